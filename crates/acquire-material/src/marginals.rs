//! Fitting entry and exit maps: what a material's rows and its slab under even light lack, put into two maps by
//! iterative proportional fitting (`DemingStephan1940`, `SinkhornKnopp1967`).

use crate::exitance::Exitance;
use crate::parallel::*;
use crate::quadrature::Quadrature;
use crate::relight::relight;
use crate::response::Responses;
use crate::{CHANNELS, Light, LitArea, Material, Result};

/// Where this share of the largest exitance leaves, or of the largest albedo enters, a map goes half the way to its value:
/// the terms say so little there that their ratio to what was measured is noise. What that leaves of the
/// exitance's misfit is a millionth of it where the slab is bright, and less than this share of the largest where it is
/// dark.
const DIM: f64 = 1e-3;
/// A map never changes light by more than this.
const MOST: f64 = 30.0;

/// What the maps of a material are to give: for every lit point the sum of its row over the window (in units of R̂_d,
/// mm⁻²; times a cell's area its albedo), and the slab's exitance under even light.
#[derive(Debug, Clone)]
pub struct Marginals {
    /// How light becomes light into rows.
    pub quadrature: Quadrature,
    /// Even light, one flux.
    pub flux: Vec<Vec<[f64; CHANNELS]>>,
    /// What leaves under it.
    pub exitance: Exitance,
    /// Sums of rows, \[N\].
    pub rows: Vec<[f64; CHANNELS]>,
}

impl Marginals {
    /// Those of a material.
    ///
    /// # Errors
    /// Those of [`LitArea::of`] and [`relight`].
    pub fn of(material: &Material) -> Result<Self> {
        let shape = material.shape();
        let quadrature = Quadrature::new(&LitArea::of(&shape)?, &shape);
        let flux = vec![Light::Uniform.flux(&quadrature)?];
        let exitance = relight(material, &quadrature, &flux, &|_| {})?.swap_remove(0);
        Ok(Self { exitance, rows: row_sums(material), quadrature, flux })
    }

    /// Multiplies the entry map of a material with an exit grid by what its rows lack of their sums.
    pub fn enter(&self, material: &mut Material, row_sums: impl Fn(&Material) -> Vec<[f64; CHANNELS]>) {
        let Some(grid) = material.header.exit_grid else { return };
        let rows = material.header.rows();
        let found = row_sums(material);
        let channel = |of: &[[f64; CHANNELS]], c: usize| of.iter().map(|v| v[c]).collect::<Vec<f64>>();
        let by_plane = |of: &[[f64; CHANNELS]]| shared(&[0, 1, 2].map(|c| channel(of, c)), grid.planes);
        for (plane, (wanted, found)) in by_plane(&self.rows).iter().zip(by_plane(&found)).enumerate() {
            let to = &mut material.entry_map[plane * rows..][..rows];
            to.iter_mut().zip(ratios(wanted, &found)).for_each(|(to, a)| *to = (f64::from(*to) * a) as f32);
        }
    }

    /// Multiplies the exit map of a material with an exit grid by what it lacks of its exitance.
    ///
    /// # Errors
    /// Those of [`relight`].
    pub fn leave(&self, material: &mut Material) -> Result<()> {
        let Some(grid) = material.header.exit_grid else { return Ok(()) };
        let samples = grid.size[0] * grid.size[1];
        let found = relight(material, &self.quadrature, &self.flux, &|_| {})?;
        let wanted = shared(&self.exitance.planes, grid.planes);
        for (plane, (wanted, found)) in wanted.iter().zip(shared(&found[0].planes, grid.planes)).enumerate() {
            let to = &mut material.exit_map[plane * samples..][..samples];
            to.iter_mut().zip(ratios(wanted, &found)).for_each(|(to, e)| *to = (f64::from(*to) * e) as f32);
        }
        Ok(())
    }
}

/// Sums of the rows of a material over their windows.
pub(crate) fn row_sums(material: &Material) -> Vec<[f64; CHANNELS]> {
    let responses = Responses::new(material);
    let sum = |index: usize| {
        let mut sum = [0.0; CHANNELS];
        for rgb in responses.row(index).as_chunks::<CHANNELS>().0 {
            (0..CHANNELS).for_each(|c| sum[c] += f64::from(rgb[c]));
        }
        sum
    };
    (0..material.header.rows()).into_par_iter().map(sum).collect()
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
