//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.

mod merge;
mod sensor;
mod shot;
mod stray;

pub use merge::{Exposure, Radiance, merge};
pub use sensor::Sensor;
pub use shot::{Bracket, decode_shot};
pub use stray::{Halo, StrayLight};
