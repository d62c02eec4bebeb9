//! What the terminal shows of errors and warnings: options as they are typed, and what to try.

use super::things::{known, rig_near};
use crate::files::is_url;
use crate::{
    CaptureWarning, CheckWarning, ConsistencyWarning, Error, LightWarning, RadianceWarning, Severity, SimulateWarning,
    Warning,
};
use std::io::ErrorKind;
use std::path::Path;

/// An error in one line.
pub(super) fn text(error: &Error) -> String {
    one_line(&match error {
        Error::Setting { setting, expected, found } => {
            format!("{}: expected {expected}, found {found}", typed(setting))
        }
        Error::WouldNotBuild { reason } => format!("would not build: {}", text(reason)),
        Error::Explained { cause, error } => format!("{cause}; that is why the work stops: {}", text(error)),
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
pub(super) fn one_line(text: &str) -> String {
    let lines: Vec<_> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    lines.join(" ")
}

/// What the person at the terminal might do about an error.
pub(super) fn hint(error: &Error) -> Option<String> {
    if let Some(hint) = of_the_input(error) {
        return Some(hint);
    }
    let hint = match error {
        Error::Io { action: "create" | "write" | "rename", .. } => {
            "choose an output path in a folder that exists and can be written, with --out"
        }
        Error::Io { path, .. } if is_url(path) => {
            "check the address, the connection and the credentials (AWS_*, GOOGLE_*); only captures and matrices are read from object stores"
        }
        Error::Io { .. } => "check the path and its permissions",
        Error::NotLocal { .. } => "copy it from or to the object store with the store's own tools",
        Error::NeedsFeature { feature, .. } => {
            return Some(format!("build it with `cargo build --release --features {feature}`"));
        }
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
            let accept = format!("to build all the same, --accept {}", finding.id());
            return Some(match **finding {
                Warning::Consistency(ConsistencyWarning::ExposureTimes { .. }) => format!(
                    "correct exposure_secs in capture.toml, or measure the times from the photographs: --exposure-from estimate; {accept}"
                ),
                _ => accept,
            });
        }
        Error::WouldNotBuild { reason } => return hint(reason),
        Error::Explained { cause, .. } => match **cause {
            Warning::Capture(CaptureWarning::DepthDiffers { .. }) => {
                "export or copy the shot again with as many bits as the others"
            }
            Warning::Check(CheckWarning::ValuesShifted { shot: None, .. }) => {
                "correct noise in rig.toml (black_dn, saturation_dn, gain_dn_per_electron), or export the photographs without the shift"
            }
            Warning::Check(CheckWarning::ValuesShifted { .. }) => "export the shot again as the others were",
            Warning::Check(CheckWarning::GrayPairExchanged { .. }) => {
                "exchange the two shots' photographs in capture.toml"
            }
            _ => "copy the photograph again from the camera, or write exposure_secs = … for it in capture.toml",
        },
        Error::MissingShots { missing, .. } => {
            let first = missing.first().map_or(0..0, Clone::clone);
            return Some(format!(
                "measure them with `acquire extract CAPTURE --shots {}..{} --out X.part`, or here with --measure-missing",
                first.start, first.end
            ));
        }
        Error::PassDue { path, missing, of, .. } => {
            let (first, path) = (missing.first().map_or(1, |r| r.start), path.display());
            return Some(format!(
                "do them with `acquire factor-part {path} --part {first}/{of}` and so on, and try again"
            ));
        }
        Error::BrokenMatrix { .. } => {
            "the store may be an incomplete copy; copy it again, or build it again with `acquire build-matrix`"
        }
        Error::MatrixFormat { .. } => "docs/matrix-format.md describes a matrix store, and what may be left out of one",
        Error::Arrays { .. } => {
            "`acquire help import-matrix` lists arrays and shapes; docs/matrix-format.md describes them"
        }
        Error::BrokenMaterial { .. } => "the file may have been cut short; make it again with `acquire factor`",
        Error::BrokenImage { .. } => "give an OpenEXR, PNG or JPEG image",
        Error::Mismatch { .. } => "compare outputs of one capture, with one grid and window",
        Error::NotOurs { .. } | Error::Changed { .. } => "move it elsewhere, or name another --out (or DIR)",
        Error::NotEmpty { .. } | Error::Exists { .. } => {
            "name another --out (or DIR), or replace an earlier output with --force"
        }
        Error::Setting { .. } => "see `acquire help` for the range of each option",
        Error::Voxels { .. } => "docs/simulation.md describes voxel files, with an example that writes one",
        Error::Diffusion { .. } => "follow the photons instead: --transport mc",
        Error::NotFinite { .. } => "the file, or what it is made from, was damaged or not written by `acquire`",
        Error::Internal { .. } => "this is a bug in acquire; please report it with the command line",
    };
    Some(hint.to_owned())
}

/// What the input is instead of what it should be, and what takes it.
fn of_the_input(error: &Error) -> Option<String> {
    match error {
        Error::Io { source, .. } if matches!(source.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded) => {
            Some("the disk is full: make room there, or name an --out (or DIR) on another one".into())
        }
        Error::Io { action: "read", path, source } => match source.kind() {
            // The file that makes a folder what it should be.
            ErrorKind::NotFound if path.ends_with("plan.toml") => known(path.parent()?),
            _ => known(path),
        },
        Error::NoManifest { path } => known(path),
        Error::Field { path, .. } if super::ending(path) == "prepared" => {
            Some("write it again with `acquire prepare CAPTURE --out X.prepared`".into())
        }
        Error::BrokenMatrix { path, .. } | Error::MatrixFormat { path, .. } => {
            known(path).filter(|_| !path.join("zarr.json").is_file())
        }
        Error::BrokenMaterial { path, .. } => known(path).filter(|_| path.is_dir()),
        Error::NoRig { path, looked } => {
            let near = [Path::new(looked), path].into_iter().find_map(rig_near)?;
            let near = near.display();
            Some(format!(
                "there is a rig.toml in {near}: name that folder, with --calibration (with `acquire patterns` --rig)"
            ))
        }
        Error::WouldNotBuild { reason } => of_the_input(reason),
        _ => None,
    }
}

/// Findings in one line each, worst first. Many of one kind are one line, which says the first and how many more there
/// are.
pub(super) fn told(findings: &[Warning]) -> Vec<(Severity, String)> {
    let mut kinds: Vec<(&Warning, usize)> = Vec::new();
    for finding in findings {
        match kinds.iter_mut().find(|(first, _)| first.id() == finding.id()) {
            Some((_, more)) => *more += 1,
            None => kinds.push((finding, 0)),
        }
    }
    kinds.sort_by_key(|(finding, _)| std::cmp::Reverse(finding.severity()));
    let line = |(finding, more): &(&Warning, usize)| {
        let more = if *more > 0 { format!("; {more} more of this kind") } else { String::new() };
        let advice = advice(finding).map(|advice| format!("; {advice}")).unwrap_or_default();
        (finding.severity(), one_line(&format!("{finding}{more}{advice}")))
    };
    kinds.iter().map(line).collect()
}

/// What might be done about a warning with the options of this program.
fn advice(warning: &Warning) -> Option<&'static str> {
    match warning {
        Warning::Radiance(RadianceWarning::ExposureRatios { .. }) => {
            Some("use --exposure-from estimate, or check camera.response in rig.toml")
        }
        Warning::Light(LightWarning::LightStretched { .. }) => Some("give its size on the slab: --extent-mm WxH"),
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
    fn many_findings_of_one_kind_are_one_line_under_the_word_of_their_severity() {
        let dark = |medium: &str, channel| SimulateWarning::DiffusionTooDark {
            medium: medium.into(),
            channel,
            reduced_scattering_per_mm: 0.5,
            absorption_per_mm: 2.0,
        };
        let findings = [
            RadianceWarning::Flicker { relative_sd: 0.01, remaining_sd: 0.001 }.into(),
            dark("ink", 'R').into(),
            dark("ink", 'G').into(),
            dark("soot", 'B').into(),
        ];
        let told = told(&findings);
        assert_eq!(told.iter().map(|t| t.0.name()).collect::<Vec<_>>(), ["warning", "note"]);
        assert!(told[0].1.starts_with("ink, R: ") && told[0].1.ends_with("; 2 more of this kind; use --transport mc"));
    }

    #[test]
    fn a_contradiction_hints_at_its_name_on_the_page_of_findings() {
        let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/findings.md")).unwrap();
        let contradictions = crate::warning::samples::written();
        let contradictions =
            contradictions.into_iter().map(|(w, _)| w).filter(|w| matches!(w, Warning::Consistency(_)));
        let mut any = false;
        for finding in contradictions {
            any = true;
            let id = finding.id();
            assert!(page.lines().any(|l| l.starts_with(&format!("| `{id}` |"))), "{id} is not on the page");
            let hint = hint(&Error::Contradiction { finding: Box::new(finding) });
            assert!(hint.unwrap().contains(&format!("--accept {id}")));
        }
        assert!(any);
    }

    #[test]
    fn options_are_named_as_they_are_typed() {
        assert_eq!(typed("grid, lit_pitch_mm"), "--grid, --lit-pitch-mm");
        assert_eq!(typed("DIR"), "DIR");
        let error = Error::Setting { setting: "target_psnr", expected: "a".into(), found: "b".into() };
        assert_eq!(text(&error), "--target-psnr: expected a, found b");
    }
}
