use super::*;
use crate::capture::Noise;
use crate::radiance::{Curve, FileNoise};
use rand::SeedableRng;
use rand_distr::{Distribution, Normal, Poisson};

const GAIN: f64 = 0.4;
const READ: f64 = 0.7;
const BLACK: f64 = 512.0;

fn sensor() -> Sensor {
    let noise =
        Noise { black_dn: BLACK, saturation_dn: 16_000.0, gain_dn_per_electron: GAIN, read_noise_electrons: READ };
    Sensor::with_curve(&noise, None, FileNoise::default())
}

fn photograph(electrons_per_sec: f64, secs: f64, n: usize, rng: &mut impl rand::Rng) -> Exposure {
    let read = Normal::new(0.0, READ).unwrap();
    let mean = electrons_per_sec * secs;
    let codes = (0..n).map(|_| {
        let electrons = if mean > 0.0 { Poisson::new(mean).unwrap().sample(rng) } else { 0.0 } + read.sample(rng);
        (BLACK + GAIN * electrons).round().clamp(0.0, 16_383.0) as u16
    });
    Exposure { samples: Samples::U16(codes.collect()), secs }
}

/// Five exposures two stops apart, from eight electrons in the longest to near saturation of the shortest.
/// (With less than one electron in the longest, clamping the plug-in at zero overstates the variance, by 17 % at 0.8.)
#[test]
fn radiance_is_unbiased_and_its_variance_right_over_six_decades() {
    let sensor = sensor();
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
    let rect = Rect { x: 0, y: 0, width: 60, height: 100 };
    let n = 3 * rect.area();
    for electrons_per_sec in [3.0, 30.0, 300.0, 3e3, 3e4, 3e5, 3e6] {
        let times = [0.01, 0.04, 0.16, 0.64, 2.56];
        let bracket: Vec<_> = times.iter().map(|&t| photograph(electrons_per_sec, t, n, &mut rng)).collect();
        let merged = merge(&bracket, rect, &sensor);
        let truth = GAIN * electrons_per_sec;
        assert!(merged.used.iter().all(|&u| u > 0));
        let mean = merged.value.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64;
        let variance = merged.value.iter().map(|&v| (f64::from(v) - truth).powi(2)).sum::<f64>() / n as f64;
        let stated = merged.variance.iter().map(|&v| f64::from(v)).sum::<f64>() / n as f64;
        // 18,000 samples: the mean is known to sd/134; 4 of these, and 0.1 % for weights that depend on the data.
        assert!(
            (mean - truth).abs() < 4.0 * (variance / n as f64).sqrt() + 1e-3 * truth,
            "{electrons_per_sec}: {mean} {truth}"
        );
        // The variance of 18,000 samples is known to 1 %; the plug-in estimate of few electrons costs a little.
        assert!((variance / stated - 1.0).abs() < 0.06, "{electrons_per_sec}: {variance} {stated}");
    }
}

#[test]
fn a_pixel_saturated_in_every_exposure_is_marked_and_not_averaged() {
    let sensor = sensor();
    let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
    let full = Exposure { samples: Samples::U16(vec![16_383, 16_383, 600]), secs: 0.1 };
    let short = Exposure { samples: Samples::U16(vec![16_383, 1000, 515]), secs: 0.001 };
    let merged = merge(&[short, full], rect, &sensor);
    assert_eq!(merged.used, [0, 1, 2]);
    assert_eq!(merged.value[0], 0.0);
    // 488 DN above black in 1 ms.
    assert!((merged.value[1] - 488_000.0).abs() < 1.0);
}

#[test]
fn nan_in_a_float_photograph_is_no_measurement() {
    let rect = Rect { x: 0, y: 0, width: 2, height: 1 };
    let samples = Samples::F32(vec![f32::NAN, f32::INFINITY, 1000.0, f32::NEG_INFINITY, -3e38, -20.0]);
    let merged = merge(&[Exposure { samples, secs: 1.0 }], rect, &sensor());
    assert_eq!(merged.used, [0, 0, 1, 0, 0, 1]);
    assert!(merged.value.iter().all(|v| v.is_finite()));
}

/// Variance of no light of [`sensor`] and whole code values.
const FLOOR: f64 = GAIN * READ * GAIN * READ + 1.0 / 12.0;
const RANGE: f64 = 16_000.0 - BLACK;

fn exposure(secs: f64, codes: &[u16]) -> Exposure {
    Exposure { samples: Samples::U16(codes.to_vec()), secs }
}

/// One sample as the documentation of [`merge`] has it, in f64: (value, variance, exposures used); `None` is a
/// saturated exposure.
fn naive(measured: &[(f64, Option<f64>)]) -> (f64, f64, u8) {
    let (mut sum_y, mut sum_t, mut least, mut kept) = (0.0, 0.0, 0.0f64, vec![]);
    for &(t, y) in measured {
        let Some(y) = y else {
            least = least.max(RANGE / t);
            continue;
        };
        if sum_t > 0.0 && sum_y / sum_t * t > 1.5 * RANGE {
            continue;
        }
        (sum_y, sum_t) = (sum_y + y, sum_t + t);
        kept.push((t, y));
    }
    if kept.is_empty() {
        return (0.0, 0.0, 0);
    }
    let light = (sum_y / sum_t).max(0.0);
    let weight = |t: f64| t * t / (GAIN * light * t + FLOOR);
    let information: f64 = kept.iter().map(|&(t, _)| weight(t)).sum();
    let mean = kept.iter().map(|&(t, y)| weight(t) * y / t).sum::<f64>() / information;
    let (mut value, mut variance) = (mean, 1.0 / information);
    if least > mean {
        value = least;
        variance = variance.min((GAIN * RANGE + FLOOR) / (RANGE * RANGE) * least * least);
    }
    (value, variance, kept.len() as u8)
}

#[test]
fn every_sample_is_the_mean_of_least_variance_of_its_own_exposures() {
    // 909 samples: more than are merged together, and not a multiple of that.
    let rect = Rect { x: 4, y: 9, width: 101, height: 3 };
    let times = [0.004, 0.03, 0.11, 0.9];
    // Five decades of light, three channels apart, off by a few percent from exposure to exposure; dark ones fall below
    // black.
    let code = |k: usize, t: f64| {
        let light = 20.0 * 10f64.powf(5.0 * ((k * 37) % 303) as f64 / 303.0) * [1.0, 3.0, 0.4][k % 3];
        let off = 1.0 + 0.04 * ((k as f64) * 1.3 + 40.0 * t).sin();
        (BLACK + light * t * off + 2.0 * ((k as f64) * 2.1 + 90.0 * t).cos()).round().clamp(0.0, 16_383.0) as u16
    };
    let bracket = times.map(|t| exposure(t, &(0..909).map(|k| code(k, t)).collect::<Vec<_>>()));
    let merged = merge(&bracket, rect, &sensor());
    assert_eq!(merged.rect, rect);
    let mut seen = [0; 5];
    for k in 0..909 {
        let measured = times.map(|t| (t, Some(code(k, t)).filter(|c| *c < 16_000).map(|c| f64::from(c) - BLACK)));
        let (value, variance, used) = naive(&measured);
        assert_eq!(merged.used[k], used, "{k}");
        if used == 0 {
            assert_eq!((merged.value[k], merged.variance[k]), (0.0, 0.0), "{k}");
            continue;
        }
        // Sums of a few f32; values near none are differences of larger ones.
        assert!(
            (f64::from(merged.value[k]) - value).abs() < 1e-5 * value.abs().max(10.0),
            "{k}: {} {value}",
            merged.value[k]
        );
        assert!(
            (f64::from(merged.variance[k]) / variance - 1.0).abs() < 1e-5,
            "{k}: {} {variance}",
            merged.variance[k]
        );
        seen[usize::from(used)] += 1;
    }
    // All numbers of usable exposures occur.
    assert!(seen[1..].iter().all(|n| *n > 50), "{seen:?}");
}

#[test]
fn without_light_the_variance_is_that_of_reading_and_rounding_and_in_much_light_that_of_photons() {
    let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
    // Nothing; a little; far above the read noise.
    let bracket = [exposure(0.1, &[512, 513, 512 + 3000]), exposure(0.4, &[512, 516, 512 + 12_000])];
    let merged = merge(&bracket, rect, &sensor());
    let expected = [0.0, 10.0, 30_000.0];
    // 1 / Σ t² / variance; Σ t² is 0.17.
    let of_photons = 1.0 / (0.01 / (GAIN * 3000.0 + FLOOR) + 0.16 / (GAIN * 12_000.0 + FLOOR));
    let of_few = 1.0 / (0.01 / (GAIN * 1.0 + FLOOR) + 0.16 / (GAIN * 4.0 + FLOOR));
    let variance = [FLOOR / 0.17, of_few, of_photons];
    for c in 0..3 {
        // f32.
        assert!((f64::from(merged.value[c]) - expected[c]).abs() <= 1e-6 * expected[c], "{c}: {}", merged.value[c]);
        assert!((f64::from(merged.variance[c]) / variance[c] - 1.0).abs() < 1e-5, "{c}: {}", merged.variance[c]);
    }
    // Floating-point photographs were not rounded: read-out alone.
    let float = Exposure { samples: Samples::F32(vec![512.0, 512.0, 3512.0]), secs: 0.1 };
    let merged = merge(&[float], rect, &sensor());
    let variance = [
        GAIN * READ * GAIN * READ / 0.01,
        GAIN * READ * GAIN * READ / 0.01,
        (GAIN * 3000.0 + (GAIN * READ).powi(2)) / 0.01,
    ];
    assert!((0..3).all(|c| (f64::from(merged.variance[c]) / variance[c] - 1.0).abs() < 1e-5), "{:?}", merged.variance);
}

#[test]
fn what_saturates_says_that_there_was_at_least_so_much_light() {
    let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
    let bracket = [exposure(0.01, &[512 + 3000, 512 + 5000, 512 + 3800]), exposure(0.04, &[16_000, 16_001, 15_999])];
    let merged = merge(&bracket, rect, &sensor());
    assert_eq!(merged.used, [1, 1, 2]);
    // 0.04 s to saturation is 387,200 DN/s: more than the 300,000 of red and less than the 500,000 of green.
    let least = RANGE / 0.04;
    let at_saturation = (GAIN * RANGE + FLOOR) / (0.04 * 0.04);
    // f32.
    assert!((f64::from(merged.value[0]) / least - 1.0).abs() < 1e-6, "{}", merged.value[0]);
    assert!((f64::from(merged.variance[0]) / at_saturation - 1.0).abs() < 1e-5, "{}", merged.variance[0]);
    assert!((merged.value[1] / 500_000.0 - 1.0).abs() < 1e-6);
    assert!((f64::from(merged.variance[1]) / ((GAIN * 5000.0 + FLOOR) / 1e-4) - 1.0).abs() < 1e-5);
    // Of two that saturate the shorter one says more.
    let longer = [bracket[0].clone(), bracket[1].clone(), exposure(0.1, &[16_383; 3])];
    let twice = merge(&longer, rect, &sensor());
    assert_eq!((twice.value[0], twice.variance[0]), (merged.value[0], merged.variance[0]));
    // Where the others know it better than the bound would, theirs is the variance.
    let three = [exposure(0.03, &[512 + 11_400; 3]), exposure(0.035, &[512 + 13_300; 3]), exposure(0.04, &[16_383; 3])];
    let merged = merge(&three, rect, &sensor());
    let information = 0.03 * 0.03 / (GAIN * 11_400.0 + FLOOR) + 0.035 * 0.035 / (GAIN * 13_300.0 + FLOOR);
    assert!((f64::from(merged.value[2]) / least - 1.0).abs() < 1e-6, "{}", merged.value[2]);
    assert!((f64::from(merged.variance[2]) * information - 1.0).abs() < 1e-4, "{}", merged.variance[2]);
}

#[test]
fn an_exposure_that_shorter_ones_predict_far_beyond_saturation_measured_something_else() {
    let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
    // 1.5 of the range is 23,232: predicted are 21,680, 24,780 and 24,780.
    let bracket = [exposure(0.1, &[512 + 2168, 512 + 2478, 512 + 2478]), exposure(1.0, &[15_000, 15_000, 900])];
    let merged = merge(&bracket, rect, &sensor());
    assert_eq!(merged.used, [2, 1, 1]);
    // Of what was left out nothing remains.
    assert!((merged.value[1] / 24_780.0 - 1.0).abs() < 1e-6 && merged.value[1] == merged.value[2]);
    assert!((f64::from(merged.variance[2]) / ((GAIN * 2478.0 + FLOOR) / 0.01) - 1.0).abs() < 1e-5);
}

/// The light of an sRGB code value (IEC 61966-2-1), 0 to 255, and its slope.
fn srgb(code: f64) -> (f64, f64) {
    let v = (code / 255.0 + 0.055) / 1.055;
    (255.0 * v.powf(2.4), 2.4 * v.powf(1.4) / 1.055)
}

#[test]
fn encoded_photographs_add_the_variance_of_their_code_values_by_the_curves_slope() {
    let noise = Noise { black_dn: 0.0, saturation_dn: 250.0, gain_dn_per_electron: 0.01, read_noise_electrons: 3.0 };
    let compression = [0.3, 2.0, 0.02];
    let sensor = Sensor::with_curve(
        &noise,
        Some(Curve::srgb()),
        FileNoise { sixteen_bit: false, compression, ..FileNoise::default() },
    );
    // Enough of them that a number of a sample is not taken for one of a channel.
    let rect = Rect { x: 0, y: 0, width: 40, height: 2 };
    let codes = [90u8, 120, 150, 60, 200, 180].repeat(40);
    let merged = merge(&[Exposure { samples: Samples::U8(codes.clone()), secs: 0.25 }], rect, &sensor);
    for (k, &code) in codes.iter().enumerate() {
        let (light, slope) = srgb(f64::from(code));
        // Noise of the code makes its light too large by half the second derivative times the variance: 1.4 slopes over
        // (code + 14).
        let coding = compression[k % 3] + 1.0 / 12.0;
        let bias = 0.5 * 1.4 * slope / (f64::from(code) + 0.055 * 255.0) * coding;
        let expected = (light - bias) / 0.25;
        // Second differences over four codes.
        assert!((f64::from(merged.value[k]) / expected - 1.0).abs() < 2e-4, "{k}: {} {expected}", merged.value[k]);
        let variance = (0.01 * light + 9e-4 + slope * slope * coding) / 0.0625;
        // A table of 1024 entries over the root of the light: half a per cent of the light at the darkest.
        assert!(
            (f64::from(merged.variance[k]) / variance - 1.0).abs() < 0.01,
            "{k}: {} {variance}",
            merged.variance[k]
        );
    }
}

#[test]
fn encoded_exposures_that_are_predicted_near_saturation_are_left_out_and_bound_nothing() {
    let noise = Noise { black_dn: 0.0, saturation_dn: 250.0, gain_dn_per_electron: 0.01, read_noise_electrons: 3.0 };
    let sensor = Sensor::with_curve(&noise, Some(Curve::srgb()), FileNoise::default());
    let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
    let of = |codes: [u8; 3], secs| Exposure { samples: Samples::U8(codes.to_vec()), secs };
    // Light of codes 124 and 130: 51.4 and 56.9; four times that is below and above 225, nine tenths of 250.
    let merged = merge(&[of([124, 130, 124], 0.1), of([230, 230, 255], 0.4)], rect, &sensor);
    assert_eq!(merged.used, [2, 1, 1]);
    // 255 is saturated, and would say 250 / 0.4 = 625 at least; it is not asked.
    let expected = srgb(124.0).0 / 0.1;
    assert!(expected < 625.0);
    // The bias of rounding is a ten-thousandth here.
    assert!((f64::from(merged.value[2]) / expected - 1.0).abs() < 1e-3, "{}", merged.value[2]);
}

fn radiance(
    rect: Rect,
    value: impl Fn(usize, usize, usize) -> f32,
    used: impl Fn(usize, usize, usize) -> u8,
) -> Radiance {
    let at = |k: usize| (rect.x + k / 3 % rect.width, rect.y + k / 3 / rect.width, k % 3);
    let all = |f: &dyn Fn(usize, usize, usize) -> f32| {
        (0..3 * rect.area()).map(at).map(|(x, y, c)| f(x, y, c)).collect::<Vec<_>>()
    };
    Radiance {
        rect,
        value: all(&value),
        variance: all(&|x, y, c| value(x, y, c) * 0.5 + c as f32),
        used: (0..3 * rect.area()).map(at).map(|(x, y, c)| used(x, y, c)).collect(),
    }
}

#[test]
fn ambient_light_goes_out_where_it_was_and_its_variance_comes_in() {
    let mut light = radiance(
        Rect { x: 5, y: 8, width: 3, height: 2 },
        |x, y, c| (100 * c + 10 * x + y) as f32,
        |x, _, _| x as u8 - 4,
    );
    let ambient = radiance(
        Rect { x: 2, y: 7, width: 9, height: 5 },
        |x, y, c| (7 * c + x * y) as f32,
        |_, y, c| (y - 8) as u8 + 2 * u8::from(c == 1),
    );
    let before = light.clone();
    light.subtract(&ambient);
    assert_eq!(light.rect, before.rect);
    for y in 8..10 {
        for x in 5..8 {
            for c in 0..3 {
                let k = 3 * (3 * (y - 8) + x - 5) + c;
                assert_eq!(light.at(x, y) + c, k);
                // Whole and half numbers: exact in f32.
                assert_eq!(light.value[k], (100 * c + 10 * x + y) as f32 - (7 * c + x * y) as f32, "{x} {y} {c}");
                let variance = [(100 * c + 10 * x + y) as f32, (7 * c + x * y) as f32].map(|v| v * 0.5 + c as f32);
                assert_eq!(light.variance[k], variance[0] + variance[1], "{x} {y} {c}");
                let used = ((x - 4) as u8).min((y - 8) as u8 + 2 * u8::from(c == 1));
                assert_eq!(light.used[k], used, "{x} {y} {c}");
            }
        }
    }
}

#[test]
fn luminance_is_the_mean_of_three_channels_and_its_variance_a_ninth_of_their_sum() {
    let light = Radiance {
        rect: Rect { x: 3, y: 1, width: 2, height: 1 },
        value: vec![1.0, 20.0, 600.0, -3.0, 9.0, 6.0],
        variance: vec![9.0, 90.0, 0.0, 1.0, 2.0, 600.0],
        used: vec![1; 6],
    };
    assert_eq!(light.luminance(), [207.0, 4.0]);
    assert_eq!(light.luminance_variance(), [11.0, 67.0]);
}

#[test]
fn no_exposures_and_no_pixels_measure_nothing() {
    let rect = Rect { x: 0, y: 0, width: 2, height: 1 };
    let merged = merge(&[], rect, &sensor());
    assert_eq!((merged.value, merged.variance, merged.used), (vec![0.0; 6], vec![0.0; 6], vec![0; 6]));
    let empty = merge(&[exposure(0.1, &[])], Rect { x: 3, y: 2, width: 0, height: 4 }, &sensor());
    assert!(empty.value.is_empty() && empty.used.is_empty());
}
