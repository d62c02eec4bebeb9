//! Parts: files of rows that one task of many has measured, with lines of text about them.
//!
//! | bytes | what |
//! |---|---|
//! | 16 | [`HEAD`] |
//! | rows × 9 × row length | rows as they wait in a scratch file ([`Row::bytes`]), by their places |
//! | to the end, less 16 | the text, a line each with its BLAKE3 before it ([`crate::output::WorkLog`]) |
//! | 8 | length of the text, little-endian |
//! | 8 | [`TAIL`] |
//!
//! A part is written under a name of its own and takes its place in one step: tasks need no lock, which shared file
//! systems often have not, and of two that write the same part the last one stays. Nothing removes what a killed task
//! has left but who removes the folder.

use super::positioned::{read_exact_at, write_all_at};
use super::store::Row;
use crate::output::{Unfinished, checked_lines, write_line};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What a part begins with.
const HEAD: &[u8; 16] = b"acquire part 1\n\0";
/// What a whole one ends with.
const TAIL: &[u8; 8] = b"\npart 1\n";
/// The name of one that is not whole: the part's name and six letters or digits between these.
const UNFINISHED: [&str; 2] = [".", ".unfinished"];

/// Refuses a place where a part cannot go: a folder that is not there, a file that is no part.
///
/// # Errors
/// [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn check_part(path: &Path) -> Result<()> {
    let folder = folder_of(path);
    if !folder.is_dir() {
        return Err(Error::io("create", path)(std::io::ErrorKind::NotFound.into()));
    }
    match path.symlink_metadata() {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(Error::io("create", path)(e)),
        Ok(kind) if kind.is_file() && is_part(path) => Ok(()),
        Ok(_) => Err(Error::NotOurs { path: path.to_path_buf() }),
    }
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Whether a file begins as parts do.
fn is_part(path: &Path) -> bool {
    let mut head = [0; HEAD.len()];
    File::open(path).and_then(|mut file| file.read_exact(&mut head)).is_ok() && head == *HEAD
}

/// Writes a part; rows come in any order from any thread.
#[derive(Debug)]
pub(crate) struct PartWriter {
    path: PathBuf,
    file: tempfile::NamedTempFile,
    row_bytes: usize,
    /// The place of each row in the file.
    places: BTreeMap<usize, usize>,
    _unfinished: Unfinished,
}

impl PartWriter {
    /// Begins the part `path` of the rows `rows`, which lie in the file in this order, of `row_len` numbers each.
    ///
    /// # Errors
    /// Those of [`check_part`].
    pub(crate) fn create(path: &Path, rows: impl IntoIterator<Item = usize>, row_len: usize) -> Result<Self> {
        check_part(path)?;
        let failed = |e| Error::io("create", path)(e);
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let prefix = format!("{}{name}.", UNFINISHED[0]);
        let mut named = tempfile::Builder::new();
        named.prefix(&prefix).suffix(UNFINISHED[1]);
        // As any file that is made here: temporary ones are their owner's alone.
        #[cfg(unix)]
        named.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let file = named.tempfile_in(folder_of(path)).map_err(failed)?;
        let _unfinished = Unfinished::new(file.path());
        write_all_at(file.as_file(), HEAD, 0).map_err(failed)?;
        let places = rows.into_iter().enumerate().map(|(place, row)| (row, place)).collect();
        Ok(Self { path: path.to_path_buf(), file, row_bytes: 9 * row_len, places, _unfinished })
    }

    /// Keeps row `index`.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Internal`] for a row that the part has not, or of another length.
    pub(crate) fn put(&self, index: usize, row: &Row) -> Result<()> {
        let bytes = row.bytes();
        match self.places.get(&index) {
            Some(place) if bytes.len() == self.row_bytes => {
                let at = (HEAD.len() + place * self.row_bytes) as u64;
                write_all_at(self.file.as_file(), &bytes, at).map_err(Error::io("write", &self.path))
            }
            _ => Err(Error::internal(format_args!("row {index} does not fit the part"))),
        }
    }

    /// Writes the text, a line for each of `lines`, and puts the part into its place.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn finish<'a, T: Serialize + 'a>(
        mut self,
        first: &impl Serialize,
        lines: impl IntoIterator<Item = &'a T>,
    ) -> Result<()> {
        let mut text = Vec::new();
        write_line(&mut text, &serde_json::to_vec(first).map_err(Error::internal)?).map_err(Error::internal)?;
        for line in lines {
            write_line(&mut text, &serde_json::to_vec(line).map_err(Error::internal)?).map_err(Error::internal)?;
        }
        let length = text.len() as u64;
        text.extend(length.to_le_bytes());
        text.extend(TAIL);
        let failed = |e| Error::io("write", &self.path)(e);
        let end = (HEAD.len() + self.places.len() * self.row_bytes) as u64;
        self.file.as_file_mut().seek(SeekFrom::Start(end)).map_err(failed)?;
        self.file.as_file_mut().write_all(&text).map_err(failed)?;
        self.file.as_file().sync_all().map_err(failed)?;
        self.file.persist(&self.path).map_err(|e| failed(e.error))?;
        Ok(())
    }
}

/// A whole part.
#[derive(Debug)]
pub(crate) struct Part {
    file: Arc<File>,
}

/// Rows in a part, one after the other from a place on.
#[derive(Debug, Clone)]
pub(crate) struct RowsAt {
    pub(super) file: Arc<File>,
    pub(super) offset: u64,
    row_bytes: usize,
}

impl RowsAt {
    /// The BLAKE3 of the first `rows` of them.
    pub(crate) fn hash(&self, rows: usize) -> std::io::Result<blake3::Hash> {
        let (mut hasher, mut bytes) = (blake3::Hasher::new(), vec![0; self.row_bytes]);
        for k in 0..rows {
            read_exact_at(&self.file, &mut bytes, self.offset + (k * self.row_bytes) as u64)?;
            hasher.update(&bytes);
        }
        Ok(hasher.finalize())
    }
}

impl Part {
    /// Opens a part, and reads its lines that are not damaged; says why it is none.
    pub(crate) fn open(path: &Path) -> Result<(Self, Vec<Vec<u8>>), String> {
        if !is_part(path) {
            return Err("it is no part".into());
        }
        let mut file = File::open(path).map_err(|e| e.to_string())?;
        let mut end = [0; 8 + TAIL.len()];
        let whole = file.seek(SeekFrom::End(-(end.len() as i64))).and_then(|at| file.read_exact(&mut end).map(|()| at));
        let (length, tail) = end.split_at(8);
        let length = u64::from_le_bytes(length.try_into().unwrap_or_default());
        let start = whole.ok().filter(|_| tail == TAIL).and_then(|at| at.checked_sub(length));
        let Some(start) = start.filter(|start| *start >= HEAD.len() as u64) else {
            return Err("it is cut short".into());
        };
        let mut text = Vec::new();
        let read = file.seek(SeekFrom::Start(start)).and_then(|_| (&mut file).take(length).read_to_end(&mut text));
        read.map_err(|e| e.to_string())?;
        let lines = checked_lines(&text).map(<[u8]>::to_vec).collect();
        Ok((Self { file: Arc::new(file) }, lines))
    }

    /// Its rows from the place `place` on, of `row_len` numbers each.
    pub(crate) fn rows_at(&self, place: usize, row_len: usize) -> RowsAt {
        let row_bytes = 9 * row_len;
        RowsAt { file: self.file.clone(), offset: (HEAD.len() + place * row_bytes) as u64, row_bytes }
    }
}

/// The parts among `paths`: files as they are, of folders all `*.part`, and how many files stopped tasks have left
/// there.
///
/// # Errors
/// [`Error::Io`] for a path that is not there.
pub(crate) fn find_parts(paths: &[PathBuf]) -> Result<(Vec<PathBuf>, usize)> {
    let (mut parts, mut unfinished) = (Vec::new(), 0);
    for path in paths {
        let kind = std::fs::metadata(path).map_err(Error::io("read", path))?;
        if !kind.is_dir() {
            parts.push(path.clone());
            continue;
        }
        let first = parts.len();
        for entry in std::fs::read_dir(path).map_err(Error::io("read", path))? {
            let entry = entry.map_err(Error::io("read", path))?.path();
            let name = entry.file_name().unwrap_or_default().to_string_lossy();
            match name.starts_with(UNFINISHED[0]) && name.ends_with(UNFINISHED[1]) {
                true => unfinished += 1,
                false if entry.extension().is_some_and(|e| e == "part") => parts.push(entry),
                false => {}
            }
        }
        parts[first..].sort();
    }
    Ok((parts, unfinished))
}
