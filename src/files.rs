//! Files that people name, opened only where they are files.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Error, ErrorKind, Read, Result};
use std::path::Path;

/// Whether a path names a place in an object store.
pub(crate) fn is_url(path: &Path) -> bool {
    let schemes = ["s3://", "gs://", "https://", "http://"];
    path.to_str().is_some_and(|path| schemes.iter().any(|scheme| path.starts_with(scheme)))
}

/// Refuses a place in an object store, for what is not a matrix.
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

/// Opens a file for reading.
///
/// # Errors
/// Those of the system; `InvalidInput` for a pipe, a device or a folder: opening a pipe waits until somebody writes to
/// it, and a device has no end.
pub(crate) fn open(path: &Path) -> Result<File> {
    let kind = std::fs::metadata(path)?;
    match kind.is_file() {
        true => File::open(path),
        false if kind.is_dir() => Err(Error::new(ErrorKind::IsADirectory, "expected a file, found a folder")),
        false => Err(Error::new(ErrorKind::InvalidInput, "expected a file, found a pipe or a device")),
    }
}

/// All bytes of a file.
///
/// # Errors
/// Those of [`open`].
pub(crate) fn read(path: &Path) -> Result<Vec<u8>> {
    let mut file = open(path)?;
    let mut bytes = Vec::with_capacity(file.metadata()?.len() as usize);
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
