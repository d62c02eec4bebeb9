//! What the slab is made of: measured optical coefficients, laid out over the plane.

mod volume;

pub use volume::{Beyond, Volume};

use crate::simulate::{MaterialKind, mix_seed};
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
}

/// Marble (Jensen et al. 2001, table 1), η = 1.5.
pub const MARBLE: Optics = Optics::new([2.19, 2.62, 3.00], [0.0021, 0.0041, 0.0071]);
/// Skin2 (the same table), η = 1.3.
pub const SKIN2: Optics = Optics::new([1.09, 1.59, 1.79], [0.013, 0.070, 0.145]);
/// Whole milk (the same table), η = 1.3.
pub const WHOLE_MILK: Optics = Optics::new([2.55, 3.21, 3.77], [0.0011, 0.0024, 0.014]);
/// A dark, denser vein in marble: not measured, chosen to look like one.
const VEIN: Optics = Optics::new([2.60, 3.00, 3.30], [0.060, 0.085, 0.110]);

/// A slab whose coefficients vary over the plane but not with depth: two media, mixed by a pattern.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Medium {
    /// Refractive index against air.
    pub refractive_index: f64,
    /// The first medium.
    pub first: Optics,
    /// The second; the same as the first when homogeneous.
    pub second: Optics,
    /// Where which is.
    pub layout: Layout,
}

/// Where the second medium takes the place of the first.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "layout", rename_all = "kebab-case")]
pub enum Layout {
    /// Nowhere.
    Uniform,
    /// On every other square of an endless chessboard.
    Chessboard {
        /// A corner of a square, mm.
        origin_mm: [f64; 2],
        /// Side of a square, mm.
        square_mm: f64,
    },
    /// Along veins: the zero lines of a turbulent noise.
    Veins {
        /// Wavelength of the coarsest noise, mm.
        scale_mm: f64,
        /// Seed of the noise.
        seed: u64,
    },
}

impl Medium {
    /// The medium of `kind` for a lit area that begins at `lit_origin_mm` and is `lit_side_mm` wide.
    pub fn new(kind: MaterialKind, lit_origin_mm: [f64; 2], lit_side_mm: f64, seed: u64) -> Self {
        let chessboard = |squares: f64| Self {
            refractive_index: 1.3,
            first: SKIN2,
            second: WHOLE_MILK,
            layout: Layout::Chessboard { origin_mm: lit_origin_mm, square_mm: lit_side_mm / squares },
        };
        match kind {
            MaterialKind::Homogeneous => {
                Self { refractive_index: 1.5, first: MARBLE, second: MARBLE, layout: Layout::Uniform }
            }
            MaterialKind::Chessboard4x4 => chessboard(4.0),
            MaterialKind::Chessboard8x8 => chessboard(8.0),
            MaterialKind::Marble => Self {
                refractive_index: 1.5,
                first: MARBLE,
                second: VEIN,
                layout: Layout::Veins { scale_mm: lit_side_mm / 3.0, seed },
            },
        }
    }

    /// The share of the second medium in the square of side `side_mm` whose first corner is `corner_mm`, in 0..=1.
    ///
    /// Exact for a chessboard, a 2 × 2 midpoint rule for veins; continuous in `corner_mm`, so that a voxel grid that
    /// follows its dot sees the material move smoothly.
    pub fn share_of_second(&self, corner_mm: [f64; 2], side_mm: f64) -> f64 {
        match self.layout {
            Layout::Uniform => 0.0,
            Layout::Chessboard { origin_mm, square_mm } => {
                let mean = |a: usize| {
                    let from = (corner_mm[a] - origin_mm[a]) / square_mm;
                    let to = from + side_mm / square_mm;
                    (square_wave_integral(to) - square_wave_integral(from)) / (to - from)
                };
                0.5 * (1.0 - mean(0) * mean(1))
            }
            Layout::Veins { scale_mm, seed } => {
                let mut sum = 0.0;
                for (u, v) in [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)] {
                    let p = [corner_mm[0] + u * side_mm, corner_mm[1] + v * side_mm];
                    sum += vein(seed, [p[0] / scale_mm, p[1] / scale_mm]);
                }
                sum / 4.0
            }
        }
    }

    /// σ'_s and σ_a of `channel` where the second medium has this share. Coefficients mix linearly, as volumes do.
    pub fn coefficients(&self, share: f64, channel: usize) -> (f64, f64) {
        let mix = |a: [f64; 3], b: [f64; 3]| a[channel] + share * (b[channel] - a[channel]);
        (
            mix(self.first.reduced_scattering_per_mm, self.second.reduced_scattering_per_mm),
            mix(self.first.absorption_per_mm, self.second.absorption_per_mm),
        )
    }
}

/// The integral from 0 of the wave that is +1 on even unit intervals and −1 on odd ones.
fn square_wave_integral(t: f64) -> f64 {
    let phase = t.rem_euclid(2.0);
    if phase < 1.0 { phase } else { 2.0 - phase }
}

/// Share of vein at `p` (in units of the coarsest wavelength): thin where four octaves of noise pass through zero.
fn vein(seed: u64, p: [f64; 2]) -> f64 {
    let (mut sum, mut scale, mut amplitude) = (0.0, 1.0, 1.0);
    for octave in 0..4 {
        sum += amplitude * value_noise(seed.wrapping_add(octave), [p[0] * scale, p[1] * scale]);
        scale *= 2.0;
        amplitude *= 0.45;
    }
    (-(sum / 0.12).powi(2)).exp()
}

/// Smooth noise in −1..1: hashed values on the unit lattice, blended by the C² quintic (Perlin 2002).
fn value_noise(seed: u64, p: [f64; 2]) -> f64 {
    let cell = [p[0].floor(), p[1].floor()];
    let blend = |t: f64| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (u, v) = (blend(p[0] - cell[0]), blend(p[1] - cell[1]));
    let at = |dx: i64, dy: i64| {
        let (x, y) = (cell[0] as i64 + dx, cell[1] as i64 + dy);
        let hash = mix_seed(mix_seed(seed, x as u64), y as u64);
        (hash >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let top = at(0, 0) + u * (at(1, 0) - at(0, 0));
    let bottom = at(0, 1) + u * (at(1, 1) - at(0, 1));
    top + v * (bottom - top)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chessboard_shares_are_exact_and_continuous() {
        let medium = Medium::new(MaterialKind::Chessboard4x4, [1.0, 2.0], 8.0, 0);
        assert_eq!(medium.share_of_second([1.2, 2.2], 0.5), 0.0);
        assert_eq!(medium.share_of_second([3.2, 2.2], 0.5), 1.0);
        // Half over an edge, and a quarter over a corner: half the area either way.
        assert!((medium.share_of_second([2.75, 2.2], 0.5) - 0.5).abs() < 1e-12);
        assert!((medium.share_of_second([2.75, 3.75], 0.5) - 0.5).abs() < 1e-12);
        let (a, b) = (medium.share_of_second([2.6, 2.2], 0.5), medium.share_of_second([2.6 + 1e-6, 2.2], 0.5));
        assert!((a - b).abs() < 1e-5);
    }

    #[test]
    fn veins_cover_a_part_of_the_slab() {
        let medium = Medium::new(MaterialKind::Marble, [0.0, 0.0], 24.0, 3);
        let shares: Vec<f64> =
            (0..400).map(|i| medium.share_of_second([(i % 20) as f64, (i / 20) as f64], 0.4)).collect();
        let mean = shares.iter().sum::<f64>() / 400.0;
        assert!((0.05..0.6).contains(&mean), "{mean}");
        assert!(shares.iter().all(|s| (0.0..=1.0).contains(s)));
    }
}
