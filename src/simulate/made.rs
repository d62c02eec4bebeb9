//! What a stopped run has made of a capture: rows of the truth wait in the matrix's scratch folder, photographs are in
//! their place, and lines say which are whole.

use super::bench::{Bench, DotNoise};
use crate::output::{Earlier, WorkLog};
use crate::transport::MatrixWriter;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// How much of the work a stopped run had done.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TakenOver {
    /// Shots (with `truth_only` lit points) that were not made again.
    pub parts: usize,
    /// Whether there was such a run with other options or of another version: all was made anew.
    pub anew: bool,
}

/// A shot, or with the truth alone a dot: its photographs with their BLAKE3, that of its rows, and the noise of those.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Part {
    number: usize,
    photographs: Vec<(String, String)>,
    rows: String,
    noise: Vec<DotNoise>,
}

pub(super) struct Made {
    log: WorkLog,
    earlier: Mutex<BTreeMap<usize, Part>>,
    taken: AtomicUsize,
}

impl Made {
    pub(super) fn of(matrix: &MatrixWriter, key: &str) -> Result<Self> {
        let (log, earlier) = matrix.earlier::<Part>(key)?;
        let parts = if let Earlier::Finished(parts) = earlier { parts } else { vec![] };
        let earlier = Mutex::new(parts.into_iter().map(|p| (p.number, p)).collect());
        Ok(Self { log, earlier, taken: AtomicUsize::new(0) })
    }

    /// Takes part `number` over, if rows and photographs (`hashes` reads them) are what the stopped run has written;
    /// returns the photographs then.
    pub(super) fn take(
        &self,
        matrix: &MatrixWriter,
        bench: &Bench,
        number: usize,
        rows: &[usize],
        hashes: impl Fn() -> Result<Vec<(String, blake3::Hash)>>,
    ) -> Result<Option<Vec<(String, blake3::Hash)>>> {
        let Some(part) = self.earlier.lock().map_err(Error::internal)?.remove(&number) else { return Ok(None) };
        // A photograph that is gone is no error here: it is taken again.
        let found = hashes().ok().filter(|found| part.photographs == named(found));
        let same = found.is_some() && blake3::Hash::from_hex(&part.rows).is_ok_and(|hash| matrix.adopt(rows, &hash));
        if same {
            bench.remember(part.noise);
            self.taken.fetch_add(1, Ordering::Relaxed);
        }
        Ok(found.filter(|_| same))
    }

    /// Part `number` is made.
    pub(super) fn add(
        &self,
        matrix: &MatrixWriter,
        bench: &Bench,
        number: usize,
        rows: &[usize],
        photographs: &[(String, blake3::Hash)],
    ) -> Result<()> {
        let mut hasher = blake3::Hasher::new();
        for &row in rows {
            hasher.update(&matrix.row(row)?.bytes());
        }
        let (rows, noise) = (hasher.finalize().to_hex().to_string(), bench.noise_of(rows));
        self.log.add(&Part { number, photographs: named(photographs), rows, noise })
    }

    pub(super) fn taken_over(&self) -> TakenOver {
        TakenOver { parts: self.taken.load(Ordering::Relaxed), anew: false }
    }
}

fn named(photographs: &[(String, blake3::Hash)]) -> Vec<(String, String)> {
    photographs.iter().map(|(file, hash)| (file.clone(), hash.to_hex().to_string())).collect()
}
