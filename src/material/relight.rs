//! Relighting a matrix or a material: the exitance of the slab under a light.

use super::{Exitance, ImagePlacement, Light, LitArea, Quadrature, Shape, Source};
use crate::progress::Progress;
use crate::transport::RowBlock;
use crate::{Error, LightWarning, Result};
use std::path::Path;

/// The exitance under several lights at once, each given as the flux into every cell of `quadrature`.
///
/// Entries that were not measured contribute nothing. A matrix is read once, in blocks; for a material see
/// [`acquire_material::relight`].
///
/// # Errors
/// Those of the source.
pub fn relight(
    source: &Source,
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
    progress: &Progress,
) -> Result<Vec<Exitance>> {
    let shape = source.shape();
    let stage = progress.stage("relight", shape.rows());
    match source {
        Source::Matrix(_) => {
            let mut out: Vec<Exitance> = fluxes.iter().map(|_| Exitance::new(quadrature.canvas())).collect();
            for rows in source.blocks() {
                let count = rows.len();
                if rows.clone().any(|row| quadrature.is_lit(row, fluxes)) {
                    splat(&mut out, &source.read(rows)?, shape.window, quadrature, fluxes);
                }
                stage.advance(count);
            }
            Ok(out)
        }
        Source::Material(material, _) => {
            Ok(acquire_material::relight(material, quadrature, fluxes, &|rows| stage.advance(rows))?)
        }
    }
}

/// A light at its place, and what there is to say of it: an image without an extent that is stretched over the lit area.
///
/// # Errors
/// [`Error::Setting`] of `extent_mm` or `tile`, which only images have.
pub fn place_light(light: Light, area: &LitArea, placement: &ImagePlacement) -> Result<(Light, Vec<LightWarning>)> {
    let Light::Image(image) = light else {
        let of = |setting| {
            let (expected, found) =
                ("an image as light beside it".into(), "a built-in light, which has its own".into());
            Err(Error::Setting { setting, expected, found })
        };
        return match placement {
            ImagePlacement { extent_mm: Some(_), .. } => of("extent_mm"),
            ImagePlacement { tile, .. } if *tile != [1, 1] => of("tile"),
            _ => Ok((light, vec![])),
        };
    };
    let stretch = image.stretch(area, placement.tile).filter(|_| placement.extent_mm.is_none());
    let image = image.placed(area, placement)?;
    let told = stretch.map(|s| LightWarning::LightStretched {
        image_ratio: s.image_ratio,
        area_ratio: s.area_ratio,
        off_mm: s.off_mm,
        limit_mm: s.limit_mm,
    });
    Ok((Light::Image(image), told.into_iter().collect()))
}

/// [`LitArea::of`], with the file in its error.
///
/// # Errors
/// [`Error::Field`] when the lit points are too far apart for an image.
pub fn lit_area(source: &Source) -> Result<LitArea> {
    lit_area_of(&source.shape(), source.path())
}

/// The same for the rows of a file.
pub(crate) fn lit_area_of(shape: &Shape<'_>, path: &Path) -> Result<LitArea> {
    LitArea::of(shape).map_err(|error| match error {
        acquire_material::Error::TooSparse { expected, found } => Error::field(path, "lit_mm", expected, found),
        other => other.into(),
    })
}

/// Adds a block of rows to every image; entries that were not measured add nothing.
pub(crate) fn splat(
    images: &mut [Exitance],
    block: &RowBlock,
    window: [usize; 2],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
) {
    splat_entries(images, block, &block.response, window, quadrature, fluxes);
}

/// The same of other numbers of the rows than their responses, \[rows\]\[dy\]\[dx\]\[channel\].
pub(crate) fn splat_entries(
    images: &mut [Exitance],
    block: &RowBlock,
    values: &[f32],
    window: [usize; 2],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
) {
    let rows: Vec<_> = (block.first..block.first + block.rows).map(|row| (row, [1.0; 3])).collect();
    acquire_material::splat(images, &rows, window, quadrature, fluxes, &|k, channel, seen, add| {
        let mut line = vec![0.0; window[0]];
        for dy in seen {
            let first = 3 * window[0] * (window[1] * k + dy);
            let entries = first..first + 3 * window[0];
            let measured = values[entries.clone()].chunks_exact(3).zip(block.valid[entries].chunks_exact(3));
            for (out, (value, valid)) in line.iter_mut().zip(measured) {
                *out = if valid[channel] == 0 { 0.0 } else { f64::from(value[channel]) };
            }
            add(0, dy, &line);
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_that_were_not_measured_add_nothing() {
        let lit_mm = [[0.0, 0.1], [1.0, -0.1], [2.05, 0.05], [3.1, 0.0]];
        let shape = Shape { points: [4, 1], window: [3, 3], pitch_mm: 0.5, lit_pitch_mm: [1.0; 2], lit_mm: &lit_mm };
        let quadrature = Quadrature::of_points(&LitArea::of(&shape).unwrap(), &shape);
        let mut block = RowBlock {
            first: 2,
            rows: 2,
            response: (0..54).map(|s| (s % 7) as f32 - 2.0).collect(),
            variance: Vec::new(),
            valid: (0..54).map(|s| u8::from(s % 5 != 0)).collect(),
        };
        let flux = vec![[1.0, 0.5, 2.0]; 4];
        let lit = |block: &RowBlock| {
            let mut images = vec![Exitance::new(quadrature.canvas())];
            splat(&mut images, block, [3, 3], &quadrature, std::slice::from_ref(&flux));
            images.remove(0)
        };
        let masked = lit(&block);
        (0..54).filter(|s| s % 5 == 0).for_each(|s| block.response[s] = 0.0);
        block.valid.fill(1);
        assert_eq!(masked, lit(&block));
        // The flux that leaves: all weights of a row sum to one.
        let expected: f64 = (0..54).filter(|s| s % 3 == 0).map(|s| f64::from(block.response[s])).sum();
        assert!((masked.planes[0].iter().sum::<f64>() - expected).abs() < 1e-12, "rounding");
    }
}
