//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.

mod curve;
mod exposures;
mod merge;
mod sensor;
mod shot;

pub use curve::{Curve, CurveEstimate, CurveOptions, LightSum, estimate_curve};
pub(crate) use exposures::{evenly, solve, take};
pub use exposures::{ExposureFit, Stack, StackScales, fit_exposures, pick_pixels, stack_scales};
pub use merge::{Exposure, Radiance, merge};
pub use sensor::{FileNoise, Sensor};
pub use shot::{Bracket, decode_shot};
