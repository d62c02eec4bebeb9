//! The material on disk: a `.safetensors` file, tensors named after the fields of [`Material`], everything else as one
//! JSON text under the metadata key `acquire`.

use crate::{CHANNELS, Error, Material, MaterialHeader, OffsetFactors, Result, SharedBasis, legendre};
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The version of files with entry and exit maps, which readers of version 2 would leave out.
const FORMAT: u32 = 3;
/// The version of files without.
const PLAIN_FORMAT: u32 = 2;
const KEY: &str = "acquire";
/// No stored number is larger: sums of products with the basis still fit an f32.
const LARGEST: f32 = 1e36;
/// No slab is larger, and no length is smaller than one over it, mm.
const LARGEST_MM: f64 = 1e9;

#[derive(Serialize, Deserialize)]
struct Metadata {
    format: u32,
    /// For tensors in half precision, in the order of [`MaterialHeader::shapes`]: numbers are to be multiplied by 2 to
    /// this power.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    half_exponents: Option<Vec<i32>>,
    #[serde(flatten)]
    header: MaterialHeader,
    /// Last in the text: BLAKE3 of the text with zeros in its place and of all tensors. Files of earlier versions have
    /// none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    blake3: Option<String>,
}

/// What stands before the checksum in the text, and in its place while it is computed.
const BEFORE_CHECKSUM: &str = "\"blake3\":\"";
const NO_CHECKSUM: &str = "0000000000000000000000000000000000000000000000000000000000000000";

/// BLAKE3 of a metadata text without its checksum, and of tensors: name, type, shape and bytes of each, by their names.
fn checksum(text: &str, mut tensors: Vec<(&str, Dtype, &[usize], &[u8])>) -> String {
    tensors.sort_by_key(|tensor| tensor.0);
    let mut hasher = blake3::Hasher::new();
    hasher.update(text.as_bytes());
    for (name, dtype, shape, data) in tensors {
        hasher.update(format!("\n{name} {dtype:?} {shape:?}\n").as_bytes()).update(data);
    }
    hasher.finalize().to_hex().to_string()
}

/// Refuses a file whose checksum is not that of its text and tensors.
fn verify(text: &str, stated: &str, file: &SafeTensors<'_>) -> Result<(), String> {
    let at = text.rfind(BEFORE_CHECKSUM).map_or(text.len(), |at| at + BEFORE_CHECKSUM.len());
    let zeroed = match (text.get(..at), text.get(at + NO_CHECKSUM.len()..)) {
        (Some(before), Some(after)) => [before, NO_CHECKSUM, after].concat(),
        _ => return Err("metadata: a checksum of another length".into()),
    };
    let tensors = file.tensors();
    let tensors = tensors.iter().map(|(name, t)| (name.as_str(), t.dtype(), t.shape(), t.data())).collect();
    match checksum(&zeroed, tensors) == stated {
        true => Ok(()),
        false => Err("its checksum differs: it was changed after it had been written".into()),
    }
}

/// How a material's numbers are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// As they are, 4 bytes each.
    F32,
    /// Rounded to 11 bits, 2 bytes each, not for colour polynomials; every tensor scaled by a power of two so that its
    /// largest number is near 2¹⁵.
    F16,
    /// Transformed, quantized and entropy coded, see the module `coded`.
    Coded,
}

impl Precision {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::F32, Self::F16, Self::Coded];

    /// Its name, as people type it.
    pub fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Coded => "coded",
        }
    }
}

impl std::fmt::Display for Precision {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// The power of two by which numbers are divided before they are rounded to half precision.
fn half_exponent(values: &[f32]) -> i32 {
    let largest = values.iter().fold(0.0_f32, |a, v| a.max(v.abs()));
    if largest > 0.0 { largest.log2().floor() as i32 - 14 } else { 0 }
}

impl Material {
    /// The bytes of a plain file in half precision; each number is off by 2⁻¹² of itself at most, those below 1e-9 of
    /// their tensor's largest by more.
    ///
    /// # Errors
    /// Those of [`Self::to_bytes`]; [`Error::Option`] for a material with colour polynomials, which magnify what
    /// rounding does to the intensity: to several times the response on a chessboard.
    pub fn to_half_bytes(&self) -> Result<Vec<u8>> {
        if let Some(degree) = self.header.degree {
            return Err(Error::Option {
                option: "precision",
                expected: "f32 or coded where colour is a polynomial, which magnifies rounding".into(),
                found: format!("f16 for {} of degree {degree}", self.header.model),
            });
        }
        self.serialized(true)
    }

    /// The bytes of a plain file, `.safetensors`. The same material gives the same bytes.
    ///
    /// # Errors
    /// [`Error::Inconsistent`] when the material's arrays do not have the lengths that its header says.
    pub fn to_bytes(&self) -> Result<Vec<u8>> {
        self.serialized(false)
    }

    fn serialized(&self, half: bool) -> Result<Vec<u8>> {
        self.check_lengths()?;
        let h = &self.header;
        let n = h.rows();
        let f32s = |v: &[f32]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let exponents: Vec<i32> = self.stored().iter().map(|values| half_exponent(values)).collect();
        let f16s = |v: &[f32], e: i32| {
            let scaled = v.iter().map(|&v| half::f16::from_f64(f64::from(v) * 2.0_f64.powi(-e)));
            scaled.flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()
        };
        let lit: Vec<f32> = self.lit_mm.iter().flatten().map(|&v| v as f32).collect();
        let shift = self.shift.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let mut tensors: Vec<(&str, Dtype, Vec<usize>, Vec<u8>)> = h
            .shapes()
            .into_iter()
            .zip(self.stored())
            .zip(&exponents)
            .filter(|(((_, shape), _), _)| *shape != [0])
            .map(|(((name, shape), values), &e)| match half {
                true => (name, Dtype::F16, shape, f16s(values, e)),
                false => (name, Dtype::F32, shape, f32s(values)),
            })
            .collect();
        tensors.push(("lit_mm", Dtype::F32, vec![n, 2], f32s(&lit)));
        tensors.push(("shift", Dtype::I16, vec![n, 2], shift));
        let views = tensors
            .iter()
            .map(|(name, dtype, shape, data)| Ok((*name, TensorView::new(*dtype, shape.clone(), data)?)))
            .collect::<Result<Vec<_>, safetensors::SafeTensorError>>()
            .map_err(Error::internal)?;
        let format = if h.exit_grid.is_some() { FORMAT } else { PLAIN_FORMAT };
        let blake3 = Some(NO_CHECKSUM.to_owned());
        let metadata = Metadata { format, half_exponents: half.then_some(exponents), header: h.clone(), blake3 };
        let text = serde_json::to_string(&metadata).map_err(Error::internal)?;
        let stored =
            tensors.iter().map(|(name, dtype, shape, data)| (*name, *dtype, shape.as_slice(), data.as_slice()));
        let checksum = checksum(&text, stored.collect());
        let (before, after) = text.rsplit_once(NO_CHECKSUM).unwrap_or((&text, ""));
        let text = [before, &checksum, after].concat();
        serialize(views, Some([(KEY.to_owned(), text)].into_iter().collect())).map_err(Error::internal)
    }

    /// Reads a material from memory, plain or coded (told apart by the first bytes); every length, range and number is
    /// checked.
    ///
    /// # Errors
    /// [`Error::Damaged`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        decode_any(bytes).map_err(|reason| Error::damaged(None, reason))
    }

    /// Reads a material from a file, see [`Self::from_bytes`].
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Damaged`].
    pub fn load(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = read_file(path).map_err(|source| Error::Io { path: path.to_path_buf(), source })?;
        decode_any(&bytes).map_err(|reason| Error::damaged(Some(path), reason))
    }

    /// Whether the header can be read again and the arrays have the lengths it says.
    pub(crate) fn check_lengths(&self) -> Result<()> {
        check_header(&self.header).map_err(Error::inconsistent)?;
        self.check().map_err(|(field, expected, found)| {
            Error::inconsistent(format!("{field}: expected {expected} numbers, found {found}"))
        })
    }

    /// Whether every number may be in a file.
    pub(crate) fn check_values(&self) -> Result<(), String> {
        let lit: Vec<f32> = self.lit_mm.iter().flatten().map(|&v| v as f32).collect();
        let tensors = self.header.shapes().into_iter().zip(self.stored()).map(|((name, _), values)| (name, values));
        // Sums of shared maps have to fit, too; factors of their own are among the tensors.
        let sums = match &self.offset_factors {
            OffsetFactors::Own(_) => Vec::new(),
            OffsetFactors::Shared(shared) => shared.offset_factors(),
        };
        for (name, values) in tensors.chain([("lit_mm", lit.as_slice()), ("offset_factors", sums.as_slice())]) {
            if let Some(at) = values.iter().position(|v| !(v.abs() <= LARGEST)) {
                return Err(format!("{name}: expected numbers up to {LARGEST:e}, found {} at {at}", values[at]));
            }
        }
        let reach = self.header.window.map(|w| w as i32 / 2);
        match self.shift.iter().position(|s| (0..2).any(|a| i32::from(s[a]).abs() > reach[a])) {
            Some(at) => Err(format!("shift: row {at} is moved by {:?}, out of its window", self.shift[at])),
            None => Ok(()),
        }
    }

    /// Whether the arrays have the lengths that the header says: (field, expected, found) when not.
    fn check(&self) -> Result<(), (&'static str, usize, usize)> {
        let h = &self.header;
        let n = h.rows();
        let tensors = h.shapes().into_iter().zip(self.stored());
        let lengths = tensors.map(|((name, shape), values)| (name, shape.iter().product(), values.len()));
        let maps = match &self.offset_factors {
            OffsetFactors::Own(_) => None,
            OffsetFactors::Shared(shared) => Some(shared.maps),
        };
        let lengths = lengths.chain([
            ("shared_maps", h.shared_maps.unwrap_or(0), maps.unwrap_or(0)),
            ("lit_mm", n, self.lit_mm.len()),
            ("shift", n, self.shift.len()),
        ]);
        match { lengths }.find(|(_, expected, found)| expected != found) {
            Some(wrong) => Err(wrong),
            None => Ok(()),
        }
    }
}

/// All bytes of a file; not of a pipe, which may never end.
fn read_file(path: &Path) -> std::io::Result<Vec<u8>> {
    let kind = std::fs::metadata(path)?;
    match kind.is_file() || kind.is_dir() {
        true => std::fs::read(path),
        false => {
            Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, "expected a file, found a pipe or a device"))
        }
    }
}

/// What first bytes the coded format has, with or without the feature that reads it.
const CODED: [u8; 4] = *b"\x89ACQ";

fn decode_any(bytes: &[u8]) -> Result<Material, String> {
    match bytes.starts_with(&CODED) {
        #[cfg(feature = "coded")]
        true => crate::coded::decode(bytes),
        #[cfg(not(feature = "coded"))]
        true => Err("coded: expected a plain file, as this program is built without the feature `coded`".into()),
        false => decode(bytes),
    }
}

fn decode(bytes: &[u8]) -> Result<Material, String> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(|e| e.to_string())?;
    let text = metadata.metadata().as_ref().and_then(|m| m.get(KEY)).ok_or("no metadata of acquire")?;
    let Metadata { format, half_exponents, header, blake3 } =
        serde_json::from_str(text).map_err(|e| format!("metadata: {e}"))?;
    if ![PLAIN_FORMAT, FORMAT].contains(&format) {
        return Err(format!("format: expected {PLAIN_FORMAT} or {FORMAT}, found {format}"));
    }
    check_header(&header)?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| e.to_string())?;
    if let Some(stated) = blake3 {
        verify(text, &stated, &file)?;
    }
    let n = header.rows();
    let exponents = half_exponents.unwrap_or_default();
    let read = |name: &str, shape: &[usize], exponent: Option<&i32>| -> Result<Vec<f32>, String> {
        if shape == [0] {
            return Ok(Vec::new());
        }
        let Some(&exponent) = exponent else {
            let data = tensor(&file, name, Dtype::F32, shape)?;
            return Ok(data.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect());
        };
        let scale = 2.0_f64.powi(exponent.clamp(-200, 200));
        let data = tensor(&file, name, Dtype::F16, shape)?.as_chunks::<2>().0;
        Ok(data.iter().map(|b| (half::f16::from_le_bytes(*b).to_f64() * scale) as f32).collect())
    };
    let shapes = header.shapes().into_iter().enumerate();
    let mut tensors = shapes.map(|(at, (name, shape))| read(name, &shape, exponents.get(at)));
    let mut next = || tensors.next().unwrap_or(Ok(Vec::new()));
    let [weights, incident_factors, own, vectors, core, profile, color_coefficients, entry_map, exit_map] =
        [next()?, next()?, next()?, next()?, next()?, next()?, next()?, next()?, next()?];
    let lit = read("lit_mm", &[n, 2], None)?;
    let offset_factors = match header.shared_maps {
        Some(maps) => OffsetFactors::Shared(SharedBasis { maps, vectors, core }),
        None => OffsetFactors::Own(own),
    };
    let shift: Vec<i16> = tensor(&file, "shift", Dtype::I16, &[n, 2])?
        .as_chunks::<2>()
        .0
        .iter()
        .map(|b| i16::from_le_bytes(*b))
        .collect();
    let material = Material {
        lit_mm: lit.as_chunks::<2>().0.iter().map(|p| p.map(f64::from)).collect(),
        weights,
        incident_factors,
        offset_factors,
        profile,
        color_coefficients,
        entry_map,
        exit_map,
        shift: shift.as_chunks::<2>().0.to_vec(),
        header,
    };
    material.check_values()?;
    Ok(material)
}

fn tensor<'a>(file: &SafeTensors<'a>, name: &str, dtype: Dtype, shape: &[usize]) -> Result<&'a [u8], String> {
    let view = file.tensor(name).map_err(|e| format!("{name}: {e}"))?;
    if view.dtype() != dtype || view.shape() != shape {
        return Err(format!("{name}: expected {dtype:?} {shape:?}, found {:?} {:?}", view.dtype(), view.shape()));
    }
    Ok(view.data())
}

/// Bounds that keep every later product and index in range.
pub(crate) fn check_header(h: &MaterialHeader) -> Result<(), String> {
    let small = |v: usize| (1..=1 << 20).contains(&v);
    let sizes = [h.points, h.window, h.extended];
    if !sizes.as_flattened().iter().all(|&v| small(v))
        || !small(h.terms)
        || h.degree.is_some_and(|p| p > legendre::MOST_DEGREE)
    {
        return Err("points, window, extended, terms or degree are out of range".into());
    }
    let odd = h.window.iter().chain(&h.extended).all(|v| v % 2 == 1);
    if !odd || h.window.iter().any(|&w| w / 2 > i16::MAX as usize) {
        return Err(format!("window, extended: expected odd numbers, found {:?}, {:?}", h.window, h.extended));
    }
    let planes = [h.incident_planes, h.offset_planes];
    if planes.iter().any(|p| ![1, CHANNELS].contains(p)) || (h.degree.is_some() && planes != [1, 1]) {
        return Err(format!("incident_planes, offset_planes: expected 1 or 3, and 1 with a degree, found {planes:?}"));
    }
    if h.shared_maps.is_some_and(|k| k == 0 || k > CHANNELS * h.terms) {
        return Err(format!("shared_maps: expected 1 to {}, found {:?}", CHANNELS * h.terms, h.shared_maps));
    }
    let large = |sizes: &[usize]| {
        let product = sizes.iter().try_fold(CHANNELS, |p, &v| p.checked_mul(v));
        product.is_none_or(|p| p > 1 << 40)
    };
    if large(&[h.points[0], h.points[1], h.terms]) || large(&[h.extended[0], h.extended[1], h.terms]) {
        return Err("the factors would be larger than any memory".into());
    }
    if let Some(g) = h.exit_grid {
        let sized = g.size.iter().all(|&s| small(s)) && !large(&g.size);
        if !sized || ![1, CHANNELS].contains(&g.planes) || !g.origin_mm.iter().all(|o| o.abs() <= LARGEST_MM) {
            return Err(format!("exit_grid: expected a size, an origin and 1 or 3 planes, found {g:?}"));
        }
    }
    let lengths = [h.pitch_mm, h.lit_pitch_mm[0], h.lit_pitch_mm[1]];
    let [low, high] = h.intensity_range;
    let range = low.abs() <= 1e6 && high.abs() <= 1e6 && high - low >= 1e-9;
    match range && lengths.iter().all(|p| (1.0 / LARGEST_MM..=LARGEST_MM).contains(p)) {
        true => Ok(()),
        false => Err("pitch_mm, lit_pitch_mm or intensity_range are not usable".into()),
    }
}

#[cfg(test)]
pub(crate) mod tests;
