//! Steady diffusion in a heterogeneous slab: −∇·(D∇φ) + σ_a φ = q per channel, D = 1/(3(σ_a + σ'_s)).
//!
//! Finite volumes on voxels that are square over the plane and thin near the surface, with the harmonic mean of D
//! between neighbours. A voxel has the mean σ'_s and σ_a of what it covers, which is continuous in its place, so that a
//! grid that follows its dot sees the material move smoothly; the grid's layers end where the material's do, unless
//! those are thinner.
//!
//! # Boundaries
//! Light that meets the inside of the top or bottom is reflected in part: φ − 2AD ∂φ/∂n = 0 with A = (1 + F_dr)/(1 −
//! F_dr) (Groenhuis et al. 1983; n points inwards). The net flux through the surface is then D ∂φ/∂n = φ_s/(2A), and as
//! nothing comes in, this is what escapes: the exitance. From a cell centre dz/2 deep it is φ/(dz/(2D) + 2A), which is
//! how both the operator and the exitance have it, so that energy balances to the solver's tolerance. At the sides of
//! the voxel box the field is taken to decay as the slab's slowest mode does, exp(−κr): D ∂φ/∂n = −Dκφ.
//!
//! # Source
//! Of each unit of flux that arrives, 1 − F enters (Fresnel at normal incidence) and is scattered once, isotropically,
//! along its first path: q₁(z) = (1 − F) σ'_s exp(−σ'_t z). The absorbed share of the first collisions and what crosses
//! the slab unscattered are lost, as they should be. Under a dot this light then makes [`FLIGHTS`] flights along fixed
//! rays (`first_flights.rs`), and only what is scattered at their ends, q₃, is the source of the diffusion equation:
//! light this young is not diffuse.
//!
//! # What the camera sees
//! Radiance, not exitance: the last flight from q₁, q₂, q₃ and σ'_s φ to the eye (`last_flight.rs`). First
//! scattering is exact in it, but for the voxels.
//!
//! # Where diffusion is wrong
//! `docs/simulation.md` has its error against photon Monte Carlo per material: 5 to 14 % of `rel_rmse` (the exitance
//! alone, without first and last flights, is off by 12 to 93 %). What remains:
//! - What was scattered more than once is no sharper than voxels. Voxels of two thirds the width take a third off the
//!   error, for twice the time.
//! - Near the surface diffusion's field is not transport's: tails are off by up to 10 %, by more where light is
//!   absorbed within few free paths. Other boundary factors (Fresnel's moments, Milne's exact extrapolation) and
//!   Grosjean's D [`dEonIrving2011`] do better at one of these and worse at the other; they are not used.
//! - Scattering is isotropic, σ'_s for σ_s, whatever the medium's mean cosine; light by way of the bottom face is left
//!   out.
//!
//! [`dEonIrving2011`]: https://doi.org/10.1145/1964921.1964951

use super::coefficients::Coefficients;
use super::domain::{Domain, SolverSlab};
use super::first_flights::{Flights, Flown};
use super::last_flight::Lit;
use super::multigrid::{Columns, Convergence, Multigrid};
use super::solution::Solution;
use crate::simulate::slab::{boundary_factor, normal_reflectance};
use crate::{Error, Result};

/// A solve takes 6 to 9 iterations, some tens when coefficients jump a thousandfold; one that takes this many has
/// failed.
const MOST_ITERATIONS: usize = 400;
/// Share of the light that may be missing from the balance before a solution is refined, how often it is, and the share
/// at which it has failed.
const REFINED_ABOVE: f64 = 1e-4;
const MOST_REFINEMENTS: usize = 6;
const FAILED_ABOVE: f64 = 1e-3;
/// What a refinement lessens the residual by.
const REFINEMENT: f64 = 1e-3;
/// Channels as messages name them.
pub(crate) const CHANNEL_NAMES: [char; 3] = ['R', 'G', 'B'];

impl SolverSlab {
    /// Solves for `flux` arriving at the columns (row-major).
    ///
    /// # Errors
    /// [`Error::Diffusion`] when the solver finds no solution that keeps all light.
    pub(crate) fn solve(&self, domain: &Domain, flux: &[f64], channel: usize) -> Result<Solution> {
        let coefficients = Coefficients::new(self, domain, channel);
        let (columns, sides) = self.operator(domain, &coefficients);
        let (top, bottom) = (columns.top.clone(), columns.bottom.clone());
        let mut multigrid = Multigrid::new(columns, &self.layers_mm);
        let first = self.source(&coefficients, flux);
        let (flown, diffuses) = self.fly(domain, &coefficients, flux, &first);
        let mut source = multigrid.zeros();
        multigrid.voxels_mut(&mut source).iter_mut().zip(&diffuses).for_each(|(to, q)| *to = *q as f32);
        let (fluence, mut convergence) = multigrid.solve(&source, self.tolerance, MOST_ITERATIONS);
        let mut solution = Solution {
            fluence: multigrid.voxels(&fluence).to_vec(),
            domain: *domain,
            refractive_index: self.volume.refractive_index,
            flux: flux.to_vec(),
            flown,
            top,
            bottom,
            sides,
            coefficients,
            layers_mm: self.layers_mm.clone(),
            source: first.iter().sum(),
        };
        let mut exact: Vec<f64> = Vec::new();
        for _ in 0..MOST_REFINEMENTS {
            if solution.balance().missing().abs() <= REFINED_ABOVE {
                break;
            }
            if exact.is_empty() {
                exact = fluence.iter().map(|&phi| f64::from(phi)).collect();
            }
            convergence = multigrid.refine(&source, &mut exact, REFINEMENT, MOST_ITERATIONS);
            let refined: Vec<f32> = exact.iter().map(|&phi| phi as f32).collect();
            solution.fluence = multigrid.voxels(&refined).to_vec();
        }
        // Light that is missing from the books is a solve that failed, whatever its residual says.
        let (missing, Convergence { iterations, residual }) = (solution.balance().missing(), convergence);
        if !(missing.abs() <= FAILED_ABOVE) {
            return Err(Error::Diffusion { channel: CHANNEL_NAMES[channel], iterations, residual, missing });
        }
        Ok(solution)
    }

    /// π times the radiance towards the eye above each column of what `flux` scatters there the first time, mm⁻²:
    /// exact, without a solve.
    pub(crate) fn first_radiance(&self, domain: &Domain, flux: &[f64], channel: usize, eye_mm: [f64; 3]) -> Vec<f32> {
        let refractive_index = self.volume.refractive_index;
        let enters = domain.entering_per_mm2(refractive_index);
        let lit = Lit {
            domain,
            layers_mm: &self.layers_mm,
            coefficients: &Coefficients::new(self, domain, channel),
            enters: &|i| flux[i] * enters,
            at_face: &|_, _| 0.0,
            middle: &|_, _| 0.0,
            scattered: &|_, _| 0.0,
        };
        lit.radiance(eye_mm, refractive_index)
    }

    /// The operator's maps, and the conductance through the sides per mm of depth.
    fn operator(&self, domain: &Domain, coefficients: &Coefficients) -> (Columns, Vec<f64>) {
        let [nx, ny] = domain.voxels;
        let (h, plane) = (domain.voxel_mm, nx * ny);
        let a = boundary_factor(self.volume.refractive_index);
        let diffusion: Vec<f64> = coefficients.all().iter().map(|(s, a)| 1.0 / (3.0 * (s + a))).collect();
        let join = |i: usize, j: usize| 2.0 * diffusion[i] * diffusion[j] / (diffusion[i] + diffusion[j]);
        let through = |diffusion: &[f64], dz: f64| -> Vec<f32> {
            diffusion.iter().map(|d| (h * h / (dz / (2.0 * d) + 2.0 * a)) as f32).collect()
        };
        let mut west = vec![0.0; diffusion.len()];
        let mut north = vec![0.0; diffusion.len()];
        for i in 0..diffusion.len() {
            if i % nx > 0 {
                west[i] = join(i, i - 1) as f32;
            }
            if i % plane >= nx {
                north[i] = join(i, i - nx) as f32;
            }
        }
        // Two half layers in series.
        let dz = &self.layers_mm;
        let under = |i: usize| match (diffusion.get(i + plane), i / plane) {
            (Some(below), k) => (dz[k] + dz[k + 1]) / (dz[k] / diffusion[i] + dz[k + 1] / below),
            (None, _) => diffusion[i],
        };
        let sides = self.sides(domain, coefficients, &diffusion);
        let loss =
            coefficients.all().iter().zip(&sides).map(|((_, absorption), side)| (absorption * h * h + side) as f32);
        let columns = Columns {
            nx,
            ny,
            west,
            north,
            loss: loss.collect(),
            vertical: (0..diffusion.len()).map(|i| (under(i) * h * h) as f32).collect(),
            top: through(&diffusion[..plane], dz[0]),
            bottom: through(&diffusion[diffusion.len() - plane..], dz[dz.len() - 1]),
        };
        (columns, sides)
    }

    /// The conductance through the sides of the box per mm of depth; 0 inside. The slowest mode of a column has one
    /// decay: that of the column's mean coefficients.
    fn sides(&self, domain: &Domain, coefficients: &Coefficients, diffusion: &[f64]) -> Vec<f64> {
        let [nx, ny] = domain.voxels;
        let (h, plane) = (domain.voxel_mm, nx * ny);
        let a = boundary_factor(self.volume.refractive_index);
        let thickness: f64 = self.layers_mm.iter().sum();
        let planes = diffusion.len() / plane;
        let mut sides = vec![0.0; diffusion.len()];
        for i in 0..plane {
            let (x, y) = (i % nx, i / nx);
            let open = [x == 0, x + 1 == nx, y == 0, y + 1 == ny].iter().filter(|&&side| side).count();
            if open == 0 {
                continue;
            }
            let mean = |value: &dyn Fn(usize) -> f64| match planes {
                1 => value(i),
                _ => (0..planes).map(|k| value(k * plane + i) * self.layers_mm[k]).sum::<f64>() / thickness,
            };
            let d = mean(&|j| diffusion[j]);
            let slowest = std::f64::consts::PI / (thickness + 4.0 * a * d);
            let kappa = (slowest * slowest + mean(&|j| coefficients.all()[j].1) / d).sqrt();
            for j in (i..diffusion.len()).step_by(plane) {
                sides[j] = open as f64 * h / (h / (2.0 * diffusion[j]) + 1.0 / (diffusion[j] * kappa));
            }
        }
        sides
    }

    /// First scattering, integrated over each voxel.
    fn source(&self, coefficients: &Coefficients, flux: &[f64]) -> Vec<f64> {
        let enters = 1.0 - normal_reflectance(self.volume.refractive_index);
        let plane = flux.len();
        let mut source = vec![0.0; plane * self.layers_mm.len()];
        for (i, &flux) in flux.iter().enumerate().filter(|(_, flux)| **flux != 0.0) {
            let mut remains = 1.0;
            let mut optical_depth = 0.0;
            for (k, &dz) in self.layers_mm.iter().enumerate() {
                let (scattering, absorption) = coefficients.layer(k)[i];
                let extinction = scattering + absorption;
                optical_depth += extinction * dz;
                let after = (-optical_depth).exp();
                source[k * plane + i] = flux * enters * scattering / extinction * (remains - after);
                remains = after;
            }
        }
        source
    }

    /// Light scattered once (`first`) after its flights: what they did in all, and what is left to diffuse.
    fn fly(&self, domain: &Domain, coefficients: &Coefficients, flux: &[f64], first: &[f64]) -> (Flown, Vec<f64>) {
        let mut all = Flown { scattered: vec![0.0; first.len()], ..Flown::default() };
        let mut diffuses = first.to_vec();
        let Some(flights) = Flights::new(self, domain, coefficients, flux) else {
            return (all, diffuses);
        };
        for _ in 0..self.flights {
            let flown = flights.fly(&diffuses);
            all.add(&flown);
            diffuses = flown.scattered;
        }
        (all, diffuses)
    }
}
