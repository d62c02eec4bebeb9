//! The chessboard in the slab's plane: where the camera sees the slab.

use super::Pairs;
use super::corners::{find_corners, refine_corners};
use super::drift::{median, scaled_deviation};
use super::fit::{Observation, ViewFit, fit_view};
use super::projector_fit::plane_of_most;
use crate::capture::{Board, Camera};
use crate::geometry::{CameraView, Lens, Point};
use crate::radiance::Radiance;

/// Finds a board in a merged photograph: its corners in slab coordinates, were it in the slab's plane, and where they
/// are seen.
///
/// Corners by OpenCV (`findChessboardCorners`, then `cornerSubPix` on the linear picture). Of small or blurred squares
/// some are found in wrong places, mostly at the rim. So the model of a flat board seen through a lens is fitted to most
/// corners, and every corner is located again from where the model puts it. Corners that are still far from the model are
/// left out, up to a tenth of all. The corner nearest the picture's top left is taken for corner (0, 0). The whole board must be in the picture.
///
/// # Errors
/// A text that says what was not found; corners of which more than a tenth fit no flat board through any lens; every
/// board, without the feature `opencv`.
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
    let height = picture.rect.height;
    let corners = find_corners(&scaled, height, board.inner_corners)?;
    if corners.len() != nx * ny {
        return Err(format!("no chessboard with {nx} × {ny} inner corners was found"));
    }
    let corners = refine_corners(&scaled, height, &corners)?;
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
    let spanned = |fit: Option<ViewFit>| fit.ok_or("the board's corners do not span a plane");
    let view = spanned(fit_most(&pairs, camera))?.view;
    let expected: Vec<Point> = pairs.iter().map(|p| view.camera_from_slab(p.0)).collect();
    let again = refine_corners(&scaled, height, &expected)?;
    let pairs: Pairs = pairs.iter().zip(again).map(|(p, seen)| (p.0, seen)).collect();
    let fit = spanned(fit_most(&pairs, camera))?;
    let kept = near(&pairs, &fit.view);
    let (off, all) = (pairs.len() - kept.len(), pairs.len());
    if off as f64 > MOST_LEFT_OUT * all as f64 {
        return Err(format!("{off} of the board's {all} corners are not where a flat board has them"));
    }
    // What is left of detection is far below a pixel.
    if fit.rms_px > 1.0 {
        return Err(format!("the board's corners fit no flat board: RMS {:.2} px", fit.rms_px));
    }
    Ok(kept)
}

/// Corners are mistaken when they are farther off the board than so many of their robust deviations.
const FAR_SIGMA: f64 = 4.5;
/// And than this share of a square's side: what a lens has beyond the model's terms moves them by less.
const FAR_SQUARES: f64 = 0.05;
/// More mistaken corners than this share are not those of a board.
const MOST_LEFT_OUT: f64 = 0.1;
/// Rounds in which the board and the corners that belong to it settle on each other.
const ROUNDS: usize = 4;

/// The board that most corners agree with. `None` for a degenerate layout.
fn fit_most(pairs: &Pairs, camera: &Camera) -> Option<ViewFit> {
    let observed = pairs.iter().flat_map(|&(from, to)| [0, 1].map(|axis| Observation { from, axis, to: to[axis] }));
    let plane = plane_of_most(&observed.collect::<Vec<_>>())?;
    let mut view = CameraView { ideal_from_slab: plane, lens: Lens::ideal(camera.principal_px, camera.focal_px) };
    let mut found = None;
    for _ in 0..ROUNDS {
        let fit = fit_view(&near(pairs, &view), camera.principal_px, camera.focal_px)?;
        view = fit.view;
        found = Some(fit);
    }
    found
}

/// The corners that are not far off a board.
fn near(pairs: &Pairs, view: &CameraView) -> Pairs {
    let off = |&(mm, px): &(Point, Point)| {
        let at = view.camera_from_slab(mm);
        (at[0] - px[0]).hypot(at[1] - px[1])
    };
    let side = |pair: &[(Point, Point)]| {
        let [a, b] = [pair[0].1, pair[1].1];
        (a[0] - b[0]).hypot(a[1] - b[1])
    };
    let square_px = median(&mut pairs.windows(2).map(side).collect::<Vec<_>>());
    let most = (FAR_SIGMA * scaled_deviation(pairs.iter().map(off), 0.0)).max(FAR_SQUARES * square_px);
    pairs.iter().copied().filter(|pair| off(pair) <= most).collect()
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

    /// What OpenCV does to small blurred squares: some corners, mostly of the rim, beside their places.
    #[test]
    fn corners_beside_their_places_do_not_bend_the_board() {
        let camera = Camera {
            size_px: [270, 220],
            focal_px: 410.0,
            principal_px: [133.0, 109.0],
            response_curve: crate::capture::ResponseCurve::Linear,
            vignetting: Vec::new(),
        };
        let lens = Lens { k1: -0.05, ..Lens::ideal([134.3, 108.1], 409.0) };
        let matrix = [[8.13, -1.65, 77.7], [1.96, 8.09, 45.0], [1.4e-3, 1.5e-3, 1.0]];
        let view = CameraView { ideal_from_slab: crate::geometry::Homography { matrix }, lens };
        let at = |k: usize| [-1.2 + 1.236 * (k % 18) as f64, -2.0 + 1.236 * (k / 18) as f64];
        let noise = |k: usize| 0.02 * ((k * 7919 % 1000) as f64 / 500.0 - 1.0);
        let seen = |k: usize| {
            let q = view.camera_from_slab(at(k));
            (at(k), [q[0] + noise(k), q[1] + noise(k + 501)])
        };
        let mut pairs: Pairs = (0..234).map(seen).collect();
        for (k, by) in [(0, [1.3, 1.7]), (17, [7.0, -5.4]), (34, [0.0, 2.4]), (35, [-2.8, 0.9]), (216, [-1.2, 1.0])] {
            pairs[k].1 = [pairs[k].1[0] + by[0], pairs[k].1[1] + by[1]];
        }
        let fit = fit_most(&pairs, &camera).unwrap();
        assert_eq!(near(&pairs, &fit.view).len(), 229);
        for k in [0, 17, 35, 117, 233] {
            let (found, truth) = (fit.view.camera_from_slab(at(k)), view.camera_from_slab(at(k)));
            // Noise of 0.012 px per axis; in a corner of the board the lens's terms are told to a few times that.
            assert!((found[0] - truth[0]).hypot(found[1] - truth[1]) < 0.04, "{k}: {found:?} {truth:?}");
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
