//! Runs the program as a person would, and reads what it says.

use regex::Regex;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The program under test: that of this package, or the one that the variable ACQUIRE names.
fn program() -> Command {
    Command::new(std::env::var_os("ACQUIRE").unwrap_or_else(|| env!("CARGO_BIN_EXE_acquire").into()))
}

/// Exit status, stdout, stderr.
pub(crate) fn run(args: &[&str]) -> (i32, String, String) {
    let output = program().args(args).output().unwrap();
    let text = |b: Vec<u8>| String::from_utf8_lossy(&b).into_owned();
    (output.status.code().unwrap_or(-1), text(output.stdout), text(output.stderr))
}

pub(crate) fn simulate(options: &str, dir: &Path) {
    let mut args = vec!["simulate", dir.to_str().unwrap(), "--quiet"];
    args.extend(options.split_whitespace());
    let (status, _, stderr) = run(&args);
    assert_eq!(status, 0, "acquire simulate {options}: {stderr}");
}

/// What a build came to.
#[derive(Debug, Clone)]
pub(crate) struct Built {
    pub status: i32,
    /// Errors and warnings, each with its hint.
    pub messages: Vec<Message>,
    /// Names of the findings that the matrix keeps.
    pub findings: Vec<String>,
    /// Against the truth, when there is a matrix.
    pub measures: Option<Measures>,
    pub stderr: String,
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Message {
    /// A note states something; it accuses nobody.
    pub note: bool,
    pub text: String,
}

impl Message {
    /// The words without their figures: one warning with other figures is no new one.
    pub(crate) fn words(&self) -> String {
        self.text.replace(|c: char| c.is_ascii_digit() || "+-−.".contains(c), "")
    }
}

#[derive(Debug, Clone, Copy)]
pub(crate) struct Measures {
    pub rel_rmse: f64,
    pub coverage: f64,
    pub entries: f64,
}

/// `build-matrix` with no options but the output, then `evaluate`.
pub(crate) fn build(capture: &Path, notes: &[Regex]) -> Built {
    let matrix = PathBuf::from(format!("{}.rd.zarr", capture.display()));
    let (dir, out) = (capture.to_str().unwrap(), matrix.to_str().unwrap());
    let (status, _, stderr) = run(&["build-matrix", dir, "--out", out]);
    // The capture's folder is not part of what is said.
    let messages = messages(&stderr.replace(dir, "CAPTURE"), notes);
    let built = matrix.exists();
    Built {
        status,
        messages,
        findings: if built { findings(&matrix) } else { Vec::new() },
        measures: if status == 0 && built { measures(out, &capture.join("truth.rd.zarr")) } else { None },
        stderr,
    }
}

fn messages(stderr: &str, notes: &[Regex]) -> Vec<Message> {
    let mut found: Vec<Message> = Vec::new();
    for line in stderr.lines() {
        let head = line.split([':', '[']).next().unwrap_or_default();
        match head {
            "error" | "warning" | "note" => {
                let note = head == "note" || notes.iter().any(|n| n.is_match(line));
                found.push(Message { note, text: line.to_owned() });
            }
            "hint" => found.iter_mut().last().into_iter().for_each(|m| m.text = format!("{}; {line}", m.text)),
            _ => {}
        }
    }
    found
}

/// From the store's attributes: `warnings` (and `findings`), each with the name of its kind.
fn findings(matrix: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(matrix.join("zarr.json")).unwrap_or_default();
    let root: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    let lists = ["warnings", "findings"].map(|name| root["attributes"][name].as_array().cloned().unwrap_or_default());
    let name = |finding: serde_json::Value| {
        let of = |field: &str| finding[field].as_str().map(str::to_owned);
        of("warning").or_else(|| of("id")).or_else(|| of("finding"))
    };
    lists.concat().into_iter().filter_map(name).collect()
}

fn measures(matrix: &str, truth: &Path) -> Option<Measures> {
    let (status, stdout, _) = run(&["evaluate", matrix, truth.to_str().unwrap(), "--json", "--quiet"]);
    let found: serde_json::Value = serde_json::from_str(&stdout).ok().filter(|_| status == 0)?;
    let figure = |name: &str| found[name].as_f64();
    Some(Measures {
        rel_rmse: figure("rel_rmse")?,
        coverage: figure("coverage_2sigma").unwrap_or(f64::NAN),
        entries: figure("entries")?,
    })
}
