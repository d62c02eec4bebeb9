//! The matrix on disk: a Zarr v3 group `*.rd.zarr` that xarray, zarr-python and dask open without our code.
//!
//! | array | dimensions | unit |
//! |---|---|---|
//! | `response` f32 | y_i, x_i, dy, dx, channel | mm⁻²; NaN where not measured |
//! | `variance` f32 | the same | mm⁻⁴; NaN where not measured |
//! | `valid` u8 | the same | 1 measured, 0 not |
//! | `x_i_mm`, `y_i_mm` f64 | y_i, x_i | where the light really fell, mm |
//! | `position_sd_mm` f64 | y_i, x_i | standard deviation of that place per axis, mm |
//! | `dx`, `dy` f64 | dx; dy | offset of the cell's centre from the lit point, mm |
//! | `shot` i32 | y_i, x_i | number of the lattice shot that lit it, counted from 0 |
//! | `shot_name` string | lattice_shot | its name in `capture.toml` |
//! | `shot_drift_px` f64 | lattice_shot, axis | its drift along x and y, camera px |
//! | `shot_drift_sd_px` f64 | lattice_shot | standard deviation of it per axis, camera px; NaN where not measured |
//! | `row_scale_sd` f64 | y_i, x_i, channel | relative standard deviation of what a row's samples have in common; may be missing |
//! | `common_sd` f64 | dy, dx, channel | standard deviation that all rows have in common, mm⁻²; may be missing |
//!
//! Stores of other programs are read too, with defaults for what they leave out: `docs/matrix-format.md`. Everything
//! else is in the group's attributes, see [`MatrixHeader`]; `findings` are the records ([`crate::FindingRecord`]) of
//! `warnings`, one for one.

use super::{CHANNELS, CommonErrors};
use crate::{Error, Result, Warning, geometry::Point};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// The version of this layout, attribute `acquire_format`.
pub(super) const FORMAT: u64 = 3;
/// The versions that are read. In 1 the response was 0 where it was not measured, and `points` and `window` were
/// attributes too; 2 had no common errors.
pub(super) const FORMATS: [u64; 3] = [1, 2, FORMAT];
/// Attribute of the group: [`super::CommonOfAll`].
pub(super) const COMMON: &str = "common_errors";
/// The most lit points along an axis.
pub(super) const MOST_POINTS: usize = 1 << 16;
/// The most samples of a window along an axis.
pub(super) const MOST_SAMPLES: usize = 4095;
/// Lattice shots up to this number are believed, and more where there are more lit points: each lights one at least.
const FEW_SHOTS: usize = 1 << 20;
/// No slab is larger, and no length is smaller than one over it, mm.
pub(super) const LARGEST_MM: f64 = 1e9;

/// What a matrix is, besides its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatrixHeader {
    /// Lit points along x and y.
    #[serde(skip)]
    pub points: [usize; 2],
    /// Outgoing samples of a window along x and y, odd.
    #[serde(skip)]
    pub window: [usize; 2],
    /// Side of an outgoing cell, mm.
    pub pitch_mm: f64,
    /// Mean distance between neighbouring lit points along x and y, mm (the pitch when there is but one).
    pub lit_pitch_mm: Point,
    /// Where each lit point is, mm, row-major over (y_i, x_i).
    #[serde(skip)]
    pub lit_mm: Vec<Point>,
    /// Standard deviation per axis of each of them, mm.
    #[serde(skip)]
    pub position_sd_mm: Vec<f64>,
    /// The shot that lit each of them, an index into `shots`; `None` when unlit.
    #[serde(skip)]
    pub shot_of: Vec<Option<usize>>,
    /// What of the variance samples have in common; `None` when that is not known.
    #[serde(skip)]
    pub common: Option<CommonErrors>,
    /// The lattice shots, with their drift.
    pub shots: Vec<ShotRecord>,
    /// Camera pixels in a mm at the slab's centre; `None` when no camera has seen it.
    #[serde(default)]
    pub camera_px_per_mm: Option<f64>,
    /// Findings of the measurement.
    pub warnings: Vec<Warning>,
    /// Version, options, input hashes, seed: how this matrix came to be.
    pub provenance: serde_json::Value,
}

impl MatrixHeader {
    /// Number of lit points, the rows.
    pub fn rows(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// Outgoing samples of one row (all channels together are three times as many).
    pub fn window_len(&self) -> usize {
        self.window[0] * self.window[1]
    }

    /// Numbers of one row: dy, dx, channel.
    pub fn row_len(&self) -> usize {
        self.window_len() * CHANNELS
    }

    /// [`Self::common`], or none where that is not known.
    pub fn common_errors(&self) -> Cow<'_, CommonErrors> {
        match &self.common {
            Some(common) => Cow::Borrowed(common),
            None => Cow::Owned(CommonErrors::none(self.rows(), self.row_len())),
        }
    }

    /// Bounds that keep every later product, index and stored number in range; says what is wrong.
    pub(super) fn check(&self) -> Result<(), String> {
        if !self.points.iter().all(|n| (1..=MOST_POINTS).contains(n)) {
            return Err(format!("points: expected 1 to {MOST_POINTS}, found {:?}", self.points));
        }
        if !self.window.iter().all(|n| n % 2 == 1 && *n <= MOST_SAMPLES) {
            return Err(format!("window: expected odd numbers up to {MOST_SAMPLES}, found {:?}", self.window));
        }
        let lengths = [self.pitch_mm, self.lit_pitch_mm[0], self.lit_pitch_mm[1]];
        if let Some(v) = lengths.into_iter().find(|v| !(1.0 / LARGEST_MM..=LARGEST_MM).contains(v)) {
            return Err(format!(
                "pitch_mm or lit_pitch_mm: expected {:e} to {LARGEST_MM:e}, found {v}",
                1.0 / LARGEST_MM
            ));
        }
        if let Some(common) = &self.common {
            common.check(self.rows(), self.row_len())?;
        }
        if self.shots.len() > most_shots(self.rows()) {
            return Err(format!("shots: expected at most {}, found {}", most_shots(self.rows()), self.shots.len()));
        }
        let drift = |s: &ShotRecord| s.drift_px.into_iter().chain(s.drift_sd_px).all(f64::is_finite);
        match self.shots.iter().find(|s| !drift(s)) {
            Some(shot) => {
                Err(format!("drift of shot \"{}\": expected finite numbers, found {:?}", shot.name, shot.drift_px))
            }
            None => Ok(()),
        }
    }

    /// Whether every lit point has a place that can be used.
    pub(super) fn check_places(&self) -> Result<(), String> {
        let place = |v: &f64| v.abs() <= LARGEST_MM;
        if let Some(v) = self.lit_mm.iter().flatten().find(|v| !place(v)) {
            return Err(format!("x_i_mm or y_i_mm: expected places within {LARGEST_MM:e} mm, found {v}"));
        }
        match self.position_sd_mm.iter().find(|v| !place(v) || **v < 0.0) {
            Some(v) => Err(format!("position_sd_mm: expected 0 to {LARGEST_MM:e}, found {v}")),
            None => Ok(()),
        }
    }

    /// Offset of window sample (dx, dy) from the lit point, in samples.
    pub fn offset_px(&self, sample: [usize; 2]) -> [isize; 2] {
        std::array::from_fn(|a| sample[a] as isize - (self.window[a] / 2) as isize)
    }
}

/// The most lattice shots of a matrix of so many rows.
pub(super) fn most_shots(rows: usize) -> usize {
    rows.max(FEW_SHOTS)
}

/// Refuses a length, mm, that no slab has.
pub(super) fn check_mm(setting: &'static str, value: f64) -> Result<()> {
    match (1.0 / LARGEST_MM..=LARGEST_MM).contains(&value) {
        true => Ok(()),
        false => {
            let expected = format!("{:e} to {LARGEST_MM:e} mm", 1.0 / LARGEST_MM);
            Err(Error::Setting { setting, expected, found: value.to_string() })
        }
    }
}

/// A lattice shot as the matrix remembers it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShotRecord {
    /// Its name in `capture.toml`.
    pub name: String,
    /// Displacement of its dots from the registered pattern, in camera px at the slab's centre.
    pub drift_px: Point,
    /// Standard deviation of it per axis, camera px; `None` when it could not be measured.
    pub drift_sd_px: Option<f64>,
}

/// One row: the window of responses around a lit point, each `[dy][dx][channel]` in one run.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// R_d, mm⁻²; 0 where invalid.
    pub response: Vec<f32>,
    /// Its variance, mm⁻⁴.
    pub variance: Vec<f32>,
    /// Whether each was measured.
    pub valid: Vec<bool>,
}

/// Consecutive rows of a matrix, concatenated, row-major over (y_i, x_i).
#[derive(Debug, Clone, PartialEq)]
pub struct RowBlock {
    /// Index of the first row.
    pub first: usize,
    /// Number of rows.
    pub rows: usize,
    /// R_d, mm⁻², `rows` × `row_len`.
    pub response: Vec<f32>,
    /// Variance, mm⁻⁴, the same shape.
    pub variance: Vec<f32>,
    /// 1 where measured.
    pub valid: Vec<u8>,
}

impl RowBlock {
    pub(super) fn zeros(rows: std::ops::Range<usize>, row_len: usize) -> Self {
        let n = rows.len() * row_len;
        Self { first: rows.start, rows: rows.len(), response: vec![0.0; n], variance: vec![0.0; n], valid: vec![0; n] }
    }
}

#[cfg(test)]
pub(super) mod tests;
