//! The seal in single files: a text by which this program knows that it has made a file, and that nobody has changed
//! it.
//!
//! Writers put [`SEAL`] where their format has room for a text (an attribute of OpenEXR, a tEXt chunk of PNG, the
//! comment of a ZIP archive); [`seal`] then replaces the zeros in it by the BLAKE3 of all other bytes. Materials
//! (`.safetensors`, `.acq`) have a checksum of their own.

/// The text that a writer puts into a file.
pub(crate) const SEAL: &str =
    "made by acquire, blake3 0000000000000000000000000000000000000000000000000000000000000000";
const DIGITS: usize = 64;
const WORDS: usize = SEAL.len() - DIGITS;
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Puts the checksum into the seal of a file; files without one stay as they are.
pub(crate) fn seal(bytes: &mut [u8]) {
    let Some((digits, rest)) = place(bytes) else { return };
    let digest = digest(bytes, digits, rest);
    bytes[digits..digits + DIGITS].copy_from_slice(digest.as_bytes());
    if bytes.starts_with(PNG) {
        // The chunk's checksum, of its type and its text.
        let kind = bytes[..digits].windows(4).rposition(|w| w == b"tEXt").unwrap_or(digits);
        let crc = crc32(&bytes[kind..digits + DIGITS]);
        bytes[digits + DIGITS..rest].copy_from_slice(&crc.to_be_bytes());
    }
}

/// Whether a file has a seal that fits all of its bytes.
pub(super) fn is_sealed(bytes: &[u8]) -> bool {
    place(bytes).is_some_and(|(digits, rest)| bytes[digits..digits + DIGITS] == *digest(bytes, digits, rest).as_bytes())
}

/// Where the digits of the seal begin, and where the bytes behind it do.
fn place(bytes: &[u8]) -> Option<(usize, usize)> {
    let words = &SEAL.as_bytes()[..WORDS];
    let digits = bytes.windows(WORDS).position(|w| w == words)? + WORDS;
    let rest = digits + DIGITS + if bytes.starts_with(PNG) { 4 } else { 0 };
    (rest <= bytes.len()).then_some((digits, rest))
}

fn digest(bytes: &[u8], digits: usize, rest: usize) -> String {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&bytes[..digits]).update(&bytes[rest..]);
    hasher.finalize().to_hex().to_string()
}

/// The checksum of PNG's chunks (CRC-32, reflected).
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, &byte: &u8| {
        (0..8).fold(crc ^ u32::from(byte), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
    };
    !bytes.iter().fold(!0, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_seal_fits_the_bytes_that_it_was_put_on_and_no_others() {
        let mut bytes = [b"head".as_slice(), SEAL.as_bytes(), b"pixels"].concat();
        assert!(!is_sealed(&bytes) && !is_sealed(b"notes"));
        seal(&mut bytes);
        assert!(is_sealed(&bytes));
        for at in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[at] ^= 1;
            assert!(!is_sealed(&changed), "byte {at}");
        }
        assert!(!is_sealed(&bytes[..bytes.len() - 1]));
    }
}
