//! What runs have left that were killed, lost their power or their disk.

use super::scratch::{LOCK, OLD, PREFIX};
use super::signals::remove;
use super::work_log;
use crate::{Error, Result};
use std::ffi::OsStr;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// What was removed on the way of this process, and not told yet.
static REMOVED: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Folders with work for a next run that this process has left, and not told yet.
static KEPT: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Removes what stopped runs have left in `folder`; of `deep`, in the folders in it, too, and with the work that they
/// had finished. Returns what was removed.
///
/// A scratch folder is a stopped run's when its lock is ours and nobody holds it; any other file or folder stays,
/// whatever its name.
///
/// # Errors
/// [`Error::Io`] when the folder cannot be read.
pub(crate) fn remove_leftovers(folder: &Path, deep: bool) -> Result<Vec<PathBuf>> {
    let mut removed = Vec::new();
    let mut entries: Vec<_> = std::fs::read_dir(folder).map_err(Error::io("read", folder))?.flatten().collect();
    entries.sort_by_key(std::fs::DirEntry::file_name);
    for entry in entries {
        let path = entry.path();
        if !entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            continue;
        }
        if is_scratch_name(&entry.file_name()) {
            // Hours of work may be in it: only who asks for it removes that.
            if (deep || !work_log::has_work(&path)) && remove_if_dead(&path) {
                removed.push(path);
            }
        } else if deep {
            // A folder that cannot be read has nothing that could be removed.
            removed.extend(remove_leftovers(&path, true).unwrap_or_default());
        }
    }
    Ok(removed)
}

/// [`remove_leftovers`] of one folder, to be told later.
pub(super) fn remove_and_remember(folder: &Path) {
    let found = remove_leftovers(folder, false).unwrap_or_default();
    REMOVED.lock().unwrap_or_else(std::sync::PoisonError::into_inner).extend(found);
}

/// What was removed since this was asked last.
pub(crate) fn take_removed() -> Vec<PathBuf> {
    std::mem::take(&mut REMOVED.lock().unwrap_or_else(std::sync::PoisonError::into_inner))
}

/// A folder stays for a next run.
pub(super) fn remember_kept(folder: &Path) {
    KEPT.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(folder.to_path_buf());
}

/// What stays for a next run, since this was asked last.
pub(crate) fn take_kept() -> Vec<PathBuf> {
    let mut kept = std::mem::take(&mut *KEPT.lock().unwrap_or_else(std::sync::PoisonError::into_inner));
    // Parts of an output are in its own folder, and may be gone with it.
    let all = kept.clone();
    kept.retain(|path| path.is_dir() && !path.ancestors().skip(1).any(|outer| all.iter().any(|p| p == outer)));
    kept
}

pub(super) fn is_scratch_name(name: &OsStr) -> bool {
    name.to_string_lossy()
        .strip_prefix(PREFIX)
        .is_some_and(|end| end.len() == 6 && end.bytes().all(|b| b.is_ascii_alphanumeric()))
}

/// The scratch folder of a stopped run for `target` that had finished some work, and its lock, which is ours now.
pub(super) fn with_work(parent: &Path, target: &Path) -> Option<(PathBuf, File)> {
    let mut folders: Vec<PathBuf> = std::fs::read_dir(parent).ok()?.flatten().map(|entry| entry.path()).collect();
    folders.retain(|f| f.file_name().is_some_and(is_scratch_name));
    folders.sort();
    folders.into_iter().find_map(|folder| {
        let Some((file, Some(lock))) = dead(&folder) else { return None };
        let same = lock.name.is_some() && lock.name.as_deref() == target.file_name().and_then(|n| n.to_str());
        if !same || !work_log::has_work(&folder) {
            return None;
        }
        put_back(&folder, lock.name);
        Some((folder, file))
    })
}

/// What a lock says.
#[derive(serde::Deserialize)]
struct Lock {
    program: String,
    #[serde(rename = "for")]
    name: Option<String>,
}

/// The lock of a run that is no more, which is held from now on, and what it says where that is ours.
fn dead(folder: &Path) -> Option<(File, Option<Lock>)> {
    let path = folder.join(LOCK);
    let file = File::open(&path).ok()?;
    if !path.symlink_metadata().is_ok_and(|kind| kind.is_file() && kind.len() < 1 << 16) || file.try_lock().is_err() {
        return None;
    }
    let text = std::fs::read_to_string(&path).unwrap_or_default();
    match serde_json::from_str::<Lock>(&text).ok().filter(|lock| lock.program.starts_with("acquire ")) {
        Some(lock) => Some((file, Some(lock))),
        // Killed before a word was written, or not ours.
        None if !text.is_empty() || std::fs::read_dir(folder).is_ok_and(|all| all.count() > 1) => None,
        None => Some((file, None)),
    }
}

/// Removes the scratch folder of a run that is no more; says whether it was one.
fn remove_if_dead(folder: &Path) -> bool {
    if folder.join(LOCK).symlink_metadata().is_err() {
        // Killed between the two: an empty folder holds nothing of anybody's.
        return std::fs::remove_dir(folder).is_ok();
    }
    let Some((_held, lock)) = dead(folder) else { return false };
    if let Some(Lock { name, .. }) = lock {
        put_back(folder, name);
    }
    remove(folder);
    !folder.exists()
}

/// Where a run was stopped between moving the old output away and putting the new one there, the old one goes back.
fn put_back(folder: &Path, name: Option<String>) {
    let (old, parent) = (folder.join(OLD), folder.parent());
    let name = name.filter(|name| Path::new(name).file_name().is_some_and(|n| n == name.as_str()));
    if let (Some(parent), Some(name)) = (parent, name)
        && old.symlink_metadata().is_ok()
        && parent.join(&name).symlink_metadata().is_err()
    {
        let _ = std::fs::rename(&old, parent.join(name));
    }
}

#[cfg(test)]
mod tests {
    use super::super::ScratchFolder;
    use super::*;

    /// What a run leaves that is killed: everything, and nobody holds the lock.
    fn left(parent: &Path, target: &str, end: &str) -> PathBuf {
        let folder = parent.join(format!("{PREFIX}{end}"));
        std::fs::create_dir_all(folder.join("new/deep")).unwrap();
        std::fs::write(folder.join("new/deep/half.png"), "half").unwrap();
        let text = serde_json::json!({"program": super::super::folder::PROGRAM, "for": target});
        std::fs::write(folder.join(LOCK), text.to_string()).unwrap();
        folder
    }

    #[test]
    fn a_stopped_run_s_folder_is_removed_and_a_living_run_s_and_other_people_s_stay() {
        let parent = tempfile::tempdir().unwrap();
        let dead = left(parent.path(), "out", "AbCd12");
        let alive = ScratchFolder::new(parent.path(), &parent.path().join("out")).unwrap();
        assert!(take_removed().contains(&dead), "by the next run that writes there");
        let dead = [left(parent.path(), "out", "AbCd12"), parent.path().join(".acquire-new-empty0")];
        std::fs::create_dir(&dead[1]).unwrap();
        let deep = left(&parent.path().join("a/b"), "out", "AbCd12");
        for (name, file, text) in [
            (".acquire-new-notes", "lock", "{\"program\": \"acquire 0.1.0\"}"),
            (".acquire-new-mine12", "notes.txt", "keep"),
            (".acquire-new-mine34", "lock", "keep"),
            (".acquire-new-mine56", "lock", "{\"program\": \"other 1\"}"),
            ("acquire-new-AbCd12", "lock", "{\"program\": \"acquire 0.1.0\"}"),
        ] {
            std::fs::create_dir(parent.path().join(name)).unwrap();
            std::fs::write(parent.path().join(name).join(file), text).unwrap();
        }
        std::fs::write(parent.path().join(".acquire-new-file12"), "keep").unwrap();
        assert_eq!(remove_leftovers(parent.path(), false).unwrap(), dead);
        assert!(alive.path().is_dir() && deep.is_dir());
        assert_eq!(remove_leftovers(parent.path(), true).unwrap(), [deep]);
        assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 8, "six that are others', the living one, a");
    }

    #[test]
    fn an_old_output_that_was_moved_away_goes_back_where_the_new_one_is_not_there_yet() {
        let parent = tempfile::tempdir().unwrap();
        let folder = left(parent.path(), "out", "AbCd12");
        std::fs::create_dir(folder.join(OLD)).unwrap();
        std::fs::write(folder.join(OLD).join("a"), "old").unwrap();
        remove_leftovers(parent.path(), false).unwrap();
        assert_eq!(std::fs::read_to_string(parent.path().join("out/a")).unwrap(), "old");
        assert_eq!(std::fs::read_dir(parent.path()).unwrap().count(), 1);
    }
}
