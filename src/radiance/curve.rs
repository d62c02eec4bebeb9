//! The response curve of a camera: light of code values, as a table with its uncertainty.

mod estimate;

pub use estimate::{CurveEstimate, CurveOptions, LightSum, estimate_curve};

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Code values of an 8-bit file; those of 16 bits are counted in 257ths.
pub const CODES: usize = 256;
/// Light of the largest code value: the linear signal of encoded files is counted from 0 to 255.
pub const FULL: f64 = 255.0;

/// Linear light of each 8-bit code value, per channel, from 0 to `FULL`; between codes it is interpolated.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    channels: Vec<Channel>,
}

#[derive(Debug, Clone, PartialEq)]
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

    /// From tables of `CODES` strictly increasing values (one, or one a channel) and their relative standard deviations.
    /// `None` unless they are.
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
        let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
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
}
