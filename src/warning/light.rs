//! What lighting a slab finds.

use super::record::catalogue;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What lighting a slab finds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum LightWarning {
    /// An image without an extent has another aspect ratio than the lit area that it is laid over.
    LightStretched {
        /// Width over height of the image, all its copies together.
        image_ratio: f64,
        /// Width over height of the lit area.
        area_ratio: f64,
        /// How far the rim of the image lies from where square pixels would put it, mm.
        off_mm: f64,
        /// From where on that is more than rounding: an outgoing sample, or half a pixel of the image, mm.
        limit_mm: f64,
    },
}

impl fmt::Display for LightWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self::LightStretched { image_ratio, area_ratio, off_mm, .. } = self;
        write!(
            f,
            "the image is {image_ratio:.3} times as wide as high, the lit area {area_ratio:.3} times: stretched over it, the image's rim lies {off_mm:.2} mm from where square pixels would put it"
        )
    }
}

catalogue!(LightWarning {
    Self::LightStretched { limit_mm, .. } => "light-stretched", Warning, Relighting, Told, vec![field("light")],
        bound("off_mm", *limit_mm, "mm");
});
