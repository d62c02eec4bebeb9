//! The first pass over a matrix: where every row goes, how noisy it is, and the mean profile.

use super::content::{Content, RawRows};
use super::fill::extend_edges;
use super::independent::independent;
use super::noise::NoiseSums;
use super::{Misfit, vector};
use crate::material::Layout;
use crate::output::numbers;
use crate::progress::Progress;
use crate::transport::normalize::{Placement, layout, place};
use crate::transport::rows::RowView;
use crate::transport::{MatrixReader, RowBlock};
use crate::{FactorWarning, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Rows whose sums are taken together, whatever the number of threads: sums are then the same for any.
const GROUP: usize = 64;

/// What the first pass finds.
#[derive(Debug, Clone)]
pub(super) struct Survey {
    /// Shift and scale of every row.
    pub placements: Vec<Placement>,
    /// The common window.
    pub layout: Layout,
    /// Mean row on the common window, \[plane, y, x\], in the unit of the factored rows.
    pub mean: Vec<f64>,
    /// Noise of the factored rows.
    pub noise: NoiseSums,
    /// Whether every row measured the whole common window.
    pub complete: bool,
    /// The largest response, mm⁻²; 0 when none is positive.
    pub peak: f64,
    /// Valid entries of the matrix, all channels.
    pub entries: u64,
    /// Σ R² over them.
    pub energy: f64,
    /// Whether the channels differ by no more than noise.
    pub grey: bool,
    /// Findings.
    pub warnings: Vec<FactorWarning>,
}

impl Survey {
    /// What a fit leaves, with what it is measured by.
    pub(super) fn misfit(&self, error: f64) -> Misfit {
        Misfit { error, energy: self.energy, peak: self.peak, entries: self.entries }
    }

    /// Columns that a row with this shift cannot have measured, ascending.
    pub(super) fn outside(&self, shift: [i16; 2], planes: usize) -> Vec<u32> {
        let samples = self.layout.len();
        let mut inside = vec![false; samples];
        self.layout.for_each(shift, |_, e| inside[e] = true);
        let columns = (0..planes).flat_map(|p| (0..samples).map(move |e| (p, e)));
        columns.filter(|(_, e)| !inside[*e]).map(|(p, e)| (p * samples + e) as u32).collect()
    }
}

/// What divides a row before it is factored; infinite for one that has nothing.
pub(super) fn scale(content: Content, placement: Option<&Placement>) -> f64 {
    match content {
        // An infinite scale makes the row zero.
        Content::Intensity => placement.map(|p| p.scale).filter(|&s| s > 0.0).unwrap_or(f64::INFINITY),
        _ => 1.0,
    }
}

/// What rows say by themselves, of which the survey is made.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct SurveyedRows {
    placements: Vec<Placement>,
    /// Σ_d v_id of every row.
    noise: Vec<f64>,
    sums: Sums,
}

/// Sums over rows on a window large enough for any shift.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Sums {
    /// The measured window, and the one that is large enough.
    window: [usize; 2],
    widest: [usize; 2],
    #[serde(with = "numbers")]
    value: Vec<f64>,
    #[serde(with = "numbers")]
    noise: Vec<f64>,
    #[serde(with = "numbers")]
    count: Vec<u32>,
    live: u32,
    entries: u64,
    energy: f64,
    peak: f64,
    grey: GreyTest,
}

/// Whether channels differ by more than noise.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub(super) struct GreyTest {
    /// Σ of squared differences of channels over what noise alone would give, and how many.
    sum: f64,
    count: u64,
    /// Whether somewhere channels differ where nothing but rounding may.
    colored: bool,
}

impl GreyTest {
    /// Adds what tells colour from grey in a row: differences of green from red and from blue.
    pub(super) fn add(&mut self, row: RowView<'_>) {
        if self.colored {
            return;
        }
        let largest = row.response.iter().fold(0.0_f32, |a, v| a.max(v.abs()));
        let entries = row.response.chunks_exact(3).zip(row.variance.chunks_exact(3)).zip(row.valid.chunks_exact(3));
        for ((r, v), m) in entries {
            for c in [0, 2] {
                if m[1] == 0 || m[c] == 0 {
                    continue;
                }
                let (difference, variance) = (f64::from(r[c]) - f64::from(r[1]), f64::from(v[c]) + f64::from(v[1]));
                if variance > 0.0 {
                    self.sum += difference * difference / variance;
                    self.count += 1;
                } else if difference.abs() > 1e-6 * f64::from(largest) {
                    self.colored = true;
                }
            }
        }
    }

    fn join(&mut self, other: &Self) {
        self.sum += other.sum;
        self.count += other.count;
        self.colored |= other.colored;
    }

    /// Noise alone gives 1 with a standard deviation of √(2/n); rows share little else than their noise.
    pub(super) fn is_grey(&self) -> bool {
        let spread = 5.0 * (2.0 / self.count.max(1) as f64).sqrt();
        !self.colored && (self.count == 0 || self.sum / self.count as f64 <= 1.0 + spread)
    }
}

/// Reads some rows of the matrix once; what is factored goes to `keep`, if that is wanted, and `each` sees every block.
///
/// # Errors
/// Those of the reader.
pub(super) fn survey_rows(
    reader: &MatrixReader,
    rows: Range<usize>,
    content: Content,
    limit: [usize; 2],
    mut keep: Option<&mut Vec<RawRows>>,
    mut each: impl FnMut(&RowBlock),
    progress: &Progress,
) -> Result<SurveyedRows> {
    let header = reader.header();
    let window = header.window;
    let stage = progress.stage("factor: survey", rows.len());
    let widest = Layout { window, extended: std::array::from_fn(|a| window[a] + 2 * limit[a]) };
    let mut sums = Sums::new(widest, content.planes());
    let mut placements = Vec::with_capacity(rows.len());
    let mut noise = NoiseSums::default();
    reader.for_each_block_of(rows, true, |block| {
        let found: Vec<Placement> =
            (0..block.rows).into_par_iter().map(|k| place(block.view(k), window, limit)).collect();
        let raw = RawRows::extract(block, content, |k| scale(content, Some(&found[k])));
        let groups: Vec<(Sums, NoiseSums)> = (0..block.rows.div_ceil(GROUP))
            .into_par_iter()
            .map(|g| {
                let mut sums = Sums::new(widest, content.planes());
                let mut noise = NoiseSums::default();
                for k in g * GROUP..((g + 1) * GROUP).min(block.rows) {
                    let sd_px = header.position_sd_mm[block.first + k] / header.pitch_mm;
                    sums.add(
                        block,
                        &raw,
                        k,
                        &found[k],
                        content,
                        if sd_px.is_finite() { sd_px } else { 0.0 },
                        &mut noise,
                    );
                }
                (sums, noise)
            })
            .collect();
        for (group, row_noise) in groups {
            sums.join(&group);
            noise.rows.extend(row_noise.rows);
        }
        placements.extend(found);
        each(block);
        if let Some(keep) = keep.as_deref_mut() {
            keep.push(raw);
        }
        stage.advance(block.rows);
        Ok(())
    })?;
    Ok(SurveyedRows { placements, noise: noise.rows, sums })
}

impl SurveyedRows {
    /// How many there are.
    pub(super) fn len(&self) -> usize {
        self.placements.len()
    }

    /// With the rows that come after them.
    pub(super) fn join(&mut self, next: Self) {
        self.placements.extend(next.placements);
        self.noise.extend(next.noise);
        self.sums.join(&next.sums);
    }

    /// What all rows of a matrix say.
    pub(super) fn survey(self, reader: &MatrixReader, content: Content, limit: [usize; 2]) -> Survey {
        let Self { placements, noise: rows, sums } = self;
        let header = reader.header();
        let counted: u64 = sums.count.iter().map(|&c| u64::from(c)).sum();
        let layout = layout(header.window, &placements);
        let sd = |sd: &f64| if sd.is_finite() { sd / header.pitch_mm } else { 0.0 };
        let mut noise = NoiseSums {
            rows,
            columns: sums.noise_on(&layout, content.planes()),
            position_sd_px: header.position_sd_mm.iter().map(sd).collect(),
            shots: if header.shots.is_empty() { header.rows() } else { header.shots.len() },
            mean: sums.noise.iter().sum::<f64>() / counted.max(1) as f64,
        };
        let (mut mean, complete) = sums.mean(&layout, content.planes());
        let unit = content.unit(sums.peak);
        mean.iter_mut().for_each(|m| *m /= unit);
        noise.divide(unit);
        let warnings = findings(&placements, limit);
        let grey = sums.grey.is_grey();
        let (peak, entries, energy) = (sums.peak, sums.entries, sums.energy);
        Survey { placements, layout, mean, noise, complete, peak, entries, energy, grey, warnings }
    }
}

/// Of a whole matrix.
#[cfg(test)]
pub(super) fn survey(reader: &MatrixReader, content: Content, limit: [usize; 2]) -> Result<Survey> {
    let all = 0..reader.header().rows();
    let rows = survey_rows(reader, all, content, limit, None, |_| {}, &Progress::silent())?;
    Ok(rows.survey(reader, content, limit))
}

fn findings(placements: &[Placement], limit: [usize; 2]) -> Vec<FactorWarning> {
    let empty = placements.iter().filter(|p| p.scale <= 0.0).count();
    let limited = placements.iter().filter(|p| p.limited).count();
    let mut warnings = Vec::new();
    if empty > 0 {
        warnings.push(FactorWarning::EmptyRows { rows: empty });
    }
    if limited > 0 {
        warnings.push(FactorWarning::ShiftLimited { rows: limited, limit: limit[0].max(limit[1]) });
    }
    warnings
}

impl Sums {
    fn new(layout: Layout, planes: usize) -> Self {
        let n = layout.len() * planes;
        Self {
            window: layout.window,
            widest: layout.extended,
            value: vec![0.0; n],
            noise: vec![0.0; n],
            count: vec![0; n],
            live: 0,
            entries: 0,
            energy: 0.0,
            peak: 0.0,
            grey: GreyTest::default(),
        }
    }

    #[expect(clippy::too_many_arguments, reason = "the inner loop of survey, split off for its length")]
    fn add(
        &mut self,
        block: &RowBlock,
        raw: &RawRows,
        k: usize,
        placement: &Placement,
        content: Content,
        sd_px: f64,
        noise: &mut NoiseSums,
    ) {
        let row = block.view(k);
        // What was not measured is zero, and adds nothing.
        self.entries += match raw.measured[k] {
            None => row.valid.len() as u64,
            Some(_) => row.valid.iter().map(|&v| u64::from(v)).sum(),
        };
        let (energy, peak) = vector::energy_and_peak(row.response);
        (self.energy, self.peak) = (self.energy + energy, self.peak.max(peak));
        if content == Content::Grey {
            self.grey.add(row);
        }
        let (planes, layout) = (content.planes(), self.layout());
        let (window, samples) = (self.window[0] * self.window[1], layout.len());
        if content == Content::Intensity && placement.scale <= 0.0 {
            noise.rows.push(0.0);
            return;
        }
        self.live += 1;
        let row_noise = independent(row, content, scale(content, Some(placement)), self.window, sd_px);
        noise.rows.push(vector::sum(&row_noise));
        let values = &raw.values[k * planes * window..(k + 1) * planes * window];
        let measured = raw.measured[k].as_deref();
        for p in 0..planes {
            layout.for_each_line(placement.shift, |w, e, n| {
                let (from, to) = (p * window + w, p * samples + e);
                // Both are zero where nothing was measured.
                vector::add_wide(&mut self.value[to..to + n], &values[from..from + n]);
                vector::add(&mut self.noise[to..to + n], &row_noise[from..from + n]);
                let counts = self.count[to..to + n].iter_mut();
                match measured {
                    None => counts.for_each(|c| *c += 1),
                    Some(m) => counts.zip(&m[from..from + n]).for_each(|(c, &m)| *c += u32::from(m)),
                }
            });
        }
    }

    fn join(&mut self, other: &Self) {
        self.value.iter_mut().zip(&other.value).for_each(|(a, b)| *a += b);
        self.noise.iter_mut().zip(&other.noise).for_each(|(a, b)| *a += b);
        self.count.iter_mut().zip(&other.count).for_each(|(a, b)| *a += b);
        self.live += other.live;
        self.entries += other.entries;
        self.energy += other.energy;
        self.peak = self.peak.max(other.peak);
        self.grey.join(&other.grey);
    }

    fn layout(&self) -> Layout {
        Layout { window: self.window, extended: self.widest }
    }

    /// Where sample `k` of plane `p` on a smaller window is among the sums.
    fn index(&self, to: &Layout, p: usize, k: usize) -> usize {
        let at = [k % to.extended[0], k / to.extended[0]];
        let [x, y] = [0, 1].map(|a| at[a] + (self.widest[a] - to.extended[a]) / 2);
        p * self.layout().len() + x + y * self.widest[0]
    }

    /// The noise of the columns of the smaller window.
    fn noise_on(&self, to: &Layout, planes: usize) -> Vec<f64> {
        (0..planes).flat_map(|p| (0..to.len()).map(move |k| self.noise[self.index(to, p, k)])).collect()
    }

    /// The mean on the smaller window, its unmeasured rim extended, and whether all rows measured all of it.
    fn mean(&self, to: &Layout, planes: usize) -> (Vec<f64>, bool) {
        let (mut all, mut complete) = (Vec::with_capacity(planes * to.len()), true);
        for p in 0..planes {
            let at = |k: usize| self.index(to, p, k);
            let mut mean: Vec<f64> =
                (0..to.len()).map(|k| self.value[at(k)] / f64::from(self.count[at(k)].max(1))).collect();
            let measured: Vec<bool> = (0..to.len()).map(|k| self.count[at(k)] > 0).collect();
            complete &= (0..to.len()).all(|k| self.count[at(k)] == self.live);
            extend_edges(&mut mean, &measured, to.extended);
            all.extend(mean);
        }
        (all, complete)
    }
}

#[cfg(test)]
mod tests;
