//! Time of the whole `build-matrix` against only decoding the same photographs with the same crates, in turn, on all
//! cores.
//!
//! `cargo bench --bench build_matrix [-- CAPTURE_DIR]` (by default a simulated capture of 16×16 points, 31×31 window);
//! prints medians over five pairs and the median of the pairs' ratios.

use acquire::capture::Capture;
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, simulate};
use rayon::prelude::*;
use std::time::Instant;

fn main() -> acquire::Result<()> {
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let named = std::env::args().skip(1).find(|a| !a.starts_with('-')).map(std::path::PathBuf::from);
    let dir = named.clone().unwrap_or_else(|| folder.path().join("capture"));
    if named.is_none() {
        simulate(
            &SimulateOptions { grid: [18, 14], window: [33, 29], ..SimulateOptions::default() },
            &dir,
            &Progress::silent(),
        )?;
    }
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
    for _ in 0..5 {
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
