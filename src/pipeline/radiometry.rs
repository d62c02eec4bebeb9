//! Before any registration: what code values, exposure times and the lamp are really like, from a few of the capture's
//! shots.

use super::BuildOptions;
use super::exposure_times::{Settings, agrees, fit_settled, judge, scale_variance};
use crate::capture::{
    Axis, Capture, ExposureFrom, Noise, Pattern, Photograph, Reduction, ResponseCurve, Samples, Surface,
};
use crate::progress::Progress;
use crate::radiance::{
    Bracket, Curve, CurveEstimate, CurveOptions, ExposureFit, FileNoise, LightSum, Sensor, Stack, decode_spread,
    estimate_curve, evenly, pick_pixels, stack_scales, take,
};
use crate::warning::bounds::REFUSED_TIME;
use crate::{Error, RadianceWarning, Result, Warning};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// The sensor and the exposures as they were found to be, and what was found on the way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Radiometry {
    noise: Noise,
    /// What turned light to code values; `None` when they are in proportion to it.
    curve: Option<Curve>,
    file: FileNoise,
    /// Photographs of each shot with their actual exposure times, shortest first.
    pub brackets: Vec<Vec<Photograph>>,
    /// Standard deviation of a photograph's light about its setting's, when there is any beyond noise.
    pub flicker_sd: Option<f64>,
    /// ln(actual / stated time) of each photograph as the stacks tell it, of what was not applied.
    log_scales: Vec<Vec<f64>>,
    /// Relative variance of the light of all rows alike, by exposure times.
    pub scale_variance: f64,
    /// Whether stated times were corrected by more than cameras round them.
    pub corrected: bool,
    pub warnings: Vec<Warning>,
    /// For the provenance.
    pub record: serde_json::Value,
}

/// Lattice shots that are looked at: one in so many, within bounds. Twelve stacks of five
/// give flicker to a tenth of itself.
const LATTICE_SHOTS_PER_LOOK: usize = 16;
const LOOKS: [usize; 2] = [8, 16];
/// Shots of the Gray code that are looked at. Some exposure times are those of the board and the white reference alone:
/// flicker that by chance changes both stacks alike would look like a wrong time.
const GRAY_SHOTS: usize = 6;
/// Gray-code bits of each axis whose light sums are looked at, finest first: their stripes have most edges.
const BITS_PER_AXIS: usize = 6;
/// Pixels of a light sum, half of them on edges.
const SUM_PIXELS: usize = 6000;
/// The brightness of a photograph that is off by more is a mistake, in files in proportion to light and in others. A
/// shutter of a good camera repeats to a per cent; an unknown curve's error is of some.
const LINEAR_TOLERANCE: f64 = 0.05;
const CURVE_TOLERANCE: f64 = 0.15;
/// The same in standard deviations of the flicker.
const FLICKER_SIGMA: f64 = 6.0;
/// Compression scatters the scales of photographs by a tenth of a per cent: only more than this is flicker of the lamp.
const LEAST_COMPRESSED_FLICKER: f64 = 0.002;
/// Less than this changes no row by more than a twentieth of a per cent: what else is unknown of it is ten times as
/// much.
const LEAST_FLICKER: f64 = 0.0005;
/// How far nominal times are trusted while the curve is estimated (standard deviation of the logarithm): a rounded 1/30
/// for 1/32 is off by 6 %, most by less; times that are to be estimated are hardly trusted.
const NOMINAL_SD: f64 = 0.03;
const DOUBTED_SD: f64 = 0.3;
/// The estimated curve's file, beside `rig.toml`.
const CURVE_FILE: &str = "response.toml";

impl Radiometry {
    /// What turns code values to light.
    pub(super) fn sensor(&self) -> Sensor {
        self.sensor_of(self.reduction().map_or(1, |by| by.factor))
    }

    /// ln(actual / stated time) of a photograph as the stacks of the capture tell it, unless its time has been
    /// corrected by that.
    pub(super) fn unapplied_log_scale(&self, shot: usize, place: usize) -> f64 {
        self.log_scales[shot][place]
    }

    /// By how much the logarithm of a photograph's light may be off: by flicker, and by what the files do to light.
    pub(super) fn brightness_tolerance(&self) -> f64 {
        let files = if self.curve.is_some() || self.file.is_compressed() { CURVE_TOLERANCE } else { LINEAR_TOLERANCE };
        files.max(FLICKER_SIGMA * self.flicker_sd.unwrap_or(0.0))
    }

    /// How the photographs are reduced; `None`: not at all.
    pub(super) fn reduction(&self) -> Option<&Reduction> {
        reduction(&self.brackets)
    }

    /// The same of photographs that are reduced.
    pub(super) fn reduced(mut self, by: &Reduction) -> Self {
        if by.factor > 1 {
            self.brackets.iter_mut().flatten().for_each(|p| p.reduction = Some(by.clone()));
        }
        self
    }

    /// Of a file that [`super::prepare`] has written, which has no tables: makes them anew.
    pub(super) fn with_tables(mut self) -> Self {
        let light = self.sensor().light_of_codes();
        let reductions = self.brackets.iter_mut().flatten().filter_map(|p| p.reduction.as_mut());
        reductions.for_each(|by| by.light.clone_from(&light));
        self
    }

    /// The same for photographs that are averaged over blocks of `factor` pixels a side.
    pub(super) fn sensor_of(&self, factor: usize) -> Sensor {
        let sample_px = self.reduction().map_or(1.0, |by| by.sample_px);
        Sensor::with_curve(&self.noise, self.curve.clone(), self.file).averaged(factor, sample_px / factor as f64)
    }
}

/// The sensor of photographs that are not reduced. sRGB stands in for a curve that is still to be estimated.
///
/// # Errors
/// [`Error::Field`] for a curve file that cannot be read.
pub(super) fn sensor_of_rig(capture: &Capture, noise: &Noise) -> Result<Sensor> {
    let curve = Curve::before_estimate(&capture.rig, &capture.rig_path)?;
    Ok(Sensor::with_curve(noise, curve, FileNoise::of_capture(capture)?))
}

/// Looks at some shots, estimates what is to be estimated, and corrects the photographs' `effective_secs` when asked
/// to.
///
/// # Errors
/// Those of decoding; [`Error::Field`] for a curve file that cannot be read and a curve that cannot be estimated.
pub(super) fn calibrate(
    capture: &Capture,
    noise: &Noise,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Radiometry> {
    let settings = Settings::of(capture);
    let chosen = choose_shots(capture, &settings);
    let stage = progress.stage("radiometry", chosen.len() + 1);
    let file = FileNoise::of_capture(capture)?;
    let is_estimated = capture.rig.camera.response_curve == ResponseCurve::Estimate;
    let mut curve = Curve::before_estimate(&capture.rig, &capture.rig_path)?;
    let by = reduction(&capture.brackets).cloned().unwrap_or_else(|| Reduction::new(1, noise.saturation_dn, None));
    let averaged = |curve| Sensor::with_curve(noise, curve, file).averaged(by.factor, by.sample_blocks());
    let mut sensor = averaged(curve.clone());
    let stacks: Vec<Stack> = chosen
        .par_iter()
        .map(|&shot| {
            let exposures = pick_pixels(decode(capture, shot)?.exposures(), &sensor);
            stage.advance(1);
            let settings = capture.brackets[shot].iter().map(|p| settings.index(p)).collect();
            Ok(Stack { exposures, settings })
        })
        .collect::<Result<_>>()?;

    let mut warnings = Vec::new();
    let mut estimate = None;
    if is_estimated {
        let found = settle_curve(capture, noise, &stacks, &settings, &sensor, file, options)?;
        curve = Some(found.curve.clone());
        sensor = averaged(curve.clone());
        estimate = Some(found);
    }
    // A photograph of something else would tell nonsense of times.
    let agreeing: Vec<&Stack> = stacks.iter().filter(|s| agrees(s, &sensor)).collect();
    // A wrong curve makes most disagree.
    let agree = 2 * agreeing.len() > stacks.len();
    let stacks: Vec<&Stack> = if agree { agreeing } else { stacks.iter().collect() };
    let scales: Vec<_> = stacks
        .par_iter()
        .filter_map(|&s| stack_scales(&[&s.exposures], &sensor, 1).map(|scales| (s, scales)))
        .collect();
    let mut fit = fit_settled(scales, settings.secs.len());
    let least_flicker = if file.is_compressed() { LEAST_COMPRESSED_FLICKER } else { LEAST_FLICKER };
    fit.flicker_sd = fit.flicker_sd.filter(|sd| agree && *sd > least_flicker);
    let judged = judge(&fit, agree, &settings, options, file, capture)?;
    let told = !file.is_compressed() || judged.iter().any(|w| matches!(w, Warning::Radiance(_)));
    let scale_variance = scale_variance(&fit, &settings, capture, options.exposure_from, told && agree);
    warnings.extend(judged);
    let mut brackets = capture.brackets.clone();
    let mut corrected = false;
    let mut log_scales: Vec<Vec<f64>> =
        brackets.iter().map(|b| b.iter().map(|p| fit.log_scale[settings.index(p)]).collect()).collect();
    if options.exposure_from == ExposureFrom::Estimate {
        settings.apply(&fit, &mut brackets);
        corrected = fit.log_scale.iter().any(|s| s.abs() > REFUSED_TIME);
        log_scales.iter_mut().flatten().for_each(|s| *s = 0.0);
    }
    stage.advance(1);
    let record = record(&fit, &settings, file, estimate.as_ref(), options);
    let (noise, flicker_sd) = (noise.clone(), fit.flicker_sd);
    Ok(Radiometry { noise, curve, file, brackets, flicker_sd, log_scales, scale_variance, corrected, warnings, record })
}

/// Pixels of a shot that are looked at. Dots are lit in several rows: every one is met.
const LOOKED_AT_PX: usize = 1 << 20;

/// Rows of a shot, spread over it.
fn decode(capture: &Capture, shot: usize) -> Result<Bracket> {
    decode_spread(&capture.brackets[shot], capture.rig.camera.size_px, LOOKED_AT_PX)
}

/// How photographs are reduced, the same for all.
fn reduction(brackets: &[Vec<Photograph>]) -> Option<&Reduction> {
    brackets.iter().flatten().find_map(|p| p.reduction.as_ref())
}

/// Some lattice shots, evenly spaced; board, white and black; and whatever else has a setting that these have not.
fn choose_shots(capture: &Capture, settings: &Settings) -> Vec<usize> {
    let lattice = capture.shots(|p| matches!(p, Pattern::Lattice { .. }));
    let looks = (lattice.len() / LATTICE_SHOTS_PER_LOOK).clamp(LOOKS[0], LOOKS[1]);
    let mut chosen: BTreeSet<usize> = evenly(&lattice, looks).collect();
    chosen.extend(capture.shots(|p| matches!(p, Pattern::Board | Pattern::ReferenceWhite | Pattern::SampleBlack)));
    chosen.extend(evenly(&capture.shots(|p| matches!(p, Pattern::GrayCode { .. })), GRAY_SHOTS));
    let of = |shot: usize| capture.brackets[shot].iter().map(|p| settings.index(p));
    let mut seen: BTreeSet<usize> = chosen.iter().flat_map(|&s| of(s)).collect();
    for shot in 0..capture.brackets.len() {
        if of(shot).any(|s| !seen.contains(&s)) {
            chosen.insert(shot);
            seen.extend(of(shot));
        }
    }
    chosen.into_iter().collect()
}

fn settle_curve(
    capture: &Capture,
    noise: &Noise,
    stacks: &[Stack],
    settings: &Settings,
    sensor: &Sensor,
    file: FileNoise,
    options: &BuildOptions,
) -> Result<CurveEstimate> {
    let times_sd = if options.exposure_from == ExposureFrom::Estimate { DOUBTED_SD } else { NOMINAL_SD };
    let sums = light_sums(capture, settings, sensor)?;
    let options = CurveOptions { times_sd, file };
    estimate_curve(stacks, &sums, settings.secs.len(), noise, &options).ok_or_else(|| {
        let expected =
            "a known response curve: the stacks have too few pixels that two exposures measured to estimate it";
        Error::field(&capture.rig_path, "camera.response", expected, "\"estimate\"")
    })
}

/// Gray-code patterns with their inverses: together they are white and black.
fn light_sums(capture: &Capture, settings: &Settings, sensor: &Sensor) -> Result<Vec<LightSum>> {
    let one = |of: fn(&Pattern) -> bool| capture.shots(of).first().copied();
    let (Some(white), Some(black)) =
        (one(|p| matches!(p, Pattern::ReferenceWhite)), one(|p| matches!(p, Pattern::ReferenceBlack)))
    else {
        return Ok(vec![]);
    };
    let code = |axis: Axis, bit: u32, inverse: bool| {
        // On the frame, black and white of the reference are not its sum.
        let wanted = Pattern::GrayCode { axis, bit, inverse, on: Surface::WhiteReference };
        capture.manifest.shots.iter().position(|s| s.pattern == wanted)
    };
    let pairs: Vec<[usize; 2]> = [Axis::X, Axis::Y]
        .into_iter()
        .flat_map(|axis| {
            let both = (0..16).filter_map(move |bit| Some([code(axis, bit, false)?, code(axis, bit, true)?]));
            both.take(BITS_PER_AXIS)
        })
        .collect();
    let white_bracket = decode(capture, white)?;
    let dark = decode(capture, black)?;
    let dark = dark.merge(dark.rect(), sensor).value;
    let sums: Vec<Vec<LightSum>> = pairs
        .par_iter()
        .map(|pair| {
            let parts = [decode(capture, pair[0])?, decode(capture, pair[1])?];
            let mut sums = Vec::new();
            for (k, photograph) in capture.brackets[white].iter().enumerate() {
                let setting = settings.index(photograph);
                let same = |shot: usize| capture.brackets[shot].iter().position(|p| settings.index(p) == setting);
                let (Some(a), Some(b)) = (same(pair[0]), same(pair[1])) else { continue };
                let all = [&parts[0].exposures()[a], &parts[1].exposures()[b], &white_bracket.exposures()[k]];
                let picked = sum_pixels([&all[0].samples, &all[1].samples, &all[2].samples], sensor);
                let secs = all[2].secs as f32;
                let black = picked.iter().flat_map(|&p| dark[3 * p..3 * p + 3].iter().map(|v| v * secs)).collect();
                let slope = slopes([&all[0].samples, &all[1].samples], &picked, parts[1].rect().width, sensor);
                let [a, b, whole] = all.map(|e| take(&e.samples, &picked));
                sums.push(LightSum { parts: [a, b], whole, black, slope });
            }
            Ok(sums)
        })
        .collect::<Result<_>>()?;
    Ok(sums.into_iter().flatten().collect())
}

/// How much half the difference of two photographs' light, the second less the first, grows from pixel to pixel along
/// their rows and columns, at some pixels, R G B: by differences of the fourth order; not at all beside what is
/// saturated.
fn slopes(samples: [&Samples; 2], picked: &[usize], width: usize, sensor: &Sensor) -> [Vec<f32>; 2] {
    let linear = [0, 1, 2].map(|c| {
        let [pattern, inverse] = samples.map(|s| sensor.linear(s, c));
        pattern.into_iter().zip(inverse).map(|(a, b)| 0.5 * (b - a)).collect::<Vec<f32>>()
    });
    let pixels = linear[0].len();
    [1, width].map(|step| {
        let at = |p: usize, c: usize| {
            // Of four neighbours: with two, a blurred edge's slope is too broad.
            let light = |by: isize| linear[c][p.saturating_add_signed(by * step as isize).min(pixels - 1)];
            let slope = (8.0 * (light(1) - light(-1)) - (light(2) - light(-2))) / 12.0;
            if slope.is_finite() { slope } else { 0.0 }
        };
        picked.iter().flat_map(|&p| [0, 1, 2].map(|c| at(p, c))).collect()
    })
}

/// Lit pixels, half of them where both parts have light.
fn sum_pixels(samples: [&Samples; 3], sensor: &Sensor) -> Vec<usize> {
    let n = samples.map(Samples::len).into_iter().min().unwrap_or(0) / 3;
    let green = samples.map(|s| sensor.linear(s, 1));
    let (mut edges, mut even) = (Vec::new(), Vec::new());
    for p in 0..n {
        let [a, b, whole] = [0, 1, 2].map(|k| green[k][p]);
        // Lit at all: a frame around the target tells nothing.
        if !(a + b + whole).is_finite() || a + b < 0.02 * sensor.full_range() {
            continue;
        }
        if a.min(b) > 0.1 * (a + b) { edges.push(p) } else { even.push(p) }
    }
    let mut picked: Vec<usize> = evenly(&edges, SUM_PIXELS / 2).chain(evenly(&even, SUM_PIXELS / 2)).collect();
    picked.sort_unstable();
    picked
}

/// Saves an estimated curve beside `rig.toml`; a warning when that cannot be written.
pub(super) fn save_curve(capture: &Capture, sensor: &Sensor) -> Option<RadianceWarning> {
    let curve = sensor.curve().filter(|_| capture.rig.camera.response_curve == ResponseCurve::Estimate)?;
    let path = capture.rig_path.with_file_name(CURVE_FILE);
    let refused = curve.write(&path).err()?;
    Some(RadianceWarning::CurveNotSaved { file: path.display().to_string(), reason: refused.to_string() })
}

fn record(
    fit: &ExposureFit,
    settings: &Settings,
    file: FileNoise,
    estimate: Option<&CurveEstimate>,
    options: &BuildOptions,
) -> serde_json::Value {
    let settings: Vec<_> = (0..settings.secs.len())
        .map(|s| {
            serde_json::json!({
                "nominal_secs": settings.secs[s],
                "measured_secs": settings.secs[s] * fit.log_scale[s].exp(),
                "relative_sd": fit.variance[s].sqrt(),
                "group": fit.group[s],
            })
        })
        .collect();
    serde_json::json!({
        "exposure_from": format!("{:?}", options.exposure_from).to_lowercase(),
        "settings": settings,
        "flicker_relative_sd": fit.flicker_sd,
        "compression_variance": file.compression,
        "response": estimate.map(|e| serde_json::json!({
            "per_channel": e.curve.is_per_channel(),
            "relative_sd": e.curve.relative_variance().sqrt(),
            "reduced_chi2": e.reduced_chi2,
            "observations": e.observations,
        })),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_of_light_sums_are_lit_and_half_of_them_show_both_parts() {
        let noise = Noise { black_dn: 0.0, saturation_dn: 200.0, gain_dn_per_electron: 1.0, read_noise_electrons: 1.0 };
        let sensor = Sensor::with_curve(&noise, None, FileNoise::default());
        // Green only counts: an edge (30 and 40), a lit part alone (3 and 70), the dark frame (1 and 2), a saturated
        // one, a second edge.
        let green = [[30u8, 40, 70], [3, 70, 73], [1, 2, 3], [150, 60, 200], [20, 3, 23]];
        let of = |k: usize| Samples::U8(green.iter().flat_map(|g| [255 - g[k], g[k], 0]).collect());
        let samples = [0, 1, 2].map(of);
        assert_eq!(sum_pixels([&samples[0], &samples[1], &samples[2]], &sensor), [0, 1, 4]);
        let none = Samples::U8(vec![]);
        assert!(sum_pixels([&none, &samples[1], &samples[2]], &sensor).is_empty());
    }

    #[test]
    fn shots_are_looked_at_until_every_setting_has_been_seen() {
        let lattice = |k: usize| Pattern::Lattice { dots: vec![[k, 0]] };
        let mut shots: Vec<(Pattern, &[f64])> = (0..40).map(|k| (lattice(k), &[0.1, 0.4][..])).collect();
        shots.push((Pattern::ReferenceBlack, &[0.1]));
        shots.push((Pattern::SampleBlack, &[0.1]));
        shots.push((Pattern::Frame, &[0.1, 1.6]));
        shots.push((Pattern::CalibrationBoard, &[1.6]));
        let capture = super::super::tests::capture(&shots);
        // Eight lattice shots, the middles of eighths; the black of the sample; the first that has 1.6 s.
        let chosen = choose_shots(&capture, &Settings::of(&capture));
        assert_eq!(chosen, [2, 7, 12, 17, 22, 27, 32, 37, 41, 42]);
    }
}
