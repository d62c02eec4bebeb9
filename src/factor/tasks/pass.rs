//! A pass over rows: what a task is told, and what it finds.

use super::saved_material::SavedMaterial;
use super::{Passes, RowsState};
use crate::factor::backend::Rows;
use crate::factor::content::Content;
use crate::factor::entry_exit::{MarginalSums, Marginals};
use crate::factor::prepared_rows::PreparedRows;
use crate::factor::regression::colors_of;
use crate::factor::survey::{SurveyedRows, survey_rows};
use crate::factor::terms::residual_of_rows;
use crate::output::numbers;
use crate::transport::RowBlock;
use crate::{Error, Result};
use faer::Mat;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// What is to be found of rows. What some find and what others find make what all do ([`Found::join`]).
#[derive(Debug, Serialize, Deserialize)]
pub(in crate::factor) enum Pass {
    /// Where they go, their noise and their mean; with `sums` what entry and exit maps are fitted to.
    Survey { content: Content, limit: [usize; 2], sums: bool },
    /// AᵀA times `width` columns, \[width, columns\].
    GramTimes {
        rows: Box<RowsState>,
        #[serde(with = "numbers")]
        columns: Vec<f32>,
        width: usize,
    },
    /// AᵀA.
    Gram { rows: Box<RowsState> },
    /// Each row times `vectors`, \[any, columns\].
    Times {
        rows: Box<RowsState>,
        #[serde(with = "numbers")]
        vectors: Vec<f64>,
        exact: bool,
    },
    /// Σ of squares of what a material's terms leave ([`PreparedRows::misfit`]).
    Misfit { rows: Box<RowsState>, material: SavedMaterial, inside: bool },
    /// The same by evaluating it.
    Residual { material: SavedMaterial },
    /// Colour polynomials.
    Color { material: SavedMaterial, degree: usize },
}

/// What a pass has found.
#[derive(Debug, Serialize, Deserialize)]
pub(in crate::factor) enum Found {
    /// Of a survey.
    Survey { rows: SurveyedRows, sums: Vec<MarginalSums> },
    /// A sum over rows.
    Sum(f64),
    /// A matrix that is a sum over rows, column by column.
    Matrix(#[serde(with = "numbers")] Vec<f64>),
    /// Numbers of each row.
    Rows(#[serde(with = "numbers")] Vec<f64>),
    /// Coefficients of each row, and the sum of squares that they leave.
    Colors {
        #[serde(with = "numbers")]
        coefficients: Vec<f32>,
        error: f64,
    },
}

impl Pass {
    /// What a person sees of it.
    pub(in crate::factor) fn name(&self) -> &'static str {
        match self {
            Self::Survey { .. } => "survey",
            Self::GramTimes { .. } | Self::Gram { .. } | Self::Times { .. } => "terms",
            Self::Misfit { .. } | Self::Residual { .. } => "measure",
            Self::Color { .. } => "colour",
        }
    }

    /// Goes over some rows of a matrix, on this machine.
    ///
    /// # Errors
    /// Those of the reader.
    pub(in crate::factor) fn go_over(self, matrix: Passes<'_>, range: Range<usize>) -> Result<Found> {
        let Passes { reader, progress, .. } = matrix;
        let prepared = |rows: Box<RowsState>| PreparedRows::of_state(matrix, *rows, range.clone());
        Ok(match self {
            Self::Survey { content, limit, sums } => {
                let mut sums = sums.then(|| Marginals::new(reader)).transpose()?;
                let window = reader.header().window;
                let each = |block: &RowBlock| sums.iter_mut().for_each(|sums| sums.add(block, window));
                let rows = survey_rows(reader, range.clone(), content, limit, None, each, progress)?;
                Found::Survey { rows, sums: sums.into_iter().map(|sums| sums.of(range.clone())).collect() }
            }
            Self::GramTimes { rows, columns, width } => {
                Found::Matrix(by_columns(&prepared(rows).gram_times(&columns, width)?))
            }
            Self::Gram { rows } => Found::Matrix(by_columns(&prepared(rows).gram()?)),
            Self::Times { rows, vectors, exact } => Found::Rows(prepared(rows).times(&vectors, exact)?),
            Self::Misfit { rows, material, inside } => {
                Found::Sum(prepared(rows).misfit(&material.material(reader), inside)?)
            }
            Self::Residual { material } => Found::Sum(residual_of_rows(reader, &material.material(reader), range)?),
            Self::Color { material, degree } => {
                let (coefficients, error) = colors_of(reader, &material.material(reader), degree, range, progress)?;
                Found::Colors { coefficients, error }
            }
        })
    }
}

fn by_columns(matrix: &Mat<f64>) -> Vec<f64> {
    (0..matrix.ncols()).flat_map(|j| (0..matrix.nrows()).map(move |i| matrix[(i, j)])).collect()
}

impl Found {
    /// What these rows and those after them say together.
    ///
    /// # Errors
    /// [`Error::Internal`] for what two passes have found.
    pub(in crate::factor) fn join(&mut self, next: Self) -> Result<()> {
        match (self, next) {
            (Self::Survey { rows, sums }, Self::Survey { rows: more, sums: of_more }) => {
                rows.join(more);
                sums.extend(of_more);
            }
            (Self::Sum(sum), Self::Sum(more)) => *sum += more,
            (Self::Matrix(sum), Self::Matrix(more)) if sum.len() == more.len() => {
                sum.iter_mut().zip(&more).for_each(|(a, b)| *a += b);
            }
            (Self::Rows(rows), Self::Rows(more)) => rows.extend(more),
            (Self::Colors { coefficients, error }, Self::Colors { coefficients: more, error: and }) => {
                coefficients.extend(more);
                *error += and;
            }
            _ => return Err(other()),
        }
        Ok(())
    }
}

/// What a pass was not asked for.
pub(super) fn other() -> Error {
    Error::internal("a part has what its pass was not asked for")
}
