//! One photon's way through the slab.

use super::{Rings, TallyWindow, eye::Eye, medium::Medium, phase::scatter, photon::Photon, tally::Tally};
use crate::geometry::Point;
use crate::simulate::light::beam::Beam;
use crate::simulate::light::fresnel::{Passage, face};
use rand::RngExt;
use rand_distr::{Distribution, Exp1};
use rand_pcg::Pcg64Mcg;

/// Below this weight a photon is played for: it goes on with [`SURVIVAL`], made heavier by as much.
const LIGHT: f64 = 0.02;
const SURVIVAL: f64 = 0.1;

/// All that does not change from photon to photon.
#[derive(Debug)]
pub(super) struct Walk<'a> {
    pub medium: &'a Medium,
    /// Share of the light that the top face lets in.
    pub enters: f64,
    pub beam: &'a Beam,
    pub window: Option<&'a TallyWindow>,
    pub rings: Option<&'a Rings>,
    pub eye: Option<Eye<'a>>,
    pub exitance: bool,
    pub extent_mm: [Point; 2],
}

/// What ends a straight flight.
enum End {
    Collision,
    Edge,
    Side,
}

impl Walk<'_> {
    /// Traces one photon from the beam to its end.
    pub(super) fn photon(&self, rng: &mut Pcg64Mcg, tally: &mut Tally) {
        let [x, y] = self.beam.sample(rng);
        let mut photon = Photon { p: [x, y, 0.0], d: [0.0, 0.0, 1.0], layer: 0, weight: self.enters, scattered: false };
        tally.photons += 1;
        if self.beside(photon.p) {
            tally.sides += photon.weight;
            return;
        }
        let mut depth: f64 = Exp1.sample(rng);
        loop {
            match self.fly(&mut photon, &mut depth) {
                End::Side => {
                    tally.sides += photon.weight;
                    return;
                }
                End::Edge => {
                    if !self.cross(&mut photon, rng, tally) {
                        return;
                    }
                }
                End::Collision => {
                    depth = Exp1.sample(rng);
                    if !self.collide(&mut photon, rng, tally) {
                        return;
                    }
                }
            }
        }
    }

    /// Moves the photon by `depth` of the layer's majorant, or to where the layer or the slab ends.
    #[inline]
    fn fly(&self, photon: &mut Photon, depth: &mut f64) -> End {
        let layer = &self.medium.layers[photon.layer];
        let [dx, dy, dz] = photon.d;
        let edge = if dz > 0.0 { layer.bottom_mm } else { layer.top_mm };
        // Straight along the slab there is no edge, and without matter no collision: both infinite, and a side is met.
        let to_edge = if dz == 0.0 { f64::INFINITY } else { (edge - photon.p[2]) / dz };
        let to_collision = *depth / layer.majorant;
        let length = to_edge.min(to_collision);
        let to = [photon.p[0] + length * dx, photon.p[1] + length * dy, photon.p[2] + length * dz];
        if self.beside(to) {
            return End::Side;
        }
        photon.p = to;
        if to_collision <= to_edge {
            return End::Collision;
        }
        *depth -= to_edge * layer.majorant;
        photon.p[2] = edge;
        End::Edge
    }

    /// Whether a point lies beside the slab; NaN and infinities do.
    #[inline]
    fn beside(&self, p: [f64; 3]) -> bool {
        let [low, high] = self.extent_mm;
        !(p[0] >= low[0] && p[0] <= high[0] && p[1] >= low[1] && p[1] <= high[1])
    }

    /// From layer to layer, or through a face; false when the photon has left.
    #[inline]
    fn cross(&self, photon: &mut Photon, rng: &mut Pcg64Mcg, tally: &mut Tally) -> bool {
        let up = photon.d[2] < 0.0;
        if up && photon.layer > 0 {
            photon.layer -= 1;
            return true;
        }
        if !up && photon.layer + 1 < self.medium.layers.len() {
            photon.layer += 1;
            return true;
        }
        // What leaves is counted by its share; whether the photon itself goes on is drawn.
        let Passage { reflectance, .. } = face(self.medium.refractive_index, photon.d[2].abs());
        let leaves = photon.weight * (1.0 - reflectance);
        if leaves > 0.0 {
            match (up, photon.scattered) {
                (true, _) => self.leave_through_top(photon, leaves, tally),
                (false, true) => tally.diffuse += leaves,
                (false, false) => tally.ballistic += leaves,
            }
        }
        photon.d[2] = -photon.d[2];
        reflectance == 1.0 || rng.random::<f64>() < reflectance
    }

    fn leave_through_top(&self, photon: &Photon, leaves: f64, tally: &mut Tally) {
        tally.reflected += leaves;
        let [x, y, _] = photon.p;
        if let Some(rings) = self.rings {
            let r = (x - self.beam.center_mm[0]).hypot(y - self.beam.center_mm[1]);
            if let Some(ring) = tally.rings.get_mut((r / rings.width_mm) as usize) {
                *ring += leaves;
            }
        }
        if self.exitance
            && let Some(cell) = self.window.and_then(|w| w.cell(x, y))
        {
            tally.exitance[cell] += leaves;
        }
    }

    /// A collision with the majorant: scatters, shows itself to the eye; false when the photon has ended.
    #[inline]
    fn collide(&self, photon: &mut Photon, rng: &mut Pcg64Mcg, tally: &mut Tally) -> bool {
        let layer = &self.medium.layers[photon.layer];
        let local = self.medium.local(layer, photon.p[0], photon.p[1]);
        if layer.uniform.is_none() && rng.random::<f64>() * layer.majorant >= local.extinction {
            return true;
        }
        tally.absorbed += photon.weight * (1.0 - local.albedo);
        photon.weight *= local.albedo;
        photon.scattered = true;
        if photon.weight < LIGHT {
            if photon.weight <= 0.0 || rng.random::<f64>() >= SURVIVAL {
                return false;
            }
            photon.weight /= SURVIVAL;
        }
        if let Some(eye) = &self.eye {
            eye.receive(photon, local, rng, &mut tally.radiance);
        }
        photon.d = scatter(photon.d, local.g, rng);
        true
    }
}
