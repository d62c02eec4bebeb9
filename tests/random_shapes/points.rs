//! Single points, draws and exports.

use super::*;

/// Offsets of a window.
fn offsets(window: [usize; 2]) -> impl Iterator<Item = [isize; 2]> {
    let half = window.map(|w| (w / 2) as isize);
    (-half[1]..=half[1]).flat_map(move |y| (-half[0]..=half[0]).map(move |x| [x, y]))
}

#[test]
fn points_of_a_material_are_its_rows_however_they_are_asked_for() {
    holds(24, (cases(), 0..KINDS), |(case, kind)| {
        let mut m = material(case, kind);
        // A lattice, of which the evaluator knows where its points are.
        let [px, py] = m.header.lit_pitch_mm;
        m.lit_mm = (0..m.header.rows())
            .map(|i| [(i % case.points[0]) as f64 * px, (i / case.points[0]) as f64 * py])
            .collect();
        let evaluator = Evaluator::new(&m).unwrap();
        let block = source(&m).read(0..m.header.rows()).unwrap();
        for i in 0..m.header.rows() {
            let (expected, size) = formula(&m, i);
            let row = m.evaluate_row(i);
            for (k, d) in offsets(case.window).enumerate() {
                let x_i = m.lit_mm[i];
                let x_o = [0, 1].map(|a| x_i[a] + d[a] as f64 * m.header.pitch_mm);
                let all = [
                    [row[3 * k], row[3 * k + 1], row[3 * k + 2]],
                    [0, 1, 2].map(|c| block.view(i).response[3 * k + c]),
                    evaluator.response(i, d).unwrap(),
                    evaluator.nearest(x_i, x_o),
                ];
                for (way, found) in all.into_iter().enumerate() {
                    for c in 0..3 {
                        // f64 sums of five terms, polynomials that lose (1 + √2)⁴ of it, then f32.
                        let tolerance = F32 * expected[k][c].abs() + 200.0 * F64 * size;
                        let off = (f64::from(found[c]) - expected[k][c]).abs();
                        assert!(off <= tolerance, "way {way}, row {i}, {d:?}: {found:?} {:?}", expected[k]);
                    }
                }
                // Places in mm are known to rounding of a lattice of up to 7 points; a neighbour's value is of the
                // rows' size.
                let found = evaluator.between(x_i, x_o);
                let sizes = (0..m.header.rows()).map(|i| formula(&m, i).1).fold(0.0, f64::max);
                for c in 0..3 {
                    let off = (f64::from(found[c]) - expected[k][c]).abs();
                    let tolerance = F32 * expected[k][c].abs() + 1e4 * F64 * sizes;
                    assert!(off <= tolerance, "between, row {i}, {d:?}: {found:?} {:?}", expected[k]);
                }
            }
        }
    });
}

#[test]
fn draws_have_a_density_that_sums_to_one_and_is_that_of_the_draws() {
    holds(24, (cases(), 0..KINDS), |(case, kind)| {
        let m = material(case, kind);
        let evaluator = Evaluator::new(&m).unwrap();
        for i in 0..m.header.rows().min(4) {
            let probabilities: Vec<f64> = offsets(case.window).map(|d| evaluator.probability(i, d)).collect();
            let total: f64 = probabilities.iter().sum();
            const DRAWS: usize = 2000;
            let mut counts = vec![0; probabilities.len()];
            for k in 0..DRAWS {
                let Some(drawn) = evaluator.sample(i, (k as f64 + 0.5) / DRAWS as f64) else {
                    assert_eq!(total, 0.0, "nothing is modelled");
                    continue;
                };
                let at = offsets(case.window).position(|d| d == drawn.offset).expect("a draw in the window");
                assert_eq!(drawn.probability, probabilities[at]);
                counts[at] += 1;
            }
            if total == 0.0 {
                continue;
            }
            // Products of few f64 for each of up to 49 samples.
            assert!((total - 1.0).abs() <= 1e3 * F64, "row {i}: {total}");
            for (count, p) in counts.into_iter().zip(&probabilities) {
                // A sample has an interval of the uniform draws and one of the others; of evenly spaced ones each
                // counts to within one.
                let off = (f64::from(count) / DRAWS as f64 - p).abs();
                assert!(off <= 2.0 / DRAWS as f64 + 1e3 * F64, "row {i}: {count} of {DRAWS}, {p}");
            }
        }
    });
}

fn array<T: npyz::Deserialize>(path: &Path, name: &str) -> Vec<T> {
    let mut zip = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
    let Ok(mut file) = zip.by_name(&format!("{name}.npy")) else { return Vec::new() };
    let mut bytes = Vec::new();
    file.read_to_end(&mut bytes).unwrap();
    npyz::NpyFile::new(bytes.as_slice()).unwrap().into_vec().unwrap()
}

#[test]
fn exported_arrays_make_the_same_rows() {
    holds(16, (cases(), 0..KINDS), |(case, kind)| {
        let m = material(case, kind);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.npz");
        export_npz(&m, &path).unwrap();
        let header: MaterialHeader = serde_json::from_slice(&array::<u8>(&path, "header_json")).unwrap();
        let back = Material {
            entry_map: m.entry_map.clone(),
            exit_map: m.exit_map.clone(),
            lit_mm: array::<f64>(&path, "lit_mm").as_chunks::<2>().0.to_vec(),
            weights: array(&path, "weights"),
            incident_factors: array(&path, "incident_factors"),
            offset_factors: match header.shared_maps {
                Some(maps) => OffsetFactors::Shared(SharedBasis {
                    maps,
                    vectors: array(&path, "offset_maps"),
                    core: array(&path, "offset_core"),
                }),
                None => OffsetFactors::Own(array(&path, "offset_factors")),
            },
            profile: array(&path, "profile"),
            color_coefficients: array(&path, "color_coefficients"),
            shift: array::<i16>(&path, "shift").as_chunks::<2>().0.to_vec(),
            header,
        };
        assert_eq!((bits(&back), &back), (bits(&m), &m));
        // Powers of the intensity give the colours that the polynomials do.
        let Some(degree) = m.header.degree else { return };
        let powers: Vec<f64> = array(&path, "color_monomials");
        let plain = Material { header: MaterialHeader { degree: None, ..m.header.clone() }, ..m.clone() };
        let [low, high] = m.header.intensity_range.map(f64::from);
        for i in 0..m.header.rows() {
            let ((values, _), (colours, size)) = (formula(&plain, i), formula(&m, i));
            for (value, colour) in values.iter().zip(&colours).filter(|(_, c)| **c != [0.0; 3]) {
                for c in 0..3 {
                    let at = (i * 3 + c) * (degree + 1);
                    let value = value[0].clamp(low, high);
                    let terms = (0..=degree).map(|p| powers[at + p] * value.powi(p as i32));
                    let (sum, sizes) = terms.fold((0.0, 0.0), |(s, a), t| (s + t, a + t.abs()));
                    // f64; powers of a degree of up to 4 over a range of 1 to 3 cancel to what the sum of their sizes
                    // shows.
                    let tolerance = 200.0 * F64 * (sizes + size);
                    assert!((sum - colour[c]).abs() <= tolerance, "{sum} {}", colour[c]);
                }
            }
        }
    });
}
