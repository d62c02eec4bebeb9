//! How near the dots of one shot may be: from measured rows to the smallest spacing.

use crate::transport::rows::RowView;

/// How a material's response falls with distance, from measured rows.
///
/// Beyond the last ring that stands out of the noise it is continued as an exponential, fitted to the outer half of
/// those rings. Diffusion in a slab falls exponentially in the end, and more steeply before: the continuation is a
/// little too low, by as much as the slope still changes.
#[derive(Debug, Clone, PartialEq)]
pub struct Tails {
    pitch_mm: f64,
    /// Mean distance of the samples of each ring, samples: ring k is those that round to k.
    radius: Vec<f64>,
    channels: [Channel; 3],
}

#[derive(Debug, Clone, PartialEq, Default)]
struct Channel {
    /// Mean over all rows of each ring, mm⁻².
    mean: Vec<f64>,
    /// The largest of the rows' means.
    largest: Vec<f64>,
    /// Standard deviation of one sample.
    sd: Vec<f64>,
    /// Rings from the first that stand out of the noise without a gap.
    significant: usize,
    /// Change of ln R in a sample beyond them; `None` when too few rings or a tail that does not fall.
    slope: Option<f64>,
}

/// A ring's mean counts when it is so many standard deviations above none.
const SIGNIFICANT: f64 = 3.0;
/// Neighbours as far as so many spacings add to a window.
const NEIGHBOURS: i32 = 3;
/// Rings of which an exponential is made.
const LEAST_RINGS: usize = 3;

impl Tails {
    /// From rows of `window` samples a side (see [`RowView`]) with cells of `pitch_mm`. `None` when no row has a
    /// measured middle.
    pub fn of<'a>(rows: impl Iterator<Item = RowView<'a>>, window: [usize; 2], pitch_mm: f64) -> Option<Self> {
        let rings = window[0].min(window[1]) / 2 + 1;
        let distance = |k: usize| {
            let off = |a: usize, n: usize| n as f64 - (window[a] / 2) as f64;
            off(0, k % window[0]).hypot(off(1, k / window[0]))
        };
        let mut radius = vec![(0.0, 0.0); rings];
        for r in (0..window[0] * window[1]).map(distance) {
            if let Some(sum) = radius.get_mut(r.round() as usize) {
                *sum = (sum.0 + r, sum.1 + 1.0);
            }
        }
        let radius: Vec<f64> = radius.into_iter().map(|(sum, n)| sum / n).collect();
        let mut sums = [0, 1, 2].map(|_| vec![RingSum::default(); rings]);
        for row in rows {
            let mut own = [0, 1, 2].map(|_| vec![RingSum::default(); rings]);
            for k in 0..window[0] * window[1] {
                let ring = distance(k).round() as usize;
                for c in (0..3).filter(|c| ring < rings && row.valid[3 * k + c] != 0) {
                    own[c][ring].add(f64::from(row.response[3 * k + c]), f64::from(row.variance[3 * k + c]));
                }
            }
            for (all, own) in sums.iter_mut().zip(&own) {
                all.iter_mut().zip(own).for_each(|(all, own)| all.join(own));
            }
        }
        if sums.iter().any(|s| s[0].count == 0.0) {
            return None;
        }
        Some(Self { pitch_mm, channels: sums.map(|s| Channel::new(&s, &radius)), radius })
    }

    /// The largest of the rows' responses at `r_mm`, mm⁻², channel `c` (0 to 2).
    pub fn largest_at(&self, r_mm: f64, c: usize) -> f64 {
        let channel = &self.channels[c];
        channel.at(&channel.largest, &self.radius, r_mm / self.pitch_mm)
    }

    /// The mean of the rows' responses at `r_mm`, mm⁻².
    pub fn mean_at(&self, r_mm: f64, c: usize) -> f64 {
        let channel = &self.channels[c];
        channel.at(&channel.mean, &self.radius, r_mm / self.pitch_mm)
    }

    /// Standard deviation of one sample at `r_mm`; beyond the window that of its rim.
    fn sd_at(&self, r_mm: f64, c: usize) -> f64 {
        let sd = &self.channels[c].sd;
        sd[((r_mm / self.pitch_mm).round() as usize).min(sd.len() - 1)]
    }

    /// Where the response has fallen below `share` of its peak, or below the noise of one sample, in all channels, mm,
    /// and whether it was seen to be there; `None` when it never does.
    pub fn reach_mm(&self, share: f64) -> Option<(f64, bool)> {
        let small = |r: f64, c: usize| self.largest_at(r, c) < (share * self.largest_at(0.0, c)).max(self.sd_at(r, c));
        let mut reach = (0.0, true);
        for c in 0..3 {
            // No window has more than 4095 samples.
            let r = (1..2048).map(|k| k as f64 * self.pitch_mm).find(|&r| small(r, c))?;
            if r > reach.0 {
                reach = (r, r <= self.measured_mm(c) + self.pitch_mm);
            }
        }
        Some(reach)
    }

    /// Beyond this the response of channel `c` is continued and not measured, mm.
    pub fn measured_mm(&self, c: usize) -> f64 {
        self.channels[c].significant.checked_sub(1).map_or(0.0, |last| self.radius[last] * self.pitch_mm)
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct RingSum {
    value: f64,
    variance: f64,
    count: f64,
    largest: f64,
}

impl RingSum {
    fn add(&mut self, value: f64, variance: f64) {
        (self.value, self.variance, self.count) = (self.value + value, self.variance + variance, self.count + 1.0);
    }

    fn join(&mut self, row: &Self) {
        if row.count > 0.0 {
            let mean = row.value / row.count;
            self.largest = if self.count == 0.0 { mean } else { self.largest.max(mean) };
            (self.value, self.variance, self.count) =
                (self.value + row.value, self.variance + row.variance, self.count + row.count);
        }
    }
}

impl Channel {
    fn new(rings: &[RingSum], radius: &[f64]) -> Self {
        let mean: Vec<f64> = rings.iter().map(|r| r.value / r.count.max(1.0)).collect();
        let stands_out = |r: &RingSum| r.count > 0.0 && r.value > SIGNIFICANT * r.variance.sqrt();
        let significant = rings.iter().position(|r| !stands_out(r)).unwrap_or(rings.len());
        let largest: Vec<f64> = rings.iter().map(|r| r.largest).collect();
        let sd = rings.iter().map(|r| (r.variance / r.count.max(1.0)).sqrt()).collect();
        let slope = slope(&largest[..significant], radius);
        Self { mean, largest, sd, significant, slope }
    }

    /// Of `values` a ring, at `r` samples: between rings as an exponential.
    fn at(&self, values: &[f64], radius: &[f64], r: f64) -> f64 {
        let Some(last) = self.significant.checked_sub(1) else { return 0.0 };
        if r < radius[last] {
            let k = radius.partition_point(|&v| v <= r).clamp(1, last) - 1;
            let t = (r - radius[k]) / (radius[k + 1] - radius[k]);
            return values[k].powf(1.0 - t) * values[k + 1].powf(t);
        }
        match self.slope {
            Some(slope) => values[last] * (slope * (r - radius[last])).exp(),
            // Noise hides what follows; or the tail does not fall, and stays.
            None if self.significant < values.len() => 0.0,
            None => values[last],
        }
    }
}

/// Least squares of ln R against distance over the outer half.
fn slope(values: &[f64], radius: &[f64]) -> Option<f64> {
    let first = values.len() / 2;
    let points: Vec<(f64, f64)> = (first..values.len()).map(|k| (radius[k], values[k].ln())).collect();
    if points.len() < LEAST_RINGS {
        return None;
    }
    let n = points.len() as f64;
    let (x, y) = (points.iter().map(|p| p.0).sum::<f64>() / n, points.iter().map(|p| p.1).sum::<f64>() / n);
    let (xy, xx) = points.iter().fold((0.0, 0.0), |s, p| (s.0 + (p.0 - x) * (p.1 - y), s.1 + (p.0 - x) * (p.0 - x)));
    Some(xy / xx).filter(|s| *s < 0.0)
}

/// Settings of [`choose_spacing`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpacingOptions {
    /// Side of the window, samples.
    pub window: usize,
    /// Distance of lit points, mm: spacings are multiples of it.
    pub lit_pitch_mm: f64,
    /// Share of a row's light that the tails of other dots may add to it. 0.1: what is left when `build-matrix` has
    /// taken it out is a fraction of the other errors of a good capture (docs/accuracy.md).
    pub most_cross_talk: f64,
}

impl Default for SpacingOptions {
    fn default() -> Self {
        Self { window: 31, lit_pitch_mm: 0.5, most_cross_talk: 0.1 }
    }
}

/// The smallest spacing that will do.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct SpacingChoice {
    /// Distance of the dots of one shot along each axis, mm.
    pub spacing_mm: f64,
    /// What the tails of other dots add to a row's light, as a share of it, in the worst channel.
    pub cross_talk: f64,
    /// Whether the tails are below the noise of single samples all over the window, whatever their share.
    pub below_noise: bool,
    /// Tails of that channel beyond this distance were continued as an exponential, mm.
    pub measured_mm: f64,
}

/// The smallest multiple of the lit pitch at which a square lattice of dots puts little enough of other dots' tails
/// into a window: no more than a share of the row's light, or less than the noise of a sample all over the window.
///
/// The neighbours' tails are the largest of the measured rows, the row's own light is their mean. `None` when no
/// spacing up to four windows will do. Not known: materials beside the probed places.
pub fn choose_spacing(tails: &Tails, options: &SpacingOptions) -> Option<SpacingChoice> {
    let pitch = tails.pitch_mm;
    let half = (options.window / 2) as i32;
    // A window is symmetric: one quarter of it tells all, its axes counted once.
    let cells: Vec<([f64; 2], f64)> = (0..=half)
        .flat_map(|y| (0..=half).map(move |x| (x, y)))
        .map(|(x, y)| {
            let weight = [x, y].iter().map(|&v| if v == 0 { 1.0 } else { 2.0 }).product();
            ([f64::from(x) * pitch, f64::from(y) * pitch], weight)
        })
        .collect();
    let light: [f64; 3] =
        std::array::from_fn(|c| cells.iter().map(|(d, w)| w * tails.mean_at(d[0].hypot(d[1]), c)).sum());
    let most = (4.0 * options.window as f64 * pitch / options.lit_pitch_mm).ceil() as usize;
    (1..=most).find_map(|k| {
        let spacing_mm = k as f64 * options.lit_pitch_mm;
        let (mut worst, mut below_noise) = ((0.0f64, 0), true);
        for (c, light) in light.iter().enumerate() {
            let mut sum = 0.0;
            for (d, weight) in &cells {
                let tail = neighbours(tails, *d, spacing_mm, c);
                sum += weight * tail;
                below_noise &= tail <= tails.sd_at(d[0].hypot(d[1]), c);
            }
            if sum / light > worst.0 {
                worst = (sum / light, c);
            }
        }
        let (cross_talk, channel) = worst;
        let measured_mm = tails.measured_mm(channel);
        let will_do = cross_talk <= options.most_cross_talk || below_noise;
        will_do.then_some(SpacingChoice { spacing_mm, cross_talk, below_noise, measured_mm })
    })
}

/// The light of the dots around, at `d` (mm) from a dot.
fn neighbours(tails: &Tails, d: [f64; 2], spacing_mm: f64, c: usize) -> f64 {
    let all = (-NEIGHBOURS..=NEIGHBOURS).flat_map(|j| (-NEIGHBOURS..=NEIGHBOURS).map(move |i| (i, j)));
    let others = all.filter(|&n| n != (0, 0));
    others
        .map(|(i, j)| (f64::from(i) * spacing_mm - d[0]).hypot(f64::from(j) * spacing_mm - d[1]))
        .map(|r| tails.largest_at(r, c))
        .sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: usize = 21;
    const PITCH: f64 = 0.5;

    /// A row that falls as exp(−r/length), with the same noise in every sample.
    fn row(length_mm: f64, sd: f32) -> (Vec<f32>, Vec<f32>, Vec<u8>) {
        let half = (WINDOW / 2) as f64;
        let response = (0..WINDOW * WINDOW).flat_map(|k| {
            let (x, y) = ((k % WINDOW) as f64 - half, (k / WINDOW) as f64 - half);
            [(-x.hypot(y) * PITCH / length_mm).exp() as f32; 3]
        });
        let response: Vec<f32> = response.collect();
        let n = response.len();
        (response, vec![sd * sd; n], vec![1; n])
    }

    fn tails(length_mm: f64, sd: f32) -> Tails {
        let (response, variance, valid) = row(length_mm, sd);
        let view = RowView { response: &response, variance: &variance, valid: &valid };
        Tails::of(std::iter::once(view), [WINDOW; 2], PITCH).unwrap()
    }

    /// Cross-talk by adding up the exact profile, cell by cell and dot by dot.
    fn exact_share(length_mm: f64, spacing_mm: f64) -> f64 {
        let half = (WINDOW / 2) as i32;
        let (mut own, mut others) = (0.0, 0.0);
        for y in -half..=half {
            for x in -half..=half {
                let d = [f64::from(x) * PITCH, f64::from(y) * PITCH];
                own += (-d[0].hypot(d[1]) / length_mm).exp();
                for j in -12..=12 {
                    for i in -12..=12 {
                        if (i, j) != (0, 0) {
                            let r = (f64::from(i) * spacing_mm - d[0]).hypot(f64::from(j) * spacing_mm - d[1]);
                            others += (-r / length_mm).exp();
                        }
                    }
                }
            }
        }
        others / own
    }

    #[test]
    fn the_spacing_is_the_smallest_whose_exact_cross_talk_is_below_the_limit() {
        for (length_mm, most_cross_talk) in [(0.4, 0.01), (0.8, 0.01), (0.8, 0.001), (1.2, 0.03)] {
            let options = SpacingOptions { window: WINDOW, lit_pitch_mm: PITCH, most_cross_talk };
            // So little noise that only the share decides.
            let choice = choose_spacing(&tails(length_mm, 1e-12), &options).unwrap();
            // Rings are rounded to whole samples: the share is off by a few per cent, the choice by one step at most.
            assert!(exact_share(length_mm, choice.spacing_mm) < 1.1 * most_cross_talk, "{length_mm} {choice:?}");
            assert!(
                exact_share(length_mm, choice.spacing_mm - 2.0 * PITCH) > most_cross_talk,
                "{length_mm} {choice:?}"
            );
            assert!(!choice.below_noise);
        }
    }

    #[test]
    fn tails_below_the_noise_do_not_keep_dots_apart() {
        let options = SpacingOptions { window: WINDOW, lit_pitch_mm: PITCH, most_cross_talk: 1e-5 };
        let (quiet, noisy) = (tails(0.8, 1e-12), tails(0.8, 1e-3));
        let [quiet, noisy] = [quiet, noisy].map(|t| choose_spacing(&t, &options).unwrap());
        assert!(noisy.below_noise && noisy.spacing_mm < quiet.spacing_mm, "{noisy:?} {quiet:?}");
    }

    #[test]
    fn a_tail_is_continued_beyond_the_window_and_beyond_the_noise() {
        for sd in [1e-12, 1e-4] {
            let tails = tails(0.8, sd);
            for r in [1.0f64, 4.0, 6.0, 9.0] {
                let (found, truth) = (tails.largest_at(r, 1), (-r / 0.8).exp());
                // Means over rings of whole samples put the curve off by a few per cent; a slope of five rings by a
                // hundredth, times 6 mm.
                assert!((found / truth - 1.0).abs() < 0.12, "{r} mm: {found} {truth}");
            }
        }
        // exp(−r/0.8) is 1e-4 at 7.4 mm, and below a noise of 0.01 from 3.7 mm on.
        assert!((tails(0.8, 1e-12).reach_mm(1e-4).unwrap().0 - 7.4).abs() <= PITCH);
        assert!(!tails(0.8, 1e-12).reach_mm(1e-4).unwrap().1 && tails(0.8, 1e-2).reach_mm(1e-4).unwrap().1);
        assert!((tails(0.8, 1e-2).reach_mm(1e-4).unwrap().0 - 3.7).abs() <= PITCH);
    }

    #[test]
    fn a_response_that_does_not_fall_has_no_spacing() {
        let options = SpacingOptions { window: WINDOW, lit_pitch_mm: PITCH, most_cross_talk: 0.01 };
        assert_eq!(choose_spacing(&tails(1e9, 1e-12), &options), None);
    }
}
