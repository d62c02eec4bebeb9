//! Raster pictures: made in memory, written as PNG beside the page and embedded in it.

use super::color::Rgb;
use crate::{Error, Result};
use base64::Engine;
use image::ImageEncoder;

/// An sRGB picture of eight bits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SrgbPicture {
    /// px.
    pub width: usize,
    /// px.
    pub height: usize,
    pixels: Vec<u8>,
}

impl SrgbPicture {
    /// Colours every pixel by its column and row.
    pub(super) fn from_fn(width: usize, height: usize, color: impl Fn(usize, usize) -> Rgb) -> Self {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(|(x, y)| color(x, y)).collect();
        Self { width, height, pixels }
    }

    /// The colour at column `x`, row `y`.
    pub(super) fn at(&self, x: usize, y: usize) -> Rgb {
        let i = 3 * (y * self.width + x);
        [self.pixels[i], self.pixels[i + 1], self.pixels[i + 2]]
    }

    /// Every pixel repeated so often that the longer side has at least `side` pixels: small windows stay crisp in any
    /// viewer.
    pub(super) fn enlarged(&self, side: usize) -> Self {
        let n = side.div_ceil(self.width.max(self.height).max(1)).max(1);
        Self::from_fn(self.width * n, self.height * n, |x, y| self.at(x / n, y / n))
    }

    /// Encodes as PNG.
    ///
    /// # Errors
    /// [`Error::Internal`] for an empty picture.
    pub(super) fn png(&self) -> Result<Vec<u8>> {
        let mut out = Vec::new();
        image::codecs::png::PngEncoder::new(&mut out)
            .write_image(&self.pixels, self.width as u32, self.height as u32, image::ExtendedColorType::Rgb8)
            .map_err(Error::internal)?;
        Ok(out)
    }
}

/// `bytes` of a PNG as a URL that carries the whole picture.
pub(super) fn data_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", base64::engine::general_purpose::STANDARD.encode(png))
}

/// The block mean that brings `width` × `height` to at most `limit` on the longer side; 1 when it fits.
pub(super) fn reduction(width: usize, height: usize, limit: usize) -> usize {
    width.max(height).div_ceil(limit).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_holds_the_pixels() {
        let picture = SrgbPicture::from_fn(3, 2, |x, y| [x as u8 * 50, y as u8 * 90, 7]).enlarged(10);
        assert_eq!((picture.width, picture.height), (12, 8));
        let back = image::load_from_memory(&picture.png().unwrap()).unwrap().to_rgb8();
        assert_eq!(back.dimensions(), (12, 8));
        assert_eq!(back.get_pixel(11, 7).0, [100, 90, 7]);
        assert_eq!(back.get_pixel(3, 0).0, [0, 0, 7]);
        assert_eq!(back.get_pixel(4, 3).0, [50, 0, 7]);
    }
}
