//! What is written of a warning is read by other programs, and by later versions of this one.

use super::*;

/// Every warning, and what version 0.1.0 writes of it.
fn written() -> Vec<(Warning, &'static str)> {
    vec![
        (
            CaptureWarning::ExposureDisagrees {
                file: "a.jpg".into(),
                used_secs: 0.1,
                other_secs: 0.25,
                other: "EXIF".into(),
                photographs: 2,
            }
            .into(),
            r#"{"warning":"exposure-disagrees","file":"a.jpg","used_secs":0.1,"other_secs":0.25,"other":"EXIF","photographs":2}"#,
        ),
        (
            CaptureWarning::ApertureOrIsoChanges { file: "b.jpg".into(), factor: 0.5 }.into(),
            r#"{"warning":"aperture-or-iso-changes","file":"b.jpg","factor":0.5}"#,
        ),
        (
            CaptureWarning::DamagedExif { file: "c.jpg".into(), reason: "\"cut\"".into() }.into(),
            r#"{"warning":"damaged-exif","file":"c.jpg","reason":"\"cut\""}"#,
        ),
        (
            CaptureWarning::UnusableExif {
                file: "d.jpg".into(),
                tag: "FNumber".into(),
                found: "0/0".into(),
                photographs: 1,
            }
            .into(),
            r#"{"warning":"unusable-exif","file":"d.jpg","tag":"FNumber","found":"0/0","photographs":1}"#,
        ),
        (
            RadianceWarning::NoiseEstimated {
                gain_dn_per_electron: 0.1,
                gain_sd: 0.01,
                read_noise_electrons: 3.0,
                read_noise_sd: 0.2,
                black_dn: 64.5,
                black_sd: 0.1,
                saturation_dn: 65535.0,
                saturation_seen: false,
            }
            .into(),
            r#"{"warning":"noise-estimated","gain_dn_per_electron":0.1,"gain_sd":0.01,"read_noise_electrons":3.0,"read_noise_sd":0.2,"black_dn":64.5,"black_sd":0.1,"saturation_dn":65535.0,"saturation_seen":false}"#,
        ),
        (
            RadianceWarning::NoiseDisagrees { field: "black_dn".into(), given: 64.0, found: 70.25, sd: 0.1 }.into(),
            r#"{"warning":"noise-disagrees","field":"black_dn","given":64.0,"found":70.25,"sd":0.1}"#,
        ),
        (
            RadianceWarning::HotPixels { photosites: 1, stuck: 0, strongest_dn_per_sec: 90.0 }.into(),
            r#"{"warning":"hot-pixels","photosites":1,"stuck":0,"strongest_dn_per_sec":90.0}"#,
        ),
        (
            RadianceWarning::ExposureRatios { nominal_secs: 0.1, measured_secs: 0.11, relative_sd: 0.001 }.into(),
            r#"{"warning":"exposure-ratios","nominal_secs":0.1,"measured_secs":0.11,"relative_sd":0.001}"#,
        ),
        (
            RadianceWarning::ExposuresUnlinked { groups: vec![vec![0.1, 0.2], vec![3.0]] }.into(),
            r#"{"warning":"exposures-unlinked","groups":[[0.1,0.2],[3.0]]}"#,
        ),
        (
            RadianceWarning::CurveNotSaved { file: "rig.toml".into(), reason: "read-only".into() }.into(),
            r#"{"warning":"curve-not-saved","file":"rig.toml","reason":"read-only"}"#,
        ),
        (
            RadianceWarning::Flicker { relative_sd: 0.01, remaining_sd: 0.001 }.into(),
            r#"{"warning":"flicker","relative_sd":0.01,"remaining_sd":0.001}"#,
        ),
        (RadianceWarning::StrayLight { share: 0.0061 }.into(), r#"{"warning":"stray-light","share":0.0061}"#),
        (
            RegistrationWarning::BoardTooSmall { outside_mm: 2.5 }.into(),
            r#"{"warning":"board-too-small","outside_mm":2.5}"#,
        ),
        (
            RegistrationWarning::BoardElsewhere { largest_px: 1.5 }.into(),
            r#"{"warning":"board-elsewhere","largest_px":1.5}"#,
        ),
        (
            RegistrationWarning::FrameMoved { shot: "frame 2".into(), moved_px: [0.5, -0.25], sd_px: 0.01 }.into(),
            r#"{"warning":"frame-moved","shot":"frame 2","moved_px":[0.5,-0.25],"sd_px":0.01}"#,
        ),
        (
            RegistrationWarning::CameraMoved { first: "lattice 1".into(), shots: 1, measured: 9, largest_px: 0.75 }
                .into(),
            r#"{"warning":"camera-moved","first":"lattice 1","shots":1,"measured":9,"largest_px":0.75}"#,
        ),
        (
            RegistrationWarning::DriftJumps { jumps: vec![DriftJump { shot: "lattice 3".into(), length_px: 1.25 }] }
                .into(),
            r#"{"warning":"drift-jumps","jumps":[{"shot":"lattice 3","length_px":1.25}]}"#,
        ),
        (RegistrationWarning::DriftFromLatticeDots.into(), r#"{"warning":"drift-from-lattice-dots"}"#),
        (
            RegistrationWarning::DriftUnmeasured { first: "lattice 1".into(), shots: 1 }.into(),
            r#"{"warning":"drift-unmeasured","first":"lattice 1","shots":1}"#,
        ),
        (RegistrationWarning::PointSpreadUnmeasured.into(), r#"{"warning":"point-spread-unmeasured"}"#),
        (
            RegistrationWarning::PointSpreadVaries { psf_px: 0.5, range_px: [0.4, 0.7] }.into(),
            r#"{"warning":"point-spread-varies","psf_px":0.5,"range_px":[0.4,0.7]}"#,
        ),
        (RegistrationWarning::StronglyBlurred { psf_px: 1.5 }.into(), r#"{"warning":"strongly-blurred","psf_px":1.5}"#),
        (
            ResponseWarning::SaturatedSamples { first: "lattice 1".into(), shots: 1, samples: 2 }.into(),
            r#"{"warning":"saturated-samples","first":"lattice 1","shots":1,"samples":2}"#,
        ),
        (
            ResponseWarning::ClippedWindow { rows: 1, samples: 3 }.into(),
            r#"{"warning":"clipped-window","rows":1,"samples":3}"#,
        ),
        (ResponseWarning::UnlitPoints { rows: 1 }.into(), r#"{"warning":"unlit-points","rows":1}"#),
        (
            ResponseWarning::CrossTalk {
                spacing_samples: 7.5,
                needed_samples: None,
                removed_share: 0.25,
                modelled_share: 0.5,
            }
            .into(),
            r#"{"warning":"cross-talk","spacing_samples":7.5,"needed_samples":null,"removed_share":0.25,"modelled_share":0.5}"#,
        ),
        (
            ResponseWarning::CrossTalk {
                spacing_samples: 7.5,
                needed_samples: Some(9),
                removed_share: 0.25,
                modelled_share: 0.5,
            }
            .into(),
            r#"{"warning":"cross-talk","spacing_samples":7.5,"needed_samples":9,"removed_share":0.25,"modelled_share":0.5}"#,
        ),
        (
            ResponseWarning::AlbedoAboveOne { rows: 2, largest: 1.0625 }.into(),
            r#"{"warning":"albedo-above-one","rows":2,"largest":1.0625}"#,
        ),
        (FactorWarning::EmptyRows { rows: 1 }.into(), r#"{"warning":"empty-rows","rows":1}"#),
        (FactorWarning::ShiftLimited { rows: 1, limit: 4 }.into(), r#"{"warning":"shift-limited","rows":1,"limit":4}"#),
        (
            FactorWarning::GoalMissed { asked: "45 dB".into(), found: "43.10 dB".into() }.into(),
            r#"{"warning":"goal-missed","asked":"45 dB","found":"43.10 dB"}"#,
        ),
        (
            SimulateWarning::RefractiveIndexDiffers {
                used: "wax".into(),
                used_index: 1.5,
                other: "ink".into(),
                other_index: 1.25,
            }
            .into(),
            r#"{"warning":"refractive-index-differs","used":"wax","used_index":1.5,"other":"ink","other_index":1.25}"#,
        ),
        (
            SimulateWarning::DiffusionTooClear {
                medium: "wax".into(),
                channel: 'R',
                mean_free_path_mm: None,
                exceeds: "window".into(),
                length_mm: 7.5,
            }
            .into(),
            r#"{"warning":"diffusion-too-clear","medium":"wax","channel":"R","mean_free_path_mm":null,"exceeds":"window","length_mm":7.5}"#,
        ),
        (
            SimulateWarning::DiffusionTooDark {
                medium: "ink".into(),
                channel: 'B',
                reduced_scattering_per_mm: 0.5,
                absorption_per_mm: 2.0,
            }
            .into(),
            r#"{"warning":"diffusion-too-dark","medium":"ink","channel":"B","reduced_scattering_per_mm":0.5,"absorption_per_mm":2.0}"#,
        ),
    ]
}

#[test]
fn a_warning_is_written_as_its_name_and_figures_whatever_its_stage() {
    for (warning, json) in written() {
        assert_eq!(serde_json::to_string(&warning).unwrap(), json);
        assert_eq!(serde_json::from_str::<Warning>(json).unwrap(), warning);
    }
}

#[test]
fn an_unknown_warning_is_refused_in_words() {
    let refused = serde_json::from_str::<Warning>(r#"{"warning":"moon-too-bright","rows":1}"#).unwrap_err();
    assert!(refused.to_string().starts_with("a warning that this version of acquire knows"), "{refused}");
}

#[test]
fn numbers_of_things_agree_with_their_nouns() {
    let said = |warning: Warning| warning.to_string();
    let saturated = |samples, shots| ResponseWarning::SaturatedSamples { first: "lattice-0001".into(), shots, samples };
    let expected = "every exposure saturates in 1 sample of 1 shot (first: \"lattice-0001\"); treated as unmeasured";
    assert_eq!(said(saturated(1, 1).into()), expected);
    let expected = "every exposure saturates in 7 samples of 2 shots (first: \"lattice-0001\"); treated as unmeasured";
    assert_eq!(said(saturated(7, 2).into()), expected);
    let limited = FactorWarning::ShiftLimited { rows: 1, limit: 4 };
    assert_eq!(
        said(limited.into()),
        "in 1 row the peak is more than 4 samples from the lit point; the shift is limited to 4 samples"
    );
}
