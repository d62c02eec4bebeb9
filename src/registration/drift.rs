//! How far the projected pattern of one shot has moved since registration.

use super::Registration;
use crate::capture::Rect;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// The displacement of one shot's dots.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Drift {
    /// On the slab, mm.
    pub slab_mm: Point,
    /// In camera px at the slab's centre.
    pub camera_px: Point,
    /// Standard deviation per axis of `camera_px`.
    pub sd_px: f64,
    /// The part of it that all shots have in common, px: of dots on the sample, their depth.
    pub common_sd_px: f64,
    /// Number of dots that it was measured from.
    pub dots: usize,
    /// How far apart the dots are, of what they should be, with its standard deviation; `None` for fewer than four.
    pub scale: Option<[f64; 2]>,
    /// Of dots on the sample: from which depth they are taken to be seen.
    pub depth: Option<SeenDepth>,
}

/// From how deep dots on the sample are seen, and how obliquely.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SeenDepth {
    /// Depth over refractive index, mm.
    pub depth_mm: f64,
    /// Its standard deviation, mm.
    pub sd_mm: f64,
    /// Slope of the line of sight inside the sample, times the refractive index: by this times the depth dots are seen
    /// beside their places.
    #[serde(alias = "tangent")]
    pub slope: f64,
}

/// A dot counts when its light is this many standard deviations above none.
const DETECTION_SIGMA: f64 = 10.0;
/// Dots of one rigid pattern agree to a tenth of a pixel, and to half of one on a sample; beyond this, px, something
/// else was found.
const LARGEST_SPREAD_PX: f64 = 1.0;
/// Sharp dots smaller than a pixel or two have a centroid that depends on where they fall between pixels, by up to
/// this, px.
const CENTROID_FLOOR_PX: f64 = 0.02;

/// The displacement of a shot from the centroids of its dots, as the median over dots in each axis.
///
/// `dots` are (expected place on the slab, mm; its picture without ambient light). The median withstands a minority of
/// dots that edges of materials pull aside; with dots on the opaque frame there are none. `None` when fewer than two or
/// less than half of the dots are found, or when they disagree by more than a pixel.
///
/// Not detected: a rotation of the pattern, motion of the camera (it is taken for the projector's).
pub fn measure_drift(dots: &[(Point, Radiance)], registration: &Registration, dot_radius_px: f64) -> Option<Drift> {
    let mut moved: Vec<(Point, f64)> = Vec::new();
    let mut places: Vec<Point> = Vec::new();
    for (slab, picture) in dots {
        let Some((seen, variance)) = centroid(picture, dot_radius_px, None) else { continue };
        let Some(at) = registration.view.slab_from_camera(seen) else { continue };
        moved.push(([at[0] - slab[0], at[1] - slab[1]], variance));
        places.push(*slab);
    }
    if moved.len() < 2 || 2 * moved.len() < dots.len() {
        return None;
    }
    let jacobian = registration.view.jacobian(registration.center_mm);
    let px_per_mm = registration.px_per_mm();
    let [x, y] = [0, 1].map(|a| robust_mean(moved.iter().map(|m| m.0[a]).collect()));
    if x.1.max(y.1) * px_per_mm > LARGEST_SPREAD_PX {
        return None;
    }
    let slab_mm = [x.0, y.0];
    let camera_px = std::array::from_fn(|i| jacobian[i][0] * slab_mm[0] + jacobian[i][1] * slab_mm[1]);
    let n = moved.len() as f64;
    let photon = moved.iter().map(|m| m.1).sum::<f64>() / n;
    let sd_px = ((photon + CENTROID_FLOOR_PX.powi(2)) / n).sqrt();
    let scale = scale(&places, &moved.iter().map(|m| m.0).collect::<Vec<_>>());
    Some(Drift { slab_mm, camera_px, sd_px, common_sd_px: 0.0, dots: moved.len(), scale, depth: None })
}

/// How much farther apart things are than at `places` when they have `moved` from there, and its standard deviation.
fn scale(places: &[Point], moved: &[Point]) -> Option<[f64; 2]> {
    let n = places.len() as f64;
    if places.len() < 4 {
        return None;
    }
    let mean = |of: &[Point], a: usize| of.iter().map(|p| p[a]).sum::<f64>() / n;
    let (middle, shift) = ([0, 1].map(|a| mean(places, a)), [0, 1].map(|a| mean(moved, a)));
    let pairs = || places.iter().zip(moved).flat_map(|(p, m)| [0, 1].map(|a| (p[a] - middle[a], m[a] - shift[a])));
    let square: f64 = pairs().map(|(p, _)| p * p).sum();
    let growth = pairs().map(|(p, m)| p * m).sum::<f64>() / square;
    let left: f64 = pairs().map(|(p, m)| (m - growth * p).powi(2)).sum();
    (square > 0.0).then(|| [1.0 + growth, (left / (2.0 * n - 3.0) / square).sqrt()])
}

/// Mean of the values within three scaled median deviations of the median, and that deviation.
pub(super) fn robust_mean(mut values: Vec<f64>) -> (f64, f64) {
    let median = median(&mut values);
    let scale = scaled_deviation(values.iter().copied(), median);
    let kept: Vec<f64> =
        values.into_iter().filter(|v| (v - median).abs() <= 3.0 * scale.max(f64::MIN_POSITIVE)).collect();
    (kept.iter().sum::<f64>() / kept.len() as f64, scale)
}

/// The median deviation from `middle`, scaled to be the standard deviation of a normal distribution; 0 for no values.
pub(crate) fn scaled_deviation(values: impl Iterator<Item = f64>, middle: f64) -> f64 {
    1.4826 * median(&mut values.map(|v| (v - middle).abs()).collect::<Vec<_>>())
}

/// The middle of some values; 0 for none.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 {
        return 0.0;
    }
    (values[(n - 1) / 2] + values[n / 2]) / 2.0
}

/// The centroid of the brightest spot, camera px, and its variance per axis; the spot's brightest pixel lies in the
/// circle `within` (centre, radius) when there is one.
pub(super) fn centroid(picture: &Radiance, radius_px: f64, within: Option<(Point, f64)>) -> Option<(Point, f64)> {
    let Rect { x: x0, y: y0, width, height } = picture.rect;
    let light = picture.luminance();
    let variance = picture.luminance_variance();
    let invalid = picture.used.as_chunks::<3>().0.iter().any(|u| u.contains(&0));
    let near = |k: usize| {
        within.is_none_or(|(c, r)| ((x0 + k % width) as f64 - c[0]).hypot((y0 + k / width) as f64 - c[1]) <= r)
    };
    let brightest = (0..light.len()).filter(|&k| near(k)).max_by(|&a, &b| light[a].total_cmp(&light[b]))?;
    if invalid {
        return None;
    }
    let reach = (radius_px + 2.0).ceil() as isize;
    let mut middle = [(brightest % width) as isize, (brightest / width) as isize];
    let mut found = None;
    for _ in 0..3 {
        // A spot that the picture cuts off has a false centroid.
        let inside = |m: isize, n: usize| m - reach >= 0 && m + reach < n as isize;
        if !inside(middle[0], width) || !inside(middle[1], height) {
            return None;
        }
        let (mut sum, mut sum_x, mut sum_y, mut noise) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
        let mut spread = 0.0f64;
        for y in middle[1] - reach..=middle[1] + reach {
            for x in middle[0] - reach..=middle[0] + reach {
                let k = y as usize * width + x as usize;
                let v = f64::from(light[k]);
                sum += v;
                sum_x += v * (x - middle[0]) as f64;
                sum_y += v * (y - middle[1]) as f64;
                noise += f64::from(variance[k]);
                spread += f64::from(variance[k]) * ((x - middle[0]).pow(2) + (y - middle[1]).pow(2)) as f64 / 2.0;
            }
        }
        if !(sum > DETECTION_SIGMA * noise.sqrt()) {
            return None;
        }
        let place = [middle[0] as f64 + sum_x / sum, middle[1] as f64 + sum_y / sum];
        found = Some(([x0 as f64 + place[0], y0 as f64 + place[1]], spread / (sum * sum)));
        let next = [place[0].round() as isize, place[1].round() as isize];
        if next == middle {
            break;
        }
        middle = next;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{CAMERA, covered, picture, registration};

    #[test]
    fn medians_and_robust_means_are_those_counted_by_hand() {
        assert_eq!((median(&mut [3.0, -1.0, 7.0]), median(&mut [4.0, 1.0, 9.0, 2.0])), (3.0, 3.0));
        // Deviations from 3 are 2, 1, 0, 1 and 97, their median 1: 100 is dropped, the rest is 1, 2, 3, 4.
        assert_eq!(robust_mean(vec![4.0, 100.0, 1.0, 3.0, 2.0]), (2.5, 1.4826));
        // The scale 1.4826 keeps what lies within 4.4478 of the median 0, to both sides.
        let mean = |far: f64| robust_mean(vec![-1.0, 0.0, 1.0, far, -4.4, 0.0, 1.0]).0;
        assert!((mean(4.4) - 1.0 / 7.0).abs() < 1e-15 && (mean(4.5) + 3.4 / 6.0).abs() < 1e-15);
        // Values that are equal have no deviation; what is not equal to them is dropped.
        assert_eq!(robust_mean(vec![5.0, 5.0, 5.0, 9.0]), (5.0, 0.0));
    }

    const RECT: Rect = Rect { x: 13, y: 27, width: 23, height: 17 };

    /// A spot of 2 × 3 px with 6 units of light in all.
    fn spot(center: Point, variance: f64) -> Radiance {
        picture(RECT, |x, y| covered(x, y, center, [2.0, 3.0]), variance)
    }

    #[test]
    fn the_centroid_of_a_spot_is_its_middle_in_the_photograph() {
        for center in [[23.3, 34.6], [22.75, 35.1], [25.0, 34.0]] {
            let (at, variance) = centroid(&spot(center, 1e-4), 2.0, None).unwrap();
            // Values are f32: 1e-7 of some px.
            assert!((at[0] - center[0]).abs() < 1e-5 && (at[1] - center[1]).abs() < 1e-5, "{at:?} {center:?}");
            // 9 × 9 pixels: the sum of x² is 9 · 2 · (1 + 4 + 9 + 16) = 540, and that of y² too; light 6.
            assert!((variance / (1e-4 * 540.0 / 36.0) - 1.0).abs() < 1e-5, "{variance}");
        }
    }

    #[test]
    fn noise_far_from_the_middle_moves_a_centroid_more() {
        let mut spot = spot([23.0, 35.0], 0.0);
        let k = spot.at(20, 37);
        spot.variance[k..k + 3].copy_from_slice(&[0.01, 0.03, 0.05]);
        let (_, variance) = centroid(&spot, 2.0, None).unwrap();
        // Three to the left and two below: (9 + 4) / 2 times a ninth of 0.09, over the light's square.
        assert!((variance / (6.5 * 0.01 / 36.0) - 1.0).abs() < 1e-5, "{variance}");
    }

    #[test]
    fn a_spot_counts_from_ten_deviations_on_and_only_whole() {
        // 81 pixels of variance 1/225: their sum's deviation is 0.6, the spot's light 6.
        let seen = |variance| centroid(&spot([23.3, 34.6], variance), 2.0, None).is_some();
        assert_eq!((seen(0.999 / 225.0), seen(1.001 / 225.0)), (true, false));
        // Four pixels around the middle must be there: columns 13 to 35, lines 27 to 43.
        // (Of 2 × 2 px, so that one pixel is the brightest.)
        let small = |center| picture(RECT, |x, y| covered(x, y, center, [2.0, 2.0]), 1e-4);
        let whole = |center| centroid(&small(center), 2.0, None).is_some();
        assert!(whole([17.0, 31.0]) && whole([31.0, 39.0]) && whole([17.0, 39.0]));
        assert!(!whole([16.0, 31.0]) && !whole([17.0, 30.0]) && !whole([32.0, 39.0]) && !whole([31.0, 40.0]));
        // A radius of 1.01 px reaches as far as one of 2.
        assert!(centroid(&small([17.0, 31.0]), 1.0, None).is_some());
        assert!(centroid(&small([16.0, 31.0]), 1.0, None).is_some());
        assert!(centroid(&small([16.0, 31.0]), 1.01, None).is_none());
        let mut broken = spot([23.3, 34.6], 1e-4);
        broken.used[4] = 0;
        assert_eq!(centroid(&broken, 2.0, None), None);
    }

    #[test]
    fn of_two_spots_the_one_within_the_circle_is_taken() {
        let two =
            |x: f64, y: f64| covered(x, y, [18.5, 33.0], [2.0, 3.0]) + 3.0 * covered(x, y, [30.0, 37.5], [2.0, 3.0]);
        let picture = picture(RECT, two, 1e-6);
        let find = |within| centroid(&picture, 1.0, within).unwrap().0;
        let near = |p: Point, q: Point| (p[0] - q[0]).hypot(p[1] - q[1]) < 1e-4;
        assert!(near(find(None), [30.0, 37.5]));
        assert!(near(find(Some(([19.0, 33.0], 4.0))), [18.5, 33.0]));
        assert!(near(find(Some(([29.0, 37.0], 4.0))), [30.0, 37.5]));
        // Nothing lies in a circle beyond the picture, to its right or below it.
        assert_eq!(centroid(&picture, 1.0, Some(([300.0, 33.0], 4.0))), None);
        assert_eq!(centroid(&picture, 1.0, Some(([18.5, 330.0], 4.0))), None);
    }

    /// Dots at places of the slab, each seen moved by its own part, with light and variance.
    fn dots(moved_mm: impl Fn(usize) -> Point, variance: f64) -> Vec<(Point, Radiance)> {
        let places = [[3.0, 2.0], [11.0, 4.0], [20.0, 9.0], [7.0, 16.0], [25.0, 14.0]];
        let dot = |(k, p): (usize, Point)| {
            let moved = moved_mm(k);
            let center = CAMERA.map([p[0] + moved[0], p[1] + moved[1]]);
            let rect = Rect { x: center[0] as usize - 9, y: center[1] as usize - 8, width: 21, height: 17 };
            (p, picture(rect, |x, y| covered(x, y, center, [2.0, 3.0]), variance))
        };
        places.into_iter().enumerate().map(dot).collect()
    }

    #[test]
    fn the_drift_of_a_shot_is_that_of_most_of_its_dots() {
        // The second dot is pulled aside; the others move by (0.11, −0.07) mm and a little to both sides of it.
        let moved = |k: usize| match k {
            1 => [0.6, 0.5],
            _ => [0.11 + 0.004 * [1.0, 0.0, -1.0, 2.0, -2.0][k], -0.07 + 0.002 * [2.0, 0.0, 1.0, -2.0, -1.0][k]],
        };
        let drift = measure_drift(&dots(moved, 1e-9), &registration(), 2.0).unwrap();
        assert!((drift.slab_mm[0] - 0.11).abs() < 1e-5 && (drift.slab_mm[1] + 0.07).abs() < 1e-5, "{drift:?}");
        // 6 · 0.11 − 0.5 · 0.07 and −0.11 − 4 · 0.07; slopes by differences.
        assert!((drift.camera_px[0] - 0.625).abs() < 1e-4 && (drift.camera_px[1] + 0.39).abs() < 1e-4, "{drift:?}");
        assert_eq!(drift.dots, 5);
        // What pixels do to a centroid is all that is left of noise: 0.02 px over five dots.
        assert!((drift.sd_px - 0.02 / 5f64.sqrt()).abs() < 1e-4, "{drift:?}");
    }

    #[test]
    fn the_noise_of_pixels_makes_a_drift_less_sure() {
        let drift = measure_drift(&dots(|_| [0.1, 0.2], 1e-3), &registration(), 2.0).unwrap();
        // Every centroid has 540 · 1e-3 / 36 px².
        let expected = ((0.015 + 0.0004) / 5.0f64).sqrt();
        assert!((drift.sd_px / expected - 1.0).abs() < 1e-4, "{drift:?} {expected}");
    }

    #[test]
    fn dots_that_are_too_few_or_do_not_agree_tell_no_drift() {
        let all = dots(|_| [0.1, 0.2], 1e-6);
        let dark = |n: usize| {
            let mut some = all.clone();
            some.iter_mut().take(n).for_each(|(_, p)| p.value.fill(0.0));
            measure_drift(&some, &registration(), 2.0).map(|d| d.dots)
        };
        assert_eq!((dark(2), dark(3), measure_drift(&[], &registration(), 2.0)), (Some(3), None, None));
        // Half is enough, one dot never.
        assert_eq!(measure_drift(&all[..1], &registration(), 2.0), None);
        assert_eq!(measure_drift(&all[..2], &registration(), 2.0).map(|d| d.dots), Some(2));
        let mut half = [all.clone(), all[..1].to_vec()].concat();
        half[..3].iter_mut().for_each(|(_, p)| p.value.fill(0.0));
        assert_eq!(measure_drift(&half, &registration(), 2.0).map(|d| d.dots), Some(3));
        // Deviations of 0.1, 0.1, 0.05 and 0.05 mm have the median 0.075 and the scale 0.111 mm: times 4.95 px it is
        // 0.55 px.
        let spread = |scale: f64| {
            let along = |k: usize| scale * [0.1, -0.1, 0.05, -0.05, 0.075][k];
            let [x, y] = [dots(|k| [along(k), 0.0], 1e-9), dots(|k| [0.0, along(k)], 1e-9)];
            [x, y].map(|d| measure_drift(&d, &registration(), 2.0).is_some())
        };
        // The median deviation of the five from 0.05 is 0.05: 1 px at a scale of 1 / (4.95 · 1.4826 · 0.05) = 2.725.
        assert_eq!((spread(2.6), spread(2.85)), ([true, true], [false, false]));
    }
}
