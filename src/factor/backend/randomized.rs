//! Block Krylov iteration from a random start (`Musco2015`): every pass over the rows multiplies the newest block by
//! AᵀA, and the leading triplets are taken from the span of all blocks (Rayleigh–Ritz). A power iteration forgets the
//! earlier blocks, and needs about the square of the passes for the same accuracy.

use super::{LowRank, Rows, eigenpairs, product};
use crate::Result;
use crate::factor::products::multiply;
use faer::{Accum, Mat, MatRef};
use rand::{Rng, SeedableRng};

/// Columns of a block beyond the triplets asked for.
const OVERSAMPLING: usize = 8;
/// Passes after which a spectrum is taken to be as flat as it looks.
const MOST_PASSES: usize = 12;
/// Power passes on the found vectors.
const MOST_REFINEMENTS: usize = 6;
/// What products in f32 leave of a residual, relative.
const F32_RESIDUAL: f64 = 3e-7;

pub(super) fn block_krylov(rows: &dyn Rows, k: usize, accuracy: f64, start: Option<&LowRank>) -> Result<LowRank> {
    let (n, m) = rows.shape();
    let width = (k + OVERSAMPLING).min(n).min(m);
    // The start is random but the same every time: the result is a function of the matrix alone.
    let mut random = rand_pcg::Pcg64::seed_from_u64(0);
    let mut next = move || f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5;
    let given = start.map_or(0, |s| s.singular_values.len().min(width));
    let mut block = Mat::from_fn(m, width, |i, j| match start {
        Some(s) if j < given => s.vectors[j * m + i],
        _ => next(),
    });
    block = block.qr().compute_thin_Q();
    if given >= k && k > 0 {
        // Known vectors, of nearly the same rows: power passes are enough.
        let values = start.map_or(Vec::new(), |s| s.singular_values.iter().map(|s| s * s).collect());
        let ritz = Ritz { residuals: vec![0.0; width], values, vectors: block };
        return refined(rows, ritz, k, accuracy, 0);
    }
    let (mut basis, mut image) = (Mat::<f64>::zeros(m, 0), Mat::<f64>::zeros(m, 0));
    let mut passes = 0;
    let ritz = loop {
        let multiplied = gram_times(rows, block.as_ref())?;
        passes += 1;
        basis = beside(&basis, &block);
        image = beside(&image, &multiplied);
        let ritz = Ritz::new(&basis, &image, width)?;
        let room = m - basis.ncols();
        if passes == MOST_PASSES || room == 0 || ritz.converged(k, accuracy, true) {
            break ritz;
        }
        let newest = multiplied.subcols(0, width.min(room)).to_owned();
        match orthonormal_rest(&basis, newest, ritz.largest(), &mut next) {
            Some(rest) => block = rest,
            None => break ritz,
        }
    };
    refined(rows, ritz, k, accuracy, passes)
}

/// Power passes on Ritz vectors. A product in f32 is off by a share of what is multiplied: in a block of mixed vectors
/// by that share of σ_1², which hides small values, in a Ritz vector by that share of σ_1 σ.
fn refined(rows: &dyn Rows, mut ritz: Ritz, k: usize, accuracy: f64, mut passes: usize) -> Result<LowRank> {
    for _ in 0..MOST_REFINEMENTS {
        let image = gram_times(rows, ritz.vectors.as_ref())?;
        passes += 1;
        // The image itself, each vector to unit length, is one power step nearer; what it was multiplied from tells the
        // error.
        let told = Ritz::new(&ritz.vectors, &image, ritz.vectors.ncols())?;
        let converged = told.converged(k, accuracy, false);
        let mut vectors = image;
        for j in 0..vectors.ncols() {
            let norm = vectors.col(j).norm_l2();
            let from = if norm > 0.0 { 1.0 / norm } else { 0.0 };
            (0..vectors.nrows()).for_each(|i| vectors[(i, j)] *= from);
            if norm == 0.0 {
                (0..vectors.nrows()).for_each(|i| vectors[(i, j)] = ritz.vectors[(i, j)]);
            }
        }
        // Twice: leading vectors are nearly orthogonal already, and stay where they are.
        for _ in 0..2 {
            vectors = vectors.qr().compute_thin_Q();
        }
        ritz = Ritz { vectors, ..told };
        if converged {
            break;
        }
    }
    Ok(ritz.low_rank(k, passes))
}

/// Leading eigenpairs of AᵀA within a subspace.
struct Ritz {
    /// Descending.
    values: Vec<f64>,
    vectors: Mat<f64>,
    /// ‖AᵀA v − θ v‖ of each.
    residuals: Vec<f64>,
}

impl Ritz {
    fn new(basis: &Mat<f64>, image: &Mat<f64>, k: usize) -> Result<Self> {
        let projected = basis.transpose() * image;
        let s = projected.nrows();
        // Symmetric but for rounding.
        let symmetric = Mat::from_fn(s, s, |i, j| (projected[(i, j)] + projected[(j, i)]) / 2.0);
        let k = k.min(s);
        let (values, rotation) = eigenpairs(symmetric.as_ref(), k)?;
        let vectors = basis * &rotation;
        let images = image * &rotation;
        let residual = |j: usize| {
            let off = |i: usize| images[(i, j)] - values[j] * vectors[(i, j)];
            (0..vectors.nrows()).map(|i| off(i) * off(i)).sum::<f64>().sqrt()
        };
        let residuals = (0..k).map(residual).collect();
        Ok(Self { values, vectors, residuals })
    }

    fn largest(&self) -> f64 {
        self.values.first().copied().unwrap_or(0.0)
    }

    /// Whether the first `k` singular values are right to `accuracy` σ_1: |σ − √θ| ≤ residual / (2 √θ), or as well as
    /// f32 can tell: in products of Ritz vectors, or of mixed ones.
    fn converged(&self, k: usize, accuracy: f64, mixed: bool) -> bool {
        let largest = self.largest();
        let floor = |theta: f64| F32_RESIDUAL * if mixed { largest } else { (largest * theta).sqrt() };
        let most = |theta: f64| (2.0 * accuracy * (largest * theta).sqrt()).max(floor(theta));
        self.values.iter().zip(&self.residuals).take(k).all(|(&theta, &r)| r <= most(theta))
    }

    fn low_rank(self, k: usize, passes: usize) -> LowRank {
        let largest = self.largest().sqrt();
        let error = |(&theta, &r): (&f64, &f64)| if r > 0.0 { (r / (2.0 * theta.sqrt())).min(r.sqrt()) } else { 0.0 };
        let worst = self.values.iter().zip(&self.residuals).take(k).map(error).fold(0.0, f64::max);
        LowRank {
            singular_values: self.values.iter().map(|v| v.sqrt()).collect(),
            vectors: super::transposed(self.vectors.as_ref(), self.values.len()),
            passes,
            residual: if largest > 0.0 { worst / largest } else { 0.0 },
        }
    }
}

/// AᵀA times a block of columns, one pass.
pub(super) fn gram_times(rows: &dyn Rows, block: MatRef<'_, f64>) -> Result<Mat<f64>> {
    let (m, width) = (block.nrows(), block.ncols());
    // [width, m], row-major: what products with rows want.
    let narrow: Vec<f32> = (0..width).flat_map(|j| (0..m).map(move |i| (i, j))).map(|at| block[at] as f32).collect();
    rows.gram_times(&narrow, width)
}

pub(in crate::factor) fn gram_times_here<R: Rows + ?Sized>(
    rows: &R,
    columns: &[f32],
    width: usize,
) -> Result<Mat<f64>> {
    let m = rows.shape().1;
    let narrow = MatRef::from_row_major_slice(columns, width, m);
    let mut sum = Mat::<f64>::zeros(m, width);
    let mut part = Mat::<f32>::zeros(m, width);
    rows.for_each(&mut |_, values| {
        let count = values.len() / m.max(1);
        let a = MatRef::from_row_major_slice(values, count, m);
        let mut projected = vec![0.0_f32; count * width];
        product(a, narrow, &mut projected);
        let projected = MatRef::from_row_major_slice(&projected, count, width);
        multiply(part.as_mut(), Accum::Replace, a.transpose(), projected);
        for j in 0..width {
            for i in 0..m {
                sum[(i, j)] += f64::from(part[(i, j)]);
            }
        }
        Ok(())
    })?;
    Ok(sum)
}

fn beside(a: &Mat<f64>, b: &Mat<f64>) -> Mat<f64> {
    let left = a.ncols();
    Mat::from_fn(b.nrows(), left + b.ncols(), |i, j| if j < left { a[(i, j)] } else { b[(i, j - left)] })
}

/// An orthonormal basis of what `block` has outside the span of `basis`; columns that have nothing there but rounding
/// become random. `None` when none has.
fn orthonormal_rest(
    basis: &Mat<f64>,
    mut block: Mat<f64>,
    largest: f64,
    next: &mut impl FnMut() -> f64,
) -> Option<Mat<f64>> {
    let remove = |block: &mut Mat<f64>| {
        let along = basis.transpose() * &*block;
        *block -= basis * along;
    };
    remove(&mut block);
    let mut left = 0;
    for j in 0..block.ncols() {
        let norm = block.col(j).norm_l2();
        if norm > F32_RESIDUAL * largest {
            left += 1;
            (0..block.nrows()).for_each(|i| block[(i, j)] /= norm);
        } else {
            (0..block.nrows()).for_each(|i| block[(i, j)] = next());
        }
    }
    if left == 0 {
        return None;
    }
    for _ in 0..2 {
        remove(&mut block);
        block = block.qr().compute_thin_Q();
    }
    Some(block)
}

#[cfg(test)]
mod tests {
    use super::super::tests::InMemory;
    use super::super::{Backend, low_rank};
    use super::*;

    const ROWS: usize = 60;
    const COLUMNS: usize = 40;

    fn sigma(j: usize) -> f64 {
        0.7_f64.powi(j as i32)
    }

    /// Column cosine of term j: orthonormal, and not in the order of the terms.
    fn right(j: usize, d: usize) -> f64 {
        let k = (7 * j + 3) % COLUMNS;
        let norm = if k == 0 { 1.0 } else { 2.0_f64.sqrt() } / (COLUMNS as f64).sqrt();
        norm * (std::f64::consts::PI * k as f64 * (d as f64 + 0.5) / COLUMNS as f64).cos()
    }

    fn rows() -> InMemory {
        let left = |j: usize, i: usize| {
            (2.0 / ROWS as f64).sqrt() * (std::f64::consts::PI * (j + 1) as f64 * (i as f64 + 0.5) / ROWS as f64).cos()
        };
        let value = |i: usize, d: usize| (0..20).map(|j| sigma(j) * left(j, i) * right(j, d)).sum();
        let values: Vec<f64> = (0..ROWS * COLUMNS).map(|at| value(at / COLUMNS, at % COLUMNS)).collect();
        InMemory::new(&values, COLUMNS, 13)
    }

    fn known(terms: usize, off: f64) -> LowRank {
        let vector = |j: usize| (0..COLUMNS).map(move |d| right(j, d) + off * ((d * d + 3 * j) as f64).sin());
        LowRank::new((0..terms).map(sigma).collect(), (0..terms).flat_map(vector).collect())
    }

    #[test]
    fn a_start_with_the_vectors_looked_for_ends_after_one_pass() {
        let found = low_rank(&rows(), 6, Backend::Randomized, 1e-5, Some(&known(6, 0.0))).unwrap();
        assert_eq!(found.passes, 1);
        for j in 0..6 {
            assert!((found.singular_values[j] - sigma(j)).abs() < 1e-6, "products in f32: {:?}", found.singular_values);
            let along: f64 = (0..COLUMNS).map(|d| found.vectors[j * COLUMNS + d] * right(j, d)).sum();
            assert!((along.abs() - 1.0).abs() < 1e-6, "the same vector: {along}");
        }
    }

    #[test]
    fn a_start_that_is_rough_or_too_short_is_improved_to_the_accuracy_asked_for() {
        for (start, k) in [(known(6, 0.02), 6), (known(3, 0.0), 8), (known(12, 0.02), 5)] {
            let found = low_rank(&rows(), k, Backend::Randomized, 1e-5, Some(&start)).unwrap();
            for j in 0..k {
                let off = (found.singular_values[j] - sigma(j)).abs();
                assert!(off < 1e-5, "σ_{j} of {k} from {}: {off}", start.singular_values.len());
            }
        }
    }

    fn ritz(values: &[f64], residuals: &[f64]) -> Ritz {
        let vectors = Mat::from_fn(3, values.len(), |i, j| (10 * i + j) as f64);
        Ritz { values: values.to_vec(), vectors, residuals: residuals.to_vec() }
    }

    #[test]
    fn values_have_converged_when_residuals_promise_the_accuracy_or_are_rounding() {
        // θ = 16, 1, 0.25: σ = 4, 1, 0.5. |σ − √θ| ≤ r / (2 √θ) is 1e-3 σ_1 for r = 2e-3 · 4 · σ.
        let limits = [0.032, 0.008, 0.004];
        let all = |scale: f64| limits.map(|r| r * scale);
        let converged = |r: [f64; 3], k, accuracy, mixed| ritz(&[16.0, 1.0, 0.25], &r).converged(k, accuracy, mixed);
        assert!(converged(all(0.999), 3, 1e-3, false));
        for j in 0..3 {
            let mut r = all(0.999);
            r[j] = 1.001 * limits[j];
            assert!(!converged(r, 3, 1e-3, false), "{j}");
            assert_eq!(converged(r, 2, 1e-3, false), j == 2, "only the first k count");
        }
        // Rounding: 3e-7 of σ_1 σ in products of Ritz vectors, of σ_1² in those of mixed ones.
        let rounding = [16.0, 4.0, 2.0].map(|s| 3e-7 * s);
        assert!(converged(rounding.map(|r| 0.999 * r), 3, 0.0, false));
        assert!(!converged(rounding.map(|r| 1.001 * r), 3, 0.0, false));
        assert!(converged([0.999 * rounding[0]; 3], 3, 0.0, true));
        assert!(!converged([0.999 * rounding[0]; 3], 3, 0.0, false));
    }

    #[test]
    fn the_stated_error_is_the_largest_of_the_terms_asked_for_over_the_first_value() {
        let low = ritz(&[16.0, 1.0, 0.25], &[0.08, 0.004, 9.0]).low_rank(2, 7);
        assert_eq!((low.singular_values.as_slice(), low.passes), ([4.0, 1.0, 0.5].as_slice(), 7));
        assert_eq!(low.vectors, [0.0, 10.0, 20.0, 1.0, 11.0, 21.0, 2.0, 12.0, 22.0]);
        // 0.08 / 8 and 0.004 / 2, over 4.
        assert!((low.residual - 0.01 / 4.0).abs() < 1e-15, "{}", low.residual);
        // Of a value near zero √r is less: 0.1 of 4.
        let small = ritz(&[16.0, 1e-6], &[0.0, 0.01]).low_rank(2, 1);
        assert!((small.residual - 0.1 / 4.0).abs() < 1e-15, "{}", small.residual);
        assert_eq!(ritz(&[0.0, 0.0], &[0.0, 0.0]).low_rank(2, 1).residual, 0.0);
    }
}
