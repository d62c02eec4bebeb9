//! Many processes that share a factorization: `acquire factor --tasks` and `acquire factor-part`.

use crate::common;
use crate::matrices::{noise, profile, write};
use acquire::material::Material;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// A matrix of 8 × 6 lit points, in a folder in which commands run.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let response = |i: usize, d: [f64; 2], c: usize| {
            let grain = 1.0 + 0.4 * noise(i, d, c) * profile(d, 1.5);
            (profile(d, 2.0 + 0.3 * ((i % 5) as f64 + c as f64)) * grain * (1.0 + 0.2 * c as f64)) as f32
        };
        write(&folder.path().join("m.rd.zarr"), [8, 6], [11, 9], |_, _| 1e-10, 0.0, response).unwrap();
        std::fs::create_dir(folder.path().join("passes")).unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn command(&self, line: &str) -> Command {
        common::command_in(self.0.path(), line)
    }

    /// (exit status, stdout, stderr)
    fn run(&self, line: &str) -> (i32, String, String) {
        common::outcome(&mut self.command(line))
    }

    /// As a shell's loop does: `tasks` gets the parts that are to be done, until there are none.
    fn factored(&self, line: &str, mut tasks: impl FnMut(&[&str])) -> usize {
        for passes in 0..60 {
            let (status, stdout, stderr) = self.run(line);
            assert_eq!(status, 0, "{stderr}");
            let parts: Vec<&str> = stdout.lines().collect();
            if parts.is_empty() {
                return passes;
            }
            assert!(stderr.contains(" of 3 to be done"), "{stderr}");
            tasks(&parts);
        }
        panic!("no end of passes");
    }
}

fn differ(a: &Path, b: &Path) -> f32 {
    let (a, b) = (Material::load(a).unwrap(), Material::load(b).unwrap());
    let rows = |m: &Material| (0..48).flat_map(|i| m.evaluate_row(i)).collect::<Vec<f32>>();
    let (a, b) = (rows(&a), rows(&b));
    let largest = b.iter().fold(0.0_f32, |most, v| most.max(v.abs()));
    a.iter().zip(&b).fold(0.0_f32, |most, (a, b)| most.max((a - b).abs())) / largest
}

#[test]
fn a_material_is_made_by_commands_in_any_order_and_by_killed_ones_too() {
    let bench = Bench::new();
    let line = |out: &str, folder: &str| {
        format!(
            "factor m.rd.zarr --terms 4 --degree 3 --backend gram --tasks {folder} --parts 3 --out {out}.safetensors"
        )
    };
    let task = |part: &str| format!("--threads 1 factor-part passes --part {part}");
    let passes = bench.factored(&line("a", "passes"), |parts| {
        // All at once, the last one first; one of them is killed.
        let mut killed = bench.command(&task(parts[0])).stderr(Stdio::null()).spawn().unwrap();
        drop(killed.kill());
        let start = |part: &&str| bench.command(&task(part)).stderr(Stdio::null()).spawn().unwrap();
        let running: Vec<_> = parts.iter().rev().map(start).collect();
        running.into_iter().for_each(|mut task| assert!(task.wait().unwrap().success()));
        killed.wait().unwrap();
        let (status, stdout, stderr) = bench.run(&format!("{} --json", task(parts[0])));
        assert!(status == 0 && stderr.contains("was there already"), "{stderr}");
        assert_eq!(serde_json::from_str::<serde_json::Value>(&stdout).unwrap()["was_there"], true);
    });
    assert!((4..10).contains(&passes), "survey, AᵀA, left vectors, colour; more with gaps: {passes}");
    std::fs::create_dir(bench.path("other")).unwrap();
    bench.factored(&line("b", "other"), |parts| {
        // One by one; part 2 is forgotten a first time.
        for part in parts.iter().filter(|part| **part != "2/3" || parts.len() == 1) {
            assert_eq!(bench.run(&format!("factor-part other --part {part}")).0, 0);
        }
    });
    let bytes = |name: &str| std::fs::read(bench.path(name)).unwrap();
    assert!(bytes("a.safetensors") == bytes("b.safetensors"), "bit by bit, but for nothing");
    let alone = "factor m.rd.zarr --terms 4 --degree 3 --backend gram --out alone.safetensors";
    assert_eq!(bench.run(alone).0, 0);
    // Sums in f64 in another order; what is stored is f32.
    let off = differ(&bench.path("a.safetensors"), &bench.path("alone.safetensors"));
    assert!(off < 1e-6, "{off:e}");
}

#[test]
fn a_pass_of_another_matrix_or_without_one_is_refused() {
    let bench = Bench::new();
    let (status, _, stderr) = bench.run("factor-part passes --part 1/3");
    assert!(status == 1 && stderr.contains("next.pass"), "{stderr}");
    let line = "factor m.rd.zarr --terms 2 --tasks passes --parts 3 --out m.safetensors";
    assert_eq!(bench.run(line).1, "1/3\n2/3\n3/3\n");
    let (status, _, stderr) = bench.run("factor-part passes --part 1/4");
    assert!(status == 1 && stderr.contains("part: expected K/3"), "{stderr}");
    std::fs::remove_dir_all(bench.path("m.rd.zarr")).unwrap();
    write(&bench.path("m.rd.zarr"), [8, 6], [11, 9], |_, _| 0.0, 0.0, |_, d, _| profile(d, 2.0) as f32).unwrap();
    let (status, _, stderr) = bench.run("factor-part passes --part 1/3");
    assert!(status == 1 && stderr.contains("another matrix"), "{stderr}");
    let (status, _, stderr) = bench.run("factor m.rd.zarr --terms 2 --tasks passes --parts 7 --out m.safetensors");
    assert!(status == 1 && stderr.contains("parts: expected 1 to 6"), "{stderr}");
    let (status, _, stderr) = bench.run("factor m.rd.zarr --terms 2 --tasks nowhere --out m.safetensors");
    assert!(status == 1 && stderr.contains("nowhere"), "{stderr}");
}
