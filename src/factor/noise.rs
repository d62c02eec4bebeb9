//! How large the singular values of noise alone would be, and so how many terms the measurement supports.

use super::content::Content;
use crate::transport::rows::{RowView, gradient, intensity};

/// Half a unit in the last place of an f32, relative: what storing the rows as f32 leaves undetermined.
pub(super) const F32_ROUNDING: f64 = 1.0 / (1 << 24) as f64;

/// Variance of one row as it is factored, split by cause.
#[derive(Debug, Clone)]
pub(super) struct RowNoise {
    /// Independent from sample to sample (photons, read noise, rounding), \[plane, window\].
    pub independent: Vec<f64>,
    /// Σ_d of the variance that the uncertain place of the lit point causes; fully correlated along the row.
    pub registration: f64,
}

/// Splits the variance of a row, in the unit of the factored rows over `scale`.
///
/// The matrix's `variance` holds both parts, the second as sd² |∇R|²: it is subtracted here, channel by channel,
/// because channels share it, whereas their photon noise averages out.
pub(super) fn row_noise(
    row: RowView<'_>,
    content: Content,
    scale: f64,
    window: [usize; 2],
    position_sd_px: f64,
) -> RowNoise {
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
pub(super) struct NoiseSums {
    /// max_i Σ_d v_id.
    pub largest_row: f64,
    /// max_d Σ_i v_id.
    pub largest_column: f64,
    /// Σ_i sd_i² ‖∇R''_i‖².
    pub registration: f64,
    /// Mean of v_id over measured samples.
    pub mean: f64,
}

impl NoiseSums {
    /// The spectral norm that noise alone would have.
    ///
    /// Independent entries of variance v_id have norm at most √max_i Σ_d v_id + √max_d Σ_i v_id, to leading order
    /// (`BandeiraVanHandel2016`). The uncertain place of lit point i adds δ_i · ∇R''_i to its row; in the worst case, a slab
    /// whose rows are all alike, all of it lies in one term of norm √Σ_i sd_i² ‖∇R''_i‖². The two are independent:
    /// a term of norm θ in independent noise of norm s shows a singular value below √(θ² + s²)
    /// (`BenaychGeorges2012`), hence the quadrature.
    pub(super) fn level(&self) -> f64 {
        let independent = self.largest_row.sqrt() + self.largest_column.sqrt();
        (independent * independent + self.registration).sqrt()
    }

    /// For rows that are divided by `unit`.
    pub(super) fn divide(&mut self, unit: f64) {
        for v in [&mut self.largest_row, &mut self.largest_column, &mut self.registration, &mut self.mean] {
            *v /= unit * unit;
        }
    }

    /// [`Self::level`], or what rounding rows to f32 hides when that is more.
    pub(super) fn threshold(&self, singular_values: &[f64]) -> f64 {
        self.level().max(F32_ROUNDING * singular_values.first().copied().unwrap_or(0.0))
    }

    /// Terms above the noise, at least one.
    pub(super) fn terms(&self, singular_values: &[f64]) -> usize {
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
        let noise = NoiseSums { largest_row: row, largest_column: column, ..Default::default() };
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

    /// A 5 × 3 window of planes, one for each channel, of which red has no first sample.
    struct Planes {
        response: Vec<f32>,
        variance: Vec<f32>,
        valid: Vec<u8>,
    }

    const WINDOW: [usize; 2] = [5, 3];
    const SLOPES: [[f64; 2]; 3] = [[0.5, -0.125], [0.25, 1.0], [-0.75, 0.0625]];
    const SD: f64 = 0.2;

    fn steep(c: usize) -> f64 {
        SD * SD * (SLOPES[c][0].powi(2) + SLOPES[c][1].powi(2))
    }

    /// Variance beyond the place's: uneven, another for each channel.
    fn photons(k: usize, c: usize) -> f64 {
        1e-3 * (1 + c * c) as f64 * (1.0 + 0.3 * (k * 7 % 5) as f64)
    }

    fn planes(variance: impl Fn(usize, usize) -> f64) -> Planes {
        let value = |k: usize, c: usize| 4.0 + SLOPES[c][0] * (k % 5) as f64 + SLOPES[c][1] * (k / 5) as f64;
        let mut valid = vec![1; 45];
        valid[0] = 0;
        let mut made = Planes {
            response: (0..45).map(|s| value(s / 3, s % 3) as f32).collect(),
            variance: (0..45).map(|s| variance(s / 3, s % 3) as f32).collect(),
            valid,
        };
        (made.response[0], made.variance[0]) = (0.0, 0.0);
        made
    }

    fn noise_of(p: &Planes, content: Content, scale: f64, sd: f64) -> RowNoise {
        let row = RowView { response: &p.response, variance: &p.variance, valid: &p.valid };
        row_noise(row, content, scale, WINDOW, sd)
    }

    #[test]
    fn every_channel_has_its_own_variance_less_that_of_the_place() {
        let noise = noise_of(&planes(|k, c| photons(k, c) + steep(c)), Content::Channels, 1.0, SD);
        for c in 0..3 {
            for k in 0..15 {
                let expected = if (k, c) == (0, 0) { 0.0 } else { photons(k, c) };
                let found = noise.independent[c * 15 + k];
                // Variances of up to 0.05 are stored as f32.
                assert!((found - expected).abs() < 5e-9, "channel {c} sample {k}: {found} {expected}");
            }
        }
        // Planes have the same slope everywhere, one-sided or not; what was not measured has none.
        let expected = 14.0 * steep(0) + 15.0 * steep(1) + 15.0 * steep(2);
        assert!((noise.registration - expected).abs() < 1e-12, "f64: {} {expected}", noise.registration);
    }

    #[test]
    fn the_variance_of_an_intensity_is_a_ninth_of_the_channels_over_the_scale_squared() {
        for (content, scale) in [(Content::Intensity, 2.5), (Content::Grey, 1.0)] {
            let noise = noise_of(&planes(|k, c| photons(k, c) + steep(c)), content, scale, SD);
            assert_eq!(noise.independent.len(), 15);
            for k in 0..15 {
                let all: f64 = (0..3).map(|c| photons(k, c)).sum();
                let expected = if k == 0 { 0.0 } else { all / 9.0 / (scale * scale) };
                assert!((noise.independent[k] - expected).abs() < 2e-9, "f32, sample {k}: {expected}");
            }
            // The place moves all channels together: the slope of the mean, not the mean of squared slopes.
            let mean = |a: usize| SLOPES.iter().map(|s| s[a]).sum::<f64>() / 3.0;
            let expected = 14.0 * SD * SD * (mean(0).powi(2) + mean(1).powi(2)) / (scale * scale);
            assert!((noise.registration - expected).abs() < 1e-7 * expected, "f32 responses: {}", noise.registration);
        }
    }

    #[test]
    fn a_variance_below_that_of_the_place_counts_as_none_in_its_channel_alone() {
        // Blue states less than its slope alone would give; that must not lower what red and green have.
        let low = planes(|k, c| if c == 2 { steep(c) / 2.0 } else { photons(k, c) + steep(c) });
        let noise = noise_of(&low, Content::Intensity, 1.0, SD);
        for k in 1..15 {
            let expected = (photons(k, 0) + photons(k, 1)) / 9.0;
            assert!((noise.independent[k] - expected).abs() < 2e-9, "f32: {} {expected}", noise.independent[k]);
        }
        let noise = noise_of(&low, Content::Channels, 1.0, SD);
        assert!(noise.independent[30..].iter().all(|&v| (0.0..1e-13).contains(&v)), "rounding alone is left");
    }

    #[test]
    fn a_known_place_leaves_the_variance_whole_and_has_no_part_of_its_own() {
        let noise = noise_of(&planes(photons), Content::Channels, 2.0, 0.0);
        assert_eq!(noise.registration, 0.0);
        let found = noise.independent[2 * 15 + 7];
        assert!((found - photons(7, 2) / 4.0).abs() < 1e-9, "f32: {found}");
        assert_eq!(noise_of(&planes(photons), Content::Intensity, 2.0, 0.0).registration, 0.0);
    }

    #[test]
    fn exact_rows_are_still_rounded_to_f32() {
        let exact = planes(|_, _| 0.0);
        let noise = noise_of(&exact, Content::Channels, 0.5, 0.0);
        // Uniform within half a unit in the last place: (2⁻²⁴ v)² / 3.
        let rounding = |v: f64| (v / 16_777_216.0).powi(2) / 3.0 / 0.25;
        for s in 1..45 {
            let (found, expected) = (noise.independent[s % 3 * 15 + s / 3], rounding(f64::from(exact.response[s])));
            assert!((found / expected - 1.0).abs() < 1e-12, "{s}: {found:e} {expected:e}");
        }
        assert_eq!(noise.independent[0], 0.0);
        let noise = noise_of(&exact, Content::Intensity, 0.5, 0.0);
        let mean = |k: usize| exact.response[3 * k..3 * k + 3].iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
        for k in 1..15 {
            assert!((noise.independent[k] / rounding(mean(k)) - 1.0).abs() < 1e-12, "{k}");
        }
    }

    #[test]
    fn rows_without_variance_or_scale_have_no_noise() {
        let mut none = planes(photons);
        for scale in [f64::INFINITY, f64::NAN] {
            let noise = noise_of(&none, Content::Intensity, scale, SD);
            assert_eq!((noise.independent, noise.registration), (vec![0.0; 15], 0.0));
        }
        none.variance.clear();
        let noise = noise_of(&none, Content::Channels, 1.0, SD);
        assert_eq!((noise.independent, noise.registration), (vec![0.0; 45], 0.0));
    }

    #[test]
    fn the_level_adds_independent_norms_and_the_place_in_quadrature() {
        let noise =
            |row, column, place| NoiseSums { largest_row: row, largest_column: column, registration: place, mean: 7.0 };
        assert_eq!(noise(9.0, 16.0, 0.0).level(), 7.0);
        assert_eq!(noise(9.0, 0.0, 16.0).level(), 5.0);
        assert_eq!(noise(0.0, 0.0, 144.0).level(), 12.0);
        assert_eq!(noise(4.0, 1.0, 16.0).level(), 5.0);
        let mut divided = noise(36.0, 64.0, 100.0);
        divided.divide(2.0);
        assert_eq!((divided.largest_row, divided.largest_column), (9.0, 16.0));
        assert_eq!((divided.registration, divided.mean), (25.0, 1.75), "all are squares");
    }

    #[test]
    fn terms_are_those_above_the_level_and_at_least_one() {
        let noise = NoiseSums { largest_row: 4.0, ..Default::default() };
        assert_eq!(noise.terms(&[5.0, 3.0, 2.0, 1.9]), 2, "one at the level is not above it");
        assert_eq!((noise.terms(&[1.0, 0.5]), noise.terms(&[])), (1, 1));
        // Values of 2⁻²⁴ of the largest are what storing rows as f32 leaves.
        let exact = NoiseSums::default();
        let largest = 2.0_f64.powi(24);
        assert_eq!(exact.threshold(&[largest, 3.0]), 1.0);
        assert_eq!(exact.terms(&[largest, 1.5, 1.0, 0.5]), 2);
        assert_eq!((noise.threshold(&[largest]), noise.threshold(&[])), (2.0, 2.0), "the larger of both");
    }
}
