//! The command line: one file per subcommand, raw arguments turned into checked settings before any work.

mod build_matrix;
mod evaluate;
mod export;
mod factor;
mod relight;
mod run;
mod simulate;

use crate::{Error, Result, progress::Progress};
use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// Measure translucent materials: photographs of a projector-lit slab to the matrix R_d(x_i, x_o) and a factored material.
#[derive(Debug, Parser)]
#[command(name = "acquire", version, after_help = EXAMPLES, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// No progress bars and no closing line; warnings and errors stay.
    #[arg(long, short, global = true)]
    quiet: bool,
    /// Number of threads [default: one per core].
    #[arg(long, global = true, value_name = "N")]
    threads: Option<usize>,
}

const EXAMPLES: &str = "\
Examples:
  acquire run captures/ --out results                  photographs to matrix, material, exports and report
  acquire build-matrix captures/ --out slab.rd.zarr    only the matrix
  acquire factor slab.rd.zarr --out slab.safetensors   only the material
  acquire simulate demo --material chessboard-4x4      a capture without a rig

Exit status: 0 done, 1 the input cannot be used, 2 a fault of acquire itself.";

#[derive(Debug, Subcommand)]
enum Command {
    Simulate(simulate::Args),
    BuildMatrix(build_matrix::Args),
    Factor(factor::Args),
    Evaluate(evaluate::Args),
    Relight(relight::Args),
    Export(export::Args),
    Run(run::Args),
}

/// What every subcommand gets besides its own arguments.
struct Context {
    progress: Progress,
    quiet: bool,
}

impl Context {
    /// The closing line of a command, on stderr: stdout is for data.
    fn done(&self, line: impl std::fmt::Display) {
        if !self.quiet {
            eprintln!("{line}");
        }
    }

    /// A finding that does not stop the work.
    fn warn(&self, warning: &crate::Warning) {
        self.progress.say(format_args!("warning: {warning}"));
    }
}

/// Runs the program on the process's arguments.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // --help and --version are successes on stdout; anything else is bad input.
            let code = if e.use_stderr() { 1 } else { 0 };
            let _ = e.print();
            return ExitCode::from(code);
        }
    };
    match run(cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            if let Some(hint) = error.hint() {
                eprintln!("hint: {hint}");
            }
            ExitCode::from(if error.is_internal() { 2 } else { 1 })
        }
    }
}

fn run(cli: Cli) -> Result<()> {
    if let Some(n) = cli.threads {
        if n == 0 {
            return Err(Error::Setting { setting: "--threads", expected: "at least 1".into(), found: "0".into() });
        }
        rayon::ThreadPoolBuilder::new().num_threads(n).build_global().map_err(Error::internal)?;
    }
    let progress = if cli.quiet { Progress::silent() } else { Progress::terminal() };
    let context = Context { progress, quiet: cli.quiet };
    match cli.command {
        Command::Simulate(args) => simulate::run(args, &context),
        Command::BuildMatrix(args) => build_matrix::run(args, &context),
        Command::Factor(args) => factor::run(args, &context),
        Command::Evaluate(args) => evaluate::run(args, &context),
        Command::Relight(args) => relight::run(args, &context),
        Command::Export(args) => export::run(args, &context),
        Command::Run(args) => run::run(args, &context),
    }
}
