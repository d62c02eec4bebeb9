//! Non-negative factorization (`Peers2006`): rows ≈ m ∘ (F H) with F, H ≥ 0, m the mean profile.
//!
//! Weights are m²: the error of R / m counts as what it is in R, so the sum that falls is that of least squares in R,
//! as for the other models (the paper does not give its weights). Hierarchical alternating least squares
//! (`Cichocki2009`): one factor at a time has a closed solution. The rows are first projected to many more singular
//! triplets than there are terms: what that leaves out is small beside what a non-negative factorization leaves, and an
//! iteration then costs nothing of the rows' length.

use super::backend::Triplets;
use super::products;
use faer::{Accum, Mat, MatRef};
use rand::{Rng, SeedableRng};

/// Iterations at the most.
const ROUNDS: usize = 1000;
/// Relative fall of the error over ten iterations below which it is taken to have ended.
const SETTLED: f64 = 3e-5;

/// Factors of one plane.
pub(super) struct NonNegative {
    /// \[rows, terms\].
    pub left: Vec<f64>,
    /// \[terms, samples\], before the profile.
    pub right: Vec<f64>,
}

/// Factors the columns `first .. first + profile.len()` of the projected rows.
pub(super) fn factorize(
    projected: &Triplets,
    columns: usize,
    first: usize,
    profile: &[f64],
    terms: usize,
) -> NonNegative {
    let (rank, m) = (projected.weights.len(), profile.len());
    let n = projected.left.len() / rank.max(1);
    // A = Y Vᵀ, n × m: least squares in R is that of A itself against F (H m).
    let y = Mat::from_fn(n, rank, |i, j| projected.left[i * rank + j] * projected.weights[j]);
    let v = Mat::from_fn(m, rank, |d, j| projected.right[j * columns + first + d]);
    let (mut left, mut right) = start(&y, &v, profile, terms);
    let energy = squared(&(y.transpose() * &y), &(v.transpose() * &v));
    let mut before = f64::INFINITY;
    for round in 0..ROUNDS {
        let (products, gram) = (multiply(&y, &(v.transpose() * &right)), right.transpose() * &right);
        update(&mut left, &products, &gram);
        let (products, gram) = (multiply(&v, &(y.transpose() * &left)), left.transpose() * &left);
        update(&mut right, &products, &gram);
        if round % 10 == 9 {
            let cross: f64 = (0..terms).map(|j| (0..m).map(|d| products[(d, j)] * right[(d, j)]).sum::<f64>()).sum();
            let error = (energy - 2.0 * cross + squared(&gram, &(right.transpose() * &right))).max(0.0);
            if !(before - error > SETTLED * error) {
                break;
            }
            before = error;
        }
    }
    NonNegative {
        left: (0..n).flat_map(|i| (0..terms).map(move |j| (i, j))).map(|at| left[at]).collect(),
        right: (0..terms)
            .flat_map(|j| (0..m).map(move |d| (d, j)))
            .map(|(d, j)| if profile[d] > 0.0 { right[(d, j)] / profile[d] } else { 0.0 })
            .collect(),
    }
}

/// A start from the singular triplets (`Boutsidis2008`): of each, the positive parts of both sides or the negative
/// ones, whichever are larger. Zeros become small: they could not grow otherwise.
fn start(y: &Mat<f64>, v: &Mat<f64>, profile: &[f64], terms: usize) -> (Mat<f64>, Mat<f64>) {
    let part = |m: &Mat<f64>, j: usize, sign: f64| -> Vec<f64> {
        (0..m.nrows()).map(|i| if j < m.ncols() { (sign * m[(i, j)]).max(0.0) } else { 0.0 }).collect()
    };
    let length = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>().sqrt();
    let mean = profile.iter().sum::<f64>() / profile.len().max(1) as f64;
    let (mut left, mut right) = (Mat::zeros(y.nrows(), terms), Mat::zeros(v.nrows(), terms));
    let mut random = rand_pcg::Pcg64::seed_from_u64(0);
    let mut next = || f64::from(random.next_u32()) / f64::from(u32::MAX);
    for j in 0..terms {
        let [positive, negative] = [1.0, -1.0].map(|sign| (part(y, j, sign), part(v, j, sign)));
        let size = |(l, r): &(Vec<f64>, Vec<f64>)| length(l) * length(r);
        let (l, r) = if size(&positive) >= size(&negative) { positive } else { negative };
        let (nl, nr) = (length(&l), length(&r));
        if nl > 0.0 && nr > 0.0 {
            let scale = (nl / nr).sqrt();
            (0..y.nrows()).for_each(|i| left[(i, j)] = l[i] / scale);
            (0..v.nrows()).for_each(|d| right[(d, j)] = r[d] * scale);
        }
        let typical = (0..y.nrows()).map(|i| left[(i, j)]).sum::<f64>() / y.nrows().max(1) as f64;
        (0..y.nrows()).for_each(|i| left[(i, j)] += 1e-2 * next() * if typical > 0.0 { typical } else { 1.0 });
        (0..v.nrows()).for_each(|d| right[(d, j)] += 1e-2 * next() * (profile[d].max(0.0) + 1e-3 * mean));
    }
    (left, right)
}

fn multiply(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    let mut out = Mat::zeros(a.nrows(), b.ncols());
    products::multiply(out.as_mut(), Accum::Replace, a.as_ref(), b.as_ref());
    out
}

/// Σ of the products of two symmetric matrices' entries: ‖F H‖² from their Gram matrices.
fn squared(a: &Mat<f64>, b: &Mat<f64>) -> f64 {
    (0..a.ncols()).map(|j| (0..a.nrows()).map(|i| a[(i, j)] * b[(i, j)]).sum::<f64>()).sum()
}

/// One sweep: every column in turn takes its best non-negative values, given the others. `products` is the data times
/// the other side, `gram` the other side's products with itself.
fn update(factor: &mut Mat<f64>, products: &Mat<f64>, gram: &Mat<f64>) {
    for j in 0..factor.ncols() {
        let own = gram[(j, j)];
        if !(own > 0.0) {
            continue;
        }
        let others: Mat<f64> = multiply_column(factor.as_ref(), gram, j);
        for i in 0..factor.nrows() {
            factor[(i, j)] = (factor[(i, j)] + (products[(i, j)] - others[(i, 0)]) / own).max(0.0);
        }
    }
}

fn multiply_column(factor: MatRef<'_, f64>, gram: &Mat<f64>, j: usize) -> Mat<f64> {
    let mut out = Mat::zeros(factor.nrows(), 1);
    products::multiply(out.as_mut(), Accum::Replace, factor, gram.as_ref().subcols(j, 1));
    out
}

#[cfg(test)]
mod tests {
    use super::super::backend::{Backend, low_rank, tests::InMemory, triplets};
    use super::*;

    #[test]
    fn rows_that_are_a_non_negative_product_are_recovered_by_one() {
        let (n, m, terms) = (60, 40, 3);
        let f = |i: usize, j: usize| ((i * (j + 2) + 3 * j) % 7) as f64 / 7.0;
        let h = |j: usize, d: usize| (-(d as f64 - 10.0 * j as f64).abs() / 6.0).exp();
        let values: Vec<f64> =
            (0..n).flat_map(|i| (0..m).map(move |d| (0..terms).map(|j| f(i, j) * h(j, d)).sum())).collect();
        let rows = InMemory::new(&values, m, 16);
        let low = low_rank(&rows, 12, Backend::Full, 0.0, None).unwrap();
        let projected = triplets(&rows, &low, 12, true).unwrap();
        let mean: Vec<f64> = (0..m).map(|d| (0..n).map(|i| values[i * m + d]).sum::<f64>() / n as f64).collect();
        let found = factorize(&projected, m, 0, &mean, terms);
        assert!(found.left.iter().chain(&found.right).all(|&v| v >= 0.0));
        let (mut error, mut size) = (0.0, 0.0);
        for i in 0..n {
            for d in 0..m {
                let fit: f64 = (0..terms).map(|j| found.left[i * terms + j] * found.right[j * m + d]).sum();
                error += (fit * mean[d] - values[i * m + d]).powi(2);
                size += values[i * m + d].powi(2);
            }
        }
        // Alternating least squares ends near the exact factors, not at them.
        assert!(error < 1e-4 * size, "{}", (error / size).sqrt());
    }

    #[test]
    fn a_sweep_takes_the_best_column_after_column_given_the_others() {
        // Three rows, two columns. products = A H, gram = H H.
        let mut factor = Mat::from_fn(3, 2, |i, j| [[1.0, 2.0], [0.5, 4.0], [3.0, 0.0]][i][j]);
        let products = Mat::from_fn(3, 2, |i, j| [[9.0, 4.0], [1.0, 7.0], [8.0, 11.0]][i][j]);
        let gram = Mat::from_fn(2, 2, |i, j| [[4.0, 1.0], [1.0, 2.0]][i][j]);
        update(&mut factor, &products, &gram);
        // First column (p − gram₁₀ other) / gram₀₀: 7/4, −3/4 → 0, 8/4; the second with these: (4 − 7/4)/2, 7/2, (11 −
        // 2)/2.
        let expected = [[1.75, 1.125], [0.0, 3.5], [2.0, 4.5]];
        for i in 0..3 {
            assert!((0..2).all(|j| (factor[(i, j)] - expected[i][j]).abs() < 1e-15), "rounding: {factor:?}");
        }
        let before = factor.clone();
        update(&mut factor, &products, &Mat::zeros(2, 2));
        assert_eq!(factor, before, "nothing is known of a column whose other side is zero");
        // ‖F H‖² of F = (1 2; 3 4; 5 6), H = (1 0 2; 0 3 1): entries 1 6 4, 3 12 10, 5 18 16.
        let f = Mat::from_fn(3, 2, |i, j| [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]][i][j]);
        let h = Mat::from_fn(2, 3, |i, j| [[1.0, 0.0, 2.0], [0.0, 3.0, 1.0]][i][j]);
        assert_eq!(squared(&(f.transpose() * &f), &(&h * h.transpose())), 911.0);
    }

    #[test]
    fn a_plane_is_factored_by_itself_over_its_own_profile() {
        let (n, m) = (7, 5);
        let f = |i: usize| 0.5 + ((i * 3) % 7) as f64 / 7.0;
        let h = |p: usize, d: usize| if (p, d) == (1, 3) { 0.0 } else { (1 + p) as f64 / (1.0 + (d + 2 * p) as f64) };
        let values: Vec<f64> = (0..n * 2 * m).map(|at| f(at / 10) * h(at % 10 / m, at % m)).collect();
        let rows = InMemory::new(&values, 2 * m, 3);
        let low = low_rank(&rows, 3, Backend::Full, 0.0, None).unwrap();
        let projected = triplets(&rows, &low, 3, true).unwrap();
        for p in 0..2 {
            let profile: Vec<f64> = (0..m).map(|d| (0..n).map(f).sum::<f64>() / n as f64 * h(p, d)).collect();
            let found = factorize(&projected, 2 * m, p * m, &profile, 1);
            for (i, d) in (0..n).flat_map(|i| (0..m).map(move |d| (i, d))) {
                let fit = found.left[i] * found.right[d] * profile[d];
                // One term is found by the first sweep; rows are f32.
                assert!((fit - f(i) * h(p, d)).abs() < 1e-5, "plane {p} row {i} sample {d}: {fit}");
            }
            assert!(p == 0 || found.right[3] == 0.0, "nothing where the profile is zero");
        }
    }

    #[test]
    fn a_start_is_the_larger_part_of_one_sign_of_each_triplet_and_a_hundredth_of_chance() {
        // Three terms from two singular triplets y_j v_j': the second's negative parts are the larger, the third term
        // has no triplet.
        let (rows, samples) = (4, 5);
        let left = [[3.0, 0.5], [1.0, -2.0], [2.0, -1.0], [4.0, 0.25]];
        let right = [[0.5, 0.2], [0.4, -0.6], [0.3, -0.3], [0.2, 0.5], [0.1, 0.0]];
        let y = Mat::from_fn(rows, 2, |i, j| left[i][j]);
        let v = Mat::from_fn(samples, 2, |d, j| right[d][j]);
        let profile = [0.4, 0.3, 0.0, 0.2, 0.1];
        let (l, r) = start(&y, &v, &profile, 3);
        let length = |v: &[f64]| v.iter().map(|v| v * v).sum::<f64>().sqrt();
        let parts = [
            [vec![3.0, 1.0, 2.0, 4.0], vec![0.5, 0.4, 0.3, 0.2, 0.1]],
            [vec![0.0, 2.0, 1.0, 0.0], vec![0.0, 0.6, 0.3, 0.0, 0.0]],
        ];
        let (mut chance, mut count) = (0.0, 0.0);
        for j in 0..3 {
            let (a, b) = match parts.get(j) {
                // Both sides get the same length, and the product stays.
                Some([a, b]) => {
                    let both = (length(a) * length(b)).sqrt();
                    (a.iter().map(|v| v * both / length(a)).collect(), b.iter().map(|v| v * both / length(b)).collect())
                }
                None => (vec![0.0; rows], vec![0.0; samples]),
            };
            let mean = a.iter().sum::<f64>() / rows as f64;
            let typical = if mean > 0.0 { mean } else { 1.0 };
            let mut near = |found: f64, exact: f64, most: f64| {
                assert!((-1e-12..=most + 1e-12).contains(&(found - exact)), "term {j}: {found} {exact} {most}");
                chance += (found - exact) / most;
                count += 1.0;
            };
            (0..rows).for_each(|i| near(l[(i, j)], a[i], 0.01 * typical));
            // The mean of the profile is 0.2.
            (0..samples).for_each(|d| near(r[(d, j)], b[d], 0.01 * (profile[d] + 0.001 * 0.2)));
        }
        // 27 even numbers have the mean 0.5 to 0.056; four of that.
        assert!((chance / count - 0.5).abs() < 0.22, "{}", chance / count);
    }
}
