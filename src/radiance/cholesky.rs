//! Small symmetric systems.

/// Solves a small symmetric positive definite system by Cholesky; `None` when it is not.
pub(crate) fn solve(mut a: Vec<f64>, mut b: Vec<f64>) -> Option<Vec<f64>> {
    let n = b.len();
    factorize(&mut a, n)?;
    for i in 0..n {
        let sum: f64 = (0..i).map(|k| a[i * n + k] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i * n + i];
    }
    for i in (0..n).rev() {
        let sum: f64 = (i + 1..n).map(|k| a[k * n + i] * b[k]).sum();
        b[i] = (b[i] - sum) / a[i * n + i];
    }
    b.iter().all(|v| v.is_finite()).then_some(b)
}

fn factorize(a: &mut [f64], n: usize) -> Option<()> {
    for i in 0..n {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| a[i * n + k] * a[j * n + k]).sum();
            let v = a[i * n + j] - sum;
            a[i * n + j] = if i != j {
                v / a[j * n + j]
            } else if v > 0.0 {
                v.sqrt()
            } else {
                return None;
            };
        }
    }
    Some(())
}

/// Logarithm of the determinant of such a matrix, row by row; `None` when it is not positive definite.
pub(crate) fn log_determinant(mut a: Vec<f64>, n: usize) -> Option<f64> {
    factorize(&mut a, n)?;
    Some((0..n).map(|i| 2.0 * a[i * n + i].ln()).sum())
}
