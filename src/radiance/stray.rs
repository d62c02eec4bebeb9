//! Stray light: the faint, wide halo that lens and sensor put around everything bright.

use super::Radiance;
use faer::Mat;
use faer::linalg::solvers::SolveLstsq;
use serde::{Deserialize, Serialize};

/// A part of the light that is spread over a wide Gaussian.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Halo {
    /// Standard deviation, camera px.
    pub radius_px: f64,
    /// Share of the light.
    pub share: f64,
}

/// The camera's halo, the same all over the picture and in all channels.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct StrayLight {
    /// Its parts; none when nothing significant was found.
    pub halos: Vec<Halo>,
    /// Share of the light in all of them.
    pub share: f64,
    /// Standard deviation of that share.
    pub share_sd: f64,
    /// Light that is as bright everywhere and fits better than any halo, DN/s: no light of the dots, and not taken out.
    #[serde(default)]
    pub even: Option<f64>,
}

/// Radii that are tried, px: mixtures of neighbours stand for those between.
const RADII_PX: [f64; 9] = [6.0, 8.5, 12.0, 17.0, 24.0, 34.0, 48.0, 68.0, 96.0];
/// A halo must be this many standard deviations above none, and this share of the light, to be taken out.
const SIGNIFICANCE: f64 = 4.0;
const LEAST_SHARE: f64 = 2e-4;
/// Blocks of the coarse pictures, over the radius of the halo: four to a standard deviation lose nothing.
const BLOCKS_PER_RADIUS: f64 = 4.0;
/// Side of the blocks in which the halo is looked for, px.
const SEEN_BLOCK_PX: usize = 4;
/// What is believed of a halo that was fitted, as a share of it: it is no sum of Gaussians.
const SHAPE_SD: f64 = 0.1;

impl StrayLight {
    /// Measures the halo in pictures of shots, ambient light subtracted, all over the photograph.
    ///
    /// `dark` marks pixels that no light reaches directly: on the opaque frame, away from its reference dots. What is
    /// there is fitted by non-negative shares of the whole picture blurred. `None` when fewer than thirty blocks of
    /// such pixels were measured.
    ///
    /// A few blocks that are bright by themselves (a dot on the frame that nobody listed) are left out. `lamp`: the
    /// ambient light that was subtracted, and by how much of itself it changes from picture to picture with the lamp (a
    /// standard deviation); projector black on the frame is as bright as a halo.
    ///
    /// Not detected: halos much narrower than the way from the dots to the nearest of these pixels, ghosts (reflections
    /// between lenses, which have a shape and a place), light that the frame scatters back, light that goes through the
    /// sample's sides.
    pub fn estimate(pictures: &[Radiance], dark: &[bool], lamp: Option<(&Radiance, f64)>) -> Option<Self> {
        let (mut rows, mut all): (Vec<Weighted>, Vec<Weighted>) = (Vec::new(), Vec::new());
        let mut weights: Vec<f64> = Vec::new();
        for picture in pictures {
            // The dark pixels' own noise, blurred, would look like a halo of theirs: their light is the halo's, and
            // second order in it.
            let lit = lit_only(picture, dark);
            let whole = [&lit];
            let halos: Vec<Coarse> =
                RADII_PX.iter().map(|&r| Coarse::paint(&whole, picture_size(picture), r).blurred(r)).collect();
            let blocks = dark_blocks(picture, dark);
            // A halo is no sum of Gaussians: what this leaves is part of the bright blocks' and of the mean.
            let mean = blocks.iter().map(|b| b.1).sum::<f64>() / blocks.len().max(1) as f64;
            let (first, mut unsteady) = (all.len(), Vec::new());
            for (at, seen, variance) in blocks {
                let shape = SHAPE_SD * SHAPE_SD * (seen * seen + mean * mean);
                let weight = 1.0 / (variance + shape).sqrt();
                if weight.is_finite() {
                    all.push((std::array::from_fn(|k| weight * luminance(halos[k].at(at))), weight * seen));
                    weights.push(weight);
                    unsteady.push(lamp.map_or(0.0, |(ambient, sd)| weight * sd * block_mean(ambient, at)));
                }
            }
            rows.extend(whitened(&all[first..], &unsteady));
        }
        let even = even_light(&all, &weights);
        let (shares, sd) = fit_without_outliers(rows)?;
        let halo = |row: &Weighted| row.0.iter().zip(&shares).map(|(h, s)| h * s).sum::<f64>() - row.1;
        let left = all.iter().map(|row| bounded(halo(row))).sum::<f64>();
        if let Some((even, _)) = even.filter(|(_, even_left)| *even_left < EVEN_GAIN * left) {
            return Some(Self { even: Some(even), share_sd: sd, ..Self::default() });
        }
        let share: f64 = shares.iter().sum();
        if !is_believed(share, sd) {
            return Some(Self { share_sd: sd, ..Self::default() });
        }
        let halos = RADII_PX.iter().zip(shares).filter(|(_, s)| *s > 0.0);
        let halos = halos.map(|(&radius_px, share)| Halo { radius_px, share }).collect();
        Some(Self { halos, share, share_sd: sd.max(SHAPE_SD * share), even: None })
    }

    /// Takes the halo out of the pictures of one shot, which together must hold nearly all of its light.
    ///
    /// With B what is seen, g the share and H the halo: (B − g · H∗B) / (1 − g), right to g². Relative to a white that
    /// fills the picture, which has no halo to lose, this is the light without it. The uncertainty of g · H∗B is added
    /// to the variance.
    pub fn remove(&self, pictures: &mut [Radiance], size_px: [usize; 2]) {
        if self.halos.is_empty() {
            return;
        }
        let relative_variance = (self.share_sd / self.share).powi(2) as f32;
        let painted: Vec<&Radiance> = pictures.iter().collect();
        let halos: Vec<(f32, Coarse)> = self
            .halos
            .iter()
            .map(|h| (h.share as f32, Coarse::paint(&painted, size_px, h.radius_px).blurred(h.radius_px)))
            .collect();
        let keep = 1.0 / (1.0 - self.share as f32);
        for picture in pictures {
            let rect = picture.rect;
            for y in 0..rect.height {
                for x in 0..rect.width {
                    let mut stray = [0.0f32; 3];
                    for (share, halo) in &halos {
                        let light = halo.at([(rect.x + x) as f64, (rect.y + y) as f64]);
                        stray.iter_mut().zip(light).for_each(|(s, l)| *s += share * l);
                    }
                    let k = 3 * (y * rect.width + x);
                    for c in 0..3 {
                        picture.value[k + c] = keep * (picture.value[k + c] - stray[c]);
                        picture.variance[k + c] =
                            keep * keep * (picture.variance[k + c] + relative_variance * stray[c] * stray[c]);
                    }
                }
            }
        }
    }
}

/// Even light has to leave less than this share of what the halo leaves, to be taken for what it is. A halo falls off
/// with the distance from the dots, ambient light does not.
const EVEN_GAIN: f64 = 0.7;

/// A square that does not grow with what is something else.
fn bounded(miss: f64) -> f64 {
    (miss * miss).min(OUTLIER * OUTLIER)
}

/// The light that all blocks have in common, and what it leaves of them; `None` when it is not significant. Dark light
/// that is less than none is even, too: `sample-black` had more.
fn even_light(rows: &[Weighted], weights: &[f64]) -> Option<(f64, f64)> {
    let mut even = 0.0;
    for round in 0..4 {
        let (mut top, mut bottom) = (0.0, 0.0);
        for ((_, seen), w) in rows.iter().zip(weights) {
            if round == 0 || (seen - even * w).abs() < OUTLIER {
                (top, bottom) = (top + w * seen, bottom + w * w);
            }
        }
        if !(bottom > 0.0) {
            return None;
        }
        even = top / bottom;
        if round == 3 && even.abs() < SIGNIFICANCE / bottom.sqrt() {
            return None;
        }
    }
    Some((even, rows.iter().zip(weights).map(|((_, seen), w)| bounded(seen - even * w)).sum()))
}

/// Whether a share of the light with this standard deviation is taken out: NaN is not.
fn is_believed(share: f64, sd: f64) -> bool {
    share > SIGNIFICANCE * sd && share > LEAST_SHARE && share < 0.5
}

/// A block's light under each halo of share one, and its own light, both times its weight.
type Weighted = ([f64; RADII_PX.len()], f64);

fn picture_size(picture: &Radiance) -> [usize; 2] {
    [picture.rect.x + picture.rect.width, picture.rect.y + picture.rect.height]
}

fn luminance(light: [f32; 3]) -> f64 {
    light.iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0
}

/// The picture without the light of its dark pixels.
fn lit_only(picture: &Radiance, dark: &[bool]) -> Radiance {
    let mut lit = picture.clone();
    lit.value.chunks_exact_mut(3).zip(dark).filter(|(_, dark)| **dark).for_each(|(value, _)| value.fill(0.0));
    lit
}

/// Rows times the inverse root of 1 + u uᵀ, the covariance of blocks with independent errors of one and a common one of
/// `u`.
fn whitened(rows: &[Weighted], u: &[f64]) -> Vec<Weighted> {
    let square: f64 = u.iter().map(|u| u * u).sum();
    if !(square > 0.0 && square.is_finite()) {
        return rows.to_vec();
    }
    let less = (1.0 - 1.0 / (1.0 + square).sqrt()) / square;
    let along = |value: &dyn Fn(&Weighted) -> f64| less * rows.iter().zip(u).map(|(r, u)| u * value(r)).sum::<f64>();
    let halos: [f64; RADII_PX.len()] = std::array::from_fn(|k| along(&|r| r.0[k]));
    let seen = along(&|r| r.1);
    let one = |(row, u): (&Weighted, &f64)| (std::array::from_fn(|k| row.0[k] - u * halos[k]), row.1 - u * seen);
    rows.iter().zip(u).map(one).collect()
}

/// The mean of a picture over the block with this middle; 0 where the picture does not reach.
fn block_mean(picture: &Radiance, middle: [f64; 2]) -> f64 {
    let n = SEEN_BLOCK_PX;
    let [x, y] = middle.map(|m| (m - 0.5 * (n as f64 - 1.0)) as usize);
    let rect = picture.rect;
    if x < rect.x || y < rect.y || x + n > rect.x + rect.width || y + n > rect.y + rect.height {
        return 0.0;
    }
    let pixels = (0..n * n).map(|k| picture.at(x + k % n, y + k / n));
    pixels.map(|k| luminance([0, 1, 2].map(|c| picture.value[k + c]))).sum::<f64>() / (n * n) as f64
}

/// Middle, mean and its variance of each block of dark pixels that were all measured.
fn dark_blocks(picture: &Radiance, dark: &[bool]) -> Vec<([f64; 2], f64, f64)> {
    let rect = picture.rect;
    let n = SEEN_BLOCK_PX;
    let block = |x: usize, y: usize| {
        let (mut sum, mut variance) = (0.0, 0.0);
        for j in y..y + n {
            for i in x..x + n {
                let k = picture.at(i, j);
                if !dark[k / 3] || picture.used[k..k + 3].contains(&0) {
                    return None;
                }
                sum += picture.value[k..k + 3].iter().map(|&v| f64::from(v)).sum::<f64>() / 3.0;
                variance += picture.variance[k..k + 3].iter().map(|&v| f64::from(v)).sum::<f64>() / 9.0;
            }
        }
        let (pixels, half) = ((n * n) as f64, 0.5 * (n as f64 - 1.0));
        Some(([x as f64 + half, y as f64 + half], sum / pixels, variance / (pixels * pixels)))
    };
    let starts = |first: usize, len: usize| (first..(first + len + 1).saturating_sub(n)).step_by(n);
    starts(rect.y, rect.height).flat_map(|y| starts(rect.x, rect.width).filter_map(move |x| block(x, y))).collect()
}

/// Blocks that the fit misses by more than this many times what it misses of most are something else than a halo.
const OUTLIER: f64 = 5.0;
/// With fewer blocks of dark pixels nothing is believed.
const LEAST_BLOCKS: usize = 30;

/// [`non_negative`], fitted again without what it misses by far until nothing is. `None` when too few blocks are left.
fn fit_without_outliers(mut rows: Vec<Weighted>) -> Option<([f64; RADII_PX.len()], f64)> {
    loop {
        if rows.len() < LEAST_BLOCKS {
            return None;
        }
        let (shares, sd) = non_negative(&rows, SIGNIFICANCE)?;
        let miss = |row: &Weighted| (row.0.iter().zip(&shares).map(|(h, s)| h * s).sum::<f64>() - row.1).abs();
        let mut misses: Vec<f64> = rows.iter().map(miss).collect();
        let middle = misses.len() / 2;
        // 1.4826 makes the median of a normal distribution's deviations its standard deviation; weights count in that
        // of the noise.
        let scale = (1.4826 * *misses.select_nth_unstable_by(middle, f64::total_cmp).1).max(1.0);
        let before = rows.len();
        rows.retain(|row| miss(row) <= OUTLIER * scale);
        if rows.len() == before {
            return Some((shares, sd));
        }
    }
}

/// Non-negative least squares by leaving out what comes out negative, or less than `least` standard deviations above 0
/// beside others, and the standard deviation of the sum.
fn non_negative(rows: &[Weighted], least: f64) -> Option<([f64; RADII_PX.len()], f64)> {
    let mut kept: Vec<usize> = (0..RADII_PX.len()).collect();
    loop {
        let n = kept.len();
        if n == 0 {
            let scale = rows.iter().map(|r| r.0.iter().sum::<f64>().powi(2)).sum::<f64>();
            return Some(([0.0; RADII_PX.len()], (1.0 / scale.max(f64::MIN_POSITIVE)).sqrt()));
        }
        let a = Mat::from_fn(rows.len(), n, |r, c| rows[r].0[kept[c]]);
        let b = Mat::from_fn(rows.len(), 1, |r, _| rows[r].1);
        let x = a.col_piv_qr().solve_lstsq(&b);
        if (0..n).any(|c| !x[(c, 0)].is_finite()) {
            return None;
        }
        let worst = (0..n).min_by(|&i, &j| x[(i, 0)].total_cmp(&x[(j, 0)]))?;
        if x[(worst, 0)] < 0.0 {
            kept.remove(worst);
            continue;
        }
        let residual: f64 = (0..rows.len())
            .map(|r| ((0..n).map(|c| a[(r, c)] * x[(c, 0)]).sum::<f64>() - b[(r, 0)]).powi(2))
            .sum::<f64>()
            / (rows.len() - n).max(1) as f64;
        // (AᵀA)⁻¹, the residual's scale at least that of the noise.
        let normal = a.transpose() * &a;
        let inverse = normal.col_piv_qr().solve_lstsq(&Mat::<f64>::identity(n, n));
        let scale = residual.max(1.0);
        // A part that alone is not significant is left out: a narrow one is seen by the blocks next to the sample only,
        // and takes what the others miss there for a share of all light.
        let significance = |c: usize| x[(c, 0)] / (inverse[(c, c)] * scale).max(f64::MIN_POSITIVE).sqrt();
        let weakest = (0..n).min_by(|&i, &j| significance(i).total_cmp(&significance(j)))?;
        if n > 1 && significance(weakest) < least {
            kept.remove(weakest);
            continue;
        }
        let variance: f64 = (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).map(|at| inverse[at]).sum::<f64>() * scale;
        let mut shares = [0.0; RADII_PX.len()];
        kept.iter().enumerate().for_each(|(c, &k)| shares[k] = x[(c, 0)]);
        return Some((shares, variance.max(0.0).sqrt()));
    }
}

/// Means over square blocks of pixels.
struct Coarse {
    block_px: usize,
    size: [usize; 2],
    value: Vec<[f32; 3]>,
}

impl Coarse {
    /// Paints the measured pixels of pictures (where they overlap, once) onto a photograph of `size_px`, for a halo of
    /// that radius.
    fn paint(pictures: &[&Radiance], size_px: [usize; 2], radius_px: f64) -> Self {
        let block_px = ((radius_px / BLOCKS_PER_RADIUS) as usize).max(1);
        let size = size_px.map(|s| s.div_ceil(block_px));
        let mut value = vec![[0.0f32; 3]; size[0] * size[1]];
        let mut painted = vec![false; if pictures.len() > 1 { size_px[0] * size_px[1] } else { 0 }];
        let share = 1.0 / (block_px * block_px) as f32;
        for picture in pictures {
            let rect = picture.rect;
            for y in rect.y..rect.y + rect.height {
                for x in rect.x..rect.x + rect.width {
                    if let Some(done) = painted.get_mut(y * size_px[0] + x)
                        && std::mem::replace(done, true)
                    {
                        continue;
                    }
                    let k = picture.at(x, y);
                    let to = &mut value[(y / block_px) * size[0] + x / block_px];
                    (0..3).for_each(|c| to[c] += share * picture.value[k + c]);
                }
            }
        }
        Self { block_px, size, value }
    }

    /// Convolved with a Gaussian of `radius_px`; nothing beyond the photograph.
    fn blurred(&self, radius_px: f64) -> Self {
        let block = self.block_px as f64;
        // Blocks and the interpolation between them blur by themselves: a twelfth and a sixth of a block squared.
        let sd = ((radius_px * radius_px - 0.25 * block * block).max(0.0)).sqrt() / block;
        let reach = (5.0 * sd).ceil() as isize;
        let weights: Vec<f64> = (-reach..=reach).map(|k| (-0.5 * (k as f64 / sd).powi(2)).exp()).collect();
        let sum: f64 = weights.iter().sum();
        let weights: Vec<f32> = weights.iter().map(|w| (w / sum) as f32).collect();
        let [width, height] = self.size;
        let along = |from: &[[f32; 3]], step: usize, length: usize, k: usize, at: usize| {
            let mut out = [0.0f32; 3];
            for (i, w) in weights.iter().enumerate() {
                let there = at as isize + i as isize - reach;
                if there >= 0 && (there as usize) < length {
                    let v = from[(k as isize + (i as isize - reach) * step as isize) as usize];
                    out.iter_mut().zip(v).for_each(|(o, v)| *o += w * v);
                }
            }
            out
        };
        let n = width * height;
        let rows: Vec<[f32; 3]> = (0..n).map(|k| along(&self.value, 1, width, k, k % width)).collect();
        let value = (0..n).map(|k| along(&rows, width, height, k, k / width)).collect();
        Self { block_px: self.block_px, size: self.size, value }
    }

    /// Bilinear between the middles of blocks.
    fn at(&self, pixel: [f64; 2]) -> [f32; 3] {
        let place = |a: usize| {
            let t = ((pixel[a] + 0.5) / self.block_px as f64 - 0.5).clamp(0.0, (self.size[a] - 1) as f64);
            let k = (t as usize).min(self.size[a].saturating_sub(2));
            (k, (t - k as f64) as f32)
        };
        let ((x, u), (y, v)) = (place(0), place(1));
        let (right, down) = (usize::from(self.size[0] > 1), if self.size[1] > 1 { self.size[0] } else { 0 });
        let k = y * self.size[0] + x;
        std::array::from_fn(|c| {
            let top = self.value[k][c] + u * (self.value[k + right][c] - self.value[k][c]);
            let low = self.value[k + down][c] + u * (self.value[k + down + right][c] - self.value[k + down][c]);
            top + v * (low - top)
        })
    }
}

#[cfg(test)]
mod tests;
