//! Brackets of an even grey at a known level, merged, against the truth and the bound.
#![allow(dead_code)]

use super::photon_sensor::PhotonSensor;
use acquire::capture::{Noise, Rect, Samples};
use acquire::radiance::{Exposure, FileNoise, Radiance, Sensor, merge};
use rand::SeedableRng;

/// A sensor and its exposures.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Bracketing {
    pub sensor: PhotonSensor,
    pub shortest_secs: f64,
    pub exposures: usize,
    pub stops: f64,
}

/// What merging made of one level.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Found {
    /// Mean squared error over the Cramér–Rao bound.
    pub of_bound: f64,
    /// Mean error over the truth, and its standard error.
    pub bias: f64,
    pub standard_error: f64,
    /// Mean stated variance over the mean squared error.
    pub stated: f64,
    /// Root mean square error over the truth.
    pub relative_rms: f64,
}

impl Bracketing {
    pub(crate) fn times(&self) -> Vec<f64> {
        (0..self.exposures).map(|k| self.shortest_secs * (k as f64 * self.stops).exp2()).collect()
    }

    /// The highest level, electrons per second: three standard deviations below the shortest exposure's saturation.
    pub(crate) fn top(&self) -> f64 {
        let full = self.sensor.full_electrons();
        (full - 3.0 * full.sqrt().hypot(self.sensor.read_noise_electrons)) / self.shortest_secs
    }

    /// Levels over so many decades down from the top, and around the saturation of every exposure but the shortest.
    pub(crate) fn levels(&self, decades: usize, per_decade: usize) -> Vec<f64> {
        let full = self.sensor.full_electrons();
        let sd = full.sqrt().hypot(self.sensor.read_noise_electrons);
        let step = |k: usize| self.top() * 10f64.powf(-(k as f64) / per_decade as f64);
        let near = |t: f64| [-3.5, -2.0, -1.0, 0.0, 1.0, 2.0, 3.5].map(|z| (full + z * sd) / t);
        let mut levels: Vec<f64> = (0..=decades * per_decade).map(step).collect();
        levels.extend(self.times().into_iter().skip(1).flat_map(near));
        levels.sort_by(|a, b| b.total_cmp(a));
        levels
    }

    /// Whether some exposure of this level is saturated by chance: within three standard deviations of it.
    pub(crate) fn near_saturation(&self, electrons_per_sec: f64) -> bool {
        let full = self.sensor.full_electrons();
        self.times().iter().any(|t| {
            let mean = electrons_per_sec * t;
            (mean - full).abs() < 3.0 * mean.sqrt().hypot(self.sensor.read_noise_electrons)
        })
    }

    /// Least variance of an unbiased estimate, (e⁻/s)².
    pub(crate) fn bound(&self, electrons_per_sec: f64) -> f64 {
        1.0 / self.times().iter().map(|t| t * t * self.sensor.information(electrons_per_sec * t)).sum::<f64>()
    }

    pub(crate) fn merger(&self) -> Sensor {
        let s = &self.sensor;
        let noise = Noise {
            black_dn: s.black_dn,
            saturation_dn: s.saturation_dn,
            gain_dn_per_electron: s.gain_dn_per_electron,
            read_noise_electrons: s.read_noise_electrons,
        };
        Sensor::with_curve(&noise, None, FileNoise::default())
    }
}

/// Code values of one level, an exposure each, and what merging made of them.
pub(crate) struct Taken {
    pub codes: Vec<Vec<u16>>,
    pub merged: Radiance,
}

/// Takes `samples` brackets of one level, three a pixel, and merges them.
pub(crate) fn take(bracketing: &Bracketing, electrons_per_sec: f64, samples: usize, seed: u64) -> Taken {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed ^ electrons_per_sec.to_bits());
    let times = bracketing.times();
    let codes: Vec<Vec<u16>> =
        times.iter().map(|&secs| bracketing.sensor.expose(electrons_per_sec * secs, samples, &mut rng)).collect();
    let exposure = |(codes, &secs): (&Vec<u16>, &f64)| Exposure { samples: Samples::U16(codes.clone()), secs };
    let bracket: Vec<Exposure> = codes.iter().zip(&times).map(exposure).collect();
    let rect = Rect { x: 0, y: 0, width: samples / 3, height: 1 };
    let merged = merge(&bracket, rect, &bracketing.merger());
    Taken { codes, merged }
}

/// How far the merge of some samples of one level is from the truth and from the bound.
pub(crate) fn measure(bracketing: &Bracketing, electrons_per_sec: f64, samples: usize, seed: u64) -> Found {
    let samples = samples.next_multiple_of(3);
    let merged = take(bracketing, electrons_per_sec, samples, seed).merged;
    let truth = electrons_per_sec * bracketing.sensor.gain_dn_per_electron;
    // Those that are saturated in every exposure are masked, and not counted.
    let measured: Vec<usize> = (0..samples).filter(|&k| merged.used[k] > 0).collect();
    let n = measured.len() as f64;
    let errors = measured.iter().map(|&k| f64::from(merged.value[k]) - truth);
    let (bias, square) = errors.fold((0.0, 0.0), |(b, s), e| (b + e / n, s + e * e / n));
    let stated = measured.iter().map(|&k| f64::from(merged.variance[k])).sum::<f64>() / n;
    let gain2 = bracketing.sensor.gain_dn_per_electron.powi(2);
    Found {
        of_bound: square / (gain2 * bracketing.bound(electrons_per_sec)),
        bias: bias / truth,
        standard_error: (square / n).sqrt() / truth,
        stated: stated / square,
        relative_rms: square.sqrt() / truth,
    }
}
