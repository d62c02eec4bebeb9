//! From a capture folder to the matrix: the way of the photographs, stage by stage.

use super::{MatrixHeader, MatrixWriter, ShotRecord};
use crate::capture::{Capture, Pattern, Photograph, Rect};
use crate::geometry::Point;
use crate::progress::{Progress, Stage};
use crate::radiance::{Radiance, Sensor, merge_shot};
use crate::registration::{BitPair, Drift, Registration, measure_drift, register_board, register_projector};
use crate::response::{CellWeights, Irradiance, LitDot, RowFindings, WindowGrid, extract_row, window_rect};
use crate::{Error, Result, Warning};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Settings of [`build_matrix`].
#[derive(Debug, Clone, Default)]
pub struct BuildOptions {
    /// The folder of `rig.toml`; by default `calibration` in the capture or beside it.
    pub calibration: Option<PathBuf>,
}

/// What [`build_matrix`] found besides the matrix.
#[derive(Debug, Clone)]
pub struct BuildReport {
    /// Where everything was.
    pub registration: Registration,
    /// Lattice shots with their drift.
    pub shots: Vec<ShotRecord>,
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

/// Pixels around a reference dot's expected place in which it is searched: drift of up to this many pixels is found.
const DRIFT_SEARCH_PX: f64 = 12.0;

/// Builds the matrix of the capture in `dir` and writes it to `out` (see [`MatrixWriter`]).
///
/// Streams: besides the ambient and white pictures one shot per thread is in memory.
///
/// # Errors
/// Those of [`Capture::open`], of decoding and registration; [`Error::DotOutsideSlab`], [`Error::DotSaturated`]; [`Error::Io`] for `out`.
/// Nothing appears at `out` then.
pub fn build_matrix(dir: &Path, options: &BuildOptions, out: &Path, progress: &Progress) -> Result<BuildReport> {
    let capture = {
        let stage = progress.stage("read", 1);
        let capture = Capture::open(dir, options.calibration.as_deref())?;
        stage.advance(1);
        capture
    };
    let mut writer = MatrixWriter::create(out, empty_header(&capture))?;
    let builder = Builder::new(&capture);
    let registration = builder.register(progress)?;
    let prepared = builder.prepare(registration, progress)?;
    let result = prepared.extract(&writer, progress)?;

    let stage = progress.stage("write", 1);
    let report = prepared.finish(result, writer.header_mut())?;
    writer.finish()?;
    stage.advance(1);
    Ok(report)
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

/// What decoding any shot needs.
struct Builder<'a> {
    capture: &'a Capture,
    sensor: Sensor,
    whole: Rect,
    hashes: Mutex<BTreeMap<PathBuf, blake3::Hash>>,
}

impl<'a> Builder<'a> {
    fn new(capture: &'a Capture) -> Self {
        let [width, height] = capture.rig.camera.size_px;
        let whole = Rect { x: 0, y: 0, width, height };
        Self { capture, sensor: Sensor::new(&capture.rig), whole, hashes: Mutex::default() }
    }

    fn merge(&self, shot: usize, rects: &[Rect]) -> Result<Vec<Radiance>> {
        let remember = |p: &Photograph, hash| {
            if let Ok(mut hashes) = self.hashes.lock() {
                hashes.insert(p.path.clone(), hash);
            }
        };
        merge_shot(&self.capture.brackets[shot], rects, self.capture.rig.camera.size_px, &self.sensor, &remember)
    }

    fn merge_whole(&self, shot: usize) -> Result<Radiance> {
        self.merge(shot, &[self.whole])?.pop().ok_or_else(|| Error::internal("a shot merged to nothing"))
    }

    fn one(&self, of: fn(&Pattern) -> bool) -> Result<usize> {
        self.capture.shots(of).first().copied().ok_or_else(|| Error::internal("a checked capture lacks a shot"))
    }

    fn failed(&self, shot: usize) -> impl Fn(String) -> Error {
        let path = self.capture.brackets[shot].last().map_or_else(|| self.capture.manifest_path(), |p| p.path.clone());
        let shot = self.capture.manifest.shots[shot].name.clone();
        move |reason| Error::Registration { path: path.clone(), shot: shot.clone(), reason }
    }

    /// Camera from the board, projector from the Gray code.
    fn register(&self, progress: &Progress) -> Result<Registration> {
        let codes = self.capture.shots(|p| matches!(p, Pattern::GrayCode { .. }));
        let stage = progress.stage("register", 1 + codes.len());
        let board = self.one(|p| matches!(p, Pattern::Board))?;
        let camera = register_board(&self.merge_whole(board)?, &self.capture.rig).map_err(self.failed(board))?;
        stage.advance(1);
        let pairs = self.bit_pairs(&codes, &stage)?;
        let first = codes[0];
        let projector =
            register_projector(&pairs, self.capture.rig.camera.size_px, &camera.view).map_err(self.failed(first))?;
        Registration::new(&camera, &projector, self.capture.manifest.slab.size_mm)
            .ok_or_else(|| self.failed(first)("the projector's map cannot be inverted".into()))
    }

    fn bit_pairs(&self, codes: &[usize], stage: &Stage<'_>) -> Result<Vec<BitPair>> {
        let mut pairs: BTreeMap<(usize, u32), [Option<usize>; 2]> = BTreeMap::new();
        for &s in codes {
            if let Pattern::GrayCode { axis, bit, inverse } = self.capture.manifest.shots[s].pattern {
                let slot = &mut pairs.entry((axis as usize, bit)).or_default()[usize::from(inverse)];
                if slot.replace(s).is_some() {
                    return Err(self.failed(s)("this bit of the Gray code was shot twice".into()));
                }
            }
        }
        let pairs: Vec<_> = pairs.into_iter().collect();
        pairs
            .into_par_iter()
            .map(|((axis, bit), shots)| {
                let [Some(pattern), Some(inverse)] = shots else {
                    let shot = shots.into_iter().flatten().next().unwrap_or(codes[0]);
                    return Err(self.failed(shot)("each bit of the Gray code needs its inverse".into()));
                };
                let light = |s: usize| Ok::<_, Error>(self.merge_whole(s)?.luminance());
                let pair = BitPair { axis, bit, pattern: light(pattern)?, inverse: light(inverse)? };
                stage.advance(2);
                Ok(pair)
            })
            .collect()
    }

    /// Ambient light and irradiance.
    fn prepare(self, registration: Registration, progress: &Progress) -> Result<Prepared<'a>> {
        let stage = progress.stage("reference", 3);
        let shots = [
            self.one(|p| matches!(p, Pattern::SampleBlack))?,
            self.one(|p| matches!(p, Pattern::ReferenceWhite))?,
            self.one(|p| matches!(p, Pattern::ReferenceBlack))?,
        ];
        let mut merged: Vec<Radiance> =
            shots.par_iter().map(|&s| self.merge_whole(s).inspect(|_| stage.advance(1))).collect::<Result<_>>()?;
        let (Some(black), Some(mut white), Some(ambient)) = (merged.pop(), merged.pop(), merged.pop()) else {
            return Err(Error::internal("three shots merged to fewer"));
        };
        white.subtract(&black);
        let px_per_mm = {
            let j = registration.view.jacobian(registration.center_mm);
            (j[0][0] * j[1][1] - j[0][1] * j[1][0]).abs().sqrt()
        };
        let cell_px = px_per_mm * self.capture.manifest.window.pitch_mm;
        let irradiance = Irradiance::new(white, &self.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
        Ok(Prepared { builder: self, registration, ambient, irradiance, px_per_mm, cell_px })
    }
}

/// Everything that lattice shots are measured against.
struct Prepared<'a> {
    builder: Builder<'a>,
    registration: Registration,
    ambient: Radiance,
    irradiance: Irradiance,
    px_per_mm: f64,
    cell_px: f64,
}

/// One lattice shot, measured.
struct ShotResult {
    /// Grid index and place of each dot.
    lit: Vec<([usize; 2], Point)>,
    drift: Option<Drift>,
    findings: Vec<([usize; 2], RowFindings)>,
    albedo_above_one: Vec<f64>,
}

impl Prepared<'_> {
    fn dots(&self, shot: usize) -> &[[usize; 2]] {
        match &self.builder.capture.manifest.shots[shot].pattern {
            Pattern::Lattice { dots } => dots,
            _ => &[],
        }
    }

    fn lattice(&self) -> Vec<usize> {
        self.builder.capture.shots(|p| matches!(p, Pattern::Lattice { .. }))
    }

    /// Where the pattern puts a dot, mm, without drift.
    fn nominal_mm(&self, dot: [usize; 2]) -> Point {
        let grid = &self.builder.capture.manifest.grid;
        self.registration.slab_from_projector.map(grid.dot_projector_px(dot))
    }

    fn reference_mm(&self) -> Vec<Point> {
        let dots = self.builder.capture.manifest.reference_dots.iter().flat_map(|r| &r.projector_px);
        dots.map(|&p| self.registration.slab_from_projector.map(p)).collect()
    }

    /// All lattice shots, in parallel, rows to the writer.
    fn extract(&self, writer: &MatrixWriter, progress: &Progress) -> Result<Vec<ShotResult>> {
        let shots = self.lattice();
        let size = self.builder.capture.manifest.slab.size_mm;
        for &shot in &shots {
            for &dot in self.dots(shot) {
                let at = self.nominal_mm(dot);
                if !(0..2).all(|a| at[a] >= 0.0 && at[a] <= size[a]) {
                    return Err(Error::DotOutsideSlab {
                        path: self.builder.capture.manifest_path(),
                        shot: self.builder.capture.manifest.shots[shot].name.clone(),
                        dot,
                        expected: format!("a place on the slab, within {:.2} × {:.2} mm", size[0], size[1]),
                        found: format!("({:.2}, {:.2}) mm", at[0], at[1]),
                    });
                }
            }
        }
        let photographs = shots.iter().map(|&s| self.builder.capture.brackets[s].len()).sum();
        let stage = progress.stage("extract", photographs);
        shots
            .into_par_iter()
            .with_max_len(1)
            .map(|shot| {
                let result = self.extract_shot(shot, writer)?;
                stage.advance(self.builder.capture.brackets[shot].len());
                Ok(result)
            })
            .collect()
    }

    fn extract_shot(&self, shot: usize, writer: &MatrixWriter) -> Result<ShotResult> {
        let manifest = &self.builder.capture.manifest;
        let size_px = self.builder.capture.rig.camera.size_px;
        let dots = self.dots(shot);
        let references = self.reference_mm();
        let radius_px = self.dot_radius_px();
        // Rectangles: reference dots, then each window with room for its drift.
        let mut rects: Vec<Rect> = Vec::new();
        for &p in &references {
            let q = self.registration.view.camera_from_slab(p);
            rects.push(square(q, radius_px + DRIFT_SEARCH_PX, size_px).ok_or_else(|| self.outside_picture(shot))?);
        }
        for &dot in dots {
            let grid = WindowGrid::new(&manifest.window, self.nominal_mm(dot), &self.registration.view);
            let rect = window_rect(&grid, size_px).ok_or_else(|| self.outside_picture(shot))?;
            rects.push(grown(rect, DRIFT_SEARCH_PX as usize, size_px));
        }
        let mut pictures = self.builder.merge(shot, &rects)?;
        pictures.iter_mut().for_each(|p| p.subtract(&self.ambient));
        let windows = pictures.split_off(references.len());
        let drift = self.drift(dots, &references, pictures, &windows, radius_px);
        let moved = drift.map_or([0.0; 2], |d| d.slab_mm);

        let mut result = ShotResult { lit: vec![], drift, findings: vec![], albedo_above_one: vec![] };
        let mut weights = CellWeights::new(self.cell_px);
        for (&dot, picture) in dots.iter().zip(&windows) {
            let nominal = self.nominal_mm(dot);
            let center = [nominal[0] + moved[0], nominal[1] + moved[1]];
            let grid = WindowGrid::new(&manifest.window, center, &self.registration.view);
            let lit = self.lit_dot(shot, dot, center, drift)?;
            let (row, findings) =
                extract_row(picture, &grid, &lit, self.irradiance.sensitivity(), manifest.slab.size_mm, &mut weights);
            self.check_peak(shot, dot, center, picture)?;
            let area = manifest.window.pitch_mm.powi(2);
            let albedo =
                (0..3).map(|c| row.response.iter().skip(c).step_by(3).map(|&r| f64::from(r)).sum::<f64>() * area);
            result.albedo_above_one.extend(albedo.reduce(f64::max).filter(|a| *a > 1.0));
            writer.put(manifest.row_index(dot), &row)?;
            result.lit.push((dot, center));
            result.findings.push((dot, findings));
        }
        Ok(result)
    }

    fn drift(
        &self,
        dots: &[[usize; 2]],
        references: &[Point],
        pictures: Vec<Radiance>,
        windows: &[Radiance],
        radius_px: f64,
    ) -> Option<Drift> {
        if !references.is_empty() {
            let seen: Vec<_> = references.iter().copied().zip(pictures).collect();
            return measure_drift(&seen, &self.registration, radius_px);
        }
        let seen: Vec<_> = dots.iter().map(|&d| self.nominal_mm(d)).zip(windows.iter().cloned()).collect();
        measure_drift(&seen, &self.registration, radius_px)
    }

    fn lit_dot(&self, shot: usize, dot: [usize; 2], center: Point, drift: Option<Drift>) -> Result<LitDot> {
        let grid = &self.builder.capture.manifest.grid;
        let pixel_mm2 = self.registration.slab_from_projector.area_scale(grid.dot_projector_px(dot));
        let area_mm2 = pixel_mm2 * (grid.dot_projector_px * grid.dot_projector_px) as f64;
        let at = self.registration.view.camera_from_slab(center);
        let flux = self.irradiance.flux(at, area_mm2).ok_or_else(|| {
            let name = &self.builder.capture.manifest.shots[shot].name;
            let found = "a saturated, black or missing reference there";
            let field = format!("shot \"{name}\", dot {dot:?}");
            Error::field(
                self.builder.capture.manifest_path(),
                field,
                "a measured white reference around the dot",
                found,
            )
        })?;
        let drift_sd = drift.map_or(0.0, |d| d.sd_px / self.px_per_mm);
        Ok(LitDot { center_mm: center, position_sd_mm: self.registration.position_sd_mm.hypot(drift_sd), flux })
    }

    /// A dot of whose middle no exposure measured any pixel cannot be used at all.
    fn check_peak(&self, shot: usize, dot: [usize; 2], center: Point, picture: &Radiance) -> Result<()> {
        let q = self.registration.view.camera_from_slab(center);
        let inside = |v: f64, from: usize, len: usize| (v.round().max(from as f64) as usize).min(from + len - 1);
        let r = picture.rect;
        let k = picture.at(inside(q[0], r.x, r.width), inside(q[1], r.y, r.height));
        let bracket = &self.builder.capture.brackets[shot];
        match bracket.first() {
            Some(shortest) if picture.used[k..k + 3].contains(&0) => Err(Error::DotSaturated {
                path: shortest.path.clone(),
                shot: shortest.shot.clone(),
                dot,
                shortest_secs: shortest.exposure_secs,
            }),
            _ => Ok(()),
        }
    }

    fn dot_radius_px(&self) -> f64 {
        let grid = &self.builder.capture.manifest.grid;
        let middle = self.nominal_mm([grid.points[0] / 2, grid.points[1] / 2]);
        let pixel_mm = self.registration.slab_from_projector.area_scale(grid.dot_projector_px([0, 0])).sqrt();
        debug_assert!(middle[0].is_finite());
        0.75 * grid.dot_projector_px as f64 * pixel_mm * self.px_per_mm
    }

    fn outside_picture(&self, shot: usize) -> Error {
        self.builder.failed(shot)("a dot lies outside the photograph".into())
    }

    /// Fills the header from the shots' results and gathers the findings.
    fn finish(&self, results: Vec<ShotResult>, header: &mut MatrixHeader) -> Result<BuildReport> {
        let capture = self.builder.capture;
        let mut warnings = capture.warnings.clone();
        let mut clipped = (0, 0);
        let mut bright: Vec<f64> = Vec::new();
        for (number, (&shot, result)) in self.lattice().iter().zip(&results).enumerate() {
            let name = capture.manifest.shots[shot].name.clone();
            let saturated: usize = result.findings.iter().map(|f| f.1.saturated).sum();
            if saturated > 0 {
                warnings.push(Warning::SaturatedSamples { shot: name.clone(), samples: saturated });
            }
            for (_, f) in result.findings.iter().filter(|f| f.1.clipped > 0) {
                clipped = (clipped.0 + 1, clipped.1 + f.clipped);
            }
            if result.drift.is_none() {
                warnings.push(Warning::DriftUnmeasured { shot: name.clone() });
            }
            bright.extend(&result.albedo_above_one);
            let sd_mm = self.registration.position_sd_mm.hypot(result.drift.map_or(0.0, |d| d.sd_px / self.px_per_mm));
            for &(dot, place) in &result.lit {
                let row = capture.manifest.row_index(dot);
                header.lit_mm[row] = place;
                header.position_sd_mm[row] = sd_mm;
                header.shot_of[row] = Some(number);
            }
            let drift_px = result.drift.map_or([0.0; 2], |d| d.camera_px);
            header.shots.push(ShotRecord { name, drift_px, drift_sd_px: result.drift.map(|d| d.sd_px) });
        }
        if clipped.0 > 0 {
            warnings.push(Warning::ClippedWindow { rows: clipped.0, samples: clipped.1 });
        }
        if let Some(largest) = bright.iter().copied().reduce(f64::max) {
            warnings.push(Warning::AlbedoAboveOne { rows: bright.len(), largest });
        }
        if capture.manifest.reference_dots.is_none() {
            warnings.push(Warning::DriftFromLatticeDots);
        }
        self.complete_header(header, &mut warnings);
        header.provenance = self.provenance()?;
        header.warnings = warnings.clone();
        Ok(BuildReport {
            registration: self.registration.clone(),
            shots: header.shots.clone(),
            warnings,
            photographs: capture.photographs(),
            points: header.points,
            window: header.window,
            overview: self.overview(header)?,
        })
    }

    /// Places of unlit points, the lit pitch, and the findings that need all shots together.
    fn complete_header(&self, header: &mut MatrixHeader, warnings: &mut Vec<Warning>) {
        let [nx, ny] = header.points;
        let unlit: Vec<usize> = (0..nx * ny).filter(|&r| header.shot_of[r].is_none()).collect();
        for &row in &unlit {
            header.lit_mm[row] = self.nominal_mm([row % nx, row / nx]);
        }
        if !unlit.is_empty() {
            warnings.push(Warning::UnlitPoints { rows: unlit.len() });
        }
        let ends = |dot: [usize; 2]| self.nominal_mm(dot);
        let far = [ends([nx - 1, 0]), ends([0, ny - 1])];
        let first = ends([0, 0]);
        for a in 0..2 {
            if header.points[a] > 1 {
                let d = [far[a][0] - first[0], far[a][1] - first[1]];
                header.lit_pitch_mm[a] = d[0].hypot(d[1]) / (header.points[a] - 1) as f64;
            }
        }
        if let Some(spacing_samples) = self.smallest_spacing() {
            let window_samples = header.window[0].max(header.window[1]);
            if spacing_samples < window_samples as f64 {
                warnings.push(Warning::CrossTalk { spacing_samples, window_samples });
            }
        }
        if let Some(outside_mm) = self.outside_board() {
            warnings.push(Warning::BoardTooSmall { outside_mm });
        }
    }

    /// The smallest distance (larger of the two axes) between dots of one shot, in outgoing samples; `None` for single dots.
    fn smallest_spacing(&self) -> Option<f64> {
        let grid = &self.builder.capture.manifest.grid;
        let first = self.nominal_mm([0, 0]);
        let step = self.nominal_mm([1.min(grid.points[0] - 1), 1.min(grid.points[1] - 1)]);
        let pitch = self.builder.capture.manifest.window.pitch_mm;
        let samples: Point = std::array::from_fn(|a| (step[a] - first[a]).abs() / pitch);
        let nearest = |shot: &usize| {
            let mut dots = self.dots(*shot).to_vec();
            dots.sort_unstable();
            // In sorted order a dot's nearest neighbour is near; looking at 64 finds it on any lattice.
            let gap = |a: [usize; 2], b: [usize; 2]| {
                (0..2).map(|k| a[k].abs_diff(b[k]) as f64 * samples[k]).fold(0.0, f64::max)
            };
            let pairs =
                dots.iter().enumerate().flat_map(|(i, &a)| dots[i + 1..].iter().take(64).map(move |&b| gap(a, b)));
            pairs.reduce(f64::min)
        };
        self.lattice().iter().filter_map(nearest).reduce(f64::min)
    }

    /// How far the slab reaches beyond the board's corners, mm; `None` when it does not by more than a square.
    fn outside_board(&self) -> Option<f64> {
        let board = &self.builder.capture.rig.board;
        let far = board.corner_mm([board.inner_corners[0] - 1, board.inner_corners[1] - 1]);
        let size = self.builder.capture.manifest.slab.size_mm;
        let outside = (0..2).map(|a| board.origin_mm[a].max(size[a] - far[a])).fold(0.0, f64::max);
        (outside > board.square_mm).then_some(outside)
    }

    fn provenance(&self) -> Result<serde_json::Value> {
        let capture = self.builder.capture;
        let hash_file =
            |p: &Path| Ok::<_, Error>(blake3::hash(&std::fs::read(p).map_err(Error::io("read", p))?).to_string());
        let mut all = blake3::Hasher::new();
        for hash in self.builder.hashes.lock().map_err(Error::internal)?.values() {
            all.update(hash.as_bytes());
        }
        let registration = serde_json::to_value(&self.registration).map_err(Error::internal)?;
        Ok(serde_json::json!({
            "program": format!("acquire {}", env!("CARGO_PKG_VERSION")),
            "capture": capture.manifest.name,
            "photographs": capture.photographs(),
            "capture_toml_blake3": hash_file(&capture.manifest_path())?,
            "rig_toml_blake3": hash_file(&capture.rig_path)?,
            "photographs_blake3": all.finalize().to_string(),
            "registration": registration,
        }))
    }

    fn overview(&self, header: &MatrixHeader) -> Result<Overview> {
        let manifest = &self.builder.capture.manifest;
        let lattice = self.lattice();
        // The shot with most dots, the middle one of these: something to see.
        let most = lattice.iter().map(|&s| self.dots(s).len()).max().unwrap_or(0);
        let full: Vec<usize> = (0..lattice.len()).filter(|&k| self.dots(lattice[k]).len() == most).collect();
        let shot = lattice[full[full.len() / 2]];
        let camera = |p: Point| self.registration.view.camera_from_slab(p);
        let half: Point = std::array::from_fn(|a| manifest.window.samples[a] as f64 * manifest.window.pitch_mm / 2.0);
        let corners = |c: Point| {
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                .map(|s| camera([c[0] + s[0] * half[0], c[1] + s[1] * half[1]]))
        };
        let lit: Vec<Point> = self.dots(shot).iter().map(|&d| header.lit_mm[manifest.row_index(d)]).collect();
        let [w, h] = manifest.slab.size_mm;
        let [nx, ny] = manifest.grid.points;
        Ok(Overview {
            shot: manifest.shots[shot].name.clone(),
            radiance: self.builder.merge_whole(shot)?,
            exposures: self.builder.capture.brackets[shot].len(),
            grid_px: (0..nx * ny).map(|r| camera(self.nominal_mm([r % nx, r / nx]))).collect(),
            lit_px: lit.iter().map(|&p| camera(p)).collect(),
            windows_px: lit.iter().map(|&p| corners(p)).collect(),
            reference_dots_px: self.reference_mm().into_iter().map(camera).collect(),
            slab_px: [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(camera),
        })
    }
}

/// The square of half side `radius` around `at`, cut to the photograph; `None` when it lies outside.
fn square(at: Point, radius: f64, size_px: [usize; 2]) -> Option<Rect> {
    let range = |a: usize| {
        let (low, high) = ((at[a] - radius).floor().max(0.0), (at[a] + radius).ceil().min(size_px[a] as f64 - 1.0));
        (low <= high).then_some((low as usize, (high - low) as usize + 1))
    };
    let ((x, width), (y, height)) = (range(0)?, range(1)?);
    Some(Rect { x, y, width, height })
}

fn grown(r: Rect, by: usize, size_px: [usize; 2]) -> Rect {
    let (x, y) = (r.x.saturating_sub(by), r.y.saturating_sub(by));
    let (right, bottom) = ((r.x + r.width + by).min(size_px[0]), (r.y + r.height + by).min(size_px[1]));
    Rect { x, y, width: right - x, height: bottom - y }
}
