//! One pass over the matrix beside its reconstruction: what each row says, and which rows to show.

use crate::transport::common::{RowErrors, RowsSum};
use crate::transport::{MatrixHeader, MatrixReader, RowBlock};
use crate::{Error, Result};
use rayon::prelude::*;

/// What one pass over matrix and material found.
#[derive(Debug, Clone, Default)]
pub struct RowSurvey {
    /// Share of the arriving light that leaves inside each row's window, mean of the channels; `None` for rows without
    /// a measurement.
    pub albedo: Vec<Option<f64>>,
    /// ‖R̂ − R‖ / ‖R‖ of each row over its measured samples.
    pub error: Vec<Option<f64>>,
    /// Mean albedo of the rows by channel and its standard deviation, by what the matrix says that its errors have in
    /// common; `None` without variance.
    pub mean_albedo: Option<[[f64; 2]; 3]>,
    /// Rows to look at.
    pub rows: Vec<ComparedRow>,
}

/// A row beside its reconstruction, each `[dy][dx][channel]`.
#[derive(Debug, Clone)]
pub struct ComparedRow {
    /// Its index, row-major over (y_i, x_i).
    pub index: usize,
    /// Why it is shown.
    pub reason: &'static str,
    /// R_d, mm⁻².
    pub response: Vec<f32>,
    /// Its variance, mm⁻⁴.
    pub variance: Vec<f32>,
    /// 1 where measured.
    pub valid: Vec<u8>,
    /// R̂_d, mm⁻².
    pub reconstructed: Vec<f32>,
}

impl RowSurvey {
    /// Reads `matrix` in blocks; `reconstruct` gives the material's row of an index.
    ///
    /// # Errors
    /// Those of [`MatrixReader::read`] and of `reconstruct`; [`Error::Internal`] when the two disagree on a row's
    /// length.
    pub fn take(matrix: &MatrixReader, reconstruct: impl Fn(usize) -> Result<Vec<f32>> + Sync) -> Result<Self> {
        let header = matrix.header();
        let n = header.row_len();
        // Some tens of megabytes per block, however large the window.
        let block_rows = ((1 << 22) / n.max(1)).max(1);
        let mut survey = Self::default();
        let common = header.common_errors();
        let (mut light, mut with_variance) = ([RowsSum::default(); 3], false);
        for first in (0..header.rows()).step_by(block_rows) {
            let block = matrix.read(first..(first + block_rows).min(header.rows()))?;
            let found: Result<Vec<_>> = (0..block.rows)
                .into_par_iter()
                .map(|i| {
                    let estimate = checked(reconstruct(first + i)?, n)?;
                    let (row, index) = (block.view(i), first + i);
                    let errors = RowErrors::new(row, index, header, &common);
                    Ok((assess(header, row.response, row.valid, &estimate), [0, 1, 2].map(|c| errors.sum(c))))
                })
                .collect();
            with_variance |= block.variance.iter().any(|v| *v > 0.0);
            for ((albedo, error), sums) in found? {
                if albedo.is_some() {
                    light.iter_mut().zip(&sums).for_each(|(all, row)| all.add(row));
                }
                survey.albedo.push(albedo);
                survey.error.push(error);
            }
        }
        let area = header.pitch_mm * header.pitch_mm;
        let mean =
            |c: usize| [light[c].value, light[c].sd(common.of_all.scale_sd[c])].map(|v| area * v / light[c].rows);
        survey.mean_albedo = with_variance.then(|| [0, 1, 2].map(mean));
        for (index, reason) in choose(header, &survey.error) {
            let RowBlock { response, variance, valid, .. } = matrix.read(index..index + 1)?;
            let reconstructed = checked(reconstruct(index)?, n)?;
            survey.rows.push(ComparedRow { index, reason, response, variance, valid, reconstructed });
        }
        Ok(survey)
    }
}

fn checked(row: Vec<f32>, expected: usize) -> Result<Vec<f32>> {
    if row.len() == expected {
        Ok(row)
    } else {
        Err(Error::internal(format_args!("a reconstructed row of {} numbers, not {expected}", row.len())))
    }
}

/// Albedo and relative error of one row.
fn assess(header: &MatrixHeader, response: &[f32], valid: &[u8], estimate: &[f32]) -> (Option<f64>, Option<f64>) {
    let (mut sum, mut norm2, mut error2, mut measured) = (0.0, 0.0, 0.0, 0usize);
    for ((&r, &e), _) in response.iter().zip(estimate).zip(valid).filter(|(_, v)| **v != 0) {
        let (r, e) = (f64::from(r), f64::from(e));
        sum += r;
        norm2 += r * r;
        error2 += (e - r) * (e - r);
        measured += 1;
    }
    if measured == 0 {
        return (None, None);
    }
    let albedo = sum * header.pitch_mm * header.pitch_mm / 3.0;
    (Some(albedo), (norm2 > 0.0).then(|| (error2 / norm2).sqrt()))
}

/// The middle of the grid, then rows that reconstruct typically, badly and worst. No row twice.
fn choose(header: &MatrixHeader, error: &[Option<f64>]) -> Vec<(usize, &'static str)> {
    let mut ranked: Vec<(f64, usize)> = error.iter().enumerate().filter_map(|(i, e)| Some(((*e)?, i))).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let Some(last) = ranked.len().checked_sub(1) else { return Vec::new() };
    let middle = header.points[1] / 2 * header.points[0] + header.points[0] / 2;
    let mut chosen: Vec<(usize, &'static str)> = Vec::new();
    let wanted = [
        (error.get(middle).copied().flatten().map(|_| middle), "middle of the grid"),
        (Some(ranked[last / 2].1), "typical: half of the rows are closer to their measurement"),
        (Some(ranked[last * 9 / 10].1), "nine of ten rows are closer to their measurement"),
        (Some(ranked[last].1), "the worst row"),
    ];
    for (index, reason) in wanted.into_iter().filter_map(|(i, reason)| Some((i?, reason))) {
        if chosen.iter().all(|c| c.0 != index) {
            chosen.push((index, reason));
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::super::tests::header;
    use super::*;

    #[test]
    fn rows_are_ranked_and_none_is_shown_twice() {
        let header = header([3, 3], [3, 3]);
        let mut error: Vec<_> = (0..9).map(|i| Some(f64::from(i))).collect();
        error[0] = None;
        let chosen: Vec<usize> = choose(&header, &error).iter().map(|c| c.0).collect();
        assert_eq!(chosen, [4, 7, 8]);
        assert!(choose(&header, &[None; 9]).is_empty());
    }

    #[test]
    fn only_measured_samples_count() {
        let header = header([1, 1], [1, 1]);
        let (albedo, error) = assess(&header, &[2.0, 2.0, 0.0], &[1, 1, 0], &[2.0, 1.0, 50.0]);
        assert!((albedo.unwrap() - 4.0 * 0.25 * 0.25 / 3.0).abs() < 1e-12);
        assert!((error.unwrap() - (1.0f64 / 8.0).sqrt()).abs() < 1e-12);
        assert_eq!(assess(&header, &[0.0; 3], &[0; 3], &[1.0; 3]), (None, None));
    }
}
