//! From light on the sensor to image files.

pub(crate) mod curve;
pub(crate) mod devices;
pub(crate) mod hot_pixels;
pub(crate) mod normal;
pub(crate) mod photograph;
pub(crate) mod psf;
pub(crate) mod sensor;
