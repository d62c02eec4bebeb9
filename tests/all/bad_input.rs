//! Whatever is wrong with the input: exit 1, one message that names file and field, a hint, and no output that looks
//! whole.

use crate::common;
use crate::common::{acquire, copy_folder};
use acquire::simulate::SimulateOptions;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A small capture, simulated once for all tests of this file.
fn original() -> &'static Path {
    static CAPTURE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let options = SimulateOptions { grid: [4, 3], window: [7, 5], exposures: 2, ..SimulateOptions::default() };
    &CAPTURE.get_or_init(|| common::capture(&options)).1
}

/// A copy of the capture to damage, with room for outputs beside it.
struct Bench {
    folder: tempfile::TempDir,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        copy_folder(original(), &folder.path().join("capture"));
        Self { folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn edit(&self, file: &str, change: impl Fn(String) -> String) {
        let path = self.path("capture").join(file);
        let text = std::fs::read_to_string(&path).unwrap();
        let changed = change(text.clone());
        assert_ne!(text, changed, "the edit of {file} changed nothing");
        std::fs::write(path, changed).unwrap();
    }

    /// A photograph of the first lattice shot.
    fn lattice_photograph(&self) -> PathBuf {
        let photos = self.path("capture/photos");
        let mut names: Vec<_> = std::fs::read_dir(&photos).unwrap().map(|e| e.unwrap().path()).collect();
        names.sort();
        names.into_iter().find(|p| p.to_string_lossy().contains("lattice")).unwrap()
    }

    /// `build-matrix` must fail, naming all of `words`, and leave nothing beside the capture; `check` must have known
    /// it.
    fn build_fails(&self, words: &[&str]) {
        let (capture, out) = (self.path("capture"), self.path("m.rd.zarr"));
        self.fails(&["build-matrix", capture.to_str().unwrap(), "--out", out.to_str().unwrap()], words);
        let (status, _, stderr) = acquire(&["check", capture.to_str().unwrap()]);
        assert_eq!(status, 1, "{stderr}");
        assert!(stderr.contains("would not build") && stderr.contains("hint: "), "{stderr}");
        for word in words {
            assert!(stderr.contains(word), "check: \"{word}\" is not in: {stderr}");
        }
    }

    fn fails(&self, args: &[&str], words: &[&str]) {
        let before = self.listing();
        let (status, stdout, stderr) = acquire(args);
        assert_eq!(status, 1, "{stderr}");
        assert_eq!(stdout, "");
        assert_eq!(stderr.matches("error: ").count(), 1, "{stderr}");
        assert!(stderr.contains("hint: "), "{stderr}");
        for word in words {
            assert!(stderr.contains(word), "\"{word}\" is not in: {stderr}");
        }
        assert_eq!(before, self.listing(), "a failed run left something");
    }

    fn listing(&self) -> Vec<PathBuf> {
        let mut names: Vec<_> = std::fs::read_dir(self.folder.path()).unwrap().map(|e| e.unwrap().path()).collect();
        names.sort();
        names
    }
}

#[test]
fn a_folder_that_is_not_there_is_refused() {
    let bench = Bench::new();
    let missing = bench.path("nowhere");
    bench.fails(&["build-matrix", missing.to_str().unwrap(), "--out", bench.path("m").to_str().unwrap()], &["nowhere"]);
}

#[test]
fn a_folder_without_a_manifest_is_refused() {
    let bench = Bench::new();
    std::fs::remove_file(bench.path("capture/capture.toml")).unwrap();
    bench.build_fails(&["capture.toml"]);
}

#[test]
fn a_capture_without_a_rig_is_refused() {
    let bench = Bench::new();
    std::fs::remove_dir_all(bench.path("capture/calibration")).unwrap();
    bench.build_fails(&["rig.toml", "--calibration"]);
}

#[test]
fn an_unknown_field_in_the_manifest_is_refused() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| t.replace("pitch_mm", "pitch_inch"));
    bench.build_fails(&["capture.toml", "pitch_inch"]);
}

#[test]
fn a_value_out_of_range_is_refused() {
    let bench = Bench::new();
    bench.edit("calibration/rig.toml", |t| t.replace("focal_px = ", "focal_px = -"));
    bench.build_fails(&["rig.toml", "camera.focal_px"]);
}

#[test]
fn a_missing_photograph_is_refused_before_any_work() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    std::fs::remove_file(&photograph).unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap(), "missing"]);
}

#[test]
fn a_photograph_cut_in_half_is_refused() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    let bytes = std::fs::read(&photograph).unwrap();
    std::fs::write(&photograph, &bytes[..bytes.len() / 2]).unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap(), "decoded"]);
}

#[test]
fn an_empty_photograph_is_refused() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    std::fs::write(&photograph, b"").unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap()]);
}

#[test]
fn a_photograph_of_another_size_is_refused() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    image::RgbImage::new(10, 12).save(&photograph).unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap(), "size", "10 × 12 px"]);
}

#[test]
fn a_head_of_a_thousand_megapixels_is_refused_before_anything_is_allocated() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    let mut bytes = std::fs::read(&photograph).unwrap();
    // Width and height behind the signature and the chunk's head; its checksum is then wrong, as a forger would mend
    // it.
    bytes[16..24].copy_from_slice(&[0, 0, 0x7d, 0, 0, 0, 0x7d, 0]);
    let crc = crc32(&bytes[12..29]);
    bytes[29..33].copy_from_slice(&crc.to_be_bytes());
    std::fs::write(&photograph, &bytes).unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap(), "32000 × 32000 px"]);
}

/// The checksum of PNG's chunks (CRC-32, reflected).
fn crc32(bytes: &[u8]) -> u32 {
    let step = |crc: u32, &byte: &u8| {
        (0..8).fold(crc ^ u32::from(byte), |c, _| if c & 1 == 1 { 0xedb8_8320 ^ (c >> 1) } else { c >> 1 })
    };
    !bytes.iter().fold(!0, step)
}

#[test]
fn a_window_wider_than_the_picture_is_refused() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| t.replacen("samples = [7, 5]", "samples = [4001, 5]", 1));
    bench.build_fails(&["capture.toml", "window.samples"]);
}

#[test]
fn a_photograph_without_any_exposure_time_is_refused() {
    let bench = Bench::new();
    let photograph = bench.lattice_photograph();
    // Saved again by a program that drops EXIF.
    image::open(&photograph).unwrap().save(&photograph).unwrap();
    bench.build_fails(&[photograph.file_name().unwrap().to_str().unwrap(), "exposure_secs"]);
}

#[test]
fn two_photographs_of_a_shot_with_the_same_exposure_are_refused() {
    let bench = Bench::new();
    let first = bench.lattice_photograph();
    let second = PathBuf::from(first.to_string_lossy().replace("_0.", "_1."));
    assert!(second.exists());
    std::fs::copy(&first, &second).unwrap();
    bench.build_fails(&[
        "capture.toml",
        first.file_name().unwrap().to_str().unwrap(),
        second.file_name().unwrap().to_str().unwrap(),
    ]);
}

#[test]
fn a_dot_that_is_saturated_in_every_exposure_is_refused() {
    let bench = Bench::new();
    let first = bench.lattice_photograph();
    let size = image::image_dimensions(&first).unwrap();
    let white = image::ImageBuffer::<image::Rgb<u16>, Vec<u16>>::from_pixel(size.0, size.1, image::Rgb([65_535; 3]));
    let mut names = Vec::new();
    for k in 0..2 {
        let path = PathBuf::from(first.to_string_lossy().replace("_0.", &format!("_{k}.")));
        white.save(&path).unwrap();
        names.push(format!("photos/{}", path.file_name().unwrap().to_str().unwrap()));
    }
    bench.edit("capture.toml", |t| {
        let mut t = t;
        for (k, name) in names.iter().enumerate() {
            t = t.replace(
                &format!("file = \"{name}\""),
                &format!("file = \"{name}\"\nexposure_secs = {}", 0.01 * (k + 1) as f64),
            );
        }
        t
    });
    bench.build_fails(&[&names[0], "saturated"]);
}

#[test]
fn a_pattern_that_names_a_dot_outside_the_grid_is_refused() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| t.replacen("dots = [[0, 0]", "dots = [[7, 0]", 1));
    bench.build_fails(&["capture.toml", "[7, 0]"]);
}

#[test]
fn a_dot_that_lands_outside_the_slab_is_refused() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| {
        let line = t.lines().find(|l| l.starts_with("size_mm")).unwrap().to_owned();
        t.replace(&line, "size_mm = [0.5, 0.5]")
    });
    bench.build_fails(&["capture.toml", "slab"]);
}

#[test]
fn a_board_that_is_not_in_the_picture_is_refused() {
    let bench = Bench::new();
    bench.edit("calibration/rig.toml", |t| t.replace("inner_corners = [", "inner_corners = [2"));
    bench.build_fails(&["board", "corners"]);
}

#[test]
fn an_output_that_cannot_be_written_is_refused() {
    let bench = Bench::new();
    std::fs::write(bench.path("file"), b"not a folder").unwrap();
    let out = bench.path("file/m.rd.zarr");
    bench.fails(
        &["build-matrix", bench.path("capture").to_str().unwrap(), "--out", out.to_str().unwrap()],
        &["m.rd.zarr"],
    );
}

#[test]
fn an_output_that_is_not_a_matrix_is_not_overwritten() {
    let bench = Bench::new();
    std::fs::write(bench.path("notes.txt"), b"years of work").unwrap();
    let out = bench.path("notes.txt");
    bench.fails(
        &["build-matrix", bench.path("capture").to_str().unwrap(), "--out", out.to_str().unwrap()],
        &["notes.txt"],
    );
    assert_eq!(std::fs::read(out).unwrap(), b"years of work");
}

#[test]
fn an_unknown_option_is_exit_1() {
    let (status, stdout, stderr) = acquire(&["build-matrix", "x", "--frobnicate"]);
    assert_eq!((status, stdout.as_str()), (1, ""));
    assert!(stderr.contains("--frobnicate"));
}

#[test]
fn a_shot_whose_reference_dots_are_not_where_they_should_be_is_refused() {
    let bench = Bench::new();
    let dir = bench.path("capture");
    let mut manifest = acquire::capture::Manifest::read(&dir).unwrap();
    for dot in &mut manifest.reference_dots.as_mut().unwrap().projector_px {
        dot[0] += 25.0;
    }
    manifest.write(&dir).unwrap();
    bench.build_fails(&["lattice-0", "reference dots"]);
}

#[test]
fn numbers_that_make_no_sense_are_refused_by_name() {
    for (file, from, to, field) in [
        ("capture.toml", "points = [4, 3]", "points = [65535, 65535]", "grid.points"),
        ("capture.toml", "samples = [7, 5]", "samples = [4095, 4095]", "window.samples"),
        ("capture.toml", "pitch_mm = 0.5", "pitch_mm = 1e-308", "window.pitch_mm"),
        ("capture.toml", "pitch_mm = 0.5", "pitch_mm = nan", "window.pitch_mm"),
        ("capture.toml", "size_mm = [", "size_mm = [1e308, 1.0] # [", "slab.size_mm"),
        ("capture.toml", "dot_projector_px = 3", "dot_projector_px = 4294967296", "grid.dot_projector_px"),
        ("capture.toml", "dot_projector_px = 3", "dot_projector_px = 1000", "grid.dot_projector_px"),
        ("capture.toml", "step_projector_px = [4.0", "step_projector_px = [inf", "grid.step_projector_px"),
        ("capture.toml", "step_projector_px = [4.0", "step_projector_px = [1000.0", "projector.size_px"),
        ("capture.toml", "\nprojector_px = [[", "\nprojector_px = [[nan, 1.0], [", "reference_dots.projector_px"),
        ("capture.toml", "board_0.png\"", "board_0.png\"\nexposure_secs = 1e-308", "exposure_secs"),
        ("calibration/rig.toml", "principal_px = [", "principal_px = [nan, 1.0] # [", "camera.principal_px"),
        ("calibration/rig.toml", "origin_mm = [", "origin_mm = [inf, 1.0] # [", "board.origin_mm"),
        ("calibration/rig.toml", "vignetting = [", "vignetting = [1e18, ", "camera.vignetting"),
        ("calibration/rig.toml", "vignetting = [", "vignetting = [-1e3, ", "camera.vignetting"),
    ] {
        let bench = Bench::new();
        bench.edit(file, |t| t.replacen(from, to, 1));
        bench.build_fails(&[file, field]);
    }
}

#[test]
fn a_jpeg_cut_in_its_pixels_is_refused() {
    let options = SimulateOptions {
        grid: [4, 3],
        window: [7, 5],
        exposures: 2,
        format: acquire::simulate::FileFormat::Jpeg,
        ..SimulateOptions::default()
    };
    let (folder, dir) = common::capture(&options);
    let bench = Bench { folder };
    let photograph = dir.join("photos/reference-white_0.jpg");
    let bytes = std::fs::read(&photograph).unwrap();
    std::fs::write(&photograph, &bytes[..bytes.len() - 100]).unwrap();
    bench.build_fails(&["reference-white_0.jpg", "ends before the image"]);
}

#[test]
fn an_output_that_is_an_input_is_refused() {
    let bench = Bench::new();
    let path = |name: &str| bench.path(name).to_str().unwrap().to_owned();
    let (capture, matrix, material) = (path("capture"), path("m.rd.zarr"), path("m.safetensors"));
    assert_eq!(acquire(&["build-matrix", &capture, "--out", &matrix]).0, 0);
    assert_eq!(acquire(&["factor", &matrix, "--out", &material]).0, 0);
    std::fs::write(path("light.png"), b"an image").unwrap();
    let before = std::fs::read(&material).unwrap();
    bench.fails(&["factor", &matrix, "--out", &path("m.rd.zarr/zarr.json")], &["--out", "lies in the input"]);
    bench.fails(&["export", &material, "--to", "npz", "--out", &material], &["--out", "input"]);
    bench.fails(&["relight", &material, "--light", "spot", "--out", &material], &["--out", "input"]);
    // The picture for viewers would go where the light is.
    bench.fails(
        &["relight", &material, "--light", &path("light.png"), "--out", &path("light.exr")],
        &["--out", "light.png"],
    );
    bench.fails(&["build-matrix", &capture, "--out", &path("capture/truth.rd.zarr")], &["--out", "truth"]);
    assert_eq!(std::fs::read(&material).unwrap(), before);
    assert_eq!(acquire(&["evaluate", &material, &matrix]).0, 0);
}

#[test]
fn a_simulation_replaces_simulations_only() {
    let bench = Bench::new();
    let photographs = bench.path("photographs");
    std::fs::create_dir(&photographs).unwrap();
    std::fs::write(photographs.join("capture.toml"), b"years of work").unwrap();
    let simulate =
        |dir: &str| ["simulate", dir, "--grid", "1", "--window", "3", "--exposures", "1", "--force"].map(str::to_owned);
    for dir in [photographs.to_str().unwrap(), "..", "."] {
        let args = simulate(dir);
        bench.fails(&args.each_ref().map(String::as_str), &["not replaced"]);
    }
    assert_eq!(std::fs::read(photographs.join("capture.toml")).unwrap(), b"years of work");
    let args = simulate(bench.path("simulated").to_str().unwrap());
    for _ in 0..2 {
        assert_eq!(acquire(&args.each_ref().map(String::as_str)).0, 0);
    }
    // A photograph that somebody put beside the simulated ones.
    let precious = bench.path("simulated/photos/IMG_0001.ARW");
    std::fs::write(&precious, b"years of work").unwrap();
    bench.fails(&args.each_ref().map(String::as_str), &["IMG_0001.ARW", "not replaced"]);
    assert!(precious.is_file());
}

#[test]
fn options_are_checked_before_any_work() {
    let bench = Bench::new();
    let (capture, out) = (bench.path("capture"), bench.path("results"));
    let run = ["run", capture.to_str().unwrap(), "--out", out.to_str().unwrap()];
    for option in [["--degree", "16"], ["--terms", "0"], ["--threads", "100000"], ["--threads", "0"]] {
        let args = [&run[..], &option[..]].concat();
        bench.fails(&args, &[option[0]]);
        assert!(!acquire(&args).2.contains("R_d of"), "{option:?}");
    }
}

#[test]
fn a_truth_of_another_shape_is_refused_before_any_work() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| t.replace("samples = [7, 5]", "samples = [5, 7]"));
    let (capture, out) = (bench.path("capture"), bench.path("results"));
    let run = ["run", capture.to_str().unwrap(), "--out", out.to_str().unwrap()];
    bench.fails(&run, &["truth.rd.zarr", "capture.toml", "window"]);
    assert!(!acquire(&run).2.contains("R_d of"));
}

#[test]
fn a_capture_that_lights_no_dot_is_refused() {
    let bench = Bench::new();
    bench.edit("capture.toml", |t| {
        let lines = t.lines().map(|l| if l.starts_with("dots = ") { "dots = []" } else { l });
        lines.collect::<Vec<_>>().join("\n")
    });
    bench.build_fails(&["capture.toml", "dots"]);
}

#[test]
fn a_matrix_that_announces_more_than_it_holds_is_refused() {
    let bench = Bench::new();
    let matrix = bench.path("capture/truth.rd.zarr");
    let rewrite = |name: &str, change: &dyn Fn(&mut serde_json::Value)| {
        let path = matrix.join(name).join("zarr.json");
        let mut value = serde_json::from_str(&std::fs::read_to_string(&path).unwrap()).unwrap();
        change(&mut value);
        std::fs::write(path, value.to_string()).unwrap();
    };
    let out = bench.path("m.safetensors");
    rewrite("", &|v| v["attributes"]["camera_px_per_mm"] = serde_json::json!(1.5));
    bench.fails(&["factor", matrix.to_str().unwrap(), "--out", out.to_str().unwrap()], &["attributes", "changed"]);
    // As a forger would mend it.
    rewrite("", &|v| drop(v["attributes"].as_object_mut().unwrap().remove("checksum")));
    for name in ["response", "variance", "valid"] {
        rewrite(name, &|v| v["shape"] = serde_json::json!([65535, 65535, 5, 7, 3]));
    }
    for name in ["x_i_mm", "y_i_mm", "position_sd_mm", "shot"] {
        rewrite(name, &|v| v["shape"] = serde_json::json!([65535, 65535]));
    }
    bench
        .fails(&["factor", matrix.to_str().unwrap(), "--out", out.to_str().unwrap()], &["response", "4294836225 rows"]);
    rewrite("response", &|v| v["shape"] = serde_json::json!([3, 0, 5, 7, 3]));
    bench.fails(&["factor", matrix.to_str().unwrap(), "--out", out.to_str().unwrap()], &["response", "x_i"]);
    // Chunks that would take 10^19 bytes: the shape is possible, memory for one of them is not.
    rewrite("response", &|v| {
        v["shape"] = serde_json::json!([3, 4, 5, 7, 3]);
        v["chunk_grid"]["configuration"]["chunk_shape"] = serde_json::json!([1, 1_u64 << 63, 5, 7, 3]);
    });
    bench.fails(&["factor", matrix.to_str().unwrap(), "--out", out.to_str().unwrap()], &["response", "chunks"]);
}

#[test]
fn nobody_listening_does_not_end_the_work() {
    let bench = Bench::new();
    let full = || std::fs::File::options().write(true).open("/dev/full").unwrap();
    let out = bench.path("m.rd.zarr");
    let status = std::process::Command::new(env!("CARGO_BIN_EXE_acquire"))
        .args(["build-matrix", bench.path("capture").to_str().unwrap(), "--out", out.to_str().unwrap()])
        .stderr(full())
        .status()
        .unwrap();
    assert!(status.success() && out.is_dir());
    let status = std::process::Command::new(env!("CARGO_BIN_EXE_acquire")).arg("run").stderr(full()).status().unwrap();
    assert_eq!(status.code(), Some(1));
}
