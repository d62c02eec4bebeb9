//! The sensor's noise: the rig's, checked against the photographs, or theirs when the rig has none.

use crate::capture::{Capture, Noise, Pattern, Photograph, Rect, ResponseCurve, Samples, Sampling};
use crate::radiance::{
    Curve, DarkLevels, FileNoise, NoiseEstimate, Sensor, black_level, blocks, channel_gains, fit, saturation,
};
use crate::warning::bounds::DOUBT_SD;
use crate::{ConsistencyWarning, Error, RadianceWarning, Result, Warning};
use rayon::prelude::*;
use std::ops::Range;

/// The noise that the merge uses, and where it comes from.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct FoundNoise {
    pub(super) noise: Noise,
    /// What the photographs say; `None` when the rig says it and they cannot be asked.
    pub(super) estimate: Option<NoiseEstimate>,
    pub(super) from_rig: bool,
    pub(super) warnings: Vec<Warning>,
}

impl FoundNoise {
    /// The same for corrected exposure times, on which a moving black level does not depend.
    ///
    /// # Errors
    /// Those of [`find`].
    pub(super) fn again(self, capture: &Capture) -> Result<Self> {
        let mut found = find(capture)?;
        let moves = |w: &Warning| matches!(w, Warning::Consistency(ConsistencyWarning::BlackMoves { .. }));
        found.warnings.extend(self.warnings.into_iter().filter(moves));
        Ok(found)
    }
}

/// Gray-code shots whose stripes are widest that are taken, of the patterns and of the inverses: two pairs of each; of
/// pictures so large that tiles of them are looked at, one pair.
const SHOTS: usize = 4;
const LARGE_SHOTS: usize = 2;
/// Lattice shots whose longest exposure is searched for clipped photosites.
const BRIGHT_SHOTS: usize = 6;
/// A rig's figure is doubted when it is off by [`DOUBT_SD`] standard deviations and by so much: gain and read noise, of
/// the estimate; black, of the read noise in DN.
const DOUBT_GAIN: f64 = 0.1;
/// Gains of two channels that differ by this share were multiplied: photosites under different filters are alike.
const DOUBT_CHANNEL: f64 = 0.15;
const DOUBT_READ: f64 = 0.25;
const DOUBT_BLACK: f64 = 0.25;
/// Code values that carry noise of less than this are as good as without, DN.
const LEAST_DN: f64 = 0.25;

/// The noise of a capture's sensor.
///
/// # Errors
/// Those of decoding; [`Error::Field`] naming `noise` in the rig file when it is not there and the photographs do not
/// tell it.
pub(super) fn find(capture: &Capture) -> Result<FoundNoise> {
    let linear = capture.rig.camera.response_curve == ResponseCurve::Linear;
    match &capture.rig.noise {
        Some(noise) if !linear => {
            Ok(FoundNoise { noise: noise.clone(), estimate: None, from_rig: true, warnings: vec![] })
        }
        Some(noise) => {
            let estimate = estimate(capture, Some(noise.saturation_dn))?.ok();
            let warnings = estimate.as_ref().map_or(vec![], |e| disagreements(noise, e));
            Ok(FoundNoise { noise: noise.clone(), estimate, from_rig: true, warnings })
        }
        None => {
            let expected = "gain, read noise, black level and saturation: the photographs do not tell them";
            let missing =
                |reason| Error::field(&capture.rig_path, "noise", expected, format!("no [noise], and {reason}"));
            let estimate = estimate(capture, None)?.map_err(missing)?;
            let mut warnings: Vec<Warning> = vec![
                RadianceWarning::NoiseEstimated {
                    gain_dn_per_electron: estimate.noise.gain_dn_per_electron,
                    gain_sd: estimate.gain_sd,
                    read_noise_electrons: estimate.noise.read_noise_electrons,
                    read_noise_sd: estimate.read_noise_sd,
                    black_dn: estimate.noise.black_dn,
                    black_sd: estimate.black_sd,
                    saturation_dn: estimate.noise.saturation_dn,
                    saturation_seen: estimate.saturation_seen,
                }
                .into(),
            ];
            warnings.extend(gains_differ(&estimate));
            Ok(FoundNoise { noise: estimate.noise.clone(), estimate: Some(estimate), from_rig: false, warnings })
        }
    }
}

/// Linear values of encoded files end there, whatever their bits.
const ENCODED_RANGE: f64 = 255.0 + 1e-3;
/// Floating-point photographs are brought to this range: code values may be anything there, 0 to 1 above all.
const FLOAT_RANGE: f64 = 16_384.0;

/// Photon transfer over the capture's own photographs; the inner error is what they lack. `saturation_dn` as far as it
/// is known.
fn estimate(capture: &Capture, saturation_dn: Option<f64>) -> Result<std::result::Result<NoiseEstimate, String>> {
    let mut reader = Reader { capture, unit_dn: None, encoding: encoding(capture)? };
    let saturation_dn = saturation_dn.map(|dn| (dn, true));
    if let Some(sensor) = &reader.encoding {
        reader.unit_dn = Some(f64::from(sensor.full_range()) / FLOAT_RANGE);
    } else if let Some(largest) = reader.largest_of_floats()? {
        reader.unit_dn = Some(saturation_dn.map_or(largest, |s| s.0).max(f64::MIN_POSITIVE) / FLOAT_RANGE);
    }
    let unit_dn = reader.unit_dn.unwrap_or(1.0);
    let saturation = match saturation_dn {
        Some((dn, seen)) => (dn / unit_dn, seen),
        None => saturation(&reader.histograms()?),
    };
    // The pedestal of encoded files is off.
    let black = match reader.encoding {
        Some(_) => Some((0.0, 0.0)),
        None => black_level(&reader.dark_levels(saturation.0)?),
    };
    let Some(black) = black else {
        return Ok(
            Err("neither reference-black nor sample-black nor a dark shot has two unsaturated exposures".into()),
        );
    };
    let width = Tiles::of(capture.rig.camera.size_px).width();
    let grid = |(a, b): &(&Photograph, &Photograph)| {
        let ((a, sampling), (b, _)) = (reader.decode(a)?, reader.decode(b)?);
        let found = blocks([&a, &b], width, black.0, saturation.0, sampling.variance_share);
        let Some(sensor) = &reader.encoding else { return Ok::<_, Error>(found) };
        let of_files = |mean: f64, c: usize| f64::from(sensor.file_variance((mean * unit_dn) as f32, c));
        Ok(found.without(|mean, c| of_files(mean, c) / (unit_dn * unit_dn)))
    };
    let grids = pairs(capture).par_iter().map(grid).collect::<Result<Vec<_>>>()?;
    let rounding = if reader.unit_dn.is_some() { 0.0 } else { 1.0 / 12.0 };
    let gains = channel_gains(&grids, black, saturation, rounding);
    Ok(fit(&grids, black, saturation, rounding).map(|mut found| {
        found.channel_gains = gains.map(|all| all.map(|gain| gain.map(|v| v * unit_dn)));
        found.noise.black_dn *= unit_dn;
        found.noise.saturation_dn *= unit_dn;
        found.noise.gain_dn_per_electron *= unit_dn;
        (found.gain_sd, found.black_sd) = (found.gain_sd * unit_dn, found.black_sd * unit_dn);
        found
    }))
}

/// The pixels of a photograph that are looked at: all along an axis of up to 1536 px, else eight tiles of 192 px,
/// evenly spread. That is 2.4 megapixels at the most: 37,000 blocks a channel, a variance to 1/2000 of itself.
struct Tiles([Vec<Range<usize>>; 2]);

const TILES: usize = 8;
/// A multiple of the side of the blocks of `radiance/noise.rs`: none lies in two tiles.
const TILE_PX: usize = 192;

impl Tiles {
    fn of(size_px: [usize; 2]) -> Self {
        Self(size_px.map(|len| match len > TILES * TILE_PX {
            true => (0..TILES).map(|k| k * (len - TILE_PX) / (TILES - 1)).map(|at| at..at + TILE_PX).collect(),
            false => std::iter::once(0..len).collect(),
        }))
    }

    /// Row by row.
    fn rects(&self) -> Vec<Rect> {
        let [columns, rows] = &self.0;
        let of = |x: &Range<usize>, y: &Range<usize>| Rect { x: x.start, y: y.start, width: x.len(), height: y.len() };
        rows.iter().flat_map(|y| columns.iter().map(move |x| of(x, y))).collect()
    }

    /// Whether there is more along both axes.
    fn are_part(&self) -> bool {
        self.0.iter().all(|ranges| ranges.len() > 1)
    }

    fn width(&self) -> usize {
        self.0[0].iter().map(Range::len).sum()
    }

    /// One picture of the code values of all tiles.
    fn together(&self, parts: &[Samples]) -> Samples {
        let mut all = Samples::U8(vec![]);
        let [columns, rows] = &self.0;
        for (rows, parts) in rows.iter().zip(parts.chunks(columns.len())) {
            for y in 0..rows.len() {
                for (columns, part) in columns.iter().zip(parts) {
                    all.extend(part, 3 * y * columns.len()..3 * (y + 1) * columns.len());
                }
            }
        }
        all
    }
}

/// Decodes photographs of a capture.
struct Reader<'a> {
    capture: &'a Capture,
    /// What makes code values linear, where they are not.
    encoding: Option<Sensor>,
    /// Of floating-point photographs and of those that were made linear, DN: they are divided by it.
    unit_dn: Option<f64>,
}

/// What makes the code values of a rig whose response is not linear linear; a curve that is still to be estimated is
/// taken for sRGB. Black is 0, nothing saturates.
fn encoding(capture: &Capture) -> Result<Option<Sensor>> {
    let curve = Curve::before_estimate(&capture.rig, &capture.rig_path)?;
    let Some(curve) = curve else { return Ok(None) };
    let open =
        Noise { black_dn: 0.0, saturation_dn: ENCODED_RANGE, gain_dn_per_electron: 0.0, read_noise_electrons: 0.0 };
    Ok(Some(Sensor::with_curve(&open, Some(curve), FileNoise::of_capture(capture)?)))
}

impl Reader<'_> {
    /// The tiles of a photograph that are looked at, side by side, in units of `unit_dn`.
    fn decode(&self, photograph: &Photograph) -> Result<(Samples, Sampling)> {
        let tiles = Tiles::of(self.capture.rig.camera.size_px);
        let (parts, sampling) = photograph.decode_parts(&tiles.rects(), self.capture.rig.camera.size_px)?;
        let mut samples = tiles.together(&parts);
        self.to_unit(&mut samples);
        Ok((samples, sampling))
    }

    /// Makes code values linear and divides floating point ones by `unit_dn`, if there is one.
    fn to_unit(&self, samples: &mut Samples) {
        if let Some(sensor) = &self.encoding {
            *samples = sensor.linear_samples(samples);
        }
        if let (Samples::F32(v), Some(unit_dn)) = (samples, self.unit_dn) {
            v.iter_mut().for_each(|v| *v = (f64::from(*v) / unit_dn) as f32);
        }
    }

    /// Shows `see` all rows of a photograph, in units of `unit_dn`, some at a time.
    fn each_row(&self, photograph: &Photograph, mut see: impl FnMut(&Samples)) -> Result<()> {
        let mut rows = photograph.open()?;
        rows.check_size(self.capture.rig.camera.size_px)?;
        let mut row = Samples::U8(vec![]);
        for _ in 0..rows.size_px()[1] {
            rows.read(1, &mut row)?;
            self.to_unit(&mut row);
            see(&row);
        }
        rows.finish()
    }

    /// The longest exposures of the board, of the white reference and of some lattice shots.
    fn brightest(&self) -> Vec<&Photograph> {
        let mut shots = self.capture.shots(|p| matches!(p, Pattern::Board | Pattern::ReferenceWhite));
        let lattice = self.capture.shots(|p| matches!(p, Pattern::Lattice { .. }));
        shots.extend(lattice.iter().step_by(lattice.len().div_ceil(BRIGHT_SHOTS).max(1)));
        shots.iter().filter_map(|&s| self.capture.brackets[s].last()).collect()
    }

    /// The largest code value of floating-point photographs; `None` when they are of whole numbers.
    fn largest_of_floats(&self) -> Result<Option<f64>> {
        let mut largest = None;
        for photograph in self.brightest() {
            let mut row = Samples::U8(vec![]);
            photograph.open()?.read(1, &mut row)?;
            if !matches!(row, Samples::F32(_)) {
                return Ok(None);
            }
            let mut finite = 0.0f32;
            self.each_row(photograph, |row| {
                if let Samples::F32(v) = row {
                    finite = v.iter().copied().filter(|v| v.is_finite()).fold(finite, f32::max);
                }
            })?;
            largest = largest.max(Some(f64::from(finite).to_bits()));
        }
        // Bits of positive numbers are in the order of the numbers.
        Ok(largest.map(f64::from_bits))
    }

    /// Mean code values of the exposures of a covered lens, else of the black shots: those without saturated photosites.
    fn dark_levels(&self, saturation_dn: f64) -> Result<Vec<DarkLevels>> {
        let mut shots = self.capture.shots(|p| matches!(p, Pattern::Dark));
        // Light of a room may be in no proportion to time.
        if shots.iter().all(|&s| self.capture.brackets[s].len() < 2) {
            shots = self.capture.shots(|p| matches!(p, Pattern::ReferenceBlack | Pattern::SampleBlack | Pattern::Dark));
        }
        let level = |p: &Photograph| {
            let (sum, n, high) = sums(&self.decode(p)?.0, saturation_dn);
            // A few hot photosites may saturate: they are left out, and weigh nothing.
            Ok::<_, Error>((n > 0.0 && high <= 1e-3 * n).then(|| (p.effective_secs, sum / n)))
        };
        let bracket = |s: usize| {
            let levels = self.capture.brackets[s].par_iter().map(level).collect::<Result<Vec<_>>>()?;
            Ok(levels.into_iter().flatten().collect())
        };
        shots.into_par_iter().map(bracket).collect()
    }

    /// How often each code value occurs in each channel of the brightest photographs. What is marked as saturated
    /// already is not counted.
    fn histograms(&self) -> Result<[Vec<u32>; 3]> {
        let mut counts = [0, 1, 2].map(|_| vec![0u32; 1 << 16]);
        for photograph in self.brightest() {
            self.each_row(photograph, |row| {
                let mut k = 0;
                row.for_each(|code| {
                    if code.is_finite() {
                        counts[k % 3][(code.round().max(0.0) as usize).min((1 << 16) - 1)] += 1;
                    }
                    k += 1;
                });
            })?;
        }
        Ok(counts)
    }
}

/// Photographs of one exposure of two Gray-code shots, both patterns or both inverses, of different bits or axes.
fn pairs(capture: &Capture) -> Vec<(&Photograph, &Photograph)> {
    let mut pairs = Vec::new();
    for inverses in [false, true] {
        let mut shots: Vec<(u32, usize, usize)> = Vec::new();
        for (s, shot) in capture.manifest.shots.iter().enumerate() {
            if let Pattern::GrayCode { axis, bit, inverse, .. } = shot.pattern
                && inverse == inverses
            {
                shots.push((bit, axis as usize, s));
            }
        }
        // The widest stripes first, the two axes in turn.
        shots.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
        shots.truncate(if Tiles::of(capture.rig.camera.size_px).are_part() { LARGE_SHOTS } else { SHOTS });
        for two in shots.as_chunks::<2>().0 {
            let [first, second] = two.map(|(.., s)| &capture.brackets[s]);
            for a in first {
                let same = |b: &&Photograph| (b.effective_secs / a.effective_secs - 1.0).abs() < 0.01;
                pairs.extend(second.iter().find(same).map(|b| (a, b)));
            }
        }
    }
    pairs
}

/// Sum and number of the code values below `saturation_dn`, and how many are not.
fn sums(samples: &Samples, saturation_dn: f64) -> (f64, f64, f64) {
    let (mut sum, mut n) = (0.0, 0.0);
    samples.for_each(|code| {
        if code < saturation_dn {
            (sum, n) = (sum + code, n + 1.0);
        }
    });
    (sum, n, samples.len() as f64 - n)
}

/// Where a rig's figures and the photographs' cannot both be right.
fn disagreements(given: &Noise, found: &NoiseEstimate) -> Vec<Warning> {
    let measured = &found.noise;
    let range = given.saturation_dn - given.black_dn;
    // Of floating point a code value may be all there is.
    let least_dn = if range < 100.0 { LEAST_DN * range / FLOAT_RANGE } else { LEAST_DN };
    let read_dn = measured.gain_dn_per_electron * measured.read_noise_electrons;
    let figures = [
        (
            "gain_dn_per_electron",
            given.gain_dn_per_electron,
            measured.gain_dn_per_electron,
            found.gain_sd,
            (DOUBT_GAIN * measured.gain_dn_per_electron).max(least_dn * least_dn / range),
        ),
        (
            "read_noise_electrons",
            given.read_noise_electrons,
            measured.read_noise_electrons,
            found.read_noise_sd,
            DOUBT_READ * measured.read_noise_electrons + least_dn / measured.gain_dn_per_electron.max(1e-12),
        ),
        ("black_dn", given.black_dn, measured.black_dn, found.black_sd, DOUBT_BLACK * read_dn.max(4.0 * least_dn)),
    ];
    let doubted =
        figures.into_iter().filter(|(_, given, found, sd, least)| (given - found).abs() > (DOUBT_SD * sd).max(*least));
    let told = |(field, given, found, sd, _): (&str, f64, f64, f64, f64)| {
        RadianceWarning::NoiseDisagrees { field: field.to_owned(), given, found, sd }.into()
    };
    // Gains that differ from channel to channel make one of them all no gain.
    match gains_differ(found) {
        Some(differ) => vec![differ],
        None => doubted.map(told).collect(),
    }
}

/// Of the darkest values of the lattice's photographs, the share that is compared with that of the black shot.
const DARKEST: usize = 20;
/// A black level that differs by more than this share of the range is told.
const BLACK_MOVES: f64 = 5e-4;

/// A black level that is another one in the lattice's photographs than in the black shots: the same difference at all
/// exposure times, which light does not make.
///
/// # Errors
/// Those of decoding.
pub(super) fn black_moves(capture: &Capture, noise: &Noise) -> Result<Option<Warning>> {
    let reader = Reader { capture, unit_dn: None, encoding: None };
    let darkest = |p: &Photograph| -> Result<f64> {
        let mut values = Vec::new();
        reader.decode(p)?.0.for_each(|code| values.extend(code.is_finite().then_some(code)));
        let at = values.len() / DARKEST;
        if values.is_empty() {
            return Ok(noise.black_dn);
        }
        values.select_nth_unstable_by(at, f64::total_cmp);
        Ok(values[..=at].iter().sum::<f64>() / (at + 1) as f64)
    };
    let lattice = capture.shots(|p| matches!(p, Pattern::Lattice { .. }));
    let (Some(&shot), Some(&black)) =
        (lattice.get(lattice.len() / 2), capture.shots(|p| matches!(p, Pattern::SampleBlack)).first())
    else {
        return Ok(None);
    };
    let difference = |p: &Photograph| {
        let same = |b: &&Photograph| (b.effective_secs / p.effective_secs - 1.0).abs() < 0.01;
        let beside = capture.brackets[black].iter().find(same)?;
        let (own, dark) = rayon::join(|| darkest(p), || darkest(beside));
        Some(own.and_then(|own| Ok(own - dark?)))
    };
    let differences: Vec<f64> = capture.brackets[shot].par_iter().filter_map(difference).collect::<Result<_>>()?;
    let least = BLACK_MOVES * (noise.saturation_dn - noise.black_dn);
    let (Some(&first), Some(&last)) = (differences.first(), differences.last()) else { return Ok(None) };
    // The shortest exposure has hardly any of the lattice's own stray light; at the longest that only adds.
    let constant = differences.len() >= 2 && first.abs() > least && (last - first).abs() < first.abs();
    Ok(constant.then(|| {
        ConsistencyWarning::BlackMoves { shot: capture.manifest.shots[shot].name.clone(), difference_dn: first }.into()
    }))
}

/// Gains of the channels that no single gain explains.
fn gains_differ(found: &NoiseEstimate) -> Option<Warning> {
    let gains = found.channel_gains?;
    let gain_sd = gains.iter().map(|g| g[1]).fold(0.0, f64::max);
    let (low, high) = gains.iter().fold((f64::INFINITY, 0.0f64), |(l, h), g| (l.min(g[0]), h.max(g[0])));
    let differ = high - low > (DOUBT_SD * 2f64.sqrt() * gain_sd).max(DOUBT_CHANNEL * low);
    differ.then(|| ConsistencyWarning::ChannelGains { gains: gains.map(|g| g[0]), gain_sd }.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Axis, Surface};

    #[test]
    fn code_values_below_saturation_are_summed_and_the_others_counted() {
        assert_eq!(sums(&Samples::U8(vec![10, 20, 200, 250, 30]), 200.0), (60.0, 3.0, 2.0));
        assert_eq!(sums(&Samples::U16(vec![1000, 4000, 4001]), 4001.0), (5000.0, 2.0, 1.0));
        // NaN is below nothing.
        assert_eq!(sums(&Samples::F32(vec![0.25, f32::NAN, f32::INFINITY, -0.5]), 1.0), (-0.25, 2.0, 2.0));
        assert_eq!(sums(&Samples::U8(vec![]), 200.0), (0.0, 0.0, 0.0));
    }

    #[test]
    fn of_large_pictures_tiles_from_edge_to_edge_are_looked_at_as_one_picture() {
        let small = Tiles::of([1536, 17]);
        assert_eq!((small.rects(), small.width()), (vec![Rect { x: 0, y: 0, width: 1536, height: 17 }], 1536));
        let tiles = Tiles::of([40, 2001]);
        let rects = tiles.rects();
        assert_eq!((rects.len(), tiles.width()), (8, 40));
        assert!(rects.iter().all(|r| (r.x, r.width, r.height) == (0, 40, 192)));
        assert_eq!((rects[0].y, rects[7].y, Tiles::of([6001, 40]).width()), (0, 2001 - 192, 1536));
        // Two by three tiles of two by one pixels.
        let tiles = Tiles([vec![0..2, 8..10], vec![0..1, 5..6, 7..8]]);
        let part = |k: u8| Samples::U8((6 * k..6 * k + 6).collect());
        let parts: Vec<Samples> = (0..6).map(part).collect();
        assert_eq!(tiles.together(&parts), Samples::U8((0..36).collect()));
        assert_eq!(tiles.rects()[3], Rect { x: 8, y: 5, width: 2, height: 1 });
    }

    fn estimate(noise: Noise, sd: [f64; 3]) -> NoiseEstimate {
        NoiseEstimate {
            noise,
            gain_sd: sd[0],
            read_noise_sd: sd[1],
            black_sd: sd[2],
            saturation_seen: true,
            blocks: 500,
            channel_gains: None,
        }
    }

    fn noise(gain_dn_per_electron: f64, read_noise_electrons: f64, black_dn: f64, saturation_dn: f64) -> Noise {
        Noise { black_dn, saturation_dn, gain_dn_per_electron, read_noise_electrons }
    }

    fn doubted(given: &Noise, found: &NoiseEstimate) -> Vec<String> {
        let name = |w: &Warning| match w {
            Warning::Radiance(RadianceWarning::NoiseDisagrees { field, given, found, sd }) => {
                format!("{field} {given} {found} {sd}")
            }
            other => format!("{other:?}"),
        };
        disagreements(given, found).iter().map(name).collect()
    }

    #[test]
    fn a_rigs_figure_is_doubted_when_it_is_off_by_five_deviations_and_by_a_share_that_matters() {
        let measured = noise(0.5, 8.0, 512.0, 16_000.0);
        let small = estimate(measured.clone(), [1e-4, 1e-3, 1e-3]);
        let of = |gain, read, black| doubted(&noise(gain, read, black, 16_000.0), &small);
        assert!(of(0.5, 8.0, 512.0).is_empty());
        // A tenth of the gain; a quarter of the read noise and half an electron (0.25 DN); a quarter of 4 DN of read
        // noise.
        assert!(
            of(0.549, 8.0, 512.0).is_empty() && of(0.5, 10.49, 512.0).is_empty() && of(0.5, 8.0, 512.99).is_empty()
        );
        assert!(of(0.451, 8.0, 512.0).is_empty() && of(0.5, 5.51, 512.0).is_empty() && of(0.5, 8.0, 511.01).is_empty());
        assert_eq!(of(0.551, 8.0, 512.0), ["gain_dn_per_electron 0.551 0.5 0.0001"]);
        assert_eq!(of(0.449, 8.0, 512.0), ["gain_dn_per_electron 0.449 0.5 0.0001"]);
        assert_eq!(of(0.5, 10.51, 512.0), ["read_noise_electrons 10.51 8 0.001"]);
        assert_eq!(of(0.5, 8.0, 513.01), ["black_dn 513.01 512 0.001"]);
        assert_eq!(of(0.6, 2.0, 500.0).len(), 3);
        // Little known: five standard deviations of each.
        let large = estimate(measured, [0.1, 3.0, 2.0]);
        assert!(doubted(&noise(0.99, 22.9, 521.9, 16_000.0), &large).is_empty());
        assert_eq!(doubted(&noise(1.01, 23.1, 522.1, 16_000.0), &large).len(), 3);
    }

    #[test]
    fn of_floating_point_photographs_a_code_value_may_be_all_there_is() {
        // A range of 1: 0.25 of 16,384ths. Read noise of 0.1 · 2e-4 DN is less than that; black may be off by that.
        let least = 0.25 / 16_384.0;
        let found = estimate(noise(2e-4, 0.1, 0.0, 1.0), [1e-9, 1e-9, 1e-9]);
        let of = |black| doubted(&noise(2e-4, 0.1, black, 1.0 + black), &found);
        assert!(of(0.99 * least).is_empty());
        assert_eq!(of(1.01 * least).len(), 1);
        // And the read noise by that many electrons beside a quarter of itself.
        let read = |extra: f64| doubted(&noise(2e-4, 0.125 + extra * least / 2e-4, 0.0, 1.0), &found).len();
        assert_eq!((read(0.99), read(1.01)), (0, 1));
    }

    #[test]
    fn the_widest_stripes_of_both_axes_are_paired_at_equal_exposures() {
        let code = |axis, bit, inverse| Pattern::GrayCode { axis, bit, inverse, on: Surface::default() };
        let capture = super::super::tests::capture(&[
            (Pattern::SampleBlack, &[0.1, 0.4]),
            (code(Axis::X, 2, false), &[0.1, 0.4]),
            (code(Axis::Y, 4, false), &[0.1, 0.4, 0.8]),
            (code(Axis::X, 4, false), &[0.1004, 0.2, 0.4]),
            (code(Axis::X, 3, true), &[0.1, 0.4]),
            (code(Axis::Y, 3, false), &[0.1, 0.4]),
            (code(Axis::X, 3, false), &[0.1, 0.4]),
            (code(Axis::Y, 3, true), &[0.3, 0.41]),
            (code(Axis::X, 1, true), &[0.1]),
        ]);
        let found: Vec<_> =
            pairs(&capture).iter().map(|(a, b)| [a.path.to_str(), b.path.to_str()].map(Option::unwrap)).collect();
        // Bit 4 of x with bit 4 of y, bit 3 with bit 3; the inverses of bit 3 share no exposure to a hundredth, and bit
        // 1 has no partner.
        let expected = [
            ["3-0.1004.png", "2-0.1.png"],
            ["3-0.4.png", "2-0.4.png"],
            ["6-0.1.png", "5-0.1.png"],
            ["6-0.4.png", "5-0.4.png"],
        ];
        assert_eq!(found, expected);
    }
}
