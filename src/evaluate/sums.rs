//! Sums over samples and over rows, against what a matrix says of their errors.

use crate::transport::common::{RowErrors, RowsSum};
use crate::transport::{CommonErrors, MatrixHeader, RowBlock};
use rayon::prelude::*;

/// Rows that one thread adds up: the same parts for any number of threads, so that sums are the same to the last bit.
const PART_ROWS: usize = 64;

/// What all rows together say of one number of a row.
#[derive(Debug, Clone, Copy, Default)]
struct Number {
    rows: f64,
    error: f64,
    value: f64,
    slope: [f64; 2],
    /// What rows do not share.
    own_variance: f64,
}

/// What all rows together say of a channel's sums.
#[derive(Debug, Clone, Copy, Default)]
struct Channel {
    sum: RowsSum,
    truth: f64,
    covered: f64,
}

/// Coverage of sums, of a candidate that is a matrix.
#[derive(Debug)]
pub(super) struct SumErrors {
    common: CommonErrors,
    numbers: Vec<Number>,
    channels: [Channel; 3],
}

impl SumErrors {
    /// For a matrix; it need not know what its errors have in common.
    pub(super) fn new(header: &MatrixHeader) -> Self {
        let common = header.common.clone();
        let common = common.unwrap_or_else(|| CommonErrors::none(header.rows(), header.row_len()));
        Self { common, numbers: vec![Number::default(); header.row_len()], channels: Default::default() }
    }

    /// Adds rows that have only entries which both measured, and variance.
    pub(super) fn add(&mut self, candidate: &RowBlock, reference: &RowBlock, header: &MatrixHeader) {
        let starts: Vec<usize> = (0..candidate.rows).step_by(PART_ROWS).collect();
        let part = |&start: &usize| {
            let mut part = Self {
                common: CommonErrors::none(0, 0),
                numbers: vec![Number::default(); self.numbers.len()],
                channels: Default::default(),
            };
            for k in start..(start + PART_ROWS).min(candidate.rows) {
                part.add_row(&self.common, candidate, reference, k, header);
            }
            (part.numbers, part.channels)
        };
        let parts: Vec<_> = starts.par_iter().map(part).collect();
        for (numbers, channels) in parts {
            self.numbers.iter_mut().zip(&numbers).for_each(|(all, part)| all.add(part));
            self.channels.iter_mut().zip(&channels).for_each(|(all, part)| all.add(part));
        }
    }

    fn add_row(&mut self, common: &CommonErrors, a: &RowBlock, b: &RowBlock, k: usize, header: &MatrixHeader) {
        let (index, a, b) = (a.first + k, a.view(k), b.view(k));
        let place_sd = header.position_sd_mm[index];
        let errors = RowErrors::new(a, index, header.window, header.pitch_mm, place_sd, common);
        let measured = |s: &usize| a.valid[*s] != 0 && a.variance[*s] > 0.0;
        for s in (0..a.response.len()).filter(measured) {
            let (value, slope) = (f64::from(a.response[s]), errors.slope(s));
            let error = value - f64::from(b.response[s]);
            self.numbers[s].add(&Number { rows: 1.0, error, value, slope, own_variance: errors.own_variance(s) });
        }
        for (c, channel) in self.channels.iter_mut().enumerate() {
            let entries = || (c..a.response.len()).step_by(3);
            if !entries().any(|s| measured(&s)) {
                continue;
            }
            let (found, truth) = (errors.sum(c), entries().map(|s| f64::from(b.response[s])).sum::<f64>());
            channel.sum.add(&found);
            channel.truth += truth;
            channel.covered += f64::from(u8::from((found.value - truth).abs() <= 2.0 * found.variance.sqrt()));
        }
    }

    /// Share of rows' sums within two standard deviations.
    pub(super) fn rows_coverage(&self) -> Option<f64> {
        let [covered, rows] =
            [|c: &Channel| c.covered, |c: &Channel| c.sum.rows].map(|of| self.channels.iter().map(of).sum::<f64>());
        (rows > 0.0).then(|| covered / rows)
    }

    /// Share of the mean row's numbers within two standard deviations.
    pub(super) fn profile_coverage(&self) -> Option<f64> {
        let of_all = self.common.of_all;
        let seen = self.numbers.iter().enumerate().filter(|(_, n)| n.rows > 0.0);
        let covered: Vec<bool> = seen
            .map(|(k, n)| {
                let place = of_all.position_sd_mm * n.slope[0].hypot(n.slope[1]);
                let shared = (of_all.scale_sd[k % 3] * n.value).powi(2)
                    + place.powi(2)
                    + (self.common.sample_sd[k] * n.rows).powi(2);
                n.error.abs() <= 2.0 * (n.own_variance + shared).sqrt()
            })
            .collect();
        (!covered.is_empty()).then(|| covered.iter().filter(|c| **c).count() as f64 / covered.len() as f64)
    }

    /// Relative error of each channel's mean albedo, and the standard deviation that the matrix says it has.
    pub(super) fn albedo_bias(&self) -> Option<[[f64; 2]; 3]> {
        let of_all = self.common.of_all;
        let bias = |(c, sums): (usize, &Channel)| {
            [sums.sum.value - sums.truth, sums.sum.sd(of_all.scale_sd[c])].map(|v| v / sums.truth)
        };
        let found: Vec<[f64; 2]> = self.channels.iter().enumerate().map(bias).collect();
        found.try_into().ok().filter(|_| self.channels.iter().all(|c| c.truth > 0.0))
    }
}

impl Number {
    fn add(&mut self, other: &Self) {
        self.rows += other.rows;
        self.error += other.error;
        self.value += other.value;
        self.own_variance += other.own_variance;
        (0..2).for_each(|a| self.slope[a] += other.slope[a]);
    }
}

impl Channel {
    fn add(&mut self, other: &Self) {
        self.sum.join(&other.sum);
        self.truth += other.truth;
        self.covered += other.covered;
    }
}
