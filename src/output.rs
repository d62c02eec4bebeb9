//! Unfinished outputs: under a temporary name beside the final one, removed when the work fails or a signal ends the program.

use crate::{Error, Result};
use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// What is to be removed when a signal ends the program.
static UNFINISHED: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A folder under a temporary name; removed with all that is in it when dropped.
#[derive(Debug)]
pub(crate) struct ScratchFolder {
    folder: tempfile::TempDir,
    // Dropped after the folder: between the two a signal finds it gone, not forgotten.
    _unfinished: Unfinished,
}

impl ScratchFolder {
    /// Makes a folder in `parent` whose name begins with `prefix`; errors name `target`, the output that it is for.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn new(parent: &Path, prefix: &str, target: &Path) -> Result<Self> {
        let folder = tempfile::Builder::new().prefix(prefix).tempdir_in(parent).map_err(Error::io("create", target))?;
        let _unfinished = Unfinished::new(folder.path());
        Ok(Self { folder, _unfinished })
    }

    /// Where it is.
    pub(crate) fn path(&self) -> &Path {
        self.folder.path()
    }
}

/// A folder that appears under its name when it is whole.
#[derive(Debug)]
pub(crate) struct NewFolder {
    scratch: ScratchFolder,
    target: PathBuf,
}

impl NewFolder {
    /// Checks that `target` may be made, before any work: a new or empty folder or, with `force`, an earlier output that holds nothing else.
    ///
    /// # Errors
    /// [`Error::NotEmpty`], [`Error::NotOurs`], [`Error::Io`].
    pub(crate) fn create(target: &Path, force: bool) -> Result<Self> {
        let full = match std::fs::read_dir(target) {
            Ok(mut entries) => entries.next().is_some(),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && target.symlink_metadata().is_err() => false,
            Err(e) => return Err(Error::io("create", target)(e)),
        };
        if full && !force {
            return Err(Error::NotEmpty { path: target.to_path_buf() });
        }
        if full {
            only_an_output(target)?;
        }
        let target = std::path::absolute(target).map_err(Error::io("create", target))?;
        let parent = target.parent().unwrap_or(&target).to_path_buf();
        std::fs::create_dir_all(&parent).map_err(Error::io("create", &parent))?;
        let scratch = ScratchFolder::new(&parent, ".acquire-new-", &target)?;
        // One folder deeper, for the permissions of an ordinary folder.
        let new = Self { scratch, target };
        std::fs::create_dir(new.path()).map_err(Error::io("create", new.path()))?;
        Ok(new)
    }

    /// Where the files go for now.
    pub(crate) fn path(&self) -> PathBuf {
        self.scratch.path().join("new")
    }

    /// Lists the folder's files in [`RECORD`] and puts it into its place; an earlier one leaves with the scratch folder.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn finish(self) -> Result<()> {
        let files = files(&self.path())?;
        let record = serde_json::json!({"program": concat!("acquire ", env!("CARGO_PKG_VERSION")), "files": files});
        let path = self.path().join(RECORD);
        std::fs::write(&path, record.to_string()).map_err(Error::io("write", &path))?;
        if self.target.exists() {
            std::fs::rename(&self.target, self.scratch.path().join("old"))
                .map_err(Error::io("rename", &self.target))?;
        }
        std::fs::rename(self.path(), &self.target).map_err(Error::io("rename", &self.target))
    }
}

/// What a folder that this program has made holds: what of it may be replaced.
pub(crate) const RECORD: &str = ".acquire-output.json";

/// The files of a folder and of those in it, by their names from there, sorted.
fn files(folder: &Path) -> Result<BTreeSet<String>> {
    let mut found = BTreeSet::new();
    let mut folders = vec![(folder.to_path_buf(), String::new())];
    while let Some((path, name)) = folders.pop() {
        for entry in std::fs::read_dir(&path).map_err(Error::io("read", &path))? {
            let entry = entry.map_err(Error::io("read", &path))?;
            let name = format!("{name}{}", entry.file_name().to_string_lossy());
            // A link to a folder is a link.
            match entry.file_type().map_err(Error::io("read", entry.path()))?.is_dir() {
                true => folders.push((entry.path(), name + "/")),
                false => drop(found.insert(name)),
            }
        }
    }
    Ok(found)
}

/// Refuses a folder that this program has not made, or that holds a file which it has not.
fn only_an_output(folder: &Path) -> Result<()> {
    #[derive(serde::Deserialize)]
    struct Record {
        files: BTreeSet<String>,
    }
    let record = std::fs::read(folder.join(RECORD)).ok();
    let record = record.and_then(|text| serde_json::from_slice::<Record>(&text).ok());
    let Some(Record { files: ours }) = record else { return Err(Error::NotOurs { path: folder.to_path_buf() }) };
    match files(folder)?.into_iter().find(|name| name != RECORD && !ours.contains(name)) {
        Some(other) => Err(Error::NotOurs { path: folder.join(other) }),
        None => Ok(()),
    }
}

/// Writes `bytes` under a temporary name in the folder of `path` and renames the file when it is complete.
///
/// # Errors
/// [`Error::Io`].
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // Made by `File::create_new` for its permissions: temporary files are otherwise for their owner only.
    let mut file = tempfile::Builder::new()
        .prefix(".acquire-")
        .make_in(folder, |name| std::fs::File::create_new(name))
        .map_err(Error::io("create", path))?;
    let _unfinished = Unfinished::new(file.path());
    file.write_all(bytes).map_err(Error::io("write", path))?;
    file.persist(path).map_err(|e| Error::io("rename", path)(e.error))?;
    Ok(())
}

/// A path that a signal removes, until this is dropped.
#[derive(Debug)]
pub(crate) struct Unfinished(PathBuf);

impl Unfinished {
    /// For a file or folder that exists and has a temporary name.
    pub(crate) fn new(path: &Path) -> Self {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
        list().insert(path.clone());
        Self(path)
    }
}

impl Drop for Unfinished {
    fn drop(&mut self) {
        list().remove(&self.0);
    }
}

fn list() -> std::sync::MutexGuard<'static, BTreeSet<PathBuf>> {
    UNFINISHED.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// From now on Ctrl-C removes what is unfinished before it ends the program.
///
/// # Errors
/// [`Error::Internal`] when the system refuses the handler.
#[cfg(not(unix))]
pub(crate) fn remove_on_signals() -> Result<()> {
    let end = || {
        list().iter().for_each(|path| remove(path));
        std::process::exit(130);
    };
    ctrlc::set_handler(end).map_err(Error::internal)
}

/// From now on Ctrl-C and SIGTERM remove what is unfinished before they end the program, as they would have without this.
///
/// # Errors
/// [`Error::Internal`] when the system refuses the handlers.
#[cfg(unix)]
pub(crate) fn remove_on_signals() -> Result<()> {
    use signal_hook::consts::{SIGINT, SIGTERM};
    let mut signals = signal_hook::iterator::Signals::new([SIGINT, SIGTERM]).map_err(Error::internal)?;
    std::thread::spawn(move || {
        for signal in signals.forever() {
            // Held until the end: the threads at work meet missing files, and wait here instead of reporting them.
            let unfinished = list();
            for path in unfinished.iter() {
                remove(path);
            }
            let _ = signal_hook::low_level::emulate_default_handler(signal);
        }
    });
    Ok(())
}

fn remove(path: &Path) {
    if !path.is_dir() {
        let _ = std::fs::remove_file(path);
        return;
    }
    // Other threads may still add files while the folder is emptied.
    for _ in 0..20 {
        if std::fs::remove_dir_all(path).is_ok() {
            return;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_is_listed_while_it_is_there() {
        let parent = tempfile::tempdir().unwrap();
        let scratch = ScratchFolder::new(parent.path(), ".x-", &parent.path().join("x")).unwrap();
        let path = scratch.path().to_path_buf();
        assert!(path.is_dir() && list().contains(&path));
        drop(scratch);
        assert!(!path.exists() && !list().contains(&path));
    }

    #[test]
    fn an_earlier_output_is_replaced_when_asked_and_only_when_nothing_else_is_in_it() {
        let parent = tempfile::tempdir().unwrap();
        let out = parent.path().join("a/out");
        let make = |force: bool, text: &str| {
            let new = NewFolder::create(&out, force)?;
            std::fs::create_dir(new.path().join("deep")).unwrap();
            std::fs::write(new.path().join("deep/one.txt"), text).unwrap();
            new.finish()
        };
        let text = || std::fs::read_to_string(out.join("deep/one.txt")).unwrap();
        drop(NewFolder::create(&out, false).unwrap());
        assert_eq!(std::fs::read_dir(parent.path().join("a")).unwrap().count(), 0, "a stopped run leaves nothing");
        make(false, "1").unwrap();
        assert!(matches!(make(false, "2"), Err(Error::NotEmpty { path }) if path == out));
        make(true, "3").unwrap();
        assert_eq!(text(), "3");
        // A file beside them, at any depth; then the same folder without the record.
        for other in ["deep/notes.txt", "IMG_0001.ARW"] {
            std::fs::write(out.join(other), "keep").unwrap();
            assert!(matches!(make(true, "4"), Err(Error::NotOurs { path }) if path == out.join(other)));
            std::fs::remove_file(out.join(other)).unwrap();
        }
        std::fs::remove_file(out.join(RECORD)).unwrap();
        assert!(matches!(make(true, "5"), Err(Error::NotOurs { path }) if path == out));
        assert_eq!(text(), "3");
        assert_eq!(std::fs::read_dir(parent.path().join("a")).unwrap().count(), 1);
        std::fs::write(parent.path().join("file"), "keep").unwrap();
        assert!(matches!(NewFolder::create(&parent.path().join("file"), true), Err(Error::Io { .. })));
    }
}
