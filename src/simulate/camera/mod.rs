//! From light on the sensor to image files.

pub(crate) mod devices;
pub(crate) mod hot_pixels;
pub(crate) mod normal;
pub(crate) mod photograph;
pub(crate) mod psf;
pub(crate) mod response;
pub(crate) mod sensor;
