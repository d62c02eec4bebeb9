//! Arrays of an NPZ archive.

use super::{Array, Arrays, count, refused};
use crate::npy::NpyHeader;
use crate::{Error, Result};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use zip::{ZipArchive, result::ZipError};

/// An archive that is open.
pub(super) struct Archive {
    path: PathBuf,
    zip: ZipArchive<BufReader<File>>,
}

impl Archive {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let file = crate::files::open_local(path).map_err(Error::io("read", path))?;
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
        let header = NpyHeader::read(&mut entry).map_err(|reason| broken(&reason))?;
        if !header.is_float() {
            return Err(broken(&format_args!("numbers of type {} (float32 or float64 are read)", header.kind)));
        }
        let len = count(path, name, &header.shape, most)?;
        let shape: Vec<usize> = header.shape.iter().map(|&n| n as usize).collect();
        let values = header.numbers(&mut entry, len, |v| v).map_err(|reason| broken(&reason))?;
        Ok(Some(Array { shape, values }))
    }

    fn blake3(&mut self) -> Result<String> {
        let file = crate::files::open_local(&self.path).map_err(Error::io("read", &self.path))?;
        let mut hasher = blake3::Hasher::new();
        hasher.update_reader(file).map_err(Error::io("read", &self.path))?;
        Ok(hasher.finalize().to_string())
    }
}
