//! Whether the photographs of one shot show the same light.

use super::merge::BLOCK;
use super::{Exposure, Sensor};
use crate::capture::Samples;

/// A photograph of a stack that does not show what the others show.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Disagreement {
    /// Which of the exposures.
    pub photograph: usize,
    /// Another one that may be the wrong one as well: with two photographs neither is told from the other.
    pub or: Option<usize>,
    /// Share of the samples with light that differ, of all pairs with that photograph, 0 to 1.
    pub share: f64,
    /// How many times as bright as the others say it is, when it shows the same and is brighter or darker alike all
    /// over.
    pub factor: Option<f64>,
}

/// What is expected of the brightness of a stack's photographs.
#[derive(Debug, Clone, Copy)]
pub struct Brightness<'a> {
    /// ln(actual / stated) of each exposure time, with any constant in common.
    pub log_scale: &'a [f64],
    /// By how much a photograph's logarithm may be off: flicker, a shutter that varies.
    pub tolerance: f64,
}

/// Light that is this many standard deviations of its noise above none is told from none, and a difference of as many
/// is no noise: one sample in 10⁹.
const SIGMA: f32 = 6.0;
/// Relative difference that is put down to what noise does not hold: photosites, the response curve, a lens that
/// breathes.
const TOLERANCE: f32 = 0.08;
/// Lossy compression moves the light of a sharp edge about by its own rules.
const COMPRESSED_TOLERANCE: f32 = 0.25;
/// Share of differing samples that is a contradiction. Untouched stacks of the simulated benches have a thousandth at
/// the most (`tests/tampered`), a photograph of another pattern has half or more.
const LEAST_SHARE: f64 = 0.02;
/// The same as a number of samples: fewer are a defect of the sensor or a cosmic ray.
const LEAST_SAMPLES: u64 = 30;
/// Values above black whose rounding is a hundredth of them or less, DN.
const LEAST_LEVEL_DN: f32 = 50.0;
/// Ratios of two exposures from which the median is taken, at the most.
const RATIOS: usize = 4096;

/// Two photographs of a stack against each other.
#[derive(Debug, Clone, Default)]
struct Pair {
    /// Samples in which one of the two has light that the other had to show.
    lit: u64,
    differ: u64,
    /// ln of how much more light than expected the second has per time than the first, when that is more than
    /// tolerated.
    log_factor: Option<f64>,
}

impl Pair {
    fn share(&self) -> f64 {
        self.differ as f64 / self.lit.max(1) as f64
    }

    fn disagrees(&self) -> bool {
        self.differs() || self.log_factor.is_some()
    }

    fn differs(&self) -> bool {
        self.differ >= LEAST_SAMPLES && self.share() > LEAST_SHARE
    }
}

/// The photographs of a stack that do not show what the others show, worst first.
///
/// Neighbours in time, and where any two of them disagree each two, are compared sample by sample, one time corrected
/// against the other by the median of their ratios: what is unsaturated and above noise in one has to be in the other
/// within its noise and 8 % (25 % where files are compressed); what saturates in one bounds the other. `parts` are
/// rectangles of one shot, the same photographs in each, sorted by time; `stride` leaves out all but every so many
/// blocks of pixels.
///
/// Of three photographs or more the one is named without which the others agree.
///
/// Not detected: movements of less than about a tenth of the width of what is seen; differences below noise or of few
/// samples.
pub fn disagreements(
    parts: &[&[Exposure]],
    sensor: &Sensor,
    stride: usize,
    brightness: Brightness<'_>,
) -> Vec<Disagreement> {
    let light = linear_light(parts, sensor, stride);
    let n = light.len();
    let compared = |a: usize, b: usize| {
        let both = [&light[a], &light[b]];
        let ratio = median_ratio(both, sensor);
        let log_factor = ratio.and_then(|r| {
            let off = f64::from(r.median).ln() - (brightness.log_scale[b] - brightness.log_scale[a]);
            (off.abs() > brightness.tolerance + r.five_sd()).then_some(off)
        });
        Pair { log_factor, ..compare(both, sensor, ratio.map_or(1.0, |r| r.median)) }
    };
    // Neighbours share most of their range: where each two of them agree, all do.
    let neighbours: Vec<Pair> = (1..n).map(|b| compared(b - 1, b)).collect();
    if !neighbours.iter().any(Pair::disagrees) {
        return vec![];
    }
    let mut pairs = vec![Pair::default(); n * n];
    for a in 0..n {
        for b in a + 1..n {
            pairs[a * n + b] = if b == a + 1 { neighbours[a].clone() } else { compared(a, b) };
        }
    }
    let pair = |a: usize, b: usize| &pairs[a.min(b) * n + a.max(b)];
    let mut left: Vec<usize> = (0..n).collect();
    let mut found = Vec::new();
    loop {
        let bad = |j: usize| left.iter().filter(|&&i| i != j && pair(i, j).disagrees()).count();
        let weight = |j: usize| left.iter().filter(|&&i| i != j).map(|&i| pair(i, j).share()).sum::<f64>();
        let Some(&worst) = left.iter().max_by(|&&a, &&b| {
            (bad(a), weight(a)).partial_cmp(&(bad(b), weight(b))).unwrap_or(std::cmp::Ordering::Equal)
        }) else {
            return found;
        };
        if bad(worst) == 0 {
            return found;
        }
        // Whose removal explains as much as that of the worst.
        let or = left.iter().copied().find(|&j| j != worst && bad(j) == bad(worst) && pair(j, worst).disagrees());
        let others: Vec<usize> = left.iter().copied().filter(|&j| j != worst && pair(j, worst).disagrees()).collect();
        let share = others.iter().map(|&j| pair(j, worst).share()).sum::<f64>() / others.len() as f64;
        let same = others.iter().all(|&j| !pair(j, worst).differs());
        let factor = |j: &usize| pair(*j, worst).log_factor.map(|f| if *j < worst { f } else { -f });
        let factors: Option<Vec<f64>> = others.iter().map(factor).collect();
        let factor = factors.filter(|_| same).map(|f| (f.iter().sum::<f64>() / f.len() as f64).exp());
        found.push(Disagreement { photograph: worst, or, share, factor });
        left.retain(|&j| j != worst);
    }
}

/// The linear value from which on nothing is compared: of a curve's upper end compression leaves little.
fn top(sensor: &Sensor) -> f32 {
    if sensor.is_curved() { 0.9 * sensor.range() } else { sensor.range() }
}

/// The shorter exposure first; the second has `ratio` times the light per stated time.
fn compare([first, second]: [&LinearLight; 2], sensor: &Sensor, ratio: f32) -> Pair {
    let tolerance = if sensor.is_compressed() { COMPRESSED_TOLERANCE } else { TOLERANCE };
    let top = top(sensor);
    let (t, u) = (first.secs, second.secs * ratio);
    // What the longer one says of the shorter.
    let scale = t / u;
    let sd = |linear: f32, c: usize| sensor.variance(linear, c).sqrt();
    let noise = |y: f32, z: f32, c: usize| sd(y, c).hypot(sd(z, c) * scale);
    let dark = [0, 1, 2].map(|c| SIGMA * noise(0.0, 0.0, c));
    let mut sums = Pair::default();
    for (k, (&y, &z)) in first.values.iter().zip(&second.values).enumerate() {
        let c = k % 3;
        let mut bounded = |seen: f32, scale: f32| {
            let least = top * scale.min(1.0);
            if least > 2.0 * SIGMA * sd(least, c) {
                sums.lit += 1;
                sums.differ += u64::from(seen < least * (1.0 - 2.0 * tolerance) - SIGMA * sd(least, c));
            }
        };
        match [y.is_finite(), z.is_finite()] {
            [true, true] => {
                let light = ((y + z) / (t + u)).max(0.0);
                let most = y.max(z * scale);
                if most > dark[c] && light * u < top {
                    sums.lit += 1;
                    let off = (y - z * scale).abs();
                    sums.differ += u64::from(off > SIGMA * noise(light * t, light * u, c) + tolerance * most);
                }
            }
            // The one that saturates says how much the other has at least: all, where its time is the longer one.
            [true, false] if z == f32::INFINITY => bounded(y, t / u),
            [false, true] if y == f32::INFINITY => bounded(z, u / t),
            _ => {}
        }
    }
    sums
}

/// How much more light the second of two photographs has per stated time than the first.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ratio {
    pub median: f32,
    samples: usize,
}

impl Ratio {
    /// Five standard deviations of the median's logarithm, of samples whose noise is a sixth each at the most.
    fn five_sd(&self) -> f64 {
        5.0 * 1.25 * 2f64.sqrt() / f64::from(SIGMA) / (self.samples as f64).sqrt()
    }
}

/// The median of the ratios of two photographs; `None` where too little is lit in both.
pub(super) fn median_ratio([first, second]: [&LinearLight; 2], sensor: &Sensor) -> Option<Ratio> {
    let top = top(sensor);
    let (t, u) = (first.secs, second.secs);
    // Where noise is less than a code value, rounding makes ratios of small values too large or too small, and so does
    // black.
    let least = if sensor.range() >= 100.0 && !sensor.is_curved() { LEAST_LEVEL_DN } else { 0.0 };
    let ratio = |(k, (&y, &z)): (usize, (&f32, &f32))| {
        let light = (y + z) / (t + u);
        let sd = |linear: f32| sensor.variance(linear, k % 3).sqrt();
        // Chosen by the light of both, on which a chance high of one hardly acts.
        let lit = light * t > least + SIGMA * sd(light * t);
        (lit && y > 0.0 && z > 0.0 && z < 0.9 * top && y < 0.9 * top).then(|| (z / u) / (y / t))
    };
    let both = first.values.iter().zip(&second.values).enumerate();
    let mut ratios: Vec<f32> = both.filter_map(ratio).take(RATIOS).collect();
    if ratios.len() < LEAST_SAMPLES as usize {
        return None;
    }
    let middle = ratios.len() / 2;
    let median = *ratios.select_nth_unstable_by(middle, f32::total_cmp).1;
    Some(Ratio { median, samples: ratios.len() })
}

/// A pile of equal code values holds as many at least as this, and so many times what the codes of the hundredth below
/// it do on average.
const LEAST_PILE: usize = 16;
const PILE_GAIN: f64 = 8.0;
/// Noise in which values do not pile up by themselves, DN.
const LEAST_NOISE_DN: f32 = 0.25;

/// The code value at which a photograph's values pile up below the saturation of the rig, DN: it clips there. `None`
/// when it does not, and when its noise there is so small that values are equal anyway.
///
/// `parts` are rectangles of it. Means of blocks pile up where all pixels of a block clip. Not detected: where a
/// response curve ends below.
pub fn pile_up(parts: &[&Samples], sensor: &Sensor) -> Option<f64> {
    if sensor.is_curved() {
        return None;
    }
    let saturation = f64::from(sensor.full_range() + sensor.black());
    let look = |see: &mut dyn FnMut(f64)| parts.iter().for_each(|part| part.for_each(&mut *see));
    let (mut top, mut beyond) = (f64::NEG_INFINITY, 0usize);
    look(&mut |c| match c >= saturation {
        true => beyond += 1,
        false => top = top.max(c),
    });
    let level = top as f32 - sensor.black();
    // What saturates where the rig says does not end below; in the dark values are few and equal.
    if beyond >= LEAST_PILE
        || !(level > 0.05 * sensor.full_range())
        || sensor.variance(level, 1) < LEAST_NOISE_DN * LEAST_NOISE_DN
    {
        return None;
    }
    let (mut equal, mut near) = (0usize, 0usize);
    look(&mut |c| {
        equal += usize::from(c == top);
        near += usize::from(c < top && c >= 0.99 * top);
    });
    let codes = match parts.first()? {
        Samples::F32(_) => 1.0,
        _ => (0.01 * top).max(1.0),
    };
    (equal >= LEAST_PILE && equal as f64 > PILE_GAIN * near as f64 / codes).then_some(top)
}

/// Linear values of one photograph, R G B after each other: saturated ones +∞, what is no measurement NaN.
pub(super) struct LinearLight {
    values: Vec<f32>,
    /// Stated time, s.
    secs: f32,
}

/// The photographs of a stack in all `parts`, every `stride`th block of their pixels.
pub(super) fn linear_light(parts: &[&[Exposure]], sensor: &Sensor, stride: usize) -> Vec<LinearLight> {
    let Some(stack) = parts.first() else { return vec![] };
    let mut all: Vec<LinearLight> = stack.iter().map(|e| LinearLight { values: vec![], secs: e.secs as f32 }).collect();
    for part in parts {
        let samples = part.iter().map(|e| e.samples.len()).min().unwrap_or(0);
        for first in (0..samples).step_by(BLOCK * stride.max(1)) {
            let len = BLOCK.min(samples - first);
            for (light, exposure) in all.iter_mut().zip(*part) {
                let from = light.values.len();
                light.values.resize(from + len, 0.0);
                sensor.linearize(&exposure.samples, first, &mut light.values[from..]);
            }
        }
    }
    all
}
