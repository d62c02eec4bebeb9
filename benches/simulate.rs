//! What a simulation costs beside its image encoder: the whole of `simulate` against only encoding and writing the same photographs, on all cores.
//!
//! `cargo bench --bench simulate [-- GRID CAMERA_PX_PER_SAMPLE png|jpeg]` (by default 16 points of a 31×31 window, 3 px a
//! sample, PNG); prints both times and their ratio, thrice in turn, and the median of the ratios.

use acquire::progress::Progress;
use acquire::simulate::{ExposureTime, FileFormat, Options, simulate, write_photograph};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Photographs held in memory at a time.
const BATCH: usize = 32;

fn main() -> acquire::Result<()> {
    let folder = tempfile::tempdir().map_err(acquire::Error::io("create", "a temporary folder"))?;
    let typed: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let number = |n: usize| typed.get(n).and_then(|a| a.parse::<f64>().ok());
    let options = Options {
        grid: number(0).map_or(16, |n| n as usize),
        window: 31,
        camera_px_per_sample: number(1).unwrap_or(3.0),
        format: if typed.get(2).is_some_and(|f| f == "jpeg") { FileFormat::Jpeg } else { FileFormat::Png },
        force: true,
        ..Options::default()
    };
    let dir = folder.path().join("capture");
    let mut ratios = Vec::new();
    for _ in 0..3 {
        let start = Instant::now();
        let summary = simulate(&options, &dir, &Progress::silent())?;
        let whole = start.elapsed().as_secs_f64();
        let encode = encode_again(&dir, &folder.path().join("again"), options.format)?;
        let [width, height] = summary.size_px;
        println!(
            "{} photographs of {width} × {height} px: simulate {whole:.2} s, encode {encode:.2} s, ratio {:.2}",
            summary.photographs,
            whole / encode
        );
        ratios.push(whole / encode);
    }
    ratios.sort_by(f64::total_cmp);
    println!("ratio {:.2}", ratios[1]);
    Ok(())
}

/// Seconds to encode and write the photographs of `dir` once more, without the time to decode them.
fn encode_again(dir: &Path, to: &Path, format: FileFormat) -> acquire::Result<f64> {
    let photos = dir.join("photos");
    std::fs::create_dir_all(to).map_err(acquire::Error::io("create", to))?;
    let entries = std::fs::read_dir(&photos).map_err(acquire::Error::io("read", &photos))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.sort();
    let mut secs = 0.0;
    for batch in paths.chunks(BATCH) {
        let decode = |path: &PathBuf| {
            let picture = image::open(path).map_err(|e| acquire::Error::Internal { what: e.to_string() })?;
            let size_px = [picture.width() as usize, picture.height() as usize];
            let codes = match format {
                FileFormat::Png => picture.into_rgb16().into_raw(),
                FileFormat::Jpeg => picture.into_rgb8().into_raw().into_iter().map(u16::from).collect(),
            };
            Ok((to.join(path.file_name().unwrap_or_default()), size_px, codes))
        };
        let decoded: Vec<_> = batch.par_iter().map(decode).collect::<acquire::Result<_>>()?;
        let start = Instant::now();
        decoded.par_iter().try_for_each(|(path, size_px, codes)| {
            write_photograph(path, format, *size_px, codes, ExposureTime::one_over(8), 0).map(drop)
        })?;
        secs += start.elapsed().as_secs_f64();
    }
    std::fs::remove_dir_all(to).map_err(acquire::Error::io("remove", to))?;
    Ok(secs)
}
