//! Colour: every channel of a row as a polynomial of the row's normalized intensity (`Kurt2013`, eqs. (2)–(4)).
//!
//! Least squares in polynomials that are orthonormal over the row's own samples, made by the Arnoldi process
//! (`Brubeck2021`): the next one is the argument times the last, less what lies along all earlier ones. Degree after
//! degree, so that the fit of every lower degree is contained in it, and as accurate as a Householder QR of the
//! Legendre columns, whose condition reaches 1e8 for a steep row at degree 15. A polynomial that the earlier ones
//! already span (a constant row, fewer distinct intensities than P+1) ends the row's fit there; the coefficients above
//! are zero.
//!
//! Most of a steep row's intensities lie close together, and polynomials of high degree then differ by little:
//! coefficients of 1e8 that cancel to 1 fit well in f64 and are useless as f32. What rounding a coefficient to f32 will
//! add is therefore part of the least squares, as a ridge: rounding is uniform within half a unit in the last place,
//! and |L_p| ≤ 1.

use super::noise::F32_ROUNDING;
use super::vector::{axpy_in, dot, dot_in};
use crate::cholesky::Cholesky;
use crate::material::legendre::MOST_DEGREE;
use pulp::{Arch, NullaryFnOnce};

/// A polynomial counts as new when what the earlier ones leave of it exceeds this share of its length; below, its
/// direction is known to fewer than half the digits of an f64.
const INDEPENDENT: f64 = 1e-8;
/// Samples that are worked on at a time: those of all columns stay in the nearest cache.
const TILE: usize = 256;
/// P + 1 at the most.
pub(super) const MOST: usize = MOST_DEGREE + 1;

/// An orthonormal basis of the polynomials at the arguments of one row.
#[derive(Debug, Clone)]
pub(super) struct PolynomialBasis {
    /// q_p at the samples, unit vectors, one after the other.
    columns: Vec<f64>,
    samples: usize,
    /// Row p: q_p in the Legendre basis.
    legendre: Vec<[f64; MOST]>,
}

/// A fit to one channel of a row.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Fit {
    /// Legendre coefficients, rounded to f32, as many as the degree asked for and one.
    pub coefficients: Vec<f32>,
    /// Σ of squared differences that the rounded coefficients leave.
    pub error: f64,
    /// Σ of squared values.
    pub energy: f64,
}

impl PolynomialBasis {
    /// The basis up to `degree` (15 at the most) at arguments in [−1, 1].
    pub(super) fn new(arguments: &[f64], degree: usize) -> Self {
        Arch::new().dispatch(Build { arguments, degree: degree.min(MOST_DEGREE) })
    }

    fn column(&self, p: usize) -> &[f64] {
        &self.columns[p * self.samples..(p + 1) * self.samples]
    }

    /// How many are independent.
    fn len(&self) -> usize {
        self.legendre.len()
    }

    /// The share of each degree in `values`, q_p · y.
    pub(super) fn project(&self, values: &[f64]) -> Vec<f64> {
        (0..self.len()).map(|p| dot(self.column(p), values)).collect()
    }

    /// The polynomial up to `degree` for `values` that is best once its coefficients are rounded to f32: least
    /// squares of the misfit and of the expected rounding together.
    pub(super) fn fit(&self, values: &[f64], degree: usize) -> Fit {
        self.fit_projected(&self.project(values), dot(values, values), degree)
    }

    /// Σ of squared errors of [`Self::fit`] at every degree up to `most`: `values` are projected once for all.
    pub(super) fn errors_by_degree(&self, values: &[f64], most: usize) -> Vec<f64> {
        let (along, energy) = (self.project(values), dot(values, values));
        (0..=most).map(|degree| self.fit_projected(&along, energy, degree).error).collect()
    }

    /// What rounding a Legendre coefficient to f32 is expected to add, over its square.
    pub(super) fn ridge_of(samples: usize) -> f64 {
        samples as f64 * F32_ROUNDING * F32_ROUNDING / 3.0
    }

    fn fit_projected(&self, along: &[f64], energy: f64, degree: usize) -> Fit {
        let n = along.len().min(degree + 1);
        let ridge = Self::ridge_of(self.samples);
        // (I + λ T Tᵀ) s = Qᵀ y, T the Legendre coefficients of the orthonormal polynomials.
        let mut normal = vec![0.0; n * n];
        for a in 0..n {
            for b in 0..=a {
                let products: f64 = self.legendre[a].iter().zip(&self.legendre[b]).map(|(a, b)| a * b).sum();
                normal[a * n + b] = ridge * products + f64::from(u8::from(a == b));
            }
        }
        let mut shares = along[..n].to_vec();
        if !Cholesky::dropping(normal, n).solve(&mut shares) {
            shares.fill(0.0);
        }
        let mut sum = [0.0; MOST];
        for (share, legendre) in shares.iter().zip(&self.legendre) {
            sum.iter_mut().zip(legendre).for_each(|(s, l)| *s += share * l);
        }
        let mut coefficients: Vec<f32> = sum[..n].iter().map(|&c| c as f32).collect();
        let kept: f64 = along[..n].iter().map(|a| a * a).sum();
        let off: f64 = along.iter().zip(&shares).map(|(a, s)| (a - s) * (a - s)).sum();
        let error = (energy - kept).max(0.0) + off + self.rounded(&sum, &coefficients);
        coefficients.resize(degree + 1, 0.0);
        Fit { coefficients, error, energy }
    }

    /// Σ of squares over the samples of what rounding coefficients changes.
    fn rounded(&self, exact: &[f64; MOST], rounded: &[f32]) -> f64 {
        let mut rest: Vec<f64> = rounded.iter().zip(exact).map(|(&r, e)| f64::from(r) - e).collect();
        let mut sum = 0.0;
        for p in (0..rest.len()).rev() {
            let share = rest[p] / self.legendre[p][p];
            sum += share * share;
            rest.iter_mut().zip(&self.legendre[p]).for_each(|(r, l)| *r -= share * l);
        }
        sum
    }

    /// Ratio of the largest to the smallest pivot of the Legendre columns' triangular factor: their condition number or
    /// less. Of the columns up to each degree up to `most`; degrees that the row cannot support repeat the last one
    /// that it can.
    pub(super) fn conditions(&self, most: usize) -> Vec<f64> {
        let (mut low, mut high) = (f64::INFINITY, 0.0_f64);
        let up_to = |p: usize| {
            if let Some(legendre) = self.legendre.get(p) {
                let pivot = (1.0 / legendre[p]).abs();
                (low, high) = (low.min(pivot), high.max(pivot));
            }
            if low > 0.0 && low.is_finite() { high / low } else { 1.0 }
        };
        (0..=most).map(up_to).collect()
    }

    /// z² of every degree: (q_p · y)² over what noise alone would give, Σ q_p² v + Σ_a (q_p · e_a)², where `variance`
    /// is that of independent noise and the `errors` e_a are what one standard deviation of an error common to the
    /// whole row changes. `None` where neither is positive, and above the degree that the row can make use of.
    pub(super) fn significance(&self, values: &[f64], variance: &[f64], errors: &[Vec<f64>]) -> Vec<Option<f64>> {
        let z2 = |q: &[f64]| {
            let independent: f64 = q.iter().zip(variance).map(|(q, v)| q * q * v).sum();
            let expected = independent + errors.iter().map(|e| dot(q, e).powi(2)).sum::<f64>();
            (expected > 0.0).then(|| dot(q, values).powi(2) / expected)
        };
        // Beyond these the ridge keeps less than half of a share: the row cannot make use of the degree.
        let ridge = Self::ridge_of(self.samples);
        let usable = |l: &&[f64; MOST]| ridge * l.iter().map(|c| c * c).sum::<f64>() < 1.0;
        let count = self.legendre.iter().take_while(usable).count();
        (0..count).map(|p| z2(self.column(p))).collect()
    }
}

struct Build<'a> {
    arguments: &'a [f64],
    degree: usize,
}

impl NullaryFnOnce for Build<'_> {
    type Output = PolynomialBasis;

    #[inline(always)]
    fn call(self) -> PolynomialBasis {
        let Self { arguments, degree } = self;
        let samples = arguments.len();
        let mut basis =
            PolynomialBasis { columns: Vec::with_capacity(samples * (degree + 1)), samples, legendre: Vec::new() };
        if samples == 0 {
            return basis;
        }
        let first = 1.0 / (samples as f64).sqrt();
        basis.columns.resize(samples, first);
        let mut constant = [0.0; MOST];
        constant[0] = first;
        basis.legendre.push(constant);
        for p in 0..degree {
            let (known, mut along) = ((p + 1) * samples, [0.0; MOST]);
            basis.columns.resize(known + samples, 0.0);
            let (earlier, new) = basis.columns.split_at_mut(known);
            let last = &earlier[p * samples..];
            for ((v, u), q) in new.iter_mut().zip(arguments).zip(last) {
                *v = u * q;
            }
            let length = dot_in(new, new).sqrt();
            // Twice is enough (`Giraud2005`), and needed only where little is left.
            let mut rest = length;
            for _ in 0..2 {
                let before = rest;
                orthogonalize(earlier, new, samples, p + 1, &mut along);
                rest = dot_in(new, new).sqrt();
                if rest > 0.5 * before {
                    break;
                }
            }
            if !(rest > INDEPENDENT * length) {
                basis.columns.truncate(known);
                break;
            }
            for v in new.iter_mut() {
                *v /= rest;
            }
            let mut next = times_argument(&basis.legendre[p]);
            for (j, share) in along.iter().enumerate().take(p + 1) {
                for n in 0..MOST {
                    next[n] -= share * basis.legendre[j][n];
                }
            }
            for n in 0..MOST {
                next[n] /= rest;
            }
            basis.legendre.push(next);
        }
        basis
    }
}

/// Takes out of `new` what lies along the first `count` columns and adds how much that was.
#[inline(always)]
fn orthogonalize(columns: &[f64], new: &mut [f64], samples: usize, count: usize, along: &mut [f64; MOST]) {
    let mut shares = [0.0; MOST];
    for first in (0..samples).step_by(TILE) {
        let range = first..(first + TILE).min(samples);
        for j in 0..count {
            shares[j] += dot_in(&columns[j * samples..][range.clone()], &new[range.clone()]);
        }
    }
    for first in (0..samples).step_by(TILE) {
        let range = first..(first + TILE).min(samples);
        for j in 0..count {
            axpy_in(-shares[j], &columns[j * samples..][range.clone()], &mut new[range.clone()]);
        }
    }
    for j in 0..count {
        along[j] += shares[j];
    }
}

/// Legendre coefficients of u times a polynomial: u L_n = ((n+1) L_{n+1} + n L_{n−1}) / (2n+1).
#[inline(always)]
fn times_argument(polynomial: &[f64; MOST]) -> [f64; MOST] {
    let mut out = [0.0; MOST];
    for n in 0..MOST {
        let share = polynomial[n] / (2 * n + 1) as f64;
        if n + 1 < MOST {
            out[n + 1] += (n + 1) as f64 * share;
        }
        if n > 0 {
            out[n - 1] += n as f64 * share;
        }
    }
    out
}

/// The mean significance of each degree over rows and channels.
#[derive(Debug, Clone)]
pub(super) struct DegreeChoice {
    sums: Vec<f64>,
    count: usize,
}

impl DegreeChoice {
    /// For degrees up to `max_degree`.
    pub(super) fn new(max_degree: usize) -> Self {
        Self { sums: vec![0.0; max_degree + 1], count: 0 }
    }

    /// Adds one channel of one row; degrees that the row cannot support count as explaining nothing.
    pub(super) fn add(&mut self, significance: &[Option<f64>]) {
        if significance.iter().all(Option::is_none) {
            return;
        }
        self.count += 1;
        for (sum, z2) in self.sums.iter_mut().zip(significance) {
            *sum += z2.unwrap_or(0.0);
        }
    }

    /// Mean z² per degree.
    pub(super) fn mean(&self) -> Vec<f64> {
        self.sums.iter().map(|s| s / self.count.max(1) as f64).collect()
    }

    /// The degree of the least Akaike information criterion (`Akaike1974`).
    ///
    /// A coefficient lowers −2 ln L by z² and costs 2, so the criterion falls as long as the mean z² exceeds 2. The
    /// degree taken is the one where the sum of (z² − 2) from degree 1 on is largest, the lowest of equals: an
    /// unneeded degree between two needed ones does not end the search, a weak one far above does not extend it.
    pub(super) fn degree(&self) -> usize {
        let (mut best, mut degree, mut sum) = (0.0, 0, 0.0);
        for (p, z2) in self.mean().into_iter().enumerate().skip(1) {
            sum += z2 - 2.0;
            if sum > best {
                (best, degree) = (sum, p);
            }
        }
        degree
    }
}

#[cfg(test)]
mod tests;
