//! Changes of a matrix and of what its material should then be.

use super::*;

/// What may be done to a matrix and to a material's rows alike.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Change {
    Channels([usize; 3]),
    Mirror(usize),
    Transpose,
}

pub(crate) fn changes() -> impl Strategy<Value = Change> {
    let orders = [[0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];
    prop_oneof![
        proptest::sample::select(orders.to_vec()).prop_map(Change::Channels),
        (0_usize..2).prop_map(Change::Mirror),
        Just(Change::Transpose),
    ]
}

impl Change {
    pub(crate) fn axes<T: Copy>(self, v: [T; 2]) -> [T; 2] {
        if matches!(self, Self::Transpose) { [v[1], v[0]] } else { v }
    }

    /// The number that comes to `at` of a grid of `size`.
    pub(crate) fn from(self, at: [usize; 2], size: [usize; 2]) -> usize {
        let [x, y] = match self {
            Self::Mirror(0) => [size[0] - 1 - at[0], at[1]],
            Self::Mirror(_) => [at[0], size[1] - 1 - at[1]],
            _ => self.axes(at),
        };
        let width = self.axes(size)[0];
        x + y * width
    }

    /// Rows with entries `[dy][dx][channel]` of a header, changed.
    pub(crate) fn rows<T: Copy>(self, rows: &[Vec<T>], points: [usize; 2], window: [usize; 2]) -> Vec<Vec<T>> {
        let (points, window) = (self.axes(points), self.axes(window));
        let channel = |c: usize| if let Self::Channels(order) = self { order[c] } else { c };
        let row = |i: usize| {
            let from = &rows[self.from([i % points[0], i / points[0]], points)];
            let entry = |k: usize| {
                let (sample, c) = place(k, window);
                from[self.from(sample, window) * 3 + channel(c)]
            };
            (0..window[0] * window[1] * 3).map(entry).collect()
        };
        (0..points[0] * points[1]).map(row).collect()
    }

    pub(crate) fn matrix(self, m: &Matrix) -> Matrix {
        let (points, window) = (m.header.points, m.header.window);
        let mut out = Matrix::of(self.axes(points), self.axes(window), |_, _, _| 0.0);
        out.header.lit_pitch_mm = self.axes(m.header.lit_pitch_mm);
        let position = |i: usize| self.axes(m.header.lit_mm[i]);
        let [nx, ny] = out.header.points;
        let place = |i: usize| position(self.from([i % nx, i / nx], [nx, ny]));
        let far =
            [m.header.lit_pitch_mm[0] * (points[0] - 1) as f64, m.header.lit_pitch_mm[1] * (points[1] - 1) as f64];
        out.header.lit_mm = (0..nx * ny).map(place).collect();
        if let Self::Mirror(a) = self {
            out.header.lit_mm.iter_mut().for_each(|p| p[a] = far[a] - p[a]);
        }
        let all =
            |get: &dyn Fn(&Row) -> Vec<f32>| self.rows(&m.rows.iter().map(get).collect::<Vec<_>>(), points, window);
        let valid: Vec<Vec<bool>> = m.rows.iter().map(|r| r.valid.clone()).collect();
        let (response, variance) = (all(&|r| r.response.clone()), all(&|r| r.variance.clone()));
        let rows = response.into_iter().zip(variance).zip(self.rows(&valid, points, window));
        out.rows = rows.map(|((response, variance), valid)| Row { response, variance, valid }).collect();
        out
    }
}
