//! The list of shots: what `capture.toml` says, with exposures and drift.

use super::{
    FileFormat, ShotTruth, SimulateOptions, camera::photograph::ExposureTime, mix_seed, scene::SimulatedScene,
    scene::drift::Motion,
};
use crate::capture::{Axis, FORMAT, Manifest, Pattern, PhotographEntry, ReferenceDots, Shot, Slab, Surface, Window};
use crate::geometry::Point;

/// Projector px of the narrowest Gray stripes: narrower ones blur together.
const NARROWEST_STRIPE_PX: u32 = 8;

/// The shots of a capture; after lattice shots comes at most one more of the frame.
#[derive(Debug)]
pub(super) struct ShotList {
    pub manifest: Manifest,
    pub first_lattice: usize,
    pub lattices: Vec<ShotTruth>,
}

impl ShotList {
    /// Lists all shots; `photographs` says how many a shot has.
    pub(super) fn new(
        options: &SimulateOptions,
        scene: &SimulatedScene,
        photographs: impl Fn(&Pattern) -> usize,
    ) -> Self {
        let mut patterns = vec![
            ("board".to_owned(), Pattern::Board),
            ("reference-white".to_owned(), Pattern::ReferenceWhite),
            ("reference-black".to_owned(), Pattern::ReferenceBlack),
            ("sample-black".to_owned(), Pattern::SampleBlack),
        ];
        if options.without_board {
            patterns.remove(0);
        }
        if options.dark_shot {
            patterns.push(("dark".to_owned(), Pattern::Dark));
        }
        if options.frame_marks {
            patterns.insert(0, ("frame".to_owned(), Pattern::Frame));
        }
        for n in 0..options.calibration_boards {
            patterns.push((format!("calibration-board-{n:02}"), Pattern::CalibrationBoard));
        }
        for (axis, letter, size) in
            [(Axis::X, 'x', scene.projector.size_px[0]), (Axis::Y, 'y', scene.projector.size_px[1])]
        {
            let bits = usize::BITS - (size.max(2) - 1).leading_zeros();
            let on = if options.gray_on_frame { Surface::Frame } else { Surface::WhiteReference };
            for bit in (0..bits).rev().filter(|&bit| 2 << bit >= NARROWEST_STRIPE_PX) {
                for inverse in [false, true] {
                    let name = format!("gray-{letter}-{bit:02}{}", if inverse { "-inverse" } else { "" });
                    patterns.push((name, Pattern::GrayCode { axis, bit, inverse, on }));
                }
            }
        }
        let first_lattice = patterns.len();
        let spacing: [usize; 2] = std::array::from_fn(|a| options.spacing()[a].min(options.grid[a]));
        for phase in 0..spacing[0] * spacing[1] {
            let every = |start: usize, a: usize| (start..options.grid[a]).step_by(spacing[a]);
            let [first_x, first_y] = [phase % spacing[0], phase / spacing[0]];
            let dots = every(first_y, 1).flat_map(|y| every(first_x, 0).map(move |x| [x, y])).collect();
            patterns.push((format!("lattice-{phase:04}"), Pattern::Lattice { dots }));
        }
        let names: Vec<String> = patterns[first_lattice..].iter().map(|(name, _)| name.clone()).collect();
        if options.frame_marks {
            patterns.push(("frame-after".to_owned(), Pattern::Frame));
        }
        let lattices = lattice_drift(options, names, |drift_px| scene.drift_mm(drift_px));
        let shots =
            patterns.into_iter().map(|(name, pattern)| shot(options, photographs(&pattern), name, pattern)).collect();
        let manifest = Manifest {
            format: FORMAT,
            name: format!("simulated {:?}", options.material).to_lowercase(),
            slab: Slab { size_mm: scene.slab_size_mm },
            grid: scene.grid.clone(),
            window: Window { samples: options.window, pitch_mm: options.pitch_mm },
            reference_dots: Some(ReferenceDots { projector_px: scene.reference_dots.clone() })
                .filter(|dots| !dots.projector_px.is_empty()),
            shots,
        };
        Self { manifest, first_lattice, lattices }
    }
}

/// Where projector and camera are at each lattice shot.
fn lattice_drift(options: &SimulateOptions, names: Vec<String>, drift_mm: impl Fn(Point) -> Point) -> Vec<ShotTruth> {
    let projector =
        Motion { walk_px: options.drift_px, jump_px: options.jump_px, jumps: options.jumps, seed: options.seed };
    let camera = Motion {
        walk_px: options.camera_drift_px,
        jump_px: options.camera_jump_px,
        jumps: options.camera_jumps,
        seed: mix_seed(options.seed, 0xca3e2a),
    };
    let paths = projector.path(names.len()).into_iter().zip(camera.path(names.len()));
    let truth = |(name, (drift_px, camera_drift_px))| ShotTruth {
        name,
        drift_px,
        drift_mm: drift_mm(drift_px),
        camera_drift_px,
    };
    names.into_iter().zip(paths).map(truth).collect()
}

fn shot(options: &SimulateOptions, photographs: usize, name: String, pattern: Pattern) -> Shot {
    let extension = match options.format {
        FileFormat::Png => "png",
        FileFormat::Tiff | FileFormat::TiffDeflate => "tif",
        FileFormat::Jpeg => "jpg",
    };
    let photographs = (0..photographs)
        .map(|n| PhotographEntry { file: format!("photos/{name}_{n}.{extension}"), exposure_secs: None })
        .collect();
    Shot { name, pattern, photographs }
}

/// The dots of a lattice shot, none for any other.
pub(super) fn dots(shot: &Shot) -> &[[usize; 2]] {
    match &shot.pattern {
        Pattern::Lattice { dots } => dots,
        _ => &[],
    }
}

/// Exposures from the shortest, each longer by `stops`.
pub(super) fn bracket(shortest: ExposureTime, count: usize, stops: f64) -> Vec<ExposureTime> {
    (0..count).map(|n| shortest.longer(n as f64 * stops)).collect()
}
