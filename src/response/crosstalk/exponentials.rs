//! The kernel that the fit starts from: what falls off as a sum of exponentials does.
//!
//! Where dots of one shot are about as far apart as their light reaches, no sample tells how much of it is which dot's,
//! and multiplicative steps stay near where they began. In an even, absorbing medium light falls off as a mixture of
//! exponentials of positive weights (the point-source solution e^(−μr)/r is one, and so are sums of such over depths
//! and reflections, but for the closest samples). The weights are those of non-negative least squares over all samples
//! with all dots that light each: one minimum, wherever the search begins.
//!
//! In an uneven medium, one kernel does not fit the light of every row's own dot. Long exponentials reduce that misfit, and
//! then predict light of other dots where there is none. So long exponentials are removed while the others fit the rows no
//! worse than all together, by a paired test over rows (`WORSE_SIGMA`).

use super::fit::{ASSUMED_SD, Fit, Pair, Sample};
use super::kernel::interpolate;

/// Shortest and longest decay lengths, in outgoing samples and in reaches (two windows), and how many.
const SHORTEST_SAMPLES: f64 = 1.5;
const LONGEST_REACHES: f64 = 0.5;
const LENGTHS: usize = 12;
/// Nodes near the dot have a weight each, samples: there light falls off as the dot's side and the medium's first
/// scattering want.
const FREE_SAMPLES: f64 = 3.0;

/// What is known to no better than this share of the brightest sample.
const LEAST_LIGHT: f64 = 1e-6;

/// Weights of the kernel's nodes from the measured light; `None` without light.
pub(super) fn mixture(fit: &Fit<'_>, samples_per_node: f64) -> Option<Vec<f64>> {
    let basis = basis(fit.layout.nodes, samples_per_node);
    let m = basis.len();
    let (mut normal, mut right) = (vec![0.0; m * m], vec![0.0; m]);
    let mut row = vec![0.0; m];
    // A sample without light or noise (a rendered one) would count for all others.
    let brightest = fit.seen.iter().flatten().map(|(light, _)| light.abs()).fold(0.0, f64::max);
    let floor = (LEAST_LIGHT * brightest).powi(2);
    for (sample, seen) in fit.layout.samples.iter().zip(&fit.seen) {
        let Some((light, variance)) = seen else { continue };
        row.fill(0.0);
        for pair in &fit.layout.pairs[sample.pairs.clone()] {
            let flux = flux(fit, sample, pair);
            row.iter_mut().zip(&basis).for_each(|(r, b)| *r += flux * interpolate(b, pair.place));
        }
        let weight = weight(*light, *variance, floor);
        for i in 0..m {
            right[i] += weight * row[i] * light;
            for j in 0..=i {
                normal[i * m + j] += weight * row[i] * row[j];
            }
        }
    }
    for i in 0..m {
        (0..i).for_each(|j| normal[j * m + i] = normal[i * m + j]);
    }
    if !(brightest > 0.0) {
        return None;
    }
    let kernel_to = |longest: usize| -> Vec<f64> {
        let kept: Vec<usize> = (0..m).filter(|&k| k >= LENGTHS || k <= longest).collect();
        let part: Vec<f64> =
            kept.iter().flat_map(|&i| kept.iter().map(move |&j| (i, j))).map(|(i, j)| normal[i * m + j]).collect();
        let weights = non_negative(&part, &kept.iter().map(|&i| right[i]).collect::<Vec<_>>());
        (0..fit.layout.nodes).map(|n| kept.iter().zip(&weights).map(|(&k, w)| w * basis[k][n]).sum()).collect()
    };
    let mut kernel = kernel_to(LENGTHS - 1);
    let best = misfit_of_rows(fit, &kernel, floor);
    for longest in 0..LENGTHS - 1 {
        let shorter = kernel_to(longest);
        if !is_worse(&misfit_of_rows(fit, &shorter, floor), &best) {
            kernel = shorter;
            break;
        }
    }
    // Positive everywhere: multiplicative steps never leave zero.
    let first = kernel.iter().copied().fold(0.0, f64::max);
    (first > 0.0 && first.is_finite()).then(|| kernel.into_iter().map(|k| k.max(1e-12 * first)).collect())
}

/// What a kernel of one brings to a sample from a dot.
fn flux(fit: &Fit<'_>, sample: &Sample, pair: &Pair) -> f64 {
    fit.layout.flux[pair.dot][fit.channel] * fit.incident[pair.dot] * fit.outgoing[sample.cell]
}

fn weight(light: f64, variance: f64, floor: f64) -> f64 {
    1.0 / ((ASSUMED_SD * light).powi(2) + variance + floor)
}

/// Weighted sums over the samples of each row of the squares of what a kernel misses.
fn misfit_of_rows(fit: &Fit<'_>, kernel: &[f64], floor: f64) -> Vec<f64> {
    let missed = |(sample, seen): (&Sample, &Option<(f64, f64)>)| {
        let Some((light, variance)) = *seen else { return 0.0 };
        let pairs = fit.layout.pairs[sample.pairs.clone()].iter();
        let modelled: f64 = pairs.map(|pair| flux(fit, sample, pair) * interpolate(kernel, pair.place)).sum();
        weight(light, variance, floor) * (light - modelled).powi(2)
    };
    let both: Vec<_> = fit.layout.samples.iter().zip(&fit.seen).collect();
    let rows = both.chunk_by(|a, b| (a.0.shot, a.0.dot) == (b.0.shot, b.0.dot));
    rows.map(|row| row.iter().map(|&sample| missed(sample)).sum()).collect()
}

/// Whether rows are fitted worse than before by so many standard deviations of the mean over them.
const WORSE_SIGMA: f64 = 3.0;

fn is_worse(rows: &[f64], before: &[f64]) -> bool {
    let n = rows.len() as f64;
    let mean = rows.iter().zip(before).map(|(a, b)| a - b).sum::<f64>() / n;
    let square = rows.iter().zip(before).map(|(a, b)| (a - b - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    mean > WORSE_SIGMA * (square / n).sqrt()
}

/// The exponentials and the free nodes, each at all nodes.
fn basis(nodes: usize, samples_per_node: f64) -> Vec<Vec<f64>> {
    let reach = samples_per_node * (nodes - 1) as f64;
    let longest = (LONGEST_REACHES * reach).max(SHORTEST_SAMPLES);
    let ratio = (longest / SHORTEST_SAMPLES).powf(1.0 / (LENGTHS - 1) as f64);
    let exponential = |k: usize| {
        let length = SHORTEST_SAMPLES * ratio.powi(k as i32);
        (0..nodes).map(|n| (-samples_per_node * n as f64 / length).exp()).collect()
    };
    let free = |node: usize| (0..nodes).map(|n| f64::from(u8::from(n == node))).collect();
    let near = ((FREE_SAMPLES / samples_per_node) as usize).min(nodes);
    (0..LENGTHS).map(exponential).chain((0..near).map(free)).collect()
}

/// Rounds over all weights; in the end the sum of squares changes by less than this share of it.
const ROUNDS: usize = 20_000;
const SETTLED: f64 = 1e-13;

/// The x ≥ 0 of the least xᵀAx − 2bᵀx, one coordinate after the other: A is small and positive semidefinite.
fn non_negative(a: &[f64], b: &[f64]) -> Vec<f64> {
    let m = b.len();
    let mut x = vec![0.0; m];
    let mut gradient: Vec<f64> = b.iter().map(|b| -b).collect();
    let mut gained = 0.0;
    for _ in 0..ROUNDS {
        let mut gain = 0.0;
        for i in 0..m {
            let bend = a[i * m + i];
            if !(bend > 0.0) {
                continue;
            }
            let step = (-gradient[i] / bend).max(-x[i]);
            if step != 0.0 {
                x[i] += step;
                gain -= step * (2.0 * gradient[i] + step * bend);
                (0..m).for_each(|j| gradient[j] += step * a[i * m + j]);
            }
        }
        gained += gain;
        if gain <= SETTLED * gained {
            break;
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::super::{LitRow, distance, fit_tails, sample_mm};
    use super::*;
    use crate::capture::Window;
    use crate::geometry::Point;
    use crate::transport::Row;

    #[test]
    fn non_negative_least_squares_has_no_gradient_where_it_is_positive_and_an_upward_one_where_it_is_zero() {
        // Of an odd matrix M of 7 rows, A = MᵀM.
        let m = |r: usize, c: usize| ((r * 31 + c * 17 + r * c * 7) % 23) as f64 / 23.0 - 0.3;
        let a: Vec<f64> = (0..16).map(|k| (0..7).map(|r| m(r, k / 4) * m(r, k % 4)).sum()).collect();
        for signs in [[1.0, 1.0, 1.0, 1.0], [1.0, -1.0, 0.5, -0.2], [-1.0; 4]] {
            let b: Vec<f64> = (0..4).map(|i| (0..4).map(|j| a[4 * i + j] * signs[j]).sum()).collect();
            let x = non_negative(&a, &b);
            for i in 0..4 {
                let gradient = (0..4).map(|j| a[4 * i + j] * x[j]).sum::<f64>() - b[i];
                assert!(x[i] >= 0.0 && gradient > -1e-6 && (x[i] == 0.0 || gradient < 1e-6), "{x:?} {i} {gradient}");
            }
        }
    }

    const WINDOW: Window = Window { samples: [21, 17], pitch_mm: 0.5 };

    /// Point sources below the surface and their mirrors above it, as diffusion has them (Farrell, Patterson & Wilson
    /// 1992): not a sum of exponentials in r near the dot. Lengths in mm.
    fn dipole(r: f64, depth: f64, mirror: f64, decay: f64) -> f64 {
        let part = |z: f64| {
            let d = r.hypot(z);
            z * (1.0 / decay + 1.0 / d) * (-d / decay).exp() / (d * d)
        };
        part(depth) + part(mirror)
    }

    /// A shot of dots `spacing` samples apart on an even slab, and what each row would be alone.
    fn shot(spacing: usize, kernel: &dyn Fn(f64) -> f64) -> (Vec<LitRow>, Vec<Vec<f64>>) {
        let line = |n: usize| (0..n).map(|k| 6.0 + 0.5 * (k * spacing) as f64);
        let dots: Vec<Point> = line(5).flat_map(|y| line(4).map(move |x| [x, y])).collect();
        let n = WINDOW.samples[0] * WINDOW.samples[1];
        let at = |p: Point, k: usize| sample_mm(&WINDOW, p, k % WINDOW.samples[0], k / WINDOW.samples[0]);
        let alone = |p: Point| (0..n).map(|k| kernel(distance(p, at(p, k)))).collect();
        let rows = dots.iter().map(|&p| {
            let seen = |k: usize| dots.iter().map(|&q| kernel(distance(q, at(p, k)))).sum::<f64>() as f32;
            let response: Vec<f32> = (0..n).flat_map(|k| [seen(k); 3]).collect();
            // Noise of a thousandth of the light.
            let variance = response.iter().map(|v| (1e-3 * v).powi(2)).collect();
            LitRow { center_mm: p, flux: [1.0; 3], row: Row { response, variance, valid: vec![true; 3 * n] } }
        });
        (rows.collect(), dots.iter().map(|&p| alone(p)).collect())
    }

    #[test]
    fn the_tails_of_broad_media_are_told_from_their_neighbours_a_window_away() {
        // Depth, mirror and decay of media whose light reaches a fifth to a whole window (10.5 × 8.5 mm); dots a window
        // apart and less.
        for (depth, mirror, decay) in [(0.4, 1.1, 1.5), (0.8, 2.0, 3.0), (0.3, 0.9, 4.5), (1.5, 4.0, 6.0)] {
            for spacing in [21, 17, 13] {
                let (mut rows, truth) = shot(spacing, &|r| dipole(r, depth, mirror, decay));
                let sum = |row: &LitRow| row.row.response.iter().step_by(3).map(|v| f64::from(*v)).sum::<f64>();
                // A dot in the middle, of which most is other dots' where the medium is the broadest.
                let before = sum(&rows[9]) / truth[9].iter().sum::<f64>() - 1.0;
                let size_mm = [30.0, 40.0].map(|v: f64| v.max(12.0 + 2.0 * spacing as f64));
                fit_tails(&[rows.clone()], &WINDOW, size_mm).unwrap().separate(&mut rows, &WINDOW);
                let after = sum(&rows[9]) / truth[9].iter().sum::<f64>() - 1.0;
                let corner = f64::from(rows[9].row.response[0]) / truth[9][0] - 1.0;
                println!("{decay} {spacing}: light {before:+.4} {after:+.4}, corner {corner:+.4}");
                // What falls off within the window's own rim is told apart to a hundredth of the light; of what does
                // not, a tenth of what was there may stay.
                assert!(after.abs() < (0.1 * before).max(0.01), "{decay} {spacing}: {before} {after}");
            }
        }
    }
}
