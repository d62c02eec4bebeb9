//! What the terminal shows of errors and warnings: options as they are typed, and what to try.

use crate::{ConsistencyWarning, Error, RadianceWarning, SimulateWarning, Warning};

/// An error in one line.
pub(super) fn text(error: &Error) -> String {
    one_line(&match error {
        Error::Setting { setting, expected, found } => {
            format!("{}: expected {expected}, found {found}", typed(setting))
        }
        Error::WouldNotBuild { reason } => format!("would not build: {}", text(reason)),
        other => other.to_string(),
    })
}

/// Fields of options as they are typed: `lit_pitch_mm` is `--lit-pitch-mm`.
fn typed(fields: &str) -> String {
    // DIR and the like are arguments without a flag.
    let one = |field: &str| match field.starts_with(|c: char| c == '-' || c.is_ascii_uppercase()) {
        true => field.to_owned(),
        false => format!("--{}", field.replace('_', "-")),
    };
    fields.split(", ").map(one).collect::<Vec<_>>().join(", ")
}

/// Decoders and file names may bring line breaks of their own.
fn one_line(text: &str) -> String {
    let lines: Vec<_> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    lines.join(" ")
}

/// What the person at the terminal might do about an error.
pub(super) fn hint(error: &Error) -> Option<String> {
    let hint = match error {
        Error::Io { action: "create" | "write" | "rename", .. } => {
            "choose an output path in a folder that exists and can be written, with --out"
        }
        Error::Io { .. } => "check the path and its permissions",
        Error::NoManifest { .. } => {
            "name the folder that holds capture.toml; docs/captures.md describes it, and `acquire simulate DIR` writes an example"
        }
        Error::NoRig { .. } => "name the folder of rig.toml with --calibration DIR; docs/captures.md describes it",
        Error::Field { .. } => "docs/captures.md lists every field with its unit and range",
        Error::MissingPhotograph { .. } => "copy the photograph back, or remove the shot from capture.toml",
        Error::BrokenPhotograph { .. } => "the copy from the camera may have been cut short; copy it again",
        Error::PhotographSize { .. } => {
            "name the rig of this camera with --calibration DIR, or correct camera.size_px in rig.toml"
        }
        Error::NoExposure { .. } => "write exposure_secs = … for this photograph in capture.toml",
        Error::SameExposure { .. } => "correct exposure_secs in capture.toml, or remove one of the two photographs",
        Error::DotOutsideSlab { .. } => "check [grid] and [slab] in capture.toml against the projected patterns",
        Error::DotSaturated { .. } => "add a shorter exposure to this shot, or close the aperture",
        Error::Registration { .. } => {
            "look at the named photograph: the whole board or pattern must be visible, sharp and unsaturated"
        }
        Error::DoesNotFit { .. } => {
            "compare plan.toml with the photographs around the one that is named; remove doubled ones, shoot missing ones again"
        }
        Error::Contradiction { finding } => {
            if matches!(**finding, Warning::Consistency(ConsistencyWarning::ExposureTimes { .. })) {
                return Some("correct exposure_secs in capture.toml, or measure the times from the photographs: --exposure-from estimate".into());
            }
            return finding.id().ok().map(|id| format!("to build all the same, --accept {id}"));
        }
        Error::WouldNotBuild { reason } => return hint(reason),
        Error::BrokenMatrix { .. } => {
            "the store may come from a stopped run; build it again with `acquire build-matrix`"
        }
        Error::BrokenMaterial { .. } => "the file may have been cut short; make it again with `acquire factor`",
        Error::BrokenImage { .. } => "give an OpenEXR, PNG or JPEG image",
        Error::Mismatch { .. } => "compare outputs of one capture, with one grid and window",
        Error::NotOurs { .. } => "move it elsewhere, or name another --out (or DIR)",
        Error::NotEmpty { .. } => "name another --out (or DIR), or replace an earlier output with --force",
        Error::Setting { .. } => "see `acquire help` for the range of each option",
        Error::Voxels { .. } => "docs/simulation.md describes voxel files, with an example that writes one",
        Error::Diffusion { .. } => "follow the photons instead: --transport mc",
        Error::NotFinite { .. } => "the file, or what it is made from, was damaged or not written by `acquire`",
        Error::Internal { .. } => "this is a bug in acquire; please report it with the command line",
    };
    Some(hint.to_owned())
}

/// What might be done about a warning with the options of this program.
pub(super) fn advice(warning: &Warning) -> Option<&'static str> {
    match warning {
        Warning::Radiance(RadianceWarning::ExposureRatios { .. }) => {
            Some("use --exposure-from estimate, or check camera.response in rig.toml")
        }
        Warning::Simulate(SimulateWarning::DiffusionTooClear { .. } | SimulateWarning::DiffusionTooDark { .. }) => {
            Some("use --transport mc")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_one_line() {
        assert_eq!(one_line("a:  b\n\n  c\n"), "a:  b c");
    }

    #[test]
    fn options_are_named_as_they_are_typed() {
        assert_eq!(typed("grid, lit_pitch_mm"), "--grid, --lit-pitch-mm");
        assert_eq!(typed("DIR"), "DIR");
        let error = Error::Setting { setting: "target_psnr", expected: "a".into(), found: "b".into() };
        assert_eq!(text(&error), "--target-psnr: expected a, found b");
    }
}
