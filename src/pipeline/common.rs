//! What of the rows' variance is no noise of single samples.

use super::lattice::{LightCorrections, ShotResult};
use super::scene::Scene;
use crate::transport::{CommonErrors, CommonOfAll};

/// The errors that samples of a row, and rows, have in common. `left_by_others`: variance by sample that separating the
/// dots of a shot has left.
///
/// Not counted: the dot's size in projector pixels, which is taken from `capture.toml` as it is; reconstruction beside the
/// peak, which counts as independent.
pub(super) fn common_errors(
    scene: &Scene<'_>,
    light: &LightCorrections,
    results: &[ShotResult],
    left_by_others: &[f64],
) -> CommonErrors {
    let manifest = &scene.capture.manifest;
    let row_len = 3 * manifest.window.samples[0] * manifest.window.samples[1];
    let mut common = CommonErrors::none(manifest.grid.len(), row_len);
    let white = light.flicker.white_variance() + scene.capture.rig.white_reference.relative_sd.powi(2);
    let exposed = scene.photographs.light_variance();
    let drift_sd_px = results.iter().filter_map(|r| r.drift).map(|d| d.common_sd_px).fold(0.0, f64::max);
    common.of_all = CommonOfAll {
        scale_sd: [(white + exposed + scene.registration.dot_area_variance()).sqrt(); 3],
        position_sd_mm: scene.registration.position_sd_mm.hypot(drift_sd_px / scene.px_per_mm),
    };
    let (mut flux, mut lit_points) = ([0.0; 3], 0.0_f64);
    for lit in results.iter().flat_map(|r| &r.lit) {
        common.row_scale_sd[manifest.grid.row_index(lit.dot)] = lit.scale_variance.map(f64::sqrt);
        (0..3).for_each(|c| flux[c] += lit.flux[c]);
        lit_points += 1.0;
    }
    // Ambient light that black shots do not have is in all samples alike.
    let even = light.stray.even.unwrap_or(0.0);
    let ambient = flux.map(|f| if f > 0.0 { (even * lit_points / f).powi(2) } else { 0.0 });
    for (k, sd) in common.sample_sd.iter_mut().enumerate() {
        *sd = (left_by_others.get(k).copied().unwrap_or(0.0) + ambient[k % 3]).sqrt();
    }
    common
}
