//! What tells that a store is as it was written.
//!
//! Every chunk ends with its own CRC-32C (the Zarr codec `crc32c`), which decoding verifies. Each array lists those of
//! its chunks in the attribute [`CHUNKS`], in the order of the grid, so that exchanged, missing and additional chunks
//! are seen; and the group's attribute [`GROUP`] has the BLAKE3 of the arrays' metadata, these lists in it, and of the
//! attributes that it names, so that no word of them changes either.
//!
//! Not told: stores of versions without these attributes, and those that another program has written anew, whose chunks
//! have other names or codecs.

use super::store::COMMON;
use base64::{Engine, prelude::BASE64_STANDARD};
use rayon::prelude::*;
use serde_json::{Map, Value};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Attribute of an array: the last four bytes of its chunks, in base64.
const CHUNKS: &str = "chunks_crc32c";
/// Attribute of the group: an object of `attributes`, the names of those that are covered, and `blake3`.
pub(super) const GROUP: &str = "checksum";
/// The arrays of rows, in many chunks.
pub(super) const ROWS: [&str; 3] = ["response", "variance", "valid"];
/// All arrays of a store.
pub(super) const ARRAYS: [&str; 11] = [
    "common_sd",
    "dx",
    "dy",
    "position_sd_mm",
    "response",
    "row_scale_sd",
    "shot",
    "valid",
    "variance",
    "x_i_mm",
    "y_i_mm",
];
/// Those that are there with the attribute [`COMMON`] only.
pub(super) const OF_COMMON: [&str; 2] = ["common_sd", "row_scale_sd"];
const TRAILER: usize = 4;
/// In the list for a chunk that is not written, as nothing in it was measured.
const NO_CHUNK: [u8; TRAILER] = [0xff; TRAILER];

/// Adds the lists of their chunks to the metadata of the arrays in `root`, which are written; returns what [`GROUP`]
/// says of them and of `attributes`.
///
/// # Errors
/// In words, what cannot be read or written.
pub(super) fn seal(root: &Path, attributes: &Map<String, Value>) -> Result<Value, String> {
    let mut arrays = metadata(root)?;
    for (name, array) in &mut arrays {
        let grid = Grid::of(name, array)?;
        let sums: Result<Vec<_>, String> =
            (0..grid.len()).into_par_iter().map(|at| trailer(&root.join(grid.file(at)))).collect();
        array["attributes"][CHUNKS] = BASE64_STANDARD.encode(sums?.as_flattened()).into();
        let text = serde_json::to_string_pretty(array).map_err(|e| e.to_string())?;
        std::fs::write(root.join(name).join("zarr.json"), text).map_err(|e| format!("array {name}: {e}"))?;
    }
    let names: BTreeSet<String> = attributes.keys().cloned().collect();
    let digest = digest(attributes, &names, &arrays)?;
    Ok(serde_json::json!({"attributes": names, "blake3": digest}))
}

/// The last four bytes of a chunk: its CRC-32C.
fn trailer(chunk: &Path) -> Result<[u8; TRAILER], String> {
    let read = || {
        let file = crate::files::open(chunk)?;
        let len = file.metadata()?.len();
        let mut bytes = [0; TRAILER];
        super::positioned::read_exact_at(&file, &mut bytes, len.saturating_sub(TRAILER as u64))?;
        Ok::<_, std::io::Error>(bytes)
    };
    match read() {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(NO_CHUNK),
        other => other.map_err(|e| format!("chunk {}: {e}", chunk.display())),
    }
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

/// The chunks of an array that this program has written.
#[derive(Debug)]
struct Grid {
    name: &'static str,
    /// Chunks along each axis, and numbers along each axis of one.
    chunks: Vec<usize>,
    sides: Vec<usize>,
}

impl Grid {
    fn of(name: &'static str, array: &Value) -> Result<Self, String> {
        let numbers = |value: &Value| -> Option<Vec<usize>> {
            value.as_array()?.iter().map(|n| n.as_u64().and_then(|n| usize::try_from(n).ok())).collect()
        };
        let shape = numbers(&array["shape"]);
        let sides = numbers(&array["chunk_grid"]["configuration"]["chunk_shape"]);
        match shape.zip(sides) {
            Some((shape, sides)) if shape.len() == sides.len() && sides.iter().all(|&n| n > 0) => {
                Ok(Self { name, chunks: shape.iter().zip(&sides).map(|(n, side)| n.div_ceil(*side)).collect(), sides })
            }
            _ => Err(format!("array {name}: expected a shape and one of chunks")),
        }
    }

    fn len(&self) -> usize {
        self.chunks.iter().try_fold(1usize, |all, &n| all.checked_mul(n)).unwrap_or(usize::MAX)
    }

    /// The file of a chunk, from the folder of the store.
    fn file(&self, mut at: usize) -> PathBuf {
        let mut indices: Vec<String> = Vec::new();
        for &n in self.chunks.iter().rev() {
            indices.insert(0, (at % n.max(1)).to_string());
            at /= n.max(1);
        }
        let (separator, folder) = if ROWS.contains(&self.name) { (".", "c.") } else { ("/", "c/") };
        Path::new(self.name).join(format!("{folder}{}", indices.join(separator)))
    }
}

/// What a store says of its chunks.
#[derive(Debug)]
pub(super) struct Checksums {
    root: PathBuf,
    arrays: BTreeMap<&'static str, (Grid, Vec<[u8; TRAILER]>)>,
    /// BLAKE3 of attributes and metadata, with the sums of all chunks in them.
    pub(super) digest: String,
}

impl Checksums {
    /// Verifies metadata and coordinates, and that every chunk of the rows is there and no other; `None` where there is
    /// nothing to verify.
    ///
    /// # Errors
    /// In words, what was changed.
    pub(super) fn open(root: &Path, attributes: &Map<String, Value>) -> Result<Option<Self>, String> {
        let Some(stated) = attributes.get(GROUP) else { return Ok(None) };
        let arrays = metadata(root)?;
        // Another program writes the attribute along with arrays of its own, and may leave some out.
        if arrays.is_empty() || !arrays.iter().all(|(name, array)| as_written(name, array)) {
            return Ok(None);
        }
        let expected = |name: &&str| !OF_COMMON.contains(name) || attributes.contains_key(COMMON);
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
            let grid = Grid::of(name, array)?;
            let bytes = BASE64_STANDARD.decode(array["attributes"][CHUNKS].as_str().unwrap_or_default());
            let sums = bytes.map_err(|e| format!("array {name}: {CHUNKS}: {e}"))?.as_chunks::<TRAILER>().0.to_vec();
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
        let sums = Self { root: root.to_path_buf(), arrays, digest };
        for (name, (grid, _)) in &sums.arrays {
            match ROWS.contains(name) {
                true => sums.check_names(name)?,
                false => (0..grid.len()).try_for_each(|at| sums.check_chunk(name, at))?,
            }
        }
        Ok(Some(sums))
    }

    /// Whether the folder of an array of rows has the files of all its chunks and of no others.
    fn check_names(&self, name: &str) -> Result<(), String> {
        let Some((grid, sums)) = self.arrays.get(name) else { return Ok(()) };
        let entries = std::fs::read_dir(self.root.join(name)).map_err(|e| format!("array {name}: {e}"))?;
        let files = entries.flatten().filter(|e| e.file_type().is_ok_and(|kind| kind.is_file()));
        let mut found: BTreeSet<String> = files.filter_map(|e| e.file_name().into_string().ok()).collect();
        for (at, sum) in sums.iter().enumerate() {
            let file = file_name(&grid.file(at));
            if !found.remove(&file) && *sum != NO_CHUNK {
                return Err(format!("array {name}: chunk {file} is missing"));
            }
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
        let ([across, side], nx) = ([grid.chunks[1], grid.sides[1]], self.points_along_x(name));
        let chunk = |row: usize| row / nx * across + row % nx / side;
        // Chunks of rows have one line of points and all samples: they are counted as the rows are.
        (chunk(rows.start)..=chunk(rows.end.saturating_sub(1).max(rows.start)))
            .try_for_each(|at| self.check_chunk(name, at))
    }

    fn points_along_x(&self, name: &str) -> usize {
        // Coordinates are in one chunk each.
        self.arrays.get("x_i_mm").filter(|_| ROWS.contains(&name)).map_or(1, |(grid, _)| grid.sides[1].max(1))
    }

    fn check_chunk(&self, name: &str, at: usize) -> Result<(), String> {
        let Some((grid, sums)) = self.arrays.get(name) else { return Ok(()) };
        let file = grid.file(at);
        let found = trailer(&self.root.join(&file)).map_err(|e| format!("array {name}: {e}"))?;
        match sums.get(at) == Some(&found) {
            true => Ok(()),
            false if found == NO_CHUNK => Err(format!("array {name}: chunk {} is missing", file_name(&file))),
            false => Err(format!("array {name}: chunk {} is not the one that was written there", file_name(&file))),
        }
    }
}

fn file_name(chunk: &Path) -> String {
    chunk.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Whether an array's chunks have the codecs and names that this program gives them.
fn as_written(name: &str, array: &Value) -> bool {
    if ROWS.contains(&name) {
        return rows_as_written(array);
    }
    let separator = array.pointer("/chunk_key_encoding/configuration/separator");
    let expected = if OF_COMMON.contains(&name) { "bytes zstd crc32c" } else { "bytes crc32c" };
    codecs(array) == expected && separator.is_none_or(|s| s == "/")
}

/// The same of an array of rows.
pub(super) fn rows_as_written(array: &Value) -> bool {
    let separator = array.pointer("/chunk_key_encoding/configuration/separator");
    codecs(array) == "bytes zstd crc32c" && separator == Some(&".".into()) && one_line(array)
}

/// The names of an array's codecs.
fn codecs(array: &Value) -> String {
    // What has no settings is a name alone.
    let name_of = |codec: &Value| codec.as_str().or_else(|| codec["name"].as_str()).map(str::to_owned);
    let codecs: Option<Vec<String>> = array["codecs"].as_array().and_then(|all| all.iter().map(name_of).collect());
    codecs.unwrap_or_default().join(" ")
}

/// Whether chunks have one line of points, all samples and all channels.
fn one_line(array: &Value) -> bool {
    let (shape, chunk) = (&array["shape"], &array["chunk_grid"]["configuration"]["chunk_shape"]);
    chunk[0] == 1 && (2..5).all(|axis| chunk[axis] == shape[axis])
}
