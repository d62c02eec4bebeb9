use super::{Context, options};
use crate::pipeline::{BuildReport, build_matrix};
use crate::simulate::TRUTH_MATRIX;
use crate::words::count;
use crate::{Error, Result};
use std::path::PathBuf;

/// Photographs to the matrix R_d(x_i, x_o).
///
/// Reads capture.toml and EXIF, merges the exposures of each shot to radiance with its variance, registers camera and
/// projector to the slab, measures each shot's drift, extracts the window of responses of every lit point, and writes a
/// Zarr v3 store that xarray, zarr-python and dask open.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire build-matrix captures/
  acquire build-matrix captures/ --calibration lab/rig-3 --out slab.rd.zarr")]
pub(super) struct Args {
    /// Folder of capture.toml.
    capture: PathBuf,
    #[command(flatten)]
    build: options::Build,
    /// Where the matrix goes; an older one there is replaced.
    #[arg(long, short, value_name = "X.rd.zarr", default_value = "matrix.rd.zarr")]
    out: PathBuf,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let truth = args.capture.join(TRUTH_MATRIX);
    if truth.canonicalize().is_ok_and(|truth| args.out.canonicalize().is_ok_and(|out| out == truth)) {
        let expected = "another path than the simulated capture's truth".into();
        return Err(Error::Setting { setting: "out", expected, found: args.out.display().to_string() });
    }
    let report = build_matrix(&args.capture, &args.build.into(), &args.out, &context.progress)?;
    report.warnings.iter().cloned().for_each(|w| context.warn(w));
    context.done(summary(&report));
    let stages: Vec<_> = context.progress.timings().iter().map(|t| format!("{} {:.2} s", t.stage, t.secs)).collect();
    context.done(stages.join(", "));
    context.done(format_args!("wrote {} in {:.1} s", args.out.display(), start.elapsed().as_secs_f64()));
    Ok(())
}

/// One line that says what was measured.
pub(super) fn summary(report: &BuildReport) -> String {
    let drift = report.shots.iter().map(|s| s.drift_px[0].powi(2) + s.drift_px[1].powi(2)).sum::<f64>();
    let drift_rms = (drift / (2 * report.shots.len().max(1)) as f64).sqrt();
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
