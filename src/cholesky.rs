//! Symmetric positive definite systems, small enough that a matrix library would only cost time: thousands are solved
//! for every shot.

/// The lower triangular factor of a symmetric positive definite matrix.
#[derive(Debug, Clone)]
pub(crate) struct Cholesky {
    lower: Vec<f64>,
    k: usize,
}

impl Cholesky {
    /// From the lower half of a row-major \[k, k\] matrix; `None` where a pivot is not more than `least` of its
    /// diagonal.
    pub(crate) fn strict(a: Vec<f64>, k: usize, least: f64) -> Option<Self> {
        let factor = Self::of(a, k, least);
        (0..k).all(|i| factor.lower[i * k + i].is_finite()).then_some(factor)
    }

    /// The same, but a pivot that is no more than rounding, or not finite, drops its unknown: it is 0 in every
    /// solution.
    pub(crate) fn dropping(a: Vec<f64>, k: usize) -> Self {
        Self::of(a, k, 1e-14)
    }

    fn of(mut a: Vec<f64>, k: usize, least: f64) -> Self {
        for j in 0..k {
            let pivot = a[j * k + j] - (0..j).map(|p| a[j * k + p] * a[j * k + p]).sum::<f64>();
            let usable = pivot.is_finite() && pivot > least * a[j * k + j].abs();
            let root = if usable { pivot.sqrt() } else { f64::INFINITY };
            a[j * k + j] = root;
            for i in j + 1..k {
                let dot: f64 = (0..j).map(|p| a[i * k + p] * a[j * k + p]).sum();
                a[i * k + j] = (a[i * k + j] - dot) / root;
            }
        }
        Self { lower: a, k }
    }

    /// Whether the solution, in place of `b`, is finite.
    pub(crate) fn solve(&self, b: &mut [f64]) -> bool {
        let (a, k) = (&self.lower, self.k);
        for i in 0..k {
            b[i] = (b[i] - (0..i).map(|p| a[i * k + p] * b[p]).sum::<f64>()) / a[i * k + i];
        }
        for i in (0..k).rev() {
            b[i] = (b[i] - (i + 1..k).map(|p| a[p * k + i] * b[p]).sum::<f64>()) / a[i * k + i];
        }
        b.iter().all(|v| v.is_finite())
    }

    fn log_determinant(&self) -> f64 {
        (0..self.k).map(|i| 2.0 * self.lower[i * self.k + i].ln()).sum()
    }
}

/// Solves a system, row by row; `None` when its matrix is not positive definite.
pub(crate) fn solve(a: Vec<f64>, mut b: Vec<f64>) -> Option<Vec<f64>> {
    Cholesky::strict(a, b.len(), 0.0)?.solve(&mut b).then_some(b)
}

/// Logarithm of the determinant of such a matrix, row by row; `None` when it is not positive definite.
pub(crate) fn log_determinant(a: Vec<f64>, n: usize) -> Option<f64> {
    Cholesky::strict(a, n, 0.0).map(|factor| factor.log_determinant())
}

/// Solves a system of known size (lower triangle given); also the diagonal of the inverse. `None` where no more than a
/// millionth of a millionth of a diagonal is left.
pub(crate) fn solve_small<const N: usize>(a: [[f64; N]; N], mut b: [f64; N]) -> Option<([f64; N], [f64; N])> {
    let factor = Cholesky::strict(a.as_flattened().to_vec(), N, 1e-12)?;
    factor.solve(&mut b);
    let inverse = std::array::from_fn(|i| {
        let mut e = [0.0; N];
        e[i] = 1.0;
        factor.solve(&mut e);
        e[i]
    });
    Some((b, inverse))
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

    #[test]
    fn a_small_system_is_solved_and_its_inverse_has_the_right_diagonal() {
        // A = [[4, 2], [2, 3]]: x = A⁻¹ (2, 5) = (−0.5, 2), A⁻¹ has 3/8 and 4/8 on its diagonal.
        let (x, inverse) = solve_small([[4.0, 0.0], [2.0, 3.0]], [2.0, 5.0]).unwrap();
        assert!((x[0] + 0.5).abs() < 1e-14 && (x[1] - 2.0).abs() < 1e-14, "{x:?}");
        assert!((inverse[0] - 0.375).abs() < 1e-14 && (inverse[1] - 0.5).abs() < 1e-14, "{inverse:?}");
        assert!(solve_small([[1.0, 0.0], [1.0, 1.0]], [1.0, 1.0]).is_none(), "singular");
    }

    #[test]
    fn three_equations_are_solved_and_a_nearly_singular_matrix_is_refused_at_any_scale() {
        // A = [[4, 2, 6], [2, 10, 0], [6, 0, 14]]: determinant 144, adjugate [[140, −28, −60], [−28, 20, 12], [−60, 12,
        // 36]].
        let a = [[4.0, 0.0, 0.0], [2.0, 10.0, 0.0], [6.0, 0.0, 14.0]];
        let (x, inverse) = solve_small(a, [1.0, -2.0, 5.0]).unwrap();
        let expected = [(140.0 + 56.0 - 300.0) / 144.0, (-28.0 - 40.0 + 60.0) / 144.0, (-60.0 - 24.0 + 180.0) / 144.0];
        // A few ulps of a well-conditioned matrix.
        assert!((0..3).all(|k| (x[k] - expected[k]).abs() < 1e-13), "{x:?}");
        assert!((0..3).all(|k| (inverse[k] - [140.0, 20.0, 36.0][k] / 144.0).abs() < 1e-13), "{inverse:?}");
        // What is left of the last diagonal must be a millionth of a millionth of it.
        let nearly =
            |scale: f64, left: f64| solve_small([[scale, 0.0], [scale, scale * (1.0 + left)]], [1.0, 2.0]).is_some();
        for scale in [1e-9, 1.0, 1e9] {
            assert_eq!((nearly(scale, 1e-10), nearly(scale, 1e-13)), (true, false));
        }
        assert!(solve_small([[f64::NAN]], [1.0]).is_none() && solve_small([[-1.0]], [1.0]).is_none());
    }

    #[test]
    fn a_cholesky_factor_solves_and_drops_what_is_not_determined() {
        // A = L Lᵀ with L = [[2], [1, 3], [-1, 4, 5]]; only the lower half is read.
        let nan = f64::NAN;
        let a = vec![4.0, nan, nan, 2.0, 10.0, nan, -2.0, 11.0, 42.0];
        let mut b = vec![4.0 - 4.0 - 6.0, 2.0 - 20.0 + 33.0, -2.0 - 22.0 + 126.0]; // A (1, −2, 3)
        assert!(Cholesky::dropping(a.clone(), 3).solve(&mut b));
        assert!(b.iter().zip([1.0, -2.0, 3.0]).all(|(a, b)| (a - b).abs() < 1e-13), "rounding: {b:?}");
        let mut b = vec![2.0, 2.0];
        assert!(Cholesky::dropping(vec![1.0, nan, 1.0, 1.0], 2).solve(&mut b));
        assert_eq!(b, [2.0, 0.0], "the second is the first once more");
        // A pivot of 1e-10 is small and known: (1, 1; 1, 1 + 1e-10) (1, 2) to eps / 1e-10.
        let mut b = vec![3.0, 3.0 + 2e-10];
        assert!(Cholesky::dropping(vec![1.0, nan, 1.0, 1.0 + 1e-10], 2).solve(&mut b));
        assert!((b[0] - 1.0).abs() < 1e-5 && (b[1] - 2.0).abs() < 1e-5, "{b:?}");
        // One of 4e-15 is the rounding of what was subtracted.
        let mut b = vec![3.0, 3.0 + 8e-15];
        assert!(Cholesky::dropping(vec![1.0, nan, 1.0, 1.0 + 4e-15], 2).solve(&mut b));
        assert_eq!(b, [3.0, 0.0]);
        assert!(!Cholesky::dropping(a, 3).solve(&mut [1.0, nan, 0.0]));
        assert!(!Cholesky::dropping(vec![4.0], 1).solve(&mut [f64::INFINITY]));
    }
}
