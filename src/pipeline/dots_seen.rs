//! Whether the dots of every lattice shot are where its pattern puts them: the sample's own dots against the reference
//! dots and the Gray code.

mod common;

use super::BuildOptions;
use super::drift::{around, dot_shape, half_spacing_px};
use super::lattice::ShotResult;
use super::looks::looks;
use super::scene::Scene;
use crate::capture::Window;
use crate::geometry::Point;
use crate::radiance::{Bracket, Radiance};
use crate::registration::{Drift, Registration, SampleDots};
use crate::transport::Row;
use crate::{ConsistencyWarning, Result, Warning};
use common::Common;

/// Where a dot of the sample was seen.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) enum DotSeen {
    /// Its core was found, this far (mm) from where pattern, registration and drift put it.
    At { off_mm: Point },
    /// There is no light in its window.
    Dark,
    /// There is light, and no dot's core.
    Unclear,
}

/// How the dots of the sample are looked for.
pub(super) struct DotSearch {
    dots: SampleDots,
    reach_px: f64,
    pitch_mm: f64,
    /// The window's cells by their distance from its middle, mm.
    cells: Vec<(f64, usize)>,
}

/// Dots that are off by more than this share of the distance of lit points are those of another pattern.
const STEP_SHARE: f64 = 0.4;
/// So near, in steps of the grid, a dot has to be to the place of another point to be taken for it.
const NEAR_STEP: f64 = 0.25;
impl DotSearch {
    pub(super) fn new(scene: &Scene<'_>) -> Result<Self> {
        let dots = SampleDots { shape: dot_shape(scene)?, dot_radius_px: scene.dot_radius_px() };
        let Window { samples: [nx, ny], pitch_mm } = scene.capture.manifest.window;
        let reach_px = 0.5 * nx.min(ny) as f64 * scene.cell_px;
        let distance = |k: usize| (k % nx).abs_diff(nx / 2) as f64;
        let across = |k: usize| (k / nx).abs_diff(ny / 2) as f64;
        let mut cells: Vec<(f64, usize)> = (0..nx * ny).map(|k| (pitch_mm * distance(k).hypot(across(k)), k)).collect();
        cells.sort_by(|a, b| a.0.total_cmp(&b.0));
        Ok(Self { dots, reach_px, pitch_mm, cells })
    }

    /// Looks for the dots of a shot around where they should be, to half the way to the next.
    pub(super) fn look(
        &self,
        scene: &Scene<'_>,
        shot: usize,
        registration: &Registration,
        drift: Option<Drift>,
        windows: &[Bracket],
    ) -> Vec<DotSeen> {
        let search_px = half_spacing_px(scene, shot).min(self.reach_px);
        let moved = drift.map_or([0.0; 2], |d| d.slab_mm);
        let look = |(&dot, bracket): (&[usize; 2], &Bracket)| {
            let nominal = scene.nominal_mm(dot);
            let expected = [nominal[0] + moved[0], nominal[1] + moved[1]];
            let reach = search_px + self.dots.shape.radius_px() + 2.0;
            let Some(picture) = around(scene, registration, bracket, expected, reach) else { return DotSeen::Dark };
            match self.dots.locate(expected, &picture, registration, search_px) {
                Some(found) => DotSeen::At { off_mm: found.moved_mm },
                None if is_dark(&picture) => DotSeen::Dark,
                None => DotSeen::Unclear,
            }
        };
        scene.dots(shot).iter().zip(windows).map(look).collect()
    }

    /// The radius around the middle of a row's window within which half of its light leaves, mm; 0 for no light.
    pub(super) fn half_light_mm(&self, row: &Row) -> f64 {
        let light = |k: usize| {
            let light: f32 = row.response[3 * k..3 * k + 3].iter().sum();
            f64::from(light).max(0.0)
        };
        let found = radius_of_half(self.cells.iter().map(|&(r, k)| (r, light(k))));
        // A cell's own light is spread over half its width.
        found.map_or(0.0, |r| r.max(0.5 * self.pitch_mm))
    }
}

/// The distance within which half of some light is, given (distance, light) from the nearest to the farthest; `None`
/// for none.
pub(super) fn radius_of_half(near: impl Iterator<Item = (f64, f64)> + Clone) -> Option<f64> {
    let half = 0.5 * near.clone().map(|(_, light)| light).sum::<f64>();
    let mut sum = 0.0;
    let mut near = near.filter(|_| half > 0.0);
    let found = near.find(|(_, light)| {
        sum += light;
        sum >= half
    });
    found.map(|(r, _)| r)
}

/// Whether no pixel is ten standard deviations above none.
fn is_dark(picture: &Radiance) -> bool {
    let variance = picture.luminance_variance();
    let used = picture.used.as_chunks::<3>().0;
    let lit = |((v, variance), used): ((f32, f32), &[u8; 3])| used.contains(&0) || v > 10.0 * variance.sqrt();
    !picture.luminance().into_iter().zip(variance).zip(used).any(lit)
}

/// What is to be told of all shots together.
///
/// # Errors
/// [`crate::Error::Contradiction`]; those of decoding.
pub(super) fn judge(scene: &Scene<'_>, results: &[ShotResult], options: &BuildOptions) -> Result<Vec<Warning>> {
    let mut warnings = Vec::new();
    let Some(common) = Common::of(scene, results) else { return Ok(warnings) };
    let ramp = common.ramp(scene, options)?;
    warnings.extend(other_patterns(scene, results, &common, options)?);
    // A step that is off puts all dots off.
    warnings.extend(match ramp {
        Some(ramp) => Some(ramp),
        None => common.offset(scene, results, options)?,
    });
    Ok(warnings)
}

/// Shots whose dots are not those of their pattern.
fn other_patterns(
    scene: &Scene<'_>,
    results: &[ShotResult],
    common: &Common,
    options: &BuildOptions,
) -> Result<Option<Warning>> {
    let lattice = scene.lattice();
    let step_mm = step_mm(scene);
    let mut wrong: Vec<usize> = Vec::new();
    // Without dots on the frame, drift is what the dots themselves say: a step of it is looked for.
    let on_frame = scene.capture.manifest.reference_dots.is_some();
    let mut before: Option<Point> = None;
    for (k, result) in results.iter().enumerate() {
        let drift = result.drift.map_or([0.0; 2], |d| d.slab_mm);
        let far = |seen: &DotSeen| match seen {
            DotSeen::At { off_mm } => {
                let left = common.left(*off_mm);
                let walked = before.filter(|_| !on_frame).map_or([0.0; 2], |b| [drift[0] - b[0], drift[1] - b[1]]);
                (left[0] + walked[0]).hypot(left[1] + walked[1]) > STEP_SHARE * step_mm
            }
            // Where nearly all dots are seen, one that is not is not there.
            DotSeen::Dark | DotSeen::Unclear => common.found > 0.8,
        };
        let off = result.seen.iter().filter(|s| far(s)).count();
        match 2 * off > result.seen.len() {
            true => wrong.push(k),
            false => before = result.drift.map(|d| d.slab_mm),
        }
    }
    let Some(&first) = wrong.first() else { return Ok(None) };
    let shows = shown(scene, results, common, &lattice, first);
    let looks = match &shows {
        Some(other) => format!("its dots are those of shot \"{other}\""),
        None => {
            let own = scene.photographs.merge_whole(lattice[first])?;
            let beside = if first > 0 { lattice[first - 1] } else { lattice[(first + 1).min(lattice.len() - 1)] };
            let expected = scene.photographs.merge_whole(beside)?;
            let same = "its dots are elsewhere";
            looks(scene.photographs, (lattice[first], None), &own, &expected, same)?.unwrap_or_else(|| same.into())
        }
    };
    let finding = ConsistencyWarning::OtherPattern {
        shot: scene.photographs.name(lattice[first]).to_owned(),
        looks,
        shots: wrong.len(),
        of: lattice.len(),
    };
    options.refuse(finding).map(Some)
}

/// The nearest shot whose pattern has all the dots that were seen in a shot.
fn shown(scene: &Scene<'_>, results: &[ShotResult], common: &Common, lattice: &[usize], k: usize) -> Option<String> {
    let near_mm = NEAR_STEP * step_mm(scene);
    let dots = results[k].seen.iter().zip(scene.dots(lattice[k]));
    let seen: Vec<Point> = dots
        .filter_map(|(seen, &dot)| match seen {
            DotSeen::At { off_mm } => {
                let (p, left) = (scene.nominal_mm(dot), common.left(*off_mm));
                Some([p[0] + left[0], p[1] + left[1]])
            }
            _ => None,
        })
        .collect();
    let has = |shot: usize, p: &Point| {
        let near = |&dot: &[usize; 2]| {
            let q = scene.nominal_mm(dot);
            (p[0] - q[0]).hypot(p[1] - q[1]) < near_mm
        };
        scene.dots(shot).iter().any(near)
    };
    let mut others: Vec<usize> = (0..lattice.len()).filter(|&j| j != k).collect();
    others.sort_by_key(|&j| j.abs_diff(k));
    let found = others.into_iter().find(|&j| !seen.is_empty() && seen.iter().all(|p| has(lattice[j], p)))?;
    Some(scene.photographs.name(lattice[found]).to_owned())
}

/// The smaller distance of neighbouring lit points, mm.
fn step_mm(scene: &Scene<'_>) -> f64 {
    scene.steps_mm().map(|[x, y]| x.hypot(y)).into_iter().fold(f64::INFINITY, f64::min)
}
