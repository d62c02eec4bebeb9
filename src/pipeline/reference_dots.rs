//! What the reference dots on the opaque frame tell of each lattice shot: the lamp's level and colour, a dot that is
//! covered, how sharp they are.

use super::BuildOptions;
use super::scene::{STILL, Scene};
use crate::capture::{Pattern, Rect};
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance};
use crate::registration::{PointSpread, measure_drift, median, scaled_deviation};
use crate::{ConsistencyWarning, Result, Warning};

/// The light of the reference dots, over some shots.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Level {
    /// Mean light of each dot and channel; `None` where it was not measured.
    mean: Vec<Option<f64>>,
    /// Variance of a shot's level about the mean, beyond that of its measurement.
    pub(super) variance: f64,
    /// Variance of the mean itself.
    mean_variance: f64,
    /// The last shots' light over the first ones', where the lamp changes over the sweep; the mean is that of the first
    /// then.
    pub(super) drift: Option<f64>,
}

/// Light of each reference dot and channel in one shot with its variance, `None` where no exposure measured it.
pub(super) type DotLight = Vec<Option<[f64; 2]>>;

/// What the reference dots of a shot show besides the lamp's level.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct DotsShow {
    /// How many of them have another light than the others say.
    pub strange: usize,
    /// Light of R, G, B over that of most shots, where the channels differ.
    pub colour: Option<[f64; 3]>,
    /// Mean square distance of their light from their middle, px².
    pub spread_px2: Option<f64>,
}

/// A shot's light that is off by more standard deviations than this of what shots differ by, and by this share, is
/// another level of the lamp.
const LAMP_SIGMA: f64 = 6.0;
const LEAST_LAMP: f64 = 0.01;

/// A reference dot that is off by more than this share and by `LAMP_SIGMA` from what the others of its shot say is
/// covered, or dirty.
const STRANGE_DOT: f64 = 0.1;
/// Channels that differ by more than this share and by `LAMP_SIGMA` are of another white balance or order.
const LEAST_COLOUR: f64 = 0.03;

/// What is taken out of a shot.
pub(super) struct Scale {
    pub(super) log_level: f64,
    /// Variance that remains.
    pub(super) variance: f64,
    /// Whether it is another level of the lamp, and no flicker.
    pub(super) is_lamp: bool,
}

impl Level {
    /// Medians over shots, so that a few that were lit otherwise do not count. `None` with fewer than four shots.
    ///
    /// `is_steady`: a change over the sweep is the lamp's.
    pub(super) fn of(lights: &[DotLight], is_steady: bool) -> Option<Self> {
        let shots = lights.len();
        let mean: Vec<Option<f64>> = (0..lights.first()?.len())
            .map(|k| {
                let mut all: Vec<f64> = lights.iter().filter_map(|l| l[k]).map(|[light, _]| light).collect();
                // A dot that some shots do not measure would give them another mean.
                (all.len() == shots).then(|| median(&mut all)).filter(|m| *m > 0.0)
            })
            .collect();
        let mut level = Self { mean, variance: 0.0, mean_variance: 0.0, drift: None };
        let found: Vec<(f64, f64)> = lights.iter().filter_map(|l| level.measured(l)).collect();
        if found.len() < 4 {
            return None;
        }
        // A lamp that warms up or steps: the references were taken beside the first shots.
        let levels: Vec<f64> = found.iter().map(|f| f.0).collect();
        let [first, last] = ends(&levels);
        let (rough, steady) = (change_within(&levels), 1.0 + first);
        if is_steady && (last - first).abs() > LEAST_LAMP.max(LAMP_SIGMA * rough) && steady > 0.0 {
            level.mean.iter_mut().flatten().for_each(|m| *m *= steady);
            // All that shots differ by is the lamp's.
            (level.variance, level.mean_variance) = ((last - first).powi(2).max(1e-4), rough * rough);
            level.drift = Some((1.0 + last) / steady);
            return Some(level);
        }
        let scale = scaled_deviation(found.iter().map(|f| f.0), 0.0);
        let noise = found.iter().map(|(_, variance)| variance).sum::<f64>() / found.len() as f64;
        let usual = LAMP_SIGMA * scale.max(noise.sqrt());
        let kept: Vec<f64> = found.iter().map(|f| f.0).filter(|l| l.abs() <= usual).collect();
        let n = kept.len() as f64;
        let spread = kept.iter().map(|level| level * level).sum::<f64>() / (n - 1.0);
        // Significant: the spread of n shots is known to √(2/n) of itself.
        let excess = spread - noise;
        level.variance = if excess > 3.0 * noise * (2.0 / n).sqrt() { excess } else { 0.0 };
        level.mean_variance = spread / n;
        Some(level)
    }

    /// Mean light of each dot and channel.
    pub(super) fn mean_light(&self) -> &[Option<f64>] {
        &self.mean
    }

    /// From now on levels are over the light that the references say, of which the mean is `level` times, known to a
    /// relative standard deviation of `relative_sd`.
    pub(super) fn anchor(&mut self, level: f64, relative_sd: f64) {
        self.mean.iter_mut().flatten().for_each(|m| *m /= level);
        self.mean_variance += relative_sd * relative_sd;
    }

    /// A shot's light over the mean less one, and its variance; dots that the others contradict do not count.
    fn measured(&self, light: &DotLight) -> Option<(f64, f64)> {
        let all = self.ratios(light);
        let middle = median(&mut all.iter().flatten().map(|r| r.0).collect::<Vec<_>>());
        mean(all.into_iter().flatten().filter(|r| !is_strange(*r, middle)))
    }

    /// Light of each dot and channel over the mean less one with its variance, `None` where it was not measured.
    fn ratios(&self, light: &DotLight) -> Vec<Option<(f64, f64)>> {
        let ratio = |(mean, light): (&Option<f64>, &Option<[f64; 2]>)| {
            let (mean, [light, variance]) = ((*mean)?, (*light)?);
            Some((light / mean - 1.0, variance.max(1e-12 * mean * mean) / (mean * mean)))
        };
        self.mean.iter().zip(light).map(ratio).collect()
    }

    /// How many dots are off from what the others of the shot say, in all channels that were measured.
    pub(super) fn strange(&self, light: &DotLight) -> usize {
        let all = self.ratios(light);
        let middle = median(&mut all.iter().flatten().map(|r| r.0).collect::<Vec<_>>());
        let off = |dot: &&[Option<(f64, f64)>]| {
            dot.iter().any(Option::is_some) && dot.iter().flatten().all(|r| is_strange(*r, middle))
        };
        all.chunks(3).filter(off).count()
    }

    /// Light of the channels over the mean, where they differ.
    pub(super) fn colour(&self, light: &DotLight) -> Option<[f64; 3]> {
        let all = self.ratios(light);
        let middle = |c: usize| median(&mut all.iter().skip(c).step_by(3).flatten().map(|r| r.0).collect::<Vec<_>>());
        let channel = |c: usize| {
            let own = all.iter().skip(c).step_by(3).flatten().copied();
            mean(own.filter(|r| !is_strange(*r, middle(c))))
        };
        let [r, g, b] = [channel(0)?, channel(1)?, channel(2)?];
        let differ =
            |a: (f64, f64), b: (f64, f64)| (a.0 - b.0).abs() > LEAST_COLOUR.max(LAMP_SIGMA * (a.1 + b.1).sqrt());
        (differ(r, g) || differ(g, b) || differ(r, b)).then_some([1.0 + r.0, 1.0 + g.0, 1.0 + b.0])
    }

    /// What is taken out of a shot: its whole level where that is more than shots usually differ by, else the level
    /// drawn towards zero; `None` for a capture whose shots do not differ.
    pub(super) fn scale_of(&self, light: &DotLight) -> Option<Scale> {
        let (level, variance) = self.measured(light)?;
        let usual = (self.variance + variance + self.mean_variance).sqrt();
        if self.drift.is_none() && level.abs() > (LAMP_SIGMA * usual).max(LEAST_LAMP) && level > -1.0 {
            return Some(Scale { log_level: level.ln_1p(), variance: variance + self.mean_variance, is_lamp: true });
        }
        if self.variance == 0.0 {
            return None;
        }
        let share = self.variance / (self.variance + variance);
        Some(Scale { log_level: share * level, variance: share * variance + self.mean_variance, is_lamp: false })
    }
}

/// Whether the light of a dot differs from that of the others of its shot.
fn is_strange((ratio, variance): (f64, f64), middle: f64) -> bool {
    (ratio - middle).abs() > (STRANGE_DOT * (1.0 + middle)).max(LAMP_SIGMA * variance.sqrt())
}

/// Mean by inverse variances, and its variance; `None` for nothing.
fn mean(ratios: impl Iterator<Item = (f64, f64)>) -> Option<(f64, f64)> {
    let (top, bottom) = ratios.fold((0.0, 0.0), |(top, bottom), (r, v)| (top + r / v, bottom + 1.0 / v));
    (bottom > 0.0).then(|| (top / bottom, 1.0 / bottom))
}

/// The reference dots of a shot, where the drift has put them.
pub(super) struct SeenDots {
    pub(super) light: DotLight,
    /// Mean square distance of the light from their middles, px².
    pub(super) spread_px2: Option<f64>,
    /// How far apart they are, of what they should be.
    scale: Option<f64>,
}

impl SeenDots {
    /// Whether dots were as sharp and as far apart in the last shots as in the first: else the light around their
    /// middles changes, too.
    pub(super) fn are_steady(shots: &[Self]) -> bool {
        let steady = |of: &dyn Fn(&Self) -> Option<f64>, least: f64| {
            let all: Vec<f64> = shots.iter().filter_map(of).collect();
            let [first, last] = ends(&all);
            all.len() < 4 || (last / first - 1.0).abs() < least.max(LAMP_SIGMA * change_within(&all) / first)
        };
        steady(&|s| s.spread_px2, WIDER) && steady(&|s| s.scale, LEAST_SCALE)
    }
}

/// Dots whose mean square width is off by this share are of another focus.
pub(super) const WIDER: f64 = 0.2;
/// Dots that are farther apart by this share are seen through another zoom: far beyond what centroids of dots some ten
/// pixels apart say.
pub(super) const LEAST_SCALE: f64 = 0.003;

/// Medians of the first and of the last third of a sweep; 0 for none.
pub(super) fn ends(values: &[f64]) -> [f64; 2] {
    let third = (values.len() / 3).max(1).min(values.len());
    [&values[..third], &values[values.len() - third..]].map(|part| median(&mut part.to_vec()))
}

/// How far values differ from the one before, as a standard deviation of each: what a slow change does not make.
pub(super) fn change_within(values: &[f64]) -> f64 {
    scaled_deviation(values.windows(2).map(|w| w[1] - w[0]), 0.0) / 2f64.sqrt()
}

/// The reference dots of a shot; `None` where they are not found.
pub(super) fn reference_light(scene: &Scene<'_>, seen: &[Bracket]) -> Option<SeenDots> {
    let pictures: Vec<(Point, Radiance)> =
        scene.reference_mm().into_iter().zip(seen).map(|(p, b)| (p, scene.picture(b, b.rect(), STILL))).collect();
    let drift = measure_drift(&pictures, scene.registration, scene.dot_radius_px())?;
    let moved = drift.slab_mm;
    let reach = reach_px(scene);
    let at = |p: Point| scene.registration.view.camera_from_slab([p[0] + moved[0], p[1] + moved[1]]);
    let placed: Vec<(Point, &Radiance)> = pictures.iter().map(|(p, picture)| (at(*p), picture)).collect();
    let mut spreads: Vec<f64> = placed.iter().filter_map(|&(at, picture)| spread_around(picture, at, reach)).collect();
    let spread_px2 = (2 * spreads.len() > pictures.len()).then(|| median(&mut spreads));
    let light = placed.iter().flat_map(|&(at, picture)| light_around(scene, picture, at, reach)).collect();
    Some(SeenDots { light, spread_px2, scale: drift.scale.map(|s| s[0]) })
}

/// Reference dots have this share of the width at the least that the board's blur and their own size give them
/// (untouched ones 0.98 at blurs up to 2 px).
const BOARD_WIDTH: f64 = 0.75;

/// Whether the board is blurred more than the reference dots, whose mean square width is `width_px2`: the blur that is
/// taken out of the rows is the board's.
///
/// # Errors
/// [`crate::Error::Contradiction`].
pub(super) fn board_blur(scene: &Scene<'_>, width_px2: f64, options: &BuildOptions) -> Result<Option<Warning>> {
    let Some(PointSpread { psf_px, .. }) = scene.registration.point_spread else { return Ok(None) };
    // Of a square of that side; as if they were a projector pixel smaller than stated, which may be wrong.
    let pixels = scene.capture.manifest.grid.dot_projector_px as f64;
    let side_px = scene.dot_side_px() * (1.0 - 1.0 / pixels);
    let sharp_px2 = side_px * side_px / 6.0;
    if width_px2 > BOARD_WIDTH * (sharp_px2 + gaussian_width(psf_px, reach_px(scene))) {
        return Ok(None);
    }
    let shot = scene.photographs.one(|p| matches!(p, Pattern::Board))?;
    let shot = scene.photographs.name(shot).to_owned();
    let dots_psf_px = (0.5 * (width_px2 - sharp_px2).max(0.0)).sqrt();
    options.refuse(ConsistencyWarning::BoardBlur { shot, psf_px, dots_psf_px }).map(Some)
}

/// Half the side of the square in which a reference dot's light is measured, px.
pub(super) fn reach_px(scene: &Scene<'_>) -> f64 {
    scene.dot_radius_px() + 2.0
}

/// Mean square distance from its middle of a Gaussian's light within `reach`, px².
fn gaussian_width(sd_px: f64, reach: f64) -> f64 {
    let u = 0.5 * (reach / sd_px.max(1e-6)).powi(2);
    // e^−u / (1 − e^−u), which is 0 for sharp pictures.
    2.0 * sd_px * sd_px * (1.0 - u / u.exp_m1())
}

/// Mean square distance of the light within `reach` of a dot's middle from it, px²; `None` where some of it was not
/// measured.
fn spread_around(picture: &Radiance, at: Point, reach: f64) -> Option<f64> {
    let Rect { x, y, width, .. } = picture.rect;
    let light = picture.luminance();
    let (mut sum, mut square) = (0.0, 0.0);
    for (k, (v, used)) in light.iter().zip(picture.used.as_chunks::<3>().0).enumerate() {
        let r = ((x + k % width) as f64 - at[0]).hypot((y + k / width) as f64 - at[1]);
        if r <= reach {
            if used.contains(&0) {
                return None;
            }
            (sum, square) = (sum + f64::from(*v), square + f64::from(*v) * r * r);
        }
    }
    (sum > 0.0).then(|| square / sum)
}

/// Light within a square of half side `reach`, its border pixels by their share, so that it does not jump when a dot
/// moves.
fn light_around(scene: &Scene<'_>, picture: &Radiance, at: Point, reach: f64) -> [Option<[f64; 2]>; 3] {
    let Rect { x, y, width, height } = picture.rect;
    let mut sum = [Some([0.0; 2]); 3];
    let share = |pixel: usize, center: f64| (reach + 0.5 - (pixel as f64 - center).abs()).clamp(0.0, 1.0);
    let inside = |a: usize, first: usize, size: usize| {
        at[a] - reach >= first as f64 && at[a] + reach <= (first + size - 1) as f64
    };
    if !inside(0, x, width) || !inside(1, y, height) {
        return [None; 3];
    }
    for py in y..y + height {
        for px in x..x + width {
            let share = share(px, at[0]) * share(py, at[1]);
            if share == 0.0 {
                continue;
            }
            let weight = share * f64::from(scene.references.irradiance.sensitivity().inverse_at(px, py));
            let k = picture.at(px, py);
            for (c, sum) in sum.iter_mut().enumerate() {
                *sum = sum.filter(|_| picture.used[k + c] > 0).map(|[light, variance]| {
                    let value = f64::from(picture.value[k + c]);
                    [light + weight * value, variance + weight * weight * f64::from(picture.variance[k + c])]
                });
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two dots in three channels, one of them not measured in green, at `level` of their mean.
    fn light(level: f64, variance: f64) -> DotLight {
        let of = |mean: f64| Some([mean * (1.0 + level), variance * mean * mean]);
        vec![of(100.0), of(250.0), of(40.0), of(900.0), None, of(60.0)]
    }

    #[test]
    fn a_shots_level_is_the_mean_over_dots_and_channels_by_their_relative_variances() {
        let mean = vec![Some(100.0), Some(200.0), None, Some(10.0)];
        let level = Level { mean, variance: 4e-4, mean_variance: 1e-5, drift: None };
        // Relative: 0.02 ± 0.01, 0.05 ± 0.02; the third has no mean, the last no light.
        let seen = vec![Some([102.0, 1.0]), Some([210.0, 16.0]), Some([7.0, 1e-9]), None];
        let (weights, total) = ([1e4, 2500.0], 12_500.0);
        let expected = (weights[0] * 0.02 + weights[1] * 0.05) / total;
        let (found, variance) = level.measured(&seen).unwrap();
        // f64.
        assert!((found - expected).abs() < 1e-12 && (variance * total - 1.0).abs() < 1e-12, "{found} {variance}");
        // Drawn towards none by its own variance of 8e-5 against that of shots, 4e-4.
        let found = level.scale_of(&seen).unwrap();
        let share = 4e-4 / (4e-4 + 8e-5);
        assert!((found.log_level - share * expected).abs() < 1e-12 && !found.is_lamp);
        assert!((found.variance - (share * 8e-5 + 1e-5)).abs() < 1e-12);
        assert!(level.measured(&vec![None; 4]).is_none());
        // A light without any noise does not rule alone for ever: 1e-12 of itself is left to it.
        let (_, variance) = level.measured(&vec![Some([100.0, 0.0]), None, None, None]).unwrap();
        assert!((variance - 1e-12).abs() < 1e-18);
    }

    #[test]
    fn an_anchored_level_is_over_the_light_of_the_references() {
        let mut level = Level::of(&[0.0, 0.01, -0.01, 0.0].map(|l| light(l, 5e-5)), true).unwrap();
        let before = level.mean_variance;
        // The dots of these shots have four fifths of the light that the references say: a quarter more is as these
        // have it.
        level.anchor(0.8, 0.01);
        assert!(level.measured(&light(0.25, 5e-5)).unwrap().0.abs() < 1e-9);
        assert!((level.measured(&light(0.0, 5e-5)).unwrap().0 + 0.2).abs() < 1e-9);
        assert!((level.mean_variance - before - 1e-4).abs() < 1e-12);
    }

    #[test]
    fn the_level_of_shots_varies_by_what_their_measurement_does_not_explain() {
        let levels = [0.03, -0.01, 0.02, -0.04, 0.01, -0.01];
        let level = Level::of(&levels.map(|l| light(l, 5e-5)), true).unwrap();
        let expected = [Some(100.0), Some(250.0), Some(40.0), Some(900.0), None, Some(60.0)];
        for (found, expected) in level.mean.iter().zip(expected) {
            assert_eq!(found.is_some(), expected.is_some());
            // The levels add up to none.
            assert!(found.zip(expected).is_none_or(|(f, e)| (f / e - 1.0).abs() < 1e-9));
        }
        // Σ level² / 5, less a fifth (five lights of one shot) of their variance; a sixth of the spread is the mean's.
        let spread = (9.0 + 1.0 + 4.0 + 16.0 + 1.0 + 1.0) * 1e-4 / 5.0;
        assert!((level.variance - (spread - 1e-5)).abs() < 1e-9, "{}", level.variance);
        assert!((level.mean_variance - spread / 6.0).abs() < 1e-9);
        // Noise that explains it: 6.4e-4 against 2e-4 and 3 · 2e-4 · √(2/6).
        assert_eq!(Level::of(&levels.map(|l| light(l, 1.5e-3)), true).unwrap().variance, 0.0);
        assert!(Level::of(&levels.map(|l| light(l, 1.0e-3)), true).unwrap().variance > 0.0);
        // Too few shots, and none.
        assert!(Level::of(&levels.map(|l| light(l, 5e-5))[..3], true).is_none());
        assert!(Level::of(&[], true).is_none());
    }

    #[test]
    fn the_width_of_a_gaussian_within_a_reach_is_that_of_its_pixels() {
        for (sd, reach) in [(2.0, 3.4), (0.8, 3.0), (1.5, 20.0), (5.0, 2.0)] {
            // A hundredth of a px is fine enough for a per cent.
            let cells = |r: f64| (-1000..1000).map(move |k| (k as f64 + 0.5) * r / 1000.0);
            let (mut sum, mut square) = (0.0, 0.0);
            for (x, y) in cells(reach).flat_map(|x| cells(reach).map(move |y| (x, y))) {
                let r2: f64 = x * x + y * y;
                if r2 <= reach * reach {
                    let light = (-0.5 * r2 / (sd * sd)).exp();
                    (sum, square) = (sum + light, square + light * r2);
                }
            }
            let found = gaussian_width(sd, reach);
            assert!((found / (square / sum) - 1.0).abs() < 0.01, "{sd} {reach}: {found}");
        }
        assert!(gaussian_width(0.0, 3.0).abs() < 1e-9);
    }
}
