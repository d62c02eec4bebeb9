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

/// Standard deviations of noise at which [`change_of_variance`] is told: 0, ¼, ½, … code values.
pub const NOISE_LEVELS: usize = 17;
/// Their distance, code values.
pub const NOISE_STEP: f64 = 0.25;

/// How much wider (or, where negative, narrower) decoded code values of one light are spread than the code values that
/// the camera had, code values squared, R G B: for noise of each of [`NOISE_LEVELS`] standard deviations, alike in all
/// channels. `None` when the bytes are no JPEG with tables.
///
/// Noise of a variance below that of a step's rounding mostly does not survive: a coefficient c of variance v, normal
/// about 0, is read as Q(c), whose mean square is q² Σ (2k − 1) P(|c| > (k − ½) q). What colours have in common goes
/// with Q's gain E[c Q(c)] / v (`Bussgang1952`). The mean of a block keeps its noise and is rounded. R, G, B and then luma
/// and chroma are rounded to whole numbers by the encoder, R, G, B by the decoder.
///
/// Not modelled: subsampled chroma, and coefficients that the scene's own edges take away from 0, which are spread by
/// q²/12.
pub fn change_of_variance(bytes: &[u8]) -> Option<[[f64; 3]; NOISE_LEVELS]> {
    let [luma, chroma] = quantization_tables(bytes)?;
    let luma = luma?;
    Some(std::array::from_fn(|k| {
        let before = (k as f64 * NOISE_STEP).powi(2);
        let after = variance_after(&luma, chroma.as_ref(), before + ROUNDING);
        after.map(|after| after + ROUNDING - before)
    }))
}

/// Y, Cb and Cr of R, G, B by JFIF, and back.
const YCC_FROM_RGB: [[f64; 3]; 3] =
    [[0.299, 0.587, 0.114], [-0.168_736, -0.331_264, 0.5], [0.5, -0.418_688, -0.081_312]];
const RGB_FROM_YCC: [[f64; 3]; 3] = [[1.0, 0.0, 1.402], [1.0, -0.344_136, -0.714_136], [1.0, 1.772, 0.0]];

/// Variance of decoded R, G, B of one light, when each had that of `before`, independently.
fn variance_after(luma: &[u16; 64], chroma: Option<&[u16; 64]>, before: f64) -> [f64; 3] {
    let through = |variance: f64, table: &[u16; 64]| -> Vec<Rounded> {
        table.iter().enumerate().map(|(k, &q)| Rounded::of(variance, f64::from(q), k == 0)).collect()
    };
    let covariance = |i: usize, j: usize| before * (0..3).map(|c| YCC_FROM_RGB[i][c] * YCC_FROM_RGB[j][c]).sum::<f64>();
    // A grey picture has luma only.
    let Some(chroma) = chroma else {
        return [through(before, luma).iter().map(|r| r.variance).sum::<f64>() / 64.0 + ROUNDING; 3];
    };
    let parts = [0, 1, 2].map(|i| through(covariance(i, i), if i == 0 { luma } else { chroma }));
    let after = |i: usize, j: usize| -> f64 {
        let each = parts[i].iter().zip(&parts[j]);
        let product =
            |(a, b): (&Rounded, &Rounded)| if i == j { a.variance } else { covariance(i, j) * a.gain * b.gain };
        each.map(product).sum::<f64>() / 64.0 + if i == j { ROUNDING } else { 0.0 }
    };
    RGB_FROM_YCC.map(|to| {
        let row = |i: usize| (0..3).map(|j| to[i] * to[j] * after(i, j)).sum::<f64>();
        (0..3).map(row).sum()
    })
}

/// What rounding to whole steps makes of a normal variable.
struct Rounded {
    variance: f64,
    /// Its covariance with what it was, over the variance.
    gain: f64,
}

impl Rounded {
    /// Of a variable about 0, or, where `anywhere`, about any mean.
    fn of(variance: f64, step: f64, anywhere: bool) -> Self {
        let sd = variance.sqrt();
        // Six standard deviations hold all but 2e-9; of steps below an eighth of one, the sum is their limit to 1e-12.
        if anywhere || step < 0.125 * sd {
            return Self { variance: variance + step * step / 12.0, gain: 1.0 };
        }
        let (mut square, mut product, mut k) = (0.0, 0.0, 1.0);
        while (k - 0.5) * step < 6.0 * sd {
            let z = (k - 0.5) * step / sd;
            square += (2.0 * k - 1.0) * libm::erfc(z * std::f64::consts::FRAC_1_SQRT_2);
            product += (-0.5 * z * z).exp();
            k += 1.0;
        }
        let gain = if variance > 0.0 { step * product / sd * (2.0 / std::f64::consts::PI).sqrt() } else { 0.0 };
        Self { variance: step * step * square, gain }
    }
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
    fn code_values_of_one_light_are_spread_as_stated_whatever_their_noise() {
        let side = 128;
        for quality in [80, 92, 98] {
            for noise in [0.5, 1.0, 2.5, 4.0] {
                let mut rng = <rand_pcg::Pcg64Mcg as rand::SeedableRng>::seed_from_u64(7);
                let mut normal = || -> f64 { rand_distr::Distribution::sample(&rand_distr::StandardNormal, &mut rng) };
                // Blocks of one colour each.
                let block = |k: usize| (k / 3 % side / 8 + side / 8 * (k / 3 / side / 8)) as f64;
                let light = |k: usize| 90.0 + 60.0 * (block(k) * [0.618_034, 0.754_878, 0.569_840][k % 3] % 1.0);
                let pixels: Vec<u8> =
                    (0..3 * side * side).map(|k| (light(k) + noise * normal()).round() as u8).collect();
                let bytes = encoded(&pixels, side as u32, quality);
                let read = image::load_from_memory(&bytes).unwrap().into_rgb8().into_raw();
                let changes = change_of_variance(&bytes).unwrap();
                for c in 0..3 {
                    let square = |k: usize| (f64::from(read[k]) - light(k)).powi(2);
                    let found = (c..read.len()).step_by(3).map(square).sum::<f64>() / (side * side) as f64;
                    let stated = changes[(noise / NOISE_STEP) as usize][c] + noise * noise;
                    // 256 blocks of 64 coefficients: a mean square that few of them make is known to a tenth.
                    assert!((found / stated - 1.0).abs() < 0.2, "{quality} {noise} {c}: {found} {stated}");
                }
            }
        }
        assert_eq!(change_of_variance(b"\x89PNG"), None);
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
