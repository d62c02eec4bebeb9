//! Arrays from files: NPY, NPZ, and Zarr groups that are no matrix yet.

use super::{ArrayOf, MatrixArrays};
use crate::files::is_url;
use crate::npy::NpyHeader;
use crate::transport::MatrixReader;
use crate::transport::row_array::{check_chunks, check_metadata, wide_numbers};
use crate::transport::store_files::StoreFiles;
use crate::{Error, Result};
use serde_json::{Map, Value};
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Arc;
use zarrs::array::Array;
use zip::{ZipArchive, result::ZipError};

/// The most numbers of an array, 16 GiB of f32.
const MOST_NUMBERS: u64 = 1 << 32;

/// What a file holds.
#[derive(Debug)]
pub enum ArraysInput {
    /// Arrays in memory.
    Arrays(Box<MatrixArrays<'static>>),
    /// A Zarr group with windows around lit points, which is a matrix already.
    Store(Box<MatrixReader>),
}

/// Where arrays come from.
trait Named {
    fn array<T: Copy + 'static>(&mut self, name: &str, make: fn(f64) -> T) -> Result<Option<ArrayOf<'static, T>>>;
}

/// Reads `path`: an `.npy` is the response; an `.npz` or a Zarr group has arrays by name. `full` says that a Zarr array
/// over four axes is a full matrix. Of a group that is a matrix, `instead` takes the place of attributes.
///
/// # Errors
/// [`Error::Io`]; [`Error::Arrays`] naming file and array; those of [`MatrixReader::open`].
pub fn open_arrays(path: &Path, full: bool, instead: &Map<String, Value>) -> Result<ArraysInput> {
    if is_url(path) || std::fs::metadata(path).map_err(Error::io("read", path))?.is_dir() {
        return from_zarr(path, full, instead);
    }
    let mut start = [0; 6];
    let mut file = crate::files::open_local(path).map_err(Error::io("read", path))?;
    let read = file.read(&mut start).map_err(Error::io("read", path))?;
    if &start[..read] == b"\x93NUMPY" {
        let mut file = BufReader::new(crate::files::open_local(path).map_err(Error::io("read", path))?);
        let response = npy(path, "response", &mut file, |v| v as f32)?;
        return Ok(ArraysInput::Arrays(Box::new(alone(path, response))));
    }
    if !start.starts_with(b"PK") {
        let found = "a file of another kind".into();
        return Err(refused(path, "file", "an .npy or .npz of NumPy, or a Zarr group", found));
    }
    let file = BufReader::new(crate::files::open_local(path).map_err(Error::io("read", path))?);
    let zip = ZipArchive::new(file).map_err(|e| refused(path, "archive", "a whole NPZ archive", e.to_string()))?;
    let arrays = by_name(path, &mut Npz { path, zip })?;
    Ok(ArraysInput::Arrays(Box::new(arrays)))
}

fn refused(path: &Path, array: &str, expected: &str, found: String) -> Error {
    Error::Arrays { path: path.to_path_buf(), array: array.into(), expected: expected.into(), found }
}

fn alone(path: &Path, response: ArrayOf<'static, f32>) -> MatrixArrays<'static> {
    MatrixArrays {
        name: path.to_path_buf(),
        response,
        variance: None,
        valid: None,
        x_i_mm: None,
        y_i_mm: None,
        position_sd_mm: None,
        pitch_mm: None,
        lit_pitch_mm: None,
    }
}

fn by_name(path: &Path, from: &mut impl Named) -> Result<MatrixArrays<'static>> {
    let missing = || refused(path, "response", "an array of this name", "none".into());
    // The small ones first: their mistakes cost nothing.
    let pitch = from.array("pitch_mm", |v| v)?;
    let lit_pitch = from.array("lit_pitch_mm", |v| v)?;
    let wrong = |name: &str, expected: &str, shape: &[usize]| refused(path, name, expected, format!("shape {shape:?}"));
    let pitch_mm = pitch.map(|a| match *a.values {
        [v] => Ok(v),
        _ => Err(wrong("pitch_mm", "one number", &a.shape)),
    });
    let lit_pitch_mm = lit_pitch.map(|a| match *a.values {
        [v] => Ok([v; 2]),
        [x, y] => Ok([x, y]),
        _ => Err(wrong("lit_pitch_mm", "one number, or two for x and y", &a.shape)),
    });
    let [x_i_mm, y_i_mm, position_sd_mm] = ["x_i_mm", "y_i_mm", "position_sd_mm"].map(|name| from.array(name, |v| v));
    Ok(MatrixArrays {
        x_i_mm: x_i_mm?,
        y_i_mm: y_i_mm?,
        position_sd_mm: position_sd_mm?,
        pitch_mm: pitch_mm.transpose()?,
        lit_pitch_mm: lit_pitch_mm.transpose()?,
        variance: from.array("variance", |v| v as f32)?,
        valid: from.array("valid", |v| u8::from(v != 0.0))?,
        ..alone(path, from.array("response", |v| v as f32)?.ok_or_else(missing)?)
    })
}

/// How many numbers a shape has, unless they are too many.
fn count(path: &Path, name: &str, shape: &[u64]) -> Result<usize> {
    let product = shape.iter().try_fold(1u64, |all, &n| all.checked_mul(n));
    product
        .filter(|n| *n <= MOST_NUMBERS)
        .map(|n| n as usize)
        .ok_or_else(|| refused(path, name, &format!("at most {MOST_NUMBERS} numbers"), format!("shape {shape:?}")))
}

fn npy<T: Copy>(path: &Path, name: &str, reader: &mut impl Read, make: fn(f64) -> T) -> Result<ArrayOf<'static, T>> {
    let broken = |reason: String| refused(path, name, "a whole NumPy array", reason);
    let header = NpyHeader::read(reader).map_err(broken)?;
    let len = count(path, name, &header.shape)?;
    let values = header.numbers(reader, len, make).map_err(broken)?;
    Ok(ArrayOf { shape: header.shape.iter().map(|&n| n as usize).collect(), values: Cow::Owned(values) })
}

struct Npz<'a> {
    path: &'a Path,
    zip: ZipArchive<BufReader<File>>,
}

impl Named for Npz<'_> {
    fn array<T: Copy + 'static>(&mut self, name: &str, make: fn(f64) -> T) -> Result<Option<ArrayOf<'static, T>>> {
        match self.zip.by_name(&format!("{name}.npy")) {
            Ok(mut entry) => npy(self.path, name, &mut entry, make).map(Some),
            Err(ZipError::FileNotFound) => Ok(None),
            Err(e) => Err(refused(self.path, name, "a whole NumPy array", e.to_string())),
        }
    }
}

/// A Zarr group, or one array, which is then the response.
struct Zarr<'a> {
    path: &'a Path,
    store: Arc<StoreFiles>,
    attributes: Map<String, Value>,
    only: bool,
}

impl Zarr<'_> {
    fn open(&self, name: &str) -> Result<Option<Array<StoreFiles>>> {
        let folder = if self.only { "" } else { name };
        let there = self.store.has(folder, &["zarr.json", ".zarray"]).map_err(Error::io("read", self.path))?;
        if !there || self.only && name != "response" {
            return Ok(None);
        }
        check_metadata(&self.store, folder).map_err(|e| refused(self.path, name, "a whole Zarr array", e))?;
        let node = if self.only { "/".into() } else { format!("/{name}") };
        let array = Array::open(self.store.clone(), &node);
        array.map(Some).map_err(|e| refused(self.path, name, "a whole Zarr array", e.to_string()))
    }
}

impl Named for Zarr<'_> {
    fn array<T: Copy + 'static>(&mut self, name: &str, make: fn(f64) -> T) -> Result<Option<ArrayOf<'static, T>>> {
        let numbers = |value: &Value| match value {
            Value::Array(all) => all.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>(),
            other => other.as_f64().map(|v| vec![v]),
        };
        let Some(array) = self.open(name)? else {
            // Scalars are attributes.
            let Some(value) = self.attributes.get(name).filter(|_| name.ends_with("pitch_mm")) else { return Ok(None) };
            let values = numbers(value).ok_or_else(|| refused(self.path, name, "a number", value.to_string()))?;
            return Ok(Some(ArrayOf {
                shape: vec![values.len()],
                values: Cow::Owned(values.into_iter().map(make).collect()),
            }));
        };
        count(self.path, name, array.shape())?;
        check_chunks(&array).map_err(|[expected, found]| refused(self.path, name, &expected, found))?;
        let values = wide_numbers(&array, &array.subset_all());
        let values = values.map_err(|e| refused(self.path, name, "a whole Zarr array of numbers", e))?;
        let shape = array.shape().iter().map(|&n| n as usize).collect();
        Ok(Some(ArrayOf { shape, values: Cow::Owned(values.into_iter().map(make).collect()) }))
    }
}

fn from_zarr(path: &Path, full: bool, instead: &Map<String, Value>) -> Result<ArraysInput> {
    if path.to_str().is_none() {
        return Err(refused(path, "group", "a path in UTF-8", "another".into()));
    }
    let store = Arc::new(StoreFiles::at(path)?);
    let broken = |e: String| refused(path, "group", "a Zarr group with the array response, or a Zarr array", e);
    if !store.has("", &["zarr.json", ".zgroup", ".zarray"]).map_err(Error::io("read", path))? {
        return Err(broken("a folder without zarr.json".into()));
    }
    let group = zarrs::group::Group::open(store.clone(), "/");
    let only = group.is_err();
    let attributes = group.map(|group| group.attributes().clone()).unwrap_or_default();
    let mut zarr = Zarr { path, store, attributes, only };
    let response = zarr.open("response")?.ok_or_else(|| broken("no array response".into()))?;
    let windows = zarr_windows(&response);
    if windows && !only && !full {
        return Ok(ArraysInput::Store(Box::new(MatrixReader::open_with(path, instead)?)));
    }
    Ok(ArraysInput::Arrays(Box::new(by_name(path, &mut zarr)?)))
}

/// Whether an array is over windows: three axes or more, unless they are those of points and channels alone.
fn zarr_windows(array: &Array<StoreFiles>) -> bool {
    match crate::transport::row_array::dimension_names(array) {
        Some(names) => names.iter().any(|name| name == "dx" || name == "dy"),
        None => array.shape().len() >= 4,
    }
}
