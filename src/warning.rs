//! Findings that do not stop the work: typed, shown on the terminal and kept in the matrix and the report.

use serde::{Deserialize, Serialize};

/// Something the person should know about a measurement that was completed all the same.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Warning {
    /// Samples that no exposure measured (saturated or outside the photograph); marked invalid.
    SaturatedSamples {
        /// The first such shot.
        first: String,
        /// How many shots.
        shots: usize,
        /// How many samples of their windows.
        samples: usize,
    },
    /// A window reaches past the sample's rim or the photograph; the samples there are marked invalid.
    ClippedWindow {
        /// How many lit points.
        rows: usize,
        /// How many samples in all.
        samples: usize,
    },
    /// Grid points that no shot lights; their rows are marked invalid.
    UnlitPoints {
        /// How many.
        rows: usize,
    },
    /// Two sources of an exposure time disagree by more than a twentieth.
    ExposureDisagrees {
        /// The photograph.
        file: String,
        /// The time that was used.
        used_secs: f64,
        /// The time that was not.
        other_secs: f64,
        /// Where the other came from.
        other: String,
    },
    /// Aperture or ISO change inside the capture; the radiance scale is corrected by them.
    ApertureOrIsoChanges {
        /// The first photograph that differs.
        file: String,
        /// The relative sensitivity against the first photograph.
        factor: f64,
    },
    /// No reference dots: drift is the median of the lattice dots' own shifts, which edges of materials bias.
    DriftFromLatticeDots,
    /// Without reference dots, shots have too few dots to measure their drift; it is taken for none.
    DriftUnmeasured {
        /// The first such shot.
        first: String,
        /// How many shots.
        shots: usize,
    },
    /// Windows of one shot overlap: dots light each other's windows by an estimated share.
    CrossTalk {
        /// The smallest distance between dots of one shot, in outgoing samples.
        spacing_samples: f64,
        /// The window's side in samples.
        window_samples: usize,
    },
    /// The board does not cover the slab: its registration there is an extrapolation.
    BoardTooSmall {
        /// The largest distance of a window's sample from the board, mm.
        outside_mm: f64,
    },
    /// Rows whose albedo exceeds one: more light leaves than arrives.
    AlbedoAboveOne {
        /// How many rows.
        rows: usize,
        /// The largest albedo found.
        largest: f64,
    },
    /// The rig has no `[noise]`: it was estimated from the photographs.
    NoiseEstimated {
        /// DN per electron.
        gain_dn_per_electron: f64,
        /// Its standard deviation.
        gain_sd: f64,
        /// Electrons.
        read_noise_electrons: f64,
        /// Its standard deviation.
        read_noise_sd: f64,
        /// DN.
        black_dn: f64,
        /// Its standard deviation.
        black_sd: f64,
        /// DN.
        saturation_dn: f64,
        /// Whether photosites were seen that clip.
        saturation_seen: bool,
    },
    /// Photosites that show light in the dark; their neighbours stand in for them as far as they are better.
    HotPixels {
        /// How many, each channel by itself.
        photosites: usize,
        /// How many of them saturate every exposure.
        stuck: usize,
        /// The strongest dark current of the others, DN/s.
        strongest_dn_per_sec: f64,
    },
    /// A figure of the rig's `[noise]` that the photographs contradict; the rig's is used.
    NoiseDisagrees {
        /// Its name in `[noise]`.
        field: String,
        /// The rig's, in the field's unit.
        given: f64,
        /// The photographs'.
        found: f64,
        /// Standard deviation of the latter.
        sd: f64,
    },
    /// An odd EXIF block that could only be read in part.
    DamagedExif {
        /// The photograph.
        file: String,
        /// The reader's message.
        reason: String,
    },
    /// Rows without any valid sample or with a peak that is not positive; they are kept as zeros.
    EmptyRows {
        /// How many.
        rows: usize,
    },
    /// A row's peak lay further out than the search permits; its shift was limited.
    ShiftLimited {
        /// How many rows.
        rows: usize,
        /// The largest permitted shift, samples.
        limit: usize,
    },
    /// A simulated slab of media with different refractive indices; it has one, the first medium's.
    RefractiveIndexDiffers {
        /// The medium whose index is used.
        used: String,
        /// That index.
        used_index: f64,
        /// A medium with another.
        other: String,
        /// Its own index.
        other_index: f64,
    },
    /// A simulated medium in which light flies too far between collisions for diffusion to hold.
    DiffusionTooClear {
        /// The medium.
        medium: String,
        /// The channel: R, G or B.
        channel: char,
        /// Transport mean free path 1/(σ'_s + σ_a), mm; `None` when nothing scatters or absorbs.
        mean_free_path_mm: Option<f64>,
        /// What it exceeds: "slab's thickness" or "window".
        exceeds: String,
        /// The length of that, mm.
        length_mm: f64,
    },
    /// A simulated medium that absorbs more than it scatters, which diffusion does not describe.
    DiffusionTooDark {
        /// The medium.
        medium: String,
        /// The channel: R, G or B.
        channel: char,
        /// σ'_s, mm⁻¹.
        reduced_scattering_per_mm: f64,
        /// σ_a, mm⁻¹.
        absorption_per_mm: f64,
    },
}

impl std::fmt::Display for Warning {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::SaturatedSamples { first, shots, samples } => write!(
                f,
                "{samples} samples in {shots} shots (\"{first}\" first) were saturated in every exposure; they are marked invalid"
            ),
            Self::ClippedWindow { rows, samples } => {
                write!(
                    f,
                    "{samples} samples of {rows} windows lie outside the slab or the photograph; they are marked invalid"
                )
            }
            Self::UnlitPoints { rows } => {
                write!(f, "{rows} grid points are lit by no shot; their rows are marked invalid")
            }
            Self::ExposureDisagrees { file, used_secs, other_secs, other } => {
                write!(f, "{file}: exposure {used_secs} s is used, {other} says {other_secs} s")
            }
            Self::ApertureOrIsoChanges { file, factor } => {
                write!(f, "{file}: aperture or ISO differ from the first photograph; radiance is scaled by {factor:.4}")
            }
            Self::DriftFromLatticeDots => {
                write!(
                    f,
                    "no reference dots in the patterns: drift comes from the lattice's own dots and is biased near edges of materials"
                )
            }
            Self::DriftUnmeasured { first, shots } => {
                write!(
                    f,
                    "{shots} shots (\"{first}\" first) have too few dots to measure their drift; it is taken for none"
                )
            }
            Self::CrossTalk { spacing_samples, window_samples } => write!(
                f,
                "dots of one shot are {spacing_samples:.1} samples apart but windows are {window_samples} wide: neighbours' tails are in the rows"
            ),
            Self::BoardTooSmall { outside_mm } => {
                write!(f, "windows reach {outside_mm:.2} mm outside the board: registration is extrapolated there")
            }
            Self::AlbedoAboveOne { rows, largest } => {
                write!(
                    f,
                    "{rows} rows send back more light than arrives (albedo up to {largest:.3}): check the white reference"
                )
            }
            Self::NoiseEstimated {
                gain_dn_per_electron,
                gain_sd,
                read_noise_electrons,
                read_noise_sd,
                black_dn,
                black_sd,
                saturation_dn,
                saturation_seen,
            } => write!(
                f,
                "noise estimated from the photographs: gain {gain_dn_per_electron:.4} ± {gain_sd:.4} DN per electron, read noise {read_noise_electrons:.2} ± {read_noise_sd:.2} electrons, black {black_dn:.2} ± {black_sd:.2} DN, saturation {saturation_dn:.0} DN{}",
                if *saturation_seen { "" } else { " (nothing clips; the largest code value)" }
            ),
            Self::HotPixels { photosites, stuck, strongest_dn_per_sec } => write!(
                f,
                "{photosites} photosites are hot (up to {strongest_dn_per_sec:.0} DN/s; {stuck} saturate every black exposure): their neighbours stand in for them"
            ),
            Self::NoiseDisagrees { field, given, found, sd } => write!(
                f,
                "noise.{field} of the rig is {given:.4}, the photographs say {found:.4} ± {sd:.4}: the reported variance may be wrong"
            ),
            Self::DamagedExif { file, reason } => write!(f, "{file}: EXIF is damaged and was read in part: {reason}"),
            Self::EmptyRows { rows } => write!(f, "{rows} rows have no positive peak; they are kept as zeros"),
            Self::ShiftLimited { rows, limit } => {
                write!(
                    f,
                    "{rows} rows have their peak more than {limit} samples from the lit point; their shift was limited to it"
                )
            }
            Self::RefractiveIndexDiffers { used, used_index, other, other_index } => write!(
                f,
                "a slab has one refractive index: {used_index} of {used} is used for {other} ({other_index}) too"
            ),
            Self::DiffusionTooClear { medium, channel, mean_free_path_mm, exceeds, length_mm } => {
                let path = mean_free_path_mm.map_or("without end".into(), |mm| format!("of {mm:.3} mm"));
                write!(
                    f,
                    "{medium}, {channel}: a transport mean free path {path} exceeds the {exceeds} of {length_mm} mm, diffusion is far off; use --transport mc"
                )
            }
            Self::DiffusionTooDark { medium, channel, reduced_scattering_per_mm, absorption_per_mm } => write!(
                f,
                "{medium}, {channel}: absorption {absorption_per_mm} /mm exceeds scattering {reduced_scattering_per_mm} /mm, diffusion is far off; use --transport mc"
            ),
        }
    }
}
