//! The first flights of scattered light, traced through the voxels along fixed rays.
//!
//! Near the lit point light has not yet forgotten where it comes from. The light that was scattered once, and again
//! what it becomes, therefore flies straight, isotropically: [`RAYS`] rays of equal weight whose starts and directions
//! are a low-discrepancy sequence relative to the source (Roberts's R₄, and the place among the source's voxels), so
//! that nothing is random and a source that moves takes its rays along. A ray leaves in every voxel what collides
//! there, expected (no roulette), is reflected by the faces after Fresnel, and keeps all energy.

use super::coefficients::Coefficients;
use super::domain::{Domain, SolverSlab};
use super::fresnel;
use std::f64::consts::PI;

/// Rays of one flight. 4096: half as many change a row's sum by 0.2 %, but tails of media with long free paths by some
/// percent.
const RAYS: usize = 4096;
/// A source of more columns than this has no rays to spare for each; nor has it a sharp image to get right.
const MOST_COLUMNS: usize = 256;
/// Below this share of its start a ray ends where it is.
const SPENT: f64 = 1e-3;
/// Powers of the inverse of the real root of x⁵ = x + 1.
const R4: [f64; 4] = [0.856_674_883_854_503, 0.733_891_856_627_126, 0.628_706_721_037_809, 0.538_597_257_223_61];

/// What became of light that flew.
#[derive(Debug, Default)]
pub(crate) struct Flown {
    /// What was scattered again, per voxel.
    pub scattered: Vec<f64>,
    pub absorbed: f64,
    pub top: f64,
    pub bottom: f64,
    pub sides: f64,
}

impl Flown {
    /// Adds a further flight.
    pub(crate) fn add(&mut self, next: &Self) {
        self.scattered.iter_mut().zip(&next.scattered).for_each(|(sum, q)| *sum += q);
        self.absorbed += next.absorbed;
        self.top += next.top;
        self.bottom += next.bottom;
        self.sides += next.sides;
    }
}

/// A slab to fly through.
#[derive(Debug)]
pub(super) struct Flights<'a> {
    domain: &'a Domain,
    coefficients: &'a Coefficients,
    refractive_index: f64,
    /// Depths of the layers' faces, mm.
    faces_mm: Vec<f64>,
}

/// A ray on its way: place in voxels over the plane and mm of depth, direction, voxel, weight.
#[derive(Debug)]
struct Ray {
    p: [f64; 3],
    d: [f64; 3],
    column: [usize; 2],
    layer: usize,
    weight: f64,
}

impl<'a> Flights<'a> {
    /// Through `slab`'s voxels in `domain`; `None` for a source (`flux` per column) too wide for it.
    pub(super) fn new(
        slab: &SolverSlab,
        domain: &'a Domain,
        coefficients: &'a Coefficients,
        flux: &[f64],
    ) -> Option<Self> {
        let mut faces_mm = vec![0.0];
        let mut depth = 0.0;
        faces_mm.extend(slab.layers_mm.iter().map(|dz| {
            depth += dz;
            depth
        }));
        let narrow = flux.iter().filter(|flux| **flux > 0.0).count() <= MOST_COLUMNS;
        narrow.then_some(Self { domain, coefficients, refractive_index: slab.volume.refractive_index, faces_mm })
    }

    /// One flight of light that starts isotropically in voxels, as much as `source` has (layer by layer).
    pub(super) fn fly(&self, source: &[f64]) -> Flown {
        let mut flown = Flown { scattered: vec![0.0; source.len()], ..Flown::default() };
        let total: f64 = source.iter().sum();
        if !(total > 0.0) {
            return flown;
        }
        let (plane, nx) = (self.domain.columns(), self.domain.voxels[0]);
        let (mut before, mut voxel) = (0.0, 0);
        for n in 0..RAYS {
            // Voxels in their order get rays by their light, from side to side: starts move smoothly as the light does.
            let share = (n as f64 + 0.5) / RAYS as f64 * total;
            while voxel + 1 < source.len() && before + source[voxel] < share {
                before += source[voxel];
                voxel += 1;
            }
            let along = ((share - before) / source[voxel]).clamp(0.0, 1.0);
            let u = R4.map(|step| (0.5 + (n + 1) as f64 * step).fract());
            let (layer, column) = (voxel / plane, [voxel % plane % nx, voxel % plane / nx]);
            let z = self.faces_mm[layer] + u[1] * (self.faces_mm[layer + 1] - self.faces_mm[layer]);
            let cosine = 1.0 - 2.0 * u[2];
            let (sin, cos) = (2.0 * PI * u[3]).sin_cos();
            let sine = (1.0 - cosine * cosine).sqrt();
            let ray = Ray {
                p: [column[0] as f64 + along, column[1] as f64 + u[0], z],
                d: [sine * cos, sine * sin, cosine],
                column,
                layer,
                weight: total / RAYS as f64,
            };
            self.trace(ray, &mut flown);
        }
        flown
    }

    /// From voxel to voxel until all has collided or left.
    fn trace(&self, mut ray: Ray, flown: &mut Flown) {
        let per_mm = 1.0 / self.domain.voxel_mm;
        let least = SPENT * ray.weight;
        loop {
            let (axis, length) = self.to_face(&ray);
            let column = ray.column[1] * self.domain.voxels[0] + ray.column[0];
            let (scattering, absorption) = self.coefficients.layer(ray.layer)[column];
            let extinction = scattering + absorption;
            // Rounding of a short way does not matter: what has not collided flies on.
            let mut collided = ray.weight * (1.0 - (-extinction * length).exp());
            if ray.weight - collided < least {
                collided = ray.weight;
            }
            ray.weight -= collided;
            flown.scattered[ray.layer * self.domain.columns() + column] += collided * scattering / extinction;
            flown.absorbed += collided * absorption / extinction;
            if ray.weight <= 0.0 {
                return;
            }
            ray.p[0] += ray.d[0] * per_mm * length;
            ray.p[1] += ray.d[1] * per_mm * length;
            ray.p[2] += ray.d[2] * length;
            let goes_on =
                if axis == 2 { self.cross_layer(&mut ray, flown) } else { self.cross_side(&mut ray, axis, flown) };
            if !goes_on {
                return;
            }
        }
    }

    /// The axis along which the ray leaves its voxel, and how far it is, mm.
    fn to_face(&self, ray: &Ray) -> (usize, f64) {
        let faces = |axis: usize| match axis {
            2 => (self.faces_mm[ray.layer], self.faces_mm[ray.layer + 1], 1.0),
            _ => (ray.column[axis] as f64, ray.column[axis] as f64 + 1.0, self.domain.voxel_mm),
        };
        let mut nearest = (2, f64::INFINITY);
        for axis in [2, 0, 1] {
            let (low, high, mm) = faces(axis);
            let edge = if ray.d[axis] > 0.0 { high } else { low };
            let length = (edge - ray.p[axis]) / ray.d[axis] * mm;
            // Along a face there is none to meet; rounding may have put the ray a little beyond it.
            if ray.d[axis] != 0.0 && length.max(0.0) < nearest.1 {
                nearest = (axis, length.max(0.0));
            }
        }
        nearest
    }

    /// Into the next column; false when the ray has left the box.
    fn cross_side(&self, ray: &mut Ray, axis: usize, flown: &mut Flown) -> bool {
        let onwards = ray.d[axis] > 0.0;
        let last = if onwards { self.domain.voxels[axis] - 1 } else { 0 };
        if ray.column[axis] == last {
            flown.sides += ray.weight;
            return false;
        }
        ray.p[axis] = (ray.column[axis] + usize::from(onwards)) as f64;
        ray.column[axis] = if onwards { ray.column[axis] + 1 } else { ray.column[axis] - 1 };
        true
    }

    /// Into the next layer, or back from a face of the slab less what leaves.
    fn cross_layer(&self, ray: &mut Ray, flown: &mut Flown) -> bool {
        let down = ray.d[2] > 0.0;
        ray.p[2] = self.faces_mm[ray.layer + usize::from(down)];
        match (down, ray.layer) {
            (true, layer) if layer + 2 < self.faces_mm.len() => ray.layer += 1,
            (false, layer) if layer > 0 => ray.layer -= 1,
            _ => {
                let leaves = ray.weight * (1.0 - fresnel::face(self.refractive_index, ray.d[2].abs()).reflectance);
                *(if down { &mut flown.bottom } else { &mut flown.top }) += leaves;
                ray.weight -= leaves;
                ray.d[2] = -ray.d[2];
            }
        }
        ray.weight > 0.0
    }
}
