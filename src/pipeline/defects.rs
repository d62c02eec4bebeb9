//! Hot photosites of a camera whose pixels are averaged: found before that, and left out of the means.

use super::Working;
use crate::Result;
use crate::capture::{Capture, Noise, Pattern, Rect, Reduction, Samples};
use crate::progress::Progress;
use crate::radiance::{Exposure, HotPixel, Sensor, find_hot_pixels, merge};

/// Rows that are looked at together, with one more above and below.
const ROWS: usize = 64;

/// The hot photosites in the longest exposure of a covered lens, else of the dark sample, in order of row, column, channel; none where nothing
/// is averaged.
///
/// Left out of every photograph alike, they bias no mean: which are left out depends on no photograph's own light.
///
/// # Errors
/// Those of decoding.
pub(super) fn find(capture: &Capture, sensor: &Sensor, working: Working, progress: &Progress) -> Result<Vec<HotPixel>> {
    let first = |of: fn(&Pattern) -> bool| capture.shots(of).into_iter().next();
    let dark = first(|p| matches!(p, Pattern::Dark)).or_else(|| first(|p| matches!(p, Pattern::SampleBlack)));
    let Some(longest) = dark.filter(|_| working.factor > 1).and_then(|shot| capture.brackets[shot].last()) else {
        return Ok(vec![]);
    };
    let [width, height] = capture.rig.camera.size_px;
    let stage = progress.stage("hot pixels", height);
    let mut rows = longest.open()?;
    rows.check_size([width, height])?;
    let (mut band, mut next) = (Samples::U8(vec![]), Samples::U8(vec![]));
    let (mut first, mut read) = (0, 0);
    let mut found = Vec::new();
    while read < height {
        let n = ROWS.min(height - read);
        rows.read(n, &mut next)?;
        stage.advance(n);
        band.extend(&next, 0..next.len());
        read += n;
        let rect = Rect { x: 0, y: first, width, height: read - first };
        let exposure =
            Exposure { samples: std::mem::replace(&mut band, Samples::U8(vec![])), secs: longest.effective_secs };
        let seen = merge(std::slice::from_ref(&exposure), rect, sensor);
        found.extend(find_hot_pixels(&seen));
        // The last row has no neighbours yet: it is looked at with the next ones, and the row above it is one.
        first = read.saturating_sub(2);
        band.extend(&exposure.samples, 3 * width * (rect.height - (read - first))..exposure.samples.len());
    }
    Ok(found)
}

/// By blocks of the working resolution, of which saturated photosites and `defects` are left out.
pub(super) fn reduction(working: Working, noise: &Noise, sensor: &Sensor, defects: &[HotPixel]) -> Reduction {
    let left_out = defects.iter().map(|h| [h.at[1], h.at[0], h.at[2]].map(|v| v as u32)).collect();
    let by = Reduction::new(working.factor, noise.saturation_dn, sensor.light_of_codes());
    Reduction { left_out, sample_px: working.px_per_sample.unwrap_or(by.sample_px), ..by }
}

#[cfg(test)]
mod tests {
    use super::super::tests::capture;
    use super::*;
    use crate::radiance::FileNoise;

    #[test]
    fn hot_photosites_are_found_once_in_whichever_rows_they_lie() {
        let dir = tempfile::tempdir().unwrap();
        let mut capture = capture(&[(Pattern::SampleBlack, &[0.1, 0.4])]);
        let [width, height] = [37, 2 * ROWS + 5];
        capture.rig.camera.size_px = [width, height];
        // Rows where bands meet; one saturates, and one is on the rim, where nothing is told.
        let sites =
            [[5, 1, 0], [7, ROWS - 2, 1], [9, ROWS - 1, 2], [11, ROWS, 0], [30, ROWS + 1, 1], [20, 2 * ROWS, 2]];
        let picture = image::ImageBuffer::from_fn(width as u32, height as u32, |x, y| {
            let at = |c: usize| [x as usize, y as usize, c];
            image::Rgb([0, 1, 2].map(|c| match at(c) {
                [30, _, 1] if sites.contains(&at(c)) => 4050u16,
                site if sites.contains(&site) || site == [0, 9, 1] => 900,
                // Noise of a few code values.
                [x, y, c] => 150 + ((7 * x + 11 * y + 3 * c) % 5) as u16,
            }))
        });
        let path = dir.path().join("dark.png");
        picture.save(&path).unwrap();
        capture.brackets[0].iter_mut().for_each(|p| p.path = path.clone());
        let noise = capture.rig.noise.clone().unwrap();
        let sensor = Sensor::with_curve(&noise, None, FileNoise::default());
        let find =
            |factor| find(&capture, &sensor, Working { factor, px_per_sample: None }, &Progress::silent()).unwrap();
        let found = find(3);
        assert_eq!(found.iter().map(|h| h.at).collect::<Vec<_>>(), sites);
        assert!(found.iter().all(|h| h.excess.is_none() == (h.at[0] == 30)), "{found:?}");
        assert!(find(1).is_empty(), "nothing is averaged");
    }
}
