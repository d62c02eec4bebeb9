//! The example for a renderer's author runs, and what it estimates by drawing is the sum that it stands for.

#[path = "../examples/shade.rs"]
#[allow(dead_code, unreachable_pub)]
mod shade;

use acquire_material::{Evaluator, Material};

#[test]
fn the_example_estimates_the_light_that_leaves() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/chessboard.safetensors");
    let (response, left) = shade::shade(path).unwrap();
    let material = Material::load(path).unwrap();
    let (header, evaluator) = (&material.header, Evaluator::new(&material).unwrap());
    let lit = header.rows() / 2;
    let x_i = material.lit_mm[lit];
    assert_eq!(response, evaluator.between(x_i, [x_i[0] + 0.3, x_i[1] - 0.2]));
    assert!(response.iter().all(|&r| r > 0.0), "{response:?}");
    // The whole of the extended window, a sample at a time.
    let [width, height] = header.extended.map(|n| n as isize / 2);
    let mut all = [0.0; 3];
    for offset in (-height..=height).flat_map(|y| (-width..=width).map(move |x| [x, y])) {
        for (sum, r) in all.iter_mut().zip(evaluator.response(lit, offset).unwrap_or_default()) {
            *sum += f64::from(r) * header.pitch_mm.powi(2);
        }
    }
    for (left, all) in left.iter().zip(all) {
        // A thousand draws in equal steps of a probability that follows the mean of the planes.
        assert!((left / all - 1.0).abs() < 0.05, "{left} {all}");
    }
}
