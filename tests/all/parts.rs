//! Many processes that share a sweep: `acquire extract` and `acquire assemble` against `acquire build-matrix`.

use crate::common;
use crate::common::{acquire, files};
use acquire::simulate::SimulateOptions;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// A capture of 12 lattice shots, and the matrix that build-matrix makes of it; another capture beside it.
fn made() -> &'static Path {
    static MADE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let make = || {
        // Four dots a shot: their light overlaps and is taken out, which replaces rows.
        let spacing = Some([4, 3]);
        let options =
            SimulateOptions { grid: [8, 6], window: [9, 7], exposures: 2, seed: 4, spacing, ..common::bench() };
        let (folder, capture) = common::capture(&options);
        let whole = folder.path().join("whole.rd.zarr");
        let words = ["build-matrix", capture.to_str().unwrap(), "--out", whole.to_str().unwrap()];
        assert_eq!(acquire(&words).0, 0);
        let other = SimulateOptions { seed: 5, material: marble(), ..options };
        acquire::simulate::simulate(&other, &folder.path().join("other"), &acquire::progress::Progress::silent())
            .unwrap();
        folder
    };
    MADE.get_or_init(make).path()
}

fn marble() -> acquire::simulate::SlabMaterial {
    "marble".parse().unwrap()
}

/// A folder with the captures, in which commands run.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        // Links: times of the files stay.
        common::lay_folder(made(), folder.path(), &|file, target| std::fs::hard_link(file, target));
        std::fs::create_dir(folder.path().join("parts")).unwrap();
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

    /// What it says on stderr.
    fn done(&self, line: &str) -> String {
        let (status, _, stderr) = self.run(line);
        assert_eq!(status, 0, "{line}: {stderr}");
        stderr
    }

    /// The ranges that assemble finds missing.
    fn missing(&self) -> (serde_json::Value, String) {
        let (status, stdout, stderr) = self.run("assemble capture parts --out o.rd.zarr --json");
        assert!(status == 1 && stderr.contains("hint: ") && !self.path("o.rd.zarr").exists(), "{stderr}");
        (serde_json::from_str::<serde_json::Value>(&stdout).unwrap()["missing"].clone(), stderr)
    }

    /// Assembles, and compares all bytes with those of build-matrix.
    fn assembled(&self, options: &str) -> String {
        let stderr = self.done(&format!("assemble capture parts --out o.rd.zarr{options}"));
        assert!(files(&self.path("o.rd.zarr")) == files(&self.path("whole.rd.zarr")), "other bytes: {stderr}");
        std::fs::remove_dir_all(self.path("o.rd.zarr")).unwrap();
        stderr
    }
}

#[test]
fn parts_that_were_measured_at_once_make_the_matrix_of_one_run_bit_by_bit() {
    let bench = Bench::new();
    let line = |k: usize| format!("--threads 1 extract capture --part {k}/3 --out parts/{k}.part");
    let tasks: Vec<_> = [3, 1].map(|k| bench.command(&line(k)).stderr(Stdio::null()).spawn().unwrap()).into();
    tasks.into_iter().for_each(|mut task| assert!(task.wait().unwrap().success()));
    let (missing, said) = bench.missing();
    assert_eq!(missing, serde_json::json!([[4, 8]]));
    assert!(said.contains("the shots 4..8") && said.contains("--shots 4..8 --out"), "{said}");
    // The matrix is whole whoever measures the rest, and with more than what is needed.
    let said = bench.assembled(" --measure-missing");
    assert!(said.contains("8 of 12 lattice shots were in parts"), "{said}");
    bench.done("extract capture --shots 2..9 --out parts/more.part");
    let said = bench.assembled("");
    assert!(said.contains("12 of 12 lattice shots were in parts"), "{said}");
    assert!(bench.done(&line(2)).contains("wrote parts/2.part: shots 4..8 of 12 from 8 photographs"));
    // Once more: there is nothing to do.
    let before = std::fs::metadata(bench.path("parts/2.part")).unwrap().modified().unwrap();
    assert!(bench.done(&line(2)).contains("was there already"));
    assert_eq!(std::fs::metadata(bench.path("parts/2.part")).unwrap().modified().unwrap(), before);
    assert_eq!(std::fs::read_dir(bench.path("parts")).unwrap().count(), 4, "nothing but the parts");
    bench.assembled("");
}

#[test]
fn parts_of_others_and_damaged_ones_are_named_and_do_no_harm() {
    let bench = Bench::new();
    bench.done("extract capture --part 1/2 --out parts/1.part");
    bench.done("extract capture --part 2/2 --out parts/2.part");
    let whole = std::fs::read(bench.path("parts/2.part")).unwrap();
    let text = whole.len() - 16 - u64::from_le_bytes(whole[whole.len() - 16..][..8].try_into().unwrap()) as usize;
    let lines: Vec<usize> = (text..whole.len()).filter(|&k| whole[k] == b'\n').collect();
    let flipped = |at: usize| {
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        bytes
    };
    for (bytes, why, missing) in [
        // A row of the second shot of six, the line of the last one, the first line, the end.
        (flipped(16 + (text - 16) / 4), "rows of it are damaged", [7, 8]),
        (flipped(lines[6] - 100), "1 of its shots are damaged", [11, 12]),
        (flipped(lines[0] - 1), "2.part (it is damaged)", [6, 12]),
        (whole[..whole.len() - 1].to_vec(), "2.part (it is cut short)", [6, 12]),
        (whole[..9].to_vec(), "2.part (it is no part)", [6, 12]),
    ] {
        std::fs::write(bench.path("parts/2.part"), &bytes).unwrap();
        let (found, said) = bench.missing();
        assert_eq!(found, serde_json::json!([missing]), "{said}");
        assert!(said.contains(why), "{why}: {said}");
    }
    // Measured again in its place, which is not done to a file that only has its name.
    let (status, _, said) = bench.run("extract capture --part 2/2 --out parts/2.part");
    assert!(status == 1 && said.contains("not an output of this program"), "{said}");
    std::fs::write(bench.path("parts/2.part"), flipped(16 + (text - 16) / 4)).unwrap();
    bench.done("extract capture --part 2/2 --out parts/2.part");
    assert!(std::fs::read(bench.path("parts/2.part")).unwrap() == whole);

    bench.done("extract other --part 1/2 --out parts/other.part");
    bench.done("extract capture --exposure-from estimate --part 1/2 --out parts/options.part");
    std::fs::write(bench.path("parts/notes.part"), "somebody's notes, which are no part").unwrap();
    std::fs::write(bench.path("parts/.3.part.AbCdEf.unfinished"), "acquire part 1\n\0").unwrap();
    let said = bench.assembled("");
    for words in [
        "other.part (it is of the capture \"simulated marble\")",
        "options.part (its photographs, rig or options are others)",
        "notes.part (it is no part)",
        "1 unfinished (of tasks that still run, or were killed)",
    ] {
        assert!(said.contains(words), "{words}: {said}");
    }
}

#[test]
fn a_photograph_that_changed_after_its_part_was_measured_is_measured_again_and_one_that_was_copied_is_not() {
    let bench = Bench::new();
    bench.done("extract capture --part 1/1 --out parts/1.part");
    let photograph = bench.path("capture/photos/lattice-0005_1.png");
    let bytes = std::fs::read(&photograph).unwrap();
    // The same under another time, as a copy has it.
    std::fs::remove_file(&photograph).unwrap();
    std::fs::write(&photograph, &bytes).unwrap();
    bench.assembled("");
    std::fs::remove_file(&photograph).unwrap();
    std::fs::copy(bench.path("capture/photos/lattice-0006_1.png"), &photograph).unwrap();
    // It may be one of those that all shots are measured against: then nothing that was measured counts, and what the
    // photograph contradicts is told first.
    let (missing, said) = bench.missing();
    let missing: Vec<[usize; 2]> = serde_json::from_value(missing).unwrap();
    let is_named = said.contains("lattice-0005_1.png");
    assert!(is_named || missing.iter().any(|[start, end]| (*start..*end).contains(&5)), "{missing:?} {said}");
    // A part that is there is not taken for one of these photographs.
    let (_, _, said) = bench.run("extract capture --part 1/1 --out parts/1.part");
    assert!(!said.contains("was there already"), "{said}");
}

#[test]
fn a_part_is_the_same_whether_its_task_has_found_or_read_what_shots_have_in_common() {
    let bench = Bench::new();
    bench.done("prepare capture --out parts/slab.prepared");
    for (from, part) in [("capture", "found"), ("parts/slab.prepared", "read")] {
        bench.done(&format!("extract {from} --part 2/3 --out {part}.part"));
    }
    assert!(std::fs::read(bench.path("found.part")).unwrap() == std::fs::read(bench.path("read.part")).unwrap());
    // A task in another folder.
    let mut command = bench.command("extract slab.prepared --shots 0..4 --out 1.part");
    assert!(command.current_dir(bench.path("parts")).output().unwrap().status.success());
    bench.done("extract parts/slab.prepared --memory 4GiB --part 2/2 --out parts/2.part");
    bench.done("extract parts/slab.prepared --shots 4..6 --out parts/3.part");
    bench.assembled("");

    let refused = |line: &str, words: &str| {
        let (status, _, said) = bench.run(line);
        assert!(status == 1 && said.contains(words) && said.contains("hint: "), "{line}: {said}");
    };
    let again = "extract parts/slab.prepared --part 1/1 --out again.part";
    refused(&format!("{again} --resolution full"), "--resolution: expected none, as `acquire prepare` was told it");
    let (file, manifest) = (bench.path("parts/slab.prepared"), bench.path("capture/capture.toml"));
    for (path, at) in [(&file, 5000), (&file, 3)] {
        let whole = std::fs::read(path).unwrap();
        let mut bytes = whole.clone();
        bytes[at] ^= 1;
        std::fs::write(path, bytes).unwrap();
        refused(again, if at == 3 { "found something else" } else { "found a damaged one" });
        std::fs::write(path, whole).unwrap();
    }
    let text = std::fs::read_to_string(&manifest).unwrap() + "\n# a remark\n";
    std::fs::remove_file(&manifest).unwrap();
    std::fs::write(&manifest, text).unwrap();
    refused(again, "as they were when it was written, found others");
    bench.done("prepare capture --out parts/slab.prepared");
    bench.done(again);
}

#[cfg(unix)]
#[test]
fn a_killed_task_leaves_no_part_and_one_that_is_told_to_end_leaves_nothing() {
    let bench = Bench::new();
    let part = || bench.command("extract capture --part 1/1 --out parts/1.part").stderr(Stdio::null()).spawn().unwrap();
    let left = || std::fs::read_dir(bench.path("parts")).unwrap().map(|e| e.unwrap().file_name()).collect::<Vec<_>>();
    for signal in ["TERM", "KILL"] {
        let mut task = part();
        while left().is_empty() {
            assert!(task.try_wait().unwrap().is_none(), "it ended before it was killed");
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        assert!(Command::new("kill").args([&format!("-{signal}"), &task.id().to_string()]).status().unwrap().success());
        assert!(!task.wait().unwrap().success());
        match signal {
            "TERM" => assert!(left().is_empty(), "{:?}", left()),
            _ => assert!(left().len() == 1 && left()[0].to_string_lossy().ends_with(".unfinished"), "{:?}", left()),
        }
    }
    let (missing, said) = bench.missing();
    assert_eq!(missing, serde_json::json!([[0, 12]]));
    assert!(said.contains("1 unfinished"), "{said}");
    assert!(part().wait().unwrap().success());
    bench.assembled("");
}

#[test]
fn ranges_that_the_sweep_has_not_are_refused_before_any_work() {
    let bench = Bench::new();
    for (line, words) in [
        ("--shots 3..3 --out parts/1.part", "--shots: expected A..B with A before B, B up to 12"),
        ("--shots 10..13 --out parts/1.part", "found 10..13"),
        ("--part 4/3 --out parts/1.part", "--part: expected K/N with K from 1 to N"),
        ("--part 1/13 --out parts/1.part", "N up to 12, the number of lattice shots"),
        ("--part three --out parts/1.part", "expected K/N, 3/64 say"),
        ("--out parts/1.part", "--part <K/N>|--shots <A..B>"),
        ("--part 1/2 --shots 0..3 --out parts/1.part", "cannot be used with"),
        ("--part 1/2 --out parts/1.txt", "a name that ends in .part"),
        ("--part 1/2 --out nowhere/1.part", "nowhere/1.part"),
        ("--part 1/2 --out capture/1.prepared", "a name that ends in .part"),
        ("--part 1/2 --out capture/photos/lattice-0001_0.png", "apart from the inputs"),
    ] {
        let (status, _, stderr) = bench.run(&format!("extract capture {line}"));
        assert!(status == 1 && stderr.contains(words), "{line}: {stderr}");
    }
    assert!(files(&bench.path("parts")).is_empty());
    let (status, _, stderr) = bench.run("assemble capture nowhere --out o.rd.zarr");
    assert!(status == 1 && stderr.contains("nowhere"), "{stderr}");
    let (status, _, stderr) = bench.run("assemble capture parts --out parts/o.rd.zarr");
    assert!(status == 1 && stderr.contains("apart from the inputs"), "{stderr}");
}
