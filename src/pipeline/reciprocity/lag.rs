//! Light of the pattern before in all shots: a projector that lags leaves it in the place of the dot before.

use super::{Compared, FARTHEST, LEAST_VALUES, SEEN_SIGMA, SIGMA, Seen, of, sd_of_median};
use crate::ConsistencyWarning;
use crate::geometry::{Point, sight_slope};
use crate::pipeline::scene::Scene;
use crate::registration::median;

/// Light of this share of a dot's own in the place of the dot before is no chance of a medium's structure.
pub(super) const LEAST_LAG: f64 = 0.03;
/// Pairs tell how far tails are displaced where they lie along the displacement, by this cosine.
const LEAST_ALONG: f64 = 0.4;
/// Of values that a medium does not reach so many tell how far they may be off.
const LEAST_FAR: usize = 3;

impl Compared {
    /// The part of the dots' offset that light from depth makes. Light of the dot before draws them along the way from
    /// dot to dot: how far they are off across it tells, where the line of sight leans that way.
    pub(super) fn offset_of_depth(&self, scene: &Scene<'_>) -> Point {
        let Some(eye_mm) = scene.registration.view.eye_mm() else { return self.offset_mm };
        let middle = |a: usize| median(&mut self.lit.iter().flatten().map(|l| l.at_mm[a]).collect::<Vec<_>>());
        let slope = sight_slope(eye_mm, [middle(0), middle(1)]);
        let [x, y] = self.way().map_or([0.0; 2], |way| {
            let step = scene.steps_mm();
            [0, 1].map(|a| way[0] as f64 * step[0][a] + way[1] as f64 * step[1][a])
        });
        let across = [-y, x];
        let along = |v: Point| (v[0] * across[0] + v[1] * across[1]) / across[0].hypot(across[1]).max(1e-12);
        if along(slope).abs() < LEAST_ALONG * slope[0].hypot(slope[1]) || x.hypot(y) == 0.0 {
            return self.offset_mm;
        }
        slope.map(|t| t * along(self.offset_mm) / along(slope))
    }

    /// The usual step from a dot to that of the shot before.
    fn way(&self) -> Option<[isize; 2]> {
        let mut ways: Vec<[isize; 2]> = self.lag.iter().map(|&[own, before]| self.step(own, before)).collect();
        ways.sort_unstable();
        ways.get(ways.len() / 2).copied()
    }

    /// Light of the pattern before in all shots.
    pub(super) fn lag(&self, seen: &[Seen]) -> Option<ConsistencyWarning> {
        let times = self.times_displaced(seen);
        // Over the peak of the dot before, what its place has too much. Between cells it seems less than it is.
        let values: Vec<Excess> = self.lag.iter().filter_map(|&pair| Excess::of(seen, pair, times)).collect();
        // So far from the dot before, it does not matter how far beside its place its light is seen.
        let is_far = |v: &&Excess| v.spread < LEAST_LAG && v.own < 2.0 * LEAST_LAG;
        let far: Vec<f64> = values.iter().filter(is_far).map(|v| v.share).collect();
        let all: Vec<f64> = values.iter().map(|v| v.share).collect();
        let found = |mut values: Vec<f64>, least: usize| {
            let share = median(&mut values);
            let sd = sd_of_median(&values, share);
            (values.len() >= least && share >= LEAST_LAG.max(SIGMA * sd)).then_some((share, sd))
        };
        // Two say nothing of how far they may be off: both have to be far off.
        let few = far.len() < LEAST_FAR && far.iter().any(|share| *share < 2.0 * LEAST_LAG);
        let of_far = found(far, 2).filter(|_| !few);
        // Near ones depend on how far beside their places tails are seen, which is known to about a dot's offset.
        let doubt = |v: &Excess| (v.spread / FARTHEST as f64).max((v.share - v.beside).abs());
        let doubt = median(&mut values.iter().map(doubt).collect::<Vec<_>>());
        let of_all = || found(all, LEAST_VALUES).filter(|(share, _)| *share > LEAST_LAG + doubt);
        // However far their tails are displaced.
        let least: Vec<f64> = values.iter().map(|v| v.least).collect();
        let of_least = || found(least, LEAST_VALUES);
        let (share, sd) = of_far.or_else(of_all).or_else(of_least)?;
        Some(ConsistencyWarning::PatternRemains { later: -1, share, sd, channel: None })
    }

    /// How many times as far as the dots' cores their tails are seen beside their places: from pairs that lie across
    /// the way from dot to dot, in which light of the pattern before is the same. `None` where the view says nothing
    /// of it.
    fn times_displaced(&self, seen: &[Seen]) -> Option<f64> {
        let way = self.way()?;
        let across = |step: [isize; 2]| step[0] * way[0] + step[1] * way[1] == 0;
        // ln of there over back, of as many times the offset as there are; those towards the side of the offset.
        let mut all: Vec<Vec<f64>> = Vec::new();
        for (k, own) in seen.iter().enumerate() {
            for (j, there) in own.there.iter().filter(|(j, _)| across(self.step(k, *j))) {
                let (Some(from), Some(to), Some(back)) = (self.lit[k], self.lit[*j], of(&seen[*j], k)) else {
                    continue;
                };
                let apart = [0, 1].map(|a| to.at_mm[a] - from.at_mm[a]);
                let along = (apart[0] * self.depth_mm[0] + apart[1] * self.depth_mm[1])
                    / (apart[0].hypot(apart[1]) * self.depth_mm[0].hypot(self.depth_mm[1])).max(1e-12);
                let both: Vec<_> = there.iter().zip(back).skip(1).collect();
                let is_seen =
                    both.iter().all(|(t, b)| t[0].min(b[0]) > SEEN_SIGMA * (t[1] + b[1]).sqrt() && b[0] > 0.0);
                if along > LEAST_ALONG && is_seen && both.len() == FARTHEST + 1 {
                    all.push(both.iter().map(|(t, b)| (t[0] / b[0]).ln()).collect());
                }
            }
        }
        if all.len() < LEAST_VALUES {
            return None;
        }
        let middle = |m: usize| median(&mut all.iter().map(|a| a[m]).collect::<Vec<_>>());
        let middles: Vec<f64> = (0..=FARTHEST).map(middle).collect();
        // Where the two are alike.
        let crossing = middles.windows(2).position(|w| w[0] * w[1] <= 0.0 && w[0] != w[1]);
        crossing.map(|m| m as f64 + middles[m] / (middles[m] - middles[m + 1]))
    }
}

/// What a row has too much in the place of the dot before.
struct Excess {
    /// Its light there less what that dot's row has in its place, over that row's peak.
    share: f64,
    /// The same as far beside its place as dots are seen, and as far as leaves least.
    beside: f64,
    least: f64,
    /// By how much that depends on how far beside their places tails are seen.
    spread: f64,
    /// What a medium has there, over that row's peak.
    own: f64,
}

impl Excess {
    /// Light from depth displaces all of a row to one side, its tails more than its peak: so many `times` as far, and
    /// where that is not known, as far as leaves least.
    fn of(seen: &[Seen], [own, before]: [usize; 2], times: Option<f64>) -> Option<Self> {
        let (there, back, peak) = (of(&seen[own], before)?, of(&seen[before], own)?, seen[before].peak);
        let each: Vec<f64> = there.iter().zip(back).map(|(there, back)| (there[0] - back[0]) / peak).collect();
        let (beside, all) = (*each.first()?, each.get(1..)?);
        let (least, most) =
            (all.iter().copied().fold(f64::INFINITY, f64::min), all.iter().copied().fold(0.0, f64::max));
        let at = |t: f64| {
            let (low, part) = (t.floor() as usize, t.fract());
            Some((1.0 - part) * all.get(low)? + part * all.get(t.ceil() as usize)?)
        };
        let share = times.and_then(at).unwrap_or(least);
        (peak > 0.0).then(|| Self {
            share,
            beside,
            least: beside.min(least),
            spread: most - least,
            own: back[0][0] / peak,
        })
    }
}
