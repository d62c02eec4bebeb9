//! Putting an output into its place, so that at every instant the earlier or the new one is there, whatever ends the
//! program.

use super::scratch::OLD;
use super::{ScratchFolder, signals};
use rayon::prelude::*;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

/// Writes all of `scratch`'s output to the disk and puts it at `target`; what was there leaves with the scratch folder.
/// With `replaces` false nothing may be there: what has appeared meanwhile stays.
///
/// # Errors
/// What the system says; `target` is then as it was.
pub(crate) fn put(scratch: &ScratchFolder, target: &Path, replaces: bool) -> io::Result<()> {
    let (new, old) = (scratch.new_path(), scratch.path().join(OLD));
    sync_all(&new)?;
    {
        // A signal waits: it removes the scratch folder, which may hold the only copy of the old output for a moment.
        let _held = signals::hold();
        match (replaces, new.is_dir()) {
            (false, _) => rename_to_nothing(&new, target)?,
            (true, false) => std::fs::rename(&new, target)?,
            (true, true) => exchange(&new, target)
                .or_else(|e| if cannot(&e) { in_two_steps(&new, target, &old) } else { Err(e) })?,
        }
    }
    sync_folder(target.parent().unwrap_or(Path::new("/")))
}

/// Whether a file system or kernel does not know the call.
fn cannot(e: &io::Error) -> bool {
    matches!(e.kind(), io::ErrorKind::Unsupported | io::ErrorKind::InvalidInput)
}

#[cfg(any(target_os = "linux", target_os = "android", target_vendor = "apple"))]
fn exchange(new: &Path, target: &Path) -> io::Result<()> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    Ok(renameat_with(CWD, new, CWD, target, RenameFlags::EXCHANGE)?)
}

#[cfg(not(any(target_os = "linux", target_os = "android", target_vendor = "apple")))]
fn exchange(_: &Path, _: &Path) -> io::Result<()> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Where there is no exchange. Ended between the two, the old output lies in the scratch folder, and the next run puts
/// it back.
fn in_two_steps(new: &Path, target: &Path, old: &Path) -> io::Result<()> {
    std::fs::rename(target, old)?;
    std::fs::rename(new, target).inspect_err(|_| drop(std::fs::rename(old, target)))
}

fn rename_to_nothing(new: &Path, target: &Path) -> io::Result<()> {
    #[cfg(any(target_os = "linux", target_os = "android", target_vendor = "apple"))]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        match renameat_with(CWD, new, CWD, target, RenameFlags::NOREPLACE).map_err(io::Error::from) {
            Err(e) if cannot(&e) => {}
            // An empty folder may give way, as for a plain rename.
            Err(e) if e.kind() == io::ErrorKind::AlreadyExists && target.is_dir() => {}
            done => return done,
        }
    }
    if target.symlink_metadata().is_ok_and(|kind| !kind.is_dir()) {
        return Err(io::ErrorKind::AlreadyExists.into());
    }
    std::fs::rename(new, target)
}

/// Waits until a file, or a folder with all that is in it, is on the disk.
fn sync_all(path: &Path) -> io::Result<()> {
    let (mut files, mut folders) = (Vec::new(), Vec::new());
    list(path, &mut files, &mut folders)?;
    files.par_iter().try_for_each(|file| File::open(file)?.sync_all())?;
    folders.par_iter().try_for_each(|folder| sync_folder(folder))
}

fn list(path: &Path, files: &mut Vec<PathBuf>, folders: &mut Vec<PathBuf>) -> io::Result<()> {
    let kind = path.symlink_metadata()?;
    if kind.is_file() {
        files.push(path.to_path_buf());
    } else if kind.is_dir() {
        for entry in std::fs::read_dir(path)? {
            list(&entry?.path(), files, folders)?;
        }
        folders.push(path.to_path_buf());
    }
    Ok(())
}

/// Waits until the names in a folder are on the disk, where the system can.
fn sync_folder(folder: &Path) -> io::Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    match cfg!(unix) {
        true => File::open(folder)?.sync_all().or_else(|e| if cannot(&e) { Ok(()) } else { Err(e) }),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(path: &Path, text: &str) {
        std::fs::create_dir_all(path).unwrap();
        std::fs::write(path.join("a"), text).unwrap();
    }

    #[test]
    fn an_output_takes_the_place_of_the_old_one_and_never_of_what_appeared_meanwhile() {
        let parent = tempfile::tempdir().unwrap();
        let target = parent.path().join("out");
        let text = || std::fs::read_to_string(target.join("a")).unwrap();
        for (replaces, new) in [(false, "1"), (true, "2")] {
            let scratch = ScratchFolder::new(parent.path(), &target).unwrap();
            folder(&scratch.new_path(), new);
            put(&scratch, &target, replaces).unwrap();
            assert_eq!(text(), new);
        }
        let scratch = ScratchFolder::new(parent.path(), &target).unwrap();
        folder(&scratch.new_path(), "3");
        assert!(put(&scratch, &target, false).is_err());
        assert_eq!(text(), "2");
        in_two_steps(&scratch.new_path(), &target, &scratch.path().join(OLD)).unwrap();
        assert_eq!(text(), "3");
        // Nothing to put there: the old one is put back.
        assert!(in_two_steps(&parent.path().join("none"), &target, &parent.path().join("old")).is_err());
        assert_eq!(text(), "3");
        let file = parent.path().join("file");
        std::fs::write(&file, "keep").unwrap();
        let scratch = ScratchFolder::new(parent.path(), &file).unwrap();
        std::fs::write(scratch.new_path(), "new").unwrap();
        assert!(put(&scratch, &file, false).is_err());
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "keep");
        put(&scratch, &file, true).unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "new");
    }
}
