//! What the shots together say: the header, the warnings, the provenance, the overview.

use super::lattice::{LightCorrections, ShotResult};
use super::reference_dots::{LEAST_SCALE, WIDER, change_within, ends};
use super::register::Registered;
use super::resume::TakenOver;
use super::scene::Scene;
use super::{Before, BuildReport, BuildSecs, CrossTalk, Overview};
use crate::capture::{Manifest, Pattern};
use crate::geometry::Point;
use crate::radiance::HotPixel;
use crate::registration::{CameraMotion, Jump, PointSpread, find_jumps};
use crate::transport::{MatrixHeader, ShotRecord};
use crate::warning::bounds::{LARGEST_ALBEDO, SPREAD_VARIES_PX, STRAY_TOLD, STRONG_BLUR_PX};
use crate::{
    ConsistencyWarning, DriftJump, Error, RadianceWarning, RegistrationWarning, ResponseWarning, Result, Warning,
};
use std::path::Path;

/// What the stages before the lattice shots found.
pub(super) struct Stages<'a> {
    pub before: &'a Before<'a>,
    pub registered: &'a Registered,
    pub light: &'a LightCorrections,
}

/// The header of the matrix and the findings of all stages.
pub(super) fn summarize(
    scene: &Scene<'_>,
    found: &Stages<'_>,
    results: &[ShotResult],
    crosstalk: Option<CrossTalk>,
    secs: BuildSecs,
) -> Result<(MatrixHeader, BuildReport)> {
    let capture = scene.capture;
    let hot: Vec<&HotPixel> = scene.references.hot.iter().chain(found.before.defects).collect();
    let mut header = unmeasured(&capture.manifest);
    // Pixels of the photographs in one of the working resolution.
    let full = found.before.working.factor as f64;
    let mut warnings: Vec<Warning> = capture.warnings.iter().cloned().map(Warning::from).collect();
    warnings.extend(found.registered.warnings.iter().cloned());
    warnings.extend(found.before.noise.warnings.iter().cloned());
    warnings.extend(found.before.radiometry.warnings.iter().cloned());
    if !hot.is_empty() {
        let stuck = hot.iter().filter(|h| h.excess.is_none()).count();
        let strongest = hot.iter().filter_map(|h| h.excess).map(f64::from).fold(0.0, f64::max);
        warnings
            .push(RadianceWarning::HotPixels { photosites: hot.len(), stuck, strongest_dn_per_sec: strongest }.into());
    }
    let mut clipped = (0, 0);
    let mut bright: Vec<f64> = Vec::new();
    let mut saturated: Option<(String, usize, usize)> = None;
    let mut unmeasured: Option<(String, usize)> = None;
    for (number, (&shot, result)) in scene.lattice().iter().zip(results).enumerate() {
        let name = capture.manifest.shots[shot].name.clone();
        let samples: usize = result.lit.iter().map(|l| l.findings.saturated).sum();
        if samples > 0 {
            let (_, shots, all) = saturated.get_or_insert((name.clone(), 0, 0));
            (*shots, *all) = (*shots + 1, *all + samples);
        }
        for lit in result.lit.iter().filter(|l| l.findings.clipped > 0) {
            clipped = (clipped.0 + 1, clipped.1 + lit.findings.clipped);
        }
        if result.drift.is_none() {
            unmeasured.get_or_insert((name.clone(), 0)).1 += 1;
        }
        bright.extend(result.lit.iter().map(|l| l.albedo).filter(|a| *a > LARGEST_ALBEDO));
        let sd_mm = scene.registration.position_sd_mm.hypot(result.drift.map_or(0.0, |d| d.sd_px / scene.px_per_mm));
        for lit in &result.lit {
            let row = capture.manifest.grid.row_index(lit.dot);
            header.lit_mm[row] = lit.center_mm;
            header.position_sd_mm[row] = sd_mm;
            header.shot_of[row] = Some(number);
        }
        let drift_px = result.drift.map_or([0.0; 2], |d| d.camera_px.map(|v| full * v));
        // The dots are seen against a camera whose own movement has its uncertainty.
        let camera_sd = result.camera.filter(CameraMotion::is_sure).map_or(0.0, |m| m.sd_px);
        header.shots.push(ShotRecord {
            name,
            drift_px,
            drift_sd_px: result.drift.map(|d| full * d.sd_px.hypot(camera_sd)),
        });
    }
    warnings.extend(
        saturated.map(|(first, shots, samples)| ResponseWarning::SaturatedSamples { first, shots, samples }.into()),
    );
    warnings.extend(unmeasured.map(|(first, shots)| RegistrationWarning::DriftUnmeasured { first, shots }.into()));
    warnings.extend(jumps(results, &header, full).map(Warning::from));
    warnings.extend(camera_moved(results, &header, full).map(Warning::from));
    if clipped.0 > 0 {
        warnings.push(ResponseWarning::ClippedWindow { rows: clipped.0, samples: clipped.1 }.into());
    }
    if let Some(largest) = bright.iter().copied().reduce(f64::max) {
        warnings.push(ResponseWarning::AlbedoAboveOne { rows: bright.len(), largest }.into());
    }
    if capture.manifest.reference_dots.is_none() {
        let depth = results.iter().find_map(|r| r.drift?.depth);
        warnings.push(RegistrationWarning::DriftFromLatticeDots { depth }.into());
    }
    let remaining = results.iter().map(|r| r.flicker_variance).sum::<f64>() / results.len().max(1) as f64;
    warnings.extend(found.light.flicker.warning(remaining).map(Warning::from));
    warnings.extend(lamp(results, &header).map(Warning::from));
    warnings.extend(found.light.flicker.drift(results.len()).map(Warning::from));
    warnings.extend(reference_dots(results, &header).into_iter().map(Warning::from));
    complete(scene, found.light, &mut header, &mut warnings);
    warnings.extend(crosstalk.as_ref().and_then(CrossTalk::warning).map(Warning::from));
    header.camera_px_per_mm = Some(full * scene.px_per_mm);
    header.provenance = provenance(scene, found, crosstalk.as_ref(), remaining)?;
    header.warnings = warnings.clone();
    let report = BuildReport {
        registration: scene.registration.clone(),
        noise: found.before.noise.noise.clone(),
        sensor: scene.photographs.sensor.clone(),
        shots: header.shots.clone(),
        crosstalk,
        warnings,
        working: found.before.working,
        drift_followed_px: full * scene.drift_followed_px(),
        photographs: capture.photographs(),
        points: header.points,
        window: header.window,
        overview: overview(scene, &header)?,
        secs,
        taken_over: TakenOver::default(),
        unused_parts: vec![],
    };
    Ok((header, report))
}

/// Places of unlit points, the lit pitch, and the findings that need all shots together.
fn complete(scene: &Scene<'_>, light: &LightCorrections, header: &mut MatrixHeader, warnings: &mut Vec<Warning>) {
    let [nx, ny] = header.points;
    let unlit: Vec<usize> = (0..nx * ny).filter(|&r| header.shot_of[r].is_none()).collect();
    for &row in &unlit {
        header.lit_mm[row] = scene.nominal_mm([row % nx, row / nx]);
    }
    if !unlit.is_empty() {
        warnings.push(ResponseWarning::UnlitPoints { rows: unlit.len() }.into());
    }
    let ends = |dot: [usize; 2]| scene.nominal_mm(dot);
    let far = [ends([nx - 1, 0]), ends([0, ny - 1])];
    let first = ends([0, 0]);
    for a in 0..2 {
        if header.points[a] > 1 {
            let d = [far[a][0] - first[0], far[a][1] - first[1]];
            header.lit_pitch_mm[a] = d[0].hypot(d[1]) / (header.points[a] - 1) as f64;
        }
    }
    if light.stray.share > STRAY_TOLD {
        warnings.push(RadianceWarning::StrayLight { share: light.stray.share }.into());
    }
    if let Some(PointSpread { psf_px, .. }) = scene.registration.point_spread.filter(|p| p.psf_px > STRONG_BLUR_PX) {
        warnings.push(RegistrationWarning::StronglyBlurred { psf_px }.into());
    }
    match scene.registration.point_spread {
        None => warnings.push(RegistrationWarning::PointSpreadUnmeasured.into()),
        Some(PointSpread { psf_px, range_px, .. }) if range_px[1] - range_px[0] > SPREAD_VARIES_PX => {
            warnings.push(RegistrationWarning::PointSpreadVaries { psf_px, range_px }.into());
        }
        Some(_) => {}
    }
    if let Some(outside_mm) = outside_board(scene) {
        warnings.push(RegistrationWarning::BoardTooSmall { outside_mm }.into());
    }
}

/// How far the slab reaches beyond the board's corners, mm; `None` when it does not by more than a square.
fn outside_board(scene: &Scene<'_>) -> Option<f64> {
    // The frame's marks are all around the slab.
    if !scene.capture.shots(|p| matches!(p, Pattern::Frame)).is_empty() {
        return None;
    }
    let board = scene.capture.rig.board.as_ref()?;
    let far = board.corner_mm([board.inner_corners[0] - 1, board.inner_corners[1] - 1]);
    let size = scene.capture.manifest.slab.size_mm;
    let outside = (0..2).map(|a| board.origin_mm[a].max(size[a] - far[a])).fold(0.0, f64::max);
    (outside > board.square_mm).then_some(outside)
}

fn provenance(
    scene: &Scene<'_>,
    stages: &Stages<'_>,
    crosstalk: Option<&CrossTalk>,
    flicker_variance: f64,
) -> Result<serde_json::Value> {
    let capture = scene.capture;
    let hash_file = |p: &Path| crate::files::hash(p).map(|hash| hash.to_string()).map_err(Error::io("read", p));
    let found = stages.before.noise;
    let noise = serde_json::json!({
        "used": found.noise,
        "source": if found.from_rig { "rig.toml" } else { "photographs" },
        "estimate": found.estimate,
    });
    let registration = serde_json::to_value(scene.registration).map_err(Error::internal)?;
    Ok(serde_json::json!({
        "program": format!("acquire {}", env!("CARGO_PKG_VERSION")),
        "capture": capture.manifest.name,
        "photographs": capture.photographs(),
        "capture_toml_blake3": hash_file(&capture.manifest_path())?,
        "rig_toml_blake3": hash_file(&capture.rig_path)?,
        "photographs_blake3": scene.photographs.hash()?.to_string(),
        "noise": noise,
        "working_resolution": stages.before.working,
        "radiometry": stages.before.radiometry.record,
        "flicker": stages.light.flicker.record(flicker_variance),
        "registration": registration,
        "stray_light": serde_json::to_value(&stages.light.stray).map_err(Error::internal)?,
        "crosstalk": serde_json::to_value(crosstalk).map_err(Error::internal)?,
    }))
}

fn overview(scene: &Scene<'_>, header: &MatrixHeader) -> Result<Overview> {
    let manifest = &scene.capture.manifest;
    let lattice = scene.lattice();
    // The shot with most dots, the middle one of these: something to see.
    let most = lattice.iter().map(|&s| scene.dots(s).len()).max().unwrap_or(0);
    let full: Vec<usize> = (0..lattice.len()).filter(|&k| scene.dots(lattice[k]).len() == most).collect();
    let shot = lattice[full[full.len() / 2]];
    let camera = |p: Point| scene.registration.view.camera_from_slab(p);
    let half: Point = std::array::from_fn(|a| manifest.window.samples[a] as f64 * manifest.window.pitch_mm / 2.0);
    let corners = |c: Point| {
        [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
            .map(|s| camera([c[0] + s[0] * half[0], c[1] + s[1] * half[1]]))
    };
    let lit: Vec<Point> = scene.dots(shot).iter().map(|&d| header.lit_mm[manifest.grid.row_index(d)]).collect();
    let [w, h] = manifest.slab.size_mm;
    let [nx, ny] = manifest.grid.points;
    Ok(Overview {
        shot: manifest.shots[shot].name.clone(),
        radiance: scene.photographs.merge_whole(shot)?,
        exposures: scene.photographs.brackets[shot].len(),
        grid_px: (0..nx * ny).map(|r| camera(scene.nominal_mm([r % nx, r / nx]))).collect(),
        lit_px: lit.iter().map(|&p| camera(p)).collect(),
        windows_px: lit.iter().map(|&p| corners(p)).collect(),
        reference_dots_px: scene.reference_mm().into_iter().map(camera).collect(),
        slab_px: [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(camera),
    })
}

impl BuildReport {
    /// RMS of the shots' drift per axis, camera px.
    pub fn drift_rms_px(&self) -> f64 {
        let sum: f64 = self.shots.iter().map(|s| s.drift_px[0].powi(2) + s.drift_px[1].powi(2)).sum();
        (sum / (2 * self.shots.len().max(1)) as f64).sqrt()
    }

    /// What was measured, for programs; names and units are those of `check`'s figures where both have them.
    ///
    /// # Errors
    /// [`Error::Internal`].
    pub fn figures(&self) -> Result<serde_json::Value> {
        Ok(serde_json::json!({
            "photographs": self.photographs,
            "lattice_shots": self.shots.len(),
            "points": self.points,
            "window": self.window,
            "camera_rms_px": self.registration.camera_rms_px,
            "projector_rms_px": self.registration.projector_rms_px,
            "psf_px": self.registration.point_spread.map(|p| self.working.factor as f64 * p.psf_px),
            "drift_rms_px": self.drift_rms_px(),
            "noise": serde_json::to_value(&self.noise).map_err(Error::internal)?,
            "working_resolution": serde_json::to_value(self.working).map_err(Error::internal)?,
            "crosstalk": serde_json::to_value(&self.crosstalk).map_err(Error::internal)?,
            "secs": self.secs.once + self.secs.lattice,
        }))
    }
}

/// The header before any row is measured.
pub(super) fn unmeasured(m: &Manifest) -> MatrixHeader {
    MatrixHeader {
        points: m.grid.points,
        window: m.window.samples,
        pitch_mm: m.window.pitch_mm,
        lit_pitch_mm: [m.window.pitch_mm; 2],
        lit_mm: vec![[0.0; 2]; m.grid.len()],
        position_sd_mm: vec![0.0; m.grid.len()],
        shot_of: vec![None; m.grid.len()],
        common: None,
        shots: vec![],
        camera_px_per_mm: None,
        warnings: vec![],
        provenance: serde_json::Value::Null,
    }
}

/// Shots under another level of the lamp.
fn lamp(results: &[ShotResult], header: &MatrixHeader) -> Option<ConsistencyWarning> {
    let off: Vec<(usize, [f64; 2])> = results.iter().enumerate().filter_map(|(k, r)| Some((k, r.lamp?))).collect();
    let &(worst, [level, level_sd]) = off.iter().max_by(|a, b| a.1[0].ln().abs().total_cmp(&b.1[0].ln().abs()))?;
    let shot = header.shots.get(worst)?.name.clone();
    Some(ConsistencyWarning::LampLevel { shot, level, level_sd, shots: off.len() })
}

/// Dots that are wider by so many deviations of what shots differ by from the one before are blurred; farther apart,
/// zoomed.
const CHANGE_SIGMA: f64 = 8.0;

/// Shots whose reference dots differ from each other, in colour, or in width.
fn reference_dots(results: &[ShotResult], header: &MatrixHeader) -> Vec<ConsistencyWarning> {
    let mut warnings = Vec::new();
    let name = |k: usize| header.shots.get(k).map_or_else(String::new, |s| s.name.clone());
    let all = |of: &dyn Fn(&ShotResult) -> bool| (0..results.len()).filter(|&k| of(&results[k])).collect::<Vec<_>>();
    let strange = all(&|r| r.dots_show.strange > 0);
    if let Some(&first) = strange.first() {
        let dots = results[first].dots_show.strange;
        warnings.push(ConsistencyWarning::ReferenceDots { shot: name(first), dots, shots: strange.len() });
    }
    let coloured = all(&|r| r.dots_show.colour.is_some());
    if let Some((&first, levels)) = coloured.first().and_then(|k| Some((k, results[*k].dots_show.colour?))) {
        warnings.push(ConsistencyWarning::ColourChanges { shot: name(first), levels, shots: coloured.len() });
    }
    let spread = |r: &ShotResult| r.dots_show.spread_px2;
    let spreads: Vec<f64> = results.iter().filter_map(spread).collect();
    // The sharpest quarter: from one shot on, all others may be blurred.
    let mut sharpest = spreads.clone();
    sharpest.sort_by(f64::total_cmp);
    let sharp = sharpest.get(sharpest.len() / 4).copied().unwrap_or(0.0);
    let limit = sharp + (WIDER * sharp).max(CHANGE_SIGMA * change_within(&spreads));
    let wide = all(&|r| spread(r).is_some_and(|s| s > limit));
    let widest = wide.iter().filter_map(|&k| spread(&results[k])).fold(0.0, f64::max);
    let scale = scale(results);
    // Another zoom makes dots wider, too.
    if let Some(&first) = wide.first().filter(|_| scale.is_none()) {
        // Of both axes.
        let added_px = (0.5 * (widest - sharp)).sqrt();
        warnings.push(ConsistencyWarning::BlurChanges { shot: name(first), added_px, shots: wide.len() });
    }
    warnings.extend(scale.map(|(first, [scale, sd], shots)| ConsistencyWarning::ScaleChanges {
        shot: name(first),
        scale,
        sd,
        shots,
    }));
    warnings
}

/// The first shot whose dots are farther apart than those of the first third of the shots, by how much, and how many
/// are.
fn scale(results: &[ShotResult]) -> Option<(usize, [f64; 2], usize)> {
    let found: Vec<(usize, [f64; 2])> =
        results.iter().enumerate().filter_map(|(k, r)| Some((k, r.drift?.scale?))).collect();
    let all: Vec<f64> = found.iter().map(|f| f.1[0]).collect();
    let [usual, _] = ends(&all);
    let within = change_within(&all);
    let off = |f: &&(usize, [f64; 2])| (f.1[0] - usual).abs() > LEAST_SCALE.max(CHANGE_SIGMA * within.hypot(f.1[1]));
    let off: Vec<&(usize, [f64; 2])> = found.iter().filter(off).collect();
    let &&(first, [scale, sd]) = off.first()?;
    (all.len() >= 4).then(|| (first, [scale / usual, sd / usual], off.len()))
}

/// Shots before which the pattern has jumped.
fn jumps(results: &[ShotResult], header: &MatrixHeader, full: f64) -> Option<RegistrationWarning> {
    let path: Vec<_> = results.iter().map(|r| r.drift.map(|d| (d.camera_px, d.sd_px))).collect();
    let found = find_jumps(&path);
    let named =
        |j: &Jump| header.shots.get(j.at).map(|s| DriftJump { shot: s.name.clone(), length_px: full * j.length_px });
    (!found.is_empty()).then(|| RegistrationWarning::DriftJumps { jumps: found.iter().filter_map(named).collect() })
}

/// Shots in which the camera's picture has moved; all were corrected.
fn camera_moved(results: &[ShotResult], header: &MatrixHeader, full: f64) -> Option<RegistrationWarning> {
    let length = |r: &ShotResult| r.camera.filter(CameraMotion::is_sure).map(|m| m.camera_px[0].hypot(m.camera_px[1]));
    let moved: Vec<(usize, f64)> = results.iter().enumerate().filter_map(|(k, r)| Some((k, length(r)?))).collect();
    let first = header.shots.get(moved.first()?.0)?.name.clone();
    let largest_px = full * moved.iter().map(|m| m.1).fold(0.0, f64::max);
    let measured = results.iter().filter(|r| r.camera.is_some()).count();
    Some(RegistrationWarning::CameraMoved { first, shots: moved.len(), measured, largest_px })
}
