//! Numbers of things in messages.

/// `1 row`, `2 rows`, `2 passes`.
pub(crate) fn count(n: usize, noun: &str) -> String {
    let plural = if noun.ends_with('s') { "es" } else { "s" };
    format!("{n} {noun}{}", if n == 1 { "" } else { plural })
}

/// A figure to four places, or where that is too few, to three digits: `7.5335`, `1.23e-5`.
pub(crate) fn figure(v: f64) -> String {
    if v == 0.0 || (1e-2..1e9).contains(&v.abs()) { format!("{v:.4}") } else { format!("{v:.2e}") }
}

#[cfg(test)]
mod tests {
    use super::{count, figure};

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
