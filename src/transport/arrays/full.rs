//! Full matrices: how large a window holds their light.

/// A default window leaves out this share of the light at most: a tenth of what a white reference is good to.
const LEFT_OUT: f64 = 1e-3;

/// The window along x and y, and the share of the light (the sum of magnitudes) that lies outside it. `asked`, or the
/// smallest with as many samples to all sides that leaves out [`LEFT_OUT`] at most; along an axis with fewer points no
/// more than reach all of them.
pub(super) fn window(
    response: &[f32],
    points: [usize; 2],
    channels: usize,
    asked: Option<[usize; 2]>,
) -> ([usize; 2], f64) {
    let [nx, ny] = points;
    let n = nx * ny;
    let within = |half: [usize; 2], i: usize, o: usize| {
        (i % nx).abs_diff(o % nx) <= half[0] && (i / nx).abs_diff(o / nx) <= half[1]
    };
    // Light by the larger of the two distances along the axes, and in all.
    let mut by_distance = vec![0.0; nx.max(ny)];
    let mut inside = 0.0;
    for (k, values) in response.chunks_exact(channels).enumerate() {
        let (i, o) = (k / n, k % n);
        let light: f64 = values.iter().filter(|v| v.is_finite()).map(|v| f64::from(v.abs())).sum();
        by_distance[(i % nx).abs_diff(o % nx).max((i / nx).abs_diff(o / nx))] += light;
        if asked.is_some_and(|window| within(window.map(|w| w / 2), i, o)) {
            inside += light;
        }
    }
    let all: f64 = by_distance.iter().sum();
    let share = |inside: f64| if all > 0.0 { ((all - inside) / all).max(0.0) } else { 0.0 };
    if let Some(window) = asked {
        return (window, share(inside));
    }
    let mut sum = 0.0;
    let mut half = 0;
    for (distance, light) in by_distance.iter().enumerate() {
        (half, sum) = (distance, sum + light);
        if share(sum) <= LEFT_OUT {
            break;
        }
    }
    let window = points.map(|points| 2 * half.min(points - 1) + 1);
    (window, share(sum))
}
