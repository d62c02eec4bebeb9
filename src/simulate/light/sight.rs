//! The way from a place on the slab to an eye above it.

use super::fresnel::{Passage, face};
use crate::geometry::Point;

/// A line of sight, refracted by the top face.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sight {
    /// Direction inside the slab, upwards.
    pub up: [f64; 3],
    /// Its cosine to the normal.
    pub cosine: f64,
    /// Shift along x and y per depth.
    pub slope: [f64; 2],
    /// Share of light that the face turns back, on either side.
    pub reflectance: f64,
}

impl Sight {
    /// From `at` (mm) to `eye_mm` (z negative: above), out of a slab of this refractive index.
    pub(super) fn new(at: Point, eye_mm: [f64; 3], refractive_index: f64) -> Self {
        let to = [eye_mm[0] - at[0], eye_mm[1] - at[1], eye_mm[2]];
        let length = to.iter().map(|v| v * v).sum::<f64>().sqrt();
        let Passage { reflectance, cosine } = face(1.0 / refractive_index, -to[2] / length);
        let up = [to[0] / length / refractive_index, to[1] / length / refractive_index, -cosine];
        Self { up, cosine, slope: [up[0] / cosine, up[1] / cosine], reflectance }
    }

    /// Where light from `p` on this way, up or down, is at depth `z` (mm).
    #[inline]
    pub(super) fn along(&self, p: [f64; 3], z: f64) -> [f64; 3] {
        let depth = (p[2] - z).abs();
        [p[0] + depth * self.slope[0], p[1] + depth * self.slope[1], z]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sight_is_refracted_after_snell() {
        let n = 1.4;
        let sight = Sight::new([1.0, 2.0], [4.0, 6.0, -5.0], n);
        // 45 degrees outside, along (3, 4, −5)/√50.
        let sine = 0.5f64.sqrt() / n;
        assert!((sight.cosine - (1.0 - sine * sine).sqrt()).abs() < 1e-14);
        let length: f64 = sight.up.iter().map(|v| v * v).sum();
        assert!((length - 1.0).abs() < 1e-14 && (sight.up[1] / sight.up[0] - 4.0 / 3.0).abs() < 1e-14);
        let [x, y, _] = sight.along([0.0, 0.0, 2.0], 0.0);
        assert!((x.hypot(y) - 2.0 * sine / sight.cosine).abs() < 1e-14);
    }
}
