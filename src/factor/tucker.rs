//! The paper's model (`Kurt2013`): peak shift, normalization, error modelling of the intensity, polynomial colour.

use super::color::{DegreeChoice, PolynomialBasis};
use super::fill::Basis;
use super::noise::F32_ROUNDING;
use super::survey::{Normalized, Survey, survey};
use super::svd::{Backend, LowRank, choose, left_vectors, low_rank};
use crate::material::{Material, MaterialHeader, Model, legendre};
use crate::progress::Progress;
use crate::transport::rows::{RowView, gradient};
use crate::transport::{MatrixReader, RowBlock};
use crate::{Error, Result};
use rayon::prelude::*;

/// Singular values kept beyond those in use, for the report's plot.
const SPECTRUM: usize = 64;
/// Rows looked at to choose the degree; its mean z² is then known to 1 in 50.
const DEGREE_ROWS: usize = 2048;
/// Roundings to f32 that count as noise of a response when the degree is chosen: of the response itself, g, f and h.
/// Those of h are common to all rows and do not average out, so that they must stay well below it.
const STORED_ROUNDINGS: f64 = 4.0;

/// How to factor.
#[derive(Debug, Clone, PartialEq, serde::Serialize)]
pub struct Options {
    /// T; `None`: as many as exceed the noise. Never more than the matrix has.
    pub terms: Option<usize>,
    /// P, 0 to 15; `None`: as the noise supports.
    pub degree: Option<usize>,
    /// Whether rows are moved so that their peaks coincide; the paper does.
    pub peak_shift: bool,
    /// How far a peak may be from its lit point, in samples; `None`: a quarter of the window. Beyond it the brightest
    /// sample is rather another dot or noise than where this dot's light leaves.
    pub max_shift: Option<usize>,
    /// The most terms that are chosen when not given; 40, well above the paper's 15.
    pub max_terms: usize,
    /// The highest degree that is chosen when not given; 15, twice the paper's 7.
    pub max_degree: usize,
    /// How often samples that a row did not measure are estimated anew from the factors; 2, after which the
    /// spectrum above the noise no longer changes visibly. Not used when nothing is missing.
    pub fill_rounds: usize,
    /// How the truncated SVD is computed; `None`: by size.
    pub backend: Option<Backend>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            terms: None,
            degree: None,
            peak_shift: true,
            max_shift: None,
            max_terms: 40,
            max_degree: 15,
            fill_rounds: 2,
            backend: None,
        }
    }
}

/// A material and what the factorization says about itself.
#[derive(Debug, Clone)]
pub struct Factored {
    /// The material.
    pub material: Material,
    /// ‖R̂−R‖ / ‖R‖ over the valid entries of the matrix it was made from.
    pub rel_rmse: f64,
    /// Why it has the terms and the degree that it has, one line.
    pub choice: String,
    /// How the SVD was computed.
    pub backend: Backend,
}

/// Factors a matrix.
///
/// Reads it about six times, in blocks; memory is bounded by the block and by the offsets of one row (their square
/// when [`Backend::Gram`] is used).
///
/// # Errors
/// [`Error::Setting`] for options out of range; those of the reader; [`Error::NotFinite`] when a response is so
/// large that a coefficient does not fit an f32.
pub fn factor(reader: &MatrixReader, options: &Options, progress: &Progress) -> Result<Factored> {
    options.check()?;
    let header = reader.header();
    let survey = survey(reader, options, &progress.stage("survey", header.rows()))?;
    let rows = header.rows();
    let columns = survey.layout.len();
    let backend = options.backend.unwrap_or_else(|| choose(rows, columns));

    let (low_rank, terms, basis) = decompose(reader, &survey, options, backend, progress)?;
    let mut material = intensity_factors(reader, &survey, &low_rank, terms, basis, progress)?;
    let (degree, why_degree) = match options.degree {
        Some(p) => (p, "as asked".to_owned()),
        None => choose_degree(reader, &material, options, progress)?,
    };
    let rel_rmse = color(reader, &mut material, degree, progress)?;

    let level = material.header.noise_level;
    let choice =
        format!("terms {terms}: {}; degree {degree}: {why_degree}", why_terms(options, &low_rank, terms, level));
    material.header.provenance = serde_json::json!({
        "version": env!("CARGO_PKG_VERSION"),
        "options": options,
        "backend": backend,
        "choice": choice,
        "rel_rmse": rel_rmse,
        "matrix": header.provenance,
    });
    Ok(Factored { material, rel_rmse, choice, backend })
}

impl Options {
    /// Refuses values that make no material.
    ///
    /// # Errors
    /// [`Error::Setting`] naming the option as typed.
    pub fn check(&self) -> Result<()> {
        let refuse = |setting, expected: &str, found: usize| {
            Err(Error::Setting { setting, expected: expected.into(), found: found.to_string() })
        };
        match self {
            Self { terms: Some(0), .. } => refuse("--terms", "at least 1", 0),
            Self { max_terms: 0, .. } => refuse("--max-terms", "at least 1", 0),
            Self { degree: Some(p), .. } if *p > 15 => refuse("--degree", "0 to 15", *p),
            Self { max_degree: p, .. } if *p > 15 => refuse("--max-degree", "0 to 15", *p),
            _ => Ok(()),
        }
    }
}

/// The truncated SVD of the normalized rows, repeated while missing samples are estimated from it.
fn decompose(
    reader: &MatrixReader,
    survey: &Survey,
    options: &Options,
    backend: Backend,
    progress: &Progress,
) -> Result<(LowRank, usize, Basis)> {
    let (rows, columns) = (survey.placements.len(), survey.layout.len());
    let rounds = if survey.complete { 0 } else { options.fill_rounds };
    let wanted = options.terms.unwrap_or(options.max_terms).max(SPECTRUM);
    let passes = if backend == Backend::Subspace { 5 } else { 1 };
    let stage = progress.stage("factor", rows * passes * (rounds + 1));
    let mut basis = Basis::mean(survey.mean.clone());
    for round in 0.. {
        let source = Normalized { reader, survey, basis: basis.clone(), stage: &stage };
        let low_rank = low_rank(&source, wanted, backend)?;
        let rank = low_rank.singular_values.iter().take_while(|&&s| s > F32_ROUNDING * low_rank.singular_values[0]);
        let most = rank.count().max(1);
        let chosen =
            options.terms.unwrap_or_else(|| survey.noise.terms(&low_rank.singular_values).min(options.max_terms));
        let terms = chosen.min(most);
        if round == rounds {
            return Ok((low_rank, terms, basis));
        }
        basis = Basis::factors(&low_rank, terms, rows, columns, survey.noise.mean);
    }
    Err(Error::internal("the factorization ended without a result"))
}

fn why_terms(options: &Options, low_rank: &LowRank, terms: usize, level: f64) -> String {
    let next = low_rank.singular_values.get(terms);
    match (options.terms, next) {
        (Some(asked), _) if asked > terms => format!("{asked} were asked for and the rows have no more"),
        (Some(_), _) => "as asked".to_owned(),
        (None, Some(&next)) if next > level => {
            format!(
                "the most allowed, singular values {} … are still above the noise ({next:.3e} > {level:.3e})",
                terms + 1
            )
        }
        (None, Some(&next)) => {
            format!("singular values {} … are below the noise ({next:.3e} < {level:.3e})", terms + 1)
        }
        (None, None) => format!("the rows have no more, noise {level:.3e}"),
    }
}

/// A second pass: f_j for every row, and the range of the normalized intensity where it was measured.
fn intensity_factors(
    reader: &MatrixReader,
    survey: &Survey,
    low_rank: &LowRank,
    terms: usize,
    basis: Basis,
    progress: &Progress,
) -> Result<Material> {
    let header = reader.header();
    let columns = survey.layout.len();
    let stage = progress.stage("incident", header.rows());
    let source = Normalized { reader, survey, basis, stage: &stage };
    let to_f32 = |v: &[f64]| v.iter().map(|&v| v as f32).collect::<Vec<_>>();
    let mut material = Material {
        header: MaterialHeader {
            model: Model::Tucker,
            points: header.points,
            window: header.window,
            pitch_mm: header.pitch_mm,
            lit_pitch_mm: header.lit_pitch_mm,
            extended: survey.layout.extended,
            terms,
            incident_planes: 1,
            offset_planes: 1,
            profile: false,
            degree: Some(0),
            intensity_range: [0.0, 1.0],
            singular_values: low_rank.singular_values.clone(),
            noise_level: survey.noise.threshold(&low_rank.singular_values),
            warnings: header.warnings.iter().chain(&survey.warnings).cloned().collect(),
            provenance: serde_json::Value::Null,
        },
        lit_mm: header.lit_mm.clone(),
        weights: to_f32(&low_rank.singular_values[..terms]),
        incident_factors: Vec::with_capacity(header.rows() * terms),
        offset_factors: to_f32(&low_rank.vectors[..terms * columns]),
        profile: Vec::new(),
        color_coefficients: Vec::new(),
        shift: survey.placements.iter().map(|p| p.shift).collect(),
    };
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    reader.for_each_block(|block| {
        let (values, measured) = source.block(&block)?;
        material.incident_factors.extend(to_f32(&left_vectors(&values, low_rank, terms, columns)));
        let ranges: Vec<[f64; 2]> = (0..block.rows)
            .into_par_iter()
            .map(|k| {
                let row = material.plane_row(0, block.first + k);
                let known = row.iter().zip(&measured[k * columns..]).filter(|(_, m)| **m).map(|(v, _)| *v);
                known.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)])
            })
            .collect();
        for range in ranges {
            (low, high) = (low.min(range[0]), high.max(range[1]));
        }
        stage.advance(block.rows);
        Ok(())
    })?;
    if low < high {
        // Rounded outwards: arguments are clamped to the range, and none that was fitted may be.
        material.header.intensity_range = [(low as f32).next_down(), (high as f32).next_up()];
    }
    Ok(material)
}

/// Arguments and values of one channel of a row, where it was measured.
struct Channel {
    /// Window indices.
    at: Vec<usize>,
    /// Arguments of the polynomial.
    arguments: Vec<f64>,
    /// R_c, mm⁻².
    values: Vec<f64>,
}

fn channels(material: &Material, index: usize, row: RowView<'_>) -> [Channel; 3] {
    let intensity = material.plane_row(0, index);
    let [low, high] = material.header.intensity_range.map(f64::from);
    let mut out = std::array::from_fn(|_| Channel { at: Vec::new(), arguments: Vec::new(), values: Vec::new() });
    let shift = material.shift.get(index).copied().unwrap_or_default();
    material.header.layout().for_each(shift, |k, e| {
        for (c, channel) in out.iter_mut().enumerate() {
            if row.valid[3 * k + c] != 0 {
                channel.at.push(k);
                channel.arguments.push(legendre::argument(intensity[e], low, high));
                channel.values.push(f64::from(row.response[3 * k + c]));
            }
        }
    });
    out
}

/// Calls `each` with the polynomial basis of every channel, made once when the channels share their samples.
fn with_bases(channels: &[Channel; 3], degree: usize, mut each: impl FnMut(usize, &Channel, &PolynomialBasis)) {
    let mut basis = PolynomialBasis::new(&channels[0].arguments, degree);
    for (c, channel) in channels.iter().enumerate() {
        if c > 0 && channel.at != channels[c - 1].at {
            basis = PolynomialBasis::new(&channel.arguments, degree);
        }
        each(c, channel, &basis);
    }
}

/// The degree that the noise supports, from rows spread over the matrix.
fn choose_degree(
    reader: &MatrixReader,
    material: &Material,
    options: &Options,
    progress: &Progress,
) -> Result<(usize, String)> {
    let header = reader.header();
    let stride = header.rows().div_ceil(DEGREE_ROWS).max(1);
    let stage = progress.stage("degree", header.rows());
    let mut choice = DegreeChoice::new(options.max_degree);
    reader.for_each_block(|block| {
        let picked: Vec<usize> = (0..block.rows).filter(|k| (block.first + k) % stride == 0).collect();
        let found: Vec<Vec<Vec<Option<f64>>>> =
            picked.into_par_iter().map(|k| row_significance(reader, material, &block, k, options.max_degree)).collect();
        found.iter().flatten().for_each(|z2| choice.add(z2));
        stage.advance(block.rows);
        Ok(())
    })?;
    let degree = choice.degree();
    let mean = choice.mean();
    let reason = match mean.get(degree + 1) {
        Some(z2) => format!("degree {} explains no more than noise (mean z² {z2:.2}, 2 needed)", degree + 1),
        // The sum that chose it ends above the one before.
        None => {
            format!("the highest allowed, it still explains more than noise (mean z² {:.2}, 2 needed)", mean[degree])
        }
    };
    Ok((degree, reason))
}

/// z² of every degree for each channel of one row.
fn row_significance(
    reader: &MatrixReader,
    material: &Material,
    block: &RowBlock,
    k: usize,
    degree: usize,
) -> Vec<Vec<Option<f64>>> {
    let header = reader.header();
    let row = block.view(k);
    let sd_px = header.position_sd_mm[block.first + k] / header.pitch_mm;
    let sd_px = if sd_px.is_finite() { sd_px } else { 0.0 };
    let mut out = Vec::new();
    with_bases(&channels(material, block.first + k, row), degree, |c, channel, basis| {
        let all: Vec<f64> = row.response.iter().skip(c).step_by(3).map(|&v| f64::from(v)).collect();
        let valid: Vec<bool> = row.valid.iter().skip(c).step_by(3).map(|&v| v != 0).collect();
        let slopes = gradient(&all, &valid, header.window);
        let variance = |&at: &usize| {
            let steep = slopes[0][at] * slopes[0][at] + slopes[1][at] * slopes[1][at];
            let rounding = STORED_ROUNDINGS * F32_ROUNDING * all[at];
            (f64::from(row.variance[3 * at + c]) - sd_px * sd_px * steep).max(0.0) + rounding * rounding / 3.0
        };
        let variance: Vec<f64> = channel.at.iter().map(variance).collect();
        let errors: Vec<Vec<f64>> = match sd_px > 0.0 {
            true => position_errors(slopes, &valid, header.window, sd_px),
            false => Vec::new(),
        };
        let errors: Vec<Vec<f64>> = errors.iter().map(|e| channel.at.iter().map(|&at| e[at]).collect()).collect();
        out.push(basis.significance(&channel.values, &variance, &errors));
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

/// Fits β and measures what the whole material leaves: ‖R̂−R‖ / ‖R‖ over valid entries, 0 when all are zero.
fn color(reader: &MatrixReader, material: &mut Material, degree: usize, progress: &Progress) -> Result<f64> {
    let stage = progress.stage("color", reader.header().rows());
    material.header.degree = Some(degree);
    let (mut error, mut size) = (0.0, 0.0);
    reader.for_each_block(|block| {
        let fits: Vec<Vec<f32>> = (0..block.rows)
            .into_par_iter()
            .map(|k| {
                let mut beta = Vec::with_capacity(3 * (degree + 1));
                with_bases(&channels(material, block.first + k, block.view(k)), degree, |_, channel, basis| {
                    beta.extend(basis.fit(&channel.values, degree).into_iter().map(|b| b as f32));
                });
                beta
            })
            .collect();
        for (k, beta) in fits.into_iter().enumerate() {
            if let Some(p) = beta.iter().position(|b| !b.is_finite()) {
                return Err(Error::NotFinite {
                    path: reader.path().to_path_buf(),
                    field: "color_coefficients",
                    found: f64::from(beta[p]),
                    at: format!("row {}", block.first + k),
                });
            }
            material.color_coefficients.extend(beta);
        }
        let sums: Vec<[f64; 2]> =
            (0..block.rows).into_par_iter().map(|k| residual(material, block.first + k, block.view(k))).collect();
        for [e, s] in sums {
            (error, size) = (error + e, size + s);
        }
        stage.advance(block.rows);
        Ok(())
    })?;
    Ok(if size > 0.0 { (error / size).sqrt() } else { 0.0 })
}

fn residual(material: &Material, index: usize, row: RowView<'_>) -> [f64; 2] {
    let fit = material.evaluate_row(index);
    let valid = fit.iter().zip(row.response).zip(row.valid).filter(|(_, v)| **v != 0);
    valid.fold([0.0, 0.0], |[error, size], ((&a, &b), _)| {
        let (a, b) = (f64::from(a), f64::from(b));
        [error + (a - b) * (a - b), size + b * b]
    })
}
