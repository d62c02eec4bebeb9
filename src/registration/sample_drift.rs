//! Drift from the lattice's own dots, where there are none on the frame.
//!
//! Three things move a dot on a translucent sample besides the projector. The glow around it is brighter on one side near an edge
//! between materials: only the sharp core is used ([`DotShape`]). What is seen comes from some depth, so that an oblique camera sees it
//! beside its place: one effective depth for the capture, learnt from how dots of one shot are pulled apart ([`Parallax`]). What is
//! left differs from dot to dot: the median and the spread over a shot's dots.

use super::drift::{centroid, median, robust_mean};
use super::{DotShape, Drift, Registration};
use crate::geometry::Point;
use crate::radiance::Radiance;

/// What a dot on the sample is off by when nothing tells, px: the centroids of dots near an edge of two materials stray so far.
const UNKNOWN_DOT_SD_PX: f64 = 0.1;
/// Sharp dots are found this well at best, px.
const FLOOR_PX: f64 = 0.01;
/// Cores on a real material are not the model's footprint: what all dots of a capture are off by alike, px (simulated materials: up to 0.03).
const COMMON_PX: f64 = 0.03;
/// A depth of this many standard deviations is believed.
const BELIEVED_SIGMA: f64 = 4.0;

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
    /// Effective depth over refractive index, mm: a dot is seen by this times the tangent of the line of sight nearer to the camera's foot.
    pub depth_mm: f64,
    /// Its standard deviation, mm.
    pub depth_sd_mm: f64,
    /// Standard deviation per axis of a single dot, px.
    pub dot_sd_px: f64,
}

impl SampleDots {
    /// Finds a dot in its picture without ambient light, near the place where the pattern puts it (mm).
    ///
    /// Dots are searched within `search_px`: not further than half the way to the next one. `None` for one that is too dark, cut off by the
    /// search or not of the dot's shape.
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

impl Parallax {
    /// Nothing known but where the camera is.
    pub fn unknown(eye_mm: [f64; 3]) -> Self {
        Self { eye_mm, depth_mm: 0.0, depth_sd_mm: 0.0, dot_sd_px: UNKNOWN_DOT_SD_PX }
    }

    /// Tangent of the line of sight at `p`: towards the camera's foot, per depth.
    fn tangent(&self, p: Point) -> Point {
        [0, 1].map(|a| (self.eye_mm[a] - p[a]) / -self.eye_mm[2])
    }

    /// Learns the depth from the dots of several shots, each with a drift of its own: what pulls a shot's dots towards the camera's foot is
    /// depth. `px_per_mm` is the camera's scale. Without shots of two dots or more the depth is unknown, and taken for none.
    ///
    /// Not detected: a pattern that has grown or shrunk since registration; it looks like depth.
    pub fn learn(shots: &[Vec<Located>], eye_mm: [f64; 3], px_per_mm: f64) -> Self {
        let nothing = Self::unknown(eye_mm);
        // Differences from the shot's mean are free of its drift: (tangent, displacement, weight that the mean takes away).
        let mut pairs: Vec<(f64, f64)> = Vec::new();
        let mut lost = 0;
        for dots in shots.iter().filter(|s| s.len() >= 2) {
            for a in 0..2 {
                let mean = |f: &dyn Fn(&Located) -> f64| dots.iter().map(f).sum::<f64>() / dots.len() as f64;
                let (tangent, moved) = (|d: &Located| nothing.tangent(d.expected_mm)[a], |d: &Located| d.moved_mm[a]);
                let (t0, m0) = (mean(&tangent), mean(&moved));
                pairs.extend(dots.iter().map(|d| (tangent(d) - t0, moved(d) - m0)));
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
        let believed = depth_mm > BELIEVED_SIGMA * sd;
        if !believed {
            let mut left: Vec<f64> = pairs.iter().map(|(_, m)| m.abs()).collect();
            let freedom = (pairs.len() as f64 / (pairs.len() - lost) as f64).sqrt();
            spread = 1.4826 * median(&mut left) * freedom;
        }
        let (depth_mm, depth_sd_mm) = if believed { (depth_mm, sd) } else { (0.0, 0.0) };
        Self { eye_mm, depth_mm, depth_sd_mm, dot_sd_px: (spread * px_per_mm).max(FLOOR_PX) }
    }

    /// The displacement of a shot from the dots that were found; `None` for none.
    pub fn drift(&self, dots: &[Located], registration: &Registration) -> Option<Drift> {
        if dots.is_empty() {
            return None;
        }
        let moved = |a: usize| dots.iter().map(move |d| d.moved_mm[a] - self.depth_mm * self.tangent(d.expected_mm)[a]);
        let slab_mm = [0, 1].map(|a| robust_mean(moved(a).collect()).0);
        let jacobian = registration.view.jacobian(registration.center_mm);
        let px_per_mm = registration.px_per_mm();
        let camera_px = std::array::from_fn(|i| jacobian[i][0] * slab_mm[0] + jacobian[i][1] * slab_mm[1]);
        let n = dots.len() as f64;
        let tangent = [0, 1].map(|a| dots.iter().map(|d| self.tangent(d.expected_mm)[a]).sum::<f64>() / n);
        let depth_px = self.depth_sd_mm * tangent[0].hypot(tangent[1]) * px_per_mm;
        let noise = dots.iter().map(|d| d.variance_px2).sum::<f64>() / n;
        // The spread between dots has the pixels' noise in it already; in dim captures that noise is more.
        let sd_px = (self.dot_sd_px.powi(2).max(noise) / n + depth_px * depth_px + COMMON_PX * COMMON_PX).sqrt();
        Some(Drift { slab_mm, camera_px, sd_px, dots: dots.len() })
    }
}
