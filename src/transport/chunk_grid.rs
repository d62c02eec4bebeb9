//! Where the chunks of an array are that this program has written: each in a file of its own, or some in a shard.
//!
//! A shard (the Zarr codec `sharding_indexed`) has the chunks of some whole lines of lit points, one after the other as
//! they would be in files of their own, and behind them an index: offset and length of each, little-endian, 2⁶⁴ − 1 twice
//! for one that is not written; and the CRC-32C of the index. So a chunk costs the reading of the index, once, and of
//! its own bytes.

use super::checksum::ROWS;
use super::store_files::StoreFiles;
use serde_json::Value;
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::ops::Range;
use std::sync::{Arc, RwLock};

/// Bytes of a CRC-32C.
pub(super) const CHECKSUM: usize = 4;
/// Bytes of a chunk's offset and length in the index of a shard.
pub(super) const ENTRY: usize = 16;
/// Offset and length of a chunk that is not written.
pub(super) const NOT_WRITTEN: [u8; ENTRY] = [0xff; ENTRY];
/// The codec that makes shards.
pub(super) const SHARDING: &str = "sharding_indexed";

/// The chunks of an array that this program has written.
#[derive(Debug)]
pub(super) struct ChunkGrid {
    name: String,
    /// Numbers along each axis of the array, and of a chunk.
    shape: Vec<usize>,
    sides: Vec<usize>,
    /// Chunks along each axis.
    counts: Vec<usize>,
    shards: Option<Shards>,
}

/// Bytes of each chunk in its shard; `None` for one that is not written.
type Index = Arc<[Option<Range<u64>>]>;

#[derive(Debug)]
struct Shards {
    /// Lines of points, and chunks along each, that a shard has.
    lines: usize,
    columns: usize,
    /// Shards along a line.
    across: usize,
    /// Of the shards that were asked for.
    indices: RwLock<BTreeMap<usize, Index>>,
}

impl ChunkGrid {
    /// From the metadata of an array.
    ///
    /// # Errors
    /// In words, what is missing there.
    pub(super) fn of(name: &str, array: &Value) -> Result<Self, String> {
        let numbers = |value: &Value| -> Option<Vec<usize>> {
            let all = value.as_array()?.iter().map(|n| n.as_u64().and_then(|n| usize::try_from(n).ok()));
            all.collect::<Option<Vec<_>>>().filter(|all| all.iter().all(|&n| n > 0))
        };
        let codec = &array["codecs"][0];
        let sharded = is_sharded(array);
        let outer = numbers(&array["chunk_grid"]["configuration"]["chunk_shape"]);
        let inner = if sharded { numbers(&codec["configuration"]["chunk_shape"]) } else { outer.clone() };
        let shape = array["shape"].as_array().and_then(|_| numbers(&array["shape"]));
        let (Some(shape), Some(sides), Some(outer)) = (shape, inner, outer) else {
            return Err(format!("array {name}: expected a shape and one of chunks"));
        };
        if shape.len() != sides.len() || outer.len() != sides.len() || sharded && shape.len() < 2 {
            return Err(format!("array {name}: expected a shape and one of chunks"));
        }
        let counts: Vec<usize> = shape.iter().zip(&sides).map(|(n, side)| n.div_ceil(*side)).collect();
        let shards = sharded.then(|| Shards {
            lines: outer[0].div_ceil(sides[0]),
            columns: outer[1].div_ceil(sides[1]),
            across: shape[1].div_ceil(outer[1]),
            indices: RwLock::default(),
        });
        Ok(Self { name: name.to_owned(), shape, sides, counts, shards })
    }

    /// How many chunks there are.
    pub(super) fn len(&self) -> usize {
        self.counts.iter().try_fold(1usize, |all, &n| all.checked_mul(n)).unwrap_or(usize::MAX)
    }

    /// Lit points of a line, and of a chunk.
    pub(super) fn points(&self) -> [usize; 2] {
        [self.shape[1], self.sides[1]]
    }

    /// The chunk of a row. Chunks of rows have one line of points and all samples: they are counted as the rows are.
    pub(super) fn of_row(&self, row: usize) -> usize {
        let [nx, side] = self.points();
        row / nx * self.counts[1] + row % nx / side
    }

    /// The rows of a chunk.
    pub(super) fn rows(&self, at: usize) -> Range<usize> {
        let [nx, side] = self.points();
        let (line, x) = (at / self.counts[1], at % self.counts[1] * side);
        line * nx + x..line * nx + (x + side).min(nx)
    }

    /// The number of a chunk's shard and its place in it; of a chunk without shards its own and 0.
    pub(super) fn place(&self, at: usize) -> (usize, usize) {
        let Some(Shards { lines, columns, across, .. }) = &self.shards else { return (at, 0) };
        let (line, column) = (at / self.counts[1], at % self.counts[1]);
        (line / lines * across + column / columns, line % lines * columns + column % columns)
    }

    /// The file that has a chunk.
    pub(super) fn file(&self, at: usize) -> String {
        if let Some(shards) = &self.shards {
            let (shard, _) = self.place(at);
            return format!("{}/c.{}.{}.0.0.0", self.name, shard / shards.across, shard % shards.across);
        }
        let (mut rest, mut indices) = (at, Vec::new());
        for &n in self.counts.iter().rev() {
            indices.insert(0, (rest % n.max(1)).to_string());
            rest /= n.max(1);
        }
        let (separator, folder) = if ROWS.contains(&self.name.as_str()) { (".", "c.") } else { ("/", "c/") };
        format!("{}/{folder}{}", self.name, indices.join(separator))
    }

    /// Its name in the folder of the array.
    pub(super) fn file_name(&self, at: usize) -> String {
        self.file(at).rsplit('/').next().unwrap_or_default().to_owned()
    }

    /// Whether chunks are in shards, whose files are there though none of their chunks may be written.
    pub(super) fn is_sharded(&self) -> bool {
        self.shards.is_some()
    }

    /// What a person finds the file of a chunk by.
    pub(super) fn file_words(&self, at: usize) -> String {
        let file = self.file_name(at);
        if !self.is_sharded() {
            return format!("chunk {file}");
        }
        let last = (at..self.len()).take_while(|&k| self.place(k).0 == self.place(at).0).last().unwrap_or(at);
        format!("shard {file} of rows {} to {}", self.rows(at).start, self.rows(last).end - 1)
    }

    /// What a person finds a chunk by.
    pub(super) fn words(&self, at: usize) -> String {
        let file = self.file_name(at);
        match self.is_sharded() {
            true => {
                let rows = self.rows(at);
                format!("chunk of rows {} to {} in shard {file}", rows.start, rows.end - 1)
            }
            false => format!("chunk {file}"),
        }
    }

    /// The bytes of a chunk; `None` when it is not written.
    ///
    /// # Errors
    /// In words, what cannot be read.
    pub(super) fn read(&self, files: &StoreFiles, at: usize) -> Result<Option<Vec<u8>>, String> {
        let file = self.file(at);
        let bytes = match self.in_shard(files, at)? {
            None => files.read(&file),
            Some(None) => return Ok(None),
            Some(Some(range)) => files.read_at(&file, range.start, (range.end - range.start) as usize),
        };
        self.unless_missing(at, bytes)
    }

    /// The last bytes of a chunk: its CRC-32C; `None` when it is not written.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    pub(super) fn trailer(&self, files: &StoreFiles, at: usize) -> Result<Option<[u8; CHECKSUM]>, String> {
        let file = self.file(at);
        let bytes = match self.in_shard(files, at)? {
            None => files.read_end(&file, CHECKSUM).map(|(bytes, _)| bytes),
            Some(None) => return Ok(None),
            Some(Some(range)) => files.read_at(&file, range.end.saturating_sub(CHECKSUM as u64), CHECKSUM),
        };
        let short = || format!("{} is cut short", self.words(at));
        self.unless_missing(at, bytes)?.map(|bytes| bytes.try_into().map_err(|_| short())).transpose()
    }

    fn unless_missing<T>(&self, at: usize, bytes: std::io::Result<T>) -> Result<Option<T>, String> {
        match bytes {
            Ok(bytes) => Ok(Some(bytes)),
            Err(e) if e.kind() == ErrorKind::NotFound && !self.is_sharded() => Ok(None),
            Err(e) => Err(format!("{}: {e}", self.words(at))),
        }
    }

    /// Where in its shard a chunk is, if there are shards, and if it is written.
    fn in_shard(&self, files: &StoreFiles, at: usize) -> Result<Option<Option<Range<u64>>>, String> {
        let Some(shards) = &self.shards else { return Ok(None) };
        let (shard, within) = self.place(at);
        let known = shards.indices.read().ok().and_then(|all| all.get(&shard).cloned());
        let index = match known {
            Some(index) => index,
            None => {
                let read = read_index(files, &self.file(at), shards.lines * shards.columns);
                let index = read.map_err(|reason| format!("{} {reason}", self.words(at)))?;
                if let Ok(mut all) = shards.indices.write() {
                    all.insert(shard, index.clone());
                }
                index
            }
        };
        Ok(Some(index.get(within).cloned().flatten()))
    }
}

/// Whether the chunks of an array are in shards, by its metadata.
pub(super) fn is_sharded(array: &Value) -> bool {
    array["codecs"][0]["name"] == SHARDING
}

/// The index of a shard with `chunks` chunks.
fn read_index(files: &StoreFiles, file: &str, chunks: usize) -> Result<Index, String> {
    let len = chunks.checked_mul(ENTRY).and_then(|n| n.checked_add(CHECKSUM)).ok_or("has too many chunks")?;
    let (bytes, all) = match files.read_end(file, len) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Err("is missing".into()),
        read => read.map_err(|e| format!("cannot be read: {e}"))?,
    };
    let damaged = "cannot be found: the shard is cut short, or its index is damaged";
    let (entries, sum) = bytes.split_last_chunk::<CHECKSUM>().filter(|_| bytes.len() == len).ok_or(damaged)?;
    if crc32c::crc32c(entries).to_le_bytes() != *sum {
        return Err(damaged.into());
    }
    let end = all - len as u64;
    let of = |entry: &[u8; ENTRY]| {
        if *entry == NOT_WRITTEN {
            return Ok(None);
        }
        let number = |from: usize| u64::from_le_bytes(std::array::from_fn(|k| entry[from + k]));
        let (from, to) = (number(0), number(0).checked_add(number(8)));
        to.filter(|to| *to <= end).map(|to| Some(from..to)).ok_or_else(|| damaged.to_owned())
    };
    entries.as_chunks::<ENTRY>().0.iter().map(of).collect()
}
