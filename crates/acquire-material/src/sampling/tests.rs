use super::super::Evaluator;
use super::*;
use crate::naive;

/// The probability of an offset, from sums of the formula over squares of the common window.
fn expected(m: &Material, i: usize, d: [isize; 2]) -> f64 {
    let modelled: Vec<[usize; 2]> = naive::offsets().filter_map(|d| naive::sample(m, i, d)).collect();
    let within = |[x, y]: [usize; 2], side: usize| {
        modelled.iter().filter(|e| e[0] / side == x && e[1] / side == y).count() as f64
    };
    let planes = m.header.planes();
    let sum = |[x, y]: [usize; 2], side: usize| -> f64 {
        let all = (0..63).map(|e| [e % 9, e / 9]).filter(|e| e[0] / side == x && e[1] / side == y);
        all.map(|e| (0..planes).map(|k| naive::plane(m, k, i, e)).sum::<f64>()).sum()
    };
    let Some(e) = naive::sample(m, i, d).filter(|_| d[0].abs() <= 3 && d[1].abs() <= 2) else { return 0.0 };
    let mut chosen = 1.0;
    for side in [8, 4, 2, 1] {
        let parent = e.map(|v| v / (2 * side));
        let children = [0, 1, 2, 3].map(|q| [2 * parent[0] + q % 2, 2 * parent[1] + q / 2]);
        let own = children.iter().position(|c| *c == e.map(|v| v / side)).unwrap();
        let counts = children.map(|c| within(c, side));
        let shares = [0, 1, 2, 3].map(|q| if counts[q] == 0.0 { 0.0 } else { sum(children[q], side).max(0.0) });
        let total: f64 = shares.iter().sum();
        chosen *= if total > 0.0 { shares[own] / total } else { counts[own] / counts.iter().sum::<f64>() };
    }
    0.01 / modelled.len() as f64 + 0.99 * chosen
}

#[test]
fn probabilities_are_products_of_the_shares_of_quarters() {
    for m in naive::materials() {
        let evaluator = Evaluator::new(&m).unwrap();
        for i in 0..naive::ROWS {
            for d in naive::offsets().chain([[4, 0], [-4, 1], [0, 3], [1, -3], [isize::MAX, isize::MIN]]) {
                let (found, e) = (evaluator.probability(i, d), expected(&m, i, d));
                // Sums are f32 in units of their largest; where they cancel, a share is off by as much of what cancels.
                assert!((found - e).abs() < 1e-5, "{} row {i} {d:?}: {found} {e}", m.header.model);
            }
        }
    }
}

#[test]
fn evenly_spaced_draws_meet_every_offset_as_often_as_its_probability_says() {
    const DRAWS: usize = 5000;
    for m in naive::materials() {
        let evaluator = Evaluator::new(&m).unwrap();
        for i in [0, 3, 4, 8, 13] {
            let mut counts = std::collections::BTreeMap::new();
            for k in 0..DRAWS {
                let s = evaluator.sample(i, (k as f64 + 0.5) / DRAWS as f64).unwrap();
                assert_eq!(s.probability, evaluator.probability(i, s.offset));
                *counts.entry(s.offset).or_insert(0) += 1;
            }
            let mut all = 0;
            for d in naive::offsets() {
                let (n, e) = (counts.get(&d).copied().unwrap_or(0), expected(&m, i, d) * DRAWS as f64);
                // An offset owns one interval of the uniform draws and one of the others: each end is rounded by one
                // draw.
                assert!((f64::from(n) - e).abs() < 2.5, "{} row {i} {d:?}: {n} {e}", m.header.model);
                all += n;
            }
            assert_eq!(all as usize, DRAWS, "none outside the window");
        }
    }
}

#[test]
fn a_part_of_a_window_is_what_lies_on_the_common_one() {
    let layout = Layout { window: naive::WINDOW, extended: naive::EXTENDED };
    let part = Part::of(layout, [2, -1]);
    // Column 0 of the window falls to −1, line 0 to 2; the last line, to 6, is the last there is.
    assert_eq!((part.low, part.high, part.size()), ([0, 2], [6, 7], [6, 5]));
    // In squares of 4: columns 0 to 3 and 4 to 5, lines 2 to 3 and 4 to 6.
    let counts = [[0, 0], [1, 0], [0, 1], [1, 1], [2, 0], [0, 2]].map(|at| part.overlap(at, 4));
    assert_eq!(counts, [8, 4, 12, 6, 0, 0]);
    let part = Part::of(layout, [9, 0]);
    assert_eq!((part.size(), part.overlap([0, 0], 16)), ([0, 5], 0), "moved off it");
}
