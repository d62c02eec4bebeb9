//! What most likely stands behind a refusal: stages say what they cannot do, and not why.

use super::photographs::Photographs;
use super::register::exchanged_pair;
use super::strangers::low_zeros;
use crate::capture::{Capture, Pattern, Photograph, Samples};
use crate::radiance::decode_spread;
use crate::{CaptureWarning, CheckWarning, ConsistencyWarning, Culprit, Error, RadianceWarning, Warning};

/// Shots beside the one that failed whose code values are looked at.
const LOOKS: usize = 4;
/// Pixels of each.
const LOOK_PX: usize = 1 << 16;

/// The error with its likeliest cause in the files, where they show one: the shot that failed is in 8 bits among others
/// of 16, its code values are shifted by bits, or those of all shots are and the rig's saturation is not.
pub(super) fn in_files(capture: &Capture, error: Error) -> Error {
    // The shot that failed, where it is known.
    let failed = match &error {
        Error::Registration { shot, .. } | Error::DotSaturated { shot, .. } => Some(shot.clone()),
        Error::Contradiction { finding } => match &**finding {
            // One of several photographs is told apart from the others; not so when all are shifted.
            Warning::Consistency(ConsistencyWarning::PhotographDisagrees { or: None, .. }) => return error,
            other => {
                other.record().culprit.into_iter().find_map(|c| if let Culprit::Shot(s) = c { Some(s) } else { None })
            }
        },
        // The white reference is what dots are measured with.
        Error::Field { path, .. } if *path == capture.manifest_path() => capture
            .shots(|p| matches!(p, Pattern::ReferenceWhite))
            .first()
            .map(|&s| capture.manifest.shots[s].name.clone()),
        _ => return error,
    };
    let depth = capture.warnings.iter().find(|w| match w {
        CaptureWarning::DepthDiffers { shot, .. } => failed.as_ref() == Some(shot),
        _ => false,
    });
    let cause = depth.cloned().map(Warning::from).or_else(|| shifted(capture, failed.as_deref()).map(Warning::from));
    let cause = cause.or_else(|| eight_bits(capture).map(Warning::from));
    explained(error, cause)
}

/// The error with its likeliest cause in the Gray code: the photographs of a pattern and its inverse were exchanged.
pub(super) fn in_gray_code(photographs: &Photographs<'_>, error: Error) -> Error {
    if !matches!(error, Error::Registration { .. } | Error::DotOutsideSlab { .. }) {
        return error;
    }
    let name = |shot: usize| photographs.name(shot).to_owned();
    // What this needs may be what failed: then nothing is known.
    let pair = exchanged_pair(photographs).ok().flatten();
    let cause =
        pair.map(|[shot, inverse]| CheckWarning::GrayPairExchanged { shot: name(shot), inverse: name(inverse) });
    explained(error, cause.map(Warning::from))
}

/// The error with its likeliest cause in the rig's `[noise]`: photographs contradict each other by more than a noise
/// that is not theirs.
pub(super) fn in_noise(warnings: &[Warning], error: Error) -> Error {
    let by_noise = |finding: &Warning| {
        use ConsistencyWarning as C;
        matches!(
            finding,
            Warning::Consistency(
                C::PhotographDisagrees { .. }
                    | C::ExposureTimes { .. }
                    | C::ResponseCurve { .. }
                    | C::BrightnessVaries { .. }
            )
        )
    };
    let is_cause = |w: &&Warning| {
        matches!(
            w,
            Warning::Radiance(RadianceWarning::NoiseDisagrees { .. })
                | Warning::Consistency(ConsistencyWarning::ChannelGains { .. } | ConsistencyWarning::BlackMoves { .. })
        )
    };
    match &error {
        // A single photograph is itself the cause.
        Error::Contradiction { finding }
            if matches!(
                **finding,
                Warning::Consistency(ConsistencyWarning::PhotographDisagrees { photographs: 1, .. })
            ) =>
        {
            error
        }
        Error::Contradiction { finding } if by_noise(finding) => {
            // The black level comes last of the rig's figures and explains most.
            explained(error, warnings.iter().rev().find(is_cause).cloned())
        }
        _ => error,
    }
}

fn explained(error: Error, cause: Option<Warning>) -> Error {
    match cause {
        Some(cause) => Error::Explained { cause: Box::new(cause), error: Box::new(error) },
        None => error,
    }
}

/// Low bits that are 0 in all values of a shot, and not in those of others; or in those of all, while they exceed the
/// rig's saturation.
fn shifted(capture: &Capture, failed: Option<&str>) -> Option<CheckWarning> {
    let all = 0..capture.brackets.len();
    let (own, others): (Vec<usize>, Vec<usize>) =
        all.partition(|&shot| Some(capture.manifest.shots[shot].name.as_str()) == failed);
    let step = (others.len() / LOOKS).max(1);
    let longest = others.iter().step_by(step).filter_map(|&shot| capture.brackets[shot].last());
    let others: Vec<Look> = longest.filter_map(|p| Look::at(capture, p)).collect();
    let shared = others.iter().map(|l| l.zeros).min()?;
    let file = |p: &Photograph| capture.name_of(&p.path);
    let photographs = own.iter().flat_map(|&shot| &capture.brackets[shot]);
    let own: Vec<(&Photograph, Look)> = photographs.filter_map(|p| Some((p, Look::at(capture, p)?))).collect();
    let zeros = own.iter().map(|(_, look)| look.zeros).min().unwrap_or(0);
    if let Some((first, _)) = own.first().filter(|_| zeros > shared) {
        let (file, shot, bits) = (file(first), failed.map(str::to_owned), zeros - shared);
        return Some(CheckWarning::ValuesShifted { file, shot, bits });
    }
    let saturation_dn = capture.rig.noise.as_ref()?.saturation_dn;
    let first = capture.brackets.iter().flatten().next()?;
    let beyond = others.iter().any(|l| f64::from(l.largest) > saturation_dn);
    (shared > 0 && beyond).then(|| CheckWarning::ValuesShifted { file: file(first), shot: None, bits: shared })
}

/// Photographs of 8 bits under a saturation that these cannot hold.
fn eight_bits(capture: &Capture) -> Option<CheckWarning> {
    let saturation_dn = capture.rig.noise.as_ref()?.saturation_dn;
    let step = (capture.brackets.len() / LOOKS).max(1);
    let mut looks = capture.brackets.iter().step_by(step).filter_map(|bracket| bracket.last());
    let eight = |p: &Photograph| matches!(samples(capture, p), Some(Samples::U8(_)));
    let all = saturation_dn > f64::from(u8::MAX) && looks.clone().all(eight);
    let file = capture.name_of(&looks.next()?.path);
    all.then_some(CheckWarning::EightBits { file, saturation_dn })
}

/// Some code values of a photograph; `None` where it cannot be read.
fn samples(capture: &Capture, photograph: &Photograph) -> Option<Samples> {
    let seen = decode_spread(std::slice::from_ref(photograph), capture.rig.camera.size_px, LOOK_PX).ok()?;
    seen.exposures().first().map(|e| e.samples.clone())
}

/// What the code values of a 16-bit photograph have in common; of one that is all black or saturated nothing is known.
struct Look {
    zeros: u32,
    largest: u16,
}

impl Look {
    fn at(capture: &Capture, photograph: &Photograph) -> Option<Self> {
        match samples(capture, photograph)? {
            Samples::U16(values) if values.iter().any(|v| !matches!(*v, 0 | u16::MAX)) => {
                Some(Self { zeros: low_zeros(&values), largest: values.iter().copied().max().unwrap_or(0) })
            }
            _ => None,
        }
    }
}
