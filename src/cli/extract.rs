use super::{Context, options};
use crate::pipeline::{ExtractReport, Shots, extract};
use crate::words::count;
use crate::{Error, Result};
use std::ops::Range;
use std::path::PathBuf;

/// Measure some of a capture's lattice shots: one task of many that share the work of build-matrix.
///
/// Tasks run at once, in any order, on one machine or many that see the same files, and again where they failed; each
/// writes a part of its own. `acquire assemble` makes the matrix of all parts. What the shots have in common every task
/// finds for itself first, unless `acquire prepare` has written it.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire extract captures/ --part 3/64 --out parts/3.part
  acquire extract parts/slab.prepared --part 3/64 --out parts/3.part
  acquire extract captures/ --shots 120..180 --out parts/again.part
  acquire assemble captures/ parts/ --out slab.rd.zarr

docs/scale.md has recipes for Slurm, Snakemake, GNU parallel and Dask.")]
pub(super) struct Args {
    /// Folder of capture.toml, or what `acquire prepare` has made of it.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    #[command(flatten)]
    shots: Which,
    #[command(flatten)]
    build: options::Build,
    /// Where the part goes. A part that is there already stays if it is whole and of the same photographs, else it is
    /// replaced.
    #[arg(long, short, value_name = "X.part")]
    out: PathBuf,
    /// Print one JSON object: the shots, photographs, rows, and the time it took.
    #[arg(long)]
    json: bool,
}

/// Which shots.
#[derive(Debug, Clone, clap::Args)]
#[group(required = true, multiple = false)]
pub struct Which {
    /// The K-th of N parts of nearly equal size, K from 1.
    #[arg(long, value_name = "K/N", value_parser = part)]
    part: Option<[usize; 2]>,
    /// Lattice shots by their numbers in the sweep, from 0, B not among them.
    #[arg(long, value_name = "A..B", value_parser = range)]
    shots: Option<[usize; 2]>,
}

impl From<Which> for Shots {
    fn from(which: Which) -> Self {
        match (which.part, which.shots) {
            (Some([number, of]), _) => Self::Part { number, of },
            // Clap has refused neither.
            (None, range) => Self::Range(range.map_or(0..0, |[start, end]| Range { start, end })),
        }
    }
}

fn two(typed: &str, between: &str, expected: &str) -> Result<[usize; 2], String> {
    let two = typed.split_once(between).and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    two.ok_or_else(|| format!("expected {expected}"))
}

pub(super) fn part(typed: &str) -> Result<[usize; 2], String> {
    two(typed, "/", "K/N, 3/64 say: the third of 64 parts")
}

fn range(typed: &str) -> Result<[usize; 2], String> {
    two(typed, "..", "A..B, 120..180 say: the shots 120 to 179")
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let inputs = super::inputs_of(&args.capture, args.build.calibration.as_deref());
    super::check_part_output(&args.out, &inputs)?;
    let report = extract(&args.capture, &args.build.into(), &args.shots.into(), &args.out, &context.progress)?;
    if args.json {
        super::print(&serde_json::to_string(&report).map_err(Error::internal)?)?;
    }
    let ExtractReport { shots: [first, end], of, photographs, was_there, .. } = report;
    let what = format!("shots {first}..{end} of {of} from {}", count(photographs, "photograph"));
    let secs = start.elapsed().as_secs_f64();
    context.done(match was_there {
        true => format!("{} was there already: {what}, in {secs:.1} s", args.out.display()),
        false => format!(
            "wrote {}: {what}, in {secs:.1} s, of it {:.1} s for what all shots have in common",
            args.out.display(),
            report.once_secs
        ),
    });
    Ok(())
}
