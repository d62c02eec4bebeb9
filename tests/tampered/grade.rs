//! What became of a mistake: an outcome, from the messages and the error against the truth.

use crate::data::Mistake;
use crate::program::{Built, Message};
use crate::tamper::Touched;
use regex::{Regex, RegexBuilder};
use std::fmt;

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Outcome {
    /// Exit status 1, and the message names what is wrong.
    Refused,
    /// A matrix, and a message that names what is wrong.
    Named,
    /// Nobody else is blamed, and the error is at most twice the untouched capture's.
    Corrected,
    /// Refused or warned about, and nothing that is said names what is wrong.
    BlamedWrongly,
    /// No new message, and a larger error.
    Silent,
    /// A fault of the program: neither success nor bad input.
    Fault,
}

impl Outcome {
    pub(crate) const ALL: [Self; 6] =
        [Self::Refused, Self::Named, Self::Corrected, Self::BlamedWrongly, Self::Silent, Self::Fault];

    pub(crate) fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|outcome| outcome.to_string() == name)
    }

    /// The first three are as they should be; a silent one and a wrong blame are equally bad; a fault is worse.
    pub(crate) fn rank(self) -> u8 {
        match self {
            Self::Refused | Self::Named | Self::Corrected => 0,
            Self::BlamedWrongly | Self::Silent => 1,
            Self::Fault => 2,
        }
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Refused => "refused",
            Self::Named => "named",
            Self::Corrected => "corrected",
            Self::BlamedWrongly => "blamed-wrongly",
            Self::Silent => "silent",
            Self::Fault => "fault",
        })
    }
}

/// How far above the untouched error a corrected one may be.
const CORRECTED: f64 = 2.0;

pub(crate) fn outcome(untouched: &Built, built: &Built, mistake: &Mistake, touched: &Touched) -> Outcome {
    if !matches!(built.status, 0 | 1) || built.stderr.contains("panicked at") {
        return Outcome::Fault;
    }
    let right = Right::of(mistake, touched);
    let old = |m: &Message| untouched.messages.iter().any(|o| o.words() == m.words());
    let new: Vec<&Message> = built.messages.iter().filter(|m| !old(m)).collect();
    // An old warning counts when only now it names the culprit.
    let turned = |m: &&Message| !untouched.messages.iter().any(|o| o.words() == m.words() && right.names(&o.text));
    let named = built.messages.iter().filter(turned).any(|m| right.names(&m.text))
        || built.findings.iter().any(|f| mistake.findings.contains(f) && !untouched.findings.contains(f));
    if built.status == 1 {
        return if named { Outcome::Refused } else { Outcome::BlamedWrongly };
    }
    if named {
        return Outcome::Named;
    }
    if new.iter().any(|m| !m.note) {
        return Outcome::BlamedWrongly;
    }
    let good = built.measures.zip(untouched.measures).is_some_and(|(m, u)| {
        // Entries marked as not measured are no error, as long as most are there.
        m.rel_rmse <= CORRECTED * u.rel_rmse && m.entries >= 0.5 * u.entries
    });
    if good { Outcome::Corrected } else { Outcome::Silent }
}

/// What names the mistake.
struct Right {
    says: Vec<Regex>,
    wrong: Option<Regex>,
}

impl Right {
    fn of(mistake: &Mistake, touched: &Touched) -> Self {
        let mut words: Vec<&str> = Vec::new();
        for name in &mistake.names {
            match name.as_str() {
                "photograph" => words.extend(touched.photographs.iter().map(String::as_str)),
                "shot" => words.extend(touched.shots.iter().map(String::as_str)),
                "first-shot" => words.extend(touched.shots.first().map(String::as_str)),
                "first-photograph" => words.extend(touched.photographs.first().map(String::as_str)),
                other => words.push(other),
            }
        }
        let whole = |word: &str| pattern(&format!("(^|[^a-z0-9_-]){}($|[^a-z0-9_-])", regex::escape(word)));
        let mut says: Vec<Regex> = words.into_iter().map(whole).collect();
        says.extend(mistake.says.as_deref().map(pattern));
        Self { says, wrong: mistake.wrong.as_deref().map(pattern) }
    }

    fn names(&self, text: &str) -> bool {
        self.says.iter().any(|s| s.is_match(text)) && !self.wrong.as_ref().is_some_and(|w| w.is_match(text))
    }
}

pub(crate) fn pattern(text: &str) -> Regex {
    RegexBuilder::new(text).case_insensitive(true).build().unwrap_or_else(|e| panic!("{text}: {e}"))
}
