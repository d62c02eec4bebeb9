//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.

mod hot_pixels;
mod merge;
mod noise;
mod sensor;
mod shot;
mod stray;

pub use hot_pixels::{HotPixel, find_hot_pixels, mend};
pub use merge::{Exposure, Radiance, merge};
pub use noise::{Block, DarkLevels, Grid, NoiseEstimate, black_level, blocks, clipping_code, fit, saturation};
pub use sensor::Sensor;
pub use shot::{Bracket, decode_shot};
pub use stray::{Halo, StrayLight};
