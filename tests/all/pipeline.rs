//! From simulated photographs to the matrix: known truth recovered to a stated error.

use crate::common;
use crate::common::compare;
use acquire::geometry::{CameraView, Homography};
use acquire::pipeline::{BuildOptions, BuildReport, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, SlabMaterial};
use acquire::transport::MatrixReader;
use acquire::{CaptureWarning, RadianceWarning, ResponseWarning, Warning};
use std::path::Path;

fn build(dir: &Path) -> (std::path::PathBuf, BuildReport) {
    let out = dir.with_extension("rd.zarr");
    let report = build_matrix(dir, &BuildOptions::default(), &out, &Progress::silent()).unwrap();
    (out, report)
}

#[derive(serde::Deserialize)]
struct Truth {
    camera_from_slab: CameraView,
    slab_from_projector: Homography,
}

/// RMS over the slab of where camera and projector are believed to be against where they are, camera px and projector
/// px.
fn registration_rms(dir: &Path, report: &BuildReport) -> [f64; 2] {
    let truth: Truth = toml::from_str(&std::fs::read_to_string(dir.join("truth.toml")).unwrap()).unwrap();
    let found = &report.registration;
    let (cx, cy) = (2.0 * found.center_mm[0], 2.0 * found.center_mm[1]);
    let projector = truth.slab_from_projector.inverse().unwrap();
    let mut sums = [0.0; 2];
    for k in 0..100 {
        let p = [cx * (f64::from(k % 10) + 0.5) / 10.0, cy * (f64::from(k / 10) + 0.5) / 10.0];
        let (a, b) = (truth.camera_from_slab.camera_from_slab(p), found.view.camera_from_slab(p));
        let (c, d) = (projector.map(p), found.slab_from_projector.projector_from_slab(p));
        for i in 0..2 {
            sums[0] += (a[i] - b[i]).powi(2) / 200.0;
            sums[1] += (c[i] - d[i]).powi(2) / 200.0;
        }
    }
    sums.map(f64::sqrt)
}

#[test]
fn a_noise_free_capture_gives_the_matrix_to_a_hundredth_or_so() {
    noise_free_captures(&[SlabMaterial::chessboard([4, 3]), SlabMaterial::marble()]);
}

#[test]
#[ignore = "slow: more of the same"]
fn a_noise_free_capture_of_every_material_gives_the_matrix_to_a_hundredth_or_so() {
    noise_free_captures(&[SlabMaterial::homogeneous(), SlabMaterial::chessboard([8, 6])]);
}

fn noise_free_captures(materials: &[SlabMaterial]) {
    for material in materials {
        let options = SimulateOptions {
            material: material.clone(),
            grid: [9, 7],
            window: [17, 13],
            noise_free: true,
            ..common::bench()
        };
        let (_folder, dir) = common::capture(&options);
        let (matrix, report) = build(&dir);
        let found = compare(&matrix, &dir.join("truth.rd.zarr"));
        // What is left is the reconstruction of the dots' edges from three pixels a sample, which depends on where dots
        // lie on the pixels: 0.7 to 1.1 % over three seeds, worst on chessboards (0.9 % at 3.3 px a sample).
        assert!(found.rel_rmse < 0.0125, "{material:?} {found:?}");
        assert!(found.drift_rms_px < 0.05, "{material:?} {found:?}");
        assert_eq!(found.valid, 1.0);
        let rms = registration_rms(&dir, &report);
        assert!(rms[0] < 0.05 && rms[1] < 0.05, "{material:?} {rms:?}");
    }
}

#[test]
fn a_noisy_capture_gives_the_matrix_to_three_percent_and_its_variance_is_right() {
    for material in [SlabMaterial::homogeneous(), SlabMaterial::chessboard([4, 3])] {
        let options = SimulateOptions { material: material.clone(), grid: [7, 6], window: [33, 29], ..common::bench() };
        let (_folder, dir) = common::capture(&options);
        let (matrix, report) = build(&dir);
        let found = compare(&matrix, &dir.join("truth.rd.zarr"));
        assert!(found.rel_rmse < 0.03, "{material:?} {found:?}");
        // 95.4 % of a normal distribution; 120,000 entries leave sampling error far below the promised two points.
        assert!((0.93..0.97).contains(&found.coverage), "{material:?} {found:?}");
        assert!(found.drift_rms_px < 0.05, "{material:?} {found:?}");
        let rms = registration_rms(&dir, &report);
        assert!(rms[0] < 0.05 && rms[1] < 0.05, "{material:?} {rms:?}");
    }
}

/// Photon noise makes the slab's light rough between the samples, which the reconstruction cannot follow: 3 %, not 1 %
/// (20,000 photons).
#[test]
#[ignore = "slow: 6 s"]
fn a_capture_by_monte_carlo_gives_its_matrix() {
    let mc = SimulateOptions { transport: acquire::simulate::Transport::Mc, photons: 20_000, ..common::bench() };
    for material in ["homogeneous", "chessboard-4x4", "layered:skin1=0.4,ketchup=1"] {
        let options = SimulateOptions {
            material: material.parse().unwrap(),
            grid: [4, 3],
            window: [13, 9],
            noise_free: true,
            ..mc.clone()
        };
        let (_folder, dir) = common::capture(&options);
        let (matrix, _) = build(&dir);
        let found = compare(&matrix, &dir.join("truth.rd.zarr"));
        assert!(found.rel_rmse < 0.03 && found.valid == 1.0, "{material}: {found:?}");
    }
}

#[test]
fn the_blur_of_an_ordinary_lens_is_found_and_taken_out() {
    let options = SimulateOptions { psf_px: 0.5, window: [33, 29], grid: [5, 4], seed: 5, ..common::bench() };
    let (_folder, dir) = common::capture(&options);
    let (out, report) = build(&dir);
    let found = report.registration.point_spread.unwrap();
    // The board is seen with noise of a per cent or so in a few thousand pixels at edges.
    assert!((found.psf_px - 0.5).abs() < 0.01, "{found:?}");
    let comparison = common::compare(&out, &dir.join("truth.rd.zarr"));
    // Left in, this blur costs nine per cent; what is promised with noise is three.
    assert!(comparison.rel_rmse < 0.02, "{comparison:?}");
    assert!((0.93..=0.97).contains(&comparison.coverage), "{comparison:?}");
}

#[test]
fn the_noise_of_a_single_exposure_is_not_taken_for_a_halo() {
    let material = SlabMaterial::homogeneous();
    let lit_pitch_mm = Some([1.0, 1.2]);
    let options = SimulateOptions {
        material,
        grid: [9, 7],
        window: [33, 29],
        lit_pitch_mm,
        exposures: 1,
        seed: 3,
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let (matrix, report) = build(&dir);
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    // 0.6 % is found; with the halo of a fifth of the light that the frame's noise pretended, it was 17 %.
    assert!(found.rel_rmse < 0.01, "{found:?}");
    assert!(
        !report.warnings.iter().any(|w| matches!(w, Warning::Radiance(RadianceWarning::StrayLight { .. }))),
        "{:?}",
        report.warnings
    );
}

#[test]
fn a_lattice_of_many_dots_gives_the_matrix_to_one_percent() {
    let pitch_mm = SimulateOptions::default().pitch_mm;
    let options = SimulateOptions {
        grid: [13, 11],
        window: [15, 11],
        lit_pitch_mm: Some([3.0 * pitch_mm, 4.0 * pitch_mm]),
        noise_free: true,
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let (matrix, report) = build(&dir);
    // Eight and six lit points, 24 samples, apart: four dots in some shots.
    assert_eq!(report.shots.len(), 48);
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    assert_eq!(found.valid, 1.0);
    assert!(found.rel_rmse < 0.01, "{found:?}");
}

#[test]
#[ignore = "slow: 5 s"]
fn dots_nearer_than_their_windows_are_told_apart_and_warned_of() {
    let material = SlabMaterial::chessboard([4, 3]);
    let options = SimulateOptions {
        material,
        grid: [13, 11],
        window: [17, 13],
        spacing: Some([6, 5]),
        seed: 2,
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let (matrix, report) = build(&dir);
    assert_eq!(report.shots.len(), 30);
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    assert!(found.rel_rmse < 0.03, "{found:?}");
    let crosstalk = report.crosstalk.unwrap();
    assert!(crosstalk.removed_share > 0.3 && crosstalk.modelled_share > 0.1, "{crosstalk:?}");
    assert!(
        report.warnings.iter().any(|w| matches!(w, Warning::Response(ResponseWarning::CrossTalk { .. }))),
        "{:?}",
        report.warnings
    );
    let keep = BuildOptions { keep_crosstalk: true, ..BuildOptions::default() };
    build_matrix(&dir, &keep, &matrix, &Progress::silent()).unwrap();
    // The neighbours' peaks are in the window's corners.
    assert!(compare(&matrix, &dir.join("truth.rd.zarr")).rel_rmse > 0.5);
}

#[test]
#[ignore = "slow: 20 s"]
fn the_veins_of_marble_are_not_put_to_dots_that_are_far_away() {
    let options = SimulateOptions {
        material: SlabMaterial::marble(),
        grid: [14, 11],
        window: [17, 13],
        lit_pitch_mm: Some([1.5; 2]),
        seed: 2,
        ..SimulateOptions::default()
    };
    let (_folder, dir) = common::capture(&options);
    let (out, _) = build(&dir);
    let found = compare(&out, &dir.join("truth.rd.zarr"));
    println!("{found:?}");
    // 0.286 % and 93.4 %, as with the neighbours' light left in (0.285 %): there is less than 0.01 % of it. With tails
    // of any length 0.46 % and 84 %.
    assert!(found.rel_rmse < 0.0035 && found.coverage > 0.9, "{found:?}");
}

#[test]
fn photographs_in_eight_bit_jpeg_give_a_matrix_too() {
    let options = SimulateOptions {
        grid: [5, 4],
        window: [13, 9],
        format: acquire::simulate::FileFormat::Jpeg,
        ..common::bench()
    };
    let (_folder, dir) = common::capture(&options);
    let (matrix, _) = build(&dir);
    let found = compare(&matrix, &dir.join("truth.rd.zarr"));
    // Eight bits and JPEG's quantization of blocks: each cell averages ten pixels of about 1 % error.
    assert!(found.rel_rmse < 0.05, "{found:?}");
}

#[test]
fn one_thread_and_two_give_the_same_matrix() {
    let options = SimulateOptions { grid: [5, 4], window: [9, 7], ..common::bench() };
    let (folder, dir) = common::capture(&options);
    let matrices = ["1", "2"].map(|threads| {
        let out = folder.path().join(format!("{threads}.rd.zarr"));
        let (status, _, stderr) = common::acquire(&[
            "build-matrix",
            dir.to_str().unwrap(),
            "--out",
            out.to_str().unwrap(),
            "--threads",
            threads,
        ]);
        assert_eq!(status, 0, "{stderr}");
        MatrixReader::open(&out).unwrap().read(0..16).unwrap()
    });
    assert!(matrices[0] == matrices[1]);
}

#[test]
fn grid_points_that_no_shot_lights_are_invalid_and_reported() {
    let options = SimulateOptions { grid: [4, 3], window: [7, 5], exposures: 2, ..common::bench() };
    let (_folder, dir) = common::capture(&options);
    let mut manifest = acquire::capture::Manifest::read(&dir).unwrap();
    let last = manifest.shots.pop().unwrap();
    manifest.write(&dir).unwrap();
    let (matrix, report) = build(&dir);
    let acquire::capture::Pattern::Lattice { dots } = &last.pattern else { panic!("the last shot is no lattice") };
    let unlit = report.warnings.iter().find(|w| matches!(w, Warning::Response(ResponseWarning::UnlitPoints { .. })));
    assert_eq!(unlit, Some(&ResponseWarning::UnlitPoints { rows: dots.len() }.into()));
    let reader = MatrixReader::open(&matrix).unwrap();
    let row = manifest.grid.row_index(dots[0]);
    assert!(reader.read(row..row + 1).unwrap().valid.iter().all(|&v| v == 0));
}

#[test]
fn an_exposure_in_the_manifest_overrides_exif_and_the_difference_is_told() {
    let options = SimulateOptions { grid: [2, 3], window: [7, 5], exposures: 2, ..common::bench() };
    let (_folder, dir) = common::capture(&options);
    let mut manifest = acquire::capture::Manifest::read(&dir).unwrap();
    let (before, _) = build(&dir);
    let read = |m: &Path| MatrixReader::open(m).unwrap().read(0..4).unwrap().response;
    let response = read(&before);
    // All lattice exposures said to be twice as long: half the radiance.
    let exif = acquire::capture::Capture::open(&dir, None).unwrap().brackets;
    for (shot, bracket) in manifest.shots.iter_mut().zip(exif) {
        for entry in &mut shot.photographs {
            let photograph = bracket.iter().find(|p| p.path.ends_with(&entry.file)).unwrap();
            let lattice = matches!(
                shot.pattern,
                acquire::capture::Pattern::Lattice { .. } | acquire::capture::Pattern::SampleBlack
            );
            entry.exposure_secs = lattice.then_some(2.0 * photograph.exposure_secs);
        }
    }
    manifest.write(&dir).unwrap();
    let (after, report) = build(&dir);
    assert!(report.warnings.iter().any(|w| matches!(w, Warning::Capture(CaptureWarning::ExposureDisagrees { .. }))));
    let peak = |v: &[f32]| v.iter().copied().fold(0.0f32, f32::max);
    // The same photographs; only f32 rounding and the weights' noise floor differ.
    assert!((peak(&read(&after)) / peak(&response) - 0.5).abs() < 1e-3);
}

#[test]
fn the_committed_capture_gives_its_matrix() {
    let folder = tempfile::tempdir().unwrap();
    let captures = Path::new(env!("CARGO_MANIFEST_DIR")).join("captures");
    let out = folder.path().join("matrix.rd.zarr");
    let (status, _, stderr) =
        common::acquire(&["build-matrix", captures.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(status, 0, "{stderr}");
    // Eight-bit JPEG, as above.
    assert!(compare(&out, &captures.join("truth.rd.zarr")).rel_rmse < 0.03);
}
