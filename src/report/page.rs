//! The page itself: sections in the order in which somebody asks.

use super::text::{bytes, escape, seconds, significant};
use super::{Comparison, Files, ReportInput, figures, maps, row_pictures};
use crate::progress::StageTime;
use crate::words::count;
use crate::{FactorWarning, FindingRecord, Result, Warning};
use std::fmt::Write;

/// Name, what it is, how its number is written.
type Measure = (&'static str, &'static str, fn(f64) -> String);

/// Measures that the page knows; others are shown by their names alone.
const MEASURES: [Measure; 19] = [
    ("rel_rmse", "relative error ‖R̂ − R‖ / ‖R‖", percent),
    ("psnr_db", "peak signal to noise over all entries and channels", decibel),
    ("log_rmse", "error of ln R above 10⁻⁴ of each row's peak: the tails", three),
    ("relit_psnr_db", "the same ratio for the slab under a fixed set of lights", decibel),
    ("coverage_2sigma", "entries within two standard deviations; 95.4 % is right", percent),
    ("coverage_2sigma_rows", "the rows' sums within two standard deviations", percent),
    ("coverage_2sigma_profile", "the same of the numbers of the mean row", percent),
    ("albedo_bias", "relative error of the mean albedo, R G B", percent),
    ("albedo_bias_sd", "standard deviation of that error as the matrix says it, R G B", percent),
    ("drift_rms_px", "difference of the shots' drift, camera px", length),
    ("position_rms_mm", "difference of the lit points' places, mm", length),
    ("position_rms_px", "the same in camera px", length),
    ("albedo_max", "largest albedo of a row, R G B; above 1 more leaves than arrives", three),
    ("albedo_mean", "mean albedo of the rows, R G B", three),
    ("albedo_violations", "rows with an albedo above 1", whole),
    ("reciprocity", "R(a,b) − R(b,a) over their mean, RMS", three),
    ("bytes_f32", "every stored number as four bytes", size),
    ("bytes_file", "on disk", size),
    ("entries", "numbers compared", whole),
];

/// Culprits of a finding that are named.
const NAMED: usize = 5;

/// The whole page; the pictures that it embeds are also put into `files`.
pub(super) fn html(input: &ReportInput, files: &mut Files) -> Result<String> {
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"><title>{} – acquire</title><style>\n{}{}</style></head><body>\n",
        escape(input.title),
        include_str!("chart.css"),
        include_str!("page.css")
    );
    head(&mut out, input);
    findings(&mut out, input);
    photograph(&mut out, input, files)?;
    drift(&mut out, input, files);
    if !input.survey.rows.is_empty() {
        out.push_str("<h2>Rows of the matrix</h2><p class=\"lead\">What leaves around a lit point: as measured, as the material gives it back, the difference of the two as a share of what was measured there, and over the standard deviation of the measurement (pure noise leaves no structure there, and few samples beyond 2 σ). Each kind of picture has one scale for all rows. In the cuts dots are measurements with two standard deviations, lines the material. Grey was not measured, or has no light.</p>");
        out.push_str(&row_pictures::section(input.matrix, &input.survey.rows, files)?);
        out.push_str("<h2>Over the slab</h2><p class=\"lead\">One cell per lit point.</p>");
        out.push_str(&maps::section(input.matrix, input.survey, files)?);
    }
    factorization(&mut out, input, files);
    measures(&mut out, input.comparisons);
    timings(&mut out, input);
    provenance(&mut out, input)?;
    out.push_str("</body></html>\n");
    Ok(out)
}

fn head(out: &mut String, input: &ReportInput) {
    let (m, material) = (input.matrix, input.material);
    let psnr = input.comparisons.first().and_then(|c| c.value("psnr_db"));
    let psnr = psnr.map(|v| format!(", {}", decibel(v))).unwrap_or_default();
    let _ = write!(
        out,
        "<header><p class=\"name\">{}</p><h1>R<sub>d</sub> of {}×{} points, {}×{} window; material {}{psnr}</h1></header><dl class=\"tiles\">",
        escape(input.title),
        m.points[0],
        m.points[1],
        m.window[0],
        m.window[1],
        bytes(material.bytes_file)
    );
    let mut tile = |name: &str, value: String, note: String| {
        let _ = write!(
            out,
            "<div><dt>{}</dt><dd>{}<small>{}</small></dd></div>",
            escape(name),
            escape(&value),
            escape(&note)
        );
    };
    for c in input.comparisons {
        if let Some(v) = c.value("rel_rmse") {
            tile("relative error", percent(v), c.title.clone());
        }
    }
    let degree = material.degree.map(|d| format!(", degree {d}")).unwrap_or_default();
    tile("model", material.model.clone(), format!("{}{degree}", count(material.terms, "term")));
    if let Some(coded) = material.bytes_coded {
        tile(
            "coded",
            bytes(coded),
            format!("1/{:.0} of {}", material.bytes_file as f64 / coded as f64, bytes(material.bytes_file)),
        );
    }
    let window_mm = [0, 1].map(|a| m.window[a] as f64 * m.pitch_mm);
    tile("window", extent_mm(window_mm, 3), format!("cells of {} mm", significant(m.pitch_mm, 3)));
    tile("lit points", extent_mm(m.lit_pitch_mm, 2), "apart".to_owned());
    let largest = m.shots.iter().map(|s| s.drift_px[0].hypot(s.drift_px[1])).fold(0.0, f64::max);
    tile("largest drift", format!("{largest:.2} px"), format!("over {}", count(m.shots.len(), "lattice shot")));
    tile("time", seconds(input.timings.iter().map(|t| t.secs).sum()), "all stages".to_owned());
    out.push_str("</dl>");
}

/// Findings, worst first, each with what it is put down to and what was done.
fn findings(out: &mut String, input: &ReportInput) {
    let of_matrix = input.matrix.warnings.iter().map(Warning::record);
    let mut all: Vec<_> = of_matrix.chain(input.warnings.iter().map(FactorWarning::record)).collect();
    if all.is_empty() {
        return;
    }
    all.sort_by_key(|finding| std::cmp::Reverse(finding.severity));
    let number = count(all.len(), "finding");
    let _ = write!(out, "<section class=\"warnings\"><b>{number} about this measurement</b><ul>");
    for FindingRecord { id, severity, seen, culprit, done, .. } in all {
        let culprit: Vec<String> = culprit.iter().take(NAMED).map(ToString::to_string).collect();
        let culprit = if culprit.is_empty() { String::new() } else { format!("; {}", culprit.join(", ")) };
        let _ = write!(
            out,
            "<li class=\"{0}\"><b>{0}</b>: {1} <small><code>{2}</code>{3}; {4}</small></li>",
            severity.name(),
            escape(&seen),
            escape(&id),
            escape(&culprit),
            done.name()
        );
    }
    out.push_str("</ul></section>");
}

fn photograph(out: &mut String, input: &ReportInput, files: &mut Files) -> Result<()> {
    let Some(overview) = input.overview else { return Ok(()) };
    let name = escape(&overview.shot);
    let _ = write!(
        out,
        "<h2>A shot and what was found in it</h2><p class=\"lead\">Shot “{name}”, its exposures merged, brightness on a logarithmic scale. At the right the surroundings of one window. Grid and reference dots are drawn where the registration puts them, the dots of this shot and their windows with its drift.</p><label class=\"toggle\"><input type=\"checkbox\" id=\"grid\" checked>show the recovered grid</label><div class=\"photos\">{}</div>",
        figures::shot(input, overview, files)?
    );
    out.push_str("<ul class=\"legend\"><li><i style=\"background:#8dff7a\"></i>lit points of the grid</li><li><i style=\"background:#ffe14d\"></i>dots of this shot</li><li><i style=\"background:#6fd3ff\"></i>their windows</li><li><i style=\"background:#ff7ad1\"></i>reference dots</li><li><i style=\"background:#fff;outline:1px solid #999\"></i>rim of the sample</li></ul>");
    let (img, legend) = figures::exposures(overview, files)?;
    let _ = write!(
        out,
        "<h2>Exposures that measured each pixel</h2><p class=\"lead\">Of the same shot: an exposure counts where it is neither saturated nor dead.</p><div class=\"exposures\">{img}{legend}</div>"
    );
    Ok(())
}

fn drift(out: &mut String, input: &ReportInput, files: &mut Files) {
    let shots = &input.matrix.shots;
    if shots.is_empty() {
        return;
    }
    let _ = write!(
        out,
        "<h2>Drift</h2><p class=\"lead\">How far the dots of each lattice shot lie from the registered pattern, in camera pixels; it is taken out of the matrix. Arrows: x right, y down as in the photographs, early shots pale. Bars: two standard deviations.</p><div class=\"third\"><figure>{}</figure><figure>{}<ul class=\"legend\"><li><i style=\"background:var(--accent)\"></i>x</li><li><i style=\"background:var(--second)\"></i>y</li></ul></figure></div><details><summary>Numbers</summary><table><tr><th>shot</th><th class=\"n\">x, px</th><th class=\"n\">y, px</th><th class=\"n\">standard deviation, px</th></tr>",
        figures::drift_compass(shots, files),
        figures::drift_series(shots, files)
    );
    for s in shots {
        let sd = s.drift_sd_px.map_or("not measured".to_owned(), |v| format!("{v:.4}"));
        let _ = write!(
            out,
            "<tr><td>{}</td><td class=\"n\">{:.4}</td><td class=\"n\">{:.4}</td><td class=\"n\">{sd}</td></tr>",
            escape(&s.name),
            s.drift_px[0],
            s.drift_px[1]
        );
    }
    out.push_str("</table></details>");
}

fn factorization(out: &mut String, input: &ReportInput, files: &mut Files) {
    let material = input.material;
    if material.levels.is_empty() {
        return;
    }
    let choice = material.choice.as_deref().map(|c| format!("<p class=\"lead\">{}</p>", escape(c))).unwrap_or_default();
    let _ = write!(
        out,
        "<h2>Singular values</h2>{choice}<figure class=\"single\">{}<ul class=\"legend\"><li><i style=\"background:var(--accent)\"></i>kept</li><li><i style=\"border:1.5px solid var(--soft);border-radius:50%\"></i>left out</li><li><i style=\"background:var(--second);height:3px;margin-bottom:3px\"></i>what noise alone would give in the same directions</li></ul></figure>",
        figures::singular_values(material, files)
    );
}

fn measures(out: &mut String, comparisons: &[Comparison]) {
    if comparisons.is_empty() {
        return;
    }
    out.push_str("<h2>Measures</h2><div class=\"scroll\"><table class=\"measures\"><tr><th>measure</th>");
    comparisons.iter().for_each(|c| {
        let _ = write!(out, "<th class=\"n\">{}</th>", escape(&c.title));
    });
    out.push_str("</tr>");
    let known = MEASURES.iter().map(|(name, what, format)| (*name, *what, *format));
    let unknown = comparisons.iter().flat_map(|c| c.values.keys()).filter(|k| MEASURES.iter().all(|m| m.0 != *k));
    let unknown: std::collections::BTreeSet<&str> = unknown.map(String::as_str).collect();
    for (name, what, format) in known.chain(unknown.into_iter().map(|n| (n, "", four as fn(f64) -> String))) {
        if comparisons.iter().all(|c| !c.values.contains_key(name)) {
            continue;
        }
        let _ = write!(out, "<tr><td><code>{}</code> <small>{what}</small></td>", escape(name));
        for c in comparisons {
            let value = |v: &f64| format!("<span>{}</span>", escape(&format(*v)));
            let values = c.values.get(name).map(|v| v.iter().map(value).collect::<Vec<_>>().join(" "));
            let _ = write!(out, "<td class=\"n\">{}</td>", values.unwrap_or_else(|| "–".to_owned()));
        }
        out.push_str("</tr>");
    }
    out.push_str("</table></div>");
}

fn timings(out: &mut String, input: &ReportInput) {
    let stages = whole_stages(input.timings);
    let longest = stages.iter().map(|t| t.secs).fold(0.0, f64::max);
    if longest <= 0.0 {
        return;
    }
    out.push_str("<h2>Time per stage</h2><table>");
    for t in &stages {
        let share = 100.0 * t.secs / longest;
        let _ = write!(
            out,
            "<tr><td>{}</td><td class=\"n\">{}</td><td class=\"time\"><i style=\"width:{share:.1}%\"></i></td></tr>",
            escape(&t.stage),
            seconds(t.secs)
        );
    }
    out.push_str("</table>");
}

/// Stages whose parts have names as `factor: terms` as one each, its parts in brackets.
fn whole_stages(timings: &[StageTime]) -> Vec<StageTime> {
    let mut whole: Vec<(StageTime, Vec<String>)> = Vec::new();
    for t in timings {
        let (name, part) = t.stage.split_once(": ").map_or((t.stage.as_str(), None), |(name, part)| (name, Some(part)));
        let part = part.map(|part| format!("{part} {}", seconds(t.secs)));
        match whole.iter_mut().find(|(stage, _)| stage.stage == name) {
            Some((stage, parts)) => {
                stage.secs += t.secs;
                parts.extend(part);
            }
            None => whole.push((StageTime { stage: name.to_owned(), secs: t.secs }, part.into_iter().collect())),
        }
    }
    let named = |(stage, parts): (StageTime, Vec<String>)| match parts.is_empty() {
        true => stage,
        false => StageTime { stage: format!("{} ({})", stage.stage, parts.join(", ")), secs: stage.secs },
    };
    whole.into_iter().map(named).collect()
}

fn provenance(out: &mut String, input: &ReportInput) -> Result<()> {
    let text = serde_json::to_string_pretty(&input.matrix.provenance).map_err(crate::Error::internal)?;
    let _ = write!(
        out,
        "<h2>Provenance</h2><p class=\"lead\">Written by acquire {}; how the matrix came to be, as it is kept in the matrix itself.</p><details><summary>Version, options, input hashes</summary><pre>{}</pre></details>",
        env!("CARGO_PKG_VERSION"),
        escape(&text)
    );
    Ok(())
}

/// Two lengths in mm, or one when they are the same to so many digits.
fn extent_mm(mm: [f64; 2], digits: usize) -> String {
    match mm.map(|v| significant(v, digits)) {
        [x, y] if x == y => format!("{x} mm"),
        [x, y] => format!("{x} × {y} mm"),
    }
}

fn percent(v: f64) -> String {
    format!("{} %", significant(100.0 * v, 3))
}

fn decibel(v: f64) -> String {
    format!("{v:.1} dB")
}

/// A length to four places: places are known to less than that.
fn length(v: f64) -> String {
    if v > 0.0 && v < 5e-5 { "< 0.0001".to_owned() } else { format!("{v:.4}") }
}

fn size(v: f64) -> String {
    bytes(v as u64)
}

fn whole(v: f64) -> String {
    format!("{v:.0}")
}

fn three(v: f64) -> String {
    significant(v, 3)
}

fn four(v: f64) -> String {
    significant(v, 4)
}
