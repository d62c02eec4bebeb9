use super::*;
use crate::Error;
use crate::naive;
use crate::response::tests::every_kind;
use rand::{RngExt, SeedableRng};

/// All offsets of a window and one beyond it on every side.
fn offsets(window: [usize; 2]) -> Vec<[isize; 2]> {
    let [rx, ry] = window.map(|w| (w / 2) as isize + 1);
    (-ry..=ry).flat_map(|y| (-rx..=rx).map(move |x| [x, y])).collect()
}

#[test]
fn a_point_is_that_of_its_row() {
    for m in every_kind() {
        let evaluator = Evaluator::new(&m).unwrap();
        for (i, offset) in (0..7).flat_map(|i| offsets(m.header.window).into_iter().map(move |o| (i, o))) {
            let (a, b) = (evaluator.response(i, offset), m.response(i, offset));
            assert_eq!(a.is_some(), b.is_some());
            for (a, b) in a.into_iter().flatten().zip(b.into_iter().flatten()) {
                assert!((a - b).abs() <= 1e-6 * b.abs().max(1e-6), "a rounding of f32 at most: {a} {b}");
            }
        }
        assert_eq!(evaluator.response(0, [isize::MAX, isize::MIN]), None);
    }
}

#[test]
fn millimetres_meet_lit_points_and_samples_and_are_linear_between_them() {
    for m in every_kind() {
        let (h, evaluator) = (&m.header, Evaluator::new(&m).unwrap());
        for (i, offset) in (0..6).flat_map(|i| offsets(h.window).into_iter().map(move |o| (i, o))) {
            let x_i = m.lit_mm[i];
            let x_o = [0, 1].map(|a| x_i[a] + offset[a] as f64 * h.pitch_mm);
            let expected = m.response(i, offset).unwrap_or([0.0; 3]);
            for found in [evaluator.nearest(x_i, x_o), evaluator.between(x_i, x_o)] {
                let near = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-5);
                assert!(near, "positions round at 1e-16, values at 6e-8: {found:?} {expected:?}");
            }
        }
        // Lit points 0 and 1, half way, at the offset of their own.
        let x_i = [0.5 * (m.lit_mm[0][0] + m.lit_mm[1][0]), m.lit_mm[0][1]];
        let mean: [f32; 3] =
            std::array::from_fn(|c| (m.response(0, [0, 0]).unwrap()[c] + m.response(1, [0, 0]).unwrap()[c]) / 2.0);
        let found = evaluator.between(x_i, x_i);
        assert!(found.iter().zip(mean).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?} {mean:?}");
        if h.degree.is_none() && h.window == [5, 3] {
            let between = evaluator.between(m.lit_mm[4], [m.lit_mm[4][0] + 0.25, m.lit_mm[4][1]]);
            let ends = [m.response(4, [0, 0]).unwrap(), m.response(4, [1, 0]).unwrap()];
            for c in 0..3 {
                assert!((between[c] - (ends[0][c] + ends[1][c]) / 2.0).abs() < 1e-5, "the mean of two samples");
            }
        }
    }
}

#[test]
fn nothing_is_far_from_the_slab_or_nowhere() {
    let evaluator = Evaluator::new(&every_kind()[0]).unwrap();
    for p in [[-1.0, 0.0], [0.0, 99.0], [f64::NAN, 0.0], [f64::INFINITY, f64::NEG_INFINITY], [1e300, 0.0]] {
        for (x_i, x_o) in [(p, p), ([0.0; 2], p), (p, [0.0; 2])] {
            let near = x_o == [-1.0, 0.0];
            assert!(near || evaluator.nearest(x_i, x_o) == [0.0; 3], "{x_i:?} {x_o:?}");
            assert!(near || evaluator.between(x_i, x_o) == [0.0; 3], "{x_i:?} {x_o:?}");
        }
    }
}

#[test]
fn probabilities_sum_to_one_and_are_positive_wherever_the_response_may_be() {
    for m in every_kind() {
        let evaluator = Evaluator::new(&m).unwrap();
        for i in 0..6 {
            let all = offsets(m.header.window);
            let sum: f64 = all.iter().map(|&o| evaluator.probability(i, o)).sum();
            let drawn = evaluator.sample(i, 0.5).is_some();
            assert!(if drawn { (sum - 1.0).abs() < 1e-12 } else { sum == 0.0 }, "rounding of f64: {sum}");
            for o in all {
                let responds = m.response(i, o).is_some_and(|r| r != [0.0; 3]);
                assert!(!responds || evaluator.probability(i, o) > 0.01 / 16.0, "of 15 samples, and 1 % uniform");
            }
        }
        assert_eq!((evaluator.sample(6, 0.5), evaluator.probability(6, [0, 0])), (None, 0.0));
    }
}

/// The probability that χ² with `dof` degrees of freedom exceeds this is below 1e-6 (Wilson and Hilferty, 4.75 standard
/// deviations).
fn limit(dof: f64) -> f64 {
    let s = 2.0 / (9.0 * dof);
    dof * (1.0 - s + 4.75 * s.sqrt()).powi(3)
}

#[test]
fn draws_are_distributed_as_their_probabilities() {
    let mut random = rand_pcg::Pcg64::seed_from_u64(5);
    for m in every_kind() {
        let evaluator = Evaluator::new(&m).unwrap();
        for i in [0, 1, 2, 5] {
            let all = offsets(m.header.window);
            let mut counts = vec![0.0; all.len()];
            const DRAWS: usize = 20_000;
            for _ in 0..DRAWS {
                let Some(s) = evaluator.sample(i, random.random()) else { continue };
                let at = all.iter().position(|o| *o == s.offset).unwrap();
                counts[at] += 1.0;
                assert_eq!(s.probability, evaluator.probability(i, s.offset), "the same arithmetic");
            }
            if evaluator.sample(i, 0.0).is_none() {
                continue;
            }
            let expected = all.iter().map(|&o| evaluator.probability(i, o) * DRAWS as f64);
            let seen: Vec<(f64, f64)> = counts.into_iter().zip(expected).filter(|(_, e)| *e > 0.0).collect();
            let chi2: f64 = seen.iter().map(|(n, e)| (n - e).powi(2) / e).sum();
            let dof = seen.len() as f64 - 1.0;
            assert!(dof == 0.0 || chi2 < limit(dof), "χ² = {chi2} of {dof}, {:?} row {i}", m.header);
        }
    }
}

#[test]
fn a_response_without_negative_parts_is_drawn_in_proportion() {
    let mut m = every_kind().into_iter().find(|m| m.header.degree.is_none()).unwrap();
    let positive = [&mut m.weights, &mut m.incident_factors, m.offset_factors.own(), &mut m.profile];
    positive.into_iter().flatten().for_each(|v| *v = v.abs());
    m.header.extended = [7, 3];
    m.shift[0] = [0, 0];
    let evaluator = Evaluator::new(&m).unwrap();
    let mean = |o| m.response(0, o).map_or(0.0, |r| f64::from(r[0] + r[1] + r[2]));
    let all = offsets(m.header.window);
    // Light beyond this row's window, in the common one, makes some of it rarer: within a square of two samples the
    // ratio is exact.
    let ratio = |o| evaluator.probability(0, o) - 0.01 / 15.0;
    let (a, b) = ([0, -1], [0, 0]);
    assert!(all.contains(&a) && mean(a) > 0.0);
    let (found, expected) = (ratio(a) / ratio(b), mean(a) / mean(b));
    assert!((found / expected - 1.0).abs() < 1e-5, "sums are f32: {found} {expected}");
}

#[test]
fn rows_of_zeros_and_numbers_at_the_ends_of_the_range_are_drawn_too() {
    let mut random = rand_pcg::Pcg64::seed_from_u64(6);
    for m in every_kind() {
        for ends in [[0.0; 4], [1e-30, 1e30, -1e-30, -1e30], [1e-30; 4], [1e30; 4], [1e-45; 4]] {
            let mut m = m.clone();
            let each = [&mut m.weights, &mut m.incident_factors, m.offset_factors.own(), &mut m.profile];
            each.into_iter().flatten().enumerate().for_each(|(k, v)| *v = ends[k * 7 % 4]);
            let evaluator = Evaluator::new(&m).unwrap();
            let sum: f64 = offsets(m.header.window).iter().map(|&o| evaluator.probability(0, o)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{sum}");
            for random in [0.0, 1.0, f64::NAN, -1.0, random.random()] {
                let s = evaluator.sample(0, random).unwrap();
                assert!(s.probability > 0.0 && s.probability <= 1.0 + 1e-12);
            }
            let value = evaluator.between(m.lit_mm[0], m.lit_mm[1]);
            assert!(value.iter().all(|v| !v.is_nan()));
        }
    }
}

#[test]
fn a_material_that_is_not_whole_is_refused() {
    let mut m = every_kind().remove(0);
    m.offset_factors.own().pop();
    assert!(matches!(Evaluator::new(&m), Err(Error::Inconsistent { .. })));
}

/// Points all over the slab and beyond it, in lattice coordinates, none half way between two lattice points or samples.
fn places() -> Vec<[f64; 2]> {
    let along = |n: f64| (0..).map(|k| -0.72 + 0.28 * f64::from(k)).take_while(move |v| *v < n).collect::<Vec<_>>();
    along(4.8).into_iter().flat_map(|u| along(2.8).into_iter().map(move |v| [u, v])).collect()
}

fn mm(u: [f64; 2]) -> [f64; 2] {
    [0, 1].map(|r| naive::ORIGIN_MM[r] + u[0] * naive::STEPS_MM[0][r] + u[1] * naive::STEPS_MM[1][r])
}

/// Offsets in samples, within the window and beyond.
const STEPS: [[f64; 2]; 9] =
    [[0.0, 0.0], [1.2, -0.7], [-2.6, 1.3], [3.4, 0.2], [-3.3, -2.4], [0.3, 2.45], [3.7, 0.0], [0.0, -2.6], [-0.4, 0.4]];

#[test]
fn points_on_a_turned_lattice_are_the_naive_formula() {
    for m in naive::materials() {
        let evaluator = Evaluator::new(&m).unwrap();
        for i in 0..naive::ROWS {
            for d in naive::offsets() {
                let expected = naive::response(&m, i, d).unwrap();
                for (a, b) in evaluator.response(i, d).unwrap().into_iter().zip(expected) {
                    assert!((f64::from(a) - b).abs() < 1e-6, "f32: {} row {i} {d:?}: {a} {b}", m.header.model);
                }
            }
        }
    }
}

#[test]
fn the_nearest_is_that_of_the_nearest_lattice_point_at_the_nearest_offset() {
    for m in naive::materials() {
        let evaluator = Evaluator::new(&m).unwrap();
        for u in places() {
            for step in STEPS {
                let x_i = mm(u);
                let x_o = [0, 1].map(|a| x_i[a] + step[a] * naive::PITCH_MM);
                let point = (0..naive::ROWS)
                    .find(|i| (u[0] - (i % 5) as f64).abs() < 0.5 && (u[1] - (i / 5) as f64).abs() < 0.5);
                let expected =
                    point.and_then(|i| naive::response(&m, i, step.map(|s| s.round() as isize))).unwrap_or([0.0; 3]);
                for (a, b) in evaluator.nearest(x_i, x_o).into_iter().zip(expected) {
                    assert!((f64::from(a) - b).abs() < 1e-6, "f32: {u:?} {step:?}: {a} {b}");
                }
            }
        }
    }
}

#[test]
fn between_points_is_bilinear_in_the_lattice_and_in_the_offset() {
    for m in naive::materials() {
        let evaluator = Evaluator::new(&m).unwrap();
        for u in places() {
            for step in STEPS {
                let x_i = mm(u);
                let x_o = [0, 1].map(|a| x_i[a] + step[a] * naive::PITCH_MM);
                let inside = u[0] >= -0.5 && u[0] <= 4.5 && u[1] >= -0.5 && u[1] <= 2.5;
                let inside = inside && step[0].abs() <= 3.5 && step[1].abs() <= 2.5;
                let (u, d) = (
                    [u[0].clamp(0.0, 4.0), u[1].clamp(0.0, 2.0)],
                    [step[0].clamp(-3.0, 3.0), step[1].clamp(-2.0, 2.0)],
                );
                let mut expected = [0.0; 3];
                for i in (0..naive::ROWS).filter(|_| inside) {
                    let weight = naive::tent(u[0], (i % 5) as f64) * naive::tent(u[1], (i / 5) as f64);
                    let (mut planes, mut modelled) = ([0.0; 3], 0.0);
                    for at in naive::offsets() {
                        let share = naive::tent(d[0], at[0] as f64) * naive::tent(d[1], at[1] as f64);
                        let Some(e) = naive::sample(&m, i, at).filter(|_| share > 0.0) else { continue };
                        modelled += share;
                        let values = naive::planes(&m, i, e);
                        (0..3).for_each(|k| planes[k] += share * values[k]);
                    }
                    if modelled == 0.0 {
                        continue;
                    }
                    // The intensity of what is modelled has a colour; beyond it there is nothing, in proportion.
                    let row = naive::colored(&m, i, planes.map(|v| v / modelled)).map(|v| v * modelled);
                    (0..3).for_each(|c| {
                        expected[c] += weight * row[c] * naive::entry(&m, c, i) * naive::exit(&m, c, x_o)
                    });
                }
                for (a, b) in evaluator.between(x_i, x_o).into_iter().zip(expected) {
                    assert!((f64::from(a) - b).abs() < 1e-6, "f32: {} {u:?} {step:?}: {a} {b}", m.header.model);
                }
            }
        }
    }
}

#[test]
fn a_lattice_of_one_line_or_of_points_in_one_place_takes_the_pitch() {
    let line = Lattice::of([4, 1], &[[1.0, 5.0], [1.5, 5.25], [2.0, 5.5], [2.5, 5.75]], [9.0, 0.75]);
    // One step is (0.5, 0.25) mm; across it the pitch, along y.
    for (u, p) in [([0.0, 0.0], [1.0, 5.0]), ([3.0, 0.0], [2.5, 5.75]), ([1.0, 2.0], [1.5, 6.75])] {
        let found = line.map(p);
        assert!((0..2).all(|a| (found[a] - u[a]).abs() < 1e-12), "rounding: {found:?} {u:?}");
    }
    let heap = Lattice::of([3, 2], &[[2.0, 3.0]; 6], [0.5, 0.25]);
    let found = heap.map([2.5, 3.5]);
    // The middle of 3 × 2 points is (1, 0.5).
    assert!((found[0] - 2.0).abs() < 1e-12 && (found[1] - 2.5).abs() < 1e-12, "rounding: {found:?}");
}
