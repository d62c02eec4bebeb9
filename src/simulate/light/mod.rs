//! Where light goes inside the slab: the transport solvers, and the continuous field of what leaves it.

pub(crate) mod beam;
pub(crate) mod coefficients;
#[cfg(test)]
mod depth_tests;
pub(crate) mod diffusion;
pub(crate) mod domain;
pub(crate) mod dots;
pub(crate) mod field;
mod first_flights;
#[cfg(test)]
mod flight_tests;
mod fresnel;
mod last_flight;
pub mod monte_carlo;
pub(crate) mod multigrid;
mod sight;
pub(crate) mod solution;
#[cfg(test)]
mod tests;
pub(crate) mod validity;
