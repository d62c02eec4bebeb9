//! Check: everything that can be known about a capture before an hour of work, in seconds.
//!
//! Looks at every file's head, and takes a sample of the lattice shots the whole way that `build-matrix` goes, by the
//! same code: what stops that at opening, at registration or at the sampled shots is found here.
//!
//! Not found: what only an unsampled lattice shot shows (lost reference dots, saturated dots), damage in the middle of
//! a file, and all that `docs/captures.md` lists as what the program does not find.

mod heads;
mod pixels;
mod text;

pub use crate::warning::{Severity, Topic};
pub use text::table;

use crate::capture::{self, Capture, Manifest, Pattern, Reduction, Rig, Taken};
use crate::pipeline::{BuildOptions, BuildReport, BuildSecs, try_build};
use crate::progress::Progress;
use crate::radiance::Sensor;
use crate::warning::bounds::{BLUR_SHARE, DRIFT_SHARE};
use crate::{CheckWarning, Error, FindingRecord, ResponseWarning, Result, Warning};
use pixels::Pictures;
use serde::Serialize;
use std::path::Path;

/// Settings of [`check`].
#[derive(Debug, Clone)]
pub struct CheckOptions {
    /// Those of the build that is to come.
    pub build: BuildOptions,
    /// Lattice shots to look at, spread over the sweep. 8: the first, the last and some between show drift and light.
    pub lattice_shots: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { build: BuildOptions::default(), lattice_shots: 8 }
    }
}

/// What was measured; each `None` when it was not reached.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Figures {
    /// Photographs that `capture.toml` names.
    pub photographs: usize,
    /// Those of them whose EXIF tells ISO, aperture, focal length or mode.
    pub photographs_with_settings: usize,
    /// Those that say when they were taken.
    pub photographs_with_time: usize,
    /// Bytes of those that are there.
    pub photograph_bytes: u64,
    /// Shots.
    pub shots: usize,
    /// Lattice shots.
    pub lattice_shots: usize,
    /// Those of them that were looked at.
    pub lattice_shots_looked_at: usize,
    /// Grid points, and how many of them are lit.
    pub points: [usize; 2],
    /// How many of them a shot lights.
    pub points_lit: usize,
    /// Exposures of most lattice shots, s.
    pub lattice_exposures_secs: Vec<f64>,
    /// RMS of the board's corners, camera px.
    pub camera_rms_px: Option<f64>,
    /// RMS of the Gray code's edges, projector px.
    pub projector_rms_px: Option<f64>,
    /// Standard deviation of the lens's blur, camera px.
    pub psf_px: Option<f64>,
    /// Side of an outgoing sample, camera px.
    pub sample_px: Option<f64>,
    /// Largest drift of the shots that were looked at, camera px.
    pub drift_most_px: Option<f64>,
    /// Dots that were looked at.
    pub dots_looked_at: usize,
    /// Largest share of the windows of a shot that is black in its longest exposure.
    pub dark_share: Option<f64>,
    /// The matrix is no larger than this.
    pub matrix_bytes_most: u64,
    /// What building the whole matrix would take here, s.
    pub build_secs: Option<f64>,
}

/// What [`check`] found.
#[derive(Debug, Default)]
pub struct CheckReport {
    /// The capture's name, when its manifest can be read.
    pub name: Option<String>,
    /// What was measured.
    pub figures: Figures,
    /// What was found, worst first.
    pub findings: Vec<Warning>,
    /// What `build-matrix` would stop with; `None` when nothing is known that would stop it.
    pub stopped_by: Option<Error>,
    /// The same among the findings.
    refusal: Option<Warning>,
}

/// Checks the capture in `dir`. What is wrong with it is in the report.
///
/// # Errors
/// [`Error::Setting`] for no lattice shots to look at; [`Error::Internal`].
pub fn check(dir: &Path, options: &CheckOptions, progress: &Progress) -> Result<CheckReport> {
    if options.lattice_shots == 0 {
        let (expected, found) = ("at least 1".into(), "0".into());
        return Err(Error::Setting { setting: "lattice_shots", expected, found });
    }
    let mut report = CheckReport::default();
    let done = report.look(dir, options, progress);
    if let Err(error) = done {
        if error.is_internal() {
            return Err(error);
        }
        report.stop(error, dir);
    }
    report.stop_at_files(dir);
    let mut findings = std::mem::take(&mut report.findings);
    findings.sort_by_key(|f| std::cmp::Reverse(report.record(f).severity));
    report.findings = findings;
    Ok(report)
}

/// Pixels along the longer side of the pictures that are looked at where nothing tells how fine the windows are.
const LOOK_PX: usize = 2000;

impl CheckReport {
    /// Whether nothing is known that would stop `build-matrix`.
    pub fn would_build(&self) -> bool {
        self.stopped_by.is_none()
    }

    /// What all findings have, of one of [`Self::findings`]: that which would stop the build is an error.
    pub fn record(&self, finding: &Warning) -> FindingRecord {
        match self.refusal.as_ref() == Some(finding) {
            true => finding.record().refused(),
            false => finding.record(),
        }
    }

    /// One object for programs: `would_build`, `reason`, `figures`, and `findings` as [`FindingRecord`]s with their own
    /// `figures`.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn json(&self) -> Result<serde_json::Value> {
        let findings: Result<Vec<_>> = self.findings.iter().map(|f| self.record(f).with_figures(f)).collect();
        Ok(serde_json::json!({
            "name": self.name,
            "would_build": self.would_build(),
            "reason": self.stopped_by.as_ref().map(ToString::to_string),
            "figures": serde_json::to_value(&self.figures).map_err(Error::internal)?,
            "findings": findings?,
        }))
    }

    fn found(&mut self, finding: impl Into<Warning>) {
        self.findings.push(finding.into());
    }

    fn look(&mut self, dir: &Path, options: &CheckOptions, progress: &Progress) -> Result<()> {
        let calibration = options.build.calibration.as_deref();
        {
            let stage = progress.stage("files", 2);
            if crate::files::is_folder(dir) {
                let manifest = Manifest::read(dir)?;
                let rig = Rig::read(&Rig::find(dir, calibration)?)?;
                self.heads(dir, &manifest, &rig);
            }
            stage.advance(1);
        }
        let capture = Capture::open_with(dir, calibration, options.build.exposure_from)
            .inspect_err(|_| self.found(CheckWarning::NotLookedAt))?;
        self.warned(capture.warnings.iter().cloned().map(Warning::from));
        let sample = sampled(&capture, options.lattice_shots);
        self.figures.lattice_shots_looked_at = sample.shots(is_lattice).len();
        let tried = try_build(&sample, &options.build, progress);
        self.pixels(&capture, &sample, tried.as_ref().ok(), progress)?;
        let tried = tried?;
        self.estimate(&capture, &sample, tried.secs);
        dots_on_slab(&capture, &tried)
    }

    fn heads(&mut self, dir: &Path, manifest: &Manifest, rig: &Rig) {
        self.name = Some(manifest.name.clone());
        let heads = heads::read(dir, manifest, rig);
        self.findings.extend(heads.iter().filter_map(|h| h.finding.clone()).map(Warning::from));
        let bytes = heads.iter().filter_map(|h| h.bytes).sum();
        let photographs = heads.len();
        let taken: Vec<Taken> = heads.into_iter().filter(|h| h.bytes.is_some()).map(|h| h.taken).collect();
        self.findings.extend(capture::findings(&taken, manifest).into_iter().map(Warning::from));
        let lit: std::collections::BTreeSet<[usize; 2]> =
            manifest.shots.iter().flat_map(|s| dots(&s.pattern)).copied().collect();
        let points = manifest.grid.len();
        if lit.len() < points {
            self.found(ResponseWarning::UnlitPoints { rows: points - lit.len() });
        }
        // Response and variance in four bytes each, validity in one, three channels.
        let row_bytes = 27 * manifest.window.samples[0] * manifest.window.samples[1];
        self.figures = Figures {
            photographs,
            photographs_with_settings: taken.iter().filter(|h| h.has_settings()).count(),
            photographs_with_time: taken.iter().filter(|h| h.taken_secs().is_some()).count(),
            photograph_bytes: bytes,
            shots: manifest.shots.len(),
            lattice_shots: manifest.shots.iter().filter(|s| is_lattice(&s.pattern)).count(),
            points: manifest.grid.points,
            points_lit: lit.len(),
            lattice_exposures_secs: capture::lattice_exposures(&taken, manifest),
            matrix_bytes_most: row_bytes as u64 * points as u64,
            ..Figures::default()
        };
    }

    /// Warnings of the pipeline that were not found already. Of a sample, every other point is unlit: that is counted
    /// before.
    fn warned(&mut self, warnings: impl IntoIterator<Item = Warning>) {
        for warning in warnings {
            let of_sample = matches!(warning, Warning::Response(ResponseWarning::UnlitPoints { .. }));
            if !of_sample && !self.findings.iter().any(|f| same(f, &warning)) {
                self.findings.push(warning);
            }
        }
    }

    fn pixels(
        &mut self,
        capture: &Capture,
        sample: &Capture,
        tried: Option<&BuildReport>,
        progress: &Progress,
    ) -> Result<()> {
        let stage = progress.stage("light", 3);
        // Photographs are averaged as the registration did. Without one, they are averaged to about [`LOOK_PX`] pixels
        // a side.
        let longer = sample.rig.camera.size_px.into_iter().max().unwrap_or(0);
        let factor = tried.map_or((longer / LOOK_PX).max(1), |t| t.working.factor);
        // What code values mean may itself have to be found by the build: guessed, all might look black.
        let of_rig = || Some(Sensor::of_capture(sample).ok()?.averaged(factor, 1.0));
        let sensor = tried.map(|t| t.sensor.clone()).or_else(of_rig);
        let Some(sensor) = sensor else { return Ok(()) };
        let saturation_dn =
            tried.map(|t| &t.noise).or(sample.rig.noise.as_ref()).map_or(f64::INFINITY, |n| n.saturation_dn);
        let reduced = sample.reduced(&Reduction::new(factor, saturation_dn, sensor.light_of_codes()));
        let pictures = Pictures::new(&reduced, sensor);
        self.findings.extend(pictures.stills(tried)?.into_iter().map(Warning::from));
        stage.advance(1);
        let Some(tried) = tried else { return Ok(()) };
        self.warned(tried.warnings.iter().cloned());
        let dots = pictures.lattice(tried)?;
        self.findings.extend(dots.findings().into_iter().map(Warning::from));
        (self.figures.dots_looked_at, self.figures.dark_share) = (dots.looked_at, dots.dark_share());
        stage.advance(1);

        self.figures.camera_rms_px = Some(tried.registration.camera_rms_px);
        self.figures.projector_rms_px = Some(tried.registration.projector_rms_px);
        self.drift(tried);
        // In the camera's own pixels.
        let full = factor as f64;
        let sample_px = full * capture.manifest.window.pitch_mm * tried.registration.px_per_mm();
        self.figures.sample_px = Some(sample_px);
        self.figures.psf_px = tried.registration.point_spread.map(|p| full * p.psf_px);
        if let Some(psf_px) = self.figures.psf_px.filter(|psf| *psf > BLUR_SHARE * sample_px) {
            self.found(CheckWarning::Blurred { psf_px, sample_px });
        }
        stage.advance(1);
        Ok(())
    }

    fn drift(&mut self, tried: &BuildReport) {
        let length = |s: &crate::transport::ShotRecord| s.drift_px[0].hypot(s.drift_px[1]);
        let Some(shot) = tried.shots.iter().max_by(|a, b| length(a).total_cmp(&length(b))) else { return };
        let drift_px = length(shot);
        self.figures.drift_most_px = Some(drift_px);
        let most_px = tried.drift_followed_px;
        if drift_px > DRIFT_SHARE * most_px {
            self.found(CheckWarning::LargeDrift { shot: shot.name.clone(), drift_px, most_px });
        }
    }

    /// From the time that the sample took.
    fn estimate(&mut self, capture: &Capture, sample: &Capture, secs: BuildSecs) {
        let photographs = |c: &Capture| c.shots(is_lattice).iter().map(|&s| c.brackets[s].len()).sum::<usize>();
        let more = photographs(capture) as f64 / photographs(sample).max(1) as f64;
        self.figures.build_secs = Some(secs.once + more * secs.lattice);
    }

    fn stop(&mut self, error: Error, dir: &Path) {
        let refusal = Warning::refusal(&error, dir);
        if let Error::Explained { error, .. } = &error {
            // Told by its cause.
            let effect = Warning::refusal(error, dir);
            self.findings.retain(|f| *f != effect);
        }
        // The files' heads may have told it before, in other words.
        let known = self.findings.iter().find(|f| same(f, &refusal)).cloned();
        if known.is_none() {
            self.findings.push(refusal.clone());
        }
        self.refusal = Some(known.unwrap_or(refusal));
        self.stopped_by.get_or_insert(error);
    }

    /// A broken photograph of a shot that was not sampled stops the build too.
    fn stop_at_files(&mut self, dir: &Path) {
        if self.stopped_by.is_some() {
            return;
        }
        let error = self.findings.iter().find_map(|f| match f {
            Warning::Check(CheckWarning::BrokenPhotograph { file, shot, reason }) => {
                Some(Error::BrokenPhotograph { path: dir.join(file), shot: shot.clone(), reason: reason.clone() })
            }
            Warning::Check(CheckWarning::MissingPhotograph { file, shot }) => {
                Some(Error::MissingPhotograph { path: dir.join(file), shot: shot.clone() })
            }
            _ => None,
        });
        if let Some(error) = error {
            self.stop(error, dir);
        }
    }
}

/// Whether two findings are one, in other words or figures.
fn same(a: &Warning, b: &Warning) -> bool {
    a.id() == b.id() && a.record().culprit == b.record().culprit
}

fn is_lattice(pattern: &Pattern) -> bool {
    matches!(pattern, Pattern::Lattice { .. })
}

fn dots(pattern: &Pattern) -> &[[usize; 2]] {
    match pattern {
        Pattern::Lattice { dots } => dots,
        _ => &[],
    }
}

/// The capture with no more than `most` of its lattice shots: the first, the last, and some evenly between.
fn sampled(capture: &Capture, most: usize) -> Capture {
    let lattice = capture.shots(|p| !dots(p).is_empty());
    let last = lattice.len().saturating_sub(1);
    let steps = most.saturating_sub(1).max(1);
    let kept: Vec<usize> = match lattice.len() <= most {
        true => lattice,
        false => (0..most).map(|k| lattice[k * last / steps]).collect(),
    };
    let keep = |s: &usize| !is_lattice(&capture.manifest.shots[*s].pattern) || kept.contains(s);
    let shots: Vec<usize> = (0..capture.manifest.shots.len()).filter(keep).collect();
    let mut sample = capture.clone();
    sample.manifest.shots = shots.iter().map(|&s| capture.manifest.shots[s].clone()).collect();
    sample.brackets = shots.iter().map(|&s| capture.brackets[s].clone()).collect();
    sample
}

/// All dots, of unsampled shots too, as the pipeline requires them.
fn dots_on_slab(capture: &Capture, tried: &BuildReport) -> Result<()> {
    let size = capture.manifest.slab.size_mm;
    for shot in &capture.manifest.shots {
        for &dot in dots(&shot.pattern) {
            let at = tried.registration.slab_from_projector.map(capture.manifest.grid.dot_projector_px(dot));
            if !(0..2).all(|a| at[a] >= 0.0 && at[a] <= size[a]) {
                return Err(Error::DotOutsideSlab {
                    path: capture.manifest_path(),
                    shot: shot.name.clone(),
                    dot,
                    expected: format!("a place on the slab, within {:.2} × {:.2} mm", size[0], size[1]),
                    found: format!("({:.2}, {:.2}) mm", at[0], at[1]),
                });
            }
        }
    }
    Ok(())
}
