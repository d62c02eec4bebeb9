//! What the import of a matrix from arrays finds.

use super::bounds::{LARGEST_ALBEDO, LIGHT_OUTSIDE};
use super::record::catalogue;
use crate::words::{count, figure};
use serde::{Deserialize, Serialize};
use std::fmt;

/// What the import of a matrix from arrays finds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ArraysWarning {
    /// Responses below zero, which are kept.
    NegativeResponses {
        /// How many.
        entries: usize,
        /// Their sum over that of all others.
        share: f64,
        /// The lowest, mm⁻².
        lowest: f64,
        /// Where it is.
        at: String,
    },
    /// Samples without a number; marked as not measured.
    UnmeasuredSamples {
        /// How many.
        entries: usize,
        /// Of how many.
        of: usize,
        /// The first of them.
        at: String,
    },
    /// Light of a full matrix that lies outside the windows, and is not in the store.
    LightOutsideWindow {
        /// Its share of all responses, by magnitude.
        share: f64,
        /// Samples of the window along x and y.
        window: [usize; 2],
    },
    /// Rows whose sum times the area of a sample exceeds one: more light leaves than arrives.
    ImportedAlbedo {
        /// How many rows.
        rows: usize,
        /// The largest albedo found.
        largest: f64,
        /// Side of a sample, mm.
        pitch_mm: f64,
    },
}

impl fmt::Display for ArraysWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NegativeResponses { entries, share, lowest, at } => write!(
                f,
                "response: {} below zero ({:.2} % of the light), lowest {lowest:.3e} at {at}; kept",
                count(*entries, "number"),
                100.0 * share
            ),
            Self::UnmeasuredSamples { entries, of, at } => write!(
                f,
                "response: {entries} of {} NaN or marked invalid, first {at}; treated as unmeasured",
                count(*of, "number")
            ),
            Self::LightOutsideWindow { share, window } => write!(
                f,
                "{:.3} % of the light lies outside the window of {}×{} samples, and is left out",
                100.0 * share,
                window[0],
                window[1]
            ),
            Self::ImportedAlbedo { rows, largest, pitch_mm } => write!(
                f,
                "more light leaves than arrives in {} (albedo up to {}, the sum of a row times {pitch_mm}² mm²): check pitch_mm, and that response is in mm⁻²",
                count(*rows, "row"),
                figure(*largest)
            ),
        }
    }
}

catalogue!(ArraysWarning {
    Self::NegativeResponses { .. } => "negative-responses", Warning, Arrays, Told, vec![field("response")], None;
    Self::UnmeasuredSamples { .. } => "unmeasured-samples", Note, Arrays, LeftOut, vec![field("response")], None;
    Self::LightOutsideWindow { share, .. } if *share > LIGHT_OUTSIDE => "light-outside-window", Warning, Arrays, LeftOut,
        vec![field("window")], bound("share", LIGHT_OUTSIDE, "");
    Self::LightOutsideWindow { .. } => "light-outside-window", Note, Arrays, LeftOut, vec![field("window")], None;
    Self::ImportedAlbedo { rows: n, .. } => "imported-albedo", Warning, Arrays, Told, vec![rows(*n)], bound("largest", LARGEST_ALBEDO, "");
});
