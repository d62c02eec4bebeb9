//! Single files.

use super::{ScratchFolder, put, seal};
use crate::{Error, Result, files::check_local};
use std::path::{Path, PathBuf};

/// Writes a file whole, in the place of an earlier one only if this program has made that. `bytes` are sealed on the
/// way (see [`super::seal`]).
///
/// # Errors
/// [`Error::Changed`], [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn write_whole(path: &Path, mut bytes: Vec<u8>) -> Result<()> {
    let path = real(path)?;
    let replaces = check_file(&path, true)?;
    seal::seal(&mut bytes);
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scratch = ScratchFolder::new(folder, &path)?;
    std::fs::write(scratch.new_path(), &bytes).map_err(Error::io("write", &path))?;
    put(&scratch, &path, replaces).map_err(Error::io("write", &path))
}

/// Checks, before any work, that a file may be written; says whether there is one to be replaced.
///
/// # Errors
/// [`Error::NotLocal`]; [`Error::Exists`] unless `force`; [`Error::NotOurs`], [`Error::Io`].
pub(crate) fn check_file(path: &Path, force: bool) -> Result<bool> {
    check_local(path)?;
    let path = real(path)?;
    match path.symlink_metadata() {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(false),
        Err(e) => Err(Error::io("create", &path)(e)),
        Ok(_) if !force => Err(Error::Exists { path }),
        Ok(kind) if kind.is_file() && made_here(&path)? => Ok(true),
        Ok(_) => Err(Error::NotOurs { path }),
    }
}

/// Where a link leads: it stays, and what it names is written.
fn real(path: &Path) -> Result<PathBuf> {
    match path.is_symlink() {
        true => path.canonicalize().map_err(Error::io("create", path)),
        false => Ok(path.to_path_buf()),
    }
}

/// Whether this program has made a file, and nobody has changed it since.
fn made_here(path: &Path) -> Result<bool> {
    let bytes = std::fs::read(path).map_err(Error::io("read", path))?;
    Ok(seal::is_sealed(&bytes) || acquire_material::Material::from_bytes(&bytes).is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_replaced_when_asked_and_only_when_it_is_ours_and_unchanged() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.exr");
        let bytes = |text: &str| [seal::SEAL.as_bytes(), text.as_bytes()].concat();
        assert!(!check_file(&path, false).unwrap());
        write_whole(&path, bytes("1")).unwrap();
        assert!(matches!(check_file(&path, false), Err(Error::Exists { path: p }) if p == path));
        assert!(check_file(&path, true).unwrap());
        write_whole(&path, bytes("2")).unwrap();
        let written = std::fs::read(&path).unwrap();
        assert!(written.ends_with(b"2"));
        for other in [b"notes".to_vec(), written[..written.len() - 1].to_vec(), vec![]] {
            std::fs::write(&path, &other).unwrap();
            assert!(matches!(write_whole(&path, bytes("3")), Err(Error::NotOurs { .. })));
            assert!(matches!(check_file(&path, true), Err(Error::NotOurs { .. })));
            assert_eq!(std::fs::read(&path).unwrap(), other);
        }
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[cfg(unix)]
    #[test]
    fn a_link_stays_and_leads_to_the_new_file() {
        let folder = tempfile::tempdir().unwrap();
        let (link, file) = (folder.path().join("link"), folder.path().join("file"));
        write_whole(&file, seal::SEAL.into()).unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        write_whole(&link, [seal::SEAL, "new"].concat().into()).unwrap();
        assert!(link.is_symlink() && std::fs::read(&file).unwrap().ends_with(b"new"));
    }
}
