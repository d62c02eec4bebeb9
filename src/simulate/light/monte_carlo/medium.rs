//! A volume as one channel's photons meet it.

use crate::simulate::slab::{Beyond, Optics, Volume};

/// Optical depth beyond which light towards the camera is left out: exp(−36) is below any sum's rounding.
const OPAQUE: f64 = 36.0;

/// Coefficients at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Local {
    /// Extinction σ_t = σ_s + σ_a, mm⁻¹.
    pub extinction: f64,
    /// Scattering over extinction.
    pub albedo: f64,
    /// Mean cosine.
    pub g: f64,
}

/// A layer between two depths.
#[derive(Debug, Clone)]
pub(super) struct Layer {
    pub top_mm: f64,
    pub bottom_mm: f64,
    /// Largest extinction of the layer, mm⁻¹.
    pub majorant: f64,
    /// The coefficients, when they are the same all over the layer.
    pub uniform: Option<Local>,
    /// Otherwise where its voxels begin.
    first: usize,
}

/// A slab as one channel's photons meet it.
#[derive(Debug, Clone)]
pub struct Medium {
    pub(super) refractive_index: f64,
    pub(super) layers: Vec<Layer>,
    voxels: [i64; 2],
    origin_mm: [f64; 2],
    per_mm: [f64; 2],
    beyond: Beyond,
    locals: Vec<Local>,
}

impl Medium {
    /// `volume` as `channel` (0 to 2) sees it.
    pub fn new(volume: &Volume, channel: usize) -> Self {
        let plane = volume.voxels[0] * volume.voxels[1];
        let local = |o: &Optics| {
            let scattering = o.scattering_per_mm(channel);
            let extinction = scattering + o.absorption_per_mm[channel];
            let albedo = if extinction > 0.0 { scattering / extinction } else { 0.0 };
            Local { extinction, albedo, g: o.anisotropy[channel] }
        };
        let mut layers = Vec::with_capacity(volume.layers_mm.len());
        let mut locals = Vec::new();
        let mut depth = 0.0;
        for (optics, thickness) in volume.optics.chunks(plane).zip(&volume.layers_mm) {
            let here: Vec<Local> = optics.iter().map(local).collect();
            let (first, top_mm) = (locals.len(), depth);
            depth += thickness;
            let uniform = here.iter().all(|l| *l == here[0]).then_some(here[0]);
            let majorant = here.iter().map(|l| l.extinction).fold(0.0, f64::max);
            layers.push(Layer { top_mm, bottom_mm: depth, majorant, uniform, first });
            if uniform.is_none() {
                locals.extend(here);
            }
        }
        Self {
            refractive_index: volume.refractive_index,
            layers,
            voxels: volume.voxels.map(|n| n as i64),
            origin_mm: volume.origin_mm,
            per_mm: volume.voxel_mm.map(|v| 1.0 / v),
            beyond: volume.beyond,
            locals,
        }
    }

    /// Thickness of the slab, mm.
    pub fn thickness_mm(&self) -> f64 {
        self.layers.last().map_or(0.0, |l| l.bottom_mm)
    }

    /// Where in its layer the voxel of numbers (x, y) is.
    #[inline]
    fn place(&self, x: i64, y: i64) -> usize {
        let [nx, ny] = self.voxels;
        self.beyond.stand_in(y, ny) * nx as usize + self.beyond.stand_in(x, nx)
    }

    /// The coefficients of `layer` at (x, y).
    #[inline]
    pub(super) fn local(&self, layer: &Layer, x: f64, y: f64) -> Local {
        if let Some(uniform) = layer.uniform {
            return uniform;
        }
        self.locals[layer.first + self.place(self.number(0, x), self.number(1, y))]
    }

    /// The number of the voxel at coordinate `t`, unwrapped.
    #[inline]
    fn number(&self, a: usize, t: f64) -> i64 {
        ((t - self.origin_mm[a]) * self.per_mm[a]).floor() as i64
    }

    /// The optical depth from `p` in `layer` along direction `d` (d[2] ≠ 0) to the face that it meets; infinite beyond
    /// [`OPAQUE`].
    #[inline]
    pub(super) fn depth_to_face(&self, layer: usize, p: [f64; 3], d: [f64; 3]) -> f64 {
        let up = d[2] < 0.0;
        let (mut depth, mut z, mut layer) = (0.0, p[2], layer);
        loop {
            let here = &self.layers[layer];
            let edge = if up { here.top_mm } else { here.bottom_mm };
            let length = (edge - z) / d[2];
            depth += match here.uniform {
                Some(local) => local.extinction * length,
                None => {
                    let t = (z - p[2]) / d[2];
                    self.depth_across(here, [p[0] + t * d[0], p[1] + t * d[1]], [d[0], d[1]], length, OPAQUE - depth)
                }
            };
            if depth > OPAQUE {
                return f64::INFINITY;
            }
            if layer == if up { 0 } else { self.layers.len() - 1 } {
                return depth;
            }
            z = edge;
            layer = if up { layer - 1 } else { layer + 1 };
        }
    }

    /// The optical depth along `length` mm within one layer: from voxel to voxel, until it exceeds `most`.
    fn depth_across(&self, layer: &Layer, from: [f64; 2], d: [f64; 2], length: f64, most: f64) -> f64 {
        let mut voxel = [self.number(0, from[0]), self.number(1, from[1])];
        let mut next = [f64::INFINITY; 2];
        let mut step = [f64::INFINITY; 2];
        for a in 0..2 {
            if d[a] != 0.0 {
                let ahead = if d[a] > 0.0 { voxel[a] + 1 } else { voxel[a] };
                next[a] = (ahead as f64 / self.per_mm[a] + self.origin_mm[a] - from[a]) / d[a];
                step[a] = 1.0 / (self.per_mm[a] * d[a].abs());
            }
        }
        let (mut at, mut depth) = (0.0, 0.0);
        loop {
            let a = usize::from(next[1] < next[0]);
            let to = next[a].min(length);
            let local = self.locals[layer.first + self.place(voxel[0], voxel[1])];
            depth += local.extinction * (to - at).max(0.0);
            if to >= length || depth > most {
                return depth;
            }
            at = to;
            voxel[a] += if d[a] > 0.0 { 1 } else { -1 };
            next[a] += step[a];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn optics(extinction: f64) -> Optics {
        Optics { reduced_scattering_per_mm: [extinction; 3], absorption_per_mm: [0.0; 3], anisotropy: [0.0; 3] }
    }

    #[test]
    fn optical_depth_through_voxels_equals_fine_steps() {
        let volume = Volume {
            origin_mm: [0.2, -0.4],
            voxel_mm: [0.3, 0.7],
            voxels: [3, 2],
            layers_mm: vec![0.5, 0.8],
            beyond: Beyond::Repeat,
            optics: (0..12).map(|i| optics(0.5 + f64::from(i * 7 % 12))).collect(),
            refractive_index: 1.0,
        };
        let medium = Medium::new(&volume, 1);
        for (p, d) in [
            ([0.1, 0.3, 1.1], [0.6, 0.0, -0.8]),
            ([-2.0, 5.0, 0.45], [-0.36, 0.48, -0.8]),
            ([0.21, -0.41, 1.3], [0.0, 0.0, -1.0]),
            ([-0.7, 0.4, 0.0], [0.36, 0.48, 0.8]),
        ] {
            let layer = usize::from(p[2] > 0.5);
            let face = if d[2] < 0.0 { 0.0 } else { 1.3 };
            let (steps, length) = (200_000, (face - p[2]) / d[2]);
            let sum: f64 = (0..steps)
                .map(|i| {
                    let t = (f64::from(i) + 0.5) / f64::from(steps) * length;
                    let z = p[2] + t * d[2];
                    let layer = &medium.layers[usize::from(z > 0.5)];
                    medium.local(layer, p[0] + t * d[0], p[1] + t * d[1]).extinction
                })
                .sum();
            let (exact, dense) = (medium.depth_to_face(layer, p, d), sum * length / f64::from(steps));
            // The midpoint rule misplaces each of some ten edges by a step.
            assert!((exact - dense).abs() < 10.0 * 12.0 * length / f64::from(steps), "{exact} {dense}");
        }
    }
}
