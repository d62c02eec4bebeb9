//! Photographs as files: decoded code values, their container, and the EXIF block that goes with them.

use image::ImageDecoder;
use std::path::Path;

/// How code values lie in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Container {
    Png16,
    Png8,
    /// Written again at quality 100, without chroma subsampling.
    Jpeg,
}

/// Interleaved RGB code values of one photograph.
#[derive(Debug, Clone)]
pub(crate) struct Picture {
    pub size: [usize; 2],
    pub codes: Vec<u16>,
    pub container: Container,
    pub exif: Option<Vec<u8>>,
    /// The file says that it is sRGB (PNG's gAMA and sRGB chunks).
    pub says_srgb: bool,
}

impl Picture {
    pub(crate) fn read(path: &Path) -> Self {
        let reader = image::ImageReader::open(path).unwrap();
        let mut decoder = reader.into_decoder().unwrap();
        let exif = decoder.exif_metadata().unwrap();
        let picture = image::DynamicImage::from_decoder(decoder).unwrap();
        let size = [picture.width() as usize, picture.height() as usize];
        let jpeg = path.extension().is_some_and(|e| e == "jpg" || e == "jpeg");
        let (container, codes) = match picture {
            image::DynamicImage::ImageRgb16(p) => (Container::Png16, p.into_raw()),
            image::DynamicImage::ImageRgb8(p) => {
                let container = if jpeg { Container::Jpeg } else { Container::Png8 };
                (container, p.into_raw().into_iter().map(u16::from).collect())
            }
            other => panic!("{}: not RGB of 8 or 16 bits: {:?}", path.display(), other.color()),
        };
        Self { size, codes, container, exif, says_srgb: false }
    }

    /// Writes a file of its own: the one that was there may be a link to the untouched capture's.
    pub(crate) fn write(&self, path: &Path) {
        let bytes = match self.container {
            Container::Jpeg => self.jpeg(),
            Container::Png8 | Container::Png16 => self.png(),
        };
        replace(path, &bytes);
    }

    fn jpeg(&self) -> Vec<u8> {
        use image::ImageEncoder;
        let mut bytes = Vec::new();
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 100);
        if let Some(exif) = &self.exif {
            encoder.set_exif_metadata(exif.clone()).unwrap();
        }
        let codes: Vec<u8> = self.codes.iter().map(|&c| c.min(255) as u8).collect();
        let [width, height] = self.size.map(|s| s as u32);
        encoder.write_image(&codes, width, height, image::ExtendedColorType::Rgb8).unwrap();
        bytes
    }

    fn png(&self) -> Vec<u8> {
        let [width, height] = self.size.map(|s| s as u32);
        let mut info = png::Info::with_size(width, height);
        info.color_type = png::ColorType::Rgb;
        let wide = self.container == Container::Png16;
        info.bit_depth = if wide { png::BitDepth::Sixteen } else { png::BitDepth::Eight };
        info.exif_metadata = self.exif.clone().map(Into::into);
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::with_info(&mut bytes, info).unwrap();
        if self.says_srgb {
            encoder.set_source_gamma(png::ScaledFloat::new(0.45455));
            encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
        }
        encoder.set_compression(png::Compression::Fastest);
        let mut writer = encoder.write_header().unwrap();
        let data: Vec<u8> = match wide {
            true => self.codes.iter().flat_map(|c| c.to_be_bytes()).collect(),
            false => self.codes.iter().map(|&c| c.min(255) as u8).collect(),
        };
        writer.write_image_data(&data).unwrap();
        writer.finish().unwrap();
        bytes
    }

    /// ExposureTime of its EXIF, s.
    pub(crate) fn exposure_secs(&self) -> Option<f64> {
        let block = self.exif.as_ref()?;
        let at = exposure_at(block)?;
        Some(f64::from(number(block, at, 4)?) / f64::from(number(block, at + 4, 4)?))
    }

    /// Writes another ExposureTime into its EXIF.
    pub(crate) fn set_exposure_secs(&mut self, secs: f64) {
        let block = self.exif.as_mut().expect("a photograph with EXIF");
        let at = exposure_at(block).expect("an ExposureTime");
        let (over, under) = ((secs * 1e9).round() as u32, 1_000_000_000u32);
        let bytes = |n: u32| if block[0] == b'M' { n.to_be_bytes() } else { n.to_le_bytes() };
        let (over, under) = (bytes(over), bytes(under));
        block[at..at + 4].copy_from_slice(&over);
        block[at + 4..at + 8].copy_from_slice(&under);
    }
}

/// Writes `bytes` under this name, whatever other names the old file has.
pub(crate) fn replace(path: &Path, bytes: &[u8]) {
    std::fs::remove_file(path).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// Where the numerator of ExposureTime stands in a TIFF block.
fn exposure_at(block: &[u8]) -> Option<usize> {
    let mut todo = vec![number(block, 4, 4)? as usize];
    while let Some(at) = todo.pop() {
        for k in 0..number(block, at, 2)? as usize {
            let entry = at + 2 + 12 * k;
            let value = number(block, entry + 8, 4)? as usize;
            match number(block, entry, 2)? {
                0x829a => return Some(value),
                0x8769 => todo.push(value),
                _ => {}
            }
        }
    }
    None
}

fn number(block: &[u8], at: usize, length: usize) -> Option<u32> {
    let bytes = block.get(at..at + length)?;
    let join = |number: u32, byte: &u8| number << 8 | u32::from(*byte);
    Some(if block[0] == b'M' { bytes.iter().fold(0, join) } else { bytes.iter().rev().fold(0, join) })
}
