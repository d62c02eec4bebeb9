use super::{Context, options};
use crate::capture::Manifest;
use crate::evaluate::{evaluate, noise_level};
use crate::factor::{FactorOptions, Factored, factor};
use crate::material::coded::{EncodeOptions, encode};
use crate::material::{self, Material, Precision, Responses, Source, export_exr, export_npz};
use crate::output::{NewFolder, key_of, write_whole};
use crate::pipeline::{BuildReport, build_matrix_in};
use crate::report::{self, Comparison, MaterialSummary, ReportInput, RowSurvey};
use crate::simulate::TRUTH_MATRIX;
use crate::transport::MatrixReader;
use crate::{Error, Result};
use std::path::{Path, PathBuf};

/// The whole way: photographs to matrix, material, exports, measures and a report.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire run captures/ --out results
  acquire run captures/ --out results --force --terms 15 --degree 7

Writes into RESULTS: matrix.rd.zarr, material.safetensors, the same coded in material.acq, material.exr, material.npz,
measures.json, report/report.html.
When the capture has a truth.rd.zarr beside it (a simulated one), the matrix is measured against it.")]
pub(super) struct Args {
    /// Folder of capture.toml.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    /// The folder to make.
    #[arg(long, short, value_name = "RESULTS")]
    out: PathBuf,
    #[command(flatten)]
    build: options::Build,
    /// Number of terms [default: as many as exceed the measured noise].
    #[arg(long, value_name = "T")]
    terms: Option<usize>,
    /// Degree of the colour polynomial, 0 to 15 [default: as the measured noise supports].
    #[arg(long, value_name = "P")]
    degree: Option<usize>,
    /// Replace earlier results at RESULTS.
    #[arg(long)]
    force: bool,
}

const MATRIX: &str = "matrix.rd.zarr";
const MATERIAL: &str = "material.safetensors";
const CODED: &str = "material.acq";
/// Comparisons with the matrix.
const PLAIN_TITLE: &str = "material against matrix";
const CODED_TITLE: &str = "coded material against matrix";
const MEASURES: &str = "measures.json";

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let factoring = FactorOptions { terms: args.terms, degree: args.degree, ..FactorOptions::default() };
    factoring.check()?;
    let inputs = super::inputs_of(&args.capture, args.build.calibration.as_deref());
    super::check_folder("out", &args.out, &inputs, false)?;
    let build_options = args.build.clone().into();
    // What of it is still right the matrix's own work says.
    let (results, log, _) = NewFolder::go_on::<()>(&args.out, args.force, &key_of(&"run")?)?;
    log.add(&())?;
    results.clear()?;
    let folder = results.path();
    let manifest = Manifest::read(&args.capture)?;
    check_truth(&args.capture, &manifest)?;
    let title = manifest.name;

    let matrix = folder.join(MATRIX);
    let build = build_matrix_in(results.scratch(), &args.capture, &build_options, &matrix, &context.progress);
    if build.as_ref().is_err_and(Error::is_of_system) {
        results.keep_work();
    }
    let build = build?;
    context.tell(&build.warnings);
    super::build_matrix::taken_over(&build).into_iter().for_each(|line| context.done(line));
    context.done(super::build_matrix::summary(&build));

    let made = from_matrix(&args, &factoring, &title, &build, &folder, context);
    let (comparisons, files) = match made {
        Ok(made) => made,
        // The matrix is what took the time; an earlier output that is whole stays instead.
        Err(error) if !results.replaces() => {
            // What was being written has no seal of its own.
            let _ = std::fs::remove_file(folder.join(MEASURES));
            let _ = std::fs::remove_dir_all(folder.join("report"));
            if results.finish().is_ok() {
                let matrix = args.out.join(MATRIX);
                context.done(format_args!("kept: {}; next: acquire factor {}", matrix.display(), matrix.display()));
            }
            return Err(error);
        }
        Err(error) => return Err(error),
    };
    results.finish()?;
    for c in &comparisons {
        context.done(closing_line(c));
    }
    context.done(files_text(&files, &comparisons));
    context.done(format_args!("results: {}", args.out.display()));
    context.done(format_args!("report:  {}", args.out.join("report/report.html").display()));
    Ok(())
}

/// Everything that is made of the matrix in `folder`.
fn from_matrix(
    args: &Args,
    factoring: &FactorOptions,
    title: &str,
    build: &BuildReport,
    folder: &Path,
    context: &Context,
) -> Result<(Vec<Comparison>, MaterialFiles)> {
    let at = |name: &str| folder.join(name);
    let matrix = MatrixReader::open(&at(MATRIX))?;
    let factored = factor(&matrix, factoring, &context.progress)?;
    let files = save(&factored.material, folder, context)?;
    context.done(&factored.choice);
    export_exr(&factored.material, &at("material.exr"))?;
    export_npz(&factored.material, &at("material.npz"))?;
    let comparisons = compare(&args.capture, folder, context)?;
    write_report(title, build, &Made { matrix, factored, files, comparisons: &comparisons }, folder, context)?;
    Ok((comparisons, files))
}

/// What the report is of.
struct Made<'a> {
    matrix: MatrixReader,
    factored: Factored,
    files: MaterialFiles,
    comparisons: &'a [Comparison],
}

/// The material's two files, for the line that tells which is for what.
#[derive(Clone, Copy)]
struct MaterialFiles {
    plain_bytes: u64,
    coded_bytes: u64,
    /// ‖R̂_coded − R̂‖ / ‖R̂‖, as the coder measured it.
    added_error: f64,
}

/// What the two files are, what they cost, and what each is for; comparisons are those of [`compare`].
fn files_text(files: &MaterialFiles, comparisons: &[Comparison]) -> String {
    let MaterialFiles { plain_bytes, coded_bytes, added_error } = files;
    let tails = |title: &str| comparisons.iter().find(|c| c.title == title)?.value("log_rmse");
    let tails = tails(PLAIN_TITLE).zip(tails(CODED_TITLE));
    let tails = tails.map(|(plain, coded)| format!("; log_rmse {coded:.4}, plain {plain:.4}")).unwrap_or_default();
    format!(
        "{MATERIAL}: {plain_bytes} bytes, the factors as they are: to edit, for renderers and all that reads safetensors\n{CODED}: {coded_bytes} bytes, the same coded, {added_error:.5} off it in rel_rmse{tails}: to keep and to send, read by acquire"
    )
}

/// Writes the material plain and coded.
fn save(material: &Material, folder: &Path, context: &Context) -> Result<MaterialFiles> {
    let plain = folder.join(MATERIAL);
    material::save(material, Precision::F32, &plain)?;
    let plain_bytes = std::fs::metadata(&plain).map_err(Error::io("read", &plain))?.len();
    let stage = context.progress.stage("code", 1);
    let coded = encode(material, &EncodeOptions::default())?;
    stage.advance(1);
    let files = MaterialFiles { plain_bytes, coded_bytes: coded.bytes.len() as u64, added_error: coded.added_error };
    write_whole(&folder.join(CODED), coded.bytes)?;
    Ok(files)
}

fn write_report(title: &str, build: &BuildReport, made: &Made<'_>, folder: &Path, context: &Context) -> Result<()> {
    let Made { matrix, factored, files, comparisons } = made;
    let material = &factored.material;
    let responses = Responses::new(material);
    let survey = {
        let stage = context.progress.stage("compare", matrix.header().rows());
        RowSurvey::take(matrix, |i| {
            stage.advance(1);
            Ok(responses.row(i))
        })?
    };
    let summary = MaterialSummary {
        bytes_coded: Some(files.coded_bytes),
        levels: factored.levels.clone(),
        ..MaterialSummary::new(&material.header, files.plain_bytes, Some(factored.choice.clone()))
    };
    let input = ReportInput {
        title,
        matrix: matrix.header(),
        material: &summary,
        overview: Some(&build.overview),
        survey: &survey,
        comparisons,
        timings: &context.progress.timings(),
        warnings: &factored.warnings,
    };
    report::write(&folder.join("report"), &input)
}

/// A truth that the results could not be compared with is refused before they are made.
fn check_truth(capture: &Path, manifest: &Manifest) -> Result<()> {
    let path = capture.join(TRUTH_MATRIX);
    if !path.is_dir() {
        return Ok(());
    }
    let truth = MatrixReader::open(&path)?;
    let fields = [
        ("points", truth.header().points, manifest.grid.points),
        ("window", truth.header().window, manifest.window.samples),
    ];
    match fields.into_iter().find(|(_, truth, manifest)| truth != manifest) {
        None => Ok(()),
        Some((field, in_truth, in_manifest)) => Err(Error::Mismatch {
            a: path,
            b: capture.join("capture.toml"),
            field: field.to_owned(),
            a_value: format!("{in_truth:?}"),
            b_value: format!("{in_manifest:?}"),
        }),
    }
}

/// Measures the material, plain and coded, against the matrix, for a simulated capture the matrix against the truth,
/// and what the matrix's noise alone has of the measures; writes them.
fn compare(capture: &Path, folder: &Path, context: &Context) -> Result<Vec<Comparison>> {
    let matrix = folder.join(MATRIX);
    let truth = capture.join(TRUTH_MATRIX);
    let mut pairs = vec![(PLAIN_TITLE, folder.join(MATERIAL), &matrix), (CODED_TITLE, folder.join(CODED), &matrix)];
    if truth.is_dir() {
        pairs.push(("matrix against truth", matrix.clone(), &truth));
    }
    let mut object = serde_json::Map::new();
    let mut comparisons = Vec::new();
    for (title, candidate, reference) in pairs {
        let measures = evaluate(&Source::open(&candidate)?, &MatrixReader::open(reference)?, &context.progress)?;
        comparisons.push(Comparison::new(title, &measures)?);
        object.insert(title.replace(' ', "_"), serde_json::to_value(&measures).map_err(Error::internal)?);
    }
    if let Some(noise) = noise_level(&MatrixReader::open(&matrix)?)? {
        comparisons.push(Comparison::new("the matrix's noise", &noise)?);
        object.insert("noise".into(), serde_json::to_value(noise).map_err(Error::internal)?);
    }
    let path = folder.join(MEASURES);
    let text = serde_json::to_string_pretty(&object).map_err(Error::internal)?;
    std::fs::write(&path, text + "\n").map_err(Error::io("write", &path))?;
    Ok(comparisons)
}

/// The line that a person waits for.
fn closing_line(c: &Comparison) -> String {
    let percent = c.value("rel_rmse").map(|v| format!("rel_rmse {:.2} %", 100.0 * v));
    let psnr = c.value("psnr_db").map(|v| format!("psnr {v:.1} dB"));
    let tails = c.value("log_rmse").map(|v| format!("log_rmse {v:.4}"));
    let parts: Vec<String> = percent.into_iter().chain(psnr).chain(tails).collect();
    format!("{}: {}", c.title, parts.join(", "))
}
