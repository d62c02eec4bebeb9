//! What the tests of several stages need.

use super::*;
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
        response_curve: ResponseCurve::Linear,
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
        white_reference: WhiteReference { reflectance: [0.91, 0.74, 0.52], relative_sd: 0.0 },
    };
    let name = |k: usize| format!("shot {k}");
    let photograph = |k: usize, secs: f64| Photograph::new(format!("{k}-{secs}.png"), name(k), secs);
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
                dot_area_projector_px2: None,
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

/// What a stage gave; when asked, saved and loaded on the way.
fn passed<T: serde::Serialize + serde::de::DeserializeOwned>(output: T, through_files: bool) -> T {
    match through_files {
        true => serde_json::from_slice(&serde_json::to_vec(&output).unwrap()).unwrap(),
        false => output,
    }
}

#[test]
fn stages_that_go_on_from_saved_outputs_give_the_same_rows_to_the_last_bit() {
    let capture = Capture::open(std::path::Path::new("captures"), None).unwrap();
    let (options, silent) = (BuildOptions::default(), Progress::silent());
    let rows = [false, true].map(|through_files| {
        let noise = passed(noise::find(&capture).unwrap(), through_files);
        let radiometry = radiometry::calibrate(&capture, &noise.noise, &options, &silent).unwrap();
        let radiometry = passed(radiometry, through_files);
        let photographs = Photographs::new(&capture, &capture, &radiometry, 1);
        let registered = passed(register::register(&photographs, &options, &silent).unwrap(), through_files);
        let references =
            references::references(&photographs, &registered, radiometry.flicker_sd, &options, &silent).unwrap();
        let references = passed(references, through_files);
        let scene = Scene::new(&photographs, &registered, &references);
        let stray = passed(stray::measure(&scene, radiometry.flicker_sd, &options, &silent).unwrap().0, through_files);
        let flicker = passed(Flicker::measure(&scene, radiometry.flicker_sd).unwrap(), through_files);
        let (light, sink) = (LightCorrections { stray, flicker }, HeldRows::default());
        let movements = Movements::prepare(&scene).unwrap();
        let search = dots_seen::DotSearch::new(&scene).unwrap();
        let (registered, findings, at) = (&registered, vec![], Instant::now());
        let prepared = Prepared { scene: &scene, registered, light, movements, search, findings, at };
        lattice::extract(&prepared, &sink, &silent).unwrap();
        let row = |index: usize| sink.row(index).unwrap();
        (0..capture.manifest.grid.len()).map(row).collect::<Vec<_>>()
    });
    assert_eq!(rows[0].len(), 63);
    assert_eq!(rows[0], rows[1]);
}
