//! A lamp that flickers: how much, and what of it can be taken out.
//!
//! Three scales are measured, and only when the capture's stacks show flicker at all:
//! - a photograph against the others of its stack, from the pixels that several measured (`radiance/exposures.rs`), drawn towards none by
//!   the flicker of the whole capture;
//! - a stack against the other stacks, from the light of the reference dots on the opaque frame;
//! - the white reference against the Gray-code shots, each of which adds up with its inverse to the same white.

use super::lattice::{Prepared, STILL};
use crate::capture::Rect;
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance, Sensor, evenly, solve, stack_scales};
use crate::registration::measure_drift;
use crate::{Result, Warning};
use rayon::prelude::*;

/// Flicker of a capture.
#[derive(Debug, Clone)]
pub(super) struct Flicker {
    /// Standard deviation of a photograph's light, relative.
    sd: f64,
    level: Option<Level>,
    /// Relative variance that remains in the white reference.
    white_variance: f64,
}

/// The light of the reference dots, over some shots.
#[derive(Debug, Clone)]
struct Level {
    /// Mean light of each dot and channel; `None` where it was not measured.
    mean: Vec<Option<f64>>,
    /// Variance of a shot's level about the mean, beyond that of its measurement.
    variance: f64,
    /// Variance of the mean itself.
    mean_variance: f64,
}

/// Light of each reference dot and channel in one shot with its variance, `None` where no exposure measured it.
type DotLight = Vec<Option<[f64; 2]>>;

/// Lattice shots whose reference dots make the mean. Their own flicker is in it: a sixth of a shot's.
const SHOTS: usize = 36;
/// Samples of a shot that are looked at: more would not know the scales any better than they flicker.
const SAMPLES: usize = 60_000;

/// A photograph that is off by more than this many standard deviations of the flicker is off by something else.
const FLICKER_SIGMA: f64 = 5.0;

impl Flicker {
    /// Looks at the reference dots of some lattice shots; `None` when the stacks showed no flicker.
    pub fn measure(prepared: &Prepared) -> Result<Option<Self>> {
        let Some(sd) = prepared.shots.radiometry.flicker_sd else { return Ok(None) };
        // Unknown, the white reference deviates as any photograph does.
        let white_variance = prepared.white_variance.unwrap_or(sd * sd);
        let mut flicker = Self { sd, level: None, white_variance };
        if prepared.reference_mm().is_empty() {
            return Ok(Some(flicker));
        }
        let shots: Vec<usize> = evenly(&prepared.lattice(), SHOTS).collect();
        let lights: Vec<Option<DotLight>> = shots
            .par_iter()
            .map(|&shot| {
                let mut seen = prepared.shots.decode(shot, &prepared.reference_rects(shot)?)?;
                flicker.steady_stack(&prepared.shots.sensor, seen.iter_mut().collect());
                Ok(prepared.reference_light(&seen))
            })
            .collect::<Result<_>>()?;
        flicker.level = Level::of(&lights.into_iter().flatten().collect::<Vec<_>>());
        Ok(Some(flicker))
    }

    /// Takes what can be taken out of a shot's exposure times; returns the relative variance that remains, common to its rows.
    pub fn steady(&self, prepared: &Prepared, references: &mut [Bracket], windows: &mut [Bracket]) -> f64 {
        let both = references.iter_mut().chain(windows.iter_mut()).collect();
        let [common, own] = self.steady_stack(&prepared.shots.sensor, both);
        let light = self.level.as_ref().and_then(|level| Some((level, prepared.reference_light(references)?)));
        let found = light.and_then(|(level, light)| level.scale_of(&light));
        let Some((log_level, left)) = found else { return common + own + self.white_variance };
        for bracket in references.iter_mut().chain(windows) {
            bracket.scale_secs(&vec![log_level.exp(); bracket.exposures().len()]);
        }
        left + own + self.white_variance
    }

    /// Corrects the times of a stack's photographs against each other. Returns the relative variances that remain: one that all have in
    /// common, and the mean of what each has besides.
    fn steady_stack(&self, sensor: &Sensor, brackets: Vec<&mut Bracket>) -> [f64; 2] {
        let samples: usize = brackets.iter().map(|b| 3 * b.rect().area()).sum();
        let parts: Vec<_> = brackets.iter().map(|b| b.exposures()).collect();
        let n = parts.first().map_or(1, |p| p.len());
        let prior = self.sd * self.sd;
        let untouched = [prior / n as f64, prior * (1.0 - 1.0 / n as f64)];
        let scales = stack_scales(&parts, sensor, samples.div_ceil(SAMPLES));
        let found = scales.and_then(|s| shrink(&s.log_scale, &s.information, prior));
        let Some((log_scale, covariance)) = found else { return untouched };
        // Times or a response curve that are wrong differ alike in every stack: that is told elsewhere, and is no flicker.
        if log_scale.iter().any(|s| s.abs() > FLICKER_SIGMA * self.sd) {
            return untouched;
        }
        let factors: Vec<f64> = log_scale.iter().map(|s| s.exp()).collect();
        brackets.into_iter().for_each(|b| b.scale_secs(&factors));
        let common = covariance.iter().sum::<f64>() / (n * n) as f64;
        let mean = (0..n).map(|j| covariance[j * n + j]).sum::<f64>() / n as f64;
        [common, (mean - common).max(0.0)]
    }

    /// What to tell people, given the mean relative variance that remains.
    pub fn warning(&self, remaining: f64) -> Warning {
        Warning::Flicker { relative_sd: self.sd, remaining_sd: remaining.sqrt() }
    }

    /// For the provenance.
    pub fn record(&self, remaining: f64) -> serde_json::Value {
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

impl Level {
    fn of(lights: &[DotLight]) -> Option<Self> {
        let shots = lights.len();
        let mean: Vec<Option<f64>> = (0..lights.first()?.len())
            .map(|k| {
                let all: Vec<f64> = lights.iter().filter_map(|l| l[k]).map(|[light, _]| light).collect();
                // A dot that some shots do not measure would give them another mean.
                (all.len() == shots).then(|| all.iter().sum::<f64>() / shots as f64).filter(|m| *m > 0.0)
            })
            .collect();
        let mut level = Self { mean, variance: 0.0, mean_variance: 0.0 };
        let found: Vec<(f64, f64)> = lights.iter().filter_map(|l| level.measured(l)).collect();
        if found.len() < 4 {
            return None;
        }
        let n = found.len() as f64;
        let spread = found.iter().map(|(level, _)| level * level).sum::<f64>() / (n - 1.0);
        let noise = found.iter().map(|(_, variance)| variance).sum::<f64>() / n;
        // Significant: the spread of n shots is known to √(2/n) of itself.
        let excess = spread - noise;
        level.variance = if excess > 3.0 * noise * (2.0 / n).sqrt() { excess } else { 0.0 };
        level.mean_variance = spread / n;
        (level.variance > 0.0).then_some(level)
    }

    /// Logarithm of a shot's light over the mean, and its variance.
    fn measured(&self, light: &DotLight) -> Option<(f64, f64)> {
        let (mut top, mut bottom) = (0.0, 0.0);
        for (mean, light) in self.mean.iter().zip(light) {
            let (Some(mean), Some([light, variance])) = (mean, light) else { continue };
            let weight = mean * mean / variance.max(1e-12 * mean * mean);
            top += weight * (light / mean - 1.0);
            bottom += weight;
        }
        (bottom > 0.0).then(|| (top / bottom, 1.0 / bottom))
    }

    /// The level of a shot, drawn towards none, and the variance that remains.
    fn scale_of(&self, light: &DotLight) -> Option<(f64, f64)> {
        let (level, variance) = self.measured(light)?;
        let share = self.variance / (self.variance + variance);
        Some((share * level, share * variance + self.mean_variance))
    }
}

impl Prepared<'_> {
    /// Light of the reference dots where the drift has put them.
    fn reference_light(&self, seen: &[Bracket]) -> Option<DotLight> {
        let pictures: Vec<(Point, Radiance)> =
            self.reference_mm().into_iter().zip(seen).map(|(p, b)| (p, self.picture(b, b.rect(), STILL))).collect();
        let moved = measure_drift(&pictures, &self.registration, self.dot_radius_px())?.slab_mm;
        let reach = self.dot_radius_px() + 2.0;
        let light = |(p, picture): &(Point, Radiance)| {
            let at = self.registration.view.camera_from_slab([p[0] + moved[0], p[1] + moved[1]]);
            self.light_around(picture, at, reach)
        };
        Some(pictures.iter().flat_map(light).collect())
    }

    /// Light within a square of half side `reach`, its border pixels by their share, so that it does not jump when a dot moves.
    fn light_around(&self, picture: &Radiance, at: Point, reach: f64) -> [Option<[f64; 2]>; 3] {
        let Rect { x, y, width, height } = picture.rect;
        let mut sum = [Some([0.0; 2]); 3];
        let share = |pixel: usize, center: f64| (reach + 0.5 - (pixel as f64 - center).abs()).clamp(0.0, 1.0);
        let inside = |a: usize, first: usize, size: usize| {
            at[a] - reach >= first as f64 && at[a] + reach <= (first + size - 1) as f64
        };
        if !inside(0, x, width) || !inside(1, y, height) {
            return [None; 3];
        }
        for py in y..y + height {
            for px in x..x + width {
                let share = share(px, at[0]) * share(py, at[1]);
                if share == 0.0 {
                    continue;
                }
                let weight = share * f64::from(self.irradiance.sensitivity().inverse_at(px, py));
                let k = picture.at(px, py);
                for (c, sum) in sum.iter_mut().enumerate() {
                    *sum = sum.filter(|_| picture.used[k + c] > 0).map(|[light, variance]| {
                        let value = f64::from(picture.value[k + c]);
                        [light + weight * value, variance + weight * weight * f64::from(picture.variance[k + c])]
                    });
                }
            }
        }
        sum
    }
}
