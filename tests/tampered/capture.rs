//! A copy of a capture that may be changed: its shots, its photographs, its sensor, its two files of text.

use crate::common;
use crate::data::{Exposures, Selection, Which};
use crate::picture::Picture;
use crate::sensor::Sensor;
use std::path::{Path, PathBuf};

pub(crate) struct Capture {
    pub dir: PathBuf,
    pub manifest: toml::Table,
    pub rig: toml::Table,
    pub sensor: Sensor,
    pub shots: Vec<Shot>,
}

pub(crate) struct Shot {
    pub name: String,
    pub kind: String,
    /// Axis and bit of a Gray code that is not inverted.
    plain_stripes: Option<(String, i64)>,
    /// The shortest first.
    pub photographs: Vec<Entry>,
}

#[derive(Debug, Clone)]
pub(crate) struct Entry {
    pub file: String,
    pub secs: f64,
}

/// A photograph: number of its shot, number of its exposure.
pub(crate) type Place = (usize, usize);

impl Capture {
    /// Copies by links: a file is replaced before it is changed.
    pub(crate) fn copy(from: &Path, to: &Path) -> Self {
        common::lay_folder(from, to, &|file, target| {
            std::fs::hard_link(file, target).or_else(|_| std::fs::copy(file, target).map(|_| ()))
        });
        // Mistakes of the laboratory, not damage to files: those are noticed by their checksums.
        let _ = std::fs::remove_file(to.join("photographs.b3"));
        let read = |name: &str| std::fs::read_to_string(to.join(name)).unwrap().parse::<toml::Table>().unwrap();
        let (manifest, rig) = (read("capture.toml"), read("calibration/rig.toml"));
        let sensor = Sensor::of(&rig).expect("a rig with [noise]");
        let shots = manifest["shots"].as_array().unwrap().iter().map(|shot| Shot::read(to, shot)).collect();
        Self { dir: to.to_owned(), manifest, rig, sensor, shots }
    }

    /// Writes the two files of text.
    pub(crate) fn save(&self) {
        let write = |name: &str, table: &toml::Table| {
            crate::picture::replace(&self.dir.join(name), toml::to_string(table).unwrap().as_bytes());
        };
        write("capture.toml", &self.manifest);
        write("calibration/rig.toml", &self.rig);
    }

    pub(crate) fn path(&self, (shot, exposure): Place) -> PathBuf {
        self.dir.join(&self.shots[shot].photographs[exposure].file)
    }

    pub(crate) fn secs(&self, (shot, exposure): Place) -> f64 {
        self.shots[shot].photographs[exposure].secs
    }

    pub(crate) fn read(&self, place: Place) -> Picture {
        Picture::read(&self.path(place))
    }

    /// Numbers of the shots of these kinds that are meant, in their order.
    pub(crate) fn chosen_shots(&self, kinds: &[String], which: Which) -> Vec<usize> {
        let of_kind = |k: &usize| kinds.iter().any(|kind| kind == "all" || *kind == self.shots[*k].kind);
        let all: Vec<usize> = (0..self.shots.len()).filter(of_kind).collect();
        assert!(!all.is_empty(), "the capture has no shot of {kinds:?}");
        let inner = |share: f64| ((share * all.len() as f64) as usize).min(all.len().saturating_sub(2)).max(1);
        match which {
            Which::All => all,
            Which::EverySecond => all.into_iter().skip(1).step_by(2).collect(),
            Which::At(_) if all.len() < 3 => all[..1].to_vec(),
            Which::At(share) => vec![all[inner(share)]],
            Which::From(share) => all[inner(share)..].to_vec(),
            Which::FinestInverse => vec![self.chosen_shots(kinds, Which::Finest)[0] + 1],
            Which::Finest => {
                let stripes = |k: &&usize| self.shots[**k].plain_stripes.clone().map(|(axis, bit)| (bit, axis));
                let finest = all.iter().filter(|k| stripes(k).is_some()).min_by_key(stripes);
                vec![*finest.expect("Gray code")]
            }
        }
    }

    /// The photographs that are meant, shot by shot, the shortest exposure first.
    pub(crate) fn chosen(&self, selection: &Selection) -> Vec<Place> {
        let exposures = |shot: usize| {
            let last = self.shots[shot].photographs.len() - 1;
            let range = match selection.exposures {
                Exposures::All => 0..last + 1,
                Exposures::Shortest => 0..1,
                Exposures::Middle => last / 2..last / 2 + 1,
                Exposures::Longest => last..last + 1,
            };
            range.map(move |exposure| (shot, exposure))
        };
        self.chosen_shots(&selection.of, selection.which).into_iter().flat_map(exposures).collect()
    }

    /// The shot of the same kind so many before this one, or after it.
    pub(crate) fn beside(&self, shot: usize, after: bool, shots: usize) -> Option<usize> {
        let alike = |&k: &usize| self.shots[k].kind == self.shots[shot].kind;
        let nth = shots - 1;
        if after { (shot + 1..self.shots.len()).filter(alike).nth(nth) } else { (0..shot).rev().filter(alike).nth(nth) }
    }

    /// DN above black; where it is saturated, what the shorter exposures of the shot say.
    pub(crate) fn light(&self, (shot, exposure): Place) -> Vec<f64> {
        let light =
            |e: usize| -> Vec<f64> { self.read((shot, e)).codes.iter().map(|&c| self.sensor.light(c)).collect() };
        let mut found = light(exposure);
        let mut open: Vec<usize> = (0..found.len()).filter(|&k| self.sensor.saturated(found[k])).collect();
        for shorter in (0..exposure).rev() {
            if open.is_empty() {
                break;
            }
            let ratio = self.secs((shot, exposure)) / self.secs((shot, shorter));
            let below = light(shorter);
            let (known, still): (Vec<_>, Vec<_>) = open.into_iter().partition(|&k| !self.sensor.saturated(below[k]));
            known.iter().for_each(|&k| found[k] = found[k].max(ratio * below[k]));
            open = still;
        }
        found
    }

    /// Relative sensitivity over the picture, as docs/captures.md defines it.
    pub(crate) fn sensitivity(&self) -> impl Fn(usize, usize) -> f64 + use<> {
        let camera = &self.rig["camera"];
        let floats = |name: &str| -> Vec<f64> {
            let list = camera.get(name).and_then(|v| v.as_array());
            list.map(|list| list.iter().map(|v| v.as_float().unwrap()).collect()).unwrap_or_default()
        };
        let (centre, terms) = (floats("principal_px"), floats("vignetting"));
        let focal = camera["focal_px"].as_float().unwrap();
        move |x, y| {
            let r2 = ((x as f64 - centre[0]).powi(2) + (y as f64 - centre[1]).powi(2)) / (focal * focal);
            1.0 + terms.iter().rev().fold(0.0, |sum, c| (sum + c) * r2)
        }
    }

    /// The entry of a photograph in capture.toml.
    pub(crate) fn entry(&mut self, (shot, exposure): Place) -> &mut toml::Table {
        let file = self.shots[shot].photographs[exposure].file.clone();
        let shots = self.manifest["shots"].as_array_mut().unwrap();
        let mut entries = shots[shot]["photographs"].as_array_mut().unwrap().iter_mut();
        entries.find(|e| e["file"].as_str() == Some(&file)).unwrap().as_table_mut().unwrap()
    }
}

impl Shot {
    fn read(dir: &Path, shot: &toml::Value) -> Self {
        let text = |name: &str| shot[name].as_str().unwrap().to_owned();
        let entry = |entry: &toml::Value| {
            let file = entry["file"].as_str().unwrap().to_owned();
            let told = entry.get("exposure_secs").and_then(|v| v.as_float());
            let secs = told.or_else(|| Picture::read(&dir.join(&file)).exposure_secs()).expect("an exposure time");
            Entry { file, secs }
        };
        let mut photographs: Vec<Entry> = shot["photographs"].as_array().unwrap().iter().map(entry).collect();
        photographs.sort_by(|a, b| a.secs.total_cmp(&b.secs));
        let plain = shot.get("inverse").and_then(|v| v.as_bool()) == Some(false);
        let plain_stripes = plain.then(|| (text("axis"), shot["bit"].as_integer().unwrap()));
        Self { name: text("name"), kind: text("kind"), plain_stripes, photographs }
    }
}
