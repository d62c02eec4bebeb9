//! What each pattern shows.

use super::Studio;
use crate::capture::{Pattern, Surface};
use crate::geometry::Point;
use crate::simulate::SimulateOptions;
use crate::simulate::scene::patterns::{Brightness, GrayCode, board_albedo, board_rule};
use crate::simulate::scene::pixels::{FieldMean, GAUSS_1, GAUSS_6, Pixel, PixelGrid, RenderedPicture, Rule};

impl Studio {
    /// A shot without dots; the Gray code is projected `moved_px` beside its place.
    pub(super) fn still(
        &self,
        options: &SimulateOptions,
        pattern: &Pattern,
        moved_px: Point,
        pixels: &PixelGrid,
    ) -> RenderedPicture {
        let (scene, black) = (&self.bench.scene, options.projector_black);
        let irradiance = |p: Point, lit: f64| {
            let projected = black + (1.0 - black) * lit;
            scene.white_irradiance(p).map(|e| e * projected + options.ambient)
        };
        let white = |p: Point, lit: f64| {
            let light = irradiance(p, lit);
            let reflectance = scene.white_reflectance(p);
            std::array::from_fn(|c| light[c] * reflectance[c])
        };
        let projector_px = |p: Point| {
            let [x, y] = scene.slab_from_projector.projector_from_slab(p);
            [x - moved_px[0], y - moved_px[1]]
        };
        match *pattern {
            Pattern::Board | Pattern::CalibrationBoard => self.board(options, pixels),
            Pattern::ReferenceWhite => pixels.picture(|_| GAUSS_1, |p| white(p, 1.0)),
            Pattern::ReferenceBlack => pixels.picture(|_| GAUSS_1, |p| white(p, 0.0)),
            Pattern::GrayCode { axis, bit, inverse, on: Surface::Frame } => {
                let code = GrayCode { axis, bit, inverse, blur_px: scene.projector_blur_px };
                let pixel_px = self.pixel_projector_px(options, pixels);
                let rule = |pixel: &Pixel| match code.around(projector_px(pixel.first_corner_mm()), pixel_px) {
                    Brightness::Even(_) => GAUSS_1,
                    Brightness::Edge(rule) => rule,
                };
                let moved = |p: Point| [p[0] - moved_px[0], p[1] - moved_px[1]];
                let sharp = |p: Point| code.brightness(moved(p));
                self.lit_sample(options, pixels, rule, sharp, |p| code.blurred(moved(p), options))
            }
            Pattern::GrayCode { axis, bit, inverse, on: Surface::WhiteReference } => {
                let code = GrayCode { axis, bit, inverse, blur_px: scene.projector_blur_px };
                let pixel_px = self.pixel_projector_px(options, pixels);
                pixels.picture_of(|pixel| {
                    let light = match code.around(projector_px(pixel.first_corner_mm()), pixel_px) {
                        Brightness::Even(lit) => pixel.mean(GAUSS_1, |p| white(p, lit)),
                        Brightness::Edge(rule) => pixel.mean(rule, |p| white(p, code.brightness(projector_px(p)))),
                    };
                    light.map(|v| v as f32)
                })
            }
            Pattern::Frame => self.lit_sample(options, pixels, |_| GAUSS_1, |_| 1.0, |_| 1.0),
            Pattern::SampleBlack | Pattern::Lattice { .. } => self.dark_sample(options, pixels),
            Pattern::Dark => pixels.black(),
        }
    }

    /// An upper bound of a camera pixel's extent, projector px.
    fn pixel_projector_px(&self, options: &SimulateOptions, pixels: &PixelGrid) -> f64 {
        let [x, y] = options.projector_px_mm();
        let (sin, cos) = options.projector_turn_deg.to_radians().sin_cos();
        // The projector's keystone adds little to a pixel's extent in projector px, its turn up to the diagonal.
        1.2 * (sin.abs() + cos.abs()) * pixels.pixel_mm() / x.min(y)
    }

    /// The board under white light; in another pose it is lit as in the slab's plane, which moves no corner.
    fn board(&self, options: &SimulateOptions, pixels: &PixelGrid) -> RenderedPicture {
        let (scene, pixel_mm) = (&self.bench.scene, pixels.pixel_mm());
        let lit = |p: Point| scene.white_irradiance(p).map(|e| e + options.ambient);
        pixels.picture(|p| board_rule(scene, pixel_mm, p), |p| lit(p).map(|e| e * board_albedo(scene, p)))
    }

    /// Sample and frame under a pattern: `sharp` is its brightness (0 to 1) at projector px on the frame and `rule` how
    /// a pixel averages it, `blurred` its brightness on the sample.
    ///
    /// An approximation on the sample: what it sends back under even light, times the blurred pattern in each pixel's
    /// middle: blurred over two samples it changes little within a pixel.
    fn lit_sample(
        &self,
        options: &SimulateOptions,
        pixels: &PixelGrid,
        rule: impl Fn(&Pixel) -> Rule + Sync,
        sharp: impl Fn(Point) -> f64 + Sync,
        blurred: impl Fn(Point) -> f64 + Sync,
    ) -> RenderedPicture {
        let (scene, black, pixel_mm) = (&self.bench.scene, options.projector_black, pixels.pixel_mm());
        let dark = black + options.ambient;
        let projector_px = |p: Point| scene.slab_from_projector.projector_from_slab(p);
        let level = |lit: f64| black + (1.0 - black) * lit;
        let arriving = |p: Point, lit: f64| scene.white_irradiance(p).map(|e| e * level(lit) + options.ambient);
        let share = |p: Point| (level(blurred(projector_px(p))) + options.ambient) / dark;
        let light = |p: Point| match (&self.dark_field, scene.on_sample(p), scene.on_frame_or_sample(p)) {
            (Some(field), true, _) => field.at(p).map(|v| f64::from(v) * share(p)),
            (None, true, _) => arriving(p, blurred(projector_px(p))).map(|e| 0.5 * e),
            (_, _, true) => arriving(p, sharp(projector_px(p))).map(|e| e * scene.frame_albedo(p)),
            _ => [0.0; 3],
        };
        let mean = self.dark_field.as_ref().map(|field| FieldMean::new(pixel_mm, field));
        pixels.picture_of(|pixel| {
            let p = pixel.first_corner_mm();
            match &mean {
                _ if scene.near_rim(p, pixel_mm) || scene.near_mark(p, 2.0 * pixel_mm) => {
                    pixel.mean(GAUSS_6, light).map(|v| v as f32)
                }
                Some(mean) if scene.on_sample(p) => {
                    let share = share(pixel.centre_mm()) as f32;
                    mean.on_sample(scene, pixel).map(|v| v * share)
                }
                None if scene.on_sample(p) => pixel.mean(GAUSS_1, light).map(|v| v as f32),
                _ => pixel.mean(rule(pixel), light).map(|v| v as f32),
            }
        })
    }

    /// Sample and frame under the projector's black and the ambient light.
    pub(super) fn dark_sample(&self, options: &SimulateOptions, pixels: &PixelGrid) -> RenderedPicture {
        match self.dark_field {
            Some(_) => self.lit_sample(options, pixels, |_| GAUSS_1, |_| 0.0, |_| 0.0),
            None => pixels.black(),
        }
    }
}
