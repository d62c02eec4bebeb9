//! Lights: irradiance over the lit area, as an image or as one of the fixed set that `relit_psnr_db` uses.
//!
//! # Conventions
//! - The lit area is the union of the lit cells, `points` × `lit_pitch_mm`; u runs over it along x and v along y, 0 to
//!   1; row 0 of an image is at the top, v = 0.
//! - Irradiance is linear, in any unit per mm²; the exitance that comes out is in the same unit.

use crate::quadrature::{LitArea, LitCell, Quadrature};
use crate::{Error, Point, Result, Shape};

/// Irradiance over the lit area.
#[derive(Debug, Clone, PartialEq)]
pub enum Light {
    /// A round Gaussian spot in the middle, standard deviation 0.15 of the area's sides.
    Spot,
    /// Eight stripes along y, lit and dark in turn, the first lit.
    Stripes,
    /// From 0 at the left to 1 at the right.
    Gradient,
    /// 1 everywhere.
    Uniform,
    /// Unit flux into one lit point (x, y).
    Point([usize; 2]),
    /// An image over the lit area, see [`LightImage::placed`].
    Image(LightImage),
}

/// Linear irradiance, row 0 at the top.
#[derive(Debug, Clone, PartialEq)]
pub struct LightImage {
    /// Columns and rows.
    pub size: [usize; 2],
    /// R, G, B of every pixel.
    pub rgb: Vec<[f32; 3]>,
    /// Copies side by side along x and y, see [`LightImage::placed`].
    pub(crate) copies: [usize; 2],
}

/// The fixed set of illuminations of `relit_psnr_db`.
pub const FIXED_SET: [Light; 4] = [Light::Spot, Light::Stripes, Light::Gradient, Light::Uniform];

impl Light {
    /// Radiant flux that each cell of the lit area receives: the irradiance at its middle (an image: its mean over the
    /// cell) times the cell's area. [`Light::Point`] takes the cells of [`Quadrature::of_points`].
    ///
    /// # Errors
    /// [`Error::Option`] for a point outside the grid, or on cells that are not those of lit points.
    pub fn flux(&self, quadrature: &Quadrature) -> Result<Vec<[f64; 3]>> {
        if let Self::Point([x, y]) = *self {
            let refuse = |expected, found| Err(Error::Option { option: "light", expected, found });
            let found = format!("point:{x},{y}");
            let Some([nx, ny]) = quadrature.of_points else {
                return refuse("irradiance on an area".into(), found);
            };
            if x >= nx || y >= ny {
                return refuse(format!("a point below {nx},{ny}"), found);
            }
            let mut flux = vec![[0.0; 3]; nx * ny];
            flux[x + y * nx] = [1.0; 3];
            return Ok(flux);
        }
        let flux = |cell: &LitCell| {
            let [u, v] = [0, 1].map(|a| (cell.from[a] + cell.to[a]) / 2.0);
            let gray = |value: f64| [value * cell.area_mm2; 3];
            match self {
                Self::Spot => gray((-((u - 0.5).powi(2) + (v - 0.5).powi(2)) / (2.0 * 0.15 * 0.15)).exp()),
                Self::Stripes => gray(if (u * 4.0).fract() < 0.5 { 1.0 } else { 0.0 }),
                Self::Gradient => gray(u),
                Self::Uniform | Self::Point(_) => gray(1.0),
                Self::Image(image) => image.mean(cell.from, cell.to).map(|e| e * cell.area_mm2),
            }
        };
        Ok(quadrature.cells.iter().map(flux).collect())
    }

    /// The cells that this light falls on: the lit area, or the lit points themselves for [`Light::Point`].
    pub fn quadrature(&self, area: &LitArea, shape: &Shape<'_>) -> Quadrature {
        match self {
            Self::Point(_) => Quadrature::of_points(area, shape),
            _ => Quadrature::new(area, shape),
        }
    }
}

impl LightImage {
    /// An image of columns × rows, R, G and B of every pixel, once over the lit area.
    pub fn new(size: [usize; 2], rgb: Vec<[f32; 3]>) -> Self {
        Self { size, rgb, copies: [1, 1] }
    }

    /// Mean over a part of the image, pixels counted by the share that lies in it; `from` and `to` are shares of its
    /// sides.
    fn mean(&self, from: Point, to: Point) -> [f64; 3] {
        let overlaps = |a: usize| {
            let all = (self.size[a] * self.copies[a]) as f64;
            let [low, high] = [from[a], to[a]].map(|v| (v * all).clamp(0.0, all));
            let side = (high - low).max(1e-300);
            self.overlaps(a, low, high).map(|(p, part)| (p, part / side)).collect::<Vec<_>>()
        };
        let (columns, lines) = (overlaps(0), overlaps(1));
        let mut sum = [0.0; 3];
        for &(y, wy) in &lines {
            for &(x, wx) in &columns {
                for (s, v) in sum.iter_mut().zip(self.rgb[x + y * self.size[0]]) {
                    *s += wx * wy * f64::from(v);
                }
            }
        }
        sum
    }
}

/// Linear value of an sRGB-encoded one, both 0 to 1 (`IEC61966`).
pub fn linear_from_srgb(v: f32) -> f32 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// sRGB encoding of a linear value, clamped to 0 … 1.
pub fn srgb_from_linear(v: f32) -> f32 {
    let v = v.clamp(0.0, 1.0);
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The cells of regular lit points with these pitches.
    fn cells(points: [usize; 2], pitch_mm: Point) -> Quadrature {
        let place = |k: usize| [(k % points[0]) as f64 * pitch_mm[0], (k / points[0]) as f64 * pitch_mm[1]];
        let lit_mm: Vec<Point> = (0..points[0] * points[1]).map(place).collect();
        let shape = Shape { points, window: [1, 1], pitch_mm: 1.0, lit_pitch_mm: pitch_mm, lit_mm: &lit_mm };
        Quadrature::of_points(&LitArea::of(&shape).unwrap(), &shape)
    }

    fn shape(points: [usize; 2]) -> Quadrature {
        cells(points, [0.5, 2.0])
    }

    #[test]
    fn an_image_on_the_lit_area_keeps_its_total_flux_whatever_the_outgoing_pitch() {
        let image = LightImage::new([7, 5], (0..35).map(|k| [k as f32, (k * k % 11) as f32, 1.0]).collect());
        let lit_mm: Vec<Point> = (0..12).map(|k| [(k % 4) as f64 * 0.5, (k / 4) as f64 * 2.0]).collect();
        for pitch_mm in [0.2, 0.5, 0.7, 3.0] {
            let shape = Shape { points: [4, 3], window: [3, 3], pitch_mm, lit_pitch_mm: [0.5, 2.0], lit_mm: &lit_mm };
            let quadrature = Quadrature::new(&LitArea::of(&shape).unwrap(), &shape);
            let flux = Light::Image(image.clone()).flux(&quadrature).unwrap();
            for c in 0..3 {
                let mean = image.rgb.iter().map(|p| f64::from(p[c])).sum::<f64>() / 35.0;
                let total: f64 = flux.iter().map(|f| f[c]).sum();
                // The area is 2 × 6 mm; rounding of f64.
                assert!((total - 12.0 * mean).abs() < 1e-9, "pitch {pitch_mm}: {total} {mean}");
            }
        }
    }

    #[test]
    fn an_image_keeps_its_total_flux_on_any_grid() {
        let image = LightImage::new([7, 5], (0..35).map(|k| [k as f32, (k * k % 11) as f32, 1.0]).collect());
        let mean: Vec<f64> = (0..3).map(|c| image.rgb.iter().map(|p| f64::from(p[c])).sum::<f64>() / 35.0).collect();
        for points in [[7, 5], [3, 2], [20, 11], [1, 1]] {
            let flux = Light::Image(image.clone()).flux(&shape(points)).unwrap();
            for c in 0..3 {
                let total: f64 = flux.iter().map(|f| f[c]).sum();
                // The cell is 1 mm²: mean irradiance times the number of cells; rounding of f64.
                assert!((total - mean[c] * (points[0] * points[1]) as f64).abs() < 1e-10);
            }
        }
    }

    #[test]
    fn a_point_gets_unit_flux_and_must_be_on_the_grid() {
        let flux = Light::Point([2, 1]).flux(&shape([4, 3])).unwrap();
        assert_eq!(flux.iter().position(|f| f[0] > 0.0), Some(6));
        assert_eq!(flux[6], [1.0; 3]);
        assert!(Light::Point([4, 1]).flux(&shape([4, 3])).is_err());
    }

    #[test]
    fn srgb_round_trips() {
        for k in 0..=255 {
            let v = k as f32 / 255.0;
            assert!((srgb_from_linear(linear_from_srgb(v)) - v).abs() < 1e-5, "f32 powers: {v}");
        }
    }

    /// 5 × 3 cells of 0.5 × 2 mm: as many columns as lines of no light.
    fn flux(light: &Light) -> Vec<[f64; 3]> {
        light.flux(&shape([5, 3])).unwrap()
    }

    #[test]
    fn built_in_lights_are_their_formulas_at_the_middle_of_each_cell() {
        let (spot, stripes) = (flux(&Light::Spot), flux(&Light::Stripes));
        let (gradient, uniform) = (flux(&Light::Gradient), flux(&Light::Uniform));
        for k in 0..15 {
            let (u, v): (f64, f64) = (0.1 + 0.2 * (k % 5) as f64, [1.0 / 6.0, 0.5, 5.0 / 6.0][k / 5]);
            // A cell of 1 mm².
            let expected = (-((u - 0.5).powi(2) + (v - 0.5).powi(2)) / 0.045).exp();
            assert!(spot[k].iter().all(|f| (f - expected).abs() < 1e-14), "rounding: {:?} {expected}", spot[k]);
            // Eighths of the side in turn: u = .1 lies in the first, .3, .5, .7 and .9 in the third, fifth, sixth and
            // eighth.
            assert_eq!(stripes[k], [[1.0, 1.0, 1.0, 0.0, 0.0][k % 5]; 3]);
            assert!(gradient[k].iter().all(|f| (f - u).abs() < 1e-15), "rounding: {:?}", gradient[k]);
            assert_eq!(uniform[k], [1.0; 3]);
        }
        let wide = cells([5, 3], [3.0, 0.5]);
        assert_eq!(Light::Uniform.flux(&wide).unwrap()[4], [1.5; 3], "flux is irradiance times the cell");
        assert_eq!(Light::Point([4, 1]).flux(&wide).unwrap()[9], [1.0; 3], "but a point has one");
        let picture = LightImage::new([2, 1], vec![[2.0, 4.0, 6.0], [8.0, 10.0, 12.0]]);
        let lit = Light::Image(picture).flux(&cells([2, 1], [3.0, 0.5])).unwrap();
        assert_eq!(lit, [[3.0, 6.0, 9.0], [12.0, 15.0, 18.0]], "a picture as the others");
    }

    #[test]
    fn the_mean_of_a_cell_counts_pixels_by_the_part_in_it() {
        let image = LightImage::new(
            [4, 2],
            (0..8).map(|k| [k as f32, (k * k) as f32, if k == 5 { 16.0 } else { 0.0 }]).collect(),
        );
        let found = flux(&Light::Image(image.clone()));
        for cell in 0..15 {
            // A raster of 20 × 6 is finer than both grids: 4 × 2 of it in a cell, 5 × 3 in a pixel.
            let mut expected = [0.0; 3];
            for s in 0..8 {
                let (x, y) = (cell % 5 * 4 + s % 4, cell / 5 * 2 + s / 4);
                (0..3).for_each(|c| expected[c] += f64::from(image.rgb[x / 5 + y / 3 * 4][c]) / 8.0);
            }
            let near = (0..3).all(|c| (found[cell][c] - expected[c]).abs() < 1e-12);
            assert!(near, "rounding, cell {cell}: {:?} {expected:?}", found[cell]);
        }
    }

    #[test]
    fn srgb_has_the_values_of_the_standard() {
        // Worked out from IEC 61966-2-1: the straight part ends at 0.04045, the power is 2.4.
        for (encoded, linear) in
            [(0.5, 0.214_041_14), (0.02, 0.001_547_988), (0.735_357, 0.5), (0.461_356_13, 0.18), (1.0, 1.0), (0.0, 0.0)]
        {
            assert!((linear_from_srgb(encoded) - linear).abs() < 1e-6, "f32 powers: {encoded}");
            assert!((srgb_from_linear(linear) - encoded).abs() < 1e-6, "f32 powers: {linear}");
        }
        assert_eq!(srgb_from_linear(-3.0), 0.0);
        assert_eq!(srgb_from_linear(7.0), srgb_from_linear(1.0), "clamped");
    }
}
