//! From a capture folder to the matrix: the way of the photographs, stage by stage.

mod crosstalk;
mod drift;
mod findings;
mod flicker;
mod lattice;
mod noise;
mod radiometry;
mod shots;
mod stray;

use crate::capture::{Capture, ExposureFrom, Noise};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{Radiance, Sensor};
use crate::registration::Registration;
use crate::transport::{MatrixHeader, MatrixWriter, ShotRecord};
use crate::{Result, Warning};
pub use crosstalk::CrossTalk;
use shots::Shots;
use std::path::{Path, PathBuf};

/// Settings of [`build_matrix`].
#[derive(Debug, Clone, Default)]
pub struct BuildOptions {
    /// Folder of rig.toml [default: calibration/ in the capture, else beside it].
    pub calibration: Option<PathBuf>,
    /// Leave the light of a shot's other dots in the rows, to see what it does.
    pub keep_crosstalk: bool,
    /// Where exposure times come from. capture.toml comes before all; `estimate` measures the actual times behind EXIF's from the
    /// photographs.
    pub exposure_from: ExposureFrom,
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
    /// Number of photographs.
    pub photographs: usize,
    /// Lit points.
    pub points: [usize; 2],
    /// Window samples.
    pub window: [usize; 2],
    /// The picture of one lattice shot with what was found in it.
    pub overview: Overview,
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
/// Streams: besides the ambient and white pictures one shot per thread is in memory.
///
/// # Errors
/// Those of [`Capture::open`], of decoding and registration; [`crate::Error::DotOutsideSlab`], [`crate::Error::DotSaturated`]; [`crate::Error::Io`] for `out`.
/// Nothing appears at `out` then.
pub fn build_matrix(dir: &Path, options: &BuildOptions, out: &Path, progress: &Progress) -> Result<BuildReport> {
    let mut capture = {
        let stage = progress.stage("read", 1);
        let capture = Capture::open_with(dir, options.calibration.as_deref(), options.exposure_from)?;
        stage.advance(1);
        capture
    };
    let mut writer = MatrixWriter::create(out, empty_header(&capture))?;
    let mut report = measure(&mut capture, options, &mut writer, progress)?;
    let stage = progress.stage("write", 1);
    // Here, so that neither a check nor a capture that cannot be built replaces an earlier curve.
    let not_saved = radiometry::save_curve(&capture, &report.sensor);
    writer.header_mut().warnings.extend(not_saved.clone());
    report.warnings.extend(not_saved);
    writer.finish()?;
    stage.advance(1);
    Ok(report)
}

/// All of [`build_matrix`] but the matrix: what `acquire check` does with a sample of a capture's lattice shots.
///
/// # Errors
/// Those of [`build_matrix`] after [`Capture::open`].
pub fn try_build(mut capture: Capture, options: &BuildOptions, progress: &Progress) -> Result<BuildReport> {
    let temporary = std::env::temp_dir();
    let scratch = crate::output::ScratchFolder::new(&temporary, ".acquire-try-", &temporary)?;
    let mut writer = MatrixWriter::create(&scratch.path().join("try.rd.zarr"), empty_header(&capture))?;
    measure(&mut capture, options, &mut writer, progress)
}

/// Everything between an opened capture and a complete writer.
fn measure(
    capture: &mut Capture,
    options: &BuildOptions,
    writer: &mut MatrixWriter,
    progress: &Progress,
) -> Result<BuildReport> {
    let noise = noise::find(capture)?;
    let radiometry = radiometry::calibrate(capture, &noise.noise, options, progress)?;
    let shots = Shots::new(capture, noise, radiometry);
    let (registration, found) = shots.register(progress)?;
    let mut prepared = shots.prepare(registration, found, progress)?;
    prepared.flicker = flicker::Flicker::measure(&prepared)?;
    let mut result = prepared.extract(writer, progress)?;
    let crosstalk = match options.keep_crosstalk {
        true => None,
        false => prepared.separate(&mut result, writer, progress)?,
    };
    prepared.finish(result, crosstalk, writer.header_mut())
}

fn empty_header(capture: &Capture) -> MatrixHeader {
    let m = &capture.manifest;
    MatrixHeader {
        points: m.grid.points,
        window: m.window.samples,
        pitch_mm: m.window.pitch_mm,
        lit_pitch_mm: [m.window.pitch_mm; 2],
        lit_mm: vec![[0.0; 2]; m.grid.len()],
        position_sd_mm: vec![0.0; m.grid.len()],
        shot_of: vec![None; m.grid.len()],
        shots: vec![],
        warnings: vec![],
        provenance: serde_json::Value::Null,
    }
}

#[cfg(test)]
mod tests;
