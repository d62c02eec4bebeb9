//! A TIFF's code values strip by strip, or row by row where the file holds them as they are.

use super::photograph::MOST_BYTES;
use super::rows::{channels_to_rgb, rgb_of};
use super::samples::Samples;
use crate::files::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use tiff::decoder::{ChunkType, Decoder, DecodingResult};
use tiff::tags::Tag;

/// A TIFF's strips or rows of tiles.
pub(super) struct TiffBands {
    decoder: Decoder<BufReader<File>>,
    size_px: [usize; 2],
    channels: usize,
    /// 1, or one for each channel where they are stored one after the other.
    planes: usize,
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
    /// Reads the head.
    ///
    /// # Errors
    /// In words, what is wrong with the file.
    pub(super) fn new(file: BufReader<File>) -> Result<Self, String> {
        use tiff::ColorType;
        let words = |e: tiff::TiffError| e.to_string();
        let mut limits = tiff::decoder::Limits::default();
        (limits.decoding_buffer_size, limits.intermediate_buffer_size) = (MOST_BYTES, MOST_BYTES);
        let mut decoder = Decoder::new(file).map_err(words)?.with_limits(limits);
        let (width, height) = decoder.dimensions().map_err(words)?;
        let channels = match decoder.colortype().map_err(words)? {
            ColorType::RGB(_) => 3,
            ColorType::RGBA(_) => 4,
            ColorType::Gray(_) => 1,
            other => return Err(format!("pixels of type {other:?} are not read")),
        };
        let planar: Option<u16> = decoder.find_tag_unsigned(Tag::PlanarConfiguration).map_err(words)?;
        let planes = if planar.is_some_and(|p| p != 1) { channels } else { 1 };
        let (chunk_width, chunk_rows) = decoder.chunk_dimensions();
        if chunk_width == 0 || chunk_rows == 0 {
            return Err("strips or tiles without pixels".into());
        }
        let size_px = [width as usize, height as usize];
        let (across, chunk_rows) = (width.div_ceil(chunk_width) as usize, chunk_rows as usize);
        let large = decoder.get_chunk_type() == ChunkType::Strip
            && size_px[0] * channels * chunk_rows.min(size_px[1]) > STRIP_BYTES;
        let plain = if large && planes == 1 { Plain::of(&mut decoder).map_err(words)? } else { None };
        if let Some(plain) = &plain {
            plain.check(&mut decoder, size_px, channels, chunk_rows)?;
        }
        Ok(Self { decoder, size_px, channels, planes, chunk_rows, across, row: 0, plain, bytes: vec![] })
    }

    /// Columns and rows.
    pub(super) fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    /// Leaves out whole strips or rows of tiles that end within the next `rows`; returns how many rows these are.
    pub(super) fn skip(&mut self, rows: usize) -> usize {
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

    /// The next rows: a strip, a row of tiles, or one row of a plain file.
    ///
    /// # Errors
    /// In words, what is wrong with the file.
    pub(super) fn read(&mut self, band: &mut Samples) -> Result<(), String> {
        if self.row >= self.size_px[1] {
            return Err("the file ends before the image does".into());
        }
        if self.plain.is_some() {
            return self.read_plain(band).map_err(|e| e.to_string());
        }
        let chunk = self.row / self.chunk_rows * self.across;
        let rows = self.chunk_rows.min(self.size_px[1] - self.row);
        self.row += rows;
        let mut tiles = Vec::with_capacity(self.across);
        for k in 0..self.across {
            let width = self.decoder.chunk_data_dimensions((chunk + k) as u32).0 as usize;
            let tile = self.chunk(chunk + k)?;
            if tile.len() != 3 * width * rows {
                return Err(format!("a strip or tile of {} numbers, expected {}", tile.len(), 3 * width * rows));
            }
            tiles.push((width, tile));
        }
        if self.across == 1 {
            *band = tiles.pop().map_or(Samples::U8(vec![]), |(_, strip)| strip);
            return Ok(());
        }
        band.clear();
        for y in 0..rows {
            for (width, tile) in &tiles {
                band.extend(tile, 3 * width * y..3 * width * (y + 1));
            }
        }
        Ok(())
    }

    /// A strip or tile, with all its channels.
    fn chunk(&mut self, index: usize) -> Result<Samples, String> {
        let mut plane = |p: usize| {
            let of_plane = self.across * self.size_px[1].div_ceil(self.chunk_rows);
            let index = u32::try_from(index + p * of_plane).map_err(|e| e.to_string())?;
            self.decoder.read_chunk(index).map_err(|e| e.to_string())
        };
        if self.planes == 1 {
            return of_tiff(plane(0)?, self.channels);
        }
        // Alpha is not looked at.
        let colors = (0..self.channels.min(3)).map(|p| of_tiff(plane(p)?, 1)).collect::<Result<Vec<_>, String>>()?;
        Samples::of_planes(&colors).ok_or_else(|| "planes of different lengths or kinds".into())
    }

    fn read_plain(&mut self, band: &mut Samples) -> std::io::Result<()> {
        let Some(plain) = &self.plain else { return Ok(()) };
        let line = self.size_px[0] * self.channels * usize::from(plain.bits / 8);
        let (strip, inside) = (self.row / self.chunk_rows, self.row % self.chunk_rows);
        let offset = plain.offsets.get(strip).copied().unwrap_or(u64::MAX).saturating_add((inside * line) as u64);
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

impl Plain {
    /// Whether the file holds all the strips that its head announces, before memory is set aside for them.
    fn check(
        &self,
        decoder: &mut Decoder<BufReader<File>>,
        [width, height]: [usize; 2],
        channels: usize,
        strip_rows: usize,
    ) -> Result<(), String> {
        let len = decoder.inner().get_ref().len().map_err(|e| e.to_string())?;
        let line = (width * channels) as u64 * u64::from(self.bits / 8);
        for strip in 0..height.div_ceil(strip_rows) {
            let rows = strip_rows.min(height - strip * strip_rows) as u64;
            let end = self.offsets.get(strip).and_then(|o| o.checked_add(rows.checked_mul(line)?));
            if end.is_none_or(|end| end > len) {
                return Err(format!(
                    "the file ends before strip {strip} does: {width} × {height} px announced, {len} bytes"
                ));
            }
        }
        Ok(())
    }
}

fn of_tiff(decoded: DecodingResult, channels: usize) -> Result<Samples, String> {
    Ok(match decoded {
        DecodingResult::U8(v) => Samples::U8(rgb_of(v, channels)),
        DecodingResult::U16(v) => Samples::U16(rgb_of(v, channels)),
        DecodingResult::F32(v) => Samples::F32(rgb_of(v, channels)),
        _ => return Err("samples must be 8 or 16 bit integers or 32 bit floats".into()),
    })
}

#[cfg(test)]
mod tests {
    use super::super::rows::tests::{rows, save_tiff};
    use super::*;
    use tiff::encoder::Compression;

    #[test]
    fn strips_that_are_not_compressed_are_read_by_rows_whatever_their_height() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.tif");
        for strip in [23, 7] {
            save_tiff(&path, Compression::Uncompressed, strip);
            let mut bands = TiffBands::new(BufReader::new(crate::files::open(&path).unwrap())).unwrap();
            // As if they were large.
            let plain = Plain::of(&mut bands.decoder).unwrap().unwrap();
            let (size_px, rows_of) = (bands.size_px, bands.chunk_rows);
            plain.check(&mut bands.decoder, size_px, 3, rows_of).unwrap();
            let wider = [2 * size_px[0], size_px[1]];
            assert!(plain.check(&mut bands.decoder, wider, 3, rows_of).unwrap_err().contains("ends before"));
            bands.plain = Some(plain);
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
        let mut bands = TiffBands::new(BufReader::new(crate::files::open(&path).unwrap())).unwrap();
        assert!(Plain::of(&mut bands.decoder).unwrap().is_none(), "compressed");
    }
}
