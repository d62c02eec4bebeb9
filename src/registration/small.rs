//! Small linear systems, without a matrix library's overhead: thousands are solved for every shot.

/// Solves by Cholesky's factors (lower triangle given); also the diagonal of the inverse. `None` unless positive definite.
pub(super) fn solve<const N: usize>(mut a: [[f64; N]; N], b: [f64; N]) -> Option<([f64; N], [f64; N])> {
    for i in 0..N {
        for j in 0..=i {
            let sum: f64 = a[i][j] - (0..j).map(|k| a[i][k] * a[j][k]).sum::<f64>();
            if i == j {
                if !(sum > 1e-12 * a[i][i].abs()) {
                    return None;
                }
                a[i][i] = sum.sqrt();
            } else {
                a[i][j] = sum / a[j][j];
            }
        }
    }
    let through = |b: [f64; N]| {
        let mut x = b;
        for i in 0..N {
            x[i] = (x[i] - (0..i).map(|k| a[i][k] * x[k]).sum::<f64>()) / a[i][i];
        }
        for i in (0..N).rev() {
            x[i] = (x[i] - (i + 1..N).map(|k| a[k][i] * x[k]).sum::<f64>()) / a[i][i];
        }
        x
    };
    let inverse = std::array::from_fn(|i| {
        let mut e = [0.0; N];
        e[i] = 1.0;
        through(e)[i]
    });
    Some((through(b), inverse))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_small_system_is_solved_and_its_inverse_has_the_right_diagonal() {
        // A = [[4, 2], [2, 3]]: x = A⁻¹ (2, 5) = (−0.5, 2), A⁻¹ has 3/8 and 4/8 on its diagonal.
        let (x, inverse) = solve([[4.0, 0.0], [2.0, 3.0]], [2.0, 5.0]).unwrap();
        assert!((x[0] + 0.5).abs() < 1e-14 && (x[1] - 2.0).abs() < 1e-14, "{x:?}");
        assert!((inverse[0] - 0.375).abs() < 1e-14 && (inverse[1] - 0.5).abs() < 1e-14, "{inverse:?}");
        assert!(solve([[1.0, 0.0], [1.0, 1.0]], [1.0, 1.0]).is_none(), "singular");
    }

    #[test]
    fn three_equations_are_solved_and_a_nearly_singular_matrix_is_refused_at_any_scale() {
        // A = [[4, 2, 6], [2, 10, 0], [6, 0, 14]]: determinant 144, adjugate [[140, −28, −60], [−28, 20, 12], [−60, 12, 36]].
        let a = [[4.0, 0.0, 0.0], [2.0, 10.0, 0.0], [6.0, 0.0, 14.0]];
        let (x, inverse) = solve(a, [1.0, -2.0, 5.0]).unwrap();
        let expected = [(140.0 + 56.0 - 300.0) / 144.0, (-28.0 - 40.0 + 60.0) / 144.0, (-60.0 - 24.0 + 180.0) / 144.0];
        // A few ulps of a well-conditioned matrix.
        assert!((0..3).all(|k| (x[k] - expected[k]).abs() < 1e-13), "{x:?}");
        assert!((0..3).all(|k| (inverse[k] - [140.0, 20.0, 36.0][k] / 144.0).abs() < 1e-13), "{inverse:?}");
        // What is left of the last diagonal must be a millionth of a millionth of it.
        let nearly = |scale: f64, left: f64| solve([[scale, 0.0], [scale, scale * (1.0 + left)]], [1.0, 2.0]).is_some();
        for scale in [1e-9, 1.0, 1e9] {
            assert_eq!((nearly(scale, 1e-10), nearly(scale, 1e-13)), (true, false));
        }
        assert!(solve([[f64::NAN]], [1.0]).is_none() && solve([[-1.0]], [1.0]).is_none());
    }
}
