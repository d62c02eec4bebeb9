//! One photon's way through the slab.

use super::{
    Beam, Rings, Window,
    fresnel::{Passage, face},
    medium::{Local, Medium},
    phase::{density, scatter},
    tally::Tally,
};
use crate::geometry::Point;
use rand::RngExt;
use rand_distr::{Distribution, Exp1, StandardNormal};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

/// Below this weight a photon is played for: it goes on with [`SURVIVAL`], made heavier by as much.
const LIGHT: f64 = 0.02;
const SURVIVAL: f64 = 0.1;
/// Collisions deeper than this many free paths show themselves to the eye only at times, and then as bright as all.
const DEEP: f64 = 3.0;
const SHOWN: f64 = 0.125;

/// All that does not change from photon to photon.
#[derive(Debug)]
pub(super) struct Walk<'a> {
    pub medium: Medium,
    pub beam: &'a Beam,
    pub window: Option<&'a Window>,
    pub rings: Option<&'a Rings>,
    pub eye_mm: Option<[f64; 3]>,
    pub exitance: bool,
    pub extent_mm: [Point; 2],
}

/// Where a photon is, where it goes, and what it is worth.
struct Photon {
    p: [f64; 3],
    d: [f64; 3],
    layer: usize,
    weight: f64,
    scattered: bool,
}

/// What ends a straight flight.
enum End {
    Collision,
    Edge,
    Side,
}

impl Walk<'_> {
    /// Share of the light that the top face turns back before it enters.
    pub fn specular(&self) -> f64 {
        face(1.0 / self.medium.refractive_index, 1.0).reflectance
    }

    /// Traces one photon from the beam to its end.
    pub fn photon(&self, rng: &mut Pcg64Mcg, tally: &mut Tally) {
        let [x, y] = self.beam.sample(rng);
        let weight = 1.0 - self.specular();
        let mut photon = Photon { p: [x, y, 0.0], d: [0.0, 0.0, 1.0], layer: 0, weight, scattered: false };
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
        if let (Some(eye), Some(window)) = (self.eye_mm, self.window) {
            self.show(photon, local, eye, window, rng, tally);
        }
        photon.d = scatter(photon.d, local.g, rng);
        true
    }

    /// Adds what the eye receives of this scattering: the expected light that flies to it without another one, straight
    /// or by way of the faces, which reflect a part of it.
    ///
    /// With Φ scattered by p per steradian inside, and dω' cosθ' n² = dω cosθ across the face, π times the radiance that
    /// leaves is π Φ p e^(−τ) (1 − F)/(n² cosθ') per area. The direction is the eye's from above the collision; from
    /// where the light leaves it differs by less than depth over distance to the eye.
    fn show(
        &self,
        photon: &Photon,
        local: Local,
        eye: [f64; 3],
        window: &Window,
        rng: &mut Pcg64Mcg,
        tally: &mut Tally,
    ) {
        let n = self.medium.refractive_index;
        let to: [f64; 3] = [eye[0] - photon.p[0], eye[1] - photon.p[1], eye[2]];
        let scale = 1.0 / (to[0] * to[0] + to[1] * to[1] + to[2] * to[2]).sqrt();
        let Passage { reflectance, cosine } = face(1.0 / n, -to[2] * scale);
        let up = [to[0] * scale / n, to[1] * scale / n, -cosine];
        let down = [up[0], up[1], cosine];
        let value = photon.weight * PI / (n * n * cosine);
        let turned = |d: [f64; 3]| density(local.g, photon.d[0] * d[0] + photon.d[1] * d[1] + photon.d[2] * d[2]);
        let mut add = |at: [f64; 3], light: f64| {
            if let Some(cell) = window.cell(at[0], at[1]) {
                tally.radiance[cell] += (1.0 - reflectance) * light;
            }
        };
        let slope = [up[0] / cosine, up[1] / cosine];
        let along = |p: [f64; 3], z: f64| [p[0] + (p[2] - z).abs() * slope[0], p[1] + (p[2] - z).abs() * slope[1], z];
        let medium = &self.medium;
        // Little light comes up from the deep: an eighth of those collisions stand for all.
        let played = local.extinction * photon.p[2] > DEEP;
        if !played || rng.random::<f64>() < SHOWN {
            let light = value * turned(up) * (-medium.depth_to_face(photon.layer, photon.p, up)).exp();
            add(along(photon.p, 0.0), if played { light / SHOWN } else { light });
        }
        // What the faces send back is little too: the bottom first, or the top and then the bottom.
        if reflectance > 0.0 && rng.random::<f64>() < SHOWN {
            let (last, thickness) = (medium.layers.len() - 1, medium.thickness_mm());
            let from_top = value * turned(up) * (-medium.depth_to_face(photon.layer, photon.p, up)).exp() * reflectance;
            let starts = [(photon.p, photon.layer, value * turned(down)), (along(photon.p, 0.0), 0, from_top)];
            for (mut p, mut layer, light) in starts {
                let mut light = light / SHOWN;
                loop {
                    let bottom = along(p, thickness);
                    let depth = medium.depth_to_face(layer, p, down) + medium.depth_to_face(last, bottom, up);
                    light *= reflectance * (-depth).exp();
                    (p, layer) = (along(bottom, 0.0), 0);
                    add(p, light);
                    light *= reflectance / SHOWN;
                    if light == 0.0 || rng.random::<f64>() >= SHOWN {
                        break;
                    }
                }
            }
        }
    }
}

impl Beam {
    /// Where a photon of the beam arrives.
    #[inline]
    fn sample(&self, rng: &mut Pcg64Mcg) -> Point {
        if self.side_px == 0.0 && self.blur_px == 0.0 {
            return self.center_mm;
        }
        let q: Point = std::array::from_fn(|_| {
            let normal: f64 = StandardNormal.sample(rng);
            self.side_px * (rng.random::<f64>() - 0.5) + self.blur_px * normal
        });
        std::array::from_fn(|a| self.center_mm[a] + self.mm_from_px[a][0] * q[0] + self.mm_from_px[a][1] * q[1])
    }
}

impl Window {
    /// The cell that holds (x, y).
    #[inline]
    fn cell(&self, x: f64, y: f64) -> Option<usize> {
        let (u, v) = ((x - self.corner_mm[0]) / self.cell_mm, (y - self.corner_mm[1]) / self.cell_mm);
        let inside = u >= 0.0 && v >= 0.0 && u < self.cells[0] as f64 && v < self.cells[1] as f64;
        inside.then(|| v as usize * self.cells[0] + u as usize)
    }
}
