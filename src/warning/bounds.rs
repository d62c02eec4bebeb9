//! From where on something is a finding: stated once, for the stage that looks and for the record that tells. Each is a
//! line of `docs/findings.md`.

/// Two sources of one exposure time may differ by rounding to nominal values (1/30 for 1/32) before it is worth a word.
pub(crate) const EXPOSURE_TOLERANCE: f64 = 0.07;
/// Nominal exposure times differ by rounding (1/30 for 1/32), those of neighbouring third stops by a quarter.
pub(crate) const SAME_EXPOSURE: f64 = 0.1;
/// A rig's figure is doubted when it is off by so many standard deviations.
pub(crate) const DOUBT_SD: f64 = 5.0;
/// A measured time is worth a word when it differs by more than this and by more than so many standard deviations: of
/// ten times of a capture, one is off by more than four by chance in 1,600 captures.
pub(crate) const TIME_TOLERANCE: f64 = 0.005;
pub(crate) const TIME_SIGMA: f64 = 4.0;
/// A time that is off by a third of a stop (ln 2 / 3) is the next setting, and none that a camera rounded (1/30 for
/// 1/32 is 6 %; shutters are off by an eighth of a stop).
pub(crate) const REFUSED_TIME: f64 = 0.231;
/// A slope of ln(actual) over ln(nominal) that is off by more is a response curve: times that are wrong one by one have
/// none.
pub(crate) const REFUSED_SLOPE: f64 = 0.1;
/// From this offset of all dots on, projector px, rows would be off by more than any stated uncertainty.
pub(crate) const REFUSED_PROJECTOR_PX: f64 = 0.5;
/// Light of another pattern that is a larger share of a dot's: the matrix's error is then several times what it states.
pub(crate) const REFUSED_REMAINS: f64 = 0.03;
/// The white reference's level over the Gray code's that is off by more is refused: no lamp drifts so far in a session.
pub(crate) const REFUSED_LEVEL: f64 = 0.1;
/// Reference dots whose light is off by more than this, ln, from what the references say: exposure times as cameras
/// round them explain 0.15, a dot of 9 instead of 8 projector px makes 0.24.
pub(crate) const REFUSED_LIGHT: f64 = 0.2;
/// Channels of the reference dots that are off by more than this from each other: the largest
/// of 70 untouched captures differ by 0.056, of sRGB files in 8 bits by 0.083.
pub(crate) const REFUSED_COLOUR: f64 = 0.15;
/// Light of a black shot over that of white where the sample lies: a projector's black has a thousandth, a bad one a
/// fiftieth.
pub(crate) const BRIGHTEST_BLACK: f64 = 0.1;
/// A covered lens has less than this share of the light of the sample under a black projector: dark current has the
/// more, the darker the room.
pub(crate) const COVERED: f64 = 0.5;
/// So many pixels of the white reference that differ from their surroundings are dust; more are a pattern, or something
/// in the way.
pub(crate) const UNEVEN_SHARE: f64 = 0.03;
/// Even light that is a larger share of a dot's light in its window is refused.
pub(crate) const EVEN_REFUSED: f64 = 0.01;
/// A halo of this share is worth a word: an ordinary lens has about half a per cent.
pub(crate) const STRAY_TOLD: f64 = 0.005;
/// Board and frame disagree when their corners are further apart, px, and by so many standard deviations.
pub(crate) const BOARD_ELSEWHERE_PX: f64 = 0.2;
/// The frame has moved when its marks have by more than this, px, and by so many standard deviations.
pub(crate) const FRAME_MOVED_PX: f64 = 0.05;
pub(crate) const MOVED_SIGMA: f64 = 5.0;
/// Stripes of this share that are off the plane are more than edges of what stands around.
pub(crate) const STRIPES_LEFT_OUT: f64 = 0.05;
/// A part of the projector's map that is off by more, projector px, is seen in the rows beside their stated
/// uncertainty.
pub(crate) const MAP_BENDS_PX: f64 = 0.25;
/// A point spread that differs by this much over the board, px, leaves a few per cent of the peaks where it is not the
/// mean's.
pub(crate) const SPREAD_VARIES_PX: f64 = 0.1;
/// From this blur on a sharp dot's peak is known to two per cent and worse at 3 px a sample (docs/accuracy.md).
pub(crate) const STRONG_BLUR_PX: f64 = 0.9;
/// A sample that was measured with a ruler is of its stated size to a hundredth; printers are off by some hundredths.
pub(crate) const OTHER_SIZE: f64 = 0.02;
/// More light than arrives cannot leave.
pub(crate) const LARGEST_ALBEDO: f64 = 1.0;
/// More saturated pixels than this in the shortest exposure are more than hot ones.
pub(crate) const SATURATED_SHARE: f64 = 1e-3;
/// Half of a window without light is worth a word.
pub(crate) const DARK_SHARE: f64 = 0.5;
/// With less than a twentieth of the windows above black, a row is its dot and little else.
pub(crate) const BLACK_SHARE: f64 = 0.95;
/// Blur over more than this share of an outgoing sample (as a standard deviation) spreads much of the peak into its
/// neighbours.
pub(crate) const BLUR_SHARE: f64 = 1.0 / 3.0;
/// Of the farthest drift that can be followed.
pub(crate) const DRIFT_SHARE: f64 = 0.5;
/// A window that leaves out more of the light than this is worth a warning: relit slabs are then darker by as much,
/// which is what a careful white reference is good to.
pub(crate) const LIGHT_OUTSIDE: f64 = 0.01;
