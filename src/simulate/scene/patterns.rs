//! What is printed and projected: the board, Gray codes, dots, and how a pixel averages their edges.

use super::SimulatedScene;
use super::pixels::{GAUSS_1, GAUSS_2, GAUSS_3, GAUSS_6, Rule};
use crate::simulate::SimulateOptions;
use crate::{capture::Axis, geometry::Point};

/// Albedo of the printed board, dark and light.
const BOARD_ALBEDO: [f64; 2] = [0.05, 0.85];

/// Albedo of the printed board at `p`: white paper everywhere around the squares, the first square dark.
pub(crate) fn board_albedo(scene: &SimulatedScene, p: Point) -> f64 {
    let board = &scene.board;
    let soft = board.edge_blur_mm / board.square_mm;
    // A square wave of each coordinate, −1 and +1, with soft edges; outside the squares there is only paper.
    let wave = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        let edge = nearest(t).clamp(0, board.inner_corners[a] as i64 - 1);
        let sign = if edge % 2 == 0 { 1.0 } else { -1.0 };
        sign * (2.0 * normal_cdf((t - edge as f64) / soft) - 1.0)
    };
    let inside = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        normal_cdf((t + 1.0) / soft) * normal_cdf((board.inner_corners[a] as f64 - t) / soft)
    };
    let [dark, light] = BOARD_ALBEDO;
    let darkness = 0.5 * (1.0 + wave(0) * wave(1)) * inside(0) * inside(1);
    light + darkness * (dark - light)
}

/// How to average the board over pixels that begin at `p` and reach `pixel_mm` far.
pub(crate) fn board_rule(scene: &SimulatedScene, pixel_mm: f64, p: Point) -> Rule {
    let reach = (pixel_mm + 6.0 * scene.board.edge_blur_mm) / scene.board.square_mm;
    let between = |a: usize| {
        let t = (p[a] - scene.board.origin_mm[a]) / scene.board.square_mm;
        (t - nearest(t) as f64).abs() > reach
    };
    if between(0) && between(1) { GAUSS_1 } else { GAUSS_6 }
}

/// One bit of the Gray code, as projected.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GrayCode {
    pub axis: Axis,
    pub bit: u32,
    pub inverse: bool,
    pub blur_px: f64,
}

impl GrayCode {
    /// Signed distance (projector px) of projector position `q` from the nearest edge, and whether light begins there.
    fn nearest_edge(&self, q: Point) -> (f64, bool) {
        let t = match self.axis {
            Axis::X => q[0],
            Axis::Y => q[1],
        };
        // Bit j of n XOR (n >> 1) changes where n passes 2^j, 2^j + 2^(j+1), …; the edge lies half a pixel before.
        let stripe = f64::from(2u32 << self.bit);
        let first = f64::from(1u32 << self.bit) - 0.5;
        let edge = nearest((t - first) / stripe);
        (t - first - edge as f64 * stripe, (edge % 2 == 0) != self.inverse)
    }

    /// Brightness 0..1 at projector position `q`, blurred across its edges.
    pub(crate) fn brightness(&self, q: Point) -> f64 {
        let (distance, rises) = self.nearest_edge(q);
        let after = blurred_step(distance, self.blur_px);
        if rises { after } else { 1.0 - after }
    }

    /// Brightness at `q` as a translucent sample shows it: the mean of the stripes over a Gaussian of two outgoing
    /// pitches.
    pub(crate) fn blurred(&self, q: Point, options: &SimulateOptions) -> f64 {
        const POINTS: i32 = 9;
        let sd = options.projector_px_mm().map(|mm| 2.0 * options.pitch_mm / mm);
        let (mut sum, mut weights) = (0.0, 0.0);
        for k in -POINTS..=POINTS {
            let t = 3.0 * f64::from(k) / f64::from(POINTS);
            let weight = (-0.5 * t * t).exp();
            sum += weight * self.brightness([q[0] + t * sd[0], q[1] + t * sd[1]]);
            weights += weight;
        }
        sum / weights
    }

    /// What pixels see that begin at `q` and reach `pixel_px` far.
    pub(crate) fn around(&self, q: Point, pixel_px: f64) -> Brightness {
        let (distance, rises) = self.nearest_edge(q);
        // Five standard deviations from an edge a step is complete to 3e-7.
        if distance.abs() > pixel_px + 5.0 * self.blur_px {
            return Brightness::Even(if (distance > 0.0) == rises { 1.0 } else { 0.0 });
        }
        // The error falls as the fourth and sixth power of pixel over blur: below 1e-4 of the step at these limits.
        Brightness::Edge(match pixel_px / self.blur_px {
            r if r < 0.7 => GAUSS_2,
            r if r < 1.5 => GAUSS_3,
            _ => GAUSS_6,
        })
    }
}

/// What a pixel sees of a projected pattern.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Brightness {
    /// The same all over.
    Even(f64),
    /// An edge, to be averaged by a rule.
    Edge(Rule),
}

/// The nearest whole number; `round` is a slow call on processors without SSE 4.1.
fn nearest(v: f64) -> i64 {
    let below = (v + 0.5) as i64;
    if below as f64 > v + 0.5 { below - 1 } else { below }
}

/// A step from 0 to 1 at 0, blurred by a normal distribution.
fn blurred_step(t: f64, blur: f64) -> f64 {
    // Sharp steps stay finite where both are zero.
    normal_cdf(t / blur.max(1e-9))
}

/// A blurred square of half a side `half`, or a blurred disc of this radius, at `q` from its middle.
///
/// The disc: chords, each a blurred line along x, blurred along y; midpoints of the angle, right to 1e-4 for blurs of a
/// tenth of the radius and more.
pub(crate) fn soft_dot(q: Point, half: f64, blur_px: f64, round: bool) -> f64 {
    if !round {
        return soft_box(q[0], half, blur_px) * soft_box(q[1], half, blur_px);
    }
    let chord = |k: usize| {
        let angle = std::f64::consts::PI * ((k as f64 + 0.5) / CHORDS as f64 - 0.5);
        let (y, width) = (half * angle.sin(), half * angle.cos());
        let far = (q[1] - y) / blur_px;
        soft_box(q[0], width, blur_px) * (-0.5 * far * far).exp() * width
    };
    let norm = (std::f64::consts::PI / 2.0).sqrt() / (CHORDS as f64 * blur_px);
    norm * (0..CHORDS).map(chord).sum::<f64>()
}

/// Chords of a disc.
const CHORDS: usize = 64;

/// A box of half width `half`, blurred as the projector's pixels are; its integral stays 2 · half.
fn soft_box(t: f64, half: f64, blur_px: f64) -> f64 {
    blurred_step(t + half, blur_px) - blurred_step(t - half, blur_px)
}

/// The standard normal distribution function, absolute error below 1e-7 (Abramowitz & Stegun 7.1.26 for erf).
pub(crate) fn normal_cdf(t: f64) -> f64 {
    let x = t.abs() / std::f64::consts::SQRT_2;
    if x > 5.0 {
        return if t > 0.0 { 1.0 } else { 0.0 };
    }
    let k = 1.0 / (1.0 + 0.327_591_1 * x);
    let polynomial =
        k * (0.254_829_592 + k * (-0.284_496_736 + k * (1.421_413_741 + k * (-1.453_152_027 + k * 1.061_405_429))));
    let tail = 0.5 * polynomial * (-x * x).exp();
    if t > 0.0 { 1.0 - tail } else { tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gray_code_equals_its_definition_at_pixel_centres() {
        for bit in 2..7 {
            for n in 0..200u32 {
                let expected = f64::from(((n ^ (n >> 1)) >> bit) & 1);
                let q = [f64::from(n), f64::from(n)];
                // Half a pixel from an edge is 1.7 standard deviations of the blur: under 5 % of the step.
                assert!(
                    (GrayCode { axis: Axis::X, bit, inverse: false, blur_px: 0.3 }.brightness(q) - expected).abs()
                        < 0.05,
                    "bit {bit}, column {n}"
                );
                assert!(
                    (GrayCode { axis: Axis::Y, bit, inverse: true, blur_px: 0.3 }.brightness(q) + expected - 1.0).abs()
                        < 0.05
                );
            }
        }
    }
}
