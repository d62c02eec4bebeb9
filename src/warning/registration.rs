//! What registration finds: board, frame, point spread, drift.

use super::bounds::{
    BOARD_ELSEWHERE_PX, FRAME_MOVED_PX, MAP_BENDS_PX, MOVED_SIGMA, SPREAD_VARIES_PX, STRIPES_LEFT_OUT, STRONG_BLUR_PX,
};
use super::record::catalogue;
use crate::geometry::sight_angle;
use crate::registration::SeenDepth;
use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// A shift by depth of less than this, mm, is not worth its words.
const LEAST_DEPTH_TOLD_MM: f64 = 5e-4;

/// What registration finds: board, frame, point spread, drift.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum RegistrationWarning {
    /// The board does not cover the slab: its registration there is an extrapolation.
    BoardTooSmall {
        /// The largest distance of a window's sample from the board, mm.
        outside_mm: f64,
    },
    /// The board lay elsewhere than the frame's marks: the marks' plane is used.
    BoardElsewhere {
        /// The largest distance between the two at the slab's corners, camera px.
        largest_px: f64,
    },
    /// A later photograph of the frame shows it elsewhere: camera or frame have moved during the capture.
    FrameMoved {
        /// The later shot.
        shot: String,
        /// Median movement of its marks since the first frame shot, camera px.
        moved_px: [f64; 2],
        /// Its standard deviation per axis, px.
        sd_px: f64,
    },
    /// The camera (or the sample) has moved since registration, seen at the sample's rim; windows were moved with it.
    CameraMoved {
        /// The first such shot.
        first: String,
        /// How many lattice shots.
        shots: usize,
        /// In how many lattice shots the rim was seen well enough to tell.
        measured: usize,
        /// The largest movement, camera px.
        largest_px: f64,
    },
    /// The pattern has moved suddenly between shots, by more than its slow walk explains.
    DriftJumps {
        /// The shots before which it happened.
        jumps: Vec<DriftJump>,
    },
    /// No reference dots: drift is the median of the lattice dots' own shifts, which edges of materials bias.
    DriftFromLatticeDots {
        /// From which depth the dots are taken to be seen; `None` where the view or all dots are unknown.
        #[serde(default)]
        depth: Option<SeenDepth>,
    },
    /// Shots without reference dots have too few dots for a measurement of their drift; their drift is treated as zero.
    DriftUnmeasured {
        /// The first such shot.
        first: String,
        /// How many shots.
        shots: usize,
    },
    /// The finest bits of the Gray code are ignored: the camera does not tell their stripes apart.
    GrayBitsIgnored {
        /// How many of the projector's columns' bits, and of its rows'.
        bits: [usize; 2],
    },
    /// Part of the stripes' area shows codes that do not lie on the plane's map, and is left out.
    StripesLeftOut {
        /// Its share of the area's squares with a code, or of the edges.
        share: f64,
    },
    /// The stripes of one part of the slab's plane are off the projector's map together.
    ProjectorMapBends {
        /// By how much, projector px.
        off_projector_px: f64,
        /// Its standard deviation, projector px.
        sd_projector_px: f64,
        /// Where, slab mm.
        at_mm: [f64; 2],
    },
    /// The blur of the lens could not be measured on the board; it is treated as zero.
    PointSpreadUnmeasured,
    /// The lens blurs more in one part of the picture than in another; its mean is taken out everywhere.
    PointSpreadVaries {
        /// Standard deviation that is taken out, camera px.
        psf_px: f64,
        /// The least and the largest of the picture's parts, camera px.
        range_px: [f64; 2],
    },
    /// The lens blurs so much that taking it out costs accuracy and amplifies noise.
    StronglyBlurred {
        /// Standard deviation of the blur, camera px.
        psf_px: f64,
    },
}

/// One jump of the projected pattern.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DriftJump {
    /// The first shot after it.
    pub shot: String,
    /// Its length, camera px.
    pub length_px: f64,
}

impl fmt::Display for RegistrationWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BoardTooSmall { outside_mm } => {
                write!(f, "windows reach {outside_mm:.2} mm outside the board: registration is extrapolated there")
            }
            Self::BoardElsewhere { largest_px } => write!(
                f,
                "board and frame marks disagree about the slab's corners by up to {largest_px:.2} px; the marks are used"
            ),
            Self::FrameMoved { shot, moved_px: [x, y], sd_px } => write!(
                f,
                "in \"{shot}\" the frame is ({x:.3}, {y:.3}) px from its first place (standard deviation {sd_px:.3} px): camera or frame moved during the capture"
            ),
            Self::CameraMoved { first, shots, measured, largest_px } => write!(
                f,
                "camera and sample moved relative to each other by up to {largest_px:.2} px, in {shots} of the {} that show the sample's rim well enough (first: \"{first}\"); windows were moved with the rim",
                count(*measured, "lattice shot")
            ),
            Self::DriftJumps { jumps } => {
                let named = jumps.iter().take(5).map(|j| format!("\"{}\" by {:.2} px", j.shot, j.length_px));
                let more = if jumps.len() > 5 { format!(" and {} more", jumps.len() - 5) } else { String::new() };
                let list = named.collect::<Vec<_>>().join(", ");
                write!(f, "the pattern jumped before {list}{more}; the jumps are corrected, but something was touched")
            }
            Self::DriftFromLatticeDots { depth: Some(d) }
                if d.slope * d.depth_mm.max(d.sd_mm) >= LEAST_DEPTH_TOLD_MM =>
            {
                write!(
                    f,
                    "the patterns have no reference dots: drift is measured on the lattice dots, which is biased near edges of materials; seen {:.0}° off the normal, from a depth of {:.3} ± {:.3} mm over the refractive index, they lie {:.3} ± {:.3} mm beside their places",
                    sight_angle(d.slope).to_degrees(),
                    d.depth_mm,
                    d.sd_mm,
                    d.slope * d.depth_mm,
                    d.slope * d.sd_mm
                )
            }
            Self::DriftFromLatticeDots { .. } => write!(
                f,
                "the patterns have no reference dots: drift is measured on the lattice dots, which is biased near edges of materials"
            ),
            Self::DriftUnmeasured { first, shots } => write!(
                f,
                "too few dots to measure the drift of {} (first: \"{first}\"); no drift is assumed",
                count(*shots, "shot")
            ),
            Self::GrayBitsIgnored { bits } => {
                let axes = bits.iter().zip(["x", "y"]).filter(|(n, _)| **n > 0);
                let list = axes.map(|(n, axis)| format!("{n} in {axis}")).collect::<Vec<_>>().join(" and ");
                write!(
                    f,
                    "the camera does not tell the finest stripes of the Gray code apart; these bits are ignored: {list}"
                )
            }
            Self::StripesLeftOut { share } => write!(
                f,
                "{:.1} % of the stripes do not lie on the plane that the others agree on, and are left out",
                100.0 * share
            ),
            Self::ProjectorMapBends { off_projector_px, sd_projector_px, at_mm: [x, y] } => write!(
                f,
                "the stripes around ({x:.1}, {y:.1}) mm are {off_projector_px:+.2} ± {sd_projector_px:.2} projector px off the projector's map, and the rows there as much: is the slab's plane flat, and all of it in view?"
            ),
            Self::PointSpreadUnmeasured => {
                write!(f, "the lens blur cannot be measured at the board's edges; it remains in the rows")
            }
            Self::PointSpreadVaries { psf_px, range_px } => write!(
                f,
                "the lens blur varies from {:.2} px to {:.2} px over the picture; {psf_px:.2} px is removed everywhere: check focus and tilt",
                range_px[0], range_px[1]
            ),
            Self::StronglyBlurred { psf_px } => write!(
                f,
                "the lens blurs by {psf_px:.2} px, so that peaks are accurate to a few per cent only: focus it, or stop it down"
            ),
        }
    }
}

catalogue!(RegistrationWarning {
    Self::BoardTooSmall { .. } => "board-too-small", Warning, Registration, Told, vec![part("board")], None;
    Self::BoardElsewhere { .. } => "board-elsewhere", Warning, Registration, LeftOut, vec![part("board")],
        bound("largest_px", BOARD_ELSEWHERE_PX, "px");
    Self::FrameMoved { shot: name, sd_px, .. } => "frame-moved", Warning, Drift, Told, vec![shot(name)],
        bound("moved_px", FRAME_MOVED_PX.max(MOVED_SIGMA * sd_px), "px");
    Self::CameraMoved { first, .. } => "camera-moved", Warning, Drift, Corrected, vec![shot(first)], None;
    Self::DriftJumps { jumps } => "drift-jumps", Warning, Drift, Corrected,
        jumps.iter().map(|j| shot(&j.shot)).collect(), None;
    Self::DriftFromLatticeDots { .. } => "drift-from-lattice-dots", Warning, Drift, Replaced,
        vec![field("reference_dots")], None;
    Self::DriftUnmeasured { first, .. } => "drift-unmeasured", Warning, Drift, Replaced, vec![shot(first)], None;
    Self::GrayBitsIgnored { .. } => "gray-bits-ignored", Note, Registration, LeftOut, vec![part("Gray code")], None;
    Self::StripesLeftOut { .. } => "stripes-left-out", Warning, Registration, LeftOut, vec![part("Gray code")],
        bound("share", STRIPES_LEFT_OUT, "");
    Self::ProjectorMapBends { .. } => "projector-map-bends", Warning, Registration, Told, vec![part("projector")],
        bound("off_projector_px", MAP_BENDS_PX, "projector px");
    Self::PointSpreadUnmeasured => "point-spread-unmeasured", Warning, Focus, Told, vec![part("board")], None;
    Self::PointSpreadVaries { .. } => "point-spread-varies", Warning, Focus, Corrected, vec![part("lens")],
        bound("range_px", SPREAD_VARIES_PX, "px");
    Self::StronglyBlurred { .. } => "strongly-blurred", Warning, Focus, Corrected, vec![part("lens")],
        bound("psf_px", STRONG_BLUR_PX, "px");
});
