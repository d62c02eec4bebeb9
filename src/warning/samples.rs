//! A sample of every finding.

use super::*;

/// Every finding, and what is written of it.
pub(crate) fn written() -> Vec<(Warning, &'static str)> {
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
            CaptureWarning::DamagedExif { file: "c.jpg".into(), reason: "\"cut\"".into(), photographs: 1 }.into(),
            r#"{"warning":"damaged-exif","file":"c.jpg","reason":"\"cut\"","photographs":1}"#,
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
            CaptureWarning::DepthDiffers {
                file: "a.png".into(),
                shot: "s".into(),
                bits: 8,
                most_bits: 16,
                photographs: 2,
            }
            .into(),
            r#"{"warning":"depth-differs","file":"a.png","shot":"s","bits":8,"most_bits":16,"photographs":2}"#,
        ),
        (
            CheckWarning::ValuesShifted { file: "a.png".into(), shot: Some("s".into()), bits: 4 }.into(),
            r#"{"warning":"values-shifted","file":"a.png","shot":"s","bits":4}"#,
        ),
        (
            CheckWarning::ValuesShifted { file: "a.png".into(), shot: None, bits: 4 }.into(),
            r#"{"warning":"values-shifted","file":"a.png","shot":null,"bits":4}"#,
        ),
        (
            CheckWarning::GrayPairExchanged { shot: "s".into(), inverse: "t".into() }.into(),
            r#"{"warning":"gray-pair-exchanged","shot":"s","inverse":"t"}"#,
        ),
        (CheckWarning::Stopped { reason: "no rig".into() }.into(), r#"{"warning":"stopped","reason":"no rig"}"#),
        (
            CheckWarning::MissingPhotograph { file: "a.png".into(), shot: "s".into() }.into(),
            r#"{"warning":"missing-photograph","file":"a.png","shot":"s"}"#,
        ),
        (
            CheckWarning::BrokenPhotograph { file: "a.png".into(), shot: "s".into(), reason: "cut".into() }.into(),
            r#"{"warning":"broken-photograph","file":"a.png","shot":"s","reason":"cut"}"#,
        ),
        (
            CheckWarning::WrongSize { file: "a.png".into(), expected_px: [3, 2], found_px: [2, 3] }.into(),
            r#"{"warning":"wrong-size","file":"a.png","expected_px":[3,2],"found_px":[2,3]}"#,
        ),
        (CheckWarning::NoExposure { file: "a.png".into() }.into(), r#"{"warning":"no-exposure","file":"a.png"}"#),
        (
            CheckWarning::SameExposure {
                shot: "s".into(),
                first: "a.png".into(),
                second: "b.png".into(),
                exposure_secs: 0.5,
            }
            .into(),
            r#"{"warning":"same-exposure","shot":"s","first":"a.png","second":"b.png","exposure_secs":0.5}"#,
        ),
        (
            CheckWarning::UnusableField {
                file: "rig.toml".into(),
                field: "camera.focal_px".into(),
                expected: "1 to 2".into(),
                found: "3".into(),
            }
            .into(),
            r#"{"warning":"unusable-field","file":"rig.toml","field":"camera.focal_px","expected":"1 to 2","found":"3"}"#,
        ),
        (
            CheckWarning::RegistrationFailed { file: "a.png".into(), shot: "s".into(), reason: "no board".into() }
                .into(),
            r#"{"warning":"registration-failed","file":"a.png","shot":"s","reason":"no board"}"#,
        ),
        (
            CheckWarning::DotOutsideSlab {
                shot: "s".into(),
                dot: [1, 2],
                expected: "on it".into(),
                found: "beside".into(),
            }
            .into(),
            r#"{"warning":"dot-outside-slab","shot":"s","dot":[1,2],"expected":"on it","found":"beside"}"#,
        ),
        (
            CheckWarning::DotSaturated { file: "a.png".into(), shot: "s".into(), dot: [1, 2], shortest_secs: 0.5 }
                .into(),
            r#"{"warning":"dot-saturated","file":"a.png","shot":"s","dot":[1,2],"shortest_secs":0.5}"#,
        ),
        (
            CaptureWarning::NoExif { file: "a.png".into(), photographs: 2 }.into(),
            r#"{"warning":"no-exif","file":"a.png","photographs":2}"#,
        ),
        (
            CaptureWarning::AutomaticExposure { file: "a.png".into(), photographs: 2, program: "program".into() }
                .into(),
            r#"{"warning":"automatic-exposure","file":"a.png","photographs":2,"program":"program"}"#,
        ),
        (
            CaptureWarning::AutomaticWhiteBalance { file: "a.png".into(), photographs: 2 }.into(),
            r#"{"warning":"automatic-white-balance","file":"a.png","photographs":2}"#,
        ),
        (
            CaptureWarning::SettingChanges {
                setting: "ISO".into(),
                file: "a.png".into(),
                photographs: 2,
                expected: "100".into(),
                found: "200".into(),
            }
            .into(),
            r#"{"warning":"setting-changes","setting":"ISO","file":"a.png","photographs":2,"expected":"100","found":"200"}"#,
        ),
        (
            CaptureWarning::BracketDiffers {
                shot: "s".into(),
                shots: 1,
                expected_secs: vec![0.25, 1.0],
                found_secs: vec![0.25],
            }
            .into(),
            r#"{"warning":"bracket-differs","shot":"s","shots":1,"expected_secs":[0.25,1.0],"found_secs":[0.25]}"#,
        ),
        (
            CaptureWarning::OutOfOrder { file: "a.png".into(), after_file: "b.png".into(), shots: 1, lattice: true }
                .into(),
            r#"{"warning":"out-of-order","file":"a.png","after_file":"b.png","shots":1,"lattice":true}"#,
        ),
        (
            CaptureWarning::OutOfOrder { file: "a.png".into(), after_file: "b.png".into(), shots: 1, lattice: false }
                .into(),
            r#"{"warning":"out-of-order","file":"a.png","after_file":"b.png","shots":1,"lattice":false}"#,
        ),
        (
            CheckWarning::Saturated { shot: "s".into(), share: 0.5 }.into(),
            r#"{"warning":"saturated","shot":"s","share":0.5}"#,
        ),
        (
            CheckWarning::SaturatedDots { shot: "s".into(), dots: 1, of: 9 }.into(),
            r#"{"warning":"saturated-dots","shot":"s","dots":1,"of":9}"#,
        ),
        (CheckWarning::Dark { shot: "s".into(), share: 0.75 }.into(), r#"{"warning":"dark","shot":"s","share":0.75}"#),
        (CheckWarning::Dark { shot: "s".into(), share: 1.0 }.into(), r#"{"warning":"dark","shot":"s","share":1.0}"#),
        (
            CheckWarning::Blurred { psf_px: 1.5, sample_px: 3.0 }.into(),
            r#"{"warning":"blurred","psf_px":1.5,"sample_px":3.0}"#,
        ),
        (
            CheckWarning::LargeDrift { shot: "s".into(), drift_px: 5.0, most_px: 8.0 }.into(),
            r#"{"warning":"large-drift","shot":"s","drift_px":5.0,"most_px":8.0}"#,
        ),
        (
            CheckWarning::DeadDots { shot: "s".into(), dot: [1, 2], dots: 1, of: 9 }.into(),
            r#"{"warning":"dead-dots","shot":"s","dot":[1,2],"dots":1,"of":9}"#,
        ),
        (CheckWarning::NotLookedAt.into(), r#"{"warning":"not-looked-at"}"#),
        (
            ConsistencyWarning::PhotographDisagrees {
                file: "a.png".into(),
                shot: "s".into(),
                looks: "turned by 180°".into(),
                share: 0.5,
                photographs: 2,
                or: None,
            }
            .into(),
            r#"{"warning":"photograph-disagrees","file":"a.png","shot":"s","looks":"turned by 180°","share":0.5,"photographs":2,"or":null}"#,
        ),
        (
            ConsistencyWarning::PhotographDisagrees {
                file: "a.png".into(),
                shot: "s".into(),
                looks: "turned by 180°".into(),
                share: 0.5,
                photographs: 1,
                or: Some("b.png".into()),
            }
            .into(),
            r#"{"warning":"photograph-disagrees","file":"a.png","shot":"s","looks":"turned by 180°","share":0.5,"photographs":1,"or":"b.png"}"#,
        ),
        (
            ConsistencyWarning::ExposureTimes {
                file: "a.png".into(),
                nominal_secs: 0.5,
                measured_secs: 0.25,
                relative_sd: 0.01,
                settings: 1,
            }
            .into(),
            r#"{"warning":"exposure-times","file":"a.png","nominal_secs":0.5,"measured_secs":0.25,"relative_sd":0.01,"settings":1}"#,
        ),
        (
            ConsistencyWarning::ExposuresUnmeasured { settings: 3 }.into(),
            r#"{"warning":"exposures-unmeasured","settings":3}"#,
        ),
        (
            ConsistencyWarning::BrightnessVaries { relative_sd: 0.25 }.into(),
            r#"{"warning":"brightness-varies","relative_sd":0.25}"#,
        ),
        (
            ConsistencyWarning::OtherPattern {
                shot: "s".into(),
                looks: "the pattern of shot t".into(),
                shots: 1,
                of: 9,
            }
            .into(),
            r#"{"warning":"other-pattern","shot":"s","looks":"the pattern of shot t","shots":1,"of":9}"#,
        ),
        (
            ConsistencyWarning::DotsOffset {
                field: "reference_dots".into(),
                offset_projector_px: [1.0, 0.0],
                sd_projector_px: 0.125,
            }
            .into(),
            r#"{"warning":"dots-offset","field":"reference_dots","offset_projector_px":[1.0,0.0],"sd_projector_px":0.125}"#,
        ),
        (
            ConsistencyWarning::DotsOffset {
                field: "reference_dots".into(),
                offset_projector_px: [0.25, 0.0],
                sd_projector_px: 0.125,
            }
            .into(),
            r#"{"warning":"dots-offset","field":"reference_dots","offset_projector_px":[0.25,0.0],"sd_projector_px":0.125}"#,
        ),
        (
            ConsistencyWarning::ResponseCurve { given: "linear".into(), slope: 0.5, encoding: Some("sRGB".into()) }
                .into(),
            r#"{"warning":"response-curve","given":"linear","slope":0.5,"encoding":"sRGB"}"#,
        ),
        (
            ConsistencyWarning::AmbientChanged { dn_per_sec: 8.5, share: 0.25 }.into(),
            r#"{"warning":"ambient-changed","dn_per_sec":8.5,"share":0.25}"#,
        ),
        (
            ConsistencyWarning::AmbientChanged { dn_per_sec: 8.5, share: 0.001 }.into(),
            r#"{"warning":"ambient-changed","dn_per_sec":8.5,"share":0.001}"#,
        ),
        (
            ConsistencyWarning::HaloImplausible { share: 0.25, most: 0.1 }.into(),
            r#"{"warning":"halo-implausible","share":0.25,"most":0.1}"#,
        ),
        (
            ConsistencyWarning::LampLevel { shot: "s".into(), level: 0.75, level_sd: 0.01, shots: 2 }.into(),
            r#"{"warning":"lamp-level","shot":"s","level":0.75,"level_sd":0.01,"shots":2}"#,
        ),
        (
            ConsistencyWarning::WhiteLevel { shot: "s".into(), level: 1.25, level_sd: 0.01 }.into(),
            r#"{"warning":"white-level","shot":"s","level":1.25,"level_sd":0.01}"#,
        ),
        (
            ConsistencyWarning::WhiteLevel { shot: "s".into(), level: 1.05, level_sd: 0.01 }.into(),
            r#"{"warning":"white-level","shot":"s","level":1.05,"level_sd":0.01}"#,
        ),
        (
            ConsistencyWarning::WhiteUneven { shot: "s".into(), looks: "stripes".into(), share: 0.25 }.into(),
            r#"{"warning":"white-uneven","shot":"s","looks":"stripes","share":0.25}"#,
        ),
        (
            ConsistencyWarning::ClipsBelow { file: "a.png".into(), code: 4000.0, given: 16055.0, photographs: 2 }
                .into(),
            r#"{"warning":"clips-below","file":"a.png","code":4000.0,"given":16055.0,"photographs":2}"#,
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
