//! What JPEG compression does to code values: its error, from the quantization tables in the file.

/// Variance of a decoded pixel's error, code values squared, R G B; `None` when the bytes are no JPEG with tables.
///
/// A coefficient that is rounded to steps of q is off by q²/12. High ones are mostly rounded to nothing: what is lost
/// then is the coefficient, and of what sensor noise leaves in it (variance `noise`, code values squared; 1 is about
/// that of a good sensor's mid-greys in 8 bits) no more than that is lost. The mean over the 64 coefficients is the
/// variance of a pixel; luma and chroma add up as the colour transform of JFIF mixes them, and the decoder rounds once
/// more.
///
/// Not modelled: that errors of neighbouring pixels depend on each other, subsampled chroma, edges (they lose more).
pub fn compression_variance(bytes: &[u8], noise: f64) -> Option<[f64; 3]> {
    variance_of_tables(bytes, |t| {
        let sum: f64 = t.iter().map(|&q| (f64::from(q).powi(2) / 12.0).min(noise)).sum();
        sum / 64.0 + ROUNDING
    })
}

/// The same of the mean of pixels that are lit alike, however many: steps of the mean of a block of 8 × 8, and luma and
/// chroma rounded as they are decoded.
///
/// Not modelled: noise that survives compression, which spreads the rounding and lowers this variance; rounding in the
/// encoder, which differs between cameras.
pub fn flat_variance(bytes: &[u8]) -> Option<[f64; 3]> {
    // The first coefficient is eight times the mean.
    variance_of_tables(bytes, |t| (f64::from(t[0]) / 8.0).powi(2) / 12.0 + ROUNDING)
}

/// From that of luma and of chroma by their tables, as the colour transform of JFIF mixes them.
fn variance_of_tables(bytes: &[u8], variance: impl Fn(&[u16; 64]) -> f64) -> Option<[f64; 3]> {
    let [luma, chroma] = quantization_tables(bytes)?;
    let luma = variance(luma.as_ref()?);
    // A grey picture has luma only.
    let chroma = chroma.as_ref().map_or(0.0, variance);
    Some([
        luma + 1.402f64.powi(2) * chroma,
        luma + (0.344f64.powi(2) + 0.714f64.powi(2)) * chroma,
        luma + 1.772f64.powi(2) * chroma,
    ])
}

/// Of whole numbers, code values squared.
const ROUNDING: f64 = 1.0 / 12.0;

/// The first two tables of the DQT segments before the picture's data.
fn quantization_tables(bytes: &[u8]) -> Option<[Option<[u16; 64]>; 2]> {
    if !bytes.starts_with(&[0xff, 0xd8]) {
        return None;
    }
    let mut tables = [None; 2];
    let mut at = 2;
    // Segments up to the start of the scan.
    while let Some(&[0xff, marker, high, low]) = bytes.get(at..at + 4) {
        let length = usize::from(u16::from_be_bytes([high, low]));
        let segment = bytes.get(at + 4..at + 2 + length.max(2))?;
        match marker {
            0xdb => read_tables(segment, &mut tables)?,
            0xda => break,
            _ => {}
        }
        at += 2 + length;
    }
    tables[0].is_some().then_some(tables)
}

fn read_tables(mut segment: &[u8], tables: &mut [Option<[u16; 64]>; 2]) -> Option<()> {
    while let Some((&head, rest)) = segment.split_first() {
        let wide = head >> 4 != 0;
        let bytes = if wide { 128 } else { 64 };
        let body = rest.get(..bytes)?;
        let entry = |k: usize| match wide {
            true => u16::from_be_bytes([body[2 * k], body[2 * k + 1]]),
            false => u16::from(body[k]),
        };
        if let Some(table) = tables.get_mut(usize::from(head & 15)) {
            *table = Some(std::array::from_fn(entry));
        }
        segment = &rest[bytes..];
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageEncoder;

    fn encoded(pixels: &[u8], side: u32, quality: u8) -> Vec<u8> {
        let mut bytes = Vec::new();
        let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
        encoder.write_image(pixels, side, side, image::ExtendedColorType::Rgb8).unwrap();
        bytes
    }

    #[test]
    fn the_variance_is_that_of_noisy_pictures_compressed_and_read_again() {
        let side = 128;
        // Uniform noise of variance 140, so that no coefficient is rounded to nothing.
        let mut state = 12_345u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        let pixels: Vec<u8> = (0..3 * side * side).map(|_| 108 + random() % 41).collect();
        // The colour transform leaves 0.4 of the noise in each chroma: steps of 20 are still rounded about uniformly.
        for quality in [90, 95, 98] {
            let bytes = encoded(&pixels, side, quality);
            let read = image::load_from_memory(&bytes).unwrap().into_rgb8().into_raw();
            let stated = compression_variance(&bytes, 140.0).unwrap();
            for c in 0..3 {
                let each = pixels.iter().zip(&read).skip(c).step_by(3);
                let found =
                    each.map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>() / f64::from(side * side);
                // A quarter: rounding is not uniform where a step is wider than the noise.
                assert!((found / stated[c] - 1.0).abs() < 0.25, "quality {quality}, {c}: {found} {stated:?}");
            }
        }
    }

    #[test]
    fn means_of_blocks_that_are_lit_alike_are_off_by_their_steps_and_by_rounding() {
        // Patches of 48 × 48, each lit alike but for noise of a third of a code value, which does not survive; chroma of
        // their neighbours reaches them at the rim.
        let (patch, across) = (48, 12);
        let side = patch * across;
        let mut state = 12_345u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let light: Vec<[f64; 3]> = (0..across * across).map(|_| [0, 1, 2].map(|_| 90.0 + 60.0 * random())).collect();
        let of = |k: usize| k / 3 % side / patch + across * (k / 3 / side / patch);
        let pixels: Vec<u8> =
            (0..3 * side * side).map(|k| (light[of(k)][k % 3] + random() - 0.5).round() as u8).collect();
        let bytes = encoded(&pixels, side as u32, 90);
        let read = image::load_from_memory(&bytes).unwrap().into_rgb8().into_raw();
        let (mut before, mut after) = (vec![[0.0; 3]; light.len()], vec![[0.0; 3]; light.len()]);
        for k in 0..pixels.len() {
            let middle = |at: usize| (16..32).contains(&(at % patch));
            if middle(k / 3 % side) && middle(k / 3 / side) {
                before[of(k)][k % 3] += f64::from(pixels[k]) / 256.0;
                after[of(k)][k % 3] += f64::from(read[k]) / 256.0;
            }
        }
        let stated = flat_variance(&bytes).unwrap();
        for c in 0..3 {
            let error = before.iter().zip(&after).map(|(a, b)| (a[c] - b[c]).powi(2)).sum::<f64>() / light.len() as f64;
            let stated = stated[c] + ROUNDING;
            // Some noise survives and spreads the rounding; 144 patches tell a variance to 12 %.
            assert!((0.6..1.3).contains(&(error / stated)), "{c}: {error} {stated}");
        }
        assert_eq!(flat_variance(b"\x89PNG"), None);
    }

    #[test]
    fn files_without_tables_have_none() {
        assert_eq!(compression_variance(b"\x89PNG", 1.0), None);
        let bytes = encoded(&[9; 3 * 64], 8, 95);
        for len in 0..bytes.len().min(80) {
            assert_eq!(compression_variance(&bytes[..len], 1.0), None, "{len} bytes");
        }
    }
}
