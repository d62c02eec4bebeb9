//! A whole capture folder, checked before any work starts.

use super::exif::{self, ExifExposure, ExposureFrom};
use super::manifest::{LEAST_SECS, MOST_SECS};
use super::together::{self, Taken};
use super::{CameraSettings, Kept, Manifest, Pattern, Photograph, ResponseCurve, Rig};
use crate::warning::bounds::EXPOSURE_TOLERANCE;
use crate::{CaptureWarning, Error, Result, geometry::Point};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// A capture whose manifest, rig and photographs' heads have been read and fit together.
#[derive(Debug, Clone)]
pub struct Capture {
    /// Its folder.
    pub dir: PathBuf,
    /// `capture.toml`.
    pub manifest: Manifest,
    /// `rig.toml`.
    pub rig: Rig,
    /// Where the rig was found.
    pub rig_path: PathBuf,
    /// The photographs of each shot of the manifest, shortest exposure first.
    pub brackets: Vec<Vec<Photograph>>,
    /// Findings.
    pub warnings: Vec<CaptureWarning>,
}

/// Exposure times that are off by the same factor, to this, are off by one cause.
const SAME_RATIO: f64 = 0.01;

impl Capture {
    /// The name of a file as capture.toml gives it.
    pub(crate) fn name_of(&self, path: &Path) -> String {
        path.strip_prefix(&self.dir).unwrap_or(path).display().to_string()
    }

    /// [`Self::open_with`] exposure times from EXIF.
    ///
    /// # Errors
    /// Those of [`Self::open_with`].
    pub fn open(dir: &Path, calibration: Option<&Path>) -> Result<Self> {
        Self::open_with(dir, calibration, ExposureFrom::Exif)
    }

    /// Reads and checks a capture: manifest, rig, presence, size and exposure of every photograph. No pixels are
    /// decoded.
    ///
    /// # Errors
    /// Those of [`Manifest::read`], [`Rig::find`] and [`Rig::read`]; [`Error::MissingPhotograph`],
    /// [`Error::BrokenPhotograph`], [`Error::NoExposure`], [`Error::SameExposure`]; [`Error::Field`] for a photograph
    /// of another size or a shot that is needed and not there.
    pub fn open_with(dir: &Path, calibration: Option<&Path>, exposure_from: ExposureFrom) -> Result<Self> {
        if !crate::files::is_folder(dir) {
            let missing = std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such folder");
            return Err(Error::io("read", dir)(missing));
        }
        let manifest = Manifest::read(dir)?;
        let rig_path = Rig::find(dir, calibration)?;
        let rig = Rig::read(&rig_path)?;
        let manifest_path = dir.join("capture.toml");
        require_shots(&manifest, &manifest_path)?;
        check_against_rig(&manifest, &rig, &manifest_path)?;

        let mut warnings = Vec::new();
        let heads: Vec<(Vec<Head>, Vec<CaptureWarning>)> = {
            let shots = manifest.shots.par_iter();
            shots.map(|shot| read_heads(dir, shot, rig.camera.size_px, exposure_from)).collect::<Result<_>>()?
        };
        if rig.camera.response_curve == ResponseCurve::Linear {
            warnings.extend(depth_differs(heads.iter().flat_map(|(heads, _)| heads)));
        }
        let first = heads.iter().flat_map(|(heads, _)| heads).next().map(|h| h.exif.clone()).unwrap_or_default();
        let taken: Vec<Taken> =
            heads.iter().enumerate().flat_map(|(shot, (heads, _))| heads.iter().map(move |h| h.taken(shot))).collect();
        let found = together::findings(&taken, &manifest);
        // Told with its values.
        let mut told = found.iter().any(|w| matches!(w, CaptureWarning::SettingChanges { setting, .. } if ["ISO", "f-number"].contains(&setting.as_str())));
        warnings.extend(found);
        let (mut brackets, kept) = (Vec::new(), Kept::default());
        for (mut shot_heads, mut found) in heads {
            gather(&mut warnings, &mut found);
            for head in &mut shot_heads {
                head.photograph.kept = kept.clone();
                let factor = relative_sensitivity(&head.exif, &first);
                head.photograph.effective_secs = head.photograph.exposure_secs * factor;
                let field = "exposure time · ISO / f-number²";
                Error::unless_within(&head.photograph.path, field, head.photograph.effective_secs, 1e-12, 1e9)?;
                if (factor - 1.0).abs() > 1e-6 && !told {
                    told = true;
                    warnings.push(CaptureWarning::ApertureOrIsoChanges { file: head.name.clone(), factor });
                }
            }
            brackets.push(sorted_bracket(shot_heads, &manifest_path)?);
        }
        Ok(Self { dir: dir.to_path_buf(), manifest, rig, rig_path, brackets, warnings })
    }

    /// Indices of the shots of a kind, in the manifest's order.
    pub fn shots(&self, of: impl Fn(&Pattern) -> bool) -> Vec<usize> {
        (0..self.manifest.shots.len()).filter(|&s| of(&self.manifest.shots[s].pattern)).collect()
    }

    /// Where its photographs are kept.
    pub(crate) fn kept(&self) -> Kept {
        self.brackets.iter().flatten().next().map(|p| p.kept.clone()).unwrap_or_default()
    }

    /// The path of `capture.toml`.
    pub fn manifest_path(&self) -> PathBuf {
        self.dir.join("capture.toml")
    }

    /// Number of photographs.
    pub fn photographs(&self) -> usize {
        self.brackets.iter().map(Vec::len).sum()
    }
}

struct Head {
    name: String,
    photograph: Photograph,
    bits: u8,
    exif: ExifExposure,
    settings: Option<CameraSettings>,
}

impl Head {
    fn taken(&self, shot: usize) -> Taken {
        Taken {
            shot,
            file: self.name.clone(),
            exposure_secs: Some(self.photograph.exposure_secs),
            settings: self.settings.clone(),
        }
    }
}

/// Adds findings; the same one of many photographs is said once, with their number.
fn gather(warnings: &mut Vec<CaptureWarning>, found: &mut Vec<CaptureWarning>) {
    use CaptureWarning::{DamagedExif, ExposureDisagrees, UnusableExif};
    for new in found.drain(..) {
        let known = warnings.iter_mut().find_map(|old| match (old, &new) {
            (DamagedExif { photographs, .. }, DamagedExif { .. }) => Some(photographs),
            (UnusableExif { tag, photographs, .. }, UnusableExif { tag: new, .. }) if tag == new => Some(photographs),
            (
                ExposureDisagrees { used_secs, other_secs, other, photographs, .. },
                ExposureDisagrees { used_secs: new_used, other_secs: new_secs, other: new_other, .. },
            ) if other == new_other
                && ((new_secs * *used_secs) / (*other_secs * new_used) - 1.0).abs() < SAME_RATIO =>
            {
                Some(photographs)
            }
            _ => None,
        });
        match known {
            Some(photographs) => *photographs += 1,
            None => warnings.push(new),
        }
    }
}

/// Photographs of 8 bits among others, or others among them.
fn depth_differs<'a>(heads: impl Iterator<Item = &'a Head>) -> Option<CaptureWarning> {
    let (eight, more): (Vec<&Head>, Vec<&Head>) = heads.partition(|h| h.bits == 8);
    let (fewer, most) = if eight.len() < more.len() { (eight, more) } else { (more, eight) };
    let (first, usual) = fewer.first().zip(most.first())?;
    Some(CaptureWarning::DepthDiffers {
        file: first.name.clone(),
        shot: first.photograph.shot.clone(),
        bits: first.bits,
        most_bits: usual.bits,
        photographs: fewer.len(),
    })
}

fn read_heads(
    dir: &Path,
    shot: &super::Shot,
    size_px: [usize; 2],
    exposure_from: ExposureFrom,
) -> Result<(Vec<Head>, Vec<CaptureWarning>)> {
    let mut warnings = Vec::new();
    let mut heads = Vec::new();
    for entry in &shot.photographs {
        let path = dir.join(&entry.file);
        let mut photograph = Photograph::new(path, &shot.name, 0.0);
        let (found, bits) = photograph.head()?;
        if found != size_px {
            return Err(Error::PhotographSize { path: photograph.path, expected: size_px, found });
        }
        let (exif, settings) =
            exif::read(&photograph.path, &entry.file, &mut warnings).map_err(Error::io("read", &photograph.path))?;
        let mut sources = [
            (entry.exposure_secs, "capture.toml"),
            (exif.exposure_secs, "EXIF ExposureTime"),
            (exif.apex_secs, "EXIF ShutterSpeedValue"),
        ];
        if exposure_from == ExposureFrom::Apex {
            sources.swap(1, 2);
        }
        let mut known = sources.iter().filter_map(|(secs, source)| Some(((*secs)?, *source)));
        let Some((used_secs, source)) = known.next() else {
            let damaged = |w: &&CaptureWarning| match w {
                CaptureWarning::DamagedExif { file, .. } | CaptureWarning::UnusableExif { file, .. } => {
                    *file == entry.file
                }
                _ => false,
            };
            let cause = warnings.iter().find(damaged).cloned();
            let error = Error::NoExposure { path: photograph.path };
            return Err(match cause {
                Some(cause) => Error::Explained { cause: Box::new(cause.into()), error: Box::new(error) },
                None => error,
            });
        };
        Error::unless_within(&photograph.path, source, used_secs, LEAST_SECS, MOST_SECS)?;
        for (other_secs, other) in known {
            if (other_secs / used_secs - 1.0).abs() > EXPOSURE_TOLERANCE {
                let (file, other) = (entry.file.clone(), other.to_owned());
                warnings.push(CaptureWarning::ExposureDisagrees { file, used_secs, other_secs, other, photographs: 1 });
            }
        }
        photograph.exposure_secs = used_secs;
        heads.push(Head { name: entry.file.clone(), photograph, bits, exif, settings });
    }
    Ok((heads, warnings))
}

/// Light gathered per second against the first photograph's settings: ISO over the square of the f-number.
fn relative_sensitivity(exif: &ExifExposure, first: &ExifExposure) -> f64 {
    let ratio = |a: Option<f64>, b: Option<f64>| a.zip(b).map_or(1.0, |(a, b)| a / b);
    ratio(exif.iso, first.iso) / ratio(exif.f_number, first.f_number).powi(2)
}

fn sorted_bracket(mut heads: Vec<Head>, manifest: &Path) -> Result<Vec<Photograph>> {
    heads.sort_by(|a, b| a.photograph.effective_secs.total_cmp(&b.photograph.effective_secs));
    for pair in heads.windows(2) {
        // Nominal times of neighbouring third stops differ by a quarter; nearer than a hundredth is the same.
        if pair[1].photograph.effective_secs / pair[0].photograph.effective_secs < 1.01 {
            let (mut first, mut second) = (pair[0].name.clone(), pair[1].name.clone());
            if first > second {
                std::mem::swap(&mut first, &mut second);
            }
            return Err(Error::SameExposure {
                path: manifest.to_path_buf(),
                shot: pair[0].photograph.shot.clone(),
                first,
                second,
                exposure_secs: pair[0].photograph.exposure_secs,
            });
        }
    }
    Ok(heads.into_iter().map(|h| h.photograph).collect())
}

/// What makes sense only for this camera and projector: a slip of the pen here would cost hours or all memory later.
fn check_against_rig(manifest: &Manifest, rig: &Rig, path: &Path) -> Result<()> {
    type Need = (&'static str, &'static str, bool, fn(&Pattern) -> bool);
    let needs: [Need; 3] = [
        ("calibration-board", "[board]", rig.board.is_some(), |p| matches!(p, Pattern::CalibrationBoard)),
        ("board", "[board]", rig.board.is_some(), |p| matches!(p, Pattern::Board)),
        ("frame", "[frame]", rig.frame.is_some(), |p| matches!(p, Pattern::Frame)),
    ];
    for (kind, table, there, of) in needs {
        if let Some(shot) = manifest.shots.iter().find(|s| of(&s.pattern) && !there) {
            let field = format!("shot \"{}\": kind = \"{kind}\"", shot.name);
            return Err(Error::field(path, field, format!("{table} in rig.toml"), "none"));
        }
    }
    let [width, height] = rig.projector.size_px;
    let projector = format!("the projector's {width} × {height} px (projector.size_px in rig.toml)");
    if manifest.grid.dot_projector_px > width.min(height) {
        let found = manifest.grid.dot_projector_px;
        return Err(Error::field(path, "grid.dot_projector_px", format!("a dot that fits {projector}"), found));
    }
    let inside = |field: String, at: Point| {
        if (0..2).all(|a| at[a] >= -0.5 && at[a] <= rig.projector.size_px[a] as f64 - 0.5) {
            return Ok(());
        }
        Err(Error::field(path, field, format!("a place in {projector}"), format!("({}, {})", at[0], at[1])))
    };
    for &at in manifest.reference_dots.iter().flat_map(|r| &r.projector_px) {
        inside("reference_dots.projector_px".into(), at)?;
    }
    let mut lit = 0;
    for shot in &manifest.shots {
        let Pattern::Lattice { dots } = &shot.pattern else { continue };
        lit += dots.len();
        for &dot in dots {
            inside(format!("shot \"{}\": dot {dot:?}", shot.name), manifest.grid.dot_projector_px(dot))?;
        }
    }
    if lit == 0 {
        return Err(Error::field(path, "shots of kind \"lattice\": dots", "at least one", "none"));
    }
    let points = manifest.grid.len();
    if points > POINTS_UNASKED && points / POINTS_PER_LIT > lit {
        let expected = format!("a grid of which the lattice shots light one point in {POINTS_PER_LIT} or more");
        let found = format!("{points} points, {lit} of them lit");
        return Err(Error::field(path, "grid.points", expected, found));
    }
    let largest = SAMPLES_PER_PX * rig.camera.size_px[0].max(rig.camera.size_px[1]);
    for samples in manifest.window.samples {
        if samples > largest {
            let expected = format!("at most {largest}, {SAMPLES_PER_PX} for each pixel across a photograph");
            return Err(Error::field(path, "window.samples", expected, samples));
        }
    }
    Ok(())
}

/// Grids up to this many points may be mostly unlit: the first shots of a long sweep, say.
const POINTS_UNASKED: usize = 1 << 16;
/// Beyond it one point in so many must be lit; a single lattice shot lights one in a few hundred.
const POINTS_PER_LIT: usize = 4096;
/// Finer windows would only repeat the photograph's pixels.
const SAMPLES_PER_PX: usize = 2;

fn require_shots(manifest: &Manifest, path: &Path) -> Result<()> {
    let count = |of: fn(&Pattern) -> bool| manifest.shots.iter().filter(|s| of(&s.pattern)).count();
    type Kind = (&'static str, fn(&Pattern) -> bool);
    let board = count(|p| matches!(p, Pattern::Board));
    if board > 1 || (board == 0 && count(|p| matches!(p, Pattern::Frame)) == 0) {
        let expected = "exactly one, or none and a shot of kind \"frame\"";
        return Err(Error::field(path, "shots of kind \"board\"", expected, board));
    }
    let white = count(|p| matches!(p, Pattern::ReferenceWhite));
    if !(1..=2).contains(&white) {
        let expected = "one, or a second after the lattice shots";
        return Err(Error::field(path, "shots of kind \"reference-white\"", expected, white));
    }
    let once: [Kind; 2] = [
        ("reference-black", |p| matches!(p, Pattern::ReferenceBlack)),
        ("sample-black", |p| matches!(p, Pattern::SampleBlack)),
    ];
    for (kind, of) in once {
        if count(of) != 1 {
            return Err(Error::field(path, format!("shots of kind \"{kind}\""), "exactly one", count(of)));
        }
    }
    let several: [Kind; 2] = [
        ("gray-code", |p| matches!(p, Pattern::GrayCode { .. })),
        ("lattice", |p| matches!(p, Pattern::Lattice { .. })),
    ];
    for (kind, of) in several {
        if count(of) == 0 {
            return Err(Error::field(path, format!("shots of kind \"{kind}\""), "at least one", "none"));
        }
    }
    let mut lit_by = std::collections::BTreeMap::new();
    for shot in &manifest.shots {
        let Pattern::Lattice { dots } = &shot.pattern else { continue };
        for dot in dots {
            if let Some(earlier) = lit_by.insert(dot, &shot.name) {
                let field = format!("shots \"{}\": dots", shot.name);
                return Err(Error::field(
                    path,
                    field,
                    "each dot in one shot only",
                    format!("{dot:?} also in \"{earlier}\""),
                ));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
