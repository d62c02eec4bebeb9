//! The same bench seen by cameras of more pixels.

use crate::common;
use crate::common::compare;
use acquire::Warning;
use acquire::pipeline::{BuildOptions, Resolution, Working, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{FileFormat, SimulateOptions, SlabMaterial};

/// Builds it at a resolution; what was chosen, the comparison with the truth, and the findings.
fn built(dir: &std::path::Path, resolution: Resolution) -> (Working, common::Comparison, Vec<Warning>) {
    let out = dir.with_extension("rd.zarr");
    let options = BuildOptions { resolution, ..BuildOptions::default() };
    let report = build_matrix(dir, &options, &out, &Progress::silent()).unwrap();
    (report.working, compare(&out, &dir.join("truth.rd.zarr")), report.warnings)
}

fn bench(camera_px_per_sample: f64) -> SimulateOptions {
    let material = SlabMaterial::chessboard([3, 2]);
    // The white reference's error, which all samples have in common, would be most of it.
    SimulateOptions {
        material,
        grid: [4, 3],
        window: [11, 7],
        exposures: 3,
        camera_px_per_sample,
        white_unevenness: 0.0,
        ..common::bench()
    }
}

#[test]
fn a_camera_of_six_times_the_pixels_gives_the_same_matrix_from_blocks_of_them() {
    let (_folder, dir) = common::capture(&bench(18.0));
    let (full, whole, warnings) = built(&dir, Resolution::Full);
    assert_eq!(full, Working { factor: 1, px_per_sample: None });
    assert!(warnings.is_empty(), "{warnings:?}");
    let (working, reduced, warnings) = built(&dir, Resolution::Auto);
    // 18 asked for at the slab's centre; perspective and tilt change it by a few per cent over the slab.
    assert_eq!(working.factor, 2);
    assert!((working.px_per_sample.unwrap() / 18.0 - 1.0).abs() < 0.05, "{working:?}");
    assert!(warnings.is_empty(), "{warnings:?}");
    println!("{whole:?}\n{reduced:?}");
    // The same light: noise is the same, and what the reconstruction adds at 9 px a sample is below a thousandth
    // (docs/accuracy.md).
    assert!(reduced.rel_rmse < whole.rel_rmse + 1e-3);
    assert!((0.93..0.98).contains(&reduced.coverage), "{}", reduced.coverage);
    // And coarser, as asked.
    let (working, coarse, _) = built(&dir, Resolution::PxPerSample(4.0));
    assert_eq!(working.factor, 4);
    assert!(coarse.rel_rmse < whole.rel_rmse + 4e-3, "{coarse:?}");
}

#[test]
fn means_are_not_taken_where_code_values_are_a_curve_of_light_or_pixels_are_few() {
    let (_folder, dir) = common::capture(&SimulateOptions { format: FileFormat::Jpeg, grid: [2, 2], ..bench(16.5) });
    assert_eq!(built(&dir, Resolution::Auto).0, Working { factor: 1, px_per_sample: None });
    let (_folder, dir) = common::capture(&bench(3.0));
    assert_eq!(built(&dir, Resolution::Auto).0, Working { factor: 1, px_per_sample: None });
}
