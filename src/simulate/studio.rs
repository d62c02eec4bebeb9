//! One capture's photographs: renders shots, exposes and writes them.

#[cfg(test)]
mod tests;

use super::{
    ShotList, ShotTruth, SimulateOptions,
    bench::Bench,
    camera::photograph::{ExposureTime, PhotographWriter},
    camera::{hot_pixels::hot_pixels, psf, sensor::SimulatedSensor},
    light::domain::Domain,
    light::dots::Glow,
    light::field::Field,
    mix_seed,
    scene::FRAME_ALBEDO,
    scene::render::{
        Brightness, FieldMean, GAUSS_1, GAUSS_6, GrayCode, Pixel, PixelGrid, RenderedPicture, Rule, board_albedo,
        board_rule,
    },
    shot_list,
};
use crate::{
    Result,
    capture::{Pattern, Surface},
    geometry::Point,
    transport::{MatrixWriter, Row},
};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use std::f64::consts::PI;
use std::path::Path;
use std::sync::Mutex;

/// Shortest exposure of lattice shots, s⁻¹.
const SHORTEST_PER_SEC: u32 = 256;
/// Share of the range that the brightest pixel of the shortest exposure reaches.
const BRIGHTEST: f64 = 0.70;
/// Around the sample, for the response to light all over it.
const SLAB_MARGIN_PITCHES: f64 = 6.0;
/// Dots per axis that are solved beforehand to set the exposure.
const PILOTS: usize = 5;

/// The bench with its camera: everything that all shots share.
#[derive(Debug)]
pub(super) struct Studio {
    pub bench: Bench,
    pub sensor: SimulatedSensor,
    pixels: PixelGrid,
    vignetting: Vec<f32>,
    /// Index and dark current (electrons per second) of the hot photosites.
    hot: Vec<(usize, f32)>,
    /// The light of the sample under the projector's black and the ambient light, and a picture of it.
    dark_field: Option<Field>,
    dark_sample: RenderedPicture,
    /// Electrons per second and unit of radiance at the principal point.
    pub electrons_per_sec: f64,
    white_shortest: ExposureTime,
    /// Memory of shots that are done, for the next.
    spare: Mutex<Vec<Darkroom>>,
}

/// What the pictures of a shot are made in.
#[derive(Debug)]
struct Darkroom {
    picture: RenderedPicture,
    rate: Vec<f32>,
    codes: Vec<u16>,
    writer: PhotographWriter,
}

/// How far the projector has moved at a photograph of the Gray code, projector px.
fn gray_jitter(options: &SimulateOptions, shot: usize) -> Point {
    if options.gray_jitter_px == 0.0 {
        return [0.0; 2];
    }
    let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(options.seed ^ 0x6a77, shot as u64));
    [0, 1].map(|_| {
        let normal: f64 = StandardNormal.sample(&mut rng);
        options.gray_jitter_px * normal
    })
}

impl Studio {
    /// Solves for the light all over the sample, and chooses the sensitivity.
    pub(super) fn new(options: &SimulateOptions, bench: Bench) -> Result<Self> {
        let scene = &bench.scene;
        let pixels = PixelGrid::new(scene, [0.0; 2], psf::parts(options.psf_px))?;
        let [width, height] = scene.camera.size_px;
        let sensitivity = |i: usize| scene.camera.vignetting_at([(i % width) as f64, (i / width) as f64]) as f32;
        let vignetting = (0..width * height).map(sensitivity).collect();
        let mut studio = Self {
            sensor: SimulatedSensor::new(options),
            vignetting,
            hot: hot_pixels(3 * width * height, options.hot_pixels, options.seed),
            dark_field: None,
            dark_sample: Vec::new(),
            electrons_per_sec: 0.0,
            white_shortest: ExposureTime::one_over(1),
            spare: Mutex::default(),
            pixels,
            bench,
        };
        studio.dark_field = studio.solve_dark_sample(options)?;
        studio.dark_sample = studio.render_dark_sample(options, &studio.pixels);
        studio.set_sensitivity(options)?;
        Ok(studio)
    }

    /// The exposure times of a shot.
    pub(super) fn bracket(&self, options: &SimulateOptions, pattern: &Pattern) -> Vec<ExposureTime> {
        match pattern {
            // The frame is darker than the white reference by four stops.
            Pattern::Frame | Pattern::GrayCode { on: Surface::Frame, .. } => {
                shot_list::bracket(self.white_shortest, 3, 2.0)
            }
            Pattern::Board if options.link_exposures => {
                let mut bracket = shot_list::bracket(self.white_shortest, 2, 2.0);
                bracket.push(ExposureTime::one_over(SHORTEST_PER_SEC));
                bracket
            }
            Pattern::Board | Pattern::CalibrationBoard | Pattern::ReferenceWhite | Pattern::GrayCode { .. } => {
                shot_list::bracket(self.white_shortest, 2, 2.0)
            }
            _ => shot_list::bracket(ExposureTime::one_over(SHORTEST_PER_SEC), options.exposures, options.stops),
        }
    }

    /// Every exposure time that is used: what EXIF says and what it is, s.
    pub(super) fn exposures(&self, options: &SimulateOptions) -> Vec<[f64; 2]> {
        let mut all = self.bracket(options, &Pattern::ReferenceWhite);
        all.extend(self.bracket(options, &Pattern::SampleBlack));
        let told = |t: &ExposureTime| t.told(options.exif_stops_error, options.nominal_times, options.seed).secs();
        all.iter().map(|t| [told(t), t.secs()]).collect()
    }

    /// Renders a shot, writes its photographs and, for dots, the rows of the truth. Returns the bytes of the
    /// photographs.
    pub(super) fn shoot(
        &self,
        options: &SimulateOptions,
        plan: &ShotList,
        shot: usize,
        dir: &Path,
        truth: &MatrixWriter,
    ) -> Result<u64> {
        let entry = &plan.manifest.shots[shot];
        let mut room = self.spare.lock().ok().and_then(|mut spare| spare.pop()).unwrap_or_else(|| Darkroom {
            picture: RenderedPicture::new(),
            rate: Vec::new(),
            codes: Vec::new(),
            writer: PhotographWriter::new(options.format, self.bench.scene.camera.size_px),
        });
        room.picture = match &entry.pattern {
            Pattern::Lattice { dots } => {
                let moved = &plan.lattices[shot - plan.first_lattice];
                let keep = |dot, row| truth.put(self.bench.scene.grid.row_index(dot), &row);
                self.lattice(options, dots, moved, keep, room.picture)?
            }
            Pattern::Frame => {
                self.lit_sample(options, &self.pixels_at(options, plan, shot)?, |_| GAUSS_1, |_| 1.0, |_| 1.0)
            }
            Pattern::CalibrationBoard => {
                let earlier = plan.manifest.shots[..shot].iter().filter(|s| s.pattern == Pattern::CalibrationBoard);
                self.board(
                    options,
                    &PixelGrid::of_view(
                        &self.bench.scene.posed_view(earlier.count()),
                        &self.bench.scene,
                        psf::parts(options.psf_px),
                    )?,
                )
            }
            pattern => self.still(options, pattern, gray_jitter(options, shot)),
        };
        room.rate = self.rate(options, &room.picture, room.rate);
        let mut bytes = 0;
        for (n, (exposure, file)) in self.bracket(options, &entry.pattern).iter().zip(&entry.photographs).enumerate() {
            let seed = mix_seed(mix_seed(options.seed, shot as u64), n as u64);
            let lit_secs = exposure.secs() * lamp(options.flicker, seed);
            self.sensor.expose(&room.rate, &self.hot, lit_secs, exposure.secs(), seed, &mut room.codes);
            let told = exposure.told(options.exif_stops_error, options.nominal_times, options.seed);
            bytes += room.writer.write(&dir.join(&file.file), &room.codes, told, shot * 10 + n)?;
        }
        if let Ok(mut spare) = self.spare.lock() {
            spare.push(room);
        }
        Ok(bytes)
    }

    /// Electrons per second of a picture, R G B interleaved, in the memory of `rate`.
    fn rate(&self, options: &SimulateOptions, picture: &RenderedPicture, mut rate: Vec<f32>) -> Vec<f32> {
        let scale = (self.electrons_per_sec / PI) as f32;
        let (size_px, parts) = (self.bench.scene.camera.size_px, psf::parts(options.psf_px));
        rate.resize(3 * picture.len(), 0.0);
        rate.as_chunks_mut::<3>().0.iter_mut().zip(picture).for_each(|(to, light)| *to = light.map(|l| scale * l));
        let mut rate = psf::see(rate, size_px, parts, options.psf_px, options.glare);
        let lit = rate.as_chunks_mut::<3>().0.iter_mut().zip(&self.vignetting);
        lit.for_each(|(rate, v)| rate.iter_mut().for_each(|r| *r *= v));
        rate
    }

    /// A shot without dots; the Gray code is projected `moved_px` beside its place.
    fn still(&self, options: &SimulateOptions, pattern: &Pattern, moved_px: Point) -> RenderedPicture {
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
            Pattern::Board | Pattern::CalibrationBoard => self.board(options, &self.pixels),
            Pattern::ReferenceWhite => self.pixels.picture(|_| GAUSS_1, |p| white(p, 1.0)),
            Pattern::ReferenceBlack => self.pixels.picture(|_| GAUSS_1, |p| white(p, 0.0)),
            Pattern::GrayCode { axis, bit, inverse, on: Surface::Frame } => {
                let code = GrayCode { axis, bit, inverse, blur_px: scene.projector_blur_px };
                let pixel_px = self.pixel_projector_px(options);
                let rule = |pixel: &Pixel| match code.around(projector_px(pixel.first_corner_mm()), pixel_px) {
                    Brightness::Even(_) => GAUSS_1,
                    Brightness::Edge(rule) => rule,
                };
                let moved = |p: Point| [p[0] - moved_px[0], p[1] - moved_px[1]];
                let sharp = |p: Point| code.brightness(moved(p));
                self.lit_sample(options, &self.pixels, rule, sharp, |p| code.blurred(moved(p), options))
            }
            Pattern::GrayCode { axis, bit, inverse, on: Surface::WhiteReference } => {
                let code = GrayCode { axis, bit, inverse, blur_px: scene.projector_blur_px };
                let pixel_px = self.pixel_projector_px(options);
                self.pixels.picture_of(|pixel| {
                    let light = match code.around(projector_px(pixel.first_corner_mm()), pixel_px) {
                        Brightness::Even(lit) => pixel.mean(GAUSS_1, |p| white(p, lit)),
                        Brightness::Edge(rule) => pixel.mean(rule, |p| white(p, code.brightness(projector_px(p)))),
                    };
                    light.map(|v| v as f32)
                })
            }
            Pattern::SampleBlack | Pattern::Frame | Pattern::Lattice { .. } => self.dark_sample.clone(),
            Pattern::Dark => self.pixels.picture(|_| GAUSS_1, |_| [0.0; 3]),
        }
    }

    /// An upper bound of a camera pixel's extent, projector px.
    fn pixel_projector_px(&self, options: &SimulateOptions) -> f64 {
        let [x, y] = options.projector_px_mm();
        let (sin, cos) = options.projector_turn_deg.to_radians().sin_cos();
        // The projector's keystone adds little to a pixel's extent in projector px, its turn up to the diagonal.
        1.2 * (sin.abs() + cos.abs()) * self.pixels.pixel_mm() / x.min(y)
    }

    /// The board under white light; in another pose it is lit as in the slab's plane, which moves no corner.
    fn board(&self, options: &SimulateOptions, pixels: &PixelGrid) -> RenderedPicture {
        let (scene, pixel_mm) = (&self.bench.scene, pixels.pixel_mm());
        let lit = |p: Point| scene.white_irradiance(p).map(|e| e + options.ambient);
        pixels.picture(|p| board_rule(scene, pixel_mm, p), |p| lit(p).map(|e| e * board_albedo(scene, p)))
    }

    /// The pixels of a shot before or after the lattice shots: a camera that has moved stays where it is.
    fn pixels_at(&self, options: &SimulateOptions, plan: &ShotList, shot: usize) -> Result<PixelGrid> {
        let last = plan.lattices.last().filter(|_| shot > plan.first_lattice);
        PixelGrid::new(&self.bench.scene, last.map_or([0.0; 2], |l| l.camera_drift_px), psf::parts(options.psf_px))
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

    /// A shot of dots, in the memory of `picture`; `keep` receives the truth of each.
    fn lattice(
        &self,
        options: &SimulateOptions,
        dots: &[[usize; 2]],
        moved: &ShotTruth,
        keep: impl Fn([usize; 2], Row) -> Result<()> + Sync,
        mut picture: RenderedPicture,
    ) -> Result<RenderedPicture> {
        let (lit, drift_mm) = (1.0 - options.projector_black, moved.drift_mm);
        // A camera that has moved sees every pixel elsewhere.
        let own_pixels = match moved.camera_drift_px {
            [0.0, 0.0] => None,
            shift_px => Some(PixelGrid::new(&self.bench.scene, shift_px, psf::parts(options.psf_px))?),
        };
        let pixels = own_pixels.as_ref().unwrap_or(&self.pixels);
        match &own_pixels {
            None => picture.clone_from(&self.dark_sample),
            Some(pixels) => picture = self.render_dark_sample(options, pixels),
        }
        // A few dots at a time: their order in the sum is fixed, and memory is bounded.
        for group in dots.chunks(16) {
            let solve = |&dot: &[usize; 2]| {
                let glow = self.bench.glow(dot, drift_mm)?;
                keep(dot, self.bench.row(options, dot, drift_mm, &glow))?;
                Ok((glow, self.bench.flux(dot, drift_mm)))
            };
            let glows: Vec<(Glow, [f64; 3])> = group.par_iter().map(solve).collect::<Result<_>>()?;
            for (glow, flux) in &glows {
                for field in &glow.fields {
                    pixels.add_field(&mut picture, &self.bench.scene, field, flux.map(|f| lit * f));
                }
            }
        }
        for &dot_px in &self.bench.scene.reference_dots {
            pixels.add_frame_dot(&mut picture, &self.bench.scene, dot_px, drift_mm, lit * FRAME_ALBEDO);
        }
        Ok(picture)
    }

    /// The light of the sample under the projector's black and the ambient light; `None` without either.
    fn solve_dark_sample(&self, options: &SimulateOptions) -> Result<Option<Field>> {
        if options.projector_black == 0.0 && options.ambient == 0.0 {
            return Ok(None);
        }
        let scene = &self.bench.scene;
        let voxel_mm = self.bench.dots.voxel_mm;
        let margin = SLAB_MARGIN_PITCHES * options.pitch_mm;
        let domain = Domain {
            corner_mm: [-margin; 2],
            voxel_mm,
            voxels: scene.slab_size_mm.map(|s| (((s + 2.0 * margin) / voxel_mm).ceil() as usize).next_multiple_of(16)),
        };
        self.bench.dots.slab.check_size(&domain)?;
        let mut flux = [0, 1, 2].map(|_| vec![0.0; domain.columns()]);
        for i in 0..domain.columns() {
            let corner = domain.voxel_corner_mm([i % domain.voxels[0], i / domain.voxels[0]]);
            // Only what falls on the sample enters: the overlap of the voxel with it.
            let overlap = |a: usize| ((corner[a] + voxel_mm).min(scene.slab_size_mm[a]) - corner[a].max(0.0)).max(0.0);
            let area = overlap(0) * overlap(1);
            let light = self.dark_irradiance(options, corner.map(|c| c + 0.5 * voxel_mm));
            flux.iter_mut().zip(light).for_each(|(flux, e)| flux[i] = e * area);
        }
        self.bench.dots.diffuse(&domain, [&flux[0], &flux[1], &flux[2]]).map(Some)
    }

    fn dark_irradiance(&self, options: &SimulateOptions, p: Point) -> [f64; 3] {
        self.bench.scene.white_irradiance(p).map(|e| e * options.projector_black + options.ambient)
    }

    /// Sample and frame under the projector's black and the ambient light.
    fn render_dark_sample(&self, options: &SimulateOptions, pixels: &PixelGrid) -> RenderedPicture {
        match self.dark_field {
            Some(_) => self.lit_sample(options, pixels, |_| GAUSS_1, |_| 0.0, |_| 0.0),
            None => pixels.black(),
        }
    }

    /// Sets the sensitivity so that the brightest of some dots reaches [`BRIGHTEST`] in the shortest exposure.
    fn set_sensitivity(&mut self, options: &SimulateOptions) -> Result<()> {
        let pilots = options.grid.map(|n| PILOTS.min(n));
        let place = |n: usize, a: usize| ((2 * n + 1) * options.grid[a]) / (2 * pilots[a]);
        let px_mm = options.pitch_mm / options.camera_px_per_sample;
        let peak = |n: usize| {
            let dot = [place(n % pilots[0], 0), place(n / pilots[0], 1)];
            let (glow, flux) = (self.bench.glow(dot, [0.0; 2])?, self.bench.flux(dot, [0.0; 2]));
            let means = glow.cell_means(self.bench.scene.dot_mm(dot, [0.0; 2]), [5, 5], px_mm);
            Ok(means.iter().enumerate().map(|(i, m)| f64::from(*m) * flux[i % 3]).fold(0.0, f64::max))
        };
        let peaks: Vec<f64> = (0..pilots[0] * pilots[1]).into_par_iter().map(peak).collect::<Result<_>>()?;
        let brightest = peaks.into_iter().fold(FRAME_ALBEDO, f64::max);
        let wanted = BRIGHTEST * self.sensor.full_range_electrons();
        self.electrons_per_sec = wanted * f64::from(SHORTEST_PER_SEC) * PI / brightest;
        // The longer of two exposures of white reaches the same share; white is 1 at its brightest.
        let longer_per_sec = self.electrons_per_sec / PI / wanted;
        self.white_shortest = ExposureTime::one_over((4.0 * longer_per_sec).ceil() as u32);
        Ok(())
    }
}

/// The lamp's output during one photograph, of its mean.
fn lamp(flicker: f64, seed: u64) -> f64 {
    let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(seed, 0x1a3b));
    let normal: f64 = StandardNormal.sample(&mut rng);
    (1.0 + flicker * normal).max(0.0)
}
