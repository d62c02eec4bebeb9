//! Photographs of fewer, larger pixels: means of blocks, as a camera of that resolution would have taken them.
//!
//! Code values must be in proportion to light: means of a curve's code values are not those of light.

use super::{Camera, Capture, Pixels, Samples, Sampling};

/// Blocks of so many pixels along each axis become one.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Reduction {
    /// Pixels of a block along each axis.
    pub factor: usize,
    /// Code values from here on are saturated.
    pub saturation_dn: f64,
}

impl Pixels {
    /// Means of whole blocks; what is left at the right and below is dropped. A block that is saturated in part measured nothing (NaN), one that
    /// is saturated as a whole stays saturated.
    pub fn reduced(self, by: Reduction) -> Self {
        let Reduction { factor, saturation_dn } = by;
        if factor <= 1 {
            return self;
        }
        let size = [self.width, self.height];
        let samples = match &self.samples {
            Samples::U8(v) => means(v, f32::from, size, factor, saturation_dn as f32),
            Samples::U16(v) => means(v, f32::from, size, factor, saturation_dn as f32),
            Samples::F32(v) => means(v, |c| c, size, factor, saturation_dn as f32),
        };
        let n = factor as f64;
        let sampling = Sampling {
            offset_px: self.sampling.offset_px.map(|o| o.map(|o| o / n)),
            aperture_px: self.sampling.aperture_px.map(|a| (n - 1.0 + a) / n),
            variance_share: self.sampling.variance_share,
        };
        let [width, height] = size.map(|s| s / factor);
        Self { width, height, samples: Samples::F32(samples), sampling, hash: self.hash }
    }
}

fn means<T: Copy>(
    values: &[T],
    code: impl Fn(T) -> f32,
    [width, height]: [usize; 2],
    n: usize,
    saturation: f32,
) -> Vec<f32> {
    let (across, down) = (width / n, height / n);
    let mut out = Vec::with_capacity(3 * across * down);
    // Of a line of blocks: sums, and how many of each are saturated.
    let (mut sums, mut full) = (vec![0.0_f64; 3 * across], vec![0_u32; 3 * across]);
    for line in 0..down {
        sums.fill(0.0);
        full.fill(0);
        for y in line * n..(line + 1) * n {
            let row = &values[3 * y * width..][..3 * across * n];
            for (block, pixels) in row.chunks_exact(3 * n).enumerate() {
                let (mut sum, mut saturated) = ([0.0_f32; 3], [0_u32; 3]);
                for pixel in pixels.chunks_exact(3) {
                    for c in 0..3 {
                        let v = code(pixel[c]);
                        sum[c] += v;
                        saturated[c] += u32::from(v >= saturation);
                    }
                }
                for c in 0..3 {
                    sums[3 * block + c] += f64::from(sum[c]);
                    full[3 * block + c] += saturated[c];
                }
            }
        }
        let all = (n * n) as u32;
        out.extend(sums.iter().zip(&full).map(|(&sum, &full)| match full {
            0 => (sum / f64::from(all)) as f32,
            full if full == all => saturation,
            _ => f32::NAN,
        }));
    }
    out
}

impl Camera {
    /// The same camera with blocks of pixels for pixels.
    pub fn reduced(&self, factor: usize) -> Self {
        let n = factor.max(1) as f64;
        Self {
            size_px: self.size_px.map(|s| s / factor.max(1)),
            focal_px: self.focal_px / n,
            // The first block's centre lies (n − 1)/2 from the first pixel's.
            principal_px: self.principal_px.map(|p| (p - 0.5 * (n - 1.0)) / n),
            ..self.clone()
        }
    }
}

impl Capture {
    /// The same capture as a camera of fewer pixels would have taken it.
    pub fn reduced(&self, by: Reduction) -> Self {
        let mut reduced = self.clone();
        if by.factor > 1 {
            reduced.rig.camera = self.rig.camera.reduced(by.factor);
            reduced.brackets.iter_mut().flatten().for_each(|p| p.reduction = Some(by));
        }
        reduced
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_means_and_those_that_saturate_in_part_measured_nothing() {
        // 7 × 5 pixels in blocks of two: 3 × 2 of them; a column and a line are left over.
        let code = |x: usize, y: usize, c: usize| (10 * x + 3 * y + 100 * c) as u16;
        let mut values: Vec<u16> = (0..105).map(|k| code(k / 3 % 7, k / 21, k % 3)).collect();
        values[3 * (2 * 7 + 3) + 1] = 4000;
        for (x, y) in [(4, 2), (5, 2), (4, 3), (5, 3)] {
            values[3 * (y * 7 + x) + 2] = 4000 + x as u16;
        }
        let pixels = Pixels {
            width: 7,
            height: 5,
            samples: Samples::U16(values),
            sampling: Sampling::WHOLE,
            hash: blake3::hash(b""),
        };
        let found = pixels.reduced(Reduction { factor: 2, saturation_dn: 4000.0 });
        assert_eq!((found.width, found.height, found.sampling), (3, 2, Sampling::WHOLE));
        let Samples::F32(found) = found.samples else { panic!("means are not whole") };
        for k in 0..18 {
            let (x, y, c) = (k / 3 % 3, k / 9, k % 3);
            match (x, y, c) {
                (1, 1, 1) => assert!(found[k].is_nan(), "a quarter of it is saturated"),
                (2, 1, 2) => assert_eq!(found[k], 4000.0),
                // Five and one and a half are half a step along each axis.
                _ => assert_eq!(found[k], f32::from(code(2 * x, 2 * y, c)) + 5.0 + 1.5),
            }
        }
    }

    #[test]
    fn a_reduced_camera_sees_points_in_the_blocks_that_hold_their_pixels() {
        let camera = Camera {
            size_px: [1000, 701],
            focal_px: 1500.0,
            principal_px: [480.0, 350.5],
            response_curve: super::super::ResponseCurve::Linear,
            vignetting: vec![-0.3],
        };
        let small = camera.reduced(7);
        assert_eq!(small.size_px, [142, 100]);
        // A point 0.1 of the focal length from the axis: at 630 px, in the block from 630 to 636, whose middle is 633.
        let at = |c: &Camera| c.principal_px[0] + 0.1 * c.focal_px;
        assert!((at(&camera) - 630.0).abs() < 1e-9 && (at(&small) - (90.0 - 3.0 / 7.0)).abs() < 1e-9);
        let shade = |c: &Camera| c.vignetting_at([at(c), c.principal_px[1]]);
        assert!((shade(&camera) - shade(&small)).abs() < 1e-12, "rounding");
    }
}
