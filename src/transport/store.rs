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
//! | `shot` i32 | y_i, x_i | number of the shot that lit it, an index into the attribute `shots` |
//! | `row_scale_sd` f64 | y_i, x_i, channel | relative standard deviation of what a row's samples have in common; may be missing |
//! | `common_sd` f64 | dy, dx, channel | standard deviation that all rows have in common, mm⁻²; may be missing |
//!
//! Stores of other programs are read too, with defaults for what they leave out: `docs/matrix-format.md`. Everything
//! else is in the group's attributes, see [`MatrixHeader`]; `findings` are the records ([`FindingRecord`]) of
//! `warnings`, one for one.

use super::checksum::{self, Checksums};
use super::open::{self, Opened};
use super::part::RowsAt;
use super::row_array::{RowArray, RowLayout};
use super::scratch_rows::ScratchRows;
use super::{CHANNELS, CommonErrors, earlier};
use crate::output::{Earlier, ScratchFolder, WorkLog, put};
use crate::{Error, FindingRecord, Result, Warning, geometry::Point};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::codec::{Crc32cCodec, ZstdCodec};
use zarrs::array::{Array, ArrayBuilder, ArraySubset, BytesToBytesCodecTraits, ChunkKeySeparator, data_type};
use zarrs::filesystem::FilesystemStore;

/// The version of this layout, attribute `acquire_format`.
const FORMAT: u64 = 3;
/// The versions that are read. In 1 the response was 0 where it was not measured, and `points` and `window` were
/// attributes too; 2 had no common errors.
pub(super) const FORMATS: [u64; 3] = [1, 2, FORMAT];
/// Attribute of the group: [`super::CommonOfAll`].
pub(super) const COMMON: &str = "common_errors";
/// The most lit points along an axis.
pub(super) const MOST_POINTS: usize = 1 << 16;
/// The most samples of a window along an axis.
pub(super) const MOST_SAMPLES: usize = 4095;
/// No slab is larger, and no length is smaller than one over it, mm.
pub(super) const LARGEST_MM: f64 = 1e9;
/// Whatever the Zarr crate answers; turned into ours at the public functions.
type BoxedError = Box<dyn std::error::Error + Send + Sync>;
/// Gives consecutive rows.
type BlockSource<'a> = dyn Fn(std::ops::Range<usize>) -> Result<RowBlock> + Sync + 'a;
/// A chunk holds about this many bytes of responses: large enough for the disk, small enough to stream.
const CHUNK_BYTES: usize = 4 << 20;
/// Numbers that one thread looks through at a time.
const CHECKED: usize = 1 << 16;
/// Lines of chunks that are read at once, in numbers: chunks of several lines of points are decoded once for all of
/// them up to here.
const BAND_NUMBERS: usize = 1 << 26;
/// Negative levels leave the bytes that do not repeat as they are: decoding is twice as fast as at level 1, for a tenth
/// more bytes of measured noise, which no level compresses by much.
const ZSTD_LEVEL: i32 = -1;

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

/// Writes a matrix. Rows come in any order from any thread; nothing appears under the final name before
/// [`Self::finish`].
///
/// Rows wait uncompressed in a scratch file until all of a chunk are there.
#[derive(Debug)]
pub struct MatrixWriter {
    path: PathBuf,
    header: MatrixHeader,
    folder: ScratchFolder,
    replaces: bool,
    rows: ScratchRows,
    /// Whether rows outlive the writing of the store.
    stays: bool,
}

impl MatrixWriter {
    /// Prepares to write the store `path`; an older store there is replaced by [`Self::finish`].
    ///
    /// # Errors
    /// [`Error::Io`] when the folder of `path` cannot be written; [`Error::NotOurs`], [`Error::Changed`] when something
    /// other than a matrix of this program is at `path`.
    pub fn create(path: &Path, header: MatrixHeader) -> Result<Self> {
        Self::new(path, header, ScratchFolder::new)
    }

    /// [`Self::create`], with what a stopped run for the same `path` had finished.
    pub(crate) fn go_on(path: &Path, header: MatrixHeader) -> Result<Self> {
        Self::new(path, header, ScratchFolder::go_on)
    }

    /// [`Self::go_on`] for a `path` in an output that is not finished: rows wait in its scratch folder `outer` and stay
    /// there when the store is written, so that a run that is stopped afterwards need not measure them again.
    pub(crate) fn go_on_in(outer: &Path, path: &Path, header: MatrixHeader) -> Result<Self> {
        let writer = Self::new(path, header, |_, path| ScratchFolder::go_on(outer, path))?;
        writer.keep_work();
        Ok(Self { stays: true, ..writer })
    }

    fn new(
        path: &Path,
        header: MatrixHeader,
        scratch: impl FnOnce(&Path, &Path) -> Result<ScratchFolder>,
    ) -> Result<Self> {
        if path.to_str().is_none() {
            // The Zarr crate could not read it back.
            let reason = "the path of a matrix must be UTF-8";
            return Err(Error::io("create", path)(std::io::Error::new(std::io::ErrorKind::InvalidInput, reason)));
        }
        let replaces = earlier::check(path, true)?;
        // Where a link leads: it stays.
        let path = &if replaces { path.canonicalize().map_err(Error::io("create", path))? } else { path.to_path_buf() };
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let folder = scratch(parent, path)?;
        let rows = ScratchRows::new(&folder, header.rows(), header.row_len()).map_err(Error::io("create", path))?;
        Ok(Self { path: path.clone(), header, folder, replaces, rows, stays: false })
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
    /// [`Error::Io`]; [`Error::Internal`] when the row has another length than the header says, or a value is not
    /// finite.
    pub fn put(&self, index: usize, row: &Row) -> Result<()> {
        self.rows.put(index, row, false, &self.path)
    }

    /// Stores row `index` in the place of the one that was put, which a later run can still take over.
    ///
    /// # Errors
    /// Those of [`Self::put`].
    pub(crate) fn replace(&self, index: usize, row: &Row) -> Result<()> {
        self.rows.put(index, row, true, &self.path)
    }

    /// The row that was put last at `index`.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when there is none.
    pub fn row(&self, index: usize) -> Result<Row> {
        self.rows.row(index, &self.path)
    }

    /// Takes the rows of a stopped run for its own if together they have this BLAKE3; says whether they have.
    pub(crate) fn adopt(&self, indices: &[usize], hash: &blake3::Hash) -> bool {
        self.rows.adopt(indices, hash)
    }

    /// The same of rows that a task has measured; they stay in its part, which must stay until the store is written.
    pub(crate) fn adopt_part(&self, indices: &[usize], hash: &blake3::Hash, in_part: &RowsAt) -> bool {
        self.rows.adopt_part(indices, hash, in_part)
    }

    /// What the stopped run had finished that this one goes on from ([`Self::go_on`]), if it worked on the same `key`;
    /// what is added from now on is there for a next run.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn earlier<T: serde::de::DeserializeOwned>(&self, key: &str) -> Result<(WorkLog, Earlier<T>)> {
        WorkLog::open(&self.folder, key)
    }

    /// From now on what was finished stays for a next run, whatever becomes of this one.
    pub(crate) fn keep_work(&self) {
        self.folder.keep();
    }

    /// Writes the store and renames it into place. Rows never put are invalid throughout.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] when the header holds what [`MatrixReader::open`] would refuse.
    pub fn finish(self) -> Result<()> {
        self.finish_from(&|rows| self.rows.block(rows).map_err(Error::io("read", &self.path)))
    }

    /// [`Self::finish`] with rows that were not put: `block` is called once for each of some ranges that together are
    /// all rows, from several threads. No scratch file is needed then, which takes nine bytes a number.
    ///
    /// # Errors
    /// Those of [`Self::finish`] and of `block`.
    pub fn finish_with(self, block: impl Fn(std::ops::Range<usize>) -> Result<RowBlock> + Sync) -> Result<()> {
        self.finish_from(&block)
    }

    fn finish_from(&self, block: &BlockSource<'_>) -> Result<()> {
        self.header.check().and_then(|()| self.header.check_places()).map_err(Error::internal)?;
        let done = self.write(block);
        // A full disk, say: the rows need not be measured again.
        match &done {
            Ok(()) if !self.stays => self.folder.let_go(),
            Err(error) if error.is_of_system() => {
                self.keep_work();
                let _ = std::fs::remove_dir_all(self.folder.new_path());
            }
            _ => {}
        }
        done
    }

    fn write(&self, block: &BlockSource<'_>) -> Result<()> {
        let store_path = self.folder.new_path();
        // Half of one that a stopped run has left.
        match std::fs::remove_dir_all(&store_path) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(Error::io("write", &self.path)(e)),
            _ => {}
        }
        self.write_store(&store_path, block).map_err(|e| match e.downcast::<Error>() {
            Ok(error) => *error,
            Err(e) => {
                let reason = e.to_string();
                Error::io("write", &self.path)(std::io::Error::new(kind_of(&reason), reason))
            }
        })?;
        earlier::check(&self.path, self.replaces)?;
        put(&self.folder, &self.path, self.replaces).map_err(Error::io("write", &self.path))
    }

    fn write_store(&self, store_path: &Path, block: &BlockSource<'_>) -> Result<(), BoxedError> {
        let header = &self.header;
        let store = Arc::new(FilesystemStore::new(store_path)?);
        let mut attributes = serde_json::Map::new();
        attributes.insert("acquire_format".into(), FORMAT.into());
        attributes.insert("channels".into(), serde_json::json!(["R", "G", "B"]));
        if let serde_json::Value::Object(fields) = serde_json::to_value(header)? {
            attributes.extend(fields);
        }
        if let Some(common) = &header.common {
            attributes.insert(COMMON.into(), serde_json::to_value(common.of_all)?);
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
            let mut block = block(rows.clone())?;
            let n = rows.len() * header.row_len();
            if [block.response.len(), block.variance.len(), block.valid.len()] != [n; 3] {
                return Err(Error::internal(format_args!("rows {rows:?} do not fit the matrix")).into());
            }
            let not = block.valid.iter().enumerate().filter(|(_, v)| **v == 0).map(|(k, _)| k);
            not.for_each(|k| (block.response[k], block.variance[k]) = (f32::NAN, f32::NAN));
            let subset = subset(header, rows);
            response.store_array_subset(&subset, block.response)?;
            variance.store_array_subset(&subset, block.variance)?;
            valid.store_array_subset(&subset, block.valid)?;
            Ok::<_, BoxedError>(())
        })?;
        // Last, as it has the checksum of all metadata.
        attributes.insert(checksum::GROUP.into(), checksum::seal(store_path, &attributes)?);
        zarrs::group::GroupBuilder::new().attributes(attributes).build(store, "/")?.store_metadata()?;
        Ok(())
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
        if let Some(common) = &header.common {
            let [samples_x, samples_y] = header.window.map(|n| n as u64);
            let channels = CHANNELS as u64;
            let (shape, names) = ([grid[0], grid[1], channels], ["y_i", "x_i", "channel"]);
            let values = common.row_scale_sd.as_flattened().to_vec();
            small_array(store, "row_scale_sd", &shape, &names, data_type::float64(), f64::NAN, values)?;
            let (shape, names) = ([samples_y, samples_x, channels], ["dy", "dx", "channel"]);
            let values = common.sample_sd.clone();
            small_array(store, "common_sd", &shape, &names, data_type::float64(), f64::NAN, values)?;
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
    let nx = header.points[0];
    // Equal chunks along a line, of at least half as many rows as may be; else the last one is padded to the size of
    // the others.
    let equal = (most.div_ceil(2)..=most).rev().find(|&n| nx.is_multiple_of(n));
    equal.unwrap_or(nx.div_ceil(nx.div_ceil(most)))
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
        "valid" | "shot" | "row_scale_sd" => "1",
        "common_sd" => "mm^-2",
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
    let checked: Arc<dyn BytesToBytesCodecTraits> = Arc::new(Crc32cCodec::new());
    let codecs = match checksum::OF_COMMON.contains(&name) {
        // Often zero, or nearly constant.
        true => vec![Arc::new(ZstdCodec::new(ZSTD_LEVEL, false)), checked],
        false => vec![checked],
    };
    // The fill value is one that no data has: a chunk that equals it would not be written, and seem lost.
    let array = ArrayBuilder::new(shape.to_vec(), shape.to_vec(), data_type, fill.into())
        .dimension_names(Some(dimensions.iter().copied()))
        .attributes(units(name, &[]))
        .bytes_to_bytes_codecs(codecs)
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
    fn parts(&self, rows: std::ops::Range<usize>) -> Vec<std::ops::Range<usize>> {
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
            false => Error::BrokenMatrix { path: self.path.clone(), reason: format!("array {name}: {reason}") },
        };
        if let Some(checksums) = &self.checksums {
            let mut read = ["response", "valid"].into_iter().chain((!variance.is_empty()).then_some("variance"));
            let checked: Result<(), String> = read.try_for_each(|name| checksums.check_rows(name, &rows));
            checked.map_err(|reason| Error::BrokenMatrix { path: self.path.clone(), reason })?;
        }
        if self.layout.stored != self.layout.window {
            // Nothing is read there.
            response.fill(f32::NAN);
            variance.fill(0.0);
            valid.fill(0);
        }
        let (a, b) = rayon::join(
            || self.response.read(rows.clone(), &self.layout, response).map_err(|e| unread("response", e)),
            || match &self.variance {
                Some(array) if !variance.is_empty() => {
                    array.read(rows.clone(), &self.layout, variance).map_err(|e| unread("variance", e))
                }
                _ => {
                    variance.fill(0.0);
                    Ok(())
                }
            },
        );
        a.and(b)?;
        match &self.valid {
            Some(array) => array.read_flags(rows.clone(), &self.layout, valid).map_err(|e| unread("valid", e))?,
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

/// What the system said: of its errors the Zarr crate keeps the words, and in them the number.
fn kind_of(reason: &str) -> std::io::ErrorKind {
    let number = reason.rsplit_once("(os error ").and_then(|(_, end)| end.split(')').next()?.parse().ok());
    number.map_or(std::io::ErrorKind::Other, |number| std::io::Error::from_raw_os_error(number).kind())
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

impl RowBlock {
    pub(super) fn zeros(rows: std::ops::Range<usize>, row_len: usize) -> Self {
        let n = rows.len() * row_len;
        Self { first: rows.start, rows: rows.len(), response: vec![0.0; n], variance: vec![0.0; n], valid: vec![0; n] }
    }
}

#[cfg(test)]
pub(super) mod tests;
