//! Report: one self-contained page with its pictures.
//!
//! Data in, files out: [`write()`] takes plain data ([`ReportInput`]) and knows nothing of how it was made.
//! [`RowSurvey`] reads the matrix once and picks the rows that the page shows.

pub(crate) mod chart;
mod color;
mod figures;
mod labels;
mod maps;
mod page;
mod picture;
mod row_pictures;
mod row_survey;
pub(crate) mod text;

pub use row_survey::{ComparedRow, RowSurvey};

use crate::factor::TermLevel;
use crate::material::MaterialHeader;
use crate::pipeline::Overview;
use crate::transport::MatrixHeader;
use crate::{Error, FactorWarning, Result, progress::StageTime};
use std::collections::BTreeMap;
use std::path::Path;

/// Everything that the page shows.
#[derive(Debug, Clone, Copy)]
pub struct ReportInput<'a> {
    /// The capture's name.
    pub title: &'a str,
    /// What the matrix is; shots with their drift, warnings and provenance come from here.
    pub matrix: &'a MatrixHeader,
    /// What the material is.
    pub material: &'a MaterialSummary,
    /// A photograph with what was found in it.
    pub overview: Option<&'a Overview>,
    /// The matrix beside its reconstruction.
    pub survey: &'a RowSurvey,
    /// Measures, the material against the matrix first.
    pub comparisons: &'a [Comparison],
    /// Stages in the order they ended.
    pub timings: &'a [StageTime],
    /// Findings after the matrix was written (its own are in `matrix`).
    pub warnings: &'a [FactorWarning],
}

/// The material in a few words and numbers.
#[derive(Debug, Clone, Default)]
pub struct MaterialSummary {
    /// The model's name, `tucker` say.
    pub model: String,
    /// Terms that were kept.
    pub terms: usize,
    /// Degree of the colour polynomial, when the model has one.
    pub degree: Option<usize>,
    /// Size of the file.
    pub bytes_file: u64,
    /// Size of the same coded, where that was made.
    pub bytes_coded: Option<u64>,
    /// Singular values among which terms were chosen, beside their noise.
    pub levels: Vec<TermLevel>,
    /// One line on how terms and degree were chosen.
    pub choice: Option<String>,
}

impl MaterialSummary {
    /// What `header` says, for a file of `bytes_file`; `choice` is a line on how terms and degree were chosen. What
    /// only a factorization knows is empty.
    pub fn new(header: &MaterialHeader, bytes_file: u64, choice: Option<String>) -> Self {
        Self {
            model: header.model.to_string(),
            terms: header.terms,
            degree: header.degree,
            bytes_file,
            bytes_coded: None,
            levels: Vec::new(),
            choice,
        }
    }
}

/// Measures of one thing against another, by the names of `docs/metrics.md`.
#[derive(Debug, Clone)]
pub struct Comparison {
    /// "material against matrix", say.
    pub title: String,
    /// Measures by name; several numbers are those of R, G and B.
    pub values: BTreeMap<String, Vec<f64>>,
}

impl Comparison {
    /// Takes every number and every list of numbers of the outermost level of `measures`.
    ///
    /// # Errors
    /// [`Error::Internal`] when `measures` cannot be serialized.
    pub fn new(title: &str, measures: &impl serde::Serialize) -> Result<Self> {
        let measures = serde_json::to_value(measures).map_err(Error::internal)?;
        let numbers = |v: &serde_json::Value| match v {
            serde_json::Value::Array(list) => list.iter().map(serde_json::Value::as_f64).collect(),
            v => v.as_f64().map(|v| vec![v]),
        };
        let named = measures.as_object().into_iter().flatten();
        let values = named.filter_map(|(name, v)| Some((name.clone(), numbers(v)?))).collect();
        Ok(Self { title: title.to_owned(), values })
    }

    /// The measure `name`, when it is there and one number.
    pub fn value(&self, name: &str) -> Option<f64> {
        match self.values.get(name)?.as_slice() {
            [v] => Some(*v),
            _ => None,
        }
    }
}

/// Writes `report.html` and its pictures into `dir`, which is made when it is not there.
///
/// The page needs no other file: pictures are embedded, charts are inline. The files beside it are the same pictures
/// for use elsewhere.
///
/// # Errors
/// [`Error::Io`]; [`Error::Internal`] when the parts of `input` do not belong together.
pub fn write(dir: &Path, input: &ReportInput) -> Result<()> {
    std::fs::create_dir_all(dir).map_err(Error::io("create", dir))?;
    let mut files = Vec::new();
    let html = page::html(input, &mut files)?;
    files.push(("report.html".to_owned(), html.into_bytes()));
    for (name, bytes) in files {
        let path = dir.join(name);
        std::fs::write(&path, bytes).map_err(Error::io("write", &path))?;
    }
    Ok(())
}

/// Files that go beside the page: name and content.
type Files = Vec<(String, Vec<u8>)>;

#[cfg(test)]
mod tests;
