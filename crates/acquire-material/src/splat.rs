//! Rows added to images where they leave the slab.

use crate::CHANNELS;
use crate::exitance::Exitance;
use crate::parallel::*;
use crate::quadrature::Quadrature;
use std::ops::Range;

/// Bands of lines into which an image is divided, for as many threads.
const BANDS: usize = 8;

/// Adds rows to every image: those of `rows`, each by its index and what its channels are multiplied by;
/// `lines(k, channel, seen, add)` calls `add(dx, dy, values)` for pieces of the lines of the k-th of them, from sample
/// (dx, dy) of its window on; lines that are not in `seen` need not be given.
///
/// A row is added once for every share that it has in the light of `quadrature`. Each band of an image is filled by one
/// thread, in the order of rows: the sums do not depend on the number of threads. Images lie on the quadrature's
/// canvas.
pub fn splat(
    images: &mut [Exitance],
    rows: &[(usize, [f64; CHANNELS])],
    window: [usize; 2],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; CHANNELS]>],
    lines: &(impl Fn(usize, usize, Range<usize>, &mut dyn FnMut(usize, usize, &[f64])) + Sync),
) {
    let [width, height] = quadrature.canvas().size;
    let mut bands = Vec::new();
    for (image, flux) in images.iter_mut().zip(fluxes) {
        let lines = height.div_ceil(BANDS).max(1);
        for (channel, plane) in image.planes.iter_mut().enumerate() {
            let parts = plane.chunks_mut((lines * width).max(1)).enumerate();
            bands.extend(parts.map(|(n, samples)| (Band { width, first: n * lines, samples }, flux, channel)));
        }
    }
    bands.into_par_iter().for_each(|(mut band, flux, channel)| {
        let mut parts = Vec::new();
        for (k, (index, gain)) in rows.iter().enumerate() {
            let lit = quadrature.shares(*index).iter().filter_map(|share| {
                let weight = share.weight * flux.get(share.cell as usize)?[channel] * gain[channel];
                let at = [share.at as usize % width, share.at as usize / width];
                let corner = [at[0].checked_sub(window[0] / 2)?, at[1].checked_sub(window[1] / 2)?];
                (weight != 0.0 && band.sees(corner[1], window[1])).then_some((corner, weight))
            });
            parts.clear();
            parts.extend(lit);
            let corners = parts.iter().map(|([_, y], _)| *y);
            if let (Some(least), Some(most)) = (corners.clone().min(), corners.max()) {
                let seen = band.lines();
                let seen = seen.start.saturating_sub(most)..(seen.end.saturating_sub(least)).min(window[1]);
                lines(k, channel, seen, &mut |dx, dy, values| {
                    parts.iter().for_each(|([x, y], weight)| band.add([x + dx, y + dy], values, *weight));
                });
            }
        }
    });
}

/// Consecutive lines of an image.
struct Band<'a> {
    width: usize,
    first: usize,
    samples: &'a mut [f64],
}

impl Band<'_> {
    /// Those of the image that it has.
    fn lines(&self) -> Range<usize> {
        self.first..self.first + self.samples.len() / self.width.max(1)
    }

    /// Whether any of `lines` lines from `from` on is in it.
    fn sees(&self, from: usize, lines: usize) -> bool {
        from + lines > self.first && from < self.lines().end
    }

    /// Adds a line of a row when it falls on the band.
    fn add(&mut self, [x, y]: [usize; 2], line: &[f64], weight: f64) {
        let Some(from) = y.checked_sub(self.first).map(|y| y * self.width + x) else { return };
        if let Some(out) = self.samples.get_mut(from..from + line.len()) {
            pulp::Arch::new().dispatch(AddLine { out, line, weight });
        }
    }
}

/// One line of a canvas.
struct AddLine<'a> {
    out: &'a mut [f64],
    line: &'a [f64],
    weight: f64,
}

impl pulp::NullaryFnOnce for AddLine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.out.iter_mut().zip(self.line).for_each(|(out, v)| *out += self.weight * v);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LitArea, Shape};

    /// Two lights on 4 × 1 points of which rows 2 and 3 are added, with windows of 3 × 3; some entries were not
    /// measured.
    #[test]
    fn every_share_of_a_cells_light_leaves_with_the_offsets_of_its_row() {
        let lit_mm = [[0.0, 0.1], [1.0, -0.1], [2.05, 0.05], [3.1, 0.0]];
        let shape = Shape { points: [4, 1], window: [3, 3], pitch_mm: 0.5, lit_pitch_mm: [1.0; 2], lit_mm: &lit_mm };
        let area = LitArea::of(&shape).unwrap();
        let value =
            |k: usize, s: usize| if (s + k).is_multiple_of(5) { 0.0 } else { ((7 * s + 5 * k) % 23) as f64 - 4.0 };
        for quadrature in [Quadrature::new(&area, &shape), Quadrature::of_points(&area, &shape)] {
            let canvas = quadrature.canvas();
            let flux = |light: usize, i: usize, c: usize| (1 + light) as f64 + 0.25 * i as f64 - 0.5 * c as f64;
            let of = |l: usize| (0..quadrature.cells.len()).map(|i| [0, 1, 2].map(|c| flux(l, i, c))).collect();
            let fluxes: Vec<Vec<[f64; 3]>> = (0..2).map(of).collect();
            let mut images = vec![Exitance::new(canvas), Exitance::new(canvas)];
            let gains = [[1.0, 2.0, 0.5], [3.0, 1.0, 1.0]];
            splat(&mut images, &[(2, gains[0]), (3, gains[1])], [3, 3], &quadrature, &fluxes, &|k, c, seen, add| {
                let line = |dy: usize, dx: usize, n: usize| -> Vec<f64> {
                    (dx..dx + n).map(|dx| value(k, 3 * (3 * dy + dx) + c)).collect()
                };
                // The middle line in pieces.
                for (dx, dy, n) in [(0, 0, 3), (0, 1, 1), (1, 1, 2), (0, 2, 3)] {
                    if seen.contains(&dy) {
                        add(dx, dy, &line(dy, dx, n));
                    }
                }
            });
            for (light, image) in images.iter().enumerate() {
                for c in 0..3 {
                    let mut expected = vec![0.0; image.planes[c].len()];
                    for (k, row) in [2, 3].into_iter().enumerate() {
                        for share in quadrature.shares(row) {
                            for s in 0..9 {
                                let at = share.at as usize + s % 3 + s / 3 * canvas.size[0] - 1 - canvas.size[0];
                                expected[at] += share.weight
                                    * flux(light, share.cell as usize, c)
                                    * gains[k][c]
                                    * value(k, 3 * s + c);
                            }
                        }
                    }
                    let pairs = image.planes[c].iter().zip(&expected);
                    assert!(pairs.clone().all(|(a, b)| (a - b).abs() < 1e-12), "rounding, light {light} channel {c}");
                    assert!(expected.iter().any(|v| *v != 0.0));
                }
            }
        }
    }
}
