//! Where measured rows go.

use crate::transport::{MatrixWriter, Row};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Takes rows in any order, from any thread, and gives them back.
pub(super) trait RowSink: Sync {
    /// Keeps row `index`, in the place of an earlier one.
    fn put(&self, index: usize, row: &Row) -> Result<()>;

    /// Row `index`, which was put before.
    fn row(&self, index: usize) -> Result<Row>;
}

impl RowSink for MatrixWriter {
    fn put(&self, index: usize, row: &Row) -> Result<()> {
        Self::put(self, index, row)
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

    fn row(&self, index: usize) -> Result<Row> {
        self.rows().get(&index).cloned().ok_or_else(|| Error::internal(format!("row {index} was not measured")))
    }
}
