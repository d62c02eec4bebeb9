//! Matrix: the store R_d(x_i, x_o) on disk.

mod store;

pub use store::{MatrixHeader, MatrixReader, MatrixWriter, Row, RowBlock, ShotRecord};
