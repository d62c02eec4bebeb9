//! Writing a matrix: rows wait until all are there, then the store is written and takes its place.

use super::chunk_writer::{Chunking, RowsArray};
use super::part::RowsAt;
use super::scratch_rows::ScratchRows;
use super::store::{COMMON, FORMAT, MatrixHeader, Row, RowBlock};
use super::{CHANNELS, checksum, earlier};
use crate::files::{Objects, is_url};
use crate::output::{Earlier, ScratchFolder, WorkLog, put};
use crate::{Error, FindingRecord, Result, Warning};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::codec::{Crc32cCodec, ZstdCodec};
use zarrs::array::{ArrayBuilder, BytesToBytesCodecTraits, data_type};
use zarrs::filesystem::FilesystemStore;

/// Whatever the Zarr crate answers; turned into ours at the public functions.
pub(super) type BoxedError = Box<dyn std::error::Error + Send + Sync>;
/// Gives consecutive rows.
type BlockSource<'a> = dyn Fn(std::ops::Range<usize>) -> Result<RowBlock> + Sync + 'a;
/// Negative levels leave the bytes that do not repeat as they are: decoding is twice as fast as at level 1, for a tenth
/// more bytes of measured noise, which no level compresses by much.
pub(super) const ZSTD_LEVEL: i32 = -1;

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
    /// Instead of [`Chunking::of`] the header.
    chunking: Option<Chunking>,
    /// Where the store goes, unless to a folder.
    objects: Option<Objects>,
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
        let objects = if is_url(path) { Some(Objects::open(path)?) } else { None };
        // Where a link leads: it stays.
        let path = &if replaces && objects.is_none() {
            path.canonicalize().map_err(Error::io("create", path))?
        } else {
            path.to_path_buf()
        };
        let parent = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        // A store is made whole on this machine before any of it goes elsewhere.
        let temporary = std::env::temp_dir();
        let folder = scratch(if objects.is_some() { &temporary } else { parent }, path)?;
        let rows = ScratchRows::new(&folder, header.rows(), header.row_len()).map_err(Error::io("create", path))?;
        Ok(Self { path: path.clone(), header, folder, replaces, rows, stays: false, chunking: None, objects })
    }

    /// With chunks and shards as they are asked for: those of large matrices, in small ones.
    #[cfg(test)]
    pub(super) fn chunked(self, chunking: Chunking) -> Self {
        Self { chunking: Some(chunking), ..self }
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
    /// [`Error::Io`]; [`Error::Internal`] when no row was put at `index`.
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
    /// [`Error::Io`]; [`Error::Internal`] when the header holds what [`super::MatrixReader::open`] would refuse.
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
        let put = match &self.objects {
            Some(objects) => objects.replace(&store_path, self.replaces),
            None => put(&self.folder, &self.path, self.replaces),
        };
        put.map_err(Error::io("write", &self.path))
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
        // Themselves they are arrays: there may be hundreds of thousands.
        attributes.insert("shots".into(), header.shots.len().into());
        if let Some(common) = &header.common {
            attributes.insert(COMMON.into(), serde_json::to_value(common.of_all)?);
        }
        // What `warnings` say, as other programs may want it; not read again.
        let findings: Vec<FindingRecord> = header.warnings.iter().map(Warning::record).collect();
        attributes.insert("findings".into(), serde_json::to_value(findings)?);
        self.write_coordinates(&store)?;

        self.write_rows(store_path, block)?;
        // Last, as it has the checksum of all metadata.
        attributes.insert(checksum::GROUP.into(), checksum::seal(store_path, &attributes)?);
        zarrs::group::GroupBuilder::new().attributes(attributes).build(store, "/")?.store_metadata()?;
        Ok(())
    }

    fn write_rows(&self, root: &Path, block: &BlockSource<'_>) -> Result<(), BoxedError> {
        let header = &self.header;
        let chunking = self.chunking.unwrap_or(Chunking::of(header));
        let response = RowsArray::create(header, chunking, root, "response", data_type::float32(), f32::NAN)?;
        let variance = RowsArray::create(header, chunking, root, "variance", data_type::float32(), f32::NAN)?;
        let valid = RowsArray::create(header, chunking, root, "valid", data_type::uint8(), u8::MAX)?;
        chunking.files(header).into_par_iter().try_for_each(|chunks| {
            let first = chunks[0].start;
            let (mut responses, mut variances) = (response.file(first)?, variance.file(first)?);
            let mut flags = valid.file(first)?;
            for rows in chunks {
                let mut block = block(rows.clone())?;
                let n = rows.len() * header.row_len();
                if [block.response.len(), block.variance.len(), block.valid.len()] != [n; 3] {
                    return Err(Error::internal(format_args!("rows {rows:?} do not fit the matrix")).into());
                }
                let not = block.valid.iter().enumerate().filter(|(_, v)| **v == 0).map(|(k, _)| k);
                not.for_each(|k| (block.response[k], block.variance[k]) = (f32::NAN, f32::NAN));
                responses.put(rows.start, block.response)?;
                variances.put(rows.start, block.variance)?;
                flags.put(rows.start, block.valid)?;
            }
            responses.finish()?;
            variances.finish()?;
            flags.finish()
        })
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
        self.write_shots(store)
    }

    fn write_shots(&self, store: &Arc<FilesystemStore>) -> Result<(), BoxedError> {
        let shots = &self.header.shots;
        if shots.is_empty() {
            return Ok(());
        }
        let (n, names) = (shots.len() as u64, ["lattice_shot", "axis"]);
        let drift: Vec<f64> = shots.iter().flat_map(|s| s.drift_px).collect();
        small_array(store, "shot_drift_px", &[n, 2], &names, data_type::float64(), f64::NAN, drift)?;
        // NaN is data here: no number is missing otherwise. No deviation is negative.
        let sd: Vec<f64> = shots.iter().map(|s| s.drift_sd_px.unwrap_or(f64::NAN)).collect();
        small_array(store, "shot_drift_sd_px", &[n], &names[..1], data_type::float64(), -1.0, sd)?;
        let text: Vec<String> = shots.iter().map(|s| s.name.clone()).collect();
        small_array(store, "shot_name", &[n], &names[..1], data_type::string(), Vec::<u8>::new(), text)
    }
}

/// The attributes of an array: its unit, and what else there is to say.
pub(super) fn units(name: &str, more: &[(&str, &str)]) -> serde_json::Map<String, serde_json::Value> {
    let unit = match name {
        "response" => "mm^-2",
        "variance" => "mm^-4",
        "valid" | "shot" | "row_scale_sd" => "1",
        "common_sd" => "mm^-2",
        "shot_drift_px" | "shot_drift_sd_px" => "px",
        "shot_name" => "",
        _ => "mm",
    };
    let all = [("units", unit)].into_iter().filter(|(_, unit)| !unit.is_empty()).chain(more.iter().copied());
    all.map(|(key, value)| (key.to_owned(), value.into())).collect()
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
    let codecs = match checksum::is_compressed(name) {
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

/// What the system said: of its errors the Zarr crate keeps the words, and in them the number.
fn kind_of(reason: &str) -> std::io::ErrorKind {
    let number = reason.rsplit_once("(os error ").and_then(|(_, end)| end.split(')').next()?.parse().ok());
    number.map_or(std::io::ErrorKind::Other, |number| std::io::Error::from_raw_os_error(number).kind())
}
