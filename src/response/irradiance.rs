//! The light that a lit dot brings, from the white reference.

use crate::capture::Rig;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// Light per area under a full white pattern, seen as the camera would see it, vignetting taken out.
#[derive(Debug)]
pub struct Irradiance {
    white: Radiance,
    sensitivity: Sensitivity,
    reflectance: [f64; 3],
    /// Half the side of the square of pixels over which it is averaged.
    radius_px: usize,
}

/// Relative sensitivity of each pixel (vignetting), inverted once.
#[derive(Debug)]
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
    /// `radius_px`: half the side of the square over which it is averaged at a dot; falloff must be nearly linear over it.
    pub fn new(white: Radiance, rig: &Rig, radius_px: usize) -> Self {
        Self { white, sensitivity: Sensitivity::new(rig), reflectance: rig.white_reference.reflectance, radius_px }
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
            relative_variance: std::array::from_fn(|c| variance[c] / (sum[c] * sum[c])),
        })
    }
}
