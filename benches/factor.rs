//! Time of every stage of `factor`, and the peak memory of the process, on a large synthetic matrix.
//!
//! `cargo bench --bench factor [-- POINTS WINDOW [STORE [BACKEND]]]` (by default 128 × 128 points, 31 × 31 window). The
//! matrix has 24 terms of falling weight, displaced peaks, colour that is no polynomial of the intensity, and noise with its variance.
//! With STORE it is written there, or read when it is there already. BACKEND: full, gram or subspace.

use acquire::factor::{Options, factor};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The farthest that a peak lies from its lit point, samples.
const REACH: usize = 2;
/// Profiles: four widths, each with angular harmonics 0 to 5.
const WIDTHS: [f64; 4] = [1.5, 3.0, 5.0, 9.0];
const HARMONICS: usize = 6;
/// Exponents and gains of R, G and B against the intensity.
const COLOR: [[f64; 2]; 3] = [[0.9, 1.0], [1.0, 0.8], [1.2, 0.5]];

fn main() -> acquire::Result<()> {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let number = |k: usize, default| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (points, window) = (number(0, 128), number(1, 31));
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let store = args.get(2).map_or_else(|| folder.path().join("large.rd.zarr"), PathBuf::from);
    if !store.exists() {
        write(&store, points, window)?;
    }
    let reader = MatrixReader::open(&store)?;
    println!("{:?} points, {:?} window", reader.header().points, reader.header().window);
    let start = Instant::now();
    reader.for_each_block(|_| Ok(()))?;
    println!("reading it once: {:.1} s", start.elapsed().as_secs_f64());
    let backend = args.get(3).and_then(|name| serde_json::from_value(name.as_str().into()).ok());
    let chosen = Options { backend, ..Options::default() };
    let fixed = Options { terms: Some(15), degree: Some(7), ..chosen.clone() };
    for (name, options) in [("T = 15, P = 7", fixed), ("chosen", chosen)] {
        let progress = Progress::silent();
        let factored = factor(&reader, &options, &progress)?;
        let timings = progress.timings();
        println!("{name}: {:.1} s, rel_rmse {:.6e}", timings.iter().map(|t| t.secs).sum::<f64>(), factored.rel_rmse);
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
        shots: Vec::new(),
        warnings: Vec::new(),
        provenance: serde_json::json!({ "bench": "factor" }),
    };
    let writer = MatrixWriter::create(store, header.clone())?;
    let profiles = profiles(window);
    (0..rows).into_par_iter().try_for_each(|index| writer.put(index, &row(&header, &profiles, index)))?;
    writer.finish()
}

/// e^(−r/w) (r/(r+w))^m cos(mθ), per profile and sample of a window wide enough for every displacement.
fn profiles(window: usize) -> Vec<Vec<f64>> {
    let wide = window + 2 * REACH;
    let shapes = WIDTHS.into_iter().flat_map(|w| (0..HARMONICS).map(move |m| (w, m)));
    let at = |(width, m): (f64, usize), k: usize| {
        let [x, y] = [k % wide, k / wide].map(|v| v as f64 - (wide / 2) as f64);
        let r = x.hypot(y);
        (-r / width).exp() * (r / (r + width)).powi(m as i32) * (m as f64 * y.atan2(x)).cos()
    };
    shapes.map(|shape| (0..wide * wide).map(|k| at(shape, k)).collect()).collect()
}

fn row(header: &MatrixHeader, profiles: &[Vec<f64>], index: usize) -> Row {
    let nx = header.points[0];
    let place = [index % nx, index / nx].map(|v| std::f64::consts::TAU * v as f64 / nx as f64);
    let amount = |k: usize| {
        let (m, phase) = ((k % HARMONICS) as i32, 1.7 * k as f64);
        let wave = (place[0] * (1 + k % 3) as f64 + phase).sin() * (place[1] * (1 + k % 5) as f64 - phase).cos();
        if m == 0 { 0.25 + 0.15 * wave } else { 0.2 * 0.5_f64.powi(m) * wave }
    };
    let amounts: Vec<f64> = (0..profiles.len()).map(amount).collect();
    let mut random = rand_pcg::Pcg64::seed_from_u64(index as u64);
    let n = header.row_len();
    let mut row = Row { response: Vec::with_capacity(n), variance: Vec::with_capacity(n), valid: vec![true; n] };
    let window = header.window[0];
    let peak = place.map(|p| (REACH as f64 * (1.0 - (3.0 * p).sin())).round() as usize);
    for d in 0..header.window_len() {
        let at = d % window + peak[0] + (d / window + peak[1]) * (window + 2 * REACH);
        let intensity: f64 = profiles.iter().zip(&amounts).map(|(p, a)| a * p[at]).sum::<f64>().max(0.0);
        for [exponent, gain] in COLOR {
            let value = gain * intensity.powf(exponent + 0.1 * place[0].sin());
            let variance = 1e-6 * (value + 0.01);
            let noise: f64 = StandardNormal.sample(&mut random);
            row.response.push((value + variance.sqrt() * noise) as f32);
            row.variance.push(variance as f32);
        }
    }
    row
}
