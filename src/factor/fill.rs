//! Samples of the common window that a row did not measure, estimated so that the factorization needs no weights.
//!
//! Any constant, and edge extension too, would make rows near the sample's rim differ from the others and cost
//! terms. Here a row's missing part is what the other rows have there: first the mean profile scaled to the row, then
//! the factorization itself, fitted to what the row measured. Iterating that is expectation maximization for
//! probabilistic PCA with missing data (`Tipping1999`); estimates never enter the colour regression or a measure.

use super::backend::{LowRank, product};
use super::vector::dot;
use crate::cholesky::Cholesky;
use crate::output::numbers;
use faer::MatRef;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Multiplications of a block that are quick in f64.
const FEW_PRODUCTS: usize = 20_000_000;

/// Which columns of a row were not measured.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Missing {
    /// None.
    Nothing,
    /// Those of a pattern that many rows share, by its number.
    Pattern(usize),
    /// These, ascending.
    Columns(Vec<u32>),
}

/// Profiles that a row is composed of, with how much of each to expect.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Basis {
    /// Profiles, \[k, columns\].
    #[serde(with = "numbers")]
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
    pub(super) fn mean(profile: &[f64]) -> Self {
        Self { columns: profile.len(), vectors: profile.to_vec(), ridge: vec![0.0] }
    }

    /// The first `terms` of a factorization of `rows` rows; `noise` is the variance of one sample.
    pub(super) fn factors(low_rank: &LowRank, terms: usize, rows: usize, columns: usize, noise: f64) -> Self {
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
        Cholesky::dropping(normal, k)
    }

    /// Replaces the samples that were not measured in a block of rows; a row without any measured sample stays as it
    /// is.
    pub(super) fn fill(&self, values: &mut [f32], missing: &[Missing]) {
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

/// Extends a profile into samples that no row measured: each takes the nearest measured sample of its line, and
/// a line without any takes the nearest line that has some. All missing stays zero.
pub(super) fn extend_edges(values: &mut [f64], measured: &[bool], size: [usize; 2]) {
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
    use super::super::test_matrices::solved;
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

    /// What a Gaussian prior expects of the missing samples: rows are Σ a_j h_j plus noise, the a_j independent with
    /// variances σ_j²/rows. Solved over the measured samples instead of the profiles.
    fn expected(low: &LowRank, rows: usize, noise: f64, row: &[f32], missing: &[usize]) -> Vec<f64> {
        let columns = row.len();
        let covariance = |a: usize, b: usize| -> f64 {
            let h = |j: usize, d: usize| low.vectors[j * columns + d];
            let variance = |j: usize| low.singular_values[j].powi(2) / rows as f64;
            (0..low.singular_values.len()).map(|j| h(j, a) * variance(j) * h(j, b)).sum()
        };
        let seen: Vec<usize> = (0..columns).filter(|d| !missing.contains(d)).collect();
        let system =
            seen.iter().map(|&a| seen.iter().map(|&b| covariance(a, b) + if a == b { noise } else { 0.0 }).collect());
        let weights = solved(system.collect(), seen.iter().map(|&d| f64::from(row[d])).collect());
        missing.iter().map(|&d| seen.iter().zip(&weights).map(|(&s, w)| covariance(d, s) * w).sum()).collect()
    }

    /// Three profiles of seven columns, neither orthogonal where a part is missing nor alike in size.
    fn three_terms() -> LowRank {
        let vectors = (0..21).map(|k| ((k * k % 13) as f64 - 5.5) / 12.0 + 0.05 * (k / 7) as f64).collect();
        LowRank::new(vec![6.0, 2.0, 0.5], vectors)
    }

    #[test]
    fn a_gap_holds_what_the_noise_and_the_spread_of_the_terms_lead_to_expect() {
        let (low, row) = (three_terms(), [0.9_f32, -0.4, 1.7, 0.3, 2.2, -1.1, 0.6]);
        // From nearly exact rows to such where the ridge decides: from 4e-4 to 40 times the profiles' products.
        for noise in [1e-5, 0.02, 0.4, 3.0] {
            let basis = Basis::factors(&low, 3, 4, 7, noise);
            for missing in [vec![0], vec![5, 6], vec![1, 2, 4], vec![0, 1, 2, 3, 5, 6]] {
                let found = filled(&basis, &row, &missing.iter().map(|&d| d as u32).collect::<Vec<_>>());
                for (&d, e) in missing.iter().zip(expected(&low, 4, noise, &row, &missing)) {
                    // Values near 1 are stored as f32.
                    assert!((f64::from(found[d]) - e).abs() < 1e-6, "noise {noise} {missing:?}: {} {e}", found[d]);
                }
                assert!((0..7).filter(|d| !missing.contains(d)).all(|d| found[d] == row[d]), "what was measured stays");
            }
        }
    }

    #[test]
    fn only_the_first_terms_fill() {
        let low = three_terms();
        let two = LowRank::new(low.singular_values[..2].to_vec(), low.vectors[..14].to_vec());
        let row = [0.9_f32, -0.4, 1.7, 0.3, 0.0, 0.0, 0.6];
        let found = filled(&Basis::factors(&low, 2, 9, 7, 0.1), &row, &[4, 5]);
        for (d, e) in [4, 5].into_iter().zip(expected(&two, 9, 0.1, &row, &[4, 5])) {
            assert!((f64::from(found[d]) - e).abs() < 1e-6, "f32: {} {e}", found[d]);
        }
        let rest = Basis::factors(&low, 9, 9, 7, 0.1);
        assert_eq!(rest.ridge.len(), 3, "no more than there are");
    }

    #[test]
    fn every_row_of_a_block_has_its_own_gaps_and_what_stood_there_does_not_count() {
        let (low, noise) = (three_terms(), 0.3);
        let basis = Basis::factors(&low, 3, 5, 7, noise);
        let patterns = [([0, 0], vec![2]), ([1, -1], vec![0, 6]), ([2, 0], vec![])];
        let rows: Vec<f32> = (0..35).map(|k| ((k * 11 % 17) as f32 - 6.0) / 5.0).collect();
        let missing = [
            Missing::Nothing,
            Missing::Pattern(1),
            Missing::Columns(vec![3, 4]),
            Missing::Pattern(0),
            Missing::Columns((0..7).collect()),
        ];
        let gaps: [&[usize]; 5] = [&[], &[0, 6], &[3, 4], &[2], &[0, 1, 2, 3, 4, 5, 6]];
        let mut found = rows.clone();
        for (i, gap) in gaps.iter().enumerate() {
            gap.iter().for_each(|&d| found[7 * i + d] = 1e30);
        }
        basis.prepared(&patterns).fill(&mut found, &missing);
        for i in 0..5 {
            let row = &rows[7 * i..7 * i + 7];
            let want = if gaps[i].len() < 7 { expected(&low, 5, noise, row, gaps[i]) } else { vec![0.0; 7] };
            for d in 0..7 {
                let e = gaps[i].iter().position(|&g| g == d).map_or(f64::from(row[d]), |at| want[at]);
                assert!((f64::from(found[7 * i + d]) - e).abs() < 1e-6, "f32, row {i}: {} {e}", found[7 * i + d]);
            }
        }
    }

    #[test]
    fn large_blocks_are_multiplied_in_f32_and_filled_alike() {
        let (rows, columns, k) = (500, 2003, 20);
        // Cosines, orthogonal over the columns; row i holds a few of them in known amounts.
        let h = |j: usize, d: usize| {
            let angle = std::f64::consts::PI * (d as f64 + 0.5) * j as f64 / columns as f64;
            angle.cos() * (if j == 0 { 1.0 } else { 2.0 } / columns as f64).sqrt()
        };
        let amount = |i: usize, j: usize| ((7 * i + 3 * j) % 5) as f64 - 1.5;
        let value = |i: usize, d: usize| -> f64 { (0..k).map(|j| amount(i, j) * h(j, d)).sum() };
        let vectors: Vec<f64> = (0..k * columns).map(|at| h(at / columns, at % columns)).collect();
        let missing = |i: usize| vec![3 + i as u32, 1500];
        let mut values = vec![0.0; rows * columns];
        for i in 0..rows {
            let row = &mut values[i * columns..][..columns];
            for j in 0..k {
                let a = amount(i, j);
                row.iter_mut().zip(&vectors[j * columns..]).for_each(|(v, h)| *v += (a * h) as f32);
            }
            missing(i).iter().for_each(|&d| row[d as usize] = -9.0);
        }
        assert!(rows * columns * k >= FEW_PRODUCTS);
        let low = LowRank::new(vec![1.0; k], vectors);
        let all: Vec<Missing> = (0..rows).map(|i| Missing::Columns(missing(i))).collect();
        Basis::factors(&low, k, rows, columns, 0.0).prepared(&[]).fill(&mut values, &all);
        for i in 0..rows {
            for d in missing(i).into_iter().map(|d| d as usize) {
                // Products of 2003 samples in f32: 1e-7 of amounts up to 2.5, times 20 profiles of .03.
                let found = f64::from(values[i * columns + d]);
                assert!((found - value(i, d)).abs() < 1e-6, "row {i} column {d}: {found} {}", value(i, d));
            }
        }
    }

    #[test]
    fn edges_of_a_wide_window_are_extended_along_lines_first() {
        // 5 × 4; of equally near samples and lines the first.
        let known = [
            [None, None, None, None, None],
            [None, Some(2.0), None, Some(5.0), None],
            [None, None, None, None, None],
            [Some(7.0), None, None, None, Some(9.0)],
        ];
        let measured: Vec<bool> = known.iter().flatten().map(Option::is_some).collect();
        let mut values: Vec<f64> = known.iter().flatten().map(|v| v.unwrap_or(-1.0)).collect();
        extend_edges(&mut values, &measured, [5, 4]);
        let upper = [2.0, 2.0, 2.0, 5.0, 5.0];
        assert_eq!(values, [upper, upper, upper, [7.0, 7.0, 7.0, 9.0, 9.0]].concat());
        let mut none = [3.0, 4.0];
        extend_edges(&mut none, &[false, false], [2, 1]);
        assert_eq!(none, [3.0, 4.0], "nothing to extend");
    }

    #[test]
    fn edges_are_extended_from_the_nearest_measured_sample() {
        let mut values = [0.0, 0.0, 0.0, 0.0, 5.0, 7.0, 0.0, 0.0, 0.0];
        extend_edges(&mut values, &[false, false, false, false, true, true, false, false, false], [3, 3]);
        assert_eq!(values, [5.0, 5.0, 7.0, 5.0, 5.0, 7.0, 5.0, 5.0, 7.0]);
    }
}
