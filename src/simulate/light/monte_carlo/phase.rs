//! Henyey and Greenstein's phase function, and random directions.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

/// A uniform point of the unit disc's inside (not its centre) and its squared distance from the centre.
#[inline]
fn disc(rng: &mut Pcg64Mcg) -> ([f64; 2], f64) {
    const HALF: f64 = 1.0 / (1u64 << 31) as f64;
    loop {
        // Both coordinates from one number: 32 bits are finer than any tally.
        let bits: u64 = rng.random();
        let u = f64::from((bits >> 32) as i32) * HALF;
        let v = f64::from(bits as i32) * HALF;
        let s = u * u + v * v;
        if s < 1.0 && s > 0.0 {
            return ([u, v], s);
        }
    }
}

/// A direction uniform over the sphere (Marsaglia 1972).
#[inline]
pub(super) fn isotropic(rng: &mut Pcg64Mcg) -> [f64; 3] {
    let ([u, v], s) = disc(rng);
    let root = 2.0 * (1.0 - s).sqrt();
    [u * root, v * root, 1.0 - 2.0 * s]
}

/// The direction after scattering from direction `d` (a unit vector) with mean cosine `g`.
#[inline]
pub(super) fn scatter(d: [f64; 3], g: f64, rng: &mut Pcg64Mcg) -> [f64; 3] {
    if g == 0.0 {
        return isotropic(rng);
    }
    let t = (1.0 - g * g) / (1.0 - g + 2.0 * g * rng.random::<f64>());
    let cosine = ((1.0 + g * g - t * t) / (2.0 * g)).clamp(-1.0, 1.0);
    let ([u, v], s) = disc(rng);
    // The azimuth (u, v)/√s times the sine, in one root.
    let scale = ((1.0 - cosine * cosine) / s).sqrt();
    let (a, b) = (u * scale, v * scale);
    // A basis around d without branches (Duff et al. 2017).
    let sign = 1.0f64.copysign(d[2]);
    let k = -1.0 / (sign + d[2]);
    let m = d[0] * d[1] * k;
    let e1 = [1.0 + sign * d[0] * d[0] * k, sign * m, -sign * d[0]];
    let e2 = [m, sign + d[1] * d[1] * k, -d[1]];
    let mut out: [f64; 3] = std::array::from_fn(|i| a * e1[i] + b * e2[i] + cosine * d[i]);
    // Keeps the length at 1 over thousands of turns: one Newton step.
    let fix = 1.5 - 0.5 * (out[0] * out[0] + out[1] * out[1] + out[2] * out[2]);
    out.iter_mut().for_each(|v| *v *= fix);
    out
}

/// The share that scatters into one steradian around an angle of cosine `cosine` (Henyey & Greenstein 1941).
#[inline]
pub(super) fn density(g: f64, cosine: f64) -> f64 {
    if g == 0.0 {
        return 1.0 / (4.0 * PI);
    }
    let t = 1.0 + g * g - 2.0 * g * cosine;
    (1.0 - g * g) / (4.0 * PI * t * t.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    /// The first two Legendre moments of Henyey and Greenstein's function are g and g²; the azimuth is uniform.
    #[test]
    fn scattering_has_the_moments_of_its_phase_function() {
        let mut rng = Pcg64Mcg::seed_from_u64(5);
        for g in [-0.5, 0.0, 0.3, 0.9] {
            for d in [[0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.48, -0.64, 0.6]] {
                let n = 200_000;
                let (mut first, mut second, mut sum) = (0.0, 0.0, [0.0; 3]);
                for _ in 0..n {
                    let to = scatter(d, g, &mut rng);
                    let length: f64 = to.iter().map(|v| v * v).sum();
                    assert!((length - 1.0).abs() < 1e-12);
                    let c: f64 = to.iter().zip(&d).map(|(a, b)| a * b).sum();
                    first += c / f64::from(n);
                    second += 0.5 * (3.0 * c * c - 1.0) / f64::from(n);
                    sum.iter_mut().zip(to).for_each(|(s, t)| *s += t / f64::from(n));
                }
                // Both have a standard deviation below 0.6: five standard errors.
                let error = 5.0 * 0.6 / f64::from(n).sqrt();
                assert!((first - g).abs() < error && (second - g * g).abs() < error, "g {g}: {first} {second}");
                let aside: f64 = sum.iter().zip(&d).map(|(s, d)| (s - g * d).powi(2)).sum::<f64>().sqrt();
                assert!(aside < 2.0 * error, "g {g}: {sum:?}");
            }
        }
    }

    #[test]
    fn the_density_integrates_to_one_and_to_its_mean_cosine() {
        for g in [-0.7, 0.0, 0.2, 0.85] {
            let n = 200_000;
            let (mut total, mut mean) = (0.0, 0.0);
            for i in 0..n {
                let c = 2.0 * (f64::from(i) + 0.5) / f64::from(n) - 1.0;
                let p = density(g, c) * 4.0 * PI / f64::from(n);
                total += p;
                mean += c * p;
            }
            assert!((total - 1.0).abs() < 1e-6 && (mean - g).abs() < 1e-6, "{g}: {total} {mean}");
        }
    }
}
