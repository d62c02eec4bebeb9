//! Merged radiance against the Cramér–Rao bound, level by level.
//!
//! `cargo bench --bench merge [-- PIXELS [SENSOR EXPOSURES STOPS]]`: SENSOR is sony-a7r3, canon-t1 or phone. With
//! `ACQUIRE_STACK=DIR` the stacks, the truth and what we make of them are written there instead, for benches/peers/hdr.

#[path = "../tests/common/merge_levels.rs"]
mod merge_levels;
#[path = "../tests/common/photon_sensor.rs"]
mod photon_sensor;

use merge_levels::{Bracketing, Taken, measure, take};
use photon_sensor::PhotonSensor;
use rayon::prelude::*;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let number = |k: usize, default: f64| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(default);
    let sensor = match args.get(1).map(String::as_str) {
        Some("canon-t1") => PhotonSensor::CANON_T1,
        Some("phone") => PhotonSensor::PHONE,
        _ => PhotonSensor::SONY_A7R3,
    };
    let bracketing =
        Bracketing { sensor, shortest_secs: 1.0 / 256.0, exposures: number(2, 5.0) as usize, stops: number(3, 2.0) };
    let pixels = number(0, 200_000.0) as usize;
    if let Some(dir) = std::env::var_os("ACQUIRE_STACK") {
        return write_stack(&bracketing, pixels, dir.as_ref()).expect("the stack's folder can be written to");
    }
    let levels = bracketing.levels(5, 24);
    let found: Vec<_> = levels.par_iter().map(|&l| measure(&bracketing, l, pixels, 1)).collect();
    println!("   e/s        rms %    mse/bound    bias % (± se)      stated/mse");
    let (mut worst, mut near_worst, mut bias) = (0.0f64, 0.0f64, 0.0f64);
    for (&level, f) in levels.iter().zip(&found) {
        let near = bracketing.near_saturation(level);
        let mark = if near { "near saturation" } else { "" };
        println!(
            "{level:10.3e}  {:7.3}  {:9.3}   {:+8.4} ± {:.4}  {:9.3}  {mark}",
            100.0 * f.relative_rms,
            f.of_bound,
            100.0 * f.bias,
            100.0 * f.standard_error,
            f.stated
        );
        let of = if near { &mut near_worst } else { &mut worst };
        *of = of.max(f.of_bound);
        bias = bias.max((f.bias.abs() - 2.0 * f.standard_error).max(0.0));
    }
    println!(
        "largest mse/bound: {worst:.3}, near saturation {near_worst:.3}; largest bias beyond two standard errors {:.4} %",
        100.0 * bias
    );
}

/// Rows of a level in the pictures of the stack: two, so that it holds whole blocks of a Bayer mosaic.
const ROWS: usize = 2;

/// Grey 16-bit pictures `exposure-K.png`, a level in every two rows; `stack.json`; `value.f32`, `variance.f32`,
/// `used.u8` of our merge.
fn write_stack(
    bracketing: &Bracketing,
    pixels: usize,
    dir: &std::path::Path,
) -> Result<(), Box<dyn std::error::Error>> {
    std::fs::create_dir_all(dir)?;
    let width = (pixels / ROWS).next_multiple_of(6);
    let mut levels = bracketing.levels(5, 8);
    // What no exposure measures, and no light at all.
    levels.extend([3.0 * bracketing.top(), 0.0]);
    let stacks: Vec<_> = levels.par_iter().map(|&level| take(bracketing, level, ROWS * width, 2)).collect();
    for k in 0..bracketing.exposures {
        let codes: Vec<u16> = stacks.iter().flat_map(|s| s.codes[k].iter().copied()).collect();
        let picture =
            image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width as u32, (ROWS * levels.len()) as u32, codes);
        picture.ok_or("a picture of another size")?.save(dir.join(format!("exposure-{k}.png")))?;
    }
    let floats = |of: fn(&Taken) -> &[f32]| -> Vec<u8> {
        stacks.iter().flat_map(|s| of(s).iter().flat_map(|v| v.to_le_bytes())).collect()
    };
    std::fs::write(dir.join("value.f32"), floats(|s| &s.merged.value))?;
    std::fs::write(dir.join("variance.f32"), floats(|s| &s.merged.variance))?;
    std::fs::write(dir.join("used.u8"), stacks.iter().flat_map(|s| s.merged.used.clone()).collect::<Vec<u8>>())?;
    let sensor = bracketing.sensor;
    let bounds: Vec<f64> = levels.iter().map(|&l| if l > 0.0 { bracketing.bound(l) } else { 0.0 }).collect();
    let text = serde_json::to_string_pretty(&serde_json::json!({
        "exposure_secs": bracketing.times(),
        "electrons_per_sec": levels,
        "bound_variance": bounds,
        "near_saturation": levels.iter().map(|&l| bracketing.near_saturation(l)).collect::<Vec<_>>(),
        "gain_dn_per_electron": sensor.gain_dn_per_electron,
        "read_noise_electrons": sensor.read_noise_electrons,
        "black_dn": sensor.black_dn,
        "saturation_dn": sensor.saturation_dn,
        "max_dn": sensor.max_dn,
        "width": width,
        "rows": ROWS,
    }))?;
    std::fs::write(dir.join("stack.json"), text)?;
    Ok(())
}
