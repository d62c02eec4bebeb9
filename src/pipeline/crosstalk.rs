//! The dots of one shot light each other's windows: taking that out once all rows are there.

use super::lattice::{ShotResult, albedo};
use super::scene::Scene;
use super::sink::RowSink;
use crate::geometry::Point;
use crate::progress::Progress;
use crate::response::{LitRow, Separation, TailModel, fit_tails, reach_mm};
use crate::{ResponseWarning, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Rows that the model is fitted to, about; more would only take longer.
const FITTED_ROWS: usize = 1500;
/// Rows are told apart well enough when the other dots make them uncertain by no more than this share of themselves.
const ENOUGH: f64 = 0.01;

/// What was done about cross-talk.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CrossTalk {
    /// The smallest distance between dots of one shot, in outgoing samples.
    pub spacing_samples: f64,
    /// The smallest distance at which the other dots make a row uncertain by no more than 1 % of itself, by the fitted
    /// model of an even slab; `None` when two windows are not enough.
    pub needed_samples: Option<usize>,
    /// Share of the light in the windows that was put to other dots.
    pub removed_share: f64,
    /// Share of the samples that are modelled rather than measured.
    pub modelled_share: f64,
    /// Share of a row's light by which it may still be too bright or too dark, all rows alike: one standard deviation.
    pub common_share: f64,
}

impl CrossTalk {
    /// A finding when the spacing is smaller than it should be.
    pub(super) fn warning(&self) -> Option<ResponseWarning> {
        let Self { spacing_samples, needed_samples, removed_share, modelled_share, common_share } = *self;
        let enough = needed_samples.is_some_and(|needed| spacing_samples >= needed as f64);
        (!enough).then_some(ResponseWarning::CrossTalk {
            spacing_samples,
            needed_samples,
            removed_share,
            modelled_share,
            common_share,
        })
    }
}

/// The smallest distance of dots, samples, where the light of one can be in another's window.
pub(super) fn overlap_samples(scene: &Scene<'_>) -> Option<f64> {
    let window = &scene.capture.manifest.window;
    scene.smallest_spacing().filter(|spacing| spacing * window.pitch_mm <= reach_mm(window))
}

/// Leaves in each row the light of its own dot; with it, the variance by sample that this leaves, mean over rows. `None`
/// when no dot's light can reach another's window, or no row holds any.
pub(super) fn separate(
    scene: &Scene<'_>,
    results: &mut [ShotResult],
    rows: &impl RowSink,
    progress: &Progress,
) -> Result<Option<(CrossTalk, Vec<f64>)>> {
    let manifest = &scene.capture.manifest;
    let Some(spacing_samples) = overlap_samples(scene) else { return Ok(None) };
    let stage = progress.stage("separate", results.len());
    let rows_of = |result: &ShotResult| -> Result<Vec<LitRow>> {
        let row = |lit: &super::lattice::LitPoint| {
            let row = rows.row(manifest.grid.row_index(lit.dot))?;
            Ok(LitRow { center_mm: lit.center_mm, flux: lit.flux, row })
        };
        result.lit.iter().map(row).collect()
    };
    let Some(model) = fit(scene, results, rows_of)? else { return Ok(None) };
    let found: Vec<Separation> = results
        .par_iter_mut()
        .map(|result| {
            let mut measured = rows_of(result)?;
            let found = model.separate(&mut measured, &manifest.window);
            for (lit, separated) in result.lit.iter_mut().zip(&measured) {
                rows.replace(manifest.grid.row_index(lit.dot), &separated.row)?;
                lit.albedo = albedo(&separated.row, &manifest.window);
            }
            stage.advance(1);
            Ok(found)
        })
        .collect::<Result<_>>()?;
    let mut sum = Separation::default();
    found.iter().for_each(|f| sum.add(f));
    let share = |part: f64, whole: f64| if whole > 0.0 { part / whole } else { 0.0 };
    let crosstalk = CrossTalk {
        spacing_samples,
        needed_samples: model.spacing_for(ENOUGH, &manifest.window),
        removed_share: share(sum.removed, sum.light),
        modelled_share: share(sum.modelled as f64, sum.samples as f64),
        common_share: model.left_at(spacing_samples, &manifest.window).light_share,
    };
    Ok(Some((crosstalk, sum.mean_variance())))
}

/// Fits the model to shots that are spread over the sweep.
fn fit(
    scene: &Scene<'_>,
    results: &[ShotResult],
    rows_of: impl Fn(&ShotResult) -> Result<Vec<LitRow>>,
) -> Result<Option<TailModel>> {
    let manifest = &scene.capture.manifest;
    let rows: usize = results.iter().map(|r| r.lit.len()).sum();
    let lit: Vec<&ShotResult> = results.iter().filter(|r| !r.lit.is_empty()).collect();
    let wanted = (lit.len() * FITTED_ROWS).div_ceil(rows.max(1)).min(lit.len());
    // Golden steps spread over the sweep whatever its rhythm.
    let place = |k: usize| ((k as f64 * 0.618_033_988_75).fract() * lit.len() as f64) as usize;
    let chosen: std::collections::BTreeSet<usize> =
        if wanted == lit.len() { (0..lit.len()).collect() } else { (0..wanted).map(place).collect() };
    let shots: Vec<Vec<LitRow>> = chosen.into_iter().map(|k| rows_of(lit[k])).collect::<Result<_>>()?;
    let size_mm: Point = manifest.slab.size_mm;
    Ok(fit_tails(&shots, &manifest.window, size_mm))
}
