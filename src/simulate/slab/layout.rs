//! From a material's name to voxels.

use super::table::NamedMedium;
use super::{Beyond, Optics, SlabMaterial, Volume, voxels};
use crate::simulate::{SimulateOptions, mix_seed};
use crate::{Error, Result, SimulateWarning, geometry::Point};
use serde::{Deserialize, Serialize};

/// Voxels of veins across an outgoing cell, and the most of them along an axis: the narrowest veins are a hundredth of
/// the lit area wide, so that this many still resolve them.
const VEIN_VOXELS_PER_PITCH: f64 = 10.0;
const MOST_VEIN_VOXELS: f64 = 1024.0;
/// Veins go on around the sample by this many pitches; beyond, the border's voxels go on.
const VEIN_MARGIN_PITCHES: f64 = 8.0;
/// The top layer of plain `layered`, as a share of the thickness.
const TOP_SHARE: f64 = 0.25;

/// Where the slab lies, mm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SlabPlace {
    /// First corner and size of the lit area.
    pub lit_origin_mm: Point,
    pub lit_size_mm: Point,
    /// Size of the sample, whose first corner is the origin.
    pub size_mm: Point,
}

/// A slab ready for light.
#[derive(Debug, Clone)]
pub(crate) struct Built {
    pub volume: Volume,
    pub record: SlabRecord,
    pub warnings: Vec<SimulateWarning>,
}

/// The slab as `truth.toml` has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SlabRecord {
    /// The material, as on the command line.
    pub material: String,
    /// Refractive index against air.
    pub refractive_index: f64,
    /// Voxels along x, y, z.
    pub voxels: [usize; 3],
    /// Sides of a voxel along x and y, mm.
    pub voxel_mm: [f64; 2],
    /// First corner of the first voxel, mm.
    pub origin_mm: Point,
    /// Thickness of the voxel layers from the top, mm (one of many equal ones stands for all).
    pub layers_mm: Vec<f64>,
    /// What lies beside the voxels.
    pub beyond: Beyond,
    /// BLAKE3 of the voxel file, when there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub voxels_blake3: Option<String>,
    /// The media by name with their coefficients; none for a voxel file.
    #[serde(default)]
    pub media: Vec<MediumRecord>,
}

/// A medium as `truth.toml` has it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MediumRecord {
    /// Its name.
    pub name: String,
    /// Whether its coefficients are measured (Jensen et al. 2001).
    pub measured: bool,
    /// Coefficients of R, G, B.
    pub optics: Optics,
}

/// Builds the slab of `options`.
///
/// # Errors
/// [`Error::Setting`] when thickness or anisotropy contradict the material; whatever [`voxels::read`] says of a voxel
/// file.
pub(crate) fn build(options: &SimulateOptions, place: &SlabPlace) -> Result<Built> {
    let g = options.anisotropy.unwrap_or(0.0);
    let thickness_mm = options.thickness_mm();
    if let Some(own) = options.material.thickness_mm() {
        agree(options, own)?;
    }
    let optics = |medium: &NamedMedium| medium.optics.with_anisotropy(g);
    let (media, mut volume): (Vec<&NamedMedium>, Volume) = match &options.material {
        SlabMaterial::Homogeneous(medium) => {
            (vec![medium], Volume::uniform(optics(medium), medium.refractive_index, thickness_mm))
        }
        SlabMaterial::Chessboard { squares, media } => {
            (media.to_vec(), chessboard(media.map(optics), *squares, place, thickness_mm))
        }
        SlabMaterial::Veined { media } => (media.to_vec(), veins(media.map(optics), options, place, thickness_mm)),
        SlabMaterial::Layered(layers) => {
            let usual = || {
                let [top, below] = SlabMaterial::default_layers();
                vec![(top, TOP_SHARE * thickness_mm), (below, (1.0 - TOP_SHARE) * thickness_mm)]
            };
            let layers = layers.clone().unwrap_or_else(usual);
            let list: Vec<_> = layers.iter().map(|(medium, t)| (optics(medium), *t)).collect();
            (layers.iter().map(|(medium, _)| *medium).collect(), Volume::layered(&list, 1.0))
        }
        SlabMaterial::Voxels(path) => return from_file(path, options, place),
    };
    volume.refractive_index = media[0].refractive_index;
    let warnings = media
        .iter()
        .find(|m| m.refractive_index != volume.refractive_index)
        .map(|other| SimulateWarning::RefractiveIndexDiffers {
            used: media[0].name.into(),
            used_index: volume.refractive_index,
            other: other.name.into(),
            other_index: other.refractive_index,
        })
        .into_iter()
        .collect();
    let mut record = SlabRecord::new(&options.material, &volume);
    for medium in media {
        if !record.media.iter().any(|m| m.name == medium.name) {
            let (name, measured) = (medium.name.to_owned(), medium.measured);
            record.media.push(MediumRecord { name, measured, optics: optics(medium) });
        }
    }
    Ok(Built { volume, record, warnings })
}

/// Refuses a `thickness_mm` that is not the material's own.
fn agree(options: &SimulateOptions, own_mm: f64) -> Result<()> {
    match options.thickness_mm {
        Some(asked) if (asked - own_mm).abs() > 1e-9 * own_mm => Err(Error::Setting {
            setting: "thickness_mm",
            expected: format!("{}, which the material has, or no such option", (1e6 * own_mm).round() / 1e6),
            found: asked.to_string(),
        }),
        _ => Ok(()),
    }
}

fn from_file(path: &std::path::Path, options: &SimulateOptions, place: &SlabPlace) -> Result<Built> {
    let file = voxels::read(path, options.anisotropy)?;
    agree(options, file.volume.thickness_mm())?;
    if let Some(recorded) = options.voxels_blake3.as_ref().filter(|hash| **hash != file.blake3) {
        return Err(voxels::refused(path, "file", format!("the file whose BLAKE3 is {recorded}"), &file.blake3));
    }
    let mut volume = file.volume;
    volume.origin_mm = std::array::from_fn(|a| {
        place.lit_origin_mm[a] + 0.5 * (place.lit_size_mm[a] - volume.voxels[a] as f64 * volume.voxel_mm[a])
    });
    let mut record = SlabRecord::new(&options.material, &volume);
    record.voxels_blake3 = Some(file.blake3);
    Ok(Built { volume, record, warnings: Vec::new() })
}

impl SlabRecord {
    fn new(material: &SlabMaterial, volume: &Volume) -> Self {
        let layers_mm = &volume.layers_mm;
        let equal = layers_mm.iter().all(|t| *t == layers_mm[0]);
        Self {
            material: material.to_string(),
            refractive_index: volume.refractive_index,
            voxels: [volume.voxels[0], volume.voxels[1], layers_mm.len()],
            voxel_mm: volume.voxel_mm,
            origin_mm: volume.origin_mm,
            layers_mm: if equal { layers_mm[..1].to_vec() } else { layers_mm.clone() },
            beyond: volume.beyond,
            voxels_blake3: None,
            media: Vec::new(),
        }
    }
}

/// Fields over the lit area, and the same pattern endlessly: exactly 2 × 2 voxels that repeat.
fn chessboard([a, b]: [Optics; 2], squares: [usize; 2], place: &SlabPlace, thickness_mm: f64) -> Volume {
    Volume {
        origin_mm: place.lit_origin_mm,
        voxel_mm: std::array::from_fn(|a| place.lit_size_mm[a] / squares[a] as f64),
        voxels: [2, 2],
        beyond: Beyond::Repeat,
        optics: vec![a, b, b, a],
        ..Volume::uniform(a, 1.0, thickness_mm)
    }
}

/// Veins along the zero lines of a turbulent noise whose coarsest wavelength is a third of the lit area's longer side.
fn veins([stone, vein]: [Optics; 2], options: &SimulateOptions, place: &SlabPlace, thickness_mm: f64) -> Volume {
    let margin = VEIN_MARGIN_PITCHES * options.pitch_mm;
    let extent = place.size_mm.map(|s| s + 2.0 * margin);
    let longest = extent[0].max(extent[1]);
    let voxel_mm = (options.pitch_mm / VEIN_VOXELS_PER_PITCH).max(longest / MOST_VEIN_VOXELS);
    let voxels = extent.map(|e| (e / voxel_mm).ceil().max(1.0) as usize);
    let scale_mm = place.lit_size_mm[0].max(place.lit_size_mm[1]) / 3.0;
    let cell = |i: usize| {
        let voxel = [i % voxels[0], i / voxels[0]];
        let at: Point = std::array::from_fn(|a| ((voxel[a] as f64 + 0.5) * voxel_mm - margin) / scale_mm);
        stone.mixed(&vein, vein_share(options.seed, at))
    };
    Volume {
        origin_mm: [-margin; 2],
        voxel_mm: [voxel_mm; 2],
        voxels,
        beyond: Beyond::Extend,
        optics: (0..voxels[0] * voxels[1]).map(cell).collect(),
        ..Volume::uniform(stone, 1.0, thickness_mm)
    }
}

/// Share of vein at `p` (in units of the coarsest wavelength): thin where four octaves of noise pass through zero.
fn vein_share(seed: u64, p: Point) -> f64 {
    let (mut sum, mut scale, mut amplitude) = (0.0, 1.0, 1.0);
    for octave in 0..4 {
        sum += amplitude * value_noise(seed.wrapping_add(octave), [p[0] * scale, p[1] * scale]);
        scale *= 2.0;
        amplitude *= 0.45;
    }
    (-(sum / 0.12).powi(2)).exp()
}

/// Smooth noise in −1..1: hashed values on the unit lattice, blended by the C² quintic (Perlin 2002).
fn value_noise(seed: u64, p: Point) -> f64 {
    let cell = [p[0].floor(), p[1].floor()];
    let blend = |t: f64| t * t * t * (t * (t * 6.0 - 15.0) + 10.0);
    let (u, v) = (blend(p[0] - cell[0]), blend(p[1] - cell[1]));
    let at = |dx: i64, dy: i64| {
        let (x, y) = (cell[0] as i64 + dx, cell[1] as i64 + dy);
        let hash = mix_seed(mix_seed(seed, x as u64), y as u64);
        (hash >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    };
    let top = at(0, 0) + u * (at(1, 0) - at(0, 0));
    let bottom = at(0, 1) + u * (at(1, 1) - at(0, 1));
    top + v * (bottom - top)
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLACE: SlabPlace = SlabPlace { lit_origin_mm: [1.0, 2.0], lit_size_mm: [8.0, 6.0], size_mm: [10.0, 12.0] };

    fn built(material: &str, thickness_mm: Option<f64>) -> Result<Built> {
        let material = material.parse().unwrap();
        build(&SimulateOptions { material, thickness_mm, ..SimulateOptions::default() }, &PLACE)
    }

    fn scattering(volume: &Volume, p: Point) -> f64 {
        let [x, y] = [volume.voxel_at(0, p[0]), volume.voxel_at(1, p[1])];
        volume.optics[y * volume.voxels[0] + x].reduced_scattering_per_mm[0]
    }

    #[test]
    fn a_chessboard_begins_with_its_first_medium_and_goes_on() {
        let volume = built("chessboard-4x4:apple,cream", None).unwrap().volume;
        for (p, expected) in [([1.2, 2.2], 2.29), ([3.2, 2.2], 7.38), ([3.2, 4.2], 2.29), ([0.9, 2.2], 7.38)] {
            assert_eq!(scattering(&volume, p), expected, "{p:?}");
        }
        // One square is still two media: the other lies around it.
        assert_eq!(scattering(&built("chessboard-1x1", None).unwrap().volume, [0.9, 2.2]), 2.55);
    }

    #[test]
    fn veins_cover_a_part_of_the_slab() {
        let volume = built("marble", None).unwrap().volume;
        assert_eq!(volume.voxel_mm, [0.05; 2]);
        let vein: Vec<f64> =
            volume.optics.iter().map(|o| (o.reduced_scattering_per_mm[0] - 2.19) / (2.60 - 2.19)).collect();
        let mean = vein.iter().sum::<f64>() / vein.len() as f64;
        assert!((0.05..0.6).contains(&mean), "{mean}");
        assert!(vein.iter().all(|s| (-1e-9..=1.0 + 1e-9).contains(s)));
    }

    #[test]
    fn layers_have_their_own_thickness_and_another_is_refused() {
        let slab = built("layered:skin1=0.5,whole-milk=3.0", None).unwrap();
        assert_eq!(slab.volume.layers_mm, [0.5, 3.0]);
        assert_eq!(slab.record.media[1].name, "whole-milk");
        built("layered:skin1=0.5,whole-milk=3.0", Some(3.5)).unwrap();
        let error = built("layered:skin1=0.5,whole-milk=3.0", Some(4.0)).unwrap_err();
        assert!(error.to_string().contains("thickness_mm"), "{error}");
        assert_eq!(built("layered", Some(8.0)).unwrap().volume.layers_mm, [2.0, 6.0]);
    }

    #[test]
    fn media_of_other_refractive_index_are_reported() {
        assert!(built("chessboard-4x4", None).unwrap().warnings.is_empty());
        let slab = built("chessboard-4x4:marble,cream", None).unwrap();
        assert_eq!(slab.volume.refractive_index, 1.5);
        assert!(
            matches!(&slab.warnings[..], [SimulateWarning::RefractiveIndexDiffers { other, .. }] if other == "cream")
        );
    }
}
