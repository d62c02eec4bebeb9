use super::{Homography, Lens, Point};
use serde::{Deserialize, Serialize};

/// Where projector pixels land on the slab: the projector is a camera run backwards, with a lens before its homography.
///
/// A slab point p is lit by projector pixel lens.distort(ideal_from_slab(p)).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SlabFromProjector {
    slab_from_ideal: Homography,
    ideal_from_slab: Homography,
    lens: Lens,
}

impl SlabFromProjector {
    /// From slab mm to ideal projector px, and the lens; `None` when the homography cannot be inverted.
    pub fn new(ideal_from_slab: Homography, lens: Lens) -> Option<Self> {
        Some(Self { slab_from_ideal: ideal_from_slab.inverse()?, ideal_from_slab, lens })
    }

    /// The map of ideal projector px, as without a lens.
    pub fn homography(&self) -> Homography {
        self.slab_from_ideal
    }

    /// The lens; both coefficients are zero where none was needed.
    pub fn lens(&self) -> &Lens {
        &self.lens
    }

    /// Where projector pixel `q` lands, slab mm.
    pub fn map(&self, q: Point) -> Point {
        self.slab_from_ideal.map(if self.lens.is_ideal() { q } else { self.lens.undistort(q) })
    }

    /// The projector pixel that lights slab point `p` (mm).
    pub fn projector_from_slab(&self, p: Point) -> Point {
        let ideal = self.ideal_from_slab.map(p);
        if self.lens.is_ideal() { ideal } else { self.lens.distort(ideal) }
    }

    /// Derivative of [`Self::map`] at `q`, mm per px; with a lens by central differences (relative error below 1e-6).
    pub fn jacobian(&self, q: Point) -> [[f64; 2]; 2] {
        if self.lens.is_ideal() {
            return self.slab_from_ideal.jacobian(q);
        }
        let h = 1e-2;
        let [right, left] = [h, -h].map(|h| self.map([q[0] + h, q[1]]));
        let [below, above] = [h, -h].map(|h| self.map([q[0], q[1] + h]));
        [0, 1].map(|i| [(right[i] - left[i]) / (2.0 * h), (below[i] - above[i]) / (2.0 * h)])
    }

    /// Area of a projector pixel on the slab at `q`, mm².
    pub fn area_scale(&self, q: Point) -> f64 {
        let j = self.jacobian(q);
        (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_of_the_slab_is_lit_by_the_pixel_that_lands_there() {
        let h = Homography { matrix: [[6.0, 0.3, 12.0], [-0.2, 6.1, 9.0], [1e-3, -5e-4, 1.0]] };
        for k1 in [0.0, -0.02] {
            let lens = Lens { center_px: [100.0, 80.0], focal_px: 200.0, k1, k2: 0.0 };
            let map = SlabFromProjector::new(h, lens).unwrap();
            for p in [[0.0, 0.0], [20.0, 3.0], [7.0, 25.0]] {
                let q = map.projector_from_slab(p);
                let back = map.map(q);
                // Newton to 1e-13 of coordinates of order 100.
                assert!((0..2).all(|a| (back[a] - p[a]).abs() < 1e-9), "{p:?} {back:?}");
                let j = map.jacobian(q);
                let moved = map.map([q[0] + 0.5, q[1] - 0.25]);
                // Second order: curvature of a few 1e-5 mm/px² times half a pixel squared.
                let linear = [0, 1].map(|i| p[i] + 0.5 * j[i][0] - 0.25 * j[i][1]);
                assert!((0..2).all(|a| (linear[a] - moved[a]).abs() < 1e-4), "{linear:?} {moved:?}");
            }
        }
    }
}
