//! Arrays of a Zarr group.

use super::{Array, Arrays, count, refused};
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::data_type;
use zarrs::filesystem::FilesystemStore;

/// The most files that a group may have.
const MOST_FILES: usize = 1 << 20;

/// A group that is open.
pub(super) struct ZarrGroup {
    path: PathBuf,
    store: Arc<FilesystemStore>,
}

impl ZarrGroup {
    pub(super) fn open(path: &Path) -> Result<Self> {
        let broken = |e: &dyn std::fmt::Display| refused(path, "group", "an NPZ archive or a Zarr group", e);
        if path.to_str().is_none() {
            return Err(broken(&"a path that is not UTF-8"));
        }
        let store = FilesystemStore::new(path).map_err(|e| broken(&e))?;
        if !["zarr.json", ".zgroup"].iter().any(|name| path.join(name).is_file()) {
            return Err(broken(&"a folder without zarr.json"));
        }
        Ok(Self { path: path.to_path_buf(), store: Arc::new(store) })
    }
}

impl Arrays for ZarrGroup {
    fn array(&mut self, name: &str, most: usize) -> Result<Option<Array>> {
        let path = &self.path;
        if !path.join(name).is_dir() {
            return Ok(None);
        }
        let broken = |e: &dyn std::fmt::Display| refused(path, name, "a whole Zarr array", e);
        let array = zarrs::array::Array::open(self.store.clone(), &format!("/{name}")).map_err(|e| broken(&e))?;
        let len = count(path, name, array.shape(), most)?;
        let shape: Vec<usize> = array.shape().iter().map(|&n| n as usize).collect();
        if len == 0 {
            return Ok(Some(Array { shape, values: Vec::new() }));
        }
        // A chunk is decoded whole, however little of it the array has.
        let chunk = array.chunk_shape(&vec![0; shape.len()]).map_err(|e| broken(&e))?;
        let sides: Vec<u64> = chunk.iter().map(|n| n.get()).collect();
        count(path, &format!("{name}, its chunks"), &sides, 8 * most)?;
        let all = array.subset_all();
        let values = if *array.data_type() == data_type::float32() {
            let values: Vec<f32> = array.retrieve_array_subset(&all).map_err(|e| broken(&e))?;
            values.into_iter().map(f64::from).collect()
        } else if *array.data_type() == data_type::float64() {
            array.retrieve_array_subset(&all).map_err(|e| broken(&e))?
        } else {
            return Err(broken(&format_args!("numbers of type {} (float32 or float64 are read)", array.data_type())));
        };
        Ok(Some(Array { shape, values }))
    }

    fn blake3(&mut self) -> Result<String> {
        let mut files = Vec::new();
        let mut folders = vec![self.path.clone()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(&folder).map_err(Error::io("read", &folder))? {
                let entry = entry.map_err(Error::io("read", &folder))?;
                let kind = entry.file_type().map_err(Error::io("read", entry.path()))?;
                if kind.is_dir() {
                    folders.push(entry.path())
                } else {
                    files.push(entry.path())
                }
                if files.len() > MOST_FILES {
                    let found = format!("{} and more", files.len());
                    return Err(refused(&self.path, "group", format!("at most {MOST_FILES} files"), found));
                }
            }
        }
        files.sort();
        let mut all = blake3::Hasher::new();
        for file in files {
            let mut hasher = blake3::Hasher::new();
            let opened = crate::files::open(&file).map_err(Error::io("read", &file))?;
            hasher.update_reader(opened).map_err(Error::io("read", &file))?;
            let name = file.strip_prefix(&self.path).unwrap_or(&file);
            all.update(format!("{}\0{}\n", name.display(), hasher.finalize()).as_bytes());
        }
        Ok(all.finalize().to_string())
    }
}
