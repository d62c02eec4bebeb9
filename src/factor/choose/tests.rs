use super::super::Backend;
use super::super::test_matrices::stored;
use super::*;
use crate::material::Model;
use crate::progress::Progress;
use crate::transport::Row;

#[test]
fn an_uncertain_place_moves_a_row_by_its_slopes_and_curvatures_along_each_axis() {
    // R = 3x² + 0.5y² + 0.7xy + 2x − y + 4 on 9 × 7: central differences of a quadratic are its derivatives.
    let window = [9, 7];
    let at = |k: usize| [(k % 9) as f64, (k / 9) as f64];
    let values: Vec<f64> = (0..63)
        .map(|k| {
            let [x, y] = at(k);
            3.0 * x * x + 0.5 * y * y + 0.7 * x * y + 2.0 * x - y + 4.0
        })
        .collect();
    let valid = [true; 63];
    let sd = 0.2;
    let errors = position_errors(gradient(&values, &valid, window), &valid, window, sd);
    assert_eq!(errors.len(), 5);
    for k in 0..63 {
        let [x, y] = at(k);
        // Two samples from the rim all differences are central.
        if !(2.0..=6.0).contains(&x) || !(2.0..=4.0).contains(&y) {
            continue;
        }
        // δ is Gaussian of one sd: δ² − sd² has the standard deviation √2 sd².
        let second = sd * sd * 2.0_f64.sqrt() / 2.0;
        let expected =
            [sd * (6.0 * x + 0.7 * y + 2.0), sd * (y + 0.7 * x - 1.0), second * 6.0, second * 1.0, sd * sd * 0.7];
        for (n, (e, expected)) in errors.iter().zip(expected).enumerate() {
            assert!((e[k] - expected).abs() < 1e-12, "rounding, error {n} at {x} {y}: {} {expected}", e[k]);
        }
    }
}

/// A small matrix of two terms, which intensity alone does not colour.
fn matrix(points: [usize; 2]) -> super::super::test_matrices::StoredMatrix {
    stored(
        points,
        [5, 3],
        |_| 0.0,
        |i| {
            let value = |k: usize, c: usize| {
                let (x, y) = ((k % 5) as f64 - 2.0, (k / 5) as f64 - 1.0);
                let narrow = (-(x * x + 2.0 * y * y)).exp();
                let broad = (-(0.2 * x * x + 0.1 * y * y)).exp();
                // So much that one term leaves the range of normalized intensities, 0 to 1.
                let share = (i * 5 % 7) as f64 / 10.0;
                (2.0 * narrow + share * broad) * [1.0, 0.6, 0.3][c] + 0.2 * c as f64 * broad * broad
            };
            Row {
                response: (0..45).map(|s| value(s / 3, s % 3) as f32).collect(),
                variance: vec![1e-10; 45],
                valid: vec![true; 45],
            }
        },
    )
}

/// What `factor` makes of it with these options.
fn made(reader: &MatrixReader, options: &FactorOptions) -> Factored {
    super::super::factor(reader, options, &Progress::silent()).unwrap()
}

fn options(terms: usize, degree: usize) -> FactorOptions {
    let (model, backend) = (Some(Model::Tucker), Some(Backend::Full));
    FactorOptions {
        model,
        backend,
        terms: Some(terms),
        degree: Some(degree),
        peak_shift: false,
        ..FactorOptions::default()
    }
}

#[test]
fn a_goal_is_missed_by_more_than_a_hundredth_of_a_decibel_or_by_a_byte() {
    let matrix = matrix([4, 3]);
    let material = made(&matrix.reader, &options(1, 1)).material;
    // 1 weight, 12 + 15 factors, 12 · 3 · 2 coefficients, 2 ends of the range.
    let bytes = 4 * (1 + 12 + 15 + 72 + 2);
    assert_eq!(material.bytes_f32(), bytes);
    assert_eq!(Goal::Bytes(bytes).missed(&material, None), None);
    let missed = Goal::Bytes(bytes - 1).missed(&material, Some(99.0));
    assert_eq!(missed, Some(FactorWarning::GoalMissed { asked: "407 bytes".into(), found: "408 bytes".into() }));
    assert_eq!(Goal::Psnr(40.0).missed(&material, Some(39.991)), None);
    let missed = Goal::Psnr(40.0).missed(&material, Some(39.98));
    assert_eq!(missed, Some(FactorWarning::GoalMissed { asked: "40 dB".into(), found: "39.98 dB".into() }));
    assert_eq!(Goal::Psnr(40.0).missed(&material, None), None, "nothing is left to miss");
    assert_eq!(Goal::Noise.missed(&material, Some(1.0)), None);
}

#[test]
fn of_two_materials_the_one_that_reaches_the_goal_is_preferred_then_the_cheaper_or_better() {
    let matrix = matrix([4, 3]);
    let small = made(&matrix.reader, &options(1, 0));
    let large = made(&matrix.reader, &options(2, 2));
    let with = |f: &Factored, db: f64| Factored { psnr_db: Some(db), ..f.clone() };
    let bytes = |f: &Factored| f.material.bytes_f32();
    assert!(bytes(&small) < bytes(&large));
    let prefers = |goal: Goal, small_db: f64, large_db: f64| {
        let (a, b) = (with(&small, small_db), with(&large, large_db));
        (goal.prefers(&a, &b), goal.prefers(&b, &a))
    };
    assert_eq!(prefers(Goal::Psnr(40.0), 40.0, 60.0), (true, false), "both reach it: fewer bytes");
    assert_eq!(prefers(Goal::Psnr(40.0), 39.0, 41.0), (false, true));
    assert_eq!(prefers(Goal::Psnr(40.0), 41.0, 39.0), (true, false));
    assert_eq!(prefers(Goal::Psnr(40.0), 30.0, 39.0), (false, true), "neither: the nearer");
    let room = Goal::Bytes(bytes(&large));
    assert_eq!(prefers(room, 30.0, 31.0), (false, true), "both fit: the better");
    assert_eq!(prefers(Goal::Bytes(bytes(&small)), 30.0, 99.0), (true, false));
    assert_eq!(prefers(Goal::Bytes(bytes(&small) - 1), 30.0, 99.0), (true, false), "neither fits: the smaller");
    assert_eq!(prefers(Goal::Noise, 30.0, 99.0), (false, false));
    let exact = Factored { psnr_db: None, ..small.clone() };
    assert!(Goal::Psnr(100.0).prefers(&exact, &with(&large, 99.0)), "nothing left is more than any number");
}

#[test]
fn sampled_rows_are_whole_runs_spread_over_the_matrix() {
    let spread = |points, count| spread(&matrix(points).reader, count);
    // 12 rows: every one, by itself.
    assert_eq!(spread([4, 3], 256), (0..12).map(|i| i..i + 1).collect::<Vec<_>>());
    // 117 rows in 32 places: 4 apart, of which two are read; the last place has but one row.
    let found = spread([9, 13], 64);
    assert_eq!((found.len(), found[1].clone(), found[29].clone()), (30, 4..6, 116..117));
    assert_eq!(spread([9, 13], 1)[3], 12..13);
}

#[test]
fn rows_of_one_colour_look_grey_and_others_do_not() {
    assert!(!looks_grey(&matrix([4, 3]).reader).unwrap());
    let grey = |variance: f32| {
        stored(
            [4, 3],
            [5, 3],
            |_| 0.0,
            move |i| Row {
                response: (0..45).map(|s| 1.0 + (s / 3 + i) as f32 + 0.1 * ((s % 3) as f32 - 1.0)).collect(),
                variance: vec![variance; 45],
                valid: vec![true; 45],
            },
        )
    };
    // Red and blue are off by 0.1 of green: z² = 0.01 / (2 v).
    assert!(looks_grey(&grey(0.005).reader).unwrap());
    assert!(!looks_grey(&grey(0.003).reader).unwrap());
}

/// What sampled rows tell, against factoring the matrix with every number of terms and every degree.
#[test]
fn errors_of_sampled_rows_are_those_of_a_factorization() {
    let matrix = matrix([4, 3]);
    let top = made(&matrix.reader, &FactorOptions { degree: Some(3), ..options(2, 3) });
    let mut bare = top.material.clone();
    (bare.header.degree, bare.color_coefficients) = (None, Vec::new());
    let (table, energy) = sampled_errors(&matrix.reader, &bare, 3).unwrap();
    assert_eq!((table.len(), table[0].len()), (2, 4));
    let block = matrix.reader.read_responses(0..12).unwrap();
    let squares: f64 = block.response.iter().map(|&v| f64::from(v).powi(2)).sum();
    assert!((energy / squares - 1.0).abs() < 1e-12, "f64 sums: {energy} {squares}");
    for terms in 1..=2 {
        for degree in 0..=3 {
            let error = made(&matrix.reader, &options(terms, degree)).rel_rmse.powi(2) * squares;
            let found = table[terms - 1][degree];
            // Least squares do not depend on the range of the basis; rounding of coefficients to f32 does.
            assert!((found - error).abs() < 1e-4 * error + 1e-12 * squares, "T {terms} P {degree}: {found} {error}");
        }
    }
}

/// The cheapest that reaches a quality, and the best within bytes, against all of them.
#[test]
fn goals_choose_among_all_terms_and_degrees() {
    let matrix = matrix([4, 3]);
    let most = FactorOptions { max_degree: 3, ..options(2, 3) };
    let mut bare = made(&matrix.reader, &most).material;
    (bare.header.degree, bare.color_coefficients) = (None, Vec::new());
    let survey =
        super::super::survey::survey(&matrix.reader, super::super::content::Content::Intensity, [0, 0]).unwrap();
    let free = FactorOptions { terms: None, degree: None, max_degree: 3, ..options(2, 3) };
    // 1 weight, 12 + 15 factors a term, 36 coefficients a degree, 2 ends of the range.
    let bytes = |t: usize, p: usize| 4 * (28 * t + 36 * (p + 1) + 2) as u64;
    let all: Vec<(usize, usize, u64, f64)> = (1..=2)
        .flat_map(|t| (0..=3).map(move |p| (t, p)))
        .map(|(t, p)| (t, p, bytes(t, p), made(&matrix.reader, &options(t, p)).psnr_db.unwrap()))
        .collect();
    let chosen = |goal| {
        let found = terms_and_degree(&matrix.reader, &bare, &survey, goal, &free).unwrap();
        ((found.terms, found.degree), found.short)
    };
    let best = all.iter().map(|a| a.3).fold(0.0, f64::max);
    for db in [10.0, 20.0, 30.0, 35.0, best - 0.2] {
        // A tenth of a decibel in hand.
        let expected = all.iter().filter(|a| a.3 >= db + 0.1).min_by_key(|a| a.2).unwrap();
        assert_eq!(chosen(Goal::Psnr(db)), ((expected.0, expected.1), false), "{db} dB: {all:?}");
    }
    let top = all.iter().max_by(|a, b| a.3.total_cmp(&b.3)).unwrap();
    assert_eq!(chosen(Goal::Psnr(best + 1.0)), ((top.0, top.1), true));
    for limit in [bytes(1, 0), bytes(1, 1), bytes(2, 0) + 1, bytes(2, 1), bytes(2, 3) - 1, 1 << 20] {
        let expected = all.iter().filter(|a| a.2 <= limit).max_by(|a, b| a.3.total_cmp(&b.3)).unwrap();
        assert_eq!(chosen(Goal::Bytes(limit)), ((expected.0, expected.1), expected.0 == 2), "{limit} bytes: {all:?}");
    }
    assert_eq!(chosen(Goal::Bytes(bytes(1, 0) - 1)), ((1, 0), false), "the smallest");
    let fixed = FactorOptions { degree: Some(2), ..free };
    let found = terms_and_degree(&matrix.reader, &bare, &survey, Goal::Psnr(1.0), &fixed).unwrap();
    assert_eq!((found.terms, found.degree), (1, 2), "a degree that was asked for stays");
}

#[test]
fn conditions_are_the_median_and_the_largest_over_rows() {
    let matrix = matrix([5, 1]);
    let material = made(&matrix.reader, &options(2, 2)).material;
    let found = regression_conditions(&matrix.reader, &material, 2).unwrap();
    // Of degree 0 there is one pivot. Of degree 1, pivots are √n and the spread of u around its mean.
    let mut expected: Vec<f64> = (0..5)
        .map(|i| {
            let [low, high] = material.header.intensity_range.map(f64::from);
            let u: Vec<f64> =
                Responses::new(&material).plane(0, &[i]).iter().map(|v| 2.0 * (v - low) / (high - low) - 1.0).collect();
            let mean = u.iter().sum::<f64>() / 15.0;
            let spread = u.iter().map(|u| (u - mean).powi(2)).sum::<f64>().sqrt();
            15.0_f64.sqrt() / spread
        })
        .collect();
    expected.sort_by(f64::total_cmp);
    assert_eq!(found[0], [1.0, 1.0]);
    for (found, expected) in found[1].iter().zip([expected[2], expected[4]]) {
        assert!((found / expected - 1.0).abs() < 1e-12, "rounding: {found} {expected}");
    }
}

/// Channels are a line and a square of the intensity, whose squares sum to nothing; rows of noise of variance `noise`,
/// which say `stated`.
fn squares(noise: f64, stated: f64) -> super::super::test_matrices::StoredMatrix {
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    let value = |i: usize, k: usize, c: usize| {
        let (x, y) = ((k % 9) as f64 - 3.5, (k / 9) as f64 - 3.0);
        let v = (1.0 + 0.1 * (i % 5) as f64) * (-(0.12 * x * x + 0.05 * x * y + 0.2 * y * y)).exp();
        [1.0, 0.7, 0.4][c] * v + [0.5, -0.2, -0.3][c] * v * v
    };
    stored(
        [8, 6],
        [9, 7],
        |_| 0.0,
        |i| {
            let mut random = rand_pcg::Pcg64::seed_from_u64(i as u64);
            let mut draw = || -> f64 { StandardNormal.sample(&mut random) };
            let response = (0..189).map(|s| (value(i, s / 3, s % 3) + noise.sqrt() * draw()) as f32).collect();
            Row { response, variance: vec![stated as f32; 189], valid: vec![true; 189] }
        },
    )
}

#[test]
fn a_degree_goes_as_far_as_the_polynomial_stands_out_of_the_stated_noise() {
    let chosen = |noise: f64, stated: f64| {
        let matrix = squares(noise, stated);
        let material = made(&matrix.reader, &options(1, 1)).material;
        degree_by_noise(&matrix.reader, &material, 6).unwrap()
    };
    let (degree, why) = chosen(1e-6, 1e-6);
    assert_eq!(degree, 2, "{why}");
    assert!(why.starts_with("degree 3 explains no more than noise"), "{why}");
    // The square is 0.5 v² at the most, 0.06 from a line: far below a deviation of 1, where the line is 0.7 of it.
    let (degree, why) = chosen(1e-6, 1.0);
    assert!(degree < 2, "{degree}: {why}");
    let (degree, why) = chosen(1e-4, 1e-8);
    assert_eq!(degree, 6, "noise that is not stated looks like colour");
    assert!(why.starts_with("the highest allowed"), "{why}");
}

#[test]
fn the_noise_of_a_row_is_its_own_with_rounding_and_that_of_its_place_apart() {
    // Steep rows of which the place is known to a fifth of a sample (0.25 mm); in some samples that is all of the
    // stated variance.
    let value = |i: usize, k: usize, c: usize| {
        let (x, y) = ((k % 5) as f64 - 2.2, (k / 5) as f64 - 0.7);
        (2.0 + i as f64 + c as f64) * (-(0.3 * x * x + 0.5 * y * y + 0.2 * x * y)).exp()
    };
    let response = |i: usize, k: usize, c: usize| f64::from(value(i, k, c) as f32);
    // Central differences, one-sided at the rim.
    let slope = |v: &dyn Fn(usize, usize) -> f64, k: usize| {
        let (x, y) = (k % 5, k / 5);
        let (a, b) = (x.saturating_sub(1), (x + 1).min(4));
        let (d, e) = (y.saturating_sub(1), (y + 1).min(2));
        [(v(b, y) - v(a, y)) / (b - a) as f64, (v(x, e) - v(x, d)) / (e - d) as f64]
    };
    let of_place = |i: usize, k: usize, c: usize| {
        let [x, y] = slope(&|x, y| response(i, x + 5 * y, c), k);
        0.04 * (x * x + y * y)
    };
    let variance =
        |i: usize, s: usize| if i == 0 { of_place(i, s / 3, s % 3) * [0.5, 1.0, 1.5][s / 3 % 3] } else { 0.0 };
    let matrix = stored(
        [2, 1],
        [5, 3],
        |i| if i == 0 { 0.05 } else { 0.0 },
        |i| Row {
            response: (0..45).map(|s| value(i, s / 3, s % 3) as f32).collect(),
            variance: (0..45).map(|s| variance(i, s) as f32).collect(),
            valid: vec![true; 45],
        },
    );
    let mut material = made(&matrix.reader, &options(1, 2)).material;
    (material.header.degree, material.header.intensity_range) = (None, [-1e-3, 1.0]);
    let block = matrix.reader.read(0..2).unwrap();
    let found = regression::rows(&Responses::new(&material), &block, |k, channels| {
        row_significance(&matrix.reader, channels, &block, k, 2)
    });
    let rounding = 4.0 * f64::from(f32::EPSILON) / 2.0;
    for i in 0..2 {
        let u: Vec<f64> = Responses::new(&material)
            .plane(0, &[i])
            .iter()
            .map(|v| 2.0 * (v + f64::from(1e-3_f32)) / (1.0 + f64::from(1e-3_f32)) - 1.0)
            .collect();
        let basis = PolynomialBasis::new(&u, 2);
        for c in 0..3 {
            let values: Vec<f64> = (0..15).map(|k| response(i, k, c)).collect();
            let noise: Vec<f64> = (0..15)
                .map(|k| {
                    // Of the second row everything is known but for rounding.
                    let place = if i == 0 { of_place(i, k, c) } else { 0.0 };
                    let own = f64::from(variance(i, 3 * k + c) as f32);
                    (own - place).max(0.0) + (rounding * values[k]).powi(2) / 3.0
                })
                .collect();
            let errors = position_errors(gradient(&values, &[true; 15], [5, 3]), &[true; 15], [5, 3], 0.2);
            let expected = basis.significance(&values, &noise, if i == 0 { &errors } else { &[] });
            assert_eq!(found[i][c].len(), 3);
            for (found, expected) in found[i][c].iter().zip(expected) {
                // A difference of f32 variances and of f64 squares of slopes: 1e-7 of them.
                assert!((found.unwrap() / expected.unwrap() - 1.0).abs() < 1e-4, "{i} {c}: {found:?} {expected:?}");
            }
        }
    }
}
