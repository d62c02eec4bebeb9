//! What this machine can do at best: files, memory, products.

use faer::linalg::matmul::matmul;
use faer::{Accum, Mat};
use std::io::Read;
use std::path::Path;
use std::time::Instant;

/// 10⁹ operations a second of products [m, k] · [k, n] in f32 on all cores, the best of five.
pub(super) fn rate(m: usize, k: usize, n: usize) -> f64 {
    let a = Mat::<f32>::from_fn(m, k, |i, j| ((i * 7 + j) % 11) as f32);
    let b = Mat::<f32>::from_fn(k, n, |i, j| ((i * 5 + j) % 13) as f32);
    let mut out = Mat::<f32>::zeros(m, n);
    let secs = (0..5).map(|_| {
        let start = Instant::now();
        matmul(out.as_mut(), Accum::Replace, a.as_ref(), b.as_ref(), 1.0, faer::get_global_parallelism());
        start.elapsed().as_secs_f64()
    });
    2e-9 * (m * k * n) as f64 / secs.fold(f64::INFINITY, f64::min)
}

/// Seconds to read all files of a folder into one buffer, as warm as the system has them.
///
/// # Errors
/// Those of reading.
pub(super) fn plain_read(folder: &Path) -> std::io::Result<f64> {
    let (mut folders, mut buffer, start) = (vec![folder.to_path_buf()], vec![0; 1 << 20], Instant::now());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                folders.push(entry.path());
                continue;
            }
            let mut file = std::fs::File::open(entry.path())?;
            while file.read(&mut buffer)? > 0 {}
        }
    }
    Ok(start.elapsed().as_secs_f64())
}
