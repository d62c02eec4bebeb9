use super::{Homography, Point};
use serde::{Deserialize, Serialize};

/// Radial lens distortion, the two-term Brown model.
///
/// With n = (ideal − centre)/focal and r = |n|, the distorted point is centre + focal · n · (1 + k1 r² + k2 r⁴)
/// (Brown 1971, the first terms of OpenCV's model). Tangential terms are not modelled.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lens {
    /// Centre of distortion, camera px.
    pub center_px: Point,
    /// Focal length, px: the unit of r.
    pub focal_px: f64,
    /// Coefficient of r².
    pub k1: f64,
    /// Coefficient of r⁴.
    pub k2: f64,
}

impl Lens {
    /// A lens without distortion.
    pub const fn ideal(center_px: Point, focal_px: f64) -> Self {
        Self { center_px, focal_px, k1: 0.0, k2: 0.0 }
    }

    /// Where the lens really puts an ideal (pinhole) image point.
    pub fn distort(&self, ideal: Point) -> Point {
        let n = [(ideal[0] - self.center_px[0]) / self.focal_px, (ideal[1] - self.center_px[1]) / self.focal_px];
        let r2 = n[0] * n[0] + n[1] * n[1];
        let s = self.focal_px * (1.0 + r2 * (self.k1 + r2 * self.k2));
        [self.center_px[0] + s * n[0], self.center_px[1] + s * n[1]]
    }

    /// The ideal point that the lens puts at `distorted`; Newton on the radius, to 1e-12 of it.
    ///
    /// Valid where the radial map is monotone, as for any lens that makes a picture.
    pub fn undistort(&self, distorted: Point) -> Point {
        let d =
            [(distorted[0] - self.center_px[0]) / self.focal_px, (distorted[1] - self.center_px[1]) / self.focal_px];
        let rd = d[0].hypot(d[1]);
        if rd == 0.0 {
            return distorted;
        }
        let mut r = rd;
        for _ in 0..20 {
            let r2 = r * r;
            let f = r * (1.0 + r2 * (self.k1 + r2 * self.k2)) - rd;
            let slope = 1.0 + r2 * (3.0 * self.k1 + 5.0 * self.k2 * r2);
            let step = f / slope;
            r -= step;
            if step.abs() <= 1e-13 * rd {
                break;
            }
        }
        let s = self.focal_px * r / rd;
        [self.center_px[0] + s * d[0], self.center_px[1] + s * d[1]]
    }
}

/// How the camera sees the slab's plane: a homography to ideal pixels, then the lens.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraView {
    /// Slab mm to ideal (undistorted) camera px.
    pub ideal_from_slab: Homography,
    /// The lens.
    pub lens: Lens,
}

impl CameraView {
    /// Where slab point `p` (mm) appears, camera px.
    pub fn camera_from_slab(&self, p: Point) -> Point {
        self.lens.distort(self.ideal_from_slab.map(p))
    }

    /// The slab point (mm) seen at camera pixel `q`; `None` when the homography cannot be inverted.
    pub fn slab_from_camera(&self, q: Point) -> Option<Point> {
        Some(self.ideal_from_slab.inverse()?.map(self.lens.undistort(q)))
    }

    /// Derivative of [`Self::camera_from_slab`] at `p`, px per mm, by central differences (relative error below 1e-6).
    pub fn jacobian(&self, p: Point) -> [[f64; 2]; 2] {
        let h = 1e-4;
        let dx = difference(self.camera_from_slab([p[0] + h, p[1]]), self.camera_from_slab([p[0] - h, p[1]]), 2.0 * h);
        let dy = difference(self.camera_from_slab([p[0], p[1] + h]), self.camera_from_slab([p[0], p[1] - h]), 2.0 * h);
        [[dx[0], dy[0]], [dx[1], dy[1]]]
    }
}

fn difference(a: Point, b: Point, h: f64) -> Point {
    [(a[0] - b[0]) / h, (a[1] - b[1]) / h]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undistort_undoes_distort_for_barrel_and_pincushion() {
        for (k1, k2) in [(-0.2, 0.05), (0.15, -0.02), (0.0, 0.0)] {
            let lens = Lens { center_px: [320.0, 240.0], focal_px: 800.0, k1, k2 };
            for p in [[0.0, 0.0], [320.0, 240.0], [640.0, 480.0], [100.0, 400.0]] {
                let q = lens.undistort(lens.distort(p));
                // Newton to 1e-13 relative on coordinates of order 1000.
                assert!((q[0] - p[0]).abs() < 1e-9 && (q[1] - p[1]).abs() < 1e-9, "{p:?} {q:?}");
            }
        }
    }
}
