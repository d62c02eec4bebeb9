//! `acquire simulate`: a capture without a rig, and its truth.

use super::{Context, options};
use crate::words::count;
use crate::{
    Result,
    simulate::{self, BenchKind, Cause, SimulateOptions, SlabMaterial, TakenOver},
};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  acquire simulate demo                                        18 × 14 points of one medium, in seconds
  acquire simulate demo --material chessboard-4x4 --seed 2     two media, other noise
  acquire simulate big --grid 32 --window 31                   more than 5000 photographs
  acquire simulate phone --sensor phone --format jpeg          8-bit, sRGB
  acquire simulate ideal --only                                what an ideal bench would measure
  acquire simulate drift --only drift                          what drift alone does to it
  acquire simulate worn --with psf,glare,hot-pixels,flicker    a bench with everyday faults
  acquire simulate other --bench oblique                       a camera 30° off the normal, no reference dots, …
  acquire simulate dark --material ketchup                     one medium of the table
  acquire simulate face --material layered:skin1=0.5,skin2=3   layers from the top, mm
  acquire simulate mine --voxels slab.npz                      coefficients of your own

Materials:
  homogeneous[:MEDIUM] or MEDIUM          one medium (marble; `marble` alone is the veined slab)
  chessboard-NxM[:MEDIUM,MEDIUM]          fields over the lit area (skin2, whole-milk), up to 256 along each axis
  marble[:MEDIUM,MEDIUM]                  stone with veins (marble, vein)
  layered[:MEDIUM=MM,MEDIUM=MM,…]         from the top (skin1, a quarter of the thickness, on whole-milk)
Media measured by Jensen et al. 2001: apple, chicken1, chicken2, cream, ketchup, marble, potato, skim-milk,
  skin1, skin2, spectralon, whole-milk. Not measured: vein, nearly-opaque, nearly-clear, lossless, one-channel-black.
A slab has one refractive index, that of its first medium.

Writes capture.toml, photos/, calibration/rig.toml and the truth: truth.rd.zarr, truth.toml.";

/// Write a simulated capture: photographs of a projector-lit slab, its rig, and the true matrix.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub(super) struct Args {
    /// The folder to write.
    dir: PathBuf,
    #[command(flatten)]
    options: Options,
}

/// All that can be asked of a simulation.
#[derive(Debug, clap::Args)]
pub(super) struct Options {
    #[command(flatten)]
    options: options::Simulate,
    /// A slab of voxels from an NPZ file or a Zarr group (docs/simulation.md), instead of --material.
    #[arg(long, value_name = "FILE.npz|DIR.zarr", conflicts_with = "material", help_heading = "Slab")]
    voxels: Option<PathBuf>,
    /// Another bench: its figures stand for all options below that are left at their defaults (docs/simulation.md).
    #[arg(long, value_enum, value_name = "BENCH", default_value = "usual", help_heading = "Capture")]
    bench: BenchKind,
    /// Only these causes of error, every other off; those of zero strength get a realistic one. None: an ideal bench.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', num_args = 0..=1, help_heading = "Switches")]
    only: Option<Vec<Cause>>,
    /// These causes besides those that are on; those of zero strength get a realistic one.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', help_heading = "Switches")]
    with: Vec<Cause>,
    /// Without these causes.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', help_heading = "Switches")]
    without: Vec<Cause>,
}

impl Options {
    /// As the library has them.
    pub(super) fn options(self) -> Result<SimulateOptions> {
        let mut options = SimulateOptions::from(self.options);
        if let Some(file) = self.voxels {
            options.material = SlabMaterial::Voxels(file);
        }
        options = options.on_bench(self.bench);
        options.switch(self.only.as_deref(), &self.with, &self.without)?;
        Ok(options)
    }
}

/// Runs the command.
pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    super::check_folder("DIR", &args.dir, args.options.voxels.as_deref().as_slice(), false)?;
    let options = args.options.options()?;
    let start = std::time::Instant::now();
    let summary = simulate::simulate(&options, &args.dir, &context.progress)?;
    context.tell(&summary.warnings);
    match summary.taken_over {
        TakenOver { anew: true, .. } => {
            context.done("a stopped run had begun with other options or as another version: all was made anew");
        }
        TakenOver { parts: 0, .. } => {}
        TakenOver { parts, .. } => {
            let what = if options.truth_only { "lit point" } else { "shot" };
            context.done(format_args!("{} made by a stopped run and taken over", count(parts, what)));
        }
    }
    let (dir, secs) = (args.dir.display(), start.elapsed().as_secs_f64());
    let noise = summary.photon_noise.map_or(String::new(), |noise| format!(" (photon noise {:.2} %)", 100.0 * noise));
    if options.truth_only {
        context.done(format_args!(
            "{dir}: the truth of {}{noise} in {secs:.1} s, no photographs",
            count(summary.shots, "shot")
        ));
        return Ok(());
    }
    context.done(format_args!(
        "{dir}: {} of {}, {} × {} px, {:.0} MB, and their truth{noise} in {secs:.1} s; next: acquire build-matrix {dir} --out {}.rd.zarr",
        count(summary.photographs, "photograph"),
        count(summary.shots, "shot"),
        summary.size_px[0],
        summary.size_px[1],
        summary.photograph_bytes as f64 / 1e6,
        args.dir.with_extension("").display(),
    ));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Simulate {
        #[command(flatten)]
        args: Args,
    }

    fn parsed(arguments: &[&str]) -> SimulateOptions {
        Simulate::try_parse_from([&["simulate", "dir"], arguments].concat()).unwrap().args.options.options.into()
    }

    #[test]
    fn without_arguments_the_options_are_the_library_s() {
        assert_eq!(parsed(&[]), SimulateOptions::default());
    }

    #[test]
    fn photons_may_be_written_with_an_exponent() {
        assert_eq!(parsed(&["--photons", "1e6"]).photons, 1_000_000);
        for wrong in ["1.5", "-3", "many", "1e20"] {
            assert!(Simulate::try_parse_from(["simulate", "dir", "--photons", wrong]).is_err(), "{wrong}");
        }
    }
}
