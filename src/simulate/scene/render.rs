//! What the camera receives: the light of a scene averaged over the area of each pixel.

use super::Scene;
use crate::simulate::light::{diffusion::Domain, field::Field};
use crate::{
    Error, Result,
    capture::Axis,
    geometry::{Homography, Point},
};
use rayon::prelude::*;

/// Blur of the projector's pixels, projector px (standard deviation).
pub(crate) const PROJECTOR_BLUR_PX: f64 = 0.3;
/// Softness of the printed board's edges, camera px.
const PRINT_BLUR_PX: f64 = 0.2;
/// Albedo of the printed board, dark and light.
const BOARD_ALBEDO: [f64; 2] = [0.05, 0.85];

/// Nodes and weights of Gauss and Legendre on −½..½: three suit the smooth fields, six the edges.
const GAUSS_3: [(f64, f64); 3] =
    [(-0.387_298_334_620_741_7, 5.0 / 18.0), (0.0, 4.0 / 9.0), (0.387_298_334_620_741_7, 5.0 / 18.0)];
const GAUSS_6: [(f64, f64); 6] = [
    (-0.466_234_757_101_576, 0.085_662_246_189_585_2),
    (-0.330_604_693_233_132_3, 0.180_380_786_524_069_3),
    (-0.119_309_593_041_598_5, 0.233_956_967_286_345_5),
    (0.119_309_593_041_598_5, 0.233_956_967_286_345_5),
    (0.330_604_693_233_132_3, 0.180_380_786_524_069_3),
    (0.466_234_757_101_576, 0.085_662_246_189_585_2),
];

/// A picture: radiant exitance that a Lambertian surface would need, π times radiance, row-major.
pub(crate) type Picture = Vec<[f32; 3]>;

/// Where the corners of all pixels lie on the slab; within a pixel, bilinear between them.
#[derive(Debug)]
pub(crate) struct PixelGrid {
    size_px: [usize; 2],
    corners_mm: Vec<Point>,
}

impl PixelGrid {
    /// Projects all corners back onto the slab.
    pub fn new(scene: &Scene) -> Result<Self> {
        let size_px = scene.camera.size_px;
        let slab_from_ideal =
            scene.view.ideal_from_slab.inverse().ok_or_else(|| Error::internal("camera view is singular"))?;
        let across = size_px[0] + 1;
        let corner = |i: usize| {
            let q = [(i % across) as f64 - 0.5, (i / across) as f64 - 0.5];
            slab_from_ideal.map(scene.view.lens.undistort(q))
        };
        let corners_mm = (0..across * (size_px[1] + 1)).into_par_iter().map(corner).collect();
        Ok(Self { size_px, corners_mm })
    }

    /// The mean of `f` over the area of pixel (x, y).
    #[inline]
    fn mean<const C: usize>(&self, rule: &[(f64, f64)], x: usize, y: usize, f: impl Fn(Point) -> [f64; C]) -> [f64; C] {
        let across = self.size_px[0] + 1;
        let i = y * across + x;
        let [a, b, c, d] = [i, i + 1, i + across, i + across + 1].map(|i| self.corners_mm[i]);
        let mut sum = [0.0; C];
        for &(v, wv) in rule {
            let v = v + 0.5;
            let left = [a[0] + v * (c[0] - a[0]), a[1] + v * (c[1] - a[1])];
            let right = [b[0] + v * (d[0] - b[0]), b[1] + v * (d[1] - b[1])];
            for &(u, wu) in rule {
                let u = u + 0.5;
                let value = f([left[0] + u * (right[0] - left[0]), left[1] + u * (right[1] - left[1])]);
                sum.iter_mut().zip(value).for_each(|(s, value)| *s += wu * wv * value);
            }
        }
        sum
    }

    /// A whole picture of `f`, edges averaged by 6 × 6 points a pixel.
    pub fn picture(&self, f: impl Fn(Point) -> [f64; 3] + Sync) -> Picture {
        let [width, height] = self.size_px;
        let pixel = |i: usize| self.mean(&GAUSS_6, i % width, i / width, &f).map(|v| v as f32);
        (0..width * height).into_par_iter().map(pixel).collect()
    }

    /// Adds `scale` times `field` where it is not zero and the sample is in view.
    pub fn add_field(&self, picture: &mut Picture, scene: &Scene, field: &Field, scale: [f64; 3]) {
        let light = |p: Point| {
            if scene.on_sample(p) { field.at(p).map(f64::from) } else { [0.0; 3] }
        };
        for (x, y) in self.seen(scene, field.bounds_mm()) {
            let mean = self.mean(&GAUSS_3, x, y, light);
            let pixel = &mut picture[y * self.size_px[0] + x];
            pixel.iter_mut().zip(mean).zip(scale).for_each(|((p, m), s)| *p += (m * s) as f32);
        }
    }

    /// Adds a dot of the projector that falls on the frame, displaced by `drift_mm`.
    pub fn add_frame_dot(&self, picture: &mut Picture, scene: &Scene, dot_px: Point, drift_mm: Point, albedo_lit: f64) {
        let half = 0.5 * scene.grid.dot_projector_px as f64;
        let reach = half + 5.0 * PROJECTOR_BLUR_PX;
        let corners = [[-reach, -reach], [reach, -reach], [-reach, reach], [reach, reach]].map(|r| {
            let p = scene.slab_from_projector.map([dot_px[0] + r[0], dot_px[1] + r[1]]);
            [p[0] + drift_mm[0], p[1] + drift_mm[1]]
        });
        let low: Point = std::array::from_fn(|a| corners.iter().map(|p| p[a]).fold(f64::MAX, f64::min));
        let high: Point = std::array::from_fn(|a| corners.iter().map(|p| p[a]).fold(f64::MIN, f64::max));
        let light = |p: Point| {
            let q = scene.projector_from_slab.map([p[0] - drift_mm[0], p[1] - drift_mm[1]]);
            let lit = soft_box(q[0] - dot_px[0], half) * soft_box(q[1] - dot_px[1], half);
            scene.white_irradiance(p).map(|e| albedo_lit * lit * e)
        };
        for (x, y) in self.seen(scene, [low, high]) {
            let mean = self.mean(&GAUSS_6, x, y, light);
            let pixel = &mut picture[y * self.size_px[0] + x];
            pixel.iter_mut().zip(mean).for_each(|(p, m)| *p += m as f32);
        }
    }

    /// The pixels that may see a rectangle of the slab.
    fn seen(&self, scene: &Scene, [low, high]: [Point; 2]) -> impl Iterator<Item = (usize, usize)> + use<> {
        let corners = [low, [high[0], low[1]], [low[0], high[1]], high].map(|p| scene.view.camera_from_slab(p));
        let range = |a: usize| {
            let first = corners.iter().map(|q| q[a]).fold(f64::MAX, f64::min) - 1.5;
            let last = corners.iter().map(|q| q[a]).fold(f64::MIN, f64::max) + 1.5;
            let limit = self.size_px[a] as f64 - 1.0;
            first.clamp(0.0, limit) as usize..last.clamp(0.0, limit) as usize + 1
        };
        let xs = range(0);
        range(1).flat_map(move |y| xs.clone().map(move |x| (x, y)))
    }
}

/// Albedo of the printed board at `p`: white paper everywhere around the squares, the first square dark.
pub(crate) fn board_albedo(scene: &Scene, px_mm: f64, p: Point) -> f64 {
    let board = &scene.board;
    let soft = PRINT_BLUR_PX * px_mm / board.square_mm;
    // A square wave of each coordinate, −1 and +1, with soft edges; outside the squares there is only paper.
    let wave = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        let edge = t.round().clamp(0.0, board.inner_corners[a] as f64 - 1.0);
        let sign = if edge as i64 % 2 == 0 { 1.0 } else { -1.0 };
        sign * (2.0 * normal_cdf((t - edge) / soft) - 1.0)
    };
    let inside = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        normal_cdf((t + 1.0) / soft) * normal_cdf((board.inner_corners[a] as f64 - t) / soft)
    };
    let [dark, light] = BOARD_ALBEDO;
    let darkness = 0.5 * (1.0 + wave(0) * wave(1)) * inside(0) * inside(1);
    light + darkness * (dark - light)
}

/// Brightness 0..1 of one bit of the Gray code at projector position `q`, blurred across its edges.
pub(crate) fn gray_code(axis: Axis, bit: u32, inverse: bool, q: Point) -> f64 {
    let t = match axis {
        Axis::X => q[0],
        Axis::Y => q[1],
    };
    // Bit j of n XOR (n >> 1) changes where n passes 2^j, 2^j + 2^(j+1), …; the edge lies half a pixel before.
    let stripe = f64::from(2u32 << bit);
    let first = f64::from(1u32 << bit) - 0.5;
    let edge = ((t - first) / stripe).round();
    let rises = edge.rem_euclid(2.0) == 0.0;
    let after = normal_cdf((t - first - edge * stripe) / PROJECTOR_BLUR_PX);
    if rises != inverse { after } else { 1.0 - after }
}

/// A box of half width `half`, blurred as the projector's pixels are; its integral stays 2 · half.
pub(crate) fn soft_box(t: f64, half: f64) -> f64 {
    normal_cdf((t + half) / PROJECTOR_BLUR_PX) - normal_cdf((t - half) / PROJECTOR_BLUR_PX)
}

/// Share of a dot's flux that each voxel column of `domain` receives (they sum to 1), the dot centred on `center_mm`.
///
/// The square is mapped by the projector's derivative at the dot, and each column integrated by 6 × 6 Gauss points.
pub(crate) fn footprint(
    domain: &Domain,
    slab_from_projector: &Homography,
    dot_px: Point,
    center_mm: Point,
    dot_side_px: usize,
) -> Vec<f64> {
    let j = slab_from_projector.jacobian(dot_px);
    let det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
    let half = 0.5 * dot_side_px as f64;
    let reach_px = half + 6.0 * PROJECTOR_BLUR_PX;
    let reach_mm: Point = std::array::from_fn(|a| reach_px * (j[a][0].abs() + j[a][1].abs()));
    let range = |a: usize| {
        let voxel = |v: f64| (v - domain.corner_mm[a]) / domain.voxel_mm;
        let limit = domain.voxels[a] as f64;
        let (from, to) = (voxel(center_mm[a] - reach_mm[a]).floor(), voxel(center_mm[a] + reach_mm[a]).ceil());
        from.clamp(0.0, limit) as usize..to.clamp(0.0, limit) as usize
    };
    let mut flux = vec![0.0; domain.columns()];
    for y in range(1) {
        for x in range(0) {
            let corner = domain.voxel_corner_mm([x, y]);
            let mut sum = 0.0;
            for (v, wv) in GAUSS_6 {
                for (u, wu) in GAUSS_6 {
                    let d = [
                        corner[0] + (u + 0.5) * domain.voxel_mm - center_mm[0],
                        corner[1] + (v + 0.5) * domain.voxel_mm - center_mm[1],
                    ];
                    let q = [(j[1][1] * d[0] - j[0][1] * d[1]) / det, (j[0][0] * d[1] - j[1][0] * d[0]) / det];
                    sum += wu * wv * soft_box(q[0], half) * soft_box(q[1], half);
                }
            }
            flux[y * domain.voxels[0] + x] = sum;
        }
    }
    let total: f64 = flux.iter().sum();
    if total > 0.0 {
        flux.iter_mut().for_each(|f| *f /= total);
    }
    flux
}

/// The standard normal distribution function, absolute error below 1e-7 (Abramowitz & Stegun 7.1.26 for erf).
pub(crate) fn normal_cdf(t: f64) -> f64 {
    let x = t.abs() / std::f64::consts::SQRT_2;
    if x > 5.0 {
        return if t > 0.0 { 1.0 } else { 0.0 };
    }
    let k = 1.0 / (1.0 + 0.327_591_1 * x);
    let polynomial =
        k * (0.254_829_592 + k * (-0.284_496_736 + k * (1.421_413_741 + k * (-1.453_152_027 + k * 1.061_405_429))));
    let tail = 0.5 * polynomial * (-x * x).exp();
    if t > 0.0 { 1.0 - tail } else { tail }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gray_code_equals_its_definition_at_pixel_centres() {
        for bit in 2..7 {
            for n in 0..200u32 {
                let expected = f64::from(((n ^ (n >> 1)) >> bit) & 1);
                let q = [f64::from(n), f64::from(n)];
                // Half a pixel from an edge is 1.7 standard deviations of the blur: under 5 % of the step.
                assert!((gray_code(Axis::X, bit, false, q) - expected).abs() < 0.05, "bit {bit}, column {n}");
                assert!((gray_code(Axis::Y, bit, true, q) + expected - 1.0).abs() < 0.05);
            }
        }
    }

    #[test]
    fn the_footprint_moves_smoothly() {
        let domain = Domain { corner_mm: [0.0, 0.0], voxel_mm: 0.4, voxels: [20, 20] };
        let view = Homography::similarity(0.2, [0.0, 0.0]);
        let mean_x = |x: f64| {
            let flux = footprint(&domain, &view, [0.0, 0.0], [x, 4.0], 3);
            flux.iter().enumerate().map(|(i, f)| f * ((i % 20) as f64 + 0.5) * 0.4).sum::<f64>()
        };
        for step in 0..8 {
            let x = 4.0 + 0.05 * f64::from(step);
            // Voxel columns hold only masses, so their centroid may differ by the second moment within a voxel.
            assert!((mean_x(x) - x).abs() < 0.02, "{x}: {}", mean_x(x));
        }
    }
}
