//! A material that is not finished yet, for tasks.

use crate::material::{Material, MaterialHeader, OffsetFactors, SharedBasis};
use crate::output::numbers;
use crate::transport::MatrixReader;
use serde::{Deserialize, Serialize};

/// All of a material but where its lit points are, which the matrix says.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(in crate::factor) struct SavedMaterial {
    header: MaterialHeader,
    #[serde(with = "numbers")]
    weights: Vec<f32>,
    #[serde(with = "numbers")]
    incident_factors: Vec<f32>,
    /// Offset factors, or the maps of which they are sums.
    #[serde(with = "numbers")]
    offset_factors: Vec<f32>,
    #[serde(with = "numbers")]
    core: Vec<f32>,
    /// How many maps; `None` for factors of their own.
    maps: Option<usize>,
    #[serde(with = "numbers")]
    profile: Vec<f32>,
    #[serde(with = "numbers")]
    color_coefficients: Vec<f32>,
    #[serde(with = "numbers")]
    entry_map: Vec<f32>,
    #[serde(with = "numbers")]
    exit_map: Vec<f32>,
    #[serde(with = "numbers")]
    shift: Vec<[i16; 2]>,
}

impl From<&Material> for SavedMaterial {
    fn from(material: &Material) -> Self {
        let (offset_factors, core, maps) = match &material.offset_factors {
            OffsetFactors::Own(factors) => (factors.clone(), Vec::new(), None),
            OffsetFactors::Shared(shared) => (shared.vectors.clone(), shared.core.clone(), Some(shared.maps)),
        };
        Self {
            header: material.header.clone(),
            weights: material.weights.clone(),
            incident_factors: material.incident_factors.clone(),
            offset_factors,
            core,
            maps,
            profile: material.profile.clone(),
            color_coefficients: material.color_coefficients.clone(),
            entry_map: material.entry_map.clone(),
            exit_map: material.exit_map.clone(),
            shift: material.shift.clone(),
        }
    }
}

impl SavedMaterial {
    /// The material, of this matrix.
    pub(in crate::factor) fn material(self, reader: &MatrixReader) -> Material {
        Material {
            header: self.header,
            lit_mm: reader.header().lit_mm.clone(),
            weights: self.weights,
            incident_factors: self.incident_factors,
            offset_factors: match self.maps {
                None => OffsetFactors::Own(self.offset_factors),
                Some(maps) => {
                    OffsetFactors::Shared(SharedBasis { maps, vectors: self.offset_factors, core: self.core })
                }
            },
            profile: self.profile,
            color_coefficients: self.color_coefficients,
            entry_map: self.entry_map,
            exit_map: self.exit_map,
            shift: self.shift,
        }
    }
}
