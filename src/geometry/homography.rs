use super::Point;
use serde::{Deserialize, Serialize};

/// A projective map of the plane, row-major, scaled so that the last entry is 1 when it is not zero.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Homography {
    /// The 3 × 3 matrix.
    pub matrix: [[f64; 3]; 3],
}

impl Homography {
    /// The map that changes nothing.
    pub const IDENTITY: Self = Self { matrix: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] };

    /// A uniform scale and a translation: p ↦ scale · p + offset.
    pub fn similarity(scale: f64, offset: Point) -> Self {
        Self { matrix: [[scale, 0.0, offset[0]], [0.0, scale, offset[1]], [0.0, 0.0, 1.0]] }
    }

    /// The image of `p`. A point on the vanishing line gives infinities.
    pub fn map(&self, p: Point) -> Point {
        let m = &self.matrix;
        let w = m[2][0] * p[0] + m[2][1] * p[1] + m[2][2];
        [(m[0][0] * p[0] + m[0][1] * p[1] + m[0][2]) / w, (m[1][0] * p[0] + m[1][1] * p[1] + m[1][2]) / w]
    }

    /// The 2 × 2 derivative of [`Self::map`] at `p`, `[[dx'/dx, dx'/dy], [dy'/dx, dy'/dy]]`.
    pub fn jacobian(&self, p: Point) -> [[f64; 2]; 2] {
        let m = &self.matrix;
        let w = m[2][0] * p[0] + m[2][1] * p[1] + m[2][2];
        let q = self.map(p);
        let row = |i: usize| [(m[i][0] - q[i] * m[2][0]) / w, (m[i][1] - q[i] * m[2][1]) / w];
        [row(0), row(1)]
    }

    /// Area scale |det J| at `p`.
    pub fn area_scale(&self, p: Point) -> f64 {
        let j = self.jacobian(p);
        (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs()
    }

    /// `self` after `first`.
    pub fn after(&self, first: &Self) -> Self {
        let (a, b) = (&self.matrix, &first.matrix);
        let matrix = std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()));
        Self { matrix }.scaled()
    }

    /// The inverse map, `None` when the matrix is singular.
    pub fn inverse(&self) -> Option<Self> {
        let m = &self.matrix;
        let cofactor = |i: usize, j: usize| {
            let (a, b, c, d) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
            m[a][c] * m[b][d] - m[a][d] * m[b][c]
        };
        let det: f64 = (0..3).map(|j| m[0][j] * cofactor(0, j)).sum();
        let size: f64 = m.iter().flatten().map(|v| v.abs()).fold(0.0, f64::max);
        if !(det.abs() > size.powi(3) * 1e-14) {
            return None;
        }
        let matrix = std::array::from_fn(|i| std::array::from_fn(|j| cofactor(j, i) / det));
        Some(Self { matrix }.scaled())
    }

    fn scaled(mut self) -> Self {
        let w = self.matrix[2][2];
        if w != 0.0 {
            self.matrix.iter_mut().flatten().for_each(|v| *v /= w);
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const H: Homography = Homography { matrix: [[1.2, 0.1, -3.0], [-0.05, 0.9, 4.0], [1e-3, -2e-3, 1.0]] };

    #[test]
    fn inverse_brings_points_back() {
        let back = H.inverse().unwrap();
        for p in [[0.0, 0.0], [10.0, -7.0], [123.0, 45.0]] {
            let q = back.map(H.map(p));
            // Cancellation over a few products of order 100: some hundred ulps.
            assert!((q[0] - p[0]).abs() < 1e-10 && (q[1] - p[1]).abs() < 1e-10);
        }
    }

    #[test]
    fn jacobian_agrees_with_differences() {
        let (p, h) = ([12.0, 5.0], 1e-5);
        let j = H.jacobian(p);
        for axis in 0..2 {
            let mut a = p;
            let mut b = p;
            a[axis] -= h;
            b[axis] += h;
            let (qa, qb) = (H.map(a), H.map(b));
            for i in 0..2 {
                // Central differences: error h² plus rounding over h.
                assert!((j[i][axis] - (qb[i] - qa[i]) / (2.0 * h)).abs() < 1e-8);
            }
        }
    }

    #[test]
    fn a_singular_matrix_has_no_inverse() {
        assert!(Homography { matrix: [[1.0, 2.0, 3.0], [2.0, 4.0, 6.0], [0.0, 0.0, 1.0]] }.inverse().is_none());
    }

    fn near(a: &Homography, b: [[f64; 3]; 3], tolerance: f64) -> bool {
        a.matrix.iter().flatten().zip(b.iter().flatten()).all(|(a, b)| (a - b).abs() <= tolerance)
    }

    #[test]
    fn a_point_is_mapped_by_rows_over_the_depth() {
        // Depth 1 + 0.01 + 0.014; (12 − 0.7 − 3, −0.5 − 6.3 + 4).
        let q = H.map([10.0, -7.0]);
        assert!((q[0] - 8.3 / 1.024).abs() < 1e-14 && (q[1] + 2.8 / 1.024).abs() < 1e-14, "{q:?}");
        assert_eq!(Homography::similarity(2.5, [3.0, -7.0]).map([4.0, 10.0]), [13.0, 18.0]);
        assert_eq!(Homography::IDENTITY.map([4.0, 10.0]), [4.0, 10.0]);
        // On the vanishing line, 1e-3 x − 2e-3 y + 1 = 0.
        assert!(H.map([0.0, 500.0]).iter().all(|v| v.is_infinite()));
    }

    #[test]
    fn the_area_s_scale_is_the_determinant_over_the_depth_cubed() {
        for p in [[0.0, 0.0], [12.0, 5.0], [-40.0, 70.0]] {
            let [[a, b, c], [d, e, f], [g, h, i]] = H.matrix;
            let det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g);
            let depth: f64 = g * p[0] + h * p[1] + i;
            // Some ulps of numbers of order 1.
            assert!((H.area_scale(p) - det / depth.powi(3)).abs() < 1e-13);
        }
        // A mirror keeps areas positive.
        let mirror = Homography { matrix: [[-3.0, 0.0, 1.0], [0.5, 2.0, 0.0], [0.0, 0.0, 1.0]] };
        assert_eq!(mirror.area_scale([9.0, 2.0]), 6.0);
    }

    #[test]
    fn maps_are_applied_one_after_the_other_from_the_right() {
        let g = Homography { matrix: [[0.5, -0.2, 7.0], [0.3, 2.0, -1.0], [-2e-3, 1e-3, 0.8]] };
        let both = g.after(&H);
        assert_eq!(both.matrix[2][2], 1.0);
        for p in [[10.0, -7.0], [3.0, 25.0]] {
            let (q, expected) = (both.map(p), g.map(H.map(p)));
            assert!((0..2).all(|a| (q[a] - expected[a]).abs() < 1e-12), "{q:?} {expected:?}");
        }
    }

    #[test]
    fn the_inverse_of_a_matrix_of_whole_numbers_is_the_one_worked_out_by_hand() {
        // The adjugate is [[1, 3, −1], [−1, 2, 1], [3, −6, 2]], the determinant 5; the last entry becomes 1.
        let m = [[2.0, 0.0, 1.0], [1.0, 1.0, 0.0], [0.0, 3.0, 1.0]];
        let expected = [[0.5, 1.5, -0.5], [-0.5, 1.0, 0.5], [1.5, -3.0, 1.0]];
        for scale in [1.0, 1e-30, 1e30, -4.0] {
            let inverse = Homography { matrix: m.map(|r| r.map(|v| v * scale)) }.inverse().unwrap();
            assert!(near(&inverse, expected, 1e-14), "{inverse:?}");
        }
        // The last entry of this one's inverse is 0: it is left as it is.
        let turn = Homography { matrix: [[0.0, 0.0, 1.0], [2.0, 0.0, 0.0], [0.0, 4.0, 0.0]] };
        assert!(near(&turn.inverse().unwrap(), [[0.0, 0.5, 0.0], [0.0, 0.0, 0.25], [1.0, 0.0, 0.0]], 1e-15));
        assert!(Homography { matrix: [[f64::NAN; 3]; 3] }.inverse().is_none());
    }
}
