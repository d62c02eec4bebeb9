//! What the slab is made of: optical coefficients in voxels, from media by name or from a file.

pub(crate) mod layout;
mod material;
pub mod table;
mod volume;
pub mod voxels;

pub use layout::{MediumRecord, SlabRecord};
pub use material::SlabMaterial;
pub use volume::{Beyond, Volume};

use serde::{Deserialize, Serialize};

/// Transport coefficients of one medium, per channel (R, G, B), mm⁻¹.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Optics {
    /// Reduced scattering σ'_s.
    pub reduced_scattering_per_mm: [f64; 3],
    /// Absorption σ_a.
    pub absorption_per_mm: [f64; 3],
    /// Mean cosine g of the scattering angle (Henyey–Greenstein), −1 < g < 1. Scattering is σ_s = σ'_s/(1 − g).
    pub anisotropy: [f64; 3],
}

impl Optics {
    const fn new(reduced_scattering_per_mm: [f64; 3], absorption_per_mm: [f64; 3]) -> Self {
        Self { reduced_scattering_per_mm, absorption_per_mm, anisotropy: [0.0; 3] }
    }

    /// Transport extinction σ'_s + σ_a of a channel, mm⁻¹.
    pub fn extinction_per_mm(&self, channel: usize) -> f64 {
        self.reduced_scattering_per_mm[channel] + self.absorption_per_mm[channel]
    }

    /// Scattering σ_s = σ'_s/(1 − g) of a channel, mm⁻¹.
    pub fn scattering_per_mm(&self, channel: usize) -> f64 {
        self.reduced_scattering_per_mm[channel] / (1.0 - self.anisotropy[channel])
    }

    /// The same reduced scattering with mean cosine `g` in every channel.
    pub fn with_anisotropy(self, g: f64) -> Self {
        Self { anisotropy: [g; 3], ..self }
    }

    /// The mixture of this with a share (0..=1) of `other`. Scattering and absorption mix as volumes do; so does the
    /// mean cosine, weighted by scattering.
    pub fn mixed(&self, other: &Self, share: f64) -> Self {
        let mut mixture = *self;
        for c in 0..3 {
            let mix = |a: f64, b: f64| a + share * (b - a);
            let reduced = mix(self.reduced_scattering_per_mm[c], other.reduced_scattering_per_mm[c]);
            let full = mix(self.scattering_per_mm(c), other.scattering_per_mm(c));
            mixture.reduced_scattering_per_mm[c] = reduced;
            mixture.absorption_per_mm[c] = mix(self.absorption_per_mm[c], other.absorption_per_mm[c]);
            if self.anisotropy[c] != other.anisotropy[c] && full > 0.0 {
                mixture.anisotropy[c] = 1.0 - reduced / full;
            }
        }
        mixture
    }
}

/// Unpolarized Fresnel reflectance at normal incidence, ((η − 1)/(η + 1))².
pub fn normal_reflectance(refractive_index: f64) -> f64 {
    ((refractive_index - 1.0) / (refractive_index + 1.0)).powi(2)
}

/// A(η) = (1 + F_dr)/(1 − F_dr) of the diffuse boundary condition, F_dr by the polynomial of Egan & Hilgeman 1979 as
/// Groenhuis et al. 1983 and Jensen et al. 2001 use it (η > 1).
pub fn boundary_factor(refractive_index: f64) -> f64 {
    let eta = refractive_index;
    let f_dr = -1.440 / (eta * eta) + 0.710 / eta + 0.668 + 0.0636 * eta;
    (1.0 + f_dr) / (1.0 - f_dr)
}
