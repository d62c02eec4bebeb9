//! What merging finds: noise, exposure times, response curve, lamp, hot photosites, stray light.

use super::bounds::{DOUBT_SD, STRAY_TOLD, TIME_SIGMA, TIME_TOLERANCE};
use super::record::catalogue;
use crate::words::{count, figure};
use serde::{Deserialize, Serialize};
use std::fmt;

/// What merging finds: noise, exposure times, response curve, lamp, hot photosites, stray light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum RadianceWarning {
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
    /// Photosites that show light in the dark; their neighbours stand in for them as far as they are better.
    HotPixels {
        /// How many, each channel by itself.
        photosites: usize,
        /// How many of them saturate every exposure.
        stuck: usize,
        /// The strongest dark current of the others, DN/s.
        strongest_dn_per_sec: f64,
    },
    /// Exposure times are not in the ratios that the photographs show, or the response curve is not what the rig says.
    ExposureRatios {
        /// The nominal time that is farthest off, s.
        nominal_secs: f64,
        /// What the photographs say it was, the mean of all settings taken as right, s.
        measured_secs: f64,
        /// Relative standard deviation of that.
        relative_sd: f64,
        /// What the light of all rows alike may be off by for such times (a standard deviation of itself).
        scale_sd: f64,
    },
    /// No stack relates these exposure settings to the others: their scales rest on the nominal times alone.
    ExposuresUnlinked {
        /// Nominal times of each group that stacks do link, s.
        groups: Vec<Vec<f64>>,
        /// What the light of all rows alike may be off by for it (a standard deviation of itself); 0 where nothing tells.
        scale_sd: f64,
    },
    /// The rig's folder cannot be written: the estimated response curve is used but not kept.
    CurveNotSaved {
        /// The file.
        file: String,
        /// The system's answer.
        reason: String,
    },
    /// The lamp's output changes from photograph to photograph; it was measured and taken out.
    Flicker {
        /// Relative standard deviation of a photograph.
        relative_sd: f64,
        /// What remains of it in a row, relative.
        remaining_sd: f64,
    },
    /// A halo around everything bright, which was taken out; what is uncertain of it is in the variance.
    StrayLight {
        /// Share of the light in it.
        share: f64,
    },
}

impl fmt::Display for RadianceWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoiseEstimated { gain_dn_per_electron: 0.0, black_dn, saturation_dn, .. } => write!(
                f,
                "the photographs show no noise beyond that of their code values (rounding, compression), which alone is in the variance; black {black_dn:.2} DN, saturation {saturation_dn:.0} DN"
            ),
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
                "noise estimated from the photographs: gain {} ± {} DN per electron, read noise {read_noise_electrons:.2} ± {read_noise_sd:.2} electrons, black {black_dn:.2} ± {black_sd:.2} DN, saturation {saturation_dn:.0} DN{}",
                figure(*gain_dn_per_electron),
                figure(*gain_sd),
                if *saturation_seen { "" } else { " (no pixel clips: the largest code value)" }
            ),
            Self::NoiseDisagrees { field, given, found, sd } => write!(
                f,
                "noise.{field} is {} in rig.toml, but {} ± {} in the photographs: the reported variance may be wrong",
                figure(*given),
                figure(*found),
                figure(*sd)
            ),
            Self::HotPixels { photosites, stuck, strongest_dn_per_sec } => write!(
                f,
                "{} found (up to {strongest_dn_per_sec:.0} DN/s; {stuck} saturated in every black exposure) and replaced by the neighbours",
                count(*photosites, "hot photosite")
            ),
            Self::ExposureRatios { nominal_secs, measured_secs, relative_sd, scale_sd } => write!(
                f,
                "the nominal exposure of {nominal_secs:.6} s is {measured_secs:.6} s ({:+.2} % ± {:.2} %) in the photographs: for times so far off all rows together may be by {:.1} %",
                100.0 * (measured_secs / nominal_secs - 1.0),
                100.0 * relative_sd,
                100.0 * scale_sd
            ),
            Self::ExposuresUnlinked { groups, scale_sd } => {
                let list = |g: &Vec<f64>| g.iter().map(|s| format!("{s:.6}")).collect::<Vec<_>>().join(", ");
                let groups: Vec<String> = groups.iter().map(list).collect();
                write!(
                    f,
                    "no stack links the exposures of {} s: their common scale relies on the nominal times",
                    groups.join(" s and ")
                )?;
                if *scale_sd > 0.0 {
                    write!(f, ", by which all rows together may be off by {:.1} %", 100.0 * scale_sd)?;
                }
                Ok(())
            }
            Self::CurveNotSaved { file, reason } => {
                write!(f, "{file}: the estimated response curve could not be saved: {reason}")
            }
            Self::Flicker { relative_sd, remaining_sd } => write!(
                f,
                "the lamp flickers by {:.2} % from photograph to photograph; {:.2} % remains after the correction",
                100.0 * relative_sd,
                100.0 * remaining_sd
            ),
            Self::StrayLight { share } => write!(
                f,
                "{:.2} % of the light is in a wide halo of the camera, which was measured on the frame and removed: clean the lens and shade it",
                100.0 * share
            ),
        }
    }
}

catalogue!(RadianceWarning {
    Self::NoiseEstimated { .. } => "noise-estimated", Note, Light, Replaced, vec![field("noise")], None;
    Self::NoiseDisagrees { field: name, sd, .. } => "noise-disagrees", Warning, Light, Told,
        vec![field(&format!("noise.{name}"))], bound("found - given", DOUBT_SD * sd, "");
    Self::HotPixels { .. } => "hot-pixels", Note, Light, Replaced, vec![part("camera")], None;
    Self::ExposureRatios { nominal_secs, relative_sd, .. } => "exposure-ratios", Warning, Exposures, Told,
        vec![exposure(*nominal_secs)],
        bound("measured_secs / nominal_secs - 1", TIME_TOLERANCE.max(TIME_SIGMA * relative_sd), "");
    Self::ExposuresUnlinked { groups, .. } => "exposures-unlinked", Warning, Exposures, Told,
        groups.iter().filter_map(|g| g.first()).map(|secs| exposure(*secs)).collect(), None;
    Self::CurveNotSaved { file, .. } => "curve-not-saved", Warning, Files, Told, vec![photograph(file)], None;
    Self::Flicker { .. } => "flicker", Note, Light, Corrected, vec![part("lamp")], None;
    Self::StrayLight { .. } => "stray-light", Warning, Focus, Corrected, vec![part("lens")],
        bound("share", STRAY_TOLD, "");
});
