//! Light to code values: photons, read-out, pedestal, rounding, clipping.

use crate::capture::Noise;
use crate::simulate::{FileFormat, Options};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

/// Gain of a Sony A7r3 at 14 bits, DN per electron (facts: .40).
const GAIN_DN: f64 = 0.40;
/// Its noise before the gain, electrons, and after it, DN: .71 and 3.0, together 7.5 electrons.
const READ_ELECTRONS: f64 = 0.71;
const ADC_DN: f64 = 3.0;
/// The pedestal at 14 bits, DN.
const BLACK_DN: f64 = 512.0;
/// Where the sensor is said to be linear up to, of its largest code value.
const LINEAR_UP_TO: f64 = 0.98;
/// Means above which one normal deviate stands for photons and read-out together (skewness below 0.03).
const JOINT_ABOVE: f32 = 1200.0;
/// Means above which the quantile expansion is used instead of the exact inversion.
const INVERT_BELOW: f32 = 12.0;

/// The sensor of one capture, in code values of the linear signal.
#[derive(Debug, Clone)]
pub(crate) struct Sensor {
    black_dn: f32,
    max_dn: f32,
    gain: f32,
    read_electrons: f32,
    noise_free: bool,
    srgb: bool,
}

impl Sensor {
    /// The sensor that the options ask for.
    pub fn new(options: &Options) -> Self {
        let read_electrons = READ_ELECTRONS.hypot(ADC_DN / GAIN_DN);
        let (black, max, srgb) = match options.format {
            FileFormat::Png => {
                let max = f64::from((1u32 << options.bits) - 1);
                ((BLACK_DN * max / 16_383.0).round(), max, false)
            }
            FileFormat::Jpeg => (0.0, 255.0, true),
        };
        let gain = GAIN_DN * (max - black) / (16_383.0 - BLACK_DN);
        Self {
            black_dn: black as f32,
            max_dn: max as f32,
            gain: gain as f32,
            read_electrons: read_electrons as f32,
            noise_free: options.noise_free,
            srgb,
        }
    }

    /// What the rig file says of it.
    pub fn noise(&self) -> Noise {
        let (gain, read) = if self.noise_free { (0.0, 0.0) } else { (self.gain, self.read_electrons) };
        let tidy = |v: f32| (f64::from(v) * 1e6).round() / 1e6;
        Noise {
            black_dn: f64::from(self.black_dn),
            saturation_dn: (f64::from(self.max_dn) * LINEAR_UP_TO).round(),
            gain_dn_per_electron: tidy(gain),
            read_noise_electrons: tidy(read),
        }
    }

    /// Electrons that fill the range.
    pub fn full_range_electrons(&self) -> f64 {
        f64::from((self.max_dn - self.black_dn) / self.gain)
    }

    /// Code values for mean electron counts `rate · exposure_secs`; the same seed gives the same picture.
    pub fn expose(&self, rate: &[f32], exposure_secs: f64, seed: u64) -> Vec<u16> {
        let exposure = exposure_secs as f32;
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let code = |electrons: f32| {
            let linear = (self.black_dn + self.gain * electrons).clamp(0.0, self.max_dn);
            let encoded = if self.srgb { 255.0 * srgb_from_linear(linear / 255.0) } else { linear };
            encoded.round() as u16
        };
        if self.noise_free {
            return rate.iter().map(|r| code(r * exposure)).collect();
        }
        let read = self.read_electrons;
        rate.iter()
            .map(|r| {
                let mean = r * exposure;
                let normal: f32 = StandardNormal.sample(&mut rng);
                if mean > JOINT_ABOVE {
                    return code(mean + (mean + read * read).sqrt() * normal);
                }
                code(poisson(mean, &mut rng) + read * normal)
            })
            .collect()
    }
}

/// A Poisson count. Inverted exactly below a mean of 12, above it by the quantile expansion of Giles 2016
/// (ACM TOMS 42, eq. Q_N2, whose error in probability falls as 1/mean and is below 1e-3 here).
fn poisson(mean: f32, rng: &mut Pcg64Mcg) -> f32 {
    if mean <= 0.0 {
        return 0.0;
    }
    if mean > INVERT_BELOW {
        let w: f32 = StandardNormal.sample(rng);
        let root = mean.sqrt();
        let quantile = mean + root * w + (2.0 + w * w) / 6.0 - (w / 36.0 + w * w * w / 72.0) / root;
        return quantile.floor().max(0.0);
    }
    let mut remains: f32 = rng.random();
    let mut term = (-mean).exp();
    let mut count = 0.0;
    while remains > term && count < 100.0 {
        remains -= term;
        count += 1.0;
        term *= mean / count;
    }
    count
}

/// The sRGB curve (IEC 61966-2-1), linear to encoded, both 0 to 1.
fn srgb_from_linear(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(codes: &[u16]) -> (f64, f64) {
        let n = codes.len() as f64;
        let mean = codes.iter().map(|&c| f64::from(c)).sum::<f64>() / n;
        (mean, codes.iter().map(|&c| (f64::from(c) - mean).powi(2)).sum::<f64>() / (n - 1.0))
    }

    #[test]
    fn mean_and_variance_are_those_of_the_rig_file() {
        let sensor = Sensor::new(&Options::default());
        let noise = sensor.noise();
        for electrons in [0.0, 0.7, 5.0, 11.9, 12.1, 40.0, 300.0, 1190.0, 1210.0, 20_000.0] {
            let n = 200_000;
            let (mean, variance) = moments(&sensor.expose(&vec![electrons as f32; n], 1.0, 9));
            let (gain, read) = (noise.gain_dn_per_electron, noise.read_noise_electrons);
            let signal = gain * electrons;
            let expected = gain * signal + (gain * read).powi(2) + 1.0 / 12.0;
            // Five standard errors of each.
            let mean_error = (mean - noise.black_dn - signal).abs();
            assert!(mean_error < 5.0 * (expected / n as f64).sqrt(), "{electrons}: mean off by {mean_error}");
            let ratio = variance / expected;
            assert!((ratio - 1.0).abs() < 5.0 * (2.0 / n as f64).sqrt(), "{electrons}: variance ratio {ratio}");
        }
    }

    #[test]
    fn counts_are_poisson() {
        let mut rng = Pcg64Mcg::seed_from_u64(3);
        for mean in [2.0f32, 30.0] {
            let n = 400_000;
            let counts: Vec<f64> = (0..n).map(|_| f64::from(poisson(mean, &mut rng))).collect();
            let m = counts.iter().sum::<f64>() / f64::from(n);
            let third = counts.iter().map(|c| (c - m).powi(3)).sum::<f64>() / f64::from(n);
            // The third central moment of a Poisson variable is its mean; its standard error is about √(15 mean³/n).
            let error = 5.0 * (15.0 * f64::from(mean).powi(3) / f64::from(n)).sqrt();
            assert!((third - f64::from(mean)).abs() < error, "{mean}: {third}");
        }
    }

    #[test]
    fn without_noise_only_rounding_remains() {
        let sensor = Sensor::new(&Options { noise_free: true, ..Options::default() });
        assert_eq!(sensor.expose(&[0.0, 1000.0, 1e9], 1.0, 0), vec![512, 912, 16_383]);
        assert_eq!(sensor.noise().gain_dn_per_electron, 0.0);
    }
}
