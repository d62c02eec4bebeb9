//! Relighting: the exitance of the slab under a light, rows added where they leave the slab.

use super::light::srgb_from_linear;
use super::source::{Shape, Source};
use crate::geometry::Point;
use crate::progress::Progress;
use crate::transport::RowBlock;
use crate::{Error, Result};
use rayon::prelude::*;
use std::path::Path;

/// The largest side of a canvas, samples; beyond it the lit points cannot be right.
const LARGEST: usize = 1 << 15;

/// A canvas may have so many samples for each sample of a window …
const GAPS: f64 = 64.0;
/// … and this many in any case.
const SMALL: f64 = (1 << 20) as f64;

/// A regular grid of outgoing samples that covers every window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Canvas {
    /// Centre of sample (0, 0), mm.
    pub origin_mm: Point,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Side of a sample, mm.
    pub pitch_mm: f64,
}

/// Radiant exitance, row 0 at the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Exitance {
    /// Where its samples are.
    pub canvas: Canvas,
    /// R, G and B planes, `size` each, in the light's unit of irradiance.
    pub planes: [Vec<f64>; 3],
}

impl Canvas {
    /// The smallest canvas on which no window, spread over the nearest samples, is cut.
    ///
    /// # Errors
    /// [`Error::Field`] when the lit points are too far apart for their pitch.
    pub fn covering(shape: &Shape<'_>, path: &Path) -> Result<Self> {
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        for point in shape.lit_mm {
            for a in 0..2 {
                (low[a], high[a]) = (low[a].min(point[a]), high[a].max(point[a]));
            }
        }
        let half = |a: usize| (shape.window[a] / 2) as f64 * shape.pitch_mm;
        let sides: [f64; 2] =
            std::array::from_fn(|a| ((high[a] - low[a]) / shape.pitch_mm).ceil() + shape.window[a] as f64 + 1.0);
        if !sides.iter().all(|s| (1.0..=LARGEST as f64).contains(s)) {
            let expected = format!("lit points within {LARGEST} samples of each other");
            return Err(Error::field(path, "lit_mm", expected, format!("{:.0} × {:.0}", sides[0], sides[1])));
        }
        // Memory for gaps between far-off windows is not to exceed by much what the windows themselves hold.
        let held = (shape.rows() * shape.window[0] * shape.window[1]) as f64;
        if sides[0] * sides[1] > (GAPS * held).max(SMALL) {
            let expected = "lit points whose windows cover a good part of the slab".to_owned();
            let found = format!("{} windows on {:.0} × {:.0} samples", shape.rows(), sides[0], sides[1]);
            return Err(Error::field(path, "lit_mm", expected, found));
        }
        Ok(Self {
            origin_mm: std::array::from_fn(|a| low[a] - half(a)),
            size: sides.map(|s| s as usize),
            pitch_mm: shape.pitch_mm,
        })
    }
}

impl Exitance {
    /// Black.
    pub fn new(canvas: Canvas) -> Self {
        Self { canvas, planes: std::array::from_fn(|_| vec![0.0; canvas.size[0] * canvas.size[1]]) }
    }

    /// The exitance that maps to white in [`Self::tone_mapped`]: its 99.5th percentile; 1 when that is not positive.
    pub fn white(&self) -> f64 {
        let mut all: Vec<f64> = self.planes.concat();
        let at = all.len() * 995 / 1000;
        if at >= all.len() {
            return 1.0;
        }
        let (_, white, _) = all.select_nth_unstable_by(at, f64::total_cmp);
        if *white > 0.0 { *white } else { 1.0 }
    }

    /// 8-bit sRGB, interleaved, with `white` at 255.
    pub fn tone_mapped(&self, white: f64) -> Vec<u8> {
        let samples = self.planes[0].len();
        (0..samples * 3)
            .map(|k| (255.0 * srgb_from_linear((self.planes[k % 3][k / 3] / white) as f32)).round() as u8)
            .collect()
    }
}

/// The exitance under several lights at once, each given as the flux into every lit point.
///
/// Entries that were not measured contribute nothing. Reads the source once, in blocks.
///
/// # Errors
/// Those of the source; see [`Canvas::covering`].
pub fn relight(source: &Source, fluxes: &[Vec<[f64; 3]>], progress: &Progress) -> Result<Vec<Exitance>> {
    let shape = source.shape();
    let canvas = Canvas::covering(&shape, source.path())?;
    let mut out: Vec<Exitance> = fluxes.iter().map(|_| Exitance::new(canvas)).collect();
    let stage = progress.stage("relight", shape.rows());
    for rows in source.blocks() {
        let block = source.read(rows)?;
        splat(&mut out, &block, &shape, fluxes);
        stage.advance(block.rows);
    }
    Ok(out)
}

/// Adds a block of rows to every image. Each plane is filled by one thread, in the order of rows: the sums do not
/// depend on the number of threads.
pub(crate) fn splat(images: &mut [Exitance], block: &RowBlock, shape: &Shape<'_>, fluxes: &[Vec<[f64; 3]>]) {
    let planes: Vec<(usize, usize, Canvas, &mut Vec<f64>)> = images
        .iter_mut()
        .enumerate()
        .flat_map(|(l, image)| {
            let canvas = image.canvas;
            image.planes.iter_mut().enumerate().map(move |(c, plane)| (l, c, canvas, plane))
        })
        .collect();
    planes.into_par_iter().for_each(|(l, c, canvas, plane)| {
        for k in 0..block.rows {
            let (Some(point), Some(flux)) = (shape.lit_mm.get(block.first + k), fluxes[l].get(block.first + k)) else {
                continue;
            };
            if flux[c] != 0.0 {
                add_row(plane, &canvas, block, k, c, flux[c], shape.window, *point);
            }
        }
    });
}

/// Spreads each sample of a row over the four nearest samples of the canvas by bilinear weights, which sum to one: the
/// flux that leaves is conserved.
#[expect(clippy::too_many_arguments, reason = "the inner loop of splat, split off for its length")]
fn add_row(
    plane: &mut [f64],
    canvas: &Canvas,
    block: &RowBlock,
    k: usize,
    channel: usize,
    flux: f64,
    window: [usize; 2],
    point: Point,
) {
    let corner: [f64; 2] =
        std::array::from_fn(|a| ((point[a] - canvas.origin_mm[a]) / canvas.pitch_mm - (window[a] / 2) as f64).max(0.0));
    let base = corner.map(|c| c.floor());
    let [fx, fy] = [corner[0] - base[0], corner[1] - base[1]];
    let [x0, y0] = base.map(|b| b as usize);
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let row = block.view(k);
    for dy in 0..window[1] {
        for dx in 0..window[0] {
            let s = 3 * (dx + dy * window[0]) + channel;
            if row.valid[s] == 0 {
                continue;
            }
            let value = flux * f64::from(row.response[s]);
            let at = x0 + dx + (y0 + dy) * canvas.size[0];
            for (offset, weight) in [0, 1, canvas.size[0], canvas.size[0] + 1].into_iter().zip(weights) {
                if let Some(sample) = plane.get_mut(at + offset).filter(|_| weight > 0.0) {
                    *sample += weight * value;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::file::tests::example;
    use super::super::{Light, Source};
    use super::*;

    #[test]
    fn the_flux_that_leaves_is_that_of_the_rows_wherever_they_lie() {
        let mut material = example();
        material.lit_mm.iter_mut().enumerate().for_each(|(k, p)| p[0] += 0.013 * k as f64);
        let rows: Vec<Vec<f32>> = (0..6).map(|i| material.evaluate_row(i)).collect();
        let source = Source::Material(Box::new(material), "m".into());
        let flux = Light::Gradient.flux(&source.shape()).unwrap();
        let out = relight(&source, std::slice::from_ref(&flux), &Progress::silent()).unwrap();
        for c in 0..3 {
            let expected: f64 = rows
                .iter()
                .zip(&flux)
                .map(|(row, f)| f[c] * row.iter().skip(c).step_by(3).map(|&v| f64::from(v)).sum::<f64>())
                .sum();
            let total: f64 = out[0].planes[c].iter().sum();
            assert!((total - expected).abs() < 1e-10 * expected.abs().max(1.0), "rounding of f64 sums");
        }
    }

    #[test]
    fn a_canvas_that_is_nearly_all_gaps_is_refused() {
        let mut material = example();
        material.lit_mm[5] = [10_000.0, 10_000.0];
        let source = Source::Material(Box::new(material), "m".into());
        let refused = Canvas::covering(&source.shape(), source.path());
        assert!(matches!(refused, Err(Error::Field { field, .. }) if field == "lit_mm"));
    }

    #[test]
    fn an_image_that_overflows_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let material = example();
        let source = Source::Material(Box::new(material), "m".into());
        let mut exitance = Exitance::new(Canvas::covering(&source.shape(), source.path()).unwrap());
        exitance.planes[1][3] = 1e39;
        let path = folder.path().join("e.exr");
        let refused = crate::material::write_exitance(&exitance, &path);
        assert!(matches!(refused, Err(Error::NotFinite { at, .. }) if at.contains("sample 3")));
        assert!(!path.exists());
    }

    #[test]
    fn one_point_shows_its_row() {
        let material = example();
        let row = material.evaluate_row(4);
        let source = Source::Material(Box::new(material), "m".into());
        let flux = Light::Point([1, 1]).flux(&source.shape()).unwrap();
        let out = &relight(&source, &[flux], &Progress::silent()).unwrap()[0];
        // Point (1, 1) is 2 samples right of and 3 below the first.
        for (k, rgb) in row.chunks_exact(3).enumerate() {
            let at = 2 + k % 5 + (3 + k / 5) * out.canvas.size[0];
            for c in 0..3 {
                assert!((out.planes[c][at] - f64::from(rgb[c])).abs() < 1e-9, "positions are exact to rounding");
            }
        }
    }
}
