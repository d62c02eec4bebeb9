//! Time of every stage of `factor`, and the peak memory of the process, on a large synthetic matrix.
//!
//! `cargo bench --bench factor [-- POINTS WINDOW [STORE [BACKEND]]]` (by default 128 × 128 points, 31 × 31 window). The
//! matrix has 24 terms of falling weight, displaced peaks, colour that is no polynomial of the intensity, and noise of
//! 1e-4 of the row's peak with its variance. With STORE it is written there, or read when it is there already; BACKEND
//! is full, gram, randomized, deflation, or `none` to write the store and no more. Also the rate of the products that
//! the randomized back end makes, and of square ones, which are as fast as this processor goes, and the least time that
//! the work could take here: a plain read of the store's files, and the products of every row with T vectors, there and
//! back, once.

#[path = "measure/limits.rs"]
mod limits;

use acquire::factor::{FactorOptions, factor};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, RowBlock};
use limits::{plain_read, rate};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The farthest that a peak lies from its lit point, samples.
const REACH: usize = 2;
/// Profiles: four widths, each with angular harmonics 0 to 5.
const WIDTHS: [f64; 4] = [1.5, 3.0, 5.0, 9.0];
const HARMONICS: usize = 6;
/// Exponents and gains of R, G and B against the intensity.
const COLOR: [[f32; 2]; 3] = [[0.9, 1.0], [1.0, 0.8], [1.2, 0.5]];
/// Standard deviation of the noise, of the row's largest response.
const NOISE: f32 = 1e-4;

fn main() -> acquire::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let number = |k: usize, default| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (points, window) = (number(0, 128), number(1, 31));
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let store = args.get(2).map_or_else(|| folder.path().join("large.rd.zarr"), PathBuf::from);
    if !store.exists() {
        let start = Instant::now();
        write(&store, points, window)?;
        println!("written in {:.1} s", start.elapsed().as_secs_f64());
    }
    if args.get(3).is_some_and(|name| name == "none") {
        return Ok(());
    }
    let reader = MatrixReader::open(&store)?;
    println!("{:?} points, {:?} window", reader.header().points, reader.header().window);
    let start = Instant::now();
    reader.for_each_block(|_| Ok(()))?;
    println!("reading it once: {:.1} s", start.elapsed().as_secs_f64());
    let samples = reader.header().window_len();
    let rows = (1 << 24) / (9 * 3 * samples).max(1);
    let (square, tall, wide) = (rate(2048, 2048, 2048), rate(rows, samples, 23), rate(samples, rows, 23));
    println!("products in f32: {square:.0} GFlop/s square; {tall:.0} and {wide:.0} of {rows} rows with 23 vectors");
    let read = plain_read(&store).map_err(acquire::Error::io("read", &store))?;
    let numbers = (reader.header().rows() * reader.header().row_len()) as f64;
    println!("a plain read of the files: {read:.2} s");
    let backend = args.get(3).and_then(|name| serde_json::from_value(name.as_str().into()).ok());
    let chosen = FactorOptions { backend, ..FactorOptions::default() };
    let fixed = FactorOptions { terms: Some(15), degree: Some(7), ..chosen.clone() };
    for (name, options) in [("T = 15, P = 7", fixed), ("chosen", chosen)] {
        let (progress, start) = (Progress::silent(), Instant::now());
        let factored = factor(&reader, &options, &progress)?;
        let timings = progress.timings();
        let secs = start.elapsed().as_secs_f64();
        let planes = factored.material.header.offset_planes as f64;
        let least = read + 4e-9 * numbers * planes / 3.0 * factored.material.header.terms as f64 / wide.max(tall);
        println!(
            "{name}: {secs:.1} s, {:.1} times the least ({least:.2} s); rel_rmse {:.6e}",
            secs / least,
            factored.rel_rmse
        );
        println!("  {:?}: {}", factored.backend, factored.choice);
        timings.iter().for_each(|t| println!("  {:<10} {:7.2} s", t.stage, t.secs));
    }
    if let Some(kib) = peak_kib() {
        println!("peak memory {:.0} MiB", kib / 1024.0);
    }
    Ok(())
}

/// Largest resident size of this process so far; `None` where the system does not tell.
fn peak_kib() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().trim_end_matches("kB").trim().parse().ok()
}

/// Writes the store chunk by chunk, without a scratch file: that would take nine bytes an entry of disk (26 GB at
/// 512 × 512 points) and twice the time.
fn write(store: &Path, points: usize, window: usize) -> acquire::Result<()> {
    let rows = points * points;
    let header = MatrixHeader {
        points: [points; 2],
        window: [window; 2],
        pitch_mm: 0.5,
        lit_pitch_mm: [0.5; 2],
        lit_mm: (0..rows).map(|i| [i % points, i / points].map(|v| v as f64 * 0.5)).collect(),
        position_sd_mm: vec![0.0; rows],
        shot_of: vec![None; rows],
        common: None,
        shots: Vec::new(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: serde_json::json!({ "bench": "factor" }),
    };
    let profiles = profiles(window);
    MatrixWriter::create(store, header.clone())?.finish_with(|rows| {
        let n = rows.len() * header.row_len();
        let (mut response, mut variance) = (Vec::with_capacity(n), Vec::with_capacity(n));
        for index in rows.clone() {
            let of_row = row(&header, &profiles, index, &mut response);
            variance.resize(response.len(), of_row);
        }
        Ok(RowBlock { first: rows.start, rows: rows.len(), response, variance, valid: vec![1; n] })
    })
}

/// e^(−r/w) (r/(r+w))^m cos(mθ), per profile and sample of a window wide enough for every displacement.
fn profiles(window: usize) -> Vec<Vec<f32>> {
    let wide = window + 2 * REACH;
    let shapes = WIDTHS.into_iter().flat_map(|w| (0..HARMONICS).map(move |m| (w, m)));
    let at = |(width, m): (f64, usize), k: usize| {
        let [x, y] = [k % wide, k / wide].map(|v| v as f64 - (wide / 2) as f64);
        let r = x.hypot(y);
        ((-r / width).exp() * (r / (r + width)).powi(m as i32) * (m as f64 * y.atan2(x)).cos()) as f32
    };
    shapes.map(|shape| (0..wide * wide).map(|k| at(shape, k)).collect()).collect()
}

/// Appends the responses of row `index` to `values`; returns the variance of every one of them.
fn row(header: &MatrixHeader, profiles: &[Vec<f32>], index: usize, values: &mut Vec<f32>) -> f32 {
    let nx = header.points[0];
    let place = [index % nx, index / nx].map(|v| std::f64::consts::TAU * v as f64 / nx as f64);
    let amount = |k: usize| {
        let (m, phase) = ((k % HARMONICS) as i32, 1.7 * k as f64);
        let wave = (place[0] * (1 + k % 3) as f64 + phase).sin() * (place[1] * (1 + k % 5) as f64 - phase).cos();
        (if m == 0 { 0.25 + 0.15 * wave } else { 0.2 * 0.5_f64.powi(m) * wave }) as f32
    };
    let ([window, _], first) = (header.window, values.len());
    let peak = place.map(|p| (REACH as f64 * (1.0 - (3.0 * p).sin())).round() as usize);
    let mut intensity = vec![0.0_f32; header.window_len()];
    for (k, profile) in profiles.iter().enumerate() {
        let amount = amount(k);
        let lines = profile.chunks_exact(window + 2 * REACH).skip(peak[1]);
        for (to, from) in intensity.chunks_exact_mut(window).zip(lines) {
            to.iter_mut().zip(&from[peak[0]..]).for_each(|(to, from)| *to += amount * from);
        }
    }
    let power = COLOR.map(|[exponent, _]| exponent + 0.1 * place[0].sin() as f32);
    // Zero has no logarithm; 1e-30 is as dark.
    let logarithms = intensity.iter().map(|i| i.max(1e-30).ln());
    values.extend(logarithms.flat_map(|l| std::array::from_fn::<_, 3, _>(|c| COLOR[c][1] * (power[c] * l).exp())));
    let sd = NOISE * values[first..].iter().copied().fold(0.0, f32::max);
    let mut random = rand_pcg::Pcg64::seed_from_u64(index as u64);
    for value in &mut values[first..] {
        let noise: f32 = StandardNormal.sample(&mut random);
        *value += sd * noise;
    }
    sd * sd
}
