//! A matrix from arrays that somebody else made: windows around lit points, or a full matrix over pairs of points.
//!
//! # Conventions
//! - `response` is `[y_i, x_i, dy, dx]`, or that with a last axis of 1 or 3 channels; a full matrix is `[i, o]`, `[i,
//!   o, channel]`, or, where it is said to be full, `[y_i, x_i, y_o, x_o]` with or without channels. The first point is
//!   the lit one. One channel is grey: it is all three.
//! - A full matrix is over one lattice of points, which is both lit and outgoing: its pitches are one.

mod files;
mod full;
mod survey;

pub use files::{ArraysInput, open_arrays};

use super::store::{MOST_POINTS, MOST_SAMPLES};
use super::{CHANNELS, MatrixHeader, MatrixReader, MatrixWriter, Row};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::{Error, Result, Warning};
use rayon::prelude::*;
use std::borrow::Cow;
use std::path::Path;
use survey::Survey;

/// Numbers of rows that are made at a time.
const BLOCK_NUMBERS: usize = 1 << 22;

/// An array in C order.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrayOf<'a, T: Clone> {
    /// Numbers along each axis.
    pub shape: Vec<usize>,
    /// All of them.
    pub values: Cow<'a, [T]>,
}

/// What a matrix is made from. Only `response` is needed.
#[derive(Debug, Clone, PartialEq)]
pub struct MatrixArrays<'a> {
    /// What errors call it: the file, or the output that it is for.
    pub name: std::path::PathBuf,
    /// R_d, mm⁻², in one of the shapes of this module. NaN: not measured.
    pub response: ArrayOf<'a, f32>,
    /// Its variance, mm⁻⁴, of the same shape; 0 where it is not known, which is the default.
    pub variance: Option<ArrayOf<'a, f32>>,
    /// 1 where measured, 0 where not; default: where the response is a number.
    pub valid: Option<ArrayOf<'a, u8>>,
    /// Where lit points are along x, mm, `[y_i, x_i]`; default: a lattice of the lit pitch from 0.
    pub x_i_mm: Option<ArrayOf<'a, f64>>,
    /// The same along y.
    pub y_i_mm: Option<ArrayOf<'a, f64>>,
    /// Standard deviation of those places per axis, mm, `[y_i, x_i]`; default: 0.
    pub position_sd_mm: Option<ArrayOf<'a, f64>>,
    /// Side of a sample, mm, where the file says it.
    pub pitch_mm: Option<f64>,
    /// Distance of lit points along x and y, mm, where the file says it.
    pub lit_pitch_mm: Option<Point>,
}

/// How arrays become a matrix.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ArraysOptions {
    /// Side of a sample, mm; before what the file says. Needed where the file does not say it.
    pub pitch_mm: Option<f64>,
    /// Distance of lit points along x and y, mm; before what the file says. Default: that of the given places, else the
    /// pitch.
    pub lit_pitch_mm: Option<Point>,
    /// Lit points along x and y of a full matrix `[i, o]`; default: as many along both, where their number is a square.
    pub points: Option<[usize; 2]>,
    /// Samples along x and y of the windows of a full matrix, odd; default: the smallest as wide as high that leave out
    /// a thousandth of the light at most.
    pub window: Option<[usize; 2]>,
    /// Whether `[y_i, x_i, a, b]` is a full matrix over y_o and x_o, and not windows.
    pub full: bool,
    /// How the arrays came to be, for the provenance.
    pub source: String,
}

/// What came of it.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct ImportedMatrix {
    /// Lit points along x and y.
    pub points: [usize; 2],
    /// Samples of a window along x and y.
    pub window: [usize; 2],
    /// Channels of the arrays: 1 or 3.
    pub channels: usize,
    /// Side of a sample, mm.
    pub pitch_mm: f64,
    /// Distance of lit points along x and y, mm.
    pub lit_pitch_mm: Point,
    /// Share of the store's numbers that were measured.
    pub measured_share: f64,
    /// Of a full matrix, the share of the light that lies outside the windows.
    pub light_outside_window: Option<f64>,
    /// What was not given, and what stands for it.
    pub defaults: Vec<String>,
    /// What was found.
    #[serde(skip)]
    pub findings: Vec<Warning>,
}

/// Which number of the arrays is at a lit point, sample and channel.
#[derive(Debug)]
struct Form {
    points: [usize; 2],
    window: [usize; 2],
    channels: usize,
    full: bool,
}

impl Form {
    /// Where the samples of line `dy` of a row's window lie in the arrays: sample of the window, first number of the
    /// arrays, how many.
    fn line(&self, row: usize, dy: usize) -> Option<(usize, usize, usize)> {
        let ([nx, ny], [w, h]) = (self.points, self.window);
        if !self.full {
            return Some((0, (row * h + dy) * w * self.channels, w));
        }
        // The outgoing point is the lit one and the offset; beyond the lattice nothing is known.
        let (x, y) = (row % nx, row / nx);
        let y_o = (y + dy).checked_sub(h / 2).filter(|&y| y < ny)?;
        let first = (w / 2).saturating_sub(x);
        let x_o = (x + first).checked_sub(w / 2).filter(|&x| x < nx)?;
        let count = (nx - x_o).min(w - first);
        Some((first, (row * nx * ny + y_o * nx + x_o) * self.channels, count))
    }
}

/// Writes the store `out` from arrays.
///
/// # Errors
/// [`Error::Arrays`] and [`Error::NotFinite`], naming the array and the place; [`Error::Setting`]; [`Error::Io`].
pub fn import_arrays(
    arrays: &MatrixArrays<'_>,
    options: &ArraysOptions,
    out: &Path,
    progress: &Progress,
) -> Result<ImportedMatrix> {
    let refused = |array: &str, expected: String, found: String| arrays.refused(array, expected, found);
    let mut form = form(arrays, options)?;
    for (name, shape) in
        [("variance", arrays.variance.as_ref().map(|a| &a.shape)), ("valid", arrays.valid.as_ref().map(|a| &a.shape))]
    {
        if let Some(shape) = shape.filter(|shape| **shape != arrays.response.shape) {
            return Err(refused(
                name,
                format!("the shape of response, {:?}", arrays.response.shape),
                format!("{shape:?}"),
            ));
        }
    }
    let mut outside = None;
    if form.full {
        let asked = options.window;
        let (window, share) = full::window(&arrays.response.values, form.points, form.channels, asked);
        (form.window, outside) = (window, Some(share));
    }
    let mut defaults = Vec::new();
    let header = header(arrays, options, &form, &mut defaults)?;
    let imported = ImportedMatrix {
        points: header.points,
        window: header.window,
        channels: form.channels,
        pitch_mm: header.pitch_mm,
        lit_pitch_mm: header.lit_pitch_mm,
        measured_share: 0.0,
        light_outside_window: outside,
        defaults,
        findings: Vec::new(),
    };
    let mut survey = Survey::new(&header);
    let writer = MatrixWriter::create(out, header)?;
    let (rows, len) = (writer.header().rows(), writer.header().row_len());
    let stage = progress.stage("import", rows);
    let at_once = (BLOCK_NUMBERS / len).max(1);
    for first in (0..rows).step_by(at_once) {
        let made: Vec<Result<Row>> = (first..rows.min(first + at_once))
            .into_par_iter()
            .map(|index| {
                let row = arrays.row(&form, index)?;
                writer.put(index, &row)?;
                Ok(row)
            })
            .collect();
        for (k, row) in made.into_iter().enumerate() {
            survey.add(&row?, |sample, channel| arrays.place(&form, first + k, sample, channel));
            stage.advance(1);
        }
    }
    finish(writer, survey, imported)
}

/// Writes the store `out` from another store that [`MatrixReader`] reads.
///
/// # Errors
/// Those of [`MatrixReader::read`] and [`MatrixWriter`].
pub fn import_store(reader: &MatrixReader, source: &str, out: &Path, progress: &Progress) -> Result<ImportedMatrix> {
    let mut header = reader.header().clone();
    let before = std::mem::take(&mut header.provenance);
    header.provenance = provenance(source, Some(before));
    let imported = ImportedMatrix {
        points: header.points,
        window: header.window,
        channels: reader.channels(),
        pitch_mm: header.pitch_mm,
        lit_pitch_mm: header.lit_pitch_mm,
        measured_share: 0.0,
        light_outside_window: None,
        defaults: Vec::new(),
        findings: Vec::new(),
    };
    let mut survey = Survey::new(&header);
    let writer = MatrixWriter::create(out, header)?;
    let stage = progress.stage("import", reader.header().rows());
    let [nx, wx] = [reader.header().points[0], reader.header().window[0]];
    reader.for_each_block(|block| {
        for k in 0..block.rows {
            let (view, index) = (block.view(k), block.first + k);
            let valid = view.valid.iter().map(|&v| v != 0).collect();
            let row = Row { response: view.response.to_vec(), variance: view.variance.to_vec(), valid };
            writer.put(index, &row)?;
            survey.add(&row, |sample, channel| {
                Some(format!("response{:?}", [index / nx, index % nx, sample / wx, sample % wx, channel]))
            });
            stage.advance(1);
        }
        Ok(())
    })?;
    finish(writer, survey, imported)
}

fn finish(mut writer: MatrixWriter, survey: Survey, imported: ImportedMatrix) -> Result<ImportedMatrix> {
    let (measured_share, findings) = survey.findings(imported.light_outside_window);
    writer.header_mut().warnings.extend(findings.iter().cloned());
    writer.finish()?;
    Ok(ImportedMatrix { measured_share, findings, ..imported })
}

fn provenance(source: &str, before: Option<serde_json::Value>) -> serde_json::Value {
    let mut object = serde_json::json!({ "source": source, "version": env!("CARGO_PKG_VERSION") });
    if let Some(before) = before.filter(|before| !before.is_null()) {
        object["of_source"] = before;
    }
    object
}

/// What the shape of the arrays means.
fn form(arrays: &MatrixArrays<'_>, options: &ArraysOptions) -> Result<Form> {
    let shape = arrays.response.shape.as_slice();
    let refused = |expected: &str| arrays.refused("response", expected.into(), format!("shape {shape:?}"));
    if arrays.response.values.is_empty() {
        return Err(refused("a number or more"));
    }
    let (sides, channels) = match *shape {
        [n, m] => (vec![n, m], 1),
        [n, m, c @ (1 | CHANNELS)] => (vec![n, m], c),
        [a, b, c, d] => (vec![a, b, c, d], 1),
        [a, b, c, d, channels @ (1 | CHANNELS)] => (vec![a, b, c, d], channels),
        _ => {
            return Err(refused(
                "[y_i, x_i, dy, dx], [y_i, x_i, dy, dx, 1 or 3], or of a full matrix [i, o], [i, o, 1 or 3]",
            ));
        }
    };
    let form = match *sides.as_slice() {
        [n, m] => {
            if n != m {
                return Err(refused("as many outgoing as lit points"));
            }
            let points = match options.points {
                Some(points) if points[0].checked_mul(points[1]) == Some(n) => points,
                Some(points) => {
                    let expected = format!("two numbers whose product is {n}, the points of response");
                    return Err(Error::Setting {
                        setting: "points",
                        expected,
                        found: format!("{}x{}", points[0], points[1]),
                    });
                }
                None if n.isqrt().pow(2) == n => [n.isqrt(); 2],
                None => {
                    let expected = format!("points along x and y, as {n} is no square");
                    return Err(Error::Setting { setting: "points", expected, found: "none".into() });
                }
            };
            Form { points, window: [1; 2], channels, full: true }
        }
        [ny, nx, h, w] => {
            if options.full && [ny, nx] != [h, w] {
                return Err(refused(
                    "[y_i, x_i, y_o, x_o] with as many outgoing as lit points, as it is said to be full",
                ));
            }
            if !options.full && (h % 2 == 0 || w % 2 == 0) {
                return Err(refused(
                    "odd numbers of samples along dy and dx, with the lit point in the middle (a matrix over y_o, x_o is imported as full)",
                ));
            }
            Form { points: [nx, ny], window: [w, h], channels, full: options.full }
        }
        _ => return Err(Error::internal("an array has two or four sides")),
    };
    if form.points.iter().any(|&n| n > MOST_POINTS) || form.window.iter().any(|&n| n > MOST_SAMPLES) {
        return Err(refused(&format!("up to {MOST_POINTS} points and {MOST_SAMPLES} samples along an axis")));
    }
    if !form.full {
        for (setting, given) in [("points", options.points), ("window", options.window)] {
            if let Some([a, b]) = given {
                let expected = "none, as the shape of response says it (it is for full matrices)".into();
                return Err(Error::Setting { setting, expected, found: format!("{a}x{b}") });
            }
        }
    }
    if let Some(window) = options.window.filter(|w| w.iter().any(|&n| n % 2 == 0 || n > MOST_SAMPLES)) {
        let expected = format!("odd numbers up to {MOST_SAMPLES}");
        return Err(Error::Setting { setting: "window", expected, found: format!("{}x{}", window[0], window[1]) });
    }
    Ok(form)
}

fn header(
    arrays: &MatrixArrays<'_>,
    options: &ArraysOptions,
    form: &Form,
    defaults: &mut Vec<String>,
) -> Result<MatrixHeader> {
    let [nx, ny] = form.points;
    let Some(pitch_mm) = options.pitch_mm.or(arrays.pitch_mm) else {
        let expected = "the side of a sample in mm, as the input does not say it".into();
        return Err(Error::Setting { setting: "pitch_mm", expected, found: "none".into() });
    };
    super::store::check_mm("pitch_mm", pitch_mm)?;
    let lit = if form.full { Some([pitch_mm; 2]) } else { None };
    let stated = options.lit_pitch_mm.or(arrays.lit_pitch_mm).or(lit);
    stated.into_iter().flatten().try_for_each(|v| super::store::check_mm("lit_pitch_mm", v))?;
    let places = [
        arrays.over_points("x_i_mm", &arrays.x_i_mm, form.points)?,
        arrays.over_points("y_i_mm", &arrays.y_i_mm, form.points)?,
    ];
    let (lit_mm, lit_pitch_mm): (Vec<Point>, Point) = match places {
        [Some(x), Some(y)] => {
            let lit_mm: Vec<Point> = x.into_iter().zip(y).map(|(x, y)| [x, y]).collect();
            let found = [0, 1].map(|a| super::open::distance(&lit_mm, form.points, a));
            let pitch = [0, 1].map(|a| stated.map(|p| p[a]).or(found[a]).unwrap_or(pitch_mm));
            (lit_mm, pitch)
        }
        [None, None] => {
            let pitch = stated.unwrap_or([pitch_mm; 2]);
            if stated.is_none() {
                defaults.push(format!("lit_pitch_mm: the pitch, {pitch_mm} mm"));
            }
            defaults.push(format!("x_i_mm, y_i_mm: a lattice of {} mm × {} mm from 0", pitch[0], pitch[1]));
            ((0..nx * ny).map(|k| [(k % nx) as f64 * pitch[0], (k / nx) as f64 * pitch[1]]).collect(), pitch)
        }
        [x, _] => {
            let missing = if x.is_some() { "y_i_mm" } else { "x_i_mm" };
            return Err(arrays.refused(missing, "x_i_mm and y_i_mm, or neither".into(), "one of them".into()));
        }
    };
    if arrays.variance.is_none() {
        defaults.push("variance: 0, not known".into());
    }
    let position_sd_mm = match arrays.over_points("position_sd_mm", &arrays.position_sd_mm, form.points)? {
        Some(sd) => sd,
        None => {
            defaults.push("position_sd_mm: 0".into());
            vec![0.0; nx * ny]
        }
    };
    let header = MatrixHeader {
        points: form.points,
        window: form.window,
        pitch_mm,
        lit_pitch_mm,
        lit_mm,
        position_sd_mm,
        shot_of: vec![None; nx * ny],
        common: None,
        shots: Vec::new(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: provenance(&options.source, None),
    };
    let checked = header.check().and_then(|()| header.check_places());
    checked.map_err(|reason| arrays.refused("x_i_mm, y_i_mm, position_sd_mm", "places on a slab".into(), reason))?;
    Ok(header)
}

impl MatrixArrays<'_> {
    fn refused(&self, array: &str, expected: String, found: String) -> Error {
        Error::Arrays { path: self.name.clone(), array: array.into(), expected, found }
    }

    /// A number for each lit point.
    fn over_points(
        &self,
        name: &str,
        array: &Option<ArrayOf<'_, f64>>,
        [nx, ny]: [usize; 2],
    ) -> Result<Option<Vec<f64>>> {
        let Some(array) = array else { return Ok(None) };
        let fits = array.shape == [ny, nx] || array.shape == [nx * ny];
        if !fits || array.values.len() != nx * ny {
            let expected = format!("shape [{ny}, {nx}] over y_i, x_i");
            return Err(self.refused(name, expected, format!("{:?}", array.shape)));
        }
        match array.values.iter().position(|v| !v.is_finite()) {
            Some(k) => {
                let found = format!("{} at [{}, {}]", array.values[k], k / nx, k % nx);
                Err(self.refused(name, "finite numbers".into(), found))
            }
            None => Ok(Some(array.values.to_vec())),
        }
    }

    /// A row of the matrix.
    fn row(&self, form: &Form, index: usize) -> Result<Row> {
        let ([w, h], channels) = (form.window, form.channels);
        let n = w * h * CHANNELS;
        let mut row = Row { response: vec![0.0; n], variance: vec![0.0; n], valid: vec![false; n] };
        for dy in 0..h {
            let Some((first, from, count)) = form.line(index, dy) else { continue };
            for k in 0..count * CHANNELS {
                let (out, at) = (
                    (dy * w + first) * CHANNELS + k,
                    from + k / CHANNELS * channels + (k % CHANNELS).min(channels - 1),
                );
                let value = self.response.values[at];
                let valid = match &self.valid {
                    Some(valid) => valid.values[at] != 0,
                    None => !value.is_nan(),
                };
                if !valid {
                    continue;
                }
                let variance = self.variance.as_ref().map_or(0.0, |variance| variance.values[at]);
                for (field, number) in [("response", value), ("variance", variance)] {
                    if !number.is_finite() {
                        let at = format!("{field}{:?}", self.index(at));
                        return Err(Error::NotFinite { path: self.name.clone(), field, found: number.into(), at });
                    }
                }
                if variance < 0.0 {
                    return Err(self.refused(
                        "variance",
                        "0 or more".into(),
                        format!("{variance} at variance{:?}", self.index(at)),
                    ));
                }
                (row.response[out], row.variance[out], row.valid[out]) = (value, variance, true);
            }
        }
        Ok(row)
    }

    /// The indices of a number of the arrays.
    fn index(&self, at: usize) -> Vec<usize> {
        let mut rest = at;
        let mut index: Vec<usize> = self
            .response
            .shape
            .iter()
            .rev()
            .map(|&n| {
                let one = rest % n;
                rest /= n;
                one
            })
            .collect();
        index.reverse();
        index
    }

    /// The indices of a number of a row, for a person; `None` where the arrays have none.
    fn place(&self, form: &Form, row: usize, sample: usize, channel: usize) -> Option<String> {
        let (dx, dy) = (sample % form.window[0], sample / form.window[0]);
        let (first, from, count) = form.line(row, dy)?;
        let at = from + dx.checked_sub(first)? * form.channels + channel.min(form.channels - 1);
        (dx < first + count).then(|| format!("response{:?}", self.index(at)))
    }
}

#[cfg(test)]
mod tests;
