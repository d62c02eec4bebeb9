//! Colour polynomials of a whole matrix: the paper's second half (`Kurt2013`, eqs. (2)–(4)).

use super::color::PolynomialBasis;
use crate::Result;
use crate::material::{Material, legendre};
use crate::progress::Progress;
use crate::transport::rows::RowView;
use crate::transport::{MatrixReader, RowBlock};
use rayon::prelude::*;

/// Arguments and values of one channel of a row, where it was measured.
pub(super) struct Channel {
    /// Window indices; empty when they are those of the first channel.
    pub at: Vec<usize>,
    /// Arguments of the polynomial, likewise.
    pub arguments: Vec<f64>,
    /// R_c, mm⁻².
    pub values: Vec<f64>,
}

/// The channels of a row whose reconstructed intensity on the common window is `intensity`.
fn channels(material: &Material, index: usize, intensity: &[f64], row: RowView<'_>) -> [Channel; 3] {
    let [low, high] = material.header.intensity_range.map(f64::from);
    let shift = material.shift.get(index).copied().unwrap_or_default();
    let layout = material.header.layout();
    let n = row.valid.len() / 3;
    let complete = row.valid.iter().fold(true, |all, &v| all & (v != 0));
    let mut out: [Channel; 3] = std::array::from_fn(|_| Channel {
        at: Vec::with_capacity(n),
        arguments: Vec::with_capacity(n),
        values: Vec::with_capacity(n),
    });
    let argument = |v: f64| legendre::argument(v, low, high);
    if complete {
        let [first, ..] = &mut out;
        layout.for_each_line(shift, |k, e, len| {
            first.at.extend(k..k + len);
            first.arguments.extend(intensity[e..e + len].iter().map(|&v| argument(v)));
        });
        for (c, channel) in out.iter_mut().enumerate() {
            layout.for_each_line(shift, |k, _, len| {
                let values = row.response[3 * k..3 * (k + len)].as_chunks::<3>().0;
                channel.values.extend(values.iter().map(|rgb| f64::from(rgb[c])));
            });
        }
        return out;
    }
    layout.for_each(shift, |k, e| {
        let argument = argument(intensity[e]);
        for (c, channel) in out.iter_mut().enumerate() {
            if row.valid[3 * k + c] != 0 {
                channel.at.push(k);
                channel.arguments.push(argument);
                channel.values.push(f64::from(row.response[3 * k + c]));
            }
        }
    });
    out
}

/// Calls `each` with the polynomial basis of every channel, made once when the channels share their samples.
pub(super) fn with_bases(
    channels: &[Channel; 3],
    degree: usize,
    mut each: impl FnMut(usize, &[usize], &[f64], &PolynomialBasis),
) {
    let [first, ..] = channels;
    let shared = PolynomialBasis::new(&first.arguments, degree);
    for (c, channel) in channels.iter().enumerate() {
        if c == 0 || channel.at == first.at || (channel.at.is_empty() && channel.values.len() == first.values.len()) {
            each(c, &first.at, &channel.values, &shared);
        } else {
            each(c, &channel.at, &channel.values, &PolynomialBasis::new(&channel.arguments, degree));
        }
    }
}

/// Fits β of all rows, one pass, and returns Σ (R̂−R)² over valid entries.
pub(super) fn color(reader: &MatrixReader, material: &mut Material, degree: usize, progress: &Progress) -> Result<f64> {
    let stage = progress.stage("color", reader.header().rows());
    material.header.degree = Some(degree);
    material.header.intensity_range = intensity_range(material);
    let mut error = 0.0;
    let mut coefficients = Vec::with_capacity(reader.header().rows() * 3 * (degree + 1));
    for range in reader.blocks() {
        let block = reader.read_responses(range.clone())?;
        let fits = rows(material, &block, |_, channels| {
            let mut fits = Vec::with_capacity(3);
            with_bases(channels, degree, |_, _, values, basis| fits.push(basis.fit(values, degree)));
            fits
        });
        for fit in fits.iter().flatten() {
            coefficients.extend_from_slice(&fit.coefficients);
            error += fit.error;
        }
        stage.advance(block.rows);
    }
    material.color_coefficients = coefficients;
    Ok(error)
}

/// What `each(k, channels)` makes of every row of a block.
pub(super) fn rows<T: Send>(
    material: &Material,
    block: &RowBlock,
    each: impl Fn(usize, &[Channel; 3]) -> T + Sync,
) -> Vec<T> {
    let samples = material.header.layout().len();
    let intensity = material.plane_block(0, block.first..block.first + block.rows);
    (0..block.rows)
        .into_par_iter()
        .map(|k| {
            let row = &intensity[k * samples..(k + 1) * samples];
            each(k, &channels(material, block.first + k, row, block.view(k)))
        })
        .collect()
}

/// The range of the reconstructed intensities over all windows.
fn intensity_range(material: &Material) -> [f32; 2] {
    let (samples, rows) = (material.header.layout().len(), material.header.rows());
    let step = ((4 << 20) / samples.max(1)).max(1);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    for first in (0..rows).step_by(step) {
        let end = (first + step).min(rows);
        let block = material.plane_block(0, first..end);
        let ranges: Vec<[f64; 2]> = (first..end)
            .into_par_iter()
            .filter(|&i| material.incident(0, i).iter().any(|&f| f != 0.0))
            .map(|i| {
                let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
                material.header.layout().for_each_line(material.shift[i], |_, e, n| {
                    for &v in &block[(i - first) * samples + e..][..n] {
                        (low, high) = (low.min(v), high.max(v));
                    }
                });
                [low, high]
            })
            .collect();
        for range in ranges {
            (low, high) = (low.min(range[0]), high.max(range[1]));
        }
    }
    // Rounded outwards: arguments are clamped to the range, and none that was fitted may be.
    if low < high { [(low as f32).next_down(), (high as f32).next_up()] } else { [0.0, 1.0] }
}
