//! Lit points as a lattice: from millimetres to the indices of lit points, and the four around a place.

use crate::Point;

/// Lattice coordinates of a point of the slab: u = origin + from_mm · x, as the lit points are on average.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lattice {
    origin: Point,
    from_mm: [Point; 2],
    to_mm: [Point; 2],
}

impl Lattice {
    /// By least squares through the lit points; a side of one point takes the pitch.
    pub(crate) fn of(points: [usize; 2], lit_mm: &[Point], pitch_mm: Point) -> Self {
        let n = lit_mm.len().max(1) as f64;
        let middle = points.map(|p| (p as f64 - 1.0) / 2.0);
        let place = |k: usize| [(k % points[0]) as f64 - middle[0], (k / points[0]) as f64 - middle[1]];
        let mean = [0, 1].map(|a| lit_mm.iter().map(|p| p[a]).sum::<f64>() / n);
        // On a full grid the two coordinates are orthogonal: each slope by itself. to_mm[r][c]: mm along r for a step
        // along c.
        let slope = |r: usize, c: usize| {
            let square: f64 = (0..lit_mm.len()).map(|k| place(k)[c].powi(2)).sum();
            let along: f64 = lit_mm.iter().enumerate().map(|(k, p)| place(k)[c] * (p[r] - mean[r])).sum();
            if square > 0.0 { along / square } else { f64::from(u8::from(r == c)) * pitch_mm[c] }
        };
        let mut to_mm = [[slope(0, 0), slope(0, 1)], [slope(1, 0), slope(1, 1)]];
        let determinant = |m: &[Point; 2]| m[0][0] * m[1][1] - m[0][1] * m[1][0];
        // Points that are on no lattice: the pitch says what they should have been.
        if !(determinant(&to_mm).abs() > 1e-6 * pitch_mm[0] * pitch_mm[1]) {
            to_mm = [[pitch_mm[0], 0.0], [0.0, pitch_mm[1]]];
        }
        let d = determinant(&to_mm);
        let from_mm = [[to_mm[1][1] / d, -to_mm[0][1] / d], [-to_mm[1][0] / d, to_mm[0][0] / d]];
        let origin = [0, 1].map(|a| middle[a] - from_mm[a][0] * mean[0] - from_mm[a][1] * mean[1]);
        Self { origin, from_mm, to_mm }
    }

    /// Lattice coordinates of a point, mm.
    pub(crate) fn map(&self, p: Point) -> Point {
        [0, 1].map(|a| self.origin[a] + self.from_mm[a][0] * p[0] + self.from_mm[a][1] * p[1])
    }

    /// The point at lattice coordinates, mm.
    pub(crate) fn place(&self, u: Point) -> Point {
        let d = [u[0] - self.origin[0], u[1] - self.origin[1]];
        [0, 1].map(|r| self.to_mm[r][0] * d[0] + self.to_mm[r][1] * d[1])
    }

    /// Largest extent along each lattice axis of a square cell of the slab with this side.
    pub(crate) fn extent(&self, side_mm: f64) -> Point {
        self.from_mm.map(|row| side_mm * (row[0].abs() + row[1].abs()))
    }
}

/// The four places of a grid around a point, and how far it is from the first.
pub(crate) struct Corners {
    first: [usize; 2],
    next: [usize; 2],
    beyond: Point,
}

impl Corners {
    /// `None` further than half a step outside the grid.
    pub(crate) fn around(at: Point, size: [usize; 2]) -> Option<Self> {
        let inside = |a: usize| at[a] >= -0.5 && at[a] <= size[a] as f64 - 0.5;
        (inside(0) && inside(1)).then(|| Self::held(at, size))
    }

    /// Those of the nearest point of the grid where it is outside.
    pub(crate) fn held(at: Point, size: [usize; 2]) -> Self {
        let at = [0, 1].map(|a| at[a].clamp(0.0, size[a] as f64 - 1.0));
        let first = at.map(|v| v as usize);
        let next = [0, 1].map(|a| (first[a] + 1).min(size[a] - 1));
        Self { first, next, beyond: [at[0] - first[0] as f64, at[1] - first[1] as f64] }
    }

    /// With their weights, which sum to one.
    pub(crate) fn each(&self) -> [([usize; 2], f64); 4] {
        let (p, q, [x, y]) = (self.first, self.next, self.beyond);
        [(p, (1.0 - x) * (1.0 - y)), ([q[0], p[1]], x * (1.0 - y)), ([p[0], q[1]], (1.0 - x) * y), (q, x * y)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_and_coordinates_are_each_others_inverse_on_a_turned_lattice() {
        let to = |x: f64, y: f64| [3.0 + 0.4 * x - 0.1 * y, -2.0 + 0.2 * x + 0.7 * y];
        let lit: Vec<Point> = (0..35).map(|k| to((k % 7) as f64, (k / 7) as f64)).collect();
        let lattice = Lattice::of([7, 5], &lit, [0.4, 0.7]);
        for (k, p) in lit.iter().enumerate() {
            let u = lattice.map(*p);
            assert!((u[0] - (k % 7) as f64).abs() < 1e-12 && (u[1] - (k / 7) as f64).abs() < 1e-12, "rounding: {u:?}");
            let back = lattice.place(u);
            assert!((back[0] - p[0]).abs() < 1e-12 && (back[1] - p[1]).abs() < 1e-12, "rounding: {back:?}");
        }
    }
}
