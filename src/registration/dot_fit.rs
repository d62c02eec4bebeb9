//! The sharp core of a projected dot, found on a translucent sample whose glow is not symmetric.

use crate::cholesky::solve_small;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// Lengths of a fit are counted in units: a camera pixel, or for dots of more than four pixels a quarter of their side, so
/// that a dot looks the same in whichever resolution. Half the side of the largest dot whose unit is a pixel, px.
const HALF_PX: f64 = 2.0;
/// Points of the template across a unit.
const FINE: usize = 8;
/// Blur of lens and projector that is tried, standard deviation, units.
const BLURS: [f64; 6] = [0.2, 0.35, 0.5, 0.7, 1.0, 1.4];
/// Units around the dot in which glow and core are told apart.
const AROUND: f64 = 3.0;
/// Steps of Gauss and Newton; they settle in five.
const STEPS: usize = 12;
/// Unknowns: core, its place, and the glow: level, slopes, curvature.
const UNKNOWNS: usize = 7;

/// The footprint of a dot as pixels see it, for several blurs.
#[derive(Debug, Clone)]
pub struct DotShape {
    templates: Vec<Vec<f64>>,
    across: usize,
    radius_px: f64,
    /// Camera pixels.
    unit_px: f64,
}

/// Where the core of a dot was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundDot {
    /// Its centre, camera px.
    pub at: Point,
    /// Variance of the centre per axis from the noise of the pixels, px².
    pub variance: f64,
    /// Light of the core above the glow over its standard deviation.
    pub contrast: f64,
    /// What the model leaves of the light around the dot, RMS over the core's height.
    pub misfit: f64,
}

impl DotShape {
    /// The footprint of a square of `side_px` projector pixels under `camera_from_projector`, the local derivative (px
    /// per px).
    pub fn new(camera_from_projector: [[f64; 2]; 2], side_px: f64) -> Option<Self> {
        let half_px = |[[a, b], [c, d]]: [[f64; 2]; 2]| 0.5 * side_px * (a.abs() + b.abs()).max(c.abs() + d.abs());
        let unit_px = (half_px(camera_from_projector) / HALF_PX).max(1.0);
        let [[a, b], [c, d]] = camera_from_projector.map(|row| row.map(|v| v / unit_px));
        let det = a * d - b * c;
        if !(det.abs() * unit_px * unit_px > 1e-12) || !(half_px(camera_from_projector) < 100.0) {
            return None;
        }
        let radius = half_px(camera_from_projector) / unit_px + AROUND;
        let blur_reach = 4.0 * BLURS[BLURS.len() - 1] + 1.0;
        let side = 2 * ((radius + blur_reach) * FINE as f64).ceil() as usize + 1;
        let middle = (side / 2) as f64;
        let inside = |x: f64, y: f64| {
            let (u, v) = ((d * x - b * y) / det, (a * y - c * x) / det);
            u.abs() <= 0.5 * side_px && v.abs() <= 0.5 * side_px
        };
        // Four by four points a cell: the footprint's edge is placed to a thirtieth of a unit.
        let cell = |k: usize| {
            let (x, y) = ((k % side) as f64 - middle, (k / side) as f64 - middle);
            let sub = |n: usize| (n as f64 - 1.5) / 4.0;
            let lit =
                (0..16).filter(|n| inside((x + sub(n % 4)) / FINE as f64, (y + sub(n / 4)) / FINE as f64)).count();
            lit as f64 / 16.0
        };
        let sharp: Vec<f64> = (0..side * side).map(cell).collect();
        let templates = BLURS.iter().map(|&blur| blurred(&sharp, side, blur, 1.0 / unit_px)).collect();
        Some(Self { templates, across: side, radius_px: unit_px * radius, unit_px })
    }

    /// How far from the dot's centre pixels are looked at, px.
    pub fn radius_px(&self) -> f64 {
        self.radius_px
    }

    /// The core of the dot whose centre is near `start` (camera px, to a quarter of its side or two).
    ///
    /// The light around is taken for the footprint times a height, plus a glow that changes smoothly (level, slopes,
    /// isotropic curvature): slopes of a glow that is brighter on one side move no core. The blur is that of `BLURS`
    /// that leaves least. `None` when pixels are invalid or outside, or the fit wanders off.
    ///
    /// Not detected: an edge between materials within the footprint itself, which moves the core's own light.
    pub fn find(&self, picture: &Radiance, start: Point) -> Option<FoundDot> {
        let window = PixelLight::new(picture);
        let mut best: Option<FoundDot> = None;
        for template in &self.templates {
            let from = best.map_or(start, |b| b.at);
            if let Some(found) = self.fit(template, &window, from) {
                if best.is_none_or(|b| found.misfit < b.misfit) {
                    best = Some(found);
                } else if best.is_some() {
                    break;
                }
            }
        }
        best
    }

    fn fit(&self, template: &[f64], window: &PixelLight, start: Point) -> Option<FoundDot> {
        let mut at = start;
        let mut last = None;
        for _ in 0..STEPS {
            let (matrix, right, sums) = self.equations(template, window, at)?;
            let solved = solve_small(matrix, right)?;
            let [core, sx, sy, ..] = solved.0;
            if !(core > 0.0) {
                return None;
            }
            let step = [sx / core, sy / core];
            let length = step[0].hypot(step[1]);
            let limit = if length > self.unit_px { self.unit_px / length } else { 1.0 };
            at = [at[0] + limit * step[0], at[1] + limit * step[1]];
            if (at[0] - start[0]).hypot(at[1] - start[1]) > 3.0 * self.unit_px {
                return None;
            }
            let left = (sums.square - solved.0.iter().zip(right).map(|(a, b)| a * b).sum::<f64>()).max(0.0);
            // Errors of the pixels are about equal over so small a window: the mean stands for all.
            let noise = sums.noise / sums.weight;
            let variance = noise * 0.5 * (solved.1[1] + solved.1[2]) / (core * core);
            let contrast = core / (noise * solved.1[0]).sqrt().max(f64::MIN_POSITIVE);
            last = Some(FoundDot { at, variance, contrast, misfit: (left / sums.weight).sqrt() / core });
            if length < 1e-4 {
                return last;
            }
        }
        last
    }

    /// Normal equations about `at`, weighted by a taper that moves with it.
    fn equations(
        &self,
        template: &[f64],
        w: &PixelLight,
        at: Point,
    ) -> Option<([[f64; UNKNOWNS]; UNKNOWNS], [f64; UNKNOWNS], Sums)> {
        let r = self.radius_px;
        let (x0, x1) = ((at[0] - r).ceil(), (at[0] + r).floor());
        let (y0, y1) = ((at[1] - r).ceil(), (at[1] + r).floor());
        let rect = w.rect;
        let inside =
            |low: f64, high: f64, from: usize, len: usize| low >= from as f64 && high <= (from + len - 1) as f64;
        if !inside(x0, x1, rect.x, rect.width) || !inside(y0, y1, rect.y, rect.height) {
            return None;
        }
        let mut matrix = [[0.0; UNKNOWNS]; UNKNOWNS];
        let mut right = [0.0; UNKNOWNS];
        let mut sums = Sums { square: 0.0, weight: 0.0, noise: 0.0 };
        for y in y0 as usize..=y1 as usize {
            for x in x0 as usize..=x1 as usize {
                let (dx, dy) = (x as f64 - at[0], y as f64 - at[1]);
                let far = (dx * dx + dy * dy) / (r * r);
                if far >= 1.0 {
                    continue;
                }
                let k = (y - rect.y) * rect.width + x - rect.x;
                let (light, noise) = w.light[k]?;
                let weight = (1.0 - far).powi(2);
                let [t, tx, ty] = self.template_at(template, dx, dy);
                // The centre moves against the argument of the template.
                let row = [t, -tx, -ty, 1.0, dx / r, dy / r, far];
                for i in 0..UNKNOWNS {
                    for j in 0..=i {
                        matrix[i][j] += weight * row[i] * row[j];
                    }
                    right[i] += weight * row[i] * light;
                }
                sums.square += weight * light * light;
                sums.weight += weight;
                sums.noise += weight * noise;
            }
        }
        Some((matrix, right, sums))
    }

    /// The template and its derivatives by px at an offset from the dot's centre, px.
    fn template_at(&self, template: &[f64], dx: f64, dy: f64) -> [f64; 3] {
        let middle = (self.across / 2) as f64;
        let fine = FINE as f64 / self.unit_px;
        let (u, v) = (dx * fine + middle, dy * fine + middle);
        let (i, j) = (u as usize, v as usize);
        let (fu, fv) = (u - i as f64, v - j as f64);
        let at = |i: usize, j: usize| template[j * self.across + i];
        let mix = |f: &dyn Fn(usize, usize) -> f64| {
            (1.0 - fv) * ((1.0 - fu) * f(i, j) + fu * f(i + 1, j))
                + fv * ((1.0 - fu) * f(i, j + 1) + fu * f(i + 1, j + 1))
        };
        let slope = 0.5 * fine;
        [
            mix(&|i, j| at(i, j)),
            slope * mix(&|i, j| at(i + 1, j) - at(i - 1, j)),
            slope * mix(&|i, j| at(i, j + 1) - at(i, j - 1)),
        ]
    }
}

struct Sums {
    square: f64,
    weight: f64,
    noise: f64,
}

/// Light and variance of a picture's pixels, `None` where no exposure measured them.
struct PixelLight {
    rect: crate::capture::Rect,
    light: Vec<Option<(f64, f64)>>,
}

impl PixelLight {
    fn new(picture: &Radiance) -> Self {
        let used = picture.used.as_chunks::<3>().0.iter().map(|u| !u.contains(&0));
        let light = picture.luminance().into_iter().zip(picture.luminance_variance()).zip(used);
        let light = light.map(|((l, v), used)| used.then_some((f64::from(l), f64::from(v)))).collect();
        Self { rect: picture.rect, light }
    }
}

/// A picture of cells averaged over a pixel and blurred by a normal distribution, both along x and y; lengths in units.
fn blurred(sharp: &[f64], side: usize, blur: f64, pixel: f64) -> Vec<f64> {
    let (sd, half) = (blur * FINE as f64, 0.5 * pixel * FINE as f64);
    let half_cells = half.ceil() as isize;
    let reach = (4.0 * sd).ceil() as isize + half_cells;
    // How much of a cell is in the pixel: half of each outermost one, where pixels are whole cells.
    let share = |k: isize| (half - k.unsigned_abs() as f64 + 0.5).clamp(0.0, 1.0).min(2.0 * half);
    let kernel: Vec<f64> = (-reach..=reach)
        .map(|k| {
            let of = |m: isize| share(m) * (-0.5 * ((k - m) as f64 / sd).powi(2)).exp();
            (-half_cells..=half_cells).map(of).sum::<f64>()
        })
        .collect();
    let sum: f64 = kernel.iter().sum();
    let pass = |from: &[f64], step: usize, other: usize| -> Vec<f64> {
        let mut to = vec![0.0; from.len()];
        for line in 0..side {
            for k in 0..side {
                let first = (k as isize - reach).max(0);
                let last = (k as isize + reach).min(side as isize - 1);
                let value: f64 = (first..=last)
                    .map(|m| kernel[(m - k as isize + reach) as usize] * from[line * other + m as usize * step])
                    .sum();
                to[line * other + k * step] = value / sum;
            }
        }
        to
    };
    pass(&pass(sharp, 1, side), side, 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{jitter, picture};
    use crate::capture::Rect;

    /// Projector to camera: no axis is like the other.
    const SLOPE: [[f64; 2]; 2] = [[1.1, 0.3], [-0.2, 1.6]];
    const RECT: Rect = Rect { x: 31, y: 17, width: 25, height: 21 };

    /// The light of a dot of 2 × 2 projector px under a Gaussian blur, averaged over a pixel: a sum over places of the
    /// dot.
    fn dot(center: Point, blur_px: f64, x: f64, y: f64) -> f64 {
        let cdf = |t: f64| 0.5 * libm::erfc(-t / (blur_px * std::f64::consts::SQRT_2));
        let pixel = |d: f64| cdf(d + 0.5) - cdf(d - 0.5);
        let place = |k: usize| 2.0 * ((k as f64 + 0.5) / 16.0 - 0.5);
        let mut sum = 0.0;
        for k in 0..256 {
            let (u, v) = (place(k % 16), place(k / 16));
            let at = [0, 1].map(|a| center[a] + SLOPE[a][0] * u + SLOPE[a][1] * v);
            sum += pixel(x - at[0]) * pixel(y - at[1]);
        }
        // The footprint's area in camera px: a pixel wholly within it has the light 1.
        sum / 256.0 * 4.0 * (1.1 * 1.6 + 0.2 * 0.3)
    }

    /// Made once: its templates are the slow part.
    fn shape() -> &'static DotShape {
        static SHAPE: std::sync::OnceLock<DotShape> = std::sync::OnceLock::new();
        SHAPE.get_or_init(|| DotShape::new(SLOPE, 2.0).unwrap())
    }

    #[test]
    fn pixels_are_looked_at_three_beyond_the_footprint() {
        // Half of 2 · max(1.1 + 0.3, 0.2 + 1.6), and three more.
        assert!((shape().radius_px() - 4.8).abs() < 1e-12);
        assert!(DotShape::new([[1.0, 2.0], [2.0, 4.0]], 2.0).is_none(), "a line");
        assert!(DotShape::new(SLOPE, 112.0).is_none() && DotShape::new(SLOPE, f64::NAN).is_none());
    }

    #[test]
    fn a_dot_of_many_pixels_is_found_as_one_of_few_is() {
        // Five times as many pixels along each axis: the light of the small picture at every place.
        let shape = DotShape::new(SLOPE.map(|row| row.map(|v| 5.0 * v)), 2.0).unwrap();
        // Half of 2 · 5 · 1.8 is 9: in units of 4.5 px, 2 and 3 more.
        assert!((shape.unit_px - 4.5).abs() < 1e-12 && (shape.radius_px() - 22.5).abs() < 1e-12);
        let (center, rect) = ([43.37, 26.81], Rect { x: 155, y: 85, width: 125, height: 105 });
        let light = |x: f64, y: f64| {
            let (x, y) = (x / 5.0, y / 5.0);
            let (dx, dy) = (x - center[0], y - center[1]);
            // An edge of two materials at the footprint's rim: no glow of level, slope and curvature.
            let edge = if dx > 1.6 { 12.0 } else { 0.0 };
            50.0 * dot(center, 0.35, x, y) + 20.0 + 3.0 * dx - 1.5 * dy - 0.3 * (dx * dx + dy * dy) + edge
        };
        let found = shape.find(&picture(rect, light, 0.01), [220.0, 130.0]).unwrap();
        let off = [0, 1].map(|a| found.at[a] / 5.0 - center[a]);
        // The edge draws it aside by a hundredth of what it is high, of the dot.
        assert!(off[0].hypot(off[1]) < 0.1, "{off:?}");
    }

    #[test]
    fn the_core_of_a_dot_is_found_under_a_glow_that_leans_to_one_side() {
        let center = [43.37, 26.81];
        for blur in [0.35, 0.8] {
            let glow = |x: f64, y: f64| {
                let (dx, dy) = (x - center[0], y - center[1]);
                20.0 + 3.0 * dx - 1.5 * dy - 0.3 * (dx * dx + dy * dy)
            };
            let picture = picture(RECT, |x, y| 50.0 * dot(center, blur, x, y) + glow(x, y), 0.01);
            let found = shape().find(&picture, [44.0, 26.0]).unwrap();
            // A blur of 0.8 is between two of the templates.
            assert!((found.at[0] - center[0]).hypot(found.at[1] - center[1]) < 0.01, "{blur}: {found:?}");
            assert!(found.misfit < 0.01, "{found:?}");
        }
    }

    #[test]
    fn a_dot_strays_by_no_more_than_its_deviation_from_one_noise_to_the_next() {
        let center = [43.37, 26.81];
        let clean = picture(RECT, |x, y| 50.0 * dot(center, 0.5, x, y) + 20.0, 0.0);
        let found = |draw: usize| {
            let mut noisy = clean.clone();
            noisy.variance.fill(4.0);
            // Even in ±2: a variance of 4/3, that of the mean of three channels of 4.
            noisy.value.iter_mut().enumerate().for_each(|(k, v)| *v += 2.0 * jitter(1000 * draw + k / 3) as f32);
            shape().find(&noisy, center).unwrap()
        };
        let all: Vec<FoundDot> = (0..60).map(found).collect();
        let strays = all.iter().map(|f| (0..2).map(|a| (f.at[a] - center[a]).powi(2)).sum::<f64>() / 2.0);
        let (strays, told) = (strays.sum::<f64>() / 60.0, all.iter().map(|f| f.variance).sum::<f64>() / 60.0);
        // Weights of the taper count as if they were variances: the deviation is told too large, by less than twice;
        // 120 draws tell a variance to 13 %.
        assert!(strays < 1.3 * told && strays > 0.3 * told, "{strays} {told}");
    }

    #[test]
    fn contrast_and_variance_go_with_light_and_noise() {
        let find = |light: f64, variance: f64| {
            let center = [43.37, 26.81];
            let picture = picture(RECT, |x, y| light * dot(center, 0.5, x, y) + 7.0, variance);
            shape().find(&picture, center).unwrap()
        };
        let (one, bright, noisy) = (find(50.0, 0.01), find(100.0, 0.01), find(50.0, 0.04));
        // Values are f32, and the fit settles to 1e-4 px.
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-3;
        assert!(near(bright.contrast, 2.0 * one.contrast) && near(noisy.contrast, 0.5 * one.contrast));
        assert!(near(bright.variance, 0.25 * one.variance) && near(noisy.variance, 4.0 * one.variance));
    }

    #[test]
    fn a_dot_that_is_cut_off_unmeasured_dark_or_elsewhere_is_not_found() {
        let at = |center: Point| picture(RECT, |x, y| 50.0 * dot(center, 0.5, x, y) + 7.0, 0.01);
        // 4.8 px around it: columns 31 to 55, lines 17 to 37.
        let seen = |center: Point| shape().find(&at(center), center).is_some();
        assert!(seen([34.9, 20.9]) && seen([51.1, 33.1]));
        assert!(!seen([34.7, 26.0]) && !seen([43.0, 20.7]) && !seen([51.3, 26.0]) && !seen([43.0, 33.3]));
        let center = [43.4, 26.8];
        let broken = |x: usize, y: usize| {
            let mut picture = at(center);
            let k = picture.at(x, y);
            picture.used[k + 1] = 0;
            shape().find(&picture, center).is_some()
        };
        assert!(!broken(43, 27) && !broken(47, 28) && broken(50, 28) && broken(43, 33));
        assert_eq!(shape().find(&picture(RECT, |x, y| 90.0 - 40.0 * dot(center, 0.5, x, y), 0.01), center), None);
        assert_eq!(shape().find(&at([47.0, 26.8]), [43.0, 26.8]), None, "four pixels off");
    }

    #[test]
    fn a_template_is_the_footprint_averaged_over_a_pixel_and_blurred() {
        let shape = shape();
        for (n, blur) in [(1, 0.35), (4, 1.0)] {
            for (dx, dy) in [(0.0, 0.0), (1.3, -0.4), (-0.7, 2.1), (2.2, 1.0)] {
                let value = |x: f64, y: f64| dot([0.0; 2], blur, x, y);
                let h = 1e-3;
                let expected = [
                    value(dx, dy),
                    (value(dx + h, dy) - value(dx - h, dy)) / (2.0 * h),
                    (value(dx, dy + h) - value(dx, dy - h)) / (2.0 * h),
                ];
                let found = shape.template_at(&shape.templates[n], dx, dy);
                // Cells of an eighth of a pixel, between which it is bilinear: curvature times 1/512, and slopes' by
                // more.
                assert!((found[0] - expected[0]).abs() < 0.01, "{blur} ({dx}, {dy}): {found:?} {expected:?}");
                assert!(
                    (1..3).all(|k| (found[k] - expected[k]).abs() < 0.03),
                    "{blur} ({dx}, {dy}): {found:?} {expected:?}"
                );
            }
        }
    }
}
