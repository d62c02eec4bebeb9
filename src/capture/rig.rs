//! `calibration/rig.toml`: the camera, the projector, the board and the white reference. Field by field in
//! `docs/captures.md`.

use crate::{Error, Result, geometry::Point};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The whole of `rig.toml`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Version of this format: 1.
    pub format: u32,
    /// The camera.
    pub camera: Camera,
    /// The sensor's noise; without it, it is estimated from the photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise: Option<Noise>,
    /// The projector.
    pub projector: Projector,
    /// The chessboard; captures with a board shot need it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub board: Option<Board>,
    /// The marks on the frame; captures with a frame shot need them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<FrameMarks>,
    /// The white reference.
    pub white_reference: WhiteReference,
}

/// Optics and response curve of the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Width and height of its photographs, px.
    pub size_px: [usize; 2],
    /// Nominal focal length, px.
    pub focal_px: f64,
    /// Principal point, px (centre of the first pixel is 0).
    pub principal_px: Point,
    /// How code values encode light.
    #[serde(rename = "response")]
    pub response_curve: ResponseCurve,
    /// Vignetting V = 1 + c₀ r² + c₁ r⁴ + …, r the distance from the principal point over `focal_px`.
    #[serde(default)]
    pub vignetting: Vec<f64>,
}

impl Camera {
    /// Relative sensitivity at pixel `q`, 1 at the principal point.
    pub fn vignetting_at(&self, q: Point) -> f64 {
        let r2 =
            ((q[0] - self.principal_px[0]).powi(2) + (q[1] - self.principal_px[1]).powi(2)) / self.focal_px.powi(2);
        // Horner from the last coefficient: 1 + r²(c₀ + r²(c₁ + …)).
        1.0 + self.vignetting.iter().rev().fold(0.0, |sum, c| r2 * (c + sum))
    }
}

/// How code values encode light.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum ResponseCurve {
    /// Code values are proportional to light above the black level.
    Linear,
    /// The sRGB curve (IEC 61966-2-1) over the full range of code values.
    Srgb,
    /// Not known: estimated from the capture's own stacks and saved as `response.toml` beside `rig.toml`.
    Estimate,
    /// A saved curve, the name of a file beside `rig.toml`.
    File(String),
}

impl From<String> for ResponseCurve {
    fn from(name: String) -> Self {
        match name.as_str() {
            "linear" => Self::Linear,
            "srgb" => Self::Srgb,
            "estimate" => Self::Estimate,
            _ => Self::File(name),
        }
    }
}

impl From<ResponseCurve> for String {
    fn from(curve: ResponseCurve) -> Self {
        match curve {
            ResponseCurve::Linear => "linear".into(),
            ResponseCurve::Srgb => "srgb".into(),
            ResponseCurve::Estimate => "estimate".into(),
            ResponseCurve::File(name) => name,
        }
    }
}

/// The noise of the sensor, in code values (DN) of the linear signal: at the photographs' own bit depth with a linear
/// response curve, from 0 to 255 with the sRGB curve.
///
/// The variance of a linear value y is gain · (y − black) + (gain · read)² + 1/12 (Poisson, read-out, rounding), DN².
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Noise {
    /// Code value of no light, DN.
    pub black_dn: f64,
    /// Code value from which a pixel counts as saturated, DN.
    pub saturation_dn: f64,
    /// DN per photo-electron.
    pub gain_dn_per_electron: f64,
    /// Read noise, electrons.
    pub read_noise_electrons: f64,
}

/// The projector.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Projector {
    /// Width and height, px.
    pub size_px: [usize; 2],
    /// Where its lens's axis meets the image, px: far from the middle when the lens is shifted. `None` for the middle.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub principal_px: Option<Point>,
}

impl Projector {
    /// Centre of the lens's distortion, px.
    pub fn lens_center_px(&self) -> Point {
        self.principal_px.unwrap_or(self.size_px.map(|s| 0.5 * (s as f64 - 1.0)))
    }
}

/// A printed chessboard that lies in the slab's plane for the board shot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// Inner corners along x and y; unequal, so that the board cannot be taken for its own turn.
    pub inner_corners: [usize; 2],
    /// Side of a square, mm.
    pub square_mm: f64,
    /// The first inner corner in slab coordinates, mm.
    pub origin_mm: Point,
    /// Softness of the printed edges (standard deviation), mm.
    #[serde(default)]
    pub edge_blur_mm: f64,
}

impl Board {
    /// Inner corner `[i, j]` in slab coordinates, mm.
    pub fn corner_mm(&self, corner: [usize; 2]) -> Point {
        std::array::from_fn(|a| self.origin_mm[a] + corner[a] as f64 * self.square_mm)
    }
}

impl Board {
    fn check(&self, path: &Path) -> Result<()> {
        let range = |name: &str, v: f64, low: f64, high: f64| Error::unless_within(path, name, v, low, high);
        range("board.square_mm", self.square_mm, 1e-6, 1e6)?;
        range("board.edge_blur_mm", self.edge_blur_mm, 0.0, self.square_mm)?;
        let corners = self.inner_corners;
        if corners[0] == corners[1] {
            return Err(Error::field(path, "board.inner_corners", "unequal numbers", format!("{corners:?}")));
        }
        for a in 0..2 {
            range("board.inner_corners", corners[a] as f64, 3.0, 1000.0)?;
            range("board.origin_mm", self.origin_mm[a], -1e6, 1e6)?;
        }
        Ok(())
    }
}

impl FrameMarks {
    fn check(&self, path: &Path) -> Result<()> {
        Error::unless_within(path, "frame.diameter_mm", self.diameter_mm, 1e-6, 1e6)?;
        for v in self.marks_mm.iter().flatten() {
            Error::unless_within(path, "frame.marks_mm", *v, -1e6, 1e6)?;
        }
        Error::unless_within(path, "frame.marks_mm: number of marks", self.marks_mm.len() as f64, 8.0, 10_000.0)?;
        for (k, a) in self.marks_mm.iter().enumerate() {
            let near = |b: &&Point| (a[0] - b[0]).hypot(a[1] - b[1]) < 1.5 * self.diameter_mm;
            if let Some(other) = self.marks_mm[k + 1..].iter().find(near) {
                let expected = "centres at least one and a half diameters apart";
                return Err(Error::field(path, "frame.marks_mm", expected, format!("{a:?} and {other:?}")));
            }
        }
        Ok(())
    }
}

/// Discs printed on the opaque frame around the sample, darker or brighter than it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameMarks {
    /// Their centres in slab coordinates, mm.
    pub marks_mm: Vec<Point>,
    /// Their diameter, mm.
    pub diameter_mm: f64,
}

/// A diffuse white target of known reflectance.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WhiteReference {
    /// Its reflectance per channel (R, G, B).
    pub reflectance: [f64; 3],
    /// Relative standard deviation of that, as a whole and from place to place; 0 when nobody has stated one.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub relative_sd: f64,
}

fn is_zero(v: &f64) -> bool {
    *v == 0.0
}

impl Rig {
    /// Finds the rig of the capture in `capture_dir`: in `calibration` when given, else `capture_dir/calibration`, else
    /// `calibration` beside it.
    ///
    /// # Errors
    /// [`Error::NoRig`] with the places that were tried.
    pub fn find(capture_dir: &Path, calibration: Option<&Path>) -> Result<PathBuf> {
        let places = match calibration {
            Some(dir) => vec![dir.to_path_buf()],
            None => {
                let beside =
                    crate::files::canonical(capture_dir).ok().and_then(|d| Some(d.parent()?.join("calibration")));
                // Above a bucket there is nothing.
                let beside = beside.filter(|p| crate::files::is_url(p) == crate::files::is_url(capture_dir));
                [Some(capture_dir.join("calibration")), beside].into_iter().flatten().collect()
            }
        };
        for path in places.iter().map(|p| p.join("rig.toml")) {
            if crate::files::is_file(&path).map_err(Error::io("read", &path))? {
                return Ok(path);
            }
        }
        Err(Error::NoRig {
            path: capture_dir.to_path_buf(),
            looked: places.iter().map(|p| p.display().to_string()).collect::<Vec<_>>().join(", "),
        })
    }

    /// Reads and checks a rig file.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Field`].
    pub fn read(path: &Path) -> Result<Self> {
        let text = crate::files::read_to_string(path).map_err(Error::io("read", path))?;
        let rig: Self = super::parse_toml(path, &text)?;
        rig.check(path)?;
        Ok(rig)
    }

    /// Writes `rig.toml` into `dir`.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dir: &Path) -> Result<()> {
        let path = dir.join("rig.toml");
        let text = toml::to_string(self).map_err(Error::internal)?;
        std::fs::write(&path, text).map_err(Error::io("write", &path))
    }

    /// Copies a rig file, as it was written, and the response curve that it names, into the folder `to`.
    ///
    /// # Errors
    /// Those of [`Rig::read`]; [`Error::Io`], for a curve that is not there too.
    pub fn copy(path: &Path, to: &Path) -> Result<()> {
        let one = |from: &Path, name: &str| {
            let copy = to.join(name);
            let bytes = crate::files::read(from).map_err(Error::io("read", from))?;
            std::fs::write(&copy, bytes).map_err(Error::io("write", &copy))
        };
        if let ResponseCurve::File(name) = &Self::read(path)?.camera.response_curve {
            one(&path.with_file_name(name), name)?;
        }
        one(path, "rig.toml")
    }

    fn check(&self, path: &Path) -> Result<()> {
        let range = |name: &str, v: f64, low: f64, high: f64| Error::unless_within(path, name, v, low, high);
        if self.format != super::FORMAT {
            return Err(Error::field(path, "format", super::FORMAT.to_string(), self.format));
        }
        range("camera.focal_px", self.camera.focal_px, 1.0, 1e7)?;
        if let ResponseCurve::File(name) = &self.camera.response_curve {
            let expected = r#""linear", "srgb", "estimate", or the name of a curve's .toml file beside rig.toml"#;
            if !name.ends_with(".toml") || name.contains(['/', '\\']) {
                return Err(Error::field(path, "camera.response", expected, format!("\"{name}\"")));
            }
        }
        if let Some(noise) = &self.noise {
            range("noise.black_dn", noise.black_dn, 0.0, 65_535.0)?;
            range("noise.saturation_dn", noise.saturation_dn, noise.black_dn + 1e-6, 1e9)?;
            range("noise.gain_dn_per_electron", noise.gain_dn_per_electron, 0.0, 1e6)?;
            range("noise.read_noise_electrons", noise.read_noise_electrons, 0.0, 1e6)?;
        }
        if let Some(board) = &self.board {
            board.check(path)?;
        }
        if let Some(frame) = &self.frame {
            frame.check(path)?;
        }
        for a in 0..2 {
            range("camera.size_px", self.camera.size_px[a] as f64, 1.0, 65_536.0)?;
            range("projector.size_px", self.projector.size_px[a] as f64, 1.0, 65_536.0)?;
            range("camera.principal_px", self.camera.principal_px[a], -1e6, 1e6)?;
            if let Some(principal) = self.projector.principal_px {
                range("projector.principal_px", principal[a], -1e6, 1e6)?;
            }
        }
        for r in self.white_reference.reflectance {
            range("white_reference.reflectance", r, 1e-6, 1.0)?;
        }
        range("white_reference.relative_sd", self.white_reference.relative_sd, 0.0, 1.0)?;
        if self.camera.vignetting.iter().any(|c| !c.is_finite()) {
            return Err(Error::field(
                path,
                "camera.vignetting",
                "finite numbers",
                format!("{:?}", self.camera.vignetting),
            ));
        }
        self.check_vignetting(path)
    }

    /// Corners darker than a hundredth of the middle, or brighter than a hundred times, are a mistake in a coefficient.
    fn check_vignetting(&self, path: &Path) -> Result<()> {
        const STEPS: usize = 16;
        let at = |k: usize, a: usize| (self.camera.size_px[a] - 1) as f64 * k as f64 / STEPS as f64;
        for k in 0..=STEPS {
            for l in 0..=STEPS {
                let q = [at(k, 0), at(l, 1)];
                let v = self.camera.vignetting_at(q);
                if !(0.01..=100.0).contains(&v) {
                    let found = format!("{} at pixel ({:.0}, {:.0})", crate::error::number(v), q[0], q[1]);
                    let expected = "a relative sensitivity of 0.01 to 100 all over the picture";
                    return Err(Error::field(path, "camera.vignetting", expected, found));
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        Camera {
            size_px: [161, 81],
            focal_px: 200.0,
            principal_px: [30.0, 20.0],
            response_curve: ResponseCurve::Linear,
            vignetting: vec![-0.3, 0.12, -0.05],
        }
    }

    fn rig() -> Rig {
        Rig {
            format: super::super::FORMAT,
            camera: camera(),
            noise: None,
            projector: Projector { size_px: [101, 64], principal_px: None },
            board: None,
            frame: None,
            white_reference: WhiteReference { reflectance: [0.9, 0.8, 0.7], relative_sd: 0.0 },
        }
    }

    fn refused(change: impl FnOnce(&mut Rig)) -> Option<String> {
        let mut rig = rig();
        change(&mut rig);
        match rig.check(Path::new("rig.toml")) {
            Ok(()) => None,
            Err(Error::Field { field, .. }) => Some(field),
            Err(other) => panic!("{other}"),
        }
    }

    #[test]
    fn vignetting_is_a_polynomial_of_the_squared_distance_over_the_focal_length() {
        // 100 px right of and 80 px above the principal point: r² = (100² + 80²) / 200² = 0.41.
        let expected = 1.0 - 0.3 * 0.41 + 0.12 * 0.41 * 0.41 - 0.05 * 0.41 * 0.41 * 0.41;
        let found = camera().vignetting_at([130.0, -60.0]);
        assert!((found - expected).abs() < 1e-15, "{found} {expected}");
        assert_eq!(camera().vignetting_at([30.0, 20.0]), 1.0);
        let steep = Camera { vignetting: vec![-2.0], ..camera() };
        // Twice as far along one axis is four times as much; the two axes have their own middle.
        assert!((steep.vignetting_at([50.0, 20.0]) - 0.98).abs() < 1e-15);
        assert!((steep.vignetting_at([30.0, 60.0]) - 0.92).abs() < 1e-15);
        assert_eq!(Camera { vignetting: vec![], ..camera() }.vignetting_at([9.0, 9.0]), 1.0);
    }

    #[test]
    fn a_corner_that_is_all_but_dark_is_a_mistake_in_a_coefficient() {
        // The farthest corner is (160, 80): r² = (130² + 60²) / 200² = 0.5125; 1 − c r² is 0.01 at c = 0.99 / 0.5125.
        let limit = 0.99 / 0.5125;
        assert_eq!(refused(|r| r.camera.vignetting = vec![-limit + 1e-6]), None);
        assert_eq!(refused(|r| r.camera.vignetting = vec![-limit - 1e-6]).as_deref(), Some("camera.vignetting"));
        // From its other side the picture's first column is the farthest.
        let moved = |c: f64| {
            move |r: &mut Rig| {
                (r.camera.principal_px, r.camera.vignetting) = ([130.0, 60.0], vec![c]);
            }
        };
        assert_eq!(refused(moved(-limit + 1e-6)), None);
        assert!(refused(moved(-limit - 1e-6)).is_some());
        assert!(refused(|r| r.camera.vignetting = vec![99.1 / 0.5125]).is_some());
        assert_eq!(refused(|r| r.camera.vignetting = vec![98.9 / 0.5125]), None);
        assert!(refused(|r| r.camera.vignetting = vec![0.0, f64::NAN]).is_some());
    }

    #[test]
    fn corners_of_the_board_and_the_projector_s_middle_are_where_their_axes_say() {
        let board = Board { inner_corners: [6, 4], square_mm: 1.5, origin_mm: [3.0, -4.0], edge_blur_mm: 0.0 };
        assert_eq!(board.corner_mm([2, 1]), [6.0, -2.5]);
        let projector = |principal_px| Projector { size_px: [101, 64], principal_px }.lens_center_px();
        assert_eq!(projector(None), [50.0, 31.5]);
        assert_eq!(projector(Some([40.0, 90.0])), [40.0, 90.0]);
    }

    #[test]
    fn fields_of_the_rig_out_of_range_are_told_by_name() {
        let board = |corners: [usize; 2], square_mm, origin_mm, edge_blur_mm| {
            let board = Board { inner_corners: corners, square_mm, origin_mm, edge_blur_mm };
            refused(|r| r.board = Some(board))
        };
        assert_eq!(board([6, 4], 1.5, [3.0, -4.0], 1.5), None);
        assert_eq!(board([5, 5], 1.5, [3.0, -4.0], 0.0).as_deref(), Some("board.inner_corners"));
        assert_eq!(board([6, 2], 1.5, [3.0, -4.0], 0.0).as_deref(), Some("board.inner_corners"));
        assert_eq!(board([1001, 4], 1.5, [3.0, -4.0], 0.0).as_deref(), Some("board.inner_corners"));
        assert_eq!(board([6, 4], 1.5, [3.0, -1.1e6], 0.0).as_deref(), Some("board.origin_mm"));
        assert_eq!(board([6, 4], 1.5, [3.0, 0.0], 1.6).as_deref(), Some("board.edge_blur_mm"));
        assert_eq!(board([6, 4], 0.0, [3.0, 0.0], 0.0).as_deref(), Some("board.square_mm"));
        let noise = |black_dn, saturation_dn| {
            let noise = Noise { black_dn, saturation_dn, gain_dn_per_electron: 0.5, read_noise_electrons: 2.0 };
            refused(|r| r.noise = Some(noise))
        };
        assert_eq!((noise(100.0, 4000.0), noise(0.0, 1.0)), (None, None));
        assert_eq!(noise(-1.0, 255.0).as_deref(), Some("noise.black_dn"));
        assert_eq!(noise(100.0, 100.0).as_deref(), Some("noise.saturation_dn"));
        for (field, change) in [
            ("format", (|r| r.format = 2) as fn(&mut Rig)),
            ("camera.focal_px", |r| r.camera.focal_px = 0.5),
            ("camera.size_px", |r| r.camera.size_px = [161, 0]),
            ("projector.size_px", |r| r.projector.size_px = [65_537, 64]),
            ("camera.principal_px", |r| r.camera.principal_px = [0.0, f64::INFINITY]),
            ("projector.principal_px", |r| r.projector.principal_px = Some([0.0, -1.1e6])),
            ("white_reference.reflectance", |r| r.white_reference.reflectance = [0.9, 0.9, 1.01]),
            ("white_reference.relative_sd", |r| r.white_reference.relative_sd = -0.01),
            ("camera.response", |r| r.camera.response_curve = ResponseCurve::File("../curve.toml".into())),
            ("camera.response", |r| r.camera.response_curve = ResponseCurve::File("curve.txt".into())),
        ] {
            assert_eq!(refused(change).as_deref(), Some(field));
        }
        assert_eq!(refused(|r| r.camera.response_curve = ResponseCurve::File("curve.toml".into())), None);
        assert_eq!(refused(|r| r.white_reference.reflectance = [1.0, 1e-6, 0.5]), None);
        // A lens may be shifted beyond the picture.
        assert_eq!(refused(|r| r.camera.principal_px = [-40.0, -9.0]), None);
        assert_eq!(refused(|r| r.projector.principal_px = Some([50.0, -400.0])), None);
    }

    #[test]
    fn marks_nearer_than_one_and_a_half_diameters_are_refused() {
        // Two rows of marks, 3 mm apart along x and 10 mm along y.
        let marks =
            |n: usize| (0..n).map(|k| [3.0 * (k / 2) as f64, 5.0 + 10.0 * (k % 2) as f64]).collect::<Vec<Point>>();
        let frame = |marks_mm, diameter_mm| refused(|r| r.frame = Some(FrameMarks { marks_mm, diameter_mm }));
        assert_eq!((frame(marks(8), 2.0), frame(marks(9), 1.0)), (None, None));
        assert_eq!(frame(marks(8), 2.001).as_deref(), Some("frame.marks_mm"));
        assert_eq!(frame(marks(7), 1.0).as_deref(), Some("frame.marks_mm: number of marks"));
        assert_eq!(frame(marks(8), 0.0).as_deref(), Some("frame.diameter_mm"));
        let mut far = marks(8);
        far[5][1] = 1.1e6;
        assert_eq!(frame(far, 1.0).as_deref(), Some("frame.marks_mm"));
        // The last two may be the near ones, above each other.
        let mut near = marks(8);
        near[7] = [9.0, 6.4];
        assert_eq!(frame(near.clone(), 1.0).as_deref(), Some("frame.marks_mm"));
        near[7] = [9.0, 6.5];
        assert_eq!(frame(near, 1.0), None);
    }

    #[test]
    fn a_response_curve_is_written_as_it_is_read() {
        for name in ["linear", "srgb", "estimate", "curve.toml"] {
            assert_eq!(String::from(ResponseCurve::from(name.to_owned())), name);
        }
        assert_eq!(ResponseCurve::from("linear".to_owned()), ResponseCurve::Linear);
        assert_eq!(ResponseCurve::from("srgb".to_owned()), ResponseCurve::Srgb);
        assert_eq!(ResponseCurve::from("estimate".to_owned()), ResponseCurve::Estimate);
    }

    #[test]
    fn a_rig_is_read_as_it_was_written_and_copied_with_its_curve() {
        let folder = tempfile::tempdir().unwrap();
        let [from, to] = ["from", "to"].map(|n| folder.path().join(n));
        [&from, &to].into_iter().for_each(|d| std::fs::create_dir(d).unwrap());
        let mut with_curve = rig();
        with_curve.camera.response_curve = ResponseCurve::File("curve.toml".into());
        with_curve.write(&from).unwrap();
        assert_eq!(Rig::read(&from.join("rig.toml")).unwrap(), with_curve);
        assert!(Rig::copy(&from.join("rig.toml"), &to).is_err(), "the curve is not there");
        std::fs::write(from.join("curve.toml"), "a curve").unwrap();
        Rig::copy(&from.join("rig.toml"), &to).unwrap();
        assert_eq!(Rig::read(&to.join("rig.toml")).unwrap(), with_curve);
        assert_eq!(std::fs::read_to_string(to.join("curve.toml")).unwrap(), "a curve");
    }
}
