//! The page on synthetic data: an isotropic exponential response over a slab of two materials.

use super::*;
use crate::RegistrationWarning::DriftUnmeasured;
use crate::capture::Rect;
use crate::geometry::Point;
use crate::radiance::Radiance;
use crate::transport::ShotRecord;

/// A header of `points` lit points 0.5 mm apart, cells of 0.25 mm.
pub(super) fn header(points: [usize; 2], window: [usize; 2]) -> MatrixHeader {
    let n = points[0] * points[1];
    MatrixHeader {
        points,
        window,
        pitch_mm: 0.25,
        lit_pitch_mm: [0.5, 0.5],
        lit_mm: (0..n).map(|i| [2.0 + 0.5 * (i % points[0]) as f64, 2.0 + 0.5 * (i / points[0]) as f64]).collect(),
        position_sd_mm: vec![0.001; n],
        shot_of: (0..n).map(|i| Some(i % 4)).collect(),
        common: None,
        shots: (0..4)
            .map(|i| ShotRecord {
                name: format!("lattice <{i}>"),
                drift_px: [0.3 * f64::from(i) - 0.4, 0.2 - 0.15 * f64::from(i * i)],
                drift_sd_px: (i != 2).then_some(0.02),
            })
            .collect(),
        camera_px_per_mm: None,
        warnings: vec![DriftUnmeasured { first: "lattice <2>".into(), shots: 1 }.into()],
        provenance: serde_json::json!({"version": "0.1.0", "options": {"note": "</pre><script>"}}),
    }
}

fn survey(header: &MatrixHeader) -> RowSurvey {
    let [nx, ny] = header.window;
    let row = |index: usize, reason| {
        let mut view = ComparedRow {
            index,
            reason,
            response: Vec::new(),
            variance: Vec::new(),
            valid: Vec::new(),
            reconstructed: Vec::new(),
        };
        for i in 0..3 * nx * ny {
            let [dx, dy] = header.offset_px([i / 3 % nx, i / 3 / nx]).map(|v| v as f64 * header.pitch_mm);
            let r = (dx.hypot(dy)).max(0.1);
            let mean_free = [1.6, 1.1, 0.7][i % 3];
            let exact = (0.5 * (-r * mean_free * 2.0).exp() / r) as f32;
            // A ripple stands for noise that grows towards the tails.
            view.response.push(exact * (1.0 + 0.05 * ((i * 7919 % 100) as f32 / 50.0 - 1.0) * (1.0 + 3.0 * r as f32)));
            view.variance.push((exact * 0.05 * (1.0 + 3.0 * r as f32)).powi(2));
            view.valid.push(u8::from(i / 3 % nx + i / 3 / nx > 2));
            view.reconstructed.push(exact);
        }
        view
    };
    let n = header.rows();
    let checker = |i: usize| (i % header.points[0] / 4 + i / header.points[0] / 4) % 2;
    RowSurvey {
        mean_albedo: Some([[0.71234, 0.0123], [0.5, 0.002], [0.25, 0.0017]]),
        albedo: (0..n).map(|i| (i != 3).then(|| 0.5 + 0.3 * checker(i) as f64)).collect(),
        error: (0..n).map(|i| (i != 3).then(|| 0.01 + 0.02 * checker(i) as f64 + 0.001 * (i % 5) as f64)).collect(),
        rows: vec![row(n / 2, "middle of the grid"), row(n - 1, "the worst row")],
    }
}

fn overview(header: &MatrixHeader) -> Overview {
    let (width, height) = (400, 320);
    let at = |mm: Point| [60.0 + 38.0 * mm[0] + 0.9 * mm[1], 30.0 - 0.6 * mm[0] + 36.0 * mm[1]];
    let square = |c: Point, half: f64| {
        [[-half, -half], [half, -half], [half, half], [-half, half]].map(|o| at([c[0] + o[0], c[1] + o[1]]))
    };
    let lit: Vec<Point> = header.lit_mm.iter().copied().step_by(header.points[0] * 4 + 4).collect();
    let reference = [[-0.8, -0.2], [7.8, -0.2], [-0.8, 7.4], [7.8, 7.4]].map(at).to_vec();
    let lit_px: Vec<Point> = lit.iter().map(|p| at(*p)).collect();
    let (mut value, mut used) = (Vec::new(), Vec::new());
    for k in 0..width * height {
        let q = [(k % width) as f64, (k / width) as f64];
        let near = |dots: &[Point], scale: f64| -> f64 {
            dots.iter().map(|p| (-(q[0] - p[0]).hypot(q[1] - p[1]) / scale).exp()).sum()
        };
        let v = near(&lit_px, 9.0) + 0.4 * near(&reference, 1.2);
        value.extend([1.2, 1.0, 0.7].map(|c| v as f32 * c + 1e-4));
        used.extend([if v > 0.97 { 0 } else { (5.0 - (1.0 + 60.0 * v).log2()).round().clamp(1.0, 5.0) as u8 }; 3]);
    }
    let variance = vec![0.0; value.len()];
    Overview {
        shot: "lattice \"0\" & <co>".into(),
        radiance: Radiance { rect: Rect { x: 0, y: 0, width, height }, value, variance, used },
        exposures: 5,
        grid_px: header.lit_mm.iter().map(|p| at(*p)).collect(),
        lit_px,
        windows_px: lit.iter().map(|p| square(*p, header.window[0] as f64 * header.pitch_mm / 2.0)).collect(),
        reference_dots_px: reference,
        slab_px: square([3.5, 3.5], 3.6),
    }
}

fn material() -> MaterialSummary {
    MaterialSummary {
        model: "tucker".into(),
        terms: 5,
        degree: Some(3),
        bytes_file: 58_211,
        bytes_coded: Some(4_321),
        levels: (0..25)
            .map(|i| TermLevel {
                singular_value: 40.0 * (-0.9 * f64::from(i)).exp() + 0.05,
                noise: 0.6 - 0.01 * f64::from(i),
                kept: i < 5,
            })
            .collect(),
        choice: Some("T = 5: the sixth singular value (0.49) is below the noise (0.60); P = 3".into()),
    }
}

/// Writes the page of the synthetic data into `dir`.
fn write_into(dir: &Path) {
    let header = header([12, 12], [21, 21]);
    let comparisons = [
        Comparison::new(
            "material against matrix",
            &serde_json::json!({"rel_rmse": 0.0123, "psnr_db": 41.23, "log_rmse": 0.08,
            "bytes_f32": 58_000, "bytes_file": 58_211, "albedo_max": [0.81, 0.72, 0.6], "something_new": 12.5, "note": "not a number"}),
        ),
        Comparison::new("matrix against truth", &serde_json::json!({"rel_rmse": 0.021, "psnr_db": 38.0})),
    ]
    .map(Result::unwrap);
    let timings = [("read", 0.4), ("merge", 6.2), ("factor: survey", 0.5), ("factor: terms", 1.1)];
    let timings = timings.map(|(stage, secs)| StageTime { stage: stage.into(), secs });
    let (material, overview, survey) = (material(), overview(&header), survey(&header));
    let input = ReportInput {
        title: "Chessboard <4×4> & co",
        matrix: &header,
        material: &material,
        overview: Some(&overview),
        survey: &survey,
        comparisons: &comparisons,
        timings: &timings,
        warnings: &[],
    };
    write(dir, &input).unwrap();
}

#[test]
fn the_page_needs_nothing_but_itself() {
    let dir = tempfile::tempdir().unwrap();
    write_into(dir.path());
    let html = std::fs::read_to_string(dir.path().join("report.html")).unwrap();
    // The name of SVG's vocabulary is the only address; every other reference is data or a place in the page.
    assert_eq!(html.matches("http").count(), html.matches("http://www.w3.org/2000/svg").count());
    for attribute in ["src=\"", "href=\""] {
        for (i, _) in html.match_indices(attribute) {
            let value = &html[i + attribute.len()..];
            assert!(value.starts_with("data:image/png;base64,") || value.starts_with('#'), "{}", &value[..40]);
        }
    }
    assert!(!html.contains("<script") && !html.contains("@import") && !html.contains("url("));
    for name in ["Chessboard &lt;4×4&gt; &amp; co", "lattice &lt;2&gt;", "lattice &quot;0&quot; &amp; &lt;co&gt;"] {
        assert!(html.contains(name), "{name}");
    }
    assert!(html.contains("</sub> of 12×12 points, 21×21 window; material 58.2 kB, 41.2 dB</h1>"));
    assert!(!html.contains("NaN") && !html.contains("inf"));
    assert!(html.contains("<td>factor (survey 500 ms, terms 1.1 s)</td><td class=\"n\">1.6 s</td>"));
}

#[test]
fn every_picture_beside_the_page_is_in_it() {
    let dir = tempfile::tempdir().unwrap();
    write_into(dir.path());
    let html = std::fs::read_to_string(dir.path().join("report.html")).unwrap();
    assert!(html.contains("mean of all rows R 0.712 ± 0.012, G 0.5000 ± 0.0020, B 0.2500 ± 0.0017"), "albedo");
    let mut pngs = 0;
    for entry in std::fs::read_dir(dir.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "png") {
            pngs += 1;
            assert!(html.contains(&picture::data_url(&std::fs::read(&path).unwrap())), "{}", path.display());
        }
    }
    // Shot, exposures, two maps, four windows of two rows.
    assert_eq!(pngs, 12);
    let size = |name: &str| image::open(dir.path().join(name)).unwrap().to_rgb8();
    assert_eq!(size("shot.png").dimensions(), (400, 320));
    assert_eq!(size("row-1-measured.png").dimensions(), (252, 252));
    assert_eq!(size("row-1-measured.png").get_pixel(0, 0).0, color::INVALID);
    assert_eq!(size("albedo.png").get_pixel(3 * 27 + 1, 1).0, color::INVALID);
    assert_eq!(size("exposures.png").get_pixel(0, 319).0, color::count(5));
}

#[test]
fn a_large_photograph_is_reduced_and_a_wrong_one_refused() {
    assert_eq!((picture::reduction(1600, 900, 1600), picture::reduction(6000, 4000, 1600)), (1, 4));
    let mut wrong = overview(&header([2, 2], [3, 3]));
    wrong.radiance.used.pop();
    assert!(figures::exposures(&wrong, &mut Vec::new()).unwrap_err().is_internal());
}

/// For looking at: `REPORT_DIR=/tmp/r cargo test report::tests::look -- --ignored`.
#[test]
#[ignore = "writes where REPORT_DIR says, for eyes"]
fn look() {
    if let Some(dir) = std::env::var_os("REPORT_DIR") {
        write_into(Path::new(&dir));
    }
}
