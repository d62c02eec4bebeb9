//! One capture's light: solves for dots, renders shots, exposes and writes them.

use super::{
    Options, Plan,
    camera::photograph::{self, ExposureTime},
    camera::sensor::Sensor,
    light::diffusion::{Domain, Slab},
    light::field::Field,
    light::validity,
    mix_seed, plan,
    scene::render::{Picture, PixelGrid, board_albedo, footprint, gray_code},
    scene::{FRAME_ALBEDO, Scene},
    slab::SlabRecord,
    slab::layout::{self, Built, Place},
};
use crate::{
    Result, Warning,
    capture::Pattern,
    geometry::Point,
    transport::{MatrixWriter, Row},
};
use rayon::prelude::*;
use std::f64::consts::PI;
use std::path::Path;

/// Shortest exposure of lattice shots, s⁻¹.
const SHORTEST_PER_SEC: u32 = 256;
/// Share of the range that the brightest pixel of the shortest exposure reaches.
const BRIGHTEST: f64 = 0.70;
/// Around a window the box of voxels goes on by this many pitches, so that its sides do not shape the tails.
const BOX_MARGIN_PITCHES: usize = 4;
/// Around the sample, for the response to light all over it.
const SLAB_MARGIN_PITCHES: f64 = 6.0;
/// Dots per axis that are solved beforehand to set the exposure.
const PILOTS: usize = 5;

/// Everything that all shots share.
#[derive(Debug)]
pub(super) struct Studio {
    pub scene: Scene,
    pub slab: Slab,
    /// The slab, readable.
    pub record: SlabRecord,
    /// Findings about the slab.
    pub warnings: Vec<Warning>,
    pub sensor: Sensor,
    pixels: PixelGrid,
    vignetting: Vec<f32>,
    /// The sample under the projector's black and the ambient light.
    dark_sample: Picture,
    /// Electrons per second and unit of radiance at the principal point.
    pub electrons_per_sec: f64,
    white_shortest: ExposureTime,
    box_voxels: usize,
}

impl Studio {
    /// Sets the bench up, solves for the light all over the sample, and chooses the sensitivity.
    pub fn new(options: &Options) -> Result<Self> {
        let scene = Scene::new(options)?;
        let voxel_mm = options.pitch_mm / options.voxels_per_sample as f64;
        let place =
            Place { lit_origin_mm: scene.lit_origin_mm, lit_side_mm: scene.lit_side_mm, size_mm: scene.slab_size_mm };
        let Built { volume, record, mut warnings } = layout::build(options, &place)?;
        warnings.extend(validity::warnings(&volume, &record, options.window as f64 * options.pitch_mm));
        let slab = Slab::new(volume, voxel_mm, options.tolerance);
        let pixels = PixelGrid::new(&scene)?;
        let [width, height] = scene.camera.size_px;
        let sensitivity = |i: usize| scene.camera.vignetting_at([(i % width) as f64, (i / width) as f64]) as f32;
        let samples = options.window + 2 * BOX_MARGIN_PITCHES;
        let mut studio = Self {
            sensor: Sensor::new(options),
            vignetting: (0..width * height).map(sensitivity).collect(),
            dark_sample: Vec::new(),
            electrons_per_sec: 0.0,
            white_shortest: ExposureTime::one_over(1),
            box_voxels: (samples * options.voxels_per_sample).next_multiple_of(8),
            scene,
            slab,
            record,
            warnings,
            pixels,
        };
        studio.dark_sample = studio.render_dark_sample(options)?;
        studio.set_sensitivity(options)?;
        Ok(studio)
    }

    /// Where a dot falls, mm.
    pub fn dot_mm(&self, dot: [usize; 2], drift_mm: Point) -> Point {
        let p = self.scene.slab_from_projector.map(self.scene.grid.dot_projector_px(dot));
        [p[0] + drift_mm[0], p[1] + drift_mm[1]]
    }

    /// The exposure times of a shot.
    pub fn bracket(&self, options: &Options, pattern: &Pattern) -> Vec<ExposureTime> {
        match pattern {
            Pattern::Board | Pattern::ReferenceWhite | Pattern::GrayCode { .. } => {
                plan::bracket(self.white_shortest, 2, 2.0)
            }
            _ => plan::bracket(ExposureTime::one_over(SHORTEST_PER_SEC), options.exposures, options.stops),
        }
    }

    /// Renders a shot, writes its photographs and, for dots, the rows of the truth. Returns the bytes of the photographs.
    pub fn shoot(&self, options: &Options, plan: &Plan, shot: usize, dir: &Path, truth: &MatrixWriter) -> Result<u64> {
        let entry = &plan.manifest.shots[shot];
        let picture = match &entry.pattern {
            Pattern::Lattice { dots } => {
                let drift_mm = plan.lattices[shot - plan.first_lattice].drift_mm;
                self.lattice(options, dots, drift_mm, |dot, row| truth.put(plan.manifest.row_index(dot), &row))?
            }
            pattern => self.still(options, pattern),
        };
        let scale = self.electrons_per_sec / PI;
        let rate: Vec<f32> = picture
            .iter()
            .zip(&self.vignetting)
            .flat_map(|(light, v)| light.map(|l| (scale * f64::from(l * v)) as f32))
            .collect();
        let mut bytes = 0;
        for (n, (exposure, file)) in self.bracket(options, &entry.pattern).iter().zip(&entry.photographs).enumerate() {
            let seed = mix_seed(mix_seed(options.seed, shot as u64), n as u64);
            let codes = self.sensor.expose(&rate, exposure.secs(), seed);
            let (path, size_px) = (dir.join(&file.file), self.scene.camera.size_px);
            bytes += photograph::write(&path, options.format, size_px, &codes, *exposure, shot * 10 + n)?;
        }
        Ok(bytes)
    }

    /// A shot without dots.
    fn still(&self, options: &Options, pattern: &Pattern) -> Picture {
        let (scene, black) = (&self.scene, options.projector_black);
        let irradiance = |p: Point, lit: f64| {
            let projected = black + (1.0 - black) * lit;
            scene.white_irradiance(p).map(|e| e * projected + options.ambient)
        };
        let white = |p: Point, lit: f64| {
            let light = irradiance(p, lit);
            std::array::from_fn(|c| light[c] * scene.white.reflectance[c])
        };
        match *pattern {
            Pattern::Board => {
                let px_mm = options.pitch_mm / options.camera_px_per_sample;
                self.pixels.picture(|p| irradiance(p, 1.0).map(|e| e * board_albedo(scene, px_mm, p)))
            }
            Pattern::ReferenceWhite => self.pixels.picture(|p| white(p, 1.0)),
            Pattern::ReferenceBlack => self.pixels.picture(|p| white(p, 0.0)),
            Pattern::GrayCode { axis, bit, inverse } => {
                self.pixels.picture(|p| white(p, gray_code(axis, bit, inverse, scene.projector_from_slab.map(p))))
            }
            Pattern::SampleBlack | Pattern::Lattice { .. } => self.dark_sample.clone(),
        }
    }

    /// A shot of dots; `keep` receives the truth of each.
    fn lattice(
        &self,
        options: &Options,
        dots: &[[usize; 2]],
        drift_mm: Point,
        keep: impl Fn([usize; 2], Row) -> Result<()> + Sync,
    ) -> Result<Picture> {
        let lit = 1.0 - options.projector_black;
        let mut picture = self.dark_sample.clone();
        // A few dots at a time: their order in the sum is fixed, and memory is bounded.
        for group in dots.chunks(16) {
            let solve = |&dot: &[usize; 2]| {
                let (field, flux) = self.dot(options, dot, drift_mm)?;
                let center = self.dot_mm(dot, drift_mm);
                let response = field.cell_means(center, [options.window; 2], options.pitch_mm);
                let (variance, valid) = (vec![0.0; response.len()], vec![true; response.len()]);
                keep(dot, Row { response, variance, valid })?;
                Ok((field, flux))
            };
            let fields: Vec<(Field, [f64; 3])> = group.par_iter().map(solve).collect::<Result<_>>()?;
            for (field, flux) in &fields {
                self.pixels.add_field(&mut picture, &self.scene, field, flux.map(|f| lit * f));
            }
        }
        for &dot_px in &self.scene.reference_dots {
            self.pixels.add_frame_dot(&mut picture, &self.scene, dot_px, drift_mm, lit * FRAME_ALBEDO);
        }
        Ok(picture)
    }

    /// The exitance of one dot per unit of its flux, and its flux under full white.
    fn dot(&self, options: &Options, dot: [usize; 2], drift_mm: Point) -> Result<(Field, [f64; 3])> {
        let dot_px = self.scene.grid.dot_projector_px(dot);
        let center = self.dot_mm(dot, drift_mm);
        let voxel_mm = options.pitch_mm / options.voxels_per_sample as f64;
        let domain = Domain {
            corner_mm: center.map(|c| c - 0.5 * self.box_voxels as f64 * voxel_mm),
            voxel_mm,
            voxels: [self.box_voxels; 2],
        };
        let side = self.scene.grid.dot_projector_px;
        let share = footprint(&domain, &self.scene.slab_from_projector, dot_px, center, side);
        let area_mm2 = (side * side) as f64 * self.scene.slab_from_projector.area_scale(dot_px);
        Ok((self.solve(&domain, [&share; 3])?, self.scene.white_irradiance(center).map(|e| e * area_mm2)))
    }

    /// The exitance for flux arriving at the columns of `domain`, per channel.
    fn solve(&self, domain: &Domain, flux: [&[f64]; 3]) -> Result<Field> {
        let channel = |c: usize| Ok(self.slab.solve(domain, flux[c], c)?.exitance());
        let [red, green, blue] = [channel(0)?, channel(1)?, channel(2)?];
        Ok(Field::interpolate(domain.corner_mm, domain.voxel_mm, domain.voxels, [&red, &green, &blue]))
    }

    /// Sample and frame under the projector's black and the ambient light.
    fn render_dark_sample(&self, options: &Options) -> Result<Picture> {
        let scene = &self.scene;
        let voxel_mm = options.pitch_mm / options.voxels_per_sample as f64;
        let margin = SLAB_MARGIN_PITCHES * options.pitch_mm;
        let domain = Domain {
            corner_mm: [-margin; 2],
            voxel_mm,
            voxels: scene.slab_size_mm.map(|s| (((s + 2.0 * margin) / voxel_mm).ceil() as usize).next_multiple_of(16)),
        };
        self.slab.check_size(&domain)?;
        let irradiance = |p: Point| scene.white_irradiance(p).map(|e| e * options.projector_black + options.ambient);
        let mut flux = [0, 1, 2].map(|_| vec![0.0; domain.columns()]);
        for i in 0..domain.columns() {
            let corner = domain.voxel_corner_mm([i % domain.voxels[0], i / domain.voxels[0]]);
            // Only what falls on the sample enters: the overlap of the voxel with it.
            let overlap = |a: usize| ((corner[a] + voxel_mm).min(scene.slab_size_mm[a]) - corner[a].max(0.0)).max(0.0);
            let area = overlap(0) * overlap(1);
            let light = irradiance(corner.map(|c| c + 0.5 * voxel_mm));
            flux.iter_mut().zip(light).for_each(|(flux, e)| flux[i] = e * area);
        }
        let field = self.solve(&domain, [&flux[0], &flux[1], &flux[2]])?;
        Ok(self.pixels.picture(|p| {
            if scene.on_sample(p) {
                field.at(p).map(f64::from)
            } else if scene.on_frame_or_sample(p) {
                irradiance(p).map(|e| e * FRAME_ALBEDO)
            } else {
                [0.0; 3]
            }
        }))
    }

    /// Sets the sensitivity so that the brightest of some dots reaches [`BRIGHTEST`] in the shortest exposure.
    fn set_sensitivity(&mut self, options: &Options) -> Result<()> {
        let pilots = PILOTS.min(options.grid);
        let place = |n: usize| ((2 * n + 1) * options.grid) / (2 * pilots);
        let peak = |n: usize| {
            let dot = [place(n % pilots), place(n / pilots)];
            let (field, flux) = self.dot(options, dot, [0.0; 2])?;
            let px_mm = options.pitch_mm / options.camera_px_per_sample;
            let means = field.cell_means(self.dot_mm(dot, [0.0; 2]), [5, 5], px_mm);
            Ok(means.iter().enumerate().map(|(i, m)| f64::from(*m) * flux[i % 3]).fold(0.0, f64::max))
        };
        let peaks: Vec<f64> = (0..pilots * pilots).into_par_iter().map(peak).collect::<Result<_>>()?;
        let brightest = peaks.into_iter().fold(FRAME_ALBEDO, f64::max);
        let wanted = BRIGHTEST * self.sensor.full_range_electrons();
        self.electrons_per_sec = wanted * f64::from(SHORTEST_PER_SEC) * PI / brightest;
        // The longer of two exposures of white reaches the same share; white is 1 at its brightest.
        let longer_per_sec = self.electrons_per_sec / PI / wanted;
        self.white_shortest = ExposureTime::one_over((4.0 * longer_per_sec).ceil() as u32);
        Ok(())
    }

    /// What [`Self::dot`] is made of, for tests.
    #[cfg(test)]
    pub fn dot_field(&self, options: &Options, dot: [usize; 2], drift_mm: Point) -> Field {
        self.dot(options, dot, drift_mm).unwrap().0
    }
}
