use super::super::test_matrices::solved;
use super::*;
use crate::material::legendre;
use faer::linalg::solvers::SolveLstsq;
use rand::{Rng, SeedableRng};
use rand_distr::{Distribution, StandardNormal};

fn value(coefficients: &[f64], u: f64) -> f64 {
    let mut basis = vec![0.0; coefficients.len()];
    legendre::evaluate(u, &mut basis);
    dot(&basis, coefficients)
}

fn wide(coefficients: &[f32]) -> Vec<f64> {
    coefficients.iter().map(|&c| f64::from(c)).collect()
}

#[test]
fn the_fit_is_as_good_as_that_of_a_householder_qr_at_every_degree() {
    let mut random = rand_pcg::Pcg64::seed_from_u64(3);
    let mut next = || f64::from(random.next_u32()) / f64::from(u32::MAX);
    // Evenly spread arguments, and those of an exponential over a 31 × 31 window: most of them within 1e-3 of −1.
    let even: Vec<f64> = (0..961).map(|_| 2.0 * next() - 1.0).collect();
    let radius = |k: i32| f64::hypot(f64::from(k % 31 - 15), f64::from(k / 31 - 15));
    let steep: Vec<f64> = (0..961).map(|k| 2.0 * (-radius(k) / 2.0).exp() - 1.0).collect();
    for (name, u) in [("even", even), ("steep", steep)] {
        let y: Vec<f64> = u.iter().map(|u| (u + 1.0).powf(0.8) + 0.01 * next()).collect();
        for degree in [0, 1, 7, 15] {
            let basis = PolynomialBasis::new(&u, degree);
            let along = basis.project(&y);
            let design = faer::Mat::from_fn(u.len(), degree + 1, |i, p| {
                let mut l = vec![0.0; degree + 1];
                legendre::evaluate(u[i], &mut l);
                l[p]
            });
            let solved = design.qr().solve_lstsq(faer::Mat::from_fn(u.len(), 1, |i, _| y[i]));
            let fitted = &design * &solved;
            let theirs: f64 = (0..=degree).map(|p| solved[(p, 0)].abs()).sum();
            for i in 0..u.len() {
                let ours: f64 = (0..basis.len()).map(|p| along[p] * basis.column(p)[i]).sum();
                // Ours are right to some eps; theirs are sums of large coefficients that cancel.
                assert!(
                    (ours - fitted[(i, 0)]).abs() < 1e-11 + 1e-14 * theirs,
                    "{name} {degree}: {ours} {}",
                    fitted[(i, 0)]
                );
                let through: f64 = (0..basis.len()).map(|p| along[p] * value(&basis.legendre[p], u[i])).sum();
                // Through Legendre coefficients, which are large and cancel: eps times their size, a few times.
                let size = (0..basis.len())
                    .map(|p| along[p].abs() * basis.legendre[p].iter().map(|l| l.abs()).sum::<f64>())
                    .sum::<f64>();
                assert!((through - ours).abs() < 1e-14 * size + 1e-13, "{name} {degree}: {through} {ours}, {size:e}");
            }
            for p in 0..basis.len() {
                for q in 0..=p {
                    let expected = f64::from(u8::from(p == q));
                    // Some eps, which add up over degrees.
                    assert!((dot(basis.column(p), basis.column(q)) - expected).abs() < 1e-12, "{name} {p} {q}");
                }
            }
        }
    }
}

#[test]
fn the_stated_error_is_that_of_the_rounded_coefficients() {
    let u: Vec<f64> = (0..300).map(|k| 2.0 * (-0.05 * f64::from(k)).exp() - 1.0).collect();
    let y: Vec<f64> = u.iter().map(|u| (2.5 * u).sin()).collect();
    for degree in [0, 3, 7, 15] {
        let fit = PolynomialBasis::new(&u, degree).fit(&y, degree);
        let error: f64 = u.iter().zip(&y).map(|(&u, y)| (value(&wide(&fit.coefficients), u) - y).powi(2)).sum();
        // The energy less the fitted shares cancels: eps times the energy, some times.
        assert!((error - fit.error).abs() < 1e-6 * error + 1e-14 * fit.energy, "{degree}: {error:e} {:e}", fit.error);
    }
}

#[test]
fn rows_that_cannot_support_the_degree_get_a_lower_one() {
    let constant = wide(&PolynomialBasis::new(&[0.25; 9], 7).fit(&[2.0; 9], 7).coefficients);
    assert!((value(&constant, 0.25) - 2.0).abs() < 1e-14 && constant[1..].iter().all(|&c| c == 0.0));
    let two = wide(&PolynomialBasis::new(&[-1.0, 0.5, -1.0, 0.5], 15).fit(&[1.0, 4.0, 1.0, 4.0], 15).coefficients);
    assert!((value(&two, 0.5) - 4.0).abs() < 1e-13 && (value(&two, -1.0) - 1.0).abs() < 1e-13);
    let none = PolynomialBasis::new(&[], 3).fit(&[], 3);
    assert_eq!(none.coefficients, [0.0; 4]);
}

#[test]
fn the_degree_of_a_noisy_polynomial_is_found_even_past_a_gap() {
    let mut random = rand_pcg::Pcg64::seed_from_u64(5);
    let mut choice = DegreeChoice::new(15);
    let u: Vec<f64> = (0..121).map(|k| f64::from(k) / 60.0 - 1.0).collect();
    for _ in 0..100 {
        let y: Vec<f64> = u
            .iter()
            .map(|&u| {
                let noise: f64 = StandardNormal.sample(&mut random);
                value(&[1.0, 1.0, 0.5, 0.0, 0.3], u) + 0.1 * noise
            })
            .collect();
        choice.add(&PolynomialBasis::new(&u, 15).significance(&y, &vec![0.01; u.len()], &[]));
    }
    assert_eq!(choice.degree(), 4, "{:?}", choice.mean());
    // Under noise alone z² is χ² of one degree of freedom: mean 1, sd sqrt(2/100) here, 5 of them allowed.
    assert!(choice.mean()[5..].iter().all(|z| (z - 1.0).abs() < 0.7), "{:?}", choice.mean());
}

#[test]
fn errors_of_every_degree_are_those_of_its_own_fit() {
    let u: Vec<f64> = (0..40).map(|k| f64::from(k * k) / 800.0 - 1.0).collect();
    let y: Vec<f64> = u.iter().map(|u| (2.0 * u).exp() + 0.3 * (9.0 * u).sin()).collect();
    let errors = PolynomialBasis::new(&u, 5).errors_by_degree(&y, 5);
    for (degree, error) in errors.iter().enumerate() {
        // Normal equations in powers: well conditioned enough up to degree 5.
        let power = |u: f64, p: usize| u.powi(p as i32);
        let sum = |f: &dyn Fn(usize) -> f64| (0..40).map(f).sum::<f64>();
        let gram = (0..=degree).map(|a| (0..=degree).map(|b| sum(&|k| power(u[k], a + b))).collect()).collect();
        let right = (0..=degree).map(|a| sum(&|k| power(u[k], a) * y[k])).collect();
        let beta = solved(gram, right);
        let left = sum(&|k| ((0..=degree).map(|p| beta[p] * power(u[k], p)).sum::<f64>() - y[k]).powi(2));
        // Rounding the coefficients to f32 adds some 1e-12; normal equations lose half the digits.
        assert!((error - left).abs() < 1e-8 * left + 1e-10, "degree {degree}: {error} {left}");
    }
}

#[test]
fn significance_is_a_share_over_what_independent_and_common_errors_would_give() {
    // On −1, 0, 1 the orthonormal polynomials are (1, 1, 1)/√3, (−1, 0, 1)/√2 and (1, −2, 1)/√6.
    let basis = PolynomialBasis::new(&[-1.0, 0.0, 1.0], 2);
    let values = [1.0, 4.0, 9.0];
    let shares = [14.0 / 3.0_f64.sqrt(), 8.0 / 2.0_f64.sqrt(), 2.0 / 6.0_f64.sqrt()];
    let near = |found: &[Option<f64>], expected: [f64; 3]| {
        assert_eq!(found.len(), 3);
        for (found, expected) in found.iter().zip(expected) {
            // Rounding of f64.
            assert!((found.unwrap() / expected - 1.0).abs() < 1e-13, "{found:?} {expected}");
        }
    };
    let variance = [0.1, 0.2, 0.6];
    let independent = [0.9 / 3.0, 0.7 / 2.0, 1.5 / 6.0];
    near(&basis.significance(&values, &variance, &[]), [0, 1, 2].map(|p| shares[p].powi(2) / independent[p]));
    // Two errors common to the row add the squares of their own shares.
    let errors = [vec![3.0, 0.0, 0.0], vec![1.0, 2.0, -1.0]];
    let common = [9.0 / 3.0 + 4.0 / 3.0, 9.0 / 2.0 + 4.0 / 2.0, 9.0 / 6.0 + 16.0 / 6.0];
    let both = |p: usize| shares[p].powi(2) / (independent[p] + common[p]);
    near(&basis.significance(&values, &variance, &errors), [both(0), both(1), both(2)]);
    near(&basis.significance(&values, &[0.0; 3], &errors), [0, 1, 2].map(|p| shares[p].powi(2) / common[p]));
    let slope = [vec![0.5, 0.0, -0.5]];
    let found = basis.significance(&values, &[0.0; 3], &slope);
    // The first and the last polynomial are as they should be whatever the slope: rounding alone, if at all.
    assert!((found[1].unwrap() / (shares[1].powi(2) / 0.5) - 1.0).abs() < 1e-13);
    assert_eq!(basis.significance(&values, &[0.0; 3], &[]), [None; 3], "nothing to compare with");
}

#[test]
fn conditions_are_ratios_of_pivots_that_only_grow() {
    // u = −1, 0, 1: Legendre columns (1,1,1), u and (1, −.5, 1), whose part beyond the constant is (.5, −1, .5): pivots
    // √3, √2, √1.5.
    let basis = PolynomialBasis::new(&[-1.0, 0.0, 1.0], 6);
    let expected = [1.0, 1.5_f64.sqrt(), 2.0_f64.sqrt(), 2.0_f64.sqrt(), 2.0_f64.sqrt()];
    for (found, expected) in basis.conditions(4).iter().zip(expected) {
        assert!((found - expected).abs() < 1e-14, "rounding: {found} {expected}");
    }
    assert_eq!(basis.conditions(4).len(), 5);
    assert_eq!(PolynomialBasis::new(&[], 3).conditions(2), [1.0; 3]);
}

#[test]
fn a_degree_is_the_last_at_which_the_sum_beyond_two_is_largest() {
    let degree = |z2: &[f64]| {
        let mut choice = DegreeChoice::new(z2.len() - 1);
        choice.add(&z2.iter().map(|&z| Some(z)).collect::<Vec<_>>());
        choice.degree()
    };
    assert_eq!(degree(&[99.0, 1.9, 1.0]), 0, "the constant is always there");
    assert_eq!(degree(&[0.0, 5.0, 1.0, 2.5]), 1, "3, 2, 2.5");
    assert_eq!(degree(&[0.0, 5.0, 1.0, 3.5]), 3, "3, 2, 3.5");
    assert_eq!(degree(&[0.0, 5.0, 1.0, 3.0]), 1, "the lowest of equals");
    let mut choice = DegreeChoice::new(2);
    choice.add(&[None, None, None]);
    assert_eq!(choice.mean(), [0.0; 3]);
    choice.add(&[Some(1.0), Some(7.0)]);
    choice.add(&[Some(3.0), Some(2.0), Some(4.0)]);
    choice.add(&[Some(5.0), None, Some(2.0)]);
    // A row that tells nothing does not count; a degree that a row cannot support counts as 0.
    assert_eq!(choice.mean(), [3.0, 3.0, 2.0]);
    assert_eq!(choice.degree(), 1);
}

#[test]
fn a_fit_of_a_polynomial_is_that_polynomial() {
    let u = [-0.9, -0.3, 0.0, 0.2, 0.65, 1.0];
    let y: Vec<f64> = u.iter().map(|&u| value(&[0.5, -2.0, 0.25, 1.5], u)).collect();
    let fit = PolynomialBasis::new(&u, 3).fit(&y, 3);
    let expected = [0.5_f32, -2.0, 0.25, 1.5];
    // The ridge of 1e-15 and rounding are below half a unit in the last place, which may yet go either way.
    assert!(fit.coefficients.iter().zip(expected).all(|(a, b)| (a - b).abs() < 3e-7), "{:?}", fit.coefficients);
    assert!((fit.energy - y.iter().map(|y| y * y).sum::<f64>()).abs() < 1e-12, "f64 sums");
    let higher = PolynomialBasis::new(&u, 3).fit(&y, 4);
    assert_eq!((higher.coefficients.len(), higher.coefficients[4]), (5, 0.0), "a basis without that degree");
}

#[test]
fn rounding_of_coefficients_adds_the_square_of_the_polynomial_that_it_changes_them_by() {
    let u: Vec<f64> = (0..50).map(|k| f64::from(k * k) / 1250.0 - 0.97).collect();
    let basis = PolynomialBasis::new(&u, 3);
    let (mut exact, rounded) = ([0.0; MOST], [0.5_f32, -1.25, 2.0, 0.75]);
    exact[..4].copy_from_slice(&[0.4, -1.0, 2.5, 0.5]);
    let changed = [0.1_f64, -0.25, -0.5, 0.25];
    let expected: f64 = u.iter().map(|&u| value(&changed, u).powi(2)).sum();
    // f64 sums, through polynomials whose coefficients are of size one.
    assert!((basis.rounded(&exact, &rounded) / expected - 1.0).abs() < 1e-10, "{expected}");
    // A third of the square of half a unit in the last place of 1, for every sample.
    let half_unit = f64::from(f32::EPSILON) / 2.0;
    assert!((PolynomialBasis::ridge_of(50) / (50.0 * half_unit * half_unit / 3.0) - 1.0).abs() < 1e-14);
}

/// Arguments of which all are within `width` of −1, where Legendre polynomials hardly differ.
fn near_the_end(width: f64) -> Vec<f64> {
    (0..60).map(|k| -1.0 + width * (f64::from(k) + 0.5) / 30.0).collect()
}

#[test]
fn degrees_whose_coefficients_rounding_would_spoil_are_damped_and_the_error_says_so() {
    let u = near_the_end(1e-4);
    let y: Vec<f64> = (0..60).map(|k| 1.0 + 0.3 * (0.4 * f64::from(k)).sin()).collect();
    let basis = PolynomialBasis::new(&u, 4);
    for degree in 0..=4 {
        let fit = basis.fit(&y, degree);
        let error: f64 = u.iter().zip(&y).map(|(&u, y)| (value(&wide(&fit.coefficients), u) - y).powi(2)).sum();
        // Coefficients of up to 1e6 cancel: 1e-10 of the values, and their square is summed.
        assert!((error / fit.error - 1.0).abs() < 1e-6, "{degree}: {error} {}", fit.error);
        let exact = fit.energy - basis.project(&y)[..=degree].iter().map(|a| a * a).sum::<f64>();
        // Degree 1 is 1e4 of a coefficient, which f32 can hold; degree 2 is 1e8.
        let damped = (fit.error - exact) / exact;
        assert_eq!(damped > 1e-3, degree >= 2, "{degree}: {damped}");
    }
}

#[test]
fn a_row_makes_use_of_the_degrees_that_rounding_leaves_more_than_half_of() {
    // q_p has coefficients of about c_p / width^p, c = √3, 3.4, 6.6: half is left where they are 1.7 / 6e-8 at the
    // most, so that degree 1 needs a width of 6e-8, degree 2 one of 3e-4, degree 3 one of 6e-3.
    for (width, count) in [(1e-4, 2), (1e-3, 3), (2e-2, 4)] {
        let found = PolynomialBasis::new(&near_the_end(width), 3).significance(&[1.0; 60], &[1.0; 60], &[]);
        assert_eq!(found.len(), count, "{width}");
    }
}
