//! Jumps of the pattern told from its slow walk.

use super::drift::median;
use crate::geometry::Point;

/// A sudden displacement between two shots.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Jump {
    /// Index of the first shot after it.
    pub at: usize,
    /// Its length, camera px.
    pub length_px: f64,
}

/// A step is a jump beyond this many standard deviations of the walk's steps and of the two measurements: by chance
/// once in 10⁷ steps.
const SIGMA: f64 = 6.0;
/// With fewer steps there is no telling what is usual.
const LEAST_STEPS: usize = 4;

/// The steps of `path` (drift in px and its standard deviation per axis, in shooting order; `None` where it was not
/// measured) that its other steps do not explain.
///
/// The usual step is the median of all, so that jumps in less than half of the shots do not hide each other. A movement
/// and its return are two jumps. Not detected: jumps below six times the walk's own steps, jumps within a shot,
/// anything in a path of fewer than five shots.
pub fn find_jumps(path: &[Option<(Point, f64)>]) -> Vec<Jump> {
    let known: Vec<(usize, Point, f64)> =
        path.iter().enumerate().filter_map(|(k, p)| p.map(|(d, sd)| (k, d, sd))).collect();
    let steps: Vec<(usize, f64, f64)> = known
        .windows(2)
        .map(|w| (w[1].0, (w[1].1[0] - w[0].1[0]).hypot(w[1].1[1] - w[0].1[1]), w[0].2.hypot(w[1].2)))
        .collect();
    if steps.len() < LEAST_STEPS {
        return vec![];
    }
    let mut lengths: Vec<f64> = steps.iter().map(|s| s.1).collect();
    // The median length of a step with standard deviation 1 along each axis is √(2 ln 2) (Rayleigh).
    let walk = median(&mut lengths) / (2.0 * 2f64.ln()).sqrt();
    let jumps = steps.iter().filter(|(_, length, sd)| *length > SIGMA * walk.max(*sd));
    jumps.map(|&(at, length_px, _)| Jump { at, length_px }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A walk of steps of 0.1 px whose direction turns by the golden angle: no two alike, nothing random.
    fn walk(shots: usize) -> Vec<Option<(Point, f64)>> {
        let mut at = [0.0; 2];
        let mut path = Vec::new();
        for k in 0..shots {
            let (sin, cos) = (2.4 * k as f64).sin_cos();
            at = [at[0] + 0.1 * cos, at[1] + 0.1 * sin];
            path.push(Some((at, 0.01)));
        }
        path
    }

    #[test]
    fn a_jump_is_found_by_its_shot_and_a_walk_has_none() {
        let mut path = walk(30);
        assert_eq!(find_jumps(&path), vec![]);
        for (_, p) in path.iter_mut().enumerate().skip(11) {
            *p = p.map(|(d, sd)| ([d[0] + 1.5, d[1]], sd));
        }
        path[10] = None;
        let found = find_jumps(&path);
        assert_eq!(found.len(), 1);
        // Two steps of the walk at the most are added or taken away.
        assert!(found[0].at == 11 && (found[0].length_px - 1.5).abs() < 0.21, "{found:?}");
    }

    #[test]
    fn steps_within_what_the_measurement_tells_are_no_jumps() {
        let still: Vec<_> = (0..20).map(|k| Some(([if k == 7 { 0.3 } else { 0.0 }, 0.0], 0.1))).collect();
        assert_eq!(find_jumps(&still), vec![]);
        let sure: Vec<_> = still.into_iter().map(|p| p.map(|(d, _)| (d, 0.01))).collect();
        assert_eq!(find_jumps(&sure).len(), 2, "there and back");
    }

    #[test]
    fn a_jump_is_six_deviations_of_a_walk_whose_median_step_is_known() {
        // Steps of 0.1 px by turns, far from the origin: the walk's deviation is 0.1 / √(2 ln 2), six of them are
        // 0.5096 px.
        let path = |steps: &[Point]| {
            let mut at = [5.0, -7.0];
            let mut path = vec![Some((at, 0.001))];
            for step in steps {
                at = [at[0] + step[0], at[1] + step[1]];
                path.push(Some((at, 0.001)));
            }
            path
        };
        let jumps = |length: f64| {
            let (a, b) = ([0.06, -0.08], [-0.08, 0.06]);
            find_jumps(&path(&[a, b, a, [0.6 * length, 0.8 * length], b, a]))
        };
        assert_eq!(jumps(0.509), vec![]);
        let found = jumps(0.511);
        assert!(found.len() == 1 && found[0].at == 4 && (found[0].length_px - 0.511).abs() < 1e-12, "{found:?}");
        // Four steps are the least.
        let (a, far) = ([0.06, -0.08], [6.0, 8.0]);
        assert_eq!((find_jumps(&path(&[a, far, a])).len(), find_jumps(&path(&[a, far, a, a])).len()), (0, 1));
    }
}
