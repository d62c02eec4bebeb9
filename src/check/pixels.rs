//! What the pixels of a few shots tell: saturation, darkness, dots that are not there.

use crate::capture::{Capture, Pattern, Photograph, Rect};
use crate::geometry::Point;
use crate::pipeline::BuildReport;
use crate::radiance::{Radiance, Sensor, merge_shot};
use crate::warning::bounds::{DARK_SHARE, SATURATED_SHARE};
use crate::{CheckWarning, Result};
use rayon::prelude::*;

/// A pixel is black when its light is less than so many standard deviations.
const BLACK_SIGMA: f32 = 2.0;
/// A dot is there when it is so many times brighter than what surrounds it …
const DOT_CONTRAST: f64 = 1.2;
/// … by so many standard deviations.
const DOT_SIGMA: f64 = 5.0;

/// Decodes whole shots of a capture.
pub(super) struct Pictures<'a> {
    capture: &'a Capture,
    sensor: Sensor,
    whole: Rect,
}

/// What [`Pictures::lattice`] saw in the sampled shots.
#[derive(Default)]
pub(super) struct SeenDots {
    pub looked_at: usize,
    saturated: Vec<String>,
    dead: Vec<(String, [usize; 2])>,
    /// Shot and share of its windows that is black in the longest exposure.
    dark: Vec<(String, f64)>,
}

impl<'a> Pictures<'a> {
    pub(super) fn new(capture: &'a Capture, sensor: Sensor) -> Self {
        let [width, height] = capture.rig.camera.size_px;
        Self { capture, sensor, whole: Rect { x: 0, y: 0, width, height } }
    }

    /// The merged picture of some exposures of one shot.
    pub(super) fn merged(&self, photographs: &[Photograph]) -> Result<Radiance> {
        merge_shot(photographs, self.capture.rig.camera.size_px, &self.sensor)
    }

    /// Saturation of the shots without dots, over the slab when it is known where that is, else over the whole picture.
    pub(super) fn stills(&self, report: Option<&BuildReport>) -> Result<Vec<CheckWarning>> {
        let region = report.map_or(self.whole, |r| bounds(&r.overview.slab_px, self.whole));
        let mut found = Vec::new();
        for shot in self.capture.shots(|p| matches!(p, Pattern::Board | Pattern::ReferenceWhite)) {
            let (bracket, name) = (&self.capture.brackets[shot], &self.capture.manifest.shots[shot].name);
            let shortest = self.merged(&bracket[..1])?;
            let share = share(&shortest, region, |used, _, _| used == 0);
            if share > SATURATED_SHARE {
                found.push(CheckWarning::Saturated { shot: name.clone(), share });
            }
            let longest = self.merged(&bracket[bracket.len() - 1..])?;
            let share = self::share(&longest, region, black);
            if share > DARK_SHARE {
                found.push(CheckWarning::Dark { shot: name.clone(), share });
            }
        }
        Ok(found)
    }

    /// The dots of all lattice shots of the capture, which is a sample; `report` is that of the same sample.
    pub(super) fn lattice(&self, report: &BuildReport) -> Result<SeenDots> {
        let black = self.capture.shots(|p| matches!(p, Pattern::SampleBlack));
        let ambient = self.merged(black.first().map_or(&[][..], |&s| &self.capture.brackets[s]))?;
        let shots = self.capture.shots(|p| matches!(p, Pattern::Lattice { .. }));
        let seen: Vec<SeenDots> = shots
            .par_iter()
            .zip(&report.shots)
            .map(|(&shot, record)| {
                // The drift is told in the camera's own pixels.
                let drift_px = record.drift_px.map(|d| d / report.working.factor as f64);
                self.lattice_shot(shot, drift_px, report, &ambient)
            })
            .collect::<Result<_>>()?;
        Ok(seen.into_iter().fold(SeenDots::default(), |mut all, one| {
            all.looked_at += one.looked_at;
            all.saturated.extend(one.saturated);
            all.dead.extend(one.dead);
            all.dark.extend(one.dark);
            all
        }))
    }

    fn lattice_shot(&self, shot: usize, drift_px: Point, report: &BuildReport, ambient: &Radiance) -> Result<SeenDots> {
        let (manifest, bracket) = (&self.capture.manifest, &self.capture.brackets[shot]);
        let name = &manifest.shots[shot].name;
        let Pattern::Lattice { dots } = &manifest.shots[shot].pattern else { return Ok(SeenDots::default()) };
        let mut picture = self.merged(bracket)?;
        picture.subtract(ambient);
        let shortest = self.merged(&bracket[..1])?;
        let longest = self.merged(&bracket[bracket.len() - 1..])?;
        let scale = Scale::new(self.capture, report);
        let mut out = SeenDots { looked_at: dots.len(), ..SeenDots::default() };
        let (mut dark, mut pixels) = (0.0, 0.0);
        for &dot in dots {
            let place = report.registration.slab_from_projector.map(manifest.grid.dot_projector_px(dot));
            let nominal = report.registration.view.camera_from_slab(place);
            let at = [nominal[0] + drift_px[0], nominal[1] + drift_px[1]];
            let Some(middle) = square(at, 1.0, self.whole) else { continue };
            if share(&shortest, middle, |used, _, _| used == 0) > 0.0 {
                out.saturated.push(name.clone());
            }
            if is_dead(&picture, at, middle, scale.ring_px) {
                out.dead.push((name.clone(), dot));
            }
            if let Some(window) = square(at, scale.window_px, self.whole) {
                dark += share(&longest, window, black) * window.area() as f64;
                pixels += window.area() as f64;
            }
        }
        if pixels > 0.0 {
            out.dark.push((name.clone(), dark / pixels));
        }
        Ok(out)
    }
}

impl SeenDots {
    pub(super) fn findings(&self) -> Vec<CheckWarning> {
        let (of, mut found) = (self.looked_at, Vec::new());
        if let Some(shot) = self.saturated.first() {
            found.push(CheckWarning::SaturatedDots { shot: shot.clone(), dots: self.saturated.len(), of });
        }
        if let Some((shot, dot)) = self.dead.first() {
            found.push(CheckWarning::DeadDots { shot: shot.clone(), dot: *dot, dots: self.dead.len(), of });
        }
        let darkest = self.dark.iter().max_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((shot, share)) = darkest.filter(|d| d.1 > DARK_SHARE) {
            found.push(CheckWarning::Dark { shot: shot.clone(), share: *share });
        }
        found
    }

    /// The largest share of black pixels in the windows of a shot.
    pub(super) fn dark_share(&self) -> Option<f64> {
        self.dark.iter().map(|d| d.1).reduce(f64::max)
    }
}

/// Lengths in the picture, px.
struct Scale {
    /// From a dot's middle to beyond its light's peak.
    ring_px: f64,
    /// Half the window.
    window_px: f64,
}

impl Scale {
    fn new(capture: &Capture, report: &BuildReport) -> Self {
        let (grid, window) = (&capture.manifest.grid, &capture.manifest.window);
        let px_per_mm = report.registration.px_per_mm();
        let pixel_mm = report.registration.slab_from_projector.area_scale(grid.origin_projector_px).sqrt();
        let dot_px = grid.dot_projector_px as f64 * pixel_mm * px_per_mm;
        let pitch_px = window.pitch_mm * px_per_mm;
        let window_px = 0.5 * window.samples[0].max(window.samples[1]) as f64 * pitch_px;
        Self { ring_px: 0.5 * dot_px + pitch_px.max(2.0), window_px }
    }
}

/// Whether no dot stands out from what surrounds its place; where pixels are saturated there is light.
fn is_dead(picture: &Radiance, at: Point, middle: Rect, ring_px: f64) -> bool {
    let light = |x: usize, y: usize| {
        let k = picture.at(x, y);
        let sum = |v: &[f32]| v[k..k + 3].iter().map(|&v| f64::from(v)).sum::<f64>();
        (!picture.used[k..k + 3].contains(&0)).then(|| (sum(&picture.value) / 3.0, sum(&picture.variance) / 9.0))
    };
    let pixels =
        (middle.y..middle.y + middle.height).flat_map(|y| (middle.x..middle.x + middle.width).map(move |x| (x, y)));
    let Some(inner) = pixels.map(|(x, y)| light(x, y)).collect::<Option<Vec<_>>>() else { return false };
    let mut ring: Vec<f64> = (0..16)
        .filter_map(|k| {
            let (sin, cos) = (std::f64::consts::TAU * f64::from(k) / 16.0).sin_cos();
            let q = square([at[0] + ring_px * cos, at[1] + ring_px * sin], 0.0, picture.rect)?;
            light(q.x, q.y).map(|l| l.0)
        })
        .collect();
    ring.sort_by(f64::total_cmp);
    let around = ring.get(ring.len() / 2).copied().unwrap_or(0.0);
    let n = inner.len() as f64;
    let (mean, sd) =
        (inner.iter().map(|l| l.0).sum::<f64>() / n, (inner.iter().map(|l| l.1).sum::<f64>() / (n * n)).sqrt());
    !(mean > DOT_CONTRAST * around && mean - around > DOT_SIGMA * sd)
}

fn black(used: u8, value: f32, variance: f32) -> bool {
    used > 0 && value < BLACK_SIGMA * variance.sqrt()
}

/// The share of a region's samples of which `is` holds, told (used, value, variance).
fn share(picture: &Radiance, region: Rect, is: impl Fn(u8, f32, f32) -> bool) -> f64 {
    let mut count = 0usize;
    for y in region.y..region.y + region.height {
        let k = picture.at(region.x, y);
        count +=
            (k..k + 3 * region.width).filter(|&k| is(picture.used[k], picture.value[k], picture.variance[k])).count();
    }
    count as f64 / (3 * region.area()).max(1) as f64
}

/// The pixels within `reach` of `at` along both axes; `None` when that is outside the picture.
fn square(at: Point, reach: f64, whole: Rect) -> Option<Rect> {
    let range = |a: usize, n: usize| {
        let (low, high) = ((at[a] - reach).round().max(0.0), (at[a] + reach).round().min(n as f64 - 1.0));
        (low <= high).then_some((low as usize, (high - low) as usize + 1))
    };
    let ((x, width), (y, height)) = (range(0, whole.width)?, range(1, whole.height)?);
    Some(Rect { x, y, width, height })
}

/// The box around some points, cut to the picture; all of it when nothing is left.
fn bounds(points: &[Point], whole: Rect) -> Rect {
    let fold = |a: usize, pick: fn(f64, f64) -> f64| points.iter().map(|p| p[a]).reduce(pick).unwrap_or(0.0);
    let range = |a: usize, n: usize| {
        let (low, high) = (fold(a, f64::min).max(0.0), fold(a, f64::max).min(n as f64 - 1.0));
        (low <= high).then_some((low as usize, (high - low) as usize + 1))
    };
    match (range(0, whole.width), range(1, whole.height)) {
        (Some((x, width)), Some((y, height))) => Rect { x, y, width, height },
        _ => whole,
    }
}
