use super::super::test_matrices::{StoredMatrix, stored};
use super::super::{Factored, factor};
use super::*;
use crate::FactorWarning;
use crate::progress::Progress;
use crate::transport::Row;

const POINTS: [usize; 2] = [4, 3];
const ROWS: usize = 12;
const WINDOW: [usize; 2] = [5, 3];
const SAMPLES: usize = 15;
const SIGMA: [f64; 4] = [5.0, 3.0, 2.0, 0.5];
/// Which cosine each term is along the rows.
const ALONG: [usize; 4] = [0, 3, 1, 5];
/// h_{k,j} of each term: an amount of a cosine for every channel. No channel has a cosine twice: terms are orthonormal.
const MAPS: [[(f64, usize); 3]; 4] = [
    [(0.6, 1), (0.64, 1), (0.48, 1)],
    [(0.8, 2), (0.36, 2), (0.48, 4)],
    [(0.0, 7), (0.6, 7), (0.8, 7)],
    [(0.6, 4), (0.8, 4), (0.0, 9)],
];

/// Orthonormal over k.
fn cosine(n: usize, j: usize, k: usize) -> f64 {
    let norm = if j == 0 { 1.0 } else { 2.0_f64.sqrt() };
    norm * (std::f64::consts::PI * j as f64 * (k as f64 + 0.5) / n as f64).cos() / (n as f64).sqrt()
}

/// The response of the first `terms` terms.
fn exact(terms: usize, i: usize, e: usize, c: usize) -> f64 {
    let term = |j: usize| {
        let (amount, l) = MAPS[j][c];
        SIGMA[j] * cosine(ROWS, ALONG[j], i) * amount * cosine(SAMPLES, l, e)
    };
    (0..terms).map(term).sum()
}

fn matrix(
    variance: f32,
    value: impl Fn(usize, usize, usize) -> f64,
    valid: impl Fn(usize, usize) -> bool,
) -> StoredMatrix {
    stored(
        POINTS,
        WINDOW,
        |_| 0.0,
        |i| Row {
            response: (0..45).map(|s| if valid(i, s) { value(i, s / 3, s % 3) as f32 } else { 0.0 }).collect(),
            variance: vec![variance; 45],
            valid: (0..45).map(|s| valid(i, s)).collect(),
        },
    )
}

fn options(model: Model) -> FactorOptions {
    let backend = Some(Backend::Full);
    let plain = FactorOptions { maps: Some(false), profile_power: 0.0, ..FactorOptions::default() };
    FactorOptions { model: Some(model), backend, peak_shift: false, ..plain }
}

fn made(matrix: &StoredMatrix, options: &FactorOptions) -> Factored {
    factor(&matrix.reader, options, &Progress::silent()).unwrap()
}

/// A material without a polynomial at a window sample, as the formula says: tensors as they lie.
fn value(m: &Material, i: usize, e: usize, c: usize) -> f64 {
    let (h, n) = (&m.header, m.header.rows());
    let [ex, ey] = h.extended;
    let place = |a: usize, at: usize| at as isize - WINDOW[a] as isize / 2 - isize::from(m.shift[i][a]);
    let (x, y) = (place(0, e % 5) + ex as isize / 2, place(1, e / 5) + ey as isize / 2);
    if !(0..ex as isize).contains(&x) || !(0..ey as isize).contains(&y) {
        return 0.0;
    }
    let at = x as usize + y as usize * ex;
    let (a, b) = (c.min(h.incident_planes - 1), c.min(h.offset_planes - 1));
    let term = |j: usize| {
        let f = m.incident_factors[(a * n + i) * h.terms + j];
        f64::from(m.weights[j]) * f64::from(f) * f64::from(m.offset_factors.all()[(b * h.terms + j) * ex * ey + at])
    };
    let profile = if h.profile { f64::from(m.profile[b * ex * ey + at]) } else { 1.0 };
    profile * (0..h.terms).map(term).sum::<f64>()
}

/// Σ (R̂−R)² and Σ R² over valid entries.
fn misfit(m: &Material, real: impl Fn(usize, usize, usize) -> f64, valid: impl Fn(usize, usize) -> bool) -> [f64; 2] {
    let mut sums = [0.0; 2];
    for i in 0..ROWS {
        for s in (0..45).filter(|&s| valid(i, s)) {
            let r = real(i, s / 3, s % 3);
            sums[0] += (value(m, i, s / 3, s % 3) - r).powi(2);
            sums[1] += r * r;
        }
    }
    sums
}

#[test]
fn a_joint_material_is_the_triplets_in_the_unit_of_the_matrix() {
    let matrix = matrix(0.0, |i, e, c| exact(4, i, e, c), |_, _| true);
    for terms in 1..=4 {
        let found = made(&matrix, &FactorOptions { terms: Some(terms), ..options(Model::Joint) });
        let m = &found.material;
        assert_eq!((m.header.terms, m.header.incident_planes, m.header.offset_planes), (terms, 1, 3));
        for i in 0..ROWS {
            for s in 0..45 {
                let (r, e) = (value(m, i, s / 3, s % 3), exact(terms, i, s / 3, s % 3));
                // Rows and factors are f32; maps that channels share may leave a hundredth of what the terms leave,
                // squared.
                let most = 1e-6 + 0.1 * SIGMA[terms..].iter().map(|s| s * s).sum::<f64>().sqrt();
                assert!((r - e).abs() < most, "T {terms} row {i} sample {s}: {r} {e}");
            }
        }
        for (j, sigma) in SIGMA.iter().enumerate() {
            assert!((m.header.singular_values[j] - sigma).abs() < 1e-6, "rows are f32: {:?}", m.header.singular_values);
            assert!(j >= terms || (f64::from(m.weights[j]) - sigma).abs() < 1e-6, "{:?}", m.weights);
        }
        let [error, energy] = misfit(m, |i, e, c| exact(4, i, e, c), |_, _| true);
        assert!((found.rel_rmse - (error / energy).sqrt()).abs() < 1e-6, "f32: {} {error} {energy}", found.rel_rmse);
    }
}

#[test]
fn the_noise_chooses_the_terms_above_it_and_says_why() {
    // Independent entries of variance v: √v (√45 + √12), here 0.55, between the third value and the fourth; little
    // enough that channels differ by more.
    let sides = 45.0_f64.sqrt() + 12.0_f64.sqrt();
    let matrix = matrix((0.55 / sides).powi(2) as f32, |i, e, c| exact(4, i, e, c), |_, _| true);
    let found = made(&matrix, &options(Model::Joint));
    assert_eq!(found.material.header.terms, 3);
    let level = found.material.header.noise_level;
    assert!((level - 0.55).abs() < 1e-6, "variance in f32: {level}");
    assert!(
        found.choice.contains("terms 3: other singular values are below their noise (number 4: "),
        "{}",
        found.choice
    );
    // What the words say is what the report draws.
    let level = &found.levels[3];
    let words = format!("(number 4: {} < {})", plain(level.singular_value, 3), plain(level.noise, 3));
    assert!(found.choice.contains(&words) && !level.kept, "{words} {}", found.choice);
    assert_eq!(found.levels.iter().filter(|l| l.kept).count(), 3);
    // The fourth value was made .4 before noise, which adds at most its own norm.
    assert!(level.singular_value > 0.3 && level.noise < 0.6, "{level:?}");
    let few = made(&matrix, &FactorOptions { max_terms: 2, ..options(Model::Joint) });
    assert_eq!(few.material.header.terms, 2);
    let why = "terms 2: the most allowed, more singular values are above their noise";
    assert!(few.choice.contains(why), "{}", few.choice);
    let asked = made(&matrix, &FactorOptions { terms: Some(1), ..options(Model::Joint) });
    assert!(asked.choice.contains("terms 1: as asked"), "{}", asked.choice);
}

/// Every number of terms and of shared maps: bytes and squared error in closed form.
fn candidates() -> Vec<(u64, f64)> {
    let mut all = Vec::new();
    for terms in 1..=4 {
        let left: f64 = SIGMA[terms..].iter().map(|s| s * s).sum();
        all.push((4 * (terms + ROWS * terms + 3 * SAMPLES * terms) as u64, left));
        let mut squares = [0.0; 15];
        for j in 0..terms {
            MAPS[j].iter().for_each(|&(amount, l)| squares[l] += (SIGMA[j] * amount).powi(2));
        }
        squares.sort_by(|a, b| b.total_cmp(a));
        for maps in 1..=3 * terms {
            let lost: f64 = squares.iter().skip(maps).sum();
            all.push((4 * (terms + ROWS * terms + SAMPLES * maps + 3 * terms * maps) as u64, left + lost));
        }
    }
    all
}

#[test]
fn goals_choose_terms_and_shared_maps_among_all_numbers_of_both() {
    let matrix = matrix(0.0, |i, e, c| exact(4, i, e, c), |_, _| true);
    let entries = || (0..ROWS * 45).map(|at| exact(4, at / 45, at % 45 / 3, at % 3));
    let peak = entries().fold(0.0, f64::max);
    let energy: f64 = entries().map(|r| r * r).sum();
    let psnr = |error: f64| 20.0 * (peak / (error / (ROWS * 45) as f64).sqrt()).log10();
    let all = candidates();
    for goal_db in [psnr(20.0), psnr(9.0), psnr(5.0), psnr(3.0), psnr(0.3)] {
        let found = made(&matrix, &FactorOptions { goal: Goal::Psnr(goal_db), ..options(Model::Joint) });
        let expected = all.iter().filter(|a| psnr(a.1) >= goal_db).min_by_key(|a| a.0).unwrap();
        assert_eq!(found.material.bytes_f32(), expected.0, "{goal_db} dB: {}", found.choice);
        let db = found.psnr_db.unwrap();
        assert!((db - psnr(expected.1)).abs() < 1e-4, "rows are f32, {goal_db} dB: {db} {}", psnr(expected.1));
        assert!((found.rel_rmse - (expected.1 / energy).sqrt()).abs() < 1e-6, "{}", found.rel_rmse);
    }
    for limit in [160, 200, 260, 340, 420, 520, 600] {
        let found = made(&matrix, &FactorOptions { goal: Goal::Bytes(limit), ..options(Model::Joint) });
        let expected = all.iter().filter(|a| a.0 <= limit).min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        let db = found.psnr_db.unwrap();
        assert!(found.material.bytes_f32() <= limit, "{limit}: {}", found.choice);
        assert!((db - psnr(expected.1)).abs() < 1e-4, "rows are f32, {limit} bytes: {db} {}", psnr(expected.1));
    }
}

#[test]
fn a_goal_looks_for_up_to_four_times_the_terms_that_noise_may_have() {
    let matrix = matrix(0.0, |i, e, c| exact(4, i, e, c), |_, _| true);
    for backend in [Backend::Full, Backend::Randomized] {
        let one =
            FactorOptions { max_terms: 1, goal: Goal::Psnr(60.0), backend: Some(backend), ..options(Model::Joint) };
        let found = made(&matrix, &one);
        assert_eq!(found.material.header.terms, 4, "{}", found.choice);
        assert!(found.psnr_db.unwrap() > 60.0);
        let [error, energy] = misfit(&found.material, |i, e, c| exact(4, i, e, c), |_, _| true);
        assert!((error / energy).sqrt() < 1e-4, "60 dB: {error} {energy}");
    }
}

/// Grey: three channels alike, some samples missing.
#[test]
fn a_grey_matrix_is_measured_over_all_its_valid_entries() {
    let real = |i: usize, e: usize, _: usize| -> f64 {
        (0..3).map(|j| SIGMA[j] * cosine(ROWS, ALONG[j], i) * cosine(SAMPLES, [1, 2, 7][j], e)).sum()
    };
    let whole = matrix(0.0, real, |_, _| true);
    for terms in 1..=2 {
        let found = made(&whole, &FactorOptions { terms: Some(terms), ..options(Model::Joint) });
        assert_eq!(found.material.header.planes(), 1);
        let (left, all): (f64, f64) =
            (SIGMA[terms..3].iter().map(|s| s * s).sum(), SIGMA[..3].iter().map(|s| s * s).sum());
        assert!((found.rel_rmse - (left / all).sqrt()).abs() < 1e-6, "rows are f32: {}", found.rel_rmse);
        for (j, sigma) in SIGMA[..3].iter().enumerate() {
            assert!((found.material.header.singular_values[j] - sigma).abs() < 1e-6, "of the mean of the channels");
        }
        // The goal that this reaches by a tenth of a decibel: what is planned is what comes out.
        let goal = Goal::Psnr(found.psnr_db.unwrap() - 0.1);
        let planned = made(&whole, &FactorOptions { goal, ..options(Model::Joint) });
        assert_eq!(planned.material.header.terms, terms, "{}", planned.choice);
    }
    let valid = |i: usize, s: usize| !(i == 2 && s / 3 == 4 || i == 7 && s / 3 % 5 == 1);
    let gaps = matrix(0.0, real, valid);
    let found = made(&gaps, &FactorOptions { terms: Some(1), ..options(Model::Joint) });
    let [error, energy] = misfit(&found.material, real, valid);
    assert!((found.rel_rmse - (error / energy).sqrt()).abs() < 1e-6, "f32: {} {error} {energy}", found.rel_rmse);
}

#[test]
fn gaps_do_not_count_and_are_filled_from_all_terms() {
    let valid =
        |i: usize, s: usize| !(i == 2 && s % 3 == 1 && s / 3 > 9 || i == 7 && s / 3 % 5 == 1 || i == 9 && s == 0);
    let gaps = matrix(0.0, |i, e, c| exact(2, i, e, c), valid);
    for terms in 1..=2 {
        let found = made(&gaps, &FactorOptions { terms: Some(terms), ..options(Model::Joint) });
        let [error, energy] = misfit(&found.material, |i, e, c| exact(2, i, e, c), valid);
        assert!((found.rel_rmse - (error / energy).sqrt()).abs() < 1e-6, "f32: {} {error} {energy}", found.rel_rmse);
    }
    // One round more than gaps are filled, each one pass of a full decomposition.
    let rounds =
        |fill_rounds: usize| made(&gaps, &FactorOptions { terms: Some(2), fill_rounds, ..options(Model::Joint) });
    assert!(rounds(3).choice.contains("full, 4 passes"), "{}", rounds(3).choice);
    assert!(rounds(0).choice.contains("full, 1 pass"), "{}", rounds(0).choice);
    // Estimated from both terms again and again, the rows become the two terms that they are, measured or not.
    let found = made(&gaps, &FactorOptions { terms: Some(2), fill_rounds: 40, ..options(Model::Joint) });
    let [error, energy] = misfit(&found.material, |i, e, c| exact(2, i, e, c), |_, _| true);
    assert!((error / energy).sqrt() < 1e-5, "where the iteration ends: {error} {energy}");
}

/// Where each row is brightest, from its lit point.
const SHIFTS: [[i16; 2]; ROWS] =
    [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [0, 0], [1, 1], [0, 0], [-1, 1], [0, 0], [0, 0], [0, 0]];

/// A bright sample at the shift, a row of nothing; another colour for each.
fn shifted(i: usize, e: usize, c: usize) -> f64 {
    let at = (2 + SHIFTS[i][0] + 5 * (1 + SHIFTS[i][1])) as usize;
    let peak = if e == at { 4.0 } else { 0.0 };
    if i == 10 { 0.0 } else { (peak + ((3 * e + 5 * c + i) % 7) as f64 * 0.125) * (1.0 + c as f64 * 0.5) }
}

#[test]
fn shifts_and_findings_are_kept_and_shifts_count_in_bytes() {
    let matrix = matrix(1e-9, shifted, |_, _| true);
    let with =
        |goal, terms| FactorOptions { goal, terms, peak_shift: true, max_shift: Some(1), ..options(Model::Joint) };
    let found = made(&matrix, &with(Goal::Noise, Some(12)));
    let m = &found.material;
    assert_eq!((m.shift.as_slice(), m.header.extended), (SHIFTS.as_slice(), [7, 5]));
    assert!(found.warnings == [FactorWarning::EmptyRows { rows: 1 }], "{:?}", found.warnings);
    let [error, energy] = misfit(m, shifted, |_, _| true);
    assert!((error / energy).sqrt() < 1e-5, "all terms, in f32: {error} {energy}");
    let smallest = made(&matrix, &with(Goal::Bytes(1), None)).material.bytes_f32();
    for limit in (smallest..smallest + 400).step_by(40) {
        let found = made(&matrix, &with(Goal::Bytes(limit), None));
        assert!(found.material.bytes_f32() <= limit, "{limit}: {} {}", found.material.bytes_f32(), found.choice);
    }
}

/// Two non-negative terms, of another profile for each channel.
fn positive(i: usize, e: usize, c: usize) -> f64 {
    let first = (1 + i % 4) as f64 * (-0.2 * (e as f64 - 7.0).abs() * (1.0 + c as f64)).exp();
    let second = (1 + i / 4) as f64 * ((e * (c + 2)) % 5) as f64 * 0.2;
    2.0 * first + second
}

#[test]
fn a_non_negative_material_has_the_mean_of_each_channel_for_its_profile() {
    let matrix = matrix(0.0, positive, |_, _| true);
    let found = made(&matrix, &FactorOptions { terms: Some(2), ..options(Model::Peers2006) });
    let m = &found.material;
    assert_eq!((m.header.incident_planes, m.header.offset_planes, m.header.profile), (3, 3, true));
    assert_eq!(m.weights, [1.0, 1.0]);
    assert!(
        m.header.singular_values.is_empty()
            && m.incident_factors.iter().chain(m.offset_factors.all().iter()).all(|v| *v >= 0.0)
    );
    for c in 0..3 {
        for e in 0..SAMPLES {
            let mean = (0..ROWS).map(|i| positive(i, e, c)).sum::<f64>() / ROWS as f64;
            let found = f64::from(m.profile[c * SAMPLES + e]);
            assert!((found / mean - 1.0).abs() < 1e-6, "f32, channel {c} sample {e}: {found} {mean}");
        }
    }
    let [error, energy] = misfit(m, positive, |_, _| true);
    assert!((error / energy).sqrt() < 1e-2, "alternating least squares ends near the factors: {error} {energy}");
    assert!((found.rel_rmse - (error / energy).sqrt()).abs() < 1e-6, "f32: {}", found.rel_rmse);
    // T weights, factors of 12 points and 15 samples for each channel and term, three profiles.
    let bytes = |terms: usize| 4 * (terms + 3 * ROWS * terms + 3 * SAMPLES * terms + 3 * SAMPLES) as u64;
    let limited =
        |limit| made(&matrix, &FactorOptions { goal: Goal::Bytes(limit), ..options(Model::Peers2006) }).material;
    assert_eq!(limited(bytes(1)).bytes_f32(), bytes(1));
    assert_eq!(limited(bytes(2) - 1).bytes_f32(), bytes(1));
}
