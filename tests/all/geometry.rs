//! Where things are: boards, frames, stripes and drift of simulated captures against their truth.

use crate::common;
use crate::common::compare;
use acquire::capture::{Manifest, Pattern, Rig, Surface};
use acquire::geometry::{CameraView, Homography, Lens, Point, SlabFromProjector};
use acquire::pipeline::{BuildOptions, BuildReport, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{Cause, SimulateOptions, SlabMaterial};
use acquire::{Error, RegistrationWarning, Result, Warning};
use std::path::Path;

fn try_build(dir: &Path) -> Result<BuildReport> {
    build_matrix(dir, &BuildOptions::default(), &dir.with_extension("rd.zarr"), &Progress::silent())
}

fn build(dir: &Path) -> BuildReport {
    try_build(dir).unwrap()
}

#[derive(serde::Deserialize)]
struct Truth {
    camera_from_slab: CameraView,
    slab_from_projector: Homography,
    projector_lens: Option<Lens>,
    shots: Vec<ShotTruth>,
}

#[derive(serde::Deserialize)]
struct ShotTruth {
    camera_drift_px: Point,
}

fn truth(dir: &Path) -> Truth {
    toml::from_str(&std::fs::read_to_string(dir.join("truth.toml")).unwrap()).unwrap()
}

/// RMS per axis over the slab of where camera and projector are believed to be, camera px and projector px.
fn registration_rms(dir: &Path, report: &BuildReport) -> [f64; 2] {
    let (truth, found) = (truth(dir), &report.registration);
    let lens = truth.projector_lens.unwrap_or(Lens::ideal([0.0; 2], 1.0));
    let projector = SlabFromProjector::new(truth.slab_from_projector.inverse().unwrap(), lens).unwrap();
    let mut sums = [0.0; 2];
    for k in 0..100 {
        let p =
            [0, 1].map(|a| 2.0 * found.center_mm[a] * (f64::from(if a == 0 { k % 10 } else { k / 10 }) + 0.5) / 10.0);
        let (a, b) = (truth.camera_from_slab.camera_from_slab(p), found.view.camera_from_slab(p));
        let (c, d) = (projector.projector_from_slab(p), found.slab_from_projector.projector_from_slab(p));
        for i in 0..2 {
            sums[0] += (a[i] - b[i]).powi(2) / 200.0;
            sums[1] += (c[i] - d[i]).powi(2) / 200.0;
        }
    }
    sums.map(f64::sqrt)
}

fn small() -> SimulateOptions {
    // A picture of some 160 px in which squares of the board have 11, with twelve lattice shots.
    SimulateOptions {
        material: SlabMaterial::chessboard([4, 3]),
        grid: [4, 3],
        lit_pitch_mm: Some([3.0, 2.5]),
        step_projector_px: [24, 20],
        window: [23, 19],
        exposures: 2,
        seed: 3,
        ..common::bench()
    }
}

/// Twelve shots of ten dots on a chessboard whose fields are about a shot's spacing: every dot lies near an edge.
fn dense() -> SimulateOptions {
    SimulateOptions {
        grid: [12, 10],
        window: [13, 9],
        lit_pitch_mm: Some([1.5, 2.0]),
        step_projector_px: [4, 5],
        spacing: Some([4, 3]),
        exposures: 3,
        seed: 3,
        ..small()
    }
}

fn without_reference_dots(dir: &Path, change: impl Fn(&mut Manifest)) {
    let mut manifest = Manifest::read(dir).unwrap();
    manifest.reference_dots = None;
    change(&mut manifest);
    manifest.write(dir).unwrap();
}

fn registered_to_hundredths_of_a_pixel(name: &str, options: &SimulateOptions) {
    let (_folder, dir) = common::capture(options);
    let rms = registration_rms(&dir, &build(&dir));
    // What the project asks for: 0.02 px of the camera, 0.05 of the projector.
    assert!(rms[0] < 0.02 && rms[1] < 0.05, "{name}: {rms:?}");
}

#[test]
fn camera_and_projector_are_registered_to_hundredths_of_a_pixel() {
    registered_to_hundredths_of_a_pixel("board and frame", &SimulateOptions { frame_marks: true, ..small() });
    let frame = SimulateOptions { frame_marks: true, without_board: true, gray_on_frame: true, ..small() };
    registered_to_hundredths_of_a_pixel("frame, stripes on it", &frame);
}

#[test]
#[ignore = "slow: half a minute of processor time, most of it for simulated point spreads"]
fn camera_and_projector_are_registered_to_hundredths_of_a_pixel_through_real_lenses() {
    let frame = SimulateOptions { frame_marks: true, without_board: true, ..small() };
    let cases = [
        ("board, psf of half a pixel", SimulateOptions { psf_px: 0.5, ..small() }),
        ("frame alone, psf of half a pixel", SimulateOptions { psf_px: 0.5, ..frame.clone() }),
        ("projector with a lens", SimulateOptions { projector_distortion: -0.01, ..small() }),
        (
            "projector with a lens, stripes on the frame",
            SimulateOptions { gray_on_frame: true, projector_distortion: -0.01, ..frame },
        ),
    ];
    cases.iter().for_each(|(name, options)| registered_to_hundredths_of_a_pixel(name, options));
}

#[test]
fn a_projectors_lens_is_modelled_where_the_stripes_ask_for_it_and_only_there() {
    for (k1, asked) in [(0.0, false), (-0.02, true)] {
        // Marks: a chessboard of small squares leaves the camera a bend of its own, which the projector would take up.
        let options = SimulateOptions { projector_distortion: k1, frame_marks: true, without_board: true, ..small() };
        let (_folder, dir) = common::capture(&options);
        let found = build(&dir).registration;
        assert_eq!(found.slab_from_projector.lens().is_ideal(), !asked, "{k1}: {found:?}");
        // The gain that decided is told.
        assert_eq!(found.projector_ideal_rms_px > 1.5 * found.projector_rms_px, asked, "{k1}: {found:?}");
    }
}

#[test]
#[ignore = "slow: 3 s"]
fn the_cameras_lens_is_chosen_by_what_the_views_show_and_the_choice_is_kept() {
    for (distortion, terms) in [(0.0, 0..=0), (-0.15, 1..=2)] {
        let (_folder, dir) = common::capture(&SimulateOptions { calibration_boards: 3, distortion, ..small() });
        let report = build(&dir);
        let lens = &report.registration.lens;
        assert!(terms.contains(&lens.radial_terms), "{distortion}: {lens:?}");
        // None, one, two radial terms, two and the centre: each was tried and says how well it did.
        assert!(lens.views == 4 && lens.trials.len() == 4, "{lens:?}");
        assert!(registration_rms(&dir, &report)[0] < 0.02, "{lens:?}");
    }
}

#[test]
fn drift_with_reference_dots_follows_walk_and_jumps() {
    let mut options = SimulateOptions { material: SlabMaterial::homogeneous(), ..dense() };
    options.with(&[Cause::Jumps]);
    let (_folder, dir) = common::capture(&options);
    let report = build(&dir);
    let found = compare(&dir.with_extension("rd.zarr"), &dir.join("truth.rd.zarr"));
    assert!(found.drift_rms_px < 0.03, "{found:?}");
    let jumps = report.warnings.iter().find_map(|w| {
        if let Warning::Registration(RegistrationWarning::DriftJumps { jumps }) = w { Some(jumps) } else { None }
    });
    // Three jumps of 1.5 px, which steps of the walk (0.16 px) lengthen or shorten.
    let jumps = jumps.expect("jumps are told");
    assert!(jumps.len() == 3 && jumps.iter().all(|j| (j.length_px - 1.5).abs() < 0.4), "{jumps:?}");
}

fn drift_without_reference_dots(causes: &[Cause]) {
    let mut options = dense();
    options.with(causes);
    let (_folder, dir) = common::capture(&options);
    without_reference_dots(&dir, |_| ());
    let report = build(&dir);
    let found = compare(&dir.with_extension("rd.zarr"), &dir.join("truth.rd.zarr"));
    // Centroids, which the glow pulls, are off by 0.11 px here.
    assert!(found.drift_rms_px < 0.03, "{causes:?}: {found:?}");
    let told = |w: &Warning| matches!(w, Warning::Registration(RegistrationWarning::DriftFromLatticeDots { .. }));
    assert!(report.warnings.iter().any(told));
    let jumped =
        report.warnings.iter().any(|w| matches!(w, Warning::Registration(RegistrationWarning::DriftJumps { .. })));
    assert_eq!(jumped, !causes.is_empty(), "{:?}", report.warnings);
}

#[test]
#[ignore = "slow: 5 s"]
fn drift_without_reference_dots_is_not_pulled_by_edges_or_by_depth() {
    drift_without_reference_dots(&[]);
}

#[test]
#[ignore = "slow: a quarter of a minute of processor time for the simulated point spread"]
fn drift_without_reference_dots_follows_jumps_through_a_real_lens() {
    drift_without_reference_dots(&[Cause::Jumps, Cause::Psf]);
}

#[test]
fn a_pattern_that_may_be_its_neighbours_is_refused_by_the_shots_name() {
    let options = SimulateOptions {
        grid: [10, 8],
        lit_pitch_mm: None,
        step_projector_px: [4, 5],
        window: [9, 7],
        spacing: Some([3, 2]),
        drift_px: 0.1,
        ..small()
    };
    let (_folder, dir) = common::capture(&options);
    let origin = Manifest::read(&dir).unwrap().grid.origin_projector_px;
    // Dots are 4 px of the projector apart, those of a shot 12: half their distance, and all of it.
    for moved in [6.0, 12.0] {
        without_reference_dots(&dir, |m| m.grid.origin_projector_px[0] = origin[0] - moved);
        let error = try_build(&dir).unwrap_err();
        let Error::Registration { shot, reason, .. } = &error else { panic!("{moved}: {error}") };
        assert!(shot.starts_with("lattice-") && reason.contains("without reference dots"), "{moved}: {error}");
    }
    without_reference_dots(&dir, |m| m.grid.origin_projector_px = origin);
    build(&dir);
}

#[test]
fn a_camera_that_moves_is_told_and_followed_and_one_that_stands_is_not_suspected() {
    for (moves, limit_px) in [(false, 0.02), (true, 0.1)] {
        let mut options = SimulateOptions {
            material: SlabMaterial::homogeneous(),
            grid: [9, 7],
            lit_pitch_mm: None,
            step_projector_px: [4, 5],
            exposures: 5,
            ..small()
        };
        if moves {
            options.with(&[Cause::CameraJumps]);
        }
        let (_folder, dir) = common::capture(&options);
        let report = build(&dir);
        let told =
            report.warnings.iter().any(|w| matches!(w, Warning::Registration(RegistrationWarning::CameraMoved { .. })));
        assert_eq!(told, moves, "{:?}", report.warnings);
        let found = compare(&dir.with_extension("rd.zarr"), &dir.join("truth.rd.zarr"));
        // Uncorrected, the camera's jumps of 1 px leave 0.47 px per axis in the drift, and coverage at 69 %.
        assert!(found.drift_rms_px < limit_px && found.coverage > 0.9, "{moves}: {found:?}");
    }
}

#[test]
fn the_glow_of_dots_near_the_rim_is_no_movement_of_the_camera() {
    // A sample of 10 mm, whose rim every dot lights.
    let (_folder, dir) =
        common::capture(&SimulateOptions { grid: [7, 5], window: [17, 13], seed: 3, ..common::bench() });
    let report = build(&dir);
    let told =
        report.warnings.iter().any(|w| matches!(w, Warning::Registration(RegistrationWarning::CameraMoved { .. })));
    assert!(!told, "{:?}", report.warnings);
    let found = compare(&dir.with_extension("rd.zarr"), &dir.join("truth.rd.zarr"));
    // Glow that is followed leaves 0.075 px; without, it is 0.004 px.
    assert!(found.drift_rms_px < 0.02, "{found:?}");
}

#[test]
fn a_frame_that_is_seen_elsewhere_at_the_end_is_told_with_the_figure() {
    for moves in [false, true] {
        let mut options = SimulateOptions { frame_marks: true, ..small() };
        if moves {
            options.with(&[Cause::CameraJumps]);
        }
        let (_folder, dir) = common::capture(&options);
        let report = build(&dir);
        let moved = report.warnings.iter().find_map(|w| match w {
            Warning::Registration(RegistrationWarning::FrameMoved { moved_px, .. }) => Some(*moved_px),
            _ => None,
        });
        let last = truth(&dir).shots.last().unwrap().camera_drift_px;
        match moved {
            // Discs are found to some hundredths of a pixel.
            Some(m) => assert!(moves && (m[0] - last[0]).hypot(m[1] - last[1]) < 0.03, "{m:?} {last:?}"),
            None => assert!(!moves, "{:?}", report.warnings),
        }
    }
}

#[test]
fn a_capture_that_lacks_what_its_shots_need_is_refused_before_any_work() {
    let (_folder, dir) = common::capture(&SimulateOptions { frame_marks: true, grid: [2, 3], ..small() });
    let rig_path = dir.join("calibration");
    let rig = Rig::read(&rig_path.join("rig.toml")).unwrap();
    Rig { frame: None, ..rig.clone() }.write(&rig_path).unwrap();
    let error = try_build(&dir).unwrap_err().to_string();
    assert!(error.contains("kind = \"frame\"") && error.contains("[frame] in rig.toml"), "{error}");
    Rig { board: None, ..rig.clone() }.write(&rig_path).unwrap();
    let error = try_build(&dir).unwrap_err().to_string();
    assert!(error.contains("kind = \"board\"") && error.contains("[board] in rig.toml"), "{error}");
    rig.write(&rig_path).unwrap();

    let mut manifest = Manifest::read(&dir).unwrap();
    let stripes = manifest.shots.iter_mut().rfind(|s| matches!(s.pattern, Pattern::GrayCode { .. })).unwrap();
    if let Pattern::GrayCode { on, .. } = &mut stripes.pattern {
        *on = Surface::Frame;
    }
    let name = stripes.name.clone();
    manifest.write(&dir).unwrap();
    let error = try_build(&dir).unwrap_err().to_string();
    assert!(error.contains(&name) && error.contains("one for the whole Gray code"), "{error}");
}

#[test]
fn a_frame_without_its_marks_is_refused_by_the_shots_name() {
    let (_folder, dir) = common::capture(&SimulateOptions { frame_marks: true, grid: [2, 3], ..small() });
    let rig_path = dir.join("calibration");
    let mut rig = Rig::read(&rig_path.join("rig.toml")).unwrap();
    // Marks where there are none.
    let marks = rig.frame.iter_mut().flat_map(|f| &mut f.marks_mm);
    marks.enumerate().for_each(|(k, m)| m[1] += if k % 2 == 0 { 2.0 } else { -2.0 });
    rig.write(&rig_path).unwrap();
    let error = try_build(&dir).unwrap_err();
    assert!(
        matches!(&error, Error::Registration { shot, reason, .. } if shot == "frame" && reason.contains("marks")),
        "{error}"
    );
}
