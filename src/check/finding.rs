//! What `check` can find: typed, with a severity and the part of the capture that it is about.

use crate::words::count;
use crate::{CaptureWarning, RadianceWarning, RegistrationWarning, ResponseWarning, Warning};
use serde::Serialize;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// Worth knowing.
    Note,
    /// The matrix can be built, but may be wrong or poor.
    Warning,
    /// The matrix cannot be built.
    Error,
}

/// The part of a capture that a finding is about: the rows of the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Topic {
    /// Files: there, whole, of the right size.
    Files,
    /// Exposure times.
    Exposures,
    /// Other settings of the camera.
    Settings,
    /// The order in which the photographs were taken.
    Order,
    /// Saturated and dark pixels.
    Light,
    /// Sharpness.
    Focus,
    /// Board, Gray code, and how they fit.
    Registration,
    /// How far the pattern moved.
    Drift,
    /// Dots: lit, where they should be, each once, far enough apart.
    Dots,
}

impl Topic {
    /// All of them, in the order of the table.
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
        }
    }
}

/// One thing that was found. Lists name their first member and count the rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "finding", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Finding {
    /// What building stops with.
    WouldNotBuild {
        /// The message of `build-matrix`.
        reason: String,
        /// What it is about.
        topic: Topic,
    },
    /// A photograph that is not there.
    MissingPhotograph {
        /// The file.
        file: String,
        /// Its shot.
        shot: String,
    },
    /// A photograph that is no whole image, as far as its head and its end tell.
    BrokenPhotograph {
        /// The file.
        file: String,
        /// Its shot.
        shot: String,
        /// Why.
        reason: String,
    },
    /// A photograph of another size than the rig's.
    WrongSize {
        /// The file.
        file: String,
        /// `camera.size_px`.
        expected_px: [usize; 2],
        /// Its own.
        found_px: [usize; 2],
    },
    /// A photograph of which neither EXIF nor capture.toml tells the exposure.
    NoExposure {
        /// The file.
        file: String,
    },
    /// Photographs without EXIF: their settings and their order are not known.
    NoExif {
        /// The first.
        file: String,
        /// How many.
        photographs: usize,
    },
    /// The camera chose exposures by itself.
    AutomaticExposure {
        /// The first such photograph.
        file: String,
        /// How many.
        photographs: usize,
        /// How: "aperture priority", …
        program: String,
    },
    /// The camera chose the white balance by itself: it may change from photograph to photograph.
    AutomaticWhiteBalance {
        /// The first such photograph.
        file: String,
        /// How many.
        photographs: usize,
    },
    /// A setting that should stay did not.
    SettingChanges {
        /// "ISO", "f-number", "focal length", "camera".
        setting: String,
        /// The first photograph that differs.
        file: String,
        /// How many do.
        photographs: usize,
        /// The value of most photographs.
        expected: String,
        /// That of this one.
        found: String,
    },
    /// Lattice shots whose exposures differ from those of most.
    BracketDiffers {
        /// The first such shot.
        shot: String,
        /// How many.
        shots: usize,
        /// The bracket of most, s.
        expected_secs: Vec<f64>,
        /// That of this shot, s.
        found_secs: Vec<f64>,
    },
    /// Photographs taken before those that precede them in capture.toml.
    OutOfOrder {
        /// The first such photograph.
        file: String,
        /// A photograph that precedes it there and was taken later.
        after_file: String,
        /// How many shots are out of order.
        shots: usize,
        /// Whether lattice shots are among them: those are alike, and easily exchanged.
        lattice: bool,
    },
    /// Pixels that are saturated in the shortest exposure.
    Saturated {
        /// The shot.
        shot: String,
        /// The share of its sample (or board), 0 to 1.
        share: f64,
    },
    /// Dots whose middle is saturated in the shortest exposure.
    SaturatedDots {
        /// The first shot.
        shot: String,
        /// How many dots of the sampled shots.
        dots: usize,
        /// Of how many.
        of: usize,
    },
    /// Pixels that even the longest exposure does not tell from black.
    Dark {
        /// The first shot.
        shot: String,
        /// The share of its pixels (of a lattice shot: in the windows), 0 to 1.
        share: f64,
    },
    /// The photographs are blurred over a good part of an outgoing sample.
    Blurred {
        /// Standard deviation of the lens's blur, px.
        psf_px: f64,
        /// Side of an outgoing sample, px.
        sample_px: f64,
    },
    /// The pattern moved by a good part of what can be followed.
    LargeDrift {
        /// The shot.
        shot: String,
        /// Camera px.
        drift_px: f64,
        /// What can be followed, camera px.
        most_px: f64,
    },
    /// A dot that should be lit and is not to be seen.
    DeadDots {
        /// The first shot.
        shot: String,
        /// Its dot.
        dot: [usize; 2],
        /// How many dots of the sampled shots.
        dots: usize,
        /// Of how many.
        of: usize,
    },
    /// Grid points that no shot lights.
    UnlitPoints {
        /// How many.
        points: usize,
        /// Of how many.
        of: usize,
    },
    /// Lattice shots were not looked at, because something before them failed.
    NotLookedAt,
    /// What `build-matrix` would warn of.
    Warned {
        /// Its warning.
        warning: Warning,
    },
}

impl Finding {
    /// How much it matters.
    pub fn severity(&self) -> Severity {
        match self {
            Self::WouldNotBuild { .. }
            | Self::MissingPhotograph { .. }
            | Self::BrokenPhotograph { .. }
            | Self::WrongSize { .. }
            | Self::NoExposure { .. } => Severity::Error,
            Self::NoExif { .. } | Self::Dark { .. } | Self::NotLookedAt => Severity::Note,
            Self::OutOfOrder { lattice: false, .. } => Severity::Note,
            _ => Severity::Warning,
        }
    }

    /// What it is about.
    pub fn topic(&self) -> Topic {
        match self {
            Self::WouldNotBuild { topic, .. } => *topic,
            Self::MissingPhotograph { .. } | Self::BrokenPhotograph { .. } | Self::WrongSize { .. } => Topic::Files,
            Self::NoExposure { .. } | Self::BracketDiffers { .. } => Topic::Exposures,
            Self::NoExif { .. }
            | Self::AutomaticExposure { .. }
            | Self::AutomaticWhiteBalance { .. }
            | Self::SettingChanges { .. } => Topic::Settings,
            Self::OutOfOrder { .. } => Topic::Order,
            Self::Saturated { .. } | Self::SaturatedDots { .. } | Self::Dark { .. } => Topic::Light,
            Self::Blurred { .. } => Topic::Focus,
            Self::LargeDrift { .. } => Topic::Drift,
            Self::DeadDots { .. } | Self::UnlitPoints { .. } | Self::NotLookedAt => Topic::Dots,
            Self::Warned { warning } => topic_of(warning),
        }
    }
}

fn topic_of(warning: &Warning) -> Topic {
    use {CaptureWarning as C, RadianceWarning as M, RegistrationWarning as R, ResponseWarning as E};
    match warning {
        Warning::Capture(C::ExposureDisagrees { .. } | C::UnusableExif { .. }) => Topic::Exposures,
        Warning::Capture(C::ApertureOrIsoChanges { .. } | C::DamagedExif { .. }) => Topic::Settings,
        Warning::Radiance(M::ExposureRatios { .. } | M::ExposuresUnlinked { .. }) => Topic::Exposures,
        Warning::Radiance(M::StrayLight { .. }) => Topic::Focus,
        Warning::Radiance(_) => Topic::Light,
        Warning::Registration(R::BoardTooSmall { .. } | R::BoardElsewhere { .. }) => Topic::Registration,
        Warning::Registration(R::StronglyBlurred { .. } | R::PointSpreadUnmeasured | R::PointSpreadVaries { .. }) => {
            Topic::Focus
        }
        Warning::Registration(_) => Topic::Drift,
        Warning::Response(E::SaturatedSamples { .. } | E::AlbedoAboveOne { .. }) => Topic::Light,
        Warning::Consistency(_) => Topic::Dots,
        // `check` neither factors nor simulates.
        Warning::Response(_) | Warning::Factor(_) | Warning::Simulate(_) => Topic::Dots,
    }
}

/// A share as people read it.
fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

/// Exposure times as people read them.
pub(super) fn times(secs: &[f64]) -> String {
    let each = secs.iter().map(|t| if *t < 0.3 { format!("1/{:.0}", 1.0 / t) } else { format!("{t:.1}") });
    format!("{} s", each.collect::<Vec<_>>().join(" "))
}

impl std::fmt::Display for Finding {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::WouldNotBuild { reason, .. } => write!(f, "{reason}"),
            Self::MissingPhotograph { file, shot } => write!(f, "{file} of shot \"{shot}\" is missing"),
            Self::BrokenPhotograph { file, shot, reason } => write!(f, "{file} of shot \"{shot}\": {reason}"),
            Self::WrongSize { file, expected_px: [w, h], found_px: [x, y] } => {
                write!(f, "{file} has {x} × {y} px, but camera.size_px of rig.toml is {w} × {h} px")
            }
            Self::NoExposure { file } => write!(f, "{file}: no exposure time in EXIF or capture.toml"),
            Self::NoExif { file, photographs } => {
                write!(
                    f,
                    "no EXIF in {} (first: {file}): settings and order are unknown",
                    count(*photographs, "photograph")
                )
            }
            Self::AutomaticExposure { file, photographs, program } => write!(
                f,
                "the camera chose exposures by {program} in {} (first: {file}): set it to manual and shoot again",
                count(*photographs, "photograph")
            ),
            Self::AutomaticWhiteBalance { file, photographs } => write!(
                f,
                "automatic white balance in {} (first: {file}): colours may change, except in raw files",
                count(*photographs, "photograph")
            ),
            Self::SettingChanges { setting, file, photographs, expected, found } => {
                write!(
                    f,
                    "{setting} changes: {found} in {} (first: {file}), {expected} in most",
                    count(*photographs, "photograph")
                )
            }
            Self::BracketDiffers { shot, shots, expected_secs, found_secs } => write!(
                f,
                "exposures differ from those of most lattice shots in {} (first: \"{shot}\", {}; most: {})",
                count(*shots, "shot"),
                times(found_secs),
                times(expected_secs)
            ),
            Self::OutOfOrder { file, after_file, shots, .. } => write!(
                f,
                "{} out of order: {file} was taken before {after_file}, which precedes it in capture.toml",
                count(*shots, "shot")
            ),
            Self::Saturated { shot, share } => {
                write!(f, "\"{shot}\": {} of its pixels are saturated in the shortest exposure", percent(*share))
            }
            Self::SaturatedDots { shot, dots, of } => write!(
                f,
                "the shortest exposure saturates in {dots} of the {} looked at (first: \"{shot}\"): add a shorter one",
                count(*of, "dot")
            ),
            Self::Dark { shot, share } => {
                write!(f, "\"{shot}\": {} of its pixels are black even in the longest exposure", percent(*share))
            }
            Self::Blurred { psf_px, sample_px } => write!(
                f,
                "the lens blurs by {psf_px:.2} px, and an outgoing sample is {sample_px:.1} px wide: focus the camera, or stop it down"
            ),
            Self::LargeDrift { shot, drift_px, most_px } => write!(
                f,
                "\"{shot}\": the pattern has moved by {drift_px:.1} px since the registration; at most {most_px:.0} px can be followed"
            ),
            Self::DeadDots { shot, dot, dots, of } => write!(
                f,
                "{dots} of the {} looked at cannot be seen (first: {dot:?} of \"{shot}\"): were patterns or photographs exchanged?",
                count(*of, "dot")
            ),
            Self::UnlitPoints { points, of } => write!(f, "no shot lights {points} of {}", count(*of, "grid point")),
            Self::NotLookedAt => write!(f, "the photographs' pixels were not looked at"),
            Self::Warned { warning } => write!(f, "{warning}"),
        }
    }
}
