//! Photosites that saturate in the dark: always, or in the long exposures only.

use crate::common;
use crate::common::compare;
use acquire::capture::{Capture, Samples};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{ExposureTime, FileFormat, SimulateOptions, SlabMaterial, write_photograph};
use acquire::{RadianceWarning, Warning};
use std::path::Path;

/// Code value of saturation, and dark current of a very hot photosite: it saturates a second, not a quarter of it.
const FULL: u16 = 16_383;
const HOT_DN_PER_SEC: f64 = 24_000.0;

/// Every 41st column and 37th row has a photosite that is stuck, or hot in turn. Returns how many of each.
fn spoil(dir: &Path) -> [usize; 2] {
    let capture = Capture::open(dir, None).unwrap();
    let mut counts = [0; 2];
    for photograph in capture.brackets.iter().flatten() {
        let pixels = photograph.decode().unwrap();
        let Samples::U16(mut codes) = pixels.samples else { panic!("16-bit photographs") };
        counts = [0; 2];
        for y in (20..pixels.height - 2).step_by(37) {
            for x in (15..pixels.width - 2).step_by(41) {
                let hot = (x / 41 + y / 37) % 2;
                let k = 3 * (y * pixels.width + x) + (x + y) % 3;
                let dark = (HOT_DN_PER_SEC * photograph.exposure_secs).round() as u32;
                codes[k] = if hot == 0 { FULL } else { (u32::from(codes[k]) + dark).min(u32::from(FULL)) as u16 };
                counts[hot] += 1;
            }
        }
        let time =
            ExposureTime { numerator: (photograph.exposure_secs * 1e9).round() as u32, denominator: 1_000_000_000 };
        write_photograph(&photograph.path, FileFormat::Png, [pixels.width, pixels.height], &codes, time, 0).unwrap();
    }
    counts
}

#[test]
fn stuck_and_hot_photosites_cost_neither_samples_nor_accuracy_and_are_told() {
    let options = SimulateOptions {
        material: SlabMaterial::chessboard([4, 3]),
        grid: [9, 7],
        window: [33, 29],
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let out = dir.with_extension("rd.zarr");
    let build = || build_matrix(&dir, &BuildOptions::default(), &out, &Progress::silent()).unwrap().warnings;
    let warnings = build();
    assert!(
        !warnings.iter().any(|w| matches!(w, Warning::Radiance(RadianceWarning::HotPixels { .. }))),
        "{warnings:?}"
    );
    let clean = compare(&out, &dir.join("truth.rd.zarr"));
    let [stuck_ones, hot_ones] = spoil(&dir);
    assert!(stuck_ones > 5 && hot_ones > 5);
    let warnings = build();
    let found = compare(&out, &dir.join("truth.rd.zarr"));
    println!("{clean:?}\n{found:?}");
    let told = warnings.iter().find_map(|w| match w {
        Warning::Radiance(RadianceWarning::HotPixels { photosites, stuck, .. }) => Some([*stuck, photosites - stuck]),
        _ => None,
    });
    assert_eq!(told, Some([stuck_ones, hot_ones]), "{warnings:?}");
    assert_eq!(found.valid, 1.0, "no window loses a sample");
    // One photosite in 1,500 or so: where one falls on a dot its neighbours know the light to a few per cent only.
    assert!(found.rel_rmse < 1.3 * clean.rel_rmse, "{found:?} {clean:?}");
    assert!((0.93..0.97).contains(&found.coverage), "{found:?}");
}
