//! A few rows of R_d: measured, reconstructed, their difference, and a cut through the peak.

use super::chart::{Chart, ChartAxis, nice_below};
use super::color::{self, Rgb};
use super::figures::{keep, scale_bar};
use super::picture::{SrgbPicture, data_url};
use super::text::{escape, significant};
use super::{ComparedRow, Files};
use crate::Result;
use crate::transport::MatrixHeader;
use std::fmt::Write;

/// Decades that the logarithmic pictures span.
const DECADES: f64 = 4.0;
/// The difference is shown this many times too strong.
const STRONGER: f64 = 5.0;
/// Where the scale of the difference in standard deviations ends.
const SIGMAS: f64 = 4.0;
/// Names in files and captions of a row's pictures.
const PICTURES: [(&str, &str); 4] = [
    ("measured", "measured"),
    ("reconstructed", "reconstructed"),
    ("difference", "difference × 5"),
    ("sigmas", "difference / σ"),
];
const CHANNEL_CLASSES: [&str; 3] = ["red", "green", "blue"];

/// The whole section: scales, then a line of figures per row.
pub(super) fn section(header: &MatrixHeader, rows: &[ComparedRow], files: &mut Files) -> Result<String> {
    let top =
        rows.iter().flat_map(|r| (0..header.window_len()).map(|i| measured(r, i).unwrap_or(0.0))).fold(0.0, f64::max);
    let mut out = String::from("<div class=\"scales\">");
    let end = |v: f64| significant(v, 2);
    bar_scale(
        &mut out,
        color::sequential,
        [&end(top * 10f64.powf(-DECADES)), &end(top * 10f64.powf(-DECADES / 2.0)), &end(top)],
        "R_d, mean of the channels, mm⁻², logarithmic",
    );
    let percent = 100.0 / STRONGER;
    bar_scale(
        &mut out,
        |t| color::diverging(2.0 * t - 1.0),
        [&format!("−{percent} %"), "0", &format!("+{percent} %")],
        "reconstructed − measured, of the row's peak; shown × 5",
    );
    bar_scale(
        &mut out,
        |t| color::diverging(2.0 * t - 1.0),
        [&format!("−{SIGMAS} σ"), "0", &format!("+{SIGMAS} σ")],
        "reconstructed − measured, in standard deviations",
    );
    out.push_str("</div>");
    for (k, row) in rows.iter().enumerate() {
        one(&mut out, header, row, k + 1, top, files)?;
    }
    Ok(out)
}

fn one(
    out: &mut String,
    header: &MatrixHeader,
    row: &ComparedRow,
    number: usize,
    top: f64,
    files: &mut Files,
) -> Result<()> {
    let (column, line) = (row.index % header.points[0], row.index / header.points[0]);
    let place = header.lit_mm.get(row.index).map(|p| format!(" at ({:.2}, {:.2}) mm", p[0], p[1])).unwrap_or_default();
    let _ =
        write!(out, "<h3>Point [{column}, {line}]<span>{place}: {}</span></h3><div class=\"row\">", escape(row.reason));
    let peak = (0..header.window_len()).filter_map(|i| measured(row, i)).fold(0.0, f64::max);
    for (name, title) in PICTURES {
        let at = |x, y| colored(name, row, y * header.window[0] + x, top, peak);
        let png = SrgbPicture::from_fn(header.window[0], header.window[1], at).enlarged(240).png()?;
        let _ = write!(out, "<figure>{}<figcaption>{title}</figcaption></figure>", framed(header, &png, title));
        files.push((format!("row-{number}-{name}.png"), png));
    }
    let chart = cut(header, row);
    keep(files, &format!("row-{number}-cut.svg"), &chart);
    let _ = write!(out, "<figure>{chart}<figcaption>cut through the peak along x</figcaption></figure></div>");
    Ok(())
}

/// The colour of sample `i` in the picture `name` of [`PICTURES`].
fn colored(name: &str, row: &ComparedRow, i: usize, top: f64, peak: f64) -> Rgb {
    let log = |v: f64| color::sequential(color::log_position(v, top, DECADES));
    let estimate = mean(&row.reconstructed, i);
    let Some(value) = measured(row, i).or((name == "reconstructed").then_some(0.0)) else { return color::INVALID };
    match name {
        "measured" => log(value),
        "reconstructed" => log(estimate),
        "difference" => color::diverging(STRONGER * (estimate - value) / peak),
        _ => {
            // The channels' errors are taken as independent.
            let sd = (mean(&row.variance, i) / 3.0).sqrt();
            if sd > 0.0 { color::diverging((estimate - value) / sd / SIGMAS) } else { color::INVALID }
        }
    }
}

/// A window's picture with the lit point marked and a scale bar.
fn framed(header: &MatrixHeader, png: &[u8], name: &str) -> String {
    // A dark scale bar on the pictures whose zero is white.
    let class = if name.starts_with("difference") { "photo pale" } else { "photo" };
    let width_mm = header.window[0] as f64 * header.pitch_mm;
    let height = 100.0 * header.window[1] as f64 / header.window[0] as f64;
    let length_mm = nice_below(width_mm / 3.0);
    let bar =
        scale_bar(5.0, height - 6.0, 100.0 * length_mm / width_mm, 7.0, &format!("{} mm", significant(length_mm, 1)));
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"{class}\" viewBox=\"0 0 100 {height:.2}\" role=\"img\" aria-label=\"{name} window\"><image href=\"{}\" width=\"100\" height=\"{height:.2}\" preserveAspectRatio=\"none\" style=\"image-rendering:pixelated\"/>{bar}</svg>",
        data_url(png)
    )
}

/// Measured values with two standard deviations, and the reconstruction as lines, along x through the brightest sample.
fn cut(header: &MatrixHeader, row: &ComparedRow) -> String {
    let [nx, ny] = header.window;
    let brightest = (0..nx * ny).filter_map(|i| Some((measured(row, i)?, i)));
    let y = brightest.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(ny / 2, |(_, i)| i / nx);
    let at = |x: usize, c: usize| 3 * (y * nx + x) + c;
    let mm = |x: usize| header.offset_px([x, y])[0] as f64 * header.pitch_mm;
    let values = || (0..nx).flat_map(|x| (0..3).map(move |c| (x, c)));
    let shown =
        |x: usize, c: usize| (row.valid[at(x, c)] != 0).then(|| f64::from(row.response[at(x, c)])).filter(|v| *v > 0.0);
    let high = values().filter_map(|(x, c)| shown(x, c)).fold(0.0, f64::max);
    let low = values().filter_map(|(x, c)| shown(x, c)).filter(|v| *v > high * 1e-6).fold(high, f64::min);
    let half = nx as f64 / 2.0 * header.pitch_mm;
    let mut chart = Chart::new(
        380.0,
        250.0,
        ChartAxis::linear(-half, half, "offset along x, mm"),
        ChartAxis::decades(low, high, "R_d, mm⁻²"),
    );
    for (c, class) in CHANNEL_CLASSES.into_iter().enumerate() {
        for x in 0..nx {
            if let Some(v) = shown(x, c) {
                let two_sd = 2.0 * f64::from(row.variance[at(x, c)].max(0.0)).sqrt();
                chart.bar(mm(x), v - two_sd, v + two_sd, &format!("whisker {class}"));
            }
        }
        chart.line((0..nx).map(|x| (mm(x), f64::from(row.reconstructed[at(x, c)]))), class);
        chart.dots((0..nx).filter_map(|x| Some((mm(x), shown(x, c)?))), 2.0, class);
    }
    chart.finish("Measured and reconstructed responses along x")
}

/// A colour scale with three labels.
pub(super) fn bar_scale(out: &mut String, color: impl Fn(f64) -> Rgb, labels: [&str; 3], title: &str) {
    let stops: Vec<String> = (0..=16).map(|i| color::hex(color(f64::from(i) / 16.0))).collect();
    let _ = write!(
        out,
        "<div class=\"scale\"><div class=\"ramp\" style=\"background:linear-gradient(90deg,{})\"></div><div class=\"ends\"><span>{}</span><span>{}</span><span>{}</span></div><p>{}</p></div>",
        stops.join(","),
        escape(labels[0]),
        escape(labels[1]),
        escape(labels[2]),
        escape(title)
    );
}

/// Mean of the three channels of sample `i`.
fn mean(values: &[f32], i: usize) -> f64 {
    values[3 * i..3 * i + 3].iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0
}

/// Mean of the channels, when all were measured.
fn measured(row: &ComparedRow, i: usize) -> Option<f64> {
    row.valid[3 * i..3 * i + 3].iter().all(|v| *v != 0).then(|| mean(&row.response, i))
}
