//! Planes and lenses: where a point of the slab appears in the camera, and where a projector pixel lands on the slab.
//!
//! # Conventions
//! - Slab: millimetres, origin at the top left corner of the sample as the camera sees it, x right, y down.
//! - Camera and projector: pixels; the centre of pixel (column 0, row 0) is (0.0, 0.0), x right, y down.
//! - Transforms are named `to_from_from`: `camera_from_slab` takes slab millimetres to camera pixels.
//! - All of it in f64.

mod homography;
mod lens;
mod projector;

pub use homography::Homography;
pub use lens::{CameraView, Lens};
pub(crate) use lens::{sight_angle, sight_slope};
pub use projector::SlabFromProjector;

pub use acquire_material::Point;
