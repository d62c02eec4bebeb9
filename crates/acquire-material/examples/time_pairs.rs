//! Nanoseconds of a pair of points, on one thread and on all: what `python/tests/measure.py` compares itself with.
//!
//! `cargo run --release -p acquire-material --example time_pairs -- slab.safetensors`

use acquire_material::{Evaluator, Material, Point};
use rand::{RngExt, SeedableRng};
use rayon::prelude::*;
use std::time::Instant;

const PAIRS: usize = 1_000_000;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let path = std::env::args().nth(1).ok_or("expected the path of a material")?;
    let material = Material::load(&path)?;
    let evaluator = Evaluator::new(&material)?;
    let mut rng = rand_pcg::Pcg64::seed_from_u64(0);
    let places = |a: usize| material.lit_mm.iter().map(move |p| p[a]);
    let range = |a: usize| [places(a).fold(f64::MAX, f64::min), places(a).fold(f64::MIN, f64::max)];
    let [x, y] = [range(0), range(1)];
    let mut point = |near: Option<Point>| -> Point {
        let [u, v]: [f64; 2] = rng.random();
        match near {
            None => [x[0] + u * (x[1] - x[0]), y[0] + v * (y[1] - y[0])],
            // Within four millimetres: most of a window of 31 samples of half a millimetre.
            Some([x, y]) => [x + 8.0 * (u - 0.5), y + 8.0 * (v - 0.5)],
        }
    };
    let pairs: Vec<[Point; 2]> = (0..PAIRS)
        .map(|_| {
            let from = point(None);
            [from, point(Some(from))]
        })
        .collect();
    let best = |work: &dyn Fn() -> f32| {
        let secs = (0..5).map(|_| {
            let start = Instant::now();
            std::hint::black_box(work());
            start.elapsed().as_secs_f64()
        });
        secs.fold(f64::MAX, f64::min) * 1e9 / PAIRS as f64
    };
    let sum = |pair: &[Point; 2]| evaluator.between(pair[0], pair[1])[1];
    println!("between: {:.0} ns a pair on one thread", best(&|| pairs.iter().map(sum).sum()));
    println!("between: {:.0} ns a pair on all", best(&|| pairs.par_iter().map(sum).sum()));
    let sum = |pair: &[Point; 2]| evaluator.nearest(pair[0], pair[1])[1];
    println!("nearest: {:.0} ns a pair on one thread", best(&|| pairs.iter().map(sum).sum()));
    println!("nearest: {:.0} ns a pair on all", best(&|| pairs.par_iter().map(sum).sum()));
    Ok(())
}
