//! Whatever is wrong with the input: exit 1, one message that names file and field, a hint, and no output that looks whole.

mod common;

use acquire::simulate::Options;
use common::{acquire, copy_folder};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A small capture, simulated once for all tests of this file.
fn original() -> &'static Path {
    static CAPTURE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let options = Options { grid: 3, window: 5, exposures: 2, ..Options::default() };
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

    /// `build-matrix` must fail, naming all of `words`, and leave nothing beside the capture.
    fn build_fails(&self, words: &[&str]) {
        self.fails(
            &[
                "build-matrix",
                self.path("capture").to_str().unwrap(),
                "--out",
                self.path("m.rd.zarr").to_str().unwrap(),
            ],
            words,
        );
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
