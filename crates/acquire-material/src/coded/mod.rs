//! Coded materials: the maps of a [`Material`] transformed, quantized and entropy coded; decoded to plain factors at
//! load.
//!
//! The error that coding adds is one in R̂_d: each map gets the step that its coefficients' effect on R̂_d asks for,
//! and each coefficient, step and transform is chosen by what it costs in bits against the squared error it leaves
//! (`Sullivan1998`). The format is described byte for byte in `docs/materials.md`.
//!
//! # What this does not detect
//! Whether the material itself is a good one: the added error is against the plain factors, not against the matrix.

mod entropy;
mod exact;
mod falloff;
mod maps;
mod measure;
mod planes;
mod stream;
mod symbols;
mod text;
mod through;
mod transform;

use crate::{Error, Material, MaterialHeader, OffsetFactors, Result};
use maps::Price;
use through::EvenLight;

/// The first bytes of every coded material.
const MAGIC: [u8; 4] = *b"\x89ACQ";
/// Version of the format. Anything that changes a decoder's result needs a new one.
const VERSION: u16 = 2;
/// Magic, version, bytes of the header's stream, checksum.
const PREAMBLE: usize = 4 + 2 + 4 + 8;

/// How good, or how small.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Quality {
    /// The largest error that coding may add, as ‖R̂_coded − R̂‖_F / ‖R̂‖_F; 1e-6 to 1.
    AddedError(f64),
    /// The largest file, bytes; the least error within it is looked for.
    MaxBytes(u64),
}

/// How a material is coded.
#[derive(Debug, Clone, PartialEq)]
pub struct EncodeOptions {
    /// Default: an added error of 0.3 %, which is little beside what most factorizations leave.
    pub quality: Quality,
    /// How far a lit point may be moved along x and y, in outgoing cells. Default: as many cells as the relative error
    /// of R̂_d that is expected, at most 0.02: a row moved by a whole cell would change by about itself, at most.
    pub position_error_px: Option<f64>,
}

impl Default for EncodeOptions {
    fn default() -> Self {
        Self { quality: Quality::AddedError(3e-3), position_error_px: None }
    }
}

/// A coded material.
#[derive(Debug, Clone, PartialEq)]
pub struct Coded {
    /// The file.
    pub bytes: Vec<u8>,
    /// ‖R̂_coded − R̂‖_F / ‖R̂‖_F, measured on evenly spaced rows: on all of them where that is quick.
    pub added_error: f64,
    /// What a reader of the file will get.
    pub material: Material,
}

/// Price of a bit against squared error, in squared steps: the best of a sweep on the chessboard (docs/materials.md);
/// within a factor of two of it the bytes change by 2 %.
const LAMBDA: f64 = 0.08;
/// The step that about gives an error, both against ‖R̂‖ (0.078 to 0.090 on three matrices): where a search begins.
const STEP_OF_ERROR: f64 = 0.085;
const MOST_POSITION_ERROR: f64 = 0.02;
/// Entry and exit maps that were fitted again may make the error of R̂_d so many times larger: even light is worth that.
const MOST_WORSE: f64 = 1.5;
/// Encodings that a search may try.
const ATTEMPTS: usize = 14;
/// A result this close to what was asked ends the search.
const CLOSE: f64 = 0.97;

/// Codes a material. The same bytes for any number of threads.
///
/// # Errors
/// [`Error::Option`] for a quality that is out of range or that cannot be reached; [`Error::Inconsistent`] when the
/// material's arrays do not have the lengths that its header says, or hold numbers that no file may hold.
pub fn encode(material: &Material, options: &EncodeOptions) -> Result<Coded> {
    material.check_lengths()?;
    material.check_values().map_err(Error::inconsistent)?;
    check_options(options)?;
    // Maps that channels share are coded as what they stand for: the transform finds what they have in common.
    let own = material.header.shared_maps.is_some().then(|| Material {
        header: MaterialHeader { shared_maps: None, ..material.header.clone() },
        offset_factors: OffsetFactors::Own(material.offset_factors.all().into_owned()),
        ..material.clone()
    });
    let material = own.as_ref().unwrap_or(material);
    let sample = measure::Sample::of(material);
    // Polynomials are fitted to the responses themselves.
    let fits = material.header.exit_grid.is_some() && material.header.degree.is_none();
    let mut even = fits.then(|| EvenLight::of(material)).transpose()?;
    let first = match options.quality {
        Quality::AddedError(error) => STEP_OF_ERROR * error,
        Quality::MaxBytes(_) => 1e-4,
    };
    let mut search = Search { step: first * sample.norm().max(1e-30), good: None, bad: None };
    let mut best: Option<Coded> = None;
    for attempt in 0..ATTEMPTS {
        let mut coded = encode_at(material, options, search.step, &sample, even.as_ref())?;
        if attempt == 0 && even.is_some() {
            // Where sums are nearly nothing beside what they are sums of, they tell nothing of the maps.
            let as_they_were = encode_at(material, options, search.step, &sample, None)?;
            if coded.added_error > MOST_WORSE * as_they_were.added_error {
                (coded, even) = (as_they_were, None);
            }
        }
        // Above 1 is too much.
        let used = match options.quality {
            Quality::AddedError(error) => coded.added_error / error,
            Quality::MaxBytes(bytes) => coded.bytes.len() as f64 / bytes as f64,
        };
        let better = best.as_ref().is_none_or(|b| match options.quality {
            Quality::AddedError(_) => coded.bytes.len() < b.bytes.len(),
            Quality::MaxBytes(_) => coded.added_error < b.added_error,
        });
        if used <= 1.0 && better {
            best = Some(coded);
        }
        if (CLOSE..=1.0).contains(&used) || !search.next(used, options.quality) {
            break;
        }
    }
    best.ok_or_else(|| unreachable_quality(options.quality))
}

/// A search for the step, on a logarithmic scale.
struct Search {
    step: f64,
    /// The step nearest to the goal that kept to it, and that did not.
    good: Option<f64>,
    bad: Option<f64>,
}

impl Search {
    /// Moves to the next step to try, after `used` of what is allowed; whether there is one.
    fn next(&mut self, used: f64, quality: Quality) -> bool {
        if used <= 1.0 {
            self.good = Some(self.step)
        } else {
            self.bad = Some(self.step)
        }
        // Error grows and size falls by about the 3/4th power of the step.
        let power = if matches!(quality, Quality::AddedError(_)) { -4.0 / 3.0 } else { 4.0 / 3.0 };
        let guess = self.step * (used.max(1e-3) / 0.985).powf(power).clamp(1.0 / 64.0, 64.0);
        self.step = match (self.good, self.bad) {
            (Some(good), Some(bad)) => {
                let (low, high) = (good.min(bad), good.max(bad));
                if high / low < 1.002 {
                    return false;
                }
                if guess > low * 1.001 && guess < high / 1.001 { guess } else { (low * high).sqrt() }
            }
            _ => guess,
        };
        (1e-150..1e150).contains(&self.step)
    }
}

fn check_options(options: &EncodeOptions) -> Result<()> {
    let refuse = |option, expected: &str, found: f64| {
        Err(Error::Option { option, expected: expected.into(), found: found.to_string() })
    };
    match options.quality {
        Quality::AddedError(error) if !(1e-6..=1.0).contains(&error) => refuse("added_error", "1e-6 to 1", error),
        Quality::MaxBytes(0) => refuse("max_bytes", "at least 1", 0.0),
        _ => match options.position_error_px {
            Some(error) if !(1e-6..=1.0).contains(&error) => refuse("position_error_px", "1e-6 to 1 px", error),
            _ => Ok(()),
        },
    }
}

fn unreachable_quality(quality: Quality) -> Error {
    match quality {
        Quality::AddedError(error) => Error::Option {
            option: "added_error",
            expected: "an error that coding can keep to with this material".into(),
            found: error.to_string(),
        },
        Quality::MaxBytes(bytes) => Error::Option {
            option: "max_bytes",
            expected: "room for the header, the positions and some of the maps".into(),
            found: bytes.to_string(),
        },
    }
}

/// One encoding, decoded again and measured.
fn encode_at(
    material: &Material,
    options: &EncodeOptions,
    step: f64,
    sample: &measure::Sample,
    even: Option<&EvenLight>,
) -> Result<Coded> {
    let price = Price { step, lambda: LAMBDA };
    let norm = sample.norm();
    let expected = step / (norm.max(1e-30) * STEP_OF_ERROR);
    let position_error = options.position_error_px.unwrap_or(expected.clamp(1e-6, MOST_POSITION_ERROR));
    let maps = stream::write_maps(material, even, norm, price, position_error).map_err(Error::internal)?;
    let plain = stream::read_maps(&maps, rounded(&material.header)).map_err(Error::internal)?;
    let added_error = sample.relative_error(&plain);
    let mut header = rounded(&material.header);
    remember(&mut header, added_error);
    let text = serde_json::to_string(&header).map_err(Error::internal)?;
    let bytes = assemble(&stream::write_header(&text).map_err(Error::internal)?, &maps)?;
    // Numbers in text are what a reader makes of them.
    let header = serde_json::from_str(&text).map_err(Error::internal)?;
    Ok(Coded { bytes, added_error, material: Material { header, ..plain } })
}

/// The header as it is kept: singular values have as many digits as an f32 needs.
fn rounded(header: &MaterialHeader) -> MaterialHeader {
    let mut header = header.clone();
    for value in &mut header.singular_values {
        *value = (*value as f32).to_string().parse().unwrap_or(*value);
    }
    header
}

/// Notes in the provenance that, and how, the material was coded.
fn remember(header: &mut MaterialHeader, added_error: f64) {
    let note = serde_json::json!({"format": VERSION, "added_rel_rmse": (added_error as f32)});
    match header.provenance.as_object_mut() {
        Some(known) => drop(known.insert("coded".into(), note)),
        None => header.provenance = serde_json::json!({"coded": note, "before": header.provenance}),
    }
}

fn assemble(header: &[u8], maps: &[u8]) -> Result<Vec<u8>> {
    let length = u32::try_from(header.len()).map_err(Error::internal)?;
    let body = [VERSION.to_le_bytes().as_slice(), &length.to_le_bytes(), header, maps].concat();
    let sum = checksum(&body);
    let (fixed, streams) = body.split_at(6);
    Ok([MAGIC.as_slice(), fixed, &sum, streams].concat())
}

/// The first 8 bytes of BLAKE3 of everything but the magic and the checksum.
fn checksum(body: &[u8]) -> [u8; 8] {
    let hash = blake3::hash(body);
    std::array::from_fn(|k| hash.as_bytes()[k])
}

/// Reads a coded material.
pub(crate) fn decode(bytes: &[u8]) -> Result<Material, String> {
    let (Some(preamble), Some(streams)) = (bytes.get(..PREAMBLE), bytes.get(PREAMBLE..)) else {
        return Err(format!("expected at least {PREAMBLE} bytes, found {}", bytes.len()));
    };
    if preamble[..4] != MAGIC {
        return Err("not a coded material".into());
    }
    let version = u16::from_le_bytes([preamble[4], preamble[5]]);
    if version != VERSION {
        return Err(format!("format of coded materials: expected {VERSION}, found {version}"));
    }
    if checksum(&[&preamble[4..10], streams].concat()) != preamble[10..] {
        return Err("the checksum differs: the file was cut or changed".into());
    }
    decode_streams(&preamble[6..10], streams)
}

/// The part after the checksum, which a hostile file can get right.
fn decode_streams(length: &[u8], streams: &[u8]) -> Result<Material, String> {
    let length = length.iter().rev().fold(0, |n, &b| n << 8 | usize::from(b));
    let (Some(header), Some(maps)) = (streams.get(..length), streams.get(length..)) else {
        return Err(format!("header: {length} bytes of {}", streams.len()));
    };
    let text = stream::read_header(header)?;
    let header: MaterialHeader = serde_json::from_str(&text).map_err(|e| format!("header: {e}"))?;
    crate::file::check_header(&header)?;
    if let Some(maps) = header.shared_maps {
        return Err(format!("shared_maps: expected none in a coded file, found {maps}"));
    }
    stream::read_maps(maps, header)
}

#[cfg(test)]
mod tests;
