//! Matrix: the store R_d(x_i, x_o) on disk, and the way there from a capture.

mod build;
pub mod normalize;
pub mod rows;
mod store;

pub use build::{BuildOptions, BuildReport, Overview, build_matrix};
pub use store::{MatrixHeader, MatrixReader, MatrixWriter, Row, RowBlock, ShotRecord};
