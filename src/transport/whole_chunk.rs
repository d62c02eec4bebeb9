//! Chunks as this program writes them, decoded into their place. The general way of the Zarr crate copies a chunk
//! three times, into memory that is new each time: of a matrix in memory that is two thirds of reading it.

use super::CHANNELS;
use super::checksum::{inner_codecs, rows_as_written};
use super::chunk_grid::{CHECKSUM, ChunkGrid};
use super::store_files::StoreFiles;
use std::ops::Range;
use zarrs::array::Array;

/// An array of rows as [`rows_as_written`] has it: a chunk holds whole windows of lit points of one line, compressed by
/// zstd and followed by their CRC-32C.
#[derive(Debug)]
pub(super) struct WholeChunks {
    grid: ChunkGrid,
    /// Bytes of a row.
    row_bytes: usize,
}

impl WholeChunks {
    /// `None` for an array with other chunks.
    pub(super) fn of(array: &Array<StoreFiles>) -> Option<Self> {
        let metadata = serde_json::to_value(array.metadata()).ok()?;
        let codecs = inner_codecs(&metadata);
        let little = codecs[0]["configuration"]["endian"].as_str().is_none_or(|e| e == "little");
        let bytes = match metadata["data_type"].as_str()? {
            "float32" => 4,
            "uint8" => 1,
            _ => return None,
        };
        let shape: [u64; 5] = array.shape().try_into().ok()?;
        let here = little && cfg!(target_endian = "little");
        if !(here && rows_as_written(&metadata) && shape[4] == CHANNELS as u64) {
            return None;
        }
        let grid = ChunkGrid::of(array.path().as_str().trim_start_matches('/'), &metadata).ok()?;
        let row = usize::try_from(shape[2] * shape[3] * shape[4]).ok()?;
        Some(Self { grid, row_bytes: row.checked_mul(bytes)? })
    }

    /// Decodes rows of one chunk into `out`; `sum` is what its CRC-32C is to be, where that is known. False when the
    /// rows are of several chunks, or theirs is missing or another: the general way then has the words for the error.
    ///
    /// # Errors
    /// In words, that the chunk is damaged.
    pub(super) fn read(
        &self,
        files: &StoreFiles,
        rows: &Range<usize>,
        sum: Option<[u8; CHECKSUM]>,
        out: &mut [u8],
    ) -> Result<bool, String> {
        if rows.is_empty() || out.len() != rows.len() * self.row_bytes {
            return Ok(false);
        }
        let at = self.grid.of_row(rows.start);
        let from = (rows.start - self.grid.rows(at).start) * self.row_bytes;
        let whole = self.grid.points()[1] * self.row_bytes;
        let Ok(Some(encoded)) = self.grid.read(files, at) else { return Ok(false) };
        let Some((packed, checksum)) = encoded.split_last_chunk::<CHECKSUM>() else { return Ok(false) };
        if self.grid.of_row(rows.end - 1) != at || sum.is_some_and(|sum| sum != *checksum) {
            return Ok(false);
        }
        match crc32c::crc32c(packed).to_le_bytes() == *checksum {
            true => Ok(decode(packed, from, whole, out)),
            false => Err(format!("{} is damaged: its CRC-32C is another", self.grid.words(at))),
        }
    }
}

/// `out.len()` bytes from `from` on of a chunk of `whole` bytes; says whether it is such a chunk.
fn decode(packed: &[u8], from: usize, whole: usize, out: &mut [u8]) -> bool {
    let Ok(mut decompressor) = zstd::bulk::Decompressor::new() else { return false };
    if out.len() == whole {
        return decompressor.decompress_to_buffer(packed, out).is_ok_and(|n| n == whole);
    }
    // Some rows of it, or the last chunk of a line, which goes on beyond it.
    let all = decompressor.decompress(packed, whole).ok().filter(|all| all.len() == whole);
    let part = all.as_ref().and_then(|all| all.get(from..)?.get(..out.len()));
    part.inspect(|part| out.copy_from_slice(part)).is_some()
}

#[cfg(test)]
mod tests {
    use super::super::store::tests::header;
    use super::super::{MatrixReader, MatrixWriter, RowBlock};

    const POINTS: [usize; 2] = [11, 2];
    const WINDOW: [usize; 2] = [221, 223];

    /// Rows of 0.6 MB: chunks of six, of which the second goes on beyond a line of eleven.
    fn rows(range: std::ops::Range<usize>) -> RowBlock {
        let n = 3 * WINDOW[0] * WINDOW[1];
        let value = |k: usize| ((k * 7919) % 10_007) as f32 * 0.25 - 300.0;
        let (first, rows) = (range.start, range.len());
        let numbers = first * n..(first + rows) * n;
        let valid: Vec<u8> = numbers.clone().map(|k| u8::from(!k.is_multiple_of(5))).collect();
        let measured = |v: f32, k: usize| if k.is_multiple_of(5) { 0.0 } else { v };
        let response = numbers.clone().map(|k| measured(value(k), k)).collect();
        let variance = numbers.map(|k| measured(value(k).abs(), k)).collect();
        RowBlock { first, rows, response, variance, valid }
    }

    #[test]
    fn whole_and_cut_chunks_are_read_as_they_were_made() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let header = header(POINTS, WINDOW);
        MatrixWriter::create(&path, header).unwrap().finish_with(|range| Ok(rows(range))).unwrap();
        let reader = MatrixReader::open(&path).unwrap();
        // All chunks; one that is padded; parts of two.
        for range in [0..22, 6..11, 17..22, 3..8, 10..13] {
            let (found, made) = (reader.read(range.clone()).unwrap(), rows(range.clone()));
            assert!(found.response == made.response && found.variance == made.variance, "{range:?}");
            assert!(found.valid == made.valid, "{range:?}");
            let light = reader.read_responses(range.clone()).unwrap();
            assert!(light.response == made.response && light.variance.is_empty(), "{range:?}");
        }
        // The blocks share their memory.
        let mut all = Vec::new();
        let keep = |block: &RowBlock| {
            all.extend_from_slice(&block.response);
            assert!(block.variance.is_empty());
            Ok(())
        };
        reader.for_each_block_of_responses(keep).unwrap();
        assert!(all == rows(0..22).response);
    }

    #[test]
    fn rows_that_do_not_fit_the_matrix_are_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let header = header([2, 1], [3, 1]);
        let short = |range: std::ops::Range<usize>| {
            let n = range.len();
            Ok(RowBlock {
                first: range.start,
                rows: n,
                response: vec![0.0; 8],
                variance: vec![],
                valid: vec![0; 9 * n],
            })
        };
        assert!(matches!(
            MatrixWriter::create(&path, header).unwrap().finish_with(short),
            Err(crate::Error::Internal { .. })
        ));
        assert!(!path.exists());
    }
}
