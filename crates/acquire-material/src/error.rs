//! What can go wrong with a material.

use std::path::{Path, PathBuf};

/// `Result` with this crate's [`enum@Error`].
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Everything that ends the work.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The system refused to read a file.
    #[error("{}: cannot be read: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's answer.
        source: std::io::Error,
    },
    /// A file, or bytes in memory, are incomplete, damaged or no material.
    #[error("{}incomplete or damaged material: {reason}", path.as_deref().map(|p| format!("{}: ", p.display())).unwrap_or_default())]
    Damaged {
        /// The file; `None` for bytes in memory.
        path: Option<PathBuf>,
        /// What was expected and found.
        reason: String,
    },
    /// An option has a value that cannot be used.
    #[error("{option}: expected {expected}, found {found}")]
    Option {
        /// The field of the options.
        option: &'static str,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// The lit points of a material are too far apart for an image of all its rows.
    #[error("lit_mm: expected {expected}, found {found}")]
    TooSparse {
        /// What an image can hold.
        expected: String,
        /// What the lit points would need.
        found: String,
    },
    /// A material that was put together in memory contradicts itself, or holds numbers that no file may hold.
    #[error("inconsistent material: {reason}")]
    Inconsistent {
        /// The field, what was expected and found.
        reason: String,
    },
    /// Our own fault.
    #[error("internal error: {reason}")]
    Internal {
        /// What was found to be impossible.
        reason: String,
    },
}

impl Error {
    pub(crate) fn damaged(path: Option<&Path>, reason: String) -> Self {
        Self::Damaged { path: path.map(Path::to_path_buf), reason }
    }

    pub(crate) fn inconsistent(reason: impl std::fmt::Display) -> Self {
        Self::Inconsistent { reason: reason.to_string() }
    }

    pub(crate) fn internal(reason: impl std::fmt::Display) -> Self {
        Self::Internal { reason: reason.to_string() }
    }
}
