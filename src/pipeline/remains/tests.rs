use super::*;
use crate::pipeline::reference_dots::DotsShow;

/// Light of this share, over that of the dots, in the places of patterns so many shots later: by channel.
fn results(light: impl Fn(isize, usize) -> f64) -> Vec<ShotResult> {
    let spots =
        |rise: &dyn Fn(usize) -> f64, around: f64| [0, 1, 2].map(|c| Spot { rise: rise(c), variance: 1e-8, around });
    // What places differ by, a hundredth of the sample's light there.
    let odd = |k: usize, later: isize| 0.01 * ((7 * k) as f64 + 3.0 * later as f64).sin();
    let shot = |k: usize| {
        let elsewhere = |later: isize| {
            let around = 0.02 + 0.005 * later as f64;
            let rise = |c: usize| (light(later, c) + (odd(k, later) - 0.08) * around) * 5.0;
            Elsewhere { later, number: 0, spots: spots(&rise, 5.0 * around) }
        };
        let there = LATER.into_iter().filter(|l| k.checked_add_signed(*l).is_some_and(|k| k < 9));
        ShotResult {
            lit: vec![],
            drift: None,
            camera: None,
            flicker_variance: 0.0,
            lamp: None,
            dots_show: DotsShow::default(),
            seen: vec![],
            spots: Spots { own: vec![Some(spots(&|_| 5.0, 0.1))], elsewhere: there.map(elsewhere).collect() },
        }
    };
    (0..9).map(shot).collect()
}

#[test]
fn light_of_another_pattern_is_told_with_its_share_and_pattern_and_structure_is_not() {
    assert_eq!(find(&results(|_, _| 0.0)), None);
    for (of, share) in [(-1, 0.1), (-1, 0.01), (1, 0.03), (-2, 0.02)] {
        let found = find(&results(|later, _| if later == of { share } else { 0.0 }));
        let Some(ConsistencyWarning::PatternRemains { later, share: found, channel, .. }) = found else {
            panic!("{of} {share}")
        };
        assert_eq!((later, channel), (of, None));
        // A hundredth of a fiftieth, as the places differ.
        assert!((found - share).abs() < 5e-4, "{found} {share}");
    }
    // Two on there is no light yet: what is there is the sample's.
    assert_eq!(find(&results(|later, _| if later == 2 { 0.1 } else { 0.0 })), None);
}

#[test]
fn a_lag_of_two_patterns_is_that_of_the_nearer() {
    let found = find(&results(|later, _| [0.02, 0.08, 0.0, 0.0][LATER.iter().position(|l| *l == later).unwrap()]));
    assert!(matches!(found, Some(ConsistencyWarning::PatternRemains { later: -1, .. })), "{found:?}");
}

#[test]
fn light_in_one_channel_alone_is_told_as_that() {
    let found = find(&results(|later, c| if later == -1 && c == 2 { 0.04 } else { 0.0 }));
    let Some(ConsistencyWarning::PatternRemains { share, channel: Some(2), .. }) = found else { panic!("{found:?}") };
    assert!((share - 0.04).abs() < 5e-4, "{share}");
    let found = find(&results(|later, c| if later == -1 { 0.04 + 0.01 * c as f64 } else { 0.0 }));
    assert!(matches!(found, Some(ConsistencyWarning::PatternRemains { channel: None, .. })), "{found:?}");
}

#[test]
fn a_dot_rises_from_a_slope_by_its_own_light() {
    let rect = Rect { x: 3, y: 5, width: 21, height: 19 };
    let at = [13.3, 14.6];
    let light = |x: f64, y: f64| 2.0 + 0.1 * x - 0.2 * y + if (x - at[0]).hypot(y - at[1]) <= 3.0 { 1.5 } else { 0.0 };
    let value = (0..rect.area()).flat_map(|k| {
        let v = light((rect.x + k % rect.width) as f64, (rect.y + k / rect.width) as f64) as f32;
        [v, 2.0 * v, 3.0 * v]
    });
    let mut picture = Radiance {
        rect,
        value: value.collect(),
        variance: vec![0.01; 3 * rect.area()],
        used: vec![1; 3 * rect.area()],
    };
    let found = spots(&picture, at, 3.0).unwrap();
    for (c, spot) in found.iter().enumerate() {
        let times = (c + 1) as f64;
        // Light in f32.
        assert!((spot.rise - 1.5 * times).abs() < 1e-4, "{spot:?}");
        assert!((spot.around - times * (2.0 + 0.1 * at[0] - 0.2 * at[1])).abs() < 1e-4, "{spot:?}");
        // 0.01 over some 28 pixels, and over some 60 of the ring.
        assert!(spot.variance > 3e-4 && spot.variance < 8e-4, "{spot:?}");
    }
    assert_eq!(spots(&picture, [7.0, 14.6], 3.0), None, "the ring ends beside the picture");
    picture.used[3 * (9 * 21 + 10)] = 0;
    assert_eq!(spots(&picture, at, 3.0), None, "a saturated pixel");
}
