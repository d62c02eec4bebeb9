//! Leading singular values and right singular vectors of rows that come in blocks.
//!
//! Error modelling (`Bilgili2011`, `Kurt2013`) takes the best rank-1 term, then the best rank-1 term of what that
//! leaves, and so on. The best rank-1 term in least squares is the leading singular triplet, and deflating by it leaves
//! the other triplets as they are (`Eckart1936`): T steps of it are the truncated SVD. [`Backend::Deflation`] takes the
//! steps one by one; the others compute the same at once.

mod deflation;
mod dense;
mod randomized;

pub(super) use dense::gram_here;
pub(super) use randomized::gram_times_here;

use super::products::multiply;
use crate::{Error, Result};
use faer::{Accum, Mat, MatRef, Side};
use rayon::prelude::*;

/// How a truncated SVD is computed. Errors are of singular values, relative to the largest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// The whole matrix in memory, bidiagonalized in f64: 1e-14.
    Full,
    /// Eigenvectors of the Gram matrix over columns in f64, one pass: σ_k to 1e-16 σ_1/σ_k, so that those below 1e-8
    /// σ_1 are lost.
    Gram,
    /// Block Krylov subspace from a random start (`Musco2015`), products in f32, as many passes as the asked accuracy
    /// needs, then power passes on the found vectors, whose products are as accurate as each is large: down to 1e-6,
    /// less where the spectrum is flat.
    Randomized,
    /// One term after the other by power iteration on what the earlier ones leave, as the papers describe it, in f32:
    /// slow, 1e-4 to 1e-6.
    Deflation,
}

impl std::fmt::Display for Backend {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Full => "full",
            Self::Gram => "gram",
            Self::Randomized => "randomized",
            Self::Deflation => "deflation",
        })
    }
}

/// A matrix of f32 that comes in blocks of consecutive rows, the same each time; what back ends want of it is found in
/// one pass each, here or by others ([`super::tasks`]).
pub(super) trait Rows {
    /// Number of rows and columns.
    fn shape(&self) -> (usize, usize);

    /// AᵀA times `width` columns, \[width, columns\]: products in f32, sums over blocks of rows in f64.
    ///
    /// # Errors
    /// Those of the source.
    fn gram_times(&self, columns: &[f32], width: usize) -> Result<Mat<f64>> {
        gram_times_here(self, columns, width)
    }

    /// AᵀA in f64, its lower half.
    ///
    /// # Errors
    /// Those of the source.
    fn gram(&self) -> Result<Mat<f64>> {
        gram_here(self)
    }

    /// Every row times `vectors`, \[any, columns\]: \[rows, any\]; `exact` in f64, else in f32.
    ///
    /// # Errors
    /// Those of the source.
    fn times(&self, vectors: &[f64], exact: bool) -> Result<Vec<f64>> {
        times_here(self, vectors, exact)
    }

    /// Calls `each(first_row, block)`, blocks row-major, in order.
    ///
    /// # Errors
    /// Those of the source and of `each`.
    fn for_each(&self, each: &mut dyn FnMut(usize, &[f32]) -> Result<()>) -> Result<()>;
}

/// Leading singular triplets without their left vectors, which a second pass gives.
#[derive(Debug, Clone)]
pub(super) struct LowRank {
    /// Descending.
    pub singular_values: Vec<f64>,
    /// One unit row for each, \[k, columns\]; its largest entry in magnitude is positive.
    pub vectors: Vec<f64>,
    /// Passes over the rows that it took.
    pub passes: usize,
    /// ‖AᵀA v − σ² v‖ / (2 σ_1 σ), the largest of all triplets: what their singular values are off by, over σ_1, or
    /// less.
    pub residual: f64,
}

/// Multiplications of a full SVD that are still quick (about two seconds).
const FULL_WORK: usize = 1_000_000_000;
/// Columns up to which the Gram matrix and its eigenvectors are affordable (0.7 GiB and ten seconds on two cores).
const GRAM_COLUMNS: usize = 4500;
/// What products in f32 can still tell, relative to the largest singular value.
const F32_ACCURACY: f64 = 1e-6;

/// The back end for rows of this shape: the quickest that reaches `accuracy`.
pub(super) fn choose(rows: usize, columns: usize, accuracy: f64) -> Backend {
    let work = rows.saturating_mul(columns).saturating_mul(rows.min(columns));
    if work <= FULL_WORK {
        Backend::Full
    } else if accuracy >= F32_ACCURACY {
        Backend::Randomized
    } else if columns <= GRAM_COLUMNS {
        Backend::Gram
    } else {
        Backend::Full
    }
}

/// The same where rows are with many tasks: none has all of them.
///
/// # Errors
/// [`Error::Setting`] for an accuracy that would need them.
pub(super) fn choose_for_tasks(columns: usize, accuracy: f64) -> Result<Backend> {
    match accuracy {
        a if a >= F32_ACCURACY => Ok(Backend::Randomized),
        _ if columns <= GRAM_COLUMNS => Ok(Backend::Gram),
        a => Err(Error::Setting {
            setting: "accuracy",
            expected: format!("{F32_ACCURACY:e} or more with tasks, or windows of up to {GRAM_COLUMNS} numbers"),
            found: format!("{a:e} and {columns} numbers"),
        }),
    }
}

/// The `k` leading singular values and right vectors, fewer when the matrix is smaller than that; back ends that
/// iterate may add some that are less accurate. `start` are right vectors for them to begin with, \[any, columns\].
///
/// # Errors
/// Those of the source; [`Error::Internal`] when a decomposition does not converge.
pub(super) fn low_rank(
    rows: &dyn Rows,
    k: usize,
    backend: Backend,
    accuracy: f64,
    start: Option<&LowRank>,
) -> Result<LowRank> {
    let (n, m) = rows.shape();
    let k = k.min(n).min(m);
    let mut low = match backend {
        Backend::Full => dense::full(rows, k)?,
        Backend::Gram => dense::gram(rows, k)?,
        Backend::Randomized => randomized::block_krylov(rows, k, accuracy, start)?,
        Backend::Deflation => deflation::one_by_one(rows, k, accuracy)?,
    };
    for vector in low.vectors.chunks_exact_mut(m.max(1)) {
        let sign = sign_of_largest(vector);
        vector.iter_mut().for_each(|v| *v *= sign);
    }
    Ok(low)
}

/// The factors of the first `terms` triplets.
#[derive(Debug, Clone)]
pub(super) struct Triplets {
    /// g_j, \[terms\].
    pub weights: Vec<f64>,
    /// f_j, unit norm over rows (zeros where the weight is zero), \[rows, terms\].
    pub left: Vec<f64>,
    /// h_j, \[terms, columns\].
    pub right: Vec<f64>,
}

/// A last pass: left vectors A v_j / σ_j. Weights are their lengths, which are right to the square of what the right
/// vectors are off by; for approximate right vectors both sides are rotated to singular vectors of the projected rows.
///
/// # Errors
/// Those of the source.
pub(super) fn triplets(rows: &dyn Rows, low: &LowRank, terms: usize, exact: bool) -> Result<Triplets> {
    let (n, m) = rows.shape();
    let all = low.singular_values.len();
    let terms = terms.min(all);
    let vectors = &low.vectors[..all * m];
    let left = rows.times(vectors, exact)?;
    // Singular vectors of the projected rows, whose Gram matrix is nearly diagonal.
    let projected = MatRef::from_row_major_slice(&left, n, all);
    let small = gram_of(projected);
    let (values, rotation) = eigen(small.as_ref(), terms)?;
    let rotated = projected * &rotation;
    let mut right = vec![0.0; terms * m];
    multiply(
        faer::MatMut::from_row_major_slice_mut(&mut right, terms, m),
        Accum::Replace,
        rotation.transpose(),
        MatRef::from_row_major_slice(vectors, all, m),
    );
    let mut out = Triplets { weights: values, left: vec![0.0; n * terms], right };
    for (j, h) in out.right.chunks_exact_mut(m.max(1)).enumerate() {
        let sign = sign_of_largest(h);
        h.iter_mut().for_each(|v| *v *= sign);
        let sigma = out.weights[j];
        if sigma > 0.0 {
            (0..n).for_each(|i| out.left[i * terms + j] = sign * rotated[(i, j)] / sigma);
        }
    }
    Ok(out)
}

pub(super) fn times_here<R: Rows + ?Sized>(rows: &R, vectors: &[f64], exact: bool) -> Result<Vec<f64>> {
    let m = rows.shape().1;
    let all = vectors.len() / m.max(1);
    let narrow: Vec<f32> = vectors.iter().map(|&v| v as f32).collect();
    let mut found = Vec::with_capacity(rows.shape().0 * all);
    rows.for_each(&mut |_, block| {
        let count = block.len() / m.max(1);
        if exact {
            let (wide, mut out) = (widened(block), vec![0.0; count * all]);
            let v = MatRef::from_row_major_slice(vectors, all, m);
            product(MatRef::from_row_major_slice(&wide, count, m), v, &mut out);
            found.extend(out);
        } else {
            let mut out = vec![0.0_f32; count * all];
            let v = MatRef::from_row_major_slice(&narrow, all, m);
            product(MatRef::from_row_major_slice(block, count, m), v, &mut out);
            found.extend(out.into_iter().map(f64::from));
        }
        Ok(())
    })?;
    Ok(found)
}

/// What makes the largest entry in magnitude positive.
fn sign_of_largest(vector: &[f64]) -> f64 {
    let largest = vector.iter().copied().fold(0.0_f64, |a, b| if b.abs() > a.abs() { b } else { a });
    if largest < 0.0 { -1.0 } else { 1.0 }
}

/// `out` (row-major) = a bᵀ.
pub(super) fn product<T: faer::traits::ComplexField + Copy + Send + Sync>(
    a: MatRef<'_, T>,
    b: MatRef<'_, T>,
    out: &mut [T],
) {
    let out = faer::MatMut::from_row_major_slice_mut(out, a.nrows(), b.nrows());
    multiply(out, Accum::Replace, a, b.transpose());
}

fn widened(block: &[f32]) -> Vec<f64> {
    let mut wide = vec![0.0; block.len()];
    wide.par_chunks_mut(1 << 16).zip(block.par_chunks(1 << 16)).for_each(|(to, from)| {
        to.iter_mut().zip(from).for_each(|(t, &f)| *t = f64::from(f));
    });
    wide
}

/// AᵀA, both halves.
fn gram_of(a: MatRef<'_, f64>) -> Mat<f64> {
    let mut gram = Mat::zeros(a.ncols(), a.ncols());
    multiply(gram.as_mut(), Accum::Replace, a.transpose(), a);
    gram
}

fn transposed(v: MatRef<'_, f64>, k: usize) -> Vec<f64> {
    (0..k).flat_map(|j| (0..v.nrows()).map(move |i| v[(i, j)])).collect()
}

/// Eigenvectors of a symmetric matrix (lower half) for its `k` largest eigenvalues; square roots of those, descending.
fn eigen(gram: MatRef<'_, f64>, k: usize) -> Result<(Vec<f64>, Mat<f64>)> {
    let (values, vectors) = eigenpairs(gram, k)?;
    Ok((values.into_iter().map(f64::sqrt).collect(), vectors))
}

/// The `k` largest eigenvalues of a symmetric positive matrix (lower half), descending, none below zero, and their
/// vectors.
pub(super) fn eigenpairs(gram: MatRef<'_, f64>, k: usize) -> Result<(Vec<f64>, Mat<f64>)> {
    let eigen = gram
        .self_adjoint_eigen(Side::Lower)
        .map_err(|e| Error::internal(format!("the eigendecomposition did not converge: {e:?}")))?;
    let n = gram.nrows();
    let values = eigen.S().column_vector();
    let largest = (0..k).map(|j| values[n - 1 - j].max(0.0)).collect();
    Ok((largest, Mat::from_fn(n, k, |i, j| eigen.U()[(i, n - 1 - j)])))
}

impl LowRank {
    /// Triplets that need no iteration.
    pub(super) fn new(singular_values: Vec<f64>, vectors: Vec<f64>) -> Self {
        Self { singular_values, vectors, passes: 1, residual: 0.0 }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    pub(crate) struct InMemory {
        values: Vec<f32>,
        columns: usize,
        block: usize,
    }

    impl InMemory {
        pub(crate) fn new(values: &[f64], columns: usize, block: usize) -> Self {
            Self { values: values.iter().map(|&v| v as f32).collect(), columns, block }
        }
    }

    impl Rows for InMemory {
        fn shape(&self) -> (usize, usize) {
            (self.values.len() / self.columns, self.columns)
        }
        fn for_each(&self, each: &mut dyn FnMut(usize, &[f32]) -> Result<()>) -> Result<()> {
            for (k, block) in self.values.chunks(self.block * self.columns).enumerate() {
                each(k * self.block, block)?;
            }
            Ok(())
        }
    }

    const ALL: [Backend; 4] = [Backend::Full, Backend::Gram, Backend::Randomized, Backend::Deflation];

    /// Random rows with these singular values, rounded to f32.
    fn with_spectrum(n: usize, m: usize, sigma: impl Fn(usize) -> f64) -> InMemory {
        let mut random = rand_pcg::Pcg64::seed_from_u64(7);
        let mut next = || f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5;
        let r = m.min(n);
        let u = Mat::from_fn(n, r, |_, _| next()).qr().compute_thin_Q();
        let v = Mat::from_fn(m, r, |_, _| next()).qr().compute_thin_Q();
        let s = Mat::from_fn(r, r, |i, j| if i == j { sigma(i) } else { 0.0 });
        let a = u * s * v.transpose();
        let values: Vec<f64> = (0..n).flat_map(|i| (0..m).map(move |j| (i, j))).map(|at| a[at]).collect();
        InMemory::new(&values, m, 7)
    }

    fn residual(rows: &InMemory, t: &Triplets) -> f64 {
        let terms = t.weights.len();
        let mut sum = 0.0;
        for (i, row) in rows.values.chunks(rows.columns).enumerate() {
            for (d, value) in row.iter().enumerate() {
                let fit: f64 =
                    (0..terms).map(|j| t.weights[j] * t.left[i * terms + j] * t.right[j * rows.columns + d]).sum();
                sum += (f64::from(*value) - fit).powi(2);
            }
        }
        sum.sqrt()
    }

    #[test]
    fn every_back_end_leaves_the_residual_that_eckart_and_young_prescribe() {
        for (n, m) in [(40, 25), (25, 40), (60, 60), (5, 3), (1, 9), (9, 1)] {
            let sigma = |i: usize| 0.5_f64.powf(i as f64 / 2.0);
            let rows = with_spectrum(n, m, sigma);
            for backend in ALL {
                let low = low_rank(&rows, 12, backend, 1e-6, None).unwrap();
                let exact = matches!(backend, Backend::Full | Backend::Gram);
                let t = triplets(&rows, &low, 12, exact).unwrap();
                assert_eq!(t.weights.len(), 12.min(n).min(m));
                for (j, s) in t.weights.iter().enumerate() {
                    // Rows are rounded to f32 (6e-8), products of some back ends too; deflation stops at 1e-6.
                    let tolerance = if exact { 2e-7 } else { 3e-6 };
                    assert!((s - sigma(j)).abs() < tolerance, "{backend:?} {n}×{m} σ_{j} = {s}, {}", sigma(j));
                }
                let left_over: f64 = (t.weights.len()..n.min(m)).map(|j| 0.5_f64.powf(j as f64)).sum::<f64>().sqrt();
                assert!((residual(&rows, &t) - left_over).abs() < 1e-5, "{backend:?} {n}×{m}");
            }
        }
    }

    #[test]
    fn values_are_right_to_the_stated_error_whether_the_spectrum_decays_fast_slowly_or_not_at_all() {
        let (n, m) = (300, 120);
        type Spectrum = (&'static str, fn(usize) -> f64);
        let spectra: [Spectrum; 3] = [
            ("fast", |i| 0.5_f64.powi(i as i32)),
            ("slow", |i| 1.0 / (1.0 + i as f64)),
            ("flat", |i| 1.0 - 1e-4 * i as f64),
        ];
        for (name, sigma) in spectra {
            let rows = with_spectrum(n, m, sigma);
            for (backend, tolerance) in
                [(Backend::Full, 1e-7), (Backend::Gram, 1e-7), (Backend::Randomized, 1e-4), (Backend::Deflation, 1e-2)]
            {
                let low = low_rank(&rows, 15, backend, 1e-6, None).unwrap();
                let t = triplets(&rows, &low, 15, false).unwrap();
                let worst = (0..15).map(|j| (t.weights[j] - sigma(j)).abs()).fold(0.0, f64::max);
                // The f32 rows themselves are off by about 1e-7; a flat spectrum has no vectors to converge to, but
                // values.
                assert!(worst < tolerance, "{name} {backend:?}: {worst:e} after {} passes", low.passes);
            }
        }
    }

    #[test]
    fn a_matrix_of_zeros_has_zero_values_and_finite_vectors() {
        let rows = InMemory::new(&[0.0; 24], 4, 5);
        for backend in ALL {
            let low = low_rank(&rows, 3, backend, 1e-6, None).unwrap();
            assert!(low.singular_values.iter().all(|&s| s == 0.0), "{backend:?} {:?}", low.singular_values);
            assert!(low.vectors.iter().all(|v| v.is_finite()), "{backend:?}");
            let t = triplets(&rows, &low, 3, true).unwrap();
            assert!(t.left.iter().all(|&v| v == 0.0));
        }
    }

    /// Rank 0 to 2, equal singular values, equal rows, and rows that differ by thirty decades; the largest is one, as
    /// rows are factored.
    #[test]
    fn rows_at_the_extremes_are_composed_again_by_every_back_end() {
        let bump = |d: usize, at: f64| (-(d as f64 - at).powi(2) / 20.0).exp();
        type Value<'a> = &'a dyn Fn(usize, usize) -> f64;
        let kinds: [(&str, Value<'_>, f64); 6] = [
            ("nothing", &|_, _| 0.0, 0.0),
            ("equal rows", &|_, d| bump(d, 15.0), 1.0),
            ("one term", &|i, d| (1 + i % 3) as f64 * bump(d, 15.0), 3.0),
            ("two terms", &|i, d| bump(d, 15.0) + (i % 2) as f64 * bump(d, 11.0), 2.0),
            ("equal values", &|i, d| f64::from(u8::from(i % 30 == d)), 1.0),
            ("graded", &|i, d| 10.0_f64.powf(-0.5 * i as f64) * bump(d, 12.0 + (i % 2) as f64), 1.0),
        ];
        for (name, value, size) in kinds {
            let values: Vec<f64> =
                (0..60).flat_map(|i| (0..30).map(move |d| (i, d))).map(|(i, d)| value(i, d)).collect();
            let rows = InMemory::new(&values, 30, 16);
            for backend in ALL {
                let low = low_rank(&rows, 30, backend, 1e-6, None).unwrap();
                let t = triplets(&rows, &low, 30, false).unwrap();
                let off = residual(&rows, &t);
                // Of 1,800 entries that are f32, as are products.
                assert!(off <= 1e-5 * size * 42.0, "{name} {backend:?}: {off:e} of {size:e}");
            }
        }
    }

    #[test]
    fn fewer_terms_than_asked_for_are_found_in_rows_of_low_rank() {
        let values: Vec<f64> =
            (0..200).flat_map(|i| (0..50).map(move |d| (1 + i % 3) as f64 * (-0.1 * d as f64).exp())).collect();
        let rows = InMemory::new(&values, 50, 64);
        for backend in ALL {
            let low = low_rank(&rows, 8, backend, 1e-6, None).unwrap();
            let t = triplets(&rows, &low, 8, true).unwrap();
            // One term, the others rounding of f32 products.
            assert!(t.weights[1..].iter().all(|s| *s < 3e-7 * t.weights[0]), "{backend:?} {:?}", t.weights);
        }
    }

    /// k-th cosine of n samples, of unit length: orthogonal to the others.
    fn cosine(n: usize, k: usize, x: usize) -> f64 {
        let norm = if k == 0 { 1.0 } else { 2.0 } / n as f64;
        norm.sqrt() * (std::f64::consts::PI * k as f64 * (x as f64 + 0.5) / n as f64).cos()
    }

    #[test]
    fn products_of_cosines_have_the_triplets_that_they_were_made_of() {
        let sigma = [5.0, 3.0, 2.0, 0.5];
        for (n, m) in [(7, 11), (11, 7)] {
            // Rows have cosine 2, 0, 3, 1 where columns have 1, 4, 0, 2.
            let (left, right) =
                (|j: usize, i| cosine(n, [2, 0, 3, 1][j], i), |j: usize, d| cosine(m, [1, 4, 0, 2][j], d));
            let value = |i: usize, d: usize| -> f64 { (0..4).map(|j| sigma[j] * left(j, i) * right(j, d)).sum() };
            let values: Vec<f64> = (0..n * m).map(|at| value(at / m, at % m)).collect();
            let rows = InMemory::new(&values, m, 3);
            for backend in ALL {
                let low = low_rank(&rows, 4, backend, 1e-6, None).unwrap();
                let t = triplets(&rows, &low, 4, true).unwrap();
                // Rows, and products of some back ends, are f32; vectors are off by that over gaps of a few tenths.
                for j in 0..4 {
                    assert!((t.weights[j] - sigma[j]).abs() < 3e-6, "{backend:?} {n}×{m}: {:?}", t.weights);
                    assert!((low.singular_values[j] - sigma[j]).abs() < 2e-5, "{backend:?}: {:?}", low.singular_values);
                    let h = &t.right[j * m..][..m];
                    let largest = h.iter().copied().fold(0.0, |a: f64, b| if b.abs() > a.abs() + 1e-5 { b } else { a });
                    let along: f64 = (0..m).map(|d| h[d] * right(j, d)).sum();
                    assert!((along.abs() - 1.0).abs() < 1e-5, "{backend:?} {n}×{m} term {j}: {h:?}");
                    assert!(largest > 0.0 || (0..m).any(|d| h[d] >= -largest - 1e-5), "its largest entry is positive");
                    for i in 0..n {
                        let found = t.left[i * 4 + j];
                        assert!((found - along * left(j, i)).abs() < 1e-4, "{backend:?} {n}×{m} term {j}: {found}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_quickest_back_end_that_is_accurate_enough_is_chosen() {
        assert_eq!(choose(1000, 1000, 1e-5), Backend::Full, "a thousand million multiplications");
        assert_eq!(choose(1000, 1001, 1e-5), Backend::Randomized);
        assert_eq!(choose(1_000_000, 30, 1e-9), Backend::Full, "30² million");
        assert_eq!(choose(1_000_000, 32, 1e-6), Backend::Randomized);
        assert_eq!(choose(1_000_000, 4500, 0.9e-6), Backend::Gram);
        assert_eq!(choose(1_000_000, 4501, 0.9e-6), Backend::Full, "columns too many to square");
        assert_eq!(choose(usize::MAX, usize::MAX, 1e-5), Backend::Randomized);
    }

    #[test]
    fn the_largest_entry_decides_the_sign() {
        assert_eq!(sign_of_largest(&[1.0, -3.0, 2.0]), -1.0);
        assert_eq!(sign_of_largest(&[1.0, -2.0, 3.0]), 1.0);
        assert_eq!(sign_of_largest(&[-2.0, 2.0]), -1.0, "the first of equals");
        assert_eq!((sign_of_largest(&[]), sign_of_largest(&[0.0])), (1.0, 1.0));
    }
}
