//! Each cause does to photographs what it says; without any, photographs are the ideal rendering, rounded.

use super::super::{Bench, CameraCurve, Cause, ShotList, Truth, simulate};
use super::*;
use crate::capture::{Manifest, ResponseCurve, Rig};
use crate::progress::Progress;
use std::collections::BTreeMap;

/// One lattice shot of four dots on a bench that is not square, without noise, all else ideal but `causes`.
fn bench(causes: &[Cause]) -> SimulateOptions {
    let mut options =
        SimulateOptions { grid: [2, 2], window: [5, 3], spacing: Some([1, 1]), ..SimulateOptions::default() };
    options.only(causes);
    options
}

/// All photographs of a capture by name: code values and exposure.
fn photographs(options: &SimulateOptions) -> BTreeMap<String, (Vec<u16>, f64)> {
    let dir = tempfile::tempdir().unwrap();
    simulate(options, &dir.path().join("c"), &Progress::silent()).unwrap();
    let mut found = BTreeMap::new();
    for shot in Manifest::read(&dir.path().join("c")).unwrap().shots {
        for entry in shot.photographs {
            let path = dir.path().join("c").join(&entry.file);
            let mut file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
            let exif = exif::Reader::new().read_from_container(&mut file).unwrap();
            let exif::Value::Rational(time) =
                &exif.get_field(exif::Tag::ExposureTime, exif::In::PRIMARY).unwrap().value
            else {
                panic!("no exposure time");
            };
            let codes = image::open(&path).unwrap().into_rgb16().into_raw();
            found.insert(entry.file, (codes, time[0].to_f64()));
        }
    }
    found
}

fn truth_and_rig(options: &SimulateOptions) -> (Truth, Rig) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("c");
    simulate(options, &path, &Progress::silent()).unwrap();
    let truth = toml::from_str(&std::fs::read_to_string(path.join("truth.toml")).unwrap()).unwrap();
    (truth, Rig::read(&path.join("calibration/rig.toml")).unwrap())
}

fn studio(options: &SimulateOptions) -> Studio {
    Studio::new(options, Bench::new(options, &Progress::silent()).unwrap()).unwrap()
}

fn lattice(options: &SimulateOptions, camera_drift_px: Point) -> (Studio, RenderedPicture) {
    let studio = studio(options);
    let view = moved_view(&studio.bench.scene.view, camera_drift_px);
    let dots = LitDots::new(&studio, &view, &[[0, 0], [1, 0], [0, 1], [1, 1]], [0.0; 2]);
    let picture = shown(&studio, options, Shown::Dots(dots), Some(&view));
    (studio, picture)
}

/// A whole picture.
fn shown(
    studio: &Studio,
    options: &SimulateOptions,
    mut shown: Shown<'_>,
    view: Option<&CameraView>,
) -> RenderedPicture {
    let mut whole = Vec::new();
    for rows in &studio.strips {
        let mut picture = Vec::new();
        studio.show(options, &mut shown, view, rows, |_, _| Ok(()), &mut picture).unwrap();
        whole.extend(picture);
    }
    whole
}

/// Electrons per second of a picture as the sensor sees it.
fn rate(studio: &Studio, options: &SimulateOptions, picture: &RenderedPicture) -> Vec<f32> {
    let mut lens = PointSpread::new(studio.bench.scene.camera.size_px, options.psf_px, options.glare);
    let mut rate = lens.see(studio.electrons(picture));
    studio.darken_corners(&mut rate, 0);
    rate
}

#[test]
fn pictures_rendered_in_strips_are_those_of_the_whole() {
    let mut options = bench(&[Cause::Psf, Cause::Ambient, Cause::ProjectorBlack, Cause::Distortion]);
    options.frame_marks = true;
    let gray = Pattern::GrayCode { axis: crate::capture::Axis::Y, bit: 3, inverse: true, on: Surface::WhiteReference };
    let mut at_once = studio(&options);
    assert_eq!(at_once.strips.len(), 1);
    let height = at_once.bench.scene.camera.size_px[1];
    let mut in_strips = studio(&options);
    in_strips.whole = None;
    in_strips.strips = (0..height).step_by(7).map(|y| y..(y + 7).min(height)).collect();
    let view = moved_view(&at_once.bench.scene.view, [1.3, -0.4]);
    at_once.whole = None;
    for pattern in [gray, Pattern::Board, Pattern::ReferenceWhite, Pattern::SampleBlack, Pattern::Frame] {
        let show = |studio: &Studio| shown(studio, &options, Shown::Still(&pattern, [0.3, 0.2]), Some(&view));
        assert!(show(&at_once) == show(&in_strips), "{pattern:?}");
    }
    let dots = |studio: &Studio| LitDots::new(studio, &view, &[[0, 0], [1, 0], [0, 1], [1, 1]], [0.05, -0.1]);
    let show = |studio: &Studio| shown(studio, &options, Shown::Dots(dots(studio)), Some(&view));
    let (whole, strips) = (show(&at_once), show(&in_strips));
    let (lit, dark) = (whole.iter().flatten().sum::<f32>(), shown_dark(&at_once, &options));
    // The dots are most of the light, and not all of it.
    assert!(whole == strips && lit > 1.5 * dark && dark > 0.0, "{lit} {dark}");
}

fn shown_dark(studio: &Studio, options: &SimulateOptions) -> f32 {
    shown(studio, options, Shown::Still(&Pattern::SampleBlack, [0.0; 2]), None).iter().flatten().sum()
}

#[test]
fn photographs_of_an_ideal_bench_are_the_rendering_rounded() {
    let options = bench(&[]);
    let (studio, picture) = lattice(&options, [0.0; 2]);
    let noise = SimulatedSensor::new(&SimulateOptions { noise_free: false, ..options.clone() }).noise();
    let mut brightest = 0.0f64;
    let shots = photographs(&options);
    let lattices: Vec<_> = shots.iter().filter(|s| s.0.contains("lattice")).collect();
    assert_eq!(lattices.len(), options.exposures);
    for (_, (codes, secs)) in lattices {
        for (code, light) in codes.iter().zip(picture.iter().flatten()) {
            let electrons = f64::from(*light) / PI * studio.electrons_per_sec * secs;
            let expected = (noise.black_dn + noise.gain_dn_per_electron * electrons).min(16_383.0);
            brightest = brightest.max(expected);
            // Half a code value, and the rounding of f32.
            assert!((f64::from(*code) - expected).abs() < 0.5 + 3e-7 * expected, "{code} {expected}");
        }
    }
    assert_eq!(brightest, 16_383.0, "the longest exposure saturates at the dots");
}

#[test]
fn a_camera_that_moves_shows_the_same_picture_elsewhere() {
    let options = bench(&[Cause::CameraDrift, Cause::Ambient, Cause::Distortion]);
    let (studio, still) = lattice(&options, [0.0; 2]);
    let (_, moved) = lattice(&options, [2.0, -1.0]);
    let [width, height] = studio.bench.scene.camera.size_px;
    let brightest = still.iter().flatten().copied().fold(0.0, f32::max);
    for y in 2..height - 2 {
        for x in 2..width - 2 {
            let (a, b) = (still[y * width + x], moved[(y - 1) * width + x + 2]);
            // Whole pixels see the same places but for rounding.
            assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1e-5 * brightest), "{x} {y}: {a:?} {b:?}");
        }
    }
    // By a fraction of a pixel: the centroid of all light moves by it.
    let (_, nudged) = lattice(&options, [0.3, 0.0]);
    let centroid = |picture: &RenderedPicture| {
        let sum: f64 = picture.iter().map(|p| f64::from(p[1])).sum();
        picture.iter().enumerate().map(|(i, p)| (i % width) as f64 * f64::from(p[1])).sum::<f64>() / sum
    };
    let by = centroid(&nudged) - centroid(&still);
    // Six points a pixel at the rims of sample and frame.
    assert!((by - 0.3).abs() < 0.01, "{by}");
}

#[test]
fn drift_and_jumps_are_those_of_the_truth() {
    let sweep = |causes: &[Cause]| {
        let mut options = SimulateOptions {
            grid: [5, 4],
            window: [5, 3],
            spacing: Some([4, 3]),
            exposures: 1,
            ..SimulateOptions::default()
        };
        options.only(causes);
        ShotList::new(&options, &Bench::new(&options, &Progress::silent()).unwrap().scene, |_| 1).lattices
    };
    let jumps = |path: Vec<Point>| path.windows(2).filter(|w| w[0] != w[1]).count();
    let paths = |causes: &[Cause]| {
        let lattices = sweep(causes);
        assert_eq!(lattices.len(), 12);
        let [projector, camera]: [Vec<Point>; 2] =
            [lattices.iter().map(|s| s.drift_px).collect(), lattices.iter().map(|s| s.camera_drift_px).collect()];
        [jumps(projector), jumps(camera)]
    };
    assert_eq!(paths(&[]), [0, 0]);
    assert_eq!(paths(&[Cause::Jumps]), [3, 0]);
    assert_eq!(paths(&[Cause::CameraJumps]), [0, 3]);
    assert_eq!(paths(&[Cause::Drift]), [11, 0]);
    assert_eq!(paths(&[Cause::CameraDrift]), [0, 11]);
}

#[test]
fn a_lamp_that_flickers_changes_each_photograph_by_the_share_that_was_asked_for() {
    let mut options = bench(&[Cause::Flicker]);
    let steady = photographs(&bench(&[]));
    options.flicker = 0.02;
    let factors: Vec<f64> = photographs(&options)
        .iter()
        .filter(|(name, _)| name.contains("white") || name.contains("gray"))
        .map(|(name, (codes, _))| {
            let light = |codes: &[u16]| codes.iter().map(|&c| f64::from(c) - 512.0).sum::<f64>();
            light(codes) / light(&steady[name].0) - 1.0
        })
        .collect();
    let n = factors.len() as f64;
    let mean = factors.iter().sum::<f64>() / n;
    let sd = (factors.iter().map(|f| (f - mean).powi(2)).sum::<f64>() / (n - 1.0)).sqrt();
    // Four standard errors of mean and standard deviation.
    assert!(n > 30.0 && mean.abs() < 4.0 * 0.02 / n.sqrt(), "{mean} of {n}");
    assert!((sd / 0.02 - 1.0).abs() < 4.0 / (2.0 * n).sqrt(), "{sd}");
}

#[test]
fn hot_pixels_are_the_same_in_every_photograph() {
    let mut options = bench(&[Cause::HotPixels]);
    options.hot_pixels = 1e-3;
    let (hot, clean) = (photographs(&options), photographs(&bench(&[])));
    let of = |name: &str| {
        let differ = hot[name].0.iter().zip(&clean[name].0).enumerate().filter(|(_, (a, b))| a != b);
        differ.map(|(i, (a, b))| (i, a - b)).collect::<Vec<_>>()
    };
    // 1/4 s and 1 s: a hot photosite of 200 electrons a second is 20 and 80 code values brighter.
    let (shorter, longest) = (of("photos/sample-black_3.png"), of("photos/sample-black_4.png"));
    let count = clean["photos/sample-black_4.png"].0.len() as f64 * 1e-3;
    assert_eq!(longest.len(), count.round() as usize);
    assert!(shorter.iter().all(|s| longest.iter().any(|l| l.0 == s.0 && l.1 > 2 * s.1)));
}

#[test]
fn lens_and_glare_spread_the_light_of_a_point() {
    let spread = |causes: &[Cause]| {
        let options = bench(causes);
        let studio = studio(&options);
        let [width, height] = studio.bench.scene.camera.size_px;
        let parts = psf::parts(options.psf_px);
        let mut picture = vec![[0.0; 3]; width * height * parts * parts];
        for k in 0..parts * parts {
            let (x, y) = (width / 2 * parts + k % parts, height / 2 * parts + k / parts);
            picture[y * width * parts + x] = [1.0; 3];
        }
        let rate = rate(&studio, &options, &picture);
        let green = |x: usize, y: usize| f64::from(rate[3 * (y * width + x) + 1]);
        let (x, y) = (width / 2, height / 2);
        [green(x + 1, y) / green(x, y), green(x + 10, y) / green(x, y)]
    };
    assert_eq!(spread(&[]), [0.0, 0.0]);
    // An even pixel and a Gaussian of 0.5 px folded leave 0.610 in the pixel and 0.191 in the next. Halves of pixels
    // make less of so sharp a thing, (w₁ + 2w₂ + w₃) / (2w₀ + 2w₁) with wₖ = exp(−k²/2): 0.2765 for 0.313.
    let [near, far] = spread(&[Cause::Psf]);
    assert!((near - 0.2765).abs() < 1e-3 && far == 0.0, "{near} {far}");
    let [near, far] = spread(&[Cause::Glare]);
    // 1 % over 2π · 400 px².
    let peak = 0.01 / (2.0 * PI * 400.0);
    assert!(far > 0.8 * peak && far < near && near < 1.05 * peak, "{near} {far}");
}

#[test]
fn vignetting_darkens_the_corners_of_photographs() {
    let corner = |causes: &[Cause]| {
        let options = bench(causes);
        let studio = studio(&options);
        let [width, height] = studio.bench.scene.camera.size_px;
        let rate = rate(&studio, &options, &vec![[1.0; 3]; width * height]);
        rate[0] / rate[3 * (height / 2 * width + width / 2)]
    };
    assert!((corner(&[]) - 1.0).abs() < 1e-6 && (corner(&[Cause::Vignetting]) - 0.85).abs() < 1e-3);
}

#[test]
fn a_film_curve_is_in_the_truth_and_not_in_the_rig() {
    let (truth, rig) = truth_and_rig(&bench(&[Cause::Film]));
    assert_eq!(rig.camera.response_curve, ResponseCurve::Srgb);
    assert_eq!(truth.response_curve, CameraCurve::Film.samples());
    let srgb = SimulateOptions { response_curve: Some(CameraCurve::Srgb), ..bench(&[]) };
    assert_ne!(truth_and_rig(&srgb).0.response_curve, truth.response_curve);
    let name = "photos/reference-white_1.png";
    assert_ne!(photographs(&bench(&[Cause::Film]))[name], photographs(&srgb)[name]);
    // Without being told, PNG is linear.
    let (truth, rig) = truth_and_rig(&bench(&[]));
    assert_eq!(rig.camera.response_curve, ResponseCurve::Linear);
    assert!(truth.response_curve.iter().all(|[linear, encoded]| linear == encoded));
}

#[test]
fn projector_black_ambient_light_falloff_and_blur_reach_the_photographs() {
    let still = |causes: &[Cause], pattern: &Pattern| {
        let options = bench(causes);
        let studio = studio(&options);
        let picture = shown(&studio, &options, Shown::Still(pattern, [0.0; 2]), None);
        let [width, height] = studio.bench.scene.camera.size_px;
        (picture[height / 2 * width + width / 2], picture[0], picture)
    };
    let black = Pattern::ReferenceBlack;
    let white = still(&[], &Pattern::ReferenceWhite);
    // The projector's colour times the reference's.
    let full = [1.0 * 0.97, 0.95 * 0.94, 0.85 * 0.88].map(|v| v as f32);
    assert_eq!((still(&[], &black).0, white.0, white.1), ([0.0; 3], full, full));
    for c in 0..3 {
        let reflectance = [0.97, 0.94, 0.88][c];
        assert!((still(&[Cause::ProjectorBlack], &black).0[c] - full[c] * 2e-4).abs() < 1e-8);
        // Ambient light is white.
        assert!((still(&[Cause::Ambient], &black).0[c] - reflectance * 5e-5).abs() < 1e-8);
        assert!(still(&[Cause::Falloff], &Pattern::ReferenceWhite).1[c] < 0.91 * full[c]);
    }
    let uneven = still(&[Cause::WhiteUnevenness], &Pattern::ReferenceWhite).2;
    let deviations = || uneven.iter().map(|p| p[1] / full[1] - 1.0);
    let (low, high) = (deviations().fold(f32::MAX, f32::min), deviations().fold(f32::MIN, f32::max));
    assert!(low < -0.001 && high > 0.001 && low > -0.0021 && high < 0.0021, "{low} {high}");
    // Blurred stripes: more pixels between dark and light.
    let stripes = Pattern::GrayCode { axis: crate::capture::Axis::X, bit: 2, inverse: false, on: Default::default() };
    let between = |causes: &[Cause]| still(causes, &stripes).2.iter().filter(|p| p[0] > 0.01 && p[0] < 0.98).count();
    assert!(between(&[Cause::Blur]) > between(&[]));
}
