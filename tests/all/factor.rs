//! From a matrix on disk to a material: recovery of known factors and the choices made from noise. `extremes.rs` has
//! the extremes.

use crate::common;
use crate::matrices::{fixed, noise, profile, run, tucker, write};
use acquire::evaluate::evaluate;
use acquire::factor::{Backend, FactorOptions, Factored, Goal, factor};
use acquire::material::{self, Evaluator, Model, OffsetFactors, Precision, Source};
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate;
use acquire::transport::{MatrixReader, MatrixWriter, Row};

#[test]
fn a_homogeneous_gray_slab_is_one_term_and_a_straight_line() {
    let f = run(&tucker(), [8, 8], [11, 11], |_, d, c| (profile(d, 2.0) * [1.0, 0.7, 0.4][c]) as f32).unwrap();
    assert_eq!((f.material.header.terms, f.material.header.degree), (1, Some(1)), "{}", f.choice);
    assert!(f.rel_rmse < 1e-6, "f32 rounding: {}", f.rel_rmse);
}

#[test]
fn a_noisy_homogeneous_slab_is_one_term() {
    const GAIN: [f64; 3] = [1.0, 0.7, 0.4];
    let bell = |d: [f64; 2]| (-(d[0] * d[0] + d[1] * d[1]) / 8.0).exp();
    let folder = tempfile::tempdir().unwrap();
    for (sd, position_sd_mm) in [(0.003, 0.0), (0.03, 0.0), (0.003, 0.05)] {
        let sd_px = position_sd_mm / 0.5;
        // As the pipeline states it: photons, and the uncertain place times the slope.
        let variance = |d: [f64; 2], c: usize| {
            let slope2 = bell(d).powi(2) * (d[0] * d[0] + d[1] * d[1]) / 16.0;
            (sd * sd + (sd_px * GAIN[c]).powi(2) * slope2) as f32
        };
        let response = |i: usize, d: [f64; 2], c: usize| {
            let off = |a: usize| sd_px * noise(i + 100_000, [a as f64, 0.0], 0);
            (GAIN[c] * bell([d[0] + off(0), d[1] + off(1)]) + sd * noise(i, d, c)) as f32
        };
        let path = folder.path().join("m.rd.zarr");
        let reader = write(&path, [12, 12], [15, 15], variance, position_sd_mm, response).unwrap();
        let f = factor(&reader, &tucker(), &Progress::silent()).unwrap();
        let found = (f.material.header.terms, f.material.header.degree);
        assert_eq!(found, (1, Some(1)), "sd {sd}, position {position_sd_mm}: {}", f.choice);
        let joint = factor(&reader, &FactorOptions::default(), &Progress::silent()).unwrap();
        assert_eq!(joint.material.header.terms, 1, "sd {sd}, position {position_sd_mm}: {}", joint.choice);
    }
}

#[test]
fn three_clear_terms_in_noise_are_three_terms() {
    let folder = tempfile::tempdir().unwrap();
    let reader = write(
        &folder.path().join("m.rd.zarr"),
        [16, 16],
        [15, 15],
        |_, _| 1e-6,
        0.0,
        |i, d, c| {
            let (a, b) = ((i % 16) as f64 / 16.0, (i / 16) as f64 / 16.0);
            let rest = 1.0 - 0.5 * a - 0.4 * b;
            let value = rest * profile(d, 1.0) + 0.5 * a * profile(d, 2.0) + 0.4 * b * profile(d, 5.0);
            (value + 1e-3 * noise(i, d, c)) as f32
        },
    )
    .unwrap();
    let options = FactorOptions { peak_shift: false, ..tucker() };
    let f = factor(&reader, &options, &Progress::silent()).unwrap();
    assert_eq!(f.material.header.terms, 3, "{}", f.choice);
}

#[test]
fn every_back_end_gives_the_same_material() {
    let response = |i: usize, d: [f64; 2], c: usize| {
        (profile(d, 1.0 + (i % 7) as f64 / 3.0) * (1.0 + 0.2 * c as f64 + 0.1 * (i / 7) as f64)) as f32
    };
    let of = |backend| run(&FactorOptions { backend: Some(backend), ..fixed(3, 3) }, [7, 6], [9, 9], response).unwrap();
    let full = of(Backend::Full);
    for backend in [Backend::Gram, Backend::Randomized] {
        let other = of(backend);
        for i in 0..42 {
            for (a, b) in full.material.evaluate_row(i).iter().zip(other.material.evaluate_row(i)) {
                // Both are rounded to f32; the cubic amplifies a few times.
                assert!((a - b).abs() < 1e-5, "{backend:?} row {i}: {a} {b}");
            }
        }
    }
}

#[test]
fn shifted_peaks_come_back_where_they_were_measured() {
    let centre = |i: usize| [(i % 3) as f64 - 1.0, (i / 3 % 3) as f64 - 1.0];
    let response = |i: usize, d: [f64; 2], c: usize| {
        (profile([d[0] - centre(i)[0], d[1] - centre(i)[1]], 2.0) * (1.0 + c as f64)) as f32
    };
    let f = run(&fixed(1, 1), [6, 6], [13, 13], response).unwrap();
    assert_eq!(f.material.header.extended, [15, 15]);
    for i in 0..36 {
        assert_eq!(f.material.shift[i].map(f64::from), centre(i));
        assert_eq!(Evaluator::new(&f.material).unwrap().response(i, centre(i).map(|v| v as isize)).unwrap()[0], {
            let row = f.material.evaluate_row(i);
            row.iter().step_by(3).copied().fold(0.0, f32::max)
        });
    }
    // One profile in nine places: one term once shifted. What the rows miss of the common window is filled by
    // the mean and two rounds of refinement; exact up to f32.
    assert!(f.rel_rmse < 1e-5, "{}", f.rel_rmse);
    let unshifted = run(&FactorOptions { peak_shift: false, ..fixed(1, 1) }, [6, 6], [13, 13], response).unwrap();
    assert!(unshifted.rel_rmse > 0.1, "{}", unshifted.rel_rmse);
}

#[test]
fn samples_that_were_not_measured_do_not_cost_terms() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let reader = write(&path, [8, 8], [9, 9], |_, _| 0.0, 0.0, |_, d, _| profile(d, 2.0) as f32).unwrap();
    let (header, rows) = (reader.header().clone(), header_rows(&reader));
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    for (i, mut row) in rows.into_iter().enumerate() {
        // A slab whose rim cuts windows.
        for k in 0..header.row_len() {
            let d = header.offset_px([k / 3 % 9, k / 3 / 9]);
            let (x, y) = ((i % 8) as isize + d[0], (i / 8) as isize + d[1]);
            if !(0..8).contains(&x) || !(0..8).contains(&y) {
                (row.response[k], row.valid[k]) = (0.0, false);
            }
        }
        writer.put(i, &row).unwrap();
    }
    writer.finish().unwrap();
    let f = factor(&MatrixReader::open(&path).unwrap(), &tucker(), &Progress::silent()).unwrap();
    assert_eq!(f.material.header.terms, 1, "{}", f.choice);
    assert!(f.rel_rmse < 1e-6, "{}", f.rel_rmse);
}

fn header_rows(reader: &MatrixReader) -> Vec<Row> {
    let block = reader.read(0..reader.header().rows()).unwrap();
    (0..block.rows)
        .map(|k| {
            let row = block.view(k);
            let valid = row.valid.iter().map(|&v| v != 0).collect();
            Row { response: row.response.to_vec(), variance: row.variance.to_vec(), valid }
        })
        .collect()
}

/// The matrix of a simulated capture and what `options` make of it.
fn simulated(slab: &simulate::SimulateOptions, options: &FactorOptions) -> (tempfile::TempDir, MatrixReader, Factored) {
    let (folder, dir) = common::capture(slab);
    let path = folder.path().join("m.rd.zarr");
    build_matrix(&dir, &BuildOptions::default(), &path, &Progress::silent()).unwrap();
    let reader = MatrixReader::open(&path).unwrap();
    let factored = factor(&reader, options, &Progress::silent()).unwrap();
    (folder, reader, factored)
}

#[test]
#[ignore = "slow: 7 s"]
fn a_drifted_capture_factors_as_well_as_an_undrifted_one_to_within_one_decibel() {
    let psnr_db = |drift_px: f64| {
        let slab = simulate::SimulateOptions {
            material: simulate::SlabMaterial::chessboard([4, 3]),
            grid: [13, 11],
            window: [17, 13],
            drift_px,
            ..common::bench()
        };
        let (folder, reader, factored) = simulated(&slab, &fixed(15, 7));
        let path = folder.path().join("m.safetensors");
        material::save(&factored.material, Precision::F32, &path).unwrap();
        evaluate(&Source::open(&path).unwrap(), &reader, &Progress::silent()).unwrap().psnr_db.unwrap()
    };
    let (still, drifted) = (psnr_db(0.0), psnr_db(1.0));
    // The decibel is what the project promises.
    assert!((still - drifted).abs() < 1.0, "{still} dB without drift, {drifted} dB with");
}

#[test]
fn a_homogeneous_slab_chooses_one_term_and_a_degree_that_ends_at_the_noise() {
    // Of coarse voxels, rows would differ by where a dot lies on them.
    let slab = simulate::SimulateOptions { grid: [13, 11], window: [17, 13], ..simulate::SimulateOptions::default() };
    let (_folder, reader, factored) = simulated(&slab, &tucker());
    let joint = factor(&reader, &FactorOptions::default(), &Progress::silent()).unwrap();
    assert_eq!(joint.material.header.terms, 1, "{}", joint.choice);
    assert_eq!(factored.material.header.terms, 1, "{}", factored.choice);
    assert!(factored.choice.contains("explains no more than noise"), "{}", factored.choice);
}

#[test]
fn settings_that_make_no_material_are_refused() {
    for options in [fixed(0, 1), fixed(1, 16)] {
        let refused = run(&options, [2, 2], [3, 3], |_, _, _| 1.0);
        assert!(matches!(refused, Err(acquire::Error::Setting { .. })), "{refused:?}");
    }
}

/// Four widths mixed unevenly over the slab, each channel another power of the mix: no model is exact.
fn uneven(i: usize, d: [f64; 2], c: usize) -> f32 {
    let (a, b) = ((i % 12) as f64 / 12.0, (i / 12) as f64 / 12.0);
    let value =
        (1.2 - a) * profile(d, 1.0 + b) + a * profile(d, 3.0) + 0.3 * (9.0 * a * b).sin().abs() * profile(d, 6.0);
    value.powf([0.9, 1.0, 1.15][c] + 0.1 * (a - b)) as f32
}

#[test]
fn a_target_is_reached_with_fewer_bytes_than_a_higher_one_and_a_budget_is_kept() {
    for model in [None, Some(Model::Joint), Some(Model::Tucker), Some(Model::Peers2006)] {
        let of =
            |goal| run(&FactorOptions { model, goal, ..FactorOptions::default() }, [12, 12], [11, 11], uneven).unwrap();
        let low = of(Goal::Psnr(45.0));
        assert!(
            low.psnr_db.unwrap() >= 45.0 || model == Some(Model::Peers2006),
            "{model:?} {:?} {}",
            low.psnr_db,
            low.choice
        );
        let high = of(Goal::Psnr(55.0));
        assert!(high.material.bytes_f32() >= low.material.bytes_f32(), "{model:?}: {} {}", low.choice, high.choice);
        let budget = high.material.bytes_f32();
        let held = of(Goal::Bytes(budget));
        assert!(held.material.bytes_f32() <= budget, "{model:?}: {} of {budget}", held.material.bytes_f32());
        // The same bytes hold at least about what they held when the other question was asked.
        assert!(held.psnr_db.unwrap() >= high.psnr_db.unwrap() - 0.5, "{model:?}: {} {}", held.choice, high.choice);
    }
}

#[test]
fn without_a_model_a_goal_takes_the_better_of_two() {
    let of = |model| {
        run(&FactorOptions { model, goal: Goal::Bytes(12_000), ..FactorOptions::default() }, [12, 12], [11, 11], uneven)
            .unwrap()
    };
    let [free, joint, tucker] = [None, Some(Model::Joint), Some(Model::Tucker)].map(of);
    let best = joint.psnr_db.unwrap().max(tucker.psnr_db.unwrap());
    assert_eq!(free.psnr_db, Some(best), "{}", free.choice);
}

#[test]
fn a_matrix_without_colour_has_no_colour_coefficients() {
    let f = run(&FactorOptions::default(), [9, 9], [9, 9], |i, d, _| uneven(i, d, 1)).unwrap();
    let h = &f.material.header;
    assert_eq!((h.planes(), h.degree, h.profile), (1, None, false), "{}", f.choice);
    assert!(f.rel_rmse < 1e-3, "{}", f.rel_rmse);
    assert!(f.choice.contains("no colour"), "{}", f.choice);
    let row = f.material.evaluate_row(40);
    assert!(row.chunks(3).all(|rgb| rgb[0] == rgb[1] && rgb[1] == rgb[2]));
    // One entry of colour, and it is no longer grey.
    let spot =
        |i: usize, d: [f64; 2], c: usize| uneven(i, d, 1) * if (i, c, d) == (33, 2, [0.0, 0.0]) { 1.5 } else { 1.0 };
    let colored = run(&FactorOptions::default(), [9, 9], [9, 9], spot).unwrap();
    assert_eq!(colored.material.header.planes(), 3, "{}", colored.choice);
}

#[test]
fn rows_that_do_not_fit_in_memory_give_the_same_material() {
    // Displaced peaks, so that gaps are filled anew at every pass.
    let moved = |i: usize, d: [f64; 2], c: usize| uneven(i, [d[0] - (i % 3) as f64 + 1.0, d[1]], c);
    let folder = tempfile::tempdir().unwrap();
    let reader = write(&folder.path().join("m.rd.zarr"), [12, 12], [11, 11], |_, _| 0.0, 0.0, moved).unwrap();
    for model in [Model::Joint, Model::Tucker, Model::Peers2006] {
        for backend in [Backend::Full, Backend::Gram, Backend::Randomized] {
            let of = |memory_bytes| {
                let options = FactorOptions {
                    model: Some(model),
                    terms: Some(6),
                    backend: Some(backend),
                    memory_bytes,
                    ..FactorOptions::default()
                };
                factor(&reader, &options, &Progress::silent()).unwrap()
            };
            let (kept, streamed) = (of(None), of(Some(1)));
            assert!(streamed.choice.contains("streamed") && !kept.choice.contains("streamed"));
            // Gaps are filled from the last round either way; where blocks end decides the order of some sums.
            let (a, b) = (kept.rel_rmse, streamed.rel_rmse);
            assert!((a - b).abs() < 1e-5 * a + 1e-9, "{model:?} {backend:?}: {a} {b}");
        }
    }
}

#[test]
fn shared_offset_maps_cost_what_they_are_said_to() {
    let f = run(
        &FactorOptions { model: Some(Model::Joint), terms: Some(10), ..FactorOptions::default() },
        [12, 12],
        [11, 11],
        uneven,
    )
    .unwrap();
    let OffsetFactors::Shared(shared) = &f.material.offset_factors else {
        panic!("thirty maps of three like channels")
    };
    assert_eq!(f.material.header.shared_maps, Some(shared.maps));
    let numbers = 10 + 144 * 10 + shared.maps * 121 + 30 * shared.maps;
    assert_eq!(f.material.bytes_f32(), 4 * numbers as u64);
}
