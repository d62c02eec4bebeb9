//! A board whose photographs are mirrored or turned: it is found all the same, and puts the slab elsewhere. The sample's
//! rim tells, where the camera looks aslant or stands to one side.

use super::camera_motion::{RimSegment, locate_rim, rim_segments};
use super::drift::median;
use crate::capture::Board;
use crate::geometry::{CameraView, Homography, Point};
use crate::radiance::Radiance;

/// What may have been done to its photographs, and which axes of the picture that turns round.
const FLIPS: [(&str, [bool; 2]); 3] = [
    ("mirrored left to right", [true, false]),
    ("mirrored upside down", [false, true]),
    ("turned by 180°", [true, true]),
];
/// As the photographs are, the rim is farther than this from its place, px.
const OFF_PX: f64 = 1.0;
/// Undone, it is this much nearer: by chance a sample that was laid down by hand is, along both axes and turned, once in
/// some hundreds.
const NEARER: f64 = 0.1;
/// A rim that is not seen is farther from its place than it is looked for, px.
const LOOKED_FOR_PX: f64 = 3.0;
/// This share of the rim's pieces is seen.
const SEEN: f64 = 0.67;

/// What the photographs of a board look like.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlippedBoard {
    /// In words.
    pub looks: &'static str,
    /// How far the rim is from its place, what was done to them undone: the median of its pieces, px.
    pub off_px: f64,
    /// The same as they are; `None` where less than two thirds of it are seen.
    pub as_it_is_px: Option<f64>,
}

/// Whether the rim of a slab of `size_mm`, seen in `picture`, is where `view` would put it, had the photographs of the
/// board that it was fitted to been mirrored or turned, and not where it puts it as it is.
///
/// Not detected: a camera that looks straight down on the middle of board and slab.
pub fn flip_of_board(
    view: &CameraView,
    board: &Board,
    size_px: [usize; 2],
    (size_mm, picture): (Point, &Radiance),
) -> Option<FlippedBoard> {
    let off = |view: &CameraView| off_rim(view, size_mm, size_px, picture);
    let as_it_is_px = off(view);
    if as_it_is_px.is_some_and(|off| off < OFF_PX) {
        return None;
    }
    let undone = |&(looks, flip): &(&'static str, [bool; 2])| Some((looks, off(&flipped(view, board, size_px, flip))?));
    let (looks, off_px) = FLIPS.iter().filter_map(undone).min_by(|a, b| a.1.total_cmp(&b.1))?;
    let nearer = off_px < NEARER * as_it_is_px.unwrap_or(LOOKED_FOR_PX);
    nearer.then_some(FlippedBoard { looks, off_px, as_it_is_px })
}

/// How far the rim is from where a view puts it, px.
fn off_rim(view: &CameraView, size_mm: Point, size_px: [usize; 2], picture: &Radiance) -> Option<f64> {
    let segments = rim_segments(view, size_mm, size_px);
    let place = |s: &RimSegment| Some(locate_rim(&picture.part(s.rect), s, None)?.offset_px.abs());
    let mut off: Vec<f64> = segments.iter().filter_map(place).collect();
    (off.len() as f64 > SEEN * segments.len() as f64 && !off.is_empty()).then(|| median(&mut off))
}

/// The view of a camera whose pictures of the board were turned round along some axes: of picture and board alike, since
/// corners are counted from the picture's top left.
fn flipped(view: &CameraView, board: &Board, size_px: [usize; 2], flip: [bool; 2]) -> CameraView {
    let far_mm = board.corner_mm([board.inner_corners[0] - 1, board.inner_corners[1] - 1]);
    let about = |ends: Point| {
        let row = |a: usize| {
            let mut row = [0.0; 3];
            (row[a], row[2]) = if flip[a] { (-1.0, ends[a]) } else { (1.0, 0.0) };
            row
        };
        Homography { matrix: [row(0), row(1), [0.0, 0.0, 1.0]] }
    };
    let picture = about(size_px.map(|n| (n - 1) as f64));
    let plane = about([0, 1].map(|a| board.origin_mm[a] + far_mm[a]));
    let mut lens = view.lens;
    lens.center_px = picture.map(lens.center_px);
    CameraView { ideal_from_slab: picture.after(&view.ideal_from_slab).after(&plane), lens }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;
    use crate::geometry::Lens;

    const SIZE_PX: [usize; 2] = [150, 128];
    const SIZE_MM: Point = [17.0, 13.0];

    fn board() -> Board {
        Board { inner_corners: [7, 5], square_mm: 2.0, origin_mm: [1.5, 2.2], edge_blur_mm: 0.0 }
    }

    /// A slab of 17 × 13 mm in a brighter frame, seen from the left and from above.
    fn view() -> CameraView {
        let matrix = [[6.2, -0.2, 21.0], [0.3, 6.1, 19.0], [1e-3, 2e-3, 1.0]];
        CameraView {
            ideal_from_slab: Homography { matrix },
            lens: Lens { k1: -0.03, ..Lens::ideal([72.0, 66.0], 300.0) },
        }
    }

    fn picture() -> Radiance {
        let rect = Rect { x: 0, y: 0, width: SIZE_PX[0], height: SIZE_PX[1] };
        let inside = |q: Point| {
            let p = view().slab_from_camera(q).unwrap();
            u8::from((0..2).all(|a| p[a] > 0.0 && p[a] < SIZE_MM[a]))
        };
        let light = |k: usize| {
            let (x, y) = ((k % SIZE_PX[0]) as f64, (k / SIZE_PX[0]) as f64);
            let part = |n: u32| inside([x + f64::from(n % 5) * 0.2 - 0.4, y + f64::from(n / 5) * 0.2 - 0.4]);
            8.0 - (0..25).map(|n| f32::from(part(n))).sum::<f32>() / 5.0
        };
        let value = (0..rect.area()).flat_map(|k| [light(k); 3]).collect();
        Radiance { rect, value, variance: vec![1e-3; 3 * rect.area()], used: vec![1; 3 * rect.area()] }
    }

    fn flip(view: &CameraView) -> Option<FlippedBoard> {
        flip_of_board(view, &board(), SIZE_PX, (SIZE_MM, &picture()))
    }

    #[test]
    fn photographs_of_a_board_that_are_mirrored_or_turned_are_told_by_the_samples_rim() {
        assert_eq!(flip(&view()), None);
        for (looks, axes) in FLIPS {
            let found = flip(&flipped(&view(), &board(), SIZE_PX, axes)).unwrap();
            // Edges of 25 points a pixel are right to a tenth of one.
            assert!(found.looks == looks && found.off_px < 0.1, "{found:?}");
        }
    }

    #[test]
    fn a_sample_that_lies_elsewhere_is_no_flipped_board() {
        for offset in [[0.4, 0.0], [-0.5, 0.3], [0.2, 0.5]] {
            let plane = Homography { matrix: [[1.0, 0.0, offset[0]], [0.0, 1.0, offset[1]], [0.0, 0.0, 1.0]] };
            let seen = view();
            assert_eq!(flip(&CameraView { ideal_from_slab: seen.ideal_from_slab.after(&plane), ..seen }), None);
        }
    }

    #[test]
    fn a_flipped_view_puts_the_turned_round_board_where_the_picture_is_turned_round() {
        let (view, board) = (view(), board());
        let turned = flipped(&view, &board, SIZE_PX, [true, false]);
        for (i, j) in [(0, 0), (6, 0), (2, 4)] {
            let [x, y] = view.camera_from_slab(board.corner_mm([i, j]));
            let found = turned.camera_from_slab(board.corner_mm([6 - i, j]));
            // f64 through one lens and its mirror image.
            assert!((found[0] - (149.0 - x)).abs() < 1e-9 && (found[1] - y).abs() < 1e-9, "{found:?}");
        }
    }
}
