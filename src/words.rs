//! Numbers of things in messages.

/// `1 row`, `2 rows`, `2 passes`.
pub(crate) fn count(n: usize, noun: &str) -> String {
    let plural = if noun.ends_with('s') { "es" } else { "s" };
    format!("{n} {noun}{}", if n == 1 { "" } else { plural })
}

#[cfg(test)]
mod tests {
    use super::count;

    #[test]
    fn one_thing_is_singular_and_all_other_numbers_are_plural() {
        let said = [count(0, "row"), count(1, "row"), count(2, "row"), count(1, "pass"), count(3, "pass")];
        assert_eq!(said, ["0 rows", "1 row", "2 rows", "1 pass", "3 passes"]);
    }
}
