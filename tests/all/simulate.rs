//! Simulated captures: what is written reads back, is the same for any number of threads, and is replaced only when
//! asked.

use acquire::{
    capture::{Manifest, Pattern, Rig},
    progress::Progress,
    simulate::{FileFormat, SimulateOptions, SlabMaterial, Transport, Truth, simulate},
    transport::MatrixReader,
};
use npyz::WriterBuilder;
use std::path::Path;

fn tiny() -> SimulateOptions {
    SimulateOptions {
        material: SlabMaterial::chessboard([4, 3]),
        grid: [4, 3],
        window: [7, 5],
        exposures: 2,
        ..SimulateOptions::default()
    }
}

/// All files below `dir` with their bytes, sorted by name.
fn files(dir: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    let mut folders = vec![dir.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(dir).unwrap().display().to_string();
                found.push((name, std::fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn one_and_two_threads_write_the_same_bytes() {
    let traced = SimulateOptions { transport: Transport::Mc, photons: 2_000, ..tiny() };
    let everywhere = SimulateOptions { material: SlabMaterial::homogeneous(), ..traced.clone() };
    for options in [tiny(), traced, everywhere] {
        same_for_any_number_of_threads(&options);
    }
}

fn same_for_any_number_of_threads(options: &SimulateOptions) {
    let dir = tempfile::tempdir().unwrap();
    let write = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let path = dir.path().join(format!("threads-{threads}"));
        pool.install(|| simulate(options, &path, &Progress::silent())).unwrap();
        files(&path)
    };
    let (one, two) = (write(1), write(2));
    assert_eq!(one.len(), two.len());
    for (a, b) in one.iter().zip(&two) {
        assert_eq!(a.0, b.0);
        assert!(a.1 == b.1, "{} differs", a.0);
    }
}

#[test]
fn the_capture_and_its_truth_read_back() {
    let dir = tempfile::tempdir().unwrap();
    for (format, extension) in [(FileFormat::Png, "png"), (FileFormat::Jpeg, "jpg")] {
        let path = dir.path().join(extension);
        let options = SimulateOptions { format, spacing: Some([2, 3]), ..tiny() };
        let summary = simulate(&options, &path, &Progress::silent()).unwrap();
        let manifest = Manifest::read(&path).unwrap();
        let rig = Rig::read(&Rig::find(&path, None).unwrap()).unwrap();
        assert_eq!(rig.camera.size_px, summary.size_px);
        assert_eq!(manifest.shots.len(), summary.shots);
        let mut lit = 0;
        for shot in &manifest.shots {
            if let Pattern::Lattice { dots } = &shot.pattern {
                lit += dots.len();
            }
            for photograph in &shot.photographs {
                let size = image::image_dimensions(path.join(&photograph.file)).unwrap();
                assert_eq!([size.0 as usize, size.1 as usize], rig.camera.size_px);
            }
        }
        assert_eq!(lit, 12, "every point is lit once");

        let truth: Truth = toml::from_str(&std::fs::read_to_string(path.join("truth.toml")).unwrap()).unwrap();
        assert_eq!(truth.options, options);
        let matrix = MatrixReader::open(&path.join("truth.rd.zarr")).unwrap();
        let header = matrix.header();
        assert_eq!((header.points, header.window), ([4, 3], [7, 5]));
        assert_eq!(header.shots.len(), 6);
        assert!(header.shot_of.iter().all(Option::is_some));
        let block = matrix.read(0..12).unwrap();
        assert!(block.response.iter().all(|&r| r > 0.0) && block.valid.iter().all(|&v| v == 1));
        for row in block.response.chunks(header.row_len()) {
            // A part of the albedo: no more leaves than arrives.
            let albedo: f32 = row.iter().step_by(3).sum::<f32>() * (header.pitch_mm * header.pitch_mm) as f32;
            assert!(albedo > 0.1 && albedo < 1.0, "{albedo}");
        }
        // The lit point is where the projector's map and the shot's drift put it.
        let shot = header.shot_of[5].unwrap();
        let mapped = truth.slab_from_projector.map(manifest.grid.dot_projector_px([1, 1]));
        for a in 0..2 {
            assert!((header.lit_mm[5][a] - mapped[a] - truth.shots[shot].drift_mm[a]).abs() < 1e-12);
        }
    }
}

#[test]
fn a_folder_is_replaced_only_when_asked_and_only_an_earlier_simulation() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("capture");
    std::fs::create_dir(&path).unwrap();
    std::fs::write(path.join("precious.txt"), "keep").unwrap();
    let options = SimulateOptions { grid: [1, 1], window: [5, 3], exposures: 1, ..SimulateOptions::default() };
    let error = simulate(&options, &path, &Progress::silent()).unwrap_err();
    assert!(matches!(error, acquire::Error::NotEmpty { .. }), "{error}");
    assert!(path.join("precious.txt").exists());
    let force = SimulateOptions { force: true, ..options };
    simulate(&force, &path, &Progress::silent()).unwrap_err();
    assert!(path.join("precious.txt").exists(), "a folder that is no simulation is somebody's work");
    // A simulation, and the same file beside it.
    std::fs::remove_file(path.join("precious.txt")).unwrap();
    simulate(&force, &path, &Progress::silent()).unwrap();
    std::fs::write(path.join("precious.txt"), "keep").unwrap();
    let error = simulate(&force, &path, &Progress::silent()).unwrap_err();
    assert!(matches!(error, acquire::Error::NotOurs { path: file } if file == path.join("precious.txt")));
    std::fs::remove_file(path.join("precious.txt")).unwrap();
    simulate(&force, &path, &Progress::silent()).unwrap();
    assert!(path.join("capture.toml").exists());
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left beside the capture");
}

fn truth(dir: &Path) -> Truth {
    toml::from_str(&std::fs::read_to_string(dir.join("truth.toml")).unwrap()).unwrap()
}

#[test]
fn the_truth_records_the_media_and_findings_are_told() {
    let dir = tempfile::tempdir().unwrap();
    for (n, (text, media, findings)) in [
        ("layered:skin1=0.5,cream=2", &["skin1", "cream"][..], 0),
        ("chessboard-3x3:apple,potato", &["apple", "potato"], 0),
        // Black in blue, where it absorbs and scatters nothing.
        ("one-channel-black", &["one-channel-black"], 1),
        // Marble has another refractive index than cream.
        ("layered:marble=1,cream=2", &["marble", "cream"], 1),
    ]
    .into_iter()
    .enumerate()
    {
        let options = SimulateOptions { material: text.parse().unwrap(), grid: [2, 3], ..tiny() };
        let path = dir.path().join(n.to_string());
        let summary = simulate(&options, &path, &Progress::silent()).unwrap();
        assert_eq!(summary.warnings.len(), findings, "{text}: {:?}", summary.warnings);
        let truth = truth(&path);
        assert_eq!(truth.options, options);
        assert_eq!(truth.medium.media.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), media);
        let rows = MatrixReader::open(&path.join("truth.rd.zarr")).unwrap().read(0..4).unwrap();
        let blue_is_black = rows.response.iter().skip(2).step_by(3).all(|&r| r == 0.0);
        assert_eq!(blue_is_black, text == "one-channel-black");
    }
}

/// A voxel file of two layers is the layered slab, and the record of it refuses another file.
#[test]
fn a_voxel_file_is_simulated_and_its_hash_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("slab.npz");
    let write = |scattering: f64| {
        let layers = |top: [f64; 3], below: [f64; 3]| [top, below].map(|rgb| [rgb; 4]).as_flattened().concat();
        let scattering = layers([0.74, 0.88, 1.01], [scattering, 5.47, 3.15]);
        let absorption = layers([0.032, 0.17, 0.48], [0.0002, 0.0028, 0.0163]);
        let mut zip = zip::ZipWriter::new(std::fs::File::create(&file).unwrap());
        for (name, shape, values) in [
            ("reduced_scattering_per_mm", &[2u64, 2, 2, 3][..], scattering),
            ("absorption_per_mm", &[2, 2, 2, 3], absorption),
            ("voxel_mm", &[3], vec![3.0, 3.0, 1.0]),
        ] {
            zip.start_file(format!("{name}.npy"), zip::write::SimpleFileOptions::default()).unwrap();
            let options = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut zip);
            let mut writer = options.begin_nd().unwrap();
            writer.extend(values).unwrap();
            writer.finish().unwrap();
        }
        zip.finish().unwrap();
    };
    write(7.38);
    let options = SimulateOptions { material: SlabMaterial::Voxels(file.clone()), ..tiny() };
    let path = dir.path().join("voxels");
    simulate(&options, &path, &Progress::silent()).unwrap();
    let layered = SimulateOptions { material: "layered:skin1=1,cream=1".parse().unwrap(), ..tiny() };
    simulate(&layered, &dir.path().join("layered"), &Progress::silent()).unwrap();
    let rows = |dir: &Path| MatrixReader::open(&dir.join("truth.rd.zarr")).unwrap().read(0..9).unwrap().response;
    for (a, b) in rows(&path).iter().zip(rows(&dir.path().join("layered"))) {
        // The same numbers by sums over other voxels.
        assert!((a / b - 1.0).abs() < 1e-4, "{a} {b}");
    }
    let recorded = truth(&path).options;
    assert_eq!(recorded.voxels_blake3.as_ref().map(String::len), Some(64));
    simulate(&recorded, &dir.path().join("again"), &Progress::silent()).unwrap();
    write(7.37);
    let error = simulate(&recorded, &dir.path().join("other"), &Progress::silent()).unwrap_err();
    assert!(error.to_string().contains("BLAKE3") && !dir.path().join("other").exists(), "{error}");
}

#[test]
fn the_truth_alone_is_that_of_the_capture_and_is_no_capture() {
    let traced = SimulateOptions { transport: Transport::Mc, photons: 2_000, ..tiny() };
    for options in [tiny(), traced] {
        let dir = tempfile::tempdir().unwrap();
        let [whole, alone] = ["whole", "alone"].map(|name| dir.path().join(name));
        let with = simulate(&options, &whole, &Progress::silent()).unwrap();
        let options = SimulateOptions { truth_only: true, ..options };
        let without = simulate(&options, &alone, &Progress::silent()).unwrap();
        assert_eq!((without.photographs, without.photograph_bytes), (0, 0));
        assert_eq!((with.shots, with.photon_noise), (without.shots, without.photon_noise));
        let names: Vec<String> = std::fs::read_dir(&alone)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        let known = |name: &String| name.starts_with("truth.") || name == ".acquire-output.json";
        assert!(names.len() == 3 && names.iter().all(known), "{names:?}");
        let [a, b] = [&whole, &alone].map(|p| MatrixReader::open(&p.join("truth.rd.zarr")).unwrap());
        assert_eq!((&a.header().lit_mm, &a.header().shots), (&b.header().lit_mm, &b.header().shots));
        assert_eq!(a.read(0..a.header().rows()).unwrap(), b.read(0..b.header().rows()).unwrap());
        // Replaced as any simulation.
        simulate(&SimulateOptions { force: true, ..options }, &alone, &Progress::silent()).unwrap();
    }
}
