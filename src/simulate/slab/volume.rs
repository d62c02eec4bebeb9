//! The slab as both transport solvers see it: voxels of optical coefficients between two parallel faces.

use super::Optics;
use crate::geometry::Point;
use serde::{Deserialize, Serialize};

/// What lies beside the voxels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Beyond {
    /// The same voxels again, endlessly.
    Repeat,
    /// The voxels of the border, endlessly.
    Extend,
}

impl Beyond {
    /// The voxel of 0..`n` that stands for number `i`, which may lie beside them.
    #[inline]
    pub(crate) fn stand_in(self, i: i64, n: i64) -> usize {
        match self {
            Self::Repeat => i.rem_euclid(n) as usize,
            Self::Extend => i.clamp(0, n - 1) as usize,
        }
    }
}

/// A slab without sides: coefficients per voxel, one refractive index. Slab coordinates in mm, z downwards from the
/// top.
///
/// Between voxels the refractive index does not change: light is refracted and reflected at the two faces only.
#[derive(Debug, Clone, PartialEq)]
pub struct Volume {
    /// Refractive index against air, ≥ 1.
    pub refractive_index: f64,
    /// First corner of voxel [0, 0], mm.
    pub origin_mm: Point,
    /// Sides of a voxel along x and y, mm.
    pub voxel_mm: [f64; 2],
    /// Voxels along x and y.
    pub voxels: [usize; 2],
    /// Thickness of the voxel layers from the top, mm; their sum is the slab's.
    pub layers_mm: Vec<f64>,
    /// What lies beside the voxels.
    pub beyond: Beyond,
    /// Coefficients, `[layer][y][x]`.
    pub optics: Vec<Optics>,
}

impl Volume {
    /// One medium everywhere.
    pub fn uniform(optics: Optics, refractive_index: f64, thickness_mm: f64) -> Self {
        Self::layered(&[(optics, thickness_mm)], refractive_index)
    }

    /// Layers from the top, each with its thickness in mm.
    pub fn layered(layers: &[(Optics, f64)], refractive_index: f64) -> Self {
        Self {
            refractive_index,
            origin_mm: [0.0; 2],
            voxel_mm: [1.0; 2],
            voxels: [1, 1],
            layers_mm: layers.iter().map(|(_, thickness)| *thickness).collect(),
            beyond: Beyond::Extend,
            optics: layers.iter().map(|(optics, _)| *optics).collect(),
        }
    }

    /// Thickness of the slab, mm.
    pub fn thickness_mm(&self) -> f64 {
        self.layers_mm.iter().sum()
    }

    /// The same slab with neighbouring layers of equal voxels joined.
    pub fn merged(self) -> Self {
        let plane = self.voxels[0] * self.voxels[1];
        let layer = |k: usize| &self.optics[k * plane..(k + 1) * plane];
        if (1..self.layers_mm.len()).all(|k| layer(k - 1) != layer(k)) {
            return self;
        }
        let mut merged = Self { layers_mm: Vec::new(), optics: Vec::new(), ..self };
        for (layer, thickness) in self.optics.chunks(plane).zip(&self.layers_mm) {
            match (merged.optics.len().checked_sub(plane), merged.layers_mm.last_mut()) {
                (Some(last), Some(above)) if merged.optics[last..] == *layer => *above += thickness,
                _ => {
                    merged.layers_mm.push(*thickness);
                    merged.optics.extend_from_slice(layer);
                }
            }
        }
        merged
    }

    /// The largest extinction σ'_s + σ_a of any channel, mm⁻¹.
    pub fn largest_extinction_per_mm(&self) -> f64 {
        let extinction = |o: &Optics| (0..3).map(|c| o.extinction_per_mm(c)).fold(0.0, f64::max);
        self.optics.iter().map(extinction).fold(0.0, f64::max)
    }

    /// The layers that `from..to` (mm of depth) overlaps, each with its share of the length; shares sum to 1.
    pub fn depth_shares(&self, from: f64, to: f64) -> Vec<(usize, f64)> {
        let last = self.layers_mm.len() - 1;
        let (mut above, mut shares) = (0.0, Vec::new());
        for (layer, thickness) in self.layers_mm.iter().enumerate() {
            // The last layer takes what rounding leaves below it.
            let below = if layer == last { f64::INFINITY } else { above + thickness };
            let share = (to.min(below) - from.max(above)) / (to - from);
            if share > 0.0 {
                shares.push((layer, share));
            }
            above += thickness;
        }
        shares
    }

    /// Whether the slab is the same wherever light enters.
    pub fn is_laterally_uniform(&self) -> bool {
        let plane = self.voxels[0] * self.voxels[1];
        self.optics.chunks(plane).all(|layer| layer.iter().all(|o| *o == layer[0]))
    }

    /// The voxel along axis `a` (0: x, 1: y) that holds coordinate `t` (mm).
    #[inline]
    pub fn voxel_at(&self, a: usize, t: f64) -> usize {
        let n = self.voxels[a];
        if n == 1 {
            return 0;
        }
        self.wrap(a, ((t - self.origin_mm[a]) / self.voxel_mm[a]).floor() as i64)
    }

    /// The voxel that stands for number `i` along axis `a`, which may lie beside the grid.
    fn wrap(&self, a: usize, i: i64) -> usize {
        self.beyond.stand_in(i, self.voxels[a] as i64)
    }

    /// The voxels along axis `a` that `from..to` (mm) overlaps, each with its share of the length; shares sum to 1.
    pub fn shares(&self, a: usize, from: f64, to: f64) -> Vec<(usize, f64)> {
        if self.voxels[a] == 1 {
            return vec![(0, 1.0)];
        }
        let scaled = |t: f64| (t - self.origin_mm[a]) / self.voxel_mm[a];
        let (from, to) = (scaled(from), scaled(to));
        let overlap = |i: i64| ((i + 1) as f64).min(to) - (i as f64).max(from);
        (from.floor() as i64..to.ceil() as i64)
            .map(|i| (self.wrap(a, i), overlap(i) / (to - from)))
            .filter(|(_, share)| *share > 0.0)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(beyond: Beyond) -> Volume {
        let medium =
            |s: f64| Optics { reduced_scattering_per_mm: [s; 3], absorption_per_mm: [0.0; 3], anisotropy: [0.0; 3] };
        Volume {
            voxels: [3, 1],
            voxel_mm: [0.5, 1.0],
            origin_mm: [1.0, 0.0],
            beyond,
            optics: [1.0, 2.0, 3.0].map(medium).to_vec(),
            ..Volume::uniform(medium(1.0), 1.3, 2.0)
        }
    }

    #[test]
    fn voxels_go_on_as_asked() {
        let at = |beyond, t| row(beyond).voxel_at(0, t);
        assert_eq!([0.9, 1.1, 2.4, 2.6].map(|t| at(Beyond::Repeat, t)), [2, 0, 2, 0]);
        assert_eq!([0.9, 1.1, 2.4, 2.6].map(|t| at(Beyond::Extend, t)), [0, 0, 2, 2]);
    }

    #[test]
    fn equal_layers_are_joined_and_others_kept() {
        let [a, b] = [1.0, 2.0].map(|s| Optics {
            reduced_scattering_per_mm: [s; 3],
            absorption_per_mm: [0.0; 3],
            anisotropy: [0.0; 3],
        });
        let slab = Volume::layered(&[(a, 1.0), (a, 0.5), (b, 1.0), (a, 0.25), (a, 0.25)], 1.3);
        assert_eq!(slab.merged(), Volume::layered(&[(a, 1.5), (b, 1.0), (a, 0.5)], 1.3));
        let plain = Volume::layered(&[(a, 1.0), (b, 1.0)], 1.3);
        assert_eq!(plain.clone().merged(), plain);
        let shares = plain.depth_shares(0.5, 1.75);
        assert!(shares.iter().zip([(0, 0.4), (1, 0.6)]).all(|(s, e)| s.0 == e.0 && (s.1 - e.1).abs() < 1e-12));
        // Rounding may put the solver's bottom a little deeper than the slab's.
        assert_eq!(plain.depth_shares(1.5, 2.0 + 1e-12), [(1, 1.0)]);
    }

    #[test]
    fn shares_are_lengths() {
        let shares = row(Beyond::Repeat).shares(0, 0.9, 1.75);
        let expected = [(2, 0.1 / 0.85), (0, 0.5 / 0.85), (1, 0.25 / 0.85)];
        assert_eq!(shares.len(), 3);
        for ((voxel, share), (v, s)) in shares.iter().zip(expected) {
            assert!(*voxel == v && (share - s).abs() < 1e-12, "{shares:?}");
        }
        assert_eq!(row(Beyond::Extend).shares(1, -3.0, 7.0), [(0, 1.0)]);
    }
}
