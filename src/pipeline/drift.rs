//! How far the pattern of a lattice shot has moved: from dots on the frame, or without any from the dots on the sample.

use super::lattice::{DRIFT_SEARCH_PX, Prepared, STILL, overlap, square};
use crate::capture::Rect;
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance};
use crate::registration::{
    CameraMotion, DotShape, Drift, Located, Parallax, Registration, RimPlace, RimSegment, SampleDots, camera_motion,
    locate_rim, measure_drift, rim_segments,
};
use crate::{Error, Result};
use rayon::prelude::*;

/// Shots that are decoded beforehand to learn how deep the dots on the sample are seen.
const PILOT_SHOTS: usize = 8;
/// Of the half distance between neighbouring dots: nearer to it, a dot cannot be told from its neighbour.
const TOLD_APART: f64 = 0.9;

/// What movements of a shot are measured from.
pub(super) struct Movements {
    pub(super) source: DriftSource,
    /// The sample's rim in pieces, and where each was found before the lattice shots.
    rims: Vec<RimSegment>,
    before: Vec<Option<RimPlace>>,
}

impl Movements {
    /// The pixels that show the rim.
    pub(super) fn rim_rects(&self) -> impl Iterator<Item = Rect> {
        self.rims.iter().map(|r| r.rect)
    }
}

/// What drift is measured from.
pub(super) enum DriftSource {
    /// Dots on the opaque frame, expected at these places, mm.
    Frame(Vec<Point>),
    /// The dots of the lattice; no parallax for a view that no camera has.
    Sample(SampleDots, Option<Parallax>),
}

impl Prepared<'_> {
    /// Prepares the measurement of every shot's movements.
    pub(super) fn movements(&self) -> Result<Movements> {
        let size_mm = self.shots.capture.manifest.slab.size_mm;
        let mut rims = rim_segments(&self.registration.view, size_mm, self.shots.capture.rig.camera.size_px);
        let mut before: Vec<_> = rims.iter().map(|r| locate_rim(&part(&self.ambient, r.rect), r, None)).collect();
        // What is not seen without dots would only be looked for in vain.
        rims = rims.into_iter().zip(&before).filter_map(|(r, b)| b.map(|_| r)).collect();
        before.retain(Option::is_some);
        Ok(Movements { source: self.drift_source()?, rims, before })
    }

    /// How the camera's picture has moved; `None` where sample and frame are too dark to tell.
    pub(super) fn camera_motion(&self, movements: &Movements, seen: &[Bracket]) -> Option<CameraMotion> {
        let find = |((rim, before), bracket): ((&RimSegment, &Option<RimPlace>), &Bracket)| {
            let picture = bracket.merge(bracket.rect(), &self.shots.sensor);
            locate_rim(&picture, rim, before.map(|b| b.offset_px))
        };
        let now: Vec<_> = movements.rims.iter().zip(&movements.before).zip(seen).map(find).collect();
        camera_motion(&movements.rims, &movements.before, &now)
    }

    /// Decides it, and learns what the sample's dots need.
    fn drift_source(&self) -> Result<DriftSource> {
        let references = self.reference_mm();
        if !references.is_empty() {
            return Ok(DriftSource::Frame(references));
        }
        let grid = &self.shots.capture.manifest.grid;
        let middle = grid.dot_projector_px([grid.points[0] / 2, grid.points[1] / 2]);
        let a = self.registration.slab_from_projector.jacobian(middle);
        let b = self.registration.view.jacobian(self.registration.slab_from_projector.map(middle));
        let camera_from_projector =
            std::array::from_fn(|i| std::array::from_fn(|k| b[i][0] * a[0][k] + b[i][1] * a[1][k]));
        let shape = DotShape::new(camera_from_projector, grid.dot_projector_px as f64)
            .ok_or_else(|| Error::internal("dots have no shape in a registration that was accepted"))?;
        let dots = SampleDots { shape, dot_radius_px: self.dot_radius_px() };
        let Some(eye_mm) = self.registration.view.eye_mm() else { return Ok(DriftSource::Sample(dots, None)) };
        let mut pilots: Vec<usize> = self.lattice().into_iter().filter(|&s| self.dots(s).len() >= 2).collect();
        pilots.sort_by_key(|&s| std::cmp::Reverse(self.dots(s).len()));
        pilots.truncate(PILOT_SHOTS);
        let seen = |&shot: &usize| {
            let reach = dots.shape.radius_px() + self.search_px(shot) + 2.0;
            let size_px = self.shots.capture.rig.camera.size_px;
            let near =
                |&d: &[usize; 2]| square(self.registration.view.camera_from_slab(self.nominal_mm(d)), reach, size_px);
            let rects = self.dots(shot).iter().filter_map(near).collect::<Vec<_>>();
            if rects.len() < self.dots(shot).len() {
                return Err(self.outside_picture(shot));
            }
            let windows = self.shots.decode(shot, &rects)?;
            Ok(self.locate(shot, &self.registration, &windows, &dots).into_iter().flatten().collect())
        };
        let seen: Vec<Vec<Located>> = pilots.par_iter().map(seen).collect::<Result<_>>()?;
        Ok(DriftSource::Sample(dots, Some(Parallax::learn(&seen, eye_mm, self.px_per_mm))))
    }

    /// How far dots of a shot are searched, px: further than half the way to the next, one would be taken for the other.
    fn search_px(&self, shot: usize) -> f64 {
        self.half_spacing_px(shot).min(DRIFT_SEARCH_PX)
    }

    fn half_spacing_px(&self, shot: usize) -> f64 {
        self.shot_spacing(shot).map_or(f64::INFINITY, |s| 0.5 * s * self.cell_px)
    }

    fn locate(
        &self,
        shot: usize,
        registration: &Registration,
        windows: &[Bracket],
        dots: &SampleDots,
    ) -> Vec<Option<Located>> {
        let (search_px, size_px) = (self.search_px(shot), self.shots.capture.rig.camera.size_px);
        let reach = dots.shape.radius_px() + search_px + 2.0;
        let around = |(&dot, bracket): (&[usize; 2], &Bracket)| {
            let expected = self.nominal_mm(dot);
            let near = square(registration.view.camera_from_slab(expected), reach, size_px)?;
            dots.locate(
                expected,
                &self.picture(bracket, overlap(near, bracket.rect())?, STILL),
                registration,
                search_px,
            )
        };
        self.dots(shot).iter().zip(windows).map(around).collect()
    }

    /// The drift of a shot; `None` when its dots on the sample are too dark to tell.
    ///
    /// # Errors
    /// [`Error::Registration`] naming the shot when its dots are not where they are searched, or when they may be their neighbours.
    pub(super) fn drift(
        &self,
        shot: usize,
        registration: &Registration,
        movements: &Movements,
        references_seen: &[Bracket],
        windows: &[Bracket],
    ) -> Result<Option<Drift>> {
        match &movements.source {
            DriftSource::Frame(places) => {
                let seen: Vec<(Point, Radiance)> =
                    places.iter().zip(references_seen).map(|(&p, b)| (p, self.picture(b, b.rect(), STILL))).collect();
                let drift = measure_drift(&seen, registration, self.dot_radius_px());
                drift.map(Some).ok_or_else(|| self.lost(shot, windows, places.len()))
            }
            DriftSource::Sample(dots, parallax) => {
                let located = self.locate(shot, registration, windows, dots);
                self.refuse_other_dots(shot, &located)?;
                let located: Vec<Located> = located.into_iter().flatten().collect();
                let unknown = || Parallax::unknown([0.0, 0.0, -1.0]);
                Ok(parallax.unwrap_or_else(unknown).drift(&located, registration))
            }
        }
    }

    /// Refuses a shot without dots on the frame whose own dots may be each other's neighbours.
    fn refuse_other_dots(&self, shot: usize, located: &[Option<Located>]) -> Result<()> {
        let limit_px = TOLD_APART * self.half_spacing_px(shot);
        let found = located.iter().flatten().count();
        let far = |d: &&Located| d.moved_mm[0].hypot(d.moved_mm[1]) * self.px_per_mm > limit_px;
        let further = located.iter().flatten().filter(far).count();
        if 2 * further > found {
            return Err(self.shots.failed(shot)(format!(
                "its dots have moved by {limit_px:.1} px or more since registration, about half their distance: without reference dots they cannot be told from their neighbours"
            )));
        }
        // A lattice that has moved by a whole step leaves one side dark and fits everywhere else.
        let dots = self.dots(shot);
        for axis in 0..2 {
            let ends = [dots.iter().map(|d| d[axis]).min(), dots.iter().map(|d| d[axis]).max()];
            if ends[0] == ends[1] {
                continue;
            }
            for end in ends {
                let side = |k: &usize| Some(dots[*k][axis]) == end;
                let dark = (0..dots.len()).filter(side).all(|k| located[k].is_none());
                let others = (0..dots.len()).filter(|k| !side(k)).all(|k| located[k].is_some());
                if dark && others {
                    return Err(self.shots.failed(shot)(
                        "the outermost dots of one side are missing and all others are there: without reference dots a pattern that has moved by a whole step of its lattice cannot be told".into(),
                    ));
                }
            }
        }
        Ok(())
    }

    /// Why a shot's reference dots were not found: saturation of everything, or a pattern that is elsewhere.
    fn lost(&self, shot: usize, windows: &[Bracket], references: usize) -> Error {
        for (&dot, bracket) in self.dots(shot).iter().zip(windows) {
            if let Err(saturated) =
                self.check_peak(shot, dot, self.nominal_mm(dot), &self.picture(bracket, bracket.rect(), STILL))
            {
                return saturated;
            }
        }
        let reach = DRIFT_SEARCH_PX - 2.0;
        self.shots.failed(shot)(format!(
            "less than half of its {references} reference dots were found within {reach} px of where the pattern puts them"
        ))
    }
}

/// The pixels of `rect`, which must lie in the picture, had it moved by `moved_px`: cubic between pixels (Catmull and Rom), clamped at the border.
///
/// Between pixels noise is averaged; its variance is kept as it was, which is too much by a third at the most.
pub(super) fn moved_part(picture: &Radiance, rect: Rect, moved_px: Point) -> Radiance {
    let mut out = part(picture, rect);
    let whole = picture.rect;
    let weights = moved_px.map(|m| {
        let f = -m - (-m).floor();
        [
            f * (-0.5 + f * (1.0 - 0.5 * f)),
            1.0 + f * f * (-2.5 + 1.5 * f),
            f * (0.5 + f * (2.0 - 1.5 * f)),
            f * f * (-0.5 + 0.5 * f),
        ]
    });
    let first = moved_px.map(|m| (-m).floor() as isize - 1);
    let at = |base: usize, n: usize, from: usize, len: usize, axis: usize| {
        (base as isize + first[axis] + n as isize).clamp(from as isize, (from + len) as isize - 1) as usize
    };
    for k in 0..rect.area() {
        let (x, y) = (rect.x + k % rect.width, rect.y + k / rect.width);
        for c in 0..3 {
            let mut sum = 0.0;
            for n in 0..16 {
                let (u, v) = (at(x, n % 4, whole.x, whole.width, 0), at(y, n / 4, whole.y, whole.height, 1));
                sum += weights[0][n % 4] * weights[1][n / 4] * f64::from(picture.value[picture.at(u, v) + c]);
            }
            out.value[3 * k + c] = sum as f32;
        }
    }
    out
}

/// The pixels of `rect`, which must lie in the picture.
fn part(picture: &Radiance, rect: Rect) -> Radiance {
    let rows = (rect.y..rect.y + rect.height).map(|y| {
        let from = picture.at(rect.x, y);
        from..from + 3 * rect.width
    });
    let cut = |all: &[f32]| rows.clone().flat_map(|r| all[r].iter().copied()).collect();
    let used = rows.clone().flat_map(|r| picture.used[r].iter().copied()).collect();
    Radiance { rect, value: cut(&picture.value), variance: cut(&picture.variance), used }
}
