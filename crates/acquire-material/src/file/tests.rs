use super::*;
use crate::{Model, naive};

impl Material {
    fn save(&self, path: &Path) -> Result<()> {
        self.to_bytes().map(|bytes| std::fs::write(path, bytes).unwrap())
    }

    fn save_half(&self, path: &Path) -> Result<()> {
        self.to_half_bytes().map(|bytes| std::fs::write(path, bytes).unwrap())
    }
}

/// A small material with two terms, shifts and a quadratic colour.
pub(crate) fn example() -> Material {
    let header = MaterialHeader {
        model: Model::Tucker,
        points: [3, 2],
        window: [5, 3],
        pitch_mm: 0.5,
        lit_pitch_mm: [1.0, 1.5],
        extended: [7, 3],
        terms: 2,
        incident_planes: 1,
        offset_planes: 1,
        shared_maps: None,
        profile: false,
        exit_grid: None,
        degree: Some(2),
        intensity_range: [-0.1, 1.0],
        singular_values: vec![3.0, 1.0, 1e-3],
        noise_level: 0.01,
        warnings: Vec::new(),
        provenance: serde_json::json!({"version": "test"}),
    };
    let wave = |n: usize, f: f32| (0..n).map(|k| (f * k as f32).sin()).collect::<Vec<f32>>();
    Material {
        lit_mm: (0..6).map(|k| [(k % 3) as f64, (k / 3) as f64 * 1.5]).collect(),
        weights: vec![3.0, 1.0],
        incident_factors: wave(12, 0.7),
        offset_factors: wave(42, 0.3).into(),
        profile: Vec::new(),
        entry_map: Vec::new(),
        exit_map: Vec::new(),
        color_coefficients: wave(54, 1.1),
        shift: vec![[0, 0], [1, 0], [-1, 0], [0, 0], [1, 0], [0, 0]],
        header,
    }
}

#[test]
fn what_is_saved_is_what_is_loaded_and_two_files_of_it_are_equal() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (folder.path().join("a.safetensors"), folder.path().join("b.safetensors"));
    let material = example();
    material.save(&a).unwrap();
    material.save(&b).unwrap();
    assert_eq!(Material::load(&a).unwrap(), material);
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
}

#[test]
fn half_precision_is_right_to_eleven_bits_over_many_decades() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.safetensors");
    let mut material = example();
    assert!(matches!(material.save_half(&path), Err(Error::Option { option: "precision", .. })));
    (material.header.degree, material.color_coefficients) = (None, Vec::new());
    material.weights = vec![3e20, 1e17];
    material.offset_factors.own().iter_mut().for_each(|h| *h *= 1e-25);
    material.save_half(&path).unwrap();
    let loaded = Material::load(&path).unwrap();
    for (a, b) in material.stored().iter().zip(loaded.stored()) {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= a.abs() / 2048.0), "half a unit in the last place");
    }
    assert_eq!((loaded.shift, loaded.lit_mm), (material.shift.clone(), material.lit_mm.clone()));
    let (whole, half) = (folder.path().join("w.safetensors"), std::fs::metadata(&path).unwrap().len());
    material.save(&whole).unwrap();
    assert!(half < std::fs::metadata(&whole).unwrap().len());
}

#[test]
fn a_file_cut_anywhere_or_with_a_flipped_byte_of_its_header_is_refused_or_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.safetensors");
    example().save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    for len in 0..bytes.len() {
        assert!(decode(&bytes[..len]).is_err(), "{len} of {} bytes", bytes.len());
    }
    for at in 0..bytes.len() {
        let mut flipped = bytes.clone();
        flipped[at] ^= 0x10;
        // Of the name of the checksum alone: then it is a file of an earlier version, and whole.
        assert!(decode(&flipped).is_err() || decode(&flipped).unwrap() == example(), "byte {at}");
    }
}

#[test]
fn exchanged_tensors_are_refused_and_files_without_a_checksum_are_read() {
    let bytes = example().to_bytes().unwrap();
    let (text, file) = (SafeTensors::read_metadata(&bytes).unwrap().1, SafeTensors::deserialize(&bytes).unwrap());
    let text = text.metadata().as_ref().unwrap()[KEY].clone();
    let write = |text: &str, exchange: bool| {
        let name = |name: &str| match name {
            "incident_factors" if exchange => "more".to_owned(),
            name => name.to_owned(),
        };
        let views: Vec<_> = file.tensors().into_iter().map(|(n, view)| (name(&n), view)).collect();
        serialize(views, Some([(KEY.to_owned(), text.to_owned())].into_iter().collect())).unwrap()
    };
    // Written again by another program, in another order: the same material.
    assert_eq!(decode(&write(&text, false)).unwrap(), example());
    assert!(decode(&write(&text, true)).unwrap_err().contains("checksum"));
    let at = text.rfind(",\"blake3\"").unwrap();
    let earlier = format!("{}}}", &text[..at]);
    assert_eq!(decode(&write(&earlier, false)).unwrap(), example());
    assert!(decode(&write(&text.replacen("0.01", "0.02", 1), false)).unwrap_err().contains("checksum"));
}

#[test]
fn numbers_that_are_not_finite_and_shifts_out_of_range_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.safetensors");
    let mut material = example();
    material.weights[1] = f32::NAN;
    material.save(&path).unwrap();
    assert!(matches!(Material::load(&path), Err(Error::Damaged { reason, .. }) if reason.contains("weights")));
    let mut material = example();
    material.shift[3] = [3, 0];
    material.save(&path).unwrap();
    assert!(matches!(Material::load(&path), Err(Error::Damaged { reason, .. }) if reason.contains("row 3")));
    let mut material = example();
    material.color_coefficients[7] = 1e37;
    material.save(&path).unwrap();
    let refused = Material::load(&path);
    assert!(matches!(refused, Err(Error::Damaged { reason, .. }) if reason.contains("color_coefficients")));
    let mut material = example();
    material.header.lit_pitch_mm[1] = f64::NAN;
    assert!(matches!(material.save(&path), Err(Error::Inconsistent { .. })), "it could not be read again");
    let mut material = example();
    material.shift.pop();
    assert!(matches!(material.save(&path), Err(Error::Inconsistent { .. })));
}

#[test]
fn one_response_is_the_same_as_in_its_row() {
    let material = example();
    for index in 0..6 {
        let row = material.evaluate_row(index);
        for (k, rgb) in row.chunks_exact(3).enumerate() {
            let offset = [(k % 5) as isize - 2, (k / 5) as isize - 1];
            assert_eq!(material.response(index, offset).unwrap(), rgb);
        }
    }
    assert_eq!(material.response(0, [3, 0]), None);
    assert_eq!(material.response(6, [0, 0]), None);
    assert!(material.evaluate_row(6).is_empty());
    // 2 weights, 12 + 42 factors, 54 coefficients, 12 shifts, 2 ends of the range
    assert_eq!(material.bytes_f32(), 4 * 124);
}

fn saved(material: &Material) -> Vec<u8> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.safetensors");
    material.save(&path).unwrap();
    std::fs::read(&path).unwrap()
}

/// A joint material whose offset factors are sums of two maps.
fn sharing() -> Material {
    let mut m = naive::materials().remove(0);
    let wave = |n: usize, f: f32| (0..n).map(|k| (f * (k as f32 + 1.0)).sin()).collect::<Vec<f32>>();
    let shared = SharedBasis { maps: 2, vectors: wave(2 * 63, 0.41), core: wave(3 * 3 * 2, 1.3) };
    (m.header.shared_maps, m.offset_factors) = (Some(2), OffsetFactors::Shared(shared));
    m
}

#[test]
fn every_tensor_lies_in_the_file_in_its_order_under_its_name() {
    for m in naive::materials().into_iter().chain([sharing()]) {
        let bytes = saved(&m);
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let f32s = |name: &str| {
            let view = file.tensor(name).unwrap();
            assert_eq!(view.dtype(), Dtype::F32, "{name}");
            let values = view.data().chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect::<Vec<_>>();
            (view.shape().to_vec(), values)
        };
        let (a, b) = (m.header.incident_planes, m.header.offset_planes);
        assert_eq!(f32s("weights"), (vec![3], m.weights.clone()));
        assert_eq!(f32s("incident_factors"), (vec![a, 15, 3], m.incident_factors.clone()));
        match &m.offset_factors {
            OffsetFactors::Own(own) => assert_eq!(f32s("offset_factors"), (vec![b, 3, 7, 9], own.clone())),
            OffsetFactors::Shared(shared) => {
                assert_eq!(f32s("offset_maps"), (vec![2, 7, 9], shared.vectors.clone()));
                assert_eq!(f32s("offset_core"), (vec![3, 3, 2], shared.core.clone()));
                assert!(file.tensor("offset_factors").is_err());
            }
        }
        assert_eq!(file.tensor("profile").is_ok(), m.header.profile);
        if m.header.profile {
            assert_eq!(f32s("profile"), (vec![b, 7, 9], m.profile.clone()));
        }
        if let Some(p) = m.header.degree {
            assert_eq!(f32s("color_coefficients"), (vec![15, 3, p + 1], m.color_coefficients.clone()));
        }
        let lit = m.lit_mm.iter().flatten().map(|&v| v as f32).collect();
        assert_eq!(f32s("lit_mm"), (vec![15, 2], lit));
        let shift = file.tensor("shift").unwrap();
        assert_eq!((shift.dtype(), shift.shape()), (Dtype::I16, [15, 2].as_slice()));
        let shifts: Vec<i16> = shift.data().chunks(2).map(|b| i16::from_le_bytes(b.try_into().unwrap())).collect();
        assert_eq!(shifts, m.shift.concat());
        assert_eq!(decode(&bytes).unwrap(), m);
    }
}

#[test]
fn half_precision_rounds_every_tensor_by_itself_and_keeps_positions_and_shifts() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("m.safetensors");
    for mut m in naive::materials().into_iter().chain([sharing()]).filter(|m| m.header.degree.is_none()) {
        m.weights.iter_mut().for_each(|g| *g *= 3e5);
        m.profile.iter_mut().for_each(|v| *v *= 1e-7);
        m.save_half(&path).unwrap();
        let loaded = Material::load(&path).unwrap();
        assert_eq!((&loaded.header, &loaded.lit_mm, &loaded.shift), (&m.header, &m.lit_mm, &m.shift));
        for (found, asked) in loaded.stored().into_iter().zip(m.stored()) {
            assert_eq!(found.len(), asked.len());
            for (found, asked) in found.iter().zip(asked) {
                // Eleven bits of the number: half a unit in the last place is 2⁻¹¹ of it at most.
                assert!((found - asked).abs() <= asked.abs() / 2048.0, "{found} {asked}");
            }
        }
        assert_eq!(matches!(loaded.offset_factors, OffsetFactors::Shared(_)), m.header.shared_maps.is_some());
    }
}

#[test]
fn headers_that_describe_no_material_are_refused() {
    let good = example().header;
    assert_eq!(check_header(&good), Ok(()));
    type Change = fn(&mut MaterialHeader);
    let refused: [(&str, Change); 22] = [
        ("out of range", |h| h.points[1] = 0),
        ("out of range", |h| h.points[0] = (1 << 20) + 1),
        ("out of range", |h| h.window[0] = 0),
        ("out of range", |h| h.extended[1] = 0),
        ("out of range", |h| h.terms = 0),
        ("out of range", |h| h.degree = Some(16)),
        ("odd", |h| h.window[0] = 4),
        ("odd", |h| h.extended[1] = 4),
        ("odd", |h| h.window[1] = 65_537),
        ("1 or 3", |h| h.incident_planes = 2),
        ("1 or 3", |h| h.offset_planes = 0),
        ("1 or 3", |h| h.offset_planes = 3),
        ("shared_maps", |h| h.shared_maps = Some(0)),
        ("shared_maps", |h| h.shared_maps = Some(7)),
        ("memory", |h| (h.points, h.terms) = ([1 << 20, 1 << 20], 2)),
        ("memory", |h| (h.extended, h.terms) = ([(1 << 20) - 1, (1 << 20) - 1], 2)),
        ("not usable", |h| h.pitch_mm = 0.0),
        ("not usable", |h| h.lit_pitch_mm[0] = 2e9),
        ("not usable", |h| h.lit_pitch_mm[1] = -1.0),
        ("not usable", |h| h.intensity_range = [0.5, 0.5]),
        ("not usable", |h| h.intensity_range = [-2e6, 1.0]),
        ("not usable", |h| h.intensity_range[1] = f32::NAN),
    ];
    for (k, (reason, change)) in refused.into_iter().enumerate() {
        let mut h = good.clone();
        change(&mut h);
        let found = check_header(&h).unwrap_err();
        assert!(found.contains(reason), "{k}: {found}");
    }
    let mut most = good;
    (most.degree, most.offset_planes, most.shared_maps) = (None, 3, Some(6));
    assert_eq!(check_header(&most), Ok(()));
}

/// The file without its checksum, with another text of the header, and another name and shape of each tensor.
fn rewritten(
    bytes: &[u8],
    text: impl Fn(String) -> String,
    tensor: impl Fn(&str, Vec<usize>) -> (String, Vec<usize>),
) -> Vec<u8> {
    let (_, metadata) = SafeTensors::read_metadata(bytes).unwrap();
    let header = metadata.metadata().as_ref().unwrap()[KEY].clone();
    let unsigned = format!("{}}}", &header[..header.rfind(",\"blake3\"").unwrap()]);
    let header = text(unsigned);
    let file = SafeTensors::deserialize(bytes).unwrap();
    let views = file.tensors().into_iter().map(|(name, view)| {
        let (name, shape) = tensor(&name, view.shape().to_vec());
        (name, TensorView::new(view.dtype(), shape, view.data()).unwrap())
    });
    serialize(views, Some([(KEY.to_owned(), header)].into_iter().collect())).unwrap()
}

#[test]
fn entry_and_exit_maps_are_stored_plain_halved_and_coded() {
    for m in crate::naive::materials().into_iter().filter(|m| m.header.exit_grid.is_some()) {
        let plain = decode(&m.to_bytes().unwrap()).unwrap();
        assert_eq!((&plain.entry_map, &plain.exit_map), (&m.entry_map, &m.exit_map));
        assert_eq!(plain.header.exit_grid, m.header.exit_grid);
        let near = |a: &[f32], b: &[f32], off: f32| {
            assert_eq!(a.len(), b.len());
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() <= off), "{a:?} {b:?}");
        };
        if m.header.degree.is_none() {
            let half = decode(&m.to_half_bytes().unwrap()).unwrap();
            // Numbers up to 1.5, rounded to 11 bits.
            near(&half.exit_map, &m.exit_map, 1.5 / 2048.0);
            near(&half.entry_map, &m.entry_map, 1.5 / 2048.0);
        }
        #[cfg(feature = "coded")]
        {
            let options = crate::coded::EncodeOptions::default();
            let coded = crate::coded::encode(&m, &options).unwrap();
            assert!(coded.added_error <= 3e-3, "as asked: {}", coded.added_error);
            let read = crate::Material::from_bytes(&coded.bytes).unwrap();
            assert_eq!(read, coded.material);
            // Maps are a fourth of the added error in a mean sense; a single sample may be off by several times that.
            near(&read.exit_map, &m.exit_map, 0.05);
            near(&read.entry_map, &m.entry_map, 0.05);
        }
    }
}

#[test]
fn files_of_another_format_or_with_transposed_or_missing_tensors_are_refused() {
    let bytes = saved(&example());
    let same = |name: &str, shape: Vec<usize>| (name.to_owned(), shape);
    assert_eq!(decode(&rewritten(&bytes, |t| t, same)).unwrap(), example());
    let other = rewritten(&bytes, |t| t.replace("\"format\":2", "\"format\":4"), same);
    assert_eq!(decode(&other).unwrap_err(), "format: expected 2 or 3, found 4");
    for wanted in ["incident_factors", "offset_factors", "color_coefficients", "lit_mm", "shift"] {
        let transposed = rewritten(
            &bytes,
            |t| t,
            |name, mut shape| {
                if name == wanted {
                    shape.reverse();
                }
                (name.to_owned(), shape)
            },
        );
        let reason = decode(&transposed).unwrap_err();
        assert!(reason.starts_with(wanted) && reason.contains("expected"), "{reason}");
        let lost = rewritten(&bytes, |t| t, |name, shape| (name.replace(wanted, "other"), shape));
        assert!(decode(&lost).unwrap_err().starts_with(wanted));
    }
    let half = rewritten(&bytes, |t| t.replacen('{', "{\"half_exponents\":[0,0,0,0,0,0,0],", 1), same);
    assert!(decode(&half).unwrap_err().contains("F16"), "numbers of another width");
}

#[test]
fn a_shift_may_reach_the_rim_of_its_own_axis() {
    let mut m = example();
    m.shift[2] = [-2, 1];
    assert_eq!(decode(&saved(&m)).unwrap().shift, m.shift);
    // Two lines are out of a window of 5 × 3.
    m.shift[2] = [1, -2];
    assert!(decode(&saved(&m)).unwrap_err().contains("row 2"));
}
