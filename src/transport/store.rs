//! The matrix on disk: a Zarr v3 group `*.rd.zarr` that xarray, zarr-python and dask open without our code.
//!
//! | array | dimensions | unit |
//! |---|---|---|
//! | `response` f32 | y_i, x_i, dy, dx, channel | mm⁻² |
//! | `variance` f32 | the same | mm⁻⁴ |
//! | `valid` u8 | the same | 1 measured, 0 not (the response is then 0) |
//! | `x_i_mm`, `y_i_mm` f64 | y_i, x_i | where the light really fell, mm |
//! | `position_sd_mm` f64 | y_i, x_i | standard deviation of that place per axis, mm |
//! | `dx_mm`, `dy_mm` f64 | dx; dy | offset of the cell's centre from the lit point, mm |
//! | `shot` i32 | y_i, x_i | number of the shot that lit it, an index into the attribute `shots` |
//!
//! Everything else is in the group's attributes, see [`MatrixHeader`].

use crate::{Error, Result, Warning, geometry::Point};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::path::{Path, PathBuf};

const FORMAT: u32 = 1;
const CHANNELS: usize = 3;

/// What a matrix is, besides its numbers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatrixHeader {
    /// Lit points along x and y.
    pub points: [usize; 2],
    /// Outgoing samples of a window along x and y, odd.
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
    /// The lattice shots, with their drift.
    pub shots: Vec<ShotRecord>,
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

    /// Offset of window sample (dx, dy) from the lit point, in samples.
    pub fn offset_px(&self, sample: [usize; 2]) -> [isize; 2] {
        std::array::from_fn(|a| sample[a] as isize - (self.window[a] / 2) as isize)
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

/// Writes a matrix. Rows come in any order from any thread; nothing appears under the final name before [`Self::finish`].
#[derive(Debug)]
pub struct MatrixWriter {
    path: PathBuf,
    header: MatrixHeader,
    scratch: File,
    folder: tempfile::TempDir,
    written: std::sync::Mutex<Vec<bool>>,
}

impl MatrixWriter {
    /// Prepares to write the store `path`.
    ///
    /// # Errors
    /// [`Error::Io`] when the folder of `path` cannot be written.
    pub fn create(path: &Path, header: MatrixHeader) -> Result<Self> {
        todo!()
    }

    /// What will be written besides the rows.
    pub fn header_mut(&mut self) -> &mut MatrixHeader {
        &mut self.header
    }

    /// Stores row `index` (row-major over (y_i, x_i)).
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when the row has another length than the header says.
    pub fn put(&self, index: usize, row: &Row) -> Result<()> {
        todo!()
    }

    /// Writes the store and renames it into place, replacing an older one. Rows never put are invalid throughout.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn finish(self) -> Result<()> {
        todo!()
    }
}

/// Reads a matrix in blocks of rows.
#[derive(Debug)]
pub struct MatrixReader {
    path: PathBuf,
    header: MatrixHeader,
}

impl MatrixReader {
    /// Opens a store and reads everything but the rows.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::BrokenMatrix`].
    pub fn open(path: &Path) -> Result<Self> {
        todo!()
    }

    /// What the matrix is.
    pub fn header(&self) -> &MatrixHeader {
        &self.header
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Reads consecutive rows; callable from several threads.
    ///
    /// # Errors
    /// [`Error::BrokenMatrix`] when a chunk cannot be read, [`Error::NotFinite`] for NaN or infinity.
    pub fn read(&self, rows: std::ops::Range<usize>) -> Result<RowBlock> {
        todo!()
    }
}
