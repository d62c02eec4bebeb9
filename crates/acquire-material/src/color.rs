//! Colours of an intensity: the three polynomials of a row, the same for one sample and for many.

use crate::{CHANNELS, Material, legendre};

/// Powers of the basis's argument from the Legendre basis: what any row of a material needs.
#[derive(Debug, Clone)]
pub(crate) struct Colors {
    /// \[P+1, P+1\]: row p holds L_p.
    powers: Vec<Vec<f64>>,
}

impl Colors {
    /// For polynomials of `degree`.
    pub(crate) fn new(degree: usize) -> Self {
        // On [−1, 1] powers lose (1 + √2)^P of the digits, 6 of f64's 16 at the highest degree, 15: none that an f32
        // shows.
        let unit = |p: usize| (0..=degree).map(|q| f32::from(u8::from(q == p))).collect::<Vec<_>>();
        Self { powers: (0..=degree).map(|p| legendre::monomials(&unit(p), -1.0, 1.0)).collect() }
    }

    /// The coefficients of powers of the argument, lowest first, of row `index`.
    pub(crate) fn of_row(&self, material: &Material, index: usize) -> Vec<[f64; CHANNELS]> {
        let mut coefficients = vec![[0.0; CHANNELS]; self.powers.len()];
        let betas = material.coefficients(index, self.powers.len() - 1);
        for (c, beta) in betas.into_iter().enumerate() {
            for (&b, powers) in beta.iter().zip(&self.powers) {
                coefficients.iter_mut().zip(powers).for_each(|(sum, &m)| sum[c] += f64::from(b) * m);
            }
        }
        coefficients
    }
}

/// The interval of the intensities that a material's polynomials are defined on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Interval {
    scale: f64,
    middle: f64,
}

impl Interval {
    pub(crate) fn of(range: [f32; 2]) -> Self {
        let [low, high] = range.map(f64::from);
        // As in `legendre::argument`.
        let (scale, middle) = if high > low { (1.0 / (high - low), low + high) } else { (0.0, 0.0) };
        Self { scale, middle }
    }

    /// Arguments of the basis, clamped to −1 and 1.
    #[inline(always)]
    pub(crate) fn arguments<const N: usize>(&self, values: [f64; N]) -> [f64; N] {
        let mut u = [0.0; N];
        for n in 0..N {
            u[n] = (self.scale * (2.0 * values[n] - self.middle)).clamp(-1.0, 1.0);
        }
        u
    }
}

/// The three polynomials at arguments `u`. Plain loops: what goes through a closure is not compiled for the vector
/// instructions at hand.
#[inline(always)]
pub(crate) fn colors<const N: usize>(coefficients: &[[f64; CHANNELS]], u: [f64; N]) -> [[f64; N]; CHANNELS] {
    let mut sums = [[0.0; N]; CHANNELS];
    for b in coefficients.iter().rev() {
        for c in 0..CHANNELS {
            for n in 0..N {
                sums[c][n] = sums[c][n] * u[n] + b[c];
            }
        }
    }
    sums
}
