//! Orthonormal, or nearly orthonormal, transforms of a map, in f64 and in place.

use rustdct::{DctPlanner, TransformType2And3};
use std::collections::HashMap;
use std::sync::Arc;

/// How a map is turned into coefficients.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Transform {
    /// The map itself.
    None,
    /// Cosine transform (DCT-II) of the whole map.
    Cosine,
    /// Wavelets CDF 9/7 with two levels (`Cohen1992`).
    Wavelet2,
    /// The same with three levels.
    Wavelet3,
    /// Cosine transform of blocks of 8×8, which end at the map's rim.
    Blocks8,
}

/// All of them; a file names one by its place here.
pub(super) const ALL: [Transform; 5] =
    [Transform::None, Transform::Cosine, Transform::Wavelet2, Transform::Wavelet3, Transform::Blocks8];

/// Plans of the cosine transforms used so far.
#[derive(Default)]
pub(super) struct Plans {
    planner: Option<DctPlanner<f64>>,
    known: HashMap<usize, Arc<dyn TransformType2And3<f64>>>,
}

impl Plans {
    fn of(&mut self, length: usize) -> Arc<dyn TransformType2And3<f64>> {
        let planner = self.planner.get_or_insert_with(DctPlanner::new);
        Arc::clone(self.known.entry(length).or_insert_with(|| planner.plan_dct2(length)))
    }
}

/// Coefficients of a map of `size` (x, y), row-major, in its place.
pub(super) fn forward(transform: Transform, plans: &mut Plans, map: &mut [f64], size: [usize; 2]) {
    match transform {
        Transform::None => {}
        Transform::Cosine => along_both(map, size, size, |line| cosine(plans, line)),
        Transform::Wavelet2 => levels(size, 2).for_each(|s| along_both(map, size, s, analyse)),
        Transform::Wavelet3 => levels(size, 3).for_each(|s| along_both(map, size, s, analyse)),
        Transform::Blocks8 => blocks(map, size, |block, s| along_both(block, s, s, |line| cosine(plans, line))),
    }
}

/// The inverse of [`forward`].
pub(super) fn inverse(transform: Transform, plans: &mut Plans, map: &mut [f64], size: [usize; 2]) {
    let wavelet = |map: &mut [f64], count| {
        let sizes: Vec<_> = levels(size, count).collect();
        sizes.into_iter().rev().for_each(|s| along_both(map, size, s, synthesise));
    };
    match transform {
        Transform::None => {}
        Transform::Cosine => along_both(map, size, size, |line| inverse_cosine(plans, line)),
        Transform::Wavelet2 => wavelet(map, 2),
        Transform::Wavelet3 => wavelet(map, 3),
        Transform::Blocks8 => blocks(map, size, |block, s| along_both(block, s, s, |line| inverse_cosine(plans, line))),
    }
}

/// The corner of the map that each level splits.
fn levels(size: [usize; 2], count: usize) -> impl Iterator<Item = [usize; 2]> {
    std::iter::successors(Some(size), |s| Some(s.map(|v| v.div_ceil(2)))).take(count)
}

/// Applies `line` to the columns, then to the rows, of the corner `part` of a map of `size`.
fn along_both(map: &mut [f64], size: [usize; 2], part: [usize; 2], mut line: impl FnMut(&mut [f64])) {
    let mut column = vec![0.0; part[1]];
    for x in 0..part[0] {
        (0..part[1]).for_each(|y| column[y] = map[x + y * size[0]]);
        line(&mut column);
        (0..part[1]).for_each(|y| map[x + y * size[0]] = column[y]);
    }
    (0..part[1]).for_each(|y| line(&mut map[y * size[0]..][..part[0]]));
}

fn blocks(map: &mut [f64], size: [usize; 2], mut each: impl FnMut(&mut [f64], [usize; 2])) {
    for y in (0..size[1]).step_by(8) {
        for x in (0..size[0]).step_by(8) {
            let part = [(size[0] - x).min(8), (size[1] - y).min(8)];
            let at = |k: usize| x + k % part[0] + (y + k / part[0]) * size[0];
            let mut block: Vec<f64> = (0..part[0] * part[1]).map(|k| map[at(k)]).collect();
            each(&mut block, part);
            block.iter().enumerate().for_each(|(k, &v)| map[at(k)] = v);
        }
    }
}

fn cosine(plans: &mut Plans, line: &mut [f64]) {
    let n = line.len() as f64;
    plans.of(line.len()).process_dct2(line);
    line.iter_mut().for_each(|v| *v *= (2.0 / n).sqrt());
    line[0] *= std::f64::consts::FRAC_1_SQRT_2;
}

fn inverse_cosine(plans: &mut Plans, line: &mut [f64]) {
    let n = line.len() as f64;
    line[0] *= std::f64::consts::SQRT_2;
    line.iter_mut().for_each(|v| *v *= (2.0 / n).sqrt());
    plans.of(line.len()).process_dct3(line);
}

/// Lifting steps and scale of CDF 9/7 (`Daubechies1998`).
const LIFTS: [f64; 4] = [-1.586_134_342_059_924, -0.052_980_118_572_961, 0.882_911_075_530_934, 0.443_506_852_043_971];
const SCALE: f64 = 1.149_604_398_860_241;

/// Adds `factor` times the sum of its two neighbours to every second sample from `first` on; mirrored at the ends.
fn lift(line: &mut [f64], first: usize, factor: f64) {
    let last = line.len() - 1;
    for k in (first..=last).step_by(2) {
        let (left, right) = (if k == 0 { 1 } else { k - 1 }, if k == last { last - 1 } else { k + 1 });
        line[k] += factor * (line[left] + line[right]);
    }
}

fn analyse(line: &mut [f64]) {
    if line.len() < 2 {
        return;
    }
    LIFTS.iter().enumerate().for_each(|(k, &factor)| lift(line, 1 - k % 2, factor));
    let low = line.iter().step_by(2).map(|v| v * SCALE);
    let split: Vec<f64> = low.chain(line.iter().skip(1).step_by(2).map(|v| v / SCALE)).collect();
    line.copy_from_slice(&split);
}

fn synthesise(line: &mut [f64]) {
    if line.len() < 2 {
        return;
    }
    let split = line.to_vec();
    let half = line.len().div_ceil(2);
    line.iter_mut().step_by(2).zip(&split).for_each(|(v, s)| *v = s / SCALE);
    line.iter_mut().skip(1).step_by(2).zip(&split[half..]).for_each(|(v, s)| *v = s * SCALE);
    LIFTS.iter().enumerate().rev().for_each(|(k, &factor)| lift(line, 1 - k % 2, -factor));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_transform_of_every_shape_is_undone_and_keeps_the_norm() {
        for size in [[1, 1], [1, 7], [9, 1], [2, 2], [5, 3], [31, 31], [16, 24], [37, 2]] {
            let map: Vec<f64> = (0..size[0] * size[1]).map(|k| ((k * k) as f64 * 0.37).sin() + 0.5).collect();
            let norm = |m: &[f64]| m.iter().map(|v| v * v).sum::<f64>().sqrt();
            for transform in ALL {
                let (mut plans, mut back) = (Plans::default(), map.clone());
                forward(transform, &mut plans, &mut back, size);
                let ratio = norm(&back) / norm(&map);
                // CDF 9/7 is biorthogonal and nearly orthonormal inside long lines; lines of few samples, all rim, are
                // farther off
                let room = match transform {
                    Transform::Wavelet2 | Transform::Wavelet3 => 0.5,
                    _ => 1e-12, // rounding
                };
                assert!((ratio - 1.0).abs() < room, "{transform:?} {size:?}: {ratio}");
                inverse(transform, &mut plans, &mut back, size);
                let error = map.iter().zip(&back).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(error < 1e-12, "rounding, {transform:?} {size:?}: {error}");
            }
        }
    }

    /// The orthonormal cosine transform by its definition.
    fn naive_dct(map: &[f64], [w, h]: [usize; 2]) -> Vec<f64> {
        let part = |n: usize, k: usize, x: usize| {
            let norm = if k == 0 { 1.0 } else { 2.0 } / n as f64;
            norm.sqrt() * (std::f64::consts::PI * k as f64 * (x as f64 + 0.5) / n as f64).cos()
        };
        let entry =
            |k: usize| -> f64 { (0..w * h).map(|s| map[s] * part(w, k % w, s % w) * part(h, k / w, s / w)).sum() };
        (0..w * h).map(entry).collect()
    }

    fn uneven(size: [usize; 2]) -> Vec<f64> {
        (0..size[0] * size[1]).map(|k| ((k * k) as f64 * 0.37).sin() + 0.1 * (k % size[0]) as f64).collect()
    }

    #[test]
    fn the_cosine_transform_is_its_definition() {
        for size in [[7, 5], [1, 6], [12, 3], [31, 2]] {
            let map = uneven(size);
            let mut found = map.clone();
            forward(Transform::Cosine, &mut Plans::default(), &mut found, size);
            let expected = naive_dct(&map, size);
            // Rounding of sums of a hundred numbers.
            assert!(
                found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-13),
                "{size:?}: {found:?} {expected:?}"
            );
        }
    }

    #[test]
    fn blocks_of_eight_are_transformed_each_by_itself_up_to_the_rim() {
        let size = [19, 10];
        let map = uneven(size);
        let mut found = map.clone();
        forward(Transform::Blocks8, &mut Plans::default(), &mut found, size);
        for (x, y, w, h) in [(0, 0, 8, 8), (8, 0, 8, 8), (16, 0, 3, 8), (0, 8, 8, 2), (8, 8, 8, 2), (16, 8, 3, 2)] {
            let at = |k: usize| x + k % w + (y + k / w) * size[0];
            let block: Vec<f64> = (0..w * h).map(|k| map[at(k)]).collect();
            for (k, e) in naive_dct(&block, [w, h]).into_iter().enumerate() {
                assert!((found[at(k)] - e).abs() < 1e-13, "rounding, block {x} {y}: {} {e}", found[at(k)]);
            }
        }
    }

    /// One level of CDF 9/7 by convolution with its filters (`Cohen1992`), the line mirrored at its end samples.
    fn filtered(line: &[f64]) -> Vec<f64> {
        // Analysis filters, unit gain at zero frequency for the low one, as in JPEG 2000 part 1, table F.4.
        const LOW: [f64; 5] = [
            0.602_949_018_236_357_9,
            0.266_864_118_442_872_3,
            -0.078_223_266_528_987_85,
            -0.016_864_118_442_874_95,
            0.026_748_757_410_809_76,
        ];
        const HIGH: [f64; 4] =
            [1.115_087_052_456_994, -0.591_271_763_114_247, -0.057_543_526_228_499_57, 0.091_271_763_114_249_48];
        let n = line.len() as isize;
        let mirrored = |k: isize| {
            let k = k.rem_euclid(2 * (n - 1));
            line[k.min(2 * (n - 1) - k) as usize]
        };
        let sum = |taps: &[f64], at: isize| -> f64 {
            let both = |(d, t): (usize, &f64)| t * (mirrored(at - d as isize) + mirrored(at + d as isize));
            taps[0] * mirrored(at) + taps.iter().enumerate().skip(1).map(both).sum::<f64>()
        };
        let root = 2.0_f64.sqrt();
        let low = (0..n).step_by(2).map(|k| root * sum(&LOW, k));
        low.chain((1..n).step_by(2).map(|k| sum(&HIGH, k) / root)).collect()
    }

    #[test]
    fn a_level_of_the_wavelet_is_a_convolution_with_its_published_filters() {
        for n in [12, 13, 31] {
            let line = uneven([n, 1]);
            let mut found = line.clone();
            analyse(&mut found);
            let expected = filtered(&line);
            for (a, b) in found.iter().zip(&expected) {
                // Lifting steps and scale are published to 12 digits or more.
                assert!((a - b).abs() < 1e-9, "{n}: {a} {b}");
            }
        }
    }

    #[test]
    fn levels_of_the_wavelet_split_the_corner_of_the_level_before() {
        let size = [11, 6];
        let map = uneven(size);
        for (transform, count) in [(Transform::Wavelet2, 2), (Transform::Wavelet3, 3)] {
            let mut found = map.clone();
            forward(transform, &mut Plans::default(), &mut found, size);
            let mut expected = map.clone();
            for part in [[11, 6], [6, 3], [3, 2]].into_iter().take(count) {
                for x in 0..part[0] {
                    let column: Vec<f64> = (0..part[1]).map(|y| expected[x + 11 * y]).collect();
                    filtered(&column).iter().enumerate().for_each(|(y, v)| expected[x + 11 * y] = *v);
                }
                for y in 0..part[1] {
                    let line = filtered(&expected[11 * y..11 * y + part[0]]);
                    expected[11 * y..11 * y + part[0]].copy_from_slice(&line);
                }
            }
            for (at, (a, b)) in found.iter().zip(&expected).enumerate() {
                assert!((a - b).abs() < 1e-8, "digits of the filters, {transform:?} {at}: {a} {b}");
            }
        }
    }
}
