//! The data: mistakes/*.toml and captures.toml, as docs/testing.md describes them.

use serde::Deserialize;
use std::collections::BTreeMap;

/// The files of mistakes, in the order of the table.
const FILES: [(&str, &str); 7] = [
    ("stack", include_str!("mistakes/stack.toml")),
    ("times", include_str!("mistakes/times.toml")),
    ("patterns", include_str!("mistakes/patterns.toml")),
    ("light", include_str!("mistakes/light.toml")),
    ("references", include_str!("mistakes/references.toml")),
    ("figures", include_str!("mistakes/figures.toml")),
    ("settings", include_str!("mistakes/settings.toml")),
];

pub(crate) fn mistakes() -> Vec<Mistake> {
    #[derive(Deserialize)]
    #[serde(deny_unknown_fields)]
    struct File {
        kind: String,
        wrong: Option<String>,
        mistake: Vec<Mistake>,
    }
    let read = |(name, text): (&'static str, &str)| {
        let file: File = toml::from_str(text).unwrap_or_else(|e| panic!("mistakes/{name}.toml: {e}"));
        file.mistake.into_iter().map(move |mut mistake| {
            (mistake.kind, mistake.file) = (file.kind.clone(), name.to_owned());
            mistake.wrong = mistake.wrong.or_else(|| file.wrong.clone());
            mistake
        })
    };
    FILES.into_iter().flat_map(read).collect()
}

pub(crate) fn captures() -> Captures {
    toml::from_str(include_str!("captures.toml")).unwrap_or_else(|e| panic!("captures.toml: {e}"))
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Captures {
    /// Regular expressions of messages that state what was done and accuse nobody.
    pub notes: Vec<String>,
    pub tampered: Vec<TamperedCapture>,
    /// Options that every untouched capture has; a later option of its own holds.
    pub untouched_base: String,
    pub untouched: Vec<UntouchedCapture>,
}

/// A capture that mistakes are made in.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TamperedCapture {
    pub id: String,
    pub meaning: String,
    /// Options of `acquire simulate`.
    pub simulate: String,
}

/// A capture in which nobody made a mistake.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct UntouchedCapture {
    /// Options of `acquire simulate`, after `untouched_base`.
    pub simulate: String,
    /// A regular expression of messages that are true of it: a lamp that does flicker.
    #[serde(default)]
    pub is_so: Option<String>,
    /// It is accused of something today; the test does not fail for it.
    #[serde(default)]
    pub accused_today: bool,
    /// One of the few that the default test builds.
    #[serde(default)]
    pub fast: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Mistake {
    pub id: String,
    /// Of its file.
    #[serde(skip)]
    pub kind: String,
    /// Name of its file.
    #[serde(skip)]
    pub file: String,
    pub meaning: String,
    /// Made one after another.
    #[serde(default)]
    pub steps: Vec<Step>,
    /// Changes of capture.toml and rig.toml, after the steps.
    #[serde(default)]
    pub edits: Vec<Edit>,
    /// What a right message names: `photograph`, `shot`, `first-shot` of those that were changed; anything else is a
    /// word of its own.
    #[serde(default)]
    pub names: Vec<String>,
    /// Names of findings that are right.
    #[serde(default)]
    pub findings: Vec<String>,
    /// A regular expression; a message that matches it is right, without regard to case.
    #[serde(default)]
    pub says: Option<String>,
    /// A message that matches this is wrong all the same: it names the shot, and blames it for something else.
    #[serde(default)]
    pub wrong: Option<String>,
    /// Captures it cannot be made in, and why.
    #[serde(default)]
    pub cannot: BTreeMap<String, String>,
    /// The outcome that is reached today, by capture.
    #[serde(default)]
    pub today: BTreeMap<String, String>,
    /// One of the few that the default test makes.
    #[serde(default)]
    pub fast: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Step {
    #[serde(flatten)]
    pub on: Selection,
    #[serde(rename = "do")]
    pub operation: Operation,
}

/// Which photographs.
#[derive(Debug, Clone, Deserialize)]
pub(crate) struct Selection {
    /// Kinds of shots; `all` for every kind.
    pub of: Vec<String>,
    #[serde(default)]
    pub which: Which,
    #[serde(default)]
    pub exposures: Exposures,
}

/// Which shots of the kind, in their order.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Which {
    #[default]
    All,
    EverySecond,
    /// The one at this share of the sweep, never its first or last where there are three.
    At(f64),
    /// All from that one on.
    From(f64),
    /// The columns' finest Gray code.
    Finest,
    /// The shot after it.
    FinestInverse,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Exposures {
    #[default]
    All,
    Shortest,
    Middle,
    Longest,
}

/// What happens to the chosen photographs. Lengths are camera px, places are shares of the picture's width and height.
#[derive(Debug, Clone, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub(crate) enum Operation {
    /// The lamp's relative output; with `from`, it goes evenly from that to `to` over the chosen shots.
    Lamp {
        from: Option<f64>,
        to: f64,
    },
    /// Uniform light, of the sensor's range in the longest of the chosen exposures.
    Ambient {
        share: f64,
    },
    /// A lens cap.
    Dark,
    /// A soft disc takes away `depth` of the light.
    Shadow {
        at: [f64; 2],
        radius: f64,
        depth: f64,
    },
    /// A soft disc of light is added, of the sensor's range in the longest of the chosen exposures.
    Glint {
        at: [f64; 2],
        radius: f64,
        share: f64,
    },
    /// Rows are darker and brighter by `depth`: a lamp on alternating current under a rolling shutter.
    Bands {
        depth: f64,
        period_px: f64,
    },
    /// The light of another shot, at the nearest exposure; with `share`, that much of it is added.
    Show {
        of: String,
        which: Which,
        share: Option<f64>,
    },
    /// The light of the shot before (`ahead`: after; `shots` before or after): all of it, or a share, of one channel
    /// alone where one is named.
    Delay {
        share: f64,
        #[serde(default)]
        ahead: bool,
        #[serde(default = "one")]
        shots: usize,
        channel: Option<usize>,
    },
    /// Changes places with the photographs of another shot of the same kind.
    Exchange {
        with: Which,
    },
    Turn,
    Mirror,
    Shift {
        px: [f64; 2],
    },
    /// The picture grows about its middle.
    Zoom {
        factor: f64,
    },
    /// Out of focus.
    Blur {
        sd_px: f64,
    },
    /// The camera's own sharpening; below zero, its noise reduction.
    Sharpen {
        amount: f64,
        sd_px: f64,
    },
    /// Ends at this share of the sensor's range.
    Clip {
        share: f64,
    },
    /// The signal is higher by this share of the sensor's range.
    Offset {
        share: f64,
    },
    /// Each channel times a factor.
    Balance {
        factors: [f64; 3],
    },
    /// Bits shifted to the left, or below zero to the right.
    Bits {
        left: i32,
    },
    /// The upper eight bits in a file of eight.
    EightBits,
    /// sRGB, and the file says so.
    Srgb,
    Bgr,
    /// The next shorter exposure once more.
    ShorterAgain,
    /// EXIF's exposure time times a factor.
    ExifTime {
        factor: f64,
    },
    /// Shortest and longest of the chosen ones have each other's EXIF.
    ExchangeTimes,
    WithoutExif,
    /// The file ends at this share.
    Cut {
        share: f64,
    },
    /// Every second pixel of every second row.
    Half,
    /// `exposure_secs` of capture.toml: EXIF's times a factor.
    ManifestTime {
        factor: f64,
    },
    /// Indices of the lit points in capture.toml.
    Dots {
        add: Option<[i64; 2]>,
        mirror: Option<usize>,
    },
}

fn one() -> usize {
    1
}

/// A change of one field: `capture.grid.points` or `rig.noise.black_dn`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Edit {
    pub field: String,
    pub set: Option<toml::Value>,
    /// Added to a number or, number by number, to a list or each list of a list.
    pub add: Option<Vec<f64>>,
    pub times: Option<Vec<f64>>,
    /// The two numbers of a list change places.
    #[serde(default)]
    pub exchange: bool,
    /// Those of every list of a list.
    #[serde(default, rename = "exchange-each")]
    pub exchange_each: bool,
    #[serde(default)]
    pub remove: bool,
}
