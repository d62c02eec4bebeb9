//! What is found in the rows of a matrix that is imported.

use super::super::{CHANNELS, MatrixHeader, Row};
use crate::warning::bounds::LARGEST_ALBEDO;
use crate::{ArraysWarning, Warning};

/// What has been seen so far.
pub(super) struct Survey {
    pitch_mm: f64,
    window: [usize; 2],
    entries: usize,
    /// How many, and where the first is.
    unmeasured: (usize, Option<String>),
    negative: usize,
    /// The lowest response, and where it is.
    lowest: (f64, String),
    negative_sum: f64,
    positive_sum: f64,
    bright_rows: usize,
    largest_albedo: f64,
}

impl Survey {
    pub(super) fn new(header: &MatrixHeader) -> Self {
        Self {
            pitch_mm: header.pitch_mm,
            window: header.window,
            entries: 0,
            unmeasured: (0, None),
            negative: 0,
            lowest: (0.0, String::new()),
            negative_sum: 0.0,
            positive_sum: 0.0,
            bright_rows: 0,
            largest_albedo: 0.0,
        }
    }

    /// Looks at a row; `place` has the words for a sample and channel of it, and nothing for samples that the arrays do
    /// not have.
    pub(super) fn add(&mut self, row: &Row, place: impl Fn(usize, usize) -> Option<String>) {
        let mut sums = [0.0; CHANNELS];
        for (k, (&value, &valid)) in row.response.iter().zip(&row.valid).enumerate() {
            let value = f64::from(value);
            if !valid {
                if let Some(at) = place(k / CHANNELS, k % CHANNELS) {
                    self.entries += 1;
                    self.unmeasured.0 += 1;
                    self.unmeasured.1.get_or_insert(at);
                }
                continue;
            }
            self.entries += 1;
            sums[k % CHANNELS] += value;
            if value >= 0.0 {
                self.positive_sum += value;
                continue;
            }
            self.negative += 1;
            self.negative_sum -= value;
            if value < self.lowest.0 {
                self.lowest = (value, place(k / CHANNELS, k % CHANNELS).unwrap_or_default());
            }
        }
        let albedo = sums.into_iter().fold(0.0, f64::max) * self.pitch_mm.powi(2);
        self.bright_rows += usize::from(albedo > LARGEST_ALBEDO);
        self.largest_albedo = self.largest_albedo.max(albedo);
    }

    /// The share of numbers that were measured, and the findings.
    pub(super) fn findings(self, outside: Option<f64>) -> (f64, Vec<Warning>) {
        let mut found = Vec::new();
        if self.negative > 0 {
            let share = self.negative_sum / self.positive_sum.max(f64::MIN_POSITIVE);
            let (lowest, at) = self.lowest;
            found.push(
                ArraysWarning::NegativeResponses { entries: self.negative, share: share.min(f64::MAX), lowest, at }
                    .into(),
            );
        }
        if let (entries @ 1.., Some(at)) = self.unmeasured {
            found.push(ArraysWarning::UnmeasuredSamples { entries, of: self.entries, at }.into());
        }
        if let Some(share) = outside.filter(|share| *share > 0.0) {
            found.push(ArraysWarning::LightOutsideWindow { share, window: self.window }.into());
        }
        if self.bright_rows > 0 {
            let (rows, largest) = (self.bright_rows, self.largest_albedo);
            found.push(ArraysWarning::ImportedAlbedo { rows, largest, pitch_mm: self.pitch_mm }.into());
        }
        let measured = self.entries - self.unmeasured.0;
        (measured as f64 / self.entries.max(1) as f64, found)
    }
}
