//! A continuous field over the slab from one value per cell: a cubic B-spline.
//!
//! This field *is* the light that the camera sees and that the truth is integrated from: C², zero outside its box.

use crate::geometry::Point;

/// A field of three channels.
#[derive(Debug, Clone)]
pub(crate) struct Field {
    /// Centre of the first voxel, mm.
    origin_mm: Point,
    per_mm: f64,
    size: [usize; 2],
    /// Spline coefficients, row-major; the fourth channel is padding for the vector unit.
    coefficients: Vec<[f32; 4]>,
}

impl Field {
    /// Interpolates `channels` (row-major over `size`), voxels of side `voxel_mm`, the first with its corner at
    /// `corner_mm`.
    pub(crate) fn interpolate(corner_mm: Point, voxel_mm: f64, size: [usize; 2], channels: [&[f32]; 3]) -> Self {
        let mut field = Self::smooth(corner_mm, voxel_mm, size, channels);
        for row in field.coefficients.chunks_exact_mut(size[0]) {
            prefilter(row, 1, size[0]);
        }
        for x in 0..size[0] {
            prefilter(&mut field.coefficients[x..], size[0], size[1]);
        }
        field
    }

    /// Spreads the content of every cell as a cubic B-spline: nowhere negative, noise is not amplified, the integral
    /// stays. Blurs by a standard deviation of 0.58 cells, that of the spline.
    pub(crate) fn smooth(corner_mm: Point, cell_mm: f64, size: [usize; 2], channels: [&[f32]; 3]) -> Self {
        let mut coefficients = vec![[0.0; 4]; size[0] * size[1]];
        for (c, values) in channels.iter().enumerate() {
            coefficients.iter_mut().zip(values.iter()).for_each(|(to, v)| to[c] = *v);
        }
        Self { origin_mm: corner_mm.map(|c| c + 0.5 * cell_mm), per_mm: 1.0 / cell_mm, size, coefficients }
    }

    /// The same field elsewhere.
    pub(crate) fn moved(&self, by_mm: Point) -> Self {
        let origin_mm = std::array::from_fn(|a| self.origin_mm[a] + by_mm[a]);
        Self { origin_mm, ..self.clone() }
    }

    /// Side of a cell, mm.
    pub(crate) fn cell_mm(&self) -> f64 {
        1.0 / self.per_mm
    }

    /// The field at `p` (mm), zero where the spline's support leaves the box.
    #[inline(always)]
    pub(crate) fn at(&self, p: Point) -> [f32; 3] {
        let nodes = Nodes { share: [[1.0], [0.0], [0.0], [0.0]], weight: [1.0] };
        self.mean_over(&nodes, [p; 4]).unwrap_or_default()
    }

    /// The mean over a quadrilateral (mm; first and second corner above third and fourth), bilinear between its
    /// corners, by the points of `nodes`; `None` where the spline's support leaves the box.
    #[inline(always)]
    pub(crate) fn mean_over<const P: usize>(&self, nodes: &Nodes<P>, corners_mm: [Point; 4]) -> Option<[f32; 3]> {
        let ((column, across), (row, down)) = (self.places(nodes, corners_mm, 0)?, self.places(nodes, corners_mm, 1)?);
        let (wx, wy) = (all_weights(&across), all_weights(&down));
        let mut sum = [[0.0f32; 4]; 4];
        for n in 0..P {
            let first = (row[n] as usize) * self.size[0] + column[n] as usize;
            let mut line = [[0.0f32; 4]; 4];
            for j in 0..4 {
                let row: &[[f32; 4]; 4] = self.coefficients.get(first + j * self.size[0]..)?.first_chunk()?;
                for k in 0..4 {
                    for l in 0..4 {
                        line[k][l] += wy[j][n] * row[k][l];
                    }
                }
            }
            for k in 0..4 {
                let weight = nodes.weight[n] * wx[k][n];
                for l in 0..4 {
                    sum[k][l] += weight * line[k][l];
                }
            }
        }
        Some([0, 1, 2].map(|l| (sum[0][l] + sum[1][l]) + (sum[2][l] + sum[3][l])))
    }

    /// Along one axis: the first coefficient that touches each node, and how far the node lies past the second (0 to
    /// 1).
    #[inline(always)]
    fn places<const P: usize>(
        &self,
        nodes: &Nodes<P>,
        corners_mm: [Point; 4],
        axis: usize,
    ) -> Option<([i32; P], [f32; P])> {
        let corners = corners_mm.map(|p| (p[axis] - self.origin_mm[axis]) * self.per_mm);
        let (mut low, mut high) = (corners[0], corners[0]);
        for &c in &corners[1..] {
            low = if c < low { c } else { low };
            high = if c > high { c } else { high };
        }
        if !(low >= 1.0 && high < self.size[axis] as f64 - 2.0) {
            return None;
        }
        // From here on in single precision, counted from a coefficient nearby: none is negative, so that to cut is to
        // floor.
        let base = low as i32;
        let corners = corners.map(|c| (c - f64::from(base)) as f32);
        let (mut first, mut past) = ([0; P], [0.0; P]);
        for n in 0..P {
            let at = (nodes.share[0][n] * corners[0] + nodes.share[1][n] * corners[1])
                + (nodes.share[2][n] * corners[2] + nodes.share[3][n] * corners[3]);
            first[n] = base - 1 + at as i32;
            past[n] = at - at as i32 as f32;
        }
        Some((first, past))
    }

    /// Means over `cells` × `cells` squares of side `cell_mm`, centred as a whole on `center_mm`: `[y][x][channel]`,
    /// exact.
    pub(crate) fn cell_means(&self, center_mm: Point, cells: [usize; 2], cell_mm: f64) -> Vec<f32> {
        let side = cell_mm * self.per_mm;
        let weights: [Vec<(usize, Vec<f64>)>; 2] = std::array::from_fn(|a| {
            let middle = (center_mm[a] - self.origin_mm[a]) * self.per_mm;
            let first = middle - 0.5 * cells[a] as f64 * side;
            (0..cells[a]).map(|m| mean_weights(first + m as f64 * side, side, self.size[a])).collect()
        });
        let mut means = Vec::with_capacity(cells[0] * cells[1] * 3);
        for (y0, wy) in &weights[1] {
            for (x0, wx) in &weights[0] {
                let mut sum = [0.0f64; 3];
                for (j, wy) in wy.iter().enumerate() {
                    let row = &self.coefficients[(y0 + j) * self.size[0] + x0..][..wx.len()];
                    for (coefficient, wx) in row.iter().zip(wx) {
                        for c in 0..3 {
                            sum[c] += wy * wx * f64::from(coefficient[c]);
                        }
                    }
                }
                means.extend(sum.map(|s| s as f32));
            }
        }
        means
    }

    /// The rectangle outside which the field is zero, mm: first and last corner.
    pub(crate) fn bounds_mm(&self) -> [Point; 2] {
        let at = |i: [f64; 2]| std::array::from_fn(|a| self.origin_mm[a] + i[a] / self.per_mm);
        [at([1.0, 1.0]), at([self.size[0] as f64 - 2.0, self.size[1] as f64 - 2.0])]
    }
}

/// Points and weights of a rule over a quadrilateral: a point is at the sum of its shares of the corners.
#[derive(Debug, Clone)]
pub(crate) struct Nodes<const P: usize> {
    share: [[f32; P]; 4],
    weight: [f32; P],
}

impl<const P: usize> Nodes<P> {
    /// The products of a rule on −½..½ of √P points and weights.
    pub(crate) fn new(rule: &[(f64, f64)]) -> Self {
        let side = rule.len();
        debug_assert_eq!(side * side, P);
        let (mut u, mut v, mut weight) = ([0.0; P], [0.0; P], [0.0; P]);
        for n in 0..P {
            let (across, down) = (rule[n % side], rule[n / side]);
            (u[n], v[n], weight[n]) = (0.5 + across.0, 0.5 + down.0, (across.1 * down.1) as f32);
        }
        let share = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]].map(|[x, y]| {
            let part = |t: f64, end: f64| if end > 0.5 { t } else { 1.0 - t };
            std::array::from_fn(|n| (part(u[n], x) * part(v[n], y)) as f32)
        });
        Self { share, weight }
    }
}

/// Weights of the four coefficients around points `t` past the second.
#[inline(always)]
fn all_weights<const P: usize>(t: &[f32; P]) -> [[f32; P]; 4] {
    let mut weights = [[0.0; P]; 4];
    for n in 0..P {
        let (t, s) = (t[n], 1.0 - t[n]);
        weights[0][n] = s * s * s * (1.0 / 6.0);
        weights[1][n] = 2.0 / 3.0 - t * t * (1.0 - 0.5 * t);
        weights[2][n] = 2.0 / 3.0 - s * s * (1.0 - 0.5 * s);
        weights[3][n] = t * t * t * (1.0 / 6.0);
    }
    weights
}

/// Coefficients that touch the interval from `from`, `side` long (in voxels), and their share of its mean.
fn mean_weights(from: f64, side: f64, size: usize) -> (usize, Vec<f64>) {
    let to = from + side;
    let first = ((from - 2.0).ceil().max(0.0)) as usize;
    let last = ((to + 2.0).floor().max(0.0) as usize).min(size.saturating_sub(1));
    let share = |i: usize| (spline_integral(to - i as f64) - spline_integral(from - i as f64)) / side;
    (first.min(last), (first.min(last)..=last).map(share).collect())
}

/// ∫ from −∞ to t of the centred cubic B-spline, by its truncated powers.
fn spline_integral(t: f64) -> f64 {
    if t >= 2.0 {
        return 1.0;
    }
    let power = |k: f64| (t + 2.0 - k).max(0.0).powi(4);
    (power(0.0) - 4.0 * power(1.0) + 6.0 * power(2.0) - 4.0 * power(3.0)) / 24.0
}

/// Values to cubic B-spline coefficients along one line, mirrored at its ends (Unser 1999, box 2).
fn prefilter(line: &mut [[f32; 4]], stride: usize, n: usize) {
    const POLE: f32 = -0.267_949_2; // √3 − 2
    if n < 2 {
        return;
    }
    let add = |a: [f32; 4], b: [f32; 4], f: f32| -> [f32; 4] { std::array::from_fn(|l| a[l] + f * b[l]) };
    let mut sum = line[0];
    let mut power = POLE;
    for i in 1..n.min(16) {
        sum = add(sum, line[i * stride], power);
        power *= POLE;
    }
    line[0] = sum;
    for i in 1..n {
        line[i * stride] = add(line[i * stride], line[(i - 1) * stride], POLE);
    }
    let last = add(line[(n - 1) * stride], line[(n - 2) * stride], POLE);
    line[(n - 1) * stride] = last.map(|v| v * POLE / (POLE * POLE - 1.0));
    for i in (0..n - 1).rev() {
        let (next, this) = (line[(i + 1) * stride], line[i * stride]);
        line[i * stride] = std::array::from_fn(|l| POLE * (next[l] - this[l]));
    }
    for i in 0..n {
        line[i * stride] = line[i * stride].map(|v| 6.0 * v);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bump(p: Point) -> f32 {
        (-(p[0] - 5.0).powi(2) / 3.0 - (p[1] - 4.5).powi(2) / 5.0).exp() as f32
    }

    fn field() -> Field {
        let (size, voxel) = ([40, 36], 0.25);
        let values: Vec<f32> = (0..size[0] * size[1])
            .map(|i| bump([((i % size[0]) as f64 + 0.5) * voxel, ((i / size[0]) as f64 + 0.5) * voxel]))
            .collect();
        Field::interpolate([0.0, 0.0], voxel, size, [&values, &values, &values])
    }

    #[test]
    fn it_passes_through_its_values() {
        let field = field();
        for p in [[4.875, 4.625], [3.125, 6.125]] {
            // f32 recursion over some tens of samples.
            assert!((field.at(p)[1] - bump(p)).abs() < 1e-6);
        }
    }

    #[test]
    fn means_over_quadrilaterals_are_those_of_their_points() {
        use crate::simulate::scene::pixels::{GAUSS_2, GAUSS_3};
        let field = field();
        for (x, y) in (0..200).map(|k| (1.0 + 0.037 * f64::from(k), 1.5 + 0.029 * f64::from(k))) {
            let corners = [[x, y], [x + 0.31, y + 0.02], [x - 0.03, y + 0.29], [x + 0.285, y + 0.305]];
            let exact = |rule: &[(f64, f64)]| {
                let mut sum = 0.0;
                for (v, wv) in rule.iter().map(|r| (r.0 + 0.5, r.1)) {
                    for (u, wu) in rule.iter().map(|r| (r.0 + 0.5, r.1)) {
                        let between = |a: usize| {
                            let [p, q, r, s] = corners.map(|c| c[a]);
                            (1.0 - v) * (p + u * (q - p)) + v * (r + u * (s - r))
                        };
                        sum += wu * wv * f64::from(field.at([between(0), between(1)])[1]);
                    }
                }
                sum
            };
            // Single precision from the place to the sum: a few 1e-7 of the bump, whose height is 1.
            let two = f64::from(field.mean_over(&Nodes::<4>::new(GAUSS_2), corners).unwrap()[1]);
            assert!((two - exact(GAUSS_2)).abs() < 5e-7, "{two} {}", exact(GAUSS_2));
            let three = f64::from(field.mean_over(&Nodes::<9>::new(GAUSS_3), corners).unwrap()[1]);
            assert!((three - exact(GAUSS_3)).abs() < 5e-7, "{three} {}", exact(GAUSS_3));
        }
        assert!(field.mean_over(&Nodes::<4>::new(GAUSS_2), [[0.3, 3.0], [0.6, 3.0], [0.3, 3.3], [0.6, 3.3]]).is_none());
        assert_eq!(field.at([0.37, 3.0]), [0.0; 3]);
    }

    #[test]
    fn cell_means_equal_dense_sampling() {
        let field = field();
        let means = field.cell_means([5.1, 4.3], [5, 5], 0.6);
        let n = 60;
        let mut sum = 0.0;
        for i in 0..n * n {
            let (u, v) = ((i % n) as f64, (i / n) as f64);
            let p = [5.1 - 0.3 + (u + 0.5) * 0.6 / n as f64 + 0.6, 4.3 - 0.3 + (v + 0.5) * 0.6 / n as f64 - 0.6];
            sum += f64::from(field.at(p)[2]);
        }
        let dense = sum / (n * n) as f64;
        // The midpoint rule with 60 points errs by about 1e-5 of the value.
        assert!((f64::from(means[(5 + 3) * 3 + 2]) - dense).abs() < 2e-5 * dense);
    }
}
