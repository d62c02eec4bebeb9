//! Error modelling to the letter (`Bilgili2011`): the best rank-1 term of the rows, then of what is left, T times.

use super::randomized::gram_times;
use super::{LowRank, Rows};
use crate::Result;
use faer::Mat;
use rand::{Rng, SeedableRng};

/// Passes after which a term is taken as it is: the next one is nearly as large, and either is as good.
const MOST_PASSES: usize = 60;

pub(super) fn one_by_one(rows: &dyn Rows, k: usize, accuracy: f64) -> Result<LowRank> {
    let m = rows.shape().1;
    let mut random = rand_pcg::Pcg64::seed_from_u64(0);
    let mut low = LowRank { singular_values: Vec::new(), vectors: Vec::new(), passes: 0, residual: 0.0 };
    for _ in 0..k {
        let mut v = Mat::from_fn(m, 1, |_, _| f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5);
        let mut theta = 0.0;
        let largest = low.singular_values.first().copied();
        for pass in 0..=MOST_PASSES {
            let length = orthogonalize(&mut v, &low.vectors, m);
            let scale = largest.map_or(length, |s| s * s);
            if !(length > 1e-7 * scale) {
                // Nothing is left but rounding.
                theta = 0.0;
                unit(&mut v, &low.vectors, m, &mut random);
                break;
            }
            if pass == MOST_PASSES {
                break;
            }
            let image = gram_times(rows, v.as_ref())?;
            low.passes += 1;
            theta = (0..m).map(|i| v[(i, 0)] * image[(i, 0)]).sum::<f64>().max(0.0);
            let mut rest = image.clone();
            orthogonal_to(&mut rest, &low.vectors, m);
            let off = (0..m).map(|i| (rest[(i, 0)] - theta * v[(i, 0)]).powi(2)).sum::<f64>().sqrt();
            let scale = largest.map_or(theta, |s| s * s);
            v = rest;
            let bound = if theta > 0.0 { off / (2.0 * theta.sqrt() * scale.sqrt()) } else { 0.0 };
            if bound <= accuracy || off <= 1e-7 * scale {
                low.residual = low.residual.max(bound);
                if !(orthogonalize(&mut v, &low.vectors, m) > 1e-7 * scale) {
                    // What was left is rounding, and points anywhere.
                    theta = 0.0;
                    unit(&mut v, &low.vectors, m, &mut random);
                }
                break;
            }
        }
        low.singular_values.push(theta.sqrt());
        low.vectors.extend((0..m).map(|i| v[(i, 0)]));
    }
    // Equal values may come in any order.
    let mut order: Vec<usize> = (0..k).collect();
    order.sort_by(|&a, &b| low.singular_values[b].total_cmp(&low.singular_values[a]));
    let vectors = order.iter().flat_map(|&j| low.vectors[j * m..(j + 1) * m].iter().copied()).collect();
    let singular_values = order.iter().map(|&j| low.singular_values[j]).collect();
    Ok(LowRank { singular_values, vectors, ..low })
}

/// Takes out of v what lies along the earlier vectors.
fn orthogonal_to(v: &mut Mat<f64>, earlier: &[f64], m: usize) {
    for h in earlier.chunks_exact(m) {
        let along: f64 = h.iter().enumerate().map(|(i, h)| h * v[(i, 0)]).sum();
        h.iter().enumerate().for_each(|(i, h)| v[(i, 0)] -= along * h);
    }
}

/// The same, and scales v to unit length; the length that it had. A zero stays.
///
/// Twice: of a vector that nearly vanishes the first time, what is left is mostly rounding along the earlier ones
/// (`Giraud2005`).
fn orthogonalize(v: &mut Mat<f64>, earlier: &[f64], m: usize) -> f64 {
    let mut lengths = [0.0; 2];
    for length in &mut lengths {
        orthogonal_to(v, earlier, m);
        *length = v.col(0).norm_l2();
        if *length > 0.0 {
            (0..m).for_each(|i| v[(i, 0)] /= *length);
        }
    }
    lengths[0] * lengths[1]
}

/// A random unit vector orthogonal to the earlier ones.
fn unit(v: &mut Mat<f64>, earlier: &[f64], m: usize, random: &mut impl Rng) {
    (0..m).for_each(|i| v[(i, 0)] = f64::from(random.next_u32()) / f64::from(u32::MAX) - 0.5);
    for _ in 0..2 {
        orthogonalize(v, earlier, m);
    }
}
