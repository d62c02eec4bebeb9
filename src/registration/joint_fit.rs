//! The camera's lens from boards and stripes together.
//!
//! A few dozen corners of a small board hardly tell a lens from an ideal one. The edges of the Gray code are thousands:
//! between two ideal lenses they lie in a homography, and what bends them is the camera's distortion or the projector's.
//! Both are radial about centres of their own, and only one of them moves the board's corners too.

use super::fit::{Observation, ViewFit, fit_homography, gauss_newton};
use super::lens_fit::{FLOOR_PX, LensChoice, LensTrial, Pairs, lens, rms_of_views, sds_alone, solve_planes, view_fits};
use super::projector_fit::{ALIKE, LEAST_SD_PX, WORTH_PX, bend, fit_given, independent_edges, offs};
use crate::geometry::{CameraView, Homography, Lens, Point};

/// An edge of a stripe.
#[derive(Debug, Clone, Copy)]
pub struct SeenEdge {
    /// Where the camera sees it, px.
    pub at_px: Point,
    /// 0 for projector columns, 1 for rows.
    pub axis: usize,
    /// Its projector coordinate, px.
    pub to: f64,
}

/// Edges that are looked at, at the most.
const EDGES: usize = 1500;
/// Radial terms of camera and projector that are tried.
const MODELS: [(usize, usize); 8] = [(0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (2, 1), (1, 2)];
/// One with most of what lenses do.
const RICHEST: (usize, usize) = (1, 1);
/// Fewer independent edges than this tell no lens from another.
const LEAST_EDGES: f64 = 50.0;
/// Stripes may not make the corners' squares larger by more than so many of their standard deviations squared, above the
/// least that any lens leaves: what bends the stripes then is no lens.
const MOST_WORSE: f64 = 16.0;

/// Chooses the lens again, by boards and edges together; `views` and `choice` are those of
/// [`super::fit_lens_of_views`], the first view that of the slab's plane, `projector` has the projector's centre and
/// unit of length.
///
/// The sum of both information criteria decides between up to two radial terms of the camera and of the projector each.
/// `None` where the edges are too few, or want a lens that the boards refuse; the boards' own choice stands then.
///
/// Not detected: a surface that is not plane, where its shape looks like a distortion that the boards do not refuse.
pub fn fit_lens_with_stripes(
    views: &[Pairs],
    choice: &LensChoice,
    edges: &[SeenEdge],
    center_px: Point,
    focal_px: f64,
    projector: Lens,
) -> Option<(Vec<ViewFit>, LensChoice)> {
    // A centre of the lens's own is told by several boards: they say enough.
    if choice.center || edges.len() < (LEAST_EDGES * ALIKE) as usize {
        return None;
    }
    // Neighbours along an edge tell the same.
    let step = (edges.len() / EDGES).max(ALIKE as usize);
    let edges: Vec<SeenEdge> = edges.iter().copied().step_by(step).collect();
    let together =
        Together { views, alone: sds_alone(views, center_px, focal_px)?, edges, center_px, focal_px, projector };
    let corners = 2.0 * views.iter().map(Vec::len).sum::<usize>() as f64;
    // What no lens explains weighs the edges against the corners.
    let (first, _) = together.fit(RICHEST, 1.0)?;
    let independent = independent_edges(&first.observed, &first.off);
    if independent < LEAST_EDGES {
        return None;
    }
    let weight = (independent / together.edges.len() as f64).sqrt() / first.rms_px.max(LEAST_SD_PX);
    let tried = MODELS.into_iter().filter_map(|terms| Some((terms, together.fit(terms, weight)?.0)));
    let tried: Vec<((usize, usize), Fitted)> = tried.filter(|(terms, fitted)| terms.1 == 0 || fitted.bends()).collect();
    let least = tried.iter().map(|t| t.1.square).fold(f64::INFINITY, f64::min);
    let information = |((camera_terms, projector_terms), fitted): &((usize, usize), Fitted)| {
        corners * (fitted.square / corners).max(1e-6).ln()
            + independent * fitted.rms_px.max(FLOOR_PX).powi(2).ln()
            + (camera_terms + projector_terms) as f64 * (corners + independent).ln()
    };
    let chosen = tried.iter().min_by(|a, b| information(a).total_cmp(&information(b)))?;
    let ((camera_terms, _), fitted) = chosen;
    if fitted.square - least > MOST_WORSE * least / corners {
        return None;
    }
    let fits = view_fits(&fitted.views, views, *camera_terms);
    let trial = LensTrial {
        radial_terms: *camera_terms,
        center: false,
        rms_px: rms_of_views(&fitted.views, views),
        information: information(chosen),
    };
    Some((fits, LensChoice { radial_terms: *camera_terms, with_stripes: Some(trial), ..choice.clone() }))
}

/// Corners and edges.
struct Together<'a> {
    views: &'a [Pairs],
    /// What each view's corners are off by alone, px.
    alone: Vec<f64>,
    edges: Vec<SeenEdge>,
    center_px: Point,
    focal_px: f64,
    projector: Lens,
}

/// A model of both lenses, fitted.
struct Fitted {
    views: Vec<CameraView>,
    /// Sum of the corners' squares over what they are off by alone.
    square: f64,
    /// The edges: slab mm to projector px.
    observed: Vec<Observation>,
    map: Homography,
    projector: Lens,
    /// What they are off the model by, projector px.
    off: Vec<f64>,
    rms_px: f64,
}

impl Fitted {
    /// Whether the projector's lens moves any edge by what is worth a model.
    fn bends(&self) -> bool {
        self.observed.iter().any(|o| bend(&self.projector, self.map.map(o.from)) > WORTH_PX)
    }
}

impl Together<'_> {
    /// So many radial terms of camera and projector; an edge counts by its error times `weight`.
    fn fit(&self, (camera_terms, projector_terms): (usize, usize), weight: f64) -> Option<(Fitted, Vec<f64>)> {
        let solve = |k: [f64; 4]| {
            let of = |first: usize, terms: usize| [0, 1].map(|t| if t < terms { k[first + t] } else { 0.0 });
            let ([c1, c2], [k1, k2]) = (of(0, camera_terms), of(camera_terms, projector_terms));
            let camera = lens([c1, c2, 0.0, 0.0], self.center_px, self.focal_px);
            self.solve(camera, Lens { k1, k2, ..self.projector }, weight)
        };
        gauss_newton(&solve, &mut [0.0; 4], camera_terms + projector_terms)
    }

    /// The planes and the projector's map for given lenses, and the residuals of all.
    fn solve(&self, camera: Lens, projector: Lens, weight: f64) -> Option<(Fitted, Vec<f64>)> {
        let (views, mut residuals) = solve_planes(self.views, &self.alone, camera)?;
        let square = residuals.iter().map(|r| r * r).sum();
        let seen = |e: &SeenEdge| {
            let from = views[0].slab_from_camera(e.at_px)?;
            Some(Observation { from, axis: e.axis, to: e.to })
        };
        let observed: Vec<Observation> = self.edges.iter().map(seen).collect::<Option<_>>()?;
        // An ideal lens needs no place to start from.
        let start = if projector.is_ideal() { Homography::IDENTITY } else { fit_homography(&observed)?.0 };
        let (map, rms_px) = fit_given(&observed, start, &projector)?;
        let off = offs(&observed, &map, &projector);
        residuals.extend(off.iter().map(|r| weight * r));
        Some((Fitted { views, square, observed, map, projector, off, rms_px }, residuals))
    }
}

#[cfg(test)]
mod tests {
    use super::super::fit_lens_of_views;
    use super::*;

    const CENTER: Point = [78.0, 72.0];
    const FOCAL: f64 = 244.0;
    const VIEW: Homography = Homography { matrix: [[6.2, -0.1, 44.0], [0.3, 6.2, 32.0], [1.5e-3, 2.1e-3, 1.0]] };
    const MAP: Homography = Homography { matrix: [[9.4, 0.6, 58.0], [-0.8, 10.1, 51.0], [-1e-3, 8e-4, 1.0]] };

    /// Digits that nothing follows, −1 to 1.
    fn odd(k: usize) -> f64 {
        let mixed = (k as u64 + 7).wrapping_mul(6_364_136_223_846_793_005).rotate_left(29).wrapping_mul(0x9e37_79b9);
        (mixed >> 33) as f64 / (1u64 << 30) as f64 - 1.0
    }

    fn projector() -> Lens {
        Lens::ideal([119.5, 119.5], 240.0)
    }

    /// 7 × 8 corners that are found to 0.12 px.
    fn board(camera: &Lens) -> Vec<Pairs> {
        let corner = |k: usize| {
            let p = [0.7 + 1.95 * (k % 7) as f64, -1.2 + 1.95 * (k / 7) as f64];
            let q = camera.distort(VIEW.map(p));
            (p, [q[0] + 0.2 * odd(2 * k), q[1] + 0.2 * odd(2 * k + 1)])
        };
        vec![(0..56).map(corner).collect()]
    }

    /// The edges of four bits on both axes, one a projector line, found to 0.02 camera px.
    fn edges(camera: &Lens, projector: &Lens) -> Vec<SeenEdge> {
        let back = MAP.inverse().unwrap();
        let mut all = Vec::new();
        for axis in 0..2 {
            for bit in 2..6u32 {
                let side = f64::from(1u32 << bit);
                for line in 0..240 {
                    for m in (1..).step_by(2).map(|m| f64::from(m) * side - 0.5).take_while(|to| *to < 240.0) {
                        let at = if axis == 0 { [m, f64::from(line)] } else { [f64::from(line), m] };
                        // The ideal point that the projector's lens brings there.
                        let slab = back.map(projector.undistort(at));
                        let seen = camera.distort(VIEW.map(slab));
                        let at_px = [0, 1].map(|a| seen[a] + 0.035 * odd(62 * all.len() + 5 + a));
                        all.push(SeenEdge { at_px, axis, to: m });
                    }
                }
            }
        }
        all
    }

    fn chosen(camera: &Lens, projector_lens: &Lens) -> Option<(Vec<ViewFit>, LensChoice)> {
        let views = board(camera);
        let (_, choice) = fit_lens_of_views(&views, CENTER, FOCAL).unwrap();
        assert_eq!(choice.radial_terms, 0, "the corners alone tell no lens: {choice:?}");
        let edges = edges(camera, projector_lens);
        fit_lens_with_stripes(&views, &choice, &edges, CENTER, FOCAL, projector())
    }

    #[test]
    fn stripes_tell_whose_distortion_it_is_where_corners_do_not() {
        let (straight, bent) = (Lens::ideal(CENTER, FOCAL), Lens { k1: -0.05, ..Lens::ideal(CENTER, FOCAL) });
        let (fits, choice) = chosen(&bent, &projector()).unwrap();
        assert_eq!(choice.radial_terms, 1, "{choice:?}");
        assert!((fits[0].view.lens.k1 + 0.05).abs() < 2e-3, "{:?}", fits[0].view.lens);
        let (fits, choice) = chosen(&straight, &projector()).unwrap();
        assert!(choice.radial_terms == 0 && fits[0].view.lens.is_ideal(), "{choice:?}");
        let (fits, choice) = chosen(&straight, &Lens { k1: 0.03, ..projector() }).unwrap();
        assert!(choice.radial_terms == 0 && fits[0].view.lens.is_ideal(), "{choice:?}");
    }

    #[test]
    fn stripes_do_not_bend_what_the_boards_see_straight_and_few_of_them_decide_nothing() {
        let straight = Lens::ideal(CENTER, FOCAL);
        let views = board(&straight);
        let (_, choice) = fit_lens_of_views(&views, CENTER, FOCAL).unwrap();
        // Of another camera: a bend of 4 px at the picture's corner.
        let other = edges(&Lens { k1: -0.5, ..straight }, &projector());
        let with = |edges: &[SeenEdge]| fit_lens_with_stripes(&views, &choice, edges, CENTER, FOCAL, projector());
        assert!(with(&other).is_none_or(|(fits, _)| fits[0].view.lens.is_ideal()));
        assert!(with(&edges(&straight, &projector())[..399]).is_none());
    }
}
