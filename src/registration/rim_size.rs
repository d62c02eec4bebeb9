//! How large the sample is by its rim, as the board sees it: a printed board that is not of its stated size, or another sample than stated.

use super::camera_motion::{RimSegment, locate_rim, rim_segments};
use super::drift::{median, scaled_deviation};
use crate::cholesky::solve_small;
use crate::geometry::{CameraView, Homography, Point};
use crate::radiance::Radiance;

/// Sizes that are tried, of the stated one, are so far apart that the rim moves by this, px: segments find it 3 px to either side.
const STEP_PX: f64 = 2.0;
/// The largest difference that is looked for.
const LARGEST: f64 = 0.12;
/// Segments that are needed: of the sides that are seen, half, and of four segments each three sides.
const LEAST_SEGMENTS: usize = 12;

/// The sample's size over `size_mm`, by a similarity that takes its rim to where it is seen in `picture` (the whole photograph, the sample
/// without dots), and its standard deviation; `None` where less than half of the rim is seen.
///
/// Not detected: a sample of another shape, one that is off by more than an eighth.
pub fn rim_size(view: &CameraView, size_mm: Point, size_px: [usize; 2], picture: &Radiance) -> Option<[f64; 2]> {
    let half_px = 0.5 * size_mm[0].min(size_mm[1]) * view.px_per_mm(size_mm.map(|s| 0.5 * s));
    let steps = (LARGEST * half_px / STEP_PX).ceil() as isize;
    let mut order: Vec<isize> = (-steps..=steps).collect();
    order.sort_by_key(|k| k.abs());
    let mut best: Option<(usize, [f64; 2])> = None;
    for k in order {
        let tried = 1.0 + k as f64 * STEP_PX / half_px;
        let segments = rim_segments(&scaled(view, size_mm, tried), size_mm, size_px);
        let found: Vec<(RimSegment, f64)> =
            segments.iter().filter_map(|s| Some((*s, locate_rim(&part(picture, s)?, s, None)?.offset_px))).collect();
        if found.len() < LEAST_SEGMENTS.max(segments.len() / 2) {
            continue;
        }
        let Some((kept, [growth, sd])) = growth(&found, view.camera_from_slab(size_mm.map(|s| 0.5 * s))) else {
            continue;
        };
        if best.is_none_or(|(most, _)| kept > most) {
            best = Some((kept, [tried * (1.0 + growth), sd]));
        }
        // Where it should be: nothing else is looked for.
        if k == 0 && 4 * kept > 3 * segments.len() {
            break;
        }
    }
    best.map(|b| b.1)
}

/// The view of a sample that is larger by a factor about its middle.
fn scaled(view: &CameraView, size_mm: Point, factor: f64) -> CameraView {
    let m = view.ideal_from_slab.matrix;
    let middle = size_mm.map(|s| 0.5 * s * (1.0 - factor));
    let row = |r: [f64; 3]| [factor * r[0], factor * r[1], r[0] * middle[0] + r[1] * middle[1] + r[2]];
    CameraView { ideal_from_slab: Homography { matrix: m.map(row) }, ..view.clone() }
}

/// The pixels of a segment.
fn part(picture: &Radiance, segment: &RimSegment) -> Option<Radiance> {
    let (r, whole) = (segment.rect, picture.rect);
    let inside = r.x + r.width <= whole.width && r.y + r.height <= whole.height;
    let rows = (r.y..r.y + r.height).map(|y| 3 * (y * whole.width + r.x)..3 * (y * whole.width + r.x + r.width));
    let cut = |all: &[f32]| rows.clone().flat_map(|k| all[k].iter().copied()).collect();
    let used = || rows.clone().flat_map(|k| picture.used[k].iter().copied()).collect();
    inside.then(|| Radiance { rect: r, value: cut(&picture.value), variance: cut(&picture.variance), used: used() })
}

/// Movement and growth about `middle` that explain where segments are seen: how many agree, and the growth with its standard deviation.
fn growth(found: &[(RimSegment, f64)], middle: Point) -> Option<(usize, [f64; 2])> {
    let row = |s: &RimSegment| {
        let out = (s.at[0] - middle[0]) * s.normal[0] + (s.at[1] - middle[1]) * s.normal[1];
        [s.normal[0], s.normal[1], out]
    };
    let (mut fit, mut limit) = ([0.0; 3], f64::INFINITY);
    let mut result = None;
    for _ in 0..5 {
        let left = |(s, offset): &(RimSegment, f64)| offset - row(s).iter().zip(fit).map(|(a, b)| a * b).sum::<f64>();
        let kept: Vec<&(RimSegment, f64)> = found.iter().filter(|f| left(f).abs() <= limit).collect();
        if kept.len() < LEAST_SEGMENTS {
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
        let left = |(s, offset): &(RimSegment, f64)| offset - row(s).iter().zip(fit).map(|(a, b)| a * b).sum::<f64>();
        let mut misses: Vec<f64> = found.iter().map(|f| left(f).abs()).collect();
        let scale = 1.4826 * median(&mut misses);
        limit = (4.0 * scale).max(0.2);
        let spread = scaled_deviation(kept.iter().map(|f| left(f)), 0.0);
        result = Some((kept.len(), [fit[2], spread * inverse[2].sqrt()]));
    }
    result
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

    #[test]
    fn a_sample_is_measured_by_its_rim_where_it_is_a_tenth_larger_or_smaller_and_beside_its_place() {
        for (factor, shift) in [(1.0, 0.0), (1.0, 0.2), (1.05, -0.1), (0.95, 0.1), (1.1, 0.0), (0.9, 0.0)] {
            let [size, sd] = rim_size(&view(), [28.0, 19.0], SIZE_PX, &picture(factor, shift)).unwrap();
            // Edges of 25 points a pixel are right to a tenth of one, of some 70 px to the middle.
            assert!((size - factor).abs() < 0.003, "{factor} {shift}: {size} ± {sd}");
            assert!(sd < 0.002, "{sd}");
        }
        let mut even = picture(1.0, 0.0);
        even.value.fill(4.0);
        assert_eq!(rim_size(&view(), [28.0, 19.0], SIZE_PX, &even), None);
    }
}
