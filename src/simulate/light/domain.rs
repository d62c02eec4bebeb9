//! The box of voxels in which light is solved for, and the slab in it.

use crate::simulate::slab::{Volume, normal_reflectance};
use crate::{Error, Result, geometry::Point};

/// The most voxels of a box: 40 to 90 bytes each.
const MOST_VOXELS: usize = 1 << 26;
/// Flights that light scattered by the beam makes before it diffuses. 2: a third of the error of none in clear media,
/// three quarters of it in marble, for about the time of the solve; in cream, the densest, more flights make it worse.
const FLIGHTS: usize = 2;

/// The first layer is at most this part of a voxel's width and of the shortest mean free path, but no less than
/// [`THINNEST`] of the width.
const FIRST_OF_VOXEL: f64 = 1.0 / 3.0;

const FIRST_OF_PATH: f64 = 0.5;

const THINNEST: f64 = 0.01;

/// Layers grow by a quarter to this many widths of a voxel, and again below [`DEEP`] widths, in proportion to their
/// depth: light that comes back from there is spread wider than that.
const THICKEST: f64 = 1.4;

const DEEP: f64 = 32.0;

/// Extinction below which a medium is taken to have this much, mm⁻¹: a mean free path of 10 m is as good as none.
pub(super) const LEAST_EXTINCTION_PER_MM: f64 = 1e-4;

/// A box of voxels in slab coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Domain {
    /// The box's first corner, mm.
    pub corner_mm: Point,
    /// Side of a voxel over the plane, mm.
    pub voxel_mm: f64,
    /// Voxels along x and y.
    pub voxels: [usize; 2],
}

impl Domain {
    /// First corner of voxel `[x, y]`, mm.
    pub(crate) fn voxel_corner_mm(&self, voxel: [usize; 2]) -> Point {
        std::array::from_fn(|a| self.corner_mm[a] + voxel[a] as f64 * self.voxel_mm)
    }

    /// Number of columns.
    pub(crate) fn columns(&self) -> usize {
        self.voxels[0] * self.voxels[1]
    }

    /// What enters per mm² of a column at which a unit of flux arrives.
    pub(crate) fn entering_per_mm2(&self, refractive_index: f64) -> f64 {
        (1.0 - normal_reflectance(refractive_index)) / self.voxel_mm.powi(2)
    }
}

/// The slab as the solver sees it.
#[derive(Debug, Clone)]
pub(crate) struct SolverSlab {
    pub volume: Volume,
    /// Thickness of the solver's layers from the top, mm.
    pub layers_mm: Vec<f64>,
    /// When to stop: residual over first residual.
    pub tolerance: f64,
    /// Flights before light diffuses.
    pub flights: usize,
}

impl SolverSlab {
    /// The slab for a solver whose voxels are `voxel_mm` wide.
    pub(crate) fn new(volume: Volume, voxel_mm: f64, tolerance: f64) -> Self {
        let volume = volume.merged();
        Self { layers_mm: layers_mm(&volume, voxel_mm), volume, tolerance, flights: FLIGHTS }
    }

    /// Refuses a box of more voxels than memory is meant for.
    ///
    /// # Errors
    /// [`Error::Setting`] naming `voxels_per_sample`.
    pub(crate) fn check_size(&self, domain: &Domain) -> Result<()> {
        let voxels = domain.columns().saturating_mul(self.layers_mm.len());
        match voxels <= MOST_VOXELS {
            true => Ok(()),
            false => Err(Error::Setting {
                setting: "voxels_per_sample",
                expected: format!(
                    "a sample of at most {MOST_VOXELS} voxels (a smaller grid or window, or fewer voxels per sample)"
                ),
                found: format!("{} × {} × {} voxels", domain.voxels[0], domain.voxels[1], self.layers_mm.len()),
            }),
        }
    }
}

/// The solver's layers from the top, mm, for voxels `voxel_mm` wide: thin at the top, ending where the material's
/// layers end (unless these are thinner than half a layer).
pub(crate) fn layers_mm(volume: &Volume, voxel_mm: f64) -> Vec<f64> {
    let path = 1.0 / volume.largest_extinction_per_mm().max(LEAST_EXTINCTION_PER_MM);
    let first = (FIRST_OF_VOXEL * voxel_mm).min(FIRST_OF_PATH * path).max(THINNEST * voxel_mm);
    let most = |depth: f64| THICKEST * voxel_mm * (depth / (DEEP * voxel_mm)).max(1.0);
    let thickness = volume.thickness_mm();
    let mut layers = Vec::new();
    let (mut top, mut end) = (0.0, 0.0);
    for (n, material) in volume.layers_mm.iter().enumerate() {
        end += material;
        let next = (first + 0.25 * top).min(most(top));
        let last = n + 1 == volume.layers_mm.len();
        if !last && (end - top < 0.5 * next || thickness - end < 0.5 * next) {
            continue;
        }
        fill(&mut layers, end - top, next, |depth| most(top + depth));
        top = end;
    }
    layers
}

/// Layers that grow by a quarter from `next` to at most `most`, scaled to fill `thickness`.
fn fill(layers: &mut Vec<f64>, thickness: f64, mut next: f64, most: impl Fn(f64) -> f64) {
    let begin = layers.len();
    let mut sum = 0.0;
    while sum < thickness {
        layers.push(next);
        sum += next;
        next = (1.25 * next).min(most(sum));
    }
    layers[begin..].iter_mut().for_each(|t| *t *= thickness / sum);
}
