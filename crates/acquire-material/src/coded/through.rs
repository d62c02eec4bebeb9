//! Entry and exit maps in the stream.

use super::entropy::{Reader, Writer};
use super::maps::{Group, Price};
use super::stream::{to_f32, to_f64};
use crate::parallel::*;
use crate::{CHANNELS, Exitance, Light, LitArea, Material, MaterialHeader, Quadrature, Responses, Result};
use crate::{fit_entry_map, fit_exit_map, relight};

/// How many times finer than other maps entry and exit maps are kept: an error of theirs is one of all that enters or
/// leaves at a place.
const THROUGH_FINER: f64 = 4.0;

/// What a material gives under even light, which its maps are for.
pub(super) struct EvenLight {
    pub quadrature: Quadrature,
    /// One flux.
    pub flux: Vec<Vec<[f64; CHANNELS]>>,
    pub exitance: Exitance,
    /// Sums of rows over their windows, \[N\].
    pub rows: Vec<[f64; CHANNELS]>,
}

impl EvenLight {
    /// # Errors
    /// Those of [`LitArea::of`] and [`relight`].
    pub(super) fn of(material: &Material) -> Result<Self> {
        let shape = material.shape();
        let quadrature = Quadrature::new(&LitArea::of(&shape)?, &shape);
        let flux = vec![Light::Uniform.flux(&quadrature)?];
        let exitance = relight(material, &quadrature, &flux, &|_| {})?.swap_remove(0);
        Ok(Self { exitance, rows: row_sums(material), quadrature, flux })
    }

    /// Fits the exit map of other terms to it.
    fn leave(&self, material: &mut Material) -> Result<(), String> {
        fit_exit_map(material, &self.exitance, &self.quadrature, &self.flux).map_err(|e| e.to_string())
    }
}

/// Sums of the rows of a material over their windows.
pub(super) fn row_sums(material: &Material) -> Vec<[f64; CHANNELS]> {
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

/// Writes the entry and exit maps of `decoded`, whose terms are as a decoder sees them; fitted to `even` before, the exit map
/// to the entry map as a decoder sees it, too. `norm` is ‖R̂‖.
pub(super) fn write_through(
    w: &mut Writer,
    decoded: &mut Material,
    even: Option<&EvenLight>,
    norm: f64,
    price: Price,
    first: i32,
) -> Result<(), String> {
    let Some(grid) = decoded.header.exit_grid else { return Ok(()) };
    // The sensitivity is the root of the squared response that a sample multiplies, in the mean.
    let mut write = |map: &[f32], size: [usize; 2]| -> Result<Vec<f32>, String> {
        let mut group = Group::new(size, grid.planes, first);
        let sensitivity = THROUGH_FINER * norm / (map.len() as f64).sqrt();
        let planes = map.chunks_exact(size[0] * size[1]);
        let seen: Result<Vec<_>, _> = planes.map(|plane| group.encode(w, &to_f64(plane), sensitivity, price)).collect();
        to_f32("maps", &seen?.concat())
    };
    if let Some(even) = even {
        // One round: they were right for the terms before, and of what is left a fifth remains.
        even.leave(decoded)?;
        let found = row_sums(decoded);
        fit_entry_map(decoded, &even.rows, &found);
    }
    decoded.entry_map = write(&decoded.entry_map, decoded.header.points)?;
    if let Some(even) = even {
        even.leave(decoded)?;
    }
    write(&decoded.exit_map, grid.size)?;
    Ok(())
}

/// Reads what [`write_through`] wrote.
pub(super) fn read_through(r: &mut Reader, h: &MaterialHeader, first: i32) -> Result<[Vec<f32>; 2], String> {
    let Some(grid) = h.exit_grid else { return Ok([Vec::new(), Vec::new()]) };
    let mut read = |name: &str, size: [usize; 2]| {
        let mut group = Group::new(size, grid.planes, first);
        let planes: Vec<Vec<f64>> = (0..grid.planes).map(|_| group.decode(r)).collect::<Result<_, _>>()?;
        to_f32(name, &planes.concat())
    };
    Ok([read("entry_map", h.points)?, read("exit_map", grid.size)?])
}
