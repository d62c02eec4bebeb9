//! The matrix on disk: a Zarr v3 group `*.rd.zarr` that xarray, zarr-python and dask open without our code.
//!
//! | array | dimensions | unit |
//! |---|---|---|
//! | `response` f32 | y_i, x_i, dy, dx, channel | mm⁻² |
//! | `variance` f32 | the same | mm⁻⁴ |
//! | `valid` u8 | the same | 1 measured, 0 not (the response is then 0) |
//! | `x_i_mm`, `y_i_mm` f64 | y_i, x_i | where the light really fell, mm |
//! | `position_sd_mm` f64 | y_i, x_i | standard deviation of that place per axis, mm |
//! | `dx`, `dy` f64 | dx; dy | offset of the cell's centre from the lit point, mm |
//! | `shot` i32 | y_i, x_i | number of the shot that lit it, an index into the attribute `shots` |
//!
//! Everything else is in the group's attributes, see [`MatrixHeader`]; `findings` are the records ([`FindingRecord`]) of `warnings`, one for one.

use super::checksum::{self, Checksums};
use super::{earlier, positioned};
use crate::output::{ScratchFolder, put};
use crate::{Error, FindingRecord, Result, Warning, geometry::Point};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use zarrs::array::codec::{Crc32cCodec, ZstdCodec};
use zarrs::array::{Array, ArrayBuilder, ArraySubset, ChunkKeySeparator, ElementOwned, data_type};
use zarrs::filesystem::FilesystemStore;

/// The version of this layout, attribute `acquire_format`.
const FORMAT: u32 = 1;
/// The most lit points along an axis.
const MOST_POINTS: usize = 1 << 16;
/// The most samples of a window along an axis.
const MOST_SAMPLES: usize = 4095;
/// No slab is larger, and no length is smaller than one over it, mm.
const LARGEST_MM: f64 = 1e9;
/// Whatever the Zarr crate answers; turned into ours at the public functions.
type BoxedError = Box<dyn std::error::Error + Send + Sync>;
/// R, G, B.
const CHANNELS: usize = 3;
/// A chunk holds about this many bytes of responses: large enough for the disk, small enough to stream.
const CHUNK_BYTES: usize = 4 << 20;
/// Numbers that one thread looks through at a time.
const CHECKED: usize = 1 << 16;
/// Negative levels leave the bytes that do not repeat as they are: decoding is twice as fast as at level 1, for a tenth more bytes of measured
/// noise, which no level compresses by much.
const ZSTD_LEVEL: i32 = -1;

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

    /// Bounds that keep every later product, index and stored number in range; says what is wrong.
    fn check(&self) -> Result<(), String> {
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
        let drift = |s: &ShotRecord| s.drift_px.into_iter().chain(s.drift_sd_px).all(f64::is_finite);
        match self.shots.iter().find(|s| !drift(s)) {
            Some(shot) => {
                Err(format!("drift of shot \"{}\": expected finite numbers, found {:?}", shot.name, shot.drift_px))
            }
            None => Ok(()),
        }
    }

    /// Whether every lit point has a place that can be used.
    fn check_places(&self) -> Result<(), String> {
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
///
/// A lattice shot lights points all over the slab, so rows wait uncompressed in a scratch file until all of a chunk are there.
#[derive(Debug)]
pub struct MatrixWriter {
    path: PathBuf,
    header: MatrixHeader,
    folder: ScratchFolder,
    replaces: bool,
    scratch: File,
    written: Mutex<Vec<bool>>,
}

impl MatrixWriter {
    /// Prepares to write the store `path`; an older store there is replaced by [`Self::finish`].
    ///
    /// # Errors
    /// [`Error::Io`] when the folder of `path` cannot be written; [`Error::NotOurs`], [`Error::Changed`] when something other than a matrix of this
    /// program is at `path`.
    pub fn create(path: &Path, header: MatrixHeader) -> Result<Self> {
        if path.to_str().is_none() {
            // The Zarr crate could not read it back.
            let reason = "the path of a matrix must be UTF-8";
            return Err(Error::io("create", path)(std::io::Error::new(std::io::ErrorKind::InvalidInput, reason)));
        }
        let replaces = earlier::check(path, true)?;
        // Where a link leads: it stays.
        let path = &if replaces { path.canonicalize().map_err(Error::io("create", path))? } else { path.to_path_buf() };
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = ScratchFolder::new(parent, path)?;
        let scratch = tempfile::tempfile_in(folder.path()).map_err(Error::io("create", path))?;
        let written = Mutex::new(vec![false; header.rows()]);
        Ok(Self { path: path.clone(), header, folder, replaces, scratch, written })
    }

    /// What will be written besides the rows.
    pub fn header_mut(&mut self) -> &mut MatrixHeader {
        &mut self.header
    }

    /// What will be written besides the rows.
    pub fn header(&self) -> &MatrixHeader {
        &self.header
    }

    /// Stores row `index` (row-major over (y_i, x_i)).
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when the row has another length than the header says, or a value is not finite.
    pub fn put(&self, index: usize, row: &Row) -> Result<()> {
        let n = self.header.row_len();
        if index >= self.header.rows() || [row.response.len(), row.variance.len(), row.valid.len()] != [n; 3] {
            return Err(Error::internal(format_args!("row {index} does not fit the matrix")));
        }
        let mut bytes = Vec::with_capacity(n * 9);
        for value in row.response.iter().chain(&row.variance) {
            if !value.is_finite() {
                return Err(Error::internal(format_args!("row {index} holds {value}")));
            }
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        bytes.extend(row.valid.iter().map(|&v| u8::from(v)));
        positioned::write_all_at(&self.scratch, &bytes, (index * n * 9) as u64)
            .map_err(Error::io("write", &self.path))?;
        self.written.lock().map_err(Error::internal)?[index] = true;
        Ok(())
    }

    /// The row that was put last at `index`.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when there is none.
    pub fn row(&self, index: usize) -> Result<Row> {
        let written = self.written.lock().map_err(Error::internal)?.get(index).copied();
        if written != Some(true) {
            return Err(Error::internal(format_args!("row {index} has not been put")));
        }
        let block = self.read_scratch(index..index + 1, |_| true).map_err(Error::io("read", &self.path))?;
        Ok(Row {
            response: block.response,
            variance: block.variance,
            valid: block.valid.into_iter().map(|v| v != 0).collect(),
        })
    }

    /// Writes the store and renames it into place. Rows never put are invalid throughout.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when the header holds what [`MatrixReader::open`] would refuse.
    pub fn finish(self) -> Result<()> {
        self.header.check().and_then(|()| self.header.check_places()).map_err(Error::internal)?;
        let written = self.written.lock().map_err(Error::internal)?.clone();
        let store_path = self.folder.new_path();
        self.write_store(&store_path, &written).map_err(|e| e.to_string()).map_err(|reason| Error::Io {
            path: self.path.clone(),
            action: "write",
            source: std::io::Error::new(kind_of(&reason), reason),
        })?;
        earlier::check(&self.path, self.replaces)?;
        put(&self.folder, &self.path, self.replaces).map_err(Error::io("write", &self.path))
    }

    fn write_store(&self, store_path: &Path, written: &[bool]) -> Result<(), BoxedError> {
        let header = &self.header;
        let store = Arc::new(FilesystemStore::new(store_path)?);
        let mut attributes = serde_json::Map::new();
        attributes.insert("acquire_format".into(), FORMAT.into());
        attributes.insert("channels".into(), serde_json::json!(["R", "G", "B"]));
        if let serde_json::Value::Object(fields) = serde_json::to_value(header)? {
            attributes.extend(fields);
        }
        // What `warnings` say, as other programs may want it; not read again.
        let findings: Vec<FindingRecord> = header.warnings.iter().map(Warning::record).collect();
        attributes.insert("findings".into(), serde_json::to_value(findings)?);
        self.write_coordinates(&store)?;

        let arrays =
            ["response", "variance"].map(|name| rows_array(header, &store, name, data_type::float32(), f32::NAN));
        let [response, variance] = arrays;
        let (response, variance) = (response?, variance?);
        let valid = rows_array(header, &store, "valid", data_type::uint8(), u8::MAX)?;
        for array in [&response, &variance, &valid] {
            array.store_metadata()?;
        }
        let chunks: Vec<_> = chunks(header).collect();
        chunks.into_par_iter().try_for_each(|rows| {
            let block = self.read_scratch(rows.clone(), |row| written[row])?;
            let subset = subset(header, rows);
            response.store_array_subset(&subset, block.response)?;
            variance.store_array_subset(&subset, block.variance)?;
            valid.store_array_subset(&subset, block.valid)?;
            Ok::<_, BoxedError>(())
        })?;
        for name in checksum::ARRAYS {
            let mut array = Array::open(store.clone(), &format!("/{name}"))?;
            let sums = checksum::of_chunks(store_path, &array)?;
            array.attributes_mut().insert(checksum::CHUNKS.into(), sums);
            array.store_metadata()?;
        }
        // Last, as it has the checksum of all metadata.
        attributes.insert(checksum::GROUP.into(), checksum::of_group(store_path, &attributes)?);
        zarrs::group::GroupBuilder::new().attributes(attributes).build(store, "/")?.store_metadata()?;
        Ok(())
    }

    fn read_scratch(&self, rows: std::ops::Range<usize>, written: impl Fn(usize) -> bool) -> std::io::Result<RowBlock> {
        let n = self.header.row_len();
        let mut block = RowBlock::zeros(rows.clone(), n);
        let mut bytes = vec![0u8; n * 9];
        for (k, row) in rows.enumerate().filter(|&(_, row)| written(row)) {
            positioned::read_exact_at(&self.scratch, &mut bytes, (row * n * 9) as u64)?;
            let (values, valid) = bytes.split_at(n * 8);
            let floats = values.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
            for (i, value) in floats.enumerate() {
                let target = if i < n { &mut block.response } else { &mut block.variance };
                target[k * n + i % n] = value;
            }
            block.valid[k * n..(k + 1) * n].copy_from_slice(valid);
        }
        Ok(block)
    }

    fn write_coordinates(&self, store: &Arc<FilesystemStore>) -> Result<(), BoxedError> {
        let header = &self.header;
        let grid = [header.points[1] as u64, header.points[0] as u64];
        let names = ["y_i", "x_i"];
        let lit = |a: usize| header.lit_mm.iter().map(|p| p[a]).collect::<Vec<f64>>();
        small_array(store, "x_i_mm", &grid, &names, data_type::float64(), f64::NAN, lit(0))?;
        small_array(store, "y_i_mm", &grid, &names, data_type::float64(), f64::NAN, lit(1))?;
        small_array(
            store,
            "position_sd_mm",
            &grid,
            &names,
            data_type::float64(),
            f64::NAN,
            header.position_sd_mm.clone(),
        )?;
        // Zarr has no missing integers; −1 is the documented mark of an unlit point on disk only.
        let shot = header.shot_of.iter().map(|s| s.map_or(-1, |s| s as i32)).collect::<Vec<i32>>();
        small_array(store, "shot", &grid, &names, data_type::int32(), i32::MIN, shot)?;
        for (a, name) in ["dx", "dy"].into_iter().enumerate() {
            let offsets = (0..header.window[a]).map(|k| header.offset_px([k, k])[a] as f64 * header.pitch_mm);
            let shape = [header.window[a] as u64];
            small_array(store, name, &shape, &[name], data_type::float64(), f64::NAN, offsets.collect())?;
        }
        Ok(())
    }
}

/// Ranges of rows that lie in one chunk each.
fn chunks(header: &MatrixHeader) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
    let (nx, step) = (header.points[0], chunk_rows(header));
    (0..header.points[1]).flat_map(move |y| (0..nx).step_by(step).map(move |x| y * nx + x..y * nx + (x + step).min(nx)))
}

fn chunk_rows(header: &MatrixHeader) -> usize {
    let most = (CHUNK_BYTES / (4 * header.row_len())).clamp(1, header.points[0]);
    // Equal chunks along a line: the last one is padded to the size of the others.
    header.points[0].div_ceil(header.points[0].div_ceil(most))
}

/// The part of a row array that holds `rows`, all of one y_i.
fn subset(header: &MatrixHeader, rows: std::ops::Range<usize>) -> ArraySubset {
    let (nx, [wx, wy]) = (header.points[0], header.window);
    let (y, x) = ((rows.start / nx) as u64, (rows.start % nx) as u64);
    let n = rows.len() as u64;
    ArraySubset::new_with_ranges(&[y..y + 1, x..x + n, 0..wy as u64, 0..wx as u64, 0..CHANNELS as u64])
}

/// The attributes of an array: its unit, and what else there is to say.
fn units(name: &str, more: &[(&str, &str)]) -> serde_json::Map<String, serde_json::Value> {
    let unit = match name {
        "response" => "mm^-2",
        "variance" => "mm^-4",
        "valid" | "shot" => "1",
        _ => "mm",
    };
    let all = [("units", unit)].into_iter().chain(more.iter().copied());
    all.map(|(key, value)| (key.to_owned(), value.into())).collect()
}

fn rows_array<F>(
    header: &MatrixHeader,
    store: &Arc<FilesystemStore>,
    name: &str,
    data_type: zarrs::array::DataType,
    fill: F,
) -> Result<Array<FilesystemStore>, zarrs::array::ArrayCreateError>
where
    F: Into<zarrs::array::FillValue>,
{
    let ([nx, ny], [wx, wy]) = (header.points, header.window);
    let shape = [ny, nx, wy, wx, CHANNELS].map(|n| n as u64);
    let chunk = [1, chunk_rows(header), wy, wx, CHANNELS].map(|n| n as u64);
    ArrayBuilder::new(shape.to_vec(), chunk.to_vec(), data_type, fill.into())
        .dimension_names(["y_i", "x_i", "dy", "dx", "channel"].into())
        // The CF convention by which xarray takes the lit points' places for coordinates.
        .attributes(units(name, &[("coordinates", "x_i_mm y_i_mm")]))
        .bytes_to_bytes_codecs(vec![Arc::new(ZstdCodec::new(ZSTD_LEVEL, false)), Arc::new(Crc32cCodec::new())])
        // One file a chunk in one folder: five nested folders for each would cost more than the data.
        .chunk_key_encoding_default_separator(ChunkKeySeparator::Dot)
        .build(store.clone(), &format!("/{name}"))
}

fn small_array<T: zarrs::array::Element>(
    store: &Arc<FilesystemStore>,
    name: &str,
    shape: &[u64],
    dimensions: &[&str],
    data_type: zarrs::array::DataType,
    fill: impl Into<zarrs::array::FillValue>,
    values: Vec<T>,
) -> Result<(), BoxedError>
where
    Vec<T>: zarrs::array::IntoArrayBytes<'static>,
{
    // The fill value is one that no data has: a chunk that equals it would not be written, and seem lost.
    let array = ArrayBuilder::new(shape.to_vec(), shape.to_vec(), data_type, fill.into())
        .dimension_names(Some(dimensions.iter().copied()))
        .attributes(units(name, &[]))
        .bytes_to_bytes_codecs(vec![Arc::new(Crc32cCodec::new())])
        .build(store.clone(), &format!("/{name}"))?;
    array.store_metadata()?;
    array.store_array_subset(&array.subset_all(), values)?;
    Ok(())
}

/// Reads a matrix in blocks of rows.
#[derive(Debug)]
pub struct MatrixReader {
    path: PathBuf,
    header: MatrixHeader,
    response: Array<FilesystemStore>,
    variance: Array<FilesystemStore>,
    valid: Array<FilesystemStore>,
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

    /// Opens a store and reads everything but the rows.
    ///
    /// # Errors
    /// [`Error::Io`] when there is nothing at `path`, [`Error::BrokenMatrix`] when it is not a whole matrix.
    pub fn open(path: &Path) -> Result<Self> {
        let root = path.join("zarr.json");
        std::fs::metadata(path).map_err(Error::io("read", path))?;
        if path.to_str().is_none() {
            let reason = "the path of a matrix must be UTF-8";
            return Err(Error::io("read", path)(std::io::Error::new(std::io::ErrorKind::InvalidInput, reason)));
        }
        let broken = |reason: String| Error::BrokenMatrix { path: path.to_path_buf(), reason };
        if !root.is_file() {
            return Err(broken("zarr.json is missing".into()));
        }
        let store = Arc::new(FilesystemStore::new(path).map_err(|e| broken(e.to_string()))?);
        let group = zarrs::group::Group::open(store.clone(), "/").map_err(|e| broken(e.to_string()))?;
        let attributes = serde_json::Value::Object(group.attributes().clone());
        let checksums = Checksums::open(path, group.attributes()).map_err(&broken)?;
        let format = attributes.get("acquire_format").and_then(serde_json::Value::as_u64);
        if format != Some(FORMAT.into()) {
            return Err(broken(format!("acquire_format: expected {FORMAT}, found {format:?}")));
        }
        let mut header: MatrixHeader =
            serde_json::from_value(attributes).map_err(|e| broken(format!("attributes: {e}")))?;
        header.check().map_err(&broken)?;
        let open = |name: &str| {
            chunks_fit_memory(&path.join(name).join("zarr.json"))
                .map_err(|reason| broken(format!("array {name}: {reason}")))?;
            Array::open(store.clone(), &format!("/{name}")).map_err(|e| broken(format!("array {name}: {e}")))
        };
        let ([nx, ny], [wx, wy]) = (header.points, header.window);
        let shape = [ny, nx, wy, wx, CHANNELS].map(|n| n as u64);
        let rows = |name: &str| {
            let array = open(name)?;
            if array.shape() == shape {
                Ok(array)
            } else {
                Err(broken(format!("array {name}: expected shape {shape:?}, found {:?}", array.shape())))
            }
        };
        let (response, variance, valid) = (rows("response")?, rows("variance")?, rows("valid")?);
        if valid.fill_value().as_ne_bytes() != [u8::MAX] {
            return Err(broken(format!(
                "array valid: expected the fill value {}, which marks missing chunks",
                u8::MAX
            )));
        }
        if let Some(checksums) = &checksums {
            [&response, &variance, &valid]
                .iter()
                .try_for_each(|array| checksums.check_names(array))
                .map_err(&broken)?;
            for name in checksum::ARRAYS.into_iter().filter(|name| !checksum::ROWS.contains(name)) {
                let array = open(name)?;
                checksums.check_chunks(&array, &array.subset_all()).map_err(&broken)?;
            }
        }
        let points = &shape[..2];
        let x: Vec<f64> = small(path, &open("x_i_mm")?, points).map_err(&broken)?;
        let y: Vec<f64> = small(path, &open("y_i_mm")?, points).map_err(&broken)?;
        header.lit_mm = x.into_iter().zip(y).map(|(x, y)| [x, y]).collect();
        header.position_sd_mm = small(path, &open("position_sd_mm")?, points).map_err(&broken)?;
        let shot: Vec<i32> = small(path, &open("shot")?, points).map_err(&broken)?;
        header.shot_of = shot.into_iter().map(|s| usize::try_from(s).ok()).collect();
        let shots = header.shots.len();
        if let Some(s) = header.shot_of.iter().flatten().find(|&&s| s >= shots) {
            return Err(broken(format!("array shot: expected numbers below {shots}, found {s}")));
        }
        header.check_places().map_err(&broken)?;
        Ok(Self { path: path.to_path_buf(), header, response, variance, valid, checksums })
    }

    /// What the matrix is.
    pub fn header(&self) -> &MatrixHeader {
        &self.header
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Ranges of rows that lie in one chunk each; together all rows, in order.
    pub(super) fn chunks(&self) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        chunks(&self.header)
    }

    /// Reads consecutive rows; callable from several threads.
    ///
    /// # Errors
    /// [`Error::BrokenMatrix`] when a chunk is missing or damaged, [`Error::NotFinite`] for NaN or infinity,
    /// [`Error::Internal`] for rows that the matrix has not.
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
        if rows.end > self.header.rows() || rows.start > rows.end {
            return Err(Error::internal(format_args!("rows {rows:?} of a matrix of {}", self.header.rows())));
        }
        let nx = self.header.points[0];
        let n = rows.len() * self.header.row_len();
        let mut block = RowBlock {
            first: rows.start,
            rows: rows.len(),
            response: vec![0.0; n],
            variance: vec![0.0; if variance { n } else { 0 }],
            valid: vec![0; n],
        };
        // Chunks are decoded side by side, each into its place.
        let mut parts = Vec::new();
        let (mut response, mut variances, mut valid) =
            (block.response.as_mut_slice(), block.variance.as_mut_slice(), block.valid.as_mut_slice());
        let mut at = rows.start;
        while at < rows.end {
            let end = rows.end.min((at / nx + 1) * nx);
            let end = end.min(at - at % nx + (at % nx / chunk_rows(&self.header) + 1) * chunk_rows(&self.header));
            let n = (end - at) * self.header.row_len();
            let (response_here, rest) = std::mem::take(&mut response).split_at_mut(n);
            response = rest;
            let (valid_here, rest) = std::mem::take(&mut valid).split_at_mut(n);
            valid = rest;
            let (variance_here, rest) = std::mem::take(&mut variances).split_at_mut(if variance { n } else { 0 });
            variances = rest;
            parts.push((subset(&self.header, at..end), response_here, variance_here, valid_here));
            at = end;
        }
        parts.into_par_iter().try_for_each(|(part, response, variances, valid)| -> Result<()> {
            let read = |array: &Array<FilesystemStore>, out: &mut [f32]| -> Result<()> {
                if !out.is_empty() {
                    out.copy_from_slice(&self.part::<f32>(array, &part)?);
                }
                Ok(())
            };
            let (a, b) = rayon::join(|| read(&self.response, response), || read(&self.variance, variances));
            a.and(b)?;
            valid.copy_from_slice(&self.part::<u8>(&self.valid, &part)?);
            Ok(())
        })?;
        self.check(&block)?;
        Ok(block)
    }

    fn part<T: ElementOwned>(&self, array: &Array<FilesystemStore>, part: &ArraySubset) -> Result<Vec<T>>
    where
        Vec<T>: zarrs::array::FromArrayBytes,
    {
        let broken = |reason: String| Error::BrokenMatrix { path: self.path.clone(), reason };
        if let Some(checksums) = &self.checksums {
            checksums.check_chunks(array, part).map_err(broken)?;
        }
        array.retrieve_array_subset::<Vec<T>>(part).map_err(|e| broken(format!("array {}: {e}", array.path())))
    }

    fn check(&self, block: &RowBlock) -> Result<()> {
        if block.valid.par_chunks(CHECKED).any(|part| part.iter().fold(false, |bad, &v| bad | (v > 1))) {
            let reason =
                format!("array valid: a chunk of rows {} to {} is missing", block.first, block.first + block.rows);
            return Err(Error::BrokenMatrix { path: self.path.clone(), reason });
        }
        for (field, values) in [("response", &block.response), ("variance", &block.variance)] {
            // Without a way out of the loop it is a matter of vector instructions; where is looked for only when there is something.
            if values.par_chunks(CHECKED).all(|part| part.iter().fold(true, |good, v| good & v.is_finite())) {
                continue;
            }
            if let Some(at) = values.iter().position(|v| !v.is_finite()) {
                let (n, wx) = (self.header.row_len(), self.header.window[0]);
                let (row, sample) = (block.first + at / n, at % n / CHANNELS);
                let lit = [row % self.header.points[0], row / self.header.points[0]];
                let at_text =
                    format!("lit point {lit:?}, sample [{}, {}], channel {}", sample % wx, sample / wx, at % CHANNELS);
                return Err(Error::NotFinite { path: self.path.clone(), field, found: values[at].into(), at: at_text });
            }
        }
        Ok(())
    }
}

/// What the system said: of its errors the Zarr crate keeps the words, and in them the number.
fn kind_of(reason: &str) -> std::io::ErrorKind {
    let number = reason.rsplit_once("(os error ").and_then(|(_, end)| end.split(')').next()?.parse().ok());
    number.map_or(std::io::ErrorKind::Other, |number| std::io::Error::from_raw_os_error(number).kind())
}

/// No chunk has more numbers, of our own or of others.
const MOST_IN_CHUNK: u64 = 1 << 29;

/// Refuses chunks, and chunks of shards, of no numbers or of more than memory has: they are set aside before any is read.
fn chunks_fit_memory(metadata: &Path) -> std::result::Result<(), String> {
    let text = crate::files::read(metadata).map_err(|e| format!("zarr.json: {e}"))?;
    let array: serde_json::Value = serde_json::from_slice(&text).map_err(|e| format!("zarr.json: {e}"))?;
    let shards = array["codecs"].as_array().into_iter().flatten().map(|codec| &codec["configuration"]["chunk_shape"]);
    for shape in shards.chain([&array["chunk_grid"]["configuration"]["chunk_shape"]]) {
        let Some(shape) = shape.as_array() else { continue };
        let numbers = shape.iter().try_fold(1u64, |n, side| n.checked_mul(side.as_u64()?));
        if !numbers.is_some_and(|n| (1..=MOST_IN_CHUNK).contains(&n)) {
            let shape = serde_json::Value::from(shape.clone());
            return Err(format!("expected chunks of 1 to {MOST_IN_CHUNK} numbers, found {shape}"));
        }
    }
    Ok(())
}

fn small<T: ElementOwned>(root: &Path, array: &Array<FilesystemStore>, shape: &[u64]) -> Result<Vec<T>, String>
where
    Vec<T>: zarrs::array::FromArrayBytes,
{
    let name = array.path().to_string();
    if array.shape() != shape {
        return Err(format!("array {name}: expected shape {shape:?}, found {:?}", array.shape()));
    }
    // One chunk, not compressed: its size tells whether the shape may be believed before memory is set aside for it.
    let file = root.join(array.chunk_key(&vec![0; shape.len()]).as_str());
    let (found, expected) =
        (std::fs::metadata(file).map_or(0, |kind| kind.len()), shape.iter().product::<u64>() * size_of::<T>() as u64);
    if found < expected {
        return Err(format!("array {name}: expected a chunk of {expected} bytes, found {found}"));
    }
    array.retrieve_array_subset(&array.subset_all()).map_err(|e| format!("array {name}: {e}"))
}

impl RowBlock {
    fn zeros(rows: std::ops::Range<usize>, row_len: usize) -> Self {
        let n = rows.len() * row_len;
        Self { first: rows.start, rows: rows.len(), response: vec![0.0; n], variance: vec![0.0; n], valid: vec![0; n] }
    }
}

#[cfg(test)]
pub(super) mod tests;
