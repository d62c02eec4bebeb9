//! Files that people name, on disks and in object stores, opened only where they are files.

#[cfg_attr(not(feature = "cloud"), expect(unreachable_code, reason = "there are no objects"))]
mod object_file;
#[cfg_attr(feature = "cloud", path = "objects.rs")]
#[cfg_attr(not(feature = "cloud"), path = "no_objects.rs")]
mod objects;

pub(crate) use objects::Objects;

use object_file::{ObjectFile, hash_object};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Whether a path names a place in an object store.
pub(crate) fn is_url(path: &Path) -> bool {
    let schemes = ["s3://", "gs://", "https://", "http://"];
    path.to_str().is_some_and(|path| schemes.iter().any(|scheme| path.starts_with(scheme)))
}

/// Refuses a place in an object store, for what is written or read on disks only.
///
/// # Errors
/// [`crate::Error::NotLocal`].
pub(crate) fn check_local(path: &Path) -> crate::Result<()> {
    if is_url(path) { Err(crate::Error::NotLocal { path: path.to_path_buf() }) } else { Ok(()) }
}

/// All files below a folder and their lengths, bytes: by their names from there, `/` between folders.
///
/// # Errors
/// Those of reading the folders.
pub(crate) fn below(folder: &Path) -> Result<BTreeMap<String, u64>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![(folder.to_path_buf(), String::new())];
    while let Some((folder, before)) = folders.pop() {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let name = format!("{before}{}", entry.file_name().to_string_lossy());
            match entry.file_type()?.is_dir() {
                true => folders.push((entry.path(), name + "/")),
                false => drop(files.insert(name, entry.metadata()?.len())),
            }
        }
    }
    Ok(files)
}

/// Refuses a place in an object store in a program that knows none.
///
/// # Errors
/// [`crate::Error::NeedsFeature`]; [`crate::Error::Io`] for a URL that cannot be used.
pub(crate) fn check_readable(path: &Path) -> crate::Result<()> {
    if is_url(path) { Objects::open(path).map(|_| ()) } else { Ok(()) }
}

/// The object that a URL names.
fn object(path: &Path) -> Result<Objects> {
    Objects::open(path).map_err(|e| match e {
        crate::Error::Io { source, .. } => source,
        other => Error::new(ErrorKind::Unsupported, other.to_string()),
    })
}

/// A file that is open for reading.
#[derive(Debug)]
pub(crate) enum File {
    /// On a disk.
    Local(std::fs::File),
    /// In an object store.
    Object(Box<ObjectFile>),
}

impl File {
    /// Its length, bytes.
    ///
    /// # Errors
    /// Those of the system.
    pub(crate) fn len(&self) -> Result<u64> {
        match self {
            Self::Local(file) => Ok(file.metadata()?.len()),
            Self::Object(object) => Ok(object.len()),
        }
    }
}

impl Read for File {
    fn read(&mut self, out: &mut [u8]) -> Result<usize> {
        match self {
            Self::Local(file) => file.read(out),
            Self::Object(object) => object.read(out),
        }
    }
}

impl Seek for File {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        match self {
            Self::Local(file) => file.seek(to),
            Self::Object(object) => object.seek(to),
        }
    }
}

/// What tells, without reading it, whether a file is the one that it was.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct FileState {
    /// Its length.
    pub bytes: u64,
    /// Its last change, ns since 1970.
    pub modified_ns: u64,
}

/// Length and time of the last change of a file.
///
/// # Errors
/// Those of the system or the store.
pub(crate) fn state(path: &Path) -> Result<FileState> {
    if is_url(path) {
        return object(path)?.state("");
    }
    let file = std::fs::metadata(path)?;
    let since = file.modified()?.duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    Ok(FileState { bytes: file.len(), modified_ns: since.as_nanos() as u64 })
}

/// Whether there is such a file.
///
/// # Errors
/// Those of the store, but for `NotFound`.
pub(crate) fn is_file(path: &Path) -> Result<bool> {
    if !is_url(path) {
        return Ok(path.is_file());
    }
    match object(path)?.state("") {
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(false),
        state => state.map(|_| true),
    }
}

/// Whether there is such a folder; object stores have none, and any place there may be one.
pub(crate) fn is_folder(path: &Path) -> bool {
    is_url(path) || path.is_dir()
}

/// The place that a path leads to from wherever it is read.
///
/// # Errors
/// Those of the system.
pub(crate) fn canonical(path: &Path) -> Result<PathBuf> {
    if is_url(path) { Ok(path.to_path_buf()) } else { path.canonicalize() }
}

/// Opens a file for reading.
///
/// # Errors
/// Those of [`open_local`] and of the store.
pub(crate) fn open(path: &Path) -> Result<File> {
    match is_url(path) {
        true => ObjectFile::open(path).map(|object| File::Object(Box::new(object))),
        false => open_local(path).map(File::Local),
    }
}

/// Opens a file on a disk for reading.
///
/// # Errors
/// Those of the system; `InvalidInput` for a pipe, a device or a folder: opening a pipe waits until somebody writes to
/// it, and a device has no end.
pub(crate) fn open_local(path: &Path) -> Result<std::fs::File> {
    let kind = std::fs::metadata(path)?;
    match kind.is_file() {
        true => std::fs::File::open(path),
        false if kind.is_dir() => Err(Error::new(ErrorKind::IsADirectory, "expected a file, found a folder")),
        false => Err(Error::new(ErrorKind::InvalidInput, "expected a file, found a pipe or a device")),
    }
}

/// BLAKE3 of a file, read piece by piece; of an object only what this process has not read yet.
///
/// # Errors
/// Those of [`open`].
pub(crate) fn hash(path: &Path) -> Result<blake3::Hash> {
    if is_url(path) {
        return hash_object(path);
    }
    let mut hasher = blake3::Hasher::new();
    hasher.update_reader(open_local(path)?)?;
    Ok(hasher.finalize())
}

/// All bytes of a file.
///
/// # Errors
/// Those of [`open`].
pub(crate) fn read(path: &Path) -> Result<Vec<u8>> {
    let mut file = open(path)?;
    let mut bytes = Vec::with_capacity(file.len()? as usize);
    file.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// All text of a file.
///
/// # Errors
/// Those of [`open`]; `InvalidData` when it is not UTF-8.
pub(crate) fn read_to_string(path: &Path) -> Result<String> {
    String::from_utf8(read(path)?).map_err(|_| Error::new(ErrorKind::InvalidData, "expected text in UTF-8"))
}
