//! The files of a store, by their names in it: all that a reader asks of the place where a matrix is.

use super::positioned::read_exact_at;
use std::collections::BTreeSet;
use std::fs::File;
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
}

impl StoreFiles {
    /// The store at `path`.
    pub(super) fn at(path: &Path) -> Self {
        Self::Folder(path.to_path_buf())
    }

    fn open(&self, name: &str) -> io::Result<File> {
        let Self::Folder(root) = self;
        crate::files::open(&root.join(name))
    }

    /// All bytes of a file.
    pub(super) fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        let Self::Folder(root) = self;
        crate::files::read(&root.join(name))
    }

    /// `len` bytes of a file from `offset` on.
    pub(super) fn read_at(&self, name: &str, offset: u64, len: usize) -> io::Result<Vec<u8>> {
        let mut bytes = vec![0; len];
        read_exact_at(&self.open(name)?, &mut bytes, offset)?;
        Ok(bytes)
    }

    /// The last `len` bytes of a file, or all where it is shorter, and its length.
    pub(super) fn read_end(&self, name: &str, len: usize) -> io::Result<(Vec<u8>, u64)> {
        let file = self.open(name)?;
        let all = file.metadata()?.len();
        let len = usize::try_from(all).map_or(len, |all| all.min(len));
        let mut bytes = vec![0; len];
        read_exact_at(&file, &mut bytes, all - len as u64)?;
        Ok((bytes, all))
    }

    /// The length of a file.
    pub(super) fn len(&self, name: &str) -> io::Result<u64> {
        let Self::Folder(root) = self;
        Ok(std::fs::metadata(root.join(name))?.len())
    }

    /// Whether there is a file of this name.
    pub(super) fn is_file(&self, name: &str) -> bool {
        let Self::Folder(root) = self;
        root.join(name).is_file()
    }

    /// Whether there is a folder of this name.
    pub(super) fn is_folder(&self, name: &str) -> bool {
        let Self::Folder(root) = self;
        root.join(name).is_dir()
    }

    /// The names of the files in a folder.
    pub(super) fn names(&self, folder: &str) -> io::Result<BTreeSet<String>> {
        let Self::Folder(root) = self;
        let files =
            std::fs::read_dir(root.join(folder))?.flatten().filter(|e| e.file_type().is_ok_and(|kind| kind.is_file()));
        Ok(files.filter_map(|e| e.file_name().into_string().ok()).collect())
    }

    /// Bytes of all files of a folder and of the folders in it.
    pub(super) fn bytes(&self, folder: &str) -> io::Result<u64> {
        let Self::Folder(root) = self;
        let mut sum = 0;
        let mut folders = vec![root.join(folder)];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder)? {
                let entry = entry?;
                match entry.file_type()?.is_dir() {
                    true => folders.push(entry.path()),
                    false => sum += entry.metadata()?.len(),
                }
            }
        }
        Ok(sum)
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
