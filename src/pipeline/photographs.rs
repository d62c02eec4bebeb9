//! Reading the shots of a capture: decoded, merged, by the exposure times and the sensor that radiometry found.

use super::radiometry::Radiometry;
use crate::capture::{Camera, Capture, Pattern, Photograph, Rect, Reduction};
use crate::geometry::{CameraView, Homography, Lens};
use crate::radiance::{Bracket, Radiance, Sensor, decode_shot, merge_shot};
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;

/// A capture's photographs with what decoding any shot needs.
pub(super) struct Photographs<'a> {
    pub(super) capture: &'a Capture,
    /// Photographs of each shot with their actual exposure times, shortest first.
    pub(super) brackets: &'a [Vec<Photograph>],
    pub(super) sensor: Sensor,
    /// Board and frame are read finer.
    pub(super) fine: Fine<'a>,
    /// BLAKE3 of every file that was read.
    hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
}

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
    /// `full` is the capture as it was taken, `capture` the same in the working resolution.
    pub(super) fn new(full: &'a Capture, capture: &'a Capture, radiometry: &'a Radiometry, working: usize) -> Self {
        let fine = Fine::new(full, radiometry, working);
        Self { capture, brackets: &radiometry.brackets, sensor: radiometry.sensor(), fine, hashes: Mutex::default() }
    }

    /// The merged picture of a shot in the finer resolution.
    pub(super) fn merge_fine(&self, shot: usize) -> Result<Radiance> {
        self.remember(shot)?;
        let fine = |p: &Photograph| {
            let reduction = p.reduction.clone().map(|by| Reduction { factor: self.fine.factor, ..by });
            Photograph { reduction, ..p.clone() }
        };
        let bracket: Vec<Photograph> = self.brackets[shot].iter().map(fine).collect();
        merge_shot(&bracket, self.fine.camera().size_px, &self.fine.sensor)
    }

    /// Decodes a shot and keeps the pixels of `rects`.
    pub(super) fn decode(&self, shot: usize, rects: &[Rect]) -> Result<Vec<Bracket>> {
        self.remember(shot)?;
        decode_shot(&self.brackets[shot], rects, self.capture.rig.camera.size_px)
    }

    pub(super) fn merge_whole(&self, shot: usize) -> Result<Radiance> {
        self.remember(shot)?;
        merge_shot(&self.brackets[shot], self.capture.rig.camera.size_px, &self.sensor)
    }

    /// Hashes the files of a shot that were not read before.
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
