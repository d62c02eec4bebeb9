use super::super::test_matrices::{StoredMatrix, stored};
use super::*;
use crate::progress::Progress;
use crate::transport::Row;
use crate::transport::rows::RowView;

const WINDOW: [usize; 2] = [5, 3];
const SHIFTS: [[i16; 2]; 6] = [[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [0, 0]];

fn valid(i: usize, k: usize, c: usize) -> bool {
    !(i == 2 && c == 1 && k == 4 || i == 5 && k.is_multiple_of(5))
}

/// A peak where the shift says, another colour for each row.
fn response(i: usize, k: usize, c: usize) -> f32 {
    let at = 2 + SHIFTS[i][0] + 5 * (1 + SHIFTS[i][1]);
    let peak = if k == at as usize { 4.0 } else { 0.0 };
    if valid(i, k, c) { (peak + ((3 * k + 5 * c + i) % 7) as f32 * 0.125) * (1.0 + c as f32 * 0.5) } else { 0.0 }
}

fn matrix() -> StoredMatrix {
    stored(
        [2, 3],
        WINDOW,
        |_| 0.0,
        |i| Row {
            response: (0..45).map(|s| response(i, s / 3, s % 3)).collect(),
            variance: vec![1e-9; 45],
            valid: (0..45).map(|s| valid(i, s / 3, s % 3)).collect(),
        },
    )
}

/// Row i on the common window of 7 × 5; `None` where it was not measured.
fn placed(content: Content, i: usize, unit: f64) -> Vec<Option<f64>> {
    let grey = |k: usize| (0..3).map(|c| f64::from(response(i, k, c))).sum::<f64>() / 3.0;
    let whole = |k: usize| (0..3).all(|c| valid(i, k, c));
    let largest = (0..15).filter(|&k| whole(k)).map(grey).fold(0.0, f64::max);
    let mut row = vec![None; 35 * content.planes()];
    for p in 0..content.planes() {
        for k in 0..15 {
            let x = (k % 5) as isize - 2 - isize::from(SHIFTS[i][0]) + 3;
            let y = (k / 5) as isize - 1 - isize::from(SHIFTS[i][1]) + 2;
            row[p * 35 + (x + 7 * y) as usize] = match content {
                Content::Channels => valid(i, k, p).then(|| f64::from(response(i, k, p)) / unit),
                Content::Grey => whole(k).then(|| grey(k) / unit),
                Content::Intensity => whole(k).then(|| grey(k) / largest),
            };
        }
    }
    row
}

fn all_rows(rows: &PreparedRows<'_>) -> (Vec<f32>, Vec<Vec<u32>>) {
    let (mut values, mut gaps) = (Vec::new(), Vec::new());
    rows.for_each_chunk("test", &mut |first, block, missing| {
        assert_eq!(first, gaps.len(), "in order");
        values.extend_from_slice(block);
        gaps.extend(missing.iter().map(|m| match m {
            Missing::Nothing => Vec::new(),
            Missing::Pattern(k) => rows.patterns[*k].1.clone(),
            Missing::Columns(columns) => columns.clone(),
        }));
        Ok(())
    })
    .unwrap();
    (values, gaps)
}

#[test]
fn rows_are_placed_by_their_shifts_and_gaps_filled_with_the_mean_in_memory_or_not() {
    let (matrix, progress) = (matrix(), Progress::silent());
    for content in [Content::Intensity, Content::Grey, Content::Channels] {
        for memory in [1 << 20, 0] {
            let rows =
                PreparedRows::new(Passes::here(&matrix.reader, &progress), content, [1, 1], memory, 0.0, None).unwrap();
            assert_eq!((rows.how_read().is_empty(), rows.has_gaps()), (memory > 0, true));
            let columns = 35 * content.planes();
            assert_eq!(rows.shape(), (6, columns));
            let peak = (0..6).flat_map(|i| (0..45).map(move |s| response(i, s / 3, s % 3))).fold(0.0, f32::max);
            let unit = if content == Content::Intensity { 1.0 } else { f64::from(peak) };
            assert_eq!(rows.unit(), unit);
            let mean = &rows.survey.mean;
            let (values, gaps) = all_rows(&rows);
            for i in 0..6 {
                let expected = placed(content, i, unit);
                // The mean profile in the amount that suits the measured samples best.
                let measured = |d: &usize| expected[*d].is_some();
                let along: f64 = (0..columns).filter(measured).map(|d| expected[d].unwrap() * mean[d]).sum();
                let square: f64 = (0..columns).filter(measured).map(|d| mean[d] * mean[d]).sum();
                for d in 0..columns {
                    let e = expected[d].unwrap_or(along / square * mean[d]);
                    let found = f64::from(values[i * columns + d]);
                    assert!((found - e).abs() < 1e-6, "f32, {content:?} row {i} column {d}: {found} {e}");
                }
                let missing: Vec<u32> = (0..columns).filter(|d| !measured(d)).map(|d| d as u32).collect();
                assert_eq!(gaps[i], missing, "{content:?} row {i}");
            }
        }
    }
}

#[test]
fn gaps_are_estimated_anew_from_another_basis_in_memory_or_not() {
    let (matrix, progress) = (matrix(), Progress::silent());
    let mut found = Vec::new();
    for memory in [1 << 20, 0] {
        let mut rows =
            PreparedRows::new(Passes::here(&matrix.reader, &progress), Content::Grey, [1, 1], memory, 0.0, None)
                .unwrap();
        let (before, gaps) = all_rows(&rows);
        let flat = Basis::mean(&(0..35).map(|d| 1.0 + 0.1 * f64::from(d)).collect::<Vec<_>>());
        rows.refill(flat);
        let (after, _) = all_rows(&rows);
        for i in 0..6 {
            let seen: Vec<usize> = (0..35).filter(|d| !gaps[i].contains(&(*d as u32))).collect();
            let profile = |d: usize| 1.0 + 0.1 * d as f64;
            let along: f64 = seen.iter().map(|&d| f64::from(after[35 * i + d]) * profile(d)).sum();
            let square: f64 = seen.iter().map(|&d| profile(d).powi(2)).sum();
            for d in 0..35 {
                let (b, a) = (before[35 * i + d], after[35 * i + d]);
                match seen.contains(&d) {
                    true => assert_eq!(a, b),
                    false => assert!((f64::from(a) - along / square * profile(d)).abs() < 1e-6, "f32 of up to 4"),
                }
            }
        }
        found.push(after);
    }
    assert_eq!(found[0], found[1]);
}

#[test]
fn planes_are_taken_out_of_a_row_over_its_scale_and_zero_where_not_measured() {
    let response: Vec<f32> = vec![3.0, 6.0, 12.0, 1.0, 2.0, 6.0, 9.0, 8.0, 7.0];
    let valid = [1, 1, 1, 1, 1, 0, 1, 1, 1];
    let row = RowView { response: &response, variance: &[], valid: &valid };
    let mut one = [9.0; 3];
    for content in [Content::Intensity, Content::Grey] {
        let measured = content.extract(row, 2.0, &mut one).unwrap();
        assert_eq!((one, &*measured), ([3.5, 0.0, 4.0], &[true, false, true][..]));
    }
    let mut three = [9.0; 9];
    let measured = Content::Channels.extract(row, 2.0, &mut three).unwrap();
    assert_eq!(three, [1.5, 0.5, 4.5, 3.0, 1.0, 4.0, 6.0, 0.0, 3.5]);
    assert_eq!(&*measured, [true, true, true, true, true, true, true, false, true]);
    let complete = RowView { valid: &[1; 9], ..row };
    assert!(Content::Channels.extract(complete, 1.0, &mut three).is_none());
    assert_eq!(three, [3.0, 1.0, 9.0, 6.0, 2.0, 8.0, 12.0, 6.0, 7.0]);
}

#[test]
fn only_rows_as_they_were_measured_have_a_unit() {
    assert_eq!([Content::Intensity, Content::Grey, Content::Channels].map(|c| c.unit(8.0)), [1.0, 8.0, 8.0]);
    assert_eq!([0.0, -2.0, f64::NAN].map(|peak| Content::Channels.unit(peak)), [1.0; 3]);
    assert_eq!([Content::Intensity, Content::Grey, Content::Channels].map(Content::planes), [1, 1, 3]);
    let counted = [Content::Intensity, Content::Grey, Content::Channels].map(Content::channels_per_plane);
    assert_eq!(counted, [1.0, 3.0, 1.0]);
}
