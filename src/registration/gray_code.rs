//! Gray-code stripes on the white reference, or on the frame around the sample: where each projector pixel lands on the
//! slab's plane.

use super::board::percentile;
use super::fit::Observation;
use super::projector_fit::{ProjectorFit, fit_projector, plane_of_most};
use super::stripe_area::{BLOCK_PX, StripeArea, StripeSurface, check_sides, usable_pixels};
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

/// Stripes narrower than this, camera px, have no plateau of their own between two edges seen through the lens
/// ([`find_edges`] looks 2.5 px to each side at the least).
const NARROWEST_STRIPE_PX: f64 = 4.0;
/// An edge's blur ends so many projector px beside it: between the edges of the narrowest stripes, two apart. A blur of
/// 0.3 px has 0.4 % of its step farther out.
const EDGE_REACH_PROJECTOR_PX: f64 = 0.8;
/// And so many pixels at the least, for the lens.
const LEAST_REACH_PX: usize = 2;
/// The finest bits are ignored when fewer than this share of the lit pixels are clearly dark or light under them: an
/// edge's blur is as wide as the stripe then.
const CLEAR_SHARE: f64 = 0.5;
/// A pixel reads clearly from this contrast on.
const CLEAR: f32 = 0.5;
/// A square is off the plane when its pixels' codes are off the map by more than this share of a finest stripe, which
/// is what decoding rounds to (half) and a half more.
const OFF_PLANE_STRIPES: f64 = 1.0;
/// Where more squares than this are off the plane, it is not the plane of most.
const MOST_LEFT_OUT: f64 = 0.5;

/// What the stripes say of the projector.
#[derive(Debug, Clone)]
pub struct StripeFit {
    /// The map.
    pub projector: ProjectorFit,
    /// Share of the area that was left out: squares whose codes, or edges that, are far off the map; the larger of
    /// both.
    pub left_out: f64,
    /// The edges that the map rests on: slab mm to one projector coordinate.
    pub edges: Vec<Observation>,
    /// How many of the finest bits of each axis were ignored: the camera does not tell their stripes apart.
    pub ignored_bits: [usize; 2],
}

/// What the codes tell before the edges do.
struct Coarse {
    contrasts: Vec<Contrast>,
    usable: Vec<bool>,
    decoded: Vec<Observation>,
    /// Slab mm to projector px.
    map: Homography,
    across: [Across; 2],
    ignored_bits: [usize; 2],
}

/// Fits the map slab → projector to the places where stripes begin and end.
///
/// First each pixel's code gives its projector coordinate to a stripe, where every bit is clear; a homography that most
/// of them agree with tells which squares of the picture lie in the plane. Then every edge between light and dark,
/// located to a fraction of a pixel by the area under the contrast, gives one exact coordinate; edges that are far off
/// are left out. A pixel takes part when both photographs measured it, when it is lit, lies in `area`, and is not on
/// the sample (`surface`). The finest bits of an axis are ignored where the camera does not tell their stripes apart.
/// `lens` has the projector's centre and unit of length: a radial distortion is fitted when the edges ask for it.
///
/// # Errors
/// A text that says what was not found.
///
/// Not detected: a frame that is not in the sample's plane, where all of it lies in another; distortion of the
/// projector that is not radial, but as [`ProjectorFit::trend`].
pub fn register_projector(
    pairs: &[BitPair],
    size_px: [usize; 2],
    view: &CameraView,
    surface: StripeSurface,
    area: &StripeArea,
    lens: Lens,
) -> Result<StripeFit, String> {
    let ideal = view.ideal_from_slab.inverse().ok_or("the camera's view of the slab cannot be inverted")?;
    let slab = |q: Point| ideal.map(view.lens.undistort(q));
    let coarse = |area: &StripeArea| -> Result<Coarse, String> {
        let usable = usable_pixels(view, size_px, surface, area, &slab);
        let mut contrasts: Vec<Contrast> = pairs.iter().map(|p| contrast(p, &usable)).collect();
        let mut ignored_bits = drop_unclear(&mut contrasts);
        let lit = usable.iter().filter(|u| **u).count();
        let decoded = decode_pixels(&contrasts, &usable, (lit / DECODED_PIXELS).max(1), size_px[0], &slab)?;
        let map = plane_of_most(&decoded).ok_or("the Gray code was decoded in too few pixels to span a plane")?;
        let across = across_stripes(&map, size_px, &slab);
        for axis in 0..2 {
            let wide =
                |c: &Contrast| f64::from(2u32 << c.bit) * across[axis].px_per_projector_px >= NARROWEST_STRIPE_PX;
            let before = contrasts.len();
            contrasts.retain(|c| c.axis != axis || wide(c));
            ignored_bits[axis] += before - contrasts.len();
        }
        Ok(Coarse { contrasts, usable, decoded, map, across, ignored_bits })
    };
    // Of a slab that is stated far too small, the whole picture tells where the dots are.
    let everywhere = StripeArea::everywhere();
    // A frame is in the plane as far as it goes.
    let area = if surface == StripeSurface::White { area } else { &everywhere };
    let mut found = coarse(area).or_else(|_| coarse(&everywhere))?;
    if let Some(wider) = area.widened(&found.map) {
        found = coarse(&wider)?;
    }
    let Coarse { mut contrasts, usable, decoded, map: coarse_map, across, ignored_bits } = found;
    if let StripeSurface::Frame(size_mm) = surface {
        check_sides(&decoded, size_mm)?;
    }
    let left_out = leave_out_off_plane(&mut contrasts, &usable, size_px[0], &coarse_map, &slab)?;
    if left_out > MOST_LEFT_OUT {
        return Err(format!(
            "the stripes fit no plane: {:.0} % of the squares with a code are off it",
            100.0 * left_out
        ));
    }

    let mut edges = Vec::new();
    for contrast in &contrasts {
        for q in find_edges(contrast, size_px, &across[contrast.axis]) {
            let from = slab(q);
            let coarse = coarse_map.map(from)[contrast.axis];
            if let Some(to) = nearest_edge(coarse, contrast.bit) {
                edges.push(Observation { from, axis: contrast.axis, to });
            }
        }
    }
    let (fit, edges) = fit_projector(edges, lens).ok_or("too few stripe edges were found")?;
    if fit.rms_px > 1.0 {
        return Err(format!("the stripes fit no plane: RMS {:.2} projector px", fit.rms_px));
    }
    Ok(StripeFit { left_out: left_out.max(fit.left_out), ignored_bits, edges, projector: fit })
}

/// Removes the finest bits of each axis that are not told apart, while two are left; how many.
fn drop_unclear(contrasts: &mut Vec<Contrast>) -> [usize; 2] {
    let clear = |c: &Contrast| {
        let lit = c.value.iter().flatten();
        let (all, clear) = lit.fold((0usize, 0usize), |(n, k), v| (n + 1, k + usize::from(v.abs() > CLEAR)));
        clear as f64 >= CLEAR_SHARE * all as f64
    };
    [0, 1].map(|axis| {
        let mut bits: Vec<u32> = contrasts.iter().filter(|c| c.axis == axis).map(|c| c.bit).collect();
        bits.sort_unstable();
        let most = bits.len().saturating_sub(2);
        let unclear = |bit: &&u32| contrasts.iter().any(|c| c.axis == axis && c.bit == **bit && !clear(c));
        let dropped: Vec<u32> = bits.iter().take(most).take_while(unclear).copied().collect();
        contrasts.retain(|c| c.axis != axis || !dropped.contains(&c.bit));
        dropped.len()
    })
}

/// Takes the light out of all squares whose codes are off the map; the share of the squares with codes that are.
fn leave_out_off_plane(
    contrasts: &mut [Contrast],
    usable: &[bool],
    width: usize,
    map: &Homography,
    slab: &dyn Fn(Point) -> Point,
) -> Result<f64, String> {
    let columns = width.div_ceil(BLOCK_PX);
    let square = |k: usize| (k / width) / BLOCK_PX * columns + (k % width) / BLOCK_PX;
    let squares = columns * (usable.len() / width).div_ceil(BLOCK_PX);
    let (mut seen, mut off) = (vec![0u32; squares], vec![0u32; squares]);
    for axis in 0..2 {
        let finest = contrasts.iter().filter(|c| c.axis == axis).map(|c| c.bit).min().unwrap_or(0);
        let most = OFF_PLANE_STRIPES * f64::from(1u32 << finest);
        for (k, to) in decoded(contrasts, axis, usable, 1)? {
            let at = map.map(slab([(k % width) as f64, (k / width) as f64]))[axis];
            seen[square(k)] += 1;
            off[square(k)] += u32::from((at - to).abs() > most);
        }
    }
    let left_out: Vec<bool> = seen.iter().zip(&off).map(|(n, k)| 2 * k > *n).collect();
    for value in contrasts.iter_mut().flat_map(|c| c.value.iter_mut().enumerate()) {
        if left_out[square(value.0)] {
            *value.1 = None;
        }
    }
    let with_codes = seen.iter().filter(|n| **n > 0).count().max(1);
    Ok(left_out.iter().filter(|l| **l).count() as f64 / with_codes as f64)
}

fn contrast(pair: &BitPair, usable: &[bool]) -> Contrast {
    let allowed = |k: usize| pair.valid[k] && usable[k];
    let sum: Vec<f32> = pair.pattern.iter().zip(&pair.inverse).map(|(a, b)| a + b).collect();
    let seen: Vec<f32> = sum.iter().enumerate().filter(|(k, _)| allowed(*k)).map(|(_, s)| *s).collect();
    let least = LIT_SHARE * percentile(&seen, 0.9);
    let lit = |k: usize| allowed(k) && sum[k] > least && sum[k] > 0.0;
    let share = |k: usize| (pair.pattern[k] - pair.inverse[k]) / sum[k];
    let value = (0..sum.len()).map(|k| lit(k).then(|| share(k))).collect();
    Contrast { axis: pair.axis, bit: pair.bit, value }
}

/// The projector coordinate of every `step`th usable pixel as the middle of the finest stripe that its bits tell, both
/// axes.
fn decode_pixels(
    contrasts: &[Contrast],
    usable: &[bool],
    step: usize,
    width: usize,
    slab: &dyn Fn(Point) -> Point,
) -> Result<Vec<Observation>, String> {
    let mut out = Vec::new();
    for axis in 0..2 {
        let from = |k: usize| slab([(k % width) as f64, (k / width) as f64]);
        out.extend(decoded(contrasts, axis, usable, step)?.into_iter().map(|(k, to)| Observation {
            from: from(k),
            axis,
            to,
        }));
    }
    Ok(out)
}

/// Pixels of which all bits of an axis are clear, and their coordinate.
fn decoded(contrasts: &[Contrast], axis: usize, usable: &[bool], step: usize) -> Result<Vec<(usize, f64)>, String> {
    let mut bits: Vec<&Contrast> = contrasts.iter().filter(|c| c.axis == axis).collect();
    bits.sort_by_key(|c| std::cmp::Reverse(c.bit));
    let Some(finest) = bits.last().map(|c| c.bit) else {
        return Err(format!("no Gray-code shots for the projector's {} axis", ["x", "y"][axis]));
    };
    if bits.windows(2).any(|p| p[0].bit != p[1].bit + 1) {
        return Err("the Gray code's bits must follow each other without a gap".into());
    }
    let side = f64::from(1u32 << finest);
    let middle = |k: usize| {
        // A pixel on a stripe's edge may read either way: only clear ones count here.
        let mut code = 0u32;
        for c in &bits {
            let clear = c.value[k].filter(|v| v.abs() > CLEAR)?;
            code = (code << 1) | ((code & 1) ^ u32::from(clear > 0.0));
        }
        Some((k, (f64::from(code) + 0.5) * side - 0.5))
    };
    Ok((0..usable.len()).filter(|k| usable[*k]).step_by(step).filter_map(middle).collect())
}

/// Edges of bit j lie between projector pixels m − 1 and m, m an odd multiple of 2^j; `None` when the nearest is not
/// clear.
fn nearest_edge(coordinate: f64, bit: u32) -> Option<f64> {
    let side = f64::from(1u32 << bit);
    let m = 2.0 * (((coordinate + 0.5) / side - 1.0) / 2.0).round() + 1.0;
    let edge = m * side - 0.5;
    // Edges are 2·side apart; the first estimate is good to half a finest stripe.
    ((coordinate - edge).abs() < 0.5 * side).then_some(edge)
}

/// How the stripes of one projector axis lie in the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Across {
    /// Whether they are crossed along the picture's rows (0) or columns (1): the direction nearer to right angles.
    along: usize,
    /// Camera px that a projector px is wide, along it.
    px_per_projector_px: f64,
}

impl Across {
    /// Pixels to each side of the two between which an edge lies that still belong to it.
    fn reach_px(&self) -> usize {
        ((EDGE_REACH_PROJECTOR_PX * self.px_per_projector_px) as usize).max(LEAST_REACH_PX)
    }
}

/// Across which direction of the picture the stripes of each projector axis are looked at.
///
/// Along the other an edge is seen aslant, its blur longer than the plateaus between which [`find_edges`] looks for it:
/// at 25 degrees that pulled edges by 1.75 projector px RMS. Decided in the middle of the picture: at 45 degrees both
/// do.
fn across_stripes(coarse_map: &Homography, size_px: [usize; 2], slab: &dyn Fn(Point) -> Point) -> [Across; 2] {
    let middle = size_px.map(|s| 0.5 * s as f64);
    let at = |q: Point| coarse_map.map(slab(q));
    let (here, right, below) = (at(middle), at([middle[0] + 1.0, middle[1]]), at([middle[0], middle[1] + 1.0]));
    [0, 1].map(|axis| {
        let change = [right, below].map(|p| (p[axis] - here[axis]).abs());
        let along = usize::from(change[1] > change[0]);
        Across { along, px_per_projector_px: 1.0 / change[along].max(1e-9) }
    })
}

/// Camera positions of a bit's edges.
///
/// Between plateaus p and q, `reach` pixels before and after the two between which the sign changes, the edge lies where
/// the area under the contrast says: exact for a sharp edge seen through any symmetric blur narrower than that.
fn find_edges(contrast: &Contrast, [width, height]: [usize; 2], across: &Across) -> Vec<Point> {
    let reach = across.reach_px();
    let mut edges = Vec::new();
    let (lines, length, step, line_step) =
        if across.along == 0 { (height, width, 1, width) } else { (width, height, width, 1) };
    for line in 0..lines {
        let at = |k: usize| contrast.value[line * line_step + k * step];
        for k in reach..length.saturating_sub(reach + 1) {
            let (Some(a), Some(b)) = (at(k), at(k + 1)) else { continue };
            if (a > 0.0) == (b > 0.0) {
                continue;
            }
            let (Some(p), Some(q)) = (at(k - reach), at(k + 1 + reach)) else { continue };
            let inner = (k + 1 - reach..=k + reach).map(at).sum::<Option<f32>>();
            let Some(sum) = inner else { continue };
            if (p - q).abs() < EDGE_CONTRAST || (p > 0.0) != (a > 0.0) || (q > 0.0) != (b > 0.0) {
                continue;
            }
            let share = (sum - 2.0 * reach as f32 * q) / (p - q);
            let place = k as f64 - reach as f64 + 0.5 + f64::from(share);
            edges.push(if across.along == 0 { [place, line as f64] } else { [line as f64, place] });
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

    fn pair(axis: usize, bit: u32) -> BitPair {
        pair_of(axis, bit, |_, p| PROJECTOR.map(p))
    }

    /// What a pixel sees of bit `bit` of the code, averaged over 6 × 6 places in it; `map` from its column and place on
    /// the plane, mm.
    fn pair_of(axis: usize, bit: u32, map: impl Fn(f64, Point) -> Point) -> BitPair {
        let back = view().ideal_from_slab.inverse().unwrap();
        let place = |k: usize| (k as f64 + 0.5) / 6.0 - 0.5;
        let lit = |k: usize| {
            let (x, y) = ((k % SIZE[0]) as f64, (k / SIZE[0]) as f64);
            let on = (0..36)
                .filter(|s| {
                    let q = map(x, back.map([x + place(s % 6), y + place(s / 6)]));
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

    fn registered(pairs: &[BitPair], lens: Lens) -> Result<StripeFit, String> {
        register_projector(pairs, SIZE, &view(), StripeSurface::White, &StripeArea::everywhere(), lens)
    }

    /// The largest error of the map over the slab's points, projector px.
    fn error_px(fit: &StripeFit) -> f64 {
        let points = [[2.0, 1.0], [13.0, 9.0], [22.0, 17.0], [4.0, 18.0], [23.0, 2.0]];
        let off = points.map(|p| {
            let (a, b) = (fit.projector.slab_from_projector.projector_from_slab(p), PROJECTOR.map(p));
            (a[0] - b[0]).hypot(a[1] - b[1])
        });
        off.into_iter().fold(0.0, f64::max)
    }

    #[test]
    fn a_wall_behind_the_plane_is_left_out_and_said() {
        let ideal = Lens::ideal([23.5, 19.5], 60.0);
        // The right third of the picture is a wall where the stripes lie 3.7 px (and a tenth more of their place)
        // further right.
        let wall = Homography { matrix: [[2.2, 0.1, 6.7], [-0.15, 1.7, 4.0], [1e-3, -2e-3, 1.0]] };
        let wall_from = |x: f64| x > 88.0;
        let pairs: Vec<BitPair> = (0..2)
            .flat_map(|axis| {
                (2..6).map(move |bit| {
                    pair_of(axis, bit, |x, p| if wall_from(x) { wall.map(p) } else { PROJECTOR.map(p) })
                })
            })
            .collect();
        let fit = registered(&pairs, ideal).unwrap();
        // The wall is a third of the picture; its stripes along y lie where the plane's would, those along x do not.
        assert!(fit.left_out > 0.12 && fit.left_out < 0.35, "{fit:?}");
        // Two thirds of the picture, extrapolated to the last of it: the edges are off by some hundredths each.
        assert!(error_px(&fit) < 0.05, "{} {fit:?}", error_px(&fit));
        // Of an area that ends before the wall, nothing is left out; the dot beyond it widens the area to the wall
        // again.
        let only = |dots: Vec<Point>| {
            let area = StripeArea { corners_mm: [[-2.0, -2.0], [16.0, 30.0]], dots_projector_px: dots };
            register_projector(&pairs, SIZE, &view(), StripeSurface::White, &area, ideal).unwrap()
        };
        let fit = only(vec![]);
        assert!(fit.left_out < 0.02 && error_px(&fit) < 0.05, "{} {fit:?}", error_px(&fit));
        let fit = only(vec![PROJECTOR.map([22.0, 10.0])]);
        assert!(fit.left_out > 0.05 && error_px(&fit) < 0.05, "{} {fit:?}", error_px(&fit));
    }

    #[test]
    fn bits_that_the_camera_does_not_tell_apart_are_ignored() {
        let ideal = Lens::ideal([23.5, 19.5], 60.0);
        // A projector pixel is about 2.3 camera px wide, so bits 0 and 1 have stripes of 4.6 and 9; through a blur of
        // 13 px at the finest both are grey.
        let mut pairs: Vec<BitPair> = (0..2).flat_map(|axis| (0..6).map(move |bit| pair(axis, bit))).collect();
        let whole = registered(&pairs, ideal).unwrap();
        assert_eq!(whole.ignored_bits, [0, 0]);
        for pair in pairs.iter_mut().filter(|p| p.axis == 1 && p.bit < 2) {
            let (pattern, inverse) = (blurred(&pair.pattern), blurred(&pair.inverse));
            (pair.pattern, pair.inverse) = (pattern, inverse);
        }
        let fit = registered(&pairs, ideal).unwrap();
        assert_eq!(fit.ignored_bits, [0, 2], "{fit:?}");
        assert!(error_px(&fit) < 0.02, "{} {fit:?}", error_px(&fit));
        // A coarser bit that nobody can read is no fine one.
        pairs.iter_mut().filter(|p| p.axis == 0 && p.bit == 3).for_each(|p| p.inverse = p.pattern.clone());
        assert!(registered(&pairs, ideal).is_err());
    }

    /// Means over 13 × 13 pixels.
    fn blurred(light: &[f32]) -> Vec<f32> {
        let [w, h] = SIZE;
        let mean = |k: usize| {
            let (x, y) = (k % w, k / w);
            let (xs, ys) = (x.saturating_sub(6)..(x + 7).min(w), y.saturating_sub(6)..(y + 7).min(h));
            let n = (xs.len() * ys.len()) as f32;
            ys.flat_map(|v| xs.clone().map(move |u| light[v * w + u])).sum::<f32>() / n
        };
        (0..w * h).map(mean).collect()
    }

    #[test]
    fn the_projector_is_registered_by_where_its_stripes_end() {
        let ideal = Lens::ideal([23.5, 19.5], 60.0);
        let fit = registered(&code(), ideal).unwrap();
        for p in [[2.0, 1.0], [13.0, 9.0], [22.0, 17.0], [4.0, 18.0]] {
            let (a, b) = (fit.projector.slab_from_projector.projector_from_slab(p), PROJECTOR.map(p));
            // Edges of 36 places a pixel of half a projector pixel: a hundredth each, and hundreds of them.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.01, "{a:?} {b:?}");
        }
        assert!(fit.projector.rms_px < 0.03 && fit.projector.edges > 500, "{fit:?}");
        // Without one axis, or a bit, it cannot be told.
        let only = |keep: &dyn Fn(&BitPair) -> bool| {
            let some: Vec<BitPair> = code().into_iter().filter(keep).collect();
            registered(&some, ideal).unwrap_err()
        };
        assert!(only(&|p| p.axis == 0).contains("y axis") && only(&|p| p.axis == 1).contains("x axis"));
        assert!(only(&|p| p.bit != 3).contains("gap"));
    }

    #[test]
    fn pixels_are_decoded_to_the_middle_of_their_finest_stripe() {
        let contrasts: Vec<Contrast> = code().iter().map(|p| contrast(p, &[true; SIZE[0] * SIZE[1]])).collect();
        let back = view().ideal_from_slab.inverse().unwrap();
        let decoded = decode_pixels(&contrasts, &[true; SIZE[0] * SIZE[1]], 1, SIZE[0], &|q| back.map(q)).unwrap();
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

    /// Stripes crossed along the rows by a camera that has three pixels to one of the projector's.
    const ROWS: Across = Across { along: 0, px_per_projector_px: 3.0 };

    #[test]
    fn an_edge_that_the_projector_blurs_over_many_pixels_is_found_where_it_is() {
        // 19 camera px to a projector px: its blur of 0.3 px is 5.7 camera px.
        let (width, at) = (150, 71.3);
        let cdf = |x: f64| 0.5 * libm::erfc(-x / (5.7 * std::f64::consts::SQRT_2));
        let value = (0..width).map(|k| Some((2.0 * cdf(k as f64 - at) - 1.0) as f32)).collect();
        let across = Across { along: 0, px_per_projector_px: 19.0 };
        let found = find_edges(&Contrast { axis: 0, bit: 1, value }, [width, 1], &across);
        assert_eq!(found.len(), 1);
        // 15 px to each side, 2.6 deviations, leave 0.5 % of the step outside: alike on both sides but for 0.2 px of 0.3.
        assert!((found[0][0] - at).abs() < 0.02, "{found:?}");
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
            find_edges(
                &Contrast { axis: 0, bit: 0, value },
                [width, height],
                &Across { along: axis, px_per_projector_px: 3.0 },
            )
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
            find_edges(&Contrast { axis: 0, bit: 0, value }, [width, height], &ROWS).len()
        };
        assert_eq!((weak(0.6, -0.45), weak(0.5, -0.45), weak(-0.6, 0.45)), (11, 0, 11));
        let mut value: Vec<Option<f32>> = (0..width).map(|k| step(9.3, k)).collect();
        value[11] = None;
        assert_eq!(find_edges(&Contrast { axis: 0, bit: 0, value }, [width, 1], &ROWS).len(), 0);
    }

    #[test]
    fn contrast_is_the_difference_over_the_sum_where_there_is_light() {
        let n = 40;
        // Light from 10 to 49 of which a share of −1 to 1 is the pattern's; the last is dark, the one before it not
        // valid.
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
        let found = contrast(&pair, &usable);
        assert_eq!((found.axis, found.bit), (1, 3));
        for k in 0..n {
            match found.value[k] {
                // Three roundings of f32.
                Some(v) => assert!(![5, 38, 39].contains(&k) && (v - share(k)).abs() < 1e-6),
                None => assert!([5, 38, 39].contains(&k), "{k}"),
            }
        }
        assert!(contrast(&pair, &vec![true; n]).value[5].is_some());
        let dark = BitPair { pattern: vec![0.0; n], inverse: vec![0.0; n], ..pair };
        assert!(contrast(&dark, &vec![true; n]).value.iter().all(Option::is_none));
    }
}
