//! Drift from the lattice's own dots, where there are none on the frame.
//!
//! Three things move a dot on a translucent sample besides the projector. The glow around it is brighter on one side
//! near an edge between materials: only the sharp core is used ([`DotShape`]). What is seen comes from some depth, so
//! that an oblique camera sees it beside its place: one effective depth for the capture, learnt from how dots of one
//! shot are pulled apart ([`Parallax`]). What is left differs from dot to dot: the median and the spread over a shot's
//! dots.

use super::drift::{centroid, median, robust_mean};
use super::{DotShape, Drift, Registration, SeenDepth};
use crate::geometry::{Point, sight_slope};
use crate::radiance::Radiance;

/// What a dot on the sample is off by when nothing tells, in sides of the dot: the centroids of dots near an edge of two
/// materials stray so far.
const UNKNOWN_DOT_SD: f64 = 0.044;
/// Sharp dots are found this well at best, in sides.
const DOT_FLOOR: f64 = 0.0044;
/// Cores on a real material are not the model's footprint: what all dots of a capture are off by alike, in sides
/// (simulated materials, dots of 2 to 15 px: up to that).
const COMMON_DOT: f64 = 0.0133;
/// A depth of this many standard deviations is believed where the medium says nothing.
const BELIEVED_SIGMA: f64 = 4.0;
/// Depth over refractive index of a dot's core, in radii of the half of its light, and its scatter from medium to
/// medium: 0.10 to 0.63 in 26 captures of 12 media, cells of 0.2 and 0.5 mm, by diffusion and by Monte Carlo
/// (docs/accuracy.md, "Geometry").
pub(crate) const DEPTH_OF_HALF_LIGHT: f64 = 0.3;
pub(crate) const DEPTH_OF_HALF_LIGHT_SD: f64 = 0.2;

/// How dots on the sample are looked for.
#[derive(Debug, Clone)]
pub struct SampleDots {
    /// The footprint of a dot.
    pub shape: DotShape,
    /// The radius of the brightest spot, px.
    pub dot_radius_px: f64,
}

/// A dot that was found on the sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Located {
    /// Where the pattern puts it, mm.
    pub expected_mm: Point,
    /// How far from there it is seen, mm.
    pub moved_mm: Point,
    /// Variance per axis from the pixels' noise, px².
    pub variance_px2: f64,
}

/// The depth from which dots are seen, and how well one dot tells the drift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parallax {
    /// Where the camera is, slab mm.
    pub eye_mm: [f64; 3],
    /// Side of a dot, px.
    pub dot_side_px: f64,
    /// Effective depth over refractive index, mm: a dot is seen by this times the slope of the line of sight nearer to the
    /// camera's foot.
    pub depth_mm: f64,
    /// Its standard deviation, mm.
    pub depth_sd_mm: f64,
    /// Standard deviation per axis of a single dot, px.
    pub dot_sd_px: f64,
}

impl SampleDots {
    /// Finds a dot in its picture without ambient light, near the place where the pattern puts it (mm).
    ///
    /// Dots are searched within `search_px`: not further than half the way to the next one. `None` for one that is too
    /// dark, cut off by the search or not of the dot's shape.
    pub fn locate(
        &self,
        expected_mm: Point,
        picture: &Radiance,
        registration: &Registration,
        search_px: f64,
    ) -> Option<Located> {
        let expected_px = registration.view.camera_from_slab(expected_mm);
        let (start, _) = centroid(picture, self.dot_radius_px, Some((expected_px, search_px)))?;
        let found = self.shape.find(picture, start)?;
        let seen_mm = registration.view.slab_from_camera(found.at)?;
        let moved_mm = [seen_mm[0] - expected_mm[0], seen_mm[1] - expected_mm[1]];
        Some(Located { expected_mm, moved_mm, variance_px2: found.variance })
    }
}

/// What the medium itself says of the depth from which its dots are seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthOfMedium {
    /// Depth over refractive index, mm.
    pub depth_mm: f64,
    /// Its standard deviation, mm.
    pub sd_mm: f64,
}

impl DepthOfMedium {
    /// From the radius around a dot within which half of its light leaves, mm: light that comes from deeper has spread
    /// wider.
    pub fn of_half_light(half_light_mm: f64) -> Self {
        Self { depth_mm: DEPTH_OF_HALF_LIGHT * half_light_mm, sd_mm: DEPTH_OF_HALF_LIGHT_SD * half_light_mm }
    }
}

impl Parallax {
    /// Nothing known but where the camera is.
    pub fn unknown(eye_mm: [f64; 3], dot_side_px: f64) -> Self {
        Self { eye_mm, dot_side_px, depth_mm: 0.0, depth_sd_mm: 0.0, dot_sd_px: UNKNOWN_DOT_SD * dot_side_px }
    }

    /// Slope of the line of sight at `p`: towards the camera's foot, per depth over refractive index.
    fn slope(&self, p: Point) -> Point {
        sight_slope(self.eye_mm, p)
    }

    /// Learns the depth from the dots of several shots, each with a drift of its own: what pulls a shot's dots towards
    /// the camera's foot is depth. `px_per_mm` is the camera's scale. A camera that looks at all dots from one
    /// direction does not tell it: what `medium` says counts by its standard deviation beside what the dots do. Without
    /// either the depth is unknown, and taken for none.
    ///
    /// Not detected: a pattern that has grown or shrunk since registration; it looks like depth.
    pub fn learn(
        shots: &[Vec<Located>],
        eye_mm: [f64; 3],
        px_per_mm: f64,
        dot_side_px: f64,
        medium: Option<DepthOfMedium>,
    ) -> Self {
        let unknown = Self::unknown(eye_mm, dot_side_px);
        let depth = |d: DepthOfMedium| Self { depth_mm: d.depth_mm, depth_sd_mm: d.sd_mm, ..unknown };
        let nothing = medium.map_or(unknown, depth);
        // Differences from the shot's mean are free of its drift: (slope, displacement, weight that the mean takes away).
        let mut pairs: Vec<(f64, f64)> = Vec::new();
        let mut lost = 0;
        for dots in shots.iter().filter(|s| s.len() >= 2) {
            for a in 0..2 {
                let mean = |f: &dyn Fn(&Located) -> f64| dots.iter().map(f).sum::<f64>() / dots.len() as f64;
                let (slope, moved) = (|d: &Located| nothing.slope(d.expected_mm)[a], |d: &Located| d.moved_mm[a]);
                let (t0, m0) = (mean(&slope), mean(&moved));
                pairs.extend(dots.iter().map(|d| (slope(d) - t0, moved(d) - m0)));
                lost += 1;
            }
        }
        let (mut depth_mm, mut sd, mut spread) = (0.0, f64::INFINITY, f64::INFINITY);
        for _ in 0..3 {
            let kept = || pairs.iter().filter(|(t, m)| (m - depth_mm * t).abs() <= 3.0 * spread);
            let square: f64 = kept().map(|(t, _)| t * t).sum();
            if !(square > 0.0) || pairs.len() < lost + 2 {
                return nothing;
            }
            let slope = kept().map(|(t, m)| t * m).sum::<f64>() / square;
            let mut left: Vec<f64> = pairs.iter().map(|(t, m)| (m - slope * t).abs()).collect();
            // Each shot's mean has taken one of its freedoms.
            let freedom = (pairs.len() as f64 / (pairs.len() - lost - 1) as f64).sqrt();
            spread = (1.4826 * median(&mut left) * freedom).max(1e-9);
            (depth_mm, sd) = (slope, spread / square.sqrt());
        }
        let (depth_mm, depth_sd_mm) = match medium {
            Some(medium) => {
                let (seen, told) = (sd.max(1e-12).powi(-2), medium.sd_mm.max(1e-12).powi(-2));
                let depth_mm = (seen * depth_mm + told * medium.depth_mm) / (seen + told);
                (depth_mm.max(0.0), (seen + told).powf(-0.5))
            }
            None if depth_mm > BELIEVED_SIGMA * sd => (depth_mm, sd),
            None => (0.0, sd.hypot(depth_mm)),
        };
        if medium.is_some() || depth_mm == 0.0 {
            let mut left: Vec<f64> = pairs.iter().map(|(t, m)| (m - depth_mm * t).abs()).collect();
            let freedom = (pairs.len() as f64 / (pairs.len() - lost) as f64).sqrt();
            spread = 1.4826 * median(&mut left) * freedom;
        }
        Self { depth_mm, depth_sd_mm, dot_sd_px: (spread * px_per_mm).max(DOT_FLOOR * dot_side_px), ..unknown }
    }

    /// The displacement of a shot from the dots that were found; `None` for none.
    pub fn drift(&self, dots: &[Located], registration: &Registration) -> Option<Drift> {
        if dots.is_empty() {
            return None;
        }
        let moved = |a: usize| dots.iter().map(move |d| d.moved_mm[a] - self.depth_mm * self.slope(d.expected_mm)[a]);
        let slab_mm = [0, 1].map(|a| robust_mean(moved(a).collect()).0);
        let jacobian = registration.view.jacobian(registration.center_mm);
        let px_per_mm = registration.px_per_mm();
        let camera_px = std::array::from_fn(|i| jacobian[i][0] * slab_mm[0] + jacobian[i][1] * slab_mm[1]);
        let n = dots.len() as f64;
        let slope = [0, 1].map(|a| dots.iter().map(|d| self.slope(d.expected_mm)[a]).sum::<f64>() / n);
        let slope = slope[0].hypot(slope[1]);
        let depth_px = self.depth_sd_mm * slope * px_per_mm;
        let depth = SeenDepth { depth_mm: self.depth_mm, sd_mm: self.depth_sd_mm, slope };
        let noise = dots.iter().map(|d| d.variance_px2).sum::<f64>() / n;
        // The spread between dots has the pixels' noise in it already; in dim captures that noise is more.
        let common_sd_px = depth_px.hypot(COMMON_DOT * self.dot_side_px);
        let sd_px = (self.dot_sd_px.powi(2).max(noise) / n).sqrt().hypot(common_sd_px);
        Some(Drift { slab_mm, camera_px, sd_px, common_sd_px, dots: dots.len(), scale: None, depth: Some(depth) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{jitter, registration};

    /// Of dots.
    const SIDE_PX: f64 = 2.5;

    const EYE: [f64; 3] = [40.0, -30.0, -200.0];

    fn located(expected_mm: Point, moved_mm: Point, variance_px2: f64) -> Located {
        Located { expected_mm, moved_mm, variance_px2 }
    }

    /// (40 − x, −30 − y) / 200, refracted into an index of 1.4 by Snell's law, times that index.
    fn slope(p: Point) -> Point {
        let tangent = [(40.0 - p[0]) / 200.0, (-30.0 - p[1]) / 200.0];
        let outside = tangent[0].hypot(tangent[1]);
        let inside = (outside.atan().sin() / 1.4).asin();
        tangent.map(|t| 1.4 * inside.tan() * t / outside)
    }

    /// Shots of dots that are seen by `depth` times the slope nearer to the camera's foot, after a drift of each
    /// shot's own.
    fn shots(depth: f64, noise_mm: f64) -> Vec<Vec<Located>> {
        let dot = |shot: usize, k: usize| {
            let p = [2.0 + 11.0 * (k % 4) as f64, 3.0 + 9.0 * (k / 4) as f64];
            let slope = slope(p);
            let drift = [0.3 - 0.1 * shot as f64, -0.2 + 0.07 * shot as f64];
            let off = |a: usize| noise_mm * jitter(1000 * shot + 10 * k + a);
            located(p, [0, 1].map(|a| drift[a] + depth * slope[a] + off(a)), 1e-6)
        };
        (0..6).map(|shot| (0..12).map(|k| dot(shot, k)).collect()).collect()
    }

    #[test]
    fn the_line_of_sight_leans_towards_the_camera_s_foot() {
        let found = Parallax::unknown(EYE, SIDE_PX).slope([10.0, 20.0]);
        let expected = slope([10.0, 20.0]);
        assert!((0..2).all(|a| (found[a] - expected[a]).abs() < 1e-14), "{found:?} {expected:?}");
    }

    #[test]
    fn depth_is_learnt_from_how_dots_of_a_shot_are_pulled_apart() {
        let found = Parallax::learn(&shots(1.5, 0.0), EYE, 7.0, SIDE_PX, None);
        assert!((found.depth_mm - 1.5).abs() < 1e-9, "{found:?}");
        assert_eq!((found.eye_mm, found.dot_sd_px), (EYE, DOT_FLOOR * SIDE_PX));
        // Noise that is even in ±0.02 mm has a median deviation of 0.01 mm: 0.0148 mm, or 0.104 px at 7 px a
        // millimetre.
        let found = Parallax::learn(&shots(1.5, 0.02), EYE, 7.0, SIDE_PX, None);
        assert!((found.dot_sd_px / 0.104 - 1.0).abs() < 0.2, "144 differences: a tenth of it; {found:?}");
        // Least squares: the noise over the root of the slopes' squares about each shot's mean.
        let slopes = |a: usize| shots(0.0, 0.0)[0].iter().map(|d| slope(d.expected_mm)[a]).collect::<Vec<_>>();
        let square: f64 = (0..2)
            .map(|a| {
                let t = slopes(a);
                let mean = t.iter().sum::<f64>() / 12.0;
                t.iter().map(|t| (t - mean).powi(2)).sum::<f64>()
            })
            .sum();
        let sd = found.dot_sd_px / 7.0 / (6.0 * square).sqrt();
        assert!((found.depth_sd_mm / sd - 1.0).abs() < 1e-9, "{found:?} {sd}");
        assert!((found.depth_mm - 1.5).abs() < 3.0 * sd, "{found:?}");
    }

    #[test]
    fn a_depth_within_its_noise_or_behind_the_surface_is_taken_for_none() {
        for depth in [0.0, -1.5] {
            let found = Parallax::learn(&shots(depth, 0.02), EYE, 7.0, SIDE_PX, None);
            assert_eq!(found.depth_mm, 0.0);
            // Dots stray by 0.0148 mm over tangents of 0.61 in all; what was found and not believed counts beside it.
            assert!(found.depth_sd_mm > 0.02 && found.depth_sd_mm < 0.03_f64.hypot(1.2 * depth.abs()), "{found:?}");
            // What dots are off by is then all that the shot's mean leaves, the depth that is not believed too.
            let mut left = Vec::new();
            for dots in shots(depth, 0.02) {
                for a in 0..2 {
                    let mean = dots.iter().map(|d| d.moved_mm[a]).sum::<f64>() / 12.0;
                    left.extend(dots.iter().map(|d| (d.moved_mm[a] - mean).abs()));
                }
            }
            left.sort_by(f64::total_cmp);
            let spread = 1.4826 * 0.5 * (left[71] + left[72]) * (144.0 / (144.0 - 12.0_f64)).sqrt();
            assert!((found.dot_sd_px / (7.0 * spread) - 1.0).abs() < 1e-9, "{found:?} {spread}");
        }
        // Shots of one dot, or none, tell nothing.
        let single: Vec<Vec<Located>> = shots(1.5, 0.0).into_iter().map(|s| s[..1].to_vec()).collect();
        assert_eq!(Parallax::learn(&single, EYE, 7.0, SIDE_PX, None), Parallax::unknown(EYE, SIDE_PX));
        assert_eq!(Parallax::learn(&[], EYE, 7.0, SIDE_PX, None), Parallax::unknown(EYE, SIDE_PX));
        assert!((Parallax::unknown(EYE, SIDE_PX).dot_sd_px - 0.11).abs() < 1e-12);
    }

    #[test]
    fn what_the_medium_says_counts_by_its_deviation_and_alone_where_the_dots_say_nothing() {
        let medium = DepthOfMedium { depth_mm: 0.9, sd_mm: 0.3 };
        let learn = |shots: &[Vec<Located>], medium| Parallax::learn(shots, EYE, 7.0, SIDE_PX, medium);
        let (dots, both) = (learn(&shots(1.5, 0.02), None), learn(&shots(1.5, 0.02), Some(medium)));
        let (w, v) = (dots.depth_sd_mm.powi(-2), 0.3f64.powi(-2));
        assert!((both.depth_mm - (w * dots.depth_mm + v * 0.9) / (w + v)).abs() < 1e-9, "{both:?}");
        assert!((both.depth_sd_mm - (w + v).powf(-0.5)).abs() < 1e-9 && both.depth_sd_mm < dots.depth_sd_mm);
        // From very far all dots are seen under one tangent: 20 mm over 2 m.
        let far = |p: Point| [(4e4 - p[0]) / 2e5, (-3e4 - p[1]) / 2e5];
        let telecentric: Vec<Vec<Located>> = shots(0.0, 0.02)
            .into_iter()
            .map(|shot| {
                let moved = |d: &Located| [0, 1].map(|a| d.moved_mm[a] + 1.5 * far(d.expected_mm)[a]);
                shot.iter().map(|d| located(d.expected_mm, moved(d), 1e-6)).collect()
            })
            .collect();
        let found = Parallax::learn(&telecentric, [4e4, -3e4, -2e5], 7.0, SIDE_PX, Some(medium));
        // The dots themselves tell it to some tens of millimetres.
        assert!((found.depth_mm - 0.9).abs() < 0.01 && (found.depth_sd_mm / 0.3 - 1.0).abs() < 0.01, "{found:?}");
        let alone = learn(&[], Some(medium));
        assert_eq!((alone.depth_mm, alone.depth_sd_mm, alone.dot_sd_px), (0.9, 0.3, UNKNOWN_DOT_SD * SIDE_PX));
    }

    #[test]
    fn a_mistaken_dot_does_not_bend_the_depth() {
        let mut some = shots(1.5, 0.001);
        some[3][7].moved_mm = [2.0, -1.0];
        let found = Parallax::learn(&some, EYE, 7.0, SIDE_PX, None);
        // Its shot's mean is off by a twelfth of it: eleven dots more that count as mistaken.
        assert!((found.depth_mm - 1.5).abs() < 0.01, "{found:?}");
    }

    #[test]
    fn a_drift_is_what_the_depth_does_not_explain() {
        let parallax = Parallax { eye_mm: EYE, dot_side_px: SIDE_PX, depth_mm: 1.5, depth_sd_mm: 0.0, dot_sd_px: 1e-6 };
        let dots = &shots(1.5, 0.0)[2];
        let drift = parallax.drift(dots, &registration()).unwrap();
        // (0.3 − 0.2, −0.2 + 0.14) mm; 6 · 0.1 − 0.5 · 0.06 and −0.1 − 4 · 0.06 px.
        assert!((drift.slab_mm[0] - 0.1).abs() < 1e-12 && (drift.slab_mm[1] + 0.06).abs() < 1e-12, "{drift:?}");
        assert!((drift.camera_px[0] - 0.57).abs() < 1e-5 && (drift.camera_px[1] + 0.34).abs() < 1e-5, "{drift:?}");
        assert_eq!((drift.dots, parallax.drift(&[], &registration())), (12, None));
    }

    #[test]
    fn each_cause_makes_a_drift_less_sure_in_its_turn() {
        let sd = |depth_sd_mm: f64, dot_sd_px: f64, variance_px2: f64| {
            let dots: Vec<Located> =
                [[10.0, 20.0], [30.0, 10.0], [14.0, 6.0]].map(|p| located(p, [0.0; 2], variance_px2)).to_vec();
            let parallax = Parallax { eye_mm: EYE, dot_side_px: SIDE_PX, depth_mm: 0.0, depth_sd_mm, dot_sd_px };
            parallax.drift(&dots, &registration()).unwrap().sd_px
        };
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-6;
        // What all dots of a capture are off by alike: 0.0133 of 2.5 px.
        assert!(near(sd(0.0, 0.0, 0.0), 0.033_25));
        // Three dots of 0.6 px each, or of 0.36 px² by their pixels: whichever is more.
        let three = 0.12f64.sqrt().hypot(0.033_25);
        assert!(near(sd(0.0, 0.6, 0.0), three) && near(sd(0.0, 0.6, 0.3), three) && near(sd(0.0, 0.1, 0.36), three));
        // Tangents are (30, −50), (10, −40) and (26, −36) over 200; √24.5 px a millimetre.
        let mean = |a: usize| [[10.0, 20.0], [30.0, 10.0], [14.0, 6.0]].map(|p| slope(p)[a] / 3.0).iter().sum::<f64>();
        let depth = 2.0 * mean(0).hypot(mean(1)) * 24.5f64.sqrt();
        assert!(near(sd(2.0, 0.0, 0.0), depth.hypot(0.033_25)));
    }

    #[test]
    fn two_dots_of_one_shot_are_enough_where_they_lie_apart() {
        let pair = |second: Point| {
            let dot = |p: Point| located(p, [0.2 + 1.5 * slope(p)[0], 0.1 + 1.5 * slope(p)[1]], 1e-6);
            Parallax::learn(&[vec![dot([2.0, 3.0]), dot(second)]], EYE, 7.0, SIDE_PX, None)
        };
        assert!((pair([30.0, 11.0]).depth_mm - 1.5).abs() < 1e-9);
        assert_eq!(pair([2.0, 3.0]), Parallax::unknown(EYE, SIDE_PX));
    }

    #[test]
    fn a_dot_strays_by_what_the_depth_leaves_over_the_freedoms_that_are_left() {
        let found = Parallax::learn(&shots(1.5, 0.02), EYE, 7.0, SIDE_PX, None);
        let mut left = Vec::new();
        for dots in shots(1.5, 0.02) {
            for a in 0..2 {
                let part = |d: &Located| d.moved_mm[a] - found.depth_mm * slope(d.expected_mm)[a];
                let mean = dots.iter().map(part).sum::<f64>() / 12.0;
                left.extend(dots.iter().map(|d| (part(d) - mean).abs()));
            }
        }
        left.sort_by(f64::total_cmp);
        // 144 differences less 12 means and the depth.
        let spread = 1.4826 * 0.5 * (left[71] + left[72]) * (144.0 / 131.0_f64).sqrt();
        assert!((found.dot_sd_px / (7.0 * spread) - 1.0).abs() < 1e-9, "{found:?} {spread}");
    }

    #[test]
    fn a_dot_is_located_from_where_the_pattern_puts_it() {
        use super::super::pictures::{CAMERA, covered, picture};
        use crate::capture::Rect;
        let dots = SampleDots { shape: DotShape::new([[1.0, 0.0], [0.0, 1.0]], 3.0).unwrap(), dot_radius_px: 2.0 };
        let (expected, moved) = ([12.0, 9.0], [0.11, -0.17]);
        let at = CAMERA.map([expected[0] + moved[0], expected[1] + moved[1]]);
        let rect = Rect { x: at[0] as usize - 12, y: at[1] as usize - 10, width: 26, height: 22 };
        // A brighter spot stands elsewhere in the picture.
        let other = [at[0] - 7.5, at[1] + 4.0];
        let light =
            |x: f64, y: f64| 5.0 + 80.0 * covered(x, y, at, [3.0, 3.0]) + 99.0 * covered(x, y, other, [1.0, 1.0]);
        let found = dots.locate(expected, &picture(rect, light, 0.01), &registration(), 4.0).unwrap();
        // The core's blur is one of those that are tried or nearly: some hundredths of a pixel, over 4 px a millimetre.
        assert!((0..2).all(|a| (found.moved_mm[a] - moved[a]).abs() < 0.01), "{found:?}");
        assert_eq!(found.expected_mm, expected);
        assert!(found.variance_px2 > 0.0 && found.variance_px2 < 1e-3, "{found:?}");
        let dark = |x: f64, y: f64| 5.0 - 2.0 * covered(x, y, at, [3.0, 3.0]);
        assert_eq!(dots.locate(expected, &picture(rect, dark, 0.01), &registration(), 4.0), None);
    }

    #[test]
    fn a_depth_is_believed_from_four_standard_deviations_on() {
        // Of dots that stray by 0.0148 mm over tangents of 0.61 in all: 0.024 mm. In steps of a twelfth of that.
        let found: Vec<Parallax> = (0..75)
            .map(|k| Parallax::learn(&shots(0.05 + 0.002 * f64::from(k), 0.02), EYE, 7.0, SIDE_PX, None))
            .collect();
        let believed: Vec<f64> =
            found.iter().filter(|f| f.depth_mm > 0.0).map(|f| f.depth_mm / f.depth_sd_mm).collect();
        let least = believed.iter().copied().fold(f64::INFINITY, f64::min);
        assert!(believed.len() < 70 && least > 4.0 && least < 4.4, "{least} of {}", believed.len());
    }
}
