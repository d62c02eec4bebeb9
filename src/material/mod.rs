//! Material: evaluate R̂_d, relight, save, export.
//!
//! # Conventions
//! - Incident points are row-major over (y_i, x_i), as in the matrix; channels are linear R, G, B.
//! - Offsets live on the common window of [`Layout`]: the measured window and the room that shifted rows need.
//! - Stored numbers are f32; sums and polynomials are evaluated in f64.

mod exr_layers;
mod file;
pub mod legendre;
pub mod light;
mod npz;
mod relight;
mod source;

pub use exr_layers::{export_exr, write_exitance, write_png};
pub use light::{FIXED_SET, Light, LightImage};
pub use npz::export_npz;
pub(crate) use relight::splat;
pub use relight::{Canvas, Exitance, relight};
pub use source::{Shape, Source};

use crate::{Warning, geometry::Point, transport::normalize::Layout};
use serde::{Deserialize, Serialize};

const CHANNELS: usize = 3;

/// Which factorization a material holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Model {
    /// Intensity by error modelling, colour by a polynomial of the intensity per incident point (`Kurt2013`).
    Tucker,
}

impl std::fmt::Display for Model {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tucker => f.write_str("tucker"),
        }
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
    /// Samples along x and y of the window on which the offset factors live: `window` and what shifts need.
    pub extended: [usize; 2],
    /// T, the number of terms.
    pub terms: usize,
    /// P, the degree of the colour polynomial.
    pub degree: usize,
    /// The normalized intensities that the Legendre basis maps to −1 and 1; arguments are clamped to them.
    pub intensity_range: [f32; 2],
    /// Leading singular values of the normalized rows, descending; more than T of them.
    pub singular_values: Vec<f64>,
    /// The spectral norm that noise alone would have, in the unit of `singular_values`.
    pub noise_level: f64,
    /// Findings of the measurement and of the factorization.
    pub warnings: Vec<Warning>,
    /// Version, options, and the provenance of the matrix.
    pub provenance: serde_json::Value,
}

/// A factored material: R̂_d(x_i, d) = Σ_p β_{c,p}(x_i) L_p(Î), Î = Σ_j g_j f_j(x_i) h_j(d − shift(x_i)).
///
/// `Kurt2013`, eqs. (1)–(4), with Legendre polynomials L_p on [`MaterialHeader::intensity_range`] for the powers.
/// Tensors are row-major with the shapes named at each; N = x × y lit points.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    /// What it is.
    pub header: MaterialHeader,
    /// Where each lit point is, mm, \[N\].
    pub lit_mm: Vec<Point>,
    /// g_j, the singular values of the terms, \[T\].
    pub weights: Vec<f32>,
    /// f_j(x_i), unit norm over x_i for every j, \[N, T\].
    pub incident_factors: Vec<f32>,
    /// h_j(d), unit norm over d for every j, \[T, extended y, extended x\].
    pub offset_factors: Vec<f32>,
    /// β_{c,p}(x_i), mm⁻², \[N, 3, P+1\].
    pub color_coefficients: Vec<f32>,
    /// Offset of each row's peak from its lit point, samples along x and y, \[N, 2\].
    pub shift: Vec<[i16; 2]>,
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

    /// Numbers of one row: dy, dx, channel.
    pub fn row_len(&self) -> usize {
        self.window[0] * self.window[1] * CHANNELS
    }
}

impl Material {
    /// Every stored number as 4 bytes, the papers' count: weights, factors, coefficients, shifts and the intensity
    /// range; metadata and positions are not counted.
    pub fn bytes_f32(&self) -> u64 {
        let numbers = self.weights.len()
            + self.incident_factors.len()
            + self.offset_factors.len()
            + self.color_coefficients.len()
            + 2 * self.shift.len()
            + self.header.intensity_range.len();
        4 * numbers as u64
    }

    /// Normalized intensity Î of row `index` on the common window; empty when there is no such row.
    pub fn intensity_row(&self, index: usize) -> Vec<f64> {
        let terms = self.header.terms;
        let Some(f) = self.incident_factors.get(index * terms..(index + 1) * terms) else { return Vec::new() };
        let samples = self.header.layout().len();
        let mut row = vec![0.0; samples];
        for ((&g, &f), h) in self.weights.iter().zip(f).zip(self.offset_factors.chunks_exact(samples.max(1))) {
            let gf = f64::from(g) * f64::from(f);
            for (sum, &h) in row.iter_mut().zip(h) {
                *sum += gf * f64::from(h);
            }
        }
        row
    }

    /// R̂_d of row `index` on its measured window, \[dy\]\[dx\]\[channel\], mm⁻², put back where it was measured.
    /// Empty when there is no such row.
    pub fn evaluate_row(&self, index: usize) -> Vec<f32> {
        let Some(&shift) = self.shift.get(index) else { return Vec::new() };
        let intensity = self.intensity_row(index);
        let [low, high] = self.header.intensity_range.map(f64::from);
        let mut arguments = vec![0.0; self.header.window[0] * self.header.window[1]];
        self.header.layout().for_each(shift, |k, e| arguments[k] = legendre::argument(intensity[e], low, high));
        let columns = legendre::columns(&arguments, self.header.degree + 1);
        let mut row = vec![0.0; self.header.row_len()];
        let mut sums = arguments;
        for (c, beta) in self.coefficients(index).into_iter().enumerate() {
            sums.fill(0.0);
            for (column, &b) in columns.iter().zip(beta) {
                sums.iter_mut().zip(column).for_each(|(sum, l)| *sum += f64::from(b) * l);
            }
            row.iter_mut().skip(c).step_by(CHANNELS).zip(&sums).for_each(|(value, &sum)| *value = sum as f32);
        }
        row
    }

    /// R̂_d at one offset (samples along x and y), mm⁻²; `None` outside the window or for a row that is not there.
    pub fn response(&self, index: usize, offset: [isize; 2]) -> Option<[f32; 3]> {
        let shift = *self.shift.get(index)?;
        let layout = self.header.layout();
        let sample = |a: usize| {
            let s = usize::try_from(offset[a] + (layout.window[a] / 2) as isize).ok()?;
            (s < layout.window[a]).then_some(s)
        };
        let at = layout.start(shift)? + sample(0)? + sample(1)? * layout.extended[0];
        let (terms, samples) = (self.header.terms, layout.len());
        let f = self.incident_factors.get(index * terms..(index + 1) * terms)?;
        let term =
            |j: usize| f64::from(self.weights[j]) * f64::from(f[j]) * f64::from(self.offset_factors[j * samples + at]);
        let [low, high] = self.header.intensity_range.map(f64::from);
        let mut basis = vec![0.0; self.header.degree + 1];
        legendre::evaluate(legendre::argument((0..terms).map(term).sum(), low, high), &mut basis);
        let value = |beta: &[f32]| beta.iter().zip(&basis).map(|(&b, l)| f64::from(b) * l).sum::<f64>() as f32;
        Some(self.coefficients(index).map(value))
    }

    /// β of row `index`, P+1 for each channel.
    fn coefficients(&self, index: usize) -> [&[f32]; CHANNELS] {
        let n = self.header.degree + 1;
        std::array::from_fn(|c| &self.color_coefficients[(index * CHANNELS + c) * n..][..n])
    }
}
