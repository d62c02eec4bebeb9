//! What the projector shows in one shot, pixel by pixel.

use super::Plan;
use crate::capture::{Axis, Grid, Pattern};
use crate::geometry::Point;
use crate::{Error, Result};
use std::path::Path;

/// A grey picture, 0 black and 255 white, row by row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ProjectorPicture {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// One byte a pixel.
    pub pixels: Vec<u8>,
}

impl ProjectorPicture {
    /// A picture of one brightness.
    pub fn even(size_px: [usize; 2], brightness: u8) -> Self {
        Self { size_px, pixels: vec![brightness; size_px[0] * size_px[1]] }
    }

    /// The picture of a pattern of `plan` for a projector of `size_px`.
    pub fn of(plan: &Plan, pattern: &Pattern, size_px: [usize; 2]) -> Self {
        match pattern {
            Pattern::Board | Pattern::CalibrationBoard | Pattern::Frame | Pattern::ReferenceWhite => {
                Self::even(size_px, 255)
            }
            Pattern::ReferenceBlack | Pattern::SampleBlack | Pattern::Dark => Self::even(size_px, 0),
            Pattern::GrayCode { axis, bit, inverse, .. } => {
                let mut picture = Self::even(size_px, 0);
                for (k, pixel) in picture.pixels.iter_mut().enumerate() {
                    let n = match axis {
                        Axis::X => k % size_px[0],
                        Axis::Y => k / size_px[0],
                    };
                    let lit = ((n ^ (n >> 1)) >> bit) & 1 == 1;
                    *pixel = if lit != *inverse { 255 } else { 0 };
                }
                picture
            }
            Pattern::Lattice { dots } => {
                let mut picture = Self::even(size_px, 0);
                let lit = dots.iter().map(|&d| plan.grid.dot_projector_px(d));
                let references = plan.reference_dots.iter().flat_map(|r| r.projector_px.iter().copied());
                lit.chain(references).for_each(|at| picture.add_dot(at, &plan.grid));
                picture
            }
        }
    }

    /// An outline to lay the sample into: the slab's rim, the lit points' and a cross in the middle.
    pub fn alignment(outlines: &[[Point; 4]], middle: Point, size_px: [usize; 2]) -> Self {
        let mut picture = Self::even(size_px, 0);
        for corners in outlines {
            (0..4).for_each(|k| picture.add_line(corners[k], corners[(k + 1) % 4]));
        }
        picture.add_line([middle[0] - 10.0, middle[1]], [middle[0] + 10.0, middle[1]]);
        picture.add_line([middle[0], middle[1] - 10.0], [middle[0], middle[1] + 10.0]);
        picture
    }

    fn add_dot(&mut self, at: Point, grid: &Grid) {
        let side = grid.dot_projector_px as isize;
        let first = at.map(|v| (v - (side - 1) as f64 / 2.0).round() as isize);
        for y in first[1]..first[1] + side {
            for x in first[0]..first[0] + side {
                self.set(x, y);
            }
        }
    }

    fn add_line(&mut self, a: Point, b: Point) {
        let steps = (b[0] - a[0]).abs().max((b[1] - a[1]).abs()).min(1e5).ceil().max(1.0);
        for k in 0..=steps as usize {
            let t = k as f64 / steps;
            self.set((a[0] + t * (b[0] - a[0])).round() as isize, (a[1] + t * (b[1] - a[1])).round() as isize);
        }
    }

    fn set(&mut self, x: isize, y: isize) {
        let [width, height] = self.size_px;
        if (0..width as isize).contains(&x) && (0..height as isize).contains(&y) {
            self.pixels[y as usize * width + x as usize] = 255;
        }
    }

    /// Writes an 8-bit grey PNG.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, self.size_px[0] as u32, self.size_px[1] as u32);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header().map_err(Error::internal)?;
        writer.write_image_data(&self.pixels).map_err(Error::internal)?;
        writer.finish().map_err(Error::internal)?;
        std::fs::write(path, bytes).map_err(Error::io("write", path))
    }
}
