//! A matrix or a material, told apart by what is on disk, and read the same way.

use super::{Material, Responses, Shape};
use crate::files::is_url;
use crate::transport::{MatrixReader, RowBlock};
use crate::{Error, Result};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// Numbers in a block of a material's rows, as many as fit a block of a matrix.
const MATERIAL_BLOCK: usize = 2 << 20;

/// Where rows come from.
#[derive(Debug)]
pub enum Source {
    /// Measured or simulated rows.
    Matrix(Box<MatrixReader>),
    /// Rows evaluated from factors.
    Material(Box<Material>, PathBuf),
}

impl Source {
    /// Opens either: a folder is a matrix, a URL too, and a file a material.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::BrokenMatrix`], [`Error::BrokenMaterial`].
    pub fn open(path: &Path) -> Result<Self> {
        let is_folder = || std::fs::metadata(path).map(|kind| kind.is_dir()).map_err(Error::io("read", path));
        match is_url(path) || is_folder()? {
            true => Ok(Self::Matrix(Box::new(MatrixReader::open(path)?))),
            false => Ok(Self::Material(Box::new(super::load(path)?), path.to_path_buf())),
        }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        match self {
            Self::Matrix(reader) => reader.path(),
            Self::Material(_, path) => path,
        }
    }

    /// Points, window, pitches.
    pub fn shape(&self) -> Shape<'_> {
        match self {
            Self::Matrix(reader) => reader.shape(),
            Self::Material(material, _) => material.shape(),
        }
    }

    /// Consecutive rows. A material's are all valid and have no variance.
    ///
    /// # Errors
    /// Those of [`MatrixReader::read`].
    pub fn read(&self, rows: Range<usize>) -> Result<RowBlock> {
        match self {
            Self::Matrix(reader) => reader.read(rows),
            Self::Material(material, _) => {
                let indices: Vec<usize> = rows.clone().collect();
                let n = indices.len() * material.header.row_len();
                let mut response = vec![0.0; n];
                Responses::new(material).interleaved(&indices, &mut response);
                let (variance, valid) = (vec![0.0; n], vec![1; n]);
                Ok(RowBlock { first: rows.start, rows: rows.len(), response, variance, valid })
            }
        }
    }

    /// Consecutive ranges of rows that together are all rows, in order, and quick to [`Self::read`].
    pub fn blocks(&self) -> Vec<Range<usize>> {
        match self {
            Self::Matrix(reader) => reader.blocks(),
            Self::Material(material, _) => {
                let rows = material.header.rows();
                let step = (MATERIAL_BLOCK / material.header.row_len().max(1)).max(1);
                (0..rows).step_by(step).map(|first| first..(first + step).min(rows)).collect()
            }
        }
    }

    /// Bytes on disk, the whole folder of a matrix.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn bytes_file(&self) -> Result<u64> {
        match self {
            Self::Matrix(reader) => reader.bytes_file(),
            Self::Material(_, path) => Ok(std::fs::metadata(path).map_err(Error::io("read", path))?.len()),
        }
    }

    /// Every stored number as 4 bytes: all responses of a matrix, see [`Material::bytes_f32`] for a material.
    pub fn bytes_f32(&self) -> u64 {
        match self {
            Self::Matrix(reader) => 4 * (reader.header().rows() * reader.header().row_len()) as u64,
            Self::Material(material, _) => material.bytes_f32(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::naive;
    use super::*;

    #[test]
    fn rows_of_a_material_are_read_in_order_and_are_all_valid() {
        let m = naive::materials().remove(0);
        let source = Source::Material(Box::new(m.clone()), "m".into());
        let block = source.read(4..7).unwrap();
        assert_eq!((block.first, block.rows), (4, 3));
        assert!(block.valid.iter().all(|&v| v == 1) && block.variance.iter().all(|&v| v == 0.0));
        for (s, value) in block.response.iter().enumerate() {
            let (i, k, c) = (4 + s / 105, s % 105 / 3, s % 3);
            let d = [(k % 7) as isize - 3, (k / 7) as isize - 2];
            let expected = naive::response(&m, i, d).unwrap()[c];
            assert!((f64::from(*value) - expected).abs() < 1e-6, "f32, row {i} {d:?}: {value} {expected}");
        }
        let shape = source.shape();
        assert_eq!((shape.points, shape.window, shape.rows()), ([5, 3], [7, 5], 15));
        assert_eq!((shape.pitch_mm, shape.lit_pitch_mm, shape.lit_mm), (0.5, [0.75, 1.0], m.lit_mm.as_slice()));
        assert_eq!(source.bytes_f32(), m.bytes_f32());
    }

    #[test]
    fn blocks_of_a_material_are_all_its_rows_once() {
        let mut m = naive::materials().remove(0);
        // 2 Mi numbers a block, 105 a row: 19972 rows.
        m.header.points = [199, 201];
        let blocks = Source::Material(Box::new(m), "m".into()).blocks();
        assert_eq!(blocks, [0..19_972, 19_972..39_944, 39_944..39_999]);
    }
}
