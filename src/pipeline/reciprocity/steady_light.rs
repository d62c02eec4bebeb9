//! Light in one place of the sample that the rows of all shots have: a reflection that `sample-black` has not. It adds to
//! what others say of the place, R_d(a, b) + g(b), and nothing to what the place says of others.
//!
//! Not detected: light between the lit points, light that is on most of them, light as on a smooth slope.

use super::{Common, Compared, LEAST_VALUES, Seen, of};
use crate::registration::{median, scaled_deviation};

/// A place is told where the light is so large a part of what the other rows have there, in the median.
const LEAST_SHARE: f64 = 0.1;
/// It is so many times its standard deviation, and what places usually differ by.
const PLACE_SIGMA: f64 = 5.5;
const SPREAD: f64 = 2.2;
/// A level of the place instead explains the pairs so much worse.
const LEVEL_WORSE: f64 = 1.25;
/// Times that all places are fitted.
const SWEEPS: usize = 8;
/// Times that weights are found from what is left.
const ROUNDS: usize = 6;

/// Light that is not the dots'.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct SteadyLight {
    /// The row of the brightest place.
    pub(super) row: usize,
    /// Over the row's own peak, and its standard deviation.
    pub(super) share: f64,
    pub(super) sd: f64,
    /// Places that have it.
    pub(super) places: usize,
}

/// What two rows say between the same two places: of the place, from it, and the variance of their difference.
#[derive(Clone, Copy)]
struct Pair {
    other: usize,
    there: f64,
    back: f64,
    variance: f64,
}

/// Looks for such light.
pub(super) fn find(pairs: &Compared, seen: &[Seen], common: &Common) -> Option<SteadyLight> {
    let of_place = |j: usize| -> Vec<Pair> {
        let pair = |&(k, _): &(usize, Vec<super::Light>)| {
            let (there, back) = (of(&seen[k], j)?[0], of(&seen[j], k)?[0]);
            let factor = common.get(&pairs.step(k, j))?.exp();
            let variance = there[1] / (factor * factor) + back[1];
            Some(Pair { other: k, there: there[0] / factor, back: back[0], variance })
        };
        seen[j].there.iter().filter_map(pair).collect()
    };
    let all: Vec<Vec<Pair>> = (0..seen.len()).map(of_place).collect();
    // What pairs differ by, over their light, without anybody's light: the structure of the sample within a cell.
    let structure = scaled_deviation(
        all.iter().flatten().filter(|p| p.back > 0.0).map(|p| (p.there - p.back) / p.back.max(p.variance.sqrt())),
        0.0,
    );
    // Light in one place is in what this place says of others: of all of them together.
    let mut light = vec![0.0; seen.len()];
    let mut fits: Vec<Option<Fit>> = vec![None; seen.len()];
    let mut left_of_level = vec![0.0; seen.len()];
    for sweep in 1..=SWEEPS {
        for (j, pairs) in all.iter().enumerate() {
            let own: Vec<Pair> = pairs.iter().map(|p| Pair { back: p.back - light[p.other], ..*p }).collect();
            fits[j] = Fit::of(&own, structure);
            light[j] = fits[j].map_or(0.0, |f| f.light);
            if sweep == SWEEPS {
                // there = level · back instead.
                left_of_level[j] = Solved::of(&own, structure, |p| p.back).left;
            }
        }
        // Only differences are seen: most places have none.
        let none = median(&mut fits.iter().flatten().map(|f| f.light).collect::<Vec<_>>());
        light.iter_mut().for_each(|l| *l -= none);
        fits.iter_mut().flatten().for_each(|f| f.light -= none);
    }
    let usual = scaled_deviation(fits.iter().flatten().map(|f| f.light), 0.0);
    let is_lit = |(j, f): &(usize, Fit)| {
        let least = (PLACE_SIGMA * f.sd).max(SPREAD * usual).max(LEAST_SHARE * f.usual_light);
        f.light > least && LEVEL_WORSE * f.left < left_of_level[*j]
    };
    let lit: Vec<(usize, Fit)> =
        fits.iter().enumerate().filter_map(|(j, fit)| Some((j, (*fit)?))).filter(is_lit).collect();
    let places = lit.len();
    let &(row, fit) = lit.iter().max_by(|a, b| a.1.light.total_cmp(&b.1.light))?;
    let peak = seen[row].peak;
    (peak > 0.0).then_some(SteadyLight { row, share: fit.light / peak, sd: fit.sd / peak, places })
}

/// there = back + light, of the pairs of a place.
#[derive(Clone, Copy, Debug)]
struct Fit {
    light: f64,
    sd: f64,
    /// [`Solved::left`].
    left: f64,
    /// The median of what the others have in the place, without it.
    usual_light: f64,
}

impl Fit {
    /// `None` for too few pairs.
    fn of(pairs: &[Pair], structure: f64) -> Option<Self> {
        if pairs.len() < LEAST_VALUES {
            return None;
        }
        let Solved { unknown: light, sd, left } = Solved::of(pairs, structure, |_| 1.0);
        let usual_light = median(&mut pairs.iter().map(|p| p.back.max(0.0)).collect::<Vec<_>>());
        light.is_finite().then_some(Self { light, sd, left, usual_light })
    }
}

/// there = back + unknown · of, where a pair has the noise of both and what structure does to it.
struct Solved {
    unknown: f64,
    sd: f64,
    /// The sum of what is left of the pairs, as Cauchy's law counts it.
    left: f64,
}

impl Solved {
    /// By least squares with Cauchy's weights.
    fn of(pairs: &[Pair], structure: f64, of: impl Fn(&Pair) -> f64) -> Self {
        let whiten = |p: &Pair| {
            let sd = (p.variance + (structure * p.back).powi(2)).sqrt();
            [(p.there - p.back) / sd, of(p) / sd]
        };
        let whitened: Vec<[f64; 2]> = pairs.iter().map(whiten).collect();
        let (mut unknown, mut sd) = (0.0, f64::INFINITY);
        for _ in 0..ROUNDS {
            let left = |[y, x]: &[f64; 2]| y - unknown * x;
            let scale = scaled_deviation(whitened.iter().map(left), 0.0).max(1.0);
            let (mut xx, mut xy) = (0.0, 0.0);
            for w in &whitened {
                let weight = 1.0 / (1.0 + (left(w) / (2.0 * scale)).powi(2));
                (xx, xy) = (xx + weight * w[1] * w[1], xy + weight * w[0] * w[1]);
            }
            (unknown, sd) = (xy / xx, scale / xx.sqrt());
        }
        let cost = |w: &[f64; 2]| (1.0 + ((w[0] - unknown * w[1]) / 2.0).powi(2)).ln();
        Self { unknown, sd, left: whitened.iter().map(cost).sum() }
    }
}
