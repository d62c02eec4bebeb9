//! Relighting a matrix or a material: the exitance of the slab under a light.

use super::{Canvas, Exitance, Shape, Source};
use crate::progress::Progress;
use crate::transport::RowBlock;
use crate::{Error, Result};
use std::path::Path;

/// The exitance under several lights at once, each given as the flux into every lit point.
///
/// Entries that were not measured contribute nothing. A matrix is read once, in blocks; for a material see
/// [`acquire_material::relight`].
///
/// # Errors
/// Those of the source; [`Error::Field`] when the lit points are too far apart for an image.
pub fn relight(source: &Source, fluxes: &[Vec<[f64; 3]>], progress: &Progress) -> Result<Vec<Exitance>> {
    let shape = source.shape();
    let canvas = canvas(&shape, source.path())?;
    let stage = progress.stage("relight", shape.rows());
    match source {
        Source::Matrix(_) => {
            let mut out: Vec<Exitance> = fluxes.iter().map(|_| Exitance::new(canvas)).collect();
            let lit = |i: usize| fluxes.iter().any(|f| f.get(i).is_some_and(|f| *f != [0.0; 3]));
            for rows in source.blocks() {
                let count = rows.len();
                if rows.clone().any(lit) {
                    splat(&mut out, &source.read(rows)?, &shape, fluxes);
                }
                stage.advance(count);
            }
            Ok(out)
        }
        Source::Material(material, _) => Ok(acquire_material::relight(material, fluxes, &|rows| stage.advance(rows))?),
    }
}

/// [`Canvas::covering`], with the file in its error.
pub(crate) fn canvas(shape: &Shape<'_>, path: &Path) -> Result<Canvas> {
    Canvas::covering(shape).map_err(|error| match error {
        acquire_material::Error::TooSparse { expected, found } => Error::field(path, "lit_mm", expected, found),
        other => other.into(),
    })
}

/// Adds a block of rows to every image; entries that were not measured add nothing.
pub(crate) fn splat(images: &mut [Exitance], block: &RowBlock, shape: &Shape<'_>, fluxes: &[Vec<[f64; 3]>]) {
    let indices: Vec<usize> = (block.first..block.first + block.rows).collect();
    let width = shape.window[0];
    acquire_material::splat(images, &indices, shape, fluxes, &|k, channel, dy, line| {
        let row = block.view(k);
        let entries = 3 * width * dy..3 * width * (dy + 1);
        let measured = row.response[entries.clone()].chunks_exact(3).zip(row.valid[entries].chunks_exact(3));
        for (out, (value, valid)) in line.iter_mut().zip(measured) {
            *out = if valid[channel] == 0 { 0.0 } else { f64::from(value[channel]) };
        }
    });
}

#[cfg(test)]
mod tests {
    use super::super::naive::tent;
    use super::*;

    /// Two images of 9 × 6 samples, rows 2 and 3 of four with windows of 3 × 2, on the canvas and between its samples.
    #[test]
    fn measured_entries_are_spread_over_the_four_nearest_samples_and_others_are_not() {
        let canvas = Canvas { origin_mm: [10.0, -4.0], size: [9, 6], pitch_mm: 0.5 };
        // Windows of 3 × 3 around them; the third lies on samples of the canvas, the last between them.
        let lit_mm = [[0.0; 2], [0.0; 2], [11.0, -2.5], [12.625, -2.875]];
        let shape = Shape { points: [4, 1], window: [3, 3], pitch_mm: 0.5, lit_pitch_mm: [1.0; 2], lit_mm: &lit_mm };
        let value = |k: usize, s: usize| ((7 * s + 5 * k) % 23) as f32 - 4.0;
        let valid = |k: usize, s: usize| u8::from(!(s + k).is_multiple_of(5));
        let block = RowBlock {
            first: 2,
            rows: 2,
            response: (0..54).map(|s| value(s / 27, s % 27)).collect(),
            variance: Vec::new(),
            valid: (0..54).map(|s| valid(s / 27, s % 27)).collect(),
        };
        let flux = |light: usize, i: usize, c: usize| (1 + light) as f64 + 0.25 * i as f64 - 0.5 * c as f64;
        let fluxes: Vec<Vec<[f64; 3]>> =
            (0..2).map(|l| (0..4).map(|i| [0, 1, 2].map(|c| flux(l, i, c))).collect()).collect();
        let mut images = vec![Exitance::new(canvas), Exitance::new(canvas)];
        splat(&mut images, &block, &shape, &fluxes);
        for (light, image) in images.iter().enumerate() {
            for c in 0..3 {
                for (at, found) in image.planes[c].iter().enumerate() {
                    let mut e = 0.0;
                    for k in 0..2 {
                        for s in (0..9).filter(|s| valid(k, 3 * s + c) != 0) {
                            let offset = [(s % 3) as f64 - 1.0, (s / 3) as f64 - 1.0];
                            let place = |a: usize| (lit_mm[2 + k][a] - canvas.origin_mm[a]) / 0.5 + offset[a];
                            let near = tent(place(0), (at % 9) as f64) * tent(place(1), (at / 9) as f64);
                            e += flux(light, 2 + k, c) * near * f64::from(value(k, 3 * s + c));
                        }
                    }
                    assert!((found - e).abs() < 1e-12, "f64, light {light} channel {c} sample {at}: {found} {e}");
                }
            }
        }
    }
}
