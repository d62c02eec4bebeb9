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
//! Of two tasks that write the same part the last one stays ([`Unlocked`]).

use super::positioned::{read_exact_at, write_all_at};
use super::store::Row;
use crate::output::{Unlocked, begins_with, check_by_head, checked_lines, is_unfinished, write_line};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What a part begins with.
const HEAD: &[u8; 16] = b"acquire part 1\n\0";
/// What a whole one ends with.
const TAIL: &[u8; 8] = b"\npart 1\n";

/// Refuses a place where a part cannot go: a folder that is not there, a file that is no part.
///
/// # Errors
/// [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn check_part(path: &Path) -> Result<()> {
    check_by_head(path, HEAD)
}

/// Writes a part; rows come in any order from any thread.
#[derive(Debug)]
pub(crate) struct PartWriter {
    path: PathBuf,
    file: Unlocked,
    row_bytes: usize,
    /// The place of each row in the file.
    places: BTreeMap<usize, usize>,
}

impl PartWriter {
    /// Begins the part `path` of the rows `rows`, which lie in the file in this order, of `row_len` numbers each.
    ///
    /// # Errors
    /// Those of [`check_part`].
    pub(crate) fn create(path: &Path, rows: impl IntoIterator<Item = usize>, row_len: usize) -> Result<Self> {
        check_part(path)?;
        let file = Unlocked::create(path)?;
        write_all_at(file.file(), HEAD, 0).map_err(Error::io("create", path))?;
        let places = rows.into_iter().enumerate().map(|(place, row)| (row, place)).collect();
        Ok(Self { path: path.to_path_buf(), file, row_bytes: 9 * row_len, places })
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
                write_all_at(self.file.file(), &bytes, at).map_err(Error::io("write", &self.path))
            }
            _ => Err(Error::internal(format_args!("row {index} does not fit the part"))),
        }
    }

    /// Writes the text, a line for each of `lines`, and puts the part into its place.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn finish<'a, T: Serialize + 'a>(
        self,
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
        let end = (HEAD.len() + self.places.len() * self.row_bytes) as u64;
        write_all_at(self.file.file(), &text, end).map_err(Error::io("write", &self.path))?;
        self.file.finish()
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
    /// Opens a part and reads its undamaged lines. The error says why the file is not a part.
    pub(crate) fn open(path: &Path) -> Result<(Self, Vec<Vec<u8>>), String> {
        if !begins_with(path, HEAD) {
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
            match is_unfinished(&name) {
                true => unfinished += 1,
                false if entry.extension().is_some_and(|e| e == "part") => parts.push(entry),
                false => {}
            }
        }
        parts[first..].sort();
    }
    Ok((parts, unfinished))
}
