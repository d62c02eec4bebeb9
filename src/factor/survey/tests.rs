use super::super::test_matrices::{StoredMatrix, stored};
use super::*;
use crate::transport::Row;
use crate::transport::rows::gradient;

const POINTS: [usize; 2] = [3, 2];
const WINDOW: [usize; 2] = [7, 5];
/// Where the peaks of the six rows are.
const SHIFTS: [[i16; 2]; 6] = [[0, 0], [1, 0], [0, -1], [-1, 1], [0, 0], [1, -1]];
const SD_MM: [f64; 6] = [0.01, 0.05, 0.0, 0.02, 0.04, 0.03];
const PITCH_MM: f64 = 0.25;

/// A peak at its shift and an uneven, coloured rest; row 4 has nothing.
fn response(i: usize, k: usize, c: usize) -> f64 {
    let at = [3 + SHIFTS[i][0] as usize, (2 + isize::from(SHIFTS[i][1])) as usize];
    let rest = 0.1 + 0.02 * ((5 * k + 3 * c + 7 * i) % 11) as f64;
    let peak = if k == at[0] + 7 * at[1] { 3.0 + i as f64 } else { 0.0 };
    if i == 4 { 0.0 } else { (peak + rest) * [1.0, 0.75, 0.5][c] }
}

fn valid(i: usize, k: usize, c: usize) -> bool {
    !((i == 1 && k.is_multiple_of(7)) || (i == 3 && (k, c) == (5, 1)))
}

fn photons(i: usize, k: usize, c: usize) -> f64 {
    1e-4 * (1 + i) as f64 * (1 + c) as f64 * (1.0 + (k % 7) as f64 + if k == 18 { 40.0 } else { 0.0 })
}

fn sd_px(i: usize) -> f64 {
    SD_MM[i] / PITCH_MM
}

/// sd² |∇R|² of one plane of a row.
fn steep(i: usize, values: &[f64], measured: &[bool]) -> Vec<f64> {
    let [gx, gy] = gradient(values, measured, WINDOW);
    gx.iter().zip(&gy).map(|(x, y)| sd_px(i).powi(2) * (x * x + y * y)).collect()
}

fn channel(i: usize, c: usize) -> (Vec<f64>, Vec<bool>) {
    let measured: Vec<bool> = (0..35).map(|k| valid(i, k, c)).collect();
    ((0..35).map(|k| if measured[k] { response(i, k, c) } else { 0.0 }).collect(), measured)
}

fn intensity(i: usize) -> (Vec<f64>, Vec<bool>) {
    let measured: Vec<bool> = (0..35).map(|k| (0..3).all(|c| valid(i, k, c))).collect();
    let mean = |k: usize| (0..3).map(|c| response(i, k, c)).sum::<f64>() / 3.0;
    ((0..35).map(|k| if measured[k] { mean(k) } else { 0.0 }).collect(), measured)
}

fn matrix() -> StoredMatrix {
    let row = |i: usize| {
        let place: Vec<Vec<f64>> = (0..3).map(|c| channel(i, c)).map(|(v, m)| steep(i, &v, &m)).collect();
        let all = || (0..105).map(|s| (s / 3, s % 3));
        Row {
            response: all().map(|(k, c)| if valid(i, k, c) { response(i, k, c) as f32 } else { 0.0 }).collect(),
            variance: all()
                .map(|(k, c)| if valid(i, k, c) { (photons(i, k, c) + place[c][k]) as f32 } else { 0.0 })
                .collect(),
            valid: all().map(|(k, c)| valid(i, k, c)).collect(),
        }
    };
    stored(POINTS, WINDOW, |i| SD_MM[i], row)
}

/// What the survey should find, by a loop over rows, planes and samples of the common window (9 × 7 here).
#[derive(Default)]
struct Naive {
    mean: Vec<Option<f64>>,
    rows: Vec<f64>,
    columns: Vec<f64>,
    noise_mean: f64,
}

fn naive(content: Content, unit: f64) -> Naive {
    let planes = content.planes();
    let (mut sums, mut noise, mut count) = (vec![0.0; planes * 63], vec![0.0; planes * 63], vec![0; planes * 63]);
    let mut found = Naive::default();
    for (i, shift) in SHIFTS.iter().enumerate() {
        let (all, _) = intensity(i);
        let largest = all.iter().copied().fold(0.0, f64::max);
        let scale = if content == Content::Intensity { largest } else { unit };
        if content == Content::Intensity && largest == 0.0 {
            found.rows.push(0.0);
            continue;
        }
        let mut row = 0.0;
        for p in 0..planes {
            let (values, measured) = if planes == 3 { channel(i, p) } else { intensity(i) };
            for k in (0..35).filter(|&k| measured[k]) {
                let variance = match planes {
                    3 => photons(i, k, p),
                    _ => (0..3).map(|c| photons(i, k, c)).sum::<f64>() / 9.0,
                };
                // The sample at the row's shift from the centre goes to the centre of the common window.
                let x = (k % 7) as isize - 3 - isize::from(shift[0]) + 4;
                let y = (k / 7) as isize - 2 - isize::from(shift[1]) + 3;
                let at = p * 63 + (x + 9 * y) as usize;
                sums[at] += values[k] / scale;
                noise[at] += variance / (scale * scale);
                count[at] += 1;
                row += variance / (scale * scale);
            }
        }
        found.rows.push(row);
    }
    found.noise_mean = noise.iter().sum::<f64>() / count.iter().sum::<usize>() as f64;
    found.columns = noise;
    found.mean = sums.iter().zip(&count).map(|(s, &n)| (n > 0).then(|| s / n as f64)).collect();
    found
}

#[test]
fn the_first_pass_finds_what_a_loop_over_all_entries_does() {
    let matrix = matrix();
    // The largest response of all: row 5's red peak.
    let peak = response(5, 4 + 7, 0);
    for content in [Content::Intensity, Content::Grey, Content::Channels] {
        let unit = if content == Content::Intensity { 1.0 } else { peak };
        let expected = naive(content, unit);
        let found = survey(&matrix.reader, content, [2, 1]).unwrap();
        assert_eq!(found.layout, Layout { window: WINDOW, extended: [9, 7] }, "as far as shifts go, not the limit");
        assert_eq!(found.placements.iter().map(|p| p.shift).collect::<Vec<_>>(), SHIFTS);
        // What is stored is f32.
        let near = |a: f64, b: f64| (a - b).abs() < 3e-7 * b.abs().max(1e-2);
        for (at, (m, e)) in found.mean.iter().zip(&expected.mean).enumerate() {
            assert!(e.is_none_or(|e| near(*m, e)), "{content:?} mean {at}: {m} {e:?}");
        }
        let noise = &found.noise;
        let all = |found: &[f64], expected: &[f64], name: &str| {
            assert_eq!(found.len(), expected.len());
            let largest = expected.iter().copied().fold(0.0, f64::max);
            for (a, b) in found.iter().zip(expected) {
                // Variances are f32, and that of the place, up to a hundred times that of photons, was taken out of
                // them.
                assert!((a - b).abs() < 1e-5 * largest, "{content:?} {name}: {a} {b}");
            }
        };
        all(&noise.rows, &expected.rows, "rows");
        all(&noise.columns, &expected.columns, "columns");
        all(&[noise.mean], &[expected.noise_mean], "mean");
        all(
            &noise.position_sd_px,
            &[0, 1, 2, 3, 4, 5].map(|i: usize| SD_MM[i] / matrix.reader.header().pitch_mm),
            "place",
        );
        let entries =
            || (0..6).flat_map(|i| (0..105).map(move |s| (i, s / 3, s % 3))).filter(|&(i, k, c)| valid(i, k, c));
        assert_eq!(found.entries, entries().count() as u64);
        let energy: f64 = entries().map(|(i, k, c)| response(i, k, c).powi(2)).sum();
        assert!(near(found.energy, energy) && near(found.peak, peak), "{} {energy}", found.energy);
        assert!(!found.complete);
        assert_eq!(found.warnings, [FactorWarning::EmptyRows { rows: 1 }]);
        let misfit = found.misfit(2.5);
        assert_eq!((misfit.error, misfit.energy, misfit.peak), (2.5, found.energy, found.peak));
        assert_eq!(misfit.entries, found.entries);
    }
}

#[test]
fn the_mean_is_extended_where_no_row_reaches() {
    let matrix = matrix();
    let found = survey(&matrix.reader, Content::Channels, [2, 1]).unwrap();
    // No shift reaches the upper left corner of the common window: its line's first sample that some row measured.
    let expected = naive(Content::Channels, found.peak);
    for p in 0..3 {
        let line = |y: usize| &expected.mean[p * 63 + 9 * y..][..9];
        assert!(line(6)[8].is_none() && line(6)[7].is_some(), "a corner that is beyond all rows");
        let (a, b) = (found.mean[p * 63 + 9 * 6 + 8], line(6)[7].unwrap());
        assert!((a - b).abs() < 1e-7, "f32: {a} {b}");
    }
}

#[test]
fn columns_outside_a_shifted_window_are_those_that_it_cannot_measure() {
    let matrix = matrix();
    let found = survey(&matrix.reader, Content::Channels, [2, 1]).unwrap();
    for shift in SHIFTS {
        let mut expected = Vec::new();
        for at in 0..3 * 63_u32 {
            let (x, y) =
                ((at % 9) as isize - 4 + isize::from(shift[0]), (at % 63 / 9) as isize - 3 + isize::from(shift[1]));
            if x.abs() > 3 || y.abs() > 2 {
                expected.push(at);
            }
        }
        assert_eq!(found.outside(shift, 3), expected);
        assert_eq!(found.outside(shift, 1), expected[..expected.len() / 3]);
    }
}

#[test]
fn rows_on_the_same_window_without_gaps_are_complete() {
    let row = |i: usize| Row {
        response: (0..45).map(|s| if s / 3 == 7 { 5.0 + i as f32 } else { (s % 3) as f32 * 0.1 }).collect(),
        variance: vec![0.0; 45],
        valid: vec![true; 45],
    };
    let matrix = stored([2, 3], [5, 3], |_| 0.0, row);
    for content in [Content::Intensity, Content::Grey, Content::Channels] {
        let found = survey(&matrix.reader, content, [1, 1]).unwrap();
        assert!(found.complete && found.warnings.is_empty());
        assert_eq!(found.layout.extended, [5, 3]);
        assert_eq!(found.mean.len(), 15 * content.planes());
    }
}

#[test]
fn rows_whose_brightest_sample_is_out_of_reach_are_reported_with_the_limit() {
    let row = |i: usize| {
        let at = [6, 17, 0][i];
        let response = (0..105)
            .map(|s| {
                if s / 3 == 17 {
                    2.0
                } else if s / 3 == at {
                    9.0
                } else {
                    0.5
                }
            })
            .collect();
        Row { response, variance: vec![1e-6; 105], valid: vec![true; 105] }
    };
    let matrix = stored([3, 1], WINDOW, |_| 0.0, row);
    let found = survey(&matrix.reader, Content::Intensity, [2, 1]).unwrap();
    assert_eq!(found.warnings, [FactorWarning::ShiftLimited { rows: 2, limit: 2 }]);
}

#[test]
fn what_divides_a_row_is_its_largest_intensity_or_nothing() {
    let placement = Placement { scale: 3.5, ..Default::default() };
    assert_eq!(scale(Content::Intensity, Some(&placement)), 3.5);
    assert_eq!(scale(Content::Intensity, Some(&Placement::default())), f64::INFINITY);
    assert_eq!(scale(Content::Intensity, None), f64::INFINITY);
    assert_eq!((scale(Content::Grey, Some(&placement)), scale(Content::Channels, None)), (1.0, 1.0));
}

/// A row of 50 samples whose red and blue are `z` standard deviations of a difference from green.
fn differing(z: [f64; 2], variance: f32, valid: &[u8]) -> GreyTest {
    // Green has three times the variance of the others: the difference has four times.
    let sd = (4.0 * f64::from(variance)).sqrt();
    let response: Vec<f32> = (0..50).flat_map(|_| [4.0 + (z[0] * sd) as f32, 4.0, 4.0 - (z[1] * sd) as f32]).collect();
    let variance: Vec<f32> = (0..50).flat_map(|_| [variance, 3.0 * variance, variance]).collect();
    let mut test = GreyTest::default();
    test.add(RowView { response: &response, variance: &variance, valid });
    test
}

#[test]
fn channels_that_differ_by_their_noise_are_grey_and_by_more_are_not() {
    // 100 differences: the mean of z² may be up to 1 + 5 √(2/100) = 1.7071.
    assert!(differing([1.0, 1.0], 0.01, &[1; 150]).is_grey());
    assert!(differing([1.306; 2], 0.01, &[1; 150]).is_grey(), "1.7056");
    assert!(!differing([1.307; 2], 0.01, &[1; 150]).is_grey(), "1.7082");
    // Either side counts: (2.4 + 1) / 2 and less.
    assert!(differing([1.55, 1.0], 0.01, &[1; 150]).is_grey(), "1.70125");
    assert!(!differing([1.56, 1.0], 0.01, &[1; 150]).is_grey(), "1.7168");
    assert!(!differing([1.0, 1.56], 0.01, &[1; 150]).is_grey());
    // What was not measured is no colour: no green, or no red beside a grey blue.
    let without = |c: usize| (0..150).map(|s| u8::from(s % 3 != c)).collect::<Vec<u8>>();
    assert!(differing([9.0, 9.0], 0.01, &without(1)).is_grey());
    assert!(differing([9.0, 1.0], 0.01, &without(0)).is_grey());
    assert!(!differing([9.0, 1.0], 0.01, &without(2)).is_grey());
    assert!(GreyTest::default().is_grey(), "nothing differs in nothing");
}

#[test]
fn without_variance_a_millionth_of_the_largest_response_is_colour() {
    let of = |by: f32| {
        let mut test = GreyTest::default();
        let response = [-1e6, -1e6, -1e6, 8.0, 8.0, 8.0 + by];
        test.add(RowView { response: &response, variance: &[0.0; 6], valid: &[1; 6] });
        test
    };
    assert!(of(0.9).is_grey() && of(-0.9).is_grey());
    assert!(!of(1.1).is_grey() && !of(-1.1).is_grey());
    let mut joined = differing([1.0, 1.0], 0.01, &[1; 150]);
    joined.join(&of(1.1));
    assert!(!joined.is_grey(), "colour anywhere is colour");
}

#[test]
fn grey_tests_of_parts_are_that_of_the_whole() {
    let mut joined = differing([1.0, 1.0], 0.01, &[1; 150]);
    joined.join(&differing([1.7, 1.7], 0.01, &[1; 150]));
    // (1 + 2.89) / 2 = 1.945 of 200, above 1.5.
    assert!(!joined.is_grey());
    let mut joined = differing([1.0, 1.0], 0.01, &[1; 150]);
    joined.join(&differing([1.35, 1.35], 0.01, &[1; 150]));
    // 1.8225 alone is above 1.7071; with the first, 1.411 of 200 is below 1.5.
    assert!(joined.is_grey());
}
