//! Relighting: what a person expects to see of a slab under a light.

use crate::common::acquire as program;
use acquire::factor::{FactorOptions, factor};
use acquire::material::{Exitance, Light, Source, lit_area, relight};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row, ShotRecord};
use std::path::Path;

const POINTS: [usize; 2] = [17, 12];
const WINDOW: [usize; 2] = [15, 11];
const PITCH_MM: f64 = 0.4;
const LIT_PITCH_MM: [f64; 2] = [1.2, 0.8];

/// Lit points moved shot by shot, by up to a third of a sample: as a bench drifts.
fn place(i: usize) -> [f64; 2] {
    let (x, y, shot) = (i % POINTS[0], i / POINTS[0], (i % POINTS[0] % 3 + 3 * (i / POINTS[0] % 2)) as f64);
    [
        0.13 * (2.1 * shot).sin() + LIT_PITCH_MM[0] * x as f64,
        5.0 + 0.13 * (1.3 * shot).cos() + LIT_PITCH_MM[1] * y as f64,
    ]
}

/// A matrix whose rows are `albedo(i)` times one profile of three colours.
fn matrix(path: &Path, albedo: impl Fn(usize) -> f64) -> MatrixReader {
    let rows = POINTS[0] * POINTS[1];
    let header = MatrixHeader {
        points: POINTS,
        window: WINDOW,
        pitch_mm: PITCH_MM,
        lit_pitch_mm: LIT_PITCH_MM,
        lit_mm: (0..rows).map(place).collect(),
        position_sd_mm: vec![0.002; rows],
        shot_of: vec![Some(0); rows],
        common: None,
        shots: vec![ShotRecord { name: "a".into(), drift_px: [0.0; 2], drift_sd_px: None }],
        warnings: Vec::new(),
        camera_px_per_mm: None,
        provenance: serde_json::Value::Null,
    };
    let writer = MatrixWriter::create(path, header).unwrap();
    for i in 0..rows {
        let value = |s: usize| {
            let (dx, dy) = ((s / 3 % 15) as f64 - 7.0, (s / 45) as f64 - 5.0);
            albedo(i) * [0.3, 0.2, 0.1][s % 3] * (-dx.hypot(dy) / [1.5, 1.1, 0.8][s % 3]).exp()
        };
        let response: Vec<f32> = (0..495).map(|s| value(s) as f32).collect();
        let variance = response.iter().map(|r| (0.002 * r).powi(2) + 1e-10).collect();
        writer.put(i, &Row { response, variance, valid: vec![true; 495] }).unwrap();
    }
    writer.finish().unwrap();
    MatrixReader::open(path).unwrap()
}

fn lit(source: &Source, light: &Light) -> Exitance {
    let quadrature = light.quadrature(&lit_area(source).unwrap(), &source.shape());
    let flux = light.flux(&quadrature).unwrap();
    relight(source, &quadrature, &[flux], &Progress::silent()).unwrap().remove(0)
}

/// Samples that are further from the rim of the lit area than half a window: (x, y in mm, R, G, B).
fn inside(image: &Exitance) -> Vec<([f64; 2], [f64; 3])> {
    let size = image.canvas.size;
    let places = (0..size[0] * size[1]).map(|k| {
        let at = [0, 1].map(|a| image.canvas.origin_mm[a] + [k % size[0], k / size[0]][a] as f64 * PITCH_MM);
        (at, [0, 1, 2].map(|c| image.planes[c][k]))
    });
    let margin = [7.6 * PITCH_MM, 5.6 * PITCH_MM];
    let low = [-0.6 - 0.15 + margin[0], 5.0 - 0.4 - 0.15 + margin[1]];
    let high = [16.0 * 1.2 + 0.6 + 0.15 - margin[0], 5.0 + 11.0 * 0.8 + 0.4 + 0.15 - margin[1]];
    places.filter(|(at, _)| (0..2).all(|a| at[a] > low[a] + 0.3 && at[a] < high[a] - 0.3)).collect()
}

#[test]
fn an_even_slab_under_even_light_is_even_however_its_points_drifted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let reader = matrix(&path, |_| 1.0);
    let made = factor(&reader, &FactorOptions::default(), &Progress::silent()).unwrap();
    assert_eq!((made.material.header.terms, made.material.header.exit_grid), (1, None), "{}", made.choice);
    let file = folder.path().join("m.safetensors");
    std::fs::write(&file, made.material.to_bytes().unwrap()).unwrap();
    for source in [Source::open(&path).unwrap(), Source::open(&file).unwrap()] {
        let image = lit(&source, &Light::Uniform);
        let seen = inside(&image);
        assert!(seen.len() > 100, "{}", seen.len());
        for c in 0..3 {
            let mean = seen.iter().map(|(_, e)| e[c]).sum::<f64>() / seen.len() as f64;
            let worst = seen.iter().map(|(_, e)| (e[c] / mean - 1.0).abs()).fold(0.0, f64::max);
            assert!(worst < 1e-5, "rows are f32, channel {c}: {worst}");
            // An irradiance of one leaves as the albedo: the sum of a row over its window.
            let albedo: f64 = (0..165)
                .map(|s| {
                    let (dx, dy) = ((s % 15) as f64 - 7.0, (s / 15) as f64 - 5.0);
                    [0.3, 0.2, 0.1][c] * (-dx.hypot(dy) / [1.5, 1.1, 0.8][c]).exp() * PITCH_MM * PITCH_MM
                })
                .sum();
            assert!((mean / albedo - 1.0).abs() < 1e-5, "rows are f32: {mean} {albedo}");
        }
    }
}

#[test]
fn a_slope_of_albedo_is_seen_where_it_is_however_its_points_drifted() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    matrix(&path, |i| 1.0 + 0.02 * place(i)[0]);
    let image = lit(&Source::open(&path).unwrap(), &Light::Uniform);
    let seen = inside(&image);
    // A symmetric profile times a slope is the slope: fitted through two ends, compared everywhere.
    let value = |x: f64| 1.0 + 0.02 * x;
    let scale = seen.iter().map(|(at, e)| e[0] / value(at[0])).sum::<f64>() / seen.len() as f64;
    let worst = seen.iter().map(|(at, e)| (e[0] / scale / value(at[0]) - 1.0).abs()).fold(0.0, f64::max);
    // Points are found to a thousandth of their moves, which change the albedo by 0.3 % at most.
    assert!(worst < 1e-4, "{worst}");
}

/// An even light of 8 × 8 pixels.
fn even_light(path: &Path) {
    exr::prelude::write_rgb_file(path, 8, 8, |_, _| (1.0_f32, 1.0_f32, 1.0_f32)).unwrap();
}

#[test]
fn an_image_of_another_ratio_than_the_lit_area_is_told_unless_its_size_is_given() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (m, light, out) = (path("m.rd.zarr"), path("light.exr"), path("e.exr"));
    matrix(Path::new(&m), |_| 1.0);
    even_light(Path::new(&light));
    let relit = |more: &[&str]| {
        let (status, _, stderr) =
            program(&[&["relight", &m, "--light", &light, "--out", &out, "--force"], more].concat());
        assert_eq!(status, 0, "{stderr}");
        let image = acquire::material::read_light_image(Path::new(&out)).unwrap();
        (stderr, image.rgb.iter().map(|p| f64::from(p[1])).sum::<f64>() * PITCH_MM * PITCH_MM)
    };
    // 17 × 12 points, 1.2 × 0.8 mm apart, light 20.4 × 9.6 mm.
    let (told, everywhere) = relit(&[]);
    for words in ["warning: the image is 1.000 times as wide as high, the lit area 2.1", "--extent-mm WxH"] {
        assert!(told.contains(words), "{told}");
    }
    assert!(!relit(&["--tile", "17x8"]).0.contains("warning"), "copies of 1.2 × 1.2 mm");
    for more in [&["--extent-mm", "6x4"][..], &["--extent-mm", "6x4", "--tile", "3x2"]] {
        let (told, flux) = relit(more);
        assert!(!told.contains("warning"), "{told}");
        // What leaves is as the area that is lit; the lattice's mean pitch differs from 1.2 × 0.8 mm by drift.
        let share = flux / everywhere * 20.4 * 9.6 / 24.0;
        assert!((share - 1.0).abs() < 0.02, "{more:?}: {share}");
    }
}

#[test]
fn sizes_and_copies_that_no_light_has_are_refused_as_they_are_typed() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (m, light, out) = (path("m.rd.zarr"), path("light.exr"), path("e.exr"));
    matrix(Path::new(&m), |_| 1.0);
    even_light(Path::new(&light));
    for (light, more, words) in [
        (
            light.as_str(),
            ["--extent-mm", "0x4"],
            "error: --extent-mm: expected finite sides above 0 mm, found 0 × 4 mm",
        ),
        (&light, ["--extent-mm", "6x-4"], "found 6 × -4 mm"),
        (&light, ["--tile", "2x0"], "error: --tile: expected 1×1 to "),
        (&light, ["--tile", "90x2"], "each as wide as an outgoing sample (0.4 mm) or wider, found 90×2"),
        ("spot", ["--extent-mm", "6x4"], "error: --extent-mm: expected an image"),
        ("stripes", ["--tile", "3x1"], "error: --tile: expected an image"),
    ] {
        let (status, _, stderr) = program(&[&["relight", &m, "--light", light, "--out", &out][..], &more].concat());
        assert!(status == 1 && stderr.contains(words), "{more:?}: {stderr}");
        assert!(!Path::new(&out).exists(), "{more:?}");
    }
}
