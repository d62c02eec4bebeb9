//! Reading a matrix, in blocks of rows.

use super::CHANNELS;
use super::checksum::Checksums;
use super::open::{self, Opened};
use super::row_array::{RowArray, RowLayout};
use super::store::{MatrixHeader, RowBlock};
use crate::{Error, Result};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Numbers that one thread looks through at a time.
const CHECKED: usize = 1 << 16;
/// Lines of chunks that are read at once, in numbers: chunks of several lines of points are decoded once for all of
/// them up to here.
const BAND_NUMBERS: usize = 1 << 26;

/// Reads a matrix in blocks of rows.
#[derive(Debug)]
pub struct MatrixReader {
    path: PathBuf,
    header: MatrixHeader,
    layout: RowLayout,
    response: RowArray,
    variance: Option<RowArray>,
    valid: Option<RowArray>,
    /// `None` for a store that another program, or an earlier version of this one, has written.
    checksums: Option<Checksums>,
}

impl MatrixReader {
    /// Where its rows lie.
    pub fn shape(&self) -> acquire_material::Shape<'_> {
        let h = self.header();
        acquire_material::Shape {
            points: h.points,
            window: h.window,
            pitch_mm: h.pitch_mm,
            lit_pitch_mm: h.lit_pitch_mm,
            lit_mm: &h.lit_mm,
        }
    }

    /// Opens a store, this program's or another's, and reads everything but the rows.
    ///
    /// What a store may leave out, and what stands for it then, is in `docs/matrix-format.md`. Not detected: a chunk of
    /// another program's store that is lost, where its fill value is a number that could have been measured.
    ///
    /// # Errors
    /// [`Error::Io`] when there is nothing at `path`, [`Error::MatrixFormat`] when it is no matrix,
    /// [`Error::BrokenMatrix`] when it is not a whole one.
    pub fn open(path: &Path) -> Result<Self> {
        Self::open_with(path, &serde_json::Map::new())
    }

    /// [`Self::open`] with attributes that take the place of those of the same name.
    pub(super) fn open_with(path: &Path, attributes: &serde_json::Map<String, serde_json::Value>) -> Result<Self> {
        let Opened { header, layout, response, variance, valid, checksums } = open::open(path, attributes)?;
        Ok(Self { path: path.to_path_buf(), header, layout, response, variance, valid, checksums })
    }

    /// What the matrix is.
    pub fn header(&self) -> &MatrixHeader {
        &self.header
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Bytes of all its files.
    ///
    /// # Errors
    /// [`Error::Io`], also for a matrix at `https://`, where there is no way to ask which files there are.
    pub fn bytes_file(&self) -> Result<u64> {
        self.response.files().bytes("").map_err(Error::io("read", &self.path))
    }

    /// What tells it from every other matrix; `None` for one without checksums.
    pub(crate) fn digest(&self) -> Option<&str> {
        self.checksums.as_ref().map(|c| c.digest.as_str())
    }

    /// Channels that are stored: 3, or 1, which is read as all three.
    pub fn channels(&self) -> usize {
        self.response.sides[4]
    }

    /// Ranges of rows that lie in chunks that no other range has, as far as memory allows; together all rows, in order.
    pub(super) fn chunks(&self) -> Vec<std::ops::Range<usize>> {
        self.parts(0..self.header.rows())
    }

    /// Splits rows into ranges that are read at once: part of a line of points, or some whole lines.
    pub(super) fn parts(&self, rows: std::ops::Range<usize>) -> Vec<std::ops::Range<usize>> {
        let nx = self.header.points[0];
        let [across, down] = self.response.chunk_points();
        let line = nx * self.header.row_len();
        let down = down.min((BAND_NUMBERS / line).max(1));
        let mut parts = Vec::new();
        let mut at = rows.start;
        while at < rows.end {
            let (x, y) = (at % nx, at / nx);
            let lines = (down - y % down).min((rows.end - at) / nx);
            let end = if x == 0 && lines > 1 {
                at + lines * nx
            } else {
                // Up to the end of the chunk, or of the line when chunks have several.
                let end = if down > 1 { nx } else { ((x / across + 1) * across).min(nx) };
                (y * nx + end).min(rows.end)
            };
            parts.push(at..end);
            at = end;
        }
        parts
    }

    /// Reads consecutive rows; callable from several threads.
    ///
    /// # Errors
    /// [`Error::BrokenMatrix`] when a chunk is missing or damaged, [`Error::NotFinite`] for NaN or infinity where it
    /// was measured, [`Error::MatrixFormat`] for numbers of a type that is not read, [`Error::Internal`] for rows that
    /// the matrix has not.
    pub fn read(&self, rows: std::ops::Range<usize>) -> Result<RowBlock> {
        self.read_parts(rows, true)
    }

    /// [`Self::read`] without the variance, which is half of the bytes.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    pub fn read_responses(&self, rows: std::ops::Range<usize>) -> Result<RowBlock> {
        self.read_parts(rows, false)
    }

    fn read_parts(&self, rows: std::ops::Range<usize>, variance: bool) -> Result<RowBlock> {
        let mut block = RowBlock::zeros(0..0, 0);
        self.read_into(rows, variance, &mut block)?;
        Ok(block)
    }

    /// [`Self::read`], with the variance or without, into the memory of another block.
    pub(super) fn read_into(&self, rows: std::ops::Range<usize>, variance: bool, block: &mut RowBlock) -> Result<()> {
        if rows.end > self.header.rows() || rows.start > rows.end {
            return Err(Error::internal(format_args!("rows {rows:?} of a matrix of {}", self.header.rows())));
        }
        let n = rows.len() * self.header.row_len();
        (block.first, block.rows) = (rows.start, rows.len());
        block.response.resize(n, 0.0);
        block.variance.resize(if variance { n } else { 0 }, 0.0);
        block.valid.resize(n, 0);
        // Chunks are decoded side by side, each into its place.
        let mut parts = Vec::new();
        let (mut response, mut variances, mut valid) =
            (block.response.as_mut_slice(), block.variance.as_mut_slice(), block.valid.as_mut_slice());
        for rows in self.parts(rows) {
            let n = rows.len() * self.header.row_len();
            let (response_here, rest) = std::mem::take(&mut response).split_at_mut(n);
            response = rest;
            let (valid_here, rest) = std::mem::take(&mut valid).split_at_mut(n);
            valid = rest;
            let (variance_here, rest) = std::mem::take(&mut variances).split_at_mut(if variance { n } else { 0 });
            variances = rest;
            parts.push(Part { rows, response: response_here, variance: variance_here, valid: valid_here });
        }
        parts.into_par_iter().try_for_each(|part| self.read_part(part))
    }

    fn read_part(&self, part: Part<'_>) -> Result<()> {
        let Part { rows, response, variance, valid } = part;
        let unread = |name: &str, reason: String| match reason.starts_with("numbers of type") {
            true => Error::MatrixFormat {
                path: self.path.clone(),
                part: format!("array {name}"),
                expected: "numbers of type float32, float64 or float16".into(),
                found: reason,
            },
            false => self.response.files().broken(&self.path, format!("array {name}: {reason}")),
        };
        let sums = self.checksums.as_ref();
        if self.layout.stored != self.layout.window {
            // Nothing is read there.
            response.fill(f32::NAN);
            variance.fill(0.0);
            valid.fill(0);
        }
        let (a, b) = rayon::join(
            || self.response.read(rows.clone(), &self.layout, sums, response).map_err(|e| unread("response", e)),
            || match &self.variance {
                Some(array) if !variance.is_empty() => {
                    array.read(rows.clone(), &self.layout, sums, variance).map_err(|e| unread("variance", e))
                }
                _ => {
                    variance.fill(0.0);
                    Ok(())
                }
            },
        );
        a.and(b)?;
        match &self.valid {
            Some(array) => array.read_flags(rows.clone(), &self.layout, sums, valid).map_err(|e| unread("valid", e))?,
            None => valid.iter_mut().zip(&*response).for_each(|(valid, v)| *valid = u8::from(!v.is_nan())),
        }
        self.settle(rows.start, response, variance, valid)
    }

    /// Makes what was not measured 0, and refuses what is no number where it was measured.
    fn settle(&self, first: usize, response: &mut [f32], variance: &mut [f32], valid: &[u8]) -> Result<()> {
        if let Some(at) = first_bad(valid, |v| v > 1) {
            return Err(self.bad_flag(first, at, valid[at]));
        }
        for (field, values) in [("response", response), ("variance", variance)] {
            let settled = values.par_chunks_mut(CHECKED).zip(valid.par_chunks(CHECKED)).map(|(values, valid)| {
                // Without a way out of the loop it is a matter of vector instructions; where is looked for only when
                // there is something.
                values.iter_mut().zip(valid).fold(true, |good, (v, &valid)| {
                    *v = if valid == 0 { 0.0 } else { *v };
                    good & v.is_finite()
                })
            });
            if settled.reduce(|| true, |a, b| a & b) {
                continue;
            }
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                return Err(self.not_finite(field, first, at, values[at]));
            }
        }
        Ok(())
    }

    fn bad_flag(&self, first: usize, at: usize, found: u8) -> Error {
        let (place, text) = self.place(first, at);
        let array = self.valid.as_ref().filter(|array| array.fill_byte() == Some(found));
        match array.and_then(|array| array.missing_chunk(place)) {
            Some(chunk) => Error::BrokenMatrix { path: self.path.clone(), reason: format!("chunk {chunk} is missing") },
            None => Error::MatrixFormat {
                path: self.path.clone(),
                part: "array valid".into(),
                expected: "1 where measured and 0 where not".into(),
                found: format!("{found} at {text}"),
            },
        }
    }

    fn not_finite(&self, field: &'static str, first: usize, at: usize, found: f32) -> Error {
        let (place, text) = self.place(first, at);
        let array = if field == "response" { Some(&self.response) } else { self.variance.as_ref() };
        match array.filter(|_| found.is_nan()).and_then(|array| array.missing_chunk(place)) {
            Some(chunk) => Error::BrokenMatrix {
                path: self.path.clone(),
                reason: format!("chunk {chunk} is missing, though its samples are marked as measured"),
            },
            None => Error::NotFinite { path: self.path.clone(), field, found: found.into(), at: text },
        }
    }

    /// Where number `at` of the rows from `first` on is: along each axis of the stored arrays, and for a person.
    fn place(&self, first: usize, at: usize) -> ([usize; 5], String) {
        let (n, [wx, _], [nx, _]) = (self.header.row_len(), self.header.window, self.header.points);
        let (row, sample, channel) = (first + at / n, at % n / CHANNELS, at % CHANNELS);
        let ([x, y], [left, top]) = ([row % nx, row / nx], self.layout.before);
        let (dx, dy) = ((sample % wx).saturating_sub(left), (sample / wx).saturating_sub(top));
        let channels = self.response.sides[4];
        let text = format!("lit point [{x}, {y}], sample [{dx}, {dy}], channel {channel}");
        ([y, x, dy, dx, channel.min(channels - 1)], text)
    }
}

/// Rows that are read at once, and where they go.
struct Part<'a> {
    rows: std::ops::Range<usize>,
    response: &'a mut [f32],
    variance: &'a mut [f32],
    valid: &'a mut [u8],
}

/// The first of the numbers that is bad.
fn first_bad(values: &[u8], bad: impl Fn(u8) -> bool + Sync) -> Option<usize> {
    let any = values.par_chunks(CHECKED).any(|part| part.iter().fold(false, |any, &v| any | bad(v)));
    any.then(|| values.iter().position(|&v| bad(v))).flatten()
}
