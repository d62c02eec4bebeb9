//! Factorization at the extremes of shape and value. Every bound says where it comes from; singular values and the best
//! polynomials come from `tests/tables/extremes.py`, in 160 and 100 digits.

use crate::matrices::{fixed, noise, profile, run, tucker, write};
use acquire::factor::{Backend, FactorOptions, Factored, Goal, factor};
use acquire::material::Model;
use acquire::progress::Progress;
use acquire::transport::MatrixReader;
use acquire::{Error, FactorWarning};
use serde_json::Value;
use std::sync::Arc;

const BACKENDS: [Backend; 3] = [Backend::Full, Backend::Gram, Backend::Randomized];
/// What iterating back ends are asked for: the best that products in f32 allow.
const ACCURACY: f64 = 1e-6;
/// Half the distance of neighbouring f32, relative.
const ROUNDING: f64 = f32::EPSILON as f64 / 2.0;
/// Smallest positive f32.
const SUBNORMAL: f64 = 1.401_298_464_324_817e-45;
/// What a row of one term may be off, of its peak: weight, two factors, the coefficients of a straight line (the
/// larger of them below twice the peak) and the result are each rounded to f32.
const ONE_TERM: f64 = 9.0 * ROUNDING;

/// The largest difference between row `index` of the material and `expected`, over the largest of `expected`.
fn row_error(f: &Factored, index: usize, expected: impl Fn([f64; 2], usize) -> f32) -> f64 {
    let [wx, wy] = f.material.header.window;
    let row = f.material.evaluate_row(index);
    assert_eq!(row.len(), wx * wy * 3);
    let (mut error, mut peak) = (0.0_f64, 0.0_f64);
    for (k, found) in row.into_iter().enumerate() {
        let d = [k / 3 % wx, k / 3 / wx];
        let d = [d[0] as f64 - (wx / 2) as f64, d[1] as f64 - (wy / 2) as f64];
        let expected = f64::from(expected(d, k % 3));
        assert!(found.is_finite(), "row {index}, {d:?}: {found}");
        (error, peak) = (error.max((f64::from(found) - expected).abs()), peak.max(expected.abs()));
    }
    error / peak
}

/// What the square root of an eigenvalue of AᵀA is off by when the products are in f64 (1e-15 of the largest) or in f32
/// (3e-7).
fn gram_error(backend: Backend, largest: f64, value: f64) -> f64 {
    let relative: f64 = match backend {
        Backend::Full => return 0.0,
        Backend::Gram => 1e-15,
        _ => 3e-7,
    };
    largest * (relative * largest / value).min(relative.sqrt())
}

fn number(text: &Value) -> f64 {
    text.as_str().map_or_else(|| text.as_f64().unwrap(), |t| t.parse().unwrap())
}

fn numbers(list: &Value) -> Vec<f64> {
    list.as_array().unwrap().iter().map(number).collect()
}

/// Grey rows of a case of `singular.json`, 4 × 2 points and 3 × 3 samples, and their singular values.
struct Table {
    name: String,
    entries: Vec<f64>,
    normalized: Vec<f64>,
    plain: Vec<f64>,
}

impl Table {
    fn response(&self, index: usize, d: [f64; 2]) -> f32 {
        self.entries[index * 9 + ((d[1] + 1.0) * 3.0 + d[0] + 1.0) as usize] as f32
    }

    fn all() -> Vec<Self> {
        let tables: Value = serde_json::from_str(include_str!("../tables/singular.json")).unwrap();
        assert_eq!((tables["rows"].as_u64(), tables["columns"].as_u64()), (Some(8), Some(9)));
        let cases = tables["cases"].as_array().unwrap().iter();
        cases
            .map(|case| Self {
                name: case["name"].as_str().unwrap().into(),
                entries: numbers(&case["entries"]),
                normalized: numbers(&case["normalized"]),
                plain: numbers(&case["plain"]),
            })
            .collect()
    }

    fn options(&self, backend: Backend) -> FactorOptions {
        FactorOptions { peak_shift: false, backend: Some(backend), accuracy: ACCURACY, ..fixed(8, 1) }
    }

    fn factored(&self, backend: Backend) -> Factored {
        run(&self.options(backend), [4, 2], [3, 3], |i, d, _| self.response(i, d)).unwrap()
    }
}

#[test]
fn singular_values_are_those_of_extended_precision() {
    for table in Table::all() {
        for backend in BACKENDS {
            let f = table.factored(backend);
            let (found, largest) = (&f.material.header.singular_values, table.normalized[0]);
            assert!(found.len() >= f.material.header.terms);
            for (k, (found, expected)) in found.iter().zip(&table.normalized).enumerate() {
                // Normalized rows are held as f32: ‖δA‖ is at most one rounding of the Frobenius norm. Beyond that the
                // full decomposition adds nothing, and the others what an eigenvalue of AᵀA is off by.
                let held = ROUNDING * table.normalized.iter().map(|v| v * v).sum::<f64>().sqrt();
                let bound = held + gram_error(backend, largest, *expected);
                let name = &table.name;
                assert!((found - expected).abs() <= bound, "{name}, {backend:?}, {k}: {found:e} {expected:e}");
            }
        }
    }
}

#[test]
fn joint_has_the_singular_values_of_the_rows_as_they_are_measured() {
    for table in Table::all() {
        for backend in BACKENDS {
            let model = Some(Model::Joint);
            let plain = FactorOptions { maps: Some(false), profile_power: 0.0, ..table.options(backend) };
            let options = FactorOptions { model, degree: None, ..plain };
            // Another response for every channel: 1, 2 and 4 times the row, √21 of its norm.
            let gain = |c: usize| [1.0, 2.0, 4.0][c] * if table.name.contains("1e30") { 0.25 } else { 1.0 };
            let response = |i: usize, d: [f64; 2], c: usize| table.response(i, d) * gain(c) as f32;
            let f = run(&options, [4, 2], [3, 3], response).unwrap();
            let scale = gain(0) * 21_f64.sqrt();
            let (found, largest) = (&f.material.header.singular_values, table.plain[0] * scale);
            for (k, (found, expected)) in found.iter().zip(&table.plain).enumerate() {
                let expected = expected * scale;
                let bound = 2.0 * ROUNDING * largest + gram_error(backend, largest, expected);
                let name = &table.name;
                assert!((found - expected).abs() <= bound, "{name}, {backend:?}, {k}: {found:e} {expected:e}");
            }
            // What is left is what the values that were left out hold: no row is off by more than they are.
            let terms = f.material.header.terms;
            let left = table.plain[terms..].iter().map(|v| v * v).sum::<f64>().sqrt() * scale;
            let least = table.plain[terms - 1] * scale;
            let bound =
                left + (3.0 * ROUNDING * (terms as f64).sqrt() + 1e-7) * largest + gram_error(backend, largest, least);
            for i in 0..8 {
                for (k, found) in f.material.evaluate_row(i).into_iter().enumerate() {
                    let expected = table.entries[i * 9 + k / 3] * gain(k % 3);
                    let off = (f64::from(found) - expected).abs();
                    assert!(off <= bound, "{}, {backend:?}, row {i}: {off:e} > {bound:e}", table.name);
                }
            }
        }
    }
}

#[test]
fn rows_of_any_scale_come_back_to_their_own_precision() {
    for table in Table::all() {
        for backend in BACKENDS {
            let f = table.factored(backend);
            // One rounding for each of three numbers of each term, the sum of whose magnitudes is below √terms times
            // the row's norm, 3 at most; the rest as with one term. Terms below 6e-8 of the largest are left out,
            // and a direction that AᵀA gives loses as much as its value is off by.
            let terms = f.material.header.terms as f64;
            let least = table.normalized.iter().rfind(|&&v| v > 6e-8 * table.normalized[0]).unwrap();
            let left_out = 6e-8 * table.normalized[0] + gram_error(backend, table.normalized[0], *least);
            let bound = ONE_TERM + 3.0 * ROUNDING * 3.0 * terms.sqrt() + left_out;
            for i in 0..8 {
                let peak = (0..9).map(|k| table.entries[i * 9 + k]).fold(0.0, f64::max);
                if peak == 0.0 {
                    assert!(f.material.evaluate_row(i).iter().all(|&v| v == 0.0), "{}, row {i}", table.name);
                    continue;
                }
                // Both coefficients and the result are rounded to multiples of the smallest subnormal.
                let (error, bound) = (row_error(&f, i, |d, _| table.response(i, d)), bound + 2.0 * SUBNORMAL / peak);
                assert!(error <= bound, "{}, {backend:?}, row {i}: {error:e} > {bound:e}", table.name);
            }
        }
    }
}

/// The best fit of one degree to the row of `polynomials.json`.
struct Best {
    degree: usize,
    residual_norm: Vec<f64>,
    fitted: Vec<Vec<f64>>,
}

/// Offset and responses of the samples of an eighth of the window.
type Samples = Vec<([u64; 2], Vec<f64>)>;

fn polynomials() -> (Samples, Vec<Best>) {
    let table: Value = serde_json::from_str(include_str!("../tables/polynomials.json")).unwrap();
    let offset = |v: &Value| [v["offset"][0].as_u64().unwrap(), v["offset"][1].as_u64().unwrap()];
    let samples = table["samples"].as_array().unwrap().iter().map(|v| (offset(v), numbers(&v["rgb"]))).collect();
    let best = |fit: &Value| Best {
        degree: fit["degree"].as_u64().unwrap() as usize,
        residual_norm: numbers(&fit["residual_norm"]),
        fitted: fit["fitted"].as_array().unwrap().iter().map(numbers).collect(),
    };
    (samples, table["fits"].as_array().unwrap().iter().map(best).collect())
}

#[test]
fn polynomials_of_a_steep_row_are_as_good_as_any_in_extended_precision() {
    let (samples, fits) = polynomials();
    // The eighth of the window that the table holds.
    let folded = |d: [f64; 2]| {
        let (a, b) = (d[0].abs() as u64, d[1].abs() as u64);
        samples.iter().position(|(o, _)| *o == [a.max(b), a.min(b)]).unwrap()
    };
    for best in fits {
        let f = run(&fixed(1, best.degree), [2, 2], [31, 31], |_, d, c| samples[folded(d)].1[c] as f32).unwrap();
        let (mut left, mut size, mut furthest) = ([0.0; 3], [0.0; 3], 0.0_f64);
        for (k, found) in f.material.evaluate_row(3).into_iter().enumerate() {
            let at = folded([(k / 3 % 31) as f64 - 15.0, (k / 3 / 31) as f64 - 15.0]);
            let (c, exact) = (k % 3, samples[at].1[k % 3]);
            left[c] += (f64::from(found) - exact).powi(2);
            size[c] += exact * exact;
            furthest = furthest.max((f64::from(found) - best.fitted[at][c]).abs());
        }
        for c in 0..3 {
            let (found, optimal) = (left[c].sqrt(), best.residual_norm[c]);
            let rounding = 4.0 * ROUNDING * size[c].sqrt();
            // To degree 7 coefficients are below ten times the row. At 15 the columns' condition number is 4e11 and the
            // best coefficients are near 1e6, of no use in f32: misfit and rounding together are least at 1.5 of the
            // best.
            let slack = if best.degree <= 7 { 1e-4 } else { 0.6 };
            assert!(found >= optimal - rounding, "degree {}: {found} beats the best, {optimal}", best.degree);
            assert!(found <= optimal * (1.0 + slack) + rounding, "degree {}: {found} {optimal}", best.degree);
        }
        if best.degree <= 7 {
            // The fit moves with the arguments, whose factors are rounded to f32, by its slope: less than ten.
            assert!(furthest < 20.0 * ROUNDING, "degree {}: {furthest:e}", best.degree);
        }
    }
}

#[test]
fn degree_zero_is_the_mean_of_each_channel() {
    let response = |i: usize, d: [f64; 2], c: usize| ((1 + i) as f64 * profile(d, 1.5) * [1.0, 0.5, 2.0][c]) as f32;
    let f = run(&fixed(1, 0), [2, 2], [5, 5], response).unwrap();
    for i in 0..4 {
        for c in 0..3 {
            let offsets = (0..25).map(|k| [(k % 5) as f64 - 2.0, (k / 5) as f64 - 2.0]);
            let mean = offsets.map(|d| f64::from(response(i, d, c))).sum::<f64>() / 25.0;
            for found in f.material.evaluate_row(i).into_iter().skip(c).step_by(3) {
                // one coefficient, rounded once
                assert!((f64::from(found) - mean).abs() <= 2.0 * ROUNDING * mean, "{found} {mean}");
            }
        }
    }
}

#[test]
fn rows_of_zeros_are_kept_as_zeros_and_reported() {
    let response = |i: usize, d: [f64; 2], _: usize| if i == 5 { 0.0 } else { profile(d, 1.0) as f32 };
    let f = run(&tucker(), [4, 4], [5, 5], response).unwrap();
    assert!(f.warnings.contains(&FactorWarning::EmptyRows { rows: 1 }));
    assert!(f.material.evaluate_row(5).iter().all(|&v| v == 0.0));
    assert!(row_error(&f, 6, |d, c| response(6, d, c)) <= ONE_TERM);
    let all = run(&tucker(), [3, 3], [5, 5], |_, _, _| 0.0).unwrap();
    assert!(all.warnings.contains(&FactorWarning::EmptyRows { rows: 9 }));
    assert!(all.material.evaluate_row(0).iter().all(|&v| v == 0.0));
    assert_eq!(all.rel_rmse, 0.0);
}

#[test]
fn one_entry_that_is_not_zero_comes_back_alone() {
    let response = |i: usize, d: [f64; 2], c: usize| {
        if i == 4 && d == [0.0, 0.0] { [2.0, 1.0, 0.25][c] } else { 0.0_f32 }
    };
    for options in [fixed(1, 1), fixed(15, 7), tucker()] {
        let f = run(&options, [3, 3], [5, 5], response).unwrap();
        assert_eq!(f.material.header.terms, 1);
        assert!(f.warnings.contains(&FactorWarning::EmptyRows { rows: 8 }));
        for i in 0..9 {
            if i == 4 {
                assert!(row_error(&f, i, |d, c| response(i, d, c)) <= ONE_TERM);
            } else {
                assert!(f.material.evaluate_row(i).iter().all(|&v| v == 0.0), "row {i}");
            }
        }
    }
}

#[test]
fn constant_rows_whose_polynomial_is_undetermined_come_back() {
    let response = |i: usize, _: [f64; 2], c: usize| (1 + i * i + c) as f32 * 0.1;
    for (terms, degree) in [(1, 0), (1, 1), (1, 7), (15, 15)] {
        let f = run(&fixed(terms, degree), [4, 4], [5, 5], response).unwrap();
        assert_eq!(f.material.header.terms, 1, "{}", f.choice);
        for i in 0..16 {
            let error = row_error(&f, i, |d, c| response(i, d, c));
            assert!(error <= ONE_TERM, "degree {degree}, row {i}: {error:e}");
        }
    }
}

#[test]
fn one_row_and_one_column_are_exact() {
    let steep = |_: usize, d: [f64; 2], c: usize| (profile(d, 2.0) * [1.0, 0.7, 0.4][c]) as f32;
    let f = run(&fixed(3, 1), [1, 1], [7, 7], steep).unwrap();
    assert_eq!(f.material.header.terms, 1);
    assert!(row_error(&f, 0, |d, c| steep(0, d, c)) <= ONE_TERM);
    let number = |i: usize, _: [f64; 2], c: usize| (1 + i + 2 * c) as f32;
    for points in [[5, 5], [1, 1]] {
        let f = run(&fixed(3, 7), points, [1, 1], number).unwrap();
        for i in 0..points[0] * points[1] {
            assert!(row_error(&f, i, |d, c| number(i, d, c)) <= ONE_TERM);
        }
    }
}

#[test]
fn more_terms_than_the_rows_have_are_not_made_up() {
    let f = run(&fixed(15, 1), [4, 4], [5, 5], |_, d, _| profile(d, 1.0) as f32).unwrap();
    assert_eq!(f.material.header.terms, 1);
    assert!(f.choice.contains("15 asked, all that"), "{}", f.choice);
}

#[test]
fn repeated_rows_have_the_rank_of_those_that_differ_and_equal_responses() {
    let response = |i: usize, d: [f64; 2], _: usize| profile(d, 1.0 + (i % 3) as f64) as f32;
    for backend in BACKENDS {
        let options = FactorOptions { backend: Some(backend), ..fixed(15, 1) };
        let f = run(&options, [5, 5], [7, 7], response).unwrap();
        // The Gram matrix cannot tell values below 3e-8 of the largest from zero; they are below what f32 resolves.
        assert_eq!(f.material.header.terms, 3, "{backend:?}: {:?}", f.material.header.singular_values);
        for i in 0..25 {
            assert_eq!(f.material.evaluate_row(i), f.material.evaluate_row(i % 3), "{backend:?}, row {i}");
            assert!(row_error(&f, i, |d, c| response(i, d, c)) <= 3.0 * ONE_TERM, "three terms");
        }
    }
}

#[test]
fn of_two_equal_peaks_the_nearer_then_the_first_goes_to_the_centre() {
    let bump = |d: [f64; 2], at: [f64; 2]| profile([d[0] - at[0], d[1] - at[1]], 0.3);
    for (peaks, shift) in [([[2.0, 0.0], [-2.0, 0.0]], [-2, 0]), ([[0.0, 2.0], [1.0, 0.0]], [1, 0])] {
        let response = |_: usize, d: [f64; 2], _: usize| (bump(d, peaks[0]) + bump(d, peaks[1])) as f32;
        let f = run(&fixed(2, 1), [3, 3], [11, 11], response).unwrap();
        for i in 0..9 {
            assert_eq!(f.material.shift[i], shift);
            let error = row_error(&f, i, |d, c| response(i, d, c));
            assert!(error <= ONE_TERM, "{error:e}");
        }
    }
}

#[test]
fn a_peak_on_the_rim_is_reported_and_comes_back() {
    let response = |i: usize, d: [f64; 2], _: usize| {
        let peak = if i == 4 { [-4.0, 4.0] } else { [0.0, 0.0] };
        profile([d[0] - peak[0], d[1] - peak[1]], 2.0) as f32
    };
    let limited = run(&fixed(2, 1), [3, 3], [9, 9], response).unwrap();
    assert!(limited.warnings.iter().any(|w| matches!(w, FactorWarning::ShiftLimited { rows: 1, .. })));
    assert_eq!(limited.material.shift[4], [-2, 2], "the brightest within reach");
    // Allowed to go there, it shares a quarter of the common window with the others.
    let moved = run(&FactorOptions { max_shift: Some(4), ..fixed(1, 1) }, [3, 3], [9, 9], response).unwrap();
    assert_eq!((moved.material.shift[4], moved.material.header.extended), ([-4, 4], [17, 17]));
    assert!(moved.material.header.warnings.is_empty(), "{:?}", moved.material.header.warnings);
    for i in 0..9 {
        let error = row_error(&moved, i, |d, c| response(i, d, c));
        // One profile, whose parts that nobody measured are estimated by the ridge's 1e-6 of the peak.
        assert!(error <= ONE_TERM + 1e-6, "row {i}: {error:e}");
    }
}

#[test]
fn negative_entries_around_zero_keep_their_sign() {
    let response = |i: usize, d: [f64; 2], _: usize| (profile(d, 0.5) + 0.01 * noise(i, d, 0)) as f32;
    let f = run(&fixed(40, 1), [4, 4], [5, 5], response).unwrap();
    assert_eq!(f.material.header.terms, 16, "noise has full rank");
    for i in 0..16 {
        let error = row_error(&f, i, |d, c| response(i, d, c));
        // 16 terms, of which the first is the peak and the others are hundredths of it
        assert!(error <= 3.0 * ONE_TERM, "row {i}: {error:e}");
    }
    // A row that is nowhere above zero has no peak to be divided by.
    let dark = |i: usize, d: [f64; 2], c: usize| if i == 3 { -0.01 } else { response(i, d, c) };
    let f = run(&fixed(40, 1), [4, 4], [5, 5], dark).unwrap();
    assert!(f.warnings.contains(&FactorWarning::EmptyRows { rows: 1 }));
    assert!(f.material.evaluate_row(3).iter().all(|v| v.is_finite()));
}

#[test]
fn responses_near_the_largest_number_come_back_or_are_refused_by_name() {
    for largest in [1e30_f32, f32::MAX] {
        let response = |_: usize, d: [f64; 2], _: usize| (f64::from(largest) * profile(d, 1.0)) as f32;
        match run(&fixed(1, 1), [3, 3], [5, 5], response) {
            Ok(f) => assert!(row_error(&f, 4, |d, c| response(4, d, c)) <= ONE_TERM, "{largest:e}"),
            // Coefficients beyond 1e30 are refused, at the latest when the file is read.
            Err(e) => assert!(
                matches!(e, Error::NotFinite { .. } | Error::BrokenMaterial { .. }) && largest > 1e38,
                "{largest:e}: {e:?}"
            ),
        }
    }
}

#[test]
fn numbers_that_are_not_finite_are_refused_with_their_place() {
    let folder = tempfile::tempdir().unwrap();
    for (k, (field, bad)) in
        [("response", f32::NAN), ("response", f32::INFINITY), ("variance", f32::NEG_INFINITY)].into_iter().enumerate()
    {
        let path = folder.path().join(format!("{k}.rd.zarr"));
        write(&path, [3, 2], [5, 5], |_, _| 1e-6, 0.0, |_, d, _| profile(d, 1.0) as f32).unwrap();
        // The writer refuses such numbers; other programs write stores too, without its checksum.
        let files = Arc::new(zarrs::filesystem::FilesystemStore::new(&path).unwrap());
        let array = zarrs::array::Array::open(files, &format!("/{field}")).unwrap();
        let chunk = [1, 0, 0, 0, 0];
        let mut values: Vec<f32> = array.retrieve_chunk(&chunk).unwrap();
        values[(2 * 25 + 3 * 5 + 1) * 3 + 2] = bad;
        array.store_chunk(&chunk, values).unwrap();
        let group = path.join("zarr.json");
        let mut metadata: serde_json::Value = serde_json::from_slice(&std::fs::read(&group).unwrap()).unwrap();
        metadata["attributes"].as_object_mut().unwrap().remove("checksum").unwrap();
        std::fs::write(&group, metadata.to_string()).unwrap();
        let refused = factor(&MatrixReader::open(&path).unwrap(), &fixed(1, 1), &Progress::silent());
        let Err(Error::NotFinite { field: named, at, .. }) = refused else { panic!("{refused:?}") };
        assert_eq!(named, field);
        assert_eq!(at, "lit point [2, 1], sample [1, 3], channel 2");
    }
}

#[test]
fn extremes_of_shape_and_value_give_finite_materials() {
    let one = |_: usize, d: [f64; 2], _: usize| if d == [0.0, 0.0] { 2.0 } else { 0.0 };
    type Case<'a> = (&'a str, [usize; 2], [usize; 2], &'a dyn Fn(usize, [f64; 2], usize) -> f32);
    let cases: [Case<'_>; 5] = [
        ("one entry", [3, 3], [5, 5], &|i, d, c| if i == 4 { one(i, d, c) } else { 0.0 }),
        ("constant rows", [4, 4], [5, 5], &|i, _, c| 1.0 + i as f32 + c as f32),
        ("one of each", [1, 1], [1, 1], &|_, _, _| 3.0),
        ("peak on the rim", [3, 3], [5, 5], &|_, d, _| if d == [-2.0, 2.0] { 9.0 } else { 1.0 }),
        ("coloured noise", [4, 4], [5, 5], &|i, d, c| (profile(d, 0.5) + 0.01 * noise(i, d, c)) as f32),
    ];
    for (name, points, window, response) in cases {
        for (terms, degree) in [(None, None), (Some(1), Some(0)), (Some(100), Some(15))] {
            let f = run(&FactorOptions { terms, degree, ..tucker() }, points, window, response).unwrap();
            assert!(f.rel_rmse.is_finite() && f.rel_rmse <= 1.0, "{name} {terms:?}: {}", f.rel_rmse);
            // Three channels of independent noise are no function of one intensity.
            if degree == Some(15) && name != "coloured noise" {
                assert!(f.rel_rmse < 1e-4, "{name}: enough terms and degrees for anything, {}", f.rel_rmse);
            }
            let rows = points[0] * points[1];
            assert!((0..rows).all(|i| f.material.evaluate_row(i).iter().all(|v| v.is_finite())), "{name}");
        }
    }
}

#[test]
fn every_model_takes_every_extreme_of_shape() {
    type Case<'a> = (&'a str, [usize; 2], [usize; 2], &'a dyn Fn(usize, [f64; 2], usize) -> f32);
    let cases: [Case<'_>; 8] = [
        ("zeros", [3, 3], [5, 5], &|_, _, _| 0.0),
        ("a row of zeros", [3, 3], [5, 5], &|i, d, c| {
            if i == 4 { 0.0 } else { (1 + c) as f32 * profile(d, 1.0) as f32 }
        }),
        ("one entry", [3, 3], [5, 5], &|i, d, c| if i == 4 && d == [0.0; 2] { (1 + c) as f32 } else { 0.0 }),
        ("constant rows", [4, 4], [5, 5], &|i, _, c| (1 + i) as f32 * [1.0, 0.5, 2.0][c]),
        ("one row", [1, 1], [7, 7], &|_, d, c| (profile(d, 2.0) * [1.0, 0.7, 0.4][c]) as f32),
        ("one offset", [5, 5], [1, 1], &|i, _, c| (1 + i) as f32 * [1.0, 0.5, 2.0][c]),
        ("one of each", [1, 1], [1, 1], &|_, _, c| [1.0, 0.5, 2.0][c]),
        ("a peak on the rim", [3, 3], [5, 5], &|_, d, c| (if d == [-2.0, 2.0] { 9.0 } else { 1.0 }) * (1 + c) as f32),
    ];
    for (name, points, window, response) in cases {
        for model in [Model::Joint, Model::Peers2006] {
            let options = FactorOptions { model: Some(model), terms: Some(3), ..FactorOptions::default() };
            let f = run(&options, points, window, response).unwrap();
            // All of them are of rank one, with entries that no rule calls negative. Peers2006 iterates to 1e-4 or
            // better.
            let bound = if model == Model::Joint { ONE_TERM } else { 1e-3 };
            assert!(f.rel_rmse <= bound, "{name}, {model}: {}", f.rel_rmse);
            for i in (0..points[0] * points[1]).filter(|&i| response(i, [0.0; 2], 0) != 0.0) {
                let error = row_error(&f, i, |d, c| response(i, d, c));
                assert!(error <= 4.0 * bound, "{name}, {model}, row {i}: {error:e}");
            }
        }
    }
}

#[test]
fn goals_are_met_with_fewer_rows_than_terms_that_are_tried() {
    let response = |i: usize, d: [f64; 2], c: usize| (profile(d, 1.0 + i as f64 / 4.0) * [1.0, 0.7, 0.4][c]) as f32;
    for (model, color_regression) in
        [(Model::Tucker, false), (Model::Joint, false), (Model::Peers2006, false), (Model::Peers2006, true)]
    {
        let with = |goal| {
            let options = FactorOptions { model: Some(model), color_regression, goal, ..FactorOptions::default() };
            run(&options, [3, 3], [5, 5], response).unwrap()
        };
        // What terms of peers2006 leave is estimated from singular values: 10 dB for what the estimate may be off by.
        let least = if model == Model::Peers2006 { 20.0 } else { 30.0 };
        let reached = with(Goal::Psnr(30.0)).psnr_db.unwrap_or(f64::INFINITY);
        assert!(reached >= least, "{model}: {reached} dB");
        let bytes = with(Goal::Bytes(4000)).material.bytes_f32();
        assert!(bytes <= 4000, "{model}: {bytes} bytes");
        // Less than any material takes: the smallest there is.
        let smallest = with(Goal::Bytes(1)).material;
        assert_eq!(smallest.header.terms, 1, "{model}");
        assert!(smallest.bytes_f32() <= bytes, "{model}");
    }
}

#[test]
#[ignore = "half a minute and 250 MB of scratch"]
fn a_million_rows_of_rank_one_are_one_term() {
    let response =
        |i: usize, d: [f64; 2], c: usize| (profile(d, 1.0) * (1.0 + (i % 977) as f64) * [1.0, 0.5, 0.25][c]) as f32;
    for backend in [Backend::Gram, Backend::Randomized] {
        let options = FactorOptions { backend: Some(backend), ..fixed(15, 1) };
        let f = run(&options, [1000, 1000], [3, 3], response).unwrap();
        assert_eq!(f.material.header.terms, 1, "{backend:?}: {:?}", f.material.header.singular_values);
        // A million equal rows of norm ‖h‖: their rounding to f32 is independent and averages out. With the randomized
        // back end vectors and the nine products of a row are rounded to f32, too, alike in all rows.
        let roundings = if backend == Backend::Gram { 1.0 } else { 10.0 };
        let norm = (0..9).map(|k| profile([(k % 3) as f64 - 1.0, (k / 3) as f64 - 1.0], 1.0).powi(2)).sum::<f64>();
        let expected = (1e6 * norm).sqrt();
        let off = (f.material.header.singular_values[0] / expected - 1.0).abs();
        assert!(off < roundings * ROUNDING, "{backend:?}: {off:e}");
        for i in (0..1_000_000).step_by(9973) {
            assert!(row_error(&f, i, |d, c| response(i, d, c)) <= ONE_TERM, "row {i}");
        }
    }
}
