//! The factored material, see [`acquire_material`], with what a person does with its files: read and write them, light
//! a matrix or a material with an image, export.

mod exr_layers;
mod light_file;
#[cfg(test)]
#[allow(dead_code, reason = "some is only for the other crate's tests")]
#[path = "../../crates/acquire-material/src/naive.rs"]
mod naive;
mod npz;
mod relight;
mod source;

pub use acquire_material::{
    Canvas, Evaluator, ExitGrid, Exitance, FIXED_SET, ImagePlacement, Layout, Light, LightImage, LitArea, Material,
    MaterialHeader, Model, OffsetFactors, Precision, Quadrature, Responses, Sampled, Shape, SharedBasis, coded,
    legendre,
};
pub use exr_layers::{export_exr, write_exitance, write_png};
pub use light_file::{parse_light, read_light_image};
pub use npz::export_npz;
pub use relight::{lit_area, place_light, relight};
pub(crate) use relight::{lit_area_of, splat, splat_entries};
pub use source::Source;

use crate::output::write_whole;
use crate::{Error, Result};
use std::path::Path;

/// Numbers of a row and sample: R, G, B.
const CHANNELS: usize = 3;

/// Reads a material, plain or coded.
///
/// # Errors
/// [`Error::Io`], [`Error::BrokenMaterial`].
pub fn load(path: &Path) -> Result<Material> {
    Ok(Material::load(path)?)
}

/// Writes a plain material under a temporary name, and renames it when complete.
///
/// # Errors
/// [`Error::Io`]; [`Error::Setting`] for half precision where colour is a polynomial; [`Error::Internal`] when the
/// material's arrays do not have the lengths that its header says.
pub fn save(material: &Material, precision: Precision, path: &Path) -> Result<()> {
    let bytes = match precision {
        Precision::F32 => material.to_bytes()?,
        Precision::F16 => material.to_half_bytes()?,
        Precision::Coded => coded::encode(material, &coded::EncodeOptions::default())?.bytes,
    };
    write_whole(path, bytes)
}

impl From<acquire_material::Error> for Error {
    fn from(error: acquire_material::Error) -> Self {
        use acquire_material::Error as Of;
        match error {
            Of::Io { path, source } => Self::Io { path, action: "read", source },
            Of::Damaged { path: Some(path), reason } => Self::BrokenMaterial { path, reason },
            Of::Option { option: setting, expected, found } => Self::Setting { setting, expected, found },
            other => Self::internal(other),
        }
    }
}
