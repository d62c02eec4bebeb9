//! How sharp the photographs are, from the edges of the board's squares.

use crate::capture::Board;
use crate::geometry::{CameraView, Point};
use crate::radiance::Radiance;

/// Bins a pixel across an edge: edges lie at all fractions of a pixel, so that together they show the rise finer than it.
const BINS_PER_PX: f64 = 4.0;
/// Beyond this share of a square's side from the edge the next edge would be seen.
const REACH: f64 = 0.4;
/// A rise is measured from this many samples on.
const LEAST_SAMPLES: usize = 200;
/// Edges between these shares of a square's side along it: corners blur differently.
const ALONG: [f64; 2] = [0.3, 0.7];

/// The mean rise of the board's edges from a tenth to nine tenths of their height, px (`ISO12233`'s slanted edges, all together).
///
/// A pixel that averages over its own area and nothing else makes 0.8 px; a Gaussian blur of σ alone 2.56 σ. `None` when too little of the
/// board is measured or its squares are under some 8 px. Not told apart: blur of the lens, of motion, of the print.
pub(super) fn edge_width_px(picture: &Radiance, board: &Board, view: &CameraView) -> Option<f64> {
    let light = picture.luminance();
    let [nx, ny] = board.inner_corners;
    let corner = |i: usize, j: usize| view.camera_from_slab(board.corner_mm([i, j]));
    let edges_x = (0..ny).flat_map(|j| (0..nx - 1).map(move |i| ([i, j], [i + 1, j])));
    let edges_y = (0..ny - 1).flat_map(|j| (0..nx).map(move |i| ([i, j], [i, j + 1])));
    let mut bins: Vec<(f64, usize)> = Vec::new();
    let mut reach_px = f64::INFINITY;
    for (a, b) in edges_x.chain(edges_y) {
        let (p, q) = (corner(a[0], a[1]), corner(b[0], b[1]));
        let Some(samples) = across(picture, &light, p, q) else { continue };
        reach_px = reach_px.min(REACH * (q[0] - p[0]).hypot(q[1] - p[1]));
        add_normalized(&samples, reach_px, &mut bins);
    }
    if reach_px < 3.0 || bins.iter().map(|b| b.1).sum::<usize>() < LEAST_SAMPLES {
        return None;
    }
    rise(&bins)
}

/// Signed distance from the edge p–q and light of the pixels beside its middle part; `None` when it leaves the picture.
fn across(picture: &Radiance, light: &[f32], p: Point, q: Point) -> Option<Vec<(f64, f64)>> {
    let length = (q[0] - p[0]).hypot(q[1] - p[1]);
    let along = [(q[0] - p[0]) / length, (q[1] - p[1]) / length];
    let reach = REACH * length;
    let range = |a: usize, n: usize| {
        let (low, high) = (p[a].min(q[a]) - reach, p[a].max(q[a]) + reach);
        (low >= 0.0 && high <= n as f64 - 1.0).then_some(low.ceil() as usize..=high as usize)
    };
    let (xs, ys) = (range(0, picture.rect.width)?, range(1, picture.rect.height)?);
    let mut samples = Vec::new();
    for y in ys {
        for x in xs.clone() {
            let d = [x as f64 - p[0], y as f64 - p[1]];
            let share = (d[0] * along[0] + d[1] * along[1]) / length;
            let distance = d[1] * along[0] - d[0] * along[1];
            let k = picture.at(x, y);
            if distance.abs() <= reach && (ALONG[0]..=ALONG[1]).contains(&share) && !picture.used[k..k + 3].contains(&0)
            {
                samples.push((distance, f64::from(light[k / 3])));
            }
        }
    }
    Some(samples)
}

/// Adds an edge's samples, its dark side set to 0 and its light one to 1, light on the positive side.
fn add_normalized(samples: &[(f64, f64)], reach: f64, bins: &mut Vec<(f64, usize)>) {
    // The outer half of each side is its plateau.
    let plateau = |side: f64| {
        let far: Vec<f64> = samples.iter().filter(|s| s.0 * side > 0.6 * reach).map(|s| s.1).collect();
        (far.len() > 1).then(|| far.iter().sum::<f64>() / far.len() as f64)
    };
    let (Some(before), Some(after)) = (plateau(-1.0), plateau(1.0)) else { return };
    if (after - before).abs() < 0.2 * after.max(before) {
        return;
    }
    let side = if after > before { 1.0 } else { -1.0 };
    let (low, high) = (before.min(after), before.max(after));
    let half = (reach * BINS_PER_PX) as isize;
    bins.resize(bins.len().max(2 * half as usize + 1), (0.0, 0));
    let middle = (bins.len() / 2) as isize;
    for (distance, value) in samples {
        let bin = middle + (side * distance * BINS_PER_PX).round() as isize;
        if let Some(bin) = usize::try_from(bin).ok().and_then(|b| bins.get_mut(b)) {
            *bin = (bin.0 + (value - low) / (high - low), bin.1 + 1);
        }
    }
}

fn rise(bins: &[(f64, usize)]) -> Option<f64> {
    let curve: Vec<(f64, f64)> = (0..bins.len())
        .filter(|&k| bins[k].1 > 0)
        .map(|k| ((k as f64 - (bins.len() / 2) as f64) / BINS_PER_PX, bins[k].0 / bins[k].1 as f64))
        .collect();
    let half = curve.windows(2).position(|w| w[0].1 < 0.5 && w[1].1 >= 0.5)?;
    let between = |a: (f64, f64), b: (f64, f64), at: f64| a.0 + (at - a.1) / (b.1 - a.1) * (b.0 - a.0);
    // Outwards from the middle, so that ripples of the plateaus do not count.
    let low = (0..=half).rev().find(|&k| curve[k].1 <= 0.1).map(|k| between(curve[k], curve[k + 1], 0.1))?;
    let high = (half + 1..curve.len()).find(|&k| curve[k].1 >= 0.9).map(|k| between(curve[k - 1], curve[k], 0.9))?;
    Some(high - low)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;
    use crate::geometry::{Homography, Lens};

    /// The normal distribution's integral, by Abramowitz and Stegun 7.1.26 (error below 2e-7).
    fn phi(x: f64) -> f64 {
        let z = x.abs() / std::f64::consts::SQRT_2;
        let t = 1.0 / (1.0 + 0.3275911 * z);
        let poly = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
        let erf = 1.0 - poly * (-z * z).exp();
        if x < 0.0 { 0.5 * (1.0 - erf) } else { 0.5 * (1.0 + erf) }
    }

    #[test]
    fn the_edges_of_a_blurred_board_have_the_width_of_its_blur() {
        let board = Board { inner_corners: [7, 6], square_mm: 2.0, origin_mm: [4.0, 4.0] };
        // 8 px/mm, turned by 4 degrees: edges meet pixels at all fractions.
        let (sin, cos) = 4.0f64.to_radians().sin_cos();
        let ideal_from_slab =
            Homography { matrix: [[8.0 * cos, -8.0 * sin, 20.0], [8.0 * sin, 8.0 * cos, 5.0], [0.0, 0.0, 1.0]] };
        let view = CameraView { ideal_from_slab, lens: Lens::ideal([80.0, 80.0], 500.0) };
        let rect = Rect { x: 0, y: 0, width: 180, height: 170 };
        for sigma_px in [0.7, 1.5] {
            let mut value = Vec::new();
            for y in 0..rect.height {
                for x in 0..rect.width {
                    let p = view.slab_from_camera([x as f64, y as f64]).unwrap();
                    // A product of two blurred square waves, ±1: exact for a board without rims.
                    let wave = |v: f64| {
                        let (u, s) = ((v - 4.0) / 2.0, sigma_px / 8.0 / 2.0);
                        (-20..=20)
                            .fold(-1.0, |w, k| w + if k & 1 == 0 { 2.0 } else { -2.0 } * phi((u - f64::from(k)) / s))
                    };
                    let v = 0.5 + 0.4 * wave(p[0]) * wave(p[1]);
                    value.extend([v as f32; 3]);
                }
            }
            let n = value.len();
            let picture = Radiance { rect, value, variance: vec![0.0; n], used: vec![1; n] };
            let width = edge_width_px(&picture, &board, &view).unwrap();
            // Bins of a quarter pixel widen by 0.25²/12 in variance: under 1 %; plateaus within reach of the blur narrow by about 2 %.
            assert!((width / (2.563 * sigma_px) - 1.0).abs() < 0.05, "{sigma_px}: {width}");
        }
    }
}
