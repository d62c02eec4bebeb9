//! Discs printed on the frame around the sample: the slab's plane as the sample really lies.

use super::Pairs;
use super::blobs::{Blob, find_blobs};
use super::camera_motion::softened;
use super::drift::median;
use super::fit::{Observation, ViewFit, fit_homography, fit_view};
use crate::capture::{Camera, FrameMarks};
use crate::cholesky::solve_small;
use crate::geometry::{CameraView, Homography, Lens, Point};
use crate::radiance::Radiance;
use std::collections::BTreeSet;

/// Softness of printed edges that is tried besides the pixel's own width, scale of a logistic distribution, px.
const SOFTNESS_PX: [f64; 4] = [0.05, 0.15, 0.3, 0.5];
/// Pixels around a disc that are looked at, in its radius.
const AROUND: f64 = 1.4;
/// A disc counts when it differs from the frame by so many standard deviations.
const DISC_SIGMA: f64 = 10.0;
/// Fewer marks leave nothing to check a plane's eight numbers with.
const LEAST_MARKS: usize = 8;

/// A mark as it was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundMark {
    /// Its index in `[frame]` of the rig.
    pub index: usize,
    /// The image of the disc's centre, camera px: not the centre of its image, which perspective displaces.
    pub camera_px: Point,
}

/// The plane through the marks.
#[derive(Debug, Clone)]
pub struct FrameFit {
    /// The camera's view of it.
    pub fit: ViewFit,
    /// The marks that it goes through.
    pub marks: Vec<FoundMark>,
}

/// Registers the camera to the plane of the frame's marks, from a merged photograph under white light.
///
/// With a `prior` view (the board's) its lens is kept and marks are looked for where it expects them, and all over the
/// picture when they are not there. Without one, discs are found in the picture and told apart by their layout. Each
/// disc is then fitted as what it is, a disc in the plane, so that perspective biases no centre. Marks more than four
/// deviations off are dropped.
///
/// # Errors
/// A text that says what was not found.
///
/// Not detected: marks that are not where the rig file says, all alike (another scale, another origin); a frame above
/// or below the sample.
pub fn register_frame(
    picture: &Radiance,
    frame: &FrameMarks,
    prior: Option<&CameraView>,
    camera: &Camera,
) -> Result<FrameFit, String> {
    let near = prior.map(|view| locate(picture, frame, view)).filter(|m| 2 * m.len() > frame.marks_mm.len());
    let mut pairs = match near {
        Some(pairs) => pairs,
        None => {
            let blobs = find_blobs(picture);
            // A view that is known shows how the picture is turned.
            let turns = if prior.is_some() { &TURNS_DEG[..1] } else { &TURNS_DEG };
            let view = match_layout(&blobs, frame, camera, turns)?;
            locate(picture, frame, &view)
        }
    };
    let mut found = None;
    for _ in 0..3 {
        let fit = fit_marks(&mut pairs, frame, prior, camera)?;
        found = Some((fit, pairs.clone()));
        pairs = locate(picture, frame, &fit.view);
    }
    let (fit, pairs) = found.ok_or("no marks were fitted")?;
    if fit.rms_px > 0.5 {
        return Err(format!("the frame's marks fit no plane: RMS {:.2} px", fit.rms_px));
    }
    Ok(FrameFit { fit, marks: pairs })
}

impl FrameFit {
    /// The marks in slab coordinates and where they are seen.
    pub fn pairs(&self, frame: &FrameMarks) -> Pairs {
        self.marks.iter().map(|m| (frame.marks_mm[m.index], m.camera_px)).collect()
    }
}

/// Median displacement of the marks from one photograph to another and its standard deviation per axis, camera px;
/// `None` with fewer than four marks in both.
pub fn marks_moved(before: &FrameFit, after: &FrameFit) -> Option<(Point, f64)> {
    let both = before.marks.iter().filter_map(|a| Some((a, after.marks.iter().find(|b| b.index == a.index)?)));
    let moved: Vec<Point> = both.map(|(a, b)| [0, 1].map(|k| b.camera_px[k] - a.camera_px[k])).collect();
    if moved.len() < 4 {
        return None;
    }
    let middle = [0, 1].map(|k| median(&mut moved.iter().map(|m| m[k]).collect::<Vec<_>>()));
    let mut left: Vec<f64> = moved.iter().flat_map(|m| [0, 1].map(|k| (m[k] - middle[k]).abs())).collect();
    // The median of n values is 1.25 times less certain than their mean.
    Some((middle, (1.25 * 1.4826 * median(&mut left) / (moved.len() as f64).sqrt()).max(1e-3)))
}

fn fit_marks(
    pairs: &mut Vec<FoundMark>,
    frame: &FrameMarks,
    prior: Option<&CameraView>,
    camera: &Camera,
) -> Result<ViewFit, String> {
    for round in 0..2 {
        let all = frame.marks_mm.len();
        if pairs.len() < LEAST_MARKS || 2 * pairs.len() < all {
            return Err(format!("only {} of the frame's {all} marks were found", pairs.len()));
        }
        let points: Vec<(Point, Point)> = pairs.iter().map(|m| (frame.marks_mm[m.index], m.camera_px)).collect();
        let fit = match prior {
            Some(view) => fit_plane(&points, view.lens),
            None => fit_view(&points, camera.principal_px, camera.focal_px),
        };
        let fit = fit.ok_or("the frame's marks do not span a plane")?;
        if round == 1 {
            return Ok(fit);
        }
        let off = |m: &FoundMark| {
            let q = fit.view.camera_from_slab(frame.marks_mm[m.index]);
            (q[0] - m.camera_px[0]).hypot(q[1] - m.camera_px[1])
        };
        let mut distances: Vec<f64> = pairs.iter().map(off).collect();
        let usual = median(&mut distances).max(0.01);
        pairs.retain(|m| off(m) <= 4.0 * usual);
    }
    Err("the frame's marks do not span a plane".into())
}

/// The plane alone, through a lens that is known.
fn fit_plane(points: &[(Point, Point)], lens: Lens) -> Option<ViewFit> {
    let observations: Vec<Observation> = points
        .iter()
        .map(|&(from, to)| (from, lens.undistort(to)))
        .flat_map(|(from, to)| [0, 1].map(|axis| Observation { from, axis, to: to[axis] }))
        .collect();
    let (ideal_from_slab, _) = fit_homography(&observations)?;
    let view = CameraView { ideal_from_slab, lens };
    let square = |&(from, to): &(Point, Point)| {
        let q = view.camera_from_slab(from);
        (q[0] - to[0]).powi(2) + (q[1] - to[1]).powi(2)
    };
    let n = 2.0 * points.len() as f64;
    let rms_px = (points.iter().map(square).sum::<f64>() / n).sqrt();
    Some(ViewFit { view, rms_px, sd_px: rms_px * (8.0 / n).sqrt() })
}

/// All marks that are found near where `view` expects them.
fn locate(picture: &Radiance, frame: &FrameMarks, view: &CameraView) -> Vec<FoundMark> {
    let light = picture.luminance();
    let one = |(index, &mark): (usize, &Point)| {
        let camera_px = locate_disc(picture, &light, mark, 0.5 * frame.diameter_mm, view)?;
        Some(FoundMark { index, camera_px })
    };
    frame.marks_mm.iter().enumerate().filter_map(one).collect()
}

/// A pixel: its place on the slab, light, variance.
type Pixel = (Point, f64, f64);

/// Where the centre of a disc of the slab at `mark` with `radius` (mm) really is, camera px.
fn locate_disc(picture: &Radiance, light: &[f32], mark: Point, radius: f64, view: &CameraView) -> Option<Point> {
    let at = view.camera_from_slab(mark);
    let j = view.jacobian(mark);
    let det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
    if !(det.abs() > 1e-12) {
        return None;
    }
    let inverse = [[j[1][1] / det, -j[0][1] / det], [-j[1][0] / det, j[0][0] / det]];
    let slab_from_ideal = view.ideal_from_slab.inverse()?;
    let reach = [0, 1].map(|a| AROUND * radius * j[a][0].hypot(j[a][1]));
    let r = picture.rect;
    let (low, high) = ([0, 1].map(|a| (at[a] - reach[a]).floor()), [0, 1].map(|a| (at[a] + reach[a]).ceil()));
    let first = [r.x, r.y].map(|v| v as f64);
    let last = [r.x + r.width - 1, r.y + r.height - 1].map(|v| v as f64);
    if !(0..2).all(|a| low[a] >= first[a] && high[a] <= last[a]) {
        return None;
    }
    let mut pixels: Vec<Pixel> = Vec::new();
    for y in low[1] as usize..=high[1] as usize {
        for x in low[0] as usize..=high[0] as usize {
            let p = slab_from_ideal.map(view.lens.undistort([x as f64, y as f64]));
            let k = (y - r.y) * r.width + x - r.x;
            if (p[0] - mark[0]).hypot(p[1] - mark[1]) > AROUND * radius {
                continue;
            }
            if picture.used[3 * k..3 * k + 3].contains(&0) {
                return None;
            }
            let variance = picture.variance[3 * k..3 * k + 3].iter().map(|v| f64::from(*v)).sum::<f64>() / 9.0;
            pixels.push((p, f64::from(light[k]), variance));
        }
    }
    let settled = SOFTNESS_PX.iter().filter_map(|&soft| settle(&pixels, mark, radius, &inverse, soft));
    let (center, _) = settled.min_by(|a, b| a.1.total_cmp(&b.1))?;
    Some(view.camera_from_slab(center))
}

/// Gauss and Newton on the disc's centre (mm); height and a plane of light around it are linear. Also the mean square
/// that is left.
fn settle(
    pixels: &[Pixel],
    mark: Point,
    radius: f64,
    mm_from_px: &[[f64; 2]; 2],
    softness_px: f64,
) -> Option<(Point, f64)> {
    const TERMS: usize = 6;
    let mut center = mark;
    for _ in 0..15 {
        let (mut matrix, mut right) = ([[0.0; TERMS]; TERMS], [0.0; TERMS]);
        let (mut square, mut noise) = (0.0, 0.0);
        for (p, light, variance) in pixels {
            let d = [p[0] - center[0], p[1] - center[1]];
            let far = d[0].hypot(d[1]).max(1e-9);
            let u = d.map(|v| v / far);
            // Millimetres that the distance changes by for a pixel along its gradient.
            let mm = [0, 1].map(|a| u[0] * mm_from_px[0][a] + u[1] * mm_from_px[1][a]);
            let mm_per_px = mm[0].hypot(mm[1]);
            let inside_px = (radius - far) / mm_per_px;
            let [(a, la), (b, lb)] = [inside_px + 0.5, inside_px - 0.5].map(|x| softened(x / softness_px));
            let (cover, slope) = (softness_px * (a - b), (la - lb) / mm_per_px);
            let row = [cover, slope * u[0], slope * u[1], 1.0, d[0], d[1]];
            for i in 0..TERMS {
                (0..=i).for_each(|j| matrix[i][j] += row[i] * row[j]);
                right[i] += row[i] * light;
            }
            square += light * light;
            noise += variance;
        }
        let (x, inverse) = solve_small(matrix, right)?;
        let count = pixels.len() as f64;
        let left = (square - x.iter().zip(&right).map(|(a, b)| a * b).sum::<f64>()).max(0.0) / count;
        let variance = (noise / count).max(left);
        if !(x[0].abs() > DISC_SIGMA * (variance * inverse[0]).sqrt()) {
            return None;
        }
        let step = [x[1] / x[0], x[2] / x[0]];
        let length = step[0].hypot(step[1]);
        let limit = if length > 0.5 * radius { 0.5 * radius / length } else { 1.0 };
        center = [center[0] + limit * step[0], center[1] + limit * step[1]];
        if (center[0] - mark[0]).hypot(center[1] - mark[1]) > 1.2 * radius {
            return None;
        }
        if length < 1e-4 * radius {
            return Some((center, left));
        }
    }
    None
}

/// Turns of the picture that are tried for the first match of the marks where no board tells it, degrees: to either
/// side of upright, as slab coordinates are defined.
const TURNS_DEG: [f64; 9] = [0.0, 8.0, -8.0, 16.0, -16.0, 24.0, -24.0, 32.0, -32.0];

/// A first view from discs that nobody has numbered: their layout about upright in the picture, as slab coordinates are
/// defined. Of the turns tried the one counts that matches most marks.
fn match_layout(blobs: &[Blob], frame: &FrameMarks, camera: &Camera, turns_deg: &[f64]) -> Result<CameraView, String> {
    let all = frame.marks_mm.len();
    let few = || format!("{} discs of one size were found in the picture, but the frame has {all} marks", blobs.len());
    if blobs.len() < LEAST_MARKS || 2 * blobs.len() < all {
        return Err(few());
    }
    let seen: Vec<Point> = blobs.iter().map(|b| b.center_px).collect();
    let (marks, discs) = (Cloud::of(&frame.marks_mm), Cloud::of(&seen));
    if !(marks.spread > 0.0 && discs.spread > 0.0) {
        return Err("the frame's marks lie on a point".into());
    }
    let scale = discs.spread / marks.spread;
    let mut best: Option<(usize, Homography)> = None;
    for turn in turns_deg {
        let (sin, cos) = turn.to_radians().sin_cos();
        let about_middle = Homography::similarity(1.0, marks.middle.map(|v| -v));
        let turned = [[scale * cos, -scale * sin, 0.0], [scale * sin, scale * cos, 0.0], [0.0, 0.0, 1.0]];
        let start =
            Homography::similarity(1.0, discs.middle).after(&Homography { matrix: turned }.after(&about_middle));
        let matched = settle_layout(start, &seen, frame, scale);
        if let Some((count, view)) = matched.filter(|(count, _)| best.as_ref().is_none_or(|(most, _)| count > most)) {
            best = Some((count, view));
        }
    }
    let (_, ideal_from_slab) = best.ok_or_else(few)?;
    Ok(CameraView { ideal_from_slab, lens: Lens::ideal(camera.principal_px, camera.focal_px) })
}

/// Middle and root mean square distance from it.
struct Cloud {
    middle: Point,
    spread: f64,
}

impl Cloud {
    fn of(points: &[Point]) -> Self {
        let n = points.len() as f64;
        let middle = [0, 1].map(|a| points.iter().map(|p| p[a]).sum::<f64>() / n);
        let square = |p: &Point| (p[0] - middle[0]).powi(2) + (p[1] - middle[1]).powi(2);
        Self { middle, spread: (points.iter().map(square).sum::<f64>() / n).sqrt() }
    }
}

/// Matches each mark with the disc nearest to where the view expects it, and fits the view anew, by turns: the number
/// of discs that are some mark's, and the view. (Discs are counted, not marks: a wrong view may put all marks on a few
/// discs.)
fn settle_layout(mut view: Homography, seen: &[Point], frame: &FrameMarks, scale: f64) -> Option<(usize, Homography)> {
    const ROUNDS: usize = 6;
    let mut matched = BTreeSet::new();
    for _ in 0..ROUNDS {
        matched.clear();
        let mut observations = Vec::new();
        for &mark in &frame.marks_mm {
            let q = view.map(mark);
            let far = |d: &Point| (d[0] - q[0]).hypot(d[1] - q[1]);
            let (nearest, disc) = seen.iter().enumerate().min_by(|a, b| far(a.1).total_cmp(&far(b.1)))?;
            // Half the way to another mark at the least: discs are farther apart than they are wide.
            if far(disc) < frame.diameter_mm * scale {
                matched.insert(nearest);
                observations.extend([0, 1].map(|axis| Observation { from: mark, axis, to: disc[axis] }));
            }
        }
        (view, _) = fit_homography(&observations)?;
    }
    Some((matched.len(), view))
}

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{picture, share};
    use crate::capture::{Rect, ResponseCurve};
    use crate::geometry::Homography;

    /// Twelve marks around a sample of 30 × 20 mm, four along x and three along y, none above another's column.
    fn frame() -> FrameMarks {
        let above = [[-1.0, -4.0], [9.0, -4.5], [20.0, -4.0], [33.0, -3.5]];
        let below = [[-2.0, 24.0], [11.0, 24.5], [19.0, 24.0], [32.0, 25.0]];
        let beside = [[-5.0, 6.0], [-5.5, 15.0], [35.0, 7.0], [36.0, 16.0]];
        FrameMarks { marks_mm: [above, below, beside].concat(), diameter_mm: 2.4 }
    }

    fn camera() -> Camera {
        Camera {
            size_px: [230, 140],
            focal_px: 400.0,
            principal_px: [110.0, 65.0],
            response_curve: ResponseCurve::Linear,
            vignetting: Vec::new(),
        }
    }

    fn view() -> CameraView {
        let ideal_from_slab = Homography { matrix: [[4.6, 0.2, 40.0], [-0.15, 4.1, 28.0], [8e-4, -6e-4, 1.0]] };
        CameraView { ideal_from_slab, lens: Lens::ideal([110.0, 65.0], 400.0) }
    }

    /// Discs of the slab's plane as the camera sees them, on light that grows downwards; not those that `without`
    /// names.
    fn photograph(view: &CameraView, without: &[usize]) -> Radiance {
        part_of_photograph(Rect { x: 0, y: 0, width: 230, height: 140 }, view, without)
    }

    fn part_of_photograph(rect: Rect, view: &CameraView, without: &[usize]) -> Radiance {
        let back = view.ideal_from_slab.inverse().unwrap();
        let marks: Vec<Point> =
            frame().marks_mm.into_iter().enumerate().filter(|(k, _)| !without.contains(k)).map(|(_, m)| m).collect();
        let inside = |x: f64, y: f64| {
            let p = back.map(view.lens.undistort([x, y]));
            marks.iter().any(|m| (p[0] - m[0]).hypot(p[1] - m[1]) < 1.2)
        };
        let near = |x: f64, y: f64| {
            let p = back.map([x, y]);
            marks.iter().any(|m| (p[0] - m[0]).hypot(p[1] - m[1]) < 2.0)
        };
        let light = |x: f64, y: f64| {
            let dark = if near(x, y) { share(x, y, inside) } else { 0.0 };
            (60.0 + 0.1 * y) * (1.0 - 0.85 * dark)
        };
        picture(rect, light, 0.01)
    }

    #[test]
    fn marks_are_told_apart_by_their_layout_and_found_at_their_centres() {
        let found = register_frame(&photograph(&view(), &[6]), &frame(), None, &camera()).unwrap();
        let indices: Vec<usize> = found.marks.iter().map(|m| m.index).collect();
        assert_eq!(indices, [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11]);
        for mark in &found.marks {
            let q = view().camera_from_slab(frame().marks_mm[mark.index]);
            // Discs of eleven pixels, each of 144 places: a few thousandths of a pixel.
            assert!((mark.camera_px[0] - q[0]).hypot(mark.camera_px[1] - q[1]) < 0.02, "{mark:?} {q:?}");
        }
        let p = [12.0, 13.0];
        let (a, b) = (found.fit.view.camera_from_slab(p), view().camera_from_slab(p));
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.02 && found.fit.rms_px < 0.02, "{a:?} {b:?}");
        let pairs = found.pairs(&frame());
        assert_eq!((pairs.len(), pairs[6]), (11, (frame().marks_mm[7], found.marks[6].camera_px)));
    }

    #[test]
    fn a_known_view_finds_marks_that_have_moved_and_keeps_its_lens() {
        let prior = CameraView { lens: Lens { k1: -0.05, ..view().lens }, ..view() };
        let mut moved = prior;
        moved.ideal_from_slab = Homography::similarity(1.0, [1.7, -0.9]).after(&prior.ideal_from_slab);
        let [before, after] =
            [prior, moved].map(|v| register_frame(&photograph(&v, &[]), &frame(), Some(&prior), &camera()).unwrap());
        assert_eq!((after.marks.len(), after.fit.view.lens), (12, prior.lens));
        let (px, sd) = marks_moved(&before, &after).unwrap();
        // The lens displaces nothing in the middle of the picture, and changes a movement at its rim by some hundredths
        // of a pixel.
        assert!((px[0] - 1.7).abs() < 0.02 && (px[1] + 0.9).abs() < 0.02, "{px:?}");
        assert!(sd < 0.02, "{sd}");
    }

    #[test]
    fn too_few_marks_are_an_error() {
        let error = register_frame(&photograph(&view(), &[0, 1, 2, 3, 4]), &frame(), None, &camera()).unwrap_err();
        assert!(error.contains("7 discs"), "{error}");
        let error =
            register_frame(&photograph(&view(), &[0, 1, 2, 3, 4]), &frame(), Some(&view()), &camera()).unwrap_err();
        assert!(error.contains("only 7 of the frame's 12 marks"), "{error}");
    }

    fn fitted(moved: &[(usize, Point)]) -> FrameFit {
        let marks = moved.iter().map(|&(index, camera_px)| FoundMark { index, camera_px }).collect();
        FrameFit { fit: ViewFit { view: view(), rms_px: 0.0, sd_px: 0.0 }, marks }
    }

    #[test]
    fn the_movement_of_marks_is_their_median_and_its_deviation_that_of_what_is_left() {
        let places: Vec<(usize, Point)> = (0..6).map(|k| (k, [10.0 * k as f64, 3.0 * (k * k) as f64])).collect();
        let off = [[0.3, -0.5], [0.34, -0.48], [0.29, -0.55], [9.0, 9.0], [0.26, -0.5]];
        // The second photograph has them in another order, without the last, and with one that the first has not.
        let mut after: Vec<(usize, Point)> =
            (0..5).map(|k| (k, [places[k].1[0] + off[k][0], places[k].1[1] + off[k][1]])).rev().collect();
        after.push((8, [1.0, 1.0]));
        let (px, sd) = marks_moved(&fitted(&places), &fitted(&after)).unwrap();
        assert!((px[0] - 0.3).abs() < 1e-12 && (px[1] + 0.5).abs() < 1e-12, "{px:?}");
        // Left along x: 0, 0.04, 0.01, 8.7, 0.04; along y 0, 0.02, 0.05, 9.5, 0: the median of ten is 0.03.
        assert!((sd - 1.25 * 1.4826 * 0.03 / 5f64.sqrt()).abs() < 1e-12, "{sd}");
        assert_eq!(marks_moved(&fitted(&places[..3]), &fitted(&after)), None);
        // Marks that agree are still not known better than a thousandth of a pixel.
        assert_eq!(marks_moved(&fitted(&places), &fitted(&places)), Some(([0.0, 0.0], 1e-3)));
    }

    #[test]
    fn a_plane_through_a_known_lens_is_fitted_with_eight_numbers() {
        let lens = Lens { k1: -0.1, ..view().lens };
        let truth = CameraView { lens, ..view() };
        let pair = |k: usize, off: f64| {
            let p = frame().marks_mm[k];
            let q = truth.camera_from_slab(p);
            (p, [q[0] + off * [1.0, -1.0][k % 2], q[1]])
        };
        let exact: Vec<_> = (0..12).map(|k| pair(k, 0.0)).collect();
        let fit = fit_plane(&exact, lens).unwrap();
        assert!(fit.rms_px < 1e-9 && fit.view.lens == lens, "{fit:?}");
        let noisy: Vec<_> = (0..12).map(|k| pair(k, 0.1)).collect();
        let fit = fit_plane(&noisy, lens).unwrap();
        let square: f64 = noisy
            .iter()
            .map(|(p, q)| {
                let seen = fit.view.camera_from_slab(*p);
                (seen[0] - q[0]).powi(2) + (seen[1] - q[1]).powi(2)
            })
            .sum();
        // 24 coordinates, eight of which the plane takes.
        assert!((fit.rms_px - (square / 24.0).sqrt()).abs() < 1e-12);
        assert!((fit.sd_px - fit.rms_px / 3f64.sqrt()).abs() < 1e-12);
    }

    #[test]
    fn a_picture_that_does_not_begin_at_the_corner_shows_the_marks_at_the_same_places() {
        let part = Rect { x: 9, y: 1, width: 210, height: 136 };
        let [whole, part] = [photograph(&view(), &[]), part_of_photograph(part, &view(), &[])];
        for prior in [Some(view()), None] {
            let [a, b] = [&whole, &part].map(|p| register_frame(p, &frame(), prior.as_ref(), &camera()).unwrap());
            assert_eq!((a.marks.len(), b.marks.len()), (12, 12));
            for (a, b) in a.marks.iter().zip(&b.marks) {
                assert_eq!(a.index, b.index);
                // The same pixels; without a prior the first view is another in its last digits, and so is where the
                // search ends.
                let off = (a.camera_px[0] - b.camera_px[0]).hypot(a.camera_px[1] - b.camera_px[1]);
                assert!(off < 1e-4, "{a:?} {b:?}");
            }
        }
    }

    #[test]
    fn a_mark_at_the_rim_of_the_picture_is_not_used() {
        // The disc's middle is at (17.9, 88.6), 1.4 radii are 7.7 px along x: a picture from x = 11 on cuts its
        // surroundings.
        let at = view().camera_from_slab(frame().marks_mm[9]);
        assert!((at[0] - 17.9).abs() < 0.2, "{at:?}");
        for (x, found) in [(9, true), (11, false)] {
            let part = part_of_photograph(Rect { x, y: 0, width: 230 - x, height: 140 }, &view(), &[]);
            let marks = register_frame(&part, &frame(), Some(&view()), &camera()).unwrap().marks;
            assert_eq!(marks.iter().any(|m| m.index == 9), found, "{x}");
        }
    }

    #[test]
    fn a_mark_that_is_not_where_the_rig_says_is_left_out() {
        let mut wrong = frame();
        wrong.marks_mm[3] = [33.5, -3.2];
        let found = register_frame(&photograph(&view(), &[]), &wrong, Some(&view()), &camera()).unwrap();
        let indices: Vec<usize> = found.marks.iter().map(|m| m.index).collect();
        assert_eq!(indices, [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11]);
        let p = [12.0, 13.0];
        let (a, b) = (found.fit.view.camera_from_slab(p), view().camera_from_slab(p));
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.02 && found.fit.rms_px < 0.02, "{a:?} {b:?}");
    }

    #[test]
    fn marks_are_dropped_beyond_four_usual_distances() {
        let lens = Some(view());
        let seen = |off: &dyn Fn(usize) -> Point| -> Vec<FoundMark> {
            let at = |k: usize| view().camera_from_slab(frame().marks_mm[k]);
            (0..12)
                .map(|k| (k, at(k), off(k)))
                .map(|(index, q, o)| FoundMark { index, camera_px: [q[0] + o[0], q[1] + o[1]] })
                .collect()
        };
        // Alternating tenths of a pixel, and what one mark is off by besides.
        for far in [0.0, 0.4, 0.8, 1.6, 3.2] {
            let off = |k: usize| [[0.1, -0.1][k % 2] + if k == 7 { far } else { 0.0 }, [0.06, 0.02, -0.08][k % 3]];
            let mut pairs = seen(&off);
            let points: Vec<(Point, Point)> = pairs.iter().map(|m| (frame().marks_mm[m.index], m.camera_px)).collect();
            let first = fit_plane(&points, view().lens).unwrap();
            let mut distances: Vec<f64> = points
                .iter()
                .map(|(p, q)| {
                    let at = first.view.camera_from_slab(*p);
                    (at[0] - q[0]).hypot(at[1] - q[1])
                })
                .collect();
            let kept: Vec<usize> = {
                let mut sorted = distances.clone();
                sorted.sort_by(f64::total_cmp);
                let usual = 0.5 * (sorted[5] + sorted[6]);
                (0..12).filter(|&k| distances[k] <= 4.0 * usual).collect()
            };
            let fit = fit_marks(&mut pairs, &frame(), lens.as_ref(), &camera()).unwrap();
            assert_eq!(pairs.iter().map(|m| m.index).collect::<Vec<_>>(), kept, "{far}");
            assert_eq!(kept.contains(&7), far < 1.0, "{far}: {distances:?}");
            distances.clear();
            // The plane is that of the marks that were kept.
            let points: Vec<_> = kept.iter().map(|&k| points[k]).collect();
            assert!((fit.rms_px - fit_plane(&points, view().lens).unwrap().rms_px).abs() < 1e-12);
        }
    }
}
