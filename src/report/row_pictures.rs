//! A few rows of R_d: measured, reconstructed, their difference, and a cut through the peak.

use super::chart::{Chart, ChartAxis, nice_above, nice_below};
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
/// Share of the samples that lie within the scales of differences; the rest are their ends.
const WITHIN: f64 = 0.98;
/// Samples below this share of their row's peak have no share of a difference, as they have none in `log_rmse`.
const FAINTEST: f64 = 1e-4;
/// Names in files and captions of a row's pictures.
const PICTURES: [(&str, &str); 4] = [
    ("measured", "measured"),
    ("reconstructed", "reconstructed"),
    ("difference", "difference, share"),
    ("sigmas", "difference / σ"),
];
const CHANNEL_CLASSES: [&str; 3] = ["red", "green", "blue"];
/// Which colour is which channel.
const CHANNEL_KEY: &str =
    "<span class=\"channels\"><i class=\"red\"></i>R <i class=\"green\"></i>G <i class=\"blue\"></i>B</span>";

/// The whole section: scales, then a line of figures per row.
pub(super) fn section(header: &MatrixHeader, rows: &[ComparedRow], files: &mut Files) -> Result<String> {
    let scales = RowScales::of(header, rows);
    let top = scales.top;
    let mut out = String::from("<div class=\"scales\">");
    let end = |v: f64| significant(v, 2);
    let within = format!("{:.0} % of the samples below lie within", 100.0 * WITHIN);
    bar_scale(
        &mut out,
        color::sequential,
        [&end(top * 10f64.powf(-DECADES)), &end(top * 10f64.powf(-DECADES / 2.0)), &end(top)],
        "R_d, mean of the channels, mm⁻², logarithmic",
    );
    for (limit, unit, what) in [
        (100.0 * scales.share, "%", "reconstructed − measured, of what was measured there"),
        (scales.sigmas, "σ", "reconstructed − measured, in standard deviations"),
    ] {
        let limit = significant(limit, 1);
        let (low, high) = (format!("−{limit} {unit}"), format!("+{limit} {unit}"));
        bar_scale(&mut out, |t| color::diverging(2.0 * t - 1.0), [&low, "0", &high], &format!("{what}; {within}"));
    }
    out.push_str("</div>");
    for (k, row) in rows.iter().enumerate() {
        one(&mut out, header, row, k + 1, &scales, files)?;
    }
    Ok(out)
}

/// The colour scales of all rows.
struct RowScales {
    /// The largest response, mm⁻².
    top: f64,
    /// Where the scale of differences ends, as a share of what was measured.
    share: f64,
    /// The same in standard deviations.
    sigmas: f64,
}

impl RowScales {
    fn of(header: &MatrixHeader, rows: &[ComparedRow]) -> Self {
        let all = || rows.iter().flat_map(|row| (0..header.window_len()).map(move |i| (row, i)));
        let top = all().filter_map(|(row, i)| measured(row, i)).fold(0.0, f64::max);
        let peaks: Vec<f64> = rows.iter().map(|row| peak(header, row)).collect();
        let of_rows = rows.iter().zip(&peaks);
        let shares = of_rows.flat_map(|(row, &peak)| (0..header.window_len()).filter_map(move |i| share(row, i, peak)));
        let sigmas = all().filter_map(|(row, i)| in_sigmas(row, i));
        Self { top, share: limit(shares.collect()), sigmas: limit(sigmas.collect()) }
    }
}

/// The round number within which [`WITHIN`] of these lie; 1 where none is above zero.
fn limit(differences: Vec<f64>) -> f64 {
    let mut sizes: Vec<f64> = differences.into_iter().map(f64::abs).collect();
    sizes.sort_by(f64::total_cmp);
    let at = (sizes.len() as f64 * WITHIN).ceil() as usize;
    nice_above(sizes.get(at.max(1) - 1).copied().unwrap_or(0.0))
}

/// The largest mean of channels of a row.
fn peak(header: &MatrixHeader, row: &ComparedRow) -> f64 {
    (0..header.window_len()).filter_map(|i| measured(row, i)).fold(0.0, f64::max)
}

/// The difference of sample `i` as a share of what was measured there.
fn share(row: &ComparedRow, i: usize, peak: f64) -> Option<f64> {
    let value = measured(row, i).filter(|v| *v > FAINTEST * peak)?;
    Some((mean(&row.reconstructed, i) - value) / value)
}

/// The same in standard deviations; the channels' errors are taken as independent.
fn in_sigmas(row: &ComparedRow, i: usize) -> Option<f64> {
    let (value, sd) = (measured(row, i)?, (mean(&row.variance, i) / 3.0).sqrt());
    (sd > 0.0).then(|| (mean(&row.reconstructed, i) - value) / sd)
}

fn one(
    out: &mut String,
    header: &MatrixHeader,
    row: &ComparedRow,
    number: usize,
    scales: &RowScales,
    files: &mut Files,
) -> Result<()> {
    let (column, line) = (row.index % header.points[0], row.index / header.points[0]);
    let place = header.lit_mm.get(row.index).map(|p| format!(" at ({:.2}, {:.2}) mm", p[0], p[1])).unwrap_or_default();
    let _ =
        write!(out, "<h3>Point [{column}, {line}]<span>{place}: {}</span></h3><div class=\"row\">", escape(row.reason));
    let peak = peak(header, row);
    for (name, title) in PICTURES {
        let at = |x, y| colored(name, row, y * header.window[0] + x, scales, peak);
        let png = SrgbPicture::from_fn(header.window[0], header.window[1], at).enlarged(240).png()?;
        let _ = write!(out, "<figure>{}<figcaption>{title}</figcaption></figure>", framed(header, &png, title));
        files.push((format!("row-{number}-{name}.png"), png));
    }
    let chart = cut(header, row);
    keep(files, &format!("row-{number}-cut.svg"), &chart);
    let _ = write!(
        out,
        "<figure class=\"cut\">{chart}<figcaption>cut through the peak along x{CHANNEL_KEY}</figcaption></figure></div>"
    );
    Ok(())
}

/// The colour of sample `i` in the picture `name` of [`PICTURES`].
fn colored(name: &str, row: &ComparedRow, i: usize, scales: &RowScales, peak: f64) -> Rgb {
    let log = |v: f64| color::sequential(color::log_position(v, scales.top, DECADES));
    let color = match name {
        "measured" => measured(row, i).map(log),
        "reconstructed" => Some(log(mean(&row.reconstructed, i))),
        "difference" => share(row, i, peak).map(|v| color::diverging(v / scales.share)),
        _ => in_sigmas(row, i).map(|v| color::diverging(v / scales.sigmas)),
    };
    color.unwrap_or(color::INVALID)
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

#[cfg(test)]
mod tests {
    use super::super::tests::header;
    use super::*;

    #[test]
    fn scales_of_differences_are_round_and_hold_nearly_all_samples() {
        let header = header([1, 1], [10, 10]);
        let mut row = ComparedRow {
            index: 0,
            reason: "",
            response: vec![0.5; 300],
            variance: vec![1e-4; 300],
            valid: vec![1; 300],
            reconstructed: (0..300).map(|k| 0.5 + 0.0001 * (k / 3) as f32).collect(),
        };
        // Differences 0 … 0.0099; the sample of rank 98 is 0.0097 off: 1.94 %, and of sd 0.01/√3 1.68.
        let scales = RowScales::of(&header, std::slice::from_ref(&row));
        assert_eq!((scales.top, scales.share, scales.sigmas), (0.5, 0.02, 2.0));
        let color = |name, row: &ComparedRow, i| colored(name, row, i, &scales, 0.5);
        assert_eq!(color("difference", &row, 0), color::diverging(0.0));
        assert_ne!(color("difference", &row, 25), color::diverging(0.0), "half a per cent is seen");
        assert_ne!(color("sigmas", &row, 99), color::diverging(1.0), "and the largest is not the end of the scale");
        // What has no light has no share of it.
        row.response[..3].fill(1e-6);
        assert_eq!(color("difference", &row, 0), color::INVALID);
        assert_eq!(limit(vec![]), 1.0);
    }
}
