//! From light on the sensor to image files.

pub(crate) mod photograph;
pub(crate) mod sensor;
