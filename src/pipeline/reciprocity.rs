//! R_d(a, b) = R_d(b, a), whatever the sample is made of: what two rows say of each other's places must agree. A shot
//! that had less light on the sample than on the frame, light of the shot before, and light that is not the dots', do
//! not.

mod lag;
mod steady_light;

use super::BuildOptions;
use super::dots_seen::DotSeen;
use super::lattice::ShotResult;
use super::remains;
use super::scene::Scene;
use super::sink::RowSink;
use crate::capture::{Pattern, Window};
use crate::geometry::Point;
use crate::registration::{median, scaled_deviation};
use crate::transport::Row;
use crate::{ConsistencyWarning, Result, Warning};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Rows are compared from this many radii of a dot on: nearer, the dot's own edge is what is seen.
const LEAST_RADII: f64 = 2.0;
/// Light that is not so many times its standard deviation is not compared.
const SEEN_SIGMA: f64 = 6.0;
/// A shot whose level differs by less, ln, from what others say is not told: beside a boundary of media a dot and a
/// cell, which have not the same shape, see other shares of it. The largest of the 85 untouched captures of
/// tests/tampered: 0.12.
const LEAST_LEVEL: f64 = 0.2;
/// Single places of a shot that differ by more, ln, are shadowed or lit when there are so many of them, and this share
/// of those that were compared.
const LEAST_PLACE: f64 = 0.35;
const LEAST_PLACES: usize = 4;
const PLACES_SHARE: f64 = 0.08;
/// The tails of a row come from deeper than its dot's core, and are displaced the more by an oblique view: by up to so
/// many times as much.
const FARTHEST: usize = 4;
/// Steps along the grid that are looked at.
const MOST_STEPS: isize = 1000;
/// What is told is so many standard deviations off.
const SIGMA: f64 = 6.0;
/// With fewer values nothing is said.
const LEAST_VALUES: usize = 8;

/// Light of a row in a place, and its variance.
type Light = [f64; 2];

/// ln of what all pairs of a displacement, in steps of the grid, have in common.
type Common = BTreeMap<[isize; 2], f64>;

/// What rows say of each other's places.
///
/// # Errors
/// [`crate::Error::Contradiction`]; those of reading rows.
pub(super) fn judge(
    scene: &Scene<'_>,
    results: &[ShotResult],
    rows: &impl RowSink,
    options: &BuildOptions,
) -> Result<Vec<Warning>> {
    let pairs = Compared::of(scene, results);
    let seen = pairs.look(scene, rows)?;
    // Places away from all tails tell better: where they show none of the pattern before, tails lean for another reason.
    let lag = pairs.lag(&seen).filter(|_| !remains::exclude(results, lag::LEAST_LAG));
    let mut warnings: Vec<Warning> = lag.map(|f| options.refuse(f)).transpose()?.into_iter().collect();
    let common = pairs.common(&seen);
    if let Some(off) = pairs.levels(&seen, &common) {
        let shot = scene.photographs.name(scene.lattice()[off.shot]).to_owned();
        let (level, level_sd) = (off.ln_level.exp(), off.ln_level.exp() * off.sd);
        let finding = ConsistencyWarning::ShotLight { shot, level, level_sd, places: off.places, shots: off.shots };
        warnings.push(finding.into());
        // A shadow on one shot is in what all others say of its place, too.
        return Ok(warnings);
    }
    if let Some(found) = steady_light::find(&pairs, &seen, &common) {
        let black = scene.photographs.one(|p| matches!(p, Pattern::SampleBlack))?;
        let at_mm = pairs.lit[found.row].map_or([0.0; 2], |lit| lit.at_mm);
        let finding = ConsistencyWarning::LightOnSample {
            shot: scene.photographs.name(black).to_owned(),
            at_px: scene.registration.view.camera_from_slab(at_mm),
            share: found.share,
            share_sd: found.sd,
            places: found.places,
        };
        warnings.push(finding.into());
    }
    Ok(warnings)
}

/// The shot whose rows are farthest off.
#[derive(Debug, Clone, Copy, PartialEq)]
struct OffShot {
    /// Its number in the sweep.
    shot: usize,
    /// ln of its light over what other shots say, and the standard deviation of that.
    ln_level: f64,
    sd: f64,
    /// In so many of so many places, where it is not the whole shot; those of a row are alike.
    places: Option<[usize; 2]>,
    /// How many shots are off.
    shots: usize,
}

/// A row: its shot's number in the sweep, and where it was lit.
#[derive(Clone, Copy)]
struct Lit {
    shot: usize,
    at_mm: Point,
}

/// Light that a row has in a place over what the row of that place has in its own.
#[derive(Debug, Clone, Copy)]
struct Ratio {
    ln_ratio: f64,
    /// Of the noise of both.
    sd: f64,
}

/// The rows that are compared with each other.
struct Compared {
    lit: Vec<Option<Lit>>,
    /// Rows whose places each row is asked for.
    asked: Vec<Vec<usize>>,
    /// Each row with the nearest one of the shot before.
    lag: Vec<[usize; 2]>,
    shots: usize,
    columns: usize,
    /// How far beside their places the dots of the capture are seen, mm: from below the surface of an oblique sample,
    /// or by an error of registration.
    offset_mm: Point,
    /// The part of it that light from depth makes.
    depth_mm: Point,
}

/// What a row says: its own peak, and the light in the places that it was asked for.
#[derive(Clone, Default)]
struct Seen {
    peak: f64,
    /// Row; light as far beside its place as dots are seen beside theirs, in its place, and so many times as far beside
    /// it as light from depth displaces a dot, up to [`FARTHEST`] where the window reaches.
    there: Vec<(usize, Vec<Light>)>,
}

impl Compared {
    fn of(scene: &Scene<'_>, results: &[ShotResult]) -> Self {
        let manifest = &scene.capture.manifest;
        let [nx, ny] = manifest.grid.points;
        let mut lit: Vec<Option<Lit>> = vec![None; nx * ny];
        for (shot, result) in results.iter().enumerate() {
            for l in &result.lit {
                lit[manifest.grid.row_index(l.dot)] = Some(Lit { shot, at_mm: l.center_mm });
            }
        }
        let mut asked: Vec<Vec<usize>> = vec![vec![]; nx * ny];
        let steps = steps(scene);
        for (k, own) in lit.iter().enumerate() {
            let Some(own) = own else { continue };
            for [dx, dy] in &steps {
                let to = [(k % nx) as isize + dx, (k / nx) as isize + dy];
                if to[0] < 0 || to[1] < 0 || to[0] >= nx as isize || to[1] >= ny as isize {
                    continue;
                }
                let other = to[1] as usize * nx + to[0] as usize;
                if lit[other].is_some_and(|o| o.shot != own.shot) {
                    asked[k].push(other);
                }
            }
        }
        let mut lag = Vec::new();
        for pair in results.windows(2) {
            for l in &pair[1].lit {
                let far = |p: Point| (p[0] - l.center_mm[0]).hypot(p[1] - l.center_mm[1]);
                let nearest = pair[0].lit.iter().min_by(|a, b| far(a.center_mm).total_cmp(&far(b.center_mm)));
                let Some(before) = nearest else { continue };
                let [own, other] = [l.dot, before.dot].map(|d| manifest.grid.row_index(d));
                if inside(&manifest.window, l.center_mm, before.center_mm) {
                    lag.push([own, other]);
                    for (a, b) in [(own, other), (other, own)] {
                        if !asked[a].contains(&b) {
                            asked[a].push(b);
                        }
                    }
                }
            }
        }
        let off = |a: usize| {
            let seen = results.iter().flat_map(|r| &r.seen);
            let mut all: Vec<f64> =
                seen.filter_map(|s| if let DotSeen::At { off_mm } = s { Some(off_mm[a]) } else { None }).collect();
            median(&mut all)
        };
        let mut pairs = Self {
            lit,
            asked,
            lag,
            shots: results.len(),
            columns: nx,
            offset_mm: [off(0), off(1)],
            depth_mm: [0.0; 2],
        };
        pairs.depth_mm = pairs.offset_of_depth(scene);
        pairs
    }

    fn look(&self, scene: &Scene<'_>, rows: &impl RowSink) -> Result<Vec<Seen>> {
        let window = &scene.capture.manifest.window;
        let look = |k: usize| {
            let Some(own) = self.lit[k].filter(|_| !self.asked[k].is_empty()) else { return Ok(Seen::default()) };
            let row = rows.row(k)?;
            let place = |&j: &usize| {
                let at = self.lit[j]?.at_mm;
                let beside = |times: f64, by: Point| [0, 1].map(|a| at[a] + times * by[a]);
                let light = |at: Point| light_at(&row, window, own.at_mm, at);
                let mut all = vec![light(beside(1.0, self.offset_mm))?, light(at)?];
                all.extend((1..=FARTHEST).map_while(|times| light(beside(times as f64, self.depth_mm))));
                Some((j, all))
            };
            let peak = light_at(&row, window, own.at_mm, own.at_mm).map_or(0.0, |l| l[0]);
            Ok(Seen { peak, there: self.asked[k].iter().filter_map(place).collect() })
        };
        (0..self.lit.len()).into_par_iter().map(look).collect()
    }

    /// For each row, ln of its light over that of the rows of other shots between the same places, without what is
    /// [`Self::common`].
    fn ratios(&self, seen: &[Seen], common: &Common) -> Vec<Vec<Ratio>> {
        let of_row = |k: usize| {
            let each = self.each_ratio(seen, k);
            each.filter_map(|(step, r)| Some(Ratio { ln_ratio: r.ln_ratio - common.get(&step)?, ..r })).collect()
        };
        (0..seen.len()).map(of_row).collect()
    }

    /// ln of what all pairs of a displacement have in common, which is no shot's: light from depth is seen beside its
    /// place.
    fn common(&self, seen: &[Seen]) -> Common {
        let mut alike: BTreeMap<[isize; 2], Vec<f64>> = BTreeMap::new();
        for (step, ratio) in (0..seen.len()).flat_map(|k| self.each_ratio(seen, k)) {
            alike.entry(step).or_default().push(ratio.ln_ratio);
        }
        alike.retain(|_, all| all.len() >= LEAST_VALUES);
        alike.into_iter().map(|(step, mut all)| (step, median(&mut all))).collect()
    }

    /// Light of row `k` over that of the rows of other shots between the same places, where both are beyond doubt.
    fn each_ratio<'a>(&'a self, seen: &'a [Seen], k: usize) -> impl Iterator<Item = ([isize; 2], Ratio)> + 'a {
        seen[k].there.iter().filter_map(move |(j, there)| {
            let ([light, variance], [back, back_variance]) = (there[0], of(&seen[*j], k)?[0]);
            let sd = (variance / (light * light) + back_variance / (back * back)).sqrt();
            let ratio = || Ratio { ln_ratio: (light / back).ln(), sd };
            (light.min(back) > SEEN_SIGMA * (variance + back_variance).sqrt()).then(|| (self.step(k, *j), ratio()))
        })
    }

    /// From one row to another, steps of the grid.
    fn step(&self, from: usize, to: usize) -> [isize; 2] {
        let place = |k: usize| [(k % self.columns) as isize, (k / self.columns) as isize];
        [place(to)[0] - place(from)[0], place(to)[1] - place(from)[1]]
    }

    /// Shots whose rows have another light than the rows of other shots say: all of them, some, or in some places.
    fn levels(&self, seen: &[Seen], common: &Common) -> Option<OffShot> {
        let rows = self.ratios(seen, common);
        let mut shots: Vec<Vec<Ratio>> = vec![vec![]; self.shots];
        let mut places = vec![0; self.shots];
        for (lit, ratios) in self.lit.iter().zip(&rows) {
            if let Some(lit) = lit {
                shots[lit.shot].extend(ratios);
                places[lit.shot] += ratios.len();
            }
        }
        let find =
            |(shot, [ln_level, sd]): (usize, [f64; 2]), places, shots| OffShot { shot, ln_level, sd, places, shots };
        let worst =
            |off: &[(usize, [f64; 2])]| off.iter().copied().max_by(|a, b| a.1[0].abs().total_cmp(&b.1[0].abs()));
        let whole = off_levels(&shots);
        if let Some(worst) = worst(&whole) {
            return Some(find(worst, None, whole.len()));
        }
        // A shadow on some dots of a shot.
        let single = off_levels(&rows);
        if let Some((row, level)) = worst(&single) {
            let of = |row: usize| self.lit[row].map(|lit| lit.shot);
            let shot = of(row)?;
            let off = single.iter().filter(|(row, _)| of(*row) == Some(shot)).map(|(row, _)| rows[*row].len()).sum();
            let mut shots: Vec<usize> = single.iter().filter_map(|(row, _)| of(*row)).collect();
            shots.sort_unstable();
            shots.dedup();
            return Some(find((shot, level), Some([off, places[shot]]), shots.len()));
        }
        let limit = LEAST_PLACE.max(SIGMA * scaled_deviation(shots.iter().flatten().map(|r| r.ln_ratio), 0.0));
        // Something in the way takes light from all of its places, or adds to all.
        let away = |ratios: &Vec<Ratio>| {
            let far = |r: &&Ratio| r.ln_ratio.abs() > limit.max(SIGMA * r.sd);
            let (more, less): (Vec<f64>, Vec<f64>) =
                ratios.iter().filter(far).map(|r| r.ln_ratio).partition(|r| *r > 0.0);
            if more.len() > less.len() { more } else { less }
        };
        let some: Vec<(usize, Vec<f64>)> = shots
            .iter()
            .map(away)
            .enumerate()
            .filter(|(k, away)| away.len() >= LEAST_PLACES && away.len() as f64 > PLACES_SHARE * places[*k] as f64)
            .collect();
        let (shot, away) = some.iter().max_by_key(|(_, away)| away.len())?;
        let middle = median(&mut away.clone());
        let places = [away.len(), places[*shot]];
        Some(find((*shot, [middle, sd_of_median(away, middle)]), Some(places), some.len()))
    }
}

/// Of groups of ratios those whose median, ln, is off beyond what it is known to and what groups differ by; with its
/// standard deviation.
fn off_levels(groups: &[Vec<Ratio>]) -> Vec<(usize, [f64; 2])> {
    let level = |ratios: &Vec<Ratio>| {
        let mut all: Vec<f64> = ratios.iter().map(|r| r.ln_ratio).collect();
        let middle = median(&mut all);
        (all.len() >= 3).then(|| [middle, sd_of_median(&all, middle)])
    };
    let levels: Vec<Option<[f64; 2]>> = groups.iter().map(level).collect();
    let usual = scaled_deviation(levels.iter().flatten().map(|l| l[0]), 0.0);
    let off = |l: &[f64; 2]| l[0].abs() > LEAST_LEVEL.max(SIGMA * usual).max(SIGMA * l[1]);
    levels.iter().enumerate().filter_map(|(k, l)| Some((k, (*l).filter(off)?))).collect()
}

/// Standard deviation of the median of some values.
fn sd_of_median(values: &[f64], median: f64) -> f64 {
    1.25 * scaled_deviation(values.iter().copied(), median) / (values.len() as f64).sqrt()
}

/// What a row says of the place of row `k`.
fn of(seen: &Seen, k: usize) -> Option<&[Light]> {
    seen.there.iter().find(|(j, _)| *j == k).map(|(_, light)| light.as_slice())
}

/// Steps of the grid, in sixteen directions, to the nearest point that is beyond a dot's edge, to the farthest in the
/// window, and half way; and to the points in its corners, where there is the least light.
fn steps(scene: &Scene<'_>) -> Vec<[isize; 2]> {
    let window = &scene.capture.manifest.window;
    let step_mm = scene.steps_mm();
    let least_mm = LEAST_RADII * scene.dot_radius_px() / scene.px_per_mm;
    let half_mm = window.samples.map(|n| 0.5 * n as f64 * window.pitch_mm);
    let way = |step: [isize; 2]| [0, 1].map(|a| step[0] as f64 * step_mm[0][a] + step[1] as f64 * step_mm[1][a]);
    let is_between = |step: [isize; 2]| {
        let way = way(step);
        way[0].hypot(way[1]) >= least_mm && (0..2).all(|a| way[a].abs() <= half_mm[a])
    };
    let mut steps: Vec<[isize; 2]> = Vec::new();
    for u in -2isize..=2 {
        for v in -2isize..=2 {
            // Directions, each once.
            if u % 2 == 0 && v % 2 == 0 {
                continue;
            }
            let along = |k: &isize| is_between([u * k, v * k]);
            let all: Vec<isize> = (1..=MOST_STEPS).skip_while(|k| !along(k)).take_while(along).collect();
            let some = [all.first(), all.get(all.len() / 2), all.last()];
            steps.extend(some.into_iter().flatten().map(|k| [u * k, v * k]));
        }
    }
    let most = [0, 1].map(|a| {
        (0..=MOST_STEPS)
            .take_while(|k| {
                let only = if a == 0 { [*k, 0] } else { [0, *k] };
                (0..2).all(|b| way(only)[b].abs() <= half_mm[b])
            })
            .last()
            .unwrap_or(0)
    });
    for [u, v] in [[1, 1], [1, -1], [-1, 1], [-1, -1]] {
        let corner = |[i, j]: [isize; 2]| is_between([u * i, v * j]).then_some([u * i, v * j]);
        let far = |step: &[isize; 2]| way(*step)[0].hypot(way(*step)[1]);
        // The grid may be turned against the window: a step less along either.
        let near =
            (0..3).flat_map(|i| (0..3).map(move |j| [most[0] - i, most[1] - j])).filter(|s| s[0] > 0 && s[1] > 0);
        steps.extend(near.filter_map(corner).max_by(|a, b| far(a).total_cmp(&far(b))));
    }
    steps.sort_unstable();
    steps.dedup();
    steps
}

/// Whether a place lies within a window.
fn inside(window: &Window, center_mm: Point, at_mm: Point) -> bool {
    (0..2).all(|a| (at_mm[a] - center_mm[a]).abs() <= 0.5 * window.samples[a] as f64 * window.pitch_mm)
}

/// Light of a row in a place: the sum of the channels, linear between cells. `None` outside and beside cells that were
/// not measured.
fn light_at(row: &Row, window: &Window, center_mm: Point, at_mm: Point) -> Option<Light> {
    let [nx, ny] = window.samples;
    let u: Point = std::array::from_fn(|a| {
        let last = (window.samples[a] - 1) as f64;
        ((at_mm[a] - center_mm[a]) / window.pitch_mm + 0.5 * last).clamp(0.0, last)
    });
    if !inside(window, center_mm, at_mm) {
        return None;
    }
    let low = [0, 1].map(|a| (u[a].floor() as usize).min([nx, ny][a].saturating_sub(2)));
    let part = [0, 1].map(|a| u[a] - low[a] as f64);
    let (mut light, mut variance) = (0.0, 0.0);
    for (i, j) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
        let weight = [i, j].iter().zip(part).map(|(&k, p)| if k == 1 { p } else { 1.0 - p }).product::<f64>();
        if weight == 0.0 {
            continue;
        }
        let k = (low[1] + j) * nx + low[0] + i;
        for c in 3 * k..3 * k + 3 {
            row.valid[c].then_some(())?;
            light += weight * f64::from(row.response[c]);
            variance += weight * weight * f64::from(row.variance[c]);
        }
    }
    Some([light, variance])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Seven by five points, one a shot, each asked for those within 3.5 mm.
    fn pairs() -> Compared {
        let [nx, ny] = [7, 5];
        let at = |k: usize| [(k % nx) as f64, 1.2 * (k / nx) as f64];
        let lit = (0..nx * ny).map(|k| Some(Lit { shot: k, at_mm: at(k) })).collect();
        let far = |a: usize, b: usize| (at(a)[0] - at(b)[0]).hypot(at(a)[1] - at(b)[1]);
        let asked = (0..nx * ny).map(|k| (0..nx * ny).filter(|&j| j != k && far(k, j) < 3.5).collect()).collect();
        let lag = (1..nx * ny).map(|k| [k, k - 1]).filter(|[a, b]| far(*a, *b) < 3.5).collect();
        Compared { lit, asked, lag, shots: nx * ny, columns: nx, offset_mm: [0.0; 2], depth_mm: [0.0; 2] }
    }

    /// What rows say: exp(−distance), times what `place` says of row k in the place of row j.
    fn seen(pairs: &Compared, place: impl Fn(usize, usize) -> f64) -> Vec<Seen> {
        let at = |k: usize| pairs.lit[k].unwrap().at_mm;
        let light = |k: usize, j: usize| {
            let d = [at(j)[0] - at(k)[0], at(j)[1] - at(k)[1]];
            // More to one side than to the other, as of light from depth; a little that is each pair's own.
            let lean = 1.0 - 0.1 * d[0] / d[0].hypot(d[1]);
            place(k, j) * lean * (-d[0].hypot(d[1])).exp() * (1.0 + 0.01 * ((7 * k + 3 * j) as f64).sin())
        };
        let there = |k: usize| {
            // Displaced by as much as dots are seen beside their places, there is no lean.
            let far = |j: usize| (at(j)[0] - at(k)[0]) / (at(j)[0] - at(k)[0]).hypot(at(j)[1] - at(k)[1]);
            let straight = |j: usize| light(k, j) / (1.0 - 0.1 * far(j));
            let both = |j: usize| [straight(j), light(k, j), straight(j)].map(|light| [light, 1e-9]).to_vec();
            pairs.asked[k].iter().map(|&j| (j, both(j))).collect()
        };
        (0..pairs.lit.len()).map(|k| Seen { peak: 1.5, there: there(k) }).collect()
    }

    fn levels(pairs: &Compared, seen: &[Seen]) -> Option<OffShot> {
        pairs.levels(seen, &pairs.common(seen))
    }

    fn steady(pairs: &Compared, seen: &[Seen]) -> Option<steady_light::SteadyLight> {
        steady_light::find(pairs, seen, &pairs.common(seen))
    }

    #[test]
    fn a_shot_under_less_light_is_named_with_its_level_and_a_sample_that_leans_to_one_side_is_not() {
        let pairs = pairs();
        assert_eq!(levels(&pairs, &seen(&pairs, |_, _| 1.0)), None);
        for (shot, level) in [(0, 0.5), (16, 0.6), (34, 1.7)] {
            let found = levels(&pairs, &seen(&pairs, |k, _| if k == shot { level } else { 1.0 })).unwrap();
            assert_eq!((found.shot, found.places, found.shots), (shot, None, 1));
            // The pairs' own per cent, and the median over a neighbour or two of what is alike.
            assert!((found.ln_level.exp() / level - 1.0).abs() < 0.02, "{found:?}");
        }
        // A twentieth is within what boundaries of media do.
        assert_eq!(levels(&pairs, &seen(&pairs, |k, _| if k == 9 { 0.95 } else { 1.0 })), None);
    }

    #[test]
    fn a_shadow_on_some_places_of_a_shot_is_that_of_the_shot() {
        let pairs = pairs();
        let shadow = |k: usize, j: usize| if k == 17 && j > 17 && j % 7 > 2 { 0.4 } else { 1.0 };
        let found = levels(&pairs, &seen(&pairs, shadow)).unwrap();
        let places = pairs.asked[17].iter().filter(|&&j| shadow(17, j) < 1.0).count();
        assert_eq!((found.shot, found.places, found.shots), (17, Some([places, pairs.asked[17].len()]), 1));
        assert!((found.ln_level.exp() / 0.4 - 1.0).abs() < 0.03, "{found:?}");
    }

    #[test]
    fn a_shadow_on_one_dot_of_a_shot_that_has_more_is_that_of_the_shot() {
        let mut pairs = pairs();
        // Seven shots, of a column each.
        pairs.lit.iter_mut().enumerate().for_each(|(k, lit)| lit.as_mut().unwrap().shot = k % 7);
        pairs.shots = 7;
        let lit = pairs.lit.clone();
        let apart = |a: usize, b: usize| lit[a].unwrap().shot != lit[b].unwrap().shot;
        pairs.asked.iter_mut().enumerate().for_each(|(k, asked)| asked.retain(|&j| apart(k, j)));
        assert_eq!(levels(&pairs, &seen(&pairs, |_, _| 1.0)), None);
        let found = levels(&pairs, &seen(&pairs, |k, _| if k == 17 { 0.5 } else { 1.0 })).unwrap();
        let all = (0..35).filter(|k| k % 7 == 3).map(|k| pairs.asked[k].len()).sum();
        assert_eq!((found.shot, found.places, found.shots), (3, Some([pairs.asked[17].len(), all]), 1));
        assert!((found.ln_level.exp() / 0.5 - 1.0).abs() < 0.03, "{found:?}");
    }

    #[test]
    fn light_that_all_shots_have_in_one_place_is_that_of_the_place_and_neither_a_level_nor_a_shadow_is() {
        let pairs = pairs();
        let lit = |light: f64, places: &[usize]| {
            let mut seen = seen(&pairs, |_, _| 1.0);
            let all = seen.iter_mut().flat_map(|s| &mut s.there).filter(|(j, _)| places.contains(j));
            all.for_each(|(_, there)| there.iter_mut().for_each(|l| l[0] += 1.5 * light));
            steady(&pairs, &seen)
        };
        assert_eq!(lit(0.0, &[]), None);
        for places in [&[17][..], &[3, 4, 10], &[0]] {
            let found = lit(0.05, places).unwrap();
            assert!(places.contains(&found.row) && found.places == places.len(), "{found:?}");
            // The pairs' own per cent of light that is up to a fifth of the peak.
            assert!((found.share - 0.05).abs() < 0.004 && found.sd < 0.004, "{found:?}");
        }
        for (shot, level) in [(0, 0.5), (16, 0.6), (34, 1.7)] {
            let seen = seen(&pairs, |k, _| if k == shot { level } else { 1.0 });
            assert_eq!(steady(&pairs, &seen), None);
        }
        let shadow = |k: usize, j: usize| if k == 17 && j > 17 && j % 7 > 2 { 0.4 } else { 1.0 };
        assert_eq!(steady(&pairs, &seen(&pairs, shadow)), None);
    }

    #[test]
    fn what_is_left_of_the_pattern_before_is_its_share() {
        let pairs = pairs();
        let lag = |share: f64| {
            let mut seen = seen(&pairs, |_, _| 1.0);
            for [own, before] in &pairs.lag {
                let (_, there) = seen[*own].there.iter_mut().find(|(j, _)| j == before).unwrap();
                there.iter_mut().for_each(|light| light[0] += 1.5 * share);
            }
            pairs.lag(&seen)
        };
        assert_eq!(lag(0.0), None);
        let Some(ConsistencyWarning::PatternRemains { share, sd, .. }) = lag(0.1) else { panic!("a tenth is found") };
        // The pairs' own per cent.
        assert!((share - 0.1).abs() < 0.01 && sd < 0.005, "{share} ± {sd}");
    }

    #[test]
    fn light_in_a_place_is_linear_between_cells_and_nothing_beside_what_was_not_measured() {
        let window = Window { samples: [3, 5], pitch_mm: 0.5 };
        let value = |k: usize| (1 + k) as f32;
        let mut row = Row {
            response: (0..15).flat_map(|k| [value(k); 3]).collect(),
            variance: vec![4.0; 45],
            valid: vec![true; 45],
        };
        let light = |row: &Row, at: Point| light_at(row, &window, [10.0, 20.0], at);
        // The middle cell, the seventh, in three channels.
        assert_eq!(light(&row, [10.0, 20.0]), Some([24.0, 12.0]));
        // Half way to the right, a quarter down: 8 + 0.5 + 0.25 · 3; weights 3/8 and 1/8 twice.
        let [found, variance] = light(&row, [10.25, 20.125]).unwrap();
        assert!((found - 3.0 * 9.25).abs() < 1e-9 && (variance - 12.0 * 2.0 * (9.0 + 1.0) / 64.0).abs() < 1e-9);
        // The outermost half cell is as bright as its cell, beyond there is nothing.
        assert_eq!(light(&row, [10.7, 20.0]).unwrap()[0], 27.0);
        assert_eq!(light(&row, [10.8, 20.0]), None);
        row.valid[3 * 8] = false;
        assert_eq!(light(&row, [10.25, 20.125]), None);
        assert!(light(&row, [10.0, 20.125]).is_some());
    }
}
