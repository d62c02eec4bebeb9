//! Where measured rows go.

use super::resume::MeasuredShot;
use crate::output::{Earlier, WorkLog};
use crate::transport::{MatrixWriter, Row};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Takes rows in any order, from any thread, and gives them back.
pub(super) trait RowSink: Sync {
    /// Keeps row `index`, as it was measured.
    fn put(&self, index: usize, row: &Row) -> Result<()>;

    /// Keeps row `index` in the place of the measured one, which a later run can still go on from.
    fn replace(&self, index: usize, row: &Row) -> Result<()>;

    /// Row `index`, as it was kept last.
    fn row(&self, index: usize) -> Result<Row>;

    /// What a stopped run has measured with the same `key`, and where to add what this one has. Sinks in memory have
    /// neither.
    fn earlier(&self, key: &str) -> Result<Option<(WorkLog, Earlier<MeasuredShot>)>>;

    /// Takes measured rows of that run; says whether they are what it has written, by their BLAKE3.
    fn adopt(&self, indices: &[usize], hash: &blake3::Hash) -> bool;

    /// Refuses to go on where lattice shots are still to be measured, by their numbers in a sweep of `of`, which others
    /// should have measured.
    fn may_lack(&self, _lacking: &[usize], _of: usize) -> Result<()> {
        Ok(())
    }
}

impl RowSink for MatrixWriter {
    fn put(&self, index: usize, row: &Row) -> Result<()> {
        Self::put(self, index, row)
    }

    fn replace(&self, index: usize, row: &Row) -> Result<()> {
        Self::replace(self, index, row)
    }

    fn earlier(&self, key: &str) -> Result<Option<(WorkLog, Earlier<MeasuredShot>)>> {
        Self::earlier(self, key).map(Some)
    }

    fn adopt(&self, indices: &[usize], hash: &blake3::Hash) -> bool {
        Self::adopt(self, indices, hash)
    }

    fn row(&self, index: usize) -> Result<Row> {
        Self::row(self, index)
    }
}

/// Rows in memory, of a part of a capture.
#[derive(Debug, Default)]
pub(super) struct HeldRows(Mutex<BTreeMap<usize, Row>>);

impl HeldRows {
    fn rows(&self) -> std::sync::MutexGuard<'_, BTreeMap<usize, Row>> {
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl RowSink for HeldRows {
    fn put(&self, index: usize, row: &Row) -> Result<()> {
        self.rows().insert(index, row.clone());
        Ok(())
    }

    fn replace(&self, index: usize, row: &Row) -> Result<()> {
        self.put(index, row)
    }

    fn earlier(&self, _: &str) -> Result<Option<(WorkLog, Earlier<MeasuredShot>)>> {
        Ok(None)
    }

    fn adopt(&self, _: &[usize], _: &blake3::Hash) -> bool {
        false
    }

    fn row(&self, index: usize) -> Result<Row> {
        self.rows().get(&index).cloned().ok_or_else(|| Error::internal(format!("row {index} was not measured")))
    }
}
