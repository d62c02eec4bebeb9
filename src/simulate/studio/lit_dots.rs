//! The dots of a shot.

use super::Studio;
use crate::geometry::{CameraView, Point};
use crate::simulate::SimulateOptions;
use crate::simulate::light::dots::Glow;
use crate::simulate::scene::FRAME_ALBEDO;
use crate::simulate::scene::pixels::{PixelGrid, RenderedPicture, seen_px};
use crate::{Result, transport::Row};
use rayon::prelude::*;
use std::ops::Range;

/// Dots that are solved for at once.
const TOGETHER: usize = 16;

/// The dots of a shot. Their light is solved for when the first rows that show it are rendered, and forgotten after the
/// last.
#[derive(Debug)]
pub(super) struct LitDots {
    drift_mm: Point,
    dots: Vec<LitDot>,
}

#[derive(Debug)]
struct LitDot {
    dot: [usize; 2],
    /// Camera rows that may show it; never empty, so that every dot is solved for once.
    rows: Range<usize>,
    /// Its light per unit of flux, and its flux.
    light: Option<(Glow, [f64; 3])>,
}

impl LitDots {
    /// Dots of a pattern that has moved by `drift_mm`, in the order in which their light is added.
    pub(super) fn new(studio: &Studio, view: &CameraView, dots: &[[usize; 2]], drift_mm: Point) -> Self {
        let last = studio.bench.scene.camera.size_px[1] - 1;
        let lit = |&dot: &[usize; 2]| {
            let [_, [first_px, last_px]] = seen_px(view, studio.bench.reach_mm(dot, drift_mm));
            let row = |v: f64| v.clamp(0.0, last as f64) as usize;
            LitDot { dot, rows: row(first_px - 2.0)..row(last_px + 2.0) + 1, light: None }
        };
        Self { drift_mm, dots: dots.iter().map(lit).collect() }
    }

    /// Adds their light to a picture of `rows`; `keep` receives the truth of those that are seen for the first time.
    pub(super) fn add(
        &mut self,
        studio: &Studio,
        options: &SimulateOptions,
        pixels: &PixelGrid,
        rows: &Range<usize>,
        keep: impl Fn([usize; 2], Row) -> Result<()> + Sync,
        picture: &mut RenderedPicture,
    ) -> Result<()> {
        let (bench, drift_mm, lit) = (&studio.bench, self.drift_mm, 1.0 - options.projector_black);
        let seen = |d: &LitDot| d.rows.start < rows.end && rows.start < d.rows.end;
        let mut seen: Vec<&mut LitDot> = self.dots.iter_mut().filter(|d| seen(d)).collect();
        // A few at a time: their order in the sum is fixed, and memory is bounded.
        for group in seen.chunks_mut(TOGETHER) {
            group.par_iter_mut().filter(|d| d.light.is_none()).try_for_each(|d| -> Result<()> {
                let glow = bench.glow(d.dot, drift_mm)?;
                keep(d.dot, bench.row(options, d.dot, drift_mm, &glow))?;
                d.light = Some((glow, bench.flux(d.dot, drift_mm)));
                Ok(())
            })?;
            for d in group {
                let Some((glow, flux)) = &d.light else { continue };
                for field in &glow.fields {
                    pixels.add_field(picture, &bench.scene, field, flux.map(|f| lit * f));
                }
                if d.rows.end <= rows.end {
                    d.light = None;
                }
            }
        }
        for &dot_px in &bench.scene.reference_dots {
            pixels.add_frame_dot(picture, &bench.scene, dot_px, drift_mm, lit * FRAME_ALBEDO);
        }
        Ok(())
    }
}
