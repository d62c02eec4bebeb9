//! Pictures worked out by hand for the tests of this folder.

use super::{LensChoice, Registration};
use crate::capture::Rect;
use crate::geometry::{CameraView, Homography, Lens, Point, SlabFromProjector};
use crate::radiance::Radiance;

/// A picture whose pixels' mean over the channels is `light` at (x, y), every channel its own share of it; the variance
/// of that mean is `variance`, every channel its own share too.
pub(super) fn picture(rect: Rect, light: impl Fn(f64, f64) -> f64, variance: f64) -> Radiance {
    let n = 3 * rect.area();
    let at = |k: usize| ((rect.x + k / 3 % rect.width) as f64, (rect.y + k / 3 / rect.width) as f64);
    let value = |k: usize| (light(at(k).0, at(k).1) * [0.5, 1.75, 0.75][k % 3]) as f32;
    let noise = |k: usize| (variance * [1.0, 6.0, 2.0][k % 3]) as f32;
    Radiance { rect, value: (0..n).map(value).collect(), variance: (0..n).map(noise).collect(), used: vec![1; n] }
}

/// The mean of `inside` over the pixel at (x, y), from 12 × 12 places in it.
pub(super) fn share(x: f64, y: f64, inside: impl Fn(f64, f64) -> bool) -> f64 {
    let place = |k: usize| (k as f64 + 0.5) / 12.0 - 0.5;
    let lit = (0..144).filter(|k| inside(x + place(k % 12), y + place(k / 12))).count();
    lit as f64 / 144.0
}

/// How much of the pixel at (x, y) a rectangle covers. Where its sides are whole numbers of pixels its centroid is
/// exact.
pub(super) fn covered(x: f64, y: f64, center: Point, size: Point) -> f64 {
    let along = |at: f64, center: f64, size: f64| {
        let (low, high) = (center - 0.5 * size, center + 0.5 * size);
        (high.min(at + 0.5) - low.max(at - 0.5)).max(0.0)
    };
    along(x, center[0], size[0]) * along(y, center[1], size[1])
}

/// -1 to 1, a different number for every `k`.
pub(super) fn jitter(k: usize) -> f64 {
    let mixed = (k as u64 + 11).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(31).wrapping_mul(0xd1b5_4a32_d192_ed03);
    (mixed >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

/// Slab to camera px: six px a millimetre along x, four along y, turned a little.
pub(super) const CAMERA: Homography = Homography { matrix: [[6.0, 0.5, 40.0], [-1.0, 4.0, 45.0], [0.0, 0.0, 1.0]] };

/// A registration of which only the camera's view and the projector's plane matter.
pub(super) fn registration() -> Registration {
    let lens = Lens::ideal([100.0, 80.0], 300.0);
    let projector = Homography { matrix: [[5.0, 0.0, 7.0], [0.0, 3.0, 2.0], [0.0, 0.0, 1.0]] };
    Registration {
        view: CameraView { ideal_from_slab: CAMERA, lens },
        slab_from_projector: SlabFromProjector::new(projector, lens).unwrap(),
        center_mm: [15.0, 10.0],
        point_spread: None,
        camera_rms_px: 0.0,
        lens: LensChoice {
            views: 1,
            points: 80,
            radial_terms: 0,
            center: false,
            trials: Vec::new(),
            with_stripes: None,
        },
        projector_rms_px: 0.0,
        projector_ideal_rms_px: 0.0,
        projector_scale_sd: [0.0; 2],
        position_sd_mm: 0.0,
    }
}
