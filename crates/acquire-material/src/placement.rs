//! Images of light at their place: over the lit area or in millimetres of the slab, once or repeated.

use crate::light::LightImage;
use crate::parallel::*;
use crate::quadrature::LitArea;
use crate::{Error, Point, Result};

/// Pixels of a resampled image in an outgoing sample: what lies beside an edge of the image is told apart to a fourth
/// of a sample.
const PIXELS: f64 = 4.0;
/// The most pixels of a resampled image along an axis.
const MOST_PIXELS: f64 = 16384.0;
/// The most copies along an axis: as many as fit a [`MOST_PIXELS`] wide image at four pixels a copy.
const MOST_COPIES: f64 = 4096.0;

/// Where an image lies on the slab.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImagePlacement {
    /// From and to along the slab's x and y, mm, dark beyond. `None`: the lit area, along the sides of its lattice.
    pub extent_mm: Option<[[f64; 2]; 2]>,
    /// Copies of the image along x and y that fill this extent side by side.
    pub tile: [usize; 2],
}

impl Default for ImagePlacement {
    fn default() -> Self {
        Self { extent_mm: None, tile: [1, 1] }
    }
}

impl ImagePlacement {
    /// Width and height of the extent, or of the lit area where no extent is given, mm.
    ///
    /// # Errors
    /// [`Error::Option`] for an extent that is not finite or has no area, and for copies that are none or narrower than
    /// an outgoing sample, which would not be resolved.
    fn sides_mm(&self, area: &LitArea) -> Result<Point> {
        let sides = self.extent_mm.map_or_else(|| area.sides_mm(), |extent| extent.map(|[from, to]| to - from));
        if !sides.iter().all(|s| s.is_finite() && *s > 0.0) {
            // Differences of places have digits that nobody gave.
            let [x, y] = sides.map(|s| (s * 1e9).round() / 1e9);
            let (expected, found) = ("finite sides above 0 mm".into(), format!("{x} × {y} mm"));
            return Err(Error::Option { option: "extent_mm", expected, found });
        }
        let pitch = area.canvas.pitch_mm;
        // Ends of an extent are rounded.
        let most = sides.map(|s| (s / pitch * (1.0 + 1e-9)).floor().clamp(1.0, MOST_COPIES) as usize);
        if (0..2).any(|a| !(1..=most[a]).contains(&self.tile[a])) {
            let expected = format!(
                "1×1 to {}×{} copies, each as wide as an outgoing sample ({pitch} mm) or wider",
                most[0], most[1]
            );
            let found = format!("{}×{}", self.tile[0], self.tile[1]);
            return Err(Error::Option { option: "tile", expected, found });
        }
        Ok(sides)
    }
}

impl LightImage {
    /// The image at its place, as one over the lit area. Over an extent it is resampled there: means over pixels of a
    /// fourth of an outgoing sample. On a turned lattice such a pixel's sides are taken to be along the slab's axes;
    /// its middle is exact. All sampling is by means over areas: one that two copies share has its part of both.
    ///
    /// # Errors
    /// [`Error::Option`] of `extent_mm` or `tile`.
    pub fn placed(mut self, area: &LitArea, placement: &ImagePlacement) -> Result<Self> {
        let sides = placement.sides_mm(area)?;
        self.copies = placement.tile;
        let Some(extent) = placement.extent_mm else { return Ok(self) };
        let lit = area.sides_mm();
        let size = lit.map(|side| (PIXELS * side / area.canvas.pitch_mm).ceil().clamp(1.0, MOST_PIXELS) as usize);
        let step = [0, 1].map(|a| lit[a] / size[a] as f64);
        // Pixels of the image that lie in one around `middle`, and the share of it that each covers.
        let overlap = |a: usize, middle: f64| {
            let pixel = sides[a] / (self.size[a] * self.copies[a]) as f64;
            let [from, to] = [-0.5, 0.5].map(|end| (middle + end * step[a] - extent[a][0]) / pixel);
            self.overlaps(a, from, to).map(move |(p, part)| (p, (part * pixel / step[a]) as f32))
        };
        let pixel = |k: usize| {
            let share = |a: usize, k: usize| (k as f64 + 0.5) / size[a] as f64;
            let middle = area.place([share(0, k % size[0]), share(1, k / size[0])]);
            let mut sum = [0.0_f32; 3];
            for (line, down) in overlap(1, middle[1]) {
                for (column, across) in overlap(0, middle[0]) {
                    let rgb = self.rgb[column + line * self.size[0]];
                    (0..3).for_each(|c| sum[c] += down * across * rgb[c]);
                }
            }
            sum
        };
        let rgb = (0..size[0] * size[1]).into_par_iter().map(pixel).collect();
        Ok(Self::new(size, rgb))
    }

    /// How far from the aspect ratio of the lit area the image is when it fills that without an extent, in `tile`
    /// copies; `None` within rounding: less than an outgoing sample at the rim, or half a pixel of the image.
    pub fn stretch(&self, area: &LitArea, tile: [usize; 2]) -> Option<Stretch> {
        let sides = area.sides_mm();
        let pixels = [0, 1].map(|a| (self.size[a] * tile[a]) as f64);
        let pixel = [0, 1].map(|a| sides[a] / pixels[a]);
        // With square pixels as wide as they are along one side, the other side's ends would lie elsewhere.
        let off = |a: usize| (pixels[1 - a] * pixel[a] - sides[1 - a]).abs() / 2.0;
        let found = Stretch {
            image_ratio: pixels[0] / pixels[1],
            area_ratio: sides[0] / sides[1],
            off_mm: off(0).min(off(1)),
            limit_mm: area.canvas.pitch_mm.max(pixel[0].max(pixel[1]) / 2.0),
        };
        (found.off_mm > found.limit_mm).then_some(found)
    }

    /// Pixels along axis `a` that lie between two places, in pixels from the first copy's beginning, and the part of
    /// each that does.
    pub(crate) fn overlaps(&self, a: usize, from: f64, to: f64) -> impl Iterator<Item = (usize, f64)> + use<> {
        let n = self.size[a];
        let all = n * self.copies[a];
        let (from, to) = (from.max(0.0), to.min(all as f64));
        let pixels = from.floor() as usize..(to.ceil().max(0.0) as usize).min(all);
        pixels.map(move |p| (p % n, (to.min(p as f64 + 1.0) - from.max(p as f64)).max(0.0)))
    }
}

/// An image that is stretched, see [`LightImage::stretch`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stretch {
    /// Width over height of the image, all its copies together.
    pub image_ratio: f64,
    /// Width over height of the lit area.
    pub area_ratio: f64,
    /// How far the rim of the image lies from where square pixels would put it, mm.
    pub off_mm: f64,
    /// From where on that is more than rounding, mm.
    pub limit_mm: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Light, Quadrature, Shape};

    /// 8 × 4 points half a millimetre apart from (10, 20) mm on: a lit area of 4 × 2 mm from (9.75, 19.75) on.
    fn points() -> Vec<Point> {
        (0..32).map(|k| [10.0 + 0.5 * (k % 8) as f64, 20.0 + 0.5 * (k / 8) as f64]).collect()
    }

    fn shape(lit_mm: &[Point]) -> Shape<'_> {
        Shape { points: [8, 4], window: [5, 3], pitch_mm: 0.5, lit_pitch_mm: [0.5; 2], lit_mm }
    }

    /// Irradiance of each of the 8 × 4 cells, which are the lit points' own.
    fn cells(image: LightImage, placement: ImagePlacement) -> Vec<[f64; 3]> {
        let lit = points();
        let area = LitArea::of(&shape(&lit)).unwrap();
        let light = Light::Image(image.placed(&area, &placement).unwrap());
        let flux = light.flux(&Quadrature::of_points(&area, &shape(&lit))).unwrap();
        flux.iter().map(|f| f.map(|f| f / 0.25)).collect()
    }

    fn image() -> LightImage {
        LightImage::new(
            [4, 2],
            (0..8).map(|k| [k as f32 + 1.0, 0.5 * k as f32, if k == 5 { 3.0 } else { 0.0 }]).collect(),
        )
    }

    fn near(found: &[[f64; 3]], expected: impl Fn(usize, usize) -> [f64; 3]) {
        for (k, found) in found.iter().enumerate() {
            let expected = expected(k % 8, k / 8);
            let off = (0..3).map(|c| (found[c] - expected[c]).abs()).fold(0.0, f64::max);
            assert!(off < 1e-5, "sums of f32, cell {k}: {found:?} {expected:?}");
        }
    }

    fn pixel(x: usize, y: usize) -> [f64; 3] {
        image().rgb[x % 4 + 4 * (y % 2)].map(f64::from)
    }

    #[test]
    fn an_image_of_known_size_lies_there_and_all_else_is_dark() {
        // Pixels of one cell each over the middle 2 × 1 mm: columns 2 to 5, lines 1 and 2.
        let lit = points();
        let area = LitArea::of(&shape(&lit)).unwrap();
        let extent = area.around_middle([2.0, 1.0]);
        assert!((extent[0][0] - 10.75).abs() < 1e-12 && (extent[1][1] - 21.25).abs() < 1e-12, "rounding: {extent:?}");
        let found = cells(image(), ImagePlacement { extent_mm: Some(extent), tile: [1, 1] });
        let inside = |x: usize, y: usize| (2..6).contains(&x) && (1..3).contains(&y);
        near(&found, |x, y| if inside(x, y) { pixel(x - 2, y - 1) } else { [0.0; 3] });
    }

    #[test]
    fn copies_fill_the_lit_area_or_an_extent_side_by_side() {
        // 2 × 2 copies of 4 × 2 pixels on 8 × 4 cells: a pixel a cell, the same over the lit area and over its extent.
        for extent_mm in [None, Some([[9.75, 13.75], [19.75, 21.75]])] {
            near(&cells(image(), ImagePlacement { extent_mm, tile: [2, 2] }), pixel);
        }
        // Twice as large, cut by the rim of the lit area: half of the copies.
        let extent_mm = Some([[9.75, 17.75], [19.75, 23.75]]);
        near(&cells(image(), ImagePlacement { extent_mm, tile: [4, 4] }), pixel);
    }

    #[test]
    fn a_cell_that_two_copies_share_has_its_part_of_both() {
        // Half a cell aside: the first column is half dark, all others halves of two pixels, at a seam of both copies.
        let extent_mm = Some([[10.0, 14.0], [19.75, 21.75]]);
        let found = cells(image(), ImagePlacement { extent_mm, tile: [2, 2] });
        near(&found, |x, y| {
            let left = if x == 0 { [0.0; 3] } else { pixel(x - 1, y) };
            [0, 1, 2].map(|c| (left[c] + pixel(x, y)[c]) / 2.0)
        });
    }

    #[test]
    fn what_cannot_be_placed_is_named_by_its_field() {
        let lit = points();
        let area = LitArea::of(&shape(&lit)).unwrap();
        let option = |extent_mm, tile| match image().placed(&area, &ImagePlacement { extent_mm, tile }) {
            Err(Error::Option { option, .. }) => Some(option),
            other => other.map(|_| None).unwrap(),
        };
        for wrong in [[[0.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [2.0, 1.0]], [[0.0, f64::NAN], [0.0, 1.0]]] {
            assert_eq!(option(Some(wrong), [1, 1]), Some("extent_mm"));
        }
        // The lit area has 8 × 4 samples; an extent of 1 mm has two.
        for (extent_mm, tile, refused) in [
            (None, [8, 4], false),
            (None, [9, 4], true),
            (None, [1, 0], true),
            (Some([[0.0, 1.0], [0.0, 1.0]]), [2, 2], false),
            (Some([[0.0, 1.0], [0.0, 1.0]]), [2, 3], true),
        ] {
            assert_eq!(option(extent_mm, tile), refused.then_some("tile"), "{extent_mm:?} {tile:?}");
        }
    }

    #[test]
    fn an_image_is_stretched_where_square_pixels_would_lie_a_sample_elsewhere() {
        let lit = points();
        let area = LitArea::of(&shape(&lit)).unwrap();
        let stretch = |size: [usize; 2], tile| LightImage::new(size, vec![]).stretch(&area, tile);
        // The area is twice as wide as high; a sample is half a millimetre.
        assert_eq!((stretch([200, 100], [1, 1]), stretch([100, 100], [2, 1])), (None, None));
        let found = stretch([100, 100], [1, 1]).unwrap();
        let expected = Stretch { image_ratio: 1.0, area_ratio: 2.0, off_mm: 1.0, limit_mm: 0.5 };
        let pairs = [(found.area_ratio, expected.area_ratio), (found.off_mm, 1.0), (found.limit_mm, 0.5)];
        assert!(found.image_ratio == 1.0 && pairs.iter().all(|(a, b)| (a - b).abs() < 1e-12), "rounding: {found:?}");
        assert_eq!(stretch([160, 100], [1, 1]), None, "a quarter of a millimetre");
        // One line is even along y, and one pixel is even.
        assert_eq!((stretch([4000, 1], [1, 1]), stretch([1, 1], [1, 1])), (None, None));
    }
}
