use super::*;
use crate::radiance::Exposure;

#[test]
fn basis_functions_are_the_uniform_cubic_splines_of_the_logarithm() {
    // Codes at which ln((z + 8) / 8) is a whole number of intervals, and half of one more: 1/6, 4/6, 1/6, and 1/48, 23/48.
    let code = |intervals: f64| 8.0 * ((263.0f64 / 8.0).ln() * intervals / 14.0).exp() - 8.0;
    for k in [0.0, 3.0, 12.0] {
        // A hair above a node: rounding may put the node itself into the interval before.
        let (first, values) = basis(code(k) + 1e-9);
        let expected = [1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0, 0.0];
        assert!(
            first == k as usize && (0..4).all(|m| (values[m] - expected[m]).abs() < 1e-7),
            "{k} {first} {values:?}"
        );
        let (first, values) = basis(code(k + 0.5));
        let expected = [1.0, 23.0, 23.0, 1.0].map(|v| v / 48.0);
        assert!(first == k as usize && (0..4).all(|m| (values[m] - expected[m]).abs() < 1e-12), "{values:?}");
        // Not symmetric: at a quarter (27, 235, 121, 1) / 384.
        let (_, values) = basis(code(k + 0.25));
        let expected = [27.0, 235.0, 121.0, 1.0].map(|v| v / 384.0);
        assert!((0..4).all(|m| (values[m] - expected[m]).abs() < 1e-12), "{values:?}");
    }
    // The last code is the end of the last interval.
    let (first, values) = basis(255.0);
    assert!(
        first == INTERVALS - 1 && (values[3] - 1.0 / 6.0).abs() < 1e-9 && values[0].abs() < 1e-9,
        "{first} {values:?}"
    );
}

#[test]
fn entries_of_one_index_are_summed_and_rows_add_up_to_normal_equations() {
    assert_eq!(merged(&mut [(4, 1.0), (2, 0.5), (4, 0.25), (0, 3.0)]), [(0, 3.0), (2, 0.5), (4, 1.25)]);
    assert_eq!(merged(&mut []), []);
    let mut one = System::new(3);
    one.add(&[(0, 2.0), (2, -1.0)], 5.0, 0.5);
    assert_eq!(one.matrix, [2.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.5]);
    assert_eq!(one.right, [5.0, 0.0, -2.5]);
    let mut other = System::new(3);
    other.add(&[(1, 4.0)], 1.0, -1.0);
    (other.chi2, other.freedom, one.chi2, one.freedom) = (2.0, 3.0, 10.0, 20.0);
    let both = one.merge(other);
    assert_eq!((both.matrix[4], both.right[1], both.chi2, both.freedom), (-16.0, -4.0, 12.0, 23.0));
    assert_eq!((both.matrix[0], both.right[2]), (2.0, -2.5));
}

#[test]
fn the_start_is_the_srgb_curve() {
    let fit = Fit {
        coefficients: starting(&Curve::srgb()),
        curves: 1,
        times: vec![],
        lamps: vec![],
        chi2: 0.0,
        freedom: 1.0,
        covariance_diagonal: vec![],
    };
    let curve = fit.curve(vec![vec![0.0; CODES]]).unwrap();
    for code in (4..256).step_by(7) {
        let code = f64::from(code);
        let exact = Curve::srgb().linear_at(0, code);
        // Splines of 14 intervals smooth sRGB's kink at code 10.
        assert!((curve.linear_at(0, code) / exact - 1.0).abs() < 0.02, "{code} {}", curve.linear_at(0, code) / exact);
    }
    // Below code 4 a power law to 0.
    let [one, two, four] = [1.0, 2.0, 4.0].map(|z| curve.linear_at(0, z));
    assert!((two / one / (four / two) - 1.0).abs() < 1e-6 && curve.linear_at(0, 0.0) == 0.0, "{one} {two} {four}");
}

/// g(z) = 255 (z / 255)^γ, each channel by its own γ.
fn code_of(light: f64, gamma: f64) -> f64 {
    255.0 * (light / 255.0).powf(1.0 / gamma)
}

const NOISE: Noise =
    Noise { black_dn: 0.0, saturation_dn: 250.0, gain_dn_per_electron: 0.01, read_noise_electrons: 1.0 };

/// Codes of `lights` in three channels, in 16 bits so that rounding is nothing.
fn codes(lights: impl Iterator<Item = f64>, gamma: [f64; 3]) -> Samples {
    let all: Vec<u16> =
        lights.enumerate().map(|(k, light)| (257.0 * code_of(light.min(255.0), gamma[k % 3])).round() as u16).collect();
    Samples::U16(all)
}

/// Three exposures of light over three decades, and light sums of parts of all ratios.
fn scene(gamma: [f64; 3]) -> (Stack, LightSum) {
    let light = |k: usize| 3.0 * 10f64.powf(2.6 * ((k * 61) % 900) as f64 / 900.0);
    let exposures =
        [0.25, 1.0, 3.0].map(|secs| Exposure { samples: codes((0..900).map(|k| light(k) * secs), gamma), secs });
    let stack = Stack { exposures: exposures.to_vec(), settings: vec![0, 1, 2] };
    let whole = |k: usize| 60.0 + 180.0 * ((k * 37) % 600) as f64 / 600.0;
    let share = |k: usize| 0.12 + 0.76 * ((k * 101) % 600) as f64 / 600.0;
    let parts = [false, true]
        .map(|other| codes((0..600).map(|k| whole(k) * if other { 1.0 - share(k) } else { share(k) }), gamma));
    (stack, LightSum { parts, whole: codes((0..600).map(whole), gamma), black: vec![0.0; 600] })
}

fn estimated(gamma: [f64; 3]) -> CurveEstimate {
    let (stack, sum) = scene(gamma);
    let file = FileNoise { sixteen_bit: true, compression: [0.0; 3] };
    let options = CurveOptions { times_sd: 0.03, file };
    estimate_curve(&[stack], &[sum], 3, &NOISE, &options).unwrap()
}

#[test]
fn one_power_law_for_all_channels_is_found_as_one_curve() {
    let found = estimated([1.8; 3]);
    assert!(!found.curve.is_per_channel());
    for code in [20.0, 60.0, 120.0, 200.0, 240.0] {
        let exact = 255.0 * (code / 255.0f64).powf(1.8);
        // Photons leave a few thousandths; the scale is that of the last code, beyond what is measured.
        let ratio = found.curve.linear_at(0, code) / found.curve.linear_at(0, 188.0);
        let expected = exact / (255.0 * (188.0f64 / 255.0).powf(1.8));
        assert!((ratio / expected - 1.0).abs() < 0.01, "{code}: {}", ratio / expected);
        // And what it says of itself is of that size.
        let sd = found.curve.relative_sd_at(0, code);
        assert!(sd < 0.05 && (ratio / expected - 1.0).abs() < 4.0 * sd + 1e-3, "{code}: {sd}");
    }
    // Against half the range.
    assert!(found.curve.relative_sd_at(0, 188.0) < 1e-9);
    // No noise was added to this.
    assert!(found.reduced_chi2 < 0.1 && found.observations > 1000, "{} {}", found.reduced_chi2, found.observations);
}

#[test]
fn three_power_laws_are_found_as_three_curves_in_their_order() {
    let gamma = [1.5, 2.0, 2.6];
    let found = estimated(gamma);
    assert!(found.curve.is_per_channel());
    for c in 0..3 {
        for code in [40.0, 120.0, 240.0] {
            let ratio = found.curve.linear_at(c, code) / found.curve.linear_at(c, 188.0);
            let expected = (code / 188.0f64).powf(gamma[c]);
            // A third of the data each.
            assert!((ratio / expected - 1.0).abs() < 0.02, "{c} {code}: {}", ratio / expected);
        }
    }
}

#[test]
fn too_little_in_common_gives_no_curve() {
    let file = FileNoise { sixteen_bit: true, compression: [0.0; 3] };
    let options = CurveOptions { times_sd: 0.03, file };
    assert!(estimate_curve(&[], &[], 2, &NOISE, &options).is_none());
    let lone = Exposure { samples: codes((0..300).map(|k| 20.0 + k as f64 * 0.5), [2.0; 3]), secs: 1.0 };
    let stack = Stack { exposures: vec![lone], settings: vec![0] };
    assert!(estimate_curve(&[stack], &[], 1, &NOISE, &options).is_none());
}
