//! Checksums of a capture's photographs as they were when it was made: lines of a BLAKE3 and a name, as the program
//! `b3sum` writes and checks them.

use crate::{Error, Result};
use std::collections::BTreeMap;
use std::path::Path;

/// The file of checksums in a capture's folder. A capture without one is not checked, nor is a photograph that is not
/// named.
pub(crate) const CHECKSUMS: &str = "photographs.b3";

/// Writes the checksums of photographs by their names in the folder `dir`.
///
/// # Errors
/// [`Error::Io`].
pub(crate) fn write_checksums(dir: &Path, photographs: &BTreeMap<String, blake3::Hash>) -> Result<()> {
    let path = dir.join(CHECKSUMS);
    let text: String = photographs.iter().map(|(name, hash)| format!("{hash}  {name}\n")).collect();
    std::fs::write(&path, text).map_err(Error::io("write", &path))
}

/// What was written; nothing where there is no such file.
///
/// # Errors
/// [`Error::Io`]; [`Error::Field`] for a line that is none of a checksum.
pub(crate) fn read_checksums(dir: &Path) -> Result<BTreeMap<String, blake3::Hash>> {
    let path = dir.join(CHECKSUMS);
    let text = match crate::files::read_to_string(&path) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(BTreeMap::new()),
        text => text.map_err(Error::io("read", &path))?,
    };
    let line = |(k, line): (usize, &str)| {
        let parts =
            line.split_once("  ").and_then(|(hash, name)| Some((name.to_owned(), blake3::Hash::from_hex(hash).ok()?)));
        parts.ok_or_else(|| Error::field(&path, format!("line {}", k + 1), "a BLAKE3, two spaces and a name", line))
    };
    text.lines().enumerate().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn checksums_are_read_as_they_were_written() {
        let dir = tempfile::tempdir().unwrap();
        assert!(read_checksums(dir.path()).unwrap().is_empty());
        std::fs::write(dir.path().join("a  b.png"), "a picture").unwrap();
        let written =
            BTreeMap::from([("a  b.png".to_owned(), crate::files::hash(&dir.path().join("a  b.png")).unwrap())]);
        assert_eq!(written["a  b.png"], blake3::hash(b"a picture"));
        write_checksums(dir.path(), &written).unwrap();
        assert_eq!(read_checksums(dir.path()).unwrap(), written);
        std::fs::write(dir.path().join(CHECKSUMS), "0123  a.png\n").unwrap();
        assert!(matches!(read_checksums(dir.path()), Err(Error::Field { field, .. }) if field == "line 1"));
    }
}
