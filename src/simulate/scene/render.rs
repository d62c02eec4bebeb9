//! What the camera receives: the light of a scene averaged over the area of each pixel.

use super::SimulatedScene;
use crate::simulate::SimulateOptions;
use crate::simulate::light::field::{Field, Nodes};
use crate::{
    Error, Result,
    capture::Axis,
    geometry::{CameraView, Homography, Point},
};
use rayon::prelude::*;
use std::ops::Range;

/// Albedo of the printed board, dark and light.
const BOARD_ALBEDO: [f64; 2] = [0.05, 0.85];

/// Nodes and weights of Gauss and Legendre on −½..½: two are exact for what is cubic over a pixel, three suit the
/// smooth fields, six the edges. One is enough for the projector's light, which bends by 3e-7 of itself within a pixel.
pub(crate) type Rule = &'static [(f64, f64)];
pub(crate) const GAUSS_1: Rule = &[(0.0, 1.0)];
pub(crate) const GAUSS_2: Rule = &[(-0.288_675_134_594_812_9, 0.5), (0.288_675_134_594_812_9, 0.5)];
pub(crate) const GAUSS_3: Rule =
    &[(-0.387_298_334_620_741_7, 5.0 / 18.0), (0.0, 4.0 / 9.0), (0.387_298_334_620_741_7, 5.0 / 18.0)];
pub(crate) const GAUSS_6: Rule = &[
    (-0.466_234_757_101_576, 0.085_662_246_189_585_2),
    (-0.330_604_693_233_132_3, 0.180_380_786_524_069_3),
    (-0.119_309_593_041_598_5, 0.233_956_967_286_345_5),
    (0.119_309_593_041_598_5, 0.233_956_967_286_345_5),
    (0.330_604_693_233_132_3, 0.180_380_786_524_069_3),
    (0.466_234_757_101_576, 0.085_662_246_189_585_2),
];

/// A picture: radiant exitance that a Lambertian surface would need, π times radiance, row-major.
pub(crate) type RenderedPicture = Vec<[f32; 3]>;

/// The corners of a pixel on the slab, mm: the upper two, then the lower two.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Pixel {
    pub corners_mm: [Point; 4],
}

impl Pixel {
    /// The corner that comes first.
    #[inline(always)]
    pub(crate) fn first_corner_mm(&self) -> Point {
        self.corners_mm[0]
    }

    /// The mean of the corners.
    pub(crate) fn centre_mm(&self) -> Point {
        [0, 1].map(|a| 0.25 * self.corners_mm.iter().map(|p| p[a]).sum::<f64>())
    }

    /// The mean of `f` over the pixel's area.
    #[inline(always)]
    pub(crate) fn mean<const C: usize>(&self, rule: &[(f64, f64)], f: impl Fn(Point) -> [f64; C]) -> [f64; C] {
        let [a, b, c, d] = self.corners_mm;
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
}

/// Where the corners of all pixels, or of equal parts of them, lie on the slab; within one, bilinear between them.
#[derive(Debug)]
pub(crate) struct PixelGrid {
    /// Pixels, or parts of them, along x and y.
    size_px: [usize; 2],
    /// Parts of a camera pixel along each axis.
    parts: usize,
    corners_mm: Vec<Point>,
    /// How far the camera's picture has moved, px.
    shift_px: Point,
}

impl PixelGrid {
    /// Projects all corners of pixels cut into `parts` along each axis back onto the slab, for a picture that has moved
    /// by `shift_px`.
    pub(crate) fn new(scene: &SimulatedScene, shift_px: Point, parts: usize) -> Result<Self> {
        let mut view = scene.view;
        view.ideal_from_slab = Homography::similarity(1.0, shift_px).after(&view.ideal_from_slab);
        view.lens.center_px = [0, 1].map(|a| view.lens.center_px[a] + shift_px[a]);
        Ok(Self { shift_px, ..Self::of_view(&view, scene, parts)? })
    }

    /// The same for any view.
    pub(crate) fn of_view(view: &CameraView, scene: &SimulatedScene, parts: usize) -> Result<Self> {
        let size_px = scene.camera.size_px.map(|s| s * parts);
        let slab_from_ideal =
            view.ideal_from_slab.inverse().ok_or_else(|| Error::internal("camera view is singular"))?;
        let across = size_px[0] + 1;
        let corner = |i: usize| {
            let part = [i % across, i / across];
            let q: Point = std::array::from_fn(|a| part[a] as f64 / parts as f64 - 0.5);
            slab_from_ideal.map(view.lens.undistort(q))
        };
        let corners_mm = (0..across * (size_px[1] + 1)).into_par_iter().map(corner).collect();
        Ok(Self { size_px, parts, corners_mm, shift_px: [0.0; 2] })
    }

    /// A whole picture of `f`, averaged over each pixel by `rule(p)`, p the pixel's first corner: edges need more
    /// points than what lies between them.
    pub(crate) fn picture(
        &self,
        rule: impl Fn(Point) -> Rule + Sync,
        f: impl Fn(Point) -> [f64; 3] + Sync,
    ) -> RenderedPicture {
        self.picture_of(|pixel| pixel.mean(rule(pixel.first_corner_mm()), &f).map(|v| v as f32))
    }

    /// A whole picture of what `light` says of every pixel.
    pub(crate) fn picture_of(&self, light: impl Fn(&Pixel) -> [f32; 3] + Sync) -> RenderedPicture {
        let [width, height] = self.size_px;
        let mut picture = vec![[0.0; 3]; width * height];
        picture.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, to)| *to = light(&self.pixel(x, y)));
        });
        picture
    }

    #[inline(always)]
    fn pixel(&self, x: usize, y: usize) -> Pixel {
        let across = self.size_px[0] + 1;
        let i = y * across + x;
        Pixel { corners_mm: [i, i + 1, i + across, i + across + 1].map(|i| self.corners_mm[i]) }
    }

    /// A black picture.
    pub(crate) fn black(&self) -> RenderedPicture {
        vec![[0.0; 3]; self.size_px[0] * self.size_px[1]]
    }

    /// An upper bound of a pixel's extent on the slab along either axis, mm.
    pub(crate) fn pixel_mm(&self) -> f64 {
        let [width, height] = self.size_px;
        let places = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1), (width / 2, height / 2)];
        let extent = |(x, y)| {
            let corners_mm = self.pixel(x, y).corners_mm;
            let along = |a: usize| {
                let values = corners_mm.map(|p| p[a]);
                values.iter().copied().fold(f64::MIN, f64::max) - values.iter().copied().fold(f64::MAX, f64::min)
            };
            along(0).max(along(1))
        };
        // Between these places the scale changes by less than a tenth.
        1.1 * places.map(extent).into_iter().fold(0.0, f64::max)
    }

    /// Adds `scale` times `field` where it is not zero and the sample is in view.
    pub(crate) fn add_field(
        &self,
        picture: &mut RenderedPicture,
        scene: &SimulatedScene,
        field: &Field,
        scale: [f64; 3],
    ) {
        let mean = FieldMean::new(self.pixel_mm(), field);
        let [xs, ys] = self.seen(scene, field.bounds_mm());
        pulp::Arch::new().dispatch(AddField {
            pixels: self,
            picture,
            scene,
            mean,
            scale: scale.map(|s| s as f32),
            xs,
            ys,
        });
    }

    /// Adds a dot of the projector that falls on the frame, displaced by `drift_mm`.
    pub(crate) fn add_frame_dot(
        &self,
        picture: &mut RenderedPicture,
        scene: &SimulatedScene,
        dot_px: Point,
        drift_mm: Point,
        albedo_lit: f64,
    ) {
        let half = 0.5 * scene.grid.dot_projector_px as f64;
        let reach = half + 5.0 * scene.projector_blur_px;
        let corners = [[-reach, -reach], [reach, -reach], [-reach, reach], [reach, reach]].map(|r| {
            let p = scene.slab_from_projector.map([dot_px[0] + r[0], dot_px[1] + r[1]]);
            [p[0] + drift_mm[0], p[1] + drift_mm[1]]
        });
        let low: Point = std::array::from_fn(|a| corners.iter().map(|p| p[a]).fold(f64::MAX, f64::min));
        let high: Point = std::array::from_fn(|a| corners.iter().map(|p| p[a]).fold(f64::MIN, f64::max));
        let light = |p: Point| {
            let q = scene.slab_from_projector.projector_from_slab([p[0] - drift_mm[0], p[1] - drift_mm[1]]);
            let blur = scene.projector_blur_px;
            let lit = soft_dot([q[0] - dot_px[0], q[1] - dot_px[1]], half, blur, scene.has_round_dots());
            scene.white_irradiance(p).map(|e| albedo_lit * lit * e)
        };
        let [xs, ys] = self.seen(scene, [low, high]);
        for (y, x) in ys.flat_map(|y| xs.clone().map(move |x| (y, x))) {
            let mean = self.pixel(x, y).mean(GAUSS_6, light);
            let pixel = &mut picture[y * self.size_px[0] + x];
            pixel.iter_mut().zip(mean).for_each(|(p, m)| *p += m as f32);
        }
    }

    /// Columns and rows of the pixels that may see a rectangle of the slab.
    fn seen(&self, scene: &SimulatedScene, [low, high]: [Point; 2]) -> [Range<usize>; 2] {
        let corners = [low, [high[0], low[1]], [low[0], high[1]], high].map(|p| scene.view.camera_from_slab(p));
        let range = |a: usize| {
            let part = |q: f64| (q + self.shift_px[a] + 0.5) * self.parts as f64 - 0.5;
            let first = part(corners.iter().map(|q| q[a]).fold(f64::MAX, f64::min)) - 1.5;
            let last = part(corners.iter().map(|q| q[a]).fold(f64::MIN, f64::max)) + 1.5;
            let limit = self.size_px[a] as f64 - 1.0;
            first.clamp(0.0, limit) as usize..last.clamp(0.0, limit) as usize + 1
        };
        [range(0), range(1)]
    }
}

/// Light to be added to some columns and rows, as a value: so all of it is compiled for each kind of processor.
struct AddField<'a> {
    pixels: &'a PixelGrid,
    picture: &'a mut RenderedPicture,
    scene: &'a SimulatedScene,
    mean: FieldMean<'a>,
    scale: [f32; 3],
    xs: Range<usize>,
    ys: Range<usize>,
}

impl pulp::NullaryFnOnce for AddField<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let width = self.pixels.size_px[0];
        for y in self.ys {
            let row = &mut self.picture[y * width..][..width];
            for x in self.xs.clone() {
                let light = self.mean.on_sample(self.scene, &self.pixels.pixel(x, y));
                for c in 0..3 {
                    row[x][c] += light[c] * self.scale[c];
                }
            }
        }
    }
}

/// Albedo of the printed board at `p`: white paper everywhere around the squares, the first square dark.
pub(crate) fn board_albedo(scene: &SimulatedScene, p: Point) -> f64 {
    let board = &scene.board;
    let soft = board.edge_blur_mm / board.square_mm;
    // A square wave of each coordinate, −1 and +1, with soft edges; outside the squares there is only paper.
    let wave = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        let edge = nearest(t).clamp(0, board.inner_corners[a] as i64 - 1);
        let sign = if edge % 2 == 0 { 1.0 } else { -1.0 };
        sign * (2.0 * normal_cdf((t - edge as f64) / soft) - 1.0)
    };
    let inside = |a: usize| {
        let t = (p[a] - board.origin_mm[a]) / board.square_mm;
        normal_cdf((t + 1.0) / soft) * normal_cdf((board.inner_corners[a] as f64 - t) / soft)
    };
    let [dark, light] = BOARD_ALBEDO;
    let darkness = 0.5 * (1.0 + wave(0) * wave(1)) * inside(0) * inside(1);
    light + darkness * (dark - light)
}

/// How to average the board over pixels that begin at `p` and reach `pixel_mm` far.
pub(crate) fn board_rule(scene: &SimulatedScene, pixel_mm: f64, p: Point) -> Rule {
    let reach = (pixel_mm + 6.0 * scene.board.edge_blur_mm) / scene.board.square_mm;
    let between = |a: usize| {
        let t = (p[a] - scene.board.origin_mm[a]) / scene.board.square_mm;
        (t - nearest(t) as f64).abs() > reach
    };
    if between(0) && between(1) { GAUSS_1 } else { GAUSS_6 }
}

/// One bit of the Gray code, as projected.
#[derive(Debug, Clone, Copy)]
pub(crate) struct GrayCode {
    pub axis: Axis,
    pub bit: u32,
    pub inverse: bool,
    pub blur_px: f64,
}

impl GrayCode {
    /// Signed distance (projector px) of projector position `q` from the nearest edge, and whether light begins there.
    fn nearest_edge(&self, q: Point) -> (f64, bool) {
        let t = match self.axis {
            Axis::X => q[0],
            Axis::Y => q[1],
        };
        // Bit j of n XOR (n >> 1) changes where n passes 2^j, 2^j + 2^(j+1), …; the edge lies half a pixel before.
        let stripe = f64::from(2u32 << self.bit);
        let first = f64::from(1u32 << self.bit) - 0.5;
        let edge = nearest((t - first) / stripe);
        (t - first - edge as f64 * stripe, (edge % 2 == 0) != self.inverse)
    }

    /// Brightness 0..1 at projector position `q`, blurred across its edges.
    pub(crate) fn brightness(&self, q: Point) -> f64 {
        let (distance, rises) = self.nearest_edge(q);
        let after = blurred_step(distance, self.blur_px);
        if rises { after } else { 1.0 - after }
    }

    /// Brightness at `q` as a translucent sample shows it: the mean of the stripes over a Gaussian of two outgoing
    /// pitches.
    pub(crate) fn blurred(&self, q: Point, options: &SimulateOptions) -> f64 {
        const POINTS: i32 = 9;
        let sd = options.projector_px_mm().map(|mm| 2.0 * options.pitch_mm / mm);
        let (mut sum, mut weights) = (0.0, 0.0);
        for k in -POINTS..=POINTS {
            let t = 3.0 * f64::from(k) / f64::from(POINTS);
            let weight = (-0.5 * t * t).exp();
            sum += weight * self.brightness([q[0] + t * sd[0], q[1] + t * sd[1]]);
            weights += weight;
        }
        sum / weights
    }

    /// What pixels see that begin at `q` and reach `pixel_px` far.
    pub(crate) fn around(&self, q: Point, pixel_px: f64) -> Brightness {
        let (distance, rises) = self.nearest_edge(q);
        // Five standard deviations from an edge a step is complete to 3e-7.
        if distance.abs() > pixel_px + 5.0 * self.blur_px {
            return Brightness::Even(if (distance > 0.0) == rises { 1.0 } else { 0.0 });
        }
        // The error falls as the fourth and sixth power of pixel over blur: below 1e-4 of the step at these limits.
        Brightness::Edge(match pixel_px / self.blur_px {
            r if r < 0.7 => GAUSS_2,
            r if r < 1.5 => GAUSS_3,
            _ => GAUSS_6,
        })
    }
}

/// What a pixel sees of a projected pattern.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Brightness {
    /// The same all over.
    Even(f64),
    /// An edge, to be averaged by a rule.
    Edge(Rule),
}

/// The nearest whole number; `round` is a slow call on processors without SSE 4.1.
fn nearest(v: f64) -> i64 {
    let below = (v + 0.5) as i64;
    if below as f64 > v + 0.5 { below - 1 } else { below }
}

/// Means of a field over pixels that reach `pixel_mm` far: within a third of a voxel its spline is all but cubic.
#[derive(Debug)]
pub(crate) struct FieldMean<'a> {
    field: &'a Field,
    fine: bool,
    four: Nodes<4>,
    nine: Nodes<9>,
}

impl<'a> FieldMean<'a> {
    /// For pixels of that extent.
    pub(crate) fn new(pixel_mm: f64, field: &'a Field) -> Self {
        let fine = 3.0 * pixel_mm < field.cell_mm();
        Self { field, fine, four: Nodes::new(GAUSS_2), nine: Nodes::new(GAUSS_3) }
    }

    /// The mean over a pixel of the field where the sample is in view, of zero elsewhere.
    #[inline(always)]
    pub(crate) fn on_sample(&self, scene: &SimulatedScene, pixel: &Pixel) -> [f32; 3] {
        if pixel.corners_mm.iter().all(|&p| scene.on_sample(p)) {
            let mean = match self.fine {
                true => self.field.mean_over(&self.four, pixel.corners_mm),
                false => self.field.mean_over(&self.nine, pixel.corners_mm),
            };
            if let Some(mean) = mean {
                return mean;
            }
        }
        let light = |p: Point| if scene.on_sample(p) { self.field.at(p).map(f64::from) } else { [0.0; 3] };
        pixel.mean(if self.fine { GAUSS_2 } else { GAUSS_3 }, light).map(|v| v as f32)
    }
}

/// A step from 0 to 1 at 0, blurred by a normal distribution.
fn blurred_step(t: f64, blur: f64) -> f64 {
    // Sharp steps stay finite where both are zero.
    normal_cdf(t / blur.max(1e-9))
}

/// A blurred square of half a side `half`, or a blurred disc of this radius, at `q` from its middle.
///
/// The disc: chords, each a blurred line along x, blurred along y; midpoints of the angle, right to 1e-4 for blurs of a
/// tenth of the radius and more.
pub(crate) fn soft_dot(q: Point, half: f64, blur_px: f64, round: bool) -> f64 {
    if !round {
        return soft_box(q[0], half, blur_px) * soft_box(q[1], half, blur_px);
    }
    let chord = |k: usize| {
        let angle = std::f64::consts::PI * ((k as f64 + 0.5) / CHORDS as f64 - 0.5);
        let (y, width) = (half * angle.sin(), half * angle.cos());
        let far = (q[1] - y) / blur_px;
        soft_box(q[0], width, blur_px) * (-0.5 * far * far).exp() * width
    };
    let norm = (std::f64::consts::PI / 2.0).sqrt() / (CHORDS as f64 * blur_px);
    norm * (0..CHORDS).map(chord).sum::<f64>()
}

/// Chords of a disc.
const CHORDS: usize = 64;

/// A box of half width `half`, blurred as the projector's pixels are; its integral stays 2 · half.
fn soft_box(t: f64, half: f64, blur_px: f64) -> f64 {
    blurred_step(t + half, blur_px) - blurred_step(t - half, blur_px)
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
                assert!(
                    (GrayCode { axis: Axis::X, bit, inverse: false, blur_px: 0.3 }.brightness(q) - expected).abs()
                        < 0.05,
                    "bit {bit}, column {n}"
                );
                assert!(
                    (GrayCode { axis: Axis::Y, bit, inverse: true, blur_px: 0.3 }.brightness(q) + expected - 1.0).abs()
                        < 0.05
                );
            }
        }
    }
}
