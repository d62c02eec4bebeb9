//! Lattice shots that a stopped run has measured: their rows wait in the matrix's scratch folder, what else is known of
//! them in lines beside.
//!
//! What comes before the lattice shots is done again, once a capture; from that and the files that were read for it a
//! key is made, so that shots are taken over only where all that they are measured against is the same. Their own
//! photographs are known by their BLAKE3.

use super::lattice::{LightCorrections, ShotResult};
use super::photographs::Said;
use super::scene::Scene;
use super::sink::RowSink;
use crate::files::FileState;
use crate::output::{Earlier, WorkLog, key_of};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// A measured shot: its number in the manifest, what its photographs have said, the BLAKE3 of its rows in the order of
/// its dots.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct MeasuredShot {
    pub(super) shot: usize,
    pub(super) said: Said,
    pub(super) rows: String,
    pub(super) result: ShotResult,
    /// Its photographs' files as a task saw them before it read them; none where the photographs are to be read again.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) files: Vec<FileState>,
}

impl MeasuredShot {
    pub(super) fn new(said: Said, shot: usize, rows: blake3::Hash, result: ShotResult) -> Self {
        Self { shot, said, rows: rows.to_hex().to_string(), result, files: vec![] }
    }
}

/// How much of the work a stopped run had done.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TakenOver {
    /// Lattice shots that were not measured again.
    pub shots: usize,
    /// Lattice shots in all.
    pub of: usize,
    /// Whether there was such a run whose photographs, options or version were others: all was done anew.
    pub anew: bool,
}

/// What a stopped run has left, and where this one adds to it.
pub(super) struct Resumed {
    log: Option<WorkLog>,
    /// By shot: several tasks may have measured the same.
    earlier: Mutex<BTreeMap<usize, Vec<MeasuredShot>>>,
    pub(super) anew: bool,
}

impl Resumed {
    /// # Errors
    /// [`Error::Io`].
    pub(super) fn of(scene: &Scene<'_>, light: &LightCorrections, rows: &impl RowSink) -> Result<Self> {
        let Some((log, earlier)) = rows.earlier(&key(scene, light)?)? else {
            return Ok(Self { log: None, earlier: Mutex::default(), anew: false });
        };
        let anew = matches!(earlier, Earlier::Other);
        let shots = if let Earlier::Finished(shots) = earlier { shots } else { vec![] };
        let mut earlier = BTreeMap::<usize, Vec<MeasuredShot>>::new();
        shots.into_iter().for_each(|s| earlier.entry(s.shot).or_default().push(s));
        Ok(Self { log: Some(log), earlier: Mutex::new(earlier), anew })
    }

    /// What that run has measured of a shot, if photographs and rows are still the same.
    ///
    /// # Errors
    /// [`Error::Io`] when a photograph cannot be read.
    pub(super) fn take(&self, scene: &Scene<'_>, shot: usize, rows: &impl RowSink) -> Result<Option<ShotResult>> {
        let earlier = self.earlier.lock().map_err(Error::internal)?.remove(&shot).unwrap_or_default();
        let grid = &scene.capture.manifest.grid;
        let indices: Vec<usize> = scene.dots(shot).iter().map(|&dot| grid.row_index(dot)).collect();
        for measured in earlier {
            let same = measured.result.lit.iter().map(|l| l.dot).eq(scene.dots(shot).iter().copied())
                && blake3::Hash::from_hex(&measured.rows).is_ok_and(|hash| rows.adopt(&indices, &hash))
                && scene.photographs.repeat(shot, &measured.said, &measured.files)?;
            if same {
                return Ok(Some(measured.result));
            }
        }
        Ok(None)
    }

    /// Keeps a measured shot, whose rows were put, for a next run.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(super) fn add(&self, scene: &Scene<'_>, shot: usize, rows: blake3::Hash, result: &ShotResult) -> Result<()> {
        let Some(log) = &self.log else { return Ok(()) };
        log.add(&MeasuredShot::new(scene.photographs.said(shot)?, shot, rows, result.clone()))
    }
}

/// The key of all that lattice shots are measured against. Pictures of references are in it by the files that they were
/// made of.
pub(super) fn key(scene: &Scene<'_>, light: &LightCorrections) -> Result<String> {
    let (capture, references) = (scene.capture, scene.references);
    let times: Vec<Vec<f64>> =
        scene.photographs.brackets.iter().map(|b| b.iter().map(|p| p.exposure_secs).collect()).collect();
    key_of(&(
        format!(
            "{:?} {:?} {:?} {}",
            capture.manifest,
            capture.rig,
            scene.photographs.sensor,
            scene.photographs.hash()?
        ),
        (scene.registration, &references.hot, references.white_variance, references.lamp),
        (&light.stray, &light.flicker, times),
    ))
}
