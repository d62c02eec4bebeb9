//! Photographs against the checksums that were recorded when the capture was made. They are hashed anyway, when they
//! are read.

use super::BuildOptions;
use super::photographs::Photographs;
use crate::{ConsistencyWarning, Error, Result, Warning};
use std::collections::BTreeMap;

/// The result of a build with what became of its photographs: as the cause of an error, or as an error where they are
/// not accepted.
///
/// Not looked at: photographs that were not read, as `check` leaves most of a sweep.
pub(super) fn with_changed<T>(
    photographs: &Photographs<'_>,
    recorded: &BTreeMap<String, blake3::Hash>,
    options: &BuildOptions,
    built: Result<T>,
) -> Result<(T, Option<Warning>)> {
    let read = photographs.hashes()?;
    let name = |path: &std::path::Path| photographs.capture.name_of(path);
    let changed = read.iter().filter(|(path, hash)| recorded.get(&name(path)).is_some_and(|was| was != *hash));
    let changed: Vec<String> = changed.map(|(path, _)| name(path)).collect();
    let finding = changed.first().map(|file| {
        Warning::from(ConsistencyWarning::PhotographChanged { file: file.clone(), photographs: changed.len() })
    });
    match (built, finding) {
        (built, None) => built.map(|built| (built, None)),
        (Ok(built), Some(finding)) => options.refuse(finding).map(|finding| (built, Some(finding))),
        // Contradictions name what they are of.
        (Err(error @ (Error::Contradiction { .. } | Error::Explained { .. })), Some(_)) => Err(error),
        (Err(error), Some(cause)) => Err(Error::Explained { cause: Box::new(cause), error: Box::new(error) }),
    }
}
