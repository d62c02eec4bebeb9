//! From the files of one shot to its radiance.

use super::{Exposure, Radiance, Sensor, merge};
use crate::Result;
use crate::capture::{Photograph, Rect};

/// Decodes a bracket photograph by photograph and merges the pixels in each of `rects`.
///
/// At any time one photograph is held whole, besides the crops. `decoded` is told each file's hash as it is read.
///
/// # Errors
/// Those of [`Photograph::decode`]; [`crate::Error::BrokenPhotograph`] when the decoded size is not that of the file's head.
pub fn merge_shot(
    bracket: &[Photograph],
    rects: &[Rect],
    size_px: [usize; 2],
    sensor: &Sensor,
    decoded: &(dyn Fn(&Photograph, blake3::Hash) + Sync),
) -> Result<Vec<Radiance>> {
    let mut crops: Vec<Vec<Exposure>> = vec![Vec::with_capacity(bracket.len()); rects.len()];
    for photograph in bracket {
        let pixels = photograph.decode()?;
        decoded(photograph, pixels.hash);
        if [pixels.width, pixels.height] != size_px {
            return Err(crate::Error::BrokenPhotograph {
                path: photograph.path.clone(),
                shot: photograph.shot.clone(),
                reason: format!("{} × {} px were decoded, its head says {size_px:?}", pixels.width, pixels.height),
            });
        }
        for (crop, &rect) in crops.iter_mut().zip(rects) {
            crop.push(Exposure { samples: pixels.crop(rect), secs: photograph.effective_secs });
        }
    }
    Ok(crops.iter().zip(rects).map(|(bracket, &rect)| merge(bracket, rect, sensor)).collect())
}
