//! `acquire patterns`: pictures that light every point once, and that a simulated bench would have shown.

use crate::common;
use crate::common::acquire;
use acquire::capture::{Axis, Capture, Pattern, Rig};
use acquire::geometry::Point;
use acquire::patterns::{
    PatternsOptions, Plan, Probe, ProjectorPicture, SpacingOptions, choose_spacing, lattice_shots, plan,
};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, Truth};
use acquire::transport::MatrixReader;
use std::path::{Path, PathBuf};

/// A simulated capture of nine lattice shots with its truth.
fn simulated() -> (tempfile::TempDir, PathBuf, Truth) {
    let options = SimulateOptions {
        grid: [7, 5],
        // A plan has one pitch for both axes.
        lit_pitch_mm: Some([0.5; 2]),
        step_projector_px: [4, 4],
        window: [5, 5],
        spacing: Some([3, 3]),
        exposures: 2,
        drift_px: 0.0,
        ..SimulateOptions::default()
    };
    let (folder, dir) = common::capture(&options);
    let truth = toml::from_str(&std::fs::read_to_string(dir.join("truth.toml")).unwrap()).unwrap();
    (folder, dir, truth)
}

fn dots(pattern: &Pattern) -> &[[usize; 2]] {
    match pattern {
        Pattern::Lattice { dots } => dots,
        _ => &[],
    }
}

#[test]
fn the_written_pictures_light_every_point_once_inside_the_projector_and_apart() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("plan");
    let rig = Rig::read(Path::new("calibration/rig.toml")).unwrap();
    let [width, height] = rig.projector.size_px;
    let arguments = "patterns --rig calibration --slab-mm 12x11 --projector-px-per-mm 8 --lit-pitch-mm 0.7 --window 9 --spacing-mm 2.5 --out";
    let arguments: Vec<&str> = arguments.split(' ').chain([out.to_str().unwrap()]).collect();
    let (status, stdout, stderr) = acquire(&arguments);
    assert_eq!((status, stdout.as_str()), (0, ""), "{stderr}");
    let plan = Plan::read(&out).unwrap();
    let side = plan.grid.dot_projector_px;
    let references = &plan.reference_dots.as_ref().unwrap().projector_px;
    let mut lit = vec![0; plan.grid.len()];
    let mut names = Vec::new();
    for shot in &plan.shots {
        let name = shot.picture.clone().unwrap();
        let picture = image::open(out.join(&name)).unwrap().into_luma8();
        names.push(name);
        assert_eq!([picture.width() as usize, picture.height() as usize], [width, height]);
        let white = picture.pixels().filter(|p| p.0[0] == 255).count();
        assert_eq!(white + picture.pixels().filter(|p| p.0[0] == 0).count(), width * height, "black and white only");
        match &shot.pattern {
            Pattern::Board | Pattern::CalibrationBoard | Pattern::Frame | Pattern::ReferenceWhite => {
                assert_eq!(white, width * height);
            }
            Pattern::ReferenceBlack | Pattern::SampleBlack | Pattern::Dark => assert_eq!(white, 0),
            Pattern::GrayCode { .. } => assert!(white > 0 && white < width * height),
            Pattern::Lattice { dots } => {
                // So many white pixels in whole dots: none is cut off, none lies on another.
                assert_eq!(white, (dots.len() + references.len()) * side * side, "{}", shot.name);
                let places: Vec<Point> = dots.iter().map(|&d| plan.grid.dot_projector_px(d)).collect();
                for at in places.iter().chain(references) {
                    let first = at.map(|v| v - (side as f64 - 1.0) / 2.0);
                    assert!(first.iter().all(|v| v.fract() == 0.0), "on whole pixels");
                    for k in 0..side * side {
                        let (x, y) = (first[0] as u32 + (k % side) as u32, first[1] as u32 + (k / side) as u32);
                        assert_eq!(picture.get_pixel(x, y).0, [255]);
                    }
                }
                for (k, a) in places.iter().enumerate() {
                    // 2.5 mm at 8 px a mm, along one of the axes.
                    assert!(places[..k].iter().all(|b| (a[0] - b[0]).abs().max((a[1] - b[1]).abs()) >= 20.0));
                }
                dots.iter().for_each(|&d| lit[plan.grid.row_index(d)] += 1);
            }
        }
    }
    assert!(lit.len() > 50 && lit.iter().all(|&n| n == 1), "{lit:?}");
    let mut sorted = names.clone();
    sorted.sort();
    assert_eq!(names, sorted, "the order of names is that of shooting");
    let page = std::fs::read_to_string(out.join("how-to-shoot.txt")).unwrap();
    assert!(page.contains(&format!("{} photographs", plan.photographs())), "{page}");
}

#[test]
fn shots_are_those_of_a_simulated_capture() {
    let (_folder, dir, _) = simulated();
    let capture = Capture::open(&dir, None).unwrap();
    let m = &capture.manifest;
    let options = PatternsOptions {
        slab_mm: Some(m.slab.size_mm),
        projector_px_per_mm: Some(8.0),
        grid: Some([7, 5]),
        window: Some(5),
        spacing_mm: Some(1.5),
        frame_mm: 1.0,
        // Seven points 0.5 mm apart, as simulated.
        margin_mm: Some((m.slab.size_mm[0] - 3.4) / 2.0),
        ..PatternsOptions::default()
    };
    let planned = plan(&options, &capture.rig, None).unwrap().plan;
    let codes = |patterns: Vec<Pattern>| {
        let mut codes: Vec<_> = patterns
            .into_iter()
            .filter_map(|p| match p {
                Pattern::GrayCode { axis, bit, inverse, .. } => Some((axis == Axis::Y, bit, inverse)),
                _ => None,
            })
            .collect();
        codes.sort();
        codes
    };
    let (a, b) = (m.shots.iter().map(|s| s.pattern.clone()), planned.shots.iter().map(|s| s.pattern.clone()));
    assert_eq!(codes(a.collect()), codes(b.collect()));
    let sweep = |shots: Vec<&Pattern>| {
        shots.into_iter().map(dots).filter(|d| !d.is_empty()).map(<[_]>::to_vec).collect::<Vec<_>>()
    };
    let simulated = sweep(m.shots.iter().map(|s| &s.pattern).collect());
    assert_eq!(simulated, sweep(planned.shots.iter().map(|s| &s.pattern).collect()));
    assert_eq!(simulated, lattice_shots([7, 5], [3, 3]));
}

/// The pictures of a simulated capture's own plan, seen by the camera that truth.toml describes, against its
/// photographs.
#[test]
fn pictures_show_what_the_simulated_photographs_show() {
    let (_folder, dir, truth) = simulated();
    let capture = Capture::open(&dir, None).unwrap();
    let plan = Plan::of_capture(&capture);
    let size_px = capture.rig.projector.size_px;
    let photograph = |shot: usize| {
        let path = &capture.brackets[shot].last().unwrap().path;
        image::open(path).unwrap().into_rgb16()
    };
    let projector_from_slab = truth.slab_from_projector.inverse().unwrap();
    let white = photograph(capture.shots(|p| matches!(p, Pattern::ReferenceWhite))[0]);
    let black = capture.rig.noise.as_ref().unwrap().black_dn as i32;
    let (mut told, mut wrong) = (0usize, 0usize);
    for (shot, planned) in plan.shots.iter().enumerate() {
        let picture = ProjectorPicture::of(&plan, &planned.pattern, size_px);
        let at = |p: Point| {
            let q = p.map(|v| v.round() as usize);
            picture.pixels[q[1] * size_px[0] + q[0]]
        };
        match &planned.pattern {
            Pattern::GrayCode { .. } => {
                let seen = photograph(shot);
                for (x, y, pixel) in seen.enumerate_pixels().step_by(7) {
                    let p = truth.camera_from_slab.slab_from_camera([f64::from(x), f64::from(y)]).unwrap();
                    let q = projector_from_slab.map(p);
                    let inside = (0..2).all(|a| q[a] > 3.0 && q[a] < size_px[a] as f64 - 4.0);
                    let reference = white.get_pixel(x, y).0[1];
                    // Where stripes are even over two pixels around, a camera pixel cannot reach an edge.
                    let even = inside
                        && [-2.0, 2.0].iter().all(|d| at([q[0] + d, q[1]]) == at(q) && at([q[0], q[1] + d]) == at(q));
                    if even && reference > 2000 {
                        told += 1;
                        // Signed: noise goes below the black level.
                        let light = |code: u16| i32::from(code) - black;
                        wrong += usize::from((2 * light(pixel.0[1]) > light(reference)) != (at(q) == 255));
                    }
                }
            }
            Pattern::Lattice { dots } => {
                let seen = photograph(shot);
                for &dot in dots {
                    let q = plan.grid.dot_projector_px(dot);
                    let at = truth.camera_from_slab.camera_from_slab(truth.slab_from_projector.map(q));
                    let light = |dx: f64, dy: f64| {
                        seen.get_pixel((at[0] + dx).round() as u32, (at[1] + dy).round() as u32).0[1]
                    };
                    // The lit place is brighter than all places a sample away.
                    assert!(
                        [(3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0)]
                            .iter()
                            .all(|d| light(0.0, 0.0) > light(d.0, d.1)),
                        "{dot:?}"
                    );
                }
            }
            _ => {}
        }
    }
    assert!(told > 5000 && wrong == 0, "{wrong} of {told}");
}

#[test]
fn settings_that_make_no_patterns_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("plan");
    for (arguments, words) in [
        ("--projector-px-per-mm 8", "--slab-mm"),
        ("--slab-mm 12", "--projector-px-per-mm"),
        ("--slab-mm 12 --projector-px-per-mm 80", "256 × 240 px"),
        ("--slab-mm 12 --projector-px-per-mm 8 --grid 200", "--grid"),
        ("--slab-mm 12 --projector-px-per-mm 8 --window 30", "--window"),
        ("--slab-mm 12 --projector-px-per-mm 8 --margin-mm 7", "--margin-mm"),
        ("--slab-mm 12 --projector-px-per-mm 8 --shortest-secs 1/0", "--shortest-secs"),
        ("--slab-mm 12 --projector-px-per-mm nan", "--projector-px-per-mm"),
        ("--slab-mm 12 --projector-px-per-mm 8 --dot-px 0", "--dot-px"),
        ("--slab-mm 12 --projector-px-per-mm 8 --probe nowhere", "nowhere"),
    ] {
        let command = format!("patterns --rig calibration --out {} {arguments}", out.display());
        let (status, _, stderr) = acquire(&command.split(' ').collect::<Vec<_>>());
        assert_eq!(status, 1, "{arguments}: {stderr}");
        assert!(stderr.contains(words), "{arguments}: {stderr}");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "{arguments} left something");
    }
}

/// A quick capture of six single dots on a material whose light dies within a few samples.
fn probe() -> (tempfile::TempDir, Probe, Rig) {
    let options = SimulateOptions {
        material: "nearly-opaque".parse().unwrap(),
        grid: [2, 3],
        lit_pitch_mm: Some([4.0, 3.5]),
        step_projector_px: [32, 28],
        spacing: Some([2, 3]),
        window: [27, 23],
        ..SimulateOptions::default()
    };
    let (folder, dir) = common::capture(&options);
    let probe = Probe::read(&dir, &BuildOptions::default(), &Progress::silent()).unwrap();
    let rig = Rig::read(&dir.join("calibration/rig.toml")).unwrap();
    (folder, probe, rig)
}

#[test]
fn a_probe_asks_for_few_photographs_and_for_exposures_that_fit() {
    let (_folder, probe, rig) = probe();
    let written = plan(&PatternsOptions { frame_mm: 2.0, ..PatternsOptions::default() }, &rig, Some(&probe)).unwrap();
    let (choice, without) = (written.choice.unwrap(), written.without_probe.unwrap());
    assert!(written.plan.grid.len() > without.grid.len() && choice.window < 15, "{choice:?}");
    assert!(written.plan.photographs() < without.photographs() / 4, "{choice:?}");
    assert!(choice.spacing.cross_talk <= 0.1 || choice.spacing.below_noise, "{choice:?}");
    // The simulator sets its sensitivity so that the brightest dot reaches 0.7 of the range in 1/256 s; the plan goes
    // to the third of a stop below.
    let shortest = choice.shortest_secs.unwrap() * 256.0;
    assert!((0.75..1.05).contains(&shortest), "{choice:?}");
    // Where the probe's dots lie on the slab the plan's do too.
    let back = probe.registration.slab_from_projector;
    let size = written.plan.slab.size_mm;
    for shot in &written.plan.shots {
        for &dot in dots(&shot.pattern) {
            let p = back.map(written.plan.grid.dot_projector_px(dot));
            assert!((0..2).all(|a| p[a] > 0.0 && p[a] < size[a]), "{dot:?} {p:?}");
        }
    }
}

#[test]
#[ignore = "slow: 5 s"]
fn what_the_probe_says_of_cross_talk_is_what_a_capture_with_that_spacing_has() {
    let (_folder, probe, _) = probe();
    let options = SpacingOptions { window: 7, lit_pitch_mm: 0.5, most_cross_talk: 0.03 };
    let choice = choose_spacing(&probe.tails, &options).unwrap();
    let spacing = (choice.spacing_mm / 0.5).round() as usize;
    assert!((2..=5).contains(&spacing), "{choice:?}");
    // The middle row's light with all its neighbours, and alone: whatever else the pipeline does to it cancels.
    let light = |spacing: usize| {
        let options = SimulateOptions {
            material: "nearly-opaque".parse().unwrap(),
            grid: [15, 13],
            window: [7, 7],
            lit_pitch_mm: Some([0.5; 2]),
            spacing: Some([spacing; 2]),
            noise_free: true,
            drift_px: 0.0,
            ..SimulateOptions::default()
        };
        let (folder, dir) = common::capture(&options);
        let out = folder.path().join("m.rd.zarr");
        let keep = BuildOptions { keep_crosstalk: true, ..BuildOptions::default() };
        build_matrix(&dir, &keep, &out, &Progress::silent()).unwrap();
        let matrix = MatrixReader::open(&out).unwrap();
        let row = matrix.read(6 * 15 + 7..6 * 15 + 8).unwrap();
        [0, 1, 2].map(|c| row.response.iter().skip(c).step_by(3).map(|&r| f64::from(r)).sum::<f64>())
    };
    let (near, alone) = (light(spacing), light(15));
    let worst = (0..3).map(|c| near[c] / alone[c] - 1.0).fold(0.0, f64::max);
    // Tails enter as means over rings of whole samples, and as the largest of four noisy rows: a quarter of so small a
    // share.
    assert!((worst / choice.cross_talk - 1.0).abs() < 0.25, "{worst} {choice:?}");
}
