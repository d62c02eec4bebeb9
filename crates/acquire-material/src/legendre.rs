//! Legendre polynomials on an interval, and their conversion to powers for exports.

/// The highest degree of a colour polynomial.
pub const MOST_DEGREE: usize = 15;

/// Maps an intensity to the basis's argument in [−1, 1], clamped; 0 when the interval is empty.
#[inline]
pub fn argument(intensity: f64, low: f64, high: f64) -> f64 {
    let width = high - low;
    if width > 0.0 { ((2.0 * intensity - low - high) / width).clamp(-1.0, 1.0) } else { 0.0 }
}

/// L_0(u) … L_{n−1}(u), by Bonnet's recursion; exact to rounding for |u| ≤ 1.
pub fn evaluate(u: f64, out: &mut [f64]) {
    for p in 0..out.len() {
        out[p] = match p {
            0 => 1.0,
            1 => u,
            _ => next(p, u, out[p - 1], out[p - 2]),
        };
    }
}

/// L_p from L_{p−1} and L_{p−2}.
fn next(p: usize, u: f64, last: f64, before: f64) -> f64 {
    let k = p as f64;
    ((2.0 * k - 1.0) * u * last - (k - 1.0) * before) / k
}

/// Coefficients of powers of the intensity, lowest first, from coefficients of the Legendre basis on [low, high].
///
/// For export only: the sum of the result's terms loses about one digit per degree above 5 to cancellation.
/// An empty interval gives the constant that the basis has there.
pub fn monomials(coefficients: &[f32], low: f64, high: f64) -> Vec<f64> {
    let n = coefficients.len();
    let width = high - low;
    // u = scale · intensity + offset
    let (scale, offset) = if width > 0.0 { (2.0 / width, -(low + high) / width) } else { (0.0, 0.0) };
    let times_u = |poly: &[f64]| -> Vec<f64> {
        (0..n).map(|k| offset * poly[k] + if k > 0 { scale * poly[k - 1] } else { 0.0 }).collect()
    };
    let (mut before, mut current) = (vec![0.0; n], vec![0.0; n]);
    let mut sum = vec![0.0; n];
    if let Some(first) = current.first_mut() {
        *first = 1.0;
    }
    for (p, &c) in coefficients.iter().enumerate() {
        for (s, v) in sum.iter_mut().zip(&current) {
            *s += f64::from(c) * v;
        }
        let k = (p + 1) as f64;
        let shifted = times_u(&current);
        let next =
            shifted.iter().zip(&before).map(|(s, b)| ((2.0 * k - 1.0) * s - (k - 1.0) * b) / k).collect::<Vec<_>>();
        before = std::mem::replace(&mut current, next);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_recursion_gives_the_tabulated_polynomials() {
        let mut l = [0.0; 5];
        evaluate(0.3, &mut l);
        let expected = [1.0, 0.3, -0.365, -0.3825, 0.0729375]; // Abramowitz & Stegun 22.4.8 worked out by hand
        assert!(l.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-15), "{l:?}");
        evaluate(-1.0, &mut l);
        assert!((0..5).all(|p| l[p] == (-1.0_f64).powi(p as i32)), "{l:?}");
    }

    #[test]
    fn monomials_and_basis_agree_for_the_published_degree() {
        let coefficients = [1.0, -2.0, 0.5, 3.0, -1.0, 0.25, 2.0, -0.125_f32];
        let (low, high) = (-0.05, 1.02);
        let powers = monomials(&coefficients, low, high);
        let mut basis = [0.0; 8];
        for step in 0..=20 {
            let x = low + (high - low) * f64::from(step) / 20.0;
            evaluate(argument(x, low, high), &mut basis);
            let a: f64 = basis.iter().zip(coefficients).map(|(l, c)| l * f64::from(c)).sum();
            let b: f64 = powers.iter().rev().fold(0.0, |sum, c| sum * x + c);
            // coefficients reach 1e4 in degree 7: 1e4 · eps = 2e-12
            assert!((a - b).abs() < 1e-10, "{a} {b}");
        }
    }

    #[test]
    fn an_empty_interval_has_one_argument() {
        assert_eq!(argument(5.0, 1.0, 1.0), 0.0);
        assert_eq!(monomials(&[2.0, 7.0, 4.0], 1.0, 1.0)[0], 0.0, "2 + 4 L_2(0) = 0");
    }

    #[test]
    fn polynomials_up_to_the_highest_have_their_values() {
        // Σ (−1)^k C(n, k) C(2n − 2k, n) u^(n−2k) / 2^n in exact fractions.
        let degrees = [2, 3, 5, 8, 15];
        let table = [
            (-0.7, [0.235, 0.1925, 0.365_198_75, 0.306_704_346_484_375, -0.123_203_581_740_076_34]),
            (0.2, [-0.44, -0.28, 0.307_52, -0.039_564_8, -0.003_868_892_692_48]),
            (0.9, [0.715, 0.4725, -0.041_141_25, -0.409_685_903_515_625, 0.305_197_542_128_423_76]),
        ];
        for (u, expected) in table {
            let mut l = [0.0; MOST_DEGREE + 1];
            evaluate(u, &mut l);
            for (p, e) in degrees.into_iter().zip(expected) {
                // Some eps from the recursion.
                assert!((l[p] - e).abs() < 1e-14, "L_{p}({u}) = {}", l[p]);
            }
        }
        evaluate(0.5, &mut []);
    }

    #[test]
    fn powers_of_an_intensity_are_those_of_the_books() {
        // L_7 = (429 u⁷ − 693 u⁵ + 315 u³ − 35 u) / 16.
        let seventh = monomials(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], -1.0, 1.0);
        assert_eq!(seventh, [0.0, -35.0, 0.0, 315.0, 0.0, -693.0, 0.0, 429.0].map(|v| v / 16.0));
        // On [2, 4] u = x − 3: L_2 = 1.5 x² − 9 x + 13; on [1, 5] u = (x − 3) / 2: 0.375 x² − 2.25 x + 2.875.
        assert_eq!(monomials(&[0.0, 0.0, 1.0], 2.0, 4.0), [13.0, -9.0, 1.5]);
        assert_eq!(monomials(&[0.0, 0.0, 1.0], 1.0, 5.0), [2.875, -2.25, 0.375]);
        assert_eq!(monomials(&[2.0, 3.0], 2.0, 4.0), [-7.0, 3.0]);
        assert!(monomials(&[], 0.0, 1.0).is_empty());
    }

    #[test]
    fn an_argument_is_where_an_intensity_lies_between_the_ends() {
        assert_eq!([1.0, 2.5, 4.0, 7.0].map(|v| argument(v, 1.0, 7.0)), [-1.0, -0.5, 0.0, 1.0]);
        assert_eq!([-9.0, 1e30].map(|v| argument(v, 1.0, 7.0)), [-1.0, 1.0], "clamped");
        assert_eq!(argument(3.0, 7.0, 1.0), 0.0, "an interval the wrong way round is empty");
    }
}
