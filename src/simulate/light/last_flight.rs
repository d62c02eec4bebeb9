//! The last flight: what the eye sees of light that diffuses in the slab.
//!
//! The formal solution of the transport equation along the line of sight: with a slab that sends out S/4π everywhere (S
//! = σ'_s φ + q, q what the beam scatters first), π times the radiance towards the eye is π (1 − F)/n² ∫ S/4π e^(−τ/µ)
//! dz/µ, µ the cosine to the normal inside. Within a layer φ is taken as linear from its top to its middle and from
//! there to its bottom, extinction as constant, and the beam as it fades: all of that is integrated exactly. Light from
//! depth z comes out z·slope beside its source; a layer is shifted as a whole, by cubic interpolation.
//!
//! Left out: what reaches the eye by way of the bottom face (F of it, some percent of the little that gets there).

use super::coefficients::Coefficients;
use super::domain::Domain;
use super::sight::Sight;

/// A shift of fewer voxels than this is not seen.
const UNSEEN: f64 = 0.01;

/// Light in the slab, layer by layer from the top.
pub(super) struct Lit<'a> {
    pub domain: &'a Domain,
    pub layers_mm: &'a [f64],
    pub coefficients: &'a Coefficients,
    /// What enters a column, per mm².
    pub enters: &'a dyn Fn(usize) -> f64,
    /// Fluence at the top of a layer, above a column; one layer more for the last one's bottom.
    pub at_face: &'a dyn Fn(usize, usize) -> f64,
    /// Fluence in the middle of a layer.
    pub middle: &'a dyn Fn(usize, usize) -> f64,
    /// What is scattered in a voxel after the first time and before diffusing, per mm², even over its depth.
    pub scattered: &'a dyn Fn(usize, usize) -> f64,
}

impl Lit<'_> {
    /// π times the radiance towards the eye above each column.
    pub(super) fn radiance(&self, eye_mm: [f64; 3], refractive_index: f64) -> Vec<f32> {
        let plane = self.domain.columns();
        let middle = |i: usize| {
            let corner = self.domain.voxel_corner_mm([i % self.domain.voxels[0], i / self.domain.voxels[0]]);
            corner.map(|c| c + 0.5 * self.domain.voxel_mm)
        };
        let sights: Vec<Sight> = (0..plane).map(|i| Sight::new(middle(i), eye_mm, refractive_index)).collect();
        // Above each column's layer: the optical depth, and the share that is left of what flies through it to the eye.
        let (mut above, mut seen) = (vec![0.0; plane], vec![1.0; plane]);
        let mut faded = vec![0.0; plane];
        let mut light = vec![0.0; plane];
        let mut sum = vec![0.0; plane];
        let mut depth = 0.0;
        for (k, dz) in self.layers_mm.iter().enumerate() {
            for i in 0..plane {
                let flight = Flight::new(self.layers_mm[k], self.coefficients.layer(k)[i], sights[i].cosine);
                light[i] = self.of_layer(k, i, &flight, above[i]);
                faded[i] = flight.left;
            }
            let shift_px = (depth + 0.5 * dz) / self.domain.voxel_mm;
            for i in 0..plane {
                let shift = sights[i].slope.map(|s| -s * shift_px);
                sum[i] += sampled(&light, self.domain.voxels, i, shift) * seen[i];
                let (s, a) = self.coefficients.layer(k)[i];
                above[i] += (s + a) * dz;
                seen[i] *= faded[i] * faded[i];
            }
            depth += dz;
        }
        // Interpolation may swing below zero beside a sharp dot; light does not.
        let emitted = |(sum, sight): (&f64, &Sight)| {
            let value = (1.0 - sight.reflectance) / (4.0 * refractive_index * refractive_index);
            (value * sum).max(0.0) as f32
        };
        sum.iter().zip(&sights).map(emitted).collect()
    }

    /// 4 times the radiance at the top of layer `k` that starts in it, under an optical depth of `above`.
    fn of_layer(&self, k: usize, i: usize, flight: &Flight, above: f64) -> f64 {
        let Flight { albedo, depth, cosine, even, rising, left } = *flight;
        let (top, here, bottom) = ((self.at_face)(k, i), (self.middle)(k, i), (self.at_face)(k + 1, i));
        let upper = top * (even - rising) + here * rising;
        let lower = here * (even - rising) + bottom * rising;
        let diffuse = albedo * (upper + left * lower);
        let again = match (self.scattered)(k, i) {
            0.0 => 0.0,
            scattered => scattered / depth * even * (1.0 + left),
        };
        // The beam fades on its way down, and what it scatters on its way up.
        let first = match (self.enters)(i) {
            0.0 => 0.0,
            enters => {
                let both = (1.0 + cosine) / cosine;
                enters * albedo / (1.0 + cosine) * (-above).exp() * -(-depth * both).exp_m1()
            }
        };
        diffuse + again + first
    }
}

/// A voxel on the way to the eye.
struct Flight {
    albedo: f64,
    /// Optical depth from its top to its bottom.
    depth: f64,
    cosine: f64,
    /// [`fading`] over its upper half, along the way to the eye.
    even: f64,
    rising: f64,
    /// What that half lets through.
    left: f64,
}

impl Flight {
    fn new(layer_mm: f64, (scattering, absorption): (f64, f64), cosine: f64) -> Self {
        let extinction = scattering + absorption;
        let depth = extinction * layer_mm;
        let (even, rising) = fading(0.5 * depth / cosine);
        Self { albedo: scattering / extinction, depth, cosine, even, rising, left: 1.0 - even }
    }
}

/// ∫ e^(−t) dt and ∫ (t/x) e^(−t) dt over 0..x.
fn fading(x: f64) -> (f64, f64) {
    if x < 1e-4 {
        // Their series: the next terms are of x³.
        return (x * (1.0 - 0.5 * x), x * (0.5 - x / 3.0));
    }
    let even = -(-x).exp_m1();
    (even, (even - x * (1.0 - even)) / x)
}

/// A map beside cell `i`, by cubic convolution (Keys 1981, a = −1/2): exact for parabolas, so that it does not blur;
/// beyond the map its border.
fn sampled(map: &[f64], [nx, ny]: [usize; 2], i: usize, shift: [f64; 2]) -> f64 {
    if shift[0].abs().max(shift[1].abs()) < UNSEEN {
        return map[i];
    }
    let taps = |at: usize, shift: f64, n: usize| {
        let place = at as f64 + shift;
        let t = place - place.floor();
        let weights = [
            0.5 * t * (t * (2.0 - t) - 1.0),
            0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
            0.5 * t * (t * (4.0 - 3.0 * t) + 1.0),
            0.5 * t * t * (t - 1.0),
        ];
        let first = place.floor() as i64 - 1;
        let cells: [usize; 4] = std::array::from_fn(|j| (first + j as i64).clamp(0, n as i64 - 1) as usize);
        (cells, weights)
    };
    let ((columns, wx), (rows, wy)) = (taps(i % nx, shift[0], nx), taps(i / nx, shift[1], ny));
    let mut sum = 0.0;
    for (y, wy) in rows.iter().zip(wy) {
        for (x, wx) in columns.iter().zip(wx) {
            sum += wx * wy * map[y * nx + x];
        }
    }
    sum
}
