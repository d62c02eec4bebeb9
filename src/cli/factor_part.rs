use super::Context;
use crate::factor::factor_part;
use crate::{Error, Result};
use std::path::PathBuf;

/// Go over some of a matrix's rows for a factorization: one task of many that share a pass.
///
/// Tasks run at once, in any order, on one machine or many that see the same files, and again where they failed.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire factor slab.rd.zarr --terms 15 --tasks passes/ --parts 64    prints the parts that are to be done
  acquire factor-part passes/ --part 3/64

docs/scale.md has recipes for Slurm, GNU parallel and Dask.")]
pub(super) struct Args {
    /// The folder of `acquire factor --tasks`.
    tasks: PathBuf,
    /// The K-th of the N parts of the pass that is due, K from 1. A part that is there already stays.
    #[arg(long, value_name = "K/N", value_parser = super::extract::part)]
    part: [usize; 2],
    /// Print one JSON object: pass, stage, rows, whether the part was there, and bytes read and written.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let report = factor_part(&args.tasks, args.part, &context.progress)?;
    if args.json {
        super::print(&serde_json::to_string(&report).map_err(Error::internal)?)?;
    }
    let [first, end] = report.rows;
    let what = format!("pass {} ({}), rows {first}..{end}", report.pass, report.stage);
    let secs = start.elapsed().as_secs_f64();
    context.done(match report.was_there {
        true => format!("{what}: was there already"),
        false => format!("{what}: {:.1} MB in {secs:.1} s", report.bytes_part as f64 / 1e6),
    });
    Ok(())
}
