//! In the place of `objects.rs` in a program without the feature `cloud`: there are no object stores.

use super::FileState;
use super::object_file::Part;
use crate::{Error, Result};
use std::collections::BTreeMap;
use std::io;
use std::path::Path;

/// The objects of a store, of which there are none.
#[derive(Debug, Clone)]
pub(crate) enum Objects {}

impl Objects {
    /// Refuses a URL.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        Err(Error::NeedsFeature { path: path.to_path_buf(), feature: "cloud" })
    }

    pub(crate) fn lost(&self) -> Option<String> {
        match *self {}
    }

    pub(crate) fn read(&self, _name: &str) -> io::Result<Vec<u8>> {
        match *self {}
    }

    pub(crate) fn read_at(&self, _name: &str, _offset: u64, _len: usize) -> io::Result<Vec<u8>> {
        match *self {}
    }

    pub(crate) fn read_end(&self, _name: &str, _len: usize) -> io::Result<(Vec<u8>, u64)> {
        match *self {}
    }

    pub(crate) fn part(&self, _from: u64, _len: u64, _as_before: Option<&str>) -> io::Result<Part> {
        match *self {}
    }

    pub(crate) fn state(&self, _name: &str) -> io::Result<FileState> {
        match *self {}
    }

    pub(crate) fn len(&self, _name: &str) -> io::Result<u64> {
        match *self {}
    }

    pub(crate) fn all(&self, _folder: &str) -> io::Result<BTreeMap<String, u64>> {
        match *self {}
    }

    pub(crate) fn replace(&self, _folder: &Path, _earlier: bool) -> io::Result<()> {
        match *self {}
    }
}
