//! Merges the exposures of one shot and prints the radiance of a pixel with its standard deviation.
//!
//! `cargo run --example merge_bracket -- captures reference-white 80 70`: folder, shot, column and row.

use acquire::capture::{Capture, Rect};
use acquire::radiance::{Exposure, Sensor, merge};
use acquire::{Error, Result};
use std::path::Path;

/// Radiance of a pixel, code values per second in R, G and B; its standard deviation; how many exposures measured it.
pub fn radiance_at(folder: &Path, shot: &str, [x, y]: [usize; 2]) -> Result<([f64; 3], [f64; 3], [u8; 3])> {
    // Manifest, rig and the heads of all photographs are read and checked; no pixel is decoded yet.
    let capture = Capture::open(folder, None)?;
    let asked =
        |field: &str, expected: &str, found: &str| Error::field(capture.manifest_path(), field, expected, found);
    let named = capture.manifest.shots.iter().position(|s| s.name == shot);
    let photographs = &capture.brackets[named.ok_or_else(|| asked("shots: name", "the name of a shot", shot))?];

    // The bracket, shortest exposure first. Every photograph of a capture is of one size.
    let decoded = photographs.iter().map(|photograph| photograph.decode()).collect::<Result<Vec<_>>>()?;
    let rect = Rect { x: 0, y: 0, width: decoded[0].width, height: decoded[0].height };
    if x >= rect.width || y >= rect.height {
        return Err(asked("pixel", &format!("within {} × {} px", rect.width, rect.height), &format!("({x}, {y})")));
    }

    // Noise and response curve from rig.toml, what 8 bits and JPEG add from the files.
    let sensor = Sensor::of_capture(&capture)?;
    let exposures = decoded.into_iter().zip(photographs);
    let exposures = exposures.map(|(pixels, p)| Exposure { samples: pixels.samples, secs: p.effective_secs });
    let merged = merge(&exposures.collect::<Vec<_>>(), rect, &sensor);
    let at = merged.at(x, y);
    let sd = |c: usize| f64::from(merged.variance[at + c]).sqrt();
    Ok(([0, 1, 2].map(|c| f64::from(merged.value[at + c])), [0, 1, 2].map(sd), [0, 1, 2].map(|c| merged.used[at + c])))
}

fn main() -> Result<()> {
    let typed: Vec<String> = std::env::args().skip(1).collect();
    let word = |k: usize, default: &str| typed.get(k).cloned().unwrap_or(default.to_owned());
    let column_or_row = |k: usize, default: &str| word(k, default).parse().map_err(Error::internal);
    let pixel = [column_or_row(2, "80")?, column_or_row(3, "70")?];
    let (radiance, sd, exposures) = radiance_at(Path::new(&word(0, "captures")), &word(1, "reference-white"), pixel)?;
    for (c, name) in ["R", "G", "B"].into_iter().enumerate() {
        println!("{name}: {:.1} ± {:.1} DN/s from {} exposures", radiance[c], sd[c], exposures[c]);
    }
    Ok(())
}
