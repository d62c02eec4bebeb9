//! Reading the shots of a capture: decoded, merged, by the exposure times and the sensor that radiometry found.

use super::radiometry::Radiometry;
use crate::capture::{Capture, Pattern, Photograph, Rect};
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
    /// BLAKE3 of every file that was read.
    hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
}

impl<'a> Photographs<'a> {
    pub(super) fn new(capture: &'a Capture, radiometry: &'a Radiometry) -> Self {
        Self { capture, brackets: &radiometry.brackets, sensor: radiometry.sensor(), hashes: Mutex::default() }
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
