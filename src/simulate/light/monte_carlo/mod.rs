//! Photon Monte Carlo through a slab of voxels.
//!
//! # Model
//! Unpolarized light, one channel at a time. Beams arrive along the normal. In the slab, flights are drawn by delta
//! tracking against each layer's largest extinction (Woodcock et al. 1965); collisions take the absorbed share off the
//! photon's weight, with roulette below a fiftieth, and turn it by Henyey and Greenstein's phase function. At the two
//! faces Fresnel's equations decide; within the slab the refractive index does not change. At its sides, if it has any,
//! light leaves freely.
//!
//! # What is counted
//! The flux through the top (the exitance, also over rings and over a window), through the bottom (scattered or not),
//! through the sides, and what is absorbed; and π times the radiance towards an eye above the slab, to which every
//! scattering contributes the light that is expected to reach it. Everything is per unit of flux that *arrives*. Each
//! number comes with its standard error, from the scatter of [`BATCHES`] independent batches.
//!
//! # Not modelled
//! Polarization, rough faces, light that leaves the slab and comes back, refraction between voxels.
//!
//! Sources: Wang et al. 1995 (MCML), Woodcock et al. 1965, Henyey & Greenstein 1941.

mod eye;
mod medium;
mod phase;
mod photon;
mod tally;
#[cfg(test)]
mod tests;
mod walk;

pub use medium::Medium;
pub use tally::{Estimate, Map, Outcome};

use super::beam::Beam;
use crate::simulate::{mix_seed, slab::normal_reflectance};
use crate::{Error, Result, geometry::Point, progress::Stage};
use eye::Eye;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use tally::{Collected, Tally};
use walk::Walk;

/// Independent batches that a trace is made of: enough to know a standard error to 7 %.
pub const BATCHES: u64 = 100;

/// Light that wanders further than this many thicknesses from the beam is given up as lost through the sides.
const LOST_THICKNESSES: f64 = 1000.0;

/// Square cells over the top of the slab.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TallyWindow {
    /// First corner, mm.
    pub corner_mm: Point,
    /// Side of a cell, mm.
    pub cell_mm: f64,
    /// Cells along x and y.
    pub cells: [usize; 2],
}

impl TallyWindow {
    /// Length along axis `a`, mm.
    fn side_mm(&self, a: usize) -> f64 {
        self.cell_mm * self.cells[a] as f64
    }

    /// The cell that holds (x, y).
    #[inline]
    fn cell(&self, x: f64, y: f64) -> Option<usize> {
        let per_mm = 1.0 / self.cell_mm;
        let (u, v) = ((x - self.corner_mm[0]) * per_mm, (y - self.corner_mm[1]) * per_mm);
        let inside = u >= 0.0 && v >= 0.0 && u < self.cells[0] as f64 && v < self.cells[1] as f64;
        inside.then(|| v as usize * self.cells[0] + u as usize)
    }
}

/// Rings around the beam's centre, all of one width.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rings {
    /// Width, mm.
    pub width_mm: f64,
    /// How many.
    pub count: usize,
}

impl Rings {
    /// Area of ring `i`, mm².
    pub fn area_mm2(&self, i: usize) -> f64 {
        std::f64::consts::PI * self.width_mm * self.width_mm * (2 * i + 1) as f64
    }
}

/// What to trace, and what to count besides the totals.
#[derive(Debug, Clone, Copy)]
pub struct Setup<'a> {
    /// The slab, as the channel sees it.
    pub medium: &'a Medium,
    /// Where light arrives.
    pub beam: Beam,
    /// First and last corner of a slab with sides, mm; `None` for one without end.
    pub extent_mm: Option<[Point; 2]>,
    /// The window for `exitance` and for radiance.
    pub window: Option<TallyWindow>,
    /// Whether to count the exitance over the window.
    pub exitance: bool,
    /// Where the eye is (z negative: above the slab), mm, to count the radiance over the window.
    pub eye_mm: Option<[f64; 3]>,
    /// Rings for the exitance.
    pub rings: Option<Rings>,
}

impl<'a> Setup<'a> {
    /// A pencil beam at the origin; only totals.
    pub fn totals(medium: &'a Medium) -> Self {
        let beam = Beam::pencil([0.0; 2]);
        Self { medium, beam, extent_mm: None, window: None, exitance: false, eye_mm: None, rings: None }
    }
}

/// How long to trace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TraceOptions {
    /// Photons, rounded up to whole batches.
    pub photons: u64,
    /// Seed. The same seed gives the same numbers, whatever the number of threads.
    pub seed: u64,
}

/// Traces photons, on all threads. `stage` advances by [`BATCHES`] steps.
///
/// # Errors
/// [`Error::Setting`] without photons.
///
/// Not detected: estimates whose error is far from normal because hardly any photon reached them.
pub fn trace(setup: &Setup, options: &TraceOptions, stage: Option<&Stage>) -> Result<Outcome> {
    if options.photons == 0 {
        return Err(Error::Setting { setting: "photons", expected: "at least 1".into(), found: "0".into() });
    }
    // What the top face turns back before it enters.
    let specular = normal_reflectance(setup.medium.refractive_index);
    let walk = walk(setup, specular);
    let window = setup.window.as_ref();
    let batch = |n: u64| {
        if let Some(stage) = stage {
            stage.begin();
        }
        let mut rng = Pcg64Mcg::seed_from_u64(mix_seed(options.seed, n));
        let exitance = window.filter(|_| setup.exitance);
        let mut tally = Tally::new(setup.rings.as_ref(), exitance, window.filter(|_| setup.eye_mm.is_some()));
        for _ in 0..options.photons.div_ceil(BATCHES) {
            walk.photon(&mut rng, &mut tally);
        }
        if let Some(stage) = stage {
            stage.advance(1);
        }
        tally
    };
    let mut collected = Collected::default();
    // A few batches at a time: their order in the sums is fixed, and memory is bounded.
    for first in (0..BATCHES).step_by(20) {
        let tallies: Vec<Tally> = (first..first + 20).into_par_iter().map(batch).collect();
        tallies.iter().for_each(|tally| collected.add(tally));
    }
    Ok(collected.finish(specular, setup.rings.as_ref(), window))
}

fn walk<'a>(setup: &'a Setup, specular: f64) -> Walk<'a> {
    let medium = setup.medium;
    let reach = setup.window.map_or(0.0, |w| w.side_mm(0).max(w.side_mm(1)));
    let lost = LOST_THICKNESSES * (medium.thickness_mm() + reach);
    let around = [setup.beam.center_mm.map(|c| c - lost), setup.beam.center_mm.map(|c| c + lost)];
    Walk {
        extent_mm: setup.extent_mm.unwrap_or(around),
        medium,
        enters: 1.0 - specular,
        beam: &setup.beam,
        window: setup.window.as_ref(),
        rings: setup.rings.as_ref(),
        eye: setup.eye_mm.zip(setup.window.as_ref()).map(|(eye, window)| Eye::new(eye, window, medium)),
        exitance: setup.exitance,
    }
}
