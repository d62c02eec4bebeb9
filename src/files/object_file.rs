//! One object read as a file: some of it at a time, and as few bytes twice as can be.

use super::{Objects, object};
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::{self, Error, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The first request for a place in an object asks for so many bytes: heads of photographs are shorter.
const FIRST_BYTES: u64 = 64 << 10;
/// Each that follows where the last one ended asks for four times as many, up to this: at 20 ms a request and 100 MB/s, a
/// third of the time is waiting.
const MOST_BYTES: u64 = 4 << 20;

thread_local! {
    /// The first part of the object that this thread opened last: size and EXIF are asked for one after the other.
    static OPENED: RefCell<Option<(PathBuf, Part)>> = const { RefCell::new(None) };
}

/// BLAKE3 of the objects that were read, as far as they were read in order, until somebody asks for it: a photograph comes
/// over the network once, to be decoded and hashed.
static HASHED: Mutex<BTreeMap<PathBuf, Hashed>> = Mutex::new(BTreeMap::new());

enum Hashed {
    Whole(blake3::Hash),
    /// And the tag of the object.
    Begun(Box<ObjectHash>, Option<String>),
}

/// BLAKE3 of the first bytes of an object.
#[derive(Debug, Default)]
struct ObjectHash {
    hasher: blake3::Hasher,
    bytes: u64,
}

impl ObjectHash {
    /// Takes what of `window`, which begins at `begin`, comes next.
    fn update(&mut self, window: &[u8], begin: u64) {
        let end = begin + window.len() as u64;
        if begin <= self.bytes && self.bytes < end {
            self.hasher.update(&window[(self.bytes - begin) as usize..]);
            self.bytes = end;
        }
    }
}

/// BLAKE3 of the object at a URL. What was read before in this process is not read again.
///
/// # Errors
/// Those of [`ObjectFile::open`].
pub(crate) fn hash_object(path: &Path) -> io::Result<blake3::Hash> {
    let known = HASHED.lock().unwrap_or_else(PoisonError::into_inner).remove(path);
    let mut file = match known {
        Some(Hashed::Whole(hash)) => return Ok(hash),
        Some(Hashed::Begun(hash, tag)) => ObjectFile::go_on(path, *hash, tag.as_deref())?,
        None => ObjectFile::open(path)?,
    };
    while file.hash.bytes < file.len {
        file.at = file.hash.bytes;
        file.fetch()?;
    }
    Ok(std::mem::take(&mut file.hash).hasher.finalize())
}

/// What one request brought.
#[derive(Debug, Clone)]
pub(crate) struct Part {
    /// From the place that was asked for on.
    pub bytes: Vec<u8>,
    /// Length of the object.
    pub all: u64,
    /// Changes when the object does; not all servers have one.
    pub tag: Option<String>,
}

/// An object that is open for reading. It is one and the same from the first byte to the last: where a server tells
/// objects apart, one that has changed in the meantime cannot be read on.
#[derive(Debug)]
pub(crate) struct ObjectFile {
    object: Objects,
    len: u64,
    tag: Option<String>,
    /// Bytes that are here, and where they begin in the object.
    window: Vec<u8>,
    begin: u64,
    at: u64,
    next_bytes: u64,
    path: PathBuf,
    hash: ObjectHash,
}

impl ObjectFile {
    /// Reads the beginning.
    ///
    /// # Errors
    /// `NotFound`, and those of the connection.
    pub(super) fn open(path: &Path) -> io::Result<Self> {
        let object = object(path)?;
        let opened = OPENED.take().filter(|(last, _)| last == path).map(|(_, part)| part);
        let part = match opened.map_or_else(|| object.part(0, FIRST_BYTES, None), Ok) {
            // There is no first byte to ask for.
            Err(e) if e.kind() != ErrorKind::NotFound && object.len("").is_ok_and(|len| len == 0) => {
                Part { bytes: Vec::new(), all: 0, tag: None }
            }
            part => part?,
        };
        OPENED.set(Some((path.to_path_buf(), part.clone())));
        let mut hash = ObjectHash::default();
        hash.update(&part.bytes, 0);
        Ok(Self::of(path, object, part, 0, hash))
    }

    /// Opens an object behind what is hashed of it.
    fn go_on(path: &Path, mut hash: ObjectHash, tag: Option<&str>) -> io::Result<Self> {
        let object = object(path)?;
        let part = object.part(hash.bytes, MOST_BYTES, tag)?;
        let begin = hash.bytes;
        hash.update(&part.bytes, begin);
        Ok(Self::of(path, object, part, begin, hash))
    }

    fn of(path: &Path, object: Objects, part: Part, begin: u64, hash: ObjectHash) -> Self {
        let Part { bytes: window, all: len, tag } = part;
        let path = path.to_path_buf();
        Self { object, len, tag, window, begin, at: begin, next_bytes: 4 * FIRST_BYTES, path, hash }
    }

    pub(super) fn len(&self) -> u64 {
        self.len
    }

    fn fetch(&mut self) -> io::Result<()> {
        let follows = self.at == self.begin + self.window.len() as u64;
        let wanted = if follows { self.next_bytes } else { FIRST_BYTES };
        let part = self.object.part(self.at, wanted, self.tag.as_deref())?;
        if part.all != self.len || part.tag != self.tag {
            return Err(Error::other("the object was replaced while it was read"));
        }
        if part.bytes.is_empty() {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        (self.window, self.begin) = (part.bytes, self.at);
        self.hash.update(&self.window, self.begin);
        self.next_bytes = (4 * wanted).min(MOST_BYTES);
        Ok(())
    }
}

/// Remembers what was hashed, but for heads of long objects.
impl Drop for ObjectFile {
    fn drop(&mut self) {
        let hash = std::mem::take(&mut self.hash);
        let hashed = match hash.bytes {
            0 => return,
            bytes if bytes == self.len => Hashed::Whole(hash.hasher.finalize()),
            bytes if bytes > FIRST_BYTES => Hashed::Begun(Box::new(hash), self.tag.take()),
            _ => return,
        };
        let path = std::mem::take(&mut self.path);
        HASHED.lock().unwrap_or_else(PoisonError::into_inner).insert(path, hashed);
    }
}

impl Read for ObjectFile {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if out.is_empty() || self.at >= self.len {
            return Ok(0);
        }
        if self.at < self.begin || self.at >= self.begin + self.window.len() as u64 {
            self.fetch()?;
        }
        let here = &self.window[(self.at - self.begin) as usize..];
        let count = here.len().min(out.len());
        out[..count].copy_from_slice(&here[..count]);
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for ObjectFile {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::End(by) => self.len.checked_add_signed(by),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
        };
        self.at = at.ok_or(ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}
