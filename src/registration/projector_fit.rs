//! The projector's map and, when the stripes ask for it, its lens.

use super::drift::{median, scaled_deviation};
use super::fit::{Observation, fit_homography};
use crate::geometry::{Homography, Lens, Point, SlabFromProjector};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::collections::BTreeMap;

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
    /// Relative standard deviation of the map's scale along each axis of the projector.
    pub scale_sd: [f64; 2],
    /// Number of edges.
    pub edges: usize,
    /// Share of the edges that are off the map by half a projector pixel and more, otherwise than most of their picture of
    /// the code: of something that does not lie in the plane. (Of those that are left out beside them most lie where
    /// prints end.)
    pub left_out: f64,
    /// Where the edges are off the map together, if anywhere: what no plane and no radial distortion explains.
    pub trend: Option<MapTrend>,
}

/// Edges of one part of the picture that are off the map together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapTrend {
    /// Their mean, projector px.
    pub off_px: f64,
    /// Its standard deviation, projector px.
    pub sd_px: f64,
    /// The middle of the part, slab mm.
    pub at_mm: Point,
}

/// Edges that decide about the lens: more tell no more.
const DECIDING_EDGES: usize = 6000;
/// Neighbouring pixels along one edge share their errors: about so many are one.
pub(super) const ALIKE: f64 = 8.0;
/// A distortion that moves no edge by this is not worth a model, projector px: the homography takes up most of it, and
/// it may be the camera's lens that is a little off.
pub(super) const WORTH_PX: f64 = 0.25;
/// Rounds in which homography and distortion settle on each other.
const ROUNDS: usize = 4;
/// Edges further off than so many robust deviations are left out: of a normal distribution's 1e-5.
const FAR_SIGMA: f64 = 4.5;
/// Blur and prints displace no edge as far as this, projector px.
const ELSEWHERE_PX: f64 = 0.5;
/// The least robust deviation that edges are given, projector px: of an exact picture all would be far off.
pub(super) const LEAST_SD_PX: f64 = 1e-3;

/// Fits homography and lens to edges (slab mm to one projector coordinate), dropping edges far off until none is.
///
/// The lens has at most two radial terms about `lens.center_px`, as many as lower the Bayesian information criterion,
/// and none that moves no edge by a quarter of a pixel. With the fit come the edges that it rests on. `None` for fewer
/// than nine edges or a degenerate layout.
pub fn fit_projector(edges: Vec<Observation>, lens: Lens) -> Option<(ProjectorFit, Vec<Observation>)> {
    let lens = Lens { k1: 0.0, k2: 0.0, ..lens };
    let step = (edges.len() / DECIDING_EDGES).max(1);
    let deciding: Vec<Observation> = edges.iter().copied().step_by(step).collect();
    // Mistaken edges are off by more than any lens; the plane that most agree on knows nothing of them, and a lens
    // brings back what it bends.
    let first = plane_of_edges(&deciding)?;
    let (mut few, mut start) = (Vec::new(), (first, lens));
    for _ in 0..ROUNDS {
        let kept = near(&deciding, &start);
        if kept.len() == few.len() {
            break;
        }
        few = kept;
        start = fit_lens(&few, first, lens, 2).map_or((first, lens), |(h, lens, _)| (h, lens));
    }
    let mut best: Option<(f64, Lens)> = None;
    for terms in 0..=2 {
        let Some((h, found, rms)) = fit_lens(&few, first, lens, terms) else { continue };
        let n = independent_edges(&few, &offs(&few, &h, &found));
        let information = n * rms.max(1e-4).powi(2).ln() + (8 + terms) as f64 * n.ln();
        let worth = terms == 0 || few.iter().any(|o| bend(&found, h.map(o.from)) > WORTH_PX);
        if worth && best.is_none_or(|(b, _)| information < b) {
            best = Some((information, found));
        }
    }
    let (_, chosen) = best?;
    let moved = moved_pictures(&edges, &start);
    let elsewhere = |o: &&Observation| (signed_off(o, &start.0, &start.1) - moved[&picture(o)]).abs() > ELSEWHERE_PX;
    let far = edges.iter().filter(elsewhere).count() as f64 / edges.len() as f64;
    let edges = near(&edges, &start);
    let (h, rms_px) = fit_given(&edges, first, &chosen)?;
    let ideal_rms_px = if chosen.is_ideal() { rms_px } else { fit_given(&edges, first, &lens)?.1 };
    let independent = independent_edges(&edges, &offs(&edges, &h, &chosen)).max(11.0);
    let parameters = 8 + usize::from(chosen.k1 != 0.0) + usize::from(chosen.k2 != 0.0);
    let fit = ProjectorFit {
        slab_from_projector: SlabFromProjector::new(h, chosen)?,
        rms_px,
        ideal_rms_px,
        sd_px: rms_px * (parameters as f64 / independent).sqrt(),
        scale_sd: [0, 1].map(|axis| scale_sd(&edges, axis, rms_px, independent)),
        edges: edges.len(),
        left_out: far,
        trend: trend(&edges, &(h, chosen)),
    };
    Some((fit, edges))
}

/// How far an edge is off the map, signed, projector px.
fn signed_off(o: &Observation, h: &Homography, lens: &Lens) -> f64 {
    lens.distort(h.map(o.from))[o.axis] - o.to
}

/// The same of several.
pub(super) fn offs(edges: &[Observation], h: &Homography, lens: &Lens) -> Vec<f64> {
    edges.iter().map(|o| signed_off(o, h, lens)).collect()
}

/// As how many independent edges these count, which are `off` the map: neighbours along one edge share their errors, and
/// so do all edges of a picture where the pictures of the code lie elsewhere (a projector that moves).
///
/// What the edges of a picture have in common is their intraclass correlation ρ by analysis of variance: m of them are
/// m / (1 + (m − 1) ρ).
pub(super) fn independent_edges(edges: &[Observation], off: &[f64]) -> f64 {
    let n = (edges.len() as f64 / ALIKE).max(1.0);
    let mut pictures: BTreeMap<(usize, u32), [f64; 3]> = BTreeMap::new();
    for (o, off) in edges.iter().zip(off) {
        let sum = pictures.entry(picture(o)).or_default();
        (sum[0], sum[1], sum[2]) = (sum[0] + 1.0, sum[1] + off, sum[2] + off * off);
    }
    let groups = pictures.len() as f64;
    if groups < 3.0 || n <= groups {
        return n;
    }
    let (all, sum) = pictures.values().fold((0.0, 0.0), |(n, s), p| (n + p[0], s + p[1]));
    let mean = sum / all;
    let between: f64 = pictures.values().map(|p| p[0] * (p[1] / p[0] - mean).powi(2)).sum();
    let within: f64 = pictures.values().map(|p| p[2] - p[1] * p[1] / p[0]).sum();
    // Of independent ones: sums of squares have ALIKE times as many terms as there are.
    let (between, within) = (between / ALIKE / (groups - 1.0), within / ALIKE / (n - groups));
    let m = n / groups;
    let shared = ((between - within) / (between + (m - 1.0) * within).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0);
    n / (1.0 + (m - 1.0) * shared)
}

/// Relative standard deviation of a line's slope through an axis's edges, `independent` of all, that are off it by
/// `rms_px`.
fn scale_sd(edges: &[Observation], axis: usize, rms_px: f64, independent: f64) -> f64 {
    let own = || edges.iter().filter(|o| o.axis == axis).map(|o| o.to);
    let n = own().count() as f64;
    let mean = own().sum::<f64>() / n;
    let square_px2 = own().map(|to| (to - mean).powi(2)).sum::<f64>() / n;
    rms_px / (independent * n / edges.len() as f64 * square_px2).sqrt()
}

/// How far an edge is off the map, projector px.
fn off(o: &Observation, (h, lens): &(Homography, Lens)) -> f64 {
    signed_off(o, h, lens).abs()
}

/// The edges that are not far off the map: by their scatter and by how far whole pictures of the code are off it.
///
/// A projector that moves puts all edges of a picture beside their places. Where the others fill most of the area, their
/// scatter alone would take such a picture for mistaken.
fn near(edges: &[Observation], map: &(Homography, Lens)) -> Vec<Observation> {
    let scatter = scaled_deviation(edges.iter().map(|o| off(o, map)), 0.0);
    let moved = scaled_deviation(moved_pictures(edges, map).into_values(), 0.0);
    let most = FAR_SIGMA * scatter.hypot(moved).max(LEAST_SD_PX);
    edges.iter().copied().filter(|o| off(o, map) <= most).collect()
}

/// How far most edges of each picture are off the map together, projector px.
fn moved_pictures(edges: &[Observation], map: &(Homography, Lens)) -> BTreeMap<(usize, u32), f64> {
    let mut pictures: BTreeMap<(usize, u32), Vec<f64>> = BTreeMap::new();
    for o in edges {
        pictures.entry(picture(o)).or_default().push(signed_off(o, &map.0, &map.1));
    }
    pictures.into_iter().map(|(picture, mut offs)| (picture, median(&mut offs))).collect()
}

/// Axis and bit of the code whose picture has the edge: edges of bit j lie at odd multiples of 2^j, less half a pixel.
fn picture(o: &Observation) -> (usize, u32) {
    (o.axis, ((o.to + 0.5).round().max(0.0) as u64).trailing_zeros())
}

/// The plane that the edges agree with, all of them or most: of both, that of the least sum of squares that end at
/// [`ELSEWHERE_PX`].
///
/// Most edges may belong to few pictures of the code. Where these have moved, a homography fits most of the edges
/// exactly, wrongly, and leaves the other pictures far off.
fn plane_of_edges(edges: &[Observation]) -> Option<Homography> {
    let cost = |h: &Homography| -> f64 {
        edges.iter().map(|o| ((h.map(o.from)[o.axis] - o.to) / ELSEWHERE_PX).powi(2).min(1.0)).sum()
    };
    let all = fit_homography(edges).map(|(h, _)| h);
    let found = [all, plane_of_most(edges)].into_iter().flatten();
    found.min_by(|a, b| cost(a).total_cmp(&cost(b)))
}

/// Parts along each side into which the edges are sorted for their trend.
const PARTS: usize = 6;
/// Fewer edges than for so many independent ones (see [`ALIKE`]) tell no trend.
const TREND_EDGES: f64 = 8.0;

/// The part of the plane, and the axis, whose edges are off the map together the most, beyond what their scatter
/// explains and by how much their picture of the code has moved.
fn trend(edges: &[Observation], map: &(Homography, Lens)) -> Option<MapTrend> {
    let moved = moved_pictures(edges, map);
    let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
    for o in edges {
        for a in 0..2 {
            (low[a], high[a]) = (low[a].min(o.from[a]), high[a].max(o.from[a]));
        }
    }
    let side = [0, 1].map(|a| (high[a] - low[a]).max(f64::MIN_POSITIVE) / PARTS as f64);
    let part = |p: Point| [0, 1].map(|a| (((p[a] - low[a]) / side[a]) as usize).min(PARTS - 1));
    let mut sums = vec![[0.0; 3]; 2 * PARTS * PARTS];
    for o in edges {
        let off = signed_off(o, &map.0, &map.1) - moved[&picture(o)];
        let [i, j] = part(o.from);
        let sum = &mut sums[(o.axis * PARTS + j) * PARTS + i];
        (sum[0], sum[1], sum[2]) = (sum[0] + 1.0, sum[1] + off, sum[2] + off * off);
    }
    let found = sums.iter().enumerate().filter_map(|(k, &[n, sum, square])| {
        let independent = n / ALIKE;
        (independent >= TREND_EDGES).then(|| {
            let mean = sum / n;
            let sd_px = ((square / n - mean * mean).max(0.0) / independent).sqrt();
            let at_mm = [k % PARTS, k / PARTS % PARTS].map(|v| v as f64 + 0.5);
            MapTrend { off_px: mean, sd_px, at_mm: [0, 1].map(|a| low[a] + side[a] * at_mm[a]) }
        })
    });
    found.filter(|t| t.off_px.abs() > TREND_SIGMA * t.sd_px).max_by(|a, b| a.off_px.abs().total_cmp(&b.off_px.abs()))
}

/// A trend of so many deviations: of 72 parts and axes none in 10 000 captures.
const TREND_SIGMA: f64 = 5.0;

/// Hypotheses and what each rests on: of 8 pixels of which a third are off the plane, one in 26 hypotheses has none of
/// them.
const HYPOTHESES: usize = 300;
const HYPOTHESIS_PIXELS: usize = 8;
/// Pixels that judge a hypothesis.
const JUDGES: usize = 1500;

/// The homography that most observations agree with: of hypotheses from a few of them each, the one of the least median
/// residual (Rousseeuw 1984), then least squares over what is within 2.5 robust deviations of it. `None` with too few
/// or a degenerate layout.
pub(super) fn plane_of_most(observations: &[Observation]) -> Option<Homography> {
    let by_axis = [0, 1].map(|axis| observations.iter().copied().filter(|o| o.axis == axis).collect::<Vec<_>>());
    let half = HYPOTHESIS_PIXELS / 2;
    if by_axis.iter().any(|of| of.len() < half) {
        return None;
    }
    let off = |h: &Homography, o: &Observation| (h.map(o.from)[o.axis] - o.to).abs();
    let judges: Vec<Observation> = observations.iter().copied().step_by((observations.len() / JUDGES).max(1)).collect();
    let deviation = |h: &Homography| scaled_deviation(judges.iter().map(|o| off(h, o)), 0.0);
    // The same in every run.
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let mut best = fit_homography(observations).map(|(h, _)| (deviation(&h), h));
    for _ in 0..HYPOTHESES {
        let some: Vec<Observation> =
            (0..HYPOTHESIS_PIXELS).map(|k| by_axis[k % 2][rng.random_range(0..by_axis[k % 2].len())]).collect();
        let Some((h, _)) = fit_homography(&some) else { continue };
        let sd = deviation(&h);
        if best.is_none_or(|(b, _)| sd < b) {
            best = Some((sd, h));
        }
    }
    let (mut sd, mut h) = best?;
    for _ in 0..ROUNDS {
        let near: Vec<Observation> = observations.iter().copied().filter(|o| off(&h, o) <= 2.5 * sd).collect();
        h = fit_homography(&near)?.0;
        sd = deviation(&h);
    }
    Some(h)
}

/// How far the lens moves an ideal point, px.
pub(super) fn bend(lens: &Lens, ideal: Point) -> f64 {
    let q = lens.distort(ideal);
    (q[0] - ideal[0]).hypot(q[1] - ideal[1])
}

/// The homography for a given lens, and the RMS residual: what the lens adds to each coordinate is taken off where the
/// last map puts it.
pub(super) fn fit_given(edges: &[Observation], start: Homography, lens: &Lens) -> Option<(Homography, f64)> {
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
        let residuals = offs(edges, &h, &lens);
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
        let fit = fit_projector(edges(&ideal), ideal).unwrap().0;
        assert!(fit.slab_from_projector.lens().is_ideal(), "{fit:?}");
        let real = Lens { k1: -0.02, ..ideal };
        let fit = fit_projector(edges(&real), ideal).unwrap().0;
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
            let fit = fit_projector(seen.clone(), ideal).unwrap().0;
            let lens = fit.slab_from_projector.lens();
            assert_eq!((lens.k1 != 0.0, lens.k2 != 0.0), (k1 != 0.0, k2 != 0.0), "{lens:?}");
            assert_eq!(fit.edges, 2000);
            // The lens's share is taken off where the last map puts it, which has settled to 1e-6 of the RMS.
            assert!((fit.rms_px / rms_of(&fit, &seen) - 1.0).abs() < 1e-4, "{fit:?}");
            assert!((fit.sd_px - fit.rms_px * (parameters / 250.0).sqrt()).abs() < 1e-12, "{fit:?}");
        }
        // 43 edges would be five: at least eleven are taken for as many, more than a lens has parameters.
        let few: Vec<Observation> = edges(&ideal).into_iter().step_by(47).collect();
        let fit = fit_projector(few, ideal).unwrap().0;
        assert!((fit.sd_px - fit.rms_px * (8.0 / 11.0f64).sqrt()).abs() < 1e-12, "{fit:?}");
    }

    #[test]
    fn edges_far_off_are_dropped_and_a_bend_of_less_than_a_quarter_of_a_pixel_is_not_modelled() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let mut seen = edges(&ideal);
        // Every fiftieth is off by 3 px, once to each side; the others by no more than a hundredth.
        seen.iter_mut().step_by(50).enumerate().for_each(|(k, o)| o.to += if k % 2 == 0 { 3.0 } else { -3.0 });
        let fit = fit_projector(seen, ideal).unwrap().0;
        assert_eq!(fit.edges, 1960);
        // The others are off by 0.01 / √3.
        assert!((fit.rms_px - 0.01 / 3f64.sqrt()).abs() < 2e-4, "{fit:?}");
        assert_eq!(fit.rms_px, fit.ideal_rms_px);
        // The farthest point is 0.62 focal lengths from the centre: k1 · r³ · f is 0.07 px per thousandth.
        let bent = |k1: f64| {
            let fit = fit_projector(edges(&Lens { k1, ..ideal }), ideal).unwrap().0;
            fit.slab_from_projector.lens().k1
        };
        assert_eq!(bent(-0.002), 0.0);
        assert!(bent(-0.008) != 0.0);
    }

    #[test]
    fn edges_that_are_off_together_are_a_trend_with_its_place() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        assert_eq!(fit_projector(edges(&ideal), ideal).unwrap().0.trend, None);
        // Rows' edges between 20 and 24.5 mm, and 9 and 13.5, are off by 0.02 px: less than what is left out (4.5
        // deviations of 0.0074 px), and of six times 28 edges, as good as 21 independent ones, sixteen deviations of
        // their mean.
        let mut seen: Vec<Observation> = (0..6).flat_map(|_| edges(&ideal)).collect();
        // One axis after the other, as the stripes' pictures come: every second edge decides about the lens.
        seen.sort_by_key(|o| o.axis);
        let there = |p: Point| (20.0..24.5).contains(&p[0]) && (9.0..13.5).contains(&p[1]);
        seen.iter_mut().filter(|o| o.axis == 1 && there(o.from)).for_each(|o| o.to += 0.02);
        let fit = fit_projector(seen, ideal).unwrap().0;
        let trend = fit.trend.unwrap();
        assert!(there(trend.at_mm) && trend.off_px < -0.01 && trend.off_px > -0.02, "{fit:?}");
        // The part has a column of edges that are not off, which scatter about the mean with the others.
        assert!(trend.sd_px > 0.0058 / 21f64.sqrt() && trend.sd_px < 0.01 / 21f64.sqrt(), "{fit:?}");
        assert_eq!(fit.left_out, 0.0);
    }

    #[test]
    fn the_plane_of_most_is_not_moved_by_what_two_fifths_say() {
        let other = Homography { matrix: [[8.5, 0.2, 60.0], [-0.1, 7.1, 45.0], [1e-3, -5e-4, 1.0]] };
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let mut seen = edges(&ideal);
        seen.iter_mut().filter(|o| o.from[0] > 17.5).for_each(|o| o.to = other.map(o.from)[o.axis]);
        let h = plane_of_most(&seen).unwrap();
        for p in [[1.0, 1.0], [15.0, 26.0], [8.0, 14.0]] {
            let (a, b) = (h.map(p), H.map(p));
            // Edges are off by 0.006 px RMS, and many.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.005, "{a:?} {b:?}");
        }
        assert!(plane_of_most(&seen[..6]).is_none());
    }

    #[test]
    fn of_many_edges_some_decide_about_the_lens_and_all_about_the_map() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        let real = Lens { k1: -0.02, ..ideal };
        // The same edges seven times over, one axis after the other as the stripes' pictures come.
        let mut many: Vec<Observation> = (0..7).flat_map(|_| edges(&real)).collect();
        many.sort_by_key(|o| o.axis);
        let (a, b) = (fit_projector(many, ideal).unwrap().0, fit_projector(edges(&real), ideal).unwrap().0);
        assert_eq!(a.edges, 14_000);
        // Every second edge decides, seven times over all of them: k1 is told to 3e-4.
        assert!((a.slab_from_projector.lens().k1 - b.slab_from_projector.lens().k1).abs() < 3e-4);
        assert!((a.sd_px / a.rms_px - (9.0 / 1750.0f64).sqrt()).abs() < 1e-12);
        assert!(fit_projector(edges(&ideal)[..8].to_vec(), ideal).is_none_or(|(f, _)| f.rms_px.is_finite()));
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
            !fit_projector(edges(&real), ideal).unwrap().0.slab_from_projector.lens().is_ideal()
        };
        // Edges are off by a hundredth of a pixel: k1 is found to a hundredth of the bend.
        assert_eq!([0.15, 0.22, 0.28, 0.4].map(found), [false, false, true, true]);
    }

    #[test]
    fn a_code_of_few_pictures_that_have_moved_is_fitted_by_all_of_them() {
        // Bits 2 to 4 of x and 2 to 5 of y over 42 and 65 projector px: half of the edges are those of two pictures.
        let h = Homography { matrix: [[-3.4, 0.5, 56.0], [0.4, 3.3, 13.0], [1e-3, 1e-3, 1.0]] };
        let back = h.inverse().unwrap();
        let moved = [[0.05, -0.23, 0.33, 0.0], [-0.03, 0.12, 0.04, -0.19]];
        let mut seen = Vec::new();
        for (axis, bits, size) in [(0usize, 2..5u32, 42.0), (1, 2..6, 65.0)] {
            for bit in bits {
                let edge = |m: usize| f64::from(1u32 << bit) * (2 * m + 1) as f64 - 0.5;
                for to in (0..16).map(edge).filter(|to| *to < size) {
                    seen.extend((0..80).map(|k| {
                        let across = 3.0 + f64::from(k) * [0.75, 0.48][axis];
                        let noise = 0.02 * (f64::from((k * 7919 + 31 * bit) % 1000) / 500.0 - 1.0);
                        let off = moved[axis][bit as usize - 2] + noise;
                        let q = if axis == 0 { [to + off, across] } else { [across, to + off] };
                        Observation { from: back.map(q), axis, to }
                    }));
                }
            }
        }
        let ideal = Lens::ideal([47.0, 39.0], 96.0);
        let (fit, kept) = fit_projector(seen.clone(), ideal).unwrap();
        assert_eq!(kept.len(), seen.len(), "no picture is left out");
        // Least squares over seven pictures that are 0.19 px off RMS: as much in the middle, twice that in a corner.
        for (q, most) in [([21.0, 32.0], 0.25), ([4.0, 5.0], 0.5), ([38.0, 60.0], 0.5), ([38.0, 5.0], 0.5)] {
            let found = fit.slab_from_projector.projector_from_slab(back.map(q));
            assert!((found[0] - q[0]).hypot(found[1] - q[1]) < most, "{found:?} {q:?}");
        }
        // What is in common to a picture counts as one: the deviation that is stated is of that size.
        assert!(fit.sd_px > 0.1 && fit.sd_px < 0.4, "{}", fit.sd_px);
        // So is that of the scale: the ends of a square of the grid are this far from their distance.
        for axis in 0..2 {
            let side = [34.0, 55.0][axis];
            let ends = [[4.0, 5.0], if axis == 0 { [38.0, 5.0] } else { [4.0, 60.0] }];
            let found = ends.map(|q| fit.slab_from_projector.projector_from_slab(back.map(q))[axis]);
            let error = (found[1] - found[0]) / side - 1.0;
            assert!(error.abs() < 3.0 * fit.scale_sd[axis] && fit.scale_sd[axis] < 0.02, "{error} {:?}", fit.scale_sd);
        }
        assert!(fit.trend.is_none(), "{:?}", fit.trend);
        // A wall behind the plane, a third of all edges, is left out still.
        let wall = Homography { matrix: [[-3.4, 0.5, 61.0], [0.4, 3.3, 8.0], [1e-3, 1e-3, 1.0]] };
        let behind = |o: &Observation| o.from[1] > 11.0;
        for o in seen.iter_mut().filter(|o| behind(o)) {
            o.to += wall.map(o.from)[o.axis] - h.map(o.from)[o.axis];
        }
        let (_, kept) = fit_projector(seen.clone(), ideal).unwrap();
        let share = kept.iter().filter(|o| behind(o)).count() as f64 / kept.len() as f64;
        assert!(share < 0.02, "{share}");
    }

    #[test]
    fn edges_of_pictures_that_lie_elsewhere_count_as_few() {
        let ideal = Lens::ideal([150.0, 130.0], 300.0);
        // Twelve pictures of two axes: bits 0 to 5.
        let at = |k: usize, axis: usize, bit: u32| Observation {
            from: [(k % 50) as f64 * 0.6, (k / 50) as f64 * 0.7],
            axis,
            to: f64::from(1u32 << bit) * (2 * (k % 9) + 1) as f64 - 0.5,
        };
        let all: Vec<Observation> = (0..4800).map(|k| at(k % 400, k / 400 % 2, (k / 800) as u32)).collect();
        assert_eq!(offs(&all, &H, &ideal).len(), 4800);
        let noise = |k: usize| f64::from((k * 7919 % 1000) as u32) / 500.0 - 1.0;
        let still: Vec<f64> = (0..4800).map(|k| 0.1 * noise(k)).collect();
        // As many as there are, an eighth of all; the correlation's own scatter may cost a few.
        let independent = independent_edges(&all, &still);
        assert!(independent > 400.0 && independent <= 600.0, "{independent}");
        let moved: Vec<f64> = (0..4800).map(|k| still[k] + 0.4 * noise(17 * (k / 400) + 3)).collect();
        // Twelve displacements, each told very well: about a dozen.
        let independent = independent_edges(&all, &moved);
        assert!((10.0..20.0).contains(&independent), "{independent}");
        assert_eq!(independent_edges(&all[..300], &still[..300]), 37.5, "of one picture nothing is told");
    }
}
