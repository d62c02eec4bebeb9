//! Colour polynomials from sums over a row, for rows that let it be done so quickly.
//!
//! A product of two Legendre polynomials is a sum of others (`Adams1878`): the normal equations of degree P are made of
//! Σ L_k(u), k to 2P, and Σ L_p(u) y. That is a tenth of the work of [`PolynomialBasis`], and loses twice the digits
//! that the columns' condition costs. Where that could be seen in a coefficient's f32, or in the error that is left,
//! there is no fit, and the row goes the other way.

use super::color::{Fit, MOST, PolynomialBasis};
use super::vector::{dot_in, sum_in};
use crate::cholesky::Cholesky;
use pulp::{Arch, NullaryFnOnce};

/// A pivot is at least this share of its diagonal: 1e-16 over it is a hundredth of what rounding to f32 changes.
const PIVOT: f64 = 1e-7;
/// The error left is at least this share of the energy: the difference of sums that are right to 1e-15 tells it to a
/// thousandth.
const ERROR: f64 = 1e-12;
/// Samples that are worked on at a time: three polynomials and the channels at those stay in the nearest cache.
const TILE: usize = 256;
/// 2P + 1 at the most.
const SUMS: usize = 2 * MOST - 1;

/// Sums of one row.
struct Moments {
    /// Σ L_k(u).
    of_basis: [f64; SUMS],
    /// Σ L_p(u) y of every channel.
    along: [[f64; MOST]; 3],
    /// Σ y².
    energy: [f64; 3],
    samples: usize,
}

/// Fits of a degree.
pub(super) struct MomentFits {
    degree: usize,
    /// For a ≥ b, row by row: L_a L_b = Σ_r c_r L_{a+b−2r}.
    products: Vec<Vec<f64>>,
}

impl MomentFits {
    /// For polynomials of this degree, 15 at the most.
    pub(super) fn new(degree: usize) -> Self {
        let lower = (0..=degree).flat_map(|a| (0..=a).map(move |b| (a, b)));
        Self { degree, products: lower.map(|(a, b)| product(a, b)).collect() }
    }

    /// The same as [`PolynomialBasis::fit`] of every channel, at arguments that they share; `None` where these sums do
    /// not tell it well enough.
    pub(super) fn fit(&self, arguments: &[f64], channels: [&[f64]; 3]) -> Option<[Fit; 3]> {
        let moments = Arch::new().dispatch(Sum { arguments, channels, degree: self.degree });
        let n = self.degree + 1;
        let mut gram = vec![0.0; n * n];
        let mut products = self.products.iter();
        for a in 0..n {
            for (b, product) in (0..=a).zip(&mut products) {
                let sums = (0..=b).map(|r| product[r] * moments.of_basis[a + b - 2 * r]);
                gram[a * n + b] = sums.sum::<f64>();
            }
        }
        let mut normal = gram.clone();
        (0..n).for_each(|a| normal[a * n + a] += PolynomialBasis::ridge_of(moments.samples));
        let cholesky = Cholesky::strict(normal, n, PIVOT)?;
        let fit = |c: usize| {
            let mut exact = moments.along[c][..n].to_vec();
            if !cholesky.solve(&mut exact) {
                return None;
            }
            let coefficients: Vec<f32> = exact.iter().map(|&v| v as f32).collect();
            let rounded: Vec<f64> = coefficients.iter().map(|&v| f64::from(v)).collect();
            // Both halves of the quadratic form.
            let quadratic: f64 = (0..n)
                .map(|a| {
                    let below: f64 = (0..a).map(|b| 2.0 * gram[a * n + b] * rounded[b]).sum();
                    rounded[a] * (below + gram[a * n + a] * rounded[a])
                })
                .sum();
            let linear: f64 = rounded.iter().zip(&moments.along[c]).map(|(r, b)| r * b).sum();
            let (energy, error) = (moments.energy[c], moments.energy[c] - 2.0 * linear + quadratic);
            (error > ERROR * energy.max(quadratic)).then_some(Fit { coefficients, error, energy })
        };
        Some([fit(0)?, fit(1)?, fit(2)?])
    }
}

/// c_r of L_a L_b = Σ_r c_r L_{a+b−2r}, r to b, for b ≤ a.
fn product(a: usize, b: usize) -> Vec<f64> {
    // 1 · 3 · … (2m − 1) / m!
    let odd = |m: usize| (1..=m).map(|i| (2 * i - 1) as f64 / i as f64).product::<f64>();
    let share = |r: usize| (2 * (a + b) - 4 * r + 1) as f64 / (2 * (a + b) - 2 * r + 1) as f64;
    (0..=b).map(|r| odd(r) * odd(a - r) * odd(b - r) / odd(a + b - r) * share(r)).collect()
}

struct Sum<'a> {
    arguments: &'a [f64],
    channels: [&'a [f64]; 3],
    degree: usize,
}

impl NullaryFnOnce for Sum<'_> {
    type Output = Moments;

    #[inline(always)]
    fn call(self) -> Moments {
        let Self { arguments, channels, degree } = self;
        let mut out =
            Moments { of_basis: [0.0; SUMS], along: [[0.0; MOST]; 3], energy: [0.0; 3], samples: arguments.len() };
        // L_k and the two before it, over a tile.
        let mut legendre = [[0.0; TILE]; 3];
        for first in (0..arguments.len()).step_by(TILE) {
            let n = TILE.min(arguments.len() - first);
            let u = &arguments[first..first + n];
            let y = channels.map(|c| &c[first..first + n]);
            for c in 0..3 {
                out.energy[c] += dot_in(y[c], y[c]);
            }
            for k in 0..=2 * degree {
                let [now, last, before] = &mut legendre;
                match k {
                    0 => now.fill(1.0),
                    1 => now[..n].copy_from_slice(u),
                    _ => {
                        let (a, b) = ((2 * k - 1) as f64 / k as f64, (k - 1) as f64 / k as f64);
                        for (((now, u), last), before) in now[..n].iter_mut().zip(u).zip(&*last).zip(&*before) {
                            *now = a * u * last - b * before;
                        }
                    }
                }
                if k <= degree {
                    let sums = four_sums(&now[..n], y);
                    out.of_basis[k] += sums[3];
                    (0..3).for_each(|c| out.along[c][k] += sums[c]);
                } else {
                    out.of_basis[k] += sum_in(&now[..n]);
                }
                legendre.rotate_right(1);
            }
        }
        out
    }
}

/// Lanes of the sums.
const LANES: usize = 8;

/// Σ l y of each channel, and Σ l.
#[inline(always)]
fn four_sums(l: &[f64], [r, g, b]: [&[f64]; 3]) -> [f64; 4] {
    let (parts, rest) = l.as_chunks::<LANES>();
    let [r, g, b] = [r, g, b].map(|y| y.as_chunks::<LANES>());
    let mut lanes = [[0.0; LANES]; 4];
    for (((l, r), g), b) in parts.iter().zip(r.0).zip(g.0).zip(b.0) {
        for k in 0..LANES {
            lanes[0][k] += l[k] * r[k];
            lanes[1][k] += l[k] * g[k];
            lanes[2][k] += l[k] * b[k];
            lanes[3][k] += l[k];
        }
    }
    let mut sums = lanes.map(|lanes| lanes.iter().sum::<f64>());
    for (((l, r), g), b) in rest.iter().zip(r.1).zip(g.1).zip(b.1) {
        sums = [sums[0] + l * r, sums[1] + l * g, sums[2] + l * b, sums[3] + l];
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::material::legendre;

    #[test]
    fn a_product_of_two_polynomials_is_the_sum_of_others() {
        for (a, b) in (0..MOST).flat_map(|a| (0..=a).map(move |b| (a, b))) {
            let sum = product(a, b);
            for u in [-1.0, -0.7, 0.0, 0.31, 0.99] {
                let mut l = [0.0; SUMS];
                legendre::evaluate(u, &mut l);
                let found: f64 = sum.iter().enumerate().map(|(r, c)| c * l[a + b - 2 * r]).sum();
                assert!((found - l[a] * l[b]).abs() < 1e-14, "rounding of {b} sums: {a} {b} {u}");
            }
        }
    }

    fn row(samples: usize, steep: f64) -> (Vec<f64>, [Vec<f64>; 3]) {
        let u: Vec<f64> = (0..samples).map(|i| 2.0 * (-steep * i as f64 / samples as f64).exp() - 1.0).collect();
        let value = |c: usize, i: usize| (1.0 + 0.5 * c as f64) * (1.5 + u[i]).powf(1.3) + 1e-3 * ((i * i) as f64).sin();
        let channels = [0, 1, 2].map(|c| (0..samples).map(|i| value(c, i)).collect());
        (u, channels)
    }

    #[test]
    fn fits_are_those_of_the_orthonormal_basis_where_there_is_one() {
        let mut made = 0;
        for (samples, steep, degree) in [(741, 2.0, 7), (257, 0.5, 3), (13, 1.0, 2), (1000, 4.0, 5), (40, 1.0, 0)] {
            let (u, channels) = row(samples, steep);
            let basis = PolynomialBasis::new(&u, degree);
            let Some(fits) = MomentFits::new(degree).fit(&u, [&channels[0], &channels[1], &channels[2]]) else {
                continue;
            };
            made += 1;
            for (fit, values) in fits.iter().zip(&channels) {
                let other = basis.fit(values, degree);
                let largest = other.coefficients.iter().fold(0.0_f32, |a, c| a.max(c.abs()));
                for (a, b) in fit.coefficients.iter().zip(&other.coefficients) {
                    // A unit of f32 in the largest.
                    assert!((a - b).abs() <= 1.2e-7 * largest, "{samples} {steep} {degree}: {a} {b}");
                }
                assert!((fit.energy / other.energy - 1.0).abs() < 1e-13);
                // Rounded coefficients may be neighbours.
                assert!((fit.error / other.error - 1.0).abs() < 1e-3, "{} {}", fit.error, other.error);
            }
        }
        assert_eq!(made, 5);
    }

    #[test]
    fn rows_that_sums_do_not_tell_are_left_to_the_other_way() {
        let fits = |u: &[f64], y: &[f64], degree| MomentFits::new(degree).fit(u, [y, y, y]).is_some();
        let (u, [y, ..]) = row(500, 1.0);
        let close: Vec<f64> = u.iter().map(|u| 0.5 + 0.1 * u).collect();
        assert!(!fits(&close, &y, 7), "arguments close together");
        assert!(!fits(&[0.5; 9], &[2.0; 9], 1), "one argument");
        let (u, _) = row(500, 1.0);
        assert!(!fits(&u, &u, 2), "an error of rounding alone");
        assert!(!fits(&u, &vec![0.0; 500], 2), "nothing");
        assert!(!fits(&[], &[], 2), "no sample");
        let mut bad = u.clone();
        bad[3] = f64::NAN;
        assert!(!fits(&u, &bad, 2), "no number");
    }
}
