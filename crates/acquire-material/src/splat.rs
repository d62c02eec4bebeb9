//! Rows added to images where they leave the slab.

use crate::exitance::{Canvas, Exitance, Shape};
use crate::parallel::*;

/// Bands of lines into which an image is divided, for as many threads.
const BANDS: usize = 8;

/// Adds the rows `indices` to every image; `line(k, channel, dy, out)` writes line `dy` of the k-th of them.
///
/// Each sample is spread over the four nearest samples of the canvas by bilinear weights, which sum to one: the flux that leaves is
/// conserved. Each band of an image is filled by one thread, in the order of rows: the sums do not depend on the number of threads.
pub fn splat(
    images: &mut [Exitance],
    indices: &[usize],
    shape: &Shape<'_>,
    fluxes: &[Vec<[f64; 3]>],
    line: &(impl Fn(usize, usize, usize, &mut [f64]) + Sync),
) {
    let mut bands = Vec::new();
    for (image, flux) in images.iter_mut().zip(fluxes) {
        let canvas = image.canvas;
        let lines = canvas.size[1].div_ceil(BANDS).max(1);
        for (channel, plane) in image.planes.iter_mut().enumerate() {
            let parts = plane.chunks_mut((lines * canvas.size[0]).max(1)).enumerate();
            bands.extend(parts.map(|(n, samples)| (Band { canvas, first: n * lines, samples }, flux, channel)));
        }
    }
    bands.into_par_iter().for_each(|(mut band, flux, channel)| {
        let [mut above, mut here] = [0, 1].map(|_| vec![0.0; shape.window[0] + 2]);
        for (k, &index) in indices.iter().enumerate() {
            let (Some(point), Some(flux)) = (shape.lit_mm.get(index), flux.get(index)) else { continue };
            if flux[channel] != 0.0 {
                let corner = band.canvas.corner(*point, shape.window);
                let add = |dy: usize, out: &mut [f64]| line(k, channel, dy, out);
                band.add(corner, flux[channel], shape.window, [&mut above, &mut here], add);
            }
        }
    });
}

/// Where a window's first sample falls: a sample of the canvas, and how far beyond it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corner {
    pub(crate) at: [usize; 2],
    pub(crate) beyond: [f64; 2],
}

impl Canvas {
    /// Of the window around a lit point.
    pub(crate) fn corner(&self, point: [f64; 2], window: [usize; 2]) -> Corner {
        let corner: [f64; 2] =
            std::array::from_fn(|a| ((point[a] - self.origin_mm[a]) / self.pitch_mm - (window[a] / 2) as f64).max(0.0));
        let base = corner.map(f64::floor);
        Corner { at: base.map(|b| b as usize), beyond: [corner[0] - base[0], corner[1] - base[1]] }
    }
}

/// Consecutive lines of an image.
struct Band<'a> {
    canvas: Canvas,
    first: usize,
    samples: &'a mut [f64],
}

impl Band<'_> {
    /// Adds what of a row falls on the band. The buffers hold a line of the row each, a zero before and after it.
    fn add(
        &mut self,
        corner: Corner,
        flux: f64,
        window: [usize; 2],
        [above, here]: [&mut Vec<f64>; 2],
        line: impl Fn(usize, &mut [f64]),
    ) {
        let (width, [x, y]) = (self.canvas.size[0], corner.at);
        let [fx, fy] = corner.beyond;
        let height = window[1] + usize::from(fy > 0.0);
        let end = (y + height).min(self.first + self.samples.len() / width.max(1));
        let start = y.max(self.first);
        if start >= end {
            return;
        }
        let weights =
            [[(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy)], [(1.0 - fx) * fy, fx * fy]].map(|w| w.map(|w| w * flux));
        let read = |dy: Option<usize>, into: &mut Vec<f64>| match dy.filter(|&dy| dy < window[1]) {
            Some(dy) => line(dy, &mut into[1..=window[0]]),
            None => into.fill(0.0),
        };
        read((start - y).checked_sub(1).filter(|_| fy > 0.0), above);
        for at in start..end {
            read(Some(at - y), here);
            let from = (at - self.first) * width + x;
            // A column more when the samples lie between those of the canvas.
            let count = window[0] + usize::from(fx > 0.0);
            if let Some(out) = self.samples.get_mut(from..from + count) {
                pulp::Arch::new().dispatch(AddLine { out, here, above, weights });
            }
            std::mem::swap(above, here);
        }
    }
}

/// One line of a canvas: two lines of a row, each as it is and a sample later.
struct AddLine<'a> {
    out: &'a mut [f64],
    here: &'a [f64],
    above: &'a [f64],
    weights: [[f64; 2]; 2],
}

impl pulp::NullaryFnOnce for AddLine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let n = self.out.len();
        let [[w00, w01], [w10, w11]] = self.weights;
        let (here, here_later) = (&self.here[1..=n], &self.here[..n]);
        if w10 == 0.0 && w11 == 0.0 && w01 == 0.0 {
            for x in 0..n {
                self.out[x] += w00 * here[x];
            }
            return;
        }
        let (above, above_later) = (&self.above[1..=n], &self.above[..n]);
        for x in 0..n {
            self.out[x] += w00 * here[x] + w01 * here_later[x] + (w10 * above[x] + w11 * above_later[x]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::naive::tent;

    /// Two images of 9 × 6 samples, rows 2 and 3 of four with windows of 3 × 2, on the canvas and between its samples.
    #[test]
    fn measured_entries_are_spread_over_the_four_nearest_samples_and_others_are_not() {
        let canvas = Canvas { origin_mm: [10.0, -4.0], size: [9, 6], pitch_mm: 0.5 };
        // Windows of 3 × 3 around them; the third lies on samples of the canvas, the last between them.
        let lit_mm = [[0.0; 2], [0.0; 2], [11.0, -2.5], [12.625, -2.875]];
        let shape = Shape { points: [4, 1], window: [3, 3], pitch_mm: 0.5, lit_pitch_mm: [1.0; 2], lit_mm: &lit_mm };
        let value = |k: usize, s: usize| ((7 * s + 5 * k) % 23) as f32 - 4.0;
        let valid = |k: usize, s: usize| u8::from(!(s + k).is_multiple_of(5));
        let flux = |light: usize, i: usize, c: usize| (1 + light) as f64 + 0.25 * i as f64 - 0.5 * c as f64;
        let fluxes: Vec<Vec<[f64; 3]>> =
            (0..2).map(|l| (0..4).map(|i| [0, 1, 2].map(|c| flux(l, i, c))).collect()).collect();
        let mut images = vec![Exitance::new(canvas), Exitance::new(canvas)];
        splat(&mut images, &[2, 3], &shape, &fluxes, &|k, c, dy, line| {
            for (dx, to) in line.iter_mut().enumerate() {
                let s = 3 * (3 * dy + dx) + c;
                *to = if valid(k, s) == 0 { 0.0 } else { f64::from(value(k, s)) };
            }
        });
        for (light, image) in images.iter().enumerate() {
            for c in 0..3 {
                for (at, found) in image.planes[c].iter().enumerate() {
                    let mut e = 0.0;
                    for k in 0..2 {
                        for s in (0..9).filter(|s| valid(k, 3 * s + c) != 0) {
                            let offset = [(s % 3) as f64 - 1.0, (s / 3) as f64 - 1.0];
                            let place = |a: usize| (lit_mm[2 + k][a] - canvas.origin_mm[a]) / 0.5 + offset[a];
                            let near = tent(place(0), (at % 9) as f64) * tent(place(1), (at / 9) as f64);
                            e += flux(light, 2 + k, c) * near * f64::from(value(k, 3 * s + c));
                        }
                    }
                    assert!((found - e).abs() < 1e-12, "f64, light {light} channel {c} sample {at}: {found} {e}");
                }
            }
        }
    }

    #[test]
    fn the_corner_of_a_window_is_half_of_it_before_its_point() {
        let canvas = Canvas { origin_mm: [1.0, 2.0], size: [9, 9], pitch_mm: 0.25 };
        let corner = canvas.corner([2.5625, 3.25], [5, 3]);
        // 6.25 and 5 samples from the origin, less 2 and 1.
        assert_eq!((corner.at, corner.beyond), ([4, 4], [0.25, 0.0]));
        let before = canvas.corner([1.0, 2.0], [5, 3]);
        assert_eq!((before.at, before.beyond), ([0, 0], [0.0, 0.0]), "a point nearer to the rim is held");
    }
}
