//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.
//!
//! The main way: [`Capture::open`](crate::capture::Capture::open) finds the photographs of each shot, sorted by
//! exposure; [`Photograph::decode`](crate::capture::Photograph::decode) gives their code values; [`Sensor::with_curve`]
//! is what relates these to light; [`merge`] makes [`Radiance`] of both. `examples/merge_bracket.rs` is a program of 60
//! lines that does this for one pixel.

mod agreement;
mod curve;
mod exposures;
mod hot_pixels;
mod merge;
mod noise;
mod sensor;
mod shot;
mod stray;

pub use agreement::{Brightness, Disagreement, disagreements, pile_up};
pub use curve::{Curve, CurveEstimate, CurveOptions, LightSum, estimate_curve};
pub use exposures::{ExposureFit, MOST_FLICKER, Stack, StackScales, fit_exposures, pick_pixels, stack_scales};
pub(crate) use exposures::{evenly, take};
pub use hot_pixels::{HotPixel, find_hot_pixels, mend};
pub use merge::{Exposure, Radiance, merge};
pub use noise::{
    Block, BlockGrid, DarkLevels, NoiseEstimate, black_level, blocks, channel_gains, clipping_code, fit, saturation,
};
pub use sensor::{FileNoise, Sensor};
pub use shot::{Bracket, decode_shot, decode_spread, merge_keeping, merge_shot};
pub use stray::{Halo, StrayLight};
