//! An unknown response curve, from the capture's own stacks and from light that adds up.

use super::{CODES, Curve, FULL};
use crate::capture::{Noise, Samples};
use crate::cholesky::solve;
use crate::radiance::exposures::{Here, Stack};
use crate::radiance::merge::BLOCK;
use crate::radiance::{FileNoise, Sensor};
use rayon::prelude::*;

/// Two photographs whose light adds up to that of two others: a pattern, its inverse, white and black, all of one
/// exposure time.
#[derive(Debug, Clone)]
pub struct LightSum {
    /// Code values of the pattern and its inverse, R G B interleaved, the same pixels in each.
    pub parts: [Samples; 2],
    /// Those of white.
    pub whole: Samples,
    /// Linear light of black in that exposure time, DN; little.
    pub black: Vec<f32>,
    /// How much half the inverse's linear light less half the pattern's (of any curve near the right one) grows from
    /// pixel to pixel along the picture's rows and columns, DN.
    pub slope: [Vec<f32>; 2],
}

/// Settings of [`estimate_curve`].
#[derive(Debug, Clone, Copy)]
pub struct CurveOptions {
    /// Standard deviation of ln(actual / nominal) that the exposure times are trusted to.
    pub times_sd: f64,
    /// Rounding and compression.
    pub file: FileNoise,
}

/// An estimated curve.
#[derive(Debug, Clone)]
pub struct CurveEstimate {
    /// The curve, with its uncertainty.
    pub curve: Curve,
    /// Squared residuals over their degrees of freedom: 1 when the noise is as the rig says.
    pub reduced_chi2: f64,
    /// Number of code values that it rests on.
    pub observations: usize,
}

/// Cubic B-splines in ln(code + [`OFFSET`]): fine where curves bend.
const INTERVALS: usize = 14;
const COEFFICIENTS: usize = INTERVALS + 3;
const OFFSET: f64 = 8.0;
/// Below this code value a power law leads to 0: clipping at black makes means there too large.
const LEAST_CODE: f64 = 4.0;
/// Prior standard deviation of second differences of coefficients: sRGB has 0.05, film-like curves 0.2.
const BEND_SD: f64 = 0.3;
/// Prior standard deviation of a lamp's change from one photograph to another.
const LAMP_SD: f64 = 0.02;
/// And of what compression does to all edges of a pattern alike, where dark parts cannot tell the lamp's change.
const COMPRESSED_LAMP_SD: f64 = 0.004;
/// Prior standard deviation of how far pattern and inverse moved against each other, camera px.
const MOVED_SD_PX: f64 = 0.7;
/// The same where they have not.
const HELD_SD_PX: f64 = 1e-6;
/// Unknowns of a light sum: the lamp's change in either part, and how far these moved against each other along both
/// axes.
const PER_SUM: usize = 4;
/// A light sum tells about the curve where both parts have at least this share of it.
const LEAST_SHARE: f64 = 0.1;
const ITERATIONS: usize = 15;
/// What a movement leaves is alike all along an edge: all samples of a sum tell no more than those of one profile,
/// eight px across a rising and a falling edge each.
const PROFILE_SAMPLES: f64 = 16.0;
/// A pattern and its inverse that lie this near to each other, camera px, add up but for noise, and no movement is
/// unknown: what JPEG does to edges looks like 0.05 px, photons and the curve's own error like 0.02 (still captures of
/// tests/all/radiometry.rs).
const STILL_PX: f64 = 0.1;
/// Fewer samples with light of both parts tell no variance of their own.
const LEAST_SHARED: usize = 50;
/// Compression errs for a block of pixels together: so many are one observation when curves are compared.
const BLOCK_PIXELS: f64 = 64.0;

/// Estimates ln g(z), g being the light of code value z, as a monotone curve; one for all channels, or one each when
/// the Bayesian information criterion says that they differ.
///
/// Weighted least squares over all unknowns at once: the curve's coefficients, the light of each pixel (eliminated),
/// one exposure time a setting with the prior `times_sd`. As in `MitsunagaNayar1999` curve and exposure ratios are
/// found together; stacks alone leave the ambiguity g → g^γ, t → t^γ (`GrossbergNayar2003`), which here is settled by
/// light sums: g(pattern) + g(inverse) = g(white) + g(black) holds for one γ only. A projector that moves between
/// pattern and inverse breaks that at the edges of stripes, where alone both have light: the movement is an unknown of
/// each sum, and what it leaves unexplained is added to the sum's variance. Weights are otherwise those of photon
/// statistics and of rounding and compression, at predicted values, not at the noisy ones.
///
/// `None` when the stacks have too little in common. Not detected: a curve that changes between photographs (automatic
/// tone mapping), crosstalk of channels (a colour matrix before the curve).
pub fn estimate_curve(
    stacks: &[Stack],
    sums: &[LightSum],
    settings: usize,
    noise: &Noise,
    options: &CurveOptions,
) -> Option<CurveEstimate> {
    let still = Problem { stacks, sums, settings, noise, options, moving: false };
    let first = still.fit(1, None)?;
    let moving = still.moved_px(&first)? > STILL_PX;
    let problem = Problem { moving, ..still };
    let common = if moving { problem.fit(1, None)? } else { first };
    let own = problem.fit(3, Some(&common));
    // Each channel of its own costs twice the coefficients.
    let blocks = if options.file.is_compressed() { BLOCK_PIXELS } else { 1.0 };
    let noise_scale = own.as_ref().map_or(1.0, |o| blocks * (o.chi2 / o.freedom).max(0.1));
    let penalty = (2 * COEFFICIENTS) as f64 * common.freedom.max(2.0).ln();
    let better = own.filter(|o| (common.chi2 - o.chi2) / noise_scale > penalty);
    better.unwrap_or(common).into_estimate()
}

struct Problem<'a> {
    stacks: &'a [Stack],
    sums: &'a [LightSum],
    settings: usize,
    noise: &'a Noise,
    options: &'a CurveOptions,
    /// Whether patterns and inverses have moved against each other.
    moving: bool,
}

/// Where a solution stands.
struct Fit {
    /// Of each curve, one after the other.
    coefficients: Vec<f64>,
    curves: usize,
    times: Vec<f64>,
    lamps: Vec<f64>,
    chi2: f64,
    freedom: f64,
    covariance_diagonal: Vec<Vec<f64>>,
}

/// Normal equations.
#[derive(Clone)]
struct System {
    size: usize,
    matrix: Vec<f64>,
    right: Vec<f64>,
    chi2: f64,
    freedom: f64,
}

impl System {
    fn new(size: usize) -> Self {
        Self { size, matrix: vec![0.0; size * size], right: vec![0.0; size], chi2: 0.0, freedom: 0.0 }
    }

    /// Adds weight · row rowᵀ, negative to take out.
    fn add(&mut self, row: &[(usize, f64)], residual: f64, weight: f64) {
        for &(i, a) in row {
            self.right[i] += weight * a * residual;
            for &(j, b) in row {
                self.matrix[i * self.size + j] += weight * a * b;
            }
        }
    }

    fn merge(mut self, other: Self) -> Self {
        self.matrix.iter_mut().zip(other.matrix).for_each(|(a, b)| *a += b);
        self.right.iter_mut().zip(other.right).for_each(|(a, b)| *a += b);
        self.chi2 += other.chi2;
        self.freedom += other.freedom;
        self
    }
}

impl Problem<'_> {
    fn fit(&self, curves: usize, from: Option<&Fit>) -> Option<Fit> {
        let lamps = PER_SUM * self.sums.len();
        let mut fit = Fit {
            coefficients: from.map_or_else(|| starting(&Curve::srgb()), |f| f.coefficients.clone()).repeat(curves),
            curves,
            times: from.map_or_else(|| vec![0.0; self.settings], |f| f.times.clone()),
            lamps: from.map_or_else(|| vec![0.0; lamps], |f| f.lamps.clone()),
            chi2: 0.0,
            freedom: 0.0,
            covariance_diagonal: vec![],
        };
        let unknowns = curves * COEFFICIENTS;
        let mut system = System::new(0);
        for round in 0..ITERATIONS {
            system = self.system(&fit, round < 4)?;
            let step = solve(system.matrix.clone(), system.right.clone())?;
            let largest = step.iter().fold(0.0f64, |m, s| m.max(s.abs()));
            let damp = (0.5 / largest).min(1.0);
            fit.coefficients.iter_mut().zip(&step).for_each(|(c, s)| *c += damp * s);
            fit.times.iter_mut().zip(&step[unknowns..]).for_each(|(t, s)| *t += damp * s);
            fit.lamps.iter_mut().zip(&step[unknowns + self.settings..]).for_each(|(l, s)| *l += damp * s);
            if largest < 1e-5 && round >= 5 {
                break;
            }
        }
        if system.freedom < 100.0 {
            return None;
        }
        (fit.chi2, fit.freedom) = (system.chi2, system.freedom);
        fit.covariance_diagonal = (0..curves).map(|c| code_variance(&system, c)).collect::<Option<_>>()?;
        Some(fit)
    }

    fn system(&self, fit: &Fit, loose: bool) -> Option<System> {
        let curve = fit.curve(vec![vec![0.0; CODES]; fit.curves])?;
        let sensor = Sensor::with_curve(self.noise, Some(curve), self.options.file);
        let size = fit.coefficients.len() + self.settings + PER_SUM * self.sums.len();
        let stacks: Vec<System> =
            self.stacks.par_iter().map(|s| self.add_stack(s, fit, &sensor, System::new(size), loose)).collect();
        let sums: Vec<System> = self
            .sums
            .par_iter()
            .enumerate()
            .map(|(k, s)| self.add_sum(k, s, fit, &sensor, System::new(size), loose))
            .collect();
        // In order, so that the sum does not depend on the threads.
        let mut system = stacks.into_iter().chain(sums).fold(System::new(size), System::merge);
        self.add_priors(fit, &mut system);
        Some(system)
    }

    fn add_priors(&self, fit: &Fit, system: &mut System) {
        let base = fit.coefficients.len();
        for c in 0..fit.curves {
            let at = c * COEFFICIENTS;
            for k in 0..COEFFICIENTS - 2 {
                let row = [(at + k, 1.0), (at + k + 1, -2.0), (at + k + 2, 1.0)];
                let now: f64 = row.iter().map(|&(i, a)| a * fit.coefficients[i]).sum();
                system.add(&row, -now, BEND_SD.powi(-2));
            }
            // The scale: the largest code has the largest light.
            let (first, basis) = basis(FULL);
            let row: Vec<(usize, f64)> = (0..4).map(|m| (at + first + m, basis[m])).collect();
            let now: f64 = row.iter().map(|&(i, a)| a * fit.coefficients[i]).sum();
            system.add(&row, FULL.ln() - now, 1e8);
        }
        for (s, now) in fit.times.iter().enumerate() {
            system.add(&[(base + s, 1.0)], -now, self.options.times_sd.powi(-2));
        }
        for (l, now) in fit.lamps.iter().enumerate() {
            let lamp = if self.options.file.is_compressed() { COMPRESSED_LAMP_SD } else { LAMP_SD };
            let moved = if self.moving { MOVED_SD_PX } else { HELD_SD_PX };
            let sd = if l % PER_SUM < 2 { lamp } else { moved };
            system.add(&[(base + self.settings + l, 1.0)], -now, sd.powi(-2));
        }
    }

    /// Stacks: ln g(z_j) = ln L + ln t_j + δ at each pixel, ln L eliminated.
    fn add_stack(&self, stack: &Stack, fit: &Fit, sensor: &Sensor, mut system: System, loose: bool) -> System {
        let n = stack.exposures.len();
        let base = fit.coefficients.len();
        let time = |j: usize| stack.exposures[j].secs * fit.times[stack.settings[j]].exp();
        let secs: Vec<f32> = (0..n).map(|j| time(j) as f32).collect();
        let samples = stack.exposures.iter().map(|e| e.samples.len()).min().unwrap_or(0);
        let Some(curve) = sensor.curve() else { return system };
        let (mut here, mut linear) = (Here::new(n), vec![[0.0f32; BLOCK]; n]);
        let (mut row, mut mean) = (Vec::with_capacity(5), Vec::with_capacity(5 * n));
        for first in (0..samples).step_by(BLOCK) {
            let len = BLOCK.min(samples - first);
            for (y, e) in linear.iter_mut().zip(&stack.exposures) {
                sensor.linearize(&e.samples, first, &mut y[..len]);
            }
            for k in 0..len {
                if !here.look(&linear, k, &secs, sensor, loose) {
                    continue;
                }
                mean.clear();
                let (mut total, mut mean_residual) = (0.0, 0.0);
                let channel = (k % 3).min(fit.curves - 1);
                for j in 0..n {
                    let code = curve.code_at(k % 3, f64::from(here.mean[j]));
                    // Below it noise that black clips has another mean.
                    if here.weight[j] == 0.0 || code < LEAST_CODE {
                        continue;
                    }
                    let w = here.weight[j];
                    let (at, basis) = basis(code);
                    row.clear();
                    row.extend((0..4).map(|m| (channel * COEFFICIENTS + at + m, -basis[m])));
                    row.push((base + stack.settings[j], 1.0));
                    system.add(&row, here.residual[j], w);
                    mean.extend(row.iter().map(|&(i, a)| (i, w * a)));
                    total += w;
                    mean_residual += w * here.residual[j];
                    system.chi2 += w * here.residual[j] * here.residual[j];
                    system.freedom += 1.0;
                }
                if total > 0.0 {
                    system.add(&merged(&mut mean), mean_residual, -1.0 / total);
                    system.chi2 -= mean_residual * mean_residual / total;
                    system.freedom -= 1.0;
                }
            }
        }
        system
    }

    /// Light sums: g(a) exp(−α) + g(b) exp(−β) + s · ∇(b − a)/2 = g(white) + black, α and β being the lamp's changes, s
    /// how far b has moved against a. With the slope of both, no term of s² is left.
    fn add_sum(
        &self,
        number: usize,
        sum: &LightSum,
        fit: &Fit,
        sensor: &Sensor,
        mut system: System,
        loose: bool,
    ) -> System {
        let Some(curve) = sensor.curve() else { return system };
        let lamp = fit.coefficients.len() + self.settings + PER_SUM * number;
        let lamps = [0, 1].map(|p| fit.lamps[PER_SUM * number + p].exp().recip());
        let moved = [2, 3].map(|p| fit.lamps[PER_SUM * number + p]);
        let unexplained = self.unexplained(sum, sensor, lamps, moved);
        let samples = sum.whole.len().min(sum.black.len());
        let compressed = self.options.file.is_compressed();
        let mut linear = [[0.0f32; BLOCK]; 3];
        let mut row = Vec::with_capacity(16);
        for first in (0..samples).step_by(BLOCK) {
            let len = BLOCK.min(samples - first);
            for (y, of) in linear.iter_mut().zip([&sum.parts[0], &sum.parts[1], &sum.whole]) {
                sensor.linearize(of, first, &mut y[..len]);
            }
            for k in 0..len {
                let at = first + k;
                let Some(seen) = SumSample::of(sum, at, linear.map(|y| y[k]), lamps, moved, sensor) else { continue };
                let SumSample { lights, variance, expected, slope, excess } = seen;
                let (residual, total) = (excess / expected, seen.total_variance());
                let noise = total / (expected * expected);
                // Where the light of both meets, they have moved.
                let weight = 1.0 / if seen.is_shared() { noise + unexplained } else { noise };
                if residual.abs() > (5.0 / weight.sqrt()).max(if loose { 0.5 } else { 0.0 }) || noise > 0.01 {
                    continue;
                }
                // The row is taken at the values that fit: at the noisy ones it would correlate with the residual.
                let [a, b, whole] = [
                    lights[0] + excess * variance[0] / total,
                    lights[1] + excess * variance[1] / total,
                    lights[2] - excess * variance[2] / total,
                ];
                let shared = share_light(a, b);
                // Compression rings in the dark part, where black clips it: its mean is no longer that of the light.
                if compressed && !shared {
                    continue;
                }
                row.clear();
                // Where one part is all there is, the curve cancels and the lamp's change is seen.
                for (light, sign) in [(a, 1.0), (b, 1.0), (whole, -1.0)] {
                    let code = curve.code_at(k % 3, light);
                    if shared && code >= LEAST_CODE {
                        let channel = (k % 3).min(fit.curves - 1);
                        let (at, basis) = basis(code);
                        row.extend(
                            (0..4).map(|m| (channel * COEFFICIENTS + at + m, sign * light / expected * basis[m])),
                        );
                    }
                }
                row.push((lamp, -a / expected));
                row.push((lamp + 1, -b / expected));
                if shared && self.moving {
                    row.extend([0, 1].map(|axis| (lamp + 2 + axis, slope[axis] / expected)));
                }
                system.add(&merged(&mut row), residual, weight);
                system.chi2 += weight * residual * residual;
                system.freedom += 1.0;
            }
        }
        system
    }
}

/// Whether either part of a light sum has enough of it to tell about the curve.
fn share_light(a: f64, b: f64) -> bool {
    a.min(b) > LEAST_SHARE * (a + b)
}

/// Linear values of all samples.
fn linearized(samples: &Samples, sensor: &Sensor) -> Vec<f32> {
    let mut all = vec![0.0; samples.len()];
    sensor.linearize(samples, 0, &mut all);
    all
}

/// What a light sum shows in one sample.
#[derive(Debug, Clone, Copy)]
struct SumSample {
    /// Light of pattern, inverse (the lamp's changes taken out) and white, DN.
    lights: [f64; 3],
    variance: [f64; 3],
    /// Light of white and black together.
    expected: f64,
    slope: [f64; 2],
    /// What white and black have more than pattern and inverse, moved as they are.
    excess: f64,
}

impl SumSample {
    /// Sample `at`, whose linear values are `linear`; `None` where it is saturated or dark.
    fn of(
        sum: &LightSum,
        at: usize,
        linear: [f32; 3],
        lamps: [f64; 2],
        moved: [f64; 2],
        sensor: &Sensor,
    ) -> Option<Self> {
        let [a, b, whole] = linear.map(f64::from);
        let [a, b] = [a * lamps[0], b * lamps[1]];
        let expected = whole + f64::from(sum.black[at]);
        if !(a + b + whole).is_finite() || !(expected > 0.0) || a + b <= 0.0 {
            return None;
        }
        let lights = [a, b, whole];
        let slope = [0, 1].map(|axis| f64::from(sum.slope[axis][at]));
        Some(Self {
            lights,
            variance: lights.map(|v| f64::from(sensor.variance(v as f32, at % 3))),
            expected,
            slope,
            excess: expected - a - b - moved[0] * slope[0] - moved[1] * slope[1],
        })
    }

    fn total_variance(&self) -> f64 {
        self.variance.iter().sum()
    }

    fn is_shared(&self) -> bool {
        share_light(self.lights[0], self.lights[1])
    }
}

impl Problem<'_> {
    /// How far patterns and inverses have moved against each other, camera px, root mean square over the sums, by a
    /// solution that knows of no movement: what is left of a sum changes its sign from the rising to the falling edges
    /// of its stripes where it moved, and does not where the curve is wrong.
    fn moved_px(&self, fit: &Fit) -> Option<f64> {
        let sensor =
            Sensor::with_curve(self.noise, Some(fit.curve(vec![vec![0.0; CODES]; fit.curves])?), self.options.file);
        let square = |(number, sum): (usize, &LightSum)| {
            let lamps = [0, 1].map(|p| fit.lamps[PER_SUM * number + p].exp().recip());
            let lights = [&sum.parts[0], &sum.parts[1], &sum.whole].map(|of| linearized(of, &sensor));
            let (mut matrix, mut right) = (vec![1e-9, 0.0, 0.0, 1e-9], vec![0.0; 2]);
            for k in 0..lights[0].len().min(sum.black.len()) {
                let seen = SumSample::of(sum, k, lights.each_ref().map(|l| l[k]), lamps, [0.0; 2], &sensor);
                let Some(seen) = seen.filter(SumSample::is_shared) else { continue };
                for i in 0..2 {
                    right[i] += seen.slope[i] * seen.excess;
                    (0..2).for_each(|j| matrix[2 * i + j] += seen.slope[i] * seen.slope[j]);
                }
            }
            solve(matrix, right).map_or(0.0, |s| s[0] * s[0] + s[1] * s[1])
        };
        let squares: f64 = self.sums.par_iter().enumerate().map(square).collect::<Vec<f64>>().iter().sum();
        Some((squares / self.sums.len().max(1) as f64).sqrt())
    }

    /// Variance of a sum's relative residual where both parts have light, beyond that of noise: by the median of its
    /// absolute values.
    fn unexplained(&self, sum: &LightSum, sensor: &Sensor, lamps: [f64; 2], moved: [f64; 2]) -> f64 {
        if !self.moving {
            return 0.0;
        }
        let [a, b, whole] = [&sum.parts[0], &sum.parts[1], &sum.whole].map(|of| linearized(of, sensor));
        let (mut residuals, mut noise, mut explained) = (Vec::new(), Vec::new(), Vec::new());
        for k in 0..a.len().min(sum.black.len()) {
            let seen = SumSample::of(sum, k, [a[k], b[k], whole[k]], lamps, moved, sensor);
            let Some(seen) = seen.filter(SumSample::is_shared) else { continue };
            explained.push((moved[0] * seen.slope[0] + moved[1] * seen.slope[1]).abs() / seen.expected);
            residuals.push((seen.excess / seen.expected).abs());
            noise.push(seen.total_variance() / (seen.expected * seen.expected));
        }
        if residuals.len() < LEAST_SHARED {
            return 0.0;
        }
        let middle = |values: &mut Vec<f64>| {
            let half = values.len() / 2;
            *values.select_nth_unstable_by(half, f64::total_cmp).1
        };
        let samples = residuals.len() as f64;
        let own = ((1.4826 * middle(&mut residuals)).powi(2) - middle(&mut noise)).max(0.0);
        // A movement of a good part of a pixel is no slope: a term of its third power is left, a twelfth of it across
        // edges about a pixel wide.
        let third = (moved[0].powi(2) + moved[1].powi(2)) / 12.0 * middle(&mut explained);
        (own + third * third) * (samples / PROFILE_SAMPLES).max(1.0)
    }
}

/// Sums entries of the same index.
fn merged(row: &mut [(usize, f64)]) -> Vec<(usize, f64)> {
    row.sort_unstable_by_key(|e| e.0);
    let mut out: Vec<(usize, f64)> = Vec::with_capacity(row.len());
    for &(i, a) in row.iter() {
        match out.last_mut() {
            Some(last) if last.0 == i => last.1 += a,
            _ => out.push((i, a)),
        }
    }
    out
}

/// First of the four basis functions at a code value, and their values.
fn basis(code: f64) -> (usize, [f64; 4]) {
    let x = ((code + OFFSET).ln() - OFFSET.ln()) / ((FULL + OFFSET).ln() - OFFSET.ln()) * INTERVALS as f64;
    let first = (x as usize).min(INTERVALS - 1);
    let t = x - first as f64;
    let u = 1.0 - t;
    let values = [
        u * u * u / 6.0,
        (3.0 * t * t * t - 6.0 * t * t + 4.0) / 6.0,
        (3.0 * u * u * u - 6.0 * u * u + 4.0) / 6.0,
        t * t * t / 6.0,
    ];
    (first, values)
}

/// Coefficients of a known curve, by least squares over codes.
fn starting(curve: &Curve) -> Vec<f64> {
    let mut system = System::new(COEFFICIENTS);
    for code in LEAST_CODE as usize..CODES {
        let (first, basis) = basis(code as f64);
        let row: Vec<(usize, f64)> = (0..4).map(|m| (first + m, basis[m])).collect();
        system.add(&row, curve.linear_at(0, code as f64).ln(), 1.0);
    }
    for k in 0..COEFFICIENTS - 2 {
        system.add(&[(k, 1.0), (k + 1, -2.0), (k + 2, 1.0)], 0.0, 1e-4);
    }
    solve(system.matrix, system.right).unwrap_or_else(|| vec![0.0; COEFFICIENTS])
}

/// Variance of ln g at each code against half the range, of curve `c`.
fn code_variance(system: &System, c: usize) -> Option<Vec<f64>> {
    let n = system.size;
    let scale = (system.chi2 / system.freedom).max(1.0);
    let vector = |code: f64| {
        let (first, basis) = basis(code);
        let mut v = vec![0.0; n];
        (0..4).for_each(|m| v[c * COEFFICIENTS + first + m] = basis[m]);
        v
    };
    let middle = vector(188.0);
    (0..CODES)
        .map(|code| {
            let mut v = vector((code as f64).max(LEAST_CODE));
            v.iter_mut().zip(&middle).for_each(|(a, b)| *a -= b);
            let column = solve(system.matrix.clone(), v.clone())?;
            Some(scale * v.iter().zip(&column).map(|(a, b)| a * b).sum::<f64>().max(0.0))
        })
        .collect()
}

impl Fit {
    /// Tables of the coefficients, made monotone.
    fn curve(&self, relative_sd: Vec<Vec<f64>>) -> Option<Curve> {
        let tables = self.coefficients.chunks(COEFFICIENTS).map(|coefficients| {
            let log = |code: f64| {
                let (first, basis) = basis(code);
                (0..4).map(|m| basis[m] * coefficients[first + m]).sum::<f64>()
            };
            let h = 0.5;
            let power = LEAST_CODE * (log(LEAST_CODE + h) - log(LEAST_CODE - h)) / (2.0 * h);
            let power = power.clamp(0.5, 3.0);
            let mut table: Vec<f64> = (0..CODES)
                .map(|k| match k as f64 {
                    code if code < LEAST_CODE => log(LEAST_CODE).exp() * (code / LEAST_CODE).powf(power),
                    code => log(code).exp(),
                })
                .collect();
            // Nothing but noise makes it fall: the least rise then.
            for k in 1..CODES {
                table[k] = table[k].max(table[k - 1] * (1.0 + 1e-6) + 1e-9);
            }
            table
        });
        Curve::new(tables.collect(), relative_sd)
    }

    fn into_estimate(self) -> Option<CurveEstimate> {
        let sd = self.covariance_diagonal.iter().map(|v| v.iter().map(|v| v.sqrt()).collect()).collect();
        Some(CurveEstimate {
            curve: self.curve(sd)?,
            reduced_chi2: self.chi2 / self.freedom,
            observations: self.freedom as usize,
        })
    }
}

#[cfg(test)]
mod tests;
