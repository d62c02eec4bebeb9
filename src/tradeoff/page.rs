//! The trade-off as a table for programs and as a page that opens offline.

use super::{TradePoint, Tradeoff};
use crate::material::{Model, Precision};
use crate::report::chart::{Chart, ChartAxis};
use crate::report::text::{bytes, escape, seconds};
use std::fmt::Write;

/// One line per point, with a heading.
pub fn csv(t: &Tradeoff) -> String {
    let mut out = String::from(
        "model,backend,terms,degree,shared_maps,precision,secs,peak_bytes,bytes,bytes_file,rel_rmse,psnr_db,log_rmse,relit_psnr_db,pareto\n",
    );
    let count = |v: Option<usize>| v.map(|v| v.to_string()).unwrap_or_default();
    let number = |v: Option<f64>| v.map(|v| format!("{v:.6e}")).unwrap_or_default();
    for p in &t.measured {
        let _ = writeln!(
            out,
            "{},{},{},{},{},{},{:.4},{},{},{},{},{},{},{},{}",
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
            p.pareto
        );
    }
    out
}

/// A page with the plots error–bytes and error–time, the front, and the whole table.
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
        "<h1>What accuracy costs: {}</h1><p class=\"lead\">{} × {} lit points, {} × {} samples around each, {} of responses.{part} Every dot is a factorization that was run, saved, loaded and compared with the matrix. {LEGEND}</p>",
        escape(&name),
        t.points[0],
        t.points[1],
        t.window[0],
        t.window[1],
        bytes(t.matrix_bytes),
    );
    out.push_str("<h2>Error against bytes</h2><p class=\"lead\">Down and left is better. The line joins the front: nothing else that was run is both smaller and more accurate. Bytes are those of the numbers (bytes_f32, half of it for f16), of coded materials the whole file.</p>");
    out.push_str(&error_bytes(t));
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
            t.regression_conditions.iter().for_each(|c| out.push_str(&format!("<td>{:.1e}</td>", c[k])));
        }
        out.push_str("</tr></table></div>");
    }
    out.push_str("<h2>Everything that was run</h2>");
    table(&mut out, &t.measured.iter().collect::<Vec<_>>());
    out.push_str("</body></html>\n");
    out
}

const STYLE: &str = "
.chart { max-width: 860px; width: 100%; }
.front { fill: none; stroke: currentColor; stroke-width: 1.2; opacity: .6; }
circle.joint { fill: var(--blue); stroke: var(--blue); } circle.tucker { fill: var(--red); stroke: var(--red); }
circle.peers2006 { fill: var(--green); stroke: var(--green); }
circle.f32 { stroke: none; } circle.f16 { fill-opacity: 0; stroke-width: 1.6; stroke-dasharray: 2 1.6; } circle.coded { fill-opacity: .25; stroke-width: 1.4; }
.key { font-weight: 600; } .key.joint { color: var(--blue); } .key.tucker { color: var(--red); } .key.peers2006 { color: var(--green); }
.scroll { overflow-x: auto; } .scroll table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
.scroll td, .scroll th { padding: .15em .6em; text-align: right; white-space: nowrap; } .scroll th { font-weight: 600; }
.scroll td:first-child, .scroll th:first-child { text-align: left; }
td:first-child::before { content: '● '; visibility: hidden; } tr.pareto td:first-child::before { visibility: visible; }
";

const LEGEND: &str = "<span class=\"key joint\">joint</span>, <span class=\"key tucker\">tucker</span>, <span class=\"key peers2006\">peers2006</span>; full dots are f32, pale ones coded, dashed circles f16.";

fn error(p: &TradePoint) -> f64 {
    p.rel_rmse.unwrap_or(0.0)
}

fn class(p: &TradePoint) -> String {
    format!("{} {}", p.model, p.precision)
}

fn axis(points: &[TradePoint], value: impl Fn(&TradePoint) -> f64, title: &str) -> ChartAxis {
    let values = || points.iter().map(&value).filter(|v| *v > 0.0);
    ChartAxis::decades(values().fold(f64::INFINITY, f64::min), values().fold(0.0, f64::max), title)
}

fn error_bytes(t: &Tradeoff) -> String {
    let x = axis(&t.measured, |p| p.bytes as f64, "bytes");
    let mut chart = Chart::new(860.0, 460.0, x, axis(&t.measured, error, "rel_rmse"));
    let mut front: Vec<&TradePoint> = t.measured.iter().filter(|p| p.pareto && error(p) > 0.0).collect();
    front.sort_by_key(|p| p.bytes);
    chart.line(front.iter().map(|p| (p.bytes as f64, error(p))), "front");
    for p in t.measured.iter().filter(|p| error(p) > 0.0) {
        chart.dots([(p.bytes as f64, error(p))], 4.0, &class(p));
    }
    let published =
        |p: &&TradePoint| p.model == Model::Tucker && (p.terms, p.degree, p.precision) == (15, Some(7), Precision::F32);
    if let Some(p) = t.measured.iter().find(published) {
        chart.text((p.bytes as f64, error(p)), [8.0, -8.0], "start", "tucker, T = 15, P = 7");
    }
    chart.finish("error against bytes of every material")
}

fn error_time(t: &Tradeoff) -> String {
    let x = axis(&t.measured, |p| p.secs, "seconds");
    let mut chart = Chart::new(860.0, 460.0, x, axis(&t.measured, error, "rel_rmse"));
    for p in t.measured.iter().filter(|p| error(p) > 0.0) {
        chart.dots([(p.secs, error(p))], 4.0, &class(p));
    }
    chart.finish("error against time of every factorization")
}

fn table(out: &mut String, points: &[&TradePoint]) {
    out.push_str("<div class=\"scroll\"><table><tr><th>model</th><th>back end</th><th>T</th><th>P</th><th>maps</th><th>stored as</th><th>bytes</th><th>rel_rmse</th><th>psnr</th><th>log_rmse</th><th>relit psnr</th><th>time</th><th>memory</th></tr>");
    let count = |v: Option<usize>| v.map(|v| v.to_string()).unwrap_or_default();
    let number = |v: Option<f64>, digits: usize| v.map(|v| format!("{v:.digits$}")).unwrap_or("–".into());
    for p in points {
        let _ = write!(
            out,
            "<tr{}><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td></tr>",
            if p.pareto { " class=\"pareto\"" } else { "" },
            p.model,
            p.backend,
            p.terms,
            count(p.degree),
            count(p.shared_maps),
            p.precision,
            bytes(p.bytes),
            number(p.rel_rmse, 5),
            number(p.psnr_db, 2),
            number(p.log_rmse, 4),
            number(p.relit_psnr_db, 2),
            seconds(p.secs),
            p.peak_bytes.map(bytes).unwrap_or_default()
        );
    }
    out.push_str("</table></div>");
}
