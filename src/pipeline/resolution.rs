//! At what resolution photographs are worked on: fine enough for the samples of the windows, and no finer.

use super::BuildOptions;
use crate::capture::{Capture, Noise, Pattern, Reduction};
use crate::progress::Progress;
use crate::radiance::{Sensor, merge_shot};
use crate::registration::{Pairs, find_board, fit_lens_of_views, register_frame};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Camera pixels across an outgoing sample below which photographs are not reduced any further. From 8 on the matrix is
/// as good as at full resolution (docs/accuracy.md).
const LEAST_PX: f64 = 8.0;
/// The first look is at a picture of about so many pixels: a board of some hundred squares is found in it.
const LOOK_PX: usize = 1000;

/// Stripes and dots keep so many pixels: as narrow as `patterns` makes stripes, and what a dot has at three pixels a
/// sample.
const STRIPE_PX: f64 = 6.0;
const DOT_PX: f64 = 2.0;
/// A lattice fills a half of the slab's side or more.
const FILLED: f64 = 0.5;

/// How photographs are reduced while they are decoded.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Resolution {
    /// To eight camera pixels across an outgoing sample, or more.
    #[default]
    Auto,
    /// Not at all.
    Full,
    /// To this many camera pixels across an outgoing sample, or more.
    PxPerSample(f64),
}

/// The resolution that was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Working {
    /// Camera pixels along each side of the blocks that photographs are averaged over.
    pub factor: usize,
    /// Camera pixels across an outgoing sample before that; `None` where it was not looked for.
    pub px_per_sample: Option<f64>,
}

/// Camera pixels across a sample that are left at the least, where photographs may be reduced at all.
///
/// # Errors
/// [`Error::Setting`] for a resolution that is not positive.
pub(super) fn reducible(capture: &Capture, options: &BuildOptions) -> Result<Option<f64>> {
    let least_px = match options.resolution {
        Resolution::Full => return Ok(None),
        Resolution::Auto => LEAST_PX,
        Resolution::PxPerSample(px) if (1.0..=1e4).contains(&px) => px,
        Resolution::PxPerSample(px) => {
            let expected = "full, auto, or 1 to 10000 camera pixels across a sample".into();
            return Err(Error::Setting { setting: "resolution", expected, found: px.to_string() });
        }
    };
    Ok((at_most(capture) >= 2.0 * least_px).then_some(least_px))
}

/// Chooses it; `sensor` is that of the photographs as they are.
///
/// # Errors
/// [`Error::Setting`] for a resolution that is not positive; those of decoding.
pub(super) fn choose(
    capture: &Capture,
    noise: &Noise,
    sensor: &Sensor,
    options: &BuildOptions,
    progress: &Progress,
) -> Result<Working> {
    let Some(least_px) = reducible(capture, options)? else {
        return Ok(Working { factor: 1, px_per_sample: None });
    };
    let stage = progress.stage("resolution", 1);
    let px_per_mm = px_per_mm(capture, noise, sensor)?;
    stage.advance(1);
    let px_per_sample = px_per_mm.map(|px| px * capture.manifest.window.pitch_mm);
    let factor = px_per_mm.zip(px_per_sample).map_or(1.0, |(per_mm, per_sample)| {
        let projected = projected_mm(capture).map(|[stripe, dot]| (stripe / STRIPE_PX).min(dot / DOT_PX) * per_mm);
        (per_sample / least_px).min(projected.unwrap_or(f64::INFINITY))
    });
    Ok(Working { factor: factor.floor().max(1.0) as usize, px_per_sample })
}

/// The narrowest stripe and the side of a dot on the slab, mm, at the least: the lattice is not larger than the slab.
fn projected_mm(capture: &Capture) -> Option<[f64; 2]> {
    let (grid, slab) = (&capture.manifest.grid, &capture.manifest.slab);
    let finest = capture.manifest.shots.iter().filter_map(|s| match s.pattern {
        Pattern::GrayCode { bit, .. } => Some(bit),
        _ => None,
    });
    let extent = |a: usize| grid.points[a].saturating_sub(1) as f64 * grid.step_projector_px[a].abs();
    // The shorter side for the longer axis: the slab may lie a quarter turned.
    let side = slab.size_mm[0].min(slab.size_mm[1]);
    let px_mm = FILLED * side / extent(0).max(extent(1)).max(1.0);
    Some([2.0_f64.powi(finest.min()? as i32 + 1) * px_mm, grid.dot_projector_px as f64 * px_mm])
}

/// No more camera pixels can be across a sample when the whole slab is in the picture, at whatever angle.
fn at_most(capture: &Capture) -> f64 {
    let side = |v: [f64; 2]| v[0].hypot(v[1]);
    let picture = side(capture.rig.camera.size_px.map(|s| s as f64));
    let [width, height] = capture.manifest.slab.size_mm;
    picture / width.max(height) * capture.manifest.window.pitch_mm
}

/// Camera pixels in a mm at the slab's centre, from a small picture of the board or of the frame; `None` when neither
/// is found in any.
fn px_per_mm(capture: &Capture, noise: &Noise, sensor: &Sensor) -> Result<Option<f64>> {
    let [width, height] = capture.rig.camera.size_px;
    let mut factor = width.max(height).div_ceil(LOOK_PX).max(1);
    let center_mm = capture.manifest.slab.size_mm.map(|s| 0.5 * s);
    loop {
        let by = Reduction::new(factor, noise.saturation_dn, sensor.light_of_codes());
        let small = capture.reduced(&by);
        if let Some(pairs) = plane(&small, &sensor.clone().averaged(factor, 1.0))? {
            let camera = &small.rig.camera;
            let fit = fit_lens_of_views(&[pairs], camera.principal_px, camera.focal_px);
            if let Some((fits, _)) = fit {
                return Ok(Some(fits[0].view.px_per_mm(center_mm) * factor as f64));
            }
        }
        if factor == 1 {
            return Ok(None);
        }
        // Squares that are too small there are larger here.
        factor /= 2;
    }
}

/// Where points of the sample's plane are seen, the board's or the frame's.
fn plane(capture: &Capture, sensor: &Sensor) -> Result<Option<Pairs>> {
    let [width, height] = capture.rig.camera.size_px;
    let picture = |kind: Pattern| -> Result<_> {
        let Some(&shot) = capture.shots(|p| *p == kind).first() else { return Ok(None) };
        merge_shot(&capture.brackets[shot], [width, height], sensor).map(Some)
    };
    if let (Some(board), Some(picture)) = (&capture.rig.board, picture(Pattern::Board)?) {
        return Ok(find_board(&picture, board, &capture.rig.camera).ok());
    }
    if let (Some(marks), Some(picture)) = (&capture.rig.frame, picture(Pattern::Frame)?) {
        return Ok(register_frame(&picture, marks, None, &capture.rig.camera).ok().map(|found| found.pairs(marks)));
    }
    Ok(None)
}
