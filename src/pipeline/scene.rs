//! The bench as lattice shots see it: registered, with its black and white references.

use super::photographs::Photographs;
use super::references::References;
use super::register::Registered;
use crate::capture::{Capture, Pattern, Rect};
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance, mend};
use crate::registration::Registration;
use crate::{Error, Result};

/// Outgoing samples around a dot's expected place in which it is searched, and pixels at the least: what a bench that
/// was touched moves by.
const DRIFT_SEARCH_SAMPLES: f64 = 8.0 / 3.0;
const LEAST_SEARCH_PX: f64 = 8.0;
/// What a centroid needs around a dot, px.
const CENTROID_PX: f64 = 2.0;

/// A camera that has not moved, px.
pub(super) const STILL: Point = [0.0; 2];

/// What lattice shots are measured against, as far as their own light is not needed for it.
pub(super) struct Scene<'a> {
    pub(super) capture: &'a Capture,
    pub(super) photographs: &'a Photographs<'a>,
    pub(super) registration: &'a Registration,
    pub(super) references: &'a References,
    pub(super) px_per_mm: f64,
    pub(super) cell_px: f64,
}

impl<'a> Scene<'a> {
    pub(super) fn new(
        photographs: &'a Photographs<'a>,
        registered: &'a Registered,
        references: &'a References,
    ) -> Self {
        let (capture, registration) = (photographs.capture, &registered.registration);
        let px_per_mm = registration.px_per_mm();
        let cell_px = px_per_mm * capture.manifest.window.pitch_mm;
        Self { capture, photographs, registration, references, px_per_mm, cell_px }
    }

    pub(super) fn dots(&self, shot: usize) -> &[[usize; 2]] {
        match &self.capture.manifest.shots[shot].pattern {
            Pattern::Lattice { dots } => dots,
            _ => &[],
        }
    }

    pub(super) fn lattice(&self) -> Vec<usize> {
        self.capture.shots(|p| matches!(p, Pattern::Lattice { .. }))
    }

    /// From a lit point to the next along each axis of the grid, mm, at its first point.
    pub(super) fn steps_mm(&self) -> [Point; 2] {
        let first = self.nominal_mm([0, 0]);
        [[1, 0], [0, 1]].map(|next| {
            let p = self.nominal_mm(next);
            [p[0] - first[0], p[1] - first[1]]
        })
    }

    /// Where the pattern puts a dot, mm, without drift.
    pub(super) fn nominal_mm(&self, dot: [usize; 2]) -> Point {
        let grid = &self.capture.manifest.grid;
        self.registration.slab_from_projector.map(grid.dot_projector_px(dot))
    }

    pub(super) fn reference_mm(&self) -> Vec<Point> {
        let dots = self.capture.manifest.reference_dots.iter().flat_map(|r| &r.projector_px);
        dots.map(|&p| self.registration.slab_from_projector.map(p)).collect()
    }

    /// Radiance of a part of a bracket for a camera that has moved by `camera_px`, ambient light subtracted, hot
    /// photosites mended.
    pub(super) fn picture(&self, bracket: &Bracket, part: Rect, camera_px: Point) -> Radiance {
        let mut picture = bracket.merge(part, &self.photographs.sensor);
        match camera_px {
            STILL => picture.subtract(&self.references.ambient),
            moved => picture.subtract(&moved_part(&self.references.ambient, part, moved)),
        }
        mend(&mut picture, &self.references.hot);
        picture
    }

    /// Where the reference dots are looked for.
    pub(super) fn reference_rects(&self, shot: usize) -> Result<Vec<Rect>> {
        let reach_px = self.dot_radius_px() + self.drift_search_px();
        let around = |p: Point| {
            let at = self.registration.view.camera_from_slab(p);
            square(at, reach_px, self.capture.rig.camera.size_px).ok_or_else(|| self.outside_picture(shot))
        };
        self.reference_mm().into_iter().map(around).collect()
    }

    /// The smallest distance between dots of one shot, in outgoing samples; `None` for single dots.
    pub(super) fn smallest_spacing(&self) -> Option<f64> {
        self.lattice().iter().filter_map(|&shot| self.shot_spacing(shot)).reduce(f64::min)
    }

    /// The smallest distance (larger of the two axes) between dots of a shot, in outgoing samples; `None` for a single
    /// dot.
    pub(super) fn shot_spacing(&self, shot: usize) -> Option<f64> {
        let grid = &self.capture.manifest.grid;
        let first = self.nominal_mm([0, 0]);
        let step = self.nominal_mm([1.min(grid.points[0] - 1), 1.min(grid.points[1] - 1)]);
        let pitch = self.capture.manifest.window.pitch_mm;
        let samples: Point = std::array::from_fn(|a| (step[a] - first[a]).abs() / pitch);
        let mut dots = self.dots(shot).to_vec();
        dots.sort_unstable();
        // In sorted order a dot's nearest neighbour is near; looking at 64 finds it on any lattice.
        let gap =
            |a: [usize; 2], b: [usize; 2]| (0..2).map(|k| a[k].abs_diff(b[k]) as f64 * samples[k]).fold(0.0, f64::max);
        let pairs = dots.iter().enumerate().flat_map(|(i, &a)| dots[i + 1..].iter().take(64).map(move |&b| gap(a, b)));
        pairs.reduce(f64::min)
    }

    /// A dot of whose middle no exposure measured any pixel cannot be used at all.
    pub(super) fn check_peak(&self, shot: usize, dot: [usize; 2], center: Point, picture: &Radiance) -> Result<()> {
        let q = self.registration.view.camera_from_slab(center);
        let inside = |v: f64, from: usize, len: usize| (v.round().max(from as f64) as usize).min(from + len - 1);
        let r = picture.rect;
        let k = picture.at(inside(q[0], r.x, r.width), inside(q[1], r.y, r.height));
        let bracket = &self.photographs.brackets[shot];
        match bracket.first() {
            Some(shortest) if picture.used[k..k + 3].contains(&0) => Err(Error::DotSaturated {
                path: shortest.path.clone(),
                shot: shortest.shot.clone(),
                dot,
                shortest_secs: shortest.exposure_secs,
            }),
            _ => Ok(()),
        }
    }

    /// How far around its expected place a dot is searched.
    pub(super) fn drift_search_px(&self) -> f64 {
        (DRIFT_SEARCH_SAMPLES * self.cell_px).max(LEAST_SEARCH_PX)
    }

    /// The farthest drift that is measured; more is refused.
    pub(super) fn drift_followed_px(&self) -> f64 {
        self.drift_search_px() - CENTROID_PX
    }

    pub(super) fn dot_radius_px(&self) -> f64 {
        0.75 * self.dot_side_px()
    }

    /// The side of a dot, px.
    pub(super) fn dot_side_px(&self) -> f64 {
        let grid = &self.capture.manifest.grid;
        let pixel_mm = self.registration.slab_from_projector.area_scale(grid.dot_projector_px([0, 0])).sqrt();
        grid.dot_side_px() * pixel_mm * self.px_per_mm
    }

    pub(super) fn outside_picture(&self, shot: usize) -> Error {
        self.photographs.failed(shot)("a dot lies outside the photograph".into())
    }
}

/// Whether a place lies on the slab, `inside_mm` or more from its rim.
pub(super) fn on_slab(at: Point, size_mm: Point, inside_mm: f64) -> bool {
    (0..2).all(|a| at[a] >= inside_mm && at[a] <= size_mm[a] - inside_mm)
}

/// The square of half side `radius` around `at`, cut to the photograph; `None` when it lies outside.
pub(super) fn square(at: Point, radius: f64, size_px: [usize; 2]) -> Option<Rect> {
    let range = |a: usize| {
        let (low, high) = ((at[a] - radius).floor().max(0.0), (at[a] + radius).ceil().min(size_px[a] as f64 - 1.0));
        (low <= high).then_some((low as usize, (high - low) as usize + 1))
    };
    let ((x, width), (y, height)) = (range(0)?, range(1)?);
    Some(Rect { x, y, width, height })
}

/// The pixels of `rect`, which must lie in the picture, had it moved by `moved_px`: cubic between pixels (Catmull and
/// Rom), clamped at the border.
///
/// Between pixels noise is averaged; its variance is kept as it was, which is too much by a third at the most.
pub(super) fn moved_part(picture: &Radiance, rect: Rect, moved_px: Point) -> Radiance {
    let mut out = picture.part(rect);
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

/// A rectangle with a rim of `by` pixels, cut to the photograph.
pub(super) fn grown(r: Rect, by: usize, size_px: [usize; 2]) -> Rect {
    let (x, y) = (r.x.saturating_sub(by), r.y.saturating_sub(by));
    let (right, bottom) = ((r.x + r.width + by).min(size_px[0]), (r.y + r.height + by).min(size_px[1]));
    Rect { x, y, width: right - x, height: bottom - y }
}

/// The pixels that both have; `None` when there are none.
pub(super) fn overlap(a: Rect, b: Rect) -> Option<Rect> {
    let (x, y) = (a.x.max(b.x), a.y.max(b.y));
    let (right, bottom) = ((a.x + a.width).min(b.x + b.width), (a.y + a.height).min(b.y + b.height));
    (right > x && bottom > y).then(|| Rect { x, y, width: right - x, height: bottom - y })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_square_of_pixels_holds_its_corners_and_ends_with_the_photograph() {
        let rect = |x, y, width, height| Some(Rect { x, y, width, height });
        // 10.3 ± 2.5 is 7.8 to 12.8, 20.6 ± 2.5 is 18.1 to 23.1.
        assert_eq!(square([10.3, 20.6], 2.5, [60, 40]), rect(7, 18, 7, 7));
        assert_eq!(square([1.0, 38.5], 2.5, [60, 40]), rect(0, 36, 5, 4));
        assert_eq!(square([58.5, 1.0], 2.5, [60, 40]), rect(56, 0, 4, 5));
        assert_eq!(square([-3.6, 20.0], 2.5, [60, 40]), None);
        assert_eq!(square([63.0, 20.0], 2.5, [60, 40]), None);
        assert_eq!(square([20.0, 43.0], 2.5, [60, 40]), None);
        assert_eq!(square([45.0, 20.0], 2.0, [60, 40]), rect(43, 18, 5, 5));
        assert_eq!(square([20.0, 45.0], 2.0, [60, 40]), None, "the photograph is wider than high");
    }

    #[test]
    fn rectangles_grow_to_the_photographs_rim_and_overlap_where_both_are() {
        let rect = |x, y, width, height| Rect { x, y, width, height };
        assert_eq!(grown(rect(10, 20, 5, 7), 3, [60, 40]), rect(7, 17, 11, 13));
        assert_eq!(grown(rect(2, 1, 5, 7), 3, [60, 40]), rect(0, 0, 10, 11));
        assert_eq!(grown(rect(50, 30, 9, 9), 3, [60, 40]), rect(47, 27, 13, 13));
        let a = rect(10, 20, 5, 7);
        assert_eq!(overlap(a, rect(12, 15, 30, 8)), Some(rect(12, 20, 3, 3)));
        assert_eq!(overlap(rect(12, 15, 30, 8), a), Some(rect(12, 20, 3, 3)));
        assert_eq!(overlap(a, rect(14, 26, 9, 9)), Some(rect(14, 26, 1, 1)));
        assert_eq!(overlap(a, rect(15, 20, 9, 9)), None);
        assert_eq!(overlap(a, rect(10, 27, 9, 9)), None);
        assert_eq!(overlap(a, rect(11, 22, 2, 3)), Some(rect(11, 22, 2, 3)));
    }
}
