//! The light that a lit dot brings, from the white reference.

use crate::capture::Rig;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// Light per area under a full white pattern, seen as the camera would see it, vignetting taken out.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Irradiance {
    white: Radiance,
    sensitivity: Sensitivity,
    reflectance: [f64; 3],
    relative_sd: f64,
    /// Half the side of the square of pixels over which it is averaged.
    radius_px: usize,
}

/// Relative sensitivity of each pixel (vignetting), inverted once.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Sensitivity {
    width: usize,
    inverse: Vec<f32>,
}

impl Sensitivity {
    /// For the rig's camera.
    pub fn new(rig: &Rig) -> Self {
        let [width, height] = rig.camera.size_px;
        let pixel = |k: usize| (1.0 / rig.camera.vignetting_at([(k % width) as f64, (k / width) as f64])) as f32;
        Self { width, inverse: (0..width * height).map(pixel).collect() }
    }

    /// One over the relative sensitivity at pixel (x, y).
    pub fn inverse_at(&self, x: usize, y: usize) -> f32 {
        self.inverse[y * self.width + x]
    }
}

/// What one lit dot brings to the slab, per channel, in the camera's units times mm².
#[derive(Debug, Clone, Copy)]
pub struct Flux {
    /// The flux.
    pub value: [f64; 3],
    /// Its relative variance.
    pub relative_variance: [f64; 3],
}

impl Irradiance {
    /// From the merged white-reference shot, the black one already subtracted, covering the whole photograph.
    ///
    /// `radius_px`: half the side of the square over which it is averaged at a dot; falloff must be nearly linear over
    /// it.
    pub fn new(white: Radiance, rig: &Rig, radius_px: usize) -> Self {
        let crate::capture::WhiteReference { reflectance, relative_sd } = rig.white_reference;
        Self { white, sensitivity: Sensitivity::new(rig), reflectance, relative_sd, radius_px }
    }

    /// The camera's sensitivity.
    pub fn sensitivity(&self) -> &Sensitivity {
        &self.sensitivity
    }

    /// The flux of a dot that covers `area_mm2` of the slab and appears at camera pixel `at`.
    ///
    /// `None` when the white reference is not measured around there, or black.
    pub fn flux(&self, at: Point, area_mm2: f64) -> Option<Flux> {
        let (r, rect) = (self.radius_px as isize, self.white.rect);
        let (cx, cy) = (at[0].round() as isize, at[1].round() as isize);
        let (mut sum, mut variance, mut count) = ([0.0f64; 3], [0.0f64; 3], 0.0f64);
        for y in cy - r..=cy + r {
            for x in cx - r..=cx + r {
                if x < 0 || y < 0 || x as usize >= rect.width || y as usize >= rect.height {
                    return None;
                }
                let (x, y) = (x as usize, y as usize);
                let k = self.white.at(x, y);
                let inverse = self.sensitivity.inverse_at(x, y);
                for c in 0..3 {
                    if self.white.used[k + c] == 0 {
                        return None;
                    }
                    sum[c] += f64::from(self.white.value[k + c] * inverse);
                    variance[c] += f64::from(self.white.variance[k + c] * inverse * inverse);
                }
                count += 1.0;
            }
        }
        if sum.iter().any(|s| !(*s > 0.0)) {
            return None;
        }
        Some(Flux {
            value: std::array::from_fn(|c| sum[c] / count / self.reflectance[c] * area_mm2),
            relative_variance: std::array::from_fn(|c| variance[c] / (sum[c] * sum[c]) + self.relative_sd.powi(2)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Camera, Projector, Rect, ResponseCurve, WhiteReference};

    const SIZE_PX: [usize; 2] = [23, 14];
    const PRINCIPAL_PX: Point = [15.0, 4.0];
    const REFLECTANCE: [f64; 3] = [0.91, 0.74, 0.52];

    fn rig() -> Rig {
        let camera = Camera {
            size_px: SIZE_PX,
            focal_px: 20.0,
            principal_px: PRINCIPAL_PX,
            response_curve: ResponseCurve::Linear,
            vignetting: vec![-0.3, 0.1],
        };
        let projector = Projector { size_px: [64, 36], principal_px: None };
        let white_reference = WhiteReference { reflectance: REFLECTANCE, relative_sd: 0.0 };
        Rig { format: 1, camera, noise: None, projector, board: None, frame: None, white_reference }
    }

    /// 1 + c₀ r² + c₁ r⁴.
    fn vignetting(x: usize, y: usize) -> f64 {
        let r2 = ((x as f64 - PRINCIPAL_PX[0]).powi(2) + (y as f64 - PRINCIPAL_PX[1]).powi(2)) / 400.0;
        1.0 - 0.3 * r2 + 0.1 * r2 * r2
    }

    /// Three ramps, no two alike along any axis.
    fn ramp(x: f64, y: f64, c: usize) -> f64 {
        [800.0 + 9.0 * x - 14.0 * y, 500.0 - 8.0 * x + 21.0 * y, 200.0 + 3.0 * x + 5.0 * y][c]
    }

    fn spread(x: usize, y: usize, c: usize) -> f64 {
        [2.0, 30.0, 500.0][c] * (1.0 + 0.1 * x as f64 + 0.4 * y as f64)
    }

    /// The ramps through the vignetting.
    fn white() -> Radiance {
        let at = |k: usize| (k / 3 % SIZE_PX[0], k / 3 / SIZE_PX[0], k % 3);
        let n = 3 * SIZE_PX[0] * SIZE_PX[1];
        let value = |k: usize| {
            let (x, y, c) = at(k);
            (ramp(x as f64, y as f64, c) * vignetting(x, y)) as f32
        };
        let variance = |k: usize| {
            let (x, y, c) = at(k);
            spread(x, y, c) as f32
        };
        let rect = Rect { x: 0, y: 0, width: SIZE_PX[0], height: SIZE_PX[1] };
        let (value, variance) = ((0..n).map(value).collect(), (0..n).map(variance).collect());
        Radiance { rect, value, variance, used: vec![2; n] }
    }

    #[test]
    fn the_flux_is_the_light_of_a_perfect_white_at_the_dot_times_its_area() {
        for radius_px in [0, 1, 3] {
            let irradiance = Irradiance::new(white(), &rig(), radius_px);
            // Rounded to the pixels (17, 5) and (4, 9): the mean of a ramp over a square is that in its middle.
            for (at, [x, y]) in [([16.6, 5.4], [17.0, 5.0]), ([4.3, 8.7], [4.0, 9.0])] {
                let flux = irradiance.flux(at, 0.37).unwrap();
                for c in 0..3 {
                    let expected = ramp(x, y, c) / REFLECTANCE[c] * 0.37;
                    // Values and sensitivities in f32.
                    assert!((flux.value[c] / expected - 1.0).abs() < 1e-6, "{at:?} {c}: {} {expected}", flux.value[c]);
                }
            }
        }
    }

    #[test]
    fn the_flux_of_a_dot_scales_with_its_area_and_its_relative_variance_does_not() {
        let irradiance = Irradiance::new(white(), &rig(), 1);
        let (one, other) = (irradiance.flux([9.0, 6.0], 0.2).unwrap(), irradiance.flux([9.0, 6.0], 0.7).unwrap());
        // 0.7 / 0.2, to f64.
        assert!((0..3).all(|c| (other.value[c] / one.value[c] - 3.5).abs() < 1e-12));
        assert_eq!(one.relative_variance, other.relative_variance);
    }

    #[test]
    fn the_fluxs_variance_is_that_of_the_mean_of_its_pixels_without_vignetting() {
        let flux = Irradiance::new(white(), &rig(), 2).flux([6.0, 10.0], 0.37).unwrap();
        for c in 0..3 {
            let (mut sum, mut variance) = (0.0, 0.0);
            for y in 8..=12 {
                for x in 4..=8 {
                    sum += ramp(x as f64, y as f64, c);
                    variance += spread(x, y, c) / vignetting(x, y).powi(2);
                }
            }
            let expected = variance / (sum * sum);
            // Values and sensitivities in f32.
            assert!((flux.relative_variance[c] / expected - 1.0).abs() < 1e-5, "{c}");
        }
    }

    #[test]
    fn a_dot_whose_pixels_reach_beyond_the_picture_has_no_flux() {
        let irradiance = Irradiance::new(white(), &rig(), 2);
        let known = |x: f64, y: f64| irradiance.flux([x, y], 1.0).is_some();
        // Two pixels are needed on each side: columns 2 to 20, rows 2 to 11.
        assert!(known(2.0, 2.0) && known(20.0, 2.0) && known(2.0, 11.0) && known(20.0, 11.0));
        assert!(!known(1.0, 6.0) && !known(21.0, 6.0) && !known(9.0, 1.0) && !known(9.0, 12.0));
        assert!(!known(-50.0, 6.0) && !known(9.0, 1e9));
    }

    #[test]
    fn a_reference_that_was_not_measured_in_one_channel_or_is_black_gives_no_flux() {
        let with = |change: &dyn Fn(&mut Radiance)| {
            let mut white = white();
            change(&mut white);
            let irradiance = Irradiance::new(white, &rig(), 1);
            // Pixels (9..=11, 4..=6) and (3..=5, 8..=10).
            [irradiance.flux([10.0, 5.0], 1.0).is_some(), irradiance.flux([4.0, 9.0], 1.0).is_some()]
        };
        assert_eq!(with(&|_| ()), [true, true]);
        for c in 0..3 {
            let unmeasured = |w: &mut Radiance, x, y| {
                let k = w.at(x, y) + c;
                w.used[k] = 0;
            };
            assert_eq!(with(&|w| unmeasured(w, 11, 4)), [false, true]);
            assert_eq!(with(&|w| unmeasured(w, 3, 10)), [true, false]);
            assert_eq!(with(&|w| unmeasured(w, 12, 4)), [true, true]);
            // Black in all its pixels, or so much below black that the sum is: nothing can be divided by it.
            let light = |w: &mut Radiance, light: f32| w.value.iter_mut().skip(c).step_by(3).for_each(|v| *v = light);
            assert_eq!(with(&|w| light(w, 0.0)), [false, false]);
            assert_eq!(with(&|w| light(w, -3.0)), [false, false]);
            assert_eq!(with(&|w| light(w, f32::NAN)), [false, false]);
            assert_eq!(with(&|w| light(w, 1e-30)), [true, true]);
        }
    }

    #[test]
    fn sensitivity_is_inverted_pixel_by_pixel() {
        let sensitivity = Sensitivity::new(&rig());
        for y in 0..SIZE_PX[1] {
            for x in 0..SIZE_PX[0] {
                // f32.
                assert!((f64::from(sensitivity.inverse_at(x, y)) * vignetting(x, y) - 1.0).abs() < 1e-6, "{x} {y}");
            }
        }
    }
}
