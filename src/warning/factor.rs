//! What a factorization finds.

use serde::{Deserialize, Serialize};
use std::fmt;

/// What a factorization finds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum FactorWarning {
    /// Rows without any valid sample or with a peak that is not positive; they are kept as zeros.
    EmptyRows {
        /// How many.
        rows: usize,
    },
    /// A row's peak lay further out than the search permits; its shift was limited.
    ShiftLimited {
        /// How many rows.
        rows: usize,
        /// The largest permitted shift, samples.
        limit: usize,
    },
    /// A material does not reach what was asked of it.
    GoalMissed {
        /// What was asked, with its unit.
        asked: String,
        /// What it is.
        found: String,
    },
}

impl fmt::Display for FactorWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::EmptyRows { rows } => write!(f, "{rows} rows have no positive peak; they are kept as zeros"),
            Self::ShiftLimited { rows, limit } => {
                write!(
                    f,
                    "{rows} rows have their peak more than {limit} samples from the lit point; their shift was limited to it"
                )
            }
            Self::GoalMissed { asked, found } => write!(f, "target not reached: asked {asked}, got {found}"),
        }
    }
}
