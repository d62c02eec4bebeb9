//! A sweep that many processes measure: each writes a part ([`extract`]), one puts the parts together ([`assemble`]) to
//! the matrix that [`super::build_matrix`] makes, bit by bit.
//!
//! A part says what a stopped run leaves in its scratch folder ([`super::resume`]): measured shots under a key of all
//! that they are measured against, their rows by their BLAKE3. So one of another capture, version or rig, a damaged or
//! a missing one changes nothing but which shots are still to be measured.

use super::findings::unmeasured;
use super::lattice;
use super::resume::{MeasuredShot, key};
use super::saved::SavedCapture;
use super::scene::Scene;
use super::sink::RowSink;
use super::{Before, BuildOptions, BuildReport, Judged, Prepared, measure, open, with_prepared, write};
use crate::capture::{Grid, Manifest, Pattern};
use crate::output::{Earlier, PROGRAM, WorkLog};
use crate::progress::Progress;
use crate::transport::{MatrixWriter, Part, PartWriter, Row, RowsAt, check_part, find_parts};
use crate::words::ranges;
use crate::{Error, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

/// Lattice shots of a sweep.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Shots {
    /// By their numbers in the sweep, from 0; the end is not in it.
    Range(Range<usize>),
    /// Part `number`, from 1, of `of` parts of nearly equal size.
    Part {
        /// Which one.
        number: usize,
        /// Of how many.
        of: usize,
    },
}

impl Shots {
    /// Their numbers in a sweep of `shots`.
    ///
    /// # Errors
    /// [`Error::Setting`] for none, and for such that the sweep has not.
    pub fn range(&self, shots: usize) -> Result<Range<usize>> {
        let refuse = |setting, expected: String, found: String| Err(Error::Setting { setting, expected, found });
        match *self {
            Self::Range(Range { start, end }) if start >= end || end > shots => refuse(
                "shots",
                format!("A..B with A before B, B up to {shots}, the number of lattice shots"),
                format!("{start}..{end}"),
            ),
            Self::Range(ref range) => Ok(range.clone()),
            Self::Part { number, of } if number == 0 || number > of || of > shots => refuse(
                "part",
                format!("K/N with K from 1 to N, N up to {shots}, the number of lattice shots"),
                format!("{number}/{of}"),
            ),
            Self::Part { number, of } => Ok((number - 1) * shots / of..number * shots / of),
        }
    }
}

/// What [`extract`] has done.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExtractReport {
    /// The lattice shots of the part, by their numbers in the sweep: the first, and the one after the last.
    pub shots: [usize; 2],
    /// Lattice shots of the sweep.
    pub of: usize,
    /// Their photographs.
    pub photographs: usize,
    /// Their lit points.
    pub rows: usize,
    /// Whether the part was there, whole and of the same photographs: nothing was measured.
    pub was_there: bool,
    /// Seconds until what all shots have in common was known.
    pub once_secs: f64,
    /// Seconds of the shots.
    pub shots_secs: f64,
}

/// The first line of a part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Head {
    program: String,
    capture: String,
    key: String,
    shots: Range<usize>,
}

/// Each line after it: a shot, and the place of its first row.
#[derive(Debug, Serialize, Deserialize)]
struct Line {
    place: usize,
    measured: MeasuredShot,
}

/// Measures some lattice shots of a capture and writes them to the part `out`.
///
/// `from` is the capture's folder, of which is found first what all shots have in common, as in
/// [`super::build_matrix`], or a file that [`super::prepare_shots`] has written of that. An earlier part at `out` stays
/// where it is whole and of the same photographs, and is replaced otherwise. Nothing appears at `out` before all is
/// measured.
///
/// # Errors
/// Those of [`super::build_matrix`], but for contradictions that only the whole sweep can show: [`assemble`] looks for
/// those. [`Error::Setting`] for `shots`, [`Error::NotOurs`] when something else is at `out`; [`Error::Field`] when
/// `from` is a file that is damaged or out of date.
pub fn extract(
    from: &Path,
    options: &BuildOptions,
    shots: &Shots,
    out: &Path,
    progress: &Progress,
) -> Result<ExtractReport> {
    check_part(out)?;
    let start = Instant::now();
    let part = |range: Range<usize>, prepared: &Prepared<'_>| {
        let once_secs = start.elapsed().as_secs_f64();
        let report = extract_part(prepared, range, out, progress)?;
        Ok(ExtractReport { once_secs, shots_secs: start.elapsed().as_secs_f64() - once_secs, ..report })
    };
    if from.is_file() {
        let saved = SavedCapture::open(from, options, progress)?;
        let range = shots.range(lattice_shots(&saved.capture.manifest))?;
        return saved.with_prepared(options, |_, prepared| part(range, prepared));
    }
    let capture = open(from, options, progress)?;
    let range = shots.range(lattice_shots(&capture.manifest))?;
    let part = |_: &Before<'_>, prepared: &Prepared<'_>| part(range, prepared);
    with_prepared(&capture, options, Judged::Part, part, progress).map(|(report, _)| report)
}

/// Lattice shots of a sweep.
pub fn lattice_shots(manifest: &Manifest) -> usize {
    manifest.shots.iter().filter(|shot| matches!(shot.pattern, Pattern::Lattice { .. })).count()
}

fn extract_part(
    prepared: &Prepared<'_>,
    range: Range<usize>,
    out: &Path,
    progress: &Progress,
) -> Result<ExtractReport> {
    let scene = prepared.scene;
    let manifest = &scene.capture.manifest;
    let sweep = scene.lattice();
    let shots = &sweep[range.clone()];
    let photographs = lattice::photographs(scene, shots);
    let head = Head {
        program: PROGRAM.into(),
        capture: manifest.name.clone(),
        key: key(scene, &prepared.light)?,
        shots: range.clone(),
    };
    let rows: Vec<usize> = shots.iter().flat_map(|&s| scene.dots(s)).map(|&d| manifest.grid.row_index(d)).collect();
    let row_len = unmeasured(manifest).row_len();
    let report = ExtractReport {
        shots: [range.start, range.end],
        of: sweep.len(),
        photographs,
        rows: rows.len(),
        was_there: is_there(scene, shots, &head, out, row_len)?,
        once_secs: 0.0,
        shots_secs: 0.0,
    };
    if report.was_there {
        return Ok(report);
    }
    let stage = progress.stage("extract", photographs);
    let part = PartWriter::create(out, rows, row_len)?;
    let places = shots.iter().scan(0, |next, &shot| {
        let place = *next;
        *next += scene.dots(shot).len();
        Some((shot, place))
    });
    let measure = |(shot, place): (usize, usize)| -> Result<Line> {
        stage.begin();
        let files = scene.photographs.file_states(shot)?;
        let (result, hash) = lattice::measure(prepared, shot, |index, row| part.put(index, row))?;
        stage.advance(scene.photographs.brackets[shot].len());
        let measured = MeasuredShot::new(scene.photographs.said(shot)?, shot, hash, result);
        Ok(Line { place, measured: MeasuredShot { files, ..measured } })
    };
    let places: Vec<_> = places.collect();
    let lines: Vec<Line> = places.into_par_iter().with_max_len(1).map(measure).collect::<Result<_>>()?;
    part.finish(&head, &lines)?;
    Ok(report)
}

/// Whether a whole part of these shots is at `out`, of the photographs as they are.
fn is_there(scene: &Scene<'_>, shots: &[usize], head: &Head, out: &Path, row_len: usize) -> Result<bool> {
    let Ok((part, there, lines)) = read(out) else { return Ok(false) };
    if there != *head || !lines.iter().map(|l| l.measured.shot).eq(shots.iter().copied()) {
        return Ok(false);
    }
    for line in lines {
        let rows = part.rows_at(line.place, row_len);
        let whole = blake3::Hash::from_hex(&line.measured.rows)
            .is_ok_and(|hash| rows.hash(line.measured.result.lit.len()).is_ok_and(|found| found == hash));
        if !whole || scene.photographs.file_states(line.measured.shot)? != line.measured.files {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Opens a part: its rows, its head, its undamaged shots. The error says why the file is not a part.
fn read(path: &Path) -> Result<(Part, Head, Vec<Line>), String> {
    let (part, lines) = Part::open(path)?;
    let damaged = || "it is damaged".to_owned();
    let (first, rest) = lines.split_first().ok_or_else(damaged)?;
    let head = serde_json::from_slice(first).map_err(|_| damaged())?;
    Ok((part, head, rest.iter().filter_map(|line| serde_json::from_slice(line).ok()).collect()))
}

/// Puts parts together to the matrix of the capture in `dir`, and writes it to `out`: that of [`super::build_matrix`]
/// with the same options, bit by bit.
///
/// `parts` are files, or folders of `*.part`. Shots that no part has are measured if `measure_missing`. Photographs of
/// the others are not read again where their files have the length and the time of the last change that they had for
/// the part; else their BLAKE3 tells whether they are the same. Parts that are of no use are named in
/// [`BuildReport::unused_parts`]. Rows of parts are read where they are, so parts must stay until this is done.
///
/// # Errors
/// [`Error::MissingShots`] unless `measure_missing`; those of [`super::build_matrix`].
pub fn assemble(
    dir: &Path,
    options: &BuildOptions,
    parts: &[PathBuf],
    measure_missing: bool,
    out: &Path,
    progress: &Progress,
) -> Result<BuildReport> {
    let (files, unfinished) = find_parts(parts)?;
    let capture = open(dir, options, progress)?;
    let writer = MatrixWriter::go_on(out, unmeasured(&capture.manifest))?;
    let mut unused = Vec::new();
    if unfinished > 0 {
        unused.push(format!("{unfinished} unfinished (of tasks that still run, or were killed)"));
    }
    let rows = Assembled {
        writer,
        parts: parts.to_vec(),
        files,
        capture: capture.manifest.name.clone(),
        grid: capture.manifest.grid.clone(),
        measure_missing,
        found: Mutex::default(),
        unused: Mutex::new(unused),
    };
    let measured = measure(&capture, options, &rows, progress);
    let unused = rows.unused()?;
    let mut report = write(&capture, rows.writer, measured, progress)?;
    report.unused_parts = unused;
    Ok(report)
}

/// A matrix whose rows are in parts, as far as these have them.
struct Assembled {
    writer: MatrixWriter,
    /// As they were named.
    parts: Vec<PathBuf>,
    files: Vec<PathBuf>,
    capture: String,
    grid: Grid,
    measure_missing: bool,
    /// Rows of shots in parts, by the first of them.
    found: Mutex<BTreeMap<usize, Vec<(PathBuf, RowsAt)>>>,
    /// What of the parts was of no use, and why.
    unused: Mutex<Vec<String>>,
}

impl Assembled {
    fn unused(&self) -> Result<Vec<String>> {
        let mut unused = self.unused.lock().map_err(Error::internal)?.clone();
        unused.dedup();
        Ok(unused)
    }

    fn leave_out(&self, path: &Path, why: &str) -> Result<()> {
        self.unused.lock().map_err(Error::internal)?.push(format!("{} ({why})", path.display()));
        Ok(())
    }

    /// The shots of a part, if it is of this capture.
    fn take(&self, path: &Path, key: &str) -> Result<Vec<MeasuredShot>> {
        let (part, head, lines) = match read(path) {
            Ok(part) => part,
            Err(why) => return self.leave_out(path, &why).map(|()| vec![]),
        };
        if head.key != key {
            let why = match (head.program == PROGRAM, head.capture == self.capture) {
                (false, _) => format!("it was written by {}, not by {PROGRAM}", head.program),
                (_, false) => format!("it is of the capture \"{}\"", head.capture),
                _ => "its photographs, rig or options are others".into(),
            };
            return self.leave_out(path, &why).map(|()| vec![]);
        }
        if lines.len() < head.shots.len() {
            self.leave_out(path, &format!("{} of its shots are damaged", head.shots.len() - lines.len()))?;
        }
        let row_len = self.writer.header().row_len();
        let mut found = self.found.lock().map_err(Error::internal)?;
        let keep = |line: Line| {
            if let Some(first) = line.measured.result.lit.first() {
                let rows = part.rows_at(line.place, row_len);
                found.entry(self.grid.row_index(first.dot)).or_default().push((path.to_path_buf(), rows));
            }
            line.measured
        };
        Ok(lines.into_iter().map(keep).collect())
    }
}

impl RowSink for Assembled {
    fn put(&self, index: usize, row: &Row) -> Result<()> {
        self.writer.put(index, row)
    }

    fn replace(&self, index: usize, row: &Row) -> Result<()> {
        self.writer.replace(index, row)
    }

    fn row(&self, index: usize) -> Result<Row> {
        self.writer.row(index)
    }

    fn earlier(&self, key: &str) -> Result<Option<(WorkLog, Earlier<MeasuredShot>)>> {
        let (log, earlier) = self.writer.earlier(key)?;
        let mut shots = if let Earlier::Finished(shots) = earlier { shots } else { vec![] };
        for path in &self.files {
            shots.extend(self.take(path, key)?);
        }
        Ok(Some((log, Earlier::Finished(shots))))
    }

    fn adopt(&self, indices: &[usize], hash: &blake3::Hash) -> bool {
        if self.writer.adopt(indices, hash) {
            return true;
        }
        let candidates = self.found.lock().ok().and_then(|found| found.get(indices.first()?).cloned());
        candidates.into_iter().flatten().any(|(path, rows)| {
            let same = self.writer.adopt_part(indices, hash, &rows);
            same || self.leave_out(&path, "rows of it are damaged").is_err()
        })
    }

    fn may_lack(&self, lacking: &[usize], of: usize) -> Result<()> {
        if lacking.is_empty() || self.measure_missing {
            return Ok(());
        }
        let path = self.parts.first().cloned().unwrap_or_default();
        Err(Error::MissingShots { path, missing: ranges(lacking), of, unused: self.unused()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_a_sweep_are_all_of_it_once_and_of_nearly_one_size() {
        for (shots, of) in [(144, 7), (7, 7), (1, 1), (1000, 64)] {
            let parts: Vec<Range<usize>> =
                (1..=of).map(|number| Shots::Part { number, of }.range(shots).unwrap()).collect();
            assert!(parts.iter().flat_map(Clone::clone).eq(0..shots));
            let sizes = parts.iter().map(ExactSizeIterator::len);
            assert!(sizes.clone().max().unwrap() - sizes.min().unwrap() <= 1);
        }
    }

    #[test]
    fn ranges_that_a_sweep_has_not_are_refused_with_what_it_has() {
        let refused = |shots: Shots| shots.range(12).unwrap_err().to_string();
        for (start, end) in [(3, 3), (4, 2), (0, 13), (12, 13)] {
            let said = refused(Shots::Range(start..end));
            assert!(said.contains("up to 12") && said.contains(&format!("{start}..{end}")), "{said}");
        }
        for (number, of) in [(0, 3), (4, 3), (1, 13), (0, 0)] {
            let said = refused(Shots::Part { number, of });
            assert!(said.contains("up to 12") && said.contains(&format!("{number}/{of}")), "{said}");
        }
        assert_eq!(Shots::Range(11..12).range(12).unwrap(), 11..12);
    }
}
