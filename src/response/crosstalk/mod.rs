//! Cross-talk: the dots of one shot light each other's windows with their tails.
//!
//! # Model
//!
//! The light of all dots j of a shot at the slab's point x is Σ_j F_j · a_j · b(x) · K(|x − x_j|): F_j is the dot's
//! flux, K a kernel of the distance alone, a_j how much of the light goes in at x_j and b(x) how much comes out at x,
//! both relative to the slab's mean. It is fitted to the rows as extracted ([`fit_tails`]). What the model leaves
//! unexplained at x is shared among the dots in proportion to what each is uncertain by ([`TailModel::separate`]):
//! close to its own dot a row keeps what was measured, less the others' modelled tails; close to another dot it becomes
//! the model, with the model's variance. Only what cannot be told apart is modelled.

mod exponentials;
mod fit;
mod kernel;
mod separate;

pub use fit::fit_tails;
pub use separate::{LeftByOthers, Separation};

use crate::capture::Window;
use crate::geometry::Point;
use crate::transport::Row;
use kernel::Kernel;

/// One dot of a shot, with the row that was extracted around it.
#[derive(Debug, Clone)]
pub struct LitRow {
    /// Where the light falls, mm.
    pub center_mm: Point,
    /// The flux that it brings, R G B, in any unit common to the capture.
    pub flux: [f64; 3],
    /// Its row: exitance of all dots over its own flux.
    pub row: Row,
}

/// How the light of any dot falls off on this slab.
#[derive(Debug, Clone)]
pub struct TailModel {
    channels: [ChannelModel; 3],
}

#[derive(Debug, Clone)]
struct ChannelModel {
    kernel: Kernel,
    /// Relative standard deviation of the model at the kernel's nodes.
    relative_sd: Vec<f64>,
    outgoing: OutgoingMap,
}

/// b(x): relative to the mean, on square cells of one pitch.
#[derive(Debug, Clone)]
struct OutgoingMap {
    pitch_mm: f64,
    columns: usize,
    value: Vec<f64>,
}

impl OutgoingMap {
    fn even(size_mm: Point, pitch_mm: f64) -> Self {
        let [columns, rows] = size_mm.map(|s| ((s / pitch_mm).ceil() as usize).max(1));
        Self { pitch_mm, columns, value: vec![1.0; columns * rows] }
    }

    /// The cell of `p`; the nearest one outside.
    fn index(&self, p: Point) -> usize {
        let rows = self.value.len() / self.columns;
        let at = |a: usize, n: usize| ((p[a] / self.pitch_mm).max(0.0) as usize).min(n - 1);
        at(1, rows) * self.columns + at(0, self.columns)
    }
}

/// The centre of sample (i, j) of a window around `center_mm`, mm.
fn sample_mm(window: &Window, center_mm: Point, i: usize, j: usize) -> Point {
    let at = |a: usize, k: usize| center_mm[a] + (k as f64 - (window.samples[a] / 2) as f64) * window.pitch_mm;
    [at(0, i), at(1, j)]
}

fn distance(a: Point, b: Point) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Dots further than this many window sides from a sample are not counted in it.
const REACH_WINDOWS: f64 = 2.0;

/// How far a dot's light is followed, mm.
pub fn reach_mm(window: &Window) -> f64 {
    REACH_WINDOWS * window.pitch_mm * window.samples[0].max(window.samples[1]) as f64
}

#[cfg(test)]
mod tests;
