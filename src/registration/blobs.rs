//! Discs in a picture, wherever they are.

use super::board::percentile;
use crate::geometry::Point;
use crate::radiance::Radiance;

/// Levels of light at which the picture is cut, from darkest to brightest in equal ratios.
const LEVELS: usize = 24;
/// Pixels of the smallest disc, and the largest as a share of the picture.
const LEAST_AREA: usize = 12;
const LARGEST_SHARE: f64 = 0.02;
/// An ellipse's area is 4π times the root of its second moments' determinant; pixels keep that to some per cent.
const ROUNDNESS: std::ops::Range<f64> = 0.85..1.1;
/// Its longer axis over the shorter: a disc seen from 55 degrees.
const LONGEST: f64 = 1.75;
/// Areas of the same discs differ by perspective and by the level that cuts them.
const SAME_SIZE: f64 = 2.0;

/// A disc-like part of the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Blob {
    pub center_px: Point,
    pub area_px: f64,
}

/// Discs darker or brighter than what is around them: of the many sizes, the one that most have.
pub(super) fn find_blobs(picture: &Radiance) -> Vec<Blob> {
    let light = picture.luminance();
    let high = percentile(&light, 0.99);
    let low = percentile(&light, 0.02).max(1e-3 * high);
    let mut found: Vec<Blob> = Vec::new();
    if !(high > low) {
        return found;
    }
    for level in 1..LEVELS {
        let cut = low * (high / low).powf(level as f32 / LEVELS as f32);
        for dark in [true, false] {
            for blob in parts(&light, picture.rect.width, picture.rect.height, |v| (v < cut) == dark) {
                let same = |b: &Blob| {
                    let d = (b.center_px[0] - blob.center_px[0]).hypot(b.center_px[1] - blob.center_px[1]);
                    d * d < 0.25 * b.area_px.min(blob.area_px)
                };
                if !found.iter().any(same) {
                    found.push(blob);
                }
            }
        }
    }
    found.sort_by(|a, b| a.area_px.total_cmp(&b.area_px));
    let alike = |k: usize| found[k..].iter().take_while(|b| b.area_px <= SAME_SIZE * found[k].area_px).count();
    let Some(first) = (0..found.len()).max_by_key(|&k| (alike(k), std::cmp::Reverse(k))) else { return found };
    let offset = [picture.rect.x as f64, picture.rect.y as f64];
    let moved = |b: &Blob| Blob { center_px: [0, 1].map(|a| b.center_px[a] + offset[a]), ..*b };
    found[first..first + alike(first)].iter().map(moved).collect()
}

/// Connected parts (over sides) of the pixels that `belongs` says, those that look like discs.
fn parts(light: &[f32], width: usize, height: usize, belongs: impl Fn(f32) -> bool) -> Vec<Blob> {
    let mut todo: Vec<bool> = light.iter().map(|&v| belongs(v)).collect();
    let most = (LARGEST_SHARE * light.len() as f64) as usize;
    let (mut out, mut stack, mut part) = (Vec::new(), Vec::new(), Vec::new());
    for start in 0..light.len() {
        if !todo[start] {
            continue;
        }
        part.clear();
        stack.push(start);
        todo[start] = false;
        let mut at_border = false;
        while let Some(k) = stack.pop() {
            part.push(k);
            let (x, y) = (k % width, k / width);
            at_border |= x == 0 || y == 0 || x + 1 == width || y + 1 == height;
            let sides = [
                (x > 0, k.wrapping_sub(1)),
                (x + 1 < width, k + 1),
                (y > 0, k.wrapping_sub(width)),
                (y + 1 < height, k + width),
            ];
            for (inside, n) in sides {
                if inside && todo[n] {
                    todo[n] = false;
                    stack.push(n);
                }
            }
        }
        if !at_border && part.len() >= LEAST_AREA && part.len() <= most {
            out.extend(disc(&part, width));
        }
    }
    out
}

fn disc(part: &[usize], width: usize) -> Option<Blob> {
    let n = part.len() as f64;
    let places = || part.iter().map(|k| [(k % width) as f64, (k / width) as f64]);
    let center_px = [0, 1].map(|a| places().map(|p| p[a]).sum::<f64>() / n);
    // A pixel is a square, not a point: a twelfth more of variance.
    let moment = |a: usize, b: usize| {
        places().map(|p| (p[a] - center_px[a]) * (p[b] - center_px[b])).sum::<f64>() / n
            + if a == b { 1.0 / 12.0 } else { 0.0 }
    };
    let (xx, xy, yy) = (moment(0, 0), moment(0, 1), moment(1, 1));
    let det = xx * yy - xy * xy;
    let (half, root) = (0.5 * (xx + yy), (0.25 * (xx - yy).powi(2) + xy * xy).sqrt());
    let longest = ((half + root) / (half - root)).sqrt();
    let roundness = n / (4.0 * std::f64::consts::PI * det.sqrt());
    (ROUNDNESS.contains(&roundness) && longest <= LONGEST).then_some(Blob { center_px, area_px: n })
}
