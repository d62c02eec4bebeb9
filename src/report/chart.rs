//! Small line charts as SVG text. Colours come from the page's variables, so that charts follow light and dark.

use super::labels::{self, PlacedLabel};
use std::fmt::Write;

/// One axis: its range, its scale, its title.
#[derive(Debug, Clone)]
pub(crate) struct ChartAxis {
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Logarithmic; then `min` must be positive.
    pub log: bool,
    /// What it shows, with its unit.
    pub title: String,
}

impl ChartAxis {
    /// A linear axis; an empty range is widened.
    pub(crate) fn linear(min: f64, max: f64, title: &str) -> Self {
        let (min, max) = if max > min { (min, max) } else { (min - 0.5, min + 0.5) };
        Self { min, max, log: false, title: title.to_owned() }
    }

    /// A logarithmic axis from the decade below `min` to the one above `max`; values that are not positive are
    /// replaced.
    pub(crate) fn decades(min: f64, max: f64, title: &str) -> Self {
        let max = if max > 0.0 && max.is_finite() { max } else { 1.0 };
        let min = if min > 0.0 { min.min(max) } else { max * 1e-4 };
        let (low, high) = (min.log10().floor(), max.log10().ceil());
        let high = if high > low { high } else { low + 1.0 };
        Self { min: 10f64.powf(low), max: 10f64.powf(high), log: true, title: title.to_owned() }
    }

    /// Position 0..=1 of `v`, clamped to the range.
    fn place(&self, v: f64) -> f64 {
        let t = if self.log {
            (v.max(self.min) / self.min).log10() / (self.max / self.min).log10()
        } else {
            (v - self.min) / (self.max - self.min)
        };
        t.clamp(0.0, 1.0)
    }

    /// Whether a logarithmic axis is so short that its decades alone would be few ticks.
    fn is_short(&self) -> bool {
        self.log && self.max / self.min < 150.0
    }

    /// What stands at a tick.
    fn tick_text(&self, v: f64) -> String {
        if self.is_short() { super::text::significant(v, 1) } else { super::text::tick(v, self.log) }
    }

    fn ticks(&self) -> Vec<f64> {
        if self.log {
            let (low, high) = (self.min.log10().round() as i32, self.max.log10().round() as i32);
            if self.is_short() {
                let between = (low..high).flat_map(|e| [1.0, 2.0, 5.0].map(|head| head * 10f64.powi(e)));
                return between.chain([self.max]).collect();
            }
            let every = ((high - low) / 6 + 1) as usize;
            return (low..=high).step_by(every).map(|e| 10f64.powi(e)).collect();
        }
        let step = nice_below((self.max - self.min) / 4.0);
        let first = (self.min / step - 1e-9).ceil() as i64;
        let last = (self.max / step + 1e-9).floor() as i64;
        (first..=last).map(|i| i as f64 * step).collect()
    }
}

/// The largest of 1, 2, 5 times a power of ten that is not above `v`.
pub(crate) fn nice_below(v: f64) -> f64 {
    if !(v > 0.0 && v.is_finite()) {
        return 1.0;
    }
    let power = 10f64.powf(v.log10().floor());
    let head = v / power * (1.0 + 1e-9);
    power
        * if head >= 5.0 {
            5.0
        } else if head >= 2.0 {
            2.0
        } else {
            1.0
        }
}

/// The smallest of 1, 2, 5 times a power of ten that is not below `v`; 1 where that is not above zero.
pub(crate) fn nice_above(v: f64) -> f64 {
    let below = nice_below(v);
    if !(v > 0.0 && v.is_finite()) || below >= v * (1.0 - 1e-9) {
        return below;
    }
    [2.0, 2.5].into_iter().map(|next| below * next).find(|&next| nice_below(next) > 0.999 * next).unwrap_or(below)
}

/// A chart under construction.
#[derive(Debug)]
pub(crate) struct Chart {
    width: f64,
    height: f64,
    x: ChartAxis,
    y: ChartAxis,
    body: String,
}

const LEFT: f64 = 62.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 12.0;
const BOTTOM: f64 = 44.0;

impl Chart {
    /// A chart of `width` × `height` CSS px with axes and grid lines.
    pub(crate) fn new(width: f64, height: f64, x: ChartAxis, y: ChartAxis) -> Self {
        let mut chart = Self { width, height, x, y, body: String::new() };
        chart.axes();
        chart
    }

    /// Where the values (x, y) are drawn.
    pub(crate) fn at(&self, x: f64, y: f64) -> [f64; 2] {
        [
            LEFT + self.x.place(x) * (self.width - LEFT - RIGHT),
            self.height - BOTTOM - self.y.place(y) * (self.height - TOP - BOTTOM),
        ]
    }

    /// Where the axis of x begins and ends.
    pub(crate) fn x_range(&self) -> (f64, f64) {
        (self.x.min, self.x.max)
    }

    /// A line through the values, of CSS class `class`; it is broken where a logarithmic axis does not reach.
    pub(crate) fn line(&mut self, values: impl IntoIterator<Item = (f64, f64)>, class: &str) {
        let mut d = String::new();
        let mut pen = 'M';
        for (x, y) in values {
            if self.y.log && y < self.y.min {
                pen = 'M';
                continue;
            }
            let p = self.at(x, y);
            let _ = write!(d, "{pen}{:.1} {:.1}", p[0], p[1]);
            pen = 'L';
        }
        let _ = write!(self.body, "<path class=\"{class}\" d=\"{d}\"/>");
    }

    /// A dot of radius `r` px at each value.
    pub(crate) fn dots(&mut self, values: impl IntoIterator<Item = (f64, f64)>, r: f64, class: &str) {
        for (x, y) in values {
            let p = self.at(x, y);
            let _ = write!(self.body, "<circle class=\"{class}\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"{r}\"/>", p[0], p[1]);
        }
    }

    /// A vertical bar from `low` to `high` at `x`.
    pub(crate) fn bar(&mut self, x: f64, low: f64, high: f64, class: &str) {
        let (a, b) = (self.at(x, low), self.at(x, high));
        let _ = write!(
            self.body,
            "<line class=\"{class}\" x1=\"{:.1}\" y1=\"{:.1}\" x2=\"{:.1}\" y2=\"{:.1}\"/>",
            a[0], a[1], b[0], b[1]
        );
    }

    /// Labels of values (x, y), beside them, none on another nor, where there is room, on one of `dots` or `lines`;
    /// those that stand apart are joined to their dots.
    pub(crate) fn labels(&mut self, labels: &[((f64, f64), String)], dots: &[(f64, f64)], lines: &[Vec<(f64, f64)>]) {
        let at = |v: &(f64, f64)| self.at(v.0, v.1);
        let wanted = labels.iter().map(|(v, text)| (at(v), text.clone())).collect();
        // Lines are straight on the chart, whatever its axes: a dot every few px.
        let between = |pair: &[(f64, f64)]| {
            let (a, b) = (at(&pair[0]), at(&pair[1]));
            let steps = ((b[0] - a[0]).hypot(b[1] - a[1]) / 4.0).ceil() as usize;
            (0..=steps).map(move |k| [0, 1].map(|i| a[i] + (b[i] - a[i]) * k as f64 / steps.max(1) as f64))
        };
        let on_lines = lines.iter().flat_map(|line| line.windows(2)).flat_map(between);
        let dots: Vec<[f64; 2]> = dots.iter().map(at).chain(on_lines).collect();
        let within = [[LEFT, TOP], [self.width - RIGHT, self.height - BOTTOM]];
        for PlacedLabel { dot, text, area } in labels::place(wanted, &dots, within) {
            let near: [f64; 2] = std::array::from_fn(|a| dot[a].clamp(area[0][a], area[1][a]));
            if (near[0] - dot[0]).hypot(near[1] - dot[1]) > 10.0 {
                let [x, y] = near;
                let _ = write!(self.body, "<path class=\"leader\" d=\"M{:.1} {:.1}L{x:.1} {y:.1}\"/>", dot[0], dot[1]);
            }
            self.label((area[0][0] + area[1][0]) / 2.0, area[1][1] - 3.0, "middle", &text);
        }
    }

    /// The finished SVG; `label` says what it shows to those who cannot see it.
    pub(crate) fn finish(self, label: &str) -> String {
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"chart{}\" viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"{}\">{}</svg>",
            if self.width > 500.0 { " wide" } else { "" },
            self.width,
            self.height,
            super::text::escape(label),
            self.body
        )
    }

    fn label(&mut self, x: f64, y: f64, anchor: &str, text: &str) {
        let text = super::text::escape(text);
        let _ = write!(self.body, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{text}</text>");
    }

    fn axes(&mut self) {
        let (right, bottom) = (self.width - RIGHT, self.height - BOTTOM);
        let (x, y) = (self.x.clone(), self.y.clone());
        for v in x.ticks() {
            let p = self.at(v, y.min)[0];
            let _ =
                write!(self.body, "<line class=\"rule\" x1=\"{p:.1}\" y1=\"{TOP}\" x2=\"{p:.1}\" y2=\"{bottom}\"/>");
            self.label(p, bottom + 16.0, "middle", &x.tick_text(v));
        }
        for v in y.ticks() {
            let p = self.at(x.min, v)[1];
            let _ =
                write!(self.body, "<line class=\"rule\" x1=\"{LEFT}\" y1=\"{p:.1}\" x2=\"{right}\" y2=\"{p:.1}\"/>");
            self.label(LEFT - 7.0, p + 4.0, "end", &y.tick_text(v));
        }
        self.label((LEFT + right) / 2.0, self.height - 8.0, "middle", &x.title);
        let middle = (TOP + bottom) / 2.0;
        let _ = write!(
            self.body,
            "<text transform=\"translate(14 {middle:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
            super::text::escape(&y.title)
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ChartAxis::linear(-3.1, 3.1, "").ticks(), [-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0]);
        assert_eq!(ChartAxis::decades(0.003, 4.0, "").ticks(), [1e-3, 1e-2, 1e-1, 1.0, 10.0]);
        assert!(ChartAxis::linear(1.0, 1.0, "").ticks().len() > 1);
        let short = ChartAxis::decades(0.02, 0.7, "");
        let texts: Vec<String> = short.ticks().into_iter().map(|v| short.tick_text(v)).collect();
        assert_eq!(texts, ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1"]);
        assert!(ChartAxis::decades(0.0, 0.0, "").ticks().len() > 1);
        assert_eq!((nice_below(7.3), nice_below(0.49), nice_below(0.5), nice_below(0.0)), (5.0, 0.2, 0.5, 1.0));
        let above = [7.3, 0.2, 0.011, 0.21, 0.0].map(nice_above);
        assert!(above.iter().zip([10.0, 0.2, 0.02, 0.5, 1.0]).all(|(a, b)| (a / b - 1.0).abs() < 1e-9), "{above:?}");
    }

    #[test]
    fn logarithmic_axes_place_decades_evenly() {
        let chart = Chart::new(300.0, 200.0, ChartAxis::linear(0.0, 1.0, "a"), ChartAxis::decades(1e-3, 1.0, "b"));
        let y = |v: f64| chart.at(0.0, v)[1];
        assert!(((y(1e-3) - y(1e-2)) - (y(1e-2) - y(1e-1))).abs() < 1e-9);
        // What lies below the range, zero and negative values included, sits on its lower end.
        assert_eq!(y(0.0), y(1e-3));
        assert_eq!(y(-5.0), y(1e-3));
    }
}
