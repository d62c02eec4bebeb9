//! From a matrix on disk to a material: recovery of known factors, the choices made from noise, and extremes.

mod common;

use acquire::evaluate::evaluate;
use acquire::factor::{Backend, Factored, Options, factor};
use acquire::material::{Material, Source};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row};
use acquire::{Error, Result, Warning};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use std::path::Path;

/// A matrix of `points` rows: `response(index, [dx, dy] in samples from the lit point, channel)`.
fn write(
    path: &Path,
    points: [usize; 2],
    window: [usize; 2],
    variance: impl Fn([f64; 2], usize) -> f32,
    position_sd_mm: f64,
    response: impl Fn(usize, [f64; 2], usize) -> f32,
) -> Result<MatrixReader> {
    let rows = points[0] * points[1];
    let header = MatrixHeader {
        points,
        window,
        pitch_mm: 0.5,
        lit_pitch_mm: [0.5, 0.5],
        lit_mm: (0..rows).map(|i| [(i % points[0]) as f64 * 0.5, (i / points[0]) as f64 * 0.5]).collect(),
        position_sd_mm: vec![position_sd_mm; rows],
        shot_of: vec![None; rows],
        shots: Vec::new(),
        warnings: Vec::new(),
        provenance: serde_json::json!({}),
    };
    let writer = MatrixWriter::create(path, header.clone())?;
    for index in 0..rows {
        let offset = |k: usize| header.offset_px([k / 3 % window[0], k / 3 / window[0]]).map(|o| o as f64);
        let n = header.row_len();
        let row = Row {
            response: (0..n).map(|k| response(index, offset(k), k % 3)).collect(),
            variance: (0..n).map(|k| variance(offset(k), k % 3)).collect(),
            valid: vec![true; n],
        };
        writer.put(index, &row)?;
    }
    writer.finish()?;
    MatrixReader::open(path)
}

fn run(
    options: &Options,
    points: [usize; 2],
    window: [usize; 2],
    response: impl Fn(usize, [f64; 2], usize) -> f32,
) -> Result<Factored> {
    let folder = tempfile::tempdir().unwrap();
    let reader = write(&folder.path().join("m.rd.zarr"), points, window, |_, _| 0.0, 0.0, response)?;
    let factored = factor(&reader, options, &Progress::silent())?;
    // Whatever comes out can be stored and comes back.
    let path = folder.path().join("m.safetensors");
    factored.material.save(&path)?;
    assert_eq!(Material::load(&path)?.weights, factored.material.weights);
    Ok(factored)
}

fn profile([x, y]: [f64; 2], width: f64) -> f64 {
    (-(x * x + y * y).sqrt() / width).exp()
}

fn noise(index: usize, d: [f64; 2], c: usize) -> f64 {
    let seed = (index as u64) << 32 | ((d[0] + 500.0) as u64) << 18 | ((d[1] + 500.0) as u64) << 4 | c as u64;
    StandardNormal.sample(&mut rand_pcg::Pcg64::seed_from_u64(seed))
}

fn fixed(terms: usize, degree: usize) -> Options {
    Options { terms: Some(terms), degree: Some(degree), ..Options::default() }
}

#[test]
fn a_homogeneous_gray_slab_is_one_term_and_a_straight_line() {
    let f =
        run(&Options::default(), [8, 8], [11, 11], |_, d, c| (profile(d, 2.0) * [1.0, 0.7, 0.4][c]) as f32).unwrap();
    assert_eq!((f.material.header.terms, f.material.header.degree), (1, Some(1)), "{}", f.choice);
    assert!(f.rel_rmse < 1e-6, "f32 rounding: {}", f.rel_rmse);
}

#[test]
fn a_noisy_homogeneous_slab_is_one_term() {
    const GAIN: [f64; 3] = [1.0, 0.7, 0.4];
    let bell = |d: [f64; 2]| (-(d[0] * d[0] + d[1] * d[1]) / 8.0).exp();
    let folder = tempfile::tempdir().unwrap();
    for (sd, position_sd_mm) in [(0.003, 0.0), (0.03, 0.0), (0.003, 0.05)] {
        let sd_px = position_sd_mm / 0.5;
        // As the pipeline states it: photons, and the uncertain place times the slope.
        let variance = |d: [f64; 2], c: usize| {
            let slope2 = bell(d).powi(2) * (d[0] * d[0] + d[1] * d[1]) / 16.0;
            (sd * sd + (sd_px * GAIN[c]).powi(2) * slope2) as f32
        };
        let response = |i: usize, d: [f64; 2], c: usize| {
            let off = |a: usize| sd_px * noise(i + 100_000, [a as f64, 0.0], 0);
            (GAIN[c] * bell([d[0] + off(0), d[1] + off(1)]) + sd * noise(i, d, c)) as f32
        };
        let path = folder.path().join("m.rd.zarr");
        let reader = write(&path, [12, 12], [15, 15], variance, position_sd_mm, response).unwrap();
        let f = factor(&reader, &Options::default(), &Progress::silent()).unwrap();
        let found = (f.material.header.terms, f.material.header.degree);
        assert_eq!(found, (1, Some(1)), "sd {sd}, position {position_sd_mm}: {}", f.choice);
    }
}

#[test]
fn three_clear_terms_in_noise_are_three_terms() {
    let folder = tempfile::tempdir().unwrap();
    let reader = write(
        &folder.path().join("m.rd.zarr"),
        [16, 16],
        [15, 15],
        |_, _| 1e-6,
        0.0,
        |i, d, c| {
            let (a, b) = ((i % 16) as f64 / 16.0, (i / 16) as f64 / 16.0);
            let rest = 1.0 - 0.5 * a - 0.4 * b;
            let value = rest * profile(d, 1.0) + 0.5 * a * profile(d, 2.0) + 0.4 * b * profile(d, 5.0);
            (value + 1e-3 * noise(i, d, c)) as f32
        },
    )
    .unwrap();
    let options = Options { peak_shift: false, ..Options::default() };
    let f = factor(&reader, &options, &Progress::silent()).unwrap();
    assert_eq!(f.material.header.terms, 3, "{}", f.choice);
}

#[test]
fn every_back_end_gives_the_same_material() {
    let response = |i: usize, d: [f64; 2], c: usize| {
        (profile(d, 1.0 + (i % 7) as f64 / 3.0) * (1.0 + 0.2 * c as f64 + 0.1 * (i / 7) as f64)) as f32
    };
    let of = |backend| run(&Options { backend: Some(backend), ..fixed(3, 3) }, [7, 6], [9, 9], response).unwrap();
    let full = of(Backend::Full);
    for backend in [Backend::Gram, Backend::Subspace] {
        let other = of(backend);
        for i in 0..42 {
            for (a, b) in full.material.evaluate_row(i).iter().zip(other.material.evaluate_row(i)) {
                // Both are rounded to f32; the cubic amplifies a few times.
                assert!((a - b).abs() < 1e-5, "{backend:?} row {i}: {a} {b}");
            }
        }
    }
}

#[test]
fn shifted_peaks_come_back_where_they_were_measured() {
    let centre = |i: usize| [(i % 3) as f64 - 1.0, (i / 3 % 3) as f64 - 1.0];
    let response = |i: usize, d: [f64; 2], c: usize| {
        (profile([d[0] - centre(i)[0], d[1] - centre(i)[1]], 2.0) * (1.0 + c as f64)) as f32
    };
    let f = run(&fixed(1, 1), [6, 6], [13, 13], response).unwrap();
    assert_eq!(f.material.header.extended, [15, 15]);
    for i in 0..36 {
        assert_eq!(f.material.shift[i].map(f64::from), centre(i));
        assert_eq!(f.material.response(i, centre(i).map(|v| v as isize)).unwrap()[0], {
            let row = f.material.evaluate_row(i);
            row.iter().step_by(3).copied().fold(0.0, f32::max)
        });
    }
    // One profile in nine places: one term once shifted. What the rows miss of the common window is filled by
    // the mean and two rounds of refinement; exact up to f32.
    assert!(f.rel_rmse < 1e-5, "{}", f.rel_rmse);
    let unshifted = run(&Options { peak_shift: false, ..fixed(1, 1) }, [6, 6], [13, 13], response).unwrap();
    assert!(unshifted.rel_rmse > 0.1, "{}", unshifted.rel_rmse);
}

#[test]
fn samples_that_were_not_measured_do_not_cost_terms() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let reader = write(&path, [8, 8], [9, 9], |_, _| 0.0, 0.0, |_, d, _| profile(d, 2.0) as f32).unwrap();
    let (header, rows) = (reader.header().clone(), header_rows(&reader));
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    for (i, mut row) in rows.into_iter().enumerate() {
        // A slab whose rim cuts windows.
        for k in 0..header.row_len() {
            let d = header.offset_px([k / 3 % 9, k / 3 / 9]);
            let (x, y) = ((i % 8) as isize + d[0], (i / 8) as isize + d[1]);
            if !(0..8).contains(&x) || !(0..8).contains(&y) {
                (row.response[k], row.valid[k]) = (0.0, false);
            }
        }
        writer.put(i, &row).unwrap();
    }
    writer.finish().unwrap();
    let f = factor(&MatrixReader::open(&path).unwrap(), &Options::default(), &Progress::silent()).unwrap();
    assert_eq!(f.material.header.terms, 1, "{}", f.choice);
    assert!(f.rel_rmse < 1e-6, "{}", f.rel_rmse);
}

fn header_rows(reader: &MatrixReader) -> Vec<Row> {
    let block = reader.read(0..reader.header().rows()).unwrap();
    (0..block.rows)
        .map(|k| {
            let row = block.view(k);
            let valid = row.valid.iter().map(|&v| v != 0).collect();
            Row { response: row.response.to_vec(), variance: row.variance.to_vec(), valid }
        })
        .collect()
}

#[test]
fn rows_of_zeros_are_kept_as_zeros_and_reported() {
    let f =
        run(&Options::default(), [4, 4], [5, 5], |i, d, _| if i == 5 { 0.0 } else { profile(d, 1.0) as f32 }).unwrap();
    assert!(f.material.header.warnings.contains(&Warning::EmptyRows { rows: 1 }));
    assert!(f.material.evaluate_row(5).iter().all(|&v| v == 0.0));
    let all = run(&Options::default(), [3, 3], [5, 5], |_, _, _| 0.0).unwrap();
    assert!(all.material.evaluate_row(0).iter().all(|&v| v == 0.0));
    assert_eq!(all.rel_rmse, 0.0);
}

#[test]
fn extremes_of_shape_and_value_give_finite_materials() {
    let one = |_: usize, d: [f64; 2], _: usize| if d == [0.0, 0.0] { 2.0 } else { 0.0 };
    type Case<'a> = (&'a str, [usize; 2], [usize; 2], &'a dyn Fn(usize, [f64; 2], usize) -> f32);
    let cases: [Case<'_>; 8] = [
        ("one entry", [3, 3], [5, 5], &|i, d, c| if i == 4 { one(i, d, c) } else { 0.0 }),
        ("constant rows", [4, 4], [5, 5], &|i, _, c| 1.0 + i as f32 + c as f32),
        ("one row", [1, 1], [7, 7], &|_, d, _| profile(d, 2.0) as f32),
        ("one offset", [5, 5], [1, 1], &|i, _, c| (1 + i + c) as f32),
        ("one of each", [1, 1], [1, 1], &|_, _, _| 3.0),
        ("peak on the rim", [3, 3], [5, 5], &|_, d, _| if d == [-2.0, 2.0] { 9.0 } else { 1.0 }),
        ("negative tails", [4, 4], [5, 5], &|i, d, c| (profile(d, 0.5) + 0.01 * noise(i, d, c)) as f32),
        ("scales", [4, 4], [5, 5], &|i, d, _| profile(d, 1.0) as f32 * if i % 2 == 0 { 1e-30 } else { 1e30 }),
    ];
    for (name, points, window, response) in cases {
        for (terms, degree) in [(None, None), (Some(1), Some(0)), (Some(100), Some(15))] {
            let f = run(&Options { terms, degree, ..Options::default() }, points, window, response).unwrap();
            assert!(f.rel_rmse.is_finite() && f.rel_rmse <= 1.0, "{name} {terms:?}: {}", f.rel_rmse);
            // Three channels of independent noise are no function of one intensity.
            if degree == Some(15) && name != "negative tails" {
                assert!(f.rel_rmse < 1e-4, "{name}: enough terms and degrees for anything, {}", f.rel_rmse);
            }
            let rows = points[0] * points[1];
            assert!((0..rows).all(|i| f.material.evaluate_row(i).iter().all(|v| v.is_finite())), "{name}");
        }
    }
}

#[test]
fn more_terms_than_the_rows_have_are_not_made_up() {
    let f = run(&fixed(15, 1), [4, 4], [5, 5], |_, d, _| profile(d, 1.0) as f32).unwrap();
    assert_eq!(f.material.header.terms, 1);
    assert!(f.choice.contains("15 were asked for"), "{}", f.choice);
}

#[test]
fn bad_settings_and_numbers_that_are_not_finite_are_refused() {
    for options in [fixed(0, 1), fixed(1, 16)] {
        let refused = run(&options, [2, 2], [3, 3], |_, _, _| 1.0);
        assert!(matches!(refused, Err(Error::Setting { .. })), "{refused:?}");
    }
    for bad in [f32::NAN, f32::INFINITY] {
        let refused = run(&fixed(1, 1), [2, 2], [3, 3], |i, _, _| if i == 2 { bad } else { 1.0 });
        assert!(refused.is_err(), "{bad}");
    }
}

/// The matrix of a simulated capture and what `options` make of it.
fn simulated(slab: &simulate::Options, options: &Options) -> (tempfile::TempDir, MatrixReader, Factored) {
    let (folder, dir) = common::capture(slab);
    let path = folder.path().join("m.rd.zarr");
    build_matrix(&dir, &BuildOptions::default(), &path, &Progress::silent()).unwrap();
    let reader = MatrixReader::open(&path).unwrap();
    let factored = factor(&reader, options, &Progress::silent()).unwrap();
    (folder, reader, factored)
}

#[test]
fn a_drifted_capture_factors_as_well_as_an_undrifted_one_to_within_one_decibel() {
    let psnr_db = |drift_px: f64| {
        let slab = simulate::Options {
            material: simulate::Material::chessboard(4),
            grid: 12,
            window: 15,
            drift_px,
            ..simulate::Options::default()
        };
        let (folder, reader, factored) = simulated(&slab, &fixed(15, 7));
        let path = folder.path().join("m.safetensors");
        factored.material.save(&path).unwrap();
        evaluate(&Source::open(&path).unwrap(), &reader, &Progress::silent()).unwrap().psnr_db.unwrap()
    };
    let (still, drifted) = (psnr_db(0.0), psnr_db(1.0));
    // The decibel is what the project promises.
    assert!((still - drifted).abs() < 1.0, "{still} dB without drift, {drifted} dB with");
}

#[test]
fn a_homogeneous_slab_chooses_one_term_and_a_degree_that_ends_at_the_noise() {
    let slab = simulate::Options { grid: 12, window: 15, ..simulate::Options::default() };
    let (_folder, _, factored) = simulated(&slab, &Options::default());
    assert_eq!(factored.material.header.terms, 1, "{}", factored.choice);
    assert!(factored.choice.contains("explains no more than noise"), "{}", factored.choice);
}
