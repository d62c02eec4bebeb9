//! Images of what leaves the slab, and where rows lie on them.

use crate::light::srgb_from_linear;
use crate::{Error, Material, MaterialHeader, Point, Result};

/// The largest side of a canvas, samples; beyond it the lit points cannot be right.
const LARGEST: usize = 1 << 15;

/// Parts of a sample that are rounding.
const NEAR: f64 = 1e-6;
/// A canvas may have so many samples for each sample of a window …
const GAPS: f64 = 64.0;
/// … and this many in any case.
const SMALL: f64 = (1 << 20) as f64;

/// Where rows lie on the slab.
#[derive(Debug, Clone, Copy)]
pub struct Shape<'a> {
    /// Lit points along x and y.
    pub points: [usize; 2],
    /// Outgoing samples of a window along x and y.
    pub window: [usize; 2],
    /// Side of an outgoing cell, mm.
    pub pitch_mm: f64,
    /// Mean distance of lit points along x and y, mm.
    pub lit_pitch_mm: Point,
    /// Where each lit point is, mm.
    pub lit_mm: &'a [Point],
}

impl Shape<'_> {
    /// Number of lit points.
    pub fn rows(&self) -> usize {
        self.points[0] * self.points[1]
    }
}

impl Material {
    /// Where its rows lie.
    pub fn shape(&self) -> Shape<'_> {
        let MaterialHeader { points, window, pitch_mm, lit_pitch_mm, .. } = self.header;
        Shape { points, window, pitch_mm, lit_pitch_mm, lit_mm: &self.lit_mm }
    }
}

/// A regular grid of outgoing samples that covers every window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Canvas {
    /// Centre of sample (0, 0), mm.
    pub origin_mm: Point,
    /// Columns and rows.
    pub size: [usize; 2],
    /// Side of a sample, mm.
    pub pitch_mm: f64,
}

/// Radiant exitance, row 0 at the top.
#[derive(Debug, Clone, PartialEq)]
pub struct Exitance {
    /// Where its samples are.
    pub canvas: Canvas,
    /// R, G and B planes, `size` each, in the light's unit of irradiance.
    pub planes: [Vec<f64>; 3],
}

impl Canvas {
    /// The smallest canvas whose samples lie where the lattice point `node` does, on which light anywhere between
    /// `corners`, the ends of the lit area, or at a lit point leaves with its whole window.
    ///
    /// # Errors
    /// [`Error::TooSparse`] when the lit points are too far apart for their pitch.
    pub(crate) fn covering(shape: &Shape<'_>, node: Point, corners: [Point; 4]) -> Result<Self> {
        let pitch = shape.pitch_mm;
        // The last cell with light holds the rim of the lit area; a lit point is spread over the two samples beside it.
        let reach = |at: f64, by: f64, a: usize| (at - node[a]) / pitch + by;
        let (mut first, mut last) = ([0.0_f64; 2], [0.0_f64; 2]);
        for a in 0..2 {
            for p in &corners {
                first[a] = first[a].min(reach(p[a], 0.5 + NEAR, a).floor());
                last[a] = last[a].max(reach(p[a], -0.5 - NEAR, a).ceil());
            }
            for p in shape.lit_mm {
                first[a] = first[a].min(reach(p[a], NEAR, a).floor());
                last[a] = last[a].max(reach(p[a], -NEAR, a).ceil());
            }
        }
        let sides: [f64; 2] = std::array::from_fn(|a| last[a] - first[a] + shape.window[a] as f64);
        if !sides.iter().all(|s| (1.0..=LARGEST as f64).contains(s)) {
            let expected = format!("lit points within {LARGEST} samples of each other");
            return Err(Error::TooSparse { expected, found: format!("{:.0} × {:.0}", sides[0], sides[1]) });
        }
        // Memory for gaps between far-off windows is not to exceed by much what the windows themselves hold.
        let held = (shape.rows() * shape.window[0] * shape.window[1]) as f64;
        if sides[0] * sides[1] > (GAPS * held).max(SMALL) {
            let expected = "lit points whose windows cover a good part of the slab".to_owned();
            let found = format!("{} windows on {:.0} × {:.0} samples", shape.rows(), sides[0], sides[1]);
            return Err(Error::TooSparse { expected, found });
        }
        let half = |a: usize| (shape.window[a] / 2) as f64;
        Ok(Self {
            origin_mm: std::array::from_fn(|a| node[a] + (first[a] - half(a)) * pitch),
            size: sides.map(|s| s as usize),
            pitch_mm: pitch,
        })
    }

    /// The samples around a place (in samples) and their bilinear shares, which sum to one where all four are on the
    /// canvas.
    pub(crate) fn around(&self, at: Point) -> impl Iterator<Item = (u32, f64)> + use<> {
        let [width, height] = self.size;
        let base = at.map(|v| if (v - v.round()).abs() < NEAR { v.round() } else { v.floor() });
        let beyond = [0, 1].map(|a| if (at[a] - base[a]).abs() < NEAR { 0.0 } else { at[a] - base[a] });
        let shares = [[0, 0], [1, 0], [0, 1], [1, 1]].map(|step: [usize; 2]| {
            let share: f64 = (0..2).map(|a| if step[a] == 1 { beyond[a] } else { 1.0 - beyond[a] }).product();
            let [x, y] = [0, 1].map(|a| base[a] + step[a] as f64);
            let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            (inside && share > 0.0).then(|| ((x as usize + y as usize * width) as u32, share))
        });
        shares.into_iter().flatten()
    }
}

impl Exitance {
    /// Black.
    pub fn new(canvas: Canvas) -> Self {
        Self { canvas, planes: std::array::from_fn(|_| vec![0.0; canvas.size[0] * canvas.size[1]]) }
    }

    /// The exitance that maps to white in [`Self::tone_mapped`]: its 99.5th percentile; 1 when that is not positive.
    pub fn white(&self) -> f64 {
        let mut all: Vec<f64> = self.planes.concat();
        let at = all.len() * 995 / 1000;
        if at >= all.len() {
            return 1.0;
        }
        let (_, white, _) = all.select_nth_unstable_by(at, f64::total_cmp);
        if *white > 0.0 { *white } else { 1.0 }
    }

    /// 8-bit sRGB, interleaved, with `white` at 255.
    pub fn tone_mapped(&self, white: f64) -> Vec<u8> {
        let samples = self.planes[0].len();
        (0..samples * 3)
            .map(|k| (255.0 * srgb_from_linear((self.planes[k % 3][k / 3] / white) as f32)).round() as u8)
            .collect()
    }
}
