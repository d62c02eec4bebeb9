//! An array over lit points, samples and channels of a store, whatever its chunks, codecs and numbers are, and whoever
//! wrote it.

use super::CHANNELS;
use super::checksum::Checksums;
use super::store_files::StoreFiles;
use super::whole_chunk::WholeChunks;
use rayon::prelude::*;
use std::ops::Range;
use std::sync::Arc;
use zarrs::array::{Array, ArrayShardedExt, ArraySubset, ElementOwned, FromArrayBytes, data_type};

/// A chunk is decoded whole, however little of it an array has: it may be this much larger than the array.
const CHUNK_OVER_ARRAY: u64 = 8;
/// Nor may it have more numbers than this, 16 GiB of f32.
pub(super) const CHUNK_NUMBERS: u64 = 1 << 32;
/// Chunks below this many numbers are never too large.
const SMALL_CHUNK: u64 = 1 << 20;

/// The axes of [`RowArray`], in the order in which they are stored.
pub(super) const AXES: [&str; 5] = ["y_i", "x_i", "dy", "dx", "channel"];

/// Where the numbers of a store's rows lie in its arrays, and in the rows that are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct RowLayout {
    /// Lit points along x and y.
    pub(super) points: [usize; 2],
    /// Samples along dx and dy that are stored.
    pub(super) stored: [usize; 2],
    /// Samples along dx and dy of a row as it is read: `stored`, or more where a crop has left the lit point beside the
    /// middle.
    pub(super) window: [usize; 2],
    /// Columns and lines of `window` before the first that is stored.
    pub(super) before: [usize; 2],
}

/// An array whose axes are some of [`AXES`].
#[derive(Debug)]
pub(super) struct RowArray {
    pub(super) array: Array<StoreFiles>,
    /// Which of [`AXES`] it has; the others are of length one.
    has: [bool; 5],
    /// Numbers along each of [`AXES`].
    pub(super) sides: [usize; 5],
    /// The number that xarray has agreed on to stand for "missing", where it is not NaN.
    missing: Option<f64>,
    /// Its chunks, where they are as this program writes them.
    whole_chunks: Option<WholeChunks>,
}

impl RowArray {
    /// Of an array, with its axes told by their names, or by their number where it has none. Says what is wrong, and
    /// what was expected and found.
    pub(super) fn new(array: Array<StoreFiles>) -> Result<Self, [String; 2]> {
        check_chunks(&array)?;
        let shape = array.shape();
        let names = dimension_names(&array);
        let has = match (&names, shape.len()) {
            (Some(names), _) => {
                let has = AXES.map(|axis| names.iter().any(|name| name == axis));
                let ordered = AXES.iter().zip(has).filter(|(_, has)| *has).map(|(axis, _)| *axis);
                if !ordered.eq(names.iter().map(String::as_str)) {
                    return Err([format!("dimensions {} in this order", AXES.join(", ")), names.join(", ")]);
                }
                has
            }
            (None, 5) => [true; 5],
            (None, 4) => [true, true, true, true, false],
            (None, n) => return Err([format!("the 5 dimensions {}", AXES.join(", ")), format!("{n}, without names")]),
        };
        let mut sides = [1; 5];
        let mut lengths = shape.iter();
        for side in sides.iter_mut().zip(has).filter(|(_, has)| *has).map(|(side, _)| side) {
            *side = lengths.next().map_or(1, |&n| usize::try_from(n).unwrap_or(usize::MAX));
        }
        for field in ["scale_factor", "add_offset"] {
            if array.attributes().contains_key(field) {
                return Err(["numbers as they are (float32)".into(), format!("packed numbers (attribute {field})")]);
            }
        }
        let missing = missing(&array).map_err(|found| ["a number as _FillValue".into(), found])?;
        let whole_chunks = WholeChunks::of(&array).filter(|_| missing.is_none());
        Ok(Self { array, has, sides, missing, whole_chunks })
    }

    /// Where it is.
    pub(super) fn files(&self) -> Arc<StoreFiles> {
        self.array.storage()
    }

    /// Lit points along x and y that one chunk has (of a shard, one of its chunks).
    pub(super) fn chunk_points(&self) -> [usize; 2] {
        let chunk = match self.array.subchunk_shape() {
            Some(chunk) => Some(chunk),
            None => self.array.chunk_shape(&vec![0; self.array.shape().len()]).ok(),
        };
        let mut sides = chunk.into_iter().flatten().map(|n| usize::try_from(n.get()).unwrap_or(usize::MAX));
        let mut side = |has: bool| if has { sides.next().unwrap_or(1) } else { 1 };
        let y = side(self.has[0]);
        [side(self.has[1]), y]
    }

    /// The key of the chunk at a place of the rows as they are stored, when there is no such file.
    pub(super) fn missing_chunk(&self, place: [usize; 5]) -> Option<String> {
        let place: Vec<u64> = place.iter().zip(self.has).filter(|(_, has)| *has).map(|(&n, _)| n as u64).collect();
        let chunk = self.array.chunk_grid().chunk_indices(&place).ok().flatten()?;
        let there = self.array.retrieve_encoded_chunk(&chunk);
        there.ok()?.is_none().then(|| self.array.chunk_key(&chunk).to_string())
    }

    /// What its chunks that are not written would hold, as a number.
    pub(super) fn fill_byte(&self) -> Option<u8> {
        match self.array.fill_value().as_ne_bytes() {
            [byte] => Some(*byte),
            _ => None,
        }
    }

    /// Numbers of lit points, row-major; a range is part of one line of points, or some whole lines. Samples that are
    /// not stored are left as they are in `out`.
    pub(super) fn read(
        &self,
        rows: Range<usize>,
        layout: &RowLayout,
        sums: Option<&Checksums>,
        out: &mut [f32],
    ) -> Result<(), String> {
        if self.read_whole(&rows, layout, sums, bytemuck::cast_slice_mut(out))? {
            return Ok(());
        }
        let is = |t: zarrs::array::DataType| *self.array.data_type() == t;
        if is(data_type::float32()) {
            self.fetch::<f32, _>(&rows, layout, out, |v| v)?;
        } else if is(data_type::float64()) {
            self.fetch::<f64, _>(&rows, layout, out, |v| v as f32)?;
        } else if is(data_type::float16()) {
            self.fetch::<half::f16, _>(&rows, layout, out, f32::from)?;
        } else {
            return Err(format!("numbers of type {}", self.array.data_type()));
        }
        if let Some(missing) = self.missing.map(|v| v as f32) {
            out.iter_mut().filter(|v| **v == missing).for_each(|v| *v = f32::NAN);
        }
        Ok(())
    }

    /// The same of flags: of any whole numbers or truths; those above 255 are 255.
    pub(super) fn read_flags(
        &self,
        rows: Range<usize>,
        layout: &RowLayout,
        sums: Option<&Checksums>,
        out: &mut [u8],
    ) -> Result<(), String> {
        if self.read_whole(&rows, layout, sums, out)? {
            return Ok(());
        }
        let is = |t: zarrs::array::DataType| *self.array.data_type() == t;
        if is(data_type::uint8()) {
            self.fetch::<u8, _>(&rows, layout, out, |v| v)?;
        } else if is(data_type::bool()) {
            self.fetch::<bool, _>(&rows, layout, out, u8::from)?;
        } else {
            let wide = wide_numbers(&self.array, &self.subset(&rows, layout.points[0]))?;
            self.place(&wide, layout, out, |v| if v == 0.0 || v == 1.0 { v as u8 } else { u8::MAX });
        }
        Ok(())
    }

    /// Reads rows of one chunk as this program writes it; false when they must be read otherwise. Whichever way, they
    /// are those of the chunk that was written there.
    fn read_whole(
        &self,
        rows: &Range<usize>,
        layout: &RowLayout,
        sums: Option<&Checksums>,
        out: &mut [u8],
    ) -> Result<bool, String> {
        let name = self.array.path().as_str().trim_start_matches('/');
        if let Some(chunks) = self.whole_chunks.as_ref().filter(|_| layout.stored == layout.window) {
            let sum = sums.and_then(|sums| sums.of_row(name, rows.start));
            if chunks.read(&self.array.storage(), rows, sum, out)? {
                return Ok(true);
            }
        }
        sums.map_or(Ok(()), |sums| sums.check_rows(name, rows)).map(|()| false)
    }

    fn subset(&self, rows: &Range<usize>, nx: usize) -> ArraySubset {
        let (y, x) = (rows.start / nx, rows.start % nx);
        let lines = rows.len().div_ceil(nx).max(1);
        let columns = if lines == 1 { x..x + rows.len() } else { 0..nx };
        let [_, _, h, w, c] = self.sides;
        let ranges = [y..y + lines, columns, 0..h, 0..w, 0..c];
        let ranges: Vec<Range<u64>> = ranges
            .into_iter()
            .zip(self.has)
            .filter(|(_, has)| *has)
            .map(|(r, _)| r.start as u64..r.end as u64)
            .collect();
        ArraySubset::new_with_ranges(&ranges)
    }

    /// Numbers of lit points, each where it belongs in rows of `layout.window`.
    fn fetch<T, U>(
        &self,
        rows: &Range<usize>,
        layout: &RowLayout,
        out: &mut [U],
        as_read: impl Fn(T) -> U + Sync,
    ) -> Result<(), String>
    where
        T: ElementOwned + Copy + Send + Sync,
        U: Copy + Send,
        Vec<T>: FromArrayBytes,
    {
        if let Some(chunk) = self.split_chunk() {
            return self.gather(rows, chunk, layout, out, as_read);
        }
        let subset = self.subset(rows, layout.points[0]);
        let values = self.array.retrieve_array_subset::<Vec<T>>(&subset).map_err(|e| e.to_string())?;
        self.place(&values, layout, out, as_read);
        Ok(())
    }

    /// The sides of chunks that have parts of windows only, as zarr-python makes them when it is not told.
    fn split_chunk(&self) -> Option<[usize; 5]> {
        if self.array.is_sharded() {
            return None;
        }
        let chunk = self.array.chunk_shape(&vec![0; self.array.shape().len()]).ok()?;
        let mut sides = [1; 5];
        let mut lengths = chunk.iter();
        for side in sides.iter_mut().zip(self.has).filter(|(_, has)| *has).map(|(side, _)| side) {
            *side = usize::try_from(lengths.next()?.get()).ok()?;
        }
        (2..5).any(|a| sides[a] < self.sides[a]).then_some(sides)
    }

    /// [`Self::fetch`] chunk by chunk: the numbers of a row that lie side by side in such a chunk are too few for the
    /// general way, which is ten times slower.
    fn gather<T, U>(
        &self,
        rows: &Range<usize>,
        chunk: [usize; 5],
        layout: &RowLayout,
        out: &mut [U],
        as_read: impl Fn(T) -> U + Sync,
    ) -> Result<(), String>
    where
        T: ElementOwned + Copy + Send + Sync,
        U: Copy + Send,
        Vec<T>: FromArrayBytes,
    {
        let nx = layout.points[0];
        let lines = rows.start / nx..(rows.end - 1) / nx + 1;
        let columns = if lines.len() == 1 { rows.start % nx..(rows.end - 1) % nx + 1 } else { 0..nx };
        let [_, _, h, w, c] = self.sides;
        let ranges = [lines, columns, 0..h, 0..w, 0..c];
        let grid: [Range<usize>; 5] =
            std::array::from_fn(|a| ranges[a].start / chunk[a]..ranges[a].end.div_ceil(chunk[a]));
        let counts: [usize; 5] = std::array::from_fn(|a| grid[a].len());
        let decoded: Vec<Vec<T>> = (0..counts.iter().product())
            .into_par_iter()
            .map(|k| {
                let mut rest = k;
                let mut index = [0; 5];
                for a in (0..5).rev() {
                    index[a] = grid[a].start + rest % counts[a];
                    rest /= counts[a];
                }
                let index: Vec<u64> =
                    index.iter().zip(self.has).filter(|(_, has)| *has).map(|(&n, _)| n as u64).collect();
                self.array.retrieve_chunk::<Vec<T>>(&index).map_err(|e| e.to_string())
            })
            .collect::<Result<_, String>>()?;
        let ([wide, high], [left, top]) = (layout.window, layout.before);
        out.par_chunks_mut(CHANNELS * wide * high).enumerate().for_each(|(k, row)| {
            let (y, x) = ((rows.start + k) / nx, (rows.start + k) % nx);
            let of_row = (y / chunk[0] - grid[0].start) * counts[1] + x / chunk[1] - grid[1].start;
            let in_chunk = (y % chunk[0]) * chunk[1] + x % chunk[1];
            for (dy, dx) in (0..h).flat_map(|dy| (0..w).map(move |dx| (dy, dx))) {
                let pixel = &mut row[CHANNELS * ((dy + top) * wide + dx + left)..][..CHANNELS];
                let of_sample = (of_row * counts[2] + dy / chunk[2]) * counts[3] + dx / chunk[3];
                let at = ((in_chunk * chunk[2] + dy % chunk[2]) * chunk[3] + dx % chunk[3]) * chunk[4];
                for (channel, out) in pixel.iter_mut().enumerate() {
                    let channel = channel.min(c - 1);
                    *out = as_read(decoded[of_sample * counts[4] + channel / chunk[4]][at + channel % chunk[4]]);
                }
            }
        });
        Ok(())
    }

    /// Puts stored numbers where they belong in rows of `layout.window`, one channel into all three.
    fn place<T: Copy, U: Copy>(&self, values: &[T], layout: &RowLayout, out: &mut [U], as_read: impl Fn(T) -> U) {
        let channels = self.sides[4];
        if layout.stored == layout.window && channels == CHANNELS {
            out.iter_mut().zip(values).for_each(|(out, &v)| *out = as_read(v));
            return;
        }
        let ([w, h], [wide, high], [left, top]) = (layout.stored, layout.window, layout.before);
        let line_of = |k: usize| ((k / h) * high + k % h + top) * wide + left;
        for (k, line) in values.chunks_exact(w * channels).enumerate() {
            let into = &mut out[CHANNELS * line_of(k)..][..CHANNELS * w];
            for (out, sample) in into.chunks_exact_mut(CHANNELS).zip(line.chunks_exact(channels)) {
                for (c, out) in out.iter_mut().enumerate() {
                    *out = as_read(sample[c.min(channels - 1)]);
                }
            }
        }
    }
}

/// The names of an array's dimensions; those of Zarr v2 are in an attribute.
pub(super) fn dimension_names(array: &Array<StoreFiles>) -> Option<Vec<String>> {
    if let Some(names) = array.dimension_names() {
        return names.iter().cloned().collect();
    }
    let names = array.attributes().get("_ARRAY_DIMENSIONS")?.as_array()?;
    names.iter().map(|name| name.as_str().map(str::to_owned)).collect()
}

/// Refuses chunks, and chunks of shards, of no numbers or of more than [`CHUNK_NUMBERS`], from the metadata of the array
/// `name`: the Zarr crate reckons with their sides when it opens the array. Says what was expected and found.
pub(super) fn check_metadata(files: &StoreFiles, array: &str) -> Result<(), String> {
    let path = |name: &str| format!("{array}/{name}").trim_start_matches('/').to_owned();
    let read = |name: &str| match files.read(&path(name)) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(None),
        text => text.map(|text| Some((name.to_owned(), text))).map_err(|e| format!("{name}: {e}")),
    };
    let Some((name, text)) = read("zarr.json")?.map_or_else(|| read(".zarray"), |found| Ok(Some(found)))? else {
        return Ok(());
    };
    let mut rest: Vec<serde_json::Value> = vec![serde_json::from_slice(&text).map_err(|e| format!("{name}: {e}"))?];
    while let Some(value) = rest.pop() {
        match value {
            serde_json::Value::Array(values) => rest.extend(values),
            serde_json::Value::Object(fields) => {
                for (key, value) in fields.into_iter().filter(|(key, _)| key != "attributes") {
                    match value.as_array().filter(|_| key == "chunk_shape" || key == "chunks") {
                        Some(sides) => check_sides(sides)?,
                        None => rest.push(value),
                    }
                }
            }
            _ => {}
        }
    }
    Ok(())
}

fn check_sides(sides: &[serde_json::Value]) -> Result<(), String> {
    let numbers = sides.iter().try_fold(1u64, |all, side| all.checked_mul(side.as_u64()?));
    match numbers.is_some_and(|n| (1..=CHUNK_NUMBERS).contains(&n)) {
        true => Ok(()),
        false => {
            let found = serde_json::Value::from(sides.to_vec());
            Err(format!("expected chunks of 1 to {CHUNK_NUMBERS} numbers, found {found}"))
        }
    }
}

/// Refuses chunks that memory could not hold.
pub(super) fn check_chunks(array: &Array<StoreFiles>) -> Result<(), [String; 2]> {
    let product = |sides: &[u64]| sides.iter().try_fold(1u64, |all, &n| all.checked_mul(n));
    let numbers = product(array.shape()).unwrap_or(u64::MAX);
    let most = numbers.saturating_mul(CHUNK_OVER_ARRAY).clamp(SMALL_CHUNK, CHUNK_NUMBERS);
    let shape = array.chunk_shape(&vec![0; array.shape().len()]);
    let shape = shape.map_err(|e| ["a chunk or more".to_owned(), e.to_string()])?;
    let shape: Vec<u64> = shape.iter().map(|n| n.get()).collect();
    match product(&shape) {
        Some(n) if n <= most => Ok(()),
        _ => Err([format!("chunks of at most {most} numbers"), format!("chunks of shape {shape:?}")]),
    }
}

/// `_FillValue` where it is a number: xarray writes it as such, or as its bytes in base64.
fn missing(array: &Array<StoreFiles>) -> Result<Option<f64>, String> {
    use base64::Engine;
    let Some(value) = array.attributes().get("_FillValue") else { return Ok(None) };
    let number = match value {
        serde_json::Value::String(text) if text == "NaN" => Some(f64::NAN),
        serde_json::Value::String(text) => {
            let bytes = base64::engine::general_purpose::STANDARD.decode(text).ok();
            bytes.and_then(|bytes| bytes.try_into().ok()).map(f64::from_le_bytes)
        }
        other => other.as_f64(),
    };
    let number = number.ok_or_else(|| value.to_string())?;
    Ok(Some(number).filter(|v| !v.is_nan()))
}

/// Numbers of any type, as f64.
pub(super) fn wide_numbers(array: &Array<StoreFiles>, subset: &ArraySubset) -> Result<Vec<f64>, String> {
    macro_rules! read {
        ($($kind:ident: $type:ty => $as:expr),*) => {
            $(if *array.data_type() == data_type::$kind() {
                let values = array.retrieve_array_subset::<Vec<$type>>(subset).map_err(|e| e.to_string())?;
                return Ok(values.into_iter().map($as).collect());
            })*
        };
    }
    read!(
        float64: f64 => |v| v, float32: f32 => f64::from, float16: half::f16 => f64::from, bool: bool => f64::from,
        uint8: u8 => f64::from, uint16: u16 => f64::from, uint32: u32 => f64::from, uint64: u64 => |v| v as f64,
        int8: i8 => f64::from, int16: i16 => f64::from, int32: i32 => f64::from, int64: i64 => |v| v as f64
    );
    Err(format!("numbers of type {}", array.data_type()))
}
