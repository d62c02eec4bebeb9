//! A sensor as physics has it, written apart from both the estimator and the simulator, and what can be known from its
//! codes.
#![allow(dead_code)]

use rand::Rng;
use rand_distr::{Distribution, Normal, Poisson};

/// Poisson photons, normal read noise, a pedestal, rounding, clipping.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PhotonSensor {
    pub gain_dn_per_electron: f64,
    pub read_noise_electrons: f64,
    pub black_dn: f64,
    /// From here a code counts as clipped.
    pub saturation_dn: f64,
    pub max_dn: f64,
}

impl PhotonSensor {
    /// The default sensor of the simulator (Sony A7R III): 14 bits, 7.5 e⁻ of read noise.
    pub(crate) const SONY_A7R3: Self = Self {
        gain_dn_per_electron: 0.4,
        read_noise_electrons: 7.533597,
        black_dn: 512.0,
        saturation_dn: 16_055.0,
        max_dn: 16_383.0,
    };
    /// A Canon T1i: 14 bits, 4.3 e⁻, three code values an electron.
    pub(crate) const CANON_T1: Self = Self {
        gain_dn_per_electron: 1.2,
        read_noise_electrons: 4.2711,
        black_dn: 1024.0,
        saturation_dn: 16_055.0,
        max_dn: 16_383.0,
    };
    /// A phone: 10 bits, 7.8 e⁻.
    pub(crate) const PHONE: Self = Self {
        gain_dn_per_electron: 0.31,
        read_noise_electrons: 7.8143,
        black_dn: 64.0,
        saturation_dn: 1003.0,
        max_dn: 1023.0,
    };

    /// Electrons at which codes begin to count as clipped.
    pub(crate) fn full_electrons(&self) -> f64 {
        (self.saturation_dn - self.black_dn) / self.gain_dn_per_electron
    }

    /// `n` code values for a mean of so many electrons.
    pub(crate) fn expose(&self, electrons: f64, n: usize, rng: &mut impl Rng) -> Vec<u16> {
        let read = Normal::new(0.0, self.read_noise_electrons).unwrap();
        let photons = (electrons > 0.0).then(|| Poisson::new(electrons).unwrap());
        let code = |rng: &mut _| {
            let e = photons.as_ref().map_or(0.0, |p| p.sample(rng)) + read.sample(rng);
            (self.black_dn + self.gain_dn_per_electron * e).round().clamp(0.0, self.max_dn) as u16
        };
        (0..n).map(|_| code(rng)).collect()
    }

    /// Fisher information of one code value about the mean count of electrons, from the exact probabilities of all
    /// codes; codes at or above saturation are one outcome: that they are is known, how far is not.
    pub(crate) fn information(&self, electrons: f64) -> f64 {
        let (m, read) = (electrons.max(1e-9), self.read_noise_electrons);
        let sd = (m + read * read).sqrt();
        let to_electrons = |code: f64| (code - self.black_dn) / self.gain_dn_per_electron;
        let mean_dn = self.black_dn + self.gain_dn_per_electron * m;
        let reach_dn = 8.0 * self.gain_dn_per_electron * sd + 2.0;
        let first = (mean_dn - reach_dn).floor().max(0.0);
        let last = (mean_dn + reach_dn).ceil().min(self.saturation_dn.ceil() - 1.0);
        // Probability of a code, and its slope by the mean: over the counts within eight read noises of it.
        let of_code = |code: f64| {
            let edges = [-0.5, 0.5].map(|half| to_electrons(code + half));
            let (low, high) = ((edges[0] - 8.0 * read).floor().max(0.0), (edges[1] + 8.0 * read).ceil());
            let (mut p, mut slope, mut count) = (0.0, 0.0, low);
            let mut log_term = ln_poisson(m, low);
            while count <= high {
                let bottom = if code == 0.0 { 0.0 } else { normal_below((edges[0] - count) / read) };
                let both = log_term.exp() * (normal_below((edges[1] - count) / read) - bottom);
                (p, slope) = (p + both, slope + both * (count / m - 1.0));
                count += 1.0;
                log_term += (m / count).ln();
            }
            [p, slope]
        };
        let (mut information, mut code, mut all) = (0.0, first, [0.0; 2]);
        while code <= last {
            let [p, slope] = of_code(code);
            if p > 1e-9 {
                information += slope * slope / p;
            }
            (all, code) = ([all[0] + p, all[1] + slope], code + 1.0);
        }
        let clipped = 1.0 - all[0];
        if last + 1.0 >= self.saturation_dn && clipped > 1e-9 {
            information += all[1] * all[1] / clipped;
        }
        information
    }
}

fn ln_poisson(m: f64, n: f64) -> f64 {
    n * m.ln() - m - ln_factorial(n)
}

/// ln n!, by Stirling's series from 20.
fn ln_factorial(n: f64) -> f64 {
    if n < 20.0 {
        return (2..=n as u32).map(|k| f64::from(k).ln()).sum();
    }
    n * n.ln() - n + 0.5 * (2.0 * std::f64::consts::PI * n).ln() + 1.0 / (12.0 * n) - 1.0 / (360.0 * n.powi(3))
}

/// The normal distribution; relative error 1.2e-7 (Press et al., Numerical Recipes, erfcc).
fn normal_below(x: f64) -> f64 {
    let z = (x / std::f64::consts::SQRT_2).abs();
    let t = 1.0 / (1.0 + 0.5 * z);
    const C: [f64; 10] = [
        -1.26551223,
        1.00002368,
        0.37409196,
        0.09678418,
        -0.18628806,
        0.27886807,
        -1.13520398,
        1.48851587,
        -0.82215223,
        0.17087277,
    ];
    let tail = t * (C.iter().rev().fold(0.0, |sum, c| c + t * sum) - z * z).exp();
    if x >= 0.0 { 1.0 - 0.5 * tail } else { 0.5 * tail }
}
