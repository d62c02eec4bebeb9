//! One capture's photographs: renders shots, exposes and writes them.

mod lit_dots;
mod pictures;
#[cfg(test)]
mod tests;

use lit_dots::LitDots;

use super::{
    ShotList, SimulateOptions,
    bench::Bench,
    camera::photograph::{ExposureTime, PhotographFile, PhotographRows},
    camera::{hot_pixels::hot_pixels, psf, psf::PointSpread, sensor::SimulatedSensor},
    light::domain::Domain,
    light::field::Field,
    mix_seed,
    scene::FRAME_ALBEDO,
    scene::pixels::{PixelGrid, RenderedPicture, moved_view},
    shot_list,
};
use crate::{
    Result,
    capture::{Pattern, Surface},
    geometry::{CameraView, Point},
    transport::{MatrixWriter, Row},
};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use std::f64::consts::PI;
use std::ops::Range;
use std::path::Path;

/// Shortest exposure of lattice shots, s⁻¹.
const SHORTEST_PER_SEC: u32 = 256;
/// Share of the range that the brightest pixel of the shortest exposure reaches.
const BRIGHTEST: f64 = 0.70;
/// Around the sample, for the response to light all over it.
const SLAB_MARGIN_PITCHES: f64 = 6.0;
/// Dots per axis that are solved beforehand to set the exposure.
const PILOTS: usize = 5;

/// Of a picture so many parts of pixels are rendered at once, some 60 bytes of memory each.
const STRIP_PARTS: usize = 1 << 20;

/// The bench with its camera: everything that all shots share.
#[derive(Debug)]
pub(super) struct Studio {
    pub bench: Bench,
    pub sensor: SimulatedSensor,
    /// Rows of a picture (camera px) that are rendered together.
    strips: Vec<Range<usize>>,
    /// Where all rows are one strip: its pixels for a camera that has not moved, and the sample without dots.
    whole: Option<(PixelGrid, RenderedPicture)>,
    /// Index and dark current (electrons per second) of the hot photosites.
    hot: Vec<(usize, f32)>,
    /// The light of the sample under the projector's black and the ambient light.
    dark_field: Option<Field>,
    /// Electrons per second and unit of radiance at the principal point.
    pub electrons_per_sec: f64,
    white_shortest: ExposureTime,
}

/// One photograph that is being written.
struct Exposure<'a> {
    rows: PhotographRows<'a>,
    lit_secs: f64,
    secs: f64,
    seed: u64,
}

/// What a shot shows.
enum Shown<'a> {
    Dots(LitDots),
    Still(&'a Pattern, Point),
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
        let ([width, height], parts) = (scene.camera.size_px, psf::parts(options.psf_px));
        let strip = (STRIP_PARTS / (width * parts * parts)).clamp(1, height);
        let mut studio = Self {
            sensor: SimulatedSensor::new(options),
            strips: (0..height).step_by(strip).map(|y| y..(y + strip).min(height)).collect(),
            whole: None,
            hot: hot_pixels(3 * width * height, options.hot_pixels, options.seed),
            dark_field: None,
            electrons_per_sec: 0.0,
            white_shortest: ExposureTime::one_over(1),
            bench,
        };
        studio.dark_field = studio.solve_dark_sample(options)?;
        if let [all] = &studio.strips[..] {
            let pixels = studio.pixels(options, &studio.bench.scene.view, all)?;
            let dark = studio.dark_sample(options, &pixels);
            studio.whole = Some((pixels, dark));
        }
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

    /// Renders a shot strip by strip, writes its photographs and, for dots, the rows of the truth.
    pub(super) fn shoot(
        &self,
        options: &SimulateOptions,
        plan: &ShotList,
        shot: usize,
        dir: &Path,
        truth: &MatrixWriter,
    ) -> Result<()> {
        let (scene, entry) = (&self.bench.scene, &plan.manifest.shots[shot]);
        let bracket = self.bracket(options, &entry.pattern);
        let mut files = Vec::new();
        for (n, (exposure, photograph)) in bracket.iter().zip(&entry.photographs).enumerate() {
            let told = exposure.told(options.exif_stops_error, options.nominal_times, options.seed);
            let path = dir.join(&photograph.file);
            files.push(PhotographFile::create(&path, options.format, scene.camera.size_px, told, shot * 10 + n)?);
        }
        let mut exposures = Vec::new();
        for (n, (exposure, file)) in bracket.iter().zip(&mut files).enumerate() {
            let seed = mix_seed(mix_seed(options.seed, shot as u64), n as u64);
            let secs = exposure.secs();
            let lit_secs = secs * lamp(options.flicker, seed);
            exposures.push(Exposure { rows: file.rows()?, lit_secs, secs, seed });
        }

        let own_view = self.own_view(plan, shot);
        let mut shown = match &entry.pattern {
            Pattern::Lattice { dots } => {
                let drift_mm = plan.lattices[shot - plan.first_lattice].drift_mm;
                Shown::Dots(LitDots::new(self, own_view.as_ref().unwrap_or(&scene.view), dots, drift_mm))
            }
            pattern => Shown::Still(pattern, gray_jitter(options, shot)),
        };
        let keep = |dot, row| truth.put(scene.grid.row_index(dot), &row);
        let mut lens = PointSpread::new(scene.camera.size_px, options.psf_px, options.glare);
        let (mut picture, mut codes, mut seen_rows) = (RenderedPicture::new(), Vec::new(), 0);
        for (n, rows) in self.strips.iter().enumerate() {
            self.show(options, &mut shown, own_view.as_ref(), rows, keep, &mut picture)?;
            let mut rate = lens.see(self.electrons(&picture));
            self.darken_corners(&mut rate, seen_rows);
            self.expose(&mut exposures, &rate, seen_rows, n, &mut codes)?;
            seen_rows += rate.len() / (3 * scene.camera.size_px[0]);
        }
        exposures.into_iter().try_for_each(|e| e.rows.finish())
    }

    /// The camera's view in a shot, where it is not the one of the others: a camera that has moved, which after the
    /// lattice shots stays where it is, or a board in another pose.
    fn own_view(&self, plan: &ShotList, shot: usize) -> Option<CameraView> {
        let scene = &self.bench.scene;
        let moved = |shift_px: Point| (shift_px != [0.0; 2]).then(|| moved_view(&scene.view, shift_px));
        match &plan.manifest.shots[shot].pattern {
            Pattern::Lattice { .. } => moved(plan.lattices[shot - plan.first_lattice].camera_drift_px),
            Pattern::Frame if shot > plan.first_lattice => moved(plan.lattices.last()?.camera_drift_px),
            Pattern::CalibrationBoard => {
                let earlier = plan.manifest.shots[..shot].iter().filter(|s| s.pattern == Pattern::CalibrationBoard);
                Some(scene.posed_view(earlier.count()))
            }
            _ => None,
        }
    }

    fn pixels(&self, options: &SimulateOptions, view: &CameraView, rows: &Range<usize>) -> Result<PixelGrid> {
        PixelGrid::new(view, self.bench.scene.camera.size_px, psf::parts(options.psf_px), rows)
    }

    /// Renders some rows of a shot; `keep` receives the truth of each dot when it is first seen.
    fn show(
        &self,
        options: &SimulateOptions,
        shown: &mut Shown<'_>,
        own_view: Option<&CameraView>,
        rows: &Range<usize>,
        keep: impl Fn([usize; 2], Row) -> Result<()> + Sync,
        picture: &mut RenderedPicture,
    ) -> Result<()> {
        let of_all = self.whole.as_ref().filter(|_| own_view.is_none());
        let own;
        let pixels = match of_all {
            Some((pixels, _)) => pixels,
            None => {
                own = self.pixels(options, own_view.unwrap_or(&self.bench.scene.view), rows)?;
                &own
            }
        };
        match shown {
            Shown::Dots(dots) => {
                match of_all {
                    Some((_, dark)) => picture.clone_from(dark),
                    None => *picture = self.dark_sample(options, pixels),
                }
                dots.add(self, options, pixels, rows, keep, picture)?;
            }
            Shown::Still(pattern, moved_px) => *picture = self.still(options, pattern, *moved_px, pixels),
        }
        Ok(())
    }

    /// Electrons per second of a picture, R G B interleaved, without what the lens does.
    fn electrons(&self, picture: &RenderedPicture) -> Vec<f32> {
        let scale = (self.electrons_per_sec / PI) as f32;
        picture.as_flattened().iter().map(|light| scale * light).collect()
    }

    /// Vignetting of rows from `first` on.
    fn darken_corners(&self, rate: &mut [f32], first: usize) {
        let camera = &self.bench.scene.camera;
        for (i, rate) in rate.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let (x, y) = (i % camera.size_px[0], first + i / camera.size_px[0]);
            let share = camera.vignetting_at([x as f64, y as f64]) as f32;
            rate.iter_mut().for_each(|r| *r *= share);
        }
    }

    /// Exposes and writes rows from `first` on, which are those of strip `n`.
    fn expose(
        &self,
        exposures: &mut [Exposure<'_>],
        rate: &[f32],
        first: usize,
        n: usize,
        codes: &mut Vec<u16>,
    ) -> Result<()> {
        let from = 3 * first * self.bench.scene.camera.size_px[0];
        let hot = &self.hot[self.hot.partition_point(|h| h.0 < from)..];
        let hot = &hot[..hot.partition_point(|h| h.0 < from + rate.len())];
        let hot: Vec<(usize, f32)> = hot.iter().map(|&(i, current)| (i - from, current)).collect();
        exposures.iter_mut().try_for_each(|e| {
            // Every strip has random numbers of its own.
            let seed = if n == 0 { e.seed } else { mix_seed(e.seed, n as u64) };
            self.sensor.expose(rate, &hot, e.lit_secs, e.secs, seed, codes);
            e.rows.write(codes)
        })
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
