//! How fast memory is read.

use rayon::prelude::*;
use std::hint::black_box;
use std::time::Instant;

/// 10⁹ bytes a second that all cores together read from memory, the best of five.
pub(super) fn memory_rate() -> f64 {
    const NUMBERS: usize = 1 << 26;
    let numbers = vec![1_u64; NUMBERS];
    let secs = (0..5).map(|_| {
        let start = Instant::now();
        let sum: u64 = numbers.par_chunks(1 << 16).map(|part| part.iter().sum::<u64>()).sum();
        black_box(sum);
        start.elapsed().as_secs_f64()
    });
    8e-9 * NUMBERS as f64 / secs.fold(f64::INFINITY, f64::min)
}
