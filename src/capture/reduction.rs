//! Photographs of fewer, larger pixels: means of blocks, as a camera of that resolution would have taken them.
//!
//! Means are of light: code values that are a curve of it are made linear first.

use super::kept::Room;
use super::rows::{PAST_THE_END, RowReader};
use super::{Camera, Capture, Photograph, Pixels, Samples, Sampling};
use crate::{Error, Result};
use std::sync::Arc;

/// Blocks of so many pixels along each axis become one.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Reduction {
    /// Pixels of a block along each axis.
    pub factor: usize,
    /// Code values from here on are saturated.
    pub saturation_dn: f64,
    /// Photosites that are left out of the means of all photographs alike: they measure something else than light.
    #[serde(default, with = "shared")]
    pub left_out: Arc<[Photosite]>,
    /// Camera pixels across an outgoing sample, before.
    pub sample_px: f64,
    /// What makes whole code values linear; `None` where they are in proportion to light.
    #[serde(skip)]
    pub light: Option<Arc<LightOfCodes>>,
}

/// Linear values (DN, the pedestal included) of whole code values, R G B for each.
#[derive(Debug, Clone, PartialEq)]
pub struct LightOfCodes {
    /// 3 · 256 of them.
    pub of_u8: Vec<f32>,
    /// 3 · 65,536 of them.
    pub of_u16: Vec<f32>,
}

impl Reduction {
    /// Blocks of `factor` pixels a side, of which no photosite is left out, each an outgoing sample.
    pub fn new(factor: usize, saturation_dn: f64, light: Option<Arc<LightOfCodes>>) -> Self {
        Self { factor, saturation_dn, left_out: Arc::default(), sample_px: factor as f64, light }
    }

    /// Blocks across an outgoing sample.
    pub fn sample_blocks(&self) -> f64 {
        self.sample_px / self.factor as f64
    }
}

/// Row, column and channel of a photosite; in this order.
pub type Photosite = [u32; 3];

/// As a list of its own.
mod shared {
    use super::{Arc, Photosite};
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub(super) fn serialize<S: Serializer>(sites: &Arc<[Photosite]>, to: S) -> Result<S::Ok, S::Error> {
        sites.as_ref().serialize(to)
    }

    pub(super) fn deserialize<'d, D: Deserializer<'d>>(from: D) -> Result<Arc<[Photosite]>, D::Error> {
        Vec::deserialize(from).map(Arc::from)
    }
}

/// The rows of a photograph, reduced as it says, from the first to the last.
pub struct PhotographRows<'a> {
    photograph: &'a Photograph,
    source: Source,
    size_px: [usize; 2],
    /// Rows that were taken.
    taken: usize,
    /// What is to be kept of it: all rows that were taken.
    record: Option<Record>,
}

enum Source {
    File { reader: Box<RowReader>, blocks: Option<Box<Blocks>> },
    Memory(Arc<Pixels>),
}

struct Record {
    room: Room,
    samples: Samples,
}

impl<'a> PhotographRows<'a> {
    pub(super) fn new(photograph: &'a Photograph, mut reader: RowReader) -> Result<Self> {
        let blocks =
            photograph.reduction.as_ref().filter(|by| by.factor > 1).map(|by| Blocks::new(by, reader.size_px[0]));
        let [width, height] = reader.size_px.map(|s| s / blocks.as_ref().map_or(1, |b| b.factor));
        // Means are of four bytes; of others it is not known yet, and floating point is seldom.
        let bytes = 3 * width * height * if blocks.is_some() { 4 } else { 2 };
        let room = photograph.kept.room(bytes);
        if !reader.is_whole() {
            let record = room.map(|room| Record { room, samples: Samples::U8(vec![]) });
            let source = Source::File { reader: Box::new(reader), blocks: blocks.map(Box::new) };
            return Ok(Self { photograph, source, size_px: [width, height], taken: 0, record });
        }
        // What is in memory as a whole is reduced at once: other exposures are read beside it.
        let mut samples = Samples::F32(vec![]);
        let sampling = match blocks {
            None => {
                samples = reader.take_samples();
                reader.sampling
            }
            Some(mut blocks) => {
                for _ in 0..height {
                    blocks.line(&mut reader, &mut samples).map_err(|reason| photograph.broken(reason))?;
                }
                blocks.sampling(reader.sampling)
            }
        };
        let pixels = Arc::new(Pixels { width, height, samples, sampling });
        if let Some(room) = room {
            room.put(&photograph.path, photograph.factor(), pixels.clone());
        }
        Ok(Self::of_memory(photograph, pixels))
    }

    pub(super) fn of_memory(photograph: &'a Photograph, pixels: Arc<Pixels>) -> Self {
        let size_px = [pixels.width, pixels.height];
        Self { photograph, source: Source::Memory(pixels), size_px, taken: 0, record: None }
    }

    /// Columns and rows.
    pub fn size_px(&self) -> [usize; 2] {
        self.size_px
    }

    /// Where in its pixel each channel was measured.
    pub fn sampling(&self) -> Sampling {
        match &self.source {
            Source::File { reader, blocks } => blocks.as_ref().map_or(reader.sampling, |b| b.sampling(reader.sampling)),
            Source::Memory(pixels) => pixels.sampling,
        }
    }

    /// Refuses a photograph that is not of this size.
    ///
    /// # Errors
    /// [`Error::BrokenPhotograph`].
    pub fn check_size(&self, size_px: [usize; 2]) -> Result<()> {
        let [width, height] = self.size_px;
        match [width, height] == size_px {
            true => Ok(()),
            false => Err(self.broken(format!("{width} × {height} px were decoded, its head says {size_px:?}"))),
        }
    }

    /// Puts the next `rows` rows, which must be there, into `out` in the place of what it holds.
    ///
    /// # Errors
    /// [`Error::BrokenPhotograph`].
    pub fn read(&mut self, rows: usize, out: &mut Samples) -> Result<()> {
        let first = self.taken;
        self.taken += rows;
        let done = match &mut self.source {
            Source::File { reader, blocks: None } => reader.read(rows, out),
            Source::File { reader, blocks: Some(blocks) } => {
                out.refill_f32(|_| ());
                (0..rows).try_for_each(|_| blocks.line(reader, out))
            }
            Source::Memory(pixels) => {
                let line = 3 * pixels.width;
                out.clear();
                match self.taken <= pixels.height {
                    true => out.extend(&pixels.samples, line * first..line * self.taken),
                    false => return Err(self.broken(PAST_THE_END.into())),
                }
                Ok(())
            }
        };
        done.map_err(|reason| self.broken(reason))?;
        if let Some(record) = &mut self.record {
            record.samples.extend(out, 0..out.len());
        }
        Ok(())
    }

    /// Leaves out the next `rows` rows, which must be there.
    ///
    /// # Errors
    /// [`Error::BrokenPhotograph`].
    pub fn skip(&mut self, rows: usize) -> Result<()> {
        let Source::File { reader, blocks } = &mut self.source else {
            self.taken += rows;
            return Ok(());
        };
        // Where skipping saves no decoding, what is skipped may as well be kept.
        if self.record.is_some() && !reader.skips() {
            let mut row = Samples::U8(vec![]);
            return (0..rows).try_for_each(|_| self.read(1, &mut row));
        }
        self.record = None;
        self.taken += rows;
        let factor = blocks.as_ref().map_or(1, |b| b.factor);
        if let Some(blocks) = blocks {
            blocks.taken += factor * rows;
        }
        let done = reader.skip(factor * rows);
        done.map_err(|reason| self.broken(reason))
    }

    /// Reads what is left of the file: damage shows in its decoding.
    ///
    /// # Errors
    /// [`Error::BrokenPhotograph`].
    pub fn finish(&mut self) -> Result<()> {
        if self.record.is_some() {
            let left = self.size_px[1] - self.taken;
            self.skip(left)?;
        }
        let Source::File { reader, blocks } = &mut self.source else { return Ok(()) };
        let left = reader.size_px[1] - blocks.as_ref().map_or(1, |b| b.factor) * self.taken;
        let mut row = Samples::U8(vec![]);
        let mut end = || {
            (0..left).try_for_each(|_| reader.read(1, &mut row))?;
            reader.finish()
        };
        end().map_err(|reason| self.photograph.broken(reason))?;
        if let Some(Record { room, samples }) = self.record.take() {
            let ([width, height], sampling) = (self.size_px, self.sampling());
            let pixels = Arc::new(Pixels { width, height, samples, sampling });
            room.put(&self.photograph.path, self.photograph.factor(), pixels.clone());
            self.source = Source::Memory(pixels);
        }
        Ok(())
    }

    fn broken(&self, reason: String) -> Error {
        self.photograph.broken(reason)
    }
}

/// A line of blocks.
#[derive(Debug, Clone)]
struct Blocks {
    factor: usize,
    saturation_dn: f32,
    across: usize,
    row: Samples,
    /// Of each column and channel, over the rows of the line: sum of whole code values, of others, and how many are
    /// saturated.
    whole: Vec<u32>,
    float: Vec<f32>,
    full: Vec<u32>,
    /// Of each block and channel, pixels of the line that are left out.
    missing: Vec<u32>,
    left_out: Arc<[Photosite]>,
    light: Option<Arc<LightOfCodes>>,
    /// Rows that were read.
    taken: usize,
}

impl Blocks {
    fn new(by: &Reduction, width: usize) -> Self {
        let across = width / by.factor;
        let n = 3 * across * by.factor;
        let (whole, float, full) = (vec![0; n], vec![0.0; n], vec![0; n]);
        let saturation_dn = by.saturation_dn as f32;
        let (row, missing, left_out) = (Samples::U8(vec![]), vec![0; 3 * across], by.left_out.clone());
        let (factor, light) = (by.factor, by.light.clone());
        Self { factor, saturation_dn, across, row, whole, float, full, missing, left_out, light, taken: 0 }
    }

    fn sampling(&self, of_pixels: Sampling) -> Sampling {
        let n = self.factor as f64;
        Sampling {
            offset_px: of_pixels.offset_px.map(|o| o.map(|o| o / n)),
            aperture_px: of_pixels.aperture_px.map(|a| (n - 1.0 + a) / n),
            variance_share: of_pixels.variance_share,
        }
    }

    /// Appends the next line's means to `out`, which must be floating point. A block that is saturated in part measured
    /// nothing (NaN), one that is saturated as a whole stays saturated.
    fn line(&mut self, reader: &mut RowReader, out: &mut Samples) -> std::result::Result<(), String> {
        self.whole.fill(0);
        self.float.fill(0.0);
        self.full.fill(0);
        self.missing.fill(0);
        // Whole code values are compared as such: the least that is not below saturation.
        let least = self.saturation_dn.ceil() as u32;
        for _ in 0..self.factor {
            reader.read(1, &mut self.row)?;
            self.leave_out();
            self.taken += 1;
            let (whole, float, full, saturation) =
                (&mut self.whole, &mut self.float, &mut self.full, self.saturation_dn);
            match (&self.row, &self.light) {
                (Samples::U8(v), None) => add_whole(v, whole, full, least),
                (Samples::U16(v), None) => add_whole(v, whole, full, least),
                (Samples::U8(v), Some(light)) => add_light(looked_up(v, &light.of_u8), float, full, saturation),
                (Samples::U16(v), Some(light)) => add_light(looked_up(v, &light.of_u16), float, full, saturation),
                (Samples::F32(v), _) => add_light(v.iter().copied(), float, full, saturation),
            }
        }
        let means = (0..3 * self.across).map(|k| self.mean(k / 3, k % 3)).collect();
        let n = 3 * self.across;
        out.extend(&Samples::F32(means), 0..n);
        Ok(())
    }

    /// Makes the row's photosites that are left out zero, which adds to no sum (a curve begins at no light) and
    /// saturates nothing, and counts them.
    fn leave_out(&mut self) {
        let row = self.taken as u32;
        let first = self.left_out.partition_point(|site| site[0] < row);
        for &[_, x, c] in self.left_out[first..].iter().take_while(|site| site[0] == row) {
            let (k, block) = (3 * x as usize + c as usize, x as usize / self.factor);
            if block >= self.across {
                continue;
            }
            match &mut self.row {
                Samples::U8(v) => v[k] = 0,
                Samples::U16(v) => v[k] = 0,
                Samples::F32(v) => v[k] = 0.0,
            }
            self.missing[3 * block + c as usize] += 1;
        }
    }

    fn mean(&self, block: usize, channel: usize) -> f32 {
        let columns = || (0..self.factor).map(|i| 3 * (block * self.factor + i) + channel);
        let full: u32 = columns().map(|k| self.full[k]).sum();
        let all = (self.factor * self.factor) as u32 - self.missing[3 * block + channel];
        match full {
            _ if all == 0 => f32::NAN,
            0 => {
                let sum = |k| f64::from(self.whole[k]) + f64::from(self.float[k]);
                (columns().map(sum).sum::<f64>() / f64::from(all)) as f32
            }
            full if full == all => self.saturation_dn,
            _ => f32::NAN,
        }
    }
}

/// Sums of at most 65,536 rows of 16 bits: no sum runs over.
fn add_whole<T: Copy + Into<u32>>(row: &[T], sums: &mut [u32], full: &mut [u32], least: u32) {
    for ((sum, full), &code) in sums.iter_mut().zip(full).zip(row) {
        *sum += code.into();
        *full += u32::from(code.into() >= least);
    }
}

/// Values that are in proportion to light.
fn add_light(row: impl Iterator<Item = f32>, sums: &mut [f32], full: &mut [u32], saturation_dn: f32) {
    for ((sum, full), value) in sums.iter_mut().zip(full).zip(row) {
        *sum += value;
        *full += u32::from(value >= saturation_dn);
    }
}

fn looked_up<T: Copy + Into<usize>>(row: &[T], table: &[f32]) -> impl Iterator<Item = f32> {
    row.iter().zip([0, 1, 2].into_iter().cycle()).map(|(&code, c)| table[3 * code.into() + c])
}

impl Camera {
    /// The same camera with blocks of pixels for pixels.
    pub fn reduced(&self, factor: usize) -> Self {
        let n = factor.max(1) as f64;
        Self {
            size_px: self.size_px.map(|s| s / factor.max(1)),
            focal_px: self.focal_px / n,
            // The first block's centre lies (n − 1)/2 from the first pixel's.
            principal_px: self.principal_px.map(|p| (p - 0.5 * (n - 1.0)) / n),
            ..self.clone()
        }
    }
}

impl Capture {
    /// The same capture as a camera of fewer pixels would have taken it.
    pub fn reduced(&self, by: &Reduction) -> Self {
        let mut reduced = self.clone();
        if by.factor > 1 {
            reduced.rig.camera = self.rig.camera.reduced(by.factor);
            reduced.brackets.iter_mut().flatten().for_each(|p| p.reduction = Some(by.clone()));
        }
        reduced
    }

    /// The same capture with other exposure times: those of `brackets`, its photographs in any resolution.
    pub(crate) fn timed(&self, brackets: &[Vec<Photograph>]) -> Self {
        let as_taken = |p: &Photograph| Photograph { reduction: None, ..p.clone() };
        Self { brackets: brackets.iter().map(|b| b.iter().map(as_taken).collect()).collect(), ..self.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Pixels;

    /// By rows and as a whole, which must be the same.
    fn reduced(size_px: [usize; 2], samples: Samples, by: Reduction) -> Pixels {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        let Samples::U16(codes) = &samples else { panic!("16 bits") };
        let [width, height] = size_px.map(|s| s as u32);
        image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(width, height, codes.clone()).unwrap().save(&path).unwrap();
        let photograph = Photograph { reduction: Some(by), ..Photograph::new(path, "s", 1.0) };
        let found = photograph.decode().unwrap();
        let whole = RowReader::whole(size_px, samples, Sampling::WHOLE);
        let mut rows = PhotographRows::new(&photograph, whole).unwrap();
        let mut again = Samples::U8(vec![]);
        rows.read(found.height, &mut again).unwrap();
        rows.finish().unwrap();
        let bits = |s: &Samples| {
            let Samples::F32(v) = s else { panic!("means are not whole") };
            v.iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        };
        assert_eq!(
            (bits(&again), rows.size_px(), rows.sampling()),
            (bits(&found.samples), [found.width, found.height], found.sampling)
        );
        found
    }

    #[test]
    fn blocks_are_means_and_those_that_saturate_in_part_measured_nothing() {
        // 7 × 5 pixels in blocks of two: 3 × 2 of them; a column and a line are left over.
        let code = |x: usize, y: usize, c: usize| (10 * x + 3 * y + 100 * c) as u16;
        let mut values: Vec<u16> = (0..105).map(|k| code(k / 3 % 7, k / 21, k % 3)).collect();
        values[3 * (2 * 7 + 3) + 1] = 4000;
        for (x, y) in [(4, 2), (5, 2), (4, 3), (5, 3)] {
            values[3 * (y * 7 + x) + 2] = 4000 + x as u16;
        }
        let found = reduced([7, 5], Samples::U16(values), Reduction::new(2, 4000.0, None));
        assert_eq!((found.width, found.height, found.sampling), (3, 2, Sampling::WHOLE));
        let Samples::F32(found) = found.samples else { panic!("means are not whole") };
        for k in 0..18 {
            let (x, y, c) = (k / 3 % 3, k / 9, k % 3);
            match (x, y, c) {
                (1, 1, 1) => assert!(found[k].is_nan(), "a quarter of it is saturated"),
                (2, 1, 2) => assert_eq!(found[k], 4000.0),
                // Five and one and a half are half a step along each axis.
                _ => assert_eq!(found[k], f32::from(code(2 * x, 2 * y, c)) + 5.0 + 1.5),
            }
        }
    }

    #[test]
    fn photosites_that_are_left_out_leave_the_mean_of_the_others() {
        // 7 × 5 pixels in blocks of two; one block saturates in a photosite that is known to be stuck, and in one that
        // is not.
        let code = |x: usize, y: usize, c: usize| (10 * x + 3 * y + 100 * c) as u16;
        let mut values: Vec<u16> = (0..105).map(|k| code(k / 3 % 7, k / 21, k % 3)).collect();
        for (x, y, c) in [(1, 2, 1), (4, 1, 0), (5, 1, 0)] {
            values[3 * (y * 7 + x) + c] = 4000;
        }
        let left_out: Arc<[Photosite]> = Arc::from([[1, 4, 0], [2, 1, 1], [3, 0, 2], [3, 6, 2], [4, 0, 0]]);
        let found = reduced([7, 5], Samples::U16(values), Reduction { left_out, ..Reduction::new(2, 4000.0, None) });
        let Samples::F32(found) = found.samples else { panic!("means are not whole") };
        for k in 0..18 {
            let (x, y, c) = (k / 3 % 3, k / 9, k % 3);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| (2 * x + i, 2 * y + j));
            let mean = |without: (usize, usize)| {
                let rest = four.iter().filter(|&&at| at != without);
                rest.clone().map(|&(x, y)| f64::from(code(x, y, c))).sum::<f64>() / rest.count() as f64
            };
            let expected = match (x, y, c) {
                (2, 0, 0) => {
                    assert!(found[k].is_nan(), "another of it is saturated");
                    continue;
                }
                (0, 1, 1) => mean((1, 2)),
                (0, 1, 2) => mean((0, 3)),
                _ => mean((99, 99)),
            };
            // f32.
            assert!((f64::from(found[k]) - expected).abs() < 1e-4, "{x} {y} {c}: {} {expected}", found[k]);
        }
    }

    #[test]
    fn blocks_of_a_response_curve_are_means_of_its_light() {
        let code = |x: usize, y: usize, c: usize| (40 + 13 * x + 29 * y + 50 * c) as u16;
        let light = |code: u16, c: usize| f32::from(code).powi(2) / 100.0 * [1.0, 0.5, 2.0][c];
        let of_u16 = (0..=u16::MAX).flat_map(|z| [0, 1, 2].map(|c| light(z, c))).collect();
        let table = Arc::new(LightOfCodes { of_u8: vec![], of_u16 });
        let values: Vec<u16> = (0..105).map(|k| code(k / 3 % 7, k / 21, k % 3)).collect();
        // The blue block in the lower right corner is saturated in its brightest pixel, that of code 292.
        let (left_out, saturation_dn) = (Arc::from([[0, 3, 1]]), f64::from(light(290, 2)));
        let by = Reduction { left_out, ..Reduction::new(2, saturation_dn, Some(table)) };
        let found = reduced([7, 5], Samples::U16(values), by);
        let Samples::F32(found) = found.samples else { panic!("means are not whole") };
        for k in 0..18 {
            let (x, y, c) = (k / 3 % 3, k / 9, k % 3);
            let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| (2 * x + i, 2 * y + j));
            let of: Vec<f64> = four
                .iter()
                .filter(|&&at| (at, c) != ((3, 0), 1))
                .map(|&(x, y)| f64::from(light(code(x, y, c), c)))
                .collect();
            if of.iter().any(|&l| l >= saturation_dn) {
                assert!((x, y, c) == (2, 1, 2) && found[k].is_nan());
                continue;
            }
            let expected = of.iter().sum::<f64>() / of.len() as f64;
            // f32.
            assert!((f64::from(found[k]) / expected - 1.0).abs() < 1e-6, "{x} {y} {c}: {} {expected}", found[k]);
        }
        assert_eq!(found.iter().filter(|v| v.is_nan()).count(), 1);
    }

    #[test]
    fn a_reduced_camera_sees_points_in_the_blocks_that_hold_their_pixels() {
        let camera = Camera {
            size_px: [1000, 701],
            focal_px: 1500.0,
            principal_px: [480.0, 350.5],
            response_curve: super::super::ResponseCurve::Linear,
            vignetting: vec![-0.3],
        };
        let small = camera.reduced(7);
        assert_eq!(small.size_px, [142, 100]);
        // A point 0.1 of the focal length from the axis: at 630 px, in the block from 630 to 636, whose middle is 633.
        let at = |c: &Camera| c.principal_px[0] + 0.1 * c.focal_px;
        assert!((at(&camera) - 630.0).abs() < 1e-9 && (at(&small) - (90.0 - 3.0 / 7.0)).abs() < 1e-9);
        let shade = |c: &Camera| c.vignetting_at([at(c), c.principal_px[1]]);
        assert!((shade(&camera) - shade(&small)).abs() < 1e-12, "rounding");
    }
}
