//! What tells that a store is as it was written.
//!
//! Every chunk ends with its own CRC-32C (the Zarr codec `crc32c`), which decoding verifies. Each array lists those of
//! its chunks in the attribute [`CHUNKS`], in the order of the grid, so that exchanged, missing and additional chunks
//! are seen; and the group's attribute [`GROUP`] has the BLAKE3 of the arrays' metadata, these lists in it, and of the
//! attributes that it names, so that no word of them changes either.
//!
//! Not told: stores of versions without these attributes, and those that another program has written anew, whose chunks
//! have other names or codecs.

use super::chunk_grid::{CHECKSUM, ChunkGrid, SHARDING, is_sharded};
use super::store::COMMON;
use super::store_files::StoreFiles;
use base64::{Engine, prelude::BASE64_STANDARD};
use rayon::prelude::*;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

/// Attribute of an array: the last four bytes of its chunks, in base64.
const CHUNKS: &str = "chunks_crc32c";
/// Attribute of the group: an object of `attributes`, the names of those that are covered, and `blake3`.
pub(super) const GROUP: &str = "checksum";
/// The arrays of rows, in many chunks.
pub(super) const ROWS: [&str; 3] = ["response", "variance", "valid"];
/// All arrays of a store.
pub(super) const ARRAYS: [&str; 14] = [
    "common_sd",
    "dx",
    "dy",
    "position_sd_mm",
    "response",
    "row_scale_sd",
    "shot",
    "shot_drift_px",
    "shot_drift_sd_px",
    "shot_name",
    "valid",
    "variance",
    "x_i_mm",
    "y_i_mm",
];
/// Those that are there with the attribute [`COMMON`] only.
pub(super) const OF_COMMON: [&str; 2] = ["common_sd", "row_scale_sd"];
/// Those that are there when the attribute `shots` counts some.
pub(super) const OF_SHOTS: [&str; 3] = ["shot_drift_px", "shot_drift_sd_px", "shot_name"];
/// In the list for a chunk that is not written, as nothing in it was measured.
const NO_CHUNK: [u8; CHECKSUM] = [0xff; CHECKSUM];

/// Adds the lists of their chunks to the metadata of the arrays in `root`, which are written; returns what [`GROUP`]
/// says of them and of `attributes`.
///
/// # Errors
/// In words, what cannot be read or written.
pub(super) fn seal(root: &Path, attributes: &Map<String, Value>) -> Result<Value, String> {
    let files = StoreFiles::Folder(root.to_path_buf());
    let mut arrays = metadata(&files)?;
    for (name, array) in &mut arrays {
        let grid = ChunkGrid::of(name, array)?;
        let trailer = |at| grid.trailer(&files, at).map(|sum| sum.unwrap_or(NO_CHUNK));
        let sums: Result<Vec<_>, String> = (0..grid.len()).into_par_iter().map(trailer).collect();
        array["attributes"][CHUNKS] = BASE64_STANDARD.encode(sums?.as_flattened()).into();
        let text = serde_json::to_string_pretty(array).map_err(|e| e.to_string())?;
        std::fs::write(root.join(name).join("zarr.json"), text).map_err(|e| format!("array {name}: {e}"))?;
    }
    let names: BTreeSet<String> = attributes.keys().cloned().collect();
    let digest = digest(attributes, &names, &arrays)?;
    Ok(serde_json::json!({"attributes": names, "blake3": digest}))
}

/// BLAKE3 of the named attributes and of the arrays' metadata: names and compact JSON, a line each.
fn digest(
    attributes: &Map<String, Value>,
    names: &BTreeSet<String>,
    arrays: &BTreeMap<&str, Value>,
) -> Result<String, String> {
    let mut text = String::new();
    for name in names {
        let value = attributes.get(name).ok_or_else(|| format!("attribute {name} is missing"))?;
        text += &format!("{name} {value}\n");
    }
    for (name, value) in arrays {
        text += &format!("/{name} {value}\n");
    }
    Ok(blake3::hash(text.as_bytes()).to_string())
}

/// The metadata of the arrays that are there.
fn metadata(files: &StoreFiles) -> Result<BTreeMap<&'static str, Value>, String> {
    let read = |name: &'static str| {
        let text = match files.read(&format!("{name}/zarr.json")) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            text => text.map_err(|e| format!("array {name}: zarr.json: {e}"))?,
        };
        let value = serde_json::from_slice(&text).map_err(|e| format!("array {name}: zarr.json: {e}"))?;
        Ok(Some((name, value)))
    };
    ARRAYS.into_iter().filter_map(|name| read(name).transpose()).collect()
}

/// What a store says of its chunks.
#[derive(Debug)]
pub(super) struct Checksums {
    files: StoreFiles,
    arrays: BTreeMap<&'static str, (ChunkGrid, Vec<[u8; CHECKSUM]>)>,
    /// BLAKE3 of attributes and metadata, with the sums of all chunks in them.
    pub(super) digest: String,
}

impl Checksums {
    /// Verifies metadata and coordinates, and that every chunk of the rows is there and no other; `None` where there is
    /// nothing to verify.
    ///
    /// # Errors
    /// In words, what was changed.
    pub(super) fn open(files: &StoreFiles, attributes: &Map<String, Value>) -> Result<Option<Self>, String> {
        let Some(stated) = attributes.get(GROUP) else { return Ok(None) };
        let arrays = metadata(files)?;
        // Another program writes the attribute along with arrays of its own, and may leave some out.
        if arrays.is_empty() || !arrays.iter().all(|(name, array)| as_written(name, array)) {
            return Ok(None);
        }
        let shots = attributes.get("shots").and_then(Value::as_u64).is_some_and(|shots| shots > 0);
        let expected = |name: &&str| {
            (!OF_COMMON.contains(name) || attributes.contains_key(COMMON)) && (!OF_SHOTS.contains(name) || shots)
        };
        if let Some(name) = ARRAYS.into_iter().filter(expected).find(|name| !arrays.contains_key(name)) {
            return Err(format!("array {name}: zarr.json is missing"));
        }
        let names: Option<BTreeSet<String>> =
            stated["attributes"].as_array().and_then(|a| a.iter().map(|v| v.as_str().map(str::to_owned)).collect());
        let names = names.ok_or_else(|| format!("attribute {GROUP}: expected the names of attributes"))?;
        let digest = digest(attributes, &names, &arrays)?;
        if stated["blake3"].as_str() != Some(&digest) {
            return Err("attributes or the metadata of an array were changed after they had been written".into());
        }
        let of = |(&name, array): (&&'static str, &Value)| {
            let grid = ChunkGrid::of(name, array)?;
            let bytes = BASE64_STANDARD.decode(array["attributes"][CHUNKS].as_str().unwrap_or_default());
            let sums = bytes.map_err(|e| format!("array {name}: {CHUNKS}: {e}"))?.as_chunks::<CHECKSUM>().0.to_vec();
            match sums.len() == grid.len() {
                true => Ok((name, (grid, sums))),
                false => Err(format!(
                    "array {name}: {CHUNKS}: expected one for each of {} chunks, found {}",
                    grid.len(),
                    sums.len()
                )),
            }
        };
        let arrays = arrays.iter().map(of).collect::<Result<_, String>>()?;
        let sums = Self { files: files.clone(), arrays, digest };
        for (name, (grid, _)) in &sums.arrays {
            match ROWS.contains(name) {
                true => sums.check_names(name)?,
                false => (0..grid.len())
                    .try_for_each(|at| sums.check_chunk(name, at))
                    .map_err(|e| format!("array {name}: {e}"))?,
            }
        }
        Ok(Some(sums))
    }

    /// Whether the folder of an array of rows has the files of all its chunks and of no others.
    fn check_names(&self, name: &str) -> Result<(), String> {
        let Some((grid, sums)) = self.arrays.get(name) else { return Ok(()) };
        let found = self.files.names(name).map_err(|e| format!("array {name}: {e}"))?;
        let Some(mut found) = found else { return Ok(()) };
        let mut before = String::new();
        for (at, sum) in sums.iter().enumerate() {
            let file = grid.file_name(at);
            if file == before {
                continue;
            }
            if !found.remove(&file) && (grid.is_sharded() || *sum != NO_CHUNK) {
                return Err(format!("array {name}: {} is missing", grid.file_words(at)));
            }
            before = file;
        }
        match found.into_iter().find(|other| other.starts_with("c.")) {
            Some(other) => Err(format!("array {name}: {other} is no chunk of it")),
            None => Ok(()),
        }
    }

    /// Whether the chunks that hold rows of an array of rows are those that were written there.
    ///
    /// # Errors
    /// In words, which is another.
    pub(super) fn check_rows(&self, name: &str, rows: &Range<usize>) -> Result<(), String> {
        let Some((grid, _)) = self.arrays.get(name) else { return Ok(()) };
        let last = rows.end.saturating_sub(1).max(rows.start);
        (grid.of_row(rows.start)..=grid.of_row(last)).try_for_each(|at| self.check_chunk(name, at))
    }

    /// What the CRC-32C of the chunk with these rows is to be; `None` for an array that has no list.
    pub(super) fn of_row(&self, name: &str, row: usize) -> Option<[u8; CHECKSUM]> {
        let (grid, sums) = self.arrays.get(name)?;
        sums.get(grid.of_row(row)).copied()
    }

    fn check_chunk(&self, name: &str, at: usize) -> Result<(), String> {
        let Some((grid, sums)) = self.arrays.get(name) else { return Ok(()) };
        let found = grid.trailer(&self.files, at)?.unwrap_or(NO_CHUNK);
        match sums.get(at) == Some(&found) {
            true => Ok(()),
            false if found == NO_CHUNK => Err(format!("{} is missing", grid.words(at))),
            false => Err(format!("{} is not the one that was written there", grid.words(at))),
        }
    }
}

/// Whether the numbers of a small array repeat often, or are nearly constant.
pub(super) fn is_compressed(name: &str) -> bool {
    OF_COMMON.contains(&name) || name == "shot_name"
}

/// Whether an array's chunks have the codecs and names that this program gives them.
fn as_written(name: &str, array: &Value) -> bool {
    if ROWS.contains(&name) {
        return rows_as_written(array);
    }
    let separator = array.pointer("/chunk_key_encoding/configuration/separator");
    let expected = match name {
        "shot_name" => "vlen-utf8 zstd crc32c",
        _ if is_compressed(name) => "bytes zstd crc32c",
        _ => "bytes crc32c",
    };
    codecs(&array["codecs"]) == expected && separator.is_none_or(|s| s == "/")
}

/// The same of an array of rows.
pub(super) fn rows_as_written(array: &Value) -> bool {
    let separator = array.pointer("/chunk_key_encoding/configuration/separator");
    let outer = &array["chunk_grid"]["configuration"]["chunk_shape"];
    let chunk = if is_sharded(array) { &array["codecs"][0]["configuration"]["chunk_shape"] } else { outer };
    let fits = !is_sharded(array) || shards_as_written(array);
    fits && codecs(inner_codecs(array)) == "bytes zstd crc32c"
        && separator == Some(&".".into())
        && chunk[0] == 1
        && (2..5).all(|axis| chunk[axis] == array["shape"][axis])
}

/// Whether shards have an index as this program writes it, and whole lines of points or part of one.
fn shards_as_written(array: &Value) -> bool {
    let (shape, outer) = (&array["shape"], &array["chunk_grid"]["configuration"]["chunk_shape"]);
    let shards = &array["codecs"][0]["configuration"];
    let whole = outer[0] == 1 || outer[1].as_u64() >= shape[1].as_u64();
    let little = shards["index_codecs"][0]["configuration"]["endian"] == "little";
    let index = codecs(&shards["index_codecs"]) == "bytes crc32c" && shards["index_location"] == "end" && little;
    index && whole && (2..5).all(|axis| outer[axis] == shape[axis]) && codecs(&array["codecs"]) == SHARDING
}

/// The codecs of a chunk, be it in a file of its own or in a shard.
pub(super) fn inner_codecs(array: &Value) -> &Value {
    if is_sharded(array) { &array["codecs"][0]["configuration"]["codecs"] } else { &array["codecs"] }
}

/// The names of codecs.
fn codecs(all: &Value) -> String {
    // What has no settings is a name alone.
    let name_of = |codec: &Value| codec.as_str().or_else(|| codec["name"].as_str()).map(str::to_owned);
    let codecs: Option<Vec<String>> = all.as_array().and_then(|all| all.iter().map(name_of).collect());
    codecs.unwrap_or_default().join(" ")
}
