//! Outputs: what is replaced and what is not, and what is there after a run that was stopped.

use crate::common;
use crate::common::{acquire, files};
use acquire::simulate::SimulateOptions;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::OnceLock;

/// A capture, its matrix and material, made once for all tests of this file.
fn made() -> &'static Path {
    static MADE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let make = || {
        let options = SimulateOptions { grid: [4, 3], window: [7, 5], exposures: 2, ..common::bench() };
        let (folder, capture) = common::capture(&options);
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        let (capture, matrix) = (capture.to_str().unwrap().to_owned(), path("m.rd.zarr"));
        assert_eq!(acquire(&["build-matrix", &capture, "--out", &matrix]).0, 0);
        assert_eq!(acquire(&["factor", &matrix, "--out", &path("m.safetensors"), "--terms", "2"]).0, 0);
        let dir = folder.path().to_path_buf();
        (folder, dir)
    };
    &MADE.get_or_init(make).1
}

/// A folder with copies of them, in which commands work.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        common::copy_folder(made(), folder.path());
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn run(&self, line: &str) -> (i32, String) {
        let (status, _, stderr) = common::outcome(&mut common::command_in(self.0.path(), line));
        (status, stderr)
    }

    fn done(&self, line: &str) {
        let (status, stderr) = self.run(line);
        assert_eq!(status, 0, "{line}: {stderr}");
    }

    /// The command is refused with all of `words` and changes nothing.
    fn refused(&self, line: &str, words: &[&str]) {
        let before = files(self.0.path());
        let (status, stderr) = self.run(line);
        assert!(status == 1 && stderr.contains("hint: "), "{line}: {stderr}");
        for word in words {
            assert!(stderr.contains(word), "{line}: \"{word}\" is not in: {stderr}");
        }
        assert!(before == files(self.0.path()), "{line} changed something");
    }
}

/// Commands and their outputs, a file or a folder.
const COMMANDS: [(&str, &str); 10] = [
    ("build-matrix capture --out o.rd.zarr", "o.rd.zarr"),
    ("import-matrix m.rd.zarr --out o.rd.zarr", "o.rd.zarr"),
    ("factor m.rd.zarr --terms 1 --out o.safetensors", "o.safetensors"),
    ("factor m.rd.zarr --terms 1 --out o.acq", "o.acq"),
    ("export m.safetensors --to npz --out o.npz", "o.npz"),
    ("export m.safetensors --to exr --out o.exr", "o.exr"),
    ("relight m.safetensors --light spot --out o.exr", "o.exr"),
    ("relight m.safetensors --light spot --out o.exr", "o.png"),
    ("simulate o --grid 1 --window 3 --exposures 1 --voxels-per-sample 1", "o"),
    ("patterns --rig capture/calibration --slab-mm 10 --projector-px-per-mm 8 --grid 2 --window 5 --out o", "o"),
];

#[test]
fn nothing_is_replaced_unasked_and_then_only_what_this_program_has_made() {
    for (command, out) in COMMANDS {
        let bench = Bench::new();
        bench.done(command);
        bench.refused(command, &["--force"]);
        bench.done(&format!("{command} --force"));
        let out = bench.path(out);
        // A file or folder of somebody's under that name.
        match out.is_dir() {
            true => std::fs::remove_dir_all(&out).unwrap(),
            false => std::fs::remove_file(&out).unwrap(),
        }
        std::fs::write(&out, "years of work").unwrap();
        bench.refused(&format!("{command} --force"), &[out.file_name().unwrap().to_str().unwrap()]);
        std::fs::remove_file(&out).unwrap();
        std::fs::create_dir(&out).unwrap();
        std::fs::write(out.join("zarr.json"), "{\"zarr_format\": 3}").unwrap();
        std::fs::write(out.join("notes.txt"), "years of work").unwrap();
        bench.refused(&format!("{command} --force"), &[out.file_name().unwrap().to_str().unwrap()]);
    }
}

#[test]
fn what_somebody_has_added_to_an_output_or_changed_in_it_stays() {
    for (command, out) in COMMANDS {
        let bench = Bench::new();
        bench.done(command);
        let out = bench.path(out);
        let force = format!("{command} --force");
        if out.is_file() {
            let mut bytes = std::fs::read(&out).unwrap();
            let middle = bytes.len() / 2;
            bytes[middle] ^= 1;
            std::fs::write(&out, bytes).unwrap();
            bench.refused(&force, &["not replaced"]);
            continue;
        }
        let notes = out.join("notes.txt");
        std::fs::write(&notes, "years of work").unwrap();
        bench.refused(&force, &["notes.txt", "not replaced"]);
        std::fs::remove_file(&notes).unwrap();
        let text =
            ["zarr.json", "capture.toml", "plan.toml"].map(|name| out.join(name)).into_iter().find(|p| p.is_file());
        let text = text.unwrap();
        let words = std::fs::read_to_string(&text).unwrap();
        let from = if text.ends_with("zarr.json") { "\"pitch_mm\": " } else { "name = \"" };
        let changed = words.replacen(from, &format!("{from}1"), 1);
        assert_ne!(changed, words);
        std::fs::write(&text, changed).unwrap();
        bench.refused(&force, &["not replaced", "changed"]);
        std::fs::write(&text, words).unwrap();
        bench.done(&force);
    }
}

#[test]
fn an_output_in_an_input_or_around_one_is_refused() {
    let bench = Bench::new();
    let dcim = bench.path("lab/DCIM");
    std::fs::create_dir_all(&dcim).unwrap();
    std::fs::write(dcim.join("IMG_0001.JPG"), "a photograph").unwrap();
    std::fs::write(bench.path("light.png"), "a light").unwrap();
    bench
        .done("patterns --rig capture/calibration --slab-mm 10 --projector-px-per-mm 8 --grid 2 --window 5 --out plan");
    for line in [
        "import lab/DCIM --plan plan --out lab --force",
        "import lab/DCIM --plan plan --out lab/DCIM --force",
        "import lab/DCIM --plan plan --out lab/DCIM/sorted",
        "import lab/DCIM --plan plan --out plan --force",
        "import lab/DCIM --plan plan --out plan/capture",
        "build-matrix capture --out capture/truth.rd.zarr --force",
        "build-matrix capture --out capture --force",
        "build-matrix capture --calibration capture/../capture/calibration --out capture/calibration --force",
        "run capture --out . --force",
        "run capture --out capture --force",
        "tradeoff m.rd.zarr --out m.rd.zarr --force",
        "tradeoff m.rd.zarr --out . --force",
        "factor m.rd.zarr --out m.rd.zarr/m.acq",
        "import-matrix m.rd.zarr --out m.rd.zarr --force",
        "import-matrix m.rd.zarr --out m.rd.zarr/o.rd.zarr",
        "import-matrix m.rd.zarr --out . --force",
        "relight m.safetensors --light light.png --out light.exr",
        "patterns --rig capture/calibration --slab-mm 10 --projector-px-per-mm 8 --out capture --force",
    ] {
        bench.refused(line, &["--out", "the input"]);
    }
    bench.refused("simulate . --voxels m.rd.zarr", &["DIR", "the input"]);
    // Beside them in the capture's folder nothing of theirs is in the way.
    bench.done("build-matrix capture --out capture/matrix.rd.zarr");
}

#[test]
fn only_captures_and_matrices_lie_in_object_stores_and_none_without_the_feature() {
    let bench = Bench::new();
    for line in [
        "run capture --out s3://lab/results",
        "simulate gs://lab/capture --grid 3x2 --window 5x3 --exposures 2",
        "patterns --rig capture/calibration --slab-mm 20x15 --projector-px-per-mm 5 --grid 3x2 --window 5 --out s3://lab/p",
        "factor m.rd.zarr --out s3://lab/m.safetensors",
        "factor m.rd.zarr --out m2.safetensors --tasks s3://lab/tasks",
        "tradeoff m.rd.zarr --out s3://lab/trade",
        "relight m.safetensors --light uniform --out https://lab/r.exr",
        "export m.safetensors --to exr --out gs://lab/m.exr",
        "prepare capture --out s3://lab/c.prepared",
        "relight m.safetensors --light s3://lab/x.exr --out x.exr",
        "export s3://lab/x.safetensors --to npz --out x.npz",
        "clean s3://lab",
    ] {
        bench.refused(line, &["only captures and matrices"]);
    }
    if cfg!(feature = "cloud") {
        return;
    }
    for line in [
        "factor s3://lab/x.rd.zarr --out x.safetensors",
        "evaluate m.safetensors gs://lab/x.rd.zarr",
        "evaluate https://lab/x.rd.zarr m.rd.zarr",
        "tradeoff s3://lab/x.rd.zarr --out trade",
        "relight s3://lab/x.rd.zarr --light uniform --out r.exr",
        "build-matrix capture --out s3://lab/x.rd.zarr",
        "import-matrix s3://lab/x.npz --out gs://lab/x.rd.zarr",
        "build-matrix s3://lab/capture",
        "check gs://lab/capture",
        "prepare s3://lab/capture --out c.prepared",
        "extract s3://lab/capture --part 1/2 --out 1.part",
        "run https://lab/capture --out results",
        "build-matrix capture --calibration s3://lab/rig",
    ] {
        bench.refused(line, &["feature `cloud`", "--features cloud"]);
    }
}

#[test]
fn a_name_that_ends_as_another_format_does_is_refused() {
    let bench = Bench::new();
    for line in [
        "build-matrix capture --out m.safetensors",
        "factor m.rd.zarr --out o.exr",
        "factor m.rd.zarr --precision f32 --out o.acq",
        "export m.safetensors --to exr --out o.npz",
        "relight m.safetensors --light spot --out o.png",
        "run capture --out o.rd.zarr",
        "tradeoff m.rd.zarr --out o.html",
    ] {
        bench.refused(line, &["--out", "name"]);
    }
    bench.refused("simulate o.toml", &["DIR", "name"]);
}

/// A simulation of some minutes, which is stopped before.
fn long_run(folder: &Path, wrapper: &[&str]) -> std::process::Child {
    let simulate = [env!("CARGO_BIN_EXE_acquire"), "simulate", "big", "--grid", "32", "--window", "31", "--quiet"];
    let line = [wrapper, &simulate[..]].concat();
    let mut child = Command::new(line[0])
        .args(&line[1..])
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    while std::fs::read_dir(folder).unwrap().count() == 0 {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it was stopped");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    child
}

fn kill(signal: &str, child: &std::process::Child) {
    assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
}

#[cfg(unix)]
#[test]
fn signals_leave_nothing() {
    use std::os::unix::process::ExitStatusExt;
    // What is ignored here stays so in the program: SIGINT where a script has started the tests with `&`.
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let ignored = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigIgn:")?.trim(), 16).ok());
    for (signal, number) in [("-INT", 2), ("-TERM", 15), ("-HUP", 1)] {
        if ignored.unwrap_or(0) >> (number - 1) & 1 == 1 {
            println!("skipped: {signal} is ignored by what has started this test");
            continue;
        }
        let folder = tempfile::tempdir().unwrap();
        let child = long_run(folder.path(), &[]);
        kill(signal, &child);
        let output = child.wait_with_output().unwrap();
        assert_eq!(output.status.signal(), Some(number), "the shell is to see that it was interrupted");
        assert_eq!(String::from_utf8_lossy(&output.stderr), "");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "{signal}");
    }
}

#[cfg(target_os = "linux")]
#[test]
fn a_run_that_was_told_to_ignore_the_terminal_s_end_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = long_run(folder.path(), &["nohup"]);
    kill("-HUP", &child);
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert!(child.try_wait().unwrap().is_none(), "nohup is heeded");
    kill("-TERM", &child);
    child.wait().unwrap();
}

#[cfg(unix)]
#[test]
fn what_a_killed_run_leaves_is_removed_by_the_next_or_by_clean_and_a_living_run_s_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let left = || -> Vec<String> {
        let names = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        names.filter(|n| n.starts_with(".acquire-")).collect()
    };
    let mut dead = long_run(folder.path(), &[]);
    dead.kill().unwrap();
    dead.wait().unwrap();
    let first = left();
    assert_eq!(first.len(), 1);
    let dir = folder.path().to_str().unwrap();
    let other = folder.path().join("other");
    let next = ["simulate", other.to_str().unwrap(), "--grid", "1", "--window", "3", "--exposures", "1"];
    let (status, _, stderr) = acquire(&next);
    assert!(status == 0 && stderr.contains(&format!("note: removed {dir}/{}", first[0])), "{stderr}");
    assert_eq!(left(), [""; 0]);

    let mut alive = Command::new(env!("CARGO_BIN_EXE_acquire"))
        .args(["simulate", "big", "--grid", "32", "--window", "31", "--quiet"])
        .current_dir(folder.path())
        .spawn()
        .unwrap();
    while left().is_empty() {
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let (status, stdout, _) = acquire(&["clean", dir]);
    assert_eq!((status, stdout.as_str(), left().len()), (0, "", 1), "it still works");
    alive.kill().unwrap();
    alive.wait().unwrap();
    let killed = left();
    let (status, stdout, _) = acquire(&["clean", dir]);
    assert_eq!((status, stdout), (0, format!("{dir}/{}\n", killed[0])));
    assert_eq!(left(), [""; 0]);
}

#[test]
fn hints_say_what_the_input_is_and_what_takes_it() {
    let bench = Bench::new();
    bench
        .done("patterns --rig capture/calibration --slab-mm 10 --projector-px-per-mm 8 --grid 2 --window 5 --out plan");
    for (line, words) in [
        ("factor capture --out o.acq", ["capture is a capture", "acquire build-matrix capture"]),
        ("factor m.safetensors --out o.acq", ["m.safetensors is a material", "acquire export"]),
        ("evaluate m.rd.zarr m.safetensors", ["m.safetensors is a material", "acquire evaluate m.safetensors MATRIX"]),
        ("relight capture --light spot --out o.exr", ["capture is a capture", "build-matrix"]),
        ("export m.rd.zarr --to npz --out o.npz", ["m.rd.zarr is a matrix", "acquire factor m.rd.zarr"]),
        ("build-matrix m.rd.zarr --out o.rd.zarr", ["m.rd.zarr is a matrix", "acquire factor"]),
        ("build-matrix plan --out o.rd.zarr", ["plan is a plan", "acquire import FOLDER --plan plan"]),
        ("check capture/photos", ["capture/photos holds photographs", "acquire import"]),
        ("check capture/calibration", ["is the folder of a rig", "--calibration"]),
        ("import plan/pictures --plan capture/photos --out o", ["capture/photos holds photographs", "acquire import"]),
        (
            "patterns --rig capture --slab-mm 10 --projector-px-per-mm 8 --out o",
            ["rig.toml in capture/calibration", "--rig"],
        ),
        ("check capture --calibration capture", ["rig.toml in capture/calibration", "--calibration"]),
    ] {
        bench.refused(line, &words);
    }
}

#[test]
fn the_file_that_makes_a_folder_is_taken_for_it() {
    let bench = Bench::new();
    bench.done("check capture/capture.toml --calibration capture/calibration/rig.toml");
    bench.done("evaluate m.safetensors m.rd.zarr/zarr.json");
    bench.done("factor m.rd.zarr/zarr.json --terms 1 --out o.acq");
}

#[cfg(unix)]
#[test]
fn pipes_and_devices_are_refused_and_names_cannot_move_the_terminal() {
    let bench = Bench::new();
    let pipe = bench.path("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for path in ["pipe", "/dev/zero"] {
        for line in [
            format!("relight m.safetensors --light {path} --out o.exr"),
            format!("export {path} --to npz --out o.npz"),
            format!("import-matrix {path} --pitch-mm 1 --out o.rd.zarr"),
            format!("evaluate {path} m.rd.zarr"),
            format!("evaluate m.safetensors {path}"),
            format!("simulate o --voxels {path}"),
        ] {
            let (status, stderr) = bench.run(&line);
            assert!(status == 1 && stderr.contains("hint: "), "{line}: {stderr}");
        }
    }
    for place in ["capture/capture.toml", "capture/calibration/rig.toml", "capture/photos/reference-white_0.png"] {
        let place = bench.path(place);
        let kept = std::fs::read(&place).unwrap();
        std::fs::remove_file(&place).unwrap();
        std::fs::hard_link(&pipe, &place).unwrap();
        let (status, stderr) = bench.run("build-matrix capture --out o.rd.zarr");
        assert!(status == 1 && stderr.contains("hint: "), "{stderr}");
        std::fs::remove_file(&place).unwrap();
        std::fs::write(&place, kept).unwrap();
    }
    let (status, stderr) = bench.run("check \u{1b}[2Jnowhere\u{7}");
    assert!(status == 1 && stderr.contains("\\u{1b}[2Jnowhere\\u{7}") && !stderr.contains('\u{1b}'), "{stderr:?}");
}

#[test]
fn a_photograph_that_changed_since_the_capture_was_made_is_named() {
    let bench = Bench::new();
    bench.done("simulate c --grid 4x3 --window 7x5 --exposures 2 --voxels-per-sample 1 --format tiff");
    bench.done("check c");
    let photograph = bench.path("c/photos/lattice-0001_1.tif");
    let mut bytes = std::fs::read(&photograph).unwrap();
    // The lowest bit of one code value in the dark: nothing else could see it.
    let middle = bytes.len() / 4;
    bytes[middle] ^= 1;
    std::fs::write(&photograph, &bytes).unwrap();
    let name = format!("photos/{}", photograph.file_name().unwrap().to_str().unwrap());
    for line in ["check c", "build-matrix c --out o.rd.zarr"] {
        bench.refused(line, &[&name, "is not as it was", "--accept photograph-changed"]);
    }
    bench.done("build-matrix c --out o.rd.zarr --accept photograph-changed");
    bytes[middle] ^= 1;
    std::fs::write(&photograph, &bytes).unwrap();
    bench.done("build-matrix c --out o2.rd.zarr");
}

#[cfg(unix)]
#[test]
fn a_run_that_fails_after_the_matrix_keeps_it() {
    let bench = Bench::new();
    // The truth is compared with at the end: one that opens and cannot be read.
    std::fs::write(bench.path("capture/truth.rd.zarr/response/c.0.0.0.0.0"), "damaged").unwrap();
    let (status, stderr) = bench.run("run capture --out results");
    assert!(status == 1 && stderr.contains("kept: results/matrix.rd.zarr"), "{stderr}");
    bench.done("evaluate results/material.safetensors results/matrix.rd.zarr");
    assert!(!bench.path("results/measures.json").exists());
    bench.refused("run capture --out results", &["--force"]);
}

/// Ends a command with SIGKILL when a stopped run after it could go on from `finished` parts of the work.
#[cfg(unix)]
fn kill_after(finished: usize, bench: &Bench, line: &str) {
    fn done(folder: &Path) -> usize {
        let entries = std::fs::read_dir(folder).map(|all| all.flatten().collect::<Vec<_>>()).unwrap_or_default();
        let scratch = entries.iter().filter(|e| e.file_name().to_string_lossy().starts_with(".acquire-new-"));
        let of = |path: PathBuf| {
            let text = std::fs::read(path.join("finished")).unwrap_or_default();
            // The key is no work, nor is that an output was begun.
            let lines = text.split(|b| *b == b'\n').filter(|line| line.len() > 100).count();
            lines + done(&path)
        };
        scratch.map(|e| of(e.path())).sum()
    }
    let mut child = Command::new(env!("CARGO_BIN_EXE_acquire"))
        .args(line.split(' '))
        .current_dir(bench.0.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    while done(bench.0.path()) < finished {
        assert!(child.try_wait().unwrap().is_none(), "{line}: it ended before it was killed");
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
}

#[cfg(unix)]
fn scratch_folders(bench: &Bench) -> usize {
    let entries = std::fs::read_dir(bench.0.path()).unwrap().map(|e| e.unwrap().file_name());
    entries.filter(|name| name.to_string_lossy().starts_with(".acquire-new-")).count()
}

/// A long capture of few photographs, so that a run can be killed on its way.
#[cfg(unix)]
const LONG: &str = "simulate c --grid 8x6 --window 21x17 --exposures 2 --voxels-per-sample 1";

/// What a command makes that nothing stops; it is removed again.
#[cfg(unix)]
fn undisturbed(bench: &Bench, line: &str, out: &str) -> std::collections::BTreeMap<String, Vec<u8>> {
    bench.done(line);
    let made = files(&bench.path(out));
    std::fs::remove_dir_all(bench.path(out.split('/').next().unwrap())).unwrap();
    made
}

#[cfg(unix)]
#[test]
fn a_killed_run_goes_on_where_it_was_to_the_same_bytes() {
    let bench = Bench::new();
    bench.done(LONG);
    for (line, out, whole) in [
        ("build-matrix c --out o.rd.zarr", "o.rd.zarr", "measured by a stopped run"),
        ("run c --out o", "o/matrix.rd.zarr", "measured by a stopped run"),
        ("simulate s --grid 8x6 --window 21x17 --exposures 2 --seed 4", "s", "made by a stopped run"),
        ("simulate t --grid 8x6 --window 21x17 --truth-only", "t", "made by a stopped run"),
    ] {
        let undisturbed = undisturbed(&bench, line, out);
        kill_after(3, &bench, line);
        // Twice, and work beside it leaves it alone.
        bench.done("export m.safetensors --to npz --out beside.npz --force");
        kill_after(7, &bench, line);
        assert_eq!(scratch_folders(&bench), 1);
        let (status, stderr) = bench.run(line);
        assert!(status == 0 && stderr.contains(whole) && stderr.contains("taken over"), "{line}: {stderr}");
        assert!(files(&bench.path(out)) == undisturbed, "{line}: other bytes than of an undisturbed run");
        assert_eq!(scratch_folders(&bench), 0, "{line}");
    }
}

#[cfg(unix)]
#[test]
fn a_killed_run_is_not_gone_on_with_when_its_inputs_or_options_are_others() {
    let bench = Bench::new();
    bench.done(LONG);
    let line = "build-matrix c --out o.rd.zarr";
    let undisturbed = undisturbed(&bench, line, "o.rd.zarr");

    // Other times, and then the same ones again: nothing is left of the others.
    kill_after(4, &bench, line);
    let (status, stderr) = bench.run(&format!("{line} --exposure-from estimate"));
    assert!(status == 0 && stderr.contains("measured anew") && !stderr.contains("taken over"), "{stderr}");
    bench.done(&format!("{line} --force"));
    assert!(files(&bench.path("o.rd.zarr")) == undisturbed);

    // One photograph is another one: its shot is measured again, with what is to be said of it.
    std::fs::remove_dir_all(bench.path("o.rd.zarr")).unwrap();
    kill_after(8, &bench, line);
    let photographs = bench.path("c/photos");
    let mut names: Vec<_> = std::fs::read_dir(&photographs).unwrap().map(|e| e.unwrap().path()).collect();
    names.retain(|p| p.file_name().unwrap().to_string_lossy().starts_with("lattice"));
    names.sort();
    let kept = std::fs::read(&names[2]).unwrap();
    std::fs::copy(&names[0], &names[2]).unwrap();
    let (status, stderr) = bench.run(line);
    assert!(status == 1 && stderr.contains("do not show the same") && stderr.contains("kept: "), "{stderr}");
    std::fs::write(&names[2], kept).unwrap();
    let (status, stderr) = bench.run(line);
    assert!(status == 0 && stderr.contains("taken over"), "{stderr}");
    assert!(files(&bench.path("o.rd.zarr")) == undisturbed);
    std::fs::remove_dir_all(bench.path("o.rd.zarr")).unwrap();

    // A row that power loss has spoilt is measured again.
    kill_after(8, &bench, line);
    let scratch = std::fs::read_dir(bench.0.path()).unwrap().map(|e| e.unwrap().path());
    let rows = scratch.map(|p| p.join("rows")).find(|p| p.is_file()).unwrap();
    let len = std::fs::metadata(&rows).unwrap().len();
    std::fs::write(&rows, vec![0; len as usize]).unwrap();
    let (status, stderr) = bench.run(line);
    assert!(status == 0 && !stderr.contains("taken over"), "{stderr}");
    assert!(files(&bench.path("o.rd.zarr")) == undisturbed);

    // Who does not want it any more removes it.
    std::fs::remove_dir_all(bench.path("o.rd.zarr")).unwrap();
    kill_after(2, &bench, line);
    bench.done("clean .");
    assert_eq!(scratch_folders(&bench), 0);
}

#[cfg(unix)]
#[test]
fn what_was_measured_until_the_disk_was_full_is_gone_on_with() {
    let bench = Bench::new();
    bench.done(LONG);
    let line = "build-matrix c --out o.rd.zarr";
    let undisturbed = undisturbed(&bench, line, "o.rd.zarr");
    // Files of more than so many blocks of 512 bytes cannot be written: some rows fit.
    let limited = format!("trap '' XFSZ; ulimit -f 400; exec {} {line}", env!("CARGO_BIN_EXE_acquire"));
    let output = Command::new("sh").args(["-c", &limited]).current_dir(bench.0.path()).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && stderr.contains("kept: what was finished"), "{stderr}");
    assert_eq!(scratch_folders(&bench), 1);
    let (status, stderr) = bench.run(line);
    assert!(status == 0 && stderr.contains("taken over"), "{stderr}");
    assert!(files(&bench.path("o.rd.zarr")) == undisturbed);
}

#[cfg(unix)]
#[test]
fn a_killed_tradeoff_measures_only_what_it_had_not() {
    let bench = Bench::new();
    let line = "tradeoff m.rd.zarr --quick --out o";
    kill_after(2, &bench, line);
    let (status, stderr) = bench.run(line);
    assert!(status == 0 && stderr.contains("measured by a stopped run and taken over"), "{stderr}");
    let json: serde_json::Value =
        serde_json::from_slice(&std::fs::read(bench.path("o/tradeoff.json")).unwrap()).unwrap();
    let table = |json: &serde_json::Value| -> Vec<serde_json::Value> {
        let keep =
            |p: &serde_json::Value| serde_json::json!([p["model"], p["terms"], p["degree"], p["rel_rmse"], p["bytes"]]);
        json["measured"].as_array().unwrap().iter().map(keep).collect()
    };
    bench.done(&format!("{line} --force"));
    let whole: serde_json::Value =
        serde_json::from_slice(&std::fs::read(bench.path("o/tradeoff.json")).unwrap()).unwrap();
    assert_eq!(table(&json), table(&whole));
}
