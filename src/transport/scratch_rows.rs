//! Rows that wait for the others of their chunk.

use super::part::RowsAt;
use super::positioned::{read_exact_at, write_all_at};
use super::store::{Row, RowBlock};
use crate::output::ScratchFolder;
use crate::{Error, Result};
use std::fs::File;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// The file of rows in a scratch folder.
const ROWS: &str = "rows";

/// Uncompressed rows, in any order, from any thread: a lattice shot lights points all over the slab.
#[derive(Debug)]
pub(super) struct ScratchRows {
    /// As they were put; they outlive the run.
    put: Arc<File>,
    /// Those in the place of others.
    replaced: File,
    /// A lock a row: threads that put rows never wait for each other.
    state: Vec<Mutex<State>>,
    row_len: usize,
}

#[derive(Debug, Clone)]
enum State {
    Missing,
    Put,
    Replaced,
    /// In the file of a task that has measured it, from this byte on.
    InPart(Arc<File>, u64),
}

impl ScratchRows {
    /// For `rows` rows of `row_len` numbers in a scratch folder; rows that an earlier run has put there can be adopted.
    pub(super) fn new(folder: &ScratchFolder, rows: usize, row_len: usize) -> io::Result<Self> {
        let path = folder.path().join(ROWS);
        let put = File::options().create(true).truncate(false).read(true).write(true).open(path)?;
        let replaced = tempfile::tempfile_in(folder.path())?;
        let state = (0..rows).map(|_| Mutex::new(State::Missing)).collect();
        Ok(Self { put: Arc::new(put), replaced, state, row_len })
    }

    fn bytes(&self) -> usize {
        9 * self.row_len
    }

    /// Keeps a row; `replaces` one that was put and stays in its file.
    ///
    /// # Errors
    /// [`Error::Io`] for `path`; [`Error::Internal`] when the row has another length, or a value is not finite.
    pub(super) fn put(&self, index: usize, row: &Row, replaces: bool, path: &Path) -> Result<()> {
        let n = self.row_len;
        if index >= self.state.len() || [row.response.len(), row.variance.len(), row.valid.len()] != [n; 3] {
            return Err(Error::internal(format_args!("row {index} does not fit the matrix")));
        }
        if let Some(value) = row.response.iter().chain(&row.variance).find(|v| !v.is_finite()) {
            return Err(Error::internal(format_args!("row {index} holds {value}")));
        }
        let (file, state) = if replaces { (&self.replaced, State::Replaced) } else { (&*self.put, State::Put) };
        write_all_at(file, &row.bytes(), (index * self.bytes()) as u64).map_err(Error::io("write", path))?;
        *self.state[index].lock().unwrap_or_else(PoisonError::into_inner) = state;
        Ok(())
    }

    /// The row that was put last.
    ///
    /// # Errors
    /// [`Error::Io`] for `path`; [`Error::Internal`] when there is none.
    pub(super) fn row(&self, index: usize, path: &Path) -> Result<Row> {
        if matches!(self.state(index), State::Missing) {
            return Err(Error::internal(format_args!("row {index} has not been put")));
        }
        let mut block = RowBlock::zeros(index..index + 1, self.row_len);
        self.read(index, &mut block, 0).map_err(Error::io("read", path))?;
        let RowBlock { response, variance, valid, .. } = block;
        Ok(Row { response, variance, valid: valid.into_iter().map(|v| v != 0).collect() })
    }

    /// Takes rows that an earlier run has put for its own if together they have this BLAKE3; says whether they have.
    pub(super) fn adopt(&self, indices: &[usize], hash: &blake3::Hash) -> bool {
        let mut found = blake3::Hasher::new();
        let mut bytes = vec![0; self.bytes()];
        for &index in indices {
            if read_exact_at(&self.put, &mut bytes, (index * self.bytes()) as u64).is_err() {
                return false;
            }
            found.update(&bytes);
        }
        found.finalize() == *hash && self.set(indices, |_| State::Put)
    }

    /// [`Self::adopt`] of rows that a task has measured; they stay where they are.
    pub(super) fn adopt_part(&self, indices: &[usize], hash: &blake3::Hash, rows: &RowsAt) -> bool {
        rows.hash(indices.len()).is_ok_and(|found| found == *hash)
            && self.set(indices, |k| State::InPart(rows.file.clone(), rows.offset + (k * self.bytes()) as u64))
    }

    /// Says where rows are, if there are such rows.
    fn set(&self, indices: &[usize], of: impl Fn(usize) -> State) -> bool {
        let all = indices.iter().all(|&index| index < self.state.len());
        if all {
            for (k, &index) in indices.iter().enumerate() {
                *self.state[index].lock().unwrap_or_else(PoisonError::into_inner) = of(k);
            }
        }
        all
    }

    /// Rows in one block, those that were never put invalid throughout.
    pub(super) fn block(&self, rows: std::ops::Range<usize>) -> io::Result<RowBlock> {
        let mut block = RowBlock::zeros(rows.clone(), self.row_len);
        for (k, row) in rows.enumerate() {
            if !matches!(self.state(row), State::Missing) {
                self.read(row, &mut block, k)?;
            }
        }
        Ok(block)
    }

    fn state(&self, index: usize) -> State {
        let state = self.state.get(index).map(|state| state.lock().unwrap_or_else(PoisonError::into_inner).clone());
        state.unwrap_or(State::Missing)
    }

    fn read(&self, index: usize, block: &mut RowBlock, k: usize) -> io::Result<()> {
        let (n, mut bytes) = (self.row_len, vec![0; self.bytes()]);
        let at = (index * self.bytes()) as u64;
        match self.state(index) {
            State::Replaced => read_exact_at(&self.replaced, &mut bytes, at)?,
            State::InPart(file, at) => read_exact_at(&file, &mut bytes, at)?,
            _ => read_exact_at(&self.put, &mut bytes, at)?,
        }
        let (values, valid) = bytes.split_at(8 * n);
        let floats = values.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
        for (i, value) in floats.enumerate() {
            let target = if i < n { &mut block.response } else { &mut block.variance };
            target[k * n + i % n] = value;
        }
        block.valid[k * n..(k + 1) * n].copy_from_slice(valid);
        Ok(())
    }
}

impl Row {
    /// As it waits in a file; what [`ScratchRows::adopt`] hashes.
    pub(crate) fn bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(9 * self.response.len());
        self.response.iter().chain(&self.variance).for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        bytes.extend(self.valid.iter().map(|&v| u8::from(v)));
        bytes
    }
}
