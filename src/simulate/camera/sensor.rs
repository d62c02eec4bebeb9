//! Light to code values: photons, read-out, pedestal, conversion, response curve, clipping.

use super::{
    curve::Table,
    devices::Device,
    normal::{BLOCK, Normals},
};
use crate::capture::Noise;
use crate::simulate::{CameraCurve, FileFormat, SimulateOptions};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Where the sensor is said to be linear up to, of its largest code value.
const LINEAR_UP_TO: f64 = 0.98;
/// Read noise (electrons) from which photons and read-out together are smooth at any mean, and mean count from which
/// they are at any read noise: there one deviate stands for both.
const SMOOTH_READ: f32 = 3.0;
const SMOOTH_MEAN: f32 = 25.0;
/// Adding it to a number of up to 22 bits leaves the nearest whole number in the lowest bits.
const ROUNDER: f32 = 8_388_608.0;

/// The sensor of one capture.
#[derive(Debug, Clone)]
pub(crate) struct SimulatedSensor {
    /// Of the converter, DN.
    black_dn: f32,
    max_dn: f32,
    gain: f32,
    read_electrons: f32,
    noise_free: bool,
    development: Development,
    /// Linear code values of the file at black and at the converter's largest value: what the rig file counts in.
    file_black_dn: f64,
    file_max_dn: f64,
}

/// What becomes of the converter's values.
#[derive(Debug, Clone)]
enum Development {
    /// They are the code values.
    Raw,
    /// They are scaled to the file's range, with the pedestal.
    Scaled(f32),
    /// The pedestal is taken off, as cameras do, and a curve applied.
    Curve(Table),
}

impl SimulatedSensor {
    /// The sensor that the options ask for.
    pub(crate) fn new(options: &SimulateOptions) -> Self {
        let device = Device::of(options.sensor);
        let own_max = f64::from((1u32 << device.bits) - 1);
        let max = f64::from((1u32 << options.bits.unwrap_or(device.bits)) - 1);
        let black = (device.black_dn * max / own_max).round();
        let gain = device.gain_dn_per_electron * (max - black) / (own_max - device.black_dn);
        let max_code = match options.format {
            FileFormat::Png | FileFormat::Tiff | FileFormat::TiffDeflate => 65_535.0,
            FileFormat::Jpeg => 255.0,
        };
        // The rig counts the linear signal of encoded files from 0 to 255, whatever their bits.
        let (development, file_black_dn, file_max_dn) = match (options.response_curve(), options.format) {
            (CameraCurve::Linear, FileFormat::Jpeg) => {
                (Development::Scaled((max_code / max) as f32), black * max_code / max, max_code)
            }
            (CameraCurve::Linear, _) => (Development::Raw, black, max),
            (curve, _) => (Development::Curve(Table::new(curve, max_code)), 0.0, 255.0),
        };
        Self {
            black_dn: black as f32,
            max_dn: max as f32,
            gain: gain as f32,
            read_electrons: device.noise_electrons() as f32,
            noise_free: options.noise_free,
            development,
            file_black_dn,
            file_max_dn,
        }
    }

    /// What the rig file says of it.
    pub(crate) fn noise(&self) -> Noise {
        let gain =
            f64::from(self.gain) * (self.file_max_dn - self.file_black_dn) / f64::from(self.max_dn - self.black_dn);
        let (gain, read) = if self.noise_free { (0.0, 0.0) } else { (gain, f64::from(self.read_electrons)) };
        let tidy = |v: f64| (v * 1e6).round() / 1e6;
        Noise {
            black_dn: tidy(self.file_black_dn),
            saturation_dn: (self.file_max_dn * LINEAR_UP_TO).round(),
            gain_dn_per_electron: tidy(gain),
            read_noise_electrons: tidy(read),
        }
    }

    /// Electrons that fill the range.
    pub(crate) fn full_range_electrons(&self) -> f64 {
        f64::from((self.max_dn - self.black_dn) / self.gain)
    }

    /// Code values for mean electron counts `rate · lit_secs`, and `dark_secs` of the currents of `hot` photosites
    /// besides (index, electrons per second; in order). The same seed gives the same picture on every processor.
    pub(crate) fn expose(
        &self,
        rate: &[f32],
        hot: &[(usize, f32)],
        lit_secs: f64,
        dark_secs: f64,
        seed: u64,
        codes: &mut Vec<u16>,
    ) {
        codes.resize(rate.len(), 0);
        let (lit_secs, dark_secs) = (lit_secs as f32, dark_secs as f32);
        // Wider vectors make the same sums and roundings, only faster: nothing is contracted or reordered.
        pulp::Arch::new().dispatch(Exposure { sensor: self, rate, hot, lit_secs, dark_secs, seed, codes });
    }

    /// Mean counts to electrons as read out.
    #[inline(always)]
    fn add_noise(&self, mean: &mut [f32; BLOCK], normal: &[f32; BLOCK], rng: &mut Pcg64Mcg) {
        let read = self.read_electrons;
        if read >= SMOOTH_READ || mean.iter().all(|m| *m >= SMOOTH_MEAN) {
            mean.iter_mut().zip(normal).for_each(|(m, w)| *m = smooth(*m, read, *w));
            return;
        }
        for (m, w) in mean.iter_mut().zip(normal) {
            *m = if *m >= SMOOTH_MEAN { smooth(*m, read, *w) } else { poisson(*m, rng) + read * w };
        }
    }

    /// Electrons to code values.
    #[inline(always)]
    fn convert(&self, electrons: &[f32; BLOCK], codes: &mut [u16]) {
        // Never below 0 nor above the largest value; the pedestal is far from both.
        let rounded = |e: f32| (self.black_dn + self.gain * e).clamp(0.0, self.max_dn) + ROUNDER;
        let values = codes.iter_mut().zip(electrons);
        match &self.development {
            Development::Raw => values.for_each(|(code, &e)| *code = rounded(e).to_bits() as u16),
            Development::Scaled(scale) => {
                values.for_each(|(code, &e)| *code = ((rounded(e) - ROUNDER) * scale + ROUNDER).to_bits() as u16);
            }
            Development::Curve(table) => {
                let per_range = 1.0 / (self.max_dn - self.black_dn);
                values.for_each(|(code, &e)| {
                    let linear = (rounded(e) - ROUNDER - self.black_dn) * per_range;
                    *code = (table.encode(linear) + ROUNDER).to_bits() as u16;
                });
            }
        }
    }
}

/// One exposure, as a value: so all of it is compiled for each kind of processor. A closure would not be.
struct Exposure<'a> {
    sensor: &'a SimulatedSensor,
    rate: &'a [f32],
    hot: &'a [(usize, f32)],
    lit_secs: f32,
    dark_secs: f32,
    seed: u64,
    codes: &'a mut [u16],
}

impl pulp::NullaryFnOnce for Exposure<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { sensor, rate, hot, lit_secs, dark_secs, seed, codes } = self;
        let (mut normals, mut counts) = (Normals::new(seed), Pcg64Mcg::seed_from_u64(seed));
        let (mut mean, mut normal) = ([0.0; BLOCK], [0.0; BLOCK]);
        let mut hot = hot.iter().peekable();
        for (k, (codes, rate)) in codes.chunks_mut(BLOCK).zip(rate.chunks(BLOCK)).enumerate() {
            mean.iter_mut().zip(rate).for_each(|(m, r)| *m = r * lit_secs);
            while let Some((photosite, current)) = hot.next_if(|h| h.0 < (k + 1) * BLOCK) {
                mean[photosite - k * BLOCK] += current * dark_secs;
            }
            if !sensor.noise_free {
                normals.fill(&mut normal);
                sensor.add_noise(&mut mean, &normal, &mut counts);
            }
            sensor.convert(&mean, codes);
        }
    }
}

/// A Poisson count of the given mean and normal read noise together, from one normal deviate: the expansion of
/// Cornish and Fisher (1938) with the first four cumulants, m, m + r², m, m.
///
/// For skewness up to 0.2, which the two limits keep it below, probabilities err by less than 1e-3.
#[inline(always)]
fn smooth(mean: f32, read: f32, w: f32) -> f32 {
    let mean = mean.max(0.0);
    let variance = mean + read * read;
    let sd = variance.sqrt();
    let per_sd = 1.0 / sd;
    let share = mean * per_sd * per_sd;
    let w2 = w * w;
    let fourth = w * ((w2 - 3.0) * (1.0 / 24.0) - share * (2.0 * w2 - 5.0) * (1.0 / 36.0));
    mean + sd * w + share * ((w2 - 1.0) * (1.0 / 6.0) + fourth * per_sd)
}

/// A Poisson count, by inversion.
fn poisson(mean: f32, rng: &mut Pcg64Mcg) -> f32 {
    if !(mean > 0.0) {
        return 0.0;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::{SensorKind, camera::hot_pixels::hot_pixels, scene::patterns::normal_cdf};

    const KINDS: [SensorKind; 4] = [SensorKind::SonyA7r3, SensorKind::SonyA7r1, SensorKind::CanonT1, SensorKind::Phone];

    fn expose(
        sensor: &SimulatedSensor,
        rate: &[f32],
        hot: &[(usize, f32)],
        lit_secs: f64,
        dark_secs: f64,
        seed: u64,
    ) -> Vec<u16> {
        let mut codes = Vec::new();
        sensor.expose(rate, hot, lit_secs, dark_secs, seed, &mut codes);
        codes
    }

    #[test]
    fn wide_vectors_give_the_codes_of_narrow_ones() {
        let rate: Vec<f32> = (0..100_003).map(|i| (i as f32 * 0.37) % 50_000.0).collect();
        let hot = hot_pixels(rate.len(), 1e-3, 8);
        for (kind, curve) in [
            (SensorKind::SonyA7r3, CameraCurve::Linear),
            (SensorKind::SonyA7r1, CameraCurve::Srgb),
            (SensorKind::Phone, CameraCurve::Film),
        ] {
            let sensor = SimulatedSensor::new(&SimulateOptions {
                sensor: kind,
                response_curve: Some(curve),
                ..SimulateOptions::default()
            });
            let mut narrow = vec![0; rate.len()];
            let (rate, hot, codes) = (&rate[..], &hot[..], &mut narrow[..]);
            pulp::NullaryFnOnce::call(Exposure {
                sensor: &sensor,
                rate,
                hot,
                lit_secs: 0.3,
                dark_secs: 0.4,
                seed: 5,
                codes,
            });
            assert!(expose(&sensor, rate, hot, 0.3, 0.4, 5) == narrow, "{kind:?}");
        }
    }

    fn moments(codes: &[u16]) -> (f64, f64) {
        let n = codes.len() as f64;
        let mean = codes.iter().map(|&c| f64::from(c)).sum::<f64>() / n;
        (mean, codes.iter().map(|&c| (f64::from(c) - mean).powi(2)).sum::<f64>() / (n - 1.0))
    }

    #[test]
    fn mean_and_variance_are_those_of_the_rig_file() {
        for (sensor, bits) in
            KINDS.map(|s| (s, None)).into_iter().chain([12, 14, 16].map(|b| (SensorKind::SonyA7r3, Some(b))))
        {
            let sensor = SimulatedSensor::new(&SimulateOptions { sensor, bits, ..SimulateOptions::default() });
            let noise = sensor.noise();
            let (gain, read) = (noise.gain_dn_per_electron, noise.read_noise_electrons);
            for electrons in [0.0, 0.7, 5.0, 11.9, 24.9, 25.1, 40.0, 300.0, 1190.0, 2400.0] {
                let n = 200_000;
                let (mean, variance) = moments(&expose(&sensor, &vec![electrons as f32; n], &[], 1.0, 1.0, 9));
                let signal = gain * electrons;
                let expected = gain * signal + (gain * read).powi(2) + 1.0 / 12.0;
                // Five standard errors of each. Rounding adds 1/12 only where noise covers a code value or so: with
                // less its mean is off by exp(−2π²σ²)/π at most and its variance by four times exp(−2π²σ²) (Widrow
                // 1996).
                let uneven = (-2.0 * (std::f64::consts::PI.powi(2)) * (expected - 1.0 / 12.0)).exp();
                let error = (mean - noise.black_dn - signal).abs();
                assert!(
                    error < 5.0 * (expected / n as f64).sqrt() + uneven / 3.0,
                    "{bits:?} {electrons}: mean {error}"
                );
                let error = (variance / expected - 1.0).abs();
                let limit = 5.0 * ((2.0 + 1.0 / expected) / n as f64).sqrt() + 4.0 * uneven / expected;
                assert!(error < limit, "{noise:?} {electrons}: variance off by {error} of it, limit {limit}");
            }
        }
    }

    /// P(count + read noise < x), by summing over counts.
    fn exact(mean: f64, read: f64, x: f64) -> f64 {
        let (mut term, mut sum) = ((-mean).exp(), 0.0);
        for count in 0..(mean + 12.0 * mean.sqrt() + 30.0) as u32 {
            sum += term * normal_cdf((x - f64::from(count)) / read);
            term *= mean / f64::from(count + 1);
        }
        sum
    }

    #[test]
    fn one_deviate_has_the_distribution_of_photons_and_read_noise() {
        for (mean, read) in
            [(1.0, 4.3), (8.0, 4.3), (40.0, 4.3), (30.0, 7.55), (200.0, 7.55), (25.0, 0.71), (120.0, 0.71)]
        {
            let mut worst = 0.0f64;
            for k in -45..=45 {
                let w = f64::from(k) / 10.0;
                let x = f64::from(smooth(mean as f32, read as f32, w as f32));
                worst = worst.max((exact(mean, read, x) - normal_cdf(w)).abs());
            }
            assert!(worst < 1e-3, "{mean} {read}: probabilities err by {worst}");
        }
    }

    #[test]
    fn photons_are_poisson_down_to_the_third_moment() {
        for kind in KINDS {
            let sensor =
                SimulatedSensor::new(&SimulateOptions { sensor: kind, bits: Some(16), ..SimulateOptions::default() });
            let (gain, black) = (sensor.noise().gain_dn_per_electron, sensor.noise().black_dn);
            for mean in [2.0f64, 20.0, 60.0] {
                let n = 400_000;
                let codes = expose(&sensor, &vec![mean as f32; n], &[], 1.0, 1.0, 3);
                let electrons = codes.iter().map(|&c| (f64::from(c) - black) / gain);
                let m = electrons.clone().sum::<f64>() / n as f64;
                let third = electrons.map(|e| (e - m).powi(3)).sum::<f64>() / n as f64;
                // The third central moment of photons is their mean, noise adds none; its standard error is about √(15
                // σ⁶/n).
                let variance = mean + f64::from(sensor.read_electrons).powi(2) + 1.0 / (12.0 * gain * gain);
                let error = 5.0 * (15.0 * variance.powi(3) / n as f64).sqrt();
                assert!((third - mean).abs() < error, "{kind:?} {mean}: {third}, within {error}");
            }
        }
    }

    #[test]
    fn without_noise_only_rounding_remains() {
        let sensor = SimulatedSensor::new(&SimulateOptions { noise_free: true, ..SimulateOptions::default() });
        assert_eq!(expose(&sensor, &[0.0, 1000.0, 1e9], &[], 1.0, 1.0, 0), vec![512, 912, 16_383]);
        assert_eq!(sensor.noise().gain_dn_per_electron, 0.0);
        let wide =
            SimulatedSensor::new(&SimulateOptions { noise_free: true, bits: Some(16), ..SimulateOptions::default() });
        assert_eq!(expose(&wide, &[-1e9, 1e9], &[], 1.0, 1.0, 0), vec![0, 65_535]);
    }

    #[test]
    fn the_pedestal_is_kept_in_linear_files() {
        for (format, black) in [(FileFormat::Png, 512.0), (FileFormat::Jpeg, 512.0 * 255.0 / 16_383.0)] {
            let options =
                SimulateOptions { format, response_curve: Some(CameraCurve::Linear), ..SimulateOptions::default() };
            let sensor = SimulatedSensor::new(&options);
            assert!((sensor.noise().black_dn - black).abs() < 1e-6);
            let codes = expose(&sensor, &[0.0; 100_000], &[], 1.0, 1.0, 4);
            let (mean, variance) = moments(&codes);
            // Symmetric about the pedestal: nothing was cut off. Eight bits cannot resolve the noise, only round it.
            let tolerance = if format == FileFormat::Png { 0.05 } else { 0.1 };
            assert!((mean - black).abs() < tolerance, "{mean}");
            assert!(format == FileFormat::Jpeg || (variance - 9.16).abs() < 0.2, "{variance}");
        }
    }

    #[test]
    fn encoded_files_decode_to_the_light_that_made_them() {
        for format in [FileFormat::Png, FileFormat::Jpeg] {
            let options = SimulateOptions {
                format,
                response_curve: Some(CameraCurve::Srgb),
                noise_free: true,
                ..SimulateOptions::default()
            };
            let sensor = SimulatedSensor::new(&options);
            let full = sensor.full_range_electrons();
            let top = if format == FileFormat::Png { 65_535.0 } else { 255.0 };
            for share in [0.001, 0.02, 0.2, 0.7] {
                let code = expose(&sensor, &[(share * full) as f32], &[], 1.0, 1.0, 0)[0];
                let expected = top * CameraCurve::Srgb.encode(share);
                // Half a code value, and half a step of the converter times the slope of the curve.
                let slope = top * (CameraCurve::Srgb.encode(share + 1e-6) - CameraCurve::Srgb.encode(share)) / 1e-6;
                assert!(
                    (f64::from(code) - expected).abs() <= 0.55 + 0.5 * slope / 15_871.0,
                    "{share}: {code} {expected}"
                );
            }
            assert_eq!(sensor.noise().saturation_dn, 250.0);
        }
    }

    #[test]
    fn hot_pixels_stay_in_place_and_grow_with_exposure() {
        let sensor = SimulatedSensor::new(&SimulateOptions { noise_free: true, ..SimulateOptions::default() });
        let (rate, hot) = (vec![100.0; 30_000], hot_pixels(30_000, 1e-3, 8));
        let bright = |secs: f64| {
            let codes = expose(&sensor, &rate, &hot, secs, secs, 1);
            let dark = expose(&sensor, &rate, &[], secs, secs, 1);
            let extra = codes.iter().zip(dark).map(|(a, b)| f64::from(*a) - f64::from(b));
            extra.enumerate().filter(|(_, e)| *e > 0.0).collect::<Vec<_>>()
        };
        let (short, long) = (bright(1.0), bright(4.0));
        assert_eq!(long.len(), 30);
        for (place, extra) in &short {
            let longer = long.iter().find(|l| l.0 == *place).unwrap().1;
            // Two roundings; no pixel of these reaches saturation.
            assert!((longer - 4.0 * extra).abs() <= 5.0 || longer > 15_000.0, "{place}: {extra} {longer}");
        }
    }
}
