//! What registration finds: board, frame, point spread, drift.

use serde::{Deserialize, Serialize};
use std::fmt;

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
    DriftFromLatticeDots,
    /// Without reference dots, shots have too few dots to measure their drift; it is taken for none.
    DriftUnmeasured {
        /// The first such shot.
        first: String,
        /// How many shots.
        shots: usize,
    },
    /// The board does not tell how much the lens blurs; it is taken for not at all.
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
                "the board lay up to {largest_px:.2} px from where the frame's marks put the slab's corners; the marks are believed"
            ),
            Self::FrameMoved { shot, moved_px: [x, y], sd_px } => write!(
                f,
                "the frame is seen ({x:.3}, {y:.3}) px from its first place in \"{shot}\" (standard deviation {sd_px:.3} px): camera or frame have moved during the capture"
            ),
            Self::CameraMoved { first, shots, measured, largest_px } => write!(
                f,
                "camera and sample have moved against each other by up to {largest_px:.2} px in {shots} of the {measured} lattice shots that show the sample's rim well enough (\"{first}\" first); their windows were moved with the rim"
            ),
            Self::DriftJumps { jumps } => {
                let named = jumps.iter().take(5).map(|j| format!("\"{}\" by {:.2} px", j.shot, j.length_px));
                let more = if jumps.len() > 5 { format!(" and {} more", jumps.len() - 5) } else { String::new() };
                let list = named.collect::<Vec<_>>().join(", ");
                write!(f, "the pattern jumped before {list}{more}; it is taken out, but something was touched")
            }
            Self::DriftFromLatticeDots => {
                write!(
                    f,
                    "no reference dots in the patterns: drift comes from the lattice's own dots and is biased near edges of materials"
                )
            }
            Self::DriftUnmeasured { first, shots } => {
                write!(
                    f,
                    "{shots} shots (\"{first}\" first) have too few dots to measure their drift; it is taken for none"
                )
            }
            Self::PointSpreadUnmeasured => {
                write!(f, "the board's edges do not tell how much the lens blurs; its blur is left in the rows")
            }
            Self::PointSpreadVaries { psf_px, range_px } => write!(
                f,
                "the lens blurs by {:.2} px in one part of the picture and {:.2} px in another; {psf_px:.2} px is taken out everywhere: check focus and tilt",
                range_px[0], range_px[1]
            ),
            Self::StronglyBlurred { psf_px } => {
                write!(
                    f,
                    "the lens blurs by {psf_px:.2} px: peaks are known to some per cent only; focus it, or stop it down"
                )
            }
        }
    }
}
