//! Words and numbers of the page.

/// `text` made safe inside HTML, SVG and their attributes.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // Control characters have no place in HTML and would end a page for strict readers.
            c if c.is_control() && c != '\n' => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// `v` with `digits` significant digits, as 1.23 × 10⁻⁵ when it is very small or large.
pub(crate) fn significant(v: f64, digits: usize) -> String {
    if v == 0.0 || !v.is_finite() {
        return format!("{v}");
    }
    // Rounding first: 9.996 with three digits has one more place before the point than it seems.
    let scientific = format!("{v:.*e}", digits.saturating_sub(1));
    let (mantissa, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    if (-4..6).contains(&exponent) {
        let places = (digits as i32 - 1 - exponent).max(0) as usize;
        return minus(&format!("{v:.places$}"));
    }
    minus(&format!("{mantissa} × 10{}", superscript(exponent)))
}

/// A label on an axis.
pub(crate) fn tick(v: f64, log: bool) -> String {
    if log {
        return format!("10{}", superscript(v.log10().round() as i32));
    }
    // Ticks are multiples of 1, 2 or 5 times a power of ten; rounding removes the noise of their sum.
    minus(&format!("{}", (v * 1e9).round() / 1e9))
}

/// A size in bytes, in powers of 1000.
pub(crate) fn bytes(n: u64) -> String {
    let v = n as f64;
    match n {
        0..1_000 => format!("{n} B"),
        1_000..1_000_000 => format!("{} kB", significant(v / 1e3, 3)),
        1_000_000..1_000_000_000 => format!("{} MB", significant(v / 1e6, 3)),
        _ => format!("{} GB", significant(v / 1e9, 3)),
    }
}

/// A duration.
pub(crate) fn seconds(secs: f64) -> String {
    if secs < 1.0 {
        format!("{:.0} ms", secs * 1e3)
    } else if secs < 100.0 {
        format!("{secs:.1} s")
    } else {
        format!("{:.0} min {:.0} s", (secs / 60.0).floor(), secs % 60.0)
    }
}

fn minus(text: &str) -> String {
    text.replace('-', "−")
}

fn superscript(n: i32) -> String {
    let digit = |c: char| match c {
        '-' => '⁻',
        '1' => '¹',
        '2' => '²',
        '3' => '³',
        c => char::from_u32('⁰' as u32 + c.to_digit(10).unwrap_or(0)).unwrap_or('⁰'),
    };
    n.to_string().chars().map(digit).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_as_people_write_them() {
        assert_eq!(significant(0.012345, 3), "0.0123");
        assert_eq!(significant(9.996, 3), "10.0");
        assert_eq!(significant(-41.23, 3), "−41.2");
        assert_eq!(significant(1.5e-7, 2), "1.5 × 10⁻⁷");
        assert_eq!((tick(0.30000000000000004, false), tick(1e-3, true)), ("0.3".into(), "10⁻³".into()));
        assert_eq!(
            (bytes(999), bytes(58_400), bytes(10_200_000)),
            ("999 B".into(), "58.4 kB".into(), "10.2 MB".into())
        );
        assert_eq!(
            (seconds(0.0123), seconds(12.34), seconds(125.0)),
            ("12 ms".into(), "12.3 s".into(), "2 min 5 s".into())
        );
    }

    #[test]
    fn names_cannot_write_markup() {
        assert_eq!(escape("<b a='1'>\"&\u{7}"), "&lt;b a=&#39;1&#39;&gt;&quot;&amp;\u{fffd}");
    }
}
