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

#[cfg(test)]
mod tests {
    use super::*;

    use super::super::pictures::{picture, share};
    use crate::capture::Rect;

    /// A picture of 100 × 70 px of ellipses (centre, half axes), `dark` on light that grows to the right, or the other
    /// way round.
    fn discs(discs: &[([f64; 2], [f64; 2])], dark: bool) -> Radiance {
        let rect = Rect { x: 20, y: 300, width: 100, height: 70 };
        let light = |x: f64, y: f64| {
            let inside = |x: f64, y: f64| {
                discs.iter().any(|(c, r)| ((x - c[0]) / r[0]).powi(2) + ((y - c[1]) / r[1]).powi(2) < 1.0)
            };
            let covered = share(x, y, inside);
            let print = if dark { 1.0 - 0.9 * covered } else { 0.1 + 0.9 * covered };
            (50.0 + 0.2 * x) * print
        };
        picture(rect, light, 1.0)
    }

    #[test]
    fn discs_are_found_wherever_they_are_and_what_is_none_is_not() {
        let real = [[35.2, 312.4], [60.7, 318.0], [90.1, 311.3], [41.5, 350.6], [88.8, 349.2]];
        let mut all: Vec<([f64; 2], [f64; 2])> = real.iter().map(|&c| (c, [3.6, 3.1])).collect();
        // Too large, too long and at the border.
        all.extend([([66.0, 342.0], [7.0, 7.0]), ([107.0, 330.0], [2.0, 6.5]), ([30.0, 301.5], [3.5, 3.5])]);
        for dark in [true, false] {
            let mut found = find_blobs(&discs(&all, dark));
            found.sort_by(|a, b| a.center_px[0].total_cmp(&b.center_px[0]));
            let mut expected = real.to_vec();
            expected.sort_by(|a, b| a[0].total_cmp(&b[0]));
            assert_eq!(found.len(), 5, "{found:?}");
            for (blob, center) in found.iter().zip(expected) {
                // Whole pixels on either side of a level: a third of one at the worst.
                assert!(
                    (blob.center_px[0] - center[0]).hypot(blob.center_px[1] - center[1]) < 0.35,
                    "{blob:?} {center:?}"
                );
                // π · 3.6 · 3.1 = 35, less or more the pixels of its edge (some 20), all on one side of the first level
                // that cuts it.
                assert!(blob.area_px > 20.0 && blob.area_px < 50.0, "{blob:?}");
            }
        }
    }

    #[test]
    fn a_picture_without_contrast_has_no_discs() {
        let rect = Rect { x: 0, y: 0, width: 30, height: 20 };
        assert_eq!(find_blobs(&picture(rect, |_, _| 7.0, 1.0)), vec![]);
        assert_eq!(find_blobs(&picture(rect, |_, _| 0.0, 1.0)), vec![]);
    }

    #[test]
    fn a_part_is_a_disc_by_its_moments() {
        let of = |inside: &dyn Fn(f64, f64) -> bool| {
            let part: Vec<usize> = (0..40 * 30).filter(|k| inside((k % 40) as f64, (k / 40) as f64)).collect();
            disc(&part, 40)
        };
        let ellipse = |a: f64, b: f64| move |x: f64, y: f64| ((x - 21.0) / a).powi(2) + ((y - 12.0) / b).powi(2) <= 1.0;
        let found = of(&ellipse(8.0, 6.0)).unwrap();
        let count = (0..1200).filter(|k| ellipse(8.0, 6.0)((k % 40) as f64, (k / 40) as f64)).count();
        assert_eq!(found, Blob { center_px: [21.0, 12.0], area_px: count as f64 });
        // Axes of 1.6 and 1.9; as long along a diagonal.
        assert!(
            of(&ellipse(9.6, 6.0)).is_some() && of(&ellipse(11.4, 6.0)).is_none() && of(&ellipse(5.0, 9.5)).is_none()
        );
        let leaning = |long: f64| {
            move |x: f64, y: f64| {
                let (u, v) = ((x - 20.0 + y - 14.0) / 2f64.sqrt(), (x - 20.0 - y + 14.0) / 2f64.sqrt());
                (u / long).powi(2) + (v / 5.5).powi(2) <= 1.0
            }
        };
        assert!(of(&leaning(8.8)).is_some() && of(&leaning(10.5)).is_none());
        // A square's area is 12 over 4π of what its moments say, 0.955; a ring's and a cross's far less.
        assert!(of(&|x, y| (x - 20.0).abs() < 6.5 && (y - 14.0).abs() < 6.5).is_some());
        assert!(of(&|x, y| (3.0..8.0).contains(&(x - 20.0).hypot(y - 14.0))).is_none());
        let cross =
            |x: f64, y: f64| ((x - 20.0).abs() < 2.0 || (y - 14.0).abs() < 2.0) && (x - 20.0).hypot(y - 14.0) < 9.0;
        assert!(of(&cross).is_none());
    }

    #[test]
    fn parts_are_connected_over_sides_and_large_enough() {
        // Two squares of 4 × 4 that touch at a corner, one of 3 × 3, one of 5 × 4 at the border; 60 × 40.
        let squares = [(5, 5, 4, 4), (9, 9, 4, 4), (20, 20, 3, 3), (56, 30, 4, 5), (30, 36, 4, 4), (40, 10, 3, 4)];
        let mut light = vec![0.0; 2400];
        for (x, y, w, h) in squares {
            (0..w * h).for_each(|k| light[x + k % w + (y + k / w) * 60] = 1.0);
        }
        let found = parts(&light, 60, 40, |v| v > 0.5);
        let centers: Vec<Point> = found.iter().map(|b| b.center_px).collect();
        assert_eq!(centers, [[6.5, 6.5], [10.5, 10.5], [41.0, 11.5]]);
        // The most is a fiftieth of the picture: 48 pixels of 2400.
        let mut light = vec![0.0; 2400];
        (0..49).for_each(|k| light[10 + k % 7 + (10 + k / 7) * 60] = 1.0);
        assert_eq!(parts(&light, 60, 40, |v| v > 0.5), vec![]);
        light[10 + 10 * 60] = 0.0;
        assert_eq!(parts(&light, 60, 40, |v| v > 0.5).len(), 1);
    }

    #[test]
    fn faint_discs_are_found_between_what_is_dark_and_what_is_bright() {
        let rect = Rect { x: 20, y: 300, width: 100, height: 70 };
        // A fifth of the light is missing in a disc; a band of the picture is nearly black and sets the darkest level.
        let disc = |x: f64, y: f64| share(x, y, |x, y| (x - 70.3).hypot(y - 330.8) < 4.0);
        let light = |x: f64, y: f64| if y > 360.0 { 0.5 } else { (60.0 + 0.01 * x) * (1.0 - 0.25 * disc(x, y)) };
        let found = find_blobs(&picture(rect, light, 1.0));
        assert_eq!(found.len(), 1, "{found:?}");
        assert!((found[0].center_px[0] - 70.3).hypot(found[0].center_px[1] - 330.8) < 0.35, "{found:?}");
    }

    #[test]
    fn a_part_that_grows_to_the_left_and_upwards_is_one() {
        // A hook whose first pixel in reading order is its right top, with its other end below and up again at the
        // left.
        let rows = ["......#", "......#", ".#....#", ".#....#", ".######"];
        let mut light = vec![0.0; 1000];
        for (y, row) in rows.iter().enumerate() {
            row.bytes().enumerate().filter(|(_, b)| *b == b'#').for_each(|(x, _)| light[x + 3 + (y + 4) * 40] = 1.0);
        }
        // 13 pixels in one part are no disc, and no part of a dozen is left over.
        assert_eq!(parts(&light, 40, 25, |v| v > 0.5), vec![]);
        let near = |k: usize| (k % 40).abs_diff(20) + (k / 40).abs_diff(12) <= 2;
        let square: Vec<f32> = (0..1000).map(|k| if near(k) { 1.0 } else { 0.0 }).collect();
        // A square on its corner: its lines begin further to the left, each than the one before.
        assert_eq!(parts(&square, 40, 25, |v| v > 0.5).len(), 1);
    }
}
