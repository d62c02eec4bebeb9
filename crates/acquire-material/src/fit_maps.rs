//! Fitting entry and exit maps: what a material's rows and its slab under even light lack, put into two maps by
//! iterative proportional fitting (`DemingStephan1940`, `SinkhornKnopp1967`).

use crate::{CHANNELS, Exitance, Material, Quadrature, Result, relight};

/// Where this share of the largest exitance leaves, or of the largest albedo enters, a map goes half the way to its value:
/// the terms say so little there that their ratio to what was measured is noise. What that leaves of the
/// exitance's misfit is a millionth of it where the slab is bright, and less than this share of the largest where it is
/// dark.
const DIM: f64 = 1e-3;
/// A map never changes light by more than this.
const MOST: f64 = 30.0;

/// Multiplies the entry map of a material with an exit grid by what its rows lack: `wanted` and `found` are the sums of
/// all rows over their windows, \[N\].
///
/// Does not detect sums that cancel: where responses of both signs leave nearly nothing, their ratio says nothing of a map.
pub fn fit_entry_map(material: &mut Material, wanted: &[[f64; CHANNELS]], found: &[[f64; CHANNELS]]) {
    let Some(grid) = material.header.exit_grid else { return };
    let channels = |of: &[[f64; CHANNELS]]| [0, 1, 2].map(|c| of.iter().map(|v| v[c]).collect());
    multiply(&mut material.entry_map, grid.planes, &channels(wanted), &channels(found));
}

/// Multiplies the exit map of a material with an exit grid by what the slab lacks of its exitance under the light `flux`
/// on the cells of `quadrature`, on whose canvas the map and `wanted` lie.
///
/// Does not detect what [`fit_entry_map`] does not.
///
/// # Errors
/// Those of [`relight`].
pub fn fit_exit_map(
    material: &mut Material,
    wanted: &Exitance,
    quadrature: &Quadrature,
    flux: &[Vec<[f64; CHANNELS]>],
) -> Result<()> {
    let Some(grid) = material.header.exit_grid else { return Ok(()) };
    let found = relight(material, quadrature, flux, &|_| {})?;
    multiply(&mut material.exit_map, grid.planes, &wanted.planes, &found[0].planes);
    Ok(())
}

/// Multiplies a map of `planes` planes by what `found` is to be multiplied by to become `wanted`.
fn multiply(map: &mut [f32], planes: usize, wanted: &[Vec<f64>; CHANNELS], found: &[Vec<f64>; CHANNELS]) {
    let samples = map.len() / planes.max(1);
    let pairs = shared(wanted, planes).into_iter().zip(shared(found, planes));
    for (to, (wanted, found)) in map.chunks_exact_mut(samples.max(1)).zip(pairs) {
        to.iter_mut().zip(ratios(&wanted, &found)).for_each(|(to, ratio)| *to = (f64::from(*to) * ratio) as f32);
    }
}

/// Three channels, or their sum where one map is for all of them.
fn shared(channels: &[Vec<f64>; CHANNELS], planes: usize) -> Vec<Vec<f64>> {
    if planes == CHANNELS {
        return channels.to_vec();
    }
    let [r, g, b] = channels;
    vec![r.iter().zip(g).zip(b).map(|((r, g), b)| r + g + b).collect()]
}

/// What `found` is to be multiplied by to become `wanted`, drawn towards one where there is nearly nothing.
fn ratios(wanted: &[f64], found: &[f64]) -> Vec<f64> {
    let dim = DIM * found.iter().fold(0.0_f64, |a, v| a.max(v.abs()));
    let ratio = |(&wanted, &found): (&f64, &f64)| {
        let ratio = (wanted * found + dim * dim) / (found * found + dim * dim);
        // Light that the terms would have below zero is not turned over: nothing is left of it.
        if ratio.is_finite() { ratio.clamp(1.0 / MOST, MOST) } else { 1.0 }
    };
    wanted.iter().zip(found).map(ratio).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_are_those_asked_for_where_there_is_light_and_one_where_there_is_none() {
        let found = ratios(&[2.0, 0.5, 1e-9, 0.0], &[1.0, 1.0, 3e-9, 0.0]);
        // A millionth is what the dim share leaves.
        assert!((found[0] - 2.0).abs() < 2e-6 && (found[1] - 0.5).abs() < 2e-6, "{found:?}");
        assert!((found[2] - 1.0).abs() < 1e-2 && found[3] == 1.0, "{found:?}");
        assert_eq!(ratios(&[1.0], &[-1.0]), [1.0 / MOST], "light is not turned over");
        assert_eq!(ratios(&[0.0; 3], &[0.0; 3]), [1.0; 3]);
    }
}
