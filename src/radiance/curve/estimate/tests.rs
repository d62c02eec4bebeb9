use super::*;
use crate::radiance::Exposure;

#[test]
fn basis_functions_are_the_uniform_cubic_splines_of_the_logarithm() {
    // Codes at which ln((z + 8) / 8) is a whole number of intervals, and half of one more: 1/6, 4/6, 1/6, and 1/48,
    // 23/48.
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
    let slope = [vec![0.0; 600], vec![0.0; 600]];
    (stack, LightSum { parts, whole: codes((0..600).map(whole), gamma), black: vec![0.0; 600], slope })
}

fn estimated(gamma: [f64; 3]) -> CurveEstimate {
    let (stack, sum) = scene(gamma);
    let file = FileNoise { sixteen_bit: true, ..FileNoise::default() };
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

/// Stripes of 10 px, blurred by 1.2 px, on 20 lines of 60 px; the inverse lies `moved` px beside the pattern.
fn stripes(moved: f64, whole: f64, gamma: [f64; 3]) -> LightSum {
    // Light from 0 to 1, and its slope.
    let lit = |x: f64| {
        (0..3)
            .map(|k| [10.0 + 20.0 * k as f64, 20.0 + 20.0 * k as f64])
            .map(|[from, to]| {
                0.5 * (libm::erf((x - from) / (1.2 * 2f64.sqrt())) - libm::erf((x - to) / (1.2 * 2f64.sqrt())))
            })
            .sum::<f64>()
    };
    let x = |k: usize| (k / 3 % 60) as f64 + 0.37 * (k / 180 % 5) as f64;
    let n = 3600;
    let part = |k: usize, other: bool| whole * if other { 1.0 - lit(x(k) - moved) } else { lit(x(k)) };
    let parts = [false, true].map(|other| codes((0..n).map(|k| part(k, other)), gamma));
    let grows = |k: usize| {
        let at = |x: f64| 0.5 * whole * (1.0 - lit(x - moved) - lit(x));
        let across = |by: f64| at(x(k) + by) - at(x(k) - by);
        ((8.0 * across(1.0) - across(2.0)) / 12.0) as f32
    };
    let slope = [(0..n).map(grows).collect(), vec![0.0; n]];
    LightSum { parts, whole: codes((0..n).map(|_| whole), gamma), black: vec![0.0; n], slope }
}

#[test]
fn a_projector_that_moves_between_pattern_and_inverse_bends_no_curve() {
    for gamma in [1.4, 1.9, 2.5] {
        let (stack, _) = scene([gamma; 3]);
        let sums: Vec<LightSum> = [0.55, -0.7, 0.2, -0.35]
            .into_iter()
            .zip([230.0, 120.0, 60.0, 180.0])
            .map(|(moved, whole)| stripes(moved, whole, [gamma; 3]))
            .collect();
        let file = FileNoise { sixteen_bit: true, ..FileNoise::default() };
        // Times are nearly free: what settles the power is the sums.
        let options = CurveOptions { times_sd: 0.3, file };
        let found = estimate_curve(&[stack], &sums, 3, &NOISE, &options).unwrap();
        for code in [20.0, 60.0, 120.0, 240.0f64] {
            let ratio = found.curve.linear_at(0, code) / found.curve.linear_at(0, 188.0);
            let off = ratio / (code / 188.0).powf(gamma) - 1.0;
            let sd = found.curve.relative_sd_at(0, code);
            println!("{gamma} {code}: {off:+.4} ± {sd:.4}");
            // A hundredth per stop from half the range; code 20 is three stops away, and of a steep curve known to a
            // tenth.
            assert!(off.abs() < 0.01 * (1.0 + (code / 188.0).log2().abs()) + sd, "{gamma} {code}: {off} {sd}");
        }
    }
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
    let file = FileNoise { sixteen_bit: true, ..FileNoise::default() };
    let options = CurveOptions { times_sd: 0.03, file };
    assert!(estimate_curve(&[], &[], 2, &NOISE, &options).is_none());
    let lone = Exposure { samples: codes((0..300).map(|k| 20.0 + k as f64 * 0.5), [2.0; 3]), secs: 1.0 };
    let stack = Stack { exposures: vec![lone], settings: vec![0] };
    assert!(estimate_curve(&[stack], &[], 1, &NOISE, &options).is_none());
}

/// A state that is not the solution: three curves apart, times and lamps off.
fn state(settings: usize, sums: usize) -> Fit {
    let start = starting(&Curve::srgb());
    let coefficients = (0..3 * COEFFICIENTS).map(|k| start[k % COEFFICIENTS] + 0.03 * ((k * 7) % 5) as f64).collect();
    let wave = |n: usize| (0..n).map(|k| 0.01 * ((k * 3) % 4) as f64 - 0.012).collect();
    Fit {
        coefficients,
        curves: 3,
        times: wave(settings),
        lamps: wave(4 * sums),
        chi2: 0.0,
        freedom: 0.0,
        covariance_diagonal: vec![],
    }
}

/// Compares the sums of a system with dense rows: (row, residual, weight) of every observation.
fn assert_sums(found: &System, rows: &[(Vec<f64>, f64, f64)]) {
    let n = found.size;
    let (mut matrix, mut right) = (vec![0.0; n * n], vec![0.0; n]);
    for (row, residual, weight) in rows {
        for i in (0..n).filter(|&i| row[i] != 0.0) {
            right[i] += weight * row[i] * residual;
            (0..n).for_each(|j| matrix[i * n + j] += weight * row[i] * row[j]);
        }
    }
    let near = |found: &[f64], expected: &[f64]| {
        let size = expected.iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        // f64 sums in another order; values of the curve pass through f32.
        found.iter().zip(expected).enumerate().for_each(|(k, (f, e))| {
            assert!((f - e).abs() < 1e-6 * size, "{k}: {f} {e}");
        });
    };
    near(&found.matrix, &matrix);
    near(&found.right, &right);
}

#[test]
fn a_stacks_equations_are_those_of_curve_and_times_with_the_light_of_each_pixel_eliminated() {
    let (stack, _) = scene([1.6, 1.9, 2.3]);
    let file = FileNoise { sixteen_bit: true, ..FileNoise::default() };
    let options = CurveOptions { times_sd: 0.03, file };
    let stacks = [Stack { settings: vec![1, 0, 2], ..stack }];
    let problem = Problem { stacks: &stacks, sums: &[], settings: 3, noise: &NOISE, options: &options, moving: false };
    let fit = state(3, 0);
    let sensor = Sensor::with_curve(&NOISE, fit.curve(vec![vec![0.0; CODES]; 3]), file);
    let size = 3 * COEFFICIENTS + 3;
    let found = problem.add_stack(&stacks[0], &fit, &sensor, System::new(size), true);
    let secs: Vec<f32> =
        [(0.25, 1), (1.0, 0), (3.0, 2)].map(|(t, s)| (t * f64::exp(0.01 * [0.0, 3.0, 2.0][s] - 0.012)) as f32).into();
    let linear: Vec<Vec<f32>> = stacks[0]
        .exposures
        .iter()
        .map(|e| {
            let mut all = vec![0.0; 900];
            sensor.linearize(&e.samples, 0, &mut all);
            all
        })
        .collect();
    let mut here = Here::new(3);
    let (mut rows, mut chi2, mut freedom) = (Vec::new(), 0.0, 0.0);
    for k in 0..900 {
        let one: Vec<[f32; BLOCK]> = linear
            .iter()
            .map(|y| {
                let mut b = [0.0; BLOCK];
                b[k % 3] = y[k];
                b
            })
            .collect();
        if !here.look(&one, k % 3, &secs, &sensor, true) {
            continue;
        }
        let seen: Vec<(Vec<f64>, f64, f64)> = (0..3)
            .filter(|&j| here.weight[j] > 0.0)
            .filter_map(|j| {
                let code = sensor.curve()?.code_at(k % 3, f64::from(here.mean[j]));
                let (first, values) = basis(code);
                let mut row = vec![0.0; size];
                (0..4).for_each(|m| row[k % 3 * COEFFICIENTS + first + m] = -values[m]);
                row[3 * COEFFICIENTS + [1, 0, 2][j]] = 1.0;
                (code >= 4.0).then_some((row, here.residual[j], here.weight[j]))
            })
            .collect();
        // The light is what leaves the weighted mean of the residuals at nothing: every row less the mean of the rows.
        let total: f64 = seen.iter().map(|s| s.2).sum();
        let mean = |i: usize| seen.iter().map(|s| s.2 * s.0[i]).sum::<f64>() / total;
        let middle: Vec<f64> = (0..size).map(mean).collect();
        let off = seen.iter().map(|s| s.2 * s.1).sum::<f64>() / total;
        for (row, residual, weight) in &seen {
            let row = row.iter().zip(&middle).map(|(a, b)| a - b).collect();
            chi2 += weight * (residual - off).powi(2);
            rows.push((row, residual - off, *weight));
        }
        freedom += seen.len() as f64 - f64::from(u8::from(!seen.is_empty()));
    }
    assert!(rows.len() > 1500, "{}", rows.len());
    assert_sums(&found, &rows);
    assert!((found.chi2 / chi2 - 1.0).abs() < 1e-6, "{} {chi2}", found.chi2);
    assert_eq!(found.freedom, freedom);
}

#[test]
fn a_light_sums_equations_are_the_parts_less_the_whole_at_the_values_that_fit() {
    let (_, mut sum) = scene([1.6, 1.9, 2.3]);
    sum.black = (0..600).map(|k| 0.3 + 0.1 * (k % 7) as f32).collect();
    // In a fifth of the samples one part is nearly all: the curve cancels and the lamp is seen.
    let whole = |k: usize| 60.0 + 180.0 * ((k * 37) % 600) as f64 / 600.0;
    let share = |k: usize| if k.is_multiple_of(5) { 0.05 } else { 0.12 + 0.76 * ((k * 101) % 600) as f64 / 600.0 };
    sum.parts = [false, true].map(|other| {
        codes((0..600).map(|k| whole(k) * if other { 1.0 - share(k) } else { share(k) }), [1.6, 1.9, 2.3])
    });
    sum.slope = [11, 13].map(|step| (0..600).map(|k| 9.0 - ((k * step) % 19) as f32).collect());
    let file = FileNoise { sixteen_bit: true, ..FileNoise::default() };
    let options = CurveOptions { times_sd: 0.03, file };
    let sums = [sum.clone(), sum];
    let problem = Problem { stacks: &[], sums: &sums, settings: 2, noise: &NOISE, options: &options, moving: true };
    let mut fit = state(2, 2);
    // More than what counts as still.
    (fit.lamps[6], fit.lamps[7]) = (0.08, -0.05);
    let sensor = Sensor::with_curve(&NOISE, fit.curve(vec![vec![0.0; CODES]; 3]), file);
    let size = 3 * COEFFICIENTS + 2 + 8;
    let found = problem.add_sum(1, &sums[1], &fit, &sensor, System::new(size), true);
    let light = |s: &Samples| {
        let mut all = vec![0.0; 600];
        sensor.linearize(s, 0, &mut all);
        all
    };
    let [first, second, white] = [&sums[1].parts[0], &sums[1].parts[1], &sums[1].whole].map(light);
    let lamps = [fit.lamps[4], fit.lamps[5]].map(|l| (-l).exp());
    let displaced = |k: usize| (0..2).map(|a| fit.lamps[6 + a] * f64::from(sums[1].slope[a][k])).sum::<f64>();
    // What noise does not explain where both parts have light: by the middle of 2 lists of numbers, for 16 independent
    // samples.
    let mut lists = [vec![], vec![], vec![]];
    for k in 0..600 {
        let seen = [f64::from(first[k]) * lamps[0], f64::from(second[k]) * lamps[1], f64::from(white[k])];
        let expected = seen[2] + f64::from(sums[1].black[k]);
        if (seen[0] + seen[1] + seen[2]).is_finite() && seen[0].min(seen[1]) > 0.1 * (seen[0] + seen[1]) {
            let variance: f64 = seen.map(|v| f64::from(sensor.variance(v as f32, k % 3))).iter().sum();
            lists[0].push((expected - seen[0] - seen[1] - displaced(k)).abs() / expected);
            lists[1].push(variance / expected / expected);
            lists[2].push(displaced(k).abs() / expected);
        }
    }
    lists.iter_mut().for_each(|l| l.sort_by(f64::total_cmp));
    let [residual, noise, explained] = [&lists[0], &lists[1], &lists[2]].map(|l| l[l.len() / 2]);
    let third = (fit.lamps[6].powi(2) + fit.lamps[7].powi(2)) / 12.0 * explained;
    let unexplained = ((1.4826 * residual).powi(2) - noise + third * third) * lists[0].len() as f64 / 16.0;
    assert!(unexplained > noise, "the curve of this state is not that of the sums");
    let (mut rows, mut chi2, mut shares) = (Vec::new(), 0.0, [0; 2]);
    for k in 0..600 {
        let seen = [f64::from(first[k]) * lamps[0], f64::from(second[k]) * lamps[1], f64::from(white[k])];
        let expected = seen[2] + f64::from(sums[1].black[k]);
        if !(seen[0] + seen[1] + seen[2]).is_finite() {
            continue;
        }
        let variance = seen.map(|v| f64::from(sensor.variance(v as f32, k % 3)));
        let total = variance[0] + variance[1] + variance[2];
        let (noise, excess) = (total / expected / expected, expected - seen[0] - seen[1] - displaced(k));
        let meet = seen[0].min(seen[1]) > 0.1 * (seen[0] + seen[1]);
        let weight = 1.0 / (noise + if meet { unexplained } else { 0.0 });
        // Whatever is not noise alone is looked at up to five deviations.
        if noise > 0.01 || (excess / expected).abs() > (5.0 / weight.sqrt()).max(0.5) {
            continue;
        }
        // What each would be if the excess were shared by variance.
        let fitted = [0, 1, 2].map(|p| seen[p] + [1.0, 1.0, -1.0][p] * excess * variance[p] / total);
        let mut row = vec![0.0; size];
        let both = fitted[0].min(fitted[1]) > 0.1 * (fitted[0] + fitted[1]);
        shares[usize::from(both)] += 1;
        for p in 0..3 {
            let code = sensor.curve().unwrap().code_at(k % 3, fitted[p]);
            let (first, values) = basis(code);
            if both && code >= 4.0 {
                let sign = [1.0, 1.0, -1.0][p];
                (0..4).for_each(|m| row[k % 3 * COEFFICIENTS + first + m] += sign * fitted[p] / expected * values[m]);
            }
        }
        // Lamps and movements come after the two settings' times, four for each sum.
        row[3 * COEFFICIENTS + 2 + 4] = -fitted[0] / expected;
        row[3 * COEFFICIENTS + 2 + 5] = -fitted[1] / expected;
        for a in (0..2).filter(|_| both) {
            row[3 * COEFFICIENTS + 2 + 6 + a] = f64::from(sums[1].slope[a][k]) / expected;
        }
        chi2 += weight * (excess / expected).powi(2);
        rows.push((row, excess / expected, weight));
    }
    assert!(shares[0] > 50 && shares[1] > 300, "both kinds: {shares:?}");
    assert_sums(&found, &rows);
    assert!((found.chi2 / chi2 - 1.0).abs() < 1e-6, "{} {chi2}", found.chi2);
    assert_eq!(found.freedom, rows.len() as f64);
}
