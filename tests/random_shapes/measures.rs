//! Measures of a difference that is known.

use super::*;

fn measures(candidate: &Stored, reference: &Stored) -> Measures {
    let source = Source::Matrix(Box::new(MatrixReader::open(candidate.reader.path()).unwrap()));
    evaluate(&source, &reference.reader, &Progress::silent()).unwrap()
}

/// Another matrix of the same shape: every entry off by up to a fifth, others not measured, places off, some variance.
fn another(matrix: &Matrix, seed: u64) -> Matrix {
    let mut draw = Draw::new(seed ^ 12);
    let mut out = matrix.clone().with_gaps(seed ^ 13);
    for row in &mut out.rows {
        row.response.iter_mut().for_each(|v| *v *= 1.0 + 0.2 * draw.signed() as f32);
        row.variance.iter_mut().for_each(|v| *v = 0.01 * draw.unit() as f32);
    }
    out
}

#[test]
fn a_matrix_and_a_material_are_no_different_from_themselves() {
    holds(10, (cases(), 0..KINDS, -30..=30_i32), |(case, kind, decades)| {
        let matrix = Matrix::coloured(case).with_gaps(case.seed).scaled(10_f64.powi(decades));
        let stored = matrix.stored();
        let m = measures(&stored, &stored);
        let measured = matrix.rows.iter().flat_map(|r| &r.valid).filter(|v| **v).count();
        assert_eq!(m.entries, measured as u64);
        let zero = (matrix.energy() > 0.0).then_some(0.0);
        assert_eq!((m.rel_rmse, m.log_rmse, m.psnr_db, m.relit_psnr_db), (zero, zero, None, None));
        assert_eq!((m.position_rms_mm, m.coverage_2sigma), (0.0, None));
        // The rows of a material as a matrix: equal to the rounding of the f32 that it is stored as.
        let material = material(case, kind);
        let mut rows = Matrix::of(case.points, case.window, |_, _, _| 0.0);
        rows.header.pitch_mm = material.header.pitch_mm;
        rows.rows.iter_mut().zip(rows_of(&material)).for_each(|(row, values)| row.response = values);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        crate::save(&material, crate::Precision::F32, &path).unwrap();
        let m = evaluate(&Source::open(&path).unwrap(), &rows.stored().reader, &Progress::silent()).unwrap();
        let sizes = (0..material.header.rows()).map(|i| formula(&material, i).1.powi(2)).sum::<f64>();
        let all = rows.energy();
        // A sum in another order may round to the neighbour, as far as it cancels not at all.
        let tolerance = 2.0 * F32 + 100.0 * F64 * (sizes * (3 * case.window[0] * case.window[1]) as f64 / all).sqrt();
        assert_eq!(m.rel_rmse.is_some(), all > 0.0);
        assert!(m.rel_rmse.is_none_or(|e| e <= tolerance), "{m:?}");
    });
}

#[test]
fn measures_do_not_change_with_a_common_scale_or_order_of_axes_and_channels() {
    holds(10, (cases(), changes(), -95..=95_i32), |(case, change, exponent)| {
        let reference = Matrix::coloured(case).with_gaps(case.seed);
        let candidate = another(&reference, case.seed);
        let m = measures(&candidate.stored(), &reference.stored());
        let scale = 2_f64.powi(exponent);
        let unvaried = |m: &Matrix| {
            let mut m = m.clone();
            m.rows.iter_mut().for_each(|r| r.variance.fill(0.0));
            m.scaled(scale)
        };
        let scaled = measures(&unvaried(&candidate).stored(), &unvaried(&reference).stored());
        // A power of two: not even rounding differs.
        let common = |m: &Measures| (m.entries, m.rel_rmse, m.psnr_db, m.log_rmse, m.relit_psnr_db, m.reciprocity);
        assert_eq!(common(&scaled), common(&m));
        assert_eq!(scaled.albedo_mean, m.albedo_mean.map(|a| a * scale));
        let changed = measures(&change.matrix(&candidate).stored(), &change.matrix(&reference).stored());
        assert_eq!((changed.entries, changed.albedo_violations), (m.entries, m.albedo_violations));
        let order = if let Change::Channels(order) = change { order } else { [0, 1, 2] };
        // Sums of up to 42 · 147 numbers in another order; decibels add 20 / ln 10 of a relative error.
        let tolerance = 1e4 * F64;
        for c in 0..3 {
            for (a, b) in [(changed.albedo_max, m.albedo_max), (changed.albedo_mean, m.albedo_mean)] {
                assert!((a[c] - b[order[c]]).abs() <= tolerance * b[order[c]].abs(), "{a:?} {b:?}");
            }
        }
        let pairs = [
            (changed.rel_rmse, m.rel_rmse),
            (changed.psnr_db, m.psnr_db),
            (changed.log_rmse, m.log_rmse),
            (changed.reciprocity, m.reciprocity),
            (changed.coverage_2sigma, m.coverage_2sigma),
        ];
        for (a, b) in pairs {
            assert_eq!(a.is_some(), b.is_some());
            let (a, b) = (a.unwrap_or(0.0), b.unwrap_or(0.0));
            assert!((a - b).abs() <= tolerance * b.abs().max(1.0), "{changed:?} {m:?}");
        }
    });
}

#[test]
fn a_known_error_is_measured_as_what_it_is() {
    holds(10, (cases(), -30..=30_i32, -5.0..1.0_f64), |(case, decades, digits)| {
        let mut draw = Draw::new(case.seed ^ 14);
        let reference = Matrix::coloured(case).scaled(10_f64.powi(decades));
        let asked = 10_f64.powf(digits);
        let noise: Vec<f64> = (0..reference.rows.len() * reference.header.row_len()).map(|_| draw.signed()).collect();
        let length = noise.iter().map(|v| v * v).sum::<f64>().sqrt();
        let step = asked * reference.energy().sqrt() / length;
        let mut candidate = reference.clone();
        let entries = candidate.rows.iter_mut().flat_map(|r| &mut r.response).zip(&noise);
        entries.for_each(|(v, n)| *v = (f64::from(*v) + step * n) as f32);
        let stored = reference.stored();
        let found = measures(&candidate.stored(), &stored).rel_rmse.unwrap();
        // The candidate is rounded to f32.
        assert!((found - asked).abs() <= F32 * (1.0 + asked), "{found} {asked}");
        let (factor, error) = [(0.0, 1.0), (2.0, 1.0), (-1.0, 2.0), (0.5, 0.5)][draw.below(4)];
        let found = measures(&reference.scaled(factor).stored(), &stored).rel_rmse;
        assert_eq!(found, Some(error), "times {factor}");
    });
}
