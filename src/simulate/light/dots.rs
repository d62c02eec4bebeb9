//! The light that one dot makes leave the slab, by either transport solver.

use super::{
    beam::Beam,
    domain::{Domain, SolverSlab},
    field::Field,
    monte_carlo::{self, BATCHES, Medium, Outcome, Setup, TallyWindow},
};
use crate::simulate::{SimulateOptions, Transport, mix_seed, slab::Volume};
use crate::{Result, geometry::Point, progress::Progress};
use rayon::prelude::*;

/// Around a window the box of voxels goes on by this many pitches, so that its sides do not shape the tails.
const BOX_MARGIN_PITCHES: usize = 4;
/// Where the distance of a shot's dots is asked for, their light is followed so many window sides to each side: it is
/// to be seen in the others' windows. Where it is not, dots are a window and a half apart, and what they would add to
/// each other is left out.
const FOLLOWED_WINDOWS: f64 = 1.5;
/// Photons, and what a beam scatters first, are counted in cells of this share of the pitch, and spread by splines: a
/// blur of 0.07 pitches. (In cells twice as wide it took 6 % of a peak in marble out of its sample.)
const CELLS_PER_SAMPLE: usize = 8;
/// First scattering is looked for as far beside the beam as light may slope on its way up, but no farther than this
/// many pitches.
const SLOPE_PITCHES: f64 = 4.0;
/// A slab that is the same everywhere gets all dots' photons at once, but no more than this.
const MOST_SHARED_PHOTONS: u64 = 5_000_000;

/// What leaves around one dot, per unit of its flux.
#[derive(Debug, Clone)]
pub(crate) struct Glow {
    /// π times the radiance towards the camera, mm⁻²: the sum of these.
    pub fields: Vec<Field>,
    /// The variance of its means over outgoing cells, summed over cells and channels: photon noise. 0 for diffusion.
    pub variance_sum: f64,
}

/// Solves for dots.
#[derive(Debug)]
pub(crate) struct Dots {
    /// The slab as diffusion sees it.
    pub slab: SolverSlab,
    /// Side of its voxels, mm.
    pub voxel_mm: f64,
    eye_mm: [f64; 3],
    pitch_mm: f64,
    box_voxels: [usize; 2],
    tracer: Option<Tracer>,
    /// For a slab that is the same everywhere: what leaves around a dot in its middle, and that dot's place.
    everywhere: Option<(Glow, Point)>,
}

/// What Monte Carlo needs.
#[derive(Debug)]
struct Tracer {
    media: [Medium; 3],
    photons: u64,
    seed: u64,
}

/// Sides of the box of voxels around a dot, samples.
fn box_samples(options: &SimulateOptions) -> [usize; 2] {
    let followed = 2.0 * FOLLOWED_WINDOWS * options.window[0].max(options.window[1]) as f64;
    options.window.map(|samples| {
        let near = samples + 2 * BOX_MARGIN_PITCHES;
        if options.spacing.is_some() { near.max(followed.ceil() as usize) } else { near }
    })
}

impl Glow {
    /// Means over `cells` × `cells` squares of side `cell_mm`, centred as a whole on `center_mm`: `[y][x][channel]`,
    /// exact.
    pub(crate) fn cell_means(&self, center_mm: Point, cells: [usize; 2], cell_mm: f64) -> Vec<f32> {
        let mut sum = vec![0.0; cells[0] * cells[1] * 3];
        for field in &self.fields {
            sum.iter_mut().zip(field.cell_means(center_mm, cells, cell_mm)).for_each(|(sum, mean)| *sum += mean);
        }
        sum
    }
}

impl Dots {
    /// Prepares the solver. A slab that is the same everywhere has one answer for all dots: it is found here, for
    /// `middle`. The others' footprints differ from that by the projector's keystone, and the camera sees them from a
    /// little more aside.
    pub(crate) fn new(
        options: &SimulateOptions,
        volume: Volume,
        eye_mm: [f64; 3],
        middle: &Beam,
        progress: &Progress,
    ) -> Result<Self> {
        let voxel_mm = options.pitch_mm / options.voxels_per_sample as f64;
        let tracer = match options.transport {
            Transport::Diffusion => None,
            Transport::Mc => {
                let media = [0, 1, 2].map(|channel| Medium::new(&volume, channel));
                Some(Tracer { media, photons: options.photons, seed: options.seed })
            }
        };
        let uniform = volume.is_laterally_uniform();
        let mut dots = Self {
            slab: SolverSlab::new(volume, voxel_mm, options.tolerance),
            voxel_mm,
            eye_mm,
            pitch_mm: options.pitch_mm,
            box_voxels: box_samples(options).map(|samples| (samples * options.voxels_per_sample).next_multiple_of(8)),
            tracer,
            everywhere: None,
        };
        if uniform {
            let all = options.photons.saturating_mul((options.grid[0] * options.grid[1]) as u64);
            let photons = all.min(options.photons.max(MOST_SHARED_PHOTONS));
            dots.everywhere = Some((dots.solve(middle, photons, 0, progress)?, middle.center_mm));
        }
        Ok(dots)
    }

    /// The light of `beam`; `number` tells its random numbers from other dots'.
    pub(crate) fn glow(&self, beam: &Beam, number: usize) -> Result<Glow> {
        if let Some((glow, center_mm)) = &self.everywhere {
            let by = std::array::from_fn(|a| beam.center_mm[a] - center_mm[a]);
            let fields = glow.fields.iter().map(|field| field.moved(by)).collect();
            return Ok(Glow { fields, ..*glow });
        }
        let photons = self.tracer.as_ref().map_or(0, |tracer| tracer.photons);
        self.solve(beam, photons, 1 + number, &Progress::silent())
    }

    fn solve(&self, beam: &Beam, photons: u64, number: usize, progress: &Progress) -> Result<Glow> {
        let domain = self.domain(beam.center_mm);
        match &self.tracer {
            Some(tracer) => self.trace(tracer, &domain, beam, photons, number, progress),
            None => {
                let fields = vec![self.scattered_often(&domain, beam)?, self.scattered_once(beam)];
                Ok(Glow { fields, variance_sum: 0.0 })
            }
        }
    }

    /// What is seen by diffusion for flux arriving at the columns of `domain`, per channel.
    pub(crate) fn diffuse(&self, domain: &Domain, flux: [&[f64]; 3]) -> Result<Field> {
        let channel = |c: usize| Ok(self.slab.solve(domain, flux[c], c)?.radiance(self.eye_mm));
        Self::through(domain, channel)
    }

    /// What is seen of `beam`, but for what it scatters towards the camera at once.
    fn scattered_often(&self, domain: &Domain, beam: &Beam) -> Result<Field> {
        let flux = beam.footprint(domain);
        let channel = |c: usize| Ok(self.slab.solve(domain, &flux, c)?.radiance_but_first(self.eye_mm));
        Self::through(domain, channel)
    }

    fn through(domain: &Domain, channel: impl Fn(usize) -> Result<Vec<f32>>) -> Result<Field> {
        let [red, green, blue] = [channel(0)?, channel(1)?, channel(2)?];
        Ok(Field::interpolate(domain.corner_mm, domain.voxel_mm, domain.voxels, [&red, &green, &blue]))
    }

    /// What `beam` scatters towards the camera at once: as sharp as the beam, hence on a grid of its own.
    fn scattered_once(&self, beam: &Beam) -> Field {
        let domain = self.domain_of_once(beam);
        let flux = beam.footprint(&domain);
        let [red, green, blue] = [0, 1, 2].map(|c| self.slab.first_radiance(&domain, &flux, c, self.eye_mm));
        Field::smooth(domain.corner_mm, domain.voxel_mm, domain.voxels, [&red, &green, &blue])
    }

    /// The rectangle that the light of `beam` does not leave, mm.
    pub(crate) fn reach_mm(&self, beam: &Beam) -> [Point; 2] {
        let half_mm = [self.domain(beam.center_mm), self.domain_of_once(beam)].map(|domain| {
            let center_mm = beam.center_mm;
            [0, 1].map(|a| center_mm[a] - domain.corner_mm[a])
        });
        let half_mm: Point = std::array::from_fn(|a| half_mm[0][a].max(half_mm[1][a]));
        [-1.0, 1.0].map(|side| std::array::from_fn(|a| beam.center_mm[a] + side * half_mm[a]))
    }

    /// What [`Self::scattered_once`] is counted in.
    fn domain_of_once(&self, beam: &Beam) -> Domain {
        let thickness: f64 = self.slab.layers_mm.iter().sum();
        let cell_mm = self.cell_mm();
        let reach_mm = beam.reach_mm().into_iter().fold(0.0, f64::max);
        let half = (reach_mm + (SLOPE_PITCHES * self.pitch_mm).min(thickness)) / cell_mm;
        let half = half.ceil() as usize + 2;
        Domain {
            corner_mm: beam.center_mm.map(|c| c - half as f64 * cell_mm),
            voxel_mm: cell_mm,
            voxels: [2 * half; 2],
        }
    }

    fn domain(&self, center_mm: Point) -> Domain {
        Domain {
            corner_mm: std::array::from_fn(|a| center_mm[a] - 0.5 * self.box_voxels[a] as f64 * self.voxel_mm),
            voxel_mm: self.voxel_mm,
            voxels: self.box_voxels,
        }
    }

    /// Side of the cells for what is sharper than diffusion's voxels, mm.
    fn cell_mm(&self) -> f64 {
        self.pitch_mm / CELLS_PER_SAMPLE as f64
    }

    /// Traces all channels towards the camera.
    fn trace(
        &self,
        tracer: &Tracer,
        domain: &Domain,
        beam: &Beam,
        photons: u64,
        number: usize,
        progress: &Progress,
    ) -> Result<Glow> {
        let cell_mm = self.cell_mm();
        let cells = domain.voxels.map(|n| (n as f64 * domain.voxel_mm / cell_mm).round() as usize);
        let window = TallyWindow { corner_mm: domain.corner_mm, cell_mm, cells };
        let stage = progress.stage("trace", 3 * BATCHES as usize);
        let channel = |c: usize| -> Result<Outcome> {
            let setup = Setup {
                beam: *beam,
                window: Some(window),
                eye_mm: Some(self.eye_mm),
                ..Setup::totals(&tracer.media[c])
            };
            let seed = mix_seed(mix_seed(tracer.seed, number as u64), c as u64);
            monte_carlo::trace(&setup, &monte_carlo::TraceOptions { photons, seed }, Some(&stage))
        };
        let outcomes: Vec<Outcome> = (0..3).into_par_iter().map(channel).collect::<Result<_>>()?;
        let maps: Vec<_> = outcomes.into_iter().filter_map(|o| o.radiance).collect();
        let planes: Vec<Vec<f32>> = maps.iter().map(|m| m.mean.iter().map(|v| *v as f32).collect()).collect();
        let field = Field::smooth(window.corner_mm, window.cell_mm, window.cells, [&planes[0], &planes[1], &planes[2]]);
        let fine_per_cell = CELLS_PER_SAMPLE.pow(2) as f64;
        let variance = maps.iter().flat_map(|m| &m.standard_error).map(|e| e * e).sum::<f64>();
        Ok(Glow { fields: vec![field], variance_sum: variance / (fine_per_cell * fine_per_cell) })
    }
}
