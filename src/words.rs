//! Numbers of things in messages.

use std::ops::Range;

/// `1 row`, `2 rows`, `2 passes`.
pub(crate) fn count(n: usize, noun: &str) -> String {
    let plural = if noun.ends_with('s') { "es" } else { "s" };
    format!("{n} {noun}{}", if n == 1 { "" } else { plural })
}

/// A figure to four places, or where that is too few, to three digits: `7.5335`, `1.23e-5`.
pub(crate) fn figure(v: f64) -> String {
    if v == 0.0 || (1e-2..1e9).contains(&v.abs()) { format!("{v:.4}") } else { format!("{v:.2e}") }
}

/// `v` with so many significant digits and no exponent: `0.0000123`.
pub(crate) fn plain(v: f64, digits: usize) -> String {
    let exponent = if v == 0.0 || !v.is_finite() { 0 } else { v.abs().log10().floor() as i32 };
    let places = (digits as i32 - 1 - exponent).max(0) as usize;
    format!("{v:.places$}")
}

/// Numbers in rising order as ranges whose ends are not in them.
pub(crate) fn ranges(numbers: &[usize]) -> Vec<Range<usize>> {
    let mut ranges: Vec<Range<usize>> = Vec::new();
    for &n in numbers {
        match ranges.last_mut().filter(|last| last.end == n) {
            Some(last) => last.end += 1,
            None => ranges.push(n..n + 1),
        }
    }
    ranges
}

/// The most things of a list that a message names.
const NAMED: usize = 8;

/// `3..5, 9..10`, of many the first ones and how many of the noun there are.
pub(crate) fn spelled(ranges: &[Range<usize>], noun: &str) -> String {
    let first = ranges.iter().take(NAMED).map(|r| format!("{}..{}", r.start, r.end)).collect::<Vec<_>>().join(", ");
    match ranges.len() > NAMED {
        true => format!("{first}, … ({} in all)", count(ranges.iter().map(Range::len).sum(), noun)),
        false => first,
    }
}

/// `; not used: a.part (it is cut short)`, or nothing.
pub(crate) fn not_used(things: &[String]) -> String {
    let more = if things.len() > NAMED { format!(", and {} more", things.len() - NAMED) } else { String::new() };
    match things.is_empty() {
        true => String::new(),
        false => format!("; not used: {}{more}", things[..things.len().min(NAMED)].join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_number_has_its_digits_and_no_exponent() {
        let found = [0.0182, 0.000_012_34, 123_456.0, -0.5, 0.0].map(|v| plain(v, 3));
        assert_eq!(found, ["0.0182", "0.0000123", "123456", "-0.500", "0.00"]);
    }

    #[test]
    fn numbers_are_ranges_of_which_a_message_names_the_first() {
        let numbers = [0, 1, 2, 5, 7, 8];
        assert_eq!(ranges(&numbers), [0..3, 5..6, 7..9]);
        assert_eq!(spelled(&ranges(&numbers), "shot"), "0..3, 5..6, 7..9");
        let every_other: Vec<usize> = (0..20).step_by(2).collect();
        assert!(spelled(&ranges(&every_other), "shot").ends_with("14..15, … (10 shots in all)"));
        assert_eq!(not_used(&[]), "");
        assert_eq!(not_used(&["a".into(), "b".into()]), "; not used: a, b");
    }

    #[test]
    fn one_thing_is_singular_and_all_other_numbers_are_plural() {
        let said = [count(0, "row"), count(1, "row"), count(2, "row"), count(1, "pass"), count(3, "pass")];
        assert_eq!(said, ["0 rows", "1 row", "2 rows", "1 pass", "3 passes"]);
    }

    #[test]
    fn small_figures_keep_their_digits() {
        assert_eq!([7.5335, 0.0, 1.234e-5, -0.02].map(figure), ["7.5335", "0.0000", "1.23e-5", "-0.0200"]);
    }
}
