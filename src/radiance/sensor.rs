//! From code values to light: response curve, black level, noise.

use super::curve::{CODES, Curve, FULL};
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
    /// Variance that a linear response adds in files of whole code values, DN²: rounding and compression.
    coding: f32,
    /// When the response is not linear.
    encoding: Option<Encoding>,
}

/// What the files do to code values after the curve: both add to the variance.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FileNoise {
    /// Whether code values have 16 bits.
    pub sixteen_bit: bool,
    /// Variance of lossy compression, 8-bit code values squared, R G B; 0 without.
    pub compression: [f64; 3],
}

impl FileNoise {
    /// Whether compression adds anything.
    pub fn is_compressed(&self) -> bool {
        self.compression != [0.0; 3]
    }
}

/// A response curve, tabulated for speed. Tables hold R G B after each other for each entry.
#[derive(Debug, Clone)]
struct Encoding {
    curve: Curve,
    of_u8: Vec<f32>,
    of_u16: Vec<f32>,
    /// Variance of rounding and compression in linear values, over the square root of the linear value.
    variance: Vec<f32>,
}

/// Rounding to whole code values spreads uniformly over one: variance 1/12.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;
/// Entries of the table of variances.
const ROOTS: usize = 1024;

impl Sensor {
    /// The sensor that a rig file describes by itself, for files without compression; `"estimate"` and saved curves are taken for sRGB. `None`
    /// when its noise has to be measured.
    pub fn of_rig(rig: &Rig) -> Option<Self> {
        let curve = (rig.camera.response != ResponseCurve::Linear).then(Curve::srgb);
        rig.noise.as_ref().map(|noise| Self::with_curve(noise, curve, FileNoise::default()))
    }

    /// A sensor with a response curve of its own; `None` is a linear one.
    pub fn with_curve(noise: &Noise, curve: Option<Curve>, file: FileNoise) -> Self {
        let read = noise.gain_dn_per_electron * noise.read_noise_electrons;
        let mean_compression = file.compression.iter().sum::<f64>() / 3.0;
        // With a curve, rounding and compression depend on its slope and are in the table.
        let coding = if curve.is_some() { 0.0 } else { ROUNDING_VARIANCE + mean_compression };
        Self {
            black: noise.black_dn as f32,
            saturation: noise.saturation_dn as f32,
            gain: noise.gain_dn_per_electron as f32,
            read: (read * read) as f32,
            coding: coding as f32,
            encoding: curve.map(|curve| Encoding::new(curve, file)),
        }
    }

    /// Linear code values above black of `samples[first..]`, as many as `out` holds; saturated ones as +∞, what is no measurement as NaN.
    /// `first` must be a multiple of 3.
    pub(super) fn linearize(&self, samples: &Samples, first: usize, out: &mut [f32]) {
        fn each<T: Copy>(from: &[T], first: usize, out: &mut [f32], f: impl Fn(T) -> f32) {
            out.iter_mut().zip(&from[first..]).for_each(|(o, &v)| *o = f(v));
        }
        fn looked_up<T: Copy + Into<usize>>(from: &[T], out: &mut [f32], table: &[f32], mark: impl Fn(f32) -> f32) {
            for (o, v) in out.chunks_mut(3).zip(from.chunks(3)) {
                o.iter_mut().zip(v).enumerate().for_each(|(c, (o, &v))| *o = mark(table[3 * v.into() + c]));
            }
        }
        let mark = |code: f32| if code >= self.saturation { f32::INFINITY } else { code - self.black };
        match (samples, &self.encoding) {
            (Samples::U8(v), Some(e)) => looked_up(&v[first..], out, &e.of_u8, mark),
            (Samples::U16(v), Some(e)) => looked_up(&v[first..], out, &e.of_u16, mark),
            (Samples::U8(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            (Samples::U16(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            // NaN, infinities and negative numbers beyond all noise in a float file were measured by nothing.
            (Samples::F32(v), _) => each(v, first, out, |c| if c >= -self.saturation { mark(c) } else { f32::NAN }),
        }
    }

    /// Variance of no light, DN²: read-out, and with a linear response what whole code values add. Floating-point files were not rounded to DN.
    pub(super) fn floor(&self, samples: &Samples) -> f32 {
        let whole = !matches!(samples, Samples::F32(_));
        self.read + if whole { self.coding } else { 0.0 }
    }

    /// Linear code values above black of one channel; saturated ones as +∞.
    pub fn linear(&self, samples: &Samples, channel: usize) -> Vec<f32> {
        let mut all = vec![0.0; samples.len()];
        self.linearize(samples, 0, &mut all);
        all.into_iter().skip(channel).step_by(3).collect()
    }

    /// Linear code values from black to saturation.
    pub fn full_range(&self) -> f32 {
        self.range()
    }

    /// Largest linear value that counts.
    pub(super) fn range(&self) -> f32 {
        self.saturation - self.black
    }

    /// Variance of rounding and compression of a channel, carried to the linear signal by the curve's slope, DN².
    pub(super) fn rounding(&self, linear: f32, channel: usize) -> f32 {
        self.encoding.as_ref().map_or(0.0, |e| {
            let root = ((linear + self.black).max(0.0) / FULL as f32).sqrt() * (ROOTS - 1) as f32;
            e.variance[3 * (root as usize).min(ROOTS - 1) + channel]
        })
    }

    /// Variance of a linear value of mean `linear` above black, DN².
    pub(super) fn variance(&self, linear: f32, channel: usize) -> f32 {
        self.gain * linear.max(0.0) + self.read + self.coding + self.rounding(linear, channel)
    }

    /// Whether code values are a curve of light.
    pub(super) fn is_curved(&self) -> bool {
        self.encoding.is_some()
    }

    /// The response curve; `None` when it is linear.
    pub fn curve(&self) -> Option<&Curve> {
        self.encoding.as_ref().map(|e| &e.curve)
    }
}

impl Encoding {
    fn new(curve: Curve, file: FileNoise) -> Self {
        // 16-bit codes are 257ths of 8-bit ones.
        let step: f64 = if file.sixteen_bit { 1.0 / 257.0 } else { 1.0 };
        let coding: [f64; 3] = file.compression.map(|c| c + step * step * ROUNDING_VARIANCE);
        // A curve of a code value with noise is too large by half its bend times the variance.
        let mean = |c: usize, code: f64| {
            let light = curve.linear_at(c, code);
            let excess = 0.5 * curve.bend_at(c, code) * coding[c];
            (light - excess.clamp(-0.2 * light, 0.2 * light)) as f32
        };
        let triples = |n: usize| (0..n).flat_map(|k| (0..3).map(move |c| (k, c)));
        let of_u8 = triples(CODES).map(|(k, c)| mean(c, k as f64)).collect();
        let of_u16 = triples(1 << 16).map(|(k, c)| mean(c, k as f64 / 257.0)).collect();
        let variance = triples(ROOTS).map(|(k, c)| {
            let linear = FULL * (k as f64 / (ROOTS - 1) as f64).powi(2);
            (curve.slope_at(c, curve.code_at(c, linear)).powi(2) * coding[c]) as f32
        });
        Self { of_u8, of_u16, variance: variance.collect(), curve }
    }
}
