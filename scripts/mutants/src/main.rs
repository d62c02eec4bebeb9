//! Plants all mutants of the given files into their sources at once, each behind `crate::mutant(k)`.
//!
//! `mutants ROOT DROPPED FILE...` rewrites the files below ROOT in place and prints two kinds of lines, fields
//! separated by tabs:
//!
//! - `mutant`, number, file, line, column, what is replaced, function;
//! - `place`, file, first byte, byte after the last, numbers: what the rewritten file has there belongs to these
//!   mutants, so that an error of the compiler tells which of them do not compile.
//!
//! DROPPED lists the mutants not to plant, one a line: file, line, column, what. Nothing is planted in tests,
//! constants, patterns, types, `const fn` and the arguments of macros.

mod operators;
mod rewrite;

use std::collections::HashSet;
use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [root, dropped, files @ ..] = &arguments[..] else {
        eprintln!("usage: mutants ROOT DROPPED FILE...");
        return ExitCode::from(2);
    };
    let dropped: HashSet<String> =
        std::fs::read_to_string(dropped).unwrap_or_default().lines().map(str::to_string).collect();
    let mut count = 0;
    for file in files {
        let path = format!("{root}/{file}");
        let planted = std::fs::read_to_string(&path)
            .map_err(|e| e.to_string())
            .and_then(|source| operators::plant(file, &source, &dropped, &mut count).map_err(|e| e.to_string()))
            .and_then(|planted| std::fs::write(&path, &planted.text).map(|()| planted).map_err(|e| e.to_string()));
        match planted {
            Ok(planted) => planted.lines.iter().for_each(|line| println!("{line}")),
            Err(error) => {
                eprintln!("error: {path}: {error}");
                return ExitCode::FAILURE;
            }
        }
    }
    ExitCode::SUCCESS
}
