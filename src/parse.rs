//! Numbers as people write them on the command line.

/// One number for both axes, or two as 30x20.
pub(crate) fn pair_of<T: std::str::FromStr + Copy>(text: &str) -> Result<[T; 2], String> {
    let one = |t: &str| t.trim().parse().map_err(|_| format!("a number or two as 30x20, not {text:?}"));
    match text.split_once(['x', '×', ',']) {
        Some((x, y)) => Ok([one(x)?, one(y)?]),
        None => one(text).map(|v| [v; 2]),
    }
}

/// Seconds, also as a fraction: 1/250.
pub(crate) fn secs(text: &str) -> Result<f64, String> {
    let number = |t: &str| t.trim().parse::<f64>().map_err(|_| format!("seconds as 0.004 or 1/250, not {text:?}"));
    match text.split_once('/') {
        Some((above, below)) => Ok(number(above)? / number(below)?),
        None => number(text),
    }
}

/// A whole number, also as 1e6.
pub(crate) fn whole(text: &str) -> Result<u64, String> {
    let number: f64 = text.parse().map_err(|_| "a number such as 100000 or 1e6".to_owned())?;
    if number.fract() == 0.0 && (0.0..1e15).contains(&number) {
        Ok(number as u64)
    } else {
        Err("a whole number".into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_times_are_read_as_people_write_them() {
        assert_eq!(pair_of::<f64>("20"), Ok([20.0, 20.0]));
        assert_eq!(pair_of::<usize>("40x30"), Ok([40, 30]));
        assert_eq!(pair_of::<f64>("5x-3"), Ok([5.0, -3.0]));
        assert!(pair_of::<usize>("40x").is_err() && pair_of::<usize>("-1").is_err());
        assert_eq!((secs("1/250"), secs("0.5")), (Ok(0.004), Ok(0.5)));
        assert!(secs("1/").is_err() && secs("fast").is_err());
        assert_eq!(whole("1e6"), Ok(1_000_000));
        for wrong in ["1.5", "-3", "many", "1e20"] {
            assert!(whole(wrong).is_err(), "{wrong}");
        }
    }
}
