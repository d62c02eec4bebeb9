use super::*;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal, Poisson};
use rand_pcg::Pcg64Mcg;

const GAIN: f64 = 0.5;
const READ: f64 = 6.0;
const BLACK: f64 = 256.0;
const SIDE: usize = 192;

/// A white board under blurred stripes, with photosites that differ by a hundredth and a lamp that flickers.
fn stripes(electrons: f64, period: usize, along: usize, pattern: &[f64], rng: &mut Pcg64Mcg) -> Samples {
    let read = Normal::new(0.0, READ).unwrap();
    let lamp = 1.0 + 0.005 * rng.random_range(-1.0..1.0);
    let code = |k: usize| {
        let at = [k / 3 % SIDE, k / 3 / SIDE];
        let phase = (at[along] % (2 * period)) as f64 - period as f64;
        // Lit for negative phases; a ramp of 6 px stands for the blur.
        let lit = (0.5 - phase / 6.0).clamp(0.0, 1.0).min((0.5 + (phase + period as f64) / 6.0).clamp(0.0, 1.0));
        let falloff = 1.0 - 0.2 * (at[0] as f64 / SIDE as f64);
        let mean = electrons * lamp * falloff * pattern[k] * (0.0005 + lit);
        (BLACK + GAIN * (Poisson::new(mean).unwrap().sample(rng) + read.sample(rng))).round() as u16
    };
    Samples::U16((0..3 * SIDE * SIDE).map(code).collect())
}

#[test]
fn gain_and_read_noise_come_from_pairs_that_show_different_stripes() {
    let mut rng = Pcg64Mcg::seed_from_u64(1);
    let pattern: Vec<f64> = (0..3 * SIDE * SIDE).map(|_| 1.0 + 0.01 * rng.random_range(-1.7..1.7)).collect();
    let mut grids = Vec::new();
    for electrons in [4e3, 16e3] {
        let a = stripes(electrons, 64, 0, &pattern, &mut rng);
        let b = stripes(electrons, 48, 1, &pattern, &mut rng);
        grids.push(blocks([&a, &b], SIDE, BLACK, 16_000.0, [1.0; 3]));
    }
    let found = fit(&grids, (BLACK, 0.05), (16_000.0, true), 1.0 / 12.0).unwrap();
    let noise = &found.noise;
    // The fit's own standard deviations are a half and one per cent; three of each.
    assert!((noise.gain_dn_per_electron / GAIN - 1.0).abs() < 0.015, "{found:?}");
    assert!((noise.read_noise_electrons / READ - 1.0).abs() < 0.03, "{found:?}");
    assert!((noise.gain_dn_per_electron - GAIN).abs() < 3.0 * found.gain_sd, "{found:?}");
    assert!((noise.read_noise_electrons - READ).abs() < 3.0 * found.read_noise_sd, "{found:?}");
}

#[test]
fn photographs_that_share_no_dark_or_no_light_are_refused_in_words() {
    let even = Samples::U16(vec![1000; 3 * SIDE * SIDE]);
    let grid = blocks([&even, &even], SIDE, BLACK, 16_000.0, [1.0; 3]);
    assert!(fit(&[grid], (BLACK, 0.1), (16_000.0, true), 1.0 / 12.0).unwrap_err().contains("blocks"));
    let full = Samples::U16(vec![16_383; 3 * SIDE * SIDE]);
    let grid = blocks([&full, &full], SIDE, BLACK, 16_000.0, [1.0; 3]);
    assert!(fit(&[grid], (BLACK, 0.1), (16_000.0, true), 1.0 / 12.0).is_err());
}

#[test]
fn the_black_level_is_found_beneath_ambient_light_and_wrong_shutter_times() {
    // Two shots with different light; nominal times err by up to 2 %.
    let shot = |rate: f64| -> DarkLevels {
        let of = |(k, error): (i32, f64)| {
            let t = 0.004 * 4f64.powi(k);
            (t, 512.3 + rate * t * (1.0 + error))
        };
        [(0, 0.01), (1, -0.02), (2, 0.015), (3, -0.01), (4, 0.02)].map(of).to_vec()
    };
    let (black, sd) = black_level(&[shot(700.0), shot(400.0)]).unwrap();
    assert!((black - 512.3).abs() < 3.0 * sd && sd < 0.2, "{black} ± {sd}");
    assert_eq!(black_level(&[vec![(0.1, 515.0)], vec![(0.2, 514.0)]]), None, "one exposure each says nothing");
}

#[test]
fn saturation_is_where_codes_pile_up_and_not_just_the_largest() {
    let mut histogram = vec![0u32; 1 << 16];
    histogram[600..12_000].fill(3);
    let open = [histogram.clone(), histogram.clone(), histogram.clone()];
    assert_eq!(saturation(&open), (12_000.0, false));
    histogram[15_300] = 400;
    let clipped = [open[0].clone(), histogram, open[2].clone()];
    assert_eq!(saturation(&clipped), ((15_300.0f64 * 0.98).round(), true));
}

/// Two photographs of 2 × 3 blocks and three columns more, 19 × 24 px, that differ by `difference(x, y, c)` about
/// `level`.
fn pair(level: impl Fn(usize, usize, usize) -> f64, difference: impl Fn(usize, usize, usize) -> f64) -> [Samples; 2] {
    let at = |k: usize| (k / 3 % 19, k / 57, k % 3);
    [0.5, -0.5].map(|half| {
        let code = |k: usize| {
            let (x, y, c) = at(k);
            (level(x, y, c) + half * difference(x, y, c)) as f32
        };
        Samples::F32((0..57 * 24).map(code).collect())
    })
}

/// Alternates like a chessboard, which holds nothing of a plane.
fn chess(x: usize, y: usize) -> f64 {
    if (x + y).is_multiple_of(2) { 1.0 } else { -1.0 }
}

#[test]
fn a_blocks_variance_is_half_that_of_its_difference_without_a_plane() {
    // Another level and another noise in each block and channel; slopes of light that both do not share.
    let number = |x: usize, y: usize, c: usize| (3 * (2 * (y / 8) + x / 8) + c) as f64;
    let level = |x: usize, y: usize, c: usize| 400.0 + 10.0 * number(x, y, c);
    let difference = |x: usize, y: usize, c: usize| {
        (2.0 + number(x, y, c)) * chess(x, y) + 0.5 * x as f64 - 0.75 * y as f64 + 3.0 * c as f64
    };
    let [a, b] = pair(level, difference);
    let grid = blocks([&a, &b], 19, 256.0, 16_000.0, [1.0, 0.5, 0.25]);
    assert_eq!((grid.size, grid.blocks.len()), ([2, 3], 18));
    for (k, block) in grid.blocks.iter().enumerate() {
        let (block, c) = (block.unwrap(), k % 3);
        // Σ (2 + k)² over 64 pixels; 61 degrees of freedom are left; half of it is one photograph's.
        let expected = (2.0 + k as f64).powi(2) * 64.0 / 61.0 / 2.0 / [1.0, 0.5, 0.25][c];
        // Whole and quarter numbers: f64.
        assert!((block.variance / expected - 1.0).abs() < 1e-9, "{k}: {} {expected}", block.variance);
        assert!((block.mean - (400.0 + 10.0 * k as f64)).abs() < 1e-9, "{k}: {}", block.mean);
    }
}

#[test]
fn blocks_that_saturate_hold_no_light_or_show_different_light_are_left_out_one_by_one() {
    let with = |change: &dyn Fn(&mut [f32], &mut [f32])| {
        let [a, b] = pair(|_, _, _| 500.0, |x, y, _| 4.0 * chess(x, y));
        let (Samples::F32(mut a), Samples::F32(mut b)) = (a, b) else { panic!() };
        change(&mut a, &mut b);
        let grid = blocks([&Samples::F32(a), &Samples::F32(b)], 19, 256.0, 1000.0, [1.0; 3]);
        (0..18).filter(|&k| grid.blocks[k].is_none()).collect::<Vec<_>>()
    };
    // Pixel (9, 17), green, is in block (1, 2): the 16th of the list.
    let k = 3 * (17 * 19 + 9) + 1;
    assert_eq!(with(&|_, _| ()), [0; 0]);
    for value in [1000.0, f32::INFINITY, f32::NAN, f32::NEG_INFINITY] {
        assert_eq!(with(&|a, _| a[k] = value), [16], "{value}");
        assert_eq!(with(&|_, b| b[k] = value), [16], "{value}");
    }
    assert_eq!(with(&|a, b| (a[k], b[k]) = (999.5, 999.5)), [0; 0]);
    // Columns beyond the last whole block belong to none.
    assert_eq!(with(&|a, _| a[3 * (17 * 19 + 17)] = 1000.0), [0; 0]);
    // A tenth of 500 − 256 more, and five standard deviations of the mean's difference (4 · √(64/61 / 64) is 0.51).
    // The mean itself moves by half: limits are 28.4 up and 25.7 down.
    let shift = |by: f32| with(&|a, _| a.iter_mut().skip(2).step_by(3).for_each(|v| *v += by));
    assert_eq!(shift(28.2), [0; 0]);
    assert_eq!(shift(-25.5), [0; 0]);
    assert_eq!(shift(28.6), [2, 5, 8, 11, 14, 17]);
    assert_eq!(shift(-25.9), [2, 5, 8, 11, 14, 17]);
}

#[test]
fn code_zero_is_clipped_in_whole_numbers_and_nothing_special_in_floating_point() {
    let of = |a: Samples, b: Samples| {
        blocks([&a, &b], 8, 0.0, 200.0, [1.0; 3]).blocks.iter().map(Option::is_some).collect::<Vec<_>>()
    };
    let mut whole = vec![20u16; 192];
    whole[4] = 0;
    assert_eq!(of(Samples::U16(whole.clone()), Samples::U16(vec![20; 192])), [true, false, true]);
    assert_eq!(of(Samples::U16(vec![20; 192]), Samples::U16(whole.clone())), [true, false, true]);
    assert_eq!(
        of(Samples::U8(whole.iter().map(|&v| v as u8).collect()), Samples::U8(vec![20; 192])),
        [true, false, true]
    );
    let float = |v: Vec<u16>| Samples::F32(v.into_iter().map(f32::from).collect());
    assert_eq!(of(float(whole), float(vec![20; 192])), [true; 3]);
    // Narrower or lower than a block: none.
    assert!(blocks([&float(vec![20; 168]), &float(vec![20; 168])], 7, 0.0, 200.0, [1.0; 3]).blocks.is_empty());
    assert!(blocks([&float(vec![]), &float(vec![])], 0, 0.0, 200.0, [1.0; 3]).blocks.is_empty());
}

#[test]
fn the_black_level_of_two_exposures_is_where_their_line_begins() {
    // A line through two points is exact, and its height at 0 has the variance of both, by their times.
    let line = |[t1, y1]: [f64; 2], [t2, y2]: [f64; 2]| {
        let black = (y1 * t2 - y2 * t1) / (t2 - t1);
        let variance = |y: f64| 0.02f64.powi(2) + (0.02 * (y - black)).powi(2);
        (black, (t2 * t2 * variance(y1) + t1 * t1 * variance(y2)) / (t2 - t1).powi(2))
    };
    let (a, b) = ([[0.1, 515.0], [0.7, 560.0]], [[0.2, 509.13], [0.3, 509.9]]);
    let mut both = (0.0, 0.0);
    for [first, second] in [a, b] {
        let (black, variance) = line(first, second);
        let found = black_level(&[vec![(first[0], first[1]), (second[0], second[1])], vec![(9.0, 1e9)]]).unwrap();
        assert!((found.0 - black).abs() < 1e-6 && (found.1 / variance.sqrt() - 1.0).abs() < 1e-3, "{found:?} {black}");
        both = (both.0 + black / variance, both.1 + 1.0 / variance);
    }
    // Together: by inverse variances, which the common level changes a little.
    let shots = [a, b].map(|s| s.map(|[t, y]| (t, y)).to_vec());
    let (black, sd) = black_level(&shots).unwrap();
    assert!(
        (black - both.0 / both.1).abs() < 0.05 * sd && (sd * both.1.sqrt() - 1.0).abs() < 0.03,
        "{black} {sd} {both:?}"
    );
    assert_eq!(black_level(&[]), None);
    assert_eq!(black_level(&[vec![(0.0, 512.0), (0.0, 513.0)]]), None);
}

#[test]
fn a_pile_of_codes_is_sixteen_at_least_and_eight_times_those_just_below() {
    let of = |top: usize, pile: u32, below: u32| {
        let mut histogram = vec![0; 5000];
        histogram[..top].fill(below);
        histogram[top] = pile;
        clipping_code(&[vec![0; 5000], histogram, vec![1; 30]])
    };
    assert_eq!(of(4000, 16, 1), Some(4000));
    assert_eq!(of(4000, 15, 1), None);
    assert_eq!(of(4000, 80, 10), None);
    assert_eq!(of(4000, 81, 10), Some(4000));
    // A hundredth of the codes below: none of 99.
    assert_eq!((of(100, 900, 1), of(99, 900, 1)), (Some(100), None));
    // Only the hundredth below counts, and all of it.
    let mut histogram = vec![1000; 4000];
    histogram[3961..4000].fill(0);
    histogram.push(200);
    assert_eq!(clipping_code(&[histogram.clone(), vec![], vec![]]), None, "a mean of 25");
    histogram[3960] = 0;
    assert_eq!(clipping_code(&[histogram.clone(), vec![], vec![]]), Some(4000));
    // The least of the channels.
    let mut lower = histogram.clone();
    lower.truncate(3001);
    lower[2970..3000].fill(0);
    assert_eq!(clipping_code(&[histogram, vec![], lower]), Some(3000));
    assert_eq!(saturation(&[vec![0; 300], vec![0; 300], vec![1; 200]]), (200.0, false));
    assert_eq!(saturation(&[vec![], vec![], vec![]]), (1.0, false));
}

/// A grid of 12 × 8 blocks on a line of variance over level, a third of them dark.
fn on_line(at_black: f64, slope: f64) -> BlockGrid {
    let block = |k: usize| {
        let level = if k % 3 == 2 { 2.0 + (k % 7) as f64 } else { 100.0 + 3.0 * k as f64 };
        Some(Block { mean: 256.0 + level, variance: at_black + slope * level })
    };
    BlockGrid { size: [12, 8], blocks: (0..288).map(block).collect() }
}

#[test]
fn gain_and_read_noise_are_slope_and_height_of_the_line_with_the_errors_of_least_squares() {
    let (at_black, slope) = (30.0, 0.45);
    let grid = on_line(at_black, slope);
    let found = fit(std::slice::from_ref(&grid), (256.0, 0.3), (4000.0, true), 1.0 / 12.0).unwrap();
    let (noise, read) = (&found.noise, (at_black - 1.0 / 12.0).sqrt() / slope);
    assert_eq!((noise.black_dn, noise.saturation_dn, found.saturation_seen, found.blocks), (256.0, 4000.0, true, 288));
    // On the line itself: f64.
    assert!(
        (noise.gain_dn_per_electron - slope).abs() < 1e-9 && (noise.read_noise_electrons - read).abs() < 1e-8,
        "{found:?}"
    );
    // A variance v of 61 degrees of freedom has variance 2 v² / 61.
    let mut s = [0.0; 3];
    for b in grid.blocks.iter().flatten() {
        let (w, x) = (61.0 / (2.0 * b.variance * b.variance), b.mean - 256.0);
        s = [s[0] + w, s[1] + w * x, s[2] + w * x * x];
    }
    let det = s[0] * s[2] - s[1] * s[1];
    assert!((found.gain_sd / (s[0] / det).sqrt() - 1.0).abs() < 1e-6, "{found:?}");
    // By differences of r(F, g) = √(F − 1/12) / g; an error of the black level moves F along the line.
    let r = |f: f64, g: f64| (f - 1.0 / 12.0).sqrt() / g;
    let (df, dg) = ((r(30.001, 0.45) - r(29.999, 0.45)) / 0.002, (r(30.0, 0.45001) - r(30.0, 0.44999)) / 0.00002);
    let variance = df * df * (s[2] / det + (0.45 * 0.3f64).powi(2)) - 2.0 * df * dg * s[1] / det + dg * dg * s[0] / det;
    assert!((found.read_noise_sd / variance.sqrt() - 1.0).abs() < 1e-5, "{found:?} {}", variance.sqrt());
    assert_eq!(found.black_sd, 0.3);
    // The black level is most of it when it is little known, and nothing when it is.
    let doubted = fit(std::slice::from_ref(&grid), (256.0, 10.0), (4000.0, true), 1.0 / 12.0).unwrap();
    assert!(
        (doubted.read_noise_sd / (df * 4.5) - 1.0).abs() < 0.2 && doubted.read_noise_sd > 2.0 * found.read_noise_sd
    );
    // Floating-point samples have no rounding variance; a saturation below the black level is ignored.
    let float = fit(&[grid], (256.0, 0.3), (100.0, false), 0.0).unwrap();
    assert!((float.noise.read_noise_electrons - 30f64.sqrt() / slope).abs() < 1e-8);
    assert_eq!((float.noise.saturation_dn, float.saturation_seen), (257.0, false));
}

#[test]
fn blocks_that_stripes_cross_and_those_beside_them_are_left_out() {
    let mut grid = on_line(30.0, 0.45);
    // One channel at (5, 3) is 2.3 times the line, five standard deviations being 1.9; what is around it is off by a
    // third, as the blur of an edge makes it.
    for y in 2..=4 {
        for x in 4..=6 {
            for c in 0..3 {
                grid.blocks[3 * (12 * y + x) + c].as_mut().unwrap().variance *= 1.3;
            }
        }
    }
    grid.blocks[3 * (12 * 3 + 5) + 1].as_mut().unwrap().variance *= 1.75;
    // And one saturates in the corner at the right, far from others.
    grid.blocks[3 * 11 + 2] = None;
    let found = fit(&[grid, on_line(30.0, 0.45)], (256.0, 0.0), (4000.0, true), 0.0).unwrap();
    // 9 places and 4, three channels each, of two times 288.
    assert_eq!(found.blocks, 2 * 288 - 27 - 12);
    assert!((found.noise.gain_dn_per_electron - 0.45).abs() < 1e-9, "{found:?}");
    assert!((found.noise.read_noise_electrons - 30f64.sqrt() / 0.45).abs() < 1e-8, "{found:?}");
}

#[test]
fn a_sensor_without_noise_has_none() {
    let found = fit(&[on_line(0.0, 0.0)], (256.0, 0.1), (4000.0, true), 1.0 / 12.0).unwrap();
    assert_eq!((found.noise.gain_dn_per_electron, found.noise.read_noise_electrons), (0.0, 0.0));
    assert_eq!(found.read_noise_sd, 0.0);
}

#[test]
fn thirty_blocks_in_light_and_thirty_in_the_dark_are_needed() {
    let grid = |lit: usize, dark: usize| {
        let block = |level: f64| Some(Block { mean: 256.0 + level, variance: 5.0 + 0.4 * level });
        // Levels of a fifth are neither.
        let blocks = (0..288).map(|k| {
            block(if k < lit {
                1000.0 - k as f64
            } else if k < lit + dark {
                10.0
            } else {
                200.0
            })
        });
        BlockGrid { size: [12, 8], blocks: blocks.collect() }
    };
    let of = |lit, dark| fit(&[grid(lit, dark)], (256.0, 0.1), (4000.0, true), 0.0);
    assert!(of(30, 30).is_ok());
    assert!(of(29, 30).unwrap_err().starts_with("29 blocks"));
    assert!(of(30, 29).unwrap_err().starts_with("29 blocks"));
    assert!(fit(&[], (256.0, 0.1), (4000.0, true), 0.0).is_err());
}
