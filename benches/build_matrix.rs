//! Time of the whole `build-matrix` against only decoding the same photographs with the same crates, in turn, on all
//! cores.
//!
//! `cargo bench --bench build_matrix [-- CAPTURE_DIR]` (by default a simulated capture of 18×14 points, 33×29 window);
//! prints medians over five pairs and the median of the pairs' ratios, of elapsed time and of processor time (Linux; it
//! hardly depends on what else the machine does), the elapsed time of each stage, and a plain read of the photographs.

#[path = "measure/cost.rs"]
mod cost;

use acquire::capture::Capture;
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, simulate};
use cost::{Cost, cost, median};
use rayon::prelude::*;
use std::path::PathBuf;

const PAIRS: usize = 5;

fn main() -> acquire::Result<()> {
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let named = std::env::args().skip(1).find(|a| !a.starts_with('-')).map(PathBuf::from);
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

    let read = || {
        capture
            .brackets
            .par_iter()
            .flatten()
            .try_for_each(|p| std::fs::read(&p.path).map(drop).map_err(acquire::Error::io("read", &p.path)))
    };
    let decode = || capture.brackets.par_iter().flatten().try_for_each(|p| p.decode().map(drop));
    let build = || {
        let progress = Progress::silent();
        build_matrix(&dir, &BuildOptions::default(), &folder.path().join("m.rd.zarr"), &progress)?;
        Ok(progress.timings())
    };
    decode()?;
    let (mut reads, mut pairs, mut stages) = (Vec::new(), Vec::<[Cost; 2]>::new(), Vec::new());
    for _ in 0..PAIRS {
        reads.push(cost(read)?.1);
        let ((), decoding) = cost(decode)?;
        let (timings, building) = cost(build)?;
        pairs.push([decoding, building]);
        stages.push(timings);
    }
    for (name, of) in [("elapsed", (|c| c.elapsed) as fn(&Cost) -> f64), ("processors", |c| c.processor)] {
        let [decoding, building] = [0, 1].map(|k| median(pairs.iter().map(|pair| of(&pair[k]))));
        let ratio = median(pairs.iter().map(|[decoding, building]| of(building) / of(decoding)));
        let reading = median(reads.iter().map(of));
        println!(
            "{name:<10} read {reading:.3} s, decode {decoding:.3} s, build {building:.3} s, build / decode {ratio:.2}"
        );
    }
    for (k, timing) in stages[0].iter().enumerate() {
        println!("  {:<12} {:7.3} s", timing.stage, median(stages.iter().map(|s| s[k].secs)));
    }
    Ok(())
}
