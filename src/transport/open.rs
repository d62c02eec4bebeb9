//! Opening a store, whoever wrote it: what its arrays and attributes say, and what stands for those that it has not.
//! `docs/matrix-format.md` is the description.

use super::checksum::Checksums;
use super::row_array::{AXES, RowArray, RowLayout, check_chunks, check_metadata, dimension_names, wide_numbers};
use super::store::{COMMON, FORMATS, LARGEST_MM, MOST_POINTS, MOST_SAMPLES, MatrixHeader, ShotRecord, most_shots};
use super::store_files::StoreFiles;
use super::{CHANNELS, CommonErrors};
use crate::files::is_url;
use crate::geometry::Point;
use crate::{Error, Result};
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use zarrs::array::{Array, ArrayCreateError, data_type};

/// Lit points up to this number are believed whatever a store holds: their places take 40 MB.
const FEW_POINTS: usize = 1 << 20;
/// More are believed when so many have a byte of responses. Constant responses compress 30,000 times, and a row has
/// dozens of numbers.
const POINTS_A_BYTE: usize = 64;
/// Offsets and pitches that differ by less than this share of a sample are the same: f32 keeps 1e-7 of the largest
/// offset.
const SAME: f64 = 1e-3;
/// A stated lit pitch further than this share from the distance of the lit points is that of the matrix which this one
/// was cut out of: leaving out every other line doubles the distance, and measured places scatter by far less.
const STALE: f64 = 0.25;

/// How other programs spell the units of this store.
const UNITS: [(&str, &[&str]); 3] = [
    (
        "mm^-2",
        &["mm^-2", "mm-2", "mm**-2", "mm⁻²", "1/mm^2", "1/mm2", "1/mm**2", "1/mm²", "/mm^2", "1 / millimeter ** 2"],
    ),
    (
        "mm^-4",
        &["mm^-4", "mm-4", "mm**-4", "mm⁻⁴", "1/mm^4", "1/mm4", "1/mm**4", "1/mm⁴", "/mm^4", "1 / millimeter ** 4"],
    ),
    ("mm", &["mm", "millimeter", "millimeters", "millimetre", "millimetres"]),
];

/// A store that is open.
pub(super) struct Opened {
    pub(super) header: MatrixHeader,
    pub(super) layout: RowLayout,
    pub(super) response: RowArray,
    pub(super) variance: Option<RowArray>,
    pub(super) valid: Option<RowArray>,
    /// `None` for a store that another program, or an earlier version of this one, has written.
    pub(super) checksums: Option<Checksums>,
}

/// Opens `path` and reads all but the rows; `instead` takes the place of attributes of the same name.
pub(super) fn open(path: &Path, instead: &Map<String, Value>) -> Result<Opened> {
    let mut group = StoreGroup::open(path)?;
    group.attributes.extend(instead.clone());
    let attributes = &group.attributes;
    let response =
        group.row_array("response")?.ok_or_else(|| group.unfit("array response", "an array of this name", "none"))?;
    let [ny, nx, h, w, channels] = response.sides;
    let most = [MOST_POINTS, MOST_POINTS, MOST_SAMPLES, MOST_SAMPLES];
    if let Some(a) = (0..4).find(|&a| !(1..=most[a]).contains(&response.sides[a])) {
        return Err(group.unfit("array response", format!("1 to {} along {}", most[a], AXES[a]), response.sides[a]));
    }
    if channels != 1 && channels != CHANNELS {
        return Err(group.unfit("array response", "1 or 3 channels", channels));
    }
    let alike = |name: &str| -> Result<Option<RowArray>> {
        match group.row_array(name)? {
            Some(array) if array.sides != response.sides => {
                let expected = format!("the shape of response, {:?}", response.sides);
                Err(group.unfit(&format!("array {name}"), expected, format_args!("{:?}", array.sides)))
            }
            other => Ok(other),
        }
    };
    let (variance, valid) = (alike("variance")?, alike("valid")?);
    if let Some(names) = attributes.get("channels")
        && channels == CHANNELS
        && *names != serde_json::json!(["R", "G", "B"])
    {
        return Err(group.unfit("attribute channels", r#"["R","G","B"]"#, names));
    }
    group.refuse_places_as_indices()?;
    group.check_channel_names(channels)?;
    let (pitch_mm, layout) = windows(&group, [nx, ny], [w, h])?;
    let header = header(&group, &layout, pitch_mm)?;
    Ok(Opened { header, layout, response, variance, valid, checksums: group.checksums })
}

/// The cell's side, and where the stored samples lie in windows around the lit points.
fn windows(group: &StoreGroup, points: [usize; 2], stored: [usize; 2]) -> Result<(f64, RowLayout)> {
    let stated: Option<f64> = group.attribute("pitch_mm", "a number of mm")?;
    let offsets = [group.offsets("dx", stored[0])?, group.offsets("dy", stored[1])?];
    let spacing = |a: usize| {
        let values = offsets[a].as_deref().filter(|v| v.len() > 1)?;
        Some((values[values.len() - 1] - values[0]) / (values.len() - 1) as f64)
    };
    let Some(pitch_mm) = stated.or(spacing(0)).or(spacing(1)) else {
        return Err(group.unfit(
            "attribute pitch_mm",
            "the side of a sample in mm, or an array dx of two offsets or more",
            "neither",
        ));
    };
    if !(1.0 / LARGEST_MM..=LARGEST_MM).contains(&pitch_mm) {
        return Err(group.unfit(
            "attribute pitch_mm",
            format!("{:e} to {LARGEST_MM:e} mm", 1.0 / LARGEST_MM),
            pitch_mm,
        ));
    }
    let (mut window, mut before) = ([0; 2], [0; 2]);
    for (a, name) in ["dx", "dy"].into_iter().enumerate() {
        // Which stored sample is the lit point's own; it may lie outside a crop.
        let own = match &offsets[a] {
            None if stored[a] % 2 == 1 => (stored[a] / 2) as f64,
            None => {
                let expected = format!("an odd number of samples along {name}, or the array {name}");
                return Err(group.unfit("array response", expected, format_args!("{} samples and none", stored[a])));
            }
            Some(values) => {
                if let Some((k, v)) = values
                    .iter()
                    .enumerate()
                    .find(|(k, v)| (**v - values[0] - *k as f64 * pitch_mm).abs() > SAME * pitch_mm)
                {
                    let expected = format!("offsets in mm, {pitch_mm} mm apart as pitch_mm and the spacing of dx say");
                    let first = values[0];
                    return Err(group.unfit(
                        &format!("array {name}"),
                        expected,
                        format_args!("{first} first and {v} at {k}"),
                    ));
                }
                -values[0] / pitch_mm
            }
        };
        if !((own - own.round()).abs() <= SAME && own.abs() < MOST_SAMPLES as f64) {
            let expected = format!("offsets that are whole multiples of {pitch_mm} mm");
            let first = offsets[a].as_ref().and_then(|v| v.first()).copied().unwrap_or(f64::NAN);
            return Err(group.unfit(&format!("array {name}"), expected, format_args!("{first} first")));
        }
        let (own, last) = (own.round() as i64, stored[a] as i64 - 1);
        let half = own.max(last - own);
        (window[a], before[a]) = ((2 * half + 1) as usize, (half - own) as usize);
    }
    Ok((pitch_mm, RowLayout { points, stored, window, before }))
}

fn header(group: &StoreGroup, layout: &RowLayout, pitch_mm: f64) -> Result<MatrixHeader> {
    let points = layout.points;
    let mut header = MatrixHeader {
        points,
        window: layout.window,
        pitch_mm,
        lit_pitch_mm: [pitch_mm; 2],
        lit_mm: Vec::new(),
        position_sd_mm: Vec::new(),
        shot_of: Vec::new(),
        common: None,
        shots: shots(group, points[0] * points[1])?,
        camera_px_per_mm: group.attribute("camera_px_per_mm", "a number")?,
        warnings: group.attribute("warnings", "findings that this version of acquire knows")?.unwrap_or_default(),
        provenance: group.attributes.get("provenance").cloned().unwrap_or_default(),
    };
    header.check().map_err(|reason| group.broken(reason))?;
    group.believe(header.rows())?;
    let stated = lit_pitch(group)?;
    let places = [group.over_points("x_i_mm", points)?, group.over_points("y_i_mm", points)?];
    header.lit_pitch_mm = stated.unwrap_or([pitch_mm; 2]);
    header.lit_mm = match places {
        [None, None] => (0..header.rows())
            .map(|k| [(k % points[0]) as f64 * header.lit_pitch_mm[0], (k / points[0]) as f64 * header.lit_pitch_mm[1]])
            .collect(),
        [Some(x), Some(y)] => x.into_iter().zip(y).map(|(x, y)| [x, y]).collect(),
        [x, _] => {
            let (there, not) = if x.is_some() { ("x_i_mm", "y_i_mm") } else { ("y_i_mm", "x_i_mm") };
            return Err(group.unfit(&format!("array {not}"), format!("an array of this name beside {there}"), "none"));
        }
    };
    for a in 0..2 {
        let pitch = &mut header.lit_pitch_mm[a];
        if let Some(distance) = distance(&header.lit_mm, points, a)
            && (stated.is_none() || !((*pitch / distance - 1.0).abs() <= STALE))
        {
            *pitch = distance;
        }
    }
    header.position_sd_mm = group.over_points("position_sd_mm", points)?.unwrap_or_else(|| vec![0.0; header.rows()]);
    let shots = header.shots.len() as f64;
    let shot = group.over_points("shot", points)?.unwrap_or_else(|| vec![-1.0; header.rows()]);
    if let Some(v) = shot.iter().find(|v| **v >= shots || **v < -1.0 || v.fract() != 0.0) {
        return Err(group.unfit("array shot", format!("-1, or numbers below {shots}, of which there are names"), v));
    }
    header.shot_of = shot.into_iter().map(|v| (v >= 0.0).then_some(v as usize)).collect();
    header.common = common_errors(group, layout)?;
    header.check().and_then(|()| header.check_places()).map_err(|reason| group.broken(reason))?;
    Ok(header)
}

/// What of the variance samples have in common; samples outside of a crop have nothing.
fn common_errors(group: &StoreGroup, layout: &RowLayout) -> Result<Option<CommonErrors>> {
    let ([nx, ny], [w, h], [wx, wy]) = (layout.points, layout.stored, layout.window);
    let of_all = group.attribute(COMMON, "{scale_sd: [R, G, B], position_sd_mm}")?;
    let of_rows = group.by_channel("row_scale_sd", [ny, nx])?;
    let of_samples = group.by_channel("common_sd", [h, w])?;
    if of_all.is_none() && of_rows.is_none() && of_samples.is_none() {
        return Ok(None);
    }
    let mut common = CommonErrors::none(nx * ny, wx * wy * CHANNELS);
    common.of_all = of_all.unwrap_or_default();
    common.row_scale_sd = of_rows.unwrap_or(common.row_scale_sd);
    for (k, sd) in of_samples.into_iter().flatten().enumerate() {
        let (i, j) = (k % w + layout.before[0], k / w + layout.before[1]);
        let at = CHANNELS * (j * wx + i);
        common.sample_sd[at..at + CHANNELS].copy_from_slice(&sd);
    }
    Ok(Some(common))
}

/// The lattice shots: arrays that the attribute `shots` counts; in older stores, and in those of others, a list there.
fn shots(group: &StoreGroup, rows: usize) -> Result<Vec<ShotRecord>> {
    let Some(count) = group.attributes.get("shots").and_then(Value::as_u64) else {
        let expected = "the number of the lattice shots, or a list of {name, drift_px, drift_sd_px}";
        return Ok(group.attribute("shots", expected)?.unwrap_or_default());
    };
    let most = most_shots(rows);
    let count = usize::try_from(count).ok().filter(|count| *count <= most);
    let count = count.ok_or_else(|| group.unfit("attribute shots", format!("at most {most}"), "more"))?;
    // Whoever writes a part of a store anew may leave out the arrays, and takes the attributes along.
    if count == 0 || group.array("shot_name")?.is_none() {
        return Ok(Vec::new());
    }
    let names = group.texts("shot_name", count)?;
    let drift = group.numbers("shot_drift_px", &[count, 2])?;
    let sd = group.numbers("shot_drift_sd_px", &[count])?;
    let records = names.into_iter().enumerate().map(|(k, name)| ShotRecord {
        name,
        drift_px: [drift[2 * k], drift[2 * k + 1]],
        drift_sd_px: Some(sd[k]).filter(|sd| !sd.is_nan()),
    });
    Ok(records.collect())
}

/// Values of a small array, its shape, the names of its dimensions.
type Small = (Vec<f64>, Vec<usize>, Option<Vec<String>>);

/// The attribute `lit_pitch_mm`: one number or two.
fn lit_pitch(group: &StoreGroup) -> Result<Option<Point>> {
    match group.attributes.get("lit_pitch_mm") {
        Some(Value::Number(n)) => Ok(n.as_f64().map(|v| [v; 2])),
        _ => group.attribute("lit_pitch_mm", "a number of mm, or two for x and y"),
    }
}

/// The median distance of neighbours along an axis; `None` where there is none that can be a pitch.
pub(super) fn distance(lit_mm: &[Point], [nx, ny]: [usize; 2], axis: usize) -> Option<f64> {
    let step = [1, nx][axis];
    let neighbours = (0..nx * ny).filter(|k| if axis == 0 { k % nx + 1 < nx } else { k / nx + 1 < ny });
    let mut all: Vec<f64> =
        neighbours.map(|k| (lit_mm[k + step][0] - lit_mm[k][0]).hypot(lit_mm[k + step][1] - lit_mm[k][1])).collect();
    all.sort_by(f64::total_cmp);
    all.get(all.len() / 2).copied().filter(|d| (1.0 / LARGEST_MM..=LARGEST_MM).contains(d))
}

/// The group of a store, and its arrays by name.
struct StoreGroup {
    path: PathBuf,
    store: Arc<StoreFiles>,
    attributes: Map<String, Value>,
    checksums: Option<Checksums>,
}

impl StoreGroup {
    fn open(path: &Path) -> Result<Self> {
        let store = Arc::new(StoreFiles::at(path)?);
        if !is_url(path) {
            std::fs::metadata(path).map_err(Error::io("read", path))?;
        }
        if path.to_str().is_none() {
            let reason = "the path of a matrix must be UTF-8";
            return Err(Error::io("read", path)(std::io::Error::new(std::io::ErrorKind::InvalidInput, reason)));
        }
        let unfit = |expected: &str, found: String| Error::MatrixFormat {
            path: path.to_path_buf(),
            part: "group".into(),
            expected: expected.into(),
            found,
        };
        let has = |names: &[&str]| store.has("", names).map_err(Error::io("read", path));
        if !has(&["zarr.json", ".zgroup"])? {
            let found = match (has(&[".zarray"])?, path.is_dir()) {
                (true, _) => "an array",
                (false, _) if is_url(path) => "no zarr.json",
                (false, true) => "a folder without zarr.json",
                (false, false) => "a file",
            };
            return Err(unfit("a Zarr group with the array response", found.into()));
        }
        let group = zarrs::group::Group::open(store.clone(), "/")
            .map_err(|e| unfit("a Zarr group with the array response", e.to_string()))?;
        let mut group =
            Self { path: path.to_path_buf(), store, attributes: group.attributes().clone(), checksums: None };
        // Before the checksum: a later version may have another.
        group.check_format()?;
        group.checksums = Checksums::open(&group.store, &group.attributes).map_err(|reason| group.broken(reason))?;
        Ok(group)
    }

    fn check_format(&self) -> Result<()> {
        match self.attributes.get("acquire_format") {
            Some(found) if !found.as_u64().is_some_and(|format| FORMATS.contains(&format)) => {
                let expected = format!("one of {FORMATS:?}, or none; a later one needs a later acquire");
                Err(self.unfit("attribute acquire_format", expected, found))
            }
            _ => Ok(()),
        }
    }

    fn broken(&self, reason: String) -> Error {
        self.store.broken(&self.path, reason)
    }

    fn unfit(&self, part: &str, expected: impl Into<String>, found: impl std::fmt::Display) -> Error {
        let (part, expected, found) = (part.to_owned(), expected.into(), found.to_string());
        Error::MatrixFormat { path: self.path.clone(), part, expected, found }
    }

    fn attribute<T: DeserializeOwned>(&self, name: &str, expected: &str) -> Result<Option<T>> {
        match self.attributes.get(name) {
            None | Some(Value::Null) => Ok(None),
            Some(value) => serde_json::from_value(value.clone()).map(Some).map_err(|e| {
                self.unfit(
                    &format!("attribute {name}"),
                    expected,
                    format_args!("{} ({e})", shortened(&value.to_string())),
                )
            }),
        }
    }

    fn array(&self, name: &str) -> Result<Option<Array<StoreFiles>>> {
        let there = self.store.has(name, &["zarr.json", ".zarray"]).map_err(Error::io("read", &self.path))?;
        if !there {
            return match self.store.is_folder(name) {
                true => Err(self.broken(format!("array {name}: zarr.json is missing"))),
                false => Ok(None),
            };
        }
        let part = format!("array {name}");
        check_metadata(&self.store, name).map_err(|reason| self.broken(format!("{part}: {reason}")))?;
        match Array::open(self.store.clone(), &format!("/{name}")) {
            Ok(array) => Ok(Some(array)),
            Err(e @ ArrayCreateError::CodecsCreateError(_)) => {
                Err(self.unfit(&part, "codecs that docs/matrix-format.md lists", e))
            }
            Err(e) => Err(self.broken(format!("{part}: {e}"))),
        }
    }

    fn row_array(&self, name: &str) -> Result<Option<RowArray>> {
        let Some(array) = self.array(name)? else { return Ok(None) };
        let part = format!("array {name}");
        self.check_unit(name, &array)?;
        RowArray::new(array).map(Some).map_err(|[expected, found]| self.unfit(&part, expected, found))
    }

    /// A small array, and the names of its dimensions.
    fn small(&self, name: &str, most: usize) -> Result<Option<Small>> {
        let Some(array) = self.array(name)? else { return Ok(None) };
        let part = format!("array {name}");
        let shape: Vec<usize> = array.shape().iter().map(|&n| usize::try_from(n).unwrap_or(usize::MAX)).collect();
        if shape.iter().try_fold(1, |all: usize, &n| all.checked_mul(n)).is_none_or(|n| n > most) {
            return Err(self.unfit(&part, format!("at most {most} numbers"), format_args!("shape {shape:?}")));
        }
        check_chunks(&array).map_err(|[expected, found]| self.unfit(&part, expected, found))?;
        self.check_unit(name, &array)?;
        let values = wide_numbers(&array, &array.subset_all()).map_err(|reason| {
            match reason.starts_with("numbers of type") {
                true => self.unfit(&part, "numbers", reason),
                false => self.broken(format!("{part}: {reason}")),
            }
        })?;
        Ok(Some((values, shape, dimension_names(&array))))
    }

    /// The numbers of a small array that has to be there, of this shape.
    fn numbers(&self, name: &str, expected: &[usize]) -> Result<Vec<f64>> {
        match self.small(name, expected.iter().product())? {
            Some((values, shape, _)) if shape == expected => Ok(values),
            other => {
                let found = other.map_or("none".to_owned(), |(_, shape, _)| format!("{shape:?}"));
                Err(self.unfit(&format!("array {name}"), format!("shape {expected:?}"), found))
            }
        }
    }

    /// The strings of an array that has to be there, so many.
    fn texts(&self, name: &str, count: usize) -> Result<Vec<String>> {
        let part = format!("array {name}");
        let array = self.array(name)?.ok_or_else(|| self.unfit(&part, format!("{count} strings"), "none"))?;
        if *array.data_type() != data_type::string() || array.shape() != [count as u64] {
            let found = format!("shape {:?} of {}", array.shape(), array.data_type());
            return Err(self.unfit(&part, format!("{count} strings"), found));
        }
        check_chunks(&array).map_err(|[expected, found]| self.unfit(&part, expected, found))?;
        array.retrieve_array_subset(&array.subset_all()).map_err(|e| self.broken(format!("{part}: {e}")))
    }

    /// Refuses another unit than this store's, where an array states one.
    fn check_unit(&self, name: &str, array: &Array<StoreFiles>) -> Result<()> {
        let unit = match name {
            "response" | "common_sd" => 0,
            "variance" => 1,
            "valid" | "row_scale_sd" => return Ok(()),
            _ if name.starts_with("shot") => return Ok(()),
            _ => 2,
        };
        let (expected, spelled) = UNITS[unit];
        match array.attributes().get("units").and_then(Value::as_str).map(str::trim) {
            Some(found) if !spelled.contains(&found) => {
                Err(self.unfit(&format!("array {name}"), format!("units {expected}"), found))
            }
            _ => Ok(()),
        }
    }

    /// Refuses places under the names of the axes, as xarray's coordinates of the axes are written: they would not be
    /// read.
    fn refuse_places_as_indices(&self) -> Result<()> {
        for name in ["x_i", "y_i"] {
            let Some(array) = self.array(name)? else { continue };
            let float = [data_type::float64(), data_type::float32(), data_type::float16()].contains(array.data_type());
            if float && self.array(&format!("{name}_mm"))?.is_none() {
                let expected = "whole numbers, or none (places in mm are the arrays x_i_mm and y_i_mm)";
                return Err(self.unfit(&format!("array {name}"), expected, "numbers of floating point"));
            }
        }
        Ok(())
    }

    /// Refuses channels in another order, where an array of strings names them.
    fn check_channel_names(&self, channels: usize) -> Result<()> {
        // Other kinds of text are for other programs.
        let Ok(Some(array)) = self.array("channel") else { return Ok(()) };
        let names = *array.data_type() == data_type::string() && array.shape() == [CHANNELS as u64];
        if channels != CHANNELS || !names || check_chunks(&array).is_err() {
            return Ok(());
        }
        let names: Vec<String> = array.retrieve_array_subset(&array.subset_all()).unwrap_or_default();
        let initials: Vec<String> =
            names.iter().map(|n| n.chars().take(1).collect::<String>().to_uppercase()).collect();
        match initials == ["R", "G", "B"] || initials.iter().all(|n| !["R", "G", "B"].contains(&n.as_str())) {
            true => Ok(()),
            false => Err(self.unfit("array channel", "R, G, B in this order", names.join(", "))),
        }
    }

    /// Offsets of samples from the lit point along one axis, mm.
    fn offsets(&self, name: &str, samples: usize) -> Result<Option<Vec<f64>>> {
        let Some((values, shape, _)) = self.small(name, samples)? else { return Ok(None) };
        match values.len() == samples {
            true => Ok(Some(values)),
            false => Err(self.unfit(
                &format!("array {name}"),
                format!("{samples} offsets, one a sample"),
                format_args!("shape {shape:?}"),
            )),
        }
    }

    /// One number for each lit point, row-major: an array over both of the points' axes, over one, or of one number.
    fn over_points(&self, name: &str, [nx, ny]: [usize; 2]) -> Result<Option<Vec<f64>>> {
        let Some((values, shape, names)) = self.small(name, nx * ny)? else { return Ok(None) };
        let wrong = || {
            self.unfit(&format!("array {name}"), format!("shape [{ny}, {nx}] over y_i, x_i"), format_args!("{shape:?}"))
        };
        // Axes that are not named are told by their number.
        let axes = match names {
            Some(names) => names,
            None if shape.len() == 2 => AXES[..2].iter().map(|s| (*s).to_owned()).collect(),
            None if shape.is_empty() => Vec::new(),
            None => return Err(wrong()),
        };
        let sides: Vec<usize> =
            axes.iter().map(|axis| [ny, nx, 0][AXES[..2].iter().position(|a| a == axis).unwrap_or(2)]).collect();
        if sides != shape || axes.len() == 2 && axes[0] != AXES[0] {
            return Err(wrong());
        }
        let at = |k: usize| match axes.as_slice() {
            [] => 0,
            [one] if one == AXES[0] => k / nx,
            [_] => k % nx,
            _ => k,
        };
        let values: Vec<f64> = (0..nx * ny).map(|k| values[at(k)]).collect();
        if let Some(k) = values.iter().position(|v| !v.is_finite()) {
            let found = format_args!("{} at lit point [{}, {}]", values[k], k % nx, k / nx).to_string();
            return Err(self.unfit(&format!("array {name}"), "finite numbers", found));
        }
        Ok(Some(values))
    }

    /// Three numbers, or one for all channels, for each place of two axes.
    fn by_channel(&self, name: &str, sides: [usize; 2]) -> Result<Option<Vec<[f64; CHANNELS]>>> {
        let places = sides[0] * sides[1];
        let Some((values, shape, _)) = self.small(name, CHANNELS * places)? else { return Ok(None) };
        let channels = values.len() / places;
        if shape != [sides[0], sides[1], channels] || ![1, CHANNELS].contains(&channels) {
            let expected = format!("shape {:?}", [sides[0], sides[1], CHANNELS]);
            return Err(self.unfit(&format!("array {name}"), expected, format_args!("{shape:?}")));
        }
        Ok(Some(values.chunks(channels).map(|v| std::array::from_fn(|c| v[c % channels])).collect()))
    }

    /// Refuses more lit points than what is stored could be of, before memory is set aside for them.
    fn believe(&self, rows: usize) -> Result<()> {
        if rows <= FEW_POINTS {
            return Ok(());
        }
        let bytes = match self.store.bytes("response") {
            // A plain server does not tell.
            Err(e) if e.kind() == std::io::ErrorKind::Unsupported => return Ok(()),
            bytes => bytes.map_err(Error::io("read", &self.path))?,
        };
        match rows / POINTS_A_BYTE <= usize::try_from(bytes).unwrap_or(usize::MAX) {
            true => Ok(()),
            false => Err(self.broken(format!("array response: {rows} rows in {bytes} bytes"))),
        }
    }
}

/// Long values at a glance.
fn shortened(text: &str) -> String {
    match text.char_indices().nth(60) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text.to_owned(),
    }
}
