use super::{Context, options};
use crate::check::{Severity, check, table};
use crate::words::count;
use crate::{Error, Result};
use std::io::IsTerminal;
use std::path::PathBuf;

/// Check in seconds whether a capture would build, and list what is unusual.
///
/// Reads every photograph's head, and takes a few of the lattice shots the whole way of build-matrix. Looks at missing
/// and broken files, exposures, settings that changed or were automatic, the order of shooting, saturation, focus,
/// registration, drift and dots.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire check captures/
  acquire check captures/ --calibration lab/rig-3 --lattice-shots 32
  acquire check captures/ --json | jq -r '.findings[] | .severity + \": \" + .seen'

Each topic is good, look (it builds, but needs a look) or bad. Exit status 1 when build-matrix would fail, 0 otherwise.")]
pub(super) struct Args {
    /// Folder of capture.toml.
    #[arg(value_parser = super::things::folder_of("capture.toml"))]
    capture: PathBuf,
    #[command(flatten)]
    options: options::Check,
    /// Print one JSON object instead of a table.
    #[arg(long)]
    json: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let start = std::time::Instant::now();
    let report = check(&args.capture, &args.options.into(), &context.progress)?;
    let out = std::io::stdout();
    let text = match args.json {
        true => serde_json::to_string_pretty(&report.json()?).map_err(Error::internal)?,
        false => table(&report, out.is_terminal() && std::env::var_os("NO_COLOR").is_none()),
    };
    super::print(&text)?;
    let warnings = report.findings.iter().filter(|f| report.record(f).severity == Severity::Warning).count();
    let figures = &report.figures;
    let sample = format!("{} of {}", figures.lattice_shots_looked_at, count(figures.lattice_shots, "lattice shot"));
    match report.stopped_by {
        Some(reason) => Err(Error::WouldNotBuild { reason: Box::new(reason) }),
        None => {
            let secs = start.elapsed().as_secs_f64();
            context
                .done(format_args!("would build; {}; {sample} looked at in {secs:.1} s", count(warnings, "warning")));
            Ok(())
        }
    }
}
