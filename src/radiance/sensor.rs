//! From code values to light: response curve, black level, noise.

use crate::capture::{Noise, ResponseCurve, Rig, Samples};

/// The sensor as the merge needs it, in linear code values above black.
#[derive(Debug, Clone)]
pub struct Sensor {
    black: f32,
    saturation: f32,
    /// Variance per linear code value: Poisson.
    pub(super) gain: f32,
    /// Variance of reading out, DN².
    read: f32,
    /// Linear value of each 8-bit code, when the response is not linear.
    table: Option<Vec<f32>>,
}

/// Rounding to whole code values spreads uniformly over one: variance 1/12.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

impl Sensor {
    /// The sensor that a rig file describes by itself; `None` when its noise has to be measured.
    pub fn of_rig(rig: &Rig) -> Option<Self> {
        rig.noise.as_ref().map(|noise| Self::new(rig, noise))
    }

    /// The sensor with a rig's response and this noise: the rig's own, or an estimated one.
    pub fn new(rig: &Rig, noise: &Noise) -> Self {
        let read = noise.gain_dn_per_electron * noise.read_noise_electrons;
        let table = match rig.camera.response {
            ResponseCurve::Linear => None,
            ResponseCurve::Srgb => {
                Some((0..256).map(|code| (255.0 * srgb_to_linear(code as f64 / 255.0)) as f32).collect())
            }
        };
        Self {
            black: noise.black_dn as f32,
            saturation: noise.saturation_dn as f32,
            gain: noise.gain_dn_per_electron as f32,
            read: (read * read) as f32,
            table,
        }
    }

    /// Linear code values above black of `samples[first..]`, as many as `out` holds; saturated ones as +∞, what is no measurement as NaN.
    pub(super) fn linearize(&self, samples: &Samples, first: usize, out: &mut [f32]) {
        fn each<T: Copy>(from: &[T], first: usize, out: &mut [f32], f: impl Fn(T) -> f32) {
            out.iter_mut().zip(&from[first..]).for_each(|(o, &v)| *o = f(v));
        }
        let mark = |code: f32| if code >= self.saturation { f32::INFINITY } else { code - self.black };
        match (samples, &self.table) {
            (Samples::U8(v), Some(t)) => each(v, first, out, |c| mark(t[usize::from(c)])),
            // 16-bit files of an encoded response: interpolate the curve between its 8-bit nodes.
            (Samples::U16(v), Some(t)) => each(v, first, out, |c| mark(interpolate(t, f32::from(c) / 257.0))),
            (Samples::U8(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            (Samples::U16(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            // NaN, infinities and negative numbers beyond all noise in a float file were measured by nothing.
            (Samples::F32(v), _) => each(v, first, out, |c| if c >= -self.saturation { mark(c) } else { f32::NAN }),
        }
    }

    /// Variance of no light, DN²: read-out, and rounding of whole code values. Floating-point files were not rounded to DN.
    pub(super) fn floor(&self, samples: &Samples) -> f32 {
        let rounded = !matches!(samples, Samples::F32(_));
        self.read + if rounded { ROUNDING_VARIANCE as f32 } else { 0.0 }
    }

    /// Largest linear value that counts.
    pub(super) fn range(&self) -> f32 {
        self.saturation - self.black
    }

    /// Variance of the rounding of a code value, carried to the linear signal: the curve's slope squared over 12.
    pub(super) fn rounding(&self, linear: f32) -> f32 {
        match &self.table {
            None => 0.0,
            Some(table) => {
                let k = table.partition_point(|&v| v < linear + self.black).clamp(1, 255);
                let slope = table[k] - table[k - 1];
                slope * slope * ROUNDING_VARIANCE as f32
            }
        }
    }

    /// Whether code values are a curve of light.
    pub(super) fn is_curved(&self) -> bool {
        self.table.is_some()
    }
}

fn interpolate(table: &[f32], code: f32) -> f32 {
    let k = (code as usize).min(254);
    table[k] + (table[k + 1] - table[k]) * (code - k as f32)
}

/// The sRGB decoding of IEC 61966-2-1, both in 0 to 1.
fn srgb_to_linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}
