//! `check` says before what `build-matrix` says after: the same finding, put down to the same culprit, with the same
//! exit status.

use crate::common;
use crate::common::{acquire, copy_folder};
use acquire::capture::{Manifest, Pattern};
use acquire::simulate::SimulateOptions;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// A small capture, simulated once for all tests of this file.
fn original() -> &'static Path {
    static CAPTURE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let options = SimulateOptions { grid: [4, 3], window: [7, 5], exposures: 2, ..SimulateOptions::default() };
    &CAPTURE.get_or_init(|| common::capture(&options)).1
}

fn copy() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("capture");
    copy_folder(original(), &dir);
    (folder, dir)
}

/// The finding by which both refuse a capture, which must be one: `check` by all shots, so that nothing is left out.
fn refused(dir: &Path) -> serde_json::Value {
    let capture = dir.to_str().unwrap();
    let out = dir.with_extension("rd.zarr");
    let built = acquire(&["build-matrix", capture, "--json", "--out", out.to_str().unwrap()]);
    let checked = acquire(&["check", capture, "--json", "--lattice-shots", "100"]);
    assert_eq!((built.0, checked.0), (1, 1), "{} {}", built.2, checked.2);
    assert!(!out.exists());
    let object = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap_or_else(|e| panic!("{e}: {text}"));
    let (built, checked) = (object(&built.1), object(&checked.1));
    assert_eq!((built["built"].as_bool(), checked["would_build"].as_bool()), (Some(false), Some(false)));
    let [finding] = &built["findings"].as_array().unwrap()[..] else { panic!("{built}") };
    assert_eq!((finding["severity"].as_str(), finding["done"].as_str()), (Some("error"), Some("refused")));
    let same = |f: &&serde_json::Value| f["id"] == finding["id"] && f["culprit"] == finding["culprit"];
    let known = checked["findings"].as_array().unwrap().iter().find(same);
    let known = known.unwrap_or_else(|| panic!("build-matrix: {finding}, check: {checked}"));
    assert_eq!((&known["severity"], &known["done"]), (&finding["severity"], &finding["done"]));
    finding.clone()
}

fn photographs(dir: &Path, shot: &str) -> Vec<PathBuf> {
    let manifest = Manifest::read(dir).unwrap();
    let shot = manifest.shots.iter().find(|s| s.name == shot).unwrap();
    shot.photographs.iter().map(|p| dir.join(&p.file)).collect()
}

/// Writes a PNG again with its EXIF and other code values.
fn rewrite(path: &Path, bits: png::BitDepth, code: impl Fn(u16) -> u16) {
    let reader = png::Decoder::new(std::io::BufReader::new(std::fs::File::open(path).unwrap())).read_info().unwrap();
    let exif = reader.info().exif_metadata.clone();
    let pixels = image::open(path).unwrap().into_rgb16();
    let mut info = png::Info::with_size(pixels.width(), pixels.height());
    (info.color_type, info.bit_depth, info.exif_metadata) = (png::ColorType::Rgb, bits, exif);
    let codes = pixels.as_raw().iter().map(|&v| code(v));
    let bytes: Vec<u8> = match bits {
        png::BitDepth::Eight => codes.map(|v| v as u8).collect(),
        _ => codes.flat_map(u16::to_be_bytes).collect(),
    };
    let file = std::fs::File::create(path).unwrap();
    png::Encoder::with_info(file, info).unwrap().write_header().unwrap().write_image_data(&bytes).unwrap();
}

#[test]
fn what_is_wrong_with_files_and_fields_is_the_same_finding() {
    let lattice = "lattice-0000";
    type Break<'a> = &'a dyn Fn(&Path);
    let edit = |dir: &Path, file: &str, from: &str, to: &str| {
        let path = dir.join(file);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(text.contains(from), "{from}");
        std::fs::write(path, text.replacen(from, to, 1)).unwrap();
    };
    let cases: [(&str, Break); 7] = [
        ("missing-photograph", &|dir| std::fs::remove_file(&photographs(dir, lattice)[0]).unwrap()),
        ("broken-photograph", &|dir| {
            let path = &photographs(dir, lattice)[0];
            let bytes = std::fs::read(path).unwrap();
            std::fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
        }),
        ("wrong-size", &|dir| image::RgbImage::new(10, 12).save(&photographs(dir, lattice)[0]).unwrap()),
        ("no-exposure", &|dir| {
            let path = &photographs(dir, lattice)[0];
            image::open(path).unwrap().save(path).unwrap();
        }),
        ("same-exposure", &|dir| {
            let paths = photographs(dir, lattice);
            std::fs::copy(&paths[0], &paths[1]).unwrap();
        }),
        ("unusable-field", &|dir| edit(dir, "calibration/rig.toml", "focal_px = ", "focal_px = -")),
        ("stopped", &|dir| std::fs::remove_file(dir.join("capture.toml")).unwrap()),
    ];
    for (id, damage) in cases {
        let (_folder, dir) = copy();
        damage(&dir);
        assert_eq!(refused(&dir)["id"], id);
    }
}

#[test]
fn a_shot_in_eight_bits_is_the_cause_and_not_the_board_that_is_not_seen() {
    let (_folder, dir) = copy();
    for path in photographs(&dir, "board") {
        rewrite(&path, png::BitDepth::Eight, |v| v >> 8);
    }
    let finding = refused(&dir);
    assert_eq!(finding["id"], "depth-differs");
    assert_eq!((&finding["figures"]["shot"], &finding["figures"]["bits"]), (&"board".into(), &8.into()));
}

#[test]
fn values_shifted_by_bits_are_the_cause_and_not_the_exposure() {
    let (_folder, dir) = copy();
    let shot = "lattice-0003";
    for path in photographs(&dir, shot) {
        // As a converter fills 16 bits.
        rewrite(&path, png::BitDepth::Sixteen, |v| (u32::from(v) << 4).min(0xfff0) as u16);
    }
    let finding = refused(&dir);
    assert_eq!(finding["id"], "values-shifted", "{finding}");
    assert_eq!((&finding["figures"]["shot"], &finding["figures"]["bits"]), (&shot.into(), &4.into()));
}

#[test]
fn an_exchanged_pair_of_the_gray_code_is_the_cause_and_not_the_grid() {
    let original = Manifest::read(original()).unwrap();
    let find = |axis: usize, bit: u32, inverted: bool| {
        let is = |p: &Pattern| match *p {
            Pattern::GrayCode { axis: a, bit: b, inverse, .. } => (a as usize, b, inverse) == (axis, bit, inverted),
            _ => false,
        };
        original.shots.iter().position(|s| is(&s.pattern)).unwrap()
    };
    // The coarsest has 128 projector px: its exchange mirrors the map. The next leaves none. Of the finest, which have
    // edges where they had them before, an exchange does no harm.
    for (axis, bit) in [(0, 7), (0, 6), (1, 7), (1, 6)] {
        let (_folder, dir) = copy();
        let mut manifest = original.clone();
        let [a, b] = [find(axis, bit, false), find(axis, bit, true)];
        let other = manifest.shots[b].photographs.clone();
        manifest.shots[b].photographs = std::mem::replace(&mut manifest.shots[a].photographs, other);
        manifest.write(&dir).unwrap();
        let finding = refused(&dir);
        let names = [a, b].map(|s| manifest.shots[s].name.as_str());
        assert_eq!(finding["id"], "gray-pair-exchanged", "{names:?}: {finding}");
        assert_eq!(["shot", "inverse"].map(|f| finding["figures"][f].as_str().unwrap()), names);
    }
}

#[test]
fn damaged_exif_is_the_cause_of_an_unknown_exposure() {
    let (_folder, dir) = copy();
    let path = &photographs(&dir, "lattice-0001")[0];
    let pixels = image::open(path).unwrap().into_rgb16();
    let mut info = png::Info::with_size(pixels.width(), pixels.height());
    (info.color_type, info.bit_depth) = (png::ColorType::Rgb, png::BitDepth::Sixteen);
    // A directory of no fields whose next one lies at byte 1.
    info.exif_metadata = Some(b"MM\0*\0\0\0\x08\0\0\0\0\0\x01".to_vec().into());
    let bytes: Vec<u8> = pixels.as_raw().iter().flat_map(|v| v.to_be_bytes()).collect();
    let file = std::fs::File::create(path).unwrap();
    png::Encoder::with_info(file, info).unwrap().write_header().unwrap().write_image_data(&bytes).unwrap();
    let finding = refused(&dir);
    assert_eq!(
        (finding["id"].as_str(), finding["culprit"][0]["photograph"].as_str()),
        (Some("damaged-exif"), Some("photos/lattice-0001_0.png"))
    );
}

#[test]
fn a_matrix_keeps_the_records_beside_the_figures_and_the_program_prints_the_same() {
    let (_folder, dir) = copy();
    let mut manifest = Manifest::read(&dir).unwrap();
    let last = manifest.shots.iter().rposition(|s| matches!(s.pattern, Pattern::Lattice { .. })).unwrap();
    manifest.shots.remove(last);
    manifest.write(&dir).unwrap();
    let out = dir.with_extension("rd.zarr");
    let args = ["build-matrix", dir.to_str().unwrap(), "--json", "--out", out.to_str().unwrap()];
    let (status, stdout, stderr) = acquire(&args);
    assert_eq!(status, 0, "{stderr}");
    let object: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    let attributes = |out: &Path| -> serde_json::Value {
        let text = std::fs::read_to_string(out.join("zarr.json")).unwrap();
        serde_json::from_str::<serde_json::Value>(&text).unwrap()["attributes"].clone()
    };
    let kept = attributes(&out);
    let (kept, warnings) = (kept["findings"].as_array().unwrap(), kept["warnings"].as_array().unwrap());
    assert_eq!(kept.len(), object["findings"].as_array().unwrap().len());
    assert!(kept.iter().any(|f| f["id"] == "unlit-points"), "{kept:?}");
    for ((kept, printed), warning) in kept.iter().zip(object["findings"].as_array().unwrap()).zip(warnings) {
        assert_eq!(kept["id"], warning["warning"]);
        for field in ["id", "severity", "topic", "seen", "bound", "culprit", "done"] {
            assert_eq!(kept[field], printed[field]);
        }
        assert!(stderr.contains(&format!(
            "{}: {}",
            kept["severity"].as_str().unwrap(),
            kept["seen"].as_str().unwrap()
        )));
    }
}

#[test]
fn what_is_no_name_of_a_finding_cannot_be_accepted() {
    let (status, _, stderr) = acquire(&["build-matrix", "nowhere", "--accept", "photograph-disagree"]);
    assert_eq!(status, 1);
    assert!(stderr.contains("--accept") && stderr.contains("docs/findings.md"), "{stderr}");
}
