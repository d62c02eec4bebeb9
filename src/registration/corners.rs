//! The corners of a chessboard in a picture, by OpenCV: all that needs it.

use crate::geometry::Point;

/// Inner corners, row after row, from either end of the board; none when no whole board is seen. `picture` is linear, 0
/// to 255.
///
/// # Errors
/// OpenCV's own.
#[cfg(feature = "opencv")]
pub(super) fn find_corners(picture: &[f32], height: usize, inner: [usize; 2]) -> Result<Vec<Point>, String> {
    use opencv::{calib3d, core, imgproc, prelude::*};
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
        let grey = core::Mat::from_slice(picture)?;
        let grey = grey.reshape(1, height as i32)?;
        let points: Vec<_> = corners.iter().collect();
        let nearest = points.windows(2).map(|p| (p[0].x - p[1].x).hypot(p[0].y - p[1].y)).fold(f32::MAX, f32::min);
        let half = (0.35 * nearest).clamp(2.0, 15.0) as i32;
        let stop = core::TermCriteria::new(core::TermCriteria_COUNT | core::TermCriteria_EPS, 100, 1e-4)?;
        imgproc::corner_sub_pix(&grey, &mut corners, core::Size::new(half, half), core::Size::new(-1, -1), stop)?;
        Ok(corners.iter().map(|c| [f64::from(c.x), f64::from(c.y)]).collect())
    };
    find().map_err(|e| format!("OpenCV: {}", e.message))
}

/// Without OpenCV no corner is found.
///
/// # Errors
/// Always.
#[cfg(not(feature = "opencv"))]
pub(super) fn find_corners(_: &[f32], _: usize, _: [usize; 2]) -> Result<Vec<Point>, String> {
    Err("a board is found by OpenCV, and this program was built without it (feature `opencv`)".into())
}
