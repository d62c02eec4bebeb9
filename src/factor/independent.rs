//! What of the noise of a row is independent from sample to sample.

use super::content::Content;
use super::noise::F32_ROUNDING;
use crate::transport::rows::{RowView, gradient, is_complete, mean_of};
use pulp::{Arch, NullaryFnOnce};

/// Variance of a row that is independent from sample to sample (photons, read noise, rounding), in the unit of the
/// factored rows over `scale`, \[plane, window\].
///
/// The matrix's `variance` also holds what the uncertain place of the lit point causes, sd² |∇R|²: it is subtracted
/// here, channel by channel, because channels share it, whereas their photon noise averages out.
pub(super) fn independent(
    row: RowView<'_>,
    content: Content,
    scale: f64,
    window: [usize; 2],
    position_sd_px: f64,
) -> Vec<f64> {
    let n = window[0] * window[1];
    let mut independent = vec![0.0; n * content.planes()];
    if row.variance.is_empty() || !scale.is_finite() {
        return independent;
    }
    let position = position_sd_px * position_sd_px;
    if is_complete(row.valid) {
        let channels = content == Content::Channels;
        let row = Complete { row, channels, scale, window, position, out: &mut independent };
        Arch::new().dispatch(row);
        return independent;
    }
    general(row, content, scale, window, position, &mut independent);
    independent
}

/// [`independent`] of a row with gaps.
fn general(row: RowView<'_>, content: Content, scale: f64, window: [usize; 2], position: f64, independent: &mut [f64]) {
    let n = window[0] * window[1];
    for c in 0..3 {
        let steep = (position > 0.0).then(|| {
            let values: Vec<f64> = row.response.iter().skip(c).step_by(3).map(|&v| f64::from(v)).collect();
            let valid: Vec<bool> = row.valid.iter().skip(c).step_by(3).map(|&v| v != 0).collect();
            let [gx, gy] = gradient(&values, &valid, window);
            gx.iter().zip(&gy).map(|(x, y)| x * x + y * y).collect::<Vec<f64>>()
        });
        let (to, share) = if content == Content::Channels { (c * n, 1.0) } else { (0, 1.0 / 9.0) };
        for (k, v) in row.variance.iter().skip(c).step_by(3).enumerate() {
            let common = steep.as_ref().map_or(0.0, |s| position * s[k]);
            independent[to + k] += (f64::from(*v) - common).max(0.0) * share;
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
        for (k, (rgb, valid)) in row.response.as_chunks::<3>().0.iter().zip(row.valid.chunks_exact(3)).enumerate() {
            finish(k, mean_of(rgb), valid.iter().all(|&v| v != 0));
        }
    }
}

/// [`independent`] of a row that was measured everywhere: channels lie side by side as they are stored, and neighbours
/// are three numbers or a line away.
struct Complete<'a> {
    row: RowView<'a>,
    channels: bool,
    scale: f64,
    window: [usize; 2],
    position: f64,
    out: &'a mut [f64],
}

impl NullaryFnOnce for Complete<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { row, channels, scale, window: [w, h], position, out } = self;
        let (response, width, over) = (row.response, 3 * w, 1.0 / (scale * scale));
        let mut own = vec![0.0; width];
        let rounded = |value: f64| (F32_ROUNDING * value) * (F32_ROUNDING * value) / 3.0;
        for y in 0..h {
            let line = &response[y * width..][..width];
            own.iter_mut().zip(&row.variance[y * width..]).for_each(|(own, &v)| *own = f64::from(v));
            if position > 0.0 {
                take_slopes(&mut own, response, [w, h], y, position);
            }
            own.iter_mut().for_each(|v| *v = if *v > 0.0 { *v } else { 0.0 });
            let (own, line) = (own.as_chunks::<3>().0, line.as_chunks::<3>().0);
            if channels {
                let [r, g, b] = [0, 1, 2].map(|c| (c * h + y) * w);
                for (k, (own, rgb)) in own.iter().zip(line).enumerate() {
                    for (c, at) in [r, g, b].into_iter().enumerate() {
                        out[at + k] = (own[c] + rounded(f64::from(rgb[c]))) * over;
                    }
                }
            } else {
                for ((out, own), rgb) in out[y * w..][..w].iter_mut().zip(own).zip(line) {
                    *out = ((own[0] + own[1] + own[2]) / 9.0 + rounded(mean_of(rgb))) * over;
                }
            }
        }
    }
}

/// Takes sd² |∇R|² off line `y` of a row, as [`gradient`] has it.
#[inline(always)]
fn take_slopes(own: &mut [f64], response: &[f32], [w, h]: [usize; 2], y: usize, position: f64) {
    let width = 3 * w;
    let line = |y: usize| &response[y * width..][..width];
    if h > 1 {
        let (before, after) = (y.saturating_sub(1), (y + 1).min(h - 1));
        let over = position / ((after - before) * (after - before)) as f64;
        for ((own, &a), &b) in own.iter_mut().zip(line(after)).zip(line(before)) {
            let step = f64::from(a) - f64::from(b);
            *own -= over * step * step;
        }
    }
    if w > 1 {
        let here = line(y);
        let take = |own: &mut f64, a: f32, b: f32, over: f64| {
            let step = f64::from(a) - f64::from(b);
            *own -= over * step * step;
        };
        for c in 0..3 {
            take(&mut own[c], here[3 + c], here[c], position);
            take(&mut own[width - 3 + c], here[width - 3 + c], here[width - 6 + c], position);
        }
        for ((own, &a), &b) in own[3..width - 3].iter_mut().zip(&here[6..]).zip(here) {
            take(own, a, b, position / 4.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let noise = independent(row, Content::Intensity, 1.0, window, sd);
        // f32 storage of the variance: 1e-7 relative
        assert!(noise.iter().all(|v| (v - 1e-4).abs() < 1e-8), "{:?}", noise);
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

    fn noise_of(p: &Planes, content: Content, scale: f64, sd: f64) -> Vec<f64> {
        let row = RowView { response: &p.response, variance: &p.variance, valid: &p.valid };
        independent(row, content, scale, WINDOW, sd)
    }

    #[test]
    fn every_channel_has_its_own_variance_less_that_of_the_place() {
        let noise = noise_of(&planes(|k, c| photons(k, c) + steep(c)), Content::Channels, 1.0, SD);
        for c in 0..3 {
            for k in 0..15 {
                let expected = if (k, c) == (0, 0) { 0.0 } else { photons(k, c) };
                let found = noise[c * 15 + k];
                // Variances of up to 0.05 are stored as f32.
                assert!((found - expected).abs() < 5e-9, "channel {c} sample {k}: {found} {expected}");
            }
        }
    }

    #[test]
    fn the_variance_of_an_intensity_is_a_ninth_of_the_channels_over_the_scale_squared() {
        for (content, scale) in [(Content::Intensity, 2.5), (Content::Grey, 1.0)] {
            let noise = noise_of(&planes(|k, c| photons(k, c) + steep(c)), content, scale, SD);
            assert_eq!(noise.len(), 15);
            for k in 0..15 {
                let all: f64 = (0..3).map(|c| photons(k, c)).sum();
                let expected = if k == 0 { 0.0 } else { all / 9.0 / (scale * scale) };
                assert!((noise[k] - expected).abs() < 2e-9, "f32, sample {k}: {expected}");
            }
        }
    }

    #[test]
    fn a_variance_below_that_of_the_place_counts_as_none_in_its_channel_alone() {
        // Blue states less than its slope alone would give; that must not lower what red and green have.
        let low = planes(|k, c| if c == 2 { steep(c) / 2.0 } else { photons(k, c) + steep(c) });
        let noise = noise_of(&low, Content::Intensity, 1.0, SD);
        for k in 1..15 {
            let expected = (photons(k, 0) + photons(k, 1)) / 9.0;
            assert!((noise[k] - expected).abs() < 2e-9, "f32: {} {expected}", noise[k]);
        }
        let noise = noise_of(&low, Content::Channels, 1.0, SD);
        assert!(noise[30..].iter().all(|&v| (0.0..1e-13).contains(&v)), "rounding alone is left");
    }

    #[test]
    fn a_known_place_leaves_the_variance_whole_and_has_no_part_of_its_own() {
        let noise = noise_of(&planes(photons), Content::Channels, 2.0, 0.0);
        let found = noise[2 * 15 + 7];
        assert!((found - photons(7, 2) / 4.0).abs() < 1e-9, "f32: {found}");
    }

    #[test]
    fn exact_rows_are_still_rounded_to_f32() {
        let exact = planes(|_, _| 0.0);
        let noise = noise_of(&exact, Content::Channels, 0.5, 0.0);
        // Uniform within half a unit in the last place: (2⁻²⁴ v)² / 3.
        let rounding = |v: f64| (v / 16_777_216.0).powi(2) / 3.0 / 0.25;
        for s in 1..45 {
            let (found, expected) = (noise[s % 3 * 15 + s / 3], rounding(f64::from(exact.response[s])));
            assert!((found / expected - 1.0).abs() < 1e-12, "{s}: {found:e} {expected:e}");
        }
        assert_eq!(noise[0], 0.0);
        let noise = noise_of(&exact, Content::Intensity, 0.5, 0.0);
        let mean = |k: usize| exact.response[3 * k..3 * k + 3].iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
        for k in 1..15 {
            assert!((noise[k] / rounding(mean(k)) - 1.0).abs() < 1e-12, "{k}");
        }
    }

    #[test]
    fn rows_without_variance_or_scale_have_no_noise() {
        let mut none = planes(photons);
        for scale in [f64::INFINITY, f64::NAN] {
            let noise = noise_of(&none, Content::Intensity, scale, SD);
            assert_eq!(noise, vec![0.0; 15]);
        }
        none.variance.clear();
        let noise = noise_of(&none, Content::Channels, 1.0, SD);
        assert_eq!(noise, vec![0.0; 45]);
    }

    #[test]
    fn rows_without_gaps_have_the_noise_that_the_way_for_gaps_gives() {
        for window in [[7, 5], [1, 5], [6, 1], [1, 1], [2, 2]] {
            let n = window[0] * window[1];
            let value = |s: usize| ((7 * s * s + 3 * s) % 31) as f32 * 0.25 - 2.0;
            let response: Vec<f32> = (0..3 * n).map(value).collect();
            let variance: Vec<f32> = (0..3 * n).map(|s| 0.02 * ((5 * s) % 17) as f32).collect();
            let row = RowView { response: &response, variance: &variance, valid: &vec![1; 3 * n] };
            for (content, sd) in [(Content::Channels, 0.0), (Content::Channels, 0.05), (Content::Intensity, 0.05)] {
                let found = independent(row, content, 2.5, window, sd);
                let mut expected = vec![0.0; n * content.planes()];
                general(row, content, 2.5, window, sd * sd, &mut expected);
                for (f, e) in found.iter().zip(&expected) {
                    // Rounding of what is subtracted, up to 0.2 over 6.25.
                    assert!((f - e).abs() < 1e-16, "{window:?} {content:?} {sd}: {f:e} {e:e}");
                }
            }
        }
    }
}
