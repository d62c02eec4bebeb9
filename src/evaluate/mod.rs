//! Evaluate: the measures of `docs/metrics.md`, a candidate matrix or material against a reference matrix.

mod noise;
mod reciprocity;
mod sums;

use crate::geometry::Point;
use crate::material::{Exitance, FIXED_SET, Quadrature, Source, lit_area_of, relight, splat};
use crate::progress::Progress;
use crate::transport::{MatrixHeader, MatrixReader, RowBlock};
use crate::{Error, Result};
pub use noise::{NoiseLevel, noise_level};
use rayon::prelude::*;
use reciprocity::Reciprocity;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use sums::SumErrors;

/// Entries above this share of their row's largest reference entry count in `log_rmse`.
const LOG_ABOVE: f64 = 1e-4;
/// What a candidate entry is raised to before its logarithm is taken, as a share of the same peak.
const LOG_FLOOR: f64 = 1e-6;

/// Every measure of a candidate against a reference; `None` where it is not defined, see `docs/metrics.md`.
///
/// An entry counts when both the candidate and the reference measured it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Measures {
    /// Entries compared, over all channels.
    pub entries: u64,
    /// ‖R̂−R‖ / ‖R‖; `None` when the reference is zero.
    pub rel_rmse: Option<f64>,
    /// 20 log₁₀(max R / RMSE), dB; `None` when the two are equal or the reference is nowhere positive.
    pub psnr_db: Option<f64>,
    /// RMS of ln R̂ − ln R over entries above 1e-4 of their row's peak.
    pub log_rmse: Option<f64>,
    /// PSNR of the slab under the fixed set of lights, dB; `None` as for `psnr_db`.
    pub relit_psnr_db: Option<f64>,
    /// Every stored number of the candidate as 4 bytes.
    pub bytes_f32: u64,
    /// Bytes of the candidate on disk.
    pub bytes_file: u64,
    /// Largest albedo of a row of the candidate, per channel; a window sees only a part of it.
    pub albedo_max: [f64; 3],
    /// Mean albedo of the candidate's rows, per channel.
    pub albedo_mean: [f64; 3],
    /// Rows of the candidate with an albedo above one in any channel.
    pub albedo_violations: u64,
    /// RMS of R(a,b) − R(b,a) over the RMS of their mean, in the candidate; `None` when no two lit points see each
    /// other.
    pub reciprocity: Option<f64>,
    /// Share of the candidate's entries within two of its standard deviations of the reference; `None` when it has no
    /// variance. 0.954 is expected of a normal error.
    pub coverage_2sigma: Option<f64>,
    /// The same of the sums of the rows' channels, by what the candidate says that samples of a row have in common.
    pub coverage_2sigma_rows: Option<f64>,
    /// The same of the numbers of the mean row, by what it says that rows have in common.
    pub coverage_2sigma_profile: Option<f64>,
    /// Relative error of the mean albedo, per channel; `None` for a candidate without variance.
    pub albedo_bias: Option<[f64; 3]>,
    /// The standard deviation of that error by what the candidate says.
    pub albedo_bias_sd: Option<[f64; 3]>,
    /// RMS length of the difference of drift between shots of one name, camera px.
    pub drift_rms_px: Option<f64>,
    /// RMS distance between the candidate's lit points and the reference's, mm.
    pub position_rms_mm: f64,
    /// The same in camera px, when the candidate's or the reference's provenance says how many make a millimetre.
    pub position_rms_px: Option<f64>,
}

/// Sums over entries, of one row or of many.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    entries: u64,
    error: f64,
    size: f64,
    peak: f64,
    log_error: f64,
    log_entries: u64,
    covered: u64,
    with_variance: u64,
    albedo: [f64; 3],
}

/// Compares a candidate with a reference matrix. Reads both once, in blocks.
///
/// # Errors
/// [`Error::Mismatch`] when points, window or pitch differ; those of the readers.
pub fn evaluate(candidate: &Source, reference: &MatrixReader, progress: &Progress) -> Result<Measures> {
    let shape = candidate.shape();
    check(candidate, reference)?;
    let header = reference.header();
    let reference_shape = reference.shape();
    let area = lit_area_of(&reference_shape, reference.path())?;
    // Both are lit alike, on the reference's area, each from where its own lit points are.
    let [own, theirs] = [Quadrature::new(&area, &shape), Quadrature::new(&area, &reference_shape)];
    let fluxes = FIXED_SET.iter().map(|light| Ok(light.flux(&theirs)?)).collect::<Result<Vec<_>>>()?;
    let black = || vec![Exitance::new(area.canvas); fluxes.len()];
    // What leaves a material between its lit points is for its exit map to say; a matrix is its rows.
    let mut lit = match candidate {
        Source::Matrix(_) => black(),
        Source::Material(..) => relight(candidate, &own, &fluxes, progress)?,
    };
    let mut lit_reference = black();
    let mut reciprocity = Reciprocity::new(&shape);
    let (mut all, mut albedo) = (Sums::default(), Albedo::default());
    let mut positions = (0.0, 0_u64);
    let mut sum_errors = matrix_header(candidate).map(SumErrors::new);

    let stage = progress.stage("evaluate", shape.rows());
    for rows in reference.blocks() {
        let first = rows.start;
        let (mut a, mut b) = (candidate.read(rows.clone())?, reference.read(rows)?);
        let unmeasured = unmeasured(candidate, &a, &b);
        keep_common(&mut a, &mut b);
        let sums: Vec<Sums> =
            (0..a.rows).into_par_iter().map(|k| compare(&a, &b, k, shape.pitch_mm, candidate)).collect();
        for (k, row) in sums.iter().enumerate().filter(|(_, s)| s.entries > 0) {
            all.add(row);
            albedo.add(row.albedo);
            let [p, q] = [shape.lit_mm[first + k], header.lit_mm[first + k]];
            positions.0 += (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2);
            positions.1 += 1;
        }
        if let Some(sum_errors) = &mut sum_errors {
            sum_errors.add(&a, &b);
        }
        reciprocity.add(&a, &shape);
        match unmeasured {
            None => splat(&mut lit, &a, shape.window, &own, &fluxes),
            Some(rest) => splat(&mut lit_reference, &rest, shape.window, &own, &fluxes),
        }
        splat(&mut lit_reference, &b, shape.window, &theirs, &fluxes);
        stage.advance(a.rows);
    }
    let position_rms_mm = (positions.0 / positions.1.max(1) as f64).sqrt();
    let candidate_header = matrix_header(candidate);
    let albedo_bias = sum_errors.as_ref().filter(|_| all.with_variance > 0).and_then(SumErrors::albedo_bias);
    Ok(Measures {
        entries: all.entries,
        rel_rmse: (all.size > 0.0).then(|| (all.error / all.size).sqrt()),
        psnr_db: psnr(all.peak, all.error, all.entries),
        log_rmse: (all.log_entries > 0).then(|| (all.log_error / all.log_entries as f64).sqrt()),
        relit_psnr_db: relit_psnr(&lit, &lit_reference),
        bytes_f32: candidate.bytes_f32(),
        bytes_file: candidate.bytes_file()?,
        albedo_max: albedo.max,
        albedo_mean: albedo.sum.map(|s| s / albedo.rows.max(1) as f64),
        albedo_violations: albedo.violations,
        reciprocity: reciprocity.relative_rms(),
        coverage_2sigma: (all.with_variance > 0).then(|| all.covered as f64 / all.with_variance as f64),
        coverage_2sigma_rows: sum_errors.as_ref().and_then(SumErrors::rows_coverage),
        coverage_2sigma_profile: sum_errors.as_ref().and_then(SumErrors::profile_coverage),
        albedo_bias: albedo_bias.map(|b| b.map(|[bias, _]| bias)),
        albedo_bias_sd: albedo_bias.map(|b| b.map(|[_, sd]| sd)),
        drift_rms_px: candidate_header.and_then(|h| drift_rms(h, header)),
        position_rms_mm,
        position_rms_px: candidate_header
            .and_then(|h| h.camera_px_per_mm)
            .or(header.camera_px_per_mm)
            .filter(|v| v.is_finite() && *v > 0.0)
            .map(|scale| scale * position_rms_mm),
    })
}

fn matrix_header(source: &Source) -> Option<&MatrixHeader> {
    match source {
        Source::Matrix(reader) => Some(reader.header()),
        Source::Material(..) => None,
    }
}

fn check(candidate: &Source, reference: &MatrixReader) -> Result<()> {
    let (a, b) = (candidate.shape(), reference.header());
    let mismatch = |field: &str, a_value: String, b_value: String| {
        Err(Error::Mismatch {
            a: candidate.path().to_path_buf(),
            b: reference.path().to_path_buf(),
            field: field.to_owned(),
            a_value,
            b_value,
        })
    };
    if a.points != b.points {
        return mismatch("points", format!("{:?}", a.points), format!("{:?}", b.points));
    }
    if a.window != b.window {
        return mismatch("window", format!("{:?}", a.window), format!("{:?}", b.window));
    }
    // Both are settings, not measurements: they differ by how they were written, if at all.
    if (a.pitch_mm - b.pitch_mm).abs() > 1e-6 * b.pitch_mm {
        return mismatch("pitch_mm", a.pitch_mm.to_string(), b.pitch_mm.to_string());
    }
    Ok(())
}

/// What a material says where the reference was not measured: that is no error, so it is the reference's, too. `None`
/// for a matrix.
fn unmeasured(candidate: &Source, a: &RowBlock, b: &RowBlock) -> Option<RowBlock> {
    let Source::Material(..) = candidate else { return None };
    let valid = b.valid.iter().map(|&v| 1 - v).collect();
    Some(RowBlock { first: a.first, rows: a.rows, response: a.response.clone(), variance: Vec::new(), valid })
}

/// Marks entries that either did not measure as invalid in both, and makes them zero.
fn keep_common(a: &mut RowBlock, b: &mut RowBlock) {
    let entries = a.valid.iter_mut().zip(&mut b.valid).zip(a.response.iter_mut().zip(&mut b.response));
    for ((va, vb), (ra, rb)) in entries {
        if *va == 0 || *vb == 0 {
            (*va, *vb, *ra, *rb) = (0, 0, 0.0, 0.0);
        }
    }
}

fn compare(a: &RowBlock, b: &RowBlock, k: usize, pitch_mm: f64, candidate: &Source) -> Sums {
    let (a, b) = (a.view(k), b.view(k));
    let measured = matches!(candidate, Source::Matrix(_));
    let peak = b.response.iter().copied().fold(0.0_f32, f32::max);
    let peak = f64::from(peak);
    let mut sums = Sums { peak, ..Sums::default() };
    for s in (0..b.response.len()).filter(|&s| b.valid[s] != 0) {
        let (x, y) = (f64::from(a.response[s]), f64::from(b.response[s]));
        sums.entries += 1;
        sums.error += (x - y) * (x - y);
        sums.size += y * y;
        sums.albedo[s % 3] += x * pitch_mm * pitch_mm;
        if y > LOG_ABOVE * peak {
            sums.log_error += (x.max(LOG_FLOOR * peak) / y).ln().powi(2);
            sums.log_entries += 1;
        }
        let variance = f64::from(a.variance[s]);
        if measured && variance > 0.0 {
            sums.with_variance += 1;
            sums.covered += u64::from((x - y).abs() <= 2.0 * variance.sqrt());
        }
    }
    sums
}

impl Sums {
    fn add(&mut self, row: &Self) {
        self.entries += row.entries;
        self.error += row.error;
        self.size += row.size;
        self.peak = self.peak.max(row.peak);
        self.log_error += row.log_error;
        self.log_entries += row.log_entries;
        self.covered += row.covered;
        self.with_variance += row.with_variance;
    }
}

#[derive(Debug, Default)]
struct Albedo {
    max: [f64; 3],
    sum: [f64; 3],
    rows: u64,
    violations: u64,
}

impl Albedo {
    fn add(&mut self, row: [f64; 3]) {
        for c in 0..3 {
            // Noise can make all of a dark matrix's albedos negative: the largest is then below zero, too.
            self.max[c] = if self.rows == 0 { row[c] } else { self.max[c].max(row[c]) };
            self.sum[c] += row[c];
        }
        self.rows += 1;
        self.violations += u64::from(row.iter().any(|&a| a > 1.0));
    }
}

/// 20 log₁₀(peak / RMSE).
fn psnr(peak: f64, error: f64, entries: u64) -> Option<f64> {
    let rmse = (error / entries.max(1) as f64).sqrt();
    (peak > 0.0 && rmse > 0.0).then(|| 20.0 * (peak / rmse).log10())
}

fn relit_psnr(a: &[Exitance], b: &[Exitance]) -> Option<f64> {
    let (mut error, mut entries, mut peak) = (0.0, 0_u64, 0.0_f64);
    for (a, b) in a.iter().zip(b) {
        for (a, b) in a.planes.iter().flatten().zip(b.planes.iter().flatten()) {
            error += (a - b) * (a - b);
            peak = peak.max(*b);
            entries += 1;
        }
    }
    psnr(peak, error, entries)
}

fn drift_rms(a: &MatrixHeader, b: &MatrixHeader) -> Option<f64> {
    let by_name: BTreeMap<&str, Point> = b.shots.iter().map(|s| (s.name.as_str(), s.drift_px)).collect();
    let squares: Vec<f64> = a
        .shots
        .iter()
        .filter_map(|s| by_name.get(s.name.as_str()).map(|d| (s.drift_px, *d)))
        .map(|(p, q)| (p[0] - q[0]).powi(2) + (p[1] - q[1]).powi(2))
        .collect();
    (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
}

#[cfg(test)]
mod tests;
