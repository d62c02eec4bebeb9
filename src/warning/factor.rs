//! What a factorization finds.

use super::record::catalogue;
use crate::words::count;
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
            Self::EmptyRows { rows } => write!(f, "no positive peak in {}; stored as zeros", count(*rows, "row")),
            Self::ShiftLimited { rows, limit } => {
                let limit = count(*limit, "sample");
                write!(
                    f,
                    "in {} the peak is more than {limit} from the lit point; the shift is limited to {limit}",
                    count(*rows, "row")
                )
            }
            Self::GoalMissed { asked, found } => write!(f, "target not reached: asked {asked}, got {found}"),
        }
    }
}

catalogue!(FactorWarning {
    Self::EmptyRows { rows: n } => "empty-rows", Warning, Material, Replaced, vec![rows(*n)], None;
    Self::ShiftLimited { rows: n, limit } => "shift-limited", Warning, Material, Replaced, vec![rows(*n)],
        bound("shift", *limit as f64, "samples");
    Self::GoalMissed { .. } => "goal-missed", Warning, Material, Told, vec![], None;
});
