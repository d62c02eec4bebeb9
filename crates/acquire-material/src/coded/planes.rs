//! Bases in which the maps of a material are least alike and equally important: a rotation of the three channels, and
//! an orthonormal basis for the colour polynomials.

use super::entropy::Bits;
use super::exact::{raw, raw_f32};
use super::maps::Price;
use crate::{CHANNELS, Material, Responses, legendre};

/// Angles are whole parts of a turn.
const ANGLE_BITS: u32 = 12;

/// A rotation of the channels, by Euler angles in 1/4096 of a turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Rotation {
    angles: [u32; 3],
    /// Rows are the new channels.
    rows: [[f64; CHANNELS]; CHANNELS],
}

impl Rotation {
    fn new(angles: [u32; 3]) -> Self {
        let turn = angles.map(|a| f64::from(a) * std::f64::consts::TAU / f64::from(1_u32 << ANGLE_BITS));
        // libm: the same digits on every machine
        let ([ca, cb, cc], [sa, sb, sc]) = (turn.map(libm::cos), turn.map(libm::sin));
        let rows = [
            [ca * cb, sa * cb, -sb],
            [ca * sb * sc - sa * cc, sa * sb * sc + ca * cc, cb * sc],
            [ca * sb * cc + sa * sc, sa * sb * cc - ca * sc, cb * cc],
        ];
        Self { angles, rows }
    }

    /// The rotation that leaves the channels with moments `moments` (sums of products) least correlated; none for fewer
    /// than three channels.
    pub(super) fn decorrelating(moments: [[f64; CHANNELS]; CHANNELS]) -> Self {
        let rows = eigenvectors(moments);
        let whole = f64::from(1_u32 << ANGLE_BITS) / std::f64::consts::TAU;
        let part = |angle: f64| ((angle * whole).round() as i64).rem_euclid(1 << ANGLE_BITS) as u32;
        let (a, b) = (libm::atan2(rows[0][1], rows[0][0]), libm::asin(-rows[0][2].clamp(-1.0, 1.0)));
        let c = libm::atan2(rows[1][2], rows[2][2]);
        Self::new([part(a), part(b), part(c)])
    }

    /// No rotation.
    pub(super) fn none() -> Self {
        Self::new([0; 3])
    }

    /// Codes the angles.
    ///
    /// # Errors
    /// Those of `bits`.
    pub(super) fn code<B: Bits>(self, bits: &mut B) -> Result<Self, String> {
        let mut angles = self.angles;
        for angle in &mut angles {
            *angle = raw(bits, u64::from(*angle), ANGLE_BITS)? as u32;
        }
        Ok(Self::new(angles))
    }

    /// Turns three planes of equal length into the new channels.
    pub(super) fn forward(&self, planes: &mut [Vec<f64>]) {
        self.apply(planes, |rows, to, from| rows[to][from]);
    }

    /// Undoes [`Self::forward`].
    pub(super) fn inverse(&self, planes: &mut [Vec<f64>]) {
        self.apply(planes, |rows, to, from| rows[from][to]);
    }

    fn apply(&self, planes: &mut [Vec<f64>], entry: impl Fn(&[[f64; 3]; 3], usize, usize) -> f64) {
        let [r, g, b] = planes else { return };
        for ((r, g), b) in r.iter_mut().zip(g.iter_mut()).zip(b.iter_mut()) {
            let old = [*r, *g, *b];
            [*r, *g, *b] =
                std::array::from_fn(|to| (0..CHANNELS).map(|from| entry(&self.rows, to, from) * old[from]).sum());
        }
    }
}

/// Sums of products of three planes over several sets of them.
pub(super) fn moments(sets: &[Vec<Vec<f64>>]) -> [[f64; CHANNELS]; CHANNELS] {
    let mut sums = [[0.0; CHANNELS]; CHANNELS];
    for planes in sets.iter().filter(|planes| planes.len() == CHANNELS) {
        for (a, row) in sums.iter_mut().enumerate() {
            for (b, sum) in row.iter_mut().enumerate() {
                *sum += planes[a].iter().zip(&planes[b]).map(|(x, y)| x * y).sum::<f64>();
            }
        }
    }
    sums
}

/// Eigenvectors of a symmetric matrix as rows of a rotation, largest eigenvalue first, by Jacobi's rotations.
fn eigenvectors(mut m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let mut v = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    for _ in 0..30 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if m[p][q] == 0.0 || !m[p][q].is_finite() {
                continue;
            }
            let theta = libm::atan2(2.0 * m[p][q], m[p][p] - m[q][q]) / 2.0;
            let (c, s) = (libm::cos(theta), libm::sin(theta));
            for row in &mut m {
                (row[p], row[q]) = (c * row[p] + s * row[q], c * row[q] - s * row[p]);
            }
            for k in 0..3 {
                (m[p][k], m[q][k]) = (c * m[p][k] + s * m[q][k], c * m[q][k] - s * m[p][k]);
                (v[p][k], v[q][k]) = (c * v[p][k] + s * v[q][k], c * v[q][k] - s * v[p][k]);
            }
        }
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| m[b][b].total_cmp(&m[a][a]));
    let mut rows = order.map(|k| v[k]);
    // The third is the cross product of the others: a rotation, not a reflection.
    let [a, b, _] = rows;
    rows[2] = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    rows
}

/// The triangular L of G = L Lᵀ, G the mean over rows of Σ_samples L_p L_q: in γ = Lᵀβ an error of one in any
/// coefficient of a row moves the row by one. Row by row, lower triangle.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct ColorBasis {
    degree: usize,
    lower: Vec<f32>,
}

/// Where the fit of a row's polynomials begins, and in how many rounds it comes to rest: from a strong ridge (a row's
/// Gram matrix is about one in this basis), since the cost of a coefficient has a minimum near zero that a weak one
/// does not find.
const FIRST_RIDGE: f64 = 0.3;
const RIDGE_ROUNDS: usize = 12;
/// Smallest entry of the diagonal, against the largest: a constant intensity leaves the polynomials undetermined.
const LEAST: f64 = 1e-6;

impl ColorBasis {
    /// From the samples of every `stride`th row of a material with a colour polynomial.
    pub(super) fn of(material: &Material, degree: usize, stride: usize) -> Self {
        let n = degree + 1;
        let h = &material.header;
        let [low, high] = h.intensity_range.map(f64::from);
        let (mut gram, mut rows, mut basis) = (vec![0.0; n * n], 0.0, vec![0.0; n]);
        let responses = Responses::new(material);
        for index in (0..h.rows()).step_by(stride.max(1)) {
            rows += 1.0;
            for v in responses.plane(0, &[index]) {
                legendre::evaluate(legendre::argument(v, low, high), &mut basis);
                for p in 0..n {
                    (0..=p).for_each(|q| gram[p * n + q] += basis[p] * basis[q]);
                }
            }
        }
        gram.iter_mut().for_each(|g| *g /= rows);
        let mut lower = vec![0.0_f64; n * n];
        for p in 0..n {
            for q in 0..=p {
                let known: f64 = (0..q).map(|k| lower[p * n + k] * lower[q * n + k]).sum();
                let rest = gram[p * n + q] - known;
                lower[p * n + q] =
                    if p == q { rest.max(0.0).sqrt().max(LEAST * gram[0].sqrt()) } else { rest / lower[q * n + q] };
            }
        }
        let lower = (0..n).flat_map(|p| (0..=p).map(move |q| (p, q))).map(|(p, q)| lower[p * n + q] as f32).collect();
        Self { degree, lower }
    }

    /// Codes the triangle; a decoder gives `None`.
    ///
    /// # Errors
    /// Those of `bits`; a diagonal that is not positive.
    pub(super) fn code<B: Bits>(bits: &mut B, basis: Option<&Self>, degree: usize) -> Result<Self, String> {
        let mut lower = Vec::new();
        for p in 0..=degree {
            for q in 0..=p {
                let asked = basis.and_then(|b| b.lower.get(lower.len()).copied()).unwrap_or(0.0);
                let found = raw_f32(bits, asked).map_err(|e| format!("colour basis: {e}"))?;
                if p == q && found <= 0.0 {
                    return Err(format!("colour basis: expected a positive diagonal, found {found}"));
                }
                lower.push(found);
            }
        }
        Ok(Self { degree, lower })
    }

    /// γ of each channel of a row, fitted to the row of `original` as polynomials of the intensity of `decoded`; of
    /// fits that are about equally good against the step, one that costs few bits.
    ///
    /// A row of nearly constant intensity leaves most coefficients undetermined. What a coefficient costs is about
    /// log₂(|γ|/step); the slope of that gives the weights of a ridge, improved round by round.
    pub(super) fn fit(
        &self,
        original: &Responses<'_>,
        decoded: &Responses<'_>,
        degree: usize,
        index: usize,
        price: Price,
    ) -> [Vec<f64>; CHANNELS] {
        let (n, material) = (degree + 1, original.material());
        let [low, high] = material.header.intensity_range.map(f64::from);
        let (mut gram, mut basis) = (vec![0.0; n * n], vec![0.0; n]);
        let mut right = [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
        let beta = material.coefficients(index, degree);
        for (v, seen) in original.plane(0, &[index]).into_iter().zip(decoded.plane(0, &[index])) {
            legendre::evaluate(legendre::argument(v, low, high), &mut basis);
            let values = beta.map(|beta| beta.iter().zip(&basis).map(|(&b, l)| f64::from(b) * l).sum::<f64>());
            legendre::evaluate(legendre::argument(seen, low, high), &mut basis);
            // In the basis of γ: L⁻¹ applied from the left
            for p in 0..n {
                let known: f64 = (0..p).map(|q| self.entry(p, q) * basis[q]).sum();
                basis[p] = (basis[p] - known) / self.entry(p, p);
            }
            for p in 0..n {
                (0..=p).for_each(|q| gram[p * n + q] += basis[p] * basis[q]);
                (0..CHANNELS).for_each(|c| right[c][p] += basis[p] * values[c]);
            }
        }
        right.map(|right| {
            let mut gamma = vec![0.0; n];
            for round in 0..RIDGE_ROUNDS {
                let least = price.lambda * price.step.powi(2);
                let ridge = |g: f64| if round == 0 { FIRST_RIDGE } else { least / (g * g + price.step.powi(2) / 4.0) };
                let mut system = gram.clone();
                (0..n).for_each(|p| system[p * n + p] += ridge(gamma[p]));
                gamma = solve(&system, &right, n);
            }
            gamma
        })
    }

    fn entry(&self, p: usize, q: usize) -> f64 {
        f64::from(self.lower[p * (p + 1) / 2 + q])
    }

    /// β to γ, in place, P+1 numbers; the encoder fits γ itself.
    #[cfg(test)]
    fn forward(&self, beta: &mut [f64]) {
        for q in 0..=self.degree {
            beta[q] = (q..=self.degree).map(|p| self.entry(p, q) * beta[p]).sum();
        }
    }

    /// γ to β, in place.
    pub(super) fn inverse(&self, gamma: &mut [f64]) {
        for q in (0..=self.degree).rev() {
            let known: f64 = (q + 1..=self.degree).map(|p| self.entry(p, q) * gamma[p]).sum();
            gamma[q] = (gamma[q] - known) / self.entry(q, q);
        }
    }
}

/// x of A x = b, A symmetric and positive definite, given by its lower triangle, row-major; by Cholesky.
fn solve(a: &[f64], b: &[f64], n: usize) -> Vec<f64> {
    let (mut lower, mut x) = (a.to_vec(), b.to_vec());
    for p in 0..n {
        for q in 0..=p {
            let known: f64 = (0..q).map(|k| lower[p * n + k] * lower[q * n + k]).sum();
            let rest = lower[p * n + q] - known;
            lower[p * n + q] = if p == q { rest.max(f64::MIN_POSITIVE).sqrt() } else { rest / lower[q * n + q] };
        }
        let known: f64 = (0..p).map(|k| lower[p * n + k] * x[k]).sum();
        x[p] = (x[p] - known) / lower[p * n + p];
    }
    for p in (0..n).rev() {
        let known: f64 = (p + 1..n).map(|k| lower[k * n + p] * x[k]).sum();
        x[p] = (x[p] - known) / lower[p * n + p];
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_is_undone_and_leaves_almost_no_correlation() {
        let wave = |f: f64| (0..200).map(|k| (f * f64::from(k)).sin()).collect::<Vec<f64>>();
        let (a, b, c) = (wave(0.3), wave(0.71), wave(1.7));
        let mix = |x: f64, y: f64, z: f64| (0..200).map(|k| x * a[k] + y * b[k] + z * c[k]).collect::<Vec<f64>>();
        let mut planes = vec![mix(3.0, 0.2, 0.05), mix(2.5, -0.3, 0.1), mix(2.0, 0.1, -0.2)];
        let before = planes.clone();
        let rotation = Rotation::decorrelating(moments(std::slice::from_ref(&planes)));
        rotation.forward(&mut planes);
        let m = moments(std::slice::from_ref(&planes));
        assert!(m[0][0] > m[1][1] && m[1][1] > m[2][2]);
        // angles are rounded by up to half of 2π/4096, in each of which the largest moment leaks
        assert!(m[0][1].abs() < 3e-3 * m[0][0] && m[1][2].abs() < 3e-3 * m[0][0], "{m:?}");
        rotation.inverse(&mut planes);
        let error = planes.concat().iter().zip(before.concat()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 1e-12, "rounding: {error}");
    }

    #[test]
    fn a_colour_basis_is_undone_and_makes_errors_equal() {
        let material = crate::file::tests::example();
        let basis = ColorBasis::of(&material, 2, 1);
        let beta = [0.3, -1.2, 0.7];
        let mut gamma = beta;
        basis.forward(&mut gamma);
        // |γ|² is the mean over rows of the sum of squares of the polynomial
        let [low, high] = material.header.intensity_range.map(f64::from);
        let mut l = [0.0; 3];
        let mut sum = 0.0;
        for i in 0..6 {
            for v in Responses::new(&material).plane(0, &[i]) {
                legendre::evaluate(legendre::argument(v, low, high), &mut l);
                sum += (0..3).map(|p| l[p] * beta[p]).sum::<f64>().powi(2) / 6.0;
            }
        }
        let square: f64 = gamma.iter().map(|g| g * g).sum();
        assert!((square / sum - 1.0).abs() < 1e-5, "the triangle is kept in f32: {square} {sum}");
        basis.inverse(&mut gamma);
        assert!(gamma.iter().zip(beta).all(|(a, b)| (a - b).abs() < 1e-12), "rounding: {gamma:?}");
    }

    #[test]
    fn eigenvectors_are_a_rotation_whose_rows_the_matrix_only_stretches_the_longest_first() {
        for m in [
            [[4.0, -1.0, 0.5], [-1.0, 3.0, 2.0], [0.5, 2.0, 1.0]],
            [[1.0, 0.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 3.0]],
            [[2.0, 0.0, 1.5], [0.0, 7.0, 0.0], [1.5, 0.0, 2.0]],
            [[3.0, 2.9, 2.8], [2.9, 3.1, 3.0], [2.8, 3.0, 3.3]],
        ] {
            let rows = eigenvectors(m);
            let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            let values = rows.map(|v| dot(v, m.map(|line| dot(line, v))));
            for (k, v) in rows.iter().enumerate() {
                for a in 0..3 {
                    // Thirty sweeps of Jacobi's rotations end at rounding.
                    assert!((dot(m[a], *v) - values[k] * v[a]).abs() < 1e-12, "{m:?}: {rows:?}");
                }
                for (l, w) in rows.iter().enumerate() {
                    assert!((dot(*v, *w) - f64::from(u8::from(k == l))).abs() < 1e-12, "{rows:?}");
                }
            }
            assert!(values[0] >= values[1] && values[1] >= values[2], "{values:?}");
            let [a, b, c] = rows;
            let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            assert!((dot(cross, c) - 1.0).abs() < 1e-12, "no reflection: {rows:?}");
        }
    }
}
