//! `acquire run`: a simulated capture to results and a report, as a person runs it.

use crate::common;
use crate::common::{acquire, capture};
use acquire::material::Responses;
use acquire::simulate::SimulateOptions;

#[test]
fn a_capture_becomes_results_with_a_report_that_needs_no_network() {
    let (folder, dir) = capture(&SimulateOptions { grid: [7, 5], window: [11, 7], ..common::bench() });
    let out = folder.path().join("results");
    let (capture, results) = (dir.to_str().unwrap(), out.to_str().unwrap());
    let (status, stdout, stderr) = acquire(&["run", capture, "--out", results, "--terms", "2", "--degree", "2"]);
    assert_eq!((status, stdout.as_str()), (0, ""), "{stderr}");
    for line in ["material against matrix: rel_rmse ", "matrix against truth: rel_rmse ", "report:  "] {
        assert!(stderr.contains(line), "{stderr}");
    }
    for name in ["matrix.rd.zarr/zarr.json", "material.exr", "material.npz"] {
        assert!(out.join(name).is_file(), "{name}");
    }
    let [plain, coded] = ["material.safetensors", "material.acq"].map(|name| {
        let bytes = std::fs::metadata(out.join(name)).unwrap().len();
        assert!(stderr.contains(&format!("{name}: {bytes} bytes, ")), "{stderr}");
        acquire::material::load(&out.join(name)).unwrap()
    });
    let said = stderr.split_once(" off it in rel_rmse").unwrap().0.rsplit_once(' ').unwrap().1;
    let (mut error, mut size) = (0.0, 0.0);
    for i in 0..35 {
        for (a, b) in Responses::new(&plain).row(i).iter().zip(Responses::new(&coded).row(i)) {
            error += f64::from(a - b).powi(2);
            size += f64::from(*a).powi(2);
        }
    }
    // Five places are printed; the coder keeps to three thousandths.
    let added = (error / size).sqrt();
    assert!((said.parse::<f64>().unwrap() - added).abs() < 1e-5 && added <= 3e-3, "{said} {added}");
    let measures: serde_json::Value =
        serde_json::from_slice(&std::fs::read(out.join("measures.json")).unwrap()).unwrap();
    assert!(measures["matrix_against_truth"]["rel_rmse"].as_f64().unwrap() < 0.03);
    let html = std::fs::read_to_string(out.join("report/report.html")).unwrap();
    assert!(html.contains("of 7×5 points, 11×7 window; material "));
    assert_eq!(html.matches("http").count(), html.matches("http://www.w3.org/2000/svg").count());

    let (status, _, stderr) = acquire(&["run", capture, "--out", results]);
    assert!(status == 1 && stderr.contains("--out") && stderr.contains("--force"), "{stderr}");
    let (status, _, stderr) = acquire(&["run", capture, "--out", results, "--force", "--quiet", "--terms", "1"]);
    assert_eq!((status, stderr.as_str()), (0, ""));
    // The capture and the results, no scratch folder.
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn a_run_that_fails_leaves_nothing() {
    let (folder, dir) = capture(&SimulateOptions { grid: [5, 4], window: [9, 7], ..common::bench() });
    std::fs::remove_file(dir.join("calibration/rig.toml")).unwrap();
    let out = folder.path().join("results");
    let (status, _, stderr) = acquire(&["run", dir.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert!(status == 1 && stderr.contains("rig.toml") && stderr.contains("hint: "), "{stderr}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
