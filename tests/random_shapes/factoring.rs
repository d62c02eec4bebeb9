//! Matrices that are cropped or changed are factored alike.

use super::*;

#[test]
fn as_many_terms_as_a_matrix_has_reproduce_it_and_any_crop_of_it() {
    holds(12, (cases(), -30..=30_i32), |(case, decades)| {
        let mut draw = Draw::new(case.seed ^ 7);
        let matrix = Matrix::coloured(case).with_gaps(case.seed).scaled(10_f64.powi(decades));
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        for part in [matrix.crop(first, points, window), matrix] {
            let terms = part.rows.len();
            let options = FactorOptions { peak_shift: draw.chance(0.7), ..joint(terms) };
            let f = part.factored(&options);
            let energy = part.energy();
            let error = (part.error(&rows_of(&f.material)) / energy.max(f64::MIN_POSITIVE)).sqrt();
            // Gaps of a shifted row are filled with what may be larger than what was measured, by a few times.
            let tolerance = 4.0 * storing(terms);
            assert!(error <= tolerance, "{error:e} of {tolerance:e}, {}", f.choice);
            assert!((error - f.rel_rmse).abs() <= tolerance, "{error:e} {:e}", f.rel_rmse);
        }
    });
}

/// A matrix of products of two random factors, and the number of them.
fn low_rank(case: Case) -> (Matrix, usize) {
    let mut draw = Draw::new(case.seed ^ 8);
    let n = case.points[0] * case.points[1];
    let len = case.window[0] * case.window[1] * 3;
    let rank = 1 + draw.below(3);
    let incident: Vec<f64> = (0..n * rank).map(|_| draw.signed()).collect();
    let offset: Vec<f64> = (0..len * rank).map(|_| draw.signed()).collect();
    let matrix = Matrix::of(case.points, case.window, |i, [x, y], c| {
        let k = (x + y * case.window[0]) * 3 + c;
        (0..rank).map(|j| incident[i * rank + j] * offset[k * rank + j]).sum()
    });
    (matrix, rank)
}

#[test]
fn a_crop_of_a_matrix_of_low_rank_and_its_rows_in_any_order_take_as_many_terms() {
    holds(10, cases(), |case| {
        let mut draw = Draw::new(case.seed ^ 9);
        let (matrix, rank) = low_rank(case);
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        let order = draw.order(matrix.rows.len());
        let other = Matrix { rows: order.iter().map(|&i| matrix.rows[i].clone()).collect(), ..matrix.clone() };
        let options = FactorOptions { peak_shift: false, ..joint(rank) };
        let mut values = Vec::new();
        for part in [matrix.crop(first, points, window), matrix, other] {
            let f = part.factored(&options);
            let error = (part.error(&rows_of(&f.material)) / part.energy()).sqrt();
            // Entries are rounded to f32, which the terms need not follow.
            let tolerance = storing(rank) + F32;
            assert!(error <= tolerance, "{error:e} of {tolerance:e}, {}", f.choice);
            values.push(f.material.header.singular_values);
        }
        // They are roots of products in f64, of up to 42 rows and some times as many steps of the decomposition.
        let tolerance = 1e3 * F64 * values[1][0].powi(2);
        assert!(values[1].iter().zip(&values[2]).all(|(a, b)| (a * a - b * b).abs() <= tolerance), "{values:?}");
    });
}

#[test]
fn a_crop_is_factored_no_worse_than_the_factored_matrix_is_cropped() {
    holds(10, cases(), |case| {
        let mut draw = Draw::new(case.seed ^ 10);
        let matrix = Matrix::coloured(case);
        let points = case.points.map(|n| 1 + draw.below(n));
        let first = [0, 1].map(|a| draw.below(case.points[a] - points[a] + 1));
        let window = case.window.map(|w| w - 2 * draw.below(w / 2 + 1));
        let terms = 1 + draw.below(4);
        let options = FactorOptions { peak_shift: false, ..joint(terms) };
        let whole = rows_of(&matrix.factored(&options).material);
        let part = matrix.crop(first, points, window);
        let cropped = crop(&matrix.header, |i| whole[i].clone(), first, points, window);
        let own = part.error(&rows_of(&part.factored(&options).material)).sqrt();
        let (of_whole, size) = (part.error(&cropped).sqrt(), part.energy().sqrt());
        // Sharing maps may add a hundredth to the squared error; beyond it the best of that rank is not worse than any
        // other of that rank.
        let tolerance = 1.01_f64.sqrt() * of_whole + storing(terms) * size;
        assert!(own <= tolerance, "{own:e}, cropped {of_whole:e} of {size:e}");
    });
}

#[test]
fn a_changed_matrix_is_factored_to_the_changed_material() {
    holds(20, (cases(), changes(), any::<bool>()), |(case, change, tucker)| {
        let mut draw = Draw::new(case.seed ^ 11);
        let matrix = Matrix::coloured(case);
        let terms = 1 + draw.below(4);
        let options = match tucker {
            true => FactorOptions { model: Some(Model::Tucker), degree: Some(draw.below(4)), ..joint(terms) },
            false => joint(terms),
        };
        let (f, g) = (matrix.factored(&options), change.matrix(&matrix).factored(&options));
        let (a, b) = (&f.material.header, &g.material.header);
        assert_eq!((change.axes(a.extended), a.terms, a.shared_maps), (b.extended, b.terms, b.shared_maps));
        let expected = change.rows(&rows_of(&f.material), case.points, case.window);
        let found = rows_of(&g.material);
        let size = matrix.energy().sqrt();
        let off: f64 =
            expected.iter().flatten().zip(found.iter().flatten()).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        // What is known to rounding turns terms by as much over the distance of the last singular value that is kept to
        // the first that is not. A polynomial of degree 3 on a row whose intensities lie close together magnifies that.
        let [last, next] =
            [terms - 1, terms].map(|j| a.singular_values.get(j).copied().unwrap_or(0.0) / a.singular_values[0]);
        let turned = if next > 0.0 { 1.0 / (last - next).max(F64) } else { 1.0 };
        let magnified = if tucker { 30.0 } else { 1.0 };
        let tolerance = magnified * (2.0 * storing(terms) + F32 * turned);
        assert!(off.sqrt() <= tolerance * size, "{:e} of {tolerance:e}, {}", off.sqrt() / size, f.choice);
        assert!((f.rel_rmse - g.rel_rmse).abs() <= tolerance, "{} {}", f.rel_rmse, g.rel_rmse);
    });
}

#[test]
fn a_matrix_times_a_power_of_two_is_factored_to_the_material_times_it_to_the_last_bit() {
    let ways = |way: usize, terms: usize| {
        let base = FactorOptions { terms: Some(terms), ..FactorOptions::default() };
        let (tucker, peers) = (Some(Model::Tucker), Some(Model::Peers2006));
        match way {
            0 => FactorOptions { model: Some(Model::Joint), ..base },
            1 => FactorOptions { model: tucker, degree: Some(terms), ..base },
            2 => FactorOptions { model: peers, ..base },
            3 => FactorOptions { model: peers, color_regression: true, degree: Some(1), ..base },
            4 => FactorOptions { backend: Some(Backend::Gram), ..base },
            5 => FactorOptions { backend: Some(Backend::Randomized), ..base },
            6 => FactorOptions::default(),
            7 => FactorOptions { model: tucker, ..FactorOptions::default() },
            _ => FactorOptions { goal: Goal::Psnr(20.0 * terms as f64), ..FactorOptions::default() },
        }
    };
    // Scaled variances are to be normal numbers, too.
    let scales = prop_oneof![(-95..=95_i32).prop_map(|k| (k, 0.0)), (-50..=50_i32).prop_map(|k| (k, 1e-3))];
    holds(20, (cases(), 0_usize..9, 1_usize..4, scales), |(case, way, terms, (exponent, variance))| {
        let mut matrix = Matrix::coloured(case).with_gaps(case.seed);
        matrix.rows.iter_mut().for_each(|r| r.variance.fill(variance));
        let scale = 2_f64.powi(exponent);
        let options = ways(way, terms);
        let (f, g) = (matrix.factored(&options), matrix.clone().scaled(scale).factored(&options));
        assert_eq!((f.rel_rmse, f.psnr_db), (g.rel_rmse, g.psnr_db), "{} / {}", f.choice, g.choice);
        let (a, b) = (&f.material.header, &g.material.header);
        assert_eq!((a.terms, a.degree, a.shared_maps, a.planes()), (b.terms, b.degree, b.shared_maps, b.planes()));
        assert_eq!((&f.material.shift, &a.warnings), (&g.material.shift, &b.warnings));
        let scaled = rows_of(&f.material).into_iter().flatten().map(|v| (f64::from(v) * scale) as f32);
        assert_eq!(scaled.collect::<Vec<_>>(), rows_of(&g.material).concat());
    });
}
