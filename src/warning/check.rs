//! What looking at a capture's files and at the pixels of some of its shots finds, and what stops the work.

use super::bounds::{BLACK_SHARE, BLUR_SHARE, DARK_SHARE, DRIFT_SHARE, SATURATED_SHARE};
use super::record::catalogue;
use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What looking at a capture's files and at the pixels of some of its shots finds, and what stops the work. Lists name
/// their first member and count the rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum CheckWarning {
    /// What stops the work and has no name of its own.
    Stopped {
        /// The error's message.
        reason: String,
    },
    /// A photograph that is not there.
    MissingPhotograph {
        /// The file.
        file: String,
        /// Its shot.
        shot: String,
    },
    /// A photograph that is no whole image.
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
    /// Two photographs of one shot with the same exposure.
    SameExposure {
        /// The shot.
        shot: String,
        /// One photograph.
        first: String,
        /// The other.
        second: String,
        /// Their exposure time, s.
        exposure_secs: f64,
    },
    /// A field of capture.toml, rig.toml or another file whose value cannot be used.
    UnusableField {
        /// The file.
        file: String,
        /// The field.
        field: String,
        /// What it should have been.
        expected: String,
        /// What it was.
        found: String,
    },
    /// Board, frame, Gray code or reference dots were not found, or do not fit.
    RegistrationFailed {
        /// The photograph or manifest.
        file: String,
        /// The shot.
        shot: String,
        /// Why.
        reason: String,
    },
    /// A dot that the patterns put beside the slab.
    DotOutsideSlab {
        /// The shot.
        shot: String,
        /// The dot's grid index (x, y).
        dot: [usize; 2],
        /// Where it may be.
        expected: String,
        /// Where it is.
        found: String,
    },
    /// A dot whose peak no exposure measured.
    DotSaturated {
        /// The shortest photograph of its shot.
        file: String,
        /// The shot.
        shot: String,
        /// The dot's grid index (x, y).
        dot: [usize; 2],
        /// The shortest exposure time of the shot, s.
        shortest_secs: f64,
    },
    /// A photograph all of whose code values are multiples of a power of two, where those of other shots are not.
    ValuesShifted {
        /// The photograph.
        file: String,
        /// Its shot; `None`: all of the capture, which also exceeds the rig's saturation.
        shot: Option<String>,
        /// By how many bits.
        bits: u32,
    },
    /// All photographs have 8 bits, and the rig's figures of noise are those of more.
    EightBits {
        /// One of them.
        file: String,
        /// The rig's saturation, beyond what 8 bits hold.
        saturation_dn: f64,
    },
    /// The Gray code fits, with all dots on the slab, when the photographs of a pattern and its inverse are exchanged,
    /// and not as it is.
    GrayPairExchanged {
        /// The pattern's shot.
        shot: String,
        /// Its inverse's.
        inverse: String,
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
        /// How many dots of the shots that were looked at.
        dots: usize,
        /// Of how many.
        of: usize,
    },
    /// Pixels that even the longest exposure does not tell from black.
    Dark {
        /// The darkest shot.
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
        /// How many dots of the shots that were looked at.
        dots: usize,
        /// Of how many.
        of: usize,
    },
    /// Lattice shots were not looked at, because something before them failed.
    NotLookedAt,
}

catalogue!(CheckWarning {
    Self::Stopped { .. } => "stopped", Error, Files, Refused, vec![], None;
    Self::MissingPhotograph { file, shot: name } => "missing-photograph", Error, Files, Refused,
        vec![photograph(file), shot(name)], None;
    Self::BrokenPhotograph { file, shot: name, .. } => "broken-photograph", Error, Files, Refused,
        vec![photograph(file), shot(name)], None;
    Self::WrongSize { file, .. } => "wrong-size", Error, Files, Refused, vec![photograph(file)], None;
    Self::NoExposure { file } => "no-exposure", Error, Exposures, Refused, vec![photograph(file)], None;
    Self::SameExposure { shot: name, first, second, .. } => "same-exposure", Error, Exposures, Refused,
        vec![photograph(first), photograph(second), shot(name)], None;
    Self::UnusableField { file, field: name, .. } => "unusable-field", Error, Files, Refused,
        vec![photograph(file), field(name)], None;
    Self::RegistrationFailed { file, shot: name, .. } => "registration-failed", Error, Registration, Refused,
        vec![photograph(file), shot(name)], None;
    Self::DotOutsideSlab { shot: name, dot: at, .. } => "dot-outside-slab", Error, Dots, Refused,
        vec![shot(name), dot(*at)], None;
    Self::DotSaturated { file, shot: name, dot: at, .. } => "dot-saturated", Error, Light, Refused,
        vec![photograph(file), shot(name), dot(*at)], None;
    Self::ValuesShifted { file, .. } => "values-shifted", Error, Files, Refused, vec![photograph(file)], None;
    Self::EightBits { file, .. } => "eight-bits", Error, Files, Refused,
        vec![photograph(file), field("noise.saturation_dn")], bound("saturation_dn", f64::from(u8::MAX), "DN");
    Self::GrayPairExchanged { shot: name, inverse } => "gray-pair-exchanged", Error, Registration, Refused,
        vec![shot(name), shot(inverse)], None;
    Self::Saturated { shot: name, .. } => "saturated", Warning, Light, Told, vec![shot(name)],
        bound("share", SATURATED_SHARE, "");
    Self::SaturatedDots { shot: name, .. } => "saturated-dots", Warning, Light, Told, vec![shot(name)],
        bound("dots", 0.0, "");
    Self::Dark { shot: name, share } if *share > BLACK_SHARE => "dark", Warning, Light, Told, vec![shot(name)],
        bound("share", BLACK_SHARE, "");
    Self::Dark { shot: name, .. } => "dark", Note, Light, Told, vec![shot(name)], bound("share", DARK_SHARE, "");
    Self::Blurred { sample_px, .. } => "blurred", Warning, Focus, Told, vec![part("lens")],
        bound("psf_px", BLUR_SHARE * sample_px, "px");
    Self::LargeDrift { shot: name, most_px, .. } => "large-drift", Warning, Drift, Told, vec![shot(name)],
        bound("drift_px", DRIFT_SHARE * most_px, "px");
    Self::DeadDots { shot: name, dot: at, .. } => "dead-dots", Warning, Dots, Told, vec![shot(name), dot(*at)],
        bound("dots", 0.0, "");
    Self::NotLookedAt => "not-looked-at", Note, Dots, Told, vec![], None;
});

/// A share as people read it.
fn percent(share: f64) -> String {
    format!("{:.1} %", 100.0 * share)
}

impl fmt::Display for CheckWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stopped { reason } => write!(f, "{reason}"),
            Self::MissingPhotograph { file, shot } => write!(f, "{file} of shot \"{shot}\" is missing"),
            Self::BrokenPhotograph { file, shot, reason } => write!(f, "{file} of shot \"{shot}\": {reason}"),
            Self::WrongSize { file, expected_px: [w, h], found_px: [x, y] } => {
                write!(f, "{file} has {x} × {y} px, but camera.size_px of rig.toml is {w} × {h} px")
            }
            Self::NoExposure { file } => write!(f, "{file}: no exposure time in EXIF or capture.toml"),
            Self::SameExposure { shot, first, second, exposure_secs } => {
                write!(f, "{first} and {second} of shot \"{shot}\" both have an exposure of {exposure_secs} s")
            }
            Self::UnusableField { file, field, expected, found } => {
                write!(f, "{file}: {field}: expected {expected}, found {found}")
            }
            Self::RegistrationFailed { file, shot, reason } => write!(f, "{file} of shot \"{shot}\": {reason}"),
            Self::DotOutsideSlab { shot, dot, expected, found } => {
                write!(f, "\"{shot}\": dot {dot:?} is at {found}, expected {expected}")
            }
            Self::DotSaturated { shot, dot, shortest_secs, .. } => write!(
                f,
                "\"{shot}\": dot {dot:?} is saturated in every exposure, the shortest of {shortest_secs} s too"
            ),
            Self::ValuesShifted { file, shot: Some(shot), bits } => write!(
                f,
                "{file}: the code values of shot \"{shot}\" are shifted left by {}: all are multiples of {}, those of other shots are not",
                count(*bits as usize, "bit"),
                1u32 << bits
            ),
            Self::ValuesShifted { file, shot: None, bits } => write!(
                f,
                "{file}: all code values of the capture are multiples of {} and exceed noise.saturation_dn of rig.toml: they are shifted left by {}",
                1u32 << bits,
                count(*bits as usize, "bit")
            ),
            Self::EightBits { file, saturation_dn } => write!(
                f,
                "{file}: the photographs have 8 bits, code values up to 255, and noise.saturation_dn of rig.toml is {saturation_dn}: [noise] is that of other files"
            ),
            Self::GrayPairExchanged { shot, inverse } => write!(
                f,
                "the photographs of \"{shot}\" and \"{inverse}\" are exchanged: the other way round the Gray code fits and all dots are on the slab"
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
            Self::NotLookedAt => write!(f, "the photographs' pixels were not looked at"),
        }
    }
}
