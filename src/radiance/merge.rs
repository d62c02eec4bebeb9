//! Merging a bracket by photon statistics.

use super::Sensor;
use crate::capture::{Rect, Samples};

/// One exposure of a shot over the pixels to be merged.
#[derive(Debug, Clone)]
pub struct Exposure {
    /// Code values, R G B interleaved.
    pub samples: Samples,
    /// Effective exposure time, s.
    pub secs: f64,
}

/// Linear radiance of a rectangle of pixels, in code values per second, R G B interleaved.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Radiance {
    /// Where in the photograph.
    pub rect: Rect,
    /// Radiance, DN/s; 0 where nothing measured it.
    pub value: Vec<f32>,
    /// Variance, (DN/s)².
    pub variance: Vec<f32>,
    /// How many exposures measured each; 0 means that the value is not to be used.
    pub used: Vec<u8>,
}

/// An exposure that the shorter ones predict to be beyond this share of the range measured something else (blooming, a
/// defect): noise of photons does not take it there.
const PREDICTED_SHARE: f32 = 1.5;
/// The same for encoded photographs: compression puts values on either side of saturation that the light does not have,
/// and what is saturated there says nothing about the pixel.
const PREDICTED_SHARE_ENCODED: f32 = 0.9;

/// Merges a bracket to radiance: at each pixel and channel the minimum-variance mean of y/t over unsaturated exposures.
///
/// Weights are t²/variance with variance = gain · L t + floor, L being the pooled estimate Σy/Σt (the
/// maximum-likelihood value for pure Poisson noise, `Hasinoff2010`). Saturated exposures are masked, never averaged in;
/// but they say that there was at least so much light, and a radiance that the others put below that is raised to it.
/// Without this, keeping the low outcomes of an exposure near saturation and dropping its high ones would be a bias of
/// a third of its noise. (Encoded photographs are left out from nine tenths of the range on, by what the shorter
/// exposures predict, and bound nothing.)
///
/// Mean squared error is within 5 % of the Cramér–Rao bound but within three standard deviations of an exposure's
/// saturation, where chance decides whether it counts and nothing reaches the bound (`docs/accuracy.md`). The bracket
/// must be sorted by time and cover `rect`.
///
/// Not detected: light that changes between the exposures, motion.
pub fn merge(bracket: &[Exposure], rect: Rect, sensor: &Sensor) -> Radiance {
    let n = 3 * rect.area();
    let mut out = Radiance { rect, value: vec![0.0; n], variance: vec![0.0; n], used: vec![0; n] };
    let mut linear = vec![[0.0f32; BLOCK]; bracket.len()];
    let values = out.value.chunks_mut(BLOCK).zip(out.variance.chunks_mut(BLOCK)).zip(out.used.chunks_mut(BLOCK));
    for (k, ((value, variance), used)) in values.enumerate() {
        let n = value.len();
        for (y, exposure) in linear.iter_mut().zip(bracket) {
            sensor.linearize(&exposure.samples, k * BLOCK, &mut y[..n]);
        }
        let pooled = pool(bracket, &mut linear, sensor, used);
        weigh(bracket, &linear, &pooled, sensor, value, variance);
    }
    out
}

/// Samples that are merged together, whole pixels: all their exposures stay in the nearest cache.
pub(super) const BLOCK: usize = 510;

/// What all exposures of a block say together.
struct Pooled {
    /// Σy/Σt over the usable ones, DN/s.
    estimate: [f32; BLOCK],
    /// The least radiance that saturates those that are saturated, DN/s; −∞ when none is.
    least: [f32; BLOCK],
}

/// Pools the usable exposures of each sample and counts them; the others become NaN in `linear`.
///
/// Written without branches so that it is vectorized.
fn pool(bracket: &[Exposure], linear: &mut [[f32; BLOCK]], sensor: &Sensor, used: &mut [u8]) -> Pooled {
    let range = sensor.range();
    let (share, saturated) = match sensor.is_curved() {
        true => (PREDICTED_SHARE_ENCODED, f32::NEG_INFINITY),
        false => (PREDICTED_SHARE, range),
    };
    let (mut sum_y, mut sum_t, mut least) = ([0.0f32; BLOCK], [0.0f32; BLOCK], [f32::NEG_INFINITY; BLOCK]);
    for (y, exposure) in linear.iter_mut().zip(bracket) {
        let t = exposure.secs as f32;
        let sums = y.iter_mut().zip(&mut sum_y).zip(&mut sum_t).zip(&mut least).zip(&mut *used);
        for ((((y, sum_y), sum_t), least), used) in sums {
            // With nothing pooled yet both sides are 0, and nothing is predicted.
            let predicted_high = *sum_y * t > share * range * *sum_t;
            let usable = y.is_finite() & !predicted_high;
            *least = if *y == f32::INFINITY { least.max(saturated / t) } else { *least };
            *sum_y += if usable { *y } else { 0.0 };
            *sum_t += if usable { t } else { 0.0 };
            *used += u8::from(usable);
            *y = if usable { *y } else { f32::NAN };
        }
    }
    // Nothing measured: 0/0, whose NaN becomes 0 in max.
    Pooled { estimate: std::array::from_fn(|k| (sum_y[k] / sum_t[k]).max(0.0)), least }
}

fn weigh(
    bracket: &[Exposure],
    linear: &[[f32; BLOCK]],
    pooled: &Pooled,
    sensor: &Sensor,
    value: &mut [f32],
    variance: &mut [f32],
) {
    let mut bottom = [0.0f32; BLOCK];
    for (y, exposure) in linear.iter().zip(bracket) {
        let (t, floor) = (exposure.secs as f32, sensor.floor(&exposure.samples));
        let sums = value.iter_mut().zip(&mut bottom).zip(&pooled.estimate).zip(y).enumerate();
        for (k, (((top, bottom), &estimate), &y)) in sums {
            let mut variance = sensor.gain * estimate * t + floor;
            if sensor.is_curved() {
                variance += sensor.rounding(estimate * t, k % 3);
            }
            let usable = y.is_finite();
            let w = if usable { t / variance } else { 0.0 };
            *top += w * if usable { y } else { 0.0 };
            *bottom += w * t;
        }
    }
    // Of an exposure that is just saturated, in units of the square of its radiance.
    let floor = bracket.first().map_or(0.0, |e| sensor.floor(&e.samples));
    let at_saturation = (sensor.gain * sensor.range() + floor) / (sensor.range() * sensor.range());
    for (((value, variance), &bottom), &least) in value.iter_mut().zip(variance).zip(&bottom).zip(&pooled.least) {
        let measured = bottom > 0.0;
        let (mean, of_mean) = (*value / bottom, 1.0 / bottom);
        let raised = mean < least;
        let v = if raised { of_mean.min(at_saturation * least * least) } else { of_mean };
        *value = if measured { mean.max(least) } else { 0.0 };
        *variance = if measured { v } else { 0.0 };
    }
}

impl Radiance {
    /// Index of channel 0 of photograph pixel (x, y), which must lie in `rect`.
    pub fn at(&self, x: usize, y: usize) -> usize {
        3 * ((y - self.rect.y) * self.rect.width + (x - self.rect.x))
    }

    /// The pixels of `rect`, which must lie in the picture.
    pub fn part(&self, rect: Rect) -> Self {
        let rows = (rect.y..rect.y + rect.height).map(|y| {
            let from = self.at(rect.x, y);
            from..from + 3 * rect.width
        });
        let cut = |all: &[f32]| rows.clone().flat_map(|r| all[r].iter().copied()).collect();
        let used = rows.clone().flat_map(|r| self.used[r].iter().copied()).collect();
        Self { rect, value: cut(&self.value), variance: cut(&self.variance), used }
    }

    /// Subtracts `other` (ambient light, say), which must cover this rectangle; variances add, validity is that of
    /// both.
    pub fn subtract(&mut self, other: &Self) {
        let n = 3 * self.rect.width;
        for y in 0..self.rect.height {
            let (a, b) = (n * y, other.at(self.rect.x, self.rect.y + y));
            for k in 0..n {
                self.value[a + k] -= other.value[b + k];
                self.variance[a + k] += other.variance[b + k];
                self.used[a + k] = self.used[a + k].min(other.used[b + k]);
            }
        }
    }

    /// Variance of [`Self::luminance`].
    pub fn luminance_variance(&self) -> Vec<f32> {
        self.variance.as_chunks::<3>().0.iter().map(|p| (p[0] + p[1] + p[2]) / 9.0).collect()
    }

    /// Mean of the three channels, one value a pixel.
    pub fn luminance(&self) -> Vec<f32> {
        self.value.as_chunks::<3>().0.iter().map(|p| (p[0] + p[1] + p[2]) / 3.0).collect()
    }
}

#[cfg(test)]
mod tests;
