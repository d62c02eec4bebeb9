//! What the tests of several stages need.

use crate::capture::{
    Camera, Capture, Grid, Manifest, Noise, Pattern, Photograph, Projector, ResponseCurve, Rig, Shot, Slab,
    WhiteReference, Window,
};

/// A capture of these patterns with photographs of these exposures, of which no file exists; 17 × 11 px.
pub(super) fn capture(shots: &[(Pattern, &[f64])]) -> Capture {
    let camera = Camera {
        size_px: [17, 11],
        focal_px: 50.0,
        principal_px: [9.0, 4.0],
        response: ResponseCurve::Linear,
        vignetting: vec![],
    };
    let noise = Noise { black_dn: 100.0, saturation_dn: 4000.0, gain_dn_per_electron: 0.5, read_noise_electrons: 4.0 };
    let rig = Rig {
        format: 1,
        camera,
        noise: Some(noise),
        projector: Projector { size_px: [64, 36], principal_px: None },
        board: None,
        frame: None,
        white_reference: WhiteReference { reflectance: [0.91, 0.74, 0.52] },
    };
    let name = |k: usize| format!("shot {k}");
    let photograph = |k: usize, secs: f64| Photograph {
        path: format!("{k}-{secs}.png").into(),
        shot: name(k),
        exposure_secs: secs,
        effective_secs: secs,
    };
    let of = |(k, (pattern, _)): (usize, &(Pattern, &[f64]))| Shot {
        name: name(k),
        pattern: pattern.clone(),
        photographs: vec![],
    };
    Capture {
        dir: "captures".into(),
        manifest: Manifest {
            format: 1,
            name: "by hand".into(),
            slab: Slab { size_mm: [20.0, 9.0] },
            grid: Grid {
                points: [5, 3],
                origin_projector_px: [4.0, 6.0],
                step_projector_px: [3.0, 2.0],
                dot_projector_px: 2,
            },
            window: Window { samples: [7, 5], pitch_mm: 0.5 },
            reference_dots: None,
            shots: shots.iter().enumerate().map(of).collect(),
        },
        rig,
        rig_path: "captures/calibration/rig.toml".into(),
        brackets: shots
            .iter()
            .enumerate()
            .map(|(k, (_, secs))| secs.iter().map(|&s| photograph(k, s)).collect())
            .collect(),
        warnings: vec![],
    }
}
