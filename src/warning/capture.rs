//! What reading a capture finds: exposure times, EXIF, settings.

use super::bounds::EXPOSURE_TOLERANCE;
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
    /// Photographs of 8 bits among such of more, or the other way round, while code values are in proportion to light: one rig cannot
    /// describe both.
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
});
