//! What the simulator cannot describe of a slab.

use super::record::catalogue;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What the simulator cannot describe of a slab.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum SimulateWarning {
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

impl fmt::Display for SimulateWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::RefractiveIndexDiffers { used, used_index, other, other_index } => write!(
                f,
                "a slab has one refractive index: {used_index} of {used} is used for {other} ({other_index}) too"
            ),
            Self::DiffusionTooClear { medium, channel, mean_free_path_mm, exceeds, length_mm } => {
                let path = mean_free_path_mm.map_or("infinite transport mean free path".into(), |mm| {
                    format!("transport mean free path of {mm:.3} mm")
                });
                write!(
                    f,
                    "{medium}, {channel}: the {path} exceeds the {exceeds} of {length_mm} mm; diffusion is inaccurate"
                )
            }
            Self::DiffusionTooDark { medium, channel, reduced_scattering_per_mm, absorption_per_mm } => write!(
                f,
                "{medium}, {channel}: absorption of {absorption_per_mm} /mm exceeds reduced scattering of {reduced_scattering_per_mm} /mm; diffusion is inaccurate"
            ),
        }
    }
}

catalogue!(SimulateWarning {
    Self::RefractiveIndexDiffers { other, used_index, .. } => "refractive-index-differs", Warning, Simulation, Replaced,
        vec![medium(other)], bound("other_index", *used_index, "");
    Self::DiffusionTooClear { medium: name, length_mm, .. } => "diffusion-too-clear", Warning, Simulation, Told,
        vec![medium(name)], bound("mean_free_path_mm", *length_mm, "mm");
    Self::DiffusionTooDark { medium: name, reduced_scattering_per_mm, .. } => "diffusion-too-dark", Warning, Simulation, Told,
        vec![medium(name)], bound("absorption_per_mm", *reduced_scattering_per_mm, "/mm");
});
