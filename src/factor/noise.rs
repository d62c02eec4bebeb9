//! How large the singular values of noise alone would be, and so how many terms the measurement supports.

use super::backend::Triplets;
use rayon::prelude::*;

/// Half a unit in the last place of an f32, relative: what storing the rows as f32 leaves undetermined.
pub(super) const F32_ROUNDING: f64 = 1.0 / (1 << 24) as f64;

/// Beside the peak 60 to 80 % of entries are within two stated standard deviations of the truth (docs/accuracy.md): at
/// 60 %, errors there are 2.4 times those stated. They follow the slope of the row, as an error of the place does.
const BESIDE_PEAK: f64 = 2.4;

/// Sums of the noise over rows and over columns.
#[derive(Debug, Clone, Default)]
pub(super) struct NoiseSums {
    /// Σ_d v_id of every row.
    pub rows: Vec<f64>,
    /// Σ_i v_id of every column of the common window.
    pub columns: Vec<f64>,
    /// sd of every lit point's place, samples.
    pub position_sd_px: Vec<f64>,
    /// Shots: the points of one were moved together, so that what places do scatters as a mean over so many.
    pub shots: usize,
    /// Mean of v_id over measured samples.
    pub mean: f64,
}

impl NoiseSums {
    /// For rows that are divided by `unit`.
    pub(super) fn divide(&mut self, unit: f64) {
        let sums = self.rows.iter_mut().chain(&mut self.columns).chain([&mut self.mean]);
        sums.for_each(|v| *v /= unit * unit);
    }

    /// For columns that are multiplied by `metric`; rows as if each had its noise where the columns have it.
    pub(super) fn weighed(&self, metric: &[f32]) -> Self {
        if metric.is_empty() {
            return self.clone();
        }
        let squares = metric.iter().map(|&w| f64::from(w).powi(2));
        let columns: Vec<f64> = self.columns.iter().zip(squares).map(|(v, w)| v * w).collect();
        let (before, after) = (self.columns.iter().sum::<f64>(), columns.iter().sum::<f64>());
        let share = if before > 0.0 { after / before } else { 1.0 };
        Self {
            rows: self.rows.iter().map(|v| v * share).collect(),
            columns,
            position_sd_px: self.position_sd_px.clone(),
            shots: self.shots,
            mean: self.mean * share,
        }
    }

    /// A bound of the singular values that independent noise alone would give, √max_i Σ_d v_id + √max_d Σ_i v_id
    /// (`BandeiraVanHandel2016`), or what rounding rows to f32 hides when that is more.
    pub(super) fn bound(&self, singular_values: &[f64]) -> f64 {
        let largest = |sums: &[f64]| sums.iter().copied().fold(0.0, f64::max).sqrt();
        let rounding = F32_ROUNDING * singular_values.first().copied().unwrap_or(0.0);
        (largest(&self.rows) + largest(&self.columns)).max(rounding)
    }

    /// Singular values above the bound, at least one.
    pub(super) fn count_above(&self, singular_values: &[f64]) -> usize {
        let bound = self.bound(singular_values);
        singular_values.iter().take_while(|&&s| s > bound).count().max(1)
    }

    /// The noise of each of these terms.
    ///
    /// Independent entries of variance v_id give a pair of directions u, v the norm √(Σ u_i² Σ_d v_id) + √(Σ v_d² Σ_i
    /// v_id): of even noise √n + √m, the edge of Marchenko and Pastur; where noise is uneven, that of the part in which
    /// the pair lies. The uncertain place of lit point i adds δ_i · ∇R_i to its row, and to second order ½ δ_i² ∇²R_i:
    /// what of that lies along v has the expected square Σ_i sd_i² (∇R_i · v)² and so on, which k shots scatter by
    /// √(2/k) of itself: two of those are added. Errors of a dot's edge look like such of its place, and are larger
    /// than stated by [`BESIDE_PEAK`]. The two are independent: a term of norm θ in noise of norm s shows a singular
    /// value below √(θ² + s²) (`BenaychGeorges2012`), hence the quadrature. Rows are taken to be what the terms say;
    /// `metric` is what columns were multiplied by.
    pub(super) fn of_terms(&self, all: &Triplets, metric: &[f32], size: [usize; 2]) -> Vec<TermNoise> {
        let (terms, largest) = (all.weights.len(), all.weights.first().copied().unwrap_or(0.0));
        let columns = all.right.len() / terms.max(1);
        let place = self.position(all, metric, size);
        let scatter = BESIDE_PEAK * BESIDE_PEAK * (1.0 + 2.0 * (2.0 / self.shots.max(1) as f64).sqrt());
        (0..terms)
            .map(|j| {
                let left = self.rows.iter().enumerate().map(|(i, v)| v * all.left[i * terms + j].powi(2)).sum::<f64>();
                let right = &all.right[j * columns..][..columns];
                let right = self.columns.iter().zip(right).map(|(v, h)| v * h * h).sum::<f64>();
                TermNoise { left, right, place: scatter * place[j], rounding: F32_ROUNDING * largest }
            })
            .collect()
    }

    /// Expected squares of what uncertain places put into each term.
    fn position(&self, all: &Triplets, metric: &[f32], size: [usize; 2]) -> Vec<f64> {
        let (terms, samples) = (all.weights.len(), size[0] * size[1]);
        let columns = all.right.len() / terms.max(1);
        let mut out = vec![0.0; terms];
        if !self.position_sd_px.iter().any(|sd| *sd > 0.0) || samples == 0 {
            return out;
        }
        let weight = |d: usize| metric.get(d).map_or(1.0, |&w| f64::from(w));
        // Derivatives of every term's map, seen along every other: of x, y, xx, yy, xy.
        let seen: Vec<[Vec<f64>; 5]> = (0..terms)
            .into_par_iter()
            .map(|k| {
                let mut along = [0; 5].map(|_| vec![0.0; terms]);
                for p in (0..columns).step_by(samples) {
                    let map: Vec<f64> = (p..p + samples).map(|d| all.right[k * columns + d] / weight(d)).collect();
                    let [x, y] = [0, 1].map(|axis| derivative(&map, size, axis));
                    let [xx, xy, yy] = [derivative(&x, size, 0), derivative(&x, size, 1), derivative(&y, size, 1)];
                    for (of, sums) in [x, y, xx, yy, xy].iter().zip(&mut along) {
                        for (j, sum) in sums.iter_mut().enumerate() {
                            let other = &all.right[j * columns + p..][..samples];
                            *sum += (0..samples).map(|e| weight(p + e) * of[e] * other[e]).sum::<f64>();
                        }
                    }
                }
                along
            })
            .collect();
        // Σ_i sd_i² (Σ_k a_ik D_kj)² = Σ_kl D_kj D_lj Σ_i sd_i² a_ik a_il: the rows are gone through once for each
        // power of sd.
        let amounts = |i: usize, k: usize| all.weights[k] * all.left[i * terms + k];
        let [first, second] = [2, 4].map(|power| {
            let mut gram = vec![0.0; terms * terms];
            for (i, sd) in self.position_sd_px.iter().enumerate().filter(|(_, sd)| **sd > 0.0) {
                for k in 0..terms {
                    let amount = sd.powi(power) * amounts(i, k);
                    (0..terms).for_each(|l| gram[k * terms + l] += amount * amounts(i, l));
                }
            }
            gram
        });
        for (j, out) in out.iter_mut().enumerate() {
            let square = |gram: &[f64], kind: usize| -> f64 {
                let row = |k: usize| (0..terms).map(|l| gram[k * terms + l] * seen[l][kind][j]).sum::<f64>();
                (0..terms).map(|k| seen[k][kind][j] * row(k)).sum()
            };
            let [x, y, xx, yy, xy] = [(&first, 0), (&first, 1), (&second, 2), (&second, 3), (&second, 4)]
                .map(|(gram, kind)| square(gram, kind));
            // Sums of squares but for rounding.
            *out = (x + y + (xx + yy) / 2.0 + xy).max(0.0);
        }
        out
    }
}

/// Derivative of a map along an axis, by differences of the sixth order, of lower ones near the rim: central
/// differences of a peak that is two samples wide are a third too small.
fn derivative(map: &[f64], size: [usize; 2], axis: usize) -> Vec<f64> {
    const ORDERS: [&[f64]; 4] =
        [&[], &[1.0 / 2.0], &[8.0 / 12.0, -1.0 / 12.0], &[45.0 / 60.0, -9.0 / 60.0, 1.0 / 60.0]];
    let step = if axis == 0 { 1 } else { size[0] };
    (0..map.len())
        .map(|e| {
            let at = if axis == 0 { e % size[0] } else { e / size[0] };
            let room = at.min(size[axis] - 1 - at).min(3);
            let weights = ORDERS[room].iter().enumerate();
            weights.map(|(k, w)| w * (map[e + (k + 1) * step] - map[e - (k + 1) * step])).sum()
        })
        .collect()
}

/// What noise does to one term.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct TermNoise {
    /// Σ u_i² Σ_d v_id.
    pub left: f64,
    /// Σ v_d² Σ_i v_id.
    pub right: f64,
    /// Expected square of what uncertain places do.
    pub place: f64,
    /// The singular value that rounding hides.
    pub rounding: f64,
}

impl TermNoise {
    /// The singular value that noise alone would give.
    pub(super) fn level(&self) -> f64 {
        let independent = self.left.sqrt() + self.right.sqrt();
        (independent * independent + self.place).sqrt().max(self.rounding)
    }

    /// The share of a singular value that is nearest to the truth in the mean (`GavishDonoho2017`, for the Frobenius
    /// norm, with the noise of the term's own directions); of what uncertain places add, the share of its square.
    pub(super) fn kept(&self, singular_value: f64) -> f64 {
        let square = singular_value * singular_value;
        if !(square > 0.0) {
            return 1.0;
        }
        let (n, m) = (self.left / square, self.right / square);
        let independent = ((1.0 - n - m).powi(2) - 4.0 * n * m).max(0.0).sqrt();
        if n + m >= 1.0 { 0.0 } else { independent * (1.0 - self.place / square).max(0.0) }
    }
}

/// Terms above their level, at least the first; at most `most`.
pub(super) fn significant(singular_values: &[f64], noise: &[TermNoise], most: usize) -> Vec<usize> {
    let above = singular_values.iter().zip(noise).enumerate().filter(|(j, (s, n))| *j == 0 || **s > n.level());
    above.map(|(j, _)| j).take(most.max(1)).collect()
}

#[cfg(test)]
mod tests {
    use super::super::backend::{Backend, low_rank, tests::InMemory, triplets};
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_distr::{Distribution, StandardNormal};

    /// A product of unit vectors of random signs with these weights, and noise of variance r_i c_d; as triplets.
    fn with_noise(
        weights: &[f64],
        n: usize,
        m: usize,
        row: &dyn Fn(usize) -> f64,
        column: &dyn Fn(usize) -> f64,
    ) -> Triplets {
        let mut random = rand_pcg::Pcg64::seed_from_u64(1);
        let mut next = || -> f64 { StandardNormal.sample(&mut random) };
        let [left, right] =
            [n, m].map(|len| weights.iter().map(|_| (0..len).map(|_| next().signum()).collect()).collect());
        let (left, right): (Vec<Vec<f64>>, Vec<Vec<f64>>) = (left, right);
        let mut values = Vec::new();
        for i in 0..n {
            for d in 0..m {
                let signal: f64 = (0..weights.len()).map(|j| weights[j] * left[j][i] * right[j][d]).sum();
                values.push(signal / ((n * m) as f64).sqrt() + next() * (row(i) * column(d)).sqrt());
            }
        }
        let rows = InMemory::new(&values, m, 50);
        let low = low_rank(&rows, 12, Backend::Full, 0.0, None).unwrap();
        triplets(&rows, &low, 12, true).unwrap()
    }

    #[test]
    fn terms_are_told_from_noise_wherever_it_is_uneven() {
        let (n, m) = (120, 80);
        // Even noise, and a factor of a thousand in variance from the first row or column to the last.
        for uneven in [1.0_f64, 1e-3] {
            let row = |i: usize| uneven.powf(i as f64 / n as f64);
            let column = |d: usize| uneven.powf(d as f64 / m as f64);
            let noise = NoiseSums {
                rows: (0..n).map(|i| (0..m).map(|d| row(i) * column(d)).sum()).collect(),
                columns: (0..m).map(|d| (0..n).map(|i| row(i) * column(d)).sum()).collect(),
                position_sd_px: Vec::new(),
                shots: n,
                mean: 0.0,
            };
            let alone = with_noise(&[], n, m, &row, &column);
            let levels = noise.of_terms(&alone, &[], [m, 1]);
            for (s, noise) in alone.weights.iter().zip(&levels) {
                let level = noise.level();
                // The edge is a limit: the largest value scatters by n^(−2/3), 4 %, around it.
                assert!(*s < 1.04 * level, "{s} {level}");
            }
            assert!(alone.weights[0] > 0.8 * levels[0].level(), "and not far below: {}", alone.weights[0]);
            let with = with_noise(&[60.0, 40.0, 28.0], n, m, &row, &column);
            let found = significant(&with.weights, &noise.of_terms(&with, &[], [m, 1]), 12);
            assert_eq!(found.len(), 3, "of {:?}", with.weights);
        }
    }

    #[test]
    fn what_an_uncertain_place_does_to_equal_rows_is_no_term() {
        let (size, n) = ([21, 17], 150);
        let bump = |x: f64, y: f64| (-(x * x / 9.0 + y * y / 14.0)).exp();
        let mut random = rand_pcg::Pcg64::seed_from_u64(3);
        let sd = 0.15;
        let mut values = Vec::new();
        for _ in 0..n {
            let [dx, dy]: [f64; 2] = std::array::from_fn(|_| sd * random.sample::<f64, _>(StandardNormal));
            values.extend((0..357).map(|k| bump((k % 21) as f64 - 10.0 + dx, (k / 21) as f64 - 8.0 + dy)));
        }
        let rows = InMemory::new(&values, 357, 50);
        let low = low_rank(&rows, 8, Backend::Full, 0.0, None).unwrap();
        let all = triplets(&rows, &low, 8, true).unwrap();
        let known =
            NoiseSums { rows: vec![0.0; n], columns: vec![0.0; 357], position_sd_px: vec![sd; n], shots: n, mean: 0.0 };
        let levels = known.of_terms(&all, &[], size);
        // Slopes along x and y: 150 draws scatter by 6 %; two standard deviations of their squares, 23 %, and the dots'
        // edges are in the level.
        for j in [1, 2] {
            let ratio = all.weights[j] / levels[j].level();
            assert!((0.75..1.0).contains(&(ratio * BESIDE_PEAK)), "term {j}: {ratio}");
        }
        assert_eq!(significant(&all.weights, &levels, 8), [0]);
        let exact = NoiseSums { position_sd_px: vec![0.0; n], ..known };
        assert!(significant(&all.weights, &exact.of_terms(&all, &[], size), 8).len() > 5, "without it they are terms");
    }

    #[test]
    fn a_metric_on_columns_scales_their_noise_and_the_share_of_every_row() {
        let noise = NoiseSums {
            rows: vec![6.0, 3.0],
            columns: vec![1.0, 2.0, 6.0],
            position_sd_px: vec![0.0; 2],
            shots: 2,
            mean: 1.5,
        };
        let weighed = noise.weighed(&[3.0, 1.0, 0.5]);
        // 9 + 2 + 1.5 for 9.
        assert_eq!(weighed.columns, [9.0, 2.0, 1.5]);
        let near = |a: f64, b: f64| (a - b).abs() < 1e-12;
        assert!(near(weighed.rows[0], 6.0 * 12.5 / 9.0) && near(weighed.rows[1], 3.0 * 12.5 / 9.0), "{weighed:?}");
        assert!(near(weighed.mean, 1.5 * 12.5 / 9.0));
    }

    #[test]
    fn sums_are_those_of_squares_of_the_unit() {
        let mut noise =
            NoiseSums { rows: vec![36.0], columns: vec![64.0, 4.0], position_sd_px: vec![0.3], shots: 1, mean: 7.0 };
        noise.divide(2.0);
        assert_eq!((noise.rows, noise.columns, noise.mean), (vec![9.0], vec![16.0, 1.0], 1.75));
        assert_eq!(noise.position_sd_px, [0.3], "samples");
    }

    #[test]
    fn terms_are_those_above_their_own_level_and_the_first() {
        let level = |left: f64, right: f64, place: f64| TermNoise { left, right, place, rounding: 0.0 };
        assert_eq!(level(9.0, 16.0, 0.0).level(), 7.0);
        assert_eq!(level(4.0, 1.0, 16.0).level(), 5.0);
        assert_eq!(TermNoise { rounding: 9.0, ..level(4.0, 1.0, 16.0) }.level(), 9.0);
        let levels = [level(0.0, 4.0, 0.0), level(0.0, 4.0, 0.0), level(0.0, 4.0, 60.0), level(0.0, 4.0, 0.0)];
        assert_eq!(significant(&[5.0, 3.0, 2.9, 2.5], &levels, 9), [0, 1, 3], "the third is what places do");
        assert_eq!(significant(&[1.0, 0.5], &levels, 9), [0]);
        assert_eq!(significant(&[5.0, 3.0, 2.9, 2.5], &levels, 2), [0, 1]);
    }

    #[test]
    fn what_is_kept_of_a_term_is_nothing_at_the_edge_and_all_of_it_far_above() {
        let noise = TermNoise { left: 4.0, right: 9.0, place: 0.0, rounding: 0.0 };
        assert!(noise.kept(5.0).abs() < 1e-12, "the edge");
        assert!((noise.kept(5e3) - 1.0).abs() < 1e-5);
        // Gavish and Donoho: √((y² − β − 1)² − 4β)/y for noise of variance 1/n; here y = 6/3 and β = 4/9.
        let (y, beta) = (2.0_f64, 4.0 / 9.0);
        let expected = ((y * y - beta - 1.0).powi(2) - 4.0 * beta).sqrt() / y / y;
        assert!((noise.kept(6.0) - expected).abs() < 1e-12, "{}", noise.kept(6.0));
        let moved = TermNoise { place: 9.0, ..noise };
        assert!((moved.kept(6.0) - expected * 0.75).abs() < 1e-12, "a quarter of its square is what places do");
    }
}
