//! Material: evaluate R̂_d, relight, save, export.
//!
//! # Conventions
//! - Incident points are row-major over (y_i, x_i), as in the matrix; channels are linear R, G, B.
//! - Offsets live on the common window of [`Layout`]: the measured window and the room that shifted rows need.
//! - Stored numbers are f32; sums and polynomials are evaluated in f64.

pub mod coded;
mod convolve;
mod evaluator;
mod exr_layers;
mod file;
pub mod legendre;
pub mod light;
#[cfg(test)]
mod naive;
mod npz;
mod relight;
mod rows;
mod sampling;
mod source;
mod splat;

pub use evaluator::Evaluator;
pub use exr_layers::{export_exr, write_exitance, write_png};
pub use file::Precision;
pub use light::{FIXED_SET, Light, LightImage};
pub use npz::export_npz;
pub use relight::{Canvas, Exitance, relight};
pub use sampling::Sampled;
pub use source::{Shape, Source};
pub(crate) use splat::splat;

use crate::{Warning, geometry::Point, transport::normalize::Layout};
use serde::{Deserialize, Serialize};

const CHANNELS: usize = 3;

/// Which factorization a material holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[derive(clap::ValueEnum)]
#[value(rename_all = "lower")]
#[non_exhaustive]
pub enum Model {
    /// Intensity by error modelling, colour by a polynomial of the intensity per incident point (`Kurt2013`).
    Tucker,
    /// The mean profile divided out, the rest a non-negative factorization (`Peers2006`).
    Peers2006,
    /// One factorization of the three channels together.
    Joint,
}

impl std::fmt::Display for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Tucker => "tucker",
            Self::Peers2006 => "peers2006",
            Self::Joint => "joint",
        })
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
    /// Samples along x and y of the common window, on which the offset factors live, see [`Layout`]; R̂_d is 0 outside it.
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
    /// P, the degree of the colour polynomial; `None` when there is none: then the planes are R, G and B themselves,
    /// or the one plane is the response of all three.
    pub degree: Option<usize>,
    /// The normalized intensities that the Legendre basis maps to −1 and 1; arguments are clamped to them.
    pub intensity_range: [f32; 2],
    /// Leading singular values of the rows as they were factored, descending; more than T of them. Empty for [`Model::Peers2006`].
    pub singular_values: Vec<f64>,
    /// The spectral norm that noise alone would have, in the unit of `singular_values`.
    pub noise_level: f64,
    /// Findings of the measurement and of the factorization.
    pub warnings: Vec<Warning>,
    /// Version, options, and the provenance of the matrix.
    pub provenance: serde_json::Value,
}

/// A factored material.
///
/// Plane k at incident point i and sample e = d − shift_i of the common window is
/// v_k(i, e) = m_k(e) Σ_j g_j f_{k,j}(i) h_{k,j}(e), where the profile m is 1 when there is none. With a colour polynomial there
/// is one plane, the normalized intensity, and R̂_c = Σ_p β_{c,p}(i) L_p(v) with Legendre polynomials L_p on
/// [`MaterialHeader::intensity_range`] for the powers of `Kurt2013`, eqs. (1)–(4); without one R̂_c is plane c, or the only plane.
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
    /// h_{k,j}(d), \[B, T, extended y, extended x\]; made from `shared` when that is there.
    pub offset_factors: Vec<f32>,
    /// What is stored in the place of `offset_factors`.
    pub shared: Option<SharedBasis>,
    /// m_k(d), \[B, extended y, extended x\], or empty.
    pub profile: Vec<f32>,
    /// β_{c,p}(x_i), mm⁻², \[N, 3, P+1\], or empty.
    pub color_coefficients: Vec<f32>,
    /// Offset of each row's peak from its lit point, samples along x and y, \[N, 2\].
    pub shift: Vec<[i16; 2]>,
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

impl SharedBasis {
    /// The offset factors, \[B, T, extended y, extended x\].
    pub(crate) fn offset_factors(&self) -> Vec<f32> {
        let samples = self.vectors.len() / self.maps.max(1);
        let wide: Vec<f64> = self.vectors.iter().map(|&v| f64::from(v)).collect();
        let core: Vec<f64> = self.core.iter().map(|&v| f64::from(v)).collect();
        let factors = self.core.len() / self.maps.max(1);
        let mut out = vec![0.0; factors * samples];
        faer::linalg::matmul::matmul(
            faer::MatMut::from_row_major_slice_mut(&mut out, factors, samples),
            faer::Accum::Replace,
            faer::MatRef::from_row_major_slice(&core, factors, self.maps),
            faer::MatRef::from_row_major_slice(&wide, self.maps, samples),
            1.0,
            faer::get_global_parallelism(),
        );
        out.into_iter().map(|v| v as f32).collect()
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
        format!("{}, {} {noun}{maps}{color}", self.model, self.terms)
    }

    /// Planes that the factors give: 1 or 3.
    pub fn planes(&self) -> usize {
        self.incident_planes.max(self.offset_planes)
    }

    /// Tensors that are stored, in the order of [`Material::stored`]; those that a material has not have the shape \[0\].
    pub(crate) fn shapes(&self) -> [(&'static str, Vec<usize>); 7] {
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
        ]
    }

    /// Every number that such a material stores as 4 bytes, the papers' count: weights, factors, profile, coefficients, the shifts when
    /// there are any, and the intensity range when there is a polynomial; metadata and positions are not counted.
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
    pub(crate) fn is_shifted(&self) -> bool {
        self.shift.iter().any(|s| *s != [0, 0])
    }

    /// Tensors as they are stored, in the order of [`MaterialHeader::shapes`].
    pub(crate) fn stored(&self) -> [&[f32]; 7] {
        let (own, maps, core): (&[f32], &[f32], &[f32]) = match &self.shared {
            Some(shared) => (&[], &shared.vectors, &shared.core),
            None => (&self.offset_factors, &[], &[]),
        };
        [&self.weights, &self.incident_factors, own, maps, core, &self.profile, &self.color_coefficients]
    }

    /// f_{k,j} of row `index`, \[T\]; empty when there is no such row.
    pub(crate) fn incident(&self, plane: usize, index: usize) -> &[f32] {
        let h = &self.header;
        let at = (plane.min(h.incident_planes - 1) * h.rows() + index) * h.terms;
        if index < h.rows() { self.incident_factors.get(at..at + h.terms).unwrap_or_default() } else { &[] }
    }

    /// h_{k,j} on the common window, \[T, samples\].
    pub(crate) fn offsets(&self, plane: usize) -> &[f32] {
        let len = self.header.terms * self.header.layout().len();
        &self.offset_factors[plane.min(self.header.offset_planes - 1) * len..][..len]
    }

    /// m_k on the common window, when there is a profile.
    pub(crate) fn profile_plane(&self, plane: usize) -> Option<&[f32]> {
        let len = self.header.layout().len();
        let plane = plane.min(self.header.offset_planes - 1);
        self.header.profile.then(|| &self.profile[plane * len..][..len])
    }

    /// Plane `plane` of row `index` on the common window; empty when there is no such row. The only plane of a material with a colour
    /// polynomial is the normalized intensity Î.
    pub fn plane_row(&self, plane: usize, index: usize) -> Vec<f64> {
        let f = self.incident(plane, index);
        if f.is_empty() {
            return Vec::new();
        }
        let samples = self.header.layout().len();
        let mut row = vec![0.0; samples];
        for ((&g, &f), h) in self.weights.iter().zip(f).zip(self.offsets(plane).chunks_exact(samples.max(1))) {
            let gf = f64::from(g) * f64::from(f);
            for (sum, &h) in row.iter_mut().zip(h) {
                *sum += gf * f64::from(h);
            }
        }
        if let Some(profile) = self.profile_plane(plane) {
            row.iter_mut().zip(profile).for_each(|(v, &m)| *v *= f64::from(m));
        }
        row
    }

    /// Plane `plane` of consecutive rows on the common window, \[row, y, x\], by one product in f64: steep polynomials of it magnify
    /// what f32 would round.
    pub(crate) fn plane_block(&self, plane: usize, rows: std::ops::Range<usize>) -> Vec<f64> {
        let (terms, samples) = (self.header.terms, self.header.layout().len());
        let amount = |(&f, &g): (&f32, &f32)| f64::from(f) * f64::from(g);
        let amounts: Vec<f64> =
            rows.clone().flat_map(|i| self.incident(plane, i).iter().zip(&self.weights).map(amount)).collect();
        let offsets: Vec<f64> = self.offsets(plane).iter().map(|&h| f64::from(h)).collect();
        let mut out = vec![0.0; rows.len() * samples];
        faer::linalg::matmul::matmul(
            faer::MatMut::from_row_major_slice_mut(&mut out, rows.len(), samples),
            faer::Accum::Replace,
            faer::MatRef::from_row_major_slice(&amounts, rows.len(), terms),
            faer::MatRef::from_row_major_slice(&offsets, terms, samples),
            1.0,
            faer::get_global_parallelism(),
        );
        if let Some(profile) = self.profile_plane(plane) {
            out.chunks_exact_mut(samples)
                .for_each(|row| row.iter_mut().zip(profile).for_each(|(v, &m)| *v *= f64::from(m)));
        }
        out
    }

    /// R̂_d of row `index` on its measured window, \[dy\]\[dx\]\[channel\], mm⁻², put back where it was measured.
    /// Empty when there is no such row.
    pub fn evaluate_row(&self, index: usize) -> Vec<f32> {
        let Some(&shift) = self.shift.get(index) else { return Vec::new() };
        let (h, layout) = (&self.header, self.header.layout());
        let mut row = vec![0.0; h.row_len()];
        let Some(degree) = h.degree else {
            for plane in 0..h.planes() {
                let values = self.plane_row(plane, index);
                for c in if h.planes() == 1 { 0..CHANNELS } else { plane..plane + 1 } {
                    layout.for_each(shift, |k, e| row[3 * k + c] = values[e] as f32);
                }
            }
            return row;
        };
        let intensity = self.plane_row(0, index);
        let [low, high] = h.intensity_range.map(f64::from);
        let mut arguments = vec![0.0; h.window[0] * h.window[1]];
        let mut modelled = vec![false; arguments.len()];
        layout.for_each(shift, |k, e| {
            (arguments[k], modelled[k]) = (legendre::argument(intensity[e], low, high), true);
        });
        let columns = legendre::columns(&arguments, degree + 1);
        let mut sums = arguments;
        for (c, beta) in self.coefficients(index, degree).into_iter().enumerate() {
            sums.fill(0.0);
            for (column, &b) in columns.iter().zip(beta) {
                sums.iter_mut().zip(column).for_each(|(sum, l)| *sum += f64::from(b) * l);
            }
            let values = row.iter_mut().skip(c).step_by(CHANNELS).zip(sums.iter().zip(&modelled));
            values.filter(|(_, (_, m))| **m).for_each(|(value, (&sum, _))| *value = sum as f32);
        }
        row
    }

    /// R̂_d at one offset (samples along x and y), mm⁻²; `None` outside the window or for a row that is not there.
    pub fn response(&self, index: usize, offset: [isize; 2]) -> Option<[f32; 3]> {
        let shift = *self.shift.get(index)?;
        let (h, layout) = (&self.header, self.header.layout());
        let sample = |a: usize| {
            let s = usize::try_from(offset[a] + (layout.window[a] / 2) as isize).ok()?;
            (s < layout.window[a]).then_some(s)
        };
        let Some(at) = layout.index(shift, [sample(0)?, sample(1)?]) else { return Some([0.0; 3]) };
        let samples = layout.len();
        let value = |plane: usize| {
            let terms = self.weights.iter().zip(self.incident(plane, index)).enumerate();
            let h = self.offsets(plane);
            let sum: f64 =
                terms.map(|(j, (&g, &f))| f64::from(g) * f64::from(f) * f64::from(h[j * samples + at])).sum();
            self.profile_plane(plane).map_or(sum, |m| sum * f64::from(m[at]))
        };
        let Some(degree) = h.degree else {
            return Some(match h.planes() {
                1 => [value(0) as f32; 3],
                _ => std::array::from_fn(|c| value(c) as f32),
            });
        };
        let [low, high] = h.intensity_range.map(f64::from);
        let mut basis = vec![0.0; degree + 1];
        legendre::evaluate(legendre::argument(value(0), low, high), &mut basis);
        let color = |beta: &[f32]| beta.iter().zip(&basis).map(|(&b, l)| f64::from(b) * l).sum::<f64>() as f32;
        Some(self.coefficients(index, degree).map(color))
    }

    /// β of row `index`, P+1 for each channel.
    pub(crate) fn coefficients(&self, index: usize, degree: usize) -> [&[f32]; CHANNELS] {
        let n = degree + 1;
        std::array::from_fn(|c| &self.color_coefficients[(index * CHANNELS + c) * n..][..n])
    }
}
