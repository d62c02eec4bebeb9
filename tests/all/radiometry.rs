//! What code values, exposure times and the lamp are really like, found from simulated photographs of known truth.

use crate::common;
use crate::common::compare;
use acquire::capture::{ExposureFrom, ResponseCurve, Rig};
use acquire::evaluate::evaluate;
use acquire::material::Source;
use acquire::pipeline::{BuildOptions, BuildReport, build_matrix};
use acquire::progress::Progress;
use acquire::radiance::Curve;
use acquire::simulate::{CameraCurve, FileFormat, RigCurve, SimulateOptions, SlabMaterial};
use acquire::transport::MatrixReader;
use acquire::{ConsistencyWarning, Error, RadianceWarning, Warning};
use std::path::Path;

/// Marble that is the same everywhere: codes, times and the lamp do not depend on where light goes, and one dot's light
/// is all that is solved for.
fn bench() -> SimulateOptions {
    SimulateOptions {
        material: SlabMaterial::homogeneous(),
        grid: [9, 7],
        window: [17, 13],
        seed: 3,
        ..common::bench()
    }
}

fn build(dir: &Path, exposure_from: ExposureFrom) -> (std::path::PathBuf, BuildReport) {
    let out = dir.with_extension("rd.zarr");
    let options = BuildOptions { exposure_from, ..BuildOptions::default() };
    let report = build_matrix(dir, &options, &out, &Progress::silent()).unwrap();
    (out, report)
}

#[derive(serde::Deserialize)]
struct Truth {
    exposures_secs: Vec<[f64; 2]>,
    response_curve: Vec<[f64; 2]>,
}

fn truth(dir: &Path) -> Truth {
    toml::from_str(&std::fs::read_to_string(dir.join("truth.toml")).unwrap()).unwrap()
}

/// Errors of the measured times' logarithms, their common mean taken out.
fn time_errors(dir: &Path, matrix: &Path) -> Vec<f64> {
    let truth = truth(dir).exposures_secs;
    let provenance = MatrixReader::open(matrix).unwrap().header().provenance.clone();
    let settings = provenance["radiometry"]["settings"].as_array().unwrap().clone();
    assert!(settings.iter().all(|s| s["group"] == settings[0]["group"]), "linked by the board: {settings:?}");
    let error = |s: &serde_json::Value| {
        let (nominal, measured) = (s["nominal_secs"].as_f64().unwrap(), s["measured_secs"].as_f64().unwrap());
        let near = |t: &&[f64; 2]| ((t[0] / nominal).ln().abs() * 1e9) as u64;
        (measured / truth.iter().min_by_key(near).unwrap()[1]).ln()
    };
    let errors: Vec<f64> = settings.iter().map(error).collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    errors.iter().map(|e| e - mean).collect()
}

/// Largest relative error of the saved curve between codes 10 and 245, its scale taken out, against the simulator's
/// table of pairs.
fn curve_error(dir: &Path) -> f64 {
    let curve = Curve::read(&dir.join("calibration/response.toml")).unwrap();
    // The pairs are dense in the root of light; only codes that are pairs are compared, so that nothing is interpolated
    // in the truth.
    let pairs: Vec<(f64, f64)> = truth(dir).response_curve.iter().map(|p| (255.0 * p[1], p[0])).collect();
    let used = pairs.iter().filter(|(code, _)| (10.0..=245.0).contains(code));
    let errors: Vec<f64> = used
        .flat_map(|&(code, light)| (0..3).map(move |c| (c, code, light)))
        .map(|(c, code, light)| (curve.linear_at(c, code) / light).ln())
        .collect();
    let mean = errors.iter().sum::<f64>() / errors.len() as f64;
    errors.iter().map(|e| (e - mean).abs()).fold(0.0, f64::max)
}

/// The stated error of all rows alike (green), after a look that they are not off by more than three of it.
fn albedo_sd_that_holds(matrix: &Path, dir: &Path) -> f64 {
    let (source, truth) = (Source::open(matrix).unwrap(), MatrixReader::open(&dir.join("truth.rd.zarr")).unwrap());
    let found = evaluate(&source, &truth, &Progress::silent()).unwrap();
    let (bias, sd) = (found.albedo_bias.unwrap(), found.albedo_bias_sd.unwrap());
    assert!((0..3).all(|c| bias[c].abs() < 3.0 * sd[c]), "{bias:?} ± {sd:?}");
    sd[1]
}

#[test]
fn nominal_times_are_counted_in_the_error_of_all_rows() {
    for link_exposures in [false, true] {
        let (_folder, dir) = common::capture(&SimulateOptions { nominal_times: true, link_exposures, ..bench() });
        let (matrix, _) = build(&dir, ExposureFrom::Exif);
        let sd = albedo_sd_that_holds(&matrix, &dir);
        // 1/125 for 1/128 s and the like: some per cent, and a tenth of one without them.
        assert!((0.01..0.15).contains(&sd), "{sd}");
    }
}

#[test]
fn times_that_exif_gives_wrong_by_an_eighth_of_a_stop_are_measured_to_half_a_percent() {
    let (_folder, dir) = common::capture(&SimulateOptions { exif_stops_error: 0.125, link_exposures: true, ..bench() });
    let (matrix, report) = build(&dir, ExposureFrom::Exif);
    // The lie is told, and what it costs is seen.
    assert!(
        report.warnings.iter().any(|w| matches!(w, Warning::Radiance(RadianceWarning::ExposureRatios { .. }))),
        "{:?}",
        report.warnings
    );
    let lied = compare(&matrix, &dir.join("truth.rd.zarr"));
    assert!(lied.rel_rmse > 0.03, "{lied:?}");
    albedo_sd_that_holds(&matrix, &dir);

    let (matrix, report) = build(&dir, ExposureFrom::Estimate);
    assert!(!report.warnings.iter().any(|w| matches!(
        w,
        Warning::Radiance(RadianceWarning::ExposureRatios { .. })
            | Warning::Radiance(RadianceWarning::ExposuresUnlinked { .. })
    )));
    let errors = time_errors(&dir, &matrix);
    // The project promises half a per cent; photons leave 0.05 %.
    assert!(errors.iter().all(|e| e.abs() < 0.002), "{errors:?}");
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    // As with times that are right: 0.8 %, the reconstruction of the dots' edges.
    assert!(found.rel_rmse < 0.0125, "{found:?}");
}

#[test]
fn true_times_and_a_steady_lamp_raise_no_warning() {
    let (_folder, dir) = common::capture(&bench());
    let (_, report) = build(&dir, ExposureFrom::Exif);
    let none = |w: &Warning| {
        !matches!(
            w,
            Warning::Radiance(RadianceWarning::ExposureRatios { .. })
                | Warning::Radiance(RadianceWarning::Flicker { .. })
        )
    };
    assert!(report.warnings.iter().all(none), "{:?}", report.warnings);
}

#[test]
fn settings_that_no_stack_links_are_named() {
    let (_folder, dir) = common::capture(&SimulateOptions { exif_stops_error: 0.125, ..bench() });
    let (matrix, report) = build(&dir, ExposureFrom::Estimate);
    let groups = report.warnings.iter().find_map(|w| match w {
        Warning::Radiance(RadianceWarning::ExposuresUnlinked { groups, scale_sd }) => {
            // Times are off by an eighth of a stop, 8.7 %, RMS: about 8.7 % (1/2 + 1/5)^½, by what few settings tell.
            assert!((0.02..0.3).contains(scale_sd), "{scale_sd}");
            Some(groups.iter().map(Vec::len).collect::<Vec<_>>())
        }
        _ => None,
    });
    // Two exposures of the references, five of the lattice.
    assert_eq!(groups, Some(vec![2, 5]));
    albedo_sd_that_holds(&matrix, &dir);
}

#[test]
fn an_unknown_response_of_jpeg_files_is_found_to_two_percent_together_with_the_times() {
    let (_folder, dir) = common::capture(&SimulateOptions {
        response_curve: Some(CameraCurve::Film),
        format: FileFormat::Jpeg,
        rig_curve: Some(RigCurve::Estimate),
        exif_stops_error: 0.125,
        link_exposures: true,
        ..bench()
    });
    let (matrix, _) = build(&dir, ExposureFrom::Estimate);
    // 1.5 % is found; the project aims at 1 %, which a bench that was square and central had (0.7 %).
    let error = curve_error(&dir);
    assert!(error < 0.02, "curve off by {error}");
    let errors = time_errors(&dir, &matrix);
    // 0.2 to 1.9 % over three seeds and two materials (the project aims at half a per cent): a curve that is a little
    // steeper and times that are a little farther apart give almost the same stacks.
    assert!(errors.iter().all(|e| e.abs() < 0.02), "{errors:?}");
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    // JPEG with a known curve and true times has 1.8 %.
    assert!(found.rel_rmse < 0.025, "{found:?}");

    // The saved curve does without an estimate.
    let mut rig = Rig::read(&dir.join("calibration/rig.toml")).unwrap();
    rig.camera.response_curve = ResponseCurve::File("response.toml".into());
    rig.write(&dir.join("calibration")).unwrap();
    let (matrix, _) = build(&dir, ExposureFrom::Estimate);
    let again = compare(&matrix, &dir.join("truth.rd.zarr"));
    // The times are measured anew, from pixels that another curve picks.
    assert!((again.rel_rmse - found.rel_rmse).abs() < 2e-3, "{again:?} {found:?}");
}

#[test]
fn an_unknown_response_of_16_bit_files_is_found_to_a_fifth_of_a_percent() {
    let (_folder, dir) = common::capture(&SimulateOptions {
        response_curve: Some(CameraCurve::Film),
        rig_curve: Some(RigCurve::Estimate),
        ..bench()
    });
    build(&dir, ExposureFrom::Exif);
    let error = curve_error(&dir);
    // Photons leave 0.06 %, the table of 256 codes as much.
    assert!(error < 0.002, "curve off by {error}");
}

#[test]
fn a_response_that_the_rig_gives_wrong_is_noticed() {
    let (_folder, dir) = common::capture(&SimulateOptions { response_curve: Some(CameraCurve::Film), ..bench() });
    let out = dir.with_file_name("matrix.rd.zarr");
    let mut options = BuildOptions::default();
    let refused = build_matrix(&dir, &options, &out, &Progress::silent()).unwrap_err();
    let is_curve = |w: &Warning| matches!(w, Warning::Consistency(ConsistencyWarning::ResponseCurve { .. }));
    assert!(matches!(&refused, Error::Contradiction { finding } if is_curve(finding)), "{refused}");
    assert!(!out.exists());
    // Whoever knows better goes on, and is told.
    options.accept = vec!["response-curve".into()];
    match build_matrix(&dir, &options, &out, &Progress::silent()) {
        Ok(report) => assert!(report.warnings.iter().any(is_curve), "{:?}", report.warnings),
        Err(Error::Contradiction { finding }) => assert!(!is_curve(&finding), "{finding}"),
        Err(other) => panic!("{other}"),
    }
}

#[test]
fn flicker_is_measured_and_mostly_taken_out() {
    let (_folder, steady) = common::capture(&bench());
    let (_other, flickering) = common::capture(&SimulateOptions { flicker: 0.01, ..bench() });
    let (matrix, _) = build(&steady, ExposureFrom::Exif);
    let without = compare(&matrix, &steady.join("truth.rd.zarr"));
    let (matrix, report) = build(&flickering, ExposureFrom::Exif);
    let found = compare(&matrix, &flickering.join("truth.rd.zarr"));
    let sd = report.warnings.iter().find_map(|w| match w {
        Warning::Radiance(RadianceWarning::Flicker { relative_sd, .. }) => Some(*relative_sd),
        _ => None,
    });
    // Some 40 degrees of freedom: a standard deviation is known to 11 %, and drawn from a coarse list (15 %).
    assert!(sd.is_some_and(|sd| (0.0065..0.0135).contains(&sd)), "{sd:?}");
    // One per cent in each of five photographs and the white reference; a quarter of a per cent may stay.
    assert!(found.rel_rmse < without.rel_rmse + 0.0025, "{found:?} {without:?}");
}

#[test]
fn a_missing_or_damaged_curve_file_is_named() {
    let (_folder, dir) = common::capture(&SimulateOptions { grid: [2, 3], window: [7, 5], exposures: 3, ..bench() });
    let mut rig = Rig::read(&dir.join("calibration/rig.toml")).unwrap();
    rig.camera.response_curve = ResponseCurve::File("mine.toml".into());
    rig.write(&dir.join("calibration")).unwrap();
    let out = dir.with_extension("rd.zarr");
    let refused = |text: Option<&str>| {
        if let Some(text) = text {
            std::fs::write(dir.join("calibration/mine.toml"), text).unwrap();
        }
        build_matrix(&dir, &BuildOptions::default(), &out, &Progress::silent()).unwrap_err().to_string()
    };
    assert!(refused(None).contains("mine.toml"));
    assert!(refused(Some("format = 2\nlinear = []\nrelative_sd = []")).contains("format"));
    assert!(refused(Some("format = 1\nlinear = []\nrelative_sd = []")).contains("256"));
    assert!(!out.exists());
}
