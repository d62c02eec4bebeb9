//! Peak shift and normalization: from rows R'_d(x_i, d) to R''_d on a window that all of them share.
//!
//! # Conventions
//! - A row's `shift` is the offset, in whole samples, at which its peak was found; that sample goes to the centre.
//! - The common window is larger than the measured one by the largest shift in use on every side, so no sample is
//!   lost and nothing wraps. What a row did not measure of it is left to [`crate::factor`] to fill.

use super::rows::{RowView, intensity};
use acquire_material::Layout;
use pulp::{Arch, NullaryFnOnce};

/// How many standard deviations a sample must exceed the centre by to be taken for the peak.
///
/// Below it the two are equal as far as the measurement can tell, and a shift would turn noise into extra terms:
/// every noisy row of a homogeneous slab would be moved by a sample.
const PEAK_SIGMAS: f64 = 3.0;

/// Where one row goes on the common window.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
pub struct Placement {
    /// Offset of the peak from the lit point along x and y, samples; [0, 0] when the row is not shifted.
    pub shift: [i16; 2],
    /// The row's largest intensity, mm⁻²; 0 when it has no positive peak.
    pub scale: f64,
    /// Whether a brighter sample lies further away than a shift may reach.
    pub limited: bool,
}

/// Finds a row's peak and scale.
///
/// The peak is its brightest measured intensity within `limit` samples of the centre along each axis; of equals the
/// one nearest to the centre, then the first in reading order. It counts when it exceeds the centre by three
/// standard deviations of their difference; a centre that was not measured cannot be compared, and the row stays.
pub fn place(row: RowView<'_>, window: [usize; 2], limit: [usize; 2]) -> Placement {
    let (values, measured) = intensity(row);
    let centre = [window[0] / 2, window[1] / 2];
    let offset = |k: usize| [(k % window[0]) as i64 - centre[0] as i64, (k / window[0]) as i64 - centre[1] as i64];
    let within = |k: &usize| (0..2).all(|a| offset(*k)[a].unsigned_abs() <= limit[a] as u64);
    let far = |k: usize| offset(k).iter().map(|o| o * o).sum::<i64>();
    // The brightest of the samples within so many of the centre.
    let brightest = |reach: [usize; 2]| {
        let range =
            |a: usize| centre[a].saturating_sub(reach[a])..(centre[a].saturating_add(reach[a]) + 1).min(window[a]);
        let line = |y: usize| {
            let at = range(0).start + y * window[0];
            (at, &values[at..at + range(0).len()], &measured[at..at + range(0).len()])
        };
        let most = |y: usize| Arch::new().dispatch(Largest { values: line(y).1, measured: line(y).2 });
        let of_lines: Vec<f64> = range(1).map(most).collect();
        let largest = of_lines.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let bright = range(1).zip(&of_lines).filter(|(_, v)| **v == largest).flat_map(|(y, _)| {
            let (at, values, measured) = line(y);
            (0..values.len()).filter(move |&x| measured[x] && values[x] == largest).map(move |x| at + x)
        });
        bright.min_by_key(|&k| far(k))
    };
    let Some(largest) = brightest(window) else { return Placement::default() };
    if values[largest] <= 0.0 {
        return Placement::default();
    }
    let middle = centre[0] + centre[1] * window[0];
    let variance = |k: usize| row.variance[3 * k..3 * k + 3].iter().map(|&v| f64::from(v)).sum::<f64>() / 9.0;
    let exceeds =
        |k: usize, m: usize| values[k] - values[m] > PEAK_SIGMAS * (variance(k) + variance(m)).max(0.0).sqrt();
    let mut placement = Placement { scale: values[largest], ..Default::default() };
    if let Some(peak) = brightest(limit).filter(|_| measured[middle]) {
        if peak != middle && exceeds(peak, middle) {
            placement.shift = offset(peak).map(|o| o as i16);
        }
        placement.limited = limit != [0, 0] && !within(&largest) && exceeds(largest, peak);
    }
    placement
}

/// The largest measured value; −∞ when no sample was measured.
struct Largest<'a> {
    values: &'a [f64],
    measured: &'a [bool],
}

impl NullaryFnOnce for Largest<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        let mut lanes = [f64::NEG_INFINITY; 8];
        for (values, measured) in self.values.chunks(8).zip(self.measured.chunks(8)) {
            for ((lane, &v), &m) in lanes.iter_mut().zip(values).zip(measured) {
                *lane = if m && v > *lane { v } else { *lane };
            }
        }
        lanes.into_iter().fold(f64::NEG_INFINITY, f64::max)
    }
}

/// The common window for rows with these placements.
pub fn layout(window: [usize; 2], placements: &[Placement]) -> Layout {
    let reach = |a: usize| placements.iter().map(|p| usize::from(p.shift[a].unsigned_abs())).max().unwrap_or(0);
    Layout { window, extended: std::array::from_fn(|a| window[a] + 2 * reach(a)) }
}

/// Writes the normalized, shifted intensity of a row into `values` and where it was measured into `measured`, both on
/// the common window. Rows without a peak are zeros, and count as not measured.
pub fn normalized(row: RowView<'_>, placement: &Placement, layout: &Layout, values: &mut [f64], measured: &mut [bool]) {
    values.fill(0.0);
    measured.fill(false);
    if placement.scale <= 0.0 {
        return;
    }
    let (intensity, valid) = intensity(row);
    layout.for_each(placement.shift, |k, e| {
        values[e] = intensity[k] / placement.scale;
        measured[e] = valid[k];
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(window: [usize; 2], bright: &[(usize, usize, f32)], variance: f32) -> (Vec<f32>, Vec<f32>, Vec<u8>) {
        let n = window[0] * window[1] * 3;
        let mut response = vec![0.0; n];
        for &(x, y, v) in bright {
            let k = 3 * (x + y * window[0]);
            response[k..k + 3].fill(v);
        }
        (response, vec![variance; n], vec![1; n])
    }

    fn placed(window: [usize; 2], limit: [usize; 2], bright: &[(usize, usize, f32)], variance: f32) -> Placement {
        let (response, variance, valid) = row(window, bright, variance);
        place(RowView { response: &response, variance: &variance, valid: &valid }, window, limit)
    }

    #[test]
    fn the_peak_goes_to_the_centre_and_equal_peaks_are_decided_by_nearness_then_reading_order() {
        assert_eq!(placed([9, 9], [4, 4], &[(6, 1, 5.0), (4, 4, 1.0)], 0.0).shift, [2, -3]);
        assert_eq!(placed([9, 9], [4, 4], &[(1, 4, 5.0), (6, 4, 5.0)], 0.0).shift, [2, 0]);
        assert_eq!(placed([9, 9], [4, 4], &[(6, 4, 5.0), (2, 4, 5.0)], 0.0).shift, [-2, 0]);
    }

    #[test]
    fn a_peak_on_the_rim_beyond_the_limit_is_reported_and_still_sets_the_scale() {
        let placement = placed([9, 9], [2, 2], &[(0, 0, 7.0), (5, 4, 2.0), (4, 4, 1.0)], 0.0);
        assert_eq!(placement, Placement { shift: [1, 0], scale: 7.0, limited: true });
    }

    #[test]
    fn noise_does_not_move_a_row() {
        // The neighbour is brighter by 0.1; the difference of two intensities has sd sqrt(2 · 3 · 0.01 / 9) = 0.08.
        assert_eq!(placed([9, 9], [2, 2], &[(4, 4, 1.0), (5, 4, 1.1)], 0.01).shift, [0, 0]);
        assert_eq!(placed([9, 9], [2, 2], &[(4, 4, 1.0), (5, 4, 1.1)], 1e-6).shift, [1, 0]);
    }

    #[test]
    fn rows_without_a_positive_peak_have_no_scale() {
        assert_eq!(placed([3, 3], [1, 1], &[], 0.0), Placement::default());
        assert_eq!(placed([3, 3], [1, 1], &[(1, 1, -1.0)], 0.0), Placement::default());
    }

    #[test]
    fn shifted_rows_lose_nothing_and_do_not_wrap() {
        let window = [5, 3];
        let layout = layout(window, &[Placement { shift: [2, -1], scale: 1.0, limited: false }, Placement::default()]);
        assert_eq!(layout.extended, [9, 5]);
        let (response, variance, valid) = row(window, &[(4, 0, 3.0), (0, 2, 1.0)], 0.0);
        let view = RowView { response: &response, variance: &variance, valid: &valid };
        let placement = place(view, window, [2, 1]);
        assert_eq!(placement.shift, [2, -1]);
        let (mut values, mut measured) = (vec![9.0; layout.len()], vec![true; layout.len()]);
        normalized(view, &placement, &layout, &mut values, &mut measured);
        assert_eq!(values[4 + 2 * 9], 1.0, "the peak is in the middle");
        assert_eq!(values[4 * 9], 1.0 / 3.0, "the other sample keeps its distance");
        assert_eq!(measured.iter().filter(|&&m| m).count(), 15);
    }

    /// A row of 7 × 5 samples, dark but for `bright`: (x, y, three channels).
    fn coloured(bright: &[(usize, usize, [f32; 3])]) -> Vec<f32> {
        let mut response = vec![0.0; 105];
        for (x, y, rgb) in bright {
            response[3 * (x + 7 * y)..][..3].copy_from_slice(rgb);
        }
        response
    }

    #[test]
    fn the_peak_is_the_brightest_mean_of_the_channels_and_sets_the_scale() {
        // The first is brighter in red alone, the second in all: (9 + 1 + 1) / 3 < (3 + 5 + 4) / 3.
        let response = coloured(&[(1, 1, [9.0, 1.0, 1.0]), (5, 3, [3.0, 5.0, 4.0]), (3, 2, [1.0, 0.0, 0.5])]);
        let placed =
            |limit| place(RowView { response: &response, variance: &[0.0; 105], valid: &[1; 105] }, [7, 5], limit);
        assert_eq!(placed([3, 2]), Placement { shift: [2, 1], scale: 4.0, limited: false });
        // (5, 3) is two columns off and (1, 1) too: nothing lies within one but the centre, and what is brighter is
        // told.
        assert_eq!(placed([1, 2]), Placement { shift: [0, 0], scale: 4.0, limited: true });
        assert_eq!(placed([2, 0]), Placement { shift: [0, 0], scale: 4.0, limited: true });
        // Where shifts are not asked for there is nothing to say.
        assert_eq!(placed([0, 0]), Placement { shift: [0, 0], scale: 4.0, limited: false });
    }

    #[test]
    fn a_shift_needs_three_deviations_of_the_difference_of_two_intensities() {
        // Channels' variances add up to 0.09 and 0.27: intensities have a ninth of it, the difference 0.04; three
        // deviations are 0.6.
        let shift = |more: f32| {
            let response = coloured(&[(5, 1, [1.0 + 3.0 * more, 1.0, 1.0]), (3, 2, [0.0, 1.0, 2.0])]);
            let mut variance = vec![0.0; 105];
            variance[3 * (5 + 7)..][..3].copy_from_slice(&[0.01, 0.02, 0.06]);
            variance[3 * (3 + 14)..][..3].copy_from_slice(&[0.0, 0.03, 0.24]);
            place(RowView { response: &response, variance: &variance, valid: &[1; 105] }, [7, 5], [3, 2]).shift
        };
        assert_eq!((shift(0.59), shift(0.61)), ([0, 0], [2, -1]));
    }

    #[test]
    fn samples_of_which_a_channel_is_missing_are_no_peak_and_a_missing_centre_keeps_the_row() {
        let response = coloured(&[(0, 4, [9.0; 3]), (4, 1, [4.0, 5.0, 6.0]), (3, 2, [1.0; 3])]);
        let mut valid = vec![1; 105];
        valid[3 * 28 + 2] = 0;
        let placed =
            |valid: &[u8]| place(RowView { response: &response, variance: &[0.0; 105], valid }, [7, 5], [3, 2]);
        assert_eq!(placed(&valid), Placement { shift: [1, -1], scale: 5.0, limited: false });
        valid[3 * (3 + 14) + 1] = 0;
        assert_eq!(placed(&valid), Placement { shift: [0, 0], scale: 5.0, limited: false });
        assert_eq!(placed(&[0; 105]), Placement::default());
    }

    #[test]
    fn the_common_window_is_larger_by_the_largest_shift_of_each_axis() {
        let shifted = |shift| Placement { shift, ..Placement::default() };
        let layout = layout([7, 5], &[shifted([2, -1]), shifted([-3, 0]), shifted([1, 1])]);
        assert_eq!((layout.extended, layout.len(), layout.is_empty()), ([13, 7], 91, false));
        assert_eq!(super::layout([7, 5], &[]).extended, [7, 5]);
        assert!(Layout { window: [1, 1], extended: [0, 3] }.is_empty());
    }

    #[test]
    fn lines_of_a_window_fall_where_each_sample_does_and_are_cut_at_the_rim() {
        for (window, extended) in [([7, 5], [13, 7]), ([7, 5], [5, 3]), ([3, 5], [9, 1]), ([5, 1], [3, 7])] {
            let layout = Layout { window, extended };
            for shift in [[0, 0], [3, -1], [-2, 1], [1, 2], [-30, 0], [0, 30], [40, -40]] {
                // Offset of a sample from the lit point, less the shift, is its offset from the common window's centre.
                let mut expected = Vec::new();
                for (y, x) in (0..window[1]).flat_map(|y| (0..window[0]).map(move |x| (y, x))) {
                    let at = [0, 1].map(|a| {
                        let sample = [x, y][a] as i64 - (window[a] / 2) as i64;
                        sample - i64::from(shift[a]) + (extended[a] / 2) as i64
                    });
                    let inside = (0..2).all(|a| at[a] >= 0 && at[a] < extended[a] as i64);
                    let index = inside.then(|| (at[0] + at[1] * extended[0] as i64) as usize);
                    assert_eq!(layout.index(shift, [x, y]), index);
                    expected.extend(index.map(|e| (x + y * window[0], e)));
                }
                let mut found = Vec::new();
                layout.for_each(shift, |k, e| found.push((k, e)));
                assert_eq!(found, expected, "{layout:?} {shift:?}");
                let mut lines = 0;
                layout.for_each_line(shift, |k, _, n| {
                    assert!(n > 0 && k % window[0] + n <= window[0]);
                    lines += n;
                });
                assert_eq!(lines, expected.len());
            }
        }
    }

    #[test]
    fn normalized_rows_keep_their_gaps_and_rows_without_a_scale_are_blank() {
        let response = coloured(&[(4, 1, [4.0, 5.0, 6.0]), (0, 0, [1.0, 2.0, 4.5])]);
        let mut valid = vec![1; 105];
        valid[3 * 34] = 0;
        let row = RowView { response: &response, variance: &[0.0; 105], valid: &valid };
        let layout = Layout { window: [7, 5], extended: [9, 7] };
        let placement = Placement { shift: [1, -1], scale: 5.0, limited: false };
        let (mut values, mut measured) = (vec![7.0; 63], vec![true; 63]);
        normalized(row, &placement, &layout, &mut values, &mut measured);
        // (4, 1) goes to the middle (4, 3), and (0, 0), four columns to its left and a line above it, to (0, 2).
        assert_eq!((values[4 + 3 * 9], values[2 * 9]), (1.0, 0.5));
        assert_eq!(values.iter().filter(|&&v| v != 0.0).count(), 2);
        // Sample (6, 4) misses a channel; it lies at (6, 6).
        assert!(!measured[6 + 6 * 9] && measured[5 + 6 * 9]);
        assert_eq!(measured.iter().filter(|&&m| m).count(), 34);
        normalized(row, &Placement { scale: 0.0, ..placement }, &layout, &mut values, &mut measured);
        assert!(values.iter().all(|&v| v == 0.0) && !measured.contains(&true));
    }
}
