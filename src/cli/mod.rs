//! The command line: one file per subcommand, raw arguments turned into checked settings before any work.

mod build_matrix;
mod check;
mod evaluate;
mod export;
mod factor;
mod import;
mod import_matrix;
mod keywords;
mod messages;
mod options;
mod patterns;
mod relight;
mod run;
mod simulate;
mod tradeoff;
mod values;

pub use keywords::{build_options, factor_options, simulate_options};
use messages::one_line;

use crate::{Error, Result, Severity, progress::Progress};
use clap::{Parser, Subcommand};
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

/// Measure translucent materials: photographs of a projector-lit slab to the matrix R_d(x_i, x_o) and a factored material.
#[derive(Debug, Parser)]
#[command(name = "acquire", version, after_help = EXAMPLES, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// No progress bars, notes and closing line; warnings and errors stay.
    #[arg(long, short, global = true)]
    quiet: bool,
    /// Number of threads [default: one per core].
    #[arg(long, global = true, value_name = "N")]
    threads: Option<usize>,
}

const EXAMPLES: &str = "\
Examples:
  acquire run captures/ --out results                  photographs to matrix, material, exports and report
  acquire check captures/                              whether it would build, in seconds
  acquire build-matrix captures/ --out slab.rd.zarr    only the matrix
  acquire factor slab.rd.zarr --out slab.safetensors   only the material
  acquire simulate demo --material chessboard-4x4      a capture without a rig

Exit status: 0 done, 1 the input cannot be used, 2 a fault of acquire itself.";

/// More only cost memory, and the system's patience.
const MOST_THREADS: usize = 1024;

#[derive(Debug, Subcommand)]
enum Command {
    Simulate(Box<simulate::Args>),
    Patterns(Box<patterns::Args>),
    Import(import::Args),
    ImportMatrix(import_matrix::Args),
    Check(check::Args),
    BuildMatrix(build_matrix::Args),
    Factor(factor::Args),
    Evaluate(evaluate::Args),
    Relight(relight::Args),
    Tradeoff(tradeoff::Args),
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
            message(line);
        }
    }

    /// Findings that did not stop the work, each kind once; notes are for those who want to hear all.
    fn tell<W: Clone + Into<crate::Warning>>(&self, findings: &[W]) {
        let findings: Vec<crate::Warning> = findings.iter().cloned().map(Into::into).collect();
        for (severity, line) in messages::told(&findings) {
            if severity > Severity::Note || !self.quiet {
                self.progress.say(format_args!("{}: {line}", severity.name()));
            }
        }
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
    // A panic has said where it was; it is ours, and ends like any other fault of ours.
    let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(cli)));
    match done.unwrap_or_else(|_| Err(Error::internal("the program panicked"))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            message(format_args!("error: {}", messages::text(&error)));
            if let Some(hint) = messages::hint(&error) {
                message(format_args!("hint: {hint}"));
            }
            ExitCode::from(if error.is_internal() { 2 } else { 1 })
        }
    }
}

/// A line on stderr; one that nobody reads must not end the work.
fn message(line: impl std::fmt::Display) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Data on stdout, which `| head` may have read all that it wants of.
fn print(text: &str) -> Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("write", "standard output")(e)),
        _ => Ok(()),
    }
}

/// Endings of material files.
const MATERIALS: [&str; 2] = ["safetensors", "acq"];

/// Refuses an output file that would fail or harm only after the work: a folder, a device, a file without a folder, one of `inputs`, a name
/// that ends in none of `endings`, an existing .safetensors or .acq file that this program did not write.
fn check_output(out: &Path, inputs: &[&Path], endings: &[&str]) -> Result<()> {
    let refuse = |expected: &str| {
        Err(Error::Setting { setting: "out", expected: expected.into(), found: out.display().to_string() })
    };
    if std::fs::metadata(out).is_ok_and(|kind| !kind.is_file()) {
        return refuse("a file");
    }
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Some(name) = out.file_name().filter(|_| folder.is_dir()) else {
        return refuse("a file in a folder that exists");
    };
    let folder = folder.canonicalize().map_err(Error::io("create", out))?;
    let places = [Some(folder.join(name)), out.canonicalize().ok()];
    let inputs: Vec<_> = inputs.iter().filter_map(|input| input.canonicalize().ok()).collect();
    if places.iter().flatten().any(|place| inputs.iter().any(|input| place.starts_with(input))) {
        return refuse("another file than the input");
    }
    let ending = out.extension().and_then(|e| e.to_str()).unwrap_or_default();
    if !endings.contains(&ending) {
        return refuse(&format!("a name that ends in .{}", endings.join(" or .")));
    }
    if MATERIALS.contains(&ending) && out.exists() && crate::material::load(out).is_err() {
        return Err(Error::NotOurs { path: out.to_path_buf() });
    }
    Ok(())
}

fn run(cli: Cli) -> Result<()> {
    if let Some(n) = cli.threads {
        let refuse =
            |expected: &str| Error::Setting { setting: "threads", expected: expected.into(), found: n.to_string() };
        if !(1..=MOST_THREADS).contains(&n) {
            return Err(refuse("1 to 1024 threads"));
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build_global();
        pool.map_err(|e| refuse(&format!("fewer threads (the system cannot start more: {e})")))?;
    }
    crate::output::remove_on_signals()?;
    let progress = if cli.quiet { Progress::silent() } else { Progress::terminal() };
    let context = Context { progress, quiet: cli.quiet };
    match cli.command {
        Command::Simulate(args) => simulate::run(*args, &context),
        Command::Patterns(args) => patterns::run(*args, &context),
        Command::Import(args) => import::run(args, &context),
        Command::ImportMatrix(args) => import_matrix::run(args, &context),
        Command::Check(args) => check::run(args, &context),
        Command::BuildMatrix(args) => build_matrix::run(args, &context),
        Command::Factor(args) => factor::run(args, &context),
        Command::Evaluate(args) => evaluate::run(args, &context),
        Command::Relight(args) => relight::run(args, &context),
        Command::Tradeoff(args) => tradeoff::run(args, &context),
        Command::Export(args) => export::run(args, &context),
        Command::Run(args) => run::run(args, &context),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_that_are_inputs_folders_or_devices_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let (input, store) = (folder.path().join("m.safetensors"), folder.path().join("m.rd.zarr"));
        std::fs::write(&input, "x").unwrap();
        std::fs::create_dir(&store).unwrap();
        std::fs::write(store.join("zarr.json"), "x").unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(&input, folder.path().join("link")).unwrap();
        let inputs = [input.as_path(), store.as_path()];
        let refused = |name: &str| check_output(&folder.path().join(name), &inputs, &MATERIALS).is_err();
        for name in ["m.safetensors", "./m.safetensors", "m.rd.zarr", "m.rd.zarr/zarr.json", "m.rd.zarr/new"] {
            assert!(refused(name), "{name}");
        }
        #[cfg(unix)]
        assert!(refused("link"));
        assert!(refused("") && refused("..") && refused("nowhere/x"));
        assert!(check_output(Path::new("/dev/null"), &[], &[""]).is_err(), "a rename would replace the device");
        assert!(!refused("new.safetensors") && !refused("new.acq"));
        assert!(refused("notes.txt") && refused("new"), "other names are of other files");
        std::fs::write(folder.path().join("model.safetensors"), "somebody's weights").unwrap();
        assert!(refused("model.safetensors"), "no material of this program");
    }
}
