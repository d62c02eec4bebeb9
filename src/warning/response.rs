//! What the extraction of rows finds: samples, windows, cross-talk, albedo.

use super::bounds::LARGEST_ALBEDO;
use super::record::catalogue;
use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What the extraction of rows finds: samples, windows, cross-talk, albedo.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ResponseWarning {
    /// Samples that no exposure measured (saturated or outside the photograph); marked invalid.
    SaturatedSamples {
        /// The first such shot.
        first: String,
        /// How many shots.
        shots: usize,
        /// How many samples of their windows.
        samples: usize,
    },
    /// A window reaches past the sample's rim or the photograph; the samples there are marked invalid.
    ClippedWindow {
        /// How many lit points.
        rows: usize,
        /// How many samples in all.
        samples: usize,
    },
    /// Grid points that no shot lights; their rows are marked invalid.
    UnlitPoints {
        /// How many.
        rows: usize,
    },
    /// Dots of one shot are so near to each other that their rows could be told apart only with the help of a model.
    CrossTalk {
        /// The smallest distance between dots of one shot, in outgoing samples.
        spacing_samples: f64,
        /// The distance that would do without; `None` when two windows would not.
        needed_samples: Option<usize>,
        /// Share of the light in the windows that was other dots' and was removed.
        removed_share: f64,
        /// Share of the samples that are the model's rather than measured.
        modelled_share: f64,
        /// Share of a row's light by which it may still be off, all rows alike: one standard deviation.
        #[serde(default)]
        common_share: f64,
    },
    /// Rows whose albedo exceeds one: more light leaves than arrives.
    AlbedoAboveOne {
        /// How many rows.
        rows: usize,
        /// The largest albedo found.
        largest: f64,
    },
}

impl fmt::Display for ResponseWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::SaturatedSamples { first, shots, samples } => write!(
                f,
                "every exposure saturates in {} of {} (first: \"{first}\"); treated as unmeasured",
                count(*samples, "sample"),
                count(*shots, "shot")
            ),
            Self::ClippedWindow { rows, samples } => write!(
                f,
                "{} of {} outside the slab or the photograph; treated as unmeasured",
                count(*samples, "sample"),
                count(*rows, "window")
            ),
            Self::UnlitPoints { rows } => {
                write!(f, "no shot lights {}; treated as unmeasured", count(*rows, "grid point"))
            }
            Self::CrossTalk { spacing_samples, needed_samples, removed_share, modelled_share, common_share } => {
                let needed = needed_samples.map_or("more than two windows".into(), |n| count(n, "sample"));
                write!(
                    f,
                    "dots of one shot are {spacing_samples:.1} samples apart and light each other's windows: {:.1} % of the light was removed, {:.1} % of the samples are modelled; all rows alike may be {:.1} % too bright or too dark for it (standard deviation); a distance of {needed} avoids it",
                    100.0 * removed_share,
                    100.0 * modelled_share,
                    100.0 * common_share
                )
            }
            Self::AlbedoAboveOne { rows, largest } => write!(
                f,
                "more light leaves than arrives in {} (albedo up to {largest:.3}): check the white reference",
                count(*rows, "row")
            ),
        }
    }
}

catalogue!(ResponseWarning {
    Self::SaturatedSamples { first, .. } => "saturated-samples", Warning, Light, LeftOut, vec![shot(first)], None;
    Self::ClippedWindow { rows: n, .. } => "clipped-window", Note, Dots, LeftOut, vec![rows(*n)], None;
    Self::UnlitPoints { rows: n } => "unlit-points", Warning, Dots, LeftOut, vec![rows(*n)], None;
    Self::CrossTalk { needed_samples, .. } => "cross-talk", Warning, Dots, Corrected, vec![part("patterns")],
        needed_samples.and_then(|needed| bound("spacing_samples", needed as f64, "samples"));
    Self::AlbedoAboveOne { rows: n, .. } => "albedo-above-one", Warning, Light, Told,
        vec![part("white reference"), rows(*n)], bound("largest", LARGEST_ALBEDO, "");
});
