//! Time of the whole `build-matrix` against only decoding the same photographs with the same crates, in turn, on all cores.
//!
//! `cargo bench --bench build_matrix [-- GRID WINDOW PAIRS]`; prints medians and the ratio pair by pair.

use acquire::capture::Capture;
use acquire::progress::Progress;
use acquire::simulate::{Options, simulate};
use acquire::transport::{BuildOptions, build_matrix};
use rayon::prelude::*;
use std::time::Instant;

fn main() -> acquire::Result<()> {
    let numbers: Vec<usize> = std::env::args().filter_map(|a| a.parse().ok()).collect();
    let number = |k: usize, default| numbers.get(k).copied().unwrap_or(default);
    let (grid, window, pairs) = (number(0, 16), number(1, 31), number(2, 5));
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let dir = folder.path().join("capture");
    simulate(&Options { grid, window, ..Options::default() }, &dir, &Progress::silent())?;
    let capture = Capture::open(&dir, None)?;
    println!("{} photographs of {:?} px", capture.photographs(), capture.rig.camera.size_px);

    let decode = || -> acquire::Result<f64> {
        let start = Instant::now();
        capture.brackets.par_iter().flatten().try_for_each(|p| p.decode().map(drop))?;
        Ok(start.elapsed().as_secs_f64())
    };
    let build = || -> acquire::Result<f64> {
        let start = Instant::now();
        build_matrix(&dir, &BuildOptions::default(), &folder.path().join("m.rd.zarr"), &Progress::silent())?;
        Ok(start.elapsed().as_secs_f64())
    };
    decode()?;
    let mut times = Vec::new();
    for _ in 0..pairs.max(1) {
        times.push((decode()?, build()?));
    }
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    println!("decode {:.3} s", median(times.iter().map(|t| t.0).collect()));
    println!("build  {:.3} s", median(times.iter().map(|t| t.1).collect()));
    println!("ratio  {:.2}", median(times.iter().map(|t| t.1 / t.0).collect()));
    Ok(())
}
