use super::*;
use crate::Warning;

fn arrays(shape: &[usize], values: Vec<f32>) -> MatrixArrays<'static> {
    MatrixArrays {
        name: "x.npz".into(),
        response: ArrayOf { shape: shape.to_vec(), values: Cow::Owned(values) },
        variance: None,
        valid: None,
        x_i_mm: None,
        y_i_mm: None,
        position_sd_mm: None,
        pitch_mm: None,
        lit_pitch_mm: None,
    }
}

fn pitch() -> ArraysOptions {
    ArraysOptions { pitch_mm: Some(0.5), ..ArraysOptions::default() }
}

fn import(
    arrays: &MatrixArrays<'_>,
    options: &ArraysOptions,
) -> Result<(ImportedMatrix, MatrixHeader, super::super::RowBlock)> {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("m.rd.zarr");
    let imported = import_arrays(arrays, options, &out, &Progress::silent())?;
    let reader = MatrixReader::open(&out)?;
    let block = reader.read(0..reader.header().rows())?;
    Ok((imported, reader.header().clone(), block))
}

/// R_d of a full matrix over 4 × 3 points: no two numbers are alike, and it falls with the distance.
fn full(i: usize, o: usize) -> f32 {
    let apart = (i % 4).abs_diff(o % 4).pow(2) + (i / 4).abs_diff(o / 4).pow(2);
    (-2.0 * apart as f32).exp() * (1.0 + 0.01 * (12 * i + o) as f32)
}

#[test]
fn windows_of_three_channels_and_of_one_are_rows() {
    let values: Vec<f32> = (0..2 * 3 * 3 * 5 * 3).map(|k| k as f32 * 1e-4).collect();
    let (imported, header, block) = import(&arrays(&[2, 3, 3, 5, 3], values.clone()), &pitch()).unwrap();
    assert_eq!((header.points, header.window, header.pitch_mm, header.lit_pitch_mm), ([3, 2], [5, 3], 0.5, [0.5; 2]));
    assert_eq!((block.response, imported.channels, imported.measured_share), (values.clone(), 3, 1.0));
    assert_eq!(imported.defaults.len(), 4, "{:?}", imported.defaults);
    for shape in [&[2, 3, 3, 5][..], &[2, 3, 3, 5, 1]] {
        let (imported, _, block) = import(&arrays(shape, values[..90].to_vec()), &pitch()).unwrap();
        assert_eq!(imported.channels, 1);
        assert!(block.response.chunks(3).zip(&values).all(|(rgb, v)| rgb == [*v; 3]));
    }
}

#[test]
fn a_full_matrix_is_cut_into_windows_and_says_what_lies_outside() {
    let values: Vec<f32> = (0..144).map(|k| full(k / 12, k % 12)).collect();
    let options = |window, points| ArraysOptions { window, points, ..pitch() };
    for (shape, flag) in
        [(vec![12, 12], false), (vec![12, 12, 1], false), (vec![3, 4, 3, 4], true), (vec![3, 4, 3, 4, 1], true)]
    {
        let points = (!flag).then_some([4, 3]);
        let options = ArraysOptions { full: flag, ..options(Some([3, 5]), points) };
        let (imported, header, block) = import(&arrays(&shape, values.clone()), &options).unwrap();
        assert_eq!((header.points, header.window, header.lit_pitch_mm), ([4, 3], [3, 5], [0.5; 2]));
        let (mut inside, all): (f64, f64) = (0.0, values.iter().map(|&v| f64::from(v)).sum());
        for (i, k) in (0..12_usize).flat_map(|i| (0..15_usize).map(move |k| (i, k))) {
            let (x, y) = ((i % 4 + k % 3).checked_sub(1), (i / 4 + k / 3).checked_sub(2));
            let o = x.zip(y).filter(|(x, y)| *x < 4 && *y < 3).map(|(x, y)| x + 4 * y);
            let expected = o.map(|o| full(i, o));
            inside += f64::from(expected.unwrap_or(0.0));
            let at = (i * 15 + k) * 3;
            assert_eq!(block.response[at..at + 3], [expected.unwrap_or(0.0); 3], "{i} {k}");
            assert_eq!(block.valid[at], u8::from(o.is_some()));
        }
        let share = imported.light_outside_window.unwrap();
        assert!((share - (all - inside) / all).abs() < 1e-12, "f64: {share}");
        // What lies beyond the lattice was never there, and is not said to be missing.
        assert_eq!(imported.measured_share, 1.0);
        let ids: Vec<_> = imported.findings.iter().map(Warning::id).collect();
        assert_eq!(ids, ["light-outside-window"]);
    }
    // By default the window is as small as leaves out a thousandth: e⁻⁸ two points away, for 20 pairs of a dozen that
    // hold most of it.
    let (imported, header, _) = import(&arrays(&[12, 12], values.clone()), &options(None, Some([4, 3]))).unwrap();
    assert_eq!(header.window, [3, 3]);
    assert!((1e-4..1e-3).contains(&imported.light_outside_window.unwrap()));
    let (_, header, _) = import(&arrays(&[9, 9], vec![1.0; 81]), &pitch()).unwrap();
    assert_eq!((header.points, header.window), ([3, 3], [5, 5]), "a square number of points, all equally bright");
}

#[test]
fn what_is_odd_about_the_numbers_is_told_with_its_place() {
    let mut values = vec![0.5; 2 * 3 * 3 * 5];
    (values[7], values[50]) = (-0.25, f32::NAN);
    values[51] = f32::NAN;
    let (imported, header, block) = import(&arrays(&[2, 3, 3, 5], values.clone()), &pitch()).unwrap();
    let said: Vec<String> = imported.findings.iter().map(ToString::to_string).collect();
    assert!(said[0].contains("1 number below zero") || said[0].contains("3 numbers below zero"), "{said:?}");
    assert!(said[0].contains("-2.500e-1 at response[0, 0, 1, 2]"), "{said:?}");
    assert!(said[1].contains("first response[1, 0, 1, 0]"), "{said:?}");
    // 15 samples of 0.5 mm⁻² on 0.25 mm² each: 1.875.
    assert!(said[2].contains("in 6 rows (albedo up to 1.8750"), "{said:?}");
    assert_eq!(header.warnings, imported.findings);
    assert_eq!(block.valid.iter().filter(|&&v| v == 0).count(), 6);
    values[8] = f32::INFINITY;
    match import(&arrays(&[2, 3, 3, 5], values), &pitch()) {
        Err(Error::NotFinite { field: "response", at, .. }) => assert_eq!(at, "response[0, 0, 1, 3]"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn arrays_beside_the_response_are_used() {
    let own = |shape: &[usize], values: Vec<f64>| Some(ArrayOf { shape: shape.to_vec(), values: Cow::Owned(values) });
    let given = MatrixArrays {
        variance: Some(ArrayOf { shape: vec![1, 2, 1, 1], values: Cow::Owned(vec![0.1, 0.2]) }),
        valid: Some(ArrayOf { shape: vec![1, 2, 1, 1], values: Cow::Owned(vec![1, 0]) }),
        x_i_mm: own(&[1, 2], vec![3.0, 4.5]),
        y_i_mm: own(&[1, 2], vec![1.0, 1.0]),
        position_sd_mm: own(&[1, 2], vec![0.01, 0.02]),
        pitch_mm: Some(0.25),
        ..arrays(&[1, 2, 1, 1], vec![1.0, f32::NAN])
    };
    let (imported, header, block) = import(&given, &ArraysOptions::default()).unwrap();
    assert_eq!((header.lit_mm, header.lit_pitch_mm), (vec![[3.0, 1.0], [4.5, 1.0]], [1.5, 0.25]));
    assert_eq!((header.position_sd_mm, header.pitch_mm), (vec![0.01, 0.02], 0.25));
    assert_eq!(block.variance, [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]);
    assert!(imported.defaults.is_empty(), "{:?}", imported.defaults);
    let refused = |given: MatrixArrays<'_>| import(&given, &ArraysOptions::default()).unwrap_err().to_string();
    let wide = MatrixArrays { x_i_mm: own(&[2, 1], vec![3.0, 4.5]), ..given.clone() };
    assert!(refused(wide).contains("x_i_mm: expected shape [1, 2]"));
    assert!(
        refused(MatrixArrays { y_i_mm: None, ..given.clone() })
            .contains("y_i_mm: expected x_i_mm and y_i_mm, or neither")
    );
    let negative = Some(ArrayOf { shape: vec![1, 2, 1, 1], values: Cow::Owned(vec![-0.1, 0.2]) });
    assert!(
        refused(MatrixArrays { variance: negative, ..given.clone() })
            .contains("variance: expected 0 or more, found -0.1 at variance[0, 0, 0, 0]")
    );
    let short = Some(ArrayOf { shape: vec![2], values: Cow::Owned(vec![0.1, 0.2]) });
    assert!(refused(MatrixArrays { variance: short, ..given }).contains("variance: expected the shape of response"));
}

#[test]
fn shapes_and_options_that_do_not_fit_are_refused() {
    let refused = |shape: &[usize], options: &ArraysOptions| {
        import(&arrays(shape, vec![0.1; shape.iter().product()]), options).unwrap_err().to_string()
    };
    for (shape, words) in [
        (&[4][..], "found shape [4]"),
        (&[3, 4], "as many outgoing as lit points"),
        (&[0, 3, 3, 3], "a number or more"),
        (&[2, 2, 4, 3], "odd numbers of samples"),
        (&[2, 2, 3, 3, 2], "found shape [2, 2, 3, 3, 2]"),
        (&[12, 12], "points: expected points along x and y, as 12 is no square, found none"),
    ] {
        assert!(refused(shape, &pitch()).contains(words), "{}", refused(shape, &pitch()));
    }
    assert!(refused(&[2, 2, 3, 3], &ArraysOptions::default()).contains("pitch_mm: expected the side of a sample"));
    assert!(refused(&[2, 2, 3, 3], &ArraysOptions { pitch_mm: Some(0.0), ..pitch() }).contains("pitch_mm"));
    assert!(
        refused(&[2, 2, 3, 3], &ArraysOptions { lit_pitch_mm: Some([1.0, f64::NAN]), ..pitch() })
            .contains("lit_pitch_mm")
    );
    assert!(refused(&[2, 2, 3, 3], &ArraysOptions { window: Some([3, 3]), ..pitch() }).contains("window"));
    assert!(refused(&[2, 2, 3, 3], &ArraysOptions { full: true, ..pitch() }).contains("as many outgoing"));
    assert!(
        refused(&[12, 12], &ArraysOptions { points: Some([5, 2]), ..pitch() })
            .contains("product is 12, the points of response, found 5x2")
    );
    assert!(refused(&[4, 4], &ArraysOptions { window: Some([2, 3]), ..pitch() }).contains("odd numbers"));
}
