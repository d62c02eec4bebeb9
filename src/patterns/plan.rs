//! `plan.toml`: a capture that is still to be shot. Field by field in `docs/captures.md`.

use crate::capture::{
    Capture, FORMAT, Grid, Manifest, Pattern, PhotographEntry, ReferenceDots, Shot, Slab, Window, parse_toml,
};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The file's name.
pub const PLAN_FILE: &str = "plan.toml";

/// The whole of `plan.toml`: `capture.toml` with exposures in the place of photographs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// Version of this format: 1.
    pub format: u32,
    /// A name for people.
    pub name: String,
    /// The sample.
    pub slab: Slab,
    /// The lit points.
    pub grid: Grid,
    /// The outgoing samples around each.
    pub window: Window,
    /// Dots on the frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_dots: Option<ReferenceDots>,
    /// What is to be projected, in the order of shooting.
    pub shots: Vec<PlannedShot>,
}

/// One pattern that is to be photographed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlannedShot {
    /// A unique name for people and messages; the photographs get it.
    pub name: String,
    /// What is projected, onto what.
    #[serde(flatten)]
    pub pattern: Pattern,
    /// The picture to project, relative to the plan's folder; `None` when it is made elsewhere.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub picture: Option<String>,
    /// The bracket, s, in the order of shooting.
    pub exposures_secs: Vec<f64>,
}

/// Exposures of a bracket nearer than this are one: cameras' steps are a third of a stop, a quarter.
const LEAST_STEP: f64 = 1.1;

impl Plan {
    /// Reads and checks `plan.toml` in `dir`.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Field`], [`Error::DotOutsideSlab`] for a dot outside the grid.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join(PLAN_FILE);
        let text = crate::files::read_to_string(&path).map_err(Error::io("read", &path))?;
        let plan: Self = parse_toml(&path, &text)?;
        plan.check(&path)?;
        Ok(plan)
    }

    /// Writes `plan.toml` into `dir`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dir: &Path) -> Result<()> {
        let path = dir.join(PLAN_FILE);
        let text = toml::to_string(self).map_err(Error::internal)?;
        std::fs::write(&path, text).map_err(Error::io("write", &path))
    }

    /// The plan by which a capture could be shot again: its shots in the order of its manifest, shortest exposures
    /// first.
    pub fn of_capture(capture: &Capture) -> Self {
        let m = &capture.manifest;
        let shots = m.shots.iter().zip(&capture.brackets).map(|(shot, bracket)| PlannedShot {
            name: shot.name.clone(),
            pattern: shot.pattern.clone(),
            picture: None,
            exposures_secs: bracket.iter().map(|p| p.exposure_secs).collect(),
        });
        Self {
            format: FORMAT,
            name: m.name.clone(),
            slab: m.slab.clone(),
            grid: m.grid.clone(),
            window: m.window.clone(),
            reference_dots: m.reference_dots.clone(),
            shots: shots.collect(),
        }
    }

    /// The manifest once the photographs are there; `entries` gives those of shot s.
    pub fn manifest(&self, entries: impl Fn(usize) -> Vec<PhotographEntry>) -> Manifest {
        let shot = |(s, planned): (usize, &PlannedShot)| Shot {
            name: planned.name.clone(),
            pattern: planned.pattern.clone(),
            photographs: entries(s),
        };
        Manifest {
            format: FORMAT,
            name: self.name.clone(),
            slab: self.slab.clone(),
            grid: self.grid.clone(),
            window: self.window.clone(),
            reference_dots: self.reference_dots.clone(),
            shots: self.shots.iter().enumerate().map(shot).collect(),
        }
    }

    /// Number of photographs.
    pub fn photographs(&self) -> usize {
        self.shots.iter().map(|s| s.exposures_secs.len()).sum()
    }

    /// Time for all photographs, s, when the camera takes `overhead_secs` for each besides its exposure.
    pub fn shooting_secs(&self, overhead_secs: f64) -> f64 {
        self.shots.iter().flat_map(|s| &s.exposures_secs).map(|t| t + overhead_secs).sum()
    }

    /// Refuses what could never become a capture.
    ///
    /// # Errors
    /// As [`Self::read`]; they name `path`.
    pub fn check(&self, path: &Path) -> Result<()> {
        if self.format != FORMAT {
            return Err(Error::field(path, "format", FORMAT.to_string(), self.format));
        }
        for shot in &self.shots {
            let field = format!("shots \"{}\": exposures_secs", shot.name);
            if shot.exposures_secs.is_empty() {
                return Err(Error::field(path, field, "at least one", "none"));
            }
            if shot.name.is_empty() || shot.name.contains(['/', '\\', '\0']) || shot.name.starts_with('.') {
                let expected = "a name that can begin a file's";
                return Err(Error::field(path, "shots: name", expected, format!("{:?}", shot.name)));
            }
            let mut times = shot.exposures_secs.clone();
            times.sort_by(f64::total_cmp);
            if let Some(pair) = times.windows(2).find(|p| p[1] / p[0] < LEAST_STEP) {
                let found = format!("{} and {}", pair[0], pair[1]);
                return Err(Error::field(path, field, "exposures that differ by a tenth", found));
            }
        }
        let entries = |s: usize| {
            let each = self.shots[s].exposures_secs.iter();
            each.map(|&t| PhotographEntry { file: String::new(), exposure_secs: Some(t) }).collect()
        };
        self.manifest(entries).check(path)
    }
}
