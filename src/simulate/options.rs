//! What to simulate.

use super::slab::SlabMaterial;
use crate::geometry::Point;
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// The photographs' file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FileFormat {
    /// 16-bit PNG. With a linear response curve it holds the sensor's code values unscaled.
    Png,
    /// 16-bit TIFF, not compressed: the same code values, larger files, decoded at once.
    Tiff,
    /// 16-bit TIFF, compressed by Deflate after a difference from the pixel before.
    TiffDeflate,
    /// 8-bit JPEG (quality 95, no chroma subsampling).
    Jpeg,
}

/// Whose sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SensorKind {
    /// Sony A7R III: 14 bits, 7.5 e⁻ of read noise.
    #[serde(rename = "sony-a7r3")]
    SonyA7r3,
    /// Sony A7R: 14 bits, 0.7 e⁻.
    #[serde(rename = "sony-a7r1")]
    SonyA7r1,
    /// Canon T1i: 14 bits, 4.3 e⁻, three times the gain.
    #[serde(rename = "canon-t1")]
    CanonT1,
    /// A phone: 10 bits, 7.8 e⁻.
    Phone,
}

/// Which bench the options describe where they are left as they are.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum BenchKind {
    /// Camera nearly above the slab, half-millimetre cells, reference dots.
    #[default]
    Usual,
    /// Camera far away and 30° off the normal, cells of 0.2 mm, no reference dots, a Gray code that moves from picture
    /// to picture, uneven light.
    Oblique,
}

/// What solves for the light inside the slab.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Transport {
    /// Diffusion: fast and without noise, wrong near the source and for media that absorb much or scatter little.
    Diffusion,
    /// Photon Monte Carlo: right, and noisy.
    Mc,
}

/// How code values encode light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CameraCurve {
    /// Code values in proportion to light, above the sensor's black level.
    Linear,
    /// The sRGB curve.
    Srgb,
    /// A film-like curve with toe and shoulder; the rig file says sRGB, as a lab would guess.
    Film,
}

/// What the rig file says of the response curve.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RigCurve {
    /// Code values in proportion to light.
    Linear,
    /// The sRGB curve.
    Srgb,
    /// Not known: to be estimated.
    Estimate,
}

/// Everything that makes a simulated capture; the same options give the same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SimulateOptions {
    /// Replace DIR when it is an earlier simulation.
    #[serde(skip)]
    pub force: bool,
    /// The slab's material; the forms are listed below. Marble: the simplest truth.
    pub material: SlabMaterial,
    /// Mean cosine of the scattering angle in every medium, −0.99 to 0.99; the reduced scattering stays as it is
    /// [default: 0]
    pub anisotropy: Option<f64>,
    /// BLAKE3 of the voxel file: `simulate` records it, and refuses another file when it is given.
    pub voxels_blake3: Option<String>,
    /// Thickness of the slab, mm [default: that of the layers or voxels, or 4]
    pub thickness_mm: Option<f64>,
    /// What solves for the light inside the slab. Diffusion takes seconds.
    pub transport: Transport,
    /// Photons for a dot and channel, with `transport mc`. 100,000: about half a per cent of noise in a row.
    pub photons: u64,
    /// Voxels of the transport solver across an outgoing cell.
    pub voxels_per_sample: usize,
    /// Relative residual at which diffusion stops. 1e-6: far below what 5 exposures can see.
    pub tolerance: f64,
    /// Write the true matrix only: truth.rd.zarr and truth.toml, no photographs and no capture.toml.
    pub truth_only: bool,
    /// Lit points along the projector's axes: 16 or 24x16. 18x14: minutes of a lab's time, seconds of ours.
    pub grid: [usize; 2],
    /// Outgoing samples of a window along the slab's axes, odd: 15 or 31x21. 17x13: the peak and most of the tails.
    pub window: [usize; 2],
    /// Side of an outgoing cell, mm. 0.5: responses of most materials fall by 3 to 4 decades within a window of 31.
    pub pitch_mm: f64,
    /// Distance of lit points along the projector's axes, mm: 1 or 1x1.5 [default: the pitch along x, and along y what
    /// makes the projector's pixels square]
    pub lit_pitch_mm: Option<Point>,
    /// Distance of the dots of one shot, in lit points: 8 or 8x6 [default: one and a half windows]
    pub spacing: Option<[usize; 2]>,
    /// Exposures of each lattice shot.
    pub exposures: usize,
    /// Stops between exposures. 2: five exposures reach over the 16 bits of a material's response.
    pub stops: f64,
    /// Seed of everything random: noise, drift, jumps, flicker, hot pixels, veins.
    pub seed: u64,
    /// Whose sensor: gain, noise, bits and black level. The A7R III is a current camera.
    pub sensor: SensorKind,
    /// Bits of its converter [default: its own]
    pub bits: Option<u32>,
    /// Format of the photographs.
    pub format: FileFormat,
    /// Response curve; the rig file takes `film` for sRGB [default: linear for PNG, srgb for JPEG]
    #[serde(rename = "response")]
    pub response_curve: Option<CameraCurve>,
    /// Leave `[noise]` out of the rig file: it is to be estimated from the photographs.
    pub rig_without_noise: bool,
    /// The board is shot at the lattice's shortest exposure too: its black squares link the exposures of the references
    /// to those of the lattice.
    pub link_exposures: bool,
    /// What the rig file says of the response curve [default: linear, or srgb for srgb and film]
    #[serde(rename = "rig_response")]
    pub rig_curve: Option<RigCurve>,
    /// EXIF gives each distinct exposure time wrong by a fixed random amount of this size, root mean square, stops.
    pub exif_stops_error: f64,
    /// EXIF gives the usual name of the time: 1/250 for 1/256, thirds of stops.
    pub nominal_times: bool,
    /// Camera pixels across an outgoing cell. 3: enough for sub-cell registration.
    pub camera_px_per_sample: f64,
    /// The camera's pixels: 6000x4000. Slab and frame fill them as far as their shape allows, which decides
    /// `camera_px_per_sample` [default: as many as slab and frame need]
    pub camera_size: Option<[usize; 2]>,
    /// Lens distortion, Brown's k1. −0.05: a good lens, 3 px at the corner of a picture of 1000; k2 is −k1/5.
    pub distortion: f64,
    /// Tilt of the camera about the slab's x and y axes, degrees: 5 or 5x-3.
    pub camera_tilt_deg: Point,
    /// Turn of the camera about its axis, degrees. 2: set up by hand.
    pub camera_turn_deg: f64,
    /// Distance of the camera in widths of slab and frame. 2: an ordinary lens; 40: nearly telecentric.
    pub camera_distance: f64,
    /// Sensitivity lost at the corner. 0.15: a good lens, stopped down.
    pub vignetting: f64,
    /// Standard deviation of the point-spread function, px. 0: pixels average over their area, and that is all.
    pub psf_px: f64,
    /// Share of the light in a halo of 20 px.
    pub glare: f64,
    /// Share of the photosites that are hot.
    pub hot_pixels: f64,
    /// Projector pixels between neighbouring lit points along each axis: 4 or 4x5.
    pub step_projector_px: [usize; 2],
    /// Turn of the projector's picture against the slab, degrees. 3: set up by hand; 90: a projector on its side.
    pub projector_turn_deg: f64,
    /// The projector's picture comes by a mirror: its columns run backwards.
    pub projector_mirrored: bool,
    /// Side of a dot, projector pixels. 3: a dark pixel between neighbours.
    pub dot_projector_px: usize,
    /// Dots are discs of that diameter.
    pub round_dots: bool,
    /// Blur of a projector pixel (standard deviation), projector pixels.
    pub projector_blur_px: f64,
    /// Distortion of its lens, Brown's k1 with the image's width for focal length. Usual: 0.01, 1 px at the corner of a
    /// picture of 300.
    pub projector_distortion: f64,
    /// Standard deviation per axis by which the projector moves between photographed patterns of the Gray code,
    /// projector px.
    pub gray_jitter_px: f64,
    /// No dots on the frame: drift is to be found from the sample's own.
    pub without_reference_dots: bool,
    /// Photographs of the board in other poses, for the lens.
    pub calibration_boards: usize,
    /// Print dark discs on the frame, photograph them before and after the lattice shots, and tell the rig file.
    pub frame_marks: bool,
    /// A lab without a board: the frame's marks alone tell where the slab is.
    pub without_board: bool,
    /// Project the Gray code on the sample in its frame instead of the white reference.
    pub gray_on_frame: bool,
    /// A shot with the lens covered, at the exposures of the lattice shots.
    pub dark_shot: bool,
    /// Irradiance of a black projector pixel over that of a white one. 1/5000: more would saturate the longest of
    /// five exposures all over the sample.
    pub projector_black: f64,
    /// By how much the white reference's reflectance differs across it from what the rig file says, at most, of itself.
    /// 0.002: a good reference.
    pub white_unevenness: f64,
    /// Irradiance lost towards the corner.
    pub falloff: f64,
    /// Standard deviation of the lamp from photograph to photograph, of its output.
    pub flicker: f64,
    /// Ambient irradiance over that of projector white. 5e-5: a dark room.
    pub ambient: f64,
    /// Slow walk of the pattern: root mean square over the lattice shots, camera px. 0.5: a bench that was touched.
    pub drift_px: f64,
    /// Length of its jumps, camera px.
    pub jump_px: f64,
    /// Number of its jumps.
    pub jumps: usize,
    /// Slow walk of the camera's picture, root mean square, px.
    pub camera_drift_px: f64,
    /// Length of its jumps, px.
    pub camera_jump_px: f64,
    /// Number of its jumps.
    pub camera_jumps: usize,
    /// No photon and read noise, only rounding: as `without noise`.
    pub noise_free: bool,
}

impl Default for SimulateOptions {
    fn default() -> Self {
        Self {
            material: SlabMaterial::homogeneous(),
            anisotropy: None,
            voxels_blake3: None,
            transport: Transport::Diffusion,
            photons: 100_000,
            truth_only: false,
            grid: [18, 14],
            window: [17, 13],
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
            response_curve: None,
            rig_without_noise: false,
            rig_curve: None,
            link_exposures: false,
            exif_stops_error: 0.0,
            nominal_times: false,
            distortion: -0.05,
            camera_tilt_deg: [5.0, -3.0],
            camera_turn_deg: 2.0,
            camera_distance: 2.0,
            gray_jitter_px: 0.0,
            without_reference_dots: false,
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
            camera_size: None,
            thickness_mm: None,
            voxels_per_sample: 2,
            step_projector_px: [4, 5],
            projector_turn_deg: 3.0,
            projector_mirrored: false,
            white_unevenness: 0.002,
            dot_projector_px: 3,
            round_dots: false,
            projector_black: 2e-4,
            projector_distortion: 0.0,
            gray_on_frame: false,
            dark_shot: false,
            frame_marks: false,
            calibration_boards: 0,
            without_board: false,
            falloff: 0.12,
            projector_blur_px: 0.3,
            ambient: 5e-5,
            tolerance: 1e-6,
            force: false,
        }
    }
}

impl SimulateOptions {
    /// The options with those of another bench in the place of all that are the usual ones.
    pub fn on_bench(self, bench: BenchKind) -> Self {
        if bench == BenchKind::Usual {
            return self;
        }
        let usual = Self::default();
        let of = |own: f64, usual: f64, other: f64| if own == usual { other } else { own };
        Self {
            camera_tilt_deg: if self.camera_tilt_deg == usual.camera_tilt_deg {
                [24.0, -19.0]
            } else {
                self.camera_tilt_deg
            },
            camera_turn_deg: of(self.camera_turn_deg, usual.camera_turn_deg, -11.0),
            camera_distance: of(self.camera_distance, usual.camera_distance, 40.0),
            pitch_mm: of(self.pitch_mm, usual.pitch_mm, 0.2),
            psf_px: of(self.psf_px, usual.psf_px, 0.6),
            falloff: of(self.falloff, usual.falloff, 0.4),
            white_unevenness: of(self.white_unevenness, usual.white_unevenness, 0.005),
            projector_turn_deg: of(self.projector_turn_deg, usual.projector_turn_deg, -7.0),
            projector_blur_px: of(self.projector_blur_px, usual.projector_blur_px, 0.45),
            gray_jitter_px: of(self.gray_jitter_px, usual.gray_jitter_px, 0.4),
            without_reference_dots: true,
            ..self
        }
    }

    /// Nominal distance of lit points along the projector's axes, mm.
    pub fn lit_pitch_mm(&self) -> Point {
        let [x, y] = self.step_projector_px.map(|step| step as f64);
        self.lit_pitch_mm.unwrap_or([self.pitch_mm, self.pitch_mm * y / x])
    }

    /// Nominal side of a projector pixel on the slab along the projector's axes, mm.
    pub(super) fn projector_px_mm(&self) -> Point {
        [0, 1].map(|a| self.lit_pitch_mm()[a] / self.step_projector_px[a] as f64)
    }

    /// Width and height of a window, mm.
    pub(super) fn window_mm(&self) -> Point {
        self.window.map(|w| w as f64 * self.pitch_mm)
    }

    /// Thickness of the slab, mm (not of a voxel file, which says it itself).
    pub fn thickness_mm(&self) -> f64 {
        self.material.thickness_mm().or(self.thickness_mm).unwrap_or(4.0)
    }

    /// Distance of the dots of one shot, in lit points: by default one and a half windows, and 24 outgoing samples at
    /// least, so that their tails in each other's windows are below a thousandth of a peak (default materials and
    /// pitch).
    pub fn spacing(&self) -> [usize; 2] {
        let samples = self.window.map(|w| (1.5 * w as f64).max(24.0));
        // The window's extent along the projector's axes: its sides when the projector stands upright or on its side.
        let upright = self.projector_turn_deg.to_radians().sin().abs() < 0.5_f64.sqrt();
        let samples = if upright { samples } else { [samples[1], samples[0]] };
        let wide = |a: usize| (samples[a] * self.pitch_mm / self.lit_pitch_mm()[a]).ceil() as usize;
        self.spacing.unwrap_or([wide(0).max(1), wide(1).max(1)])
    }

    /// How code values encode light.
    pub fn response_curve(&self) -> CameraCurve {
        self.response_curve.unwrap_or(match self.format {
            FileFormat::Png | FileFormat::Tiff | FileFormat::TiffDeflate => CameraCurve::Linear,
            FileFormat::Jpeg => CameraCurve::Srgb,
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
        range("photons", self.photons as f64, 1e3, 1e12)?;
        let lit_pitch_mm = self.lit_pitch_mm();
        for side in self.camera_size.into_iter().flatten() {
            range("camera_size", side as f64, 64.0, 16_384.0)?;
        }
        for a in 0..2 {
            range("grid", self.grid[a] as f64, 1.0, 1024.0)?;
            range("window", self.window[a] as f64, 3.0, 255.0)?;
            range("step_projector_px", self.step_projector_px[a] as f64, 1.0, 64.0)?;
            range("lit_pitch_mm", lit_pitch_mm[a], 1e-3, 1e3)?;
            range("spacing", self.spacing()[a] as f64, 1.0, 1e6)?;
            range("camera_tilt_deg", self.camera_tilt_deg[a], -45.0, 45.0)?;
        }
        if let Some(even) = self.window.iter().find(|w| w.is_multiple_of(2)) {
            let found = even.to_string();
            return Err(Error::Setting { setting: "window", expected: "odd numbers".into(), found });
        }
        // The picture's top left corner must stay the sample's.
        range("camera_turn_deg", self.camera_turn_deg, -30.0, 30.0)?;
        range("camera_distance", self.camera_distance, 1.0, 1000.0)?;
        range("gray_jitter_px", self.gray_jitter_px, 0.0, 5.0)?;
        range("projector_turn_deg", self.projector_turn_deg, -180.0, 180.0)?;
        range("white_unevenness", self.white_unevenness, 0.0, 0.5)?;
        range("drift_px", self.drift_px, 0.0, 20.0)?;
        range("pitch_mm", self.pitch_mm, 1e-3, 1e3)?;
        range("calibration_boards", self.calibration_boards as f64, 0.0, 100.0)?;
        range("exposures", self.exposures as f64, 1.0, 10.0)?;
        range("stops", self.stops, 0.1, 4.0)?;
        range("bits", f64::from(self.bits.unwrap_or(8)), 8.0, 16.0)?;
        range("exif_stops_error", self.exif_stops_error, 0.0, 1.0)?;
        range("distortion", self.distortion, -0.5, 0.5)?;
        range("projector_distortion", self.projector_distortion, -0.2, 0.2)?;
        range("vignetting", self.vignetting, 0.0, 0.9)?;
        range("psf_px", self.psf_px, 0.0, 20.0)?;
        range("glare", self.glare, 0.0, 0.5)?;
        range("hot_pixels", self.hot_pixels, 0.0, 0.1)?;
        range("flicker", self.flicker, 0.0, 0.2)?;
        range("jump_px", self.jump_px, 0.0, 20.0)?;
        range("jumps", self.jumps as f64, 1.0, 1e4)?;
        range("camera_drift_px", self.camera_drift_px, 0.0, 20.0)?;
        range("camera_jump_px", self.camera_jump_px, 0.0, 20.0)?;
        range("camera_jumps", self.camera_jumps as f64, 1.0, 1e4)?;
        range("camera_px_per_sample", self.camera_px_per_sample, 1.0, 200.0)?;
        range("anisotropy", self.anisotropy.unwrap_or(0.0), -0.99, 0.99)?;
        range("thickness_mm", self.thickness_mm(), 1e-2, 1e3)?;
        range("voxels_per_sample", self.voxels_per_sample as f64, 1.0, 8.0)?;
        let narrower = self.step_projector_px[0].min(self.step_projector_px[1]);
        range("dot_projector_px", self.dot_projector_px as f64, 1.0, narrower as f64)?;
        range("projector_black", self.projector_black, 0.0, 0.5)?;
        range("falloff", self.falloff, 0.0, 0.9)?;
        range("projector_blur_px", self.projector_blur_px, 0.0, 2.0)?;
        range("ambient", self.ambient, 0.0, 0.5)?;
        range("tolerance", self.tolerance, 1e-7, 1e-2)
    }
}

/// A slow walk goes no farther than 3.4 times its root mean square (3.5 with some margin), jumps no farther than
/// [`super::scene::JUMP_REACH`] of their size.
fn reach_px(walk_px: f64, jump_px: f64) -> f64 {
    3.5 * walk_px + super::scene::JUMP_REACH * jump_px
}
