//! Point queries for a renderer: R̂_d at one pair of points, without allocation.

use crate::color::{Colors, Interval, colors};
use crate::lattice::{Corners, Lattice};
use crate::sampling::{LANES, Sampled, Tree};
use crate::{CHANNELS, Layout, Material, Point, Result, offset_plane};

/// A material rearranged so that a query touches a few contiguous pieces of memory.
///
/// Holds its factors once more, as f32 (padded to four terms), and the sums that sampling needs: about as much again
/// for the offset factors. Queries do not allocate and can be made from any number of threads.
#[derive(Debug, Clone)]
pub struct Evaluator {
    layout: Layout,
    points: [usize; 2],
    pitch_mm: f64,
    shift: Vec<[i16; 2]>,
    /// T, rounded up to lanes.
    terms: usize,
    /// A and B.
    planes: [usize; 2],
    /// g_j, \[T\].
    weights: Vec<f64>,
    /// f_{k,j}(x_i), \[N, A, T\].
    incident: Vec<f32>,
    /// h_{k,j}(e), \[samples, B, T\].
    offset: Vec<f32>,
    /// m_k(e), \[samples, B\]; empty without a profile.
    profile: Vec<f32>,
    /// Coefficients of powers of the basis's argument, \[N, P+1, 3\]; empty without a polynomial.
    color: Vec<[f64; CHANNELS]>,
    powers: usize,
    interval: Interval,
    /// Only the maps and positions of a material that has maps: its factors are held above.
    through: Option<Box<Material>>,
    lattice: Lattice,
    tree: Tree,
}

/// Four rows at four samples of their windows.
struct Between<'a> {
    evaluator: &'a Evaluator,
    lit: [(usize, f64); 4],
    samples: [([usize; 2], f64); 4],
}

impl pulp::NullaryFnOnce for Between<'_> {
    type Output = [f64; 3];

    #[inline(always)]
    fn call(self) -> [f64; 3] {
        let Self { evaluator: all, lit, samples } = self;
        let shift = all.shift[lit[0].0];
        let places = samples.map(|(sample, weight)| (all.layout.index(shift, sample), weight));
        if lit.iter().any(|(i, _)| all.shift[*i] != shift) || places.iter().any(|(e, _)| e.is_none()) {
            let mut sum = [0.0; CHANNELS];
            for (index, weight) in lit.into_iter().filter(|(_, w)| *w > 0.0) {
                let row = all.row_between(index, &samples);
                (0..CHANNELS).for_each(|c| sum[c] += weight * row[c]);
            }
            return sum;
        }
        // Rows that are shifted alike share what is between samples.
        let places = places.map(|(e, weight)| (e.unwrap_or(0), weight));
        if all.powers == 0 {
            let plane = |k: usize| all.mixed(k, places, [lit])[0];
            return if all.planes == [1, 1] { [plane(0); 3] } else { [plane(0), plane(1), plane(2)] };
        }
        let rows = all.mixed(0, places, lit.map(|(index, _)| [(index, 1.0)]));
        let mut sum = [0.0; CHANNELS];
        for (value, (index, weight)) in rows.into_iter().zip(lit) {
            let color = all.color(index, [value; 3]);
            (0..CHANNELS).for_each(|c| sum[c] += weight * color[c]);
        }
        sum
    }
}

impl Evaluator {
    /// Rearranges `material`.
    ///
    /// # Errors
    /// [`crate::Error::Inconsistent`] when its arrays do not have the lengths that its header says.
    pub fn new(material: &Material) -> Result<Self> {
        material.check_lengths()?;
        let (h, layout) = (&material.header, material.header.layout());
        let (rows, samples, terms) = (h.rows(), layout.len(), h.terms.next_multiple_of(LANES));
        let planes = [h.incident_planes, h.offset_planes];
        let mut weights = vec![0.0; terms];
        weights.iter_mut().zip(&material.weights).for_each(|(w, &g)| *w = f64::from(g));
        let mut incident = vec![0.0; rows * planes[0] * terms];
        for (at, record) in incident.chunks_exact_mut(terms).enumerate() {
            let f = material.incident(at % planes[0], at / planes[0]);
            record[..f.len()].copy_from_slice(f);
        }
        let mut offset = vec![0.0; samples * planes[1] * terms];
        let all = material.offset_factors.all();
        let mut profile = vec![0.0; if h.profile { samples * planes[1] } else { 0 }];
        for plane in 0..planes[1] {
            for (j, map) in offset_plane(&all, h, plane).chunks_exact(samples).enumerate() {
                for (e, &v) in map.iter().enumerate() {
                    offset[(e * planes[1] + plane) * terms + j] = v;
                }
            }
            for (e, &m) in material.profile_plane(plane).unwrap_or_default().iter().enumerate() {
                profile[e * planes[1] + plane] = m;
            }
        }
        let color = h.degree.map_or(Vec::new(), |degree| {
            let colors = Colors::new(degree);
            (0..rows).flat_map(|i| colors.of_row(material, i)).collect()
        });
        Ok(Self {
            layout,
            points: h.points,
            pitch_mm: h.pitch_mm,
            shift: material.shift.clone(),
            terms,
            planes,
            weights,
            incident,
            offset,
            profile,
            color,
            powers: h.degree.map_or(0, |p| p + 1),
            interval: Interval::of(h.intensity_range),
            through: h.exit_grid.is_some().then(|| Box::new(material.maps_alone())),
            lattice: Lattice::of(h.points, &material.lit_mm, h.lit_pitch_mm),
            tree: Tree::new(material),
        })
    }

    /// R̂_d at one offset (samples along x and y), mm⁻²; `None` outside the window or for a row that is not there.
    ///
    /// The entry of [`Material::evaluate_row`] to rounding (sums are f64 in another order).
    pub fn response(&self, index: usize, offset: [isize; 2]) -> Option<[f32; 3]> {
        let shift = *self.shift.get(index)?;
        let sample = |a: usize| {
            let s = usize::try_from(offset[a].checked_add((self.layout.window[a] / 2) as isize)?).ok()?;
            (s < self.layout.window[a]).then_some(s)
        };
        let sample = [sample(0)?, sample(1)?];
        let Some(e) = self.layout.index(shift, sample) else { return Some([0.0; CHANNELS]) };
        let value = self.value(index, e);
        let Some(through) = &self.through else { return Some(value.map(|v| v as f32)) };
        let at = [0, 1].map(|a| through.lit_mm[index][a] + offset[a] as f64 * self.pitch_mm);
        let (entry, exit) = (through.entry(index), through.exit(at));
        Some(std::array::from_fn(|c| (entry[c] * exit[c] * value[c]) as f32))
    }

    /// R̂_d(x_i, x_o) of the lit point and the sample that are nearest to two points of the slab, mm⁻²; 0 outside the
    /// window of the lit point or further than half a step from all lit points.
    ///
    /// The offset is kept: the sample is that nearest to x_o − x_i from the lit point, however far x_i is from it.
    /// Otherwise a response would jump by its peak wherever the nearest lit point changes.
    pub fn nearest(&self, x_i: Point, x_o: Point) -> [f32; 3] {
        let u = self.lattice.map(x_i);
        let cell: [Option<usize>; 2] = std::array::from_fn(|a| {
            let last = self.points[a] - 1;
            (u[a] >= -0.5 && u[a] <= last as f64 + 0.5).then_some((u[a].round().max(0.0) as usize).min(last))
        });
        let steps = [0, 1].map(|a| (x_o[a] - x_i[a]) / self.pitch_mm);
        let ([Some(x), Some(y)], true) = (cell, steps.iter().all(|s| s.is_finite())) else { return [0.0; 3] };
        let offset = steps.map(|s| s.round() as isize);
        self.response(x + y * self.points[0], offset).unwrap_or([0.0; 3])
    }

    /// R̂_d(x_i, x_o), mm⁻², between lit points and between samples.
    ///
    /// Bilinear in x_i between the rows of the four lit points around it, each taken at the offset x_o − x_i, and
    /// bilinear in the offset between the four samples around it. A material with a colour polynomial interpolates the
    /// normalized intensity between samples, then the colours between rows. Entry maps are interpolated with the rows;
    /// the exit map is that of x_o. Beyond the outermost lit points or samples by up to half a step the outermost are
    /// taken, further out it is 0.
    ///
    /// At lit points and samples it is [`Self::response`]. Between them its error is that of bilinear interpolation, an
    /// eighth of the second difference: largest at the peak of a response that is narrower than a sample, and where two
    /// materials meet between lit points. Samples are averages over their cells and are not sharpened.
    pub fn between(&self, x_i: Point, x_o: Point) -> [f32; 3] {
        let u = self.lattice.map(x_i);
        let half = |a: usize| (self.layout.window[a] / 2) as f64;
        let d: Point = std::array::from_fn(|a| (x_o[a] - x_i[a]) / self.pitch_mm + half(a));
        let (Some(lit), Some(samples)) = (Corners::around(u, self.points), Corners::around(d, self.layout.window))
        else {
            return [0.0; 3];
        };
        let lit = lit.each().map(|([x, y], weight)| (x + y * self.points[0], weight));
        let samples = samples.each();
        let Some(through) = &self.through else {
            return pulp::Arch::new().dispatch(Between { evaluator: self, lit, samples }).map(|v| v as f32);
        };
        let exit = through.exit(x_o);
        std::array::from_fn(|c| {
            // What enters is weighed channel by channel.
            let lit = lit.map(|(index, weight)| (index, weight * through.entry(index)[c]));
            let inside = pulp::Arch::new().dispatch(Between { evaluator: self, lit, samples });
            (exit[c] * inside[c]) as f32
        })
    }

    /// A row between samples of its window.
    fn row_between(&self, index: usize, samples: &[([usize; 2], f64); 4]) -> [f64; 3] {
        let Some(&shift) = self.shift.get(index) else { return [0.0; 3] };
        let mut planes = [0.0; CHANNELS];
        let mut outside = 0.0;
        for &(sample, weight) in samples.iter().filter(|(_, w)| *w > 0.0) {
            match self.layout.index(shift, sample) {
                Some(e) => {
                    let values = self.plane_values(index, e);
                    (0..CHANNELS).for_each(|k| planes[k] += weight * values[k]);
                }
                None => outside += weight,
            }
        }
        // Where nothing is modelled the response is 0, whatever colour an intensity of 0 has.
        if outside == 0.0 || self.powers == 0 {
            return self.color(index, planes);
        }
        let inside = 1.0 - outside;
        if inside <= 0.0 {
            return [0.0; 3];
        }
        self.color(index, planes.map(|v| v / inside)).map(|v| v * inside)
    }

    /// A pair of an offset from lit point `index`, drawn for its response, and the probability of it; `None` for a row
    /// that is not there or of which nothing is modelled. `random` is uniform in [0, 1).
    ///
    /// Offsets are whole samples along x and y; a point that is uniform in the sample's cell (`pitch_mm` wide) around
    /// it has the density `probability` / `pitch_mm`². The probability is nearly proportional to the mean of the planes
    /// (with a colour polynomial: to the normalized intensity), without entry and exit maps, and at least a hundredth
    /// of that of a uniform choice, so that it is positive wherever the response may be.
    pub fn sample(&self, index: usize, random: f64) -> Option<Sampled> {
        let shift = *self.shift.get(index)?;
        self.tree.sample(self.factors(index), self.layout, shift, random)
    }

    /// The probability with which [`Self::sample`] draws an offset, exactly; 0 outside the modelled window and for a
    /// row that is not there.
    pub fn probability(&self, index: usize, offset: [isize; 2]) -> f64 {
        self.shift.get(index).map_or(0.0, |&s| self.tree.probability(self.factors(index), self.layout, s, offset))
    }

    /// f_{k,j} of a row, \[A, T\].
    #[inline(always)]
    fn factors(&self, index: usize) -> &[f32] {
        let len = self.planes[0] * self.terms;
        &self.incident[index * len..][..len]
    }

    /// Row `index` at sample `e` of the common window.
    fn value(&self, index: usize, e: usize) -> [f64; 3] {
        self.color(index, self.plane_values(index, e))
    }

    /// The planes; a single one is repeated.
    #[inline(always)]
    fn plane_values(&self, index: usize, e: usize) -> [f64; 3] {
        let ([a, b], t) = (self.planes, self.terms);
        let incident = self.factors(index);
        let offset = &self.offset[e * b * t..][..b * t];
        let mut planes = [0.0; CHANNELS];
        for k in 0..a.max(b) {
            let (ka, kb) = (k.min(a - 1), k.min(b - 1));
            let sum = product(&self.weights, &incident[ka * t..][..t], &offset[kb * t..][..t]);
            planes[k] = if self.profile.is_empty() { sum } else { sum * f64::from(self.profile[e * b + kb]) };
        }
        if a.max(b) == 1 { [planes[0]; 3] } else { planes }
    }

    /// A plane at a weighted mean of samples `places` of the common window, for weighted means of rows.
    #[inline(always)]
    fn mixed<const N: usize, const ROWS: usize>(
        &self,
        k: usize,
        places: [(usize, f64); 4],
        rows: [[(usize, f64); N]; ROWS],
    ) -> [f64; ROWS] {
        let ([a, b], t) = (self.planes, self.terms);
        let (ka, kb) = (k.min(a - 1), k.min(b - 1));
        let offsets = places.map(|(e, _)| self.offset[(e * b + kb) * t..][..t].as_chunks::<LANES>().0);
        let shares =
            places.map(|(e, w)| if self.profile.is_empty() { w } else { w * f64::from(self.profile[e * b + kb]) });
        let factors = rows.map(|r| r.map(|(i, _)| self.incident[(i * a + ka) * t..][..t].as_chunks::<LANES>().0));
        let mut sums = [[0.0; LANES]; ROWS];
        for (chunk, g) in self.weights.as_chunks::<LANES>().0.iter().enumerate() {
            for lane in 0..LANES {
                let mut h = 0.0;
                for s in 0..4 {
                    h += shares[s] * f64::from(offsets[s][chunk][lane]);
                }
                h *= g[lane];
                for r in 0..ROWS {
                    let mut f = 0.0;
                    for s in 0..N {
                        f += rows[r][s].1 * f64::from(factors[r][s][chunk][lane]);
                    }
                    sums[r][lane] += f * h;
                }
            }
        }
        sums.map(|s| (s[0] + s[1]) + (s[2] + s[3]))
    }

    /// Planes as colours.
    #[inline(always)]
    fn color(&self, index: usize, planes: [f64; 3]) -> [f64; 3] {
        if self.powers == 0 {
            return planes;
        }
        let coefficients = &self.color[index * self.powers..][..self.powers];
        colors(coefficients, self.interval.arguments([planes[0]])).map(|c| c[0])
    }
}

/// Σ_j g_j f_j h_j.
#[inline(always)]
pub(crate) fn product(g: &[f64], f: &[f32], h: &[f32]) -> f64 {
    let mut sums = [0.0; LANES];
    let terms = g.as_chunks::<LANES>().0.iter().zip(f.as_chunks::<LANES>().0.iter().zip(h.as_chunks::<LANES>().0));
    for (g, (f, h)) in terms {
        for lane in 0..LANES {
            sums[lane] += g[lane] * f64::from(f[lane]) * f64::from(h[lane]);
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3])
}

#[cfg(test)]
mod tests;
