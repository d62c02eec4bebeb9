//! The response of rows: a product of matrices, then the colour polynomial, with the vector instructions at hand.
//!
//! Every value of a material is Σ_j g_j f_j h_j of its planes, see [`Material`]; here for many samples of many rows at
//! once, in [`crate::Evaluator`] for single pairs of points, from factors that lie otherwise in memory. Colours are
//! those of [`colors`] in both. Sums and polynomials are evaluated in f64, in an order that depends neither on the rows
//! beside a row nor on the number of threads.

use crate::color::{Colors, Interval, colors};
use crate::layout::Core;
use crate::parallel::*;
use crate::{CHANNELS, Layout, Material};
use pulp::Simd;
use std::ops::Range;

/// Numbers in the product of a few rows: they stay in the processor's cache.
const PRODUCT: usize = 1 << 17;
/// Samples that go through the polynomial together.
const LANES: usize = 8;
/// Numbers in a padded line of a map: two of the widest vectors.
const LINE: usize = 16;

/// Maps in f64, one below the other, each padded with zeros to whole vectors.
#[derive(Debug, Clone)]
pub(crate) struct Maps {
    samples: usize,
    padded: Vec<f64>,
}

impl Maps {
    /// From `count` maps of equal length.
    pub(crate) fn new(maps: &[f64], count: usize) -> Self {
        let samples = maps.len() / count.max(1);
        let stride = samples.next_multiple_of(LINE);
        let mut padded = vec![0.0; count * stride];
        let lines = padded.chunks_exact_mut(stride.max(1)).zip(maps.chunks_exact(samples.max(1)));
        lines.for_each(|(to, from)| to[..samples].copy_from_slice(from));
        Self { samples, padded }
    }

    pub(crate) fn samples(&self) -> usize {
        self.samples
    }

    /// Numbers from one line of sums to the next.
    pub(crate) fn stride(&self) -> usize {
        self.samples.next_multiple_of(LINE)
    }

    /// The samples of map `at`.
    pub(crate) fn map(&self, at: usize) -> &[f64] {
        &self.padded[at * self.stride()..][..self.samples]
    }

    /// Sums of all maps, one for each line of `amounts` (\[sums, maps\]): \[sums, [`Self::stride`]\].
    pub(crate) fn sums(&self, amounts: &[f64], out: &mut Vec<f64>) {
        let (stride, maps) = (self.stride().max(1), self.padded.len() / self.stride().max(1));
        out.resize(amounts.len() / maps.max(1) * stride, 0.0);
        sums(amounts, &self.padded, maps, out, stride);
    }
}

/// Sums of the first `terms` lines of `maps`, one line of `out` for each `terms` numbers of `amounts`.
fn sums(amounts: &[f64], maps: &[f64], terms: usize, out: &mut [f64], stride: usize) {
    pulp::Arch::new().dispatch(Sums { amounts, maps, terms, out, stride });
}

struct Sums<'a> {
    amounts: &'a [f64],
    maps: &'a [f64],
    terms: usize,
    out: &'a mut [f64],
    stride: usize,
}

impl pulp::WithSimd for Sums<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        /// Sums that are made together: their vectors fit the registers.
        const TOGETHER: usize = 4;
        let Self { amounts, maps, terms, out, stride } = self;
        if terms == 0 {
            return out.fill(0.0);
        }
        let blocks = out.chunks_mut(TOGETHER * stride).zip(amounts.chunks(TOGETHER * terms));
        for (out, amounts) in blocks {
            match amounts.len() / terms {
                TOGETHER => several::<S, TOGETHER>(simd, amounts, maps, terms, out, stride),
                _ => {
                    for (out, amounts) in out.chunks_exact_mut(stride).zip(amounts.chunks_exact(terms)) {
                        several::<S, 1>(simd, amounts, maps, terms, out, stride);
                    }
                }
            }
        }
    }
}

#[inline(always)]
fn several<S: Simd, const R: usize>(
    simd: S,
    amounts: &[f64],
    maps: &[f64],
    terms: usize,
    out: &mut [f64],
    stride: usize,
) {
    let step = 2 * S::F64_LANES;
    for e in (0..stride).step_by(step) {
        let mut total = [[simd.splat_f64s(0.0); 2]; R];
        for j in 0..terms {
            let (h, _) = S::as_simd_f64s(&maps[j * stride + e..][..step]);
            for r in 0..R {
                let amount = simd.splat_f64s(amounts[r * terms + j]);
                for v in 0..2 {
                    total[r][v] = simd.mul_add_e_f64s(amount, h[v], total[r][v]);
                }
            }
        }
        for r in 0..R {
            let (to, _) = S::as_mut_simd_f64s(&mut out[r * stride + e..][..step]);
            to.copy_from_slice(&total[r]);
        }
    }
}

/// A material prepared for the responses of many rows.
#[derive(Debug)]
pub struct Responses<'a> {
    material: &'a Material,
    layout: Layout,
    /// m_k h_{k,j} on the common window, for each of B planes.
    maps: Vec<Maps>,
    /// What of the common window is left out of the maps.
    core: Option<Core>,
    colors: Option<Colors>,
    exit: bool,
}

impl<'a> Responses<'a> {
    /// Prepares `material`: memory of twice its offset factors.
    pub fn new(material: &'a Material) -> Self {
        Self::without(material, None)
    }

    /// The same of what lies outside a part of the common window.
    fn without(material: &'a Material, core: Option<Core>) -> Self {
        let (h, layout) = (&material.header, material.header.layout());
        let (samples, terms) = (layout.len(), h.terms);
        let factors = material.offset_factors.all();
        let outside = |e: &usize| core.as_ref().is_none_or(|core| !core.contains(layout.extended[0], *e));
        let kept: Vec<usize> = (0..samples).filter(outside).collect();
        let maps = (0..h.offset_planes).map(|plane| {
            let factors = &factors[plane * terms * samples..][..terms * samples];
            let profile = material.profile_plane(plane);
            let value = |line: &[f32], e: usize| f64::from(line[e]) * profile.map_or(1.0, |m| f64::from(m[e]));
            let lines = factors.chunks_exact(samples.max(1));
            let wide: Vec<f64> = lines.flat_map(|line| kept.iter().map(move |&e| value(line, e))).collect();
            Maps::new(&wide, terms)
        });
        let maps = maps.collect();
        Self { material, layout, maps, core, colors: h.degree.map(Colors::new), exit: true }
    }

    /// Of light before it leaves, without the exit map; and of what lies outside `core` alone.
    pub(crate) fn entering(material: &'a Material, core: Option<Core>) -> Self {
        Self { exit: false, ..Self::without(material, core) }
    }

    /// Calls `each(dx, dy, map_index, length)` for pieces of the lines `seen` of a window shifted by `shift`, as far as
    /// they lie in the maps.
    pub(crate) fn for_each_piece(
        &self,
        shift: [i16; 2],
        seen: Range<usize>,
        mut each: impl FnMut(usize, usize, usize, usize),
    ) {
        let (width, columns) = (self.layout.extended[0], self.layout.window[0].max(1));
        self.layout.for_each_line(shift, |k, e, n| {
            let (dx, dy) = (k % columns, k / columns);
            match &self.core {
                _ if !seen.contains(&dy) => {}
                None => each(dx, dy, e, n),
                Some(core) => core.outside(width, e, n, |skipped, n| {
                    let e = e + skipped;
                    each(dx + skipped, dy, e - core.before(width, e), n);
                }),
            }
        });
    }

    /// What it was made from.
    pub fn material(&self) -> &Material {
        self.material
    }

    /// T.
    pub(crate) fn terms(&self) -> usize {
        self.material.header.terms
    }

    /// A and B.
    pub(crate) fn factor_planes(&self) -> [usize; 2] {
        [self.material.header.incident_planes, self.material.header.offset_planes]
    }

    /// g_j f_{k,j} of a row; 0 for a row that is not there.
    pub(crate) fn incident(&self, plane: usize, index: usize, term: usize) -> f64 {
        let f = self.material.incident(plane, index).get(term).copied().unwrap_or(0.0);
        self.material.weights.get(term).map_or(0.0, |&g| f64::from(g) * f64::from(f))
    }

    /// Samples of the maps: those of the common window.
    pub(crate) fn map_len(&self) -> usize {
        self.maps.first().map_or(0, Maps::samples)
    }

    /// m_k h_{k,j} on the common window.
    pub(crate) fn map(&self, plane: usize, term: usize) -> &[f64] {
        self.maps[plane.min(self.maps.len() - 1)].map(term)
    }

    /// All planes of the rows `indices`, as [`Self::plane`] gives one.
    pub(crate) fn planes(&self, indices: &[usize]) -> Vec<Vec<f64>> {
        (0..self.material.header.planes()).map(|plane| self.plane(plane, indices)).collect()
    }

    /// Samples of a measured window.
    pub fn window_len(&self) -> usize {
        self.layout.window[0] * self.layout.window[1]
    }

    /// R̂_d of row `index` on its measured window, \[dy\]\[dx\]\[channel\], mm⁻²; zeros for a row that is not there.
    pub fn row(&self, index: usize) -> Vec<f32> {
        let mut out = vec![0.0; CHANNELS * self.window_len()];
        self.interleaved(&[index], &mut out);
        out
    }

    /// R̂_d of the rows `indices`, mm⁻², into `out`, \[rows\]\[channel\]\[dy\]\[dx\]; rows that are not there are
    /// zeros.
    pub fn by_channel(&self, indices: &[usize], out: &mut [f64]) {
        self.each(indices, out, |index, values, _, out| {
            out.fill(0.0);
            self.finish(index, values, out);
        });
    }

    /// The same as \[rows\]\[dy\]\[dx\]\[channel\].
    pub fn interleaved(&self, indices: &[usize], out: &mut [f32]) {
        let len = self.window_len();
        self.each(indices, out, |index, values, planes, out| {
            planes.resize(CHANNELS * len, 0.0);
            planes.fill(0.0);
            self.finish(index, values, planes);
            let (red, rest) = planes.split_at(len);
            let (green, blue) = rest.split_at(len);
            for (rgb, (r, (g, b))) in out.as_chunks_mut::<3>().0.iter_mut().zip(red.iter().zip(green.iter().zip(blue)))
            {
                *rgb = [*r as f32, *g as f32, *b as f32];
            }
        });
    }

    /// Plane `plane` of the rows `indices` on the common window, \[rows\]\[y\]\[x\]; rows that are not there are zeros.
    /// The only plane of a material with a colour polynomial is the normalized intensity.
    pub fn plane(&self, plane: usize, indices: &[usize]) -> Vec<f64> {
        let samples = self.map_len();
        let mut out = vec![0.0; indices.len() * samples];
        let few = (PRODUCT / samples.max(1)).clamp(1, 64);
        let part = |(factors, product): &mut (Vec<f64>, Vec<f64>), (out, indices): (&mut [f64], &[usize])| {
            let stride = self.product(plane, indices, factors, product);
            for (out, line) in out.chunks_exact_mut(samples.max(1)).zip(product.chunks_exact(stride.max(1))) {
                out.copy_from_slice(&line[..samples]);
            }
        };
        let buffers = || (Vec::new(), Vec::new());
        for_each_part(&mut out, few * samples, indices, few, buffers, part);
        out
    }

    /// Multiplies the factors of a few rows at a time, and calls `finish` with each row, its planes (each padded to the
    /// stride of the maps), a buffer and its part of `out`.
    fn each<V: Send>(
        &self,
        indices: &[usize],
        out: &mut [V],
        finish: impl Fn(usize, &[&[f64]], &mut Vec<f64>, &mut [V]) + Sync,
    ) {
        let planes = self.material.header.planes();
        let len = CHANNELS * self.window_len();
        let few = (PRODUCT / (planes * self.layout.len()).max(1)).clamp(1, 64);
        let buffers = || (Vec::new(), vec![Vec::new(); planes], Vec::new());
        for_each_part(out, few * len, indices, few, buffers, |(factors, products, buffer), (out, indices)| {
            let mut stride = 0;
            for (plane, product) in products.iter_mut().enumerate() {
                stride = self.product(plane, indices, factors, product);
            }
            for (k, (out, &index)) in out.chunks_exact_mut(len).zip(indices).enumerate() {
                let empty: [&[f64]; CHANNELS] = [&[]; CHANNELS];
                let mut values = empty;
                values.iter_mut().zip(&*products).for_each(|(v, product)| *v = &product[k * stride..][..stride]);
                finish(index, &values[..planes], buffer, out);
            }
        });
    }

    /// A plane of rows on the common window, \[rows\]\[stride\]; gives the stride.
    fn product(&self, plane: usize, indices: &[usize], factors: &mut Vec<f64>, product: &mut Vec<f64>) -> usize {
        let terms = self.terms();
        factors.clear();
        factors.resize(indices.len() * terms, 0.0);
        for (row, &index) in factors.chunks_exact_mut(terms.max(1)).zip(indices) {
            let f = self.material.incident(plane, index).iter().zip(&self.material.weights);
            row.iter_mut().zip(f).for_each(|(v, (&f, &g))| *v = f64::from(g) * f64::from(f));
        }
        let maps = &self.maps[plane.min(self.maps.len() - 1)];
        maps.sums(factors, product);
        maps.stride()
    }

    /// The part of the common window that a row measured, in colour, as it leaves.
    fn finish(&self, index: usize, values: &[&[f64]], row: &mut [f64]) {
        self.inside(index, values, row);
        self.material.multiply(index, row, self.exit);
    }

    /// The same of the terms alone.
    fn inside(&self, index: usize, values: &[&[f64]], row: &mut [f64]) {
        let (h, window) = (&self.material.header, self.window_len());
        let Some(&shift) = self.material.shift.get(index).filter(|_| index < h.rows()) else { return };
        let Some(known) = &self.colors else {
            for (c, channel) in row.chunks_exact_mut(window).enumerate() {
                let plane = values[c.min(h.planes() - 1)];
                self.layout.for_each_line(shift, |k, e, n| channel[k..k + n].copy_from_slice(&plane[e..e + n]));
            }
            return;
        };
        let (coefficients, interval) = (known.of_row(self.material, index), Interval::of(h.intensity_range));
        let (first, rest) = row.split_at_mut(window);
        let (second, third) = rest.split_at_mut(window);
        self.layout.for_each_line(shift, |k, e, n| {
            let out = [&mut first[k..k + n], &mut second[k..k + n], &mut third[k..k + n]];
            let values = &values[0][e..e + n];
            pulp::Arch::new().dispatch(ColorLine { values, interval, coefficients: &coefficients, out });
        });
    }
}

/// Calls `each` with parts of `out` and of `indices`, on all cores with the feature `threads`, and with a buffer that
/// parts share.
fn for_each_part<V: Send, B>(
    out: &mut [V],
    len: usize,
    indices: &[usize],
    count: usize,
    buffers: impl Fn() -> B + Sync + Send,
    each: impl Fn(&mut B, (&mut [V], &[usize])) + Sync + Send,
) {
    out.par_chunks_mut(len.max(1)).zip(indices.par_chunks(count)).for_each_init(buffers, each);
}

/// The three polynomials of a row on a line of its intensities.
struct ColorLine<'a> {
    values: &'a [f64],
    interval: Interval,
    /// Of powers of u, lowest first.
    coefficients: &'a [[f64; CHANNELS]],
    out: [&'a mut [f64]; CHANNELS],
}

impl pulp::NullaryFnOnce for ColorLine<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let [red, green, blue] = self.out;
        let mut at = 0;
        while at < self.values.len() {
            // The last lanes overlap those before them: the same numbers are written twice.
            let n = LANES.min(self.values.len());
            at = at.min(self.values.len() - n);
            let mut values = [0.0; LANES];
            values[..n].copy_from_slice(&self.values[at..at + n]);
            let sums = colors(self.coefficients, self.interval.arguments(values));
            red[at..at + n].copy_from_slice(&sums[0][..n]);
            green[at..at + n].copy_from_slice(&sums[1][..n]);
            blue[at..at + n].copy_from_slice(&sums[2][..n]);
            at += n;
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
