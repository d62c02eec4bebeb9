//! A photograph's code values row by row, so that it is in memory as a whole only where its format leaves no choice.

use super::photograph::raw;
use super::photograph::{Format, UNKNOWN_ENDING, decode_exr, decode_jpeg, to_rgb};
use super::samples::{Samples, Sampling};
use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;
use tiff::decoder::{ChunkType, Decoder, DecodingResult};
use tiff::tags::Tag;

/// Rows of a photograph from the first to the last, three channels each; grey is repeated in them, alpha dropped.
///
/// PNG comes by rows, TIFF by strips or rows of tiles, and by rows where it is not compressed. JPEG, OpenEXR, raw files, interlaced PNG and
/// compressed TIFF in one strip are decoded whole.
pub(super) struct RowReader {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// Where in its pixel each channel was measured.
    pub sampling: Sampling,
    source: Source,
    /// What was decoded last, and how many of its rows were taken.
    band: Samples,
    taken: usize,
}

enum Source {
    Png(Box<png::Reader<BufReader<File>>>, Vec<u8>),
    Tiff(Box<TiffBands>),
    /// All of it is in the band.
    Whole,
}

impl RowReader {
    /// Reads the head.
    ///
    /// # Errors
    /// Those of the file system (outer); in words, what is wrong with the file.
    pub(super) fn open(path: &Path) -> std::io::Result<Result<Self, String>> {
        let mut file = BufReader::with_capacity(1 << 18, File::open(path)?);
        Ok(match Format::of(path) {
            None => Err(UNKNOWN_ENDING.into()),
            Some(Format::Tiff) => Self::tiff(file),
            Some(Format::Exr) => decode_exr(file).map(|(w, h, samples)| Self::whole([w, h], samples, Sampling::WHOLE)),
            Some(Format::Raw) => {
                let mut bytes = Vec::new();
                file.read_to_end(&mut bytes)?;
                raw::decode(&bytes).map(|(w, h, samples, sampling)| Self::whole([w, h], samples, sampling))
            }
            Some(Format::Common) => {
                let mut first = [0; 8];
                let is_png = file.read_exact(&mut first).is_ok() && first == *b"\x89PNG\r\n\x1a\n";
                file.rewind()?;
                match is_png {
                    true => Self::png(file),
                    false => decode_jpeg(path)?.map(|(w, h, samples)| Self::whole([w, h], samples, Sampling::WHOLE)),
                }
            }
        })
    }

    /// Of what is in memory.
    pub(super) fn whole(size_px: [usize; 2], samples: Samples, sampling: Sampling) -> Self {
        Self { size_px, sampling, source: Source::Whole, band: samples, taken: 0 }
    }

    fn png(file: BufReader<File>) -> Result<Self, String> {
        let mut decoder = png::Decoder::new(file);
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().map_err(|e| e.to_string())?;
        let (width, height) = reader.info().size();
        let size_px = [width as usize, height as usize];
        if reader.info().interlaced {
            let len = reader.output_buffer_size().filter(|&len| len <= super::photograph::MOST_BYTES);
            let mut bytes = vec![0; len.ok_or("more pixels than are read")?];
            reader.next_frame(&mut bytes).map_err(|e| e.to_string())?;
            let mut samples = Samples::U8(vec![]);
            of_png(&bytes, reader.output_color_type(), &mut samples)?;
            return Ok(Self::whole(size_px, samples, Sampling::WHOLE));
        }
        let row = vec![0; reader.output_line_size(width).ok_or("rows of more bytes than memory has")?];
        let source = Source::Png(Box::new(reader), row);
        Ok(Self { size_px, sampling: Sampling::WHOLE, source, band: Samples::U8(vec![]), taken: 0 })
    }

    fn tiff(file: BufReader<File>) -> Result<Self, String> {
        let bands = TiffBands::new(file)?;
        let size_px = bands.size_px;
        let source = Source::Tiff(Box::new(bands));
        Ok(Self { size_px, sampling: Sampling::WHOLE, source, band: Samples::U8(vec![]), taken: 0 })
    }

    /// Whether all of it is in memory.
    pub(super) fn is_whole(&self) -> bool {
        matches!(self.source, Source::Whole)
    }

    /// Puts the next `rows` rows, which must be there, into `out` in the place of what it holds.
    ///
    /// # Errors
    /// In words, what is wrong with the file.
    pub(super) fn read(&mut self, rows: usize, out: &mut Samples) -> Result<(), String> {
        out.clear();
        let line = 3 * self.size_px[0];
        let mut missing = rows;
        while missing > 0 {
            let here = self.band.len() / line - self.taken;
            if here == 0 {
                self.next_band()?;
                continue;
            }
            let n = here.min(missing);
            out.extend(&self.band, line * self.taken..line * (self.taken + n));
            self.taken += n;
            missing -= n;
        }
        Ok(())
    }

    /// Leaves out the next `rows` rows, which must be there; what is in them is decoded only where the format asks for it.
    ///
    /// # Errors
    /// In words, what is wrong with the file.
    pub(super) fn skip(&mut self, rows: usize) -> Result<(), String> {
        let line = 3 * self.size_px[0];
        let mut missing = rows;
        while missing > 0 {
            let n = (self.band.len() / line - self.taken).min(missing);
            self.taken += n;
            missing -= n;
            if let (Source::Tiff(bands), 1..) = (&mut self.source, missing) {
                missing -= bands.skip(missing);
            }
            if missing > 0 {
                self.next_band()?;
            }
        }
        Ok(())
    }

    fn next_band(&mut self) -> Result<(), String> {
        self.taken = 0;
        match &mut self.source {
            Source::Png(reader, row) => {
                let there = reader.read_row(row).map_err(|e| e.to_string())?;
                there.ok_or("the file ends before the image does")?;
                of_png(row, reader.output_color_type(), &mut self.band)
            }
            Source::Tiff(bands) => bands.read(&mut self.band),
            Source::Whole => Err("the file ends before the image does".into()),
        }
    }

    /// After the last row: what a format has behind it to tell whether all was read rightly.
    ///
    /// # Errors
    /// In words, what is wrong with the file.
    pub(super) fn finish(&mut self) -> Result<(), String> {
        match &mut self.source {
            Source::Png(reader, row) => reader.read_row(row).map(|_| ()).map_err(|e| e.to_string()),
            _ => Ok(()),
        }
    }
}

/// The code values of some rows as the PNG decoder gives them.
fn of_png(bytes: &[u8], kind: (png::ColorType, png::BitDepth), out: &mut Samples) -> Result<(), String> {
    let (color, depth) = kind;
    let channels = color.samples();
    match depth {
        png::BitDepth::Sixteen => {
            let codes = bytes.as_chunks::<2>().0.iter().map(|&c| u16::from_be_bytes(c));
            out.refill_u16(|out| channels_to_rgb(codes, channels, out));
        }
        png::BitDepth::Eight => out.refill_u8(|out| channels_to_rgb(bytes.iter().copied(), channels, out)),
        other => return Err(format!("pixels of {other:?} bits are not read")),
    }
    Ok(())
}

/// Grey three times, colours without alpha.
fn channels_to_rgb<T: Copy>(mut codes: impl Iterator<Item = T>, channels: usize, out: &mut Vec<T>) {
    match channels {
        3 => out.extend(codes),
        1 => out.extend(codes.flat_map(|v| [v; 3])),
        2 => out.extend(codes.step_by(2).flat_map(|v| [v; 3])),
        _ => {
            while let (Some(r), Some(g), Some(b), Some(_)) = (codes.next(), codes.next(), codes.next(), codes.next()) {
                out.extend([r, g, b]);
            }
        }
    }
}

/// A TIFF's strips or rows of tiles.
struct TiffBands {
    decoder: Decoder<BufReader<File>>,
    size_px: [usize; 2],
    channels: usize,
    /// Rows of a strip or tile.
    chunk_rows: usize,
    /// Strips or tiles side by side.
    across: usize,
    /// The first row that was not read.
    row: usize,
    /// Bytes of a code value where rows can be read from the file as they are.
    plain: Option<Plain>,
    bytes: Vec<u8>,
}

/// Strips that are not compressed.
struct Plain {
    offsets: Vec<u64>,
    bits: u16,
    big_endian: bool,
}

/// Strips of no more bytes than this are read as they are.
const STRIP_BYTES: usize = 1 << 22;

impl TiffBands {
    fn new(file: BufReader<File>) -> Result<Self, String> {
        use tiff::ColorType;
        let words = |e: tiff::TiffError| e.to_string();
        let mut limits = tiff::decoder::Limits::default();
        let most = super::photograph::MOST_BYTES;
        (limits.decoding_buffer_size, limits.intermediate_buffer_size) = (most, most);
        let mut decoder = Decoder::new(file).map_err(words)?.with_limits(limits);
        let (width, height) = decoder.dimensions().map_err(words)?;
        let channels = match decoder.colortype().map_err(words)? {
            ColorType::RGB(_) => 3,
            ColorType::RGBA(_) => 4,
            ColorType::Gray(_) => 1,
            other => return Err(format!("pixels of type {other:?} are not read")),
        };
        let planar: Option<u16> = decoder.find_tag_unsigned(Tag::PlanarConfiguration).map_err(words)?;
        if planar.is_some_and(|p| p != 1) && channels > 1 {
            return Err("planes of one colour each (PlanarConfiguration 2) are not read".into());
        }
        let (chunk_width, chunk_rows) = decoder.chunk_dimensions();
        if chunk_width == 0 || chunk_rows == 0 {
            return Err("strips or tiles without pixels".into());
        }
        let size_px = [width as usize, height as usize];
        let (across, chunk_rows) = (width.div_ceil(chunk_width) as usize, chunk_rows as usize);
        let large = decoder.get_chunk_type() == ChunkType::Strip
            && size_px[0] * channels * chunk_rows.min(size_px[1]) > STRIP_BYTES;
        let plain = if large { Plain::of(&mut decoder).map_err(words)? } else { None };
        Ok(Self { decoder, size_px, channels, chunk_rows, across, row: 0, plain, bytes: vec![] })
    }

    /// Leaves out whole strips or rows of tiles that end within the next `rows`; returns how many rows these are.
    fn skip(&mut self, rows: usize) -> usize {
        let before = self.row;
        if self.plain.is_some() {
            self.row += rows;
        } else {
            self.row = (self.row + rows) / self.chunk_rows * self.chunk_rows;
        }
        // The last strip may be shorter: what it lacks of the others is not there to be skipped.
        self.row = self.row.clamp(before, self.size_px[1].max(before));
        self.row - before
    }

    fn read(&mut self, band: &mut Samples) -> Result<(), String> {
        if self.row >= self.size_px[1] {
            return Err("the file ends before the image does".into());
        }
        if self.plain.is_some() {
            return self.read_plain(band).map_err(|e| e.to_string());
        }
        let chunk = self.row / self.chunk_rows * self.across;
        let rows = self.chunk_rows.min(self.size_px[1] - self.row);
        self.row += rows;
        if self.across == 1 {
            *band = of_tiff(self.decoder.read_chunk(chunk as u32).map_err(|e| e.to_string())?, self.channels)?;
            return Ok(());
        }
        let mut tiles = Vec::with_capacity(self.across);
        for k in 0..self.across {
            let index = (chunk + k) as u32;
            let width = self.decoder.chunk_data_dimensions(index).0 as usize;
            let tile = self.decoder.read_chunk(index).map_err(|e| e.to_string())?;
            tiles.push((width, of_tiff(tile, self.channels)?));
        }
        band.clear();
        for y in 0..rows {
            for (width, tile) in &tiles {
                let from = 3 * width * y..3 * width * (y + 1);
                if tile.len() < from.end {
                    return Err("a tile of fewer pixels than it should have".into());
                }
                band.extend(tile, from);
            }
        }
        Ok(())
    }

    fn read_plain(&mut self, band: &mut Samples) -> std::io::Result<()> {
        let Some(plain) = &self.plain else { return Ok(()) };
        let line = self.size_px[0] * self.channels * usize::from(plain.bits / 8);
        let (strip, inside) = (self.row / self.chunk_rows, self.row % self.chunk_rows);
        let offset = plain.offsets.get(strip).copied().unwrap_or(u64::MAX / 2) + (inside * line) as u64;
        self.bytes.resize(line, 0);
        let file = self.decoder.inner();
        if file.stream_position()? != offset {
            file.seek(SeekFrom::Start(offset))?;
        }
        file.read_exact(&mut self.bytes)?;
        self.row += 1;
        let (bytes, channels) = (&self.bytes, self.channels);
        let (pairs, fours) = (bytes.as_chunks::<2>().0.iter(), bytes.as_chunks::<4>().0.iter());
        let be = plain.big_endian;
        let u16_of = |&b: &[u8; 2]| if be { u16::from_be_bytes(b) } else { u16::from_le_bytes(b) };
        let f32_of = |&b: &[u8; 4]| if be { f32::from_be_bytes(b) } else { f32::from_le_bytes(b) };
        match plain.bits {
            8 => band.refill_u8(|out| channels_to_rgb(bytes.iter().copied(), channels, out)),
            16 => band.refill_u16(|out| channels_to_rgb(pairs.map(u16_of), channels, out)),
            _ => band.refill_f32(|out| channels_to_rgb(fours.map(f32_of), channels, out)),
        }
        Ok(())
    }
}

impl Plain {
    /// `None` for strips that need decoding.
    fn of(decoder: &mut Decoder<BufReader<File>>) -> tiff::TiffResult<Option<Self>> {
        let compression: u16 = decoder.find_tag_unsigned(Tag::Compression)?.unwrap_or(1);
        let predictor: u16 = decoder.find_tag_unsigned(Tag::Predictor)?.unwrap_or(1);
        let photometric: u16 = decoder.find_tag_unsigned(Tag::PhotometricInterpretation)?.unwrap_or(0);
        let fill: u16 = decoder.find_tag_unsigned(Tag::FillOrder)?.unwrap_or(1);
        let bits: Vec<u16> = decoder.find_tag_unsigned_vec(Tag::BitsPerSample)?.unwrap_or_default();
        let formats: Vec<u16> = decoder.find_tag_unsigned_vec(Tag::SampleFormat)?.unwrap_or_else(|| vec![1]);
        let Some(&first) = bits.first() else { return Ok(None) };
        let known = match first {
            8 | 16 => formats.iter().all(|&f| f == 1),
            32 => formats.iter().all(|&f| f == 3),
            _ => false,
        };
        // 1 is grey from black, 2 is R G B.
        let plain = compression == 1 && predictor == 1 && fill == 1 && matches!(photometric, 1 | 2);
        if !plain || !known || bits.iter().any(|&b| b != first) {
            return Ok(None);
        }
        let offsets = decoder.get_tag_u64_vec(Tag::StripOffsets)?;
        let big_endian = decoder.byte_order() == tiff::tags::ByteOrder::BigEndian;
        Ok(Some(Self { offsets, bits: first, big_endian }))
    }
}

fn of_tiff(decoded: DecodingResult, channels: usize) -> Result<Samples, String> {
    Ok(match decoded {
        DecodingResult::U8(v) => Samples::U8(to_rgb(v, channels)),
        DecodingResult::U16(v) => Samples::U16(to_rgb(v, channels)),
        DecodingResult::F32(v) => Samples::F32(to_rgb(v, channels)),
        _ => return Err("samples must be 8 or 16 bit integers or 32 bit floats".into()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, colortype};

    const SIZE_PX: [usize; 2] = [31, 23];

    /// Different at every pixel and channel, and no bytes alike.
    fn code(x: usize, y: usize, c: usize) -> u16 {
        (1234 + 701 * x + 83 * y + 17_001 * c) as u16
    }

    fn rows(range: std::ops::Range<usize>) -> Samples {
        let at = |y: usize| (0..3 * SIZE_PX[0]).map(move |k| code(k / 3, y, k % 3));
        Samples::U16(range.flat_map(at).collect())
    }

    /// Reads some rows, leaves some out, reads the others.
    fn read_as_written(path: &Path, of: impl Fn(Samples) -> Samples) {
        let mut reader = RowReader::open(path).unwrap().unwrap();
        assert_eq!(reader.size_px, SIZE_PX, "{path:?}");
        let mut out = Samples::F32(vec![]);
        for (from, to) in [(0, 3), (10, 11), (16, 23)] {
            let before = [0, 3, 11][[0, 10, 16].iter().position(|&f| f == from).unwrap()];
            reader.skip(from - before).unwrap();
            reader.read(to - from, &mut out).unwrap();
            assert_eq!(out, of(rows(from..to)), "{path:?}, rows {from} to {to}");
        }
        reader.finish().unwrap();
        assert!(reader.read(1, &mut out).is_err(), "{path:?} ends");
    }

    fn save_tiff(path: &Path, compression: Compression, rows_per_strip: u32) {
        let mut encoder = TiffEncoder::new(File::create(path).unwrap()).unwrap().with_compression(compression);
        let [w, h] = SIZE_PX.map(|s| s as u32);
        let mut image = encoder.new_image::<colortype::RGB16>(w, h).unwrap();
        image.rows_per_strip(rows_per_strip).unwrap();
        let Samples::U16(codes) = rows(0..SIZE_PX[1]) else { unreachable!() };
        image.write_data(&codes).unwrap();
    }

    #[test]
    fn rows_of_every_format_are_those_that_were_written() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let [w, h] = SIZE_PX.map(|s| s as u32);
        let png =
            image::ImageBuffer::from_fn(w, h, |x, y| image::Rgb([0, 1, 2].map(|c| code(x as usize, y as usize, c))));
        png.save(at("a.png")).unwrap();
        let alpha = image::ImageBuffer::from_fn(w, h, |x, y| {
            let [r, g, b] = [0, 1, 2].map(|c| code(x as usize, y as usize, c));
            image::Rgba([r, g, b, 9])
        });
        alpha.save(at("alpha.png")).unwrap();
        for (name, compression, strip) in [
            ("strips.tif", Compression::Uncompressed, 4),
            ("one.tif", Compression::Uncompressed, 23),
            ("deflate.tif", Compression::Deflate(DeflateLevel::Fast), 5),
            ("lzw.tif", Compression::Lzw, 23),
        ] {
            save_tiff(&at(name), compression, strip);
        }
        for name in ["a.png", "alpha.png", "strips.tif", "one.tif", "deflate.tif", "lzw.tif"] {
            read_as_written(&at(name), |rows| rows);
        }
        // Grey of 8 bits: that of red, in all channels.
        let grey = image::ImageBuffer::from_fn(w, h, |x, y| image::Luma([code(x as usize, y as usize, 0) as u8]));
        grey.save(at("grey.png")).unwrap();
        read_as_written(&at("grey.png"), |rows| {
            let Samples::U16(rows) = rows else { unreachable!() };
            Samples::U8(rows.chunks_exact(3).flat_map(|p| [p[0] as u8; 3]).collect())
        });
    }

    #[test]
    fn strips_that_are_not_compressed_are_read_by_rows_whatever_their_height() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        for strip in [23, 7] {
            save_tiff(&path, Compression::Uncompressed, strip);
            let mut bands = TiffBands::new(BufReader::new(File::open(&path).unwrap())).unwrap();
            // As if they were large.
            bands.plain = Plain::of(&mut bands.decoder).unwrap();
            let mut band = Samples::U8(vec![]);
            for y in 0..5 {
                bands.read(&mut band).unwrap();
                assert_eq!(band, rows(y..y + 1));
            }
            assert_eq!(bands.skip(13), 13);
            bands.read(&mut band).unwrap();
            assert_eq!(band, rows(18..19));
        }
        save_tiff(&path, Compression::Lzw, 23);
        let mut bands = TiffBands::new(BufReader::new(File::open(&path).unwrap())).unwrap();
        assert!(Plain::of(&mut bands.decoder).unwrap().is_none(), "compressed");
    }

    #[test]
    fn a_file_cut_short_is_an_error_in_words_at_whichever_row() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let [w, h] = SIZE_PX.map(|s| s as u32);
        image::RgbImage::from_fn(w, h, |x, y| image::Rgb([x as u8, y as u8, 9])).save(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        for len in [0, 20, bytes.len() / 2, bytes.len() - 20] {
            std::fs::write(&path, &bytes[..len]).unwrap();
            let mut out = Samples::U8(vec![]);
            let read = RowReader::open(&path).unwrap().and_then(|mut r| r.read(23, &mut out).and_then(|()| r.finish()));
            assert!(read.is_err(), "{len} of {} bytes", bytes.len());
        }
    }
}
