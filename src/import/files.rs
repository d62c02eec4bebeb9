//! The photographs of a camera's folder, in the order of shooting.

use crate::capture::{CameraSettings, Photograph};
use crate::words::count;
use crate::{Error, Result};
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// One photograph of the folder.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// The file.
    pub path: PathBuf,
    /// What its EXIF says, as far as there is any.
    pub settings: CameraSettings,
    /// Its size; `None` when its head cannot be read.
    pub size_px: Option<[usize; 2]>,
}

/// What lies in a folder.
#[derive(Debug, Clone, PartialEq)]
pub struct Listing {
    /// The photographs that are taken, unsorted.
    pub taken: Vec<Found>,
    /// Their ending, in lower case.
    pub kind: String,
    /// Photographs of other kinds (the JPEG beside the RAW), which are left.
    pub left: usize,
    /// Hidden files, sidecars and everything else that is no photograph.
    pub ignored: usize,
}

/// Endings of photographs, those that keep most of the sensor's numbers first; spellings of one kind together.
const KINDS: [&[&str]; 15] = [
    &["dng"],
    &["cr3"],
    &["cr2"],
    &["nef"],
    &["arw"],
    &["raf"],
    &["rw2"],
    &["orf"],
    &["pef"],
    &["srw"],
    &["tif", "tiff"],
    &["png"],
    &["exr"],
    &["jpg", "jpeg"],
    &["heic", "heif"],
];

/// Lists the photographs in `folder` and its folders. Of several kinds the one with most files is taken, of equals the
/// first that this program reads in the order RAW, TIFF, PNG, EXR, JPEG; `take` (an ending) names another.
///
/// # Errors
/// [`Error::Io`]; [`Error::Setting`] when there is no photograph, or none of the kind that was named.
pub fn list(folder: &Path, take: Option<&str>) -> Result<Listing> {
    let (mut files, mut ignored) = (Vec::new(), 0);
    walk(folder, 0, &mut files, &mut ignored)?;
    let mut kinds: BTreeMap<usize, Vec<PathBuf>> = BTreeMap::new();
    for path in files {
        match kind_of(&ending(&path)) {
            Some(kind) => kinds.entry(kind).or_default().push(path),
            None => ignored += 1,
        }
    }
    let chosen = match take {
        None => {
            let mut order: Vec<(usize, usize)> = kinds.iter().map(|(&kind, paths)| (paths.len(), kind)).collect();
            order.sort_by_key(|&(n, kind)| (std::cmp::Reverse(n), kind));
            let most = order.first().map_or(0, |o| o.0);
            let readable = |kind: usize| kinds[&kind].first().is_some_and(|p| size_px(p).is_some());
            let equals = || order.iter().filter(|o| o.0 == most).map(|o| o.1);
            equals().find(|&kind| readable(kind)).or_else(|| equals().next())
        }
        Some(name) => {
            let kind = kind_of(&name.trim_start_matches('.').to_ascii_lowercase());
            let kind = kind.filter(|kind| kinds.contains_key(kind));
            Some(kind.ok_or_else(|| Error::Setting {
                setting: "take",
                expected: format!("the ending of a photograph in the folder ({})", names(kinds.keys())),
                found: name.to_owned(),
            })?)
        }
    };
    let Some(chosen) = chosen else {
        return Err(Error::Setting {
            setting: "FOLDER",
            expected: "a folder of photographs".into(),
            found: format!("none in {} ({})", folder.display(), count(ignored, "other file")),
        });
    };
    let left = kinds.iter().filter(|(kind, _)| **kind != chosen).map(|(_, paths)| paths.len()).sum();
    let paths = kinds.remove(&chosen).unwrap_or_default();
    let taken = paths.into_par_iter().map(|path| {
        let settings = CameraSettings::read(&path).map_err(Error::io("read", &path))?.unwrap_or_default();
        let size_px = size_px(&path);
        Ok(Found { path, settings, size_px })
    });
    Ok(Listing { taken: taken.collect::<Result<_>>()?, kind: KINDS[chosen][0].to_owned(), left, ignored })
}

/// Folders in a folder are followed so deep: DCIM/100CANON.
const DEEPEST: usize = 3;

fn walk(folder: &Path, depth: usize, files: &mut Vec<PathBuf>, ignored: &mut usize) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(Error::io("read", folder))? {
        let entry = entry.map_err(Error::io("read", folder))?;
        let path = entry.path();
        if entry.file_name().to_string_lossy().starts_with('.') {
            *ignored += 1;
        } else if path.is_dir() {
            if depth < DEEPEST {
                walk(&path, depth + 1, files, ignored)?;
            }
        } else {
            files.push(path);
        }
    }
    Ok(())
}

fn size_px(path: &Path) -> Option<[usize; 2]> {
    Photograph::new(path, "", 0.0).size_px().ok()
}

fn ending(path: &Path) -> String {
    path.extension().map_or(String::new(), |e| e.to_string_lossy().to_ascii_lowercase())
}

fn kind_of(ending: &str) -> Option<usize> {
    KINDS.iter().position(|k| k.contains(&ending))
}

fn names<'a>(kinds: impl Iterator<Item = &'a usize>) -> String {
    kinds.map(|&k| KINDS[k][0]).collect::<Vec<_>>().join(", ")
}

/// The order of shooting by the numbers in the names: folder by folder, 2 before 10, and 9999 before 0001 where the
/// counter began anew.
pub fn by_number(mut photographs: Vec<Found>) -> Vec<Found> {
    let wraps: Vec<(PathBuf, u64)> = wraps(&photographs);
    photographs.sort_by_cached_key(|p| {
        let folder = p.path.parent().unwrap_or(Path::new("")).to_path_buf();
        let (prefix, number, digits) = numbered(&p.path);
        // Numbers up to the half are those after the counter began anew.
        let round = wraps.iter().any(|w| w.0 == folder && number < w.1 / 2);
        let number = number + if round { 10u64.saturating_pow(digits as u32) } else { 0 };
        (natural(&folder.to_string_lossy()), prefix, number, p.path.clone())
    });
    photographs
}

/// The order of shooting by the camera's clock, and by number where it stood still; `None` when a photograph has no
/// time.
pub fn by_time(photographs: Vec<Found>) -> Option<Vec<Found>> {
    if photographs.iter().any(|p| p.settings.taken_secs.is_none()) {
        return None;
    }
    let mut photographs = by_number(photographs);
    let time = |p: &Found| p.settings.taken_secs.unwrap_or(0.0);
    // Stable: equal times stay in the order of their numbers.
    photographs.sort_by(|a, b| time(a).total_cmp(&time(b)));
    Some(photographs)
}

/// Folders in which the camera's counter began anew, with the number after its last: both its last and its first number
/// are there, and a gap between.
fn wraps(photographs: &[Found]) -> Vec<(PathBuf, u64)> {
    let mut folders: BTreeMap<PathBuf, Vec<(u64, usize)>> = BTreeMap::new();
    for p in photographs {
        let (_, number, digits) = numbered(&p.path);
        folders.entry(p.path.parent().unwrap_or(Path::new("")).to_path_buf()).or_default().push((number, digits));
    }
    let wrap = |(folder, numbers): (PathBuf, Vec<(u64, usize)>)| {
        let digits = numbers.first()?.1;
        let end = 10u64.checked_pow(digits as u32)?;
        let has = |n: u64| numbers.iter().any(|v| v.0 == n);
        let begins_anew = digits >= 2
            && numbers.iter().all(|v| v.1 == digits)
            && has(end - 1)
            && (has(0) || has(1))
            && (numbers.len() as u64) < end - 1;
        begins_anew.then_some((folder, end))
    };
    folders.into_iter().filter_map(wrap).collect()
}

/// What precedes the last number of a file's name, that number, and its digits.
fn numbered(path: &Path) -> (String, u64, usize) {
    let stem = path.file_stem().map_or(String::new(), |s| s.to_string_lossy().into_owned());
    let end = stem.rfind(|c: char| c.is_ascii_digit()).map_or(0, |k| k + 1);
    let start = stem[..end]
        .rfind(|c: char| !c.is_ascii_digit())
        .map_or(0, |k| k + stem[k..].chars().next().map_or(1, char::len_utf8));
    let digits = &stem[start..end];
    (stem[..start].to_lowercase(), digits.parse().unwrap_or(0), digits.len())
}

/// A text in pieces that sort as people do: numbers by their size.
fn natural(text: &str) -> Vec<(String, u64)> {
    let mut pieces = vec![(String::new(), 0u64)];
    let mut in_number = false;
    for c in text.chars() {
        match c.to_digit(10) {
            Some(d) => {
                in_number = true;
                if let Some(last) = pieces.last_mut() {
                    last.1 = last.1.saturating_mul(10).saturating_add(u64::from(d));
                }
            }
            None => {
                if in_number {
                    pieces.push((String::new(), 0));
                    in_number = false;
                }
                if let Some(last) = pieces.last_mut() {
                    last.0.push(c);
                }
            }
        }
    }
    pieces
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(path: &str, taken_secs: Option<f64>) -> Found {
        let settings = CameraSettings { taken_secs, ..CameraSettings::default() };
        Found { path: path.into(), settings, size_px: None }
    }

    fn paths(photographs: Vec<Found>) -> Vec<String> {
        photographs.into_iter().map(|p| p.path.to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn numbers_sort_by_size_and_go_on_after_the_last_of_the_counter() {
        let sorted = |names: &[&str]| paths(by_number(names.iter().map(|n| found(n, None)).collect()));
        assert_eq!(sorted(&["a/10.jpg", "a/9.jpg"]), ["a/9.jpg", "a/10.jpg"]);
        let wrapped = ["IMG_9998.JPG", "IMG_9999.JPG", "IMG_0001.JPG", "IMG_0002.jpg"];
        let mut mixed = wrapped;
        mixed.reverse();
        assert_eq!(sorted(&mixed), wrapped);
        assert_eq!(
            sorted(&["IMG_9998.JPG", "IMG_0002.JPG"]),
            ["IMG_0002.JPG", "IMG_9998.JPG"],
            "no counter that began anew"
        );
        assert_eq!(sorted(&["101CANON/IMG_0001.CR2", "99CANON/IMG_9999.CR2"])[0], "99CANON/IMG_9999.CR2");
        assert_eq!(sorted(&["ü7é.jpg", "ü6é.jpg"]), ["ü6é.jpg", "ü7é.jpg"]);
    }

    #[test]
    fn the_clock_rules_and_numbers_decide_within_a_second() {
        let names = [("IMG_0001.JPG", 9.0), ("IMG_9998.JPG", 7.0), ("IMG_9999.JPG", 9.0), ("IMG_0002.JPG", 9.5)];
        let sorted = by_time(names.iter().map(|(n, t)| found(n, Some(*t))).collect()).unwrap();
        assert_eq!(paths(sorted), ["IMG_9998.JPG", "IMG_9999.JPG", "IMG_0001.JPG", "IMG_0002.JPG"]);
        assert_eq!(by_time(vec![found("a", None)]), None);
    }
}
