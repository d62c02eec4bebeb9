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
use std::sync::Mutex;

/// What decoding any shot needs.
pub(super) struct Shots<'a> {
    pub(super) capture: &'a Capture,
    pub(super) sensor: Sensor,
    pub(super) radiometry: Radiometry,
    whole: Rect,
    pub(super) hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
}

impl<'a> Shots<'a> {
    pub(super) fn new(capture: &'a Capture, radiometry: Radiometry) -> Self {
        let [width, height] = capture.rig.camera.size_px;
        let whole = Rect { x: 0, y: 0, width, height };
        Self { capture, sensor: radiometry.sensor.clone(), radiometry, whole, hashes: Mutex::default() }
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
        let (Some(black), Some(mut white), Some(ambient)) = (merged.pop(), merged.pop(), merged.pop()) else {
            return Err(Error::internal("three shots merged to fewer"));
        };
        white.subtract(&black);
        let px_per_mm = {
            let j = registration.view.jacobian(registration.center_mm);
            (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs().sqrt()
        };
        let cell_px = px_per_mm * self.capture.manifest.window.pitch_mm;
        let irradiance = Irradiance::new(white, &self.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
        Ok(Prepared { shots: self, registration, ambient, irradiance, px_per_mm, cell_px })
    }
}
