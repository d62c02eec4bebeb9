//! What coding does to R̂_d: measured on rows, and predicted to first order.

use crate::parallel::*;
use crate::{Material, Responses, legendre};

/// Multiplications that measuring once may take; beyond it rows are skipped evenly.
const WORK: usize = 1 << 29;
/// Rows that are measured in any case.
const LEAST_ROWS: usize = 256;

/// Rows of the material as it was.
pub(super) struct Sample {
    stride: usize,
    rows: Vec<Vec<f32>>,
}

/// Every how many rows are looked at.
pub(super) fn stride(material: &Material) -> usize {
    let h = &material.header;
    let row = h.layout().len() * (h.terms * h.planes() + 3 * h.degree.map_or(0, |p| p + 1)).max(1);
    h.rows().div_ceil((WORK / row.max(1)).max(LEAST_ROWS)).max(1)
}

impl Sample {
    /// Evaluates evenly spaced rows.
    pub(super) fn of(material: &Material) -> Self {
        let stride = stride(material);
        let rows: Vec<usize> = (0..material.header.rows()).step_by(stride).collect();
        let responses = Responses::new(material);
        Self { stride, rows: rows.into_par_iter().map(|i| responses.row(i)).collect() }
    }

    /// ‖R̂‖_F, mm⁻², of the whole material as far as the rows tell.
    pub(super) fn norm(&self) -> f64 {
        (self.rows.iter().map(|row| square(row.iter().copied())).sum::<f64>() * self.stride as f64).sqrt()
    }

    /// ‖R̂_other − R̂‖_F / ‖R̂‖_F on the rows; 0 when nothing differs.
    pub(super) fn relative_error(&self, other: &Material) -> f64 {
        let other = Responses::new(other);
        let differences: Vec<f64> = self
            .rows
            .par_iter()
            .enumerate()
            .map(|(k, row)| {
                let coded = other.row(k * self.stride);
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
pub(super) fn energy(values: &[f64]) -> f64 {
    values.iter().map(|v| v * v).sum()
}

/// By how much R̂_d moves, all channels together, when a sample of a plane moves by one. With a colour polynomial that
/// is ‖R̂‖/‖v‖: its own slope would be ruled by a few rows whose polynomials swing between their samples, which coding
/// fits anew.
pub(super) fn slope(material: &Material) -> f64 {
    let h = &material.header;
    let Some(degree) = h.degree else {
        return if h.planes() == 1 { 3.0_f64.sqrt() } else { 1.0 };
    };
    let [low, high] = h.intensity_range.map(f64::from);
    let (mut response, mut intensity, mut basis) = (0.0, 0.0, vec![0.0; degree + 1]);
    let responses = Responses::new(material);
    for index in (0..h.rows()).step_by(h.rows().div_ceil(LEAST_ROWS)) {
        let coefficients = material.coefficients(index, degree);
        for v in responses.plane(0, &[index]) {
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
pub(super) fn refit_weights(h: &[Vec<f64>], q: &[Vec<f64>]) -> Vec<Vec<f64>> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::naive;

    #[test]
    fn errors_are_those_of_all_rows_and_channels() {
        for m in naive::materials() {
            let mut other = m.clone();
            other.weights[1] *= 1.25;
            let (mut off, mut all) = (0.0, 0.0);
            for i in 0..naive::ROWS {
                for d in naive::offsets() {
                    let (a, b) = (naive::response(&m, i, d).unwrap(), naive::response(&other, i, d).unwrap());
                    for c in 0..3 {
                        off += (a[c] - b[c]).powi(2);
                        all += a[c] * a[c];
                    }
                }
            }
            let sample = Sample::of(&m);
            // Rows are f32.
            assert!((sample.norm() / all.sqrt() - 1.0).abs() < 1e-6, "{} {}", sample.norm(), all.sqrt());
            let found = sample.relative_error(&other);
            assert!((found - (off / all).sqrt()).abs() < 1e-6, "{:?}: {found} {}", m.header.model, (off / all).sqrt());
        }
    }

    #[test]
    fn refitted_factors_leave_nothing_along_the_maps_that_are_left() {
        let wave = |f: f64| (0..40).map(|k| (f * f64::from(k)).sin() + 0.3).collect::<Vec<f64>>();
        let h = [wave(0.3), wave(0.9), wave(1.7)];
        let q: Vec<Vec<f64>> =
            (0..3).map(|k| (0..40).map(|e| h[k][e] + 0.2 * h[(k + 1) % 3][e] + 0.1 * wave(2.3)[e]).collect()).collect();
        let weights = refit_weights(&h, &q);
        // Least squares: h_j − Σ_k w_kj q_k has no part along any q.
        for j in 0..3 {
            let rest: Vec<f64> =
                (0..40).map(|e| h[j][e] - (0..3).map(|k| weights[k][j] * q[k][e]).sum::<f64>()).collect();
            for (k, q) in q.iter().enumerate() {
                let along: f64 = rest.iter().zip(q).map(|(a, b)| a * b).sum();
                assert!(along.abs() < 1e-6, "a ridge of 1e-9: {j} {k} {along}");
            }
        }
    }

    #[test]
    fn a_plane_moves_one_channel_or_all_three_or_as_much_as_its_polynomials_say() {
        for m in naive::materials() {
            let h = &m.header;
            let expected = if h.degree.is_some() {
                let (mut response, mut intensity) = (0.0, 0.0);
                for i in 0..naive::ROWS {
                    for e in 0..63 {
                        let v = naive::planes(&m, i, [e % 9, e / 9]);
                        response += naive::colored(&m, i, v).iter().map(|r| r * r).sum::<f64>();
                        intensity += v[0] * v[0];
                    }
                }
                (response / intensity).sqrt()
            } else if h.planes() == 1 {
                3.0_f64.sqrt()
            } else {
                1.0
            };
            assert!((slope(&m) / expected - 1.0).abs() < 1e-12, "f64: {} {expected}", slope(&m));
        }
    }
}
