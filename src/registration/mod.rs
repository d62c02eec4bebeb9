//! Register: slab ↔ camera ↔ projector, and the drift of every lattice shot.

mod blobs;
mod board;
mod camera_motion;
mod corners;
mod dot_fit;
mod drift;
mod fit;
mod flipped_board;
mod frame_marks;
mod gray_code;
mod joint_fit;
mod jumps;
mod lens_fit;
#[cfg(test)]
mod pictures;
mod projector_fit;
mod rim_size;
mod sample_drift;
mod sharpness;
mod stripe_area;

pub use board::find_board;
pub use camera_motion::{CameraMotion, RimPlace, RimSegment, camera_motion, locate_rim, rim_segments};
pub use dot_fit::{DotShape, FoundDot};
pub use drift::{Drift, SeenDepth, measure_drift};
pub(crate) use drift::{median, scaled_deviation};
pub use fit::{Observation, ViewFit, fit_homography, fit_view};
pub use flipped_board::{FlippedBoard, flip_of_board};
pub use frame_marks::{FoundMark, FrameFit, marks_moved, register_frame};
pub use gray_code::{BitPair, StripeFit, register_projector};
pub use joint_fit::{SeenEdge, fit_lens_with_stripes};
pub use jumps::{Jump, find_jumps};
pub use lens_fit::{LensChoice, LensTrial, Pairs, fit_lens_of_views};
pub use projector_fit::{MapTrend, ProjectorFit, fit_projector};
pub use rim_size::{RimFit, fit_rim};
pub(crate) use sample_drift::DEPTH_OF_HALF_LIGHT;
pub use sample_drift::{DepthOfMedium, Located, Parallax, SampleDots};
pub use sharpness::{PointSpread, measure_point_spread};
pub use stripe_area::{StripeArea, StripeSurface};

use crate::geometry::{CameraView, Homography, Point, SlabFromProjector};
use serde::{Deserialize, Serialize};

/// Slab, camera and projector related to each other.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Registration {
    /// The camera's view of the slab's plane.
    pub view: CameraView,
    /// Projector px to slab mm.
    pub slab_from_projector: SlabFromProjector,
    /// The slab's centre, mm.
    pub center_mm: Point,
    /// The lens's blur, which the extraction takes out; `None` when no board tells.
    pub point_spread: Option<PointSpread>,
    /// RMS of the board's corners (or the frame's marks) against the model, camera px.
    pub camera_rms_px: f64,
    /// How the camera's lens was chosen.
    pub lens: LensChoice,
    /// RMS of the stripes' edges against the model, projector px.
    pub projector_rms_px: f64,
    /// The same against a projector without distortion, projector px.
    pub projector_ideal_rms_px: f64,
    /// Relative standard deviation of the scale of that map along the projector's axes: of a dot's area, both together.
    pub projector_scale_sd: [f64; 2],
    /// Standard deviation per axis of where a projected point is on the slab, relative to the camera's samples, mm
    /// (without drift).
    pub position_sd_mm: f64,
}

impl Registration {
    /// Camera px in a mm at the slab's centre.
    pub fn px_per_mm(&self) -> f64 {
        self.view.px_per_mm(self.center_mm)
    }

    /// The same with the camera's picture moved by `camera_px`.
    pub fn moved(&self, camera_px: Point) -> Self {
        let mut moved = self.clone();
        moved.view.ideal_from_slab = Homography::similarity(1.0, camera_px).after(&self.view.ideal_from_slab);
        moved.view.lens.center_px = [0, 1].map(|a| self.view.lens.center_px[a] + camera_px[a]);
        moved
    }

    /// Relative variance of the area of a dot, by the map's scale.
    pub fn dot_area_variance(&self) -> f64 {
        self.projector_scale_sd.iter().map(|sd| sd * sd).sum()
    }

    /// Puts the two fits together for a slab of `size_mm`; `None` when the projector's map cannot be inverted.
    pub fn new(
        camera: &ViewFit,
        lens: LensChoice,
        point_spread: Option<PointSpread>,
        projector: &ProjectorFit,
        size_mm: Point,
    ) -> Option<Self> {
        let slab_from_projector = projector.slab_from_projector;
        let center_mm = [size_mm[0] / 2.0, size_mm[1] / 2.0];
        let middle_px = slab_from_projector.projector_from_slab(center_mm);
        let projector_px_per_mm = (1.0 / slab_from_projector.area_scale(middle_px)).sqrt();
        if !projector_px_per_mm.is_finite() {
            return None;
        }
        // The stripes are seen by the same camera: an error of its view moves stripes and samples alike, and cancels to
        // first order.
        let position_sd_mm = projector.sd_px / projector_px_per_mm;
        Some(Self {
            view: camera.view,
            point_spread,
            slab_from_projector,
            center_mm,
            camera_rms_px: camera.rms_px,
            lens,
            projector_rms_px: projector.rms_px,
            projector_ideal_rms_px: projector.ideal_rms_px,
            projector_scale_sd: projector.scale_sd,
            position_sd_mm,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moved_picture_moves_the_view_and_its_lens_alike() {
        let mut still = pictures::registration();
        (still.view.lens.k1, still.view.lens.k2) = (-0.1, 0.02);
        let moved = still.moved([2.5, -1.25]);
        for p in [[0.0, 0.0], [15.0, 10.0], [28.0, 3.0]] {
            let (a, b) = (still.view.camera_from_slab(p), moved.view.camera_from_slab(p));
            assert!((b[0] - a[0] - 2.5).abs() < 1e-12 && (b[1] - a[1] + 1.25).abs() < 1e-12, "{a:?} {b:?}");
        }
        assert_eq!(moved.view.lens.center_px, [102.5, 78.75]);
        assert_eq!((moved.view.lens.k1, moved.slab_from_projector), (-0.1, still.slab_from_projector));
    }

    #[test]
    fn a_position_is_as_sure_as_the_stripes_in_millimetres() {
        let base = pictures::registration();
        let camera = ViewFit { view: base.view, rms_px: 0.11, sd_px: 0.01 };
        let projector = ProjectorFit {
            slab_from_projector: base.slab_from_projector,
            rms_px: 0.22,
            ideal_rms_px: 0.33,
            sd_px: 0.06,
            scale_sd: [0.01, 0.02],
            edges: 100,
            left_out: 0.0,
            trend: None,
        };
        let found = Registration::new(&camera, base.lens.clone(), None, &projector, [30.0, 20.0]).unwrap();
        // 5 by 3 projector px a millimetre: √15 on average.
        assert!((found.position_sd_mm - 0.06 / 15f64.sqrt()).abs() < 1e-15);
        assert_eq!((found.center_mm, found.camera_rms_px), ([15.0, 10.0], 0.11));
        assert_eq!((found.projector_rms_px, found.projector_ideal_rms_px), (0.22, 0.33));
        // The plane's determinant is 24.5; slopes are differences of 1e-4 mm.
        assert!((found.px_per_mm() - 24.5f64.sqrt()).abs() < 1e-6);
    }
}
