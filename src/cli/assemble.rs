use super::build_matrix::{json, summary};
use super::{Context, options};
use crate::Result;
use crate::pipeline::assemble;
use crate::words::count;
use std::path::PathBuf;

/// Put the parts that `acquire extract` has written together to the matrix that build-matrix makes, bit by bit.
///
/// Parts of another capture, other options or another version, damaged and doubled ones do no harm, and are named.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire assemble captures/ parts/ --out slab.rd.zarr
  acquire assemble captures/ parts/all.part --measure-missing --out slab.rd.zarr
  acquire assemble captures/ parts/ --json | jq -r '.missing[] | join(\"..\")'

Exit status 1 when shots are missing; the message and --json say which.")]
pub(super) struct Args {
    /// Folder of capture.toml.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    /// Parts, or folders of them (*.part).
    #[arg(required = true)]
    parts: Vec<PathBuf>,
    #[command(flatten)]
    build: options::Build,
    /// Measure the shots that no part has.
    #[arg(long)]
    measure_missing: bool,
    /// Where the matrix goes.
    #[arg(long, short, value_name = "X.rd.zarr", default_value = "matrix.rd.zarr")]
    out: PathBuf,
    /// Replace an earlier matrix there.
    #[arg(long)]
    force: bool,
    /// Print one JSON object: that of build-matrix; where shots are missing, their ranges in `missing`.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let mut inputs = super::inputs_of(&args.capture, args.build.calibration.as_deref());
    inputs.extend(args.parts.iter().cloned());
    super::check_matrix_output("out", &args.out, &inputs, args.force)?;
    let options = args.build.into();
    let built = assemble(&args.capture, &options, &args.parts, args.measure_missing, &args.out, &context.progress);
    if args.json {
        super::print(&json(&built, &args.capture, &args.out)?)?;
    }
    let report = built?;
    context.tell(&report.warnings);
    report.unused_parts.iter().for_each(|part| context.done(format_args!("note: not used: {part}")));
    let taken = report.taken_over;
    context.done(format_args!("{} of {} were in parts", taken.shots, count(taken.of, "lattice shot")));
    context.done(summary(&report));
    context.done(format_args!("wrote {} in {:.1} s", args.out.display(), start.elapsed().as_secs_f64()));
    Ok(())
}
