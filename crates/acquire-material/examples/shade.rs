//! A renderer's two uses of a material: the response from one point of the slab to another, and offsets drawn for it.
//!
//! `cargo run -p acquire-material --example shade -- slab.safetensors`

use acquire_material::{Evaluator, Material, Result};

fn main() -> Result<()> {
    let of_the_tests = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/chessboard.safetensors");
    shade(&std::env::args().nth(1).unwrap_or(of_the_tests.into())).map(|_| ())
}

/// The response between two points and the shares that leave, as they are printed.
pub fn shade(path: &str) -> Result<([f32; 3], [f64; 3])> {
    let material = Material::load(path)?;
    println!("{}, {:?} lit points", material.header.describe(), material.header.points);
    let evaluator = Evaluator::new(&material)?;

    // Light enters at x_i and leaves at x_o, both in mm on the slab: mm⁻² in R, G and B.
    let x_i = material.lit_mm[material.header.rows() / 2];
    let x_o = [x_i[0] + 0.3, x_i[1] - 0.2];
    let response = evaluator.between(x_i, x_o);
    println!("R_d({x_i:?}, {x_o:?}) = {response:?} mm⁻²");

    // The share of the light into one lit point that leaves near it, by drawing offsets: weight each by 1 /
    // probability.
    let (lit, draws, cell_mm2) = (material.header.rows() / 2, 1000, material.header.pitch_mm.powi(2));
    let mut left = [0.0; 3];
    for n in 0..draws {
        let Some(drawn) = evaluator.sample(lit, (n as f64 + 0.5) / draws as f64) else { break };
        let of_offset = evaluator.response(lit, drawn.offset).unwrap_or_default();
        for c in 0..3 {
            left[c] += f64::from(of_offset[c]) * cell_mm2 / (drawn.probability * draws as f64);
        }
    }
    println!("of the light into it, these shares leave within its window: {left:.3?}");
    Ok((response, left))
}
