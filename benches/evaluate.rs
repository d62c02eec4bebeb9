//! What evaluating a material costs: a point query, a draw, relighting the slab.
//!
//! `cargo bench --bench evaluate [-- POINTS WINDOW TERMS QUERIES]` (by default 256 × 256 points, 61 × 61 window, T = 15,
//! 2²⁰ queries), on synthetic factors: `tucker` with P = 7, `joint`, and `joint` with 25 different shifts. Queries and
//! draws on one core, at random lit points and offsets (memory is the limit) and at one lit point (the processor is);
//! relighting on all cores, lit points beside the samples of the canvas. Then the material is written as a matrix (no more than 128 ×
//! 128 points of it), which is relit and which the material is evaluated against.
//!
//! Beside them the least that this machine could take: what has to be read once, from memory or by a plain read of the
//! files, and the products of the terms, at the rates that the bench measures.

#[path = "measure/limits.rs"]
mod limits;
#[path = "measure/memory.rs"]
mod memory;

use acquire::evaluate::evaluate;
use acquire::material::{
    Evaluator, Light, Material, MaterialHeader, Model, Precision, Responses, Source, lit_area, relight, save,
};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter};
use limits::{plain_read, rate};
use memory::memory_rate;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;
use std::hint::black_box;
use std::path::Path;
use std::time::Instant;

const DEGREE: usize = 7;
const LIGHTS: [Light; 3] = [Light::Uniform, Light::Gradient, Light::Spot];
/// Points of the matrix along each axis, at most: 0.7 GB with windows of 61 × 61.
const MATRIX_POINTS: usize = 128;

/// 10⁹ a second: bytes from memory; operations of products of rows with the terms, and of square ones.
#[derive(Debug, Clone, Copy)]
struct Rates {
    memory: f64,
    rows: f64,
    square: f64,
}

fn main() -> acquire::Result<()> {
    let args: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let number = |k: usize, default| args.get(k).copied().unwrap_or(default);
    let size = [number(0, 256), number(1, 61), number(2, 15)];
    println!("{} × {0} points, {} × {1} window, T = {}", size[0], size[1], size[2]);
    let rates =
        Rates { memory: memory_rate(), rows: rate(4096, size[2], size[1] * size[1]), square: rate(2048, 2048, 2048) };
    println!(
        "{:.1} GB/s from memory, {:.0} GFlop/s in products of rows, {:.0} in square ones",
        rates.memory, rates.rows, rates.square
    );
    for (name, model, reach) in
        [("tucker, P = 7", Model::Tucker, 0), ("joint", Model::Joint, 0), ("joint, 25 shifts", Model::Joint, 2)]
    {
        println!("{name}");
        let material = synthetic(size, model, reach);
        queries(&material, number(3, 1 << 20))?;
        relighting(material, rates)?;
    }
    println!("as a matrix");
    against_matrix(synthetic([size[0].min(MATRIX_POINTS), size[1], size[2]], Model::Joint, 0), rates)
}

/// Seconds to multiply every row out of the factors, and to read these once.
fn least_of_rows(material: &Material, rates: Rates) -> f64 {
    let h = &material.header;
    let products = 2 * h.rows() * h.terms * h.offset_planes * h.window[0] * h.window[1];
    1e-9 * (products as f64 / rates.rows + material.bytes_f32() as f64 / rates.memory)
}

/// Seconds to convolve the terms instead: transforms of impulses and of maps, one back for each channel, at 2.5 n log₂ n
/// operations for n samples of the canvas.
fn least_of_convolution(material: &Material, canvas: [usize; 2], rates: Rates) -> f64 {
    let h = &material.header;
    let samples = (canvas[0] * canvas[1]) as f64;
    let transforms = (h.terms * (3 + h.offset_planes) + 3) as f64;
    1e-9 * (transforms * 2.5 * samples * samples.log2() / rates.square + material.bytes_f32() as f64 / rates.memory)
}

/// Peaks that are narrower and wider, brighter and darker from place to place.
fn synthetic([points, window, terms]: [usize; 3], model: Model, reach: usize) -> Material {
    let extended = window + 2 * reach;
    let planes = if model == Model::Joint { 3 } else { 1 };
    let rows = points * points;
    let wave = |k: usize, j: usize, c: usize| (0.37 * k as f32 + 1.7 * j as f32 + 0.5 * c as f32).sin();
    let incident = |at: usize| {
        let (i, j) = (at / terms, at % terms);
        (if j == 0 { 2.0 } else { wave(i % points / 7 + i / points / 5, j, 0) }) / points as f32
    };
    let offset = |at: usize| {
        let (e, j, c) =
            (at % (extended * extended), at / (extended * extended) % terms, at / (extended * extended * terms));
        let d = [e % extended, e / extended].map(|v| v as f32 - (extended / 2) as f32);
        let r = d[0].hypot(d[1]);
        (-r / (2.0 + 0.7 * j as f32 + c as f32)).exp() * (j as f32 * d[1].atan2(d[0])).cos()
    };
    let degree = (model == Model::Tucker).then_some(DEGREE);
    let powers = degree.map_or(0, |p| p + 1);
    let side = 2 * reach + 1;
    Material {
        entry_map: Vec::new(),
        exit_map: Vec::new(),
        header: MaterialHeader {
            exit_grid: None,
            model,
            points: [points; 2],
            window: [window; 2],
            pitch_mm: 0.5,
            lit_pitch_mm: [0.5; 2],
            extended: [extended; 2],
            terms,
            incident_planes: 1,
            offset_planes: planes,
            shared_maps: None,
            profile: false,
            degree,
            intensity_range: [-0.05, 1.05],
            singular_values: Vec::new(),
            noise_level: 0.0,
            warnings: Vec::new(),
            provenance: serde_json::Value::Null,
        },
        lit_mm: (0..rows)
            .map(|i| [(i % points) as f64 * 0.5 + 0.1 * (i as f64).sin(), (i / points) as f64 * 0.5])
            .collect(),
        weights: (0..terms).map(|j| points as f32 / 2.0 * 0.7_f32.powi(j as i32)).collect(),
        incident_factors: (0..rows * terms).map(incident).collect(),
        offset_factors: (0..planes * terms * extended * extended).map(offset).collect::<Vec<_>>().into(),
        profile: Vec::new(),
        color_coefficients: (0..rows * 3 * powers).map(|k| 0.5_f32.powi((k % powers.max(1)) as i32)).collect(),
        shift: (0..rows).map(|i| [i % side, i / side % side].map(|s| s as i16 - reach as i16)).collect(),
    }
}

fn queries(material: &Material, count: usize) -> acquire::Result<()> {
    let start = Instant::now();
    let evaluator = Evaluator::new(material)?;
    println!("  prepare   {:8.0} ms", 1e3 * start.elapsed().as_secs_f64());
    let h = &material.header;
    let mut random = rand_pcg::Pcg64::seed_from_u64(1);
    let reach = (h.window[0] / 2) as i64;
    let anywhere: Vec<(usize, [isize; 2], f64)> = (0..count)
        .map(|_| {
            let offset = [0, 1].map(|_| random.random_range(-reach..=reach) as isize);
            (random.random_range(0..h.rows()), offset, random.random())
        })
        .collect();
    let here: Vec<_> = anywhere.iter().map(|&(_, offset, u)| (h.rows() / 2, offset, u)).collect();
    for (place, queries) in [("anywhere", &anywhere), ("at one lit point", &here)] {
        let time = |name: &str, each: &dyn Fn(usize, [isize; 2], f64)| {
            let mut best = f64::INFINITY;
            for _ in 0..5 {
                let start = Instant::now();
                queries.iter().for_each(|&(i, offset, u)| each(i, offset, u));
                best = best.min(start.elapsed().as_secs_f64());
            }
            println!("  {name:<9} {:8.1} ns {place}", 1e9 * best / queries.len() as f64);
        };
        time("response", &|i, d, _| _ = black_box(evaluator.response(i, d)));
        let points = |i: usize, d: [isize; 2], u: f64| {
            let x_i = material.lit_mm[i].map(|v| v + 0.2 * u);
            (x_i, [0, 1].map(|a| x_i[a] + 0.5 * (d[a] as f64 + u - 0.5)))
        };
        time("nearest", &|i, d, u| {
            let (x_i, x_o) = points(i, d, u);
            black_box(evaluator.nearest(x_i, x_o));
        });
        time("between", &|i, d, u| {
            let (x_i, x_o) = points(i, d, u);
            black_box(evaluator.between(x_i, x_o));
        });
        time("sample", &|i, _, u| _ = black_box(evaluator.sample(i, u)));
        time("probability", &|i, d, _| _ = black_box(evaluator.probability(i, d)));
    }
    Ok(())
}

fn relighting(material: Material, rates: Rates) -> acquire::Result<()> {
    let rows = material.header.rows();
    let (of_rows, colored) = (least_of_rows(&material, rates), material.header.degree.is_some());
    let convolved = |canvas| if colored { f64::INFINITY } else { least_of_convolution(&material, canvas, rates) };
    let canvas = [0, 1].map(|a| material.header.points[a] + material.header.window[a] - 1);
    let least = of_rows.min(convolved(canvas));
    println!("  the least for all rows {of_rows:.3} s, for relighting {least:.4} s");
    let start = Instant::now();
    let responses = Responses::new(&material);
    let sum: f32 = (0..rows).into_par_iter().map(|i| responses.row(i)[0]).sum();
    black_box(sum);
    println!("  all rows, one by one {:6.2} s", start.elapsed().as_secs_f64());
    let source = Source::Material(Box::new(material), "bench".into());
    let start = Instant::now();
    for rows in source.blocks() {
        black_box(source.read(rows)?);
    }
    println!("  all rows, in blocks  {:6.2} s", start.elapsed().as_secs_f64());
    for light in LIGHTS {
        let secs = relit(&source, &light)?;
        println!("  relight, {:<11} {secs:6.2} s, {:.1} times the least", format!("{light:?}"), secs / least);
    }
    Ok(())
}

/// Seconds to relight with one light.
fn relit(source: &Source, light: &Light) -> acquire::Result<f64> {
    let start = Instant::now();
    let quadrature = light.quadrature(&lit_area(source)?, &source.shape());
    let flux = light.flux(&quadrature)?;
    black_box(relight(source, &quadrature, &[flux], &Progress::silent())?);
    Ok(start.elapsed().as_secs_f64())
}

/// Relights the matrix that a material is, and evaluates the material against it.
fn against_matrix(material: Material, rates: Rates) -> acquire::Result<()> {
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let store = folder.path().join("bench.rd.zarr");
    let of_rows = least_of_rows(&material, rates);
    let file = folder.path().join("bench.safetensors");
    save(&material, Precision::F32, &file)?;
    let source = Source::Material(Box::new(material), file);
    write(&source, &store)?;
    let reference = MatrixReader::open(&store)?;
    let matrix = Source::Matrix(Box::new(MatrixReader::open(&store)?));
    let header = reference.header();
    let numbers = (header.rows() * header.row_len()) as f64;
    // Numbers have to come from the files, and from memory once they are decoded.
    let read = plain_read(&store).map_err(acquire::Error::io("read", &store))? + 4e-9 * numbers / rates.memory;
    println!("  {:?} points, a plain read and one from memory {read:.3} s, all rows {of_rows:.3} s", header.points);
    for light in LIGHTS {
        let secs = relit(&matrix, &light)?;
        println!("  relight, {:<11} {secs:6.2} s, {:.1} times the least", format!("{light:?}"), secs / read);
    }
    for _ in 0..3 {
        let start = Instant::now();
        black_box(evaluate(&source, &reference, &Progress::silent())?);
        let secs = start.elapsed().as_secs_f64();
        println!("  evaluate {secs:6.2} s, {:.1} times the least", secs / (read + of_rows));
    }
    Ok(())
}

fn write(source: &Source, store: &Path) -> acquire::Result<()> {
    let shape = source.shape();
    let header = MatrixHeader {
        points: shape.points,
        window: shape.window,
        pitch_mm: shape.pitch_mm,
        lit_pitch_mm: [0.5; 2],
        lit_mm: shape.lit_mm.to_vec(),
        position_sd_mm: vec![0.0; shape.rows()],
        shot_of: vec![None; shape.rows()],
        common: None,
        shots: Vec::new(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: serde_json::json!({ "bench": "evaluate" }),
    };
    MatrixWriter::create(store, header)?.finish_with(|rows| source.read(rows))
}
