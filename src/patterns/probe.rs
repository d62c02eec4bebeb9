//! What a quick capture of a few single dots tells about the capture that is to come.

use super::{PatternsOptions, SpacingChoice, SpacingOptions, Tails, choose_spacing};
use crate::capture::{Capture, Manifest, Pattern, Rig};
use crate::geometry::{Homography, Point};
use crate::output::ScratchFolder;
use crate::pipeline::{BuildOptions, BuildReport, build_matrix};
use crate::progress::Progress;
use crate::registration::Registration;
use crate::transport::MatrixReader;
use crate::{Error, ResponseWarning, Result, Warning};
use std::path::Path;

/// A probe capture, measured.
#[derive(Debug, Clone)]
pub struct Probe {
    /// Its manifest: slab, window, dots.
    pub manifest: Manifest,
    /// Where slab and projector are.
    pub registration: Registration,
    /// How its rows fall.
    pub tails: Tails,
    /// Exposures of its white reference, s, shortest first.
    pub white_secs: Vec<f64>,
    /// The brightest pixel of any dot, DN/s.
    peak_dn_per_sec: f64,
    /// Largest linear code value that counts, DN.
    range_dn: f64,
    /// Noise of no light, DN.
    read_dn: f64,
}

/// What the probe chose.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ProbeChoice {
    /// How near dots may be.
    pub spacing: SpacingChoice,
    /// Samples of the window along each axis.
    pub window: usize,
    /// Whether the window's rim was seen by the probe (else it is where the continued tail puts it).
    pub window_measured: bool,
    /// Shortest exposure of the lattice shots, s; `None` when it was given.
    pub shortest_secs: Option<f64>,
    /// Exposures of them; `None` when given.
    pub exposures: Option<usize>,
}

/// A window ends where the response is below this share of its peak.
const WINDOW_SHARE: f64 = 1e-4;
/// The brightest pixel reaches this share of the range in the shortest exposure: the other dots may be a little
/// brighter.
const BRIGHTEST: f64 = 0.7;
/// A pixel at the window's rim reaches so many times the read noise in the longest exposure; a sample is a mean of
/// several.
const RIM_SIGMA: f64 = 3.0;
/// An edge of a stripe is placed from two pixels before it and three after: nearer edges disturb each other, camera px.
const STRIPE_CAMERA_PX: f64 = 6.0;
/// More exposures gain nothing that the first and the last do not have.
const MOST_EXPOSURES: usize = 8;

impl Probe {
    /// Builds the matrix of the capture in `dir` in a temporary place and reads what the plan needs.
    ///
    /// # Errors
    /// Those of [`build_matrix`]; [`Error::Field`] when dots of one shot are so near that they light each other's
    /// windows, or no row was measured.
    pub fn read(dir: &Path, options: &BuildOptions, progress: &Progress) -> Result<Self> {
        let temporary = std::env::temp_dir();
        let scratch = ScratchFolder::new(&temporary, &temporary)?;
        let store = scratch.path().join("probe.rd.zarr");
        let report = build_matrix(dir, options, &store, progress)?;
        let capture = Capture::open(dir, options.calibration.as_deref())?;
        let refuse = |field: &str, expected: &str, found: String| {
            Err(Error::field(capture.manifest_path(), field, expected, found))
        };
        if let Some(near) =
            report.warnings.iter().find(|w| matches!(w, Warning::Response(ResponseWarning::CrossTalk { .. })))
        {
            return refuse("shots: dots", "a probe whose dots do not light each other's windows", near.to_string());
        }
        let matrix = MatrixReader::open(&store)?;
        let header = matrix.header();
        let block = matrix.read(0..header.rows())?;
        let lit = || (0..header.rows()).filter(|&k| header.shot_of[k].is_some());
        let Some(tails) = Tails::of(lit().map(|k| block.view(k)), header.window, header.pitch_mm) else {
            return refuse("shots: dots", "at least one measured row", "none".into());
        };
        let peaks: Vec<([usize; 2], f64)> = lit()
            .map(|k| {
                let peak = block.view(k).response.iter().fold(0.0f32, |a, &b| a.max(b));
                ([k % header.points[0], k / header.points[0]], f64::from(peak))
            })
            .collect();
        let noise = &report.noise;
        let read = noise.gain_dn_per_electron * noise.read_noise_electrons;
        let white = capture.shots(|p| matches!(p, Pattern::ReferenceWhite));
        Ok(Self {
            white_secs: white.iter().flat_map(|&s| &capture.brackets[s]).map(|p| p.exposure_secs).collect(),
            peak_dn_per_sec: brightest(&capture, &report, &peaks),
            range_dn: noise.saturation_dn - noise.black_dn,
            read_dn: (read * read + 1.0 / 12.0).sqrt(),
            manifest: capture.manifest,
            registration: report.registration,
            tails,
        })
    }

    /// Slab mm to projector px.
    ///
    /// # Errors
    /// [`Error::Internal`]: a registration can be inverted.
    pub fn projector_from_slab(&self) -> Result<Homography> {
        // A projector's lens bends by less than what slab and frame leave around the dots.
        let inverse = self.registration.slab_from_projector.homography().inverse();
        inverse.ok_or_else(|| Error::internal("the probe's registration cannot be inverted"))
    }

    /// Narrowest stripes whose edges the registration can place, projector px.
    pub(super) fn narrowest_stripe_px(&self) -> usize {
        let r = &self.registration;
        let projector_px_per_mm = self.projector_from_slab().map_or(1.0, |h| h.area_scale(r.center_mm).sqrt());
        (STRIPE_CAMERA_PX * projector_px_per_mm / r.px_per_mm() - 1e-6).ceil().clamp(2.0, 65_536.0) as usize
    }

    /// Spacing, window and exposures for this material.
    ///
    /// # Errors
    /// [`Error::Setting`] when the response reaches further than any spacing could keep apart.
    pub fn choose(&self, options: &PatternsOptions, rig: &Rig) -> Result<ProbeChoice> {
        let too_far = |found: &str| {
            Error::Setting {
            setting: "probe",
            expected:
                "a response that falls off within its window; give window and spacing_mm, or a probe with a wider window"
                    .into(),
            found: found.into(),
        }
        };
        let pitch_mm = options.pitch_mm.unwrap_or(self.manifest.window.pitch_mm);
        let (reach, seen) = self.tails.reach_mm(WINDOW_SHARE).ok_or_else(|| too_far("one that does not fall off"))?;
        let window = options.window.unwrap_or(2 * (reach / pitch_mm).ceil() as usize + 1);
        let scale = self.projector_from_slab()?.area_scale(self.registration.center_mm).sqrt();
        let lit_pitch_mm = options.lit_pitch_mm.unwrap_or(pitch_mm);
        let lit_pitch_mm = match options.grid {
            Some(_) => {
                let layout = super::layout(options, rig, Some(self), None)?;
                layout.grid(options)?.step_projector_px[0] / scale
            }
            None => (lit_pitch_mm * scale).round().max(1.0) / scale,
        };
        let spacing_options = SpacingOptions { window, lit_pitch_mm, most_cross_talk: options.most_cross_talk };
        let spacing = choose_spacing(&self.tails, &spacing_options)
            .ok_or_else(|| too_far("tails that no spacing keeps apart"))?;
        let shortest = options.shortest_secs.unwrap_or_else(|| self.shortest_secs(options));
        Ok(ProbeChoice {
            spacing,
            window,
            window_measured: seen || options.window.is_some(),
            shortest_secs: options.shortest_secs.is_none().then_some(shortest),
            exposures: options.exposures.is_none().then(|| self.exposures(shortest, options.stops, reach)),
        })
    }

    /// The time in which the brightest pixel reaches [`BRIGHTEST`], in whole thirds of a stop below it.
    fn shortest_secs(&self, options: &PatternsOptions) -> f64 {
        // Larger dots bring more light; on a diffusing sample their peak grows no faster than that.
        let dots = (options.dot_px as f64).powi(2) / self.manifest.grid.dot_area_px2();
        let secs = BRIGHTEST * self.range_dn / (self.peak_dn_per_sec * dots.max(1.0));
        ((3.0 * secs.log2()).floor() / 3.0).exp2()
    }

    fn exposures(&self, shortest_secs: f64, stops: f64, reach_mm: f64) -> usize {
        let mean = |r: f64| (0..3).map(|c| self.tails.mean_at(r, c)).sum::<f64>();
        let peak = (0..3).map(|c| self.tails.largest_at(0.0, c)).fold(0.0, f64::max);
        // A pixel is a small sample: response and radiance fall alike.
        let rim_dn_per_sec = self.peak_dn_per_sec * mean(reach_mm) / 3.0 / peak;
        let longest_secs = RIM_SIGMA * self.read_dn / rim_dn_per_sec;
        let more = ((longest_secs / shortest_secs).log2() / stops).ceil();
        if more.is_finite() { (more.max(0.0) as usize + 1).min(MOST_EXPOSURES) } else { MOST_EXPOSURES }
    }
}

/// The brightest pixel of any dot, DN/s: that of the overview's shot, times how much brighter the brightest row is.
fn brightest(capture: &Capture, report: &BuildReport, peaks: &[([usize; 2], f64)]) -> f64 {
    let overview = &report.overview;
    let shown = capture.manifest.shots.iter().find(|s| s.name == overview.shot);
    let dots = match shown.map(|s| &s.pattern) {
        Some(Pattern::Lattice { dots }) => dots.as_slice(),
        _ => &[],
    };
    let near = |at: &Point| {
        let rect = overview.radiance.rect;
        let range = |v: f64, n: usize| {
            let middle = v.round().clamp(0.0, n as f64 - 1.0) as usize;
            middle.saturating_sub(2)..=(middle + 2).min(n - 1)
        };
        let pixels = range(at[1], rect.height).flat_map(|y| range(at[0], rect.width).map(move |x| (x, y)));
        let values = pixels.flat_map(|(x, y)| {
            let k = overview.radiance.at(x, y);
            overview.radiance.value[k..k + 3].to_vec()
        });
        f64::from(values.fold(0.0f32, f32::max))
    };
    let largest = |v: &mut dyn Iterator<Item = f64>| v.fold(0.0, f64::max);
    let seen = largest(&mut overview.lit_px.iter().map(near));
    let of_shown = largest(&mut peaks.iter().filter(|(dot, _)| dots.contains(dot)).map(|p| p.1));
    let of_all = largest(&mut peaks.iter().map(|p| p.1));
    if of_shown > 0.0 { seen * of_all / of_shown } else { seen }
}
