//! What a photograph says about its own exposure.

use crate::Warning;
use exif::{In, Tag, Value};
use std::path::Path;

/// The exposure of one photograph as its EXIF block tells it; each `None` when absent.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ExifExposure {
    /// ExposureTime, s.
    pub exposure_secs: Option<f64>,
    /// ShutterSpeedValue, turned into seconds: 2^−value.
    pub apex_secs: Option<f64>,
    /// FNumber.
    pub f_number: Option<f64>,
    /// ISO speed (PhotographicSensitivity).
    pub iso: Option<f64>,
}

/// Reads the EXIF block of a photograph; a file without one gives all `None`.
///
/// Damaged blocks are read as far as they go, with a [`Warning::DamagedExif`].
pub fn read(path: &Path, name: &str, warnings: &mut Vec<Warning>) -> std::io::Result<ExifExposure> {
    let mut file = std::io::BufReader::with_capacity(1 << 12, std::fs::File::open(path)?);
    let parsed = exif::Reader::new().continue_on_error(true).read_from_container(&mut file).or_else(|e| {
        e.distill_partial_result(|errors| {
            let reason = errors.first().map(ToString::to_string).unwrap_or_default();
            warnings.push(Warning::DamagedExif { file: name.to_owned(), reason });
        })
    });
    let Ok(block) = parsed else {
        // No EXIF in this file, or a container that carries none (EXR).
        return Ok(ExifExposure::default());
    };
    let number = |tag: Tag| block.get_field(tag, In::PRIMARY).and_then(|f| first_number(&f.value));
    let positive = |v: Option<f64>| v.filter(|v| v.is_finite() && *v > 0.0);
    Ok(ExifExposure {
        exposure_secs: positive(number(Tag::ExposureTime)),
        apex_secs: positive(number(Tag::ShutterSpeedValue).map(|v| (-v).exp2())),
        f_number: positive(number(Tag::FNumber)),
        iso: positive(number(Tag::PhotographicSensitivity)),
    })
}

fn first_number(value: &Value) -> Option<f64> {
    match value {
        Value::Rational(v) => v.first().map(|r| r.to_f64()),
        Value::SRational(v) => v.first().map(|r| r.to_f64()),
        other => other.get_uint(0).map(f64::from),
    }
}
