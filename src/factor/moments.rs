//! Colour polynomials from sums over a row, for rows that let it be done so quickly.
//!
//! A product of two Legendre polynomials is a sum of others (`Adams1878`): the normal equations of degree P are made of
//! Σ L_k(u), k to 2P, and Σ L_p(u) y. That is a tenth of the work of [`PolynomialBasis`], and loses twice the digits
//! that the columns' condition costs. Where that could be seen in a coefficient's f32, or in the error that is left,
//! there is no fit, and the row goes the other way.

use super::color::{Fit, MOST, PolynomialBasis};
use super::vector::{Lanes, add_all_in, add_products_in};
use crate::cholesky::Cholesky;
use crate::material::legendre::argument;
use pulp::{Arch, NullaryFnOnce};

/// A pivot is at least this share of its diagonal: 1e-16 over it is a hundredth of what rounding to f32 changes.
const PIVOT: f64 = 1e-7;
/// The error left is at least this share of the energy: the difference of sums that are right to 1e-15 tells it to a
/// thousandth.
const ERROR: f64 = 1e-12;
/// Samples that are worked on at a time: three polynomials and the channels there stay in the nearest cache.
const TILE: usize = 256;
/// 2P + 1 at the most.
const SUMS: usize = 2 * MOST - 1;

/// Sums of one row.
struct Moments {
    /// Σ L_k(u).
    of_basis: [Lanes; SUMS],
    /// Σ L_p(u) y of every channel.
    along: [[Lanes; MOST]; 3],
    /// Σ y².
    energy: [Lanes; 3],
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

    /// The same as [`PolynomialBasis::fit`] of every channel of a row that was measured everywhere; `None` where these
    /// sums do not tell it well enough.
    pub(super) fn fit(&self, row: &CompleteRow<'_>) -> Option<[Fit; 3]> {
        let moments = Arch::new().dispatch(Sum { row, degree: self.degree });
        let n = self.degree + 1;
        let total = |lanes: &Lanes| lanes.iter().sum::<f64>();
        let of_basis: Vec<f64> = moments.of_basis.iter().map(total).collect();
        let mut gram = vec![0.0; n * n];
        let mut products = self.products.iter();
        for a in 0..n {
            for (b, product) in (0..=a).zip(&mut products) {
                let sums = (0..=b).map(|r| product[r] * of_basis[a + b - 2 * r]);
                gram[a * n + b] = sums.sum::<f64>();
            }
        }
        let mut normal = gram.clone();
        (0..n).for_each(|a| normal[a * n + a] += PolynomialBasis::ridge_of(moments.samples));
        let cholesky = Cholesky::strict(normal, n, PIVOT)?;
        let fit = |c: usize| {
            let along: Vec<f64> = moments.along[c][..n].iter().map(total).collect();
            let mut exact = along.clone();
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
            let linear: f64 = rounded.iter().zip(&along).map(|(r, b)| r * b).sum();
            let energy = total(&moments.energy[c]);
            let error = energy - 2.0 * linear + quadratic;
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

/// A row, and the intensity of its terms, of which it is a polynomial.
pub(super) struct CompleteRow<'a> {
    /// Lines of the window: where each begins in the row, and in the intensity, and its length.
    pub lines: &'a [(usize, usize, usize)],
    /// R_d, mm⁻².
    pub response: &'a [[f32; 3]],
    pub intensity: &'a [f64],
    /// What becomes −1 and 1.
    pub interval: [f64; 2],
}

/// Some samples.
struct Tile {
    arguments: [f64; TILE],
    channels: [[f64; TILE]; 3],
    samples: usize,
}

struct Sum<'a> {
    row: &'a CompleteRow<'a>,
    degree: usize,
}

impl NullaryFnOnce for Sum<'_> {
    type Output = Moments;

    #[inline(always)]
    fn call(self) -> Moments {
        let Self { row, degree } = self;
        let none = Lanes::default();
        let mut out = Moments { of_basis: [none; SUMS], along: [[none; MOST]; 3], energy: [none; 3], samples: 0 };
        let mut tile = Tile { arguments: [0.0; TILE], channels: [[0.0; TILE]; 3], samples: 0 };
        for &(at, of_intensity, length) in row.lines {
            let mut done = 0;
            while done < length {
                let n = (length - done).min(TILE - tile.samples);
                let (intensity, response) =
                    (&row.intensity[of_intensity + done..][..n], &row.response[at + done..][..n]);
                tile.take(intensity, response, row.interval);
                done += n;
                if tile.samples == TILE {
                    out.add(&tile, degree);
                    tile.samples = 0;
                }
            }
        }
        out.add(&tile, degree);
        out
    }
}

impl Tile {
    #[inline(always)]
    fn take(&mut self, intensity: &[f64], response: &[[f32; 3]], [low, high]: [f64; 2]) {
        let (first, n) = (self.samples, intensity.len());
        for (to, &v) in self.arguments[first..first + n].iter_mut().zip(intensity) {
            *to = argument(v, low, high);
        }
        let [r, g, b] = self.channels.each_mut().map(|c| &mut c[first..first + n]);
        for ((rgb, r), (g, b)) in response.iter().zip(r).zip(g.iter_mut().zip(b)) {
            (*r, *g, *b) = (f64::from(rgb[0]), f64::from(rgb[1]), f64::from(rgb[2]));
        }
        self.samples += n;
    }
}

impl Moments {
    #[inline(always)]
    fn add(&mut self, tile: &Tile, degree: usize) {
        let n = tile.samples;
        self.samples += n;
        let (u, y) = (&tile.arguments[..n], tile.channels.each_ref().map(|c| &c[..n]));
        for c in 0..3 {
            add_products_in(&mut self.energy[c], y[c], y[c]);
        }
        // L_k and the two before it.
        let mut legendre = [[0.0; TILE]; 3];
        for k in 0..=2 * degree {
            // Each takes the place of the one that is no longer needed.
            let [a, b, c] = &mut legendre;
            let (now, last, before) = match k % 3 {
                0 => (a, &*c, &*b),
                1 => (b, &*a, &*c),
                _ => (c, &*b, &*a),
            };
            match k {
                0 => now.fill(1.0),
                1 => now[..n].copy_from_slice(u),
                _ => {
                    let (a, b) = ((2 * k - 1) as f64 / k as f64, (k - 1) as f64 / k as f64);
                    for (((now, u), last), before) in now[..n].iter_mut().zip(u).zip(last).zip(before) {
                        *now = a * u * last - b * before;
                    }
                }
            }
            add_all_in(&mut self.of_basis[k], &now[..n]);
            if k <= degree {
                // A closure would be compiled without the vector instructions.
                for c in 0..3 {
                    add_products_in(&mut self.along[c][k], &now[..n], y[c]);
                }
            }
        }
    }
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

    /// A row of three lines, its intensities, and its samples as the orthonormal basis takes them.
    struct Made {
        lines: Vec<(usize, usize, usize)>,
        response: Vec<[f32; 3]>,
        intensity: Vec<f64>,
        arguments: Vec<f64>,
        channels: [Vec<f64>; 3],
    }

    const INTERVAL: [f64; 2] = [0.0, 2.0];

    /// `left` samples at the end of each line lie outside of the common window; intensities lie two further there.
    fn row(width: usize, left: usize, of: impl Fn(f64) -> f64) -> Made {
        let lines: Vec<_> = (0..3).map(|y| (y * width, y * (width + 2) + 1, width - left)).collect();
        let at = |k: usize| of((k % width) as f64 / width as f64 + (k / width) as f64 / (3 * width) as f64);
        let value = |k: usize, c: usize| {
            ((1.0 + 0.5 * c as f64) * (0.5 + at(k)).powf(1.3) + 1e-3 * ((k * k) as f64).sin()) as f32
        };
        let response: Vec<[f32; 3]> = (0..3 * width).map(|k| [0, 1, 2].map(|c| value(k, c))).collect();
        let mut intensity = vec![f64::NAN; 3 * (width + 2)];
        let inside = || lines.iter().flat_map(|&(k, e, n)| (0..n).map(move |x| (k + x, e + x)));
        inside().for_each(|(k, e)| intensity[e] = at(k));
        let arguments = inside().map(|(k, _)| at(k) - 1.0).collect();
        let channels = [0, 1, 2].map(|c| inside().map(|(k, _)| f64::from(response[k][c])).collect());
        Made { lines, response, intensity, arguments, channels }
    }

    impl Made {
        fn fit(&self, degree: usize) -> Option<[Fit; 3]> {
            let Self { lines, response, intensity, .. } = self;
            MomentFits::new(degree).fit(&CompleteRow { lines, response, intensity, interval: INTERVAL })
        }
    }

    #[test]
    fn fits_are_those_of_the_orthonormal_basis_where_there_is_one() {
        for (width, left, steep, degree) in
            [(247, 0, 2.0, 7), (85, 3, 0.5, 3), (9, 1, 1.0, 2), (300, 0, 4.0, 5), (13, 2, 1.0, 0)]
        {
            let row = row(width, left, |x| 2.0 * (-steep * x).exp());
            let basis = PolynomialBasis::new(&row.arguments, degree);
            for (fit, values) in row.fit(degree).unwrap().iter().zip(&row.channels) {
                let other = basis.fit(values, degree);
                let largest = other.coefficients.iter().fold(0.0_f32, |a, c| a.max(c.abs()));
                for (a, b) in fit.coefficients.iter().zip(&other.coefficients) {
                    // A unit of f32 in the largest.
                    assert!((a - b).abs() <= 1.2e-7 * largest, "{width} {steep} {degree}: {a} {b}");
                }
                assert!((fit.energy / other.energy - 1.0).abs() < 1e-13);
                // Rounded coefficients may be neighbours.
                assert!((fit.error / other.error - 1.0).abs() < 1e-3, "{} {}", fit.error, other.error);
            }
        }
    }

    #[test]
    fn rows_that_sums_do_not_tell_are_left_to_the_other_way() {
        assert!(row(170, 0, |x| 1.0 + 0.1 * x).fit(7).is_none(), "arguments close together");
        assert!(row(3, 0, |_| 0.5).fit(1).is_none(), "one argument");
        let good = || row(170, 0, |x| 2.0 * (-x).exp());
        assert!(good().fit(2).is_some());
        let linear = good().intensity.iter().filter(|v| v.is_finite()).map(|&v| [v as f32; 3]).collect();
        assert!(Made { response: linear, ..good() }.fit(2).is_none(), "an error of rounding alone");
        assert!(Made { response: vec![[0.0; 3]; 510], ..good() }.fit(2).is_none(), "nothing");
        assert!(Made { lines: Vec::new(), ..good() }.fit(2).is_none(), "no sample");
        let mut bad = good();
        bad.response[3][1] = f32::NAN;
        assert!(bad.fit(2).is_none(), "no number");
    }
}
