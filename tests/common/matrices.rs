//! Small matrices written to disk for tests of factorizations, and what is made of them.
#![allow(dead_code)]

use acquire::Result;
use acquire::factor::{FactorOptions, Factored, factor};
use acquire::material::{self, Material, Model, Precision};
use acquire::progress::Progress;
use acquire::transport::{MatrixHeader, MatrixReader, MatrixWriter, Row};
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use std::path::Path;

/// The header of a matrix with samples of half a millimetre, lit points `lit_pitch_mm` apart at known places, and
/// nothing else known.
pub(crate) fn header(points: [usize; 2], window: [usize; 2], lit_pitch_mm: [f64; 2]) -> MatrixHeader {
    let rows = points[0] * points[1];
    let place = |i: usize| [(i % points[0]) as f64 * lit_pitch_mm[0], (i / points[0]) as f64 * lit_pitch_mm[1]];
    MatrixHeader {
        points,
        window,
        pitch_mm: 0.5,
        lit_pitch_mm,
        lit_mm: (0..rows).map(place).collect(),
        position_sd_mm: vec![0.0; rows],
        shot_of: vec![None; rows],
        common: None,
        shots: Vec::new(),
        camera_px_per_mm: None,
        warnings: Vec::new(),
        provenance: serde_json::json!({}),
    }
}

/// A matrix of `points` rows: `response(index, [dx, dy] in samples from the lit point, channel)`.
pub(crate) fn write(
    path: &Path,
    points: [usize; 2],
    window: [usize; 2],
    variance: impl Fn([f64; 2], usize) -> f32,
    position_sd_mm: f64,
    response: impl Fn(usize, [f64; 2], usize) -> f32,
) -> Result<MatrixReader> {
    let rows = points[0] * points[1];
    let header = MatrixHeader { position_sd_mm: vec![position_sd_mm; rows], ..header(points, window, [0.5; 2]) };
    let writer = MatrixWriter::create(path, header.clone())?;
    for index in 0..rows {
        let offset = |k: usize| header.offset_px([k / 3 % window[0], k / 3 / window[0]]).map(|o| o as f64);
        let n = header.row_len();
        let row = Row {
            response: (0..n).map(|k| response(index, offset(k), k % 3)).collect(),
            variance: (0..n).map(|k| variance(offset(k), k % 3)).collect(),
            valid: vec![true; n],
        };
        writer.put(index, &row)?;
    }
    writer.finish()?;
    MatrixReader::open(path)
}

pub(crate) fn run(
    options: &FactorOptions,
    points: [usize; 2],
    window: [usize; 2],
    response: impl Fn(usize, [f64; 2], usize) -> f32,
) -> Result<Factored> {
    let folder = tempfile::tempdir().unwrap();
    let reader = write(&folder.path().join("m.rd.zarr"), points, window, |_, _| 0.0, 0.0, response)?;
    let factored = factor(&reader, options, &Progress::silent())?;
    // Whatever comes out can be stored and comes back.
    let path = folder.path().join("m.safetensors");
    material::save(&factored.material, Precision::F32, &path)?;
    assert_eq!(Material::load(&path)?.weights, factored.material.weights);
    Ok(factored)
}

pub(crate) fn profile([x, y]: [f64; 2], width: f64) -> f64 {
    (-(x * x + y * y).sqrt() / width).exp()
}

pub(crate) fn noise(index: usize, d: [f64; 2], c: usize) -> f64 {
    let seed = (index as u64) << 32 | ((d[0] + 500.0) as u64) << 18 | ((d[1] + 500.0) as u64) << 4 | c as u64;
    StandardNormal.sample(&mut rand_pcg::Pcg64::seed_from_u64(seed))
}

pub(crate) fn fixed(terms: usize, degree: usize) -> FactorOptions {
    FactorOptions { terms: Some(terms), degree: Some(degree), ..tucker() }
}

/// The paper's model, its terms and degree chosen from the noise.
pub(crate) fn tucker() -> FactorOptions {
    FactorOptions { model: Some(Model::Tucker), ..FactorOptions::default() }
}
