use super::*;
use crate::capture::Noise;
use crate::radiance::{Curve, FileNoise};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal, Poisson};

const GAIN: f64 = 0.4;
const READ: f64 = 7.5;
const BLACK: f64 = 512.0;

fn sensor() -> Sensor {
    let noise =
        Noise { black_dn: BLACK, saturation_dn: 16_000.0, gain_dn_per_electron: GAIN, read_noise_electrons: READ };
    Sensor::with_curve(&noise, None, FileNoise::default())
}

/// Pixels of light spread over five decades, most of them dark, as photographs of `actual` times that are said to be
/// `stated`.
fn stack(stated: &[f64], actual: &[f64], settings: &[usize], seed: u64) -> Stack {
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
    let read = Normal::new(0.0, READ).unwrap();
    let exposures = stated.iter().zip(actual).map(|(&secs, &actual)| {
        let codes = (0..9000).map(|k| {
            let electrons_per_sec = 1e6 * 10f64.powf(-5.0 * f64::from(k) / 9000.0);
            let electrons = Poisson::new(electrons_per_sec * actual).unwrap().sample(&mut rng) + read.sample(&mut rng);
            (BLACK + GAIN * electrons).round().clamp(0.0, 16_383.0) as u16
        });
        Exposure { samples: Samples::U16(codes.collect()), secs }
    });
    Stack { exposures: exposures.collect(), settings: settings.to_vec() }
}

fn differences(of: &[f64]) -> Vec<f64> {
    of.windows(2).map(|w| w[1] - w[0]).collect()
}

#[test]
fn ratios_of_times_are_found_within_their_stated_uncertainty() {
    let (stated, off) = ([0.01, 0.04, 0.16, 0.64], [0.08, -0.09, 0.05, 0.0]);
    let actual: Vec<f64> = stated.iter().zip(off).map(|(t, o): (&f64, f64)| t * o.exp()).collect();
    let expected = differences(&off);
    for seed in 0..5 {
        let stack = stack(&stated, &actual, &[0, 1, 2, 3], seed);
        let found = stack_scales(&[&stack.exposures], &sensor(), 1).unwrap();
        let fit = fit_exposures(&[(&stack, found)], 4);
        for (k, (a, b)) in differences(&fit.log_scale).iter().zip(&expected).enumerate() {
            let sd = (fit.variance[k] + fit.variance[k + 1]).sqrt();
            // Photons of 9000 pixels leave 0.05 to 0.2 %; 4 standard deviations of 15 draws.
            assert!(sd < 3e-3 && (a - b).abs() < 4.0 * sd, "seed {seed}, {k}: {a} {b} ± {sd}");
        }
    }
}

#[test]
fn the_exposures_of_a_group_keep_their_nominal_mean_and_groups_are_told_apart() {
    let a = stack(&[0.01, 0.04], &[0.011, 0.04], &[0, 1], 1);
    let b = stack(&[0.16, 0.64], &[0.16, 0.60], &[2, 3], 2);
    let scales = |s: &Stack| stack_scales(&[&s.exposures], &sensor(), 1).unwrap();
    let fit = fit_exposures(&[(&a, scales(&a)), (&b, scales(&b))], 5);
    assert_eq!(fit.group, [0, 0, 2, 2, 4], "the last is in no stack");
    assert!((fit.log_scale[0] + fit.log_scale[1]).abs() < 1e-9 && (fit.log_scale[2] + fit.log_scale[3]).abs() < 1e-9);
    // ln 1.1 between two settings, half of it each; 0.2 % by photons.
    assert!((fit.log_scale[0] - 0.5 * 1.1f64.ln()).abs() < 4e-3, "{fit:?}");
    assert!(fit.log_scale[4].abs() < 1e-12);
}

#[test]
fn flicker_is_found_when_it_is_there_and_not_when_it_is_not() {
    let stated = [0.01, 0.04, 0.16, 0.64];
    let flicker = |sd: f64| {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(5);
        let lamp = Normal::new(1.0, sd).unwrap();
        let stacks: Vec<Stack> = (0..20)
            .map(|k| {
                let actual: Vec<f64> = stated.iter().map(|t| t * lamp.sample(&mut rng)).collect();
                stack(&stated, &actual, &[0, 1, 2, 3], 100 + k)
            })
            .collect();
        let pairs: Vec<_> = stacks.iter().map(|s| (s, stack_scales(&[&s.exposures], &sensor(), 1).unwrap())).collect();
        fit_exposures(&pairs, 4).flicker_sd
    };
    assert_eq!(flicker(0.0), None);
    // 57 degrees of freedom: a standard deviation is known to a tenth; three of these, and the grid's step of 8 %.
    let found = flicker(0.005).unwrap();
    assert!((found / 0.005 - 1.0).abs() < 0.35, "{found}");
}

#[test]
fn a_stack_of_which_one_exposure_measured_everything_says_nothing() {
    let alone = stack(&[0.01], &[0.01], &[0], 1);
    assert!(stack_scales(&[&alone.exposures], &sensor(), 1).is_none());
    let saturated = |secs| Exposure { samples: Samples::U16(vec![16_383; 300]), secs };
    assert!(stack_scales(&[&[saturated(0.1), saturated(1.0)]], &sensor(), 1).is_none());
    assert!(stack_scales(&[], &sensor(), 1).is_none());
}

/// Two exposures without noise: 1200 pixels of three channels apart, lit from 4 DN to beyond saturation in the first.
fn clean(stated: [f64; 2], actual: [f64; 2]) -> Vec<Exposure> {
    let light = |k: usize| 15.0 * 1.006f64.powf((k / 3) as f64) * [1.0, 0.6, 0.25][k % 3];
    let of = |k: usize| {
        let code = |j: usize| (BLACK + light(j) * actual[k] / actual[0]) as f32;
        Exposure { samples: Samples::F32((0..3600).map(code).collect()), secs: stated[k] }
    };
    vec![of(0), of(1)]
}

#[test]
fn a_stack_without_noise_gives_the_ratio_and_the_information_of_its_photons() {
    // Said to be four times, really 4.4 times longer.
    let exposures = clean([0.02, 0.08], [0.02, 0.088]);
    let found = stack_scales(&[&exposures], &sensor(), 1).unwrap();
    let ratio = found.log_scale[1] - found.log_scale[0];
    // f32 values.
    assert!((ratio - 1.1f64.ln()).abs() < 1e-5, "{found:?}");
    // One pixel tells the ratio by w₁ w₂ / (w₁ + w₂), w being signal² / variance; those nearer than four standard
    // deviations to black or to saturation tell nothing.
    let Samples::F32(first) = &exposures[0].samples else { panic!() };
    let information = |wanted: &dyn Fn(usize) -> bool| {
        let (mut sum, mut counted) = (0.0, 0);
        for (_, code) in first.iter().enumerate().filter(|(k, _)| wanted(*k)) {
            let y = f64::from(*code) - BLACK;
            let signals = [y, 4.4 * y];
            let variance = signals.map(|s| GAIN * s + GAIN * READ * GAIN * READ + 1.0 / 12.0);
            let usable = |k: usize| {
                let sd = variance[k].sqrt();
                signals[k] > 4.0 * sd && signals[k] + 4.0 * sd < 15_488.0
            };
            if usable(0) && usable(1) {
                let w = [0, 1].map(|k| signals[k] * signals[k] / variance[k]);
                sum += w[0] * w[1] / (w[0] + w[1]);
                counted += 1;
            }
        }
        assert!((400..3000).contains(&counted), "some are left out: {counted}");
        sum
    };
    let expected = information(&|_| true);
    for (k, sign) in [(0, 1.0), (1, -1.0), (2, -1.0), (3, 1.0)] {
        // f32 weights; one bright pixel more or less is four times that.
        let off = found.information[k] / (sign * expected) - 1.0;
        assert!(off.abs() < 1e-4, "{k}: {} {expected}", found.information[k]);
    }
    // Two rectangles of a shot tell twice as much; every second block of samples what it holds.
    let twice = stack_scales(&[&exposures, &exposures], &sensor(), 1).unwrap();
    assert!((twice.information[0] / found.information[0] - 2.0).abs() < 1e-6);
    let strided = stack_scales(&[&exposures], &sensor(), 2).unwrap();
    let expected = information(&|k| (k / 510).is_multiple_of(2));
    assert!((strided.information[0] / expected - 1.0).abs() < 1e-4, "{} {expected}", strided.information[0]);
}

#[test]
fn noise_that_the_rig_understates_makes_scales_less_certain() {
    let mut exposures = clean([0.02, 0.08], [0.02, 0.08]);
    let calm = stack_scales(&[&exposures], &sensor(), 1).unwrap();
    // Two standard deviations up and down in turn: χ² is about four times its degrees of freedom, shared by the two
    // exposures.
    let Samples::F32(v) = &mut exposures[0].samples else { panic!() };
    for (k, code) in v.iter_mut().enumerate() {
        let y = f64::from(*code) - BLACK;
        let both = (1.0 + 0.25) * (GAIN * y + 9.0);
        *code += (2.0 * both.sqrt() * if k % 2 == 0 { 1.0 } else { -1.0 }) as f32;
    }
    let noisy = stack_scales(&[&exposures], &sensor(), 1).unwrap();
    let excess = calm.information[0] / noisy.information[0];
    // Some pixels near black fall out.
    assert!((3.0..5.0).contains(&excess), "{excess}");
}

/// A stack of two photographs whose log scales differ by `difference`, known with information `known`.
fn two(settings: [usize; 2], difference: f64, known: f64) -> (Stack, StackScales) {
    let scales =
        StackScales { log_scale: vec![0.3, 0.3 + difference], information: vec![known, -known, -known, known] };
    (Stack { exposures: vec![], settings: settings.to_vec() }, scales)
}

fn fitted(pairs: &[(Stack, StackScales)], settings: usize, sd: f64) -> (Given, Vec<usize>) {
    let stacks: Vec<Contrast> = pairs.iter().filter_map(|(s, scales)| Contrast::new(s, scales)).collect();
    let group = groups(&stacks, settings);
    (fit_given(&stacks, &group, sd), group)
}

#[test]
fn stacks_of_two_are_averaged_by_the_inverse_of_their_variances_and_of_twice_the_flickers() {
    // Settings 2 and 0 of four, unequally known.
    let data = [(0.05, 4e4), (0.02, 1e4), (-0.01, 2500.0)];
    let pairs = data.map(|(difference, known)| two([2, 0], difference, known));
    for sd in [0.0, 0.004, 0.03] {
        let (given, group) = fitted(&pairs, 4, sd);
        assert_eq!(group, [0, 1, 0, 3]);
        let weights = data.map(|(_, known)| 1.0 / (1.0 / known + 2.0 * sd * sd));
        let total: f64 = weights.iter().sum();
        let mean = (0..3).map(|k| weights[k] * data[k].0).sum::<f64>() / total;
        // Half of it each, the variance of a difference a quarter each; small systems in f64.
        assert!((given.log_scale[0] - 0.5 * mean).abs() < 1e-9 && (given.log_scale[2] + 0.5 * mean).abs() < 1e-9);
        for k in [0, 2] {
            assert!((given.variance[k] * 4.0 * total - 1.0).abs() < 1e-6, "{k}: {}", given.variance[k]);
        }
        assert!(given.log_scale[1].abs() < 1e-12 && given.variance[1] < 1e-9);
    }
}

#[test]
fn the_likelihood_of_flicker_is_that_of_normal_differences_about_their_mean() {
    let data = [(0.05, 4e4), (0.02, 1e4), (-0.01, 2500.0), (0.03, 3e4)];
    let pairs = data.map(|(difference, known)| two([0, 1], difference, known));
    // Restricted: the fitted mean costs half the logarithm of its information.
    let expected = |sd: f64| {
        let v = data.map(|(_, known)| 1.0 / known + 2.0 * sd * sd);
        let total: f64 = v.iter().map(|v| 1.0 / v).sum();
        let mean = (0..4).map(|k| data[k].0 / v[k]).sum::<f64>() / total;
        let chi2: f64 = (0..4).map(|k| (data[k].0 - mean).powi(2) / v[k]).sum();
        -0.5 * (v.iter().map(|v| v.ln()).sum::<f64>() + total.ln() + chi2)
    };
    let of = |sd: f64| fitted(&pairs, 2, sd).0.log_likelihood;
    for sd in [0.001, 0.01, 0.02, 0.1] {
        let (found, expected) = (of(sd) - of(0.0), expected(sd) - expected(0.0));
        // Logarithms of determinants, f64.
        assert!((found - expected).abs() < 1e-6 * expected.abs().max(1.0), "{sd}: {found} {expected}");
    }
}

#[test]
fn settings_that_stacks_link_one_after_the_other_are_one_group() {
    // 4 and 1, 1 and 3: one group of three; 0 and 2 another; 5 alone.
    let pairs = [two([4, 1], 0.1, 1e4), two([1, 3], 0.2, 1e4), two([0, 2], -0.3, 1e4)];
    let (given, group) = fitted(&pairs, 6, 0.0);
    assert_eq!(group, [0, 1, 0, 1, 1, 5]);
    // 4: −0.4/3, 1: −0.1/3, 3: 0.5/3 about their mean; a chain of two.
    let expected = [0.15, -0.1 / 3.0, -0.15, 0.5 / 3.0, -0.4 / 3.0, 0.0];
    assert!((0..6).all(|k| (given.log_scale[k] - expected[k]).abs() < 1e-9), "{:?}", given.log_scale);
    // Of a − (2a + b)/3 and so on with variances 1e-4 of a and b: 5/9, 2/9, 5/9 of it; of a pair alone a quarter.
    let variance = [0.25, 2.0 / 9.0, 0.25, 5.0 / 9.0, 5.0 / 9.0, 0.0].map(|v| v * 1e-4);
    assert!((0..6).all(|k| (given.variance[k] - variance[k]).abs() < 1e-10), "{:?}", given.variance);
}

#[test]
fn a_photograph_that_measured_nothing_is_no_part_of_its_stack() {
    let mut stack = two([0, 1], 0.1, 1e4);
    stack.0.settings.push(7);
    stack.1.log_scale.push(2.0);
    // The third knows its scale to more than a tenth.
    stack.1.information = vec![1e4, -1e4, 0.0, -1e4, 1e4 + 100.0, -100.0, 0.0, -100.0, 100.0];
    let kept = Contrast::new(&stack.0, &stack.1).unwrap();
    assert_eq!(
        (kept.settings, kept.log_scale, kept.information),
        (vec![0, 1], vec![0.3, 0.4], vec![1e4, -1e4, -1e4, 1e4 + 100.0])
    );
    stack.1.information[8] = 101.0;
    assert_eq!(Contrast::new(&stack.0, &stack.1).unwrap().settings, [0, 1, 7]);
    let (stack, mut scales) = two([0, 1], 0.1, 1e4);
    scales.information[3] = 50.0;
    assert!(Contrast::new(&stack, &scales).is_none());
}

#[test]
fn flicker_is_believed_only_when_it_is_much_likelier() {
    // Differences that their own variance of 1e-4 explains, and such as it does not.
    let pairs = |scale: f64| [1.0, -1.0, 0.5, -0.7, 1.2, -1.1, 0.3, -0.4].map(|d| two([0, 1], scale * d * 0.01, 1e4));
    let of = |scale: f64| {
        let pairs = pairs(scale);
        fit_exposures(&pairs.iter().map(|(s, x)| (s, x.clone())).collect::<Vec<_>>(), 2).flicker_sd
    };
    assert_eq!(of(1.0), None);
    // Spread 0.0087 · 10: √(0.087² − 0.01²)/√2 is 0.061; the grid's step is a sixth.
    let found = of(10.0).unwrap();
    assert!((found / 0.061 - 1.0).abs() < 0.17, "{found}");
}

#[test]
fn samples_of_a_list_are_spread_evenly_over_it() {
    let all: Vec<usize> = (100..110).collect();
    // The middles of four quarters: 1.25, 3.75, 6.25, 8.75.
    assert_eq!(evenly(&all, 4).collect::<Vec<_>>(), [101, 103, 106, 108]);
    assert_eq!(evenly(&all, 10).collect::<Vec<_>>(), all);
    assert_eq!(evenly(&all, 99).collect::<Vec<_>>(), all);
    assert_eq!((evenly(&all, 0).count(), evenly(&all[..0], 3).count()), (0, 0));
    assert_eq!(evenly(&all, 1).collect::<Vec<_>>(), [105]);
}

#[test]
fn all_three_channels_of_a_pixel_are_taken() {
    let codes: Vec<u8> = (0..18).collect();
    assert_eq!(take(&Samples::U8(codes.clone()), &[4, 1]), Samples::U8(vec![12, 13, 14, 3, 4, 5]));
    let wide = Samples::U16(codes.iter().map(|&c| 1000 * u16::from(c)).collect());
    assert_eq!(take(&wide, &[5]), Samples::U16(vec![15_000, 16_000, 17_000]));
    let float = Samples::F32(codes.iter().map(|&c| 0.5 * f32::from(c)).collect());
    assert_eq!(take(&float, &[0, 2]), Samples::F32(vec![0.0, 0.5, 1.0, 3.0, 3.5, 4.0]));
}

#[test]
fn bright_pixels_are_all_picked_and_dark_ones_as_many_of_each_level() {
    // 900 pixels of green 22 and 23 DN a centisecond, 40 of 300, 25 of 9000, which saturate the longer exposure; red
    // and blue say other things.
    let light = |p: usize| {
        if p % 37 == 5 {
            9000.0
        } else if p % 23 == 7 {
            300.0
        } else {
            22.0 + (p % 2) as f64
        }
    };
    let code = |k: usize, t: f64| {
        let all = [3.0 * (k / 3) as f64, light(k / 3), 7000.0 - (k / 3) as f64];
        (BLACK + all[k % 3] * t / 0.01).min(16_383.0) as f32
    };
    let exposures =
        [0.01, 0.04].map(|secs| Exposure { samples: Samples::F32((0..2700).map(|k| code(k, secs)).collect()), secs });
    let picked = pick_pixels(&exposures, &sensor());
    let Samples::F32(first) = &picked[0].samples else { panic!() };
    assert_eq!(picked.iter().map(|e| e.secs).collect::<Vec<_>>(), [0.01, 0.04]);
    // In order, each pixel whole: its number is in red.
    let numbers: Vec<usize> =
        first.as_chunks::<3>().0.iter().map(|p| ((p[0] - BLACK as f32) / 3.0).round() as usize).collect();
    assert!(numbers.is_sorted_by(|a, b| a < b));
    for (n, pixel) in numbers.iter().zip(first.as_chunks::<3>().0) {
        assert_eq!(*pixel, [0, 1, 2].map(|c| code(3 * n + c, 0.01)));
    }
    let count = |level: std::ops::Range<f64>| numbers.iter().filter(|&&n| level.contains(&light(n))).count();
    let there = |level: std::ops::Range<f64>| (0..900).filter(|&n| level.contains(&light(n))).count();
    // 22 and 23 DN are one level of half an octave.
    assert_eq!([count(0.0..30.0), count(200.0..400.0), count(5e3..1e4)], [300, there(200.0..400.0), there(5e3..1e4)]);
}

/// A power law for each channel.
fn curved() -> Sensor {
    let table = |gamma: f64| (0..256).map(|z| 255.0 * (f64::from(z) / 255.0).powf(gamma)).collect::<Vec<_>>();
    let curve = Curve::new([1.4, 2.0, 2.8].map(table).into(), vec![vec![0.0; 256]; 3]);
    let noise = Noise { black_dn: 0.0, saturation_dn: 250.0, gain_dn_per_electron: 0.02, read_noise_electrons: 2.0 };
    Sensor::with_curve(
        &noise,
        curve,
        FileNoise { sixteen_bit: false, compression: [0.3, 1.0, 3.0], ..FileNoise::default() },
    )
}

/// One sample of so much light in each exposure, looked at as a sample of channel `c`.
fn looked(sensor: &Sensor, light: [f32; 2], secs: [f32; 2], c: usize, loose: bool) -> Option<Here> {
    let linear = light.map(|v| {
        let mut block = [0.0; BLOCK];
        block[c] = v;
        block
    });
    let mut here = Here::new(2);
    here.look(&linear, c, &secs, sensor, loose).then_some(here)
}

#[test]
fn a_sample_counts_by_the_noise_of_its_own_channel() {
    let sensor = curved();
    let mut weights = Vec::new();
    for c in 0..3 {
        let here = looked(&sensor, [30.0, 120.0], [1.0, 4.0], c, false).unwrap();
        for (j, mean) in [30.0_f32, 120.0].into_iter().enumerate() {
            let expected = f64::from(mean * mean / sensor.variance(mean, c));
            // f32.
            assert!((here.weight[j] / expected - 1.0).abs() < 1e-5, "{c} {j}: {} {expected}", here.weight[j]);
            assert!(here.residual[j].abs() < 1e-6 && (here.mean[j] / mean - 1.0).abs() < 1e-6);
        }
        weights.push(here.weight[0]);
    }
    assert!(weights.windows(2).all(|w| (w[1] / w[0] - 1.0).abs() > 0.05), "compression differs: {weights:?}");
}

#[test]
fn a_sample_five_deviations_off_is_no_noise_and_at_first_one_that_is_off_by_three_fifths() {
    let sensor = sensor();
    // Two of one time, above and below their mean by as much.
    let found =
        |mean: f32, off: f32, loose: bool| looked(&sensor, [mean - off, mean + off], [1.0; 2], 0, loose).is_some();
    let sd = sensor.variance(2000.0, 0).sqrt();
    assert!(found(2000.0, 4.9 * sd, false) && !found(2000.0, 5.1 * sd, false));
    assert!(found(2000.0, 0.59 * 2000.0, true) && !found(2000.0, 0.61 * 2000.0, true));
}

#[test]
fn flicker_must_make_the_stacks_twenty_times_as_likely() {
    let off = [1.0, -1.0, 0.5, -0.7, 1.2, -1.1, 0.3, -0.4];
    // By how much (natural logarithm) the best flicker is likelier than none; e³ is 20.
    let mut seen = [0; 2];
    for k in 0..60 {
        let scale = 1.0 + 0.03 * f64::from(k);
        let pairs = off.map(|d| two([0, 1], scale * d * 0.01, 1e4));
        let fit = fit_exposures(&pairs.iter().map(|(s, x)| (s, x.clone())).collect::<Vec<_>>(), 2);
        let none = fitted(&pairs, 2, 0.0).0.log_likelihood;
        let likelier = (0..200)
            .map(|k| fitted(&pairs, 2, 1e-3 * 1.03f64.powi(k)).0.log_likelihood - none)
            .fold(f64::NEG_INFINITY, f64::max);
        // The grid of the fit is coarser: a sixth.
        if likelier > 3.1 {
            assert!(fit.flicker_sd.is_some(), "{scale}: {likelier}");
            seen[1] += usize::from(likelier < 4.3);
        } else if likelier < 3.0 {
            assert_eq!(fit.flicker_sd, None, "{scale}: {likelier}");
            seen[0] += usize::from(likelier > 2.0);
        }
    }
    assert!(seen[0] > 0 && seen[1] > 0, "some on either side: {seen:?}");
}
