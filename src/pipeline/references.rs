//! The shots that every lattice shot is measured against: black, and the white reference.

use super::BuildOptions;
use super::lamp::LampBetween;
use super::lattice_light::{FrameShare, frame_shares};
use super::looks::shown_shot;
use super::photographs::Photographs;
use super::register::{Registered, SUM_STEP};
use super::scene::on_slab;
use crate::capture::Pattern;
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{HotPixel, Radiance, find_hot_pixels, mend};
use crate::registration::{Registration, median};
use crate::response::Irradiance;
use crate::warning::bounds::{BRIGHTEST_BLACK, COVERED, REFUSED_LEVEL, UNEVEN_SHARE};
use crate::{ConsistencyWarning, Error, Result, Warning};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Pixels this bright, of the brightest, are lit.
const LIT_SHARE: f32 = 0.3;

/// Ambient light and irradiance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct References {
    /// What the camera sees of the sample without dots.
    pub ambient: Radiance,
    pub hot: Vec<HotPixel>,
    pub irradiance: Irradiance,
    /// Relative variance of the white reference's light that flicker leaves, when it was measured.
    pub white_variance: Option<f64>,
    /// From a second white reference.
    pub lamp: Option<LampBetween>,
    /// At each reference dot.
    pub frame_share: Vec<FrameShare>,
    pub warnings: Vec<Warning>,
}

/// The level of the white reference over that of the Gray code is told when it is off by more than this and by so many
/// of its standard deviations, and refused from [`REFUSED_LEVEL`] on.
const LEAST_LEVEL: f64 = 0.01;
const LEVEL_SIGMA: f64 = 6.0;
/// A pixel of the sample's place that differs by more than this from the mean around is no part of an evenly lit white.
const UNEVEN: f32 = 0.25;
/// The darkest twentieth of an evenly lit white has this share of the light of its brightest at the least.
const DARKEST: f32 = 0.15;

impl References {
    /// Counts even light that black shots do not have to the uncertainty of the ambient light: `dn_per_sec`, the same
    /// error in all pixels of a cell of `cell_px` a side, so many times what averaging them would leave.
    pub(super) fn doubt_ambient(&mut self, dn_per_sec: f64, cell_px: f64) {
        let added = (dn_per_sec * cell_px).powi(2) as f32;
        self.ambient.variance.iter_mut().for_each(|v| *v += added);
    }
}

/// Reads black and white.
///
/// # Errors
/// Those of decoding.
pub(super) fn references(
    photographs: &Photographs<'_>,
    registered: &Registered,
    flicker_sd: Option<f64>,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<References> {
    let mut warnings = Vec::new();
    let stage = progress.stage("reference", 3);
    let shots = [
        photographs.one(|p| matches!(p, Pattern::SampleBlack))?,
        photographs.one(|p| matches!(p, Pattern::ReferenceWhite))?,
        photographs.one(|p| matches!(p, Pattern::ReferenceBlack))?,
    ];
    let mut merged: Vec<Radiance> =
        shots.par_iter().map(|&s| photographs.merge_whole(s).inspect(|_| stage.advance(1))).collect::<Result<_>>()?;
    let (Some(black), Some(mut white), Some(mut ambient)) = (merged.pop(), merged.pop(), merged.pop()) else {
        return Err(Error::internal("three shots merged to fewer"));
    };
    warnings.extend(exchanged(photographs, registered, [&ambient, &white, &black], shots, options)?);
    let level = white_level(&registered.sums, &white, &black);
    let mut is_off = false;
    if let Some(Level { mean, sd, .. }) = level {
        let off = (1.0 / mean - 1.0).abs();
        if off > LEAST_LEVEL.max(LEVEL_SIGMA * sd.max(flicker_sd.unwrap_or(0.0))) {
            let shot = photographs.name(shots[1]).to_owned();
            let finding = ConsistencyWarning::WhiteLevel { shot, level: 1.0 / mean, level_sd: sd };
            is_off = true;
            warnings.push(if off > REFUSED_LEVEL { options.refuse(finding)? } else { finding.into() });
        }
    }
    // A level that is off by more than a tenth is no flicker, and nothing is done about it.
    let steadied = level.filter(|l| (l.mean - 1.0).abs() < REFUSED_LEVEL && (flicker_sd.is_some() || is_off));
    if let Some(Level { mean, .. }) = steadied {
        white.value.iter_mut().for_each(|v| *v *= mean as f32);
        white.variance.iter_mut().for_each(|v| *v *= (mean * mean) as f32);
    }
    let white_variance = steadied.map(|l| l.variance_of_mean);
    white.subtract(&black);
    warnings.extend(unevenness(photographs, registered, &white, shots[1], options)?);
    let lamp = LampBetween::measure(photographs, &white, &black, flicker_sd, options)?;
    let (lamp, changed) = lamp.unzip();
    warnings.extend(changed.flatten());
    let dark = dark(photographs, &ambient)?;
    warnings.extend(dark.as_ref().err().cloned());
    let hot = find_hot_pixels(dark.as_ref().ok().and_then(Option::as_ref).unwrap_or(&ambient));
    mend(&mut white, &hot);
    let cell_px = registered.registration.px_per_mm() * photographs.capture.manifest.window.pitch_mm;
    let frame_share = frame_shares(&reference_px(photographs, registered), cell_px.max(2.0), &ambient, &black);
    let irradiance = Irradiance::new(white, &photographs.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
    if let Some(sd) = flicker_sd {
        // One shot's lamp, the same error in all pixels of a cell: that many times what averaging them would leave.
        let share = sd * sd / photographs.brackets[shots[0]].len() as f64 * cell_px * cell_px;
        let values = ambient.variance.iter_mut().zip(&ambient.value);
        values.for_each(|(variance, value)| *variance += share as f32 * value * value);
    }
    Ok(References { ambient, hot, irradiance, white_variance, lamp, frame_share, warnings })
}

/// Camera px of the reference dots, without drift.
fn reference_px(photographs: &Photographs<'_>, registered: &Registered) -> Vec<Point> {
    let Registration { view, slab_from_projector, .. } = &registered.registration;
    let dots = photographs.capture.manifest.reference_dots.iter().flat_map(|r| &r.projector_px);
    dots.map(|&p| view.camera_from_slab(slab_from_projector.map(p))).collect()
}

/// Every [`SUM_STEP`]th pixel, those of them that are lit.
pub(super) fn lit_places(light: &[f32]) -> impl Iterator<Item = usize> {
    let brightest = light.iter().copied().fold(0.0, f32::max);
    (0..light.len()).step_by(SUM_STEP).filter(move |&p| light[p] > LIT_SHARE * brightest)
}

/// The lamp's mean level over the Gray code, of that of the white reference.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Level {
    mean: f64,
    /// Of one pair of patterns.
    sd: f64,
    variance_of_mean: f64,
}

/// Gray-code patterns with their inverses over the white reference: each pair adds up to white and black. `None` with
/// fewer than three pairs, and where they are not the white reference's at all.
///
/// The median over pixels, so that those that some exposure did not measure do not matter.
fn white_level(sums: &[Vec<f32>], white: &Radiance, black: &Radiance) -> Option<Level> {
    let (light, dark) = (white.luminance(), black.luminance());
    let lit: Vec<usize> = lit_places(&light).collect();
    let ratio = |sum: &Vec<f32>| {
        let mut all: Vec<f32> = lit.iter().map(|&p| (sum[p / SUM_STEP] - dark[p]) / light[p]).collect();
        let middle = all.len() / 2;
        (!all.is_empty()).then(|| f64::from(*all.select_nth_unstable_by(middle, f32::total_cmp).1))
    };
    let ratios: Vec<f64> = sums.iter().map(ratio).collect::<Option<_>>()?;
    let n = ratios.len() as f64;
    if ratios.len() < 3 {
        return None;
    }
    let mean = ratios.iter().sum::<f64>() / n;
    let variance = ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean > 0.0).then(|| Level { mean, sd: variance.sqrt(), variance_of_mean: variance / n })
}

/// Light of the sample under black over that of the white reference under black: no sample is as dark.
const DARKEST_BLACK: f64 = 0.01;
/// Reference dots in the black shot with more than this share of the white reference's light come from a lattice, not
/// from black.
const BLACK_DOT: f64 = 0.05;

/// Reference shots that show something else than they should, by their light where the sample lies.
fn exchanged(
    photographs: &Photographs<'_>,
    registered: &Registered,
    [sample_black, white, black]: [&Radiance; 3],
    [sample_shot, _, black_shot]: [usize; 3],
    options: &BuildOptions,
) -> Result<Option<Warning>> {
    let size_mm = photographs.capture.manifest.slab.size_mm;
    let view = &registered.registration.view;
    let on_sample = |k: usize| {
        let [x, y] = [k % white.rect.width, k / white.rect.width].map(|v| v as f64);
        view.slab_from_camera([x, y]).is_some_and(|p| on_slab(p, size_mm, 0.0))
    };
    let places: Vec<usize> = (0..white.rect.area()).step_by(SUM_STEP).filter(|&k| on_sample(k)).collect();
    let level = |picture: &Radiance| {
        let (light, used) = (picture.luminance(), picture.used.as_chunks::<3>().0);
        let mut seen: Vec<f64> =
            places.iter().filter(|&&k| !used[k].contains(&0)).map(|&k| f64::from(light[k])).collect();
        (4 * seen.len() > places.len()).then(|| median(&mut seen))
    };
    let name = |shot: usize| photographs.name(shot).to_owned();
    let refused = |shot: usize, looks: &str, ratio: f64| {
        options.refuse(ConsistencyWarning::ReferenceLight { shot: name(shot), looks: looks.into(), ratio }).map(Some)
    };
    let (light, dark, ambient) = (level(white), level(black), level(sample_black));
    let Some(light) = light else { return Ok(None) };
    // What saturates is bright.
    let of_white = |level: Option<f64>| level.map_or(f64::INFINITY, |l| l / light.max(f64::MIN_POSITIVE));
    if of_white(dark) > BRIGHTEST_BLACK {
        return refused(black_shot, "it is lit, or exchanged with the white reference", of_white(dark));
    }
    if of_white(ambient) > BRIGHTEST_BLACK {
        return refused(sample_shot, "it is lit: projector or room were not dark", of_white(ambient));
    }
    // A dot of the pattern on the frame, where black has none.
    let seen = sample_black.luminance();
    let mut at_dots: Vec<f64> = reference_px(photographs, registered)
        .into_iter()
        .filter_map(|[x, y]| {
            let inside =
                x >= 0.0 && y >= 0.0 && x < white.rect.width as f64 - 0.5 && y < white.rect.height as f64 - 0.5;
            let k = inside.then(|| y.round() as usize * white.rect.width + x.round() as usize)?;
            Some(f64::from(seen[k]) / light)
        })
        .collect();
    let at_dots = median(&mut at_dots);
    if at_dots > BLACK_DOT {
        return refused(sample_shot, "it shows reference dots: the projector still had a lattice", at_dots);
    }
    let noise = |picture: &Radiance| {
        let mut all: Vec<f64> = picture.luminance_variance().iter().step_by(SUM_STEP).map(|v| f64::from(*v)).collect();
        (median(&mut all) / places.len().max(1) as f64).sqrt()
    };
    // A cap lets nothing through that any other black shot has.
    let (Some(dark), Some(ambient)) = (dark, ambient) else { return Ok(None) };
    if dark > 10.0 * noise(black) && dark > 0.0 && ambient < DARKEST_BLACK * dark && dark > 10.0 * noise(sample_black) {
        let looks = "it has no light at all, the other black shot has: was the lens covered?";
        let finding =
            ConsistencyWarning::ReferenceLight { shot: name(sample_shot), looks: looks.into(), ratio: ambient / light };
        return Ok(Some(finding.into()));
    }
    Ok(None)
}

/// A covered lens has less light than [`COVERED`] or so many standard deviations.
const COVERED_SIGMA: f64 = 10.0;

/// What the sensor shows of no light, where a shot of a covered lens is there; a finding where it was not covered.
fn dark(photographs: &Photographs<'_>, ambient: &Radiance) -> Result<std::result::Result<Option<Radiance>, Warning>> {
    let Some(&shot) = photographs.capture.shots(|p| matches!(p, Pattern::Dark)).first() else { return Ok(Ok(None)) };
    let dark = photographs.merge_whole(shot)?;
    let middle = |values: Vec<f32>| {
        let mut some: Vec<f64> = values.iter().step_by(SUM_STEP).map(|v| f64::from(*v)).collect();
        let count = some.len().max(1) as f64;
        (median(&mut some), count)
    };
    let (light, count) = middle(dark.luminance());
    let sd = (middle(dark.luminance_variance()).0 / count).sqrt();
    let ratio = light / middle(ambient.luminance()).0.max(f64::MIN_POSITIVE);
    if ratio < COVERED || light < COVERED_SIGMA * sd {
        return Ok(Ok(Some(dark)));
    }
    Ok(Err(ConsistencyWarning::DarkIsLit { shot: photographs.name(shot).to_owned(), ratio }.into()))
}

/// A pixel of the white reference that differs by more than this from what Gray-code patterns and their inverses add up
/// to there.
const UNLIKE_SUM: f32 = 0.1;

/// Share of the sample's place where the white reference is not what the Gray code's light adds up to, all over alike
/// taken out.
fn unlike_sums(sums: &[Vec<f32>], white: &Radiance, inside: &impl Fn(usize, usize) -> bool) -> f64 {
    let (light, w) = (white.luminance(), white.rect.width);
    let brightest = sums.iter().flatten().copied().fold(0.0, f32::max);
    let mut ratios: Vec<f64> = (0..light.len())
        .step_by(SUM_STEP)
        .filter(|&p| inside(p % w, p / w))
        .filter_map(|p| {
            let mut all: Vec<f64> = sums.iter().map(|s| f64::from(s[p / SUM_STEP])).collect();
            let sum = median(&mut all);
            (sum > f64::from(0.1 * brightest)).then(|| f64::from(light[p]) / sum)
        })
        .collect();
    if sums.len() < 3 || ratios.len() < 30 {
        return 0.0;
    }
    let middle = median(&mut ratios);
    let off = ratios.iter().filter(|r| (*r / middle - 1.0).abs() > f64::from(UNLIKE_SUM)).count();
    off as f64 / ratios.len() as f64
}

/// What is to be told of a white reference, without black, that is not evenly lit where the sample lies.
fn unevenness(
    photographs: &Photographs<'_>,
    registered: &Registered,
    white: &Radiance,
    shot: usize,
    options: &BuildOptions,
) -> Result<Option<Warning>> {
    let manifest = &photographs.capture.manifest;
    let [w, h] = [white.rect.width, white.rect.height];
    let (light, used) = (white.luminance(), white.used.as_chunks::<3>().0);
    let cell_px = registered.registration.px_per_mm() * manifest.window.pitch_mm;
    let reach = cell_px.round().clamp(2.0, 50.0) as usize;
    // Its rim is blurred.
    let margin_mm = 2.0 * reach as f64 / registered.registration.px_per_mm();
    let inside = |x: usize, y: usize| {
        let at = registered.registration.view.slab_from_camera([x as f64, y as f64]);
        at.is_some_and(|p| on_slab(p, manifest.slab.size_mm, margin_mm))
    };
    let (mut all, mut uneven, mut levels) = (0usize, 0usize, Vec::new());
    for y in (reach..h.saturating_sub(reach)).step_by(2) {
        for x in (reach..w.saturating_sub(reach)).step_by(2) {
            if used[y * w + x].contains(&0) || !inside(x, y) {
                continue;
            }
            // The four pixels a cell away to each side, whose mean a slope does not move.
            let around =
                [[x - reach, y], [x + reach, y], [x, y - reach], [x, y + reach]].map(|[u, v]| light[v * w + u]);
            let mean = around.iter().sum::<f32>() / 4.0;
            all += 1;
            uneven += usize::from((light[y * w + x] - mean).abs() > UNEVEN * mean.abs());
            levels.push(light[y * w + x]);
        }
    }
    if all < 100 {
        return Ok(None);
    }
    let share = (uneven as f64 / all as f64).max(unlike_sums(&registered.sums, white, &inside));
    levels.sort_by(f32::total_cmp);
    let dark = levels[all / 20] < DARKEST * levels[all - 1 - all / 20];
    if share < UNEVEN_SHARE && !dark {
        return Ok(None);
    }
    let codes = photographs.capture.shots(|p| matches!(p, Pattern::GrayCode { .. } | Pattern::Lattice { .. }));
    let looks = shown_shot(photographs, white, &codes)?
        .unwrap_or_else(|| "a pattern, or something in the way of the light".into());
    let shot = photographs.name(shot).to_owned();
    options.refuse(ConsistencyWarning::WhiteUneven { shot, looks, share }).map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;

    const BLACK: f32 = 3.0;

    /// The white of a pixel: no two alike, three channels apart; every fourth is not lit.
    fn light(p: usize) -> f32 {
        if p % 4 == 2 { 8.0 } else { 60.0 + p as f32 }
    }

    fn picture(of: impl Fn(usize) -> f32, variance: f32) -> Radiance {
        let rect = Rect { x: 0, y: 0, width: 17, height: 11 };
        // The luminance of each is `of`, which channels share unevenly.
        let value = (0..187).flat_map(|p| [0.5, 0.9, 1.6].map(|c| c * of(p))).collect();
        Radiance { rect, value, variance: vec![variance; 561], used: vec![1; 561] }
    }

    /// What is found of a lamp that makes `levels` of the sums of pattern and inverse.
    fn level(levels: &[f32]) -> Option<Level> {
        // White is seen with the black; a sum holds it twice.
        let sum = |level: &f32| {
            (0..187).step_by(SUM_STEP).map(|p| (light(p) * level + BLACK) * if p == 26 { 40.0 } else { 1.0 }).collect()
        };
        let sums: Vec<Vec<f32>> = levels.iter().map(sum).collect();
        white_level(&sums, &picture(light, 2.0), &picture(|_| BLACK, 1.0))
    }

    #[test]
    fn the_level_of_the_white_reference_is_that_of_gray_code_patterns_with_their_inverses() {
        let found = level(&[1.02, 1.05, 0.99, 1.06]).unwrap();
        // Mean 1.03; of four deviations −1, 2, −4, 3 per cent, Σ² / 3. One pixel that is wrong in all of them is not
        // the median's. f32.
        assert!((found.mean - 1.03).abs() < 1e-5, "{found:?}");
        assert!((found.sd.powi(2) / (30e-4 / 3.0) - 1.0).abs() < 1e-3, "{found:?}");
        assert!((4.0 * found.variance_of_mean / found.sd.powi(2) - 1.0).abs() < 1e-9);
        assert_eq!((level(&[1.02, 1.05]), level(&[])), (None, None), "fewer than three pairs");
    }
}
