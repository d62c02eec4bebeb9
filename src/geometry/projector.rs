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

    const PLANE: Homography = Homography { matrix: [[6.0, 0.5, 40.0], [-1.0, 4.0, 25.0], [0.0, 0.0, 1.0]] };

    #[test]
    fn a_projector_without_a_lens_is_its_plane_s_map() {
        let map = SlabFromProjector::new(PLANE, Lens::ideal([100.0, 80.0], 200.0)).unwrap();
        assert_eq!(map.projector_from_slab([16.0, 8.0]), [140.0, 41.0]);
        // The inverse of [[6, 0.5], [−1, 4]] is [[4, −0.5], [1, 6]] / 24.5.
        let (q, j) = (map.map([140.0, 41.0]), map.jacobian([140.0, 41.0]));
        assert!((q[0] - 16.0).abs() < 1e-12 && (q[1] - 8.0).abs() < 1e-12, "{q:?}");
        let expected = [[4.0 / 24.5, -0.5 / 24.5], [1.0 / 24.5, 6.0 / 24.5]];
        assert!((0..4).all(|k| (j[k / 2][k % 2] - expected[k / 2][k % 2]).abs() < 1e-14), "{j:?}");
        assert!((map.area_scale([9.0, -2.0]) - 1.0 / 24.5).abs() < 1e-15);
        assert_eq!(map.lens().focal_px, 200.0);
        assert_eq!(map.homography().map([140.0, 41.0]), q);
        let flat = Homography { matrix: [[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]] };
        assert!(SlabFromProjector::new(flat, *map.lens()).is_none());
        // Turned over, a pixel still has an area.
        let mirror = Homography { matrix: [PLANE.matrix[1], PLANE.matrix[0], PLANE.matrix[2]] };
        assert!(SlabFromProjector::new(mirror, *map.lens()).unwrap().area_scale([1.0, 1.0]) > 0.0);
    }

    #[test]
    fn a_projector_s_lens_bends_its_pixels_before_they_land() {
        let (k1, k2) = (-0.2, 0.3);
        let map = SlabFromProjector::new(PLANE, Lens { center_px: [100.0, 80.0], focal_px: 200.0, k1, k2 }).unwrap();
        let n = [0.2, -0.195];
        let r2: f64 = 0.078_025;
        let (s, ds) = (1.0 + k1 * r2 + k2 * r2 * r2, k1 + 2.0 * k2 * r2);
        let q = [100.0 + 200.0 * s * n[0], 80.0 + 200.0 * s * n[1]];
        let lit = map.projector_from_slab([16.0, 8.0]);
        assert!((0..2).all(|a| (lit[a] - q[a]).abs() < 1e-12), "{lit:?}");
        // The forward slope is d(n s)/dn times that of the plane; the backward one its inverse.
        let bend = [0, 1].map(|i| [0, 1].map(|j| if i == j { s } else { 0.0 } + 2.0 * n[i] * n[j] * ds));
        let plane = [[6.0, 0.5], [-1.0, 4.0]];
        let [[a, b], [c, d]] = [0, 1].map(|i| [0, 1].map(|j| bend[i][0] * plane[0][j] + bend[i][1] * plane[1][j]));
        let det: f64 = a * d - b * c;
        let (found, expected) = (map.jacobian(q), [[d / det, -b / det], [-c / det, a / det]]);
        // Differences over 0.02 px, as documented: slopes of 0.2 mm a pixel to a millionth.
        assert!((0..4).all(|k| (found[k / 2][k % 2] - expected[k / 2][k % 2]).abs() < 3e-7), "{found:?} {expected:?}");
        assert!((map.area_scale(q) * det - 1.0).abs() < 3e-6);
    }
}
