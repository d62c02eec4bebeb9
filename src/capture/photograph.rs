//! One photograph: its file, exposure, size, and its pixels when asked.

#[cfg(feature = "raw")]
pub(super) use super::raw;
use super::reduction::{PhotographRows, Reduction};
use super::rows::RowReader;
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
}

impl Photograph {
    /// Reads the head; rows follow as they are asked for.
    ///
    /// # Errors
    /// [`Error::MissingPhotograph`], [`Error::BrokenPhotograph`] (an unknown format or layout).
    pub fn open(&self) -> Result<PhotographRows<'_>> {
        let reader = RowReader::open(&self.path).map_err(|e| self.unreadable(e))?;
        PhotographRows::new(self, reader.map_err(|reason| self.broken(reason))?)
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

    /// The code values in each of `rects`, which must lie in the picture of `size_px`, and where in its pixel each channel was measured.
    ///
    /// With `to_the_end` the file is read to its end, and damage behind the last of them found.
    ///
    /// # Errors
    /// Those of [`Self::decode`]; [`Error::BrokenPhotograph`] when the file holds another size than its head said.
    pub fn decode_parts(
        &self,
        rects: &[Rect],
        size_px: [usize; 2],
        to_the_end: bool,
    ) -> Result<(Vec<Samples>, Sampling)> {
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
        if to_the_end {
            rows.finish()?;
        }
        Ok((parts, rows.sampling()))
    }

    /// BLAKE3 of the file, read piece by piece.
    ///
    /// # Errors
    /// Those of reading it.
    pub fn hash(&self) -> Result<blake3::Hash> {
        let mut hasher = blake3::Hasher::new();
        let file = std::fs::File::open(&self.path).map_err(|e| self.unreadable(e))?;
        hasher.update_reader(file).map_err(|e| self.unreadable(e))?;
        Ok(hasher.finalize())
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
        let file = || std::fs::File::open(&self.path).map(std::io::BufReader::new).map_err(|e| self.unreadable(e));
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
                let head = meta.headers.first().ok_or_else(|| broken("no image in the file".into()))?;
                Ok(([head.layer_size.width(), head.layer_size.height()], 32))
            }
            Some(Format::Common) => {
                let reader =
                    image::ImageReader::new(file()?).with_guessed_format().map_err(|e| broken(e.to_string()))?;
                let decoder = reader.into_decoder().map_err(|e| broken(e.to_string()))?;
                let (w, h) = decoder.dimensions();
                let color = decoder.color_type();
                Ok(([w as usize, h as usize], (color.bits_per_pixel() / u16::from(color.channel_count())) as u8))
            }
            Some(Format::Raw) => {
                let bytes = std::fs::read(&self.path).map_err(|e| self.unreadable(e))?;
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
/// The largest picture that is decoded, px.
const MOST_PIXELS: usize = 1 << 27;

/// JPEG, and whatever else the file's first bytes say that it is.
pub(super) fn decode_jpeg(bytes: &[u8]) -> Decoded {
    check_jpeg_end(bytes)?;
    let mut reader = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(MOST_BYTES as u64);
    reader.limits(limits);
    let image = reader.decode().map_err(|e| e.to_string())?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    Ok((width, height, Samples::U8(image.into_rgb8().into_raw())))
}

/// Refuses a JPEG file that does not reach its end-of-image marker: the decoder fills what is missing with grey and
/// says nothing. Other files pass.
///
/// Not detected: damage between intact markers; JPEG has no checksum.
pub(crate) fn check_jpeg_end(bytes: &[u8]) -> Result<(), String> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return Ok(());
    }
    let mut at = 2;
    loop {
        // Compressed data up to the next marker, whose 0xff may be repeated.
        at += bytes[at.min(bytes.len())..].iter().take_while(|&&b| b != 0xff).count();
        at += bytes[at.min(bytes.len())..].iter().take_while(|&&b| b == 0xff).count();
        match bytes.get(at) {
            None => return Err("the file ends before the image does".into()),
            Some(0xd9) => return Ok(()),
            // A 0xff of the data, or a restart: no segment follows.
            Some(0x00 | 0x01 | 0xd0..=0xd7) => at += 1,
            // Segments are skipped by their length: an EXIF thumbnail has an end marker of its own.
            Some(_) => at += 1 + bytes.get(at + 1..at + 3).map_or(2, |n| usize::from(u16::from_be_bytes([n[0], n[1]]))),
        }
    }
}

/// Refuses an OpenEXR file whose head announces more pixels than are decoded: they are allocated before any is read.
pub(crate) fn check_exr_size(bytes: &[u8]) -> Result<(), String> {
    check_exr_head(&exr::meta::MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(|e| e.to_string())?)
}

fn check_exr_head(head: &exr::meta::MetaData) -> Result<(), String> {
    for layer in &head.headers {
        let size = [layer.layer_size.width(), layer.layer_size.height()];
        if size[0].checked_mul(size[1]).is_none_or(|pixels| pixels > MOST_PIXELS) {
            return Err(format!("{} × {} px: more than {MOST_PIXELS} are not read", size[0], size[1]));
        }
    }
    Ok(())
}

pub(super) fn decode_exr(mut file: impl std::io::BufRead + std::io::Seek + Send) -> Decoded {
    use exr::prelude::*;
    let head = exr::meta::MetaData::read_from_buffered(&mut file, false).map_err(|e| e.to_string())?;
    check_exr_head(&head)?;
    file.rewind().map_err(|e| e.to_string())?;
    let image = read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            |size, _| (size.width(), vec![0.0f32; size.area() * 3]),
            |(width, pixels): &mut (usize, Vec<f32>), at, (r, g, b): (f32, f32, f32)| {
                let k = 3 * (at.y() * *width + at.x());
                pixels[k..k + 3].copy_from_slice(&[r, g, b]);
            },
        )
        .first_valid_layer()
        .all_attributes()
        .from_buffered(file)
        .map_err(|e| e.to_string())?;
    let size = image.layer_data.size;
    Ok((size.width(), size.height(), Samples::F32(image.layer_data.channel_data.pixels.1)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jpeg_is_whole_only_up_to_its_own_end_marker() {
        // An EXIF segment with a thumbnail, a scan with a stuffed 0xff and a restart, the end, and a camera's trailer.
        let head = [0xff, 0xd8, 0xff, 0xe1, 0, 6, 0xff, 0xd8, 0xff, 0xd9, 0xff, 0xda, 0, 3, 1];
        let scan = [7, 0xff, 0, 8, 0xff, 0xd0, 9, 0xff, 0xff];
        let whole = [&head[..], &scan, &[0xd9, 0xff, 0xd8, 1]].concat();
        assert!(check_jpeg_end(&whole).is_ok());
        for len in 2..head.len() + scan.len() {
            assert!(check_jpeg_end(&whole[..len]).is_err(), "{len} bytes");
        }
        assert!(check_jpeg_end(b"\x89PNG").is_ok(), "not a JPEG");
    }

    #[test]
    fn an_exr_that_announces_too_many_pixels_is_refused() {
        use exr::prelude::*;
        let channels = SpecificChannels::rgb(|_: Vec2<usize>| (0.5f32, 0.5f32, 0.5f32));
        let mut file = Cursor::new(Vec::new());
        Image::from_channels((2, 2), channels).write().to_buffered(&mut file).unwrap();
        let mut bytes = file.into_inner();
        assert_eq!(decode_exr(Cursor::new(&bytes)).unwrap().0, 2);
        // The data window ends with its largest column and row.
        let at = bytes.windows(12).position(|w| w == b"dataWindow\0b").unwrap() + b"dataWindow\0box2i\0".len() + 4 + 8;
        bytes[at..at + 8].copy_from_slice(&[0xff, 0xff, 0, 0, 0xff, 0xff, 0, 0]);
        assert!(check_exr_size(&bytes).is_err() && decode_exr(Cursor::new(&bytes)).is_err());
    }
}
