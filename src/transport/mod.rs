//! Matrix: the store R_d(x_i, x_o) on disk, its rows, their shift and normalization.

pub mod normalize;
mod positioned;
pub mod rows;
mod store;

pub use store::{MatrixHeader, MatrixReader, MatrixWriter, Row, RowBlock, ShotRecord};
