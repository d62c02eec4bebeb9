//! The options of the library's stages as they are typed.

use super::factor::bytes;
use super::values::{finding, pair_of, resolution, secs, whole};
use crate::capture::ExposureFrom;
use crate::geometry::Point;
use crate::patterns::{PatternsOptions, SpacingOptions};
use crate::pipeline::Resolution;
use crate::simulate::{CameraCurve, FileFormat, RigCurve, SensorKind, SimulateOptions, SlabMaterial, Transport};
use std::path::PathBuf;

/// Arguments by the names of a stage's options, and their conversion; options that are not listed cannot be typed.
macro_rules! typed {
    ($name:ident => $target:path { $($(#[$attribute:meta])* $field:ident: $type:ty,)* }) => {
        #[derive(Debug, Clone, clap::Args)]
        pub struct $name {
            $($(#[$attribute])* pub $field: $type,)*
        }

        impl From<$name> for $target {
            #[allow(clippy::needless_update, reason = "some stages have options that cannot be typed")]
            fn from(typed: $name) -> Self {
                Self { $($field: typed.$field.into(),)* ..Self::default() }
            }
        }
    };
}

typed!(Build => crate::pipeline::BuildOptions {
    /// Folder of rig.toml [default: calibration/ in the capture, else beside it].
    #[arg(long, value_name = "DIR", value_parser = super::things::folder_of("rig.toml"))]
    calibration: Option<PathBuf>,
    /// Leave the light of a shot's other dots in the rows, to see what it does.
    #[arg(long)]
    keep_crosstalk: bool,
    /// Photographs are reduced while they are decoded: `auto`, to 8 camera pixels or more across an outgoing sample, as
    /// few as the windows require; `full`, not at all; or the least number of pixels across a sample.
    #[arg(long, value_name = "PX", default_value = "auto", value_parser = resolution)]
    resolution: Resolution,
    /// Memory for the photographs at work, 2GiB say: as many threads as fit into it [default: all threads].
    #[arg(long = "memory", value_name = "BYTES", value_parser = bytes)]
    memory_bytes: Option<u64>,
    /// Where exposure times come from. capture.toml comes before all; `estimate` measures the actual times behind
    /// EXIF's from the photographs.
    #[arg(long, value_enum, default_value = "exif", value_name = "SOURCE")]
    exposure_from: ExposureFrom,
    /// Go on where a capture contradicts itself in this way; the name is that of the message's hint. May be given
    /// again.
    #[arg(long, value_name = "FINDING", value_parser = finding)]
    accept: Vec<String>,
});

typed!(Check => crate::check::CheckOptions {
    /// Options of the build to be checked.
    #[command(flatten)]
    build: Build,
    /// Lattice shots to look at, spread over the sweep. 8: the first, the last and some between show drift and light.
    #[arg(long, value_name = "N", default_value_t = 8)]
    lattice_shots: usize,
});

typed!(Import => crate::import::ImportOptions {
    /// Link the photographs (hard links, on the same disk) instead of copying them.
    #[arg(long)]
    link: bool,
    /// Ending of the photographs to take, of a camera that wrote two of each [default: the one with most files; of
    /// equals RAW, TIFF, PNG, EXR, JPEG].
    #[arg(long, value_name = "ENDING")]
    take: Option<String>,
    /// Folder of rig.toml, copied into the capture [default: calibration/ of the plan].
    #[arg(long, value_name = "DIR", value_parser = super::things::folder_of("rig.toml"))]
    calibration: Option<PathBuf>,
    /// A name for people [default: the plan's].
    #[arg(long)]
    name: Option<String>,
    /// Use the plan's exposures for photographs without EXIF; only their number can be checked then.
    #[arg(long)]
    exposures_from_plan: bool,
    /// Replace an earlier capture at --out.
    #[arg(long)]
    force: bool,
});

typed!(Patterns => PatternsOptions {
    /// A name for people; it heads the report.
    #[arg(long)]
    name: Option<String>,
    /// Width and height of the sample, mm: 20 or 30x20 [default with --probe: the probe's].
    #[arg(long, value_name = "MM[xMM]", value_parser = pair_of::<f64>)]
    slab_mm: Option<Point>,
    /// Projector pixels in a mm of the slab [default with --probe: as registered].
    #[arg(long, value_name = "PX")]
    projector_px_per_mm: Option<f64>,
    /// Projector pixel that falls on the middle of the slab [default: the projector's middle; with --probe: as
    /// registered].
    #[arg(long, value_name = "XxY", value_parser = pair_of::<f64>)]
    center_px: Option<Point>,
    /// Lit points: 32 or 40x30 [default: as many as --lit-pitch-mm makes].
    #[arg(long, value_name = "N[xN]", value_parser = pair_of::<usize>, conflicts_with = "lit_pitch_mm")]
    grid: Option<[usize; 2]>,
    /// Distance of lit points, mm [default: --pitch-mm].
    #[arg(long, value_name = "MM")]
    lit_pitch_mm: Option<f64>,
    /// Outgoing samples of a window along each axis, odd [default: 31; with --probe: as far as the response reaches].
    #[arg(long, value_name = "N")]
    window: Option<usize>,
    /// Side of an outgoing cell, mm [default: 0.5; with --probe: the probe's].
    #[arg(long, value_name = "MM")]
    pitch_mm: Option<f64>,
    /// Side of a dot, projector pixels. 3: a dark pixel between neighbours four pixels apart.
    #[arg(long, value_name = "PX", default_value_t = 3)]
    dot_px: usize,
    /// Distance of the dots of one shot, mm [default: one and a half windows; with --probe: the smallest that the tails
    /// permit].
    #[arg(long, value_name = "MM")]
    spacing_mm: Option<f64>,
    /// Least distance of the lit points from the slab's rim, mm [default: half a window, or a quarter of the slab when
    /// that is less].
    #[arg(long, value_name = "MM")]
    margin_mm: Option<f64>,
    /// Width of the opaque frame, mm: the reference dots lie in its middle.
    #[arg(long, value_name = "MM", default_value_t = 6.0)]
    frame_mm: f64,
    /// Narrowest stripes of the Gray code, projector pixels [default: 8; with --probe: what is six camera pixels].
    #[arg(long, value_name = "PX")]
    narrowest_stripe_px: Option<usize>,
    /// Exposures of each lattice and each black shot [default: 5; with --probe: as many as the response requires].
    #[arg(long, value_name = "N")]
    exposures: Option<usize>,
    /// Stops between exposures.
    #[arg(long, value_name = "STOPS", default_value_t = 2.0)]
    stops: f64,
    /// Shortest exposure of a lattice shot, s, as 0.004 or 1/250: the brightest dot must not saturate in it [default:
    /// 1/256; with --probe: as measured].
    #[arg(long, value_name = "S", value_parser = secs)]
    shortest_secs: Option<f64>,
    /// Shorter of the two exposures of board, white reference and Gray code, s [default: --shortest-secs; with --probe:
    /// the probe's].
    #[arg(long, value_name = "S", value_parser = secs)]
    white_secs: Option<f64>,
    /// Time that the camera takes per photograph besides its exposure, s, to estimate the time of shooting.
    #[arg(long, value_name = "S", default_value_t = 1.5)]
    overhead_secs: f64,
    /// Share of a row's light that other dots' tails may add to it before `build-matrix` takes that out, with --probe.
    #[arg(long, value_name = "SHARE", default_value_t = SpacingOptions::default().most_cross_talk)]
    most_cross_talk: f64,
});

typed!(Simulate => SimulateOptions {
    /// Replace DIR when it is an earlier simulation.
    #[arg(long)]
    force: bool,
    /// The slab's material; the forms are listed below. Marble: the simplest truth.
    #[arg(long, default_value = "homogeneous", help_heading = "Slab")]
    material: SlabMaterial,
    /// Mean cosine of the scattering angle in every medium, −0.99 to 0.99; the reduced scattering stays as it is
    /// [default: 0]
    #[arg(long, value_name = "G", allow_negative_numbers = true, help_heading = "Slab")]
    anisotropy: Option<f64>,
    /// Thickness of the slab, mm [default: that of the layers or voxels, or 4]
    #[arg(long, value_name = "MM", help_heading = "Slab")]
    thickness_mm: Option<f64>,
    /// What solves for the light inside the slab. Diffusion takes seconds.
    #[arg(long, value_enum, default_value = "diffusion", help_heading = "Slab")]
    transport: Transport,
    /// Photons for a dot and channel, with --transport mc. 100,000: about half a per cent of noise in a row.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().photons, value_parser = whole, help_heading = "Slab")]
    photons: u64,
    /// Voxels of the transport solver across an outgoing cell.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().voxels_per_sample, help_heading = "Slab")]
    voxels_per_sample: usize,
    /// Write the true matrix only: truth.rd.zarr and truth.toml, no photographs and no capture.toml.
    #[arg(long, help_heading = "Capture")]
    truth_only: bool,
    /// Lit points along the projector's axes: 16 or 24x16. 18x14: minutes of a lab's time, seconds of ours.
    #[arg(long, value_name = "N[xN]", default_value = "18x14", value_parser = pair_of::<usize>, help_heading = "Capture")]
    grid: [usize; 2],
    /// Outgoing samples of a window along the slab's axes, odd: 15 or 31x21. 17x13: the peak and most of the tails.
    #[arg(long, value_name = "N[xN]", default_value = "17x13", value_parser = pair_of::<usize>, help_heading = "Capture")]
    window: [usize; 2],
    /// Side of an outgoing cell, mm. 0.5: responses of most materials fall by 3 to 4 decades within a window of 31.
    #[arg(long, value_name = "MM", default_value_t = SimulateOptions::default().pitch_mm, help_heading = "Capture")]
    pitch_mm: f64,
    /// Distance of lit points along the projector's axes, mm: 1 or 1x1.5 [default: the pitch along x, and along y what
    /// makes the projector's pixels square]
    #[arg(long, value_name = "MM[xMM]", value_parser = pair_of::<f64>, help_heading = "Capture")]
    lit_pitch_mm: Option<Point>,
    /// Distance of the dots of one shot, in lit points: 8 or 8x6 [default: one and a half windows]
    #[arg(long, value_name = "N[xN]", value_parser = pair_of::<usize>, help_heading = "Capture")]
    spacing: Option<[usize; 2]>,
    /// Exposures of each lattice shot.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().exposures, help_heading = "Capture")]
    exposures: usize,
    /// Stops between exposures. 2: five exposures reach over the 16 bits of a material's response.
    #[arg(long, value_name = "STOPS", default_value_t = SimulateOptions::default().stops, help_heading = "Capture")]
    stops: f64,
    /// Seed of everything random: noise, drift, jumps, flicker, hot pixels, veins.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().seed, help_heading = "Capture")]
    seed: u64,
    /// Whose sensor: gain, noise, bits and black level. The A7R III is a current camera.
    #[arg(long, value_enum, default_value = "sony-a7r3", help_heading = "Camera")]
    sensor: SensorKind,
    /// Bits of its converter [default: its own]
    #[arg(long, value_name = "BITS", help_heading = "Camera")]
    bits: Option<u32>,
    /// Format of the photographs.
    #[arg(long, value_enum, default_value = "png", help_heading = "Camera")]
    format: FileFormat,
    /// Response curve; the rig file takes `film` for sRGB [default: linear for PNG, srgb for JPEG]
    #[arg(long = "response", value_enum, value_name = "CURVE", help_heading = "Camera")]
    response_curve: Option<CameraCurve>,
    /// Leave `[noise]` out of the rig file: it is to be estimated from the photographs.
    #[arg(long, help_heading = "Camera")]
    rig_without_noise: bool,
    /// The board is shot at the lattice's shortest exposure too: its black squares link the exposures of the references
    /// to those of the lattice.
    #[arg(long, help_heading = "Capture")]
    link_exposures: bool,
    /// What the rig file says of the response curve [default: linear, or srgb for srgb and film]
    #[arg(long = "rig-response", value_enum, value_name = "CURVE", help_heading = "Camera")]
    rig_curve: Option<RigCurve>,
    /// Fixed random error of each distinct exposure time in EXIF, root mean square, stops.
    #[arg(long, value_name = "STOPS", default_value_t = SimulateOptions::default().exif_stops_error, help_heading = "Camera")]
    exif_stops_error: f64,
    /// EXIF holds nominal exposure times in thirds of stops: 1/250 for 1/256.
    #[arg(long, help_heading = "Camera")]
    nominal_times: bool,
    /// Camera pixels across an outgoing cell, 1 to 200. 3: enough for sub-cell registration.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().camera_px_per_sample, help_heading = "Camera")]
    camera_px_per_sample: f64,
    /// The camera's pixels: 6000x4000. Slab and frame fill them as far as their shape allows, which decides the pixels
    /// across a cell [default: as many as slab and frame need]
    #[arg(long, value_name = "WxH", value_parser = pair_of::<usize>, conflicts_with = "camera_px_per_sample", help_heading = "Camera")]
    camera_size: Option<[usize; 2]>,
    /// Lens distortion, Brown's k1. −0.05: a good lens, 3 px at the corner of a picture of 1000; k2 is −k1/5.
    #[arg(long, value_name = "K1", allow_negative_numbers = true, default_value_t = SimulateOptions::default().distortion, help_heading = "Camera")]
    distortion: f64,
    /// Tilt of the camera about the slab's x and y axes, degrees: 5 or 5x-3.
    #[arg(long, value_name = "DEG[xDEG]", allow_hyphen_values = true, default_value = "5x-3", value_parser = pair_of::<f64>, help_heading = "Camera")]
    camera_tilt_deg: Point,
    /// Turn of the camera about its axis, degrees. 2: set up by hand.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true, default_value_t = SimulateOptions::default().camera_turn_deg, help_heading = "Camera")]
    camera_turn_deg: f64,
    /// Distance of the camera in widths of slab and frame. 2: an ordinary lens; 40: nearly telecentric.
    #[arg(long, value_name = "WIDTHS", default_value_t = SimulateOptions::default().camera_distance, help_heading = "Camera")]
    camera_distance: f64,
    /// Sensitivity lost at the corner. 0.15: a good lens, stopped down.
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().vignetting, help_heading = "Camera")]
    vignetting: f64,
    /// Standard deviation of the point-spread function, px. 0: pixels average over their area, and that is all.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().psf_px, help_heading = "Camera")]
    psf_px: f64,
    /// Share of the light in a halo of 20 px.
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().glare, help_heading = "Camera")]
    glare: f64,
    /// Share of the photosites that are hot.
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().hot_pixels, help_heading = "Camera")]
    hot_pixels: f64,
    /// Projector pixels between neighbouring lit points along each axis: 4 or 4x5.
    #[arg(long, value_name = "PX[xPX]", default_value = "4x5", value_parser = pair_of::<usize>, help_heading = "Projector")]
    step_projector_px: [usize; 2],
    /// Turn of the projector's picture against the slab, degrees. 3: set up by hand; 90: a projector on its side.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true, default_value_t = SimulateOptions::default().projector_turn_deg, help_heading = "Projector")]
    projector_turn_deg: f64,
    /// The projector's picture is mirrored: its columns run backwards.
    #[arg(long, help_heading = "Projector")]
    projector_mirrored: bool,
    /// Side of a dot, projector pixels. 3: a dark pixel between neighbours.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().dot_projector_px, help_heading = "Projector")]
    dot_projector_px: usize,
    /// Dots are discs of that diameter, not squares.
    #[arg(long, help_heading = "Projector")]
    round_dots: bool,
    /// Blur of a projector pixel (standard deviation), projector pixels.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().projector_blur_px, help_heading = "Projector")]
    projector_blur_px: f64,
    /// Distortion of its lens, Brown's k1 with the image's width for focal length. Usual: 0.01, 1 px at the corner of a
    /// picture of 300.
    #[arg(long, value_name = "K1", allow_negative_numbers = true, default_value_t = SimulateOptions::default().projector_distortion, help_heading = "Projector")]
    projector_distortion: f64,
    /// Standard deviation per axis by which the projector moves between the pictures of the Gray code, projector px.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().gray_jitter_px, help_heading = "Drift")]
    gray_jitter_px: f64,
    /// No reference dots on the frame: drift is to be found from the dots on the sample.
    #[arg(long, help_heading = "Capture")]
    without_reference_dots: bool,
    /// Photographs of the board in other poses, for the lens.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().calibration_boards, help_heading = "Capture")]
    calibration_boards: usize,
    /// Print dark discs on the frame, photograph them before and after the lattice shots, and list them in the rig
    /// file.
    #[arg(long, help_heading = "Capture")]
    frame_marks: bool,
    /// A lab without a board: the frame's marks alone tell where the slab is.
    #[arg(long, requires = "frame_marks", conflicts_with = "calibration_boards", help_heading = "Capture")]
    without_board: bool,
    /// Project the Gray code on the sample in its frame instead of the white reference.
    #[arg(long, help_heading = "Projector")]
    gray_on_frame: bool,
    /// A shot with the lens covered, at the exposures of the lattice shots.
    #[arg(long, help_heading = "Capture")]
    dark_shot: bool,
    /// Irradiance of a black projector pixel over that of a white one. 1/5000: more would saturate the longest of
    /// five exposures all over the sample.
    #[arg(long, value_name = "RATIO", default_value_t = SimulateOptions::default().projector_black, help_heading = "Projector")]
    projector_black: f64,
    /// Largest relative deviation of the white reference's reflectance from what the rig file says.
    /// 0.002: a good reference.
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().white_unevenness, help_heading = "Capture")]
    white_unevenness: f64,
    /// Irradiance lost towards the corner.
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().falloff, help_heading = "Projector")]
    falloff: f64,
    /// Standard deviation of the lamp from photograph to photograph, of its output.
    #[arg(long, value_name = "RATIO", default_value_t = SimulateOptions::default().flicker, help_heading = "Projector")]
    flicker: f64,
    /// Ambient irradiance over that of projector white. 5e-5: a dark room.
    #[arg(long, value_name = "RATIO", default_value_t = SimulateOptions::default().ambient, help_heading = "Projector")]
    ambient: f64,
    /// Slow walk of the pattern: root mean square over the lattice shots, camera px. 0.5: a bench that was touched.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().drift_px, help_heading = "Drift")]
    drift_px: f64,
    /// Length of its jumps, camera px.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().jump_px, help_heading = "Drift")]
    jump_px: f64,
    /// Number of its jumps.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().jumps, help_heading = "Drift")]
    jumps: usize,
    /// Slow walk of the camera's picture, root mean square, px.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().camera_drift_px, help_heading = "Drift")]
    camera_drift_px: f64,
    /// Length of its jumps, px.
    #[arg(long, value_name = "PX", default_value_t = SimulateOptions::default().camera_jump_px, help_heading = "Drift")]
    camera_jump_px: f64,
    /// Number of its jumps.
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().camera_jumps, help_heading = "Drift")]
    camera_jumps: usize,
    /// No photon and read noise, only rounding: as `--without noise`.
    #[arg(long, help_heading = "Switches")]
    noise_free: bool,
});
