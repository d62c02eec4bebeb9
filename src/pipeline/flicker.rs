//! A lamp that flickers: how much, and what of it can be taken out.
//!
//! Three scales are measured, the first only when the capture's stacks show flicker at all:
//! - a photograph against the others of its stack, from the pixels that several measured (`radiance/exposures.rs`),
//!   drawn towards none by the flicker of the whole capture;
//! - a stack against the other stacks, from the light of the reference dots on the opaque frame: drawn towards none by
//!   what shots differ by, or as a whole where a shot is off by more than that;
//! - the white reference against the Gray-code shots, each of which adds up with its inverse to the same white
//!   (`references.rs`).

use super::BuildOptions;
use super::lattice_light::LatticeLight;
use super::reference_dots::{DotsShow, Level, SeenDots, board_blur, reference_light};
use super::scene::Scene;
use crate::cholesky::solve;
use crate::radiance::{Bracket, Sensor, evenly, stack_scales};
use crate::registration::median;
use crate::{ConsistencyWarning, RadianceWarning, Result, Warning};
use rayon::prelude::*;

/// Flicker of a capture.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Flicker {
    /// Standard deviation of a photograph's light, relative; `None` when the stacks show none.
    sd: Option<f64>,
    level: Option<Level>,
    /// The mean of it over what the references say.
    light: Option<LatticeLight>,
    /// Mean square width of the reference dots, px².
    width_px2: Option<f64>,
    /// Whether levels are over what the references say.
    anchored: bool,
    /// Relative variance that remains in the white reference.
    white_variance: f64,
}

/// Lattice shots whose reference dots make the mean. Their own flicker is in it: a sixth of a shot's.
const SHOTS: usize = 36;
/// Samples of a shot that are looked at: more would not know the scales any better than they flicker.
const SAMPLES: usize = 60_000;

/// What flicker leaves of a shot, and what was done about its lamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Steadied {
    /// Relative variance that remains, common to the shot's rows.
    pub variance: f64,
    /// The lamp's level over that of most shots and its standard deviation, where it is off by more than flicker and
    /// noise.
    pub lamp: Option<[f64; 2]>,
    /// What the reference dots show besides.
    pub dots: DotsShow,
}

/// A photograph that is off by more than this many standard deviations of the flicker is off by something else.
const FLICKER_SIGMA: f64 = 5.0;

impl Flicker {
    /// Looks at the reference dots of some lattice shots.
    ///
    /// # Errors
    /// Those of decoding.
    pub(super) fn measure(scene: &Scene<'_>, sd: Option<f64>) -> Result<Self> {
        // Unknown, the white reference deviates as any photograph does.
        let white_variance = sd.map_or(0.0, |sd| scene.references.white_variance.unwrap_or(sd * sd));
        let mut flicker = Self { sd, level: None, light: None, width_px2: None, anchored: false, white_variance };
        if scene.reference_mm().is_empty() {
            return Ok(flicker);
        }
        let shots: Vec<usize> = evenly(&scene.lattice(), SHOTS).collect();
        let seen: Vec<Option<SeenDots>> = shots
            .par_iter()
            .map(|&shot| {
                let mut seen = scene.photographs.decode(shot, &scene.reference_rects(shot)?)?;
                flicker.steady_stack(&scene.photographs.sensor, seen.iter_mut().collect());
                Ok(reference_light(scene, &seen))
            })
            .collect::<Result<_>>()?;
        let seen: Vec<SeenDots> = seen.into_iter().flatten().collect();
        let is_steady = SeenDots::are_steady(&seen);
        let mut widths: Vec<f64> = seen.iter().filter_map(|s| s.spread_px2).collect();
        flicker.width_px2 = (!widths.is_empty()).then(|| median(&mut widths));
        flicker.level = Level::of(&seen.into_iter().map(|s| s.light).collect::<Vec<_>>(), is_steady);
        flicker.light = flicker.level.as_ref().and_then(|level| LatticeLight::of(scene, level));
        if let (Some(level), Some(light)) = (&mut flicker.level, &mut flicker.light)
            && level.drift.is_some_and(|drift| light.fits_later(drift))
        {
            level.anchor(light.mean(), light.sd / light.mean());
            *light = light.anchored();
            flicker.anchored = true;
        }
        Ok(flicker)
    }

    /// Takes what can be taken out of a shot's exposure times.
    pub(super) fn steady(
        &self,
        scene: &Scene<'_>,
        shot: usize,
        references: &mut [Bracket],
        windows: &mut [Bracket],
    ) -> Steadied {
        let both = references.iter_mut().chain(windows.iter_mut()).collect();
        let [common, own] = self.steady_stack(&scene.photographs.sensor, both);
        let seen = reference_light(scene, references);
        let mut dots = DotsShow { spread_px2: seen.as_ref().and_then(|s| s.spread_px2), ..DotsShow::default() };
        let both = self.level.as_ref().zip(seen.as_ref());
        if let Some((level, seen)) = both {
            (dots.strange, dots.colour) = (level.strange(&seen.light), level.colour(&seen.light));
        }
        let scale = |brackets: &mut [Bracket], level: f64| {
            brackets.iter_mut().for_each(|b| b.scale_secs(&vec![level; b.exposures().len()]));
        };
        let Some(found) = both.and_then(|(level, seen)| level.scale_of(&seen.light)) else {
            let mut variance = common + own + self.white_variance;
            // Without reference dots, what lies between two white references tells the lamp.
            if let Some(between) = scene.references.lamp.filter(|_| scene.capture.manifest.reference_dots.is_none()) {
                let [level, of_lamp] = between.at(shot);
                scale(windows, level);
                variance += of_lamp;
            }
            return Steadied { variance, lamp: None, dots };
        };
        scale(references, found.log_level.exp());
        scale(windows, found.log_level.exp());
        let lamp = found.is_lamp.then(|| [found.log_level.exp(), found.variance.sqrt()]);
        Steadied { variance: found.variance + own + self.white_variance, lamp, dots }
    }

    /// Corrects the times of a stack's photographs against each other. Returns the relative variances that remain: one
    /// that all have in common, and the mean of what each has besides.
    fn steady_stack(&self, sensor: &Sensor, brackets: Vec<&mut Bracket>) -> [f64; 2] {
        let Some(sd) = self.sd else { return [0.0; 2] };
        let samples: usize = brackets.iter().map(|b| 3 * b.rect().area()).sum();
        let parts: Vec<_> = brackets.iter().map(|b| b.exposures()).collect();
        let n = parts.first().map_or(1, |p| p.len());
        let prior = sd * sd;
        let untouched = [prior / n as f64, prior * (1.0 - 1.0 / n as f64)];
        let scales = stack_scales(&parts, sensor, samples.div_ceil(SAMPLES));
        let found = scales.and_then(|s| shrink(&s.log_scale, &s.information, prior));
        let Some((log_scale, covariance)) = found else { return untouched };
        // Times or a response curve that are wrong differ alike in every stack: that is told elsewhere, and is no
        // flicker.
        if log_scale.iter().any(|s| s.abs() > FLICKER_SIGMA * sd) {
            return untouched;
        }
        let factors: Vec<f64> = log_scale.iter().map(|s| s.exp()).collect();
        brackets.into_iter().for_each(|b| b.scale_secs(&factors));
        let common = covariance.iter().sum::<f64>() / (n * n) as f64;
        let mean = (0..n).map(|j| covariance[j * n + j]).sum::<f64>() / n as f64;
        [common, (mean - common).max(0.0)]
    }

    /// Relative variance of the white reference's light that is left: all rows have it in common.
    pub(super) fn white_variance(&self) -> f64 {
        self.white_variance
    }

    /// What to tell people, given the mean relative variance that remains; `None` without flicker.
    pub(super) fn warning(&self, remaining: f64) -> Option<RadianceWarning> {
        self.sd.map(|relative_sd| RadianceWarning::Flicker { relative_sd, remaining_sd: remaining.sqrt() })
    }

    /// A lamp that changes over the sweep of so many shots.
    pub(super) fn drift(&self, shots: usize) -> Option<ConsistencyWarning> {
        let level = self.level.as_ref()?.drift?;
        Some(ConsistencyWarning::LampDrifts { level, shots, to_references: self.anchored })
    }

    /// What board and references say of the reference dots as a whole; `times_are_off`: exposure times are, and explain
    /// a little.
    ///
    /// # Errors
    /// [`crate::Error::Contradiction`].
    pub(super) fn judge(
        &self,
        scene: &Scene<'_>,
        times_are_off: bool,
        options: &BuildOptions,
    ) -> Result<Option<Warning>> {
        let blur = self.width_px2.map(|width| board_blur(scene, width, options)).transpose()?.flatten();
        match &self.light {
            // The light of dots is judged by that blur.
            Some(light) if blur.is_none() => light.judge(scene, times_are_off, options),
            _ => Ok(blur),
        }
    }

    /// For the provenance.
    pub(super) fn record(&self, remaining: f64) -> serde_json::Value {
        serde_json::json!({
            "relative_sd": self.sd,
            "shot_level_sd": self.level.as_ref().map(|l| l.variance.sqrt()),
            "white_remaining_sd": self.white_variance.sqrt(),
            "remaining_sd": remaining.sqrt(),
        })
    }
}

/// Posterior mean and covariance of scales whose prior is none with variance `prior` each.
fn shrink(log_scale: &[f64], information: &[f64], prior: f64) -> Option<(Vec<f64>, Vec<f64>)> {
    let n = log_scale.len();
    let mut system = information.to_vec();
    (0..n).for_each(|j| system[j * n + j] += 1.0 / prior);
    let right = (0..n).map(|j| (0..n).map(|i| information[j * n + i] * log_scale[i]).sum()).collect();
    let mean = solve(system.clone(), right)?;
    let column = |i: usize| solve(system.clone(), (0..n).map(|j| if i == j { 1.0 } else { 0.0 }).collect());
    let covariance: Vec<Vec<f64>> = (0..n).map(column).collect::<Option<_>>()?;
    Some((mean, covariance.concat()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_drawn_towards_none_by_what_is_known_of_them_and_of_the_flicker() {
        // Two photographs of which only the ratio is known, with information 5000 on each; a flicker of variance 1e-4.
        let (known, prior) = (5000.0, 1e-4);
        let information = [known, -known, -known, known];
        let (mean, covariance) = shrink(&[0.05, 0.01], &information, prior).unwrap();
        // Half the difference is left of each, times 2 · 5000 / (2 · 5000 + 1e4); small systems in f64.
        assert!((mean[0] - 0.01).abs() < 1e-12 && (mean[1] + 0.01).abs() < 1e-12, "{mean:?}");
        // What both have in common stays at its prior; their difference is known to 1 / 2e4.
        let (common, contrast) = (prior, 1.0 / (2.0 * known + 1.0 / prior));
        let expected = [0.5 * (common + contrast), 0.5 * (common - contrast)];
        for (k, e) in [(0, expected[0]), (1, expected[1]), (2, expected[1]), (3, expected[0])] {
            assert!((covariance[k] / e - 1.0).abs() < 1e-9, "{k}: {covariance:?}");
        }
        // Unequal ones, each known by itself.
        let (mean, covariance) = shrink(&[0.05, 0.01], &[3e4, 0.0, 0.0, 1e3], prior).unwrap();
        assert!((mean[0] - 0.05 * 0.75).abs() < 1e-12 && (mean[1] - 0.01 / 11.0).abs() < 1e-12);
        assert!((covariance[0] - 1.0 / 4e4).abs() < 1e-12 && (covariance[3] - 1.0 / 1.1e4).abs() < 1e-12);
    }
}
