//! What tells that a store is as it was written.
//!
//! Every chunk ends with its own CRC-32C (the Zarr codec `crc32c`), which decoding verifies. Each array lists those of its chunks in the attribute
//! [`CHUNKS`], in the order of the grid, so that exchanged, missing and additional chunks are seen; and the group's attribute [`GROUP`] has the BLAKE3 of
//! the arrays' metadata, these lists in it, and of the attributes that it names, so that no word of them changes either.
//!
//! Not told: stores of versions without these attributes, and those that another program has written anew, whose chunks have other names or codecs.

use base64::{Engine, prelude::BASE64_STANDARD};
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use zarrs::array::{Array, ArraySubset};
use zarrs::filesystem::FilesystemStore;

/// Attribute of an array: the last four bytes of its chunks, in base64.
pub(super) const CHUNKS: &str = "chunks_crc32c";
/// Attribute of the group: an object of `attributes`, the names of those that are covered, and `blake3`.
pub(super) const GROUP: &str = "checksum";
/// The arrays of rows, in many chunks.
pub(super) const ROWS: [&str; 3] = ["response", "variance", "valid"];
/// All arrays of a store.
pub(super) const ARRAYS: [&str; 9] =
    ["dx", "dy", "position_sd_mm", "response", "shot", "valid", "variance", "x_i_mm", "y_i_mm"];
const TRAILER: usize = 4;

/// The last four bytes of a chunk: its CRC-32C.
fn trailer(chunk: &Path) -> std::io::Result<[u8; TRAILER]> {
    let file = crate::files::open(chunk)?;
    let len = file.metadata()?.len();
    let mut bytes = [0; TRAILER];
    super::positioned::read_exact_at(&file, &mut bytes, len.saturating_sub(TRAILER as u64))?;
    Ok(bytes)
}

/// The files of an array's chunks, row-major, with their indices.
fn chunks<'a>(
    root: &'a Path,
    array: &'a Array<FilesystemStore>,
    of: &ArraySubset,
) -> impl Iterator<Item = (usize, PathBuf)> + use<'a> {
    let grid = array.chunk_grid_shape();
    of.indices().into_iter().map(move |chunk| {
        let at = chunk.iter().zip(grid).fold(0, |at, (k, n)| at * n + k);
        (at as usize, root.join(array.chunk_key(&chunk).as_str()))
    })
}

fn all(array: &Array<FilesystemStore>) -> ArraySubset {
    ArraySubset::new_with_shape(array.chunk_grid_shape().to_vec())
}

/// What [`CHUNKS`] says of an array whose chunks have been written to the store `root`.
pub(super) fn of_chunks(root: &Path, array: &Array<FilesystemStore>) -> std::io::Result<Value> {
    let bytes: std::io::Result<Vec<[u8; TRAILER]>> =
        chunks(root, array, &all(array)).map(|(_, file)| trailer(&file)).collect();
    Ok(BASE64_STANDARD.encode(bytes?.as_flattened()).into())
}

/// What [`GROUP`] says of `attributes` and of the arrays that have been written to the store `root`.
pub(super) fn of_group(root: &Path, attributes: &Map<String, Value>) -> Result<Value, String> {
    let names: BTreeSet<String> = attributes.keys().cloned().collect();
    let digest = digest(attributes, &names, &metadata(root)?)?;
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
fn metadata(root: &Path) -> Result<BTreeMap<&'static str, Value>, String> {
    let read = |name: &'static str| {
        let text = match crate::files::read(&root.join(name).join("zarr.json")) {
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
    root: PathBuf,
    chunks: BTreeMap<&'static str, Vec<[u8; TRAILER]>>,
}

impl Checksums {
    /// Verifies metadata, and that each chunk of the rows is there and no other; `None` where there is nothing to verify.
    ///
    /// # Errors
    /// In words, what was changed.
    pub(super) fn open(root: &Path, attributes: &Map<String, Value>) -> Result<Option<Self>, String> {
        let Some(group) = attributes.get(GROUP) else { return Ok(None) };
        let arrays = metadata(root)?;
        // Another program writes the attribute along with arrays of its own, and may leave some out.
        if arrays.is_empty() || !arrays.iter().all(|(name, array)| as_written(name, array)) {
            return Ok(None);
        }
        if let Some(name) = ARRAYS.into_iter().find(|name| !arrays.contains_key(name)) {
            return Err(format!("array {name}: zarr.json is missing"));
        }
        let names: Option<BTreeSet<String>> =
            group["attributes"].as_array().and_then(|a| a.iter().map(|v| v.as_str().map(str::to_owned)).collect());
        let names = names.ok_or_else(|| format!("attribute {GROUP}: expected the names of attributes"))?;
        if group["blake3"].as_str() != Some(&digest(attributes, &names, &arrays)?) {
            return Err("attributes or the metadata of an array were changed after they had been written".into());
        }
        let of = |(name, array): (&&'static str, &Value)| {
            let text = array["attributes"][CHUNKS].as_str().unwrap_or_default();
            let bytes = BASE64_STANDARD.decode(text).map_err(|e| format!("array {name}: {CHUNKS}: {e}"))?;
            Ok((*name, bytes.as_chunks::<TRAILER>().0.to_vec()))
        };
        let chunks = arrays.iter().map(of).collect::<Result<_, String>>()?;
        Ok(Some(Self { root: root.to_path_buf(), chunks }))
    }

    /// Whether the folder of an array has the files of all its chunks and of no others.
    ///
    /// # Errors
    /// In words, which is missing or too many.
    pub(super) fn check_names(&self, array: &Array<FilesystemStore>) -> Result<(), String> {
        let name = name(array);
        let expected = array.chunk_grid_shape().iter().try_fold(1u64, |n, &of| n.checked_mul(of));
        let listed = self.chunks.get(name).map_or(0, Vec::len);
        if expected != Some(listed as u64) {
            return Err(format!("array {name}: {CHUNKS}: expected one for each chunk, found {listed}"));
        }
        let entries = std::fs::read_dir(self.root.join(name)).map_err(|e| format!("array {name}: {e}"))?;
        let mut found: BTreeSet<PathBuf> = entries
            .filter_map(|e| e.ok().filter(|e| e.file_type().is_ok_and(|kind| kind.is_file())))
            .map(|e| e.path())
            .collect();
        for (_, chunk) in chunks(&self.root, array, &all(array)) {
            if !found.remove(&chunk) {
                return Err(format!("array {name}: chunk {} is missing", file_name(&chunk)));
            }
        }
        match found.iter().map(|other| file_name(other)).find(|other| other.starts_with("c.")) {
            Some(other) => Err(format!("array {name}: {other} is no chunk of it")),
            None => Ok(()),
        }
    }

    /// Whether the chunks that hold `part` of an array are those that were written there.
    ///
    /// # Errors
    /// In words, which is another.
    pub(super) fn check_chunks(&self, array: &Array<FilesystemStore>, part: &ArraySubset) -> Result<(), String> {
        let name = name(array);
        let of = array.chunks_in_array_subset(part).map_err(|e| format!("array {name}: {e}"))?;
        for (at, file) in chunks(&self.root, array, &of.unwrap_or_else(|| all(array))) {
            let found = trailer(&file).map_err(|e| format!("array {name}: chunk {}: {e}", file_name(&file)))?;
            if self.chunks.get(name).and_then(|chunks| chunks.get(at)) != Some(&found) {
                return Err(format!("array {name}: chunk {} is not the one that was written there", file_name(&file)));
            }
        }
        Ok(())
    }
}

fn name(array: &Array<FilesystemStore>) -> &str {
    array.path().as_str().trim_start_matches('/')
}

fn file_name(chunk: &Path) -> String {
    chunk.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Whether an array's chunks have the codecs and names that this program gives them.
fn as_written(name: &str, array: &Value) -> bool {
    // What has no settings is a name alone.
    let name_of = |codec: &Value| codec.as_str().or_else(|| codec["name"].as_str()).map(str::to_owned);
    let codecs: Option<Vec<String>> = array["codecs"].as_array().and_then(|all| all.iter().map(name_of).collect());
    let codecs = codecs.unwrap_or_default().join(" ");
    let separator = array.pointer("/chunk_key_encoding/configuration/separator");
    match ROWS.contains(&name) {
        true => codecs == "bytes zstd crc32c" && separator == Some(&".".into()),
        false => codecs == "bytes crc32c" && separator.is_none_or(|s| s == "/"),
    }
}
