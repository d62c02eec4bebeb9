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

#[cfg(test)]
mod tests {
    use super::*;

    /// L Lᵀ of L = (2, 0, 0; −1, 3, 0; 0.5, 4, 0.25): determinant (2 · 3 · 0.25)² = 2.25.
    const A: [f64; 9] = [4.0, -2.0, 1.0, -2.0, 10.0, 11.5, 1.0, 11.5, 0.25 + 16.0 + 0.0625];

    #[test]
    fn a_system_is_solved_and_its_determinant_is_that_of_its_factor() {
        let x = [3.0, -0.5, 7.0];
        let b = (0..3).map(|i| (0..3).map(|j| A[3 * i + j] * x[j]).sum()).collect();
        let found = solve(A.to_vec(), b).unwrap();
        // Condition of some hundred times 1e-16.
        assert!((0..3).all(|k| (found[k] - x[k]).abs() < 1e-10), "{found:?}");
        assert!((log_determinant(A.to_vec(), 3).unwrap() - 2.25f64.ln()).abs() < 1e-12);
    }

    #[test]
    fn what_is_not_positive_definite_or_not_a_number_has_no_solution() {
        assert_eq!(solve(vec![4.0], vec![10.0]), Some(vec![2.5]));
        assert_eq!(solve(vec![], vec![]), Some(vec![]));
        assert_eq!(solve(vec![0.0], vec![1.0]), None);
        assert_eq!(solve(vec![-1.0], vec![1.0]), None);
        assert_eq!(solve(vec![1.0, 2.0, 2.0, 1.0], vec![1.0, 1.0]), None);
        assert_eq!(solve(vec![1.0], vec![f64::NAN]), None);
        assert_eq!(solve(vec![f64::NAN], vec![1.0]), None);
        assert_eq!(log_determinant(vec![1.0, 1.0, 1.0, 1.0], 2), None);
    }
}
