//! Patterns: the pictures that a projector shows for a capture, the plan that tells `import` what to expect, and a page
//! for the person.
//!
//! With a quick probe capture the plan asks for no photograph that the scene does not require: see [`Probe`].

mod layout;
mod page;
mod picture;
mod plan;
mod probe;
mod spacing;

pub use layout::{gray_bits, lattice_shots};
pub use page::hours;
pub use picture::ProjectorPicture;
pub use plan::{PLAN_FILE, Plan, PlannedShot};
pub use probe::{Probe, ProbeChoice};
pub use spacing::{SpacingChoice, SpacingOptions, Tails, choose_spacing};

use crate::capture::{Rig, Window};
use crate::geometry::{Homography, Point};
use crate::output::NewFolder;
use crate::progress::Progress;
use crate::{Error, Result};
use layout::PlanLayout;
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Settings of [`patterns`].
#[derive(Debug, Clone)]
pub struct PatternsOptions {
    /// A name for people; it heads the report.
    pub name: Option<String>,
    /// Width and height of the sample, mm: 20 or 30x20 [default with `probe`: the probe's].
    pub slab_mm: Option<Point>,
    /// Projector pixels in a mm of the slab [default with `probe`: as registered].
    pub projector_px_per_mm: Option<f64>,
    /// Projector pixel that falls on the middle of the slab [default: the projector's middle; with `probe`: as
    /// registered].
    pub center_px: Option<Point>,
    /// Lit points: 32 or 40x30 [default: as many as `lit_pitch_mm` makes].
    pub grid: Option<[usize; 2]>,
    /// Distance of lit points, mm [default: `pitch_mm`].
    pub lit_pitch_mm: Option<f64>,
    /// Outgoing samples of a window along each axis, odd [default: 31; with `probe`: as far as the response reaches].
    pub window: Option<usize>,
    /// Side of an outgoing cell, mm [default: 0.5; with `probe`: the probe's].
    pub pitch_mm: Option<f64>,
    /// Side of a dot, projector pixels. 3: a dark pixel between neighbours four pixels apart.
    pub dot_px: usize,
    /// Distance of the dots of one shot, mm [default: one and a half windows; with `probe`: the smallest that the tails
    /// permit].
    pub spacing_mm: Option<f64>,
    /// Least distance of the lit points from the slab's rim, mm [default: half a window, or a quarter of the slab when
    /// that is less].
    pub margin_mm: Option<f64>,
    /// Width of the opaque frame, mm: the reference dots lie in its middle.
    pub frame_mm: f64,
    /// Narrowest stripes of the Gray code, projector pixels [default: 8; with `probe`: what is six camera pixels].
    pub narrowest_stripe_px: Option<usize>,
    /// Exposures of each lattice and each black shot [default: 5; with `probe`: as many as the response requires].
    pub exposures: Option<usize>,
    /// Stops between exposures.
    pub stops: f64,
    /// Shortest exposure of a lattice shot, s, as 0.004 or 1/250: the brightest dot must not saturate in it [default:
    /// 1/256; with `probe`: as measured].
    pub shortest_secs: Option<f64>,
    /// Shorter of the two exposures of board, white reference and Gray code, s [default: `shortest_secs`; with `probe`:
    /// the probe's].
    pub white_secs: Option<f64>,
    /// What the camera takes for a photograph besides its exposure, s, to tell the time.
    pub overhead_secs: f64,
    /// Share of a row's light that other dots' tails may add to it before `build-matrix` takes that out, with `probe`.
    pub most_cross_talk: f64,
}

impl Default for PatternsOptions {
    fn default() -> Self {
        Self {
            name: None,
            slab_mm: None,
            projector_px_per_mm: None,
            center_px: None,
            grid: None,
            lit_pitch_mm: None,
            window: None,
            pitch_mm: None,
            dot_px: 3,
            spacing_mm: None,
            margin_mm: None,
            frame_mm: 6.0,
            narrowest_stripe_px: None,
            exposures: None,
            stops: 2.0,
            shortest_secs: None,
            white_secs: None,
            overhead_secs: 1.5,
            most_cross_talk: SpacingOptions::default().most_cross_talk,
        }
    }
}

/// Window of a plan without a probe, samples: what the simulator's bench and the published measurements use.
const WINDOW: usize = 31;
/// Side of its cells, mm.
const PITCH_MM: f64 = 0.5;
/// Distance of the dots of one shot without a probe, windows: neighbours' tails are below a thousandth of the peak in
/// most materials.
const SPACING_WINDOWS: f64 = 1.5;
/// Stripes without a probe, projector px: where projector and camera have about the same pixels, edges are far enough
/// apart.
const NARROWEST_STRIPE_PX: usize = 8;
/// Exposures without a probe.
const EXPOSURES: usize = 5;
/// The shortest without a probe, s.
const SHORTEST_SECS: f64 = 1.0 / 256.0;
/// Exposures of white things: dark corners and squares need a longer one.
const WHITE_EXPOSURES: usize = 2;

/// What [`patterns`] wrote.
#[derive(Debug, Clone)]
pub struct Patterns {
    /// The plan.
    pub plan: Plan,
    /// The same without the probe, to compare; `None` without one.
    pub without_probe: Option<Plan>,
    /// What the probe chose.
    pub choice: Option<ProbeChoice>,
}

/// The plan for a rig, and for the material when a probe of it is given.
///
/// # Errors
/// [`Error::Setting`] for options out of range or that do not fit the projector, or one that is missing without a
/// probe.
pub fn plan(options: &PatternsOptions, rig: &Rig, probe: Option<&Probe>) -> Result<Patterns> {
    options.check()?;
    let choice = probe.map(|p| p.choose(options, rig)).transpose()?;
    let plan = layout(options, rig, probe, choice.as_ref())?.plan(options, rig)?;
    let without_probe = match probe {
        Some(_) => Some(layout(options, rig, probe, None)?.plan(options, rig)?),
        None => None,
    };
    for plan in [Some(&plan), without_probe.as_ref()].into_iter().flatten() {
        plan.check(Path::new(PLAN_FILE))?;
    }
    Ok(Patterns { plan, without_probe, choice })
}

fn layout(
    options: &PatternsOptions,
    rig: &Rig,
    probe: Option<&Probe>,
    choice: Option<&ProbeChoice>,
) -> Result<PlanLayout> {
    let missing = |setting, expected: &str| Error::Setting { setting, expected: expected.into(), found: "none".into() };
    let slab_mm = options.slab_mm.or(probe.map(|p| p.manifest.slab.size_mm));
    let slab_mm = slab_mm.ok_or_else(|| missing("slab_mm", "the sample's size, or a probe of it"))?;
    let pitch_mm = options.pitch_mm.or(probe.map(|p| p.manifest.window.pitch_mm)).unwrap_or(PITCH_MM);
    let samples = options.window.or(choice.map(|c| c.window)).unwrap_or(WINDOW);
    let projector_from_slab = match (options.projector_px_per_mm, probe) {
        (None, Some(probe)) => probe.projector_from_slab()?,
        (scale, _) => {
            let scale = scale.ok_or_else(|| missing("projector_px_per_mm", "a number, or a probe"))?;
            let middle = options.center_px.unwrap_or(rig.projector.size_px.map(|s| 0.5 * (s as f64 - 1.0)));
            let corner = std::array::from_fn(|a| middle[a] - 0.5 * scale * slab_mm[a]);
            Homography::similarity(scale, corner)
        }
    };
    let default_spacing = SPACING_WINDOWS * samples as f64 * pitch_mm;
    let shortest = options.shortest_secs.or(choice.and_then(|c| c.shortest_secs)).unwrap_or(SHORTEST_SECS);
    let exposures = options.exposures.or(choice.and_then(|c| c.exposures)).unwrap_or(EXPOSURES);
    let bracket = |shortest: f64, n: usize| (0..n).map(|k| shortest * (k as f64 * options.stops).exp2()).collect();
    let white_secs: Vec<f64> = match (options.white_secs, probe) {
        (None, Some(probe)) => probe.white_secs.clone(),
        (secs, _) => bracket(secs.unwrap_or(shortest), WHITE_EXPOSURES),
    };
    Ok(PlanLayout {
        slab_mm,
        projector_from_slab,
        window: Window { samples: [samples; 2], pitch_mm },
        spacing_mm: options.spacing_mm.or(choice.map(|c| c.spacing.spacing_mm)).unwrap_or(default_spacing),
        narrowest_stripe_px: options
            .narrowest_stripe_px
            .or(probe.map(Probe::narrowest_stripe_px))
            .unwrap_or(NARROWEST_STRIPE_PX),
        lattice_secs: bracket(shortest, exposures),
        white_secs,
    })
}

/// Writes the pictures, `plan.toml`, the rig and the page for the person into `out`; nothing appears there before all
/// is written.
///
/// # Errors
/// Those of [`plan`] and [`Rig::read`]; [`Error::Setting`] when `out` is in use (see `force`); [`Error::Io`].
pub fn patterns(
    options: &PatternsOptions,
    rig_path: &Path,
    probe: Option<&Probe>,
    out: &Path,
    force: bool,
    progress: &Progress,
) -> Result<Patterns> {
    let rig = Rig::read(rig_path)?;
    let written = plan(options, &rig, probe)?;
    let folder = NewFolder::create(out, force)?;
    let dir = folder.path();
    let make = |path: PathBuf| std::fs::create_dir(&path).map_err(Error::io("create", &path));
    make(dir.join("pictures"))?;
    make(dir.join("calibration"))?;
    Rig::copy(rig_path, &dir.join("calibration"))?;
    written.plan.write(&dir)?;
    let page = dir.join(page::PAGE_FILE);
    std::fs::write(&page, page::text(&written.plan, options.overhead_secs, out)).map_err(Error::io("write", &page))?;
    let layout = layout(options, &rig, probe, written.choice.as_ref())?;
    alignment(&layout, &written.plan, &rig).write(&dir.join("align.png"))?;

    let stage = progress.stage("pictures", written.plan.shots.len());
    written.plan.shots.par_iter().try_for_each(|shot| {
        let Some(picture) = &shot.picture else { return Ok(()) };
        ProjectorPicture::of(&written.plan, &shot.pattern, rig.projector.size_px).write(&dir.join(picture))?;
        stage.advance(1);
        Ok::<_, Error>(())
    })?;
    drop(stage);
    folder.finish()?;
    Ok(written)
}

/// The rims of slab and lit points as the projector sees them.
fn alignment(layout: &PlanLayout, plan: &Plan, rig: &Rig) -> ProjectorPicture {
    let [w, h] = layout.slab_mm;
    let slab = [[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]].map(|p| layout.projector_from_slab.map(p));
    let last = plan.grid.points.map(|n| n - 1);
    let lit = [[0, 0], [last[0], 0], last, [0, last[1]]].map(|d| plan.grid.dot_projector_px(d));
    let middle = layout.projector_from_slab.map([0.5 * w, 0.5 * h]);
    ProjectorPicture::alignment(&[slab, lit], middle, rig.projector.size_px)
}

impl PatternsOptions {
    /// Refuses values that make no patterns.
    ///
    /// # Errors
    /// [`Error::Setting`] naming the option as typed.
    pub fn check(&self) -> Result<()> {
        let range = |setting, value: Option<f64>, low: f64, high: f64| match value {
            Some(v) if !(v >= low && v <= high) => Err(Error::Setting {
                setting,
                expected: format!("{} to {}", crate::error::number(low), crate::error::number(high)),
                found: crate::error::number(v),
            }),
            _ => Ok(()),
        };
        for a in 0..2 {
            range("slab_mm", self.slab_mm.map(|s| s[a]), 1e-3, 1e6)?;
            range("center_px", self.center_px.map(|s| s[a]), -65_536.0, 65_536.0)?;
            range("grid", self.grid.map(|g| g[a] as f64), 1.0, 65_536.0)?;
        }
        range("projector_px_per_mm", self.projector_px_per_mm, 1e-3, 1e6)?;
        range("lit_pitch_mm", self.lit_pitch_mm, 1e-6, 1e6)?;
        range("window", self.window.map(|w| w as f64), 1.0, 4095.0)?;
        range("pitch_mm", self.pitch_mm, 1e-6, 1e6)?;
        range("dot_px", Some(self.dot_px as f64), 1.0, 1000.0)?;
        range("spacing_mm", self.spacing_mm, 1e-6, 1e6)?;
        range("margin_mm", self.margin_mm, 0.0, 1e6)?;
        range("frame_mm", Some(self.frame_mm), 1e-3, 1e6)?;
        range("narrowest_stripe_px", self.narrowest_stripe_px.map(|n| n as f64), 2.0, 65_536.0)?;
        range("exposures", self.exposures.map(|n| n as f64), 1.0, 20.0)?;
        range("stops", Some(self.stops), 0.33, 6.0)?;
        range("shortest_secs", self.shortest_secs, 1e-6, 1e3)?;
        range("white_secs", self.white_secs, 1e-6, 1e3)?;
        range("overhead_secs", Some(self.overhead_secs), 0.0, 1e4)?;
        range("most_cross_talk", Some(self.most_cross_talk), 1e-6, 1.0)?;
        if self.window.is_some_and(|w| w.is_multiple_of(2)) {
            let found = self.window.unwrap_or(0).to_string();
            return Err(Error::Setting { setting: "window", expected: "an odd number".into(), found });
        }
        Ok(())
    }
}
