//! How far projector and camera have moved at each lattice shot: a slow walk, and sudden jumps that stay.

use crate::geometry::Point;
use crate::simulate::mix_seed;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

/// Jumps lead nowhere farther from the first place than this many times their length.
pub(crate) const JUMP_REACH: f64 = 1.5;

/// A movement of something over the sweep.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Motion {
    /// Root mean square length of the slow walk, px.
    pub walk_px: f64,
    /// Length and number of the jumps.
    pub jump_px: f64,
    pub jumps: usize,
    pub seed: u64,
}

impl Motion {
    /// Its displacement at each of `shots`, px.
    pub(crate) fn path(&self, shots: usize) -> Vec<Point> {
        let walk = slow_walk(shots, self.walk_px, self.seed);
        let jumps = jumps(shots, self.jumps, self.seed);
        walk.iter().zip(jumps).map(|(w, j)| std::array::from_fn(|a| w[a] + self.jump_px * j[a])).collect()
    }
}

/// A slow random walk, one step per lattice shot: root mean square length `rms_px`.
fn slow_walk(shots: usize, rms_px: f64, seed: u64) -> Vec<Point> {
    const MEMORY: f64 = 0.95;
    let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(seed, 0xd21f7));
    let mut at = [0.0; 2];
    let mut walk = Vec::with_capacity(shots);
    for shot in 0..shots {
        let step: Point = std::array::from_fn(|_| StandardNormal.sample(&mut rng));
        let (keep, move_by) = if shot == 0 { (0.0, 1.0) } else { (MEMORY, (1.0 - MEMORY * MEMORY).sqrt()) };
        at = std::array::from_fn(|a| keep * at[a] + move_by * step[a]);
        walk.push(at);
    }
    let mean_square = walk.iter().map(|p| p[0] * p[0] + p[1] * p[1]).sum::<f64>() / shots.max(1) as f64;
    let scale = if mean_square > 0.0 { rms_px / mean_square.sqrt() } else { 0.0 };
    // No shot beyond 3.4 times the root mean square, so that every window stays on the sample.
    walk.iter()
        .map(|p| {
            let length = p[0].hypot(p[1]) * scale;
            let limit = if length > 3.4 * rms_px { 3.4 * rms_px / length } else { 1.0 };
            p.map(|v| v * scale * limit)
        })
        .collect()
}

/// Where jumps of length one have led at each shot: `count` of them (or one at each shot but the first), at different
/// shots, each in a random direction that stays within [`JUMP_REACH`].
fn jumps(shots: usize, count: usize, seed: u64) -> Vec<Point> {
    let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(seed, 0x70b5));
    let mut when: Vec<usize> = (1..shots).collect();
    let count = count.min(when.len());
    for k in 0..count {
        let other = rng.random_range(k..when.len());
        when.swap(k, other);
    }
    let when = &when[..count];
    let mut at = [0.0; 2];
    let mut path = Vec::with_capacity(shots);
    for shot in 0..shots {
        if when.contains(&shot) {
            at = loop {
                let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
                let next: Point = [at[0] + cos, at[1] + sin];
                if next[0].hypot(next[1]) <= JUMP_REACH {
                    break next;
                }
            };
        }
        path.push(at);
    }
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    const STILL: Motion = Motion { walk_px: 0.0, jump_px: 0.0, jumps: 3, seed: 7 };

    #[test]
    fn the_walk_has_the_length_that_was_asked_for_and_is_slow() {
        let walk = Motion { walk_px: 0.5, ..STILL }.path(400);
        let mean_square = |steps: &[Point]| steps.iter().map(|p| p[0] * p[0] + p[1] * p[1]).sum::<f64>() / 400.0;
        // The limit on single shots may shorten it by a little.
        assert!((mean_square(&walk).sqrt() - 0.5).abs() < 0.01);
        let steps: Vec<Point> = walk.windows(2).map(|w| [w[1][0] - w[0][0], w[1][1] - w[0][1]]).collect();
        // A memory of 0.95: steps of √(2 · 0.05) of the length.
        assert!(mean_square(&steps).sqrt() < 0.4 * 0.5);
        assert!(STILL.path(400).iter().all(|p| *p == [0.0; 2]));
    }

    #[test]
    fn jumps_have_the_number_and_size_that_were_asked_for_and_stay() {
        for (jumps, seed) in [(1, 1), (3, 2), (12, 3), (400, 4)] {
            let path = Motion { jump_px: 1.5, jumps, seed, ..STILL }.path(200);
            let lengths = path.windows(2).map(|w| (w[1][0] - w[0][0]).hypot(w[1][1] - w[0][1]));
            let jumped: Vec<f64> = lengths.filter(|l| *l > 0.0).collect();
            assert_eq!(jumped.len(), jumps.min(199));
            assert!(jumped.iter().all(|l| (l - 1.5).abs() < 1e-12));
            assert!(path.iter().all(|p| p[0].hypot(p[1]) <= 1.5 * JUMP_REACH + 1e-12));
        }
    }
}
