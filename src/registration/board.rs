//! The chessboard in the slab's plane: where the camera sees the slab.

use super::Pairs;
use super::corners::find_corners;
use super::fit::fit_view;
use crate::capture::{Board, Camera};
use crate::radiance::Radiance;

/// Finds a board in a merged photograph: its corners in slab coordinates, were it in the slab's plane, and where they
/// are seen.
///
/// Corners by OpenCV (`findChessboardCorners`, then `cornerSubPix` on the linear picture). The corner nearest the
/// picture's top left is taken for corner (0, 0). The whole board must be in the picture.
///
/// # Errors
/// A text that says what was not found; corners that fit no flat board through any lens; every board, without the
/// feature `opencv`.
///
/// Not detected: a board that is not where `rig.toml` says.
pub fn find_board(picture: &Radiance, board: &Board, camera: &Camera) -> Result<Pairs, String> {
    let [nx, ny] = board.inner_corners;
    let light = picture.luminance();
    let brightest = percentile(&light, 0.99);
    if !(brightest > 0.0) {
        return Err("the photograph is black".into());
    }
    let scaled: Vec<f32> = light.iter().map(|v| (255.0 * v / brightest).clamp(0.0, 255.0)).collect();
    let corners = find_corners(&scaled, picture.rect.height, board.inner_corners)?;
    if corners.len() != nx * ny {
        return Err(format!("no chessboard with {nx} × {ny} inner corners was found"));
    }
    let at = |i: usize, j: usize| corners[j * nx + i];
    // OpenCV starts at either end of the board: x must grow to the right, y downwards.
    let flip_x = at(nx - 1, 0)[0] < at(0, 0)[0];
    let flip_y = at(0, ny - 1)[1] < at(0, 0)[1];
    let pairs: Pairs = (0..ny)
        .flat_map(|j| (0..nx).map(move |i| [i, j]))
        .map(|[i, j]| {
            let seen = at(if flip_x { nx - 1 - i } else { i }, if flip_y { ny - 1 - j } else { j });
            (board.corner_mm([i, j]), seen)
        })
        .collect();
    let fit =
        fit_view(&pairs, camera.principal_px, camera.focal_px).ok_or("the board's corners do not span a plane")?;
    // A mistaken corner is off by whole squares; detection noise is far below a pixel.
    if fit.rms_px > 1.0 {
        return Err(format!("the board's corners fit no flat board: RMS {:.2} px", fit.rms_px));
    }
    Ok(pairs)
}

/// The value below which the share `q` of `values` lies; 0 for none.
pub(super) fn percentile(values: &[f32], q: f64) -> f32 {
    let mut sorted = values.to_vec();
    if sorted.is_empty() {
        return 0.0;
    }
    let k = ((sorted.len() - 1) as f64 * q) as usize;
    *sorted.select_nth_unstable_by(k, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(feature = "opencv")]
    use {
        super::super::pictures::{picture, share},
        crate::capture::{Rect, ResponseCurve},
        crate::geometry::Homography,
    };

    #[test]
    fn percentiles_are_values_of_the_sorted_list() {
        let values = [5.0, -1.0, 9.0, 3.0, 7.0];
        assert_eq!([0.0, 0.24, 0.25, 0.5, 0.99, 1.0].map(|q| percentile(&values, q)), [-1.0, -1.0, 3.0, 5.0, 7.0, 9.0]);
        assert_eq!((percentile(&[], 0.5), percentile(&[4.0], 0.9)), (0.0, 4.0));
    }

    #[cfg(feature = "opencv")]
    fn camera(size_px: [usize; 2], focal_px: f64) -> Camera {
        let principal_px = size_px.map(|s| 0.5 * (s - 1) as f64);
        Camera { size_px, focal_px, principal_px, response_curve: ResponseCurve::Linear, vignetting: Vec::new() }
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn corners_of_a_board_are_found_by_their_own_numbers() {
        (0..2).for_each(corners_of_a_board);
    }

    #[cfg(feature = "opencv")]
    #[test]
    fn a_board_on_a_dark_plate_without_a_white_margin_is_found() {
        // Squares of 14 px, a few of them in half the light, on a plate as dark as they are.
        let h = Homography { matrix: [[7.1, 0.3, 21.0], [-0.2, 6.8, 19.0], [1e-3, -1e-3, 1.0]] };
        let back = h.inverse().unwrap();
        let board = Board { inner_corners: [7, 5], square_mm: 2.0, origin_mm: [2.0, 2.0], edge_blur_mm: 0.0 };
        let bright = |x: f64, y: f64| {
            let p = back.map([x, y]);
            let [i, j] = [0, 1].map(|a| ((p[a] - board.origin_mm[a]) / board.square_mm).floor() as i64);
            (-1..7).contains(&i) && (-1..5).contains(&j) && (i + j).rem_euclid(2) == 0
        };
        let rect = Rect { x: 0, y: 0, width: 170, height: 140 };
        let seen = picture(rect, |x, y| 3.0 + (900.0 - 3.0 * x) * share(x, y, bright), 1.0);
        let camera = camera([170, 140], 500.0);
        for (mm, px) in find_board(&seen, &board, &camera).unwrap() {
            let q = h.map(mm);
            // OpenCV's corners on sharp squares whose light falls by a third from one side of the board to the other:
            // up to 0.11 px.
            assert!((px[0] - q[0]).hypot(px[1] - q[1]) < 0.2, "{px:?} {q:?}");
        }
    }

    /// OpenCV begins at the one or the other end, by which squares are dark.
    #[cfg(feature = "opencv")]
    fn corners_of_a_board(first_dark: i64) {
        // Squares of 2 mm, seen obliquely at about 6 and 5 px a millimetre; light inside the board only.
        let h = Homography { matrix: [[6.4, 0.4, 9.0], [-0.3, 5.3, 14.0], [2e-3, -1e-3, 1.0]] };
        let back = h.inverse().unwrap();
        let board = Board { inner_corners: [6, 4], square_mm: 2.0, origin_mm: [3.0, 2.5], edge_blur_mm: 0.0 };
        let bright = |x: f64, y: f64| {
            let p = back.map([x, y]);
            let [i, j] = [0, 1].map(|a| ((p[a] - board.origin_mm[a]) / board.square_mm).floor() as i64);
            let on_board = (-1..6).contains(&i) && (-1..4).contains(&j);
            !on_board || (i + j).rem_euclid(2) == first_dark
        };
        let rect = Rect { x: 0, y: 0, width: 120, height: 90 };
        let seen = picture(rect, |x, y| 3.0 + 900.0 * share(x, y, bright), 1.0);
        let camera = camera([120, 90], 400.0);
        let pairs = find_board(&seen, &board, &camera).unwrap();
        assert_eq!(pairs.len(), 24);
        for (k, (mm, px)) in pairs.iter().enumerate() {
            assert_eq!(*mm, [3.0 + 2.0 * (k % 6) as f64, 2.5 + 2.0 * (k / 6) as f64]);
            let q = h.map(*mm);
            // OpenCV's corners on sharp squares of ten pixels.
            assert!((px[0] - q[0]).hypot(px[1] - q[1]) < 0.1, "{px:?} {q:?}");
        }
        let other = Board { inner_corners: [7, 4], ..board.clone() };
        assert!(find_board(&seen, &other, &camera).unwrap_err().contains("7 × 4"));
        let black = picture(rect, |_, _| 0.0, 1.0);
        assert!(find_board(&black, &board, &camera).unwrap_err().contains("black"));
    }
}
