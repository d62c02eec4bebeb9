//! `acquire simulate`: a capture without a rig, and its truth.

use super::Context;
use crate::{
    Result,
    simulate::{self, Cause, FileFormat, Material, Options, Response, SensorKind, Transport},
};
use std::path::PathBuf;

const EXAMPLES: &str = "\
Examples:
  acquire simulate demo                                        16 × 16 points of one medium, in seconds
  acquire simulate demo --material chessboard-4x4 --seed 2     two media, other noise
  acquire simulate big --grid 32 --window 31                   more than 5000 photographs
  acquire simulate phone --sensor phone --format jpeg          8-bit, sRGB
  acquire simulate ideal --only                                what an ideal bench would measure
  acquire simulate drift --only drift                          what drift alone does to it
  acquire simulate worn --with psf,glare,hot-pixels,flicker    a bench with everyday faults
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
    /// Replace DIR when it is an earlier simulation.
    #[arg(long)]
    force: bool,
    /// The slab's material; the forms are listed below.
    #[arg(long, default_value = "homogeneous", help_heading = "Slab")]
    material: Material,
    /// A slab of voxels from an NPZ file or a Zarr group (docs/simulation.md), instead of --material.
    #[arg(long, value_name = "FILE.npz|DIR.zarr", conflicts_with = "material", help_heading = "Slab")]
    voxels: Option<PathBuf>,
    /// Mean cosine of the scattering angle in every medium, −0.99 to 0.99; the reduced scattering stays as it is [default: 0].
    #[arg(long, value_name = "G", allow_negative_numbers = true, help_heading = "Slab")]
    anisotropy: Option<f64>,
    /// Thickness of the slab, mm [default: that of the layers or voxels, or 4].
    #[arg(long, value_name = "MM", help_heading = "Slab")]
    thickness_mm: Option<f64>,
    /// What solves for the light inside the slab.
    #[arg(long, value_enum, default_value = "diffusion", help_heading = "Slab")]
    transport: Transport,
    /// Photons for a dot and channel, with --transport mc.
    #[arg(long, value_name = "N", default_value_t = Options::default().photons, value_parser = photons, help_heading = "Slab")]
    photons: u64,
    /// Voxels of the transport solver across an outgoing cell.
    #[arg(long, value_name = "N", default_value_t = Options::default().voxels_per_sample, help_heading = "Slab")]
    voxels_per_sample: usize,
    /// Lit points along each axis.
    #[arg(long, value_name = "N", default_value_t = Options::default().grid, help_heading = "Capture")]
    grid: usize,
    /// Outgoing samples of a window along each axis, odd.
    #[arg(long, value_name = "N", default_value_t = Options::default().window, help_heading = "Capture")]
    window: usize,
    /// Side of an outgoing cell, mm.
    #[arg(long, value_name = "MM", default_value_t = Options::default().pitch_mm, help_heading = "Capture")]
    pitch_mm: f64,
    /// Distance of lit points, mm [default: the pitch].
    #[arg(long, value_name = "MM", help_heading = "Capture")]
    lit_pitch_mm: Option<f64>,
    /// Distance of the dots of one shot, in lit points [default: one and a half windows].
    #[arg(long, value_name = "N", help_heading = "Capture")]
    spacing: Option<usize>,
    /// Exposures of each lattice shot.
    #[arg(long, value_name = "N", default_value_t = Options::default().exposures, help_heading = "Capture")]
    exposures: usize,
    /// Stops between exposures.
    #[arg(long, value_name = "STOPS", default_value_t = Options::default().stops, help_heading = "Capture")]
    stops: f64,
    /// Seed of everything random: noise, drift, jumps, flicker, hot pixels, veins.
    #[arg(long, value_name = "N", default_value_t = Options::default().seed, help_heading = "Capture")]
    seed: u64,
    /// Whose sensor: gain, noise, bits and black level.
    #[arg(long, value_enum, default_value = "sony-a7r3", help_heading = "Camera")]
    sensor: SensorKind,
    /// Bits of its converter [default: its own].
    #[arg(long, value_name = "BITS", help_heading = "Camera")]
    bits: Option<u32>,
    /// Format of the photographs.
    #[arg(long, value_enum, default_value = "png", help_heading = "Camera")]
    format: FileFormat,
    /// Response curve; the rig file takes `film` for sRGB [default: linear for PNG, srgb for JPEG].
    #[arg(long, value_enum, help_heading = "Camera")]
    response: Option<Response>,
    /// Camera pixels across an outgoing cell.
    #[arg(long, value_name = "PX", default_value_t = Options::default().camera_px_per_sample, help_heading = "Camera")]
    camera_px_per_sample: f64,
    /// Lens distortion, Brown's k1.
    #[arg(long, value_name = "K1", allow_negative_numbers = true, default_value_t = Options::default().distortion, help_heading = "Camera")]
    distortion: f64,
    /// Sensitivity lost at the corner.
    #[arg(long, value_name = "SHARE", default_value_t = Options::default().vignetting, help_heading = "Camera")]
    vignetting: f64,
    /// Standard deviation of the point-spread function, px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().psf_px, help_heading = "Camera")]
    psf_px: f64,
    /// Share of the light in a halo of 20 px.
    #[arg(long, value_name = "SHARE", default_value_t = Options::default().glare, help_heading = "Camera")]
    glare: f64,
    /// Share of the photosites that are hot.
    #[arg(long, value_name = "SHARE", default_value_t = Options::default().hot_pixels, help_heading = "Camera")]
    hot_pixels: f64,
    /// Projector pixels between neighbouring lit points.
    #[arg(long, value_name = "PX", default_value_t = Options::default().step_projector_px, help_heading = "Projector")]
    step_projector_px: usize,
    /// Side of a dot, projector pixels.
    #[arg(long, value_name = "PX", default_value_t = Options::default().dot_projector_px, help_heading = "Projector")]
    dot_projector_px: usize,
    /// Blur of a projector pixel (standard deviation), projector pixels.
    #[arg(long, value_name = "PX", default_value_t = Options::default().projector_blur_px, help_heading = "Projector")]
    projector_blur_px: f64,
    /// Irradiance of a black projector pixel over that of a white one.
    #[arg(long, value_name = "RATIO", default_value_t = Options::default().projector_black, help_heading = "Projector")]
    projector_black: f64,
    /// Irradiance lost towards the corner.
    #[arg(long, value_name = "SHARE", default_value_t = Options::default().falloff, help_heading = "Projector")]
    falloff: f64,
    /// Standard deviation of the lamp from photograph to photograph, of its output.
    #[arg(long, value_name = "RATIO", default_value_t = Options::default().flicker, help_heading = "Projector")]
    flicker: f64,
    /// Ambient irradiance over that of projector white.
    #[arg(long, value_name = "RATIO", default_value_t = Options::default().ambient, help_heading = "Projector")]
    ambient: f64,
    /// Slow walk of the pattern: root mean square over the lattice shots, camera px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().drift_px, help_heading = "Drift")]
    drift_px: f64,
    /// Length of its jumps, camera px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().jump_px, help_heading = "Drift")]
    jump_px: f64,
    /// Number of its jumps.
    #[arg(long, value_name = "N", default_value_t = Options::default().jumps, help_heading = "Drift")]
    jumps: usize,
    /// Slow walk of the camera's picture, root mean square, px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().camera_drift_px, help_heading = "Drift")]
    camera_drift_px: f64,
    /// Length of its jumps, px.
    #[arg(long, value_name = "PX", default_value_t = Options::default().camera_jump_px, help_heading = "Drift")]
    camera_jump_px: f64,
    /// Number of its jumps.
    #[arg(long, value_name = "N", default_value_t = Options::default().camera_jumps, help_heading = "Drift")]
    camera_jumps: usize,
    /// Only these causes of error, every other off; those of zero strength get a realistic one. None: an ideal bench.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', num_args = 0..=1, help_heading = "Switches")]
    only: Option<Vec<Cause>>,
    /// These causes besides those that are on; those of zero strength get a realistic one.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', help_heading = "Switches")]
    with: Vec<Cause>,
    /// Without these causes.
    #[arg(long, value_enum, value_name = "CAUSES", value_delimiter = ',', help_heading = "Switches")]
    without: Vec<Cause>,
    /// No photon and read noise, only rounding: as `--without noise`.
    #[arg(long, help_heading = "Switches")]
    noise_free: bool,
}

impl Args {
    fn options(&self) -> Result<Options> {
        let mut options = Options {
            material: self.voxels.clone().map_or(self.material.clone(), Material::Voxels),
            anisotropy: self.anisotropy,
            voxels_blake3: None,
            transport: self.transport,
            photons: self.photons,
            thickness_mm: self.thickness_mm,
            voxels_per_sample: self.voxels_per_sample,
            grid: self.grid,
            window: self.window,
            pitch_mm: self.pitch_mm,
            lit_pitch_mm: self.lit_pitch_mm,
            spacing: self.spacing,
            exposures: self.exposures,
            stops: self.stops,
            seed: self.seed,
            sensor: self.sensor,
            bits: self.bits,
            format: self.format,
            response: self.response,
            camera_px_per_sample: self.camera_px_per_sample,
            distortion: self.distortion,
            vignetting: self.vignetting,
            psf_px: self.psf_px,
            glare: self.glare,
            hot_pixels: self.hot_pixels,
            step_projector_px: self.step_projector_px,
            dot_projector_px: self.dot_projector_px,
            projector_blur_px: self.projector_blur_px,
            projector_black: self.projector_black,
            falloff: self.falloff,
            flicker: self.flicker,
            ambient: self.ambient,
            drift_px: self.drift_px,
            jump_px: self.jump_px,
            jumps: self.jumps,
            camera_drift_px: self.camera_drift_px,
            camera_jump_px: self.camera_jump_px,
            camera_jumps: self.camera_jumps,
            noise_free: self.noise_free,
            tolerance: Options::default().tolerance,
            force: self.force,
        };
        options.switch(self.only.as_deref(), &self.with, &self.without)?;
        Ok(options)
    }
}

/// A whole number, also as 1e6.
fn photons(text: &str) -> std::result::Result<u64, String> {
    let number: f64 = text.parse().map_err(|_| "a number such as 100000 or 1e6".to_owned())?;
    if number.fract() == 0.0 && (0.0..1e15).contains(&number) {
        Ok(number as u64)
    } else {
        Err("a whole number".into())
    }
}

/// Runs the command.
pub fn run(args: Args, context: &Context) -> Result<()> {
    let options = args.options()?;
    let start = std::time::Instant::now();
    let summary = simulate::simulate(&options, &args.dir, &context.progress)?;
    for warning in &summary.warnings {
        context.warn(warning);
    }
    let dir = args.dir.display();
    let noise = summary.photon_noise.map_or(String::new(), |noise| format!(" (photon noise {:.2} %)", 100.0 * noise));
    context.done(format_args!(
        "{dir}: {} photographs of {} shots, {} × {} px, {:.0} MB, and their truth{noise} in {:.1} s; next: acquire build-matrix {dir} --out {}.rd.zarr",
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
