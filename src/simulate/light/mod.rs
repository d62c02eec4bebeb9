//! Where light goes inside the slab: the transport solvers, and the continuous field of what leaves it.

pub(crate) mod coefficients;
pub(crate) mod diffusion;
pub(crate) mod field;
pub(crate) mod multigrid;
#[cfg(test)]
mod tests;
