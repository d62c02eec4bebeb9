//! From linear light to the code values of an encoded file.

use crate::capture::ResponseCurve;
use crate::simulate::{CameraCurve, RigCurve};

/// Steepness of the film-like curve in the sRGB signal, and the mid-grey that it keeps (sRGB of 0.18).
const FILM_EXPONENT: f64 = 1.5;
const FILM_GREY: f64 = 0.461_356;

impl CameraCurve {
    /// The encoded value of linear light, both 0 to 1.
    pub(crate) fn encode(self, linear: f64) -> f64 {
        match self {
            Self::Linear => linear,
            Self::Srgb => srgb(linear),
            Self::Film => film(srgb(linear)),
        }
    }

    /// What the rig file says: what it is asked to; else a lab with a film-like curve takes it for sRGB.
    pub(crate) fn told(self, asked: Option<RigCurve>) -> ResponseCurve {
        match (asked, self) {
            (Some(RigCurve::Linear), _) | (None, Self::Linear) => ResponseCurve::Linear,
            (Some(RigCurve::Srgb), _) | (None, Self::Srgb | Self::Film) => ResponseCurve::Srgb,
            (Some(RigCurve::Estimate), _) => ResponseCurve::Estimate,
        }
    }

    /// (linear, encoded) pairs for the truth: dense where the curve bends.
    pub(crate) fn samples(self) -> Vec<[f64; 2]> {
        (0..=64).map(|k| (f64::from(k) / 64.0).powi(2)).map(|linear| [linear, self.encode(linear)]).collect()
    }
}

/// The sRGB curve (IEC 61966-2-1), linear to encoded.
fn srgb(linear: f64) -> f64 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

/// A toe and a shoulder: (1 + k) vⁿ/(vⁿ + k), the saturating curve of Naka and Rushton (`NakaRushton1966`) scaled to
/// end at 1, with k such that mid-grey stays where it is.
fn film(v: f64) -> f64 {
    let slope = FILM_GREY.powf(FILM_EXPONENT - 1.0);
    let k = slope * (1.0 - FILM_GREY) / (1.0 - slope);
    let power = v.powf(FILM_EXPONENT);
    (1.0 + k) * power / (power + k)
}

/// A curve tabulated for speed: linear between nodes that are even in the square root of light.
///
/// Half the step squared times the curve's second derivative in that root (26 for sRGB near black) over 2 errs by
/// at most 2e-7 of the range: a hundredth of a code value of 16 bits, six at the kink of sRGB.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    nodes: Vec<f32>,
}

const INTERVALS: usize = 4096;

impl Table {
    /// `curve` with code values up to `max_code`.
    pub(crate) fn new(curve: CameraCurve, max_code: f64) -> Self {
        let node = |k: usize| (max_code * curve.encode((k as f64 / INTERVALS as f64).powi(2))) as f32;
        Self { nodes: (0..=INTERVALS).map(node).collect() }
    }

    /// The code value of linear light in 0 to 1, not rounded.
    #[inline(always)]
    pub(crate) fn encode(&self, linear: f32) -> f32 {
        let t = linear.clamp(0.0, 1.0).sqrt() * INTERVALS as f32;
        let k = (t as usize).min(INTERVALS - 1);
        self.nodes[k] + (self.nodes[k + 1] - self.nodes[k]) * (t - k as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_film_curve_is_monotone_and_not_what_the_rig_says() {
        let samples = CameraCurve::Film.samples();
        assert!(samples.windows(2).all(|w| w[1][0] > w[0][0] && w[1][1] > w[0][1]));
        assert!(samples[0] == [0.0; 2] && samples[64][0] == 1.0 && (samples[64][1] - 1.0).abs() < 1e-12);
        assert!((CameraCurve::Film.encode(0.18) - CameraCurve::Srgb.encode(0.18)).abs() < 1e-5, "mid-grey stays");
        assert!(CameraCurve::Film.encode(0.01) < 0.6 * CameraCurve::Srgb.encode(0.01), "a toe");
        assert!(CameraCurve::Film.encode(0.6) > 1.02 * CameraCurve::Srgb.encode(0.6), "a shoulder");
        assert_eq!(CameraCurve::Film.told(None), ResponseCurve::Srgb);
    }

    #[test]
    fn the_table_is_the_curve_to_a_fraction_of_a_code() {
        for curve in [CameraCurve::Linear, CameraCurve::Srgb, CameraCurve::Film] {
            let table = Table::new(curve, 65_535.0);
            for k in 0..=100_000u32 {
                let linear = (f64::from(k) / 1e5).powi(3);
                let error = f64::from(table.encode(linear as f32)) - 65_535.0 * curve.encode(linear);
                // 2e-7 of the range, as much for f32, and more at the kink of sRGB.
                assert!(error.abs() < 0.1, "{curve:?} at {linear}: {error}");
            }
        }
    }
}
