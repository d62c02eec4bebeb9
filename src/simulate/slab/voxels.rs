//! A slab from a voxel file: NumPy's NPZ, or a Zarr group.
//!
//! | array | shape | unit, range |
//! |---|---|---|
//! | `reduced_scattering_per_mm` | z, y, x, channel (R, G, B) | σ'_s, mm⁻¹, 0 to 10⁶ |
//! | `absorption_per_mm` | the same | σ_a, mm⁻¹, 0 to 10⁶ |
//! | `voxel_mm` | 3 (x, y, z), 1 or none | sides of a voxel, mm, 10⁻⁴ to 10³ |
//! | `anisotropy` (optional) | that of the scattering, or none | g, −0.99 to 0.99; 0 |
//! | `refractive_index` (optional) | 1 or none | 1 to 2.5; 1.3 |
//!
//! Numbers are f32 or f64. z goes down from the lit face, x and y are the slab's; the block is centred on the lit area,
//! its border voxels go on beyond it, and its depth is the slab's thickness.
//!
//! Shapes are checked before memory is set aside for the numbers, so that a damaged file costs none.

mod npz;
mod zarr;

use super::{Beyond, Optics, Volume};
use crate::{Error, Result};
use std::path::Path;

/// The most voxels: 72 bytes each while light is followed.
pub const MOST_VOXELS: usize = 1 << 23;
const SCATTERING: &str = "reduced_scattering_per_mm";
const ABSORPTION: &str = "absorption_per_mm";
const ANISOTROPY: &str = "anisotropy";

/// A voxel file's slab, its first corner at the origin.
#[derive(Debug, Clone, PartialEq)]
pub struct VoxelFile {
    /// The slab.
    pub volume: Volume,
    /// BLAKE3 of the file, or of all files of the group with their names.
    pub blake3: String,
}

/// An array as it was stored, in C order.
#[derive(Debug)]
struct Array {
    shape: Vec<usize>,
    values: Vec<f64>,
}

/// Where arrays come from. `None`: there is no such array. Arrays of more than `most` numbers are refused unread.
trait Arrays {
    fn array(&mut self, name: &str, most: usize) -> Result<Option<Array>>;
    fn blake3(&mut self) -> Result<String>;
}

/// Reads a voxel file; `anisotropy` is that of every voxel, for a file that has none of its own.
///
/// # Errors
/// [`Error::Io`]; [`Error::Voxels`] naming file and array for what cannot be used; [`Error::Setting`] when both
/// `anisotropy` and the file say g.
pub fn read(path: &Path, anisotropy: Option<f64>) -> Result<VoxelFile> {
    let kind = std::fs::metadata(path).map_err(Error::io("read", path))?;
    let mut arrays: Box<dyn Arrays> =
        if kind.is_dir() { Box::new(zarr::ZarrGroup::open(path)?) } else { Box::new(npz::Archive::open(path)?) };
    let volume = assemble(path, arrays.as_mut(), anisotropy)?;
    Ok(VoxelFile { volume, blake3: arrays.blake3()? })
}

fn assemble(path: &Path, arrays: &mut dyn Arrays, anisotropy: Option<f64>) -> Result<Volume> {
    let missing = |name: &str| refused(path, name, "an array of this name", "none");
    // The small ones first: their mistakes cost nothing.
    let side = arrays.array("voxel_mm", 3)?.ok_or_else(|| missing("voxel_mm"))?;
    let sides: [f64; 3] = match side.values[..] {
        [s] => [s; 3],
        [x, y, z] => [x, y, z],
        _ => return Err(refused(path, "voxel_mm", "three sides x, y, z or one", format!("{:?}", side.shape))),
    };
    for s in sides {
        within(path, "voxel_mm", s, 1e-4, 1e3)?;
    }
    let refractive_index = match arrays.array("refractive_index", 1)? {
        Some(Array { values, shape }) => match values[..] {
            [n] => n,
            _ => return Err(refused(path, "refractive_index", "one number", format!("shape {shape:?}"))),
        },
        None => 1.3,
    };
    within(path, "refractive_index", refractive_index, 1.0, 2.5)?;

    let most = 3 * MOST_VOXELS;
    let scattering = arrays.array(SCATTERING, most)?.ok_or_else(|| missing(SCATTERING))?;
    let shape = scattering.shape.clone();
    let &[nz, ny, nx, 3] = &shape[..] else {
        return Err(refused(path, SCATTERING, "shape [z, y, x, 3]", format!("{shape:?}")));
    };
    if nz * ny * nx == 0 {
        return Err(refused(path, SCATTERING, "a voxel or more", format!("shape {shape:?}")));
    }
    within(path, "voxel_mm, the slab's thickness in mm", nz as f64 * sides[2], 1e-2, 1e3)?;
    let absorption = arrays.array(ABSORPTION, most)?.ok_or_else(|| missing(ABSORPTION))?;
    if absorption.shape != shape {
        let expected = format!("shape {shape:?}, as {SCATTERING}");
        return Err(refused(path, ABSORPTION, expected, format!("{:?}", absorption.shape)));
    }
    check(path, SCATTERING, &scattering, 0.0, 1e6)?;
    check(path, ABSORPTION, &absorption, 0.0, 1e6)?;
    let g = anisotropies(path, arrays, anisotropy, &shape)?;

    let rgb = |values: &[f64], voxel: usize| std::array::from_fn(|c| values[3 * voxel + c]);
    let optics = (0..nz * ny * nx).map(|i| Optics {
        reduced_scattering_per_mm: rgb(&scattering.values, i),
        absorption_per_mm: rgb(&absorption.values, i),
        anisotropy: if g.len() == 1 { [g[0]; 3] } else { rgb(&g, i) },
    });
    Ok(Volume {
        refractive_index,
        origin_mm: [0.0; 2],
        voxel_mm: [sides[0], sides[1]],
        voxels: [nx, ny],
        layers_mm: vec![sides[2]; nz],
        beyond: Beyond::Extend,
        optics: optics.collect(),
    })
}

/// One g for all, or one for each number of `shape`.
fn anisotropies(path: &Path, arrays: &mut dyn Arrays, asked: Option<f64>, shape: &[usize]) -> Result<Vec<f64>> {
    let Some(array) = arrays.array(ANISOTROPY, 3 * MOST_VOXELS)? else {
        return Ok(vec![asked.unwrap_or(0.0)]);
    };
    if let Some(g) = asked {
        let expected = format!("no such option, as {} has the array {ANISOTROPY}", path.display());
        return Err(Error::Setting { setting: "anisotropy", expected, found: g.to_string() });
    }
    if array.values.len() != 1 && array.shape != shape {
        let expected = format!("one number or shape {shape:?}, as {SCATTERING}");
        return Err(refused(path, ANISOTROPY, expected, format!("{:?}", array.shape)));
    }
    check(path, ANISOTROPY, &array, -0.99, 0.99)?;
    Ok(array.values)
}

/// Refuses numbers outside `low..=high` and NaN.
fn check(path: &Path, name: &str, array: &Array, low: f64, high: f64) -> Result<()> {
    let Some(at) = array.values.iter().position(|v| !(*v >= low && *v <= high)) else { return Ok(()) };
    let mut index = Vec::new();
    let mut rest = at;
    for n in array.shape.iter().rev() {
        index.insert(0, rest % n);
        rest /= n;
    }
    let expected = format!("numbers from {} to {}", crate::error::number(low), crate::error::number(high));
    Err(refused(path, name, expected, format!("{} at {index:?}", crate::error::number(array.values[at]))))
}

pub(super) fn refused(
    path: &Path,
    array: impl Into<String>,
    expected: impl Into<String>,
    found: impl std::fmt::Display,
) -> Error {
    Error::Voxels { path: path.into(), array: array.into(), expected: expected.into(), found: found.to_string() }
}

fn within(path: &Path, array: &str, value: f64, low: f64, high: f64) -> Result<()> {
    let number = crate::error::number;
    match value >= low && value <= high {
        true => Ok(()),
        false => Err(refused(path, array, format!("{} to {}", number(low), number(high)), number(value))),
    }
}

/// The number of values of `shape`, unless it is more than `most`.
fn count(path: &Path, name: &str, shape: &[u64], most: usize) -> Result<usize> {
    let product = shape.iter().try_fold(1u64, |product, &n| product.checked_mul(n));
    product.filter(|n| *n <= most as u64).map(|n| n as usize).ok_or_else(|| {
        let expected = format!("at most {most} numbers");
        refused(path, name, expected, format!("shape {shape:?}"))
    })
}

#[cfg(test)]
mod tests;
