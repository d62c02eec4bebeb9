use super::*;
use crate::transport::Row;

/// Wider than high, unlike the slab.
const WIDE: Window = Window { samples: [7, 3], pitch_mm: 0.5 };
const SIZE_MM: Point = [12.0, 6.0];
/// Two windows of the longer side.
const REACH_MM: f64 = 7.0;
const STEP_MM: f64 = 0.25;
/// 7 mm in quarters of a millimetre, and two more.
const NODES: usize = 30;
const DOTS: [&[Point]; 2] = [&[[1.1, 1.2], [2.7, 1.9], [10.6, 4.4]], &[[6.2, 2.9], [8.4, 2.2]]];

/// Even numbers from 0 to 1 that follow no line.
fn odd(k: usize) -> f64 {
    ((k * 7919 + 13) % 101) as f64 / 101.0
}

/// Two shots whose light falls with distance and is uneven by a fifth; no two dots, channels or samples are alike.
fn shots() -> Vec<Vec<LitRow>> {
    let row = |s: usize, d: usize| {
        let center_mm = DOTS[s][d];
        let flux = [1.0 + 0.3 * d as f64, 2.0 - 0.4 * d as f64, 0.5 + 0.2 * (s + d) as f64];
        let response = |k: usize| {
            let at = [center_mm[0] + 0.5 * ((k / 3 % 7) as f64 - 3.0), center_mm[1] + 0.5 * ((k / 21) as f64 - 1.0)];
            let light: f64 = DOTS[s].iter().map(|p| (-(at[0] - p[0]).hypot(at[1] - p[1]) / 0.9).exp()).sum();
            (light * (0.8 + 0.4 * odd(k + 71 * d + 37 * s)) * (1.0 + (k % 3) as f64)) as f32
        };
        let variance = (0..63).map(|k| (1e-3 * (1.0 + odd(3 * k + d))) as f32).collect();
        let valid = (0..63).map(|k| !(k + 5 * d + s).is_multiple_of(11)).collect();
        LitRow { center_mm, flux, row: Row { response: (0..63).map(response).collect(), variance, valid } }
    };
    (0..2).map(|s| (0..DOTS[s].len()).map(|d| row(s, d)).collect()).collect()
}

/// What lights a sample: the dot's number among all, the node before its distance, and how far it is beyond that.
struct Lit {
    dot: usize,
    node: usize,
    t: f64,
}

/// Every sample of every row: its shot, dot, index, cell on the slab, and what lights it; of that, which is its own.
fn samples(shots: &[Vec<LitRow>]) -> Vec<(usize, usize, usize, usize, Vec<Lit>, usize)> {
    let mut all = Vec::new();
    let mut first = 0;
    for (s, shot) in shots.iter().enumerate() {
        for (d, row) in shot.iter().enumerate() {
            for k in 0..21 {
                let at =
                    [row.center_mm[0] + 0.5 * ((k % 7) as f64 - 3.0), row.center_mm[1] + 0.5 * ((k / 7) as f64 - 1.0)];
                let [column, line] = at.map(|v| (v.max(0.0) / 0.5) as usize);
                // Beyond the slab the nearest cell.
                let cell = line.min(11) * 24 + column.min(23);
                let (mut lit, mut own) = (Vec::new(), 0);
                for (j, other) in shot.iter().enumerate() {
                    let r = (at[0] - other.center_mm[0]).hypot(at[1] - other.center_mm[1]);
                    if j == d {
                        own = lit.len();
                    }
                    if r <= REACH_MM {
                        let node = (r / STEP_MM) as usize;
                        lit.push(Lit { dot: first + j, node, t: r / STEP_MM - node as f64 });
                    }
                }
                all.push((s, d, k, cell, lit, own));
            }
        }
        first += shot.len();
    }
    all
}

#[test]
fn a_sample_is_lit_by_the_dots_of_its_own_shot_within_two_windows() {
    let shots = shots();
    let layout = lay_out(&shots, &WIDE, SIZE_MM);
    assert_eq!((layout.step_mm, layout.nodes), (STEP_MM, NODES));
    let flux: Vec<[f64; 3]> = shots.iter().flatten().map(|r| r.flux).collect();
    assert_eq!(layout.flux, flux);
    let expected = samples(&shots);
    assert_eq!(layout.samples.len(), expected.len());
    for (found, (s, d, k, cell, lit, own)) in layout.samples.iter().zip(&expected) {
        assert_eq!((found.shot, found.dot, found.index, found.cell), (*s, *d, *k, *cell));
        assert_eq!(found.own - found.pairs.start, *own, "{s} {d} {k}");
        let pairs = &layout.pairs[found.pairs.clone()];
        assert_eq!(pairs.len(), lit.len());
        for (pair, lit) in pairs.iter().zip(lit) {
            assert_eq!(pair.dot, lit.dot);
            let (found, exact) = (pair.place.node as f64 + f64::from(pair.place.share), lit.node as f64 + lit.t);
            // The share is f32.
            assert!((found - exact).abs() < 1e-6, "{s} {d} {k}: {found} {exact}");
        }
    }
    assert!(expected.iter().any(|e| e.4.len() == 1) && expected.iter().any(|e| e.4.len() == 2), "both occur");
}

#[test]
fn of_too_many_pairs_an_even_share_is_kept_and_all_near_the_dots() {
    let window = Window { samples: [23, 19], pitch_mm: 0.5 };
    // 40 dots in a corner, 80 in another, 42 mm and more away from them: further than light is followed, 23 mm.
    let dot = |d: usize| LitRow {
        center_mm: if d < 40 { [5.0 + 0.05 * d as f64, 8.0] } else { [45.0 + 0.05 * d as f64, 30.0] },
        flux: [1.0; 3],
        row: Row { response: vec![], variance: vec![], valid: vec![] },
    };
    let shot: Vec<LitRow> = (0..120).map(dot).collect();
    assert_eq!(neighbours_within(&shot, 23.0), 80);
    // 120 dots with 80 neighbours and 437 samples each are 4.2 million: every third sample.
    let layout = lay_out(&[shot], &window, [60.0, 40.0]);
    let (mut by_dot, mut by_index) = ([0_usize; 120], [0_usize; 437]);
    let core = |k: usize| (k % 23).abs_diff(11).pow(2) + (k / 23).abs_diff(9).pow(2) < 9;
    for sample in &layout.samples {
        by_dot[sample.dot] += usize::from(!core(sample.index));
        by_index[sample.index] += 1;
    }
    let cores = (0..437).filter(|&k| core(k)).count();
    assert_eq!(cores, 25);
    // 412 samples of each row beyond the core: a third of them, to a few for where the stride begins.
    assert!(by_dot.iter().all(|n| n.abs_diff(412 / 3) < 20), "{by_dot:?}");
    assert!((0..437).all(|k| if core(k) { by_index[k] == 120 } else { by_index[k].abs_diff(40) < 5 }), "{by_index:?}");
}

/// A state in which no two numbers are alike, before any step.
fn state<'a>(shots: &[Vec<LitRow>], layout: &'a Layout, channel: usize) -> Fit<'a> {
    let mut fit = Fit::new(shots, layout, vec![1.0; 24 * 12], channel);
    fit.kernel = (0..NODES).map(|n| (-0.25 * n as f64).exp() * (0.5 + 2.0 * odd(n))).collect();
    fit.incident.iter_mut().enumerate().for_each(|(d, a)| *a = 0.7 + 0.2 * d as f64);
    fit.outgoing.iter_mut().enumerate().for_each(|(k, b)| *b = 0.7 + 0.6 * odd(5 * k));
    fit
}

/// A sample's cell, what lights it and by which share, which of that is its own, the weight, and measured over modelled
/// light.
type Modelled = (usize, Vec<(Lit, f64)>, usize, f64, f64);

/// Every measured sample with what each dot brings to it by the model, the weight, and measured over modelled.
fn modelled(shots: &[Vec<LitRow>], fit: &Fit<'_>) -> Vec<Modelled> {
    let c = fit.channel;
    let flux: Vec<f64> = shots.iter().flatten().map(|r| r.flux[c]).collect();
    let mut all = Vec::new();
    for (s, d, k, cell, lit, own) in samples(shots) {
        let LitRow { row, flux: own_flux, .. } = &shots[s][d];
        if !row.valid[3 * k + c] {
            continue;
        }
        let light = f64::from(row.response[3 * k + c]) * own_flux[c];
        let variance = f64::from(row.variance[3 * k + c]) * own_flux[c] * own_flux[c];
        let parts: Vec<f64> = lit
            .iter()
            .map(|l| {
                let kernel = (1.0 - l.t) * fit.kernel[l.node] + l.t * fit.kernel[l.node + 1];
                flux[l.dot] * fit.incident[l.dot] * fit.outgoing[cell] * kernel
            })
            .collect();
        let total: f64 = parts.iter().sum();
        // A model that is believed to a fifth.
        let weight = 1.0 / (0.04 + variance / (total * total));
        let lit = lit.into_iter().zip(parts.iter().map(|p| p / total)).collect();
        all.push((cell, lit, own, weight, light / total));
    }
    all
}

fn assert_near(found: &[f64], expected: &[f64]) {
    assert_eq!(found.len(), expected.len());
    for (k, (found, expected)) in found.iter().zip(expected).enumerate() {
        // Places between nodes are f32.
        assert!((found / expected - 1.0).abs() < 1e-5, "{k}: {found} {expected}");
    }
}

#[test]
fn each_factor_is_scaled_by_measured_over_modelled_light_weighted_by_its_share() {
    let shots = shots();
    let layout = lay_out(&shots, &WIDE, SIZE_MM);
    let mut limited = Vec::new();
    for channel in 0..3 {
        let mut fit = state(&shots, &layout, channel);
        // A step begins with so many samples of weight 1/0.04 that say "no change", and is no larger than 2.
        let step = |sums: &[(f64, f64)], before: &[f64], anchor: f64| -> Vec<f64> {
            let factor = |(top, bottom): &(f64, f64)| (top + 25.0 * anchor) / (bottom + 25.0 * anchor);
            sums.iter().zip(before).map(|(s, b)| b * factor(s).clamp(0.5, 2.0)).collect()
        };
        let mut sums = vec![(0.0, 0.0); NODES];
        let mut add = |n: usize, w: f64, ratio: f64| sums[n] = (sums[n].0 + w * ratio, sums[n].1 + w);
        for (_, lit, _, weight, ratio) in modelled(&shots, &fit) {
            for (l, share) in &lit {
                add(l.node, (1.0 - l.t) * share * weight, ratio);
                add(l.node + 1, l.t * share * weight, ratio);
            }
        }
        let expected = step(&sums, &fit.kernel, 0.5);
        fit.update_kernel();
        assert_near(&fit.kernel, &expected);
        limited.extend(sums.iter().filter(|s| s.1 > 0.0).map(|s| s.0 + 12.5 > 2.0 * (s.1 + 12.5)));

        let mut sums = vec![(0.0, 0.0); 5];
        for (_, lit, _, weight, ratio) in modelled(&shots, &fit) {
            for (l, share) in &lit {
                sums[l.dot] = (sums[l.dot].0 + share * weight * ratio, sums[l.dot].1 + share * weight);
            }
        }
        let expected = step(&sums, &fit.incident, 1.0);
        fit.update_incident();
        assert_near(&fit.incident, &expected);

        let mut sums = vec![(0.0, 0.0); 24 * 12];
        for (cell, _, _, weight, ratio) in modelled(&shots, &fit) {
            sums[cell] = (sums[cell].0 + weight * ratio, sums[cell].1 + weight);
        }
        let expected = step(&sums, &fit.outgoing, 2.0);
        fit.update_outgoing();
        assert_near(&fit.outgoing, &expected);
    }
    assert!(limited.contains(&true) && limited.contains(&false), "some steps are as large as they may be: {limited:?}");
}

#[test]
fn what_the_model_misses_is_stated_by_distance_where_a_dot_is_alone_and_more_beyond() {
    let shots = shots();
    let layout = lay_out(&shots, &WIDE, SIZE_MM);
    for channel in 0..3 {
        let mut fit = state(&shots, &layout, channel);
        // Near the truth, so that some of it is within the noise.
        fit.kernel = (0..NODES).map(|n| (1.0 + channel as f64) * (-0.25 * n as f64 / 0.9).exp()).collect();
        fit.incident.fill(1.0);
        fit.outgoing.fill(1.0);
        let (mut own_sum, mut own_weight, mut all) = ([0.0; NODES], [0.0; NODES], [0.0; NODES]);
        let mut shared = (0.0, 0.0);
        for (_, lit, own, weight, ratio) in modelled(&shots, &fit) {
            // Squared, less the variance of the noise: 1/w = 0.04 + variance.
            let missed = (ratio - 1.0).powi(2) - (1.0 / weight - 0.04);
            let (w, node) = (0.04 * weight, lit[own].0.node);
            all[node] += w;
            if lit[own].1 > 0.8 {
                own_sum[node] += w * missed;
                own_weight[node] += w;
            } else {
                let effective = 1.0 / lit.iter().map(|l| l.1 * l.1).sum::<f64>();
                shared = (shared.0 + w * missed * effective, shared.1 + w);
            }
        }
        let shared: f64 = shared.0 / shared.1;
        assert!(shared > 9e-4, "more than the least: {shared}");
        let (mut last, mut last_node) = (9e-4, 1.0);
        let mut kinds = [0; 2];
        let expected: Vec<f64> = (0..NODES)
            .map(|n| {
                let sd = if all[n] > 0.0 && own_weight[n] > 0.5 * all[n] {
                    last = f64::max((own_sum[n] + 2.0 * last) / (own_weight[n] + 2.0), 9e-4);
                    last_node = f64::max(n as f64, 1.0);
                    kinds[0] += 1;
                    last.sqrt()
                } else {
                    kinds[1] += 1;
                    last.max(shared).sqrt() * (n as f64 / last_node).max(1.0)
                };
                (1.7 * sd).min(1.0)
            })
            .collect();
        assert!(kinds[0] >= 3 && kinds[1] >= 3 && expected[3] < 1.0, "{kinds:?} {expected:?}");
        assert_near(&fit.relative_sd(), &expected);
    }
}
