//! Light that falls on the slab, and the rows that answer for it.
//!
//! Rows were measured at some points of the lit area, light falls everywhere. At a point x between lit points the
//! response is taken to be the bilinear mean of the rows of the four lit points around x, each at the same offset d,
//! where these points really are: a lattice with the drift of every point. The exitance is then an integral over the
//! lit area, summed over cells of the outgoing pitch, so that an even slab under even light is even, however its lit
//! points were moved. What it costs is that light and material are not resolved below the distance of lit points.

use crate::exitance::{Canvas, Shape};
use crate::lattice::{Corners, Lattice};
use crate::{Point, Result};

/// Lattice coordinates this close to a lit point are that point.
const SAME: f64 = 1e-6;
/// Smaller shares of a cell are rounding.
const NOTHING: f64 = 1e-9;

/// The part of the slab on which light falls, and the canvas for what leaves.
///
/// The lit area is the union of the lit cells: half a lit pitch around every point of the lattice.
#[derive(Debug, Clone)]
pub struct LitArea {
    /// Where exitance is sampled.
    pub canvas: Canvas,
    points: [usize; 2],
    lattice: Lattice,
}

impl LitArea {
    /// Of the lit points of a matrix or a material.
    ///
    /// # Errors
    /// [`crate::Error::TooSparse`] when the lit points are too far apart for their pitch.
    pub fn of(shape: &Shape<'_>) -> Result<Self> {
        let lattice = Lattice::of(shape.points, shape.lit_mm, shape.lit_pitch_mm);
        let corner = |x: bool, y: bool| {
            let at = |far: bool, n: usize| if far { n as f64 - 0.5 } else { -0.5 };
            lattice.place([at(x, shape.points[0]), at(y, shape.points[1])])
        };
        let corners = [corner(false, false), corner(true, false), corner(false, true), corner(true, true)];
        let canvas = Canvas::covering(shape, lattice.place([0.0, 0.0]), corners)?;
        Ok(Self { canvas, points: shape.points, lattice })
    }

    /// Where on the slab the lit area has a place that is given by its shares of the area's two sides, mm. The sides
    /// are those of the lattice of lit points, which may be turned against the slab's axes.
    pub fn place(&self, share: Point) -> Point {
        self.lattice.place([0, 1].map(|a| share[a] * self.points[a] as f64 - 0.5))
    }

    /// Lengths of its two sides, mm.
    pub fn sides_mm(&self) -> Point {
        let corner = self.place([0.0, 0.0]);
        [self.place([1.0, 0.0]), self.place([0.0, 1.0])].map(|p| (p[0] - corner[0]).hypot(p[1] - corner[1]))
    }

    /// An extent of this size around its middle, along the slab's axes: from and to along x and y, mm.
    pub fn around_middle(&self, size_mm: Point) -> [[f64; 2]; 2] {
        let middle = self.place([0.5, 0.5]);
        [0, 1].map(|a| [-0.5, 0.5].map(|end| middle[a] + end * size_mm[a]))
    }
}

/// A cell on which light falls.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LitCell {
    /// From and to, as shares of the lit area along its two sides.
    pub(crate) from: Point,
    pub(crate) to: Point,
    pub(crate) area_mm2: f64,
}

/// A part of a row's answer: light of a lit cell, leaving around a sample of the canvas.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Share {
    /// The lit cell.
    pub(crate) cell: u32,
    /// The sample of the canvas at which the row's offset is zero.
    pub(crate) at: u32,
    pub(crate) weight: f64,
}

/// How light on cells of the lit area becomes light into rows.
#[derive(Debug, Clone)]
pub struct Quadrature {
    canvas: Canvas,
    pub(crate) cells: Vec<LitCell>,
    /// Whether cells are those of lit points.
    pub(crate) of_points: Option<[usize; 2]>,
    /// Where each row's shares begin, and where the last one's end.
    starts: Vec<u32>,
    shares: Vec<Share>,
}

impl Quadrature {
    /// The lit area in cells of the outgoing pitch (finer where lit points are closer than that); each cell's light is
    /// shared by the rows of the lit points of `shape` around it. `area` may be that of another shape of the same slab.
    pub fn new(area: &LitArea, shape: &Shape<'_>) -> Self {
        let canvas = area.canvas;
        let own = Lattice::of(shape.points, shape.lit_mm, shape.lit_pitch_mm);
        let extent = area.lattice.extent(canvas.pitch_mm);
        let fine = extent.map(|e| (e - SAME).ceil().max(1.0) as usize);
        let place = Places::new(shape, own);
        let sides = [0, 1].map(|a| area.points[a] as f64);
        let (mut cells, mut shares) = (Vec::new(), Vec::new());
        let cell_area = canvas.pitch_mm.powi(2) / (fine[0] * fine[1]) as f64;
        for y in 0..canvas.size[1] * fine[1] {
            for x in 0..canvas.size[0] * fine[0] {
                let sample = [(x as f64 + 0.5) / fine[0] as f64 - 0.5, (y as f64 + 0.5) / fine[1] as f64 - 0.5];
                let middle = [0, 1].map(|a| canvas.origin_mm[a] + sample[a] * canvas.pitch_mm);
                let u = area.lattice.map(middle);
                let half = [0, 1].map(|a| extent[a] / (2.0 * fine[a] as f64));
                let from = [0, 1].map(|a| (u[a] - half[a]).max(-0.5));
                let to = [0, 1].map(|a| (u[a] + half[a]).min(sides[a] - 0.5));
                let inside = [0, 1].map(|a| (to[a] - from[a]) / (2.0 * half[a]));
                if inside.iter().any(|&i| i <= NOTHING) {
                    continue;
                }
                let cell = cells.len() as u32;
                let part = |v: Point| [0, 1].map(|a| (v[a] + 0.5) / sides[a]);
                cells.push(LitCell { from: part(from), to: part(to), area_mm2: cell_area * inside[0] * inside[1] });
                for (at, near) in canvas.around(sample) {
                    for (row, weight) in place.rows(own.map(middle)) {
                        if weight * near > 0.0 {
                            shares.push((row, Share { cell, at, weight: weight * near }));
                        }
                    }
                }
            }
        }
        Self::sorted(canvas, cells, None, shape.rows(), &shares)
    }

    /// Every lit point by itself, at its place: what light on its lit cell gives when all of it enters there.
    pub fn of_points(area: &LitArea, shape: &Shape<'_>) -> Self {
        let canvas = area.canvas;
        let [nx, ny] = shape.points.map(|n| n as f64);
        let area_mm2 = shape.lit_pitch_mm[0] * shape.lit_pitch_mm[1];
        let (mut cells, mut shares) = (Vec::new(), Vec::new());
        for (row, point) in shape.lit_mm.iter().enumerate().take(shape.rows()) {
            let (i, j) = ((row % shape.points[0]) as f64, (row / shape.points[0]) as f64);
            cells.push(LitCell { from: [i / nx, j / ny], to: [(i + 1.0) / nx, (j + 1.0) / ny], area_mm2 });
            let sample = [0, 1].map(|a| (point[a] - canvas.origin_mm[a]) / canvas.pitch_mm);
            for (at, weight) in canvas.around(sample).filter(|(_, w)| *w > 0.0) {
                shares.push((row, Share { cell: row as u32, at, weight }));
            }
        }
        Self::sorted(canvas, cells, Some(shape.points), shape.rows(), &shares)
    }

    fn sorted(
        canvas: Canvas,
        cells: Vec<LitCell>,
        of_points: Option<[usize; 2]>,
        rows: usize,
        shares: &[(usize, Share)],
    ) -> Self {
        let mut starts = vec![0_u32; rows + 1];
        shares.iter().for_each(|(row, _)| starts[row + 1] += 1);
        (0..rows).for_each(|row| starts[row + 1] += starts[row]);
        let mut next = starts.clone();
        let mut sorted = vec![Share { cell: 0, at: 0, weight: 0.0 }; shares.len()];
        for (row, share) in shares {
            sorted[next[*row] as usize] = *share;
            next[*row] += 1;
        }
        Self { canvas, cells, of_points, starts, shares: sorted }
    }

    /// Where exitance is sampled.
    pub fn canvas(&self) -> Canvas {
        self.canvas
    }

    /// The parts of a row's answer; none for a row that is not there.
    pub(crate) fn shares(&self, row: usize) -> &[Share] {
        let (Some(&from), Some(&to)) = (self.starts.get(row), self.starts.get(row + 1)) else { return &[] };
        &self.shares[from as usize..to as usize]
    }

    /// Whether row `row` has a share in the light of any of these fluxes.
    pub fn is_lit(&self, row: usize, fluxes: &[Vec<[f64; 3]>]) -> bool {
        self.shares(row).iter().any(|s| fluxes.iter().any(|f| f.get(s.cell as usize).is_some_and(|f| *f != [0.0; 3])))
    }
}

/// Lit points where they are.
struct Places {
    points: [usize; 2],
    /// How far each is from its place on the lattice, in steps of it.
    moved: Vec<Point>,
}

impl Places {
    fn new(shape: &Shape<'_>, lattice: Lattice) -> Self {
        let moved = |(k, p): (usize, &Point)| {
            let u = lattice.map(*p);
            [u[0] - (k % shape.points[0]) as f64, u[1] - (k / shape.points[0]) as f64]
        };
        Self { points: shape.points, moved: shape.lit_mm.iter().enumerate().map(moved).collect() }
    }

    /// The four rows around lattice coordinates and their shares, which sum to one; the outermost beyond them.
    fn rows(&self, u: Point) -> [(usize, f64); 4] {
        let mut at = u;
        // Lit points are moved by a part of a step: each round leaves that part of what the last one left.
        for _ in 0..4 {
            let moved = self.corners(at).iter().fold([0.0; 2], |sum, (row, w)| {
                let moved = self.moved.get(*row).copied().unwrap_or_default();
                [sum[0] + w * moved[0], sum[1] + w * moved[1]]
            });
            at = [u[0] - moved[0], u[1] - moved[1]];
        }
        self.corners(at)
    }

    fn corners(&self, at: Point) -> [(usize, f64); 4] {
        let at = at.map(|v| if (v - v.round()).abs() < SAME { v.round() } else { v });
        Corners::held(at, self.points).each().map(|([x, y], weight)| (x + y * self.points[0], weight))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 7 × 5 points 1.5 samples apart along x and 2 along y, each moved by up to a fifth of a sample.
    fn moved() -> Vec<Point> {
        let wave = |k: usize, f: f64| 0.1 * (f * k as f64).sin();
        (0..35).map(|k| [0.75 * (k % 7) as f64 + wave(k, 1.3), 4.0 + 1.0 * (k / 7) as f64 + wave(k, 2.1)]).collect()
    }

    fn shape(lit_mm: &[Point]) -> Shape<'_> {
        Shape { points: [7, 5], window: [5, 3], pitch_mm: 0.5, lit_pitch_mm: [0.75, 1.0], lit_mm }
    }

    #[test]
    fn a_share_of_the_lit_area_is_a_place_along_the_sides_of_its_lattice() {
        let turn = 0.2_f64;
        let lit: Vec<Point> = (0..12)
            .map(|k| [0.75 * (k % 4) as f64, 1.0 * (k / 4) as f64])
            .map(|[x, y]| [x * turn.cos() - y * turn.sin(), x * turn.sin() + y * turn.cos()])
            .collect();
        let shape = Shape { points: [4, 3], window: [5, 3], pitch_mm: 0.5, lit_pitch_mm: [0.75, 1.0], lit_mm: &lit };
        let area = LitArea::of(&shape).unwrap();
        // Half a lit pitch beyond the first point and the last; the middle of the first cell is the first point.
        for (share, expected) in [([0.125, 1.0 / 6.0], lit[0]), ([0.875, 5.0 / 6.0], lit[11]), ([0.375, 0.5], lit[5])] {
            let found = area.place(share);
            assert!((0..2).all(|a| (found[a] - expected[a]).abs() < 1e-12), "rounding: {found:?} {expected:?}");
        }
    }

    #[test]
    fn cells_cover_the_lit_area_once_and_every_cell_is_answered_for_once() {
        let lit = moved();
        let shape = shape(&lit);
        let area = LitArea::of(&shape).unwrap();
        let quadrature = Quadrature::new(&area, &shape);
        let total: f64 = quadrature.cells.iter().map(|c| c.area_mm2).sum();
        // 7 × 5 cells of 0.75 × 1 mm, whose mean pitch the moves change by a few per cent.
        let lattice = area.lattice;
        let [a, b, c] = [[-0.5, -0.5], [6.5, -0.5], [-0.5, 4.5]].map(|u| lattice.place(u));
        let expected = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        assert!(
            (total / expected - 1.0).abs() < 0.02,
            "a slightly turned rim is cut along the axes: {total} {expected}"
        );
        let mut answered = vec![0.0; quadrature.cells.len()];
        for row in 0..35 {
            quadrature.shares(row).iter().for_each(|s| answered[s.cell as usize] += s.weight);
        }
        assert!(answered.iter().all(|a| (a - 1.0).abs() < 1e-12), "rounding");
    }

    #[test]
    fn a_linear_function_of_the_place_is_interpolated_exactly_wherever_the_points_were_moved() {
        let lit = moved();
        let shape = shape(&lit);
        let area = LitArea::of(&shape).unwrap();
        let quadrature = Quadrature::new(&area, &shape);
        let value = |p: Point| 2.0 + 0.3 * p[0] - 0.7 * p[1];
        let mut sums = vec![0.0; quadrature.cells.len()];
        for (row, p) in lit.iter().enumerate() {
            quadrature.shares(row).iter().for_each(|s| sums[s.cell as usize] += s.weight * value(*p));
        }
        let mut places = vec![None; quadrature.cells.len()];
        for row in 0..35 {
            for s in quadrature.shares(row) {
                let at = [s.at as usize % area.canvas.size[0], s.at as usize / area.canvas.size[0]];
                let place = [0, 1].map(|a| area.canvas.origin_mm[a] + 0.5 * at[a] as f64);
                places[s.cell as usize] = Some(place);
            }
        }
        let mut compared = 0;
        for (sum, place) in sums.iter().zip(&places) {
            let Some(place) = place else { continue };
            let u = area.lattice.map(*place);
            // Beyond the outermost points nothing is extrapolated.
            if (0..2).all(|a| u[a] > 0.3 && u[a] < [5.7, 3.7][a]) {
                compared += 1;
                // The moves are found by four rounds, each leaving a fifth.
                assert!((sum - value(*place)).abs() < 1e-3, "{place:?}: {sum} {}", value(*place));
            }
        }
        assert!(compared > 40, "{compared}");
    }

    #[test]
    fn regular_points_at_the_outgoing_pitch_answer_for_their_own_cell_alone() {
        let lit: Vec<Point> = (0..12).map(|k| [0.5 * (k % 4) as f64, 0.5 * (k / 4) as f64]).collect();
        let shape = Shape { points: [4, 3], window: [5, 3], pitch_mm: 0.5, lit_pitch_mm: [0.5; 2], lit_mm: &lit };
        let area = LitArea::of(&shape).unwrap();
        assert_eq!(area.canvas.size, [8, 5]);
        let quadrature = Quadrature::new(&area, &shape);
        for row in 0..12 {
            let [share] = quadrature.shares(row) else { panic!("{:?}", quadrature.shares(row)) };
            assert_eq!(share.weight, 1.0);
            assert_eq!(share.at as usize, 2 + row % 4 + (1 + row / 4) * 8);
            assert!((quadrature.cells[share.cell as usize].area_mm2 - 0.25).abs() < 1e-12, "rounding");
        }
        let points = Quadrature::of_points(&area, &shape);
        assert!(
            (0..12)
                .all(|row| points.shares(row).len() == 1 && points.shares(row)[0].at == quadrature.shares(row)[0].at)
        );
    }

    #[test]
    fn points_closer_than_the_outgoing_pitch_are_all_heard() {
        let lit: Vec<Point> = (0..60).map(|k| [0.2 * (k % 10) as f64, 0.2 * (k / 10) as f64]).collect();
        let shape = Shape { points: [10, 6], window: [5, 3], pitch_mm: 0.5, lit_pitch_mm: [0.2; 2], lit_mm: &lit };
        let area = LitArea::of(&shape).unwrap();
        let quadrature = Quadrature::new(&area, &shape);
        let total: f64 = quadrature.cells.iter().map(|c| c.area_mm2).sum();
        assert!((total - 2.0 * 1.2).abs() < 1e-9, "rounding: {total}");
        assert!((0..60).all(|row| !quadrature.shares(row).is_empty()));
    }
}
