//! What the terms of a material give for many rows: products of matrices in f32, of a few rows at a time, so that they
//! are used while they are in the processor's cache.

use super::products::multiply_here;
use crate::material::Material;
use faer::{MatMut, MatRef};
use rayon::prelude::*;
use std::ops::Range;

/// Numbers in the product of a few rows: 1 MiB.
const PRODUCT: usize = 1 << 18;

/// A material without a colour polynomial, prepared for the rows of its terms in f32.
pub(super) struct TermRows<'m> {
    material: &'m Material,
    /// m_k h_{k,j} over the largest of them, \[B, T, samples\].
    offset: Vec<f32>,
    /// g_j over the largest of them.
    weights: Vec<f64>,
    /// What the rows are to be multiplied by: the product of both largest.
    pub unit: f64,
}

/// A plane of a row of the terms, and what entry and exit maps multiply it by.
pub(super) struct TermRow<'r> {
    pub plane: usize,
    pub index: usize,
    /// In [`TermRows::unit`], on the common window, \[y\]\[x\]; may be written to.
    pub values: &'r mut [f32],
    /// On the measured window, \[dy\]\[dx\]; ones without maps.
    pub maps: &'r [f32],
}

impl<'m> TermRows<'m> {
    pub(super) fn new(material: &'m Material) -> Self {
        let (h, samples) = (&material.header, material.header.layout().len().max(1));
        let mut wide: Vec<f64> = material.offset_factors.all().iter().map(|&v| f64::from(v)).collect();
        for (plane, maps) in wide.chunks_exact_mut(h.terms.max(1) * samples).enumerate() {
            let Some(profile) = material.profile_plane(plane) else { break };
            let lines = maps.chunks_exact_mut(samples);
            lines.for_each(|line| line.iter_mut().zip(profile).for_each(|(v, &m)| *v *= f64::from(m)));
        }
        let largest = |values: &mut dyn Iterator<Item = f64>| match values.fold(0.0_f64, |a, v| a.max(v.abs())) {
            0.0 => 1.0,
            largest => largest,
        };
        let of_maps = largest(&mut wide.iter().copied());
        let of_weights = largest(&mut material.weights.iter().map(|&g| f64::from(g)));
        Self {
            material,
            offset: wide.iter().map(|v| (v / of_maps) as f32).collect(),
            weights: material.weights.iter().map(|&g| f64::from(g) / of_weights).collect(),
            unit: of_maps * of_weights,
        }
    }

    /// Calls `each` for every plane of every row of `rows`, on all cores; gives what it gives, in an order that depends
    /// on the rows alone.
    pub(super) fn map<R: Send>(&self, rows: Range<usize>, each: impl Fn(TermRow<'_>) -> R + Sync) -> Vec<R> {
        let (h, planes) = (&self.material.header, self.material.header.planes());
        let (samples, window) = (h.layout().len().max(1), h.window[0] * h.window[1]);
        let few = (PRODUCT / samples).clamp(1, 128);
        let starts: Vec<usize> = rows.clone().step_by(few).collect();
        let block = |(values, maps): &mut (Vec<f32>, Vec<f32>), first: usize| {
            let last = (first + few).min(rows.end);
            values.resize((last - first) * samples, 0.0);
            maps.resize(window, 0.0);
            let mut found = Vec::with_capacity(planes * (last - first));
            for plane in 0..planes {
                self.products(plane, first..last, values);
                for (values, index) in values.chunks_exact_mut(samples).zip(first..) {
                    self.material.row_maps(plane, index, maps);
                    found.push(each(TermRow { plane, index, values, maps }));
                }
            }
            found
        };
        let found: Vec<Vec<R>> = starts.into_par_iter().map_init(Default::default, block).collect();
        found.into_iter().flatten().collect()
    }

    /// A plane of the rows `rows`, \[row\]\[y\]\[x\], on this core.
    fn products(&self, plane: usize, rows: Range<usize>, out: &mut [f32]) {
        let h = &self.material.header;
        let (terms, samples, count) = (h.terms, h.layout().len().max(1), rows.len());
        let mut amounts = Vec::with_capacity(count * terms);
        for index in rows {
            let f = self.material.incident(plane, index).iter().zip(&self.weights);
            amounts.extend(f.map(|(&f, g)| (g * f64::from(f)) as f32));
        }
        let maps = &self.offset[plane.min(h.offset_planes - 1) * terms * samples..][..terms * samples];
        multiply_here(
            MatMut::from_row_major_slice_mut(out, count, samples),
            MatRef::from_row_major_slice(&amounts, count, terms),
            MatRef::from_row_major_slice(maps, terms, samples),
        );
    }
}
