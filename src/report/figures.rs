//! The figures about the measurement: the shot with its grid, exposures, drift, singular values.

use super::chart::{Chart, ChartAxis, nice_below};
use super::color;
use super::picture::{SrgbPicture, data_url, reduction};
use super::text::{escape, significant};
use super::{Files, MaterialSummary, ReportInput};
use crate::capture::Rect;
use crate::geometry::Point;
use crate::pipeline::Overview;
use crate::transport::ShotRecord;
use crate::{Error, Result};
use std::fmt::Write;

/// The longer side of an embedded photograph, px: enough to see single dots, small enough to send.
const LIMIT_PX: usize = 1600;

/// From so many shots on, arrows and dots are drawn fine.
const MANY: usize = 60;

/// An SVG for the page, and the same as a file that brings its own colours.
pub(super) fn keep(files: &mut Files, name: &str, svg: &str) {
    let style = format!("<style>{}</style>", include_str!("chart.css"));
    let at = svg.find('>').map_or(0, |i| i + 1);
    files.push((name.to_owned(), format!("{}{style}{}", &svg[..at], &svg[at..]).into_bytes()));
}

/// The tone-mapped shot with slab, windows, lit points and reference dots; then a detail of one window.
pub(super) fn shot(input: &ReportInput, o: &Overview, files: &mut Files) -> Result<String> {
    let [width, height] = size(o)?;
    let n = reduction(width, height, LIMIT_PX);
    let (w, h) = (width / n, height / n);
    let mean = |x: usize, y: usize| -> [f32; 3] {
        let mut sum = [0.0f32; 3];
        for (j, i) in (0..n * n).map(|k| (y * n + k / n, x * n + k % n)) {
            (0..3).for_each(|c| sum[c] += o.radiance.value[3 * (j * width + i) + c]);
        }
        sum.map(|v| v / (n * n) as f32)
    };
    let mut bright: Vec<f32> =
        (0..w * h).map(|k| color::luminance(mean(k % w, k / w))).filter(|l| l.is_finite()).collect();
    bright.sort_by(f32::total_cmp);
    // A few hot pixels must not darken the rest.
    let white = bright.get(bright.len().saturating_sub(1 + bright.len() / 2000)).copied().unwrap_or(1.0);
    let png = SrgbPicture::from_fn(w, h, |x, y| color::tone_map(mean(x, y), white)).png()?;
    let mut layers = format!(
        "<image href=\"{}\" x=\"-0.5\" y=\"-0.5\" width=\"{}\" height=\"{}\"/><g class=\"found\">",
        data_url(&png),
        w * n,
        h * n
    );
    files.push(("shot.png".to_owned(), png));
    outline(&mut layers, &o.slab_px, "slab");
    o.windows_px.iter().for_each(|w| outline(&mut layers, w, "window"));
    points(&mut layers, &o.grid_px, "lit");
    points(&mut layers, &o.reference_dots_px, "reference");
    points(&mut layers, &o.lit_px, "shot");
    layers.push_str("</g>");
    let label = escape(&format!("Shot {}, tone-mapped, with the recovered grid", o.shot));
    let bar = shot_scale_bar(input, o).unwrap_or_default();
    let svg = |body: &str, view: &str| {
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"photo\" viewBox=\"{view}\" role=\"img\" aria-label=\"{label}\">{body}</svg>"
        )
    };
    let whole = format!("-0.5 -0.5 {width} {height}");
    keep(files, "shot-grid.svg", &svg(&format!("{layers}{bar}"), &whole));
    let mut out = svg(&format!("<g id=\"layers\" class=\"photo\">{layers}</g>{bar}"), &whole);
    if let Some(view) = detail(o) {
        out.push_str(&svg("<use href=\"#layers\"/>", &view));
    }
    Ok(out)
}

/// How many exposures measured each pixel, and the legend with shares.
pub(super) fn exposures(o: &Overview, files: &mut Files) -> Result<(String, String)> {
    let [width, height] = size(o)?;
    let n = reduction(width, height, LIMIT_PX);
    let used = |k: usize| o.radiance.used[3 * k..3 * k + 3].iter().copied().min().unwrap_or(0);
    // The worst pixel of a block stands for it: a saturated dot must not vanish by shrinking.
    let worst = |x: usize, y: usize| {
        let block = (0..n * n).map(|k| used((y * n + k / n) * width + x * n + k % n));
        usize::from(block.min().unwrap_or(0))
    };
    let png = SrgbPicture::from_fn(width / n, height / n, |x, y| color::count(worst(x, y))).png()?;
    let img = format!(
        "<img src=\"{}\" width=\"{}\" height=\"{}\" alt=\"Number of exposures that measured each pixel\">",
        data_url(&png),
        width / n,
        height / n
    );
    files.push(("exposures.png".to_owned(), png));
    let mut pixels = vec![0usize; o.exposures.max(1) + 1];
    for k in 0..width * height {
        let count = usize::from(used(k)).min(pixels.len() - 1);
        pixels[count] += 1;
    }
    let mut legend = String::from("<ul class=\"legend\">");
    for (count, pixels) in pixels.into_iter().enumerate() {
        let share = pixels as f64 / (width * height) as f64;
        let name = match count {
            0 => "none: not measured".to_owned(),
            1 => "1 exposure".to_owned(),
            n => format!("{n} exposures"),
        };
        let swatch = color::hex(color::count(count));
        let _ = write!(legend, "<li><i style=\"background:{swatch}\"></i>{name} <b>{:.2} %</b></li>", 100.0 * share);
    }
    legend.push_str("</ul>");
    Ok((img, legend))
}

/// Every shot's drift as an arrow from the centre, x right and y down as in the photographs.
pub(super) fn drift_compass(shots: &[ShotRecord], files: &mut Files) -> String {
    const R: f64 = 120.0;
    let largest = shots.iter().map(|s| s.drift_px[0].hypot(s.drift_px[1])).fold(0.0, f64::max);
    let full = if largest > 0.0 { largest * 1.1 } else { 1.0 };
    let mut body = String::new();
    let step = nice_below(full / 1.8);
    for k in 1..=(full / step) as usize {
        let r = k as f64 * step / full * R;
        let _ = write!(body, "<circle class=\"rule\" cx=\"0\" cy=\"0\" r=\"{r:.1}\"/>");
        let _ = write!(body, "<text x=\"4\" y=\"{:.1}\">{} px</text>", -r - 3.0, significant(k as f64 * step, 2));
    }
    let _ = write!(body, "<path class=\"rule\" d=\"M-{R} 0H{R}M0 -{R}V{R}\"/>");
    for (i, s) in shots.iter().enumerate() {
        let [x, y] = s.drift_px.map(|v| v / full * R);
        let (length, turn) = (x.hypot(y), y.atan2(x).to_degrees());
        let head = if length > 5.0 { "M0 0l-5 -2.2v4.4z" } else { "" };
        // From the first shot to the last: early arrows are pale.
        let strength = 0.35 + 0.65 * i as f64 / shots.len().max(2) as f64;
        let class = if shots.len() > MANY { "arrow many" } else { "arrow" };
        let _ = write!(
            body,
            "<g class=\"{class}\" opacity=\"{strength:.2}\"><path d=\"M0 0L{x:.2} {y:.2}\"/><path class=\"head\" d=\"{head}\" transform=\"translate({x:.2} {y:.2}) rotate({turn:.1})\"/><title>{}</title></g>",
            escape(&s.name)
        );
    }
    let svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"chart\" viewBox=\"-140 -140 280 280\" role=\"img\" aria-label=\"Drift of every shot as an arrow\">{body}</svg>"
    );
    keep(files, "drift-arrows.svg", &svg);
    svg
}

/// Drift along x and y against the shot's number, with two standard deviations.
pub(super) fn drift_series(shots: &[ShotRecord], files: &mut Files) -> String {
    let reach = shots
        .iter()
        .map(|s| s.drift_px[0].abs().max(s.drift_px[1].abs()) + 2.0 * s.drift_sd_px.unwrap_or(0.0))
        .fold(1e-3, f64::max)
        * 1.08;
    let last = shots.len().saturating_sub(1) as f64;
    let x = ChartAxis::linear(-0.5, last + 0.5, "shot");
    let mut chart = Chart::new(560.0, 280.0, x, ChartAxis::linear(-reach, reach, "drift, camera px"));
    chart.line([(-0.5, 0.0), (last + 0.5, 0.0)], "zero");
    let radius = if shots.len() > MANY { 1.4 } else { 3.0 };
    for (axis, class) in [(0, "a"), (1, "b")] {
        // Side by side, so that neither hides the other.
        let place = |i: usize| i as f64 + if axis == 0 { -0.12 } else { 0.12 };
        for (i, s) in shots.iter().enumerate() {
            if let Some(sd) = s.drift_sd_px {
                chart.bar(
                    place(i),
                    s.drift_px[axis] - 2.0 * sd,
                    s.drift_px[axis] + 2.0 * sd,
                    &format!("whisker {class}"),
                );
            }
        }
        chart.dots(shots.iter().enumerate().map(|(i, s)| (place(i), s.drift_px[axis])), radius, class);
    }
    let svg = chart.finish("Drift of every shot along x and y");
    keep(files, "drift.svg", &svg);
    svg
}

/// Singular values on a logarithmic axis, the kept ones filled, and the noise of each.
pub(super) fn singular_values(material: &MaterialSummary, files: &mut Files) -> String {
    let shown = &material.levels[..material.levels.len().min(60)];
    let top = shown.first().map_or(1.0, |level| level.singular_value);
    // Values at rounding level say nothing and would stretch the axis.
    let low = shown.iter().flat_map(|l| [l.singular_value, l.noise]).filter(|v| *v > top * 1e-8).fold(top, f64::min);
    let x = ChartAxis::linear(0.0, shown.len() as f64 + 1.0, "term");
    let mut chart = Chart::new(560.0, 300.0, x, ChartAxis::decades(low, top, "singular value"));
    chart.line(shown.iter().enumerate().map(|(i, level)| (i as f64 + 1.0, level.noise)), "noise");
    let values = |kept: bool| {
        let all = shown.iter().enumerate().filter(move |(_, level)| level.kept == kept);
        all.map(|(i, level)| (i as f64 + 1.0, level.singular_value))
    };
    chart.dots(values(true), 3.6, "kept");
    chart.dots(values(false), 3.0, "dropped");
    let svg = chart.finish("Singular values of the factored rows and their noise");
    keep(files, "singular-values.svg", &svg);
    svg
}

/// Width and height of the shot, px.
fn size(o: &Overview) -> Result<[usize; 2]> {
    let Rect { width, height, .. } = o.radiance.rect;
    let n = 3 * width * height;
    if n == 0 || o.radiance.value.len() != n || o.radiance.used.len() != n {
        return Err(Error::internal(format_args!("overview of shot \"{}\" is not {width} × {height}", o.shot)));
    }
    Ok([width, height])
}

fn outline(svg: &mut String, corners: &[Point], class: &str) {
    if corners.is_empty() {
        return;
    }
    let d: Vec<String> = corners.iter().map(|p| format!("{:.1} {:.1}", p[0], p[1])).collect();
    // Twice: a dark line under the coloured one keeps it readable on any picture.
    let _ = write!(svg, "<path class=\"under\" d=\"M{0}Z\"/><path class=\"{class}\" d=\"M{0}Z\"/>", d.join("L"));
}

fn points(svg: &mut String, at: &[Point], class: &str) {
    // Strokes of no length with round ends: a dot costs a dozen bytes, so that large grids stay light.
    let d: String = at.iter().map(|p| format!("M{:.1} {:.1}h0", p[0], p[1])).collect();
    let _ = write!(svg, "<path class=\"dot under\" d=\"{d}\"/><path class=\"dot {class}\" d=\"{d}\"/>");
}

/// A view box around a window in the middle, a third of its size beyond it, inside the picture.
fn detail(o: &Overview) -> Option<String> {
    let window = o.windows_px.get(o.windows_px.len() / 2)?;
    let range = |a: usize| {
        let low = window.iter().map(|p| p[a]).fold(f64::INFINITY, f64::min);
        let high = window.iter().map(|p| p[a]).fold(f64::NEG_INFINITY, f64::max);
        (low, high)
    };
    let size = size(o).ok()?.map(|v| v as f64);
    let (ranges, limit) = ([range(0), range(1)], size[0].min(size[1]));
    let side = ranges.iter().map(|r| 1.6 * (r.1 - r.0)).fold(0.0, f64::max).min(limit);
    let start = |a: usize| ((ranges[a].0 + ranges[a].1 - side) / 2.0).clamp(-0.5, size[a] - side - 0.5);
    (side.is_finite() && side > 0.0).then(|| format!("{:.1} {:.1} {side:.1} {side:.1}", start(0), start(1)))
}

/// A bar of a round number of millimetres at the lower left of the photograph.
fn shot_scale_bar(input: &ReportInput, o: &Overview) -> Option<String> {
    let last = input.matrix.rows().checked_sub(1)?;
    let (a, b) = (input.matrix.lit_mm.first()?, input.matrix.lit_mm.get(last)?);
    let (p, q) = (o.grid_px.first()?, o.grid_px.get(last)?);
    let mm = (b[0] - a[0]).hypot(b[1] - a[1]);
    let px_per_mm = (q[0] - p[0]).hypot(q[1] - p[1]) / mm;
    if !(px_per_mm.is_finite() && px_per_mm > 0.0) {
        return None;
    }
    let [width, height] = size(o).ok()?.map(|v| v as f64);
    let length_mm = nice_below(width / px_per_mm / 4.0);
    let (x, y, size) = (width * 0.03, height * 0.965, width / 42.0);
    Some(scale_bar(x, y, length_mm * px_per_mm, size, &format!("{} mm", significant(length_mm, 1))))
}

/// A labelled bar, drawn over a dark halo.
pub(super) fn scale_bar(x: f64, y: f64, length: f64, font: f64, label: &str) -> String {
    let end = x + length;
    let above = y - font * 0.45;
    format!(
        "<path class=\"under bar\" d=\"M{x:.2} {y:.2}H{end:.2}\"/><path class=\"bar\" d=\"M{x:.2} {y:.2}H{end:.2}\"/><text class=\"on-photo\" x=\"{x:.2}\" y=\"{above:.2}\" font-size=\"{font:.2}\">{label}</text>"
    )
}
