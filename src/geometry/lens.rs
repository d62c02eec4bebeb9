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

    /// Whether it distorts nothing.
    pub fn is_ideal(&self) -> bool {
        self.k1 == 0.0 && self.k2 == 0.0
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

    /// Where the camera is, slab mm, z negative above the slab's top; `None` for a view that no camera has.
    ///
    /// The homography is K (r₁ r₂ t) with the lens's centre and focal length in K (Zhang 2000). As good as these: an
    /// error of 1 % in the focal length is 1 % of the height.
    pub fn eye_mm(&self) -> Option<[f64; 3]> {
        let m = &self.ideal_from_slab.matrix;
        let (c, f) = (self.lens.center_px, self.lens.focal_px);
        let column = |j: usize| [(m[0][j] - c[0] * m[2][j]) / f, (m[1][j] - c[1] * m[2][j]) / f, m[2][j]];
        let dot = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        let [x, y, t] = [column(0), column(1), column(2)];
        // Both axes should come out equally long.
        let length = 0.5 * (dot(x, x).sqrt() + dot(y, y).sqrt());
        let sign = if t[2] >= 0.0 { 1.0 } else { -1.0 };
        let [x, y, t] = [x, y, t].map(|v| v.map(|e| sign * e / length));
        let z = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]];
        let eye = [-dot(x, t), -dot(y, t), -dot(z, t)];
        (eye.iter().all(|v| v.is_finite()) && eye[2] < 0.0).then_some(eye)
    }

    /// Camera px in a mm at slab point `p` (mm): the root of the area's scale.
    pub fn px_per_mm(&self, p: Point) -> f64 {
        let j = self.jacobian(p);
        (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs().sqrt()
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

/// Assumed refractive index of the sample. With 1.3 slopes at 30° would be 1.2 % larger, with 1.6 1.9 % smaller.
const REFRACTIVE_INDEX: f64 = 1.4;

/// Slope of the line of sight, refracted by the sample's top, from an eye (slab mm, z negative above the top) to a place
/// on the slab, times the refractive index: how far towards the camera's foot light from below is seen, per depth over
/// refractive index. Of small angles it is the tangent.
pub(crate) fn sight_slope(eye_mm: [f64; 3], at_mm: Point) -> Point {
    let tangent = [0, 1].map(|a| (eye_mm[a] - at_mm[a]) / -eye_mm[2]);
    let square = tangent[0] * tangent[0] + tangent[1] * tangent[1];
    // n tan θ′ / tan θ by Snell's law: n cos θ / √(n² − sin² θ).
    let n2 = REFRACTIVE_INDEX * REFRACTIVE_INDEX;
    let bent = REFRACTIVE_INDEX / (n2 + (n2 - 1.0) * square).sqrt();
    tangent.map(|t| bent * t)
}

/// The angle (rad) between normal and line of sight outside the sample of a [`sight_slope`] of that length.
pub(crate) fn sight_angle(slope: f64) -> f64 {
    let n2 = REFRACTIVE_INDEX * REFRACTIVE_INDEX;
    (REFRACTIVE_INDEX * slope / (n2 + slope * slope).sqrt()).min(1.0).asin()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_of_sight_is_refracted_and_its_angle_outside_told_back() {
        // From 30° off the normal along (3, 4): sin θ′ = 0.5 / 1.4.
        let (outside, inside) = (30f64.to_radians(), (0.5f64 / 1.4).asin());
        let slope = sight_slope([30.0 * outside.tan(), 40.0 * outside.tan(), -50.0], [0.0, 0.0]);
        let expected = 1.4 * inside.tan();
        assert!((slope[0] - 0.6 * expected).abs() < 1e-12 && (slope[1] - 0.8 * expected).abs() < 1e-12, "{slope:?}");
        assert!((sight_angle(expected) - outside).abs() < 1e-12);
        let small = sight_slope([0.1, 0.0, -100.0], [0.0, 0.0]);
        assert!((small[0] / 1e-3 - 1.0).abs() < 1e-6 && small[1] == 0.0);
    }

    #[test]
    fn a_view_tells_where_its_camera_is() {
        // A camera at (3, −4, −50) mm, tilted by 0.2 rad about x, with f = 1000 px and its centre at (300, 200).
        let (s, c) = 0.2f64.sin_cos();
        let eye = [3.0, -4.0, -50.0];
        let r = [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]];
        let t: [f64; 3] = std::array::from_fn(|i| -(0..3).map(|k| r[i][k] * eye[k]).sum::<f64>());
        let k = [[1000.0, 0.0, 300.0], [0.0, 1000.0, 200.0], [0.0, 0.0, 1.0]];
        let column = |j: usize| if j < 2 { [r[0][j], r[1][j], r[2][j]] } else { t };
        let matrix = std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|n| k[i][n] * column(j)[n]).sum()));
        let view = CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([300.0, 200.0], 1000.0) };
        let found = view.eye_mm().unwrap();
        // A few products of numbers up to 5e4: some 1e-11 of rounding.
        assert!((0..3).all(|a| (found[a] - eye[a]).abs() < 1e-8), "{found:?}");
    }

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

    #[test]
    fn a_distorted_point_is_the_one_worked_out_by_hand() {
        let lens = Lens { center_px: [100.0, 80.0], focal_px: 200.0, k1: -0.1, k2: 0.05 };
        // n = (0.2, −0.15), r² = 0.0625: 1 − 0.1 r² + 0.05 r⁴ = 0.993 945 312 5.
        let expected = [139.757_812_5, 50.181_640_625];
        let (there, back) = (lens.distort([140.0, 50.0]), lens.undistort(expected));
        assert!((0..2).all(|a| (there[a] - expected[a]).abs() < 1e-12), "{there:?}");
        assert!((0..2).all(|a| (back[a] - [140.0, 50.0][a]).abs() < 1e-10), "{back:?}");
        assert_eq!(lens.undistort([100.0, 80.0]), [100.0, 80.0]);
        let only = |k1, k2| Lens { k1, k2, ..lens }.is_ideal();
        assert_eq!((only(0.0, 0.0), only(0.1, 0.0), only(0.0, 0.1)), (true, false, false));
        assert!(Lens::ideal([1.0, 2.0], 3.0).is_ideal());
    }

    /// A view whose two axes, scales and offsets all differ.
    fn uneven(k1: f64, k2: f64) -> CameraView {
        CameraView {
            ideal_from_slab: Homography { matrix: [[6.0, 0.5, 40.0], [-1.0, 4.0, 25.0], [0.0, 0.0, 1.0]] },
            lens: Lens { center_px: [100.0, 80.0], focal_px: 200.0, k1, k2 },
        }
    }

    #[test]
    fn a_view_is_the_plane_s_map_and_then_the_lens() {
        // (6 · 16 + 0.5 · 8 + 40, −16 + 32 + 25) = (140, 41): n = (0.2, −0.195), r² = 0.078 025.
        let view = uneven(-0.1, 0.0);
        let factor = 1.0 - 0.1 * 0.078_025;
        let expected = [100.0 + 40.0 * factor, 80.0 - 39.0 * factor];
        let seen = view.camera_from_slab([16.0, 8.0]);
        assert!((0..2).all(|a| (seen[a] - expected[a]).abs() < 1e-12), "{seen:?}");
        let back = view.slab_from_camera(expected).unwrap();
        // Newton to 1e-13 of some 100 px, over 4 px a millimetre.
        assert!((back[0] - 16.0).abs() < 1e-10 && (back[1] - 8.0).abs() < 1e-10, "{back:?}");
        let flat = Homography { matrix: [[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0]] };
        assert_eq!(CameraView { ideal_from_slab: flat, ..view }.slab_from_camera([1.0, 2.0]), None);
    }

    #[test]
    fn the_slope_of_a_view_is_the_slope_of_the_lens_times_that_of_the_plane() {
        for (k1, k2) in [(0.0, 0.0), (-0.3, 0.0), (0.1, 0.4)] {
            let view = uneven(k1, k2);
            let p = [16.0, 8.0];
            let n = [0.2, -0.195];
            let r2: f64 = n[0] * n[0] + n[1] * n[1];
            // d(n s)/dn = s + 2 n nᵀ ds/d(r²)
            let (s, ds) = (1.0 + k1 * r2 + k2 * r2 * r2, k1 + 2.0 * k2 * r2);
            let bend = [0, 1].map(|i| [0, 1].map(|j| if i == j { s } else { 0.0 } + 2.0 * n[i] * n[j] * ds));
            let plane = [[6.0, 0.5], [-1.0, 4.0]];
            let expected = [0, 1].map(|i| [0, 1].map(|j| bend[i][0] * plane[0][j] + bend[i][1] * plane[1][j]));
            let found = view.jacobian(p);
            // Central differences: as their documentation says, of slopes of order 5.
            assert!(
                (0..4).all(|k| (found[k / 2][k % 2] - expected[k / 2][k % 2]).abs() < 5e-6),
                "{found:?} {expected:?}"
            );
            let area: f64 = expected[0][0] * expected[1][1] - expected[0][1] * expected[1][0];
            assert!((view.px_per_mm(p) - area.sqrt()).abs() < 5e-6);
        }
        // 24.5 square pixels a square millimetre without a lens, and as many in a mirror.
        let mut mirror = uneven(0.0, 0.0);
        mirror.ideal_from_slab.matrix.swap(0, 1);
        assert!((mirror.px_per_mm([1.0, 2.0]) - 24.5_f64.sqrt()).abs() < 1e-6);
    }

    /// A camera at `eye`, turned about all three axes: K (r₁ r₂ t).
    fn turned(eye: [f64; 3], focal_px: f64) -> [[f64; 3]; 3] {
        let ([sx, cx], [sy, cy], [sz, cz]) = ([0.2f64, -0.3, 0.5].map(f64::sin_cos)).map(|(s, c)| [s, c]).into();
        let about = [
            [[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]],
            [[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]],
            [[cz, -sz, 0.0], [sz, cz, 0.0], [0.0, 0.0, 1.0]],
        ];
        let times = |a: [[f64; 3]; 3], b: [[f64; 3]; 3]| -> [[f64; 3]; 3] {
            std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
        };
        let r = times(about[0], times(about[1], about[2]));
        let t: [f64; 3] = std::array::from_fn(|i| -(0..3).map(|k| r[i][k] * eye[k]).sum::<f64>());
        let pose = std::array::from_fn(|i| [r[i][0], r[i][1], t[i]]);
        times([[focal_px, 0.0, 300.0], [0.0, focal_px, 210.0], [0.0, 0.0, 1.0]], pose)
    }

    #[test]
    fn the_camera_s_place_does_not_depend_on_how_its_map_is_scaled() {
        let eye = [13.0, -24.0, -150.0];
        for scale in [1.0, -2.0, 1e-3] {
            let matrix = turned(eye, 900.0).map(|r| r.map(|v| v * scale));
            let view = CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([300.0, 210.0], 900.0) };
            let found = view.eye_mm().unwrap();
            // Products of numbers up to 1e5: some 1e-11 of rounding.
            assert!((0..3).all(|a| (found[a] - eye[a]).abs() < 1e-8), "{found:?}");
        }
        // A mirrored picture would be seen from below.
        let mut mirrored = turned(eye, 900.0);
        mirrored.iter_mut().for_each(|r| r.swap(0, 1));
        let lens = Lens::ideal([300.0, 210.0], 900.0);
        assert_eq!(CameraView { ideal_from_slab: Homography { matrix: mirrored }, lens }.eye_mm(), None);
        assert_eq!(CameraView { ideal_from_slab: Homography { matrix: [[f64::NAN; 3]; 3] }, lens }.eye_mm(), None);
    }

    #[test]
    fn a_focal_length_that_is_a_hundredth_too_long_puts_the_camera_a_hundredth_too_high() {
        // Straight down from (5, −3, −80): x' = 900 (x − 5) / 80 + 300.
        let matrix =
            [[900.0, 0.0, 300.0 * 80.0 - 900.0 * 5.0], [0.0, 900.0, 210.0 * 80.0 + 900.0 * 3.0], [0.0, 0.0, 80.0]];
        let lens = Lens::ideal([300.0, 210.0], 909.0);
        let found = CameraView { ideal_from_slab: Homography { matrix }, lens }.eye_mm().unwrap();
        assert!((0..3).all(|a| (found[a] - [5.0, -3.0, -80.8][a]).abs() < 1e-10), "{found:?}");
        // Where pixels are a fiftieth longer along x the mean of both axes counts: 900 and 918 are 909.
        let matrix = [[918.0, 0.0, 300.0 * 80.0 - 918.0 * 5.0], matrix[1], matrix[2]];
        let found = CameraView { ideal_from_slab: Homography { matrix }, lens }.eye_mm().unwrap();
        // The third axis is as long as their product: short of 1 by the square of a hundredth.
        assert!((found[2] + 80.0).abs() < 0.01, "{found:?}");
    }
}
