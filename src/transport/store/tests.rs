use super::*;
use crate::transport::chunk_writer::Chunking;
use crate::transport::{CommonOfAll, MatrixReader, MatrixWriter, checksum};
use std::path::Path;
use std::sync::Arc;
use zarrs::array::{Array, ArrayBuilder, ArraySubset};
use zarrs::filesystem::FilesystemStore;

pub(in crate::transport) fn header(points: [usize; 2], window: [usize; 2]) -> MatrixHeader {
    let rows = points[0] * points[1];
    MatrixHeader {
        points,
        window,
        pitch_mm: 0.5,
        lit_pitch_mm: [0.5, 0.5],
        lit_mm: (0..rows).map(|r| [(r % points[0]) as f64 * 0.5, 1.0 + (r / points[0]) as f64 * 0.5]).collect(),
        position_sd_mm: vec![0.01; rows],
        shot_of: (0..rows).map(|r| (r > 0).then_some(0)).collect(),
        common: None,
        shots: vec![ShotRecord { name: "a".into(), drift_px: [0.1, 0.2], drift_sd_px: None }],
        camera_px_per_mm: None,
        warnings: vec![crate::ResponseWarning::UnlitPoints { rows: 1 }.into()],
        provenance: serde_json::json!({"seed": 1}),
    }
}

/// A row of which every other number was measured.
pub(in crate::transport) fn row(header: &MatrixHeader, index: usize) -> Row {
    let n = header.row_len();
    let measured = |k: usize, v: f32| if k.is_multiple_of(2) { v } else { 0.0 };
    let response = (0..n).map(|k| measured(k, (index * n + k) as f32)).collect();
    let variance = (0..n).map(|k| measured(k, index as f32)).collect();
    Row { response, variance, valid: (0..n).map(|k| k.is_multiple_of(2)).collect() }
}

#[test]
fn what_was_put_is_read_back_whatever_the_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = header([5, 3], [3, 1]);
    for _ in 0..2 {
        // The second time replaces the first.
        let writer = MatrixWriter::create(&path, header.clone()).unwrap();
        for index in (1..header.rows()).rev() {
            writer.put(index, &row(&header, index)).unwrap();
        }
        writer.finish().unwrap();
    }
    let reader = MatrixReader::open(&path).unwrap();
    assert_eq!(reader.header(), &header);
    let block = reader.read(3..12).unwrap();
    for index in 3..12 {
        let (n, expected) = (header.row_len(), row(&header, index));
        let part = (index - 3) * n..(index - 2) * n;
        assert_eq!(block.response[part.clone()], expected.response);
        assert_eq!(block.variance[part.clone()], expected.variance);
        assert!(block.valid[part].iter().zip(expected.valid).all(|(a, b)| (*a == 1) == b));
    }
    assert!(reader.read(0..1).unwrap().valid.iter().all(|&v| v == 0), "a row never put is invalid");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "nothing is left beside the store");
}

#[test]
fn a_missing_chunk_is_an_error_and_not_a_row_of_zeros() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = header([2, 2], [3, 3]);
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    writer.finish().unwrap();
    let reader = MatrixReader::open(&path).unwrap();
    std::fs::remove_file(path.join("valid/c.1.0.0.0.0")).unwrap();
    reader.read(0..2).unwrap();
    assert!(matches!(reader.read(2..4), Err(Error::BrokenMatrix { .. })));
    let missing = |e: Error| e.to_string().ends_with("array valid: chunk c.1.0.0.0.0 is missing");
    assert!(MatrixReader::open(&path).is_err_and(missing), "before any work");
}

#[test]
fn a_stopped_writer_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    drop(MatrixWriter::create(&path, header([2, 2], [3, 3])).unwrap());
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// 3 × 2 points with places, deviations and shots that no exchange of axes leaves alike.
fn uneven() -> MatrixHeader {
    MatrixHeader {
        points: [3, 2],
        window: [5, 3],
        pitch_mm: 0.25,
        // Near the median distances of the places: another pitch would be that of a matrix which this one was cut out
        // of.
        lit_pitch_mm: [3.5, 8.0],
        lit_mm: (0..6).map(|r| [10.0 + f64::from(r), -20.0 - 0.5 * f64::from(r * r)]).collect(),
        position_sd_mm: (0..6).map(|r| 0.01 * f64::from(r)).collect(),
        shot_of: [Some(1), None, Some(0), Some(1), Some(0), None].to_vec(),
        common: Some(CommonErrors {
            row_scale_sd: (0..6).map(|r| [0.01, 0.02 * f64::from(r), 0.003]).collect(),
            of_all: CommonOfAll { scale_sd: [0.004, 0.005, 0.001], position_sd_mm: 0.007 },
            sample_sd: (0..45).map(|k| 1e-3 * f64::from(k * k % 13)).collect(),
        }),
        shots: ["a", "b"].map(|n| ShotRecord { name: n.into(), drift_px: [0.1, 0.2], drift_sd_px: Some(0.3) }).to_vec(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: serde_json::Value::Null,
    }
}

/// The bytes of a small array's only chunk, as f64.
fn stored(path: &Path, chunk: &str) -> Vec<f64> {
    let bytes = std::fs::read(path.join(chunk)).unwrap();
    bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect()
}

#[test]
fn coordinates_on_disk_are_under_their_own_names() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    MatrixWriter::create(&path, uneven()).unwrap().finish().unwrap();
    // Read without our reader, which could exchange what the writer has exchanged.
    assert_eq!(stored(&path, "x_i_mm/c/0/0"), [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]);
    assert_eq!(stored(&path, "y_i_mm/c/0/0"), [-20.0, -20.5, -22.0, -24.5, -28.0, -32.5]);
    let sd = stored(&path, "position_sd_mm/c/0/0");
    assert!((0..6).all(|r| (sd[r] - 0.01 * r as f64).abs() < 1e-15), "{sd:?}");
    assert_eq!(stored(&path, "dx/c/0"), [-0.5, -0.25, 0.0, 0.25, 0.5]);
    assert_eq!(stored(&path, "dy/c/0"), [-0.25, 0.0, 0.25]);
    let shots = std::fs::read(path.join("shot/c/0/0")).unwrap();
    let shots: Vec<i32> = shots[..24].as_chunks::<4>().0.iter().map(|b| i32::from_le_bytes(*b)).collect();
    assert_eq!(shots, [1, -1, 0, 1, 0, -1]);
    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(path.join(name).join("zarr.json")).unwrap()).unwrap()
    };
    for (name, unit) in [("response", "mm^-2"), ("variance", "mm^-4"), ("valid", "1")] {
        let array = json(name);
        assert_eq!(array["shape"], serde_json::json!([2, 3, 3, 5, 3]));
        assert_eq!(array["dimension_names"], serde_json::json!(["y_i", "x_i", "dy", "dx", "channel"]));
        assert_eq!(array["attributes"]["units"], unit);
        assert_eq!(array["attributes"]["coordinates"], "x_i_mm y_i_mm");
    }
    assert_eq!((&json("shot")["attributes"]["units"], &json("dx")["attributes"]["units"]), (&"1".into(), &"mm".into()));
    assert_eq!(json("x_i_mm")["dimension_names"], serde_json::json!(["y_i", "x_i"]));
    let reader = MatrixReader::open(&path).unwrap();
    assert_eq!((reader.header(), reader.path()), (&uneven(), path.as_path()));
}

#[test]
fn lattice_shots_are_arrays_however_many_and_lists_of_older_stores_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let shots = (0..3000).map(|k| ShotRecord {
        name: format!("lattice-{k:04}, ½ exposed"),
        drift_px: [0.25 * f64::from(k), -1.0 / f64::from(k + 1)],
        drift_sd_px: (k % 3 > 0).then_some(0.01 * f64::from(k)),
    });
    let header = MatrixHeader { shots: shots.collect(), ..uneven() };
    MatrixWriter::create(&path, header.clone()).unwrap().finish().unwrap();
    assert_eq!(MatrixReader::open(&path).unwrap().header(), &header);
    // Read without our reader. The group says how many there are, and no more of them.
    let store = Arc::new(FilesystemStore::new(&path).unwrap());
    let array = |name: &str| Array::open(store.clone(), name).unwrap();
    let names: Vec<String> = array("/shot_name").retrieve_array_subset(&array("/shot_name").subset_all()).unwrap();
    assert_eq!((names.len(), names[2999].as_str()), (3000, "lattice-2999, ½ exposed"));
    let drift: Vec<f64> = array("/shot_drift_px").retrieve_array_subset(&array("/shot_drift_px").subset_all()).unwrap();
    assert_eq!(drift[2 * 1001..][..2], [250.25, -1.0 / 1002.0]);
    let root = path.join("zarr.json");
    let mut group: serde_json::Value = serde_json::from_slice(&std::fs::read(&root).unwrap()).unwrap();
    assert_eq!(group["attributes"]["shots"], 3000);
    assert!(group.to_string().len() < 2000, "{group}");
    // As it was before.
    unsealed(&path);
    group["attributes"].as_object_mut().unwrap().remove("checksum").unwrap();
    group["attributes"]["shots"] = serde_json::to_value(&header.shots).unwrap();
    std::fs::write(&root, group.to_string()).unwrap();
    checksum::OF_SHOTS.iter().for_each(|name| std::fs::remove_dir_all(path.join(name)).unwrap());
    assert_eq!(MatrixReader::open(&path).unwrap().header(), &header);
    // Without names no row can have been lit by one; but for that they may be left out.
    group["attributes"]["shots"] = 3000.into();
    std::fs::write(&root, group.to_string()).unwrap();
    let said = MatrixReader::open(&path).unwrap_err().to_string();
    assert!(said.contains("array shot: expected -1, or numbers below 0, of which there are names, found 1"), "{said}");
}

#[test]
fn an_entry_lies_at_its_line_column_sample_and_channel() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = uneven();
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    for index in 0..6 {
        writer.put(index, &row(&header, index)).unwrap();
    }
    assert_eq!(writer.row(4).unwrap(), row(&header, 4));
    writer.finish().unwrap();
    let store = Arc::new(FilesystemStore::new(&path).unwrap());
    let array = Array::open(store, "/response").unwrap();
    for [y, x, dy, dx, c] in [[1, 0, 2, 4, 1], [0, 2, 1, 3, 2], [1, 1, 0, 1, 0]] {
        let one = ArraySubset::new_with_ranges(&[y, x, dy, dx, c].map(|k| k..k + 1));
        let found = array.retrieve_array_subset::<Vec<f32>>(&one).unwrap();
        let sample = (5 * dy + dx) * 3 + c;
        match sample % 2 {
            0 => assert_eq!(found, [((3 * y + x) * 45 + sample) as f32]),
            // NaN, so that means of other programs leave it out.
            _ => assert!(found[0].is_nan(), "{found:?}"),
        }
    }
    let reader = MatrixReader::open(&path).unwrap();
    let (all, light) = (reader.read(1..5).unwrap(), reader.read_responses(1..5).unwrap());
    assert_eq!((light.first, light.rows, &light.response, &light.valid), (1, 4, &all.response, &all.valid));
    assert!(light.variance.is_empty() && all.variance.len() == 4 * 45);
    assert_eq!(reader.read(3..3).unwrap().rows, 0);
    for wrong in [4..7, 7..7, std::ops::Range { start: 3, end: 2 }] {
        assert!(matches!(reader.read(wrong), Err(Error::Internal { .. })));
    }
}

#[test]
fn sizes_and_offsets_are_those_of_the_window() {
    let header = uneven();
    assert_eq!((header.rows(), header.window_len(), header.row_len()), (6, 15, 45));
    assert_eq!((header.offset_px([0, 0]), header.offset_px([4, 1])), ([-2, -1], [2, 0]));
}

#[test]
fn rows_of_several_chunks_are_read_across_their_borders() {
    // A row is 4 · 3 · 301 · 201 bytes: five of them fit 4 MiB, and seven points are two equal chunks of four.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = MatrixHeader { window: [301, 201], ..header([7, 2], [301, 201]) };
    assert_eq!(Chunking::of(&header).files(&header), [0..4, 4..7, 7..11, 11..14].map(|chunk| vec![chunk]));
    let n = header.row_len();
    let writer = MatrixWriter::create(&path, header).unwrap();
    for index in 0..14 {
        let number = index as f32;
        let row = Row { response: vec![number; n], variance: vec![number + 0.5; n], valid: vec![index % 3 == 0; n] };
        writer.put(index, &row).unwrap();
    }
    writer.finish().unwrap();
    let reader = MatrixReader::open(&path).unwrap();
    for range in [2..13, 3..5, 5..6, 6..8, 12..14] {
        let block = reader.read(range.clone()).unwrap();
        for (k, index) in range.enumerate() {
            for at in [k * n, k * n + n / 2, (k + 1) * n - 1] {
                let found = (block.response[at], block.variance[at], block.valid[at]);
                let measured = if index % 3 == 0 { (index as f32, index as f32 + 0.5, 1) } else { (0.0, 0.0, 0) };
                assert_eq!(found, measured);
            }
        }
    }
}

#[test]
fn rows_that_do_not_fit_or_are_no_numbers_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let header = uneven();
    let writer = MatrixWriter::create(&folder.path().join("m.rd.zarr"), header.clone()).unwrap();
    let refused = |index: usize, change: &dyn Fn(&mut Row)| {
        let mut row = row(&header, 1);
        change(&mut row);
        matches!(writer.put(index, &row), Err(Error::Internal { .. }))
    };
    assert!(!refused(5, &|_| ()) && refused(6, &|_| ()));
    for change in [
        (|r: &mut Row| r.response.push(0.0)) as fn(&mut Row),
        |r| r.variance.truncate(44),
        |r| r.valid.push(true),
        |r| r.response[44] = f32::NAN,
        |r| r.variance[0] = f32::INFINITY,
    ] {
        assert!(refused(2, &change));
    }
    assert!(writer.row(5).is_ok() && writer.row(2).is_err() && writer.row(6).is_err());
}

/// As an earlier version of this program has written it.
fn unsealed(path: &Path) {
    let path = path.join("zarr.json");
    let mut group: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    group["attributes"].as_object_mut().unwrap().remove("checksum").unwrap();
    std::fs::write(&path, serde_json::to_string_pretty(&group).unwrap()).unwrap();
}

/// Writes an array anew, as another program does.
fn put<T: zarrs::array::Element>(path: &Path, name: &str, values: Vec<T>)
where
    Vec<T>: zarrs::array::IntoArrayBytes<'static>,
{
    let array = Array::open(Arc::new(FilesystemStore::new(path).unwrap()), name).unwrap();
    array.store_array_subset(&array.subset_all(), values).unwrap();
}

#[test]
fn a_number_on_disk_that_is_not_finite_is_told_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    for name in ["response", "variance"] {
        let _ = std::fs::remove_dir_all(&path);
        let writer = MatrixWriter::create(&path, uneven()).unwrap();
        let row = Row { response: vec![1.0; 45], variance: vec![1.0; 45], valid: vec![true; 45] };
        (0..6).for_each(|index| writer.put(index, &row).unwrap());
        writer.finish().unwrap();
        let store = Arc::new(FilesystemStore::new(&path).unwrap());
        let array = Array::open(store, &format!("/{name}")).unwrap();
        // Line 1, column 2: lit point [2, 1]; sample (3, 2), channel 1.
        let one = ArraySubset::new_with_ranges(&[1, 2, 2, 3, 1].map(|k| k..k + 1));
        array.store_array_subset(&one, vec![f32::NEG_INFINITY]).unwrap();
        unsealed(&path);
        let reader = MatrixReader::open(&path).unwrap();
        assert!(reader.read(0..5).is_ok());
        match reader.read(4..6) {
            Err(Error::NotFinite { field, found, at, .. }) => {
                assert_eq!((field, at.as_str()), (name, "lit point [2, 1], sample [3, 2], channel 1"));
                assert_eq!(found, f64::NEG_INFINITY);
            }
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn headers_out_of_range_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let finished = |change: fn(&mut MatrixHeader)| {
        let mut writer = MatrixWriter::create(&path, uneven()).unwrap();
        change(writer.header_mut());
        writer.finish().is_ok()
    };
    assert!(finished(|_| ()));
    for change in [
        (|h: &mut MatrixHeader| h.points = [3, 0]) as fn(&mut MatrixHeader),
        |h| h.points = [65_537, 1],
        |h| h.window = [5, 2],
        |h| h.window = [4097, 3],
        |h| h.pitch_mm = 0.9e-9,
        |h| h.pitch_mm = f64::NAN,
        |h| h.lit_pitch_mm = [0.5, 1.1e9],
        |h| h.lit_pitch_mm = [-0.5, 0.5],
        |h| h.shots[1].drift_px = [0.0, f64::NAN],
        |h| h.shots[0].drift_sd_px = Some(f64::INFINITY),
        |h| h.lit_mm[4][1] = -1.1e9,
        |h| h.lit_mm[2][0] = f64::NAN,
        |h| h.position_sd_mm[5] = -1e-3,
        |h| h.position_sd_mm[1] = 1.1e9,
    ] {
        assert!(!finished(change));
    }
    // The bounds themselves are allowed.
    assert!(finished(|h| (h.pitch_mm, h.lit_pitch_mm, h.position_sd_mm[3]) = (1e-9, [1e9, 1e-9], 0.0)));
    assert!(finished(|h| (h.lit_mm[0], h.position_sd_mm[3]) = ([-1e9, 1e9], 1e9)));
}

#[test]
fn a_folder_that_is_no_whole_matrix_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let after = |change: &dyn Fn(&Path)| {
        let _ = std::fs::remove_dir_all(&path);
        MatrixWriter::create(&path, uneven()).unwrap().finish().unwrap();
        unsealed(&path);
        change(&path);
        MatrixReader::open(&path).err().map(|e| e.to_string())
    };
    let edit = |name: &'static str, from: &'static str, to: &'static str| {
        move |path: &Path| {
            let text = std::fs::read_to_string(path.join(name)).unwrap();
            assert!(text.contains(from), "{text}");
            std::fs::write(path.join(name), text.replacen(from, to, 1)).unwrap();
        }
    };
    assert_eq!(after(&|_| ()), None);
    let said = |change: &dyn Fn(&Path), part: &str| assert!(after(change).unwrap().contains(part), "{part}");
    said(
        &edit("zarr.json", "\"acquire_format\": 3", "\"acquire_format\": 4"),
        "acquire_format: expected one of [1, 2, 3]",
    );
    said(&|path: &Path| put(path, "/shot", vec![2i32; 6]), "numbers below 2");
    said(&|path: &Path| std::fs::write(path.join("x_i_mm/c/0/0"), [0; 47]).unwrap(), "array x_i_mm");
    said(&|path: &Path| put(path, "/y_i_mm", vec![f64::INFINITY; 6]), "array y_i_mm: expected finite");
    said(&|path: &Path| std::fs::write(path.join("y_i_mm/c/0/0"), [0; 52]).unwrap(), "array y_i_mm");
    said(&|path: &Path| std::fs::remove_file(path.join("variance/zarr.json")).unwrap(), "array variance: zarr.json");
    said(&|path: &Path| std::fs::remove_dir_all(path.join("response")).unwrap(), "array response: expected an array");
    said(
        &edit("valid/zarr.json", "3,\n    3,\n    5,", "3,\n    5,\n    3,"),
        "array valid: expected the shape of response",
    );
    assert!(matches!(MatrixReader::open(&folder.path().join("none")), Err(Error::Io { .. })));
    // Whatever else is there is not overwritten.
    std::fs::create_dir(folder.path().join("other")).unwrap();
    let refused = |path: &Path| match MatrixWriter::create(path, uneven()) {
        Err(e @ (Error::NotOurs { .. } | Error::Changed { .. })) => e.to_string(),
        other => panic!("{other:?}"),
    };
    let other = folder.path().join("other");
    let group = r#"{"zarr_format": 3, "node_type": "group", "attributes": {"made by": "a lab"}}"#;
    std::fs::write(other.join("zarr.json"), group).unwrap();
    assert!(refused(&other).starts_with(&other.display().to_string()));
    std::fs::remove_dir_all(&path).unwrap();
    MatrixWriter::create(&path, uneven()).unwrap().finish().unwrap();
    std::fs::write(path.join("notes.txt"), "keep").unwrap();
    assert!(refused(&path).contains("notes.txt: not replaced"));
    assert!(path.join("notes.txt").is_file() && path.join("zarr.json").is_file());
}

/// A store with two chunks a line, whose rows differ.
fn in_chunks(path: &Path) -> MatrixHeader {
    let common = Some(CommonErrors::none(60, 3 * 131 * 131));
    let header = MatrixHeader { shot_of: vec![None; 60], common, ..header([30, 2], [131, 131]) };
    let writer = MatrixWriter::create(path, header.clone()).unwrap();
    for index in [0, 20, 40] {
        writer.put(index, &row(&header, index)).unwrap();
    }
    writer.finish().unwrap();
    header
}

#[test]
fn exchanged_missing_and_additional_chunks_are_seen_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    in_chunks(&path);
    let at = |name: &str| path.join(name);
    let read = || MatrixReader::open(&path).and_then(|r| r.read(0..60).map(|_| ()));
    read().unwrap();
    let exchange = |a: &str, b: &str| {
        std::fs::rename(at(a), at("aside")).unwrap();
        std::fs::rename(at(b), at(a)).unwrap();
        std::fs::rename(at("aside"), at(b)).unwrap();
    };
    for (a, b) in [
        ("response/c.0.0.0.0.0", "response/c.0.1.0.0.0"),
        ("response/c.0.0.0.0.0", "variance/c.0.0.0.0.0"),
        ("valid/c.0.1.0.0.0", "valid/c.1.1.0.0.0"),
        ("x_i_mm/c/0/0", "y_i_mm/c/0/0"),
        ("response/zarr.json", "variance/zarr.json"),
        ("response", "variance"),
    ] {
        exchange(a, b);
        // Chunks of validity that hold nothing are equal, and may change places.
        let equal = std::fs::read(at(a)).ok().is_some_and(|bytes| std::fs::read(at(b)).unwrap() == bytes);
        assert_eq!(read().is_err(), !equal, "{a} and {b}");
        exchange(a, b);
    }
    let chunk = at("variance/c.1.0.0.0.0");
    let bytes = std::fs::read(&chunk).unwrap();
    std::fs::remove_file(&chunk).unwrap();
    assert!(read().unwrap_err().to_string().ends_with("array variance: chunk c.1.0.0.0.0 is missing"));
    std::fs::write(&chunk, &bytes).unwrap();
    std::fs::write(at("variance/c.2.0.0.0.0"), &bytes).unwrap();
    assert!(read().unwrap_err().to_string().ends_with("array variance: c.2.0.0.0.0 is no chunk of it"));
    std::fs::remove_file(at("variance/c.2.0.0.0.0")).unwrap();
    read().unwrap();
}

#[test]
fn a_bit_that_changes_anywhere_is_seen() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = header([2, 2], [3, 1]);
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    (0..4).for_each(|index| writer.put(index, &row(&header, index)).unwrap());
    writer.finish().unwrap();
    let read = || MatrixReader::open(&path).and_then(|r| Ok((r.header().clone(), r.read(0..4)?)));
    let whole = read().unwrap();
    let mut folders = vec![path.clone()];
    while let Some(folder) = folders.pop() {
        for file in std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()) {
            if file.is_dir() {
                folders.push(file);
                continue;
            }
            let bytes = std::fs::read(&file).unwrap();
            // Every byte of what is short.
            for at in (0..bytes.len()).step_by(1 + bytes.len() / 200) {
                let mut changed = bytes.clone();
                changed[at] ^= 1 << (at % 7);
                std::fs::write(&file, &changed).unwrap();
                // White space and what no reader asks for may change.
                assert!(read().is_err() || read().unwrap() == whole, "byte {at} of {file:?}");
            }
            std::fs::write(&file, &bytes).unwrap();
        }
    }
    assert_eq!(read().unwrap(), whole);
}

#[test]
fn a_store_without_checksums_and_one_that_was_written_anew_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    MatrixWriter::create(&path, uneven()).unwrap().finish().unwrap();
    let edit = |file: &str, change: &dyn Fn(&mut serde_json::Value)| {
        let mut json = serde_json::from_slice(&std::fs::read(path.join(file)).unwrap()).unwrap();
        change(&mut json);
        std::fs::write(path.join(file), json.to_string()).unwrap();
    };
    edit("zarr.json", &|group| group["attributes"]["camera_px_per_mm"] = 0.5.into());
    assert!(matches!(MatrixReader::open(&path), Err(Error::BrokenMatrix { .. })), "changed");
    unsealed(&path);
    assert_eq!(MatrixReader::open(&path).unwrap().header().camera_px_per_mm, Some(0.5));
}

#[test]
fn a_crop_that_another_program_made_is_read_and_is_not_replaced_and_an_array_of_ours_that_is_gone_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let (path, crop) = (folder.path().join("m.rd.zarr"), folder.path().join("crop.rd.zarr"));
    let header = MatrixHeader { common: uneven().common, ..header([3, 2], [5, 3]) };
    let writer = MatrixWriter::create(&path, header.clone()).unwrap();
    (0..6).for_each(|index| writer.put(index, &row(&header, index)).unwrap());
    writer.finish().unwrap();
    // As xarray does it: attributes go along, the checksums among them; chunks have its own names. The first column of
    // windows and `variance` are left out.
    let [from, to] = [&path, &crop].map(|path| Arc::new(FilesystemStore::new(path).unwrap()));
    let group = zarrs::group::Group::open(from.clone(), "/").unwrap();
    assert!(group.attributes().contains_key(checksum::GROUP));
    let builder = |shape: &[u64], of: &Array<FilesystemStore>, names: &[&str]| {
        let mut builder =
            ArrayBuilder::new(shape.to_vec(), shape.to_vec(), of.data_type().clone(), of.fill_value().clone());
        builder.dimension_names(Some(names.iter().copied())).attributes(of.attributes().clone());
        builder
    };
    zarrs::group::GroupBuilder::new()
        .attributes(group.attributes().clone())
        .build(to.clone(), "/")
        .unwrap()
        .store_metadata()
        .unwrap();
    let source = Array::open(from.clone(), "/response").unwrap();
    let kept = ArraySubset::new_with_ranges(&[0..2, 0..3, 0..3, 1..5, 0..3]);
    let values: Vec<f32> = source.retrieve_array_subset(&kept).unwrap();
    let array = builder(&[2, 3, 3, 4, 3], &source, &["y_i", "x_i", "dy", "dx", "channel"]);
    let array = array.build(to.clone(), "/response").unwrap();
    array.store_metadata().unwrap();
    array.store_array_subset(&array.subset_all(), values).unwrap();
    let source = Array::open(from.clone(), "/common_sd").unwrap();
    let kept = ArraySubset::new_with_ranges(&[0..3, 1..5, 0..3]);
    let values: Vec<f64> = source.retrieve_array_subset(&kept).unwrap();
    let array = builder(&[3, 4, 3], &source, &["dy", "dx", "channel"]).build(to.clone(), "/common_sd").unwrap();
    array.store_metadata().unwrap();
    array.store_array_subset(&array.subset_all(), values).unwrap();
    let source = Array::open(from, "/dx").unwrap();
    let values: Vec<f64> =
        source.retrieve_array_subset(&ArraySubset::new_with_start_shape(vec![1], vec![4]).unwrap()).unwrap();
    let array = builder(&[4], &source, &["dx"]).build(to, "/dx").unwrap();
    array.store_metadata().unwrap();
    array.store_array_subset(&array.subset_all(), values).unwrap();
    let cropped = MatrixReader::open(&crop).unwrap();
    assert_eq!((cropped.header().points, cropped.header().window), ([3, 2], [5, 3]));
    let (left, all) = (cropped.header().common.clone().unwrap(), header.common.clone().unwrap());
    assert_eq!((left.of_all, &left.row_scale_sd), (all.of_all, &vec![[0.0; 3]; 6]), "rows' own were left out");
    for (k, sd) in left.sample_sd.iter().enumerate() {
        assert_eq!(*sd, if (k / CHANNELS).is_multiple_of(5) { 0.0 } else { all.sample_sd[k] }, "number {k}");
    }
    let (whole, part) = (MatrixReader::open(&path).unwrap().read(0..6).unwrap(), cropped.read(0..6).unwrap());
    for k in 0..whole.response.len() {
        let expected = if (k / CHANNELS).is_multiple_of(5) { (0.0, 0) } else { (whole.response[k], whole.valid[k]) };
        assert_eq!((part.response[k], part.valid[k]), expected, "number {k}");
    }
    assert!(matches!(MatrixWriter::create(&crop, header.clone()), Err(Error::NotOurs { .. })));
    // Of ours, every array is told by name.
    for name in checksum::ARRAYS {
        let aside = folder.path().join("aside");
        std::fs::rename(path.join(name), &aside).unwrap();
        let error = MatrixReader::open(&path).unwrap_err().to_string();
        assert!(error.ends_with(&format!("array {name}: zarr.json is missing")), "{error}");
        std::fs::rename(&aside, path.join(name)).unwrap();
    }
}

#[test]
fn a_chunk_that_changes_under_an_open_reader_is_seen_in_every_array() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    in_chunks(&path);
    let reader = MatrixReader::open(&path).unwrap();
    for name in checksum::ROWS {
        let chunks = [0, 1].map(|y| path.join(name).join(format!("c.{y}.0.0.0.0")));
        let [before, other] = [0, 1].map(|k| std::fs::read(&chunks[k]).unwrap());
        assert_ne!(before, other, "{name}");
        // Whole, with a checksum of its own: another line's.
        std::fs::write(&chunks[0], other).unwrap();
        let error = reader.read(0..1).unwrap_err().to_string();
        assert!(
            error.ends_with(&format!("array {name}: chunk c.0.0.0.0.0 is not the one that was written there")),
            "{error}"
        );
        assert!(reader.read(30..31).is_ok(), "rows of other chunks");
        assert_eq!(reader.read_responses(0..1).is_ok(), name == "variance");
        std::fs::write(&chunks[0], before).unwrap();
    }
    reader.read(0..60).unwrap();
}
