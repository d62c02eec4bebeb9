//! The catalogue of findings: typed, shown on the terminal and kept in the matrix, the material and the report.
//!
//! Each stage has an enum of its own, and its functions return that; [`Warning`] joins them, and [`FindingRecord`] is
//! what all have. They stand here and not in the stages' folders because the header of a matrix keeps those of all
//! stages: this module imports none of them. `docs/findings.md` lists them, with what to do about each.

mod arrays;
pub(crate) mod bounds;
mod capture;
mod check;
mod consistency;
mod factor;
mod light;
mod radiance;
mod record;
mod registration;
mod response;
#[cfg(test)]
pub(crate) mod samples;
mod simulate;
#[cfg(test)]
mod tests;

pub use arrays::ArraysWarning;
pub use capture::CaptureWarning;
pub(crate) use capture::times;
pub use check::CheckWarning;
pub use consistency::ConsistencyWarning;
pub use factor::FactorWarning;
pub use light::LightWarning;
pub use radiance::RadianceWarning;
pub use record::{Bound, Culprit, Done, FindingRecord, Severity, Topic};
pub use registration::{DriftJump, RegistrationWarning};
pub use response::ResponseWarning;
pub use simulate::SimulateWarning;

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A finding: something the person should know about the work, whether or not it was completed.
///
/// Written, it is an object of the finding's name (`warning`) and its figures; the names of all stages differ.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a warning that this version of acquire knows, with its figures")]
#[non_exhaustive]
pub enum Warning {
    /// Of reading a capture.
    Capture(CaptureWarning),
    /// Of looking at a capture's files and pixels, and what stops the work.
    Check(CheckWarning),
    /// Of comparing what a capture says twice.
    Consistency(ConsistencyWarning),
    /// Of merging exposures.
    Radiance(RadianceWarning),
    /// Of registration.
    Registration(RegistrationWarning),
    /// Of extracting rows.
    Response(ResponseWarning),
    /// Of a factorization.
    Factor(FactorWarning),
    /// Of lighting a matrix or a material.
    Light(LightWarning),
    /// Of the simulator.
    Simulate(SimulateWarning),
    /// Of importing a matrix from arrays.
    Arrays(ArraysWarning),
}

/// Each stage's enum is one variant: it becomes a warning by `into()`, and is shown as it shows itself.
macro_rules! join {
    ($($stage:ident($warning:ident)),*) => {
        $(impl From<$warning> for Warning {
            fn from(warning: $warning) -> Self {
                Self::$stage(warning)
            }
        })*

        impl std::fmt::Display for Warning {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                match self {
                    $(Self::$stage(warning) => warning.fmt(f),)*
                }
            }
        }

        impl Warning {
            /// The names of all findings, each once, stage by stage: the lines of `docs/findings.md`.
            pub fn ids() -> Vec<&'static str> {
                let mut ids = [$($warning::IDS),*].concat();
                ids.dedup();
                ids
            }

            /// Its name, as it is written: `photograph-disagrees`.
            pub fn id(&self) -> &'static str {
                match self {
                    $(Self::$stage(warning) => warning.id(),)*
                }
            }

            /// What all findings have: of one that did not stop the work, unless it can do nothing else.
            pub fn record(&self) -> FindingRecord {
                match self {
                    $(Self::$stage(warning) => warning.record(),)*
                }
            }
        }
    };
}

join!(
    Capture(CaptureWarning),
    Check(CheckWarning),
    Consistency(ConsistencyWarning),
    Radiance(RadianceWarning),
    Registration(RegistrationWarning),
    Response(ResponseWarning),
    Factor(FactorWarning),
    Light(LightWarning),
    Simulate(SimulateWarning),
    Arrays(ArraysWarning)
);

impl Warning {
    /// How much it matters, where it did not stop the work.
    pub fn severity(&self) -> Severity {
        self.record().severity
    }

    /// What it is about.
    pub fn topic(&self) -> Topic {
        self.record().topic
    }

    /// What stops the work, as a finding; files are named as in the capture in `dir`.
    pub fn refusal(error: &Error, dir: &Path) -> Self {
        let name = |path: &Path| path.strip_prefix(dir).unwrap_or(path).display().to_string();
        let found = match error {
            Error::Contradiction { finding: cause } | Error::Explained { cause, .. } => return (**cause).clone(),
            Error::WouldNotBuild { reason } => return Self::refusal(reason, dir),
            Error::MissingPhotograph { path, shot } => {
                CheckWarning::MissingPhotograph { file: name(path), shot: shot.clone() }
            }
            Error::BrokenPhotograph { path, shot, reason } => {
                CheckWarning::BrokenPhotograph { file: name(path), shot: shot.clone(), reason: reason.clone() }
            }
            Error::PhotographSize { path, expected, found } => {
                CheckWarning::WrongSize { file: name(path), expected_px: *expected, found_px: *found }
            }
            Error::NoExposure { path } => CheckWarning::NoExposure { file: name(path) },
            Error::SameExposure { shot, first, second, exposure_secs, .. } => CheckWarning::SameExposure {
                shot: shot.clone(),
                first: first.clone(),
                second: second.clone(),
                exposure_secs: *exposure_secs,
            },
            Error::Field { path, field, expected, found } => CheckWarning::UnusableField {
                file: name(path),
                field: field.clone(),
                expected: expected.clone(),
                found: found.clone(),
            },
            Error::Registration { path, shot, reason } => {
                CheckWarning::RegistrationFailed { file: name(path), shot: shot.clone(), reason: reason.clone() }
            }
            Error::DotOutsideSlab { shot, dot, expected, found, .. } => CheckWarning::DotOutsideSlab {
                shot: shot.clone(),
                dot: *dot,
                expected: expected.clone(),
                found: found.clone(),
            },
            Error::DotSaturated { path, shot, dot, shortest_secs } => CheckWarning::DotSaturated {
                file: name(path),
                shot: shot.clone(),
                dot: *dot,
                shortest_secs: *shortest_secs,
            },
            other => CheckWarning::Stopped { reason: other.to_string() },
        };
        found.into()
    }

    /// For programs: the record, and beside it the figures by their names.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn json(&self) -> Result<serde_json::Value> {
        self.record().with_figures(self)
    }
}

impl FindingRecord {
    /// The record of what stops the work.
    pub fn refused(self) -> Self {
        Self { severity: Severity::Error, done: Done::Refused, ..self }
    }

    /// For programs: the record, and beside it the figures of the finding that gave it by their names.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn with_figures(&self, of: &Warning) -> Result<serde_json::Value> {
        let mut object = serde_json::to_value(self).map_err(Error::internal)?;
        let mut figures = serde_json::to_value(of).map_err(Error::internal)?;
        if let Some(figures) = figures.as_object_mut() {
            figures.remove("warning");
        }
        object["figures"] = figures;
        Ok(object)
    }
}
