//! What all lattice shots of a capture have in common, in a file: tasks that measure some of them read it instead of
//! finding it again, and open no photographs but their own: [`Saved`] in a [`TaskFile`].
//!
//! [`super::assemble`] finds all of it again from the photographs, and takes no part for one of them that was measured
//! against anything else: a file that is out of date costs time, and makes no wrong matrix.

use super::dots_seen::DotSearch;
use super::drift::Movements;
use super::lattice::LightCorrections;
use super::noise::FoundNoise;
use super::photographs::{Heard, Photographs};
use super::radiometry::Radiometry;
use super::references::References;
use super::register::Registered;
use super::scene::Scene;
use super::{Before, BuildOptions, Judged, Prepared, Resolution, Working, finish, in_memory, open, with_prepared};
use crate::capture::{Capture, ExposureFrom, Manifest, Photograph, Rig, read_checksums};
use crate::output::{PROGRAM, TaskFile};
use crate::progress::Progress;
use crate::radiance::HotPixel;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::time::Instant;

const HEAD: &[u8; 16] = b"acquire common\n\0";

/// What [`with_prepared`] has found.
#[derive(Serialize, Deserialize)]
struct Saved<'a> {
    program: String,
    dir: PathBuf,
    rig_path: PathBuf,
    /// BLAKE3 of capture.toml and rig.toml, which tasks read themselves.
    manifest_and_rig: [String; 2],
    /// As the capture has them, before anything was found.
    brackets: Cow<'a, [Vec<Photograph>]>,
    noise: Cow<'a, FoundNoise>,
    working: Working,
    defects: Cow<'a, [HotPixel]>,
    radiometry: Cow<'a, Radiometry>,
    heard: Heard,
    registered: Cow<'a, Registered>,
    references: Cow<'a, References>,
    light: Cow<'a, LightCorrections>,
}

/// Refuses a place where such a file cannot go: a folder that is not there, a file that is something else.
///
/// # Errors
/// [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn check_prepared(path: &Path) -> Result<()> {
    crate::output::check_by_head(path, HEAD)
}

/// Finds what all lattice shots of the capture in `dir` have in common and writes it to `out`, which [`super::extract`]
/// takes in the place of the capture. An earlier such file is replaced.
///
/// # Errors
/// Those of [`super::extract`].
pub fn prepare(dir: &Path, options: &BuildOptions, out: &Path, progress: &Progress) -> Result<u64> {
    check_prepared(out)?;
    // Tasks may work in other folders.
    let dir = crate::files::canonical(dir).map_err(Error::io("read", dir))?;
    let capture = open(&dir, options, progress)?;
    let save = |before: &Before<'_>, prepared: &Prepared<'_>| {
        let rig_path = crate::files::canonical(&capture.rig_path).map_err(Error::io("read", &capture.rig_path))?;
        let saved = Saved {
            program: PROGRAM.into(),
            manifest_and_rig: hashes(&dir, &rig_path)?,
            dir: dir.clone(),
            rig_path,
            brackets: Cow::Borrowed(&capture.brackets),
            noise: Cow::Borrowed(before.noise),
            working: before.working,
            defects: Cow::Borrowed(before.defects),
            radiometry: Cow::Borrowed(before.radiometry),
            heard: prepared.scene.photographs.heard()?,
            registered: Cow::Borrowed(prepared.registered),
            references: Cow::Borrowed(prepared.scene.references),
            light: Cow::Borrowed(&prepared.light),
        };
        TaskFile::new(HEAD, &saved)?.write(out)
    };
    with_prepared(&capture, options, Judged::Part, save, progress).map(|(bytes, _)| bytes)
}

fn hashes(dir: &Path, rig_path: &Path) -> Result<[String; 2]> {
    let of = |path: &Path| crate::files::hash(path).map(|hash| hash.to_string()).map_err(Error::io("read", path));
    Ok([of(&dir.join("capture.toml"))?, of(rig_path)?])
}

fn read(path: &Path) -> Result<Saved<'static>> {
    let refuse = |found: &str| {
        let expected = "a whole file that `acquire prepare` of this version has written";
        Err(Error::field(path, "file", expected, found))
    };
    let file = match TaskFile::read(path, HEAD)? {
        Ok(file) => file,
        Err(found) => return refuse(found),
    };
    match file.value::<Saved<'static>>() {
        Ok(saved) if saved.program == PROGRAM => Ok(saved),
        Ok(saved) => refuse(&format!("one of {}", saved.program)),
        Err(e) => refuse(&format!("one that another version has written ({e})")),
    }
}

/// A capture with what its lattice shots have in common.
pub(super) struct SavedCapture {
    pub(super) capture: Capture,
    saved: Saved<'static>,
}

impl SavedCapture {
    /// # Errors
    /// [`Error::Field`] for a file that is damaged, of another version, or of a capture that has changed since;
    /// [`Error::Setting`] for `options` that were chosen when it was written.
    pub(super) fn open(path: &Path, options: &BuildOptions, progress: &Progress) -> Result<Self> {
        let stage = progress.stage("read", 1);
        let mut saved = read(path)?;
        let chosen = [
            ("calibration", options.calibration.is_some()),
            ("resolution", options.resolution != Resolution::default()),
            ("exposure_from", options.exposure_from != ExposureFrom::default()),
        ];
        if let Some((setting, _)) = chosen.into_iter().find(|(_, given)| *given) {
            let expected = "none, as `acquire prepare` was told it".into();
            return Err(Error::Setting { setting, expected, found: "one".into() });
        }
        if hashes(&saved.dir, &saved.rig_path)? != saved.manifest_and_rig {
            let expected = "capture.toml and rig.toml as they were when it was written";
            return Err(Error::field(path, "file", expected, "others"));
        }
        let capture = Capture {
            manifest: Manifest::read(&saved.dir)?,
            rig: Rig::read(&saved.rig_path)?,
            dir: std::mem::take(&mut saved.dir),
            rig_path: saved.rig_path.clone(),
            brackets: std::mem::take(&mut saved.brackets).into_owned(),
            warnings: vec![],
        };
        saved.radiometry = Cow::Owned(saved.radiometry.into_owned().with_tables());
        stage.advance(1);
        Ok(Self { capture, saved })
    }

    /// [`with_prepared`] for a part.
    ///
    /// # Errors
    /// Those of [`with_prepared`].
    pub(super) fn with_prepared<T: Send>(
        &self,
        options: &BuildOptions,
        then: impl FnOnce(&Before<'_>, &Prepared<'_>) -> Result<T> + Send,
    ) -> Result<T> {
        let (full, saved, start) = (&self.capture, &self.saved, Instant::now());
        let (noise, working) = (&saved.noise, saved.working);
        let capture = &saved.radiometry.reduction().map_or_else(|| full.clone(), |by| full.reduced(by));
        let recorded = &read_checksums(&full.dir)?;
        let before = Before { noise, working, defects: &saved.defects, radiometry: &saved.radiometry, recorded, start };
        in_memory(full, options, working, || {
            let photographs = Photographs::new(full, capture, &saved.radiometry, working.factor);
            photographs.hear(&saved.heard)?;
            let scene = &Scene::new(&photographs, &saved.registered, &saved.references);
            let movements = Movements::prepare(scene)?;
            let (at, search) = (Instant::now(), DotSearch::new(scene)?);
            let (registered, light) = (&*saved.registered, saved.light.clone().into_owned());
            let prepared = Prepared { scene, registered, light, movements, search, findings: vec![], at };
            finish(&photographs, &before, options, Judged::Part, then(&before, &prepared)).map(|(done, _)| done)
        })
    }
}
