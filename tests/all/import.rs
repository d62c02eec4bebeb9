//! `acquire import`: a camera's folder sorted into shots, or refused by the first photograph that does not fit.

use crate::common::{acquire, files};
use acquire::capture::{Capture, ResponseCurve, Rig};
use acquire::patterns::Plan;
use acquire::radiance::Curve;
use std::path::{Path, PathBuf};

/// The capture of the checkout: 247 JPEG photographs.
const CAPTURE: &str = "captures";

/// A camera's folder with the capture's photographs as IMG_0001.JPG, IMG_0002.JPG, …, and the plan by which they were
/// shot.
struct Bench {
    folder: tempfile::TempDir,
    photographs: usize,
}

impl Bench {
    fn new() -> Self {
        Self::numbered_from(1)
    }

    fn numbered_from(first: usize) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (camera, plan) = (folder.path().join("camera"), folder.path().join("plan"));
        std::fs::create_dir_all(&camera).unwrap();
        std::fs::create_dir_all(plan.join("calibration")).unwrap();
        let capture = Capture::open(Path::new(CAPTURE), None).unwrap();
        std::fs::copy(&capture.rig_path, plan.join("calibration/rig.toml")).unwrap();
        Plan::of_capture(&capture).write(&plan).unwrap();
        let photographs: Vec<_> = capture.brackets.iter().flatten().map(|p| p.path.clone()).collect();
        for (k, path) in photographs.iter().enumerate() {
            // The counter goes from 9999 to 1.
            let number = (first + k - 1) % 9999 + 1;
            std::fs::copy(path, camera.join(format!("IMG_{number:04}.JPG"))).unwrap();
        }
        Self { folder, photographs: photographs.len() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn photograph(&self, number: usize) -> PathBuf {
        self.path(&format!("camera/IMG_{number:04}.JPG"))
    }

    fn import(&self, more: &[&str]) -> (i32, String, String) {
        let paths = ["camera", "plan", "out"].map(|p| self.path(p).to_str().unwrap().to_owned());
        acquire(&[&["import", &paths[0], "--plan", &paths[1], "--out", &paths[2]], more].concat())
    }

    /// The import must fail, naming all of `words`, and leave nothing.
    fn refused(&self, more: &[&str], words: &[&str]) {
        let before = std::fs::read_dir(self.folder.path()).unwrap().count();
        let (status, stdout, stderr) = self.import(more);
        assert_eq!((status, stdout.as_str()), (1, ""), "{stderr}");
        assert_eq!(stderr.matches("error: ").count(), 1, "{stderr}");
        assert!(stderr.contains("hint: "), "{stderr}");
        for word in words {
            assert!(stderr.contains(word), "\"{word}\" is not in: {stderr}");
        }
        assert_eq!(std::fs::read_dir(self.folder.path()).unwrap().count(), before, "something was left");
    }

    /// The import must give the capture that the photographs came from.
    fn gives_the_capture(&self, more: &[&str]) {
        let (status, _, stderr) = self.import(more);
        assert_eq!(status, 0, "{stderr}");
        let (a, b) = (files(Path::new(CAPTURE)), files(&self.path("out")));
        for (name, bytes) in a.iter().filter(|(name, _)| name.starts_with("photos/") || *name == "capture.toml") {
            assert!(b.get(name) == Some(bytes), "{name} differs");
        }
        // The capture, its checksums, its rig, and the record of what may be replaced.
        assert_eq!(b.len(), self.photographs + 4);
    }

    /// Moves the clock of a photograph: its time is text of fixed length.
    fn set_clock(&self, number: usize, change: impl Fn(&str) -> String) {
        let path = self.photograph(number);
        let mut bytes = std::fs::read(&path).unwrap();
        let at = bytes.windows(11).position(|w| w == b"2026:01:01 ").unwrap();
        let old = String::from_utf8(bytes[at..at + 19].to_vec()).unwrap();
        bytes[at..at + 19].copy_from_slice(change(&old).as_bytes());
        std::fs::write(&path, bytes).unwrap();
    }
}

#[test]
fn a_camera_s_folder_gives_the_same_matrix_byte_for_byte() {
    let bench = Bench::new();
    bench.gives_the_capture(&[]);
    let build = |capture: &str, out: &str| {
        let out = bench.path(out);
        let (status, _, stderr) = acquire(&["build-matrix", capture, "--out", out.to_str().unwrap()]);
        assert_eq!(status, 0, "{stderr}");
        files(&out)
    };
    let original = build(CAPTURE, "a.rd.zarr");
    let imported = build(bench.path("out").to_str().unwrap(), "b.rd.zarr");
    assert!(original.len() > 5 && original == imported);
}

#[test]
fn hidden_files_sidecars_and_other_spellings_do_not_disturb() {
    let bench = Bench::new();
    for name in [".hidden.jpg", "._IMG_0001.JPG", "IMG_0001.xmp", "IMG_0001.THM", "notes.txt"] {
        std::fs::write(bench.path("camera").join(name), "x").unwrap();
    }
    for number in 1..20 {
        let path = bench.photograph(number);
        std::fs::rename(&path, path.with_extension(["jpg", "jpeg", "Jpg"][number % 3])).unwrap();
    }
    let (status, _, stderr) = bench.import(&[]);
    assert_eq!(status, 0, "{stderr}");
    assert!(stderr.contains("247 photographs (.jpg, 5 other files ignored)"), "{stderr}");
}

#[test]
fn of_raw_and_jpeg_pairs_one_kind_is_taken_and_said() {
    let bench = Bench::new();
    for number in 1..=bench.photographs {
        // No raw file that anything could decode.
        std::fs::write(bench.photograph(number).with_extension("CR3"), "x").unwrap();
    }
    bench.refused(&["--take", "nef"], &["--take", "nef", "cr3, jpg"]);
    bench.refused(&["--take", "cr3"], &["IMG_0001.CR3", "no exposure time"]);
    let (status, _, stderr) = bench.import(&[]);
    assert_eq!(status, 0, "{stderr}");
    assert!(stderr.contains("(.jpg, 247 of other kinds left)"), "{stderr}");
}

#[test]
fn numbers_that_begin_anew_and_links_are_fine() {
    use std::os::unix::fs::MetadataExt;
    let bench = Bench::numbered_from(9900);
    // The photographs on both sides of the end within one second: only their numbers tell their order.
    for number in [9998, 9999, 1, 2] {
        bench.set_clock(number, |_| "2026:01:01 00:05:30".into());
    }
    let (status, _, stderr) = bench.import(&["--link"]);
    assert_eq!(status, 0, "{stderr}");
    let (from, to) = (bench.photograph(9999), bench.path("out/photos"));
    let inode = std::fs::metadata(from).unwrap().ino();
    let linked = std::fs::read_dir(to).unwrap().filter(|e| e.as_ref().unwrap().metadata().unwrap().ino() == inode);
    assert_eq!(linked.count(), 1);
}

#[test]
fn a_clock_that_was_set_back_is_overruled_by_the_numbers() {
    let bench = Bench::new();
    for number in 100..=bench.photographs {
        // Two days earlier from here on.
        bench.set_clock(number, |t| t.replace("2026:01:01", "2025:12:30"));
    }
    let (status, _, stderr) = bench.import(&[]);
    assert_eq!(status, 0, "{stderr}");
    assert!(stderr.contains("by the numbers in their names"), "{stderr}");
    let names =
        |dir: &Path| files(dir).into_iter().filter(|f| f.0.starts_with("photos/")).map(|f| f.0).collect::<Vec<_>>();
    assert_eq!(names(Path::new(CAPTURE)), names(&bench.path("out")));
}

#[test]
fn a_missing_photograph_is_named_by_the_one_that_follows() {
    let bench = Bench::new();
    // Shots of two: the second exposure of the second shot.
    std::fs::remove_file(bench.photograph(4)).unwrap();
    bench.refused(&[], &["IMG_0005.JPG", "reference-white", "exposure 2 of 2", "a photograph is missing before it"]);
}

#[test]
fn a_doubled_photograph_is_named() {
    let bench = Bench::new();
    std::fs::copy(bench.photograph(4), bench.path("camera/IMG_0004b.JPG")).unwrap();
    bench.refused(&[], &["IMG_0004b.JPG", "reference-black", "exposure 1 of 3", "an extra one"]);
}

#[test]
fn photographs_that_end_early_or_go_on_are_named() {
    let bench = Bench::new();
    let last = bench.photograph(bench.photographs);
    let kept = std::fs::read(&last).unwrap();
    std::fs::remove_file(&last).unwrap();
    bench.refused(&[], &["IMG_0246.JPG", "lattice-0062", "exposure 3 of 3", "the last photograph, 246 of 247"]);
    for number in [247, 248] {
        std::fs::write(bench.photograph(number), &kept).unwrap();
    }
    bench.refused(&[], &["IMG_0248.JPG", "no more than the plan's 247", "248 photographs"]);
}

#[test]
fn an_exposure_that_is_not_the_plan_s_is_named_with_both() {
    let bench = Bench::new();
    let (a, b) = (bench.photograph(246), bench.photograph(247));
    // The bracket's last two exposures exchanged in place: times and numbers stay.
    let swap = bench.path("camera/x");
    std::fs::rename(&a, &swap).unwrap();
    std::fs::rename(&b, &a).unwrap();
    std::fs::rename(&swap, &b).unwrap();
    bench.set_clock(246, |_| "2026:01:01 23:00:00".into());
    bench.set_clock(247, |_| "2026:01:01 23:00:01".into());
    bench.refused(&[], &["IMG_0246.JPG", "lattice-0062", "exposure 2 of 3, 1/64 s", "1/16 s"]);
}

#[test]
fn settings_that_change_are_named() {
    let bench = Bench::new();
    let path = bench.photograph(30);
    let mut bytes = std::fs::read(&path).unwrap();
    // PhotographicSensitivity, SHORT, one value: 100 to 200.
    let big = [0x88, 0x27, 0, 3, 0, 0, 0, 1, 0, 100];
    let at = bytes.windows(10).position(|w| w == big).unwrap();
    bytes[at + 9] = 200;
    std::fs::write(&path, bytes).unwrap();
    bench.refused(&[], &["IMG_0030.JPG", "ISO 100 as in the first", "200"]);
}

#[test]
fn folders_without_photographs_or_plan_are_refused() {
    let bench = Bench::new();
    std::fs::remove_dir_all(bench.path("camera")).unwrap();
    bench.refused(&[], &["camera"]);
    std::fs::create_dir(bench.path("camera")).unwrap();
    bench.refused(&[], &["FOLDER", "photographs"]);
    std::fs::remove_file(bench.path("plan/plan.toml")).unwrap();
    bench.refused(&[], &["plan.toml"]);
}

#[test]
fn photographs_without_exif_need_the_plan_s_word() {
    let bench = Bench::new();
    for number in 1..=bench.photographs {
        let path = bench.photograph(number);
        let pixels = image::open(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        pixels.save(path.with_extension("png")).unwrap();
    }
    bench.refused(&[], &["IMG_0001.png", "no exposure time"]);
    let (status, _, stderr) = bench.import(&["--exposures-from-plan"]);
    assert_eq!(status, 0, "{stderr}");
    let imported = Capture::open(&bench.path("out"), None).unwrap();
    let original = Capture::open(Path::new(CAPTURE), None).unwrap();
    let times = |c: &Capture| c.brackets.iter().flatten().map(|p| p.exposure_secs).collect::<Vec<_>>();
    assert_eq!(times(&imported), times(&original));
}

#[test]
fn a_capture_that_is_there_is_replaced_only_when_asked() {
    let bench = Bench::new();
    std::fs::create_dir(bench.path("out")).unwrap();
    std::fs::write(bench.path("out/notes.txt"), "years of work").unwrap();
    bench.refused(&[], &["--out", "--force"]);
    bench.refused(&["--force"], &["not replaced", "--out"]);
    std::fs::remove_file(bench.path("out/notes.txt")).unwrap();
    assert_eq!(bench.import(&[]).0, 0);
    bench.refused(&[], &["--out", "--force"]);
    bench.gives_the_capture(&["--force"]);
}

#[test]
fn a_response_curve_that_the_rig_names_comes_along() {
    let bench = Bench::new();
    let calibration = bench.path("plan/calibration");
    let mut rig = Rig::read(&calibration.join("rig.toml")).unwrap();
    rig.camera.response_curve = ResponseCurve::File("curve.toml".into());
    rig.write(&calibration).unwrap();
    bench.refused(&[], &["curve.toml"]);
    Curve::srgb().write(&calibration.join("curve.toml")).unwrap();
    let (status, _, stderr) = bench.import(&[]);
    assert_eq!(status, 0, "{stderr}");
    let [planned, imported] = [calibration, bench.path("out/calibration")].map(|c| files(&c));
    assert!(planned.len() == 2 && planned == imported);
}
