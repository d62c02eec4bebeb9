//! Colour: every channel of a row as a polynomial of the row's normalized intensity (`Kurt2013`, eqs. (2)–(4)).
//!
//! Least squares by QR of Legendre columns, degree after degree, so that the fit of every lower degree is contained
//! in it. A column that the earlier ones already span (a constant row, fewer distinct intensities than P+1) ends the
//! row's polynomial there; the coefficients above are zero.
//!
//! Most of a steep row's intensities lie close together, and columns of high degree then differ by little:
//! coefficients of 1e8 that cancel to 1 fit well in f64 and are useless as f32. Each row therefore takes, up to P,
//! the degree at which what the fit leaves and what rounding its coefficients adds are least together.

use super::noise::F32_ROUNDING;
use crate::material::legendre;

/// A column counts as new when what the earlier columns leave of it exceeds this share of its length; below, its
/// direction is known to fewer than half the digits of an f64.
const INDEPENDENT: f64 = 1e-8;

/// An orthonormal basis of the polynomials at the arguments of one row.
#[derive(Debug, Clone)]
pub struct PolynomialBasis {
    /// q_p, unit vectors over the samples; as many as are independent.
    columns: Vec<Vec<f64>>,
    /// Column p of the triangular factor: Legendre column p in terms of q_0 … q_p.
    triangle: Vec<Vec<f64>>,
}

impl PolynomialBasis {
    /// The basis up to `degree` at arguments in [−1, 1].
    pub fn new(arguments: &[f64], degree: usize) -> Self {
        let (mut columns, mut triangle) = (Vec::<Vec<f64>>::new(), Vec::new());
        for mut column in legendre::columns(arguments, degree + 1) {
            let length = norm(&column);
            let mut entries = vec![0.0; columns.len() + 1];
            // Twice is enough (`Giraud2005`) for orthogonality to rounding.
            for _ in 0..2 {
                for (q, entry) in columns.iter().zip(&mut entries) {
                    let along = dot(q, &column);
                    *entry += along;
                    column.iter_mut().zip(q).for_each(|(v, q)| *v -= along * q);
                }
            }
            let rest = norm(&column);
            if !(rest > INDEPENDENT * length) {
                break;
            }
            column.iter_mut().for_each(|v| *v /= rest);
            entries[columns.len()] = rest;
            columns.push(column);
            triangle.push(entries);
        }
        Self { columns, triangle }
    }

    /// The share of each degree in `values`, q_p · y.
    pub fn project(&self, values: &[f64]) -> Vec<f64> {
        self.columns.iter().map(|q| dot(q, values)).collect()
    }

    /// Legendre coefficients of the fit to `values`, `degree + 1` of them: least squares, of the degree up to `degree`
    /// that is best once they are rounded to f32.
    pub fn fit(&self, values: &[f64], degree: usize) -> Vec<f64> {
        let along = self.project(values);
        let mut left = dot(values, values);
        let mut best = (left, Vec::new());
        for p in 0..along.len().min(degree + 1) {
            left = (left - along[p] * along[p]).max(0.0);
            let coefficients = self.solve(&along[..=p]);
            // |L_p| ≤ 1 at every sample
            let rounding = values.len() as f64 * F32_ROUNDING * F32_ROUNDING * dot(&coefficients, &coefficients);
            if left + rounding < best.0 {
                best = (left + rounding, coefficients);
            }
        }
        best.1.resize(degree + 1, 0.0);
        best.1
    }

    /// Legendre coefficients of a polynomial given by its shares in the orthonormal columns.
    fn solve(&self, along: &[f64]) -> Vec<f64> {
        let mut rest = along.to_vec();
        let mut out = vec![0.0; along.len()];
        for p in (0..rest.len()).rev() {
            out[p] = rest[p] / self.triangle[p][p];
            for (r, t) in rest.iter_mut().zip(&self.triangle[p]).take(p) {
                *r -= t * out[p];
            }
        }
        out
    }

    /// z² of every degree: (q_p · y)² over what noise alone would give, Σ q_p² v + Σ_a (q_p · e_a)², where `variance`
    /// is that of independent noise and the `errors` e_a are what one standard deviation of an error common to the
    /// whole row changes. `None` where neither is positive, and above the degree that the row can make use of.
    pub fn significance(&self, values: &[f64], variance: &[f64], errors: &[Vec<f64>]) -> Vec<Option<f64>> {
        let z2 = |q: &Vec<f64>| {
            let independent: f64 = q.iter().zip(variance).map(|(q, v)| q * q * v).sum();
            let expected = independent + errors.iter().map(|e| dot(q, e).powi(2)).sum::<f64>();
            (expected > 0.0).then(|| dot(q, values).powi(2) / expected)
        };
        let usable = self.fit(values, self.columns.len().saturating_sub(1)).iter().rposition(|&c| c != 0.0);
        self.columns.iter().take(usable.map_or(0, |p| p + 1)).map(z2).collect()
    }
}

/// The mean significance of each degree over rows and channels.
#[derive(Debug, Clone)]
pub struct DegreeChoice {
    sums: Vec<f64>,
    count: usize,
}

impl DegreeChoice {
    /// For degrees up to `max_degree`.
    pub fn new(max_degree: usize) -> Self {
        Self { sums: vec![0.0; max_degree + 1], count: 0 }
    }

    /// Adds one channel of one row; degrees that the row cannot support count as explaining nothing.
    pub fn add(&mut self, significance: &[Option<f64>]) {
        if significance.iter().all(Option::is_none) {
            return;
        }
        self.count += 1;
        for (sum, z2) in self.sums.iter_mut().zip(significance) {
            *sum += z2.unwrap_or(0.0);
        }
    }

    /// Mean z² per degree.
    pub fn mean(&self) -> Vec<f64> {
        self.sums.iter().map(|s| s / self.count.max(1) as f64).collect()
    }

    /// The degree of the least Akaike information criterion (`Akaike1974`).
    ///
    /// A coefficient lowers −2 ln L by z² and costs 2, so the criterion falls as long as the mean z² exceeds 2. The
    /// degree taken is the one where the sum of (z² − 2) from degree 1 on is largest, the lowest of equals: an
    /// unneeded degree between two needed ones does not end the search, a weak one far above does not extend it.
    pub fn degree(&self) -> usize {
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

/// Sums in eight lanes: a single sum waits for each addition, and most of the time of a fit is spent here.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
    let mut lanes = [0.0; 8];
    for (a, b) in a.iter().zip(b) {
        for k in 0..8 {
            lanes[k] += a[k] * b[k];
        }
    }
    lanes.iter().sum::<f64>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f64>()
}

fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::linalg::solvers::SolveLstsq;
    use rand::{Rng, SeedableRng};
    use rand_distr::{Distribution, StandardNormal};

    fn value(coefficients: &[f64], u: f64) -> f64 {
        let mut basis = vec![0.0; coefficients.len()];
        legendre::evaluate(u, &mut basis);
        dot(&basis, coefficients)
    }

    #[test]
    fn the_fit_is_the_least_squares_solution_of_an_independent_solver() {
        let mut random = rand_pcg::Pcg64::seed_from_u64(3);
        let mut next = || f64::from(random.next_u32()) / f64::from(u32::MAX);
        for degree in [0, 1, 7, 15] {
            let u: Vec<f64> = (0..200).map(|_| 2.0 * next().powi(3) - 1.0).collect();
            let y: Vec<f64> = u.iter().map(|u| (3.0 * u).sin() + 0.1 * next()).collect();
            let fit = PolynomialBasis::new(&u, degree).fit(&y, degree);
            let powers = faer::Mat::from_fn(200, degree + 1, |i, p| {
                let mut basis = vec![0.0; degree + 1];
                legendre::evaluate(u[i], &mut basis);
                basis[p]
            });
            let expected = powers.qr().solve_lstsq(faer::Mat::from_fn(200, 1, |i, _| y[i]));
            for (p, c) in fit.iter().enumerate() {
                // condition of the columns up to 1e3 at degree 15: 1e3 · eps · 1e3
                assert!((c - expected[(p, 0)]).abs() < 1e-9, "degree {degree}: {c} {}", expected[(p, 0)]);
            }
        }
    }

    #[test]
    fn rows_that_cannot_support_the_degree_get_a_lower_one() {
        let constant = PolynomialBasis::new(&[0.25; 9], 7).fit(&[2.0; 9], 7);
        assert!((value(&constant, 0.25) - 2.0).abs() < 1e-14 && constant[1..].iter().all(|&c| c == 0.0));
        let two = PolynomialBasis::new(&[-1.0, 0.5, -1.0, 0.5], 15).fit(&[1.0, 4.0, 1.0, 4.0], 15);
        assert!((value(&two, 0.5) - 4.0).abs() < 1e-13 && (value(&two, -1.0) - 1.0).abs() < 1e-13);
        let none = PolynomialBasis::new(&[], 3).fit(&[], 3);
        assert_eq!(none, [0.0; 4]);
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
}
