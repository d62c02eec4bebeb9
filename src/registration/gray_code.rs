//! Gray-code stripes on the white reference: where each projector pixel lands on the slab's plane.

use super::board::percentile;
use super::fit::{Observation, fit_homography};
use crate::geometry::{CameraView, Homography, Point};

/// One bit of the code on one axis: the pattern and its inverse, one light value a pixel.
#[derive(Debug, Clone)]
pub struct BitPair {
    /// 0 for projector columns, 1 for rows.
    pub axis: usize,
    /// Bit number.
    pub bit: u32,
    /// Light under the pattern.
    pub pattern: Vec<f32>,
    /// Light under its inverse.
    pub inverse: Vec<f32>,
}

/// The projector registered to the slab's plane.
#[derive(Debug, Clone, Copy)]
pub struct ProjectorFit {
    /// Slab mm to projector px.
    pub projector_from_slab: Homography,
    /// RMS of the stripes' edges against the model, projector px.
    pub rms_px: f64,
    /// Standard deviation per axis of a modelled point, projector px.
    pub sd_px: f64,
    /// Number of edges.
    pub edges: usize,
}

/// A pixel is lit when pattern and inverse together reach this share of the bright ones.
const LIT_SHARE: f32 = 0.1;
/// An edge counts when the light's contrast on its two sides differs by more than half of the possible.
const EDGE_CONTRAST: f32 = 1.0;
/// At most this many pixels are decoded for the first estimate.
const DECODED_PIXELS: usize = 20_000;

struct Contrast {
    axis: usize,
    bit: u32,
    /// (P − P̄)/(P + P̄), `None` where unlit.
    value: Vec<Option<f32>>,
}

/// Fits the homography slab → projector to the places where stripes begin and end.
///
/// First each pixel's code gives its projector coordinate to a stripe; then every edge between light and dark, located to
/// a fraction of a pixel by the area under the contrast, gives one exact coordinate. Edges more than three deviations off
/// are dropped once. Lens distortion of the projector is not modelled: it shows in `rms_px`.
///
/// # Errors
/// A text that says what was not found.
pub fn register_projector(pairs: &[BitPair], size_px: [usize; 2], view: &CameraView) -> Result<ProjectorFit, String> {
    let [width, height] = size_px;
    let contrasts: Vec<Contrast> = pairs.iter().map(contrast).collect();
    let slab = |q: Point| view.slab_from_camera(q);
    let coarse = decode_pixels(&contrasts, width, height, &slab)?;
    let (mut projector_from_slab, _) =
        fit_homography(&coarse).ok_or("the Gray code was decoded in too few pixels to span a plane")?;

    let mut edges = Vec::new();
    for contrast in &contrasts {
        for (q, _) in find_edges(contrast, width, height) {
            let Some(from) = slab(q) else { continue };
            let coarse = projector_from_slab.map(from)[contrast.axis];
            if let Some(to) = nearest_edge(coarse, contrast.bit) {
                edges.push(Observation { from, axis: contrast.axis, to });
            }
        }
    }
    let mut rms_px = f64::INFINITY;
    for _ in 0..2 {
        let (fit, rms) = fit_homography(&edges).ok_or("too few stripe edges were found")?;
        (projector_from_slab, rms_px) = (fit, rms);
        edges.retain(|o| (fit.map(o.from)[o.axis] - o.to).abs() <= 3.0 * rms.max(1e-6));
    }
    if rms_px > 1.0 {
        return Err(format!("the stripes fit no plane: RMS {rms_px:.2} projector px"));
    }
    // Neighbouring pixels along one edge share their errors: count each stripe's edge lines, about one per stripe and 8 px.
    let independent = (edges.len() as f64 / 8.0).max(9.0);
    Ok(ProjectorFit { projector_from_slab, rms_px, sd_px: rms_px * (8.0 / independent).sqrt(), edges: edges.len() })
}

fn contrast(pair: &BitPair) -> Contrast {
    let sum: Vec<f32> = pair.pattern.iter().zip(&pair.inverse).map(|(a, b)| a + b).collect();
    let least = LIT_SHARE * percentile(&sum, 0.9);
    let value = pair.pattern.iter().zip(&pair.inverse).zip(&sum);
    let value = value.map(|((a, b), &s)| (s > least && s > 0.0).then(|| (a - b) / s)).collect();
    Contrast { axis: pair.axis, bit: pair.bit, value }
}

/// The projector coordinate of each pixel (of a subset) as the middle of the finest stripe that its bits tell.
fn decode_pixels(
    contrasts: &[Contrast],
    width: usize,
    height: usize,
    slab: &dyn Fn(Point) -> Option<Point>,
) -> Result<Vec<Observation>, String> {
    let step = (width * height / DECODED_PIXELS).max(1);
    let mut out = Vec::new();
    for axis in 0..2 {
        let mut bits: Vec<&Contrast> = contrasts.iter().filter(|c| c.axis == axis).collect();
        bits.sort_by_key(|c| std::cmp::Reverse(c.bit));
        let Some(finest) = bits.last().map(|c| c.bit) else {
            return Err(format!("no Gray-code shots for the projector's {} axis", ["x", "y"][axis]));
        };
        if bits.windows(2).any(|p| p[0].bit != p[1].bit + 1) {
            return Err("the Gray code's bits must follow each other without a gap".into());
        }
        for k in (0..width * height).step_by(step) {
            // A pixel on a stripe's edge may read either way: only clear ones count here.
            let mut code = Some(0u32);
            for c in &bits {
                let clear = c.value[k].filter(|v| v.abs() > 0.5);
                code = code.zip(clear).map(|(n, v)| (n << 1) | ((n & 1) ^ u32::from(v > 0.0)));
            }
            let Some(n) = code else { continue };
            let Some(from) = slab([(k % width) as f64, (k / width) as f64]) else { continue };
            let side = f64::from(1u32 << finest);
            out.push(Observation { from, axis, to: (f64::from(n) + 0.5) * side - 0.5 });
        }
    }
    Ok(out)
}

/// Edges of bit j lie between projector pixels m − 1 and m, m an odd multiple of 2^j; `None` when the nearest is not clear.
fn nearest_edge(coordinate: f64, bit: u32) -> Option<f64> {
    let side = f64::from(1u32 << bit);
    let m = 2.0 * (((coordinate + 0.5) / side - 1.0) / 2.0).round() + 1.0;
    let edge = m * side - 0.5;
    // Edges are 2·side apart; the first estimate is good to half a finest stripe.
    ((coordinate - edge).abs() < 0.5 * side).then_some(edge)
}

/// Camera positions of a bit's edges, along picture rows and columns.
///
/// Between plateaus p and q two pixels before and three after a change of sign, the edge lies where the area under the contrast
/// says: exact for a sharp edge seen through any symmetric blur narrower than that.
fn find_edges(contrast: &Contrast, width: usize, height: usize) -> Vec<(Point, usize)> {
    let mut edges = Vec::new();
    for along in 0..2 {
        let (lines, length, step, line_step) =
            if along == 0 { (height, width, 1, width) } else { (width, height, width, 1) };
        for line in 0..lines {
            let at = |k: usize| contrast.value[line * line_step + k * step];
            for k in 2..length.saturating_sub(3) {
                let (Some(a), Some(b)) = (at(k), at(k + 1)) else { continue };
                if (a > 0.0) == (b > 0.0) {
                    continue;
                }
                let (Some(p), Some(q)) = (at(k - 2), at(k + 3)) else { continue };
                let inner = (k - 1..=k + 2).map(at).sum::<Option<f32>>();
                let Some(sum) = inner else { continue };
                if (p - q).abs() < EDGE_CONTRAST || (p > 0.0) != (a > 0.0) || (q > 0.0) != (b > 0.0) {
                    continue;
                }
                let share = (sum - 4.0 * q) / (p - q);
                let place = k as f64 - 1.5 + f64::from(share);
                let point = if along == 0 { [place, line as f64] } else { [line as f64, place] };
                edges.push((point, along));
            }
        }
    }
    edges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_of_a_bit_are_where_its_gray_code_changes() {
        for bit in 0..4u32 {
            let code = |n: u32| ((n ^ (n >> 1)) >> bit) & 1;
            for m in 1..64u32 {
                let changes = code(m) != code(m - 1);
                let found = nearest_edge(f64::from(m) - 0.5, bit) == Some(f64::from(m) - 0.5);
                assert_eq!(changes, found, "bit {bit} at {m}");
            }
        }
    }
}
