//! Exposure times as the photographs tell them, and what is to be told of those that are stated.

use super::BuildOptions;
use crate::capture::{Capture, ExposureFrom, Pattern, Photograph, stated_encoding};
use crate::radiance::{
    Brightness, ExposureFit, FileNoise, MOST_FLICKER, Sensor, Stack, StackScales, disagreements, fit_exposures,
};
use crate::warning::bounds::{REFUSED_SLOPE, REFUSED_TIME, TIME_SIGMA, TIME_TOLERANCE};
use crate::{ConsistencyWarning, RadianceWarning, Result, Warning};
use std::collections::{BTreeMap, BTreeSet};

/// Compressed dark parts mislead by half a per cent and more: a measured time is worth a word there when it differs by
/// more than this.
const COMPRESSED_TIME_TOLERANCE: f64 = 0.015;
/// The distinct nominal exposures of a capture, shortest first.
pub(super) struct Settings {
    pub(super) secs: Vec<f64>,
}

impl Settings {
    pub(super) fn of(capture: &Capture) -> Self {
        let mut secs: Vec<f64> = capture.brackets.iter().flatten().map(|p| p.effective_secs).collect();
        secs.sort_by(f64::total_cmp);
        secs.dedup_by(|b, a| *b / *a < SAME);
        Self { secs }
    }

    pub(super) fn index(&self, photograph: &Photograph) -> usize {
        self.secs.partition_point(|s| s * SAME <= photograph.effective_secs).min(self.secs.len() - 1)
    }

    /// The first photograph of a setting.
    fn first_file(&self, setting: usize, capture: &Capture) -> String {
        let first = capture.brackets.iter().flatten().find(|p| self.index(p) == setting);
        first.map_or_else(String::new, |p| capture.name_of(&p.path))
    }

    pub(super) fn apply(&self, fit: &ExposureFit, brackets: &mut [Vec<Photograph>]) {
        for bracket in brackets {
            for photograph in bracket.iter_mut() {
                photograph.effective_secs *= fit.log_scale[self.index(photograph)].exp();
            }
            bracket.sort_by(|a, b| a.effective_secs.total_cmp(&b.effective_secs));
        }
    }
}

/// Nominal exposures nearer than this are one setting.
const SAME: f64 = 1.000_001;

/// The fit of the settings, without single stacks whose times contradict those of most: their photographs are told one
/// by one.
pub(super) fn fit_settled(mut stacks: Vec<(&Stack, StackScales)>, settings: usize) -> ExposureFit {
    let most = stacks.len() / 4;
    for _ in 0..=most {
        let fit = fit_exposures(&stacks, settings);
        let off = |(stack, scales): &(&Stack, StackScales)| {
            let n = scales.log_scale.len();
            let left: Vec<f64> = (0..n)
                .filter(|&j| scales.information[j * n + j] > 100.0)
                .map(|j| scales.log_scale[j] - fit.log_scale[stack.settings[j]])
                .collect();
            let mean = left.iter().sum::<f64>() / left.len().max(1) as f64;
            left.iter().map(|l| (l - mean).abs()).fold(0.0, f64::max)
        };
        let worst = (0..stacks.len()).max_by(|&a, &b| off(&stacks[a]).total_cmp(&off(&stacks[b])));
        match worst.filter(|&k| off(&stacks[k]) > REFUSED_TIME && stacks.len() > 3) {
            Some(k) => drop(stacks.remove(k)),
            None => return fit,
        }
    }
    fit_exposures(&stacks, settings)
}

/// Relative variance of the light of all lattice shots against the white reference's, because nominal times are not what
/// they were: 0 where times are those that stacks tell and link both.
///
/// By how much nominal times are off is what those of linked settings scatter by about their mean, as many standard
/// deviations of it as Student's distribution has with so few; which need not hold for settings with nothing to compare
/// with. Times as stated: the white reference and a place of the sample are each mostly told by one exposure. Times as
/// measured: each linked group has the mean error of its own. Compressed files scatter by themselves, and count only
/// where that is `told`.
pub(super) fn scale_variance(
    fit: &ExposureFit,
    settings: &Settings,
    capture: &Capture,
    from: ExposureFrom,
    told: bool,
) -> f64 {
    let groups: Vec<Vec<usize>> = groups(fit).into_values().collect();
    let (mut squares, mut free) = (0.0, 0.0);
    for group in groups.iter().filter(|_| told && !fit.failed) {
        let mean = group.iter().map(|&s| fit.log_scale[s]).sum::<f64>() / group.len() as f64;
        squares += group.iter().map(|&s| (fit.log_scale[s] - mean).powi(2) - fit.variance[s]).sum::<f64>();
        free += group.len() as f64 - 1.0;
    }
    if !(squares > 0.0 && free > 0.0) {
        return 0.0;
    }
    // Of three at the least: Student's distribution has a variance only from there on.
    let nominal = squares / free * f64::max(free, 3.0) / (f64::max(free, 3.0) - 2.0);
    let share = |kind: fn(&Pattern) -> bool| {
        let mut used = BTreeSet::new();
        let shots = capture.shots(kind);
        used.extend(shots.iter().flat_map(|&shot| &capture.brackets[shot]).map(|p| settings.index(p)));
        move |s: &usize| if used.contains(s) { 1.0 / used.len() as f64 } else { 0.0 }
    };
    let (white, lattice) = (share(|p| *p == Pattern::ReferenceWhite), share(|p| matches!(p, Pattern::Lattice { .. })));
    match from {
        ExposureFrom::Exif | ExposureFrom::Apex => 2.0 * nominal,
        ExposureFrom::Estimate => groups
            .iter()
            .map(|group| {
                let weight: f64 = group.iter().map(|s| white(s) - lattice(s)).sum();
                weight * weight * nominal / group.len() as f64
            })
            .sum(),
    }
}

/// The settings of each group that stacks link.
fn groups(fit: &ExposureFit) -> BTreeMap<usize, Vec<usize>> {
    let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    fit.group.iter().enumerate().for_each(|(s, &g)| groups.entry(g).or_default().push(s));
    groups
}

/// Whether the photographs of a stack show the same, whatever their brightness.
pub(super) fn agrees(stack: &Stack, sensor: &Sensor) -> bool {
    let brightness = Brightness { log_scale: &vec![0.0; stack.exposures.len()], tolerance: f64::INFINITY };
    disagreements(&[&stack.exposures], sensor, 1, brightness).is_empty()
}

/// What the fit says against the stated times, the lamp and the response curve; `agree`: whether the photographs of
/// most stacks show the same.
///
/// # Errors
/// [`crate::Error::Contradiction`].
pub(super) fn judge(
    fit: &ExposureFit,
    agree: bool,
    settings: &Settings,
    options: &BuildOptions,
    file: FileNoise,
    capture: &Capture,
) -> Result<Vec<Warning>> {
    let scale_variance = |told| scale_variance(fit, settings, capture, options.exposure_from, told);
    let mut warnings = Vec::new();
    if fit.failed {
        warnings.push(ConsistencyWarning::ExposuresUnmeasured { settings: settings.secs.len() }.into());
        return Ok(warnings);
    }
    let linked: Vec<Vec<usize>> = groups(fit).into_values().collect();
    if let Some(slope) = linked.iter().find_map(|group| curve_slope(fit, settings, group)) {
        let encoding = capture.brackets.iter().flatten().next().and_then(|p| stated_encoding(&p.path));
        warnings.push(options.refuse(ConsistencyWarning::ResponseCurve {
            given: capture.rig.camera.response_curve.clone().into(),
            slope,
            encoding,
        })?);
        return Ok(warnings);
    }
    if !agree {
        // What the photographs of stacks show differs, not only how bright: that is told shot by shot.
        return Ok(warnings);
    }
    if let Some(relative_sd) = fit.flicker_sd.filter(|sd| *sd > 0.99 * MOST_FLICKER) {
        warnings.push(options.refuse(ConsistencyWarning::BrightnessVaries { relative_sd })?);
    }
    if options.exposure_from == ExposureFrom::Estimate {
        if linked.len() > 1 {
            let secs = |group: &Vec<usize>| group.iter().map(|&s| settings.secs[s]).collect();
            let (groups, scale_sd) = (linked.iter().map(secs).collect(), scale_variance(true).sqrt());
            warnings.push(RadianceWarning::ExposuresUnlinked { groups, scale_sd }.into());
        }
        return Ok(warnings);
    }
    let tolerance = if file.is_compressed() { COMPRESSED_TIME_TOLERANCE } else { TIME_TOLERANCE };
    let significant = |s: &usize| {
        let (off, sd) = (fit.log_scale[*s].abs(), fit.variance[*s].sqrt());
        off > tolerance && off > TIME_SIGMA * sd
    };
    let off = |s: usize| fit.log_scale[s].abs();
    let Some(worst) = (0..settings.secs.len()).filter(significant).max_by(|&a, &b| off(a).total_cmp(&off(b))) else {
        return Ok(warnings);
    };
    let (nominal_secs, measured_secs) = (settings.secs[worst], settings.secs[worst] * fit.log_scale[worst].exp());
    let relative_sd = fit.variance[worst].sqrt();
    warnings.push(match off(worst) > REFUSED_TIME {
        true => options.refuse(ConsistencyWarning::ExposureTimes {
            file: settings.first_file(worst, capture),
            nominal_secs,
            measured_secs,
            relative_sd,
            settings: (0..settings.secs.len()).filter(|s| significant(s) && off(*s) > REFUSED_TIME).count(),
        })?,
        false => RadianceWarning::ExposureRatios {
            nominal_secs,
            measured_secs,
            relative_sd,
            scale_sd: scale_variance(true).sqrt(),
        }
        .into(),
    });
    Ok(warnings)
}

/// The slope of ln(actual) over ln(nominal) of linked settings when it is not 1 and explains most of what they are off
/// by: that of a response curve that was not taken into account.
fn curve_slope(fit: &ExposureFit, settings: &Settings, of: &[usize]) -> Option<f64> {
    if of.len() < 3 {
        return None;
    }
    let n = of.len() as f64;
    let x: Vec<f64> = of.iter().map(|&s| settings.secs[s].ln()).collect();
    let y: Vec<f64> = of.iter().zip(&x).map(|(&s, x)| x + fit.log_scale[s]).collect();
    let mean = |v: &[f64]| v.iter().sum::<f64>() / n;
    let (mx, my) = (mean(&x), mean(&y));
    let square: f64 = x.iter().map(|x| (x - mx).powi(2)).sum();
    let slope = x.iter().zip(&y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>() / square;
    // What 1 leaves, and what the slope leaves.
    let left = |slope: f64| x.iter().zip(&y).map(|(x, y)| (y - my - slope * (x - mx)).powi(2)).sum::<f64>();
    ((slope - 1.0).abs() > REFUSED_SLOPE && left(slope) < 0.1 * left(1.0)).then_some(slope)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Pattern;

    fn photograph(secs: f64) -> Photograph {
        Photograph { effective_secs: secs, ..Photograph::new("a.png", "white", 9.0) }
    }

    #[test]
    fn a_photograph_belongs_to_the_setting_of_its_effective_time() {
        let settings = Settings { secs: vec![0.01, 0.04, 0.16] };
        let index = |secs: f64| settings.index(&photograph(secs));
        assert_eq!([0.01, 0.04, 0.16].map(index), [0, 1, 2]);
        // Nearer than a millionth is the same.
        assert_eq!([0.040_000_02, 0.039_999_98].map(index), [1, 1]);
    }

    #[test]
    fn the_worst_exposure_time_is_told_when_it_is_off_by_more_than_noise_and_nominal_rounding() {
        let settings = Settings { secs: vec![0.01, 0.04, 0.16] };
        let of = |log_scale: [f64; 3], sd: f64, compression: f64| {
            let fit = ExposureFit {
                log_scale: log_scale.to_vec(),
                variance: vec![sd * sd; 3],
                group: vec![0; 3],
                flicker_sd: None,
                failed: false,
            };
            let file = FileNoise { sixteen_bit: false, compression: [compression; 3], ..FileNoise::default() };
            judge(&fit, true, &settings, &BuildOptions::default(), file, &super::super::tests::capture(&[])).unwrap()
        };
        assert!(of([0.004, -0.004, 0.0], 1e-5, 0.0).is_empty());
        assert!(of([0.0, -0.02, 0.02], 0.01, 0.0).is_empty(), "two standard deviations");
        assert!(of([0.0, -0.014, 0.014], 1e-5, 0.3).is_empty(), "of compressed files");
        for compression in [0.0, 0.3] {
            let warnings = of([0.02, -0.05, 0.03], 0.001, compression);
            let [Warning::Radiance(RadianceWarning::ExposureRatios { nominal_secs, measured_secs, relative_sd, .. })] =
                warnings[..]
            else {
                panic!("{warnings:?}")
            };
            // 0.04 e^−0.05; the standard deviation is the root of the variance (f64).
            assert_eq!(nominal_secs, 0.04);
            assert!((measured_secs - 0.038_049_177).abs() < 1e-8 && (relative_sd - 0.001).abs() < 1e-12);
        }
        let fit = ExposureFit {
            log_scale: vec![0.9; 3],
            variance: vec![0.0; 3],
            group: vec![0, 1, 0],
            flicker_sd: None,
            failed: false,
        };
        let options = BuildOptions { exposure_from: ExposureFrom::Estimate, ..BuildOptions::default() };
        let warnings =
            judge(&fit, true, &settings, &options, FileNoise::default(), &super::super::tests::capture(&[])).unwrap();
        let [Warning::Radiance(RadianceWarning::ExposuresUnlinked { groups, .. })] = &warnings[..] else {
            panic!("{warnings:?}")
        };
        assert_eq!(*groups, [vec![0.01, 0.16], vec![0.04]]);
    }

    #[test]
    fn times_that_are_off_make_the_light_of_all_rows_uncertain() {
        let capture = super::super::tests::capture(&[
            (Pattern::ReferenceWhite, &[0.01, 0.04]),
            (Pattern::Lattice { dots: vec![] }, &[0.1, 0.4, 1.6]),
        ]);
        let settings = Settings::of(&capture);
        let variance = |log_scale: [f64; 5], group: [usize; 5], from: ExposureFrom, told: bool| {
            let log_scale = log_scale.to_vec();
            let fit = ExposureFit {
                log_scale,
                variance: vec![1e-6; 5],
                group: group.into(),
                flicker_sd: None,
                failed: false,
            };
            scale_variance(&fit, &settings, &capture, from, told)
        };
        let (apart, linked) = ([0, 0, 2, 2, 2], [0; 5]);
        let times = [0.0, 0.02, -0.03, 0.0, 0.0];
        // About the means .01 and -.01: 2e-4 + 6e-4 less noise of 5e-6, of three free ones; Student's of three: 3 times.
        let nominal = (8e-4 - 5e-6) / 3.0 * 3.0;
        for (from, group, expected) in [
            (ExposureFrom::Exif, apart, 2.0 * nominal),
            (ExposureFrom::Estimate, apart, nominal * (1.0 / 2.0 + 1.0 / 3.0)),
            (ExposureFrom::Estimate, linked, 0.0),
        ] {
            let found = variance(times, group, from, true);
            assert!((found - expected).abs() < 1e-12, "{from:?} {group:?}: {found} {expected}");
            assert_eq!(variance(times, group, from, false), 0.0);
        }
        // Of five linked ones four are free: mean -.002, Σ² 1.28e-3, factor 2.
        let found = variance(times, linked, ExposureFrom::Exif, true);
        assert!((found - 2.0 * (1.28e-3 - 5e-6) / 4.0 * 2.0).abs() < 1e-12, "{found}");
        assert_eq!(variance([0.0; 5], linked, ExposureFrom::Exif, true), 0.0, "right times");
        assert_eq!(variance(times, [0, 1, 2, 3, 4], ExposureFrom::Exif, true), 0.0, "nothing to compare with");
    }

    #[test]
    fn settings_are_the_distinct_times_and_are_corrected_each_by_its_own_factor() {
        let mut capture = super::super::tests::capture(&[
            (Pattern::Board, &[0.01, 0.04]),
            (Pattern::ReferenceWhite, &[0.04, 0.160_000_01]),
            (Pattern::SampleBlack, &[0.16]),
        ]);
        let settings = Settings::of(&capture);
        assert_eq!(settings.secs, [0.01, 0.04, 0.16]);
        let fit = ExposureFit {
            // 0.04 is really 0.2: longer than what 0.16 is.
            log_scale: vec![0.0, 5f64.ln(), 0.5f64.ln()],
            variance: vec![0.0; 3],
            group: vec![0; 3],
            flicker_sd: None,
            failed: false,
        };
        settings.apply(&fit, &mut capture.brackets);
        let secs = |k: usize| capture.brackets[k].iter().map(|p| p.effective_secs).collect::<Vec<_>>();
        let close = |found: Vec<f64>, expected: &[f64]| {
            found.len() == expected.len() && found.iter().zip(expected).all(|(f, e)| (f / e - 1.0).abs() < 1e-6)
        };
        assert!(close(secs(0), &[0.01, 0.2]) && close(secs(1), &[0.08, 0.2]) && close(secs(2), &[0.08]));
        // What the camera was set to stays.
        assert_eq!(capture.brackets[1][1].exposure_secs, 0.04);
    }
}
