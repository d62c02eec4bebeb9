//! The corners of a chessboard in a picture, by OpenCV: all that needs it.

use crate::geometry::Point;

/// Inner corners to a pixel or so, row after row, from either end of the board; none when no whole board is seen.
/// `picture` is linear, 0 to 255.
///
/// # Errors
/// OpenCV's own.
#[cfg(feature = "opencv")]
pub(super) fn find_corners(picture: &[f32], height: usize, inner: [usize; 2]) -> Result<Vec<Point>, String> {
    use opencv::{calib3d, core, prelude::*};
    let pattern = core::Size::new(inner[0] as i32, inner[1] as i32);
    let find = || -> opencv::Result<Vec<Point>> {
        let bytes: Vec<u8> = picture.iter().map(|v| v.round() as u8).collect();
        let grey8 = core::Mat::from_slice(&bytes)?;
        let grey8 = grey8.reshape(1, height as i32)?;
        let mut corners = core::Vector::<core::Point2f>::new();
        let flags = calib3d::CALIB_CB_ADAPTIVE_THRESH | calib3d::CALIB_CB_NORMALIZE_IMAGE;
        // The first needs a light margin around the squares; the second, by sectors (Duda & Frese 2018), takes longer
        // and needs none.
        let by_sectors = calib3d::CALIB_CB_NORMALIZE_IMAGE | calib3d::CALIB_CB_EXHAUSTIVE;
        if !calib3d::find_chessboard_corners(&grey8, pattern, &mut corners, flags)?
            && !calib3d::find_chessboard_corners_sb(&grey8, pattern, &mut corners, by_sectors)?
        {
            return Ok(Vec::new());
        }
        Ok(corners.iter().map(|c| [f64::from(c.x), f64::from(c.y)]).collect())
    };
    find().map_err(|e| format!("OpenCV: {}", e.message))
}

/// The same corners to a fraction of a pixel, each looked for around where it is given (`cornerSubPix`).
///
/// # Errors
/// OpenCV's own.
#[cfg(feature = "opencv")]
pub(super) fn refine_corners(picture: &[f32], height: usize, corners: &[Point]) -> Result<Vec<Point>, String> {
    use opencv::{core, imgproc, prelude::*};
    let refine = || -> opencv::Result<Vec<Point>> {
        let grey = core::Mat::from_slice(picture)?;
        let grey = grey.reshape(1, height as i32)?;
        let nearest = corners.windows(2).map(|p| (p[0][0] - p[1][0]).hypot(p[0][1] - p[1][1])).fold(f64::MAX, f64::min);
        let half = (0.35 * nearest).clamp(2.0, 15.0) as i32;
        let stop = core::TermCriteria::new(core::TermCriteria_COUNT | core::TermCriteria_EPS, 100, 1e-4)?;
        let mut found: core::Vector<core::Point2f> =
            corners.iter().map(|c| core::Point2f::new(c[0] as f32, c[1] as f32)).collect();
        imgproc::corner_sub_pix(&grey, &mut found, core::Size::new(half, half), core::Size::new(-1, -1), stop)?;
        Ok(found.iter().map(|c| [f64::from(c.x), f64::from(c.y)]).collect())
    };
    refine().map_err(|e| format!("OpenCV: {}", e.message))
}

/// Without OpenCV none is refined.
///
/// # Errors
/// Never.
#[cfg(not(feature = "opencv"))]
pub(super) fn refine_corners(_: &[f32], _: usize, corners: &[Point]) -> Result<Vec<Point>, String> {
    Ok(corners.to_vec())
}

/// Without OpenCV no corner is found.
///
/// # Errors
/// Always.
#[cfg(not(feature = "opencv"))]
pub(super) fn find_corners(_: &[f32], _: usize, _: [usize; 2]) -> Result<Vec<Point>, String> {
    Err("a board is found by OpenCV, and this program was built without it (feature `opencv`)".into())
}
