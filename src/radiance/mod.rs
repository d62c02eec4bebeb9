//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.

mod curve;
mod exposures;
mod hot_pixels;
mod merge;
mod noise;
mod sensor;
mod shot;
mod stray;

pub use curve::{Curve, CurveEstimate, CurveOptions, LightSum, estimate_curve};
pub use exposures::{ExposureFit, Stack, StackScales, fit_exposures, pick_pixels, stack_scales};
pub(crate) use exposures::{evenly, take};
pub use hot_pixels::{HotPixel, find_hot_pixels, mend};
pub use merge::{Exposure, Radiance, merge};
pub use noise::{Block, DarkLevels, Grid, NoiseEstimate, black_level, blocks, clipping_code, fit, saturation};
pub use sensor::{FileNoise, Sensor};
pub use shot::{Bracket, decode_shot, decode_spread, merge_shot};
pub use stray::{Halo, StrayLight};
