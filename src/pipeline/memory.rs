//! How many shots can be worked on at once in so much memory.

use super::Working;
use crate::capture::{Capture, Pattern, Photograph};
use crate::{Error, Result};

/// Program, libraries, the matrix's writer, bytes. Measured: 40 to 60 MB for captures of small pictures.
const PROGRAM: u64 = 64 << 20;
/// What the pictures that all shots share take, bytes a pixel of the working resolution: ambient light, the white
/// reference and what is made of it (27 each: value, variance and count of three channels), the board's, and room for
/// one that is being made.
const SHARED_PER_PX: u64 = 5 * 27;
/// Of a bit of the Gray code: pattern, inverse, whether it counts.
const BIT_PER_PX: u64 = 9;
/// Of each thread: two merged pictures, or the windows of a shot before and after merging.
const MERGED_PER_PX: u64 = 2 * 27;
/// The board in its finer resolution, merged and searched: value, variance and count of 4 megapixels, and what OpenCV
/// makes of them.
const FINE: u64 = 160 << 20;
/// Code values in floating point.
const CODES_PER_PX: u64 = 12;
/// The tiles in which noise is looked for, of two photographs, and decoders' buffers.
const THREAD: u64 = 40 << 20;

/// Of photographs that several stages read: of 24 megapixels 113 in blocks of 9 × 9, of 0.5 megapixels 134 as they are.
const KEPT: u64 = 384 << 20;

/// Lets photographs be kept while the working resolution is not known; where memory is bounded, none.
pub(super) fn keep_before(capture: &Capture, memory_bytes: Option<u64>) {
    capture.kept().allow(if memory_bytes.is_none() { KEPT as usize } else { 0 });
}

/// Threads that fit into `memory_bytes`, of `threads`; photographs are kept in what is left.
///
/// # Errors
/// Those of [`threads`].
pub(super) fn share(
    capture: &Capture,
    working: Working,
    memory_bytes: Option<u64>,
    most_threads: usize,
) -> Result<usize> {
    let (threads, left) = match memory_bytes {
        None => (most_threads, KEPT),
        Some(bytes) => {
            let (threads, need) = (threads(capture, working, bytes, most_threads)?, Need::of(capture, working));
            (threads, (bytes - need.shared - threads as u64 * need.thread).min(KEPT))
        }
    };
    let kept = capture.kept();
    if working.factor > 1 {
        // As they were taken nobody reads them again.
        kept.forget();
    }
    kept.allow(left as usize);
    Ok(threads)
}

/// Threads that fit into `memory_bytes`, of `threads`.
///
/// An upper bound: windows are taken for the whole picture.
///
/// # Errors
/// [`Error::Setting`] with the least memory in which one works.
fn threads(capture: &Capture, working: Working, memory_bytes: u64, threads: usize) -> Result<usize> {
    let need = Need::of(capture, working);
    let fits = memory_bytes.saturating_sub(need.shared) / need.thread;
    if fits == 0 {
        let mib = |bytes: u64| format!("{} MiB", bytes.div_ceil(1 << 20));
        let expected =
            format!("{} or more, which one thread needs for these photographs", mib(need.shared + need.thread));
        return Err(Error::Setting { setting: "memory", expected, found: mib(memory_bytes) });
    }
    Ok(threads.min(fits as usize))
}

/// Bytes.
#[derive(Debug, PartialEq)]
struct Need {
    shared: u64,
    thread: u64,
}

impl Need {
    fn of(capture: &Capture, working: Working) -> Self {
        let exposures = capture.brackets.iter().map(Vec::len).max().unwrap_or(1) as u64;
        let bits = capture.shots(|p| matches!(p, Pattern::GrayCode { inverse: false, .. })).len() as u64;
        let full_px: u64 = capture.rig.camera.size_px.iter().map(|&s| s as u64).product();
        let px = full_px / (working.factor * working.factor) as u64;
        // Decoded whole, exposures that are not reduced stay until they are merged.
        let whole = match capture.brackets.iter().flatten().next() {
            Some(first) => whole_bytes_per_px(first) * full_px * if working.factor > 1 { 1 } else { exposures },
            None => 0,
        };
        Self {
            shared: PROGRAM + FINE.min(full_px * 40) + px * (SHARED_PER_PX + BIT_PER_PX * bits),
            thread: THREAD + px * (MERGED_PER_PX + CODES_PER_PX * exposures) + whole,
        }
    }
}

/// Bytes a pixel of photographs that no format gives by rows; 0 for those that come by rows.
fn whole_bytes_per_px(photograph: &Photograph) -> u64 {
    let ending = photograph.path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    match &*ending {
        "png" | "tif" | "tiff" => 0,
        // The file and the code values.
        "jpg" | "jpeg" => 4,
        _ => 14,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::capture;
    use super::*;

    fn bench() -> Capture {
        let mut capture = capture(&[(Pattern::SampleBlack, &[0.1, 0.2, 0.4]), (Pattern::Board, &[0.1])]);
        capture.rig.camera.size_px = [9000, 7000];
        capture
    }

    fn working(factor: usize) -> Working {
        Working { factor, px_per_sample: None }
    }

    #[test]
    fn as_many_threads_work_as_fit_and_the_least_memory_is_told_to_people_who_gave_less() {
        let (capture, working) = (bench(), working(6));
        let need = Need::of(&capture, working);
        // 1.75 million pixels: 135 bytes for all, 54 and three exposures of 12 for each thread.
        assert_eq!(need, Need { shared: (224 << 20) + 1_750_000 * 135, thread: (40 << 20) + 1_750_000 * 90 });
        let of = |memory| threads(&capture, working, memory, 8);
        assert_eq!(of(1 << 40).unwrap(), 8);
        assert_eq!(of(need.shared + 3 * need.thread).unwrap(), 3);
        assert_eq!(of(need.shared + need.thread).unwrap(), 1);
        let Err(Error::Setting { setting, expected, found }) = of(need.shared + need.thread - 1) else {
            panic!("a byte too little")
        };
        // 471,131,024 and 199,443,040 bytes.
        assert_eq!((setting, &*found), ("memory", "640 MiB"));
        assert!(expected.starts_with("640 MiB or more"), "{expected}");
    }

    #[test]
    fn what_is_decoded_as_a_whole_counts_as_a_whole() {
        let mut capture = bench();
        let by_rows = [1, 6].map(|n| Need::of(&capture, working(n)).thread);
        capture.brackets.iter_mut().flatten().for_each(|p| p.path = "a.JPG".into());
        let whole = [1, 6].map(|n| Need::of(&capture, working(n)).thread);
        // All three exposures where they are not reduced, one at a time where they are.
        assert_eq!([whole[0] - by_rows[0], whole[1] - by_rows[1]], [3 * 4 * 63_000_000, 4 * 63_000_000]);
    }
}
