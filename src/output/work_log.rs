//! What a run has finished, kept in its scratch folder, so that the next run for the same output goes on from there.

use super::ScratchFolder;
use super::leftovers::is_scratch_name;
use crate::{Error, Result};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// The file of finished work in a scratch folder: a line each, a checksum before it; the first is the key.
pub(super) const LOG: &str = "finished";

/// What a stopped run has left.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Earlier<T> {
    /// There was none, or it had finished nothing.
    Nothing,
    /// It worked on other inputs, with other options, or was another version: nothing of it is used.
    Other,
    /// What it had finished.
    Finished(Vec<T>),
}

/// Finished work, a line each.
#[derive(Debug)]
pub(crate) struct WorkLog {
    path: PathBuf,
    file: Mutex<File>,
}

impl WorkLog {
    /// Reads what the stopped run had finished whose scratch folder this is, and goes on after it; begins anew when its
    /// key is another one.
    ///
    /// A line that was not written to its end, or that power loss has spoilt, is left out.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn open<T: DeserializeOwned>(scratch: &ScratchFolder, key: &str) -> Result<(Self, Earlier<T>)> {
        let path = scratch.path().join(LOG);
        let text = std::fs::read(&path).unwrap_or_default();
        let mut lines = checked_lines(&text);
        let (first, rest): (Option<&[u8]>, Vec<T>) =
            (lines.next(), lines.filter_map(|line| serde_json::from_slice(line).ok()).collect());
        let same = first == Some(key.as_bytes());
        let earlier = match (same, text.is_empty() || rest.is_empty()) {
            (true, false) => Earlier::Finished(rest),
            (false, false) => Earlier::Other,
            (_, true) => Earlier::Nothing,
        };
        let failed = |e| Error::io("write", &path)(e);
        // Of lines in the middle that are spoilt nothing is lost but themselves; after half a line a new one begins.
        let mut file = File::options().create(true).append(true).open(&path).map_err(failed)?;
        if !same {
            file.set_len(0).map_err(failed)?;
            write_line(&mut file, key.as_bytes()).map_err(failed)?;
        } else if text.last() != Some(&b'\n') {
            file.write_all(b"\n").map_err(failed)?;
        }
        Ok((Self { path: path.clone(), file: Mutex::new(file) }, earlier))
    }

    /// Adds what is finished; `work` must be in its place.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn add(&self, work: &impl Serialize) -> Result<()> {
        let text = serde_json::to_vec(work).map_err(Error::internal)?;
        let mut file = self.file.lock().map_err(Error::internal)?;
        write_line(&mut *file, &text).map_err(Error::io("write", &self.path))
    }
}

/// The key of work that depends on `inputs` alone, done by this version.
///
/// # Errors
/// [`Error::Internal`].
pub(crate) fn key_of(inputs: &impl Serialize) -> Result<String> {
    let text = serde_json::to_string(&(super::folder::PROGRAM, inputs)).map_err(Error::internal)?;
    Ok(blake3::hash(text.as_bytes()).to_hex().to_string())
}

/// Whether a scratch folder has work that a next run can go on from: lines of its own that say something, or those of a
/// part of its output.
pub(super) fn has_work(folder: &Path) -> bool {
    let text = std::fs::read(folder.join(LOG)).unwrap_or_default();
    let mut lines = checked_lines(&text);
    if lines.next().is_none() {
        return false;
    }
    let part = |entry: std::fs::DirEntry| is_scratch_name(&entry.file_name()) && has_work(&entry.path());
    lines.any(|line| line != b"null") || std::fs::read_dir(folder).is_ok_and(|all| all.flatten().any(part))
}

/// Writes a line that says whether it is whole.
pub(crate) fn write_line(file: &mut impl Write, text: &[u8]) -> std::io::Result<()> {
    let line = [blake3::hash(text).to_hex().as_bytes(), b" ", text, b"\n"].concat();
    file.write_all(&line)
}

/// The texts of those lines that are whole.
pub(crate) fn checked_lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    text.split(|b| *b == b'\n').filter_map(checked)
}

/// The text of a line that is whole.
fn checked(line: &[u8]) -> Option<&[u8]> {
    let (sum, text) = line.split_at_checked(2 * blake3::OUT_LEN)?;
    let text = text.strip_prefix(b" ")?;
    (blake3::hash(text).to_hex().as_bytes() == sum).then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finished_work_is_there_for_the_same_key_and_only_what_is_whole_of_it() {
        let parent = tempfile::tempdir().unwrap();
        let scratch = ScratchFolder::new(parent.path(), &parent.path().join("out")).unwrap();
        let open = |key: &str| WorkLog::open::<(usize, f64)>(&scratch, key).unwrap();
        let (log, earlier) = open("one");
        assert_eq!(earlier, Earlier::Nothing);
        assert!(!has_work(scratch.path()));
        let work = [(3, 0.1), (1, 1e-300), (2, 1.0 / 3.0)];
        work.iter().for_each(|w| log.add(w).unwrap());
        assert!(has_work(scratch.path()));
        let (_, earlier) = open("one");
        assert_eq!(earlier, Earlier::Finished(work.to_vec()));
        // Half a line, and a spoilt one.
        let path = scratch.path().join(LOG);
        let text = std::fs::read(&path).unwrap();
        std::fs::write(&path, &text[..text.len() - 4]).unwrap();
        let (log, earlier) = open("one");
        assert_eq!(earlier, Earlier::Finished(work[..2].to_vec()));
        log.add(&(9, 9.0)).unwrap();
        let (_, earlier) = open("one");
        assert_eq!(earlier, Earlier::Finished(vec![work[0], work[1], (9, 9.0)]));
        let mut text = std::fs::read(&path).unwrap();
        let second = text.iter().position(|b| *b == b'\n').unwrap() + 70;
        text[second] ^= 1;
        std::fs::write(&path, &text).unwrap();
        let (_, earlier) = open("one");
        assert_eq!(earlier, Earlier::Finished(vec![work[1], (9, 9.0)]));
        let (_, earlier) = open("two");
        assert_eq!(earlier, Earlier::Other);
        let (_, earlier) = open("two");
        assert_eq!(earlier, Earlier::Nothing);
    }
}
