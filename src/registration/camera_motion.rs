//! Whether the camera has moved since registration: the sample's rim against the frame, which no projected pattern
//! moves.
//!
//! A projector's black is not dark: in the longest exposures sample and frame are seen, differently bright, and where
//! one ends and the other begins stays put when only the pattern drifts. The rim is located in short segments, in the
//! shot of the sample under black and in every lattice shot; the difference is the camera's (or the sample's) movement
//! in the picture.

use super::drift::median;
use crate::capture::Rect;
use crate::cholesky::solve_small;
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
/// A rim that is found no further than this from where it was is not looked for elsewhere, px: the other starts are 1
/// px away.
const SAME_PX: f64 = 0.7;
/// Segments whose step has grown or shrunk by more than this are left out.
const GLOW: f64 = 1.5;
/// What glow on one side of a rim moves it by, px for each unit by which the rim's step has changed. On simulated
/// marble up to twice as much; it is alike in all segments of a side, so that their scatter does not show it.
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
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
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
/// Light on either side may differ from segment to segment and change along and across the sample's side: near dots it
/// glows.
pub fn locate_rim(picture: &Radiance, segment: &RimSegment, start: Option<f64>) -> Option<RimPlace> {
    let pixels = pixels(picture, segment)?;
    let best = |found: &mut dyn Iterator<Item = (RimPlace, f64)>| found.min_by(|a, b| a.1.total_cmp(&b.1));
    // From a place that is nearly right every softness settles in a step or two; from afar each must be tried from
    // several starts.
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
        let (x, inverse) = solve_small(matrix, right)?;
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

/// The movement of the picture from where the segments' rims were `before` and are `now`; `None` when too few are seen,
/// or too badly.
///
/// Not detected: a turn of the camera about its axis or a change of distance (their mean over the rim is a movement of
/// about none).
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
        (moved, inverse) = solve_small(matrix, right)?;
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

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{jitter, picture};
    use crate::geometry::{Homography, Lens};

    fn straight(offset: Point) -> CameraView {
        let matrix = [[6.0, 0.0, offset[0]], [0.0, 4.0, offset[1]], [0.0, 0.0, 1.0]];
        CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([100.0, 80.0], 300.0) }
    }

    #[test]
    fn segments_lie_along_the_rim_and_look_outwards() {
        let segments = rim_segments(&straight([20.0, 15.0]), [30.0, 20.0], [230, 111]);
        assert_eq!(segments.len(), 32);
        // Along the upper side, the right, the lower and the left one: a sixteenth of it from its beginning.
        let expected = [
            ([31.25, 15.0], [0.0, -1.0]),
            ([200.0, 20.0], [1.0, 0.0]),
            ([188.75, 95.0], [0.0, 1.0]),
            ([20.0, 90.0], [-1.0, 0.0]),
        ];
        for (segment, (at, normal)) in segments.iter().step_by(8).zip(expected) {
            let close = |a: Point, b: Point| (a[0] - b[0]).hypot(a[1] - b[1]) < 1e-9;
            assert!(close(segment.at, at) && close(segment.normal, normal), "{segment:?}");
        }
        // Six pixels along the rim and five across it.
        assert_eq!(segments[0].rect, Rect { x: 25, y: 10, width: 14, height: 11 });
        assert_eq!(segments[8].rect, Rect { x: 195, y: 14, width: 11, height: 13 });
    }

    #[test]
    fn segments_beyond_the_picture_are_left_out() {
        let sides = |offset, size| {
            let segments = rim_segments(&straight(offset), [30.0, 20.0], size);
            let along = |n: Point| segments.iter().filter(|s| s.normal[0] * n[0] + s.normal[1] * n[1] > 0.9).count();
            [[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]].map(along)
        };
        // The sides are at x = 20 and 200 (five px across and the border's own half), y = 15 and 95.
        assert_eq!(sides([20.0, 15.0], [206, 101]), [8; 4]);
        assert_eq!(sides([20.0, 15.0], [205, 101])[1], 0);
        assert_eq!(sides([20.0, 15.0], [206, 100])[2], 0);
        assert_eq!(sides([5.0, 5.0], [300, 300]), [8; 4]);
        assert_eq!(sides([4.9, 5.0], [300, 300])[3], 0);
        assert_eq!(sides([5.0, 4.9], [300, 300])[0], 0);
    }

    /// A rim across `normal` through `at`, `offset` further out: a logistic step over the mean of a pixel, on light
    /// that slopes.
    fn rim(segment: &RimSegment, offset: f64, inside: f64, outside: f64, variance: f64) -> Radiance {
        soft_rim(segment, offset, [inside, outside], variance, 0.3)
    }

    fn soft_rim(segment: &RimSegment, offset: f64, [inside, outside]: [f64; 2], variance: f64, soft: f64) -> Radiance {
        let light = |x: f64, y: f64| {
            let d = [x - segment.at[0], y - segment.at[1]];
            let across = d[0] * segment.normal[0] + d[1] * segment.normal[1];
            let along = d[1] * segment.normal[0] - d[0] * segment.normal[1];
            let place = |k: usize| (k as f64 + 0.5) / 200.0 - 0.5;
            let step = |u: f64| 1.0 / (1.0 + (-(u - offset) / soft).exp());
            let lit = (0..200).map(|k| step(across + place(k))).sum::<f64>() / 200.0;
            inside + (outside - inside) * lit + 0.4 * along
        };
        picture(segment.rect, light, variance)
    }

    fn segments() -> [RimSegment; 2] {
        // No side is along a line or a column of pixels.
        let matrix = [[5.6, -1.4, 50.3], [2.0, 3.8, 15.1], [0.0, 0.0, 1.0]];
        let view = CameraView { ideal_from_slab: Homography { matrix }, ..straight([0.0; 2]) };
        let all = rim_segments(&view, [30.0, 20.0], [250, 180]);
        assert_eq!(all.len(), 32);
        [all[2], all[9]]
    }

    #[test]
    fn a_rim_is_found_where_it_is_brighter_or_darker_than_the_frame() {
        for segment in segments() {
            for (inside, outside) in [(20.0, 60.0), (75.0, 15.0)] {
                for offset in [0.37, -1.62, 0.0] {
                    let picture = rim(&segment, offset, inside, outside, 0.01);
                    for start in [None, Some(offset + 0.3), Some(offset - 1.1)] {
                        let found = locate_rim(&picture, &segment, start);
                        let found = found.unwrap_or_else(|| panic!("{inside} {offset} {start:?}"));
                        // The softness is one of those that are tried: what is left are means of 200 places.
                        assert!((found.offset_px - offset).abs() < 2e-3, "{found:?} {offset} {start:?}");
                        assert!((found.height / (outside - inside) - 1.0).abs() < 0.01, "{found:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_rim_strays_by_its_standard_deviation_from_one_noise_to_the_next() {
        let segment = segments()[1];
        let clean = soft_rim(&segment, 0.37, [20.0, 60.0], 0.0, 0.05);
        // Noise that is even in ±1 has a variance of 1/3.
        let found = |draw: usize| {
            let mut noisy = clean.clone();
            noisy.variance.fill(1.0);
            noisy.value.iter_mut().enumerate().for_each(|(k, v)| *v += jitter(1000 * draw + k / 3) as f32);
            locate_rim(&noisy, &segment, Some(0.4)).unwrap()
        };
        let all: Vec<RimPlace> = (0..150).map(found).collect();
        let mean = all.iter().map(|p| p.offset_px).sum::<f64>() / 150.0;
        let strays = (all.iter().map(|p| (p.offset_px - mean).powi(2)).sum::<f64>() / 149.0).sqrt();
        let told = all.iter().map(|p| p.sd_px).sum::<f64>() / 150.0;
        // 150 draws tell a deviation to 6 %, and softness is chosen by the noise too.
        assert!((strays / told - 1.0).abs() < 0.25, "{strays} {told}");
        assert!((mean - 0.37).abs() < 4.0 * told / 150f64.sqrt(), "{mean}");
    }

    #[test]
    fn what_has_no_rim_or_was_not_measured_tells_nothing() {
        let segment = segments()[1];
        assert_eq!(locate_rim(&picture(segment.rect, |x, y| 30.0 + 0.2 * x - 0.1 * y, 0.01), &segment, None), None);
        // A step of a tenth of the noise of a pixel.
        assert_eq!(locate_rim(&rim(&segment, 0.2, 30.0, 30.1, 1.0), &segment, None), None);
        let mut broken = rim(&segment, 0.2, 20.0, 60.0, 0.01);
        broken.used[7] = 0;
        assert_eq!(locate_rim(&broken, &segment, None), None);
        // Further than three pixels away nothing is believed that was not looked for there.
        let far = rim(&segment, 3.4, 20.0, 60.0, 0.01);
        assert_eq!(locate_rim(&far, &segment, None), None);
        assert!((locate_rim(&far, &segment, Some(3.2)).unwrap().offset_px - 3.4).abs() < 0.01);
    }

    #[test]
    fn the_integral_of_the_logistic_function_is_a_logarithm() {
        for x in [-3.0f64, -0.2, 0.0, 0.7, 5.0] {
            let (integral, value) = softened(x);
            assert!(
                (integral - (1.0 + x.exp()).ln()).abs() < 1e-14 && (value - 1.0 / (1.0 + (-x).exp())).abs() < 1e-15
            );
        }
        assert_eq!((softened(1e4), softened(-1e4)), ((1e4, 1.0), (0.0, 0.0)));
    }

    fn place(offset_px: f64, sd_px: f64, height: f64) -> Option<RimPlace> {
        Some(RimPlace { offset_px, sd_px, height })
    }

    /// Normals up and right, sixteen in all, as the sides' of a sample that is turned by 20 degrees.
    fn sixteen() -> Vec<RimSegment> {
        let (sin, cos) = 20f64.to_radians().sin_cos();
        let normals = [[sin, -cos], [cos, sin]];
        let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
        (0..16).map(|k| RimSegment { rect, at: [0.0; 2], normal: normals[k % 2] }).collect()
    }

    const MOVED: Point = [0.31, -0.22];

    /// All rims before and after a movement: every one has its own place, noise and step.
    fn both(sd: f64, grown: f64) -> (Vec<Option<RimPlace>>, Vec<Option<RimPlace>>) {
        let before: Vec<_> = (0..16).map(|k| place(jitter(k), 0.6 * sd, 40.0 + k as f64)).collect();
        let after = sixteen().into_iter().zip(&before).map(|(s, b)| {
            let along = s.normal[0] * MOVED[0] + s.normal[1] * MOVED[1];
            b.and_then(|b| place(b.offset_px + along, 0.8 * sd, grown * b.height))
        });
        (before.clone(), after.collect())
    }

    #[test]
    fn a_movement_is_what_explains_the_rims_of_all_sides() {
        let (before, after) = both(0.08, 1.0);
        let found = camera_motion(&sixteen(), &before, &after).unwrap();
        assert!((found.camera_px[0] - 0.31).abs() < 1e-12 && (found.camera_px[1] + 0.22).abs() < 1e-12, "{found:?}");
        // Each rim is known to hypot(0.6, 0.8) · 0.08 px twice over, eight of them for each of two axes at right
        // angles.
        assert!((found.sd_px - 0.08 / 8f64.sqrt()).abs() < 1e-9, "{found:?}");
        // Rims without noise still do not agree better than 0.005 px.
        let (before, after) = both(0.0, 1.0);
        let found = camera_motion(&sixteen(), &before, &after).unwrap();
        assert!((found.sd_px - 0.005 / 8f64.sqrt()).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn glow_that_changes_a_step_makes_a_movement_less_sure() {
        // A step that grows or shrinks by a fifth may be 0.05 px of glow, alike in all.
        for grown in [1.2, 0.8] {
            let (before, after) = both(0.0, grown);
            let found = camera_motion(&sixteen(), &before, &after).unwrap();
            let each = 0.005f64.hypot(0.05);
            assert!((found.sd_px - (each / 8f64.sqrt()).hypot(0.05)).abs() < 1e-9, "{found:?}");
        }
        // By half of it and more it is another profile.
        for (grown, counts) in [(1.49, true), (1.51, false), (1.0 / 1.49, true), (1.0 / 1.51, false)] {
            let (before, after) = both(0.01, grown);
            assert_eq!(camera_motion(&sixteen(), &before, &after).is_some(), counts, "{grown}");
        }
    }

    #[test]
    fn a_mistaken_rim_is_left_out_and_too_few_tell_nothing() {
        let (before, mut after) = both(0.02, 1.0);
        after[5] = place(before[5].unwrap().offset_px + 2.0, 0.016, 45.0);
        let found = camera_motion(&sixteen(), &before, &after).unwrap();
        assert!((found.camera_px[0] - 0.31).abs() < 1e-9 && (found.camera_px[1] + 0.22).abs() < 1e-9, "{found:?}");
        // Fifteen are left, eight of them on one side.
        assert!((found.sd_px - 0.02 * (0.5f64 * (1.0 / 8.0 + 1.0 / 7.0)).sqrt()).abs() < 1e-4, "{found:?}");
        let (mut before, after) = both(0.02, 1.0);
        before[..8].fill(None);
        assert!(camera_motion(&sixteen(), &before, &after).is_some());
        before[8] = None;
        assert_eq!(camera_motion(&sixteen(), &before, &after), None);
        // 0.1 px of all together is the most: 0.1 √8 px each.
        for (sd, counts) in [(0.28, true), (0.29, false)] {
            let (before, after) = both(sd, 1.0);
            assert_eq!(camera_motion(&sixteen(), &before, &after).is_some(), counts);
        }
    }

    #[test]
    fn rims_that_disagree_beyond_their_noise_widen_the_movement_s_deviation() {
        let (before, mut after) = both(0.01, 1.0);
        for (k, place) in after.iter_mut().enumerate() {
            // Pairs of opposite errors leave the movement as it is.
            let off = 0.04 * [1.0, 1.0, -1.0, -1.0][k % 4];
            *place = place.map(|p| RimPlace { offset_px: p.offset_px + off, ..p });
        }
        let found = camera_motion(&sixteen(), &before, &after).unwrap();
        assert!((found.camera_px[0] - 0.31).abs() < 1e-9, "{found:?}");
        // All are off by four deviations.
        assert!((found.sd_px - 4.0 * 1.4826 * 0.01 / 8f64.sqrt()).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn a_movement_is_sure_beyond_three_and_a_half_deviations_and_a_twentieth_of_a_pixel() {
        let sure = |camera_px, sd_px| CameraMotion { camera_px, sd_px }.is_sure();
        assert!(sure([0.0, -0.36], 0.1) && !sure([0.0, 0.34], 0.1) && sure([0.3, 0.2], 0.1));
        assert!(sure([0.051, 0.0], 0.001) && !sure([0.03, -0.03], 0.001) && sure([0.03, -0.041], 0.001));
    }

    #[test]
    fn glow_counts_along_an_axis_by_how_much_its_rims_tell() {
        let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
        let segments: Vec<RimSegment> = (0..16)
            .map(|k| RimSegment { rect, at: [0.0; 2], normal: if k < 8 { [1.0, 0.0] } else { [0.0, 1.0] } })
            .collect();
        let before = vec![place(0.1, 0.0, 40.0); 16];
        let now: Vec<_> = (0..16)
            .map(|k| match k {
                // Sure, but for a glow of 0.05 px: 0.005² + 0.05² = 0.002525 px².
                0..4 => place(0.4, 0.0, 48.0),
                _ => place(if k < 8 { 0.4 } else { -0.1 }, 0.08, 40.0),
            })
            .collect();
        let found = camera_motion(&segments, &before, &now).unwrap();
        assert!((found.camera_px[0] - 0.3).abs() < 1e-12 && (found.camera_px[1] + 0.2).abs() < 1e-12, "{found:?}");
        let (sure, other) = (4.0 / 0.002_525, 4.0 / 0.0064);
        let glow = 0.05 * sure / (sure + other);
        let scatter: f64 = (0.5 * (1.0 / (sure + other) + 0.0064 / 8.0_f64)).sqrt();
        assert!((found.sd_px - scatter.hypot(glow)).abs() < 1e-12, "{found:?}");
    }
}
