use super::*;
use crate::capture::{Camera, Projector, ResponseCurve, Rig, WhiteReference};
use crate::geometry::{Homography, Lens};

/// Wider than high, as the pictures below are.
const SIZE_PX: [usize; 2] = [61, 47];
const FOCAL_PX: f64 = 50.0;
const PRINCIPAL_PX: Point = [40.0, 11.0];
const VIGNETTING: f64 = -0.2;
const WINDOW: Window = Window { samples: [9, 5], pitch_mm: 0.5 };
const CENTER_MM: Point = [4.3, 3.1];
const SLAB_MM: Point = [20.0, 9.0];
const FLUX: [f64; 3] = [2.0, 5.0, 0.8];
/// Camera px of the slab's origin, and px in a mm along x and y, of [`upright`].
const ORIGIN_PX: Point = [3.3, 1.6];
const SCALE_PX: Point = [6.2, 7.4];

fn sensitivity() -> Sensitivity {
    let camera = Camera {
        size_px: SIZE_PX,
        focal_px: FOCAL_PX,
        principal_px: PRINCIPAL_PX,
        response_curve: ResponseCurve::Linear,
        vignetting: vec![VIGNETTING],
    };
    let projector = Projector { size_px: [64, 36], principal_px: None };
    let white_reference = WhiteReference { reflectance: [0.91, 0.74, 0.52], relative_sd: 0.0 };
    Sensitivity::new(&Rig { format: 1, camera, noise: None, projector, board: None, frame: None, white_reference })
}

/// What is left of the light at a pixel, by the formula of the rig file's documentation.
fn vignetting(x: f64, y: f64) -> f64 {
    let r2 = ((x - PRINCIPAL_PX[0]).powi(2) + (y - PRINCIPAL_PX[1]).powi(2)) / FOCAL_PX.powi(2);
    1.0 + VIGNETTING * r2
}

fn view(matrix: [[f64; 3]; 3]) -> CameraView {
    CameraView { ideal_from_slab: Homography { matrix }, lens: Lens::ideal([0.0; 2], 1.0) }
}

/// Axes along the picture's, unequal scales.
fn upright() -> CameraView {
    view([[SCALE_PX[0], 0.0, ORIGIN_PX[0]], [0.0, SCALE_PX[1], ORIGIN_PX[1]], [0.0, 0.0, 1.0]])
}

/// What a camera with vignetting sees of `light(x, y, channel)`, without noise.
fn seen(light: impl Fn(f64, f64, usize) -> f64) -> Radiance {
    let rect = Rect { x: 2, y: 1, width: SIZE_PX[0] - 3, height: SIZE_PX[1] - 2 };
    let n = 3 * rect.area();
    let mut picture = Radiance { rect, value: vec![0.0; n], variance: vec![0.0; n], used: vec![1; n] };
    each(&mut picture, |picture, k, x, y, c| picture.value[k] = (light(x, y, c) * vignetting(x, y)) as f32);
    picture
}

fn each(picture: &mut Radiance, mut f: impl FnMut(&mut Radiance, usize, f64, f64, usize)) {
    let rect = picture.rect;
    for k in 0..3 * rect.area() {
        let (x, y) = (rect.x + k / 3 % rect.width, rect.y + k / 3 / rect.width);
        f(picture, k, x as f64, y as f64, k % 3);
    }
}

fn dot() -> LitDot {
    LitDot { center_mm: CENTER_MM, position_sd_mm: 0.0, flux: Flux { value: FLUX, relative_variance: [0.0; 3] } }
}

fn shared() -> Vec<CellWeights> {
    vec![CellWeights::new(3.4, 0.0)]
}

fn extract(light: &Radiance, view: &CameraView, dot: &LitDot, weights: &mut [CellWeights]) -> (Row, RowFindings) {
    let grid = WindowGrid::new(&WINDOW, CENTER_MM, view);
    extract_row(light, &grid, dot, &sensitivity(), SLAB_MM, weights)
}

/// (i, j, channel) of each sample, in the row's order.
fn samples() -> impl Iterator<Item = (usize, (usize, usize, usize))> {
    (0..3 * 45).map(|k| (k, (k / 3 % 9, k / 27, k % 3)))
}

/// Centre of cell (i, j), mm: the middle one of 9 × 5 is (4, 2).
fn cell_mm(i: usize, j: usize) -> Point {
    [CENTER_MM[0] + 0.5 * (i as f64 - 4.0), CENTER_MM[1] + 0.5 * (j as f64 - 2.0)]
}

/// Three ramps, no two alike along any axis.
fn ramp(x: f64, y: f64, c: usize) -> f64 {
    [300.0 + 4.0 * x - 2.5 * y, 150.0 - 1.5 * x + 3.5 * y, 90.0 + 0.7 * x + 1.1 * y][c]
}

/// Values of about 1, weights in f32 that add to 1 and of which some hundred count: 1e-6 and some.
fn assert_close(found: f32, expected: f64, what: impl std::fmt::Debug) {
    assert!((f64::from(found) - expected).abs() < 5e-6 * expected.abs().max(1e-3), "{what:?}: {found} {expected}");
}

#[test]
fn each_cell_holds_the_light_at_its_own_place_over_its_channels_flux() {
    // Turned and sheared, so that both pixel axes depend on both of the slab.
    let view = view([[5.4, 1.3, 3.3], [-0.9, 6.6, 6.6], [0.0, 0.0, 1.0]]);
    let (row, findings) = extract(&seen(ramp), &view, &dot(), &mut shared());
    assert_eq!(findings, RowFindings::default());
    for (k, (i, j, c)) in samples() {
        // The mean of a ramp over a parallelogram is its value in the middle.
        let [x, y] = cell_mm(i, j);
        let expected = ramp(5.4 * x + 1.3 * y + 3.3, -0.9 * x + 6.6 * y + 6.6, c) / FLUX[c];
        assert!(row.valid[k]);
        assert_close(row.response[k], expected, (i, j, c));
    }
}

#[test]
fn a_row_is_the_same_in_any_unit_of_light() {
    let mut picture = seen(ramp);
    picture.variance.fill(30.0);
    let mut lit = dot();
    lit.flux.relative_variance = [1e-5, 2e-5, 3e-5];
    let (one, _) = extract(&picture, &upright(), &lit, &mut shared());
    for unit in [1e-12f32, 1e12] {
        let mut other = picture.clone();
        other.value.iter_mut().for_each(|v| *v *= unit);
        other.variance.iter_mut().for_each(|v| *v *= unit * unit);
        let mut lit = lit;
        lit.flux.value = FLUX.map(|f| f * f64::from(unit));
        let (row, _) = extract(&other, &upright(), &lit, &mut shared());
        for k in 0..row.response.len() {
            // Some roundings of f32.
            assert_close(row.response[k], f64::from(one.response[k]), (unit, k));
            assert!((row.variance[k] / one.variance[k] - 1.0).abs() < 1e-5, "{unit} {k}");
        }
    }
}

#[test]
fn a_row_without_light_is_measured_to_be_nothing() {
    let (row, findings) = extract(&seen(|_, _, _| 0.0), &upright(), &dot(), &mut shared());
    assert!(row.valid.iter().all(|v| *v) && row.response.iter().chain(&row.variance).all(|v| *v == 0.0));
    assert_eq!(findings, RowFindings::default());
}

/// Gauss–Legendre places and weights over [−1, 1] of 3 and 6 points (Abramowitz and Stegun, table 25.4).
const COARSE: [(f64, f64); 3] =
    [(-0.774_596_669_241_483, 5.0 / 9.0), (0.0, 8.0 / 9.0), (0.774_596_669_241_483, 5.0 / 9.0)];
const FINE: [(f64, f64); 6] = [
    (-0.932_469_514_203_152, 0.171_324_492_379_170),
    (-0.661_209_386_466_265, 0.360_761_573_048_139),
    (-0.238_619_186_083_197, 0.467_913_934_572_691),
    (0.238_619_186_083_197, 0.467_913_934_572_691),
    (0.661_209_386_466_265, 0.360_761_573_048_139),
    (0.932_469_514_203_152, 0.171_324_492_379_170),
];

/// Weights of pixels for the mean over [a, b] (px along one axis) at the places of a quadrature, as the documentation
/// of [`CellWeights`] describes them, the other way round: the light at a place is the slope of the polynomial through
/// the running sums at `n` + 1 pixel edges.
fn naive_weights(n: usize, [a, b]: [f64; 2], places: &[(f64, f64)]) -> std::collections::BTreeMap<usize, f64> {
    // Slope at x of the polynomial through running sums of pixel `of` alone; the pixels are `n` around `pixel`.
    let slope = |pixel: f64, of: f64, x: f64| {
        let edges: Vec<f64> = (0..=n).map(|k| pixel - (n / 2) as f64 + k as f64 - 0.5).collect();
        let term = |k: usize| {
            let others = || (0..=n).filter(move |&m| m != k);
            let bottom: f64 = others().map(|m| edges[k] - edges[m]).product();
            let product = |m: usize| others().filter(|&l| l != m).map(|l| x - edges[l]).product::<f64>();
            f64::from(u8::from(edges[k] > of)) * others().map(product).sum::<f64>() / bottom
        };
        (0..=n).map(term).sum::<f64>()
    };
    let light = |of: f64, x: f64| {
        let t = x - x.floor();
        let blend = t * t * (3.0 - 2.0 * t);
        let part = |pixel: f64| if (of - pixel).abs() <= (n / 2) as f64 { slope(pixel, of, x) } else { 0.0 };
        (1.0 - blend) * part(x.floor()) + blend * part(x.floor() + 1.0)
    };
    let mean =
        |of: usize| places.iter().map(|(u, w)| 0.5 * w * light(of as f64, 0.5 * (a + b) + 0.5 * (b - a) * u)).sum();
    (a.floor() as usize - 3..=b.floor() as usize + 4).map(|of| (of, mean(of))).collect()
}

/// What one pixel counts in the mean over a cell, and in its difference from the mean by degree 4.
struct Tap {
    at: [usize; 2],
    mean: f64,
    difference: f64,
}

fn taps(i: usize, j: usize) -> Vec<Tap> {
    let span = |a: usize, k: f64| ORIGIN_PX[a] + SCALE_PX[a] * (CENTER_MM[a] + 0.5 * k);
    // Three samples from the dot on, fewer places do.
    let places: &[(f64, f64)] = if i.abs_diff(4).max(j.abs_diff(2)) <= 3 { &FINE } else { &COARSE };
    let axis = |n: usize, a: usize, k: f64| naive_weights(n, [span(a, k - 0.5), span(a, k + 0.5)], places);
    let [x6, x4] = [7, 5].map(|n| axis(n, 0, i as f64 - 4.0));
    let [y6, y4] = [7, 5].map(|n| axis(n, 1, j as f64 - 2.0));
    let pixel = |x: usize, y: usize| {
        let v = vignetting(x as f64, y as f64);
        Tap { at: [x, y], mean: x6[&x] * y6[&y] / v, difference: (x6[&x] * y6[&y] - x4[&x] * y4[&y]) / v }
    };
    y6.keys().flat_map(|&y| x6.keys().map(move |&x| (x, y))).map(|(x, y)| pixel(x, y)).collect()
}

/// Of a sample by its [`taps`]: mean and its variance, difference of both degrees and its variance, over the flux.
fn naive(picture: &Radiance, (i, j, c): (usize, usize, usize)) -> [f64; 4] {
    let mut sum = [0.0; 4];
    for tap in taps(i, j) {
        let k = picture.at(tap.at[0], tap.at[1]) + c;
        let (light, variance) = (f64::from(picture.value[k]), f64::from(picture.variance[k]));
        let add =
            [tap.mean * light, tap.mean.powi(2) * variance, tap.difference * light, tap.difference.powi(2) * variance];
        sum.iter_mut().zip(add).for_each(|(s, a)| *s += a);
    }
    [sum[0] / FLUX[c], sum[1] / FLUX[c].powi(2), sum[2] / FLUX[c], sum[3] / FLUX[c].powi(2)]
}

/// Pixels that differ as no light does, by up to this much.
const TEXTURE: [f64; 3] = [300.0, 200.0, 500.0];

fn texture(x: f64, y: f64, c: usize) -> f64 {
    ramp(x, y, c) + TEXTURE[c] * ((12.9898 * x + 78.233 * y + 37.7 * c as f64).sin() * 43_758.545_3).fract().abs()
}

/// Variances that differ from pixel to pixel along both axes, and by channel.
fn noisy(mut picture: Radiance, level: f64) -> Radiance {
    each(&mut picture, |p, k, x, y, c| {
        p.variance[k] = (level * [1.0, 0.2, 6.0][c] * (1.0 + 0.9 * (1.7 * x).sin() * (2.3 * y).cos())) as f32;
    });
    picture
}

fn is_sharp((i, j, _): (usize, usize, usize)) -> bool {
    i.abs_diff(4).max(j.abs_diff(2)) <= 1
}

#[test]
fn any_picture_is_averaged_as_by_polynomials_of_degree_6_written_the_other_way_round() {
    let picture = seen(texture);
    let (row, _) = extract(&picture, &upright(), &dot(), &mut shared());
    for (k, at) in samples() {
        let error = (f64::from(row.response[k]) - naive(&picture, at)[0]).abs() * FLUX[at.2] / TEXTURE[at.2];
        // Of the texture: weights are interpolated in a table, and f32.
        assert!(error < 2e-5, "{at:?} {error}");
    }
}

#[test]
fn the_noise_of_each_pixel_is_in_the_variance_by_the_square_of_its_weight() {
    // On a ramp both degrees agree, so that there is no doubt.
    let picture = noisy(seen(ramp), 40.0);
    let (row, _) = extract(&picture, &upright(), &dot(), &mut shared());
    for (k, at) in samples() {
        let expected = naive(&picture, at)[1];
        // Twice the relative error of the larger weights, 1e-5 of a tenth.
        assert!((f64::from(row.variance[k]) / expected - 1.0).abs() < 2e-4, "{at:?} {} {expected}", row.variance[k]);
    }
}

#[test]
fn around_the_dot_a_sample_is_doubted_by_twice_the_difference_of_both_degrees() {
    let picture = seen(texture);
    let (row, _) = extract(&picture, &upright(), &dot(), &mut shared());
    let (mut worst, mut largest) = (0.0f64, 0.0f64);
    for (k, at) in samples() {
        let expected = if is_sharp(at) { 2.0 * naive(&picture, at)[2].abs() } else { 0.0 };
        let unit = TEXTURE[at.2] / FLUX[at.2];
        worst = worst.max((f64::from(row.variance[k]).sqrt() - expected).abs() / unit);
        largest = largest.max(expected / unit);
        assert!(is_sharp(at) || row.variance[k] == 0.0, "{at:?}");
    }
    // Of the texture: what a response may be off; and the doubts are much more than that.
    assert!(worst < 2e-5 && largest > 100.0 * 2e-5, "{worst} {largest}");
}

#[test]
fn what_noise_makes_of_the_difference_is_no_doubt() {
    // Noise of half the difference, and of more than it; only at pixels that the difference counts much, or the mean's
    // own noise would be all.
    for share in [0.5, 3.0] {
        let mut picture = seen(texture);
        for tap in taps(4, 2).iter().filter(|t| t.difference.abs() > 0.1 * t.mean.abs()) {
            let k = picture.at(tap.at[0], tap.at[1]);
            picture.variance[k..k + 3].fill(1.0);
        }
        for c in 0..3 {
            let [_, _, difference, noise] = naive(&picture, (4, 2, c));
            let scale = (share * difference * difference / noise) as f32;
            picture.variance.iter_mut().skip(c).step_by(3).for_each(|v| *v *= scale);
        }
        let (row, _) = extract(&picture, &upright(), &dot(), &mut shared());
        for c in 0..3 {
            let [_, variance, difference, noise] = naive(&picture, (4, 2, c));
            let doubt = 4.0 * (difference * difference - noise).max(0.0);
            let found = f64::from(row.variance[3 * (2 * 9 + 4) + c]);
            // Small weights are right to a thousandth of themselves, and so is the difference.
            assert!((found / (variance + doubt) - 1.0).abs() < 2e-3, "{share} {c}: {found} {variance} {doubt}");
            // The noise's part is much more than that.
            let part = 4.0 * noise.min(difference * difference) / (variance + doubt);
            assert!(part > 0.02, "{share} {c} {part}");
        }
    }
}

#[test]
fn the_fluxs_variance_is_in_every_sample_by_the_square_of_its_response() {
    let mut lit = dot();
    lit.flux.relative_variance = [1e-4, 9e-4, 25e-4];
    let (row, _) = extract(&seen(ramp), &upright(), &lit, &mut shared());
    for (k, (i, j, c)) in samples() {
        let [x, y] = cell_mm(i, j);
        let r = ramp(SCALE_PX[0] * x + ORIGIN_PX[0], SCALE_PX[1] * y + ORIGIN_PX[1], c) / FLUX[c];
        let expected = r * r * [1e-4, 9e-4, 25e-4][c];
        // Nothing else: the pixels have no noise. Twice the relative error of a response.
        assert!((f64::from(row.variance[k]) / expected - 1.0).abs() < 1e-5, "{:?}", (i, j, c));
    }
}

#[test]
fn the_places_variance_is_in_every_sample_by_the_square_of_the_slope() {
    let mut lit = dot();
    lit.position_sd_mm = 0.03;
    // Curved along x and y, so that a difference over one side only is told from one over both.
    let light =
        |x: f64, y: f64, c: usize| ramp(x, y, c) + [0.11, -0.07, 0.03][c] * x * x + [-0.05, 0.02, 0.09][c] * y * y;
    let (row, _) = extract(&seen(light), &upright(), &lit, &mut shared());
    let (bx, by) = ([4.0, -1.5, 0.7], [-2.5, 3.5, 1.1]);
    for (k, (i, j, c)) in samples() {
        let [x, y] = cell_mm(i, j);
        let slope = |a: usize, at: f64, b: f64, curve: f64, index: usize, last: usize| {
            // Of a parabola: that in the middle of the two neighbours, or of the sample and its only one.
            let middle = at
                + if index == 0 {
                    0.25
                } else if index == last {
                    -0.25
                } else {
                    0.0
                };
            SCALE_PX[a] * (b + 2.0 * curve * (SCALE_PX[a] * middle + ORIGIN_PX[a])) / FLUX[c]
        };
        let sx = slope(0, x, bx[c], [0.11, -0.07, 0.03][c], i, 8);
        let sy = slope(1, y, by[c], [-0.05, 0.02, 0.09][c], j, 4);
        let expected = 0.03f64.powi(2) * (sx * sx + sy * sy);
        // Differences of responses of some hundred, 1e-6 of which is rounding.
        let tolerance = 2e-3 * expected + 1e-6 * (f64::from(row.response[k]) * 0.03).powi(2);
        let error = f64::from(row.variance[k]) - expected;
        assert!(error.abs() < tolerance, "{:?} {} {expected}", (i, j, c), row.variance[k]);
    }
}

#[test]
fn slopes_leave_out_neighbours_that_were_not_measured() {
    let row = |valid: &dyn Fn(usize, usize) -> bool| {
        let response = samples().map(|(_, (i, j, c))| ((c + 1) * (i * i + 10 * j * j)) as f32).collect();
        let valid = samples().map(|(_, (i, j, _))| valid(i, j)).collect();
        let mut row = Row { response, variance: vec![0.5; 135], valid };
        add_position_variance(&mut row, &WindowGrid::new(&WINDOW, CENTER_MM, &upright()), 0.1);
        row.variance
    };
    let at = |i: usize, j: usize, c: usize| 3 * (9 * j + i) + c;
    // i² + 10 j²: by central differences over two samples of 0.5 mm 4 i and 40 j; ± 2 and ± 20 with one neighbour only.
    let expected = |sx: f64, sy: f64, c: usize| 0.5 + 0.01 * ((c + 1) as f64).powi(2) * (sx * sx + sy * sy);
    let check = |v: &[f32], (i, j): (usize, usize), sx: f64, sy: f64| {
        for c in 0..3 {
            // f32.
            let e = expected(sx, sy, c);
            assert!((f64::from(v[at(i, j, c)]) / e - 1.0).abs() < 1e-5, "{i} {j} {c}: {} {e}", v[at(i, j, c)]);
        }
    };
    let all = row(&|_, _| true);
    check(&all, (4, 1), 16.0, 40.0);
    check(&all, (0, 4), 2.0, 140.0);
    check(&all, (8, 0), 30.0, 20.0);
    let right_is_gone = row(&|i, j| (i, j) != (5, 1));
    check(&right_is_gone, (4, 1), 14.0, 40.0);
    // What is not measured is not touched.
    assert_eq!(right_is_gone[at(5, 1, 2)], 0.5);
    check(&row(&|i, j| (i, j) != (3, 1)), (4, 1), 18.0, 40.0);
    check(&row(&|i, j| (i, j) != (4, 0)), (4, 1), 16.0, 60.0);
    check(&row(&|i, j| (i, j) != (4, 2)), (4, 1), 16.0, 20.0);
    check(&row(&|i, j| (i, j) == (4, 1)), (4, 1), 0.0, 0.0);
}

#[test]
fn variances_of_pixels_doubt_flux_and_place_add_up() {
    let variance = |level: f64, flux: f64, sd: f64| {
        let mut lit = dot();
        (lit.flux.relative_variance, lit.position_sd_mm) = ([flux, 2.0 * flux, 3.0 * flux], sd);
        let picture = if level > 0.0 { noisy(seen(texture), level) } else { seen(texture) };
        extract(&picture, &upright(), &lit, &mut shared()).0.variance
    };
    let (level, flux, sd) = (3.0, 2e-4, 0.01);
    let none = variance(0.0, 0.0, 0.0);
    let [a, b, c] = [variance(level, 0.0, 0.0), variance(0.0, flux, 0.0), variance(0.0, 0.0, sd)];
    let all = variance(level, flux, sd);
    for (k, at) in samples() {
        let sum = a[k] + (b[k] - none[k]) + (c[k] - none[k]);
        // Sums of f32.
        assert!((all[k] / sum - 1.0).abs() < 1e-4, "{at:?} {} {sum}", all[k]);
        assert!(a[k] > 0.0 && b[k] > none[k] && c[k] > none[k], "{at:?}");
    }
}

#[test]
fn cells_beyond_the_slab_are_left_out_on_each_side() {
    let mut weights = shared();
    let mut valid = |center_mm: Point, size_mm: Point| {
        // The slab's picture is moved so that the window always lies inside the photograph.
        let matrix = [
            [SCALE_PX[0], 0.0, ORIGIN_PX[0] + SCALE_PX[0] * (CENTER_MM[0] - center_mm[0])],
            [0.0, SCALE_PX[1], ORIGIN_PX[1] + SCALE_PX[1] * (CENTER_MM[1] - center_mm[1])],
            [0.0, 0.0, 1.0],
        ];
        let grid = WindowGrid::new(&WINDOW, center_mm, &view(matrix));
        let (row, findings) = extract_row(&seen(ramp), &grid, &dot(), &sensitivity(), size_mm, &mut weights);
        let columns: Vec<usize> = (0..9).filter(|i| row.valid[3 * (2 * 9 + i)]).collect();
        let rows: Vec<usize> = (0..5).filter(|j| row.valid[3 * (9 * j + 4)]).collect();
        let zero = row.valid.iter().zip(row.response.iter().zip(&row.variance));
        assert!(zero.filter(|(valid, _)| !**valid).all(|(_, (r, v))| *r == 0.0 && *v == 0.0));
        assert_eq!(row.valid.iter().filter(|v| **v).count(), 3 * columns.len() * rows.len());
        (columns, rows, findings.clipped)
    };
    let all = |n: usize| (0..n).collect::<Vec<_>>();
    assert_eq!(valid([4.0, 3.0], [20.0, 9.0]), (all(9), all(5), 0));
    // Centres at −1.1, −0.6, −0.1, 0.4 mm and on: three columns are gone.
    assert_eq!(valid([0.9, 3.0], [20.0, 9.0]), (all(9)[3..].to_vec(), all(5), 15));
    // At −0.8, −0.3, 0.2 mm …
    assert_eq!(valid([4.0, 0.2], [20.0, 9.0]), (all(9), all(5)[2..].to_vec(), 18));
    // 2.0 to 6.0 mm across, 2.0 to 4.0 mm down.
    assert_eq!(valid([4.0, 3.0], [4.6, 9.0]), (all(6), all(5), 15));
    assert_eq!(valid([4.0, 3.0], [20.0, 3.1]), (all(9), all(3), 18));
    // On the rim itself still counts, on all four sides.
    assert_eq!(valid([2.0, 1.0], [4.0, 2.0]), (all(9), all(5), 0));
}

#[test]
fn cells_whose_pixels_lie_beyond_the_picture_are_left_out_and_no_others() {
    let whole = seen(ramp);
    let (row, _) = extract(&whole, &upright(), &dot(), &mut shared());
    let crop = |rect: Rect| {
        let mut part = Radiance { rect, value: vec![], variance: vec![], used: vec![] };
        for y in rect.y..rect.y + rect.height {
            let k = whole.at(rect.x, y);
            part.value.extend(&whole.value[k..k + 3 * rect.width]);
            part.variance.extend(&whole.variance[k..k + 3 * rect.width]);
            part.used.extend(&whole.used[k..k + 3 * rect.width]);
        }
        extract(&part, &upright(), &dot(), &mut shared())
    };
    // A rectangle that the window's own asks for changes nothing.
    let grid = WindowGrid::new(&WINDOW, CENTER_MM, &upright());
    assert_eq!(crop(window_rect(&grid, SIZE_PX).unwrap()).0, row);
    // Cell i begins at 3.3 + 6.2 (4.3 + 0.5 (i − 4.5)) = 16.01 + 3.1 i px across and needs the 3 pixels before; cell j
    // at 15.29 + 3.7 j. The last ones end at 43.91 and 33.79 px and need pixels 47 and 37.
    let Rect { x, y, width, height } = whole.rect;
    let columns = |r: &Row| (0..9).filter(|i| r.valid[3 * (2 * 9 + i)]).collect::<Vec<_>>();
    let rows = |r: &Row| (0..5).filter(|j| r.valid[3 * (9 * j + 4)]).collect::<Vec<_>>();
    let all = |n: usize| (0..n).collect::<Vec<_>>();
    assert_eq!(crop(Rect { x: 13, y: 12, width: 35, height: 26 }).0, row);
    let (left, found) = crop(Rect { x: 14, y, width: width + x - 14, height });
    assert_eq!((columns(&left), rows(&left), found.clipped), (all(9)[1..].to_vec(), all(5), 5));
    let (top, found) = crop(Rect { x, y: 13, width, height: height + y - 13 });
    assert_eq!((columns(&top), rows(&top), found.clipped), (all(9), all(5)[1..].to_vec(), 9));
    let (right, found) = crop(Rect { x, y, width: 47 - x, height });
    assert_eq!((columns(&right), rows(&right), found.clipped), (all(8), all(5), 5));
    let (bottom, found) = crop(Rect { x, y, width, height: 37 - y });
    assert_eq!((columns(&bottom), rows(&bottom), found.clipped), (all(9), all(4), 9));
    // Those that are left are what they were.
    for part in [&left, &top, &right, &bottom] {
        for (k, at) in samples().filter(|(k, _)| part.valid[*k]) {
            assert_eq!(part.response[k], row.response[k], "{at:?}");
        }
    }
}

#[test]
fn a_pixel_that_was_not_measured_spoils_the_cells_that_need_it_in_its_own_channel() {
    let mut picture = seen(ramp);
    // In the picture, left of the middle and above it.
    let (x, y) = (24, 20);
    let k = picture.at(x, y);
    picture.used[k + 1] = 0;
    picture.value[k + 1] = 0.0;
    let (row, findings) = extract(&picture, &upright(), &dot(), &mut shared());
    let needs = |a: usize, pixel: f64, k: usize, count: usize| {
        let step = 0.5 * SCALE_PX[a];
        let start = ORIGIN_PX[a] + SCALE_PX[a] * CENTER_MM[a] + (k as f64 - count as f64 / 2.0) * step;
        // Pixels from 3 before the one at whose right the cell begins to 4 after the one where it ends.
        pixel >= start.floor() - 3.0 && pixel <= (start + step).floor() + 4.0
    };
    let mut spoilt = 0;
    for (k, (i, j, c)) in samples() {
        let hit = needs(0, x as f64, i, 9) && needs(1, y as f64, j, 5);
        assert_eq!(row.valid[k], !(hit && c == 1), "{:?}", (i, j, c));
        assert!(row.valid[k] || (row.response[k], row.variance[k]) == (0.0, 0.0));
        spoilt += usize::from(hit && c == 1);
    }
    // Three or four cells along each axis reach it.
    assert!(spoilt > 5 && findings == RowFindings { clipped: 0, saturated: spoilt }, "{findings:?} {spoilt}");
}

#[test]
fn each_channel_of_a_mosaic_is_read_where_it_was_measured() {
    let offsets: [Point; 3] = [[-0.25, 0.3], [0.2, 0.1], [0.35, -0.4]];
    // A pixel's value is the light at its offset from the pixel's centre.
    let mut picture = seen(|x, y, c| ramp(x + offsets[c][0], y + offsets[c][1], c));
    picture.variance.iter_mut().enumerate().for_each(|(k, v)| *v = [3.0, 50.0, 700.0][k % 3]);
    let mut weights = offsets.map(|o| CellWeights::sampled(3.4, 0.0, 1.0, o));
    let (row, _) = extract(&picture, &upright(), &dot(), &mut weights);
    for (k, (i, j, c)) in samples() {
        let [x, y] = cell_mm(i, j);
        let expected = ramp(SCALE_PX[0] * x + ORIGIN_PX[0], SCALE_PX[1] * y + ORIGIN_PX[1], c) / FLUX[c];
        assert_close(row.response[k], expected, (i, j, c));
        // Nine pixels or more share a cell, unevenly; channels differ tenfold, so a wrong channel shows.
        let share = f64::from(row.variance[k]) * FLUX[c].powi(2) / [3.0, 50.0, 700.0][c];
        assert!((0.06..0.2).contains(&share), "{:?} {share}", (i, j, c));
    }
    // Blue alone is not measured at one pixel, then green.
    for c in [2, 1] {
        let mut spoilt = picture.clone();
        let k = spoilt.at(30, 24);
        spoilt.used[k + c] = 0;
        let (row, findings) = extract(&spoilt, &upright(), &dot(), &mut weights);
        let gone = |of: usize| row.valid.iter().skip(of).step_by(3).filter(|v| !**v).count();
        assert_eq!([gone(0), gone(1), gone(2)].map(|n| n > 0), [0, 1, 2].map(|k| k == c));
        assert_eq!(findings.saturated, gone(c));
    }
}

#[test]
fn each_channel_of_a_mosaic_is_what_its_own_weights_alone_make_of_it() {
    let mut weights = [[-0.45, 0.3], [0.2, 0.1], [0.4, -0.45]].map(|o| CellWeights::sampled(3.4, 0.0, 1.0, o));
    // A pixel that was not measured, in turn where the stencils of some channels end and those of others do not.
    for (x, y) in [(16, 20), (19, 23), (22, 18), (26, 21), (30, 24), (31, 27), (34, 19), (38, 25)] {
        let mut picture = noisy(seen(texture), 20.0);
        let k = picture.at(x, y);
        picture.used[k..k + 3].fill(0);
        let (row, _) = extract(&picture, &upright(), &dot(), &mut weights);
        for c in 0..3 {
            let (alone, _) = extract(&picture, &upright(), &dot(), &mut weights[c..=c]);
            let of = |row: &Row| {
                let mine = |k: &usize| k % 3 == c;
                (0..135).filter(mine).map(|k| (row.response[k], row.variance[k], row.valid[k])).collect::<Vec<_>>()
            };
            assert_eq!(of(&row), of(&alone), "{x} {y} {c}");
        }
    }
}

#[test]
fn without_weights_nothing_is_measured() {
    let (row, findings) = extract(&seen(ramp), &upright(), &dot(), &mut []);
    assert!(row.valid.iter().all(|v| !v) && findings == RowFindings { clipped: 45, saturated: 0 });
}

#[test]
fn a_windows_rectangle_holds_its_corners_and_five_pixels_more() {
    let rect =
        |center_mm: Point, size_px: [usize; 2]| window_rect(&WindowGrid::new(&WINDOW, center_mm, &upright()), size_px);
    // Corners at 3.3 + 6.2 (x ± 2.25) and 1.6 + 7.4 (y ± 1.25) px: of (4.3, 3.1) 16.01 to 43.91 and 15.29 to 33.79.
    assert_eq!(rect([4.3, 3.1], SIZE_PX), Some(Rect { x: 11, y: 10, width: 39, height: 30 }));
    // Cut on the right and below, then on the left and above: 3.3 + 6.2 · 3.75 is 26.55, 1.6 + 7.4 · 2.25 is 18.25.
    assert_eq!(rect([4.3, 3.1], [43, 36]), Some(Rect { x: 11, y: 10, width: 32, height: 26 }));
    assert_eq!(rect([1.5, 1.0], SIZE_PX), Some(Rect { x: 0, y: 0, width: 33, height: 25 }));
    // Beyond each side, and with one column or row left of it.
    assert_eq!(rect([4.3, 3.1], [11, 47]), None);
    assert_eq!(rect([4.3, 3.1], [12, 47]).map(|r| (r.x, r.width)), Some((11, 1)));
    assert_eq!(rect([4.3, 3.1], [61, 10]), None);
    assert_eq!(rect([4.3, 3.1], [61, 11]).map(|r| (r.y, r.height)), Some((10, 1)));
    assert_eq!(rect([-4.0, 3.1], SIZE_PX), None);
    assert_eq!(rect([4.3, -3.0], SIZE_PX), None);
}
