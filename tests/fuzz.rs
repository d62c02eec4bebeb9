//! Readers and files that nobody wrote: whatever they hold, the answer is what was read or an error. See
//! `fuzz/README.md`.

mod common;

use acquire::capture::{CameraSettings, Manifest, Photograph, Rig};
use acquire::material::{Material, read_light_image};
use acquire::simulate::{FileFormat, SimulateOptions};
use acquire::transport::MatrixReader;
use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Where a mutant lies for its reader, and the reader; what it says is not looked at.
struct Reader {
    name: &'static str,
    read: fn(&Path),
}

const READERS: [Reader; 8] = [
    Reader { name: "photograph", read: read_photograph },
    Reader { name: "light", read: |path| drop(read_light_image(path)) },
    Reader { name: "material", read: read_material },
    Reader { name: "manifest", read: |path| drop(Manifest::read(path.parent().unwrap())) },
    Reader { name: "rig", read: |path| drop(Rig::read(path)) },
    Reader { name: "plan", read: |path| drop(acquire::patterns::Plan::read(path.parent().unwrap())) },
    Reader { name: "voxels", read: |path| drop(acquire::simulate::slab::voxels::read(path, None)) },
    Reader { name: "matrix", read: read_matrix },
];

fn read_photograph(path: &Path) {
    let _ = CameraSettings::read(path);
    let photograph = Photograph::new(path, "s", 0.1);
    let _ = photograph.size_px();
    if let Ok(pixels) = photograph.decode() {
        assert_eq!(pixels.samples.len(), 3 * pixels.width * pixels.height);
    }
}

fn read_material(path: &Path) {
    if let Ok(material) = Material::load(path) {
        assert_eq!(material.evaluate_row(0).len(), material.header.row_len());
    }
}

/// The mutant is a file of the matrix around it.
fn read_matrix(path: &Path) {
    let store = path.ancestors().find(|a| a.extension().is_some_and(|e| e == "zarr")).unwrap();
    if let Ok(reader) = MatrixReader::open(store) {
        reader.blocks().into_iter().for_each(|rows| drop(reader.read(rows)));
    }
}

/// A seed: the file that is mutated, in a place where its reader finds it, and its bytes.
struct Seed {
    place: PathBuf,
    bytes: Vec<u8>,
}

/// The seeds of every reader: of small captures, of what is made of them, and of the corpus. The folder holds them.
fn seeds() -> (tempfile::TempDir, Vec<(&'static Reader, Vec<Seed>)>) {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    for (name, format) in [
        ("png", FileFormat::Png),
        ("tiff", FileFormat::Tiff),
        ("deflate", FileFormat::TiffDeflate),
        ("jpeg", FileFormat::Jpeg),
    ] {
        let options = SimulateOptions { grid: [3, 3], window: [5, 5], exposures: 1, format, ..common::bench() };
        acquire::simulate::simulate(&options, &at(name), &acquire::progress::Progress::silent()).unwrap();
    }
    let path = |name: &str| at(name).to_str().unwrap().to_owned();
    let run = |line: &[&str]| assert_eq!(common::acquire(line).0, 0, "{line:?}");
    run(&["factor", &path("png/truth.rd.zarr"), "--terms", "1", "--out", &path("m.safetensors")]);
    run(&["factor", &path("png/truth.rd.zarr"), "--terms", "1", "--out", &path("m.acq")]);
    run(&["relight", &path("m.acq"), "--light", "spot", "--out", &path("light.exr")]);
    run(&["export", &path("m.acq"), "--to", "npz", "--out", &path("voxels.npz")]);
    let rig = path("png/calibration");
    run(&[
        "patterns",
        "--rig",
        &rig,
        "--slab-mm",
        "10",
        "--projector-px-per-mm",
        "8",
        "--grid",
        "1",
        "--out",
        &path("plan"),
    ]);
    let first = |capture: &str| {
        let mut all: Vec<_> =
            std::fs::read_dir(at(capture).join("photos")).unwrap().map(|e| e.unwrap().path()).collect();
        all.sort();
        all.swap_remove(0)
    };
    let store = at("png/truth.rd.zarr");
    // Without its checksums: they would refuse all mutants before anything else looks at them.
    let root = store.join("zarr.json");
    let mut group: serde_json::Value = serde_json::from_slice(&std::fs::read(&root).unwrap()).unwrap();
    group["attributes"].as_object_mut().unwrap().remove("checksum").unwrap();
    std::fs::write(&root, group.to_string()).unwrap();
    let all = READERS.iter().map(|reader| {
        let mut places: Vec<PathBuf> = match reader.name {
            "photograph" => ["png", "tiff", "deflate", "jpeg"].map(first).into(),
            "light" => vec![at("light.exr"), at("light.png"), first("jpeg")],
            "material" => vec![at("m.safetensors"), at("m.acq")],
            "manifest" => vec![at("png/capture.toml")],
            "rig" => vec![at("png/calibration/rig.toml")],
            "plan" => vec![at("plan/plan.toml")],
            "voxels" => vec![at("voxels.npz")],
            _ => [
                "zarr.json",
                "response/zarr.json",
                "valid/zarr.json",
                "x_i_mm/zarr.json",
                "x_i_mm/c/0/0",
                "valid/c.0.0.0.0.0",
            ]
            .map(|name| store.join(name))
            .into(),
        };
        let mut seeds: Vec<Seed> =
            places.drain(..).map(|place| Seed { bytes: std::fs::read(&place).unwrap(), place }).collect();
        for file in corpus(reader.name) {
            let name = file.file_name().unwrap();
            let place = if reader.name == "matrix" {
                store.join("response/zarr.json")
            } else {
                at("corpus").join(reader.name).join(name)
            };
            std::fs::create_dir_all(place.parent().unwrap()).unwrap();
            seeds.push(Seed { bytes: std::fs::read(&file).unwrap(), place });
        }
        (reader, seeds)
    });
    let all = all.collect();
    (folder, all)
}

fn corpus(reader: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/corpus").join(reader);
    let mut files: Vec<_> = std::fs::read_dir(folder).into_iter().flatten().map(|e| e.unwrap().path()).collect();
    files.sort();
    files
}

/// Reads `bytes` in the place of a seed.
fn read(reader: &Reader, place: &Path, bytes: &[u8]) {
    std::fs::write(place, bytes).unwrap();
    let outcome = std::panic::catch_unwind(|| (reader.read)(place));
    if outcome.is_err() {
        panic!("a panic in the reader of a {}: the file is {}", reader.name, place.display());
    }
}

fn mutated(seed: &[u8], other: &[u8], rng: &mut impl Rng) -> Vec<u8> {
    let mut bytes = seed.to_vec();
    for _ in 0..rng.random_range(1..5) {
        let len = bytes.len();
        if len == 0 {
            break;
        }
        // Heads are where sizes stand.
        let at = if rng.random() { rng.random_range(0..len) } else { rng.random_range(0..len.min(512)) };
        let end = (at + 1 + rng.random_range(0..64)).min(len);
        match rng.random_range(0..9) {
            0 => bytes[at] ^= 1 << rng.random_range(0..8),
            1 => bytes[at] = rng.random(),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let stretch = bytes[at..end].to_vec();
                bytes.splice(at..at, stretch);
            }
            4 => bytes[at..end].fill(0),
            5 => bytes.truncate(at),
            6 => {
                let from = rng.random_range(0..other.len().max(1)).min(other.len());
                let stretch = &other[from..(from + end - at).min(other.len())];
                bytes[at..at + stretch.len()].copy_from_slice(stretch);
            }
            7 => {
                let extreme =
                    [0, 1, u64::MAX, i64::MAX as u64, 1 << 31, 1 << 32, u64::from(u32::MAX)][rng.random_range(0..7)];
                let size = [1, 2, 4, 8][rng.random_range(0..4)];
                let number = if rng.random() {
                    extreme.to_le_bytes()
                } else {
                    extreme.rotate_left(0).swap_bytes().to_le_bytes()
                };
                let number = &number[..size.min(len - at)];
                bytes[at..at + number.len()].copy_from_slice(number);
            }
            // Of texts: digits and signs.
            _ => bytes[at] = b"0123456789-+.eE,[]{}\"= "[rng.random_range(0..23)],
        }
    }
    bytes
}

#[test]
fn every_file_of_the_corpus_is_read_or_refused() {
    let (_folder, all) = seeds();
    for (reader, seeds) in &all {
        for seed in seeds {
            let start = Instant::now();
            read(reader, &seed.place, &seed.bytes);
            // One second on an idle machine; tests run beside each other.
            assert!(start.elapsed() < Duration::from_secs(10), "{}: {:?}", reader.name, start.elapsed());
        }
    }
}

#[test]
#[ignore = "slow: a quarter of a minute"]
fn mutated_files_end_no_reader() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default);
    let (secs, seed) = (number("FUZZ_SECS", 2), number("FUZZ_SEED", 1));
    let found = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/found");
    let (_folder, all) = seeds();
    for (reader, seeds) in &all {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let (start, mut count) = (Instant::now(), 0u64);
        while start.elapsed() < Duration::from_secs(secs) {
            let [own, other] = [0, 1].map(|_| &seeds[rng.random_range(0..seeds.len())]);
            let bytes = mutated(&own.bytes, &other.bytes, &mut rng);
            // Kept until it was read: an abort leaves it.
            let kept = found.join(format!(
                "{}-{seed}-{count}-{}",
                reader.name,
                own.place.file_name().unwrap().to_string_lossy()
            ));
            std::fs::create_dir_all(&found).unwrap();
            std::fs::write(&kept, &bytes).unwrap();
            read(reader, &own.place, &bytes);
            std::fs::remove_file(&kept).unwrap();
            std::fs::write(&own.place, &own.bytes).unwrap();
            count += 1;
        }
        println!("{}: {count} mutants in {:.0} s", reader.name, start.elapsed().as_secs_f64());
    }
    let _ = std::fs::remove_dir(&found);
}
