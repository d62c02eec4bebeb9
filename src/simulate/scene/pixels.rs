//! What the camera receives: the light of a scene averaged over the area of each pixel, some rows at a time.

use super::SimulatedScene;
use super::patterns::soft_dot;
use crate::simulate::light::field::{Field, Nodes};
use crate::{
    Error, Result,
    geometry::{CameraView, Homography, Point},
};
use rayon::prelude::*;
use std::ops::Range;

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

/// Where the corners of some rows of pixels, or of equal parts of them, lie on the slab; within one, bilinear between
/// them.
#[derive(Debug)]
pub(crate) struct PixelGrid {
    view: CameraView,
    /// Parts of a camera pixel along each axis.
    parts: usize,
    /// Of the picture, in parts.
    width: usize,
    /// In parts.
    rows: Range<usize>,
    corners_mm: Vec<Point>,
    /// An upper bound of a pixel's extent on the slab along either axis.
    pixel_mm: f64,
}

/// Corners are projected back onto the slab at every so many pixels of a row at most, and at [`NODES`] places of it at
/// least; between them a cubic is right to 1e-5 px (test).
const NODE_PX: usize = 16;
const NODES: usize = 64;

impl PixelGrid {
    /// Projects the corners of the pixels of `rows` (camera px), cut into `parts` along each axis, back onto the slab.
    pub(crate) fn new(view: &CameraView, size_px: [usize; 2], parts: usize, rows: &Range<usize>) -> Result<Self> {
        let slab_from_ideal =
            view.ideal_from_slab.inverse().ok_or_else(|| Error::internal("camera view is singular"))?;
        let corner = |part: [f64; 2]| slab_from_ideal.map(view.lens.undistort(part.map(|p| p / parts as f64 - 0.5)));
        let width = size_px[0] * parts;
        let step = (size_px[0] / NODES).clamp(1, NODE_PX) * parts;
        let steps = width.div_ceil(step);
        let weights: Vec<[f64; 4]> = (0..step).map(|k| cubic(k as f64 / step as f64)).collect();
        let rows = rows.start * parts..rows.end * parts;
        let line = |y: usize| {
            // One node before the first and one behind the last, for the cubics there.
            let nodes: Vec<Point> =
                (0..steps + 3).map(|n| corner([(n * step) as f64 - step as f64, y as f64])).collect();
            let nodes = &nodes;
            let weights = &weights;
            (0..=width)
                .map(move |x| match (x / step, x % step) {
                    (n, 0) => nodes[n + 1],
                    (n, k) => [0, 1].map(|a| (0..4).map(|j| weights[k][j] * nodes[n + j][a]).sum()),
                })
                .collect::<Vec<Point>>()
        };
        let corners_mm = (rows.start..rows.end + 1).into_par_iter().flat_map_iter(line).collect();
        let pixel_mm = pixel_mm(|x, y| corner([(x * parts) as f64, (y * parts) as f64]), size_px) / parts as f64;
        Ok(Self { view: *view, parts, width, rows, corners_mm, pixel_mm })
    }

    /// A picture of `f`, averaged over each pixel by `rule(p)`, p the pixel's first corner: edges need more
    /// points than what lies between them.
    pub(crate) fn picture(
        &self,
        rule: impl Fn(Point) -> Rule + Sync,
        f: impl Fn(Point) -> [f64; 3] + Sync,
    ) -> RenderedPicture {
        self.picture_of(|pixel| pixel.mean(rule(pixel.first_corner_mm()), &f).map(|v| v as f32))
    }

    /// A picture of what `light` says of every pixel.
    pub(crate) fn picture_of(&self, light: impl Fn(&Pixel) -> [f32; 3] + Sync) -> RenderedPicture {
        let mut picture = self.black();
        picture.par_chunks_mut(self.width).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, to)| *to = light(&self.pixel(x, y)));
        });
        picture
    }

    /// Pixel, or part of one, `x` of row `y` of these.
    #[inline(always)]
    fn pixel(&self, x: usize, y: usize) -> Pixel {
        let across = self.width + 1;
        let i = y * across + x;
        Pixel { corners_mm: [i, i + 1, i + across, i + across + 1].map(|i| self.corners_mm[i]) }
    }

    /// A black picture.
    pub(crate) fn black(&self) -> RenderedPicture {
        vec![[0.0; 3]; self.width * self.rows.len()]
    }

    /// An upper bound of a pixel's extent on the slab along either axis, mm.
    pub(crate) fn pixel_mm(&self) -> f64 {
        self.pixel_mm
    }

    /// Adds `scale` times `field` where it is not zero and the sample is in view.
    pub(crate) fn add_field(
        &self,
        picture: &mut RenderedPicture,
        scene: &SimulatedScene,
        field: &Field,
        scale: [f64; 3],
    ) {
        let mean = FieldMean::new(self.pixel_mm, field);
        let [xs, ys] = self.seen(field.bounds_mm());
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
        let [xs, ys] = self.seen([low, high]);
        for (y, x) in ys.flat_map(|y| xs.clone().map(move |x| (y, x))) {
            let mean = self.pixel(x, y).mean(GAUSS_6, light);
            let pixel = &mut picture[y * self.width + x];
            pixel.iter_mut().zip(mean).for_each(|(p, m)| *p += m as f32);
        }
    }

    /// Columns and rows (of these) of the pixels that may see a rectangle of the slab.
    fn seen(&self, rectangle_mm: [Point; 2]) -> [Range<usize>; 2] {
        let [xs, ys] = seen_px(&self.view, rectangle_mm).map(|px| px.map(|q| (q + 0.5) * self.parts as f64 - 0.5));
        let within = |[first, last]: [f64; 2], limits: &Range<usize>| {
            let [start, end] = [limits.start, limits.end].map(|v| v as f64);
            let [first, last] = [first - 1.5, last + 2.5].map(|v| v.clamp(start, end) as usize - limits.start);
            first..last
        };
        [within(xs, &(0..self.width)), within(ys, &self.rows)]
    }
}

/// Between which camera columns and which rows a rectangle of the slab (mm: first and last corner) is seen.
pub(crate) fn seen_px(view: &CameraView, [low, high]: [Point; 2]) -> [[f64; 2]; 2] {
    // Corners and middles of the sides, which a lens makes round.
    let middle = [0, 1].map(|a| 0.5 * (low[a] + high[a]));
    let along = [low, middle, high];
    let rim = (0..9).filter(|i| *i != 4).map(|i| view.camera_from_slab([along[i % 3][0], along[i / 3][1]]));
    let mut range = [[f64::MAX, f64::MIN]; 2];
    for q in rim {
        (0..2).for_each(|a| range[a] = [range[a][0].min(q[a]), range[a][1].max(q[a])]);
    }
    range
}

/// A view whose picture has moved by `shift_px`.
pub(crate) fn moved_view(view: &CameraView, shift_px: Point) -> CameraView {
    let mut view = *view;
    view.ideal_from_slab = Homography::similarity(1.0, shift_px).after(&view.ideal_from_slab);
    view.lens.center_px = [0, 1].map(|a| view.lens.center_px[a] + shift_px[a]);
    view
}

/// Weights of four equidistant nodes in the cubic through them, `t` (0 to 1) past the second.
fn cubic(t: f64) -> [f64; 4] {
    let (u, v, w) = (t + 1.0, t - 1.0, t - 2.0);
    [-t * v * w / 6.0, u * v * w / 2.0, -u * t * w / 2.0, u * t * v / 6.0]
}

/// An upper bound of a pixel's extent on the slab along either axis, mm, from the places of its corners.
fn pixel_mm(corner: impl Fn(usize, usize) -> Point, [width, height]: [usize; 2]) -> f64 {
    let places = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1), (width / 2, height / 2)];
    let extent = |(x, y): (usize, usize)| {
        let corners_mm = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].map(|(x, y)| corner(x, y));
        let along = |a: usize| {
            let values = corners_mm.map(|p| p[a]);
            values.iter().copied().fold(f64::MIN, f64::max) - values.iter().copied().fold(f64::MAX, f64::min)
        };
        along(0).max(along(1))
    };
    // Between these places the scale changes by less than a tenth.
    1.1 * places.map(extent).into_iter().fold(0.0, f64::max)
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
        let width = self.pixels.width;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Lens;

    /// An oblique view through a lens with strong distortion.
    fn view(size_px: [usize; 2]) -> CameraView {
        let [width, height] = size_px.map(|s| s as f64);
        let scale = width / 40.0;
        CameraView {
            ideal_from_slab: Homography {
                matrix: [[scale, 0.1 * scale, 3.0], [-0.05 * scale, 0.8 * scale, 7.0], [2e-3, -4e-3, 1.0]],
            },
            lens: Lens { center_px: [0.53 * width, 0.46 * height], focal_px: 1.4 * width, k1: -0.4, k2: 0.08 },
        }
    }

    #[test]
    fn corners_between_the_nodes_are_where_the_camera_sees_them() {
        for (size_px, parts) in [([37, 21], 1), ([245, 30], 2), ([1600, 12], 1), ([6000, 9], 3)] {
            let view = view(size_px);
            let rows = size_px[1] / 3..size_px[1] / 2;
            let grid = PixelGrid::new(&view, size_px, parts, &rows).unwrap();
            for (i, &p) in grid.corners_mm.iter().enumerate() {
                let at = [i % (grid.width + 1), grid.rows.start + i / (grid.width + 1)];
                let q = view.camera_from_slab(p);
                let error = [0, 1].map(|a| (q[a] - (at[a] as f64 / parts as f64 - 0.5)).abs());
                // As stated at `NODE_PX`.
                assert!(error[0] < 1e-5 && error[1] < 1e-5, "{size_px:?} {at:?}: {error:?}");
            }
        }
    }

    #[test]
    fn strips_are_the_rows_of_the_whole() {
        let (size_px, parts) = ([50, 40], 2);
        let view = view(size_px);
        let light = |pixel: &Pixel| pixel.mean(GAUSS_2, |p| [p[0], p[1], 1.0]).map(|v| v as f32);
        let whole = PixelGrid::new(&view, size_px, parts, &(0..40)).unwrap().picture_of(light);
        let strips: RenderedPicture = [0..7, 7..32, 32..40]
            .iter()
            .flat_map(|rows| PixelGrid::new(&view, size_px, parts, rows).unwrap().picture_of(light))
            .collect();
        assert!(whole == strips);
    }
}
