//! Makes every mistake in every capture, two builds at a time.

use crate::capture::Capture;
use crate::data::{Captures, Mistake, TamperedCapture};
use crate::grade::{Outcome, outcome, pattern};
use crate::program::{self, Built};
use crate::tamper::tamper;
use regex::Regex;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// As many builds at once as the machine has cores to spare for.
const AT_ONCE: usize = 2;

/// Calls `work` with every number below `count`, two at a time; the results are in their order.
pub(crate) fn in_turn<T: Send>(count: usize, work: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let (next, done) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    std::thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(|| {
                loop {
                    let k = next.fetch_add(1, Ordering::Relaxed);
                    if k >= count {
                        break;
                    }
                    let result = work(k);
                    done.lock().unwrap().push((k, result));
                }
            });
        }
    });
    let mut done = done.into_inner().unwrap();
    done.sort_by_key(|(k, _)| *k);
    done.into_iter().map(|(_, result)| result).collect()
}

/// A capture without mistakes, and what is built from it.
pub(crate) struct Untouched<'a> {
    pub capture: &'a TamperedCapture,
    dir: PathBuf,
    pub built: Built,
}

impl<'a> Untouched<'a> {
    fn simulate(capture: &'a TamperedCapture, folder: &Path, notes: &[Regex]) -> Self {
        let dir = folder.join(&capture.id);
        program::simulate(&capture.simulate, &dir);
        let built = program::build(&dir, notes);
        assert!(built.measures.is_some(), "the untouched {} is not built: {}", capture.id, built.stderr);
        Self { capture, dir, built }
    }
}

/// One mistake in one capture.
pub(crate) struct Run<'a> {
    pub mistake: &'a Mistake,
    pub capture: &'a str,
    pub built: Built,
    pub outcome: Outcome,
}

impl Run<'_> {
    /// What the data state for today, and whether this is worse.
    pub(crate) fn against_today(&self) -> Result<(), String> {
        let (id, capture, outcome) = (&self.mistake.id, self.capture, self.outcome);
        let said: Vec<&str> = self.built.messages.iter().map(|m| m.text.as_str()).collect();
        let told = match self.mistake.today.get(capture) {
            None => Err("the data state none".to_owned()),
            Some(name) => match Outcome::of_name(name) {
                None => Err(format!("the data state {name}, which is no outcome")),
                Some(stated) if outcome.rank() > stated.rank() => Err(format!("the data state {name}")),
                Some(_) => Ok(()),
            },
        };
        let told = if outcome == Outcome::Fault { Err("the program failed".to_owned()) } else { told };
        told.map_err(|why| format!("{id} in {capture}: {outcome}, but {why}; it said: {}", said.join(" | ")))
    }
}

/// The captures whose names the filter has, simulated and built.
pub(crate) fn untouched<'a>(captures: &'a Captures, folder: &Path, only: impl Fn(&str) -> bool) -> Vec<Untouched<'a>> {
    let notes = notes(captures);
    let chosen: Vec<_> = captures.tampered.iter().filter(|c| only(&c.id)).collect();
    in_turn(chosen.len(), |k| Untouched::simulate(chosen[k], folder, &notes))
}

pub(crate) fn notes(captures: &Captures) -> Vec<Regex> {
    captures.notes.iter().map(|n| pattern(n)).collect()
}

/// In which captures a mistake is made.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Each {
    /// In all.
    InAll,
    /// In one, the captures in turn.
    InOne,
}

/// Every mistake in every capture that it can be made in. `KEEP` of the environment names a folder where the captures
/// stay.
pub(crate) fn all<'a>(
    mistakes: &[&'a Mistake],
    untouched: &'a [Untouched<'a>],
    each: Each,
    folder: &Path,
    notes: &[Regex],
) -> Vec<Run<'a>> {
    let pairs: Vec<(&'a Mistake, &'a Untouched<'a>)> = mistakes
        .iter()
        .enumerate()
        .flat_map(|(k, &mistake)| {
            let (turned, one) = untouched.split_at(k % untouched.len());
            let can = one.iter().chain(turned).filter(|u| !mistake.cannot.contains_key(&u.capture.id));
            can.take(if each == Each::InOne { 1 } else { untouched.len() }).map(move |u| (mistake, u))
        })
        .collect();
    let keep = std::env::var_os("KEEP").map(PathBuf::from);
    in_turn(pairs.len(), |k| {
        let (mistake, u) = pairs[k];
        let name = format!("{}-{}", u.capture.id, mistake.id);
        let dir = keep.as_deref().unwrap_or(folder).join(name);
        let touched = tamper(&mut Capture::copy(&u.dir, &dir), mistake);
        let built = program::build(&dir, notes);
        if keep.is_none() {
            std::fs::remove_dir_all(&dir).unwrap();
            let _ = std::fs::remove_dir_all(format!("{}.rd.zarr", dir.display()));
        }
        let outcome = outcome(&u.built, &built, mistake, &touched);
        Run { mistake, capture: &u.capture.id, built, outcome }
    })
}
