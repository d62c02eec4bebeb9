//! Saving and loading.

use super::*;

#[test]
fn a_matrix_comes_back_from_the_store_to_the_last_bit() {
    // Windows of a megabyte: lines of points take several chunks.
    let large = (any::<u64>().no_shrink(), 5_usize..=7).prop_map(|(seed, nx)| Case {
        points: [nx, 1],
        window: [403, 301],
        seed,
    });
    holds(12, prop_oneof![5 => cases(), 1 => large], |case| {
        let mut draw = Draw::new(case.seed ^ 5);
        let mut matrix = Matrix::of(case.points, case.window, |_, _, _| 0.0);
        let n = matrix.rows.len();
        for row in &mut matrix.rows {
            row.response.iter_mut().for_each(|v| *v = draw.bits());
            row.variance.iter_mut().for_each(|v| *v = draw.bits().abs());
            row.valid.iter_mut().for_each(|v| *v = draw.chance(0.8));
        }
        let h = &mut matrix.header;
        let shots = 1 + draw.below(4);
        h.pitch_mm = draw.unit() + 1e-3;
        h.lit_pitch_mm = [draw.unit() + 1e-3, 1e3 * draw.unit() + 1e-3];
        // Places that are their pitch apart, but for some drift: from others the reader takes the pitch.
        let (pitch, origin) = (h.lit_pitch_mm, [1e3 * draw.signed(), draw.signed()]);
        let drift_mm = 0.02 * pitch[0].min(pitch[1]);
        let nx = case.points[0];
        let place = |k: usize, a: usize| origin[a] + pitch[a] * [k % nx, k / nx][a] as f64;
        h.lit_mm = (0..n).map(|k| [0, 1].map(|a| place(k, a) + drift_mm * draw.signed())).collect();
        h.position_sd_mm = (0..n).map(|_| draw.unit()).collect();
        h.shot_of = (0..n).map(|_| draw.chance(0.8).then(|| draw.below(shots))).collect();
        h.shots = (0..shots)
            .map(|k| ShotRecord {
                name: format!("lattice \"{k}\" µ"),
                drift_px: [draw.signed(), draw.signed()],
                drift_sd_px: draw.chance(0.5).then(|| draw.unit()),
            })
            .collect();
        h.warnings = vec![ResponseWarning::UnlitPoints { rows: draw.below(9) }.into()];
        h.provenance = serde_json::json!({"seed": case.seed, "list": [draw.signed(), null, "text"]});
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let writer = MatrixWriter::create(&path, matrix.header.clone()).unwrap();
        let len = matrix.header.row_len();
        let never = Row { response: vec![0.0; len], variance: vec![0.0; len], valid: vec![false; len] };
        for i in draw.order(n) {
            if draw.chance(0.1) {
                matrix.rows[i] = never.clone();
                continue;
            }
            // The last of those that are put counts.
            if draw.chance(0.2) {
                writer.put(i, &matrix.rows[draw.below(n)]).unwrap();
            }
            writer.put(i, &matrix.rows[i]).unwrap();
        }
        writer.finish().unwrap();
        let reader = MatrixReader::open(&path).unwrap();
        assert_eq!(reader.header(), &matrix.header);
        for first in 0..n {
            let range = first..first + 1 + draw.below(n - first);
            if case.window[0] > 7 && first > 1 {
                break;
            }
            let rows = &matrix.rows[range.clone()];
            let (all, part) = (reader.read(range.clone()).unwrap(), reader.read_responses(range).unwrap());
            let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            // What was not measured is 0, whatever was put there.
            let stored = |of: fn(&Row) -> &Vec<f32>| -> Vec<u32> {
                let bits = |r: &Row| {
                    of(r)
                        .iter()
                        .zip(&r.valid)
                        .map(|(v, valid)| if *valid { v.to_bits() } else { 0 })
                        .collect::<Vec<_>>()
                };
                rows.iter().flat_map(bits).collect()
            };
            let response = stored(|r| &r.response);
            assert!(bits(&all.response) == response && bits(&part.response) == response, "responses from {first}");
            assert!(bits(&all.variance) == stored(|r| &r.variance));
            let valid = rows.iter().flat_map(|r| r.valid.iter().map(|&v| u8::from(v))).collect::<Vec<_>>();
            assert!(all.valid == valid && part.valid == valid && part.variance.is_empty());
        }
    });
}

#[test]
fn a_material_comes_back_from_its_file_to_the_last_bit() {
    holds(32, (cases(), 0..KINDS), |(case, kind)| {
        let mut draw = Draw::new(case.seed ^ 6);
        let mut m = material(case, kind);
        let of_shared = m.header.shared_maps.is_some();
        let mut none = Vec::new();
        let [offsets, core] = match &mut m.offset_factors {
            OffsetFactors::Own(own) => [own, &mut none],
            OffsetFactors::Shared(shared) => [&mut shared.vectors, &mut shared.core],
        };
        let (colors, profile) = (&mut m.color_coefficients, &mut m.profile);
        let numbers = [&mut m.weights, &mut m.incident_factors, offsets, core, profile, colors];
        // Files hold no number above 1e36.
        for v in numbers.into_iter().flatten() {
            if draw.chance(0.5) {
                // Sums of products of those of shared maps stay below it, too.
                *v = Some(draw.bits()).filter(|v| v.abs() <= if of_shared { 1e17 } else { 1e36 }).unwrap_or(-0.0);
            }
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.safetensors");
        save(&m, Precision::F32, &path).unwrap();
        let once = Material::load(&path).unwrap();
        assert_eq!(once, m);
        assert_eq!(bits(&once), bits(&m));
        save(&once, Precision::F32, &path).unwrap();
        let twice = Material::load(&path).unwrap();
        assert_eq!((bits(&twice), &twice), (bits(&once), &once));
    });
}

#[test]
fn a_coded_material_comes_back_as_the_encoder_said() {
    holds(12, (cases(), 0..KINDS, 1.0..4.5_f64), |(case, kind, digits)| {
        let m = material(case, kind);
        let asked = 10_f64.powf(-digits);
        let options = coded::EncodeOptions { quality: Quality::AddedError(asked), ..coded::EncodeOptions::default() };
        let coded = coded::encode(&m, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.acq");
        std::fs::write(&path, &coded.bytes).unwrap();
        let once = Material::load(&path).unwrap();
        assert_eq!((bits(&once), &once), (bits(&coded.material), &coded.material));
        let (a, b) = (rows_of(&m), rows_of(&once));
        let squares = |f: &dyn Fn(f32, f32) -> f64| -> f64 {
            a.iter().flatten().zip(b.iter().flatten()).map(|(&a, &b)| f(a, b).powi(2)).sum()
        };
        let (off, size) = (squares(&|a, b| f64::from(a) - f64::from(b)).sqrt(), squares(&|a, _| a.into()).sqrt());
        assert!(coded.added_error <= asked);
        // Rows are rounded to f32 here.
        assert!((off - coded.added_error * size).abs() <= 2.0 * F32 * size, "{off} of {size}, {}", coded.added_error);
        let plain = folder.path().join("m.safetensors");
        save(&once, Precision::F32, &plain).unwrap();
        let twice = Material::load(&plain).unwrap();
        assert_eq!((bits(&twice), &twice.header, &twice.shift), (bits(&once), &once.header, &once.shift));
        let places = twice.lit_mm.as_flattened().iter().zip(once.lit_mm.as_flattened());
        assert!({ places }.all(|(a, b)| *a == f64::from(*b as f32)), "places are f32 in a plain file");
    });
}
