//! The table that people read.

use super::{CheckReport, Severity, Topic};
use crate::FindingRecord;
use crate::warning::times;
use crate::words::count;

/// Findings of one topic that are listed; all are in the JSON.
const LISTED: usize = 5;

/// A line a topic: its state in a word, its figures, and what was found below it. `color` is for terminals.
pub fn table(report: &CheckReport, color: bool) -> String {
    let records: Vec<FindingRecord> = report.findings.iter().map(|f| report.record(f)).collect();
    let mut lines = Vec::new();
    for topic in Topic::ALL {
        let findings: Vec<&FindingRecord> = records.iter().filter(|f| f.topic == topic).collect();
        let figures = figures(report, topic);
        let worst = findings.iter().map(|f| f.severity).max();
        let state = match (worst, &figures) {
            (Some(Severity::Error), _) => paint("bad", "31", color),
            (Some(Severity::Warning), _) => paint("look", "33", color),
            (_, Ok(_)) => paint("good", "32", color),
            (_, Err(_)) => paint("-", "2", color),
        };
        let figures = figures.unwrap_or_else(str::to_owned);
        lines.push(format!("{:<13} {state} {figures}", topic.name()).trim_end().to_owned());
        lines.extend(findings.iter().take(LISTED).map(|f| format!("{:<18} {}", "", f.seen)));
        if findings.len() > LISTED {
            lines.push(format!("{:<18} … and {} more", "", findings.len() - LISTED));
        }
    }
    let (looked_at, all) = (report.figures.lattice_shots_looked_at, report.figures.lattice_shots);
    if looked_at < all {
        lines.push(format!(
            "{looked_at} of {} looked at: what only the others show is not found",
            count(all, "lattice shot")
        ));
    }
    lines.join("\n")
}

/// A word in a field of four.
fn paint(word: &str, code: &str, color: bool) -> String {
    let field = format!("{word:<4}");
    if color { format!("\x1b[{code}m{field}\x1b[0m") } else { field }
}

/// What was measured of a topic, or why nothing was.
fn figures(report: &CheckReport, topic: Topic) -> Result<String, &'static str> {
    const NOT_REACHED: &str = "not reached";
    let f = &report.figures;
    let read = if f.photographs > 0 { Ok(()) } else { Err(NOT_REACHED) };
    let mb = |bytes: u64| match bytes as f64 / 1e6 {
        mb if mb < 10.0 => format!("{mb:.1} MB"),
        mb if mb < 1e4 => format!("{mb:.0} MB"),
        mb => format!("{:.1} GB", mb / 1e3),
    };
    let known = |n: usize| match n {
        n if n == f.photographs => String::new(),
        n => format!(" (known of {n} of {})", count(f.photographs, "photograph")),
    };
    let figures = match topic {
        Topic::Files => {
            read?;
            let time = f.build_secs.map_or(String::new(), |s| format!(", built in about {}", duration(s)));
            let (photographs, matrix) = (mb(f.photograph_bytes), mb(f.matrix_bytes_most));
            let (n, shots) = (count(f.photographs, "photograph"), count(f.shots, "shot"));
            Some(format!("{n} of {shots}, {photographs}; the matrix: {matrix} at most{time}"))
        }
        Topic::Exposures => (!f.lattice_exposures_secs.is_empty())
            .then(|| format!("{} in the lattice shots", times(&f.lattice_exposures_secs))),
        Topic::Settings => {
            read?;
            let n = f.photographs_with_settings;
            if n == 0 {
                return Err("not known: no photograph's EXIF tells them");
            }
            Some(format!("ISO, aperture, focal length, white balance, mode{}", known(n)))
        }
        Topic::Order => {
            read?;
            let n = f.photographs_with_time;
            if n == 0 {
                return Err("not known: no photograph says when it was taken");
            }
            Some(format!("as in capture.toml by the camera's clock{}", known(n)))
        }
        Topic::Light => f.dark_share.map(|share| {
            format!(
                "{} looked at; {:.0} % of their windows black in the longest exposure, at most",
                count(f.dots_looked_at, "dot"),
                100.0 * share
            )
        }),
        Topic::Focus => f.psf_px.zip(f.sample_px).map(|(psf, sample)| {
            format!("the lens blurs by {psf:.2} px (standard deviation), an outgoing sample is {sample:.1} px wide")
        }),
        Topic::Registration => f.camera_rms_px.zip(f.projector_rms_px).map(|(camera, projector)| {
            format!("board RMS {camera:.3} px camera, Gray code RMS {projector:.3} px projector")
        }),
        Topic::Drift => f.drift_most_px.map(|px| {
            format!("{px:.2} px at most in {} of {}", f.lattice_shots_looked_at, count(f.lattice_shots, "lattice shot"))
        }),
        Topic::Dots => {
            read?;
            let [x, y] = f.points;
            Some(format!("{} of {x} × {y} points lit by {}", f.points_lit, count(f.lattice_shots, "lattice shot")))
        }
        // Not of a capture.
        Topic::Material | Topic::Relighting | Topic::Simulation | Topic::Arrays => None,
    };
    figures.ok_or(NOT_REACHED)
}

/// Seconds as people read them.
fn duration(secs: f64) -> String {
    match secs {
        s if s < 10.0 => format!("{s:.1} s"),
        s if s < 120.0 => format!("{s:.0} s"),
        s if s < 7200.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}
