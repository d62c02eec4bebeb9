//! Simulate: slab transport → projector → camera, to a capture folder with real image files and its truth.
//!
//! What a lab would deliver (`capture.toml`, `photos/`, `calibration/rig.toml`) and, beside it, what it cannot know:
//! `truth.rd.zarr`, the matrix that the photographs show, and `truth.toml`, the geometry and drift.
//!
//! # What is simulated
//! - The slab: light in voxels of optical coefficients, per channel, by diffusion with first and last flights
//!   (`light/diffusion.rs` says what this approximates and where it is wrong) or by photon Monte Carlo
//!   ([`monte_carlo`]). Each lit dot has its own box, centred on the dot, so that equal surroundings give equal
//!   responses wherever the dot falls. What the camera sees of it is a continuous (C²) field; camera and truth
//!   integrate the same.
//! - The projector: a homography, square pixels with a little blur, a black level, smooth falloff, a lamp that may
//!   flicker; dots displaced by the shot's drift: a slow walk and jumps.
//! - The frame: opaque, Lambertian. It only masks: the slab continues beneath it and its light there is not returned.
//! - The camera: a tilted pinhole with radial distortion and vignetting, a point-spread function with a wide halo,
//!   pixels that average over their area, a real device's sensor with photon and read noise, hot pixels, pedestal,
//!   rounding and clipping, a response curve. It may move between lattice shots.
//!
//! Every imperfection is a [`Cause`] with a switch.
//!
//! Not simulated: specular reflection, depth of field, interreflection, colour crosstalk, fixed pattern noise but hot
//! pixels. Responses are those of the design: π times the radiance at x_o towards the camera, per unit flux arriving at
//! x_i, mm⁻².

mod bench;
mod camera;
mod causes;
mod light;
mod made;
mod options;
mod scene;
mod shot_list;
pub mod slab;
mod studio;

pub use camera::photograph::{ExposureTime, write_photograph};
pub use causes::Cause;
pub use light::{beam::Beam, monte_carlo, solution::Balance};
pub use options::{BenchKind, CameraCurve, FileFormat, RigCurve, SensorKind, SimulateOptions, Transport};
pub use slab::{Beyond, Optics, SlabMaterial, SlabRecord, Volume};

use crate::{
    Error, Result, SimulateWarning,
    capture::write_checksums,
    files::hash,
    geometry::{CameraView, Homography, Lens, Point},
    output::{Earlier, NewFolder, key_of},
    progress::Progress,
    transport::{MatrixHeader, MatrixWriter, ShotRecord},
};
use bench::Bench;
use made::Made;
pub use made::TakenOver;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use shot_list::ShotList;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use studio::Studio;

/// The matrix of what a simulated capture shows lies in its folder under this name.
pub const TRUTH_MATRIX: &str = "truth.rd.zarr";
/// And what else a lab cannot know under this.
const TRUTH_FILE: &str = "truth.toml";

/// What was written.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Summary {
    /// Number of shots.
    pub shots: usize,
    /// Number of photographs.
    pub photographs: usize,
    /// Their width and height, px, also when none was taken.
    pub size_px: [usize; 2],
    /// Bytes of all photographs.
    pub photograph_bytes: u64,
    /// Photon noise of the truth: standard error of all rows over the rows, both Euclidean. `None` for diffusion.
    pub photon_noise: Option<f64>,
    /// Findings about the slab and how its light was solved for.
    pub warnings: Vec<SimulateWarning>,
    /// What a stopped run had made of it.
    #[serde(skip)]
    pub taken_over: TakenOver,
}

/// `truth.toml`: what a lab cannot know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Scale of the sensor: electrons per second and unit of radiance at the principal point. `None` without
    /// photographs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub electrons_per_sec_per_radiance: Option<f64>,
    /// How far photon noise may put the matrix off the slab's own: see [`Summary::photon_noise`].
    #[serde(default)]
    pub photon_noise: Option<f64>,
    /// Thickness of the layers that diffusion solves on, mm.
    pub layers_mm: Vec<f64>,
    /// The camera's response curve, whatever the rig file says: pairs of linear light and encoded value, both 0 to 1.
    #[serde(default)]
    pub response_curve: Vec<[f64; 2]>,
    /// Exposure times: what EXIF says and what they are, s; those of reference shots first.
    #[serde(default)]
    pub exposures_secs: Vec<[f64; 2]>,
    /// All options.
    pub options: SimulateOptions,
    /// The material's coefficients and layout.
    pub medium: SlabRecord,
    /// The camera's view of the slab, lens included.
    pub camera_from_slab: CameraView,
    /// Projector px to slab mm, without drift: the homography of an ideal lens.
    pub slab_from_projector: Homography,
    /// The projector's lens; `None` for an ideal one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub projector_lens: Option<Lens>,
    /// Drift of each lattice shot.
    pub shots: Vec<ShotTruth>,
}

/// The drift of one lattice shot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShotTruth {
    /// Its name in `capture.toml`.
    pub name: String,
    /// Displacement of its dots, camera px at the slab's centre.
    pub drift_px: Point,
    /// The same on the slab, mm.
    pub drift_mm: Point,
    /// How far the whole picture has moved with the camera, px: besides `drift_px`.
    #[serde(default)]
    pub camera_drift_px: Point,
}

/// Writes a simulated capture to `dir`, or with `options.truth_only` its truth alone. The same options give the same
/// bytes, whatever the number of threads. What an earlier run for the same `dir` has made with the same options, which
/// was killed or ended by [`Error::Io`], is not made again.
///
/// # Errors
/// [`Error::Setting`] for options out of range or a `dir` that is not empty (unless `options.force`); [`Error::Io`].
pub fn simulate(options: &SimulateOptions, dir: &Path, progress: &Progress) -> Result<Summary> {
    options.check()?;
    NewFolder::check(dir, options.force)?;
    let fitted = scene::fitted(options)?;
    let bench = Bench::new(&fitted, progress)?;
    let options = &SimulateOptions { voxels_blake3: bench.record.voxels_blake3.clone(), ..fitted };
    let key = key_of(&SimulateOptions { force: false, ..options.clone() })?;
    let (new, log, earlier) = NewFolder::go_on::<()>(dir, options.force, &key)?;
    if !matches!(earlier, Earlier::Finished(_)) {
        log.add(&())?;
    }
    let work = Work { path: &new.path(), scratch: new.scratch(), key: &key };
    let done = match options.truth_only {
        true => write_truth_only(options, bench, &work, progress),
        false => Studio::new(options, bench).and_then(|studio| write_capture(options, studio, &work, progress)),
    };
    if done.as_ref().is_err_and(Error::is_of_system) {
        new.keep_work();
    }
    let mut summary = done?;
    summary.taken_over.anew = earlier == Earlier::Other;
    new.finish()?;
    Ok(summary)
}

/// Where the work is done until all is there.
struct Work<'a> {
    path: &'a Path,
    /// The folder around it.
    scratch: &'a Path,
    key: &'a str,
}

impl Work<'_> {
    fn matrix(&self, header: MatrixHeader) -> Result<MatrixWriter> {
        MatrixWriter::go_on_in(self.scratch, &self.path.join(TRUTH_MATRIX), header)
    }
}

fn create_folder(path: &Path) -> Result<()> {
    std::fs::create_dir_all(path).map_err(Error::io("create", path))
}

/// Photographs, manifest and rig, and the truth beside them.
fn write_capture(options: &SimulateOptions, studio: Studio, at: &Work<'_>, progress: &Progress) -> Result<Summary> {
    let work = at.path;
    let plan = ShotList::new(options, &studio.bench.scene, |pattern| studio.bracket(options, pattern).len());
    create_folder(&work.join("photos"))?;
    create_folder(&work.join("calibration"))?;
    plan.manifest.write(work)?;
    let noise = (!options.rig_without_noise).then(|| studio.sensor.noise());
    studio.bench.scene.rig(noise).write(&work.join("calibration"))?;
    let matrix = at.matrix(header(options, &studio.bench, &plan)?)?;
    let made = Made::of(&matrix, at.key)?;

    let bytes = AtomicU64::new(0);
    let checksums = Mutex::new(BTreeMap::new());
    let stage = progress.stage("photograph", plan.manifest.shots.len());
    (0..plan.manifest.shots.len()).into_par_iter().try_for_each(|shot| -> Result<()> {
        stage.begin();
        let entry = &plan.manifest.shots[shot];
        let rows: Vec<usize> = shot_list::dots(entry).iter().map(|&dot| plan.manifest.grid.row_index(dot)).collect();
        let hashes = || -> Result<Vec<(String, blake3::Hash)>> {
            let of = |file: &String| hash(&work.join(file)).map_err(Error::io("read", work.join(file)));
            entry.photographs.iter().map(|p| Ok((p.file.clone(), of(&p.file)?))).collect()
        };
        let photographs = match made.take(&matrix, &studio.bench, shot, &rows, hashes)? {
            Some(taken) => taken,
            None => {
                studio.shoot(options, &plan, shot, work, &matrix)?;
                let photographs = hashes()?;
                made.add(&matrix, &studio.bench, shot, &rows, &photographs)?;
                photographs
            }
        };
        for (file, hash) in photographs {
            let path = work.join(&file);
            bytes.fetch_add(path.metadata().map_err(Error::io("read", &path))?.len(), Ordering::Relaxed);
            checksums.lock().map_err(Error::internal)?.insert(file, hash);
        }
        stage.advance(1);
        Ok(())
    })?;
    write_checksums(work, &checksums.into_inner().map_err(Error::internal)?)?;
    matrix.finish()?;
    let truth = Truth {
        electrons_per_sec_per_radiance: Some(studio.electrons_per_sec),
        response_curve: options.response_curve().samples(),
        exposures_secs: studio.exposures(options),
        ..truth(options, &studio.bench, &plan)
    };
    truth.write(work)?;
    let photographs = plan.manifest.shots.iter().map(|s| s.photographs.len()).sum();
    let taken_over = made.taken_over();
    Ok(Summary { photographs, photograph_bytes: bytes.into_inner(), taken_over, ..summary(studio.bench, &plan) })
}

/// The true matrix, and what else a lab cannot know; nothing that would be taken for a capture.
fn write_truth_only(options: &SimulateOptions, bench: Bench, at: &Work<'_>, progress: &Progress) -> Result<Summary> {
    let plan = ShotList::new(options, &bench.scene, |_| 0);
    let matrix = at.matrix(header(options, &bench, &plan)?)?;
    let made = Made::of(&matrix, at.key)?;
    let lit: Vec<([usize; 2], Point)> = plan.manifest.shots[plan.first_lattice..]
        .iter()
        .zip(&plan.lattices)
        .flat_map(|(shot, moved)| shot_list::dots(shot).iter().map(|&dot| (dot, moved.drift_mm)))
        .collect();
    let stage = progress.stage("solve", lit.len());
    lit.into_par_iter().try_for_each(|(dot, drift_mm)| -> Result<()> {
        stage.begin();
        let row = plan.manifest.grid.row_index(dot);
        if made.take(&matrix, &bench, row, &[row], || Ok(vec![]))?.is_none() {
            let glow = bench.glow(dot, drift_mm)?;
            matrix.put(row, &bench.row(options, dot, drift_mm, &glow))?;
            made.add(&matrix, &bench, row, &[row], &[])?;
        }
        stage.advance(1);
        Ok(())
    })?;
    matrix.finish()?;
    truth(options, &bench, &plan).write(at.path)?;
    Ok(Summary { taken_over: made.taken_over(), ..summary(bench, &plan) })
}

/// Without photographs.
fn summary(bench: Bench, plan: &ShotList) -> Summary {
    Summary {
        shots: plan.manifest.shots.len(),
        photographs: 0,
        size_px: bench.scene.camera.size_px,
        photograph_bytes: 0,
        photon_noise: bench.photon_noise(),
        warnings: bench.warnings,
        taken_over: TakenOver::default(),
    }
}

/// What can be known of the truth without a camera's sensor.
fn truth(options: &SimulateOptions, bench: &Bench, plan: &ShotList) -> Truth {
    Truth {
        electrons_per_sec_per_radiance: None,
        photon_noise: bench.photon_noise(),
        layers_mm: bench.dots.slab.layers_mm.clone(),
        response_curve: Vec::new(),
        exposures_secs: Vec::new(),
        options: options.clone(),
        medium: bench.record.clone(),
        camera_from_slab: bench.scene.view,
        slab_from_projector: bench.scene.slab_from_projector.homography(),
        projector_lens: Some(*bench.scene.slab_from_projector.lens()).filter(|l| !l.is_ideal()),
        shots: plan.lattices.clone(),
    }
}

impl Truth {
    fn write(&self, work: &Path) -> Result<()> {
        let path = work.join(TRUTH_FILE);
        let text = toml::to_string(self).map_err(Error::internal)?;
        std::fs::write(&path, text).map_err(Error::io("write", &path))
    }
}

fn header(options: &SimulateOptions, bench: &Bench, plan: &ShotList) -> Result<MatrixHeader> {
    let points = bench.scene.grid.points;
    let mut lit_mm = vec![[0.0; 2]; bench.scene.grid.len()];
    let mut shot_of = vec![None; lit_mm.len()];
    for (lattice, shot) in plan.manifest.shots[plan.first_lattice..].iter().enumerate() {
        for &dot in shot_list::dots(shot) {
            let row = plan.manifest.grid.row_index(dot);
            lit_mm[row] = bench.scene.dot_mm(dot, plan.lattices[lattice].drift_mm);
            shot_of[row] = Some(lattice);
        }
    }
    // The mean step along each axis, drift left out.
    let lit_pitch_mm = std::array::from_fn(|a| {
        let steps = points[a].saturating_sub(1);
        if steps == 0 {
            return options.pitch_mm;
        }
        let end = std::array::from_fn(|b| if a == b { steps } else { 0 });
        let (p, q) = (bench.scene.dot_mm([0, 0], [0.0; 2]), bench.scene.dot_mm(end, [0.0; 2]));
        (q[0] - p[0]).hypot(q[1] - p[1]) / steps as f64
    });
    let record = |s: &ShotTruth| ShotRecord { name: s.name.clone(), drift_px: s.drift_px, drift_sd_px: Some(0.0) };
    Ok(MatrixHeader {
        points,
        window: options.window,
        pitch_mm: options.pitch_mm,
        lit_pitch_mm,
        position_sd_mm: vec![0.0; lit_mm.len()],
        lit_mm,
        shot_of,
        common: None,
        shots: plan.lattices.iter().map(record).collect(),
        camera_px_per_mm: Some(options.camera_px_per_sample / options.pitch_mm),
        warnings: Vec::new(),
        provenance: serde_json::json!({
            "source": "acquire simulate: the truth of a simulated capture",
            "version": env!("CARGO_PKG_VERSION"),
            "seed": options.seed,
            "options": serde_json::to_value(options).map_err(Error::internal)?,
        }),
    })
}

/// A seed from a seed and a number, well mixed (SplitMix64; Steele et al. 2014).
fn mix_seed(seed: u64, n: u64) -> u64 {
    let mut z = seed.wrapping_add(n.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}
