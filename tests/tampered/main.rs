//! Mistakes that laboratories make, made in simulated captures: what does the program say, and how wrong is its matrix?
//!
//! The mistakes are data, mistakes/; so are the captures, captures.toml. docs/testing.md says how to add one. Variables
//! of the environment: `MISTAKE` and `CAPTURE` choose by parts of names, with commas between them; `ACQUIRE` names
//! another program; `KEEP` a folder where the captures stay; `WRITE=1` writes docs/tampered.md and the lines `today`.

#[path = "../common/mod.rs"]
mod common;

mod capture;
mod data;
mod edit;
mod grade;
mod optics;
mod picture;
mod power;
mod program;
mod runs;
mod sensor;
mod survey;
mod table;
mod tamper;

use data::{Mistake, captures, mistakes};
use runs::{Each, Run};
use std::path::Path;

/// Whether a name has one of the parts that the environment asks for; without that, all have.
fn asked(variable: &str, name: &str) -> bool {
    std::env::var(variable).map_or(true, |parts| parts.split(',').any(|part| name.contains(part)))
}

/// Whether anything is asked for: then all is done that is, and not a part that is quick.
fn is_asked() -> bool {
    ["MISTAKE", "CAPTURE", "WRITE", "ALL"].iter().any(|variable| std::env::var_os(variable).is_some())
}

fn page(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name)
}

/// Fails with every run that is worse than what is stated.
fn hold(runs: &[Run]) {
    let broken: Vec<String> = runs.iter().filter_map(|run| run.against_today().err()).collect();
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

#[test]
fn a_mistake_of_each_kind_ends_no_worse_than_stated() {
    let (captures, mistakes) = (captures(), mistakes());
    let folder = tempfile::tempdir().unwrap();
    let chosen: Vec<&Mistake> = mistakes.iter().filter(|m| m.fast).collect();
    let first = &captures.tampered[0].id;
    let untouched = runs::untouched(&captures, folder.path(), |id| id == first);
    hold(&runs::all(&chosen, &untouched, Each::InAll, folder.path(), &runs::notes(&captures)));
}

#[test]
#[ignore = "slow: every mistake in one capture, two minutes; in all captures when a variable of the environment is set"]
fn every_mistake_ends_no_worse_than_stated() {
    let (captures, mistakes) = (captures(), mistakes());
    let folder = tempfile::tempdir().unwrap();
    let chosen: Vec<&Mistake> = mistakes.iter().filter(|m| asked("MISTAKE", &m.id)).collect();
    let untouched = runs::untouched(&captures, folder.path(), |id| asked("CAPTURE", id));
    let each = if is_asked() { Each::InAll } else { Each::InOne };
    let runs = runs::all(&chosen, &untouched, each, folder.path(), &runs::notes(&captures));
    let table = table::markdown(&chosen, &untouched, &runs);
    println!("{table}");
    if std::env::var_os("MISTAKE").is_some() {
        runs.iter().for_each(|r| println!("## {} in {}: {}\n{}", r.mistake.id, r.capture, r.outcome, r.built.stderr));
    }
    if std::env::var_os("WRITE").is_some() {
        let mut files: Vec<&str> = chosen.iter().map(|m| m.file.as_str()).collect();
        files.dedup();
        for file in files {
            table::write_today(&page(&format!("tests/tampered/mistakes/{file}.toml")), &runs);
        }
        if chosen.len() == mistakes.len() && untouched.len() == captures.tampered.len() {
            table::write_between(&page("docs/tampered.md"), "outcomes", &table);
        }
        return;
    }
    hold(&runs);
}

#[test]
fn the_data_are_sound() {
    let (captures, mistakes) = (captures(), mistakes());
    let mut ids: Vec<&str> = mistakes.iter().map(|m| m.id.as_str()).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!(ids.len(), mistakes.len(), "two mistakes have one name");
    for mistake in &mistakes {
        let id = &mistake.id;
        assert!(!mistake.steps.is_empty() || !mistake.edits.is_empty(), "{id} changes nothing");
        assert!(!mistake.names.is_empty() || mistake.says.is_some(), "{id}: no message would be right");
        mistake.says.iter().chain(&mistake.wrong).for_each(|p| drop(grade::pattern(p)));
        let known = |c: &&String| captures.tampered.iter().any(|t| t.id == **c);
        assert!(mistake.cannot.keys().chain(mistake.today.keys()).all(|c| known(&c)), "{id}: an unknown capture");
    }
}
