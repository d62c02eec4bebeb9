//! The light of one projector dot as it arrives on the slab.

use super::domain::Domain;
use crate::geometry::Point;
use crate::simulate::scene::{patterns::soft_dot, pixels::GAUSS_6};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;

/// Light that arrives along the normal, spread evenly over a square of projector pixels and blurred.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Beam {
    /// Its centre, mm.
    pub center_mm: Point,
    /// Slab mm for projector px: the derivative of the projector's view.
    pub mm_from_px: [[f64; 2]; 2],
    /// Side of the square, projector px.
    pub side_px: f64,
    /// Whether it is a disc of that diameter.
    pub round: bool,
    /// Standard deviation of the blur, projector px.
    pub blur_px: f64,
}

impl Beam {
    /// All light at one point.
    pub fn pencil(center_mm: Point) -> Self {
        Self { center_mm, mm_from_px: [[1.0, 0.0], [0.0, 1.0]], side_px: 0.0, round: false, blur_px: 0.0 }
    }

    /// Where a photon of the beam arrives.
    #[inline]
    pub(crate) fn sample(&self, rng: &mut Pcg64Mcg) -> Point {
        if self.side_px == 0.0 && self.blur_px == 0.0 {
            return self.center_mm;
        }
        let normal = |rng: &mut Pcg64Mcg| -> f64 { StandardNormal.sample(rng) };
        let q: Point = if self.round {
            let (around, share) = (std::f64::consts::TAU * rng.random::<f64>(), rng.random::<f64>());
            let r = 0.5 * self.side_px * share.sqrt();
            [r * around.cos(), r * around.sin()].map(|even| even + self.blur_px * normal(rng))
        } else {
            std::array::from_fn(|_| {
                let blur = self.blur_px * normal(rng);
                self.side_px * (rng.random::<f64>() - 0.5) + blur
            })
        };
        std::array::from_fn(|a| self.center_mm[a] + self.mm_from_px[a][0] * q[0] + self.mm_from_px[a][1] * q[1])
    }

    /// How far from its centre it has light, along x and y, mm: to six standard deviations of the blur.
    pub(crate) fn reach_mm(&self) -> Point {
        let reach_px = 0.5 * self.side_px + 6.0 * self.blur_px;
        self.mm_from_px.map(|row| reach_px * (row[0].abs() + row[1].abs()))
    }

    /// Share of the beam that each voxel column of `domain` receives (they sum to 1), by 6 × 6 Gauss points a column.
    pub(crate) fn footprint(&self, domain: &Domain) -> Vec<f64> {
        let (j, center_mm) = (self.mm_from_px, self.center_mm);
        let det = j[0][0] * j[1][1] - j[0][1] * j[1][0];
        let (half, reach_mm) = (0.5 * self.side_px, self.reach_mm());
        let range = |a: usize| {
            let voxel = |v: f64| (v - domain.corner_mm[a]) / domain.voxel_mm;
            let limit = domain.voxels[a] as f64;
            let (from, to) = (voxel(center_mm[a] - reach_mm[a]).floor(), voxel(center_mm[a] + reach_mm[a]).ceil());
            from.clamp(0.0, limit) as usize..to.clamp(0.0, limit) as usize
        };
        let mut flux = vec![0.0; domain.columns()];
        for y in range(1) {
            for x in range(0) {
                let corner = domain.voxel_corner_mm([x, y]);
                let mut sum = 0.0;
                for &(v, wv) in GAUSS_6 {
                    for &(u, wu) in GAUSS_6 {
                        let d = [
                            corner[0] + (u + 0.5) * domain.voxel_mm - center_mm[0],
                            corner[1] + (v + 0.5) * domain.voxel_mm - center_mm[1],
                        ];
                        let q = [(j[1][1] * d[0] - j[0][1] * d[1]) / det, (j[0][0] * d[1] - j[1][0] * d[0]) / det];
                        sum += wu * wv * soft_dot(q, half, self.blur_px, self.round);
                    }
                }
                flux[y * domain.voxels[0] + x] = sum;
            }
        }
        let total: f64 = flux.iter().sum();
        if total > 0.0 {
            flux.iter_mut().for_each(|f| *f /= total);
        }
        flux
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    fn beam(center_mm: Point) -> Beam {
        Beam { center_mm, mm_from_px: [[0.2, 0.03], [-0.02, 0.18]], side_px: 3.0, round: false, blur_px: 0.3 }
    }

    const DOMAIN: Domain = Domain { corner_mm: [0.0, 0.0], voxel_mm: 0.4, voxels: [20, 20] };

    fn mean_x(flux: &[f64]) -> f64 {
        flux.iter().enumerate().map(|(i, f)| f * ((i % 20) as f64 + 0.5) * 0.4).sum()
    }

    #[test]
    fn the_footprint_moves_smoothly() {
        for step in 0..8 {
            let x = 4.0 + 0.05 * f64::from(step);
            let mean = mean_x(&beam([x, 4.0]).footprint(&DOMAIN));
            // Voxel columns hold only masses, so their centroid may differ by the second moment within a voxel.
            assert!((mean - x).abs() < 0.02, "{x}: {mean}");
        }
    }

    #[test]
    fn photons_arrive_where_the_footprint_is() {
        arrive(&beam([4.1, 3.9]));
        arrive(&Beam { round: true, ..beam([4.1, 3.9]) });
    }

    fn arrive(beam: &Beam) {
        let mut rng = Pcg64Mcg::seed_from_u64(2);
        let mut counts = vec![0.0; DOMAIN.columns()];
        let n = 400_000;
        for _ in 0..n {
            let p = beam.sample(&mut rng);
            counts[(p[1] / 0.4) as usize * 20 + (p[0] / 0.4) as usize] += 1.0 / f64::from(n);
        }
        for (i, (counted, share)) in counts.iter().zip(beam.footprint(&DOMAIN)).enumerate() {
            // Five standard errors of a share, and the quadrature of a blurred edge.
            let error = 5.0 * (share / f64::from(n)).sqrt() + 1e-3;
            assert!((counted - share).abs() < error, "column {i}: {counted}, {share}");
        }
    }
}
