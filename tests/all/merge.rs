//! Merged radiance against the Cramér–Rao bound of the sensor that took the photographs; the example that merges a
//! bracket.

#[path = "../../examples/merge_bracket.rs"]
#[allow(dead_code, unreachable_pub)]
mod merge_bracket;
use crate::merge_levels::{Bracketing, measure};
use crate::photon_sensor::PhotonSensor;
use std::path::Path;

/// The default bracket of the simulator, five decades and the neighbourhood of every saturation.
#[test]
fn merged_radiance_reaches_the_bound_of_the_photons_over_five_decades() {
    let bracketing =
        Bracketing { sensor: PhotonSensor::SONY_A7R3, shortest_secs: 1.0 / 256.0, exposures: 5, stops: 2.0 };
    for level in bracketing.levels(5, 8) {
        let found = measure(&bracketing, level, 60_000, 1);
        let text = format!("{level:.3e} e/s: {found:?}");
        // 60,000 samples: the mean squared error is known to 0.6 %, the mean to its standard error.
        assert!(found.bias.abs() < 1e-3 + 4.0 * found.standard_error, "{text}");
        if bracketing.near_saturation(level) {
            // Within three standard deviations chance decides which exposures count, which the bound does not know.
            assert!(found.of_bound < 1.7, "{text}");
        } else {
            // Just outside, raising to saturation makes the error a little smaller than any unbiased estimate has.
            assert!((0.93..1.05).contains(&found.of_bound), "{text}");
            assert!((0.95..1.05).contains(&found.stated), "{text}");
        }
    }
}

/// A weighted mean of two exposures lies between them, and is known better than the worse of them.
#[test]
fn the_example_gives_a_mean_of_what_each_exposure_says() {
    let capture = acquire::capture::Capture::open(Path::new("captures"), None).unwrap();
    let shot = capture.manifest.shots.iter().position(|s| s.name == "reference-white").unwrap();
    let pixel @ [x, y] = [80, 70];
    let (radiance, sd, used) = merge_bracket::radiance_at(Path::new("captures"), "reference-white", pixel).unwrap();
    for c in 0..3 {
        // The definition of sRGB; the capture's black level is 0, and 250 saturates.
        let says = |p: &acquire::capture::Photograph| {
            let code = image::open(&p.path).unwrap().to_rgb8().get_pixel(x as u32, y as u32)[c];
            let v = f64::from(code) / 255.0;
            let linear = if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
            (code < 250).then_some(255.0 * linear / p.effective_secs)
        };
        let each: Vec<f64> = capture.brackets[shot].iter().filter_map(says).collect();
        let (low, high) = (each.iter().copied().fold(f64::MAX, f64::min), each.iter().copied().fold(0.0, f64::max));
        assert_eq!(usize::from(used[c]), each.len());
        // Tables and sums of the merge are f32.
        assert!(radiance[c] > low * (1.0 - 1e-5) && radiance[c] < high * (1.0 + 1e-5), "{low} {} {high}", radiance[c]);
        // 8 bits and JPEG: one code value of a hundred or more, which the sRGB curve makes about two per cent.
        assert!(sd[c] > 1e-4 * radiance[c] && sd[c] < 0.03 * radiance[c], "{} ± {}", radiance[c], sd[c]);
    }
    for (shot, pixel) in [("reference-grey", pixel), ("reference-white", [159, 0])] {
        let refused = merge_bracket::radiance_at(Path::new("captures"), shot, pixel);
        assert!(matches!(refused, Err(acquire::Error::Field { .. })), "{refused:?}");
    }
}
