//! The lens's point-spread function: a Gaussian core and a faint, wide halo (veiling glare).

use rayon::prelude::*;

/// Standard deviation of the halo, px.
pub(crate) const HALO_PX: f64 = 20.0;
/// Kernels end at this many standard deviations.
const REACH: f64 = 4.0;

/// Into how many parts along each axis a pixel is cut, so that weights at whole parts stand for a Gaussian of
/// `core_px`.
pub(crate) fn parts(core_px: f64) -> usize {
    match core_px {
        0.0 => 1,
        sharp if sharp < 0.4 => 3,
        middling if middling < 1.0 => 2,
        _ => 1,
    }
}

/// What pixels see of an interleaved RGB picture whose pixels are cut into `parts` along each axis: 1 − `glare` of the
/// light blurred with a Gaussian of standard deviation `core_px`, `glare` of it with one of [`HALO_PX`], averaged over
/// the parts. Light is conserved but for the borders, beyond which the outermost pixels go on.
pub(crate) fn see(picture: Vec<f32>, size_px: [usize; 2], parts: usize, core_px: f64, glare: f64) -> Vec<f32> {
    let cut = size_px.map(|s| s * parts);
    let halo = (glare > 0.0).then(|| gaussian(&whole(picture.clone(), size_px, parts), size_px, HALO_PX));
    let blurred = if core_px > 0.0 { gaussian(&picture, cut, core_px * parts as f64) } else { picture };
    let mut blurred = whole(blurred, size_px, parts);
    if let Some(halo) = halo {
        let (keep, add) = ((1.0 - glare) as f32, glare as f32);
        blurred.iter_mut().zip(halo).for_each(|(b, h)| *b = keep * *b + add * h);
    }
    blurred
}

/// Means over the parts of each pixel.
fn whole(picture: Vec<f32>, [width, height]: [usize; 2], parts: usize) -> Vec<f32> {
    if parts == 1 {
        return picture;
    }
    let share = 1.0 / (parts * parts) as f32;
    let mut out = vec![0.0; 3 * width * height];
    out.par_chunks_mut(3 * width).zip(picture.par_chunks(3 * width * parts * parts)).for_each(|(out, rows)| {
        for row in rows.chunks(3 * width * parts) {
            for (x, to) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                for part in row[3 * x * parts..][..3 * parts].as_chunks::<3>().0 {
                    to.iter_mut().zip(part).for_each(|(to, part)| *to += share * part);
                }
            }
        }
    });
    out
}

/// Separable convolution: along x, then along y.
fn gaussian(picture: &[f32], [width, height]: [usize; 2], sd_px: f64) -> Vec<f32> {
    let kernel = kernel(sd_px);
    let reach = kernel.len() / 2;
    let n = 3 * width;
    let mut along_x = vec![0.0; picture.len()];
    along_x.par_chunks_mut(n).zip(picture.par_chunks(n)).for_each(|(out, row)| {
        let [first, last] = [&row[..3], &row[n - 3..]];
        let padded = [first.repeat(reach), row.to_vec(), last.repeat(reach)].concat();
        for (k, weight) in kernel.iter().enumerate() {
            out.iter_mut().zip(&padded[3 * k..]).for_each(|(o, p)| *o += weight * p);
        }
    });
    let mut both = vec![0.0; picture.len()];
    both.par_chunks_mut(n).enumerate().for_each(|(y, out)| {
        for (k, weight) in kernel.iter().enumerate() {
            let from = (y + k).saturating_sub(reach).min(height - 1);
            out.iter_mut().zip(&along_x[from * n..]).for_each(|(o, p)| *o += weight * p);
        }
    });
    both
}

/// Weights at whole pixels that sum to one and whose second moment is `sd_px`² (to 1e-3 or better).
///
/// Samples of a Gaussian have the right variance from about 0.6 px on; below, three weights that have it exactly.
fn kernel(sd_px: f64) -> Vec<f32> {
    if sd_px < 0.6 {
        let side = 0.5 * sd_px * sd_px;
        return [side, 1.0 - 2.0 * side, side].map(|v| v as f32).to_vec();
    }
    let reach = (REACH * sd_px).ceil() as i64;
    let weights: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / sd_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A point of light in the middle, blurred: sum, first and second moment along x and y.
    fn moments(core_px: f64, glare: f64) -> [f64; 5] {
        let (width, height) = (241, 235);
        let mut picture = vec![0.0; 3 * width * height];
        picture[3 * (117 * width + 120) + 1] = 1000.0;
        let blurred = see(picture, [width, height], 1, core_px, glare);
        let mut m = [0.0; 5];
        for (i, v) in blurred.iter().enumerate() {
            assert!(*v == 0.0 || i % 3 == 1, "channels stay apart");
            let d = [(i / 3 % width) as f64 - 120.0, (i / 3 / width) as f64 - 117.0];
            let v = f64::from(*v) / 1000.0;
            [1.0, d[0], d[1], d[0] * d[0], d[1] * d[1]].iter().zip(&mut m).for_each(|(f, m)| *m += f * v);
        }
        m
    }

    #[test]
    fn light_is_conserved_and_the_second_moment_is_the_one_asked_for() {
        for (core, glare) in [(0.3, 0.0), (0.5, 0.0), (0.7, 0.0), (1.5, 0.0), (0.0, 0.01), (0.5, 0.02)] {
            let m = moments(core, glare);
            let expected = (1.0 - glare) * core * core + glare * HALO_PX * HALO_PX;
            // The kernel is cut at four standard deviations, which costs 1e-3 of the second moment.
            assert!((m[0] - 1.0).abs() < 1e-5 && m[1].abs() < 1e-4 && m[2].abs() < 1e-4, "{core} {glare}: {m:?}");
            for a in 3..5 {
                assert!((m[a] / expected - 1.0).abs() < 3e-3, "{core} {glare}: {} of {expected}", m[a]);
            }
        }
    }

    #[test]
    fn an_even_picture_stays_even_up_to_its_borders() {
        let blurred = see(vec![7.0; 3 * 30 * 20], [15, 10], 2, 1.0, 0.1);
        assert!(blurred.iter().all(|v| (v - 7.0).abs() < 1e-4));
        assert_eq!(see(vec![1.0, 2.0, 3.0], [1, 1], 1, 0.0, 0.0), [1.0, 2.0, 3.0]);
    }
}
