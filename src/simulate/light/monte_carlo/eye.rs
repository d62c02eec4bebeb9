//! What an eye above the slab receives of a scattering inside it.

use super::{
    TallyWindow,
    medium::{Local, Medium},
    phase::density,
    photon::Photon,
};
use crate::geometry::Point;
use crate::simulate::light::sight::Sight;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

/// Patches along each axis of the window, each of which has one direction towards the eye.
const PATCHES: usize = 32;
/// Collisions deeper than this many free paths show themselves to the eye only at times, and then as bright as all.
const DEEP: f64 = 2.0;
const SHOWN: f64 = 0.0625;
/// By way of both faces over this many free paths next to nothing comes: played for even more rarely.
const FAR: f64 = 8.0;
const SHOWN_FAR: f64 = 1.0 / 256.0;

/// An eye and the window through which it looks.
#[derive(Debug)]
pub(super) struct Eye<'a> {
    window: &'a TallyWindow,
    medium: &'a Medium,
    /// The way from each patch, and what flux per inverse steradian inside is worth of π times radiance: π (1 − F)/(n²
    /// cosθ').
    sights: Vec<(Sight, f64)>,
}

impl<'a> Eye<'a> {
    /// The eye at `eye_mm`, above the slab.
    pub(super) fn new(eye_mm: [f64; 3], window: &'a TallyWindow, medium: &'a Medium) -> Self {
        let n = medium.refractive_index;
        let sight = |i: usize| {
            let share = [i % PATCHES, i / PATCHES].map(|p| (p as f64 + 0.5) / PATCHES as f64);
            let at: Point = std::array::from_fn(|a| window.corner_mm[a] + share[a] * window.side_mm(a));
            let sight = Sight::new(at, eye_mm, n);
            (sight, PI * (1.0 - sight.reflectance) / (n * n * sight.cosine))
        };
        Self { window, medium, sights: (0..PATCHES * PATCHES).map(sight).collect() }
    }

    /// The way to the eye from above `p`, for places beside the window that from its border.
    #[inline]
    fn sight(&self, p: [f64; 3]) -> &(Sight, f64) {
        let patch = |a: usize| {
            let share = (p[a] - self.window.corner_mm[a]) * (1.0 / self.window.side_mm(a));
            // Casting stops at the ends of the range.
            ((share * PATCHES as f64) as usize).min(PATCHES - 1)
        };
        &self.sights[patch(1) * PATCHES + patch(0)]
    }

    /// Adds what the eye receives of this scattering to `radiance`: the expected light that flies to it without another
    /// one, straight or by way of the faces, which reflect a part of it.
    ///
    /// With Φ scattered by p per steradian inside, and dω' cosθ' n² = dω cosθ across the face, π times the radiance
    /// that leaves is π Φ p e^(−τ) (1 − F)/(n² cosθ') per area.
    pub(super) fn receive(&self, photon: &Photon, local: Local, rng: &mut Pcg64Mcg, radiance: &mut [f64]) {
        let (sight, value) = self.sight(photon.p);
        let depth = local.extinction * photon.p[2];
        // Little light comes up from the deep: one in sixteen of those collisions stands for all.
        let share = if depth > DEEP { SHOWN } else { 1.0 };
        if share == 1.0 || rng.random::<f64>() < share {
            let light = value * starts(photon, local, sight.up) / share;
            let up = self.medium.depth_to_face(photon.layer, photon.p, sight.up);
            self.add(sight.along(photon.p, 0.0), light * (-up).exp(), radiance);
        }
        if sight.reflectance > 0.0 {
            let far = local.extinction * self.medium.thickness_mm() > FAR;
            let share = if far { SHOWN_FAR } else { SHOWN };
            if rng.random::<f64>() < share {
                self.receive_reflected(photon, local, share, rng, radiance);
            }
        }
    }

    /// What comes by way of the faces: the bottom first, or the top and then the bottom, and so on from top to bottom.
    fn receive_reflected(&self, photon: &Photon, local: Local, share: f64, rng: &mut Pcg64Mcg, radiance: &mut [f64]) {
        let (medium, (sight, value)) = (self.medium, self.sight(photon.p));
        let (last, thickness) = (medium.layers.len() - 1, medium.thickness_mm());
        let down = [sight.up[0], sight.up[1], -sight.up[2]];
        let to_top = (-medium.depth_to_face(photon.layer, photon.p, sight.up)).exp() * sight.reflectance;
        let starts = [
            (photon.p, photon.layer, value * starts(photon, local, down) / share),
            (sight.along(photon.p, 0.0), 0, value * starts(photon, local, sight.up) / share * to_top),
        ];
        for (mut p, mut layer, mut light) in starts {
            loop {
                let bottom = sight.along(p, thickness);
                let depth = medium.depth_to_face(layer, p, down) + medium.depth_to_face(last, bottom, sight.up);
                light *= sight.reflectance * (-depth).exp();
                (p, layer) = (sight.along(bottom, 0.0), 0);
                self.add(p, light, radiance);
                light *= sight.reflectance / SHOWN;
                if light == 0.0 || rng.random::<f64>() >= SHOWN {
                    break;
                }
            }
        }
    }

    #[inline]
    fn add(&self, at: [f64; 3], light: f64, radiance: &mut [f64]) {
        if let Some(cell) = self.window.cell(at[0], at[1]) {
            radiance[cell] += light;
        }
    }
}

/// What starts into direction `d`, per steradian.
#[inline]
fn starts(photon: &Photon, local: Local, d: [f64; 3]) -> f64 {
    let turn = photon.d[0] * d[0] + photon.d[1] * d[1] + photon.d[2] * d[2];
    photon.weight * density(local.g, turn)
}
