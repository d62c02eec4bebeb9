//! How much light each photograph of a stack really took: the shutter's actual times, and a lamp that flickers.

use super::agreement::{linear_light, median_ratio};
use super::merge::BLOCK;
use super::{Exposure, Sensor};
use crate::capture::Samples;
use crate::cholesky::{log_determinant, solve};

/// Some pixels of one shot in all its photographs.
#[derive(Debug, Clone)]
pub struct Stack {
    /// Code values, R G B interleaved, and nominal times; shortest first.
    pub exposures: Vec<Exposure>,
    /// Which setting of the capture each has.
    pub settings: Vec<usize>,
}

/// Log light of each photograph of a stack against its stated time, as its own pixels tell it.
#[derive(Debug, Clone)]
pub struct StackScales {
    /// ln(actual / stated), with a common constant that a stack cannot tell.
    pub log_scale: Vec<f64>,
    /// Information matrix (inverse covariance) of these, row by row; the common constant is its null direction.
    pub information: Vec<f64>,
}

/// Pixels that rise from noise this far count: nearer to it the plug-in weights would bias.
const LEAST_SIGNAL_TO_NOISE: f32 = 4.0;
/// Standard deviations that a predicted value keeps from saturation, and beyond which a residual is not noise.
const MARGIN_SIGMA: f32 = 4.0;
const OUTLIER_SIGMA: f32 = 5.0;
/// While scales are known from medians only, a residual may be as large as one that is two thirds of a stop off.
const LOOSE: f32 = 0.6;
/// Prior standard deviation of ln(actual / stated) about what medians say: a stop. Only what is not measured at all is
/// held by it.
const PRIOR_SD: f64 = 0.7;
const ITERATIONS: usize = 5;

/// Sums over pixels of a linearized stack.
struct Sums {
    score: Vec<f64>,
    information: Vec<f64>,
    chi2: f64,
    freedom: f64,
}

impl Sums {
    fn new(n: usize) -> Self {
        Self { score: vec![0.0; n], information: vec![0.0; n * n], chi2: 0.0, freedom: 0.0 }
    }
}

/// Log scales of a stack's photographs by weighted least squares: at each pixel y_j = L t_j exp(δ_j), with L
/// eliminated.
///
/// Weights are signal² / variance at the pooled light, so that a residual and its weight are uncorrelated. Only values
/// that the other exposures predict to be unsaturated and above noise count. `parts` are rectangles of one shot, the
/// same photographs in each. `stride` leaves out all but every so many blocks of pixels. `None` with fewer than two
/// exposures or nothing that two of them measured.
///
/// Not detected: light that changes within the picture, a wrong response curve (it looks like wrong times).
pub fn stack_scales(parts: &[&[Exposure]], sensor: &Sensor, stride: usize) -> Option<StackScales> {
    let exposures = *parts.first()?;
    let n = exposures.len();
    if n < 2 {
        return None;
    }
    let log_scale = start(parts, sensor, stride);
    // Wrong times may stand in the wrong order.
    let mut order: Vec<usize> = (0..n).collect();
    let actual = |j: usize| exposures[j].secs * log_scale[j].exp();
    order.sort_by(|&a, &b| actual(a).total_cmp(&actual(b)));
    let sorted: Vec<Vec<&Exposure>> = parts.iter().map(|part| order.iter().map(|&j| &part[j]).collect()).collect();
    let mut log_scale: Vec<f64> = order.iter().map(|&j| log_scale[j]).collect();
    let start = log_scale.clone();
    let mut information = vec![0.0; n * n];
    for round in 0..ITERATIONS {
        let secs: Vec<f32> =
            order.iter().zip(&log_scale).map(|(&j, s)| (exposures[j].secs * f64::exp(*s)) as f32).collect();
        let mut sums = Sums::new(n);
        sorted.iter().for_each(|part| accumulate(part, &secs, sensor, stride, round < 2, &mut sums));
        if sums.freedom < 1.0 {
            return None;
        }
        // Noise that the rig understates makes everything less certain.
        let excess = (sums.chi2 / sums.freedom).max(1.0);
        information = sums.information.iter().map(|v| v / excess).collect();
        let mut system = information.clone();
        (0..n).for_each(|j| system[j * n + j] += PRIOR_SD.powi(-2));
        let right = (0..n).map(|j| sums.score[j] / excess - (log_scale[j] - start[j]) * PRIOR_SD.powi(-2)).collect();
        let step = solve(system, right)?;
        log_scale.iter_mut().zip(&step).for_each(|(s, d)| *s += d.clamp(-0.7, 0.7));
        if step.iter().all(|d| d.abs() < 1e-6) && round >= 2 {
            break;
        }
    }
    // Back in the order of the stated times.
    let mut found = StackScales { log_scale: vec![0.0; n], information: vec![0.0; n * n] };
    for (a, &j) in order.iter().enumerate() {
        found.log_scale[j] = log_scale[a];
        order.iter().enumerate().for_each(|(b, &i)| found.information[j * n + i] = information[a * n + b]);
    }
    Some(found)
}

/// Log scales from the medians of the ratios of neighbours, however wrong the times are; 0 on average.
fn start(parts: &[&[Exposure]], sensor: &Sensor, stride: usize) -> Vec<f64> {
    let light = linear_light(parts, sensor, stride);
    let n = light.len();
    let mut log_scale = vec![0.0; n];
    for j in 1..n {
        let ratio = median_ratio([&light[j - 1], &light[j]], sensor).map_or(1.0, |r| r.median);
        log_scale[j] = log_scale[j - 1] + f64::from(ratio).ln();
    }
    let mean = log_scale.iter().sum::<f64>() / n.max(1) as f64;
    log_scale.iter().map(|s| s - mean).collect()
}

fn accumulate(exposures: &[&Exposure], secs: &[f32], sensor: &Sensor, stride: usize, loose: bool, sums: &mut Sums) {
    let n = exposures.len();
    let samples = exposures.iter().map(|e| e.samples.len()).min().unwrap_or(0);
    let mut linear = vec![[0.0f32; BLOCK]; n];
    let mut here = Here::new(n);
    for first in (0..samples).step_by(BLOCK * stride.max(1)) {
        let len = BLOCK.min(samples - first);
        for (y, e) in linear.iter_mut().zip(exposures) {
            sensor.linearize(&e.samples, first, &mut y[..len]);
        }
        for k in 0..len {
            if here.look(&linear, k, secs, sensor, loose) {
                here.add_to(sums);
            }
        }
    }
}

/// One pixel and channel in all exposures: weights (0 where unusable) and relative residuals.
pub(super) struct Here {
    pub(super) weight: Vec<f64>,
    pub(super) residual: Vec<f64>,
    /// Predicted linear value in each exposure.
    pub(super) mean: Vec<f32>,
    variance: Vec<f32>,
}

impl Here {
    pub(super) fn new(n: usize) -> Self {
        Self { weight: vec![0.0; n], residual: vec![0.0; n], mean: vec![0.0; n], variance: vec![0.0; n] }
    }

    /// Looks at sample `k`, which must be of channel k mod 3; whether two exposures or more measured it.
    pub(super) fn look(
        &mut self,
        linear: &[[f32; BLOCK]],
        k: usize,
        secs: &[f32],
        sensor: &Sensor,
        loose: bool,
    ) -> bool {
        let range = sensor.range();
        let (mut sum_y, mut sum_t) = (0.0f32, 0.0f32);
        for (y, &t) in linear.iter().map(|y| y[k]).zip(secs) {
            if y.is_finite() && sum_y * t <= 0.9 * range * sum_t {
                (sum_y, sum_t) = (sum_y + y, sum_t + t);
            }
        }
        if !(sum_y > 0.0) {
            return false;
        }
        let pooled = sum_y / sum_t;
        let (mut top, mut bottom, mut count) = (0.0f32, 0.0f32, 0);
        for (j, &t) in secs.iter().enumerate() {
            let mean = pooled * t;
            let variance = sensor.variance(mean, k % 3);
            let sd = variance.sqrt();
            let y = linear[j][k];
            let usable = y.is_finite() && mean + MARGIN_SIGMA * sd < range && mean > LEAST_SIGNAL_TO_NOISE * sd;
            self.variance[j] = if usable { variance } else { 0.0 };
            if usable {
                (top, bottom, count) = (top + y * t / variance, bottom + t * t / variance, count + 1);
            }
        }
        if count < 2 || !(top > 0.0) {
            return false;
        }
        let light = top / bottom;
        for (j, &t) in secs.iter().enumerate() {
            let variance = self.variance[j];
            self.weight[j] = 0.0;
            self.mean[j] = light * t;
            if variance > 0.0 {
                let residual = linear[j][k] / self.mean[j] - 1.0;
                let weight = self.mean[j] * self.mean[j] / variance;
                let limit = OUTLIER_SIGMA / weight.sqrt();
                if residual.abs() > if loose { limit.max(LOOSE) } else { limit } {
                    return false;
                }
                (self.weight[j], self.residual[j]) = (f64::from(weight), f64::from(residual));
            }
        }
        true
    }

    fn add_to(&self, sums: &mut Sums) {
        let n = self.weight.len();
        let total: f64 = self.weight.iter().sum();
        for j in 0..n {
            let w = self.weight[j];
            if w == 0.0 {
                continue;
            }
            sums.score[j] += w * self.residual[j];
            sums.chi2 += w * self.residual[j] * self.residual[j];
            sums.freedom += 1.0;
            sums.information[j * n + j] += w;
            for i in 0..n {
                sums.information[j * n + i] -= w * self.weight[i] / total;
            }
        }
        sums.freedom -= 1.0;
    }
}

/// What all stacks together say of the capture's exposure settings.
#[derive(Debug, Clone)]
pub struct ExposureFit {
    /// ln(actual / nominal) of each setting; its median over each group that stacks link is 0.
    pub log_scale: Vec<f64>,
    /// Variance of that.
    pub variance: Vec<f64>,
    /// Which group each setting belongs to.
    pub group: Vec<usize>,
    /// Standard deviation of a photograph's light about its setting's: flicker of the lamp, or a shutter that varies.
    /// `None` when the stacks show none beyond their noise.
    pub flicker_sd: Option<f64>,
    /// The stacks could not be solved for the scales: nothing is known of them.
    pub failed: bool,
}

/// The largest flicker that is looked for, relative: what seems to flicker more is something else.
pub const MOST_FLICKER: f64 = 0.1;

/// How much likelier (natural logarithm) flicker must make the stacks before it is believed.
const FLICKER_EVIDENCE: f64 = 3.0;

/// Generalized least squares over stacks: one log scale a setting, each photograph with a random deviation of its own
/// whose variance is found by maximum likelihood.
///
/// Anchored so that within each linked group the median of the log scales is 0: most nominal times are taken as right,
/// and a group that no stack links to another keeps its own nominal scale.
pub fn fit_exposures(stacks: &[(&Stack, StackScales)], settings: usize) -> ExposureFit {
    let stacks: Vec<Contrast> = stacks.iter().filter_map(|(s, scales)| Contrast::new(s, scales)).collect();
    let group = groups(&stacks, settings);
    let none = fit_given(&stacks, &group, 0.0);
    let candidates = (0..=60).map(|k| 1e-5 * 10f64.powf(f64::from(k) / 15.0));
    let best = candidates
        .map(|sd| (sd, fit_given(&stacks, &group, sd)))
        .max_by(|a, b| a.1.log_likelihood.total_cmp(&b.1.log_likelihood));
    let believed = best.filter(|(_, fit)| fit.log_likelihood > none.log_likelihood + FLICKER_EVIDENCE);
    let flicker_sd = believed.as_ref().map(|(sd, _)| *sd);
    let mut fit = believed.map_or(none, |(_, fit)| fit);
    for g in 0..settings {
        let members: Vec<usize> = (0..settings).filter(|&k| group[k] == g).collect();
        let mut scales: Vec<f64> = members.iter().map(|&k| fit.log_scale[k]).collect();
        scales.sort_by(f64::total_cmp);
        let Some(last) = scales.len().checked_sub(1) else { continue };
        let middle = 0.5 * (scales[last / 2] + scales[last.div_ceil(2)]);
        members.iter().for_each(|&k| fit.log_scale[k] -= middle);
    }
    let failed = fit.log_likelihood == f64::MIN;
    ExposureFit { log_scale: fit.log_scale, variance: fit.variance, group, flicker_sd, failed }
}

/// A stack reduced to the photographs that it measures.
struct Contrast {
    settings: Vec<usize>,
    log_scale: Vec<f64>,
    information: Vec<f64>,
}

impl Contrast {
    fn new(stack: &Stack, scales: &StackScales) -> Option<Self> {
        let n = scales.log_scale.len();
        // A photograph whose scale is not known to a tenth is treated as unmeasured.
        let kept: Vec<usize> = (0..n).filter(|&j| scales.information[j * n + j] > 100.0).collect();
        let information = kept.iter().flat_map(|&j| kept.iter().map(move |&i| scales.information[j * n + i])).collect();
        (kept.len() >= 2).then(|| Self {
            settings: kept.iter().map(|&j| stack.settings[j]).collect(),
            log_scale: kept.iter().map(|&j| scales.log_scale[j]).collect(),
            information,
        })
    }

    /// Inverse covariance of the contrasts when each photograph deviates by `sd` besides.
    fn weight(&self, sd: f64) -> Option<Vec<f64>> {
        let n = self.settings.len();
        if sd == 0.0 {
            return Some(self.information.clone());
        }
        // (Λ⁺ + σ² I)⁻¹ on the contrasts: Λ − Λ (Λ + I/σ²)⁻¹ Λ.
        let mut sum = self.information.clone();
        (0..n).for_each(|j| sum[j * n + j] += sd.powi(-2));
        let mut out = self.information.clone();
        for i in 0..n {
            let column = solve(sum.clone(), (0..n).map(|j| self.information[j * n + i]).collect())?;
            for j in 0..n {
                out[j * n + i] -= (0..n).map(|k| self.information[j * n + k] * column[k]).sum::<f64>();
            }
        }
        Some(out)
    }
}

fn groups(stacks: &[Contrast], settings: usize) -> Vec<usize> {
    let mut group: Vec<usize> = (0..settings).collect();
    for s in stacks {
        for pair in s.settings.windows(2) {
            let (a, b) = (group[pair[0]], group[pair[1]]);
            group.iter_mut().filter(|g| **g == a.max(b)).for_each(|g| *g = a.min(b));
        }
    }
    group
}

struct Given {
    log_scale: Vec<f64>,
    variance: Vec<f64>,
    log_likelihood: f64,
}

fn fit_given(stacks: &[Contrast], group: &[usize], sd: f64) -> Given {
    let m = group.len();
    let failed = || Given { log_scale: vec![0.0; m], variance: vec![PRIOR_SD * PRIOR_SD; m], log_likelihood: f64::MIN };
    let Some(weights) = stacks.iter().map(|s| s.weight(sd)).collect::<Option<Vec<_>>>() else { return failed() };
    let (mut system, mut right) = (vec![0.0; m * m], vec![0.0; m]);
    for (s, w) in stacks.iter().zip(&weights) {
        let n = s.settings.len();
        for j in 0..n {
            for i in 0..n {
                system[s.settings[j] * m + s.settings[i]] += w[j * n + i];
                right[s.settings[j]] += w[j * n + i] * s.log_scale[i];
            }
        }
    }
    // The mean of each group is 0: a term that only acts on it, of the weight of the rest.
    let anchor = (0..m).map(|k| system[k * m + k]).fold(1.0, f64::max);
    for a in 0..m {
        for b in (0..m).filter(|&b| group[a] == group[b]) {
            let size = group.iter().filter(|g| **g == group[a]).count();
            system[a * m + b] += anchor / size as f64;
        }
    }
    let Some(log_scale) = solve(system.clone(), right) else { return failed() };
    let mut variance = Vec::new();
    for a in 0..m {
        let unit = (0..m).map(|b| if a == b { 1.0 } else { 0.0 }).collect();
        let Some(column) = solve(system.clone(), unit) else { return failed() };
        let size = group.iter().filter(|g| **g == group[a]).count() as f64;
        // What the anchor itself seems to add is no uncertainty of the anchored scale.
        variance.push((column[a] - 1.0 / (anchor * size)).max(0.0));
    }
    // Restricted likelihood: the settings that are fitted take their share of the freedom.
    let Some(fitted) = log_determinant(system, m) else { return failed() };
    let groups = (0..m).filter(|g| group.contains(g)).count() as f64;
    let mut log_likelihood = 0.5 * (groups * anchor.ln() - fitted);
    for (s, w) in stacks.iter().zip(&weights) {
        let n = s.settings.len();
        let r: Vec<f64> = (0..n).map(|j| s.log_scale[j] - log_scale[s.settings[j]]).collect();
        let chi2: f64 = (0..n * n).map(|k| r[k / n] * w[k] * r[k % n]).sum();
        // The determinant over the contrasts: the common constant gets a weight of its own.
        let scale = (0..n).map(|j| w[j * n + j]).sum::<f64>() / n as f64;
        let full = (0..n * n).map(|k| w[k] + scale / n as f64).collect();
        let Some(log_determinant) = log_determinant(full, n) else { return failed() };
        log_likelihood += 0.5 * (log_determinant - scale.ln() - chi2);
    }
    Given { log_scale, variance, log_likelihood }
}

/// Pixels of a level of light that are kept of one shot.
const PIXELS_PER_LEVEL: usize = 300;
/// Levels in an octave of light.
const LEVELS_PER_OCTAVE: f32 = 2.0;

/// Picks pixels of a whole shot, as many of each level of light: bright dots are few, and dark pixels many.
///
/// The level is that of the pooled light, which residuals do not depend on; picking by the code values of one exposure
/// would keep its chance highs.
pub fn pick_pixels(exposures: &[Exposure], sensor: &Sensor) -> Vec<Exposure> {
    let pixels = exposures.iter().map(|e| e.samples.len()).min().unwrap_or(0) / 3;
    let secs: Vec<f32> = exposures.iter().map(|e| e.secs as f32).collect();
    let mut levels: std::collections::BTreeMap<i32, Vec<usize>> = std::collections::BTreeMap::new();
    let mut linear = vec![[0.0f32; BLOCK]; exposures.len()];
    for first in (0..3 * pixels).step_by(BLOCK) {
        let len = BLOCK.min(3 * pixels - first);
        for (y, e) in linear.iter_mut().zip(exposures) {
            sensor.linearize(&e.samples, first, &mut y[..len]);
        }
        for k in (0..len).step_by(3) {
            let (mut sum_y, mut sum_t) = (0.0f32, 0.0f32);
            for (y, &t) in linear.iter().zip(&secs) {
                let green = y[k + 1];
                if green.is_finite() && sum_y * t <= 0.9 * sensor.range() * sum_t {
                    (sum_y, sum_t) = (sum_y + green, sum_t + t);
                }
            }
            if sum_y > 0.0 {
                levels.entry((LEVELS_PER_OCTAVE * (sum_y / sum_t).log2()) as i32).or_default().push((first + k) / 3);
            }
        }
    }
    let mut picked: Vec<usize> = Vec::new();
    for level in levels.into_values() {
        picked.extend(evenly(&level, PIXELS_PER_LEVEL));
    }
    picked.sort_unstable();
    exposures.iter().map(|e| Exposure { samples: take(&e.samples, &picked), secs: e.secs }).collect()
}

/// At most `most` of `all`, evenly spaced.
pub(crate) fn evenly<T: Copy>(all: &[T], most: usize) -> impl Iterator<Item = T> + '_ {
    let n = all.len().min(most);
    (0..n).map(move |k| all[(2 * k + 1) * all.len() / (2 * n)])
}

/// The code values of some pixels.
pub(crate) fn take(samples: &Samples, pixels: &[usize]) -> Samples {
    fn of<T: Copy>(v: &[T], pixels: &[usize]) -> Vec<T> {
        pixels.iter().flat_map(|&p| v[3 * p..3 * p + 3].iter().copied()).collect()
    }
    match samples {
        Samples::U8(v) => Samples::U8(of(v, pixels)),
        Samples::U16(v) => Samples::U16(of(v, pixels)),
        Samples::F32(v) => Samples::F32(of(v, pixels)),
    }
}

#[cfg(test)]
mod tests;
