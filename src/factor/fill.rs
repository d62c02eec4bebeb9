//! Samples of the common window that a row did not measure, estimated so that the factorization needs no weights.
//!
//! Any constant, and edge extension too, would make rows near the sample's rim differ from the others and cost
//! terms. Here a row's missing part is what the other rows have there: first the mean profile scaled to the row, then
//! the factorization itself, fitted to what the row measured. Iterating that is expectation maximization for
//! probabilistic PCA with missing data (`Tipping1999`); estimates never enter the colour regression or a measure.

use super::backend::{LowRank, product};
use super::vector::dot;
use faer::MatRef;
use rayon::prelude::*;

/// Multiplications of a block that are quick in f64.
const FEW_PRODUCTS: usize = 20_000_000;

/// Which columns of a row were not measured.
#[derive(Debug, Clone, PartialEq)]
pub enum Missing {
    /// None.
    Nothing,
    /// Those of a pattern that many rows share, by its number.
    Pattern(usize),
    /// These, ascending.
    Columns(Vec<u32>),
}

/// Profiles that a row is composed of, with how much of each to expect.
#[derive(Debug, Clone)]
pub struct Basis {
    /// Profiles, \[k, columns\].
    vectors: Vec<f64>,
    /// What is added to the diagonal: noise variance over the expected variance of each coefficient, \[k\].
    ridge: Vec<f64>,
    columns: usize,
}

/// A basis and the solved systems of the gaps that many rows share.
pub(super) struct PreparedBasis<'a> {
    basis: &'a Basis,
    /// Products of the profiles, \[k, k\].
    gram: Vec<f64>,
    patterns: Vec<Gap<'a>>,
}

/// Missing columns, the system of rows that miss them, and the profiles there, \[k, columns missing\].
struct Gap<'a> {
    columns: &'a [u32],
    cholesky: Cholesky,
    profiles: Vec<f64>,
}

impl Basis {
    /// The mean profile, in any amount.
    pub fn mean(profile: &[f64]) -> Self {
        Self { columns: profile.len(), vectors: profile.to_vec(), ridge: vec![0.0] }
    }

    /// The first `terms` of a factorization of `rows` rows; `noise` is the variance of one sample.
    pub fn factors(low_rank: &LowRank, terms: usize, rows: usize, columns: usize, noise: f64) -> Self {
        // A floor that keeps the system solvable when rows are exact: a millionth of the peak.
        let noise = noise.max(1e-12);
        let variance = |s: &f64| s * s / rows.max(1) as f64;
        let ridge = low_rank.singular_values.iter().take(terms).map(|s| noise / variance(s)).collect();
        let vectors = low_rank.vectors[..terms.min(low_rank.singular_values.len()) * columns].to_vec();
        Self { vectors, ridge, columns }
    }

    fn profile(&self, j: usize) -> &[f64] {
        &self.vectors[j * self.columns..(j + 1) * self.columns]
    }

    /// Solves what rows with one of these patterns of missing columns have in common.
    pub(super) fn prepared<'a>(&'a self, patterns: &'a [([i16; 2], Vec<u32>)]) -> PreparedBasis<'a> {
        let k = self.ridge.len();
        let mut gram = vec![0.0; k * k];
        for a in 0..k {
            for b in 0..=a {
                gram[a * k + b] = dot(self.profile(a), self.profile(b));
            }
        }
        let mut prepared = PreparedBasis { basis: self, gram, patterns: Vec::new() };
        prepared.patterns = patterns.par_iter().map(|(_, columns)| prepared.gap(columns)).collect();
        prepared
    }
}

impl PreparedBasis<'_> {
    fn gap<'c>(&self, columns: &'c [u32]) -> Gap<'c> {
        let at = |j: usize| columns.iter().map(move |&d| self.basis.profile(j)[d as usize]);
        let profiles = (0..self.basis.ridge.len()).flat_map(at).collect();
        Gap { columns, cholesky: self.solved(columns), profiles }
    }

    /// The system of a row that misses `columns`, factored.
    fn solved(&self, columns: &[u32]) -> Cholesky {
        let k = self.basis.ridge.len();
        let mut normal = self.gram.clone();
        let mut at = vec![0.0; k];
        for &d in columns {
            (0..k).for_each(|j| at[j] = self.basis.vectors[j * self.basis.columns + d as usize]);
            for a in 0..k {
                for b in 0..=a {
                    normal[a * k + b] -= at[a] * at[b];
                }
            }
        }
        for (j, ridge) in self.basis.ridge.iter().enumerate() {
            normal[j * k + j] += ridge;
        }
        Cholesky::new(normal, k)
    }

    /// Replaces the samples that were not measured in a block of rows; a row without any measured sample stays as it is.
    pub fn fill(&self, values: &mut [f32], missing: &[Missing]) {
        let (columns, k) = (self.basis.columns.max(1), self.basis.ridge.len());
        if missing.iter().all(|m| *m == Missing::Nothing) {
            return;
        }
        let gaps: Vec<&[u32]> = missing.iter().map(|missing| self.gaps(missing)).collect();
        values.par_chunks_mut(columns).zip(&gaps).for_each(|(row, gaps)| {
            gaps.iter().for_each(|&d| row[d as usize] = 0.0);
        });
        let products = self.products(values, missing.len());
        values.par_chunks_mut(columns).zip(missing).zip(&gaps).zip(products.par_chunks(k)).for_each(
            |(((row, missing), gaps), products)| {
                if gaps.is_empty() || gaps.len() == row.len() {
                    return;
                }
                let own;
                let gap = match missing {
                    Missing::Pattern(k) => self.patterns.get(*k),
                    _ => {
                        own = self.gap(gaps);
                        Some(&own)
                    }
                };
                let mut amounts = products.to_vec();
                if let Some(gap) = gap.filter(|gap| gap.cholesky.solve(&mut amounts)) {
                    gap.compose(row, &amounts);
                }
            },
        );
    }

    fn gaps<'m>(&'m self, missing: &'m Missing) -> &'m [u32] {
        match missing {
            Missing::Nothing => &[],
            Missing::Pattern(k) => self.patterns.get(*k).map_or(&[], |gap| gap.columns),
            Missing::Columns(columns) => columns,
        }
    }

    /// Every row times every profile, \[rows, k\]: in f32 where there is much to multiply, and back ends do the same.
    fn products(&self, values: &[f32], rows: usize) -> Vec<f64> {
        let (columns, k) = (self.basis.columns, self.basis.ridge.len());
        if rows * columns * k < FEW_PRODUCTS {
            let row = |row: &[f32]| {
                let wide: Vec<f64> = row.iter().map(|&v| f64::from(v)).collect();
                (0..k).map(|j| dot(self.basis.profile(j), &wide)).collect::<Vec<_>>()
            };
            return values.par_chunks(columns).flat_map_iter(row).collect();
        }
        let narrow: Vec<f32> = self.basis.vectors.iter().map(|&v| v as f32).collect();
        let mut out = vec![0.0_f32; rows * k];
        product(
            MatRef::from_row_major_slice(values, rows, columns),
            MatRef::from_row_major_slice(&narrow, k, columns),
            &mut out,
        );
        out.into_iter().map(f64::from).collect()
    }
}

impl Gap<'_> {
    /// Writes the missing samples of a row as a sum of profiles.
    fn compose(&self, row: &mut [f32], amounts: &[f64]) {
        let mut filled = vec![0.0; self.columns.len()];
        for (amount, profile) in amounts.iter().zip(self.profiles.chunks_exact(self.columns.len().max(1))) {
            filled.iter_mut().zip(profile).for_each(|(v, p)| *v += amount * p);
        }
        filled.iter().zip(self.columns).for_each(|(&v, &d)| row[d as usize] = v as f32);
    }
}

/// The lower triangular factor of a symmetric positive definite matrix; a pivot that is not positive, or not finite, drops its unknown.
pub(super) struct Cholesky {
    lower: Vec<f64>,
    k: usize,
}

impl Cholesky {
    /// From the lower half of a row-major \[k, k\] matrix.
    pub fn new(mut a: Vec<f64>, k: usize) -> Self {
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
        Self { lower: a, k }
    }

    /// Whether the solution, in place of `b`, is finite.
    pub fn solve(&self, b: &mut [f64]) -> bool {
        let (a, k) = (&self.lower, self.k);
        for i in 0..k {
            b[i] = (b[i] - (0..i).map(|p| a[i * k + p] * b[p]).sum::<f64>()) / a[i * k + i];
        }
        for i in (0..k).rev() {
            b[i] = (b[i] - (i + 1..k).map(|p| a[p * k + i] * b[p]).sum::<f64>()) / a[i * k + i];
        }
        b.iter().all(|v| v.is_finite())
    }
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

    fn filled(basis: &Basis, row: &[f32], missing: &[u32]) -> Vec<f32> {
        let mut own = row.to_vec();
        basis.prepared(&[]).fill(&mut own, &[Missing::Columns(missing.to_vec())]);
        let mut shared = row.to_vec();
        basis.prepared(&[([0, 0], missing.to_vec())]).fill(&mut shared, &[Missing::Pattern(0)]);
        assert_eq!(own, shared);
        own
    }

    #[test]
    fn a_row_of_the_mean_profile_is_completed_exactly() {
        let basis = Basis::mean(&[1.0, 4.0, 2.0, 0.5]);
        assert_eq!(filled(&basis, &[0.0, 8.0, 4.0, 0.0], &[0, 3]), [2.0, 8.0, 4.0, 1.0]);
    }

    #[test]
    fn a_row_of_two_terms_is_completed_to_the_ridge() {
        let low = LowRank::new(vec![3.0, 1.0], vec![0.5, 0.5, 0.5, 0.5, 0.5, -0.5, 0.5, -0.5]);
        let row = filled(&Basis::factors(&low, 2, 4, 4, 0.0), &[3.0, 1.0, 0.0, 0.0], &[2, 3]);
        // The ridge of 1e-12 against a variance of 0.25 biases by 1e-11; rows are f32.
        assert!((row[2] - 3.0).abs() < 1e-6 && (row[3] - 1.0).abs() < 1e-6, "{row:?}");
    }

    #[test]
    fn profiles_that_cannot_be_told_apart_still_give_finite_numbers() {
        let low = LowRank::new(vec![1.0, 0.0], vec![1.0, 0.0, 0.0, 1.0]);
        assert_eq!(filled(&Basis::factors(&low, 2, 3, 2, 0.0), &[2.0, 0.0], &[1]), [2.0, 0.0]);
    }

    #[test]
    fn a_row_without_any_sample_stays_as_it_is() {
        assert_eq!(filled(&Basis::mean(&[1.0, 2.0]), &[0.0, 0.0], &[0, 1]), [0.0, 0.0]);
    }

    #[test]
    fn edges_are_extended_from_the_nearest_measured_sample() {
        let mut values = [0.0, 0.0, 0.0, 0.0, 5.0, 7.0, 0.0, 0.0, 0.0];
        extend_edges(&mut values, &[false, false, false, false, true, true, false, false, false], [3, 3]);
        assert_eq!(values, [5.0, 5.0, 7.0, 5.0, 5.0, 7.0, 5.0, 5.0, 7.0]);
    }
}
