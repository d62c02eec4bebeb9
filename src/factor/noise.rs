//! How large the singular values of noise alone would be, and so how many terms the measurement supports.

use super::rows::Content;
use crate::transport::rows::{RowView, gradient, intensity};

/// Half a unit in the last place of an f32, relative: what storing the rows as f32 leaves undetermined.
pub(super) const F32_ROUNDING: f64 = 1.0 / (1 << 24) as f64;

/// Variance of one row as it is factored, split by cause.
#[derive(Debug, Clone)]
pub struct RowNoise {
    /// Independent from sample to sample (photons, read noise, rounding), \[plane, window\].
    pub independent: Vec<f64>,
    /// Σ_d of the variance that the uncertain place of the lit point causes; fully correlated along the row.
    pub registration: f64,
}

/// Splits the variance of a row, in the unit of the factored rows over `scale`.
///
/// The matrix's `variance` holds both parts, the second as sd² |∇R|²: it is subtracted here, channel by channel,
/// because channels share it, whereas their photon noise averages out.
pub fn row_noise(row: RowView<'_>, content: Content, scale: f64, window: [usize; 2], position_sd_px: f64) -> RowNoise {
    let n = window[0] * window[1];
    let mut independent = vec![0.0; n * content.planes()];
    if row.variance.is_empty() || !scale.is_finite() {
        return RowNoise { independent, registration: 0.0 };
    }
    let position = position_sd_px * position_sd_px;
    let slope = |values: &[f64], measured: &[bool]| -> Vec<f64> {
        let [gx, gy] = gradient(values, measured, window);
        gx.iter().zip(&gy).map(|(x, y)| x * x + y * y).collect()
    };
    let mut registration = 0.0;
    for c in 0..3 {
        let steep = (position > 0.0).then(|| {
            let channel: Vec<f64> = row.response.iter().skip(c).step_by(3).map(|&v| f64::from(v)).collect();
            let valid: Vec<bool> = row.valid.iter().skip(c).step_by(3).map(|&v| v != 0).collect();
            slope(&channel, &valid)
        });
        let channels = content == Content::Channels;
        let (to, share) = if channels { (c * n, 1.0) } else { (0, 1.0 / 9.0) };
        for (k, v) in row.variance.iter().skip(c).step_by(3).enumerate() {
            let common = steep.as_ref().map_or(0.0, |s| position * s[k]);
            independent[to + k] += (f64::from(*v) - common).max(0.0) * share;
        }
        if channels {
            registration += steep.iter().flatten().sum::<f64>() * position;
        }
    }
    let mut finish = |at: usize, value: f64, measured: bool| {
        let rounding = F32_ROUNDING * value;
        let variance = (independent[at] + rounding * rounding / 3.0) / (scale * scale);
        independent[at] = if measured { variance } else { 0.0 };
    };
    if content == Content::Channels {
        for (s, (&value, &valid)) in row.response.iter().zip(row.valid).enumerate() {
            finish(s % 3 * n + s / 3, f64::from(value), valid != 0);
        }
    } else {
        for (k, (rgb, valid)) in row.response.chunks_exact(3).zip(row.valid.chunks_exact(3)).enumerate() {
            let value = rgb.iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
            finish(k, value, valid.iter().all(|&v| v != 0));
        }
        if position > 0.0 {
            let (values, measured) = intensity(row);
            registration = position * slope(&values, &measured).iter().sum::<f64>();
        }
    }
    RowNoise { independent, registration: registration / (scale * scale) }
}

/// Sums of the noise over rows and over columns.
#[derive(Debug, Clone, Default)]
pub struct Noise {
    /// max_i Σ_d v_id.
    pub largest_row: f64,
    /// max_d Σ_i v_id.
    pub largest_column: f64,
    /// Σ_i sd_i² ‖∇R''_i‖².
    pub registration: f64,
    /// Mean of v_id over measured samples.
    pub mean: f64,
}

impl Noise {
    /// The spectral norm that noise alone would have.
    ///
    /// Independent entries of variance v_id have norm at most √max_i Σ_d v_id + √max_d Σ_i v_id, to leading order
    /// (`BandeiraVanHandel2016`). The uncertain place of lit point i adds δ_i · ∇R''_i to its row; in the worst case, a slab
    /// whose rows are all alike, all of it lies in one term of norm √Σ_i sd_i² ‖∇R''_i‖². The two are independent:
    /// a term of norm θ in independent noise of norm s shows a singular value below √(θ² + s²)
    /// (`BenaychGeorges2012`), hence the quadrature.
    pub fn level(&self) -> f64 {
        let independent = self.largest_row.sqrt() + self.largest_column.sqrt();
        (independent * independent + self.registration).sqrt()
    }

    /// For rows that are divided by `unit`.
    pub fn divide(&mut self, unit: f64) {
        for v in [&mut self.largest_row, &mut self.largest_column, &mut self.registration, &mut self.mean] {
            *v /= unit * unit;
        }
    }

    /// [`Self::level`], or what rounding rows to f32 hides when that is more.
    pub fn threshold(&self, singular_values: &[f64]) -> f64 {
        self.level().max(F32_ROUNDING * singular_values.first().copied().unwrap_or(0.0))
    }

    /// Terms above the noise, at least one.
    pub fn terms(&self, singular_values: &[f64]) -> usize {
        let level = self.threshold(singular_values);
        singular_values.iter().take_while(|&&s| s > level).count().max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::super::backend::{Backend, low_rank, tests::InMemory};
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn noise_alone_stays_below_its_level_and_not_far_below() {
        let (n, m) = (120, 80);
        let mut random = rand_pcg::Pcg64::seed_from_u64(1);
        // Uneven rows and columns: a factor of ten in variance over each.
        let v = |i: usize, d: usize| 0.1_f64.powf(i as f64 / n as f64) * 0.1_f64.powf(d as f64 / m as f64);
        let mut values = Vec::new();
        for i in 0..n {
            for d in 0..m {
                let x: f64 = StandardNormal.sample(&mut random);
                values.push(x * v(i, d).sqrt());
            }
        }
        let row = (0..n).map(|i| (0..m).map(|d| v(i, d)).sum::<f64>()).fold(0.0, f64::max);
        let column = (0..m).map(|d| (0..n).map(|i| v(i, d)).sum::<f64>()).fold(0.0, f64::max);
        let noise = Noise { largest_row: row, largest_column: column, ..Default::default() };
        let rows = InMemory::new(&values, m, 50);
        let first = low_rank(&rows, 1, Backend::Full, 0.0, None).unwrap().singular_values[0];
        // The bound is on the expectation; fluctuations of the norm are of the order of one entry's sd, 1 in 20.
        assert!(first < noise.level(), "{first} against {}", noise.level());
        assert!(first > 0.6 * noise.level(), "{first} against {}", noise.level());
    }

    #[test]
    fn the_registration_part_of_the_variance_is_not_counted_twice() {
        let window = [5, 5];
        let bump = |x: usize, y: usize| (-((x as f64 - 2.0).powi(2) + (y as f64 - 2.0).powi(2)) / 3.0).exp();
        let response: Vec<f32> = (0..25).flat_map(|k| [bump(k % 5, k / 5) as f32; 3]).collect();
        let values: Vec<f64> = response.iter().step_by(3).map(|&v| f64::from(v)).collect();
        let [gx, gy] = gradient(&values, &[true; 25], window);
        let sd = 0.1;
        let steep: Vec<f64> = gx.iter().zip(&gy).map(|(x, y)| sd * sd * (x * x + y * y)).collect();
        let variance: Vec<f32> = steep.iter().flat_map(|&v| [(v + 3e-4) as f32; 3]).collect();
        let row = RowView { response: &response, variance: &variance, valid: &[1; 75] };
        let noise = row_noise(row, Content::Intensity, 1.0, window, sd);
        // f32 storage of the variance: 1e-7 relative
        assert!(noise.independent.iter().all(|v| (v - 1e-4).abs() < 1e-8), "{:?}", noise.independent);
        assert!((noise.registration - steep.iter().sum::<f64>()).abs() < 1e-9);
    }
}
