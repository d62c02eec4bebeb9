//! Sums over samples and over rows, against what a matrix says of their errors.

use crate::transport::common::{RowErrors, RowsSum};
use crate::transport::rows::RowView;
use crate::transport::{CommonErrors, MatrixHeader, RowBlock};
use rayon::prelude::*;
use std::borrow::Cow;

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

/// What some rows say.
#[derive(Debug)]
struct Sums {
    numbers: Vec<Number>,
    channels: [Channel; 3],
}

/// Coverage of sums, of a candidate that is a matrix.
#[derive(Debug)]
pub(super) struct SumErrors<'a> {
    header: &'a MatrixHeader,
    common: Cow<'a, CommonErrors>,
    all: Sums,
}

impl Sums {
    fn new(row_len: usize) -> Self {
        Self { numbers: vec![Number::default(); row_len], channels: Default::default() }
    }

    fn join(&mut self, other: &Self) {
        self.numbers.iter_mut().zip(&other.numbers).for_each(|(all, part)| all.add(part));
        self.channels.iter_mut().zip(&other.channels).for_each(|(all, part)| all.add(part));
    }

    /// Adds a row of which only what both measured is valid.
    fn add(&mut self, a: RowView<'_>, b: RowView<'_>, errors: &RowErrors<'_>) {
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
}

impl<'a> SumErrors<'a> {
    /// For a matrix; it need not know what its errors have in common.
    pub(super) fn new(header: &'a MatrixHeader) -> Self {
        Self { header, common: header.common_errors(), all: Sums::new(header.row_len()) }
    }

    /// Adds rows of which only what both measured is valid.
    pub(super) fn add(&mut self, candidate: &RowBlock, reference: &RowBlock) {
        let starts: Vec<usize> = (0..candidate.rows).step_by(PART_ROWS).collect();
        let part = |&start: &usize| {
            let mut part = Sums::new(self.header.row_len());
            for k in start..(start + PART_ROWS).min(candidate.rows) {
                let row = candidate.view(k);
                let errors = RowErrors::new(row, candidate.first + k, self.header, &self.common);
                part.add(row, reference.view(k), &errors);
            }
            part
        };
        let parts: Vec<Sums> = starts.par_iter().map(part).collect();
        parts.iter().for_each(|part| self.all.join(part));
    }

    /// Share of rows' sums within two standard deviations.
    pub(super) fn rows_coverage(&self) -> Option<f64> {
        let [covered, rows] =
            [|c: &Channel| c.covered, |c: &Channel| c.sum.rows].map(|of| self.all.channels.iter().map(of).sum::<f64>());
        (rows > 0.0).then(|| covered / rows)
    }

    /// Share of the mean row's numbers within two standard deviations.
    pub(super) fn profile_coverage(&self) -> Option<f64> {
        let of_all = self.common.of_all;
        let seen = self.all.numbers.iter().enumerate().filter(|(_, n)| n.rows > 0.0);
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
        let found: Vec<[f64; 2]> = self.all.channels.iter().enumerate().map(bias).collect();
        found.try_into().ok().filter(|_| self.all.channels.iter().all(|c| c.truth > 0.0))
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
