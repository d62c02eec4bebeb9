//! The trade-off as a table for programs and as a page that opens offline.

use super::{PUBLISHED, TradePoint, Tradeoff};
use crate::evaluate::NoiseLevel;
use crate::material::{Model, Precision};
use crate::report::chart::{Chart, ChartAxis};
use crate::report::text::{bytes, escape, seconds, significant};
use crate::words::plain;
use std::fmt::Write;

/// One line per point, with a heading.
pub fn csv(t: &Tradeoff) -> String {
    let mut out = String::from(
        "model,backend,terms,degree,shared_maps,precision,secs,peak_bytes,bytes,bytes_file,rel_rmse,psnr_db,log_rmse,relit_psnr_db,pareto,default,recommended\n",
    );
    let count = |v: Option<usize>| v.map(|v| v.to_string()).unwrap_or_default();
    let number = |v: Option<f64>| v.map(|v| format!("{v:.6e}")).unwrap_or_default();
    for p in &t.measured {
        let _ = writeln!(
            out,
            "{},{},{},{},{},{},{:.4},{},{},{},{},{},{},{},{},{},{}",
            p.model,
            p.backend,
            p.terms,
            count(p.degree),
            count(p.shared_maps),
            p.precision,
            p.secs,
            p.peak_bytes.map(|b| b.to_string()).unwrap_or_default(),
            p.bytes,
            p.bytes_file,
            number(p.rel_rmse),
            number(p.psnr_db),
            number(p.log_rmse),
            number(p.relit_psnr_db),
            p.pareto,
            p.default,
            p.recommended
        );
    }
    out
}

/// A page with the plots of peaks, tails and time, the front, and the whole table.
pub fn html(t: &Tradeoff) -> String {
    let name = t.matrix.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let mut out = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"><title>{} – trade-off</title><style>\n{}{}{STYLE}</style></head><body>\n",
        escape(&name),
        include_str!("../report/chart.css"),
        include_str!("../report/page.css")
    );
    let part = match t.points_looked_at == t.points {
        true => String::new(),
        false => format!(
            " A quick look: {} × {} lit points from the middle, and bytes are theirs.",
            t.points_looked_at[0], t.points_looked_at[1]
        ),
    };
    let _ = write!(
        out,
        "<h1>What accuracy costs: {}</h1><p class=\"lead\">{} × {} lit points, {} × {} samples around each, {} of responses.{part} Every dot is a factorization that was run, saved, loaded and compared with the matrix.{} {LEGEND}</p>",
        escape(&name),
        t.points[0],
        t.points[1],
        t.window[0],
        t.window[1],
        bytes(t.matrix_bytes),
        marks_text(t)
    );
    out.push_str("<h2>Error against bytes</h2><p class=\"lead\">Down and left is better. The full line joins the front: nothing else that was run is both smaller and more accurate. Bytes are those of the numbers (bytes_f32, half of it for f16), of coded materials the whole file.</p>");
    let noise = |of: fn(&NoiseLevel) -> f64| t.noise.as_ref().map(of);
    out.push_str(&error_bytes(t, &ERROR, noise(|n| n.rel_rmse)));
    out.push_str("<h2>Tails against bytes</h2><p class=\"lead\">log_rmse: the error of ln R above 10⁻⁴ of each row's peak, which broad light shows. The same points and the same front; it need not fall along it, since coding spends its bits where most light is.</p>");
    out.push_str(&error_bytes(t, &TAILS, noise(|n| n.log_rmse)));
    let _ = write!(
        out,
        "<h2>Error against time</h2><p class=\"lead\">From the store on disk to the material, for coded ones with the coding; one plain read of the responses took {}.</p>",
        seconds(t.read_secs)
    );
    out.push_str(&error_time(t));
    out.push_str("<h2>The front</h2>");
    let mut front: Vec<&TradePoint> = t.measured.iter().filter(|p| p.pareto).collect();
    front.sort_by_key(|p| p.bytes);
    table(&mut out, &front);
    if !t.regression_conditions.is_empty() {
        out.push_str("<h2>Condition of the colour fits</h2><p class=\"lead\">Of the Legendre columns up to each degree, tucker with 15 terms: the median and the largest over sampled rows. Digits that a solution in this basis loses; the fit itself is made in polynomials orthonormal over each row.</p><div class=\"scroll\"><table><tr><th>degree</th>");
        (0..t.regression_conditions.len()).for_each(|p| out.push_str(&format!("<td>{p}</td>")));
        for (k, title) in ["median", "largest"].into_iter().enumerate() {
            let _ = write!(out, "</tr><tr><th>{title}</th>");
            t.regression_conditions.iter().for_each(|c| out.push_str(&format!("<td>{}</td>", significant(c[k], 2))));
        }
        out.push_str("</tr></table></div>");
    }
    out.push_str("<h2>Everything that was run</h2>");
    table(&mut out, &t.measured.iter().collect::<Vec<_>>());
    out.push_str("</body></html>\n");
    out
}

const STYLE: &str = "
.chart { max-width: 620px; width: 100%; }
.front { fill: none; stroke: currentColor; stroke-width: 1.2; opacity: .6; }
circle.joint { fill: var(--blue); stroke: var(--blue); } circle.tucker { fill: var(--red); stroke: var(--red); }
circle.peers2006 { fill: var(--green); stroke: var(--green); }
circle.f32 { stroke: none; } circle.f16 { fill-opacity: 0; stroke-width: 1.6; stroke-dasharray: 2 1.6; } circle.coded { fill-opacity: .25; stroke-width: 1.4; }
circle.ring { fill: none; stroke: var(--ink); stroke-width: 1.3; } circle.ring.recommended { stroke-width: 2.6; }
.key { font-weight: 600; } .key.joint { color: var(--blue); } .key.tucker { color: var(--red); } .key.peers2006 { color: var(--green); }
.scroll { overflow-x: auto; } .scroll table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.scroll td, .scroll th { padding: .15em .6em; text-align: right; white-space: nowrap; } .scroll th { font-weight: 600; }
.scroll td:first-child, .scroll th:first-child { text-align: left; } .scroll td small { display: block; padding-left: 1em; }
@media (max-width: 560px) { .scroll table { font-size: 12px; } .scroll td, .scroll th { padding: .15em .35em; } }
td:first-child::before { content: '● '; visibility: hidden; } tr.pareto td:first-child::before { visibility: visible; }
@media print { .scroll { overflow: visible; font-size: 8.5px; } .scroll td, .scroll th { padding: 1px 3px; } }
";

const LEGEND: &str = "<span class=\"key joint\">joint</span>, <span class=\"key tucker\">tucker</span>, <span class=\"key peers2006\">peers2006</span>; full dots are f32, pale ones coded, dashed circles f16.";

/// What rings and the dashed line are.
fn marks_text(t: &Tradeoff) -> String {
    let noise = t.noise.map_or_else(
        || " The matrix has no variance, so that no noise is drawn.".to_owned(),
        |n| {
            format!(
                " The dashed line is the matrix's own noise, by its variance: psnr_db {:.1}, rel_rmse {}, log_rmse {}. What lies below it differs from the matrix by less than another measurement would.",
                n.psnr_db,
                plain(n.rel_rmse, 2),
                plain(n.log_rmse, 2)
            )
        },
    );
    let recommended = match t.measured.iter().any(|p| p.recommended) {
        true => {
            " Thin rings: what the program makes when nothing is asked, plain and coded. Thick ring: recommended, the smallest whose rel_rmse and log_rmse are no more than those of the plain default and of the noise together (the root of the sum of squares)."
        }
        false => "",
    };
    noise + recommended
}

/// One measure over all points.
struct PlottedMeasure {
    name: &'static str,
    label: &'static str,
    of: fn(&TradePoint) -> Option<f64>,
}

const ERROR: PlottedMeasure =
    PlottedMeasure { name: "rel_rmse", label: "error against bytes of every material", of: |p| p.rel_rmse };
const TAILS: PlottedMeasure = PlottedMeasure {
    name: "log_rmse",
    label: "error of the tails against bytes of every material",
    of: |p| p.log_rmse,
};

fn class(p: &TradePoint) -> String {
    format!("{} {}", p.model, p.precision)
}

fn axis(values: impl Iterator<Item = f64> + Clone, title: &str) -> ChartAxis {
    let known = || values.clone().filter(|v| *v > 0.0);
    ChartAxis::decades(known().fold(f64::INFINITY, f64::min), known().fold(0.0, f64::max), title)
}

/// The points that have the measure, with its value.
fn plotted<'a>(t: &'a Tradeoff, of: &PlottedMeasure) -> Vec<(&'a TradePoint, f64)> {
    let value = of.of;
    t.measured.iter().filter_map(|p| Some((p, value(p).filter(|v| *v > 0.0)?))).collect()
}

fn error_bytes(t: &Tradeoff, measure: &PlottedMeasure, noise: Option<f64>) -> String {
    let points = plotted(t, measure);
    let y = axis(points.iter().map(|(_, v)| *v).chain(noise), measure.name);
    let mut chart = Chart::new(460.0, 380.0, axis(points.iter().map(|(p, _)| p.bytes as f64), "bytes"), y);
    let mut front: Vec<_> = points.iter().filter(|(p, _)| p.pareto).collect();
    front.sort_by_key(|(p, _)| p.bytes);
    let at = |(p, v): &(&TradePoint, f64)| (p.bytes as f64, *v);
    let mut lines = vec![front.into_iter().map(at).collect::<Vec<_>>()];
    chart.line(lines[0].iter().copied(), "front");
    for point in &points {
        chart.dots([at(point)], 3.5, &class(point.0));
    }
    let mut labels: Vec<_> = points.iter().filter_map(|point| Some((at(point), mark(point.0)?))).collect();
    // Other back ends give the same point.
    let published = points.iter().find(|(p, _)| is_published(p));
    labels.extend(published.map(|point| (at(point), "tucker, T 15, P 7".to_owned())));
    for point in points.iter().filter(|(p, _)| p.default || p.recommended) {
        let class = if point.0.recommended { "ring recommended" } else { "ring" };
        chart.dots([at(point)], 6.5, class);
    }
    if let Some(noise) = noise {
        let (low, high) = chart.x_range();
        lines.push(vec![(low, noise), (high, noise)]);
        chart.line(lines[1].iter().copied(), "noise");
        // Where files are small no point is so near to the matrix.
        labels.insert(0, ((low, noise), format!("noise, {}", plain(noise, 2))));
    }
    chart.labels(&labels, &points.iter().map(at).collect::<Vec<_>>(), &lines);
    chart.finish(measure.label)
}

/// What is written beside a point that stands out.
fn mark(p: &TradePoint) -> Option<String> {
    let stored = if p.precision == Precision::Coded { "coded" } else { "plain" };
    match (p.default, p.recommended) {
        (true, true) => Some(format!("default, {stored}: recommended")),
        (true, false) => Some(format!("default, {stored}")),
        (false, true) => Some("recommended".to_owned()),
        (false, false) => None,
    }
}

fn is_published(p: &TradePoint) -> bool {
    p.model == Model::Tucker && (p.terms, p.degree, p.precision) == (PUBLISHED.0, Some(PUBLISHED.1), Precision::F32)
}

fn error_time(t: &Tradeoff) -> String {
    let points = plotted(t, &ERROR);
    let (x, y) = (points.iter().map(|(p, _)| p.secs), points.iter().map(|(_, v)| *v));
    let mut chart = Chart::new(460.0, 380.0, axis(x, "seconds"), axis(y, ERROR.name));
    for (p, v) in &points {
        chart.dots([(p.secs, *v)], 3.5, &class(p));
    }
    chart.finish("error against time of every factorization")
}

fn table(out: &mut String, points: &[&TradePoint]) {
    out.push_str("<div class=\"scroll\"><table><tr><th>model</th><th>T</th><th>P</th><th>stored</th><th>bytes</th><th>rel_rmse</th><th>log_rmse</th><th>psnr</th><th>relit psnr</th><th>time</th><th>memory</th><th>maps</th><th>back end</th></tr>");
    let count = |v: Option<usize>| v.map(|v| v.to_string()).unwrap_or_default();
    let number = |v: Option<f64>, digits: usize| v.map(|v| format!("{v:.digits$}")).unwrap_or("–".into());
    for p in points {
        let _ = write!(out, "<tr{}><td>{}", if p.pareto { " class=\"pareto\"" } else { "" }, p.model);
        if let Some(mark) = mark(p) {
            let _ = write!(out, "<small>{mark}</small>");
        }
        for cell in [
            p.terms.to_string(),
            count(p.degree),
            p.precision.to_string(),
            bytes(p.bytes),
            number(p.rel_rmse, 5),
            number(p.log_rmse, 4),
            number(p.psnr_db, 2),
            number(p.relit_psnr_db, 2),
            seconds(p.secs),
            p.peak_bytes.map(bytes).unwrap_or_default(),
            count(p.shared_maps),
            p.backend.to_string(),
        ] {
            let _ = write!(out, "</td><td>{cell}");
        }
        out.push_str("</td></tr>");
    }
    out.push_str("</table></div>");
}
