//! One record for the findings of all stages: what it is called, how much it matters, whose it is, what was done.

use serde::{Deserialize, Serialize};

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// Worth knowing; nothing is to be done.
    Note,
    /// The result is there, but may be wrong or poor.
    Warning,
    /// There is no result.
    Error,
}

impl Severity {
    /// Its name, which heads the line on the terminal: `note`, `warning`, `error`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Note => "note",
            Self::Warning => "warning",
            Self::Error => "error",
        }
    }
}

/// The part of the work that a finding is about: the rows of `check`'s table, and what comes after the matrix.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Topic {
    /// Files: there, whole, of the right size.
    Files,
    /// Exposure times.
    Exposures,
    /// Other settings of the camera.
    Settings,
    /// The order in which the photographs were taken.
    Order,
    /// Code values: saturation, darkness, noise, the lamp.
    Light,
    /// Sharpness.
    Focus,
    /// Board, Gray code, and how they fit.
    Registration,
    /// How far the pattern or the camera moved.
    Drift,
    /// Dots: lit, where they should be, each once, far enough apart.
    Dots,
    /// The factored material.
    Material,
    /// Light on a slab that is relit.
    Relighting,
    /// The simulated slab.
    Simulation,
    /// A matrix that comes as arrays.
    Arrays,
}

impl Topic {
    /// Those of a capture, in the order of the table of `check`.
    pub const ALL: [Self; 9] = [
        Self::Files,
        Self::Exposures,
        Self::Settings,
        Self::Order,
        Self::Light,
        Self::Focus,
        Self::Registration,
        Self::Drift,
        Self::Dots,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Files => "files",
            Self::Exposures => "exposures",
            Self::Settings => "settings",
            Self::Order => "order",
            Self::Light => "light",
            Self::Focus => "focus",
            Self::Registration => "registration",
            Self::Drift => "drift",
            Self::Dots => "dots",
            Self::Material => "material",
            Self::Relighting => "relighting",
            Self::Simulation => "simulation",
            Self::Arrays => "arrays",
        }
    }
}

/// What a finding is put down to. Where many are alike, the first.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Culprit {
    /// A photograph or another file: as `capture.toml` names it, else its path.
    Photograph(String),
    /// A shot of `capture.toml`.
    Shot(String),
    /// A field of `capture.toml` or `rig.toml`, a tag of EXIF, or an option.
    Field(String),
    /// A dot of a shot by its grid index (x, y).
    Dot([usize; 2]),
    /// So many rows of the matrix, which are not told apart.
    Rows(usize),
    /// All photographs of a nominal exposure time, s.
    Exposure(f64),
    /// A medium of a simulated slab.
    Medium(String),
    /// A part of the bench: camera, lens, lamp, patterns, board, white reference.
    Part(String),
}

impl std::fmt::Display for Culprit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Photograph(name) | Self::Field(name) | Self::Medium(name) | Self::Part(name) => f.write_str(name),
            Self::Shot(name) => write!(f, "shot \"{name}\""),
            Self::Dot(dot) => write!(f, "dot {dot:?}"),
            Self::Rows(rows) => f.write_str(&crate::words::count(*rows, "row")),
            Self::Exposure(secs) => write!(f, "exposure of {secs} s"),
        }
    }
}

/// What was done about a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Done {
    /// It is told, and nothing else.
    Told,
    /// Its effect is taken out of the result, as far as it was measured.
    Corrected,
    /// Something else stands in for what is missing or wrong: an estimate, the neighbours, zero.
    Replaced,
    /// What it is about is not used, or marked as not measured.
    LeftOut,
    /// It would have stopped the work, and was accepted by name.
    Accepted,
    /// It stops the work.
    Refused,
}

impl Done {
    /// Its name: `told`, `corrected`, `replaced`, `left out`, `accepted`, `refused`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Told => "told",
            Self::Corrected => "corrected",
            Self::Replaced => "replaced",
            Self::LeftOut => "left out",
            Self::Accepted => "accepted",
            Self::Refused => "refused",
        }
    }
}

/// From where on something is a finding. `docs/findings.md` says where each comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Bound {
    /// The figure that it bounds, by its name among the finding's figures.
    pub figure: String,
    /// The figure's limit.
    pub limit: f64,
    /// Its unit; empty for a share or a number.
    pub unit: String,
}

/// A finding as all commands, the report and the matrix tell it; its figures are those of the [`super::Warning`] that
/// gave it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct FindingRecord {
    /// Its name in `docs/findings.md`.
    pub id: String,
    /// How much it matters.
    pub severity: Severity,
    /// What it is about.
    pub topic: Topic,
    /// What was seen, in a sentence.
    pub seen: String,
    /// The limit that was passed; `None` where it is no single number.
    pub bound: Option<Bound>,
    /// What it is put down to; empty where nothing is named.
    pub culprit: Vec<Culprit>,
    /// What was done about it.
    pub done: Done,
}

/// A stage's findings: for each variant its name, severity, topic, what was done, culprits and bound. The match is
/// exhaustive: a variant that is not listed does not compile.
macro_rules! catalogue {
    ($stage:ident { $($pattern:pat $(if $guard:expr)? => $id:literal, $severity:ident, $topic:ident, $done:ident, $culprit:expr, $bound:expr;)* }) => {
        impl $stage {
            /// The names of all its findings; one that depends on its figures is there twice.
            pub(super) const IDS: &'static [&'static str] = &[$($id),*];

            /// Its name, as it is written.
            pub fn id(&self) -> &'static str {
                #[allow(unused_variables, reason = "bound for other columns")]
                match self {
                    $($pattern $(if $guard)? => $id,)*
                }
            }

            /// What all findings have.
            pub fn record(&self) -> $crate::warning::FindingRecord {
                use $crate::warning::{Done, Severity, Topic};
                #[allow(unused_imports)]
                use $crate::warning::record::{bound, dot, exposure, field, medium, part, photograph, rows, shot};
                let (severity, topic, done, culprit, bound) = match self {
                    $($pattern $(if $guard)? => (Severity::$severity, Topic::$topic, Done::$done, $culprit, $bound),)*
                };
                let (id, seen) = (self.id().to_owned(), self.to_string());
                $crate::warning::FindingRecord { id, severity, topic, seen, bound, culprit, done }
            }
        }
    };
}
pub(super) use catalogue;

pub(super) fn photograph(file: &str) -> Culprit {
    Culprit::Photograph(file.to_owned())
}

pub(super) fn shot(name: &str) -> Culprit {
    Culprit::Shot(name.to_owned())
}

pub(super) fn field(name: &str) -> Culprit {
    Culprit::Field(name.to_owned())
}

pub(super) fn dot(dot: [usize; 2]) -> Culprit {
    Culprit::Dot(dot)
}

pub(super) fn rows(rows: usize) -> Culprit {
    Culprit::Rows(rows)
}

pub(super) fn exposure(secs: f64) -> Culprit {
    Culprit::Exposure(secs)
}

pub(super) fn medium(name: &str) -> Culprit {
    Culprit::Medium(name.to_owned())
}

pub(super) fn part(name: &str) -> Culprit {
    Culprit::Part(name.to_owned())
}

pub(super) fn bound(figure: &str, limit: f64, unit: &str) -> Option<Bound> {
    Some(Bound { figure: figure.to_owned(), limit, unit: unit.to_owned() })
}
