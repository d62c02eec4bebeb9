//! Read: a capture folder — `capture.toml`, photographs, EXIF, the rig — checked before any work starts.

mod encoding;
mod exif;
mod exr_file;
mod folder;
mod jpeg;
mod jpeg_scan;
mod kept;
mod manifest;
mod photograph;
#[cfg(feature = "raw")]
mod raw;
mod recorded;
mod reduction;
mod rig;
mod rows;
mod samples;
mod settings;
mod tiff_bands;
mod together;

pub(crate) use encoding::stated_encoding;
pub use exif::ExposureFrom;
pub(crate) use exr_file::decode_exr_bytes;
pub use folder::Capture;
pub use jpeg::{NOISE_LEVELS, NOISE_STEP, change_of_variance, compression_variance, flat_variance};
pub(crate) use jpeg_scan::check_jpeg_end;
pub use kept::Kept;
pub use manifest::{
    Axis, FORMAT, Grid, Manifest, Pattern, PhotographEntry, ReferenceDots, Shot, Slab, Surface, Window,
};
pub use photograph::Photograph;
pub(crate) use photograph::decode_jpeg;
pub(crate) use recorded::{read_checksums, write_checksums};
pub use reduction::{LightOfCodes, PhotographRows, Photosite, Reduction};
pub use rig::{Board, Camera, FrameMarks, Noise, Projector, ResponseCurve, Rig, WhiteReference};
pub(crate) use rows::decode_png_bytes;
pub use samples::{Pixels, Rect, Samples, Sampling};
pub use settings::CameraSettings;
pub(crate) use together::{Taken, findings, lattice_exposures};

use crate::{Error, Result};
use std::path::Path;

pub(crate) fn parse_toml<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T> {
    toml::from_str(text).map_err(|e| {
        let line = e.span().map_or(0, |s| text[..s.start].matches('\n').count() + 1);
        Error::field(path, format!("line {line}"), "a field as docs/captures.md describes it", e.message().trim())
    })
}
