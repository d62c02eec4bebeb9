//! NPZ: a material as NumPy arrays.

use super::{CHANNELS, Material, exr_layers::monomial_coefficients};
use crate::output::{SEAL, write_whole};
use crate::{Error, Result};
use npyz::WriterBuilder;
use std::io::{Cursor, Write};
use std::path::Path;
use zip::{ZipWriter, write::SimpleFileOptions};

/// Writes every tensor under its own name, `color_coefficients` in the Legendre basis and `color_monomials` in powers
/// of the intensity, the scalars of the header as arrays, and the whole header as the text `header_json`.
///
/// # Errors
/// [`Error::Io`], [`Error::Internal`].
pub fn export_npz(material: &Material, path: &Path) -> Result<()> {
    let bytes = archive(material).map_err(Error::internal)?;
    write_whole(path, bytes)
}

fn archive(material: &Material) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    let h = &material.header;
    let n = h.rows() as u64;
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let pair = |v: [usize; 2]| v.map(|v| v as f64).to_vec();
    let lit: Vec<f64> = material.lit_mm.as_flattened().to_vec();
    let range: Vec<f64> = h.intensity_range.iter().map(|&v| f64::from(v)).collect();

    for (name, shape, values) in material.tensors() {
        add(&mut zip, name, &shape.iter().map(|&n| n as u64).collect::<Vec<_>>(), values)?;
    }
    if h.shared_maps.is_some() {
        let shape = [h.offset_planes, h.terms, h.extended[1], h.extended[0]].map(|n| n as u64);
        add(&mut zip, "offset_factors", &shape, &material.offset_factors.all())?;
    }
    if let Some(degree) = h.degree {
        add(&mut zip, "color_monomials", &[n, CHANNELS as u64, degree as u64 + 1], &monomial_coefficients(material))?;
    }
    add(&mut zip, "shift", &[n, 2], material.shift.as_flattened())?;
    add(&mut zip, "lit_mm", &[n, 2], &lit)?;
    if let Some(grid) = h.exit_grid {
        add(&mut zip, "exit_origin_mm", &[2], &grid.origin_mm)?;
    }
    add(&mut zip, "points", &[2], &pair(h.points))?;
    add(&mut zip, "window", &[2], &pair(h.window))?;
    add(&mut zip, "extended", &[2], &pair(h.extended))?;
    add(&mut zip, "pitch_mm", &[], &[h.pitch_mm])?;
    add(&mut zip, "lit_pitch_mm", &[2], &h.lit_pitch_mm)?;
    if h.degree.is_some() {
        add(&mut zip, "intensity_range", &[2], &range)?;
    }
    add(&mut zip, "singular_values", &[h.singular_values.len() as u64], &h.singular_values)?;
    add(&mut zip, "noise_level", &[], &[h.noise_level])?;
    let header = serde_json::to_string(h)?;
    add(&mut zip, "header_json", &[header.len() as u64], header.as_bytes())?;
    zip.set_comment(SEAL)?;
    Ok(zip.finish()?.into_inner())
}

fn add<T: npyz::Serialize + npyz::AutoSerialize + Copy>(
    zip: &mut ZipWriter<Cursor<Vec<u8>>>,
    name: &str,
    shape: &[u64],
    values: &[T],
) -> Result<(), Box<dyn std::error::Error>> {
    let mut array = Vec::new();
    let mut writer = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut array).begin_nd()?;
    writer.extend(values.iter().copied())?;
    writer.finish()?;
    zip.start_file(
        npyz::npz::file_name_from_array_name(name),
        SimpleFileOptions::default().large_file(array.len() > 1 << 31),
    )?;
    zip.write_all(&array)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::{OffsetFactors, SharedBasis, naive};
    use super::*;
    use std::io::Read;

    fn array<T: npyz::Deserialize>(path: &Path, name: &str) -> (Vec<u64>, Vec<T>) {
        let mut zip = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
        let mut bytes = Vec::new();
        zip.by_name(&format!("{name}.npy")).unwrap().read_to_end(&mut bytes).unwrap();
        let array = npyz::NpyFile::new(bytes.as_slice()).unwrap();
        (array.shape().to_vec(), array.into_vec().unwrap())
    }

    #[test]
    fn arrays_have_the_shapes_and_the_order_that_the_material_has() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.npz");
        for m in naive::materials() {
            export_npz(&m, &path).unwrap();
            let h = &m.header;
            let (a, b) = (h.incident_planes as u64, h.offset_planes as u64);
            assert_eq!(array::<f32>(&path, "weights"), (vec![3], m.weights.clone()));
            assert_eq!(array::<f32>(&path, "incident_factors"), (vec![a, 15, 3], m.incident_factors.clone()));
            assert_eq!(array::<f32>(&path, "offset_factors"), (vec![b, 3, 7, 9], m.offset_factors.all().into_owned()));
            assert_eq!(array::<i16>(&path, "shift"), (vec![15, 2], m.shift.concat()));
            assert_eq!(array::<f64>(&path, "lit_mm"), (vec![15, 2], m.lit_mm.concat()));
            assert_eq!(array::<f64>(&path, "points"), (vec![2], vec![5.0, 3.0]));
            assert_eq!(array::<f64>(&path, "window"), (vec![2], vec![7.0, 5.0]));
            assert_eq!(array::<f64>(&path, "extended"), (vec![2], vec![9.0, 7.0]));
            assert_eq!(array::<f64>(&path, "pitch_mm"), (vec![], vec![0.5]));
            assert_eq!(array::<f64>(&path, "lit_pitch_mm"), (vec![2], vec![0.75, 1.0]));
            assert_eq!(array::<f64>(&path, "singular_values"), (vec![3], vec![3.0, 1.0, 0.5]));
            assert_eq!(array::<f64>(&path, "noise_level"), (vec![], vec![0.01]));
            if h.profile {
                assert_eq!(array::<f32>(&path, "profile"), (vec![b, 7, 9], m.profile.clone()));
            }
            let header: super::super::MaterialHeader =
                serde_json::from_slice(&array::<u8>(&path, "header_json").1).unwrap();
            assert_eq!(&header, h);
            let Some(degree) = h.degree else { continue };
            let n = degree as u64 + 1;
            assert_eq!(array::<f32>(&path, "color_coefficients"), (vec![15, 3, n], m.color_coefficients.clone()));
            assert_eq!(array::<f64>(&path, "intensity_range"), (vec![2], vec![-0.75, 1.5]));
            let (shape, powers) = array::<f64>(&path, "color_monomials");
            assert_eq!(shape, [15, 3, n]);
            for (at, powers) in powers.chunks_exact(degree + 1).enumerate() {
                let (i, c) = (at / 3, at % 3);
                let found: f64 = powers.iter().rev().fold(0.0, |sum, b| sum * 0.4 + b);
                let expected = naive::colored(&m, i, [0.4; 3])[c];
                assert!((found - expected).abs() < 1e-13, "rounding: {found} {expected}");
            }
        }
    }

    #[test]
    fn shared_maps_are_written_beside_the_offset_factors_that_they_make() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.npz");
        let mut m = naive::materials().remove(0);
        let wave = |n: usize, f: f32| (0..n).map(|k| (f * (k as f32 + 1.0)).sin()).collect::<Vec<f32>>();
        let shared = SharedBasis { maps: 2, vectors: wave(2 * 63, 0.41), core: wave(3 * 3 * 2, 1.3) };
        (m.header.shared_maps, m.offset_factors) = (Some(2), OffsetFactors::Shared(shared.clone()));
        export_npz(&m, &path).unwrap();
        assert_eq!(array::<f32>(&path, "offset_maps"), (vec![2, 7, 9], shared.vectors.clone()));
        assert_eq!(array::<f32>(&path, "offset_core"), (vec![3, 3, 2], shared.core.clone()));
        let (shape, factors) = array::<f32>(&path, "offset_factors");
        assert_eq!(shape, [3, 3, 7, 9]);
        for (at, found) in factors.iter().enumerate() {
            let (factor, e) = (at / 63, at % 63);
            let sum: f32 = (0..2).map(|l| shared.core[2 * factor + l] * shared.vectors[63 * l + e]).sum();
            assert!((found - sum).abs() < 1e-6, "f32: {found} {sum}");
        }
    }
}
