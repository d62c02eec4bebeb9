//! Where the sample is by its rim and how large, as the board sees it: a printed board that is not of its stated size,
//! a photograph of it that is turned, another sample than stated.

use super::camera_motion::{RimPlace, RimSegment, locate_rim, rim_segments};
use super::drift::{median, scaled_deviation};
use crate::cholesky::solve_small;
use crate::geometry::{CameraView, Homography, Point};
use crate::radiance::Radiance;

/// Sizes that are tried, of the stated one, are so far apart that the rim moves by this, px: segments find it 3 px to
/// either side.
const STEP_PX: f64 = 2.0;
/// The largest difference that is looked for.
const LARGEST: f64 = 0.12;
/// Segments along each side, and how many are needed at the least.
const PER_SIDE: usize = 8;
const LEAST_SEGMENTS: usize = 12;

/// Where a sample's rim is seen, of where it should be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RimFit {
    /// Its size, of the stated.
    pub scale: f64,
    /// Standard deviation of that.
    pub scale_sd: f64,
    /// How far its middle is off, camera px.
    pub offset_px: Point,
    /// Standard deviation of that per axis.
    pub offset_sd_px: f64,
}

/// Fits a similarity that takes the rim of a slab of `size_mm` to where it is seen in `picture` (the whole photograph,
/// the sample without dots), whose segments were found at `located`; `None` where less than half of the rim is seen.
///
/// Not detected: a sample of another shape, one that is larger or smaller by more than an eighth, or off by more than
/// that of its size.
pub fn fit_rim(
    view: &CameraView,
    size_mm: Point,
    size_px: [usize; 2],
    picture: &Radiance,
    (segments, located): (&[RimSegment], &[Option<RimPlace>]),
) -> Option<RimFit> {
    let middle_px = view.camera_from_slab(size_mm.map(|s| 0.5 * s));
    let half_px = 0.5 * size_mm[0].min(size_mm[1]) * view.px_per_mm(size_mm.map(|s| 0.5 * s));
    let steps = (LARGEST * half_px / STEP_PX).ceil() as isize;
    let scale = |k: isize| 1.0 + k as f64 * STEP_PX / half_px;
    let fit = |tried: f64, offset_px: Point| {
        let seen = Seen::at(&placed(view, size_mm, tried, offset_px), size_mm, size_px, picture);
        let (kept, fit) = seen.similarity(middle_px)?;
        let offset_px = [0, 1].map(|a| offset_px[a] + fit.offset_px[a]);
        Some((kept, RimFit { scale: tried * fit.scale, offset_px, ..fit }))
    };
    // Where it should be: nothing else is looked for.
    if let Some((kept, found)) = Seen::of(segments, located).similarity(middle_px)
        && 3 * kept > 2 * 4 * PER_SIDE
    {
        return Some(found);
    }
    let sizes = (-steps..=steps).filter_map(|k| fit(scale(k), [0.0; 2]));
    if let Some((_, found)) = sizes.max_by_key(|(kept, _)| *kept) {
        return Some(found);
    }
    // Elsewhere: sides tell how far along their normals only.
    let offset = |a: usize| {
        let along = |k: isize| std::array::from_fn(|i| if i == a { k as f64 * STEP_PX } else { 0.0 });
        let sees = |k: &isize| {
            let seen = Seen::at(&placed(view, size_mm, 1.0, along(*k)), size_mm, size_px, picture);
            seen.segments.iter().filter(|(s, _)| s.normal[a].abs() > s.normal[1 - a].abs()).count()
        };
        (-2 * steps..=2 * steps).max_by_key(sees).map_or(0.0, |k| k as f64 * STEP_PX)
    };
    fit(1.0, [offset(0), offset(1)]).map(|(_, found)| found)
}

/// Segments of a rim that are seen, and how far along their normals, px.
struct Seen {
    all: usize,
    segments: Vec<(RimSegment, f64)>,
}

impl Seen {
    fn at(view: &CameraView, size_mm: Point, size_px: [usize; 2], picture: &Radiance) -> Self {
        let segments = rim_segments(view, size_mm, size_px);
        let located: Vec<_> = segments.iter().map(|s| locate_rim(&picture.part(s.rect), s, None)).collect();
        Self::of(&segments, &located)
    }

    fn of(segments: &[RimSegment], located: &[Option<RimPlace>]) -> Self {
        let seen = segments.iter().zip(located).filter_map(|(s, place)| Some((*s, (*place)?.offset_px)));
        Self { all: segments.len(), segments: seen.collect() }
    }

    /// Movement and growth about `middle` that explain where they are seen, and how many agree.
    fn similarity(&self, middle: Point) -> Option<(usize, RimFit)> {
        let row = |s: &RimSegment| {
            let out = (s.at[0] - middle[0]) * s.normal[0] + (s.at[1] - middle[1]) * s.normal[1];
            [s.normal[0], s.normal[1], out]
        };
        let (mut fit, mut limit) = ([0.0; 3], f64::INFINITY);
        let mut result = None;
        for _ in 0..5 {
            let left =
                |(s, offset): &(RimSegment, f64)| offset - row(s).iter().zip(fit).map(|(a, b)| a * b).sum::<f64>();
            let kept: Vec<&(RimSegment, f64)> = self.segments.iter().filter(|f| left(f).abs() <= limit).collect();
            if kept.len() < LEAST_SEGMENTS.max(self.all / 2) {
                return None;
            }
            let (mut matrix, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
            for (s, offset) in &kept {
                let row = row(s);
                for i in 0..3 {
                    (0..=i).for_each(|j| matrix[i][j] += row[i] * row[j]);
                    right[i] += row[i] * offset;
                }
            }
            let (solved, inverse) = solve_small(matrix, right)?;
            fit = solved;
            let left =
                |(s, offset): &(RimSegment, f64)| offset - row(s).iter().zip(fit).map(|(a, b)| a * b).sum::<f64>();
            let scale = 1.4826 * median(&mut self.segments.iter().map(|f| left(f).abs()).collect::<Vec<_>>());
            limit = (4.0 * scale).max(0.2);
            let spread = scaled_deviation(kept.iter().map(|f| left(f)), 0.0);
            let found = RimFit {
                scale: 1.0 + fit[2],
                scale_sd: spread * inverse[2].sqrt(),
                offset_px: [fit[0], fit[1]],
                offset_sd_px: spread * inverse[0].max(inverse[1]).sqrt(),
            };
            result = Some((kept.len(), found));
        }
        result
    }
}

/// The view of a sample that is larger by a factor about its middle, which is seen `offset_px` beside.
fn placed(view: &CameraView, size_mm: Point, factor: f64, offset_px: Point) -> CameraView {
    let middle = size_mm.map(|s| 0.5 * s);
    let seen = view.camera_from_slab(middle);
    let elsewhere = view.slab_from_camera([seen[0] + offset_px[0], seen[1] + offset_px[1]]).unwrap_or(middle);
    let shift = [0, 1].map(|a| elsewhere[a] - factor * middle[a]);
    let row = |r: [f64; 3]| [factor * r[0], factor * r[1], r[0] * shift[0] + r[1] * shift[1] + r[2]];
    CameraView { ideal_from_slab: Homography { matrix: view.ideal_from_slab.matrix.map(row) }, ..*view }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;
    use crate::geometry::Lens;

    const SIZE_PX: [usize; 2] = [260, 190];

    fn view() -> CameraView {
        let matrix = [[6.2, -0.5, 36.0], [0.4, 5.8, 31.0], [1e-4, -2e-4, 1.0]];
        CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([130.0, 95.0], 300.0) }
    }

    /// A sample whose sides are `factor` times 28 × 19 mm, `shift` to the right, dark in a brighter frame.
    fn picture(factor: f64, shift: f64) -> Radiance {
        let view = view();
        let rect = Rect { x: 0, y: 0, width: SIZE_PX[0], height: SIZE_PX[1] };
        let inside = |x: f64, y: f64| {
            let p = view.slab_from_camera([x, y]).unwrap();
            let far = [(p[0] - 14.0 - shift).abs() - 14.0 * factor, (p[1] - 9.5).abs() - 9.5 * factor];
            f64::from(u8::from(far[0] < 0.0 && far[1] < 0.0))
        };
        let light = |k: usize| {
            let (x, y) = ((k % SIZE_PX[0]) as f64, (k / SIZE_PX[0]) as f64);
            let points = (0..25).map(|n| [f64::from(n % 5) * 0.2 - 0.4, f64::from(n / 5) * 0.2 - 0.4]);
            (8.0 - 5.0 * points.map(|d| inside(x + d[0], y + d[1])).sum::<f64>() / 25.0) as f32
        };
        let value = (0..rect.area()).flat_map(|k| [light(k); 3]).collect();
        Radiance { rect, value, variance: vec![1e-3; 3 * rect.area()], used: vec![1; 3 * rect.area()] }
    }

    fn fit(picture: &Radiance) -> Option<RimFit> {
        let segments = rim_segments(&view(), [28.0, 19.0], SIZE_PX);
        let located: Vec<_> = segments.iter().map(|s| locate_rim(&picture.part(s.rect), s, None)).collect();
        fit_rim(&view(), [28.0, 19.0], SIZE_PX, picture, (&segments, &located))
    }

    #[test]
    fn a_sample_is_measured_by_its_rim_where_it_is_a_tenth_larger_or_smaller_and_beside_its_place() {
        let cases =
            [(1.0, 0.0), (1.0, 0.2), (1.05, -0.1), (0.95, 0.1), (1.1, 0.0), (0.9, 0.0), (1.0, 1.9), (1.0, -2.3)];
        for (factor, shift) in cases {
            let found = fit(&picture(factor, shift)).unwrap();
            // Edges of 25 points a pixel are right to a tenth of one, of some 70 px to the middle.
            assert!((found.scale - factor).abs() < 0.003, "{factor} {shift}: {found:?}");
            // Some 6 px a mm.
            let [x, y] = found.offset_px;
            assert!((x / 6.2 - shift).abs() < 0.1 && (y - 0.4 * shift).abs() < 0.3, "{factor} {shift}: {found:?}");
            assert!(found.scale_sd < 0.002 && found.offset_sd_px < 0.1, "{found:?}");
        }
        let mut even = picture(1.0, 0.0);
        even.value.fill(4.0);
        assert_eq!(fit(&even), None);
    }
}
