//! Merge: the exposures of one shot to linear radiance, its variance and a validity mask.

mod cholesky;
mod curve;
mod exposures;
mod merge;
mod sensor;
mod shot;

pub(crate) use cholesky::solve;
pub use curve::{Curve, CurveEstimate, CurveOptions, LightSum, estimate_curve};
pub use exposures::{ExposureFit, Stack, StackScales, fit_exposures, pick_pixels, stack_scales};
pub(crate) use exposures::{evenly, take};
pub use merge::{Exposure, Radiance, merge};
pub use sensor::{FileNoise, Sensor};
pub use shot::{Bracket, decode_shot};
