//! How responses fall with the distance from where they are largest: what offset factors are divided by before they are
//! quantized, so that little of the light far away is lost.

use super::entropy::Bits;
use super::exact::raw;

/// Errors are weighed by the response to minus this power, as in the fit of `joint` (`--profile-power`).
const POWER: f64 = 0.25;
/// Distances at which the logarithm is kept, samples.
const RADII: [f64; 14] = [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0];
/// Steps of the natural logarithm.
const STEPS: f64 = 16.0;
const BITS: u32 = 8;

/// −ln of the falloff by distance, in steps, from a sample of the common window.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Falloff {
    middle: [usize; 2],
    knots: [u8; RADII.len()],
}

impl Falloff {
    /// No falloff: all samples alike.
    pub(super) fn none() -> Self {
        Self { middle: [0; 2], knots: [0; RADII.len()] }
    }

    /// That of terms with this energy at each sample of a common window, \[y\]\[x\]; it never rises.
    pub(super) fn of(energy: &[f64], [width, height]: [usize; 2]) -> Self {
        let largest = energy.iter().enumerate().fold((0, 0.0), |a, (k, &v)| if v > a.1 { (k, v) } else { a });
        if width * height != energy.len() || largest.1 <= 0.0 {
            return Self::none();
        }
        let middle = [largest.0 % width, largest.0 / width];
        let (mut sums, mut counts) = ([0.0; RADII.len()], [0.0; RADII.len()]);
        for (k, &e) in energy.iter().enumerate().filter(|(_, e)| **e > 0.0) {
            let (at, part) = between(middle, k, width);
            for (knot, share) in [(at, 1.0 - part), (at + 1, part)] {
                sums[knot.min(RADII.len() - 1)] += share * 0.5 * (e / largest.1).ln();
                counts[knot.min(RADII.len() - 1)] += share;
            }
        }
        let mut knots = [0; RADII.len()];
        for k in 1..RADII.len() {
            let fall = if counts[k] > 0.0 { -POWER * sums[k] / counts[k] * STEPS } else { 0.0 };
            knots[k] = (fall.round().clamp(0.0, 255.0) as u8).max(knots[k - 1]);
        }
        Self { middle, knots }
    }

    pub(super) fn code<B: Bits>(&self, bits: &mut B) -> Result<Self, String> {
        let mut found = Self::none();
        for a in 0..2 {
            found.middle[a] = raw(bits, self.middle[a] as u64, 16)? as usize;
        }
        for (to, &knot) in found.knots.iter_mut().zip(&self.knots) {
            *to = raw(bits, u64::from(knot), BITS)? as u8;
        }
        Ok(found)
    }

    /// The falloff at each sample of a common window, \[y\]\[x\]; 1 at its middle.
    pub(super) fn values(&self, [width, height]: [usize; 2]) -> Vec<f64> {
        let value = |k: usize| {
            let (at, part) = between(self.middle, k, width);
            let [a, b] = [at, at + 1].map(|k| f64::from(self.knots[k.min(RADII.len() - 1)]));
            // libm: the same digits on every machine
            libm::exp(-(a + part * (b - a)) / STEPS)
        };
        (0..width * height).map(value).collect()
    }
}

/// The knot before the distance of sample `k` from the middle, and how far it is towards the next.
fn between(middle: [usize; 2], k: usize, width: usize) -> (usize, f64) {
    let [dx, dy] = [(k % width.max(1)).abs_diff(middle[0]), (k / width.max(1)).abs_diff(middle[1])];
    let distance = ((dx * dx + dy * dy) as f64).sqrt();
    let at = RADII.iter().rposition(|r| *r <= distance).unwrap_or(0);
    let next = RADII.get(at + 1).copied().unwrap_or(RADII[at]);
    (at, if next > RADII[at] { (distance - RADII[at]) / (next - RADII[at]) } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::super::entropy::{Reader, Writer};
    use super::*;

    #[test]
    fn a_falloff_is_the_fourth_root_of_the_responses_by_distance_and_comes_back() {
        let size = [41, 33];
        let distance = |k: usize| ((k % 41) as f64 - 17.0).hypot((k / 41) as f64 - 20.0);
        let energy: Vec<f64> = (0..41 * 33).map(|k| 7.0 * (-2.0 * distance(k) / 3.0).exp()).collect();
        let falloff = Falloff::of(&energy, size);
        let mut writer = Writer::default();
        assert_eq!(falloff.code(&mut writer).as_ref(), Ok(&falloff));
        let found = Falloff::none().code(&mut Reader::new(&writer.finish()).unwrap()).unwrap();
        assert_eq!(found, falloff);
        for (k, v) in found.values(size).into_iter().enumerate() {
            // A line by distance, to a step of 1/16 and what straight pieces smooth; behind 12 samples it is known from few.
            let expected = (-POWER * distance(k) / 3.0).exp();
            let most = if distance(k) < 12.0 { 0.1 } else { 0.4 };
            assert!((v / expected).ln().abs() < most, "{k}: {v} {expected}");
        }
    }

    #[test]
    fn where_nothing_leaves_or_all_alike_there_is_no_falloff() {
        let size = [5, 3];
        assert_eq!(Falloff::of(&[0.0; 15], size), Falloff::none());
        assert_eq!(Falloff::of(&[1e-30; 15], size).values(size), [1.0; 15]);
        // The falloff is kept in 255 steps of 1/16: an energy that drops by 300 decades is limited to e^(−255/16).
        let steep: Vec<f64> = (0..15).map(|k| if k == 7 { 1e150 } else { 1e-150 }).collect();
        let values = Falloff::of(&steep, size).values(size);
        assert_eq!(values[7], 1.0);
        assert!(values.iter().all(|v| *v >= (-256.0_f64 / 16.0).exp()), "{values:?}");
    }
}
