//! `capture.toml`: what was projected and which photographs show it. Field by field in `docs/captures.md`.

use crate::{Error, Result, geometry::Point};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The version of `capture.toml` that this program reads and writes.
pub const FORMAT: u32 = 1;

/// The shortest exposure that is believed, s.
pub(super) const LEAST_SECS: f64 = 1e-9;
/// The longest.
pub(super) const MOST_SECS: f64 = 1e6;

/// The whole of `capture.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of this format: 1.
    pub format: u32,
    /// A name for people.
    pub name: String,
    /// The sample.
    pub slab: Slab,
    /// The lit points.
    pub grid: Grid,
    /// The outgoing samples around each lit point.
    pub window: Window,
    /// Dots on the opaque frame that every lattice shot shows, from which drift is measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reference_dots: Option<ReferenceDots>,
    /// What was projected, shot by shot.
    pub shots: Vec<Shot>,
}

/// The sample's extent: it spans (0, 0) to `size_mm` in slab coordinates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Slab {
    /// Width and height, mm.
    pub size_mm: Point,
}

/// The lit points, laid out in projector pixels: the dot of grid index (i, j) is centred at `origin_projector_px + (i, j) · step_projector_px`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grid {
    /// Number of lit points along x and y.
    pub points: [usize; 2],
    /// Centre of dot (0, 0), projector px (centre of the first pixel is 0).
    pub origin_projector_px: Point,
    /// Distance between neighbouring lit points, projector px.
    pub step_projector_px: Point,
    /// Side of the square of projector pixels that makes a dot.
    pub dot_projector_px: usize,
}

impl Grid {
    /// Centre of dot `[i, j]`, projector px.
    pub fn dot_projector_px(&self, dot: [usize; 2]) -> Point {
        std::array::from_fn(|a| self.origin_projector_px[a] + dot[a] as f64 * self.step_projector_px[a])
    }

    /// The index of `dot` in row-major order (y, x).
    pub fn row_index(&self, dot: [usize; 2]) -> usize {
        dot[1] * self.points[0] + dot[0]
    }

    /// Number of lit points.
    pub fn len(&self) -> usize {
        self.points[0] * self.points[1]
    }

    /// Whether there are no lit points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// The outgoing samples of each row: cells of `pitch_mm` a side, centred on the lit point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Window {
    /// Samples along x and y, odd.
    pub samples: [usize; 2],
    /// Side of a cell, mm.
    pub pitch_mm: f64,
}

/// Dots on the opaque frame around the sample.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReferenceDots {
    /// Their centres, projector px.
    pub projector_px: Vec<Point>,
}

/// One projected pattern and its photographs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// A unique name for people and messages.
    pub name: String,
    /// What was projected, onto what.
    #[serde(flatten)]
    pub pattern: Pattern,
    /// The bracket, in any order.
    pub photographs: Vec<PhotographEntry>,
}

/// What a shot shows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Pattern {
    /// The chessboard of `rig.toml` in the slab's plane, projector white.
    Board,
    /// The same chessboard anywhere in view, in any pose: for the lens only.
    CalibrationBoard,
    /// The sample in its frame, projector white: the frame's marks of `rig.toml` give the plane. A second one tells movement.
    Frame,
    /// The white reference in the slab's plane, projector white.
    ReferenceWhite,
    /// The white reference in the slab's plane, projector black.
    ReferenceBlack,
    /// The sample in place, projector black: ambient light, the projector's black level.
    SampleBlack,
    /// One bit of the Gray code, on the white reference or on the sample in its frame.
    GrayCode {
        /// The projector axis that it encodes.
        axis: Axis,
        /// Bit number j: the pattern is bit j of n XOR (n >> 1), n the projector column (or row); stripes are 2^(j+1) px wide.
        bit: u32,
        /// Whether light and dark are exchanged.
        #[serde(default)]
        inverse: bool,
        /// What it falls on.
        #[serde(default, skip_serializing_if = "Surface::is_white_reference")]
        on: Surface,
    },
    /// A lattice of dots on the sample (and the reference dots on its frame).
    Lattice {
        /// Grid indices (x, y) of the lit points.
        dots: Vec<[usize; 2]>,
    },
}

/// What a pattern is projected on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Surface {
    /// The white reference in the slab's plane.
    #[default]
    WhiteReference,
    /// The sample in its opaque frame; only the frame is used.
    Frame,
}

impl Surface {
    fn is_white_reference(&self) -> bool {
        *self == Self::WhiteReference
    }
}

/// An axis of the projector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Axis {
    /// Columns.
    X,
    /// Rows.
    Y,
}

/// One photograph of a shot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PhotographEntry {
    /// File name, relative to the folder of `capture.toml`.
    pub file: String,
    /// Exposure time, s; overrides EXIF.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposure_secs: Option<f64>,
}

impl Manifest {
    /// Reads and checks `capture.toml` in `dir`.
    ///
    /// # Errors
    /// [`Error::NoManifest`], [`Error::Field`] (syntax, a missing or unknown field, a value out of range),
    /// [`Error::DotOutsideSlab`] for a dot outside the grid. Files of photographs are not looked at.
    pub fn read(dir: &Path) -> Result<Self> {
        let path = dir.join("capture.toml");
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && dir.is_dir() => {
                return Err(Error::NoManifest { path: dir.to_path_buf() });
            }
            Err(e) => return Err(Error::io("read", &path)(e)),
        };
        let manifest: Self = super::parse_toml(&path, &text)?;
        manifest.check(&path)?;
        Ok(manifest)
    }

    /// Writes `capture.toml` into `dir`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dir: &Path) -> Result<()> {
        let path = dir.join("capture.toml");
        let text = toml::to_string(self).map_err(Error::internal)?;
        std::fs::write(&path, text).map_err(Error::io("write", &path))
    }

    pub(crate) fn check(&self, path: &Path) -> Result<()> {
        let range = |name: &str, v: f64, low: f64, high: f64| Error::unless_within(path, name, v, low, high);
        if self.format != FORMAT {
            return Err(Error::field(path, "format", FORMAT.to_string(), self.format));
        }
        for a in 0..2 {
            range("slab.size_mm", self.slab.size_mm[a], 1e-6, 1e6)?;
            range("grid.origin_projector_px", self.grid.origin_projector_px[a], -1.0, 65_536.0)?;
            range("grid.step_projector_px", self.grid.step_projector_px[a], -65_536.0, 65_536.0)?;
            if self.grid.step_projector_px[a] == 0.0 {
                return Err(Error::field(path, "grid.step_projector_px", "numbers that are not 0", 0));
            }
            for dot in self.reference_dots.iter().flat_map(|r| &r.projector_px) {
                range("reference_dots.projector_px", dot[a], -1.0, 65_536.0)?;
            }
            if self.grid.points[a] == 0 || self.grid.points[a] > 65_536 {
                return Err(Error::field(path, "grid.points", "1 to 65536", self.grid.points[a]));
            }
            let w = self.window.samples[a];
            if w.is_multiple_of(2) || w > 4095 {
                return Err(Error::field(path, "window.samples", "odd numbers from 1 to 4095", w));
            }
        }
        range("window.pitch_mm", self.window.pitch_mm, 1e-6, 1e6)?;
        range("grid.dot_projector_px", self.grid.dot_projector_px as f64, 1.0, 65_536.0)?;
        let mut names = std::collections::BTreeSet::new();
        for shot in &self.shots {
            let field = |name: &str| format!("shots \"{}\": {name}", shot.name);
            if !names.insert(&shot.name) {
                return Err(Error::field(path, field("name"), "unique names", "it twice"));
            }
            if shot.photographs.is_empty() {
                return Err(Error::field(path, field("photographs"), "at least one", "none"));
            }
            for photograph in &shot.photographs {
                if let Some(t) = photograph.exposure_secs {
                    range(&field("exposure_secs"), t, LEAST_SECS, MOST_SECS)?;
                }
            }
            if let Pattern::Lattice { dots } = &shot.pattern {
                for &dot in dots {
                    if dot[0] >= self.grid.points[0] || dot[1] >= self.grid.points[1] {
                        return Err(Error::DotOutsideSlab {
                            path: path.to_path_buf(),
                            shot: shot.name.clone(),
                            dot,
                            expected: format!("a grid index below {:?}", self.grid.points),
                            found: format!("{dot:?}"),
                        });
                    }
                }
            }
            if let Pattern::GrayCode { bit, .. } = shot.pattern
                && bit > 15
            {
                return Err(Error::field(path, field("bit"), "0 to 15", bit));
            }
        }
        Ok(())
    }
}
