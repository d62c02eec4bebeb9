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
    /// An odd EXIF block that could only be read in part.
    DamagedExif {
        /// The photograph.
        file: String,
        /// The reader's message.
        reason: String,
    },
    /// An EXIF field whose value cannot be (0/0, an overflow, an absurd time); it is not used.
    UnusableExif {
        /// The first such photograph.
        file: String,
        /// The field.
        tag: String,
        /// Its raw value.
        found: String,
        /// How many photographs.
        photographs: usize,
    },
    /// Exposure times are not in the ratios that the photographs show, or the response curve is not what the rig says.
    ExposureRatios {
        /// The nominal time that is farthest off, s.
        nominal_secs: f64,
        /// What the photographs say it was, the mean of all settings taken as right, s.
        measured_secs: f64,
        /// Relative standard deviation of that.
        relative_sd: f64,
    },
    /// No stack relates these exposure settings to the others: their scales rest on the nominal times alone.
    ExposuresUnlinked {
        /// Nominal times of each group that stacks do link, s.
        groups: Vec<Vec<f64>>,
    },
    /// The lamp's output changes from photograph to photograph; it was measured and taken out.
    Flicker {
        /// Relative standard deviation of a photograph.
        relative_sd: f64,
        /// What remains of it in a row, relative.
        remaining_sd: f64,
    },
    /// The rig's folder cannot be written: the estimated response curve is used but not kept.
    CurveNotSaved {
        /// The file.
        file: String,
        /// The system's answer.
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
            Self::DamagedExif { file, reason } => write!(f, "{file}: EXIF is damaged and was read in part: {reason}"),
            Self::UnusableExif { file, tag, found, photographs } => write!(
                f,
                "{file}: EXIF {tag} is {found}, which cannot be; it is not used (in {photographs} photographs)"
            ),
            Self::ExposureRatios { nominal_secs, measured_secs, relative_sd } => write!(
                f,
                "the exposure of {nominal_secs} s was {measured_secs:.6} s ({:+.2} % ± {:.2} %) by the photographs; use --exposure-from estimate, or check camera.response in rig.toml",
                100.0 * (measured_secs / nominal_secs - 1.0),
                100.0 * relative_sd
            ),
            Self::ExposuresUnlinked { groups } => {
                let list = |g: &Vec<f64>| g.iter().map(|s| format!("{s:.6}")).collect::<Vec<_>>().join(", ");
                let groups: Vec<String> = groups.iter().map(list).collect();
                write!(
                    f,
                    "no stack links the exposures of {} s: their common scale rests on the nominal times",
                    groups.join(" s and ")
                )
            }
            Self::Flicker { relative_sd, remaining_sd } => write!(
                f,
                "the lamp flickers by {:.2} % from photograph to photograph; it was taken out but for {:.2} %",
                100.0 * relative_sd,
                100.0 * remaining_sd
            ),
            Self::CurveNotSaved { file, reason } => {
                write!(f, "{file}: the estimated response curve could not be saved: {reason}")
            }
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
