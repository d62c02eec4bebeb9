//! The lattice's light against that of the references. The two black shots show the frame and the white reference under
//! the same little light, and so what share of the white reference's light the frame returns; with it the white
//! reference says how bright the reference dots must be.
//!
//! Not detected: anything in a room that is so dark under a black pattern that the frame is not seen, and a dark
//! current that is a tenth of that light or more (it makes the frame look brighter than it is).

use super::BuildOptions;
use super::reference_dots::{Level, reach_px};
use super::scene::{Scene, square};
use crate::geometry::Point;
use crate::radiance::Radiance;
use crate::registration::{Registration, median, scaled_deviation};
use crate::warning::bounds::{REFUSED_COLOUR, REFUSED_LIGHT};
use crate::{ConsistencyWarning, Result, Warning};
use std::f64::consts::{FRAC_1_SQRT_2, PI};

/// Black shots count where their light is so many times its standard deviation.
const SEEN_SIGMA: f64 = 5.0;
/// A frame that returns as much as the white reference to this share cannot be told from a dark current.
const LEAST_CONTRAST: f64 = 0.2;
/// The standard deviations that something must be off by.
const SIGMA: f64 = 6.0;
/// A level that is off by less, ln, is not told: of the 85 untouched captures of tests/tampered those whose exposure
/// times are right are off by 0.02 at the most.
const LEAST_OFF: f64 = 0.06;
/// Channels that agree to this share in another order are in that order.
const SAME_COLOUR: f64 = 0.04;
/// A dot of another size explains a level that it fits to this share.
const SAME_SIZE: f64 = 0.05;

/// What share of the white reference's light the frame returns at a reference dot, R, G, B; `None` where too little was
/// seen.
pub(super) type FrameShare = Option<[f64; 3]>;

/// The frame's share at each reference dot, from the black shots.
pub(super) fn frame_shares(
    places_px: &[Point],
    reach_px: f64,
    sample_black: &Radiance,
    reference_black: &Radiance,
) -> Vec<FrameShare> {
    let size_px = [sample_black.rect.width, sample_black.rect.height];
    let share = |&at: &Point| {
        let rect = square(at, reach_px, size_px)?;
        let [frame, white] = [sample_black, reference_black].map(|p| level(&p.part(rect)));
        let (frame, white) = (frame?, white?);
        Some([0, 1, 2].map(|c| frame[c] / white[c]))
    };
    places_px.iter().map(share).collect()
}

/// Median light of each channel; `None` where it is not beyond doubt.
fn level(picture: &Radiance) -> Option<[f64; 3]> {
    let channel = |all: &[f32], c: usize| -> Vec<f64> {
        let measured = all.iter().zip(&picture.used).skip(c).step_by(3).filter(|(_, used)| **used > 0);
        measured.map(|(v, _)| f64::from(*v)).collect()
    };
    let found = [0, 1, 2].map(|c| {
        let mut values = channel(&picture.value, c);
        let variance = channel(&picture.variance, c).iter().sum::<f64>() / values.len().max(1) as f64;
        // Of a median.
        let sd = 1.25 * (variance / values.len().max(1) as f64).sqrt();
        let middle = median(&mut values);
        (4 * values.len() > picture.rect.area() && middle > SEEN_SIGMA * sd).then_some(middle)
    });
    Some([found[0]?, found[1]?, found[2]?])
}

/// Share of the light of a square dot of half side `half` within a square of half side `reach` about it, when both are
/// seen through a Gaussian blur of standard deviation `sd` (all px). That the dot may be turned is left out.
fn within(half: f64, reach: f64, sd: f64) -> f64 {
    let sd = sd.max(1e-3 * half);
    // Integral of the normal distribution function.
    let area = |z: f64| {
        let (pdf, cdf) = ((-0.5 * z * z).exp() / (2.0 * PI).sqrt(), 0.5 * libm::erfc(-z * FRAC_1_SQRT_2));
        z * cdf + pdf
    };
    let below = |edge: f64| sd / (2.0 * half) * (area((edge + half) / sd) - area((edge - half) / sd));
    (below(reach) - below(-reach)).powi(2)
}

/// Light of the reference dots over what it should be.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct LatticeLight {
    /// R, G, B.
    pub(super) level: [f64; 3],
    /// The largest standard deviation of these, from how far dots disagree.
    pub(super) sd: f64,
    /// The order of the channels, 0 1 2 for R G B, in which they agree much better.
    pub(super) order: Option<[usize; 3]>,
}

impl LatticeLight {
    /// `None` where the black shots do not say what the frame returns.
    pub(super) fn of(scene: &Scene<'_>, level: &Level) -> Option<Self> {
        let reflectance = scene.capture.rig.white_reference.reflectance;
        let grid = &scene.capture.manifest.grid;
        let size_px2 = grid.dot_area_px2();
        let places = scene.capture.manifest.reference_dots.iter().flat_map(|r| &r.projector_px);
        let psf_px = scene.registration.point_spread.map_or(0.0, |p| p.psf_px);
        // Measured and expected light of each dot.
        let mut dots: Vec<[[f64; 3]; 2]> = Vec::new();
        for ((&place, share), measured) in
            places.zip(&scene.references.frame_share).zip(level.mean_light().as_chunks::<3>().0)
        {
            let (Some(share), [Some(r), Some(g), Some(b)]) = (share, measured) else { continue };
            let at = scene.registration.view.camera_from_slab(scene.registration.slab_from_projector.map(place));
            let area_px = size_px2 * camera_area(scene.registration, place);
            let Some(flux) = scene.references.irradiance.flux(at, area_px) else { continue };
            let within = within(0.5 * area_px.sqrt(), reach_px(scene), psf_px);
            let expected = [0, 1, 2].map(|c| flux.value[c] * reflectance[c] * share[c] * within);
            if share.iter().all(|s| (s - 1.0).abs() > LEAST_CONTRAST) {
                dots.push([[*r, *g, *b], expected]);
            }
        }
        if dots.len() < 3 {
            return None;
        }
        let of = |order: [usize; 3]| {
            [0, 1, 2].map(|c| {
                let mut all: Vec<f64> = dots.iter().map(|[seen, expected]| seen[order[c]] / expected[c]).collect();
                let middle = median(&mut all);
                [middle, scaled_deviation(all.iter().copied(), middle) / (dots.len() as f64).sqrt()]
            })
        };
        let found = of([0, 1, 2]);
        let level = found.map(|f| f[0]);
        let sd = found.iter().map(|f| f[1]).fold(0.0, f64::max);
        let others = [[2, 1, 0], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1]];
        let best = others.into_iter().map(|o| (colour(of(o).map(|f| f[0])), o)).min_by(|a, b| a.0.total_cmp(&b.0));
        let order = best.filter(|(off, _)| *off < SAME_COLOUR && 2.0 * off < colour(level)).map(|b| b.1);
        Some(Self { level, sd, order })
    }

    /// The mean of the channels.
    pub(super) fn mean(&self) -> f64 {
        self.level.iter().sum::<f64>() / 3.0
    }

    /// Whether it is off beyond doubt.
    pub(super) fn is_off(&self) -> bool {
        self.mean().ln().abs() > LEAST_OFF.max(SIGMA * self.sd / self.mean())
    }

    /// Whether the references were taken under the light of the last shots, `drift` times that of the first.
    pub(super) fn fits_later(&self, drift: f64) -> bool {
        self.is_off() && (drift * self.mean()).ln().abs() < LEAST_OFF
    }

    /// The same for levels over what the references say.
    pub(super) fn anchored(&self) -> Self {
        let mean = self.mean();
        Self { level: self.level.map(|l| l / mean), sd: self.sd / mean, ..*self }
    }

    /// What is to be told; `explained`: a small deviation is, by something that is told already.
    ///
    /// # Errors
    /// [`crate::Error::Contradiction`].
    pub(super) fn judge(&self, scene: &Scene<'_>, explained: bool, options: &BuildOptions) -> Result<Option<Warning>> {
        let (mean, off) = (self.mean(), colour(self.level));
        let bound = SIGMA * self.sd / mean;
        if off > REFUSED_COLOUR.max(bound) {
            let looks = match self.order {
                Some(order) => format!("the lattice's channels are in the order {}", order.map(|c| ["R", "G", "B"][c]).concat()),
                None => "the lattice's photographs have another white balance or order of channels, or the lamp another colour".into(),
            };
            let finding = ConsistencyWarning::LatticeColour { levels: self.level, sd: self.sd, looks };
            return options.refuse(finding).map(Some);
        }
        if !self.is_off() || (explained && mean.ln().abs() < REFUSED_LIGHT) {
            return Ok(None);
        }
        let grid = &scene.capture.manifest.grid;
        let size = grid.dot_projector_px as f64 * mean.sqrt();
        let fits = (size / size.round() - 1.0).abs() < 0.5 * SAME_SIZE && size.round() != grid.dot_projector_px as f64;
        let square = grid.dot_area_projector_px2.is_none();
        let size = (fits && square).then_some(size.round() as usize).filter(|s| *s > 0);
        let finding = ConsistencyWarning::LatticeLight {
            level: mean,
            sd: self.sd,
            dot_projector_px: grid.dot_projector_px,
            size,
        };
        match mean.ln().abs() < REFUSED_LIGHT {
            true => Ok(Some(finding.into())),
            false => options.refuse(finding).map(Some),
        }
    }
}

/// How far channels are from each other: the largest over the smallest, less one.
fn colour(level: [f64; 3]) -> f64 {
    level.iter().copied().fold(0.0, f64::max) / level.iter().copied().fold(f64::INFINITY, f64::min) - 1.0
}

/// Camera px² per projector px² at a projector pixel.
fn camera_area(registration: &Registration, place: Point) -> f64 {
    let [[a, b], [c, d]] = registration.view.jacobian(registration.slab_from_projector.map(place));
    registration.slab_from_projector.area_scale(place) * (a * d - b * c).abs()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_light_of_a_blurred_dot_within_a_square_is_the_sum_of_its_parts() {
        for (half, reach, sd) in [(1.0, 3.5, 2.0), (2.0, 4.0, 0.8), (0.7, 3.0, 3.0), (1.5, 2.0, 1.0)] {
            // Points of the dot, each a Gaussian of which the square holds some.
            let cdf = |t: f64| 0.5 * libm::erfc(-t / sd * FRAC_1_SQRT_2);
            let points = (0..2000).map(|k| half * ((k as f64 + 0.5) / 1000.0 - 1.0));
            let one = points.map(|u| cdf(reach - u) - cdf(-reach - u)).sum::<f64>() / 2000.0;
            assert!((within(half, reach, sd) - one * one).abs() < 1e-6, "{half} {reach} {sd}");
        }
        assert_eq!(within(1.0, 3.0, 0.0), 1.0);
    }

    use crate::capture::Rect;

    /// 40×30 px whose channels have this light, a little uneven.
    fn picture(light: [f64; 3], variance: f32) -> Radiance {
        let value = |k: usize, c: usize| (light[c] * (1.0 + 0.01 * ((k / 3) as f64).sin())) as f32;
        Radiance {
            rect: Rect { x: 0, y: 0, width: 40, height: 30 },
            value: (0..3600).map(|k| value(k, k % 3)).collect(),
            variance: vec![variance; 3600],
            used: vec![1; 3600],
        }
    }

    #[test]
    fn a_frames_share_of_the_white_is_that_of_the_black_shots_where_these_are_seen() {
        let (frame, white) = (picture([1.2, 0.9, 0.6], 0.01), picture([12.0, 10.0, 8.0], 0.01));
        let found = frame_shares(&[[12.0, 9.0], [80.0, 9.0]], 4.0, &frame, &white);
        let expected = [0.1, 0.09, 0.075];
        assert!((0..3).all(|c| (found[0].unwrap()[c] / expected[c] - 1.0).abs() < 1e-3), "{found:?}");
        assert_eq!(found[1], None, "beside the photograph");
        // 1.25 · √(variance / 81) of the frame's blue light is a fifth of it.
        assert_eq!(frame_shares(&[[12.0, 9.0]], 4.0, &picture([1.2, 0.9, 0.6], 0.8), &white), vec![None]);
    }

    #[test]
    fn levels_that_references_explain_are_told_apart_from_those_of_the_last_shots() {
        let light = |level: f64| LatticeLight { level: [level; 3], sd: 0.005, order: None };
        assert!(!light(1.02).is_off() && light(1.08).is_off() && light(0.7).is_off());
        assert!(!LatticeLight { sd: 0.05, ..light(1.2) }.is_off(), "dots that disagree by more say nothing");
        // First shots at 80 %, the last ones as the references.
        assert!(light(0.8).fits_later(1.24) && !light(0.8).fits_later(1.0) && !light(1.0).fits_later(1.24));
        let anchored = light(0.8).anchored();
        assert!((anchored.mean() - 1.0).abs() < 1e-12 && (anchored.sd - 0.00625).abs() < 1e-12);
        assert!((colour([0.8, 1.0, 0.9]) - 0.25).abs() < 1e-12);
    }
}
