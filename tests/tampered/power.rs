//! The smallest mistake that is seen, by the size of the capture: power.toml.

use crate::data::{Captures, Mistake, TamperedCapture};
use crate::grade::Outcome;
use crate::runs::{self, Each, Run, Untouched};
use crate::{asked, page, table};
use serde::Deserialize;
use std::fmt::Write;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Data {
    capture: Vec<TamperedCapture>,
    power: Vec<Power>,
}

/// A mistake that is made at several levels.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Power {
    id: String,
    meaning: String,
    unit: String,
    levels: Vec<f64>,
    #[serde(default)]
    offset: f64,
    scale: f64,
    mistake: String,
}

impl Power {
    fn mistakes(&self) -> Vec<Mistake> {
        let at = |level: &f64| {
            let value = format!("{:?}", self.offset + self.scale * level);
            let text = format!(
                "id = \"{}-{level}\"\nmeaning = \"{}\"\n{}",
                self.id,
                self.meaning,
                self.mistake.replace("VALUE", &value)
            );
            toml::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", self.id))
        };
        self.levels.iter().map(at).collect()
    }
}

fn data() -> Data {
    toml::from_str(include_str!("power.toml")).unwrap_or_else(|e| panic!("power.toml: {e}"))
}

/// What became of a mistake at one level.
#[derive(Clone, Copy)]
struct Seen {
    level: f64,
    is_seen: bool,
    /// Error of the matrix over the untouched one's; of one that is refused there is none.
    error: Option<f64>,
}

/// From which level on a mistake is always seen; the largest error that passed unseen.
fn smallest(seen: &[Seen]) -> (Option<f64>, f64) {
    let unseen = seen.iter().rposition(|s| !s.is_seen);
    let first = unseen.map_or(0, |k| k + 1);
    let errors = seen.iter().filter(|s| !s.is_seen).filter_map(|s| s.error);
    (seen.get(first).map(|s| s.level), errors.fold(0.0, f64::max))
}

#[test]
fn a_mistake_is_seen_from_the_level_on_above_which_none_passes() {
    let at = |level: f64, is_seen: bool, error: f64| Seen { level, is_seen, error: Some(error) };
    assert_eq!(
        smallest(&[at(1.0, false, 1.2), at(2.0, true, 3.0), at(4.0, false, 2.5), at(8.0, true, 9.0)]),
        (Some(8.0), 2.5)
    );
    assert_eq!(smallest(&[at(1.0, true, 1.0)]), (Some(1.0), 0.0));
    assert_eq!(smallest(&[at(1.0, false, 1.5)]), (None, 1.5));
}

#[test]
#[ignore = "slow: some minutes, and only with WRITE=1, which writes docs/tampered.md and docs/detection-power.svg"]
fn the_smallest_mistakes_that_are_seen() {
    if std::env::var_os("WRITE").is_none() {
        return;
    }
    let Data { capture, power } = data();
    let captures = Captures { tampered: capture, ..crate::data::captures() };
    let power: Vec<Power> = power.into_iter().filter(|p| asked("MISTAKE", &p.id)).collect();
    let folder = tempfile::tempdir().unwrap();
    let untouched = runs::untouched(&captures, folder.path(), |id| asked("CAPTURE", id));
    let mistakes: Vec<Vec<Mistake>> = power.iter().map(Power::mistakes).collect();
    let all: Vec<&Mistake> = mistakes.iter().flatten().collect();
    let runs = runs::all(&all, &untouched, Each::InAll, folder.path(), &runs::notes(&captures));
    let seen: Vec<Vec<Vec<Seen>>> = power
        .iter()
        .zip(&mistakes)
        .map(|(p, of)| untouched.iter().map(|u| levels(p, of, u, &runs)).collect())
        .collect();
    let text = markdown(&power, &untouched, &seen);
    println!("{text}");
    if std::env::var_os("MISTAKE").is_none() && std::env::var_os("CAPTURE").is_none() {
        table::write_between(&page("docs/tampered.md"), "detection power", &text);
        std::fs::write(page("docs/detection-power.svg"), plot(&power, &untouched, &seen)).unwrap();
    }
}

fn levels(power: &Power, mistakes: &[Mistake], untouched: &Untouched<'_>, runs: &[Run<'_>]) -> Vec<Seen> {
    let own = |id: &str| runs.iter().find(|r| r.mistake.id == id && r.capture == untouched.capture.id).unwrap();
    let of = |(level, mistake): (&f64, &Mistake)| {
        let run = own(&mistake.id);
        let error = run.built.measures.map(|m| m.rel_rmse / untouched.built.measures.unwrap().rel_rmse);
        Seen { level: *level, is_seen: matches!(run.outcome, Outcome::Refused | Outcome::Named), error }
    };
    power.levels.iter().zip(mistakes).map(of).collect()
}

fn markdown(power: &[Power], untouched: &[Untouched<'_>], seen: &[Vec<Vec<Seen>>]) -> String {
    let mut text = String::new();
    for u in untouched {
        writeln!(text, "- `{}`: {} (`{}`)", u.capture.id, u.capture.meaning, u.capture.simulate).unwrap();
    }
    let heads: Vec<String> = untouched.iter().map(|u| format!(" `{}` |", u.capture.id)).collect();
    writeln!(text, "\n| mistake | levels |{}\n|---|---|{}", heads.concat(), "---|".repeat(heads.len())).unwrap();
    for (p, of) in power.iter().zip(seen) {
        let cell = |seen: &Vec<Seen>| {
            let (level, error) = smallest(seen);
            let level = level.map_or("**none**".to_owned(), |level| level.to_string());
            match error > 0.0 {
                true => format!(" {level} ({error:.1}×) |"),
                false => format!(" {level} |"),
            }
        };
        let all: Vec<String> = p.levels.iter().map(f64::to_string).collect();
        let cells: Vec<String> = of.iter().map(cell).collect();
        writeln!(text, "| {} | {} {} |{}", p.meaning, all.join(", "), p.unit, cells.concat()).unwrap();
    }
    text
}

/// A panel for each mistake: levels from the bottom up, captures from left to right; filled where it was seen.
fn plot(power: &[Power], untouched: &[Untouched<'_>], seen: &[Vec<Vec<Seen>>]) -> String {
    let (width, height, columns) = (230, 170, 4);
    let size = [columns * width, power.len().div_ceil(columns) * height];
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"10\">\n",
        size[0], size[1]
    );
    for (k, (p, of)) in power.iter().zip(seen).enumerate() {
        let (left, top) = ((k % columns * width) as f64, (k / columns * height) as f64);
        writeln!(svg, "<text x=\"{}\" y=\"{}\" font-weight=\"bold\">{}</text>", left + 8.0, top + 14.0, p.id).unwrap();
        writeln!(svg, "<text x=\"{}\" y=\"{}\">{}</text>", left + 8.0, top + 27.0, p.unit).unwrap();
        let y = |row: usize| top + 140.0 - 20.0 * row as f64;
        for (row, level) in p.levels.iter().enumerate() {
            writeln!(svg, "<text x=\"{}\" y=\"{}\" text-anchor=\"end\">{level}</text>", left + 38.0, y(row) + 3.5)
                .unwrap();
        }
        for (column, (u, seen)) in untouched.iter().zip(of).enumerate() {
            let x = left + 65.0 + 55.0 * column as f64;
            writeln!(svg, "<text x=\"{x}\" y=\"{}\" text-anchor=\"middle\">{}</text>", top + 160.0, u.capture.id)
                .unwrap();
            for (row, seen) in seen.iter().enumerate() {
                let fill = if seen.is_seen { "#246" } else { "none" };
                writeln!(svg, "<circle cx=\"{x}\" cy=\"{}\" r=\"5\" fill=\"{fill}\" stroke=\"#246\"/>", y(row))
                    .unwrap();
                if let (false, Some(error)) = (seen.is_seen, seen.error) {
                    let text =
                        format!("<text x=\"{}\" y=\"{}\" fill=\"#777\">{error:.1}×</text>", x + 8.0, y(row) + 3.5);
                    writeln!(svg, "{text}").unwrap();
                }
            }
        }
    }
    svg + "</svg>\n"
}
