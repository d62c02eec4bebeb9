//! What evaluating a material costs: a point query, a draw, relighting the slab.
//!
//! `cargo bench --bench evaluate [-- POINTS WINDOW TERMS]` (by default 256 × 256 points, 61 × 61 window, T = 15), on
//! synthetic factors: `tucker` with P = 7, `joint`, and `joint` with 25 different shifts. Queries and draws on one
//! core, at random lit points and offsets (memory is the limit) and at one lit point (the processor is); relighting on
//! all cores, lit points beside the samples of the canvas.

use acquire::material::{Evaluator, Light, Material, MaterialHeader, Model, Responses, Source, lit_area, relight};
use acquire::progress::Progress;
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

const DEGREE: usize = 7;
const QUERIES: usize = 1 << 20;

fn main() -> acquire::Result<()> {
    let args: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let number = |k: usize, default| args.get(k).copied().unwrap_or(default);
    let size = [number(0, 256), number(1, 61), number(2, 15)];
    println!("{} × {0} points, {} × {1} window, T = {}", size[0], size[1], size[2]);
    for (name, model, reach) in
        [("tucker, P = 7", Model::Tucker, 0), ("joint", Model::Joint, 0), ("joint, 25 shifts", Model::Joint, 2)]
    {
        println!("{name}");
        let material = synthetic(size, model, reach);
        queries(&material)?;
        relighting(material)?;
    }
    Ok(())
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

fn queries(material: &Material) -> acquire::Result<()> {
    let start = Instant::now();
    let evaluator = Evaluator::new(material)?;
    println!("  prepare   {:8.0} ms", 1e3 * start.elapsed().as_secs_f64());
    let h = &material.header;
    let mut random = rand_pcg::Pcg64::seed_from_u64(1);
    let reach = (h.window[0] / 2) as i64;
    let anywhere: Vec<(usize, [isize; 2], f64)> = (0..QUERIES)
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

fn relighting(material: Material) -> acquire::Result<()> {
    let rows = material.header.rows();
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
    for light in [Light::Uniform, Light::Gradient, Light::Spot] {
        let start = Instant::now();
        let quadrature = light.quadrature(&lit_area(&source)?, &source.shape());
        let flux = light.flux(&quadrature)?;
        black_box(relight(&source, &quadrature, &[flux], &Progress::silent())?);
        println!("  relight, {:<11} {:6.2} s", format!("{light:?}"), start.elapsed().as_secs_f64());
    }
    Ok(())
}
