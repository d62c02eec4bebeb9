//! Photographs that do not show what the others of their shot show: what they look like instead, and whether the
//! capture can be believed.

use super::BuildOptions;
use super::looks::looks;
use super::photographs::Photographs;
use crate::capture::{Pattern, Samples};
use crate::radiance::decode_spread;
use crate::{ConsistencyWarning, Error, Result, Warning};

/// So many photographs have to end at the same code.
const LEAST_CLIPPED: usize = 3;
/// Of the shots of a kind that have such a photograph, more than this share are a fault of the set-up, not of a
/// photograph.
const SINGLE_SHARE: f64 = 0.2;

/// What more than half of the lattice shots have is a mistake in the rig's figures rather than in photographs.
const ALL_DO: &str = " (as most shots have one: camera.response, noise.saturation_dn or the exposure times are not those of the files, or the camera sharpens or smooths them)";

/// What came of the stages, with what is to be told of such photographs. Where they failed, it is because of them.
///
/// # Errors
/// [`crate::Error::Contradiction`]; those of decoding; that of the stages when there are no such photographs, or when
/// they are accepted.
pub(super) fn with_findings<T>(
    photographs: &Photographs<'_>,
    options: &BuildOptions,
    done: Result<T>,
) -> Result<(T, Vec<Warning>)> {
    if done.as_ref().is_err_and(Error::is_internal) {
        return done.map(|done| (done, vec![]));
    }
    // Clipping makes photographs disagree, and not the other way round.
    let findings: Vec<Warning> = match clipping(photographs, options)? {
        Some(clips) => vec![clips],
        None => judge(photographs, options)?.into_iter().collect(),
    };
    match (done, findings.first()) {
        (Ok(done), _) => Ok((done, findings)),
        (Err(error @ Error::Contradiction { .. }), _) | (Err(error), None) => Err(error),
        (Err(error), Some(finding)) => Err(options.refuse(finding.clone()).err().unwrap_or(error)),
    }
}

/// Photographs that clip below the saturation of the rig.
fn clipping(photographs: &Photographs<'_>, options: &BuildOptions) -> Result<Option<Warning>> {
    let piles = photographs.piles()?;
    let given = photographs.capture.rig.noise.as_ref().map_or(f64::INFINITY, |n| n.saturation_dn);
    // However little below: all that clips there counts as measured.
    let below: Vec<_> = piles.iter().filter(|(_, code)| **code < given).collect();
    // Equal values of one photograph may be chance where there is no noise; a converter clips all at one code.
    let alike = |code: f64| below.iter().filter(|(_, c)| **c == code).count();
    let Some(&(&[shot, place], &code)) = below.iter().max_by_key(|(_, code)| alike(**code)) else { return Ok(None) };
    if alike(code) < LEAST_CLIPPED || 2 * alike(code) < below.len() {
        return Ok(None);
    }
    let file = photographs.capture.name_of(&photographs.brackets[shot][place].path);
    options.refuse(ConsistencyWarning::ClipsBelow { file, code, given, photographs: alike(code) }).map(Some)
}

/// What to tell of them.
///
/// # Errors
/// [`crate::Error::Contradiction`] when it is not known which photograph is right, or when so many do not agree that no
/// single mistake explains it; those of decoding.
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
            None => seen_in(photographs, shot, place)?,
        } + if 2 * shots.len() > lattice { ALL_DO } else { "" },
        share: stranger.share,
        photographs: strangers.len(),
        or: stranger.or.map(file),
    };
    if stranger.or.is_some() || shots.len() as f64 > (SINGLE_SHARE * lattice as f64).max(1.0) {
        return options.refuse(finding).map(Some);
    }
    Ok(Some(finding.into()))
}

/// What a photograph shows instead of what the others of its shot show.
fn seen_in(photographs: &Photographs<'_>, shot: usize, place: usize) -> Result<String> {
    if let Some(bits) = other_bits(photographs, shot, place)? {
        return Ok(bits);
    }
    let own = photographs.merge_some(shot, |k| k == place)?;
    let others = photographs.merge_some(shot, |k| k != place)?;
    let same = "it has another brightness, response curve or sharpness";
    let unlike = "it looks like neither the shots beside it nor itself turned or moved";
    Ok(looks(photographs, (shot, Some(place)), &own, &others, same)?.unwrap_or_else(|| unlike.into()))
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
pub(super) fn low_zeros(values: &[u16]) -> u32 {
    let any = values.iter().filter(|v| **v != u16::MAX).fold(0, |all, v| all | v);
    if any == 0 { 0 } else { any.trailing_zeros() }
}
