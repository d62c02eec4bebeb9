//! Relighting without rows: lit points as weighted impulses, convolved with the offset factors.
//!
//! Without a colour polynomial the exitance is Σ_j (Σ_i Φ_i g_j f_j(i) δ(x_i)) ∗ h_j. Impulses lie where the shares of
//! the light do, moved by the shift of their row; offset factors are cut to the part of the common window that the
//! windows of all these rows have, what else they have is added row by row. All terms are summed before the one
//! transform back.

use crate::exitance::Exitance;
use crate::layout::Core;
use crate::parallel::*;
use crate::quadrature::Quadrature;
use crate::response::Responses;
use crate::{CHANNELS, Error, Material, Result};
use realfft::num_complex::Complex;
use realfft::{ComplexToReal, RealFftPlanner, RealToComplex};
use rustfft::{Fft, FftPlanner};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

type Spectrum = Vec<Complex<f64>>;

/// What the parts of a relighting cost on one core, ns (AMD EPYC with AVX-512, `cargo bench --bench evaluate`): a
/// transform per sample and binary digit of their number, a term of a sample of a plane, and adding a sample of a
/// channel to an image once.
const TRANSFORM_NS: f64 = 0.6;
const TERM_NS: f64 = 0.05;
const ADD_NS: f64 = 0.5;
/// Bytes of spectra that are summed at a time: more lights are done in turn.
const SPECTRA: usize = 1 << 29;

/// What of the rows `lit` is convolved where that takes less time than adding all of them one by one: a part of the
/// common window, the rows, and the rows of which nothing is.
///
/// Of rows that are shifted the windows overlap in part only, so the farther shifts may be from the middle one, the
/// more rows are convolved, and the less of each.
pub(super) fn parts(
    material: &Material,
    lit: Vec<usize>,
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
) -> (Option<Core>, Vec<usize>, Vec<usize>) {
    let h = &material.header;
    if h.degree.is_some() || lit.is_empty() {
        return (None, Vec::new(), lit);
    }
    let shift = |row: usize| material.shift.get(row).copied().unwrap_or_default();
    let middle = [0, 1].map(|a| {
        let mut along: Vec<i16> = lit.iter().map(|&row| shift(row)[a]).collect();
        *along.select_nth_unstable(lit.len() / 2).1
    });
    let far = |row: usize| (0..2).map(|a| shift(row)[a].abs_diff(middle[a])).max().unwrap_or(0);
    let samples = quadrature.canvas().size.map(smooth).into_iter().product::<usize>() as f64;
    let jobs = jobs(material, fluxes);
    let impulses: BTreeSet<[usize; 3]> = jobs.iter().map(|j| j.impulses(h.incident_planes)).collect();
    let transforms = (h.terms * (h.offset_planes + impulses.len()) + jobs.len()) as f64;
    let of_transforms = transforms * samples * samples.log2() * TRANSFORM_NS;
    // Of one sample of a row.
    let of_row = |row: usize| {
        let shares = quadrature.shares(row).len() as f64;
        (h.terms * h.planes()) as f64 * TERM_NS + shares * (fluxes.len() * CHANNELS) as f64 * ADD_NS
    };
    let window = (h.window[0] * h.window[1]) as f64;
    // By how far they are: rows, what a sample of all of them takes, and their shifts.
    let mut by_distance: BTreeMap<u16, (f64, [i16; 2], [i16; 2])> = BTreeMap::new();
    for &row in &lit {
        let s = shift(row);
        let (cost, least, most) = by_distance.entry(far(row)).or_insert((0.0, s, s));
        *cost += of_row(row);
        (*least, *most) = ([0, 1].map(|a| least[a].min(s[a])), [0, 1].map(|a| most[a].max(s[a])));
    }
    let all: f64 = by_distance.values().map(|(cost, ..)| cost).sum();
    let mut best: (f64, Option<(u16, Core)>) = (all * window, None);
    let (mut near, mut least, mut most) = (0.0, middle, middle);
    for (&distance, (cost, from, to)) in &by_distance {
        near += cost;
        (least, most) = ([0, 1].map(|a| least[a].min(from[a])), [0, 1].map(|a| most[a].max(to[a])));
        let Some(core) = Core::of(&h.layout(), least, most) else { break };
        let time = of_transforms + near * (window - core.samples() as f64) + (all - near) * window;
        if time < best.0 {
            best = (time, Some((distance, core)));
        }
    }
    match best.1 {
        None => (None, Vec::new(), lit),
        Some((distance, core)) => {
            let (convolved, others) = lit.into_iter().partition(|&row| far(row) <= distance);
            (Some(core), convolved, others)
        }
    }
}

/// The least number from `n` on that has no prime factors but 2, 3 and 5: its transform is fast. Even.
fn smooth(n: usize) -> usize {
    let divided = |mut n: usize, by: usize| {
        while n.is_multiple_of(by) {
            n /= by;
        }
        n
    };
    (n.max(2)..).find(|&n| n.is_multiple_of(2) && divided(divided(divided(n, 2), 3), 5) == 1).unwrap_or(n)
}

/// An image to be made: of a light, from a plane of the material and a channel of the flux, for these channels.
struct Job {
    light: usize,
    plane: usize,
    flux: usize,
    channels: Vec<usize>,
}

impl Job {
    /// What its impulses depend on: jobs that share it share them.
    fn impulses(&self, incident_planes: usize) -> [usize; 3] {
        [self.light, self.plane.min(incident_planes - 1), self.flux]
    }
}

/// Adds to every image what the rows `indices` have in `core`.
///
/// # Errors
/// [`Error::Internal`].
pub(super) fn convolve(
    images: &mut [Exitance],
    rows: &Responses<'_>,
    core: &Core,
    indices: &[usize],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
) -> Result<()> {
    let Some(canvas) = images.first().map(|i| i.canvas) else { return Ok(()) };
    let transform = Transform::new(canvas.size.map(smooth));
    let together = (SPECTRA / (16 * CHANNELS * transform.spectrum_len())).max(1);
    for (images, fluxes) in images.chunks_mut(together).zip(fluxes.chunks(together)) {
        let jobs = jobs(rows.material(), fluxes);
        let mut sums: Vec<Spectrum> = jobs.iter().map(|_| transform.dark()).collect();
        for term in 0..rows.terms() {
            add_term(&mut sums, &jobs, &transform, rows, term, core, indices, quadrature, fluxes)?;
        }
        for (job, mut sum) in jobs.iter().zip(sums) {
            let samples = transform.inverse(&mut sum)?;
            for &channel in &job.channels {
                let plane = &mut images[job.light].planes[channel];
                let lines = plane.chunks_exact_mut(canvas.size[0]).zip(samples.chunks_exact(transform.size[0]));
                lines.for_each(|(to, from)| to.iter_mut().zip(from).for_each(|(to, from)| *to += from));
            }
        }
    }
    Ok(())
}

/// Every different image once: a grey material under grey light is one.
fn jobs(material: &Material, fluxes: &[Vec<[f64; 3]>]) -> Vec<Job> {
    let planes = material.header.planes();
    // Entry maps of three channels make three fluxes of a grey one.
    let entries = material.header.exit_grid.map_or(1, |g| g.planes);
    let mut jobs: Vec<Job> = Vec::new();
    for (light, flux) in fluxes.iter().enumerate() {
        let grey = flux.iter().all(|f| f[0] == f[1] && f[1] == f[2]);
        for channel in 0..CHANNELS {
            let plane = channel.min(planes - 1);
            let flux = if grey && entries == 1 { 0 } else { channel };
            match jobs.iter_mut().find(|j| (j.light, j.plane, j.flux) == (light, plane, flux)) {
                Some(job) => job.channels.push(channel),
                None => jobs.push(Job { light, plane, flux, channels: vec![channel] }),
            }
        }
    }
    jobs
}

/// Adds one term to the spectra of all images.
#[expect(clippy::too_many_arguments, reason = "the loop of `convolve`, split off for its length")]
fn add_term(
    sums: &mut [Spectrum],
    jobs: &[Job],
    transform: &Transform,
    rows: &Responses<'_>,
    term: usize,
    core: &Core,
    indices: &[usize],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
) -> Result<()> {
    let (canvas, material) = (quadrature.canvas(), rows.material());
    let layout = material.header.layout();
    let [incident_planes, offset_planes] = rows.factor_planes();
    let kernels: Vec<Spectrum> = (0..offset_planes)
        .map(|plane| {
            let mut samples = transform.black();
            let map = rows.map(plane, term).chunks_exact(layout.extended[0]);
            let lines = map.skip(core.y.start).zip(samples.chunks_exact_mut(transform.size[0]));
            lines.take(core.y.len()).for_each(|(from, to)| to[..core.x.len()].copy_from_slice(&from[core.x.clone()]));
            transform.forward(&mut samples, core.y.len())
        })
        .collect::<Result<_>>()?;
    // The impulses of the image before: planes often share them.
    let mut last: Option<([usize; 3], Spectrum)> = None;
    for (job, sum) in jobs.iter().zip(sums) {
        let key = job.impulses(incident_planes);
        let impulses = match last.take().filter(|(k, _)| *k == key) {
            Some((_, spectrum)) => spectrum,
            None => {
                let mut samples = transform.black();
                let width = canvas.size[0];
                for &index in indices {
                    let weight = rows.incident(job.plane, index, term) * material.entry(index)[job.flux];
                    let first = core.offset_from_lit(&layout, material.shift.get(index).copied().unwrap_or_default());
                    for share in quadrature.shares(index) {
                        let Some(flux) = fluxes[job.light].get(share.cell as usize) else { continue };
                        let at = [share.at as usize % width, share.at as usize / width];
                        // An impulse at the first sample of the core.
                        let [x, y] = [0, 1].map(|a| at[a].wrapping_add_signed(first[a]));
                        if let Some(sample) = samples.get_mut(x.wrapping_add(y.wrapping_mul(transform.size[0]))) {
                            *sample += flux[job.flux] * share.weight * weight;
                        }
                    }
                }
                transform.forward(&mut samples, canvas.size[1])?
            }
        };
        let kernel = &kernels[job.plane.min(offset_planes - 1)];
        let parts = sum.par_chunks_mut(1 << 14).zip(impulses.par_chunks(1 << 14).zip(kernel.par_chunks(1 << 14)));
        parts.for_each(|(sum, (a, b))| sum.iter_mut().zip(a.iter().zip(b)).for_each(|(s, (a, b))| *s += a * b));
        last = Some((key, impulses));
    }
    Ok(())
}

/// Fourier transforms of real images of one size; spectra are column by column, the half that is not the other's
/// conjugate.
struct Transform {
    size: [usize; 2],
    lines: Arc<dyn RealToComplex<f64>>,
    lines_back: Arc<dyn ComplexToReal<f64>>,
    columns: Arc<dyn Fft<f64>>,
    columns_back: Arc<dyn Fft<f64>>,
}

impl Transform {
    /// Of images of `size`, even along x.
    fn new(size: [usize; 2]) -> Self {
        let (mut real, mut complex) = (RealFftPlanner::new(), FftPlanner::new());
        Self {
            size,
            lines: real.plan_fft_forward(size[0]),
            lines_back: real.plan_fft_inverse(size[0]),
            columns: complex.plan_fft_forward(size[1]),
            columns_back: complex.plan_fft_inverse(size[1]),
        }
    }

    fn spectrum_len(&self) -> usize {
        (self.size[0] / 2 + 1) * self.size[1]
    }

    fn black(&self) -> Vec<f64> {
        vec![0.0; self.size[0] * self.size[1]]
    }

    fn dark(&self) -> Spectrum {
        vec![Complex::default(); self.spectrum_len()]
    }

    /// The spectrum of an image whose lines from `used` on are black; the image is used up.
    fn forward(&self, samples: &mut [f64], used: usize) -> Result<Spectrum> {
        let mut by_line = self.dark();
        let used = used.min(self.size[1]);
        let lines = by_line.par_chunks_mut(self.size[0] / 2 + 1).zip(samples.par_chunks_mut(self.size[0])).take(used);
        lines.try_for_each_init(
            || self.lines.make_scratch_vec(),
            |scratch, (out, line)| self.lines.process_with_scratch(line, out, scratch).map_err(Error::internal),
        )?;
        let mut spectrum = transposed(&by_line, self.size[0] / 2 + 1, self.size[1]);
        self.along_columns(&self.columns, &mut spectrum);
        Ok(spectrum)
    }

    /// The image of a spectrum, which is used up.
    fn inverse(&self, spectrum: &mut [Complex<f64>]) -> Result<Vec<f64>> {
        self.along_columns(&self.columns_back, spectrum);
        let half = self.size[0] / 2;
        let mut by_line = transposed(spectrum, self.size[1], half + 1);
        let mut samples = self.black();
        let scale = 1.0 / samples.len() as f64;
        let lines = by_line.par_chunks_mut(half + 1).zip(samples.par_chunks_mut(self.size[0]));
        lines.try_for_each_init(
            || self.lines_back.make_scratch_vec(),
            |scratch, (line, out)| {
                // Real but for rounding, and required to be.
                (line[0].im, line[half].im) = (0.0, 0.0);
                self.lines_back.process_with_scratch(line, out, scratch).map_err(Error::internal)?;
                out.iter_mut().for_each(|v| *v *= scale);
                Ok(())
            },
        )?;
        Ok(samples)
    }

    fn along_columns(&self, columns: &Arc<dyn Fft<f64>>, spectrum: &mut [Complex<f64>]) {
        let scratch = || vec![Complex::default(); columns.get_inplace_scratch_len()];
        let each = spectrum.par_chunks_mut(self.size[1]);
        each.for_each_init(scratch, |scratch, column| columns.process_with_scratch(column, scratch));
    }
}

/// From lines of `width` to columns of `height`.
fn transposed(values: &[Complex<f64>], width: usize, height: usize) -> Spectrum {
    const TILE: usize = 8;
    let mut out = vec![Complex::default(); values.len()];
    out.par_chunks_mut(TILE * height).enumerate().for_each(|(tile, out)| {
        for y in 0..height {
            let line = &values[y * width..][..width];
            for (x, column) in out.chunks_exact_mut(height).enumerate() {
                column[y] = line[tile * TILE + x];
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::response::tests::every_kind;
    use crate::splat::splat;
    use crate::{LitArea, naive};

    /// Lights of every colour; the first is grey.
    fn lights(rows: usize) -> Vec<Vec<[f64; 3]>> {
        let wave = |k: usize, c: usize| (0.7 * k as f64 + 1.9 * c as f64).sin() + 1.1;
        let colored = (0..rows).map(|k| std::array::from_fn(|c| wave(k, c))).collect();
        vec![(0..rows).map(|k| [wave(k, 0); 3]).collect(), colored]
    }

    #[test]
    fn a_convolution_is_the_sum_of_its_rows() {
        for mut material in every_kind().into_iter().filter(|m| m.header.degree.is_none()) {
            material.lit_mm.iter_mut().enumerate().for_each(|(k, p)| p[0] += 0.013 * k as f64);
            let h = &material.header;
            let shape = material.shape();
            let quadrature = Quadrature::of_points(&LitArea::of(&shape).unwrap(), &shape);
            let canvas = quadrature.canvas();
            let rows = Responses::new(&material);
            let (indices, fluxes) = ([1, 4], lights(6));
            // Rows 1 and 4 are shifted by (1, 0), what they have is one window.
            assert!(indices.iter().all(|&i| material.shift[i] == [1, 0]));
            let core = Core::of(&h.layout(), [1, 0], [1, 0]).unwrap();
            let black = vec![Exitance::new(canvas), Exitance::new(canvas)];
            let (mut a, mut b) = (black.clone(), black);
            convolve(&mut a, &rows, &core, &indices, &quadrature, &fluxes).unwrap();
            let len = rows.window_len();
            let mut values = vec![0.0; indices.len() * 3 * len];
            rows.by_channel(&indices, &mut values);
            let known = indices.map(|i| (i, [1.0; 3]));
            splat(&mut b, &known, shape.window, &quadrature, &fluxes, &|k, c, _, add| {
                let lines = values[(3 * k + c) * len..][..len].chunks_exact(shape.window[0]);
                lines.enumerate().for_each(|(dy, line)| add(0, dy, line));
            });
            for (a, b) in a.iter().zip(&b) {
                for (a, b) in a.planes.iter().flatten().zip(b.planes.iter().flatten()) {
                    assert!(
                        (a - b).abs() < 1e-13,
                        "rounding of a transform of a few hundred samples of size 1: {a} {b}"
                    );
                }
            }
            assert!(a[1].planes[2].iter().any(|v| v.abs() > 1e-3) || h.extended == [3, 1]);
        }
    }

    #[test]
    fn sizes_of_transforms_are_even_and_of_small_primes() {
        assert_eq!([1, 3, 7, 61, 317, 1081].map(smooth), [2, 4, 8, 64, 320, 1152]);
    }

    #[test]
    fn a_transform_and_back_changes_nothing() {
        for size in [[2, 1], [4, 3], [6, 10], [20, 7]] {
            let transform = Transform::new(size);
            let samples: Vec<f64> = (0..size[0] * size[1]).map(|k| (k as f64).sin()).collect();
            let mut spectrum = transform.forward(&mut samples.clone(), size[1]).unwrap();
            let back = transform.inverse(&mut spectrum).unwrap();
            assert!(back.iter().zip(&samples).all(|(a, b)| (a - b).abs() < 1e-14), "rounding of f64");
        }
    }

    #[test]
    fn only_light_that_is_grey_everywhere_makes_one_image_for_three_channels() {
        let images = |planes: usize, flux: [[f64; 3]; 2]| -> Vec<(usize, usize, Vec<usize>)> {
            let mut m = naive::materials().remove(0);
            (m.header.incident_planes, m.header.offset_planes) = (1, planes);
            jobs(&m, &[flux.to_vec()]).into_iter().map(|j| (j.plane, j.flux, j.channels)).collect()
        };
        let (grey, own) = (vec![(0, 0, vec![0, 1, 2])], |plane: [usize; 3]| -> Vec<(usize, usize, Vec<usize>)> {
            (0..3).map(|c| (plane[c], c, vec![c])).collect()
        });
        assert_eq!(images(1, [[2.0; 3], [5.0; 3]]), grey);
        // A colour in one lit point, in any of the channels.
        for colored in [[1.0, 1.0, 3.0], [3.0, 1.0, 1.0], [1.0, 3.0, 1.0]] {
            assert_eq!(images(1, [[2.0; 3], colored]), own([0; 3]), "{colored:?}");
            assert_eq!(images(1, [colored, [2.0; 3]]), own([0; 3]), "{colored:?}");
        }
        assert_eq!(images(3, [[2.0; 3]; 2]), (0..3).map(|c| (c, 0, vec![c])).collect::<Vec<_>>());
        assert_eq!(images(3, [[2.0, 2.0, 1.0]; 2]), own([0, 1, 2]));
    }
}
