//! Offset factors of the three channels in terms of fewer maps: the third side of the Tucker decomposition (`DeLathauwer2000`).
//!
//! h_{k,j} = Σ_l c_{k,j,l} b_l: channels scatter alike, so 3 T maps are well described by K < 3 T. Because the f_j are orthonormal, what
//! the truncation changes in R is Σ of the discarded squared singular values of the g_j h_{k,j}, exactly.

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
    pub fn new(all: &'a Triplets, planes: usize, terms: usize) -> Self {
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
    pub fn left_out(&self, terms: usize) -> Result<Vec<f64>> {
        let (values, _) = self.spectrum(terms)?;
        let mut left = vec![0.0; values.len() + 1];
        for l in (0..values.len()).rev() {
            left[l] = left[l + 1] + values[l];
        }
        Ok(left)
    }

    /// Fewest maps that add no more than a hundredth to `error`.
    pub fn unnoticed(&self, terms: usize, error: f64) -> Result<usize> {
        let left = self.left_out(terms)?;
        Ok(left.iter().position(|&l| l <= UNNOTICED * error).unwrap_or(self.planes * terms).max(1))
    }

    /// The maps and the cores; `None` where sharing would take more numbers than it saves.
    pub fn basis(&self, terms: usize, maps: usize) -> Result<Option<SharedBasis>> {
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
