//! What the settings of all photographs say together: EXIF, exposures, order.

use super::{CameraSettings, Manifest, Pattern};
use crate::CaptureWarning;
use crate::warning::bounds::SAME_EXPOSURE;
use std::collections::BTreeMap;

/// A photograph of a shot with what is known of how it was taken.
pub(crate) struct Taken {
    /// Its shot's index.
    pub shot: usize,
    /// As `capture.toml` names it.
    pub file: String,
    /// Exposure by `capture.toml`, else EXIF.
    pub exposure_secs: Option<f64>,
    /// What EXIF says.
    pub settings: Option<CameraSettings>,
}

impl Taken {
    /// Whether EXIF tells any of the settings that should stay.
    pub(crate) fn has_settings(&self) -> bool {
        let any = |s: &CameraSettings| {
            let chosen = s.automatic_exposure.is_some() || s.automatic_white_balance.is_some();
            chosen || s.iso.is_some() || s.f_number.is_some() || s.focal_mm.is_some()
        };
        self.settings.as_ref().is_some_and(any)
    }

    /// Whether EXIF tells nothing of use: the file has no EXIF block, or only the tags that every TIFF has.
    fn tells_nothing(&self) -> bool {
        let exposure = self.settings.as_ref().and_then(|s| s.exposure_secs);
        exposure.is_none() && !self.has_settings() && self.taken_secs().is_none()
    }

    /// When it was taken, by the camera's clock.
    pub(crate) fn taken_secs(&self) -> Option<f64> {
        self.settings.as_ref().and_then(|s| s.taken_secs)
    }
}

/// What the photographs that are there say together.
pub(crate) fn findings(heads: &[Taken], manifest: &Manifest) -> Vec<CaptureWarning> {
    let mut found = Vec::new();
    let without: Vec<&Taken> = heads.iter().filter(|h| h.tells_nothing()).collect();
    if let Some(first) = without.first() {
        found.push(CaptureWarning::NoExif { file: first.file.clone(), photographs: without.len() });
    }
    let known: Vec<(&Taken, &CameraSettings)> = heads.iter().filter_map(|h| Some((h, h.settings.as_ref()?))).collect();
    let automatic: Vec<_> = known.iter().filter_map(|(h, s)| Some((h, s.automatic_exposure.as_ref()?))).collect();
    if let Some((head, program)) = automatic.first() {
        let (file, program) = (head.file.clone(), (*program).clone());
        found.push(CaptureWarning::AutomaticExposure { file, photographs: automatic.len(), program });
    }
    let balance: Vec<_> = known.iter().filter(|(_, s)| s.automatic_white_balance == Some(true)).collect();
    if let Some((head, _)) = balance.first() {
        found.push(CaptureWarning::AutomaticWhiteBalance { file: head.file.clone(), photographs: balance.len() });
    }
    let decimal = |v: Option<f64>| v.map(|v| format!("{}", (v * 100.0).round() / 100.0));
    type Read<'a> = &'a dyn Fn(&CameraSettings) -> Option<String>;
    let settings: [(&str, Read); 4] = [
        ("ISO", &|s| decimal(s.iso)),
        ("f-number", &|s| decimal(s.f_number)),
        ("focal length", &|s| decimal(s.focal_mm).map(|v| format!("{v} mm"))),
        ("camera", &|s| s.camera.clone()),
    ];
    found.extend(settings.iter().filter_map(|(name, read)| changes(name, &known, read)));
    found.extend(bracket_differs(heads, manifest));
    found.extend(out_of_order(heads, manifest));
    found
}

fn changes(
    setting: &str,
    known: &[(&Taken, &CameraSettings)],
    read: &dyn Fn(&CameraSettings) -> Option<String>,
) -> Option<CaptureWarning> {
    let values: Vec<(&Taken, String)> = known.iter().filter_map(|(h, s)| Some((*h, read(s)?))).collect();
    let expected = most(values.iter().map(|(_, v)| v))?;
    let mut others = values.iter().filter(|(_, v)| *v != expected);
    let (head, found) = others.next()?;
    let (setting, file, found) = (setting.to_owned(), head.file.clone(), found.clone());
    Some(CaptureWarning::SettingChanges { setting, file, photographs: 1 + others.count(), expected, found })
}

/// The value that occurs most often; of equals the first in order.
fn most<'a, T: Ord + Clone + 'a>(values: impl Iterator<Item = &'a T>) -> Option<T> {
    let mut counts: BTreeMap<&T, usize> = BTreeMap::new();
    values.for_each(|v| *counts.entry(v).or_default() += 1);
    let largest = *counts.values().max()?;
    counts.into_iter().find(|(_, n)| *n == largest).map(|(v, _)| v.clone())
}

/// Exposures of each lattice shot, shortest first.
fn lattice_brackets(heads: &[Taken], manifest: &Manifest) -> BTreeMap<usize, Vec<f64>> {
    let mut brackets: BTreeMap<usize, Vec<f64>> = BTreeMap::new();
    for head in heads {
        if matches!(manifest.shots[head.shot].pattern, Pattern::Lattice { .. }) {
            brackets.entry(head.shot).or_default().extend(head.exposure_secs);
        }
    }
    brackets.values_mut().for_each(|b| b.sort_by(f64::total_cmp));
    brackets
}

fn usual_bracket(brackets: &BTreeMap<usize, Vec<f64>>) -> Option<Vec<f64>> {
    // Times are positive: their bits are in their order.
    let keys: Vec<Vec<u64>> = brackets.values().map(|b| b.iter().map(|t| t.to_bits()).collect()).collect();
    Some(most(keys.iter())?.into_iter().map(f64::from_bits).collect())
}

fn bracket_differs(heads: &[Taken], manifest: &Manifest) -> Option<CaptureWarning> {
    let brackets = lattice_brackets(heads, manifest);
    let expected = usual_bracket(&brackets)?;
    let same = |b: &[f64]| {
        b.len() == expected.len() && b.iter().zip(&expected).all(|(a, b)| (a / b - 1.0).abs() < SAME_EXPOSURE)
    };
    let mut others = brackets.iter().filter(|(_, b)| !same(b));
    let (&shot, found_secs) = others.next()?;
    let shot = manifest.shots[shot].name.clone();
    Some(CaptureWarning::BracketDiffers {
        shot,
        shots: 1 + others.count(),
        found_secs: found_secs.clone(),
        expected_secs: expected,
    })
}

/// Shots that begin before an earlier one of the manifest has ended, by the camera's clock.
fn out_of_order(heads: &[Taken], manifest: &Manifest) -> Option<CaptureWarning> {
    let mut spans: BTreeMap<usize, [(f64, &Taken); 2]> = BTreeMap::new();
    for head in heads {
        let Some(t) = head.taken_secs() else { continue };
        let [first, last] = spans.entry(head.shot).or_insert([(t, head); 2]);
        if t < first.0 {
            *first = (t, head);
        }
        if t > last.0 {
            *last = (t, head);
        }
    }
    let mut latest: Option<(f64, &Taken)> = None;
    let (mut first, mut shots, mut lattice) = (None, 0, false);
    for (&shot, &[begin, end]) in &spans {
        if let Some(before) = latest.filter(|l| begin.0 < l.0) {
            first.get_or_insert((begin.1.file.clone(), before.1.file.clone()));
            shots += 1;
            lattice |= matches!(manifest.shots[shot].pattern, Pattern::Lattice { .. });
        }
        latest = latest.filter(|l| l.0 > end.0).or(Some(end));
    }
    let (file, after_file) = first?;
    Some(CaptureWarning::OutOfOrder { file, after_file, shots, lattice })
}

/// The exposures of most lattice shots, s, shortest first.
pub(crate) fn lattice_exposures(heads: &[Taken], manifest: &Manifest) -> Vec<f64> {
    usual_bracket(&lattice_brackets(heads, manifest)).unwrap_or_default()
}
