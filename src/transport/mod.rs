//! Matrix: the store R_d(x_i, x_o) on disk, its rows, their shift and normalization.

mod checksum;
mod earlier;
pub mod normalize;
mod positioned;
pub mod rows;
mod store;

pub(crate) use earlier::check as check_matrix;
pub use store::{MatrixHeader, MatrixReader, MatrixWriter, Row, RowBlock, ShotRecord};
