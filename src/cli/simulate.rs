//! `acquire simulate`: a capture without a rig, and its truth.

use super::Context;
use crate::{
    Result,
    simulate::{self, FileFormat, Material, Options},
};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  acquire simulate demo                                        16 × 16 points of marble, in seconds
  acquire simulate demo --material chessboard-4x4 --seed 2     two media, other noise
  acquire simulate big --grid 32 --window 31                   5120 photographs and more
  acquire simulate clean --noise-free --drift-px 0             what an ideal bench would measure
  acquire simulate phone --format jpeg                         8-bit, sRGB
  acquire simulate dark --material ketchup                     one medium of the table
  acquire simulate face --material layered:skin1=0.5,skin2=3   layers from the top, mm
  acquire simulate mine --voxels slab.npz                      coefficients of your own

Materials:
  homogeneous[:MEDIUM] or MEDIUM          one medium (marble; `marble` alone is the veined slab)
  chessboard-NxN[:MEDIUM,MEDIUM]          squares over the lit area (skin2, whole-milk), N up to 256
  marble[:MEDIUM,MEDIUM]                  stone with veins (marble, vein)
  layered[:MEDIUM=MM,MEDIUM=MM,…]         from the top (skin1, a quarter of the thickness, on whole-milk)
Media measured by Jensen et al. 2001: apple, chicken1, chicken2, cream, ketchup, marble, potato, skim-milk,
  skin1, skin2, spectralon, whole-milk. Not measured: vein, nearly-opaque, nearly-clear, lossless, one-channel-black.
A slab has one refractive index, that of its first medium.

Writes capture.toml, photos/, calibration/rig.toml and the truth: truth.rd.zarr, truth.toml.";

/// Write a simulated capture: photographs of a projector-lit slab, its rig, and the true matrix.
#[derive(Debug, clap::Args)]
#[command(after_help = EXAMPLES)]
pub struct Args {
    /// The folder to write.
    dir: PathBuf,
    /// The slab's material; the forms are listed below.
    #[arg(long, default_value = "homogeneous")]
    material: Material,
    /// A slab of voxels from an NPZ file or a Zarr group (docs/simulation.md), instead of --material.
    #[arg(long, value_name = "FILE.npz|DIR.zarr", conflicts_with = "material")]
    voxels: Option<PathBuf>,
    /// Mean cosine of the scattering angle in every medium, −0.99 to 0.99; the reduced scattering stays as it is [default: 0].
    #[arg(long, value_name = "G", allow_negative_numbers = true)]
    anisotropy: Option<f64>,
    /// Lit points along each axis.
    #[arg(long, value_name = "N", default_value_t = Options::default().grid)]
    grid: usize,
    /// Outgoing samples of a window along each axis, odd.
    #[arg(long, value_name = "N", default_value_t = Options::default().window)]
    window: usize,
    /// Seed of noise, drift and veins.
    #[arg(long, value_name = "N", default_value_t = Options::default().seed)]
    seed: u64,
    /// No photon and read noise, only rounding.
    #[arg(long)]
    noise_free: bool,
    /// Root mean square drift of the lattice shots, camera px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().drift_px)]
    drift_px: f64,
    /// Side of an outgoing cell, mm.
    #[arg(long, value_name = "MM", default_value_t = Options::default().pitch_mm)]
    pitch_mm: f64,
    /// Distance of lit points, mm [default: the pitch].
    #[arg(long, value_name = "MM")]
    lit_pitch_mm: Option<f64>,
    /// Distance of the dots of one shot, in lit points [default: one and a half windows].
    #[arg(long, value_name = "N")]
    spacing: Option<usize>,
    /// Exposures of each lattice shot.
    #[arg(long, value_name = "N", default_value_t = Options::default().exposures)]
    exposures: usize,
    /// Stops between exposures.
    #[arg(long, value_name = "STOPS", default_value_t = Options::default().stops)]
    stops: f64,
    /// Format of the photographs.
    #[arg(long, value_enum, default_value = "png")]
    format: FileFormat,
    /// Bits of the sensor (PNG).
    #[arg(long, value_name = "BITS", default_value_t = Options::default().bits)]
    bits: u32,
    /// Camera pixels across an outgoing cell.
    #[arg(long, value_name = "PX", default_value_t = Options::default().camera_px_per_sample)]
    camera_px_per_sample: f64,
    /// Thickness of the slab, mm [default: that of the layers or voxels, or 4].
    #[arg(long, value_name = "MM")]
    thickness_mm: Option<f64>,
    /// Voxels of the transport solver across an outgoing cell.
    #[arg(long, value_name = "N", default_value_t = Options::default().voxels_per_sample)]
    voxels_per_sample: usize,
    /// Projector pixels between neighbouring lit points.
    #[arg(long, value_name = "PX", default_value_t = Options::default().step_projector_px)]
    step_projector_px: usize,
    /// Side of a dot, projector pixels.
    #[arg(long, value_name = "PX", default_value_t = Options::default().dot_projector_px)]
    dot_projector_px: usize,
    /// Irradiance of a black projector pixel over that of a white one.
    #[arg(long, value_name = "RATIO", default_value_t = Options::default().projector_black)]
    projector_black: f64,
    /// Replace DIR when it exists.
    #[arg(long)]
    force: bool,
}

/// Runs the command.
pub fn run(args: Args, context: &Context) -> Result<()> {
    let options = Options {
        material: args.voxels.map_or(args.material, Material::Voxels),
        anisotropy: args.anisotropy,
        grid: args.grid,
        window: args.window,
        seed: args.seed,
        noise_free: args.noise_free,
        drift_px: args.drift_px,
        pitch_mm: args.pitch_mm,
        lit_pitch_mm: args.lit_pitch_mm,
        spacing: args.spacing,
        exposures: args.exposures,
        stops: args.stops,
        format: args.format,
        bits: args.bits,
        camera_px_per_sample: args.camera_px_per_sample,
        thickness_mm: args.thickness_mm,
        voxels_per_sample: args.voxels_per_sample,
        step_projector_px: args.step_projector_px,
        dot_projector_px: args.dot_projector_px,
        projector_black: args.projector_black,
        force: args.force,
        ..Options::default()
    };
    let start = std::time::Instant::now();
    let summary = simulate::simulate(&options, &args.dir, &context.progress)?;
    for warning in &summary.warnings {
        context.warn(warning);
    }
    let dir = args.dir.display();
    context.done(format_args!(
        "{dir}: {} photographs of {} shots, {} × {} px, {:.0} MB, and their truth in {:.1} s; next: acquire build-matrix {dir} --out {}.rd.zarr",
        summary.photographs,
        summary.shots,
        summary.size_px[0],
        summary.size_px[1],
        summary.photograph_bytes as f64 / 1e6,
        start.elapsed().as_secs_f64(),
        args.dir.with_extension("").display(),
    ));
    Ok(())
}
