//! One lens for several planes seen by the same camera.

use super::fit::{Observation, ViewFit, fit_homography, fit_view, gauss_newton};
use crate::geometry::{CameraView, Lens, Point};
use serde::{Deserialize, Serialize};

/// Pairs of a plane's points and where the camera sees them: (mm, camera px).
pub type Pairs = Vec<(Point, Point)>;

/// A model of the lens that was tried.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LensTrial {
    /// Radial terms: 0 for none, 1 for k1, 2 for k1 and k2.
    pub radial_terms: usize,
    /// Whether the centre of distortion was fitted too.
    pub center: bool,
    /// RMS of all points against it, px.
    pub rms_px: f64,
    /// Bayesian information criterion: the least is chosen.
    pub information: f64,
}

/// How the lens was chosen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LensChoice {
    /// Photographs of a plane.
    pub views: usize,
    /// Points in all of them.
    pub points: usize,
    /// Radial terms of the model that is used.
    pub radial_terms: usize,
    /// Whether it has a centre of its own.
    pub center: bool,
    /// All that were tried, by boards and marks alone.
    pub trials: Vec<LensTrial>,
    /// The model that is used, where the stripes have decided too: its information criterion is that of both.
    #[serde(default)]
    pub with_stripes: Option<LensTrial>,
}

impl LensChoice {
    /// The same in pixels of another size.
    pub(crate) fn scaled(self, scale: f64) -> Self {
        let trial = |t: LensTrial| LensTrial { rms_px: scale * t.rms_px, ..t };
        let trials = self.trials.into_iter().map(trial).collect();
        Self { trials, with_stripes: self.with_stripes.map(trial), ..self }
    }
}

/// Parameters of each model, in the order k1, k2, centre x, centre y.
const MODELS: [usize; 4] = [0, 1, 2, 4];
/// A term is tried only with this many points for each.
const PAIRS_PER_TERM: usize = 15;
/// Points are never known better than this, px.
pub(super) const FLOOR_PX: f64 = 0.003;

/// Fits a lens to several views, each of a plane of its own; every view counts by how well its own points agree.
///
/// Radial distortion and then its centre are added while the Bayesian information criterion falls. A plane's homography
/// holds focal length and pose together, which is all that placing points on it needs. The centre is only fitted to two
/// views or more: on one plane a homography stands in for it. `None` for no views, or one with fewer than ten points or
/// a degenerate layout.
pub fn fit_lens_of_views(views: &[Pairs], center_px: Point, focal_px: f64) -> Option<(Vec<ViewFit>, LensChoice)> {
    if views.is_empty() {
        return None;
    }
    let alone = sds_alone(views, center_px, focal_px)?;
    let points: usize = views.iter().map(Vec::len).sum();
    let n = 2.0 * points as f64;
    let mut best: Option<(f64, usize, Vec<CameraView>)> = None;
    let (mut trials, mut start) = (Vec::new(), [0.0; 4]);
    for terms in MODELS.into_iter().filter(|&t| t <= points / PAIRS_PER_TERM && (t < 4 || views.len() >= 2)) {
        let solve = |k: [f64; 4]| solve_planes(views, &alone, lens(k, center_px, focal_px));
        let (found, weighted) = gauss_newton(&solve, &mut start, terms)?;
        let square: f64 = weighted.iter().map(|r| r * r).sum();
        let information = n * (square / n).max(1e-6).ln() + (8 * views.len() + terms) as f64 * n.ln();
        let rms_px = rms_of_views(&found, views);
        trials.push(LensTrial { radial_terms: terms.min(2), center: terms == 4, rms_px, information });
        if best.as_ref().is_none_or(|(b, ..)| information < *b) {
            best = Some((information, terms, found));
        }
    }
    let (_, terms, found) = best?;
    let radial_terms = terms.min(2);
    let choice =
        LensChoice { views: views.len(), points, radial_terms, center: terms == 4, trials, with_stripes: None };
    Some((view_fits(&found, views, terms), choice))
}

/// What each view's points are off by when it is fitted alone, px.
pub(super) fn sds_alone(views: &[Pairs], center_px: Point, focal_px: f64) -> Option<Vec<f64>> {
    views.iter().map(|v| Some(fit_view(v, center_px, focal_px)?.rms_px.max(FLOOR_PX))).collect()
}

/// RMS of all views' points, px.
pub(super) fn rms_of_views(found: &[CameraView], views: &[Pairs]) -> f64 {
    let n = 2.0 * views.iter().map(Vec::len).sum::<usize>() as f64;
    (found.iter().zip(views).map(|(v, pairs)| square_px(v, pairs)).sum::<f64>() / n).sqrt()
}

/// Views that share a lens of so many parameters, with what their points are off by.
pub(super) fn view_fits(found: &[CameraView], views: &[Pairs], terms: usize) -> Vec<ViewFit> {
    let fit = |(view, pairs): (&CameraView, &Pairs)| {
        let n = 2.0 * pairs.len() as f64;
        let rms_px = (square_px(view, pairs) / n).sqrt();
        ViewFit { view: *view, rms_px, sd_px: rms_px * ((8 + terms) as f64 / n).sqrt() }
    };
    found.iter().zip(views).map(fit).collect()
}

pub(super) fn lens(k: [f64; 4], center_px: Point, focal_px: f64) -> Lens {
    // The centre counts in focal lengths, so that all parameters are small numbers.
    let center_px = [center_px[0] + focal_px * k[2], center_px[1] + focal_px * k[3]];
    Lens { center_px, focal_px, k1: k[0], k2: k[1] }
}

/// Every view's plane for a given lens, and the residuals over what the views' points are off by alone.
pub(super) fn solve_planes(views: &[Pairs], alone: &[f64], lens: Lens) -> Option<(Vec<CameraView>, Vec<f64>)> {
    let (mut found, mut weighted) = (Vec::new(), Vec::new());
    for (pairs, sd) in views.iter().zip(alone) {
        let ideal = pairs.iter().map(|&(from, to)| (from, lens.undistort(to)));
        let observations: Vec<Observation> =
            ideal.flat_map(|(from, to)| [0, 1].map(|axis| Observation { from, axis, to: to[axis] })).collect();
        let view = CameraView { ideal_from_slab: fit_homography(&observations)?.0, lens };
        weighted.extend(pairs.iter().flat_map(|&(from, to)| {
            let seen = view.camera_from_slab(from);
            [0, 1].map(|a| (seen[a] - to[a]) / sd)
        }));
        found.push(view);
    }
    Some((found, weighted))
}

fn square_px(view: &CameraView, pairs: &Pairs) -> f64 {
    let one = |&(from, to): &(Point, Point)| {
        let seen = view.camera_from_slab(from);
        (seen[0] - to[0]).powi(2) + (seen[1] - to[1]).powi(2)
    };
    pairs.iter().map(one).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Homography;

    /// Three planes in different poses, points off by 0.03 px in turn.
    fn views(lens: Lens) -> Vec<Pairs> {
        let poses = [
            [[6.0, 0.3, 12.0], [-0.2, 6.1, 9.0], [1e-3, -5e-4, 1.0]],
            [[5.0, -0.5, 40.0], [0.4, 5.5, 10.0], [-4e-3, 1e-3, 1.0]],
            [[5.2, 0.2, 20.0], [0.1, 4.8, 30.0], [1e-3, 5e-3, 1.0]],
        ];
        // Digits of a linear congruence: no two points alike, nothing that a lens could follow.
        let off = |k: usize| {
            let mixed =
                (k as u64 + 7).wrapping_mul(6_364_136_223_846_793_005).rotate_left(29).wrapping_mul(0x9e37_79b9);
            0.03 * ((mixed >> 33) as f64 / (1u64 << 30) as f64 - 1.0)
        };
        let pair = |view: usize, h: Homography, k: usize| {
            let p = [(k % 13) as f64 * 2.5, (k / 13) as f64 * 2.5];
            let q = lens.distort(h.map(p));
            (p, [q[0] + off(1000 * view + k), q[1] + off(1000 * view + k + 501)])
        };
        let one = |(n, matrix)| (0..156).map(|k| pair(n, Homography { matrix }, k)).collect();
        poses.into_iter().enumerate().map(one).collect()
    }

    #[test]
    fn several_views_tell_distortion_and_its_centre_and_only_what_is_there() {
        let nominal = ([110.0, 95.0], 300.0);
        let ideal = fit_lens_of_views(&views(Lens::ideal(nominal.0, nominal.1)), nominal.0, nominal.1).unwrap();
        assert!(ideal.1.radial_terms == 0 && !ideal.1.center, "{:?}", ideal.1);
        let real = Lens { center_px: [118.0, 90.0], focal_px: 300.0, k1: -0.2, k2: 0.04 };
        let (fits, choice) = fit_lens_of_views(&views(real), nominal.0, nominal.1).unwrap();
        assert!(choice.radial_terms == 2 && choice.center && choice.trials.len() == 4, "{choice:?}");
        // Noise of 0.017 px RMS; the centre is told to a few tenths of a pixel by a distortion of some px.
        let found = fits[0].view.lens.center_px;
        assert!((found[0] - 118.0).hypot(found[1] - 90.0) < 1.0, "{found:?}");
        assert!(fits.iter().all(|f| f.rms_px < 0.02), "{fits:?}");
    }

    #[test]
    fn a_lens_is_chosen_by_what_its_points_say_over_what_each_view_is_off_by_alone() {
        let (center, focal) = ([110.0, 95.0], 300.0);
        let mut seen = views(Lens { center_px: center, focal_px: focal, k1: -0.2, k2: 0.0 });
        // The second view is three times as uncertain, the third shorter.
        for (k, (_, q)) in seen[1].iter_mut().enumerate() {
            q[k % 2] += 0.1 * (f64::from((k * 37 % 100) as u32) / 50.0 - 1.0);
        }
        seen[2].truncate(104);
        let (fits, choice) = fit_lens_of_views(&seen, center, focal).unwrap();
        assert_eq!((choice.views, choice.points, choice.radial_terms, choice.center), (3, 416, 1, false));
        let tried: Vec<_> = choice.trials.iter().map(|t| (t.radial_terms, t.center)).collect();
        assert_eq!(tried, [(0, false), (1, false), (2, false), (2, true)]);
        let (mut plain, mut weighted) = (0.0, 0.0);
        for (fit, pairs) in fits.iter().zip(&seen) {
            let alone = fit_view(pairs, center, focal).unwrap().rms_px;
            let mut square = 0.0;
            for (p, q) in pairs {
                let at = fit.view.camera_from_slab(*p);
                square += (at[0] - q[0]).powi(2) + (at[1] - q[1]).powi(2);
            }
            plain += square;
            weighted += square / (alone * alone);
            let n = 2.0 * pairs.len() as f64;
            assert!((fit.rms_px - (square / n).sqrt()).abs() < 1e-12);
            // Eight numbers of the plane and one of the lens.
            assert!((fit.sd_px - fit.rms_px * (9.0 / n).sqrt()).abs() < 1e-12);
        }
        let n = 832.0f64;
        let trial = &choice.trials[1];
        assert!((trial.rms_px - (plain / n).sqrt()).abs() < 1e-12, "{trial:?}");
        let information = n * (weighted / n).ln() + (3.0 * 8.0 + 1.0) * n.ln();
        // Over hundreds: the last digits of the sums.
        assert!((trial.information - information).abs() < 1e-8, "{trial:?} {information}");
        assert!(choice.trials.iter().all(|t| t.information >= trial.information));
    }

    #[test]
    fn one_view_has_no_centre_and_few_points_few_terms() {
        let real = Lens { center_px: [118.0, 90.0], focal_px: 300.0, k1: -0.2, k2: 0.04 };
        let all = views(real);
        let trials = |views: &[Pairs]| fit_lens_of_views(views, [110.0, 95.0], 300.0).map(|f| f.1.trials.len());
        assert_eq!(trials(&all[..1]), Some(3));
        // Every eleventh of 156 is 15 points: one term; 13 of them: none; two views of 15 have two terms, of 39 the
        // centre. Every twelfth lies in one line.
        let every = |n: usize| -> Vec<Pairs> { all.iter().map(|v| v.iter().copied().step_by(n).collect()).collect() };
        assert_eq!(trials(&every(11)[..1]), Some(2));
        assert_eq!(trials(&[every(11)[0][..13].to_vec()]), Some(1));
        assert_eq!(trials(&every(12)[..1]), None);
        assert_eq!(trials(&every(11)[..2]), Some(3));
        assert_eq!(trials(&every(4)[..2]), Some(4));
        assert_eq!(trials(&every(20)[..2]), None, "eight points a view");
        assert_eq!(trials(&[]), None);
    }

    #[test]
    fn a_centre_counts_in_focal_lengths() {
        let expected = Lens { center_px: [13.0, 17.0], focal_px: 200.0, k1: 0.5, k2: -0.25 };
        assert_eq!(lens([0.5, -0.25, 0.015, -0.015], [10.0, 20.0], 200.0), expected);
    }
}
