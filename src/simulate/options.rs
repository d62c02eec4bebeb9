//! What to simulate.

use super::slab::Material;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// The photographs' file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FileFormat {
    /// 16-bit PNG. With a linear response it holds the sensor's code values unscaled.
    Png,
    /// 8-bit JPEG (quality 95, no chroma subsampling).
    Jpeg,
}

/// Whose sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// Sony A7R III: 14 bits, 7.5 e⁻ of read noise.
    #[value(name = "sony-a7r3")]
    #[serde(rename = "sony-a7r3")]
    SonyA7r3,
    /// Sony A7R: 14 bits, 0.7 e⁻.
    #[value(name = "sony-a7r1")]
    #[serde(rename = "sony-a7r1")]
    SonyA7r1,
    /// Canon T1i: 14 bits, 4.3 e⁻, three times the gain.
    #[value(name = "canon-t1")]
    #[serde(rename = "canon-t1")]
    CanonT1,
    /// A phone: 10 bits, 7.8 e⁻.
    Phone,
}

/// What solves for the light inside the slab.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Transport {
    /// Diffusion: fast and without noise, wrong near the source and for media that absorb much or scatter little.
    Diffusion,
    /// Photon Monte Carlo: right, and noisy.
    Mc,
}

/// How code values encode light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Response {
    /// Code values in proportion to light, above the sensor's black level.
    Linear,
    /// The sRGB curve.
    Srgb,
    /// A film-like curve with toe and shoulder; the rig file says sRGB, as a lab would guess.
    Film,
}

/// Everything that makes a simulated capture; the same options give the same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Options {
    /// The material. Homogeneous: the simplest truth.
    pub material: Material,
    /// Mean cosine g of the scattering angle in every medium, σ'_s as it is. None: the voxel file's, or 0, as the table of media has none.
    pub anisotropy: Option<f64>,
    /// BLAKE3 of the voxel file: `simulate` records it, and refuses another file when it is given.
    pub voxels_blake3: Option<String>,
    /// What solves for the light. Diffusion: seconds.
    pub transport: Transport,
    /// Photons that Monte Carlo traces for a dot and channel. 100,000: about 1 % of noise in a row, half a second a dot.
    pub photons: u64,
    /// Lit points along each axis. 16: minutes of a lab's time, seconds of ours.
    pub grid: usize,
    /// Outgoing samples of a window along each axis, odd. 15: the peak and most of the tails.
    pub window: usize,
    /// Seed of noise, drift and veins.
    pub seed: u64,
    /// No photon and read noise, only rounding. False: as a camera.
    pub noise_free: bool,
    /// Root mean square displacement of the lattice shots' dots, camera px at the slab's centre. 0.5: a bench that was touched.
    pub drift_px: f64,
    /// Side of an outgoing cell, mm. 0.5: responses of the default materials fall by 3 to 4 decades within a window of 31.
    pub pitch_mm: f64,
    /// Nominal distance of lit points, mm. None: the pitch.
    pub lit_pitch_mm: Option<f64>,
    /// Distance of the dots of one shot in lit points. None: one and a half windows, so that no dot lights another's window.
    pub spacing: Option<usize>,
    /// Exposures of each lattice shot. 5.
    pub exposures: usize,
    /// Stops between them. 2: five exposures reach over the 16 bits of a response.
    pub stops: f64,
    /// The photographs' format. PNG.
    pub format: FileFormat,
    /// Whose sensor. A7R III: a current camera.
    pub sensor: SensorKind,
    /// Bits of the sensor's converter. None: its own. A JPEG file has 8 always.
    pub bits: Option<u32>,
    /// How code values encode light. None: linear for PNG, sRGB for JPEG.
    pub response: Option<Response>,
    /// Lens distortion, Brown's k₁; k₂ is −k₁/5. −0.05: a good lens, 3 px at the corner of a picture of 1000.
    pub distortion: f64,
    /// Sensitivity lost at the corner of the picture. 0.15: a good lens, stopped down.
    pub vignetting: f64,
    /// Standard deviation of the lens's point-spread function, px. 0: pixels average over their area, and that is all.
    pub psf_px: f64,
    /// Share of the light that the lens scatters into a wide halo. 0.
    pub glare: f64,
    /// Share of the photosites that are hot. 0.
    pub hot_pixels: f64,
    /// Standard deviation of the lamp's output from photograph to photograph, relative. 0.
    pub flicker: f64,
    /// Distance that the projected pattern jumps, camera px at the slab's centre. 0.
    pub jump_px: f64,
    /// How often it jumps during the sweep of lattice shots. 3.
    pub jumps: usize,
    /// Root mean square displacement of the camera during the sweep, px. 0.
    pub camera_drift_px: f64,
    /// Distance that the camera's picture jumps, px. 0.
    pub camera_jump_px: f64,
    /// How often it jumps. 3.
    pub camera_jumps: usize,
    /// Camera pixels across an outgoing cell, about. 3: enough for sub-cell registration.
    pub camera_px_per_sample: f64,
    /// Thickness of the slab, mm. None: the material's own, or 4, thin enough to confine light to the window.
    pub thickness_mm: Option<f64>,
    /// Voxels across an outgoing cell. 2.
    pub voxels_per_sample: usize,
    /// Projector pixels between neighbouring lit points. 4.
    pub step_projector_px: usize,
    /// Side of a dot, projector px. 3: a dark pixel between neighbours.
    pub dot_projector_px: usize,
    /// Irradiance of a black projector pixel over that of a white one. 1/5000: more would saturate the longest of five exposures
    /// all over the sample, and a bench is set up so that it does not.
    pub projector_black: f64,
    /// Irradiance that the projector loses from its brightest point to the corner of the frame, of itself. 0.12.
    pub falloff: f64,
    /// Blur of the projector's pixels: standard deviation, projector px. 0.3.
    pub projector_blur_px: f64,
    /// Ambient irradiance over the projector's white. 5e-5: a dark room.
    pub ambient: f64,
    /// Relative residual at which a transport solve stops. 1e-6: far below what 5 exposures can see.
    pub tolerance: f64,
    /// Replace a folder that exists.
    #[serde(skip)]
    pub force: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            material: Material::homogeneous(),
            anisotropy: None,
            voxels_blake3: None,
            transport: Transport::Diffusion,
            photons: 100_000,
            grid: 16,
            window: 15,
            seed: 1,
            noise_free: false,
            drift_px: 0.5,
            pitch_mm: 0.5,
            lit_pitch_mm: None,
            spacing: None,
            exposures: 5,
            stops: 2.0,
            format: FileFormat::Png,
            sensor: SensorKind::SonyA7r3,
            bits: None,
            response: None,
            distortion: -0.05,
            vignetting: 0.15,
            psf_px: 0.0,
            glare: 0.0,
            hot_pixels: 0.0,
            flicker: 0.0,
            jump_px: 0.0,
            jumps: 3,
            camera_drift_px: 0.0,
            camera_jump_px: 0.0,
            camera_jumps: 3,
            camera_px_per_sample: 3.0,
            thickness_mm: None,
            voxels_per_sample: 2,
            step_projector_px: 4,
            dot_projector_px: 3,
            projector_black: 2e-4,
            falloff: 0.12,
            projector_blur_px: 0.3,
            ambient: 5e-5,
            tolerance: 1e-6,
            force: false,
        }
    }
}

impl Options {
    /// Nominal distance of lit points, mm.
    pub fn lit_pitch_mm(&self) -> f64 {
        self.lit_pitch_mm.unwrap_or(self.pitch_mm)
    }

    /// Thickness of the slab, mm (not of a voxel file, which says it itself).
    pub fn thickness_mm(&self) -> f64 {
        self.material.thickness_mm().or(self.thickness_mm).unwrap_or(4.0)
    }

    /// Distance of the dots of one shot, in lit points: by default one and a half windows, and 24 outgoing samples at least,
    /// so that their tails in each other's windows are below a thousandth of a peak (default materials and pitch).
    pub fn spacing(&self) -> usize {
        let samples = (1.5 * self.window as f64).max(24.0);
        let wide = (samples * self.pitch_mm / self.lit_pitch_mm()).ceil() as usize;
        self.spacing.unwrap_or(wide.max(1))
    }

    /// How code values encode light.
    pub fn response(&self) -> Response {
        self.response.unwrap_or(match self.format {
            FileFormat::Png => Response::Linear,
            FileFormat::Jpeg => Response::Srgb,
        })
    }

    /// Farthest that the projected pattern moves in a lattice shot, camera px.
    pub(super) fn drift_reach_px(&self) -> f64 {
        reach_px(self.drift_px, self.jump_px)
    }

    /// Farthest that the camera's picture moves in a lattice shot, px.
    pub(super) fn camera_reach_px(&self) -> f64 {
        reach_px(self.camera_drift_px, self.camera_jump_px)
    }

    /// Refuses values that make no capture.
    ///
    /// # Errors
    /// [`Error::Setting`] naming the option as typed.
    pub fn check(&self) -> Result<()> {
        let range = |setting, value: f64, low: f64, high: f64| {
            if value >= low && value <= high {
                return Ok(());
            }
            let expected = format!("{low} to {high}");
            Err(Error::Setting { setting, expected, found: crate::error::number(value) })
        };
        range("--photons", self.photons as f64, 1e3, 1e12)?;
        range("--grid", self.grid as f64, 1.0, 1024.0)?;
        range("--window", self.window as f64, 3.0, 255.0)?;
        if self.window.is_multiple_of(2) {
            let found = self.window.to_string();
            return Err(Error::Setting { setting: "--window", expected: "an odd number".into(), found });
        }
        range("--drift-px", self.drift_px, 0.0, 20.0)?;
        range("--pitch-mm", self.pitch_mm, 1e-3, 1e3)?;
        range("--lit-pitch-mm", self.lit_pitch_mm(), 1e-3, 1e3)?;
        range("--spacing", self.spacing() as f64, 1.0, 1e6)?;
        range("--exposures", self.exposures as f64, 1.0, 10.0)?;
        range("--stops", self.stops, 0.1, 4.0)?;
        range("--bits", f64::from(self.bits.unwrap_or(8)), 8.0, 16.0)?;
        range("--distortion", self.distortion, -0.5, 0.5)?;
        range("--vignetting", self.vignetting, 0.0, 0.9)?;
        range("--psf-px", self.psf_px, 0.0, 20.0)?;
        range("--glare", self.glare, 0.0, 0.5)?;
        range("--hot-pixels", self.hot_pixels, 0.0, 0.1)?;
        range("--flicker", self.flicker, 0.0, 0.2)?;
        range("--jump-px", self.jump_px, 0.0, 20.0)?;
        range("--jumps", self.jumps as f64, 1.0, 1e4)?;
        range("--camera-drift-px", self.camera_drift_px, 0.0, 20.0)?;
        range("--camera-jump-px", self.camera_jump_px, 0.0, 20.0)?;
        range("--camera-jumps", self.camera_jumps as f64, 1.0, 1e4)?;
        range("--camera-px-per-sample", self.camera_px_per_sample, 1.0, 50.0)?;
        range("--anisotropy", self.anisotropy.unwrap_or(0.0), -0.99, 0.99)?;
        range("--thickness-mm", self.thickness_mm(), 1e-2, 1e3)?;
        range("--voxels-per-sample", self.voxels_per_sample as f64, 1.0, 8.0)?;
        range("--step-projector-px", self.step_projector_px as f64, 1.0, 64.0)?;
        range("--dot-projector-px", self.dot_projector_px as f64, 1.0, self.step_projector_px as f64)?;
        range("--projector-black", self.projector_black, 0.0, 0.5)?;
        range("--falloff", self.falloff, 0.0, 0.9)?;
        range("--projector-blur-px", self.projector_blur_px, 0.0, 2.0)?;
        range("--ambient", self.ambient, 0.0, 0.5)?;
        range("--tolerance", self.tolerance, 1e-7, 1e-2)
    }
}

/// A slow walk goes no farther than 3.4 times its root mean square (3.5 with some margin), jumps no farther than [`super::scene::JUMP_REACH`] of their size.
fn reach_px(walk_px: f64, jump_px: f64) -> f64 {
    3.5 * walk_px + super::scene::JUMP_REACH * jump_px
}
