use super::Context;
use crate::Result;
use crate::output::remove_leftovers;
use crate::words::count;
use std::path::PathBuf;

/// Remove what runs have left that were killed, or lost their power or disk.
///
/// That is folders `.acquire-new-…`; those of runs that still work stay, and every file that is not of this program. A
/// run removes what it finds beside its output by itself, but for the work that another run had finished: the command
/// that was killed goes on from there when it is given again. `acquire clean` removes that, too.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire clean              here and in the folders below
  acquire clean captures/

Prints what was removed, a line each.")]
pub(super) struct Args {
    /// Where to look, and in all folders in it.
    #[arg(default_value = ".")]
    dir: PathBuf,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let removed = remove_leftovers(&args.dir, true)?;
    for path in &removed {
        super::print(&super::neutral(&path.display().to_string()))?;
    }
    context.done(format_args!("{} removed", count(removed.len(), "folder")));
    Ok(())
}
