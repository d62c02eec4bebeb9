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
        /// How many photographs disagree alike.
        #[serde(default)]
        photographs: usize,
    },
    /// Aperture or ISO change inside the capture; the radiance scale is corrected by them.
    ApertureOrIsoChanges {
        /// The first photograph that differs.
        file: String,
        /// The relative sensitivity against the first photograph.
        factor: f64,
    },
    /// The pattern has moved suddenly between shots, by more than its slow walk explains.
    DriftJumps {
        /// The shots before which it happened.
        jumps: Vec<DriftJump>,
    },
    /// The camera (or the sample) has moved since registration, seen at the sample's rim; windows were moved with it.
    CameraMoved {
        /// The first such shot.
        first: String,
        /// How many lattice shots.
        shots: usize,
        /// In how many lattice shots the rim was seen well enough to tell.
        measured: usize,
        /// The largest movement, camera px.
        largest_px: f64,
    },
    /// A later photograph of the frame shows it elsewhere: camera or frame have moved during the capture.
    FrameMoved {
        /// The later shot.
        shot: String,
        /// Median movement of its marks since the first frame shot, camera px.
        moved_px: [f64; 2],
        /// Its standard deviation per axis, px.
        sd_px: f64,
    },
    /// The board lay elsewhere than the frame's marks: the marks' plane is used.
    BoardElsewhere {
        /// The largest distance between the two at the slab's corners, camera px.
        largest_px: f64,
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
    /// Dots of one shot are so near to each other that their rows could be told apart only with the help of a model.
    CrossTalk {
        /// The smallest distance between dots of one shot, in outgoing samples.
        spacing_samples: f64,
        /// The distance that would do without; `None` when two windows would not.
        needed_samples: Option<usize>,
        /// Share of the light in the windows that was other dots' and was removed.
        removed_share: f64,
        /// Share of the samples that are the model's rather than measured.
        modelled_share: f64,
    },
    /// The board does not cover the slab: its registration there is an extrapolation.
    BoardTooSmall {
        /// The largest distance of a window's sample from the board, mm.
        outside_mm: f64,
    },
    /// A halo around everything bright, which was taken out; what is uncertain of it is in the variance.
    StrayLight {
        /// Share of the light in it.
        share: f64,
    },
    /// The lens blurs so much that taking it out costs accuracy and amplifies noise.
    StronglyBlurred {
        /// Standard deviation of the blur, camera px.
        psf_px: f64,
    },
    /// The board does not tell how much the lens blurs; it is taken for not at all.
    PointSpreadUnmeasured,
    /// The lens blurs more in one part of the picture than in another; its mean is taken out everywhere.
    PointSpreadVaries {
        /// Standard deviation that is taken out, camera px.
        psf_px: f64,
        /// The least and the largest of the picture's parts, camera px.
        range_px: [f64; 2],
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
    /// A material does not reach what was asked of it.
    GoalMissed {
        /// What was asked, with its unit.
        asked: String,
        /// What it is.
        found: String,
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

/// One jump of the projected pattern.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DriftJump {
    /// The first shot after it.
    pub shot: String,
    /// Its length, camera px.
    pub length_px: f64,
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
            Self::ExposureDisagrees { file, used_secs, other_secs, other, photographs } => {
                write!(f, "{file}: exposure {used_secs} s is used, {other} says {other_secs} s")?;
                if *photographs > 1 { write!(f, " ({photographs} photographs alike)") } else { Ok(()) }
            }
            Self::ApertureOrIsoChanges { file, factor } => {
                write!(f, "{file}: aperture or ISO differ from the first photograph; radiance is scaled by {factor:.4}")
            }
            Self::DriftJumps { jumps } => {
                let named = jumps.iter().take(5).map(|j| format!("\"{}\" by {:.2} px", j.shot, j.length_px));
                let more = if jumps.len() > 5 { format!(" and {} more", jumps.len() - 5) } else { String::new() };
                let list = named.collect::<Vec<_>>().join(", ");
                write!(f, "the pattern jumped before {list}{more}; it is taken out, but something was touched")
            }
            Self::CameraMoved { first, shots, measured, largest_px } => write!(
                f,
                "camera and sample have moved against each other by up to {largest_px:.2} px in {shots} of the {measured} lattice shots that show the sample's rim well enough (\"{first}\" first); their windows were moved with the rim"
            ),
            Self::FrameMoved { shot, moved_px: [x, y], sd_px } => write!(
                f,
                "the frame is seen ({x:.3}, {y:.3}) px from its first place in \"{shot}\" (standard deviation {sd_px:.3} px): camera or frame have moved during the capture"
            ),
            Self::BoardElsewhere { largest_px } => write!(
                f,
                "the board lay up to {largest_px:.2} px from where the frame's marks put the slab's corners; the marks are believed"
            ),
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
            Self::CrossTalk { spacing_samples, needed_samples, removed_share, modelled_share } => {
                let needed = needed_samples.map_or("more than two windows".into(), |n| format!("{n} samples"));
                write!(
                    f,
                    "dots of one shot are {spacing_samples:.1} samples apart and light each other's windows: {:.1} % of the light was removed, {:.1} % of the samples are modelled; {needed} apart would do",
                    100.0 * removed_share,
                    100.0 * modelled_share
                )
            }
            Self::BoardTooSmall { outside_mm } => {
                write!(f, "windows reach {outside_mm:.2} mm outside the board: registration is extrapolated there")
            }
            Self::StrayLight { share } => write!(
                f,
                "{:.2} % of the light is in a wide halo of the camera; it was measured on the frame and taken out: clean the lens, shade it",
                100.0 * share
            ),
            Self::StronglyBlurred { psf_px } => {
                write!(
                    f,
                    "the lens blurs by {psf_px:.2} px: peaks are known to some per cent only; focus it, or stop it down"
                )
            }
            Self::PointSpreadUnmeasured => {
                write!(f, "the board's edges do not tell how much the lens blurs; its blur is left in the rows")
            }
            Self::PointSpreadVaries { psf_px, range_px } => write!(
                f,
                "the lens blurs by {:.2} px in one part of the picture and {:.2} px in another; {psf_px:.2} px is taken out everywhere: check focus and tilt",
                range_px[0], range_px[1]
            ),
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
            Self::UnusableExif { file, tag, found, photographs } => write!(
                f,
                "{file}: EXIF {tag} is {found}, which cannot be; it is not used (in {photographs} photographs)"
            ),
            Self::ExposureRatios { nominal_secs, measured_secs, relative_sd } => write!(
                f,
                "the exposure of {nominal_secs:.6} s was {measured_secs:.6} s ({:+.2} % ± {:.2} %) by the photographs",
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
            Self::GoalMissed { asked, found } => write!(f, "target not reached: asked {asked}, got {found}"),
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
                    "{medium}, {channel}: a transport mean free path {path} exceeds the {exceeds} of {length_mm} mm, diffusion is far off"
                )
            }
            Self::DiffusionTooDark { medium, channel, reduced_scattering_per_mm, absorption_per_mm } => write!(
                f,
                "{medium}, {channel}: absorption {absorption_per_mm} /mm exceeds scattering {reduced_scattering_per_mm} /mm, diffusion is far off"
            ),
        }
    }
}
