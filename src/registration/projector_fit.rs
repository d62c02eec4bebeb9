//! The projector's map and, when the stripes ask for it, its lens.

use super::fit::{Observation, fit_homography};
use crate::geometry::{Homography, Lens, Point, SlabFromProjector};

/// The projector registered to the slab's plane.
#[derive(Debug, Clone, Copy)]
pub struct ProjectorFit {
    /// Projector px to slab mm, lens included.
    pub slab_from_projector: SlabFromProjector,
    /// RMS of the stripes' edges against the model, projector px.
    pub rms_px: f64,
    /// The same for an ideal lens, projector px.
    pub ideal_rms_px: f64,
    /// Standard deviation per axis of a modelled point, projector px.
    pub sd_px: f64,
    /// Number of edges.
    pub edges: usize,
}

/// Edges that decide about the lens: more tell no more.
const DECIDING_EDGES: usize = 6000;
/// Neighbouring pixels along one edge share their errors: about so many are one.
const ALIKE: f64 = 8.0;
/// A distortion that moves no edge by this is not worth a model, projector px: the homography takes up most of it, and it may be the
/// camera's lens that is a little off.
const WORTH_PX: f64 = 0.25;
/// Rounds in which homography and distortion settle on each other.
const ROUNDS: usize = 4;

/// Fits homography and lens to edges (slab mm to one projector coordinate), dropping edges more than three deviations off once.
///
/// The lens has at most two radial terms about `lens.center_px`, as many as lower the Bayesian information criterion, and none that moves
/// no edge by a quarter of a pixel. `None` for fewer than nine edges or a degenerate layout.
pub fn fit_projector(mut edges: Vec<Observation>, lens: Lens) -> Option<ProjectorFit> {
    let lens = Lens { k1: 0.0, k2: 0.0, ..lens };
    let step = (edges.len() / DECIDING_EDGES).max(1);
    let mut few: Vec<Observation> = edges.iter().copied().step_by(step).collect();
    let (first, rms) = fit_homography(&few)?;
    // Mistaken edges are off by more than any lens.
    let start = fit_lens(&few, first, lens, 2).unwrap_or((first, lens, rms));
    drop_far(&mut few, &start);
    let mut best: Option<(f64, Lens)> = None;
    for terms in 0..=2 {
        let Some((h, found, rms)) = fit_lens(&few, first, lens, terms) else { continue };
        let n = few.len() as f64 / ALIKE;
        let information = n * rms.max(1e-4).powi(2).ln() + (8 + terms) as f64 * n.ln();
        let worth = terms == 0 || few.iter().any(|o| bend(&found, h.map(o.from)) > WORTH_PX);
        if worth && best.is_none_or(|(b, _)| information < b) {
            best = Some((information, found));
        }
    }
    let (_, chosen) = best?;
    drop_far(&mut edges, &start);
    let (h, rms_px) = fit_given(&edges, first, &chosen)?;
    let ideal_rms_px = if chosen.is_ideal() { rms_px } else { fit_given(&edges, first, &lens)?.1 };
    let independent = (edges.len() as f64 / ALIKE).max(11.0);
    let parameters = 8 + usize::from(chosen.k1 != 0.0) + usize::from(chosen.k2 != 0.0);
    Some(ProjectorFit {
        slab_from_projector: SlabFromProjector::new(h, chosen)?,
        rms_px,
        ideal_rms_px,
        sd_px: rms_px * (parameters as f64 / independent).sqrt(),
        edges: edges.len(),
    })
}

fn drop_far(edges: &mut Vec<Observation>, (h, lens, rms): &(Homography, Lens, f64)) {
    edges.retain(|o| (lens.distort(h.map(o.from))[o.axis] - o.to).abs() <= 3.0 * rms.max(1e-6));
}

/// How far the lens moves an ideal point, px.
fn bend(lens: &Lens, ideal: Point) -> f64 {
    let q = lens.distort(ideal);
    (q[0] - ideal[0]).hypot(q[1] - ideal[1])
}

/// The homography for a given lens, and the RMS residual: what the lens adds to each coordinate is taken off where the last map puts it.
fn fit_given(edges: &[Observation], start: Homography, lens: &Lens) -> Option<(Homography, f64)> {
    if lens.is_ideal() {
        return fit_homography(edges);
    }
    let (mut h, mut rms) = (start, f64::INFINITY);
    for _ in 0..ROUNDS {
        let straight = |o: &Observation| {
            let ideal = h.map(o.from);
            Observation { to: o.to - (lens.distort(ideal)[o.axis] - ideal[o.axis]), ..*o }
        };
        let straight: Vec<Observation> = edges.iter().map(straight).collect();
        (h, rms) = fit_homography(&straight)?;
    }
    Some((h, rms))
}

/// Homography and the first `terms` coefficients, by turns.
fn fit_lens(edges: &[Observation], start: Homography, lens: Lens, terms: usize) -> Option<(Homography, Lens, f64)> {
    let solve = |k: [f64; 2]| {
        let lens = Lens { k1: k[0], k2: k[1], ..lens };
        let (h, rms) = fit_given(edges, start, &lens)?;
        let residuals = edges.iter().map(|o| lens.distort(h.map(o.from))[o.axis] - o.to).collect();
        Some(((h, lens, rms), residuals))
    };
    let mut k = [0.0; 2];
    super::fit::gauss_newton(&solve, &mut k, terms).map(|(found, _)| found)
}

#[cfg(test)]
mod tests {
    use super::*;

    const H: Homography = Homography { matrix: [[8.0, 0.2, 30.0], [-0.1, 8.1, 25.0], [1e-3, -5e-4, 1.0]] };

    /// Edges every four px in both axes, off by a hundredth of a pixel in turn.
    fn edges(lens: &Lens) -> Vec<Observation> {
        (0..2000)
            .map(|k| {
                let from = [(k % 50) as f64 * 0.6, (k / 50) as f64 * 0.7];
                let axis = k % 2;
                let off = 0.01 * (f64::from((k * 7919 % 1000) as u32) / 500.0 - 1.0);
                Observation { from, axis, to: lens.distort(H.map(from))[axis] + off }
            })
            .collect()
    }

    #[test]
    fn a_projectors_distortion_is_found_where_there_is_one_and_only_there() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let fit = fit_projector(edges(&ideal), ideal).unwrap();
        assert!(fit.slab_from_projector.lens().is_ideal(), "{fit:?}");
        let real = Lens { k1: -0.02, ..ideal };
        let fit = fit_projector(edges(&real), ideal).unwrap();
        // Edges are off by 0.006 px RMS: a bend of up to 2 px is told to a few thousandths of itself.
        assert!((fit.slab_from_projector.lens().k1 + 0.02).abs() < 3e-4, "{fit:?}");
        assert!(fit.rms_px < 0.008 && fit.ideal_rms_px > 0.05, "{fit:?}");
        for p in [[2.0, 3.0], [15.0, 14.0], [28.0, 25.0]] {
            let (a, b) = (fit.slab_from_projector.projector_from_slab(p), real.distort(H.map(p)));
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.005, "{a:?} {b:?}");
        }
    }

    /// RMS of the coordinates, one by one.
    fn rms_of(fit: &ProjectorFit, edges: &[Observation]) -> f64 {
        let mut square = 0.0;
        for o in edges {
            square += (fit.slab_from_projector.projector_from_slab(o.from)[o.axis] - o.to).powi(2);
        }
        (square / edges.len() as f64).sqrt()
    }

    #[test]
    fn the_deviation_of_the_map_counts_its_parameters_and_alike_neighbours_as_one() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        for (k1, k2, parameters) in [(0.0, 0.0, 8.0), (-0.02, 0.0, 9.0), (-0.06, 0.12, 10.0f64)] {
            let real = Lens { k1, k2, ..ideal };
            let seen = edges(&real);
            let fit = fit_projector(seen.clone(), ideal).unwrap();
            let lens = fit.slab_from_projector.lens();
            assert_eq!((lens.k1 != 0.0, lens.k2 != 0.0), (k1 != 0.0, k2 != 0.0), "{lens:?}");
            assert_eq!(fit.edges, 2000);
            // The lens's share is taken off where the last map puts it, which has settled to 1e-6 of the RMS.
            assert!((fit.rms_px / rms_of(&fit, &seen) - 1.0).abs() < 1e-4, "{fit:?}");
            assert!((fit.sd_px - fit.rms_px * (parameters / 250.0).sqrt()).abs() < 1e-12, "{fit:?}");
        }
        // 43 edges would be five: at least eleven are taken for as many, more than a lens has parameters.
        let few: Vec<Observation> = edges(&ideal).into_iter().step_by(47).collect();
        let fit = fit_projector(few, ideal).unwrap();
        assert!((fit.sd_px - fit.rms_px * (8.0 / 11.0f64).sqrt()).abs() < 1e-12, "{fit:?}");
    }

    #[test]
    fn edges_far_off_are_dropped_and_a_bend_of_less_than_a_quarter_of_a_pixel_is_not_modelled() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let mut seen = edges(&ideal);
        // Every fiftieth is off by 3 px, once to each side: RMS 0.42 px, three of which are 1.3.
        seen.iter_mut().step_by(50).enumerate().for_each(|(k, o)| o.to += if k % 2 == 0 { 3.0 } else { -3.0 });
        let fit = fit_projector(seen, ideal).unwrap();
        assert_eq!(fit.edges, 1960);
        // The others are off by 0.01 / √3.
        assert!((fit.rms_px - 0.01 / 3f64.sqrt()).abs() < 2e-4, "{fit:?}");
        assert_eq!(fit.rms_px, fit.ideal_rms_px);
        // The farthest point is 0.62 focal lengths from the centre: k1 · r³ · f is 0.07 px per thousandth.
        let bent = |k1: f64| {
            let fit = fit_projector(edges(&Lens { k1, ..ideal }), ideal).unwrap();
            fit.slab_from_projector.lens().k1
        };
        assert_eq!(bent(-0.002), 0.0);
        assert!(bent(-0.008) != 0.0);
    }

    #[test]
    fn of_many_edges_some_decide_about_the_lens_and_all_about_the_map() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let real = Lens { k1: -0.02, ..ideal };
        // The same edges seven times over, one axis after the other as the stripes' pictures come.
        let mut many: Vec<Observation> = (0..7).flat_map(|_| edges(&real)).collect();
        many.sort_by_key(|o| o.axis);
        let (a, b) = (fit_projector(many, ideal).unwrap(), fit_projector(edges(&real), ideal).unwrap());
        assert_eq!(a.edges, 14_000);
        // Every second edge decides, seven times over all of them: k1 is told to 3e-4.
        assert!((a.slab_from_projector.lens().k1 - b.slab_from_projector.lens().k1).abs() < 3e-4);
        assert!((a.sd_px / a.rms_px - (9.0 / 1750.0f64).sqrt()).abs() < 1e-12);
        assert!(fit_projector(edges(&ideal)[..8].to_vec(), ideal).is_none_or(|f| f.rms_px.is_finite()));
        assert!(fit_projector(edges(&ideal)[..7].to_vec(), ideal).is_none());
    }

    #[test]
    fn a_lens_is_worth_its_numbers_when_it_moves_some_edge_by_a_quarter_of_a_pixel() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        // A bend is in proportion to k1.
        let most = |lens: &Lens| edges(&ideal).iter().map(|o| bend(lens, H.map(o.from))).fold(0.0, f64::max);
        let of_one = most(&Lens { k1: 1e-4, ..ideal }) / 1e-4;
        let found = |px: f64| {
            let real = Lens { k1: px / of_one, ..ideal };
            !fit_projector(edges(&real), ideal).unwrap().slab_from_projector.lens().is_ideal()
        };
        // Edges are off by a hundredth of a pixel: k1 is found to a hundredth of the bend.
        assert_eq!([0.15, 0.22, 0.28, 0.4].map(found), [false, false, true, true]);
    }
}
