//! How far the projected pattern of one shot has moved since registration.

use super::Registration;
use crate::capture::Rect;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// The displacement of one shot's dots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// On the slab, mm.
    pub slab_mm: Point,
    /// In camera px at the slab's centre.
    pub camera_px: Point,
    /// Standard deviation per axis of `camera_px`.
    pub sd_px: f64,
    /// Number of dots that it was measured from.
    pub dots: usize,
}

/// A dot counts when its light is this many standard deviations above none.
const DETECTION_SIGMA: f64 = 10.0;
/// Dots of one rigid pattern agree to a tenth of a pixel, and to half of one on a sample; beyond this, px, something else was found.
const LARGEST_SPREAD_PX: f64 = 1.0;
/// Sharp dots smaller than a pixel or two have a centroid that depends on where they fall between pixels, by up to this, px.
const CENTROID_FLOOR_PX: f64 = 0.02;

/// The displacement of a shot from the centroids of its dots, as the median over dots in each axis.
///
/// `dots` are (expected place on the slab, mm; its picture without ambient light). The median withstands a minority of dots
/// that edges of materials pull aside; with dots on the opaque frame there are none. `None` when fewer than two or less than half
/// of the dots are found, or when they disagree by more than a pixel.
///
/// Not detected: a rotation or scaling of the pattern, motion of the camera (it is taken for the projector's).
pub fn measure_drift(dots: &[(Point, Radiance)], registration: &Registration, dot_radius_px: f64) -> Option<Drift> {
    let mut moved: Vec<(Point, f64)> = Vec::new();
    for (slab, picture) in dots {
        let Some((seen, variance)) = centroid(picture, dot_radius_px, None) else { continue };
        let Some(at) = registration.view.slab_from_camera(seen) else { continue };
        moved.push(([at[0] - slab[0], at[1] - slab[1]], variance));
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
    Some(Drift { slab_mm, camera_px, sd_px, dots: moved.len() })
}

/// Mean of the values within three scaled median deviations of the median, and that deviation.
pub(super) fn robust_mean(mut values: Vec<f64>) -> (f64, f64) {
    let median = median(&mut values);
    let mut deviations: Vec<f64> = values.iter().map(|v| (v - median).abs()).collect();
    // 1.4826 makes the median deviation of a normal distribution its standard deviation.
    let scale = 1.4826 * self::median(&mut deviations);
    let kept: Vec<f64> =
        values.into_iter().filter(|v| (v - median).abs() <= 3.0 * scale.max(f64::MIN_POSITIVE)).collect();
    (kept.iter().sum::<f64>() / kept.len() as f64, scale)
}

pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    (values[(n - 1) / 2] + values[n / 2]) / 2.0
}

/// The centroid of the brightest spot, camera px, and its variance per axis; the spot's brightest pixel lies in the circle
/// `within` (centre, radius) when there is one.
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
