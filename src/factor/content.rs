//! What of a matrix's rows is factored, as it stands in the store.

use crate::transport::RowBlock;
use crate::transport::rows::{RowView, intensity_into};
use rayon::prelude::*;

/// What of the matrix is factored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Content {
    /// Intensity of each row over its largest: one plane.
    Intensity,
    /// Intensity as it was measured: one plane, for matrices without colour.
    Grey,
    /// R, G and B as they were measured: three planes.
    Channels,
}

impl Content {
    /// Planes of a row.
    pub(super) fn planes(self) -> usize {
        if self == Self::Channels { 3 } else { 1 }
    }

    /// Channels that a plane stands for in the sums over a matrix's entries.
    pub(super) fn channels_per_plane(self) -> f64 {
        if self == Self::Grey { 3.0 } else { 1.0 }
    }

    /// What rows of a matrix with this largest response are factored in units of; 1 for normalized ones.
    pub(super) fn unit(self, peak: f64) -> f64 {
        if self == Self::Intensity || !(peak > 0.0) { 1.0 } else { peak }
    }

    /// Planes `[plane][dy][dx]` of a row over `scale`, 0 where not measured; where they were measured, `None` when
    /// everywhere.
    pub(super) fn extract(self, row: RowView<'_>, scale: f64, out: &mut [f32]) -> Option<Box<[bool]>> {
        let samples = row.valid.len() / 3;
        let complete = row.valid.iter().all(|&v| v != 0);
        if self == Self::Channels {
            for (c, plane) in out.chunks_exact_mut(samples.max(1)).enumerate() {
                let values = row.response.iter().skip(c).step_by(3);
                plane.iter_mut().zip(values).for_each(|(o, &v)| *o = (f64::from(v) / scale) as f32);
            }
        } else {
            intensity_into(row, scale, out);
        }
        if complete {
            return None;
        }
        let measured = |plane: usize, k: usize| match self {
            Self::Channels => row.valid[3 * k + plane] != 0,
            _ => row.valid[3 * k..3 * k + 3].iter().all(|&v| v != 0),
        };
        let planes = (0..self.planes()).flat_map(|p| (0..samples).map(move |k| (p, k)));
        let measured: Box<[bool]> = planes.map(|(p, k)| measured(p, k)).collect();
        out.iter_mut().zip(&measured).filter(|(_, m)| !**m).for_each(|(o, _)| *o = 0.0);
        Some(measured)
    }
}

/// Consecutive rows on their measured windows, `[row][plane][dy][dx]`.
#[derive(Debug)]
pub(super) struct RawRows {
    pub first: usize,
    pub rows: usize,
    pub values: Vec<f32>,
    /// Where each row was measured; `None` when everywhere.
    pub measured: Vec<Option<Box<[bool]>>>,
}

impl RawRows {
    /// Takes what is factored out of a block; `scale(k)` divides row `k` of the block.
    pub(super) fn extract(block: &RowBlock, content: Content, scale: impl Fn(usize) -> f64 + Sync) -> Self {
        let len = block.response.len() / block.rows.max(1) / 3 * content.planes();
        let mut values = vec![0.0; block.rows * len];
        let measured = values
            .par_chunks_mut(len.max(1))
            .enumerate()
            .map(|(k, out)| content.extract(block.view(k), scale(k), out))
            .collect();
        Self { first: block.first, rows: block.rows, values, measured }
    }
}
