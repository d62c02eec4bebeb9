//! Offset factors of the three channels in terms of fewer maps: the third side of the Tucker decomposition
//! (`DeLathauwer2000`).
//!
//! h_{k,j} = Σ_l c_{k,j,l} b_l: channels scatter alike, so 3 T maps are well described by K < 3 T. Because the f_j are
//! orthonormal, what the truncation changes in R is Σ of the discarded squared singular values of the g_j h_{k,j},
//! exactly.

use super::backend::{Triplets, eigenpairs};
use crate::Result;
use crate::material::SharedBasis;
use faer::Mat;

/// Of what the terms leave, this share may be added by sharing maps when nothing else is asked: .04 dB.
const UNNOTICED: f64 = 0.01;

/// Products of all weighted offset factors, term after term.
pub(super) struct Sharing<'a> {
    all: &'a Triplets,
    planes: usize,
    samples: usize,
    gram: Mat<f64>,
}

impl<'a> Sharing<'a> {
    /// For the first `terms` triplets.
    pub(super) fn new(all: &'a Triplets, planes: usize, terms: usize) -> Self {
        let samples = all.right.len() / all.weights.len().max(1) / planes;
        let maps = Mat::from_fn(samples, planes * terms, |e, m| {
            let (j, k) = (m / planes, m % planes);
            all.weights[j] * all.right[(j * planes + k) * samples + e]
        });
        let gram = maps.transpose() * &maps;
        Self { all, planes, samples, gram }
    }

    /// Squared singular values of the maps of the first `terms` terms, descending, and their left vectors.
    fn spectrum(&self, terms: usize) -> Result<(Vec<f64>, Mat<f64>)> {
        let n = self.planes * terms;
        eigenpairs(self.gram.submatrix(0, 0, n, n), n)
    }

    /// Σ of what is left out, over the number of maps kept: entry K for K maps of `terms` terms.
    pub(super) fn left_out(&self, terms: usize) -> Result<Vec<f64>> {
        let (values, _) = self.spectrum(terms)?;
        let mut left = vec![0.0; values.len() + 1];
        for l in (0..values.len()).rev() {
            left[l] = left[l + 1] + values[l];
        }
        Ok(left)
    }

    /// Fewest maps that add no more than a hundredth to `error`.
    pub(super) fn unnoticed(&self, terms: usize, error: f64) -> Result<usize> {
        let left = self.left_out(terms)?;
        Ok(left.iter().position(|&l| l <= UNNOTICED * error).unwrap_or(self.planes * terms).max(1))
    }

    /// The maps and the cores; `None` where sharing would take more numbers than it saves.
    pub(super) fn basis(&self, terms: usize, maps: usize) -> Result<Option<SharedBasis>> {
        let n = self.planes * terms;
        let maps = maps.min(n);
        if self.planes == 1 || maps * (self.samples + n) >= n * self.samples {
            return Ok(None);
        }
        let (values, left) = self.spectrum(terms)?;
        let mut vectors = vec![0.0_f64; maps * self.samples];
        let mut core = vec![0.0_f32; n * maps];
        for l in 0..maps {
            let s = values[l].sqrt();
            if !(s > 0.0) {
                continue;
            }
            let vector = &mut vectors[l * self.samples..(l + 1) * self.samples];
            for m in 0..n {
                let (j, k) = (m / self.planes, m % self.planes);
                let amount = left[(m, l)] * self.all.weights[j] / s;
                let h = &self.all.right[(j * self.planes + k) * self.samples..][..self.samples];
                vector.iter_mut().zip(h).for_each(|(v, h)| *v += amount * h);
                if self.all.weights[j] > 0.0 {
                    core[(k * terms + j) * maps + l] = (s * left[(m, l)] / self.all.weights[j]) as f32;
                }
            }
        }
        Ok(Some(SharedBasis { maps, vectors: vectors.into_iter().map(|v| v as f32).collect(), core }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SAMPLES: usize = 11;
    /// h_{k,j} = amount times one of three cosines: term after term, plane after plane.
    const MAPS: [(f64, usize); 6] = [(0.6, 0), (0.8, 1), (0.5, 0), (0.3, 2), (0.0, 1), (0.4, 1)];

    fn cosine(l: usize, e: usize) -> f64 {
        let k = (l + 1) as f64;
        (2.0 / SAMPLES as f64).sqrt() * (std::f64::consts::PI * k * (e as f64 + 0.5) / SAMPLES as f64).cos()
    }

    fn triplets() -> Triplets {
        let right = (0..6 * SAMPLES).map(|at| MAPS[at / SAMPLES].0 * cosine(MAPS[at / SAMPLES].1, at % SAMPLES));
        Triplets { weights: vec![3.0, 2.0], left: Vec::new(), right: right.collect() }
    }

    fn near(found: &[f64], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-13), "rounding: {found:?} {expected:?}");
    }

    #[test]
    fn what_fewer_maps_leave_out_is_the_sum_of_their_squares() {
        let all = triplets();
        let sharing = Sharing::new(&all, 3, 2);
        // Weights squared, 9 and 4. First cosine 9 (.36 + .25), second 9 · .64 + 4 · .16, third 4 · .09.
        near(&sharing.left_out(2).unwrap(), &[12.25, 5.85, 0.36, 0.0, 0.0, 0.0, 0.0]);
        near(&sharing.left_out(1).unwrap(), &[11.25, 5.49, 0.0, 0.0]);
        // A hundredth of what the terms leave goes unnoticed.
        assert_eq!(sharing.unnoticed(2, 36.1).unwrap(), 2);
        assert_eq!(sharing.unnoticed(2, 35.9).unwrap(), 3);
        assert_eq!(sharing.unnoticed(2, 1e9).unwrap(), 1, "one at least");
    }

    #[test]
    fn maps_and_cores_make_the_offset_factors_as_far_as_they_are_kept() {
        let all = triplets();
        let sharing = Sharing::new(&all, 3, 2);
        for kept in [2, 3] {
            let shared = sharing.basis(2, kept).unwrap().unwrap();
            assert_eq!((shared.maps, shared.vectors.len(), shared.core.len()), (kept, kept * SAMPLES, 6 * kept));
            let factors = shared.offset_factors();
            for (j, k) in [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)] {
                let (amount, l) = MAPS[3 * j + k];
                // The third cosine is the weakest.
                let amount = if l == 2 && kept == 2 { 0.0 } else { amount };
                for e in 0..SAMPLES {
                    let found = f64::from(factors[(k * 2 + j) * SAMPLES + e]);
                    assert!((found - amount * cosine(l, e)).abs() < 1e-6, "f32, plane {k} term {j}: {found}");
                }
            }
        }
        // Four maps take 4 · (11 + 6) numbers, the factors themselves 66.
        assert!(sharing.basis(2, 4).unwrap().is_none() && sharing.basis(2, 99).unwrap().is_none());
        assert!(Sharing::new(&all, 1, 2).basis(2, 1).unwrap().is_none(), "one plane has nothing to share with");
    }
}
