//! What work costs.

use std::time::Instant;

/// Seconds elapsed, and seconds of all processors together.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cost {
    pub(super) elapsed: f64,
    pub(super) processor: f64,
}

/// What `work` gives, and what it costs.
pub(super) fn cost<T>(work: impl FnOnce() -> acquire::Result<T>) -> acquire::Result<(T, Cost)> {
    let (start, before) = (Instant::now(), processor_secs());
    let done = work()?;
    Ok((done, Cost { elapsed: start.elapsed().as_secs_f64(), processor: processor_secs() - before }))
}

/// Time of all threads so far, user and system, in hundredths of a second as Linux counts; 0 elsewhere.
fn processor_secs() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which is in brackets: the 12th and 13th field.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    fields.iter().skip(11).take(2).filter_map(|f| f.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// The middle one of an odd number.
pub(super) fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
