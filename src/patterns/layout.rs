//! Where the dots go, and in which shot.

use super::plan::PlannedShot;
use super::{PatternsOptions, Plan};
use crate::capture::{Axis, FORMAT, Grid, Pattern, ReferenceDots, Rig, Slab, Surface, Window};
use crate::geometry::{Homography, Point};
use crate::{Error, Result};

/// Everything about the rig and the sample that the layout needs, with every default filled in.
#[derive(Debug, Clone)]
pub(super) struct PlanLayout {
    pub slab_mm: Point,
    pub projector_from_slab: Homography,
    pub window: Window,
    pub spacing_mm: f64,
    pub narrowest_stripe_px: usize,
    pub lattice_secs: Vec<f64>,
    pub white_secs: Vec<f64>,
}

/// Shares of a side at which the two reference dots beside it lie.
const REFERENCES_ALONG: [f64; 2] = [0.2, 0.8];

impl PlanLayout {
    /// The plan: what `docs/captures.md` tells people to shoot, in its order, so that the object before the camera
    /// changes thrice.
    pub(super) fn plan(&self, options: &PatternsOptions, rig: &Rig) -> Result<Plan> {
        let grid = self.grid(options)?;
        let size_px = rig.projector.size_px;
        let reference_dots = self.reference_dots(options, &grid);
        let outside = |p: &Point| !(0..2).all(|a| dot_inside(p[a], grid.dot_projector_px, size_px[a]));
        let last = grid.points.map(|n| n - 1);
        let corners = [[0, 0], [last[0], 0], [0, last[1]], last].map(|d| grid.dot_projector_px(d));
        if let Some(p) = corners.iter().chain(&reference_dots).find(|p| outside(p)) {
            return Err(Error::Setting {
                setting: "slab_mm, projector_px_per_mm, center_px",
                expected: format!("dots within the projector's {} × {} px", size_px[0], size_px[1]),
                found: format!("one at ({:.1}, {:.1}) px", p[0], p[1]),
            });
        }
        let mut shots = Vec::new();
        let mut add = |name: &str, pattern: Pattern, secs: &[f64]| {
            let number = shots.len() + 1;
            let picture = Some(format!("pictures/{number:04}_{name}.png"));
            shots.push(PlannedShot { name: name.to_owned(), pattern, picture, exposures_secs: secs.to_vec() });
        };
        add("board", Pattern::Board, &self.white_secs);
        add("reference-white", Pattern::ReferenceWhite, &self.white_secs);
        add("reference-black", Pattern::ReferenceBlack, &self.lattice_secs);
        for (axis, letter, size) in [(Axis::X, 'x', size_px[0]), (Axis::Y, 'y', size_px[1])] {
            for bit in gray_bits(size, self.narrowest_stripe_px) {
                for inverse in [false, true] {
                    let name = format!("gray-{letter}-{bit:02}{}", if inverse { "-inverse" } else { "" });
                    add(&name, Pattern::GrayCode { axis, bit, inverse, on: Surface::WhiteReference }, &self.white_secs);
                }
            }
        }
        add("sample-black", Pattern::SampleBlack, &self.lattice_secs);
        let spacing = self.spacing_points(&grid);
        for (n, dots) in lattice_shots(grid.points, spacing).into_iter().enumerate() {
            add(&format!("lattice-{n:04}"), Pattern::Lattice { dots }, &self.lattice_secs);
        }
        Ok(Plan {
            format: FORMAT,
            name: options.name.clone().unwrap_or_else(|| "unnamed".into()),
            slab: Slab { size_mm: self.slab_mm },
            grid,
            window: self.window.clone(),
            reference_dots: Some(ReferenceDots { projector_px: reference_dots }),
            shots,
        })
    }

    /// Projector px in a mm at the slab's centre.
    fn px_per_mm(&self) -> f64 {
        self.projector_from_slab.area_scale(self.slab_mm.map(|s| 0.5 * s)).sqrt()
    }

    /// The spacing along each axis in lit points.
    pub(super) fn spacing_points(&self, grid: &Grid) -> [usize; 2] {
        let px = self.spacing_mm * self.px_per_mm();
        std::array::from_fn(|a| ((px / grid.step_projector_px[a] - 1e-9).ceil().max(1.0) as usize).min(grid.points[a]))
    }

    /// Points in the middle of the slab, half a window from its rim where it is large enough, on whole projector
    /// pixels.
    pub(super) fn grid(&self, options: &PatternsOptions) -> Result<Grid> {
        let scale = self.px_per_mm();
        let dot = options.dot_px;
        let refuse = |setting, expected: String, found: String| Err(Error::Setting { setting, expected, found });
        let (mut points, mut step) = ([1; 2], [0.0; 2]);
        for a in 0..2 {
            let half_window = 0.5 * self.window.samples[a] as f64 * self.window.pitch_mm;
            let margin = options.margin_mm.unwrap_or(half_window.min(0.25 * self.slab_mm[a]));
            let extent_px = (self.slab_mm[a] - 2.0 * margin) * scale - dot as f64;
            if !(extent_px >= 0.0) {
                let found = format!("{} mm of {} mm", 2.0 * margin, self.slab_mm[a]);
                return refuse("margin_mm", "margins that leave room for a dot".into(), found);
            }
            match options.grid {
                Some(grid) => {
                    points[a] = grid[a];
                    step[a] = (extent_px / (points[a].max(2) - 1) as f64).floor();
                }
                None => {
                    step[a] = (options.lit_pitch_mm.unwrap_or(self.window.pitch_mm) * scale).round();
                    points[a] = (extent_px / step[a].max(1.0)).floor() as usize + 1;
                }
            }
            if step[a] < dot as f64 {
                let found = format!("dots {} px apart", step[a]);
                return refuse("grid, lit_pitch_mm", format!("dots that are {dot} px apart or more"), found);
            }
            if !(1..=65_536).contains(&points[a]) {
                return refuse("grid, lit_pitch_mm", "1 to 65536 points".into(), points[a].to_string());
            }
        }
        let center = self.projector_from_slab.map(self.slab_mm.map(|s| 0.5 * s));
        let origin = |a: usize| whole_dot(center[a] - 0.5 * (points[a] - 1) as f64 * step[a], dot);
        Ok(Grid {
            points,
            origin_projector_px: [origin(0), origin(1)],
            step_projector_px: step,
            dot_projector_px: dot,
            dot_area_projector_px2: None,
        })
    }

    /// Two dots on each side of the frame.
    fn reference_dots(&self, options: &PatternsOptions, grid: &Grid) -> Vec<Point> {
        let ([w, h], f) = (self.slab_mm, 0.5 * options.frame_mm);
        let sides = REFERENCES_ALONG.iter().flat_map(|&t| [[t * w, -f], [t * w, h + f], [-f, t * h], [w + f, t * h]]);
        sides.map(|p| self.projector_from_slab.map(p).map(|v| whole_dot(v, grid.dot_projector_px))).collect()
    }
}

/// The sweep: every grid point once, those of one shot `spacing` points apart along each axis, row after row of
/// offsets.
pub fn lattice_shots(points: [usize; 2], spacing: [usize; 2]) -> Vec<Vec<[usize; 2]>> {
    let step: [usize; 2] = std::array::from_fn(|a| spacing[a].clamp(1, points[a].max(1)));
    let every = |start: usize, a: usize| (start..points[a]).step_by(step[a]);
    let phases = (0..step[1]).flat_map(|y| (0..step[0]).map(move |x| [x, y]));
    let shots = phases.map(|[px, py]| every(py, 1).flat_map(|y| every(px, 0).map(move |x| [x, y])).collect());
    shots.filter(|dots: &Vec<_>| !dots.is_empty()).collect()
}

/// Bits of the Gray code for `size` columns (or rows), the widest stripes first, none narrower than `narrowest_px`.
pub fn gray_bits(size: usize, narrowest_px: usize) -> Vec<u32> {
    let bits = usize::BITS - (size.max(2) - 1).leading_zeros();
    // The coarsest is always needed: without any, nothing tells left from right.
    (0..bits).rev().filter(|&bit| bit + 1 == bits || 2usize << bit >= narrowest_px).collect()
}

/// The nearest centre of a dot of whole pixels: on a pixel for an odd side, between two for an even one.
fn whole_dot(px: f64, side: usize) -> f64 {
    if side.is_multiple_of(2) { px.floor() + 0.5 } else { px.round() }
}

fn dot_inside(center: f64, side: usize, size: usize) -> bool {
    let half = 0.5 * (side as f64 - 1.0);
    center - half >= 0.0 && center + half <= size as f64 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sweep_lights_every_point_once_and_keeps_the_distance() {
        for (points, spacing) in [([7, 5], [3, 2]), ([4, 4], [9, 9]), ([1, 6], [1, 4]), ([8, 8], [1, 1])] {
            let mut lit = vec![0; points[0] * points[1]];
            for dots in lattice_shots(points, spacing) {
                for (k, a) in dots.iter().enumerate() {
                    lit[a[1] * points[0] + a[0]] += 1;
                    for b in &dots[..k] {
                        assert!((0..2).any(|i| a[i].abs_diff(b[i]) >= spacing[i]), "{a:?} {b:?}");
                    }
                }
            }
            assert!(lit.iter().all(|&n| n == 1), "{points:?} {spacing:?}");
        }
    }

    #[test]
    fn the_bits_tell_all_columns_apart_down_to_the_narrowest_stripe() {
        assert_eq!(gray_bits(1280, 8), [10, 9, 8, 7, 6, 5, 4, 3, 2]);
        assert_eq!(gray_bits(1024, 2), [9, 8, 7, 6, 5, 4, 3, 2, 1, 0]);
        assert_eq!(gray_bits(208, 500), [7]);
    }
}
