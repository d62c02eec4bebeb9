//! Many rows of a material at once: a product of matrices, then the colour polynomial with the vector instructions at hand.
//!
//! Sums and polynomials are evaluated in f64, as [`Material::evaluate_row`] does: its results to rounding.

use super::{CHANNELS, Material, legendre};
use crate::transport::normalize::Layout;
use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use rayon::prelude::*;

/// Numbers in the product of a few rows: they stay in the processor's cache.
const PRODUCT: usize = 1 << 17;
/// Samples that go through the polynomial together.
const LANES: usize = 8;

/// A material prepared for [`Self::planes`].
pub(super) struct Rows<'a> {
    material: &'a Material,
    layout: Layout,
    /// m_k h_{k,j} on the common window, \[B, T, samples\].
    offsets: Vec<f64>,
    /// Powers of u from the Legendre basis, \[P+1, P+1\]: row p holds L_p.
    powers: Vec<Vec<f64>>,
}

impl<'a> Rows<'a> {
    /// Prepares `material`: memory of twice its offset factors.
    pub(super) fn new(material: &'a Material) -> Self {
        let (h, layout) = (&material.header, material.header.layout());
        let samples = layout.len().max(1);
        let mut offsets: Vec<f64> = material.offset_factors.iter().map(|&v| f64::from(v)).collect();
        for (at, map) in offsets.chunks_exact_mut(samples).enumerate() {
            if let Some(profile) = material.profile_plane(at / h.terms.max(1)) {
                map.iter_mut().zip(profile).for_each(|(v, &m)| *v *= f64::from(m));
            }
        }
        let unit = |p: usize, n: usize| (0..n).map(|q| f32::from(u8::from(q == p))).collect::<Vec<_>>();
        // On [−1, 1] powers lose (1 + √2)^P of the digits, 6 of f64's 16 at the highest degree, 15: none that an f32 shows.
        let powers = h.degree.map_or(Vec::new(), |degree| {
            (0..=degree).map(|p| legendre::monomials(&unit(p, degree + 1), -1.0, 1.0)).collect()
        });
        Self { material, layout, offsets, powers }
    }

    /// T.
    pub(super) fn terms(&self) -> usize {
        self.material.header.terms
    }

    /// A and B.
    pub(super) fn factor_planes(&self) -> [usize; 2] {
        [self.material.header.incident_planes, self.material.header.offset_planes]
    }

    /// g_j f_{k,j} of a row; 0 for a row that is not there.
    pub(super) fn incident(&self, plane: usize, index: usize, term: usize) -> f64 {
        let f = self.material.incident(plane, index).get(term).copied().unwrap_or(0.0);
        self.material.weights.get(term).map_or(0.0, |&g| f64::from(g) * f64::from(f))
    }

    /// m_k h_{k,j} where rows shifted by `shift` have measured it: `each(x, y, values)` gets pieces of the lines of their window.
    pub(super) fn window_map(
        &self,
        plane: usize,
        term: usize,
        shift: [i16; 2],
        mut each: impl FnMut(usize, usize, &[f64]),
    ) {
        let (h, samples, width) = (&self.material.header, self.layout.len(), self.layout.window[0].max(1));
        let at = (plane.min(h.offset_planes - 1) * h.terms + term) * samples;
        let map = &self.offsets[at..][..samples];
        self.layout.for_each_line(shift, |k, e, n| each(k % width, k / width, &map[e..e + n]));
    }

    /// Samples of a measured window.
    pub(super) fn window_len(&self) -> usize {
        self.layout.window[0] * self.layout.window[1]
    }

    /// R̂_d of the rows `indices`, mm⁻², into `out`, \[rows\]\[channel\]\[dy\]\[dx\]; rows that are not there are zeros.
    pub(super) fn planes(&self, indices: &[usize], out: &mut [f64]) {
        self.each(indices, out, |index, values, _, out| {
            out.fill(0.0);
            self.finish(index, values, out);
        });
    }

    /// The same as \[rows\]\[dy\]\[dx\]\[channel\].
    pub(super) fn interleaved(&self, indices: &[usize], out: &mut [f32]) {
        let len = self.window_len();
        self.each(indices, out, |index, values, planes, out| {
            planes.resize(CHANNELS * len, 0.0);
            planes.fill(0.0);
            self.finish(index, values, planes);
            let (red, rest) = planes.split_at(len);
            let (green, blue) = rest.split_at(len);
            for (rgb, (r, (g, b))) in out.as_chunks_mut::<3>().0.iter_mut().zip(red.iter().zip(green.iter().zip(blue)))
            {
                *rgb = [*r as f32, *g as f32, *b as f32];
            }
        });
    }

    /// Multiplies the factors of a few rows at a time, and calls `finish` with each row, its planes, a buffer and its part of `out`.
    fn each<V: Send>(
        &self,
        indices: &[usize],
        out: &mut [V],
        finish: impl Fn(usize, &[f64], &mut Vec<f64>, &mut [V]) + Sync,
    ) {
        let len = CHANNELS * self.window_len();
        let few = (PRODUCT / (self.material.header.planes() * self.layout.len()).max(1)).clamp(1, 64);
        let parts = out.par_chunks_mut(few * len).zip(indices.par_chunks(few));
        let buffers = || (Vec::new(), Vec::new(), Vec::new());
        parts.for_each_init(buffers, |(factors, product, buffer), (out, indices)| {
            self.product(indices, factors, product);
            let width = product.len() / indices.len();
            for ((out, values), &index) in out.chunks_exact_mut(len).zip(product.chunks_exact(width)).zip(indices) {
                finish(index, values, buffer, out);
            }
        });
    }

    /// The planes of rows on the common window, \[rows\]\[plane\]\[samples\].
    fn product(&self, indices: &[usize], factors: &mut Vec<f64>, product: &mut Vec<f64>) {
        let h = &self.material.header;
        let (planes, samples, terms) = (h.planes(), self.layout.len(), h.terms);
        product.resize(indices.len() * planes * samples, 0.0);
        for plane in 0..planes {
            factors.clear();
            factors.resize(indices.len() * terms, 0.0);
            for (row, &index) in factors.chunks_exact_mut(terms.max(1)).zip(indices) {
                let f = self.material.incident(plane, index).iter().zip(&self.material.weights);
                row.iter_mut().zip(f).for_each(|(v, (&f, &g))| *v = f64::from(g) * f64::from(f));
            }
            let maps = &self.offsets[plane.min(h.offset_planes - 1) * terms * samples..][..terms * samples];
            let mut all = MatMut::from_row_major_slice_mut(product.as_mut_slice(), indices.len(), planes * samples);
            matmul(
                all.as_mut().subcols_mut(plane * samples, samples),
                Accum::Replace,
                MatRef::from_row_major_slice(factors, indices.len(), terms),
                MatRef::from_row_major_slice(maps, terms, samples),
                1.0,
                Par::Seq,
            );
        }
    }

    /// The part of the common window that a row measured, in colour.
    fn finish(&self, index: usize, values: &[f64], row: &mut [f64]) {
        let (h, window) = (&self.material.header, self.window_len());
        let Some(&shift) = self.material.shift.get(index).filter(|_| index < h.rows()) else { return };
        let Some(degree) = h.degree else {
            for (c, channel) in row.chunks_exact_mut(window).enumerate() {
                let plane = &values[c.min(h.planes() - 1) * self.layout.len()..][..self.layout.len()];
                self.layout.for_each_line(shift, |k, e, n| channel[k..k + n].copy_from_slice(&plane[e..e + n]));
            }
            return;
        };
        let betas = self.material.coefficients(index, degree);
        let mut coefficients = vec![[0.0; CHANNELS]; degree + 1];
        for (c, beta) in betas.into_iter().enumerate() {
            for (&b, powers) in beta.iter().zip(&self.powers) {
                coefficients.iter_mut().zip(powers).for_each(|(sum, &m)| sum[c] += f64::from(b) * m);
            }
        }
        let [low, high] = h.intensity_range.map(f64::from);
        let (first, rest) = row.split_at_mut(window);
        let (second, third) = rest.split_at_mut(window);
        self.layout.for_each_line(shift, |k, e, n| {
            let out = [&mut first[k..k + n], &mut second[k..k + n], &mut third[k..k + n]];
            pulp::Arch::new().dispatch(Color {
                values: &values[e..e + n],
                low,
                high,
                coefficients: &coefficients,
                out,
            });
        });
    }
}

/// The three polynomials of a row on a line of its intensities.
struct Color<'a> {
    values: &'a [f64],
    low: f64,
    high: f64,
    /// Of powers of u, lowest first.
    coefficients: &'a [[f64; CHANNELS]],
    out: [&'a mut [f64]; CHANNELS],
}

impl pulp::NullaryFnOnce for Color<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [red, green, blue] = self.out;
        let width = self.high - self.low;
        // As in `legendre::argument`.
        let (scale, middle) = if width > 0.0 { (1.0 / width, self.low + self.high) } else { (0.0, 0.0) };
        let mut at = 0;
        while at < self.values.len() {
            // The last lanes overlap those before them: the same numbers are written twice.
            let n = LANES.min(self.values.len());
            at = at.min(self.values.len() - n);
            let mut u = [0.0; LANES];
            for (u, &v) in u.iter_mut().zip(&self.values[at..at + n]) {
                *u = (scale * (2.0 * v - middle)).clamp(-1.0, 1.0);
            }
            let mut sums = [[0.0; LANES]; CHANNELS];
            for b in self.coefficients.iter().rev() {
                for c in 0..CHANNELS {
                    for lane in 0..LANES {
                        sums[c][lane] = sums[c][lane] * u[lane] + b[c];
                    }
                }
            }
            red[at..at + n].copy_from_slice(&sums[0][..n]);
            green[at..at + n].copy_from_slice(&sums[1][..n]);
            blue[at..at + n].copy_from_slice(&sums[2][..n]);
            at += n;
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::{Model, file::tests::example, naive};
    use super::*;

    /// Materials of every kind, with shifts, a common window that is smaller than some shifts need, and negative factors.
    pub(in super::super) fn every_kind() -> Vec<Material> {
        let wave = |n: usize, f: f32| (0..n).map(|k| (f * (k as f32 + 1.0)).sin()).collect::<Vec<f32>>();
        let mut all = Vec::new();
        for (model, [a, b], profile, degree) in [
            (Model::Tucker, [1, 1], false, Some(2)),
            (Model::Tucker, [1, 1], false, Some(15)),
            (Model::Tucker, [1, 1], false, Some(0)),
            (Model::Peers2006, [1, 1], true, Some(3)),
            (Model::Peers2006, [3, 3], true, None),
            (Model::Peers2006, [3, 1], false, None),
            (Model::Joint, [1, 3], false, None),
            (Model::Joint, [1, 1], true, None),
        ] {
            for (window, extended, terms) in [([5, 3], [7, 3], 2), ([5, 3], [5, 3], 5), ([1, 1], [3, 1], 1)] {
                let mut m = example();
                let h = &mut m.header;
                (h.model, h.incident_planes, h.offset_planes, h.profile, h.degree) = (model, a, b, profile, degree);
                (h.window, h.extended, h.terms) = (window, extended, terms);
                let samples = extended[0] * extended[1];
                m.weights = wave(terms, 0.9);
                m.incident_factors = wave(a * 6 * terms, 0.7);
                m.offset_factors = wave(b * terms * samples, 0.3);
                m.profile = if profile { wave(b * samples, 0.11) } else { Vec::new() };
                m.color_coefficients = degree.map_or(Vec::new(), |p| wave(18 * (p + 1), 1.1));
                assert!(m.header.shapes().iter().all(|(_, s)| !s.is_empty()));
                all.push(m);
            }
        }
        all
    }

    #[test]
    fn blocks_are_the_rows_one_by_one() {
        for m in every_kind() {
            let rows = Rows::new(&m);
            let len = rows.window_len();
            let indices = [4, 0, 5, 1, 1, 2, 3, 99];
            let mut out = vec![7.0; indices.len() * 3 * len];
            rows.planes(&indices, &mut out);
            for (&i, block) in indices.iter().zip(out.chunks_exact(3 * len)) {
                let expected = if i < 6 { m.evaluate_row(i) } else { vec![0.0; 3 * len] };
                for (k, &e) in expected.iter().enumerate() {
                    let found = block[k % 3 * len + k / 3];
                    // Coefficients of size 1: rounding to f32, 6e-8 of up to 16 terms.
                    assert!((found - f64::from(e)).abs() < 1e-6, "{:?} row {i}: {found} {e}", m.header);
                }
            }
        }
    }

    #[test]
    fn numbers_at_the_ends_of_what_a_file_may_hold_stay_numbers() {
        for mut m in every_kind() {
            let ends = [1e-30, 1e30, -1e-30, -1e30];
            let each = [&mut m.weights, &mut m.incident_factors, &mut m.offset_factors, &mut m.profile];
            for (k, v) in each.into_iter().flatten().enumerate() {
                *v = ends[k % 4];
            }
            m.color_coefficients.iter_mut().enumerate().for_each(|(k, v)| *v = ends[k % 4]);
            let rows = Rows::new(&m);
            let mut out = vec![0.0; 6 * 3 * rows.window_len()];
            rows.planes(&[0, 1, 2, 3, 4, 5], &mut out);
            assert!(out.iter().all(|v| v.is_finite()));
        }
    }

    #[test]
    fn many_rows_at_once_are_the_naive_formula() {
        for m in naive::materials() {
            let rows = Rows::new(&m);
            let indices: Vec<usize> = (0..naive::ROWS).rev().collect();
            let (mut planes, mut interleaved) = (vec![7.0; 15 * 105], vec![7.0; 15 * 105]);
            rows.planes(&indices, &mut planes);
            rows.interleaved(&indices, &mut interleaved);
            for (n, &i) in indices.iter().enumerate() {
                for (k, d) in naive::offsets().enumerate() {
                    let expected = naive::response(&m, i, d).unwrap();
                    for c in 0..3 {
                        let (a, b) = (planes[n * 105 + c * 35 + k], interleaved[n * 105 + 3 * k + c]);
                        assert!((a - expected[c]).abs() < 1e-13, "f64, row {i} {d:?}: {a} {}", expected[c]);
                        assert!((f64::from(b) - expected[c]).abs() < 1e-6, "f32, row {i} {d:?}: {b} {}", expected[c]);
                    }
                }
            }
        }
    }
}
