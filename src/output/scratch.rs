//! Folders under temporary names, whose lock tells whether the run that made them still lives.

use super::leftovers;
use super::signals::{Unfinished, remove};
use super::work_log;
use crate::{Error, Result};
use std::fs::{File, TryLockError};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// What the names of all scratch folders begin with; six letters or digits follow.
pub(super) const PREFIX: &str = ".acquire-new-";
/// The file in a scratch folder that the run which made it holds locked, with the name of what it is for.
pub(super) const LOCK: &str = "lock";
/// What an output is called in its scratch folder until it is whole.
pub(super) const NEW: &str = "new";
/// And what it replaces, where the system cannot exchange the two.
pub(super) const OLD: &str = "old";

/// A folder under a temporary name; removed with all that is in it when dropped.
#[derive(Debug)]
pub(crate) struct ScratchFolder {
    path: PathBuf,
    /// Whether finished work outlives this.
    kept: AtomicBool,
    // Dropped after the folder is gone: between the two a signal finds it gone, not forgotten.
    _unfinished: Unfinished,
    _lock: File,
}

impl ScratchFolder {
    /// Makes a folder in `parent`, after removing those that stopped runs have left there without finished work; errors
    /// name `target`, the output that it is for.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn new(parent: &Path, target: &Path) -> Result<Self> {
        leftovers::remove_and_remember(parent);
        let failed = |e| Error::io("create", target)(e);
        loop {
            let make = || {
                let folder = tempfile::Builder::new().prefix(PREFIX).tempdir_in(parent)?;
                // A run that cleans up may find it before it is locked; then another is made.
                Ok(claim(folder.path(), target)?.map(|lock| (folder.keep(), lock)))
            };
            let made = Unfinished::made(make, |(path, _)| path).map_err(failed)?;
            let Some((_unfinished, (path, lock))) = made else { continue };
            return Ok(Self { path, kept: AtomicBool::new(false), _unfinished, _lock: lock });
        }
    }

    /// Takes over the folder of a stopped run for the same output that had finished some work, with all that is in it;
    /// makes one where there is none.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn go_on(parent: &Path, target: &Path) -> Result<Self> {
        match leftovers::with_work(parent, target) {
            // What was kept once is lost by no error.
            Some((path, _lock)) => {
                let _unfinished = Unfinished::new(&path);
                Ok(Self { path, kept: AtomicBool::new(true), _unfinished, _lock })
            }
            None => Self::new(parent, target),
        }
    }

    /// From now on the folder stays when it is dropped, if it has finished work for a next run.
    pub(crate) fn keep(&self) {
        self.kept.store(true, Ordering::Relaxed);
    }

    /// From now on it does not: the output is in its place.
    pub(crate) fn let_go(&self) {
        self.kept.store(false, Ordering::Relaxed);
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Where the output is made.
    pub(crate) fn new_path(&self) -> PathBuf {
        self.path.join(NEW)
    }
}

impl Drop for ScratchFolder {
    fn drop(&mut self) {
        match self.kept.load(Ordering::Relaxed) && work_log::has_work(&self.path) {
            true => leftovers::remember_kept(&self.path),
            false => remove(&self.path),
        }
    }
}

/// Makes the lock of a new folder; `None` when another process was quicker.
fn claim(folder: &Path, target: &Path) -> std::io::Result<Option<File>> {
    let path = folder.join(LOCK);
    let mut file = match File::create_new(&path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    if matches!(file.try_lock(), Err(TryLockError::WouldBlock)) || !path.exists() {
        return Ok(None);
    }
    // Where a file system knows no locks, what a stopped run leaves stays.
    let name = target.file_name().map(|n| n.to_string_lossy().into_owned());
    let text = serde_json::json!({"program": super::folder::PROGRAM, "for": name});
    writeln!(file, "{text}")?;
    Ok(Some(file))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_there_and_locked_until_it_is_dropped() {
        let parent = tempfile::tempdir().unwrap();
        let scratch = ScratchFolder::new(parent.path(), &parent.path().join("x")).unwrap();
        let path = scratch.path().to_path_buf();
        assert!(path.is_dir() && super::super::signals::is_listed(&path));
        assert!(File::open(path.join(LOCK)).unwrap().try_lock().is_err());
        std::fs::create_dir_all(scratch.new_path().join("deep")).unwrap();
        drop(scratch);
        assert!(!path.exists() && !super::super::signals::is_listed(&path));
    }
}
