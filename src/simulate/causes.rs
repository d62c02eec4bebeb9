//! What makes a real bench differ from an ideal one, each with a switch, so that an error can be blamed on one cause.

use super::{CameraCurve, SimulateOptions};
use crate::{Error, Result};

/// One imperfection of the bench.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Cause {
    /// Photon and read noise.
    Noise,
    /// The lens's point-spread function.
    Psf,
    /// The lens's wide halo.
    Glare,
    /// Lens distortion.
    Distortion,
    /// Vignetting.
    Vignetting,
    /// Hot pixels.
    HotPixels,
    /// A film-like response curve that the rig file does not tell.
    Film,
    /// Exposure times that EXIF gives wrong.
    Exif,
    /// A lamp that flickers.
    Flicker,
    /// Ambient light.
    Ambient,
    /// Uneven projector light.
    Falloff,
    /// An uneven white reference.
    WhiteUnevenness,
    /// Light of black projector pixels.
    ProjectorBlack,
    /// Blurred projector pixels.
    Blur,
    /// Distortion of the projector's lens.
    ProjectorDistortion,
    /// Slow walk of the projected pattern.
    Drift,
    /// Jumps of the projected pattern.
    Jumps,
    /// Slow walk of the camera.
    CameraDrift,
    /// Jumps of the camera.
    CameraJumps,
}

impl Cause {
    /// All of them.
    pub const ALL: [Self; 19] = [
        Self::Noise,
        Self::Psf,
        Self::Glare,
        Self::Distortion,
        Self::Vignetting,
        Self::HotPixels,
        Self::Film,
        Self::Exif,
        Self::Flicker,
        Self::Ambient,
        Self::Falloff,
        Self::WhiteUnevenness,
        Self::ProjectorBlack,
        Self::Blur,
        Self::ProjectorDistortion,
        Self::Drift,
        Self::Jumps,
        Self::CameraDrift,
        Self::CameraJumps,
    ];

    /// Its strength in the options, and one that a real bench may well have. `None` for the two that are on or off.
    fn strength(self, options: &mut SimulateOptions) -> Option<(&mut f64, f64)> {
        Some(match self {
            Self::Noise | Self::Film => return None,
            Self::Psf => (&mut options.psf_px, 0.5),
            Self::Glare => (&mut options.glare, 0.01),
            Self::Distortion => (&mut options.distortion, -0.05),
            Self::Vignetting => (&mut options.vignetting, 0.15),
            Self::HotPixels => (&mut options.hot_pixels, 1e-5),
            Self::Exif => (&mut options.exif_stops_error, 0.125),
            Self::Flicker => (&mut options.flicker, 0.003),
            Self::Ambient => (&mut options.ambient, 5e-5),
            Self::Falloff => (&mut options.falloff, 0.12),
            Self::WhiteUnevenness => (&mut options.white_unevenness, 0.002),
            Self::ProjectorBlack => (&mut options.projector_black, 2e-4),
            Self::Blur => (&mut options.projector_blur_px, 0.3),
            Self::ProjectorDistortion => (&mut options.projector_distortion, -0.01),
            Self::Drift => (&mut options.drift_px, 0.5),
            Self::Jumps => (&mut options.jump_px, 1.5),
            Self::CameraDrift => (&mut options.camera_drift_px, 0.3),
            Self::CameraJumps => (&mut options.camera_jump_px, 1.0),
        })
    }

    /// Whether it does anything.
    pub fn is_on(self, options: &SimulateOptions) -> bool {
        match self {
            Self::Noise => !options.noise_free,
            Self::Film => options.response_curve() == CameraCurve::Film,
            _ => self.strength(&mut options.clone()).is_some_and(|(value, _)| *value != 0.0),
        }
    }

    /// Switches it off, or on: with the strength that the options have, or a realistic one when that is zero.
    fn switch(self, on: bool, options: &mut SimulateOptions) {
        if on == self.is_on(options) {
            return;
        }
        match (self, self.strength(options)) {
            (Self::Noise, _) => options.noise_free = !on,
            // Off, the curve is the one that the rig file tells.
            (Self::Film, _) => options.response_curve = Some(if on { CameraCurve::Film } else { CameraCurve::Srgb }),
            (_, Some((value, realistic))) => *value = if on { realistic } else { 0.0 },
            (_, None) => {}
        }
    }

    /// Its name in one word.
    pub fn name(self) -> &'static str {
        match self {
            Self::Noise => "noise",
            Self::Psf => "psf",
            Self::Glare => "glare",
            Self::Distortion => "distortion",
            Self::Vignetting => "vignetting",
            Self::HotPixels => "hot-pixels",
            Self::Film => "film",
            Self::Exif => "exif",
            Self::Flicker => "flicker",
            Self::Ambient => "ambient",
            Self::Falloff => "falloff",
            Self::WhiteUnevenness => "white-unevenness",
            Self::ProjectorBlack => "projector-black",
            Self::Blur => "blur",
            Self::ProjectorDistortion => "projector-distortion",
            Self::Drift => "drift",
            Self::Jumps => "jumps",
            Self::CameraDrift => "camera-drift",
            Self::CameraJumps => "camera-jumps",
        }
    }
}

impl SimulateOptions {
    /// Switches `causes` on and every other off. One whose strength is zero gets a realistic one.
    pub fn only(&mut self, causes: &[Cause]) {
        Cause::ALL.iter().for_each(|cause| cause.switch(causes.contains(cause), self));
    }

    /// Switches `causes` on besides what is on already. One whose strength is zero gets a realistic one.
    pub fn with(&mut self, causes: &[Cause]) {
        causes.iter().for_each(|cause| cause.switch(true, self));
    }

    /// Switches `causes` off.
    pub fn without(&mut self, causes: &[Cause]) {
        causes.iter().for_each(|cause| cause.switch(false, self));
    }

    /// Applies the three switches of the command line.
    ///
    /// # Errors
    /// [`Error::Setting`] when they contradict each other.
    pub fn switch(&mut self, only: Option<&[Cause]>, with: &[Cause], without: &[Cause]) -> Result<()> {
        let refuse = |setting, expected: &str, cause: Cause| {
            Err(Error::Setting { setting, expected: expected.into(), found: cause.name().into() })
        };
        if let Some(both) = without.iter().find(|c| with.contains(c) || only.is_some_and(|only| only.contains(c))) {
            return refuse("without", "causes that `only` and `with` do not name", *both);
        }
        let named = || only.unwrap_or_default().iter().chain(with);
        if self.noise_free && named().any(|c| *c == Cause::Noise) {
            return refuse("noise_free", "no noise among the causes that are switched on", Cause::Noise);
        }
        if let Some(only) = only {
            self.only(only);
        }
        self.with(with);
        self.without(without);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_leaves_one_cause_on_and_without_takes_one_away() {
        for cause in Cause::ALL {
            let mut options = SimulateOptions::default();
            options.only(&[cause]);
            for other in Cause::ALL {
                assert_eq!(other.is_on(&options), other == cause, "only {cause:?}: {other:?}");
            }
            options.check().unwrap();
            options.without(&[cause]);
            assert!(Cause::ALL.iter().all(|c| !c.is_on(&options)), "{cause:?} stays on");

            let mut options = SimulateOptions::default();
            options.with(&Cause::ALL);
            options.without(&[cause]);
            for other in Cause::ALL {
                assert_eq!(other.is_on(&options), other != cause, "without {cause:?}: {other:?}");
            }
        }
    }

    #[test]
    fn a_strength_that_was_given_is_kept() {
        let mut options = SimulateOptions { psf_px: 1.7, ..SimulateOptions::default() };
        options.only(&[Cause::Psf]);
        assert_eq!(options.psf_px, 1.7);
    }

    #[test]
    fn contradictions_are_refused_by_the_name_of_the_switch() {
        let refused = |only: Option<&[Cause]>, with: &[Cause], without: &[Cause], noise_free| {
            let mut options = SimulateOptions { noise_free, ..SimulateOptions::default() };
            options.switch(only, with, without).unwrap_err().to_string()
        };
        assert!(refused(Some(&[Cause::Psf]), &[], &[Cause::Psf], false).contains("without:"));
        assert!(refused(None, &[Cause::Glare], &[Cause::Glare], false).contains("glare"));
        assert!(refused(Some(&[Cause::Noise]), &[], &[], true).contains("noise_free:"));
        SimulateOptions { noise_free: true, ..SimulateOptions::default() }
            .switch(Some(&[Cause::Drift]), &[], &[])
            .unwrap();
    }
}
