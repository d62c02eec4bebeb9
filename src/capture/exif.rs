//! What a photograph says about its own exposure.

use super::CameraSettings;
use super::manifest::{LEAST_SECS, MOST_SECS};
use crate::CaptureWarning;
use exif::{Exif, In, Tag, Value};
use std::path::Path;

/// The exposure of one photograph as its EXIF block tells it; each `None` when absent or unusable.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ExifExposure {
    /// ExposureTime, s.
    pub exposure_secs: Option<f64>,
    /// ShutterSpeedValue, turned into seconds: 2^−value.
    pub apex_secs: Option<f64>,
    /// FNumber, or 2^(ApertureValue / 2) when it is missing.
    pub f_number: Option<f64>,
    /// ISO speed: PhotographicSensitivity, or where that overflows (65535) the longer tags of EXIF 2.3.
    pub iso: Option<f64>,
}

/// Which source of an exposure time comes first. What `capture.toml` says comes before any.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ExposureFrom {
    /// EXIF ExposureTime, else ShutterSpeedValue.
    #[default]
    Exif,
    /// EXIF ShutterSpeedValue (APEX), else ExposureTime.
    Apex,
    /// As `exif`, and then one actual time for each of these nominal ones is measured from the photographs.
    Estimate,
}

/// f-numbers and ISO speeds beyond these were never built.
const F_NUMBERS: [f64; 2] = [0.1, 1000.0];
const ISO_SPEEDS: [f64; 2] = [0.1, 1e8];
/// PhotographicSensitivity has 16 bits: this value says "that or more".
const ISO_OVERFLOW: f64 = 65_535.0;

/// Reads the EXIF block of a photograph, as an exposure and as settings; a file without one gives all `None`.
///
/// Damaged blocks are read as far as they go, with a [`CaptureWarning::DamagedExif`]. A field whose value cannot be
/// (0/0, 2^32 − 1, a time beyond 1e-9 to 1e6 s) is left out with a [`CaptureWarning::UnusableExif`]; 0, which EXIF
/// writes for "unknown", is left out without.
pub(super) fn read(
    path: &Path,
    name: &str,
    warnings: &mut Vec<CaptureWarning>,
) -> std::io::Result<(ExifExposure, Option<CameraSettings>)> {
    let mut file = std::io::BufReader::with_capacity(1 << 12, crate::files::open(path)?);
    let parsed = exif::Reader::new().continue_on_error(true).read_from_container(&mut file).or_else(|e| {
        e.distill_partial_result(|errors| {
            let reason = errors.first().map(ToString::to_string).unwrap_or_default();
            warnings.push(CaptureWarning::DamagedExif { file: name.to_owned(), reason, photographs: 1 });
        })
    });
    // No EXIF in this file, or a container that carries none (EXR).
    Ok(parsed.map_or_else(
        |_| (ExifExposure::default(), None),
        |block| (interpret(&block, name, warnings), Some(CameraSettings::of(&block))),
    ))
}

fn interpret(block: &Exif, name: &str, warnings: &mut Vec<CaptureWarning>) -> ExifExposure {
    let mut usable = |tag: Tag, to: fn(f64) -> f64, [low, high]: [f64; 2]| {
        let field = block.get_field(tag, In::PRIMARY)?;
        let value = first_number(&field.value).map(to);
        // In APEX 0 is one second, elsewhere it stands for "unknown".
        let unknown = value == Some(0.0);
        let value = value.filter(|v| *v >= low && *v <= high);
        if value.is_none() && !unknown {
            let (file, tag, found) = (name.to_owned(), tag.to_string(), raw(&field.value));
            warnings.push(CaptureWarning::UnusableExif { file, tag, found, photographs: 1 });
        }
        value
    };
    let times = [LEAST_SECS, MOST_SECS];
    let exposure_secs = usable(Tag::ExposureTime, |v| v, times);
    let apex_secs = usable(Tag::ShutterSpeedValue, |v| (-v).exp2(), times);
    let f_number =
        usable(Tag::FNumber, |v| v, F_NUMBERS).or_else(|| usable(Tag::ApertureValue, |v| (v / 2.0).exp2(), F_NUMBERS));
    let iso = usable(Tag::PhotographicSensitivity, |v| v, ISO_SPEEDS);
    let longer = || {
        [Tag::ISOSpeed, Tag::RecommendedExposureIndex, Tag::StandardOutputSensitivity]
            .into_iter()
            .find_map(|tag| usable(tag, |v| v, ISO_SPEEDS))
    };
    let iso = iso.filter(|v| *v < ISO_OVERFLOW).or_else(longer).or(iso);
    ExifExposure { exposure_secs, apex_secs, f_number, iso }
}

/// The first number of a field; `None` when it is no number at all (x/0). All bits set is what writers leave of an
/// overflow.
fn first_number(value: &Value) -> Option<f64> {
    let ratio = |numerator: f64, denominator: f64| (denominator != 0.0).then(|| numerator / denominator);
    match value {
        Value::Rational(v) => {
            v.first().filter(|r| r.num != u32::MAX).and_then(|r| ratio(f64::from(r.num), f64::from(r.denom)))
        }
        Value::SRational(v) => v
            .first()
            .filter(|r| r.num != i32::MAX && r.num != i32::MIN)
            .and_then(|r| ratio(f64::from(r.num), f64::from(r.denom))),
        other => other.get_uint(0).filter(|v| *v != u32::MAX).map(f64::from),
    }
}

fn raw(value: &Value) -> String {
    match value {
        Value::Rational(v) => v.first().map(|r| format!("{}/{}", r.num, r.denom)),
        Value::SRational(v) => v.first().map(|r| format!("{}/{}", r.num, r.denom)),
        other => other.get_uint(0).map(|v| v.to_string()),
    }
    .unwrap_or_else(|| "no number".into())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use exif::{Field, Rational, SRational, experimental::Writer};

    /// The bytes of an EXIF block of these fields.
    pub(crate) fn block_of(fields: Vec<(Tag, Value)>) -> Vec<u8> {
        let fields: Vec<Field> =
            fields.into_iter().map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value }).collect();
        let mut writer = Writer::new();
        fields.iter().for_each(|f| writer.push_field(f));
        let mut bytes = std::io::Cursor::new(Vec::new());
        writer.write(&mut bytes, false).unwrap();
        bytes.into_inner()
    }

    fn read_fields(fields: Vec<(Tag, Value)>) -> (ExifExposure, Vec<CaptureWarning>) {
        let block = exif::Reader::new().read_raw(block_of(fields)).unwrap();
        let mut warnings = Vec::new();
        (interpret(&block, "a.jpg", &mut warnings), warnings)
    }

    fn rational(num: u32, denom: u32) -> Value {
        Value::Rational(vec![Rational { num, denom }])
    }

    #[test]
    fn impossible_times_are_left_out_and_said() {
        for (num, denom) in [(0, 0), (1, 0), (u32::MAX, 1), (u32::MAX, u32::MAX), (u32::MAX - 1, 1)] {
            let (exif, warnings) = read_fields(vec![(Tag::ExposureTime, rational(num, denom))]);
            assert_eq!(exif.exposure_secs, None, "{num}/{denom}");
            assert!(
                matches!(&warnings[..], [CaptureWarning::UnusableExif { tag, found, .. }]
                    if tag == "ExposureTime" && *found == format!("{num}/{denom}")),
                "{warnings:?}"
            );
        }
        for (num, denom) in [(i32::MIN, 1), (i32::MAX, 1), (-65_535, 1), (200, 1), (3, 0)] {
            let value = Value::SRational(vec![SRational { num, denom }]);
            let (exif, warnings) = read_fields(vec![(Tag::ShutterSpeedValue, value)]);
            assert_eq!(exif.apex_secs, None, "{num}/{denom}");
            assert_eq!(warnings.len(), 1, "{num}/{denom}");
        }
    }

    #[test]
    fn apex_values_stand_in_for_missing_ones_and_zero_is_a_second() {
        let apex = |tag, num, denom| (tag, Value::SRational(vec![SRational { num, denom }]));
        let (exif, warnings) =
            read_fields(vec![apex(Tag::ShutterSpeedValue, 0, 1), (Tag::ApertureValue, rational(6, 1))]);
        assert_eq!((exif.apex_secs, exif.exposure_secs, exif.f_number), (Some(1.0), None, Some(8.0)));
        assert!(warnings.is_empty());
        // FNumber 0 stands for "unknown".
        let (exif, warnings) = read_fields(vec![(Tag::FNumber, rational(0, 1)), (Tag::ApertureValue, rational(4, 1))]);
        assert_eq!((exif.f_number, warnings.len()), (Some(4.0), 0));
    }

    #[test]
    fn an_iso_speed_that_overflows_16_bits_is_taken_from_the_longer_tags() {
        let short = |v| (Tag::PhotographicSensitivity, Value::Short(vec![v]));
        let long = |tag| (tag, Value::Long(vec![102_400]));
        assert_eq!(read_fields(vec![short(65_535), long(Tag::RecommendedExposureIndex)]).0.iso, Some(102_400.0));
        assert_eq!(read_fields(vec![long(Tag::ISOSpeed)]).0.iso, Some(102_400.0));
        assert_eq!(read_fields(vec![short(400), long(Tag::ISOSpeed)]).0.iso, Some(400.0));
        assert_eq!(read_fields(vec![short(65_535)]).0.iso, Some(65_535.0));
    }

    #[test]
    fn times_and_apertures_are_the_numbers_of_the_standard() {
        let apex = |tag, num, denom| (tag, Value::SRational(vec![SRational { num, denom }]));
        let one = |field| read_fields(vec![field]).0;
        assert_eq!(one((Tag::ExposureTime, rational(1, 125))).exposure_secs, Some(0.008));
        assert_eq!(one((Tag::FNumber, rational(28, 10))).f_number, Some(2.8));
        // Table of EXIF 2.3, annex C: Tv 7 is 1/128 s (nominally 1/125), Tv -2 is 4 s; Av 5 is f/5.6, Av 3 is f/2.8.
        assert_eq!(one(apex(Tag::ShutterSpeedValue, 7, 1)).apex_secs, Some(1.0 / 128.0));
        assert_eq!(one(apex(Tag::ShutterSpeedValue, -4, 2)).apex_secs, Some(4.0));
        let f_number = one((Tag::ApertureValue, rational(10, 2))).f_number.unwrap();
        // 4 √2; exp2 is right to an ulp.
        assert!((f_number - 5.656_854_249_492_381).abs() < 1e-14, "{f_number}");
        let all = read_fields(vec![
            (Tag::ExposureTime, rational(3, 10)),
            (Tag::FNumber, rational(4, 1)),
            (Tag::PhotographicSensitivity, Value::Short(vec![200])),
            apex(Tag::ShutterSpeedValue, 2, 1),
            (Tag::ApertureValue, rational(6, 1)),
        ]);
        let expected =
            ExifExposure { exposure_secs: Some(0.3), apex_secs: Some(0.25), f_number: Some(4.0), iso: Some(200.0) };
        assert_eq!(all, (expected, vec![]));
        let other = vec![(Tag::Orientation, Value::Short(vec![1]))];
        assert_eq!(read_fields(other), (ExifExposure::default(), vec![]));
    }

    #[test]
    fn values_at_the_bounds_count_and_beyond_them_do_not() {
        let field = |tag, num, denom| read_fields(vec![(tag, rational(num, denom))]);
        assert_eq!(field(Tag::ExposureTime, 1, 1_000_000_000).0.exposure_secs, Some(1e-9));
        assert_eq!(field(Tag::ExposureTime, 1_000_000, 1).0.exposure_secs, Some(1e6));
        assert_eq!(field(Tag::FNumber, 1000, 1).0.f_number, Some(1000.0));
        assert_eq!(field(Tag::FNumber, 1, 10).0.f_number, Some(0.1));
        for (tag, num, denom) in [
            (Tag::ExposureTime, 1, 1_000_000_001),
            (Tag::ExposureTime, 1_000_001, 1),
            (Tag::FNumber, 1001, 1),
            (Tag::FNumber, 99, 1000),
            (Tag::FNumber, 4, 0),
        ] {
            let (exif, warnings) = field(tag, num, denom);
            assert_eq!((exif.exposure_secs, exif.f_number), (None, None), "{tag} {num}/{denom}");
            assert!(
                matches!(&warnings[..], [CaptureWarning::UnusableExif { file, photographs: 1, .. }] if file == "a.jpg")
            );
        }
        // All bits set stands for an overflow in every type.
        let iso = |value| read_fields(vec![(Tag::ISOSpeed, value)]);
        assert_eq!(iso(Value::Long(vec![100_000_000])).0.iso, Some(1e8));
        assert_eq!((iso(Value::Long(vec![u32::MAX])).0.iso, iso(Value::Long(vec![u32::MAX])).1.len()), (None, 1));
    }
}
