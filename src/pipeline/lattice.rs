//! The lattice shots: drift, windows, rows.

use super::Prepared;
use super::dots_seen::DotSeen;
use super::flicker::{Flicker, Steadied};
use super::reference_dots::DotsShow;
use super::remains::{Sought, Spots};
use super::resume::{Resumed, TakenOver};
use super::scene::{STILL, Scene, grown, on_slab, overlap};
use super::sink::RowSink;
use crate::capture::{Sampling, Window};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{Bracket, Radiance, StrayLight};
use crate::registration::{CameraMotion, Drift};
use crate::response::{CellWeights, Flux, LitDot, RowFindings, WindowGrid, extract_row, window_rect};
use crate::transport::Row;
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// One lattice shot, measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct ShotResult {
    pub(super) lit: Vec<LitPoint>,
    pub(super) drift: Option<Drift>,
    pub(super) camera: Option<CameraMotion>,
    /// Relative variance that flicker leaves in each row.
    pub(super) flicker_variance: f64,
    /// The lamp's level over that of most shots and its standard deviation, where it was taken out as no flicker.
    pub(super) lamp: Option<[f64; 2]>,
    /// What its reference dots show besides.
    pub(super) dots_show: DotsShow,
    /// Where each of its dots was seen.
    pub(super) seen: Vec<DotSeen>,
    /// Its light at its own dots and at those of the patterns beside.
    pub(super) spots: Spots,
}

/// One dot of a shot, measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct LitPoint {
    pub(super) dot: [usize; 2],
    pub(super) center_mm: Point,
    pub(super) flux: [f64; 3],
    /// Relative variance of what all samples of its row have in common.
    pub(super) scale_variance: [f64; 3],
    pub(super) findings: RowFindings,
    /// The largest of the channels.
    pub(super) albedo: f64,
    /// Radius around the dot within which half of the window's light leaves, mm.
    pub(super) half_light_mm: f64,
}

/// What the light of the lattice shots is corrected by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct LightCorrections {
    /// The camera's halo.
    pub(super) stray: StrayLight,
    /// The lamp's.
    pub(super) flicker: Flicker,
}

/// Refuses dots that the pattern puts beside the slab.
///
/// # Errors
/// [`Error::DotOutsideSlab`].
pub(super) fn check_dots(scene: &Scene<'_>) -> Result<()> {
    let size = scene.capture.manifest.slab.size_mm;
    for shot in scene.lattice() {
        for &dot in scene.dots(shot) {
            let at = scene.nominal_mm(dot);
            if !on_slab(at, size, 0.0) {
                return Err(Error::DotOutsideSlab {
                    path: scene.capture.manifest_path(),
                    shot: scene.capture.manifest.shots[shot].name.clone(),
                    dot,
                    expected: format!("a place on the slab, within {:.2} × {:.2} mm", size[0], size[1]),
                    found: format!("({:.2}, {:.2}) mm", at[0], at[1]),
                });
            }
        }
    }
    Ok(())
}

/// All lattice shots, in parallel, but for those that a stopped run or a task has measured; their rows go to `rows`.
///
/// # Errors
/// Those of decoding and of `rows`; [`Error::Registration`], [`Error::DotSaturated`] by shot.
pub(super) fn extract(
    prepared: &Prepared<'_>,
    rows: &impl RowSink,
    progress: &Progress,
) -> Result<(Vec<ShotResult>, TakenOver)> {
    let scene = prepared.scene;
    let shots = scene.lattice();
    let stage = progress.stage("extract", photographs(scene, &shots));
    let resumed = Resumed::of(scene, &prepared.light, rows)?;
    let found = |&shot: &usize| {
        let found = resumed.take(scene, shot, rows)?;
        found.iter().for_each(|_| stage.advance(scene.photographs.brackets[shot].len()));
        Ok(found)
    };
    let found: Vec<Option<ShotResult>> = shots.par_iter().map(found).collect::<Result<_>>()?;
    let taken = TakenOver { shots: found.iter().flatten().count(), of: shots.len(), anew: resumed.anew };
    let lacking: Vec<usize> = (0..shots.len()).filter(|&k| found[k].is_none()).collect();
    rows.may_lack(&lacking, shots.len())?;
    let measure = |(&shot, found): (&usize, Option<ShotResult>)| -> Result<ShotResult> {
        if let Some(found) = found {
            return Ok(found);
        }
        stage.begin();
        let (result, hash) = measure(prepared, shot, |index, row| rows.put(index, row))?;
        resumed.add(scene, shot, hash, &result)?;
        stage.advance(scene.photographs.brackets[shot].len());
        Ok(result)
    };
    let mut results: Vec<ShotResult> =
        shots.par_iter().zip(found).with_max_len(1).map(measure).collect::<Result<_>>()?;
    let put = |index: usize, row: &Row| rows.replace(index, row);
    for k in unlikely_movements(&results) {
        results[k] = extract_shot(prepared, shots[k], Camera::Still, put)?;
    }
    Ok((results, taken))
}

/// Photographs of some shots.
pub(super) fn photographs(scene: &Scene<'_>, shots: &[usize]) -> usize {
    shots.iter().map(|&s| scene.photographs.brackets[s].len()).sum()
}

/// One lattice shot, and the BLAKE3 of its rows, which are put in the order of its dots.
///
/// # Errors
/// Those of [`extract`].
pub(super) fn measure(
    prepared: &Prepared<'_>,
    shot: usize,
    mut put: impl FnMut(usize, &Row) -> Result<()>,
) -> Result<(ShotResult, blake3::Hash)> {
    let mut hasher = blake3::Hasher::new();
    let hashed = |index: usize, row: &Row| {
        hasher.update(&row.bytes());
        put(index, row)
    };
    let result = extract_shot(prepared, shot, Camera::Measured, hashed)?;
    Ok((result, hasher.finalize()))
}

/// What is believed of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Camera {
    /// It has moved as the rim of the sample says.
    Measured,
    /// It stands still.
    Still,
}

/// A movement that leaves the reference dots this share of it from where the shots beside have them is one of the
/// camera: it moves dots and rim alike.
const UNLIKELY: f64 = 0.4;

/// Shots whose camera seems to have moved, and whose reference dots were where they are in the shots before and after
/// but for that: the rim was mistaken, as a sample that is pushed and returns is less likely.
fn unlikely_movements(results: &[ShotResult]) -> Vec<usize> {
    let camera = |r: &ShotResult| r.camera.filter(CameraMotion::is_sure).map_or(STILL, |m| m.camera_px);
    let unlikely = |k: &usize| {
        let own = camera(&results[*k]);
        if own == STILL {
            return false;
        }
        let beside: Vec<usize> =
            [k.checked_sub(1), Some(k + 1)].into_iter().flatten().filter(|j| *j < results.len()).collect();
        let known = |j: &usize| results[*j].drift.map(|d| (d.camera_px, camera(&results[*j])));
        let (Some(drift), Some(others)) = (results[*k].drift, beside.iter().map(known).collect::<Option<Vec<_>>>())
        else {
            return false;
        };
        let n = others.len().max(1) as f64;
        let mean = |of: &dyn Fn(&(Point, Point)) -> f64| others.iter().map(of).sum::<f64>() / n;
        // How far the dots are from where they should be, the camera moved and not.
        let off = |moved: Point| {
            let a = |a: usize| drift.camera_px[a] + moved[a] - mean(&|o| o.0[a]);
            a(0).hypot(a(1))
        };
        let alone = (0..2).map(|a| own[a] - mean(&|o| o.1[a])).fold(0.0, f64::hypot);
        alone > 0.5 * own[0].hypot(own[1]) && off(own) < UNLIKELY * off(STILL)
    };
    (0..results.len()).filter(unlikely).collect()
}

fn extract_shot(
    prepared: &Prepared<'_>,
    shot: usize,
    believed: Camera,
    mut put: impl FnMut(usize, &Row) -> Result<()>,
) -> Result<ShotResult> {
    let Prepared { scene, light, movements, search, .. } = prepared;
    let manifest = &scene.capture.manifest;
    let size_px = scene.capture.rig.camera.size_px;
    let dots = scene.dots(shot);
    // Rectangles: reference dots, then each window with room for its drift.
    let mut rects = scene.reference_rects(shot)?;
    let references = rects.len();
    for &dot in dots {
        let grid = WindowGrid::new(&manifest.window, scene.nominal_mm(dot), &scene.registration.view);
        let rect = window_rect(&grid, size_px).ok_or_else(|| scene.outside_picture(shot))?;
        rects.push(grown(rect, scene.drift_search_px() as usize, size_px));
    }
    rects.extend(movements.rim_rects());
    let rims_end = rects.len();
    let sought = Sought::of(scene, shot);
    rects.extend(sought.rects());
    let mut references_seen = scene.photographs.decode(shot, &rects)?;
    let elsewhere = references_seen.split_off(rims_end);
    let mut windows = references_seen.split_off(references);
    let rims = windows.split_off(dots.len());
    let camera = (believed == Camera::Measured).then(|| movements.camera_motion(scene, &rims)).flatten();
    let camera_px = camera.filter(CameraMotion::is_sure).map_or(STILL, |m| m.camera_px);
    let registration = &scene.registration.moved(camera_px);
    let Steadied { variance: flicker_variance, lamp, dots: dots_show } =
        light.flicker.steady(scene, shot, &mut references_seen, &mut windows);
    let drift = movements.drift(scene, shot, registration, &references_seen, &windows)?;
    let moved = drift.map_or([0.0; 2], |d| d.slab_mm);
    let seen = search.look(scene, shot, registration, drift, &windows);

    // What all samples of a row have in common: the lamp, the response curve's own error, exposure times.
    let common_variance =
        flicker_variance + scene.photographs.light_variance() + scene.registration.dot_area_variance();
    let mut weights = cell_weights(scene, windows.first().map_or(Sampling::WHOLE, Bracket::sampling));
    let centers: Vec<Point> =
        dots.iter().map(|&d| scene.nominal_mm(d)).map(|p| [p[0] + moved[0], p[1] + moved[1]]).collect();
    let spots = sought.look(scene, registration, moved, (&centers, &windows), &elsewhere);
    let mut result = ShotResult { lit: vec![], drift, camera, flicker_variance, lamp, dots_show, seen, spots };
    let grids: Vec<WindowGrid> =
        centers.iter().map(|&c| WindowGrid::new(&manifest.window, c, &registration.view)).collect();
    let picture = |(grid, bracket): (&WindowGrid, &Bracket)| {
        let needed = window_rect(grid, size_px).and_then(|r| overlap(r, bracket.rect()));
        Ok(scene.picture(bracket, needed.ok_or_else(|| scene.outside_picture(shot))?, camera_px))
    };
    // The halo of any dot is in all windows: without one, windows are merged one at a time.
    let mut without_stray = match light.stray.halos.is_empty() {
        true => vec![],
        false => {
            let mut all: Vec<Radiance> = grids.iter().zip(&windows).map(picture).collect::<Result<_>>()?;
            all.extend(references_seen.iter().map(|b| scene.picture(b, b.rect(), camera_px)));
            light.stray.remove(&mut all, size_px);
            all.truncate(dots.len());
            all
        }
    }
    .into_iter();
    for (k, &dot) in dots.iter().enumerate() {
        let (center, grid) = (centers[k], &grids[k]);
        let mut lit = lit_dot(scene, shot, dot, center, drift)?;
        lit.flux.relative_variance = lit.flux.relative_variance.map(|v| v + common_variance);
        let picture = without_stray.next().map_or_else(|| picture((grid, &windows[k])), Ok)?;
        let (row, findings) = extract_row(
            &picture,
            grid,
            &lit,
            scene.references.irradiance.sensitivity(),
            manifest.slab.size_mm,
            &mut weights,
        );
        scene.check_peak(shot, dot, center, &picture)?;
        put(manifest.grid.row_index(dot), &row)?;
        let albedo = albedo(&row, &manifest.window);
        let half_light_mm = search.half_light_mm(&row);
        let Flux { value: flux, relative_variance: scale_variance } = lit.flux;
        result.lit.push(LitPoint { dot, center_mm: center, flux, scale_variance, findings, albedo, half_light_mm });
    }
    Ok(result)
}

/// One set for all channels, or one for each where a mosaic measured them at places of their own.
fn cell_weights(scene: &Scene<'_>, sampling: Sampling) -> Vec<CellWeights> {
    let psf_px = scene.registration.point_spread.map_or(0.0, |p| p.psf_px);
    if sampling == Sampling::WHOLE {
        return vec![CellWeights::new(scene.cell_px, psf_px)];
    }
    let places = sampling.aperture_px.into_iter().zip(sampling.offset_px);
    places.map(|(aperture, offset)| CellWeights::sampled(scene.cell_px, psf_px, aperture, offset)).collect()
}

fn lit_dot(scene: &Scene<'_>, shot: usize, dot: [usize; 2], center: Point, drift: Option<Drift>) -> Result<LitDot> {
    let grid = &scene.capture.manifest.grid;
    let pixel_mm2 = scene.registration.slab_from_projector.area_scale(grid.dot_projector_px(dot));
    let area_mm2 = pixel_mm2 * grid.dot_area_px2();
    let at = scene.registration.view.camera_from_slab(center);
    let flux = scene.references.irradiance.flux(at, area_mm2).ok_or_else(|| {
        let name = &scene.capture.manifest.shots[shot].name;
        let found = "a saturated, black or missing reference there";
        let field = format!("shot \"{name}\", dot {dot:?}");
        Error::field(scene.capture.manifest_path(), field, "a measured white reference around the dot", found)
    })?;
    let drift_sd = drift.map_or(0.0, |d| d.sd_px / scene.px_per_mm);
    Ok(LitDot { center_mm: center, position_sd_mm: scene.registration.position_sd_mm.hypot(drift_sd), flux })
}

/// How much light leaves in a row's window per unit that arrives, of the channel with most.
pub(super) fn albedo(row: &Row, window: &Window) -> f64 {
    let sums = (0..3).map(|c| row.response.iter().skip(c).step_by(3).map(|&r| f64::from(r)).sum::<f64>());
    sums.fold(0.0, f64::max) * window.pitch_mm.powi(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn albedo_is_the_light_that_leaves_the_window_in_the_brightest_channel() {
        // Two samples of three channels, half a millimetre apart: 0.25 mm² each.
        let row = Row { response: vec![0.1, 0.5, 0.2, 0.3, 0.6, 1.2], variance: vec![9.0; 6], valid: vec![true; 6] };
        let window = Window { samples: [2, 1], pitch_mm: 0.5 };
        // 0.4, 1.1 and 1.4 (f32 values).
        assert!((albedo(&row, &window) - 0.35).abs() < 1e-6);
        let dark = Row { response: vec![-1.0; 3], variance: vec![0.0; 3], valid: vec![true; 3] };
        assert_eq!(albedo(&dark, &window), 0.0);
    }
}
