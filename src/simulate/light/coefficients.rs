//! The slab on the solver's grid: its layers, and the mean coefficients of its voxels.

use super::domain::{Domain, LEAST_EXTINCTION_PER_MM, SolverSlab};

/// σ'_s and σ_a (mm⁻¹) of one channel on the solver's voxels.
#[derive(Debug)]
pub(crate) struct Coefficients {
    /// One plane that stands for every layer, or one for each.
    values: Vec<(f64, f64)>,
    plane: usize,
}

impl Coefficients {
    /// Means over the voxels of `domain`: products of the shares along x, y and z.
    pub(crate) fn new(slab: &SolverSlab, domain: &Domain, channel: usize) -> Self {
        let volume = &slab.volume;
        let along = |a: usize| -> Vec<Vec<(usize, f64)>> {
            let at = |i: usize| domain.corner_mm[a] + i as f64 * domain.voxel_mm;
            (0..domain.voxels[a]).map(|i| volume.shares(a, at(i), at(i + 1))).collect()
        };
        let (columns, rows) = (along(0), along(1));
        // A voxel that only a wrapped or border voxel stands for is looked up as often as it is needed, no more.
        let mut needed: Vec<usize> = columns.iter().flatten().map(|(x, _)| *x).collect();
        needed.sort_unstable();
        needed.dedup();
        let place = |x: usize| needed.binary_search(&x).unwrap_or(0);
        let columns: Vec<Vec<(usize, f64)>> =
            columns.iter().map(|shares| shares.iter().map(|(x, share)| (place(*x), *share)).collect()).collect();
        let mut values = Vec::new();
        let mut line = vec![(0.0, 0.0); needed.len()];
        for layers in depths(slab) {
            for rows in &rows {
                line.fill((0.0, 0.0));
                for (z, z_share) in &layers {
                    for (y, y_share) in rows {
                        let row = &volume.optics[(z * volume.voxels[1] + y) * volume.voxels[0]..][..volume.voxels[0]];
                        for (sum, x) in line.iter_mut().zip(&needed) {
                            sum.0 += z_share * y_share * row[*x].reduced_scattering_per_mm[channel];
                            sum.1 += z_share * y_share * row[*x].absorption_per_mm[channel];
                        }
                    }
                }
                let mean = |part: &dyn Fn((f64, f64)) -> f64, shares: &[(usize, f64)]| {
                    shares.iter().map(|(x, share)| share * part(line[*x])).sum::<f64>()
                };
                values.extend(columns.iter().map(|shares| {
                    let (scattering, absorption) = (mean(&|v| v.0, shares), mean(&|v| v.1, shares));
                    // What is missing is absorption-free scattering without consequence: the box is far smaller.
                    let missing = (LEAST_EXTINCTION_PER_MM - scattering - absorption).max(0.0);
                    (scattering + missing, absorption)
                }));
            }
        }
        Self { values, plane: domain.columns() }
    }

    /// All planes there are.
    pub(crate) fn all(&self) -> &[(f64, f64)] {
        &self.values
    }

    /// The plane of layer `k`.
    pub(crate) fn layer(&self, k: usize) -> &[(f64, f64)] {
        match self.values.len() == self.plane {
            true => &self.values,
            false => &self.values[k * self.plane..(k + 1) * self.plane],
        }
    }
}

/// The material layers of each solver layer with their shares; once for all when there is but one material layer.
fn depths(slab: &SolverSlab) -> Vec<Vec<(usize, f64)>> {
    if slab.volume.layers_mm.len() == 1 {
        return vec![vec![(0, 1.0)]];
    }
    let mut above = 0.0;
    let shares = slab.layers_mm.iter().map(|dz| {
        above += dz;
        slab.volume.depth_shares(above - dz, above)
    });
    shares.collect()
}
