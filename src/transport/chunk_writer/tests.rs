use super::super::store::tests::{header, row};
use super::super::{MatrixHeader, MatrixReader, MatrixWriter, RowBlock};
use super::*;
use crate::Error;
use crate::transport::checksum::ROWS;
use rayon::prelude::*;
use std::collections::BTreeMap;
use zarrs::array::ArraySubset;

/// Seven lit points a line in three chunks, of which the last is padded, and seven lines in three shards, of which the
/// last is.
const POINTS: [usize; 2] = [7, 7];
const CHUNKED: Chunking = Chunking { rows: 3, shard: Some([3, 3]) };
const PLAIN: Chunking = Chunking { rows: 3, shard: None };
const NAMES: [&str; 3] = ["c.0.0.0.0.0", "c.1.0.0.0.0", "c.2.0.0.0.0"];

/// Rows of which every other number was measured; nothing was measured in rows 21 to 27, a line.
fn write(path: &Path, chunking: Chunking) -> MatrixHeader {
    let header = header(POINTS, [5, 3]);
    let writer = MatrixWriter::create(path, header.clone()).unwrap().chunked(chunking);
    (0..49).filter(|k| !(21..28).contains(k)).for_each(|k| writer.put(k, &row(&header, k)).unwrap());
    writer.finish().unwrap();
    header
}

fn expected(header: &MatrixHeader, rows: Range<usize>) -> RowBlock {
    let made: Vec<_> = rows.clone().map(|k| (k, row(header, k))).collect();
    let of = |numbers: &dyn Fn(&super::super::Row) -> Vec<f32>| {
        made.iter().flat_map(|(k, row)| if (21..28).contains(k) { vec![0.0; 45] } else { numbers(row) }).collect()
    };
    let (response, variance) = (of(&|row| row.response.clone()), of(&|row| row.variance.clone()));
    let valid: Vec<f32> = of(&|row| row.valid.iter().map(|&v| f32::from(u8::from(v))).collect());
    let valid = valid.into_iter().map(|v| v as u8).collect();
    RowBlock { first: rows.start, rows: rows.len(), response, variance, valid }
}

fn files_of(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(at) = folders.pop() {
        for path in std::fs::read_dir(at).unwrap().map(|e| e.unwrap().path()) {
            match path.is_dir() {
                true => folders.push(path),
                false => drop(files.insert(path.strip_prefix(folder).unwrap().into(), std::fs::read(&path).unwrap())),
            }
        }
    }
    files
}

/// Bytes of the chunks of a shard, told by the specification of `sharding_indexed` and not by the code that is tested.
fn in_shard(bytes: &[u8], slots: usize) -> Vec<Option<Range<usize>>> {
    let index = &bytes[bytes.len() - 4 - 16 * slots..bytes.len() - 4];
    let number = |b: &[u8]| u64::from_le_bytes(b.try_into().unwrap());
    let of = |entry: &[u8]| match (number(&entry[..8]), number(&entry[8..])) {
        (u64::MAX, u64::MAX) => None,
        (at, len) => Some(at as usize..(at + len) as usize),
    };
    index.chunks(16).map(of).collect()
}

#[test]
fn more_than_a_thousand_chunks_are_in_shards_of_whole_lines() {
    let of = |points, window| {
        let header = header(points, window);
        let (chunking, files) = (Chunking::of(&header), Chunking::of(&header).files(&header));
        let all: Vec<usize> = files.iter().flatten().cloned().flatten().collect();
        assert!(all.into_iter().eq(0..header.rows()), "each row once, in order");
        (chunking.shard, files.len(), files.iter().map(Vec::len).max().unwrap())
    };
    assert_eq!(of([3, 1000], [3, 1]), (None, 1000, 1));
    assert_eq!(of([3, 1001], [3, 1]), (Some([32, 1]), 32, 32));
    // Paper scale: 256 × 256 points, 44,652 bytes a row, four chunks a line.
    assert_eq!(of([256, 256], [61, 61]), (Some([8, 4]), 32, 32));
    // 1024 × 1024 points, 175,692 bytes a row, 64 chunks a line: more files than are allowed, were shards no larger.
    assert_eq!(of([1024, 1024], [121, 121]), (Some([2, 64]), 512, 128));
    // A line of 2³⁸ numbers is more than one shard may have.
    let vast = MatrixHeader { lit_mm: vec![], position_sd_mm: vec![], shot_of: vec![], ..header([4, 1], [1, 1]) };
    let vast = MatrixHeader { points: [5462, 2], window: [4095, 4095], ..vast };
    assert_eq!(Chunking::of(&vast), Chunking { rows: 1, shard: Some([1, 85]) });
}

#[test]
fn rows_in_shards_are_those_that_were_put_whoever_reads_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = write(&path, CHUNKED);
    let reader = MatrixReader::open(&path).unwrap();
    // All; one row; across chunks; across lines; across shards; what is padded.
    for rows in [0..49, 4..5, 1..6, 5..17, 18..30, 6..7, 45..49, 21..28] {
        assert_eq!(reader.read(rows.clone()).unwrap(), expected(&header, rows));
    }
    // The general way of the Zarr crate, which knows the codec.
    let array = Array::open(Arc::new(FilesystemStore::new(&path).unwrap()), "/response").unwrap();
    let subset = ArraySubset::new_with_ranges(&[2..5, 1..7, 0..3, 0..5, 0..3]);
    let found: Vec<f32> = array.retrieve_array_subset(&subset).unwrap();
    let made = expected(&header, 0..49);
    for (k, v) in found.iter().enumerate() {
        let at = ((k / 270 + 2) * 7 + k / 45 % 6 + 1) * 45 + k % 45;
        assert!(if made.valid[at] == 1 { *v == made.response[at] } else { v.is_nan() }, "number {k}: {v}");
    }
}

#[test]
fn a_chunk_has_the_same_bytes_in_a_shard_and_in_a_file_of_its_own_whatever_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let [one, many, plain] = ["one", "many", "plain"].map(|name| folder.path().join(name));
    let with = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    with(1).install(|| write(&one, CHUNKED));
    with(5).install(|| write(&many, CHUNKED));
    assert_eq!(files_of(&one), files_of(&many));
    write(&plain, PLAIN);
    let (sharded, plain) = (files_of(&one), files_of(&plain));
    for name in ROWS {
        assert_eq!(sharded.keys().filter(|path| path.starts_with(name)).count(), 3 + 1, "shards and metadata");
        for line in 0..7 {
            let shard = &sharded[&Path::new(name).join(NAMES[line / 3])];
            for (k, range) in in_shard(shard, 9)[line % 3 * 3..][..3].iter().enumerate() {
                let alone = plain.get(&Path::new(name).join(format!("c.{line}.{k}.0.0.0")));
                assert_eq!(
                    range.clone().map(|r| &shard[r]),
                    alone.map(Vec::as_slice),
                    "{name}, line {line}, chunk {k}"
                );
                // Nothing was measured in line 3.
                assert_eq!(range.is_none(), line == 3 && name != "valid", "{name}, line {line}");
            }
        }
    }
}

#[test]
fn a_row_takes_nothing_of_a_shard_but_its_chunk_and_the_index() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = write(&path, CHUNKED);
    for name in ROWS {
        let shard = path.join(name).join(NAMES[1]);
        let mut bytes = std::fs::read(&shard).unwrap();
        // Row 40 is in line 5, column 5: in the second shard the eighth chunk. All others are overwritten.
        for range in in_shard(&bytes, 9).into_iter().enumerate().filter_map(|(k, range)| range.filter(|_| k != 7)) {
            bytes[range].fill(0);
        }
        std::fs::write(&shard, bytes).unwrap();
    }
    let reader = MatrixReader::open(&path).unwrap();
    assert_eq!(reader.read(40..41).unwrap(), expected(&header, 40..41));
    assert_eq!(reader.read(38..41).unwrap(), expected(&header, 38..41));
    let said = reader.read(37..41).unwrap_err().to_string();
    assert!(said.contains("chunk of rows 35 to 37 in shard c.1.0.0.0.0 is not the one"), "{said}");
}

#[test]
fn a_shard_that_is_cut_damaged_missing_or_another_is_told_with_its_file_and_rows() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    write(&path, CHUNKED);
    let said = |open: bool| match MatrixReader::open(&path).map(|reader| reader.read(42..45)) {
        Err(Error::BrokenMatrix { reason, .. }) if open => reason,
        Ok(Err(Error::BrokenMatrix { reason, .. })) if !open => reason,
        other => panic!("{:?}", other.map(|read| read.map(|_| ()))),
    };
    for name in ROWS {
        let shard = path.join(name).join(NAMES[2]);
        let bytes = std::fs::read(&shard).unwrap();
        let index = bytes.len() - 4 - 16 * 9;
        let prefix = format!("array {name}: chunk of rows 42 to 44 in shard c.2.0.0.0.0");
        for cut in [bytes.len() - 1, index + 3, index / 2, 3, 0] {
            std::fs::write(&shard, &bytes[..cut]).unwrap();
            assert_eq!(
                said(false),
                format!("{prefix} cannot be found: the shard is cut short, or its index is damaged")
            );
        }
        for at in [index, index + 9, bytes.len() - 2] {
            let mut changed = bytes.clone();
            changed[at] ^= 8;
            std::fs::write(&shard, changed).unwrap();
            assert_eq!(
                said(false),
                format!("{prefix} cannot be found: the shard is cut short, or its index is damaged")
            );
        }
        // One bit of a chunk's numbers, and of its CRC-32C.
        let end = in_shard(&bytes, 9)[0].clone().unwrap().end;
        for (at, words) in [(7, "damaged: its CRC-32C is another"), (end - 1, "not the one that was written there")] {
            let mut changed = bytes.clone();
            changed[at] ^= 8;
            std::fs::write(&shard, changed).unwrap();
            assert_eq!(said(false), format!("{prefix} is {words}"));
        }
        std::fs::remove_file(&shard).unwrap();
        assert_eq!(said(true), format!("array {name}: shard c.2.0.0.0.0 of rows 42 to 48 is missing"));
        std::fs::write(&shard, &bytes).unwrap();
        let other = path.join(name).join("c.3.0.0.0.0");
        std::fs::write(&other, &bytes).unwrap();
        assert_eq!(said(true), format!("array {name}: c.3.0.0.0.0 is no chunk of it"));
        std::fs::remove_file(&other).unwrap();
        // Another shard, whole, under this name; those of validity are equal, as every row has every other number.
        if name != "valid" {
            std::fs::copy(path.join(name).join(NAMES[0]), &shard).unwrap();
            assert_eq!(said(false), format!("{prefix} is not the one that was written there"));
        }
        std::fs::write(&shard, bytes).unwrap();
    }
    MatrixReader::open(&path).unwrap().read(0..49).unwrap();
}

#[test]
fn a_shard_that_goes_under_an_open_reader_is_missed_by_its_rows_alone() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let header = write(&path, CHUNKED);
    let reader = MatrixReader::open(&path).unwrap();
    reader.read(0..7).unwrap();
    std::fs::remove_file(path.join("variance").join(NAMES[1])).unwrap();
    let said = reader.read(21..24).unwrap_err().to_string();
    assert!(said.ends_with("array variance: chunk of rows 21 to 23 in shard c.1.0.0.0.0 is missing"), "{said}");
    assert_eq!(reader.read(42..49).unwrap(), expected(&header, 42..49));
    assert_eq!(reader.read_responses(21..49).unwrap().response, expected(&header, 21..49).response);
}

#[test]
fn a_matrix_in_shards_is_replaced_by_the_next_and_a_changed_one_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    write(&path, CHUNKED);
    write(&path, PLAIN);
    let header = write(&path, CHUNKED);
    assert_eq!(MatrixReader::open(&path).unwrap().read(0..49).unwrap(), expected(&header, 0..49));
    std::fs::remove_file(path.join("valid").join(NAMES[2])).unwrap();
    assert!(matches!(MatrixWriter::create(&path, header), Err(Error::Changed { .. })));
}

/// What shards cost and save, at the paper's size where the variable of the environment SHARDS_OF_THE_PAPER is set (some
/// minutes, 6 GB of TMPDIR): `SHARDS_OF_THE_PAPER=1 cargo test --release --lib the_cost_of_shards -- --ignored
/// --nocapture`.
#[test]
#[ignore = "slow at the size of the paper"]
fn the_cost_of_shards() {
    let whole = std::env::var_os("SHARDS_OF_THE_PAPER").is_some();
    let (points, window) = if whole { ([256, 256], [61, 61]) } else { ([2, 1100], [5, 3]) };
    let folder = tempfile::tempdir().unwrap();
    let header = header(points, window);
    let n = header.row_len();
    // One per cent of noise on a fall to all sides, as measured rows have it.
    let value = |k: usize| {
        let noise = (k as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(23) >> 40;
        (1.0 + 0.01 * noise as f32 / (1 << 24) as f32) / (1 + (k % n).abs_diff(n / 2)) as f32
    };
    let rows = |range: Range<usize>| {
        let response: Vec<f32> = (range.start * n..range.end * n).map(value).collect();
        let variance = response.iter().map(|v| 1e-4 * v * v).collect();
        RowBlock { first: range.start, rows: range.len(), valid: vec![1; response.len()], response, variance }
    };
    let sharded = Chunking::of(&header);
    println!("| files an array | to write, s | to open, s | all rows, s | one row, ms |\n|---|---|---|---|---|");
    for (name, chunking) in [("plain", Chunking { shard: None, ..sharded }), ("sharded", sharded)] {
        let path = folder.path().join(name);
        let writer = MatrixWriter::create(&path, header.clone()).unwrap().chunked(chunking);
        let timed = |work: &mut dyn FnMut()| {
            let start = std::time::Instant::now();
            work();
            start.elapsed().as_secs_f64()
        };
        let mut writer = Some(writer);
        let write = timed(&mut || writer.take().unwrap().finish_with(|range| Ok(rows(range))).unwrap());
        let mut reader = None;
        let open = timed(&mut || reader = Some(MatrixReader::open(&path).unwrap()));
        let reader = reader.unwrap();
        let all = timed(&mut || reader.chunks().into_par_iter().for_each(|rows| drop(reader.read(rows).unwrap())));
        let mut each: Vec<f64> = (0..101)
            .map(|k| {
                let row = k * 40_503 % header.rows();
                let secs =
                    timed(&mut || assert_eq!(reader.read(row..row + 1).unwrap().response[7], value(row * n + 7)));
                1e3 * secs
            })
            .collect();
        each.sort_by(f64::total_cmp);
        let files = std::fs::read_dir(path.join("response")).unwrap().count() - 1;
        // A chunk is a line of these points at least; 32 chunks a shard.
        let chunks = if whole { 1024usize } else { 1100 };
        assert_eq!(files, if name == "plain" { chunks } else { chunks.div_ceil(32) });
        println!("| {files} | {write:.1} | {open:.3} | {all:.2} | {:.2} |", each[50]);
    }
}
