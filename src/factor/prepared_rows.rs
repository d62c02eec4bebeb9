//! The rows that are factored, as often as they are wanted: shifted, scaled, their gaps filled; kept in memory when
//! they fit, else read from the store again.

use super::backend::Rows;
use super::content::{Content, RawRows};
use super::fill::{Basis, Missing};
use super::noise::NoiseSums;
use super::survey::{Survey, survey};
use crate::Result;
use crate::material::Material;
use crate::progress::Progress;
use crate::transport::normalize::Placement;
use crate::transport::{MatrixReader, RowBlock};
use rayon::prelude::*;

/// Consecutive rows on the common window, `[row][plane][y][x]`, and what of them was estimated.
#[derive(Debug)]
struct Chunk {
    first: usize,
    values: Vec<f32>,
    missing: Vec<Missing>,
}

/// Takes the first row of a chunk, its values and what of them was estimated.
type EachChunk<'e> = dyn FnMut(usize, &[f32], &[Missing]) -> Result<()> + 'e;

/// The rows of a matrix, prepared for factoring.
pub(super) struct PreparedRows<'a> {
    reader: &'a MatrixReader,
    progress: &'a Progress,
    /// What the first pass found.
    pub survey: Survey,
    /// What is factored.
    pub content: Content,
    /// What columns are multiplied by, \[plane, y, x\]; empty for one.
    pub metric: Vec<f32>,
    /// Noise of the rows so multiplied.
    pub noise: NoiseSums,
    /// A material whose entry and exit maps divide the rows.
    through: Option<Material>,
    /// What fills the gaps of rows that are read again.
    basis: Basis,
    /// All rows, when they fit in memory.
    cache: Option<Vec<Chunk>>,
    /// Missing columns of complete rows, per shift.
    patterns: Vec<([i16; 2], Vec<u32>)>,
}

impl<'a> PreparedRows<'a> {
    /// Reads the matrix once: places rows, keeps them when they take at most `memory` bytes, and fills gaps with the
    /// mean profile. Columns are multiplied by the mean profile to the power −`profile_power`; `each` sees every block
    /// as it is read.
    ///
    /// # Errors
    /// Those of the reader.
    pub(super) fn new(
        reader: &'a MatrixReader,
        content: Content,
        limit: [usize; 2],
        memory: u64,
        profile_power: f64,
        each: impl FnMut(&RowBlock),
        progress: &'a Progress,
    ) -> Result<Self> {
        let header = reader.header();
        let bytes = |samples: usize| (4 * header.rows() * samples * content.planes()) as u64;
        let mut raw = Vec::new();
        let keep = bytes(header.window_len()) <= memory;
        let survey = survey(reader, content, limit, keep.then_some(&mut raw), each, progress)?;
        let mut patterns: Vec<[i16; 2]> = survey.placements.iter().map(|p| p.shift).collect();
        patterns.sort_unstable();
        patterns.dedup();
        let patterns = patterns.into_iter().map(|shift| (shift, survey.outside(shift, content.planes()))).collect();
        let metric = match profile_power {
            0.0 => Vec::new(),
            power => metric(&survey.mean, survey.layout.len(), power),
        };
        let mean: Vec<f64> = match metric.is_empty() {
            true => survey.mean.clone(),
            false => survey.mean.iter().zip(&metric).map(|(m, &w)| m * f64::from(w)).collect(),
        };
        let basis = Basis::mean(&mean);
        let noise = survey.noise.weighed(&metric);
        let mut rows =
            Self { reader, progress, survey, content, metric, noise, through: None, basis, cache: None, patterns };
        if keep && bytes(rows.survey.layout.len()) <= memory {
            let basis = rows.basis.prepared(&rows.patterns);
            let chunks = raw.into_iter().map(|raw| {
                let mut chunk = rows.place(raw);
                basis.fill(&mut chunk.values, &chunk.missing);
                chunk
            });
            rows.cache = Some(chunks.collect());
        }
        Ok(rows)
    }

    /// Whether a row has gaps that [`Self::refill`] would estimate anew.
    pub(super) fn has_gaps(&self) -> bool {
        !self.survey.complete
    }

    /// Whether the rows are in memory: a pass then costs no reading.
    pub(super) fn in_memory(&self) -> bool {
        self.cache.is_some()
    }

    /// Estimates what was not measured from `basis`, from now on.
    pub(super) fn refill(&mut self, basis: Basis) {
        let prepared = basis.prepared(&self.patterns);
        for chunk in self.cache.iter_mut().flatten() {
            prepared.fill(&mut chunk.values, &chunk.missing);
        }
        self.basis = basis;
    }

    /// Divides rows by the entry and exit maps of `material` from now on.
    pub(super) fn divide_by(&mut self, material: &Material) {
        let new = material.maps_alone();
        let (old, content, layout) = (self.through.take(), self.content, self.survey.layout);
        let (samples, planes) = (layout.len(), content.planes());
        let window = layout.window[0] * layout.window[1];
        for chunk in self.cache.iter_mut().flatten() {
            let first = chunk.first;
            chunk.values.par_chunks_mut((planes * samples).max(1)).enumerate().for_each(|(k, row)| {
                let factor = |m: &Material| m.row_maps(first + k);
                let (before, after) = (old.as_ref().map(factor), factor(&new));
                for p in 0..planes {
                    layout.for_each(self.survey.placements[first + k].shift, |w, e| {
                        let before = before.as_ref().map_or(1.0, |b| b[p * window + w]);
                        let value = &mut row[p * samples + e];
                        *value = (f64::from(*value) * before / after[p * window + w]) as f32;
                    });
                }
            });
        }
        self.through = Some(new);
        // What fills the gaps is what it would be if rows were read again.
        self.refill(self.basis.clone());
    }

    /// What row `index` was before it was divided and its columns were multiplied, on its measured window
    /// `[plane][dy][dx]`.
    pub(super) fn measured(&self, index: usize, row: &[f32]) -> Vec<f64> {
        let layout = &self.survey.layout;
        let (samples, window) = (layout.len(), layout.window[0] * layout.window[1]);
        let through = self.through.as_ref().map(|m| m.row_maps(index));
        let mut out = vec![0.0; self.content.planes() * window];
        for p in 0..self.content.planes() {
            layout.for_each(self.survey.placements[index].shift, |w, e| {
                let metric = self.metric.get(p * samples + e).map_or(1.0, |&m| f64::from(m));
                let through = through.as_ref().map_or(1.0, |t| t[p * window + w]);
                out[p * window + w] = f64::from(row[p * samples + e]) * self.unit() * through / metric;
            });
        }
        out
    }

    /// Calls `each(first_row, values, missing)` for blocks of rows `[row][plane][y][x]` whose gaps are filled.
    ///
    /// # Errors
    /// Those of the reader and of `each`.
    pub(super) fn for_each_chunk(&self, stage: &str, each: &mut EachChunk<'_>) -> Result<()> {
        let stage = self.progress.stage(stage, self.reader.header().rows());
        if let Some(chunks) = &self.cache {
            return chunks.iter().try_for_each(|c| {
                each(c.first, &c.values, &c.missing)?;
                stage.advance(c.missing.len());
                Ok(())
            });
        }
        let basis = self.basis.prepared(&self.patterns);
        self.reader.for_each_block_of_responses(|block| {
            let raw = RawRows::extract(block, self.content, |k| self.scale(block.first + k));
            let mut chunk = self.place(raw);
            basis.fill(&mut chunk.values, &chunk.missing);
            each(chunk.first, &chunk.values, &chunk.missing)?;
            stage.advance(block.rows);
            Ok(())
        })
    }

    /// Columns of a row that were not measured.
    pub(super) fn missing<'m>(&'m self, missing: &'m Missing) -> &'m [u32] {
        match missing {
            Missing::Nothing => &[],
            Missing::Pattern(k) => self.patterns.get(*k).map_or(&[], |(_, columns)| columns),
            Missing::Columns(columns) => columns,
        }
    }

    /// What the factored rows are to be multiplied by; 1 for normalized ones.
    pub(super) fn unit(&self) -> f64 {
        self.content.unit(self.survey.peak)
    }

    fn scale(&self, index: usize) -> f64 {
        super::survey::scale(self.content, self.survey.placements.get(index))
    }

    /// Moves rows to their places on the common window and to their unit.
    fn place(&self, raw: RawRows) -> Chunk {
        let layout = &self.survey.layout;
        let (window, samples, planes) = (layout.window[0] * layout.window[1], layout.len(), self.content.planes());
        let unit = self.unit();
        let mut values = vec![0.0; raw.rows * planes * samples];
        let missing = values
            .par_chunks_mut((planes * samples).max(1))
            .enumerate()
            .map(|(k, out)| {
                let placement: &Placement = &self.survey.placements[raw.first + k];
                let row = &raw.values[k * planes * window..(k + 1) * planes * window];
                let through = self.through.as_ref().map(|m| m.row_maps(raw.first + k));
                for p in 0..planes {
                    layout.for_each_line(placement.shift, |w, e, n| {
                        let to = &mut out[p * samples + e..][..n];
                        to.copy_from_slice(&row[p * window + w..][..n]);
                        if unit != 1.0 {
                            to.iter_mut().for_each(|v| *v = (f64::from(*v) / unit) as f32);
                        }
                        if let Some(through) = &through {
                            let maps = &through[p * window + w..][..n];
                            to.iter_mut().zip(maps).for_each(|(v, m)| *v = (f64::from(*v) / m) as f32);
                        }
                        if let Some(metric) = self.metric.get(p * samples + e..p * samples + e + n) {
                            to.iter_mut().zip(metric).for_each(|(v, m)| *v *= m);
                        }
                    });
                }
                self.missing_of(placement, raw.measured[k].as_deref())
            })
            .collect();
        Chunk { first: raw.first, values, missing }
    }

    fn missing_of(&self, placement: &Placement, measured: Option<&[bool]>) -> Missing {
        let pattern = self.patterns.binary_search_by_key(&placement.shift, |(shift, _)| *shift);
        let (Some(measured), Ok(k)) = (measured, pattern) else {
            return match pattern {
                Ok(k) if !self.patterns[k].1.is_empty() => Missing::Pattern(k),
                _ => Missing::Nothing,
            };
        };
        let layout = &self.survey.layout;
        let (window, samples) = (layout.window[0] * layout.window[1], layout.len());
        let mut columns = self.patterns[k].1.clone();
        for p in 0..self.content.planes() {
            layout.for_each(placement.shift, |w, e| {
                if !measured[p * window + w] {
                    columns.push((p * samples + e) as u32);
                }
            });
        }
        columns.sort_unstable();
        Missing::Columns(columns)
    }
}

/// Columns below this share of a plane's largest mean weigh no more than that.
const DIM: f64 = 1e-5;

/// What columns are multiplied by: the mean profile to the power −`power`, one where it is largest.
fn metric(mean: &[f64], samples: usize, power: f64) -> Vec<f32> {
    let plane = |mean: &[f64]| {
        let largest = mean.iter().copied().fold(0.0, f64::max);
        let weight = |m: &f64| if largest > 0.0 { (m / largest).max(DIM).powf(-power) as f32 } else { 1.0 };
        mean.iter().map(weight).collect::<Vec<f32>>()
    };
    mean.chunks(samples.max(1)).flat_map(plane).collect()
}

impl Rows for PreparedRows<'_> {
    fn shape(&self) -> (usize, usize) {
        (self.survey.placements.len(), self.survey.layout.len() * self.content.planes())
    }

    fn for_each(&self, each: &mut dyn FnMut(usize, &[f32]) -> Result<()>) -> Result<()> {
        self.for_each_chunk("factor: terms", &mut |first, values, _| each(first, values))
    }
}

#[cfg(test)]
mod tests;
