//! Which points of the table stand out: the front, what the program makes unasked, and what to take.

use super::{NoiseLevel, TradePoint};
use crate::material::Precision;

/// Marks the points that no other beats in both bytes and `psnr_db`.
pub(super) fn mark_pareto(points: &mut [TradePoint]) {
    let quality = |p: &TradePoint| p.psnr_db.unwrap_or(f64::INFINITY);
    let all: Vec<(u64, f64)> = points.iter().map(|p| (p.bytes, quality(p))).collect();
    for (k, point) in points.iter_mut().enumerate() {
        let (bytes, db) = all[k];
        let beaten =
            |(j, &(b, q)): (usize, &(u64, f64))| j != k && b <= bytes && q >= db && ((b, q) != (bytes, db) || j < k);
        point.pareto = !all.iter().enumerate().any(beaten);
    }
}

/// Marks the smallest of the points whose `rel_rmse` and `log_rmse` are no more than those of the plain default and of
/// the noise together, √(default² + noise²): what is worse than the default by less than the measurement's own error.
pub(super) fn mark_recommended(points: &mut [TradePoint], noise: Option<&NoiseLevel>) {
    let default = points.iter().find(|p| p.default && p.precision == Precision::F32);
    let Some(default) = default else { return };
    let error =
        |of: fn(&TradePoint) -> Option<f64>, noise: Option<f64>| of(default).unwrap_or(0.0).hypot(noise.unwrap_or(0.0));
    let most = [error(|p| p.rel_rmse, noise.map(|n| n.rel_rmse)), error(|p| p.log_rmse, noise.map(|n| n.log_rmse))];
    let good = |p: &TradePoint| p.rel_rmse.unwrap_or(0.0) <= most[0] && p.log_rmse.unwrap_or(0.0) <= most[1];
    let best = points.iter().enumerate().filter(|(_, p)| good(p)).min_by_key(|(_, p)| p.bytes).map(|(k, _)| k);
    if let Some(best) = best {
        points[best].recommended = true;
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::point;
    use super::*;

    #[test]
    fn the_front_is_what_nothing_beats_in_bytes_and_decibels() {
        let mut points = [(100, 40.0), (200, 50.0), (150, 39.0), (200, 48.0), (300, 50.0), (200, 50.0), (90, 20.0)]
            .map(|(bytes, db)| point(bytes, db));
        mark_pareto(&mut points);
        assert_eq!(points.map(|p| p.pareto), [true, true, false, false, false, false, true]);
    }

    #[test]
    fn recommended_is_the_smallest_that_is_worse_than_the_default_by_no_more_than_noise() {
        let made = |bytes, rel_rmse, log_rmse| TradePoint {
            rel_rmse: Some(rel_rmse),
            log_rmse: Some(log_rmse),
            precision: Precision::Coded,
            ..point(bytes, 40.0)
        };
        let mut points = [
            made(50, 0.004, 0.9),
            made(60, 0.007, 0.1),
            made(70, 0.0051, 0.2),
            TradePoint { default: true, ..made(80, 0.0051, 0.2) },
            TradePoint { default: true, precision: Precision::F32, ..made(90, 0.005, 0.2) },
            made(100, 0.001, 0.01),
        ];
        let noise = |rel_rmse| NoiseLevel { rel_rmse, psnr_db: 50.0, log_rmse: 0.01 };
        let mut recommended = |noise: Option<NoiseLevel>| {
            points.iter_mut().for_each(|p| p.recommended = false);
            mark_recommended(&mut points, noise.as_ref());
            points.iter().filter(|p| p.recommended).map(|p| p.bytes).collect::<Vec<_>>()
        };
        // √(.005² + .002²) = .0054. Poor tails stay out; with more noise the peaks of the second are good enough.
        assert_eq!(recommended(None), [90]);
        assert_eq!(recommended(Some(noise(0.002))), [70]);
        assert_eq!(recommended(Some(noise(0.005))), [60]);
        mark_recommended(&mut [point(10, 30.0)], None);
    }
}
