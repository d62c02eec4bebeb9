//! How a material stands to the noise of the matrix that it was made from, as a person would compute it from the two.

use super::choose::spread;
use crate::Result;
use crate::material::{Material, Responses};
use crate::transport::MatrixReader;
use rayon::prelude::*;

/// Rows that are looked at: 2048 rows of a window of 31 × 31 tell χ² to a thousandth.
const ROWS: usize = 2048;

/// Differences of a material from its matrix in units of the matrix's standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Agreement {
    /// Mean of (R̂ − R)² over the variance of R. One: the material is as far from the matrix as the truth is. Less:
    /// some of the noise was taken for the material.
    pub chi_squared: f64,
    /// Share of entries further than two standard deviations from the matrix; 0.046 of a normal error.
    pub beyond_2sd: f64,
    /// Entries that were looked at: valid, of positive variance.
    pub entries: u64,
    /// Rows that were looked at, spread over the matrix.
    pub rows: usize,
}

impl std::fmt::Display for Agreement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let percent = 100.0 * self.beyond_2sd;
        write!(
            f,
            "against the matrix's noise: χ² {:.2} per entry, {percent:.1} % of entries beyond 2 sd",
            self.chi_squared
        )
    }
}

/// Measures it; `None` for a matrix without variance.
///
/// # Errors
/// Those of the reader.
pub(super) fn agreement(reader: &MatrixReader, material: &Material) -> Result<Option<Agreement>> {
    let responses = Responses::new(material);
    let (mut sums, mut rows) = ((0.0, 0_u64, 0_u64), 0);
    for range in spread(reader, ROWS) {
        let block = reader.read(range)?;
        rows += block.rows;
        let of_row = |k: usize| {
            let (fit, row) = (responses.row(block.first + k), block.view(k));
            let entries = fit.iter().zip(row.response).zip(row.variance.iter().zip(row.valid));
            entries.filter(|(_, (v, m))| **m != 0 && **v > 0.0).fold(
                (0.0, 0, 0),
                |(sum, beyond, n), ((a, b), (v, _))| {
                    let square = (f64::from(*a) - f64::from(*b)).powi(2) / f64::from(*v);
                    (sum + square, beyond + u64::from(square > 4.0), n + 1)
                },
            )
        };
        let found: Vec<(f64, u64, u64)> = (0..block.rows).into_par_iter().map(of_row).collect();
        found.iter().for_each(|r| sums = (sums.0 + r.0, sums.1 + r.1, sums.2 + r.2));
    }
    let (sum, beyond, entries) = sums;
    Ok((entries > 0).then(|| Agreement {
        chi_squared: sum / entries as f64,
        beyond_2sd: beyond as f64 / entries as f64,
        entries,
        rows,
    }))
}

#[cfg(test)]
mod tests {
    use super::super::test_matrices::stored;
    use super::super::{FactorOptions, factor};
    use super::*;
    use crate::progress::Progress;
    use crate::transport::Row;

    #[test]
    fn differences_are_counted_in_standard_deviations_of_measured_entries() {
        let value = |s: usize| (-((s / 3) as f64 - 7.0).powi(2) / 9.0).exp() * (1 + s % 3) as f64;
        let row = |i: usize| Row {
            response: (0..45).map(|s| (value(s) * (1.0 + i as f64)) as f32).collect(),
            variance: (0..45).map(|s| if s == 0 { 0.0 } else { 0.01 }).collect(),
            valid: (0..45).map(|s| s != 44).collect(),
        };
        let matrix = stored([3, 2], [5, 3], |_| 0.0, row);
        let options = FactorOptions { maps: Some(false), terms: Some(1), ..FactorOptions::default() };
        let mut material = factor(&matrix.reader, &options, &Progress::silent()).unwrap().material;
        // Twice as bright: off by the response itself.
        material.weights[0] *= 2.0;
        let found = agreement(&matrix.reader, &material).unwrap().unwrap();
        let off = || (0..6).flat_map(|i| (1..44).map(move |s| (value(s) * (1.0 + i as f64) / 0.1).powi(2)));
        let mean = off().sum::<f64>() / 258.0;
        assert_eq!((found.entries, found.rows), (258, 6));
        assert!((found.chi_squared / mean - 1.0).abs() < 1e-4, "f32: {} {mean}", found.chi_squared);
        let beyond = off().filter(|q| *q > 4.0).count() as f64 / 258.0;
        assert!((found.beyond_2sd - beyond).abs() < 0.005, "{} {beyond}", found.beyond_2sd);
    }
}
