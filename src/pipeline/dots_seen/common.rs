//! What all dots of a capture are off by alike: grid, reference dots and Gray code against each other.

use super::{DotSeen, STEP_SHARE, step_mm};
use crate::capture::Pattern;
use crate::cholesky::solve_small;
use crate::geometry::{Point, sight_slope};
use crate::pipeline::BuildOptions;
use crate::pipeline::lattice::ShotResult;
use crate::pipeline::scene::Scene;
use crate::registration::{DEPTH_OF_HALF_LIGHT, median, scaled_deviation};
use crate::warning::bounds::REFUSED_PROJECTOR_PX;
use crate::{ConsistencyWarning, Result, Warning};

/// The sharpest of the capture's dots lie this near to their places, in sides of a dot (docs/accuracy.md, "Geometry"):
/// nearer is not told.
const LEAST_DOT: f64 = 0.053;
/// An offset is told from so many standard deviations on.
const SIGMA: f64 = 6.0;
/// A sample that is seen obliquely shows its dots beside their places, as their light leaves it from below: from no
/// deeper than this many radii of the half of a row's light (ketchup of docs/simulation.md: 3).
const DEEPEST: f64 = 4.0;
/// About a ramp that is told dots scatter by this share of it at the most: about a step between two media they do by a
/// quarter.
const RAMP_SCATTER: f64 = 0.15;
/// With fewer dots no ramp is told.
const LEAST_DOTS: usize = 8;
/// Rounds in which dots that the others contradict are left out.
const ROUNDS: usize = 4;
/// A board whose photographs are mirrored or turned explains an offset of which it leaves so little.
const BOARD_LEAVES: f64 = 0.5;

/// A dot that was seen.
#[derive(Debug, Clone, Copy)]
struct OffDot {
    dot: [usize; 2],
    /// How far it is seen per depth over refractive index that its light comes from: towards the camera's foot.
    lean: Point,
    off_mm: Point,
}

/// What all dots of a capture are off by alike.
pub(super) struct Common {
    seen: Vec<OffDot>,
    /// Median radius of half of a row's light, mm: light comes from no deeper than [`DEEPEST`] times that.
    half_light_mm: f64,
    /// What the radii of half of a row's light differ by: from the tenth to the ninetieth of a hundred.
    half_light_spread_mm: f64,
    /// Medians: of how far dots are seen per depth, and of what dots are off by, mm.
    lean: Point,
    offset_mm: Point,
    /// The part of it that light from no depth explains, mm.
    unexplained_mm: Point,
    /// Standard deviation per axis, mm.
    sd_mm: f64,
    /// Share of all dots that were found.
    pub(super) found: f64,
}

impl Common {
    /// `None` for fewer than three dots.
    pub(super) fn of(scene: &Scene<'_>, results: &[ShotResult]) -> Option<Self> {
        let eye_mm = scene.registration.view.eye_mm();
        let mut seen: Vec<OffDot> = Vec::new();
        let mut depths: Vec<f64> = Vec::new();
        let mut all = 0;
        for (result, shot) in results.iter().zip(scene.lattice()) {
            depths.extend(result.lit.iter().map(|l| l.half_light_mm));
            for (at, &dot) in result.seen.iter().zip(scene.dots(shot)) {
                all += 1;
                if let DotSeen::At { off_mm } = at {
                    let p = scene.nominal_mm(dot);
                    let lean = eye_mm.map_or([0.0; 2], |eye| sight_slope(eye, p));
                    seen.push(OffDot { dot, lean, off_mm: *off_mm });
                }
            }
        }
        if seen.len() < 3 || depths.is_empty() {
            return None;
        }
        let found = seen.len() as f64 / all as f64;
        // Where some shots show another pattern, however many, the others tell where dots are.
        let far_mm = STEP_SHARE * step_mm(scene);
        let near: Vec<OffDot> = seen.iter().filter(|s| s.off_mm[0].hypot(s.off_mm[1]) < far_mm).copied().collect();
        let seen = if near.len() >= 3.max(seen.len() / 20) { near } else { seen };
        let middle = |of: &dyn Fn(&OffDot) -> f64| median(&mut seen.iter().map(of).collect::<Vec<_>>());
        let offset_mm = [0, 1].map(|a| middle(&|s| s.off_mm[a]));
        let lean = [0, 1].map(|a| middle(&|s| s.lean[a]));
        let square = lean[0].powi(2) + lean[1].powi(2);
        let depth = (offset_mm[0] * lean[0] + offset_mm[1] * lean[1]) / square.max(1e-12);
        let half_light_mm = median(&mut depths);
        let [low, high] = [0.1, 0.9].map(|share| depths[(share * (depths.len() - 1) as f64).round() as usize]);
        let half_light_spread_mm = high - low;
        let depth_mm = depth.clamp(0.0, DEEPEST * half_light_mm);
        let unexplained_mm = [0, 1].map(|a| offset_mm[a] - depth_mm * lean[a]);
        let spread = [0, 1].map(|a| scaled_deviation(seen.iter().map(|s| s.off_mm[a]), offset_mm[a]));
        let sd_mm = scene.registration.position_sd_mm.hypot(spread[0].max(spread[1]) / (seen.len() as f64).sqrt());
        Some(Self { seen, half_light_mm, half_light_spread_mm, lean, offset_mm, unexplained_mm, sd_mm, found })
    }

    /// What a dot is off by beyond what all are.
    pub(super) fn left(&self, off_mm: Point) -> Point {
        [0, 1].map(|a| off_mm[a] - self.offset_mm[a])
    }

    /// Dots that are the farther off the farther along the grid they are: its step is not that of the patterns, or it
    /// is turned against the Gray code.
    ///
    /// # Errors
    /// [`crate::Error::Contradiction`].
    pub(super) fn ramp(&self, scene: &Scene<'_>, options: &BuildOptions) -> Result<Option<Warning>> {
        let grid = &scene.capture.manifest.grid;
        let steps = grid.points.map(|n| n.saturating_sub(1) as f64);
        let middle = grid.dot_projector_px([grid.points[0] / 2, grid.points[1] / 2]);
        // mm from one end of the grid to the other, along x and along y, of both coordinates; scatter about it.
        let fits = [0, 1].map(|a| plane(&self.seen, grid.points, |s| s.off_mm[a]));
        let [Some(x), Some(y)] = fits else { return Ok(None) };
        let scatter_mm = x.scatter.max(y.scatter);
        let found_mm = [0, 1].map(|k| [x.slope[k], y.slope[k]]);
        // The same of the line of sight, per depth: light from one depth is seen nearer to the camera's foot.
        let leanings = [0, 1].map(|a| plane(&self.seen, grid.points, |s| s.lean[a]).map_or([0.0; 2], |p| p.slope));
        let leans = [0, 1].map(|k| [leanings[0][k], leanings[1][k]]);
        // An axis that is not stretched tells the depth: the one whose depth is nearer to what media have.
        let depth_of = |k: usize| {
            let square = leans[k][0].powi(2) + leans[k][1].powi(2);
            let along = found_mm[k][0] * leans[k][0] + found_mm[k][1] * leans[k][1];
            (square > 1e-12).then(|| (along / square).clamp(0.0, DEEPEST * self.half_light_mm))
        };
        let usual_mm = DEPTH_OF_HALF_LIGHT * self.half_light_mm;
        let depths = (0..2).filter(|&k| steps[k] > 0.0).filter_map(depth_of);
        let depth_mm = depths.min_by(|a, b| (a - usual_mm).abs().total_cmp(&(b - usual_mm).abs())).unwrap_or(0.0);
        let far_mm = [0, 1].map(|k| [0, 1].map(|a| found_mm[k][a] - depth_mm * leans[k][a]));
        let length = |v: Point| v[0].hypot(v[1]);
        // The map that says where dots should be has a scale of its own uncertainty.
        let map_mm = [0, 1].map(|k| {
            let side_px = steps[k] * grid.step_projector_px[k];
            let [[a, b], [c, d]] = scene.registration.slab_from_projector.jacobian(middle);
            scene.registration.projector_scale_sd[k] * side_px * if k == 0 { a.hypot(c) } else { b.hypot(d) }
        });
        let sd_far_mm = (scatter_mm * (12.0 / self.seen.len() as f64).sqrt()).hypot(map_mm[0].max(map_mm[1]));
        // Of two media light comes from different depths.
        let all = |a: usize| self.seen.iter().map(move |s| s.lean[a].abs());
        let aslant = [0, 1].map(|a| all(a).fold(0.0, f64::max));
        let explained_mm =
            (self.half_light_spread_mm * length(aslant)).max(scatter_mm / RAMP_SCATTER).max(SIGMA * sd_far_mm);
        let far_px = |far_mm: Point| length(projector_px(scene, middle, far_mm));
        let is_told = |far_mm: &Point| length(*far_mm) > explained_mm.max(least_mm(scene));
        let told: Vec<f64> = far_mm.iter().filter(|far| is_told(far)).map(|far| far_px(*far)).collect();
        let Some(most_px) = told.into_iter().reduce(f64::max).filter(|_| self.found >= 0.5) else { return Ok(None) };
        let per_step = |k: usize| projector_px(scene, middle, far_mm[k]).map(|v| v / steps[k].max(1.0));
        let sd_mm = sd_far_mm / steps[0].max(steps[1]).max(1.0);
        let sd_projector_px = length(projector_px(scene, middle, [sd_mm, 0.0]));
        let finding = ConsistencyWarning::DotsStep {
            along_x: per_step(0),
            along_y: per_step(1),
            sd_projector_px,
            far_projector_px: most_px,
        };
        match most_px < REFUSED_PROJECTOR_PX {
            true => Ok(Some(finding.into())),
            false => options.refuse(finding).map(Some),
        }
    }

    /// Grid, reference dots and Gray code that do not agree.
    pub(super) fn offset(
        &self,
        scene: &Scene<'_>,
        results: &[ShotResult],
        options: &BuildOptions,
    ) -> Result<Option<Warning>> {
        let grid = &scene.capture.manifest.grid;
        let middle = grid.dot_projector_px([grid.points[0] / 2, grid.points[1] / 2]);
        let off_px = projector_px(scene, middle, self.offset_mm);
        let length_mm = self.unexplained_mm[0].hypot(self.unexplained_mm[1]);
        let unexplained_px = projector_px(scene, middle, self.unexplained_mm);
        let unexplained_px = unexplained_px[0].hypot(unexplained_px[1]);
        if length_mm < least_mm(scene) || length_mm < SIGMA * self.sd_mm || self.found < 0.5 {
            return Ok(None);
        }
        // Which of them moved: at the first shot the one that lies where the Gray code puts it is right.
        let first = results.iter().find_map(|r| r.drift).map_or([0.0; 2], |d| d.slab_mm);
        let dots = [0, 1].map(|a| first[a] + self.offset_mm[a]);
        let culprit = match dots[0].hypot(dots[1]) < first[0].hypot(first[1]) {
            true => "reference_dots",
            false => "grid.origin_projector_px",
        };
        let finding = ConsistencyWarning::DotsOffset {
            field: culprit.into(),
            board: self.fits_another_board(length_mm).then(|| board(scene)).flatten(),
            offset_projector_px: off_px,
            sd_projector_px: self.sd_mm / length_mm * unexplained_px,
        };
        match unexplained_px < REFUSED_PROJECTOR_PX {
            true => Ok(Some(finding.into())),
            false => options.refuse(finding).map(Some),
        }
    }

    /// Whether dots are displaced as light from below the surface would be if the camera stood on the other side, along
    /// one axis or both: a mirrored or turned board says that it does.
    fn fits_another_board(&self, unexplained_mm: f64) -> bool {
        [[-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]].into_iter().any(|side| {
            let t = [0, 1].map(|a| side[a] * self.lean[a]);
            let along = |v: Point| v[0] * t[0] + v[1] * t[1];
            let depth_mm = along(self.offset_mm) / along(t).max(1e-12);
            let left = [0, 1].map(|a| self.offset_mm[a] - depth_mm * t[a]);
            (0.0..DEEPEST * self.half_light_mm).contains(&depth_mm)
                && left[0].hypot(left[1]) < BOARD_LEAVES * unexplained_mm
        })
    }
}

/// The least displacement that is told, mm.
fn least_mm(scene: &Scene<'_>) -> f64 {
    LEAST_DOT * scene.dot_side_px() / scene.px_per_mm
}

/// The shot of the board in the sample's plane.
fn board(scene: &Scene<'_>) -> Option<String> {
    let boards = scene.capture.shots(|p| matches!(p, Pattern::Board));
    boards.first().map(|&shot| scene.photographs.name(shot).to_owned())
}

/// A plane through values over the grid.
struct Plane {
    /// From one end of the grid to the other along x and along y.
    slope: [f64; 2],
    /// Standard deviation of values about it.
    scatter: f64,
}

/// The plane that most dots agree about; `None` for too few, or all in one line of a grid that has more.
fn plane(seen: &[OffDot], points: [usize; 2], value: impl Fn(&OffDot) -> f64) -> Option<Plane> {
    let place = |s: &OffDot| {
        // Of an axis with one point nothing is known.
        let along = |a: usize| if points[a] > 1 { s.dot[a] as f64 / (points[a] - 1) as f64 - 0.5 } else { 0.0 };
        [1.0, along(0), along(1)]
    };
    // From the median on: a plane through all would give way to those that are far off.
    let middle = median(&mut seen.iter().map(&value).collect::<Vec<_>>());
    let near = 4.0 * scaled_deviation(seen.iter().map(&value), middle);
    let mut kept: Vec<OffDot> = seen.iter().filter(|s| (value(s) - middle).abs() <= near).copied().collect();
    let mut found = None;
    for _ in 0..ROUNDS {
        if kept.len() < LEAST_DOTS.max(seen.len() / 2) {
            return None;
        }
        let (mut a, mut b) = ([[0.0; 3]; 3], [0.0; 3]);
        for s in &kept {
            let p = place(s);
            for i in 0..3 {
                (0..3).for_each(|j| a[i][j] += p[i] * p[j]);
                b[i] += p[i] * value(s);
            }
        }
        (1..3).filter(|&k| points[k - 1] == 1).for_each(|k| a[k][k] = 1.0);
        let (x, _) = solve_small(a, b)?;
        let off = |s: &OffDot| value(s) - place(s).iter().zip(x).map(|(p, x)| p * x).sum::<f64>();
        let scatter = scaled_deviation(seen.iter().map(off), 0.0);
        kept = seen.iter().filter(|s| off(s).abs() <= 4.0 * scatter).copied().collect();
        found = Some(Plane { slope: [x[1], x[2]], scatter });
    }
    found
}

/// A displacement on the slab, mm, in projector px at a projector pixel.
fn projector_px(scene: &Scene<'_>, at: Point, off_mm: Point) -> Point {
    let [[a, b], [c, d]] = scene.registration.slab_from_projector.jacobian(at);
    let det = a * d - b * c;
    [(d * off_mm[0] - b * off_mm[1]) / det, (a * off_mm[1] - c * off_mm[0]) / det]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dots(off: impl Fn(f64, f64) -> f64) -> Vec<OffDot> {
        let places = (0..7).flat_map(|i| (0..5).map(move |j| [i, j]));
        let noise = |[i, j]: [usize; 2]| 0.01 * (((7 * i + 3 * j) % 11) as f64 - 5.0) / 5.0;
        places
            .map(|dot| {
                let off = off(dot[0] as f64 / 6.0 - 0.5, dot[1] as f64 / 4.0 - 0.5) + noise(dot);
                OffDot { dot, lean: [0.0; 2], off_mm: [off, 0.0] }
            })
            .collect()
    }

    fn fit(seen: &[OffDot]) -> Option<Plane> {
        plane(seen, [7, 5], |s| s.off_mm[0])
    }

    #[test]
    fn a_ramp_is_measured_whatever_a_quarter_of_the_dots_does_and_a_step_scatters_about_its_plane() {
        let mut seen = dots(|x, y| 0.4 * x - 0.2 * y + 0.1);
        seen.iter_mut().step_by(4).for_each(|s| s.off_mm[0] += 3.0);
        let found = fit(&seen).unwrap();
        // A hundredth of scatter at 26 dots.
        assert!((found.slope[0] - 0.4).abs() < 0.01 && (found.slope[1] + 0.2).abs() < 0.01, "{:?}", found.slope);
        assert!(found.scatter < 0.02, "{}", found.scatter);
        let step = fit(&dots(|x, _| if x > 0.1 { 0.3 } else { 0.0 })).unwrap();
        assert!(step.scatter > RAMP_SCATTER * step.slope[0], "{} {:?}", step.scatter, step.slope);
        assert!(fit(&seen[..7]).is_none(), "too few");
        let line: Vec<OffDot> = dots(|x, _| x).into_iter().filter(|s| s.dot[1] == 2).collect();
        let along = plane(&line, [7, 1], |s| s.off_mm[0]);
        assert!(along.is_none(), "seven dots");
        let twice = [line.clone(), line].concat();
        assert!((plane(&twice, [7, 1], |s| s.off_mm[0]).unwrap().slope[0] - 1.0).abs() < 0.02);
    }
}
