//! How far the pattern of a lattice shot has moved: from dots on the frame, or without any from the dots on the sample.

use super::BuildOptions;
use super::dots_seen::radius_of_half;
use super::looks::looks;
use super::scene::{STILL, Scene, overlap, square};
use crate::capture::{Pattern, Rect};
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance};
use crate::registration::{
    CameraMotion, DepthOfMedium, DotShape, Drift, Located, Parallax, Registration, RimFit, RimPlace, RimSegment,
    SampleDots, camera_motion, fit_rim, flip_of_board, locate_rim, measure_drift, median, rim_segments,
};
use crate::warning::bounds::OTHER_SIZE;
use crate::{ConsistencyWarning, Error, Result, Warning};
use rayon::prelude::*;

/// Shots that are decoded beforehand to learn how deep the dots on the sample are seen.
const PILOT_SHOTS: usize = 8;
/// A slab is of another size, or elsewhere, when its rim says so by so many standard deviations.
const RIM_SIGMA: f64 = 6.0;
/// Of the half distance between neighbouring dots: nearer to it, a dot cannot be told from its neighbour.
const TOLD_APART: f64 = 0.9;

/// What movements of a shot are measured from.
pub(super) struct Movements {
    pub(super) source: DriftSource,
    /// Where the sample is by its rim.
    rim: Option<RimFit>,
    /// The sample's rim in pieces, and where each was found before the lattice shots.
    rims: Vec<RimSegment>,
    before: Vec<Option<RimPlace>>,
}

/// What drift is measured from.
pub(super) enum DriftSource {
    /// Dots on the opaque frame, expected at these places, mm.
    Frame(Vec<Point>),
    /// The dots of the lattice; no parallax for a view that no camera has.
    Sample(SampleDots, Option<Parallax>),
}

impl Movements {
    /// The pixels that show the rim.
    pub(super) fn rim_rects(&self) -> impl Iterator<Item = Rect> {
        self.rims.iter().map(|r| r.rect)
    }

    /// Prepares the measurement of every shot's movements.
    pub(super) fn prepare(scene: &Scene<'_>) -> Result<Self> {
        let size_mm = scene.capture.manifest.slab.size_mm;
        let (view, size_px) = (&scene.registration.view, scene.capture.rig.camera.size_px);
        let mut rims = rim_segments(view, size_mm, size_px);
        let mut before: Vec<_> =
            rims.iter().map(|r| locate_rim(&scene.references.ambient.part(r.rect), r, None)).collect();
        let rim = fit_rim(view, size_mm, size_px, &scene.references.ambient, (&rims, &before));
        // What is not seen without dots would only be looked for in vain.
        rims = rims.into_iter().zip(&before).filter_map(|(r, b)| b.map(|_| r)).collect();
        before.retain(Option::is_some);
        Ok(Self { source: drift_source(scene)?, rim, rims, before })
    }

    /// What the sample's rim says of board, frame and slab.
    ///
    /// # Errors
    /// [`Error::Contradiction`].
    pub(super) fn slab(&self, scene: &Scene<'_>, options: &BuildOptions) -> Result<Vec<Warning>> {
        if let Some(flipped) = flipped_board(scene) {
            return Ok(vec![options.refuse(flipped)?]);
        }
        let Some(rim) = self.rim else { return Ok(vec![]) };
        let mut warnings: Vec<Warning> = Vec::new();
        if (rim.scale - 1.0).abs() > OTHER_SIZE.max(RIM_SIGMA * rim.scale_sd) {
            warnings.push(ConsistencyWarning::SlabSize { scale: rim.scale, sd: rim.scale_sd }.into());
        }
        let size_mm = scene.capture.manifest.slab.size_mm;
        let view = &scene.registration.view;
        let middle = size_mm.map(|s| 0.5 * s);
        let seen = view.camera_from_slab(middle);
        let at = view.slab_from_camera([seen[0] + rim.offset_px[0], seen[1] + rim.offset_px[1]]).unwrap_or(middle);
        let offset_mm = [0, 1].map(|a| at[a] - middle[a]);
        let sd_mm = rim.offset_sd_px / scene.px_per_mm;
        if (0..2).any(|a| offset_mm[a].abs() > (OTHER_SIZE * size_mm[a]).max(RIM_SIGMA * sd_mm)) {
            let shots = scene.capture.shots(|p| matches!(p, Pattern::Frame | Pattern::Board));
            let shot = shots.first().map_or_else(String::new, |&s| scene.photographs.name(s).to_owned());
            warnings.push(ConsistencyWarning::SlabElsewhere { shot, offset_mm, sd_mm }.into());
        }
        Ok(warnings)
    }

    /// How the camera's picture has moved; `None` where sample and frame are too dark to tell.
    pub(super) fn camera_motion(&self, scene: &Scene<'_>, seen: &[Bracket]) -> Option<CameraMotion> {
        let find = |((rim, before), bracket): ((&RimSegment, &Option<RimPlace>), &Bracket)| {
            let picture = bracket.merge(bracket.rect(), &scene.photographs.sensor);
            locate_rim(&picture, rim, before.map(|b| b.offset_px))
        };
        let now: Vec<_> = self.rims.iter().zip(&self.before).zip(seen).map(find).collect();
        camera_motion(&self.rims, &self.before, &now)
    }

    /// The drift of a shot; `None` when its dots on the sample are too dark to tell.
    ///
    /// # Errors
    /// [`Error::Registration`] naming the shot when its dots are not where they are searched, or when they may be their
    /// neighbours.
    pub(super) fn drift(
        &self,
        scene: &Scene<'_>,
        shot: usize,
        registration: &Registration,
        references_seen: &[Bracket],
        windows: &[Bracket],
    ) -> Result<Option<Drift>> {
        match &self.source {
            DriftSource::Frame(places) => {
                let seen: Vec<(Point, Radiance)> =
                    places.iter().zip(references_seen).map(|(&p, b)| (p, scene.picture(b, b.rect(), STILL))).collect();
                let drift = measure_drift(&seen, registration, scene.dot_radius_px());
                drift.map(Some).ok_or_else(|| lost(scene, shot, windows, places.len()))
            }
            DriftSource::Sample(dots, parallax) => {
                let located = locate(scene, shot, registration, windows, dots);
                refuse_other_dots(scene, shot, &located)?;
                let located: Vec<Located> = located.into_iter().flatten().collect();
                let unknown = || Parallax::unknown([0.0, 0.0, -1.0], scene.dot_side_px());
                Ok(parallax.unwrap_or_else(unknown).drift(&located, registration))
            }
        }
    }
}

/// Photographs of the board that are mirrored or turned, where no marks on the frame stand in for it.
fn flipped_board(scene: &Scene<'_>) -> Option<ConsistencyWarning> {
    let board = scene.capture.rig.board.as_ref()?;
    if !scene.capture.shots(|p| matches!(p, Pattern::Frame)).is_empty() {
        return None;
    }
    let shot = *scene.capture.shots(|p| matches!(p, Pattern::Board)).first()?;
    let slab = (scene.capture.manifest.slab.size_mm, &scene.references.ambient);
    let found = flip_of_board(&scene.registration.view, board, scene.capture.rig.camera.size_px, slab)?;
    Some(ConsistencyWarning::BoardFlipped {
        shot: scene.photographs.name(shot).to_owned(),
        looks: found.looks.to_owned(),
        off_px: found.off_px,
        as_it_is_px: found.as_it_is_px,
    })
}

/// Decides it, and learns what the sample's dots need.
fn drift_source(scene: &Scene<'_>) -> Result<DriftSource> {
    let references = scene.reference_mm();
    if !references.is_empty() {
        return Ok(DriftSource::Frame(references));
    }
    let shape = dot_shape(scene)?;
    let dots = SampleDots { shape, dot_radius_px: scene.dot_radius_px() };
    let Some(eye_mm) = scene.registration.view.eye_mm() else { return Ok(DriftSource::Sample(dots, None)) };
    let mut pilots = scene.lattice();
    pilots.sort_by_key(|&s| std::cmp::Reverse(scene.dots(s).len()));
    pilots.truncate(PILOT_SHOTS);
    let seen = |&shot: &usize| {
        let size_px = scene.capture.rig.camera.size_px;
        let reach = (dots.shape.radius_px() + search_px(scene, shot) + 2.0).max(window_radius_px(scene, shot));
        let near =
            |&d: &[usize; 2]| square(scene.registration.view.camera_from_slab(scene.nominal_mm(d)), reach, size_px);
        let rects = scene.dots(shot).iter().filter_map(near).collect::<Vec<_>>();
        if rects.len() < scene.dots(shot).len() {
            return Err(scene.outside_picture(shot));
        }
        let windows = scene.photographs.decode(shot, &rects)?;
        let located = locate(scene, shot, scene.registration, &windows, &dots);
        let half = |(l, bracket): (&Option<Located>, &Bracket)| half_light_mm(scene, shot, bracket, l.as_ref()?);
        let halves: Vec<f64> = located.iter().zip(&windows).filter_map(half).collect();
        Ok((located.into_iter().flatten().collect(), halves))
    };
    let (seen, halves): (Vec<Vec<Located>>, Vec<Vec<f64>>) =
        pilots.par_iter().map(seen).collect::<Result<Vec<_>>>()?.into_iter().unzip();
    let mut halves = halves.concat();
    let medium = (!halves.is_empty()).then(|| DepthOfMedium::of_half_light(median(&mut halves)));
    Ok(DriftSource::Sample(dots, Some(Parallax::learn(&seen, eye_mm, scene.px_per_mm, scene.dot_side_px(), medium))))
}

/// How far a dot's light is its own: half a window, or half the way to the next dot of its shot, camera px.
fn window_radius_px(scene: &Scene<'_>, shot: usize) -> f64 {
    let [nx, ny] = scene.capture.manifest.window.samples;
    (0.5 * nx.min(ny) as f64 * scene.cell_px).min(half_spacing_px(scene, shot))
}

/// The radius around a dot within which half of the light of its surroundings ([`window_radius_px`]) leaves, mm; `None`
/// without light.
fn half_light_mm(scene: &Scene<'_>, shot: usize, bracket: &Bracket, dot: &Located) -> Option<f64> {
    let at_mm = [0, 1].map(|a| dot.expected_mm[a] + dot.moved_mm[a]);
    let at = scene.registration.view.camera_from_slab(at_mm);
    let picture = scene.picture(bracket, bracket.rect(), STILL);
    let reach = window_radius_px(scene, shot);
    let rect = picture.rect;
    let distance =
        |k: usize| ((rect.x + k % rect.width) as f64 - at[0]).hypot((rect.y + k / rect.width) as f64 - at[1]);
    let light = picture.luminance();
    let mut near: Vec<(f64, f64)> = light
        .iter()
        .enumerate()
        .map(|(k, v)| (distance(k), f64::from(*v).max(0.0)))
        .filter(|(r, _)| *r <= reach)
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    radius_of_half(near.iter().copied()).map(|r| r / scene.px_per_mm)
}

/// The footprint of the capture's dots.
///
/// # Errors
/// [`Error::Internal`] for a registration that maps dots to nothing.
pub(super) fn dot_shape(scene: &Scene<'_>) -> Result<DotShape> {
    let grid = &scene.capture.manifest.grid;
    let middle = grid.dot_projector_px([grid.points[0] / 2, grid.points[1] / 2]);
    let a = scene.registration.slab_from_projector.jacobian(middle);
    let b = scene.registration.view.jacobian(scene.registration.slab_from_projector.map(middle));
    let camera_from_projector = std::array::from_fn(|i| std::array::from_fn(|k| b[i][0] * a[0][k] + b[i][1] * a[1][k]));
    DotShape::new(camera_from_projector, grid.dot_side_px())
        .ok_or_else(|| Error::internal("dots have no shape in a registration that was accepted"))
}

/// How far dots of a shot are searched, px: further than half the way to the next, one would be taken for the other.
fn search_px(scene: &Scene<'_>, shot: usize) -> f64 {
    half_spacing_px(scene, shot).min(scene.drift_search_px())
}

/// Half the way from a dot of a shot to the next, px.
pub(super) fn half_spacing_px(scene: &Scene<'_>, shot: usize) -> f64 {
    scene.shot_spacing(shot).map_or(f64::INFINITY, |s| 0.5 * s * scene.cell_px)
}

fn locate(
    scene: &Scene<'_>,
    shot: usize,
    registration: &Registration,
    windows: &[Bracket],
    dots: &SampleDots,
) -> Vec<Option<Located>> {
    let search_px = search_px(scene, shot);
    let reach = dots.shape.radius_px() + search_px + 2.0;
    let find = |(&dot, bracket): (&[usize; 2], &Bracket)| {
        let expected = scene.nominal_mm(dot);
        dots.locate(expected, &around(scene, registration, bracket, expected, reach)?, registration, search_px)
    };
    scene.dots(shot).iter().zip(windows).map(find).collect()
}

/// What a bracket shows of the square of half side `reach_px` around a place on the slab; `None` when it shows nothing
/// of it.
pub(super) fn around(
    scene: &Scene<'_>,
    registration: &Registration,
    bracket: &Bracket,
    at_mm: Point,
    reach_px: f64,
) -> Option<Radiance> {
    let near = square(registration.view.camera_from_slab(at_mm), reach_px, scene.capture.rig.camera.size_px)?;
    Some(scene.picture(bracket, overlap(near, bracket.rect())?, STILL))
}

/// Refuses a shot without dots on the frame whose own dots may be each other's neighbours.
fn refuse_other_dots(scene: &Scene<'_>, shot: usize, located: &[Option<Located>]) -> Result<()> {
    let limit_px = TOLD_APART * half_spacing_px(scene, shot);
    let found = located.iter().flatten().count();
    let far = |d: &&Located| d.moved_mm[0].hypot(d.moved_mm[1]) * scene.px_per_mm > limit_px;
    let further = located.iter().flatten().filter(far).count();
    if 2 * further > found {
        return Err(scene.photographs.failed(shot)(format!(
            "its dots have moved by {limit_px:.1} px or more since registration, about half their distance: without reference dots they cannot be told from their neighbours"
        )));
    }
    // A lattice that has moved by a whole step leaves one side dark and fits everywhere else.
    let dots = scene.dots(shot);
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
                return Err(scene.photographs.failed(shot)(
                    "the outermost dots of one side are missing and all others are there: without reference dots a pattern that has moved by a whole step of its lattice cannot be told".into(),
                ));
            }
        }
    }
    Ok(())
}

/// Why a shot's reference dots were not found: saturation of everything, or a pattern that is elsewhere.
fn lost(scene: &Scene<'_>, shot: usize, windows: &[Bracket], references: usize) -> Error {
    for (&dot, bracket) in scene.dots(shot).iter().zip(windows) {
        if let Err(saturated) =
            scene.check_peak(shot, dot, scene.nominal_mm(dot), &scene.picture(bracket, bracket.rect(), STILL))
        {
            return saturated;
        }
    }
    let reach = scene.drift_followed_px();
    // Beside it the sweep looks as this shot should.
    let lattice = scene.lattice();
    let beside = lattice.iter().position(|&s| s == shot).and_then(|k| lattice.get(if k == 0 { 1 } else { k - 1 }));
    let looks = || {
        let (own, expected) =
            (scene.photographs.merge_whole(shot).ok()?, scene.photographs.merge_whole(*beside?).ok()?);
        looks(scene.photographs, (shot, None), &own, &expected, "").ok()?.filter(|l| !l.is_empty())
    };
    let words = looks().map_or_else(String::new, |looks| format!("; {looks}"));
    scene.photographs.failed(shot)(format!(
        "less than half of its {references} reference dots were found within {reach:.1} px of where the pattern puts them{words}"
    ))
}
