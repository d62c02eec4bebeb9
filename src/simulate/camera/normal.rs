//! Normal deviates by the block, written so that the compiler vectorizes them.
//!
//! Only additions, multiplications, divisions, square roots and operations on bits, all exact by IEEE 754: the same
//! deviates on every machine.

use crate::simulate::mix_seed;

/// Deviates made together: enough to hide latencies, few enough for the nearest cache.
pub(crate) const BLOCK: usize = 512;
/// Generators side by side, one per lane of the vector unit.
const LANES: usize = 8;
const HALF: usize = BLOCK / 2;

/// Standard normal deviates: xoshiro128+ (Blackman and Vigna 2021) in [`LANES`] lanes, each with a seed of its own, and
/// the transform of Box and Muller (1958) in single precision (relative error of radius and angle below 1e-6; none
/// beyond 6.6 standard deviations).
#[derive(Debug, Clone)]
pub(crate) struct Normals {
    state: [[u32; LANES]; 4],
}

impl Normals {
    /// The same seed gives the same deviates.
    pub(crate) fn new(seed: u64) -> Self {
        let word = |word: usize, lane: usize| (mix_seed(seed, (word * LANES + lane) as u64) >> 32) as u32;
        // A state of all zeros would stay there.
        Self { state: std::array::from_fn(|w| std::array::from_fn(|l| word(w, l) | u32::from(w == 0))) }
    }

    /// The next word of each lane.
    #[inline(always)]
    fn next(&mut self) -> [u32; LANES] {
        let [a, b, c, d] = &mut self.state;
        let mut out = [0; LANES];
        for l in 0..LANES {
            out[l] = a[l].wrapping_add(d[l]);
            let t = b[l] << 9;
            c[l] ^= a[l];
            d[l] ^= b[l];
            b[l] ^= c[l];
            a[l] ^= d[l];
            c[l] ^= t;
            d[l] = d[l].rotate_left(11);
        }
        out
    }

    /// Fills a block.
    #[inline(always)]
    pub(crate) fn fill(&mut self, out: &mut [f32; BLOCK]) {
        let (first, second) = out.split_at_mut(HALF);
        for (first, second) in first.chunks_exact_mut(LANES).zip(second.chunks_exact_mut(LANES)) {
            let (for_radius, for_angle) = (self.next(), self.next());
            for l in 0..LANES {
                // (0, 1): 31 bits of which the small values keep their own exponent.
                let uniform = ((for_radius[l] >> 1) as i32 as f32 + 0.5) * (1.0 / 2_147_483_648.0);
                let radius = (-2.0 * ln(uniform)).max(0.0).sqrt();
                // An angle within π/4 of the x axis, from the upper bits; two lower ones, which the shift drops, say
                // whether x and y change places, and the sign of the one along the axis.
                let angle = (for_angle[l] >> 8) as i32 as f32 - 8_388_607.5;
                let angle = angle * (std::f32::consts::FRAC_PI_4 / 8_388_608.0);
                let (cosine, sine) = cos_sin(angle);
                let sign = (for_angle[l] & 0x80) << 24;
                let along = f32::from_bits((radius * cosine).to_bits() ^ sign).to_bits();
                let across = (radius * sine).to_bits();
                let swap = ((for_angle[l] >> 6) & 1).wrapping_neg();
                let exchanged = (along ^ across) & swap;
                first[l] = f32::from_bits(along ^ exchanged);
                second[l] = f32::from_bits(across ^ exchanged);
            }
        }
    }
}

/// ln of a positive normal number, to 2e-7 relative or absolute: exponent by bits, 2 artanh((m − 1)/(m + 1)) by its
/// series.
#[inline(always)]
fn ln(v: f32) -> f32 {
    let bits = v.to_bits() as i32;
    // The exponent that brings the mantissa to √½..√2.
    let exponent = (bits - 0x3f35_04f3) >> 23;
    let mantissa = f32::from_bits((bits - (exponent << 23)) as u32);
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let s2 = s * s;
    let series = 2.0 + s2 * (2.0 / 3.0 + s2 * (2.0 / 5.0 + s2 * (2.0 / 7.0 + s2 * (2.0 / 9.0))));
    exponent as f32 * std::f32::consts::LN_2 + s * series
}

/// Cosine and sine within ±π/4 by their series, to 1e-7.
#[inline(always)]
fn cos_sin(x: f32) -> (f32, f32) {
    let x2 = x * x;
    let cosine = 1.0 + x2 * (-0.5 + x2 * (1.0 / 24.0 + x2 * (-1.0 / 720.0 + x2 * (1.0 / 40_320.0))));
    let sine = x * (1.0 + x2 * (-1.0 / 6.0 + x2 * (1.0 / 120.0 + x2 * (-1.0 / 5040.0 + x2 * (1.0 / 362_880.0)))));
    (cosine, sine)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::scene::patterns::normal_cdf;

    #[test]
    fn the_series_are_as_exact_as_stated() {
        for k in 1..100_000 {
            let v = k as f32 / 100_000.0;
            let exact = f64::from(v).ln();
            assert!((f64::from(ln(v)) - exact).abs() < 2e-7 * (1.0 + exact.abs()), "{v}");
            let x = (2.0 * v - 1.0) * std::f32::consts::FRAC_PI_4;
            let (c, s) = cos_sin(x);
            let (sine, cosine) = f64::from(x).sin_cos();
            assert!((f64::from(c) - cosine).abs() < 1.2e-7 && (f64::from(s) - sine).abs() < 1.2e-7, "{x}");
        }
    }

    #[test]
    fn deviates_are_normal_to_the_tails_and_uncorrelated() {
        let (mut normals, mut block) = (Normals::new(11), [0.0; BLOCK]);
        let blocks = 8192;
        let n = (blocks * BLOCK) as f64;
        let mut moments = [0.0f64; 4];
        let mut below = [0usize; 11];
        // Products with the neighbour, with the lane's next, with the other half and with the last block.
        let (mut products, mut last) = ([0.0f64; 4], [0.0f32; BLOCK]);
        for _ in 0..blocks {
            normals.fill(&mut block);
            for i in 0..BLOCK {
                let w = f64::from(block[i]);
                (0..4).for_each(|k| moments[k] += w.powi(k as i32 + 1));
                (0..11).for_each(|k| below[k] += usize::from(w < k as f64 - 5.0));
                for (k, other) in
                    [block[(i + 1) % BLOCK], block[(i + LANES) % BLOCK], block[(i + HALF) % BLOCK], last[i]]
                        .iter()
                        .enumerate()
                {
                    products[k] += w * f64::from(*other);
                }
            }
            last = block;
        }
        // Variances of the powers' means: 1, 2, 15, 96 over n; five standard errors.
        for (k, (expected, variance)) in [(0.0, 1.0), (1.0, 2.0), (0.0, 15.0), (3.0, 96.0f64)].into_iter().enumerate() {
            let error = (moments[k] / n - expected).abs();
            assert!(error < 5.0 * (variance / n).sqrt(), "moment {}: off by {error}", k + 1);
        }
        for (k, &count) in below.iter().enumerate() {
            let p = normal_cdf(k as f64 - 5.0);
            let error = (count as f64 - n * p).abs();
            assert!(error < 5.0 * (n * p * (1.0 - p)).sqrt().max(1.0) + 1e-7 * n, "below {}: {count}", k as f64 - 5.0);
        }
        // Pairs counted twice in the third product: its variance is 2/n.
        assert!(products.iter().all(|p| (p / n).abs() < 5.0 * (2.0 / n).sqrt()), "{products:?}");
    }

    #[test]
    fn seeds_give_streams_of_their_own() {
        let fill = |seed| {
            let mut block = [0.0; BLOCK];
            Normals::new(seed).fill(&mut block);
            block
        };
        assert_eq!(fill(3), fill(3));
        assert!(fill(3).iter().zip(&fill(4)).filter(|(a, b)| a == b).count() < 3);
    }
}
