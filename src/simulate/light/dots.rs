//! The light that one dot makes leave the slab, by either transport solver.

use super::{
    beam::Beam,
    diffusion::{Domain, Slab},
    field::Field,
    monte_carlo::{self, BATCHES, Medium, Outcome, Setup, Window},
};
use crate::simulate::{Options, Transport, mix_seed, slab::Volume};
use crate::{Result, geometry::Point, progress::Progress};
use rayon::prelude::*;

/// Around a window the box of voxels goes on by this many pitches, so that its sides do not shape the tails.
const BOX_MARGIN_PITCHES: usize = 4;
/// Photons are counted in cells this much finer than diffusion's voxels: the spline through them blurs by half a cell.
const FINER: usize = 2;
/// A slab that is the same everywhere gets all dots' photons at once, but no more than this.
const MOST_SHARED_PHOTONS: u64 = 20_000_000;

/// What leaves around one dot, per unit of its flux.
#[derive(Debug, Clone)]
pub(crate) struct Glow {
    /// Lambertian-equivalent exitance towards the camera, mm⁻².
    pub field: Field,
    /// The variance of its means over outgoing cells, summed over cells and channels: photon noise. 0 for diffusion.
    pub variance_sum: f64,
}

/// Solves for dots.
#[derive(Debug)]
pub(crate) struct Dots {
    /// The slab as diffusion sees it.
    pub slab: Slab,
    eye_mm: [f64; 3],
    voxel_mm: f64,
    box_voxels: usize,
    tracer: Option<Tracer>,
}

/// What Monte Carlo needs.
#[derive(Debug)]
struct Tracer {
    media: [Medium; 3],
    eye_mm: [f64; 3],
    photons: u64,
    seed: u64,
    voxels_per_sample: usize,
    /// What leaves around any dot of a slab that is the same everywhere, and that dot's place.
    everywhere: Option<(Glow, Point)>,
}

impl Dots {
    /// Prepares the solver; for a slab that is the same everywhere, Monte Carlo traces its one answer here, for `middle`.
    pub fn new(
        options: &Options,
        volume: &Volume,
        eye_mm: [f64; 3],
        middle: &Beam,
        progress: &Progress,
    ) -> Result<Self> {
        let voxel_mm = options.pitch_mm / options.voxels_per_sample as f64;
        let samples = options.window + 2 * BOX_MARGIN_PITCHES;
        let mut dots = Self {
            slab: Slab::new(volume.clone(), voxel_mm, options.tolerance),
            eye_mm,
            voxel_mm,
            box_voxels: (samples * options.voxels_per_sample).next_multiple_of(8),
            tracer: None,
        };
        if options.transport == Transport::Mc {
            let media = [0, 1, 2].map(|channel| Medium::new(volume, channel));
            let (photons, voxels_per_sample) = (options.photons, options.voxels_per_sample);
            let mut tracer = Tracer { media, eye_mm, photons, seed: options.seed, voxels_per_sample, everywhere: None };
            if volume.is_laterally_uniform() {
                let shared = photons.saturating_mul((options.grid * options.grid) as u64);
                let shared = shared.min(photons.max(MOST_SHARED_PHOTONS));
                let glow = tracer.trace(&dots.domain(middle.center_mm), middle, shared, 0, progress)?;
                tracer.everywhere = Some((glow, middle.center_mm));
            }
            dots.tracer = Some(tracer);
        }
        Ok(dots)
    }

    /// The light of `beam`; `number` tells its random numbers from other dots'.
    pub fn glow(&self, beam: &Beam, number: usize) -> Result<Glow> {
        let domain = self.domain(beam.center_mm);
        let Some(tracer) = &self.tracer else {
            let field = self.diffuse(&domain, &[0, 1, 2].map(|_| beam.footprint(&domain)))?;
            return Ok(Glow { field, variance_sum: 0.0 });
        };
        match &tracer.everywhere {
            Some((glow, center_mm)) => {
                let by = std::array::from_fn(|a| beam.center_mm[a] - center_mm[a]);
                Ok(Glow { field: glow.field.moved(by), ..*glow })
            }
            None => tracer.trace(&domain, beam, tracer.photons, 1 + number, &Progress::silent()),
        }
    }

    /// What leaves by diffusion for flux arriving at the columns of `domain`, per channel.
    pub fn diffuse(&self, domain: &Domain, flux: &[Vec<f64>; 3]) -> Result<Field> {
        let channel = |c: usize| Ok(self.slab.solve(domain, &flux[c], c)?.radiance(self.eye_mm));
        let [red, green, blue] = [channel(0)?, channel(1)?, channel(2)?];
        Ok(Field::interpolate(domain.corner_mm, domain.voxel_mm, domain.voxels, [&red, &green, &blue]))
    }

    fn domain(&self, center_mm: Point) -> Domain {
        Domain {
            corner_mm: center_mm.map(|c| c - 0.5 * self.box_voxels as f64 * self.voxel_mm),
            voxel_mm: self.voxel_mm,
            voxels: [self.box_voxels; 2],
        }
    }
}

impl Tracer {
    /// Traces all channels towards the camera.
    fn trace(&self, domain: &Domain, beam: &Beam, photons: u64, number: usize, progress: &Progress) -> Result<Glow> {
        let window = Window {
            corner_mm: domain.corner_mm,
            cell_mm: domain.voxel_mm / FINER as f64,
            cells: domain.voxels.map(|n| n * FINER),
        };
        let stage = progress.stage("trace", 3 * BATCHES as usize);
        let channel = |c: usize| -> Result<Outcome> {
            let setup =
                Setup { beam: *beam, window: Some(window), eye_mm: Some(self.eye_mm), ..Setup::totals(&self.media[c]) };
            let seed = mix_seed(mix_seed(self.seed, number as u64), c as u64);
            monte_carlo::trace(&setup, &monte_carlo::Options { photons, seed }, Some(&stage))
        };
        let outcomes: Vec<Outcome> = (0..3).into_par_iter().map(channel).collect::<Result<_>>()?;
        let maps: Vec<_> = outcomes.into_iter().filter_map(|o| o.radiance).collect();
        let planes: Vec<Vec<f32>> = maps.iter().map(|m| m.mean.iter().map(|v| *v as f32).collect()).collect();
        let field = Field::smooth(window.corner_mm, window.cell_mm, window.cells, [&planes[0], &planes[1], &planes[2]]);
        let fine_per_cell = ((FINER * self.voxels_per_sample) as f64).powi(2);
        let variance = maps.iter().flat_map(|m| &m.standard_error).map(|e| e * e).sum::<f64>();
        Ok(Glow { field, variance_sum: variance / (fine_per_cell * fine_per_cell) })
    }
}
