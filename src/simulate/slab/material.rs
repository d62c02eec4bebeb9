//! What the slab is made of, as it is written on the command line.

use super::table::{self, MARBLE, NamedMedium};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

/// The most fields of a chessboard along each axis.
const MOST_SQUARES: usize = 256;
/// The most layers of a layered slab.
const MOST_LAYERS: usize = 64;

/// The slab's material. Its text form ([`FromStr`], [`fmt::Display`], and what serde writes) is
///
/// | text | slab |
/// |---|---|
/// | `homogeneous`, `homogeneous:MEDIUM`, `MEDIUM` | one medium (marble) |
/// | `chessboard-NxM`, `chessboard-NxM:MEDIUM,MEDIUM` | N × M fields over the lit area (skin2 and whole-milk), continued outside |
/// | `marble`, `marble:MEDIUM,MEDIUM` | stone with veins (marble and vein); the bare word is not the medium |
/// | `layered` | skin1, a quarter of the thickness, on whole-milk |
/// | `layered:MEDIUM=MM,MEDIUM=MM,…` | layers from the top with their thickness |
/// | `voxels:PATH` | a voxel file, see [`super::voxels`] |
///
/// MEDIUM is a name of [`table::MEDIA`]. A slab has one refractive index: its first medium's.
#[derive(Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
#[non_exhaustive]
pub enum SlabMaterial {
    /// One medium.
    Homogeneous(&'static NamedMedium),
    /// Two media in turn.
    Chessboard {
        /// Fields over the lit area along x and y.
        squares: [usize; 2],
        /// The first field's medium and the other.
        media: [&'static NamedMedium; 2],
    },
    /// A stone with veins of another.
    Veined {
        /// Stone and vein.
        media: [&'static NamedMedium; 2],
    },
    /// Layers from the top, with their thickness in mm; `None`: skin1, a quarter of the slab, on whole-milk.
    Layered(Option<Vec<(&'static NamedMedium, f64)>>),
    /// A voxel file.
    Voxels(PathBuf),
}

impl SlabMaterial {
    /// Marble everywhere.
    pub fn homogeneous() -> Self {
        Self::Homogeneous(&MARBLE)
    }

    /// Fields of skin2 and whole-milk, so many along x and y.
    pub fn chessboard(squares: [usize; 2]) -> Self {
        Self::Chessboard { squares, media: [known("skin2"), known("whole-milk")] }
    }

    /// Marble with dark veins.
    pub fn marble() -> Self {
        Self::Veined { media: [&MARBLE, known("vein")] }
    }

    /// The media of plain `layered`, from the top.
    pub(super) fn default_layers() -> [&'static NamedMedium; 2] {
        [known("skin1"), known("whole-milk")]
    }

    /// The thickness that the material itself has, mm; `None` when it takes any.
    pub fn thickness_mm(&self) -> Option<f64> {
        match self {
            Self::Layered(Some(layers)) => Some(layers.iter().map(|(_, t)| t).sum()),
            _ => None,
        }
    }
}

/// A medium that the table is known to have.
fn known(name: &str) -> &'static NamedMedium {
    table::medium(name).unwrap_or(&MARBLE)
}

fn medium(name: &str) -> Result<&'static NamedMedium, String> {
    table::medium(name).ok_or_else(|| format!("expected a medium ({}), found \"{name}\"", table::names()))
}

fn two_media(names: &str) -> Result<[&'static NamedMedium; 2], String> {
    match names.split(',').collect::<Vec<_>>()[..] {
        [a, b] => Ok([medium(a)?, medium(b)?]),
        _ => Err(format!("expected two media, MEDIUM,MEDIUM, found \"{names}\"")),
    }
}

fn squares(text: &str) -> Result<[usize; 2], String> {
    let wrong =
        || format!("expected chessboard-NxM with N and M from 1 to {MOST_SQUARES}, found \"chessboard-{text}\"");
    let (a, b) = text.split_once('x').ok_or_else(wrong)?;
    match (a.parse::<usize>(), b.parse::<usize>()) {
        (Ok(a), Ok(b)) if [a, b].iter().all(|n| (1..=MOST_SQUARES).contains(n)) => Ok([a, b]),
        _ => Err(wrong()),
    }
}

fn layers(text: &str) -> Result<Vec<(&'static NamedMedium, f64)>, String> {
    let layer = |part: &str| {
        let (name, mm) = part.split_once('=').ok_or_else(|| format!("expected MEDIUM=MM, found \"{part}\""))?;
        let thickness: f64 = mm.parse().map_err(|_| format!("expected a thickness in mm, found \"{part}\""))?;
        if !(1e-3..=1e3).contains(&thickness) {
            return Err(format!("expected a thickness of 0.001 to 1000 mm, found \"{part}\""));
        }
        Ok((medium(name)?, thickness))
    };
    let layers: Vec<_> = text.split(',').map(layer).collect::<Result<_, String>>()?;
    if layers.len() > MOST_LAYERS {
        return Err(format!("expected at most {MOST_LAYERS} layers, found {}", layers.len()));
    }
    Ok(layers)
}

impl FromStr for SlabMaterial {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (kind, rest) = match text.split_once(':') {
            Some((kind, rest)) => (kind, Some(rest)),
            None => (text, None),
        };
        match (kind, rest) {
            ("homogeneous", None) => Ok(Self::homogeneous()),
            ("homogeneous", Some(name)) => Ok(Self::Homogeneous(medium(name)?)),
            ("marble", None) => Ok(Self::marble()),
            ("marble", Some(names)) => Ok(Self::Veined { media: two_media(names)? }),
            ("layered", None) => Ok(Self::Layered(None)),
            ("layered", Some(list)) => Ok(Self::Layered(Some(layers(list)?))),
            ("voxels", Some(path)) if !path.is_empty() => Ok(Self::Voxels(path.into())),
            (kind, rest) => match (kind.strip_prefix("chessboard-"), rest) {
                (Some(size), None) => Ok(Self::chessboard(squares(size)?)),
                (Some(size), Some(names)) => Ok(Self::Chessboard { squares: squares(size)?, media: two_media(names)? }),
                (None, None) if table::medium(kind).is_some() => Ok(Self::Homogeneous(medium(kind)?)),
                _ => Err(format!(
                    "expected homogeneous[:MEDIUM], chessboard-NxM[:MEDIUM,MEDIUM], marble[:MEDIUM,MEDIUM], layered[:MEDIUM=MM,…] or a medium ({})",
                    table::names()
                )),
            },
        }
    }
}

impl fmt::Display for SlabMaterial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let two = |media: &[&NamedMedium; 2]| format!(":{},{}", media[0].name, media[1].name);
        match self {
            m if *m == Self::homogeneous() => write!(f, "homogeneous"),
            m if *m == Self::marble() => write!(f, "marble"),
            Self::Homogeneous(medium) => write!(f, "homogeneous:{}", medium.name),
            Self::Chessboard { squares, media } => {
                let usual = *self == Self::chessboard(*squares);
                write!(f, "chessboard-{}x{}{}", squares[0], squares[1], if usual { String::new() } else { two(media) })
            }
            Self::Veined { media } => write!(f, "marble{}", two(media)),
            Self::Layered(None) => write!(f, "layered"),
            Self::Layered(Some(layers)) => {
                let list: Vec<_> = layers.iter().map(|(m, mm)| format!("{}={mm}", m.name)).collect();
                write!(f, "layered:{}", list.join(","))
            }
            Self::Voxels(path) => write!(f, "voxels:{}", path.display()),
        }
    }
}

/// As on the command line: what a person recognizes in a message.
impl fmt::Debug for SlabMaterial {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl From<SlabMaterial> for String {
    fn from(material: SlabMaterial) -> Self {
        material.to_string()
    }
}

impl TryFrom<String> for SlabMaterial {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_form_reads_back_as_it_is_written() {
        for text in [
            "homogeneous",
            "homogeneous:ketchup",
            "chessboard-6x4",
            "chessboard-256x255:apple,cream",
            "marble",
            "marble:potato,skin1",
            "layered",
            "layered:skin1=0.5,whole-milk=3.5",
            "voxels:some/file.npz",
        ] {
            assert_eq!(text.parse::<SlabMaterial>().unwrap().to_string(), text);
        }
        assert_eq!("ketchup".parse::<SlabMaterial>().unwrap().to_string(), "homogeneous:ketchup");
        assert_eq!("homogeneous:marble".parse::<SlabMaterial>().unwrap(), SlabMaterial::homogeneous());
        assert_eq!(
            "marble".parse::<SlabMaterial>().unwrap(),
            SlabMaterial::marble(),
            "the veined slab, not the medium"
        );
    }

    #[test]
    fn what_cannot_be_meant_is_refused_and_the_media_are_listed() {
        for text in [
            "",
            "chessboard-0x0",
            "chessboard-4",
            "chessboard-257x257",
            "chessboard-4x4:apple",
            "marble:apple,cream,skin1",
            "layered:",
            "layered:apple",
            "layered:apple=0",
            "layered:apple=NaN",
            "layered:apple=inf",
            "voxels:",
            "layered-x",
        ] {
            assert!(text.parse::<SlabMaterial>().is_err(), "{text}");
        }
        for text in ["plastic", "homogeneous:Marble", "chessboard-2x2:apple,plastic"] {
            assert!(text.parse::<SlabMaterial>().unwrap_err().contains("whole-milk"), "{text}");
        }
    }
}
