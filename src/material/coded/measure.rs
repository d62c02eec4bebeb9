//! What coding does to R̂_d: measured on rows, and predicted to first order.

use crate::material::{Material, legendre};
use rayon::prelude::*;

/// Multiplications that measuring once may take; beyond it rows are skipped evenly.
const WORK: usize = 1 << 29;
/// Rows that are measured in any case.
const LEAST_ROWS: usize = 256;

/// Rows of the material as it was.
pub struct Sample {
    stride: usize,
    rows: Vec<Vec<f32>>,
}

/// Every how many rows are looked at.
pub fn stride(material: &Material) -> usize {
    let h = &material.header;
    let row = h.layout().len() * (h.terms * h.planes() + 3 * h.degree.map_or(0, |p| p + 1)).max(1);
    h.rows().div_ceil((WORK / row.max(1)).max(LEAST_ROWS)).max(1)
}

impl Sample {
    /// Evaluates evenly spaced rows.
    pub fn of(material: &Material) -> Self {
        let stride = stride(material);
        let rows: Vec<usize> = (0..material.header.rows()).step_by(stride).collect();
        Self { stride, rows: rows.into_par_iter().map(|i| material.evaluate_row(i)).collect() }
    }

    /// ‖R̂‖_F, mm⁻², of the whole material as far as the rows tell.
    pub fn norm(&self) -> f64 {
        (self.rows.iter().map(|row| square(row.iter().copied())).sum::<f64>() * self.stride as f64).sqrt()
    }

    /// ‖R̂_other − R̂‖_F / ‖R̂‖_F on the rows; 0 when nothing differs.
    pub fn relative_error(&self, other: &Material) -> f64 {
        let differences: Vec<f64> = self
            .rows
            .par_iter()
            .enumerate()
            .map(|(k, row)| {
                let coded = other.evaluate_row(k * self.stride);
                row.iter().zip(&coded).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum()
            })
            .collect();
        let error = differences.iter().sum::<f64>();
        let reference: f64 = self.rows.iter().map(|row| square(row.iter().copied())).sum();
        if error > 0.0 { (error / reference).sqrt() } else { 0.0 }
    }
}

fn square(values: impl Iterator<Item = f32>) -> f64 {
    values.map(|v| f64::from(v).powi(2)).sum()
}

/// ‖v‖².
pub fn energy(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum()
}

/// By how much R̂_d moves, all channels together, when a sample of a plane moves by one. With a colour polynomial that is
/// ‖R̂‖/‖v‖: its own slope would be ruled by a few rows whose polynomials swing between their samples, which coding fits anew.
pub fn slope(material: &Material) -> f64 {
    let h = &material.header;
    let Some(degree) = h.degree else {
        return if h.planes() == 1 { 3.0_f64.sqrt() } else { 1.0 };
    };
    let [low, high] = h.intensity_range.map(f64::from);
    let (mut response, mut intensity, mut basis) = (0.0, 0.0, vec![0.0; degree + 1]);
    for index in (0..h.rows()).step_by(h.rows().div_ceil(LEAST_ROWS)) {
        let coefficients = material.coefficients(index, degree);
        for v in material.plane_row(0, index) {
            legendre::evaluate(legendre::argument(v, low, high), &mut basis);
            for beta in coefficients {
                response += beta.iter().zip(&basis).map(|(&b, l)| f64::from(b) * l).sum::<f64>().powi(2);
            }
            intensity += v * v;
        }
    }
    let slope = (response / intensity).sqrt();
    // Where nothing moves any step will do; this one is harmless.
    if slope.is_normal() { slope } else { 1e-30 }
}

/// Factors f' that make Σ f'_k q_k nearest to Σ f_j h_j: `weights[k][j]` with f'_k = Σ_j weights\[k\]\[j\] f_j.
pub fn refit_weights(h: &[Vec<f64>], q: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let terms = h.len();
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let rows =
        |of: &[Vec<f64>]| -> Vec<Vec<f64>> { q.par_iter().map(|a| of.iter().map(|b| dot(a, b)).collect()).collect() };
    let (mut gram, mut right) = (rows(q), rows(h));
    let largest = (0..terms).map(|k| gram[k][k]).fold(0.0, f64::max);
    // Terms of which nothing is left stay at zero instead of growing without bound.
    (0..terms).for_each(|k| gram[k][k] += 1e-9 * largest + f64::MIN_POSITIVE);
    for k in 0..terms {
        let (pivot, pivot_right) = (gram[k].clone(), right[k].clone());
        for i in k + 1..terms {
            let factor = gram[i][k] / pivot[k];
            (k..terms).for_each(|j| gram[i][j] -= factor * pivot[j]);
            (0..terms).for_each(|j| right[i][j] -= factor * pivot_right[j]);
        }
    }
    for k in (0..terms).rev() {
        for j in 0..terms {
            let known: f64 = (k + 1..terms).map(|l| gram[k][l] * right[l][j]).sum();
            right[k][j] = (right[k][j] - known) / gram[k][k];
        }
    }
    right
}
