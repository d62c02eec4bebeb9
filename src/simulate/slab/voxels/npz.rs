//! Arrays of an NPZ archive.
//!
//! The header of an array is read here rather than by `npyz`, whose parser trusts its sizes.

use super::{Array, Arrays, count, refused};
use crate::{Error, Result};
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use zip::{ZipArchive, result::ZipError};

/// The longest header of an array that is read, bytes; NumPy writes 128.
const LONGEST_HEADER: usize = 4096;

/// An archive that is open.
pub(super) struct Archive {
    path: PathBuf,
    zip: ZipArchive<BufReader<File>>,
}

impl Archive {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = crate::files::open(path).map_err(Error::io("read", path))?;
        let broken = |e: ZipError| refused(path, "archive", "an NPZ archive or a Zarr group", e);
        Ok(Self { path: path.to_path_buf(), zip: ZipArchive::new(BufReader::new(file)).map_err(broken)? })
    }
}

impl Arrays for Archive {
    fn array(&mut self, name: &str, most: usize) -> Result<Option<Array>> {
        let path = &self.path;
        let broken = |reason: &dyn std::fmt::Display| refused(path, name, "a whole NumPy array", reason);
        let mut entry = match self.zip.by_name(&format!("{name}.npy")) {
            Ok(entry) => entry,
            Err(ZipError::FileNotFound) => return Ok(None),
            Err(e) => return Err(broken(&e)),
        };
        let header = Header::read(&mut entry).map_err(|reason| broken(&reason))?;
        let len = count(path, name, &header.shape, most)?;
        let shape: Vec<usize> = header.shape.iter().map(|&n| n as usize).collect();
        let mut values = Vec::new();
        // Grows with what is really there: a header may promise more.
        let mut chunk = vec![0u8; (1 << 16) * header.bytes];
        while values.len() < len {
            let wanted = (len - values.len()).min(1 << 16) * header.bytes;
            entry.read_exact(&mut chunk[..wanted]).map_err(|e| broken(&e))?;
            values.extend(chunk[..wanted].chunks_exact(header.bytes).map(|b| header.number(b)));
        }
        // To the end, so that the archive's checksum is checked.
        let rest = std::io::copy(&mut entry.take(1), &mut std::io::sink()).map_err(|e| broken(&e))?;
        if rest > 0 {
            return Err(broken(&format_args!("more than the {len} numbers of its shape")));
        }
        let values = if header.fortran_order { c_order(&shape, &values) } else { values };
        Ok(Some(Array { shape, values }))
    }

    fn blake3(&mut self) -> Result<String> {
        let file = crate::files::open(&self.path).map_err(Error::io("read", &self.path))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(file).map_err(Error::io("read", &self.path))?;
        Ok(hasher.finalize().to_string())
    }
}

/// What stands before the numbers (NumPy Enhancement Proposal 1).
struct Header {
    shape: Vec<u64>,
    fortran_order: bool,
    /// Bytes of a number: 4 or 8.
    bytes: usize,
    big_endian: bool,
}

impl Header {
    fn read(reader: &mut impl Read) -> Result<Self, String> {
        let mut bytes = |n: usize| {
            let mut buffer = vec![0u8; n];
            reader.read_exact(&mut buffer).map(|()| buffer).map_err(|e| e.to_string())
        };
        let start = bytes(8)?;
        if &start[..6] != b"\x93NUMPY" {
            return Err("no NumPy array".into());
        }
        let len = match start[6] {
            1 => bytes(2)?.iter().rev().fold(0, |n, b| n << 8 | usize::from(*b)),
            2 | 3 => bytes(4)?.iter().rev().fold(0, |n, b| n << 8 | usize::from(*b)),
            version => return Err(format!("version {version} of the NumPy format")),
        };
        if len > LONGEST_HEADER {
            return Err(format!("a header of {len} bytes"));
        }
        Self::parse(&String::from_utf8_lossy(&bytes(len)?))
    }

    /// Reads `{'descr': '<f8', 'fortran_order': False, 'shape': (2, 3), }`.
    fn parse(text: &str) -> Result<Self, String> {
        let after = |key: &str| {
            let (_, rest) = text.split_once(&format!("'{key}':")).ok_or_else(|| format!("no {key} in its header"))?;
            Ok::<_, String>(rest.trim_start())
        };
        let (big_endian, bytes) = match after("descr")?.split(['\'', '"']).nth(1) {
            Some("<f4") => (false, 4),
            Some("<f8") => (false, 8),
            Some(">f4") => (true, 4),
            Some(">f8") => (true, 8),
            other => return Err(format!("numbers of type {} (float32 or float64 are read)", other.unwrap_or("?"))),
        };
        let shape = after("shape")?.strip_prefix('(').and_then(|rest| rest.split(')').next()).ok_or("no shape")?;
        let sides = shape.split(',').map(str::trim).filter(|side| !side.is_empty());
        let shape: Vec<u64> =
            sides.map(|side| side.parse()).collect::<Result<_, _>>().map_err(|_| format!("shape ({shape})"))?;
        Ok(Self { shape, fortran_order: after("fortran_order")?.starts_with("True"), bytes, big_endian })
    }

    fn number(&self, bytes: &[u8]) -> f64 {
        let mut raw = [0u8; 8];
        for (i, b) in bytes.iter().enumerate() {
            raw[if self.big_endian { bytes.len() - 1 - i } else { i }] = *b;
        }
        match self.bytes {
            4 => f64::from(f32::from_le_bytes([raw[0], raw[1], raw[2], raw[3]])),
            _ => f64::from_le_bytes(raw),
        }
    }
}

/// Values whose first axis runs fastest, in C order.
fn c_order(shape: &[usize], values: &[f64]) -> Vec<f64> {
    let place = |i: usize| {
        let (mut rest, mut strides) = (i, values.len());
        let mut place = 0;
        for n in shape.iter().rev() {
            strides /= n;
            place += rest % n * strides;
            rest /= n;
        }
        place
    };
    (0..values.len()).map(|i| values[place(i)]).collect()
}
