//! Rows one at a time: views into a block, blocks in order, intensity and gradient.

use super::{MatrixReader, RowBlock};
use crate::Result;
use pulp::{Arch, NullaryFnOnce};
use std::ops::Range;

/// About how many bytes a block of rows may take in memory, decoded: enough for the cores to share and for products to
/// be quick, little enough that the allocator keeps its parts for the next block.
const BLOCK_BYTES: usize = 48 << 20;

/// One row of a [`RowBlock`]: three slices `[dy][dx][channel]`.
#[derive(Debug, Clone, Copy)]
pub struct RowView<'a> {
    /// R_d, mm⁻²; 0 where not measured.
    pub response: &'a [f32],
    /// Its variance, mm⁻⁴; empty when it was not read.
    pub variance: &'a [f32],
    /// 1 where measured.
    pub valid: &'a [u8],
}

impl RowBlock {
    /// Row `first + k` of the matrix; empty slices when `k` is not below `rows`.
    pub fn view(&self, k: usize) -> RowView<'_> {
        let len = self.response.len().checked_div(self.rows).unwrap_or(0);
        let range = if k < self.rows { k * len..(k + 1) * len } else { 0..0 };
        RowView {
            response: &self.response[range.clone()],
            variance: self.variance.get(range.clone()).unwrap_or_default(),
            valid: &self.valid[range],
        }
    }
}

impl MatrixReader {
    /// Calls `each` with the blocks of [`Self::blocks`], one after the other in the same memory.
    ///
    /// # Errors
    /// What [`MatrixReader::read`] or `each` return.
    pub fn for_each_block(&self, each: impl FnMut(&RowBlock) -> Result<()>) -> Result<()> {
        self.for_each_block_of(0..self.header().rows(), true, each)
    }

    /// [`Self::for_each_block`] without the variance.
    ///
    /// # Errors
    /// What [`MatrixReader::read_responses`] or `each` return.
    pub fn for_each_block_of_responses(&self, each: impl FnMut(&RowBlock) -> Result<()>) -> Result<()> {
        self.for_each_block_of(0..self.header().rows(), false, each)
    }

    /// [`Self::for_each_block`] for some rows, with the variance or without.
    ///
    /// # Errors
    /// What [`MatrixReader::read`] or `each` return.
    pub(crate) fn for_each_block_of(
        &self,
        rows: Range<usize>,
        variance: bool,
        mut each: impl FnMut(&RowBlock) -> Result<()>,
    ) -> Result<()> {
        let mut block = RowBlock::zeros(0..0, 0);
        self.blocks_of(self.parts(rows)).into_iter().try_for_each(|rows| {
            self.read_into(rows, variance, &mut block)?;
            each(&block)
        })
    }

    /// Consecutive ranges of rows that together are all rows, in order, each of about 48 MiB and of whole chunks: no
    /// chunk is decoded twice.
    pub fn blocks(&self) -> Vec<Range<usize>> {
        self.blocks_of(self.chunks())
    }

    /// All rows, in order, as at most so many ranges of nearly equal numbers of chunks.
    pub(crate) fn shares(&self, count: usize) -> Vec<Range<usize>> {
        let chunks = self.chunks();
        let count = count.clamp(1, chunks.len().max(1));
        let share = |k: usize| chunks.get(k * chunks.len() / count..(k + 1) * chunks.len() / count);
        (0..count).filter_map(|k| share(k).and_then(|s| Some(s.first()?.start..s.last()?.end))).collect()
    }

    fn blocks_of(&self, chunks: Vec<Range<usize>>) -> Vec<Range<usize>> {
        // response and variance as f32, validity as u8
        let most = BLOCK_BYTES / (9 * self.header().row_len().max(1));
        let mut blocks: Vec<Range<usize>> = Vec::new();
        for chunk in chunks {
            match blocks.last_mut() {
                Some(block) if chunk.end - block.start <= most => block.end = chunk.end,
                _ => blocks.push(chunk),
            }
        }
        blocks
    }
}

/// Whether all of a row was measured.
pub fn is_complete(valid: &[u8]) -> bool {
    // Without a way out of the inner loop it is a matter of vector instructions.
    valid.chunks(1024).all(|part| part.iter().fold(true, |all, &v| all & (v != 0)))
}

/// Intensity of a sample.
#[inline(always)]
pub fn mean_of(rgb: &[f32; 3]) -> f64 {
    (f64::from(rgb[0]) + f64::from(rgb[1]) + f64::from(rgb[2])) / 3.0
}

/// Intensity of one row: the mean of its three channels, and where it was measured (all three were).
pub fn intensity(row: RowView<'_>) -> (Vec<f64>, Vec<bool>) {
    let mut values = vec![0.0; row.valid.len() / 3];
    Arch::new().dispatch(Means { response: row.response, out: &mut values });
    if is_complete(row.valid) {
        let measured = vec![true; values.len()];
        return (values, measured);
    }
    let measured: Vec<bool> = row.valid.chunks_exact(3).map(|v| v.iter().all(|&v| v != 0)).collect();
    values.iter_mut().zip(&measured).filter(|(_, m)| !**m).for_each(|(v, _)| *v = 0.0);
    (values, measured)
}

struct Means<'a> {
    response: &'a [f32],
    out: &'a mut [f64],
}

impl NullaryFnOnce for Means<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (out, rgb) in self.out.iter_mut().zip(self.response.as_chunks::<3>().0) {
            *out = mean_of(rgb);
        }
    }
}

/// Intensity of one row over `scale`; whatever it has where it was not measured.
pub fn intensity_into(row: RowView<'_>, scale: f64, out: &mut [f32]) {
    Arch::new().dispatch(ScaledMeans { response: row.response, over: 1.0 / scale, out });
}

struct ScaledMeans<'a> {
    response: &'a [f32],
    over: f64,
    out: &'a mut [f32],
}

impl NullaryFnOnce for ScaledMeans<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (out, rgb) in self.out.iter_mut().zip(self.response.as_chunks::<3>().0) {
            *out = (mean_of(rgb) * self.over) as f32;
        }
    }
}

/// Slope of a window along x and y at every sample, per sample; central differences, one-sided beside samples that
/// were not measured, 0 where neither neighbour was.
pub fn gradient(values: &[f64], measured: &[bool], window: [usize; 2]) -> [Vec<f64>; 2] {
    let [w, h] = window;
    let slope = |at: usize, before: Option<usize>, after: Option<usize>| {
        let before = before.filter(|&k| measured[k]);
        let after = after.filter(|&k| measured[k]);
        match (before, after) {
            _ if !measured[at] => 0.0,
            (Some(b), Some(a)) => (values[a] - values[b]) / 2.0,
            (Some(b), None) => values[at] - values[b],
            (None, Some(a)) => values[a] - values[at],
            (None, None) => 0.0,
        }
    };
    let along_x = |k: usize| slope(k, (!k.is_multiple_of(w)).then(|| k - 1), (k % w + 1 < w).then_some(k + 1));
    let along_y = |k: usize| slope(k, k.checked_sub(w), (k / w + 1 < h).then_some(k + w));
    [(0..w * h).map(along_x).collect(), (0..w * h).map(along_y).collect()]
}

#[cfg(test)]
mod tests {
    use super::super::{MatrixHeader, MatrixWriter};
    use super::*;

    #[test]
    fn blocks_are_all_rows_in_order() {
        let folder = tempfile::tempdir().unwrap();
        // Rows of 0.2 MB of responses: chunks of 20 at the most, blocks of some chunks.
        for points in [[30, 5], [4, 9], [1, 1]] {
            let rows = points[0] * points[1];
            let header = MatrixHeader {
                points,
                window: [131, 131],
                pitch_mm: 0.5,
                lit_pitch_mm: [0.5; 2],
                lit_mm: vec![[0.0; 2]; rows],
                position_sd_mm: vec![0.0; rows],
                shot_of: vec![None; rows],
                common: None,
                shots: Vec::new(),
                camera_px_per_mm: None,
                warnings: Vec::new(),
                provenance: serde_json::Value::Null,
            };
            let path = folder.path().join("m.rd.zarr");
            MatrixWriter::create(&path, header).unwrap().finish().unwrap();
            let blocks = MatrixReader::open(&path).unwrap().blocks();
            assert_eq!(blocks.iter().cloned().flatten().collect::<Vec<_>>(), (0..rows).collect::<Vec<_>>());
            assert!(blocks.iter().all(|b| (1..=108).contains(&b.len())), "{blocks:?}");
        }
    }

    #[test]
    fn the_gradient_of_a_plane_is_its_slope_even_beside_gaps() {
        let values: Vec<f64> = (0..12).map(|k| 2.0 * (k % 4) as f64 - 3.0 * (k / 4) as f64).collect();
        let mut measured = vec![true; 12];
        measured[5] = false;
        let [gx, gy] = gradient(&values, &measured, [4, 3]);
        for k in (0..12).filter(|&k| k != 5) {
            // Sample 4 has the gap on its right and the rim on its left: nothing to difference along x.
            assert_eq!(gx[k], if k == 4 { 0.0 } else { 2.0 });
            // Nor for the samples above and below it along y.
            assert_eq!(gy[k], if k == 1 || k == 9 { 0.0 } else { -3.0 });
        }
        assert_eq!((gx[5], gy[5]), (0.0, 0.0));
    }

    #[test]
    fn intensity_is_the_mean_of_the_channels_where_all_were_measured() {
        let (response, variance) = ([1.0, 2.0, 6.0, 4.0, 4.0, 4.0], [0.0; 6]);
        let row = RowView { response: &response, variance: &variance, valid: &[1, 1, 1, 1, 0, 1] };
        assert_eq!(intensity(row), (vec![3.0, 0.0], vec![true, false]));
    }

    #[test]
    fn a_view_is_the_row_of_its_number_and_nothing_beyond_the_last() {
        let numbers: Vec<f32> = (0..24).map(|k| k as f32).collect();
        let mut block = RowBlock {
            first: 5,
            rows: 2,
            response: numbers.clone(),
            variance: numbers.iter().map(|v| v + 100.0).collect(),
            valid: (0..24).collect(),
        };
        let view = block.view(1);
        assert_eq!((view.response[0], view.variance[0], view.valid[0], view.response.len()), (12.0, 112.0, 12, 12));
        assert_eq!(block.view(0).valid, (0..12).collect::<Vec<u8>>());
        assert!(block.view(2).response.is_empty() && block.view(2).valid.is_empty());
        // Without the variance, as `read_responses` gives it.
        block.variance.clear();
        assert_eq!((block.view(1).variance.len(), block.view(1).response.len()), (0, 12));
        let empty = RowBlock { first: 0, rows: 0, response: vec![], variance: vec![], valid: vec![] };
        assert!(empty.view(0).response.is_empty());
    }

    #[test]
    fn an_intensity_over_a_scale_counts_every_channel_once() {
        let response = [1.0, 2.0, 6.0, -4.0, 0.5, 2.0];
        let row = RowView { response: &response, variance: &[], valid: &[1, 1, 1, 1, 0, 1] };
        let mut out = [9.0; 2];
        intensity_into(row, 4.0, &mut out);
        assert_eq!(out, [0.75, -0.125]);
    }

    #[test]
    fn gradients_are_differences_of_the_nearest_measured_samples() {
        let [w, h] = [5, 4];
        let values: Vec<f64> = (0..20).map(|k| f64::from((k * 37 % 23) as u32) + 0.5 * k as f64).collect();
        let measured: Vec<bool> = (0..20).map(|k| ![3, 7, 8, 11, 16].contains(&k)).collect();
        let found = gradient(&values, &measured, [w, h]);
        let value = |x: i64, y: i64| {
            let inside = x >= 0 && y >= 0 && x < w as i64 && y < h as i64;
            let k = (x + y * w as i64) as usize;
            (inside && measured[k]).then(|| values[k])
        };
        for (y, x) in (0..h as i64).flat_map(|y| (0..w as i64).map(move |x| (y, x))) {
            for (axis, [u, v]) in [[1, 0], [0, 1]].into_iter().enumerate() {
                let expected = match (value(x - u, y - v), value(x, y), value(x + u, y + v)) {
                    (_, None, _) | (None, _, None) => 0.0,
                    (Some(before), Some(_), Some(after)) => (after - before) / 2.0,
                    (Some(before), Some(here), None) => here - before,
                    (None, Some(here), Some(after)) => after - here,
                };
                assert_eq!(found[axis][(x + y * w as i64) as usize], expected, "({x}, {y}) along {axis}");
            }
        }
    }

    #[test]
    fn blocks_hold_as_many_chunks_as_fit_48_mib() {
        let folder = tempfile::tempdir().unwrap();
        let header = MatrixHeader {
            points: [30, 5],
            window: [131, 131],
            pitch_mm: 0.5,
            lit_pitch_mm: [0.5; 2],
            lit_mm: vec![[0.0; 2]; 150],
            position_sd_mm: vec![0.0; 150],
            shot_of: vec![None; 150],
            common: None,
            shots: Vec::new(),
            camera_px_per_mm: None,
            warnings: Vec::new(),
            provenance: serde_json::Value::Null,
        };
        let path = folder.path().join("m.rd.zarr");
        MatrixWriter::create(&path, header.clone()).unwrap().finish().unwrap();
        // A row takes 9 · 3 · 131² bytes: 108 of them fit, seven chunks of 15.
        assert_eq!(MatrixReader::open(&path).unwrap().blocks(), [0..105, 105..150]);
        let small = MatrixHeader { window: [3, 1], ..header };
        MatrixWriter::create(&path, small).unwrap().finish().unwrap();
        let mut rows = Vec::new();
        let each = |block: &RowBlock| {
            rows.extend(block.first..block.first + block.rows);
            Ok(())
        };
        MatrixReader::open(&path).unwrap().for_each_block(each).unwrap();
        assert_eq!(rows, (0..150).collect::<Vec<_>>());
    }
}
