//! What a capture says twice, and not alike: photographs of a stack, patterns and dots, light, references, the rig's
//! figures.

use super::bounds::{
    BRIGHTEST_BLACK, COVERED, DOUBT_SD, EVEN_REFUSED, OTHER_SIZE, REFUSED_COLOUR, REFUSED_LEVEL, REFUSED_LIGHT,
    REFUSED_PROJECTOR_PX, REFUSED_REMAINS, REFUSED_SLOPE, REFUSED_TIME, UNEVEN_SHARE,
};
use crate::words::count;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What a capture says twice, and not alike.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "warning", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ConsistencyWarning {
    /// A photograph does not show what the other exposures of its shot show.
    PhotographDisagrees {
        /// The file.
        file: String,
        /// Its shot.
        shot: String,
        /// What it looks like: "the pattern of shot lattice-3", "turned by 180°".
        looks: String,
        /// Share of the pixels with light that disagree by more than their noise, 0 to 1.
        share: f64,
        /// How many photographs of the capture do.
        photographs: usize,
        /// Another photograph that may be the wrong one as well: nothing tells which.
        or: Option<String>,
    },
    /// Photographs that are not as they were when the capture was made, by the checksums beside `capture.toml`.
    PhotographChanged {
        /// The first of them.
        file: String,
        /// How many.
        photographs: usize,
    },
    /// Exposure times by which the photographs of the stacks do not fit together, by more than a camera rounds times.
    ExposureTimes {
        /// The first photograph of the time that is farthest off.
        file: String,
        /// The stated time that is farthest off, s.
        nominal_secs: f64,
        /// What the photographs say it was, most other times taken as right, s.
        measured_secs: f64,
        /// Relative standard deviation of that.
        relative_sd: f64,
        /// How many different times are off.
        settings: usize,
    },
    /// The stacks tell nothing of the exposure times, as they contradict each other.
    ExposuresUnmeasured {
        /// How many different times there are.
        settings: usize,
    },
    /// Photographs with the same exposure time differ in brightness from shot to shot by more than a lamp flickers.
    BrightnessVaries {
        /// Relative standard deviation that explains them best, of those that were tried.
        relative_sd: f64,
    },
    /// A lattice shot whose dots are not where its pattern puts them.
    OtherPattern {
        /// The first such shot.
        shot: String,
        /// What it looks like.
        looks: String,
        /// How many shots are so.
        shots: usize,
        /// Of how many.
        of: usize,
    },
    /// All dots of the sample are off alike from where grid, reference dots and Gray code put them together.
    DotsOffset {
        /// The field of `capture.toml` that disagrees with the Gray code at the first shot.
        field: String,
        /// The shot of the board, where dots are off as they would be if its photographs were mirrored or turned.
        board: Option<String>,
        /// By how much, projector px.
        offset_projector_px: [f64; 2],
        /// Standard deviation per axis.
        sd_projector_px: f64,
    },
    /// Dots of the sample are the farther off the farther along the grid they are.
    DotsStep {
        /// From one lit point to the next along x of the grid, seen less stated, projector px.
        along_x: [f64; 2],
        /// The same along y.
        along_y: [f64; 2],
        /// Standard deviation of each of them.
        sd_projector_px: f64,
        /// From one end of the grid to the other, the larger of the two.
        far_projector_px: f64,
    },
    /// The board is blurred more than the reference dots, so that its blur is not theirs.
    BoardBlur {
        /// The board's shot.
        shot: String,
        /// Its blur as a standard deviation, camera px.
        psf_px: f64,
        /// That of the reference dots, at the most.
        dots_psf_px: f64,
    },
    /// The lattice's photographs have even light that the black shot does not have, or the other way round.
    AmbientChanged {
        /// How much more they have, DN/s.
        dn_per_sec: f64,
        /// The same over a window, as a share of a dot's light in it.
        share: f64,
    },
    /// Light in one place of all lattice shots that were looked at, and not in the black shot.
    LightSpot {
        /// The black shot.
        shot: String,
        /// Where, camera px.
        at_px: [f64; 2],
        /// The least of the shots, DN/s.
        dn_per_sec: f64,
    },
    /// Light in one place of the sample that the rows of all shots have.
    LightOnSample {
        /// The black shot.
        shot: String,
        /// Where it is brightest, of the lit points, camera px.
        at_px: [f64; 2],
        /// Over the peak of the row of that point.
        share: f64,
        /// Its standard deviation.
        share_sd: f64,
        /// Lit points that have it.
        places: usize,
    },
    /// A halo that no lens has.
    HaloImplausible {
        /// Its share of the light.
        share: f64,
        /// The largest that is believed.
        most: f64,
    },
    /// A shot whose reference dots are brighter or darker than those of the others; it was corrected by that.
    LampLevel {
        /// The shot that is farthest off.
        shot: String,
        /// Its light over that of most shots.
        level: f64,
        /// Standard deviation of that.
        level_sd: f64,
        /// How many shots are off by more than flicker and noise.
        shots: usize,
    },
    /// Reference dots of a shot whose light is not what the others of the shot say.
    ReferenceDots {
        /// The first such shot.
        shot: String,
        /// How many of its dots.
        dots: usize,
        /// How many shots have such dots.
        shots: usize,
    },
    /// The reference dots of a shot have another colour than those of most shots.
    ColourChanges {
        /// The first such shot.
        shot: String,
        /// Light of R, G, B over that of most shots.
        levels: [f64; 3],
        /// How many shots.
        shots: usize,
    },
    /// The reference dots of a shot are wider than those of most shots.
    BlurChanges {
        /// The first such shot.
        shot: String,
        /// Standard deviation of the blur that explains the widest, besides the usual, camera px.
        added_px: f64,
        /// How many shots.
        shots: usize,
    },
    /// The reference dots of a shot are farther apart, or nearer, than those of the first shots.
    ScaleChanges {
        /// The first such shot.
        shot: String,
        /// How far apart, of what they are in the first shots.
        scale: f64,
        /// Standard deviation of that.
        sd: f64,
        /// How many shots.
        shots: usize,
    },
    /// The sensor's gain differs from channel to channel.
    ChannelGains {
        /// DN per electron of R, G, B.
        gains: [f64; 3],
        /// Largest standard deviation of these.
        gain_sd: f64,
    },
    /// The slab's axes are mirrored in the picture.
    MirroredSlab {
        /// What shows the axes: the shot of board or frame.
        shot: String,
    },
    /// The sample's rim is where the board would put the slab, were its photographs mirrored or turned.
    BoardFlipped {
        /// The board's shot.
        shot: String,
        /// What they are: "mirrored left to right".
        looks: String,
        /// How far the rim then is from its place, the median of its pieces, camera px.
        off_px: f64,
        /// The same for the photographs as they are; `None` where the rim is not seen near it.
        as_it_is_px: Option<f64>,
    },
    /// The sample's rim is beside where board or frame put the slab.
    SlabElsewhere {
        /// The shot of board or frame.
        shot: String,
        /// How far, mm, along x and y.
        offset_mm: [f64; 2],
        /// Standard deviation.
        sd_mm: f64,
    },
    /// The sample's rim is that of a larger or smaller sample.
    SlabSize {
        /// Its size by its rim, of the stated.
        scale: f64,
        /// Standard deviation of that.
        sd: f64,
    },
    /// The lamp's light changes over the sweep; it was corrected to that of the first shots.
    LampDrifts {
        /// Light of the last third of the shots over that of the first third, by their reference dots.
        level: f64,
        /// How many shots.
        shots: usize,
        /// Whether it was corrected to the light of the references, which differs from that of the first shots.
        #[serde(default)]
        to_references: bool,
    },
    /// The reference dots of the lattice have other colours than white reference and black shots say.
    LatticeColour {
        /// Their light over what it should be, R, G, B.
        levels: [f64; 3],
        /// The largest standard deviation of these.
        sd: f64,
        /// What explains it.
        looks: String,
    },
    /// The reference dots of the lattice have another light than white reference and black shots say.
    LatticeLight {
        /// Their light over what it should be.
        level: f64,
        /// Standard deviation of that.
        sd: f64,
        /// The manifest's `grid.dot_projector_px`.
        dot_projector_px: usize,
        /// The side of a dot that explains it.
        size: Option<usize>,
    },
    /// A reference shot that is bright or dark where it should not be.
    ReferenceLight {
        /// Its shot.
        shot: String,
        /// What it looks like.
        looks: String,
        /// Its light over that of the white reference, where the sample lies.
        ratio: f64,
    },
    /// A shot of a covered lens has light.
    DarkIsLit {
        /// The shot.
        shot: String,
        /// Its light over that of the sample under a black projector, the median of all pixels.
        ratio: f64,
    },
    /// The black level is another one in the lattice's photographs than in the black shots.
    BlackMoves {
        /// The lattice shot that was looked at.
        shot: String,
        /// Its black level less that of sample-black, DN, at all exposure times alike.
        difference_dn: f64,
    },
    /// The rows of a shot have another level than those of other shots say of the same pairs of places, which are
    /// reciprocal.
    ShotLight {
        /// The shot that is farthest off.
        shot: String,
        /// Its light over what the others say.
        level: f64,
        /// Standard deviation of that.
        level_sd: f64,
        /// In so many of so many places that were compared, where it is not the whole shot.
        places: Option<[usize; 2]>,
        /// How many shots are off.
        shots: usize,
    },
    /// Every lattice shot has some of the light of another: a projector or a camera that lags.
    PatternRemains {
        /// Of the pattern so many shots later; below 0 of one before.
        later: isize,
        /// Light in the places of its dots, over that of these dots in their own shots.
        share: f64,
        /// Standard deviation of that.
        sd: f64,
        /// The channel that has it alone: 0 to 2 for R, G, B.
        channel: Option<usize>,
    },
    /// The second white reference is brighter or darker than the first.
    WhiteChanged {
        /// The second one's shot.
        shot: String,
        /// Its light over that of the first, the median.
        level: f64,
        /// Standard deviation of that.
        level_sd: f64,
        /// Whether lattice shots are measured against what lies between the two.
        used: bool,
    },
    /// The white reference is brighter or darker than each Gray-code pattern and its inverse together.
    WhiteLevel {
        /// Its shot.
        shot: String,
        /// Its light over that of the sums, the median.
        level: f64,
        /// Standard deviation of the sums about each other.
        level_sd: f64,
    },
    /// The white reference is not evenly lit.
    WhiteUneven {
        /// Its shot.
        shot: String,
        /// What it looks like.
        looks: String,
        /// Share of the pixels that differ from their surroundings by more than noise.
        share: f64,
    },
    /// Code values end below the saturation of the rig.
    ClipsBelow {
        /// The first photograph in which they do.
        file: String,
        /// Where they pile up, DN.
        code: f64,
        /// The rig's `noise.saturation_dn`.
        given: f64,
        /// How many of the photographs that were looked at.
        photographs: usize,
    },
    /// Code values are not related to light as the rig says.
    ResponseCurve {
        /// `camera.response` of the rig.
        given: String,
        /// Doublings of what the files say when the exposure doubles, the rig's curve taken out; 1 is right.
        slope: f64,
        /// What the files themselves say of their code values.
        encoding: Option<String>,
    },
}

impl fmt::Display for ConsistencyWarning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::PhotographDisagrees { file, shot, looks, share, photographs, or } => {
                match or {
                    None => write!(f, "{file} does not show what the other exposures of shot \"{shot}\" show")?,
                    Some(or) => write!(f, "{file} and {or} of shot \"{shot}\" do not show the same")?,
                }
                if *share > 0.0 {
                    write!(f, " ({:.0} % of the lit samples differ by more than noise)", 100.0 * share)?;
                }
                write!(f, ": {looks}")?;
                match photographs {
                    1 => Ok(()),
                    n => write!(f, "; so do {}", count(n - 1, "other photograph")),
                }
            }
            Self::PhotographChanged { file, photographs } => {
                write!(
                    f,
                    "{file} is not as it was when the capture was made (its checksum in photographs.b3 differs)"
                )?;
                match photographs {
                    1 => Ok(()),
                    n => write!(f, "; nor {}", count(n - 1, "other photograph")),
                }
            }
            Self::ExposureTimes { file, nominal_secs, measured_secs, relative_sd, settings } => {
                write!(
                    f,
                    "the exposure time of {nominal_secs:.6} s ({file}) is {measured_secs:.6} s ({:+.1} % ± {:.1} %) by what the photographs of the stacks show",
                    100.0 * (measured_secs / nominal_secs - 1.0),
                    100.0 * relative_sd
                )?;
                match settings {
                    1 => Ok(()),
                    n => write!(f, "; {} off by more than a third of a stop", count(*n, "time")),
                }
            }
            Self::ExposuresUnmeasured { settings } => write!(
                f,
                "the stacks contradict each other: their photographs do not tell the {}",
                count(*settings, "exposure time")
            ),
            Self::BrightnessVaries { relative_sd } => write!(
                f,
                "photographs with the same exposure time differ in brightness from shot to shot by {:.0} % or more: no lamp flickers so much; times, lamp or patterns change",
                100.0 * relative_sd
            ),
            Self::OtherPattern { shot, looks, shots, of } => {
                write!(f, "the dots of shot \"{shot}\" are not where its pattern puts them: {looks}")?;
                match shots {
                    1 => Ok(()),
                    n => write!(f, "; {n} of {of} lattice shots are out of step with the patterns"),
                }
            }
            Self::DotsOffset { field, board, offset_projector_px: [x, y], sd_projector_px } => {
                write!(
                    f,
                    "all dots are {x:+.2}, {y:+.2} projector px (± {sd_projector_px:.2}) from where [grid], [reference_dots] and Gray code put them together; the one that disagrees is {field}"
                )?;
                match board {
                    None => Ok(()),
                    Some(shot) => write!(
                        f,
                        ", unless the photographs of shot \"{shot}\" are mirrored or turned: light from below the surface is displaced so then"
                    ),
                }
            }
            Self::DotsStep { along_x: [ax, ay], along_y: [bx, by], sd_projector_px, far_projector_px } => write!(
                f,
                "from one lit point to the next the dots are {ax:+.3}, {ay:+.3} projector px along x and {bx:+.3}, {by:+.3} along y (± {sd_projector_px:.3}) off what grid.step_projector_px says: {far_projector_px:.2} from one end of the grid to the other"
            ),
            Self::BoardBlur { shot, psf_px, dots_psf_px } => write!(
                f,
                "shot \"{shot}\" is blurred by {psf_px:.2} px, the reference dots by {dots_psf_px:.2} px at the most: the board was out of focus, and its blur must not be taken out of the rows"
            ),
            Self::AmbientChanged { dn_per_sec, share } => write!(
                f,
                "the lattice's photographs have {dn_per_sec:.1} DN/s of even light {} sample-black ({:.1} % of a dot's light in its window): ambient light changed after it, or the lens was covered",
                if *dn_per_sec > 0.0 { "more than" } else { "(less) than" },
                100.0 * share
            ),
            Self::LightSpot { shot, at_px: [x, y], dn_per_sec } => write!(
                f,
                "a bright spot beside the sample, at camera px ({x:.0}, {y:.0}), {dn_per_sec:.1} DN/s, is in all lattice shots that were looked at and not in \"{shot}\": a reflection or a lamp, no light of the dots; left out where stray light is measured"
            ),
            Self::LightOnSample { shot, at_px: [x, y], share, share_sd, places } => write!(
                f,
                "the rows of other points have light at {} that is not the dots', and not in \"{shot}\": a reflection or a lamp; most at camera px ({x:.0}, {y:.0}), {:.2} % ± {:.2} % of the peak there",
                count(*places, "lit point"),
                100.0 * share,
                100.0 * share_sd
            ),
            Self::HaloImplausible { share, most } => write!(
                f,
                "{:.1} % of the light seems to be in a wide halo of the camera, no lens has more than {:.0} %: light falls on the frame, the black shot is wrong, or photographs clip",
                100.0 * share,
                100.0 * most
            ),
            Self::LampLevel { shot, level, level_sd, shots } => {
                write!(
                    f,
                    "the reference dots of shot \"{shot}\" have {level:.3} (± {level_sd:.3}) times the light of most shots'"
                )?;
                match shots {
                    1 => write!(f, ": the lamp changed; taken out")?,
                    n => write!(f, ": the lamp changes; taken out of {}", count(*n, "shot"))?,
                }
                Ok(())
            }
            Self::ReferenceDots { shot, dots, shots } => {
                write!(
                    f,
                    "{} of shot \"{shot}\" {} not the light that the others of the shot say: something is in the way, or on the frame",
                    count(*dots, "reference dot"),
                    if *dots == 1 { "has" } else { "have" }
                )?;
                if *shots > 1 { write!(f, "; so in {}", count(shots - 1, "other shot")) } else { Ok(()) }
            }
            Self::ColourChanges { shot, levels: [r, g, b], shots } => {
                write!(
                    f,
                    "the reference dots of shot \"{shot}\" have another colour: R, G, B {r:.3}, {g:.3}, {b:.3} times those of most shots: white balance, order of channels or the lamp's colour changed"
                )?;
                if *shots > 1 { write!(f, "; so in {}", count(shots - 1, "other shot")) } else { Ok(()) }
            }
            Self::BlurChanges { shot, added_px, shots } => {
                write!(
                    f,
                    "the reference dots of shot \"{shot}\" are wider than those of most shots, by a blur of {added_px:.2} px: focus changed, or something moved while the shutter was open"
                )?;
                if *shots > 1 { write!(f, "; so in {}", count(shots - 1, "other shot")) } else { Ok(()) }
            }
            Self::ScaleChanges { shot, scale, sd, shots } => {
                write!(
                    f,
                    "the reference dots of shot \"{shot}\" are {scale:.4} (± {sd:.4}) times as far apart as those of the first shots: zoom, focus or a distance changed; windows are not corrected for it"
                )?;
                if *shots > 1 { write!(f, "; so in {}", count(shots - 1, "other shot")) } else { Ok(()) }
            }
            Self::ChannelGains { gains: [r, g, b], gain_sd } => write!(
                f,
                "noise says that R, G, B have {r:.4}, {g:.4}, {b:.4} DN per electron (± {gain_sd:.4}): files were multiplied by a white balance; stated variances are those of one gain"
            ),
            Self::MirroredSlab { shot } => write!(
                f,
                "the slab's axes are mirrored in the picture of shot \"{shot}\": x to the right must go with y down, as the camera sees the sample; the board is turned by 90°, or its corners or marks are listed in another order"
            ),
            Self::BoardFlipped { shot, looks, off_px, as_it_is_px } => write!(
                f,
                "the photographs of shot \"{shot}\" are {looks}: with that undone the slab lies {off_px:.2} px from the sample's rim, as they are {}",
                match as_it_is_px {
                    Some(off) => format!("{off:.2} px"),
                    None => "so far that no rim is found".to_owned(),
                }
            ),
            Self::SlabElsewhere { shot, offset_mm: [x, y], sd_mm } => write!(
                f,
                "the sample's rim is ({x:+.2}, {y:+.2}) mm (± {sd_mm:.2}) from where shot \"{shot}\" puts the slab: board.origin_mm is wrong, the photograph of the board is turned or mirrored, or the sample lies elsewhere"
            ),
            Self::SlabSize { scale, sd } => write!(
                f,
                "the sample's rim is that of one of {scale:.3} (± {sd:.3}) times slab.size_mm, as the board measures it: the printed board is not of its stated size (board.square_mm), or slab.size_mm is wrong"
            ),
            Self::LampDrifts { level, shots, to_references } => write!(
                f,
                "the lamp changes over the sweep: the reference dots of the last third of {} have {level:.3} times the light of the first third's; corrected to that of {}",
                count(*shots, "shot"),
                match to_references {
                    true => "the references, which the first shots do not have",
                    false => "the first, beside which the references were taken",
                }
            ),
            Self::LatticeColour { levels: [r, g, b], sd, looks } => write!(
                f,
                "the lattice's reference dots have {r:.3}, {g:.3}, {b:.3} (± {sd:.3}) times the light in R, G, B that the white reference and the black shots say: {looks}"
            ),
            Self::LatticeLight { level, sd, dot_projector_px, size } => {
                write!(
                    f,
                    "the lattice's reference dots have {level:.3} (± {sd:.3}) times the light that the white reference and the black shots say: "
                )?;
                match size {
                    Some(size) => write!(
                        f,
                        "dots of {size} projector px instead of {dot_projector_px} (grid.dot_projector_px) would have it; or the lamp changed, or light in the room between the black shots"
                    ),
                    None => write!(
                        f,
                        "the lamp changed between white reference and lattice, or light in the room between the black shots"
                    ),
                }
            }
            Self::ReferenceLight { shot, looks, ratio } => write!(
                f,
                "shot \"{shot}\" has {:.2} % of the white reference's light where the sample lies: {looks}",
                100.0 * ratio
            ),
            Self::DarkIsLit { shot, ratio } => write!(
                f,
                "shot \"{shot}\" of the covered lens has {ratio:.2} times the light of sample-black: the lens was not covered; hot photosites are looked for in sample-black"
            ),
            Self::BlackMoves { shot, difference_dn } => write!(
                f,
                "the black level of shot \"{shot}\" is {difference_dn:+.1} DN from that of sample-black at all exposure times alike: the camera sets its black level (noise.black_dn) by itself"
            ),
            Self::ShotLight { shot, level, level_sd, places, shots } => {
                write!(
                    f,
                    "the rows of shot \"{shot}\" have {level:.3} (± {level_sd:.3}) times the light that the rows of other shots have between the same places{}: something shadowed or lit the sample, not the frame",
                    places.map_or_else(String::new, |[off, all]| format!(", in {off} of {all} places"))
                )?;
                if *shots > 1 { write!(f, "; so in {}", count(shots - 1, "other shot")) } else { Ok(()) }
            }
            Self::PatternRemains { later, share, sd, channel } => write!(
                f,
                "the lattice shots have {:.1} % (± {:.1} %) of a dot's light{} where {}",
                100.0 * share,
                100.0 * sd,
                channel.map_or_else(String::new, |c| format!(" in channel {} alone", ["R", "G", "B"][c.min(2)])),
                match later {
                    ..=-2 => format!(
                        "the pattern {} before has its dots: the projector lags",
                        count(later.unsigned_abs(), "shot")
                    ),
                    -1 | 0 =>
                        "the pattern before has its dots: the projector lags, or the shutter opens too early".to_owned(),
                    1.. => "the next pattern has its dots: the shutter closes too late".to_owned(),
                }
            ),
            Self::WhiteLevel { shot, level, level_sd } => write!(
                f,
                "the white reference (shot \"{shot}\") has {level:.3} times the light (± {level_sd:.3}) that Gray-code patterns and their inverses have together: the lamp changed, or an exposure time is wrong"
            ),
            Self::WhiteChanged { shot, level, level_sd, used } => write!(
                f,
                "the second white reference (shot \"{shot}\") has {level:.4} times the light (± {level_sd:.4}) of the first: the lamp changed between them; {}",
                match used {
                    true => "each lattice shot is measured against what an even change has there",
                    false => "the reference dots tell the lamp of each lattice shot",
                }
            ),
            Self::WhiteUneven { shot, looks, share } => write!(
                f,
                "the white reference (shot \"{shot}\") is not even: {:.0} % of its pixels differ from their surroundings; {looks}",
                100.0 * share
            ),
            Self::ClipsBelow { file, code, given, photographs } => {
                write!(f, "code values pile up at {code} DN in {file}, noise.saturation_dn of rig.toml is {given} DN")?;
                match photographs {
                    1 => Ok(()),
                    n => write!(f, "; so do those of {}", count(n - 1, "other photograph")),
                }
            }
            Self::ResponseCurve { given, slope, encoding } => {
                write!(
                    f,
                    "camera.response is {given}, but twice the exposure gives {:.2} times the signal, at all times alike: the files have another response curve",
                    slope.exp2()
                )?;
                match encoding {
                    Some(encoding) => write!(f, " (they say themselves: {encoding})"),
                    None => Ok(()),
                }
            }
        }
    }
}

// Contradictions: in the list of a completed work they stand because they were accepted.
super::record::catalogue!(ConsistencyWarning {
    Self::PhotographDisagrees { file, shot: name, or: Some(other), .. } => "photograph-disagrees", Warning, Files, Accepted,
        vec![photograph(file), photograph(other), shot(name)], None;
    Self::PhotographDisagrees { file, shot: name, or: None, .. } => "photograph-disagrees", Warning, Files, LeftOut,
        vec![photograph(file), shot(name)], None;
    Self::PhotographChanged { file, .. } => "photograph-changed", Warning, Files, Accepted, vec![photograph(file)], None;
    Self::ExposureTimes { file, nominal_secs, .. } => "exposure-times", Warning, Exposures, Accepted,
        vec![exposure(*nominal_secs), photograph(file)], bound("measured_secs / nominal_secs - 1", REFUSED_TIME, "");
    Self::ExposuresUnmeasured { .. } => "exposures-unmeasured", Warning, Exposures, Told, vec![], None;
    Self::BrightnessVaries { .. } => "brightness-varies", Warning, Light, Accepted, vec![part("lamp")], None;
    Self::OtherPattern { shot: name, .. } => "other-pattern", Warning, Dots, Accepted, vec![shot(name)], None;
    Self::DotsOffset { field: name, offset_projector_px: [x, y], .. } if x.hypot(*y) >= REFUSED_PROJECTOR_PX =>
        "dots-offset", Warning, Dots, Accepted, vec![field(name)],
        bound("offset_projector_px", REFUSED_PROJECTOR_PX, "projector px");
    Self::DotsOffset { field: name, board, .. } => "dots-offset", Warning, Dots, Told,
        [field(name)].into_iter().chain(board.as_deref().map(shot)).collect(), None;
    Self::DotsStep { far_projector_px, .. } if *far_projector_px >= REFUSED_PROJECTOR_PX =>
        "dots-step", Warning, Dots, Accepted, vec![field("grid.step_projector_px")],
        bound("far_projector_px", REFUSED_PROJECTOR_PX, "projector px");
    Self::DotsStep { .. } => "dots-step", Warning, Dots, Told, vec![field("grid.step_projector_px")], None;
    Self::BoardBlur { shot: name, .. } => "board-blur", Warning, Focus, Accepted, vec![shot(name)], None;
    Self::AmbientChanged { share, .. } if share.abs() > EVEN_REFUSED => "ambient-changed", Warning, Light, Accepted,
        vec![part("ambient light")], bound("share", EVEN_REFUSED, "");
    Self::AmbientChanged { .. } => "ambient-changed", Warning, Light, Told, vec![part("ambient light")], None;
    Self::LightSpot { shot: name, .. } => "light-spot", Warning, Light, Told, vec![shot(name), part("ambient light")], None;
    Self::LightOnSample { shot: name, .. } => "light-on-sample", Warning, Light, Told, vec![shot(name), part("ambient light")], None;
    Self::HaloImplausible { most, .. } => "halo-implausible", Warning, Light, Accepted, vec![part("ambient light")],
        bound("share", *most, "");
    Self::LampLevel { shot: name, .. } => "lamp-level", Warning, Light, Corrected, vec![shot(name), part("lamp")], None;
    Self::ReferenceDots { shot: name, .. } => "reference-dots", Warning, Dots, Told, vec![shot(name)], None;
    Self::ColourChanges { shot: name, .. } => "colour-changes", Warning, Light, Told, vec![shot(name)], None;
    Self::BlurChanges { shot: name, .. } => "blur-changes", Warning, Focus, Told, vec![shot(name)], None;
    Self::ScaleChanges { shot: name, .. } => "scale-changes", Warning, Registration, Told, vec![shot(name)], None;
    Self::ChannelGains { gain_sd, .. } => "channel-gains", Warning, Light, Told, vec![field("noise")],
        bound("gains", DOUBT_SD * 2f64.sqrt() * gain_sd, "DN per electron");
    Self::ShotLight { shot: name, .. } => "shot-light", Warning, Light, Told, vec![shot(name)], None;
    Self::PatternRemains { share, .. } if *share >= REFUSED_REMAINS => "pattern-remains", Warning, Dots, Accepted,
        vec![part("projector")], bound("share", REFUSED_REMAINS, "");
    Self::PatternRemains { .. } => "pattern-remains", Warning, Dots, Told, vec![part("projector")], None;
    Self::LampDrifts { .. } => "lamp-drifts", Warning, Light, Corrected, vec![part("lamp")], None;
    Self::LatticeColour { .. } => "lattice-colour", Warning, Light, Accepted, vec![part("lattice's colour")],
        bound("levels", REFUSED_COLOUR, "");
    Self::LatticeLight { level, .. } if level.ln().abs() < REFUSED_LIGHT => "lattice-light", Warning, Light, Told,
        vec![part("lamp")], None;
    Self::LatticeLight { size: Some(_), .. } => "lattice-light", Warning, Light, Accepted,
        vec![field("grid.dot_projector_px"), part("lamp")], bound("ln level", REFUSED_LIGHT, "");
    Self::LatticeLight { size: None, .. } => "lattice-light", Warning, Light, Accepted, vec![part("lamp")],
        bound("ln level", REFUSED_LIGHT, "");
    Self::ReferenceLight { shot: name, ratio, .. } if *ratio > BRIGHTEST_BLACK => "reference-light", Warning, Light, Accepted,
        vec![shot(name)], bound("ratio", BRIGHTEST_BLACK, "");
    Self::ReferenceLight { shot: name, .. } => "reference-light", Warning, Light, Told, vec![shot(name)], None;
    Self::DarkIsLit { shot: name, .. } => "dark-is-lit", Warning, Light, Replaced, vec![shot(name)], bound("ratio", COVERED, "");
    Self::BlackMoves { shot: name, .. } => "black-moves", Warning, Light, Told, vec![shot(name), field("noise.black_dn")], None;
    Self::MirroredSlab { shot: name } => "mirrored-slab", Warning, Registration, Accepted, vec![shot(name)], None;
    Self::BoardFlipped { shot: name, .. } => "board-flipped", Warning, Registration, Accepted, vec![shot(name)], None;
    Self::SlabElsewhere { shot: name, .. } => "slab-elsewhere", Note, Registration, Told,
        vec![shot(name), field("board.origin_mm")], bound("offset_mm / slab.size_mm", OTHER_SIZE, "");
    Self::SlabSize { .. } => "slab-size", Warning, Registration, Told, vec![field("board.square_mm"), field("slab.size_mm")],
        bound("scale - 1", OTHER_SIZE, "");
    Self::WhiteLevel { shot: name, level, .. } if (level - 1.0).abs() > REFUSED_LEVEL => "white-level", Warning, Light, Accepted,
        vec![shot(name), part("lamp")], bound("level - 1", REFUSED_LEVEL, "");
    Self::WhiteLevel { shot: name, .. } => "white-level", Warning, Light, Corrected, vec![shot(name), part("lamp")], None;
    Self::WhiteChanged { shot: name, level, .. } if (level - 1.0).abs() > REFUSED_LEVEL => "white-changed", Warning, Light,
        Accepted, vec![shot(name), part("lamp")], bound("level - 1", REFUSED_LEVEL, "");
    Self::WhiteChanged { shot: name, .. } => "white-changed", Warning, Light, Corrected, vec![shot(name), part("lamp")], None;
    Self::WhiteUneven { shot: name, .. } => "white-uneven", Warning, Light, Accepted, vec![shot(name)],
        bound("share", UNEVEN_SHARE, "");
    Self::ClipsBelow { file, given, .. } => "clips-below", Warning, Light, Accepted,
        vec![photograph(file), field("noise.saturation_dn")], bound("code", *given, "DN");
    Self::ResponseCurve { .. } => "response-curve", Warning, Exposures, Accepted, vec![field("camera.response")],
        bound("slope - 1", REFUSED_SLOPE, "");
});
