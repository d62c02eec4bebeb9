//! What the data or a goal decides where nothing was asked for: colour or grey, the degree, terms and degree together.

use super::color::{DegreeChoice, PolynomialBasis};
use super::noise::F32_ROUNDING;
use super::regression::{self, Channel, with_bases};
use super::survey::{GreyTest, Survey};
use super::{FactorOptions, Factored};
use crate::material::{Material, MaterialHeader, Responses};
use crate::transport::rows::{RowView, gradient};
use crate::transport::{MatrixReader, RowBlock};
use crate::{FactorWarning, Result};
use std::ops::Range;

/// Rows looked at to choose the degree; its mean z² is then known to 1 in 50.
const DEGREE_ROWS: usize = 2048;
/// Rows looked at to tell colour from grey.
const GREY_ROWS: usize = 256;
/// Rows looked at to choose terms and degree for a goal.
const SAMPLE_ROWS: usize = 1024;
/// Roundings to f32 that count as noise of a response when the degree is chosen: of the response itself, g, f and h.
/// Those of h are common to all rows and do not average out, so that they must stay well below it.
const STORED_ROUNDINGS: f64 = 4.0;

/// Condition numbers of the colour fits of a `tucker` material, up to each degree: the median and the largest over
/// sampled rows, as the ratio of the pivots of the Legendre columns' triangular factor (a lower bound of the 2-norm's,
/// of its size).
///
/// # Errors
/// Those of the reader.
pub fn regression_conditions(reader: &MatrixReader, material: &Material, most: usize) -> Result<Vec<[f64; 2]>> {
    let mut found: Vec<Vec<f64>> = vec![Vec::new(); most + 1];
    let responses = Responses::new(material);
    for range in spread(reader, GREY_ROWS) {
        let block = reader.read_responses(range)?;
        let rows = regression::rows(&responses, &block, |_, channels| {
            PolynomialBasis::new(&channels[0].arguments, most).conditions(most)
        });
        rows.into_iter().for_each(|row| row.into_iter().zip(&mut found).for_each(|(c, all)| all.push(c)));
    }
    Ok(found
        .into_iter()
        .map(|mut all| {
            all.sort_by(f64::total_cmp);
            [all.get(all.len() / 2).copied().unwrap_or(1.0), all.last().copied().unwrap_or(1.0)]
        })
        .collect())
}

/// What decides on T, P and the model where they are not given.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Goal {
    /// The noise of the measurement: what is below it is not modelled.
    Noise,
    /// The fewest bytes that reach this `psnr_db` against the matrix.
    Psnr(f64),
    /// The highest `psnr_db` in so many bytes, counted as `bytes_f32`.
    Bytes(u64),
}

impl Goal {
    /// The finding that a material misses the goal; a hundredth of a decibel is not worth a word.
    pub(super) fn missed(self, material: &Material, psnr_db: Option<f64>) -> Option<FactorWarning> {
        match (self, psnr_db) {
            (Self::Psnr(asked), Some(db)) if db < asked - 0.01 => {
                Some(FactorWarning::GoalMissed { asked: format!("{asked} dB"), found: format!("{db:.2} dB") })
            }
            (Self::Bytes(asked), _) if material.bytes_f32() > asked => Some(FactorWarning::GoalMissed {
                asked: format!("{asked} bytes"),
                found: format!("{} bytes", material.bytes_f32()),
            }),
            _ => None,
        }
    }

    /// Whether `a` serves the goal better than `b`.
    pub(super) fn prefers(self, a: &Factored, b: &Factored) -> bool {
        let bytes = |f: &Factored| f.material.bytes_f32();
        let psnr = |f: &Factored| f.psnr_db.unwrap_or(f64::INFINITY);
        match self {
            Self::Noise => false,
            Self::Psnr(db) => match (psnr(a) >= db, psnr(b) >= db) {
                (true, true) => bytes(a) < bytes(b),
                (false, false) => psnr(a) > psnr(b),
                (reached, _) => reached,
            },
            Self::Bytes(most) => match (bytes(a) <= most, bytes(b) <= most) {
                (true, true) => psnr(a) > psnr(b),
                (false, false) => bytes(a) < bytes(b),
                (fits, _) => fits,
            },
        }
    }
}

/// About `count` rows of a matrix: whole blocks of neighbours, spread evenly.
pub(super) fn spread(reader: &MatrixReader, count: usize) -> Vec<Range<usize>> {
    let rows = reader.header().rows();
    // A row of the grid costs a chunk to read: few places, many neighbours.
    let (places, run) = (32.min(rows), count.div_ceil(32).max(1));
    let step = rows.div_ceil(places);
    (0..rows).step_by(step).map(|first| first..(first + run.min(step)).min(rows)).collect()
}

/// Whether the channels of some rows differ by no more than noise.
pub(super) fn looks_grey(reader: &MatrixReader) -> Result<bool> {
    let mut test = GreyTest::default();
    for range in spread(reader, GREY_ROWS) {
        let block = reader.read(range)?;
        (0..block.rows).for_each(|k| test.add(block.view(k)));
    }
    Ok(test.is_grey())
}

/// The degree that the noise supports, from rows spread over the matrix, and why.
pub(super) fn degree_by_noise(reader: &MatrixReader, material: &Material, most: usize) -> Result<(usize, String)> {
    let mut material = material.clone();
    let mut choice = DegreeChoice::new(most);
    material.header.intensity_range = [-1e-3, 1.0];
    let responses = Responses::new(&material);
    for range in spread(reader, DEGREE_ROWS) {
        let block = reader.read(range)?;
        let found =
            regression::rows(&responses, &block, |k, channels| row_significance(reader, channels, &block, k, most));
        found.iter().flatten().for_each(|z2| choice.add(z2));
    }
    let (degree, mean) = (choice.degree(), choice.mean());
    let reason = match mean.get(degree + 1) {
        Some(z2) => format!("degree {} explains no more than noise (mean z² {z2:.2}, 2 required)", degree + 1),
        // The sum that chose it ends above the one before.
        None => {
            format!("the highest allowed; it still explains more than noise (mean z² {:.2}, 2 required)", mean[degree])
        }
    };
    Ok((degree, reason))
}

/// z² of every degree for each channel of one row.
fn row_significance(
    reader: &MatrixReader,
    channels: &[Channel; 3],
    block: &RowBlock,
    k: usize,
    degree: usize,
) -> Vec<Vec<Option<f64>>> {
    let header = reader.header();
    let row = block.view(k);
    let sd_px = header.position_sd_mm[block.first + k] / header.pitch_mm;
    let sd_px = if sd_px.is_finite() { sd_px } else { 0.0 };
    let mut out = Vec::new();
    with_bases(channels, degree, |c, at, values, basis| {
        let all: Vec<f64> = row.response.iter().skip(c).step_by(3).map(|&v| f64::from(v)).collect();
        let valid: Vec<bool> = row.valid.iter().skip(c).step_by(3).map(|&v| v != 0).collect();
        let slopes = gradient(&all, &valid, header.window);
        let variance = |&at: &usize| {
            let steep = slopes[0][at] * slopes[0][at] + slopes[1][at] * slopes[1][at];
            let rounding = STORED_ROUNDINGS * F32_ROUNDING * all[at];
            (f64::from(row.variance[3 * at + c]) - sd_px * sd_px * steep).max(0.0) + rounding * rounding / 3.0
        };
        let variance: Vec<f64> = at.iter().map(variance).collect();
        let errors: Vec<Vec<f64>> = match sd_px > 0.0 {
            true => position_errors(slopes, &valid, header.window, sd_px),
            false => Vec::new(),
        };
        let errors: Vec<Vec<f64>> = errors.iter().map(|e| at.iter().map(|&at| e[at]).collect()).collect();
        out.push(basis.significance(values, &variance, &errors));
    });
    out
}

/// What an error δ of the lit point's place changes along a row, at one standard deviation of each kind: δ_x ∂_x,
/// δ_y ∂_y and, because a symmetric profile has no even part of those, the second order: (δ_x² − sd²)/2 ∂_xx, whose
/// standard deviation is sd²/√2, the same along y, and δ_x δ_y ∂_xy.
fn position_errors(slopes: [Vec<f64>; 2], valid: &[bool], window: [usize; 2], sd_px: f64) -> Vec<Vec<f64>> {
    let [xx, xy] = gradient(&slopes[0], valid, window);
    let [_, yy] = gradient(&slopes[1], valid, window);
    let [x, y] = slopes;
    let (first, second) = (sd_px, sd_px * sd_px);
    let square = second * std::f64::consts::FRAC_1_SQRT_2;
    let scaled = |v: Vec<f64>, by: f64| v.into_iter().map(|v| by * v).collect();
    vec![scaled(x, first), scaled(y, first), scaled(xx, square), scaled(yy, square), scaled(xy, second)]
}

/// Terms and degree for a goal.
pub(super) struct Chosen {
    pub terms: usize,
    pub degree: usize,
    pub why: String,
    /// Whether more terms would serve the goal.
    pub short: bool,
}

/// Chooses T and P of a `tucker` material for a goal, from the errors that sampled rows have at every T and P up to
/// those of `material`.
pub(super) fn terms_and_degree(
    reader: &MatrixReader,
    material: &Material,
    survey: &Survey,
    goal: Goal,
    options: &FactorOptions,
) -> Result<Chosen> {
    let degrees = options.degree.map_or(0..=options.max_degree, |p| p..=p);
    let most = material.header.terms;
    let (table, energy) = sampled_errors(reader, material, options.degree.unwrap_or(options.max_degree))?;
    // A sample's share of the whole.
    let share = if energy > 0.0 { survey.energy / energy } else { 0.0 };
    let header = &material.header;
    let bytes = |terms: usize, degree: usize| {
        MaterialHeader { terms, degree: Some(degree), ..header.clone() }.bytes_f32(material.is_shifted())
    };
    // Bytes are linear in both: three corners give them all.
    let (base, more_terms, more_degree) = (bytes(1, 0), bytes(2, 0), bytes(1, 1));
    let bytes = |t: usize, p: usize| base + (t - 1) as u64 * (more_terms - base) + p as u64 * (more_degree - base);
    let psnr = |t: usize, p: usize| survey.misfit(table[t - 1][p] * share).psnr_db().unwrap_or(f64::INFINITY);
    let all = || (1..=most).flat_map(|t| degrees.clone().map(move |p| (t, p)));
    let best = |a: &(usize, usize), b: &(usize, usize)| psnr(a.0, a.1).total_cmp(&psnr(b.0, b.1));
    let smallest = |a: &(usize, usize)| bytes(a.0, a.1);
    let found = match goal {
        Goal::Psnr(db) => {
            // A sample is not the whole: a tenth of a decibel in hand.
            let reached = all().filter(|&(t, p)| psnr(t, p) >= db + 0.1).min_by_key(smallest);
            reached.map(|at| (at, format!("the fewest bytes that reach {db} dB"), false)).or_else(|| {
                let top = all().max_by(best)?;
                Some((
                    top,
                    format!(
                        "{db} dB not reached: colour by a polynomial is limited to about {:.1} dB",
                        psnr(top.0, top.1)
                    ),
                    true,
                ))
            })
        }
        Goal::Bytes(limit) => {
            let fits = all().filter(|&(t, p)| bytes(t, p) <= limit).max_by(best);
            fits.map(|at| (at, format!("the best in {limit} bytes"), at.0 == most)).or_else(|| {
                Some((all().min_by_key(smallest)?, format!("the smallest takes more than {limit} bytes"), false))
            })
        }
        Goal::Noise => None,
    };
    let ((terms, degree), why, short) = found.unwrap_or(((1, 0), String::new(), false));
    Ok(Chosen { terms, degree, why, short })
}

/// Σ (R̂−R)² over sampled rows for every T and P, [T − 1][P], and Σ R² of them.
fn sampled_errors(reader: &MatrixReader, material: &Material, degree: usize) -> Result<(Vec<Vec<f64>>, f64)> {
    let terms = material.header.terms;
    let (mut table, mut energy) = (vec![vec![0.0; degree + 1]; terms], 0.0);
    let blocks: Vec<RowBlock> =
        spread(reader, SAMPLE_ROWS).into_iter().map(|range| reader.read_responses(range)).collect::<Result<_>>()?;
    let squares = |row: RowView<'_>| row.response.iter().map(|&v| f64::from(v).powi(2)).sum::<f64>();
    energy += blocks.iter().flat_map(|b| (0..b.rows).map(|k| squares(b.view(k)))).sum::<f64>();
    let mut fewer = material.clone();
    for t in 1..=terms {
        // Fewer terms are the first of them: the others weigh nothing.
        fewer.weights = material.weights.iter().enumerate().map(|(j, &g)| if j < t { g } else { 0.0 }).collect();
        // The range of the fit itself, as far as these rows tell: nothing is clamped.
        let ranges = blocks.iter().map(|b| b.first..b.first + b.rows);
        fewer.header.intensity_range = regression::intensity_range(&fewer, ranges);
        let responses = Responses::new(&fewer);
        for block in &blocks {
            let rows = regression::rows(&responses, block, |_, channels| {
                let mut errors = vec![0.0; degree + 1];
                with_bases(channels, degree, |_, _, values, basis| {
                    let of = basis.errors_by_degree(values, degree);
                    errors.iter_mut().zip(of).for_each(|(sum, e)| *sum += e);
                });
                errors
            });
            rows.iter().for_each(|row| table[t - 1].iter_mut().zip(row).for_each(|(sum, e)| *sum += e));
        }
    }
    Ok((table, energy))
}

#[cfg(test)]
mod tests;
