//! Camera raw files: the mosaic itself, never a preview, read at half size.

use super::samples::{Samples, Sampling};
use rawler::rawimage::{RawImage, RawPhotometricInterpretation};
use rawler::rawsource::RawSource;

/// Decodes a Bayer mosaic at half its size: R, the mean of the two G, and B of each 2 × 2 block, black subtracted.
///
/// Black and white levels are the file's, those of each place in the mosaic. A photosite at or above its white level is
/// +∞, and so is a mean of which one is. Where in its block each channel was sampled is in the [`Sampling`]. Nothing is
/// demosaiced, scaled by the white balance or turned.
///
/// # Errors
/// In words: a file that the reader does not know or that is damaged, a mosaic that is not 2 × 2 of R, G, G, B.
pub(super) fn decode(bytes: &[u8]) -> Result<(usize, usize, Samples, Sampling), String> {
    let image = open(bytes, false)?;
    let mosaic = Mosaic::of(&image)?;
    let [width, height] = mosaic.blocks;
    if image.data.as_f32().len() < image.width * image.height {
        return Err("fewer code values than photosites".into());
    }
    let data = image.data.as_f32();
    let light = |block: [usize; 2], place: usize| {
        let (x, y) = (mosaic.first[0] + 2 * block[0] + place % 2, mosaic.first[1] + 2 * block[1] + place / 2);
        let code = data[y * image.width + x];
        if code >= mosaic.white { f32::INFINITY } else { code - mosaic.black[place] }
    };
    let mut samples = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        for x in 0..width {
            let of = |channel: usize| light([x, y], mosaic.places[channel]);
            samples.extend([of(0), 0.5 * (of(1) + of(3)), of(2)]);
        }
    }
    Ok((width, height, Samples::F32(samples), mosaic.sampling()))
}

/// Width and height of what [`decode`] gives, without decoding.
///
/// # Errors
/// As [`decode`].
pub(super) fn size_px(bytes: &[u8]) -> Result<[usize; 2], String> {
    Ok(Mosaic::of(&open(bytes, true)?)?.blocks)
}

fn open(bytes: &[u8], head_only: bool) -> Result<RawImage, String> {
    let source = RawSource::new_from_slice(bytes);
    // The reader panics on files that it does not expect.
    let read = std::panic::catch_unwind(|| {
        let decoder = rawler::get_decoder(&source).map_err(|e| e.to_string())?;
        decoder.raw_image(&source, &Default::default(), head_only).map_err(|e| e.to_string())
    });
    read.unwrap_or_else(|_| Err("the raw reader gave up on it".into()))
}

/// The part of a sensor that sees light, in blocks of the colour filter.
struct Mosaic {
    /// Column and row of the first photosite.
    first: [usize; 2],
    blocks: [usize; 2],
    /// Place in the block (row by row) of R, G, B and the other G.
    places: [usize; 4],
    /// Of each place in the block.
    black: [f32; 4],
    white: f32,
}

impl Mosaic {
    fn of(image: &RawImage) -> Result<Self, String> {
        let RawPhotometricInterpretation::Cfa(config) = &image.photometric else {
            return Err("no mosaic of a colour filter in the file".into());
        };
        if image.cpp != 1 || (config.cfa.width, config.cfa.height) != (2, 2) {
            return Err(format!(
                "a mosaic of {} × {} colours: only 2 × 2 are read",
                config.cfa.width, config.cfa.height
            ));
        }
        let (first, size) = match image.active_area {
            Some(area) => ([area.p.x, area.p.y], [area.d.w, area.d.h]),
            None => ([0, 0], [image.width, image.height]),
        };
        let fits = first[0] + size[0] <= image.width && first[1] + size[1] <= image.height;
        let blocks = size.map(|s| s / 2);
        if !fits || blocks.contains(&0) {
            return Err("an active area outside the sensor".into());
        }
        let colors: [usize; 4] = std::array::from_fn(|k| config.cfa.color_at(first[1] + k / 2, first[0] + k % 2));
        let all = |color: usize| (0..4).filter(move |&k| colors[k] == color);
        let (mut red, mut green, mut blue) = (all(0), all(1), all(2));
        let found = (red.next(), green.next(), blue.next(), green.next());
        let (Some(r), Some(g), Some(b), Some(other)) = found else {
            return Err(format!("a mosaic of the colours {colors:?}: one R, two G and one B are needed"));
        };
        // Levels repeat from the first photosite that sees light in DNG (1.7, BlackLevel), in other files from the
        // sensor's first.
        let from = if image.camera.mode == "dng" { [0, 0] } else { first };
        let (w, h) = (image.blacklevel.width.max(1), image.blacklevel.height.max(1));
        let levels = image.blacklevel.as_vec();
        let level = |k: usize| {
            levels.get((from[1] + k / 2) % h * w + (from[0] + k % 2) % w).or(levels.first()).copied().unwrap_or(0.0)
        };
        // The least of them: which is whose, files do not agree upon.
        let white = image.whitelevel.as_vec().into_iter().fold(f32::INFINITY, f32::min);
        let black = std::array::from_fn(level);
        Ok(Self { first, blocks, places: [r, g, b, other], black, white })
    }

    /// A pixel of the half-size picture is 2 photosites wide; its centre is that of the block.
    fn sampling(&self) -> Sampling {
        let offset = |place: usize| [(place % 2) as f64 - 0.5, (place / 2) as f64 - 0.5].map(|o| 0.5 * o);
        let [r, g, b, other] = self.places.map(offset);
        let middle = [0, 1].map(|a| 0.5 * (g[a] + other[a]));
        Sampling { offset_px: [r, middle, b], aperture_px: [0.5, 1.0, 0.5], variance_share: [1.0, 0.5, 1.0] }
    }
}
