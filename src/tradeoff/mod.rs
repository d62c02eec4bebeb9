//! Trade-off: what time, memory, bytes and accuracy cost each other on one matrix, measured.
//!
//! Every point of the table is a factorization that was run, saved, loaded and compared with the matrix: nothing is
//! extrapolated.

mod marks;
mod page;

use crate::evaluate::{NoiseLevel, evaluate, noise_level};
use crate::factor::{Backend, FactorOptions, Factored, factor, regression_conditions};
use crate::material::{self, Material, Model, Precision, Source, coded, legendre};
use crate::output::ScratchFolder;
use crate::progress::Progress;
use crate::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row};
use crate::{Error, Result};
use marks::{mark_pareto, mark_recommended};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::time::Instant;

pub use page::{csv, html};

/// Numbers of terms that are tried.
const TERMS: [usize; 8] = [1, 2, 4, 8, 15, 25, 40, 60];
/// Degrees that are tried with `tucker`.
const DEGREES: [usize; 4] = [1, 3, 7, 15];
/// Errors that coding may add, relative to the material.
const CODED_ERRORS: [f64; 6] = [0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4];
/// That of a coded default.
const DEFAULT_ERROR: f64 = CODED_ERRORS[3];
/// The published setting, on which back ends are compared.
const PUBLISHED: (usize, usize) = (15, 7);
/// Side of the block of lit points that a quick look takes.
const QUICK_POINTS: usize = 24;
/// Entries of a matrix up to which a full SVD is worth its time here.
const FULL_ENTRIES: usize = 20_000_000;

/// What to try.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TradeoffOptions {
    /// Only a block of 24 × 24 lit points in the middle, and fewer settings.
    pub quick: bool,
    /// Memory for the rows, see [`FactorOptions::memory_bytes`].
    pub memory_bytes: Option<u64>,
}

/// One factorization, stored one way.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TradePoint {
    /// The model.
    pub model: Model,
    /// How the SVD was computed.
    pub backend: Backend,
    /// T.
    pub terms: usize,
    /// P, when the model has one.
    pub degree: Option<usize>,
    /// K, when channels share offset maps.
    pub shared_maps: Option<usize>,
    /// How its numbers are stored.
    pub precision: Precision,
    /// Factoring, from the store on disk to the material in memory; for coded ones with the coding.
    pub secs: f64,
    /// Peak of the process's memory during it, bytes; `None` where the system does not tell. Allocators keep some of
    /// what earlier factorizations used.
    pub peak_bytes: Option<u64>,
    /// `bytes_f32`, half of it for f16, the whole file when coded.
    pub bytes: u64,
    /// The whole file.
    pub bytes_file: u64,
    /// ‖R̂−R‖ / ‖R‖.
    pub rel_rmse: Option<f64>,
    /// See `docs/metrics.md`.
    pub psnr_db: Option<f64>,
    /// See `docs/metrics.md`.
    pub log_rmse: Option<f64>,
    /// See `docs/metrics.md`.
    pub relit_psnr_db: Option<f64>,
    /// Whether no other point has fewer bytes and a higher `psnr_db`.
    pub pareto: bool,
    /// Whether it is what the program makes when nothing is asked: plain, and coded.
    pub default: bool,
    /// Whether it is the smallest of those whose `rel_rmse` and `log_rmse` are no more than those of the plain default
    /// and of the noise together.
    pub recommended: bool,
}

/// What was measured.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Tradeoff {
    /// Where the matrix is.
    pub matrix: PathBuf,
    /// Lit points that were looked at, along x and y.
    pub points_looked_at: [usize; 2],
    /// Lit points of the matrix.
    pub points: [usize; 2],
    /// Samples of a window.
    pub window: [usize; 2],
    /// Bytes of the looked-at responses as f32.
    pub matrix_bytes: u64,
    /// One plain read of the looked-at responses through the store, seconds.
    pub read_secs: f64,
    /// What the noise of the looked-at responses has of the measures; `None` where the matrix has no variance.
    pub noise: Option<NoiseLevel>,
    /// Every point, in the order in which they were run.
    pub measured: Vec<TradePoint>,
    /// Median and largest condition number of the colour fits of the published `tucker` setting, per degree from 0.
    pub regression_conditions: Vec<[f64; 2]>,
}

/// Runs the table.
///
/// # Errors
/// Those of the reader, of [`factor`], of [`coded::encode`] and of writing temporary files.
pub fn tradeoff(reader: &MatrixReader, options: &TradeoffOptions, progress: &Progress) -> Result<Tradeoff> {
    tradeoff_from(vec![], |_| Ok(()), reader, options, progress)
}

/// One factorization of the table, by its number: what a run that is stopped leaves for the next.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct MeasuredSetting {
    number: usize,
    points: Vec<TradePoint>,
    regression_conditions: Vec<[f64; 2]>,
}

/// [`tradeoff`] but for what a stopped run has measured; `done` is told of every factorization.
///
/// # Errors
/// Those of [`tradeoff`] and of `done`.
pub(crate) fn tradeoff_from(
    earlier: Vec<MeasuredSetting>,
    done: impl Fn(&MeasuredSetting) -> Result<()>,
    reader: &MatrixReader,
    options: &TradeoffOptions,
    progress: &Progress,
) -> Result<Tradeoff> {
    let folder = ScratchFolder::new(&std::env::temp_dir(), reader.path())?;
    let part = match options.quick {
        true => Some(middle(reader, &folder.path().join("part.rd.zarr"))?),
        false => None,
    };
    let matrix = part.as_ref().unwrap_or(reader);
    let header = matrix.header();
    let start = Instant::now();
    for range in matrix.blocks() {
        matrix.read_responses(range)?;
    }
    let mut out = Tradeoff {
        matrix: reader.path().to_path_buf(),
        points_looked_at: header.points,
        points: reader.header().points,
        window: header.window,
        matrix_bytes: 4 * (header.rows() * header.row_len()) as u64,
        read_secs: start.elapsed().as_secs_f64(),
        noise: noise_level(matrix)?,
        measured: Vec::new(),
        regression_conditions: Vec::new(),
    };
    let settings = settings(header, options.quick);
    let stage = progress.stage("tradeoff", settings.len());
    let silent = Progress::silent();
    for (number, setting) in settings.into_iter().enumerate() {
        let measured = match earlier.iter().find(|m| m.number == number) {
            Some(measured) => measured.clone(),
            None => {
                let run = Run { matrix, folder: folder.path(), setting, options, silent: &silent };
                let measured = run.run(number)?;
                done(&measured)?;
                measured
            }
        };
        out.measured.extend(measured.points);
        if !measured.regression_conditions.is_empty() {
            out.regression_conditions = measured.regression_conditions;
        }
        stage.advance(1);
    }
    mark_pareto(&mut out.measured);
    mark_recommended(&mut out.measured, out.noise.as_ref());
    Ok(out)
}

/// One factorization to run.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Setting {
    /// `None`, as that of `terms`, is the program's own choice.
    model: Option<Model>,
    terms: Option<usize>,
    degree: Option<usize>,
    backend: Option<Backend>,
    /// Whether it is also stored in half precision and coded.
    stored: bool,
}

impl Setting {
    /// What the program makes when nothing is asked.
    const DEFAULT: Self = Self { model: None, terms: None, degree: None, backend: None, stored: true };

    fn is_published(&self) -> bool {
        (self.model, self.terms, self.degree) == (Some(Model::Tucker), Some(PUBLISHED.0), Some(PUBLISHED.1))
    }
}

/// The table: the program's own choice, every model over T (and P), every back end at the published setting.
fn settings(header: &MatrixHeader, quick: bool) -> Vec<Setting> {
    let most = header.rows().min(header.window_len());
    let terms: Vec<usize> = TERMS.into_iter().filter(|&t| t <= most && !(quick && [2, 60].contains(&t))).collect();
    let degrees: &[usize] = if quick { &DEGREES[1..3] } else { &DEGREES };
    let mut all = vec![Setting::DEFAULT];
    for &t in &terms {
        let of = |model, degree, stored| Setting { model: Some(model), terms: Some(t), degree, backend: None, stored };
        all.push(of(Model::Joint, None, t >= 8));
        all.push(of(Model::Peers2006, None, t == PUBLISHED.0));
        all.extend(degrees.iter().map(|&p| of(Model::Tucker, Some(p), (t, p) == PUBLISHED)));
    }
    let mut backends = vec![Backend::Gram, Backend::Deflation];
    if header.rows() * header.window_len() <= FULL_ENTRIES {
        backends.insert(0, Backend::Full);
    }
    let terms = PUBLISHED.0.min(most);
    for backend in backends {
        let (terms, backend) = (Some(terms), Some(backend));
        let of = |model, degree| Setting { model: Some(model), terms, degree, backend, stored: false };
        all.push(of(Model::Tucker, Some(PUBLISHED.1)));
        if backend != Some(Backend::Deflation) {
            all.push(of(Model::Joint, None));
        }
    }
    all
}

struct Run<'a> {
    matrix: &'a MatrixReader,
    folder: &'a Path,
    setting: Setting,
    options: &'a TradeoffOptions,
    silent: &'a Progress,
}

/// A material on disk.
struct Stored {
    path: PathBuf,
    precision: Precision,
    /// What storing took on top of factoring.
    secs: f64,
}

impl Run<'_> {
    fn run(mut self, number: usize) -> Result<MeasuredSetting> {
        let (factored, secs, peak_bytes) = self.factor()?;
        let default = self.setting == Setting::DEFAULT;
        self.setting.backend = Some(factored.backend);
        let regression_conditions = match self.setting.is_published() {
            true => regression_conditions(self.matrix, &factored.material, legendre::MOST_DEGREE)?,
            false => Vec::new(),
        };
        let stored = self.store(&factored.material, default)?;
        let measured = |s| Ok(TradePoint { default, ..self.measure(s, secs, peak_bytes)? });
        let points = stored.into_iter().map(measured).collect::<Result<_>>()?;
        Ok(MeasuredSetting { number, points, regression_conditions })
    }

    fn factor(&self) -> Result<(Factored, f64, Option<u64>)> {
        let Setting { model, terms, degree, backend, .. } = self.setting;
        let options = FactorOptions {
            model,
            terms,
            degree,
            backend,
            memory_bytes: self.options.memory_bytes,
            ..FactorOptions::default()
        };
        reset_peak();
        let start = Instant::now();
        let factored = factor(self.matrix, &options, self.silent)?;
        Ok((factored, start.elapsed().as_secs_f64(), peak_bytes()))
    }

    /// The files that are measured; of the default those that `run` writes.
    fn store(&self, material: &Material, default: bool) -> Result<Vec<Stored>> {
        let mut all = vec![];
        let path = |name: String| self.folder.join(name);
        let f32_path = path("f32.safetensors".into());
        material::save(material, Precision::F32, &f32_path)?;
        all.push(Stored { path: f32_path, precision: Precision::F32, secs: 0.0 });
        if !self.setting.stored {
            return Ok(all);
        }
        if material.header.degree.is_none() && !default {
            let path = path("f16.safetensors".into());
            material::save(material, Precision::F16, &path)?;
            all.push(Stored { path, precision: Precision::F16, secs: 0.0 });
        }
        let errors = match (default, self.options.quick) {
            (true, _) => &[DEFAULT_ERROR][..],
            (false, true) => &CODED_ERRORS[1..4],
            (false, false) => &CODED_ERRORS[..],
        };
        for (k, &error) in errors.iter().enumerate() {
            let start = Instant::now();
            let quality = coded::Quality::AddedError(error);
            let coded = coded::encode(material, &coded::EncodeOptions { quality, ..coded::EncodeOptions::default() })?;
            let file = path(format!("coded-{k}.acq"));
            crate::output::write_whole(&file, coded.bytes)?;
            all.push(Stored { path: file, precision: Precision::Coded, secs: start.elapsed().as_secs_f64() });
        }
        Ok(all)
    }

    fn measure(&self, stored: Stored, secs: f64, peak_bytes: Option<u64>) -> Result<TradePoint> {
        let source = Source::open(&stored.path)?;
        let measures = evaluate(&source, self.matrix, self.silent)?;
        let Source::Material(material, _) = &source else {
            return Err(Error::internal("a material was saved and is none"));
        };
        let h = &material.header;
        Ok(TradePoint {
            model: h.model,
            backend: self.setting.backend.unwrap_or(Backend::Randomized),
            terms: h.terms,
            degree: h.degree,
            shared_maps: h.shared_maps,
            precision: stored.precision,
            secs: secs + stored.secs,
            peak_bytes,
            bytes: match stored.precision {
                Precision::F32 => measures.bytes_f32,
                Precision::F16 => measures.bytes_f32 / 2,
                Precision::Coded => measures.bytes_file,
            },
            bytes_file: measures.bytes_file,
            rel_rmse: measures.rel_rmse,
            psnr_db: measures.psnr_db,
            log_rmse: measures.log_rmse,
            relit_psnr_db: measures.relit_psnr_db,
            pareto: false,
            default: false,
            recommended: false,
        })
    }
}

/// Copies a block of lit points from the middle of a matrix.
fn middle(reader: &MatrixReader, path: &Path) -> Result<MatrixReader> {
    let whole = reader.header();
    let size = whole.points.map(|n| n.min(QUICK_POINTS));
    let corner: [usize; 2] = std::array::from_fn(|a| (whole.points[a] - size[a]) / 2);
    let from = |i: usize| corner[0] + i % size[0] + (corner[1] + i / size[0]) * whole.points[0];
    let rows = size[0] * size[1];
    let header = MatrixHeader {
        points: size,
        lit_mm: (0..rows).map(|i| whole.lit_mm[from(i)]).collect(),
        position_sd_mm: (0..rows).map(|i| whole.position_sd_mm[from(i)]).collect(),
        shot_of: (0..rows).map(|i| whole.shot_of[from(i)]).collect(),
        common: None,
        ..whole.clone()
    };
    let writer = MatrixWriter::create(path, header)?;
    for y in 0..size[1] {
        let first = from(y * size[0]);
        let block = reader.read(first..first + size[0])?;
        for x in 0..size[0] {
            let row = block.view(x);
            writer.put(
                y * size[0] + x,
                &Row {
                    response: row.response.to_vec(),
                    variance: row.variance.to_vec(),
                    valid: row.valid.iter().map(|&v| v != 0).collect(),
                },
            )?;
        }
    }
    writer.finish()?;
    MatrixReader::open(path)
}

/// Makes the system forget the highest memory of this process so far, where it can.
fn reset_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let kib: u64 =
        status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(super) fn point(bytes: u64, psnr_db: f64) -> TradePoint {
        TradePoint {
            model: Model::Joint,
            backend: Backend::Full,
            terms: 1,
            degree: None,
            shared_maps: None,
            precision: Precision::F32,
            secs: 0.0,
            peak_bytes: None,
            bytes,
            bytes_file: bytes,
            rel_rmse: None,
            psnr_db: Some(psnr_db),
            log_rmse: None,
            relit_psnr_db: None,
            pareto: false,
            default: false,
            recommended: false,
        }
    }
}
