//! The files of a store, by their names in it: all that a reader asks of the place where a matrix is.

use super::positioned::read_exact_at;
use crate::files::{Objects, is_url};
use crate::{Error, Result};
use std::collections::BTreeSet;
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::storage::byte_range::{ByteRange, ByteRangeIterator};
use zarrs::storage::{MaybeBytesIterator, ReadableStorageTraits, StorageError, StoreKey};

/// Where a store is. Names of files and folders are relative to it, with `/` between them.
#[derive(Debug, Clone)]
pub(super) enum StoreFiles {
    /// A folder.
    Folder(PathBuf),
    /// Objects whose keys have a common beginning.
    Objects(Objects),
}

impl StoreFiles {
    /// The store at `path`, a folder or a URL.
    ///
    /// # Errors
    /// [`Error::NeedsFeature`], [`Error::Io`] for a URL that cannot be used.
    pub(super) fn at(path: &Path) -> Result<Self> {
        Ok(if is_url(path) { Self::Objects(Objects::open(path)?) } else { Self::Folder(path.to_path_buf()) })
    }

    /// All bytes of a file.
    pub(super) fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        match self {
            Self::Folder(root) => crate::files::read(&root.join(name)),
            Self::Objects(objects) => objects.read(name),
        }
    }

    /// `len` bytes of a file from `offset` on.
    pub(super) fn read_at(&self, name: &str, offset: u64, len: usize) -> io::Result<Vec<u8>> {
        let root = match self {
            Self::Folder(root) => root,
            Self::Objects(objects) => return objects.read_at(name, offset, len),
        };
        let mut bytes = vec![0; len];
        read_exact_at(&crate::files::open_local(&root.join(name))?, &mut bytes, offset)?;
        Ok(bytes)
    }

    /// The last `len` bytes of a file, or all where it is shorter, and its length.
    pub(super) fn read_end(&self, name: &str, len: usize) -> io::Result<(Vec<u8>, u64)> {
        let root = match self {
            Self::Folder(root) => root,
            Self::Objects(objects) => return objects.read_end(name, len),
        };
        let file = crate::files::open_local(&root.join(name))?;
        let all = file.metadata()?.len();
        let len = usize::try_from(all).map_or(len, |all| all.min(len));
        let mut bytes = vec![0; len];
        read_exact_at(&file, &mut bytes, all - len as u64)?;
        Ok((bytes, all))
    }

    /// The length of a file.
    pub(super) fn len(&self, name: &str) -> io::Result<u64> {
        match self {
            Self::Folder(root) => Ok(std::fs::metadata(root.join(name))?.len()),
            Self::Objects(objects) => objects.len(name),
        }
    }

    /// Whether one of these files is in a folder.
    pub(super) fn has(&self, folder: &str, names: &[&str]) -> io::Result<bool> {
        let names = names.iter().map(|name| format!("{folder}/{name}").trim_start_matches('/').to_owned());
        for name in names {
            let there = match self {
                Self::Folder(root) => Ok(root.join(name).is_file()),
                Self::Objects(objects) => objects.read(&name).map(|_| true),
            };
            match there {
                Ok(false) => {}
                Err(e) if e.kind() == ErrorKind::NotFound => {}
                there => return there,
            }
        }
        Ok(false)
    }

    /// Whether there is a folder of this name.
    pub(super) fn is_folder(&self, name: &str) -> bool {
        match self {
            Self::Folder(root) => root.join(name).is_dir(),
            Self::Objects(objects) => objects.all(name).is_ok_and(|all| !all.is_empty()),
        }
    }

    /// The names of the files in a folder; `None` where there is no way to ask.
    pub(super) fn names(&self, folder: &str) -> io::Result<Option<BTreeSet<String>>> {
        let root = match self {
            Self::Folder(root) => root,
            Self::Objects(objects) => {
                let found = match objects.all(folder) {
                    Err(e) if e.kind() == ErrorKind::Unsupported => return Ok(None),
                    found => found?,
                };
                let names = found.into_keys().filter_map(|name| Some(name.strip_prefix(folder)?.get(1..)?.to_owned()));
                return Ok(Some(names.filter(|name| !name.contains('/')).collect()));
            }
        };
        let files =
            std::fs::read_dir(root.join(folder))?.flatten().filter(|e| e.file_type().is_ok_and(|kind| kind.is_file()));
        Ok(Some(files.filter_map(|e| e.file_name().into_string().ok()).collect()))
    }

    /// Bytes of all files of a folder and of the folders in it.
    pub(super) fn bytes(&self, folder: &str) -> io::Result<u64> {
        let files = match self {
            Self::Folder(root) => crate::files::below(&root.join(folder))?,
            Self::Objects(objects) => objects.all(folder)?,
        };
        Ok(files.values().sum())
    }

    /// What is wrong with the store at `path`: it is not whole, or it could not be reached.
    pub(super) fn broken(&self, path: &Path, reason: String) -> Error {
        match self {
            Self::Objects(objects) if objects.lost().is_some() => {
                Error::io("read", path)(io::Error::other(objects.lost().unwrap_or_default()))
            }
            _ => Error::BrokenMatrix { path: path.to_path_buf(), reason },
        }
    }

    fn range(&self, name: &str, range: ByteRange) -> io::Result<Vec<u8>> {
        match range {
            ByteRange::FromStart(0, None) => self.read(name),
            ByteRange::FromStart(from, len) => {
                let all = self.len(name)?;
                let len =
                    len.or(all.checked_sub(from)).filter(|len| from.checked_add(*len).is_some_and(|to| to <= all));
                let len = len.and_then(|len| usize::try_from(len).ok()).ok_or(ErrorKind::UnexpectedEof)?;
                self.read_at(name, from, len)
            }
            ByteRange::Suffix(len) => {
                let (bytes, _) = self.read_end(name, usize::try_from(len).unwrap_or(usize::MAX))?;
                if bytes.len() as u64 == len { Ok(bytes) } else { Err(ErrorKind::UnexpectedEof.into()) }
            }
        }
    }
}

/// `None` for what is not there.
fn found<T>(result: io::Result<T>) -> Result<Option<T>, StorageError> {
    match result {
        Ok(value) => Ok(Some(value)),
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => Ok(None),
        Err(e) => Err(StorageError::IOError(Arc::new(e))),
    }
}

impl ReadableStorageTraits for StoreFiles {
    fn get_partial_many<'a>(
        &'a self,
        key: &StoreKey,
        ranges: ByteRangeIterator<'a>,
    ) -> Result<MaybeBytesIterator<'a>, StorageError> {
        let mut all = Vec::new();
        for range in ranges {
            match found(self.range(key.as_str(), range))? {
                Some(bytes) => all.push(Ok(bytes.into())),
                None => return Ok(None),
            }
        }
        Ok(Some(Box::new(all.into_iter())))
    }

    fn size_key(&self, key: &StoreKey) -> Result<Option<u64>, StorageError> {
        found(self.len(key.as_str()))
    }

    fn supports_get_partial(&self) -> bool {
        true
    }
}
