//! `acquire check`: what can be known before the work. That it fails wherever `build-matrix` does is in `bad_input.rs`.

use crate::common;
use crate::common::{acquire, copy_folder};
use acquire::capture::{Manifest, Pattern};
use acquire::simulate::SimulateOptions;
use exif::{Field, In, Rational, Tag, Value};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Nine lattice shots of four dots each, simulated once for all tests of this file.
fn original() -> &'static Path {
    static CAPTURE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let options =
        SimulateOptions { grid: [9, 6], window: [7, 5], spacing: Some([3, 3]), exposures: 3, ..common::bench() };
    &CAPTURE.get_or_init(|| common::capture(&options)).1
}

fn copy() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("capture");
    copy_folder(original(), &dir);
    (folder, dir)
}

/// Runs `check --json` and gives the exit status and the object.
fn check(dir: &Path, more: &[&str]) -> (i32, serde_json::Value) {
    let (status, stdout, stderr) = acquire(&[&["check", dir.to_str().unwrap(), "--json"], more].concat());
    let object = serde_json::from_str(&stdout).unwrap_or_else(|e| panic!("{e}: {stdout} {stderr}"));
    (status, object)
}

/// The figures of the findings of one kind, and their severity beside them.
fn found(object: &serde_json::Value, kind: &str) -> Vec<serde_json::Value> {
    let of_kind = object["findings"].as_array().unwrap().iter().filter(|f| f["id"] == kind);
    let figures = of_kind.map(|f| {
        let mut figures = f["figures"].clone();
        figures["severity"] = f["severity"].clone();
        figures
    });
    figures.collect()
}

fn edit_manifest(dir: &Path, change: impl Fn(&mut Manifest)) {
    let mut manifest = Manifest::read(dir).unwrap();
    change(&mut manifest);
    manifest.write(dir).unwrap();
}

fn lattice(manifest: &Manifest) -> Vec<usize> {
    (0..manifest.shots.len()).filter(|&s| matches!(manifest.shots[s].pattern, Pattern::Lattice { .. })).collect()
}

/// Writes a PNG again with other EXIF fields and the same pixels.
fn write_exif(path: &Path, fields: &[(Tag, Value)]) {
    write_block(path, Some(exif_block(fields)));
}

fn exif_block(fields: &[(Tag, Value)]) -> Vec<u8> {
    let fields: Vec<Field> =
        fields.iter().map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() }).collect();
    let mut writer = exif::experimental::Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut block = std::io::Cursor::new(Vec::new());
    writer.write(&mut block, false).unwrap();
    block.into_inner()
}

fn write_block(path: &Path, exif: Option<Vec<u8>>) {
    let pixels = image::open(path).unwrap().into_rgb16();
    let mut info = png::Info::with_size(pixels.width(), pixels.height());
    info.color_type = png::ColorType::Rgb;
    info.bit_depth = png::BitDepth::Sixteen;
    info.exif_metadata = exif.map(Into::into);
    let bytes: Vec<u8> = pixels.as_raw().iter().flat_map(|v| v.to_be_bytes()).collect();
    let mut png = png::Encoder::with_info(std::fs::File::create(path).unwrap(), info).unwrap().write_header().unwrap();
    png.write_image_data(&bytes).unwrap();
}

fn ascii(text: &str) -> Value {
    Value::Ascii(vec![text.as_bytes().to_vec()])
}

fn secs(numerator: u32, denominator: u32) -> Value {
    Value::Rational(vec![Rational { num: numerator, denom: denominator }])
}

#[test]
fn a_good_capture_would_build_and_its_figures_are_those_of_the_bench() {
    let (status, object) = check(original(), &[]);
    // Dots of one shot are three samples apart, windows are seven wide: that alone is to be said.
    assert_eq!((status, object["would_build"].as_bool()), (0, Some(true)));
    let findings = object["findings"].as_array().unwrap();
    assert_eq!(findings.len(), 1, "{findings:?}");
    assert_eq!(findings[0]["id"], "cross-talk");
    let figures = &object["figures"];
    let files = std::fs::read_dir(original().join("photos")).unwrap().count() as u64;
    assert_eq!((figures["photographs"].as_u64(), figures["lattice_shots"].as_u64()), (Some(files), Some(9)));
    assert_eq!((figures["points_lit"].as_u64(), figures["dots_looked_at"].as_u64()), (Some(54), Some(48)));
    // The simulated lens does not blur; noise of some per cent at the board's edges is worth a tenth of a pixel.
    assert!(figures["psf_px"].as_f64().unwrap() < 0.1, "{figures}");
    // The bench has three px a sample, seen at an angle.
    assert!((figures["sample_px"].as_f64().unwrap() - 3.0).abs() < 0.1, "{figures}");
    let truth: toml::Table = toml::from_str(&std::fs::read_to_string(original().join("truth.toml")).unwrap()).unwrap();
    let length = |shot: &toml::Value| {
        let px: Vec<f64> = shot["drift_px"].as_array().unwrap().iter().map(|v| v.as_float().unwrap()).collect();
        px[0].hypot(px[1])
    };
    let most = truth["shots"].as_array().unwrap().iter().map(length).fold(0.0, f64::max);
    // Eight of the nine shots are looked at; neighbours on a walk of 0.5 px RMS differ by less than 0.3 px.
    assert!((figures["drift_most_px"].as_f64().unwrap() - most).abs() < 0.3, "{figures} {most}");
}

#[test]
fn the_table_has_a_word_for_every_topic_and_no_colours_in_a_file() {
    let (status, stdout, stderr) = acquire(&["check", original().to_str().unwrap()]);
    assert_eq!(status, 0, "{stderr}");
    for topic in acquire::check::Topic::ALL {
        let line = stdout.lines().find(|l| l.starts_with(topic.name())).unwrap();
        let word = line[14..18].trim();
        assert_eq!(word, if topic.name() == "dots" { "look" } else { "good" }, "{line}");
    }
    assert!(!stdout.contains('\x1b'));
    assert!(stderr.contains("would build"), "{stderr}");
}

#[test]
fn every_missing_photograph_is_named_not_only_the_first() {
    let (_folder, dir) = copy();
    for name in ["photos/board_0.png", "photos/lattice-0004_1.png"] {
        std::fs::remove_file(dir.join(name)).unwrap();
    }
    let (status, object) = check(&dir, &[]);
    assert_eq!(status, 1);
    let files: Vec<_> = found(&object, "missing-photograph").iter().map(|f| f["file"].clone()).collect();
    assert_eq!(files, ["photos/board_0.png", "photos/lattice-0004_1.png"]);
    assert!(found(&object, "would-not-build").is_empty(), "said once is enough");
    assert!(object["reason"].as_str().unwrap().contains("board_0.png"));
}

#[test]
fn a_photograph_cut_short_is_found_though_its_shot_is_not_sampled() {
    let (_folder, dir) = copy();
    let path = dir.join("photos/lattice-0004_1.png");
    let bytes = std::fs::read(&path).unwrap();
    // Only the chunk that says that it ends here: the decoder misses it too.
    std::fs::write(&path, &bytes[..bytes.len() - 12]).unwrap();
    let (status, object) = check(&dir, &["--lattice-shots", "2"]);
    assert_eq!((status, object["figures"]["lattice_shots_looked_at"].as_u64()), (1, Some(2)));
    assert_eq!(found(&object, "broken-photograph")[0]["file"], "photos/lattice-0004_1.png");
    assert!(object["reason"].as_str().unwrap().contains("lattice-0004_1.png"));
    let (status, _, stderr) =
        acquire(&["build-matrix", dir.to_str().unwrap(), "--out", dir.with_extension("z").to_str().unwrap()]);
    assert!(status == 1 && stderr.contains("lattice-0004_1.png"), "{stderr}");
}

#[test]
fn a_folder_that_is_no_capture_would_not_build() {
    let folder = tempfile::tempdir().unwrap();
    let (status, object) = check(folder.path(), &[]);
    assert_eq!(status, 1);
    assert!(object["reason"].as_str().unwrap().contains("capture.toml"), "{object}");
    let (status, object) = check(&folder.path().join("nowhere"), &[]);
    assert_eq!(status, 1);
    assert!(object["reason"].as_str().unwrap().contains("nowhere"), "{object}");
}

#[test]
fn settings_that_change_or_were_automatic_are_named() {
    let (_folder, dir) = copy();
    let manual = |iso: u16, n: u32| {
        vec![
            (Tag::ExposureTime, secs(1 << (2 * n), 256)),
            (Tag::PhotographicSensitivity, Value::Short(vec![iso])),
            (Tag::FNumber, secs(8, 1)),
            (Tag::FocalLength, secs(100, 1)),
        ]
    };
    for n in 0..3 {
        write_exif(&dir.join(format!("photos/lattice-0002_{n}.png")), &manual(200, n));
        let mut fields = manual(100, n);
        fields.extend([
            (Tag::ExposureProgram, Value::Short(vec![3])),
            (Tag::ExposureMode, Value::Short(vec![0])),
            (Tag::WhiteBalance, Value::Short(vec![0])),
        ]);
        write_exif(&dir.join(format!("photos/lattice-0003_{n}.png")), &fields);
    }
    let (status, object) = check(&dir, &["--lattice-shots", "1"]);
    assert_eq!(status, 0, "odd, but it builds: {object}");
    let changes = found(&object, "setting-changes");
    let iso = changes.iter().find(|f| f["setting"] == "ISO").unwrap();
    assert_eq!((iso["expected"].as_str(), iso["found"].as_str()), (Some("100"), Some("200")));
    assert_eq!((iso["file"].as_str(), iso["photographs"].as_u64()), (Some("photos/lattice-0002_0.png"), Some(3)));
    let automatic = &found(&object, "automatic-exposure")[0];
    assert_eq!(
        (automatic["program"].as_str(), automatic["photographs"].as_u64()),
        (Some("aperture priority"), Some(3))
    );
    assert_eq!(found(&object, "automatic-white-balance")[0]["file"], "photos/lattice-0003_0.png");
}

/// All photographs with their exposure in capture.toml and another EXIF block, made of that time.
fn all_exif(dir: &Path, block: impl Fn(f64) -> Option<Vec<u8>>) -> usize {
    let capture = acquire::capture::Capture::open(dir, None).unwrap();
    let taken: Vec<_> = capture.brackets.iter().flatten().cloned().collect();
    edit_manifest(dir, |m| {
        for entry in m.shots.iter_mut().flat_map(|s| &mut s.photographs) {
            let photograph = taken.iter().find(|p| p.path == dir.join(&entry.file)).unwrap();
            entry.exposure_secs = Some(photograph.exposure_secs);
        }
    });
    taken.iter().for_each(|p| write_block(&p.path, block(p.exposure_secs)));
    taken.len()
}

#[test]
fn settings_and_order_are_not_good_where_no_photograph_has_exif() {
    let (_folder, dir) = copy();
    all_exif(&dir, |_| None);
    let (status, stdout, stderr) = acquire(&["check", dir.to_str().unwrap()]);
    assert_eq!(status, 0, "{stderr}");
    for topic in ["settings", "order"] {
        let line = stdout.lines().find(|l| l.starts_with(topic)).unwrap();
        assert!(line[14..].starts_with("-    not known"), "{line}");
    }
    assert!(stdout.contains("no EXIF in 85 photographs"), "{stdout}");
    assert!(stdout.lines().last().unwrap().starts_with("8 of 9 lattice shots looked at"), "{stdout}");
}

#[test]
fn exif_that_is_damaged_alike_in_all_photographs_is_one_note_with_their_number() {
    let (_folder, dir) = copy();
    // As piexif leaves it: the directory ends with a pointer to byte 1.
    let photographs = all_exif(&dir, |secs| {
        let mut block = exif_block(&[(Tag::ExposureTime, self::secs((1e6 * secs).round() as u32, 1_000_000))]);
        let fields = usize::from(block[9]);
        block[10 + 12 * fields..14 + 12 * fields].copy_from_slice(&[0, 0, 0, 1]);
        Some(block)
    });
    let damaged = found(&check(&dir, &[]).1, "damaged-exif");
    assert_eq!(damaged.len(), 1);
    assert_eq!(
        (damaged[0]["photographs"].as_u64(), damaged[0]["severity"].as_str()),
        (Some(photographs as u64), Some("note"))
    );
    let out = dir.with_extension("rd.zarr");
    let (status, _, stderr) = acquire(&["build-matrix", dir.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(status, 0, "{stderr}");
    assert_eq!(stderr.matches("EXIF is damaged").count(), 1, "{stderr}");
    assert!(stderr.contains("note: photos/board_0.png: EXIF is damaged"), "{stderr}");
}

#[test]
fn a_bracket_that_differs_is_named_with_both() {
    let (_folder, dir) = copy();
    edit_manifest(&dir, |m| {
        let shot = lattice(m)[5];
        m.shots[shot].photographs.remove(2);
    });
    let (status, object) = check(&dir, &[]);
    assert_eq!(status, 0);
    let differs = &found(&object, "bracket-differs")[0];
    assert_eq!((differs["shot"].as_str(), differs["shots"].as_u64()), (Some("lattice-0005"), Some(1)));
    assert_eq!(differs["expected_secs"].as_array().unwrap().len(), 3);
    assert_eq!(differs["found_secs"], serde_json::json!([1.0 / 256.0, 1.0 / 64.0]));
}

#[test]
fn exchanged_lattice_shots_are_out_of_order_and_their_dots_are_not_there() {
    let (_folder, dir) = copy();
    edit_manifest(&dir, |m| {
        // Phases (0, 0) and (1, 1) of the sweep: their dots are a sample and a half apart.
        let (a, b) = (lattice(m)[0], lattice(m)[8]);
        let photographs = m.shots[a].photographs.clone();
        m.shots[a].photographs = std::mem::replace(&mut m.shots[b].photographs, photographs);
    });
    let (status, object) = check(&dir, &["--lattice-shots", "20"]);
    assert_eq!((status, found(&object, "other-pattern")[0]["severity"].as_str()), (1, Some("error")));
    let (status, object) = check(&dir, &["--lattice-shots", "20", "--accept", "other-pattern"]);
    assert_eq!((status, found(&object, "other-pattern")[0]["severity"].as_str()), (0, Some("warning")));
    let order = &found(&object, "out-of-order")[0];
    assert_eq!((order["severity"].as_str(), order["lattice"].as_bool()), (Some("warning"), Some(true)));
    let dead = &found(&object, "dead-dots")[0];
    assert_eq!((dead["dots"].as_u64(), dead["of"].as_u64()), (Some(12), Some(54)));
    assert_eq!(dead["shot"], "lattice-0000");
}

#[test]
fn points_that_no_shot_lights_are_counted() {
    let (_folder, dir) = copy();
    edit_manifest(&dir, |m| {
        let shot = lattice(m)[3];
        m.shots.remove(shot);
    });
    let (_, object) = check(&dir, &[]);
    assert_eq!(found(&object, "unlit-points")[0]["rows"], 6);
    assert_eq!(found(&object, "unlit-points").len(), 1);
}

#[test]
fn a_white_reference_that_is_saturated_in_all_exposures_is_named_with_its_share() {
    let (_folder, dir) = copy();
    for n in 0..2 {
        let path = dir.join(format!("photos/reference-white_{n}.png"));
        let mut white = image::open(&path).unwrap().into_rgb16();
        white.pixels_mut().for_each(|p| p.0 = [65_535; 3]);
        white.save(&path).unwrap();
        write_exif(&path, &[(Tag::ExposureTime, secs(1 + n, 256)), (Tag::Make, ascii("x"))]);
    }
    let (status, object) = check(&dir, &[]);
    assert_eq!(status, 1);
    let saturated = found(&object, "saturated");
    assert_eq!((saturated[0]["shot"].as_str(), saturated[0]["share"].as_f64()), (Some("reference-white"), Some(1.0)));
    assert!(object["reason"].as_str().unwrap().contains("white reference"), "{object}");
}

#[test]
fn a_lens_out_of_focus_is_found_and_told() {
    let (_folder, sharp) = copy();
    let (_other, blurred) = common::capture(&SimulateOptions {
        grid: [7, 5],
        window: [7, 5],
        spacing: Some([3, 2]),
        exposures: 3,
        psf_px: 1.5,
        ..common::bench()
    });
    let width = |dir: &Path| {
        let object = check(dir, &[]).1;
        (object["figures"]["psf_px"].as_f64().unwrap(), found(&object, "blurred").len())
    };
    let ((sharp, none), (wide, one)) = (width(&sharp), width(&blurred));
    assert_eq!((none, one), (0, 1), "{sharp} {wide}");
    // The squares of 13 px cut the blur's tails by some per cent.
    assert!((wide / 1.5 - 1.0).abs() < 0.05, "{wide}");
}
