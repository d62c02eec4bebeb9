//! What photons leave behind, and how sure its mean is.

use super::{Rings, TallyWindow};
use serde::Serialize;

/// A mean over photons, per unit of flux that arrives, and its standard error from the scatter of the batches.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Estimate {
    /// The mean.
    pub mean: f64,
    /// Its standard error.
    pub standard_error: f64,
}

/// A map over the cells of a [`TallyWindow`], row-major, mm⁻².
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// Means over each cell.
    pub mean: Vec<f64>,
    /// Their standard errors.
    pub standard_error: Vec<f64>,
}

/// Everything that photons were counted into.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome {
    /// Photons traced.
    pub photons: u64,
    /// Reflected by the face before entering; exact.
    pub specular: f64,
    /// Left through the top, after entering.
    pub reflected: Estimate,
    /// Left through the bottom.
    pub transmitted: Estimate,
    /// The part of it that was scattered at least once.
    pub diffuse: Estimate,
    /// The part of it that was not.
    pub ballistic: Estimate,
    /// Absorbed.
    pub absorbed: Estimate,
    /// Left through the sides.
    pub sides: Estimate,
    /// What was reflected, transmitted, absorbed and lost in all: 1 within its error.
    pub spent: Estimate,
    /// Exitance through the top by distance from the beam's centre, mm⁻²; one estimate for each ring.
    pub rings: Vec<Estimate>,
    /// Exitance through the top over the window, mm⁻².
    pub exitance: Option<Map>,
    /// π times the radiance towards the eye over the window, mm⁻².
    pub radiance: Option<Map>,
}

/// The sums of one batch.
#[derive(Debug, Clone)]
pub(super) struct Tally {
    pub photons: u64,
    pub reflected: f64,
    pub diffuse: f64,
    pub ballistic: f64,
    pub absorbed: f64,
    pub sides: f64,
    pub rings: Vec<f64>,
    pub exitance: Vec<f64>,
    pub radiance: Vec<f64>,
}

impl Tally {
    pub(super) fn new(rings: Option<&Rings>, exitance: Option<&TallyWindow>, radiance: Option<&TallyWindow>) -> Self {
        let cells = |w: Option<&TallyWindow>| vec![0.0; w.map_or(0, |w| w.cells[0] * w.cells[1])];
        Self {
            photons: 0,
            reflected: 0.0,
            diffuse: 0.0,
            ballistic: 0.0,
            absorbed: 0.0,
            sides: 0.0,
            rings: vec![0.0; rings.map_or(0, |r| r.count)],
            exitance: cells(exitance),
            radiance: cells(radiance),
        }
    }
}

/// Σ over batches of their means and of the means' squares.
#[derive(Debug, Clone, Default)]
struct Moments {
    sum: Vec<f64>,
    squares: Vec<f64>,
    batches: f64,
}

impl Moments {
    /// Adds a batch whose sums are `sums`.
    fn add(&mut self, sums: &[f64], per_photon: f64) {
        self.sum.resize(sums.len(), 0.0);
        self.squares.resize(sums.len(), 0.0);
        for ((sum, square), of_batch) in self.sum.iter_mut().zip(&mut self.squares).zip(sums) {
            let mean = of_batch * per_photon;
            *sum += mean;
            *square += mean * mean;
        }
        self.batches += 1.0;
    }

    fn estimate(&self, i: usize) -> Estimate {
        let n = self.batches;
        let mean = self.sum[i] / n;
        let variance = (self.squares[i] / n - mean * mean).max(0.0) / (n - 1.0).max(1.0);
        Estimate { mean, standard_error: variance.sqrt() }
    }

    fn map(&self) -> Map {
        let all = (0..self.sum.len()).map(|i| self.estimate(i));
        let (mean, standard_error) = all.map(|e| (e.mean, e.standard_error)).unzip();
        Map { mean, standard_error }
    }
}

/// Batches of equal size put together, in their order.
#[derive(Debug, Default)]
pub(super) struct Collected {
    photons: u64,
    totals: Moments,
    rings: Moments,
    exitance: Moments,
    radiance: Moments,
}

impl Collected {
    pub(super) fn add(&mut self, tally: &Tally) {
        let per_photon = 1.0 / tally.photons as f64;
        let transmitted = tally.diffuse + tally.ballistic;
        let all = tally.reflected + transmitted + tally.absorbed + tally.sides;
        let totals = [tally.reflected, transmitted, tally.diffuse, tally.ballistic, tally.absorbed, tally.sides, all];
        self.photons += tally.photons;
        self.totals.add(&totals, per_photon);
        self.rings.add(&tally.rings, per_photon);
        self.exitance.add(&tally.exitance, per_photon);
        self.radiance.add(&tally.radiance, per_photon);
    }

    /// The estimates; `specular` was taken off before entering.
    pub(super) fn finish(self, specular: f64, rings: Option<&Rings>, window: Option<&TallyWindow>) -> Outcome {
        let [reflected, transmitted, diffuse, ballistic, absorbed, sides, all] =
            std::array::from_fn(|i| self.totals.estimate(i));
        let per_area =
            |e: Estimate, area: f64| Estimate { mean: e.mean / area, standard_error: e.standard_error / area };
        let map = |moments: &Moments| {
            let area = window.map_or(1.0, |w| w.cell_mm * w.cell_mm);
            let mut map = moments.map();
            map.mean.iter_mut().chain(&mut map.standard_error).for_each(|v| *v /= area);
            (!map.mean.is_empty()).then_some(map)
        };
        Outcome {
            photons: self.photons,
            specular,
            reflected,
            transmitted,
            diffuse,
            ballistic,
            absorbed,
            sides,
            spent: Estimate { mean: all.mean + specular, ..all },
            rings: rings.map_or(Vec::new(), |rings| {
                (0..rings.count).map(|i| per_area(self.rings.estimate(i), rings.area_mm2(i))).collect()
            }),
            exitance: map(&self.exitance),
            radiance: map(&self.radiance),
        }
    }
}
