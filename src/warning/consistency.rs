//! What a capture says twice, and not alike: photographs of a stack, patterns and dots, light, references, the rig's figures.

use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What a capture says twice, and not alike.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ConsistencyWarning {
    /// A photograph does not show what the other exposures of its shot show.
    PhotographDisagrees {
        /// The file.
        file: String,
        /// Its shot.
        shot: String,
        /// What it looks like: "the pattern of shot lattice-3", "turned by 180°".
        looks: String,
        /// Share of the pixels with light that disagree by more than their noise, 0 to 1.
        share: f64,
        /// How many photographs of the capture do.
        photographs: usize,
    },
}

impl fmt::Display for ConsistencyWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PhotographDisagrees { file, shot, looks, share, photographs } => {
                write!(
                    f,
                    "{file} does not show what the other exposures of shot \"{shot}\" show ({:.0} % of the lit pixels differ by more than noise): {looks}",
                    100.0 * share
                )?;
                match photographs {
                    1 => Ok(()),
                    n => write!(f, "; so do {}", count(n - 1, "other photograph")),
                }
            }
        }
    }
}
