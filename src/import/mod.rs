//! Import: a folder straight from a camera, sorted into the shots of a plan.
//!
//! The order is that of the camera's clock, and of the numbers in the names within a second; where the clock jumped
//! (its hour was set, say) and only the numbers fit the plan, they rule. Exposure times from EXIF must repeat the
//! plan's brackets; nothing is guessed, nothing is left out.

mod files;
mod fit;

pub use files::{Found, Listing, by_number, by_time, list};
pub use fit::{fit, same_settings};

use crate::capture::{Capture, PhotographEntry, Rig, write_checksums};
use crate::output::{NewFolder, ScratchFolder};
use crate::patterns::Plan;
use crate::progress::Progress;
use crate::{Error, Result};
use rayon::prelude::*;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Settings of [`import`].
#[derive(Debug, Clone, Default)]
pub struct ImportOptions {
    /// Link the photographs (hard links, on the same disk) instead of copying them.
    pub link: bool,
    /// Ending of the photographs to take, of a camera that wrote two of each [default: the one with most files; of
    /// equals RAW, TIFF, PNG, EXR, JPEG].
    pub take: Option<String>,
    /// Folder of rig.toml, copied into the capture [default: calibration/ of the plan].
    pub calibration: Option<PathBuf>,
    /// A name for people [default: the plan's].
    pub name: Option<String>,
    /// Believe the plan where photographs without EXIF tell no exposure: only their number can be checked then.
    pub exposures_from_plan: bool,
    /// Replace an earlier capture at `out`.
    pub force: bool,
}

/// What was imported.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// Photographs.
    pub photographs: usize,
    /// Shots.
    pub shots: usize,
    /// Ending of the photographs that were taken.
    pub kind: String,
    /// Photographs of other kinds that were left.
    pub left: usize,
    /// Hidden files, sidecars and others.
    pub ignored: usize,
    /// Whether the numbers in the names gave the order against the clock, or without one.
    pub by_number: bool,
}

/// Sorts the photographs in `folder` into the shots of the plan in `plan_dir`, and writes the capture `out`:
/// photographs, `capture.toml`, the rig. Nothing appears at `out` when anything does not fit.
///
/// # Errors
/// Those of [`Plan::read`], [`Rig::find`], [`list`] and [`Capture::open`]; [`Error::DoesNotFit`] for the first
/// photograph that is missing, doubled, or differs in exposure or settings; [`Error::Setting`] when `out` is in use;
/// [`Error::Io`].
pub fn import(
    folder: &Path,
    plan_dir: &Path,
    out: &Path,
    options: &ImportOptions,
    progress: &Progress,
) -> Result<Imported> {
    let mut plan = Plan::read(plan_dir)?;
    if let Some(name) = &options.name {
        plan.name.clone_from(name);
    }
    let rig_path = Rig::find(plan_dir, options.calibration.as_deref())?;
    let listing = {
        let stage = progress.stage("read", 1);
        let listing = list(folder, options.take.as_deref())?;
        stage.advance(1);
        listing
    };
    let mut believed = false;
    let mut taken = listing.taken;
    if options.exposures_from_plan && taken.iter().all(|p| p.settings.exposure_secs.is_none()) {
        believed = true;
    }
    let (photographs, by_number) = if believed {
        taken = by_time(taken.clone()).unwrap_or_else(|| by_number(taken));
        let expected = plan.shots.iter().flat_map(|s| &s.exposures_secs);
        taken.iter_mut().zip(expected).for_each(|(p, &t)| p.settings.exposure_secs = Some(t));
        fit(&taken, &plan)?;
        let timed = taken.iter().all(|p| p.settings.taken_secs.is_some());
        (taken, !timed)
    } else {
        ordered(taken, &plan)?
    };
    same_settings(&photographs, &plan)?;

    let new = NewFolder::create(out, options.force)?;
    let sources = by_shot(&photographs, &plan);
    try_open(&plan, &sources, &rig_path, believed)?;
    write(&new.path(), &plan, &sources, &rig_path, believed, options.link, progress)?;
    new.finish()?;
    Ok(Imported {
        photographs: photographs.len(),
        shots: plan.shots.len(),
        kind: listing.kind,
        left: listing.left,
        ignored: listing.ignored,
        by_number,
    })
}

/// The photographs in the order that fits the plan: the clock's, else the numbers'. Says whether it is the latter.
fn ordered(taken: Vec<Found>, plan: &Plan) -> Result<(Vec<Found>, bool)> {
    let numbered = by_number(taken.clone());
    let Some(timed) = by_time(taken) else {
        fit(&numbered, plan)?;
        return Ok((numbered, true));
    };
    match fit(&timed, plan) {
        Ok(()) => Ok((timed, false)),
        // A clock that was set during the capture exchanges whole parts of it.
        Err(_) if fit(&numbered, plan).is_ok() => Ok((numbered, true)),
        Err(error) => Err(error),
    }
}

/// The files of each shot.
fn by_shot(photographs: &[Found], plan: &Plan) -> Vec<Vec<PathBuf>> {
    let mut all = photographs.iter().map(|p| p.path.clone());
    plan.shots.iter().map(|s| all.by_ref().take(s.exposures_secs.len()).collect()).collect()
}

fn entries(plan: &Plan, shot: usize, believed: bool, file: impl Fn(usize) -> String) -> Vec<PhotographEntry> {
    let times = plan.shots[shot].exposures_secs.iter().enumerate();
    times.map(|(n, &t)| PhotographEntry { file: file(n), exposure_secs: believed.then_some(t) }).collect()
}

/// Opens the capture that it will be while the photographs still lie where the camera put them: messages name them
/// there.
fn try_open(plan: &Plan, sources: &[Vec<PathBuf>], rig_path: &Path, believed: bool) -> Result<()> {
    let temporary = std::env::temp_dir();
    let scratch = ScratchFolder::new(&temporary, &temporary)?;
    let absolute: Vec<Vec<PathBuf>> = sources
        .iter()
        .map(|s| s.iter().map(|p| std::path::absolute(p).map_err(Error::io("read", p))).collect())
        .collect::<Result<_>>()?;
    if let Some(path) = absolute.iter().flatten().find(|p| p.to_str().is_none()) {
        return Err(Error::field(path, "name", "a path in UTF-8", "another encoding"));
    }
    let file = |s: usize, n: usize| absolute[s][n].to_string_lossy().into_owned();
    let manifest = plan.manifest(|s| entries(plan, s, believed, |n| file(s, n)));
    manifest.write(scratch.path())?;
    Capture::open(scratch.path(), rig_path.parent()).map(|_| ())
}

fn write(
    dir: &Path,
    plan: &Plan,
    sources: &[Vec<PathBuf>],
    rig_path: &Path,
    believed: bool,
    link: bool,
    progress: &Progress,
) -> Result<()> {
    let make = |path: PathBuf| std::fs::create_dir(&path).map_err(Error::io("create", &path));
    make(dir.join("photos"))?;
    make(dir.join("calibration"))?;
    Rig::copy(rig_path, &dir.join("calibration"))?;
    let name = |s: usize, n: usize| {
        let ending = sources[s][n].extension().map_or(String::new(), |e| e.to_string_lossy().to_ascii_lowercase());
        format!("photos/{}_{n}.{ending}", plan.shots[s].name)
    };
    plan.manifest(|s| entries(plan, s, believed, |n| name(s, n))).write(dir)?;
    let all: Vec<(usize, usize)> =
        (0..sources.len()).flat_map(|s| (0..sources[s].len()).map(move |n| (s, n))).collect();
    let stage = progress.stage(if link { "link" } else { "copy" }, all.len());
    let checksum = |(s, n): (usize, usize)| {
        let (from, to) = (&sources[s][n], dir.join(name(s, n)));
        let done = if link { std::fs::hard_link(from, &to) } else { std::fs::copy(from, &to).map(|_| ()) };
        done.map_err(|e| match e.kind() {
            // The source has nothing to do with it.
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => Error::io("write", &to)(e),
            _ => Error::io(if link { "link" } else { "copy" }, from)(e),
        })?;
        // Of the source: a copy that differs is found when it is read.
        let hash = crate::files::hash(from).map_err(Error::io("read", from))?;
        stage.advance(1);
        Ok((name(s, n), hash))
    };
    write_checksums(dir, &all.into_par_iter().map(checksum).collect::<Result<_>>()?)
}
