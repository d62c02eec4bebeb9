//! Whether the camera has moved since registration: the sample's rim against the frame, which no projected pattern moves.
//!
//! A projector's black is not dark: in the longest exposures sample and frame are seen, differently bright, and where one ends and the
//! other begins stays put when only the pattern drifts. The rim is located in short segments, in the shot of the sample under black and in
//! every lattice shot; the difference is the camera's (or the sample's) movement in the picture.

use super::drift::median;
use super::small::solve;
use crate::capture::Rect;
use crate::geometry::{CameraView, Point};
use crate::radiance::Radiance;

/// Segments along each side of the sample.
const PER_SIDE: usize = 8;
/// Half the length of a segment along the rim, and half its width across, px.
const HALF_ALONG: f64 = 6.0;
const HALF_ACROSS: f64 = 5.0;
/// Softness of the rim that is tried besides the pixel's own width, scale of a logistic distribution, px.
const SOFTNESS_PX: [f64; 4] = [0.05, 0.15, 0.3, 0.5];
/// Further from the rim than so many softnesses light is that of one side to 1e-9: less than an f32 can say.
const SATURATED: f64 = 20.0;
/// A step counts when it is this many times its standard deviation.
const STEP_SIGMA: f64 = 10.0;
/// A rim that is found no further than this from where it was is not looked for elsewhere, px: the other starts are 1 px away.
const SAME_PX: f64 = 0.7;
/// Segments whose step has grown or shrunk by more than this are left out.
const GLOW: f64 = 1.5;
/// What glow on one side of a rim moves it by, px for each unit by which the rim's step has changed. On simulated marble up to twice as
/// much; it is alike in all segments of a side, so that their scatter does not show it.
const GLOW_PX: f64 = 0.25;
/// Segments that are needed for a movement.
const LEAST_SEGMENTS: usize = 8;
/// A movement of which the segments say no more than this is not known, px.
const LARGEST_SD_PX: f64 = 0.1;
/// Found offsets of segments never agree better than this, px.
const FLOOR_PX: f64 = 0.005;

/// A short piece of the sample's rim.
#[derive(Debug, Clone, Copy)]
pub struct RimSegment {
    /// The pixels around it.
    pub rect: Rect,
    /// Where its middle should be, camera px.
    pub at: Point,
    /// Unit vector across the rim, camera px.
    pub normal: Point,
}

/// Where a rim was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RimPlace {
    /// Distance along the normal from where it should be, px.
    pub offset_px: f64,
    /// Its standard deviation from the pixels' noise, px.
    pub sd_px: f64,
    /// How much brighter it is outside the sample.
    pub height: f64,
}

/// The movement of the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraMotion {
    /// How far what is fixed has moved, camera px.
    pub camera_px: Point,
    /// Standard deviation per axis, px.
    pub sd_px: f64,
}

impl CameraMotion {
    /// Whether there is one, beyond doubt and worth a correction.
    pub fn is_sure(&self) -> bool {
        self.camera_px[0].hypot(self.camera_px[1]) > (3.5 * self.sd_px).max(0.05)
    }
}

/// Segments of the rim of a sample of `size_mm`, those that are well within a picture of `size_px`.
pub fn rim_segments(view: &CameraView, size_mm: Point, size_px: [usize; 2]) -> Vec<RimSegment> {
    let [w, h] = size_mm;
    let sides = [([0.0, 0.0], [w, 0.0]), ([w, 0.0], [w, h]), ([w, h], [0.0, h]), ([0.0, h], [0.0, 0.0])];
    let between = |a: Point, b: Point, t: f64| [a[0] + t * (b[0] - a[0]), a[1] + t * (b[1] - a[1])];
    let segment = |a: Point, b: Point, k: usize| {
        let t = (k as f64 + 0.5) / PER_SIDE as f64;
        let at = view.camera_from_slab(between(a, b, t));
        let [p, q] = [t - 0.01, t + 0.01].map(|t| view.camera_from_slab(between(a, b, t)));
        let length = (q[0] - p[0]).hypot(q[1] - p[1]);
        let normal = [(q[1] - p[1]) / length, (p[0] - q[0]) / length];
        let reach = [0, 1].map(|a| HALF_ACROSS * normal[a].abs() + HALF_ALONG * normal[1 - a].abs());
        let low = [0, 1].map(|a| (at[a] - reach[a]).floor());
        let high = [0, 1].map(|a| (at[a] + reach[a]).ceil());
        let inside = (0..2).all(|a| low[a] >= 0.0 && high[a] <= size_px[a] as f64 - 1.0) && length > 0.0;
        inside
            .then(|| Rect {
                x: low[0] as usize,
                y: low[1] as usize,
                width: (high[0] - low[0]) as usize + 1,
                height: (high[1] - low[1]) as usize + 1,
            })
            .map(|rect| RimSegment { rect, at, normal })
    };
    sides.iter().flat_map(|&(a, b)| (0..PER_SIDE).filter_map(move |k| segment(a, b, k))).collect()
}

/// Finds the rim in the picture of a segment, searching around `start` (offset, px) or everywhere in it.
///
/// Light on either side may differ from segment to segment and change along and across the sample's side: near dots it glows.
pub fn locate_rim(picture: &Radiance, segment: &RimSegment, start: Option<f64>) -> Option<RimPlace> {
    let pixels = pixels(picture, segment)?;
    let best = |found: &mut dyn Iterator<Item = (RimPlace, f64)>| found.min_by(|a, b| a.1.total_cmp(&b.1));
    // From a place that is nearly right every softness settles in a step or two; from afar each must be tried from several starts.
    let softer = |from: f64| SOFTNESS_PX.map(|soft| settle(&pixels, from, soft));
    let everywhere = |starts: &[f64]| {
        let all = starts.iter().flat_map(|&s| SOFTNESS_PX.map(|soft| settle(&pixels, s, soft)));
        best(&mut all.flatten())
    };
    let (found, limit) = match start {
        Some(offset) => {
            let same = |place: &RimPlace| (place.offset_px - offset).abs() <= SAME_PX;
            let near = settle(&pixels, offset, SOFTNESS_PX[1]).filter(|(place, _)| same(place));
            let near = near
                .and_then(|(place, _)| best(&mut softer(place.offset_px).into_iter().flatten()))
                .filter(|(place, _)| same(place));
            (near.or_else(|| everywhere(&[-1.0, 0.0, 1.0].map(|d| offset + d)))?, HALF_ACROSS - 1.0)
        }
        None => (everywhere(&[-2.0, -1.0, 0.0, 1.0, 2.0])?, HALF_ACROSS - 2.0),
    };
    (found.0.offset_px.abs() <= limit).then_some(found.0)
}

/// A pixel: across and along the rim, light, variance.
struct Pixel {
    across: f64,
    along: f64,
    light: f64,
    variance: f64,
}

fn pixels(picture: &Radiance, segment: &RimSegment) -> Option<Vec<Pixel>> {
    let r = picture.rect;
    if picture.used.contains(&0) {
        return None;
    }
    let light = picture.luminance();
    let variance = picture.luminance_variance();
    let [nx, ny] = segment.normal;
    let all = (0..r.area()).map(|k| {
        let d = [(r.x + k % r.width) as f64 - segment.at[0], (r.y + k / r.width) as f64 - segment.at[1]];
        let (across, along) = (d[0] * nx + d[1] * ny, d[1] * nx - d[0] * ny);
        Pixel { across, along, light: f64::from(light[k]), variance: f64::from(variance[k]) }
    });
    Some(all.filter(|p| p.along.abs() <= HALF_ALONG && p.across.abs() <= HALF_ACROSS).collect())
}

/// Gauss and Newton on the offset; the rest is linear. Also the mean square that is left.
fn settle(pixels: &[Pixel], start: f64, softness_px: f64) -> Option<(RimPlace, f64)> {
    const TERMS: usize = 7;
    let across_pixel = (1.0 / softness_px).exp();
    let mut offset = start;
    for _ in 0..12 {
        let (mut matrix, mut right) = ([[0.0; TERMS]; TERMS], [0.0; TERMS]);
        let (mut square, mut noise) = (0.0, 0.0);
        for p in pixels {
            // A soft step averaged over a pixel, and its derivative; light on both sides, sloping on either.
            let far = p.across - offset;
            let (step, slope) = if far.abs() > 0.5 + SATURATED * softness_px {
                (f64::from(u8::from(far > 0.0)), 0.0)
            } else {
                // The difference of two `softened`: with exponents of 40 at most nothing overflows.
                let near = ((far - 0.5) / softness_px).exp();
                let (a, b) = (1.0 + across_pixel * near, 1.0 + near);
                (softness_px * (a / b).ln(), 1.0 / b - 1.0 / a)
            };
            let row = [step, slope, 1.0, step * far, (1.0 - step) * far, p.along, (1.0 - step) * far * far];
            for i in 0..TERMS {
                (0..=i).for_each(|j| matrix[i][j] += row[i] * row[j]);
                right[i] += row[i] * p.light;
            }
            square += p.light * p.light;
            noise += p.variance;
        }
        let (x, inverse) = solve(matrix, right)?;
        let [height, moved, ..] = x;
        let count = pixels.len() as f64;
        let left = (square - x.iter().zip(&right).map(|(a, b)| a * b).sum::<f64>()).max(0.0) / count;
        // Whichever is larger: the noise of the pixels, or what the model leaves.
        let variance = (noise / count).max(left);
        if !(height.abs() > STEP_SIGMA * (variance * inverse[0]).sqrt()) {
            return None;
        }
        let step = (-moved / height).clamp(-1.0, 1.0);
        offset += step;
        if offset.abs() > HALF_ACROSS {
            return None;
        }
        if step.abs() < 1e-4 {
            let sd_px = (variance * inverse[1]).sqrt() / height.abs();
            return Some((RimPlace { offset_px: offset, sd_px, height }, left));
        }
    }
    None
}

/// The integral of the logistic distribution function, and the function.
pub(super) fn softened(x: f64) -> (f64, f64) {
    let tail = (-x.abs()).exp();
    let above = tail.ln_1p();
    if x > 0.0 { (x + above, 1.0 / (1.0 + tail)) } else { (above, tail / (1.0 + tail)) }
}

/// The movement of the picture from where the segments' rims were `before` and are `now`; `None` when too few are seen, or too badly.
///
/// Not detected: a turn of the camera about its axis or a change of distance (their mean over the rim is a movement of about none).
pub fn camera_motion(
    segments: &[RimSegment],
    before: &[Option<RimPlace>],
    now: &[Option<RimPlace>],
) -> Option<CameraMotion> {
    // Normal, movement along it, its standard deviation, and what of that is glow.
    let seen: Vec<(Point, f64, f64, f64)> = segments
        .iter()
        .zip(before.iter().zip(now))
        .filter_map(|(s, (b, n))| {
            let (b, n) = ((*b)?, (*n)?);
            // Where a dot's glow outshines what was there before, the rim's profile is another.
            (n.height / b.height > 1.0 / GLOW && n.height / b.height < GLOW).then_some(())?;
            let glow = GLOW_PX * (n.height / b.height - 1.0).abs();
            Some((s.normal, n.offset_px - b.offset_px, b.sd_px.hypot(n.sd_px).max(FLOOR_PX).hypot(glow), glow))
        })
        .collect();
    let mut moved = [0.0; 2];
    let mut spread = f64::INFINITY;
    let mut inverse = [0.0; 2];
    let mut glow = [0.0; 2];
    for _ in 0..4 {
        let left = |m: Point, s: &(Point, f64, f64, f64)| s.1 - s.0[0] * m[0] - s.0[1] * m[1];
        let kept: Vec<_> = seen.iter().filter(|s| left(moved, s).abs() <= 4.0 * spread * s.2).collect();
        if kept.len() < LEAST_SEGMENTS {
            return None;
        }
        let (mut matrix, mut right) = ([[0.0; 2]; 2], [0.0; 2]);
        for (normal, offset, sd, _) in &kept {
            for i in 0..2 {
                (0..=i).for_each(|j| matrix[i][j] += normal[i] * normal[j] / (sd * sd));
                right[i] += normal[i] * offset / (sd * sd);
            }
        }
        (moved, inverse) = solve(matrix, right)?;
        // The mean glow of the segments that tell the movement along an axis: an error that they have in common.
        let told = |a: usize| kept.iter().map(move |(n, _, sd, glow)| ((n[a] / sd).powi(2), *glow));
        glow = [0, 1].map(|a| told(a).map(|(w, g)| w * g).sum::<f64>() / told(a).map(|(w, _)| w).sum::<f64>());
        let mut left: Vec<f64> = kept.iter().map(|s| (left(moved, s) / s.2).abs()).collect();
        // What segments disagree by beyond their noise widens all of them.
        spread = (1.4826 * median(&mut left)).max(1.0);
    }
    let scatter_px = spread * (0.5 * (inverse[0] + inverse[1])).sqrt();
    let sd_px = scatter_px.hypot(glow[0].max(glow[1]));
    (scatter_px <= LARGEST_SD_PX).then_some(CameraMotion { camera_px: moved, sd_px })
}
