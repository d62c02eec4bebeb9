//! `acquire import-matrix`: arrays of other programs to a store, or one message that says why not.

use crate::common::acquire;
use acquire::transport::MatrixReader;
use npyz::WriterBuilder;
use std::path::{Path, PathBuf};

fn write(to: &mut dyn std::io::Write, shape: &[u64], value: impl Fn(usize) -> f64) {
    let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(to).begin_nd().unwrap();
    array.extend((0..shape.iter().product::<u64>() as usize).map(value)).unwrap();
    array.finish().unwrap();
}

struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    fn npy(&self, name: &str, shape: &[u64], value: impl Fn(usize) -> f64) -> String {
        write(&mut std::fs::File::create(self.0.path().join(name)).unwrap(), shape, value);
        self.path(name)
    }

    fn entries(&self) -> Vec<PathBuf> {
        let mut all: Vec<_> = std::fs::read_dir(self.0.path()).unwrap().map(|e| e.unwrap().path()).collect();
        all.sort();
        all
    }

    /// It must fail with all of `words`, and leave nothing.
    fn fails(&self, arguments: &[&str], words: &[&str]) {
        let before = self.entries();
        let (status, stdout, stderr) = acquire(arguments);
        assert_eq!((status, stdout.as_str()), (1, ""), "{stderr}");
        assert!(stderr.contains("hint: "), "{stderr}");
        for word in words {
            assert!(stderr.contains(word), "\"{word}\" is not in: {stderr}");
        }
        assert_eq!(self.entries(), before);
    }
}

#[test]
fn an_array_becomes_a_store_that_other_commands_take() {
    let bench = Bench::new();
    // 4 × 3 points, windows of 5 × 5: row-major values that fall with the distance.
    let response = |k: usize| {
        let (i, d) = (k / 25, [k % 5, k / 5 % 5].map(|v| v as f64 - 2.0));
        0.1 * (-d[0].hypot(d[1])).exp() * (1.0 + 0.01 * i as f64)
    };
    let (input, out) = (bench.npy("x.npy", &[3, 4, 5, 5], response), bench.path("x.rd.zarr"));
    let (status, stdout, stderr) =
        acquire(&["import-matrix", &input, "--pitch-mm", "0.5", "--lit-pitch-mm", "1x1.5", "--out", &out, "--json"]);
    assert_eq!(status, 0, "{stderr}");
    let told: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(told["points"], serde_json::json!([4, 3]));
    assert_eq!(told["lit_pitch_mm"], serde_json::json!([1.0, 1.5]));
    assert_eq!((&told["channels"], &told["measured_share"]), (&1.into(), &1.0.into()));
    assert!(stderr.contains("variance: 0, not known") && stderr.contains("1 channel (grey)"), "{stderr}");
    let reader = MatrixReader::open(Path::new(&out)).unwrap();
    let block = reader.read(0..12).unwrap();
    for (k, rgb) in block.response.chunks(3).enumerate() {
        assert_eq!(rgb, [response(k) as f32; 3]);
    }
    assert_eq!(reader.header().lit_mm[5], [1.0, 1.5]);
    let material = bench.path("x.safetensors");
    assert_eq!(acquire(&["factor", &out, "--out", &material, "-q"]).0, 0);
    // What is there is kept, and replaced when asked; quietly nothing is said.
    let again = ["import-matrix", &input, "--pitch-mm", "0.5", "--out", &out];
    bench.fails(&again, &["x.rd.zarr", "--force"]);
    let (status, stdout, stderr) = acquire(&[&again[..], &["--force", "-q"]].concat());
    assert_eq!((status, stdout.as_str(), stderr.as_str()), (0, "", ""));
    // A store is imported as it is, under its own name not.
    let copy = bench.path("copy.rd.zarr");
    assert_eq!(acquire(&["import-matrix", &out, "--out", &copy, "-q"]).0, 0);
    let copied = MatrixReader::open(Path::new(&copy)).unwrap().read(0..12).unwrap();
    assert_eq!(copied, MatrixReader::open(Path::new(&out)).unwrap().read(0..12).unwrap());
    bench.fails(&["import-matrix", &out, "--out", &out, "--force"], &["--out", "a place apart from the inputs"]);
    bench.fails(&["import-matrix", &out, "--out", &format!("{out}/inside.rd.zarr")], &["--out"]);
    bench.fails(&["import-matrix", &out, "--window", "3", "--out", &bench.path("w.rd.zarr")], &["--window", "3x3"]);
}

#[test]
fn an_archive_has_arrays_by_name() {
    let bench = Bench::new();
    let path = bench.path("x.npz");
    let mut zip = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
    let options = zip::write::SimpleFileOptions::default();
    for (name, shape, value) in [
        (
            "response",
            &[1, 2, 1, 3, 3][..],
            &(|k: usize| if k == 4 { f64::NAN } else { 0.01 * k as f64 }) as &dyn Fn(usize) -> f64,
        ),
        ("variance", &[1, 2, 1, 3, 3], &|_| 1e-6),
        ("x_i_mm", &[1, 2], &|k| 2.0 * k as f64),
        ("y_i_mm", &[1, 2], &|_| 1.0),
        ("pitch_mm", &[], &|_| 0.25),
    ] {
        zip.start_file(format!("{name}.npy"), options).unwrap();
        write(&mut zip, shape, value);
    }
    zip.finish().unwrap();
    let out = bench.path("x.rd.zarr");
    let (status, _, stderr) = acquire(&["import-matrix", &path, "--out", &out]);
    assert_eq!(status, 0, "{stderr}");
    assert!(
        stderr.contains("note: response: 1 of 18 numbers NaN or marked invalid, first response[0, 0, 0, 1, 1]"),
        "{stderr}"
    );
    let reader = MatrixReader::open(Path::new(&out)).unwrap();
    assert_eq!((reader.header().pitch_mm, reader.header().lit_pitch_mm), (0.25, [2.0, 0.25]));
    let block = reader.read(0..2).unwrap();
    assert_eq!((block.valid[4], block.response[4], block.variance[4], block.variance[5]), (0, 0.0, 0.0, 1e-6));
}

#[test]
fn arrays_that_make_no_matrix_are_refused_and_nothing_is_written() {
    let bench = Bench::new();
    let out = bench.path("x.rd.zarr");
    let good = bench.npy("good.npy", &[2, 2, 3, 3], |_| 0.1);
    let import =
        |input: &str, words: &[&str]| bench.fails(&["import-matrix", input, "--pitch-mm", "0.5", "--out", &out], words);
    import(&bench.npy("even.npy", &[2, 2, 4, 3], |_| 0.1), &["even.npy", "response", "odd numbers", "[2, 2, 4, 3]"]);
    import(&bench.npy("one.npy", &[9], |_| 0.1), &["one.npy", "found shape [9]"]);
    import(
        &bench.npy("inf.npy", &[2, 2, 3, 3], |k| if k == 11 { f64::INFINITY } else { 0.1 }),
        &["inf at response[0, 1, 0, 2]"],
    );
    import(&bench.npy("odd.npy", &[6, 6], |_| 0.1), &["--points", "6 is no square"]);
    import(&bench.path("none.npy"), &["none.npy", "cannot read"]);
    std::fs::write(bench.path("text.npz"), "response").unwrap();
    import(&bench.path("text.npz"), &["text.npz", "expected an .npy or .npz"]);
    std::fs::write(bench.path("cut.npz"), b"PK\x03\x04").unwrap();
    import(&bench.path("cut.npz"), &["cut.npz", "whole NPZ archive"]);
    let whole = std::fs::read(&good).unwrap();
    std::fs::write(bench.path("cut.npy"), &whole[..whole.len() - 1]).unwrap();
    import(&bench.path("cut.npy"), &["cut.npy", "whole NumPy array"]);
    // A header that promises 2⁶² numbers.
    let text = String::from_utf8_lossy(&whole[10..128]).replace("(2, 2, 3, 3, )", "(2147483648, 2147483648)");
    let huge = [&whole[..8], &(text.len() as u16).to_le_bytes(), text.as_bytes(), &whole[128..]].concat();
    std::fs::write(bench.path("huge.npy"), huge).unwrap();
    import(&bench.path("huge.npy"), &["huge.npy"]);
    std::fs::create_dir(bench.path("folder")).unwrap();
    import(&bench.path("folder"), &["folder", "zarr.json"]);
    bench.fails(&["import-matrix", &good, "--out", &out], &["--pitch-mm"]);
    bench.fails(&["import-matrix", &good, "--pitch-mm", "0", "--out", &out], &["--pitch-mm"]);
    bench.fails(&["import-matrix", &good, "--pitch-mm", "nan", "--out", &out], &["--pitch-mm"]);
    bench.fails(
        &["import-matrix", &good, "--pitch-mm", "1", "--full", "--out", &out],
        &["response", "as many outgoing"],
    );
    bench.fails(&["import-matrix", &good, "--pitch-mm", "1", "--out", &bench.path("no/x.rd.zarr")], &["x.rd.zarr"]);
}
