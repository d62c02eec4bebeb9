//! Looking for the camera's halo where no light falls: on the opaque frame.

use super::BuildOptions;
use super::light_spots;
use super::scene::{Scene, on_slab};
use crate::capture::Pattern;
use crate::geometry::Point;
use crate::progress::Progress;
use crate::radiance::{Radiance, StrayLight, evenly};
use crate::warning::bounds::EVEN_REFUSED;
use crate::{ConsistencyWarning, Result, Warning};
use rayon::prelude::*;

/// Lattice shots that are looked at.
const SHOTS: usize = 4;
/// Pixels around the sample and around a reference dot's edge that light may reach directly.
const RIM_PX: f64 = 4.0;
/// Places of the mask are decided in squares of so many pixels.
const MASK_PX: usize = 4;

/// Even light that is a larger share of a dot's light in its window is told, and from [`EVEN_REFUSED`] on refused.
const EVEN_TOLD: f64 = 1e-4;
/// A halo of more light than this is none that lenses have (half a per cent, five with a fingerprint).
const LARGEST_HALO: f64 = 0.1;

/// The halo in some lattice shots, spread over the sweep; nothing when the photographs show too little of the frame.
/// `flicker_sd`: of the lamp, relative.
///
/// # Errors
/// Those of decoding; [`crate::Error::Contradiction`] for light that is no halo.
pub(super) fn measure(
    scene: &Scene<'_>,
    flicker_sd: Option<f64>,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<(StrayLight, Vec<Warning>)> {
    let lattice = scene.lattice();
    let mut dark = dark_pixels(scene);
    if !dark.contains(&true) {
        return Ok((StrayLight::default(), vec![]));
    }
    let stage = progress.stage("stray light", SHOTS.min(lattice.len()));
    let picture = |shot: usize| -> Result<Radiance> {
        let mut picture = scene.photographs.merge_whole(shot)?;
        picture.subtract(&scene.references.ambient);
        stage.advance(1);
        Ok(picture)
    };
    let shots: Vec<usize> = evenly(&lattice, SHOTS).collect();
    let pictures: Vec<Radiance> = shots.par_iter().map(|&s| picture(s)).collect::<Result<_>>()?;
    let mut warnings = Vec::new();
    if let Some(spots) = light_spots::find(&pictures, &dark) {
        spots.leave_out(&mut dark, scene.capture.rig.camera.size_px);
        warnings.push(spots.finding(scene, scene.photographs.one(|p| matches!(p, Pattern::SampleBlack))?).into());
    }
    let lamp = flicker_sd.map(|sd| (&scene.references.ambient, sd));
    let stray = StrayLight::estimate(&pictures, &dark, lamp).unwrap_or_default();
    if let Some(dn_per_sec) = stray.even {
        let window_px: f64 = scene.capture.manifest.window.samples.iter().map(|&n| n as f64 * scene.cell_px).product();
        let dots: usize = shots.iter().map(|&s| scene.dots(s).len()).sum();
        let light: f64 = pictures.iter().map(|p| sum_of_sample(p, &dark)).sum();
        let share = dn_per_sec * window_px * dots as f64 / light.max(f64::MIN_POSITIVE);
        let finding = ConsistencyWarning::AmbientChanged { dn_per_sec, share };
        match share.abs() {
            s if s > EVEN_REFUSED => warnings.push(options.refuse(finding)?),
            s if s > EVEN_TOLD => warnings.push(finding.into()),
            _ => {}
        }
        return Ok((stray, warnings));
    }
    if stray.share > LARGEST_HALO {
        warnings.push(options.refuse(ConsistencyWarning::HaloImplausible { share: stray.share, most: LARGEST_HALO })?);
        return Ok((StrayLight::default(), warnings));
    }
    Ok((stray, warnings))
}

/// Light of the pixels that are not dark, luminance.
fn sum_of_sample(picture: &Radiance, dark: &[bool]) -> f64 {
    let light = picture.luminance();
    light.iter().zip(dark).filter(|(_, dark)| !**dark).map(|(v, _)| f64::from(*v)).sum()
}

/// Pixels that see the frame or what is around it, away from its reference dots wherever they have drifted to.
fn dark_pixels(scene: &Scene<'_>) -> Vec<bool> {
    let [width, height] = scene.capture.rig.camera.size_px;
    let size_mm = scene.capture.manifest.slab.size_mm;
    let rim_mm = (RIM_PX + MASK_PX as f64) / scene.px_per_mm;
    let camera = |p: Point| scene.registration.view.camera_from_slab(p);
    let dots: Vec<Point> = scene.reference_mm().into_iter().map(camera).collect();
    let reach = scene.dot_radius_px() + scene.drift_search_px() + RIM_PX + MASK_PX as f64;
    let mut dark = vec![false; width * height];
    for y in (0..height).step_by(MASK_PX) {
        for x in (0..width).step_by(MASK_PX) {
            let q = [x as f64, y as f64];
            let Some(p) = scene.registration.view.slab_from_camera(q) else { continue };
            let near_dot = dots.iter().any(|d| (d[0] - q[0]).abs().max((d[1] - q[1]).abs()) < reach);
            if on_slab(p, size_mm, -rim_mm) || near_dot {
                continue;
            }
            for j in y..(y + MASK_PX).min(height) {
                dark[j * width + x..j * width + (x + MASK_PX).min(width)].fill(true);
            }
        }
    }
    dark
}
