//! Whether the data of a JPEG make the picture that its head announces: decoders fill what is missing with grey, and
//! say nothing.

/// Refuses a JPEG file whose data do not make its picture: one that does not reach its end-of-image marker, announces
/// more blocks than its bytes can hold, or, when it is sequential, whose Huffman codes are not those of exactly as many
/// blocks as it has (a stretch of zeros or of another file, an end that was put on too early). Other files pass.
///
/// Not detected: damage that changes no length of a code, and any in the scans of progressive files; JPEG has no
/// checksum.
pub(crate) fn check_jpeg(bytes: &[u8]) -> Result<(), String> {
    walk(bytes, true)
}

/// [`check_jpeg`] without the codes: only the end is looked for, for a tenth of the time.
pub(crate) fn check_jpeg_end(bytes: &[u8]) -> Result<(), String> {
    walk(bytes, false)
}

const SHORT: &str = "the file ends before the image does";

fn walk(bytes: &[u8], codes: bool) -> Result<(), String> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return Ok(());
    }
    let mut head = Head::default();
    let mut at = 2;
    loop {
        // Compressed data up to the next marker, whose 0xff may be repeated.
        at += bytes[at.min(bytes.len())..].iter().take_while(|&&b| b != 0xff).count();
        at += bytes[at.min(bytes.len())..].iter().take_while(|&&b| b == 0xff).count();
        match bytes.get(at) {
            None => return Err(SHORT.into()),
            Some(0xd9) => return Ok(()),
            // A 0xff of the data, or a restart: no segment follows.
            Some(0x00 | 0x01 | 0xd0..=0xd7) => at += 1,
            // Segments are skipped by their length: an EXIF thumbnail has an end marker of its own.
            Some(&marker) => {
                let length = bytes.get(at + 1..at + 3).map_or(2, |n| usize::from(u16::from_be_bytes([n[0], n[1]])));
                let segment = bytes.get(at + 3..at + 1 + length).unwrap_or_default();
                at += 1 + length;
                if codes {
                    head.read(marker, segment, bytes.len())?;
                    if marker == 0xda {
                        at += head.scan(segment, bytes.get(at..).unwrap_or_default())?;
                    }
                }
            }
        }
    }
}

/// What the segments say that a scan needs.
#[derive(Default)]
struct Head {
    frame: Option<Frame>,
    /// Codes of DC differences and of AC coefficients.
    tables: [[Option<Codes>; 4]; 2],
    restart: usize,
}

struct Frame {
    sequential: bool,
    size: [usize; 2],
    /// Name, and blocks along x and y in an interleaved unit.
    components: Vec<(u8, [usize; 2])>,
}

impl Head {
    fn read(&mut self, marker: u8, segment: &[u8], file_bytes: usize) -> Result<(), String> {
        match marker {
            0xc0..=0xc2 => {
                let frame = Frame::read(marker != 0xc2, segment).ok_or("a damaged frame header")?;
                frame.check(file_bytes)?;
                self.frame = Some(frame);
            }
            0xc4 => self.read_tables(segment).ok_or("a damaged Huffman table")?,
            0xdd => self.restart = segment.get(..2).map_or(0, |n| usize::from(u16::from_be_bytes([n[0], n[1]]))),
            _ => {}
        }
        Ok(())
    }

    fn read_tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&head, rest)) = segment.split_first() {
            let (counts, rest) = rest.split_at_checked(16)?;
            let (symbols, rest) = rest.split_at_checked(counts.iter().map(|&n| usize::from(n)).sum())?;
            *self.tables.get_mut(usize::from(head >> 4))?.get_mut(usize::from(head & 15))? =
                Some(Codes::new(counts, symbols)?);
            segment = rest;
        }
        Some(())
    }

    /// Follows the codes of a scan; returns how many bytes they take. Scans of progressive files are left to the
    /// decoder.
    fn scan(&self, segment: &[u8], data: &[u8]) -> Result<usize, String> {
        let Some(frame) = self.frame.as_ref().filter(|f| f.sequential && f.size[1] > 0) else { return Ok(0) };
        let mut parts = Vec::new();
        let named = segment.get(1..1 + 2 * usize::from(segment.first().copied().unwrap_or(0))).unwrap_or_default();
        for pair in named.as_chunks::<2>().0 {
            let component = frame.components.iter().find(|c| c.0 == pair[0]);
            let table = |kind: usize, at: u8| self.tables[kind].get(usize::from(at)).and_then(Option::as_ref);
            let (Some(component), Some(dc), Some(ac)) = (component, table(0, pair[1] >> 4), table(1, pair[1] & 15))
            else {
                return Err("a scan of a component, or with a table, that is not there".into());
            };
            parts.push((component.1, dc, ac));
        }
        let alone = parts.len() == 1;
        let units = frame.units(parts.first().filter(|_| alone).map(|p| p.0));
        let mut bits = Bits { data, at: 0, buffer: 0, bits: 0 };
        for unit in 0..units {
            if self.restart > 0 && unit > 0 && unit % self.restart == 0 {
                bits.restart()?;
            }
            for (blocks, dc, ac) in &parts {
                let blocks = if alone { 1 } else { blocks[0] * blocks[1] };
                (0..blocks).try_for_each(|_| block(&mut bits, dc, ac))?;
            }
        }
        match bits.left() {
            true => Err("more data than the picture has: they are damaged, or of another picture".into()),
            false => Ok(bits.at),
        }
    }
}

impl Frame {
    fn read(sequential: bool, segment: &[u8]) -> Option<Self> {
        let number = |at: usize| Some(usize::from(u16::from_be_bytes([*segment.get(at)?, *segment.get(at + 1)?])));
        let size = [number(3)?, number(1)?];
        let count = usize::from(*segment.get(5)?);
        let parts = segment.get(6..6 + 3 * count)?.as_chunks::<3>().0;
        let components =
            parts.iter().map(|c| (c[0], [usize::from(c[1] >> 4), usize::from(c[1] & 15)])).collect::<Vec<_>>();
        let valid = !components.is_empty() && components.iter().all(|c| c.1.iter().all(|n| (1..=4).contains(n)));
        valid.then_some(Self { sequential, size, components })
    }

    fn most(&self) -> [usize; 2] {
        [0, 1].map(|a| self.components.iter().map(|c| c.1[a]).max().unwrap_or(1))
    }

    /// Units of a scan: blocks of the one component that it is of, or interleaved ones.
    fn units(&self, alone: Option<[usize; 2]>) -> usize {
        let most = self.most();
        let along = |a: usize| match alone {
            Some(own) => (self.size[a] * own[a]).div_ceil(most[a]).div_ceil(8),
            None => self.size[a].div_ceil(8 * most[a]),
        };
        along(0) * along(1)
    }

    /// No block takes less than a bit.
    fn check(&self, file_bytes: usize) -> Result<(), String> {
        let blocks = self.size[0].div_ceil(8) * self.size[1].div_ceil(8);
        match blocks > 8 * file_bytes {
            true => {
                Err(format!("{} × {} px announced, which {file_bytes} bytes cannot hold", self.size[0], self.size[1]))
            }
            false => Ok(()),
        }
    }
}

/// For every 16 bits the length of the code that they begin with and its symbol; length 0: none.
struct Codes(Vec<(u8, u8)>);

impl Codes {
    fn new(counts: &[u8], symbols: &[u8]) -> Option<Self> {
        let mut table = Vec::with_capacity(1 << 16);
        let mut symbols = symbols.iter();
        for (length, &count) in (1..).zip(counts) {
            for _ in 0..count {
                table.resize(table.len() + (1 << (16 - length)), (length, *symbols.next()?));
            }
        }
        table.resize((table.len() <= 1 << 16).then_some(1 << 16)?, (0, 0));
        Some(Self(table))
    }
}

/// The codes of one block of 64 coefficients.
#[inline]
fn block(bits: &mut Bits<'_>, dc: &Codes, ac: &Codes) -> Result<(), String> {
    let size = bits.symbol(dc)?;
    bits.skip(u32::from(size))?;
    let mut k = 1;
    while k < 64 {
        let symbol = bits.symbol(ac)?;
        let (run, size) = (usize::from(symbol >> 4), u32::from(symbol & 15));
        match (run, size) {
            (15, 0) => k += 16,
            (_, 0) => return Ok(()),
            _ => {
                k += run + 1;
                bits.skip(size)?;
            }
        }
    }
    if k > 64 { Err("a block of more than 64 coefficients: the data are damaged".into()) } else { Ok(()) }
}

/// The bits of a scan up to the next marker.
struct Bits<'a> {
    data: &'a [u8],
    at: usize,
    buffer: u64,
    bits: u32,
}

impl Bits<'_> {
    #[inline]
    fn fill(&mut self) {
        while self.bits <= 48 {
            let (byte, length) = match (self.data.get(self.at), self.data.get(self.at + 1)) {
                (Some(0xff), Some(0x00)) => (0xff, 2),
                (None, _) | (Some(0xff), _) => return,
                (Some(&byte), _) => (byte, 1),
            };
            self.at += length;
            self.buffer = self.buffer << 8 | u64::from(byte);
            self.bits += 8;
        }
    }

    #[inline]
    fn symbol(&mut self, codes: &Codes) -> Result<u8, String> {
        if self.bits < 16 {
            self.fill();
        }
        let next = if self.bits >= 16 { self.buffer >> (self.bits - 16) } else { self.buffer << (16 - self.bits) };
        let (length, symbol) = codes.0[(next & 0xffff) as usize];
        match length {
            0 => Err("a code that is in no table: the data are damaged".into()),
            length => self.skip(u32::from(length)).map(|()| symbol),
        }
    }

    #[inline]
    fn skip(&mut self, count: u32) -> Result<(), String> {
        if self.bits < count {
            self.fill();
        }
        self.bits = self.bits.checked_sub(count).ok_or(SHORT)?;
        Ok(())
    }

    /// Whether there are more data than fill the last byte.
    fn left(&mut self) -> bool {
        self.fill();
        self.bits >= 8
    }

    fn restart(&mut self) -> Result<(), String> {
        let marker = |this: &Self| this.data.get(this.at + 1).copied();
        if self.left() {
            return Err("more data than the picture has: they are damaged, or of another picture".into());
        }
        // The 0xff of a marker may be repeated.
        while self.data.get(self.at) == Some(&0xff) && marker(self) == Some(0xff) {
            self.at += 1;
        }
        match marker(self) {
            Some(0xd0..=0xd7) => {
                self.at += 2;
                (self.buffer, self.bits) = (0, 0);
                Ok(())
            }
            _ => Err(SHORT.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageEncoder;

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

    /// Noise, so that the codes are of all lengths.
    fn encoded(size: [u32; 2], color: image::ExtendedColorType, quality: u8) -> Vec<u8> {
        let mut state = 12_345u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8 / 3
        };
        let pixels: Vec<u8> =
            (0..size[0] * size[1] * u32::from(color.channel_count())).map(|_| 80 + random()).collect();
        let mut bytes = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
        encoder.write_image(&pixels, size[0], size[1], color).unwrap();
        bytes
    }

    #[test]
    fn whole_pictures_pass_and_zeroed_exchanged_and_shortened_ones_do_not() {
        for size in [[64, 48], [33, 47], [8, 8], [1, 1]] {
            for color in [image::ExtendedColorType::Rgb8, image::ExtendedColorType::L8] {
                let bytes = encoded(size, color, 90);
                check_jpeg(&bytes).unwrap();
            }
        }
        let bytes = encoded([256, 128], image::ExtendedColorType::Rgb8, 90);
        let scan = bytes.windows(2).position(|w| w == [0xff, 0xda]).unwrap() + 14;
        for (from, len) in [(scan + 100, 64), (scan + 2000, 512), (bytes.len() - 600, 500)] {
            let mut zeroed = bytes.clone();
            zeroed[from..from + len].fill(0);
            assert!(check_jpeg_end(&zeroed).is_ok() && check_jpeg(&zeroed).is_err(), "{len} zeros at {from}");
        }
        for len in [scan, scan + 1, scan + 700, bytes.len() - 4] {
            let ended = [&bytes[..len], &[0xff, 0xd9]].concat();
            assert!(check_jpeg_end(&ended).is_ok() && check_jpeg(&ended).is_err(), "{len} of {} bytes", bytes.len());
        }
        let mut twice = bytes[..scan + 3000].to_vec();
        twice.extend_from_slice(&bytes[scan + 2000..]);
        assert!(check_jpeg(&twice).is_err(), "a stretch that is there twice");
    }

    #[test]
    fn a_size_that_the_bytes_cannot_hold_is_refused() {
        let mut bytes = encoded([64, 48], image::ExtendedColorType::L8, 50);
        let frame = bytes.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        bytes[frame + 5..frame + 9].copy_from_slice(&[0x3e, 0x80, 0x1f, 0x40]);
        assert!(check_jpeg(&bytes).unwrap_err().starts_with("8000 × 16000 px announced"));
    }
}
