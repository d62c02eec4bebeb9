//! Folders that appear when they are whole, with a record of what is in them.

use super::{Earlier, ScratchFolder, WorkLog, put};
use crate::{Error, Result, files::check_local};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What a folder that this program has made holds: what of it may be replaced.
const RECORD: &str = ".acquire-output.json";
pub(crate) const PROGRAM: &str = concat!("acquire ", env!("CARGO_PKG_VERSION"));
/// Files up to this length are recorded with their checksum: those that people edit. Of photographs and chunks of
/// matrices the length will do.
const HASHED_BYTES: u64 = 1 << 20;

#[derive(Serialize, Deserialize)]
struct Record {
    program: String,
    files: BTreeMap<String, FileRecord>,
}

#[derive(Serialize, Deserialize, PartialEq)]
struct FileRecord {
    bytes: u64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blake3: Option<String>,
}

/// A folder that appears under its name when it is whole.
#[derive(Debug)]
pub(crate) struct NewFolder {
    scratch: ScratchFolder,
    target: PathBuf,
    replaces: bool,
}

impl NewFolder {
    /// Checks that `target` may be made, before any work: a new or empty folder or, with `force`, an earlier output
    /// that holds nothing else.
    ///
    /// # Errors
    /// [`Error::NotLocal`], [`Error::NotEmpty`], [`Error::NotOurs`], [`Error::Changed`], [`Error::Io`].
    pub(crate) fn create(target: &Path, force: bool) -> Result<Self> {
        Self::new(target, force, ScratchFolder::new)
    }

    /// [`Self::create`], with all that a stopped run for the same `target` had made, if that was with the same `key`;
    /// what it made with another one is removed.
    ///
    /// # Errors
    /// Those of [`Self::create`].
    pub(crate) fn go_on<T: DeserializeOwned>(
        target: &Path,
        force: bool,
        key: &str,
    ) -> Result<(Self, WorkLog, Earlier<T>)> {
        let new = Self::new(target, force, ScratchFolder::go_on)?;
        let (log, earlier) = WorkLog::open(&new.scratch, key)?;
        if !matches!(earlier, Earlier::Finished(_)) {
            new.clear()?;
        }
        Ok((new, log, earlier))
    }

    /// Removes what was made so far.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn clear(&self) -> Result<()> {
        let path = self.path();
        let made_anew = std::fs::remove_dir_all(&path).and_then(|()| std::fs::create_dir(&path));
        made_anew.map_err(Error::io("create", &path))
    }

    /// From now on what was made stays for a next run, whatever becomes of this one.
    pub(crate) fn keep_work(&self) {
        self.scratch.keep();
    }

    /// What [`Self::create`] refuses is refused, and nothing is made.
    ///
    /// # Errors
    /// Those of [`Self::create`].
    pub(crate) fn check(target: &Path, force: bool) -> Result<()> {
        check(target, force).map(drop)
    }

    fn new(target: &Path, force: bool, scratch: impl FnOnce(&Path, &Path) -> Result<ScratchFolder>) -> Result<Self> {
        let replaces = check(target, force)?;
        // Where a link leads: it stays.
        let real = if replaces { target.canonicalize() } else { std::path::absolute(target) };
        let target = real.map_err(Error::io("create", target))?;
        let parent = target.parent().unwrap_or(&target).to_path_buf();
        std::fs::create_dir_all(&parent).map_err(Error::io("create", &parent))?;
        let scratch = scratch(&parent, &target)?;
        // One folder deeper, for the permissions of an ordinary folder.
        let new = Self { scratch, target, replaces };
        std::fs::create_dir_all(new.path()).map_err(Error::io("create", new.path()))?;
        Ok(new)
    }

    /// Where the files go for now.
    pub(crate) fn path(&self) -> PathBuf {
        self.scratch.new_path()
    }

    /// The folder around it, for what is needed until it is finished.
    pub(crate) fn scratch(&self) -> &Path {
        self.scratch.path()
    }

    /// Whether there is an earlier output that this will replace.
    pub(crate) fn replaces(&self) -> bool {
        self.replaces
    }

    /// Lists the folder's files in [`RECORD`] and puts it into its place; an earlier one leaves with the scratch
    /// folder.
    ///
    /// # Errors
    /// [`Error::Io`]; those of [`Self::create`] when somebody has put something there meanwhile.
    pub(crate) fn finish(self) -> Result<()> {
        let files = files(&self.path(), &|_| true)?;
        let path = self.path().join(RECORD);
        let text = serde_json::to_string(&Record { program: PROGRAM.into(), files }).map_err(Error::internal)?;
        std::fs::write(&path, text).map_err(Error::io("write", &path))?;
        check(&self.target, self.replaces)?;
        put(&self.scratch, &self.target, self.replaces).map_err(Error::io("write", &self.target))?;
        self.scratch.let_go();
        Ok(())
    }
}

/// Whether there is something at `target` that would be replaced.
fn check(target: &Path, force: bool) -> Result<bool> {
    check_local(target)?;
    let full = match std::fs::read_dir(target) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound && target.symlink_metadata().is_err() => false,
        Err(e) => return Err(Error::io("create", target)(e)),
    };
    match (full, force) {
        (true, false) => Err(Error::NotEmpty { path: target.to_path_buf() }),
        (true, true) => only_an_output(target).map(|()| true),
        (false, _) => Ok(false),
    }
}

/// The files of a folder and of those in it, by their names from there; checksums of those that are `hashed` and small.
fn files(folder: &Path, hashed: &dyn Fn(&str) -> bool) -> Result<BTreeMap<String, FileRecord>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![(folder.to_path_buf(), String::new())];
    while let Some((path, name)) = folders.pop() {
        for entry in std::fs::read_dir(&path).map_err(Error::io("read", &path))? {
            let entry = entry.map_err(Error::io("read", &path))?;
            let name = format!("{name}{}", entry.file_name().to_string_lossy());
            let path = entry.path();
            // A link to a folder is a link.
            let kind = entry.metadata().map_err(Error::io("read", &path))?;
            if kind.is_dir() {
                folders.push((path, name + "/"));
                continue;
            }
            let small = kind.is_file() && kind.len() <= HASHED_BYTES && hashed(&name);
            let blake3 = match small {
                true => Some(blake3::hash(&std::fs::read(&path).map_err(Error::io("read", &path))?).to_string()),
                false => None,
            };
            // No file of ours is a link or a device.
            found.insert(name, FileRecord { bytes: if kind.is_file() { kind.len() } else { u64::MAX }, blake3 });
        }
    }
    Ok(found)
}

/// Refuses a folder that this program has not made, or that holds a file which it has not, or which was changed.
fn only_an_output(folder: &Path) -> Result<()> {
    let text = std::fs::read(folder.join(RECORD)).ok();
    let record = text.and_then(|text| serde_json::from_slice::<Record>(&text).ok());
    let record = record.filter(|record| record.program.starts_with("acquire "));
    let Some(Record { files: ours, .. }) = record else { return Err(Error::NotOurs { path: folder.to_path_buf() }) };
    let hashed = |name: &str| ours.get(name).is_some_and(|ours| ours.blake3.is_some());
    for (name, found) in files(folder, &hashed)? {
        let path = folder.join(&name);
        match ours.get(&name) {
            _ if name == RECORD => {}
            None => return Err(Error::NotOurs { path }),
            Some(ours) if *ours != found => return Err(Error::Changed { path }),
            Some(_) => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_earlier_output_is_replaced_when_asked_and_only_when_nothing_else_is_in_it() {
        let parent = tempfile::tempdir().unwrap();
        let out = parent.path().join("a/out");
        let make = |force: bool, text: &str| {
            let new = NewFolder::create(&out, force)?;
            std::fs::create_dir(new.path().join("deep")).unwrap();
            std::fs::write(new.path().join("deep/one.txt"), text).unwrap();
            std::fs::write(new.path().join("long.bin"), vec![0; (HASHED_BYTES + 1) as usize]).unwrap();
            new.finish()
        };
        let text = || std::fs::read_to_string(out.join("deep/one.txt")).unwrap();
        drop(NewFolder::create(&out, false).unwrap());
        assert_eq!(std::fs::read_dir(parent.path().join("a")).unwrap().count(), 0, "a stopped run leaves nothing");
        make(false, "1").unwrap();
        assert!(matches!(make(false, "2"), Err(Error::NotEmpty { path }) if path == out));
        make(true, "3").unwrap();
        assert_eq!(text(), "3");
        // A file beside them, at any depth; one that was changed; then the same folder without the record.
        for other in ["deep/notes.txt", "IMG_0001.ARW"] {
            std::fs::write(out.join(other), "keep").unwrap();
            assert!(matches!(make(true, "4"), Err(Error::NotOurs { path }) if path == out.join(other)));
            std::fs::remove_file(out.join(other)).unwrap();
        }
        for (ours, changed) in [("deep/one.txt", b"9".as_slice()), ("long.bin", b"9")] {
            let before = std::fs::read(out.join(ours)).unwrap();
            std::fs::write(out.join(ours), changed).unwrap();
            assert!(matches!(make(true, "4"), Err(Error::Changed { path }) if path == out.join(ours)));
            std::fs::write(out.join(ours), before).unwrap();
        }
        std::fs::remove_file(out.join(RECORD)).unwrap();
        assert!(matches!(make(true, "5"), Err(Error::NotOurs { path }) if path == out));
        assert_eq!(text(), "3");
        assert_eq!(std::fs::read_dir(parent.path().join("a")).unwrap().count(), 1);
        std::fs::write(parent.path().join("file"), "keep").unwrap();
        assert!(matches!(NewFolder::create(&parent.path().join("file"), true), Err(Error::Io { .. })));
    }

    #[test]
    fn what_somebody_puts_there_during_the_work_stays() {
        let parent = tempfile::tempdir().unwrap();
        let out = parent.path().join("out");
        let new = NewFolder::create(&out, true).unwrap();
        std::fs::create_dir(&out).unwrap();
        std::fs::write(out.join("notes.txt"), "keep").unwrap();
        assert!(matches!(new.finish(), Err(Error::NotEmpty { .. })));
        assert_eq!(std::fs::read_to_string(out.join("notes.txt")).unwrap(), "keep");
    }
}
