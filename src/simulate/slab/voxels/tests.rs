//! Voxel files: what is written is read, and what is damaged is named.

use super::*;
use npyz::WriterBuilder;
use std::io::{Cursor, Write};
use std::sync::Arc;
use zip::{ZipWriter, write::SimpleFileOptions};

type Named = (&'static str, Vec<u64>, Vec<f64>);

/// A slab of 2 × 3 × 4 voxels whose numbers tell their place.
fn arrays() -> Vec<Named> {
    let shape = vec![2, 3, 4, 3];
    let count = 72;
    vec![
        (SCATTERING, shape.clone(), (0..count).map(|i| 1.0 + f64::from(i)).collect()),
        (ABSORPTION, shape, (0..count).map(|i| 0.125 * f64::from(i)).collect()),
        ("voxel_mm", vec![3], vec![0.1, 0.2, 0.3]),
        ("refractive_index", vec![], vec![1.4]),
    ]
}

fn npz(arrays: &[Named], method: zip::CompressionMethod) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, shape, values) in arrays {
        let mut bytes = Vec::new();
        let mut writer = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut bytes).begin_nd().unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
        zip.start_file(format!("{name}.npy"), SimpleFileOptions::default().compression_method(method)).unwrap();
        zip.write_all(&bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn read_npz(arrays: &[Named]) -> Result<VoxelFile> {
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), npz(arrays, zip::CompressionMethod::Deflated)).unwrap();
    read(file.path(), None)
}

fn write_zarr(path: &Path, arrays: &[Named]) {
    let store = Arc::new(zarrs::filesystem::FilesystemStore::new(path).unwrap());
    zarrs::group::GroupBuilder::new().build(store.clone(), "/").unwrap().store_metadata().unwrap();
    for (name, shape, values) in arrays {
        let data_type = zarrs::array::data_type::float64();
        let array = zarrs::array::ArrayBuilder::new(shape.clone(), shape.clone(), data_type, f64::NAN)
            .build(store.clone(), &format!("/{name}"))
            .unwrap();
        array.store_metadata().unwrap();
        array.store_array_subset(&array.subset_all(), values.clone()).unwrap();
    }
}

#[test]
fn npz_and_zarr_give_the_slab_that_was_written() {
    let stored = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(stored.path(), npz(&arrays(), zip::CompressionMethod::Stored)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    write_zarr(folder.path(), &arrays());
    let group = read(folder.path(), Some(0.5)).unwrap();
    for file in [read_npz(&arrays()).unwrap(), read(stored.path(), None).unwrap(), group.clone()] {
        let volume = file.volume;
        assert_eq!((volume.voxels, volume.layers_mm.as_slice()), ([4, 3], &[0.3, 0.3][..]));
        assert_eq!((volume.voxel_mm, volume.refractive_index), ([0.1, 0.2], 1.4));
        // [z 1, y 2, x 3] is the last voxel; its numbers are 69, 70, 71.
        assert_eq!(volume.optics[23].reduced_scattering_per_mm, [70.0, 71.0, 72.0]);
        assert_eq!(volume.optics[23].absorption_per_mm, [8.625, 8.75, 8.875]);
        assert_eq!(file.blake3.len(), 64);
    }
    assert_eq!(group.volume.optics[5].anisotropy, [0.5; 3]);
    assert_eq!(group.blake3, read(folder.path(), None).unwrap().blake3, "the hash is the data's");
}

#[test]
fn arrays_that_cannot_be_used_are_named() {
    let changed = |which: usize, change: &dyn Fn(&mut Named)| {
        let mut arrays = arrays();
        change(&mut arrays[which]);
        let named = arrays[which].0;
        let error = read_npz(&arrays).unwrap_err();
        assert!(matches!(&error, Error::Voxels { array, .. } if array.starts_with(named)), "{named}: {error}");
        error.to_string()
    };
    for value in [f64::NAN, f64::INFINITY, -1.0, 1e7] {
        let message = changed(0, &|a| a.2[40] = value);
        assert!(message.contains("[1, 0, 1, 1]"), "{message}");
    }
    changed(1, &|a| a.2[0] = -1e-9);
    changed(1, &|a| a.1 = vec![2, 4, 3, 3]);
    changed(0, &|a| a.1 = vec![72]);
    changed(0, &|a| a.1 = vec![2, 3, 3, 4]);
    changed(0, &|a| (a.1, a.2) = (vec![0, 3, 4, 3], vec![]));
    changed(2, &|a| a.2[1] = 0.0);
    changed(2, &|a| a.2[2] = 900.0);
    changed(2, &|a| (a.1, a.2) = (vec![2], vec![0.1, 0.1]));
    changed(3, &|a| a.2[0] = f64::NAN);
    for missing in 0..3 {
        let mut arrays = arrays();
        let name = arrays.remove(missing).0;
        assert!(read_npz(&arrays).unwrap_err().to_string().contains(name));
    }
    let with = |shape: Vec<u64>, values: Vec<f64>| {
        let mut arrays = arrays();
        arrays.push((ANISOTROPY, shape, values));
        arrays
    };
    assert_eq!(read_npz(&with(vec![], vec![0.7])).unwrap().volume.optics[3].anisotropy, [0.7; 3]);
    let each = with(vec![2, 3, 4, 3], (0..72).map(|i| 0.01 * f64::from(i)).collect());
    assert_eq!(read_npz(&each).unwrap().volume.optics[1].anisotropy, [0.03, 0.04, 0.05]);
    assert!(read_npz(&with(vec![], vec![1.0])).unwrap_err().to_string().contains(ANISOTROPY));
    assert!(read_npz(&with(vec![2], vec![0.1, 0.2])).unwrap_err().to_string().contains(ANISOTROPY));
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), npz(&with(vec![], vec![0.7]), zip::CompressionMethod::Stored)).unwrap();
    assert!(matches!(read(file.path(), Some(0.2)), Err(Error::Setting { setting: "anisotropy", .. })));
}

#[test]
fn a_shape_larger_than_its_numbers_costs_no_memory() {
    for shape in ["(1000000000, 1000000000, 1000000000, 3)", "(200, 200, 200, 3)", "(-1,)", "(18446744073709551616,)"] {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let mut voxel_mm = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        voxel_mm.extend(format!("{:<118}", "{'descr': '<f8', 'fortran_order': False, 'shape': (), }").bytes());
        voxel_mm.extend(0.1f64.to_le_bytes());
        let mut big = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        big.extend(
            format!("{:<118}", format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}")).bytes(),
        );
        for (name, bytes) in [("voxel_mm", voxel_mm), (SCATTERING, big)] {
            zip.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
            zip.write_all(&bytes).unwrap();
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), zip.finish().unwrap().into_inner()).unwrap();
        let error = read(file.path(), None).unwrap_err();
        assert!(matches!(&error, Error::Voxels { array, .. } if array == SCATTERING), "{shape}: {error}");
    }
}

#[test]
fn fortran_order_and_big_endian_are_understood() {
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend(format!("{:<118}", "{'descr': '>f4', 'fortran_order': True, 'shape': (2, 3), }").bytes());
    for v in [0.0f32, 10.0, 1.0, 11.0, 2.0, 12.0] {
        bytes.extend(v.to_be_bytes());
    }
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("a.npy", SimpleFileOptions::default()).unwrap();
    zip.write_all(&bytes).unwrap();
    let file = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(file.path(), zip.finish().unwrap().into_inner()).unwrap();
    let array = npz::Archive::open(file.path()).unwrap().array("a", 6).unwrap().unwrap();
    assert_eq!((array.shape, array.values), (vec![2, 3], vec![0.0, 1.0, 2.0, 10.0, 11.0, 12.0]));
}

/// Whatever is cut off or flipped, the answer is a slab or a typed error: never a panic, never our own fault.
#[test]
fn damaged_files_are_errors_and_no_panics() {
    let file = tempfile::NamedTempFile::new().unwrap();
    for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
        let whole = npz(&arrays(), method);
        for len in (0..whole.len()).step_by(7) {
            std::fs::write(file.path(), &whole[..len]).unwrap();
            assert!(!read(file.path(), None).unwrap_err().is_internal(), "cut to {len}");
        }
        for i in 0..whole.len() {
            let mut damaged = whole.clone();
            damaged[i] ^= [0xff, 0x01, 0x80][i % 3];
            std::fs::write(file.path(), &damaged).unwrap();
            if let Err(error) = read(file.path(), None) {
                assert!(!error.is_internal(), "byte {i}: {error}");
            }
        }
    }
    let folder = tempfile::tempdir().unwrap();
    assert!(!read(folder.path(), None).unwrap_err().is_internal());
    write_zarr(folder.path(), &arrays());
    for name in ["zarr.json", "voxel_mm/zarr.json", "reduced_scattering_per_mm/zarr.json"] {
        let target = folder.path().join(name);
        let whole = std::fs::read(&target).unwrap();
        for len in (0..whole.len()).step_by(13) {
            std::fs::write(&target, &whole[..len]).unwrap();
            if let Err(error) = read(folder.path(), None) {
                assert!(!error.is_internal(), "{name} cut to {len}: {error}");
            }
        }
        std::fs::write(&target, &whole).unwrap();
    }
    // A missing chunk reads as the fill value, here NaN: an error and not a slab of nothing.
    std::fs::remove_dir_all(folder.path().join("absorption_per_mm/c")).unwrap();
    assert!(read(folder.path(), None).unwrap_err().to_string().contains(ABSORPTION));
    std::fs::remove_dir_all(folder.path().join("absorption_per_mm")).unwrap();
    assert!(read(folder.path(), None).unwrap_err().to_string().contains(ABSORPTION));
}
