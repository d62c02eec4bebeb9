use super::*;
use crate::OffsetFactors;
use crate::{Model, file::tests::example, naive};

impl Material {
    /// One entry of a row; `None` outside its window or where there is no such row.
    pub fn response(&self, index: usize, [x, y]: [isize; 2]) -> Option<[f32; 3]> {
        let [width, height] = self.header.window.map(|w| w as isize);
        let (x, y) = (x.checked_add(width / 2)?, y.checked_add(height / 2)?);
        let inside = (0..width).contains(&x) && (0..height).contains(&y) && index < self.header.rows();
        inside.then(|| self.evaluate_row(index).as_chunks::<3>().0[(x + y * width) as usize])
    }
}

impl OffsetFactors {
    /// Themselves, to be changed.
    pub fn own(&mut self) -> &mut Vec<f32> {
        *self = Self::Own(self.all().into_owned());
        match self {
            Self::Own(own) => own,
            Self::Shared(_) => unreachable!(),
        }
    }
}

/// Materials of every kind, with shifts, a common window that is smaller than some shifts need, and negative factors.
pub(crate) fn every_kind() -> Vec<Material> {
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
            m.offset_factors = wave(b * terms * samples, 0.3).into();
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
        let rows = Responses::new(&m);
        let len = rows.window_len();
        let indices = [4, 0, 5, 1, 1, 2, 3, 99];
        let mut out = vec![7.0; indices.len() * 3 * len];
        rows.by_channel(&indices, &mut out);
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
        let each = [&mut m.weights, &mut m.incident_factors, m.offset_factors.own(), &mut m.profile];
        for (k, v) in each.into_iter().flatten().enumerate() {
            *v = ends[k % 4];
        }
        m.color_coefficients.iter_mut().enumerate().for_each(|(k, v)| *v = ends[k % 4]);
        let rows = Responses::new(&m);
        let mut out = vec![0.0; 6 * 3 * rows.window_len()];
        rows.by_channel(&[0, 1, 2, 3, 4, 5], &mut out);
        assert!(out.iter().all(|v| v.is_finite()));
    }
}

#[test]
fn many_rows_at_once_are_the_naive_formula() {
    for m in naive::materials() {
        let rows = Responses::new(&m);
        let indices: Vec<usize> = (0..naive::ROWS).rev().collect();
        let (mut planes, mut interleaved) = (vec![7.0; 15 * 105], vec![7.0; 15 * 105]);
        rows.by_channel(&indices, &mut planes);
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
