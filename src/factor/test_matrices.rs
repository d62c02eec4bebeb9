//! Small matrices on disk and small solves for the tests of this folder.

use crate::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row};

/// A matrix and the folder that it lives in.
pub(super) struct StoredMatrix {
    pub reader: MatrixReader,
    _folder: tempfile::TempDir,
}

/// Writes the rows that `row(index)` makes; `position_sd_mm(index)` is how well the lit point is known.
pub(super) fn stored(
    points: [usize; 2],
    window: [usize; 2],
    position_sd_mm: impl Fn(usize) -> f64,
    row: impl Fn(usize) -> Row,
) -> StoredMatrix {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.rd.zarr");
    let rows = points[0] * points[1];
    let header = MatrixHeader {
        points,
        window,
        pitch_mm: 0.25,
        lit_pitch_mm: [0.5, 0.75],
        lit_mm: (0..rows).map(|i| [(i % points[0]) as f64 * 0.5, (i / points[0]) as f64 * 0.75]).collect(),
        position_sd_mm: (0..rows).map(position_sd_mm).collect(),
        shot_of: vec![None; rows],
        common: None,
        shots: Vec::new(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: serde_json::Value::Null,
    };
    let writer = MatrixWriter::create(&path, header).unwrap();
    (0..rows).for_each(|i| writer.put(i, &row(i)).unwrap());
    writer.finish().unwrap();
    StoredMatrix { reader: MatrixReader::open(&path).unwrap(), _folder: folder }
}

/// Solves a x = b by Gaussian elimination with partial pivoting.
pub(super) fn solved(mut a: Vec<Vec<f64>>, mut b: Vec<f64>) -> Vec<f64> {
    let n = b.len();
    for k in 0..n {
        let pivot = (k..n).max_by(|&i, &j| a[i][k].abs().total_cmp(&a[j][k].abs())).unwrap();
        a.swap(k, pivot);
        b.swap(k, pivot);
        for i in k + 1..n {
            let factor = a[i][k] / a[k][k];
            (k..n).for_each(|j| a[i][j] -= factor * a[k][j]);
            b[i] -= factor * b[k];
        }
    }
    let mut x = vec![0.0; n];
    for k in (0..n).rev() {
        x[k] = (b[k] - (k + 1..n).map(|j| a[k][j] * x[j]).sum::<f64>()) / a[k][k];
    }
    x
}
