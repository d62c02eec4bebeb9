//! The window of responses around one lit point.

use super::irradiance::{Flux, Sensitivity};
use super::reconstruct::CellWeights;
use crate::capture::{Rect, Window};
use crate::geometry::{CameraView, Point};
use crate::radiance::Radiance;
use crate::transport::{Row, common::slopes};

/// A lit dot whose window is to be extracted.
#[derive(Debug, Clone, Copy)]
pub struct LitDot {
    /// Where the light falls (drift included), mm.
    pub center_mm: Point,
    /// Standard deviation per axis of that place, mm.
    pub position_sd_mm: f64,
    /// What it brings.
    pub flux: Flux,
}

/// A window's cells in the photograph.
#[derive(Debug, Clone)]
pub struct WindowGrid {
    samples: [usize; 2],
    pitch_mm: f64,
    center_mm: Point,
    /// Camera px of the cells' corners, row by row.
    corners_px: Vec<Point>,
}

/// Cells around the lit point that get the finer quadrature; further out the response is smooth over a cell.
const NEAR_SAMPLES: usize = 3;
/// Cells around the lit point into which its edges reach: their reconstruction is doubted.
const SHARP_SAMPLES: usize = 1;
/// Error of the reconstruction of degree 6, RMS, over its difference from that of degree 4. Simulated dots with sharp
/// edges have 1.9 at 3 px a sample, those that are blurred by most of a pixel 1: this keeps to the safe side.
const DOUBT: f64 = 2.0;
/// Pixels beyond a cell that its weights may reach.
const STENCIL_PX: f64 = 5.0;

impl WindowGrid {
    /// The cells of a window around `center_mm`.
    pub fn new(window: &Window, center_mm: Point, view: &CameraView) -> Self {
        let ([wx, wy], pitch) = (window.samples, window.pitch_mm);
        let corner = |k: usize, n: usize, c: f64| c + (k as f64 - n as f64 / 2.0) * pitch;
        let corners_px = (0..=wy)
            .flat_map(|j| (0..=wx).map(move |i| (i, j)))
            .map(|(i, j)| view.camera_from_slab([corner(i, wx, center_mm[0]), corner(j, wy, center_mm[1])]))
            .collect();
        Self { samples: window.samples, pitch_mm: pitch, center_mm, corners_px }
    }

    /// Corners of cell (i, j): top left, top right, bottom left, bottom right.
    fn cell(&self, i: usize, j: usize) -> [Point; 4] {
        let n = self.samples[0] + 1;
        [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)].map(|(i, j)| self.corners_px[j * n + i])
    }

    /// Whether cell (i, j) is no more than so many samples from the lit point.
    fn is_within(&self, samples: usize, i: usize, j: usize) -> bool {
        i.abs_diff(self.samples[0] / 2).max(j.abs_diff(self.samples[1] / 2)) <= samples
    }

    /// Whether the centre of cell (i, j) lies on a slab of `size_mm`.
    fn on_slab(&self, i: usize, j: usize, size_mm: Point) -> bool {
        [i, j].iter().enumerate().all(|(a, &k)| {
            let v = self.center_mm[a] + (k as f64 - (self.samples[a] / 2) as f64) * self.pitch_mm;
            v >= 0.0 && v <= size_mm[a]
        })
    }
}

/// The pixels that a window needs, cut to the photograph; `None` when it lies outside altogether.
pub fn window_rect(grid: &WindowGrid, size_px: [usize; 2]) -> Option<Rect> {
    let range = |a: usize| {
        let low = grid.corners_px.iter().map(|p| p[a]).fold(f64::MAX, f64::min) - STENCIL_PX;
        let high = grid.corners_px.iter().map(|p| p[a]).fold(f64::MIN, f64::max) + STENCIL_PX;
        let (low, high) = (low.floor().max(0.0), high.ceil().min(size_px[a] as f64 - 1.0));
        (low <= high).then_some((low as usize, (high - low) as usize + 1))
    };
    let ((x, width), (y, height)) = (range(0)?, range(1)?);
    Some(Rect { x, y, width, height })
}

/// What [`extract_row`] found besides the row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct RowFindings {
    /// Samples outside the slab or the photograph.
    pub clipped: usize,
    /// Samples that some saturated pixel spoils.
    pub saturated: usize,
}

/// Responses of a window: R = (mean exitance over each cell) / flux, mm⁻², with variance.
///
/// `light` is the dot's radiance without ambient light over [`window_rect`]; `weights` are one set for all channels, or
/// three where each channel was measured at a place of its own ([`crate::capture::Sampling`]). The variance is that of
/// the pixels, plus that of the reconstruction near the lit point (from what a lower degree would give), plus that of
/// the flux (common to the row), plus the lit point's uncertainty times the slope of R.
///
/// Not detected: light of other dots in the window, blur of the camera beyond its pixels, specular reflection.
pub fn extract_row(
    light: &Radiance,
    grid: &WindowGrid,
    dot: &LitDot,
    sensitivity: &Sensitivity,
    size_mm: Point,
    weights: &mut [CellWeights],
) -> (Row, RowFindings) {
    let [wx, wy] = grid.samples;
    let n = 3 * wx * wy;
    let mut row = Row { response: vec![0.0; n], variance: vec![0.0; n], valid: vec![false; n] };
    let mut findings = RowFindings::default();
    for j in 0..wy {
        for i in 0..wx {
            if !grid.on_slab(i, j, size_mm) {
                findings.clipped += 1;
                continue;
            }
            let (near, sharp) = (grid.is_within(NEAR_SAMPLES, i, j), grid.is_within(SHARP_SAMPLES, i, j));
            weights.iter_mut().for_each(|w| w.set(grid.cell(i, j), near, sharp));
            let Some(cell) = cell_mean(light, weights, sensitivity) else {
                findings.clipped += 1;
                continue;
            };
            findings.saturated += usize::from(cell.valid.contains(&false));
            for c in 0..3 {
                let k = 3 * (j * wx + i) + c;
                if cell.valid[c] {
                    let r = cell.value[c] / dot.flux.value[c];
                    let pixels = (cell.variance[c] + cell.doubt[c]) / dot.flux.value[c].powi(2);
                    row.response[k] = r as f32;
                    row.variance[k] = (pixels + r * r * dot.flux.relative_variance[c]) as f32;
                    row.valid[k] = true;
                }
            }
        }
    }
    add_position_variance(&mut row, grid, dot.position_sd_mm);
    (row, findings)
}

struct CellMean {
    value: [f64; 3],
    variance: [f64; 3],
    /// Variance of the reconstruction.
    doubt: [f64; 3],
    valid: [bool; 3],
}

/// By weights that all channels share, or each channel by its own.
fn cell_mean(light: &Radiance, weights: &[CellWeights], sensitivity: &Sensitivity) -> Option<CellMean> {
    let [red, green, blue] = weights else { return weighted_mean(light, weights.first()?, sensitivity) };
    let mut of = weighted_mean(light, red, sensitivity)?;
    for (c, weights) in [(1, green), (2, blue)] {
        let channel = weighted_mean(light, weights, sensitivity)?;
        (of.value[c], of.variance[c]) = (channel.value[c], channel.variance[c]);
        (of.doubt[c], of.valid[c]) = (channel.doubt[c], channel.valid[c]);
    }
    Some(of)
}

fn weighted_mean(light: &Radiance, weights: &CellWeights, sensitivity: &Sensitivity) -> Option<CellMean> {
    let ([x0, y0], [width, height], w) = weights.get();
    let rect = light.rect;
    let inside = |first: isize, size: usize, from: usize, len: usize| {
        first >= from as isize && first + size as isize <= (from + len) as isize
    };
    if !inside(x0, width, rect.x, rect.width) || !inside(y0, height, rect.y, rect.height) {
        return None;
    }
    let (x0, y0) = (x0 as usize, y0 as usize);
    let mut sum = CellMean { value: [0.0; 3], variance: [0.0; 3], doubt: [0.0; 3], valid: [true; 3] };
    let (mut difference, mut noise) = ([0.0; 3], [0.0; 3]);
    for j in 0..height {
        let k = light.at(x0, y0 + j);
        let row = k..k + 3 * width;
        let pixels = light.value[row.clone()].as_chunks::<3>().0.iter();
        let pixels = pixels.zip(light.variance[row.clone()].as_chunks::<3>().0).zip(light.used[row].as_chunks::<3>().0);
        for (i, ((value, variance), used)) in pixels.enumerate() {
            let w = w[j * width + i];
            // Corners of the stencil that no place of the quadrature reached need not be valid.
            if w == 0.0 {
                continue;
            }
            let inverse = sensitivity.inverse_at(x0 + i, y0 + j);
            let w = w * inverse;
            for c in 0..3 {
                sum.value[c] += f64::from(w * value[c]);
                sum.variance[c] += f64::from(w * w * variance[c]);
                sum.valid[c] &= used[c] > 0;
            }
            if let Some(doubt) = weights.doubt().get(j * width + i) {
                let w = doubt * inverse;
                for c in 0..3 {
                    difference[c] += f64::from(w * value[c]);
                    noise[c] += f64::from(w * w * variance[c]);
                }
            }
        }
    }
    // What noise alone makes of the difference is no sign of a sharp edge.
    sum.doubt = std::array::from_fn(|c| DOUBT * DOUBT * (difference[c] * difference[c] - noise[c]).max(0.0));
    Some(sum)
}

/// Adds sd² |∇R|² to the variance.
fn add_position_variance(row: &mut Row, grid: &WindowGrid, sd_mm: f64) {
    let slopes = slopes(&row.response, |k| row.valid[k], grid.samples, grid.pitch_mm);
    let added = slopes.iter().map(|[x, y]| (sd_mm * sd_mm * (x * x + y * y)) as f32);
    row.variance.iter_mut().zip(added).for_each(|(v, a)| *v += a);
}

#[cfg(test)]
mod tests;
