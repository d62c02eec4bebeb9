//! Writing the arrays of rows, chunk by chunk: each in a file of its own, or in shards where those would be too many.

use super::CHANNELS;
use super::chunk_grid::{CHECKSUM, ChunkGrid, ENTRY, NOT_WRITTEN};
use super::row_array::CHUNK_NUMBERS;
use super::store::MatrixHeader;
use super::writer::{BoxedError, ZSTD_LEVEL, units};
use std::fs::File;
use std::io::Write;
use std::num::NonZeroU64;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::codec::{Crc32cCodec, ShardingCodecBuilder, ZstdCodec};
use zarrs::array::{
    Array, ArrayBuilder, ArrayToBytesCodecTraits, BytesToBytesCodecTraits, ChunkKeySeparator, CodecOptions, DataType,
    Element, FillValue, IntoArrayBytes,
};
use zarrs::filesystem::FilesystemStore;

/// A chunk holds about this many bytes of responses: large enough for the disk, small enough to stream.
const CHUNK_BYTES: usize = 4 << 20;
/// The most files that an array of rows has: a page of a listing of an object store has as many names, so that opening
/// a matrix asks for the names of an array once.
pub(super) const MOST_FILES: usize = 1000;
/// Chunks of a shard, at least. Shards are written side by side, one by a thread: where sharding begins, at
/// [`MOST_FILES`] chunks, there are as many shards as each has chunks (√1000), enough for 32 threads.
const SHARD_CHUNKS: usize = 32;

/// How the rows of a matrix are divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Chunking {
    /// Lit points of a line that one chunk has.
    pub(super) rows: usize,
    /// Lines of points, and chunks along each, that a shard has; `None` where each chunk has a file.
    pub(super) shard: Option<[usize; 2]>,
}

impl Chunking {
    /// That of a matrix.
    pub(super) fn of(header: &MatrixHeader) -> Self {
        let [nx, ny] = header.points;
        let most = (CHUNK_BYTES / (4 * header.row_len())).clamp(1, nx);
        // Equal chunks along a line, of at least half as many rows as may be; else the last one is padded to the size
        // of the others.
        let equal = (most.div_ceil(2)..=most).rev().find(|&n| nx.is_multiple_of(n));
        let rows = equal.unwrap_or(nx.div_ceil(nx.div_ceil(most)));
        let across = nx.div_ceil(rows);
        let all = across * ny;
        // Whole lines, so that rows follow each other; but no more numbers than a reader takes for one chunk.
        let lines = SHARD_CHUNKS.max(all.div_ceil(MOST_FILES)).div_ceil(across).min(ny);
        let fit = (CHUNK_NUMBERS as usize / (rows * header.row_len())).max(1);
        let shard = if lines * across <= fit { [lines, across] } else { [(fit / across).max(1), across.min(fit)] };
        Self { rows, shard: (all > MOST_FILES).then_some(shard) }
    }

    /// Ranges of rows that lie in one chunk each, those of the chunks of a file together.
    pub(super) fn files(&self, header: &MatrixHeader) -> Vec<Vec<Range<usize>>> {
        let ([nx, ny], step) = (header.points, self.rows);
        let [lines, columns] = self.shard.unwrap_or([1, 1]);
        let mut files: Vec<Vec<Range<usize>>> = Vec::new();
        for y in 0..ny {
            let line: Vec<_> = (0..nx).step_by(step).map(|x| y * nx + x..y * nx + (x + step).min(nx)).collect();
            for (k, chunks) in line.chunks(columns).enumerate() {
                match files.last_mut().filter(|_| k == 0 && !y.is_multiple_of(lines)) {
                    Some(file) => file.extend_from_slice(chunks),
                    None => files.push(chunks.to_vec()),
                }
            }
        }
        files
    }
}

/// An array of rows that is being written.
pub(super) struct RowsArray<T> {
    /// With a file for each chunk: what encodes a chunk, whatever file it goes to.
    chunk: Array<FilesystemStore>,
    grid: ChunkGrid,
    root: PathBuf,
    fill: T,
    /// Numbers, and places in a shard, of a file's chunks.
    numbers: usize,
    slots: Option<usize>,
}

impl<T: Element + Copy> RowsArray<T>
where
    Vec<T>: IntoArrayBytes<'static>,
    T: Into<FillValue>,
{
    /// Writes the metadata of the array `name` of the store at `root`.
    pub(super) fn create(
        header: &MatrixHeader,
        chunking: Chunking,
        root: &Path,
        name: &str,
        data_type: DataType,
        fill: T,
    ) -> Result<Self, BoxedError> {
        let store = Arc::new(FilesystemStore::new(root)?);
        let ([nx, ny], [wx, wy]) = (header.points, header.window);
        let shape = [ny, nx, wy, wx, CHANNELS].map(|n| n as u64);
        let side = [1, chunking.rows, wy, wx, CHANNELS].map(|n| n as u64);
        let codecs: Vec<Arc<dyn BytesToBytesCodecTraits>> =
            vec![Arc::new(ZstdCodec::new(ZSTD_LEVEL, false)), Arc::new(Crc32cCodec::new())];
        let fill_value: FillValue = fill.into();
        let build = |sides: [u64; 5], sharding: Option<ShardingCodecBuilder>| {
            let mut array = ArrayBuilder::new(shape.to_vec(), sides.to_vec(), data_type.clone(), fill_value.clone());
            array
                .dimension_names(["y_i", "x_i", "dy", "dx", "channel"].into())
                // The CF convention by which xarray takes the lit points' places for coordinates.
                .attributes(units(name, &[("coordinates", "x_i_mm y_i_mm")]))
                // One file a chunk in one folder: five nested folders for each would cost more than the data.
                .chunk_key_encoding_default_separator(ChunkKeySeparator::Dot);
            match sharding {
                Some(sharding) => array.array_to_bytes_codec(sharding.build_arc()),
                None => array.bytes_to_bytes_codecs(codecs.clone()),
            };
            array.build(store.clone(), &format!("/{name}"))
        };
        let chunk = build(side, None)?;
        let sharded = match chunking.shard {
            Some([lines, across]) => {
                let inner = side.iter().filter_map(|&n| NonZeroU64::new(n)).collect();
                let mut sharding = ShardingCodecBuilder::new(inner, &data_type);
                sharding.bytes_to_bytes_codecs(codecs.clone());
                Some(build([lines as u64, across as u64 * side[1], side[2], side[3], side[4]], Some(sharding))?)
            }
            None => None,
        };
        let written = sharded.as_ref().unwrap_or(&chunk);
        written.store_metadata()?;
        let grid = ChunkGrid::of(name, &serde_json::to_value(written.metadata())?)?;
        let slots = chunking.shard.map(|[lines, across]| lines * across);
        let numbers = chunking.rows * header.row_len();
        Ok(Self { chunk, grid, root: root.to_path_buf(), fill, numbers, slots })
    }

    /// Begins the file that has the chunk of a row.
    pub(super) fn file(&self, row: usize) -> Result<ChunkFile<'_, T>, BoxedError> {
        let path = self.root.join(self.grid.file(self.grid.of_row(row)));
        let shard = self.slots.map(|slots| Ok::<_, std::io::Error>((File::create(&path)?, vec![NOT_WRITTEN; slots])));
        Ok(ChunkFile { array: self, path, shard: shard.transpose()?, at: 0 })
    }

    /// A chunk as it is on the disk; `None` when nothing in it was measured.
    fn encode(&self, mut values: Vec<T>) -> Result<Option<Vec<u8>>, BoxedError> {
        values.resize(self.numbers, self.fill);
        let (kind, fill) = (self.chunk.data_type(), self.chunk.fill_value());
        let bytes = values.into_array_bytes(kind)?;
        if bytes.is_fill_value(fill) {
            return Ok(None);
        }
        let shape = self.chunk.chunk_shape(&[0; 5])?;
        let encoded = self.chunk.codecs().encode(bytes, &shape, kind, fill, &CodecOptions::default())?;
        Ok(Some(encoded.into_owned()))
    }
}

/// A file of chunks that is being written: one, or those of a shard.
pub(super) struct ChunkFile<'a, T> {
    array: &'a RowsArray<T>,
    path: PathBuf,
    /// Its file, and what the index says of its chunks.
    shard: Option<(File, Vec<[u8; ENTRY]>)>,
    /// Where the next chunk goes.
    at: u64,
}

impl<T: Element + Copy> ChunkFile<'_, T>
where
    Vec<T>: IntoArrayBytes<'static>,
    T: Into<FillValue>,
{
    /// Writes the chunk that begins with `row`.
    pub(super) fn put(&mut self, row: usize, values: Vec<T>) -> Result<(), BoxedError> {
        let Some(bytes) = self.array.encode(values)? else { return Ok(()) };
        let Some((file, index)) = &mut self.shard else { return Ok(std::fs::write(&self.path, bytes)?) };
        file.write_all(&bytes)?;
        let (_, slot) = self.array.grid.place(self.array.grid.of_row(row));
        let len = bytes.len() as u64;
        index[slot][..8].copy_from_slice(&self.at.to_le_bytes());
        index[slot][8..].copy_from_slice(&len.to_le_bytes());
        self.at += len;
        Ok(())
    }

    /// Writes the index of a shard.
    pub(super) fn finish(self) -> Result<(), BoxedError> {
        let Some((mut file, index)) = self.shard else { return Ok(()) };
        let mut bytes = index.into_flattened();
        let sum: [u8; CHECKSUM] = crc32c::crc32c(&bytes).to_le_bytes();
        bytes.extend(sum);
        Ok(file.write_all(&bytes)?)
    }
}

#[cfg(test)]
mod tests;
