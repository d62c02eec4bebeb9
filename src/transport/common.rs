//! Errors that samples have in common, which a sum over them keeps.

use super::rows::RowView;
use super::{CHANNELS, MatrixHeader};
use crate::geometry::Point;
use serde::{Deserialize, Serialize};

/// Parts of the variance of a matrix that are no noise of single samples. All of them are in `variance`, too; a matrix
/// that has none of these is taken to have independent errors.
#[derive(Debug, Clone, PartialEq)]
pub struct CommonErrors {
    /// Of all samples of a row: relative standard deviation, by row and channel; 0 where unlit. The light that the dot
    /// brings: white reference, lamp, response curve.
    pub row_scale_sd: Vec<[f64; 3]>,
    /// Of all samples of all rows alike.
    pub of_all: CommonOfAll,
    /// Of a sample in all rows alike, and of all samples in the same direction: standard deviation, mm⁻², over dy, dx,
    /// channel. What other dots' light and ambient light may have left.
    pub sample_sd: Vec<f64>,
}

/// Errors of a whole matrix.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct CommonOfAll {
    /// Relative standard deviation by channel; the part of `row_scale_sd` that all rows share.
    pub scale_sd: [f64; 3],
    /// Standard deviation per axis of a displacement of all lit points, mm; the part of `position_sd_mm` that all rows
    /// share.
    pub position_sd_mm: f64,
}

impl CommonErrors {
    /// None, of so many rows and so many numbers of a row.
    pub fn none(rows: usize, row_len: usize) -> Self {
        Self { row_scale_sd: vec![[0.0; 3]; rows], of_all: CommonOfAll::default(), sample_sd: vec![0.0; row_len] }
    }

    /// Whether all numbers are standard deviations; says what is wrong.
    pub(super) fn check(&self, rows: usize, row_len: usize) -> Result<(), String> {
        let lengths = (self.row_scale_sd.len(), self.sample_sd.len());
        if lengths != (rows, row_len) {
            return Err(format!("common errors: expected {rows} rows of {row_len} numbers, found {lengths:?}"));
        }
        let all = self.row_scale_sd.as_flattened().iter().chain(&self.sample_sd).chain(&self.of_all.scale_sd);
        match all.chain([&self.of_all.position_sd_mm]).find(|v| !(0.0..=f64::from(f32::MAX)).contains(*v)) {
            Some(v) => Err(format!("common errors: expected standard deviations, found {v}")),
            None => Ok(()),
        }
    }
}

/// How a row's variance divides, by what becomes of it in sums.
#[derive(Debug, Clone)]
pub struct RowErrors<'a> {
    row: RowView<'a>,
    /// Of each number.
    independent: Vec<f64>,
    slopes: Vec<Point>,
    row_scale_sd: [f64; 3],
    position_sd_mm: f64,
    common: &'a CommonErrors,
}

/// The sum of a channel over the samples of one row.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RowSum {
    /// Σ R, mm⁻².
    pub value: f64,
    /// Its variance, mm⁻⁴.
    pub variance: f64,
    /// Of that, what rows do not share.
    pub own_variance: f64,
    /// Σ of [`CommonErrors::sample_sd`], mm⁻²: all rows' sums have this error in common.
    pub common_sd: f64,
}

/// The sum of a channel over samples and rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct RowsSum {
    /// Number of rows.
    pub rows: f64,
    /// Σ R, mm⁻².
    pub value: f64,
    own_variance: f64,
    common_sd: f64,
}

impl RowsSum {
    /// Adds a row's.
    pub fn add(&mut self, row: &RowSum) {
        self.join(&Self { rows: 1.0, value: row.value, own_variance: row.own_variance, common_sd: row.common_sd });
    }

    /// Adds that of other rows.
    pub fn join(&mut self, other: &Self) {
        self.rows += other.rows;
        self.value += other.value;
        self.own_variance += other.own_variance;
        self.common_sd += other.common_sd;
    }

    /// Its standard deviation, mm⁻², with the `scale_sd` of [`CommonOfAll`]; a displacement of all rows changes it by
    /// the light at the windows' rims only, and is left out.
    pub fn sd(&self, scale_sd: f64) -> f64 {
        (self.own_variance + (scale_sd * self.value).powi(2) + self.common_sd.powi(2)).sqrt()
    }
}

impl<'a> RowErrors<'a> {
    /// Of row `index` of the matrix of this header; `common` is its [`MatrixHeader::common_errors`].
    pub fn new(row: RowView<'a>, index: usize, header: &MatrixHeader, common: &'a CommonErrors) -> Self {
        let (row_scale_sd, position_sd_mm) = (common.row_scale_sd[index], header.position_sd_mm[index]);
        let slopes = slopes(row.response, |k| row.valid[k] != 0, header.window, header.pitch_mm);
        let independent = (0..row.response.len()).map(|k| {
            let r = f64::from(row.response[k]);
            let shared = (row_scale_sd[k % CHANNELS] * r).powi(2)
                + common.sample_sd[k].powi(2)
                + position_sd_mm.powi(2) * (slopes[k][0].powi(2) + slopes[k][1].powi(2));
            (f64::from(row.variance[k]) - shared).max(0.0)
        });
        let independent = independent.collect();
        Self { row, independent, slopes, row_scale_sd, position_sd_mm, common }
    }

    /// The sum of a channel over all measured samples.
    pub fn sum(&self, channel: usize) -> RowSum {
        let (mut value, mut independent, mut common_sd, mut slope) = (0.0, 0.0, 0.0, [0.0; 2]);
        for k in (channel..self.independent.len()).step_by(CHANNELS).filter(|&k| self.row.valid[k] != 0) {
            value += f64::from(self.row.response[k]);
            independent += self.independent[k];
            common_sd += self.common.sample_sd[k];
            (0..2).for_each(|a| slope[a] += self.slopes[k][a]);
        }
        let of_all = self.common.of_all;
        let steep = slope[0].powi(2) + slope[1].powi(2);
        let variance = |scale_sd: f64, position_sd_mm: f64| (scale_sd * value).powi(2) + position_sd_mm.powi(2) * steep;
        let all = independent + variance(self.row_scale_sd[channel], self.position_sd_mm) + common_sd.powi(2);
        let shared = variance(of_all.scale_sd[channel], of_all.position_sd_mm) + common_sd.powi(2);
        RowSum { value, variance: all, own_variance: (all - shared).max(0.0), common_sd }
    }

    /// Of number `k`, along x and y, mm⁻³.
    pub fn slope(&self, k: usize) -> Point {
        self.slopes[k]
    }

    /// What rows do not share of number `k`'s variance.
    pub fn own_variance(&self, k: usize) -> f64 {
        let (r, of_all) = (f64::from(self.row.response[k]), self.common.of_all);
        let scale = self.row_scale_sd[k % CHANNELS].powi(2) - of_all.scale_sd[k % CHANNELS].powi(2);
        let place = self.position_sd_mm.powi(2) - of_all.position_sd_mm.powi(2);
        let steep = self.slopes[k][0].powi(2) + self.slopes[k][1].powi(2);
        self.independent[k] + scale.max(0.0) * r * r + place.max(0.0) * steep
    }
}

/// The slope of each number of a row along x and y, mm⁻³: central differences, one-sided where a neighbour was not
/// measured, 0 where neither was.
pub fn slopes(response: &[f32], valid: impl Fn(usize) -> bool, [wx, wy]: [usize; 2], pitch_mm: f64) -> Vec<Point> {
    let slope = |before: Option<usize>, after: Option<usize>, here: usize| {
        let ok = |k: Option<usize>| k.filter(|&k| valid(k));
        let (before, after) = (ok(before), ok(after));
        let steps = usize::from(before.is_some()) + usize::from(after.is_some());
        let (low, high) = (response[before.unwrap_or(here)], response[after.unwrap_or(here)]);
        if steps == 0 { 0.0 } else { f64::from(high - low) / (steps as f64 * pitch_mm) }
    };
    let at = |k: usize| {
        if !valid(k) {
            return [0.0; 2];
        }
        let (i, j) = (k / CHANNELS % wx, k / CHANNELS / wx);
        let along = |index: usize, n: usize, step: usize| {
            slope((index > 0).then(|| k - step), (index + 1 < n).then(|| k + step), k)
        };
        [along(i, wx, CHANNELS), along(j, wy, CHANNELS * wx)]
    };
    (0..response.len()).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::store::tests::header;

    const WINDOW: [usize; 2] = [5, 3];

    fn row() -> (Vec<f32>, Vec<u8>) {
        let response = (0..45).map(|k| 0.3 + 0.1 * ((k * k % 17) as f32) - 0.02 * (k as f32)).collect();
        (response, (0..45).map(|k| u8::from(k != 19)).collect())
    }

    #[test]
    fn slopes_are_central_differences_and_one_sided_beside_what_was_not_measured() {
        let (response, valid) = row();
        let found = slopes(&response, |k| valid[k] != 0, WINDOW, 0.5);
        let r = |i: usize, j: usize, c: usize| f64::from(response[3 * (j * 5 + i) + c]);
        // Channel 1 of sample (1, 1) is number 19: not measured.
        let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-6, "{a} {b}");
        close(found[3 * 7 + 1][0], (r(3, 1, 1) - r(2, 1, 1)) / 0.5);
        close(found[3 * 7 + 2][0], (r(3, 1, 2) - r(1, 1, 2)) / 1.0);
        close(found[3 * 8][1], (r(3, 2, 0) - r(3, 0, 0)) / 1.0);
        close(found[3 * 4][1], (r(4, 1, 0) - r(4, 0, 0)) / 0.5);
        assert_eq!(found[19], [0.0; 2]);
    }

    /// Draws each error by itself and adds what the formulas add: sums over many draws have the stated variance.
    #[test]
    fn sums_of_rows_with_common_errors_scatter_as_they_say() {
        let (truth, valid) = row();
        let (scale, all_scale, sample, noise) = (0.05, 0.03, 0.02, 0.04);
        let common = CommonErrors {
            row_scale_sd: vec![[scale; 3]; 2],
            of_all: CommonOfAll { scale_sd: [all_scale; 3], position_sd_mm: 0.0 },
            sample_sd: vec![sample; 45],
        };
        let variance: Vec<f32> =
            truth.iter().map(|r| (noise * noise + sample * sample + (scale * f64::from(*r)).powi(2)) as f32).collect();
        let view = RowView { response: &truth, variance: &variance, valid: &valid };
        let header = MatrixHeader { position_sd_mm: vec![0.0; 2], ..header([2, 1], WINDOW) };
        let errors = RowErrors::new(view, 1, &header, &common);
        let mut seed = 7_u64;
        let mut normal = || {
            // Sum of twelve uniform numbers.
            (0..12).fold(-6.0, |sum, _| {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                sum + (seed >> 11) as f64 / (1_u64 << 53) as f64
            })
        };
        for c in 0..3 {
            let stated = errors.sum(c);
            let n = 20_000;
            let (mut all, mut shared) = (0.0, 0.0);
            for _ in 0..n {
                let (of_all, level) = (all_scale * normal(), sample * normal());
                let own = (scale * scale - all_scale * all_scale).sqrt() * normal();
                let (mut error, mut common_part) = (0.0, 0.0);
                for k in (c..45).step_by(3).filter(|k| *k != 19) {
                    let r = f64::from(truth[k]);
                    error += (of_all + own) * r + level + noise * normal();
                    common_part += of_all * r + level;
                }
                all += error * error / n as f64;
                shared += common_part * common_part / n as f64;
            }
            // The standard error of a variance from 20,000 draws is 1 %: four of them.
            assert!((stated.variance / all - 1.0).abs() < 0.04, "{c}: {stated:?} {all}");
            assert!(((stated.variance - stated.own_variance) / shared - 1.0).abs() < 0.04, "{c}: {stated:?} {shared}");
        }
    }
}
