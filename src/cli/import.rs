use super::{Context, options};
use crate::Result;
use crate::import::import;
use crate::words::count;
use std::path::PathBuf;

/// Sort a camera's folder of photographs into the shots of a plan.
///
/// Photographs are taken in the order of their EXIF times (and of the numbers in their names), and must repeat the
/// exposures that the plan's shots ask for. What does not fit is refused with the name of the first such photograph,
/// and nothing is written then.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire import /media/DCIM --plan plan --out captures/marble
  acquire import from-gphoto2 --plan plan --out captures/marble --link --take jpg

Then: acquire check captures/marble")]
pub(super) struct Args {
    /// Folder of the photographs, as the camera or gphoto2 made it.
    folder: PathBuf,
    /// Folder of plan.toml, as `acquire patterns` made it.
    #[arg(long, value_name = "DIR", value_parser = super::things::folder_of("plan.toml"))]
    plan: PathBuf,
    /// The capture to make.
    #[arg(long, short, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    options: options::Import,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let inputs = [Some(args.folder.as_path()), Some(&args.plan), args.options.calibration.as_deref()];
    super::check_folder("out", &args.out, &inputs.into_iter().flatten().collect::<Vec<_>>(), false)?;
    let done = import(&args.folder, &args.plan, &args.out, &args.options.into(), &context.progress)?;
    let out = args.out.display();
    let left = if done.left > 0 { format!(", {} of other kinds left", done.left) } else { String::new() };
    let ignored =
        if done.ignored > 0 { format!(", {} ignored", count(done.ignored, "other file")) } else { String::new() };
    let order = if done.by_number { "by the numbers in their names" } else { "by their times" };
    context.done(format_args!(
        "{out}: {} (.{}{left}{ignored}) in {}, {order}; next: acquire check {out}",
        count(done.photographs, "photograph"),
        done.kind,
        count(done.shots, "shot"),
    ));
    Ok(())
}
