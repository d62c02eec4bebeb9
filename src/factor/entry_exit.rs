//! Entry and exit maps: what a material's rows and its slab under even light lack, put into two maps by iterative
//! proportional fitting (`DemingStephan1940`, `SinkhornKnopp1967`).
//!
//! R̂_c(x_i, x_o) = a_c(x_i) e_c(x_o) M_c(x_i, x_o − x_i). For every x_i the sum over the window is to be that of the
//! matrix (the row's albedo), and at every x_o the exitance under even light. Entries that were not measured count as
//! what the material says there.

use super::term_rows::TermRows;
use super::vector::dot_wide;
use crate::Result;
use crate::material::{ExitGrid, Exitance, Light, Material, Quadrature, Responses, lit_area_of, splat, splat_entries};
use crate::output::numbers;
use crate::transport::{MatrixReader, RowBlock};
use acquire_material::{fit_entry_map, fit_exit_map};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::ops::Range;

/// Rounds of fitting: each takes the misfit of the one before to about a fifth of it.
pub(super) const ROUNDS: usize = 6;
/// The same where terms are to be fitted anew.
pub(super) const ROUNDS_BETWEEN: usize = 2;
/// Differences below this share of the largest exitance are not seen: 80 dB.
const UNSEEN: f64 = 1e-4;
/// Marginals over a row, their variances, and where it was measured, if not everywhere.
type RowSums = ([f64; 3], [f64; 3], Option<Vec<u8>>);

/// A row of which a part was not measured.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Gap {
    row: usize,
    /// 1 where it was, \[dy\]\[dx\]\[channel\].
    #[serde(with = "numbers")]
    valid: Vec<u8>,
}

/// What a plane has from its first number that is not zero to its last.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Band {
    first: usize,
    #[serde(with = "numbers")]
    values: Vec<f64>,
}

impl Band {
    fn of(plane: &[f64]) -> Self {
        let first = plane.iter().position(|&v| v != 0.0).unwrap_or(plane.len());
        let end = plane.iter().rposition(|&v| v != 0.0).map_or(first, |last| last + 1);
        Self { first, values: plane[first..end].to_vec() }
    }

    fn add_to(&self, plane: &mut [f64]) {
        plane.iter_mut().skip(self.first).zip(&self.values).for_each(|(a, b)| *a += b);
    }
}

/// What some consecutive rows add to [`Marginals`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct MarginalSums {
    first: usize,
    #[serde(with = "numbers")]
    rows: Vec<[f64; 3]>,
    #[serde(with = "numbers")]
    row_variance: Vec<[f64; 3]>,
    gaps: Vec<Gap>,
    exitance: [Band; 3],
    exitance_variance: [Band; 3],
}

/// What the maps are fitted to, as far as it was measured.
pub(super) struct Marginals {
    quadrature: Quadrature,
    /// Even light, and its square.
    flux: Vec<Vec<[f64; 3]>>,
    squared_flux: Vec<Vec<[f64; 3]>>,
    /// What leaves under it, as far as it was measured.
    exitance: Exitance,
    /// The variance of that, as far as it is independent from entry to entry.
    exitance_variance: Exitance,
    /// Marginals of rows, \[N\], likewise, and their variances.
    rows: Vec<[f64; 3]>,
    row_variance: Vec<[f64; 3]>,
    gaps: Vec<Gap>,
}

impl Marginals {
    /// Of no row.
    ///
    /// # Errors
    /// [`crate::Error::Field`] when the lit points are too far apart for an image.
    pub(super) fn new(reader: &MatrixReader) -> Result<Self> {
        let shape = reader.shape();
        let area = lit_area_of(&shape, reader.path())?;
        let quadrature = Quadrature::new(&area, &shape);
        let flux = vec![Light::Uniform.flux(&quadrature)?];
        let squared_flux = flux.iter().map(|cells| cells.iter().map(|f| f.map(|f| f * f)).collect()).collect();
        let exitance = Exitance::new(area.canvas);
        let none = vec![[0.0; 3]; shape.rows()];
        Ok(Self {
            quadrature,
            flux,
            squared_flux,
            exitance_variance: exitance.clone(),
            exitance,
            rows: none.clone(),
            row_variance: none,
            gaps: Vec::new(),
        })
    }

    /// Adds rows of the matrix.
    pub(super) fn add(&mut self, block: &RowBlock, window: [usize; 2]) {
        splat(std::slice::from_mut(&mut self.exitance), block, window, &self.quadrature, &self.flux);
        if !block.variance.is_empty() {
            // Shares of a cell's light are squared by no more than themselves: rather too large a variance than too
            // small a one.
            let image = std::slice::from_mut(&mut self.exitance_variance);
            splat_entries(image, block, &block.variance, window, &self.quadrature, &self.squared_flux);
        }
        let sums = |k: usize| {
            let row = block.view(k);
            let (mut sum, mut variance) = ([0.0; 3], [0.0; 3]);
            for (rgb, valid) in row.response.chunks_exact(3).zip(row.valid.chunks_exact(3)) {
                (0..3).filter(|&c| valid[c] != 0).for_each(|c| sum[c] += f64::from(rgb[c]));
            }
            for (s, v) in row.variance.iter().enumerate().filter(|(s, _)| row.valid[*s] != 0) {
                variance[s % 3] += f64::from(*v);
            }
            let complete = row.valid.iter().all(|&v| v != 0);
            (sum, variance, (!complete).then(|| row.valid.to_vec()))
        };
        let found: Vec<RowSums> = (0..block.rows).into_par_iter().map(sums).collect();
        for (k, (sum, variance, gap)) in found.into_iter().enumerate() {
            (self.rows[block.first + k], self.row_variance[block.first + k]) = (sum, variance);
            self.gaps.extend(gap.map(|valid| Gap { row: block.first + k, valid }));
        }
    }

    /// What was added by these rows, where no others were.
    pub(super) fn of(self, rows: Range<usize>) -> MarginalSums {
        let bands = |image: &Exitance| image.planes.each_ref().map(|plane| Band::of(plane));
        MarginalSums {
            first: rows.start,
            exitance: bands(&self.exitance),
            exitance_variance: bands(&self.exitance_variance),
            rows: self.rows[rows.clone()].to_vec(),
            row_variance: self.row_variance[rows].to_vec(),
            gaps: self.gaps,
        }
    }

    /// Adds what others have found of rows that were not added yet.
    pub(super) fn join(&mut self, next: MarginalSums) {
        let here = next.first..next.first + next.rows.len();
        self.rows[here.clone()].copy_from_slice(&next.rows);
        self.row_variance[here].copy_from_slice(&next.row_variance);
        self.gaps.extend(next.gaps);
        for (image, bands) in
            [(&mut self.exitance, &next.exitance), (&mut self.exitance_variance, &next.exitance_variance)]
        {
            image.planes.iter_mut().zip(bands).for_each(|(plane, band)| band.add_to(plane));
        }
    }

    /// All sums, one after the other.
    #[cfg(test)]
    pub(super) fn numbers(&self) -> Vec<f64> {
        let images = self.exitance.planes.iter().chain(&self.exitance_variance.planes).flatten();
        let rows = self.rows.iter().chain(&self.row_variance).flatten();
        let gaps = self.gaps.iter().flat_map(|gap| gap.valid.iter().map(|&v| f64::from(v)).chain([gap.row as f64]));
        images.chain(rows).copied().chain(gaps).collect()
    }

    /// The same with what the material says where nothing was measured.
    fn filled(&self, material: &Material) -> (Exitance, Vec<[f64; 3]>) {
        let (mut exitance, mut sums) = (self.exitance.clone(), self.rows.clone());
        let responses = Responses::new(material);
        for Gap { row, valid } in &self.gaps {
            let response = responses.row(*row);
            for (s, v) in response.iter().enumerate().filter(|(s, _)| valid[*s] == 0) {
                sums[*row][s % 3] += f64::from(*v);
            }
            let valid = valid.iter().map(|v| 1 - v).collect();
            let block = RowBlock { first: *row, rows: 1, response, variance: Vec::new(), valid };
            splat(std::slice::from_mut(&mut exitance), &block, material.header.window, &self.quadrature, &self.flux);
        }
        (exitance, sums)
    }

    /// Where the exit map lies.
    pub(super) fn grid(&self, planes: usize) -> ExitGrid {
        let canvas = self.exitance.canvas;
        ExitGrid { origin_mm: canvas.origin_mm, size: canvas.size, planes }
    }

    /// Whether the rows' sums, or the exitance under even light, differ from those of a material without maps by more
    /// than noise, and by more than can be seen.
    ///
    /// # Errors
    /// Those of relighting.
    pub(super) fn differ(&self, material: &Material) -> Result<bool> {
        let (exitance, sums) = self.filled(material);
        let found = acquire_material::relight(material, &self.quadrature, &self.flux, &|_| {})?;
        let largest = |values: &[f64]| values.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
        let mut tests = Vec::new();
        let own = row_sums(material);
        for c in 0..3 {
            let (wanted, found, variance) =
                (&exitance.planes[c], &found[0].planes[c], &self.exitance_variance.planes[c]);
            tests.push(excess(wanted, found, variance, UNSEEN * largest(wanted)));
            let channel = |of: &[[f64; 3]]| of.iter().map(|v| v[c]).collect::<Vec<f64>>();
            let (wanted, found, variance) = (channel(&sums), channel(&own), channel(&self.row_variance));
            tests.push(excess(&wanted, &found, &variance, UNSEEN * largest(&wanted)));
        }
        Ok(tests.into_iter().any(|t| t > 1.0))
    }

    /// Gives `material` maps of `planes` channels; those that it has are where the fit begins.
    ///
    /// # Errors
    /// Those of relighting.
    pub(super) fn fit(&self, material: &mut Material, planes: usize, rounds: usize) -> Result<()> {
        let grid = self.grid(planes);
        let samples = grid.size[0] * grid.size[1];
        if material.header.exit_grid != Some(grid) {
            material.header.exit_grid = Some(grid);
            material.entry_map = vec![1.0; planes * material.header.rows()];
            material.exit_map = vec![1.0; planes * samples];
        }
        let (exitance, rows) = self.filled(material);
        for _ in 0..rounds {
            // From one, where the terms say nearly nothing.
            material.entry_map.fill(1.0);
            let found = row_sums(material);
            fit_entry_map(material, &rows, &found);
            material.exit_map.fill(1.0);
            fit_exit_map(material, &exitance, &self.quadrature, &self.flux)?;
        }
        Ok(())
    }
}

/// Marginals of the rows of a material over their windows; terms in f32, sums in f64.
fn row_sums(material: &Material) -> Vec<[f64; 3]> {
    let (terms, header) = (TermRows::new(material), &material.header);
    let (layout, planes) = (header.layout(), header.planes());
    let found = terms.map(0..header.rows(), |row| {
        let mut sum = 0.0;
        layout.for_each_line(material.shift[row.index], |w, e, n| {
            sum += dot_wide(&row.values[e..e + n], &row.maps[w..w + n]);
        });
        (row.index, row.plane, terms.unit * sum)
    });
    let mut sums = vec![[0.0; 3]; header.rows()];
    for (index, plane, sum) in found {
        (plane..if plane + 1 == planes { 3 } else { plane + 1 }).for_each(|c| sums[index][c] = sum);
    }
    sums
}

/// Mean square of the differences over their variance and what is unseen; over what scatter alone may give it.
fn excess(wanted: &[f64], found: &[f64], variance: &[f64], unseen: f64) -> f64 {
    let entries = wanted.iter().zip(found).zip(variance);
    let terms = entries.filter_map(|((w, f), v)| {
        let bound = v + unseen * unseen;
        (bound > 0.0).then(|| (w - f).powi(2) / bound)
    });
    let (sum, count) = terms.fold((0.0, 0_usize), |(s, n), t| (s + t, n + 1));
    let mean = sum / count.max(1) as f64;
    mean / (1.0 + 5.0 * (2.0 / count.max(1) as f64).sqrt())
}

#[cfg(test)]
mod tests {
    use super::super::test_matrices::stored;
    use super::super::{FactorOptions, factor};
    use super::*;
    use crate::material::Model;
    use crate::progress::Progress;
    use crate::transport::Row;

    /// What enters and leaves, point by point, of equal rows with a step between two media; samples with `gap` were not
    /// measured.
    fn value(i: usize, e: usize, c: usize) -> f64 {
        let (x, y) = ((i % 9) as f64 + (e % 7) as f64 / 2.0, (i / 9) as f64 + (e / 7) as f64 / 3.0);
        let d2 = ((e % 7) as f64 - 3.0).powi(2) + ((e / 7) as f64 - 2.0).powi(2);
        let entry = 1.0 + 0.3 * ((i * (c + 2)) as f64).sin();
        entry * (1.0 + 0.4 * (1.7 * x + 0.9 * y).sin()) * (-d2 / (3.0 + c as f64)).exp()
    }

    fn matrix(gap: impl Fn(usize, usize) -> bool) -> super::super::test_matrices::StoredMatrix {
        let entries = || (0..35).flat_map(|e| (0..3).map(move |c| (e, c)));
        stored(
            [9, 6],
            [7, 5],
            |_| 0.0,
            |i| Row {
                response: entries().map(|(e, c)| if gap(i, e) { 0.0 } else { value(i, e, c) as f32 }).collect(),
                variance: vec![0.0; 105],
                valid: entries().map(|(e, _)| !gap(i, e)).collect(),
            },
        )
    }

    /// The largest difference of exitances under even light, and of rows' sums, relative to the largest of both.
    fn off(reader: &MatrixReader, material: &Material) -> [f64; 2] {
        let mut sums = Marginals::new(reader).unwrap();
        reader
            .for_each_block(|block| {
                sums.add(block, [7, 5]);
                Ok(())
            })
            .unwrap();
        let (exitance, rows) = sums.filled(material);
        let found = acquire_material::relight(material, &sums.quadrature, &sums.flux, &|_| {}).unwrap();
        let pairs = exitance.planes.iter().flatten().zip(found[0].planes.iter().flatten());
        let (mut apart, mut largest) = ([0.0_f64; 2], [0.0_f64; 2]);
        for (a, b) in pairs {
            (apart[0], largest[0]) = (apart[0].max((a - b).abs()), largest[0].max(a.abs()));
        }
        for (a, b) in rows.iter().flatten().zip(row_sums(material).iter().flatten()) {
            (apart[1], largest[1]) = (apart[1].max((a - b).abs()), largest[1].max(a.abs()));
        }
        [apart[0] / largest[0], apart[1] / largest[1]]
    }

    #[test]
    fn rows_have_their_albedo_and_the_slab_its_exitance_with_one_term_and_with_gaps() {
        for with_gaps in [false, true] {
            let matrix = matrix(|i, e| with_gaps && (i * 35 + e) % 23 == 0);
            let options = FactorOptions {
                model: Some(Model::Joint),
                terms: Some(1),
                maps: Some(true),
                peak_shift: false,
                ..FactorOptions::default()
            };
            let made = factor(&matrix.reader, &options, &Progress::silent()).unwrap();
            assert!(made.material.header.exit_grid.is_some());
            let with = off(&matrix.reader, &made.material);
            let plain = FactorOptions { maps: Some(false), ..options };
            let without = off(&matrix.reader, &factor(&matrix.reader, &plain, &Progress::silent()).unwrap().material);
            // Six rounds of three fits; a dim rim is half way.
            assert!(with[0] < 5e-3 && with[1] < 5e-3, "{with:?}, {without:?} without maps");
            assert!(without[0] > 0.02 && without[1] > 0.02, "{without:?}");
        }
    }

    #[test]
    fn equal_rows_need_no_maps() {
        let matrix = stored(
            [9, 6],
            [7, 5],
            |_| 0.0,
            |_| Row {
                response: (0..105)
                    .map(|s| (-((s % 21) as f64 - 10.0).powi(2) / 30.0).exp() as f32 * (1 + s % 3) as f32)
                    .collect(),
                variance: vec![0.0; 105],
                valid: vec![true; 105],
            },
        );
        let options = FactorOptions { model: Some(Model::Joint), ..FactorOptions::default() };
        let made = factor(&matrix.reader, &options, &Progress::silent()).unwrap();
        assert_eq!((made.material.header.terms, made.material.header.exit_grid), (1, None));
    }
}
