//! What a capture folder says of its photographs.

use super::*;

fn exif(iso: Option<f64>, f_number: Option<f64>) -> ExifExposure {
    ExifExposure { iso, f_number, ..ExifExposure::default() }
}

#[test]
fn light_goes_with_the_iso_speed_and_with_the_inverse_square_of_the_f_number() {
    let first = exif(Some(100.0), Some(4.0));
    let factor = |iso, f_number| relative_sensitivity(&exif(iso, f_number), &first);
    assert_eq!(factor(Some(100.0), Some(4.0)), 1.0);
    assert_eq!(factor(Some(400.0), Some(4.0)), 4.0);
    // Two stops opener is four times the light, one stop closed nearly half.
    assert_eq!(factor(Some(100.0), Some(2.0)), 4.0);
    assert!((factor(Some(100.0), Some(5.6)) - 16.0 / 31.36).abs() < 1e-15);
    assert!((factor(Some(320.0), Some(5.0)) - 3.2 * 0.64).abs() < 1e-15);
    // A figure that one of the two lacks counts as equal.
    assert_eq!((factor(None, Some(8.0)), factor(Some(50.0), None), factor(None, None)), (0.25, 0.5, 1.0));
    assert_eq!(relative_sensitivity(&first, &exif(None, None)), 1.0);
}

fn head(name: &str, effective_secs: f64) -> Head {
    let photograph = Photograph { effective_secs, ..Photograph::new(name, "s", 2.0) };
    Head { name: name.into(), photograph, bits: 16, exif: ExifExposure::default(), settings: None }
}

#[test]
fn brackets_are_sorted_by_the_light_they_gather_and_have_none_twice() {
    let sorted = |secs: &[f64]| {
        let heads = secs.iter().enumerate().map(|(k, &s)| head(&format!("{k}.png"), s)).collect();
        sorted_bracket(heads, Path::new("capture.toml"))
    };
    let found: Vec<f64> = sorted(&[0.5, 0.01, 8.0, 0.0101]).unwrap().iter().map(|p| p.effective_secs).collect();
    assert_eq!(found, [0.01, 0.0101, 0.5, 8.0]);
    match sorted(&[0.5, 8.0, 0.503]) {
        Err(Error::SameExposure { first, second, shot, .. }) => {
            assert_eq!((first.as_str(), second.as_str(), shot.as_str()), ("0.png", "2.png", "s"));
        }
        other => panic!("{other:?}"),
    }
    // The names are in order whatever that of the times.
    match sorted(&[0.503, 8.0, 0.5]) {
        Err(Error::SameExposure { first, second, .. }) => assert_eq!((&*first, &*second), ("0.png", "2.png")),
        other => panic!("{other:?}"),
    }
    assert_eq!(sorted(&[]).unwrap().len(), 0);
}

#[test]
fn photographs_of_eight_bits_among_more_are_told_and_more_among_eight_too() {
    let of = |bits: &[u8]| {
        let heads: Vec<Head> = bits.iter().map(|&bits| Head { bits, ..head("a.png", 1.0) }).collect();
        depth_differs(heads.iter()).map(|w| match w {
            CaptureWarning::DepthDiffers { bits, most_bits, photographs, .. } => (bits, most_bits, photographs),
            other => panic!("{other}"),
        })
    };
    assert_eq!(of(&[16, 8, 16, 16, 8]), Some((8, 16, 2)));
    assert_eq!(of(&[8, 8, 16]), Some((16, 8, 1)));
    // Floating point beside whole numbers may be the same code values.
    assert_eq!((of(&[16, 32, 16]), of(&[8, 8])), (None, None));
}

#[test]
fn the_same_finding_of_many_photographs_is_told_once_with_their_number() {
    let tag = |file: &str, tag: &str| CaptureWarning::UnusableExif {
        file: file.into(),
        tag: tag.into(),
        found: "0/0".into(),
        photographs: 1,
    };
    let secs = |file: &str, used_secs, other_secs, other: &str| CaptureWarning::ExposureDisagrees {
        file: file.into(),
        used_secs,
        other_secs,
        other: other.into(),
        photographs: 1,
    };
    let damaged =
        |file: &str| CaptureWarning::DamagedExif { file: file.into(), reason: format!("of {file}"), photographs: 1 };
    let mut warnings = vec![tag("a", "FNumber")];
    let mut found = vec![
        tag("b", "FNumber"),
        tag("c", "ISOSpeed"),
        tag("h", "FNumber"),
        secs("b", 0.5, 0.25, "EXIF"),
        secs("c", 0.5, 0.25, "EXIF"),
        secs("d", 0.5, 0.125, "EXIF"),
        secs("e", 0.25, 0.25, "EXIF"),
        secs("f", 0.5, 0.25, "APEX"),
        secs("g", 0.1, 0.0501, "EXIF"),
        damaged("b"),
        damaged("c"),
    ];
    gather(&mut warnings, &mut found);
    assert!(found.is_empty());
    let numbers: Vec<usize> = warnings
        .iter()
        .map(|w| match w {
            CaptureWarning::UnusableExif { photographs, .. }
            | CaptureWarning::DamagedExif { photographs, .. }
            | CaptureWarning::ExposureDisagrees { photographs, .. } => *photographs,
            other => panic!("{other}"),
        })
        .collect();
    assert_eq!(numbers, [3, 1, 3, 1, 1, 1, 2]);
}

/// A photograph of 3 × 2 px that tells both times.
fn photograph(dir: &Path, file: &str, time: [u32; 2], apex: i32) {
    use ::exif::{Rational, SRational, Tag, Value};
    let block = super::super::exif::tests::block_of(vec![
        (Tag::ExposureTime, Value::Rational(vec![Rational { num: time[0], denom: time[1] }])),
        (Tag::ShutterSpeedValue, Value::SRational(vec![SRational { num: apex, denom: 10 }])),
    ]);
    let mut info = png::Info::with_size(3, 2);
    (info.color_type, info.bit_depth) = (png::ColorType::Rgb, png::BitDepth::Eight);
    info.exif_metadata = Some(block.into());
    let out = std::fs::File::create(dir.join(file)).unwrap();
    let mut encoder = png::Encoder::with_info(out, info).unwrap().write_header().unwrap();
    encoder.write_image_data(&[7; 18]).unwrap();
}

#[test]
fn an_exposure_time_comes_from_the_manifest_then_from_the_tag_that_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    photograph(folder.path(), "a.png", [1, 30], 50);
    photograph(folder.path(), "b.png", [1, 30], 40);
    let shot = |exposure_secs| super::super::Shot {
        name: "s".into(),
        pattern: Pattern::Board,
        photographs: ["a.png", "b.png"]
            .map(|file| super::super::PhotographEntry { file: file.into(), exposure_secs })
            .to_vec(),
    };
    let heads = |given, from| read_heads(folder.path(), &shot(given), [3, 2], from).unwrap();
    let secs = |heads: &[Head]| heads.iter().map(|h| h.photograph.exposure_secs).collect::<Vec<_>>();
    // 1/30 for 1/32 is how cameras round: 6.25 % is no disagreement. 1/16 is one.
    let (found, warnings) = heads(None, ExposureFrom::Exif);
    assert_eq!(secs(&found), [1.0 / 30.0; 2]);
    assert!(
        matches!(&warnings[..], [CaptureWarning::ExposureDisagrees { file, other_secs, other, .. }]
        if file == "b.png" && *other_secs == 1.0 / 16.0 && other == "EXIF ShutterSpeedValue"),
        "{warnings:?}"
    );
    let (found, warnings) = heads(None, ExposureFrom::Apex);
    assert_eq!((secs(&found), warnings.len()), (vec![1.0 / 32.0, 1.0 / 16.0], 1));
    // The manifest overrides both, and differs from all four.
    let (found, warnings) = heads(Some(0.5), ExposureFrom::Estimate);
    assert_eq!((secs(&found), warnings.len()), (vec![0.5; 2], 4));
    // A picture that is turned is not the rig's.
    assert!(matches!(
        read_heads(folder.path(), &shot(None), [2, 3], ExposureFrom::Exif),
        Err(Error::PhotographSize { expected: [2, 3], .. })
    ));
}

fn shot(name: &str, pattern: Pattern) -> super::super::Shot {
    let photograph = super::super::PhotographEntry { file: "a.png".into(), exposure_secs: None };
    super::super::Shot { name: name.into(), pattern, photographs: vec![photograph] }
}

/// A capture that is whole: 5 × 3 dots of a projector of 100 × 60 px.
fn whole() -> (Manifest, Rig) {
    use super::super::{Axis, Board, Camera, Grid, Projector, ReferenceDots, ResponseCurve, Slab, Surface};
    use super::super::{WhiteReference, Window};
    let code = Pattern::GrayCode { axis: Axis::X, bit: 1, inverse: false, on: Surface::WhiteReference };
    let manifest = Manifest {
        format: 1,
        name: "m".into(),
        slab: Slab { size_mm: [30.0, 20.0] },
        grid: Grid {
            points: [5, 3],
            origin_projector_px: [10.0, 20.0],
            step_projector_px: [20.0, 15.0],
            dot_projector_px: 2,
            dot_area_projector_px2: None,
        },
        window: Window { samples: [7, 5], pitch_mm: 0.2 },
        reference_dots: Some(ReferenceDots { projector_px: vec![[-0.5, 59.5], [99.5, -0.5]] }),
        shots: vec![
            shot("board", Pattern::Board),
            shot("white", Pattern::ReferenceWhite),
            shot("black", Pattern::ReferenceBlack),
            shot("dark", Pattern::SampleBlack),
            shot("code", code),
            shot("first", Pattern::Lattice { dots: vec![[0, 0], [3, 2]] }),
            shot("second", Pattern::Lattice { dots: vec![[4, 0], [0, 2]] }),
        ],
    };
    let rig = Rig {
        format: 1,
        camera: Camera {
            size_px: [80, 120],
            focal_px: 200.0,
            principal_px: [40.0, 60.0],
            response_curve: ResponseCurve::Linear,
            vignetting: Vec::new(),
        },
        noise: None,
        projector: Projector { size_px: [100, 60], principal_px: None },
        board: Some(Board { inner_corners: [6, 4], square_mm: 1.5, origin_mm: [0.0; 2], edge_blur_mm: 0.0 }),
        frame: None,
        white_reference: WhiteReference { reflectance: [0.9; 3], relative_sd: 0.0 },
    };
    (manifest, rig)
}

fn refused(change: impl FnOnce(&mut Manifest, &mut Rig)) -> Option<String> {
    let (mut manifest, mut rig) = whole();
    change(&mut manifest, &mut rig);
    let path = Path::new("capture.toml");
    match require_shots(&manifest, path).and_then(|()| check_against_rig(&manifest, &rig, path)) {
        Ok(()) => None,
        Err(Error::Field { field, .. }) => Some(field),
        Err(other) => panic!("{other}"),
    }
}

#[test]
fn shots_that_are_needed_are_there_as_often_as_they_are_needed() {
    assert_eq!(refused(|_, _| ()), None);
    for (name, kind) in [
        ("white", "reference-white"),
        ("black", "reference-black"),
        ("dark", "sample-black"),
        ("code", "gray-code"),
        ("board", "board"),
    ] {
        let field = Some(format!("shots of kind \"{kind}\""));
        assert_eq!(refused(|m, _| m.shots.retain(|s| s.name != name)), field);
        let twice = refused(|m, _| {
            let again = m.shots.iter().find(|s| s.name == name).cloned();
            m.shots.extend(again);
        });
        assert_eq!(twice, field.filter(|_| !["gray-code", "reference-white"].contains(&kind)));
    }
    let thrice = refused(|m, _| {
        let again = m.shots.iter().find(|s| s.name == "white").cloned();
        m.shots.extend([again.clone(), again].into_iter().flatten());
    });
    assert_eq!(thrice.as_deref(), Some("shots of kind \"reference-white\""));
    let lattice = |s: &super::super::Shot| matches!(s.pattern, Pattern::Lattice { .. });
    assert_eq!(refused(|m, _| m.shots.retain(|s| !lattice(s))).as_deref(), Some("shots of kind \"lattice\""));
    // A frame stands in for the board, but the rig must know its marks.
    let framed = |m: &mut Manifest| m.shots[0] = shot("frame", Pattern::Frame);
    assert_eq!(refused(|m, _| framed(m)).as_deref(), Some("shot \"frame\": kind = \"frame\""));
    let marks = || crate::capture::FrameMarks { marks_mm: Vec::new(), diameter_mm: 1.0 };
    assert_eq!(refused(|m, r| (framed(m), r.frame = Some(marks())).1), None);
    assert_eq!(refused(|_, r| r.board = None).as_deref(), Some("shot \"board\": kind = \"board\""));
    let again = refused(|m, _| m.shots.push(shot("third", Pattern::Lattice { dots: vec![[1, 1], [4, 0]] })));
    assert_eq!(again.as_deref(), Some("shots \"third\": dots"));
}

#[test]
fn dots_lie_on_the_projector_s_picture_and_windows_are_no_finer_than_the_camera_s() {
    let dots = |dots: Vec<[usize; 2]>| {
        refused(|m, _| {
            m.grid.points = [9, 9];
            m.shots[6].pattern = Pattern::Lattice { dots };
        })
    };
    // Dot (4, 2) is at (90, 50), (5, 0) at (110, 20), (0, 3) at (10, 65) px of 100 × 60.
    assert_eq!(dots(vec![[4, 2]]), None);
    assert_eq!(dots(vec![[4, 2], [5, 0]]).as_deref(), Some("shot \"second\": dot [5, 0]"));
    assert_eq!(dots(vec![[0, 3]]).as_deref(), Some("shot \"second\": dot [0, 3]"));
    for at in [[-0.6, 20.0], [99.6, 20.0], [20.0, -0.6], [20.0, 59.6]] {
        let found = refused(|m, _| m.reference_dots.as_mut().unwrap().projector_px[1] = at);
        assert_eq!(found.as_deref(), Some("reference_dots.projector_px"));
    }
    let side = |n: usize| refused(|m, _| m.grid.dot_projector_px = n);
    assert_eq!((side(60), side(61).as_deref()), (None, Some("grid.dot_projector_px")));
    // Two samples for each of the longer side's 120 pixels.
    let samples = |n: usize| refused(|m, _| m.window.samples = [7, n]);
    assert_eq!((samples(239), samples(241).as_deref()), (None, Some("window.samples")));
    assert_eq!(refused(|_, r| r.camera.size_px = [120, 80]), None);
}

#[test]
fn a_large_grid_of_which_next_to_nothing_is_lit_is_a_slip_of_the_pen() {
    // 256 × 256 points may be unlit; beyond, one in 4096: four dots do for 20 479 points, were they so many, and not
    // for 65 792.
    let points = |points| refused(|m, _| m.grid.points = points);
    assert_eq!((points([256, 256]), points([257, 256]).as_deref()), (None, Some("grid.points")));
    let lit = |n: usize| {
        refused(|m, _| {
            (m.grid.points, m.grid.step_projector_px) = ([257, 256], [0.01, 0.01]);
            m.shots[6].pattern = Pattern::Lattice { dots: (0..n).map(|k| [k + 10, 1]).collect() };
        })
    };
    // 65 792 / 4096 is 16 and a bit; two are lit by the first shot.
    assert_eq!((lit(14), lit(13).as_deref()), (None, Some("grid.points")));
    let none = refused(|m, _| {
        m.shots.truncate(6);
        m.shots[5].pattern = Pattern::Lattice { dots: vec![] };
    });
    assert_eq!(none.as_deref(), Some("shots of kind \"lattice\": dots"));
}
