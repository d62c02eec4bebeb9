//! Random matrices.

use super::*;

/// A matrix in memory.
#[derive(Debug, Clone)]
pub(crate) struct Matrix {
    pub header: MatrixHeader,
    pub rows: Vec<Row>,
}

/// A matrix on disk.
pub(crate) struct Stored {
    _folder: tempfile::TempDir,
    pub reader: MatrixReader,
}

/// Of a window's numbers: the sample along x and y, and the channel.
pub(crate) fn place(k: usize, window: [usize; 2]) -> ([usize; 2], usize) {
    ([k / 3 % window[0], k / 3 / window[0]], k % 3)
}

impl Matrix {
    /// `response(row, sample, channel)`, without variance, all measured; points stand at every second sample along x
    /// and every third along y.
    pub(crate) fn of(
        points: [usize; 2],
        window: [usize; 2],
        mut response: impl FnMut(usize, [usize; 2], usize) -> f64,
    ) -> Self {
        let (n, header) = (points[0] * points[1], matrices::header(points, window, [1.0, 1.5]));
        let len = header.row_len();
        let mut row = |i| Row {
            response: (0..len)
                .map(|k| {
                    let (sample, c) = place(k, window);
                    response(i, sample, c) as f32
                })
                .collect(),
            variance: vec![0.0; len],
            valid: vec![true; len],
        };
        Self { rows: (0..n).map(&mut row).collect(), header }
    }

    /// Bells of three widths, each point and channel with its own amounts of them, a twentieth of noise; of some rows
    /// the peak is displaced.
    pub(crate) fn coloured(case: Case) -> Self {
        let mut draw = Draw::new(case.seed);
        let n = case.points[0] * case.points[1];
        let amounts: Vec<[[f64; 3]; 3]> = (0..n).map(|_| [0; 3].map(|_| [0; 3].map(|_| 0.2 + draw.unit()))).collect();
        let peaks: Vec<[f64; 2]> = (0..n).map(|_| [0; 2].map(|_| [-1.0, 0.0, 0.0, 1.0][draw.below(4)])).collect();
        Self::of(case.points, case.window, |i, s, c| {
            let d = [0, 1].map(|a| s[a] as f64 - (case.window[a] / 2) as f64 - peaks[i][a]);
            let bell = |width: f64| (-(d[0] * d[0] + d[1] * d[1]) / (2.0 * width * width)).exp();
            let smooth: f64 = (0..3).map(|j| amounts[i][c][j] * bell([0.6, 1.2, 3.0][j])).sum();
            smooth * (1.0 + 0.05 * draw.signed())
        })
    }

    /// Takes out single entries, all of some rows, and makes some rows zero.
    pub(crate) fn with_gaps(mut self, seed: u64) -> Self {
        let mut draw = Draw::new(seed ^ 1);
        for row in &mut self.rows {
            let (unlit, zero) = (draw.chance(0.05), draw.chance(0.1));
            for (valid, v) in row.valid.iter_mut().zip(&mut row.response) {
                *valid = !unlit && !draw.chance(0.05);
                if zero || !*valid {
                    *v = 0.0;
                }
            }
        }
        self
    }

    pub(crate) fn scaled(mut self, scale: f64) -> Self {
        self.rows.iter_mut().flat_map(|r| &mut r.response).for_each(|v| *v = (f64::from(*v) * scale) as f32);
        self.rows.iter_mut().flat_map(|r| &mut r.variance).for_each(|v| *v = (f64::from(*v) * scale * scale) as f32);
        self
    }

    pub(crate) fn stored(&self) -> Stored {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.rd.zarr");
        let writer = MatrixWriter::create(&path, self.header.clone()).unwrap();
        self.rows.iter().enumerate().for_each(|(i, row)| writer.put(i, row).unwrap());
        writer.finish().unwrap();
        Stored { reader: MatrixReader::open(&path).unwrap(), _folder: folder }
    }

    pub(crate) fn factored(&self, options: &FactorOptions) -> Factored {
        factor(&self.stored().reader, options, &Progress::silent()).unwrap()
    }

    /// Σ of squares over measured entries.
    pub(crate) fn energy(&self) -> f64 {
        self.error(&vec![vec![0.0; self.header.row_len()]; self.rows.len()])
    }

    /// Σ of squared differences from it, over measured entries.
    pub(crate) fn error(&self, fit: &[Vec<f32>]) -> f64 {
        let one = |(row, fit): (&Row, &Vec<f32>)| -> f64 {
            let entries = row.response.iter().zip(fit).zip(&row.valid).filter(|(_, v)| **v);
            entries.map(|((&a, &b), _)| (f64::from(a) - f64::from(b)).powi(2)).sum()
        };
        self.rows.iter().zip(fit).map(one).sum()
    }

    /// Rows of `points` points from `first` on, the middle `window` of each.
    pub(crate) fn crop(&self, first: [usize; 2], points: [usize; 2], window: [usize; 2]) -> Self {
        let cropped = |rows: &dyn Fn(usize) -> Vec<f32>| crop(&self.header, rows, first, points, window);
        let mut out = Self::of(points, window, |_, _, _| 0.0);
        let response = cropped(&|i| self.rows[i].response.clone());
        let valid = cropped(&|i| self.rows[i].valid.iter().map(|&v| f32::from(u8::from(v))).collect());
        for ((row, response), valid) in out.rows.iter_mut().zip(response).zip(valid) {
            (row.response, row.valid) = (response, valid.iter().map(|&v| v == 1.0).collect());
        }
        out
    }
}

pub(crate) fn crop(
    header: &MatrixHeader,
    rows: impl Fn(usize) -> Vec<f32>,
    first: [usize; 2],
    points: [usize; 2],
    window: [usize; 2],
) -> Vec<Vec<f32>> {
    let rim = [0, 1].map(|a| (header.window[a] - window[a]) / 2);
    let row = |i: usize| {
        let from = rows(first[0] + i % points[0] + (first[1] + i / points[0]) * header.points[0]);
        let entry = |k| {
            let ([x, y], c) = place(k, window);
            from[(x + rim[0] + (y + rim[1]) * header.window[0]) * 3 + c]
        };
        (0..window[0] * window[1] * 3).map(entry).collect()
    };
    (0..points[0] * points[1]).map(row).collect()
}
