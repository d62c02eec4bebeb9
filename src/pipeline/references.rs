//! The shots that every lattice shot is measured against: black, and the white reference.

use super::photographs::Photographs;
use super::register::{Registered, SUM_STEP};
use crate::capture::Pattern;
use crate::progress::Progress;
use crate::radiance::{HotPixel, Radiance, find_hot_pixels, mend};
use crate::response::Irradiance;
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Pixels this bright, of the brightest, are lit.
const LIT_SHARE: f32 = 0.3;

/// Ambient light and irradiance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct References {
    /// What the camera sees of the sample without dots.
    pub ambient: Radiance,
    pub hot: Vec<HotPixel>,
    pub irradiance: Irradiance,
    /// Relative variance of the white reference's light that flicker leaves, when it was measured.
    pub white_variance: Option<f64>,
}

/// Reads black and white.
///
/// # Errors
/// Those of decoding.
pub(super) fn references(
    photographs: &Photographs<'_>,
    registered: &Registered,
    flicker_sd: Option<f64>,
    progress: &Progress,
) -> Result<References> {
    let stage = progress.stage("reference", 3);
    let shots = [
        photographs.one(|p| matches!(p, Pattern::SampleBlack))?,
        photographs.one(|p| matches!(p, Pattern::ReferenceWhite))?,
        photographs.one(|p| matches!(p, Pattern::ReferenceBlack))?,
    ];
    let mut merged: Vec<Radiance> =
        shots.par_iter().map(|&s| photographs.merge_whole(s).inspect(|_| stage.advance(1))).collect::<Result<_>>()?;
    let (Some(black), Some(mut white), Some(mut ambient)) = (merged.pop(), merged.pop(), merged.pop()) else {
        return Err(Error::internal("three shots merged to fewer"));
    };
    let white_variance = flicker_sd.and_then(|_| steady_white(&registered.sums, &mut white, &black));
    white.subtract(&black);
    let hot = find_hot_pixels(&ambient);
    mend(&mut white, &hot);
    let cell_px = registered.registration.px_per_mm() * photographs.capture.manifest.window.pitch_mm;
    let irradiance = Irradiance::new(white, &photographs.capture.rig, cell_px.round().clamp(2.0, 50.0) as usize);
    if let Some(sd) = flicker_sd {
        // One shot's lamp, the same error in all pixels of a cell: that many times what averaging them would leave.
        let share = sd * sd / photographs.brackets[shots[0]].len() as f64 * cell_px * cell_px;
        let values = ambient.variance.iter_mut().zip(&ambient.value);
        values.for_each(|(variance, value)| *variance += share as f32 * value * value);
    }
    Ok(References { ambient, hot, irradiance, white_variance })
}

/// Scales the white reference to the lamp's mean over the Gray-code shots: each with its inverse adds up to white and black. Returns the
/// relative variance that remains; `None`, and nothing done, with fewer than three such sums.
///
/// The median over pixels, so that those that some exposure did not measure do not matter.
fn steady_white(sums: &[Vec<f32>], white: &mut Radiance, black: &Radiance) -> Option<f64> {
    let (light, dark) = (white.luminance(), black.luminance());
    let brightest = light.iter().copied().fold(0.0, f32::max);
    let lit: Vec<usize> = (0..light.len()).step_by(SUM_STEP).filter(|&p| light[p] > LIT_SHARE * brightest).collect();
    let ratio = |sum: &Vec<f32>| {
        let mut all: Vec<f32> = lit.iter().map(|&p| (sum[p / SUM_STEP] - dark[p]) / light[p]).collect();
        let middle = all.len() / 2;
        (!all.is_empty()).then(|| f64::from(*all.select_nth_unstable_by(middle, f32::total_cmp).1))
    };
    let ratios: Vec<f64> = sums.iter().map(ratio).collect::<Option<_>>()?;
    let n = ratios.len() as f64;
    if ratios.len() < 3 {
        return None;
    }
    let mean = ratios.iter().sum::<f64>() / n;
    let variance = ratios.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (n - 1.0) / n;
    // A tenth is no flicker: something else differs.
    if !((mean - 1.0).abs() < 0.1) {
        return None;
    }
    white.value.iter_mut().for_each(|v| *v *= mean as f32);
    white.variance.iter_mut().for_each(|v| *v *= (mean * mean) as f32);
    Some(variance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;

    const BLACK: f32 = 3.0;

    /// The white of a pixel: no two alike, three channels apart; every fourth is not lit.
    fn light(p: usize) -> f32 {
        if p % 4 == 2 { 8.0 } else { 60.0 + p as f32 }
    }

    fn picture(of: impl Fn(usize) -> f32, variance: f32) -> Radiance {
        let rect = Rect { x: 0, y: 0, width: 17, height: 11 };
        // The luminance of each is `of`, which channels share unevenly.
        let value = (0..187).flat_map(|p| [0.5, 0.9, 1.6].map(|c| c * of(p))).collect();
        Radiance { rect, value, variance: vec![variance; 561], used: vec![1; 561] }
    }

    /// What the lamp at `levels` makes of the sums of pattern and inverse.
    fn steadied(levels: &[f32]) -> (Radiance, Option<f64>) {
        // White is seen with the black; a sum holds it twice.
        let sum = |level: &f32| {
            (0..187).step_by(SUM_STEP).map(|p| (light(p) * level + BLACK) * if p == 26 { 40.0 } else { 1.0 }).collect()
        };
        let sums: Vec<Vec<f32>> = levels.iter().map(sum).collect();
        let mut white = picture(light, 2.0);
        let variance = steady_white(&sums, &mut white, &picture(|_| BLACK, 1.0));
        (white, variance)
    }

    #[test]
    fn the_white_reference_is_brought_to_the_lamps_mean_over_the_gray_code() {
        let (white, variance) = steadied(&[1.02, 1.05, 0.99, 1.06]);
        // Mean 1.03; of four deviations −1, 2, −4, 3 per cent, Σ² / 3 / 4. One pixel that is wrong in all of them is not the median's.
        assert!((variance.unwrap() / (30e-4 / 12.0) - 1.0).abs() < 1e-3, "{variance:?}");
        for (found, before) in white.value.iter().zip(picture(light, 2.0).value) {
            // f32.
            assert!((found / before - 1.03).abs() < 1e-5);
        }
        assert!(white.variance.iter().all(|v| (v / 2.0 - 1.03 * 1.03).abs() < 1e-5));
    }

    #[test]
    fn fewer_than_three_sums_or_a_tenth_of_difference_leave_the_white_reference_as_it_is() {
        for levels in [&[1.02f32, 1.05][..], &[1.2, 1.1, 1.15], &[0.85, 0.8, 0.9], &[]] {
            let (white, variance) = steadied(levels);
            assert_eq!((white, variance), (picture(light, 2.0), None), "{levels:?}");
        }
        assert!(steadied(&[1.09, 1.08, 1.1]).1.is_some());
    }
}
