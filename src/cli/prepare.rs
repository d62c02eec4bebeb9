use super::{Context, options};
use crate::Result;
use crate::pipeline::prepare_shots;
use std::path::PathBuf;

/// Find what all lattice shots of a capture have in common, and keep it in a file for `acquire extract`.
///
/// Radiometry, registration, references, and the head of every photograph: tasks that read this file open no
/// photographs but their own. `acquire extract` of the capture itself finds the same again for each task.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire prepare captures/ --out parts/slab.prepared
  acquire extract parts/slab.prepared --part 3/64 --out parts/3.part

docs/scale.md has recipes for Slurm, Snakemake, GNU parallel and Dask.")]
pub(super) struct Args {
    /// Folder of capture.toml.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    #[command(flatten)]
    build: options::Build,
    /// Where the file goes; an earlier one is replaced.
    #[arg(long, short, value_name = "X.prepared")]
    out: PathBuf,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let inputs = super::inputs_of(&args.capture, args.build.calibration.as_deref());
    super::check_prepared_output(&args.out, &inputs)?;
    let bytes = prepare_shots(&args.capture, &args.build.into(), &args.out, &context.progress)?;
    let secs = start.elapsed().as_secs_f64();
    context.done(format_args!("wrote {}, {:.1} MB, in {secs:.1} s", args.out.display(), bytes as f64 / 1e6));
    Ok(())
}
