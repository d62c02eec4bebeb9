//! Reading the shots of a capture: decoded, merged, by the exposure times and the sensor that radiometry found.

use super::radiometry::Radiometry;
use crate::capture::{Camera, Capture, Pattern, Photograph, Rect, Reduction, Samples};
use crate::files::FileState;
use crate::geometry::{CameraView, Homography, Lens};
use crate::radiance::{
    Bracket, Brightness, Disagreement, Exposure, Radiance, Sensor, decode_shot, disagreements, merge_keeping,
    merge_shot, pile_up,
};
use crate::{Error, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Mutex;

/// A capture's photographs with what decoding any shot needs.
pub(super) struct Photographs<'a> {
    pub(super) capture: &'a Capture,
    /// Photographs of each shot with their actual exposure times, shortest first.
    pub(super) brackets: &'a [Vec<Photograph>],
    radiometry: &'a Radiometry,
    pub(super) sensor: Sensor,
    /// Board and frame are read finer.
    pub(super) fine: Fine<'a>,
    /// BLAKE3 of every file that was read.
    hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
    /// Photographs that do not show what the others of their shot show, by shot and place in its bracket: left out from
    /// then on, unless another one may be the wrong one as well.
    strangers: Mutex<BTreeMap<[usize; 2], Disagreement>>,
    /// Where the code values of photographs pile up below saturation, DN, by shot and place.
    piles: Mutex<BTreeMap<[usize; 2], f64>>,
}

/// What the photographs of one shot have said: their BLAKE3, and what was found of them by their places in its bracket.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct Said {
    hashes: Vec<String>,
    strangers: Vec<(usize, Disagreement)>,
    piles: Vec<(usize, f64)>,
}

/// What all photographs that were read have said: see the fields of [`Photographs`].
#[derive(Debug, Clone, serde::Serialize, serde::Deserialize)]
pub(super) struct Heard {
    hashes: Vec<(PathBuf, String)>,
    strangers: Vec<([usize; 2], Disagreement)>,
    piles: Vec<([usize; 2], f64)>,
}

/// Pixels of a shot in which its photographs are compared.
const COMPARED_PX: usize = 1 << 14;

/// The resolution in which corners and discs are found: to some hundredths of its pixels, whatever these are.
pub(super) struct Fine<'a> {
    /// The camera as it is.
    full: &'a Capture,
    sensor: Sensor,
    factor: usize,
    /// Pixels of the blocks of the working resolution.
    working: usize,
}

/// Pixels of a picture in which corners and discs are found, at the most, unless the working resolution has more.
const FINE_PX: usize = 1 << 22;

impl<'a> Fine<'a> {
    fn new(full: &'a Capture, radiometry: &'a Radiometry, working: usize) -> Self {
        let pixels: usize = full.rig.camera.size_px.iter().product();
        let factor = ((pixels as f64 / FINE_PX as f64).sqrt().ceil() as usize).clamp(1, working);
        Self { full, sensor: radiometry.sensor_of(factor), factor, working }
    }

    pub(super) fn camera(&self) -> Camera {
        self.full.rig.camera.reduced(self.factor)
    }

    /// Pixels of the working resolution in one of this.
    pub(super) fn scale(&self) -> f64 {
        self.factor as f64 / self.working as f64
    }

    /// A view in pixels of the working resolution.
    pub(super) fn view(&self, view: &CameraView) -> CameraView {
        let scale = self.scale();
        // Centres of first pixels, in those of the camera: half a block less half a pixel.
        let shift = 0.5 * (self.factor as f64 - self.working as f64) / self.working as f64;
        let lens = Lens {
            center_px: view.lens.center_px.map(|c| scale * c + shift),
            focal_px: scale * view.lens.focal_px,
            ..view.lens
        };
        CameraView { ideal_from_slab: Homography::similarity(scale, [shift; 2]).after(&view.ideal_from_slab), lens }
    }
}

impl<'a> Photographs<'a> {
    /// Relative variance that the light of all rows has in common: by code values and by exposure times.
    pub(super) fn light_variance(&self) -> f64 {
        self.sensor.codes_variance() + self.radiometry.scale_variance
    }

    /// `full` is the capture as it was taken, `capture` the same in the working resolution.
    pub(super) fn new(full: &'a Capture, capture: &'a Capture, radiometry: &'a Radiometry, working: usize) -> Self {
        let fine = Fine::new(full, radiometry, working);
        Self {
            capture,
            brackets: &radiometry.brackets,
            radiometry,
            sensor: radiometry.sensor(),
            fine,
            hashes: Mutex::default(),
            strangers: Mutex::default(),
            piles: Mutex::default(),
        }
    }

    /// The merged picture of a shot in the finer resolution.
    pub(super) fn merge_fine(&self, shot: usize) -> Result<Radiance> {
        let fine = |p: &Photograph| {
            let reduction = p.reduction.clone().map(|by| Reduction { factor: self.fine.factor, ..by });
            Photograph { reduction, ..p.clone() }
        };
        self.merge(shot, fine, self.fine.camera().size_px, &self.fine.sensor)
    }

    /// The merged picture of a shot.
    pub(super) fn merge_whole(&self, shot: usize) -> Result<Radiance> {
        self.merge(shot, Photograph::clone, self.capture.rig.camera.size_px, &self.sensor)
    }

    fn merge(
        &self,
        shot: usize,
        read: impl Fn(&Photograph) -> Photograph,
        size_px: [usize; 2],
        sensor: &Sensor,
    ) -> Result<Radiance> {
        loop {
            let kept = self.kept(shot)?;
            let bracket: Vec<Photograph> = kept.iter().map(|&k| read(&self.brackets[shot][k])).collect();
            let (merged, rows) = merge_keeping(&bracket, size_px, sensor, COMPARED_PX)?;
            if self.compare(shot, &kept, &[rows.exposures()], sensor)?.is_empty() {
                self.remember(shot)?;
                return Ok(merged);
            }
        }
    }

    /// Decodes a shot and keeps the pixels of `rects`.
    pub(super) fn decode(&self, shot: usize, rects: &[Rect]) -> Result<Vec<Bracket>> {
        let kept = self.kept(shot)?;
        let bracket: Vec<Photograph> = kept.iter().map(|&k| self.brackets[shot][k].clone()).collect();
        let mut brackets = decode_shot(&bracket, rects, self.capture.rig.camera.size_px)?;
        let parts: Vec<&[Exposure]> = brackets.iter().map(Bracket::exposures).collect();
        for place in self.compare(shot, &kept, &parts, &self.sensor)?.into_iter().rev() {
            brackets.iter_mut().for_each(|b| b.leave_out(place));
        }
        self.remember(shot)?;
        Ok(brackets)
    }

    /// No stage reads this shot again.
    pub(super) fn done_with(&self, shot: usize) {
        self.brackets[shot].iter().for_each(|p| p.kept.forget_file(&p.path));
    }

    /// Places of a shot's bracket that are not left out.
    fn kept(&self, shot: usize) -> Result<Vec<usize>> {
        let strangers = self.strangers.lock().map_err(Error::internal)?;
        let out = |k: usize| strangers.get(&[shot, k]).is_some_and(|s| s.or.is_none());
        Ok((0..self.brackets[shot].len()).filter(|&k| !out(k)).collect())
    }

    /// Compares the photographs of a shot, those at the places `kept` of its bracket, in some rectangles; returns which
    /// of `kept` are to be left out.
    fn compare(&self, shot: usize, kept: &[usize], parts: &[&[Exposure]], sensor: &Sensor) -> Result<BTreeSet<usize>> {
        for (j, &place) in kept.iter().enumerate() {
            let own: Vec<&Samples> = parts.iter().map(|p| &p[j].samples).collect();
            if let Some(code) = pile_up(&own, sensor) {
                self.piles.lock().map_err(Error::internal)?.insert([shot, place], code);
            }
        }
        let samples: usize = parts.iter().filter_map(|p| p.first()).map(|e| e.samples.len()).sum();
        let log_scale: Vec<f64> = kept.iter().map(|&k| self.radiometry.unapplied_log_scale(shot, k)).collect();
        let brightness = Brightness { log_scale: &log_scale, tolerance: self.radiometry.brightness_tolerance() };
        let found = disagreements(parts, sensor, samples.div_ceil(3 * COMPARED_PX), brightness);
        if found.is_empty() {
            return Ok(BTreeSet::new());
        }
        let mut strangers = self.strangers.lock().map_err(Error::internal)?;
        for d in &found {
            let stranger = Disagreement { photograph: kept[d.photograph], or: d.or.map(|k| kept[k]), ..d.clone() };
            strangers.insert([shot, stranger.photograph], stranger);
        }
        Ok(found.into_iter().filter(|d| d.or.is_none()).map(|d| d.photograph).collect())
    }

    /// Photographs that do not show what the others of their shot show, by shot and place in its bracket.
    pub(super) fn strangers(&self) -> Result<BTreeMap<[usize; 2], Disagreement>> {
        Ok(self.strangers.lock().map_err(Error::internal)?.clone())
    }

    /// Where the code values of photographs pile up below saturation, DN, by shot and place in its bracket.
    pub(super) fn piles(&self) -> Result<BTreeMap<[usize; 2], f64>> {
        Ok(self.piles.lock().map_err(Error::internal)?.clone())
    }

    /// The picture of one photograph of a shot, or of all others.
    pub(super) fn merge_some(&self, shot: usize, of: impl Fn(usize) -> bool) -> Result<Radiance> {
        let bracket: Vec<Photograph> =
            self.brackets[shot].iter().enumerate().filter(|(k, _)| of(*k)).map(|(_, p)| p.clone()).collect();
        merge_shot(&bracket, self.capture.rig.camera.size_px, &self.sensor)
    }

    /// A photograph of a shot as it was taken, and its size.
    pub(super) fn as_taken(&self, shot: usize, place: usize) -> (Photograph, [usize; 2]) {
        let photograph = Photograph { reduction: None, ..self.brackets[shot][place].clone() };
        (photograph, self.fine.full.rig.camera.size_px)
    }

    /// Hashes the files of a shot that were not hashed before. After they were decoded: what was read of an object is
    /// hashed then.
    fn remember(&self, shot: usize) -> Result<()> {
        for photograph in &self.brackets[shot] {
            let known = self.hashes.lock().map_err(Error::internal)?.contains_key(&photograph.path);
            if !known {
                let hash = photograph.hash()?;
                self.hashes.lock().map_err(Error::internal)?.insert(photograph.path.clone(), hash);
            }
        }
        Ok(())
    }

    /// All that was heard so far.
    pub(super) fn heard(&self) -> Result<Heard> {
        Ok(Heard {
            hashes: self.hashes()?.into_iter().map(|(path, hash)| (path, hash.to_hex().to_string())).collect(),
            strangers: self.strangers()?.into_iter().collect(),
            piles: self.piles()?.into_iter().collect(),
        })
    }

    /// Takes what was heard before for its own.
    pub(super) fn hear(&self, heard: &Heard) -> Result<()> {
        let hash = |(path, hash): &(PathBuf, String)| {
            blake3::Hash::from_hex(hash).map(|hash| (path.clone(), hash)).map_err(Error::internal)
        };
        let hashes: Vec<_> = heard.hashes.iter().map(hash).collect::<Result<_>>()?;
        self.hashes.lock().map_err(Error::internal)?.extend(hashes);
        self.strangers.lock().map_err(Error::internal)?.extend(heard.strangers.iter().cloned());
        self.piles.lock().map_err(Error::internal)?.extend(heard.piles.iter().copied());
        Ok(())
    }

    /// What the photographs of a shot have said so far, by their places in its bracket.
    pub(super) fn said(&self, shot: usize) -> Result<Said> {
        let of = |shot: usize| [shot, 0]..=[shot, usize::MAX];
        let strangers = self.strangers.lock().map_err(Error::internal)?;
        let piles = self.piles.lock().map_err(Error::internal)?;
        Ok(Said {
            hashes: self.hashes_of(shot)?,
            strangers: strangers.range(of(shot)).map(|(key, d)| (key[1], d.clone())).collect(),
            piles: piles.range(of(shot)).map(|(key, code)| (key[1], *code)).collect(),
        })
    }

    /// Takes what a stopped run or a task has heard of a shot's photographs; says whether they are the same photographs.
    /// They are read again unless their files are still as in `files`.
    pub(super) fn repeat(&self, shot: usize, said: &Said, files: &[FileState]) -> Result<bool> {
        match files.is_empty() || self.file_states(shot)? != files {
            true => self.remember(shot)?,
            false => {
                let hashes = said.hashes.iter().filter_map(|hash| blake3::Hash::from_hex(hash).ok());
                let read = self.brackets[shot].iter().map(|p| p.path.clone()).zip(hashes);
                self.hashes.lock().map_err(Error::internal)?.extend(read);
            }
        }
        if self.hashes_of(shot)? != said.hashes {
            return Ok(false);
        }
        let strangers = said.strangers.iter().map(|(k, d)| ([shot, *k], d.clone()));
        self.strangers.lock().map_err(Error::internal)?.extend(strangers);
        self.piles.lock().map_err(Error::internal)?.extend(said.piles.iter().map(|(k, code)| ([shot, *k], *code)));
        Ok(true)
    }

    /// The files of a shot's photographs as they are now.
    pub(super) fn file_states(&self, shot: usize) -> Result<Vec<FileState>> {
        let state = |photograph: &Photograph| {
            crate::files::state(&photograph.path).map_err(Error::io("read", &photograph.path))
        };
        self.brackets[shot].iter().map(state).collect()
    }

    fn hashes_of(&self, shot: usize) -> Result<Vec<String>> {
        let hashes = self.hashes.lock().map_err(Error::internal)?;
        Ok(self.brackets[shot].iter().filter_map(|p| hashes.get(&p.path)).map(|h| h.to_hex().to_string()).collect())
    }

    /// The first shot of a pattern that a checked capture has.
    pub(super) fn one(&self, of: fn(&Pattern) -> bool) -> Result<usize> {
        self.capture.shots(of).first().copied().ok_or_else(|| Error::internal("a checked capture lacks a shot"))
    }

    pub(super) fn name(&self, shot: usize) -> &str {
        &self.capture.manifest.shots[shot].name
    }

    /// Registration of a shot failed.
    pub(super) fn failed(&self, shot: usize) -> impl Fn(String) -> Error {
        let path = self.brackets[shot].last().map_or_else(|| self.capture.manifest_path(), |p| p.path.clone());
        let shot = self.name(shot).to_owned();
        move |reason| Error::Registration { path: path.clone(), shot: shot.clone(), reason }
    }

    /// The hashes of all files that were read.
    pub(super) fn hashes(&self) -> Result<BTreeMap<PathBuf, blake3::Hash>> {
        Ok(self.hashes.lock().map_err(Error::internal)?.clone())
    }

    /// One hash of all files that were read, in the order of their names.
    pub(super) fn hash(&self) -> Result<blake3::Hash> {
        let mut all = blake3::Hasher::new();
        for hash in self.hashes.lock().map_err(Error::internal)?.values() {
            all.update(hash.as_bytes());
        }
        Ok(all.finalize())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::capture;
    use super::*;
    use crate::capture::Noise;
    use crate::radiance::FileNoise;

    #[test]
    fn a_view_that_was_found_in_small_pixels_sees_points_in_the_large_pixels_that_hold_them() {
        let mut full = capture(&[]);
        full.rig.camera.size_px = [9000, 7000];
        let noise = Noise { black_dn: 1.0, saturation_dn: 9e3, gain_dn_per_electron: 0.5, read_noise_electrons: 2.0 };
        let sensor = Sensor::with_curve(&noise, None, FileNoise::default());
        // 63 million pixels in four: blocks of 4.
        let fine = Fine { full: &full, sensor, factor: 4, working: 11 };
        assert_eq!(fine.camera().size_px, [2250, 1750]);
        let matrix = [[40.0, 3.0, 100.0], [-2.0, 41.0, 200.0], [1e-3, -2e-3, 1.0]];
        let lens = Lens { center_px: [1120.0, 880.0], focal_px: 3000.0, k1: -0.06, k2: 0.012 };
        let view = CameraView { ideal_from_slab: Homography { matrix }, lens };
        let coarse = fine.view(&view);
        for p in [[0.0, 0.0], [30.0, 5.0], [12.0, 21.0]] {
            let (a, b) = (view.camera_from_slab(p), coarse.camera_from_slab(p));
            for k in 0..2 {
                // Places in the camera's own pixels.
                assert!((4.0 * a[k] + 1.5 - (11.0 * b[k] + 5.0)).abs() < 1e-8, "{a:?} {b:?}");
            }
        }
    }
}
