//! What reading a capture finds: exposure times, EXIF, settings.

use super::bounds::{EXPOSURE_TOLERANCE, SAME_EXPOSURE};
use super::record::catalogue;
use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What reading a capture finds: exposure times, EXIF, settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum CaptureWarning {
    /// Two sources of an exposure time disagree by more than a twentieth.
    ExposureDisagrees {
        /// The photograph.
        file: String,
        /// The time that was used.
        used_secs: f64,
        /// The time that was not.
        other_secs: f64,
        /// Where the other came from.
        other: String,
        /// How many photographs disagree alike.
        #[serde(default)]
        photographs: usize,
    },
    /// Aperture or ISO change inside the capture; the radiance scale is corrected by them.
    ApertureOrIsoChanges {
        /// The first photograph that differs.
        file: String,
        /// The relative sensitivity against the first photograph.
        factor: f64,
    },
    /// An odd EXIF block that could only be read in part.
    DamagedExif {
        /// The first such photograph.
        file: String,
        /// The reader's message about it.
        reason: String,
        /// How many photographs.
        #[serde(default)]
        photographs: usize,
    },
    /// Photographs of 8 bits among such of more, or the other way round, while code values are in proportion to light:
    /// one rig cannot describe both.
    DepthDiffers {
        /// The first such photograph.
        file: String,
        /// Its shot.
        shot: String,
        /// Bits of its code values.
        bits: u8,
        /// Those of most photographs.
        most_bits: u8,
        /// How many photographs.
        photographs: usize,
    },
    /// An EXIF field whose value cannot be (0/0, an overflow, an absurd time); it is not used.
    UnusableExif {
        /// The first such photograph.
        file: String,
        /// The field.
        tag: String,
        /// Its raw value.
        found: String,
        /// How many photographs.
        photographs: usize,
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
}

/// Exposure times as people read them.
pub(crate) fn times(secs: &[f64]) -> String {
    let each = secs.iter().map(|t| if *t < 0.3 { format!("1/{:.0}", 1.0 / t) } else { format!("{t:.1}") });
    format!("{} s", each.collect::<Vec<_>>().join(" "))
}

/// Whether radiance is scaled by a setting where it changes.
fn is_scaled(setting: &str) -> bool {
    matches!(setting, "ISO" | "f-number")
}

impl fmt::Display for CaptureWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ExposureDisagrees { file, used_secs, other_secs, other, photographs } => {
                write!(f, "{file}: the exposure of {used_secs} s is used, but {other} says {other_secs} s")?;
                if *photographs > 1 { write!(f, " (the same in {photographs} photographs)") } else { Ok(()) }
            }
            Self::ApertureOrIsoChanges { file, factor } => write!(
                f,
                "{file}: aperture or ISO differs from the first photograph's; its radiance is scaled by {factor:.4}"
            ),
            Self::DamagedExif { file, reason, photographs } => {
                write!(f, "{file}: EXIF is damaged and was read in part: {reason}")?;
                if *photographs > 1 { write!(f, " (in {photographs} photographs)") } else { Ok(()) }
            }
            Self::DepthDiffers { file, shot, bits, most_bits, photographs } => {
                write!(f, "{file} of shot \"{shot}\" has {bits} bits, most photographs have {most_bits}")?;
                if *photographs > 1 { write!(f, " (so have {photographs} in all)") } else { Ok(()) }
            }
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
            Self::SettingChanges { setting, file, photographs, expected, found } => write!(
                f,
                "{setting} changes: {found} in {} (first: {file}), {expected} in most{}",
                count(*photographs, "photograph"),
                if is_scaled(setting) { "; radiance is scaled by it" } else { "" }
            ),
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
            Self::UnusableExif { file, tag, found, photographs } => write!(
                f,
                "{file}: EXIF {tag} is {found}, an impossible value; it is ignored (in {})",
                count(*photographs, "photograph")
            ),
        }
    }
}

catalogue!(CaptureWarning {
    Self::ExposureDisagrees { file, used_secs, .. } => "exposure-disagrees", Warning, Exposures, LeftOut,
        vec![photograph(file)], bound("other_secs", used_secs * (1.0 + EXPOSURE_TOLERANCE), "s");
    Self::ApertureOrIsoChanges { file, .. } => "aperture-or-iso-changes", Warning, Settings, Corrected,
        vec![photograph(file)], bound("factor", 1.0, "");
    Self::DamagedExif { file, .. } => "damaged-exif", Note, Settings, LeftOut, vec![photograph(file)], None;
    Self::DepthDiffers { file, shot: name, .. } => "depth-differs", Warning, Files, Told,
        vec![photograph(file), shot(name)], None;
    Self::UnusableExif { file, tag, .. } => "unusable-exif", Note, Exposures, LeftOut,
        vec![photograph(file), field(tag)], None;
    Self::NoExif { file, .. } => "no-exif", Note, Settings, Told, vec![photograph(file)], None;
    Self::AutomaticExposure { file, .. } => "automatic-exposure", Warning, Settings, Told, vec![photograph(file)], None;
    Self::AutomaticWhiteBalance { file, .. } => "automatic-white-balance", Warning, Settings, Told,
        vec![photograph(file)], None;
    Self::SettingChanges { file, setting, .. } if is_scaled(setting) => "setting-changes", Warning, Settings, Corrected,
        vec![photograph(file), field(setting)], None;
    Self::SettingChanges { file, setting, .. } => "setting-changes", Warning, Settings, Told,
        vec![photograph(file), field(setting)], None;
    Self::BracketDiffers { shot: name, .. } => "bracket-differs", Warning, Exposures, Told, vec![shot(name)],
        bound("found_secs / expected_secs - 1", SAME_EXPOSURE, "");
    Self::OutOfOrder { file, lattice: true, .. } => "out-of-order", Warning, Order, Told, vec![photograph(file)], None;
    Self::OutOfOrder { file, lattice: false, .. } => "out-of-order", Note, Order, Told, vec![photograph(file)], None;
});
