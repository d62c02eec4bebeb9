use super::naive::*;
use super::*;

#[test]
fn rows_and_points_of_a_material_are_its_formula() {
    for m in materials() {
        for i in 0..ROWS {
            let row = m.evaluate_row(i);
            for (k, d) in offsets().enumerate() {
                let expected = response(&m, i, d).unwrap();
                let point = m.response(i, d).unwrap();
                for c in 0..3 {
                    // Values of size one in f32.
                    assert!((f64::from(row[3 * k + c]) - expected[c]).abs() < 1e-6, "{} row {i} {d:?}", m.header.model);
                    assert!((f64::from(point[c]) - expected[c]).abs() < 1e-6, "{} row {i} {d:?}", m.header.model);
                }
            }
            for beyond in [[4, 0], [-4, 0], [0, 3], [0, -3]] {
                assert_eq!(m.response(i, beyond), None);
            }
        }
    }
}

#[test]
fn planes_of_rows_are_their_sums_over_terms_times_the_profile() {
    for m in materials() {
        for k in 0..m.header.planes() {
            let block = Responses::new(&m).plane(k, &[4, 5, 6, 7, 8]);
            for i in 4..9 {
                let row = Responses::new(&m).plane(k, &[i]);
                for e in 0..63 {
                    let expected = plane(&m, k, i, [e % 9, e / 9]);
                    // f64 sums.
                    assert!((row[e] - expected).abs() < 1e-14 && (block[63 * (i - 4) + e] - expected).abs() < 1e-14);
                }
            }
        }
        assert!(Responses::new(&m).plane(0, &[ROWS]).iter().all(|v| *v == 0.0));
    }
}

#[test]
fn shared_maps_are_summed_for_every_channel_and_term() {
    let (maps, samples, factors) = (2, 12, 6);
    let shared = super::SharedBasis {
        maps,
        vectors: (0..maps * samples).map(|k| (k as f32 * 0.7).sin()).collect(),
        core: (0..factors * maps).map(|k| (k as f32 * 1.3).cos()).collect(),
    };
    let found = shared.offset_factors();
    assert_eq!(found.len(), factors * samples);
    for (at, found) in found.iter().enumerate() {
        let (factor, e) = (at / samples, at % samples);
        let sum: f64 = (0..maps)
            .map(|l| f64::from(shared.core[factor * maps + l]) * f64::from(shared.vectors[l * samples + e]))
            .sum();
        assert!((f64::from(*found) - sum).abs() < 1e-7, "rounded to f32: {found} {sum}");
    }
}

#[test]
fn every_stored_number_counts_four_bytes() {
    // 3 weights; 15 points and 63 samples for 3 terms of each plane; a profile; coefficients and the range; 30 shifts.
    let numbers = [
        3 + 45 + 3 * 189 + 30,
        3 + 135 + 3 * 189 + 3 * 63 + 30,
        3 + 135 + 189 + 30,
        3 + 45 + 189 + 63 + 30,
        3 + 45 + 189 + 180 + 2 + 30,
        3 + 45 + 189 + 63 + 135 + 2 + 30,
    ];
    for (mut m, n) in materials().into_iter().zip(numbers) {
        assert_eq!(m.bytes_f32(), 4 * n, "{:?}", m.header);
        m.shift.fill([0, 0]);
        assert_eq!(m.bytes_f32(), 4 * (n - 30), "no shifts");
    }
    let mut joint = materials().remove(0).header;
    joint.shared_maps = Some(4);
    // Four maps and a core of 3 · 3 · 4 in the place of the offset factors.
    assert_eq!(joint.bytes_f32(false), 4 * (3 + 45 + 4 * 63 + 36));
}
