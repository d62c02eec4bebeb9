//! Merged radiance against the Cramér–Rao bound of the sensor that took the photographs.

#[path = "common/merge_levels.rs"]
mod merge_levels;
#[path = "common/photon_sensor.rs"]
mod photon_sensor;

use merge_levels::{Bracketing, measure};
use photon_sensor::PhotonSensor;

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
