//! Least squares for planes and lenses.

use crate::cholesky::solve_small;
use crate::geometry::{CameraView, Homography, Lens, Point};
use faer::Mat;
use faer::linalg::solvers::SolveLstsq;

/// Coordinate `axis` of the image of `from` was seen at `to`.
#[derive(Debug, Clone, Copy)]
pub struct Observation {
    /// The point.
    pub from: Point,
    /// 0 for x, 1 for y.
    pub axis: usize,
    /// The coordinate of its image.
    pub to: f64,
}

/// Rounds of reweighting that turn the linear equations' algebraic error into the geometric one; they settle in two.
const REWEIGHTINGS: usize = 4;

/// The homography that fits observations of single coordinates in the least-squares sense, and its RMS residual.
///
/// Linear equations in normalized coordinates (Hartley & Zisserman 2004, §4.4), solved by their normal equations and
/// reweighted by the projective depth so that residuals are distances. `None` with fewer than eight observations or a
/// degenerate layout.
pub fn fit_homography(observations: &[Observation]) -> Option<(Homography, f64)> {
    if observations.len() < 8 {
        return None;
    }
    let from_norm = normalizer(observations.iter().map(|o| o.from))?;
    let to_norm = {
        let axis = |a: usize| {
            let v: Vec<f64> = observations.iter().filter(|o| o.axis == a).map(|o| o.to).collect();
            let (low, high) = v.iter().fold((f64::MAX, f64::MIN), |(l, h), &v| (l.min(v), h.max(v)));
            (high > low).then_some(((low + high) / 2.0, (high - low) / 2.0))
        };
        let ((cx, sx), (cy, sy)) = (axis(0)?, axis(1)?);
        let s = sx.max(sy);
        Homography::similarity(1.0 / s, [-cx / s, -cy / s])
    };
    let scale = to_norm.matrix[0][0];
    let rows: Vec<(Point, usize, f64)> = observations
        .iter()
        .map(|o| (from_norm.map(o.from), o.axis, scale * o.to + to_norm.matrix[o.axis][2]))
        .collect();
    let mut h = Homography::IDENTITY;
    for round in 0..REWEIGHTINGS {
        let depth = |p: Point| if round == 0 { 1.0 } else { h.matrix[2][0] * p[0] + h.matrix[2][1] * p[1] + 1.0 };
        // Sums of products: coordinates of about one leave them a condition of 1e6 or less.
        let (mut a, mut b) = ([[0.0; 8]; 8], [0.0; 8]);
        for &(p, axis, to) in &rows {
            let w = 1.0 / depth(p);
            let first = 3 * axis;
            let at = [first, first + 1, first + 2, 6, 7];
            let row = [w * p[0], w * p[1], w, -w * to * p[0], -w * to * p[1]];
            for i in 0..5 {
                (0..=i).for_each(|j| a[at[i]][at[j]] += row[i] * row[j]);
                b[at[i]] += row[i] * w * to;
            }
        }
        let (x, _) = solve_small(a, b)?;
        let v = |k: usize| x[k];
        h = Homography { matrix: [[v(0), v(1), v(2)], [v(3), v(4), v(5)], [v(6), v(7), 1.0]] };
        if h.matrix.iter().flatten().any(|v| !v.is_finite()) {
            return None;
        }
    }
    let found = to_norm.inverse()?.after(&h.after(&from_norm));
    let square = observations.iter().map(|o| (found.map(o.from)[o.axis] - o.to).powi(2)).sum::<f64>();
    Some((found, (square / observations.len() as f64).sqrt()))
}

/// A similarity that brings points to around the unit square.
fn normalizer(points: impl Iterator<Item = Point> + Clone) -> Option<Homography> {
    let (mut low, mut high) = ([f64::MAX; 2], [f64::MIN; 2]);
    for p in points {
        for a in 0..2 {
            low[a] = low[a].min(p[a]);
            high[a] = high[a].max(p[a]);
        }
    }
    let half = (high[0] - low[0]).max(high[1] - low[1]) / 2.0;
    (half > 0.0).then(|| {
        Homography::similarity(1.0 / half, [-(low[0] + high[0]) / (2.0 * half), -(low[1] + high[1]) / (2.0 * half)])
    })
}

/// A camera view fitted to points of known place.
#[derive(Debug, Clone, Copy)]
pub struct ViewFit {
    /// The view.
    pub view: CameraView,
    /// RMS distance per axis between seen and modelled points, px.
    pub rms_px: f64,
    /// Standard deviation per axis of a modelled point, px: the RMS times √(parameters / observations).
    pub sd_px: f64,
}

/// A distortion term is tried only with this many points for each: few corners fit any curve, and extrapolate it
/// wildly.
const PAIRS_PER_TERM: usize = 15;

/// Fits homography and lens distortion to pairs (slab mm, camera px); no distortion term that the residuals do not ask
/// for.
///
/// Terms are added while the Bayesian information criterion falls. The lens's centre and focal length are those given.
/// `None` with fewer than ten pairs or a degenerate layout.
pub fn fit_view(pairs: &[(Point, Point)], center_px: Point, focal_px: f64) -> Option<ViewFit> {
    if pairs.len() < 10 {
        return None;
    }
    let observations = |lens: &Lens| -> Vec<Observation> {
        let ideal = pairs.iter().map(|&(from, to)| (from, lens.undistort(to)));
        ideal.flat_map(|(from, to)| [0, 1].map(|axis| Observation { from, axis, to: to[axis] })).collect()
    };
    let n = 2.0 * pairs.len() as f64;
    let mut best: Option<(f64, ViewFit)> = None;
    let mut start = [0.0, 0.0];
    for terms in 0..=(pairs.len() / PAIRS_PER_TERM).min(2) {
        // Given the lens, the homography is linear least squares: only k1 and k2 are searched (variable projection).
        let solve = |k: [f64; 2]| {
            let lens = Lens { center_px, focal_px, k1: k[0], k2: k[1] };
            let (ideal_from_slab, _) = fit_homography(&observations(&lens))?;
            let view = CameraView { ideal_from_slab, lens };
            let residuals = pairs.iter().flat_map(|&(from, to)| {
                let seen = view.camera_from_slab(from);
                [seen[0] - to[0], seen[1] - to[1]]
            });
            Some((view, residuals.collect::<Vec<f64>>()))
        };
        let (view, residuals) = gauss_newton(&solve, &mut start, terms)?;
        let square: f64 = residuals.iter().map(|r| r * r).sum();
        let parameters = 8.0 + terms as f64;
        let rms_px = (square / n).sqrt();
        // Corners are never known better than a thousandth of a pixel: a perfect fit must not drive the logarithm to
        // −∞.
        let information = n * (rms_px.max(1e-3)).powi(2).ln() + parameters * n.ln();
        let fit = ViewFit { view, rms_px, sd_px: rms_px * (parameters / n).sqrt() };
        if best.as_ref().is_none_or(|(b, _)| information < *b) {
            best = Some((information, fit));
        }
    }
    best.map(|(_, fit)| fit)
}

/// Steps of Gauss–Newton on the first `terms` distortion coefficients, by finite differences; four are enough from
/// zero.
pub(super) fn gauss_newton<T, const N: usize>(
    solve: &dyn Fn([f64; N]) -> Option<(T, Vec<f64>)>,
    k: &mut [f64; N],
    terms: usize,
) -> Option<(T, Vec<f64>)> {
    let mut current = solve(*k)?;
    if terms == 0 {
        return Some(current);
    }
    for _ in 0..8 {
        let mut a = Mat::<f64>::zeros(current.1.len(), terms);
        for t in 0..terms {
            let h = 1e-5;
            let mut moved = *k;
            moved[t] += h;
            let other = solve(moved)?;
            for (r, (m, c)) in other.1.iter().zip(&current.1).enumerate() {
                a[(r, t)] = (m - c) / h;
            }
        }
        let b = Mat::from_fn(current.1.len(), 1, |r, _| -current.1[r]);
        let step = a.col_piv_qr().solve_lstsq(&b);
        let mut next = *k;
        for t in 0..terms {
            next[t] += step[(t, 0)];
        }
        let square = |r: &[f64]| r.iter().map(|v| v * v).sum::<f64>();
        match solve(next) {
            Some(better) if square(&better.1) <= square(&current.1) => {
                let gain = square(&current.1) - square(&better.1);
                current = better;
                *k = next;
                if gain <= 1e-9 * square(&current.1) {
                    break;
                }
            }
            _ => break,
        }
    }
    Some(current)
}

#[cfg(test)]
mod tests {
    use super::super::pictures::jitter;
    use super::*;

    fn view(k1: f64) -> CameraView {
        let ideal_from_slab = Homography { matrix: [[6.0, 0.3, 12.0], [-0.2, 6.1, 9.0], [1e-3, -5e-4, 1.0]] };
        CameraView { ideal_from_slab, lens: Lens { center_px: [100.0, 90.0], focal_px: 300.0, k1, k2: 0.0 } }
    }

    fn pairs(view: &CameraView) -> Vec<(Point, Point)> {
        (0..80).map(|k| [(k % 10) as f64 * 3.0, (k / 10) as f64 * 3.0]).map(|p| (p, view.camera_from_slab(p))).collect()
    }

    #[test]
    fn a_view_with_distortion_is_recovered() {
        let truth = view(-0.08);
        let fit = fit_view(&pairs(&truth), [100.0, 90.0], 300.0).unwrap();
        // Finite differences of 1e-5 in k leave the last digits; a thousandth of a pixel is what the criterion asks.
        assert!(fit.rms_px < 1e-3, "{fit:?}");
        assert!((fit.view.lens.k1 + 0.08).abs() < 1e-3, "{fit:?}");
    }

    #[test]
    fn a_lens_without_distortion_gets_none() {
        let fit = fit_view(&pairs(&view(0.0)), [100.0, 90.0], 300.0).unwrap();
        assert_eq!((fit.view.lens.k1, fit.view.lens.k2), (0.0, 0.0));
    }

    #[test]
    fn points_on_a_line_are_refused() {
        let line: Vec<_> = (0..20).map(|k| ([k as f64, 0.0], [k as f64, 0.0])).collect();
        assert!(fit_view(&line, [0.0, 0.0], 100.0).is_none_or(|f| f.rms_px.is_finite()));
    }

    fn noisy(view: &CameraView, count: usize) -> Vec<(Point, Point)> {
        let off = |k| 0.04 * jitter(k);
        let moved = |(k, (p, q)): (usize, (Point, Point))| (p, [q[0] + off(2 * k), q[1] + off(2 * k + 1)]);
        pairs(view).into_iter().enumerate().map(moved).step_by(80 / count).take(count).collect()
    }

    /// RMS per axis, pair by pair.
    fn rms_of(view: &CameraView, pairs: &[(Point, Point)]) -> f64 {
        let mut square = 0.0;
        for (p, q) in pairs {
            let seen = view.camera_from_slab(*p);
            square += (seen[0] - q[0]) * (seen[0] - q[0]) + (seen[1] - q[1]) * (seen[1] - q[1]);
        }
        (square / (2 * pairs.len()) as f64).sqrt()
    }

    #[test]
    fn the_deviation_of_a_modelled_point_counts_the_parameters_of_the_plane_and_of_the_lens() {
        for (k1, k2, parameters) in [(0.0, 0.0, 8.0), (-0.15, 0.0, 9.0), (-0.3, 0.8, 10.0f64)] {
            let truth = CameraView { lens: Lens { k1, k2, ..view(0.0).lens }, ..view(0.0) };
            let seen = noisy(&truth, 80);
            let fit = fit_view(&seen, truth.lens.center_px, truth.lens.focal_px).unwrap();
            let lens = fit.view.lens;
            assert_eq!((lens.k1 != 0.0, lens.k2 != 0.0), (k1 != 0.0, k2 != 0.0), "{lens:?}");
            assert!((fit.rms_px - rms_of(&fit.view, &seen)).abs() < 1e-12, "{fit:?}");
            assert!((fit.sd_px - fit.rms_px * (parameters / 160.0).sqrt()).abs() < 1e-12, "{fit:?}");
            // No worse than the truth, which the model holds but for the choice of terms: the jitter is 0.04 / √3.
            assert!(fit.rms_px <= rms_of(&truth, &seen) && fit.rms_px > 0.8 * 0.04 / 3f64.sqrt(), "{fit:?}");
        }
    }

    #[test]
    fn few_points_get_no_lens_and_fewer_no_view() {
        let truth = CameraView { lens: Lens { k1: -0.3, k2: 0.8, ..view(0.0).lens }, ..view(0.0) };
        let terms = |count: usize| {
            let all = pairs(&truth);
            // Spread over the plane, corners too.
            let some: Vec<_> = (0..count).map(|k| all[k * 79 / (count - 1)]).collect();
            fit_view(&some, truth.lens.center_px, truth.lens.focal_px)
                .map(|f| usize::from(f.view.lens.k1 != 0.0) + usize::from(f.view.lens.k2 != 0.0))
        };
        // Fifteen points for each term.
        let found = [9, 10, 14, 15, 29, 30].map(terms);
        assert_eq!(found, [None, Some(0), Some(0), Some(1), Some(1), Some(2)]);
    }

    #[test]
    fn a_homography_of_single_coordinates_is_that_of_least_distances() {
        let matrix = [[6.0, 0.3, 12.0], [-0.2, 6.1, 9.0], [1e-2, -5e-3, 1.0]];
        let truth = Homography { matrix };
        // Eleven times x, nine times y, off by a tenth of a pixel.
        let seen: Vec<Observation> = (0..20)
            .map(|k| {
                let from = [(k * 7 % 20) as f64, (k * 3 % 11) as f64 * 1.5];
                let axis = usize::from(k % 11 >= 6 || k == 19);
                Observation { from, axis, to: truth.map(from)[axis] + 0.1 * jitter(k) }
            })
            .collect();
        let square = |h: &Homography| seen.iter().map(|o| (h.map(o.from)[o.axis] - o.to).powi(2)).sum::<f64>();
        let (found, rms) = fit_homography(&seen).unwrap();
        assert!((rms - (square(&found) / 20.0).sqrt()).abs() < 1e-12);
        // A minimum of the squared distances: no entry moved to either side is better. Reweighting stops within a
        // hundredth of a deviation of it, which these steps (of about one) are larger than.
        for entry in 0..8 {
            for sign in [-1.0, 1.0] {
                let mut other = found;
                let [r, c] = [entry / 3, entry % 3];
                other.matrix[r][c] += sign * [0.01, 0.01, 0.1][c] * if r == 2 { 0.01 } else { 1.0 };
                assert!(square(&other) > square(&found), "{entry} {sign}");
            }
        }
        assert!(fit_homography(&seen[..7]).is_none());
        // Eight exact ones determine it: every point once, and one coordinate of each of some.
        let exact: Vec<Observation> =
            seen.iter().map(|o| Observation { to: truth.map(o.from)[o.axis], ..*o }).collect();
        let (found, rms) = fit_homography(&exact).unwrap();
        assert!(rms < 1e-9, "{rms}");
        for (a, b) in found.matrix.iter().flatten().zip(matrix.iter().flatten()) {
            assert!((a / found.matrix[2][2] - b).abs() < 1e-7, "{found:?}");
        }
    }
}
