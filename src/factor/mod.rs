//! Factor: the matrix, streamed, to a compact material.

mod color;
mod fill;
mod noise;
mod survey;
mod svd;
mod tucker;

pub use svd::Backend;
pub use tucker::{Factored, Options, factor};
