//! Small simulated captures for whole-pipeline tests.
#![allow(dead_code)]

use acquire::progress::Progress;
use acquire::simulate::{Options, simulate};
use std::path::{Path, PathBuf};

/// A capture folder of its own for the test, simulated with `options`.
pub fn capture(options: &Options) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("capture");
    simulate(options, &dir, &Progress::silent()).unwrap();
    (folder, dir)
}

/// Copies a folder with all that is in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Runs the program and gives (exit status, stdout, stderr).
pub fn acquire(args: &[&str]) -> (i32, String, String) {
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_acquire")).args(args).output().unwrap();
    let text = |b: Vec<u8>| String::from_utf8_lossy(&b).into_owned();
    (output.status.code().unwrap_or(-1), text(output.stdout), text(output.stderr))
}
