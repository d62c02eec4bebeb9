//! Chunks as this program writes them, decoded into their place. The general way of the Zarr crate copies a chunk
//! three times, into memory that is new each time: of a matrix in memory that is two thirds of reading it.

use super::CHANNELS;
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::PathBuf;
use zarrs::array::Array;
use zarrs::filesystem::FilesystemStore;

/// Bytes of a CRC-32C.
const CHECKSUM: usize = 4;

/// An array whose chunks hold whole windows of lit points of one line, their numbers little-endian, compressed by zstd
/// and followed by their CRC-32C.
#[derive(Debug)]
pub(super) struct WholeChunks {
    /// Lit points of a line, and of a chunk.
    across: usize,
    side: usize,
    /// Bytes of a row.
    row_bytes: usize,
}

impl WholeChunks {
    /// `None` for an array with other chunks.
    pub(super) fn of(array: &Array<FilesystemStore>) -> Option<Self> {
        let metadata = serde_json::to_value(array.metadata()).ok()?;
        let names = metadata["codecs"].as_array()?.iter().map(|c| c.as_str().or_else(|| c["name"].as_str()));
        let little = metadata["codecs"][0]["configuration"]["endian"].as_str().is_none_or(|e| e == "little");
        let bytes = match metadata["data_type"].as_str()? {
            "float32" => 4,
            "uint8" => 1,
            _ => return None,
        };
        let shape: [u64; 5] = array.shape().try_into().ok()?;
        let chunk = array.chunk_shape(&[0; 5]).ok()?;
        let chunk: Vec<u64> = chunk.iter().map(|n| n.get()).collect();
        let whole = chunk[0] == 1 && chunk[2..] == shape[2..] && shape[4] == CHANNELS as u64;
        let ours = names.eq([Some("bytes"), Some("zstd"), Some("crc32c")]);
        if !(whole && little && ours && cfg!(target_endian = "little")) {
            return None;
        }
        let row = usize::try_from(shape[2] * shape[3] * shape[4]).ok()?;
        Some(Self {
            across: usize::try_from(shape[1]).ok()?,
            side: usize::try_from(chunk[1]).ok()?,
            row_bytes: row.checked_mul(bytes)?,
        })
    }

    /// Decodes the chunk that holds these rows and no others into `out`; false when there is none, or when it is not
    /// as it should be, for which the general way has the words.
    pub(super) fn read(&self, array: &Array<FilesystemStore>, rows: &Range<usize>, out: &mut [u8]) -> bool {
        let x = rows.start % self.across;
        let whole = x.is_multiple_of(self.side) && rows.len() == self.side.min(self.across - x);
        if !whole || out.len() != rows.len() * self.row_bytes {
            return false;
        }
        let key = array.chunk_key(&[(rows.start / self.across) as u64, (x / self.side) as u64, 0, 0, 0]);
        let path = array.storage().key_to_fspath(&key);
        decode(path, out, self.side * self.row_bytes).is_some()
    }
}

/// The first bytes of a chunk of `whole` bytes.
fn decode(path: PathBuf, out: &mut [u8], whole: usize) -> Option<()> {
    let mut file = File::open(path).ok()?;
    let len = usize::try_from(file.metadata().ok()?.len()).ok()?;
    // What does not compress is a thousandth longer.
    if len > whole + whole / 64 + 1024 {
        return None;
    }
    let mut encoded = Vec::with_capacity(len + 1);
    file.read_to_end(&mut encoded).ok()?;
    let (packed, checksum) = encoded.split_last_chunk::<CHECKSUM>()?;
    if crc32c::crc32c(packed).to_le_bytes() != *checksum {
        return None;
    }
    let mut decompressor = zstd::bulk::Decompressor::new().ok()?;
    if out.len() == whole {
        return (decompressor.decompress_to_buffer(packed, out).ok()? == whole).then_some(());
    }
    // The last chunk of a line goes on beyond it.
    let all = decompressor.decompress(packed, whole).ok()?;
    out.copy_from_slice(all.get(..out.len()).filter(|_| all.len() == whole)?);
    Some(())
}
