use super::*;
use crate::capture::Noise;
use crate::radiance::FileNoise;
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

/// Pixels of light spread over five decades, most of them dark, as photographs of `actual` times that are said to be `stated`.
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
