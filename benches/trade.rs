//! The trade: how the error falls with exposures and photographs, against the lab's time and ours.
//!
//! `cargo bench --bench trade [-- --csv] [--svg FILE] [--grid N] [--window N] [--seed N]` (by default 12 × 12 points 1
//! mm apart, window of 31 samples of 0.5 mm, seed 3). For every distance of a shot's dots one capture of a chessboard
//! slab is simulated, six exposures two stops apart; matrices are built from all of these photographs and from fewer,
//! the longest left out first (range and photographs fall), then every other one (only photographs). Cross-talk is
//! removed. A Markdown table, or CSV; one plot.
//!
//! The lab's time is assumed: the exposure times of all photographs, reference shots too, and half a second for each
//! photograph.

#[allow(dead_code, unused_imports)]
#[path = "../src/report/chart.rs"]
mod chart;
#[allow(dead_code, unused_imports)]
#[path = "../src/report/labels.rs"]
mod labels;
#[allow(dead_code, unused_imports)]
#[path = "../src/report/text.rs"]
mod text;

use acquire::capture::{Capture, Manifest, Pattern};
use acquire::evaluate::evaluate;
use acquire::material::Source;
use acquire::pipeline::{BuildOptions, build_matrix};
use acquire::progress::Progress;
use acquire::simulate::{SimulateOptions, TRUTH_MATRIX, simulate};
use acquire::transport::MatrixReader;
use acquire::{Error, Result};
use chart::{Chart, ChartAxis};
use std::path::Path;

/// Distances of a shot's dots, in lit points; the last is one dot a shot at the default grid.
const SPACINGS: [usize; 6] = [2, 3, 4, 6, 8, 12];
/// Distance of lit points: two samples.
const SAMPLES_PER_POINT: usize = 2;
/// What a photograph takes besides its exposure: projector, shutter, transfer. An assumption.
const SECS_PER_PHOTOGRAPH: f64 = 0.5;
/// Simulated exposures of a lattice shot, two stops apart.
const EXPOSURES: usize = 6;
/// Exposures that are kept, counted from the shortest: two stops apart, then four and eight apart over the same range
/// as five.
const KEPT: [&[usize]; 8] =
    [&[0], &[0, 1], &[0, 1, 2], &[0, 1, 2, 3], &[0, 1, 2, 3, 4], &[0, 1, 2, 3, 4, 5], &[0, 2, 4], &[0, 4]];
/// The first of these leave the longest out, and make a line of the plot.
const LINE: usize = EXPOSURES;
/// Colours of the lines, one a spacing: from a palette that people with any sight tell apart (Okabe and Ito).
const COLORS: [&str; SPACINGS.len()] = ["#d55e00", "#e69f00", "#009e73", "#56b4e9", "#0072b2", "#cc79a7"];

/// One matrix.
#[derive(Debug, Clone)]
struct Point {
    spacing_samples: usize,
    exposures: usize,
    stops: usize,
    photographs: usize,
    lab_secs: f64,
    /// Of all threads together: it hardly depends on what else the machine does.
    build_secs: f64,
    rel_rmse: f64,
    log_rmse: f64,
    coverage: f64,
    /// Share of the matrix that was measured.
    measured: f64,
    /// Share of the windows' light that was put to other dots.
    removed: f64,
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let after = |name: &str| args.iter().position(|a| a == name).and_then(|k| args.get(k + 1));
    let number = |name: &str, default: usize| after(name).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (grid, window, seed) = (number("--grid", 12), number("--window", 31), number("--seed", 3) as u64);
    let csv = args.iter().any(|a| a == "--csv");
    head(csv);
    let mut lines = Vec::new();
    for spacing in SPACINGS.map(|s| s.min(grid)) {
        let folder = tempfile::tempdir().map_err(Error::io("create", "a temporary folder"))?;
        let dir = folder.path().join("capture");
        let pitch_mm = SimulateOptions::default().pitch_mm;
        let options = SimulateOptions {
            material: "chessboard-4x4".parse().map_err(|what| Error::Internal { what })?,
            lit_pitch_mm: Some([SAMPLES_PER_POINT as f64 * pitch_mm; 2]),
            spacing: Some([spacing; 2]),
            exposures: EXPOSURES,
            ..SimulateOptions { grid: [grid; 2], window: [window; 2], seed, ..SimulateOptions::default() }
        };
        simulate(&options, &dir, &Progress::silent())?;
        let whole = Manifest::read(&dir)?;
        let mut line = Vec::new();
        for (k, kept) in KEPT.into_iter().enumerate() {
            keep(&whole, kept).write(&dir)?;
            match measure(&dir, spacing * SAMPLES_PER_POINT, kept) {
                Ok(point) => {
                    row(&point, csv);
                    if k < LINE {
                        line.push(point);
                    }
                }
                Err(error) => eprintln!("{} samples apart, exposures {kept:?}: {error}", spacing * SAMPLES_PER_POINT),
            }
        }
        lines.push(line);
    }
    if let Some(path) = after("--svg") {
        std::fs::write(path, plot(&lines)).map_err(Error::io("write", Path::new(path)))?;
    }
    Ok(())
}

/// The capture with only some exposures of its lattice shots.
fn keep(whole: &Manifest, kept: &[usize]) -> Manifest {
    let mut manifest = whole.clone();
    for shot in manifest.shots.iter_mut().filter(|s| matches!(s.pattern, Pattern::Lattice { .. })) {
        let mut index = 0..;
        shot.photographs.retain(|_| index.next().is_some_and(|i| kept.contains(&i)));
    }
    manifest
}

fn measure(dir: &Path, spacing_samples: usize, kept: &[usize]) -> Result<Point> {
    let out = dir.join("matrix.rd.zarr");
    let capture = Capture::open(dir, None)?;
    let exposed: f64 = capture.brackets.iter().flatten().map(|p| p.exposure_secs).sum();
    let before = processor_secs();
    let report = build_matrix(dir, &BuildOptions::default(), &out, &Progress::silent())?;
    let build_secs = processor_secs() - before;
    let truth = MatrixReader::open(&dir.join(TRUTH_MATRIX))?;
    let all = truth.header().points.iter().product::<usize>() * truth.header().row_len();
    let found = evaluate(&Source::open(&out)?, &truth, &Progress::silent())?;
    Ok(Point {
        spacing_samples,
        exposures: kept.len(),
        stops: if kept.len() > 1 { 2 * (kept[1] - kept[0]) } else { 0 },
        photographs: report.photographs,
        lab_secs: exposed + SECS_PER_PHOTOGRAPH * report.photographs as f64,
        build_secs,
        rel_rmse: found.rel_rmse.unwrap_or(f64::NAN),
        log_rmse: found.log_rmse.unwrap_or(f64::NAN),
        coverage: found.coverage_2sigma.unwrap_or(f64::NAN),
        measured: found.entries as f64 / all as f64,
        removed: report.crosstalk.map_or(0.0, |c| c.removed_share),
    })
}

/// Time of all threads so far, user and system, in hundredths of a second as Linux counts; 0 elsewhere.
fn processor_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which is in brackets: the 12th and 13th field.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    fields.iter().skip(11).take(2).filter_map(|f| f.parse::<f64>().ok()).sum::<f64>() / 100.0
}

fn head(csv: bool) {
    if csv {
        return println!(
            "spacing_samples,exposures,stops,photographs,lab_secs,build_secs,rel_rmse,log_rmse,coverage_2sigma,measured_share,removed_share"
        );
    }
    println!(
        "| spacing, samples | exposures × stops | photographs | lab, s | build, processor s | `rel_rmse` | `log_rmse` | `coverage_2sigma` | measured | cross-talk removed |"
    );
    println!("|---|---|---|---|---|---|---|---|---|---|");
}

fn row(p: &Point, csv: bool) {
    let Point { spacing_samples, exposures, stops, photographs, lab_secs, build_secs, .. } = *p;
    if csv {
        return println!(
            "{spacing_samples},{exposures},{stops},{photographs},{lab_secs:.1},{build_secs:.2},{:.5},{:.4},{:.4},{:.4},{:.5}",
            p.rel_rmse, p.log_rmse, p.coverage, p.measured, p.removed
        );
    }
    let bracket = if exposures > 1 { format!("{exposures} × {stops}") } else { "1".to_owned() };
    println!(
        "| {spacing_samples} | {bracket} | {photographs} | {lab_secs:.0} | {build_secs:.2} | {:.2} % | {:.3} | {:.1} % | {:.1} % | {:.1} % |",
        100.0 * p.rel_rmse,
        p.log_rmse,
        100.0 * p.coverage,
        100.0 * p.measured,
        100.0 * p.removed
    );
}

/// What an axis shows, with its title.
type Quantity = (&'static str, fn(&Point) -> f64);

/// Size of one of the four charts, px, and of the legend's line above them.
const CHART_PX: [f64; 2] = [430.0, 280.0];
const LEGEND_PX: f64 = 26.0;

/// Both errors against photographs and against the lab's time; a line is a spacing, its points have one to six
/// exposures.
fn plot(lines: &[Vec<Point>]) -> String {
    let abscissas: [Quantity; 2] = [("photographs", |p| p.photographs as f64), ("the lab's time, s", |p| p.lab_secs)];
    let errors: [Quantity; 2] = [("rel_rmse", |p| p.rel_rmse), ("log_rmse", |p| p.log_rmse)];
    let mut body = String::new();
    for (column, (x_title, x)) in abscissas.into_iter().enumerate() {
        for (line, (y_title, y)) in errors.into_iter().enumerate() {
            let corner = [column as f64 * CHART_PX[0], LEGEND_PX + line as f64 * CHART_PX[1]];
            let place = format!(
                "<svg x=\"{}\" y=\"{}\" width=\"{}\" height=\"{}\" ",
                corner[0], corner[1], CHART_PX[0], CHART_PX[1]
            );
            body += &panel(lines, (x_title, x), (y_title, y)).replacen("<svg ", &place, 1);
        }
    }
    let legend = |(k, line): (usize, &Vec<Point>)| {
        let name = line.first().map_or(String::new(), |p| format!("{} samples apart", p.spacing_samples));
        let x = 62.0 + 130.0 * k as f64;
        format!("<circle class=\"s{k}\" cx=\"{x}\" cy=\"13\" r=\"4\"/><text x=\"{}\" y=\"17\">{name}</text>", x + 9.0)
    };
    body += &format!("<g class=\"chart\">{}</g>", lines.iter().enumerate().map(legend).collect::<String>());
    let colors = COLORS.iter().enumerate();
    let rules: String =
        colors.map(|(k, c)| format!(".chart path.s{k}{{stroke:{c}}} .chart circle.s{k}{{fill:{c}}}\n")).collect();
    let css = include_str!("../src/report/chart.css");
    let paper = ":root{background:#fff} @media (prefers-color-scheme: dark){:root{background:#15191c}}";
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\"><style>{css}{paper}\n{rules}</style>{body}</svg>\n",
        2.0 * CHART_PX[0],
        LEGEND_PX + 2.0 * CHART_PX[1]
    )
}

fn panel(lines: &[Vec<Point>], x: Quantity, y: Quantity) -> String {
    let axis = |(title, of): Quantity| {
        let values = || lines.iter().flatten().map(of).filter(|v| v.is_finite());
        let (min, max) = (0.85 * values().fold(f64::INFINITY, f64::min), values().fold(0.0, f64::max) / 0.85);
        let mut axis = ChartAxis::decades(min, max, title);
        // Ticks are at whole decades, the nearest to either end included: an end may move towards the data by less than
        // half a decade.
        if min.log10().rem_euclid(1.0) > 0.5 {
            axis.min = min;
        }
        if max.log10().rem_euclid(1.0) < 0.5 {
            axis.max = max;
        }
        axis
    };
    let mut chart = Chart::new(CHART_PX[0], CHART_PX[1], axis(x), axis(y));
    for (k, line) in lines.iter().enumerate() {
        let values: Vec<(f64, f64)> = line.iter().map(|p| (x.1(p), y.1(p))).collect();
        chart.line(values.iter().copied(), &format!("s{k}"));
        chart.dots(values.iter().copied(), 2.6, &format!("s{k}"));
        // The numbers of exposures, where lines are least crowded.
        if k + 1 == lines.len() {
            let labels: Vec<_> = line.iter().zip(&values).map(|(p, &at)| (at, p.exposures.to_string())).collect();
            chart.labels(&labels, &values, std::slice::from_ref(&values));
        }
    }
    chart.finish(&format!("{} against {}, for dots of a shot at several distances and one to six exposures", y.0, x.0))
}
