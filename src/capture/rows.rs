//! A photograph's code values row by row, so that it is in memory as a whole only where its format leaves no choice.

use super::exr_file::decode_exr;
use super::photograph::raw;
use super::photograph::{Format, MOST_BYTES, UNKNOWN_ENDING, decode_jpeg};
use super::samples::{Samples, Sampling};
use super::tiff_bands::TiffBands;
use crate::files::File;
use std::io::{BufReader, Read, Seek};
use std::path::Path;

/// Rows of a photograph from the first to the last, three channels each; grey is repeated in them, alpha dropped.
///
/// PNG comes by rows, TIFF by strips or rows of tiles, and by rows where it is not compressed. JPEG, OpenEXR, raw
/// files, interlaced PNG and compressed TIFF in one strip are decoded whole.
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

/// What is wrong when rows are missing.
pub(super) const PAST_THE_END: &str = "the file ends before the image does";

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
        let mut file = BufReader::with_capacity(1 << 18, crate::files::open(path)?);
        Ok(match Format::of(path) {
            None => Err(UNKNOWN_ENDING.into()),
            Some(Format::Tiff) => Self::tiff(file),
            Some(Format::Exr) => decode_exr(file, usize::MAX)
                .map(|(w, h, pixels)| Self::whole([w, h], Samples::F32(pixels), Sampling::WHOLE)),
            Some(Format::Raw) => {
                let mut bytes = Vec::new();
                file.read_to_end(&mut bytes)?;
                raw::decode(&bytes).map(|(w, h, samples, sampling)| Self::whole([w, h], samples, sampling))
            }
            Some(Format::Common) => {
                if png_decoder(&mut file)?.is_some() {
                    return Ok(Self::png(file));
                }
                let mut bytes = Vec::new();
                file.read_to_end(&mut bytes)?;
                decode_jpeg(&bytes, usize::MAX).map(|(w, h, samples)| Self::whole([w, h], samples, Sampling::WHOLE))
            }
        })
    }

    /// Of what is in memory.
    pub(super) fn whole(size_px: [usize; 2], samples: Samples, sampling: Sampling) -> Self {
        Self { size_px, sampling, source: Source::Whole, band: samples, taken: 0 }
    }

    fn png(file: BufReader<File>) -> Result<Self, String> {
        let mut decoder = png_decoder(file).map_err(|e| e.to_string())?.ok_or("no PNG")?;
        decoder.set_transformations(png::Transformations::EXPAND);
        let mut reader = decoder.read_info().map_err(|e| e.to_string())?;
        let (width, height) = reader.info().size();
        let size_px = [width as usize, height as usize];
        if reader.info().interlaced {
            return Ok(Self::whole(size_px, whole_png(&mut reader)?, Sampling::WHOLE));
        }
        let row = vec![0; reader.output_line_size(width).ok_or("rows of more bytes than memory has")?];
        let source = Source::Png(Box::new(reader), row);
        Ok(Self { size_px, sampling: Sampling::WHOLE, source, band: Samples::U8(vec![]), taken: 0 })
    }

    fn tiff(file: BufReader<File>) -> Result<Self, String> {
        let bands = TiffBands::new(file)?;
        let size_px = bands.size_px();
        let source = Source::Tiff(Box::new(bands));
        Ok(Self { size_px, sampling: Sampling::WHOLE, source, band: Samples::U8(vec![]), taken: 0 })
    }

    /// Whether all of it is in memory.
    pub(super) fn is_whole(&self) -> bool {
        matches!(self.source, Source::Whole)
    }

    /// All code values of what is in memory as a whole.
    pub(super) fn take_samples(&mut self) -> Samples {
        std::mem::replace(&mut self.band, Samples::U8(vec![]))
    }

    /// Whether rows that are left out need not be decoded.
    pub(super) fn skips(&self) -> bool {
        matches!(self.source, Source::Tiff(_))
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

    /// Leaves out the next `rows` rows, which must be there; what is in them is decoded only where the format asks for
    /// it.
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
        self.decode_band()?;
        let line = 3 * self.size_px[0];
        match self.band.len() > 0 && self.band.len().is_multiple_of(line) {
            true => Ok(()),
            false => Err(format!("expected lines of {} px, found {} numbers", self.size_px[0], self.band.len())),
        }
    }

    fn decode_band(&mut self) -> Result<(), String> {
        match &mut self.source {
            Source::Png(reader, row) => {
                let there = reader.read_row(row).map_err(|e| e.to_string())?;
                there.ok_or(PAST_THE_END)?;
                of_png(row, reader.output_color_type(), &mut self.band)
            }
            Source::Tiff(bands) => bands.read(&mut self.band),
            Source::Whole => Err(PAST_THE_END.into()),
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

/// A decoder of PNG that leaves out colour profiles and texts, which small files may blow up to any size; `None` when
/// the file is no PNG.
pub(super) fn png_decoder<R: std::io::BufRead + Seek>(mut file: R) -> std::io::Result<Option<png::Decoder<R>>> {
    let mut first = [0; 8];
    let is_png = file.read_exact(&mut first).is_ok() && first == *b"\x89PNG\r\n\x1a\n";
    file.rewind()?;
    let mut decoder = png::Decoder::new_with_limits(file, png::Limits { bytes: MOST_BYTES });
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    Ok(is_png.then_some(decoder))
}

/// A whole PNG of at most `most_px` pixels; `None` when the bytes are none.
pub(crate) fn decode_png_bytes(bytes: &[u8], most_px: usize) -> Option<super::photograph::Decoded> {
    let mut decoder = png_decoder(std::io::Cursor::new(bytes)).ok()??;
    decoder.set_transformations(png::Transformations::EXPAND);
    let decode = || {
        let mut reader = decoder.read_info().map_err(|e| e.to_string())?;
        let (width, height) = reader.info().size();
        if width as usize * height as usize > most_px {
            return Err(format!("{width} × {height} px: more than {most_px} are not read; make it smaller"));
        }
        Ok((width as usize, height as usize, whole_png(&mut reader)?))
    };
    Some(decode())
}

/// All rows of a PNG at once.
fn whole_png<R: std::io::BufRead + Seek>(reader: &mut png::Reader<R>) -> Result<Samples, String> {
    let len = reader.output_buffer_size().filter(|&len| len <= MOST_BYTES);
    let mut codes = vec![0; len.ok_or("more pixels than are read")?];
    reader.next_frame(&mut codes).map_err(|e| e.to_string())?;
    let mut samples = Samples::U8(vec![]);
    of_png(&codes, reader.output_color_type(), &mut samples)?;
    Ok(samples)
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
pub(super) fn channels_to_rgb<T: Copy>(mut codes: impl Iterator<Item = T>, channels: usize, out: &mut Vec<T>) {
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

/// Grey three times, colours without alpha; colours alone stay where they are.
pub(super) fn rgb_of<T: Copy>(codes: Vec<T>, channels: usize) -> Vec<T> {
    if channels == 3 {
        return codes;
    }
    let mut out = Vec::with_capacity(3 * codes.len() / channels.max(1));
    channels_to_rgb(codes.into_iter(), channels, &mut out);
    out
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, colortype};

    pub(in crate::capture) const SIZE_PX: [usize; 2] = [31, 23];

    /// Different at every pixel and channel, and no bytes alike.
    fn code(x: usize, y: usize, c: usize) -> u16 {
        (1234 + 701 * x + 83 * y + 17_001 * c) as u16
    }

    pub(in crate::capture) fn rows(range: std::ops::Range<usize>) -> Samples {
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

    pub(in crate::capture) fn save_tiff(path: &Path, compression: Compression, rows_per_strip: u32) {
        let mut encoder = TiffEncoder::new(std::fs::File::create(path).unwrap()).unwrap().with_compression(compression);
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
