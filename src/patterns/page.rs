//! The page that lies beside the camera while the capture is shot.

use super::Plan;
use crate::capture::{Pattern, Surface};
use std::fmt::Write;
use std::path::Path;

/// Its name in the plan's folder.
pub(super) const PAGE_FILE: &str = "how-to-shoot.txt";

const BEFORE: &str = "\
Before the first photograph
  - Sample in its opaque, matt frame, both surfaces in one plane. Room dark, projector warm, crossed polarisers.
  - Show align.png: the outer outline must fall on the sample's rim, the inner one is where dots will be. Move the sample or the
    projector until it does; if the outline has the wrong size, correct projector_px_per_mm and make the patterns again.
  - Focus projector and camera on the sample's surface. From now on nothing may move but what is said here.
  - Camera: manual exposure, fixed ISO, aperture, focus and white balance, every correction off, RAW if it has it, clock on.
  - Show the pictures pixel for pixel on the whole projector, in the order of their numbers; take every exposure of a picture
    before the next picture.
";

/// What to put in front of the camera, which pictures to show, how to expose: step by step.
pub(super) fn text(plan: &Plan, overhead_secs: f64, folder: &Path) -> String {
    let mut out = String::new();
    let photographs = plan.photographs();
    // Writing to a String cannot fail.
    let _ = writeln!(
        out,
        "{}: {photographs} photographs of {} pictures, about {}\n",
        plan.name,
        plan.shots.len(),
        hours(plan.shooting_secs(overhead_secs))
    );
    out.push_str(BEFORE);
    for (number, step) in steps(plan).into_iter().enumerate() {
        let (first, last) = (step.first, step.last);
        let pictures =
            if first == last { format!("picture {first:04}") } else { format!("pictures {first:04} to {last:04}") };
        let _ = writeln!(out, "\n{}. {}", number + 1, step.object);
        let _ = writeln!(out, "   {pictures}: {}", step.what);
        let times: Vec<String> = step.secs.iter().map(|&t| time(t)).collect();
        let _ = writeln!(out, "   {} exposures each, in this order: {} s", step.secs.len(), times.join(", "));
    }
    let _ = writeln!(
        out,
        "\nThe camera's nearest times will do (1/30 for 1/32). Afterwards:\n  acquire import FOLDER-OF-PHOTOGRAPHS --plan {} --out captures/NAME\n  acquire check captures/NAME",
        folder.display()
    );
    out
}

struct Step {
    first: usize,
    last: usize,
    object: &'static str,
    what: &'static str,
    secs: Vec<f64>,
}

/// Consecutive shots with the same thing before the camera and the same exposures are one step.
fn steps(plan: &Plan) -> Vec<Step> {
    let mut steps: Vec<Step> = Vec::new();
    for (k, shot) in plan.shots.iter().enumerate() {
        let (object, what) = match shot.pattern {
            Pattern::Board => ("The printed chessboard in the sample's plane", "white"),
            Pattern::ReferenceWhite => ("The white reference in the sample's plane, covering it", "white"),
            Pattern::ReferenceBlack => ("The white reference stays", "black"),
            Pattern::CalibrationBoard => ("The printed chessboard, anywhere in view, tilted", "white"),
            Pattern::Frame => ("The sample in its frame", "white"),
            Pattern::GrayCode { on: Surface::WhiteReference, .. } => ("The white reference stays", "stripes"),
            Pattern::GrayCode { on: Surface::Frame, .. } => ("The sample in its frame", "stripes"),
            Pattern::SampleBlack => ("The sample in its frame", "black"),
            Pattern::Lattice { .. } => ("The sample stays", "dots"),
            Pattern::Dark => ("The lens is covered", "black"),
        };
        match steps.last_mut() {
            Some(s) if s.object == object && s.what == what && s.secs == shot.exposures_secs => s.last = k + 1,
            _ => steps.push(Step { first: k + 1, last: k + 1, object, what, secs: shot.exposures_secs.clone() }),
        }
    }
    steps
}

fn time(secs: f64) -> String {
    if secs < 0.3 { format!("1/{:.0}", 1.0 / secs) } else { format!("{}", (secs * 100.0).round() / 100.0) }
}

/// A duration as people read it.
pub fn hours(secs: f64) -> String {
    let minutes = (secs / 60.0).round() as u64;
    match minutes {
        0..60 => format!("{} min", minutes.max(1)),
        _ => format!("{} h {:02} min", minutes / 60, minutes % 60),
    }
}
