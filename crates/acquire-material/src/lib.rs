//! Factored subsurface-scattering materials: load, evaluate, sample, relight.
//!
//! `acquire` measures R_d(x_i, x_o) of a translucent slab and factors it; this crate is what a renderer needs of it.
//!
//! ```
//! use acquire_material::{Evaluator, Material};
//!
//! # let bytes = include_bytes!("../tests/data/chessboard.safetensors");
//! let material = Material::from_bytes(bytes)?;
//! let evaluator = Evaluator::new(&material)?;
//! // mm⁻², R, G and B, from one point of the slab (mm) to another.
//! let response = evaluator.between([1.0, 1.2], [1.1, 1.3]);
//! assert!(response.iter().all(|r| r.is_finite()));
//! # Ok::<(), acquire_material::Error>(())
//! ```
//!
//! # Conventions
//! - Incident points are row-major over (y_i, x_i), as in the matrix; channels are linear R, G, B.
//! - Offsets live on the common window of [`Layout`]: the measured window and the room that shifted rows need.
//! - Stored numbers are f32; sums and polynomials are evaluated in f64.
//!
//! # Features
//! - `coded` (default): read and write coded files.
//! - `threads` (default): all cores where there are many rows. The results are the same without.

#[cfg(feature = "coded")]
pub mod coded;
mod color;
mod convolve;
mod entry_exit;
mod error;
mod evaluator;
mod exitance;
mod file;
mod fit_maps;
mod lattice;
mod layout;
pub mod legendre;
mod light;
#[cfg(test)]
mod naive;
mod parallel;
mod placement;
mod quadrature;
mod relight;
mod response;
mod sampling;
mod splat;

pub use entry_exit::ExitGrid;
pub use error::{Error, Result};
pub use evaluator::Evaluator;
pub use exitance::{Canvas, Exitance, Shape};
pub use file::Precision;
pub use fit_maps::{fit_entry_map, fit_exit_map};
pub use layout::Layout;
pub use light::{FIXED_SET, Light, LightImage, linear_from_srgb, srgb_from_linear};
pub use placement::{ImagePlacement, Stretch};
pub use quadrature::{LitArea, Quadrature};
pub use relight::relight;
pub use response::Responses;
pub use sampling::Sampled;
pub use splat::splat;

use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// A point, vector or extent of the plane, (x, y).
pub type Point = [f64; 2];

const CHANNELS: usize = 3;

/// Which factorization a material holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Model {
    /// Intensity by error modelling, colour by a polynomial of the intensity per incident point (`Kurt2013`).
    Tucker,
    /// The mean profile divided out, the rest a non-negative factorization (`Peers2006`).
    Peers2006,
    /// One factorization of the three channels together.
    Joint,
}

impl Model {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Tucker, Self::Peers2006, Self::Joint];

    /// Its name, as people type it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tucker => "tucker",
            Self::Peers2006 => "peers2006",
            Self::Joint => "joint",
        }
    }
}

impl std::fmt::Display for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// What is known of a material besides its factors; the metadata of its file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaterialHeader {
    /// The factorization.
    pub model: Model,
    /// Lit points along x and y.
    pub points: [usize; 2],
    /// Outgoing samples of a window along x and y.
    pub window: [usize; 2],
    /// Side of an outgoing cell, mm.
    pub pitch_mm: f64,
    /// Mean distance of lit points along x and y, mm.
    pub lit_pitch_mm: Point,
    /// Samples along x and y of the common window, on which the offset factors live, see [`Layout`]; R̂_d is 0 outside
    /// it.
    pub extended: [usize; 2],
    /// T, the number of terms.
    pub terms: usize,
    /// A: 1 when all planes share their incident factors, else 3.
    pub incident_planes: usize,
    /// B: 1 when all planes share their offset factors, else 3.
    pub offset_planes: usize,
    /// K, the maps of which all offset factors are sums; `None` when they are stored themselves.
    #[serde(default)]
    pub shared_maps: Option<usize>,
    /// Whether there is a profile that multiplies the terms.
    pub profile: bool,
    /// Where the exit map lies; `None` without entry and exit maps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exit_grid: Option<ExitGrid>,
    /// P, the degree of the colour polynomial. `None` without a polynomial: three planes are then R, G and B, and a
    /// single plane is the response of all three channels.
    pub degree: Option<usize>,
    /// The normalized intensities that the Legendre basis maps to −1 and 1; arguments are clamped to them.
    pub intensity_range: [f32; 2],
    /// Leading singular values of the rows as they were factored, descending; more than T of them. Empty for
    /// [`Model::Peers2006`].
    pub singular_values: Vec<f64>,
    /// The spectral norm that noise alone would have, in the unit of `singular_values`.
    pub noise_level: f64,
    /// Findings of the measurement and of the factorization, as `acquire` writes them: an object with a `kind` and its
    /// figures each.
    pub warnings: Vec<serde_json::Value>,
    /// Version, options, and the provenance of the matrix.
    pub provenance: serde_json::Value,
}

/// A factored material.
///
/// Plane k at incident point i and sample e = d − shift_i of the common window is v_k(i, e) = m_k(e) Σ_j g_j f_{k,j}(i)
/// h_{k,j}(e), where the profile m is 1 when there is none. With a colour polynomial there is one plane, the normalized
/// intensity, and R̂_c = Σ_p β_{c,p}(i) L_p(v) with Legendre polynomials L_p on [`MaterialHeader::intensity_range`] for
/// the powers of `Kurt2013`, eqs. (1)–(4); without one R̂_c is plane c, or the only plane. Where there are entry and
/// exit maps, that is multiplied by a_c(i) and by e_c at the place where the light leaves, see [`ExitGrid`].
///
/// Tensors are row-major with the shapes named at each; N = x × y lit points.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// What it is.
    pub header: MaterialHeader,
    /// Where each lit point is, mm, \[N\].
    pub lit_mm: Vec<Point>,
    /// g_j, \[T\].
    pub weights: Vec<f32>,
    /// f_{k,j}(x_i), \[A, N, T\].
    pub incident_factors: Vec<f32>,
    /// h_{k,j}(d), \[B, T, extended y, extended x\].
    pub offset_factors: OffsetFactors,
    /// m_k(d), \[B, extended y, extended x\], or empty.
    pub profile: Vec<f32>,
    /// β_{c,p}(x_i), mm⁻², \[N, 3, P+1\], or empty.
    pub color_coefficients: Vec<f32>,
    /// a_c(x_i), \[C, N\], or empty.
    pub entry_map: Vec<f32>,
    /// e_c(x_o), \[C, y, x\] of [`ExitGrid`], or empty.
    pub exit_map: Vec<f32>,
    /// Offset of each row's peak from its lit point, samples along x and y, \[N, 2\].
    pub shift: Vec<[i16; 2]>,
}

/// Offset factors, as they are stored.
#[derive(Debug, Clone, PartialEq)]
pub enum OffsetFactors {
    /// Themselves.
    Own(Vec<f32>),
    /// Sums of fewer maps.
    Shared(SharedBasis),
}

/// Offset factors as sums of fewer maps, h_{k,j} = Σ_l c_{k,j,l} b_l.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedBasis {
    /// K.
    pub maps: usize,
    /// b_l(d), \[K, extended y, extended x\].
    pub vectors: Vec<f32>,
    /// c_{k,j,l}, \[B, T, K\].
    pub core: Vec<f32>,
}

impl OffsetFactors {
    /// All of them, \[B, T, extended y, extended x\]: a borrow, or the sums of shared maps, rounded to f32.
    pub fn all(&self) -> Cow<'_, [f32]> {
        match self {
            Self::Own(factors) => Cow::Borrowed(factors),
            Self::Shared(shared) => Cow::Owned(shared.offset_factors()),
        }
    }
}

impl From<Vec<f32>> for OffsetFactors {
    fn from(factors: Vec<f32>) -> Self {
        Self::Own(factors)
    }
}

impl SharedBasis {
    /// The offset factors, \[B, T, extended y, extended x\].
    pub fn offset_factors(&self) -> Vec<f32> {
        let wide = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
        let maps = response::Maps::new(&wide(&self.vectors), self.maps);
        let mut out = Vec::new();
        maps.sums(&wide(&self.core), &mut out);
        out.chunks_exact(maps.stride().max(1))
            .flat_map(|line| line[..maps.samples()].iter().map(|&v| v as f32))
            .collect()
    }
}

impl MaterialHeader {
    /// Number of lit points.
    pub fn rows(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// The measured and the common window.
    pub fn layout(&self) -> Layout {
        Layout { window: self.window, extended: self.extended }
    }

    /// Model, terms and degree in a few words.
    pub fn describe(&self) -> String {
        let noun = if self.terms == 1 { "term" } else { "terms" };
        let maps = self
            .shared_maps
            .map(|k| format!(" of {k} shared map{}", if k == 1 { "" } else { "s" }))
            .unwrap_or_default();
        let color = match self.degree {
            Some(p) => format!(", colour of degree {p}"),
            None if self.planes() == 1 => ", grey".to_owned(),
            None => String::new(),
        };
        let through = if self.exit_grid.is_some() { ", entry and exit maps" } else { "" };
        format!("{}, {} {noun}{maps}{color}{through}", self.model, self.terms)
    }

    /// Planes that the factors give: 1 or 3.
    pub fn planes(&self) -> usize {
        self.incident_planes.max(self.offset_planes)
    }

    /// Tensors that may be stored, in the order of [`Material::stored`]; those that a material has not have the shape
    /// \[0\].
    pub(crate) fn shapes(&self) -> [(&'static str, Vec<usize>); 9] {
        let (n, [ex, ey]) = (self.rows(), self.extended);
        let profile = if self.profile { vec![self.offset_planes, ey, ex] } else { vec![0] };
        let own = vec![self.offset_planes, self.terms, ey, ex];
        let offsets = if self.shared_maps.is_some() { vec![0] } else { own };
        [
            ("weights", vec![self.terms]),
            ("incident_factors", vec![self.incident_planes, n, self.terms]),
            ("offset_factors", offsets),
            ("offset_maps", self.shared_maps.map_or(vec![0], |k| vec![k, ey, ex])),
            ("offset_core", self.shared_maps.map_or(vec![0], |k| vec![self.offset_planes, self.terms, k])),
            ("profile", profile),
            ("color_coefficients", self.degree.map_or(vec![0], |p| vec![n, CHANNELS, p + 1])),
            ("entry_map", self.exit_grid.map_or(vec![0], |g| vec![g.planes, n])),
            ("exit_map", self.exit_grid.map_or(vec![0], |g| vec![g.planes, g.size[1], g.size[0]])),
        ]
    }

    /// Every number that such a material stores as 4 bytes, the papers' count: weights, factors, profile, coefficients,
    /// entry and exit maps, the shifts when there are any, and the intensity range when there is a polynomial; metadata
    /// and positions are not counted.
    pub fn bytes_f32(&self, shifted: bool) -> u64 {
        let tensors: usize = self.shapes().iter().map(|(_, shape)| shape.iter().product::<usize>()).sum();
        let shifts = if shifted { 2 * self.rows() } else { 0 };
        let range = if self.degree.is_some() { 2 } else { 0 };
        4 * (tensors + shifts + range) as u64
    }

    /// Numbers of one row: dy, dx, channel.
    pub fn row_len(&self) -> usize {
        self.window[0] * self.window[1] * CHANNELS
    }
}

impl Material {
    /// Every stored number as 4 bytes, see [`MaterialHeader::bytes_f32`].
    pub fn bytes_f32(&self) -> u64 {
        self.header.bytes_f32(self.is_shifted())
    }

    /// Whether any row is moved.
    pub fn is_shifted(&self) -> bool {
        self.shift.iter().any(|s| *s != [0, 0])
    }

    /// The tensors of f32 that a file of this material holds: name, shape, numbers.
    pub fn tensors(&self) -> impl Iterator<Item = (&'static str, Vec<usize>, &[f32])> {
        let all = self.header.shapes().into_iter().zip(self.stored());
        all.filter(|((_, shape), _)| *shape != [0]).map(|((name, shape), values)| (name, shape, values))
    }

    /// Tensors as they are stored, in the order of [`MaterialHeader::shapes`].
    pub(crate) fn stored(&self) -> [&[f32]; 9] {
        let (own, maps, core): (&[f32], &[f32], &[f32]) = match &self.offset_factors {
            OffsetFactors::Shared(shared) => (&[], &shared.vectors, &shared.core),
            OffsetFactors::Own(own) => (own, &[], &[]),
        };
        let [entry, exit] = [&self.entry_map, &self.exit_map];
        [&self.weights, &self.incident_factors, own, maps, core, &self.profile, &self.color_coefficients, entry, exit]
    }

    /// f_{k,j} of row `index`, \[T\]; empty when there is no such row.
    pub fn incident(&self, plane: usize, index: usize) -> &[f32] {
        let h = &self.header;
        let at = (plane.min(h.incident_planes - 1) * h.rows() + index) * h.terms;
        if index < h.rows() { self.incident_factors.get(at..at + h.terms).unwrap_or_default() } else { &[] }
    }

    /// m_k on the common window, when there is a profile.
    pub fn profile_plane(&self, plane: usize) -> Option<&[f32]> {
        let len = self.header.layout().len();
        let plane = plane.min(self.header.offset_planes - 1);
        self.header.profile.then(|| &self.profile[plane * len..][..len])
    }

    /// R̂_d of row `index` on its measured window, \[dy\]\[dx\]\[channel\], mm⁻², put back where it was measured.
    /// Empty when there is no such row.
    ///
    /// Widens the offset factors to f64 at every call: for many rows make [`Responses`] once.
    pub fn evaluate_row(&self, index: usize) -> Vec<f32> {
        if index >= self.header.rows() {
            return Vec::new();
        }
        Responses::new(self).row(index)
    }

    /// A material of its entry and exit maps and positions alone, without terms.
    pub fn maps_alone(&self) -> Self {
        Self {
            header: MaterialHeader { provenance: serde_json::Value::Null, warnings: Vec::new(), ..self.header.clone() },
            lit_mm: self.lit_mm.clone(),
            weights: Vec::new(),
            incident_factors: Vec::new(),
            offset_factors: OffsetFactors::Own(Vec::new()),
            profile: Vec::new(),
            color_coefficients: Vec::new(),
            entry_map: self.entry_map.clone(),
            exit_map: self.exit_map.clone(),
            shift: Vec::new(),
        }
    }

    /// β of row `index`, P+1 for each channel.
    pub fn coefficients(&self, index: usize, degree: usize) -> [&[f32]; CHANNELS] {
        let n = degree + 1;
        std::array::from_fn(|c| &self.color_coefficients[(index * CHANNELS + c) * n..][..n])
    }
}

/// Part `plane` of offset factors, \[T, samples\]; the only one when planes share them.
pub(crate) fn offset_plane<'a>(all: &'a [f32], h: &MaterialHeader, plane: usize) -> &'a [f32] {
    let len = h.terms * h.layout().len();
    &all[plane.min(h.offset_planes - 1) * len..][..len]
}

#[cfg(test)]
mod tests;
