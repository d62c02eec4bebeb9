//! What of a matrix's rows is factored, as it stands in the store.

use crate::transport::RowBlock;
use crate::transport::rows::{RowView, intensity_into, is_complete};
use pulp::{Arch, NullaryFnOnce};
use rayon::prelude::*;

/// What of the matrix is factored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
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
        let complete = is_complete(row.valid);
        if self == Self::Channels {
            let (r, rest) = out.split_at_mut(samples);
            let (g, b) = rest.split_at_mut(samples);
            Arch::new().dispatch(Planes { response: row.response, over: 1.0 / scale, planes: [r, g, b] });
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

/// Channels side by side to planes one after the other.
struct Planes<'a> {
    response: &'a [f32],
    over: f64,
    planes: [&'a mut [f32]; 3],
}

impl NullaryFnOnce for Planes<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { response, over, planes: [r, g, b] } = self;
        let planes = r.iter_mut().zip(g.iter_mut()).zip(b.iter_mut());
        for (((r, g), b), rgb) in planes.zip(response.as_chunks::<3>().0) {
            [*r, *g, *b] = rgb.map(|v| (f64::from(v) * over) as f32);
        }
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
