pub(super) use super::options::Build as Options;

use super::Context;
use crate::pipeline::{BuildReport, TakenOver, build_matrix};
use crate::words::count;
use crate::{Error, Result, Warning};
use std::path::{Path, PathBuf};

/// Photographs to the matrix R_d(x_i, x_o).
///
/// Reads capture.toml and EXIF, merges the exposures of each shot to radiance with its variance, registers camera and
/// projector to the slab, measures each shot's drift, extracts the window of responses of every lit point, and writes a
/// Zarr v3 store that xarray, zarr-python and dask open.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire build-matrix captures/
  acquire build-matrix captures/ --calibration lab/rig-3 --out slab.rd.zarr
  acquire build-matrix captures/ --json | jq -r '.findings[] | .severity + \": \" + .seen'

docs/findings.md lists what may be found, and what to do about it.")]
pub(super) struct Args {
    /// Folder of capture.toml.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    #[command(flatten)]
    build: Options,
    /// Where the matrix goes.
    #[arg(long, short, value_name = "X.rd.zarr", default_value = "matrix.rd.zarr")]
    out: PathBuf,
    /// Replace an earlier matrix there.
    #[arg(long)]
    force: bool,
    /// Print one JSON object: what was measured, and the findings; of a capture that is refused, why.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let inputs = super::inputs_of(&args.capture, args.build.calibration.as_deref());
    super::check_matrix_output("out", &args.out, &inputs, args.force)?;
    let built = build_matrix(&args.capture, &args.build.into(), &args.out, &context.progress);
    if args.json {
        super::print(&json(&built, &args.capture, &args.out)?)?;
    }
    let report = built?;
    context.tell(&report.warnings);
    taken_over(&report).into_iter().for_each(|line| context.done(line));
    context.done(summary(&report));
    let stages: Vec<_> = context.progress.timings().iter().map(|t| format!("{} {:.2} s", t.stage, t.secs)).collect();
    context.done(stages.join(", "));
    context.done(format_args!("wrote {} in {:.1} s", args.out.display(), start.elapsed().as_secs_f64()));
    Ok(())
}

/// `built`, `reason`, `figures` and `findings`, as `check --json` has them; the ranges of shots that no part has.
pub(super) fn json(built: &Result<BuildReport>, capture: &Path, out: &Path) -> Result<String> {
    let object = match built {
        Ok(report) => {
            let findings: Result<Vec<_>> = report.warnings.iter().map(Warning::json).collect();
            let figures = report.figures()?;
            serde_json::json!({ "built": true, "reason": null, "matrix": out, "figures": figures, "findings": findings? })
        }
        Err(error) => {
            let refusal = Warning::refusal(error, capture);
            let finding = refusal.record().refused().with_figures(&refusal)?;
            let missing: Vec<_> = match error {
                Error::MissingShots { missing, .. } => missing.iter().map(|r| [r.start, r.end]).collect(),
                _ => vec![],
            };
            let reason = error.to_string();
            serde_json::json!({ "built": false, "reason": reason, "findings": [finding], "missing": missing })
        }
    };
    serde_json::to_string_pretty(&object).map_err(Error::internal)
}

/// What a stopped run had measured.
pub(super) fn taken_over(report: &BuildReport) -> Option<String> {
    let TakenOver { shots, of, anew } = report.taken_over;
    match (shots, anew) {
        (_, true) => {
            Some("a stopped run had begun with other photographs, options or version: all was measured anew".into())
        }
        (0, false) => None,
        _ => Some(format!("{shots} of {} were measured by a stopped run, and taken over", count(of, "lattice shot"))),
    }
}

/// One line that says what was measured.
pub(super) fn summary(report: &BuildReport) -> String {
    let drift_rms = report.drift_rms_px();
    let r = &report.registration;
    let working = match (report.working.factor, report.working.px_per_sample) {
        (2.., Some(px)) => {
            let n = report.working.factor;
            format!("; photographs of {px:.1} px a sample reduced to {:.1} (blocks of {n}×{n})", px / n as f64)
        }
        _ => String::new(),
    };
    format!(
        "R_d of {}×{} points, {}×{} window from {}; registration RMS {:.3} px camera, {:.3} px projector; drift RMS {drift_rms:.2} px{working}",
        report.points[0],
        report.points[1],
        report.window[0],
        report.window[1],
        count(report.photographs, "photograph"),
        r.camera_rms_px,
        r.projector_rms_px,
    )
}
