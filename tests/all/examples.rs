//! Every command that the help and the documentation show runs, and ends well.
//!
//! Collected are the "Examples:" of `acquire help COMMAND`, and of README.md and docs/*.md the lines of ``` blocks and
//! the code spans that begin with `acquire` or `target/release/acquire`. Each help example, each span and each block
//! has a folder of its own with the files that examples name ([`Bench`]); the lines of a block run one after the other,
//! as a person types them.
//!
//! Examples are written for people, so a few rules stand between:
//! - what follows two spaces or ` #` is a remark; a pipe (`| jq …`) is cut off: jq need not be there;
//! - `[X | Y]` is run without, with X and with Y; `exr|npz` is run with each;
//! - words that stand for something are replaced by [`STANDS_FOR`];
//! - sizes are cut down by [`AT_MOST`], and [`ALSO`] adds what makes a command cheap;
//! - what lies where an output is to go is removed before (a default name may be in the way of a second command of a
//!   block).
//!
//! An example that none of this makes runnable fails the test: mend the example, or add what it names to the bench.
//! README's Python needs xarray, which is not required to build or test, and is not run.

use crate::common;
use npyz::WriterBuilder;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::{Arc, Mutex, Weak};
use std::time::Instant;

/// (option or subcommand before it, word, what it is here). An empty first entry fits everywhere.
const STANDS_FOR: &[(&str, &str, &str)] = &[
    ("simulate", "DIR", "new"),
    ("--out", "DIR", "out"),
    ("--out", "PLAN", "out"),
    ("--out", "X.rd.zarr", "out.rd.zarr"),
    // The rig of the checkout's small capture has a projector of 256 × 240 px.
    ("--rig", "DIR", "lab/projector"),
    ("--rig", "calibration/", "lab/projector"),
    ("--calibration", "DIR", "calibration"),
    ("export", "MATERIAL", "slab.safetensors"),
    ("--material", "MATERIAL", "marble"),
    ("--sensor", "S", "phone"),
    ("import-matrix", "X.npz", "windows.npz"),
    // It factors the matrix a hundred times.
    ("tradeoff", "slab.rd.zarr", "few/truth.rd.zarr"),
    ("tradeoff", "X.rd.zarr", "few/truth.rd.zarr"),
    // Its small capture has few shots.
    ("--part", "3/64", "1/2"),
    ("--parts", "64", "2"),
    ("--shots", "120..180", "0..2"),
    ("", "DIR", "captures"),
    ("", "CAPTURE", "captures/probe"),
    ("", "FOLDER", "DCIM"),
    ("", "PLAN", "plan"),
    ("", "X.rd.zarr", "slab.rd.zarr"),
    ("", "CANDIDATE", "slab.safetensors"),
    ("", "REFERENCE", "slab.rd.zarr"),
    ("", "MATRIX_OR_MATERIAL", "slab.safetensors"),
    ("", "COMMAND", "simulate"),
    ("", "/media/DCIM", "DCIM"),
    // The photographs of the bench are those of its own plan, which a new one must not replace.
    ("--out", "plan", "new-plan"),
];

/// (subcommand, option, the largest numbers it gets here, which are also given where the example leaves it out).
const AT_MOST: &[(&str, &str, &str)] =
    &[("simulate", "--grid", "3"), ("simulate", "--window", "9"), ("simulate", "--photons", "1000")];

/// (subcommand, switch that makes it cheap).
const ALSO: &[(&str, &str)] = &[("tradeoff", "--quick")];

/// Commands of one folder, with the place where each is written.
type Block = Vec<(String, String)>;

/// The files that examples name. Made once; examples get hard links.
struct Bench(tempfile::TempDir);

/// The bench of the tests that run at the same time.
static SHARED: Mutex<Weak<Bench>> = Mutex::new(Weak::new());

impl Bench {
    fn shared() -> Arc<Self> {
        // A test that failed while it made the bench leaves nothing behind.
        let mut shared = SHARED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
        shared.upgrade().unwrap_or_else(|| {
            let bench = Arc::new(Self::new());
            *shared = Arc::downgrade(&bench);
            bench
        })
    }

    fn new() -> Self {
        let bench = Self(tempfile::tempdir().unwrap());
        let at = |name: &str| bench.path().join(name);
        common::copy_folder(Path::new("captures"), &at("captures"));
        common::copy_folder(Path::new("calibration"), &at("calibration"));
        common::copy_folder(Path::new("calibration"), &at("lab/rig-3"));
        // Of a simulated capture that an example does not make itself.
        for truth in ["truth.rd.zarr", "t/truth.rd.zarr"] {
            common::copy_folder(Path::new("captures/truth.rd.zarr"), &at(truth));
        }
        std::fs::create_dir(at("parts")).unwrap();
        std::fs::create_dir(at("passes")).unwrap();
        bench.photographs_of_a_plan();
        voxels(&at("slab.npz"));
        arrays(bench.path());
        common::copy_folder(Path::new("captures/truth.rd.zarr"), &at("simulated.zarr"));
        for command in [
            "build-matrix captures --out slab.rd.zarr",
            "extract captures --part 1/1 --out parts/all.part",
            "prepare captures --out parts/slab.prepared",
            "factor slab.rd.zarr --out slab.safetensors",
            "factor slab.rd.zarr --terms 2 --tasks passes --parts 2 --out tasks.safetensors",
            "relight slab.safetensors --light spot --out window.exr",
            "simulate few --grid 4 --window 7",
            // Four single dots, far apart: what `patterns` takes for a probe.
            "simulate captures/probe --grid 2 --lit-pitch-mm 4 --step-projector-px 32 --spacing 2 --window 31",
        ] {
            let words: Vec<_> = command.split(' ').map(str::to_owned).collect();
            let output = run(bench.path(), &words);
            assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        }
        let light = |x: usize, y: usize| (0.1 * x as f32, 1.0, 0.2 * y as f32);
        exr::prelude::write_rgb_file(at("light.exr"), 12, 9, light).unwrap();
        common::copy_folder(&at("captures/probe/calibration"), &at("lab/projector"));
        let rig = std::fs::read_to_string(at("lab/projector/rig.toml")).unwrap();
        let (before, projector) = rig.split_once("[projector]\nsize_px = [").unwrap();
        let (_, rest) = projector.split_once(']').unwrap();
        // The same with more pixels on two sides: nothing else moves.
        let larger = format!("{before}[projector]\nsize_px = [1920, 1080]{rest}");
        std::fs::write(at("lab/projector/rig.toml"), larger).unwrap();
        bench
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    /// What a camera's card holds after the plan of `captures/` was shot: DCIM and from-gphoto2, and the plan.
    fn photographs_of_a_plan(&self) {
        let capture = acquire::capture::Capture::open(Path::new("captures"), None).unwrap();
        let (plan, card) = (self.path().join("plan"), self.path().join("DCIM"));
        std::fs::create_dir_all(plan.join("calibration")).unwrap();
        std::fs::create_dir_all(&card).unwrap();
        std::fs::copy(&capture.rig_path, plan.join("calibration/rig.toml")).unwrap();
        acquire::patterns::Plan::of_capture(&capture).write(&plan).unwrap();
        for (k, photograph) in capture.brackets.iter().flatten().enumerate() {
            std::fs::copy(&photograph.path, card.join(format!("IMG_{:04}.JPG", k + 1))).unwrap();
        }
        common::copy_folder(&card, &self.path().join("from-gphoto2"));
    }

    /// A folder that has all of it.
    fn folder(&self) -> tempfile::TempDir {
        // Beside the bench: hard links do not go from one disk to another.
        let folder = tempfile::tempdir_in(self.path().parent().unwrap()).unwrap();
        link_folder(self.path(), folder.path());
        folder
    }

    /// Runs the blocks and fails with all commands that failed.
    fn runs(&self, blocks: &[Block]) {
        let (mut failures, mut took) = (Vec::new(), Vec::new());
        for block in blocks {
            let folder = self.folder();
            for (place, line) in block {
                for words in commands(line) {
                    make_room(folder.path(), &words);
                    let start = Instant::now();
                    let output = run(folder.path(), &words);
                    took.push((start.elapsed(), words.join(" ")));
                    if !output.status.success() {
                        let stderr = String::from_utf8_lossy(&output.stderr);
                        failures.push(format!("{place}: {line}\n  ran: acquire {}\n{stderr}", words.join(" ")));
                    }
                }
            }
        }
        let count = took.len();
        took.sort();
        println!("{count} commands; those that took longest:");
        took.iter().rev().take(12).for_each(|(time, words)| println!("{:.1} s: acquire {words}", time.as_secs_f64()));
        assert!(failures.is_empty(), "{} of {count} commands failed\n\n{}", failures.len(), failures.join("\n"));
    }
}

/// A block of skim milk with unequal sides and steps, as docs/simulation.md describes voxel files.
fn voxels(path: &Path) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).unwrap());
    let shape = [4u64, 6, 8, 3];
    let optics = |c: [f64; 3]| (0..4 * 6 * 8 * 3).map(|k| c[k % 3]).collect::<Vec<_>>();
    for (name, shape, values) in [
        ("reduced_scattering_per_mm", &shape[..], optics([0.70, 1.22, 1.90])),
        ("absorption_per_mm", &shape[..], optics([0.0014, 0.0025, 0.0142])),
        ("voxel_mm", &[3], vec![1.2, 1.5, 1.0]),
    ] {
        zip.start_file(format!("{name}.npy"), zip::write::SimpleFileOptions::default()).unwrap();
        let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(&mut zip).begin_nd().unwrap();
        array.extend(values).unwrap();
        array.finish().unwrap();
    }
    zip.finish().unwrap();
}

/// Responses that fall with the distance, as docs/matrix-format.md takes them: windows, and a full matrix of 32 × 24
/// points.
fn arrays(folder: &Path) {
    let array = |to: &mut dyn std::io::Write, shape: &[u64], value: &dyn Fn(u64) -> f64| {
        let mut array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(to).begin_nd().unwrap();
        array.extend((0..shape.iter().product()).map(value)).unwrap();
        array.finish().unwrap();
    };
    let window = |k: u64| (-((k / 3 % 7) as f64 - 3.0).hypot((k / 21 % 5) as f64 - 2.0)).exp() * 0.1;
    let shape = [4, 6, 5, 7, 3];
    let mut zip = zip::ZipWriter::new(std::fs::File::create(folder.join("windows.npz")).unwrap());
    zip.start_file("response.npy", zip::write::SimpleFileOptions::default()).unwrap();
    array(&mut zip, &shape, &window);
    zip.start_file("pitch_mm.npy", zip::write::SimpleFileOptions::default()).unwrap();
    array(&mut zip, &[], &|_| 0.5);
    zip.finish().unwrap();
    for name in ["windows.npy", "sparse.npy"] {
        array(&mut std::fs::File::create(folder.join(name)).unwrap(), &shape, &window);
    }
    let n = 32 * 24;
    let apart = |k: u64| ((k / n % 32) as f64 - (k % 32) as f64).hypot((k / n / 32) as f64 - (k % n / 32) as f64);
    array(&mut std::fs::File::create(folder.join("full.npy")).unwrap(), &[n, n], &|k| (-apart(k)).exp() * 0.1);
}

fn link_folder(from: &Path, to: &Path) {
    common::lay_folder(from, to, &|file, target| std::fs::hard_link(file, target));
}

fn run(folder: &Path, words: &[String]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_acquire")).args(words).current_dir(folder).output().unwrap()
}

/// Removes what lies where the command writes a folder or a file.
fn make_room(folder: &Path, words: &[String]) {
    let after = |option: &str| words.iter().position(|w| w == option).and_then(|k| words.get(k + 1));
    let simulated = words.get(1).filter(|_| words[0] == "simulate");
    let out = after("--out").or(after("-o"));
    // The default name is that of the first argument.
    let ending = match words[0].as_str() {
        "factor" => Some("safetensors"),
        "export" => after("--to").map(String::as_str),
        _ => None,
    };
    let default = ending.zip(words.get(1)).filter(|_| out.is_none());
    let default = default.map(|(ending, from)| format!("{}.{ending}", from.split('.').next().unwrap_or_default()));
    // relight writes a picture beside its file.
    let beside = out.filter(|_| words[0] == "relight").map(|out| out.replace(".exr", ".png"));
    for name in [out, simulated, default.as_ref(), beside.as_ref()].into_iter().flatten() {
        let path = folder.join(name);
        let _ = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    }
}

/// The command of a line that begins with the program's name, without the name and without the remark.
fn command_of(line: &str) -> Option<&str> {
    let line = line.trim();
    let line = line.strip_prefix("target/release/").unwrap_or(line);
    let line = line.strip_prefix("acquire ")?;
    let end = [line.find("  "), line.find(" #")].into_iter().flatten().min().unwrap_or(line.len());
    Some(line[..end].trim())
}

/// The argument lists that an example stands for.
fn commands(example: &str) -> Vec<Vec<String>> {
    // Pieces between brackets: the odd ones are optional.
    let pieces: Vec<&str> = example.split(['[', ']']).collect();
    let piped = |text: &str| text.split(" | ").next().unwrap_or_default().to_owned();
    // A pipe outside of brackets ends the command; one in brackets divides alternatives. jq's own brackets come after
    // the pipe.
    let end = pieces.iter().step_by(2).position(|p| p.contains(" | ")).map_or(pieces.len(), |k| 2 * k + 1);
    let pieces = &pieces[..end];
    let line = |chosen: Option<(usize, &str)>| {
        let part = |(k, piece): (usize, &&str)| match chosen {
            _ if k % 2 == 0 => piped(piece),
            Some((at, words)) if at == k => format!(" {words} "),
            _ => " ".to_owned(),
        };
        pieces.iter().enumerate().map(part).collect::<String>()
    };
    let mut lines = vec![line(None)];
    for (k, piece) in pieces.iter().enumerate().skip(1).step_by(2).filter(|(_, p)| !matches!(**p, "OPTIONS")) {
        lines.extend(piece.split(" | ").map(|words| line(Some((k, words)))));
    }
    let mut all: Vec<_> = lines.iter().flat_map(|line| alternatives(line)).map(|words| arguments(&words)).collect();
    // An option that is there to be cheap may have been one of the alternatives.
    all.dedup();
    all
}

/// `--to exr|npz` is two commands.
fn alternatives(line: &str) -> Vec<Vec<String>> {
    let mut all = vec![Vec::new()];
    for word in line.split_whitespace() {
        let with =
            |word: &str| all.iter().map(|w: &Vec<String>| [&w[..], &[word.to_owned()]].concat()).collect::<Vec<_>>();
        all = word.split('|').flat_map(with).collect();
    }
    all
}

/// The words with what stands for something replaced, and made cheap.
fn arguments(words: &[String]) -> Vec<String> {
    let subcommand = words[0].as_str();
    let mut made = vec![subcommand.to_owned()];
    for (before, word) in words.iter().zip(&words[1..]) {
        let fits = |(context, name, _): &&(&str, &str, &str)| name == word && (context.is_empty() || context == before);
        made.push(STANDS_FOR.iter().find(fits).map_or(word.as_str(), |s| s.2).to_owned());
    }
    for (_, option, most) in AT_MOST.iter().filter(|a| a.0 == subcommand) {
        match made.iter().position(|word| word == option) {
            Some(k) => made[k + 1] = at_most(&made[k + 1], most),
            None => made.extend([(*option).to_owned(), (*most).to_owned()]),
        }
    }
    for (_, switch) in ALSO.iter().filter(|a| a.0 == subcommand && !words.iter().any(|w| w == a.1)) {
        made.push((*switch).to_owned());
    }
    made
}

/// Each number of `value` (24, or 24x16) that is larger than `most` becomes `most`; unequal ones stay unequal.
fn at_most(value: &str, most: &str) -> String {
    let most: f64 = most.parse().unwrap();
    let cut = |(k, part): (usize, &str)| match part.parse::<f64>() {
        // An odd one, of a window, stays odd.
        Ok(number) if number > most => (most - k as f64 * (1.0 + most % 2.0)).max(2.0).to_string(),
        _ => part.to_owned(),
    };
    value.split('x').enumerate().map(cut).collect::<Vec<_>>().join("x")
}

/// Names of the subcommands, from the program's own help.
fn subcommands() -> Vec<String> {
    let help = help(&["help"]);
    let listed = help.split("Commands:\n").nth(1).unwrap().split("\n\n").next().unwrap();
    let names = listed.lines().filter_map(|l| l.strip_prefix("  ")).filter(|l| !l.starts_with(' '));
    names.map(|l| l.split(' ').next().unwrap().to_owned()).filter(|name| name != "help").collect()
}

fn help(words: &[&str]) -> String {
    // Wider than clap's limit, which then rules.
    let output = Command::new(env!("CARGO_BIN_EXE_acquire")).args(words).env("COLUMNS", "200").output().unwrap();
    assert!(output.status.success());
    String::from_utf8(output.stdout).unwrap()
}

/// The examples of a help text, lines that were broken put together again.
fn examples_of(help: &str) -> Vec<String> {
    let Some(block) = help.split("Examples:\n").nth(1) else { return Vec::new() };
    let mut found: Vec<String> = Vec::new();
    for line in block.lines().take_while(|l| !l.trim().is_empty()) {
        match found.last_mut() {
            Some(last) if command_of(line).is_none() => *last = format!("{last} {}", line.trim()),
            _ => found.push(line.trim().to_owned()),
        }
    }
    found.iter().map(|line| command_of(line).unwrap_or(line).to_owned()).collect()
}

/// The commands of a Markdown page: each ``` block, each code span. A span may go on in the next line of its paragraph.
fn blocks_of(name: &str, text: &str) -> Vec<Block> {
    let (mut blocks, mut block, mut inside, mut unfinished) = (Vec::new(), Block::new(), false, String::new());
    let (mut paragraph, mut begins) = (String::new(), 0);
    for (k, line) in text.lines().chain([""]).enumerate() {
        let fence = line.trim_start().starts_with("```");
        if fence || line.trim().is_empty() {
            blocks.extend(spans_of(name, begins, &std::mem::take(&mut paragraph)));
        }
        if fence {
            inside = !inside;
            blocks.push(std::mem::take(&mut block));
        } else if let Some(start) = line.strip_suffix('\\').filter(|_| inside) {
            unfinished += start;
        } else if inside {
            let whole = std::mem::take(&mut unfinished) + line;
            block.extend(command_of(&whole).map(|command| (format!("{name}:{}", k + 1), command.to_owned())));
        } else {
            begins = if paragraph.is_empty() { k + 1 } else { begins };
            paragraph += &format!("{line}\n");
        }
    }
    blocks.retain(|block| !block.is_empty());
    blocks
}

/// The commands of the code spans of a paragraph that begins in this line of the page.
fn spans_of(name: &str, begins: usize, paragraph: &str) -> Vec<Block> {
    let (mut found, mut line) = (Vec::new(), begins);
    for (k, span) in paragraph.split('`').enumerate() {
        let text = span.replace('\n', " ");
        // A span that only names a subcommand, or leaves something out, is not a command.
        let command = command_of(&text).filter(|c| k % 2 == 1 && c.contains(' ') && !c.contains('…'));
        found.extend(command.map(|command| vec![(format!("{name}:{line}"), command.to_owned())]));
        line += span.matches('\n').count();
    }
    found
}

#[test]
fn the_examples_of_every_subcommand_s_help_run() {
    let mut blocks = Vec::new();
    for name in std::iter::once(None).chain(subcommands().iter().map(|n| Some(n.as_str()))) {
        let words: Vec<&str> = std::iter::once("help").chain(name).collect();
        let examples = examples_of(&help(&words));
        let place = format!("acquire {}", words.join(" "));
        assert!(!examples.is_empty(), "{place} has no examples");
        blocks.extend(examples.into_iter().map(|example| vec![(place.clone(), example)]));
    }
    Bench::shared().runs(&blocks);
}

#[test]
#[ignore = "slow: 35 s"]
fn the_examples_of_the_documentation_run() {
    let mut pages: Vec<PathBuf> = std::fs::read_dir("docs").unwrap().map(|e| e.unwrap().path()).collect();
    pages.push("README.md".into());
    pages.retain(|page| page.extension().is_some_and(|e| e == "md"));
    pages.sort();
    let read = |page: &PathBuf| blocks_of(&page.display().to_string(), &std::fs::read_to_string(page).unwrap());
    let blocks: Vec<Block> = pages.iter().flat_map(read).collect();
    assert!(
        blocks.iter().any(|b| b[0].0.starts_with("README.md")) && blocks.iter().any(|b| b[0].0.starts_with("docs"))
    );
    Bench::shared().runs(&blocks);
}

#[test]
fn examples_are_read_as_people_read_them() {
    let texts = |example: &str| commands(example).iter().map(|words| words.join(" ")).collect::<Vec<_>>();
    assert_eq!(texts("check DIR [--json]"), ["check captures", "check captures --json"]);
    let factor = texts("factor X.rd.zarr [--target-psnr 45 | --max-bytes 250kB] --out M.acq");
    let rest = ["", "--target-psnr 45 ", "--max-bytes 250kB "];
    assert_eq!(factor, rest.map(|r| format!("factor slab.rd.zarr {r}--out M.acq")));
    assert_eq!(texts("export a --to exr|npz --out b"), ["export a --to exr --out b", "export a --to npz --out b"]);
    assert_eq!(texts("check captures/ --json | jq -r '.findings[] | .x'"), ["check captures/ --json"]);
    let sizes = ["--grid 3x2 --window 9 --photons 1000", "--window 5x7 --grid 2 --photons 200"];
    assert_eq!(texts("simulate t --grid 24x16 --window 31"), [format!("simulate t {}", sizes[0])]);
    assert_eq!(
        texts("simulate t --window 5x11 --grid 2 --photons 200 [OPTIONS]"),
        [format!("simulate t {}", sizes[1])]
    );
    let broken =
        "x\n\nExamples:\n  acquire check a   a remark that\n  goes on\n  acquire run a\n  --out b\n\nacquire no\n";
    assert_eq!(examples_of(broken), ["check a", "run a --out b"]);
    let page = "`acquire check`, `acquire check a`, `acquire factor …`\nand `acquire check\nc --json`.\n```\ntarget/release/acquire run a \\\n --out b   # it\nacquire check b\n```\n";
    let block =
        |lines: &[(usize, &str)]| lines.iter().map(|(k, c)| (format!("p:{k}"), (*c).to_owned())).collect::<Block>();
    let spans = [block(&[(1, "check a")]), block(&[(2, "check c --json")])];
    assert_eq!(blocks_of("p", page), [&spans[..], &[block(&[(6, "run a"), (7, "check b")])]].concat());
}
