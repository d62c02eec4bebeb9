//! A symmetric multigrid preconditioner and conjugate gradients for columns of voxels.
//!
//! The operator is kept as maps over the plane: one for all layers when its coefficients do not vary with depth, else
//! one for each. Smoothing solves whole columns exactly (damped line Jacobi), coarsening is lateral only; with
//! transposed transfers the V-cycle is symmetric, as conjugate gradients need. Vectors are f32 with `nx` zeros before
//! and after, sums are f64.

const DAMPING: f32 = 0.8; // of line Jacobi: the best smoothing of the five-point stencil (Trottenberg et al. 2001, §2.1)
const COARSEST_SWEEPS: usize = 4;

/// The operator as maps over the plane (row-major), everything integrated over a voxel column's area. `west`, `north`,
/// `loss` and `vertical` hold one plane that stands for every layer, or one plane for each.
#[derive(Debug, Clone)]
pub(crate) struct Columns {
    pub nx: usize,
    pub ny: usize,
    /// Conductance to the western neighbour per mm of depth, 0 in the first column.
    pub west: Vec<f32>,
    /// Conductance to the northern neighbour per mm of depth, 0 in the first row.
    pub north: Vec<f32>,
    /// Absorption and loss through the sides per mm of depth.
    pub loss: Vec<f32>,
    /// Conductance to the layer below times the distance of the layers' centres (of the last layer: anything).
    pub vertical: Vec<f32>,
    /// Conductance through the top and the bottom.
    pub top: Vec<f32>,
    pub bottom: Vec<f32>,
}

impl Columns {
    /// Twice as wide columns. Extensive terms add; a face joins two in parallel over twice the distance.
    fn coarsen(&self) -> Self {
        let (nx, ny) = (self.nx / 2, self.ny / 2);
        let cell = |i: usize| 2 * (i / nx) * self.nx + 2 * (i % nx);
        let planes = |map: &[f32], coarse: &dyn Fn(&[f32], usize) -> f32| -> Vec<f32> {
            map.chunks(self.nx * self.ny).flat_map(|plane| (0..nx * ny).map(move |i| coarse(plane, cell(i)))).collect()
        };
        let sum = |map: &[f32]| planes(map, &|m, f| m[f] + m[f + 1] + m[f + self.nx] + m[f + self.nx + 1]);
        let face = |map: &[f32], beside: usize| planes(map, &|m, f| 0.5 * (m[f] + m[f + beside]));
        Self {
            nx,
            ny,
            west: face(&self.west, self.nx),
            north: face(&self.north, 1),
            loss: sum(&self.loss),
            vertical: sum(&self.vertical),
            top: sum(&self.top),
            bottom: sum(&self.bottom),
        }
    }
}

/// One grid of the hierarchy with its factored columns and its scratch vectors.
#[derive(Debug)]
struct Level {
    nx: usize,
    ny: usize,
    plane: usize,
    /// From one layer's maps to the next: 0 when one plane stands for all.
    stride: usize,
    west: Vec<f32>,
    north: Vec<f32>,
    vertical: Vec<f32>,
    diagonal: Vec<f32>,
    inverse_pivot: Vec<f32>,
    right: Vec<f32>,
    left: Vec<f32>,
    work: Vec<f32>,
}

/// The whole hierarchy; finest grid first.
#[derive(Debug)]
pub(crate) struct Multigrid {
    levels: Vec<Level>,
    /// The finest operator, for [`Self::refine`].
    columns: Columns,
    thickness: Vec<f32>,
    link: Vec<f32>,
}

/// What the iteration did.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Convergence {
    pub iterations: usize,
    /// Last residual over the first, Euclidean.
    pub residual: f64,
}

impl Multigrid {
    /// Builds the hierarchy for layers of these thicknesses (mm, from the top).
    pub(crate) fn new(mut columns: Columns, thickness_mm: &[f64]) -> Self {
        let thickness: Vec<f32> = thickness_mm.iter().map(|&t| t as f32).collect();
        let link: Vec<f32> = thickness_mm.windows(2).map(|t| (2.0 / (t[0] + t[1])) as f32).collect();
        let finest = columns.clone();
        let mut levels = vec![Level::new(&columns, &thickness, &link)];
        while columns.nx.is_multiple_of(2) && columns.ny.is_multiple_of(2) && columns.nx.min(columns.ny) >= 10 {
            columns = columns.coarsen();
            levels.push(Level::new(&columns, &thickness, &link));
        }
        Self { levels, columns: finest, thickness, link }
    }

    /// A zero vector of the finest grid, padded.
    pub(crate) fn zeros(&self) -> Vec<f32> {
        self.levels[0].zeros(self.thickness.len())
    }

    /// Voxels of a padded vector of the finest grid.
    pub(crate) fn voxels<'a>(&self, vector: &'a [f32]) -> &'a [f32] {
        &vector[self.levels[0].nx..vector.len() - self.levels[0].nx]
    }

    /// The same, to be written.
    pub(crate) fn voxels_mut<'a>(&self, vector: &'a mut [f32]) -> &'a mut [f32] {
        let (pad, len) = (self.levels[0].nx, vector.len());
        &mut vector[pad..len - pad]
    }

    /// Solves A x = b by preconditioned conjugate gradients from x = 0 until the residual has fallen by `tolerance`.
    pub(crate) fn solve(&mut self, b: &[f32], tolerance: f64, most: usize) -> (Vec<f32>, Convergence) {
        let mut x = self.zeros();
        let mut residual = b.to_vec();
        let start = dot(&residual, &residual).sqrt();
        let mut convergence = Convergence { iterations: 0, residual: 0.0 };
        if start == 0.0 {
            return (x, convergence);
        }
        let mut direction = self.zeros();
        let mut image = self.zeros();
        let mut rho = 1.0;
        for iteration in 1..=most {
            self.precondition(&residual);
            let z = &self.levels[0].left;
            let next = dot(&residual, z);
            let beta = if iteration == 1 { 0.0 } else { (next / rho) as f32 };
            rho = next;
            direction.iter_mut().zip(z).for_each(|(p, z)| *p = z + beta * *p);
            self.levels[0].stencil(&self.thickness, &self.link, &direction, &mut image, |_, ax| ax, &[]);
            let alpha = (rho / dot(&direction, &image)) as f32;
            for (((x, r), p), q) in x.iter_mut().zip(&mut residual).zip(&direction).zip(&image) {
                *x += alpha * p;
                *r -= alpha * q;
            }
            convergence = Convergence { iterations: iteration, residual: dot(&residual, &residual).sqrt() / start };
            if convergence.residual < tolerance {
                break;
            }
        }
        (x, convergence)
    }

    /// Adds to `x` what solves A d = b − A x, the right side in f64 and by differences: where little is lost and much
    /// flows, the f32 diagonal rounds the loss away. Padded vectors, as everywhere.
    pub(crate) fn refine(&mut self, b: &[f32], x: &mut [f64], tolerance: f64, most: usize) -> Convergence {
        let missing = self.exact_residual(b, x);
        let (correction, convergence) = self.solve(&missing, tolerance, most);
        x.iter_mut().zip(correction).for_each(|(x, d)| *x += f64::from(d));
        convergence
    }

    /// b − A x, each voxel's as its net gain.
    fn exact_residual(&self, b: &[f32], x: &[f64]) -> Vec<f32> {
        let (c, nx, plane, nz) = (&self.columns, self.columns.nx, self.levels[0].plane, self.thickness.len());
        let stride = self.levels[0].stride;
        let mut gain: Vec<f64> = b.iter().map(|&b| f64::from(b)).collect();
        for k in 0..nz {
            let dz = f64::from(self.thickness[k]);
            for i in 0..plane {
                let (j, m) = (nx + k * plane + i, k * stride + i);
                let mut join = |other: usize, conductance: f64| {
                    let flow = conductance * (x[other] - x[j]);
                    gain[j] += flow;
                    gain[other] -= flow;
                };
                if i % nx > 0 {
                    join(j - 1, dz * f64::from(c.west[m]));
                }
                if i >= nx {
                    join(j - nx, dz * f64::from(c.north[m]));
                }
                if k + 1 < nz {
                    join(j + plane, f64::from(c.vertical[m]) * f64::from(self.link[k]));
                }
                let mut loss = dz * f64::from(c.loss[m]);
                if k == 0 {
                    loss += f64::from(c.top[i]);
                }
                if k + 1 == nz {
                    loss += f64::from(c.bottom[i]);
                }
                gain[j] -= loss * x[j];
            }
        }
        gain.into_iter().map(|g| g as f32).collect()
    }

    /// One V-cycle from zero; the result is `levels[0].left`.
    fn precondition(&mut self, right: &[f32]) {
        self.levels[0].right.copy_from_slice(right);
        let (thickness, link) = (&self.thickness, &self.link);
        let deepest = self.levels.len() - 1;
        for l in 0..deepest {
            let (fine, coarse) = self.levels.split_at_mut(l + 1);
            let (fine, coarse) = (&mut fine[l], &mut coarse[0]);
            fine.first_sweep(link);
            fine.residual(thickness, link);
            restrict(fine, coarse, thickness.len());
        }
        let coarsest = &mut self.levels[deepest];
        coarsest.first_sweep(link);
        for _ in 1..COARSEST_SWEEPS {
            coarsest.sweep(thickness, link);
        }
        for l in (0..deepest).rev() {
            let (fine, coarse) = self.levels.split_at_mut(l + 1);
            let fine = &mut fine[l];
            prolong(&coarse[0], fine, thickness.len());
            fine.sweep(thickness, link);
        }
    }
}

impl Level {
    fn new(columns: &Columns, thickness: &[f32], link: &[f32]) -> Self {
        let (nx, ny, nz) = (columns.nx, columns.ny, thickness.len());
        let plane = nx * ny;
        let stride = if columns.west.len() == plane { 0 } else { plane };
        // A layer's eastern and southern borders read the first column and row of what follows: zero.
        let mut west = columns.west.clone();
        west.push(0.0);
        let mut north = columns.north.clone();
        north.resize(north.len() + nx, 0.0);
        let lateral: Vec<f32> = (0..columns.west.len())
            .map(|i| west[i] + west[i + 1] + north[i] + north[i + nx] + columns.loss[i])
            .collect();
        let mut diagonal = vec![0.0; plane * nz];
        let mut inverse_pivot = vec![0.0; plane * nz];
        for k in 0..nz {
            let above = if k > 0 { link[k - 1] } else { 0.0 };
            let below = if k + 1 < nz { link[k] } else { 0.0 };
            for i in 0..plane {
                let coupling = above * columns.vertical[k.saturating_sub(1) * stride + i];
                let mut d = thickness[k] * lateral[k * stride + i];
                d += coupling + below * columns.vertical[k * stride + i];
                if k == 0 {
                    d += columns.top[i];
                }
                if k + 1 == nz {
                    d += columns.bottom[i];
                }
                diagonal[k * plane + i] = d;
                let eliminated = if k > 0 { coupling * coupling * inverse_pivot[(k - 1) * plane + i] } else { 0.0 };
                inverse_pivot[k * plane + i] = 1.0 / (d - eliminated);
            }
        }
        let padded = vec![0.0; plane * nz + 2 * nx];
        Self {
            nx,
            ny,
            plane,
            stride,
            west,
            north,
            vertical: columns.vertical.clone(),
            diagonal,
            inverse_pivot,
            right: padded.clone(),
            left: padded.clone(),
            work: padded,
        }
    }

    fn zeros(&self, nz: usize) -> Vec<f32> {
        vec![0.0; self.plane * nz + 2 * self.nx]
    }

    /// `out = combine(with, A x)`. Borders need no care: their conductances are zero and the padding is finite.
    fn stencil(
        &self,
        thickness: &[f32],
        link: &[f32],
        x: &[f32],
        out: &mut [f32],
        combine: impl Fn(f32, f32) -> f32,
        with: &[f32],
    ) {
        let (s, nx, nz) = (self.plane, self.nx, thickness.len());
        for k in 0..nz {
            let (o, m) = (nx + k * s, k * self.stride);
            let (west, east) = (&self.west[m..m + s], &self.west[m + 1..m + 1 + s]);
            let (north, south) = (&self.north[m..m + s], &self.north[m + nx..m + nx + s]);
            let over = &self.vertical[m.saturating_sub(self.stride)..][..s];
            let under = &self.vertical[m..m + s];
            let at = |start: usize| &x[start..start + s];
            let (c, xw, xe, xn, xs) = (at(o), at(o - 1), at(o + 1), at(o - nx), at(o + nx));
            let (above, up) = if k > 0 { (link[k - 1], at(o - s)) } else { (0.0, c) };
            let (below, down) = if k + 1 < nz { (link[k], at(o + s)) } else { (0.0, c) };
            let diagonal = &self.diagonal[k * s..(k + 1) * s];
            let out = &mut out[o..o + s];
            let with = if with.is_empty() { c } else { &with[o..o + s] };
            let dz = thickness[k];
            for i in 0..s {
                let lateral = west[i] * xw[i] + east[i] * xe[i] + north[i] * xn[i] + south[i] * xs[i];
                let ax = diagonal[i] * c[i] - dz * lateral - over[i] * above * up[i] - under[i] * below * down[i];
                out[i] = combine(with[i], ax);
            }
        }
    }

    /// `work = right − A left`.
    fn residual(&mut self, thickness: &[f32], link: &[f32]) {
        let mut work = std::mem::take(&mut self.work);
        self.stencil(thickness, link, &self.left, &mut work, |r, ax| r - ax, &self.right);
        self.work = work;
    }

    /// `left = damping · (columns of A)⁻¹ right`: the first sweep, from zero.
    fn first_sweep(&mut self, link: &[f32]) {
        let mut left = std::mem::take(&mut self.left);
        left.copy_from_slice(&self.right);
        self.solve_columns(link, &mut left);
        left.iter_mut().for_each(|x| *x *= DAMPING);
        self.left = left;
    }

    /// A further sweep: `left += damping · (columns of A)⁻¹ (right − A left)`.
    fn sweep(&mut self, thickness: &[f32], link: &[f32]) {
        self.residual(thickness, link);
        let mut work = std::mem::take(&mut self.work);
        self.solve_columns(link, &mut work);
        self.left.iter_mut().zip(&work).for_each(|(x, w)| *x += DAMPING * w);
        self.work = work;
    }

    /// Solves every column exactly (Thomas), in place.
    fn solve_columns(&self, link: &[f32], d: &mut [f32]) {
        let s = self.plane;
        let d = &mut d[self.nx..];
        let vertical = |k: usize| &self.vertical[k * self.stride..][..s];
        let pivot = |k: usize| &self.inverse_pivot[k * s..(k + 1) * s];
        d[..s].iter_mut().zip(pivot(0)).for_each(|(d, p)| *d *= p);
        for (k, &link) in link.iter().enumerate() {
            let (above, below) = d[k * s..].split_at_mut(s);
            let (below, pivot, vertical) = (&mut below[..s], pivot(k + 1), vertical(k));
            for i in 0..s {
                below[i] = (below[i] + vertical[i] * link * above[i]) * pivot[i];
            }
        }
        for (k, &link) in link.iter().enumerate().rev() {
            let (above, below) = d[k * s..].split_at_mut(s);
            let (above, below, pivot, vertical) = (&mut above[..s], &below[..s], pivot(k), vertical(k));
            for i in 0..s {
                above[i] += vertical[i] * link * pivot[i] * below[i];
            }
        }
    }
}

/// Σ a·b, in f64 over short f32 runs: as fast as f32, as exact as needed.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.chunks(64)
        .zip(b.chunks(64))
        .map(|(a, b)| {
            let mut lanes = [0.0f32; 8];
            let (a8, b8) = (a.chunks_exact(8), b.chunks_exact(8));
            let rest: f32 = a8.remainder().iter().zip(b8.remainder()).map(|(x, y)| x * y).sum();
            for (x, y) in a8.zip(b8) {
                for l in 0..8 {
                    lanes[l] += x[l] * y[l];
                }
            }
            f64::from(lanes.iter().sum::<f32>() + rest)
        })
        .sum()
}

/// `coarse.right = Pᵀ fine.work`, P bilinear between cell centres (weights 3/4, 1/4), constant beyond the border.
fn restrict(fine: &Level, coarse: &mut Level, nz: usize) {
    let mut row = vec![0.0f32; fine.nx];
    for k in 0..nz {
        let from = &fine.work[fine.nx + k * fine.plane..][..fine.plane];
        let to = &mut coarse.right[coarse.nx + k * coarse.plane..][..coarse.plane];
        for y in 0..coarse.ny {
            let line = |fy: usize| &from[fy * fine.nx..(fy + 1) * fine.nx];
            let (outer_a, outer_b) = (line((2 * y).saturating_sub(1)), line((2 * y + 2).min(fine.ny - 1)));
            for (((r, a), (b, c)), d) in
                row.iter_mut().zip(outer_a).zip(line(2 * y).iter().zip(line(2 * y + 1))).zip(outer_b)
            {
                *r = 0.75 * (b + c) + 0.25 * (a + d);
            }
            transpose_row(&row, &mut to[y * coarse.nx..(y + 1) * coarse.nx]);
        }
    }
}

fn transpose_row(fine: &[f32], coarse: &mut [f32]) {
    let last = fine.len() - 1;
    for (x, c) in coarse.iter_mut().enumerate() {
        let (a, d) = (fine[(2 * x).saturating_sub(1)], fine[(2 * x + 2).min(last)]);
        *c = 0.75 * (fine[2 * x] + fine[2 * x + 1]) + 0.25 * (a + d);
    }
}

/// `fine.left += P coarse.left`.
fn prolong(coarse: &Level, fine: &mut Level, nz: usize) {
    let mut row = vec![0.0f32; coarse.nx];
    for k in 0..nz {
        let from = &coarse.left[coarse.nx + k * coarse.plane..][..coarse.plane];
        let to = &mut fine.left[fine.nx + k * fine.plane..][..fine.plane];
        for (y, to) in to.chunks_exact_mut(fine.nx).enumerate() {
            let near = y / 2;
            let far = if y % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min(coarse.ny - 1) };
            let line = |cy: usize| &from[cy * coarse.nx..(cy + 1) * coarse.nx];
            for ((r, a), b) in row.iter_mut().zip(line(near)).zip(line(far)) {
                *r = 0.75 * a + 0.25 * b;
            }
            let last = coarse.nx - 1;
            for (x, pair) in to.chunks_exact_mut(2).enumerate() {
                pair[0] += 0.75 * row[x] + 0.25 * row[x.saturating_sub(1)];
                pair[1] += 0.75 * row[x] + 0.25 * row[(x + 1).min(last)];
            }
        }
    }
}
