//! Gray-code stripes on the white reference, or on the frame around the sample: where each projector pixel lands on the slab's plane.

use super::board::percentile;
use super::fit::{Observation, fit_homography};
use super::projector_fit::{ProjectorFit, fit_projector};
use crate::geometry::{CameraView, Homography, Lens, Point};

/// One bit of the code on one axis: the pattern and its inverse, one light value a pixel.
#[derive(Debug, Clone)]
pub struct BitPair {
    /// 0 for projector columns, 1 for rows.
    pub axis: usize,
    /// Bit number.
    pub bit: u32,
    /// Light under the pattern.
    pub pattern: Vec<f32>,
    /// Light under its inverse.
    pub inverse: Vec<f32>,
    /// Whether both were measured: no exposure of either left the pixel saturated or without a value.
    pub valid: Vec<bool>,
}

/// What the stripes were projected on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StripeSurface {
    /// A white reference all over.
    White,
    /// The frame around a sample of this size, mm: only what lies outside the sample is used, which blurs the stripes.
    Frame(Point),
}

/// A pixel is lit when pattern and inverse together reach this share of the bright ones.
const LIT_SHARE: f32 = 0.1;
/// An edge counts when the light's contrast on its two sides differs by more than half of the possible.
const EDGE_CONTRAST: f32 = 1.0;
/// At most this many pixels are decoded for the first estimate.
const DECODED_PIXELS: usize = 20_000;

struct Contrast {
    axis: usize,
    bit: u32,
    /// (P − P̄)/(P + P̄), `None` where unlit.
    value: Vec<Option<f32>>,
}

/// Pixels nearer to the sample's rim than this are not on the frame alone, px.
const RIM_PX: f64 = 4.0;
/// On each side of the sample at least this share of the decoded pixels must lie: beyond them the map is an extrapolation.
const LEAST_SIDE_SHARE: f64 = 0.05;

/// Fits the map slab → projector to the places where stripes begin and end.
///
/// First each pixel's code gives its projector coordinate to a stripe, where every bit is clear; then every edge between light and dark,
/// located to a fraction of a pixel by the area under the contrast, gives one exact coordinate. Edges more than three deviations off
/// are dropped once. A pixel takes part when both photographs measured it, when it is lit, and when it is not on the sample
/// (`surface`). `lens` has the projector's centre and unit of length: a radial distortion is fitted when the edges ask for it.
///
/// # Errors
/// A text that says what was not found.
///
/// Not detected: a frame that is not in the sample's plane; distortion of the projector that is not radial.
pub fn register_projector(
    pairs: &[BitPair],
    size_px: [usize; 2],
    view: &CameraView,
    surface: StripeSurface,
    lens: Lens,
) -> Result<ProjectorFit, String> {
    let [width, height] = size_px;
    let ideal = view.ideal_from_slab.inverse().ok_or("the camera's view of the slab cannot be inverted")?;
    let slab = |q: Point| ideal.map(view.lens.undistort(q));
    let usable = usable_pixels(view, size_px, surface, &slab);
    let contrasts: Vec<Contrast> = pairs.iter().map(|p| contrast(p, usable.as_deref())).collect();
    let coarse = decode_pixels(&contrasts, width, height, &slab)?;
    if let StripeSurface::Frame(size_mm) = surface {
        check_sides(&coarse, size_mm)?;
    }
    let (coarse_map, _) =
        fit_homography(&coarse).ok_or("the Gray code was decoded in too few pixels to span a plane")?;

    let across = across_stripes(&coarse_map, size_px, &slab);
    let mut edges = Vec::new();
    for contrast in &contrasts {
        for q in find_edges(contrast, size_px, across[contrast.axis]) {
            let from = slab(q);
            let coarse = coarse_map.map(from)[contrast.axis];
            if let Some(to) = nearest_edge(coarse, contrast.bit) {
                edges.push(Observation { from, axis: contrast.axis, to });
            }
        }
    }
    let fit = fit_projector(edges, lens).ok_or("too few stripe edges were found")?;
    if fit.rms_px > 1.0 {
        return Err(format!("the stripes fit no plane: RMS {:.2} projector px", fit.rms_px));
    }
    Ok(fit)
}

/// Which pixels may be used; `None` for all.
fn usable_pixels(
    view: &CameraView,
    [width, height]: [usize; 2],
    surface: StripeSurface,
    slab: &dyn Fn(Point) -> Point,
) -> Option<Vec<bool>> {
    let StripeSurface::Frame(size) = surface else { return None };
    let rim = RIM_PX / view.px_per_mm(size.map(|s| 0.5 * s));
    let outside = |k: usize| {
        let p = slab([(k % width) as f64, (k / width) as f64]);
        (0..2).any(|a| p[a] < -rim || p[a] > size[a] + rim)
    };
    Some((0..width * height).map(outside).collect())
}

/// A frame that is seen on one side only says nothing about the other.
fn check_sides(decoded: &[Observation], size_mm: Point) -> Result<(), String> {
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

fn contrast(pair: &BitPair, usable: Option<&[bool]>) -> Contrast {
    let allowed = |k: usize| pair.valid[k] && usable.is_none_or(|u| u[k]);
    let sum: Vec<f32> = pair.pattern.iter().zip(&pair.inverse).map(|(a, b)| a + b).collect();
    let seen: Vec<f32> = sum.iter().enumerate().filter(|(k, _)| allowed(*k)).map(|(_, s)| *s).collect();
    let least = LIT_SHARE * percentile(&seen, 0.9);
    let lit = |k: usize| allowed(k) && sum[k] > least && sum[k] > 0.0;
    let share = |k: usize| (pair.pattern[k] - pair.inverse[k]) / sum[k];
    let value = (0..sum.len()).map(|k| lit(k).then(|| share(k))).collect();
    Contrast { axis: pair.axis, bit: pair.bit, value }
}

/// The projector coordinate of each pixel (of a subset) as the middle of the finest stripe that its bits tell.
fn decode_pixels(
    contrasts: &[Contrast],
    width: usize,
    height: usize,
    slab: &dyn Fn(Point) -> Point,
) -> Result<Vec<Observation>, String> {
    let step = (width * height / DECODED_PIXELS).max(1);
    let mut out = Vec::new();
    for axis in 0..2 {
        let mut bits: Vec<&Contrast> = contrasts.iter().filter(|c| c.axis == axis).collect();
        bits.sort_by_key(|c| std::cmp::Reverse(c.bit));
        let Some(finest) = bits.last().map(|c| c.bit) else {
            return Err(format!("no Gray-code shots for the projector's {} axis", ["x", "y"][axis]));
        };
        if bits.windows(2).any(|p| p[0].bit != p[1].bit + 1) {
            return Err("the Gray code's bits must follow each other without a gap".into());
        }
        for k in (0..width * height).step_by(step) {
            // A pixel on a stripe's edge may read either way: only clear ones count here.
            let mut code = Some(0u32);
            for c in &bits {
                let clear = c.value[k].filter(|v| v.abs() > 0.5);
                code = code.zip(clear).map(|(n, v)| (n << 1) | ((n & 1) ^ u32::from(v > 0.0)));
            }
            let Some(n) = code else { continue };
            let from = slab([(k % width) as f64, (k / width) as f64]);
            let side = f64::from(1u32 << finest);
            out.push(Observation { from, axis, to: (f64::from(n) + 0.5) * side - 0.5 });
        }
    }
    Ok(out)
}

/// Edges of bit j lie between projector pixels m − 1 and m, m an odd multiple of 2^j; `None` when the nearest is not clear.
fn nearest_edge(coordinate: f64, bit: u32) -> Option<f64> {
    let side = f64::from(1u32 << bit);
    let m = 2.0 * (((coordinate + 0.5) / side - 1.0) / 2.0).round() + 1.0;
    let edge = m * side - 0.5;
    // Edges are 2·side apart; the first estimate is good to half a finest stripe.
    ((coordinate - edge).abs() < 0.5 * side).then_some(edge)
}

/// Whether the stripes of each projector axis are crossed along the picture's rows (0) or columns (1): the direction nearer to right angles.
///
/// Along the other an edge is seen aslant, its blur longer than the plateaus between which [`find_edges`] looks for it: at 25 degrees that
/// pulled edges by 1.75 projector px RMS. Decided in the middle of the picture: at 45 degrees both do.
fn across_stripes(coarse_map: &Homography, size_px: [usize; 2], slab: &dyn Fn(Point) -> Point) -> [usize; 2] {
    let middle = size_px.map(|s| 0.5 * s as f64);
    let at = |q: Point| coarse_map.map(slab(q));
    let (here, right, below) = (at(middle), at([middle[0] + 1.0, middle[1]]), at([middle[0], middle[1] + 1.0]));
    [0, 1].map(|axis| usize::from((below[axis] - here[axis]).abs() > (right[axis] - here[axis]).abs()))
}

/// Camera positions of a bit's edges along picture rows (`along` 0) or columns (1).
///
/// Between plateaus p and q two pixels before and three after a change of sign, the edge lies where the area under the contrast
/// says: exact for a sharp edge seen through any symmetric blur narrower than that.
fn find_edges(contrast: &Contrast, [width, height]: [usize; 2], along: usize) -> Vec<Point> {
    let mut edges = Vec::new();
    let (lines, length, step, line_step) =
        if along == 0 { (height, width, 1, width) } else { (width, height, width, 1) };
    for line in 0..lines {
        let at = |k: usize| contrast.value[line * line_step + k * step];
        for k in 2..length.saturating_sub(3) {
            let (Some(a), Some(b)) = (at(k), at(k + 1)) else { continue };
            if (a > 0.0) == (b > 0.0) {
                continue;
            }
            let (Some(p), Some(q)) = (at(k - 2), at(k + 3)) else { continue };
            let inner = (k - 1..=k + 2).map(at).sum::<Option<f32>>();
            let Some(sum) = inner else { continue };
            if (p - q).abs() < EDGE_CONTRAST || (p > 0.0) != (a > 0.0) || (q > 0.0) != (b > 0.0) {
                continue;
            }
            let share = (sum - 4.0 * q) / (p - q);
            let place = k as f64 - 1.5 + f64::from(share);
            edges.push(if along == 0 { [place, line as f64] } else { [line as f64, place] });
        }
    }
    edges
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_of_a_bit_are_where_its_gray_code_changes() {
        for bit in 0..4u32 {
            let code = |n: u32| ((n ^ (n >> 1)) >> bit) & 1;
            for m in 1..64u32 {
                let changes = code(m) != code(m - 1);
                let found = nearest_edge(f64::from(m) - 0.5, bit) == Some(f64::from(m) - 0.5);
                assert_eq!(changes, found, "bit {bit} at {m}");
            }
        }
    }

    use super::super::pictures::jitter;
    use crate::geometry::Homography;

    const SIZE: [usize; 2] = [130, 96];
    /// Slab mm to ideal projector px, 48 × 40 of which fall into the picture.
    const PROJECTOR: Homography = Homography { matrix: [[2.0, 0.1, 3.0], [-0.15, 1.7, 4.0], [1e-3, -2e-3, 1.0]] };

    fn view() -> CameraView {
        let ideal_from_slab = Homography { matrix: [[5.0, -0.2, 3.0], [0.3, 4.4, 2.0], [0.0, 0.0, 1.0]] };
        CameraView { ideal_from_slab, lens: Lens::ideal([65.0, 48.0], 300.0) }
    }

    /// What a pixel sees of bit `bit` of the code, averaged over 6 × 6 places in it.
    fn pair(axis: usize, bit: u32) -> BitPair {
        let back = view().ideal_from_slab.inverse().unwrap();
        let place = |k: usize| (k as f64 + 0.5) / 6.0 - 0.5;
        let lit = |k: usize| {
            let (x, y) = ((k % SIZE[0]) as f64, (k / SIZE[0]) as f64);
            let on = (0..36)
                .filter(|s| {
                    let q = PROJECTOR.map(back.map([x + place(s % 6), y + place(s / 6)]));
                    // The centre of projector pixel n is n.
                    let n = (q[axis] + 0.5).floor().max(0.0) as u32;
                    ((n ^ (n >> 1)) >> bit) & 1 == 1
                })
                .count();
            on as f32 / 36.0
        };
        let share: Vec<f32> = (0..SIZE[0] * SIZE[1]).map(lit).collect();
        // Light that falls off to the lower right, of which a tenth is there without the projector.
        let light = |k: usize, s: f32| (0.1 + s) * (900.0 - 3.0 * (k % SIZE[0]) as f32 - 2.0 * (k / SIZE[0]) as f32);
        BitPair {
            axis,
            bit,
            pattern: share.iter().enumerate().map(|(k, s)| light(k, *s)).collect(),
            inverse: share.iter().enumerate().map(|(k, s)| light(k, 1.0 - s)).collect(),
            valid: vec![true; share.len()],
        }
    }

    fn code() -> Vec<BitPair> {
        (0..2).flat_map(|axis| (2..6).map(move |bit| pair(axis, bit))).collect()
    }

    #[test]
    fn the_projector_is_registered_by_where_its_stripes_end() {
        let ideal = Lens::ideal([23.5, 19.5], 60.0);
        let fit = register_projector(&code(), SIZE, &view(), StripeSurface::White, ideal).unwrap();
        for p in [[2.0, 1.0], [13.0, 9.0], [22.0, 17.0], [4.0, 18.0]] {
            let (a, b) = (fit.slab_from_projector.projector_from_slab(p), PROJECTOR.map(p));
            // Edges of 36 places a pixel of half a projector pixel: a hundredth each, and hundreds of them.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.01, "{a:?} {b:?}");
        }
        assert!(fit.rms_px < 0.03 && fit.edges > 500, "{fit:?}");
        // Without one axis, or a bit, it cannot be told.
        let only = |keep: &dyn Fn(&BitPair) -> bool| {
            let some: Vec<BitPair> = code().into_iter().filter(keep).collect();
            register_projector(&some, SIZE, &view(), StripeSurface::White, ideal).unwrap_err()
        };
        assert!(only(&|p| p.axis == 0).contains("y axis") && only(&|p| p.axis == 1).contains("x axis"));
        assert!(only(&|p| p.bit != 3).contains("gap"));
    }

    #[test]
    fn pixels_are_decoded_to_the_middle_of_their_finest_stripe() {
        let contrasts: Vec<Contrast> = code().iter().map(|p| contrast(p, None)).collect();
        let back = view().ideal_from_slab.inverse().unwrap();
        let decoded = decode_pixels(&contrasts, SIZE[0], SIZE[1], &|q| back.map(q)).unwrap();
        assert!(decoded.iter().filter(|o| o.axis == 1).count() > 8000);
        for o in &decoded {
            let at = PROJECTOR.map(o.from)[o.axis];
            if at < -0.5 {
                continue; // beyond the projector's picture
            }
            // Stripes of the finest bit are four projector px wide, from 4 m − 0.5 on.
            let middle = ((at + 0.5) / 4.0).floor() * 4.0 + 1.5;
            assert!(
                (o.to - middle).abs() < 1e-9 || (at + 0.5 - 4.0 * ((at + 0.5) / 4.0).round()).abs() < 0.4,
                "{o:?} {at}"
            );
        }
    }

    #[test]
    fn an_edge_is_where_the_area_under_the_contrast_says() {
        // Contrast along a line of a mean over a pixel of a step from 0.9 to −0.8 at 9.3, and the same down a column.
        let step = |at: f64, k: usize| {
            let before = (at - (k as f64 - 0.5)).clamp(0.0, 1.0);
            Some((0.9 * before - 0.8 * (1.0 - before)) as f32)
        };
        let (width, height) = (17, 11);
        let along = |axis: usize, at: f64| {
            let value = (0..width * height).map(|k| step(at, [k % width, k / width][axis])).collect();
            find_edges(&Contrast { axis: 0, bit: 0, value }, [width, height], axis)
        };
        for (axis, lines, at) in [(0, 11, 9.3), (1, 17, 5.75), (0, 11, 2.6)] {
            let edges = along(axis, at);
            assert_eq!(edges.len(), lines);
            for (line, point) in edges.iter().enumerate() {
                assert_eq!(point[1 - axis], line as f64);
                // f32 sums of four numbers of order 1.
                assert!((point[axis] - at).abs() < 1e-5, "{point:?} {at}");
            }
        }
        // Two pixels before the change and three after it must be there.
        assert_eq!(
            (along(0, 1.4).len(), along(0, 2.6).len(), along(0, 13.4).len(), along(0, 14.6).len()),
            (0, 11, 11, 0)
        );
        // A contrast of 1 is half of what is possible; less is no edge.
        let weak = |high: f32, low: f32| {
            let value = (0..width * height).map(|k| Some(if k % width < 8 { high } else { low })).collect();
            find_edges(&Contrast { axis: 0, bit: 0, value }, [width, height], 0).len()
        };
        assert_eq!((weak(0.6, -0.45), weak(0.5, -0.45), weak(-0.6, 0.45)), (11, 0, 11));
        let mut value: Vec<Option<f32>> = (0..width).map(|k| step(9.3, k)).collect();
        value[11] = None;
        assert_eq!(find_edges(&Contrast { axis: 0, bit: 0, value }, [width, 1], 0).len(), 0);
    }

    #[test]
    fn contrast_is_the_difference_over_the_sum_where_there_is_light() {
        let n = 40;
        // Light from 10 to 49 of which a share of −1 to 1 is the pattern's; the last is dark, the one before it not valid.
        let sum = |k: usize| if k == 39 { 0.5 } else { 10.0 + k as f32 };
        let share = |k: usize| jitter(k) as f32;
        let pair = BitPair {
            axis: 1,
            bit: 3,
            pattern: (0..n).map(|k| 0.5 * sum(k) * (1.0 + share(k))).collect(),
            inverse: (0..n).map(|k| 0.5 * sum(k) * (1.0 - share(k))).collect(),
            valid: (0..n).map(|k| k != 38).collect(),
        };
        let usable: Vec<bool> = (0..n).map(|k| k != 5).collect();
        let found = contrast(&pair, Some(&usable));
        assert_eq!((found.axis, found.bit), (1, 3));
        for k in 0..n {
            match found.value[k] {
                // Three roundings of f32.
                Some(v) => assert!(![5, 38, 39].contains(&k) && (v - share(k)).abs() < 1e-6),
                None => assert!([5, 38, 39].contains(&k), "{k}"),
            }
        }
        assert!(contrast(&pair, None).value[5].is_some());
        let dark = BitPair { pattern: vec![0.0; n], inverse: vec![0.0; n], ..pair };
        assert!(contrast(&dark, None).value.iter().all(Option::is_none));
    }

    #[test]
    fn on_a_frame_only_what_lies_outside_the_sample_is_used() {
        let slab = |q: Point| [q[0] / 5.0, q[1] / 4.0];
        let matrix = [[5.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]];
        let view = CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([0.0; 2], 300.0) };
        assert_eq!(usable_pixels(&view, SIZE, StripeSurface::White, &slab), None);
        let used = usable_pixels(&view, SIZE, StripeSurface::Frame([15.0, 12.0]), &slab).unwrap();
        // Four pixels are 4 / √20 = 0.894 mm: beyond 15.894 mm in x are columns from 80 on, beyond 12.894 in y lines from 52 on.
        for (x, y, expected) in [(79, 51, false), (80, 51, true), (79, 52, true), (0, 0, false), (3, 51, false)] {
            assert_eq!(used[x + y * SIZE[0]], expected, "({x}, {y})");
        }
        let left = |q: Point| [q[0] / 5.0 - 2.0, q[1] / 4.0 - 1.0];
        let used = usable_pixels(&view, SIZE, StripeSurface::Frame([15.0, 12.0]), &left).unwrap();
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
