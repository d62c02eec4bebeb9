//! Where stripes are used: on the slab's plane, and for a frame beside the sample.

use super::fit::Observation;
use crate::geometry::{CameraView, Homography, Point};

/// What the stripes were projected on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StripeSurface {
    /// A white reference all over.
    White,
    /// The frame around a sample of this size, mm: only what lies outside the sample is used, which blurs the stripes.
    Frame(Point),
}

/// Where on the slab's plane stripes are used: elsewhere they may fall on something that does not lie in it.
#[derive(Debug, Clone, PartialEq)]
pub struct StripeArea {
    /// Least and greatest corner of a rectangle, mm.
    pub corners_mm: [Point; 2],
    /// Reference dots and corners of the grid, projector px: the rectangle is widened to hold them.
    pub dots_projector_px: Vec<Point>,
}

/// How far beyond the outermost dot the area goes, of its own side.
const AREA_MARGIN: f64 = 0.05;

impl StripeArea {
    /// All of the picture.
    pub(super) fn everywhere() -> Self {
        Self { corners_mm: [[f64::MIN; 2], [f64::MAX; 2]], dots_projector_px: Vec::new() }
    }

    /// The rectangle with the dots in it, where `map` (slab mm to projector px) puts them; `None` when it holds them
    /// already.
    pub(super) fn widened(&self, map: &Homography) -> Option<Self> {
        let back = map.inverse()?;
        let [mut low, mut high] = self.corners_mm;
        let margin = [0, 1].map(|a| AREA_MARGIN * (high[a] - low[a]));
        for p in self.dots_projector_px.iter().map(|q| back.map(*q)).filter(|p| p.iter().all(|v| v.is_finite())) {
            for a in 0..2 {
                low[a] = low[a].min(p[a] - margin[a]);
                high[a] = high[a].max(p[a] + margin[a]);
            }
        }
        let wider = Self { corners_mm: [low, high], dots_projector_px: Vec::new() };
        (wider.corners_mm != self.corners_mm).then_some(wider)
    }
}

/// Pixels nearer to the sample's rim than this are not on the frame alone, px.
const RIM_PX: f64 = 4.0;
/// On each side of the sample at least this share of the decoded pixels must lie: beyond them the map is an
/// extrapolation.
const LEAST_SIDE_SHARE: f64 = 0.05;
/// Pixels in a square of this side are kept or left out together: a few stripes' edges and the clear pixels between
/// them.
pub(super) const BLOCK_PX: usize = 8;
/// Which pixels may be used: those of squares whose middle is in the area, and for a frame those beside the sample.
pub(super) fn usable_pixels(
    view: &CameraView,
    [width, height]: [usize; 2],
    surface: StripeSurface,
    area: &StripeArea,
    slab: &dyn Fn(Point) -> Point,
) -> Vec<bool> {
    let [low, high] = area.corners_mm;
    let inside = |p: Point| (0..2).all(|a| p[a] >= low[a] && p[a] <= high[a]);
    let columns = width.div_ceil(BLOCK_PX);
    let middle = |b: usize, side: usize| ((b * BLOCK_PX) as f64 + 0.5 * (BLOCK_PX - 1) as f64).min((side - 1) as f64);
    let squares: Vec<bool> = (0..columns * height.div_ceil(BLOCK_PX))
        .map(|b| inside(slab([middle(b % columns, width), middle(b / columns, height)])))
        .collect();
    let outside = |x: usize, y: usize| match surface {
        StripeSurface::White => true,
        StripeSurface::Frame(size) => {
            let rim = RIM_PX / view.px_per_mm(size.map(|s| 0.5 * s));
            let p = slab([x as f64, y as f64]);
            (0..2).any(|a| p[a] < -rim || p[a] > size[a] + rim)
        }
    };
    let usable = |k: usize| {
        let (x, y) = (k % width, k / width);
        squares[y / BLOCK_PX * columns + x / BLOCK_PX] && outside(x, y)
    };
    (0..width * height).map(usable).collect()
}

/// A frame that is seen on one side only says nothing about the other.
pub(super) fn check_sides(decoded: &[Observation], size_mm: Point) -> Result<(), String> {
    for axis in 0..2 {
        for (far, side) in [(false, ["left", "upper"]), (true, ["right", "lower"])] {
            let beyond = |o: &&Observation| if far { o.from[axis] > size_mm[axis] } else { o.from[axis] < 0.0 };
            let found = decoded.iter().filter(beyond).count();
            if (found as f64) < LEAST_SIDE_SHARE * decoded.len() as f64 {
                let (all, side) = (decoded.len(), side[axis]);
                return Err(format!(
                    "the frame must show the Gray code on all sides of the sample, but only {found} of {all} decoded pixels lie on its {side} side"
                ));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Lens;

    const SIZE: [usize; 2] = [130, 96];

    #[test]
    fn on_a_frame_only_what_lies_outside_the_sample_is_used() {
        let slab = |q: Point| [q[0] / 5.0, q[1] / 4.0];
        let matrix = [[5.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]];
        let view = CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([0.0; 2], 300.0) };
        let usable =
            |surface, area: &StripeArea, slab: &dyn Fn(Point) -> Point| usable_pixels(&view, SIZE, surface, area, slab);
        assert!(usable(StripeSurface::White, &StripeArea::everywhere(), &slab).iter().all(|u| *u));
        // Squares of 8 px whose middles, 3.5 px from their first, lie between 2 and 10 mm (columns 10 to 50) and beyond
        // 5 mm (line 20).
        let area = StripeArea { corners_mm: [[2.0, 5.0], [10.0, 100.0]], dots_projector_px: vec![] };
        let used = usable(StripeSurface::White, &area, &slab);
        for (x, y, expected) in
            [(7, 40, false), (8, 40, true), (47, 40, true), (48, 40, false), (20, 24, true), (20, 23, false)]
        {
            assert_eq!(used[x + y * SIZE[0]], expected, "({x}, {y})");
        }
        let used = usable(StripeSurface::Frame([15.0, 12.0]), &StripeArea::everywhere(), &slab);
        // Four pixels are 4 / √20 = 0.894 mm: beyond 15.894 mm in x are columns from 80 on, beyond 12.894 in y lines
        // from 52 on.
        for (x, y, expected) in [(79, 51, false), (80, 51, true), (79, 52, true), (0, 0, false), (3, 51, false)] {
            assert_eq!(used[x + y * SIZE[0]], expected, "({x}, {y})");
        }
        let left = |q: Point| [q[0] / 5.0 - 2.0, q[1] / 4.0 - 1.0];
        let used = usable(StripeSurface::Frame([15.0, 12.0]), &StripeArea::everywhere(), &left);
        // −0.894 mm is column 5.5, and line 0.4.
        for (x, y, expected) in [(5, 9, true), (6, 9, false), (40, 0, true), (40, 1, false)] {
            assert_eq!(used[x + y * SIZE[0]], expected, "({x}, {y})");
        }
    }

    #[test]
    fn a_frame_must_show_the_code_on_all_sides() {
        let at = |from: Point| Observation { from, axis: 0, to: 0.0 };
        let all = [[-1.0, 5.0], [31.0, 5.0], [5.0, -1.0], [5.0, 21.0]];
        let without = |side: usize, few: usize| {
            let mut decoded: Vec<Observation> =
                (0..100).map(|k| at(all[k % 4])).filter(|o| o.from != all[side]).collect();
            decoded.extend((0..few).map(|_| at(all[side])));
            check_sides(&decoded, [30.0, 20.0])
        };
        for (side, name) in ["left", "right", "upper", "lower"].into_iter().enumerate() {
            // 3 of 78 are less than a twentieth, 4 of 79 are more.
            assert!(without(side, 3).unwrap_err().contains(&format!("3 of 78 decoded pixels lie on its {name} side")));
            assert_eq!(without(side, 4), Ok(()));
        }
    }
}
