//! Findings that do not stop the work: typed, shown on the terminal and kept in the matrix, the material and the report.
//!
//! Each stage has an enum of its own, and its functions return that; [`Warning`] joins them. They stand here and not in the stages'
//! folders because the header of a matrix keeps those of all stages: this module imports none of them.

mod capture;
mod consistency;
mod factor;
mod radiance;
mod registration;
mod response;
mod simulate;
#[cfg(test)]
mod tests;

pub use capture::CaptureWarning;
pub use consistency::ConsistencyWarning;
pub use factor::FactorWarning;
pub use radiance::RadianceWarning;
pub use registration::{DriftJump, RegistrationWarning};
pub use response::ResponseWarning;
pub use simulate::SimulateWarning;

use serde::{Deserialize, Serialize};

/// Something the person should know about work that was completed all the same.
///
/// Written, it is an object of the finding's name (`warning`) and its figures; the names of all stages differ.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "a warning that this version of acquire knows, with its figures")]
#[non_exhaustive]
pub enum Warning {
    /// Of reading a capture.
    Capture(CaptureWarning),
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
    /// Of the simulator.
    Simulate(SimulateWarning),
}

impl Warning {
    /// Its name, as it is written: `photograph-disagrees`.
    ///
    /// # Errors
    /// [`crate::Error::Internal`] for a warning that cannot be written.
    pub fn id(&self) -> crate::Result<String> {
        let written = serde_json::to_value(self).map_err(crate::Error::internal)?;
        let id = written.get("warning").and_then(|id| id.as_str());
        id.map(str::to_owned).ok_or_else(|| crate::Error::internal("a warning without a name"))
    }
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
    };
}

join!(
    Capture(CaptureWarning),
    Consistency(ConsistencyWarning),
    Radiance(RadianceWarning),
    Registration(RegistrationWarning),
    Response(ResponseWarning),
    Factor(FactorWarning),
    Simulate(SimulateWarning)
);
