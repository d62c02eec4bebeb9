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
    /// `dark` marks pixels that no light reaches directly: on the opaque frame, away from its reference dots. What is there is fitted by
    /// non-negative shares of the whole picture blurred. `None` when fewer than thirty blocks of such pixels were measured.
    ///
    /// A few blocks that are bright by themselves (a dot on the frame that nobody listed) are left out.
    ///
    /// Not detected: halos much narrower than the way from the dots to the nearest of these pixels, ghosts (reflections between lenses, which have a shape and a place), light that the frame scatters
    /// back, light that goes through the sample's sides.
    pub fn estimate(pictures: &[Radiance], dark: &[bool]) -> Option<Self> {
        let mut rows: Vec<Weighted> = Vec::new();
        for picture in pictures {
            // The dark pixels' own noise, blurred, would look like a halo of theirs: their light is the halo's, and second order in it.
            let lit = lit_only(picture, dark);
            let whole = [&lit];
            let halos: Vec<Coarse> =
                RADII_PX.iter().map(|&r| Coarse::paint(&whole, picture_size(picture), r).blurred(r)).collect();
            let blocks = dark_blocks(picture, dark);
            // A halo is no sum of Gaussians: what this leaves is part of the bright blocks' and of the mean.
            let mean = blocks.iter().map(|b| b.1).sum::<f64>() / blocks.len().max(1) as f64;
            for (at, seen, variance) in blocks {
                let shape = SHAPE_SD * SHAPE_SD * (seen * seen + mean * mean);
                let weight = 1.0 / (variance + shape).sqrt();
                if weight.is_finite() {
                    rows.push((std::array::from_fn(|k| weight * luminance(halos[k].at(at))), weight * seen));
                }
            }
        }
        let (shares, sd) = fit_without_outliers(rows)?;
        let share: f64 = shares.iter().sum();
        if !is_believed(share, sd) {
            return Some(Self { halos: vec![], share: 0.0, share_sd: sd });
        }
        let halos = RADII_PX.iter().zip(shares).filter(|(_, s)| *s > 0.0);
        let halos = halos.map(|(&radius_px, share)| Halo { radius_px, share }).collect();
        Some(Self { halos, share, share_sd: sd.max(SHAPE_SD * share) })
    }

    /// Takes the halo out of the pictures of one shot, which together must hold nearly all of its light.
    ///
    /// With B what is seen, g the share and H the halo: (B − g · H∗B) / (1 − g), right to g². Relative to a white that fills the picture, which has no
    /// halo to lose, this is the light without it. The uncertainty of g · H∗B is added to the variance.
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
        let (shares, sd) = non_negative(&rows)?;
        let miss = |row: &Weighted| (row.0.iter().zip(&shares).map(|(h, s)| h * s).sum::<f64>() - row.1).abs();
        let mut misses: Vec<f64> = rows.iter().map(miss).collect();
        let middle = misses.len() / 2;
        // 1.4826 makes the median of a normal distribution's deviations its standard deviation; weights count in that of the noise.
        let scale = (1.4826 * *misses.select_nth_unstable_by(middle, f64::total_cmp).1).max(1.0);
        let before = rows.len();
        rows.retain(|row| miss(row) <= OUTLIER * scale);
        if rows.len() == before {
            return Some((shares, sd));
        }
    }
}

/// Non-negative least squares by leaving out what comes out negative, and the standard deviation of the sum.
fn non_negative(rows: &[Weighted]) -> Option<([f64; RADII_PX.len()], f64)> {
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
        // The variance of the sum: 1ᵀ (AᵀA)⁻¹ 1, the residual's scale at least that of the noise.
        let normal = a.transpose() * &a;
        let ones = Mat::<f64>::from_fn(n, 1, |_, _| 1.0);
        let solved = normal.col_piv_qr().solve_lstsq(&ones);
        let variance: f64 = (0..n).map(|c| solved[(c, 0)]).sum::<f64>() * residual.max(1.0);
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
    /// Paints the measured pixels of pictures (where they overlap, once) onto a photograph of `size_px`, for a halo of that radius.
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
mod tests {
    use super::*;
    use crate::capture::Rect;

    const SIZE: [usize; 2] = [160, 140];
    const DOTS: [[f64; 2]; 3] = [[62.0, 70.0], [75.5, 66.0], [84.0, 75.0]];

    /// Three spots with tails, in the middle of a round sample.
    fn light(x: f64, y: f64) -> f64 {
        if (x - 75.0).hypot(y - 70.0) > 30.0 {
            return 0.0;
        }
        DOTS.iter().map(|d| 1000.0 * (-(x - d[0]).hypot(y - d[1]) / 2.0).exp()).sum()
    }

    /// The same with a halo of a single Gaussian, summed pixel by pixel.
    fn picture(share: f64, radius_px: f64) -> Radiance {
        let n = SIZE[0] * SIZE[1];
        let at = |k: usize| ((k % SIZE[0]) as f64, (k / SIZE[0]) as f64);
        let bright: Vec<(f64, f64, f64)> =
            (0..n).map(at).map(|(x, y)| (x, y, light(x, y))).filter(|p| p.2 > 1e-3).collect();
        let seen = |k: usize| {
            let (x, y) = at(k);
            let halo = |p: &(f64, f64, f64)| {
                let r2 = (x - p.0).powi(2) + (y - p.1).powi(2);
                p.2 * (-0.5 * r2 / radius_px.powi(2)).exp() / (std::f64::consts::TAU * radius_px.powi(2))
            };
            (1.0 - share) * light(x, y) + if share > 0.0 { share * bright.iter().map(halo).sum::<f64>() } else { 0.0 }
        };
        let value: Vec<f32> = (0..n).flat_map(|k| [seen(k) as f32; 3]).collect();
        let rect = Rect { x: 0, y: 0, width: SIZE[0], height: SIZE[1] };
        Radiance { rect, variance: vec![1e-10; value.len()], used: vec![1; value.len()], value }
    }

    fn dark() -> Vec<bool> {
        (0..SIZE[0] * SIZE[1]).map(|k| light((k % SIZE[0]) as f64, (k / SIZE[0]) as f64) == 0.0).collect()
    }

    #[test]
    fn a_halo_is_found_on_the_frame_and_taken_out_of_the_sample() {
        for radius_px in [17.0, 20.0, 30.0] {
            let seen = picture(0.02, radius_px);
            let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark()).unwrap();
            // Radii between those tried are mixtures: the shape's stated error.
            assert!((found.share / 0.02 - 1.0).abs() < 2.0 * SHAPE_SD, "{radius_px}: {found:?}");
            assert!(found.share_sd >= 0.1 * found.share, "a tenth of it at the least: {found:?}");
            let mut windows = vec![seen];
            found.remove(&mut windows, SIZE);
            let middle = windows[0].at(70, 80);
            let (before, after, truth) =
                (picture(0.02, radius_px).value[middle], windows[0].value[middle], light(70.0, 80.0) as f32);
            // Three stated errors of the shape: where the frame does not see the halo, its radii are a guess.
            assert!(
                (after - truth).abs() < 3.0 * SHAPE_SD as f32 * (before - truth).abs(),
                "{radius_px}: {before} {after} {truth}"
            );
        }
    }

    #[test]
    fn without_a_halo_nothing_is_taken_out() {
        let seen = picture(0.0, 20.0);
        let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark()).unwrap();
        assert!(found.halos.is_empty(), "{found:?}");
        let mut windows = vec![seen.clone()];
        found.remove(&mut windows, SIZE);
        assert_eq!(windows[0], seen);
    }

    #[test]
    fn a_lit_dot_on_the_frame_is_no_halo() {
        let mut seen = picture(0.0, 20.0);
        for (x, y) in [(20, 20), (21, 20), (20, 21), (140, 30), (140, 31), (141, 31)] {
            let k = seen.at(x, y);
            seen.value[k..k + 3].fill(300.0);
        }
        let found = StrayLight::estimate(std::slice::from_ref(&seen), &dark()).unwrap();
        assert!(found.halos.is_empty(), "{found:?}");
    }

    #[test]
    fn too_little_of_the_frame_tells_nothing() {
        assert!(StrayLight::estimate(&[picture(0.0, 20.0)], &vec![false; SIZE[0] * SIZE[1]]).is_none());
        assert!(StrayLight::estimate(&[], &dark()).is_none());
        let mut unmeasured = picture(0.0, 20.0);
        unmeasured.used.fill(0);
        assert!(StrayLight::estimate(&[unmeasured], &dark()).is_none());
    }

    /// An even picture at (3, 2) of three channels, in two rectangles that overlap.
    fn even(value: [f32; 3], variance: [f32; 3]) -> Vec<Radiance> {
        let part = |x: usize, width: usize| {
            let rect = Rect { x, y: 2, width, height: 80 };
            let n = rect.area();
            Radiance { rect, value: value.repeat(n), variance: variance.repeat(n), used: vec![1; 3 * n] }
        };
        vec![part(3, 60), part(50, 57)]
    }

    #[test]
    fn what_is_taken_out_leaves_an_even_picture_even_and_its_doubt_in_the_variance() {
        let (value, variance) = ([400.0f32, 90.0, 2000.0], [0.5f32, 30.0, 0.01]);
        let halos = vec![Halo { radius_px: 6.0, share: 0.03 }, Halo { radius_px: 8.5, share: 0.01 }];
        let stray = StrayLight { halos, share: 0.04, share_sd: 0.012 };
        let mut seen = even(value, variance);
        stray.remove(&mut seen, [110, 84]);
        // Far from the rims the halo is as bright as the picture, 0.04 of it, and that is known to 0.3 of itself.
        for (picture, x, y) in [(&seen[0], 55, 42), (&seen[1], 55, 42), (&seen[1], 60, 40)] {
            let k = picture.at(x, y);
            for c in 0..3 {
                // A Gaussian that is cut at 5 standard deviations, in f32.
                assert!((picture.value[k + c] / value[c] - 1.0).abs() < 1e-4, "{c}: {}", picture.value[k + c]);
                let halo = 0.04 * value[c];
                let expected = (variance[c] + 0.09 * halo * halo) / (0.96 * 0.96);
                assert!(
                    (picture.variance[k + c] / expected - 1.0).abs() < 1e-3,
                    "{c}: {} {expected}",
                    picture.variance[k + c]
                );
            }
        }
        // In the middle of the left rim half of the halo is there: (1 − 0.02) / 0.96.
        let k = seen[0].at(3, 42);
        for c in 0..3 {
            // Blocks of 1 and 2 px are not quite at the rim.
            assert!((seen[0].value[k + c] / value[c] - 0.98 / 0.96).abs() < 3e-3, "{}", seen[0].value[k + c]);
        }
    }

    #[test]
    fn dark_blocks_have_the_mean_of_their_pixels_and_its_variance() {
        let rect = Rect { x: 2, y: 1, width: 9, height: 6 };
        let at = |k: usize| ((2 + k / 3 % 9) as f32, (1 + k / 27) as f32, (k % 3) as f32);
        let value = |k: usize| at(k).0 + 10.0 * at(k).1 + 100.0 * at(k).2;
        let n = 3 * rect.area();
        let mut picture = Radiance {
            rect,
            value: (0..n).map(value).collect(),
            variance: (0..n).map(|k| at(k).2 + 1.0).collect(),
            used: vec![1; n],
        };
        let mut dark = vec![true; 54];
        let found = dark_blocks(&picture, &dark);
        // Columns 2 to 5 and 6 to 9, rows 1 to 4; the mean of x, 10 y and 0, 100, 200.
        let expected = [([3.5, 2.5], 3.5 + 25.0 + 100.0), ([7.5, 2.5], 7.5 + 25.0 + 100.0)];
        assert_eq!(found.iter().map(|b| (b.0, b.1)).collect::<Vec<_>>(), expected);
        // (1 + 2 + 3) / 9 of a pixel, a sixteenth of that of the mean of 16; f64.
        assert!(found.iter().all(|b| (b.2 - 6.0 / 9.0 / 16.0).abs() < 1e-12), "{found:?}");
        // Pixel (5, 4) is lit; (6, 1) was not measured in green.
        dark[3 * 9 + 3] = false;
        assert_eq!(dark_blocks(&picture, &dark).len(), 1);
        let k = picture.at(6, 1);
        picture.used[k + 1] = 0;
        assert!(dark_blocks(&picture, &dark).is_empty());
    }

    #[test]
    fn shares_are_those_of_least_squares_and_never_negative() {
        // Two halos that a block sees alone: 0.02 of the first, and the second comes out negative.
        let row = |k: usize, light: f64, seen: f64| {
            let mut halos = [0.0; RADII_PX.len()];
            halos[k] = light;
            // The others are seen a little, each in a way of its own.
            (halos, seen)
        };
        let mut rows: Vec<Weighted> = (0..RADII_PX.len()).map(|k| row(k, 100.0, 0.1 * k as f64)).collect();
        rows.push(row(3, 50.0, 0.3));
        let (shares, sd) = non_negative(&rows).unwrap();
        for (k, share) in shares.iter().enumerate() {
            // (100 · 0.3 + 50 · 0.3) / 12,500 for the fourth.
            let expected = if k == 3 { 45.0 / 12_500.0 } else { 1e-3 * k as f64 };
            assert!((share - expected).abs() < 1e-12, "{k}: {share} {expected}");
        }
        // Independent: 8 of 1/100² and one of 1/12,500; the residual is below that of the noise.
        assert!((sd - (8e-4f64 + 1.0 / 12_500.0).sqrt()).abs() < 1e-9, "{sd}");
        rows[5].1 = -3.0;
        let (shares, _) = non_negative(&rows).unwrap();
        assert_eq!(shares[5], 0.0);
        assert!((shares[8] - 8e-3).abs() < 1e-12);
    }

    #[test]
    fn what_is_painted_is_the_mean_over_blocks_where_pictures_overlap_once() {
        let rect = |x, y, width, height| Rect { x, y, width, height };
        let picture = |rect: Rect, of: usize| {
            let n = 3 * rect.area();
            let value = (0..n).map(|k| ((k * 31 + 7 * of) % 97) as f32).collect();
            Radiance { rect, value, variance: vec![1.0; n], used: vec![1; n] }
        };
        let (a, b) = (picture(rect(2, 1, 11, 9), 1), picture(rect(8, 4, 13, 12), 2));
        for pictures in [vec![&a], vec![&a, &b]] {
            // Radius 12: blocks of 3 px; 23 × 17 px are 8 × 6 of them.
            let coarse = Coarse::paint(&pictures, [23, 17], 12.0);
            assert_eq!((coarse.block_px, coarse.size), (3, [8, 6]));
            let mut expected = vec![[0.0; 3]; 48];
            for y in 0..17 {
                for x in 0..23 {
                    let covers = |p: &&&Radiance| {
                        let r = p.rect;
                        (r.x..r.x + r.width).contains(&x) && (r.y..r.y + r.height).contains(&y)
                    };
                    if let Some(first) = pictures.iter().find(covers) {
                        let k = 3 * ((y - first.rect.y) * first.rect.width + x - first.rect.x);
                        (0..3).for_each(|c| expected[y / 3 * 8 + x / 3][c] += first.value[k + c] / 9.0);
                    }
                }
            }
            for (found, expected) in coarse.value.iter().zip(&expected) {
                // Nine numbers up to 97 in f32.
                assert!((0..3).all(|c| (found[c] - expected[c]).abs() < 1e-4), "{found:?} {expected:?}");
            }
        }
    }

    #[test]
    fn a_halo_is_the_sum_over_all_blocks_weighted_by_their_distance_and_nothing_beyond_the_picture() {
        let size = [9, 5];
        let value: Vec<[f32; 3]> = (0..45).map(|k| [0, 1, 2].map(|c| ((k * 13 + c * 5) % 17) as f32)).collect();
        let coarse = Coarse { block_px: 2, size, value: value.clone() };
        let blurred = coarse.blurred(5.0);
        assert_eq!((blurred.block_px, blurred.size), (2, size));
        // In blocks of 2 px; blocks and the interpolation between them are a quarter of a block squared by themselves.
        let variance = (25.0 - 0.25 * 4.0) / 4.0;
        let weight = |d: f64| f64::exp(-0.5 * d * d / variance);
        // Five standard deviations of 2.45 blocks.
        let all: f64 = (-13..=13).map(|k| weight(f64::from(k))).sum();
        for y in 0..5 {
            for x in 0..9 {
                for c in 0..3 {
                    let part = |k: usize| {
                        let d = [(k % 9) as f64 - x as f64, (k / 9) as f64 - y as f64];
                        weight(d[0]) * weight(d[1]) / (all * all) * f64::from(value[k][c])
                    };
                    let expected: f64 = (0..45).map(part).sum();
                    let found = f64::from(blurred.value[y * 9 + x][c]);
                    // Sums of 45 numbers in f32.
                    assert!((found / expected - 1.0).abs() < 1e-5, "{x} {y} {c}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn between_the_middles_of_blocks_a_plane_is_a_plane_and_beyond_the_last_it_ends() {
        let plane = |x: f64, y: f64, c: usize| [3.0 + 2.0 * x - 5.0 * y, 100.0 - x + 0.5 * y, 7.0 * x + 11.0 * y][c];
        let coarse = |size: [usize; 2]| {
            let of = |k: usize| [0, 1, 2].map(|c| plane((k % size[0]) as f64, (k / size[0]) as f64, c) as f32);
            Coarse { block_px: 3, size, value: (0..size[0] * size[1]).map(of).collect() }
        };
        for size in [[6, 4], [1, 4], [6, 1], [1, 1]] {
            let coarse = coarse(size);
            for at in
                [[1.0, 1.0], [4.0, 7.0], [5.5, 2.2], [8.3, 9.9], [16.0, 10.0], [0.0, 3.0], [17.0, 11.0], [-4.0, 90.0]]
            {
                // The middle of block k is pixel 3 k + 1.
                let place = |a: usize| ((at[a] - 1.0) / 3.0_f64).clamp(0.0, (size[a] - 1) as f64);
                for c in 0..3 {
                    let (found, expected) = (f64::from(coarse.at(at)[c]), plane(place(0), place(1), c));
                    // f32.
                    assert!((found - expected).abs() < 1e-4, "{size:?} {at:?} {c}: {found} {expected}");
                }
            }
        }
    }

    /// Blocks that see 100 of the first halo and a hundredth of it, off by so much; and one for each of the others, where nothing is.
    fn rows_off(by: impl Iterator<Item = f64>) -> Vec<Weighted> {
        let alone = |k: usize| std::array::from_fn(|j| if j == k { 100.0 } else { 0.0 });
        by.map(|off| (alone(0), 1.0 + off)).chain((1..RADII_PX.len()).map(|k| (alone(k), 0.0))).collect()
    }

    #[test]
    fn a_block_that_is_off_by_five_times_what_most_are_is_left_out_and_thirty_must_stay() {
        let fitted = |usual: f64, one: f64| {
            let even = (0..40).map(|k| if k % 2 == 0 { usual } else { -usual });
            100.0 * fit_without_outliers(rows_off(even.chain([one]))).unwrap().0[0]
        };
        // The mean of the 41 is off by a 41st of the one. What most are off by is less than the noise, 1: 5 · 41/40 is the limit.
        for (usual, one) in [(0.5, 5.1), (0.5, 5.15), (0.5, -5.1), (0.5, -5.15)] {
            let kept = (one * 40.0 / 41.0_f64).abs() <= 5.0;
            let expected = if kept { 1.0 + one / 41.0 } else { 1.0 };
            assert!((fitted(usual, one) - expected).abs() < 1e-9, "{one}: {}", fitted(usual, one));
        }
        // Else the limit is 5 · 1.4826 medians. Of 49 blocks 8 are off by nothing and 20 by 2 less what the mean is off by:
        // x · 40/41 = 7.413 (2 − x/41), x = 12.82.
        assert!((fitted(2.0, 12.6) - (1.0 + 12.6 / 41.0)).abs() < 1e-9, "{}", fitted(2.0, 12.6));
        assert!((fitted(2.0, 13.05) - 1.0).abs() < 1e-9, "{}", fitted(2.0, 13.05));
        // With the 8 others.
        assert!(fit_without_outliers(rows_off((0..21).map(|_| 0.0))).is_none());
        assert!(fit_without_outliers(rows_off((0..22).map(|_| 0.0))).is_some());
        assert!(fit_without_outliers(rows_off((0..22).map(|k| if k == 7 { 99.0 } else { 0.0 }))).is_none());
    }

    #[test]
    fn residuals_beyond_the_noise_make_the_share_less_certain() {
        // Ten blocks for each of 9 halos, off by ±3 noises: 9 · 90 over 81 degrees of freedom are 10 times the noise's variance.
        let alone = |k: usize| std::array::from_fn(|j| if j == k { 100.0 } else { 0.0 });
        let rows: Vec<Weighted> = (0..90).map(|k| (alone(k / 10), if k % 2 == 0 { 4.0 } else { -2.0 })).collect();
        let (shares, sd) = non_negative(&rows).unwrap();
        assert!(shares.iter().all(|s| (s - 0.01).abs() < 1e-12), "{shares:?}");
        // Each share has a variance of 10 / (10 · 100²).
        assert!((sd - (9.0 * 10.0 / (10.0 * 1e4_f64)).sqrt()).abs() < 1e-12, "{sd}");
    }

    #[test]
    fn a_share_is_taken_out_from_four_deviations_and_two_ten_thousandths_of_the_light_on() {
        assert!(is_believed(0.0401, 0.01) && !is_believed(0.0399, 0.01));
        // 2e-4, however well it is known.
        assert!(is_believed(2.01e-4, 1e-9) && !is_believed(1.99e-4, 1e-9));
        assert!(is_believed(0.499, 1e-3) && !is_believed(0.501, 1e-3) && !is_believed(f64::NAN, 1e-3));
    }
}
