//! The lattice shots: drift, windows, rows.

use super::drift::{Movements, moved_part};
use super::flicker::Flicker;
use super::shots::Shots;
use crate::capture::{Pattern, Rect, Sampling, Window};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{Bracket, Curve, HotPixel, Radiance, StrayLight, mend};
use crate::registration::{CameraMotion, Drift, Registration};
use crate::response::{CellWeights, Irradiance, LitDot, RowFindings, WindowGrid, extract_row, window_rect};
use crate::transport::{MatrixWriter, Row};
use crate::{Error, Result, Warning};
use rayon::prelude::*;

/// Pixels around a reference dot's expected place in which it is searched; drift of up to two less is measured, more is refused.
pub(super) const DRIFT_SEARCH_PX: f64 = 8.0;

/// A camera that has not moved, px.
pub(super) const STILL: Point = [0.0; 2];

/// Everything that lattice shots are measured against.
pub(super) struct Prepared<'a> {
    pub(super) shots: Shots<'a>,
    pub(super) registration: Registration,
    /// What was found while registering.
    pub(super) registration_warnings: Vec<Warning>,
    pub(super) ambient: Radiance,
    pub(super) hot: Vec<HotPixel>,
    pub(super) irradiance: Irradiance,
    /// The camera's halo.
    pub(super) stray: StrayLight,
    /// Relative variance of the white reference's light that flicker leaves, when it was measured.
    pub(super) white_variance: Option<f64>,
    pub(super) flicker: Option<Flicker>,
    pub(super) px_per_mm: f64,
    pub(super) cell_px: f64,
}

/// One lattice shot, measured.
pub(super) struct ShotResult {
    pub(super) lit: Vec<LitPoint>,
    pub(super) drift: Option<Drift>,
    pub(super) camera: Option<CameraMotion>,
    /// Relative variance that flicker leaves in each row.
    pub(super) flicker_variance: f64,
}

/// One dot of a shot, measured.
pub(super) struct LitPoint {
    pub(super) dot: [usize; 2],
    pub(super) center_mm: Point,
    pub(super) flux: [f64; 3],
    pub(super) findings: RowFindings,
    /// The largest of the channels.
    pub(super) albedo: f64,
}

impl Prepared<'_> {
    pub(super) fn dots(&self, shot: usize) -> &[[usize; 2]] {
        match &self.shots.capture.manifest.shots[shot].pattern {
            Pattern::Lattice { dots } => dots,
            _ => &[],
        }
    }

    pub(super) fn lattice(&self) -> Vec<usize> {
        self.shots.capture.shots(|p| matches!(p, Pattern::Lattice { .. }))
    }

    /// Where the pattern puts a dot, mm, without drift.
    pub(super) fn nominal_mm(&self, dot: [usize; 2]) -> Point {
        let grid = &self.shots.capture.manifest.grid;
        self.registration.slab_from_projector.map(grid.dot_projector_px(dot))
    }

    pub(super) fn reference_mm(&self) -> Vec<Point> {
        let dots = self.shots.capture.manifest.reference_dots.iter().flat_map(|r| &r.projector_px);
        dots.map(|&p| self.registration.slab_from_projector.map(p)).collect()
    }

    /// All lattice shots, in parallel, rows to the writer.
    pub(super) fn extract(&self, writer: &MatrixWriter, progress: &Progress) -> Result<Vec<ShotResult>> {
        let shots = self.lattice();
        let size = self.shots.capture.manifest.slab.size_mm;
        for &shot in &shots {
            for &dot in self.dots(shot) {
                let at = self.nominal_mm(dot);
                if !(0..2).all(|a| at[a] >= 0.0 && at[a] <= size[a]) {
                    return Err(Error::DotOutsideSlab {
                        path: self.shots.capture.manifest_path(),
                        shot: self.shots.capture.manifest.shots[shot].name.clone(),
                        dot,
                        expected: format!("a place on the slab, within {:.2} × {:.2} mm", size[0], size[1]),
                        found: format!("({:.2}, {:.2}) mm", at[0], at[1]),
                    });
                }
            }
        }
        let movements = self.movements()?;
        let photographs = shots.iter().map(|&s| self.shots.capture.brackets[s].len()).sum();
        let stage = progress.stage("extract", photographs);
        shots
            .into_par_iter()
            .with_max_len(1)
            .map(|shot| {
                let result = self.extract_shot(shot, &movements, writer)?;
                stage.advance(self.shots.capture.brackets[shot].len());
                Ok(result)
            })
            .collect()
    }

    fn extract_shot(&self, shot: usize, movements: &Movements, writer: &MatrixWriter) -> Result<ShotResult> {
        let manifest = &self.shots.capture.manifest;
        let size_px = self.shots.capture.rig.camera.size_px;
        let dots = self.dots(shot);
        // Rectangles: reference dots, then each window with room for its drift.
        let mut rects = self.reference_rects(shot)?;
        let references = rects.len();
        for &dot in dots {
            let grid = WindowGrid::new(&manifest.window, self.nominal_mm(dot), &self.registration.view);
            let rect = window_rect(&grid, size_px).ok_or_else(|| self.outside_picture(shot))?;
            rects.push(grown(rect, DRIFT_SEARCH_PX as usize, size_px));
        }
        rects.extend(movements.rim_rects());
        let mut references_seen = self.shots.decode(shot, &rects)?;
        let mut windows = references_seen.split_off(references);
        let camera = self.camera_motion(movements, &windows.split_off(dots.len()));
        let camera_px = camera.filter(CameraMotion::is_sure).map_or(STILL, |m| m.camera_px);
        let registration = &self.registration.moved(camera_px);
        let flicker_variance =
            self.flicker.as_ref().map_or(0.0, |f| f.steady(self, &mut references_seen, &mut windows));
        let drift = self.drift(shot, registration, movements, &references_seen, &windows)?;
        let moved = drift.map_or([0.0; 2], |d| d.slab_mm);

        let mut result = ShotResult { lit: vec![], drift, camera, flicker_variance };
        // What all samples of a row have in common: the lamp, and the response curve's own error.
        let common_variance = flicker_variance + self.shots.sensor.curve().map_or(0.0, Curve::relative_variance);
        let mut weights = self.cell_weights(windows.first().map_or(Sampling::WHOLE, Bracket::sampling));
        let centers: Vec<Point> =
            dots.iter().map(|&d| self.nominal_mm(d)).map(|p| [p[0] + moved[0], p[1] + moved[1]]).collect();
        let grids: Vec<WindowGrid> =
            centers.iter().map(|&c| WindowGrid::new(&manifest.window, c, &registration.view)).collect();
        let picture = |(grid, bracket): (&WindowGrid, &Bracket)| {
            let needed = window_rect(grid, size_px).and_then(|r| overlap(r, bracket.rect()));
            Ok(self.picture(bracket, needed.ok_or_else(|| self.outside_picture(shot))?, camera_px))
        };
        // The halo of any dot is in all windows: without one, windows are merged one at a time.
        let mut without_stray = match self.stray.halos.is_empty() {
            true => vec![],
            false => {
                let mut all: Vec<Radiance> = grids.iter().zip(&windows).map(picture).collect::<Result<_>>()?;
                all.extend(references_seen.iter().map(|b| self.picture(b, b.rect(), camera_px)));
                self.stray.remove(&mut all, size_px);
                all.truncate(dots.len());
                all
            }
        }
        .into_iter();
        for (k, &dot) in dots.iter().enumerate() {
            let (center, grid) = (centers[k], &grids[k]);
            let mut lit = self.lit_dot(shot, dot, center, drift)?;
            lit.flux.relative_variance = lit.flux.relative_variance.map(|v| v + common_variance);
            let picture = without_stray.next().map_or_else(|| picture((grid, &windows[k])), Ok)?;
            let (row, findings) =
                extract_row(&picture, grid, &lit, self.irradiance.sensitivity(), manifest.slab.size_mm, &mut weights);
            self.check_peak(shot, dot, center, &picture)?;
            writer.put(manifest.grid.row_index(dot), &row)?;
            let albedo = albedo(&row, &manifest.window);
            result.lit.push(LitPoint { dot, center_mm: center, flux: lit.flux.value, findings, albedo });
        }
        Ok(result)
    }

    /// One set for all channels, or one for each where a mosaic measured them at places of their own.
    fn cell_weights(&self, sampling: Sampling) -> Vec<CellWeights> {
        let psf_px = self.registration.point_spread.map_or(0.0, |p| p.psf_px);
        if sampling == Sampling::WHOLE {
            return vec![CellWeights::new(self.cell_px, psf_px)];
        }
        let places = sampling.aperture_px.into_iter().zip(sampling.offset_px);
        places.map(|(aperture, offset)| CellWeights::sampled(self.cell_px, psf_px, aperture, offset)).collect()
    }

    /// Radiance of a part of a bracket for a camera that has moved by `camera_px`, ambient light subtracted, hot photosites mended.
    pub(super) fn picture(&self, bracket: &Bracket, part: Rect, camera_px: Point) -> Radiance {
        let mut picture = bracket.merge(part, &self.shots.sensor);
        match camera_px {
            STILL => picture.subtract(&self.ambient),
            moved => picture.subtract(&moved_part(&self.ambient, part, moved)),
        }
        mend(&mut picture, &self.hot);
        picture
    }

    /// Where the reference dots are looked for.
    pub(super) fn reference_rects(&self, shot: usize) -> Result<Vec<Rect>> {
        let reach_px = self.dot_radius_px() + DRIFT_SEARCH_PX;
        let around = |p: Point| {
            let at = self.registration.view.camera_from_slab(p);
            square(at, reach_px, self.shots.capture.rig.camera.size_px).ok_or_else(|| self.outside_picture(shot))
        };
        self.reference_mm().into_iter().map(around).collect()
    }

    fn lit_dot(&self, shot: usize, dot: [usize; 2], center: Point, drift: Option<Drift>) -> Result<LitDot> {
        let grid = &self.shots.capture.manifest.grid;
        let pixel_mm2 = self.registration.slab_from_projector.area_scale(grid.dot_projector_px(dot));
        let area_mm2 = pixel_mm2 * (grid.dot_projector_px * grid.dot_projector_px) as f64;
        let at = self.registration.view.camera_from_slab(center);
        let flux = self.irradiance.flux(at, area_mm2).ok_or_else(|| {
            let name = &self.shots.capture.manifest.shots[shot].name;
            let found = "a saturated, black or missing reference there";
            let field = format!("shot \"{name}\", dot {dot:?}");
            Error::field(self.shots.capture.manifest_path(), field, "a measured white reference around the dot", found)
        })?;
        let drift_sd = drift.map_or(0.0, |d| d.sd_px / self.px_per_mm);
        Ok(LitDot { center_mm: center, position_sd_mm: self.registration.position_sd_mm.hypot(drift_sd), flux })
    }

    /// A dot of whose middle no exposure measured any pixel cannot be used at all.
    pub(super) fn check_peak(&self, shot: usize, dot: [usize; 2], center: Point, picture: &Radiance) -> Result<()> {
        let q = self.registration.view.camera_from_slab(center);
        let inside = |v: f64, from: usize, len: usize| (v.round().max(from as f64) as usize).min(from + len - 1);
        let r = picture.rect;
        let k = picture.at(inside(q[0], r.x, r.width), inside(q[1], r.y, r.height));
        let bracket = &self.shots.capture.brackets[shot];
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

    pub(super) fn dot_radius_px(&self) -> f64 {
        let grid = &self.shots.capture.manifest.grid;
        let pixel_mm = self.registration.slab_from_projector.area_scale(grid.dot_projector_px([0, 0])).sqrt();
        0.75 * grid.dot_projector_px as f64 * pixel_mm * self.px_per_mm
    }

    pub(super) fn outside_picture(&self, shot: usize) -> Error {
        self.shots.failed(shot)("a dot lies outside the photograph".into())
    }
}

/// How much light leaves in a row's window per unit that arrives, of the channel with most.
pub(super) fn albedo(row: &Row, window: &Window) -> f64 {
    let sums = (0..3).map(|c| row.response.iter().skip(c).step_by(3).map(|&r| f64::from(r)).sum::<f64>());
    sums.fold(0.0, f64::max) * window.pitch_mm.powi(2)
}

/// The square of half side `radius` around `at`, cut to the photograph; `None` when it lies outside.
pub(super) fn square(at: Point, radius: f64, size_px: [usize; 2]) -> Option<Rect> {
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

/// The pixels that both have; `None` when there are none.
pub(super) fn overlap(a: Rect, b: Rect) -> Option<Rect> {
    let (x, y) = (a.x.max(b.x), a.y.max(b.y));
    let (right, bottom) = ((a.x + a.width).min(b.x + b.width), (a.y + a.height).min(b.y + b.height));
    (right > x && bottom > y).then(|| Rect { x, y, width: right - x, height: bottom - y })
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

    #[test]
    fn a_square_of_pixels_holds_its_corners_and_ends_with_the_photograph() {
        let rect = |x, y, width, height| Some(Rect { x, y, width, height });
        // 10.3 ± 2.5 is 7.8 to 12.8, 20.6 ± 2.5 is 18.1 to 23.1.
        assert_eq!(square([10.3, 20.6], 2.5, [60, 40]), rect(7, 18, 7, 7));
        assert_eq!(square([1.0, 38.5], 2.5, [60, 40]), rect(0, 36, 5, 4));
        assert_eq!(square([58.5, 1.0], 2.5, [60, 40]), rect(56, 0, 4, 5));
        assert_eq!(square([-3.6, 20.0], 2.5, [60, 40]), None);
        assert_eq!(square([63.0, 20.0], 2.5, [60, 40]), None);
        assert_eq!(square([20.0, 43.0], 2.5, [60, 40]), None);
        assert_eq!(square([45.0, 20.0], 2.0, [60, 40]), rect(43, 18, 5, 5));
        assert_eq!(square([20.0, 45.0], 2.0, [60, 40]), None, "the photograph is wider than high");
    }

    #[test]
    fn rectangles_grow_to_the_photographs_rim_and_overlap_where_both_are() {
        let rect = |x, y, width, height| Rect { x, y, width, height };
        assert_eq!(grown(rect(10, 20, 5, 7), 3, [60, 40]), rect(7, 17, 11, 13));
        assert_eq!(grown(rect(2, 1, 5, 7), 3, [60, 40]), rect(0, 0, 10, 11));
        assert_eq!(grown(rect(50, 30, 9, 9), 3, [60, 40]), rect(47, 27, 13, 13));
        let a = rect(10, 20, 5, 7);
        assert_eq!(overlap(a, rect(12, 15, 30, 8)), Some(rect(12, 20, 3, 3)));
        assert_eq!(overlap(rect(12, 15, 30, 8), a), Some(rect(12, 20, 3, 3)));
        assert_eq!(overlap(a, rect(14, 26, 9, 9)), Some(rect(14, 26, 1, 1)));
        assert_eq!(overlap(a, rect(15, 20, 9, 9)), None);
        assert_eq!(overlap(a, rect(10, 27, 9, 9)), None);
        assert_eq!(overlap(a, rect(11, 22, 2, 3)), Some(rect(11, 22, 2, 3)));
    }
}
