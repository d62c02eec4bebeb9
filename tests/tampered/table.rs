//! The outcomes as Markdown, and as the lines `today` of mistakes/.

use crate::data::Mistake;
use crate::grade::Outcome;
use crate::runs::{Run, Untouched};
use std::fmt::Write;
use std::path::Path;

/// A table of all mistakes: a column for each capture, then the counts.
pub(crate) fn markdown(mistakes: &[&Mistake], untouched: &[Untouched], runs: &[Run]) -> String {
    let mut text = String::new();
    for u in untouched {
        let m = u.built.measures.unwrap();
        writeln!(
            text,
            "- `{}`: {} (`--{}`). Untouched: error {:.2} %, {:.0} % of entries within two standard deviations.",
            u.capture.id,
            u.capture.meaning,
            u.capture.simulate.trim_start_matches("--"),
            100.0 * m.rel_rmse,
            100.0 * m.coverage
        )
        .unwrap();
    }
    let ids: Vec<&str> = untouched.iter().map(|u| u.capture.id.as_str()).collect();
    let mut kind = "";
    for mistake in mistakes {
        if mistake.kind != kind {
            kind = &mistake.kind;
            let heads: Vec<String> = ids.iter().map(|id| format!(" `{id}` |")).collect();
            writeln!(text, "\n**{kind}**\n\n| mistake | what happened |{}", heads.concat()).unwrap();
            writeln!(text, "|---|---|{}", "---|".repeat(ids.len())).unwrap();
        }
        let cells: Vec<String> = untouched.iter().map(|u| format!(" {} |", cell(mistake, u, runs))).collect();
        writeln!(text, "| `{}` | {} |{}", mistake.id, mistake.meaning, cells.concat()).unwrap();
    }
    let heads: Vec<String> = Outcome::ALL.iter().map(|o| format!(" {o} |")).collect();
    writeln!(text, "\n| capture | mistakes |{}\n|---|---|{}", heads.concat(), "---|".repeat(heads.len())).unwrap();
    for id in &ids {
        let of: Vec<&Run> = runs.iter().filter(|r| r.capture == *id).collect();
        let counts = Outcome::ALL.map(|o| format!(" {} |", of.iter().filter(|r| r.outcome == o).count()));
        writeln!(text, "| `{id}` | {} |{}", of.len(), counts.concat()).unwrap();
    }
    text
}

/// The outcome; with a matrix, its error over the untouched one's, and the share of entries within two standard
/// deviations.
fn cell(mistake: &Mistake, untouched: &Untouched, runs: &[Run]) -> String {
    if mistake.cannot.contains_key(&untouched.capture.id) {
        return "–".into();
    }
    let run = runs.iter().find(|r| r.mistake.id == mistake.id && r.capture == untouched.capture.id);
    let Some(run) = run else { return String::new() };
    let name = if run.outcome.rank() > 0 { format!("**{}**", run.outcome) } else { run.outcome.to_string() };
    match run.built.measures {
        Some(m) => {
            let ratio = m.rel_rmse / untouched.built.measures.unwrap().rel_rmse;
            format!("{name}, {ratio:.1}×, {:.0} %", 100.0 * m.coverage)
        }
        None => name,
    }
}

/// Puts a text between the markers `<!-- NAME -->` and `<!-- end of NAME -->` of a page.
pub(crate) fn write_between(page: &Path, name: &str, text: &str) {
    let old = std::fs::read_to_string(page).unwrap();
    let (start, end) = (format!("<!-- {name} -->\n"), format!("<!-- end of {name} -->"));
    let (before, rest) = old.split_once(&start).unwrap_or_else(|| panic!("{start} in {}", page.display()));
    let (_, after) = rest.split_once(&end).unwrap();
    std::fs::write(page, format!("{before}{start}{text}{end}{after}")).unwrap();
}

/// Writes the outcomes into the lines `today` of a file of mistakes; those that were not run stay.
pub(crate) fn write_today(page: &Path, runs: &[Run]) {
    let text = std::fs::read_to_string(page).unwrap();
    let mut id = String::new();
    let lines: Vec<String> = text
        .lines()
        .map(|line| {
            if let Some(found) = line.strip_prefix("id = ") {
                id = found.trim_matches('"').to_owned();
            }
            let of: Vec<&Run> = runs.iter().filter(|r| r.mistake.id == id).collect();
            if !line.starts_with("today = ") || of.is_empty() {
                return line.to_owned();
            }
            let mut stated = of[0].mistake.today.clone();
            stated.extend(of.iter().map(|r| (r.capture.to_owned(), r.outcome.to_string())));
            let stated: Vec<String> = stated.iter().map(|(c, o)| format!("{c} = \"{o}\"")).collect();
            format!("today = {{ {} }}", stated.join(", "))
        })
        .collect();
    std::fs::write(page, lines.join("\n") + "\n").unwrap();
}
