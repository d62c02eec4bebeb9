//! What stands where a matrix is to go: replaced only when this program has made it, and nobody has changed it since.

use super::checksum::{self, Checksums};
use super::store_files::StoreFiles;
use crate::files::is_url;
use crate::{Error, Result};
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};

/// Checks, before any work, that a matrix may be written; says whether there is one to be replaced.
///
/// # Errors
/// [`Error::NotEmpty`] unless `force`; [`Error::NotOurs`], [`Error::Changed`]; [`Error::Io`].
pub(crate) fn check(path: &Path, force: bool) -> Result<bool> {
    if is_url(path) {
        return check_objects(path, force);
    }
    match std::fs::read_dir(path).map(|mut entries| entries.next().is_none()) {
        Ok(true) => return Ok(false),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound && path.symlink_metadata().is_err() => return Ok(false),
        Err(e) if e.kind() == std::io::ErrorKind::NotADirectory => {
            return Err(Error::NotOurs { path: path.to_path_buf() });
        }
        Ok(false) if !force => return Err(Error::NotEmpty { path: path.to_path_buf() }),
        Ok(false) => {}
        Err(e) => return Err(Error::io("create", path)(e)),
    }
    let root = path.join("zarr.json");
    let text = crate::files::read(&root).ok();
    let Some(attributes) = marked(text) else { return Err(Error::NotOurs { path: path.to_path_buf() }) };
    if let Some(path) = other_file(path)? {
        return Err(Error::NotOurs { path });
    }
    match unchanged(&StoreFiles::Folder(path.to_path_buf()), &attributes) {
        true => Ok(true),
        false => Err(Error::Changed { path: root }),
    }
}

/// [`check`] of a URL.
fn check_objects(path: &Path, force: bool) -> Result<bool> {
    if path.to_str().is_some_and(|url| url.starts_with("http")) {
        let expected = "a folder, s3:// or gs://: a plain server is read only";
        return Err(Error::Setting { setting: "out", expected: expected.into(), found: path.display().to_string() });
    }
    let files = StoreFiles::at(path)?;
    let StoreFiles::Objects(objects) = &files else { return Err(Error::internal("no folder")) };
    let all = objects.all("").map_err(Error::io("create", path))?;
    if all.is_empty() {
        return Ok(false);
    }
    if !force {
        return Err(Error::NotEmpty { path: path.to_path_buf() });
    }
    if let Some(other) = all.keys().find(|name| !is_ours(name)) {
        return Err(Error::NotOurs { path: path.join(other) });
    }
    let text = files.read("zarr.json").ok();
    let Some(attributes) = marked(text) else { return Err(Error::NotOurs { path: path.to_path_buf() }) };
    match unchanged(&files, &attributes) {
        true => Ok(true),
        false => Err(Error::Changed { path: path.join("zarr.json") }),
    }
}

/// The attributes of a group that has the mark of this program.
fn marked(text: Option<Vec<u8>>) -> Option<Map<String, Value>> {
    let group: Value = serde_json::from_slice(&text?).ok()?;
    group["attributes"].as_object().filter(|attributes| has_mark(attributes)).cloned()
}

/// Whether attributes are such as this program alone writes. Others write format 2, too, by `docs/matrix-format.md`,
/// but not its checksum; format 1 had none.
fn has_mark(attributes: &Map<String, Value>) -> bool {
    match attributes.get("acquire_format").and_then(Value::as_u64) {
        Some(1) => true,
        Some(_) => attributes.contains_key(checksum::GROUP),
        None => false,
    }
}

/// Whether attributes and metadata are as they were written, with nothing added. Stores of the format that had no
/// checksums pass.
fn unchanged(files: &StoreFiles, attributes: &Map<String, Value>) -> bool {
    let Some(covered) = attributes.get(checksum::GROUP).map(|group| &group["attributes"]) else { return true };
    let known =
        |name: &String| name == checksum::GROUP || covered.as_array().is_some_and(|a| a.iter().any(|v| v == name));
    attributes.keys().all(known) && matches!(Checksums::open(files, attributes), Ok(Some(_)))
}

/// A file in the folder of a matrix that is none of its own.
fn other_file(store: &Path) -> Result<Option<PathBuf>> {
    let mut folders = vec![(store.to_path_buf(), String::new())];
    while let Some((folder, name)) = folders.pop() {
        for entry in std::fs::read_dir(&folder).map_err(Error::io("read", &folder))? {
            let entry = entry.map_err(Error::io("read", &folder))?;
            let name = format!("{name}{}", entry.file_name().to_string_lossy());
            match entry.file_type().map_err(Error::io("read", entry.path()))? {
                kind if kind.is_dir() => folders.push((entry.path(), name + "/")),
                kind if kind.is_file() && is_ours(&name) => {}
                _ => return Ok(Some(entry.path())),
            }
        }
    }
    Ok(None)
}

/// Whether a matrix may have a file of this name: metadata, or a chunk's.
fn is_ours(name: &str) -> bool {
    let Some((array, file)) = name.split_once('/') else { return name == "zarr.json" };
    // Other programs name chunks of rows as they name all.
    let start = if checksum::ROWS.contains(&array) { "c." } else { "c/" };
    let chunk = file.strip_prefix(start).unwrap_or_default();
    let number = |part: &str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_digit());
    checksum::ARRAYS.contains(&array) && (file == "zarr.json" || chunk.split(['.', '/']).all(number))
}

#[cfg(test)]
mod tests {
    use super::super::store::tests::{header, row};
    use super::super::{MatrixReader, MatrixWriter};
    use super::*;

    #[test]
    fn a_matrix_is_replaced_by_the_next_and_nothing_of_others_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let header = header([5, 3], [3, 1]);
        let write = || {
            let writer = MatrixWriter::create(&path, header.clone())?;
            writer.put(3, &row(&header, 3))?;
            writer.finish()
        };
        assert!(!check(&path, false).unwrap());
        write().unwrap();
        assert!(matches!(check(&path, false), Err(Error::NotEmpty { .. })));
        write().unwrap();
        for other in
            ["notes.txt", "response/notes.txt", "response/c.9.x", "response/c/0/notes", "more/zarr.json", "zarr.json/x"]
        {
            let other = path.join(other);
            if std::fs::create_dir_all(other.parent().unwrap()).is_err() {
                continue;
            }
            std::fs::write(&other, "keep").unwrap();
            assert!(matches!(write(), Err(Error::NotOurs { path }) if path == other), "{other:?}");
            std::fs::remove_file(&other).unwrap();
            let _ = std::fs::remove_dir(path.join("more"));
        }
        // An attribute of somebody's, and one that somebody has changed.
        let root = path.join("zarr.json");
        let text = std::fs::read_to_string(&root).unwrap();
        for (from, to) in [("\"attributes\": {", "\"attributes\": {\"note\": 1,"), ("\"seed\": 1", "\"seed\": 2")] {
            let changed = text.replacen(from, to, 1);
            assert_ne!(changed, text);
            std::fs::write(&root, changed).unwrap();
            assert!(matches!(write(), Err(Error::Changed { path }) if path == root));
        }
        std::fs::write(&root, text).unwrap();
        write().unwrap();
        assert_eq!(MatrixReader::open(&path).unwrap().header(), &header);
        // One that somebody has written by our description, whatever version he states; ours of the version that had no
        // checksums.
        let stated = |version: i32| {
            let mut group: Value = serde_json::from_str(&std::fs::read_to_string(&root).unwrap()).unwrap();
            let attributes = group["attributes"].as_object_mut().unwrap();
            attributes.remove(checksum::GROUP);
            attributes.insert("acquire_format".into(), version.into());
            std::fs::write(&root, group.to_string()).unwrap();
        };
        stated(2);
        assert!(matches!(check(&path, true), Err(Error::NotOurs { .. })));
        stated(1);
        assert!(check(&path, true).unwrap());
        std::fs::create_dir_all(path.join("response/c/0/0/0/0")).unwrap();
        std::fs::write(path.join("response/c/0/0/0/0/0"), "a chunk as others name them").unwrap();
        assert!(matches!(check(&path, true), Err(Error::NotOurs { .. })));
        // Somebody's store, and somebody's folder with a zarr.json.
        let theirs = folder.path().join("theirs");
        std::fs::create_dir(&theirs).unwrap();
        std::fs::write(theirs.join("zarr.json"), "{\"attributes\": {}, \"node_type\": \"group\"}").unwrap();
        assert!(matches!(MatrixWriter::create(&theirs, header.clone()), Err(Error::NotOurs { .. })));
        std::fs::write(folder.path().join("file"), "keep").unwrap();
        assert!(matches!(MatrixWriter::create(&folder.path().join("file"), header), Err(Error::NotOurs { .. })));
    }
}
