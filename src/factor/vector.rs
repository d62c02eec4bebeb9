//! Sums and combinations of vectors, with the vector instructions of the processor at hand.
//!
//! No fused multiply-add: results are the same on every processor.

use pulp::{Arch, NullaryFnOnce};

/// Lanes of a sum: a single one would wait for each addition.
const LANES: usize = 16;

struct Dot<'a>(&'a [f64], &'a [f64]);

impl NullaryFnOnce for Dot<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        dot_in(self.0, self.1)
    }
}

/// Σ a b.
pub fn dot(a: &[f64], b: &[f64]) -> f64 {
    Arch::new().dispatch(Dot(a, b))
}

/// Σ a b inside a dispatched function.
#[inline(always)]
pub fn dot_in(a: &[f64], b: &[f64]) -> f64 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0.0; LANES];
    for (a, b) in a.iter().zip(b) {
        for k in 0..LANES {
            lanes[k] += a[k] * b[k];
        }
    }
    let mut sum = 0.0;
    for k in 0..LANES {
        sum += lanes[k];
    }
    for (a, b) in a_rest.iter().zip(b_rest) {
        sum += a * b;
    }
    sum
}

struct EnergyAndPeak<'a>(&'a [f32]);

impl NullaryFnOnce for EnergyAndPeak<'_> {
    type Output = (f64, f64);

    #[inline(always)]
    fn call(self) -> (f64, f64) {
        let (parts, rest) = self.0.as_chunks::<LANES>();
        let (mut sums, mut peaks) = ([0.0_f64; LANES], [0.0_f32; LANES]);
        for part in parts {
            for k in 0..LANES {
                sums[k] += f64::from(part[k]) * f64::from(part[k]);
                peaks[k] = if part[k] > peaks[k] { part[k] } else { peaks[k] };
            }
        }
        let (mut sum, mut peak) = (0.0, 0.0_f32);
        for k in 0..LANES {
            (sum, peak) = (sum + sums[k], peak.max(peaks[k]));
        }
        for &v in rest {
            (sum, peak) = (sum + f64::from(v) * f64::from(v), peak.max(v));
        }
        (sum, f64::from(peak))
    }
}

/// Σ v², and the largest value; 0 when none is positive.
pub fn energy_and_peak(values: &[f32]) -> (f64, f64) {
    Arch::new().dispatch(EnergyAndPeak(values))
}

/// y ← y + s x inside a dispatched function.
#[inline(always)]
pub fn axpy_in(s: f64, x: &[f64], y: &mut [f64]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += s * x;
    }
}
