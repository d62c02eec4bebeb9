//! From the files of one shot to its radiance.

use super::{Exposure, Radiance, Sensor, merge};
use crate::Result;
use crate::capture::{Photograph, PhotographRows, Rect, Samples, Sampling};

/// A rectangle of a shot, decoded in all its exposures and not yet merged.
#[derive(Debug, Clone)]
pub struct Bracket {
    rect: Rect,
    exposures: Vec<Exposure>,
    sampling: Sampling,
}

impl Bracket {
    /// Merges the pixels of `part`, which must lie inside the bracket's rectangle.
    pub fn merge(&self, part: Rect, sensor: &Sensor) -> Radiance {
        let mut merged = if part == self.rect {
            merge(&self.exposures, part, sensor)
        } else {
            let crop = |e: &Exposure| Exposure { samples: e.samples.crop(self.rect, part), secs: e.secs };
            merge(&self.exposures.iter().map(crop).collect::<Vec<_>>(), part, sensor)
        };
        // The same share in every exposure leaves the weights as they are.
        if self.sampling.variance_share != [1.0; 3] {
            let share = self.sampling.variance_share.into_iter().cycle();
            merged.variance.iter_mut().zip(share).for_each(|(v, s)| *v *= s);
        }
        merged
    }

    /// Leaves out an exposure, which must be one of several.
    pub fn leave_out(&mut self, exposure: usize) {
        self.exposures.remove(exposure);
    }

    /// Where in its pixel each channel was measured.
    pub fn sampling(&self) -> Sampling {
        self.sampling
    }

    /// The exposures, shortest first.
    pub fn exposures(&self) -> &[Exposure] {
        &self.exposures
    }

    /// Corrects the exposure times by a factor each.
    pub fn scale_secs(&mut self, factors: &[f64]) {
        self.exposures.iter_mut().zip(factors).for_each(|(e, f)| e.secs *= f);
    }

    /// The rectangle.
    pub fn rect(&self) -> Rect {
        self.rect
    }
}

/// Decodes every so-manieth row of a shot, so that `most_px` pixels or fewer are kept: all that tells levels of light,
/// and nothing of where they are.
///
/// # Errors
/// Those of [`Photograph::decode_parts`].
pub fn decode_spread(photographs: &[Photograph], size_px: [usize; 2], most_px: usize) -> Result<Bracket> {
    let [width, height] = size_px;
    let step = (width * height).div_ceil(most_px.max(1)).max(1);
    let rect = Rect { x: 0, y: 0, width, height: height / step };
    let mut bracket = Bracket { rect, exposures: vec![], sampling: Sampling::WHOLE };
    let mut row = Samples::U8(vec![]);
    for photograph in photographs {
        let mut rows = photograph.open()?;
        rows.check_size(size_px)?;
        let mut samples = Samples::U8(vec![]);
        for _ in 0..rect.height {
            rows.skip(step / 2)?;
            rows.read(1, &mut row)?;
            rows.skip(step - step / 2 - 1)?;
            samples.extend(&row, 0..row.len());
        }
        rows.finish()?;
        bracket.sampling = rows.sampling();
        bracket.exposures.push(Exposure { samples, secs: photograph.effective_secs });
    }
    Ok(bracket)
}

/// Decodes a shot photograph by photograph and keeps the pixels in each of `rects`: of the rest a few rows at a time
/// are in memory.
///
/// # Errors
/// Those of [`Photograph::decode_parts`].
pub fn decode_shot(photographs: &[Photograph], rects: &[Rect], size_px: [usize; 2]) -> Result<Vec<Bracket>> {
    let mut brackets: Vec<Bracket> =
        rects.iter().map(|&rect| Bracket { rect, exposures: vec![], sampling: Sampling::WHOLE }).collect();
    for photograph in photographs {
        let (parts, sampling) = photograph.decode_parts(rects, size_px)?;
        for (bracket, samples) in brackets.iter_mut().zip(parts) {
            bracket.sampling = sampling;
            bracket.exposures.push(Exposure { samples, secs: photograph.effective_secs });
        }
    }
    Ok(brackets)
}

/// Rows that are merged at a time: a megabyte or so of each exposure.
const MERGED_ROWS: usize = 16;

/// The merged picture of a shot, some rows of all its photographs at a time.
///
/// # Errors
/// Those of [`Photograph::decode_parts`].
pub fn merge_shot(photographs: &[Photograph], size_px: [usize; 2], sensor: &Sensor) -> Result<Radiance> {
    merge_keeping(photographs, size_px, sensor, 0).map(|(merged, _)| merged)
}

/// The same, and beside it rows of all photographs that are spread over the shot, `most_px` pixels or fewer, as
/// [`decode_spread`] has them.
///
/// # Errors
/// Those of [`Photograph::decode_parts`].
pub fn merge_keeping(
    photographs: &[Photograph],
    size_px: [usize; 2],
    sensor: &Sensor,
    most_px: usize,
) -> Result<(Radiance, Bracket)> {
    let [width, height] = size_px;
    let n = 3 * width * height;
    let mut merged = Radiance {
        rect: Rect { x: 0, y: 0, width, height },
        value: Vec::with_capacity(n),
        variance: Vec::with_capacity(n),
        used: Vec::with_capacity(n),
    };
    let mut open = photographs.iter().map(Photograph::open).collect::<Result<Vec<_>>>()?;
    open.iter().try_for_each(|rows| rows.check_size(size_px))?;
    let secs = photographs.iter().map(|p| p.effective_secs);
    let exposures: Vec<_> = secs.map(|secs| Exposure { samples: Samples::U8(vec![]), secs }).collect();
    let sampling = open.first().map_or(Sampling::WHOLE, PhotographRows::sampling);
    let mut band = Bracket { rect: merged.rect, exposures, sampling };
    let step = (width * height).div_ceil(most_px.max(1)).max(1);
    let rect = Rect { height: if most_px == 0 { 0 } else { height / step }, ..merged.rect };
    let mut kept = Bracket { rect, ..band.clone() };
    for y in (0..height).step_by(MERGED_ROWS) {
        band.rect = Rect { x: 0, y, width, height: MERGED_ROWS.min(height - y) };
        for ((rows, exposure), kept) in open.iter_mut().zip(&mut band.exposures).zip(&mut kept.exposures) {
            rows.read(band.rect.height, &mut exposure.samples)?;
            for row in (y..y + band.rect.height).filter(|row| row % step == step / 2 && row / step < rect.height) {
                kept.samples.extend(&exposure.samples, 3 * width * (row - y)..3 * width * (row - y + 1));
            }
        }
        let part = band.merge(band.rect, sensor);
        merged.value.extend(part.value);
        merged.variance.extend(part.variance);
        merged.used.extend(part.used);
    }
    open.iter_mut().try_for_each(PhotographRows::finish)?;
    Ok((merged, kept))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Noise, Samples};
    use crate::radiance::FileNoise;

    const SIZE_PX: [usize; 2] = [13, 8];

    fn sensor() -> Sensor {
        let noise =
            Noise { black_dn: 100.0, saturation_dn: 60_000.0, gain_dn_per_electron: 0.5, read_noise_electrons: 4.0 };
        Sensor::with_curve(&noise, None, FileNoise::default())
    }

    /// Different at every pixel and channel.
    fn code(x: usize, y: usize, c: usize) -> u16 {
        (100 + 1000 * c + 50 * x + 7 * y) as u16
    }

    fn bracket(rect: Rect, secs: &[f64], variance_share: [f32; 3]) -> Bracket {
        let at = |k: usize| code(rect.x + k / 3 % rect.width, rect.y + k / 3 / rect.width, k % 3);
        let samples = Samples::U16((0..3 * rect.area()).map(at).collect());
        let exposures = secs.iter().map(|&secs| Exposure { samples: samples.clone(), secs }).collect();
        Bracket { rect, exposures, sampling: Sampling { variance_share, ..Sampling::WHOLE } }
    }

    #[test]
    fn a_part_of_a_bracket_is_merged_from_its_own_pixels() {
        let whole = bracket(Rect { x: 7, y: 3, width: 5, height: 4 }, &[0.25], [1.0; 3]);
        for part in [Rect { x: 9, y: 4, width: 2, height: 3 }, whole.rect()] {
            let merged = whole.merge(part, &sensor());
            assert_eq!(merged.rect, part);
            for (k, value) in merged.value.iter().enumerate() {
                let (x, y) = (part.x + k / 3 % part.width, part.y + k / 3 / part.width);
                // Small whole numbers over a quarter: exact, but for the division of sums.
                let expected = f32::from(code(x, y, k % 3) - 100) * 4.0;
                assert!((value - expected).abs() <= 1e-6 * expected, "{x} {y}: {value} {expected}");
            }
        }
    }

    #[test]
    fn channels_that_are_means_of_photosites_have_their_share_of_the_variance() {
        let part = Rect { x: 9, y: 4, width: 2, height: 3 };
        let share = [1.0, 0.5, 0.2];
        let of = |share| bracket(Rect { x: 7, y: 3, width: 5, height: 4 }, &[0.25, 0.5], share).merge(part, &sensor());
        let (whole, shared) = (of([1.0; 3]), of(share));
        assert_eq!(shared.value, whole.value);
        for (k, (v, w)) in shared.variance.iter().zip(&whole.variance).enumerate() {
            assert_eq!(*v, w * share[k % 3], "{k}");
        }
    }

    #[test]
    fn each_exposure_time_is_corrected_by_its_own_factor() {
        let mut bracket = bracket(Rect { x: 1, y: 2, width: 2, height: 3 }, &[0.1, 0.4], [1.0; 3]);
        bracket.scale_secs(&[1.1, 0.9]);
        let secs: Vec<f64> = bracket.exposures().iter().map(|e| e.secs).collect();
        // f64.
        assert!((secs[0] - 0.11).abs() < 1e-12 && (secs[1] - 0.36).abs() < 1e-12, "{secs:?}");
    }

    fn photograph(dir: &std::path::Path, name: &str, size: [usize; 2], add: u16) -> Photograph {
        let path = dir.join(name);
        let picture = image::ImageBuffer::from_fn(size[0] as u32, size[1] as u32, |x, y| {
            image::Rgb([0, 1, 2].map(|c| code(x as usize, y as usize, c) + add))
        });
        picture.save(&path).unwrap();
        // What counts is the exposure at the first photograph's aperture and ISO, four times the shutter's here.
        let secs = f64::from(add);
        Photograph { effective_secs: 4.0 * secs, ..Photograph::new(path, "lattice-3", secs) }
    }

    #[test]
    fn a_shot_is_decoded_to_the_pixels_of_each_rectangle_at_its_effective_exposures() {
        let dir = tempfile::tempdir().unwrap();
        let photographs = [photograph(dir.path(), "a.png", SIZE_PX, 1), photograph(dir.path(), "b.png", SIZE_PX, 3)];
        let rects = [Rect { x: 8, y: 1, width: 5, height: 2 }, Rect { x: 0, y: 5, width: 3, height: 3 }];
        let brackets = decode_shot(&photographs, &rects, SIZE_PX).unwrap();
        assert_eq!(brackets.iter().map(Bracket::rect).collect::<Vec<_>>(), rects);
        for (bracket, rect) in brackets.iter().zip(rects) {
            assert_eq!(bracket.sampling(), Sampling::WHOLE);
            for (exposure, add) in bracket.exposures().iter().zip([1, 3]) {
                assert_eq!(exposure.secs, 4.0 * f64::from(add));
                let at = |k: usize| code(rect.x + k / 3 % rect.width, rect.y + k / 3 / rect.width, k % 3) + add;
                assert_eq!(exposure.samples, Samples::U16((0..3 * rect.area()).map(at).collect()));
            }
        }
        for photograph in &photographs {
            assert_eq!(photograph.hash().unwrap(), blake3::hash(&std::fs::read(&photograph.path).unwrap()));
        }
    }

    #[test]
    fn a_shot_is_merged_by_rows_as_it_is_as_a_whole() {
        let dir = tempfile::tempdir().unwrap();
        // More rows than are merged at a time, and no whole number of them.
        let size = [5, 2 * MERGED_ROWS + 7];
        let photographs = [photograph(dir.path(), "a.png", size, 1), photograph(dir.path(), "b.png", size, 3)];
        let whole = Rect { x: 0, y: 0, width: size[0], height: size[1] };
        let expected = decode_shot(&photographs, &[whole], size).unwrap()[0].merge(whole, &sensor());
        assert_eq!(merge_shot(&photographs, size, &sensor()).unwrap(), expected);
    }

    #[test]
    fn rows_that_are_kept_while_merging_are_those_that_are_spread_over_the_shot() {
        let dir = tempfile::tempdir().unwrap();
        let photographs = [photograph(dir.path(), "a.png", [5, 41], 2), photograph(dir.path(), "b.png", [5, 41], 4)];
        let (merged, kept) = merge_keeping(&photographs, [5, 41], &sensor(), 60).unwrap();
        assert_eq!(merged, merge_shot(&photographs, [5, 41], &sensor()).unwrap());
        let expected = decode_spread(&photographs, [5, 41], 60).unwrap();
        assert_eq!(kept.rect(), expected.rect());
        for (k, e) in kept.exposures().iter().zip(expected.exposures()) {
            assert_eq!((&k.samples, k.secs), (&e.samples, e.secs));
        }
    }

    #[test]
    fn rows_spread_over_a_shot_are_its_own() {
        let dir = tempfile::tempdir().unwrap();
        let photographs = [photograph(dir.path(), "a.png", [5, 41], 2)];
        // 205 pixels in 60: every fourth row, from the third on.
        let found = decode_spread(&photographs, [5, 41], 60).unwrap();
        assert_eq!(found.rect(), Rect { x: 0, y: 0, width: 5, height: 10 });
        let at = |k: usize| code(k / 3 % 5, 4 * (k / 15) + 2, k % 3) + 2;
        assert_eq!(found.exposures()[0].samples, Samples::U16((0..150).map(at).collect()));
        let all = decode_spread(&photographs, [5, 41], 205).unwrap();
        assert_eq!(all.exposures()[0].samples.len(), 3 * 205);
    }

    #[test]
    fn a_photograph_of_another_size_is_broken() {
        let dir = tempfile::tempdir().unwrap();
        // Turned by a quarter: as many pixels.
        let photographs = [photograph(dir.path(), "a.png", [8, 13], 1)];
        let whole = Rect { x: 0, y: 0, width: 13, height: 8 };
        for refused in [
            decode_shot(&photographs, &[whole], SIZE_PX).map(|_| ()),
            merge_shot(&photographs, SIZE_PX, &sensor()).map(|_| ()),
            decode_spread(&photographs, SIZE_PX, 1000).map(|_| ()),
        ] {
            let refused = refused.unwrap_err();
            assert!(
                matches!(&refused, crate::Error::BrokenPhotograph { shot, .. } if shot == "lattice-3"),
                "{refused}"
            );
        }
    }
}
