//! From bracketed photographs of a projector-lit slab to the subsurface-scattering matrix R_d(x_i, x_o) and a factored material.
//!
//! The modules are the way of the photographs, in this order; each depends only on those above it.

mod error;
mod warning;

pub mod geometry;
pub mod progress;

pub mod capture;
pub mod factor;
pub mod material;
pub mod radiance;
pub mod registration;
pub mod response;
pub mod transport;

pub mod evaluate;
pub mod report;
pub mod simulate;

pub mod cli;

pub use error::{Error, Result};
pub use warning::Warning;
