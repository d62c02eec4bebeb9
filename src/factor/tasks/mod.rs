//! Passes over a matrix's rows by tasks on many machines.
//!
//! A factorization goes over all rows some ten to thirty times; what it finds each time is a sum over rows or something
//! of each row ([`Pass`], [`Found`]). With tasks it asks for one such pass: a file says which, tasks go over their own
//! rows and write what they find, and the factorization is made again from the start with that, until it needs a pass
//! whose parts are not there ([`Error::PassDue`]), or is done. What earlier passes found is joined, in the order of the
//! parts, and kept: making it again takes no rows, and comes by the same digits to the same place.
//!
//! | file | what |
//! |---|---|
//! | `next.pass` | the pass that is due ([`PassFile`]) |
//! | `3-of-64.part` | what a task has found ([`FoundFile`]) under the key of the pass |
//! | `0007.sum` | what all have found in the seventh pass, likewise |
//!
//! Files take their place in one step, and one of another pass, matrix or version is as good as none. So a task may be
//! killed, run twice, or late.

mod pass;
mod saved_material;

pub(super) use super::prepared_rows::RowsState;
pub(super) use pass::{Found, Pass};
pub(super) use saved_material::SavedMaterial;

use super::content::Content;
use super::entry_exit::MarginalSums;
use super::storing::{Storage, Stored, store};
use super::survey::SurveyedRows;
use super::{Backend, FactorOptions};
use crate::files::is_url;
use crate::output::{PROGRAM, TaskFile};
use crate::progress::Progress;
use crate::transport::MatrixReader;
use crate::words::ranges;
use crate::{Error, Result};
use faer::Mat;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

const PASS: &[u8; 16] = b"acquire pass 1\n\0";
const PART: &[u8; 16] = b"acquire found 1\n";
/// Parts where no number is given: on sixteen cores each has two.
const PARTS: usize = 32;
/// Bytes of responses that a part has at the most where no number is given: about a second of one core, in which what a
/// task reads besides is a few hundredths.
const PART_BYTES: usize = 512 << 20;

/// A matrix, and who goes over its rows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Passes<'a> {
    pub reader: &'a MatrixReader,
    /// `None`: this process.
    pub tasks: Option<&'a Tasks>,
    pub progress: &'a Progress,
}

impl<'a> Passes<'a> {
    /// By this process.
    pub(super) fn here(reader: &'a MatrixReader, progress: &'a Progress) -> Self {
        Self { reader, tasks: None, progress }
    }
}

/// Where tasks find the pass that is due, and leave what they find.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TaskFolder {
    /// A folder that all of them see.
    pub path: PathBuf,
    /// How many share a pass, 1 to the chunks of the matrix; `None`: 32, or as many as have 512 MiB of responses each.
    /// Sums are taken in the order of the parts: the material is the same, bit by bit, whoever does them. Another number
    /// is rounding in f64 with [`Backend::Gram`]; with [`Backend::Randomized`] an iteration that ends elsewhere within its
    /// accuracy.
    pub parts: Option<usize>,
}

/// What `next.pass` holds.
#[derive(Debug, Serialize, Deserialize)]
struct PassFile {
    program: String,
    matrix: PathBuf,
    digest: Option<String>,
    /// Which pass of the factorization, from 1.
    number: usize,
    of: usize,
    pass: Pass,
}

/// What parts and sums hold.
#[derive(Debug, Serialize, Deserialize)]
struct FoundFile {
    /// The key of the pass.
    key: String,
    found: Found,
}

/// What a task has done.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PassReport {
    /// Which pass of the factorization, from 1.
    pub pass: usize,
    /// What it finds: survey, terms, measure or colour.
    pub stage: &'static str,
    /// The first row of the part, and the one after the last.
    pub rows: [usize; 2],
    /// Whether the part was there: nothing was read.
    pub was_there: bool,
    /// Bytes of the pass, which every task reads.
    pub bytes_pass: u64,
    /// Bytes of the part.
    pub bytes_part: u64,
}

/// Factors a matrix and stores the material as [`super::factor_and_store`] does, with passes over the rows by tasks
/// ([`factor_part`]).
///
/// # Errors
/// [`Error::PassDue`] while a pass has parts that are not there; to be called again, with the same arguments, when they
/// are. [`Error::Setting`] for a number of parts that the matrix has not, and for options that need all rows in one
/// place: [`Backend::Full`], memory for rows. Those of [`super::factor_and_store`].
pub fn factor_and_store_by_tasks(
    reader: &MatrixReader,
    options: &FactorOptions,
    storage: &Storage,
    folder: &TaskFolder,
    progress: &Progress,
) -> Result<Stored> {
    options.check()?;
    let refuse =
        |setting, expected: &str, found: String| Err(Error::Setting { setting, expected: expected.into(), found });
    if options.backend == Some(Backend::Full) {
        return refuse("backend", "randomized, gram or deflation with tasks", "full, which has all rows in one".into());
    }
    if let Some(bytes) = options.memory_bytes {
        return refuse("memory", "none with tasks, which read their rows 48 MiB at a time", bytes.to_string());
    }
    let tasks = Tasks::new(reader, folder)?;
    store(Passes { reader, tasks: Some(&tasks), progress }, options, storage)
}

/// Goes over part `number`, from 1, of `of` parts of the matrix's rows for the pass that is due in `folder`, and writes
/// what it finds there. A part that is there stays.
///
/// # Errors
/// [`Error::Field`] when no pass is due there, or one of another version or of a matrix that has changed since;
/// [`Error::Setting`] for parts that the pass has not; those of the reader.
pub fn factor_part(folder: &Path, [number, of]: [usize; 2], progress: &Progress) -> Result<PassReport> {
    faer::set_global_parallelism(faer::Par::Seq);
    let path = folder.join("next.pass");
    let refuse = |found: &str| {
        let expected = "a whole pass that `acquire factor` of this version has written, and its matrix as it was";
        Err(Error::field(&path, "file", expected, found))
    };
    let file = match TaskFile::read(&path, PASS)? {
        Ok(file) => file,
        Err(found) => return refuse(found),
    };
    let due: PassFile = match file.value::<PassFile>() {
        Ok(due) if due.program == PROGRAM => due,
        Ok(due) => return refuse(&format!("one of {}", due.program)),
        Err(e) => return refuse(&format!("one that another version has written ({e})")),
    };
    if of != due.of || number == 0 || number > of {
        let expected = format!("K/{} with K from 1, as `acquire factor` was told", due.of);
        return Err(Error::Setting { setting: "part", expected, found: format!("{number}/{of}") });
    }
    let reader = MatrixReader::open(&due.matrix)?;
    if reader.digest() != due.digest.as_deref() {
        return refuse("one of another matrix at its place");
    }
    let range = reader.shares(of).get(number - 1).cloned().ok_or_else(|| Error::internal("a part without rows"))?;
    let (out, key) = (part_path(folder, number, of), file.key());
    let mut report = PassReport {
        pass: due.number,
        stage: due.pass.name(),
        rows: [range.start, range.end],
        was_there: found_in(&out, &key).is_some(),
        bytes_pass: length(&path),
        bytes_part: length(&out),
    };
    if !report.was_there {
        let found = due.pass.go_over(Passes::here(&reader, progress), range)?;
        report.bytes_part = TaskFile::new(PART, &FoundFile { key, found })?.write(&out)?;
    }
    Ok(report)
}

fn part_path(folder: &Path, number: usize, of: usize) -> PathBuf {
    folder.join(format!("{number}-of-{of}.part"))
}

fn length(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |kind| kind.len())
}

/// What a file has of the pass with this key.
fn found_in(path: &Path, key: &str) -> Option<Found> {
    let file: FoundFile = TaskFile::read(path, PART).ok()?.ok()?.value().ok()?;
    (file.key == key).then_some(file.found)
}

/// A factorization whose passes are done by tasks.
#[derive(Debug)]
pub(super) struct Tasks {
    folder: PathBuf,
    matrix: PathBuf,
    digest: Option<String>,
    parts: usize,
    rows: usize,
    /// Passes so far.
    passes: AtomicUsize,
}

impl Tasks {
    fn new(reader: &MatrixReader, folder: &TaskFolder) -> Result<Self> {
        let header = reader.header();
        let bytes = 4 * header.rows() * header.row_len();
        let most = reader.shares(usize::MAX).len();
        let parts = folder.parts.unwrap_or_else(|| PARTS.max(bytes.div_ceil(PART_BYTES)).min(most));
        if parts == 0 || parts > most {
            let expected = format!("1 to {most}, the chunks of the matrix");
            return Err(Error::Setting { setting: "parts", expected, found: parts.to_string() });
        }
        std::fs::read_dir(&folder.path).map_err(Error::io("read", &folder.path))?;
        Ok(Self {
            folder: folder.path.clone(),
            matrix: match is_url(reader.path()) {
                true => reader.path().to_path_buf(),
                false => reader.path().canonicalize().map_err(Error::io("read", reader.path()))?,
            },
            digest: reader.digest().map(str::to_owned),
            parts,
            rows: header.rows(),
            passes: AtomicUsize::new(0),
        })
    }

    /// What all rows say in the next pass.
    fn go_over(&self, pass: Pass) -> Result<Found> {
        let number = self.passes.fetch_add(1, Ordering::Relaxed) + 1;
        let stage = pass.name();
        let (program, matrix, digest) = (PROGRAM.to_owned(), self.matrix.clone(), self.digest.clone());
        let file = TaskFile::new(PASS, &PassFile { program, matrix, digest, number, of: self.parts, pass })?;
        let key = file.key();
        let sum = self.folder.join(format!("{number:04}.sum"));
        if let Some(found) = found_in(&sum, &key) {
            return Ok(found);
        }
        let next = self.folder.join("next.pass");
        if !matches!(TaskFile::read(&next, PASS), Ok(Ok(there)) if there.key() == key) {
            file.write(&next)?;
        }
        let (mut all, mut missing) = (None, Vec::new());
        for part in 1..=self.parts {
            match (found_in(&part_path(&self.folder, part, self.parts), &key), &mut all) {
                (None, _) => missing.push(part),
                (Some(first), None) => all = Some(first),
                (Some(next), Some(all)) => all.join(next)?,
            }
        }
        match all.filter(|_| missing.is_empty()) {
            Some(found) => {
                let file = FoundFile { key, found };
                TaskFile::new(PART, &file)?.write(&sum)?;
                Ok(file.found)
            }
            None => {
                let (path, missing) = (self.folder.clone(), ranges(&missing));
                Err(Error::PassDue { path, pass: number, stage, missing, of: self.parts })
            }
        }
    }

    /// What a survey of all rows finds, and what entry and exit maps are fitted to.
    pub(super) fn survey(
        &self,
        content: Content,
        limit: [usize; 2],
        sums: bool,
    ) -> Result<(SurveyedRows, Vec<MarginalSums>)> {
        match self.go_over(Pass::Survey { content, limit, sums })? {
            Found::Survey { rows, sums } if rows.len() == self.rows => Ok((rows, sums)),
            _ => Err(pass::other()),
        }
    }

    /// A sum over all rows.
    pub(super) fn sum(&self, pass: Pass) -> Result<f64> {
        match self.go_over(pass)? {
            Found::Sum(sum) => Ok(sum),
            _ => Err(pass::other()),
        }
    }

    /// A matrix of this shape that is one.
    pub(super) fn matrix(&self, pass: Pass, rows: usize, columns: usize) -> Result<Mat<f64>> {
        match self.go_over(pass)? {
            Found::Matrix(sum) if sum.len() == rows * columns => {
                Ok(Mat::from_fn(rows, columns, |i, j| sum[j * rows + i]))
            }
            _ => Err(pass::other()),
        }
    }

    /// Numbers of all rows.
    pub(super) fn rows(&self, pass: Pass) -> Result<Vec<f64>> {
        match self.go_over(pass)? {
            Found::Rows(rows) => Ok(rows),
            _ => Err(pass::other()),
        }
    }

    /// Colour coefficients of all rows, and what they leave.
    pub(super) fn colors(&self, pass: Pass) -> Result<(Vec<f32>, f64)> {
        match self.go_over(pass)? {
            Found::Colors { coefficients, error } => Ok((coefficients, error)),
            _ => Err(pass::other()),
        }
    }
}

#[cfg(test)]
mod tests;
