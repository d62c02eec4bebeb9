//! What a photograph says about the camera that took it, and when.

use exif::{In, Tag, Value};
use std::path::Path;

/// The settings of the camera for one photograph, as EXIF tells them; each `None` when it does not.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CameraSettings {
    /// Make and model.
    pub camera: Option<String>,
    /// Exposure time, s: ExposureTime, else from ShutterSpeedValue (APEX).
    pub exposure_secs: Option<f64>,
    /// Aperture.
    pub f_number: Option<f64>,
    /// ISO speed.
    pub iso: Option<f64>,
    /// Focal length, mm.
    pub focal_mm: Option<f64>,
    /// Whether the camera chose the exposure by itself (ExposureMode, ExposureProgram), and how.
    pub automatic_exposure: Option<String>,
    /// Whether the camera chose the white balance by itself.
    pub automatic_white_balance: Option<bool>,
    /// When it was taken, by the camera's clock: s since 1970 (DateTimeOriginal, SubSecTimeOriginal).
    pub taken_secs: Option<f64>,
}

impl CameraSettings {
    /// Reads the EXIF block of a photograph (JPEG, PNG, TIFF and the raw files made of it); `None` when there is none.
    ///
    /// Damaged blocks are read as far as they go.
    ///
    /// # Errors
    /// Those of reading the file.
    pub fn read(path: &Path) -> std::io::Result<Option<Self>> {
        let mut file = std::io::BufReader::with_capacity(1 << 12, crate::files::open(path)?);
        let parsed = exif::Reader::new()
            .continue_on_error(true)
            .read_from_container(&mut file)
            .or_else(|e| e.distill_partial_result(|_| ()));
        Ok(parsed.ok().map(|block| Self::of(&block)))
    }

    pub(super) fn of(block: &exif::Exif) -> Self {
        let value = |tag| block.get_field(tag, In::PRIMARY).map(|f| &f.value);
        let positive = |tag| value(tag).and_then(number).filter(|v| v.is_finite() && *v > 0.0);
        let text = |tag| value(tag).and_then(ascii);
        let apex = value(Tag::ShutterSpeedValue).and_then(number).map(|v| (-v).exp2());
        let camera: Vec<String> = [Tag::Make, Tag::Model].into_iter().filter_map(text).collect();
        Self {
            camera: (!camera.is_empty()).then(|| camera.join(" ")),
            exposure_secs: positive(Tag::ExposureTime).or(apex.filter(|v| v.is_finite() && *v > 0.0)),
            f_number: positive(Tag::FNumber),
            iso: positive(Tag::PhotographicSensitivity),
            focal_mm: positive(Tag::FocalLength),
            automatic_exposure: automatic(
                value(Tag::ExposureMode).and_then(|v| v.get_uint(0)),
                value(Tag::ExposureProgram).and_then(|v| v.get_uint(0)),
            ),
            automatic_white_balance: value(Tag::WhiteBalance).and_then(|v| v.get_uint(0)).map(|v| v == 0),
            taken_secs: text(Tag::DateTimeOriginal).and_then(|t| secs_since_1970(&t, text(Tag::SubSecTimeOriginal))),
        }
    }
}

/// How the camera chose the exposure, when it did; EXIF 2.32, tags A402 and 8822.
fn automatic(mode: Option<u32>, program: Option<u32>) -> Option<String> {
    let name = match program {
        Some(2) => "program",
        Some(3) => "aperture priority",
        Some(4) => "shutter priority",
        Some(5..=8) => "a scene program",
        _ if mode == Some(0) => "automatic exposure",
        _ => return None,
    };
    Some(name.to_owned())
}

fn number(value: &Value) -> Option<f64> {
    match value {
        Value::Rational(v) => v.first().map(|r| r.to_f64()),
        Value::SRational(v) => v.first().map(|r| r.to_f64()),
        other => other.get_uint(0).map(f64::from),
    }
}

fn ascii(value: &Value) -> Option<String> {
    let Value::Ascii(lines) = value else { return None };
    let text = String::from_utf8_lossy(lines.first()?).trim_matches([' ', '\0']).to_owned();
    (!text.is_empty()).then_some(text)
}

/// Seconds from 1970 to "YYYY:MM:DD HH:MM:SS" and a fraction, as if the clock ran on UTC.
fn secs_since_1970(text: &str, fraction: Option<String>) -> Option<f64> {
    let t = exif::DateTime::from_ascii(text.as_bytes()).ok()?;
    if !(1..=12).contains(&t.month) || !(1..=31).contains(&t.day) {
        return None;
    }
    // Days from the civil date, years beginning in March (Hinnant, "chrono-compatible low-level date algorithms").
    let (month, day) = (i64::from(t.month), i64::from(t.day));
    let year = i64::from(t.year) - i64::from(month <= 2);
    let (era, of_era) = (year.div_euclid(400), year.rem_euclid(400));
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let days = era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468;
    let secs = days * 86_400 + i64::from(t.hour) * 3600 + i64::from(t.minute) * 60 + i64::from(t.second);
    let fraction = fraction.and_then(|f| format!("0.{}", f.trim()).parse::<f64>().ok()).unwrap_or(0.0);
    Some(secs as f64 + fraction)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clock_times_are_seconds_since_1970() {
        let secs = |text, fraction: Option<&str>| secs_since_1970(text, fraction.map(str::to_owned));
        assert_eq!(secs("1970:01:01 00:00:00", None), Some(0.0));
        // date -u -d "2026-03-01 12:34:56" +%s
        assert_eq!(secs("2026:03:01 12:34:56", Some("25")), Some(1_772_368_496.25));
        assert_eq!(secs("2000:02:29 00:00:00", None), Some(951_782_400.0));
        assert_eq!(secs("0000:00:00 00:00:00", None), None);
        assert_eq!(secs("    :  :     :  :  ", None), None);
    }

    #[test]
    fn a_manual_exposure_is_not_automatic() {
        assert_eq!(automatic(Some(1), Some(1)), None);
        assert_eq!(automatic(Some(2), Some(1)), None, "a bracket by the camera in manual mode");
        assert_eq!(automatic(None, None), None);
        assert_eq!(automatic(Some(0), Some(3)).as_deref(), Some("aperture priority"));
        assert_eq!(automatic(Some(0), None).as_deref(), Some("automatic exposure"));
    }

    #[test]
    fn every_date_is_as_many_days_from_1970_as_the_calendar_says() {
        // Days counted one by one from 1970, month by month, as an almanac does.
        let (mut days, mut year, mut month) = (0i64, 1970, 1);
        while year < 2101 {
            let leap = (year % 4 == 0 && year % 100 != 0) || year % 400 == 0;
            let length = [31, if leap { 29 } else { 28 }, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31][month - 1];
            for day in [1, length] {
                let text = format!("{year}:{month:02}:{day:02} 23:59:07");
                let expected = (days + day - 1) * 86_400 + 23 * 3600 + 59 * 60 + 7;
                assert_eq!(secs_since_1970(&text, Some(" 5 ".into())), Some(expected as f64 + 0.5), "{text}");
            }
            days += length;
            (year, month) = if month == 12 { (year + 1, 1) } else { (year, month + 1) };
        }
        for wrong in ["2020:13:01 00:00:00", "2020:00:01 00:00:00", "2020:01:32 00:00:00", "2020:01:00 00:00:00"] {
            assert_eq!(secs_since_1970(wrong, None), None);
        }
    }

    #[test]
    fn a_program_that_chooses_the_exposure_is_told_by_its_name() {
        let names = [None, None, Some("program"), Some("aperture priority"), Some("shutter priority")];
        let scene = [Some("a scene program"); 4];
        for (program, name) in names.into_iter().chain(scene).chain([None]).enumerate() {
            assert_eq!(automatic(Some(1), Some(program as u32)).as_deref(), name, "{program}");
        }
    }

    #[test]
    fn settings_are_those_of_their_own_tags() {
        use super::super::exif::tests::block_of;
        use exif::{Rational, SRational};
        let read =
            |fields: Vec<(Tag, Value)>| CameraSettings::of(&exif::Reader::new().read_raw(block_of(fields)).unwrap());
        let rational = |num, denom| Value::Rational(vec![Rational { num, denom }]);
        let signed = |num, denom| Value::SRational(vec![SRational { num, denom }]);
        let text = |t: &str| Value::Ascii(vec![t.as_bytes().to_vec()]);
        let all = read(vec![
            (Tag::Make, text(" Acme ")),
            (Tag::Model, text("Mk 4")),
            (Tag::ExposureTime, rational(1, 125)),
            (Tag::FNumber, rational(56, 10)),
            (Tag::PhotographicSensitivity, Value::Short(vec![320])),
            (Tag::FocalLength, rational(105, 2)),
            (Tag::ExposureMode, Value::Short(vec![1])),
            (Tag::ExposureProgram, Value::Short(vec![3])),
            (Tag::WhiteBalance, Value::Short(vec![1])),
            (Tag::DateTimeOriginal, text("1970:01:02 00:00:01")),
            (Tag::SubSecTimeOriginal, text("75")),
            (Tag::ShutterSpeedValue, signed(3, 1)),
        ]);
        let expected = CameraSettings {
            camera: Some("Acme Mk 4".into()),
            exposure_secs: Some(0.008),
            f_number: Some(5.6),
            iso: Some(320.0),
            focal_mm: Some(52.5),
            automatic_exposure: Some("aperture priority".into()),
            automatic_white_balance: Some(false),
            taken_secs: Some(86_401.75),
        };
        assert_eq!(all, expected);
        let apex = read(vec![(Tag::ShutterSpeedValue, signed(-3, 2)), (Tag::WhiteBalance, Value::Short(vec![0]))]);
        // 2^1.5 s
        assert!((apex.exposure_secs.unwrap() - 8f64.sqrt()).abs() < 1e-15);
        assert_eq!((apex.automatic_white_balance, apex.camera), (Some(true), None));
        let none =
            read(vec![(Tag::ExposureTime, rational(0, 1)), (Tag::FNumber, rational(3, 0)), (Tag::Make, text(" "))]);
        assert_eq!(none, CameraSettings::default());
    }
}
