//! What a simulation costs beside its image encoder: the whole of `simulate` against only encoding and writing the same
//! photographs, on all cores.
//!
//! `cargo bench --bench simulate [-- GRID CAMERA_PX_PER_SAMPLE png|jpeg]` (by default 16 points of a 31×31 window, 3 px
//! a sample, PNG); thrice in turn, in folders of their own. Prints elapsed times, processor times (Linux; they hardly
//! depend on what else the machine does) and their ratios, then the medians.

#[path = "measure/cost.rs"]
mod cost;

use acquire::progress::Progress;
use acquire::simulate::{ExposureTime, FileFormat, SimulateOptions, simulate, write_photograph};
use cost::{Cost, cost, median};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Photographs held in memory at a time.
const BATCH: usize = 64;
/// Folders are removed between rounds only when they hold this many bytes: for half a minute after files were removed
/// ext4 is slow to create others.
const MUCH: u64 = 1 << 30;

fn main() -> acquire::Result<()> {
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let typed: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let number = |n: usize| typed.get(n).and_then(|a| a.parse::<f64>().ok());
    let options = SimulateOptions {
        grid: number(0).map_or([18, 14], |n| [n as usize; 2]),
        window: [33, 29],
        camera_px_per_sample: number(1).unwrap_or(3.0),
        format: if typed.get(2).is_some_and(|f| f == "jpeg") { FileFormat::Jpeg } else { FileFormat::Png },
        ..SimulateOptions::default()
    };
    let mut ratios = [const { Vec::new() }; 2];
    for round in 0..3 {
        let dir = folder.path().join(format!("capture-{round}"));
        let (summary, whole) = cost(|| simulate(&options, &dir, &Progress::silent()))?;
        let again = folder.path().join(format!("again-{round}"));
        let encode = encode_again(&dir, &again, options.format, summary.size_px)?;
        let [width, height] = summary.size_px;
        println!(
            "{} photographs of {width} × {height} px, {:.1} MB: simulate {:.2} s ({:.2} s of processors), encode {:.2} s ({:.2} s)",
            summary.photographs,
            summary.photograph_bytes as f64 / 1e6,
            whole.elapsed,
            whole.processor,
            encode.elapsed,
            encode.processor,
        );
        ratios[0].push(whole.elapsed / encode.elapsed);
        ratios[1].push(whole.processor / encode.processor);
        if summary.photograph_bytes > MUCH {
            [dir, again]
                .iter()
                .try_for_each(|d| std::fs::remove_dir_all(d).map_err(acquire::Error::io("remove", d)))?;
        }
    }
    let [elapsed, processor] = ratios.map(|ratios| median(ratios.into_iter()));
    println!("ratio {elapsed:.2}, of processor time {processor:.2}");
    Ok(())
}

/// What it costs to encode and write the photographs of `dir` once more, without decoding them.
fn encode_again(dir: &Path, to: &Path, format: FileFormat, size_px: [usize; 2]) -> acquire::Result<Cost> {
    let photos = dir.join("photos");
    std::fs::create_dir_all(to).map_err(acquire::Error::io("create", to))?;
    let entries = std::fs::read_dir(&photos).map_err(acquire::Error::io("read", &photos))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.sort();
    let mut total = Cost::default();
    for batch in paths.chunks(BATCH) {
        let decode = |path: &PathBuf| {
            let picture = image::open(path).map_err(|e| acquire::Error::Internal { what: e.to_string() })?;
            let codes = match format {
                FileFormat::Png | FileFormat::Tiff | FileFormat::TiffDeflate => picture.into_rgb16().into_raw(),
                FileFormat::Jpeg => picture.into_rgb8().into_raw().into_iter().map(u16::from).collect(),
            };
            Ok((to.join(path.file_name().unwrap_or_default()), codes))
        };
        let decoded: Vec<_> = batch.par_iter().map(decode).collect::<acquire::Result<_>>()?;
        let ((), batch) = cost(|| {
            decoded.par_iter().try_for_each(|(path, codes)| {
                write_photograph(path, format, size_px, codes, ExposureTime::one_over(8), 0)
            })
        })?;
        total = Cost { elapsed: total.elapsed + batch.elapsed, processor: total.processor + batch.processor };
    }
    Ok(total)
}
