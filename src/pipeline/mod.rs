//! From a capture folder to the matrix: the way of the photographs, stage by stage.

mod common;
mod crosstalk;
mod defects;
mod dots_seen;
mod drift;
mod exposure_times;
mod findings;
mod flicker;
mod lamp;
mod lattice;
mod lattice_light;
mod light_spots;
mod likeliest;
mod looks;
mod memory;
mod noise;
mod parts;
mod photographs;
mod radiometry;
mod reciprocity;
mod recorded;
mod reference_dots;
mod references;
mod register;
mod remains;
mod resolution;
mod resume;
mod saved;
mod scene;
mod sink;
mod strangers;
mod stray;

use crate::capture::{Capture, ExposureFrom, Noise, ResponseCurve, read_checksums};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{Radiance, Sensor};
use crate::registration::Registration;
use crate::transport::{MatrixHeader, MatrixWriter, ShotRecord};
use crate::{Error, RadianceWarning, Result, Warning};
pub use crosstalk::CrossTalk;
use drift::Movements;
use findings::{Stages, unmeasured};
use flicker::Flicker;
use lattice::LightCorrections;
pub use parts::{ExtractReport, Shots, assemble, extract, lattice_shots};
use photographs::Photographs;
pub use resolution::{Resolution, Working};
pub use resume::TakenOver;
pub(crate) use saved::check_prepared;
pub use saved::prepare as prepare_shots;
use scene::Scene;
use sink::{HeldRows, RowSink};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Settings of [`build_matrix`].
#[derive(Debug, Clone, Default)]
pub struct BuildOptions {
    /// Folder of rig.toml [default: calibration/ in the capture, else beside it].
    pub calibration: Option<PathBuf>,
    /// Leave the light of a shot's other dots in the rows, to see what it does.
    pub keep_crosstalk: bool,
    /// How photographs are reduced while they are decoded.
    pub resolution: Resolution,
    /// Bytes that the photographs at work may take: as many threads work as fit. `None`: all threads.
    pub memory_bytes: Option<u64>,
    /// Where exposure times come from. capture.toml comes before all; `estimate` measures the actual times behind
    /// EXIF's from the photographs.
    pub exposure_from: ExposureFrom,
    /// Names of findings ([`Warning::id`]) that are told and do not stop the work.
    pub accept: Vec<String>,
}

impl BuildOptions {
    /// A finding after which no result can be believed: an error, and where it is accepted a warning.
    ///
    /// # Errors
    /// [`Error::Contradiction`].
    fn refuse(&self, finding: impl Into<Warning>) -> Result<Warning> {
        let finding = finding.into();
        match self.accept.iter().any(|id| id == finding.id()) {
            true => Ok(finding),
            false => Err(Error::Contradiction { finding: Box::new(finding) }),
        }
    }
}

/// What [`build_matrix`] found besides the matrix.
#[derive(Debug, Clone)]
pub struct BuildReport {
    /// Where everything was.
    pub registration: Registration,
    /// The sensor's noise, as it was used.
    pub noise: Noise,
    /// What turned code values to light.
    pub sensor: Sensor,
    /// Lattice shots with their drift.
    pub shots: Vec<ShotRecord>,
    /// What was done about the dots of one shot lighting each other's windows; `None` when none can.
    pub crosstalk: Option<CrossTalk>,
    /// Findings.
    pub warnings: Vec<Warning>,
    /// At what resolution photographs were worked on. Figures in camera px are of it, but for the drift, the camera's
    /// movement and `camera_px_per_mm` of the header, which are of the photographs as they are.
    pub working: Working,
    /// The farthest drift that is measured, camera px as those of `shots`; more is refused.
    pub drift_followed_px: f64,
    /// Number of photographs.
    pub photographs: usize,
    /// Lit points.
    pub points: [usize; 2],
    /// Window samples.
    pub window: [usize; 2],
    /// The picture of one lattice shot with what was found in it.
    pub overview: Overview,
    /// What it took.
    pub secs: BuildSecs,
    /// What a stopped run, or tasks, had measured of it.
    pub taken_over: TakenOver,
    /// Of [`assemble`]: parts that were of no use, and why.
    pub unused_parts: Vec<String>,
}

/// Seconds that a build took, reading the capture and writing the matrix left out.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BuildSecs {
    /// Once a capture: radiometry, registration, references.
    pub once: f64,
    /// For its lattice shots.
    pub lattice: f64,
}

/// One merged lattice shot and the registration drawn over it, for people to look at.
#[derive(Debug, Clone)]
pub struct Overview {
    /// The shot's name.
    pub shot: String,
    /// Its radiance over the whole photograph.
    pub radiance: Radiance,
    /// Number of exposures of the shot.
    pub exposures: usize,
    /// Camera px of all lit points (without drift).
    pub grid_px: Vec<Point>,
    /// Camera px of the points that this shot lights (drift included).
    pub lit_px: Vec<Point>,
    /// Outlines of their windows, four corners each, camera px.
    pub windows_px: Vec<[Point; 4]>,
    /// Camera px of the reference dots (without drift).
    pub reference_dots_px: Vec<Point>,
    /// The slab's corners, camera px.
    pub slab_px: [Point; 4],
}

/// Builds the matrix of the capture in `dir` and writes it to `out` (see [`MatrixWriter`]).
///
/// Streams: besides the ambient and white pictures one shot per thread is in memory. Shots that an earlier run for the
/// same `out` has measured, which was killed or ended by [`crate::Error::Io`], are not measured again where their
/// photographs and all that they are measured against are the same; the result is that of an undisturbed run.
///
/// # Errors
/// Those of [`Capture::open`], of decoding and registration; [`crate::Error::DotOutsideSlab`],
/// [`crate::Error::DotSaturated`]; [`crate::Error::Io`] for `out`. Nothing appears at `out` then.
pub fn build_matrix(dir: &Path, options: &BuildOptions, out: &Path, progress: &Progress) -> Result<BuildReport> {
    build_matrix_to(dir, options, |header| MatrixWriter::go_on(out, header), progress)
}

/// [`build_matrix`] for a part of an output: what was measured stays in its scratch folder `outer` until all of it is
/// there.
///
/// # Errors
/// Those of [`build_matrix`].
pub(crate) fn build_matrix_in(
    outer: &Path,
    dir: &Path,
    options: &BuildOptions,
    out: &Path,
    progress: &Progress,
) -> Result<BuildReport> {
    build_matrix_to(dir, options, |header| MatrixWriter::go_on_in(outer, out, header), progress)
}

fn build_matrix_to(
    dir: &Path,
    options: &BuildOptions,
    writer: impl FnOnce(MatrixHeader) -> Result<MatrixWriter>,
    progress: &Progress,
) -> Result<BuildReport> {
    let capture = open(dir, options, progress)?;
    let rows = writer(unmeasured(&capture.manifest))?;
    let measured = measure(&capture, options, &rows, progress);
    write(&capture, rows, measured, progress)
}

fn open(dir: &Path, options: &BuildOptions, progress: &Progress) -> Result<Capture> {
    let stage = progress.stage("read", 1);
    let capture = Capture::open_with(dir, options.calibration.as_deref(), options.exposure_from)?;
    stage.advance(1);
    Ok(capture)
}

/// Writes what was measured, whose rows are with the writer.
fn write(
    capture: &Capture,
    mut rows: MatrixWriter,
    measured: Result<(MatrixHeader, BuildReport)>,
    progress: &Progress,
) -> Result<BuildReport> {
    if measured.as_ref().is_err_and(Error::is_of_system) {
        rows.keep_work();
    }
    let (mut header, mut report) = measured?;
    let stage = progress.stage("write", 1);
    // Here, so that neither a check nor a capture that cannot be built replaces an earlier curve.
    let not_saved = radiometry::save_curve(capture, &report.sensor).map(Warning::from);
    tell(&mut header, &mut report, not_saved.into_iter().collect());
    *rows.header_mut() = header;
    rows.finish()?;
    stage.advance(1);
    Ok(report)
}

/// All of [`build_matrix`] but the matrix: what `acquire check` does with a sample of a capture's lattice shots.
///
/// # Errors
/// Those of [`build_matrix`] after [`Capture::open`].
pub fn try_build(capture: &Capture, options: &BuildOptions, progress: &Progress) -> Result<BuildReport> {
    measure(capture, options, &HeldRows::default(), progress).map(|(_, report)| report)
}

/// The way of the photographs: each stage takes what the ones before it gave, and changes none of it.
fn measure(
    capture: &Capture,
    options: &BuildOptions,
    rows: &impl RowSink,
    progress: &Progress,
) -> Result<(MatrixHeader, BuildReport)> {
    let of_all = |before: &Before<'_>, prepared: &Prepared<'_>| build_rows(before, prepared, options, rows, progress);
    let ((mut header, mut report), findings) = with_prepared(capture, options, Judged::AllShots, of_all, progress)?;
    tell(&mut header, &mut report, findings);
    Ok((header, report))
}

/// Which photographs `then` of [`with_prepared`] has looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Judged {
    /// Those by which the capture is judged.
    AllShots,
    /// Too few for that: whoever puts parts together judges them.
    Part,
}

/// What `then` makes of a capture of which all is known that its lattice shots have in common, and what is to be told
/// of the photographs besides.
fn with_prepared<T: Send>(
    capture: &Capture,
    options: &BuildOptions,
    judged: Judged,
    then: impl FnOnce(&Before<'_>, &Prepared<'_>) -> Result<T> + Send,
    progress: &Progress,
) -> Result<(T, Vec<Warning>)> {
    let found = || -> Result<_> {
        let start = Instant::now();
        memory::keep_before(capture, options.memory_bytes);
        let stage = progress.stage("noise", 2);
        let mut noise = noise::find(capture)?;
        stage.advance(1);
        noise.warnings.extend(noise::black_moves(capture, &noise.noise)?);
        stage.advance(1);
        drop(stage);
        let early = early_radiometry(capture, &noise, options, progress)?;
        let sensor = match &early {
            Some(radiometry) => radiometry.sensor(),
            None => radiometry::sensor_of_rig(capture, &noise.noise)?,
        };
        let working = resolution::choose(capture, &noise.noise, &sensor, options, progress)?;
        Ok(Found { noise, working, sensor, early, start })
    };
    let done = found().and_then(|found| {
        let working = found.working;
        in_memory(capture, options, working, || at_resolution(capture, options, found, judged, then, progress))
    });
    done.map_err(|error| likeliest::in_files(capture, error))
}

/// What is found in photographs as they are.
struct Found {
    noise: noise::FoundNoise,
    working: Working,
    /// What makes code values light before they are averaged.
    sensor: Sensor,
    early: Option<radiometry::Radiometry>,
    start: Instant,
}

/// Radiometry of the photographs as they are, where means of their code values ask for a curve that is not known.
fn early_radiometry(
    capture: &Capture,
    noise: &noise::FoundNoise,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Option<radiometry::Radiometry>> {
    let is_known = capture.rig.camera.response_curve != ResponseCurve::Estimate;
    if is_known || resolution::reducible(capture, options)?.is_none() {
        return Ok(None);
    }
    let found = radiometry::calibrate(capture, &noise.noise, options, progress);
    found.map(Some).map_err(|error| likeliest::in_noise(&noise.warnings, error))
}

/// Does `work` with as many threads as the memory permits.
fn in_memory<T: Send>(
    capture: &Capture,
    options: &BuildOptions,
    working: Working,
    work: impl FnOnce() -> Result<T> + Send,
) -> Result<T> {
    let threads = memory::share(capture, working, options.memory_bytes, rayon::current_num_threads())?;
    if threads == rayon::current_num_threads() {
        return work();
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(Error::internal)?;
    pool.install(work)
}

/// [`with_prepared`] at the working resolution.
fn at_resolution<T>(
    capture: &Capture,
    options: &BuildOptions,
    Found { noise, working, sensor, early, start }: Found,
    judged: Judged,
    then: impl FnOnce(&Before<'_>, &Prepared<'_>) -> Result<T>,
    progress: &Progress,
) -> Result<(T, Vec<Warning>)> {
    let full = capture;
    // From here on the camera is one of that resolution.
    let defects = defects::find(capture, &sensor, working, progress)?;
    let by = defects::reduction(working, &noise.noise, &sensor, &defects);
    let capture = &capture.reduced(&by);
    let radiometry = match early {
        Some(radiometry) => radiometry.reduced(&by),
        None => radiometry::calibrate(capture, &noise.noise, options, progress)
            .map_err(|error| likeliest::in_noise(&noise.warnings, error))?,
    };
    let photographs = Photographs::new(full, capture, &radiometry, working.factor);
    // What the photographs say of the noise was said of the stated times.
    let noise = if radiometry.corrected { noise.again(&full.timed(&radiometry.brackets))? } else { noise };
    let recorded = &read_checksums(&full.dir)?;
    let before = Before { noise: &noise, working, defects: &defects, radiometry: &radiometry, recorded, start };
    let done = prepare(&photographs, &before, options, |prepared| then(&before, prepared), progress);
    finish(&photographs, &before, options, judged, done)
}

/// What was done with the photographs, and what is to be told of them; where it failed, what they say of it.
fn finish<T>(
    photographs: &Photographs<'_>,
    before: &Before<'_>,
    options: &BuildOptions,
    judged: Judged,
    done: Result<T>,
) -> Result<(T, Vec<Warning>)> {
    let done = done.map_err(|error| likeliest::in_gray_code(photographs, error));
    let (done, changed) = recorded::with_changed(photographs, before.recorded, options, done)
        .map_or_else(|e| (Err(e), None), |(b, c)| (Ok(b), c));
    let (done, mut findings) = match (done, judged) {
        (Ok(done), Judged::Part) => (done, vec![]),
        (done, _) => strangers::with_findings(photographs, options, done)
            .map_err(|error| likeliest::in_noise(&before.noise.warnings, error))?,
    };
    findings.extend(changed);
    Ok((done, findings))
}

/// Adds findings to what was told before.
fn tell(header: &mut MatrixHeader, report: &mut BuildReport, findings: Vec<Warning>) {
    header.warnings.extend(findings.iter().cloned());
    report.warnings.extend(findings);
}

/// What was found before the first shot was looked at as a picture.
struct Before<'a> {
    noise: &'a noise::FoundNoise,
    working: Working,
    defects: &'a [crate::radiance::HotPixel],
    radiometry: &'a radiometry::Radiometry,
    /// Checksums of photographs as they were when the capture was made, by name.
    recorded: &'a BTreeMap<String, blake3::Hash>,
    start: Instant,
}

/// All that lattice shots are measured against.
struct Prepared<'a> {
    scene: &'a Scene<'a>,
    registered: &'a register::Registered,
    light: LightCorrections,
    movements: Movements,
    search: dots_seen::DotSearch,
    findings: Vec<Warning>,
    at: Instant,
}

/// Registration, references and the light, and what is made of them.
fn prepare<T>(
    photographs: &Photographs<'_>,
    before: &Before<'_>,
    options: &BuildOptions,
    then: impl FnOnce(&Prepared<'_>) -> Result<T>,
    progress: &Progress,
) -> Result<T> {
    let radiometry = before.radiometry;
    let registered = &register::register(photographs, options, progress)?;
    let mut references = references::references(photographs, registered, radiometry.flicker_sd, options, progress)?;
    let first = Scene::new(photographs, registered, &references);
    lattice::check_dots(&first)?;
    let (stray, stray_warnings) = stray::measure(&first, radiometry.flicker_sd, options, progress)?;
    let cell_px = first.cell_px;
    references.doubt_ambient(stray.even.unwrap_or(0.0), cell_px);
    let stage = progress.stage("lamp", 2);
    let scene = &Scene::new(photographs, registered, &references);
    let light = LightCorrections { stray, flicker: Flicker::measure(scene, radiometry.flicker_sd)? };
    stage.advance(1);
    let times_are_off = |w: &Warning| matches!(w, Warning::Radiance(RadianceWarning::ExposureRatios { .. }));
    let mut findings: Vec<Warning> =
        light.flicker.judge(scene, radiometry.warnings.iter().any(times_are_off), options)?.into_iter().collect();
    let movements = Movements::prepare(scene)?;
    findings.extend(movements.slab(scene, options)?);
    findings.extend(stray_warnings);
    findings.extend(references.warnings.iter().cloned());
    let at = Instant::now();
    let search = dots_seen::DotSearch::new(scene)?;
    stage.advance(1);
    drop(stage);
    then(&Prepared { scene, registered, light, movements, search, findings, at })
}

/// The lattice shots, and what they say together.
fn build_rows(
    before: &Before<'_>,
    prepared: &Prepared<'_>,
    options: &BuildOptions,
    rows: &impl RowSink,
    progress: &Progress,
) -> Result<(MatrixHeader, BuildReport)> {
    let Prepared { scene, registered, light, .. } = prepared;
    let (mut shots, taken_over) = lattice::extract(prepared, rows, progress)?;
    let mut seen = dots_seen::judge(scene, &shots, options)?;
    if let Some(remains) = remains::judge(&shots, options)? {
        // Its light draws the dots aside.
        seen = vec![remains];
    }
    seen.extend(prepared.findings.iter().cloned());
    let crosstalk = match options.keep_crosstalk {
        true => None,
        false => crosstalk::separate(scene, &mut shots, rows, progress)?,
    };
    // Rows that hold the light of other dots say nothing of each other's places.
    let mixed = options.keep_crosstalk && crosstalk::overlap_samples(scene).is_some();
    if seen.is_empty() && !mixed {
        seen = reciprocity::judge(scene, &shots, rows, options)?;
    }
    let (crosstalk, left_by_others) = crosstalk.unzip();
    let common = common::common_errors(scene, light, &shots, &left_by_others.unwrap_or_default());
    let stages = Stages { before, registered, light };
    let secs =
        BuildSecs { once: (prepared.at - before.start).as_secs_f64(), lattice: prepared.at.elapsed().as_secs_f64() };
    let (mut header, mut report) = findings::summarize(scene, &stages, &shots, crosstalk, secs)?;
    header.common = Some(common);
    report.taken_over = taken_over;
    tell(&mut header, &mut report, seen);
    Ok((header, report))
}

#[cfg(test)]
mod tests;
