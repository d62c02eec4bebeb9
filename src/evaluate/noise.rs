//! What a matrix's own noise measures: how far another measurement of the truth behind it would be from it.

use super::{LOG_ABOVE, LOG_FLOOR, psnr};
use crate::Result;
use crate::transport::MatrixReader;
use crate::transport::rows::RowView;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Nodes and weights of Gauss and Hermite for the mean over a normal error: exact for polynomials up to degree 9.
const NORMAL: [(f64, f64); 3] =
    [(0.0, 8.0 / 15.0), (1.355_626_179_974_266, 0.222_075_922), (2.856_970_013_872_806, 0.011_257_411)];
/// Below this relative error the square of the logarithm is that of the error to 1 % (the next term is 11/12 of its
/// square).
const SMALL: f64 = 0.1;

/// The measures of `docs/metrics.md` that a matrix's noise alone has, by its variance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseLevel {
    /// √(Σ σ² / Σ R²).
    pub rel_rmse: f64,
    /// 20 log₁₀(max R / √(mean σ²)), dB.
    pub psnr_db: f64,
    /// √(mean (ln(R + σz) − ln R)²), z normal, over the entries and with the floor of `log_rmse`.
    pub log_rmse: f64,
}

#[derive(Debug, Clone, Copy, Default)]
struct NoiseSums {
    entries: u64,
    variance: f64,
    size: f64,
    peak: f64,
    log_error: f64,
    log_entries: u64,
}

/// The noise level of a matrix, in one reading; `None` where it has no variance.
///
/// # Errors
/// Those of the reader.
pub fn noise_level(matrix: &MatrixReader) -> Result<Option<NoiseLevel>> {
    let mut all = NoiseSums::default();
    matrix.for_each_block(|block| {
        let rows: Vec<NoiseSums> = (0..block.rows).into_par_iter().map(|k| of_row(block.view(k))).collect();
        rows.iter().for_each(|row| all.add(row));
        Ok(())
    })?;
    let psnr_db = psnr(all.peak, all.variance, all.entries);
    Ok(psnr_db.map(|psnr_db| NoiseLevel {
        rel_rmse: (all.variance / all.size).sqrt(),
        psnr_db,
        log_rmse: (all.log_error / all.log_entries.max(1) as f64).sqrt(),
    }))
}

fn of_row(row: RowView<'_>) -> NoiseSums {
    let measured = || (0..row.response.len()).filter(|&s| row.valid[s] != 0);
    let peak = measured().map(|s| f64::from(row.response[s])).fold(0.0, f64::max);
    let mut sums = NoiseSums { peak, ..NoiseSums::default() };
    for s in measured() {
        let (value, variance) = (f64::from(row.response[s]), f64::from(row.variance[s]).max(0.0));
        sums.entries += 1;
        sums.variance += variance;
        sums.size += value * value;
        if value > LOG_ABOVE * peak {
            sums.log_error += log_error(variance.sqrt() / value, LOG_FLOOR * peak / value);
            sums.log_entries += 1;
        }
    }
    sums
}

/// Mean of ln² max(1 + error · z, floor) over a normal z.
fn log_error(error: f64, floor: f64) -> f64 {
    if error < SMALL {
        return error * error;
    }
    let at = |z: f64| (1.0 + error * z).max(floor).ln().powi(2);
    NORMAL.iter().map(|&(z, weight)| if z == 0.0 { weight * at(z) } else { weight * (at(z) + at(-z)) }).sum()
}

impl NoiseSums {
    fn add(&mut self, row: &Self) {
        self.entries += row.entries;
        self.variance += row.variance;
        self.size += row.size;
        self.peak = self.peak.max(row.peak);
        self.log_error += row.log_error;
        self.log_entries += row.log_entries;
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::matrix;
    use super::*;

    #[test]
    fn the_noise_of_a_matrix_is_what_its_variance_says_worked_out_by_hand() {
        let folder = tempfile::tempdir().unwrap();
        // Entries 0.1 k in row k = 1 … 6, 26 of them measured, each with a variance of 1.21e-4.
        let reader = matrix(&folder.path().join("m.rd.zarr"), 1.0, [3, 3], [0.0; 2], 0.0);
        let found = noise_level(&reader).unwrap().unwrap();
        let near = |found: f64, expected: f64, share: f64| (found / expected - 1.0).abs() < share;
        assert!(near(found.rel_rmse, (1.21e-4_f64 * 6.0 / 0.91).sqrt(), 1e-5), "f32: {found:?}");
        assert!(near(found.psnr_db, 20.0 * (0.6 / 0.011_f64).log10(), 1e-5), "f32: {found:?}");
        let inverse: f64 = (1..=6).map(|k| (0.1 * f64::from(k)).powi(-2)).sum();
        // 11 % of the first row, by quadrature: (ln(1 + e z))² has 11/12 e² more than e².
        assert!(near(found.log_rmse, (1.21e-4 * inverse / 6.0).sqrt(), 0.02), "{found:?}");
    }

    #[test]
    fn the_mean_square_of_a_logarithm_is_that_of_many_draws() {
        use rand::SeedableRng;
        use rand_distr::{Distribution, StandardNormal};
        let mut generator = rand_pcg::Pcg64::seed_from_u64(3);
        let draws: Vec<f64> = (0..400_000).map(|_| StandardNormal.sample(&mut generator)).collect();
        for (error, tolerance) in [(0.05, 0.01), (0.12, 0.02), (0.25, 0.05)] {
            let mean = draws.iter().map(|z: &f64| (1.0 + error * z).max(1e-2).ln().powi(2)).sum::<f64>();
            let (mean, found) = (mean / draws.len() as f64, log_error(error, 1e-2));
            // The draws' own error is 0.3 %; five nodes see little of where the logarithm is steep.
            assert!((found / mean - 1.0).abs() < tolerance, "{error}: {found} {mean}");
        }
        // An error many times the value: one side at the floor, the other far above.
        assert!((1.0..10.0).contains(&log_error(3.0, 1e-2)));
    }
}
