//! The command line: one file per subcommand, raw arguments turned into checked settings before any work.

mod assemble;
mod build_matrix;
mod check;
mod clean;
mod evaluate;
mod export;
mod extract;
mod factor;
mod factor_part;
mod import;
mod import_matrix;
mod keywords;
mod messages;
mod options;
mod patterns;
mod prepare;
mod relight;
mod run;
mod simulate;
mod things;
mod tradeoff;
mod values;

pub use keywords::{build_options, factor_options, simulate_options};
use messages::one_line;

use crate::capture::Manifest;
use crate::files::check_local;
use crate::output::{check_apart, check_file};
use crate::pipeline::check_prepared;
use crate::simulate::TRUTH_MATRIX;
use crate::transport::{check_matrix, check_part};
use crate::{Error, Result, Severity, progress::Progress};
use clap::{Parser, Subcommand};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Measure translucent materials: photographs of a projector-lit slab to the matrix R_d(x_i, x_o) and a factored
/// material.
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
    Prepare(prepare::Args),
    Extract(extract::Args),
    Assemble(assemble::Args),
    Factor(factor::Args),
    FactorPart(factor_part::Args),
    Evaluate(evaluate::Args),
    Relight(relight::Args),
    Tradeoff(tradeoff::Args),
    Export(export::Args),
    Run(run::Args),
    Clean(clean::Args),
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
                self.progress.say(neutral(&format!("{}: {line}", severity.name())));
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
            let plain = e.render().to_string();
            match neutral(&plain) == plain {
                true => drop(e.print()),
                false => message(plain),
            }
            return ExitCode::from(code);
        }
    };
    // A panic has said where it was; it is ours, and ends like any other fault of ours.
    let quiet = cli.quiet;
    let done = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(cli)));
    for path in crate::output::take_removed().iter().filter(|_| !quiet) {
        message(format_args!("note: removed {}, which a stopped run had left", path.display()));
    }
    let kept = crate::output::take_kept();
    match done.unwrap_or_else(|_| Err(Error::internal("the program panicked"))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            message(format_args!("error: {}", messages::text(&error)));
            if let Some(hint) = messages::hint(&error) {
                message(format_args!("hint: {hint}"));
            }
            for path in kept {
                message(format_args!(
                    "kept: what was finished, in {}; the same command goes on from there, `acquire clean` removes it",
                    path.display()
                ));
            }
            ExitCode::from(if error.is_internal() { 2 } else { 1 })
        }
    }
}

/// A line on stderr; one that nobody reads must not end the work.
fn message(line: impl std::fmt::Display) {
    let _ = writeln!(std::io::stderr(), "{}", neutral(&line.to_string()));
}

/// Text in which names of files cannot make a terminal do anything: control characters, and those that turn the
/// direction of writing, are spelled out.
fn neutral(text: &str) -> String {
    let obeyed = |c: char| {
        c.is_control() && c != '\n' && c != '\t'
            || matches!(c, '\u{200e}' | '\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
    };
    text.chars().map(|c| if obeyed(c) { c.escape_unicode().to_string() } else { c.to_string() }).collect()
}

/// Data on stdout, which `| head` may have read all that it wants of.
fn print(text: &str) -> Result<()> {
    match writeln!(std::io::stdout(), "{text}") {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Error::io("write", "standard output")(e)),
        _ => Ok(()),
    }
}

/// Endings of material files.
pub const MATERIALS: [&str; 2] = ["safetensors", "acq"];

/// Refuses an output file that would fail or harm only after the work: a folder, a device, a file without a folder, a
/// place that is not apart from `inputs`, a name that ends in none of `endings`, an existing file unless `force`, and
/// one that this program has not made. `setting` is the option that names it.
///
/// # Errors
/// [`Error::NotLocal`], [`Error::Setting`], [`Error::Exists`], [`Error::NotOurs`], [`Error::Io`].
pub fn check_output(setting: &'static str, out: &Path, inputs: &[&Path], endings: &[&str], force: bool) -> Result<()> {
    let refuse =
        |expected: &str| Err(Error::Setting { setting, expected: expected.into(), found: out.display().to_string() });
    check_local(out)?;
    if std::fs::metadata(out).is_ok_and(|kind| !kind.is_file()) {
        return refuse("a file");
    }
    let folder = out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if out.file_name().is_none() || !folder.is_dir() {
        return refuse("a file in a folder that exists");
    }
    check_apart(setting, out, inputs)?;
    if !endings.contains(&ending(out).as_str()) {
        return refuse(&format!("a name that ends in .{}", endings.join(" or .")));
    }
    check_file(out, force).map(|_| ())
}

/// Endings of files that this program or others write: a folder under such a name would be taken for one.
const FILES: [&str; 22] = [
    "acq",
    "arw",
    "bmp",
    "cr2",
    "csv",
    "dng",
    "exr",
    "gif",
    "html",
    "jpeg",
    "jpg",
    "json",
    "nef",
    "npy",
    "npz",
    "pdf",
    "png",
    "safetensors",
    "tif",
    "tiff",
    "toml",
    "txt",
];

/// Refuses a matrix to write that is not apart from `inputs`, whose name ends like that of a file, an existing one
/// unless `force`, and what this program has not made. `setting` is the option that names it.
///
/// # Errors
/// [`Error::Setting`], [`Error::NotEmpty`], [`Error::NotOurs`], [`Error::Changed`], [`Error::Io`].
pub fn check_matrix_output<P: AsRef<Path>>(setting: &'static str, out: &Path, inputs: &[P], force: bool) -> Result<()> {
    check_folder(setting, out, inputs, true)?;
    check_matrix(out, force).map(|_| ())
}

/// Refuses a part to write that is not apart from `inputs`, whose name does not end as those of parts, by which
/// `acquire assemble` finds them, and what is no part.
///
/// # Errors
/// [`Error::Setting`], [`Error::NotOurs`], [`Error::Io`].
pub fn check_part_output<P: AsRef<Path>>(out: &Path, inputs: &[P]) -> Result<()> {
    check_of_task(out, inputs, "part")?;
    check_part(out)
}

/// The same for what shots have in common.
///
/// # Errors
/// Those of [`check_part_output`].
pub fn check_prepared_output<P: AsRef<Path>>(out: &Path, inputs: &[P]) -> Result<()> {
    check_of_task(out, inputs, "prepared")?;
    check_prepared(out)
}

fn check_of_task<P: AsRef<Path>>(out: &Path, inputs: &[P], end: &str) -> Result<()> {
    check_apart("out", out, inputs)?;
    if ending(out) != end {
        let expected = format!("a name that ends in .{end}");
        return Err(Error::Setting { setting: "out", expected, found: out.display().to_string() });
    }
    Ok(())
}

/// Refuses an output folder that is not apart from `inputs`, or whose name ends like that of a file, or of a matrix
/// (`.zarr`) that it is not.
///
/// # Errors
/// [`Error::Setting`], [`Error::Io`].
pub fn check_folder<P: AsRef<Path>>(setting: &'static str, out: &Path, inputs: &[P], is_matrix: bool) -> Result<()> {
    check_apart(setting, out, inputs)?;
    let ending = ending(out);
    if FILES.contains(&ending.as_str()) || (ending == "zarr" && !is_matrix) {
        let expected = if is_matrix { "a name that ends in .rd.zarr" } else { "the name of a folder" };
        return Err(Error::Setting { setting, expected: expected.into(), found: out.display().to_string() });
    }
    Ok(())
}

/// What a build reads, and what an evaluation of it needs: an output may lie beside these in the capture's folder, and
/// may not hold one of them.
pub fn inputs_of(capture: &Path, calibration: Option<&Path>) -> Vec<PathBuf> {
    // A manifest that cannot be read is told of when it is needed.
    let Ok(manifest) = Manifest::read(capture) else { return vec![capture.to_path_buf()] };
    let kept = ["capture.toml", "calibration", TRUTH_MATRIX].map(|name| capture.join(name));
    let photographs = manifest.shots.iter().flat_map(|s| &s.photographs).map(|p| capture.join(&p.file));
    calibration.into_iter().map(Path::to_path_buf).chain(kept).chain(photographs).collect()
}

fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
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
        Command::Prepare(args) => prepare::run(args, &context),
        Command::Extract(args) => extract::run(args, &context),
        Command::Assemble(args) => assemble::run(args, &context),
        Command::Factor(args) => factor::run(args, &context),
        Command::FactorPart(args) => factor_part::run(args, &context),
        Command::Evaluate(args) => evaluate::run(args, &context),
        Command::Relight(args) => relight::run(args, &context),
        Command::Tradeoff(args) => tradeoff::run(args, &context),
        Command::Export(args) => export::run(args, &context),
        Command::Run(args) => run::run(args, &context),
        Command::Clean(args) => clean::run(args, &context),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_whose_name_is_that_of_a_file_or_of_a_matrix_is_refused() {
        let refused = |name: &str, is_matrix| check_folder::<&Path>("out", Path::new(name), &[], is_matrix).is_err();
        for name in ["a.exr", "a.SAFETENSORS", "a.rd.zarr", "a.zarr"] {
            assert!(refused(name, false), "{name}");
        }
        assert!(refused("a.npz", true) && !refused("a.rd.zarr", true) && !refused("a", true));
        assert!(!refused("results", false) && !refused("slab.v2", false) && !refused("..", false));
    }

    #[test]
    fn what_a_terminal_would_obey_is_shown_as_text() {
        assert_eq!(neutral("a\u{1b}[31m\u{7}b\u{9b}\tc\nd \u{202e}é"), "a\\u{1b}[31m\\u{7}b\\u{9b}\tc\nd \\u{202e}é");
    }

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
        let refused = |name: &str| check_output("out", &folder.path().join(name), &inputs, &MATERIALS, true).is_err();
        for name in ["m.safetensors", "./m.safetensors", "m.rd.zarr", "m.rd.zarr/zarr.json", "m.rd.zarr/new"] {
            assert!(refused(name), "{name}");
        }
        #[cfg(unix)]
        assert!(refused("link"));
        assert!(refused("") && refused("..") && refused("nowhere/x"));
        assert!(
            check_output("out", Path::new("/dev/null"), &[], &[""], true).is_err(),
            "a rename would replace the device"
        );
        assert!(!refused("new.safetensors") && !refused("new.acq"));
        assert!(refused("notes.txt") && refused("new"), "other names are of other files");
        std::fs::write(folder.path().join("model.safetensors"), "somebody's weights").unwrap();
        assert!(refused("model.safetensors"), "no material of this program");
    }
}
