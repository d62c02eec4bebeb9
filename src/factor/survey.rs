//! The first pass over a matrix: where every row goes, how noisy it is, and the mean profile; then the normalized
//! rows themselves, as often as they are wanted.

use super::fill::{Basis, extend_edges};
use super::noise::{Noise, RowNoise, row_noise};
use super::svd::Rows;
use super::tucker::Options;
use crate::transport::normalize::{Layout, Placement, layout, normalized, place};
use crate::transport::{MatrixReader, RowBlock};
use crate::{Error, Result, Warning, progress::Stage};
use rayon::prelude::*;

/// What the first pass finds.
#[derive(Debug, Clone)]
pub struct Survey {
    /// Shift and scale of every row.
    pub placements: Vec<Placement>,
    /// The common window.
    pub layout: Layout,
    /// Mean normalized row on the common window.
    pub mean: Vec<f64>,
    /// Noise of the normalized rows.
    pub noise: Noise,
    /// Whether every row measured the whole common window.
    pub complete: bool,
    /// Findings.
    pub warnings: Vec<Warning>,
}

/// Sums over rows on a window large enough for any shift.
struct Sums {
    layout: Layout,
    value: Vec<f64>,
    count: Vec<usize>,
    noise: Vec<f64>,
}

/// Reads the matrix once.
///
/// # Errors
/// Those of the reader.
pub fn survey(reader: &MatrixReader, options: &Options, stage: &Stage<'_>) -> Result<Survey> {
    let header = reader.header();
    let window = header.window;
    let limit: [usize; 2] = match options.peak_shift {
        true => std::array::from_fn(|a| options.max_shift.unwrap_or(window[a] / 4).min(window[a] / 2).min(30_000)),
        false => [0, 0],
    };
    let widest = Layout { window, extended: std::array::from_fn(|a| window[a] + 2 * limit[a]) };
    let n = widest.len();
    let mut sums = Sums { layout: widest, value: vec![0.0; n], count: vec![0; n], noise: vec![0.0; n] };
    let mut placements = Vec::with_capacity(header.rows());
    let mut noise = Noise::default();
    reader.for_each_block(|block| {
        let found: Vec<(Placement, RowNoise)> = (0..block.rows)
            .into_par_iter()
            .map(|k| {
                let row = block.view(k);
                let sd_px = header.position_sd_mm[block.first + k] / header.pitch_mm;
                let placement = place(row, window, limit);
                let noise = row_noise(row, &placement, window, if sd_px.is_finite() { sd_px } else { 0.0 });
                (placement, noise)
            })
            .collect();
        for (k, (placement, row_noise)) in found.into_iter().enumerate() {
            noise.largest_row = noise.largest_row.max(row_noise.independent.iter().sum());
            noise.registration += row_noise.registration;
            sums.add(&block, k, &placement, &row_noise.independent);
            placements.push(placement);
        }
        stage.advance(block.rows);
        Ok(())
    })?;
    noise.largest_column = sums.noise.iter().copied().fold(0.0, f64::max);
    noise.mean = sums.noise.iter().sum::<f64>() / sums.count.iter().sum::<usize>().max(1) as f64;
    let layout = layout(window, &placements);
    let live = placements.iter().filter(|p| p.scale > 0.0).count();
    let (mean, complete) = sums.mean(&layout, live);
    let warnings = findings(&placements, limit);
    Ok(Survey { placements, layout, mean, noise, complete, warnings })
}

fn findings(placements: &[Placement], limit: [usize; 2]) -> Vec<Warning> {
    let empty = placements.iter().filter(|p| p.scale <= 0.0).count();
    let limited = placements.iter().filter(|p| p.limited).count();
    let mut warnings = Vec::new();
    if empty > 0 {
        warnings.push(Warning::EmptyRows { rows: empty });
    }
    if limited > 0 {
        warnings.push(Warning::ShiftLimited { rows: limited, limit: limit[0].max(limit[1]) });
    }
    warnings
}

impl Sums {
    fn add(&mut self, block: &RowBlock, k: usize, placement: &Placement, noise: &[f64]) {
        if placement.scale <= 0.0 {
            return;
        }
        let (values, measured) = crate::transport::rows::intensity(block.view(k));
        self.layout.for_each(placement.shift, |k, e| {
            if measured[k] {
                self.value[e] += values[k] / placement.scale;
                self.noise[e] += noise[k];
                self.count[e] += 1;
            }
        });
    }

    /// The mean on the smaller window, its unmeasured rim extended, and whether all `live` rows measured all of it.
    fn mean(&self, to: &Layout, live: usize) -> (Vec<f64>, bool) {
        let margin: [usize; 2] = std::array::from_fn(|a| (self.layout.extended[a] - to.extended[a]) / 2);
        let from = |k: usize| {
            let (x, y) = (k % to.extended[0] + margin[0], k / to.extended[0] + margin[1]);
            x + y * self.layout.extended[0]
        };
        let count: Vec<usize> = (0..to.len()).map(|k| self.count[from(k)]).collect();
        let mut mean: Vec<f64> =
            (0..to.len()).map(|k| self.value[from(k)] / self.count[from(k)].max(1) as f64).collect();
        let measured: Vec<bool> = count.iter().map(|&c| c > 0).collect();
        extend_edges(&mut mean, &measured, to.extended);
        (mean, count.iter().all(|&c| c == live))
    }
}

/// The normalized rows of a matrix, their missing samples filled.
pub struct Normalized<'a> {
    /// The matrix.
    pub reader: &'a MatrixReader,
    /// Where its rows go.
    pub survey: &'a Survey,
    /// What fills the gaps.
    pub basis: Basis,
    /// Told of every row.
    pub stage: &'a Stage<'a>,
}

impl Normalized<'_> {
    /// One block of rows on the common window, row-major, and where each sample was measured.
    pub fn block(&self, block: &RowBlock) -> Result<(Vec<f64>, Vec<bool>)> {
        let samples = self.survey.layout.len();
        let mut values = vec![0.0; block.rows * samples];
        let mut measured = vec![false; block.rows * samples];
        let placements = self
            .survey
            .placements
            .get(block.first..block.first + block.rows)
            .ok_or_else(|| Error::internal("more rows than were surveyed"))?;
        values
            .par_chunks_mut(samples.max(1))
            .zip(measured.par_chunks_mut(samples.max(1)))
            .zip(placements)
            .enumerate()
            .for_each(|(k, ((values, measured), placement))| {
                normalized(block.view(k), placement, &self.survey.layout, values, measured);
                self.basis.fill(values, measured);
            });
        Ok((values, measured))
    }
}

impl Rows for Normalized<'_> {
    fn shape(&self) -> (usize, usize) {
        (self.survey.placements.len(), self.survey.layout.len())
    }

    fn for_each(&self, each: &mut dyn FnMut(usize, &[f64]) -> Result<()>) -> Result<()> {
        self.reader.for_each_block(|block| {
            let (values, _) = self.block(&block)?;
            each(block.first, &values)?;
            self.stage.advance(block.rows);
            Ok(())
        })
    }
}
