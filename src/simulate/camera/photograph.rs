//! Image files as a camera writes them: pixels and EXIF.

use crate::simulate::{FileFormat, mix_seed};
use crate::{Error, Result};
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
use image::ImageEncoder;
use std::path::Path;
use tiff::encoder::{Compression, DeflateLevel, Predictor, TiffEncoder};
use tiff::tags::Tag as Tiff;

/// An exposure time as EXIF holds it: a fraction of whole numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExposureTime {
    /// Above the line.
    pub numerator: u32,
    /// Below it.
    pub denominator: u32,
}

impl ExposureTime {
    /// 1/`denominator` s.
    pub fn one_over(denominator: u32) -> Self {
        Self { numerator: 1, denominator: denominator.max(1) }
    }

    /// This time made longer by `stops`: exact for whole stops, else to a millionth of a second.
    pub fn longer(self, stops: f64) -> Self {
        if stops.fract() == 0.0 && (0.0..=20.0).contains(&stops) {
            let numerator = self.numerator << stops as u32;
            let common = gcd(numerator, self.denominator);
            return Self { numerator: numerator / common, denominator: self.denominator / common };
        }
        Self { numerator: (self.secs() * stops.exp2() * 1e6).round() as u32, denominator: 1_000_000 }
    }

    /// What EXIF says of it: off by a random amount of `stops_error` (root mean square) that only depends on the time
    /// and `seed`, then its usual name when `nominal`.
    pub(crate) fn told(self, stops_error: f64, nominal: bool, seed: u64) -> Self {
        let key = (u64::from(self.numerator) << 32) | u64::from(self.denominator);
        let uniform = (mix_seed(mix_seed(seed, 0xe81f), key) >> 11) as f64 / (1u64 << 53) as f64;
        let stops = stops_error * 12f64.sqrt() * (uniform - 0.5);
        let told = if stops == 0.0 { self } else { Self::nanoseconds(self.secs() * stops.exp2()) };
        if nominal { told.usual_name() } else { told }
    }

    fn nanoseconds(secs: f64) -> Self {
        // 1e9 in the denominator leaves room for 4 s.
        let denominator = if secs < 4.0 { 1_000_000_000 } else { 1_000_000 };
        Self { numerator: (secs * f64::from(denominator)).round() as u32, denominator }
    }

    /// The nearest of the times that cameras show, in thirds of stops: 1/250, 1/200, 1/160, 1/125, …
    fn usual_name(self) -> Self {
        const DECADE: [f64; 10] = [1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.0, 8.0];
        let per_sec = 1.0 / self.secs();
        let names = (-2..=5).flat_map(|e| DECADE.map(|d| d * 10f64.powi(e)));
        // Cameras say 1/125 and 1/15, not 1/130 and 1/16, but these are near enough for a test of what a name costs.
        let near = |v: f64| (v / per_sec).ln().abs();
        let best = names.min_by(|a, b| near(*a).total_cmp(&near(*b))).unwrap_or(per_sec);
        if best >= 1.0 { Self::one_over(best.round() as u32) } else { Self::nanoseconds(1.0 / best) }
    }

    /// Seconds.
    pub fn secs(self) -> f64 {
        f64::from(self.numerator) / f64::from(self.denominator)
    }
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a.max(1) } else { gcd(b, a % b) }
}

/// Writes photographs one after another, in memory that is used again.
#[derive(Debug)]
pub struct PhotographWriter {
    format: FileFormat,
    size_px: [usize; 2],
    /// Code values as the encoder takes them, and the file.
    data: Vec<u8>,
    bytes: Vec<u8>,
}

impl PhotographWriter {
    /// For photographs of one format and size.
    pub fn new(format: FileFormat, size_px: [usize; 2]) -> Self {
        Self { format, size_px, data: Vec::new(), bytes: Vec::new() }
    }

    /// Writes interleaved RGB code values, a JPEG's up to 255, and returns the file's length. `taken_secs` counts from
    /// the capture's first photograph.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&mut self, path: &Path, codes: &[u16], exposure: ExposureTime, taken_secs: usize) -> Result<u64> {
        let exif = exif_block(exposure, taken_secs)?;
        self.bytes.clear();
        match self.format {
            FileFormat::Png => self.encode_png(codes, exif)?,
            FileFormat::Tiff => self.encode_tiff(codes, exposure, Compression::Uncompressed)?,
            FileFormat::TiffDeflate => self.encode_tiff(codes, exposure, Compression::Deflate(DeflateLevel::Fast))?,
            FileFormat::Jpeg => self.encode_jpeg(codes, exif)?,
        }
        std::fs::write(path, &self.bytes).map_err(Error::io("write", path))?;
        Ok(self.bytes.len() as u64)
    }

    fn encode_png(&mut self, codes: &[u16], exif: Vec<u8>) -> Result<()> {
        let [width, height] = self.size_px.map(|s| s as u32);
        let mut info = png::Info::with_size(width, height);
        info.color_type = png::ColorType::Rgb;
        info.bit_depth = png::BitDepth::Sixteen;
        info.exif_metadata = Some(exif.into());
        let mut encoder = png::Encoder::with_info(&mut self.bytes, info).map_err(Error::internal)?;
        // Noise does not compress and this decodes fastest; Up turns pedestal and black into runs.
        encoder.set_compression(png::Compression::Fastest);
        encoder.set_filter(png::Filter::Up);
        let mut writer = encoder.write_header().map_err(Error::internal)?;
        self.data.resize(2 * codes.len(), 0);
        self.data.as_chunks_mut::<2>().0.iter_mut().zip(codes).for_each(|(to, c)| *to = c.to_be_bytes());
        writer.write_image_data(&self.data).map_err(Error::internal)?;
        writer.finish().map_err(Error::internal)
    }

    fn encode_tiff(&mut self, codes: &[u16], exposure: ExposureTime, compression: Compression) -> Result<()> {
        let [width, height] = self.size_px.map(|s| s as u32);
        let predictor = match compression {
            Compression::Uncompressed => Predictor::None,
            _ => Predictor::Horizontal,
        };
        let file = std::io::Cursor::new(&mut self.bytes);
        let encoder = TiffEncoder::new(file).map_err(Error::internal)?;
        let mut encoder = encoder.with_compression(compression).with_predictor(predictor);
        // ExposureTime, FNumber, PhotographicSensitivity.
        let mut exif = encoder.extra_directory().map_err(Error::internal)?;
        let rational = |n: u32, d: u32| tiff::encoder::Rational { n, d };
        exif.write_tag(Tiff::Unknown(33_434), rational(exposure.numerator, exposure.denominator))
            .and_then(|()| exif.write_tag(Tiff::Unknown(33_437), rational(8, 1)))
            .and_then(|()| exif.write_tag(Tiff::Unknown(34_855), 100u16))
            .map_err(Error::internal)?;
        let exif = exif.finish_with_offsets().map_err(Error::internal)?;
        let mut image = encoder.new_image::<tiff::encoder::colortype::RGB16>(width, height).map_err(Error::internal)?;
        image.encoder().write_tag(Tiff::ExifDirectory, exif.offset).map_err(Error::internal)?;
        image.write_data(codes).map_err(Error::internal)
    }

    fn encode_jpeg(&mut self, codes: &[u16], exif: Vec<u8>) -> Result<()> {
        let [width, height] = self.size_px.map(|s| s as u32);
        self.data.resize(codes.len(), 0);
        self.data.iter_mut().zip(codes).for_each(|(to, &c)| *to = c.min(255) as u8);
        let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut self.bytes, 95);
        encoder.set_exif_metadata(exif).map_err(Error::internal)?;
        encoder.write_image(&self.data, width, height, image::ExtendedColorType::Rgb8).map_err(Error::internal)
    }
}

/// The TIFF block of EXIF.
fn exif_block(exposure: ExposureTime, taken_secs: usize) -> Result<Vec<u8>> {
    let (day, hour) = (1 + taken_secs / 86_400, taken_secs / 3600 % 24);
    let taken = format!("2026:01:{day:02} {hour:02}:{:02}:{:02}", taken_secs / 60 % 60, taken_secs % 60);
    let ascii = |text: &str| Value::Ascii(vec![text.as_bytes().to_vec()]);
    let rational = |num: u32, denom: u32| Value::Rational(vec![Rational { num, denom }]);
    let fields = [
        (Tag::Make, ascii("acquire")),
        (Tag::Model, ascii("acquire simulate")),
        (Tag::ExposureTime, rational(exposure.numerator, exposure.denominator)),
        (Tag::FNumber, rational(8, 1)),
        (Tag::PhotographicSensitivity, Value::Short(vec![100])),
        (Tag::DateTimeOriginal, ascii(&taken)),
    ]
    .map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = Writer::new();
    fields.iter().for_each(|field| writer.push_field(field));
    let mut block = std::io::Cursor::new(Vec::new());
    writer.write(&mut block, false).map_err(Error::internal)?;
    Ok(block.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lie_of_exif_is_fixed_for_a_time_and_of_the_size_that_was_asked_for() {
        let times: Vec<_> = (1..2000).map(ExposureTime::one_over).collect();
        let stops = |t: &ExposureTime| (t.told(0.125, false, 7).secs() / t.secs()).log2();
        let rms = (times.iter().map(|t| stops(t).powi(2)).sum::<f64>() / times.len() as f64).sqrt();
        // 2000 draws: the root mean square is known to 1.5 %.
        assert!((rms / 0.125 - 1.0).abs() < 0.06, "{rms}");
        assert_eq!(times[255].told(0.125, false, 7), times[255].told(0.125, false, 7));
        assert_eq!(times[255].told(0.0, false, 7), times[255]);
        assert_eq!(times[255].told(0.0, true, 7), ExposureTime::one_over(250));
    }

    #[test]
    fn exposure_times_stay_exact_and_are_found_in_all_formats() {
        let time = ExposureTime::one_over(256).longer(4.0);
        assert_eq!(time, ExposureTime { numerator: 1, denominator: 16 });
        let dir = tempfile::tempdir().unwrap();
        for (format, name) in [
            (FileFormat::Png, "a.png"),
            (FileFormat::Tiff, "a.tif"),
            (FileFormat::TiffDeflate, "b.tif"),
            (FileFormat::Jpeg, "a.jpg"),
        ] {
            let path = dir.path().join(name);
            PhotographWriter::new(format, [8, 4]).write(&path, &[100; 96], time, 3700).unwrap();
            let mut file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
            let exif = exif::Reader::new().read_from_container(&mut file).unwrap();
            let field = exif.get_field(Tag::ExposureTime, In::PRIMARY).unwrap();
            assert!(matches!(&field.value, Value::Rational(v) if v[0].num == 1 && v[0].denom == 16));
        }
    }
}
