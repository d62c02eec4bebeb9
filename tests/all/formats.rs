//! The same photographs in other formats give the same matrix.

use crate::common;
use crate::common::{Comparison, compare};
use acquire::capture::{Capture, Manifest, Noise, Rig, Samples};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, SlabMaterial};
use acquire::{RadianceWarning, Warning};
use std::path::Path;

const BLACK: f64 = 512.0;
const MAX: f64 = 16_383.0;

/// Rewrites every photograph with `write` under the ending `to`, exposure times in the manifest.
fn convert(dir: &Path, to: &str, write: impl Fn(&Path, [usize; 2], &[u16])) {
    let capture = Capture::open(dir, None).unwrap();
    let mut manifest = Manifest::read(dir).unwrap();
    for (shot, bracket) in manifest.shots.iter_mut().zip(&capture.brackets) {
        for entry in &mut shot.photographs {
            let photograph = bracket.iter().find(|p| p.path == dir.join(&entry.file)).unwrap();
            let pixels = photograph.decode().unwrap();
            let Samples::U16(codes) = pixels.samples else { panic!("16-bit photographs") };
            entry.file = entry.file.replace(".png", to);
            entry.exposure_secs = Some(photograph.exposure_secs);
            write(&dir.join(&entry.file), [pixels.width, pixels.height], &codes);
        }
    }
    manifest.write(dir).unwrap();
}

fn write_exr(path: &Path, [width, height]: [usize; 2], codes: &[u16]) {
    use exr::prelude::*;
    let light = |k: usize| ((f64::from(codes[k]) - BLACK) / (MAX - BLACK)) as f32;
    let pixel = |at: Vec2<usize>| {
        let k = 3 * (at.y() * width + at.x());
        (light(k), light(k + 1), light(k + 2))
    };
    Image::from_channels((width, height), SpecificChannels::rgb(pixel)).write().to_file(path).unwrap();
}

fn write_tiff(path: &Path, [width, height]: [usize; 2], codes: &[u16]) {
    let file = std::io::BufWriter::new(std::fs::File::create(path).unwrap());
    let mut encoder = tiff::encoder::TiffEncoder::new(file).unwrap();
    encoder.write_image::<tiff::encoder::colortype::RGB16>(width as u32, height as u32, codes).unwrap();
}

fn build(dir: &Path) -> (Comparison, Vec<Warning>) {
    let out = dir.with_extension("rd.zarr");
    let report = build_matrix(dir, &BuildOptions::default(), &out, &Progress::silent()).unwrap();
    (compare(&out, &dir.join("truth.rd.zarr")), report.warnings)
}

#[test]
fn tiff_and_floating_point_exr_give_the_matrix_and_the_variance_of_png() {
    let options = SimulateOptions {
        material: SlabMaterial::chessboard([4, 3]),
        grid: [9, 7],
        window: [33, 29],
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let png = build(&dir).0;
    let tiff = dir.with_file_name("tiff");
    common::copy_folder(&dir, &tiff);
    convert(&tiff, ".tif", write_tiff);
    let same = build(&tiff).0;
    assert_eq!((png.rel_rmse, png.coverage), (same.rel_rmse, same.coverage), "the same code values");

    // Light from 0 to 1, black subtracted, noise in that unit.
    convert(&dir, ".exr", write_exr);
    let path = dir.join("calibration/rig.toml");
    let rig = Rig::read(&path).unwrap();
    let given = rig.noise.clone().unwrap();
    let unit = MAX - BLACK;
    let noise = Noise {
        black_dn: 0.0,
        saturation_dn: (given.saturation_dn - BLACK) / unit,
        gain_dn_per_electron: given.gain_dn_per_electron / unit,
        ..given.clone()
    };
    for noise in [Some(noise), None] {
        Rig { noise: noise.clone(), ..rig.clone() }.write(&dir.join("calibration")).unwrap();
        let (found, warnings) = build(&dir);
        // Rounding was 1/12 of 9 DN² of read noise: leaving it out of the variance does not show.
        assert!((found.rel_rmse / png.rel_rmse - 1.0).abs() < 0.01, "{noise:?} {found:?} {png:?}");
        assert!((0.93..0.97).contains(&found.coverage), "{noise:?} {found:?}");
        assert!(
            !warnings.iter().any(|w| matches!(w, Warning::Radiance(RadianceWarning::NoiseDisagrees { .. }))),
            "{warnings:?}"
        );
        let estimated = warnings.iter().any(|w| matches!(w, Warning::Radiance(RadianceWarning::NoiseEstimated { gain_dn_per_electron, black_dn, .. })
            if (gain_dn_per_electron * unit / given.gain_dn_per_electron - 1.0).abs() < 0.02 && (black_dn * unit).abs() < 0.5));
        assert_eq!(estimated, noise.is_none(), "{warnings:?}");
    }
}
