//! Matrix stores that other programs write: any chunks and codecs, things left out, crops. (`python/tests` has the same
//! from zarr-python, xarray and dask.)

use acquire::Error;
use acquire::transport::{MatrixReader, RowBlock};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::codec::{BloscCodec, GzipCodec, TransposeCodec, TransposeOrder, ZstdCodec};
use zarrs::array::{Array, ArrayBuilder, data_type};
use zarrs::filesystem::FilesystemStore;

/// 3 × 2 points with windows of 5 × 3.
const SHAPE: [u64; 5] = [2, 3, 3, 5, 3];
const NAMES: [&str; 5] = ["y_i", "x_i", "dy", "dx", "channel"];

struct Bench {
    folder: tempfile::TempDir,
    store: Arc<FilesystemStore>,
}

fn number(k: usize) -> f32 {
    k as f32 / 8.0
}

impl Bench {
    fn new(attributes: Value) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let store = Arc::new(FilesystemStore::new(folder.path().join("m.zarr")).unwrap());
        let Value::Object(attributes) = attributes else { panic!("{attributes}") };
        let group = zarrs::group::GroupBuilder::new().attributes(attributes).build(store.clone(), "/").unwrap();
        group.store_metadata().unwrap();
        Self { folder, store }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("m.zarr")
    }

    fn array(&self, name: &str, builder: &ArrayBuilder) -> Array<FilesystemStore> {
        let array = builder.build(self.store.clone(), &format!("/{name}")).unwrap();
        array.store_metadata().unwrap();
        array
    }

    /// An array of f32 in one chunk.
    fn plain(&self, name: &str, shape: &[u64], names: Option<&[&str]>, values: Vec<f32>) -> Array<FilesystemStore> {
        let mut builder = ArrayBuilder::new(shape.to_vec(), shape.to_vec(), data_type::float32(), f32::NAN);
        builder.dimension_names(names.map(|names| names.iter().copied()));
        let array = self.array(name, &builder);
        array.store_array_subset(&array.subset_all(), values).unwrap();
        array
    }

    fn f64s(&self, name: &str, shape: &[u64], names: &[&str], values: Vec<f64>) {
        let mut builder = ArrayBuilder::new(shape.to_vec(), shape.to_vec(), data_type::float64(), f64::NAN);
        builder.dimension_names(Some(names.iter().copied()));
        let array = self.array(name, &builder);
        array.store_array_subset(&array.subset_all(), values).unwrap();
    }

    fn open(&self) -> MatrixReader {
        MatrixReader::open(&self.path()).unwrap()
    }

    /// What opening it, or reading its rows, says.
    fn refused(&self) -> String {
        let read = MatrixReader::open(&self.path()).and_then(|reader| reader.read(0..reader.header().rows()));
        match read {
            Err(Error::Internal { what }) => panic!("{what}"),
            Err(error) => error.to_string(),
            Ok(block) => panic!("{block:?}"),
        }
    }
}

fn all(reader: &MatrixReader) -> RowBlock {
    // In pieces that fit no chunk, and in those that the reader proposes.
    let rows = reader.header().rows();
    let whole = reader.read(0..rows).unwrap();
    let n = reader.header().row_len();
    for first in 0..rows {
        for last in first..=rows {
            let part = reader.read(first..last).unwrap();
            assert_eq!(part.response, whole.response[first * n..last * n], "{first}..{last}");
            assert_eq!(part.valid, whole.valid[first * n..last * n]);
        }
    }
    let mut blocks = Vec::new();
    let keep = |block: &acquire::transport::RowBlock| {
        blocks.extend_from_slice(&block.response);
        Ok(())
    };
    reader.for_each_block(keep).unwrap();
    assert_eq!(blocks, whole.response);
    whole
}

#[test]
fn a_response_and_a_pitch_suffice() {
    let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
    let values: Vec<f32> = (0..270).map(number).collect();
    bench.plain("response", &SHAPE, None, values.clone());
    let reader = bench.open();
    let h = reader.header();
    assert_eq!((h.points, h.window, h.pitch_mm, h.lit_pitch_mm), ([3, 2], [5, 3], 0.25, [0.25; 2]));
    assert_eq!(h.lit_mm, [[0.0, 0.0], [0.25, 0.0], [0.5, 0.0], [0.0, 0.25], [0.25, 0.25], [0.5, 0.25]]);
    assert_eq!((h.position_sd_mm.as_slice(), h.shot_of.as_slice()), ([0.0; 6].as_slice(), [None; 6].as_slice()));
    assert!(h.shots.is_empty() && h.warnings.is_empty() && h.provenance.is_null());
    let block = all(&reader);
    assert_eq!(block.response, values);
    assert!(block.variance.iter().all(|&v| v == 0.0) && block.valid.iter().all(|&v| v == 1));
}

#[test]
fn chunks_codecs_and_types_make_no_difference() {
    let values: Vec<f32> = (0..270).map(number).collect();
    let chunks: [[u64; 5]; 5] = [[1, 1, 3, 5, 3], [2, 3, 3, 5, 3], [2, 2, 2, 2, 1], [4, 4, 4, 4, 4], [1, 3, 1, 5, 3]];
    for chunk in chunks {
        let base = || {
            let mut builder = ArrayBuilder::new(SHAPE.to_vec(), chunk.to_vec(), data_type::float32(), f32::NAN);
            builder.dimension_names(Some(NAMES));
            builder
        };
        let mut kinds = vec![("none", base())];
        let mut with = |name, change: &dyn Fn(&mut ArrayBuilder)| {
            let mut builder = base();
            change(&mut builder);
            kinds.push((name, builder));
        };
        with("zstd", &|b| {
            b.bytes_to_bytes_codecs(vec![Arc::new(ZstdCodec::new(3, false))]);
        });
        with("gzip", &|b| {
            b.bytes_to_bytes_codecs(vec![Arc::new(GzipCodec::new(5).unwrap())]);
        });
        with("transpose", &|b| {
            let order = TransposeOrder::new(&[4, 3, 2, 1, 0]).unwrap();
            b.array_to_array_codecs(vec![Arc::new(TransposeCodec::new(order))]);
        });
        for codec in ["lz4", "blosclz", "zstd", "zlib", "snappy", "lz4hc"] {
            let options = json!({"cname": codec, "clevel": 5, "shuffle": "shuffle", "typesize": 4, "blocksize": 0});
            let codec = BloscCodec::new_with_configuration(&serde_json::from_value(options).unwrap()).unwrap();
            with("blosc", &|b| {
                b.bytes_to_bytes_codecs(vec![Arc::new(codec.clone())]);
            });
        }
        // A shard of all, whose chunks are single rows.
        with("sharding", &|b| {
            *b = ArrayBuilder::new(SHAPE.to_vec(), SHAPE.to_vec(), data_type::float32(), f32::NAN);
            b.dimension_names(Some(NAMES)).subchunk_shape(vec![1, 1, 3, 5, 3]);
        });
        for (name, builder) in kinds {
            let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
            let array = bench.array("response", &builder);
            array.store_array_subset(&array.subset_all(), values.clone()).unwrap();
            assert_eq!(all(&bench.open()).response, values, "{name}, {chunk:?}");
        }
        let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
        let double = ArrayBuilder::new(SHAPE.to_vec(), chunk.to_vec(), data_type::float64(), f64::NAN);
        let array = bench.array("response", &double);
        array
            .store_array_subset(&array.subset_all(), values.iter().map(|&v| f64::from(v)).collect::<Vec<_>>())
            .unwrap();
        assert_eq!(all(&bench.open()).response, values, "f64, {chunk:?}");
    }
}

#[test]
fn chunks_that_are_left_out_are_their_fill_value() {
    for (fill, measured) in [(0.0, 1), (f32::NAN, 0)] {
        let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
        let builder = ArrayBuilder::new(SHAPE.to_vec(), vec![1, 1, 3, 5, 3], data_type::float32(), fill);
        let array = bench.array("response", &builder);
        array.store_chunk(&[1, 2, 0, 0, 0], vec![2.0_f32; 45]).unwrap();
        let block = all(&bench.open());
        assert_eq!(block.response, [[0.0; 225].as_slice(), &[2.0; 45]].concat());
        assert_eq!(block.valid, [[measured; 225].as_slice(), &[1; 45]].concat());
    }
}

#[test]
fn flags_of_any_type_say_what_was_measured() {
    let values: Vec<f32> = (0..270).map(|k| if k % 4 == 0 { f32::NAN } else { number(k) }).collect();
    let flags: Vec<u8> = (0..270).map(|k| u8::from(k % 4 != 0 && k % 3 != 0)).collect();
    let bench = |kind: zarrs::array::DataType, fill: zarrs::array::FillValue| {
        let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
        bench.plain("response", &SHAPE, Some(&NAMES), values.clone());
        let array = bench.array("valid", &ArrayBuilder::new(SHAPE.to_vec(), SHAPE.to_vec(), kind, fill));
        (bench, array)
    };
    let expected: Vec<f32> = (0..270).map(|k| if flags[k] == 1 { values[k] } else { 0.0 }).collect();
    let check = |bench: &Bench| {
        let block = all(&bench.open());
        assert_eq!((block.response, &block.valid), (expected.clone(), &flags));
    };
    let (of_bool, array) = bench(data_type::bool(), false.into());
    array.store_array_subset(&array.subset_all(), flags.iter().map(|&v| v == 1).collect::<Vec<_>>()).unwrap();
    check(&of_bool);
    let (of_i64, array) = bench(data_type::int64(), 0_i64.into());
    array.store_array_subset(&array.subset_all(), flags.iter().map(|&v| i64::from(v)).collect::<Vec<_>>()).unwrap();
    check(&of_i64);
    let (other, array) = bench(data_type::int64(), 0_i64.into());
    array.store_array_subset(&array.subset_all(), vec![2_i64; 270]).unwrap();
    assert!(other.refused().contains("array valid: expected 1 where measured and 0 where not"));
    // NaN where it is said to be measured.
    let (nan, array) = bench(data_type::bool(), false.into());
    array.store_array_subset(&array.subset_all(), vec![true; 270]).unwrap();
    assert!(nan.refused().contains("response: expected finite numbers, found NaN at lit point [0, 0], sample [0, 0]"));
}

#[test]
fn a_chunk_that_is_lost_is_named() {
    for (name, fill) in [("response", zarrs::array::FillValue::from(f32::NAN)), ("valid", 255_u8.into())] {
        let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
        let chunk = vec![1, 1, 3, 5, 3];
        let response =
            bench.array("response", &ArrayBuilder::new(SHAPE.to_vec(), chunk.clone(), data_type::float32(), f32::NAN));
        response.store_array_subset(&response.subset_all(), vec![1.0_f32; 270]).unwrap();
        let fill = if name == "valid" { fill } else { 0_u8.into() };
        let valid = bench.array("valid", &ArrayBuilder::new(SHAPE.to_vec(), chunk, data_type::uint8(), fill));
        valid.store_array_subset(&valid.subset_all(), vec![1_u8; 270]).unwrap();
        std::fs::remove_file(bench.path().join(name).join("c/1/2/0/0/0")).unwrap();
        let said = bench.refused();
        assert!(said.contains(&format!("chunk {name}/c/1/2/0/0/0 is missing")), "{said}");
    }
}

#[test]
fn a_crop_keeps_every_sample_at_its_offset() {
    // Columns −1 … 2 of dx, line 1 of dy alone, every other lit column: what isel leaves, with attributes of the whole.
    let bench = Bench::new(
        json!({ "acquire_format": 2, "pitch_mm": 0.5, "lit_pitch_mm": [1.0, 1.0], "points": [9, 9], "window": [7, 7] }),
    );
    let values: Vec<f32> = (0..2 * 2 * 4).map(number).collect();
    bench.plain("response", &[2, 2, 4], Some(&["y_i", "x_i", "dx"]), values.clone());
    bench.f64s("dx", &[4], &["dx"], vec![-0.5, 0.0, 0.5, 1.0]);
    bench.f64s("dy", &[], &[], vec![0.5]);
    bench.f64s("x_i_mm", &[2], &["x_i"], vec![3.0, 5.0]);
    bench.f64s("y_i_mm", &[2], &["y_i"], vec![7.0, 8.0]);
    let reader = bench.open();
    let h = reader.header();
    assert_eq!((h.points, h.window, h.lit_pitch_mm), ([2, 2], [5, 3], [2.0, 1.0]));
    assert_eq!(h.lit_mm, [[3.0, 7.0], [5.0, 7.0], [3.0, 8.0], [5.0, 8.0]]);
    let block = all(&reader);
    for (row, (y, x)) in (0..4).flat_map(|row| (0..3).flat_map(move |y| (0..5).map(move |x| (row, (y, x))))) {
        let at = ((row * 3 + y) * 5 + x) * 3;
        // Line 2 of the window is dy = +1 sample, column 1 dx = −1.
        let expected = if y == 2 && x > 0 { Some(values[row * 4 + x - 1]) } else { None };
        assert_eq!(block.response[at..at + 3], [expected.unwrap_or(0.0); 3], "row {row}, sample [{x}, {y}]");
        assert_eq!(block.valid[at..at + 3], [u8::from(expected.is_some()); 3]);
    }
}

#[test]
fn what_does_not_fit_is_named_with_what_was_expected() {
    let refused = |attributes: Value, change: &dyn Fn(&Bench)| {
        let bench = Bench::new(attributes);
        change(&bench);
        bench.refused()
    };
    let plain = |bench: &Bench| drop(bench.plain("response", &SHAPE, Some(&NAMES), vec![1.0; 270]));
    let pitch = || json!({ "pitch_mm": 0.5 });
    type Case<'a> = (Value, &'a dyn Fn(&Bench), &'a str);
    let cases: &[Case<'_>] = &[
        (json!({}), &plain, "attribute pitch_mm: expected the side of a sample"),
        (json!({"pitch_mm": "0.5"}), &plain, "attribute pitch_mm: expected a number of mm, found \"0.5\""),
        (json!({"pitch_mm": -0.5}), &plain, "attribute pitch_mm: expected 1e-9 to 1e9 mm"),
        (
            json!({"pitch_mm": 0.5, "acquire_format": 7}),
            &plain,
            "attribute acquire_format: expected one of [1, 2, 3], or none",
        ),
        (
            json!({"pitch_mm": 0.5, "channels": ["B", "G", "R"]}),
            &plain,
            "attribute channels: expected [\"R\",\"G\",\"B\"]",
        ),
        (pitch(), &|_| (), "array response: expected an array of this name, found none"),
        (pitch(), &|b| drop(b.plain("response", &[2, 3, 3, 5, 2], None, vec![1.0; 180])), "1 or 3 channels, found 2"),
        (
            pitch(),
            &|b| drop(b.plain("response", &[6, 45], None, vec![1.0; 270])),
            "the 5 dimensions y_i, x_i, dy, dx, channel, found 2",
        ),
        (
            pitch(),
            &|b| drop(b.plain("response", &SHAPE, Some(&["x_i", "y_i", "dy", "dx", "channel"]), vec![1.0; 270])),
            "in this order, found x_i, y_i",
        ),
        (
            pitch(),
            &|b| drop(b.plain("response", &[2, 3, 3, 4, 3], None, vec![1.0; 216])),
            "an odd number of samples along dx, or the array dx",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("dx", &[5], &["dx"], vec![-2.0, -1.0, 0.0, 1.0, 2.0])
            },
            "array dx: expected offsets in mm, 0.5 mm apart",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("dy", &[3], &["dy"], vec![-0.3, 0.2, 0.7])
            },
            "array dy: expected offsets that are whole multiples of 0.5 mm",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("x_i_mm", &[2, 3], &["y_i", "x_i"], vec![0.0; 6])
            },
            "array y_i_mm: expected an array of this name beside x_i_mm",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("position_sd_mm", &[3, 2], &["x_i", "y_i"], vec![0.0; 6])
            },
            "array position_sd_mm: expected shape [2, 3]",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("x_i", &[3], &["x_i"], vec![0.0, 1.5, 3.0])
            },
            "array x_i: expected whole numbers, or none (places in mm are the arrays x_i_mm and y_i_mm)",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.f64s("shot", &[2, 3], &["y_i", "x_i"], vec![0.0; 6])
            },
            "array shot: expected -1, or numbers below 0",
        ),
        (
            pitch(),
            &|b| {
                plain(b);
                b.plain("variance", &[2, 3, 3, 5, 1], None, vec![0.0; 90]);
            },
            "array variance: expected the shape of response",
        ),
    ];
    let with_unit = |name: &str, unit: &str| {
        let bench = Bench::new(pitch());
        bench.plain("response", &SHAPE, Some(&NAMES), vec![1.0; 270]);
        bench.f64s("dx", &[5], &["dx"], vec![-1.0, -0.5, 0.0, 0.5, 1.0]);
        let mut array = Array::open(bench.store.clone(), &format!("/{name}")).unwrap();
        array.attributes_mut().insert("units".into(), json!(unit));
        array.store_metadata().unwrap();
        bench
    };
    assert!(with_unit("response", "cm^-2").refused().contains("array response: expected units mm^-2, found cm^-2"));
    assert!(with_unit("dx", "px").refused().contains("array dx: expected units mm, found px"));
    assert_eq!(with_unit("response", "1/mm^2").open().header().pitch_mm, 0.5);
    for (attributes, change, words) in cases {
        let said = refused(attributes.clone(), *change);
        assert!(said.contains(words), "{words}\nis not in\n{said}");
        assert!(!said.contains("incomplete or damaged"), "{said}");
    }
    let numbers = refused(pitch(), &|b| {
        let whole = ArrayBuilder::new(SHAPE.to_vec(), SHAPE.to_vec(), data_type::int32(), 0_i32);
        drop(b.array("response", &whole));
    });
    assert!(numbers.contains("array response: expected numbers of type float32, float64 or float16"), "{numbers}");
}

#[test]
fn numbers_that_stand_for_missing_ones_are_not_measured() {
    let bench = Bench::new(json!({ "pitch_mm": 0.5 }));
    let mut builder = ArrayBuilder::new(SHAPE.to_vec(), SHAPE.to_vec(), data_type::float32(), 0.0_f32);
    let mut attributes = serde_json::Map::new();
    attributes.insert("_FillValue".into(), json!(-9999.0));
    builder.attributes(attributes);
    let array = bench.array("response", &builder);
    let values: Vec<f32> = (0..270).map(|k| if k % 5 == 0 { -9999.0 } else { number(k) }).collect();
    array.store_array_subset(&array.subset_all(), values).unwrap();
    let block = all(&bench.open());
    assert!((0..270).all(|k| (block.valid[k] == 0) == (k % 5 == 0) && (k % 5 != 0 || block.response[k] == 0.0)));
}

#[test]
fn a_store_of_zarr_2_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, value: &Value| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, value.to_string()).unwrap();
    };
    write(".zgroup", &json!({"zarr_format": 2}));
    write(".zattrs", &json!({"pitch_mm": 0.5}));
    let array = json!({"zarr_format": 2, "shape": [1, 1, 1, 3, 1], "chunks": [1, 1, 1, 3, 1], "dtype": "<f4", "compressor": null,
        "fill_value": "NaN", "order": "C", "filters": null});
    write("response/.zarray", &array);
    write("response/.zattrs", &json!({"_ARRAY_DIMENSIONS": NAMES}));
    let bytes: Vec<u8> = [1.0_f32, 2.0, f32::NAN].iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.path().join("response/0.0.0.0.0"), bytes).unwrap();
    let reader = MatrixReader::open(Path::new(folder.path())).unwrap();
    let block = reader.read(0..1).unwrap();
    assert_eq!(block.response, [1.0, 1.0, 1.0, 2.0, 2.0, 2.0, 0.0, 0.0, 0.0]);
    assert_eq!(block.valid, [1, 1, 1, 1, 1, 1, 0, 0, 0]);
}

#[test]
fn chunks_of_no_numbers_and_of_more_than_memory_has_are_refused_within_shards_too() {
    let bench = Bench::new(json!({ "pitch_mm": 0.25 }));
    bench.plain("response", &SHAPE, None, (0..270).map(number).collect());
    let file = bench.path().join("response/zarr.json");
    let written: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let bytes = json!([{ "name": "bytes", "configuration": { "endian": "little" } }]);
    for sides in [json!([2, 3, 3, 5, 0]), json!([2, 3, 3, 5, 1_u64 << 63]), json!([65536, 65536, 65536, 65536, 3])] {
        let mut outer = written.clone();
        outer["chunk_grid"]["configuration"]["chunk_shape"] = sides.clone();
        let mut inner = written.clone();
        let shards = json!({ "chunk_shape": sides, "codecs": bytes, "index_codecs": bytes, "index_location": "end" });
        inner["codecs"] = json!([{ "name": "sharding_indexed", "configuration": shards }]);
        for metadata in [outer, inner] {
            std::fs::write(&file, metadata.to_string()).unwrap();
            let said = bench.refused();
            assert!(said.contains("array response: expected chunks of 1 to 4294967296 numbers, found ["), "{said}");
        }
    }
}
