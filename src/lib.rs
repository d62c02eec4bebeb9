//! From bracketed photographs of a projector-lit slab to the subsurface-scattering matrix R_d(x_i, x_o) and a factored
//! material.
//!
//! The modules stand in the order in which the photographs pass them; each depends only on those above it.

mod cholesky;
mod error;
mod files;
mod npy;
mod output;
mod warning;
mod words;

pub mod geometry;
pub mod progress;

// Read: a folder of photographs, checked before any work starts.
pub mod capture;

// Merge: the exposures of a shot to radiance.
pub mod radiance;

// Register: slab, camera and projector; the drift of every shot.
pub mod registration;

// Matrix: rows R_d(x_i, ·) on disk.
pub mod transport;

// Extract: the window of responses of each lit point.
pub mod response;

// All of the above, from a capture to a matrix.
pub mod pipeline;

// Patterns: what the projector is to show, and the plan of a capture that is still to be shot.
pub mod patterns;

// Import: a camera's folder, sorted into the shots of a plan.
pub mod import;

// Check: what can be known about a capture before that.
pub mod check;

// Material: what a renderer evaluates, and how it is saved, relit and exported.
pub mod material;

// Factor: the matrix to a material.
pub mod factor;

// Measures of a matrix or a material against a matrix.
pub mod evaluate;

// What speed, bytes and accuracy cost each other on one matrix.
pub mod tradeoff;

// A capture without a rig, and its truth.
pub mod simulate;

// What people look at.
pub mod report;

pub mod cli;

pub use error::{Error, Result};
pub use warning::{
    ArraysWarning, Bound, CaptureWarning, CheckWarning, ConsistencyWarning, Culprit, Done, DriftJump, FactorWarning,
    FindingRecord, LightWarning, RadianceWarning, RegistrationWarning, ResponseWarning, Severity, SimulateWarning,
    Topic, Warning,
};
