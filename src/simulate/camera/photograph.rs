//! Image files as a camera writes them: pixels and EXIF.

use crate::simulate::{FileFormat, mix_seed};
use crate::{Error, Result};
use exif::{Field, In, Rational, Tag, Value, experimental::Writer};
use std::fs::File;
use std::io::{BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use tiff::encoder::colortype::RGB16;
use tiff::encoder::{Compression, DeflateLevel, ImageEncoder, Predictor, TiffEncoder, TiffKindStandard};
use tiff::{TiffError, TiffResult, tags::Tag as Tiff};

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

/// Writes a photograph: interleaved RGB code values, a JPEG's up to 255. `taken_secs` counts from the capture's first
/// photograph.
///
/// # Errors
/// [`Error::Io`].
pub fn write_photograph(
    path: &Path,
    format: FileFormat,
    size_px: [usize; 2],
    codes: &[u16],
    exposure: ExposureTime,
    taken_secs: usize,
) -> Result<()> {
    let mut file = PhotographFile::create(path, format, size_px, exposure, taken_secs)?;
    let mut rows = file.rows()?;
    rows.write(codes)?;
    rows.finish()
}

/// Bytes of a PNG's chunks.
const PNG_CHUNK: usize = 1 << 20;

/// The file of a photograph, open and empty.
pub(crate) struct PhotographFile {
    path: PathBuf,
    format: FileFormat,
    size_px: [usize; 2],
    encoder: Encoder,
}

enum Encoder {
    /// Until its rows begin.
    Png(Option<Box<png::StreamWriter<'static, File>>>),
    Tiff(Box<TiffEncoder<BufWriter<File>>>, ExposureTime),
    Jpeg(File, Vec<u8>),
}

impl PhotographFile {
    /// Creates it. `taken_secs` counts from the capture's first photograph.
    pub(crate) fn create(
        path: &Path,
        format: FileFormat,
        size_px: [usize; 2],
        exposure: ExposureTime,
        taken_secs: usize,
    ) -> Result<Self> {
        let exif = exif_block(exposure, taken_secs)?;
        let file = File::create(path).map_err(Error::io("create", path))?;
        let tiff = |file, compression, predictor| -> Result<Encoder> {
            let encoder = TiffEncoder::new(BufWriter::new(file)).map_err(of_tiff(path))?;
            let encoder = encoder.with_compression(compression).with_predictor(predictor);
            Ok(Encoder::Tiff(Box::new(encoder), exposure))
        };
        let encoder = match format {
            FileFormat::Png => Encoder::Png(Some(Box::new(begin_png(file, size_px, exif).map_err(of_png(path))?))),
            FileFormat::Tiff => tiff(file, Compression::Uncompressed, Predictor::None)?,
            FileFormat::TiffDeflate => tiff(file, Compression::Deflate(DeflateLevel::Fast), Predictor::Horizontal)?,
            FileFormat::Jpeg => Encoder::Jpeg(file, exif),
        };
        Ok(Self { path: path.to_owned(), format, size_px, encoder })
    }

    /// Begins with its rows.
    pub(crate) fn rows(&mut self) -> Result<PhotographRows<'_>> {
        let encoder = match &mut self.encoder {
            Encoder::Png(writer) => {
                RowEncoder::Png(writer.take().ok_or_else(|| Error::internal("a photograph has begun twice"))?)
            }
            Encoder::Tiff(encoder, exposure) => {
                let image = begin_tiff(encoder, self.size_px, *exposure).map_err(of_tiff(&self.path))?;
                let compressed = self.format == FileFormat::TiffDeflate;
                RowEncoder::Tiff { image: Box::new(image), compressed, begun: Vec::new() }
            }
            Encoder::Jpeg(file, exif) => RowEncoder::Jpeg(file, exif),
        };
        Ok(PhotographRows { path: &self.path, size_px: self.size_px, encoder, data: Vec::new() })
    }
}

/// What takes the rows of one photograph, in any number of parts. A JPEG's are kept until the last, 3 bytes a pixel, and
/// a compressed TIFF's, 6 bytes a pixel.
pub(crate) struct PhotographRows<'a> {
    path: &'a Path,
    size_px: [usize; 2],
    encoder: RowEncoder<'a>,
    /// Code values as the encoder takes them.
    data: Vec<u8>,
}

enum RowEncoder<'a> {
    Png(Box<png::StreamWriter<'static, File>>),
    Tiff {
        image: Box<ImageEncoder<'a, BufWriter<File>, RGB16, TiffKindStandard>>,
        compressed: bool,
        /// Code values that are no whole strip yet.
        begun: Vec<u16>,
    },
    Jpeg(&'a mut File, &'a mut Vec<u8>),
}

impl PhotographRows<'_> {
    /// Writes the next rows.
    pub(crate) fn write(&mut self, codes: &[u16]) -> Result<()> {
        match &mut self.encoder {
            RowEncoder::Png(writer) => {
                self.data.resize(2 * codes.len(), 0);
                self.data.as_chunks_mut::<2>().0.iter_mut().zip(codes).for_each(|(to, c)| *to = c.to_be_bytes());
                writer.write_all(&self.data).map_err(Error::io("write", self.path))
            }
            RowEncoder::Tiff { image, compressed, begun } => {
                begun.extend_from_slice(codes);
                let mut done = 0;
                loop {
                    let strip = image.next_strip_sample_count() as usize;
                    // The encoder writes single strips without compression.
                    if *compressed || strip == 0 || begun.len() < done + strip {
                        break;
                    }
                    image.write_strip(&begun[done..done + strip]).map_err(of_tiff(self.path))?;
                    done += strip;
                }
                begun.drain(..done);
                Ok(())
            }
            RowEncoder::Jpeg(..) => {
                self.data.extend(codes.iter().map(|&c| c.min(255) as u8));
                Ok(())
            }
        }
    }

    /// Ends the file, when all rows have been written.
    pub(crate) fn finish(self) -> Result<()> {
        match self.encoder {
            RowEncoder::Png(writer) => writer.finish().map_err(of_png(self.path)),
            RowEncoder::Tiff { image, compressed: true, begun } => image.write_data(&begun).map_err(of_tiff(self.path)),
            RowEncoder::Tiff { image, .. } => image.finish().map_err(of_tiff(self.path)),
            RowEncoder::Jpeg(file, exif) => {
                let [width, height] = self.size_px.map(|s| s as u32);
                let mut to = BufWriter::new(file);
                let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut to, 95);
                image::ImageEncoder::set_exif_metadata(&mut encoder, std::mem::take(exif)).map_err(Error::internal)?;
                image::ImageEncoder::write_image(encoder, &self.data, width, height, image::ExtendedColorType::Rgb8)
                    .map_err(|e| match e {
                        image::ImageError::IoError(e) => Error::io("write", self.path)(e),
                        other => Error::internal(other),
                    })?;
                to.flush().map_err(Error::io("write", self.path))
            }
        }
    }
}

fn begin_png(
    file: File,
    size_px: [usize; 2],
    exif: Vec<u8>,
) -> std::result::Result<png::StreamWriter<'static, File>, png::EncodingError> {
    let [width, height] = size_px.map(|s| s as u32);
    let mut info = png::Info::with_size(width, height);
    info.color_type = png::ColorType::Rgb;
    info.bit_depth = png::BitDepth::Sixteen;
    info.exif_metadata = Some(exif.into());
    let mut encoder = png::Encoder::with_info(file, info)?;
    // Noise does not compress and this decodes fastest; Up turns pedestal and black into runs.
    encoder.set_compression(png::Compression::Fastest);
    encoder.set_filter(png::Filter::Up);
    encoder.write_header()?.into_stream_writer_with_size(PNG_CHUNK)
}

fn begin_tiff<W: Write + Seek>(
    encoder: &mut TiffEncoder<W>,
    size_px: [usize; 2],
    exposure: ExposureTime,
) -> TiffResult<ImageEncoder<'_, W, RGB16, TiffKindStandard>> {
    let [width, height] = size_px.map(|s| s as u32);
    // ExposureTime, FNumber, PhotographicSensitivity.
    let mut exif = encoder.extra_directory()?;
    let rational = |n: u32, d: u32| tiff::encoder::Rational { n, d };
    exif.write_tag(Tiff::Unknown(33_434), rational(exposure.numerator, exposure.denominator))?;
    exif.write_tag(Tiff::Unknown(33_437), rational(8, 1))?;
    exif.write_tag(Tiff::Unknown(34_855), 100u16)?;
    let exif = exif.finish_with_offsets()?;
    let mut image = encoder.new_image::<RGB16>(width, height)?;
    image.encoder().write_tag(Tiff::ExifDirectory, exif.offset)?;
    Ok(image)
}

fn of_png(path: &Path) -> impl Fn(png::EncodingError) -> Error {
    move |e| match e {
        png::EncodingError::IoError(e) => Error::io("write", path)(e),
        other => Error::internal(other),
    }
}

fn of_tiff(path: &Path) -> impl Fn(TiffError) -> Error {
    move |e| match e {
        TiffError::IoError(e) => Error::io("write", path)(e),
        other => Error::internal(other),
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
            write_photograph(&path, format, [8, 4], &[100; 96], time, 3700).unwrap();
            let mut file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
            let exif = exif::Reader::new().read_from_container(&mut file).unwrap();
            let field = exif.get_field(Tag::ExposureTime, In::PRIMARY).unwrap();
            assert!(matches!(&field.value, Value::Rational(v) if v[0].num == 1 && v[0].denom == 16));
        }
    }

    fn decode(path: &Path) -> Vec<u16> {
        if path.extension().is_some_and(|e| e == "png") {
            return image::open(path).unwrap().into_rgb16().into_raw();
        }
        let file = std::io::BufReader::new(File::open(path).unwrap());
        match tiff::decoder::Decoder::new(file).unwrap().read_image().unwrap() {
            tiff::decoder::DecodingResult::U16(codes) => codes,
            _ => panic!("16 bits"),
        }
    }

    #[test]
    fn photographs_written_by_rows_hold_the_code_values_in_all_formats() {
        let dir = tempfile::tempdir().unwrap();
        // Wide enough for several strips of a TIFF and chunks of a PNG, with rows in uneven parts.
        let (width, height) = (2051, 211);
        for (format, name) in
            [(FileFormat::Png, "a.png"), (FileFormat::Tiff, "a.tif"), (FileFormat::TiffDeflate, "b.tif")]
        {
            let path = dir.path().join(name);
            let codes: Vec<u16> = (0..3 * width * height).map(|i| ((i as u64 * 2_654_435_761) >> 7) as u16).collect();
            let time = ExposureTime::one_over(4);
            let mut file = PhotographFile::create(&path, format, [width, height], time, 0).unwrap();
            let mut rows = file.rows().unwrap();
            let mut from = 0;
            for n in [1, 7, 150, 3, 50] {
                rows.write(&codes[3 * width * from..][..3 * width * n]).unwrap();
                from += n;
            }
            rows.finish().unwrap();
            drop(file);
            assert!(from == height && decode(&path) == codes, "{name}");
            let at_once = dir.path().join("whole");
            write_photograph(&at_once, format, [width, height], &codes, time, 0).unwrap();
            assert!(std::fs::read(&path).unwrap() == std::fs::read(at_once).unwrap(), "{name}");
        }
    }

    #[test]
    fn a_full_disk_is_told_as_one_that_cannot_be_written() {
        for format in [FileFormat::Png, FileFormat::Tiff, FileFormat::TiffDeflate, FileFormat::Jpeg] {
            let path = Path::new("/dev/full");
            if !path.exists() {
                return;
            }
            let codes = vec![77; 3 * 3000 * 200];
            let error = write_photograph(path, format, [3000, 200], &codes, ExposureTime::one_over(4), 0).unwrap_err();
            assert!(matches!(&error, Error::Io { .. }), "{format:?}: {error:?}");
        }
    }
}
