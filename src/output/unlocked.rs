//! Files that many tasks write beside each other, on machines that share a file system.
//!
//! Locks, by which [`super::ScratchFolder`] knows what a stopped run has left, are often known on one machine only
//! there, or not at all. So nothing here needs one: a file is made under a name of its own and takes its place in one
//! step; what a killed task has left stays until somebody removes the folder.

use super::signals::Unfinished;
use crate::{Error, Result, files::check_local};
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

/// The name of a file that is not whole: its later name and six letters or digits between these.
const UNFINISHED: [&str; 2] = [".", ".unfinished"];

/// Whether a file's name is that of one that is not whole.
pub(crate) fn is_unfinished(name: &str) -> bool {
    name.starts_with(UNFINISHED[0]) && name.ends_with(UNFINISHED[1])
}

/// A file that is not whole yet; removed when dropped.
#[derive(Debug)]
pub(crate) struct Unlocked {
    path: PathBuf,
    file: tempfile::NamedTempFile,
    _unfinished: Unfinished,
}

impl Unlocked {
    /// Begins the file `path`; what is there stays until [`Self::finish`], and is replaced then.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn create(path: &Path) -> Result<Self> {
        let prefix = format!("{}{}.", UNFINISHED[0], path.file_name().unwrap_or_default().to_string_lossy());
        let mut named = tempfile::Builder::new();
        named.prefix(&prefix).suffix(UNFINISHED[1]);
        // As any file that is made here: temporary ones are their owner's alone.
        #[cfg(unix)]
        named.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
        let made = Unfinished::made(|| named.tempfile_in(folder_of(path)).map(Some), |file| file.path());
        let Some((_unfinished, file)) = made.map_err(Error::io("create", path))? else {
            return Err(Error::internal("no file was made"));
        };
        Ok(Self { path: path.to_path_buf(), file, _unfinished })
    }

    pub(crate) fn file(&self) -> &File {
        self.file.as_file()
    }

    /// Puts it into its place, when it is on the disk.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub(crate) fn finish(self) -> Result<()> {
        let Self { path, file, _unfinished } = self;
        let failed = |e| Error::io("write", &path)(e);
        file.as_file().sync_all().map_err(failed)?;
        file.persist(&path).map(drop).map_err(|e| failed(e.error))
    }
}

/// Writes a file of `bytes` so.
///
/// # Errors
/// [`Error::Io`].
pub(crate) fn write_in_place(path: &Path, bytes: &[u8]) -> Result<()> {
    let new = Unlocked::create(path)?;
    new.file().write_all(bytes).map_err(Error::io("write", path))?;
    new.finish()
}

fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Refuses a place where a file that begins with `head` cannot go: a folder that is not there, a file that begins with
/// something else.
///
/// # Errors
/// [`Error::NotLocal`], [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn check_by_head(path: &Path, head: &[u8]) -> Result<()> {
    check_local(path)?;
    std::fs::read_dir(folder_of(path)).map_err(Error::io("create", path))?;
    match path.symlink_metadata() {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(Error::io("create", path)(e)),
        Ok(kind) if kind.is_file() && begins_with(path, head) => Ok(()),
        Ok(_) => Err(Error::NotOurs { path: path.to_path_buf() }),
    }
}

/// Whether a file begins with these bytes.
pub(crate) fn begins_with(path: &Path, head: &[u8]) -> bool {
    let mut found = vec![0; head.len()];
    File::open(path).and_then(|mut file| file.read_exact(&mut found)).is_ok() && found == head
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_there_when_it_is_whole_and_takes_the_place_of_one_that_begins_alike_only() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.part");
        let names = || {
            let names = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name());
            names.map(|n| n.to_string_lossy().into_owned()).collect::<Vec<_>>()
        };
        let new = Unlocked::create(&path).unwrap();
        assert!(names().len() == 1 && is_unfinished(&names()[0]));
        drop(new);
        assert!(names().is_empty());
        // Two at once: the last one stays.
        let (first, second) = (Unlocked::create(&path).unwrap(), Unlocked::create(&path).unwrap());
        first.file().write_all(b"head 1").unwrap();
        second.file().write_all(b"head 2").unwrap();
        first.finish().unwrap();
        second.finish().unwrap();
        assert_eq!((names(), std::fs::read(&path).unwrap()), (vec!["a.part".into()], b"head 2".to_vec()));
        check_by_head(&path, b"head").unwrap();
        assert!(matches!(check_by_head(&path, b"other"), Err(Error::NotOurs { .. })));
        assert!(matches!(check_by_head(folder.path(), b"head"), Err(Error::NotOurs { .. })));
        check_by_head(&folder.path().join("new"), b"head").unwrap();
        assert!(matches!(check_by_head(&folder.path().join("no/new"), b"head"), Err(Error::Io { .. })));
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            std::fs::write(folder.path().join("plain"), "").unwrap();
            let mode = |name: &str| std::fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
            assert_eq!(mode("a.part"), mode("plain"), "others may read it as they may any file");
        }
    }
}
