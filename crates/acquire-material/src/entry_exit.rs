//! Entry and exit maps: how much more or less light enters at a point of the slab, and leaves at one, than the terms
//! say.
//!
//! R̂_c(x_i, x_o) = a_c(x_i) e_c(x_o) M_c(x_i, x_o − x_i). Between the samples of its grid e is bilinear, beyond them
//! it is that of the nearest. In the fit both are chosen so that every row has its albedo and the slab under even light
//! its exitance; see docs/materials.md.

use crate::{CHANNELS, Material, Point};
use serde::{Deserialize, Serialize};

/// The grid of an exit map: samples a pitch apart, as those of a [`crate::Canvas`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ExitGrid {
    /// Centre of sample (0, 0), mm.
    pub origin_mm: Point,
    /// Columns and rows.
    pub size: [usize; 2],
    /// C: 1 when the channels share both maps, else 3.
    pub planes: usize,
}

/// The two samples around a place along one axis, and how far it is from the first.
#[derive(Debug, Clone, Copy)]
struct Between {
    first: usize,
    next: usize,
    beyond: f64,
}

impl Between {
    fn at(place: f64, samples: usize) -> Self {
        let held = place.clamp(0.0, samples.max(1) as f64 - 1.0);
        let near = held.round();
        // Rounding of millimetres is not a step aside.
        let held = if (held - near).abs() < 1e-6 { near } else { held };
        let first = held as usize;
        Self { first, next: (first + 1).min(samples.max(1) - 1), beyond: held - first as f64 }
    }
}

/// Samples of an exit map above and below some places, one more than there are, and how far all of them are beyond.
struct ExitLine<'a> {
    above: &'a [f32],
    below: &'a [f32],
    beyond: [f64; 2],
}

struct MultiplyLine<'a> {
    line: &'a mut [f64],
    exit: ExitLine<'a>,
}

impl pulp::NullaryFnOnce for MultiplyLine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { line, exit: ExitLine { above, below, beyond: [x, y] } } = self;
        let n = line.len();
        let (above_next, below_next) = (&above[1..=n], &below[1..=n]);
        for k in 0..n {
            let left = f64::from(above[k]) + y * (f64::from(below[k]) - f64::from(above[k]));
            let right = f64::from(above_next[k]) + y * (f64::from(below_next[k]) - f64::from(above_next[k]));
            line[k] *= left + x * (right - left);
        }
    }
}

/// What a row is multiplied by on a line of its window.
struct MapsLine<'a> {
    line: &'a mut [f32],
    entry: f32,
    exit: ExitLine<'a>,
}

impl pulp::NullaryFnOnce for MapsLine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { line, entry, exit: ExitLine { above, below, beyond } } = self;
        let (n, [x, y]) = (line.len(), beyond.map(|b| b as f32));
        let (above_next, below_next) = (&above[1..=n], &below[1..=n]);
        for k in 0..n {
            let left = above[k] + y * (below[k] - above[k]);
            let right = above_next[k] + y * (below_next[k] - above_next[k]);
            line[k] = entry * (left + x * (right - left));
        }
    }
}

impl Material {
    /// a_c(x_i) of a row, channel by channel; 1 without maps or for a row that is not there.
    #[inline]
    pub fn entry(&self, index: usize) -> [f64; CHANNELS] {
        let Some(grid) = self.header.exit_grid else { return [1.0; CHANNELS] };
        let rows = self.header.rows();
        std::array::from_fn(|c| {
            let at = c.min(grid.planes - 1) * rows + index;
            self.entry_map.get(at).filter(|_| index < rows).map_or(1.0, |&a| f64::from(a))
        })
    }

    /// a_c(x_i) e_c(x_o) of a channel over the window of a row, in f32 (to 3e-7 of it), \[dy\]\[dx\]; 1 without maps.
    pub fn row_maps(&self, channel: usize, index: usize, out: &mut [f32]) {
        let width = self.header.window[0].max(1);
        let Some(&lit) = self.lit_mm.get(index).filter(|_| self.header.exit_grid.is_some()) else {
            return out.fill(1.0);
        };
        let entry = self.entry(index)[channel.min(CHANNELS - 1)] as f32;
        for (dy, line) in out.chunks_exact_mut(width).enumerate() {
            let first = self.line_from(lit, dy);
            match self.inside(channel, first, line.len()) {
                Some(exit) => pulp::Arch::new().dispatch(MapsLine { line, entry, exit }),
                None => self.exit_line(channel, first, line.len(), |x, e| line[x] = entry * e as f32),
            }
        }
    }

    /// Where line `dy` of the window of a point begins, mm.
    fn line_from(&self, lit_mm: Point, dy: usize) -> Point {
        let (window, pitch_mm) = (self.header.window, self.header.pitch_mm);
        let steps = [-((window[0] / 2) as f64), dy as f64 - (window[1] / 2) as f64];
        [0, 1].map(|a| lit_mm[a] + steps[a] * pitch_mm)
    }

    /// Multiplies a row, \[channel\]\[dy\]\[dx\], by what enters and, if wanted, by what leaves.
    pub(crate) fn multiply(&self, index: usize, row: &mut [f64], exit: bool) {
        let window = self.header.window;
        let Some(&lit) = self.lit_mm.get(index).filter(|_| self.header.exit_grid.is_some()) else { return };
        let entry = self.entry(index);
        for (c, channel) in row.chunks_exact_mut((window[0] * window[1]).max(1)).enumerate() {
            channel.iter_mut().for_each(|v| *v *= entry[c]);
            for (dy, line) in channel.chunks_exact_mut(window[0]).enumerate().filter(|_| exit) {
                self.multiply_line(c, self.line_from(lit, dy), line);
            }
        }
    }

    /// Multiplies values at places a pitch apart along x from `first_mm` on by e_c.
    pub(crate) fn multiply_line(&self, channel: usize, first_mm: Point, line: &mut [f64]) {
        match self.inside(channel, first_mm, line.len()) {
            Some(exit) => pulp::Arch::new().dispatch(MultiplyLine { line, exit }),
            None => self.exit_line(channel, first_mm, line.len(), |x, e| line[x] *= e),
        }
    }

    /// What e_c is between at `count` places a pitch apart along x from `first_mm` on; `None` where one of them lies
    /// beyond the map's samples.
    fn inside(&self, channel: usize, first_mm: Point, count: usize) -> Option<ExitLine<'_>> {
        let ExitGrid { origin_mm, size, planes } = self.header.exit_grid?;
        let place = [0, 1].map(|a| (first_mm[a] - origin_mm[a]) / self.header.pitch_mm);
        if !(place[0] > -1e-6 && place[0] + (count as f64) < size[0] as f64 - 1.0) {
            return None;
        }
        let [x, y] = [0, 1].map(|a| Between::at(place[a], size[a]));
        let plane = &self.exit_map[channel.min(planes - 1) * size[0] * size[1]..];
        let [above, below] =
            [y.first, y.next].map(|line| plane[line * size[0]..][..size[0]].get(x.first..=x.first + count));
        Some(ExitLine { above: above?, below: below?, beyond: [x.beyond, y.beyond] })
    }

    /// e_c at a point of the slab, mm; 1 without maps.
    pub fn exit(&self, at_mm: Point) -> [f64; CHANNELS] {
        let mut out = [1.0; CHANNELS];
        for (c, out) in out.iter_mut().enumerate() {
            self.exit_line(c, at_mm, 1, |_, e| *out = e);
        }
        out
    }

    /// e_c at `count` places a pitch apart along x from `first_mm` on; nothing is called without maps.
    #[inline]
    fn exit_line(&self, channel: usize, first_mm: Point, count: usize, mut each: impl FnMut(usize, f64)) {
        let Some(ExitGrid { origin_mm, size, planes }) = self.header.exit_grid else { return };
        let place = [0, 1].map(|a| (first_mm[a] - origin_mm[a]) / self.header.pitch_mm);
        let y = Between::at(place[1], size[1]);
        let plane = &self.exit_map[channel.min(planes - 1) * size[0] * size[1]..];
        let [above, below] = [y.first, y.next].map(|line| &plane[line * size[0]..][..size[0]]);
        let down = |x: usize| f64::from(above[x]) + y.beyond * (f64::from(below[x]) - f64::from(above[x]));
        for k in 0..count {
            let x = Between::at(place[0] + k as f64, size[0]);
            let left = down(x.first);
            let e = if x.beyond == 0.0 { left } else { left + x.beyond * (down(x.next) - left) };
            each(k, e);
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::naive;

    #[test]
    fn the_exit_map_is_bilinear_between_its_samples_and_held_beyond_them() {
        let m = naive::materials().into_iter().find(|m| m.header.exit_grid.is_some_and(|g| g.planes == 3)).unwrap();
        let g = m.header.exit_grid.unwrap();
        for k in 0..300 {
            let at = [0, 1].map(|a| {
                let share = ((k as f64 + 1.0) * [0.618, 0.414][a]).fract() * 1.4 - 0.2;
                g.origin_mm[a] + share * (g.size[a] as f64 - 1.0) * naive::PITCH_MM
            });
            let found = m.exit(at);
            for c in 0..3 {
                let e = naive::exit(&m, c, at);
                assert!((found[c] - e).abs() < 1e-12, "rounding, channel {c} at {at:?}: {} {e}", found[c]);
            }
        }
        let plain = naive::materials().remove(0);
        let mut maps = vec![0.0; 3 * 35];
        for index in 0..naive::ROWS {
            (0..3).for_each(|c| m.row_maps(c, index, &mut maps[35 * c..][..35]));
            for (k, found) in maps.iter().enumerate() {
                let (c, d) = (k / 35, [(k % 7) as f64 - 3.0, (k % 35 / 7) as f64 - 2.0]);
                let at = [0, 1].map(|a| m.lit_mm[index][a] + d[a] * naive::PITCH_MM);
                let product = m.entry(index)[c] * naive::exit(&m, c, at);
                assert!((f64::from(*found) - product).abs() < 4e-7 * product.abs().max(1.0), "f32: {found} {product}");
            }
        }
        plain.row_maps(0, 1, &mut maps);
        assert_eq!(maps, [1.0; 105]);
        assert_eq!((plain.exit([0.3, 0.4]), plain.entry(2)), ([1.0; 3], [1.0; 3]));
    }
}
