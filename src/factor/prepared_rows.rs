//! The rows that are factored, as often as they are wanted: shifted, scaled, their gaps filled; kept in memory when
//! they fit, else read from the store again.

use super::backend::{self, Backend, Rows};
use super::content::{Content, RawRows};
use super::entry_exit::Marginals;
use super::fill::{Basis, Missing};
use super::noise::NoiseSums;
use super::survey::{Survey, survey_rows};
use super::tasks::{Pass, Passes, Tasks};
use super::term_rows::TermRows;
use super::vector::misfit;
use crate::material::Material;
use crate::transport::RowBlock;
use crate::transport::normalize::Placement;
use crate::{Error, Result};
use faer::Mat;
use rayon::prelude::*;
use std::ops::Range;

mod state;
pub(super) use state::RowsState;

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
    matrix: Passes<'a>,
    /// Those that passes go over: all, but in a task of many.
    range: Range<usize>,
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
    /// Reads the matrix once: places rows, keeps them when they take at most `memory` bytes and no tasks do the passes,
    /// and fills gaps with the mean profile. Columns are multiplied by the mean profile to the power −`profile_power`;
    /// `sums` gets what entry and exit maps are fitted to.
    ///
    /// # Errors
    /// Those of the reader.
    pub(super) fn new(
        matrix: Passes<'a>,
        content: Content,
        limit: [usize; 2],
        memory: u64,
        profile_power: f64,
        sums: Option<&mut Marginals>,
    ) -> Result<Self> {
        let header = matrix.reader.header();
        let bytes = |samples: usize| (4 * header.rows() * samples * content.planes()) as u64;
        let mut raw = Vec::new();
        let keep = matrix.tasks.is_none() && bytes(header.window_len()) <= memory;
        let survey = surveyed(matrix, content, limit, keep.then_some(&mut raw), sums)?;
        let patterns = patterns(&survey, content);
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
        let range = 0..header.rows();
        let mut rows =
            Self { matrix, range, survey, content, metric, noise, through: None, basis, cache: None, patterns };
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

    /// How passes read the rows, in a few words; none where they are in memory.
    pub(super) fn how_read(&self) -> &'static str {
        match (self.matrix.tasks, &self.cache) {
            (Some(_), _) => ", by tasks",
            (None, None) => ", streamed from the store",
            (None, Some(_)) => "",
        }
    }

    /// Who does the passes, if not this process.
    pub(super) fn tasks(&self) -> Option<&'a Tasks> {
        self.matrix.tasks
    }

    /// How its singular values are computed where nothing else was asked.
    ///
    /// # Errors
    /// [`crate::Error::Setting`] for an accuracy that tasks do not reach.
    pub(super) fn choose_backend(&self, accuracy: f64) -> Result<Backend> {
        let (rows, columns) = self.shape();
        match self.matrix.tasks {
            Some(_) => backend::choose_for_tasks(columns, accuracy),
            None => Ok(backend::choose(rows, columns, accuracy)),
        }
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
        let (old, layout, planes) = (self.through.take(), self.survey.layout, self.content.planes());
        let (samples, window) = (layout.len(), layout.window[0] * layout.window[1]);
        let placements = &self.survey.placements;
        for chunk in self.cache.iter_mut().flatten() {
            let first = chunk.first;
            let buffers = || [vec![1.0; window], vec![1.0; window]];
            let all = chunk.values.par_chunks_mut(samples.max(1)).enumerate();
            all.for_each_init(buffers, |[before, after], (k, row)| {
                let (index, plane) = (first + k / planes, k % planes);
                if let Some(old) = &old {
                    old.row_maps(plane, index, before);
                }
                new.row_maps(plane, index, after);
                layout.for_each_line(placements[index].shift, |w, e, n| {
                    let maps = before[w..w + n].iter().zip(&after[w..w + n]);
                    row[e..e + n].iter_mut().zip(maps).for_each(|(v, (before, after))| *v *= before / after);
                });
            });
        }
        self.through = Some(new);
        // What fills the gaps is what it would be if rows were read again.
        self.refill(self.basis.clone());
    }

    /// Σ (R̂−R)² over the measured entries, in the rows' squared unit, of a material without a colour polynomial; or,
    /// `inside`, Σ of the squares of what its terms differ by from the rows as they are factored, divided by the maps.
    ///
    /// # Errors
    /// Those of the reader.
    pub(super) fn misfit(&self, material: &Material, inside: bool) -> Result<f64> {
        if let Some(tasks) = self.matrix.tasks {
            return tasks.sum(Pass::Misfit { rows: self.state(), material: material.into(), inside });
        }
        let (columns, layout, terms) = (self.shape().1, self.survey.layout, TermRows::new(material));
        let (samples, window) = (layout.len(), layout.window[0] * layout.window[1]);
        let scale = terms.unit / self.unit();
        let over: Vec<f32> = self.metric.iter().map(|m| 1.0 / m).collect();
        let ones = vec![1.0; window];
        let mut error = 0.0;
        self.for_each_chunk("factor: measure", &mut |first, values, missing| {
            let errors = terms.map(first..first + missing.len(), |row| {
                let (k, from) = (row.index - first, row.plane * samples);
                let mut measured = values[k * columns + from..][..samples].to_vec();
                if let Some(over) = over.get(from..from + samples) {
                    measured.iter_mut().zip(over).for_each(|(v, o)| *v *= o);
                }
                if let Missing::Columns(columns) = &missing[k] {
                    let here = columns.iter().filter_map(|&d| (d as usize).checked_sub(from));
                    here.filter(|&d| d < samples).for_each(|d| (measured[d], row.values[d]) = (0.0, 0.0));
                }
                let mut through = ones.clone();
                if let Some(maps) = self.through.as_ref().filter(|_| !inside) {
                    maps.row_maps(row.plane, row.index, &mut through);
                }
                let maps = if inside { &ones } else { row.maps };
                let mut sum = 0.0;
                layout.for_each_line(self.survey.placements[row.index].shift, |w, e, n| {
                    let [measured, fit] = [&measured, &*row.values].map(|v| &v[e..e + n]);
                    let [through, maps] = [&through, maps].map(|v| &v[w..w + n]);
                    sum += misfit(measured, through, scale, fit, maps);
                });
                sum
            });
            error += errors.iter().sum::<f64>();
            Ok(())
        })?;
        Ok(error)
    }

    /// Calls `each(first_row, values, missing)` for blocks of rows `[row][plane][y][x]` whose gaps are filled.
    ///
    /// # Errors
    /// Those of the reader and of `each`.
    pub(super) fn for_each_chunk(&self, stage: &str, each: &mut EachChunk<'_>) -> Result<()> {
        if self.matrix.tasks.is_some() {
            return Err(Error::internal("a pass over the rows that no task knows"));
        }
        let stage = self.matrix.progress.stage(stage, self.range.len());
        if let Some(chunks) = &self.cache {
            return chunks.iter().try_for_each(|c| {
                each(c.first, &c.values, &c.missing)?;
                stage.advance(c.missing.len());
                Ok(())
            });
        }
        let basis = self.basis.prepared(&self.patterns);
        self.matrix.reader.for_each_block_of(self.range.clone(), false, |block| {
            let raw = RawRows::extract(block, self.content, |k| self.scale(block.first + k));
            let mut chunk = self.place(raw);
            basis.fill(&mut chunk.values, &chunk.missing);
            each(chunk.first, &chunk.values, &chunk.missing)?;
            stage.advance(block.rows);
            Ok(())
        })
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
                let through = self.through.as_ref().map(|m| {
                    let mut maps = vec![1.0; planes * window];
                    let channels = maps.chunks_exact_mut(window.max(1)).enumerate();
                    channels.for_each(|(plane, maps)| m.row_maps(plane, raw.first + k, maps));
                    maps
                });
                for p in 0..planes {
                    layout.for_each_line(placement.shift, |w, e, n| {
                        let to = &mut out[p * samples + e..][..n];
                        to.copy_from_slice(&row[p * window + w..][..n]);
                        if unit != 1.0 {
                            to.iter_mut().for_each(|v| *v = (f64::from(*v) / unit) as f32);
                        }
                        if let Some(through) = &through {
                            let maps = &through[p * window + w..][..n];
                            to.iter_mut().zip(maps).for_each(|(v, m)| *v /= m);
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

/// What the first pass finds; what is factored goes to `keep`, where that is wanted.
fn surveyed(
    matrix: Passes<'_>,
    content: Content,
    limit: [usize; 2],
    keep: Option<&mut Vec<RawRows>>,
    mut sums: Option<&mut Marginals>,
) -> Result<Survey> {
    let Passes { reader, tasks, progress } = matrix;
    let rows = match tasks {
        Some(tasks) => {
            let (rows, found) = tasks.survey(content, limit, sums.is_some())?;
            sums.iter_mut().for_each(|sums| found.iter().for_each(|found| sums.join(found.clone())));
            rows
        }
        None => {
            let window = reader.header().window;
            let each = |block: &RowBlock| sums.iter_mut().for_each(|sums| sums.add(block, window));
            survey_rows(reader, 0..reader.header().rows(), content, limit, keep, each, progress)?
        }
    };
    Ok(rows.survey(reader, content, limit))
}

/// Columns that rows with the same shift cannot have measured, by shift.
fn patterns(survey: &Survey, content: Content) -> Vec<([i16; 2], Vec<u32>)> {
    let mut shifts: Vec<[i16; 2]> = survey.placements.iter().map(|p| p.shift).collect();
    shifts.sort_unstable();
    shifts.dedup();
    shifts.into_iter().map(|shift| (shift, survey.outside(shift, content.planes()))).collect()
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
        (self.range.len(), self.survey.layout.len() * self.content.planes())
    }

    fn gram_times(&self, columns: &[f32], width: usize) -> Result<Mat<f64>> {
        match self.matrix.tasks {
            Some(tasks) => {
                let pass = Pass::GramTimes { rows: self.state(), columns: columns.to_vec(), width };
                tasks.matrix(pass, self.shape().1, width)
            }
            None => backend::gram_times_here(self, columns, width),
        }
    }

    fn gram(&self) -> Result<Mat<f64>> {
        match self.matrix.tasks {
            Some(tasks) => tasks.matrix(Pass::Gram { rows: self.state() }, self.shape().1, self.shape().1),
            None => backend::gram_here(self),
        }
    }

    fn times(&self, vectors: &[f64], exact: bool) -> Result<Vec<f64>> {
        match self.matrix.tasks {
            Some(tasks) => tasks.rows(Pass::Times { rows: self.state(), vectors: vectors.to_vec(), exact }),
            None => backend::times_here(self, vectors, exact),
        }
    }

    fn for_each(&self, each: &mut dyn FnMut(usize, &[f32]) -> Result<()>) -> Result<()> {
        self.for_each_chunk("factor: terms", &mut |first, values, _| each(first, values))
    }
}

#[cfg(test)]
mod tests;
