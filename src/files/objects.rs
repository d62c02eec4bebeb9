//! Object stores: `s3://bucket/key`, `gs://bucket/key`, and `https://host/path` for reading. Credentials are
//! those of the usual environment (`AWS_*`, `GOOGLE_*`).

use super::FileState;
use super::object_file::Part;
use crate::{Error, Result};
use futures::TryStreamExt;
use object_store::aws::AmazonS3Builder;
use object_store::gcp::GoogleCloudStorageBuilder;
use object_store::http::HttpBuilder;
use object_store::path::Path as Key;
use object_store::{
    BackoffConfig, ClientOptions, GetOptions, GetRange, ObjectStore, ObjectStoreExt, RetryConfig, WriteMultipart,
};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, ErrorKind, Read};
use std::path::Path;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;
use tokio::runtime::Runtime;

/// Requests that fail are made again so often, after pauses that double from a tenth of a second: half a minute at the
/// most, as long as a server that restarts or a network that changes over is away.
const RETRIES: usize = 8;
/// And no longer than this after the first.
const RETRY_SECS: u64 = 120;
/// Files above this are written in parts of as many bytes; S3 takes 5 MiB to 5 GiB a part, and 10,000 parts.
const PART_BYTES: usize = 64 << 20;
/// Parts that are under way at once.
const PARTS_AT_ONCE: usize = 2;
/// Metadata, asked for several times while a store is opened.
const METADATA: [&str; 4] = ["zarr.json", ".zarray", ".zgroup", ".zattrs"];

/// The objects whose keys begin with that of a store.
#[derive(Debug, Clone)]
pub(crate) struct Objects(Arc<Place>);

#[derive(Debug)]
struct Place {
    store: Arc<dyn ObjectStore>,
    root: Key,
    /// Whether there is a way to ask which objects there are; plain servers have none.
    lists: bool,
    /// Contents of the metadata files that were read so far, by name; `None` for a file that does not exist.
    metadata: Mutex<BTreeMap<String, Option<Vec<u8>>>>,
    /// The last request that was given up.
    lost: Mutex<Option<String>>,
}

impl Objects {
    /// The store that a URL names. Nothing is asked of it yet.
    ///
    /// # Errors
    /// [`Error::Io`] for a URL that names no bucket, or an environment that no client can be made of.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let invalid = |reason: String| Error::io("read", path)(io::Error::new(ErrorKind::InvalidInput, reason));
        // Joined by the system's rules.
        let url = path.to_str().unwrap_or_default().replace(std::path::MAIN_SEPARATOR, "/");
        let (scheme, rest) = url.split_once("://").unwrap_or_default();
        let (host, key) = rest.split_once('/').unwrap_or((rest, ""));
        if host.is_empty() {
            return Err(invalid("expected a bucket or a host, found none".into()));
        }
        let store = client(scheme, host).map_err(|e| invalid(words(&e)))?;
        let root = Key::parse(key.trim_end_matches('/')).map_err(|e| invalid(e.to_string()))?;
        let lists = ["s3", "gs"].contains(&scheme);
        Ok(Self(Arc::new(Place { store, root, lists, metadata: Mutex::default(), lost: Mutex::default() })))
    }

    fn key(&self, name: &str) -> Key {
        name.split('/').filter(|part| !part.is_empty()).fold(self.0.root.clone(), |key, part| key.join(part))
    }

    /// An error with the name of the object.
    fn failed(&self, name: &str) -> impl Fn(object_store::Error) -> io::Error {
        let key = self.key(name);
        move |error| match error {
            object_store::Error::NotFound { .. } => ErrorKind::NotFound.into(),
            error => {
                let reason = format!("object {key}: {}", words(&error));
                *self.0.lost.lock().unwrap_or_else(PoisonError::into_inner) = Some(reason.clone());
                io::Error::other(reason)
            }
        }
    }

    /// The last request that was given up after its repetitions.
    pub(crate) fn lost(&self) -> Option<String> {
        self.0.lost.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn read(&self, name: &str) -> io::Result<Vec<u8>> {
        if !METADATA.contains(&name.rsplit('/').next().unwrap_or_default()) {
            return self.read_all(name);
        }
        let known = self.0.metadata.lock().unwrap_or_else(PoisonError::into_inner).get(name).cloned();
        let bytes = match known {
            Some(bytes) => bytes,
            None => {
                let bytes = match self.read_all(name) {
                    Err(e) if e.kind() == ErrorKind::NotFound => None,
                    bytes => Some(bytes?),
                };
                self.0.metadata.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_owned(), bytes.clone());
                bytes
            }
        };
        bytes.ok_or(ErrorKind::NotFound.into())
    }

    fn read_all(&self, name: &str) -> io::Result<Vec<u8>> {
        let key = self.key(name);
        let bytes = wait(async { self.0.store.get(&key).await?.bytes().await })?;
        Ok(bytes.map_err(self.failed(name))?.to_vec())
    }

    pub(crate) fn read_at(&self, name: &str, offset: u64, len: usize) -> io::Result<Vec<u8>> {
        if len == 0 {
            return Ok(Vec::new());
        }
        let key = self.key(name);
        let bytes = wait(self.0.store.get_range(&key, offset..offset + len as u64))?.map_err(self.failed(name))?;
        if bytes.len() == len { Ok(bytes.to_vec()) } else { Err(ErrorKind::UnexpectedEof.into()) }
    }

    pub(crate) fn read_end(&self, name: &str, len: usize) -> io::Result<(Vec<u8>, u64)> {
        let key = self.key(name);
        let options = GetOptions { range: Some(GetRange::Suffix(len as u64)), ..GetOptions::default() };
        let read = async {
            let found = self.0.store.get_opts(&key, options).await?;
            let all = found.meta.size;
            Ok((found.bytes().await?.to_vec(), all))
        };
        wait(read)?.map_err(self.failed(name))
    }

    pub(crate) fn len(&self, name: &str) -> io::Result<u64> {
        Ok(self.state(name)?.bytes)
    }

    /// Length and time of the last change.
    pub(crate) fn state(&self, name: &str) -> io::Result<FileState> {
        let found = wait(self.0.store.head(&self.key(name)))?.map_err(self.failed(name))?;
        let modified_ns = found.last_modified.timestamp_nanos_opt().unwrap_or_default().max(0) as u64;
        Ok(FileState { bytes: found.size, modified_ns })
    }

    /// Up to `len` bytes, at least one, of the object that the URL itself names, from `from` on; `as_before`: the tag of
    /// an earlier part, without which nothing is given.
    pub(crate) fn part(&self, from: u64, len: u64, as_before: Option<&str>) -> io::Result<Part> {
        let range = Some(GetRange::Bounded(from..from.saturating_add(len)));
        let options = GetOptions { range, if_match: as_before.map(str::to_owned), ..GetOptions::default() };
        let read = async {
            let found = self.0.store.get_opts(&self.0.root, options).await?;
            let (all, tag) = (found.meta.size, found.meta.e_tag.clone());
            Ok(Part { bytes: found.bytes().await?.to_vec(), all, tag })
        };
        wait(read)?.map_err(self.failed(""))
    }

    /// The objects below a folder, from the store on, with their bytes.
    pub(crate) fn all(&self, folder: &str) -> io::Result<BTreeMap<String, u64>> {
        if !self.0.lists {
            return Err(io::Error::new(ErrorKind::Unsupported, "a plain server does not tell which objects it has"));
        }
        let key = self.key(folder);
        let found = wait(self.0.store.list(Some(&key)).try_collect::<Vec<_>>())?.map_err(self.failed(folder))?;
        let root = &self.0.root;
        let name =
            |key: &Key| Some(key.prefix_match(root)?.map(|p| p.as_ref().to_owned()).collect::<Vec<_>>().join("/"));
        Ok(found.iter().filter_map(|object| Some((name(&object.location)?, object.size))).collect())
    }

    /// Writes the files of a folder, its `zarr.json` last: until then the store has no metadata. What was there before
    /// goes, its `zarr.json` first. Where that fails, what it wrote is deleted again as far as the store lets it.
    pub(crate) fn replace(&self, folder: &Path, earlier: bool) -> io::Result<()> {
        const ROOT: &str = "zarr.json";
        let old = if earlier { self.all("")? } else { BTreeMap::new() };
        if old.contains_key(ROOT) {
            self.delete([ROOT])?;
        }
        let new = crate::files::below(folder)?;
        let names = || new.keys().map(String::as_str).filter(|name| *name != ROOT);
        let written = names()
            .try_for_each(|name| self.put(name, &folder.join(name)))
            .and_then(|()| self.delete(old.keys().map(String::as_str).filter(|name| !new.contains_key(*name))))
            .and_then(|()| self.put(ROOT, &folder.join(ROOT)));
        if written.is_err() && !earlier {
            // The first failure is the one to tell; a server that is away is not asked for every object.
            let _ = self.delete(names());
        }
        written
    }

    fn delete<'a>(&self, names: impl IntoIterator<Item = &'a str>) -> io::Result<()> {
        names.into_iter().try_for_each(|name| match wait(self.0.store.delete(&self.key(name)))? {
            Err(object_store::Error::NotFound { .. }) => Ok(()),
            done => done.map_err(self.failed(name)),
        })
    }

    fn put(&self, name: &str, file: &Path) -> io::Result<()> {
        let (mut file, key) = (File::open(file)?, self.key(name));
        let mut part = Vec::new();
        let mut next = |part: &mut Vec<u8>| {
            part.clear();
            file.by_ref().take(PART_BYTES as u64).read_to_end(part)
        };
        next(&mut part)?;
        if part.len() < PART_BYTES {
            return wait(self.0.store.put(&key, part.into()))?.map(|_| ()).map_err(self.failed(name));
        }
        wait(async {
            let upload = self.0.store.put_multipart(&key).await.map_err(self.failed(name))?;
            let mut upload = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
            let written = async {
                while !part.is_empty() {
                    upload.wait_for_capacity(PARTS_AT_ONCE).await.map_err(self.failed(name))?;
                    upload.write(&part);
                    next(&mut part)?;
                }
                Ok(())
            };
            let written: io::Result<()> = written.await;
            if written.is_err() {
                // Parts of an upload that nobody ends are kept, and paid for; `finish` forgets them by itself.
                let _ = upload.abort().await;
                return written;
            }
            upload.finish().await.map(|_| ()).map_err(self.failed(name))
        })?
    }
}

/// One client for each bucket or host, so that requests share its connections.
fn client(scheme: &str, host: &str) -> object_store::Result<Arc<dyn ObjectStore>> {
    static CLIENTS: Mutex<BTreeMap<String, Arc<dyn ObjectStore>>> = Mutex::new(BTreeMap::new());
    let mut clients = CLIENTS.lock().unwrap_or_else(PoisonError::into_inner);
    let url = format!("{scheme}://{host}");
    if let Some(client) = clients.get(&url) {
        return Ok(Arc::clone(client));
    }
    let made: Arc<dyn ObjectStore> = match scheme {
        "s3" => Arc::new(AmazonS3Builder::from_env().with_bucket_name(host).with_retry(retry()).build()?),
        "gs" => Arc::new(GoogleCloudStorageBuilder::from_env().with_bucket_name(host).with_retry(retry()).build()?),
        _ => {
            let options = ClientOptions::new().with_allow_http(scheme == "http");
            Arc::new(HttpBuilder::new().with_url(&url).with_client_options(options).with_retry(retry()).build()?)
        }
    };
    clients.insert(url, Arc::clone(&made));
    Ok(made)
}

fn retry() -> RetryConfig {
    let backoff =
        BackoffConfig { init_backoff: Duration::from_millis(100), max_backoff: Duration::from_secs(15), base: 2.0 };
    RetryConfig { backoff, max_retries: RETRIES, retry_timeout: Duration::from_secs(RETRY_SECS) }
}

/// What a client says, with the causes that it does not say itself.
fn words(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let more = error.to_string();
        if !text.contains(&more) {
            text += &format!(": {more}");
        }
        cause = error.source();
    }
    text
}

/// Runs a request to its end.
fn wait<T>(request: impl Future<Output = T>) -> io::Result<T> {
    static RUNTIME: OnceLock<Runtime> = OnceLock::new();
    let runtime = match RUNTIME.get() {
        Some(runtime) => runtime,
        None => {
            let made = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
            RUNTIME.get_or_init(|| made)
        }
    };
    Ok(runtime.block_on(request))
}
