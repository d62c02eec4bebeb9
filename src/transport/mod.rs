//! Matrix: the store R_d(x_i, x_o) on disk, its rows, their shift and normalization.

pub mod arrays;
pub mod normalize;
mod open;
mod positioned;
mod row_array;
pub mod rows;
mod store;

/// R, G, B.
const CHANNELS: usize = 3;

pub use store::{MatrixHeader, MatrixReader, MatrixWriter, Row, RowBlock, ShotRecord};
