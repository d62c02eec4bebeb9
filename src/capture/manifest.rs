//! `capture.toml`: what was projected and which photographs show it. Field by field in `docs/captures.md`.

use crate::{Error, Result, geometry::Point};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The version of `capture.toml` that this program reads and writes.
pub const FORMAT: u32 = 1;
/// A dot fills at least this share of its square: less is a dot of another size.
const LEAST_DOT_SHARE: f64 = 0.1;

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

/// The lit points, laid out in projector pixels: the dot of grid index (i, j) is centred at `origin_projector_px + (i,
/// j) · step_projector_px`.
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
    /// Lit area of a dot, projector px², where it is no such square: of a disc π/4 times the square of its diameter, or
    /// the sum of its pixels' shares of full light. The square's when nothing is stated.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dot_area_projector_px2: Option<f64>,
}

impl Grid {
    /// Centre of dot `[i, j]`, projector px.
    pub fn dot_projector_px(&self, dot: [usize; 2]) -> Point {
        std::array::from_fn(|a| self.origin_projector_px[a] + dot[a] as f64 * self.step_projector_px[a])
    }

    /// Lit area of a dot, projector px².
    pub fn dot_area_px2(&self) -> f64 {
        self.dot_area_projector_px2.unwrap_or((self.dot_projector_px as f64).powi(2))
    }

    /// Side of the square of a dot's area, projector px: a disc of this area is nearly as wide (its second moment is 5 %
    /// less).
    pub fn dot_side_px(&self) -> f64 {
        self.dot_area_px2().sqrt()
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
    /// The sample in its frame, projector white: the frame's marks of `rig.toml` give the plane. A second one tells
    /// movement.
    Frame,
    /// The white reference in the slab's plane, projector white.
    ReferenceWhite,
    /// The white reference in the slab's plane, projector black.
    ReferenceBlack,
    /// The sample in place, projector black: ambient light, the projector's black level.
    SampleBlack,
    /// The lens is covered: what the sensor says of no light.
    Dark,
    /// One bit of the Gray code, on the white reference or on the sample in its frame.
    GrayCode {
        /// The projector axis that it encodes.
        axis: Axis,
        /// Bit number j: the pattern is bit j of n XOR (n >> 1), n the projector column (or row); stripes are 2^(j+1)
        /// px wide.
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
        crate::files::check_readable(dir)?;
        let path = dir.join("capture.toml");
        let text = match crate::files::read_to_string(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound && crate::files::is_folder(dir) => {
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
        if let Some(area) = self.grid.dot_area_projector_px2 {
            let square = (self.grid.dot_projector_px as f64).powi(2);
            range("grid.dot_area_projector_px2", area, LEAST_DOT_SHARE * square, square)?;
        }
        let mut names = std::collections::BTreeSet::new();
        for shot in &self.shots {
            let field = |name: &str| format!("shots \"{}\": {name}", shot.name);
            if !names.insert(&shot.name) {
                return Err(Error::field(path, field("name"), "unique names", "another shot of this name"));
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

#[cfg(test)]
mod tests {
    use super::*;

    fn manifest() -> Manifest {
        let photograph = PhotographEntry { file: "a.png".into(), exposure_secs: Some(0.5) };
        let shot = |name: &str, pattern| Shot { name: name.into(), pattern, photographs: vec![photograph.clone()] };
        Manifest {
            format: FORMAT,
            name: "m".into(),
            slab: Slab { size_mm: [30.0, 20.0] },
            grid: Grid {
                points: [5, 3],
                origin_projector_px: [100.0, 40.5],
                step_projector_px: [6.0, -4.5],
                dot_projector_px: 2,
                dot_area_projector_px2: None,
            },
            window: Window { samples: [7, 5], pitch_mm: 0.2 },
            reference_dots: Some(ReferenceDots { projector_px: vec![[1.0, 2.0], [300.0, 5.0]] }),
            shots: vec![
                shot("board", Pattern::Board),
                shot("code", Pattern::GrayCode { axis: Axis::Y, bit: 15, inverse: true, on: Surface::Frame }),
                shot("dots", Pattern::Lattice { dots: vec![[4, 0], [0, 2]] }),
                shot("cap", Pattern::Dark),
            ],
        }
    }

    #[test]
    fn a_dot_lies_a_step_of_each_axis_from_the_next_and_rows_are_counted_along_x() {
        let grid = manifest().grid;
        assert_eq!(grid.dot_projector_px([0, 0]), [100.0, 40.5]);
        assert_eq!(grid.dot_projector_px([3, 2]), [118.0, 31.5]);
        assert_eq!((grid.row_index([3, 2]), grid.row_index([4, 0]), grid.len()), (13, 4, 15));
        let none = |points| Grid { points, ..grid.clone() }.is_empty();
        assert_eq!((none([5, 3]), none([0, 3]), none([5, 0])), (false, true, true));
    }

    #[test]
    fn fields_of_the_manifest_out_of_range_are_told_by_name() {
        let path = Path::new("capture.toml");
        manifest().check(path).unwrap();
        let refused = |change: fn(&mut Manifest)| {
            let mut changed = manifest();
            change(&mut changed);
            match changed.check(path) {
                Err(Error::Field { field, .. }) => field,
                Err(Error::DotOutsideSlab { dot, .. }) => format!("dot {dot:?}"),
                other => panic!("{other:?}"),
            }
        };
        for (field, change) in [
            ("format", (|m| m.format = 0) as fn(&mut Manifest)),
            ("slab.size_mm", |m| m.slab.size_mm[1] = 0.0),
            ("slab.size_mm", |m| m.slab.size_mm[0] = 1.1e6),
            ("grid.origin_projector_px", |m| m.grid.origin_projector_px[1] = -1.5),
            ("grid.step_projector_px", |m| m.grid.step_projector_px[0] = -7e4),
            ("grid.step_projector_px", |m| m.grid.step_projector_px[1] = 0.0),
            ("grid.step_projector_px", |m| m.grid.step_projector_px[0] = 0.0),
            ("reference_dots.projector_px", |m| m.reference_dots.as_mut().unwrap().projector_px[1][1] = 7e4),
            ("grid.points", |m| m.grid.points[0] = 0),
            ("grid.points", |m| m.grid.points[1] = 65_537),
            ("window.samples", |m| m.window.samples[1] = 4),
            ("window.samples", |m| m.window.samples[0] = 4097),
            ("window.samples", |m| m.window.samples[0] = 0),
            ("window.pitch_mm", |m| m.window.pitch_mm = f64::NAN),
            ("grid.dot_projector_px", |m| m.grid.dot_projector_px = 0),
            ("grid.dot_area_projector_px2", |m| m.grid.dot_area_projector_px2 = Some(4.1)),
            ("grid.dot_area_projector_px2", |m| m.grid.dot_area_projector_px2 = Some(0.2)),
            ("shots \"code\": name", |m| m.shots[2].name = "code".into()),
            ("shots \"dots\": photographs", |m| m.shots[2].photographs.clear()),
            ("shots \"board\": exposure_secs", |m| m.shots[0].photographs[0].exposure_secs = Some(1e-10)),
            ("shots \"board\": exposure_secs", |m| m.shots[0].photographs[0].exposure_secs = Some(1.1e6)),
            ("dot [5, 0]", |m| m.shots[2].pattern = Pattern::Lattice { dots: vec![[4, 2], [5, 0]] }),
            ("dot [2, 3]", |m| m.shots[2].pattern = Pattern::Lattice { dots: vec![[2, 3]] }),
        ] {
            assert_eq!(refused(change), field);
        }
        let bit = |m: &mut Manifest| {
            m.shots[1].pattern = Pattern::GrayCode { axis: Axis::X, bit: 16, inverse: false, on: Surface::Frame };
        };
        assert_eq!(refused(bit), "shots \"code\": bit");
        // The bounds themselves are allowed.
        let mut widest = manifest();
        (widest.grid.points, widest.window.samples) = ([65_536, 65_536], [4095, 1]);
        widest.check(path).unwrap();
    }

    #[test]
    fn a_manifest_is_read_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(Manifest::read(folder.path()), Err(Error::NoManifest { .. })));
        assert!(matches!(Manifest::read(&folder.path().join("none")), Err(Error::Io { .. })));
        manifest().write(folder.path()).unwrap();
        assert_eq!(Manifest::read(folder.path()).unwrap(), manifest());
        // The usual surface is not written.
        let text = std::fs::read_to_string(folder.path().join("capture.toml")).unwrap();
        assert!(text.contains("on = \"frame\"") && Surface::default().is_white_reference());
        let mut white = manifest();
        white.shots[1].pattern =
            Pattern::GrayCode { axis: Axis::X, bit: 3, inverse: false, on: Surface::WhiteReference };
        white.write(folder.path()).unwrap();
        assert!(!std::fs::read_to_string(folder.path().join("capture.toml")).unwrap().contains("on = "));
        assert_eq!(Manifest::read(folder.path()).unwrap(), white);
    }
}
