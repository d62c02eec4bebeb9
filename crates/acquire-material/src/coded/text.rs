//! The header's JSON, byte by byte, predicted from the bytes before it and from a text that every header resembles.

use super::entropy::{Bits, Contexts, Meter, Mixer};

/// Longest run of bytes that a byte is predicted from.
const ORDERS: usize = 6;
const SLOTS: usize = 1 << 16;
/// No header is longer.
const LONGEST: usize = 1 << 24;
/// What the coder has seen before the header begins. Part of the format: changing it needs a new version.
const TYPICAL: &str = include_str!("typical.txt");

struct Text {
    mixer: Mixer,
    /// The last bytes, the latest lowest.
    last: u64,
}

impl Text {
    fn new() -> Self {
        Self { mixer: Mixer::new(ORDERS + 1, SLOTS, 256 + 256), last: 0 }
    }

    fn code<B: Bits>(&mut self, bits: &mut B, byte: u8) -> Result<u8, String> {
        // The bits of the byte so far, below a leading one.
        let mut partial = 1_usize;
        for k in (0..8).rev() {
            let slots: [usize; ORDERS + 1] = std::array::from_fn(|order| {
                let bytes = self.last & ((1 << (8 * order)) - 1);
                let mixed = (bytes + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(29);
                let mixed = (mixed ^ (partial as u64 * 8 + order as u64)).wrapping_mul(0xD6E8_FEB8_6659_FD93);
                (mixed >> 48) as usize % SLOTS
            });
            let sets = [partial, 256 + (self.last & 255) as usize];
            let bit = self.mixer.code(bits, byte >> k & 1 == 1, Contexts { slots: &slots, sets })?;
            partial = partial << 1 | usize::from(bit);
        }
        let byte = (partial & 255) as u8;
        self.last = self.last << 8 | u64::from(byte);
        Ok(byte)
    }
}

/// Codes a text; a decoder gives `None` and gets it back. Its end is a zero byte.
///
/// # Errors
/// Those of `bits`; a text that holds a zero byte, is too long, or is no UTF-8.
pub(super) fn code_text<B: Bits>(bits: &mut B, text: Option<&str>) -> Result<String, String> {
    let mut coder = Text::new();
    for byte in TYPICAL.bytes() {
        coder.code(&mut Meter::default(), byte)?;
    }
    if text.is_some_and(|t| t.len() > LONGEST || t.bytes().any(|b| b == 0)) {
        return Err(format!("header: expected up to {LONGEST} bytes and no zero"));
    }
    let mut found = Vec::new();
    loop {
        let byte = text.and_then(|t| t.as_bytes().get(found.len()).copied()).unwrap_or(0);
        match coder.code(bits, byte)? {
            0 => break,
            byte => found.push(byte),
        }
        if found.len() > LONGEST {
            return Err(format!("header: expected up to {LONGEST} bytes"));
        }
    }
    String::from_utf8(found).map_err(|e| format!("header: {e}"))
}

#[cfg(test)]
mod tests {
    use super::super::entropy::{Reader, Writer};
    use super::*;

    #[test]
    fn any_text_without_a_zero_comes_back() {
        for text in ["", "x", "{\"model\":\"joint\",\"µ\":[1.5,−2]}", "ÿ\u{10FFFF}\n\t".repeat(40).as_str()] {
            let mut w = Writer::default();
            assert_eq!(code_text(&mut w, Some(text)).as_deref(), Ok(text));
            assert_eq!(code_text(&mut Reader::new(&w.finish()).unwrap(), None).as_deref(), Ok(text));
        }
        assert!(code_text(&mut Writer::default(), Some("a\0b")).is_err());
    }
}
