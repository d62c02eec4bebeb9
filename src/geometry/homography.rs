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
}
