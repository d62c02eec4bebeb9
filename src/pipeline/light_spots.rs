//! Light in one place on the frame, or around it, that every lattice shot has and `sample-black` does not: a
//! reflection, an indicator lamp. What the dots light there is a halo, which is wide.

use super::scene::Scene;
use crate::ConsistencyWarning;
use crate::radiance::Radiance;

/// Side of the blocks that are looked at, px.
const BLOCK_PX: usize = 4;
/// A spot is brighter by this factor than nine tenths of the blocks that are so far away, blocks.
const BRIGHTER: f64 = 10.0;
const RINGS: [[usize; 2]; 2] = [[4, 6], [8, 10]];
/// Its light is so many times its standard deviation, and in all shots but the brightest no more than this factor of
/// the least.
const SIGMA: f64 = 8.0;
const STEADY: f64 = 1.5;

/// The blocks of such light.
pub(super) struct Spots {
    blocks: Vec<[usize; 2]>,
    brightest: ([usize; 2], f64),
}

/// Looks for it in pictures of shots, ambient light subtracted, all over the photograph; `dark`: pixels that no light
/// reaches directly.
pub(super) fn find(pictures: &[Radiance], dark: &[bool]) -> Option<Spots> {
    let rect = pictures.first().filter(|_| pictures.len() >= 3)?.rect;
    let [columns, rows] = [rect.width / BLOCK_PX, rect.height / BLOCK_PX];
    let is_dark = |[x, y]: [usize; 2]| {
        let row = |v: usize| v * rect.width + x * BLOCK_PX..v * rect.width + (x + 1) * BLOCK_PX;
        (y * BLOCK_PX..(y + 1) * BLOCK_PX).all(|v| !dark[row(v)].contains(&false))
    };
    let lights: Vec<(Vec<f32>, Vec<f32>)> = pictures.iter().map(|p| (p.luminance(), p.luminance_variance())).collect();
    let block = |at: [usize; 2]| {
        if !is_dark(at) {
            return None;
        }
        let seen = pictures.iter().zip(&lights).map(|(p, (light, variance))| mean(p, light, variance, at));
        let mut seen: Vec<[f64; 2]> = seen.collect::<Option<_>>()?;
        seen.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let steady = seen[seen.len() - 2][0] < STEADY * seen[0][0];
        Some((seen[0], steady))
    };
    let all: Vec<Option<([f64; 2], bool)>> = (0..columns * rows).map(|k| block([k % columns, k / columns])).collect();
    let around = |[x, y]: [usize; 2], [near, far]: [usize; 2]| {
        let mut ring = Vec::new();
        for v in y.saturating_sub(far)..(y + far + 1).min(rows) {
            for u in x.saturating_sub(far)..(x + far + 1).min(columns) {
                if u.abs_diff(x).max(v.abs_diff(y)) >= near {
                    ring.extend(all[v * columns + u].map(|(light, _)| light[0].max(light[1])));
                }
            }
        }
        ring.sort_by(f64::total_cmp);
        (ring.len() >= 10).then(|| ring[ring.len() * 9 / 10])
    };
    let is_spot = |&k: &usize| {
        let at = [k % columns, k / columns];
        all[k].is_some_and(|([light, sd], steady)| {
            let brighter = |ring: [usize; 2]| around(at, ring).is_some_and(|other| light > BRIGHTER * other.max(0.0));
            steady && light > SIGMA * sd && RINGS.into_iter().any(brighter)
        })
    };
    let found: Vec<usize> = (0..columns * rows).filter(is_spot).collect();
    let light = |k: usize| all[k].map_or(0.0, |(light, _)| light[0]);
    let &brightest = found.iter().max_by(|a, b| light(**a).total_cmp(&light(**b)))?;
    let place = |k: usize| [k % columns, k / columns];
    Some(Spots { blocks: found.iter().map(|&k| place(k)).collect(), brightest: (place(brightest), light(brightest)) })
}

/// Mean luminance of a block and its standard deviation; `None` where some of it was not measured.
fn mean(picture: &Radiance, light: &[f32], variance: &[f32], [x, y]: [usize; 2]) -> Option<[f64; 2]> {
    let (mut sum, mut square) = (0.0, 0.0);
    for v in y * BLOCK_PX..(y + 1) * BLOCK_PX {
        for u in x * BLOCK_PX..(x + 1) * BLOCK_PX {
            let k = v * picture.rect.width + u;
            if picture.used[3 * k..3 * k + 3].contains(&0) {
                return None;
            }
            (sum, square) = (sum + f64::from(light[k]), square + f64::from(variance[k]));
        }
    }
    let n = (BLOCK_PX * BLOCK_PX) as f64;
    Some([sum / n, square.sqrt() / n])
}

impl Spots {
    /// Takes their pixels, and those of the blocks beside them, out of a mask over the photograph.
    pub(super) fn leave_out(&self, mask: &mut [bool], [width, height]: [usize; 2]) {
        for [x, y] in &self.blocks {
            for v in y.saturating_sub(1) * BLOCK_PX..((y + 2) * BLOCK_PX).min(height) {
                mask[v * width + x.saturating_sub(1) * BLOCK_PX..v * width + ((x + 2) * BLOCK_PX).min(width)]
                    .fill(false);
            }
        }
    }

    /// What is to be told.
    pub(super) fn finding(&self, scene: &Scene<'_>, shot: usize) -> ConsistencyWarning {
        let (at, dn_per_sec) = self.brightest;
        let at_px = at.map(|v| (v * BLOCK_PX) as f64 + 0.5 * (BLOCK_PX as f64 - 1.0));
        ConsistencyWarning::LightSpot { shot: scene.photographs.name(shot).to_owned(), at_px, dn_per_sec }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;

    /// Four pictures of 120×80 px: a glow that moves, a spot that does not, and their noise.
    fn pictures(spot: f64, changing: bool) -> Vec<Radiance> {
        let rect = Rect { x: 0, y: 0, width: 120, height: 80 };
        let glow = |k: usize, x: f64, y: f64| 40.0 * (-(x - 30.0 - 9.0 * k as f64).hypot(y - 50.0) / 6.0).exp();
        let at = |k: usize, p: usize| {
            let (x, y) = ((p % 120) as f64, (p / 120) as f64);
            let share = if changing { 2f64.powi(k as i32) } else { 1.0 };
            glow(k, x, y) + share * spot * (-((x - 90.0).powi(2) + (y - 21.0).powi(2)) / 18.0).exp()
        };
        let value = |k: usize| (0..9600).flat_map(|p| [at(k, p) as f32; 3]).collect();
        (0..4)
            .map(|k| Radiance { rect, value: value(k), variance: vec![1e-4; 28_800], used: vec![1; 28_800] })
            .collect()
    }

    #[test]
    fn light_that_stays_in_one_place_is_found_and_what_dots_light_is_not() {
        let mut dark: Vec<bool> = vec![true; 9600];
        assert!(find(&pictures(0.0, false), &dark).is_none());
        let spots = find(&pictures(8.0, false), &dark).unwrap();
        // The blocks around (90, 21), 4 px a side; the brightest has most of the middle.
        assert_eq!(spots.brightest.0, [22, 5]);
        assert!(spots.blocks.iter().all(|b| b[0].abs_diff(22) <= 2 && b[1].abs_diff(5) <= 2));
        // Eight times as bright in one shot as in another it is lit by the dots.
        assert!(find(&pictures(8.0, true), &dark).is_none());
        let mut mask = dark.clone();
        spots.leave_out(&mut mask, [120, 80]);
        assert!(!mask[21 * 120 + 90] && mask[21 * 120 + 60] && mask[50 * 120 + 90]);
        // On the sample.
        (0..80).for_each(|y| dark[y * 120 + 70..(y + 1) * 120].fill(false));
        assert!(find(&pictures(8.0, false), &dark).is_none());
    }
}
