//! Photosites with a large dark current.

use crate::simulate::mix_seed;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use std::collections::BTreeMap;

/// Dark current of the median hot photosite, electrons per second, and the standard deviation of its logarithm.
/// Not measured: chosen so that the median is plainly seen in a second and one in a hundred is 30 times stronger.
const MEDIAN_ELECTRONS_PER_SEC: f64 = 200.0;
const LOG_SD: f64 = 1.5;

/// The photosites that are hot: index among `photosites` and dark current (electrons per second), in order.
///
/// The number is `fraction` of all, rounded; the current is log-normal, whose tail is long.
pub(crate) fn hot_pixels(photosites: usize, fraction: f64, seed: u64) -> Vec<(usize, f32)> {
    let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(seed, 0x407));
    let count = (fraction * photosites as f64).round() as usize;
    let mut hot = BTreeMap::new();
    while hot.len() < count.min(photosites) {
        let normal: f64 = StandardNormal.sample(&mut rng);
        let current = MEDIAN_ELECTRONS_PER_SEC * (LOG_SD * normal).exp();
        hot.entry(rng.random_range(0..photosites)).or_insert(current as f32);
    }
    hot.into_iter().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_are_hot_as_asked_and_their_currents_have_a_long_tail() {
        let hot = hot_pixels(2_000_000, 1e-2, 5);
        assert_eq!(hot.len(), 20_000);
        assert!(hot.windows(2).all(|w| w[0].0 < w[1].0));
        assert_eq!(hot, hot_pixels(2_000_000, 1e-2, 5));
        let mut currents: Vec<f64> = hot.iter().map(|h| f64::from(h.1)).collect();
        currents.sort_by(f64::total_cmp);
        let (median, mean) = (currents[10_000], currents.iter().sum::<f64>() / 2e4);
        // Standard errors: 1.25 · 1.5/√20000 = 1.3 % of the median, √(e^2.25 − 1)/√20000 = 2 % of the mean; five of
        // each.
        assert!((median / 200.0 - 1.0).abs() < 0.07, "{median}");
        assert!((mean / (200.0 * (0.5 * 1.5f64 * 1.5).exp()) - 1.0).abs() < 0.1, "{mean}");
        assert!(hot_pixels(1000, 0.0, 5).is_empty());
    }
}
