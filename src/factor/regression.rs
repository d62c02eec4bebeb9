//! Colour polynomials of a whole matrix: the paper's second half (`Kurt2013`, eqs. (2)–(4)).

use super::color::{Fit, PolynomialBasis};
use super::moments::{CompleteRow, MomentFits};
use super::tasks::{Pass, Passes};
use super::vector;
use crate::Result;
use crate::material::{Material, Responses, legendre};
use crate::progress::Progress;
use crate::transport::rows::{RowView, is_complete};
use crate::transport::{MatrixReader, RowBlock};
use rayon::prelude::*;
use std::ops::Range;

/// Rows whose intensities are made together: they stay in the processor's cache.
const TOGETHER: usize = 16;

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
    let complete = is_complete(row.valid);
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

/// Fits of a row that was measured everywhere, from sums over it, where that is as good.
fn of_sums(
    quick: &MomentFits,
    material: &Material,
    index: usize,
    intensity: &[f64],
    row: RowView<'_>,
) -> Option<[Fit; 3]> {
    if !is_complete(row.valid) {
        return None;
    }
    let (layout, shift) = (material.header.layout(), material.shift.get(index).copied().unwrap_or_default());
    let mut lines = Vec::with_capacity(layout.window[1]);
    layout.for_each_line(shift, |k, e, len| lines.push((k, e, len)));
    let interval = material.header.intensity_range.map(f64::from);
    quick.fit(&CompleteRow { lines: &lines, response: row.response.as_chunks().0, intensity, interval })
}

/// Fits β of all rows, one pass, and returns Σ (R̂−R)² over valid entries.
pub(super) fn color(matrix: Passes<'_>, material: &mut Material, degree: usize) -> Result<f64> {
    let all = 0..material.header.rows();
    material.header.degree = Some(degree);
    material.header.intensity_range = intensity_range(material, std::iter::once(all.clone()));
    let (coefficients, error) = match matrix.tasks {
        Some(tasks) => tasks.colors(Pass::Color { material: (&*material).into(), degree })?,
        None => colors_of(matrix.reader, material, degree, all, matrix.progress)?,
    };
    material.color_coefficients = coefficients;
    Ok(error)
}

/// β of some rows, and what they leave of them.
pub(super) fn colors_of(
    reader: &MatrixReader,
    material: &Material,
    degree: usize,
    rows: Range<usize>,
    progress: &Progress,
) -> Result<(Vec<f32>, f64)> {
    let stage = progress.stage("factor: colour", rows.len());
    let mut error = 0.0;
    let mut coefficients = Vec::with_capacity(rows.len() * 3 * (degree + 1));
    let (responses, quick) = (Responses::new(material), MomentFits::new(degree));
    reader.for_each_block_of(rows, false, |block| {
        let fits = intensities(&responses, block, |k, intensity| {
            let (index, row) = (block.first + k, block.view(k));
            if let Some(fits) = of_sums(&quick, responses.material(), index, intensity, row) {
                return fits.into();
            }
            let mut fits = Vec::with_capacity(3);
            let channels = channels(responses.material(), index, intensity, row);
            with_bases(&channels, degree, |_, _, values, basis| fits.push(basis.fit(values, degree)));
            fits
        });
        for fit in fits.iter().flatten() {
            coefficients.extend_from_slice(&fit.coefficients);
            error += fit.error;
        }
        stage.advance(block.rows);
        Ok(())
    })?;
    Ok((coefficients, error))
}

/// What `each(k, channels)` makes of every row of a block.
pub(super) fn rows<T: Send>(
    responses: &Responses<'_>,
    block: &RowBlock,
    each: impl Fn(usize, &[Channel; 3]) -> T + Sync,
) -> Vec<T> {
    intensities(responses, block, |k, intensity| {
        each(k, &channels(responses.material(), block.first + k, intensity, block.view(k)))
    })
}

/// What `each(k, intensity)` makes of the reconstructed intensity of every row of a block, on the common window.
fn intensities<T: Send>(
    responses: &Responses<'_>,
    block: &RowBlock,
    each: impl Fn(usize, &[f64]) -> T + Sync,
) -> Vec<T> {
    let samples = responses.material().header.layout().len().max(1);
    let groups = (0..block.rows.div_ceil(TOGETHER)).into_par_iter().map(|group| {
        let range = group * TOGETHER..((group + 1) * TOGETHER).min(block.rows);
        let indices: Vec<usize> = range.clone().map(|k| block.first + k).collect();
        let intensity = responses.plane(0, &indices);
        range.zip(intensity.chunks_exact(samples)).map(|(k, row)| each(k, row)).collect::<Vec<T>>()
    });
    groups.collect::<Vec<_>>().into_iter().flatten().collect()
}

/// The range of the reconstructed intensities over the windows of some rows.
pub(super) fn intensity_range(material: &Material, rows: impl IntoIterator<Item = Range<usize>>) -> [f32; 2] {
    let samples = material.header.layout().len().max(1);
    let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
    let responses = Responses::new(material);
    for rows in rows {
        let (first, count) = (rows.start, rows.len());
        let ranges = (0..count.div_ceil(TOGETHER)).into_par_iter().map(|group| {
            let indices = first + group * TOGETHER..first + ((group + 1) * TOGETHER).min(count);
            let indices: Vec<usize> = indices.filter(|&i| material.incident(0, i).iter().any(|&f| f != 0.0)).collect();
            let intensity = responses.plane(0, &indices);
            let mut range = [f64::INFINITY, f64::NEG_INFINITY];
            for (&i, row) in indices.iter().zip(intensity.chunks_exact(samples)) {
                material.header.layout().for_each_line(material.shift[i], |_, e, n| {
                    let [low, high] = vector::range(&row[e..e + n]);
                    range = [range[0].min(low), range[1].max(high)];
                });
            }
            range
        });
        for range in ranges.collect::<Vec<_>>() {
            (low, high) = (low.min(range[0]), high.max(range[1]));
        }
    }
    // Rounded outwards: arguments are clamped to the range, and none that was fitted may be.
    if low < high { [(low as f32).next_down(), (high as f32).next_up()] } else { [0.0, 1.0] }
}

#[cfg(test)]
mod tests {
    use super::super::test_matrices::{StoredMatrix, solved, stored};
    use super::*;
    use crate::material::{MaterialHeader, Model};
    use crate::transport::Row;

    const POINTS: [usize; 2] = [3, 2];
    const WINDOW: [usize; 2] = [7, 5];
    const EXTENDED: [usize; 2] = [9, 7];
    const SHIFTS: [[i16; 2]; 6] = [[0, 0], [1, -1], [0, 1], [-1, 0], [1, 1], [0, 0]];
    const DEGREE: usize = 2;

    fn valid(i: usize, k: usize, c: usize) -> bool {
        !(i == 1 && (k * 5 + c * 3).is_multiple_of(7) || i == 3 && k < 7)
    }

    fn response(i: usize, k: usize, c: usize) -> f64 {
        0.3 + 0.1 * ((k * k + 3 * k * (c + 1) + 5 * i) % 19) as f64 * (1.0 + 0.5 * c as f64)
    }

    fn matrix() -> StoredMatrix {
        stored(
            POINTS,
            WINDOW,
            |_| 0.0,
            |i| Row {
                response: (0..105)
                    .map(|s| if valid(i, s / 3, s % 3) { response(i, s / 3, s % 3) as f32 } else { 0.0 })
                    .collect(),
                variance: vec![0.0; 105],
                valid: (0..105).map(|s| valid(i, s / 3, s % 3)).collect(),
            },
        )
    }

    /// Two terms without a polynomial.
    fn material() -> Material {
        let samples = EXTENDED[0] * EXTENDED[1];
        Material {
            entry_map: Vec::new(),
            exit_map: Vec::new(),
            header: MaterialHeader {
                exit_grid: None,
                model: Model::Tucker,
                points: POINTS,
                window: WINDOW,
                pitch_mm: 0.25,
                lit_pitch_mm: [0.5, 0.75],
                extended: EXTENDED,
                terms: 2,
                incident_planes: 1,
                offset_planes: 1,
                shared_maps: None,
                profile: false,
                degree: None,
                intensity_range: [0.0, 1.0],
                singular_values: Vec::new(),
                noise_level: 0.0,
                warnings: Vec::new(),
                provenance: serde_json::Value::Null,
            },
            lit_mm: vec![[0.0; 2]; 6],
            weights: vec![2.0, 0.5],
            incident_factors: (0..12).map(|k| 0.25 + ((k * 5) % 7) as f32 * 0.125).collect(),
            offset_factors: (0..2 * samples).map(|k| ((k * k) % 23) as f32 / 23.0 - 0.2).collect::<Vec<_>>().into(),
            profile: Vec::new(),
            color_coefficients: Vec::new(),
            shift: SHIFTS.to_vec(),
        }
    }

    /// The intensity that the terms give at sample k of the window of row i.
    fn intensity(m: &Material, i: usize, k: usize) -> f64 {
        let x = (k % 7) as isize - 3 - isize::from(SHIFTS[i][0]) + 4;
        let y = (k / 7) as isize - 2 - isize::from(SHIFTS[i][1]) + 3;
        let e = (x + 9 * y) as usize;
        let term = |j: usize| {
            f64::from(m.weights[j])
                * f64::from(m.incident_factors[2 * i + j])
                * f64::from(m.offset_factors.all()[63 * j + e])
        };
        term(0) + term(1)
    }

    #[test]
    fn every_channel_of_every_row_is_fitted_as_its_normal_equations_say() {
        let (stored, mut fitted) = (matrix(), material());
        let error = color(Passes::here(&stored.reader, &Progress::silent()), &mut fitted, DEGREE).unwrap();
        let all: Vec<f64> =
            (0..6).flat_map(|i| (0..35).map(move |k| (i, k))).map(|(i, k)| intensity(&fitted, i, k)).collect();
        let (low, high) = all.iter().fold((f64::MAX, f64::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        let [found_low, found_high] = fitted.header.intensity_range.map(f64::from);
        // Rounded outwards to the next f32 or the one after.
        assert!(found_low < low && found_low > low - 3e-7 && found_high > high && found_high < high + 6e-7);
        assert_eq!((fitted.header.degree, fitted.color_coefficients.len()), (Some(DEGREE), 6 * 3 * 3));
        let mut left = 0.0;
        for i in 0..6 {
            for c in 0..3 {
                let samples: Vec<usize> = (0..35).filter(|&k| valid(i, k, c)).collect();
                let basis = |k: usize| {
                    let u = 2.0 * (intensity(&fitted, i, k) - found_low) / (found_high - found_low) - 1.0;
                    [1.0, u, 1.5 * u * u - 0.5]
                };
                let sum = |f: &dyn Fn(usize) -> f64| samples.iter().map(|&k| f(k)).sum::<f64>();
                let gram = (0..3).map(|a| (0..3).map(|b| sum(&|k| basis(k)[a] * basis(k)[b])).collect()).collect();
                let right = (0..3).map(|a| sum(&|k| basis(k)[a] * f64::from(response(i, k, c) as f32))).collect();
                let beta = solved(gram, right);
                for p in 0..3 {
                    let found = f64::from(fitted.color_coefficients[(i * 3 + c) * 3 + p]);
                    // Rounded to f32; coefficients are of size one.
                    assert!((found - beta[p]).abs() < 1e-6, "row {i} channel {c} degree {p}: {found} {}", beta[p]);
                }
                left += sum(&|k| {
                    let fit: f64 = (0..3).map(|p| beta[p] * basis(k)[p]).sum();
                    (fit - f64::from(response(i, k, c) as f32)).powi(2)
                });
            }
        }
        // The energy less the fitted shares: some eps of the energy, and what rounding coefficients adds.
        assert!((error / left - 1.0).abs() < 1e-9, "{error} {left}");
    }

    #[test]
    fn channels_measured_alike_share_a_basis_and_others_have_their_own() {
        let (stored, material) = (matrix(), material());
        let block = stored.reader.read_responses(0..6).unwrap();
        let found = rows(&Responses::new(&material), &block, |_, channels| {
            let mut seen = Vec::new();
            with_bases(channels, 1, |c, at, values, basis| {
                assert_eq!((at.len(), values.len()), (values.len(), channels[c].values.len()));
                assert_eq!(basis.project(values).len(), 2);
                seen.push((c, at.to_vec(), values.to_vec()));
            });
            seen
        });
        for (i, row) in found.into_iter().enumerate() {
            assert_eq!(row.len(), 3);
            for (c, at, values) in row {
                let expected: Vec<usize> = (0..35).filter(|&k| valid(i, k, c)).collect();
                assert_eq!(at, expected, "row {i} channel {c}");
                let expected: Vec<f64> = expected.iter().map(|&k| f64::from(response(i, k, c) as f32)).collect();
                assert_eq!(values, expected);
            }
        }
    }

    #[test]
    fn rows_of_zeros_do_not_count_in_the_range_and_constants_have_a_plain_one() {
        let mut m = material();
        m.offset_factors = vec![0.5; m.offset_factors.all().len()].into();
        m.incident_factors = (0..12).map(|k| if k / 2 == 4 { 0.0 } else { 1.0 + (k / 2) as f32 }).collect();
        // Row i is 2.5 · (1 + i) · 0.5 everywhere; row 4 is no row.
        let [low, high] = intensity_range(&m, [0..2, 2..6]);
        assert!(low < 1.25 && low > 1.249_999 && high > 7.5 && high < 7.500_002, "{low} {high}");
        m.incident_factors.fill(0.0);
        assert_eq!(intensity_range(&m, std::iter::once(0..6)), [0.0, 1.0]);
    }
}
