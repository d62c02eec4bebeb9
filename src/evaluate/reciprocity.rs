//! R_d(a, b) = R_d(b, a): how well a measured matrix keeps it, on pairs of lit points that see each other.

use crate::geometry::Point;
use crate::material::Shape;
use crate::transport::RowBlock;
use crate::transport::rows::RowView;

/// The most pairs that are compared; beyond it every k-th lit point is paired with all that it sees.
const PAIRS: usize = 1 << 18;

/// Collects both directions of each pair as the rows stream by.
#[derive(Debug)]
pub(super) struct Reciprocity {
    /// Per row: (pair, other point, direction).
    by_row: Vec<Vec<(usize, usize, usize)>>,
    /// Per pair: R(a, b) and R(b, a), each channel, once known.
    values: Vec<[Option<[f64; 3]>; 2]>,
}

impl Reciprocity {
    /// Chooses the pairs: those whose offset lies inside the window, with room for bilinear interpolation.
    pub(super) fn new(shape: &Shape<'_>) -> Self {
        let rows = shape.rows().min(shape.lit_mm.len());
        let reach: [usize; 2] = std::array::from_fn(|a| {
            let window = (shape.window[a] / 2) as f64 * shape.pitch_mm;
            ((window / shape.lit_pitch_mm[a]).ceil() as usize).min(shape.points[a])
        });
        let seen = (2 * reach[0] + 1).saturating_mul(2 * reach[1] + 1);
        let stride = rows.saturating_mul(seen).div_ceil(2 * PAIRS).max(1);
        let mut out = Self { by_row: vec![Vec::new(); shape.rows()], values: Vec::new() };
        for a in (0..rows).step_by(stride) {
            let [x, y] = [a % shape.points[0], a / shape.points[0]];
            for v in y.saturating_sub(reach[1])..(y + reach[1] + 1).min(shape.points[1]) {
                for u in x.saturating_sub(reach[0])..(x + reach[0] + 1).min(shape.points[0]) {
                    let b = u + v * shape.points[0];
                    // Each pair once: from its lower point, or from the only one of the two that is visited.
                    let visited = b.is_multiple_of(stride);
                    if b != a && b < rows && (b > a || !visited) {
                        let pair = out.values.len();
                        out.values.push([None, None]);
                        out.by_row[a].push((pair, b, 0));
                        out.by_row[b].push((pair, a, 1));
                    }
                }
            }
        }
        out
    }

    /// Takes what a block of rows knows.
    pub(super) fn add(&mut self, block: &RowBlock, shape: &Shape<'_>) {
        for k in 0..block.rows {
            let here = shape.lit_mm[block.first + k];
            for &(pair, other, direction) in &self.by_row[block.first + k] {
                let there = shape.lit_mm[other];
                self.values[pair][direction] =
                    interpolate(block.view(k), shape, [there[0] - here[0], there[1] - here[1]]);
            }
        }
    }

    /// RMS of the difference over the RMS of the mean, over pairs of which both directions were measured.
    pub(super) fn relative_rms(&self) -> Option<f64> {
        let (mut difference, mut mean) = (0.0, 0.0);
        for pair in &self.values {
            let [Some(ab), Some(ba)] = pair else { continue };
            for (x, y) in ab.iter().zip(ba) {
                difference += (x - y) * (x - y);
                mean += (x + y) * (x + y) / 4.0;
            }
        }
        (mean > 0.0).then(|| (difference / mean).sqrt())
    }
}

/// The response at an offset in mm, bilinear between four samples; `None` when one of them counts and was not measured.
fn interpolate(row: RowView<'_>, shape: &Shape<'_>, offset_mm: Point) -> Option<[f64; 3]> {
    let mut base = [0; 2];
    let mut part = [0.0; 2];
    for a in 0..2 {
        let at = offset_mm[a] / shape.pitch_mm + (shape.window[a] / 2) as f64;
        // Lit points on samples are off by rounding only (f32 positions); they need no neighbour.
        let at = if (at - at.round()).abs() < 1e-3 { at.round() } else { at };
        if !(0.0..=(shape.window[a] - 1) as f64).contains(&at) {
            return None;
        }
        (base[a], part[a]) = (at.floor() as usize, at.fract());
    }
    let mut sum = [0.0; 3];
    for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let weight = |f: f64, d: usize| if d == 1 { f } else { 1.0 - f };
        let w = weight(part[0], dx) * weight(part[1], dy);
        if w == 0.0 {
            continue;
        }
        let s = 3 * (base[0] + dx + (base[1] + dy) * shape.window[0]);
        if row.valid.get(s..s + 3)?.contains(&0) {
            return None;
        }
        for c in 0..3 {
            sum[c] += w * f64::from(row.response[s + c]);
        }
    }
    Some(sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(rows: usize, window: [usize; 2], value: impl Fn(usize, [isize; 2]) -> f32) -> RowBlock {
        let [w, h] = window;
        let at = |k: usize| [(k % w) as isize - (w / 2) as isize, (k / w) as isize - (h / 2) as isize];
        let response: Vec<f32> =
            (0..rows).flat_map(|i| (0..w * h).map(move |k| (i, k))).flat_map(|(i, k)| [value(i, at(k)); 3]).collect();
        let n = response.len();
        RowBlock { first: 0, rows, response, variance: vec![0.0; n], valid: vec![1; n] }
    }

    fn figure(value: impl Fn(usize, [isize; 2]) -> f32) -> Option<f64> {
        let lit: Vec<Point> = (0..12).map(|i| [(i % 4) as f64, (i / 4) as f64]).collect();
        let shape = Shape { points: [4, 3], window: [5, 5], pitch_mm: 0.5, lit_pitch_mm: [1.0, 1.0], lit_mm: &lit };
        let mut reciprocity = Reciprocity::new(&shape);
        assert_eq!(reciprocity.values.len(), 9 + 8 + 12, "each pair of neighbours once: across, down, diagonal");
        reciprocity.add(&block(12, [5, 5], value), &shape);
        reciprocity.relative_rms()
    }

    #[test]
    fn a_reciprocal_slab_has_no_violation() {
        assert_eq!(figure(|_, d| 1.0 / (1.0 + (d[0] * d[0] + d[1] * d[1]) as f32)), Some(0.0));
        assert_eq!(figure(|_, _| 0.0), None);
    }

    #[test]
    fn a_known_violation_is_measured() {
        // Right and down of the source 1.1, left and up 0.9: every pair differs by 0.2 around 1.
        let value = |_: usize, d: [isize; 2]| if d[1] > 0 || (d[1] == 0 && d[0] > 0) { 1.1 } else { 0.9 };
        let found = figure(value).unwrap();
        assert!((found - 0.2).abs() < 1e-6, "f32: {found}");
    }
    #[test]
    fn bilinear_values_between_samples_are_those_of_a_bilinear_field() {
        // A field that is linear in x, in y and in both at once is interpolated exactly; each channel has its own.
        let field = |c: usize, x: f64, y: f64| [1.0, -2.0, 0.5][c] + [3.0, 0.25, -1.0][c] * x - 2.0 * y + 0.5 * x * y;
        let window = [7, 3];
        let sample = |k: usize| field(k % 3, (k / 3 % 7) as f64 - 3.0, (k / 21) as f64 - 1.0) as f32;
        let response: Vec<f32> = (0..63).map(sample).collect();
        let mut valid = vec![1; 63];
        let shape = Shape { points: [1, 1], window, pitch_mm: 0.5, lit_pitch_mm: [0.5; 2], lit_mm: &[[0.0; 2]] };
        let value = |valid: &[u8], x: f64, y: f64| {
            let row = RowView { response: &response, variance: &[], valid };
            interpolate(row, &shape, [0.5 * x, 0.5 * y])
        };
        for (x, y) in [(0.3, -0.6), (-2.75, 0.25), (2.0, 0.5), (-3.0, -1.0), (3.0, 1.0), (1.5, 1.0)] {
            let found = value(&valid, x, y).unwrap();
            // Samples are multiples of 1/4, exact in f32.
            assert!((0..3).all(|c| (found[c] - field(c, x, y)).abs() < 1e-13), "{found:?}");
        }
        for (x, y) in [(-3.01, 0.0), (3.01, 0.0), (0.0, -1.01), (0.0, 1.01)] {
            assert_eq!(value(&valid, x, y), None, "outside the window");
        }
        // A millimetre that was rounded to f32 is no place between samples.
        assert_eq!(value(&valid, 1.0 + 5e-4, 0.0).unwrap()[0], field(0, 1.0, 0.0));
        assert!((value(&valid, 1.002, 0.0).unwrap()[0] - field(0, 1.0, 0.0)).abs() > 1e-3);
        // Sample (2, 1): what counts it is not measured, what only touches its side is.
        valid[3 * (5 + 2 * 7) + 1] = 0;
        assert_eq!(value(&valid, 1.5, 1.0), None);
        assert_eq!(value(&valid, 2.5, 0.5), None);
        assert!(value(&valid, 2.0, 0.0).is_some() && value(&valid, 1.0, 0.5).is_some());
    }

    #[test]
    fn of_many_pairs_every_kth_point_meets_all_that_it_sees_and_no_pair_comes_twice() {
        // 3 × 5 points are seen from each of 150 000: four times what is compared.
        let points = [500, 300];
        let lit: Vec<Point> = (0..150_000).map(|i| [(i % 500) as f64 * 1.5, (i / 500) as f64]).collect();
        let shape = Shape { points, window: [9, 11], pitch_mm: 0.4, lit_pitch_mm: [1.5, 1.0], lit_mm: &lit };
        // ⌈4 · 0.4 / 1.5⌉ = 2 columns, ⌈5 · 0.4 / 1⌉ = 2 lines: 25 points; 150 000 · 25 / 2¹⁹ = 7.2.
        let stride = 8;
        let reciprocity = Reciprocity::new(&shape);
        let mut ends = vec![[usize::MAX; 2]; reciprocity.values.len()];
        for (row, list) in reciprocity.by_row.iter().enumerate() {
            for &(pair, other, direction) in list {
                ends[pair][direction] = row;
                assert!(row % stride == 0 || other % stride == 0);
                let [dx, dy] = [(row % 500).abs_diff(other % 500), (row / 500).abs_diff(other / 500)];
                assert!(dx <= 2 && dy <= 2);
            }
        }
        let mut sorted: Vec<[usize; 2]> = ends.iter().map(|e| [e[0].min(e[1]), e[0].max(e[1])]).collect();
        sorted.sort_unstable();
        assert!(sorted.windows(2).all(|p| p[0] != p[1]) && ends.iter().all(|e| e[0] != e[1]));
        let inner = 500 * 150 + 248;
        let met = sorted.iter().filter(|e| e.contains(&inner)).count();
        assert_eq!((inner % stride, met), (0, 24));
    }

    #[test]
    fn pairs_reach_as_far_along_each_axis_as_the_window_does() {
        // 6 × 4 points 1 mm apart, windows of 9 × 5 cells of 0.5 mm: two points away along x, one along y.
        let lit: Vec<Point> = (0..24).map(|i| [(i % 6) as f64, (i / 6) as f64]).collect();
        let shape = Shape { points: [6, 4], window: [9, 5], pitch_mm: 0.5, lit_pitch_mm: [1.0, 1.0], lit_mm: &lit };
        let mut reciprocity = Reciprocity::new(&shape);
        // In a row 5 and 4 pairs, one and two points away; between rows 6 straight, 2 · 5 and 2 · 4 aslant.
        assert_eq!(reciprocity.values.len(), 4 * (5 + 4) + 3 * (6 + 10 + 8));
        // Only the samples two points to the right differ from those two to the left, by 0.2 around 1; everything else
        // is dark.
        let value = |_: usize, [dx, dy]: [isize; 2]| match (dx, dy) {
            (4, 0) => 1.1,
            (-4, 0) => 0.9,
            _ => 0.0,
        };
        reciprocity.add(&block(24, [9, 5], value), &shape);
        let found = reciprocity.relative_rms().unwrap();
        assert!((found - 0.2).abs() < 1e-6, "f32: {found}");
        let measured = reciprocity.values.iter().filter(|[ab, _]| ab.is_some_and(|v| v[0] > 0.0)).count();
        assert_eq!(measured, 4 * 4);
    }
}
