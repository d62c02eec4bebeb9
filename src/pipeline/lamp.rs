//! A second white reference, after the lattice shots: how the lamp has changed between the two.

use super::BuildOptions;
use super::photographs::Photographs;
use super::references::lit_places;
use crate::capture::Pattern;
use crate::radiance::Radiance;
use crate::registration::scaled_deviation;
use crate::warning::bounds::REFUSED_LEVEL;
use crate::{ConsistencyWarning, Result, Warning};
use serde::{Deserialize, Serialize};

/// The lamp between two white references.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct LampBetween {
    /// The two shots, in the order of shooting.
    shots: [usize; 2],
    /// Logarithm of the second's light over the first's, and its standard deviation.
    log_level: [f64; 2],
}

/// A change is told from this on, and from so many of its standard deviations.
const LEAST_LEVEL: f64 = 0.005;
const LEVEL_SIGMA: f64 = 6.0;
/// What a lamp between two moments is off the straight line between them by, over what it changes by: an exponential
/// approach that has one time constant between the two is off by 0.12 at most, one that has three by 0.32.
const NOT_STRAIGHT: f64 = 0.2;

impl LampBetween {
    /// From both shots, the first without black; `None` where there is no second, or too little of it is lit.
    ///
    /// # Errors
    /// Those of decoding; [`crate::Error::Contradiction`] for a change that no lamp makes.
    pub(super) fn measure(
        photographs: &Photographs<'_>,
        white: &Radiance,
        black: &Radiance,
        flicker_sd: Option<f64>,
        options: &BuildOptions,
    ) -> Result<Option<(Self, Option<Warning>)>> {
        let shots = photographs.capture.shots(|p| matches!(p, Pattern::ReferenceWhite));
        let &[first, second] = shots.as_slice() else { return Ok(None) };
        let mut after = photographs.merge_whole(second)?;
        after.subtract(black);
        let Some([level, scatter_sd]) = ratio(white, &after) else { return Ok(None) };
        // Each of the photographs of both flickers.
        let n = photographs.brackets[first].len().min(photographs.brackets[second].len()).max(1) as f64;
        let level_sd = scatter_sd.hypot(level * flicker_sd.unwrap_or(0.0) * (2.0 / n).sqrt());
        let lamp = Self { shots: [first, second], log_level: [level.ln(), level_sd / level] };
        let off = (level - 1.0).abs();
        if off <= LEAST_LEVEL.max(LEVEL_SIGMA * level_sd) {
            return Ok(Some((lamp, None)));
        }
        let used = photographs.capture.manifest.reference_dots.is_none();
        let shot = photographs.name(second).to_owned();
        let finding = ConsistencyWarning::WhiteChanged { shot, level, level_sd, used };
        let told = if off > REFUSED_LEVEL { options.refuse(finding)? } else { finding.into() };
        Ok(Some((lamp, Some(told))))
    }

    /// The lamp at a shot over that of the first white reference, and the relative variance of that.
    pub(super) fn at(&self, shot: usize) -> [f64; 2] {
        let [first, second] = self.shots.map(|s| s as f64);
        let share = ((shot as f64 - first) / (second - first)).clamp(0.0, 1.0);
        let [level, sd] = self.log_level;
        let bent = NOT_STRAIGHT * level * 4.0 * share * (1.0 - share);
        [(share * level).exp(), (share * sd).powi(2) + bent * bent]
    }
}

/// The median over lit pixels of one picture over another, and the standard deviation of the median; `None` with few
/// that both measured.
fn ratio(before: &Radiance, after: &Radiance) -> Option<[f64; 2]> {
    let (a, b) = (before.luminance(), after.luminance());
    let used = |p: usize| [before, after].iter().all(|r| !r.used[3 * p..3 * p + 3].contains(&0));
    let mut ratios: Vec<f64> = lit_places(&a).filter(|&p| used(p)).map(|p| f64::from(b[p] / a[p])).collect();
    let n = ratios.len();
    if n < 30 {
        return None;
    }
    ratios.sort_by(f64::total_cmp);
    let middle = ratios[n / 2];
    // Of a normal distribution the median scatters by √(π/2) more than the mean.
    let sd = scaled_deviation(ratios.iter().copied(), middle) * (std::f64::consts::FRAC_PI_2 / n as f64).sqrt();
    (middle > 0.0).then_some([middle, sd])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;

    #[test]
    fn the_lamp_goes_evenly_from_the_first_white_reference_to_the_second() {
        let lamp = LampBetween { shots: [3, 13], log_level: [0.9f64.ln(), 0.001] };
        assert_eq!((lamp.at(0), lamp.at(3)), ([1.0, 0.0], [1.0, 0.0]));
        let [level, variance] = lamp.at(8);
        // Halfway: the root of 0.9, half of the deviation, and a fifth of what it changes by.
        assert!((level - 0.9f64.sqrt()).abs() < 1e-12);
        let expected = 0.0005f64.powi(2) + (0.2 * 0.9f64.ln()).powi(2);
        assert!((variance / expected - 1.0).abs() < 1e-12, "{variance}");
        assert!((lamp.at(13)[0] - 0.9).abs() < 1e-12 && (lamp.at(20)[0] - 0.9).abs() < 1e-12);
        // Shot before the lattice and after it, in the other order of the manifest.
        let turned = LampBetween { shots: [13, 3], ..lamp };
        assert!((turned.at(3)[0] - 0.9).abs() < 1e-12 && turned.at(13)[0] == 1.0);
    }

    #[test]
    fn the_level_is_the_median_over_lit_pixels() {
        let picture = |of: &dyn Fn(usize) -> f32| {
            let rect = Rect { x: 0, y: 0, width: 60, height: 50 };
            let value = (0..3000).flat_map(|p| [0.5, 0.9, 1.6].map(|c| c * of(p))).collect();
            Radiance { rect, value, variance: vec![1.0; 9000], used: vec![1; 9000] }
        };
        let light = |p: usize| if p % 4 == 2 { 2.0 } else { 60.0 + (p % 37) as f32 };
        // One lit pixel in a hundred is covered by something; unlit ones are whatever they like.
        let after = |p: usize| {
            light(p)
                * if p % 4 == 2 {
                    9.0
                } else if p % 100 == 13 {
                    0.1
                } else {
                    0.93
                }
        };
        let [level, sd] = ratio(&picture(&light), &picture(&after)).unwrap();
        assert!((level - 0.93).abs() < 1e-5 && sd < 1e-5, "{level} {sd}");
        assert_eq!(ratio(&picture(&|_| 0.0), &picture(&after)), None);
    }
}
