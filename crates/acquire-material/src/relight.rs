//! Relighting: the exitance of the slab under a light, rows added where they leave the slab.

use crate::convolve::{convolve, parts};
use crate::exitance::{Canvas, Exitance};
use crate::parallel::*;
use crate::quadrature::Quadrature;
use crate::response::Responses;
use crate::splat::splat;
use crate::{CHANNELS, Material, Result};

/// Numbers in a block of a material's rows.
const BLOCK: usize = 1 << 20;

/// The exitance of a material under several lights at once, each given as the flux into every cell of `quadrature`
/// ([`crate::Light::flux`]).
///
/// Where the material has an exit map, it multiplies what leaves at each sample of the canvas: the light that enters
/// between lit points leaves through the surface as it is where it leaves. Rows without light are not evaluated. The
/// rows of a material without a colour polynomial are added by convolution where that is faster, as far as their
/// shifted windows have a part in common: what they leave between samples that differ by more than 15 decades is
/// rounding. `done` is told of rows as they are added.
///
/// # Errors
/// [`crate::Error::Internal`].
pub fn relight(
    material: &Material,
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
    done: &dyn Fn(usize),
) -> Result<Vec<Exitance>> {
    let shape = material.shape();
    let canvas = quadrature.canvas();
    let mut out: Vec<Exitance> = fluxes.iter().map(|_| Exitance::new(canvas)).collect();
    let lit: Vec<usize> = (0..shape.rows()).filter(|&i| quadrature.is_lit(i, fluxes)).collect();
    done(shape.rows() - lit.len());
    let (core, convolved, others) = parts(material, lit, quadrature, fluxes);
    let whole = Responses::entering(material, None);
    if let Some(core) = core {
        convolve(&mut out, &whole, &core, &convolved, quadrature, fluxes)?;
        add(&mut out, &Responses::entering(material, Some(core)), &convolved, quadrature, fluxes, done);
    }
    add(&mut out, &whole, &others, quadrature, fluxes, done);
    if material.header.exit_grid.is_some() {
        out.iter_mut().for_each(|image| leave(material, image));
    }
    Ok(out)
}

/// Multiplies an image by the exit map.
fn leave(material: &Material, image: &mut Exitance) {
    let Canvas { origin_mm, size, pitch_mm } = image.canvas;
    for (c, plane) in image.planes.iter_mut().enumerate() {
        plane.par_chunks_mut(size[0].max(1)).enumerate().for_each(|(y, line)| {
            let first = [origin_mm[0], origin_mm[1] + y as f64 * pitch_mm];
            material.multiply_line(c, first, line);
        });
    }
}

/// Adds what `rows` hold of the rows `indices` one by one.
fn add(
    out: &mut [Exitance],
    rows: &Responses<'_>,
    indices: &[usize],
    quadrature: &Quadrature,
    fluxes: &[Vec<[f64; 3]>],
    done: &dyn Fn(usize),
) {
    let (material, window) = (rows.material(), rows.material().header.window);
    let (width, len) = (window[0].max(1), rows.window_len());
    if rows.map_len() == 0 {
        return done(indices.len());
    }
    let mut values = Vec::new();
    for indices in indices.chunks((BLOCK / (CHANNELS * len).max(1)).max(1)) {
        if material.header.degree.is_some() {
            values.resize(indices.len() * CHANNELS * len, 0.0);
            rows.by_channel(indices, &mut values);
            let known: Vec<_> = indices.iter().map(|&i| (i, [1.0; CHANNELS])).collect();
            splat(out, &known, window, quadrature, fluxes, &|k, channel, seen, add| {
                let lines = &values[(k * CHANNELS + channel) * len..][..len];
                seen.for_each(|dy| add(0, dy, &lines[dy * width..][..width]));
            });
        } else {
            let (planes, samples) = (rows.planes(indices), rows.map_len());
            let known: Vec<_> = indices.iter().map(|&i| (i, material.entry(i))).collect();
            splat(out, &known, window, quadrature, fluxes, &|k, channel, seen, add| {
                let values = &planes[channel.min(planes.len() - 1)][k * samples..][..samples];
                rows.for_each_piece(material.shift[indices[k]], seen, |dx, dy, at, n| add(dx, dy, &values[at..at + n]));
            });
        }
        done(indices.len());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::tests::example;
    use crate::layout::Core;
    use crate::{Error, Light, LitArea, Point, Shape, naive};

    fn points_of(material: &Material) -> Quadrature {
        let shape = material.shape();
        Quadrature::of_points(&LitArea::of(&shape).unwrap(), &shape)
    }

    #[test]
    fn the_flux_that_leaves_is_that_of_the_rows_wherever_they_lie() {
        let mut material = example();
        material.lit_mm.iter_mut().enumerate().for_each(|(k, p)| p[0] += 0.013 * k as f64);
        let rows: Vec<Vec<f32>> = (0..6).map(|i| material.evaluate_row(i)).collect();
        let points = points_of(&material);
        let flux = Light::Gradient.flux(&points).unwrap();
        let out = relight(&material, &points, std::slice::from_ref(&flux), &|_| {}).unwrap();
        for c in 0..3 {
            let expected: f64 = rows
                .iter()
                .zip(&flux)
                .map(|(row, f)| f[c] * row.iter().skip(c).step_by(3).map(|&v| f64::from(v)).sum::<f64>())
                .sum();
            let total: f64 = out[0].planes[c].iter().sum();
            assert!((total - expected).abs() < 1e-6 * expected.abs().max(1.0), "rows one by one are rounded to f32");
        }
    }

    /// Many points: what rows of nearly one shift have in common is convolved, the rest and the few of another are not.
    #[test]
    fn a_slab_is_relit_as_its_rows_are() {
        let mut material = example();
        let h = &mut material.header;
        (h.points, h.window, h.extended) = ([40, 30], [9, 7], [13, 11]);
        (h.degree, h.offset_planes, h.lit_pitch_mm) = (None, 3, [0.5; 2]);
        let wave = |n: usize, f: f32| (0..n).map(|k| (f * k as f32).sin()).collect::<Vec<f32>>();
        material.incident_factors = wave(2 * 1200, 0.7);
        material.offset_factors = wave(3 * 2 * 143, 0.3).into();
        material.color_coefficients = Vec::new();
        material.lit_mm =
            (0..1200).map(|k| [(k % 40) as f64 * 0.5 + 0.07 * (k as f64).sin(), (k / 40) as f64 * 0.5]).collect();
        // A few far from the others, which are one sample apart.
        let shift = |k: usize| if k.is_multiple_of(97) { [2, -2] } else { [-((k % 2) as i16), (k % 3 / 2) as i16] };
        material.shift = (0..1200).map(shift).collect();
        let rows: Vec<f32> = (0..1200).flat_map(|i| material.evaluate_row(i)).collect();
        let grey: Vec<[f64; 3]> = (0..1200).map(|k| [(k % 7) as f64; 3]).collect();
        let colored: Vec<[f64; 3]> = (0..1200).map(|k| [1.0, (k % 3) as f64, 0.3]).collect();
        for fluxes in [vec![grey.clone()], vec![colored.clone(), grey]] {
            let points = points_of(&material);
            let canvas = points.canvas();
            let (core, convolved, others) = parts(&material, (0..1200).collect(), &points, &fluxes);
            assert!(core.is_some_and(|c| c.samples() == 8 * 6), "shifts of 0 and 1 along both axes");
            assert_eq!((convolved.len(), others.len()), (1200 - 13, 13));
            let mut expected = vec![Exitance::new(canvas); fluxes.len()];
            let all: Vec<_> = (0..1200).map(|i| (i, [1.0; 3])).collect();
            splat(&mut expected, &all, material.header.window, &points, &fluxes, &|k, c, _, add| {
                for (dy, dx) in (0..7).flat_map(|dy| (0..9).map(move |dx| (dy, dx))) {
                    add(dx, dy, &[f64::from(rows[189 * k + 3 * (9 * dy + dx) + c])]);
                }
            });
            let found = relight(&material, &points, &fluxes, &|_| {}).unwrap();
            for (a, b) in found.iter().zip(&expected) {
                let pairs = a.planes.iter().flatten().zip(b.planes.iter().flatten());
                let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                assert!(worst < 1e-4, "up to 63 rows of size 10 and light of 6, rounded to f32: {worst}");
            }
        }
    }

    #[test]
    fn a_canvas_that_is_nearly_all_gaps_is_refused() {
        let mut material = example();
        material.lit_mm[5] = [10_000.0, 10_000.0];
        let refused = LitArea::of(&material.shape());
        assert!(matches!(refused, Err(Error::TooSparse { .. })));
    }

    #[test]
    fn one_point_shows_its_row() {
        let material = example();
        let row = material.evaluate_row(4);
        let points = points_of(&material);
        let flux = Light::Point([1, 1]).flux(&points).unwrap();
        let out = &relight(&material, &points, &[flux], &|_| {}).unwrap()[0];
        // Point (1, 1) is 2 samples right of and 3 below the first; light reaches a sample beyond it.
        assert_eq!(out.canvas.origin_mm, [-0.5 - 1.0, -0.5 - 0.5]);
        for (k, rgb) in row.chunks_exact(3).enumerate() {
            let at = 1 + 2 + k % 5 + (1 + 3 + k / 5) * out.canvas.size[0];
            for c in 0..3 {
                assert!((out.planes[c][at] - f64::from(rgb[c])).abs() < 1e-6, "the row is rounded to f32");
            }
        }
    }

    /// A flux of three different channels into every point but one.
    fn flux(i: usize, c: usize) -> f64 {
        if i == 7 { 0.0 } else { 0.3 + ((5 * i + 3 * c) % 11) as f64 * 0.25 }
    }

    /// Every response of every point, spread over the samples of the canvas by its distance from them.
    fn expected(m: &Material, canvas: &Canvas, c: usize, lit: &[usize]) -> Vec<f64> {
        let mut out = vec![0.0; canvas.size[0] * canvas.size[1]];
        for &i in lit {
            for d in naive::offsets() {
                let value = flux(i, c) * naive::inner(m, i, d).unwrap()[c];
                let at =
                    |a: usize| (m.lit_mm[i][a] + d[a] as f64 * naive::PITCH_MM - canvas.origin_mm[a]) / naive::PITCH_MM;
                for (k, sum) in out.iter_mut().enumerate() {
                    let (x, y) = ((k % canvas.size[0]) as f64, (k / canvas.size[0]) as f64);
                    *sum += value * naive::tent(at(0), x) * naive::tent(at(1), y);
                }
            }
        }
        out
    }

    #[test]
    fn a_slab_is_relit_as_a_loop_over_points_offsets_and_samples_does() {
        for m in naive::materials() {
            let fluxes = vec![(0..naive::ROWS).map(|i| [0, 1, 2].map(|c| flux(i, c))).collect::<Vec<_>>()];
            let out = relight(&m, &points_of(&m), &fluxes, &|_| {}).unwrap();
            let canvas = out[0].canvas;
            // The lit area begins .45 mm left of the first point and .53 mm above it, a sample and one and a half, and
            // ends 3.45 mm right of it and 2.8 mm below; half a window of 7 × 5 around that.
            assert_eq!(canvas.origin_mm, [1.25 - 1.0 * 0.5 - 3.0 * 0.5, -2.0 - 1.0 * 0.5 - 2.0 * 0.5]);
            assert_eq!(canvas.size, [1 + 7 + 1 + 6, 1 + 6 + 1 + 4]);
            for c in 0..3 {
                let all: Vec<usize> = (0..naive::ROWS).collect();
                for (k, (a, b)) in out[0].planes[c].iter().zip(expected(&m, &canvas, c, &all)).enumerate() {
                    let at = [k % canvas.size[0], k / canvas.size[0]];
                    let place = [0, 1].map(|a| canvas.origin_mm[a] + at[a] as f64 * naive::PITCH_MM);
                    let b = b * naive::exit(&m, c, place);
                    // f64 throughout; polynomials in powers lose a digit.
                    assert!((a - b).abs() < 1e-12, "{} channel {c} sample {k}: {a} {b}", m.header.model);
                }
            }
        }
    }

    #[test]
    fn a_convolution_is_that_loop_over_the_rows_of_one_shift() {
        for m in naive::materials().into_iter().filter(|m| m.header.degree.is_none()) {
            let points = points_of(&m);
            let canvas = points.canvas();
            let colored: Vec<[f64; 3]> = (0..naive::ROWS).map(|i| [0, 1, 2].map(|c| flux(i, c))).collect();
            let grey: Vec<[f64; 3]> = (0..naive::ROWS).map(|i| [flux(i, 1); 3]).collect();
            for shift in [[0, 0], [-1, 0], [2, 1], [1, -1]] {
                let group: Vec<usize> = (0..naive::ROWS).filter(|&i| m.shift[i] == shift).collect();
                let core = Core::of(&m.header.layout(), shift, shift).unwrap();
                let mut images = vec![Exitance::new(canvas), Exitance::new(canvas)];
                convolve(&mut images, &Responses::new(&m), &core, &group, &points, &[grey.clone(), colored.clone()])
                    .unwrap();
                for c in 0..3 {
                    let found = images[1].planes[c].iter().zip(expected(&m, &canvas, c, &group));
                    for (k, (a, b)) in found.enumerate() {
                        // Rounding of transforms of some hundred samples of size one.
                        assert!((a - b).abs() < 1e-12, "{} channel {c} sample {k}: {a} {b}", m.header.model);
                    }
                }
                // Under grey light green is as under the coloured one, whose green it is.
                let pairs = images[0].planes[1].iter().zip(&images[1].planes[1]);
                assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-12), "the same flux");
            }
        }
    }

    #[test]
    fn lights_are_told_apart_and_rows_without_light_add_nothing() {
        let m = naive::materials().remove(0);
        let one = |at: usize, rgb: [f64; 3]| {
            (0..naive::ROWS).map(|i| if i == at { rgb } else { [0.0; 3] }).collect::<Vec<_>>()
        };
        let fluxes = [one(3, [0.0, 2.0, 0.0]), one(11, [1.0, 0.0, 3.0])];
        let out = relight(&m, &points_of(&m), &fluxes, &|_| {}).unwrap();
        let (total, row) = (
            |k: usize, c: usize| out[k].planes[c].iter().sum::<f64>(),
            |i: usize, c: usize| naive::offsets().map(|d| naive::response(&m, i, d).unwrap()[c]).sum::<f64>(),
        );
        // What leaves is the flux times the sum of a row: f64.
        for (k, c, e) in [(0, 1, 2.0 * row(3, 1)), (1, 0, row(11, 0)), (1, 2, 3.0 * row(11, 2))] {
            assert!((total(k, c) - e).abs() < 1e-12, "{} {e}", total(k, c));
        }
        assert!([(0, 0), (0, 2), (1, 1)].iter().all(|&(k, c)| out[k].planes[c].iter().all(|v| *v == 0.0)));
    }

    #[test]
    fn white_is_the_percentile_and_tones_are_encoded_by_channel() {
        let canvas = Canvas { origin_mm: [0.0; 2], size: [20, 10], pitch_mm: 1.0 };
        let mut e = Exitance::new(canvas);
        assert_eq!(e.white(), 1.0, "black has no white");
        // 600 numbers 0 … 599: the one at 597 is exceeded by two.
        for (k, v) in e.planes.iter_mut().flatten().enumerate() {
            *v = ((k * 7) % 600) as f64;
        }
        // 7 and 600 have no common factor: each number once.
        assert_eq!(e.white(), 597.0);
        let mut e = Exitance::new(Canvas { origin_mm: [0.0; 2], size: [2, 1], pitch_mm: 1.0 });
        e.planes = [vec![0.0, 4.0], vec![0.72, 2.0], vec![8.0, -1.0]];
        // 0.18 of white is 46.1 % in sRGB (117.6), a half 73.5 % (187.5, rounded to even or up by f32), beyond white is
        // white.
        let found = e.tone_mapped(4.0);
        assert_eq!([found[0], found[1], found[2], found[3], found[5]], [0, 118, 255, 255, 0]);
        assert!(found[4] == 187 || found[4] == 188, "{}", found[4]);
    }

    #[test]
    fn a_canvas_may_be_sixty_four_times_what_its_windows_hold() {
        let refused = |apart_mm: f64| {
            let lit_mm: Vec<Point> = (0..4).map(|k| [(k % 2) as f64 * apart_mm, (k / 2) as f64 * apart_mm]).collect();
            let shape = Shape {
                points: [2, 2],
                window: [129, 129],
                pitch_mm: 1.0,
                lit_pitch_mm: [apart_mm; 2],
                lit_mm: &lit_mm,
            };
            LitArea::of(&shape).is_err()
        };
        // Four windows of 129² are 66,564 samples, 64 times that 2064². A canvas is as wide as a window (129), than the
        // points are apart, and than half of that on both sides.
        assert!(!refused(967.0) && refused(969.0));
    }
}
