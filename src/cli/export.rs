use super::Context;
use crate::Result;
use crate::material::{self, export_exr, export_npz};
use std::path::PathBuf;

/// Write a material's factors as OpenEXR layers or as a NumPy archive.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire export slab.safetensors --to npz --out slab.npz     np.load(\"slab.npz\")[\"offset_factors\"]
  acquire export slab.safetensors --to exr --out slab.exr     one part per map, for any viewer")]
pub(super) struct Args {
    /// The material, a file *.safetensors.
    material: PathBuf,
    /// What to write.
    #[arg(long, value_enum)]
    to: Format,
    /// The file to write [default: the material's name with the format's extension].
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an earlier export there.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Format {
    /// OpenEXR, one part per factor and per power of the colour polynomial.
    Exr,
    /// NumPy, every tensor by name.
    Npz,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let ending = match args.to {
        Format::Exr => "exr",
        Format::Npz => "npz",
    };
    let out = args.out.unwrap_or_else(|| args.material.with_extension(ending));
    super::check_output("out", &out, &[&args.material], &[ending], args.force)?;
    let material = material::load(&args.material)?;
    match args.to {
        Format::Exr => export_exr(&material, &out)?,
        Format::Npz => export_npz(&material, &out)?,
    }
    let h = &material.header;
    context.done(format_args!("{}: {}", out.display(), h.describe()));
    Ok(())
}
