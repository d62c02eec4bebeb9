//! A solved slab: what it shows, and where its light went.

use super::coefficients::Coefficients;
use super::domain::Domain;
use super::first_flights::Flown;
use super::last_flight::Lit;
use crate::simulate::slab::boundary_factor;

/// Where the light of a solution went, per unit of flux that arrived at the surface.
#[derive(Debug, Clone, Copy)]
pub struct Balance {
    /// What entered and was scattered once.
    pub source: f64,
    /// Left through the top.
    pub top: f64,
    /// Left through the bottom.
    pub bottom: f64,
    /// Left through the sides of the box.
    pub sides: f64,
    /// Absorbed.
    pub absorbed: f64,
}

impl Balance {
    /// What left or was absorbed: as much as the source, to the solver's tolerance.
    pub fn spent(&self) -> f64 {
        self.top + self.bottom + self.sides + self.absorbed
    }

    /// The share of the source that is in none of the terms; negative when they have more.
    pub fn missing(&self) -> f64 {
        if self.source == 0.0 { self.spent() } else { 1.0 - self.spent() / self.source }
    }
}

/// A solved slab.
#[derive(Debug)]
pub(crate) struct Solution {
    /// Of each voxel.
    pub fluence: Vec<f32>,
    pub domain: Domain,
    pub refractive_index: f64,
    /// What arrived at each column.
    pub flux: Vec<f64>,
    /// What became of light before it diffused.
    pub flown: Flown,
    /// Conductance through the top and the bottom.
    pub top: Vec<f32>,
    pub bottom: Vec<f32>,
    /// Conductance through the sides per mm of depth.
    pub sides: Vec<f64>,
    pub coefficients: Coefficients,
    pub layers_mm: Vec<f64>,
    /// What was scattered once.
    pub source: f64,
}

impl Solution {
    /// The exitance through the top of each column of what diffused, per mm² of slab for the unit of the flux.
    #[cfg(test)]
    pub(crate) fn exitance(&self) -> Vec<f32> {
        let area = self.domain.voxel_mm.powi(2) as f32;
        self.fluence.iter().zip(&self.top).map(|(phi, g)| phi * g / area).collect()
    }

    /// π times the radiance towards the eye above each column, mm⁻² for the unit of the flux.
    pub(crate) fn radiance(&self, eye_mm: [f64; 3]) -> Vec<f32> {
        let enters = self.domain.entering_per_mm2(self.refractive_index);
        self.shown(eye_mm, &|i| self.flux[i] * enters)
    }

    /// The same without what is scattered towards the eye the first time: see
    /// [`super::domain::SolverSlab::first_radiance`].
    pub(crate) fn radiance_but_first(&self, eye_mm: [f64; 3]) -> Vec<f32> {
        self.shown(eye_mm, &|_| 0.0)
    }

    /// What the eye sees when `enters` mm⁻² enter a column.
    fn shown(&self, eye_mm: [f64; 3], enters: &dyn Fn(usize) -> f64) -> Vec<f32> {
        let (plane, area) = (self.domain.columns(), self.domain.voxel_mm.powi(2));
        let twice_a = 2.0 * boundary_factor(self.refractive_index);
        let fluence = |k: usize, i: usize| f64::from(self.fluence[k * plane + i]);
        let conductance = |k: usize, i: usize| {
            let (scattering, absorption) = self.coefficients.layer(k)[i];
            1.0 / ((scattering + absorption) * self.layers_mm[k])
        };
        // The boundary condition gives it at the faces, equal flows from both sides between layers.
        let at_face = |k: usize, i: usize| match k {
            0 => fluence(0, i) * f64::from(self.top[i]) / area * twice_a,
            k if k == self.layers_mm.len() => fluence(k - 1, i) * f64::from(self.bottom[i]) / area * twice_a,
            k => {
                let (above, below) = (conductance(k - 1, i), conductance(k, i));
                (above * fluence(k - 1, i) + below * fluence(k, i)) / (above + below)
            }
        };
        let lit = Lit {
            domain: &self.domain,
            layers_mm: &self.layers_mm,
            coefficients: &self.coefficients,
            enters,
            at_face: &at_face,
            middle: &fluence,
            scattered: &|k, i| self.flown.scattered[k * plane + i] / area,
        };
        lit.radiance(eye_mm, self.refractive_index)
    }

    /// Where the light went.
    pub(crate) fn balance(&self) -> Balance {
        let through = |map: &[f32], layer: &[f32]| -> f64 {
            map.iter().zip(layer).map(|(g, phi)| f64::from(*g) * f64::from(*phi)).sum()
        };
        let (mut absorbed, mut sides) = (0.0, 0.0);
        let (plane, area) = (self.top.len(), self.domain.voxel_mm.powi(2));
        for (k, (layer, &dz)) in self.fluence.chunks(plane).zip(&self.layers_mm).enumerate() {
            let sides_here = &self.sides[if self.sides.len() == plane { 0 } else { k * plane }..];
            for ((phi, (_, absorption)), side) in layer.iter().zip(self.coefficients.layer(k)).zip(sides_here) {
                absorbed += f64::from(*phi) * absorption * area * dz;
                sides += f64::from(*phi) * side * dz;
            }
        }
        let deepest = &self.fluence[self.fluence.len() - self.top.len()..];
        Balance {
            source: self.source,
            top: self.flown.top + through(&self.top, &self.fluence),
            bottom: self.flown.bottom + through(&self.bottom, deepest),
            sides: self.flown.sides + sides,
            absorbed: self.flown.absorbed + absorbed,
        }
    }
}
