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

/// The lens: takes a picture (interleaved RGB, pixels cut into parts) in strips from above, and gives what pixels see of
/// it, 1 − glare of the light blurred with a Gaussian of the core, glare of it with one of [`HALO_PX`], averaged over the
/// parts. Light is conserved but for the borders, beyond which the outermost pixels go on.
#[derive(Debug)]
pub(crate) struct PointSpread {
    parts: usize,
    width: usize,
    glare: f32,
    core: Option<Blur>,
    halo: Option<Blur>,
    /// Rows of the core that wait for their halo.
    sharp: Vec<f32>,
}

impl PointSpread {
    /// For pictures of `size_px`.
    pub(crate) fn new(size_px: [usize; 2], core_px: f64, glare: f64) -> Self {
        let parts = parts(core_px);
        let [width, height] = size_px.map(|s| s * parts);
        Self {
            parts,
            width: size_px[0],
            glare: glare as f32,
            core: (core_px > 0.0).then(|| Blur::new([width, height], core_px * parts as f64, parts)),
            halo: (glare > 0.0).then(|| Blur::new(size_px, HALO_PX, 1)),
            sharp: Vec::new(),
        }
    }

    /// Takes the next rows, and gives those that no later row changes: all that are left after the last.
    pub(crate) fn see(&mut self, rows: Vec<f32>) -> Vec<f32> {
        let halo = self.halo.as_mut().map(|halo| halo.add(&whole(&rows, self.width, self.parts)));
        let core = match &mut self.core {
            Some(core) => core.add(&rows),
            None => rows,
        };
        let core = if self.parts == 1 { core } else { whole(&core, self.width, self.parts) };
        let Some(mut seen) = halo else { return core };
        self.sharp.extend(core);
        let keep = 1.0 - self.glare;
        seen.iter_mut().zip(&self.sharp).for_each(|(halo, sharp)| *halo = keep * sharp + self.glare * *halo);
        self.sharp.drain(..seen.len());
        seen
    }
}

/// Separable convolution of rows that come in strips: along x at once, along y when all rows are there.
#[derive(Debug)]
struct Blur {
    kernel: Vec<f32>,
    /// RGB values of a row, and rows.
    row: usize,
    height: usize,
    /// Rows are given in multiples of this.
    together: usize,
    /// Blurred along x, from row `first` on; rows up to `given` have been given.
    along_x: Vec<f32>,
    first: usize,
    given: usize,
}

impl Blur {
    fn new([width, height]: [usize; 2], sd_px: f64, together: usize) -> Self {
        Self { kernel: kernel(sd_px), row: 3 * width, height, together, along_x: Vec::new(), first: 0, given: 0 }
    }

    fn add(&mut self, rows: &[f32]) -> Vec<f32> {
        let (n, reach) = (self.row, self.kernel.len() / 2);
        let old = self.along_x.len();
        self.along_x.resize(old + rows.len(), 0.0);
        self.along_x[old..].par_chunks_mut(n).zip(rows.par_chunks(n)).for_each(|(out, row)| {
            let [first, last] = [&row[..3], &row[n - 3..]];
            let padded = [first.repeat(reach), row.to_vec(), last.repeat(reach)].concat();
            for (k, weight) in self.kernel.iter().enumerate() {
                out.iter_mut().zip(&padded[3 * k..]).for_each(|(o, p)| *o += weight * p);
            }
        });
        let there = self.first + self.along_x.len() / n;
        let done = match there == self.height {
            true => self.height,
            false => (there.saturating_sub(reach) / self.together * self.together).max(self.given),
        };
        let mut both = vec![0.0; (done - self.given) * n];
        both.par_chunks_mut(n).zip(self.given..done).for_each(|(out, y)| {
            for (k, weight) in self.kernel.iter().enumerate() {
                let from = (y + k).saturating_sub(reach).min(self.height - 1) - self.first;
                out.iter_mut().zip(&self.along_x[from * n..]).for_each(|(o, p)| *o += weight * p);
            }
        });
        self.given = done;
        let needed = done.saturating_sub(reach).min(there);
        self.along_x.drain(..(needed - self.first) * n);
        self.first = needed;
        both
    }
}

/// Means over the parts of each pixel of some rows.
fn whole(rows: &[f32], width: usize, parts: usize) -> Vec<f32> {
    let share = 1.0 / (parts * parts) as f32;
    let mut out = vec![0.0; rows.len() / (parts * parts)];
    out.par_chunks_mut(3 * width).zip(rows.par_chunks(3 * width * parts * parts)).for_each(|(out, rows)| {
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

    fn see(picture: Vec<f32>, size_px: [usize; 2], core_px: f64, glare: f64) -> Vec<f32> {
        PointSpread::new(size_px, core_px, glare).see(picture)
    }

    #[test]
    fn strips_of_any_height_give_the_picture_of_the_whole() {
        for (core_px, glare) in [(0.3, 0.0), (0.8, 0.02), (1.4, 0.01), (0.0, 0.05), (0.0, 0.0)] {
            let (size_px, parts) = ([31, 260], parts(core_px));
            let n = 3 * size_px[0] * parts;
            let picture: Vec<f32> =
                (0..n * size_px[1] * parts).map(|i| ((i as u64 * 2_654_435_761) % 997) as f32).collect();
            let at_once = see(picture.clone(), size_px, core_px, glare);
            assert_eq!(at_once.len(), 3 * size_px[0] * size_px[1]);
            let mut lens = PointSpread::new(size_px, core_px, glare);
            let (mut seen, mut from) = (Vec::new(), 0);
            for height in [1, 5, 2, 120, 3, 70, 59] {
                let rows = picture[from * parts * n..][..height * parts * n].to_vec();
                seen.extend(lens.see(rows));
                from += height;
            }
            assert!(from == size_px[1] && seen == at_once, "{core_px} {glare}");
        }
    }

    /// A point of light in the middle, as `lens` shows it: sum, first and second moment along x and y.
    fn moments(lens: impl Fn(Vec<f32>, [usize; 2]) -> Vec<f32>) -> [f64; 5] {
        let (width, height) = (241, 235);
        let mut picture = vec![0.0; 3 * width * height];
        picture[3 * (117 * width + 120) + 1] = 1000.0;
        let blurred = lens(picture, [width, height]);
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
        let check = |m: [f64; 5], expected: f64| {
            // The kernel is cut at four standard deviations, which costs 1e-3 of the second moment.
            assert!((m[0] - 1.0).abs() < 1e-5 && m[1].abs() < 1e-4 && m[2].abs() < 1e-4, "{m:?}");
            assert!((3..5).all(|a| (m[a] / expected - 1.0).abs() < 3e-3), "{m:?}, expected {expected}");
        };
        for sd_px in [0.3, 0.5, 0.7, 1.5, HALO_PX] {
            check(moments(|picture, size_px| Blur::new(size_px, sd_px, 1).add(&picture)), sd_px * sd_px);
        }
        // Where pixels are not cut.
        for (core, glare) in [(1.5, 0.0), (0.0, 0.01), (1.2, 0.02)] {
            let expected = (1.0 - glare) * core * core + glare * HALO_PX * HALO_PX;
            check(moments(|picture, size_px| see(picture, size_px, core, glare)), expected);
        }
    }

    #[test]
    fn an_even_picture_stays_even_up_to_its_borders() {
        // Pixels of a core of 0.8 px are cut into two parts.
        let blurred = see(vec![7.0; 3 * 30 * 20], [15, 10], 0.8, 0.1);
        assert!(blurred.len() == 3 * 15 * 10 && blurred.iter().all(|v| (v - 7.0).abs() < 1e-4));
        assert_eq!(see(vec![1.0, 2.0, 3.0], [1, 1], 0.0, 0.0), [1.0, 2.0, 3.0]);
    }
}
