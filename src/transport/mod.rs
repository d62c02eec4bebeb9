//! Matrix: the store R_d(x_i, x_o) on disk, its rows, their shift and normalization.

pub mod arrays;
mod checksum;
mod chunk_grid;
mod chunk_writer;
pub mod common;
mod earlier;
pub mod normalize;
mod open;
mod part;
mod positioned;
mod reader;
mod row_array;
pub mod rows;
mod scratch_rows;
mod store;
mod store_files;
mod whole_chunk;
mod writer;

/// R, G, B.
const CHANNELS: usize = 3;

pub use common::{CommonErrors, CommonOfAll};
pub(crate) use earlier::check as check_matrix;
pub(crate) use part::{Part, PartWriter, RowsAt, check_part, find_parts};
pub use reader::MatrixReader;
pub use store::{MatrixHeader, Row, RowBlock, ShotRecord};
pub use writer::MatrixWriter;
