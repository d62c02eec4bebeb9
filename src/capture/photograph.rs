//! One photograph: its file, exposure, size, and its pixels when asked.

use super::exr_file::exr_size;
use super::jpeg_scan::check_jpeg;
use super::kept::Kept;
#[cfg(feature = "raw")]
pub(super) use super::raw;
use super::reduction::{PhotographRows, Reduction};
use super::rows::RowReader;
use super::rows::png_decoder;
use super::samples::{Pixels, Rect, Samples, Sampling};
use crate::{Error, Result};
use image::ImageDecoder;
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// A photograph that was found and whose exposure is known.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Photograph {
    /// The file.
    pub path: PathBuf,
    /// The shot it belongs to.
    pub shot: String,
    /// Exposure time, s.
    pub exposure_secs: f64,
    /// Exposure in seconds of the first photograph's aperture and ISO: what code values are proportional to.
    pub effective_secs: f64,
    /// What becomes of its pixels as they are decoded; `None`: they stay.
    pub reduction: Option<Reduction>,
    /// Where its pixels stay once they were decoded.
    #[serde(skip)]
    pub kept: Kept,
}

impl Photograph {
    /// A file as it is, exposed for so many seconds.
    pub fn new(path: impl Into<PathBuf>, shot: impl Into<String>, exposure_secs: f64) -> Self {
        Self {
            path: path.into(),
            shot: shot.into(),
            exposure_secs,
            effective_secs: exposure_secs,
            reduction: None,
            kept: Kept::default(),
        }
    }

    /// Reads the head; rows follow as they are asked for.
    ///
    /// # Errors
    /// [`Error::MissingPhotograph`], [`Error::BrokenPhotograph`] (an unknown format or layout).
    pub fn open(&self) -> Result<PhotographRows<'_>> {
        if let Some(pixels) = self.kept.get(&self.path, self.factor()) {
            return Ok(PhotographRows::of_memory(self, pixels));
        }
        let reader = RowReader::open(&self.path).map_err(|e| self.unreadable(e))?;
        PhotographRows::new(self, reader.map_err(|reason| self.broken(reason))?)
    }

    /// Pixels along a side of the blocks that become one.
    pub(super) fn factor(&self) -> usize {
        self.reduction.as_ref().map_or(1, |by| by.factor)
    }

    /// All of it. Grey is repeated in three channels, alpha is dropped.
    ///
    /// # Errors
    /// Those of [`Self::open`]; [`Error::BrokenPhotograph`] when the file is cut short.
    pub fn decode(&self) -> Result<Pixels> {
        let mut rows = self.open()?;
        let [width, height] = rows.size_px();
        let mut samples = Samples::U8(vec![]);
        rows.read(height, &mut samples)?;
        rows.finish()?;
        Ok(Pixels { width, height, samples, sampling: rows.sampling() })
    }

    /// The code values in each of `rects`, which must lie in the picture of `size_px`, and where in its pixel each
    /// channel was measured.
    ///
    /// The file is read to its end: damage behind the last of them is found.
    ///
    /// # Errors
    /// Those of [`Self::decode`]; [`Error::BrokenPhotograph`] when the file holds another size than its head said.
    pub fn decode_parts(&self, rects: &[Rect], size_px: [usize; 2]) -> Result<(Vec<Samples>, Sampling)> {
        let mut rows = self.open()?;
        rows.check_size(size_px)?;
        let first = rects.iter().map(|r| r.y).min().unwrap_or(0);
        let end = rects.iter().map(|r| r.y + r.height).max().unwrap_or(0);
        let mut parts: Vec<Samples> = rects.iter().map(|_| Samples::U8(vec![])).collect();
        let mut row = Samples::U8(vec![]);
        rows.skip(first)?;
        for y in first..end {
            let here = |r: &Rect| (r.y..r.y + r.height).contains(&y);
            if !rects.iter().any(here) {
                rows.skip(1)?;
                continue;
            }
            rows.read(1, &mut row)?;
            for (rect, part) in rects.iter().zip(&mut parts).filter(|(r, _)| here(r)) {
                part.extend(&row, 3 * rect.x..3 * (rect.x + rect.width));
            }
        }
        rows.finish()?;
        Ok((parts, rows.sampling()))
    }

    /// BLAKE3 of the file, read piece by piece.
    ///
    /// # Errors
    /// Those of reading it.
    pub fn hash(&self) -> Result<blake3::Hash> {
        crate::files::hash(&self.path).map_err(|e| self.unreadable(e))
    }

    /// Width and height from the file's head, without decoding or reducing it.
    ///
    /// # Errors
    /// As [`Self::decode`].
    pub fn size_px(&self) -> Result<[usize; 2]> {
        self.head().map(|(size_px, _)| size_px)
    }

    /// Width and height, and bits of a code value (32: floating point), from the file's head.
    ///
    /// # Errors
    /// As [`Self::decode`].
    pub(crate) fn head(&self) -> Result<([usize; 2], u8)> {
        let broken =
            |reason: String| Error::BrokenPhotograph { path: self.path.clone(), shot: self.shot.clone(), reason };
        let file = || crate::files::open(&self.path).map(std::io::BufReader::new).map_err(|e| self.unreadable(e));
        match Format::of(&self.path) {
            Some(Format::Tiff) => {
                let mut decoder = tiff::decoder::Decoder::new(file()?).map_err(|e| broken(e.to_string()))?;
                let (w, h) = decoder.dimensions().map_err(|e| broken(e.to_string()))?;
                let bits = decoder.colortype().map_err(|e| broken(e.to_string()))?.bit_depth();
                Ok(([w as usize, h as usize], bits))
            }
            Some(Format::Exr) => {
                let meta =
                    exr::meta::MetaData::read_from_buffered(file()?, false).map_err(|e| broken(e.to_string()))?;
                Ok((exr_size(&meta).map_err(broken)?, 32))
            }
            Some(Format::Common) => {
                if let Some(size_px) = png_size(file()?).map_err(broken)? {
                    return Ok(size_px);
                }
                let reader =
                    image::ImageReader::new(file()?).with_guessed_format().map_err(|e| broken(e.to_string()))?;
                let decoder = reader.into_decoder().map_err(|e| broken(e.to_string()))?;
                let (w, h) = decoder.dimensions();
                let color = decoder.color_type();
                Ok(([w as usize, h as usize], (color.bits_per_pixel() / u16::from(color.channel_count())) as u8))
            }
            Some(Format::Raw) => {
                let bytes = crate::files::read(&self.path).map_err(|e| self.unreadable(e))?;
                raw::size_px(&bytes).map(|size_px| (size_px, 16)).map_err(broken)
            }
            None => Err(broken(UNKNOWN_ENDING.into())),
        }
    }

    pub(super) fn broken(&self, reason: String) -> Error {
        Error::BrokenPhotograph { path: self.path.clone(), shot: self.shot.clone(), reason }
    }

    fn unreadable(&self, e: std::io::Error) -> Error {
        match e.kind() {
            std::io::ErrorKind::NotFound => {
                Error::MissingPhotograph { path: self.path.clone(), shot: self.shot.clone() }
            }
            _ => Error::io("read", &self.path)(e),
        }
    }
}

pub(super) const UNKNOWN_ENDING: &str =
    "the file name ends in none of .png .jpg .jpeg .tif .tiff .exr .dng .cr2 .nef .arw";

/// What stands in for the raw reader in a program that was built without it.
#[cfg(not(feature = "raw"))]
pub(super) mod raw {
    use super::super::samples::{Samples, Sampling};

    const REFUSAL: &str = "raw files need a program that was built with `cargo build --release --features raw`";

    pub(in crate::capture) fn decode(_: &[u8]) -> Result<(usize, usize, Samples, Sampling), String> {
        Err(REFUSAL.into())
    }

    pub(super) fn size_px(_: &[u8]) -> Result<[usize; 2], String> {
        Err(REFUSAL.into())
    }
}

pub(super) enum Format {
    Raw,
    Tiff,
    Exr,
    Common,
}

impl Format {
    pub(super) fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "tif" | "tiff" => Some(Self::Tiff),
            "exr" => Some(Self::Exr),
            "dng" | "cr2" | "nef" | "arw" => Some(Self::Raw),
            "png" | "jpg" | "jpeg" => Some(Self::Common),
            _ => None,
        }
    }
}

pub(super) type Decoded = Result<(usize, usize, Samples), String>;

/// The most bytes that a decoder may ask for: 134 million pixels of four 16-bit channels, twice.
pub(super) const MOST_BYTES: usize = 2 << 30;

/// JPEG, and whatever else the file's first bytes say that it is, of at most `most_px` pixels.
pub(crate) fn decode_jpeg(bytes: &[u8], most_px: usize) -> Decoded {
    check_jpeg(bytes)?;
    let mut reader = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(MOST_BYTES as u64);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    let (width, height) = decoder.dimensions();
    let (width, height) = (width as usize, height as usize);
    if width * height > most_px {
        return Err(format!("{width} × {height} px: more than {most_px} are not read; make it smaller"));
    }
    if decoder.total_bytes() > MOST_BYTES as u64 {
        return Err(format!("{width} × {height} px: more than are read"));
    }
    let image = image::DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?;
    Ok((width, height, Samples::U8(image.into_rgb8().into_raw())))
}

/// Size and bits of a PNG, from its head; `None` when the file is none.
fn png_size(file: std::io::BufReader<crate::files::File>) -> Result<Option<([usize; 2], u8)>, String> {
    let Some(decoder) = png_decoder(file).map_err(|e| e.to_string())? else { return Ok(None) };
    let reader = decoder.read_info().map_err(|e| e.to_string())?;
    let (width, height) = reader.info().size();
    Ok(Some(([width as usize, height as usize], reader.info().bit_depth as u8)))
}
