//! Decoding and merging any shot of a capture; the shots that everything else is measured against.

use super::lattice::Prepared;
use super::radiometry::Radiometry;
use crate::capture::{Capture, Pattern, Photograph, Rect};
use crate::progress::{Progress, Stage};
use crate::radiance::{Bracket, Radiance, Sensor, decode_shot};
use crate::registration::{BitPair, Registration, register_board, register_projector};
use crate::response::Irradiance;
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Mutex, OnceLock};

/// What decoding any shot needs.
pub(super) struct Shots<'a> {
    pub(super) capture: &'a Capture,
    pub(super) sensor: Sensor,
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
    pub(super) fn new(capture: &'a Capture, radiometry: Radiometry) -> Self {
        let [width, height] = capture.rig.camera.size_px;
        let whole = Rect { x: 0, y: 0, width, height };
        Self {
            capture,
            sensor: radiometry.sensor.clone(),
            radiometry,
            whole,
            hashes: Mutex::default(),
            sums: OnceLock::new(),
        }
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
    pub(super) fn register(&self, progress: &Progress) -> Result<Registration> {
        let codes = self.capture.shots(|p| matches!(p, Pattern::GrayCode { .. }));
        let stage = progress.stage("register", 1 + codes.len());
        let board = self.one(|p| matches!(p, Pattern::Board))?;
        // Finding the board's corners runs on one core: the other decodes stripes meanwhile.
        let (camera, pairs) = rayon::join(
            || {
                let picture = self.merge_whole(board)?;
                stage.advance(1);
                register_board(&picture, &self.capture.rig).map_err(self.failed(board))
            },
            || self.bit_pairs(&codes, &stage),
        );
        let (camera, pairs) = (camera?, pairs?);
        let sum = |p: &BitPair| p.pattern.iter().zip(&p.inverse).step_by(SUM_STEP).map(|(a, b)| a + b).collect();
        self.sums.get_or_init(|| pairs.iter().map(sum).collect());
        let first = codes[0];
        let projector =
            register_projector(&pairs, self.capture.rig.camera.size_px, &camera.view).map_err(self.failed(first))?;
        Registration::new(&camera, &projector, self.capture.manifest.slab.size_mm)
            .ok_or_else(|| self.failed(first)("the projector's map cannot be inverted".into()))
    }

    fn bit_pairs(&self, codes: &[usize], stage: &Stage<'_>) -> Result<Vec<BitPair>> {
        let mut pairs: BTreeMap<(usize, u32), [Option<usize>; 2]> = BTreeMap::new();
        for &s in codes {
            if let Pattern::GrayCode { axis, bit, inverse } = self.capture.manifest.shots[s].pattern {
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
                let light = |s: usize| Ok::<_, Error>(self.merge_whole(s)?.luminance());
                let pair = BitPair { axis, bit, pattern: light(pattern)?, inverse: light(inverse)? };
                stage.advance(2);
                Ok(pair)
            })
            .collect()
    }

    /// Ambient light and irradiance.
    pub(super) fn prepare(self, registration: Registration, progress: &Progress) -> Result<Prepared<'a>> {
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
        let px_per_mm = {
            let j = registration.view.jacobian(registration.center_mm);
            (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs().sqrt()
        };
        let cell_px = px_per_mm * self.capture.manifest.window.pitch_mm;
        let irradiance = Irradiance::new(white, &self.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
        if let Some(sd) = self.radiometry.flicker_sd {
            // One shot's lamp, the same error in all pixels of a cell: that many times what averaging them would leave.
            let share = sd * sd / self.capture.brackets[shots[0]].len() as f64 * cell_px * cell_px;
            let values = ambient.variance.iter_mut().zip(&ambient.value);
            values.for_each(|(variance, value)| *variance += share as f32 * value * value);
        }
        Ok(Prepared {
            shots: self,
            registration,
            ambient,
            irradiance,
            white_variance,
            flicker: None,
            px_per_mm,
            cell_px,
        })
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
