//! Leading singular values and right singular vectors of a matrix that is read in blocks of rows.
//!
//! Error modelling (`Bilgili2011`, `Kurt2013`) takes the best rank-1 term, then the best rank-1 term of what that
//! leaves, and so on. The best rank-1 term in least squares is the leading singular triplet, and deflating by it
//! leaves the other triplets as they are (`Eckart1936`): T steps of it are the truncated SVD, which is computed
//! here at once.

use crate::{Error, Result};
use faer::linalg::matmul::{
    matmul,
    triangular::{self, BlockStructure},
};
use faer::{Accum, Mat, MatRef, Side, get_global_parallelism};
use rand::{Rng, SeedableRng};
use rayon::prelude::*;

/// A matrix that comes in blocks of consecutive rows, the same each time.
pub trait Rows {
    /// Number of rows and columns.
    fn shape(&self) -> (usize, usize);

    /// Calls `each(first_row, block)`, blocks row-major, in order.
    ///
    /// # Errors
    /// Those of the source and of `each`.
    fn for_each(&self, each: &mut dyn FnMut(usize, &[f64]) -> Result<()>) -> Result<()>;
}

/// How a truncated SVD is computed; each in f64. Errors are relative to the largest singular value.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Backend {
    /// The whole matrix in memory, bidiagonalized: 1e-14.
    Full,
    /// Eigenvectors of the Gram matrix over columns, one pass: values σ_k to 1e-16 σ_1/σ_k, so that those below
    /// 1e-8 σ_1 are lost. Rows come as f32, whose rounding is at 6e-8.
    Gram,
    /// Block power iteration (`Halko2011`) with 30 columns more than asked for and four passes, then one pass for the
    /// values: better than 1e-4 for a slowly decaying spectrum, 1e-8 where values fall by half every five.
    Subspace,
}

/// Leading singular triplets without their left vectors, which a second pass gives.
#[derive(Debug, Clone)]
pub struct LowRank {
    /// Descending.
    pub singular_values: Vec<f64>,
    /// One unit row for each, \[k, columns\]; its largest entry in magnitude is positive.
    pub vectors: Vec<f64>,
}

/// Multiplications of a full SVD that are still quick (about two seconds).
const FULL_WORK: usize = 1_000_000_000;
/// Columns up to which the Gram matrix and its eigenvectors are always quick (seconds).
const GRAM_COLUMNS: usize = 2048;
/// Columns up to which they are affordable (0.7 GiB and ten seconds on two cores), if the rows are so many times more that the power
/// iteration's passes over them would take longer.
const LARGE_GRAM_COLUMNS: usize = 4500;
const LARGE_GRAM_ROWS_PER_COLUMN: usize = 8;
const OVERSAMPLING: usize = 30;
const POWER_PASSES: usize = 4;

/// The back end for a matrix of this shape: the most accurate one that is affordable.
pub fn choose(rows: usize, columns: usize) -> Backend {
    let work = rows.saturating_mul(columns).saturating_mul(rows.min(columns));
    if work <= FULL_WORK {
        Backend::Full
    } else if columns <= GRAM_COLUMNS || (columns <= LARGE_GRAM_COLUMNS && rows / LARGE_GRAM_ROWS_PER_COLUMN >= columns)
    {
        Backend::Gram
    } else {
        Backend::Subspace
    }
}

/// The `k` leading singular values and right vectors, fewer when the matrix is smaller than that.
///
/// # Errors
/// Those of the source; [`Error::Internal`] when a decomposition does not converge.
pub fn low_rank(rows: &dyn Rows, k: usize, backend: Backend) -> Result<LowRank> {
    let (n, m) = rows.shape();
    let k = k.min(n).min(m);
    let (singular_values, mut vectors) = match backend {
        Backend::Full => full(rows, k)?,
        Backend::Gram => gram(rows, k)?,
        Backend::Subspace => subspace(rows, k)?,
    };
    for vector in vectors.chunks_exact_mut(m.max(1)) {
        let largest = vector.iter().copied().fold(0.0_f64, |a, b| if b.abs() > a.abs() { b } else { a });
        if largest < 0.0 {
            vector.iter_mut().for_each(|v| *v = -*v);
        }
    }
    Ok(LowRank { singular_values, vectors })
}

/// Left vectors as they come from one block of rows: r · h_j / σ_j, \[rows, terms\]; zeros where σ_j is zero.
pub fn left_vectors(block: &[f64], low_rank: &LowRank, terms: usize, columns: usize) -> Vec<f64> {
    let weight = |row: &[f64], sigma: f64, h: &[f64]| {
        let dot: f64 = row.iter().zip(h).map(|(a, b)| a * b).sum();
        if sigma > 0.0 { dot / sigma } else { 0.0 }
    };
    let rows = block.par_chunks_exact(columns.max(1));
    rows.flat_map_iter(|row| {
        let triplets = low_rank.singular_values.iter().zip(low_rank.vectors.chunks_exact(columns)).take(terms);
        triplets.map(|(&sigma, h)| weight(row, sigma, h))
    })
    .collect()
}

fn transposed(v: MatRef<'_, f64>, k: usize) -> Vec<f64> {
    (0..k).flat_map(|j| (0..v.nrows()).map(move |i| v[(i, j)])).collect()
}

fn full(rows: &dyn Rows, k: usize) -> Result<(Vec<f64>, Vec<f64>)> {
    let (n, m) = rows.shape();
    let mut all = Vec::with_capacity(n * m);
    rows.for_each(&mut |_, block| {
        all.extend_from_slice(block);
        Ok(())
    })?;
    let a = MatRef::from_row_major_slice(&all, n, m);
    let svd = a.thin_svd().map_err(|e| Error::internal(format!("the SVD did not converge: {e:?}")))?;
    Ok((svd.S().column_vector().iter().take(k).copied().collect(), transposed(svd.V(), k)))
}

/// Eigenvectors of a symmetric matrix (lower half) for its `k` largest eigenvalues; square roots of those, descending.
fn eigen(gram: MatRef<'_, f64>, k: usize) -> Result<(Vec<f64>, Mat<f64>)> {
    let eigen = gram
        .self_adjoint_eigen(Side::Lower)
        .map_err(|e| Error::internal(format!("the eigendecomposition did not converge: {e:?}")))?;
    let n = gram.nrows();
    let values = eigen.S().column_vector();
    let roots = (0..k).map(|j| values[n - 1 - j].max(0.0).sqrt()).collect();
    Ok((roots, Mat::from_fn(n, k, |i, j| eigen.U()[(i, n - 1 - j)])))
}

fn gram(rows: &dyn Rows, k: usize) -> Result<(Vec<f64>, Vec<f64>)> {
    let m = rows.shape().1;
    let mut gram = Mat::<f64>::zeros(m, m);
    rows.for_each(&mut |_, block| {
        let block = MatRef::from_row_major_slice(block, block.len() / m, m);
        add_gram(&mut gram, block);
        Ok(())
    })?;
    let (values, vectors) = eigen(gram.as_ref(), k)?;
    Ok((values, transposed(vectors.as_ref(), k)))
}

/// Adds BᵀB to the lower half of `gram`.
fn add_gram(gram: &mut Mat<f64>, block: MatRef<'_, f64>) {
    triangular::matmul(
        gram.as_mut(),
        BlockStructure::TriangularLower,
        Accum::Add,
        block.transpose(),
        BlockStructure::Rectangular,
        block,
        BlockStructure::Rectangular,
        1.0,
        get_global_parallelism(),
    );
}

fn subspace(rows: &dyn Rows, k: usize) -> Result<(Vec<f64>, Vec<f64>)> {
    let (n, m) = rows.shape();
    let width = (k + OVERSAMPLING).min(n).min(m);
    // The start is random but the same every time: the result is a function of the matrix alone.
    let mut random = rand_pcg::Pcg64::seed_from_u64(0);
    let mut v = Mat::from_fn(m, width, |_, _| f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5);
    v = v.qr().compute_thin_Q();
    let par = get_global_parallelism();
    for _ in 0..POWER_PASSES {
        let mut next = Mat::<f64>::zeros(m, width);
        rows.for_each(&mut |_, block| {
            let block = MatRef::from_row_major_slice(block, block.len() / m, m);
            let projected = block * &v;
            matmul(next.as_mut(), Accum::Add, block.transpose(), projected.as_ref(), 1.0, par);
            Ok(())
        })?;
        v = next.qr().compute_thin_Q();
    }
    let mut small = Mat::<f64>::zeros(width, width);
    rows.for_each(&mut |_, block| {
        let projected = MatRef::from_row_major_slice(block, block.len() / m, m) * &v;
        add_gram(&mut small, projected.as_ref());
        Ok(())
    })?;
    let (values, rotation) = eigen(small.as_ref(), k)?;
    Ok((values, transposed((&v * &rotation).as_ref(), k)))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    pub struct InMemory {
        pub values: Vec<f64>,
        pub columns: usize,
        pub block: usize,
    }

    impl Rows for InMemory {
        fn shape(&self) -> (usize, usize) {
            (self.values.len() / self.columns, self.columns)
        }
        fn for_each(&self, each: &mut dyn FnMut(usize, &[f64]) -> Result<()>) -> Result<()> {
            for (k, block) in self.values.chunks(self.block * self.columns).enumerate() {
                each(k * self.block, block)?;
            }
            Ok(())
        }
    }

    /// Random rows whose singular values fall by half every two.
    fn decaying(n: usize, m: usize) -> InMemory {
        let mut random = rand_pcg::Pcg64::seed_from_u64(7);
        let mut next = || f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5;
        let u = Mat::from_fn(n, m.min(n), |_, _| next()).qr().compute_thin_Q();
        let v = Mat::from_fn(m, m.min(n), |_, _| next()).qr().compute_thin_Q();
        let s = Mat::from_fn(m.min(n), m.min(n), |i, j| if i == j { 0.5_f64.powf(i as f64 / 2.0) } else { 0.0 });
        let a = u * s * v.transpose();
        let values = (0..n).flat_map(|i| (0..m).map(move |j| (i, j))).map(|at| a[at]).collect();
        InMemory { values, columns: m, block: 7 }
    }

    fn residual(rows: &InMemory, low: &LowRank, terms: usize) -> f64 {
        let left = left_vectors(&rows.values, low, terms, rows.columns);
        let mut sum = 0.0;
        for (i, row) in rows.values.chunks(rows.columns).enumerate() {
            for (d, value) in row.iter().enumerate() {
                let fit: f64 = (0..terms)
                    .map(|j| low.singular_values[j] * left[i * terms + j] * low.vectors[j * rows.columns + d])
                    .sum();
                sum += (value - fit) * (value - fit);
            }
        }
        sum.sqrt()
    }

    #[test]
    fn every_back_end_leaves_the_residual_that_eckart_and_young_prescribe() {
        for (n, m) in [(40, 25), (25, 40), (60, 60), (5, 3), (1, 9), (9, 1)] {
            let rows = decaying(n, m);
            for backend in [Backend::Full, Backend::Gram, Backend::Subspace] {
                let low = low_rank(&rows, 12, backend).unwrap();
                let terms = low.singular_values.len();
                assert_eq!(terms, 12.min(n).min(m));
                for (j, s) in low.singular_values.iter().enumerate() {
                    // σ_12 = 0.02: the Gram matrix loses half the digits, eps / 0.02 = 1e-14
                    assert!((s - 0.5_f64.powf(j as f64 / 2.0)).abs() < 1e-12, "{backend:?} {n}×{m} σ_{j} = {s}");
                }
                let left_over: f64 = (terms..n.min(m)).map(|j| 0.5_f64.powf(j as f64)).sum::<f64>().sqrt();
                assert!((residual(&rows, &low, terms) - left_over).abs() < 1e-10, "{backend:?} {n}×{m}");
            }
        }
    }

    #[test]
    fn one_term_at_a_time_is_the_truncated_svd() {
        let rows = decaying(30, 20);
        let at_once = low_rank(&rows, 4, Backend::Full).unwrap();
        let mut rest = InMemory { values: rows.values.clone(), ..decaying(30, 20) };
        for j in 0..4 {
            let term = low_rank(&rest, 1, Backend::Full).unwrap();
            assert!((term.singular_values[0] - at_once.singular_values[j]).abs() < 1e-13);
            let left = left_vectors(&rest.values, &term, 1, 20);
            for (i, row) in rest.values.chunks_mut(20).enumerate() {
                for (value, h) in row.iter_mut().zip(&term.vectors) {
                    *value -= term.singular_values[0] * left[i] * h;
                }
            }
            let same = term.vectors.iter().zip(&at_once.vectors[j * 20..]).all(|(a, b)| (a - b).abs() < 1e-11);
            assert!(same, "term {j}");
        }
    }

    #[test]
    fn a_matrix_of_zeros_has_zero_values_and_finite_vectors() {
        let rows = InMemory { values: vec![0.0; 24], columns: 4, block: 5 };
        for backend in [Backend::Full, Backend::Gram, Backend::Subspace] {
            let low = low_rank(&rows, 3, backend).unwrap();
            assert!(low.singular_values.iter().all(|&s| s == 0.0));
            assert!(low.vectors.iter().all(|v| v.is_finite()), "{backend:?}");
        }
    }
}
