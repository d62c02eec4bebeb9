//! The response curve of a camera: light of code values, as a table with its uncertainty.

mod estimate;

pub use estimate::{CurveEstimate, CurveOptions, LightSum, estimate_curve};

use crate::capture::{ResponseCurve, Rig};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Code values of an 8-bit file; those of 16 bits are counted in 257ths.
pub(super) const CODES: usize = 256;
/// Light of the largest code value: the linear signal of encoded files is counted from 0 to 255.
pub(super) const FULL: f64 = 255.0;

/// Linear light of each 8-bit code value, per channel, from 0 to `FULL`; between codes it is interpolated.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Curve {
    channels: Vec<Channel>,
}

#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
struct Channel {
    linear: Vec<f64>,
    /// Slope at each code, for a monotone cubic.
    slope: Vec<f64>,
    relative_sd: Vec<f64>,
}

/// A curve's file.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    /// One list of 256 for all channels, or three (R, G, B).
    linear: Vec<Vec<f64>>,
    relative_sd: Vec<Vec<f64>>,
}

impl Curve {
    /// The sRGB curve (IEC 61966-2-1), exact.
    pub fn srgb() -> Self {
        let linear = (0..CODES).map(|code| FULL * srgb_to_linear(code as f64 / FULL)).collect();
        Self { channels: vec![Channel::new(linear, vec![0.0; CODES])] }
    }

    /// The curve that `camera.response` of a rig says, `rig_path`, whose folder has the curve's file; `None` is a linear
    /// one.
    ///
    /// # Errors
    /// Those of [`Self::read`]; [`Error::Field`] for `"estimate"`.
    pub fn of_rig(rig: &Rig, rig_path: &Path) -> Result<Option<Self>> {
        match &rig.camera.response_curve {
            ResponseCurve::Linear => Ok(None),
            ResponseCurve::Srgb => Ok(Some(Self::srgb())),
            ResponseCurve::File(name) => Self::read(&rig_path.with_file_name(name)).map(Some),
            ResponseCurve::Estimate => Err(Error::field(rig_path, "camera.response", "a known curve", "\"estimate\"")),
        }
    }

    /// [`Self::of_rig`], and sRGB for a curve that is still to be estimated.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    pub(crate) fn before_estimate(rig: &Rig, rig_path: &Path) -> Result<Option<Self>> {
        match rig.camera.response_curve {
            ResponseCurve::Estimate => Ok(Some(Self::srgb())),
            _ => Self::of_rig(rig, rig_path),
        }
    }

    /// From tables of `CODES` strictly increasing values (one, or one a channel) and their relative standard
    /// deviations. `None` unless they are.
    pub fn new(linear: Vec<Vec<f64>>, relative_sd: Vec<Vec<f64>>) -> Option<Self> {
        let whole = |table: &Vec<f64>| table.len() == CODES && table.iter().all(|v| v.is_finite());
        let rises = |table: &Vec<f64>| table.windows(2).all(|w| w[1] > w[0]);
        let fits = matches!(linear.len(), 1 | 3)
            && relative_sd.len() == linear.len()
            && linear.iter().all(|t| whole(t) && rises(t))
            && relative_sd.iter().all(|t| whole(t) && t.iter().all(|v| *v >= 0.0));
        let channels = linear.into_iter().zip(relative_sd).map(|(l, sd)| Channel::new(l, sd));
        fits.then(|| Self { channels: channels.collect() })
    }

    /// Reads a curve's file.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Field`].
    pub fn read(path: &Path) -> Result<Self> {
        let text = crate::files::read_to_string(path).map_err(Error::io("read", path))?;
        let file: File = crate::capture::parse_toml(path, &text)?;
        if file.format != crate::capture::FORMAT {
            return Err(Error::field(path, "format", crate::capture::FORMAT.to_string(), file.format));
        }
        let found =
            format!("{} lists of {:?}", file.linear.len(), file.linear.iter().map(Vec::len).collect::<Vec<_>>());
        Self::new(file.linear, file.relative_sd).ok_or_else(|| {
            let expected = "1 or 3 lists of 256 rising numbers in linear, as many in relative_sd";
            Error::field(path, "linear", expected, found)
        })
    }

    /// Writes the curve's file, beside its final name first.
    ///
    /// # Errors
    /// [`std::io::Error`].
    pub fn write(&self, path: &Path) -> std::io::Result<()> {
        let tables = |of: fn(&Channel) -> &Vec<f64>| self.channels.iter().map(|c| of(c).clone()).collect();
        let file = File {
            format: crate::capture::FORMAT,
            linear: tables(|c| &c.linear),
            relative_sd: tables(|c| &c.relative_sd),
        };
        let head = "# Response curve that acquire estimated: linear light (0 to 255) of each 8-bit code value.\n";
        let text = head.to_owned() + &toml::to_string(&file).map_err(std::io::Error::other)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        let scratch = tempfile::NamedTempFile::new_in(folder)?;
        std::fs::write(scratch.path(), text)?;
        scratch.persist(path).map(drop).map_err(|e| e.error)
    }

    fn channel(&self, channel: usize) -> &Channel {
        &self.channels[channel.min(self.channels.len() - 1)]
    }

    /// Whether each channel has a curve of its own.
    pub fn is_per_channel(&self) -> bool {
        self.channels.len() > 1
    }

    /// Light of a code value (0 to 255, fractions allowed).
    pub fn linear_at(&self, channel: usize, code: f64) -> f64 {
        let (c, k, t) = self.channel(channel).place(code);
        let (a, b, da, db) = (c.linear[k], c.linear[k + 1], c.slope[k], c.slope[k + 1]);
        let u = 1.0 - t;
        (1.0 + 2.0 * t) * u * u * a + t * u * u * da + t * t * (3.0 - 2.0 * t) * b - t * t * u * db
    }

    /// Slope of light over code, by differences over two codes.
    pub fn slope_at(&self, channel: usize, code: f64) -> f64 {
        let (low, high) = ((code - 1.0).max(0.0), (code + 1.0).min(FULL));
        (self.linear_at(channel, high) - self.linear_at(channel, low)) / (high - low)
    }

    /// Second derivative, by differences over four codes: smooth over the rounding of a table.
    pub fn bend_at(&self, channel: usize, code: f64) -> f64 {
        let code = code.clamp(2.0, FULL - 2.0);
        let at = |z: f64| self.linear_at(channel, z);
        (at(code + 2.0) - 2.0 * at(code) + at(code - 2.0)) / 4.0
    }

    /// The code value of some light; the ends of the table beyond it.
    pub fn code_at(&self, channel: usize, linear: f64) -> f64 {
        let table = &self.channel(channel).linear;
        let k = table.partition_point(|v| *v < linear).clamp(1, CODES - 1);
        let t = ((linear - table[k - 1]) / (table[k] - table[k - 1])).clamp(0.0, 1.0);
        (k - 1) as f64 + t
    }

    /// Relative standard deviation of the light of a code value, against that of half the range: common to all pixels.
    pub fn relative_sd_at(&self, channel: usize, code: f64) -> f64 {
        let (c, k, t) = self.channel(channel).place(code);
        (1.0 - t) * c.relative_sd[k] + t * c.relative_sd[k + 1]
    }

    /// Mean over channels and codes from 10 to 245 of the relative variance.
    pub fn relative_variance(&self) -> f64 {
        let all = self.channels.iter().flat_map(|c| &c.relative_sd[10..=245]);
        all.map(|s| s * s).sum::<f64>() / (236 * self.channels.len()) as f64
    }
}

impl Channel {
    fn new(linear: Vec<f64>, relative_sd: Vec<f64>) -> Self {
        let step: Vec<f64> = linear.windows(2).map(|w| w[1] - w[0]).collect();
        let n = step.len();
        // The harmonic mean of neighbouring steps keeps a cubic between them monotone (`FritschButland1984`).
        let slope = (0..=n).map(|k| match k {
            0 => step[0],
            k if k == n => step[n - 1],
            k => 2.0 * step[k - 1] * step[k] / (step[k - 1] + step[k]),
        });
        Self { slope: slope.collect(), linear, relative_sd }
    }

    fn place(&self, code: f64) -> (&Self, usize, f64) {
        let code = code.clamp(0.0, FULL);
        let k = (code as usize).min(CODES - 2);
        (self, k, code - k as f64)
    }
}

/// The sRGB decoding of IEC 61966-2-1, both in 0 to 1.
fn srgb_to_linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn between_codes_the_curve_is_the_srgb_one() {
        let curve = Curve::srgb();
        for k in 0..=2550 {
            let code = f64::from(k) / 10.0;
            let exact = FULL * srgb_to_linear(code / FULL);
            // A cubic over one code: the kink of sRGB at code 10.3 is the worst.
            let error = (curve.linear_at(0, code) - exact).abs();
            assert!(error < 2e-3 * exact + 1e-9, "{code}: {error} of {exact}");
            assert!((curve.code_at(1, exact) - code).abs() < 0.02, "{code}");
        }
    }

    #[test]
    fn a_saved_curve_is_read_back_and_a_falling_one_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("response.toml");
        let mut table: Vec<f64> = (0..CODES).map(|k| k as f64).collect();
        let curve = Curve::new(vec![table.clone(); 3], vec![vec![0.01; CODES]; 3]).unwrap();
        curve.write(&path).unwrap();
        assert_eq!(Curve::read(&path).unwrap(), curve);
        table[100] = 99.0;
        assert!(Curve::new(vec![table], vec![vec![0.0; CODES]]).is_none());
        std::fs::write(&path, "format = 1\nlinear = [[0.0]]\nrelative_sd = [[0.0]]").unwrap();
        assert!(Curve::read(&path).unwrap_err().to_string().contains("lists of 256"));
    }

    #[test]
    fn the_srgb_table_has_the_published_values() {
        let curve = Curve::srgb();
        // IEC 61966-2-1: (1/255)/12.92 below 0.04045, ((v + 0.055)/1.055)^2.4 above; by a pocket calculator.
        for (code, linear) in [(0.0, 0.0), (1.0, 3.035_27e-4), (10.0, 3.035_27e-3), (128.0, 0.215_861), (255.0, 1.0)] {
            assert!((curve.linear_at(2, code) / 255.0 - linear).abs() < 1e-6, "{code}");
        }
        assert!(!curve.is_per_channel());
    }

    /// Squares, cubes and a line, each from 0 to 255.
    fn three() -> Curve {
        let table = |power: i32| (0..CODES).map(|k| 255.0 * (k as f64 / 255.0).powi(power)).collect::<Vec<_>>();
        let sd = |scale: f64| (0..CODES).map(|k| scale * k as f64).collect::<Vec<_>>();
        Curve::new(vec![table(2), table(3), table(1)], vec![sd(1e-4), sd(2e-4), sd(5e-4)]).unwrap()
    }

    #[test]
    fn each_channel_has_its_own_table_slope_and_bend() {
        let curve = three();
        assert!(curve.is_per_channel());
        for code in [3.0, 100.0, 180.0, 252.0] {
            let (v, n) = (code / 255.0, 255.0);
            let expected = [[n * v * v, 2.0 * v, 2.0 / n], [n * v * v * v, 3.0 * v * v, 6.0 * v / n], [code, 1.0, 0.0]];
            for c in 0..3 {
                let found = [curve.linear_at(c, code), curve.slope_at(c, code), curve.bend_at(c, code)];
                // Over two codes the slope of a cube is too large by 1/255²; the rest is f64.
                let tolerance = [1e-9, 2e-5, 1e-9];
                assert!((0..3).all(|k| (found[k] - expected[c][k]).abs() < tolerance[k]), "{code} {c}: {found:?}");
                assert!((curve.code_at(c, expected[c][0]) - code).abs() < 1e-9, "{code} {c}");
            }
        }
        // A fourth channel is the last; beyond the table its ends.
        assert_eq!(curve.linear_at(7, 31.0), 31.0);
        assert_eq!([curve.linear_at(0, -5.0), curve.linear_at(0, 300.0)], [0.0, 255.0]);
        assert_eq!([curve.code_at(1, -5.0), curve.code_at(1, 300.0)], [0.0, 255.0]);
    }

    #[test]
    fn between_codes_the_curve_is_the_monotone_cubic_with_harmonic_slopes() {
        let curve = three();
        // Of squares, steps before and after code k are 2k − 1 and 2k + 1 (over 255): their harmonic mean, and the
        // Hermite cubic.
        let slope = |k: f64| 2.0 * (2.0 * k - 1.0) * (2.0 * k + 1.0) / (4.0 * k) / 255.0;
        for (k, t) in [(4.0, 0.3), (90.0, 0.5), (200.0, 0.9)] {
            let (a, b) = (k * k / 255.0, (k + 1.0) * (k + 1.0) / 255.0);
            let (t2, t3) = (t * t, t * t * t);
            let expected = (2.0 * t3 - 3.0 * t2 + 1.0) * a
                + (t3 - 2.0 * t2 + t) * slope(k)
                + (3.0 * t2 - 2.0 * t3) * b
                + (t3 - t2) * slope(k + 1.0);
            // f64.
            assert!((curve.linear_at(0, k + t) - expected).abs() < 1e-11, "{k} {t}");
            // Codes of light are linear between those of the table.
            assert!((curve.code_at(0, a + t * (b - a)) - k - t).abs() < 1e-9, "{k} {t}");
        }
        // At its ends the slope is that of the only step: of the first 1/255, of the second 3/255, of the last two
        // 507/255 and 509/255.
        let (t, second) = (0.25f64, 2.0 * 1.0 * 3.0 / 4.0 / 255.0);
        let (t2, t3) = (t * t, t * t * t);
        let first = (t3 - 2.0 * t2 + t) / 255.0 + (3.0 * t2 - 2.0 * t3) / 255.0 + (t3 - t2) * second;
        assert!((curve.linear_at(0, 0.25) - first).abs() < 1e-12);
        let (before, last) = (2.0 * 507.0 * 509.0 / 1016.0 / 255.0, 509.0 / 255.0);
        let end = (2.0 * t3 - 3.0 * t2 + 1.0) * 254.0 * 254.0 / 255.0
            + (t3 - 2.0 * t2 + t) * before
            + (3.0 * t2 - 2.0 * t3) * 255.0
            + (t3 - t2) * last;
        assert!((curve.linear_at(0, 254.25) - end).abs() < 1e-10);
    }

    #[test]
    fn slopes_and_bends_at_the_ends_are_taken_inside() {
        let curve = three();
        // Between codes 0 and 1, and 254 and 255.
        assert!((curve.slope_at(0, 0.0) - 1.0 / 255.0).abs() < 1e-12);
        assert!((curve.slope_at(0, 255.0) - 509.0 / 255.0).abs() < 1e-9);
        // Of a cube 6 v / 255 at codes 2 and 253.
        assert!((curve.bend_at(1, 0.0) - 12.0 / 255.0 / 255.0).abs() < 1e-9);
        assert!((curve.bend_at(1, 255.0) - 6.0 * 253.0 / 255.0 / 255.0).abs() < 1e-9);
    }

    #[test]
    fn the_curves_uncertainty_is_linear_between_codes_and_averaged_over_the_middle_of_all_channels() {
        let curve = three();
        for c in 0..3 {
            let expected = [1e-4, 2e-4, 5e-4][c] * 77.25;
            assert!((curve.relative_sd_at(c, 77.25) - expected).abs() < 1e-12, "{c}");
        }
        // Σ k² from 10 to 245 is 245·246·491/6 − 9·10·19/6 = 4,931,810; over 236 codes and three channels, of 30e-8 k².
        let expected = (245.0 * 246.0 * 491.0 - 9.0 * 10.0 * 19.0) / 6.0 / (3.0 * 236.0) * 30e-8;
        assert!((curve.relative_variance() / expected - 1.0).abs() < 1e-9, "{} {expected}", curve.relative_variance());
    }

    #[test]
    fn tables_that_are_no_curve_are_refused() {
        let rising = || (0..CODES).map(|k| k as f64).collect::<Vec<_>>();
        let none = || vec![0.0; CODES];
        assert!(Curve::new(vec![rising()], vec![none()]).is_some());
        assert!(Curve::new(vec![], vec![]).is_none());
        assert!(Curve::new(vec![rising(); 2], vec![none(); 2]).is_none());
        assert!(Curve::new(vec![rising(); 3], vec![none()]).is_none());
        assert!(Curve::new(vec![rising()[1..].to_vec()], vec![none()]).is_none());
        assert!(Curve::new(vec![rising()], vec![none()[1..].to_vec()]).is_none());
        for (k, v) in [(5, f64::NAN), (255, f64::INFINITY), (9, 8.0)] {
            let mut table = rising();
            table[k] = v;
            assert!(Curve::new(vec![rising(), table, rising()], vec![none(); 3]).is_none(), "{k} {v}");
        }
        for v in [-1e-9, f64::NAN] {
            let mut sd = none();
            sd[200] = v;
            assert!(Curve::new(vec![rising()], vec![sd]).is_none(), "{v}");
        }
    }

    #[test]
    fn a_curves_file_of_another_format_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("response.toml");
        three().write(&path).unwrap();
        assert_eq!(Curve::read(&path).unwrap(), three());
        let text = std::fs::read_to_string(&path).unwrap().replace("format = 1", "format = 2");
        std::fs::write(&path, text).unwrap();
        assert!(Curve::read(&path).unwrap_err().to_string().contains("format"));
        assert!(Curve::read(&dir.path().join("none.toml")).is_err());
    }
}
