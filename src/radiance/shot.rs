//! From the files of one shot to its radiance.

use super::{Exposure, Radiance, Sensor, merge};
use crate::Result;
use crate::capture::{Photograph, Rect, Sampling};

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

/// Decodes a shot and keeps all of it.
///
/// # Errors
/// Those of [`decode_shot`].
pub fn decode_whole(photographs: &[Photograph], size_px: [usize; 2]) -> Result<Bracket> {
    let whole = Rect { x: 0, y: 0, width: size_px[0], height: size_px[1] };
    let mut brackets = decode_shot(photographs, &[whole], size_px, &|_, _| {})?;
    brackets.pop().ok_or_else(|| crate::Error::internal("a shot decoded to nothing"))
}

/// Decodes a shot photograph by photograph and keeps the pixels in each of `rects`.
///
/// At any time one photograph is held whole, besides the crops. `decoded` is told each file's hash as it is read.
///
/// # Errors
/// Those of [`Photograph::decode`]; [`crate::Error::BrokenPhotograph`] when the decoded size is not that of the file's head.
pub fn decode_shot(
    photographs: &[Photograph],
    rects: &[Rect],
    size_px: [usize; 2],
    decoded: &(dyn Fn(&Photograph, blake3::Hash) + Sync),
) -> Result<Vec<Bracket>> {
    let mut brackets: Vec<Bracket> =
        rects.iter().map(|&rect| Bracket { rect, exposures: vec![], sampling: Sampling::WHOLE }).collect();
    for photograph in photographs {
        let pixels = photograph.decode()?;
        decoded(photograph, pixels.hash);
        if [pixels.width, pixels.height] != size_px {
            return Err(crate::Error::BrokenPhotograph {
                path: photograph.path.clone(),
                shot: photograph.shot.clone(),
                reason: format!("{} × {} px were decoded, its head says {size_px:?}", pixels.width, pixels.height),
            });
        }
        let whole = pixels.rect();
        for bracket in &mut brackets {
            let samples = pixels.samples.crop(whole, bracket.rect);
            bracket.sampling = pixels.sampling;
            bracket.exposures.push(Exposure { samples, secs: photograph.effective_secs });
        }
    }
    Ok(brackets)
}
