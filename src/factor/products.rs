//! Products of matrices on all cores, whose digits do not depend on how many there are: each core takes whole blocks of
//! the result, which have the same size everywhere. (faer's own threads divide sums among themselves.)

use faer::linalg::matmul::matmul;
use faer::traits::ComplexField;
use faer::{Accum, Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

/// Columns or rows of the result that one core takes at a time: enough for the blocks in which a product is quick.
const BLOCK: usize = 96;
/// Of results that are smaller than that along both axes the sums are divided, into parts of so many addends.
const ADDENDS: usize = 1 << 12;

/// `out` = a b, or `out` += a b.
pub(super) fn multiply<T: ComplexField + Copy + Send + Sync>(
    mut out: MatMut<'_, T>,
    accum: Accum,
    a: MatRef<'_, T>,
    b: MatRef<'_, T>,
) {
    let one = T::one_impl();
    if out.nrows().max(out.ncols()) <= BLOCK && a.ncols() > ADDENDS {
        let parts: Vec<Mat<T>> = (0..a.ncols().div_ceil(ADDENDS))
            .into_par_iter()
            .map(|part| {
                let (from, len) = (part * ADDENDS, ADDENDS.min(a.ncols() - part * ADDENDS));
                let mut sum = Mat::<T>::zeros(a.nrows(), b.ncols());
                matmul(sum.as_mut(), Accum::Replace, a.subcols(from, len), b.subrows(from, len), one, Par::Seq);
                sum
            })
            .collect();
        for (k, part) in parts.iter().enumerate() {
            if k == 0 && matches!(accum, Accum::Replace) {
                out.copy_from(part);
            } else {
                out += part;
            }
        }
    } else if out.ncols() >= out.nrows() {
        let columns = out.par_col_chunks_mut(BLOCK).zip(b.par_col_chunks(BLOCK));
        columns.for_each(|(out, b)| matmul(out, accum, a, b, one, Par::Seq));
    } else {
        let rows = out.par_row_chunks_mut(BLOCK).zip(a.par_row_chunks(BLOCK));
        rows.for_each(|(out, a)| matmul(out, accum, a, b, one, Par::Seq));
    }
}

/// `out` = a b on this core alone.
pub(super) fn multiply_here(out: MatMut<'_, f32>, a: MatRef<'_, f32>, b: MatRef<'_, f32>) {
    matmul(out, Accum::Replace, a, b, 1.0, Par::Seq);
}

/// The lower half of `out` += aᵀ a; some of the upper half changes too.
pub(super) fn add_gram(mut out: MatMut<'_, f64>, a: MatRef<'_, f64>) {
    out.as_mut().par_col_chunks_mut(BLOCK).zip(a.par_col_chunks(BLOCK)).enumerate().for_each(|(k, (out, columns))| {
        let first = k * BLOCK;
        let (rows, left) = (out.nrows() - first, a.subcols(first, a.ncols() - first));
        matmul(out.subrows_mut(first, rows), Accum::Add, left.transpose(), columns, 1.0, Par::Seq);
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(rows: usize, columns: usize) -> Mat<f64> {
        Mat::from_fn(rows, columns, |i, j| ((7 * i + 3 * j * j + 1) as f64).sin())
    }

    #[test]
    fn products_are_right_and_the_same_for_any_number_of_threads() {
        for [m, k, n] in [[5, 9000, 7], [300, 20, 250], [250, 20, 300], [96, 4097, 96], [1, 1, 1]] {
            let (a, b) = (numbers(m, k), numbers(k, n));
            let run = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut out = Mat::from_fn(m, n, |_, _| 1.0);
                pool.install(|| multiply(out.as_mut(), Accum::Add, a.as_ref(), b.as_ref()));
                out
            };
            let (one, three) = (run(1), run(3));
            assert_eq!(one, three);
            let plain = |i: usize, j: usize| 1.0 + (0..k).map(|l| a[(i, l)] * b[(l, j)]).sum::<f64>();
            // Rounding of sums of k numbers up to 1.
            assert!((0..m).all(|i| (0..n).all(|j| (one[(i, j)] - plain(i, j)).abs() < 1e-15 * (k * k) as f64 + 1e-13)));
        }
    }

    #[test]
    fn the_lower_half_of_a_gram_matrix_is_that_of_the_product() {
        let a = numbers(40, 210);
        let mut out = Mat::zeros(210, 210);
        add_gram(out.as_mut(), a.as_ref());
        let plain = |i: usize, j: usize| (0..40).map(|l| a[(l, i)] * a[(l, j)]).sum::<f64>();
        assert!(
            (0..210).all(|j| (j..210).all(|i| (out[(i, j)] - plain(i, j)).abs() < 1e-12)),
            "rounding of 40 addends"
        );
    }
}
