//! How much the lens blurs, from the edges of the board's squares.

use crate::capture::Board;
use crate::cholesky::solve_small;
use crate::geometry::{CameraView, Point};
use crate::radiance::Radiance;
use serde::{Deserialize, Serialize};

/// The lens's point spread over the slab, taken for a Gaussian that is the same all over it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PointSpread {
    /// Its standard deviation without the pixels' own extent, camera px; 0 when the board is as sharp as it can be.
    pub psf_px: f64,
    /// Standard deviation of `psf_px`² between parts of the picture, over their number's root, px²; as large as what
    /// was found where fewer than two parts can be told apart: it is then taken for none.
    pub variance_sd_px2: f64,
    /// The least and the largest standard deviation that a ninth of the picture gives by itself, camera px.
    pub range_px: [f64; 2],
}

/// Pixels to each side of an edge that are looked at; closer where squares are small.
const REACH_PX: f64 = 5.0;
/// The same in sides of a square: beyond, the opposite edge is near.
const REACH_SQUARES: f64 = 0.4;
/// Share of a square's side next to a corner that is left out, at least two pixels of it.
const CORNER_SHARE: f64 = 0.25;
/// The picture is cut in so many parts along each axis.
const PARTS: usize = 3;
/// Variances that are searched, px².
const LARGEST_PX2: f64 = 16.0;
/// A blur smaller than this many of its standard deviations is taken for none.
const SIGNIFICANCE: f64 = 3.0;

/// Light across one edge: signed distance of each pixel from it, px, its brightness, and how wide a pixel is across it.
struct Edge {
    part: usize,
    across: Vec<(f64, f64)>,
    /// Width of the pixel along the edge's normal, px, and the variance that the other side adds, px².
    box_px: f64,
    extra_px2: f64,
    /// The print's own softness, px².
    print_px2: f64,
}

/// Measures the point spread from the merged photograph of the board (the slanted edge of ISO 12233, fitted instead of
/// differentiated).
///
/// Every edge between neighbouring corners is fitted with a blurred step of free levels and a free shift; the variance
/// of the blur is common to all. `board.edge_blur_mm` is the print's own. `None` when fewer than ten edges can be used.
///
/// Not detected: halos wider than a few pixels, blur that is not Gaussian, a board that is softer than it says (it is
/// taken for the lens's).
pub fn measure_point_spread(picture: &Radiance, board: &Board, view: &CameraView) -> Option<PointSpread> {
    let edges = collect_edges(picture, board, view);
    if edges.len() < 10 {
        return None;
    }
    let total = least_variance(edges.iter());
    let parts: Vec<f64> = (0..PARTS * PARTS)
        .filter(|&part| edges.iter().filter(|e| e.part == part).count() >= 4)
        .map(|part| least_variance(edges.iter().filter(|e| e.part == part)))
        .collect();
    let variance_sd_px2 = sd_of_mean(&parts).unwrap_or(total.abs());
    let px = |variance: f64| variance.max(0.0).sqrt();
    let fold = |pick: fn(f64, f64) -> f64| px(parts.iter().copied().reduce(pick).unwrap_or(total));
    let psf_px = if total > SIGNIFICANCE * variance_sd_px2 { px(total) } else { 0.0 };
    Some(PointSpread { psf_px, variance_sd_px2, range_px: [fold(f64::min), fold(f64::max)] })
}

/// Standard deviation of the mean of variances, from their spread; `None` for fewer than two.
fn sd_of_mean(variances: &[f64]) -> Option<f64> {
    if variances.len() < 2 {
        return None;
    }
    let n = variances.len() as f64;
    let mean = variances.iter().sum::<f64>() / n;
    let spread = variances.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (n - 1.0);
    Some((spread / n).sqrt())
}

fn collect_edges(picture: &Radiance, board: &Board, view: &CameraView) -> Vec<Edge> {
    let [nx, ny] = board.inner_corners;
    let corner = |i: usize, j: usize| view.camera_from_slab(board.corner_mm([i, j]));
    let along_x = (0..ny).flat_map(|j| (1..nx).map(move |i| ([i - 1, j], [i, j])));
    let along_y = (1..ny).flat_map(|j| (0..nx).map(move |i| ([i, j - 1], [i, j])));
    let light = picture.luminance();
    let part = |at: usize, n: usize| (at * PARTS / n).min(PARTS - 1);
    along_x
        .chain(along_y)
        .filter_map(|(a, b)| {
            let part = part(a[1], ny) * PARTS + part(a[0], nx);
            let (from, to) = (corner(a[0], a[1]), corner(b[0], b[1]));
            let px_per_mm = (to[0] - from[0]).hypot(to[1] - from[1]) / board.square_mm;
            let print_px2 = (board.edge_blur_mm * px_per_mm).powi(2);
            edge(picture, &light, from, to, part, print_px2)
        })
        .collect()
}

/// The pixels around the edge between two neighbouring corners; `None` where the photograph ends or nothing measured
/// one.
fn edge(picture: &Radiance, light: &[f32], from: Point, to: Point, part: usize, print_px2: f64) -> Option<Edge> {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    let length = dx.hypot(dy);
    let normal = [-dy / length, dx / length];
    let reach = REACH_PX.min(REACH_SQUARES * length);
    let margin = (CORNER_SHARE * length).max(2.0);
    let rect = picture.rect;
    let range = |a: usize, first: usize, len: usize| {
        let (low, high) = (from[a].min(to[a]) - reach, from[a].max(to[a]) + reach);
        let inside = low >= first as f64 && high <= (first + len - 1) as f64;
        inside.then(|| low.floor() as usize..high.ceil() as usize)
    };
    let (columns, rows) = (range(0, rect.x, rect.width)?, range(1, rect.y, rect.height)?);
    let mut across = Vec::new();
    for y in rows {
        for x in columns.clone() {
            let p = [x as f64 - from[0], y as f64 - from[1]];
            let (d, t) = (p[0] * normal[0] + p[1] * normal[1], (p[0] * dx + p[1] * dy) / length);
            if d.abs() > reach || t < margin || t > length - margin {
                continue;
            }
            let k = picture.at(x, y);
            if picture.used[k..k + 3].contains(&0) {
                return None;
            }
            across.push((d, f64::from(light[k / 3])));
        }
    }
    let sides = normal.map(f64::abs);
    let (wide, narrow) = (sides[0].max(sides[1]), sides[0].min(sides[1]));
    (across.len() >= 12).then_some(Edge { part, across, box_px: wide, extra_px2: narrow * narrow / 12.0, print_px2 })
}

/// The search ends at an interval of this, px²: a blur of 0.3 px to 2e-5 px.
const SETTLED_PX2: f64 = 1e-5;

/// The variance of the blur that fits the edges best, px²; negative when they are sharper than the print is said to be.
fn least_variance<'a>(edges: impl Iterator<Item = &'a Edge> + Clone) -> f64 {
    let edges: Vec<&Edge> = edges.collect();
    let floor = -edges.iter().map(|e| e.print_px2 + e.extra_px2).fold(f64::MAX, f64::min);
    let residual = |variance: f64| edges.iter().filter_map(|e| e.residual(variance)).sum::<f64>();
    // A coarse walk over standard deviations, then golden section: the residual has one minimum near the best of the
    // walk.
    let step = |k: i32| floor + (f64::from(k) / 20.0).powi(2) * (LARGEST_PX2 - floor);
    let best = (0..=20).min_by(|&a, &b| residual(step(a)).total_cmp(&residual(step(b)))).unwrap_or(0);
    let (mut low, mut high) = (step((best - 1).max(0)), step((best + 1).min(20)));
    let ratio = (5f64.sqrt() - 1.0) / 2.0;
    let inner = |low: f64, high: f64| [high - ratio * (high - low), low + ratio * (high - low)];
    let [mut a, mut b] = inner(low, high).map(|at| (at, residual(at)));
    while high - low > SETTLED_PX2 {
        // One of the two inner places is one of the next two.
        if a.1 < b.1 {
            (high, b) = (b.0, a);
            let at = inner(low, high)[0];
            a = (at, residual(at));
        } else {
            (low, a) = (a.0, b);
            let at = inner(low, high)[1];
            b = (at, residual(at));
        }
    }
    (low + high) / 2.0
}

impl Edge {
    /// Sum of squares that a blur of this variance leaves, over the step's square; `None` without a step.
    fn residual(&self, variance: f64) -> Option<f64> {
        let sd = (variance + self.print_px2 + self.extra_px2).max(1e-6).sqrt();
        // Level, step, and the step's slope: a shift to first order. Least squares by the sums of products, about the
        // middle of the light: columns of about one leave them a condition of some hundreds.
        let middle = self.across.iter().map(|a| a.1).sum::<f64>() / self.across.len() as f64;
        let (mut squares, mut right, mut all) = ([[0.0; 3]; 3], [0.0; 3], 0.0);
        for &(d, v) in &self.across {
            let (row, v) = (self.columns(d, sd), v - middle);
            for i in 0..3 {
                (0..=i).for_each(|j| squares[i][j] += row[i] * row[j]);
                right[i] += row[i] * v;
            }
            all += v * v;
        }
        let (x, _) = solve_small(squares, right)?;
        let rss = (all - (0..3).map(|i| x[i] * right[i]).sum::<f64>()).max(0.0);
        let contrast = x[1] * x[1];
        (contrast > 0.0 && rss.is_finite()).then(|| rss / contrast)
    }

    fn columns(&self, d: f64, sd: f64) -> [f64; 3] {
        // The integral of the normal distribution: its difference over the pixel's width is the pixel's mean.
        let [(high, ramp_high), (low, ramp_low)] = [0.5, -0.5].map(|half| {
            let x = d + half * self.box_px;
            let cdf = normal_cdf(x / sd);
            (cdf, x * cdf + sd * (-0.5 * (x / sd).powi(2)).exp() / std::f64::consts::TAU.sqrt())
        });
        [1.0, (ramp_high - ramp_low) / self.box_px, (high - low) / self.box_px]
    }
}

fn normal_cdf(x: f64) -> f64 {
    0.5 * libm::erfc(-x / std::f64::consts::SQRT_2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;
    use crate::geometry::{Homography, Lens};

    fn board(edge_blur_mm: f64) -> Board {
        Board { inner_corners: [6, 5], square_mm: 1.0, origin_mm: [0.0, 0.0], edge_blur_mm }
    }

    fn view(turn_deg: f64) -> CameraView {
        let (sin, cos) = turn_deg.to_radians().sin_cos();
        let scale = 12.0;
        let matrix = [[scale * cos, -scale * sin, 18.3], [scale * sin, scale * cos, 8.1], [0.0, 0.0, 1.0]];
        CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([44.5, 39.5], 500.0) }
    }

    /// A board averaged over pixels by brute force: places spread evenly over each pixel, moved by a grid of quantiles
    /// of the Gaussian.
    fn picture(view: &CameraView, blur_px: f64) -> Radiance {
        let rect = Rect { x: 0, y: 0, width: 90, height: 80 };
        let places: Vec<f64> = (0..60).map(|k| (f64::from(k) + 0.5) / 60.0 - 0.5).collect();
        // A pixel's side and a Gaussian folded along one axis, at even places.
        let reach = (4.0 * blur_px + 0.5).max(0.6);
        let nodes: Vec<(f64, f64)> = (-24..=24)
            .map(|k| {
                let t = f64::from(k) / 24.0 * reach;
                let density = |u: f64| (-0.5 * ((t - u) / blur_px.max(1e-3)).powi(2)).exp();
                (t, places.iter().map(|&u| density(u)).sum::<f64>())
            })
            .collect();
        let total: f64 = nodes.iter().map(|n| n.1).sum();
        let slab = view.ideal_from_slab.inverse().unwrap();
        let mut value = Vec::new();
        for y in 0..rect.height {
            for x in 0..rect.width {
                let mut sum = 0.0;
                for &(v, wv) in &nodes {
                    for &(u, wu) in &nodes {
                        let p = slab.map([x as f64 + u, y as f64 + v]);
                        let dark = (p[0].floor() as i64 + p[1].floor() as i64) % 2 == 0;
                        sum += wu * wv * if dark { 50.0 } else { 850.0 };
                    }
                }
                value.extend([(sum / (total * total)) as f32; 3]);
            }
        }
        let n = value.len();
        Radiance { rect, value, variance: vec![1.0; n], used: vec![1; n] }
    }

    #[test]
    fn the_blur_of_a_board_is_found() {
        for (blur_px, turn_deg) in [(0.3, 0.8), (0.6, 3.0), (0.9, 20.0)] {
            let found = measure_point_spread(&picture(&view(turn_deg), blur_px), &board(0.0), &view(turn_deg)).unwrap();
            // The picture is made of 49 places an axis and pixel, an edge is displaced by up to half of one; a turned
            // pixel is taken for a box and a Gaussian.
            assert!((found.psf_px / blur_px - 1.0).abs() < 0.02, "{blur_px}: {found:?}");
            assert!(found.range_px[0] <= found.psf_px && found.psf_px <= found.range_px[1]);
        }
    }

    #[test]
    fn the_softness_of_the_print_is_not_the_lens_s() {
        // 0.03 mm at 12 px per mm are 0.36 px: what is left of 0.6 px is 0.48.
        let found = measure_point_spread(&picture(&view(3.0), 0.6), &board(0.03), &view(3.0)).unwrap();
        assert!((found.psf_px / 0.48 - 1.0).abs() < 0.03, "{found:?}");
        // A print that is said to be softer than the picture leaves nothing.
        let none = measure_point_spread(&picture(&view(3.0), 0.6), &board(0.06), &view(3.0)).unwrap();
        assert_eq!(none.psf_px, 0.0);
    }

    #[test]
    fn a_board_too_small_for_parts_tells_no_blur_and_a_finite_deviation() {
        // Twelve edges, at most two of them in a ninth of the picture: nothing to compare.
        let small = |edge_blur_mm| Board { inner_corners: [3, 3], ..board(edge_blur_mm) };
        let picture = picture(&view(3.0), 0.6);
        // 0.36 px² in all; the print's 0.06 mm at 12 px per mm are 0.52 px², more than that: a variance below zero.
        for (edge_blur_mm, expected) in [(0.0, 0.36), (0.06, 0.5184 - 0.36)] {
            let found = measure_point_spread(&picture, &small(edge_blur_mm), &view(3.0)).unwrap();
            assert_eq!(found.psf_px, 0.0);
            // The picture is good to 2 % of 0.6 px: 4 % of its square.
            assert!((found.variance_sd_px2 - expected).abs() < 0.04 * 0.36, "{found:?}");
        }
    }

    #[test]
    fn the_deviation_of_a_mean_is_that_of_its_parts_over_the_root_of_their_number() {
        // Mean 3; squares 4 + 0 + 1 + 1 over 3 are 2, over 4 a half.
        assert!((sd_of_mean(&[1.0, 3.0, 4.0, 4.0]).unwrap() - 0.5f64.sqrt()).abs() < 1e-15);
        assert_eq!((sd_of_mean(&[5.0]), sd_of_mean(&[])), (None, None));
    }

    #[test]
    fn an_even_picture_has_no_edges() {
        let mut even = picture(&view(3.0), 0.3);
        even.value.fill(7.0);
        assert!(measure_point_spread(&even, &board(0.0), &view(3.0)).is_none_or(|p| p.psf_px.is_finite()));
        even.used.fill(0);
        assert!(measure_point_spread(&even, &board(0.0), &view(3.0)).is_none());
    }
}
