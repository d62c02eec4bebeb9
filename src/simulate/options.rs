//! What to simulate.

use super::slab::Material;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// The photographs' file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FileFormat {
    /// 16-bit PNG that holds the sensor's code values unscaled: a linear camera.
    Png,
    /// 8-bit JPEG (quality 95, no chroma subsampling), sRGB encoded.
    Jpeg,
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
    /// Bits of the sensor. 14; JPEG has 8 always.
    pub bits: u32,
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
            bits: 14,
            camera_px_per_sample: 3.0,
            thickness_mm: None,
            voxels_per_sample: 2,
            step_projector_px: 4,
            dot_projector_px: 3,
            projector_black: 2e-4,
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
        range("--bits", f64::from(self.bits), 8.0, 16.0)?;
        range("--camera-px-per-sample", self.camera_px_per_sample, 1.0, 50.0)?;
        range("--anisotropy", self.anisotropy.unwrap_or(0.0), -0.99, 0.99)?;
        range("--thickness-mm", self.thickness_mm(), 1e-2, 1e3)?;
        range("--voxels-per-sample", self.voxels_per_sample as f64, 1.0, 8.0)?;
        range("--step-projector-px", self.step_projector_px as f64, 1.0, 64.0)?;
        range("--dot-projector-px", self.dot_projector_px as f64, 1.0, self.step_projector_px as f64)?;
        range("--projector-black", self.projector_black, 0.0, 0.5)?;
        range("--ambient", self.ambient, 0.0, 0.5)?;
        range("--tolerance", self.tolerance, 1e-7, 1e-2)
    }
}
