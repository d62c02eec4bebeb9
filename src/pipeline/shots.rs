//! Decoding and merging any shot of a capture; the shots that everything else is measured against.

use super::lattice::Prepared;
use super::noise::FoundNoise;
use super::radiometry::Radiometry;
use crate::capture::{Board, Capture, Pattern, Photograph, Rect, Surface};
use crate::geometry::{CameraView, Lens, Point};
use crate::progress::{Progress, Stage};
use crate::radiance::{Bracket, Radiance, Sensor, StrayLight, decode_shot, find_hot_pixels, mend};
use crate::registration::{
    BitPair, FrameFit, LensChoice, Pairs, PointSpread, Registration, StripeSurface, ViewFit, find_board,
    fit_lens_of_views, marks_moved, measure_point_spread, register_frame, register_projector,
};
use crate::response::Irradiance;
use crate::{Error, Result, Warning};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock};

/// What decoding any shot needs.
pub(super) struct Shots<'a> {
    pub(super) capture: &'a Capture,
    pub(super) sensor: Sensor,
    pub(super) noise: FoundNoise,
    pub(super) radiometry: Radiometry,
    whole: Rect,
    pub(super) hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
    /// Light of each Gray-code pattern and its inverse together, every [`SUM_STEP`]th pixel: white, but for the lamp.
    sums: OnceLock<Vec<Vec<f32>>>,
}

/// A few thousand pixels tell the lamp's change to a hundredth of a per cent.
const SUM_STEP: usize = 13;
/// Pixels this bright, of the brightest, are lit.
const LIT_SHARE: f32 = 0.3;

impl<'a> Shots<'a> {
    pub(super) fn new(capture: &'a Capture, noise: FoundNoise, radiometry: Radiometry) -> Self {
        let [width, height] = capture.rig.camera.size_px;
        let whole = Rect { x: 0, y: 0, width, height };
        let sensor = radiometry.sensor.clone();
        Self { capture, sensor, noise, radiometry, whole, hashes: Mutex::default(), sums: OnceLock::new() }
    }

    /// Decodes a shot and keeps the pixels of `rects`.
    pub(super) fn decode(&self, shot: usize, rects: &[Rect]) -> Result<Vec<Bracket>> {
        let remember = |p: &Photograph, hash| {
            if let Ok(mut hashes) = self.hashes.lock() {
                hashes.insert(p.path.clone(), hash);
            }
        };
        decode_shot(&self.capture.brackets[shot], rects, self.capture.rig.camera.size_px, &remember)
    }

    pub(super) fn merge_whole(&self, shot: usize) -> Result<Radiance> {
        let brackets = self.decode(shot, &[self.whole])?;
        let bracket = brackets.first().ok_or_else(|| Error::internal("a shot decoded to nothing"))?;
        Ok(bracket.merge(self.whole, &self.sensor))
    }

    fn one(&self, of: fn(&Pattern) -> bool) -> Result<usize> {
        self.capture.shots(of).first().copied().ok_or_else(|| Error::internal("a checked capture lacks a shot"))
    }

    pub(super) fn failed(&self, shot: usize) -> impl Fn(String) -> Error {
        let path = self.capture.brackets[shot].last().map_or_else(|| self.capture.manifest_path(), |p| p.path.clone());
        let shot = self.capture.manifest.shots[shot].name.clone();
        move |reason| Error::Registration { path: path.clone(), shot: shot.clone(), reason }
    }

    /// Camera from the board, projector from the Gray code.
    pub(super) fn register(&self, progress: &Progress) -> Result<(Registration, Vec<Warning>)> {
        let codes = self.capture.shots(|p| matches!(p, Pattern::GrayCode { .. }));
        let stage = progress.stage("register", 1 + codes.len());
        // Finding the board's corners runs on one core: the other decodes stripes meanwhile.
        let (camera, pairs) = rayon::join(
            || {
                let found = self.camera_view();
                stage.advance(1);
                found
            },
            || self.bit_pairs(&codes, &stage),
        );
        let ((camera, choice, point_spread, warnings), pairs) = (camera?, pairs?);
        let sum = |p: &BitPair| p.pattern.iter().zip(&p.inverse).step_by(SUM_STEP).map(|(a, b)| a + b).collect();
        self.sums.get_or_init(|| pairs.iter().map(sum).collect());
        let first = codes[0];
        let rig = &self.capture.rig;
        // Coefficients of the lens count in widths of the image: its focal length is not known, and need not be.
        let lens = Lens::ideal(rig.projector.lens_center_px(), rig.projector.size_px[0] as f64);
        let surface = self.stripe_surface(&codes)?;
        let projector =
            register_projector(&pairs, rig.camera.size_px, &camera.view, surface, lens).map_err(self.failed(first))?;
        let size_mm = self.capture.manifest.slab.size_mm;
        Registration::new(&camera, choice, point_spread, &projector, size_mm)
            .map(|r| (r, warnings))
            .ok_or_else(|| self.failed(first)("the projector's map cannot be inverted".into()))
    }

    /// The board gives a plane, the frame's marks the plane as the sample really lies; the lens is fitted to all of them together, and to
    /// boards in other poses where there are any.
    fn camera_view(&self) -> Result<(ViewFit, LensChoice, Option<PointSpread>, Vec<Warning>)> {
        let rig = &self.capture.rig;
        let camera = &rig.camera;
        let mut warnings = Vec::new();
        let (mut planes, mut has_board): (Vec<Pairs>, bool) = (Vec::new(), false);
        let mut sharp: Option<(Radiance, &Board)> = None;
        for calibrating in [false, true] {
            let kind = |p: &Pattern| if calibrating { *p == Pattern::CalibrationBoard } else { *p == Pattern::Board };
            for shot in self.capture.shots(kind) {
                let Some(board) = &rig.board else { continue };
                let picture = self.merge_whole(shot)?;
                planes.push(find_board(&picture, board, camera).map_err(self.failed(shot))?);
                sharp.get_or_insert((picture, board));
                has_board |= !calibrating;
            }
        }
        let lens_of = |planes: &[Pairs]| fit_lens_of_views(planes, camera.principal_px, camera.focal_px);
        let mut fits = lens_of(&planes);
        let prior = fits.as_ref().filter(|_| has_board).map(|(fits, _)| fits[0].view);
        let mut first: Option<FrameFit> = None;
        for shot in self.capture.shots(|p| *p == Pattern::Frame) {
            let Some(marks) = &rig.frame else { continue };
            let picture = self.merge_whole(shot)?;
            let found = register_frame(&picture, marks, prior.as_ref(), camera).map_err(self.failed(shot))?;
            let name = self.capture.manifest.shots[shot].name.clone();
            match &first {
                None => {
                    planes.insert(0, found.pairs(marks));
                    fits = lens_of(&planes);
                    first = Some(found);
                }
                Some(before) => {
                    let moved = marks_moved(before, &found);
                    let beyond = |(m, sd): &(Point, f64)| m[0].hypot(m[1]) > (5.0 * sd).max(0.05);
                    let told = |(moved_px, sd_px)| Warning::FrameMoved { shot: name, moved_px, sd_px };
                    warnings.extend(moved.filter(beyond).map(told));
                }
            }
        }
        let (fits, choice) = fits.ok_or_else(|| {
            Error::field(
                &self.capture.rig_path,
                "board or frame.marks_mm",
                "points that span a plane",
                "too few or on a line",
            )
        })?;
        if first.is_some() && has_board {
            warnings.extend(self.board_elsewhere(&fits[1].view, &fits[0]));
        }
        // Boards come after the frame; the first of them, in the sample's plane if there is one, tells how sharp the picture is.
        let seen = &fits[usize::from(first.is_some() && fits.len() > 1)].view;
        let point_spread = sharp.and_then(|(picture, board)| measure_point_spread(&picture, board, seen));
        Ok((fits[0], choice, point_spread, warnings))
    }

    /// Whether board and frame disagree about where the slab's corners are seen.
    fn board_elsewhere(&self, board: &CameraView, frame: &ViewFit) -> Option<Warning> {
        let [w, h] = self.capture.manifest.slab.size_mm;
        let off = |p: Point| {
            let (a, b) = (board.camera_from_slab(p), frame.view.camera_from_slab(p));
            (a[0] - b[0]).hypot(a[1] - b[1])
        };
        let largest_px = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(off).into_iter().fold(0.0, f64::max);
        (largest_px > (5.0 * frame.sd_px).max(0.2)).then_some(Warning::BoardElsewhere { largest_px })
    }

    /// What the Gray code was projected on: all of it on the same.
    fn stripe_surface(&self, codes: &[usize]) -> Result<StripeSurface> {
        let manifest = &self.capture.manifest;
        let of = |s: usize| match manifest.shots[s].pattern {
            Pattern::GrayCode { on, .. } => on,
            _ => Surface::default(),
        };
        if let Some(&other) = codes.iter().find(|&&s| of(s) != of(codes[0])) {
            let (field, first) =
                (format!("shots \"{}\": on", manifest.shots[other].name), &manifest.shots[codes[0]].name);
            let expected = format!("the surface of shot \"{first}\": one for the whole Gray code");
            return Err(Error::field(self.capture.manifest_path(), field, expected, "another"));
        }
        Ok(match of(codes[0]) {
            Surface::WhiteReference => StripeSurface::White,
            Surface::Frame => StripeSurface::Frame(manifest.slab.size_mm),
        })
    }

    fn bit_pairs(&self, codes: &[usize], stage: &Stage<'_>) -> Result<Vec<BitPair>> {
        let mut pairs: BTreeMap<(usize, u32), [Option<usize>; 2]> = BTreeMap::new();
        for &s in codes {
            if let Pattern::GrayCode { axis, bit, inverse, .. } = self.capture.manifest.shots[s].pattern {
                let slot = &mut pairs.entry((axis as usize, bit)).or_default()[usize::from(inverse)];
                if slot.replace(s).is_some() {
                    return Err(self.failed(s)("this bit of the Gray code was shot twice".into()));
                }
            }
        }
        let pairs: Vec<_> = pairs.into_iter().collect();
        pairs
            .into_par_iter()
            .map(|((axis, bit), shots)| {
                let [Some(pattern), Some(inverse)] = shots else {
                    let shot = shots.into_iter().flatten().next().unwrap_or(codes[0]);
                    return Err(self.failed(shot)("each bit of the Gray code needs its inverse".into()));
                };
                let (pattern, inverse) = (self.merge_whole(pattern)?, self.merge_whole(inverse)?);
                let used = pattern.used.as_chunks::<3>().0.iter().zip(inverse.used.as_chunks::<3>().0);
                let valid = used.map(|(a, b)| !a.contains(&0) && !b.contains(&0)).collect();
                let pair = BitPair { axis, bit, pattern: pattern.luminance(), inverse: inverse.luminance(), valid };
                stage.advance(2);
                Ok(pair)
            })
            .collect()
    }

    /// Ambient light and irradiance.
    pub(super) fn prepare(
        self,
        registration: Registration,
        registration_warnings: Vec<Warning>,
        progress: &Progress,
    ) -> Result<Prepared<'a>> {
        let stage = progress.stage("reference", 3);
        let shots = [
            self.one(|p| matches!(p, Pattern::SampleBlack))?,
            self.one(|p| matches!(p, Pattern::ReferenceWhite))?,
            self.one(|p| matches!(p, Pattern::ReferenceBlack))?,
        ];
        let mut merged: Vec<Radiance> =
            shots.par_iter().map(|&s| self.merge_whole(s).inspect(|_| stage.advance(1))).collect::<Result<_>>()?;
        let (Some(black), Some(mut white), Some(mut ambient)) = (merged.pop(), merged.pop(), merged.pop()) else {
            return Err(Error::internal("three shots merged to fewer"));
        };
        let white_variance = self.radiometry.flicker_sd.and_then(|_| self.steady_white(&mut white, &black));
        white.subtract(&black);
        let hot = find_hot_pixels(&ambient);
        mend(&mut white, &hot);
        let px_per_mm = registration.px_per_mm();
        let cell_px = px_per_mm * self.capture.manifest.window.pitch_mm;
        let irradiance = Irradiance::new(white, &self.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
        if let Some(sd) = self.radiometry.flicker_sd {
            // One shot's lamp, the same error in all pixels of a cell: that many times what averaging them would leave.
            let share = sd * sd / self.capture.brackets[shots[0]].len() as f64 * cell_px * cell_px;
            let values = ambient.variance.iter_mut().zip(&ambient.value);
            values.for_each(|(variance, value)| *variance += share as f32 * value * value);
        }
        let mut prepared = Prepared {
            shots: self,
            registration,
            registration_warnings,
            ambient,
            hot,
            irradiance,
            stray: StrayLight::default(),
            white_variance,
            flicker: None,
            px_per_mm,
            cell_px,
        };
        prepared.stray = prepared.measure_stray(progress)?;
        Ok(prepared)
    }

    /// Scales the white reference to the lamp's mean over the Gray-code shots: each with its inverse adds up to white and black. Returns the
    /// relative variance that remains; `None`, and nothing done, with fewer than three such sums.
    ///
    /// The median over pixels, so that those that some exposure did not measure do not matter.
    fn steady_white(&self, white: &mut Radiance, black: &Radiance) -> Option<f64> {
        let (light, dark) = (white.luminance(), black.luminance());
        let brightest = light.iter().copied().fold(0.0, f32::max);
        let lit: Vec<usize> =
            (0..light.len()).step_by(SUM_STEP).filter(|&p| light[p] > LIT_SHARE * brightest).collect();
        let ratio = |sum: &Vec<f32>| {
            let mut all: Vec<f32> = lit.iter().map(|&p| (sum[p / SUM_STEP] - dark[p]) / light[p]).collect();
            let middle = all.len() / 2;
            (!all.is_empty()).then(|| f64::from(*all.select_nth_unstable_by(middle, f32::total_cmp).1))
        };
        let ratios: Vec<f64> = self.sums.get()?.iter().map(ratio).collect::<Option<_>>()?;
        let n = ratios.len() as f64;
        if ratios.len() < 3 {
            return None;
        }
        let mean = ratios.iter().sum::<f64>() / n;
        let variance = ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (n - 1.0) / n;
        // A tenth is no flicker: something else differs.
        if !((mean - 1.0).abs() < 0.1) {
            return None;
        }
        white.value.iter_mut().for_each(|v| *v *= mean as f32);
        white.variance.iter_mut().for_each(|v| *v *= (mean * mean) as f32);
        Some(variance)
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::capture;
    use super::*;
    use crate::capture::Noise;
    use crate::radiance::FileNoise;

    const BLACK: f32 = 3.0;

    fn shots(capture: &Capture) -> Shots<'_> {
        let noise =
            Noise { black_dn: 100.0, saturation_dn: 4000.0, gain_dn_per_electron: 0.5, read_noise_electrons: 4.0 };
        let sensor = Sensor::with_curve(&noise, None, FileNoise::default());
        let found = FoundNoise { noise, estimate: None, from_rig: true, warnings: vec![] };
        let radiometry =
            Radiometry { sensor, flicker_sd: Some(0.01), warnings: vec![], record: serde_json::Value::Null };
        Shots::new(capture, found, radiometry)
    }

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

    /// What the lamp at `levels` makes of the sums of pattern and inverse.
    fn steadied(levels: &[f32]) -> (Radiance, Option<f64>) {
        let capture = capture(&[]);
        let shots = shots(&capture);
        // White is seen with the black; a sum holds it twice.
        let sum = |level: &f32| {
            (0..187).step_by(SUM_STEP).map(|p| (light(p) * level + BLACK) * if p == 26 { 40.0 } else { 1.0 }).collect()
        };
        shots.sums.set(levels.iter().map(sum).collect()).unwrap();
        let mut white = picture(light, 2.0);
        let variance = shots.steady_white(&mut white, &picture(|_| BLACK, 1.0));
        (white, variance)
    }

    #[test]
    fn the_white_reference_is_brought_to_the_lamps_mean_over_the_gray_code() {
        let (white, variance) = steadied(&[1.02, 1.05, 0.99, 1.06]);
        // Mean 1.03; of four deviations −1, 2, −4, 3 per cent, Σ² / 3 / 4. One pixel that is wrong in all of them is not the median's.
        assert!((variance.unwrap() / (30e-4 / 12.0) - 1.0).abs() < 1e-3, "{variance:?}");
        for (found, before) in white.value.iter().zip(picture(light, 2.0).value) {
            // f32.
            assert!((found / before - 1.03).abs() < 1e-5);
        }
        assert!(white.variance.iter().all(|v| (v / 2.0 - 1.03 * 1.03).abs() < 1e-5));
    }

    #[test]
    fn fewer_than_three_sums_or_a_tenth_of_difference_leave_the_white_reference_as_it_is() {
        for levels in [&[1.02f32, 1.05][..], &[1.2, 1.1, 1.15], &[0.85, 0.8, 0.9], &[]] {
            let (white, variance) = steadied(levels);
            assert_eq!((white, variance), (picture(light, 2.0), None), "{levels:?}");
        }
        assert!(steadied(&[1.09, 1.08, 1.1]).1.is_some());
    }
}
