use super::*;
use crate::capture::Rect;

const SIZE: [usize; 2] = [160, 140];
const DOTS: [[f64; 2]; 3] = [[62.0, 70.0], [75.5, 66.0], [84.0, 75.0]];

/// Three spots with tails, in the middle of a round sample.
fn light(x: f64, y: f64) -> f64 {
    if (x - 75.0).hypot(y - 70.0) > 30.0 {
        return 0.0;
    }
    DOTS.iter().map(|d| 1000.0 * (-(x - d[0]).hypot(y - d[1]) / 2.0).exp()).sum()
}

/// The same with a halo of a single Gaussian, summed pixel by pixel.
fn picture(share: f64, radius_px: f64) -> Radiance {
    let n = SIZE[0] * SIZE[1];
    let at = |k: usize| ((k % SIZE[0]) as f64, (k / SIZE[0]) as f64);
    let bright: Vec<(f64, f64, f64)> =
        (0..n).map(at).map(|(x, y)| (x, y, light(x, y))).filter(|p| p.2 > 1e-3).collect();
    let seen = |k: usize| {
        let (x, y) = at(k);
        let halo = |p: &(f64, f64, f64)| {
            let r2 = (x - p.0).powi(2) + (y - p.1).powi(2);
            p.2 * (-0.5 * r2 / radius_px.powi(2)).exp() / (std::f64::consts::TAU * radius_px.powi(2))
        };
        (1.0 - share) * light(x, y) + if share > 0.0 { share * bright.iter().map(halo).sum::<f64>() } else { 0.0 }
    };
    let value: Vec<f32> = (0..n).flat_map(|k| [seen(k) as f32; 3]).collect();
    let rect = Rect { x: 0, y: 0, width: SIZE[0], height: SIZE[1] };
    Radiance { rect, variance: vec![1e-10; value.len()], used: vec![1; value.len()], value }
}

fn dark() -> Vec<bool> {
    (0..SIZE[0] * SIZE[1]).map(|k| light((k % SIZE[0]) as f64, (k / SIZE[0]) as f64) == 0.0).collect()
}

#[test]
fn a_halo_is_found_on_the_frame_and_taken_out_of_the_sample() {
    for radius_px in [17.0, 20.0, 30.0] {
        let seen = picture(0.02, radius_px);
        let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark(), None).unwrap();
        // Radii between those tried are mixtures: the shape's stated error.
        assert!((found.share / 0.02 - 1.0).abs() < 2.0 * SHAPE_SD, "{radius_px}: {found:?}");
        assert!(found.share_sd >= 0.1 * found.share, "a tenth of it at the least: {found:?}");
        let mut windows = vec![seen];
        found.remove(&mut windows, SIZE);
        let middle = windows[0].at(70, 80);
        let (before, after, truth) =
            (picture(0.02, radius_px).value[middle], windows[0].value[middle], light(70.0, 80.0) as f32);
        // Three stated errors of the shape: where the frame does not see the halo, its radii are a guess.
        assert!(
            (after - truth).abs() < 3.0 * SHAPE_SD as f32 * (before - truth).abs(),
            "{radius_px}: {before} {after} {truth}"
        );
    }
}

#[test]
fn without_a_halo_nothing_is_taken_out() {
    let seen = picture(0.0, 20.0);
    let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark(), None).unwrap();
    assert!(found.halos.is_empty(), "{found:?}");
    let mut windows = vec![seen.clone()];
    found.remove(&mut windows, SIZE);
    assert_eq!(windows[0], seen);
}

/// What the projector's black makes of frame and sample: brighter to the left, a picture of the lamp at its mean.
fn black_light() -> Radiance {
    let mut ambient = picture(0.0, 20.0);
    for (k, value) in ambient.value.iter_mut().enumerate() {
        *value = 1.0 - 0.002 * (k / 3 % SIZE[0]) as f32;
    }
    ambient
}

#[test]
fn black_light_that_changes_with_the_lamp_is_no_halo_and_hides_none() {
    let ambient = black_light();
    for share in [0.0, 0.02] {
        let flickers = |by: f32| {
            let mut seen = picture(share, 20.0);
            seen.value.iter_mut().zip(&ambient.value).for_each(|(v, a)| *v += by * a);
            seen
        };
        let pictures = [0.012, -0.006, 0.009, 0.002].map(flickers);
        let found = StrayLight::estimate(&pictures, &dark(), Some((&ambient, 0.01))).unwrap();
        // The shape's stated error, and nothing of the light that changes.
        assert!((found.share - share).abs() <= 2.0 * SHAPE_SD * share, "{share}: {found:?}");
        let steady = StrayLight::estimate(&pictures, &dark(), None).unwrap();
        assert!(share > 0.0 || steady.share > 0.0 || steady.even.is_some(), "taken for something: {steady:?}");
    }
}

#[test]
fn a_part_of_the_halo_that_alone_is_not_significant_is_left_out() {
    // Three blocks see the narrowest part; errors of one.
    let rows = |excess: f64| -> Vec<Weighted> {
        let row = |i: usize| {
            // The others have a block each, in which nothing is seen.
            let mut halos = std::array::from_fn(|k| if i == 20 + k { 0.01 } else { 0.0 });
            (halos[0], halos[3]) = (if i < 3 { 1.0 } else { 0.0 }, 10.0 / (1.0 + i as f64).sqrt());
            (halos, 2.0 * halos[3] + excess * halos[0])
        };
        (0..60).map(row).collect()
    };
    // Beside the other, by the inverse of the normal matrix, a standard deviation of .73: 2.1 and 5.5 of them.
    let (shares, _) = non_negative(&rows(1.5), SIGNIFICANCE).unwrap();
    assert!(shares[0] == 0.0 && (shares[3] - 2.0).abs() < 0.3, "{shares:?}");
    let (shares, _) = non_negative(&rows(4.0), SIGNIFICANCE).unwrap();
    assert!((shares[0] - 4.0).abs() < 1e-9 && (shares[3] - 2.0).abs() < 1e-9, "{shares:?}");
}

#[test]
fn a_lit_dot_on_the_frame_is_no_halo() {
    let mut seen = picture(0.0, 20.0);
    for (x, y) in [(20, 20), (21, 20), (20, 21), (140, 30), (140, 31), (141, 31)] {
        let k = seen.at(x, y);
        seen.value[k..k + 3].fill(300.0);
    }
    let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark(), None).unwrap();
    assert!(found.halos.is_empty(), "{found:?}");
}

#[test]
fn too_little_of_the_frame_tells_nothing() {
    assert!(StrayLight::estimate(&[picture(0.0, 20.0)], &vec![false; SIZE[0] * SIZE[1]], None).is_none());
    assert!(StrayLight::estimate(&[], &dark(), None).is_none());
    let mut unmeasured = picture(0.0, 20.0);
    unmeasured.used.fill(0);
    assert!(StrayLight::estimate(&[unmeasured], &dark(), None).is_none());
}

/// An even picture at (3, 2) of three channels, in two rectangles that overlap.
fn even(value: [f32; 3], variance: [f32; 3]) -> Vec<Radiance> {
    let part = |x: usize, width: usize| {
        let rect = Rect { x, y: 2, width, height: 80 };
        let n = rect.area();
        Radiance { rect, value: value.repeat(n), variance: variance.repeat(n), used: vec![1; 3 * n] }
    };
    vec![part(3, 60), part(50, 57)]
}

#[test]
fn what_is_taken_out_leaves_an_even_picture_even_and_its_doubt_in_the_variance() {
    let (value, variance) = ([400.0f32, 90.0, 2000.0], [0.5f32, 30.0, 0.01]);
    let halos = vec![Halo { radius_px: 6.0, share: 0.03 }, Halo { radius_px: 8.5, share: 0.01 }];
    let stray = StrayLight { halos, share: 0.04, share_sd: 0.012, even: None };
    let mut seen = even(value, variance);
    stray.remove(&mut seen, [110, 84]);
    // Far from the rims the halo is as bright as the picture, 0.04 of it, and that is known to 0.3 of itself.
    for (picture, x, y) in [(&seen[0], 55, 42), (&seen[1], 55, 42), (&seen[1], 60, 40)] {
        let k = picture.at(x, y);
        for c in 0..3 {
            // A Gaussian that is cut at 5 standard deviations, in f32.
            assert!((picture.value[k + c] / value[c] - 1.0).abs() < 1e-4, "{c}: {}", picture.value[k + c]);
            let halo = 0.04 * value[c];
            let expected = (variance[c] + 0.09 * halo * halo) / (0.96 * 0.96);
            assert!(
                (picture.variance[k + c] / expected - 1.0).abs() < 1e-3,
                "{c}: {} {expected}",
                picture.variance[k + c]
            );
        }
    }
    // In the middle of the left rim half of the halo is there: (1 − 0.02) / 0.96.
    let k = seen[0].at(3, 42);
    for c in 0..3 {
        // Blocks of 1 and 2 px are not quite at the rim.
        assert!((seen[0].value[k + c] / value[c] - 0.98 / 0.96).abs() < 3e-3, "{}", seen[0].value[k + c]);
    }
}

#[test]
fn dark_blocks_have_the_mean_of_their_pixels_and_its_variance() {
    let rect = Rect { x: 2, y: 1, width: 9, height: 6 };
    let at = |k: usize| ((2 + k / 3 % 9) as f32, (1 + k / 27) as f32, (k % 3) as f32);
    let value = |k: usize| at(k).0 + 10.0 * at(k).1 + 100.0 * at(k).2;
    let n = 3 * rect.area();
    let mut picture = Radiance {
        rect,
        value: (0..n).map(value).collect(),
        variance: (0..n).map(|k| at(k).2 + 1.0).collect(),
        used: vec![1; n],
    };
    let mut dark = vec![true; 54];
    let found = dark_blocks(&picture, &dark);
    // Columns 2 to 5 and 6 to 9, rows 1 to 4; the mean of x, 10 y and 0, 100, 200.
    let expected = [([3.5, 2.5], 3.5 + 25.0 + 100.0), ([7.5, 2.5], 7.5 + 25.0 + 100.0)];
    assert_eq!(found.iter().map(|b| (b.0, b.1)).collect::<Vec<_>>(), expected);
    // (1 + 2 + 3) / 9 of a pixel, a sixteenth of that of the mean of 16; f64.
    assert!(found.iter().all(|b| (b.2 - 6.0 / 9.0 / 16.0).abs() < 1e-12), "{found:?}");
    // Pixel (5, 4) is lit; (6, 1) was not measured in green.
    dark[3 * 9 + 3] = false;
    assert_eq!(dark_blocks(&picture, &dark).len(), 1);
    let k = picture.at(6, 1);
    picture.used[k + 1] = 0;
    assert!(dark_blocks(&picture, &dark).is_empty());
}

#[test]
fn shares_are_those_of_least_squares_and_never_negative() {
    // Two halos that a block sees alone: 0.02 of the first, and the second comes out negative.
    let row = |k: usize, light: f64, seen: f64| {
        let mut halos = [0.0; RADII_PX.len()];
        halos[k] = light;
        // The others are seen a little, each in a way of its own.
        (halos, seen)
    };
    let mut rows: Vec<Weighted> = (0..RADII_PX.len()).map(|k| row(k, 100.0, 0.1 * k as f64)).collect();
    rows.push(row(3, 50.0, 0.3));
    let (shares, sd) = non_negative(&rows, 0.0).unwrap();
    for (k, share) in shares.iter().enumerate() {
        // (100 · 0.3 + 50 · 0.3) / 12,500 for the fourth.
        let expected = if k == 3 { 45.0 / 12_500.0 } else { 1e-3 * k as f64 };
        assert!((share - expected).abs() < 1e-12, "{k}: {share} {expected}");
    }
    // Independent: 8 of 1/100² and one of 1/12,500; the residual is below that of the noise.
    assert!((sd - (8e-4f64 + 1.0 / 12_500.0).sqrt()).abs() < 1e-9, "{sd}");
    rows[5].1 = -3.0;
    let (shares, _) = non_negative(&rows, 0.0).unwrap();
    assert_eq!(shares[5], 0.0);
    assert!((shares[8] - 8e-3).abs() < 1e-12);
}

#[test]
fn what_is_painted_is_the_mean_over_blocks_where_pictures_overlap_once() {
    let rect = |x, y, width, height| Rect { x, y, width, height };
    let picture = |rect: Rect, of: usize| {
        let n = 3 * rect.area();
        let value = (0..n).map(|k| ((k * 31 + 7 * of) % 97) as f32).collect();
        Radiance { rect, value, variance: vec![1.0; n], used: vec![1; n] }
    };
    let (a, b) = (picture(rect(2, 1, 11, 9), 1), picture(rect(8, 4, 13, 12), 2));
    for pictures in [vec![&a], vec![&a, &b]] {
        // Radius 12: blocks of 3 px; 23 × 17 px are 8 × 6 of them.
        let coarse = Coarse::paint(&pictures, [23, 17], 12.0);
        assert_eq!((coarse.block_px, coarse.size), (3, [8, 6]));
        let mut expected = vec![[0.0; 3]; 48];
        for y in 0..17 {
            for x in 0..23 {
                let covers = |p: &&&Radiance| {
                    let r = p.rect;
                    (r.x..r.x + r.width).contains(&x) && (r.y..r.y + r.height).contains(&y)
                };
                if let Some(first) = pictures.iter().find(covers) {
                    let k = 3 * ((y - first.rect.y) * first.rect.width + x - first.rect.x);
                    (0..3).for_each(|c| expected[y / 3 * 8 + x / 3][c] += first.value[k + c] / 9.0);
                }
            }
        }
        for (found, expected) in coarse.value.iter().zip(&expected) {
            // Nine numbers up to 97 in f32.
            assert!((0..3).all(|c| (found[c] - expected[c]).abs() < 1e-4), "{found:?} {expected:?}");
        }
    }
}

#[test]
fn a_halo_is_the_sum_over_all_blocks_weighted_by_their_distance_and_nothing_beyond_the_picture() {
    let size = [9, 5];
    let value: Vec<[f32; 3]> = (0..45).map(|k| [0, 1, 2].map(|c| ((k * 13 + c * 5) % 17) as f32)).collect();
    let coarse = Coarse { block_px: 2, size, value: value.clone() };
    let blurred = coarse.blurred(5.0);
    assert_eq!((blurred.block_px, blurred.size), (2, size));
    // In blocks of 2 px; blocks and the interpolation between them are a quarter of a block squared by themselves.
    let variance = (25.0 - 0.25 * 4.0) / 4.0;
    let weight = |d: f64| f64::exp(-0.5 * d * d / variance);
    // Five standard deviations of 2.45 blocks.
    let all: f64 = (-13..=13).map(|k| weight(f64::from(k))).sum();
    for y in 0..5 {
        for x in 0..9 {
            for c in 0..3 {
                let part = |k: usize| {
                    let d = [(k % 9) as f64 - x as f64, (k / 9) as f64 - y as f64];
                    weight(d[0]) * weight(d[1]) / (all * all) * f64::from(value[k][c])
                };
                let expected: f64 = (0..45).map(part).sum();
                let found = f64::from(blurred.value[y * 9 + x][c]);
                // Sums of 45 numbers in f32.
                assert!((found / expected - 1.0).abs() < 1e-5, "{x} {y} {c}: {found} {expected}");
            }
        }
    }
}

#[test]
fn between_the_middles_of_blocks_a_plane_is_a_plane_and_beyond_the_last_it_ends() {
    let plane = |x: f64, y: f64, c: usize| [3.0 + 2.0 * x - 5.0 * y, 100.0 - x + 0.5 * y, 7.0 * x + 11.0 * y][c];
    let coarse = |size: [usize; 2]| {
        let of = |k: usize| [0, 1, 2].map(|c| plane((k % size[0]) as f64, (k / size[0]) as f64, c) as f32);
        Coarse { block_px: 3, size, value: (0..size[0] * size[1]).map(of).collect() }
    };
    for size in [[6, 4], [1, 4], [6, 1], [1, 1]] {
        let coarse = coarse(size);
        for at in [[1.0, 1.0], [4.0, 7.0], [5.5, 2.2], [8.3, 9.9], [16.0, 10.0], [0.0, 3.0], [17.0, 11.0], [-4.0, 90.0]]
        {
            // The middle of block k is pixel 3 k + 1.
            let place = |a: usize| ((at[a] - 1.0) / 3.0_f64).clamp(0.0, (size[a] - 1) as f64);
            for c in 0..3 {
                let (found, expected) = (f64::from(coarse.at(at)[c]), plane(place(0), place(1), c));
                // f32.
                assert!((found - expected).abs() < 1e-4, "{size:?} {at:?} {c}: {found} {expected}");
            }
        }
    }
}

/// A block that sees 100 of halo `k` alone.
fn alone(k: usize) -> [f64; RADII_PX.len()] {
    std::array::from_fn(|j| if j == k { 100.0 } else { 0.0 })
}

/// Blocks that see 100 of the first halo and a hundredth of it, off by so much; and one for each of the others, where
/// nothing is.
fn rows_off(by: impl Iterator<Item = f64>) -> Vec<Weighted> {
    by.map(|off| (alone(0), 1.0 + off)).chain((1..RADII_PX.len()).map(|k| (alone(k), 0.0))).collect()
}

#[test]
fn a_block_that_is_off_by_five_times_what_most_are_is_left_out_and_thirty_must_stay() {
    let fitted = |usual: f64, one: f64| {
        let even = (0..40).map(|k| if k % 2 == 0 { usual } else { -usual });
        100.0 * fit_without_outliers(rows_off(even.chain([one]))).unwrap().0[0]
    };
    // The mean of the 41 is off by a 41st of the one. What most are off by is less than the noise, 1: 5 · 41/40 is the
    // limit.
    for (usual, one) in [(0.5, 5.1), (0.5, 5.15), (0.5, -5.1), (0.5, -5.15)] {
        let kept = (one * 40.0 / 41.0_f64).abs() <= 5.0;
        let expected = if kept { 1.0 + one / 41.0 } else { 1.0 };
        assert!((fitted(usual, one) - expected).abs() < 1e-9, "{one}: {}", fitted(usual, one));
    }
    // Above the noise the limit is 5 · 1.4826 times the median of the 49 residuals: 8 zeros, 20 of 2 − x/41, 20 of 2 +
    // x/41, and x · 40/41 of the outlier x. The median is 2 − x/41; x · 40/41 = 7.413 (2 − x/41) gives x = 12.82.
    assert!((fitted(2.0, 12.6) - (1.0 + 12.6 / 41.0)).abs() < 1e-9, "{}", fitted(2.0, 12.6));
    assert!((fitted(2.0, 13.05) - 1.0).abs() < 1e-9, "{}", fitted(2.0, 13.05));
    // With the 8 others.
    assert!(fit_without_outliers(rows_off((0..21).map(|_| 0.0))).is_none());
    assert!(fit_without_outliers(rows_off((0..22).map(|_| 0.0))).is_some());
    assert!(fit_without_outliers(rows_off((0..22).map(|k| if k == 7 { 99.0 } else { 0.0 }))).is_none());
}

#[test]
fn residuals_beyond_the_noise_make_the_share_less_certain() {
    // Ten blocks for each of 9 halos, off by ±3 noises: 9 · 90 over 81 degrees of freedom are 10 times the noise's
    // variance.
    let rows: Vec<Weighted> = (0..90).map(|k| (alone(k / 10), if k % 2 == 0 { 4.0 } else { -2.0 })).collect();
    let (shares, sd) = non_negative(&rows, 0.0).unwrap();
    assert!(shares.iter().all(|s| (s - 0.01).abs() < 1e-12), "{shares:?}");
    // Each share has a variance of 10 / (10 · 100²).
    assert!((sd - (9.0 * 10.0 / (10.0 * 1e4_f64)).sqrt()).abs() < 1e-12, "{sd}");
}

#[test]
fn a_share_is_taken_out_from_four_deviations_and_two_ten_thousandths_of_the_light_on() {
    assert!(is_believed(0.0401, 0.01) && !is_believed(0.0399, 0.01));
    // 2e-4, however well it is known.
    assert!(is_believed(2.01e-4, 1e-9) && !is_believed(1.99e-4, 1e-9));
    assert!(is_believed(0.499, 1e-3) && !is_believed(0.501, 1e-3) && !is_believed(f64::NAN, 1e-3));
}
