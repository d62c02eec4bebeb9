//! Samples of the common window that a row did not measure, estimated so that the factorization needs no weights.
//!
//! Any constant, and edge extension too, would make rows near the sample's rim differ from the others and cost
//! terms. Here a row's missing part is what the other rows have there: first the mean profile scaled to the row, then
//! the factorization itself, fitted to what the row measured. Iterating that is expectation maximization for
//! probabilistic PCA with missing data (`Tipping1999`); estimates never enter the colour regression or a measure.

use super::svd::LowRank;
use faer::linalg::matmul::matmul;
use faer::{Accum, Col, Mat, Par};

/// Profiles that a row is composed of, with how much of each to expect.
#[derive(Debug, Clone)]
pub struct Basis {
    /// Profiles, \[k, columns\].
    vectors: Vec<f64>,
    /// Expected variance of each coefficient, \[k\]; infinite when nothing is known.
    prior: Vec<f64>,
    /// Variance of a sample's deviation from the profiles.
    noise: f64,
    columns: usize,
}

impl Basis {
    /// The mean profile, in any amount.
    pub fn mean(profile: Vec<f64>) -> Self {
        Self { columns: profile.len(), vectors: profile, prior: vec![f64::INFINITY], noise: 0.0 }
    }

    /// The first `terms` of a factorization of `rows` rows; `noise` is the variance of one sample.
    pub fn factors(low_rank: &LowRank, terms: usize, rows: usize, columns: usize, noise: f64) -> Self {
        let prior = low_rank.singular_values.iter().take(terms).map(|s| s * s / rows.max(1) as f64).collect();
        let vectors = low_rank.vectors[..terms.min(low_rank.singular_values.len()) * columns].to_vec();
        // A floor that keeps the system solvable when rows are exact: a millionth of the peak.
        Self { vectors, prior, noise: noise.max(1e-12), columns }
    }

    /// Replaces the samples of `row` that were not measured; a row without any measured sample stays as it is.
    pub fn fill(&self, row: &mut [f64], measured: &[bool]) {
        let known: Vec<usize> = (0..row.len()).filter(|&d| measured[d]).collect();
        if known.is_empty() || known.len() == row.len() {
            return;
        }
        let k = self.prior.len();
        let profile = |j: usize| &self.vectors[j * self.columns..(j + 1) * self.columns];
        let profiles = Mat::from_fn(known.len(), k, |i, j| profile(j)[known[i]]);
        let values = Col::from_fn(known.len(), |i| row[known[i]]);
        let (mut normal, mut rhs) = (Mat::<f64>::zeros(k, k), Col::<f64>::zeros(k));
        // On one thread each: rows are filled side by side.
        matmul(normal.as_mut(), Accum::Replace, profiles.transpose(), profiles.as_ref(), 1.0, Par::Seq);
        matmul(rhs.as_mut(), Accum::Replace, profiles.transpose(), values.as_ref(), 1.0, Par::Seq);
        for a in 0..k {
            normal[(a, a)] += if self.prior[a] > 0.0 { self.noise / self.prior[a] } else { f64::INFINITY };
        }
        let normal = (0..k * k).map(|at| normal[(at / k, at % k)]).collect();
        let rhs = rhs.iter().copied().collect();
        let Some(coefficients) = solve(normal, rhs) else { return };
        for (d, value) in row.iter_mut().enumerate().filter(|(d, _)| !measured[*d]) {
            *value = coefficients.iter().enumerate().map(|(j, c)| c * profile(j)[d]).sum();
        }
    }
}

/// Solves a symmetric positive definite system (lower half given) by Cholesky; a pivot that is not positive, or not
/// finite, drops its unknown. `None` when the result is not finite.
fn solve(mut a: Vec<f64>, mut b: Vec<f64>) -> Option<Vec<f64>> {
    let k = b.len();
    for j in 0..k {
        let pivot = a[j * k + j] - (0..j).map(|p| a[j * k + p] * a[j * k + p]).sum::<f64>();
        let usable = pivot.is_finite() && pivot > 1e-14 * a[j * k + j];
        let root = if usable { pivot.sqrt() } else { f64::INFINITY };
        a[j * k + j] = root;
        for i in j + 1..k {
            let dot: f64 = (0..j).map(|p| a[i * k + p] * a[j * k + p]).sum();
            a[i * k + j] = (a[i * k + j] - dot) / root;
        }
    }
    for i in 0..k {
        b[i] = (b[i] - (0..i).map(|p| a[i * k + p] * b[p]).sum::<f64>()) / a[i * k + i];
    }
    for i in (0..k).rev() {
        b[i] = (b[i] - (i + 1..k).map(|p| a[p * k + i] * b[p]).sum::<f64>()) / a[i * k + i];
    }
    b.iter().all(|v| v.is_finite()).then_some(b)
}

/// Extends a profile into samples that no row measured: each takes the nearest measured sample of its line, and
/// a line without any takes the nearest line that has some. All missing stays zero.
pub fn extend_edges(values: &mut [f64], measured: &[bool], size: [usize; 2]) {
    let [w, h] = size;
    let nearest = |at: usize, known: &dyn Fn(usize) -> bool, len: usize| {
        (0..len).filter(|&k| known(k)).min_by_key(|&k| (k.abs_diff(at), k))
    };
    let has_any: Vec<bool> = (0..h).map(|y| measured[y * w..(y + 1) * w].iter().any(|&m| m)).collect();
    let known = values.to_vec();
    for y in 0..h {
        let Some(line) = nearest(y, &|k| has_any[k], h) else { return };
        for x in 0..w {
            let Some(column) = nearest(x, &|k| measured[line * w + k], w) else { continue };
            values[y * w + x] = known[line * w + column];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_of_the_mean_profile_is_completed_exactly() {
        let basis = Basis::mean(vec![1.0, 4.0, 2.0, 0.5]);
        let mut row = vec![0.0, 8.0, 4.0, 0.0];
        basis.fill(&mut row, &[false, true, true, false]);
        assert_eq!(row, [2.0, 8.0, 4.0, 1.0]);
    }

    #[test]
    fn a_row_of_two_terms_is_completed_to_the_ridge() {
        let low = LowRank { singular_values: vec![3.0, 1.0], vectors: vec![0.5, 0.5, 0.5, 0.5, 0.5, -0.5, 0.5, -0.5] };
        let basis = Basis::factors(&low, 2, 4, 4, 0.0);
        let mut row = vec![3.0, 1.0, 0.0, 0.0];
        basis.fill(&mut row, &[true, true, false, false]);
        // The ridge of 1e-12 against a variance of 0.25 biases by 1e-11.
        assert!((row[2] - 3.0).abs() < 1e-10 && (row[3] - 1.0).abs() < 1e-10, "{row:?}");
    }

    #[test]
    fn profiles_that_cannot_be_told_apart_still_give_finite_numbers() {
        let low = LowRank { singular_values: vec![1.0, 0.0], vectors: vec![1.0, 0.0, 0.0, 1.0] };
        let mut row = vec![2.0, 0.0];
        Basis::factors(&low, 2, 3, 2, 0.0).fill(&mut row, &[true, false]);
        assert_eq!(row, [2.0, 0.0]);
    }

    #[test]
    fn edges_are_extended_from_the_nearest_measured_sample() {
        let mut values = [0.0, 0.0, 0.0, 0.0, 5.0, 7.0, 0.0, 0.0, 0.0];
        extend_edges(&mut values, &[false, false, false, false, true, true, false, false, false], [3, 3]);
        assert_eq!(values, [5.0, 5.0, 7.0, 5.0, 5.0, 7.0, 5.0, 5.0, 7.0]);
    }
}
