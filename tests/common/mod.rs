//! Small simulated captures for whole-pipeline tests.
#![allow(dead_code)]

use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, simulate};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The default bench with coarser voxels and a looser solver: a chessboard takes half of the processor time or less.
/// Photographs and truth are of the same light, so the two still agree; rows of one medium, though, differ by where
/// their dots lie on the voxels, and nearly opaque slabs need the default's.
pub(crate) fn bench() -> SimulateOptions {
    SimulateOptions { voxels_per_sample: 1, tolerance: 1e-4, ..SimulateOptions::default() }
}

/// A capture folder of its own for the test, simulated with `options`.
pub(crate) fn capture(options: &SimulateOptions) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("capture");
    simulate(options, &dir, &Progress::silent()).unwrap();
    // Tests change photographs as benches do, before a capture is made of them.
    let _ = std::fs::remove_file(dir.join("photographs.b3"));
    (folder, dir)
}

/// Copies a folder with all that is in it.
pub(crate) fn copy_folder(from: &Path, to: &Path) {
    lay_folder(from, to, &|file, target| std::fs::copy(file, target).map(|_| ()));
}

/// The same folders, and in them what `put` makes of each file.
pub(crate) fn lay_folder(from: &Path, to: &Path, put: &dyn Fn(&Path, &Path) -> std::io::Result<()>) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            lay_folder(&entry.path(), &target, put);
        } else {
            put(&entry.path(), &target).unwrap();
        }
    }
}

/// Every file under a folder, by its path in it, `/` between the names.
pub(crate) fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut out = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if path.is_dir() {
            out.extend(files(&path).into_iter().map(|(inner, bytes)| (format!("{name}/{inner}"), bytes)));
        } else {
            out.insert(name, std::fs::read(&path).unwrap());
        }
    }
    out
}

/// Runs the program and gives (exit status, stdout, stderr).
pub(crate) fn acquire(args: &[&str]) -> (i32, String, String) {
    outcome(Command::new(env!("CARGO_BIN_EXE_acquire")).args(args))
}

/// The program with the words of a line, in a folder.
pub(crate) fn command_in(folder: &Path, line: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_acquire"));
    command.args(line.split(' ')).current_dir(folder);
    command
}

/// (exit status, stdout, stderr)
pub(crate) fn outcome(command: &mut Command) -> (i32, String, String) {
    let output = command.output().unwrap();
    let text = |b: Vec<u8>| String::from_utf8_lossy(&b).into_owned();
    (output.status.code().unwrap_or(-1), text(output.stdout), text(output.stderr))
}

/// A matrix against its truth, computed here and not by the code under test.
#[derive(Debug)]
pub(crate) struct Comparison {
    /// ‖R − truth‖ / ‖truth‖ over valid entries.
    pub rel_rmse: f64,
    /// Share of valid entries within two stated standard deviations of the truth.
    pub coverage: f64,
    /// Share of entries that are valid.
    pub valid: f64,
    /// RMS error of the shots' drift per axis, px.
    pub drift_rms_px: f64,
}

/// Compares two matrices of the same shape entry by entry.
pub(crate) fn compare(measured: &Path, truth: &Path) -> Comparison {
    use acquire::transport::MatrixReader;
    let (a, b) = (MatrixReader::open(measured).unwrap(), MatrixReader::open(truth).unwrap());
    let rows = 0..a.header().rows();
    let (x, y) = (a.read(rows.clone()).unwrap(), b.read(rows).unwrap());
    let (mut error, mut norm, mut within, mut valid) = (0.0f64, 0.0f64, 0usize, 0usize);
    for k in (0..x.response.len()).filter(|&k| x.valid[k] == 1) {
        let d = f64::from(x.response[k]) - f64::from(y.response[k]);
        error += d * d;
        norm += f64::from(y.response[k]).powi(2);
        within += usize::from(d * d <= 4.0 * f64::from(x.variance[k]));
        valid += 1;
    }
    let shots = a.header().shots.iter().zip(&b.header().shots);
    let drift: f64 = shots.flat_map(|(a, b)| [0, 1].map(|i| (a.drift_px[i] - b.drift_px[i]).powi(2))).sum();
    Comparison {
        rel_rmse: (error / norm).sqrt(),
        coverage: within as f64 / valid as f64,
        valid: valid as f64 / x.valid.len() as f64,
        drift_rms_px: (drift / (2 * a.header().shots.len()) as f64).sqrt(),
    }
}
