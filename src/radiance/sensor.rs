//! From code values to light: response curve, black level, noise.

use super::curve::{CODES, Curve, FULL};
use crate::capture::{
    Capture, LightOfCodes, NOISE_LEVELS, NOISE_STEP, Noise, Photograph, Samples, change_of_variance,
    compression_variance, flat_variance,
};
use crate::{Error, Result};
use std::io::Read;
use std::sync::Arc;

/// The sensor as the merge needs it, in linear code values above black.
#[derive(Debug, Clone)]
pub struct Sensor {
    black: f32,
    saturation: f32,
    /// Variance per linear code value: Poisson.
    pub(super) gain: f32,
    /// Variance of reading out, DN².
    read: f32,
    /// Variance that a linear response curve adds in files of whole code values, DN²: rounding and compression.
    coding: f32,
    file: FileNoise,
    /// When the curve is not linear.
    encoding: Option<Encoding>,
}

/// What the files do to code values after the curve: both add to the variance.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct FileNoise {
    /// Whether code values have 16 bits.
    pub sixteen_bit: bool,
    /// Variance of lossy compression, 8-bit code values squared, R G B; 0 without.
    pub compression: [f64; 3],
    /// The same of the mean of pixels that are lit alike, however many; 0 without.
    #[serde(default)]
    pub flat: [f64; 3],
    /// How much wider compression and rounding spread code values of one light than the sensor does, code values squared,
    /// R G B: [`change_of_variance`]; 0 without compression.
    #[serde(default)]
    pub change: [[f64; 3]; NOISE_LEVELS],
}

/// More than a JPEG has before its tables, previews included.
const HEAD_BYTES: u64 = 8 << 20;
/// Noise of code values that compression acts on, squared code values: about that of a good sensor's mid-greys in 8
/// bits.
const CODE_NOISE: f64 = 1.0;

impl FileNoise {
    /// Bits and compression of the capture's first photograph, which stand for all.
    ///
    /// # Errors
    /// Those of reading it.
    pub fn of_capture(capture: &Capture) -> Result<Self> {
        let Some(first) = capture.brackets.iter().flatten().next() else { return Ok(Self::default()) };
        // A JPEG's tables are in its head.
        let mut head = Vec::new();
        let file = crate::files::open(&first.path).map_err(Error::io("read", &first.path))?;
        file.take(HEAD_BYTES).read_to_end(&mut head).map_err(Error::io("read", &first.path))?;
        let compression = compression_variance(&head, CODE_NOISE).unwrap_or_default();
        let mut row = Samples::U8(vec![]);
        if compression == [0.0; 3] {
            Photograph { reduction: None, ..first.clone() }.open()?.read(1, &mut row)?;
        }
        let sixteen_bit = matches!(row, Samples::U16(_));
        let (flat, change) = (flat_variance(&head).unwrap_or_default(), change_of_variance(&head).unwrap_or_default());
        Ok(Self { sixteen_bit, compression, flat, change })
    }

    /// Variance of rounding to whole code values, 8-bit code values squared: those of 16 bits are 257ths.
    fn rounding_variance(&self) -> f64 {
        let step: f64 = if self.sixteen_bit { 1.0 / 257.0 } else { 1.0 };
        step * step * ROUNDING_VARIANCE
    }

    /// How much wider code values of one light are spread in the file than by noise of `noise` code values, code values
    /// squared.
    fn change_at(&self, noise: f64, channel: usize) -> f64 {
        if !self.is_compressed() {
            return self.rounding_variance();
        }
        // Beyond the last level every step's rounding is spread evenly.
        let at = (noise / NOISE_STEP).min((NOISE_LEVELS - 1) as f64);
        let below = (at as usize).min(NOISE_LEVELS - 2);
        let [low, high] = [below, below + 1].map(|k| self.change[k][channel]);
        low + (at - below as f64) * (high - low)
    }

    /// Whether compression adds anything.
    pub fn is_compressed(&self) -> bool {
        self.compression != [0.0; 3]
    }
}

/// A response curve, tabulated for speed. Tables hold R G B after each other for each entry.
#[derive(Debug, Clone)]
struct Encoding {
    curve: Curve,
    light: Arc<LightOfCodes>,
    /// Variance of rounding and compression in linear values, over the square root of the linear value.
    variance: Vec<f32>,
}

/// Rounding to whole code values spreads uniformly over one: variance 1/12.
const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;
/// Of floating-point photographs a code value may be all there is; those of whole numbers have many.
const WHOLE_RANGE: f32 = 100.0;
/// Standard deviation of floating-point values of a rig without noise (a rendered capture), of the range: what sums of
/// f32 are good to. The best sensors have a hundred times as much.
const LEAST_SD: f32 = 1e-6;
/// What the light of a capture is off by in a channel, relative, over what the mean of a flat patch is, code values. Of 12
/// random JPEG captures (quality 95: 0.5 code values) albedos are off by 0.17, 0.47 and 0.31 % RMS in R, G, B.
const LIGHT_PER_FLAT_CODE: f64 = 0.007;
/// Entries of the table of variances.
const ROOTS: usize = 1024;

impl Sensor {
    /// The sensor that the capture's rig describes, with what its files add.
    ///
    /// # Errors
    /// [`Error::Field`] when `noise` is missing or `camera.response` is `"estimate"`: both are measured by
    /// [`crate::pipeline::build_matrix`]. Those of [`Curve::of_rig`] and [`FileNoise::of_capture`].
    pub fn of_capture(capture: &Capture) -> Result<Self> {
        let missing = || Error::field(&capture.rig_path, "noise", "gain, read noise, black and saturation", "none");
        let noise = capture.rig.noise.as_ref().ok_or_else(missing)?;
        let curve = Curve::of_rig(&capture.rig, &capture.rig_path)?;
        Ok(Self::with_curve(noise, curve, FileNoise::of_capture(capture)?))
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
            file,
            encoding: curve.map(|curve| Encoding::new(curve, noise, file)),
        }
    }

    /// The same sensor read by means of blocks of `factor` × `factor` pixels, of which `cell_px` lie across the largest
    /// patch over whose light these means are averaged again.
    ///
    /// Their noise is independent, but for what whole code values and compression do to pixels that are lit alike:
    /// where noise of a standard deviation of s code values does not spread them, all are rounded alike. Of rounding's
    /// variance that leaves exp(−4π²s²) (`Widrow1996`); compression takes the noise away first. That part is made larger
    /// by `cell_px`², so that averaging leaves it as it is. A gradient of light spreads code values too, and then that is
    /// too much. Means are floating point, of code values that were rounded where these have a range of 100 code values
    /// or more.
    pub fn averaged(self, factor: usize, cell_px: f64) -> Self {
        if factor <= 1 {
            return self;
        }
        let share = 1.0 / (factor * factor) as f32;
        let rounded = if self.range() >= WHOLE_RANGE { self.coding } else { 0.0 };
        let alike = if rounded > 0.0 { self.rounded_alike(1.0, 0.0, 1) * (cell_px * cell_px) as f32 } else { 0.0 };
        let encoding = self.encoding.clone().map(|mut e| {
            for (k, variance) in e.variance.iter_mut().enumerate() {
                let (linear, slope) = at_root(&e.curve, k / 3, k % 3);
                let alike = self.rounded_alike(slope as f32, linear as f32 - self.black, k % 3);
                *variance = share * *variance + alike * (cell_px * cell_px) as f32;
            }
            e
        });
        Self {
            gain: self.gain * share,
            read: (self.read + rounded) * share + alike,
            coding: (self.coding - rounded) * share,
            encoding,
            ..self
        }
    }

    /// Variance that stays however many pixels are lit alike, DN², where a code value is `slope` DN.
    fn rounded_alike(&self, slope: f32, linear: f32, channel: usize) -> f32 {
        if self.is_compressed() {
            return (self.file.flat[channel] + ROUNDING_VARIANCE) as f32 * slope * slope;
        }
        let step = if self.encoding.is_some() && self.file.sixteen_bit { slope / 257.0 } else { slope };
        let noise_steps = (self.gain * linear.max(0.0) + self.read) / (step * step);
        step * step * ROUNDING_VARIANCE as f32 * (-4.0 * std::f32::consts::PI.powi(2) * noise_steps).exp()
    }

    /// Linear code values above black of `samples[first..]`, as many as `out` holds; saturated ones as +∞, what is no
    /// measurement as NaN. `first` must be a multiple of 3.
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
            (Samples::U8(v), Some(e)) => looked_up(&v[first..], out, &e.light.of_u8, mark),
            (Samples::U16(v), Some(e)) => looked_up(&v[first..], out, &e.light.of_u16, mark),
            (Samples::U8(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            (Samples::U16(v), None) => each(v, first, out, |c| mark(f32::from(c))),
            // NaN, infinities and negative numbers beyond all noise in a float file are treated as unmeasured.
            (Samples::F32(v), _) => each(v, first, out, |c| if c >= -self.saturation { mark(c) } else { f32::NAN }),
        }
    }

    /// Variance of no light, DN²: read-out, and with a linear response curve what whole code values add. Floating-point
    /// files were not rounded to DN, but never are without any noise ([`LEAST_SD`]): a weight is one over it.
    pub(super) fn floor(&self, samples: &Samples) -> f32 {
        match samples {
            Samples::F32(_) => self.read.max((LEAST_SD * self.range()).powi(2)),
            _ => self.read + self.coding,
        }
    }

    /// Linear code values above black of one channel; saturated ones as +∞.
    pub fn linear(&self, samples: &Samples, channel: usize) -> Vec<f32> {
        let mut all = vec![0.0; samples.len()];
        self.linearize(samples, 0, &mut all);
        all.into_iter().skip(channel).step_by(3).collect()
    }

    /// Linear code values above black of all channels; saturated ones as +∞, what is no measurement as NaN.
    pub fn linear_samples(&self, samples: &Samples) -> Samples {
        let mut all = vec![0.0; samples.len()];
        self.linearize(samples, 0, &mut all);
        Samples::F32(all)
    }

    /// Linear code values from black to saturation.
    pub fn full_range(&self) -> f32 {
        self.range()
    }

    /// Code value without light.
    pub(super) fn black(&self) -> f32 {
        self.black
    }

    /// Largest linear value that counts.
    pub(super) fn range(&self) -> f32 {
        self.saturation - self.black
    }

    /// Variance that whole code values and compression add to a linear value above black of a channel, DN².
    pub fn file_variance(&self, linear: f32, channel: usize) -> f32 {
        self.coding + self.rounding(linear, channel)
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
        self.gain * linear.max(0.0) + self.read + self.file_variance(linear, channel)
    }

    /// Whether lossy compression adds to the noise.
    pub(super) fn is_compressed(&self) -> bool {
        self.file.is_compressed()
    }

    /// Whether code values are a curve of light.
    pub(super) fn is_curved(&self) -> bool {
        self.encoding.is_some()
    }

    /// What makes whole code values linear; `None` when they are.
    pub fn light_of_codes(&self) -> Option<Arc<LightOfCodes>> {
        self.encoding.as_ref().map(|e| e.light.clone())
    }

    /// Relative variance of light by its code values, which all rows have in common: of the curve, where it was
    /// estimated, and of colours that compression rounds alike wherever they are.
    pub fn codes_variance(&self) -> f64 {
        let curve = self.curve().map_or(0.0, Curve::relative_variance);
        let flat = if self.is_compressed() { self.file.flat.iter().sum::<f64>() / 3.0 } else { 0.0 };
        curve + LIGHT_PER_FLAT_CODE * LIGHT_PER_FLAT_CODE * flat
    }

    /// The response curve; `None` when it is linear.
    pub fn curve(&self) -> Option<&Curve> {
        self.encoding.as_ref().map(|e| &e.curve)
    }
}

impl Encoding {
    fn new(curve: Curve, noise: &Noise, file: FileNoise) -> Self {
        let coding: [f64; 3] = file.compression.map(|c| c + file.rounding_variance());
        // Light is the mean over the noise of what the camera encoded. Where the file spreads code values more than
        // that, the mean of the curve is too large by half its bend times the difference; where less, too small. A curve
        // that was estimated has been fitted to code values of the file, with all that compression adds taken for spread:
        // with the difference, which depends on the curve, the fit does not settle (11 % off where this leaves 1.5 %).
        let is_known = curve.relative_variance() == 0.0;
        let mean = |c: usize, code: f64| {
            let (light, slope) = (curve.linear_at(c, code), curve.slope_at(c, code));
            let gain = noise.gain_dn_per_electron;
            let photons = gain * (light - noise.black_dn).max(0.0);
            let sd = (photons + (gain * noise.read_noise_electrons).powi(2)).sqrt();
            let change = if is_known { file.change_at(sd / slope, c) } else { coding[c] };
            let excess = 0.5 * curve.bend_at(c, code) * change;
            (light - excess.clamp(-0.2 * light, 0.2 * light)) as f32
        };
        let triples = |n: usize| (0..n).flat_map(|k| (0..3).map(move |c| (k, c)));
        let of_u8 = triples(CODES).map(|(k, c)| mean(c, k as f64)).collect();
        let of_u16 = triples(1 << 16).map(|(k, c)| mean(c, k as f64 / 257.0)).collect();
        let variance = triples(ROOTS).map(|(k, c)| {
            let (_, slope) = at_root(&curve, k, c);
            (slope.powi(2) * coding[c]) as f32
        });
        Self { light: Arc::new(LightOfCodes { of_u8, of_u16 }), variance: variance.collect(), curve }
    }
}

/// The linear value of an entry of the table of variances, and the curve's slope there.
fn at_root(curve: &Curve, entry: usize, channel: usize) -> (f64, f64) {
    let linear = FULL * (entry as f64 / (ROOTS - 1) as f64).powi(2);
    (linear, curve.slope_at(channel, curve.code_at(channel, linear)))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOISE: Noise =
        Noise { black_dn: 3.0, saturation_dn: 240.0, gain_dn_per_electron: 0.4, read_noise_electrons: 6.0 };

    fn linear_sensor(compression: [f64; 3]) -> Sensor {
        Sensor::with_curve(&NOISE, None, FileNoise { sixteen_bit: false, compression, ..FileNoise::default() })
    }

    fn linearized(sensor: &Sensor, samples: &Samples, first: usize) -> Vec<f32> {
        let mut out = vec![0.0; samples.len() - first];
        sensor.linearize(samples, first, &mut out);
        out
    }

    #[test]
    fn linear_code_values_are_counted_from_black_and_end_at_saturation() {
        let sensor = linear_sensor([0.0; 3]);
        let expected = [-3.0, 0.0, 97.0, 236.0, f32::INFINITY, f32::INFINITY];
        assert_eq!(linearized(&sensor, &Samples::U8(vec![0, 3, 100, 239, 240, 255]), 0), expected);
        assert_eq!(linearized(&sensor, &Samples::U16(vec![0, 3, 100, 239, 240, 60_000]), 0), expected);
        assert_eq!(linearized(&sensor, &Samples::F32(vec![0.0, 3.0, 100.0, 239.0, 240.0, 1e30]), 0), expected);
        // From the second pixel on; one channel.
        assert_eq!(linearized(&sensor, &Samples::U8(vec![9, 9, 9, 4, 5, 6]), 3), [1.0, 2.0, 3.0]);
        let two = Samples::U16(vec![3, 13, 23, 33, 43, 240]);
        assert_eq!([0, 1, 2].map(|c| sensor.linear(&two, c)), [[0.0, 30.0], [10.0, 40.0], [20.0, f32::INFINITY]]);
        assert_eq!((sensor.full_range(), sensor.is_curved(), sensor.curve()), (237.0, false, None));
    }

    #[test]
    fn what_no_sensor_measures_is_nothing() {
        let float = Samples::F32(vec![f32::NAN, f32::NEG_INFINITY, f32::INFINITY, -241.0, -240.0, -20.0]);
        let found = linearized(&linear_sensor([0.0; 3]), &float, 0);
        assert!(found[0].is_nan() && found[1].is_nan() && found[3].is_nan(), "{found:?}");
        assert_eq!((found[2], found[4], found[5]), (f32::INFINITY, -243.0, -23.0));
    }

    #[test]
    fn variance_is_that_of_reading_of_whole_code_values_of_compression_and_of_photons() {
        let (whole, float) = (Samples::U8(vec![]), Samples::F32(vec![]));
        // (0.4 DN/e · 6 e)² = 5.76; 1/12 for rounding; the mean of the channels' compression, 3.
        let sensor = linear_sensor([0.0; 3]);
        let close = |a: f32, b: f64| (f64::from(a) / b - 1.0).abs() < 1e-6; // f32
        assert!(close(sensor.floor(&whole), 5.76 + 1.0 / 12.0) && close(sensor.floor(&float), 5.76));
        let compressed = linear_sensor([1.0, 2.0, 6.0]);
        assert!(close(compressed.floor(&whole), 8.76 + 1.0 / 12.0) && close(compressed.floor(&float), 5.76));
        for c in 0..3 {
            assert!(close(compressed.variance(150.0, c), 0.4 * 150.0 + 8.76 + 1.0 / 12.0));
            assert!(close(compressed.variance(-150.0, c), 8.76 + 1.0 / 12.0));
            assert_eq!(compressed.rounding(150.0, c), 0.0);
        }
        assert!(!FileNoise::default().is_compressed());
        // 0.007 · √0.25 of light: a third of a per cent.
        let flat = FileNoise { compression: [1.0; 3], flat: [0.1, 0.25, 0.4], ..FileNoise::default() };
        assert!((Sensor::with_curve(&NOISE, None, flat).codes_variance() - 3.5e-3f64.powi(2)).abs() < 1e-15);
        assert_eq!(sensor.codes_variance(), 0.0);
        assert!(FileNoise { sixteen_bit: true, compression: [0.0, 0.0, 0.1], ..FileNoise::default() }.is_compressed());
    }

    #[test]
    fn floating_point_values_of_a_rig_without_noise_have_a_variance_to_weigh_by() {
        let noise = Noise { gain_dn_per_electron: 0.0, read_noise_electrons: 0.0, ..NOISE };
        let sensor = Sensor::with_curve(&noise, None, FileNoise::default());
        // (237 DN · 10⁻⁶)²; whole numbers have their rounding.
        assert!((sensor.floor(&Samples::F32(vec![])) / 5.6169e-8 - 1.0).abs() < 1e-5);
        assert!((sensor.floor(&Samples::U16(vec![])) * 12.0 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn means_of_blocks_have_their_share_of_all_noise_that_of_rounding_included() {
        let mean = Samples::F32(vec![]);
        let sensor = linear_sensor([0.0; 3]).averaged(4, 8.0);
        // A sixteenth of 5.76 and of 1/12; photons alike.
        assert!((sensor.floor(&mean) * 16.0 - 5.76 - 1.0 / 12.0).abs() < 1e-5);
        assert!((sensor.variance(160.0, 0) * 16.0 - 0.4 * 160.0 - 5.76 - 1.0 / 12.0).abs() < 1e-4);
        // From 0 to 1, a code value is all there is: those were not rounded to one.
        let float = Noise { black_dn: 0.0, saturation_dn: 1.0, gain_dn_per_electron: 1e-4, read_noise_electrons: 10.0 };
        let sensor = Sensor::with_curve(&float, None, FileNoise::default()).averaged(4, 8.0);
        assert!((sensor.floor(&mean) * 16.0 - 1e-6).abs() < 1e-11);
    }

    /// Three curves, g = 255 (z / 255)^γ: γ is 1.6, 2.0 and 2.6.
    const GAMMA: [f64; 3] = [1.6, 2.0, 2.6];

    fn light(code: f64, c: usize) -> f64 {
        255.0 * (code / 255.0).powf(GAMMA[c])
    }

    fn curved_sensor(file: FileNoise) -> Sensor {
        sensor_with(&NOISE, file)
    }

    fn sensor_with(noise: &Noise, file: FileNoise) -> Sensor {
        let tables = (0..3).map(|c| (0..CODES).map(|z| light(z as f64, c)).collect()).collect();
        Sensor::with_curve(noise, Curve::new(tables, vec![vec![0.0; CODES]; 3]), file)
    }

    #[test]
    fn each_channel_is_decoded_by_its_own_curve_less_what_noise_adds_by_its_bend() {
        let change = [0.5, 3.0, 9.0];
        let file = FileNoise { compression: [1.0; 3], change: [change; NOISE_LEVELS], ..FileNoise::default() };
        let sensor = curved_sensor(file);
        let codes = [40u8, 90, 160, 200, 120, 70];
        let found = linearized(&sensor, &Samples::U8(codes.to_vec()), 0);
        let wide = linearized(&sensor, &Samples::U16(codes.map(|z| 257 * u16::from(z)).to_vec()), 0);
        for (k, &code) in codes.iter().enumerate() {
            let (z, c) = (f64::from(code), k % 3);
            let bend = GAMMA[c] * (GAMMA[c] - 1.0) * light(z, c) / (z * z);
            let expected = light(z, c) - 0.5 * bend * change[c] - 3.0;
            // Second differences over four codes: 1e-3 of the correction, which is 0.05 at most.
            assert!((f64::from(found[k]) - expected).abs() < 2e-4, "{k}: {} {expected}", found[k]);
            assert_eq!(wide[k], found[k], "16 bits are 257ths");
        }
        // Saturation is at a light of 240: below code 250 of γ = 2 (245), above 247 (239.3).
        let green = linearized(&sensor, &Samples::U8(vec![0, 250, 0, 0, 246, 0]), 0);
        assert!(green[1] == f32::INFINITY && green[4].is_finite(), "{green:?}");
    }

    #[test]
    fn the_correction_for_a_bend_is_no_more_than_a_fifth_of_the_light() {
        // Code 20 of γ = 2: light 1.5686, bend 2/255, half of it times 200 is 0.784; of γ = 1.6: 4.34, 0.0104, 1.04.
        let file = FileNoise { compression: [1.0; 3], change: [[200.0; 3]; NOISE_LEVELS], ..FileNoise::default() };
        let sensor = curved_sensor(file);
        let found = linearized(&sensor, &Samples::U8(vec![20; 3]), 0);
        for c in 0..2 {
            // f32.
            assert!((f64::from(found[c]) - (0.8 * light(20.0, c) - 3.0)).abs() < 1e-5, "{c}: {}", found[c]);
        }
    }

    #[test]
    fn rounding_and_compression_reach_the_light_by_the_slope_at_the_code_that_shows_it() {
        let compression = [0.5, 3.0, 9.0];
        for (file, step) in [
            (FileNoise { sixteen_bit: false, compression, ..FileNoise::default() }, 1.0),
            (FileNoise { sixteen_bit: false, ..FileNoise::default() }, 1.0),
            (FileNoise { sixteen_bit: true, ..FileNoise::default() }, 1.0 / 257.0),
        ] {
            let sensor = curved_sensor(file);
            for c in 0..3 {
                for code in [60.0, 130.0, 220.0] {
                    let slope = GAMMA[c] * light(code, c) / code;
                    let expected = slope * slope * (file.compression[c] + step * step / 12.0);
                    // The linear value is counted from black, the curve is not.
                    let found = f64::from(sensor.rounding((light(code, c) - 3.0) as f32, c));
                    // A table of 1024 entries over the root of the light, whose entry below is taken.
                    assert!((found / expected - 1.0).abs() < 0.02, "{c} {code}: {found} {expected}");
                    let all = f64::from(sensor.variance((light(code, c) - 3.0) as f32, c));
                    let sum = 0.4 * (light(code, c) - 3.0) + 5.76 + found;
                    assert!((all / sum - 1.0).abs() < 1e-5, "{c} {code}: {all} {sum}");
                }
            }
            // What a curve's table holds is not added once more.
            assert!((sensor.floor(&Samples::U8(vec![])) - 5.76).abs() < 1e-6);
            assert!(sensor.is_curved() && sensor.rounding(1e9, 0).is_finite() && sensor.rounding(-50.0, 2) >= 0.0);
        }
    }

    /// Mean light of a JPEG of `quality` that sees `linear` DN of light everywhere, above black, R G B.
    fn mean_of_jpeg(noise: &Noise, linear: f64, quality: u8) -> [f64; 3] {
        use image::ImageEncoder;
        let side = 512;
        let mut rng = <rand_pcg::Pcg64Mcg as rand::SeedableRng>::seed_from_u64(3);
        let mut normal = || -> f64 { rand_distr::Distribution::sample(&rand_distr::StandardNormal, &mut rng) };
        let sd = (noise.gain_dn_per_electron * linear
            + (noise.gain_dn_per_electron * noise.read_noise_electrons).powi(2))
        .sqrt();
        // Blocks of 8 × 8 whose light is within a fifth of `linear`: their means are rounded up as often as down.
        let seen = |k: usize, deviate: f64| {
            let (x, y) = (k / 3 % side / 8, k / 3 / side / 8);
            let share = (x + side / 8 * y) as f64 * 0.618_034 % 1.0 - 0.5;
            let of = linear * (1.0 + 0.4 * share) + noise.black_dn;
            (255.0 * ((of + sd * deviate).max(0.0) / 255.0).powf(1.0 / GAMMA[k % 3])).round().min(255.0) as u8
        };
        let pixels: Vec<u8> = (0..3 * side * side).map(|k| seen(k, normal())).collect();
        let mut bytes = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
        encoder.write_image(&pixels, side as u32, side as u32, image::ExtendedColorType::Rgb8).unwrap();
        let file = FileNoise {
            sixteen_bit: false,
            compression: compression_variance(&bytes, CODE_NOISE).unwrap(),
            flat: flat_variance(&bytes).unwrap(),
            change: change_of_variance(&bytes).unwrap(),
        };
        let read = Samples::U8(image::load_from_memory(&bytes).unwrap().into_rgb8().into_raw());
        let found = linearized(&sensor_with(noise, file), &read, 0);
        [0, 1, 2].map(|c| found.iter().skip(c).step_by(3).map(|v| f64::from(*v)).sum::<f64>() / (side * side) as f64)
    }

    #[test]
    fn light_of_a_jpeg_is_that_of_the_camera_whatever_compression_takes_or_adds() {
        let noise = Noise { read_noise_electrons: 1.0, black_dn: 0.0, ..NOISE };
        for quality in [85, 95, 99] {
            for linear in [6.0, 15.0, 60.0, 150.0] {
                let found = mean_of_jpeg(&noise, linear, quality);
                // Green, γ = 2, which the rounding of encoder and decoder leaves nearest to its place (0.06 code values at
                // these qualities; red and blue 0.2, by the chroma's). Without the correction 0.2 at 85 and a light of 6.
                let code = 255.0 * (linear / 255.0f64).sqrt();
                let off_codes = (found[1] / linear - 1.0) * code / 2.0;
                assert!(off_codes.abs() < 0.1, "{quality} {linear}: {off_codes}");
            }
        }
    }

    /// Root mean square error of means over `pixels` pixels of 8 bits that see the same light, over a code value's
    /// slope there, when the sensor's noise is `noise` code values.
    fn error_of_means(noise: f64, pixels: usize) -> f64 {
        let (mut state, mut sum) = (9u64, 0.0);
        let mut uniform = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let patches = 400;
        for k in 0..patches {
            let code = 100.0 + (k as f64 + 0.5) / patches as f64;
            let mut mean = 0.0;
            for _ in 0..pixels {
                // Twelve uniform numbers are normal enough.
                let normal = (0..12).map(|_| uniform()).sum::<f64>() - 6.0;
                mean += (code + noise * normal).round() / pixels as f64;
            }
            sum += (mean - code).powi(2) / patches as f64;
        }
        sum.sqrt()
    }

    #[test]
    fn pixels_that_are_lit_alike_are_rounded_alike_unless_noise_spreads_them() {
        // At code 100 of γ = 2 light is 39.2 and a code value 0.784 of it. 256 pixels of a patch, in means of 16.
        let (slope, linear) = (2.0 * light(100.0, 1) / 100.0, light(100.0, 1) as f32 - 3.0);
        for noise_codes in [0.0, 0.1, 0.2, 0.3, 0.5, 1.0] {
            let noise = Noise { gain_dn_per_electron: 1e-9, read_noise_electrons: 1e9 * noise_codes * slope, ..NOISE };
            let sensor = sensor_with(&noise, FileNoise::default()).averaged(4, 4.0);
            let of_mean = sensor.floor(&Samples::F32(vec![])) + sensor.rounding(linear, 1);
            let stated = f64::from(of_mean / 16.0).sqrt() / slope;
            let found = error_of_means(noise_codes, 256);
            // It is an upper bound, of 1.3 where noise spreads a little (1/12 for 1/2π²), and known to 4 %.
            assert!((0.95..1.45).contains(&(stated / found)), "{noise_codes}: {stated} {found}");
        }
        // Compression takes the noise away first: what stays is what the file says.
        let file =
            FileNoise { sixteen_bit: false, compression: [3.0; 3], flat: [0.1, 0.2, 0.3], ..FileNoise::default() };
        let sensor = curved_sensor(file).averaged(4, 4.0);
        let stated = f64::from(sensor.rounding(linear, 1)) / (slope * slope);
        let expected = (3.0 + 1.0 / 12.0) / 16.0 + (0.2 + 1.0 / 12.0) * 16.0;
        // The table's entry below.
        assert!((stated / expected - 1.0).abs() < 0.02, "{stated} {expected}");
    }
}
