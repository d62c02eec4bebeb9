//! Slab, camera and projector related to each other: by the board or the frame's marks, and by the Gray code.

use super::BuildOptions;
use super::photographs::{Fine, Photographs};
use super::scene::on_slab;
use crate::capture::{Board, Pattern, Surface};
use crate::geometry::{CameraView, Lens, Point};
use crate::progress::{Progress, Stage};
use crate::radiance::Radiance;
use crate::registration::{
    BitPair, FrameFit, LensChoice, Observation, Pairs, PointSpread, Registration, SeenEdge, StripeArea, StripeFit,
    StripeSurface, ViewFit, find_board, fit_lens_of_views, fit_lens_with_stripes, marks_moved, measure_point_spread,
    register_frame, register_projector,
};
use crate::warning::bounds::{BOARD_ELSEWHERE_PX, FRAME_MOVED_PX, MAP_BENDS_PX, MOVED_SIGMA, STRIPES_LEFT_OUT};
use crate::{ConsistencyWarning, Error, RegistrationWarning, Result, Warning};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What [`register`] found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Registered {
    pub registration: Registration,
    /// Light of each Gray-code pattern and its inverse together, every [`SUM_STEP`]th pixel: white, but for the lamp.
    pub sums: Vec<Vec<f32>>,
    pub warnings: Vec<Warning>,
}

/// A few thousand pixels tell the lamp's change to a hundredth of a per cent.
pub(super) const SUM_STEP: usize = 13;

/// Camera from the board, projector from the Gray code.
///
/// # Errors
/// [`Error::Registration`] naming the shot; those of decoding.
pub(super) fn register(
    photographs: &Photographs<'_>,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Registered> {
    let codes = photographs.capture.shots(|p| matches!(p, Pattern::GrayCode { .. }));
    let stage = progress.stage("register", 1 + codes.len());
    // Finding the board's corners runs on one core: the other decodes stripes meanwhile.
    let (camera, pairs) = rayon::join(
        || {
            let found = camera_view(photographs);
            stage.advance(1);
            found
        },
        || bit_pairs(photographs, &codes, &stage),
    );
    let (seen, pairs) = (camera?, pairs?);
    let fine = &photographs.fine;
    let mut camera = seen.slab(fine);
    let mut warnings: Vec<Warning> = seen.warnings.iter().cloned().map(Warning::from).collect();
    warnings.extend(mirrored(photographs, &camera.view, options)?);
    let sum = |p: &BitPair| p.pattern.iter().zip(&p.inverse).step_by(SUM_STEP).map(|(a, b)| a + b).collect();
    let first = codes[0];
    // On the frame they are not of the white reference.
    let on_white = matches!(stripe_surface(photographs, &codes)?, StripeSurface::White);
    let sums = if on_white { pairs.iter().map(sum).collect() } else { vec![] };
    let fit = |view: &CameraView| projector_fit(photographs, &codes, view, &pairs)?.map_err(photographs.failed(first));
    let mut stripes = fit(&camera.view)?;
    let mut choice = seen.choice.clone();
    if let Some((fits, joint)) = lens_with_stripes(photographs, &seen, &stripes.edges) {
        let before = camera.view;
        (camera, choice) = (in_working_px(fine, &fits[0]), joint);
        if camera.view != before {
            stripes = fit(&camera.view)?;
        }
    }
    let choice = choice.scaled(fine.scale());
    warnings.extend(stripe_warnings(&stripes).map(Warning::from));
    let size_mm = photographs.capture.manifest.slab.size_mm;
    Registration::new(&camera, choice, seen.point_spread, &stripes.projector, size_mm)
        .map(|registration| Registered { registration, sums, warnings })
        .ok_or_else(|| photographs.failed(first)("the projector's map cannot be inverted".into()))
}

/// The lens by boards and stripes together, in the pixels of the boards.
fn lens_with_stripes(
    photographs: &Photographs<'_>,
    seen: &SeenPlanes,
    edges: &[Observation],
) -> Option<(Vec<ViewFit>, LensChoice)> {
    let camera = photographs.fine.camera();
    let edge = |o: &Observation| SeenEdge { at_px: seen.fits[0].view.camera_from_slab(o.from), axis: o.axis, to: o.to };
    let edges: Vec<SeenEdge> = edges.iter().map(edge).collect();
    let projector = projector_lens(photographs);
    fit_lens_with_stripes(&seen.planes, &seen.choice, &edges, camera.principal_px, camera.focal_px, projector)
}

fn projector_lens(photographs: &Photographs<'_>) -> Lens {
    let projector = &photographs.capture.rig.projector;
    // Coefficients of the lens count in widths of the image: its focal length is not known, and need not be.
    Lens::ideal(projector.lens_center_px(), projector.size_px[0] as f64)
}

/// A view of the boards' pixels in those that lattice shots are worked on in.
fn in_working_px(fine: &Fine<'_>, fit: &ViewFit) -> ViewFit {
    let scale = fine.scale();
    ViewFit { view: fine.view(&fit.view), rms_px: scale * fit.rms_px, sd_px: scale * fit.sd_px }
}

/// A slab whose axes are those of a mirror.
fn mirrored(photographs: &Photographs<'_>, view: &CameraView, options: &BuildOptions) -> Result<Option<Warning>> {
    let size_mm = photographs.capture.manifest.slab.size_mm;
    let [[a, b], [c, d]] = view.jacobian(size_mm.map(|s| 0.5 * s));
    if a * d - b * c > 0.0 {
        return Ok(None);
    }
    let shot = photographs.capture.shots(|p| matches!(p, Pattern::Board | Pattern::Frame)).first().copied();
    let shot = shot.map_or_else(String::new, |s| photographs.name(s).to_owned());
    options.refuse(ConsistencyWarning::MirroredSlab { shot }).map(Some)
}

/// The projector's map from the pairs of the Gray code; the inner error says in words why none was found.
fn projector_fit(
    photographs: &Photographs<'_>,
    codes: &[usize],
    view: &CameraView,
    pairs: &[BitPair],
) -> Result<std::result::Result<StripeFit, String>> {
    let rig = &photographs.capture.rig;
    let lens = projector_lens(photographs);
    let surface = stripe_surface(photographs, codes)?;
    let area = stripe_area(photographs);
    Ok(register_projector(pairs, rig.camera.size_px, view, surface, &area, lens))
}

/// The slab, the frame's marks, the reference dots and the grid: beyond them nothing need lie in the plane.
fn stripe_area(photographs: &Photographs<'_>) -> StripeArea {
    let manifest = &photographs.capture.manifest;
    let (mut low, mut high) = ([0.0; 2], manifest.slab.size_mm);
    for mark in photographs.capture.rig.frame.iter().flat_map(|f| &f.marks_mm) {
        for a in 0..2 {
            (low[a], high[a]) = (f64::min(low[a], mark[a]), f64::max(high[a], mark[a]));
        }
    }
    let mut dots = manifest.reference_dots.as_ref().map_or_else(Vec::new, |r| r.projector_px.clone());
    let [nx, ny] = manifest.grid.points;
    dots.extend([[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1]].map(|d| manifest.grid.dot_projector_px(d)));
    StripeArea { corners_mm: [low, high], dots_projector_px: dots }
}

/// What the stripes say of themselves.
fn stripe_warnings(fit: &StripeFit) -> impl Iterator<Item = RegistrationWarning> {
    let ignored =
        (fit.ignored_bits != [0; 2]).then_some(RegistrationWarning::GrayBitsIgnored { bits: fit.ignored_bits });
    let left_out =
        (fit.left_out > STRIPES_LEFT_OUT).then_some(RegistrationWarning::StripesLeftOut { share: fit.left_out });
    let bends = fit.projector.trend.filter(|t| t.off_px.abs() > MAP_BENDS_PX).map(|t| {
        RegistrationWarning::ProjectorMapBends { off_projector_px: t.off_px, sd_projector_px: t.sd_px, at_mm: t.at_mm }
    });
    [ignored, left_out, bends].into_iter().flatten()
}

/// Of two fits, one whose RMS is larger by this factor does not count.
const WORSE: f64 = 2.0;

/// The shots of the pattern and its inverse that, exchanged, make the Gray code fit with all dots on the slab. `None`
/// when it fits as it is, when no pair does, or when more than one does.
///
/// # Errors
/// Those of [`register`] but for the Gray code.
pub(super) fn exchanged_pair(photographs: &Photographs<'_>) -> Result<Option<[usize; 2]>> {
    let manifest = &photographs.capture.manifest;
    let codes = photographs.capture.shots(|p| matches!(p, Pattern::GrayCode { .. }));
    let silent = Progress::silent();
    let camera = camera_view(photographs)?.slab(&photographs.fine);
    let mut pairs = bit_pairs(photographs, &codes, &silent.stage("register", codes.len()))?;
    let [nx, ny] = manifest.grid.points;
    let rms = |pairs: &[BitPair]| -> Result<Option<f64>> {
        let Ok(fit) = projector_fit(photographs, &codes, &camera.view, pairs)? else { return Ok(None) };
        let lies = |dot: [usize; 2]| {
            let at = fit.projector.slab_from_projector.map(manifest.grid.dot_projector_px(dot));
            on_slab(at, manifest.slab.size_mm, 0.0)
        };
        let corners = [[0, 0], [nx - 1, 0], [0, ny - 1], [nx - 1, ny - 1]];
        Ok(corners.into_iter().all(lies).then_some(fit.projector.rms_px))
    };
    if rms(&pairs)?.is_some() {
        return Ok(None);
    }
    let mut fits: Vec<(f64, usize)> = Vec::new();
    for k in 0..pairs.len() {
        let exchange = |pair: &mut BitPair| std::mem::swap(&mut pair.pattern, &mut pair.inverse);
        exchange(&mut pairs[k]);
        fits.extend(rms(&pairs)?.map(|rms| (rms, k)));
        exchange(&mut pairs[k]);
    }
    fits.sort_by(|a, b| a.0.total_cmp(&b.0));
    let best = match fits[..] {
        [one] => one.1,
        [one, other, ..] if other.0 > WORSE * one.0 => one.1,
        _ => return Ok(None),
    };
    let (axis, bit) = (pairs[best].axis, pairs[best].bit);
    let shot = |inverted: bool| {
        let is = |s: &&usize| match manifest.shots[**s].pattern {
            Pattern::GrayCode { axis: a, bit: b, inverse, .. } => (a as usize, b, inverse) == (axis, bit, inverted),
            _ => false,
        };
        codes.iter().find(is).copied()
    };
    Ok(shot(false).zip(shot(true)).map(|(pattern, inverse)| [pattern, inverse]))
}

/// What boards and frames say, in the pixels that they were looked at in.
struct SeenPlanes {
    planes: Vec<Pairs>,
    fits: Vec<ViewFit>,
    choice: LensChoice,
    /// In pixels of the working resolution.
    point_spread: Option<PointSpread>,
    warnings: Vec<RegistrationWarning>,
}

impl SeenPlanes {
    /// The slab's plane, in pixels of the working resolution.
    fn slab(&self, fine: &Fine<'_>) -> ViewFit {
        in_working_px(fine, &self.fits[0])
    }
}

/// The board gives a plane, the frame's marks the plane as the sample really lies; the lens is fitted to all of them
/// together, and to boards in other poses where there are any.
fn camera_view(photographs: &Photographs<'_>) -> Result<SeenPlanes> {
    let (rig, fine) = (&photographs.capture.rig, &photographs.fine);
    let camera = &fine.camera();
    let mut warnings = Vec::new();
    let (mut planes, mut has_board): (Vec<Pairs>, bool) = (Vec::new(), false);
    let mut sharp: Option<(Radiance, &Board)> = None;
    for calibrating in [false, true] {
        let kind = |p: &Pattern| if calibrating { *p == Pattern::CalibrationBoard } else { *p == Pattern::Board };
        for shot in photographs.capture.shots(kind) {
            let Some(board) = &rig.board else { continue };
            let picture = photographs.merge_fine(shot)?;
            planes.push(find_board(&picture, board, camera).map_err(photographs.failed(shot))?);
            sharp.get_or_insert((picture, board));
            has_board |= !calibrating;
        }
    }
    let lens_of = |planes: &[Pairs]| fit_lens_of_views(planes, camera.principal_px, camera.focal_px);
    let mut fits = lens_of(&planes);
    let prior = fits.as_ref().filter(|_| has_board).map(|(fits, _)| fits[0].view);
    let mut first: Option<FrameFit> = None;
    for shot in photographs.capture.shots(|p| *p == Pattern::Frame) {
        let Some(marks) = &rig.frame else { continue };
        let picture = photographs.merge_fine(shot)?;
        let found = register_frame(&picture, marks, prior.as_ref(), camera).map_err(photographs.failed(shot))?;
        let name = photographs.capture.manifest.shots[shot].name.clone();
        match &first {
            None => {
                planes.insert(0, found.pairs(marks));
                fits = lens_of(&planes);
                first = Some(found);
            }
            Some(before) => {
                let moved = marks_moved(before, &found);
                let beyond = |(m, sd): &(Point, f64)| m[0].hypot(m[1]) > (MOVED_SIGMA * sd).max(FRAME_MOVED_PX);
                let scale = fine.scale();
                let told = |(moved_px, sd_px): (Point, f64)| RegistrationWarning::FrameMoved {
                    shot: name,
                    moved_px: moved_px.map(|m| scale * m),
                    sd_px: scale * sd_px,
                };
                warnings.extend(moved.filter(beyond).map(told));
            }
        }
    }
    let (fits, choice) = fits.ok_or_else(|| {
        Error::field(
            &photographs.capture.rig_path,
            "board or frame.marks_mm",
            "points that span a plane",
            "too few or on a line",
        )
    })?;
    if first.is_some() && has_board {
        warnings.extend(board_elsewhere(photographs, &fits[1].view, &fits[0]));
    }
    // Boards come after the frame; the first of them, in the sample's plane if there is one, tells how sharp the
    // picture is.
    let seen = &fits[usize::from(first.is_some() && fits.len() > 1)].view;
    let point_spread = sharp.and_then(|(picture, board)| measure_point_spread(&picture, board, seen));
    let scale = fine.scale();
    let point_spread = point_spread.map(|p| PointSpread {
        psf_px: scale * p.psf_px,
        variance_sd_px2: scale * scale * p.variance_sd_px2,
        range_px: p.range_px.map(|r| scale * r),
    });
    Ok(SeenPlanes { planes, fits, choice, point_spread, warnings })
}

/// Whether board and frame disagree about where the slab's corners are seen.
fn board_elsewhere(photographs: &Photographs<'_>, board: &CameraView, frame: &ViewFit) -> Option<RegistrationWarning> {
    let [w, h] = photographs.capture.manifest.slab.size_mm;
    let off = |p: Point| {
        let (a, b) = (board.camera_from_slab(p), frame.view.camera_from_slab(p));
        (a[0] - b[0]).hypot(a[1] - b[1])
    };
    let largest_px = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(off).into_iter().fold(0.0, f64::max);
    (largest_px > (MOVED_SIGMA * frame.sd_px).max(BOARD_ELSEWHERE_PX))
        .then_some(RegistrationWarning::BoardElsewhere { largest_px: photographs.fine.scale() * largest_px })
}

/// What the Gray code was projected on: all of it on the same.
fn stripe_surface(photographs: &Photographs<'_>, codes: &[usize]) -> Result<StripeSurface> {
    let manifest = &photographs.capture.manifest;
    let of = |s: usize| match manifest.shots[s].pattern {
        Pattern::GrayCode { on, .. } => on,
        _ => Surface::default(),
    };
    if let Some(&other) = codes.iter().find(|&&s| of(s) != of(codes[0])) {
        let (field, first) = (format!("shots \"{}\": on", manifest.shots[other].name), &manifest.shots[codes[0]].name);
        let expected = format!("the surface of shot \"{first}\": one for the whole Gray code");
        return Err(Error::field(photographs.capture.manifest_path(), field, expected, "another"));
    }
    Ok(match of(codes[0]) {
        Surface::WhiteReference => StripeSurface::White,
        Surface::Frame => StripeSurface::Frame(manifest.slab.size_mm),
    })
}

fn bit_pairs(photographs: &Photographs<'_>, codes: &[usize], stage: &Stage<'_>) -> Result<Vec<BitPair>> {
    let mut pairs: BTreeMap<(usize, u32), [Option<usize>; 2]> = BTreeMap::new();
    for &s in codes {
        if let Pattern::GrayCode { axis, bit, inverse, .. } = photographs.capture.manifest.shots[s].pattern {
            let slot = &mut pairs.entry((axis as usize, bit)).or_default()[usize::from(inverse)];
            if slot.replace(s).is_some() {
                return Err(photographs.failed(s)("this bit of the Gray code was shot twice".into()));
            }
        }
    }
    let pairs: Vec<_> = pairs.into_iter().collect();
    pairs
        .into_par_iter()
        .map(|((axis, bit), shots)| {
            let [Some(pattern), Some(inverse)] = shots else {
                let shot = shots.into_iter().flatten().next().unwrap_or(codes[0]);
                return Err(photographs.failed(shot)("each bit of the Gray code needs its inverse".into()));
            };
            let shots = [pattern, inverse];
            let (pattern, inverse) = (photographs.merge_whole(pattern)?, photographs.merge_whole(inverse)?);
            shots.iter().for_each(|&s| photographs.done_with(s));
            let used = pattern.used.as_chunks::<3>().0.iter().zip(inverse.used.as_chunks::<3>().0);
            let valid = used.map(|(a, b)| !a.contains(&0) && !b.contains(&0)).collect();
            let pair = BitPair { axis, bit, pattern: pattern.luminance(), inverse: inverse.luminance(), valid };
            stage.advance(2);
            Ok(pair)
        })
        .collect()
}
