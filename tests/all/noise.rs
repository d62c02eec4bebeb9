//! The sensor's noise from the capture itself.

use crate::common;
use crate::common::compare;
use acquire::capture::{Capture, Manifest, Pattern, Samples};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{
    CameraCurve, ExposureTime, FileFormat, SensorKind, SimulateOptions, SlabMaterial, write_photograph,
};
use acquire::{ConsistencyWarning, Error, RadianceWarning, Warning};
use std::path::Path;

fn build(dir: &Path) -> acquire::Result<(std::path::PathBuf, Vec<Warning>)> {
    let out = dir.with_extension("rd.zarr");
    let report = build_matrix(dir, &BuildOptions::default(), &out, &Progress::silent())?;
    Ok((out, report.warnings))
}

/// What the issue asks for: gain to 2 %, read noise to 10 %, black to half a code value, and the variance still right.
#[test]
#[ignore = "slow: 10 s"]
fn a_rig_without_noise_gets_it_from_the_photographs_and_the_variance_stays_right() {
    let options = SimulateOptions {
        material: SlabMaterial::chessboard([4, 3]),
        grid: [9, 7],
        window: [33, 29],
        psf_px: 0.3,
        flicker: 0.003,
        rig_without_noise: true,
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&SimulateOptions { psf_px: 0.0, flicker: 0.0, ..options.clone() });
    let (matrix, warnings) = build(&dir).unwrap();
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    assert!((0.93..0.97).contains(&found.coverage), "{found:?}");
    assert!(is_near(&warnings, 0.4, 7.5335, 512.0), "{warnings:?}");
    // Blur beside the stripes and a lamp that flickers must not get into it.
    let (_folder, dir) = common::capture(&options);
    assert!(is_near(&build(&dir).unwrap().1, 0.4, 7.5335, 512.0), "blurred: {warnings:?}");
}

fn is_near(warnings: &[Warning], gain: f64, read: f64, black: f64) -> bool {
    warnings.iter().any(|w| match w {
        Warning::Radiance(RadianceWarning::NoiseEstimated {
            gain_dn_per_electron,
            read_noise_electrons,
            black_dn,
            saturation_dn,
            saturation_seen,
            ..
        }) => {
            (gain_dn_per_electron / gain - 1.0).abs() < 0.02
                && (read_noise_electrons / read - 1.0).abs() < 0.1
                && (black_dn - black).abs() < 0.5
                && *saturation_seen
                && (*saturation_dn - 16_055.0).abs() < 2.0
        }
        _ => false,
    })
}

#[test]
fn a_rig_whose_noise_the_photographs_contradict_is_warned_about_and_a_right_one_is_not() {
    contradicted(&[SensorKind::SonyA7r1, SensorKind::Phone]);
}

#[test]
#[ignore = "slow: more of the same"]
fn a_contradicted_noise_is_told_of_other_sensors_too() {
    contradicted(&[SensorKind::SonyA7r3, SensorKind::CanonT1]);
}

fn contradicted(sensors: &[SensorKind]) {
    for &sensor in sensors {
        let (_folder, dir) =
            common::capture(&SimulateOptions { grid: [7, 5], window: [17, 13], sensor, ..common::bench() });
        let doubts = |w: &Warning| matches!(w, Warning::Radiance(RadianceWarning::NoiseDisagrees { .. }));
        let warnings = build(&dir).unwrap().1;
        assert!(!warnings.iter().any(doubts), "{sensor:?}: {warnings:?}");
        let rig = dir.join("calibration/rig.toml");
        let text = std::fs::read_to_string(&rig).unwrap();
        let gain = text.lines().find(|l| l.starts_with("gain_dn_per_electron")).unwrap().to_owned();
        let value: f64 = gain.split('=').nth(1).unwrap().trim().parse().unwrap();
        std::fs::write(&rig, text.replace(&gain, &format!("gain_dn_per_electron = {}", 1.5 * value))).unwrap();
        let warnings = build(&dir).unwrap().1;
        let gain_doubted = |w: &Warning| {
            matches!(w, Warning::Radiance(RadianceWarning::NoiseDisagrees { field, found, .. })
            if field == "gain_dn_per_electron" && (found / value - 1.0).abs() < 0.03)
        };
        assert!(warnings.iter().any(gain_doubted), "{sensor:?}: {warnings:?}");
    }
}

#[test]
fn encoded_photographs_tell_their_noise_through_the_curve() {
    let base = SimulateOptions { grid: [5, 4], window: [11, 7], rig_without_noise: true, ..common::bench() };
    // Sixteen bits hide nothing: sRGB of them has the noise of the linear files. JPEG has none but its own error.
    let linear = noise_of(&base);
    let encoded = noise_of(&SimulateOptions { response_curve: Some(CameraCurve::Srgb), ..base.clone() });
    // Code 255 stands for all that 14 bits have above a black of 512.
    let scale = 255.0 / (16_383.0 - 512.0);
    assert!((encoded / (linear * scale) - 1.0).abs() < 0.1, "{encoded} {linear}");
    assert!(noise_of(&SimulateOptions { format: FileFormat::Jpeg, ..base }) < encoded);
}

#[test]
fn photographs_that_cannot_tell_the_noise_are_refused_by_the_name_of_the_section() {
    // Black shots of one exposure do not tell what black is at no time.
    let options =
        SimulateOptions { grid: [5, 4], window: [11, 7], exposures: 1, rig_without_noise: true, ..common::bench() };
    let (_folder, dir) = common::capture(&options);
    match build(&dir) {
        Err(Error::Field { path, field, found, .. }) => {
            assert!(path.ends_with("rig.toml") && field == "noise" && found.contains("reference-black"), "{found}");
        }
        other => panic!("{other:?}"),
    }
}

/// The gain that is found, DN per electron.
fn noise_of(options: &SimulateOptions) -> f64 {
    let (_folder, dir) = common::capture(options);
    let warnings = build(&dir).unwrap().1;
    let gain = warnings.iter().find_map(|w| match w {
        Warning::Radiance(RadianceWarning::NoiseEstimated { gain_dn_per_electron, .. }) => Some(*gain_dn_per_electron),
        _ => None,
    });
    gain.unwrap_or_else(|| panic!("{warnings:?}"))
}

/// A small capture with a shot of the covered lens.
fn with_dark_shot() -> (tempfile::TempDir, std::path::PathBuf) {
    let options = SimulateOptions {
        grid: [5, 4],
        window: [11, 7],
        hot_pixels: 3e-4,
        ambient: 2e-4,
        dark_shot: true,
        rig_without_noise: true,
        ..common::bench()
    };
    common::capture(&options)
}

fn estimated_black(warnings: &[Warning]) -> f64 {
    let black = warnings.iter().find_map(|w| match w {
        Warning::Radiance(RadianceWarning::NoiseEstimated { black_dn, .. }) => Some(*black_dn),
        _ => None,
    });
    black.unwrap_or_else(|| panic!("{warnings:?}"))
}

/// Adds light to all exposures of some shots alike.
fn add_light(capture: &Capture, kind: fn(&Pattern) -> bool, dn: u16) {
    for photograph in capture.shots(kind).iter().flat_map(|&s| &capture.brackets[s]) {
        let pixels = photograph.decode().unwrap();
        let Samples::U16(mut codes) = pixels.samples else { panic!("16-bit photographs") };
        codes.iter_mut().for_each(|code| *code += dn);
        let time =
            ExposureTime { numerator: (photograph.exposure_secs * 1e9).round() as u32, denominator: 1_000_000_000 };
        write_photograph(&photograph.path, FileFormat::Png, [pixels.width, pixels.height], &codes, time, 0).unwrap();
    }
}

#[test]
fn a_covered_lens_tells_black_and_hot_photosites_under_light_that_does_not_grow_with_time() {
    let (_folder, dir) = with_dark_shot();
    let warnings = build(&dir).unwrap().1;
    let lit = |warnings: &[Warning]| {
        warnings.iter().any(|w| matches!(w, Warning::Consistency(ConsistencyWarning::DarkIsLit { .. })))
    };
    // Means of many pixels are relied upon to 0.02 DN each.
    assert!((estimated_black(&warnings) - 512.0).abs() < 0.1 && !lit(&warnings), "{warnings:?}");
    let hot = |w: &Warning| matches!(w, Warning::Radiance(RadianceWarning::HotPixels { .. }));
    assert!(warnings.iter().any(hot), "{warnings:?}");
    // A lamp that shines only while the shutter opens adds as much to a short exposure as to a long one.
    let capture = Capture::open(&dir, None).unwrap();
    add_light(&capture, |p| matches!(p, Pattern::ReferenceBlack | Pattern::SampleBlack), 40);
    assert!((estimated_black(&build_again(&dir)) - 512.0).abs() < 0.1);
    // Without the dark shot the light of that lamp is taken for part of the sensor's black level.
    let mut manifest = Manifest::read(&dir).unwrap();
    manifest.shots.retain(|s| s.pattern != Pattern::Dark);
    manifest.write(&dir).unwrap();
    assert!((estimated_black(&build_again(&dir)) - 552.0).abs() < 1.0);
}

/// The warnings of a capture that has been changed, whatever else is wrong with it.
fn build_again(dir: &Path) -> Vec<Warning> {
    let all = ["ambient-changed", "lattice-light", "photograph-disagrees"];
    let options = BuildOptions { accept: all.map(str::to_owned).to_vec(), ..BuildOptions::default() };
    let out = dir.with_extension("again.rd.zarr");
    let _ = std::fs::remove_dir_all(&out);
    build_matrix(dir, &options, &out, &Progress::silent()).unwrap().warnings
}

#[test]
fn a_dark_shot_whose_lens_was_not_covered_is_told() {
    let (_folder, dir) = with_dark_shot();
    let capture = Capture::open(&dir, None).unwrap();
    let of = |kind: fn(&Pattern) -> bool| &capture.brackets[capture.shots(kind)[0]];
    let (dark, black) = (of(|p| matches!(p, Pattern::Dark)), of(|p| matches!(p, Pattern::SampleBlack)));
    for (to, from) in dark.iter().zip(black) {
        std::fs::copy(&from.path, &to.path).unwrap();
    }
    let warnings = build(&dir).unwrap().1;
    let lit = |w: &Warning| matches!(w, Warning::Consistency(ConsistencyWarning::DarkIsLit { shot, ratio }) if shot == "dark" && *ratio == 1.0);
    assert!(warnings.iter().any(lit), "{warnings:?}");
}
