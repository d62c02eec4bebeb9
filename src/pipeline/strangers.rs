//! Photographs that do not show what the others of their shot show: what they look like instead, and whether the capture can be believed.

use super::BuildOptions;
use super::photographs::Photographs;
use crate::capture::{Pattern, Samples};
use crate::radiance::{Radiance, decode_spread};
use crate::{ConsistencyWarning, Error, Result, Warning};

/// Of the shots of a kind that have such a photograph, more than this share are a fault of the set-up, not of a photograph.
const SINGLE_SHARE: f64 = 0.2;
/// Pictures that agree this well in the logarithm of their light are the same picture.
const SAME: f64 = 0.9;
/// Movements that are tried, px of the working resolution.
const MOVED_PX: isize = 6;

/// What came of the stages, with what is to be told of such photographs. Where they failed, it is because of them.
///
/// # Errors
/// [`crate::Error::Contradiction`]; those of decoding; that of the stages when there are no such photographs, or when they are accepted.
pub(super) fn with_findings<T>(
    photographs: &Photographs<'_>,
    options: &BuildOptions,
    done: Result<T>,
) -> Result<(T, Option<Warning>)> {
    if done.as_ref().is_err_and(Error::is_internal) {
        return done.map(|done| (done, None));
    }
    let finding = judge(photographs, options)?;
    match (done, finding) {
        (Ok(done), finding) => Ok((done, finding)),
        (Err(error), Some(finding)) => Err(options.refuse(finding).err().unwrap_or(error)),
        (Err(error), None) => Err(error),
    }
}

/// What to tell of them.
///
/// # Errors
/// [`crate::Error::Contradiction`] when it is not known which photograph is right, or when so many do not agree that no single mistake
/// explains it; those of decoding.
fn judge(photographs: &Photographs<'_>, options: &BuildOptions) -> Result<Option<Warning>> {
    let strangers = photographs.strangers()?;
    // The worst is told: what it looks like is seen best.
    let first = strangers.iter().max_by(|a, b| (a.1.or.is_some()).cmp(&b.1.or.is_some()).then(b.0.cmp(a.0)));
    let Some((&[shot, place], stranger)) = first else { return Ok(None) };
    let of_lattice = |shot: usize| matches!(photographs.capture.manifest.shots[shot].pattern, Pattern::Lattice { .. });
    let lattice = photographs.capture.shots(|p| matches!(p, Pattern::Lattice { .. })).len();
    let mut shots: Vec<usize> = strangers.keys().map(|[shot, _]| *shot).filter(|&s| of_lattice(s)).collect();
    shots.dedup();
    let file = |place: usize| photographs.capture.name_of(&photographs.brackets[shot][place].path);
    let finding = ConsistencyWarning::PhotographDisagrees {
        file: file(place),
        shot: photographs.name(shot).to_owned(),
        looks: match stranger.factor {
            Some(factor) => format!("its light is {factor:.2} times what its exposure time says"),
            None => looks(photographs, shot, place)?,
        },
        share: stranger.share,
        photographs: strangers.len(),
        or: stranger.or.map(|k| file(k)),
    };
    if stranger.or.is_some() || shots.len() as f64 > (SINGLE_SHARE * lattice as f64).max(1.0) {
        return options.refuse(finding).map(Some);
    }
    Ok(Some(finding.into()))
}

/// What a photograph shows, in words that follow "it looks like".
fn looks(photographs: &Photographs<'_>, shot: usize, place: usize) -> Result<String> {
    if let Some(bits) = other_bits(photographs, shot, place)? {
        return Ok(bits);
    }
    let own = photographs.merge_some(shot, |k| k == place)?;
    let light = Levels::of(&own);
    let Some(light) = light else { return Ok("it is black".into()) };
    let others = photographs.merge_some(shot, |k| k != place)?;
    let mut candidates: Vec<(f64, String)> = Vec::new();
    let seen = light.of_picture(&own);
    let rest = light.of_picture(&others);
    let [w, h] = [own.rect.width as isize, own.rect.height as isize];
    let moved = |dx: isize, dy: isize| correlation(&seen, |x, y| at(&rest, [w, h], x - dx, y - dy), [w, h]);
    candidates.push((moved(0, 0), "it has another brightness, response curve or sharpness".into()));
    candidates.push((
        correlation(&seen, |x, y| at(&rest, [w, h], w - 1 - x, h - 1 - y), [w, h]),
        "it is turned by 180°".into(),
    ));
    candidates.push((
        correlation(&seen, |x, y| at(&rest, [w, h], w - 1 - x, y), [w, h]),
        "it is mirrored left to right".into(),
    ));
    candidates.push((
        correlation(&seen, |x, y| at(&rest, [w, h], x, h - 1 - y), [w, h]),
        "it is mirrored top to bottom".into(),
    ));
    for near in [shot.checked_sub(1), Some(shot + 1)].into_iter().flatten() {
        if near < photographs.brackets.len() {
            let picture = light.of_picture(&photographs.merge_some(near, |_| true)?);
            let name = photographs.name(near);
            candidates.push((
                correlation(&seen, |x, y| at(&picture, [w, h], x, y), [w, h]),
                format!("it shows shot \"{name}\""),
            ));
        }
    }
    let shifts = (-MOVED_PX..=MOVED_PX).flat_map(|dy| (-MOVED_PX..=MOVED_PX).map(move |dx| (dx, dy)));
    let best = shifts.map(|(dx, dy)| (moved(dx, dy), dx, dy)).max_by(|a, b| a.0.total_cmp(&b.0));
    if let Some((r, dx, dy)) = best.filter(|b| (b.1, b.2) != (0, 0)) {
        // A movement has two numbers to fit with.
        candidates.push((r - 0.01, format!("it has moved by about {dx}, {dy} px")));
    }
    let best = candidates.into_iter().max_by(|a, b| a.0.total_cmp(&b.0));
    Ok(best
        .filter(|b| b.0 > SAME)
        .map_or("it looks like neither the shots beside it nor itself turned or moved".into(), |b| b.1))
}

/// Another number of bits than the others have.
fn other_bits(photographs: &Photographs<'_>, shot: usize, place: usize) -> Result<Option<String>> {
    let look = |k: usize| {
        let (photograph, size_px) = photographs.as_taken(shot, k);
        let seen = decode_spread(&[photograph], size_px, 1 << 16)?;
        Ok::<_, Error>(seen.exposures()[0].samples.clone())
    };
    let Some(other) = (0..photographs.brackets[shot].len()).rev().find(|&k| k != place) else { return Ok(None) };
    let (own, other) = (look(place)?, look(other)?);
    Ok(match (&own, &other) {
        (Samples::U8(_), Samples::U16(_)) => Some("it has 8 bits, the others have 16".into()),
        (Samples::U16(_), Samples::U8(_)) => Some("it has 16 bits, the others have 8".into()),
        (Samples::U16(a), Samples::U16(b)) => {
            let (a, b) = (low_zeros(a), low_zeros(b));
            match a.cmp(&b) {
                std::cmp::Ordering::Greater => Some(format!(
                    "its values are multiples of {}, those of the others of {}: its bits are shifted left",
                    1 << a,
                    1 << b
                )),
                std::cmp::Ordering::Less => Some(format!(
                    "its values are multiples of {}, those of the others of {}: its bits are shifted right",
                    1 << a,
                    1 << b
                )),
                std::cmp::Ordering::Equal => None,
            }
        }
        _ => None,
    })
}

/// Low bits that are 0 in all values but saturated ones.
fn low_zeros(values: &[u16]) -> u32 {
    let any = values.iter().filter(|v| **v != u16::MAX).fold(0, |all, v| all | v);
    if any == 0 { 0 } else { any.trailing_zeros() }
}

/// The range of light that a photograph shows.
struct Levels {
    low: f32,
    high: f32,
}

impl Levels {
    /// `None` when it shows none.
    fn of(picture: &Radiance) -> Option<Self> {
        let mut sd: Vec<f32> = picture
            .luminance_variance()
            .into_iter()
            .zip(picture.used.as_chunks::<3>().0)
            .filter(|(_, u)| !u.contains(&0))
            .map(|(v, _)| v.sqrt())
            .collect();
        let middle = sd.len() / 10;
        let low = 6.0 * if sd.is_empty() { return None } else { *sd.select_nth_unstable_by(middle, f32::total_cmp).1 };
        let high = picture.luminance().into_iter().fold(0.0, f32::max);
        (high > 2.0 * low).then_some(Self { low, high })
    }

    /// Logarithms of the light, as far as that photograph would show it; what saturates is the brightest.
    fn of_picture(&self, picture: &Radiance) -> Vec<f32> {
        let used = picture.used.as_chunks::<3>().0;
        let light = picture.luminance();
        light
            .iter()
            .zip(used)
            .map(|(v, u)| if u.contains(&0) { self.high } else { v.clamp(self.low, self.high) }.ln())
            .collect()
    }
}

/// Outside, the nearest pixel.
fn at(picture: &[f32], [w, h]: [isize; 2], x: isize, y: isize) -> f32 {
    picture[(y.clamp(0, h - 1) * w + x.clamp(0, w - 1)) as usize]
}

fn correlation(a: &[f32], b: impl Fn(isize, isize) -> f32, [w, h]: [isize; 2]) -> f64 {
    let mut sums = [0.0f64; 5];
    for y in 0..h {
        for x in 0..w {
            let (a, b) = (f64::from(a[(y * w + x) as usize]), f64::from(b(x, y)));
            [a, b, a * a, b * b, a * b].into_iter().zip(&mut sums).for_each(|(v, s)| *s += v);
        }
    }
    let n = (w * h) as f64;
    let [a, b, aa, bb, ab] = sums.map(|s| s / n);
    let spread = ((aa - a * a) * (bb - b * b)).sqrt();
    if spread > 0.0 { (ab - a * b) / spread } else { 0.0 }
}
