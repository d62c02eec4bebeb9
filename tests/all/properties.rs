//! What a change of the capture must change in the matrix, and nothing else: turned, mirrored, scaled, permuted
//! captures.

use crate::common;
use acquire::capture::{Axis, Manifest, Pattern, Rig};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{CameraCurve, SimulateOptions};
use acquire::transport::{MatrixHeader, MatrixReader, RowBlock};
use image::{ImageBuffer, Rgb};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

type Picture = ImageBuffer<Rgb<u16>, Vec<u16>>;

/// A small capture without any symmetry: 4 × 3 points, windows of 9 × 7, two media, four dots in some shots.
fn options() -> SimulateOptions {
    SimulateOptions {
        material: "chessboard-3x2".parse().unwrap(),
        grid: [4, 3],
        window: [9, 7],
        lit_pitch_mm: Some([1.5, 2.0]),
        step_projector_px: [12, 15],
        exposures: 3,
        seed: 7,
        ..common::bench()
    }
}

/// A capture that can be changed and written again: its times stand in the manifest, so that photographs need no EXIF.
#[derive(Clone)]
struct Bench {
    manifest: Manifest,
    rig: Rig,
    photographs: BTreeMap<String, Picture>,
}

impl Bench {
    fn simulated(options: &SimulateOptions) -> Self {
        let (_folder, dir) = common::capture(options);
        let mut manifest = Manifest::read(&dir).unwrap();
        let mut photographs = BTreeMap::new();
        for entry in manifest.shots.iter_mut().flat_map(|s| &mut s.photographs) {
            let path = dir.join(&entry.file);
            let mut file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
            let exif = exif::Reader::new().read_from_container(&mut file).unwrap();
            let field = exif.get_field(exif::Tag::ExposureTime, exif::In::PRIMARY).unwrap();
            let exif::Value::Rational(time) = &field.value else { panic!("{field:?}") };
            entry.exposure_secs = Some(time[0].to_f64());
            photographs.insert(entry.file.clone(), image::open(&path).unwrap().into_rgb16());
        }
        let rig = Rig::read(&dir.join("calibration/rig.toml")).unwrap();
        Self { manifest, rig, photographs }
    }

    fn matrix(&self) -> (MatrixHeader, RowBlock) {
        let folder = tempfile::tempdir().unwrap();
        let dir = folder.path().join("capture");
        std::fs::create_dir_all(dir.join("photos")).unwrap();
        std::fs::create_dir(dir.join("calibration")).unwrap();
        self.manifest.write(&dir).unwrap();
        self.rig.write(&dir.join("calibration")).unwrap();
        for (name, picture) in &self.photographs {
            picture.save(dir.join(name)).unwrap();
        }
        build(&dir)
    }

    fn each_photograph(&mut self, change: impl Fn(&Picture) -> Picture) {
        self.photographs.values_mut().for_each(|p| *p = change(p));
    }
}

fn build(dir: &Path) -> (MatrixHeader, RowBlock) {
    let out: PathBuf = dir.with_extension("rd.zarr");
    build_matrix(dir, &BuildOptions::default(), &out, &Progress::silent()).unwrap();
    let reader = MatrixReader::open(&out).unwrap();
    (reader.header().clone(), reader.read(0..reader.header().rows()).unwrap())
}

/// ‖a − b‖ / ‖b‖ over entries; `to` says which entry (row, dy, dx, channel) of `a` stands for one of `b`.
fn difference(
    (header, a): &(MatrixHeader, RowBlock),
    (other, b): &(MatrixHeader, RowBlock),
    to: impl Fn(usize, [usize; 2], usize) -> (usize, [usize; 2], usize),
) -> f64 {
    let at = |h: &MatrixHeader, (row, [dx, dy], c): (usize, [usize; 2], usize)| {
        ((row * h.window[1] + dy) * h.window[0] + dx) * 3 + c
    };
    let (mut error, mut norm) = (0.0, 0.0);
    for row in 0..other.rows() {
        for (dy, dx, c) in (0..other.window[1])
            .flat_map(|dy| (0..other.window[0]).flat_map(move |dx| (0..3).map(move |c| (dy, dx, c))))
        {
            let (k, n) = (at(header, to(row, [dx, dy], c)), at(other, (row, [dx, dy], c)));
            assert_eq!(a.valid[k], b.valid[n]);
            let (x, y) = (f64::from(a.response[k]), f64::from(b.response[n]));
            error += (x - y).powi(2);
            norm += y.powi(2);
        }
    }
    (error / norm).sqrt()
}

fn same(row: usize, sample: [usize; 2], channel: usize) -> (usize, [usize; 2], usize) {
    (row, sample, channel)
}

/// The largest distance between lit points and where they should be, mm.
fn displaced(header: &MatrixHeader, expected: impl Iterator<Item = [f64; 2]>) -> f64 {
    header.lit_mm.iter().zip(expected).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f64::max)
}

/// Of a mirrored or turned picture, corners and dots are found by the same rules from another side: positions agree to
/// some hundredths of a pixel (0.17 mm), responses to what that displaces them by.
const SEEN_FROM_ELSEWHERE: f64 = 0.01;
const ELSEWHERE_MM: f64 = 0.01;

#[test]
fn a_mirrored_capture_gives_the_mirrored_matrix() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut mirrored = bench.clone();
    mirrored.each_photograph(image::imageops::flip_horizontal);
    let [width, _] = bench.rig.camera.size_px;
    mirrored.rig.camera.principal_px[0] = width as f64 - 1.0 - bench.rig.camera.principal_px[0];
    let slab_mm = bench.manifest.slab.size_mm[0];
    let board = bench.rig.board.clone().unwrap();
    let last = board.origin_mm[0] + (board.inner_corners[0] - 1) as f64 * board.square_mm;
    mirrored.rig.board.as_mut().unwrap().origin_mm[0] = slab_mm - last;
    let found = mirrored.matrix();
    let off = displaced(&found.0, original.0.lit_mm.iter().map(|p| [slab_mm - p[0], p[1]]));
    assert!(off < ELSEWHERE_MM, "{off}");
    let flipped = |row, [dx, dy]: [usize; 2], c| (row, [8 - dx, dy], c);
    let error = difference(&found, &original, flipped);
    assert!(error < SEEN_FROM_ELSEWHERE, "{error}");
    // The test can tell: unmirrored windows differ by the slab's two media.
    assert!(difference(&found, &original, same) > 2.0 * SEEN_FROM_ELSEWHERE);
}

#[test]
fn a_capture_turned_by_a_quarter_gives_the_turned_matrix() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut turned = bench.clone();
    // Clockwise: what was at the left is at the top, what was at the bottom is at the left.
    turned.each_photograph(image::imageops::rotate90);
    let camera = &bench.rig.camera;
    turned.rig.camera.size_px = [camera.size_px[1], camera.size_px[0]];
    turned.rig.camera.principal_px = [camera.size_px[1] as f64 - 1.0 - camera.principal_px[1], camera.principal_px[0]];
    let [width_mm, height_mm] = bench.manifest.slab.size_mm;
    turned.manifest.slab.size_mm = [height_mm, width_mm];
    turned.manifest.window.samples = [7, 9];
    let board = bench.rig.board.clone().unwrap();
    let last = board.origin_mm[1] + (board.inner_corners[1] - 1) as f64 * board.square_mm;
    let changed = turned.rig.board.as_mut().unwrap();
    changed.inner_corners = [board.inner_corners[1], board.inner_corners[0]];
    changed.origin_mm = [height_mm - last, board.origin_mm[0]];
    let found = turned.matrix();
    let off = displaced(&found.0, original.0.lit_mm.iter().map(|p| [height_mm - p[1], p[0]]));
    assert!(off < ELSEWHERE_MM, "{off}");
    let error = difference(&found, &original, |row, [dx, dy], c| (row, [6 - dy, dx], c));
    assert!(error < SEEN_FROM_ELSEWHERE, "{error}");
}

#[test]
fn lengths_in_other_units_scale_the_matrix_by_their_inverse_square() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut larger = bench.clone();
    // A power of two scales without rounding, but that conditions and limits in mm would show.
    let scale = 8.0;
    larger.manifest.slab.size_mm = larger.manifest.slab.size_mm.map(|v| scale * v);
    larger.manifest.window.pitch_mm *= scale;
    let board = larger.rig.board.as_mut().unwrap();
    board.square_mm *= scale;
    board.edge_blur_mm *= scale;
    board.origin_mm = board.origin_mm.map(|v| scale * v);
    let mut found = larger.matrix();
    let off = displaced(&found.0, original.0.lit_mm.iter().map(|p| p.map(|v| scale * v)));
    // Solvers stop at relative steps; 1e-9 of 70 mm.
    assert!(off < 1e-6, "{off}");
    found.1.response.iter_mut().for_each(|r| *r *= (scale * scale) as f32);
    let error = difference(&found, &original, same);
    assert!(error < 1e-5, "{error}");
}

#[test]
fn exchanged_channels_are_exchanged_in_the_matrix_and_change_nothing_else() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut exchanged = bench.clone();
    // R, G, B become B, R, G: a turn, not an exchange of two, so that its inverse is another.
    exchanged.each_photograph(|p| {
        let mut out = p.clone();
        out.pixels_mut().for_each(|p| p.0 = [p.0[2], p.0[0], p.0[1]]);
        out
    });
    let [r, g, b] = bench.rig.white_reference.reflectance;
    exchanged.rig.white_reference.reflectance = [b, r, g];
    let found = exchanged.matrix();
    // Light is summed over channels in another order: rounding of f32 in what is then located to 1e-6 px.
    let off = displaced(&found.0, original.0.lit_mm.iter().copied());
    assert!(off < 1e-4, "{off}");
    let error = difference(&found, &original, |row, sample, c| (row, sample, (c + 1) % 3));
    assert!(error < 1e-4, "{error}");
}

#[test]
fn doubled_exposure_times_change_nothing() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut doubled = bench.clone();
    let entries = doubled.manifest.shots.iter_mut().flat_map(|s| &mut s.photographs);
    entries.for_each(|p| p.exposure_secs = p.exposure_secs.map(|t| 2.0 * t));
    let found = doubled.matrix();
    // A power of two: radiance halves exactly, of dots and reference alike.
    assert_eq!(found.0.lit_mm, original.0.lit_mm);
    assert_eq!(found.1.response, original.1.response);
    assert_eq!(found.1.variance, original.1.variance);
}

#[test]
fn photographs_in_another_order_change_nothing() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut reversed = bench.clone();
    reversed.manifest.shots.iter_mut().for_each(|s| s.photographs.reverse());
    let found = reversed.matrix();
    assert_eq!((&found.0.lit_mm, &found.0.shots), (&original.0.lit_mm, &original.0.shots));
    assert!(found.1 == original.1);
}

#[test]
fn the_order_of_shots_that_are_no_lattice_changes_nothing() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut turned = bench.clone();
    // Gray codes last bit first and y before x; references after them.
    turned.manifest.shots.sort_by_key(|s| match &s.pattern {
        Pattern::GrayCode { axis, bit, inverse, .. } => (0, usize::from(*axis == Axis::X), *bit, usize::from(!inverse)),
        Pattern::Lattice { .. } => (2, 0, 0, 0),
        _ => (1, 0, 0, 0),
    });
    assert_ne!(turned.manifest.shots[0].name, bench.manifest.shots[0].name);
    let found = turned.matrix();
    // The stripes' edges are summed in another order: f64.
    let off = displaced(&found.0, original.0.lit_mm.iter().copied());
    assert!(off < 1e-6, "{off}");
    let error = difference(&found, &original, same);
    assert!(error < 1e-5, "{error}");
}

#[test]
fn a_part_of_the_shots_gives_that_part_of_the_rows() {
    let bench = Bench::simulated(&options());
    let original = bench.matrix();
    let mut part = bench.clone();
    let mut kept = Vec::new();
    let mut n = 0;
    part.manifest.shots.retain(|s| {
        let Pattern::Lattice { dots } = &s.pattern else { return true };
        n += 1;
        let keep = n % 3 != 2;
        kept.extend(dots.iter().filter(|_| keep).map(|d| d[1] * 4 + d[0]));
        keep
    });
    assert!(kept.len() >= 6 && kept.len() < 12, "{kept:?}");
    let found = part.matrix();
    let per_row = found.0.row_len();
    for row in 0..12 {
        let range = row * per_row..(row + 1) * per_row;
        if !kept.contains(&row) {
            assert!(found.1.valid[range].iter().all(|v| *v == 0), "row {row}");
            continue;
        }
        let (a, b) = (&found.1.response[range.clone()], &original.1.response[range]);
        let norm: f64 = b.iter().map(|v| f64::from(*v).powi(2)).sum();
        let error: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        // What all shots tell together (the halo of the lens, the steadied white) is known a little less well from
        // fewer.
        assert!((error / norm).sqrt() < 1e-3, "row {row}: {}", (error / norm).sqrt());
        let off = displaced_row(&found.0, &original.0, row);
        assert!(off < 1e-3, "row {row}: {off}");
    }
}

fn displaced_row(a: &MatrixHeader, b: &MatrixHeader, row: usize) -> f64 {
    (a.lit_mm[row][0] - b.lit_mm[row][0]).hypot(a.lit_mm[row][1] - b.lit_mm[row][1])
}

#[test]
fn a_curve_that_the_rig_tells_is_taken_out() {
    // The same light through the sRGB curve, in 16 bits: the curve's rounding is far below the noise.
    let linear = options();
    let encoded = SimulateOptions { response_curve: Some(CameraCurve::Srgb), ..options() };
    let [a, b] = [linear, encoded].map(|o| {
        let (_folder, dir) = common::capture(&o);
        build(&dir)
    });
    // Encoded files have lost what lay below the pedestal: a per cent or two of the noise's share of each.
    let error = difference(&a, &b, same);
    assert!(error < 0.01, "{error}");
}
