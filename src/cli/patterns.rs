use super::{Context, options};
use crate::Result;
use crate::capture::Rig;
use crate::patterns::{Patterns, PatternsOptions, Plan, Probe, hours, patterns};
use crate::pipeline::BuildOptions;
use crate::words::count;
use std::path::PathBuf;

/// Write the projector's pictures for a capture, and the plan by which its photographs are sorted.
///
/// White, black, Gray code with inverses for both axes, and the sweep of dots with the reference dots on the frame, as
/// PNG of the projector's size, numbered in the order of shooting; plan.toml for `acquire import`; how-to-shoot.txt to
/// lay beside the camera. With --probe, a quick capture of a few single dots, window, spacing and exposures are those
/// that the material requires.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Examples:
  acquire patterns --rig calibration/ --slab-mm 30 --projector-px-per-mm 12 --out plan
  acquire patterns --rig calibration/ --slab-mm 40x30 --projector-px-per-mm 12 --grid 48x32 --window 21 --shortest-secs 1/60 --out plan
  acquire patterns --rig calibration/ --slab-mm 30 --projector-px-per-mm 12 --grid 2 --spacing-mm 10 --out probe-plan
  acquire patterns --rig calibration/ --probe captures/probe --out plan

The third makes the patterns of a probe: four dots, one a shot.")]
pub(super) struct Args {
    /// Folder of rig.toml.
    #[arg(long, value_name = "DIR", value_parser = super::things::folder_of("rig.toml"))]
    rig: PathBuf,
    /// A quick capture of the same sample on the same rig: a few lattice shots of single dots.
    #[arg(long, value_name = "CAPTURE", value_parser = super::things::folder_of("capture.toml"))]
    probe: Option<PathBuf>,
    #[command(flatten)]
    options: options::Patterns,
    /// The folder to make.
    #[arg(long, short, value_name = "DIR")]
    out: PathBuf,
    /// Replace earlier patterns there.
    #[arg(long)]
    force: bool,
}

pub(super) fn run(args: Args, context: &Context) -> Result<()> {
    let options = PatternsOptions::from(args.options);
    options.check()?;
    let inputs: Vec<_> = [Some(args.rig.as_path()), args.probe.as_deref()].into_iter().flatten().collect();
    super::check_folder("out", &args.out, &inputs, false)?;
    let rig_path = Rig::find(&args.rig, Some(&args.rig))?;
    let probe = match &args.probe {
        Some(dir) => {
            // The probe is built with the defaults of every other setting.
            #[allow(clippy::needless_update)]
            let build = BuildOptions { calibration: Some(args.rig.clone()), ..BuildOptions::default() };
            Some(Probe::read(dir, &build, &context.progress)?)
        }
        None => None,
    };
    let written = patterns(&options, &rig_path, probe.as_ref(), &args.out, args.force, &context.progress)?;
    if let Some(line) = chosen(&written) {
        context.done(line);
    }
    let plan = &written.plan;
    let cost = |plan: &Plan| {
        format!(
            "{}, about {}",
            count(plan.photographs(), "photograph"),
            hours(plan.shooting_secs(options.overhead_secs))
        )
    };
    let instead =
        written.without_probe.as_ref().map_or(String::new(), |p| format!(" (without the probe: {})", cost(p)));
    context.done(format_args!(
        "{}: {} × {} points, {}, {}{instead}; next: {}",
        args.out.display(),
        plan.grid.points[0],
        plan.grid.points[1],
        count(plan.shots.len(), "picture"),
        cost(plan),
        args.out.join("how-to-shoot.txt").display(),
    ));
    Ok(())
}

/// What the probe chose, and how.
fn chosen(written: &Patterns) -> Option<String> {
    let (choice, plan) = (written.choice.as_ref()?, &written.plan);
    let s = &choice.spacing;
    let why = if s.below_noise { "below the noise" } else { "within --most-cross-talk" };
    let rim = if choice.window_measured { "" } else { ", further than the probe saw" };
    let bracket = plan.shots.last().map_or(&[][..], |s| &s.exposures_secs);
    let times: Vec<String> = bracket.iter().map(|t| format!("{t:.4}")).collect();
    Some(format!(
        "window {} ({:.1} mm{rim}); dots {:.1} mm apart: other dots add {:.2} % of a row's light ({why}; tails measured to {:.1} mm, an exponential beyond); exposures {} s",
        choice.window,
        choice.window as f64 * plan.window.pitch_mm,
        s.spacing_mm,
        100.0 * s.cross_talk,
        s.measured_mm,
        times.join(" "),
    ))
}
