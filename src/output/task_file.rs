//! What tasks hand to each other in files.
//!
//! | bytes | what |
//! |---|---|
//! | 16 | what the file is |
//! | to the end, less 32 | a value as CBOR |
//! | 32 | BLAKE3 of all before it |

use super::unlocked::write_in_place;
use crate::{Error, Result};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// A file that tasks read, in memory.
#[derive(Debug)]
pub(crate) struct TaskFile(Vec<u8>);

impl TaskFile {
    /// Of a value.
    pub(crate) fn new(head: &[u8; 16], value: &impl Serialize) -> Result<Self> {
        let mut bytes = head.to_vec();
        ciborium::into_writer(value, &mut bytes).map_err(Error::internal)?;
        bytes.extend(blake3::hash(&bytes).as_bytes());
        Ok(Self(bytes))
    }

    /// Reads one; the error says what is there instead.
    pub(crate) fn read(path: &Path, head: &[u8; 16]) -> Result<Result<Self, &'static str>> {
        let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
        if !bytes.starts_with(head) {
            return Ok(Err("something else"));
        }
        let file = Self(bytes);
        let text = file.0.len().checked_sub(32).filter(|end| *end >= head.len());
        let whole = text.is_some_and(|end| blake3::hash(&file.0[..end]).as_bytes()[..] == file.0[end..]);
        Ok(if whole { Ok(file) } else { Err("a damaged one") })
    }

    /// The value; the error is that of a file which another version has written.
    pub(crate) fn value<T: DeserializeOwned>(&self) -> Result<T, String> {
        ciborium::from_reader(&self.0[16..self.0.len() - 32]).map_err(|e| e.to_string())
    }

    /// The BLAKE3 at its end.
    pub(crate) fn key(&self) -> String {
        self.0[self.0.len() - 32..].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// Puts it into its place; its length.
    pub(crate) fn write(&self, path: &Path) -> Result<u64> {
        write_in_place(path, &self.0)?;
        Ok(self.0.len() as u64)
    }
}

/// Numbers as their bytes (`#[serde(with = "numbers")]`): CBOR has a byte more for each, and takes a call for each.
/// Files are of one byte order, that of the machine; another reads numbers that fit nothing.
pub(crate) mod numbers {
    use bytemuck::{AnyBitPattern, NoUninit};
    use serde::{Deserializer, Serializer, de};

    pub(crate) fn serialize<T: NoUninit, S: Serializer>(numbers: &[T], to: S) -> Result<S::Ok, S::Error> {
        to.serialize_bytes(bytemuck::cast_slice(numbers))
    }

    pub(crate) fn deserialize<'de, T: AnyBitPattern, D: Deserializer<'de>>(from: D) -> Result<Vec<T>, D::Error> {
        struct Bytes<T>(std::marker::PhantomData<T>);
        impl<T: AnyBitPattern> de::Visitor<'_> for Bytes<T> {
            type Value = Vec<T>;

            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("numbers as bytes")
            }

            fn visit_bytes<E: de::Error>(self, bytes: &[u8]) -> Result<Vec<T>, E> {
                let whole = bytes.chunks_exact(size_of::<T>());
                if !whole.remainder().is_empty() {
                    return Err(E::invalid_length(bytes.len(), &self));
                }
                Ok(whole.map(bytemuck::pod_read_unaligned).collect())
            }
        }
        from.deserialize_byte_buf(Bytes(std::marker::PhantomData))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    const HEAD: &[u8; 16] = b"acquire test 1\n\0";

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Value {
        #[serde(with = "numbers")]
        wide: Vec<f64>,
        #[serde(with = "numbers")]
        pairs: Vec<[i16; 2]>,
    }

    #[test]
    fn a_value_comes_back_bit_by_bit_and_no_byte_may_be_another() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a");
        let wide: Vec<f64> = (0..5000).map(|k| (k as f64).sin() * 10.0_f64.powi(k % 300 - 150)).collect();
        let value = Value { wide, pairs: vec![[1, -2], [i16::MIN, i16::MAX]] };
        let file = TaskFile::new(HEAD, &value).unwrap();
        let bytes = file.write(&path).unwrap();
        // A number takes its own bytes, and nothing besides.
        assert!(bytes < 16 + 32 + 8 * 5000 + 8 + 40, "{bytes}");
        let read = || TaskFile::read(&path, HEAD).unwrap();
        let back = read().unwrap();
        assert_eq!((back.value::<Value>().unwrap(), back.key()), (value, file.key()));
        assert_eq!(TaskFile::read(&path, b"acquire other 1\n").unwrap().unwrap_err(), "something else");
        let whole = std::fs::read(&path).unwrap();
        for at in [16, 20_000, whole.len() - 40, whole.len() - 1] {
            let mut bad = whole.clone();
            bad[at] ^= 1;
            std::fs::write(&path, bad).unwrap();
            assert_eq!(read().unwrap_err(), "a damaged one", "byte {at}");
        }
        for length in [16, 40, whole.len() - 1] {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert_eq!(read().unwrap_err(), "a damaged one", "{length} bytes");
        }
    }
}
