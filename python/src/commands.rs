//! What the program does as commands. Options are words as they are typed, so that both have one list; what is reported
//! is JSON.

use crate::errors::{internal, raised, refused};
use crate::material::NativeMaterial;
use crate::work::{Report, run};
use acquire::factor::{Stored, TaskFolder, factor_and_store, factor_and_store_by_tasks};
use acquire::material::{Material, Precision, Source};
use acquire::pipeline::Shots;
use acquire::simulate::SlabMaterial;
use acquire::transport::MatrixReader;
use acquire::transport::arrays::{
    ArraysInput, ArraysOptions, ImportedMatrix, import_arrays, import_store, open_arrays,
};
use acquire::{Error, Warning};
use pyo3::prelude::*;
use serde_json::{Value, json};
use std::path::PathBuf;

/// Findings as `--json` of the program has them.
pub(crate) fn findings(found: impl IntoIterator<Item = impl Into<Warning>>) -> acquire::Result<Vec<Value>> {
    found.into_iter().map(|finding| finding.into().json()).collect()
}

/// A report with its findings, as JSON.
fn with_findings(mut report: Value, found: impl IntoIterator<Item = impl Into<Warning>>) -> acquire::Result<String> {
    report["findings"] = Value::Array(findings(found)?);
    Ok(report.to_string())
}

fn to_json(value: &impl serde::Serialize) -> acquire::Result<Value> {
    serde_json::to_value(value).map_err(Error::internal)
}

/// The material of a matrix, and a report.
#[pyfunction]
pub(crate) fn factor(
    py: Python<'_>,
    path: PathBuf,
    words: Vec<String>,
    report: Report<'_>,
) -> PyResult<(NativeMaterial, String)> {
    let (options, storage) = acquire::cli::factor_options(&words).map_err(raised)?;
    let (material, report) = run(py, report, |progress| {
        let reader = MatrixReader::open(&path)?;
        factored(&reader, storage.precision, factor_and_store(&reader, &options, &storage, progress)?)
    })?;
    Ok((NativeMaterial::new(material, Some(storage.precision))?, report))
}

/// A material as it is stored, and what is said of it.
fn factored(reader: &MatrixReader, precision: Precision, stored: Stored) -> acquire::Result<(Material, String)> {
    let matrix_bytes = 4 * (reader.header().rows() * reader.header().row_len()) as u64;
    let factored = &stored.factored;
    let report = json!({
        "choice": factored.choice,
        "backend": factored.backend.to_string(),
        "rel_rmse": stored.rel_rmse(),
        "psnr_db": if stored.added_error > 0.0 { stored.psnr_db() } else { factored.psnr_db },
        "added_error": stored.added_error,
        "precision": precision.name(),
        "bytes": stored.bytes,
        "bytes_f32": factored.material.bytes_f32(),
        "bytes_matrix": matrix_bytes,
        "agreement": to_json(&factored.agreement)?,
        "findings": findings(factored.warnings.iter().cloned())?,
    });
    // What is stored is what is evaluated.
    let material = match precision {
        Precision::F32 => stored.factored.material,
        _ => Material::from_bytes(&stored.file)?,
    };
    Ok((material, report.to_string()))
}

/// The same by tasks ([`factor_part`]): the material, and a report; while a pass has parts that are not there, none, and
/// which they are. `out` is where the material will go.
#[pyfunction]
#[pyo3(signature = (path, out, words, folder, parts, force, report))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
pub(crate) fn factor_by_tasks(
    py: Python<'_>,
    path: PathBuf,
    out: PathBuf,
    words: Vec<String>,
    folder: PathBuf,
    parts: Option<usize>,
    force: bool,
    report: Report<'_>,
) -> PyResult<(Option<NativeMaterial>, String)> {
    let (options, storage) = acquire::cli::factor_options(&words).map_err(raised)?;
    acquire::cli::check_output("out", &out, &[&path], &acquire::cli::MATERIALS, force).map_err(raised)?;
    let folder = TaskFolder { path: folder, parts };
    let (material, report) = run(py, report, |progress| {
        let reader = MatrixReader::open(&path)?;
        match factor_and_store_by_tasks(&reader, &options, &storage, &folder, progress) {
            Err(Error::PassDue { pass, stage, missing, of, .. }) => {
                let missing: Vec<usize> = missing.into_iter().flatten().collect();
                Ok((None, json!({"pass": pass, "stage": stage, "missing": missing, "of": of}).to_string()))
            }
            stored => factored(&reader, storage.precision, stored?).map(|(material, report)| (Some(material), report)),
        }
    })?;
    let material = material.map(|material| NativeMaterial::new(material, Some(storage.precision))).transpose()?;
    Ok((material, report))
}

/// Some rows of the pass that is due: part `part` (number from 1, of how many).
#[pyfunction]
pub(crate) fn factor_part(
    py: Python<'_>,
    folder: PathBuf,
    part: [usize; 2],
    threads: Option<usize>,
    report: Report<'_>,
) -> PyResult<String> {
    run(py, report, |progress| {
        let report = on_threads(threads, || acquire::factor::factor_part(&folder, part, progress))?;
        Ok(to_json(&report)?.to_string())
    })
}

/// Measures of a matrix or material (a path, or a material in memory) against a matrix.
#[pyfunction]
pub(crate) fn evaluate(
    py: Python<'_>,
    candidate: Option<PathBuf>,
    material: Option<PyRef<'_, NativeMaterial>>,
    reference: PathBuf,
    report: Report<'_>,
) -> PyResult<String> {
    let material = material.map(|material| (material.material.clone(), material.file_bytes()));
    run(py, report, |progress| {
        let scratch;
        let source = match (candidate, material) {
            (Some(path), _) => Source::open(&path)?,
            (None, Some((material, bytes))) => {
                // Bytes of the file count among the measures: it is written, and forgotten.
                scratch = tempfile::NamedTempFile::new().map_err(Error::io("create", std::env::temp_dir()))?;
                std::fs::write(scratch.path(), bytes?).map_err(Error::io("write", scratch.path()))?;
                Source::Material(Box::new(material), scratch.path().to_path_buf())
            }
            (None, None) => return Err(Error::internal("nothing to evaluate")),
        };
        let measures = acquire::evaluate::evaluate(&source, &MatrixReader::open(&reference)?, progress)?;
        Ok(to_json(&measures)?.to_string())
    })
}

/// A capture without a rig.
#[pyfunction]
pub(crate) fn simulate(py: Python<'_>, dir: PathBuf, words: Vec<String>, report: Report<'_>) -> PyResult<String> {
    let options = acquire::cli::simulate_options(&words).map_err(raised)?;
    let voxels = match &options.material {
        SlabMaterial::Voxels(file) => Some(file.as_path()),
        _ => None,
    };
    acquire::cli::check_folder("dir", &dir, voxels.as_slice(), false).map_err(raised)?;
    run(py, report, |progress| {
        let summary = acquire::simulate::simulate(&options, &dir, progress)?;
        with_findings(to_json(&summary)?, summary.warnings)
    })
}

/// Photographs to a matrix.
#[pyfunction]
pub(crate) fn build_matrix(
    py: Python<'_>,
    capture: PathBuf,
    out: PathBuf,
    words: Vec<String>,
    force: bool,
    report: Report<'_>,
) -> PyResult<String> {
    let options = acquire::cli::build_options(&words).map_err(raised)?;
    let inputs = acquire::cli::inputs_of(&capture, options.calibration.as_deref());
    acquire::cli::check_matrix_output("out", &out, &inputs, force).map_err(raised)?;
    run(py, report, |progress| {
        let built = acquire::pipeline::build_matrix(&capture, &options, &out, progress)?;
        with_findings(built.figures()?, built.warnings)
    })
}

/// Checks, before any work, that a capture can become a matrix at `out`; how many lattice shots it has.
#[pyfunction]
pub(crate) fn plan(capture: PathBuf, out: PathBuf, words: Vec<String>, force: bool) -> PyResult<usize> {
    let options = acquire::cli::build_options(&words).map_err(raised)?;
    let inputs = acquire::cli::inputs_of(&capture, options.calibration.as_deref());
    acquire::cli::check_matrix_output("out", &out, &inputs, force).map_err(raised)?;
    let manifest = acquire::capture::Manifest::read(&capture).map_err(raised)?;
    Ok(acquire::pipeline::lattice_shots(&manifest))
}

/// What all lattice shots have in common, to a file; its bytes.
#[pyfunction]
pub(crate) fn prepare(
    py: Python<'_>,
    capture: PathBuf,
    out: PathBuf,
    words: Vec<String>,
    threads: Option<usize>,
    report: Report<'_>,
) -> PyResult<u64> {
    let options = acquire::cli::build_options(&words).map_err(raised)?;
    let inputs = acquire::cli::inputs_of(&capture, options.calibration.as_deref());
    acquire::cli::check_prepared_output(&out, &inputs).map_err(raised)?;
    run(py, report, |progress| {
        on_threads(threads, || acquire::pipeline::prepare_shots(&capture, &options, &out, progress))
    })
}

/// Some lattice shots, to a part: either part `part` (number from 1, of how many) or those of a range.
#[pyfunction]
#[pyo3(signature = (source, out, words, part, shots, threads, report))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
pub(crate) fn extract(
    py: Python<'_>,
    source: PathBuf,
    out: PathBuf,
    words: Vec<String>,
    part: Option<[usize; 2]>,
    shots: Option<[usize; 2]>,
    threads: Option<usize>,
    report: Report<'_>,
) -> PyResult<String> {
    let options = acquire::cli::build_options(&words).map_err(raised)?;
    let inputs = acquire::cli::inputs_of(&source, options.calibration.as_deref());
    acquire::cli::check_part_output(&out, &inputs).map_err(raised)?;
    let shots = match (part, shots) {
        (Some([number, of]), None) => Shots::Part { number, of },
        (None, Some([start, end])) => Shots::Range(start..end),
        _ => return Err(refused("part, shots: expected one of the two")),
    };
    run(py, report, |progress| {
        let report = on_threads(threads, || acquire::pipeline::extract(&source, &options, &shots, &out, progress))?;
        Ok(to_json(&report)?.to_string())
    })
}

/// Parts to a matrix.
#[pyfunction]
#[pyo3(signature = (capture, parts, out, words, measure_missing, force, threads, report))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
pub(crate) fn assemble(
    py: Python<'_>,
    capture: PathBuf,
    parts: Vec<PathBuf>,
    out: PathBuf,
    words: Vec<String>,
    measure_missing: bool,
    force: bool,
    threads: Option<usize>,
    report: Report<'_>,
) -> PyResult<String> {
    let options = acquire::cli::build_options(&words).map_err(raised)?;
    let mut inputs = acquire::cli::inputs_of(&capture, options.calibration.as_deref());
    inputs.extend(parts.iter().cloned());
    acquire::cli::check_matrix_output("out", &out, &inputs, force).map_err(raised)?;
    run(py, report, |progress| {
        let built = on_threads(threads, || {
            acquire::pipeline::assemble(&capture, &options, &parts, measure_missing, &out, progress)
        })?;
        let mut object = built.figures()?;
        object["unused_parts"] = json!(built.unused_parts);
        with_findings(object, built.warnings)
    })
}

/// Does `work` on so many threads; on all where none are given.
fn on_threads<T: Send>(threads: Option<usize>, work: impl FnOnce() -> acquire::Result<T> + Send) -> acquire::Result<T> {
    let Some(threads) = threads else { return work() };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(Error::internal)?;
    pool.install(work)
}

/// A matrix from a file of arrays.
#[pyfunction]
#[pyo3(signature = (path, out, pitch_mm, lit_pitch_mm, points, window, full, force, report))]
#[allow(clippy::too_many_arguments, reason = "keywords of the Python function")]
pub(crate) fn import_matrix(
    py: Python<'_>,
    path: PathBuf,
    out: PathBuf,
    pitch_mm: Option<f64>,
    lit_pitch_mm: Option<[f64; 2]>,
    points: Option<[usize; 2]>,
    window: Option<[usize; 2]>,
    full: bool,
    force: bool,
    report: Report<'_>,
) -> PyResult<String> {
    acquire::cli::check_matrix_output("out", &out, &[&path], force).map_err(raised)?;
    run(py, report, |progress| {
        let mut instead = serde_json::Map::new();
        instead.extend(pitch_mm.map(|v| ("pitch_mm".to_owned(), json!(v))));
        instead.extend(lit_pitch_mm.map(|v| ("lit_pitch_mm".to_owned(), json!(v))));
        let source = format!("acquire.import_matrix: {}", path.display());
        let imported = match open_arrays(&path, full, &instead)? {
            ArraysInput::Store(reader) => import_store(&reader, &source, &out, progress)?,
            ArraysInput::Arrays(arrays) => {
                let options = ArraysOptions { pitch_mm, lit_pitch_mm, points, window, full, source };
                import_arrays(&arrays, &options, &out, progress)?
            }
        };
        told(&imported)
    })
}

/// What was imported, as JSON.
pub(crate) fn told(imported: &ImportedMatrix) -> acquire::Result<String> {
    with_findings(to_json(imported)?, imported.findings.iter().cloned())
}

/// JSON of anything, as an exception where it fails.
pub(crate) fn text(value: &impl serde::Serialize) -> PyResult<String> {
    serde_json::to_string(value).map_err(internal)
}
