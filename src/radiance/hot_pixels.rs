//! Photosites with a dark current of their own, found in a black shot, and their light from their neighbours.

use super::Radiance;

/// A photosite (of one channel) that shows light in the dark.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct HotPixel {
    /// Column, row and channel.
    pub at: [usize; 3],
    /// Its dark current above its neighbours, DN/s; `None` when it saturates every exposure.
    pub excess: Option<f32>,
}

/// A photosite is hot that stands so many standard deviations, or times its neighbours' scatter, above the brightest of
/// them.
const SIGNIFICANCE: f32 = 6.0;
/// Dark currents are relied upon to this share from shot to shot: they double every 6 to 8 K.
const DARK_CURRENT_ERROR: f32 = 0.1;
/// Neighbours of a photosite (x, y): the four beside it, then the four at its corners.
const NEIGHBOURS: [[isize; 2]; 8] = [[-1, 0], [1, 0], [0, -1], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]];

/// Finds the hot photosites of a merged black shot, in order of row, column, channel.
///
/// One whose eight neighbours are not all in the picture is left out, and so is the weaker one of two neighbours: the
/// tip of a bright corner looks the same. Its dark current goes out with the ambient light all the same.
///
/// Not detected: dead photosites, those whose noise is large but whose mean is not.
pub fn find_hot_pixels(dark: &Radiance) -> Vec<HotPixel> {
    let mut found = Vec::new();
    let r = dark.rect;
    for y in 1..r.height.saturating_sub(1) {
        for x in 1..r.width.saturating_sub(1) {
            for c in 0..3 {
                let k = 3 * (y * r.width + x) + c;
                // Most photosites end here.
                let row = dark.value[k - 3].max(dark.value[k + 3]);
                if dark.used[k] > 0 && dark.value[k] <= row {
                    continue;
                }
                let mut around = NEIGHBOURS.map(|d| dark.value[beside(k, d, r.width)]);
                let largest = around.iter().copied().fold(f32::MIN, f32::max);
                if dark.used[k] > 0 && dark.value[k] <= largest {
                    continue;
                }
                let measured = NEIGHBOURS.iter().filter(|&&d| dark.used[beside(k, d, r.width)] > 0).count();
                // Where all around saturates too there is light.
                if measured < 7 {
                    continue;
                }
                around.sort_by(f32::total_cmp);
                let hot = match dark.used[k] {
                    0 => Some(None),
                    _ => {
                        let scatter = (around[5] - around[2]).max(dark.variance[k].sqrt());
                        let stands_out = dark.value[k] - around[7] > SIGNIFICANCE * scatter;
                        stands_out.then(|| Some(dark.value[k] - 0.5 * (around[3] + around[4])))
                    }
                };
                found.extend(hot.map(|excess| HotPixel { at: [r.x + x, r.y + y, c], excess }));
            }
        }
    }
    found
}

fn beside(k: usize, d: [isize; 2], width: usize) -> usize {
    // Interior photosites only: never below zero.
    (k as isize + 3 * (d[1] * width as isize + d[0])) as usize
}

/// Puts the neighbours' light into the hot photosites of `light` (ambient light and dark current already subtracted),
/// by inverse variance with their own: what is left of their dark current is a tenth of it.
///
/// The neighbours give what they would if light were a quadratic there; its variance holds the whole of the quadratic
/// part. `hot` in the order of [`find_hot_pixels`].
pub fn mend(light: &mut Radiance, hot: &[HotPixel]) {
    let r = light.rect;
    let first = hot.partition_point(|h| h.at[1] < r.y);
    let last = hot.partition_point(|h| h.at[1] < r.y + r.height);
    let inside = hot[first..last].iter().filter(|h| (r.x..r.x + r.width).contains(&h.at[0]));
    let inside: Vec<(usize, HotPixel)> = inside.map(|h| (light.at(h.at[0], h.at[1]) + h.at[2], *h)).collect();
    // From what was there before: an order of mending would show.
    let mended: Vec<(usize, f32, f32)> = inside
        .iter()
        .filter_map(|&(k, h)| {
            let (value, variance) = around(light, k, h, &inside)?;
            let own = h.excess.filter(|_| light.used[k] > 0);
            let Some(excess) = own else { return Some((k, value, variance)) };
            let doubted = light.variance[k] + (DARK_CURRENT_ERROR * excess).powi(2);
            let (a, b) = (1.0 / variance.max(f32::MIN_POSITIVE), 1.0 / doubted.max(f32::MIN_POSITIVE));
            Some((k, (a * value + b * light.value[k]) / (a + b), 1.0 / (a + b)))
        })
        .collect();
    for (k, value, variance) in mended {
        (light.value[k], light.variance[k], light.used[k]) = (value, variance, light.used[k].max(1));
    }
}

/// Value and variance from the neighbours that are measured and not hot; `None` with fewer than four.
fn around(light: &Radiance, k: usize, h: HotPixel, hot: &[(usize, HotPixel)]) -> Option<(f32, f32)> {
    let r = light.rect;
    let (x, y) = ((h.at[0] - r.x) as isize, (h.at[1] - r.y) as isize);
    let neighbour = |d: [isize; 2]| {
        let inside = x + d[0] >= 0 && y + d[1] >= 0 && x + d[0] < r.width as isize && y + d[1] < r.height as isize;
        let n = inside.then(|| beside(k, d, r.width))?;
        let good = light.used[n] > 0 && hot.binary_search_by_key(&n, |h| h.0).is_err();
        good.then(|| (light.value[n], light.variance[n]))
    };
    let all = NEIGHBOURS.map(neighbour);
    let mean = |of: &[Option<(f32, f32)>]| {
        let n = of.iter().flatten().count() as f32;
        of.iter().flatten().fold((0.0, 0.0), |(m, v), (value, variance)| (m + value / n, v + variance / (n * n)))
    };
    if all.iter().all(Option::is_some) {
        let (beside, corners) = (mean(&all[..4]), mean(&all[4..]));
        let curve = beside.0 - corners.0;
        return Some((beside.0 + curve, 4.0 * beside.1 + corners.1 + curve * curve));
    }
    let known = all.iter().flatten().count();
    let (value, variance) = mean(&all);
    let spread = all.iter().flatten().map(|n| (n.0 - value).powi(2)).sum::<f32>() / known as f32;
    (known >= 4).then_some((value, variance + spread))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Rect;
    use rand::SeedableRng;
    use rand_distr::{Distribution, Normal};

    const SIDE: usize = 60;

    fn picture(light: impl Fn(f64, f64) -> f64, sd: f64, seed: u64) -> Radiance {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let noise = Normal::new(0.0, sd).unwrap();
        let value = |k: usize| (light((k / 3 % SIDE) as f64, (k / 3 / SIDE) as f64) + noise.sample(&mut rng)) as f32;
        let n = 3 * SIDE * SIDE;
        let rect = Rect { x: 100, y: 40, width: SIDE, height: SIDE };
        Radiance { rect, value: (0..n).map(value).collect(), variance: vec![(sd * sd) as f32; n], used: vec![3; n] }
    }

    #[test]
    fn hot_photosites_are_found_and_neither_edges_nor_noise_are() {
        // An edge between two materials runs across.
        let mut dark = picture(|x, y| if x + 0.3 * y > 30.0 { 400.0 } else { 200.0 }, 3.0, 1);
        assert_eq!(find_hot_pixels(&dark), []);
        let (hot, stuck) = (dark.at(120, 60) + 1, dark.at(131, 71));
        dark.value[hot] += 80.0;
        (dark.value[stuck], dark.used[stuck]) = (0.0, 0);
        let found = find_hot_pixels(&dark);
        assert_eq!(found.iter().map(|h| h.at).collect::<Vec<_>>(), [[120, 60, 1], [131, 71, 0]]);
        assert!((found[0].excess.unwrap() - 80.0).abs() < 15.0 && found[1].excess.is_none(), "{found:?}");
    }

    /// A dot of Gaussian shape with a width of 2 px: the worst that a window holds.
    #[test]
    fn mended_light_is_as_far_off_as_its_variance_says() {
        let dot = |x: f64, y: f64| 5000.0 * (-((x - 30.3).powi(2) + (y - 29.6).powi(2)) / 8.0).exp() + 50.0;
        let (mut square, mut worst) = (0.0, 0.0f64);
        let mut count = 0.0;
        for seed in 0..40 {
            let mut light = picture(dot, 5.0, seed);
            let (x, y) = (20 + (7 * seed as usize) % 21, 20 + (11 * seed as usize) % 21);
            let at = [100 + x, 40 + y, 2];
            let k = light.at(at[0], at[1]) + 2;
            (light.value[k], light.used[k]) = (0.0, 0);
            mend(&mut light, &[HotPixel { at, excess: None }]);
            let error = (f64::from(light.value[k]) - dot(x as f64, y as f64)) / f64::from(light.variance[k]).sqrt();
            assert_eq!(light.used[k], 1);
            (square, worst, count) = (square + error * error, worst.max(error.abs()), count + 1.0);
        }
        // In units of the stated standard deviation: never far above one; it may be below, the doubt is on the safe
        // side.
        assert!((square / count).sqrt() < 1.1 && worst < 3.5, "{} {worst}", (square / count).sqrt());
    }

    /// 6 × 5 photosites at (100, 40), three channels apart, no two alike.
    fn small(value: impl Fn(usize, usize, usize) -> f32, variance: impl Fn(usize, usize, usize) -> f32) -> Radiance {
        let at = |k: usize| (100 + k / 3 % 6, 40 + k / 18, k % 3);
        let all =
            |f: &dyn Fn(usize, usize, usize) -> f32| (0..90).map(at).map(|(x, y, c)| f(x, y, c)).collect::<Vec<_>>();
        let rect = Rect { x: 100, y: 40, width: 6, height: 5 };
        Radiance { rect, value: all(&value), variance: all(&variance), used: vec![2; 90] }
    }

    #[test]
    fn a_photosite_is_hot_six_deviations_above_the_brightest_beside_it() {
        // Green photosite (103, 41) among neighbours of 10 to 19, whose middle four spread over 17 − 12 = 5.
        let ring = [[10.0, 11.0, 12.0], [13.0, 0.0, 15.0], [17.0, 18.0, 19.0]];
        let around = |x: usize, y: usize, hot: f32| match (x, y) {
            (103, 41) => hot,
            (102..=104, 40..=42) => ring[y - 40][x - 102],
            _ => 14.0,
        };
        let found = |hot: f32, variance: f32| {
            find_hot_pixels(&small(|x, y, c| if c == 1 { around(x, y, hot) } else { 14.0 }, |_, _, _| variance))
        };
        assert_eq!(found(19.0 + 30.0, 1.0), []);
        // The median of the eight is 14.
        assert_eq!(found(49.5, 1.0), [HotPixel { at: [103, 41, 1], excess: Some(35.5) }]);
        // With more noise than scatter, that of the noise: 19 + 6 · 8.
        assert_eq!(found(67.0, 64.0), []);
        assert_eq!(found(67.5, 64.0), [HotPixel { at: [103, 41, 1], excess: Some(53.5) }]);
        // A dark photosite is not hot.
        assert_eq!(found(-400.0, 1.0), []);
    }

    #[test]
    fn a_photosite_that_saturates_among_seven_that_do_not_is_hot() {
        let mut dark = small(|x, y, _| (x + 2 * y) as f32, |_, _, _| 1.0);
        let (k, beside) = (dark.at(104, 43) + 2, dark.at(105, 44) + 2);
        (dark.value[k], dark.used[k]) = (0.0, 0);
        assert_eq!(find_hot_pixels(&dark), [HotPixel { at: [104, 43, 2], excess: None }]);
        dark.used[beside] = 0;
        assert_eq!(find_hot_pixels(&dark), [HotPixel { at: [104, 43, 2], excess: None }]);
        let other = dark.at(103, 42) + 2;
        dark.used[other] = 0;
        // Six are too few; that one has seven itself.
        assert_eq!(find_hot_pixels(&dark), [HotPixel { at: [103, 42, 2], excess: None }]);
        // On the rim nothing is told, and in pictures without an inside.
        let mut rim = small(|_, _, _| 1.0, |_, _, _| 1e-6);
        for (x, y) in [(100, 42), (105, 42), (102, 40), (102, 44)] {
            let k = rim.at(x, y);
            rim.value[k] = 1e6;
        }
        assert_eq!(find_hot_pixels(&rim), []);
        let rect = Rect { x: 0, y: 0, width: 1, height: 1 };
        assert_eq!(
            find_hot_pixels(&Radiance { rect, value: vec![9.0; 3], variance: vec![1.0; 3], used: vec![1; 3] }),
            []
        );
    }

    /// A quadratic, whose value in the middle the neighbours know: twice the mean of the four beside less that of the
    /// four at the corners.
    fn bowl(x: usize, y: usize, c: usize) -> f32 {
        let (x, y) = (x as f32 - 102.0, y as f32 - 41.0);
        [100.0 + 3.0 * x - 2.0 * y + x * x, 200.0 + 5.0 * x + 2.0 * x * x - 4.0 * y * y, 50.0 - x + 6.0 * y * y][c]
    }

    fn spread(x: usize, y: usize, c: usize) -> f32 {
        (c + 1) as f32 * (1.0 + (x - 100) as f32 + 10.0 * (y - 40) as f32)
    }

    /// What the eight around (102, 41) say: value, variance.
    fn expected(c: usize) -> (f32, f32) {
        let sum = |places: [[usize; 2]; 4]| places.iter().map(|p| spread(p[0], p[1], c)).sum::<f32>() / 16.0;
        let beside = sum([[101, 41], [103, 41], [102, 40], [102, 42]]);
        let corners = sum([[101, 40], [103, 40], [101, 42], [103, 42]]);
        // Half the second derivatives: 1, 2 − 4, 6; their half is what corners and sides differ by.
        let curve = [0.5, -1.0, 3.0][c];
        ([100.0, 200.0, 50.0][c], 4.0 * beside + corners + curve * curve)
    }

    #[test]
    fn a_photosite_that_says_nothing_is_what_a_quadratic_through_its_neighbours_is() {
        for c in 0..3 {
            let mut light = small(bowl, spread);
            let k = light.at(102, 41) + c;
            let before = light.clone();
            (light.value[k], light.used[k]) = (1e9, 0);
            mend(&mut light, &[HotPixel { at: [102, 41, c], excess: None }]);
            let (value, variance) = expected(c);
            // f32 sums of a few numbers.
            assert!((light.value[k] - value).abs() < 1e-4 && (light.variance[k] / variance - 1.0).abs() < 1e-5, "{c}");
            assert_eq!(light.used[k], 1);
            // Nothing else is touched.
            light.value[k] = before.value[k];
            assert_eq!(light.value, before.value);
        }
    }

    #[test]
    fn a_hot_photosite_counts_by_what_a_tenth_of_its_dark_current_leaves_it() {
        for (c, excess) in [(0, 30.0), (1, 300.0), (2, 1e5)] {
            let mut light = small(bowl, spread);
            let k = light.at(102, 41) + c;
            light.value[k] += 7.0;
            mend(&mut light, &[HotPixel { at: [102, 41, c], excess: Some(excess) }]);
            let (value, variance) = expected(c);
            let own = spread(102, 41, c) + (0.1 * excess).powi(2);
            let (a, b) = (1.0 / variance, 1.0 / own);
            let both = (a * value + b * (value + 7.0)) / (a + b);
            // f32.
            assert!((light.value[k] - both).abs() < 1e-3, "{c}: {} {both}", light.value[k]);
            assert!((light.variance[k] * (a + b) - 1.0).abs() < 1e-5, "{c}");
            assert_eq!(light.used[k], 2);
        }
    }

    #[test]
    fn with_some_neighbours_missing_the_others_mean_and_scatter_are_taken() {
        // In the corner three are left, and with a fourth from nowhere nothing is done; on the rim five.
        let hot = |x, y| HotPixel { at: [x, y, 1], excess: None };
        let mut light = small(bowl, spread);
        let before = light.clone();
        mend(&mut light, &[hot(100, 40)]);
        assert_eq!(light, before);
        let k = light.at(105, 42) + 1;
        light.used[k] = 0;
        mend(&mut light, &[hot(105, 42)]);
        let places = [[104, 41], [105, 41], [104, 42], [104, 43], [105, 43]];
        let of = |p: [usize; 2]| (bowl(p[0], p[1], 1), spread(p[0], p[1], 1));
        let mean = places.iter().map(|&p| of(p).0).sum::<f32>() / 5.0;
        let noise = places.iter().map(|&p| of(p).1).sum::<f32>() / 25.0;
        let scatter = places.iter().map(|&p| (of(p).0 - mean).powi(2)).sum::<f32>() / 5.0;
        // f32.
        assert!((light.value[k] - mean).abs() < 1e-3, "{} {mean}", light.value[k]);
        assert!((light.variance[k] / (noise + scatter) - 1.0).abs() < 1e-5);
        // A neighbour that is hot or was not measured is not used, nor is one of another channel or outside the
        // picture.
        let mut light = small(bowl, spread);
        let gone = light.at(104, 41) + 1;
        light.used[gone] = 0;
        let all = [
            hot(104, 12),
            hot(90, 41),
            hot(104, 42),
            HotPixel { at: [104, 43, 0], excess: None },
            hot(105, 43),
            hot(103, 44),
            hot(104, 99),
        ];
        let k = light.at(104, 42) + 1;
        mend(&mut light, &all);
        let places = [[103, 41], [105, 41], [103, 42], [105, 42], [103, 43], [104, 43]];
        let mean = places.iter().map(|&p| of(p).0).sum::<f32>() / 6.0;
        assert!((light.value[k] - mean).abs() < 1e-3, "{} {mean}", light.value[k]);
    }
}
