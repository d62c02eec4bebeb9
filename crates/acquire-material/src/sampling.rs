//! Drawing offsets for a row's response: a tree of sums over the common window, as factored as the material.
//!
//! The sum of a row over a square of samples is Σ_j g_j f_j(i) H_j(square), H_j the sum of h_j over it: one tree serves
//! all rows. From the whole window on, one of the four quarters is chosen with a probability proportional to its sum (0
//! when negative), down to a sample. The probability of a sample is the product of those choices, whatever the sums
//! were: it is known exactly where rows are cut by their shifts and where negative samples cancel, only less close to
//! the response.

use crate::{Layout, Material, offset_plane};

/// Terms that are multiplied together.
pub(crate) const LANES: usize = 4;

/// Share of the draws that are uniform over the window.
const UNIFORM: f64 = 0.01;

/// An offset that was drawn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampled {
    /// Samples along x and y from the lit point.
    pub offset: [isize; 2],
    /// With which it is drawn.
    pub probability: f64,
}

/// Sums of the offset factors over squares of 1, 2, 4, … samples.
#[derive(Debug, Clone)]
pub(super) struct Tree {
    /// From the samples up; the last one has a single square of four quarters.
    levels: Vec<Level>,
    /// g_j and the scale of its sums, \[A, T\], T rounded up to lanes.
    weights: Vec<f64>,
}

#[derive(Debug, Clone)]
struct Level {
    /// Squares of the level above, along x.
    width: usize,
    /// Sums over their quarters, \[squares above, 4, A, T\], in units of their scale.
    sums: Vec<f32>,
}

/// Samples that a row has, on the common window: from `low` to before `high`.
#[derive(Debug, Clone, Copy)]
struct Part {
    low: [isize; 2],
    high: [isize; 2],
}

impl Part {
    fn of(layout: Layout, shift: [i16; 2]) -> Self {
        let first =
            |a: usize| (layout.extended[a] / 2) as isize - (layout.window[a] / 2) as isize - isize::from(shift[a]);
        let end = |a: usize| (first(a) + layout.window[a] as isize).min(layout.extended[a] as isize);
        Self { low: [first(0).max(0), first(1).max(0)], high: [end(0), end(1)] }
    }

    /// Samples in common with a square.
    fn overlap(&self, square: [usize; 2], side: usize) -> usize {
        let along = |a: usize| {
            let first = (square[a] * side) as isize;
            ((first + side as isize).min(self.high[a]) - first.max(self.low[a])).max(0) as usize
        };
        along(0) * along(1)
    }

    fn size(&self) -> [usize; 2] {
        [0, 1].map(|a| (self.high[a] - self.low[a]).max(0) as usize)
    }
}

impl Tree {
    pub(super) fn new(material: &Material) -> Self {
        let (h, layout) = (&material.header, material.header.layout());
        let (terms, a) = (h.terms.next_multiple_of(LANES), h.incident_planes);
        let width = a * terms;
        // Planes that share their incident factors are summed: what is drawn for is the sum over planes.
        let mut maps = vec![0.0; layout.len() * width];
        let all = material.offset_factors.all();
        for plane in 0..h.planes() {
            let profile = material.profile_plane(plane);
            for (j, map) in offset_plane(&all, h, plane).chunks_exact(layout.len()).enumerate() {
                for (e, &v) in map.iter().enumerate() {
                    let m = profile.map_or(1.0, |p| f64::from(p[e]));
                    maps[e * width + plane.min(a - 1) * terms + j] += f64::from(v) * m;
                }
            }
        }
        let mut levels = Vec::new();
        let mut size = layout.extended;
        let mut scales = vec![0.0_f64; width];
        let mut sums = Vec::new();
        while levels.is_empty() || size != [1, 1] {
            let above = size.map(|s| s.div_ceil(2));
            let mut quarters = vec![0.0; above[0] * above[1] * 4 * width];
            let mut summed = vec![0.0; above[0] * above[1] * width];
            for (at, record) in maps.chunks_exact(width).enumerate() {
                let (x, y) = (at % size[0], at / size[0]);
                let parent = x / 2 + y / 2 * above[0];
                quarters[(parent * 4 + x % 2 + 2 * (y % 2)) * width..][..width].copy_from_slice(record);
                let total = &mut summed[parent * width..][..width];
                for ((total, &v), scale) in total.iter_mut().zip(record).zip(&mut scales) {
                    *total += v;
                    *scale = scale.max(v.abs());
                }
            }
            sums.push(quarters);
            levels.push(above[0]);
            (size, maps) = (above, summed);
        }
        let in_units = |sums: Vec<f64>| -> Vec<f32> {
            let scale = |k: usize| scales[k % width].max(f64::MIN_POSITIVE);
            sums.into_iter().enumerate().map(|(k, v)| (v / scale(k)) as f32).collect()
        };
        let levels = levels.into_iter().zip(sums);
        let levels = levels.map(|(width, sums)| Level { width, sums: in_units(sums) }).collect();
        let weight = |k: usize| material.weights.get(k % terms).map_or(0.0, |&g| f64::from(g) * scales[k]);
        Self { levels, weights: (0..width).map(weight).collect() }
    }

    /// The probabilities of the quarters of a square at level `level` + 1. The factors are those of a row, \[A, T\].
    #[inline(always)]
    fn quarters(&self, level: usize, square: [usize; 2], part: &Part, factors: &[f32]) -> [f64; 4] {
        let Level { width, sums } = &self.levels[level];
        let records = &sums[(square[0] + square[1] * width) * 4 * factors.len()..];
        let child = |q: usize| [2 * square[0] + q % 2, 2 * square[1] + q / 2];
        let counts = [0, 1, 2, 3].map(|q| part.overlap(child(q), 1 << level));
        let mut share = products(&self.weights, factors, records);
        for q in 0..4 {
            share[q] = if counts[q] == 0 { 0.0 } else { share[q].max(0.0) };
        }
        let total: f64 = share.iter().sum();
        if total > 0.0 && total.is_finite() {
            return share.map(|s| s / total);
        }
        let all = counts.iter().sum::<usize>().max(1) as f64;
        counts.map(|c| c as f64 / all)
    }

    /// Draws an offset for a row with these factors.
    pub(super) fn sample(&self, factors: &[f32], layout: Layout, shift: [i16; 2], random: f64) -> Option<Sampled> {
        pulp::Arch::new().dispatch(Draw { tree: self, factors, layout, shift, random })
    }

    #[inline(always)]
    fn draw(&self, factors: &[f32], layout: Layout, shift: [i16; 2], random: f64) -> Option<Sampled> {
        let part = Part::of(layout, shift);
        let [width, height] = part.size();
        if width * height == 0 {
            return None;
        }
        let random = random.clamp(0.0, 1.0);
        let (at, chosen) = if random < UNIFORM {
            let k = ((random / UNIFORM * (width * height) as f64) as usize).min(width * height - 1);
            let at = [part.low[0] as usize + k % width, part.low[1] as usize + k / width];
            (at, self.chosen(factors, &part, at))
        } else {
            let mut left = (random - UNIFORM) / (1.0 - UNIFORM);
            let (mut square, mut chosen) = ([0; 2], 1.0);
            for level in (0..self.levels.len()).rev() {
                let shares = self.quarters(level, square, &part, factors);
                let mut picked = 0;
                let mut before = 0.0;
                let mut sum = 0.0;
                for q in (0..4).filter(|&q| shares[q] > 0.0) {
                    (picked, before) = (q, sum);
                    sum += shares[q];
                    if left < sum {
                        break;
                    }
                }
                left = ((left - before) / shares[picked]).clamp(0.0, 1.0);
                chosen *= shares[picked];
                square = [2 * square[0] + picked % 2, 2 * square[1] + picked / 2];
            }
            (square, chosen)
        };
        let offset = [0, 1].map(|a| at[a] as isize - (layout.extended[a] / 2) as isize + isize::from(shift[a]));
        Some(Sampled { offset, probability: mixed(chosen, width * height) })
    }

    /// With which probability [`Self::sample`] draws an offset.
    pub(super) fn probability(&self, factors: &[f32], layout: Layout, shift: [i16; 2], offset: [isize; 2]) -> f64 {
        let part = Part::of(layout, shift);
        let place = |a: usize| {
            let e = offset[a].checked_add((layout.extended[a] / 2) as isize)?.checked_sub(isize::from(shift[a]))?;
            (part.low[a]..part.high[a]).contains(&e).then_some(e as usize)
        };
        let (Some(x), Some(y)) = (place(0), place(1)) else { return 0.0 };
        let [width, height] = part.size();
        let chosen = pulp::Arch::new().dispatch(Walk { tree: self, factors, part: &part, at: [x, y] });
        mixed(chosen, width * height)
    }

    /// The probability of the choices that lead to a sample of the common window.
    #[inline(always)]
    fn chosen(&self, factors: &[f32], part: &Part, at: [usize; 2]) -> f64 {
        let mut chosen = 1.0;
        for level in (0..self.levels.len()).rev() {
            let square = at.map(|a| a >> (level + 1));
            let quarter = at.map(|a| a >> level & 1);
            chosen *= self.quarters(level, square, part, factors)[quarter[0] + 2 * quarter[1]];
        }
        chosen
    }
}

/// Σ_j g_j f_j H_j of four quarters. Plain loops: what goes through a closure is not compiled for the vector
/// instructions at hand.
#[inline(always)]
fn products(g: &[f64], f: &[f32], sums: &[f32]) -> [f64; 4] {
    let (g, f) = (g.as_chunks::<LANES>().0, f.as_chunks::<LANES>().0);
    let sums = sums.as_chunks::<LANES>().0;
    let n = g.len().min(f.len()).min(sums.len() / 4);
    let quarters = [&sums[..n], &sums[n..2 * n], &sums[2 * n..3 * n], &sums[3 * n..4 * n]];
    let mut out = [[0.0; LANES]; 4];
    for k in 0..n {
        for lane in 0..LANES {
            let gf = g[k][lane] * f64::from(f[k][lane]);
            for q in 0..4 {
                out[q][lane] += gf * f64::from(quarters[q][k][lane]);
            }
        }
    }
    out.map(|s| (s[0] + s[1]) + (s[2] + s[3]))
}

/// With the share that is uniform over `samples`.
fn mixed(chosen: f64, samples: usize) -> f64 {
    UNIFORM / samples as f64 + (1.0 - UNIFORM) * chosen
}

/// [`Tree::sample`] with the vector instructions at hand.
struct Draw<'a> {
    tree: &'a Tree,
    factors: &'a [f32],
    layout: Layout,
    shift: [i16; 2],
    random: f64,
}

impl pulp::NullaryFnOnce for Draw<'_> {
    type Output = Option<Sampled>;

    #[inline(always)]
    fn call(self) -> Option<Sampled> {
        self.tree.draw(self.factors, self.layout, self.shift, self.random)
    }
}

/// [`Tree::chosen`] with them: the same numbers, so that a probability is that of the draw to the last bit.
struct Walk<'a> {
    tree: &'a Tree,
    factors: &'a [f32],
    part: &'a Part,
    at: [usize; 2],
}

impl pulp::NullaryFnOnce for Walk<'_> {
    type Output = f64;

    #[inline(always)]
    fn call(self) -> f64 {
        self.tree.chosen(self.factors, self.part, self.at)
    }
}

#[cfg(test)]
mod tests;
