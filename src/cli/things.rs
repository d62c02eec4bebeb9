//! What lies at a path that a command could not use: the hint says which command takes it.

use clap::builder::{PathBufValueParser, TypedValueParser};
use std::path::{Path, PathBuf};

/// What this program makes and takes.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Thing {
    Capture,
    Plan,
    Rig,
    Matrix,
    Material,
    Photographs,
}

impl Thing {
    /// Told by the files that make it one.
    fn at(path: &Path) -> Option<Self> {
        let has = |name: &str| path.join(name).is_file();
        if path.is_file() {
            let material = ["safetensors", "acq"].iter().any(|e| super::ending(path) == *e);
            return material.then_some(Self::Material);
        }
        if !path.is_dir() {
            return None;
        }
        [
            ("capture.toml", Self::Capture),
            ("plan.toml", Self::Plan),
            ("rig.toml", Self::Rig),
            ("zarr.json", Self::Matrix),
        ]
        .into_iter()
        .find(|(file, _)| has(file))
        .map(|(_, thing)| thing)
        .or_else(|| has_photographs(path).then_some(Self::Photographs))
    }

    fn words(self, path: &Path) -> String {
        let at = path.display();
        match self {
            Self::Capture => format!(
                "{at} is a capture: `acquire build-matrix {at}` makes a matrix of it, `acquire run {at} --out RESULTS` all the rest too"
            ),
            Self::Plan => format!(
                "{at} is a plan: `acquire import FOLDER --plan {at} --out CAPTURE` makes a capture of it and the photographs in FOLDER"
            ),
            Self::Rig => format!(
                "{at} is the folder of a rig: name it with --calibration (with `acquire patterns` --rig), and the capture or plan in its place"
            ),
            Self::Matrix => format!(
                "{at} is a matrix: `acquire factor {at}` makes a material of it; relight, tradeoff and evaluate take it as it is"
            ),
            Self::Material => format!(
                "{at} is a material: `acquire export`, `acquire relight` and `acquire evaluate {at} MATRIX` take it"
            ),
            Self::Photographs => format!(
                "{at} holds photographs: `acquire import {at} --plan PLAN --out CAPTURE` makes a capture of them"
            ),
        }
    }
}

fn has_photographs(folder: &Path) -> bool {
    let kinds = ["png", "jpg", "jpeg", "tif", "tiff", "exr", "dng", "cr2", "nef", "arw"];
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.take(1000).any(|e| kinds.contains(&super::ending(&e.path()).as_str()))
}

/// What lies at `path`, in words, and what takes it; `None` where it is nothing that is known.
pub(super) fn known(path: &Path) -> Option<String> {
    Thing::at(path).map(|thing| thing.words(path))
}

/// Where a rig lies near a folder that has none.
pub(super) fn rig_near(path: &Path) -> Option<PathBuf> {
    let near = [
        path.join("calibration"),
        path.to_path_buf(),
        path.parent()?.join("calibration"),
        path.parent()?.to_path_buf(),
    ];
    near.into_iter().find(|folder| folder.join("rig.toml").is_file())
}

/// A folder, or the file in it that makes it one, which people name as often.
pub(super) fn folder_of(file: &'static str) -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().map(move |path| {
        match path.file_name().is_some_and(|name| name == file) && path.is_file() {
            true => path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")).to_path_buf(),
            false => path,
        }
    })
}

/// A matrix, or its `zarr.json`; a material stays.
pub(super) fn matrix() -> impl TypedValueParser<Value = PathBuf> {
    folder_of("zarr.json")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn things_are_told_by_the_files_that_make_them() {
        let dir = tempfile::tempdir().unwrap();
        for (file, thing) in [
            ("capture.toml", Thing::Capture),
            ("plan.toml", Thing::Plan),
            ("rig.toml", Thing::Rig),
            ("zarr.json", Thing::Matrix),
            ("IMG_1.JPG", Thing::Photographs),
        ] {
            let folder = dir.path().join(file.replace('.', "-"));
            std::fs::create_dir(&folder).unwrap();
            assert_eq!(Thing::at(&folder), None);
            std::fs::write(folder.join(file), "").unwrap();
            assert_eq!(Thing::at(&folder), Some(thing));
        }
        let material = dir.path().join("m.acq");
        std::fs::write(&material, "").unwrap();
        assert_eq!(Thing::at(&material), Some(Thing::Material));
        assert_eq!(Thing::at(&dir.path().join("none")), None);
    }
}
