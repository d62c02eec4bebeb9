#!/usr/bin/env python3
"""Mutation testing: which small faults no test notices. Python 3.11, standard library; needs git, cargo and what the build needs.

All mutants of all files are planted at once into a copy of the tree, each behind `crate::mutant(k)` (the program in
scripts/mutants does it), and built once; the environment variable MUTANT then chooses one. So a mutant costs the tests that
reach it, not a build. docs/testing.md ("Mutants") lists the operators and says how to read the results.
"""

import argparse
import concurrent.futures
import hashlib
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

from compare_build import git, say, seed

ROOT = Path(__file__).resolve().parent.parent
WORK = ROOT / "target/mutants"
TREE, CARGO, TOOL = WORK / "tree", WORK / "cargo", WORK / "tool"
BUILT, DROPPED, RESULTS = WORK / "built.json", WORK / "dropped.tsv", WORK / "results.tsv"
# Packages and where they are.
CRATES = {"acquire": Path("."), "acquire-material": Path("crates/acquire-material")}
# Optimized a little, or the build takes longer than the tests; without lines, which nobody reads.
PROFILE = [f"--config=profile.release.package.{crate}.{setting}" for crate in CRATES for setting in ["opt-level=1", "debug=0"]]
ROUNDS = 12
COLUMNS = "number file line column what function result seconds test".split()
RUNTIME = """
/// Whether mutant `number` is the one to run with (environment variable `MUTANT`). With `MUTANT=reached`, none; the numbers
/// that are asked for are then written to the file `MUTANT_REACHED`.
#[doc(hidden)]
pub fn mutant(number: usize) -> bool {
    use std::io::Write;
    use std::sync::{LazyLock, Mutex, atomic::{AtomicBool, Ordering::Relaxed}};
    static CHOSEN: LazyLock<usize> = LazyLock::new(|| match std::env::var("MUTANT") {
        Ok(value) if value == "reached" => usize::MAX,
        Ok(value) => value.parse().unwrap_or(0),
        Err(_) => 0,
    });
    static REACHED: [AtomicBool; COUNT + 1] = [const { AtomicBool::new(false) }; COUNT + 1];
    static FILE: LazyLock<Mutex<std::fs::File>> =
        LazyLock::new(|| Mutex::new(std::fs::File::options().create(true).append(true).open(std::env::var("MUTANT_REACHED").unwrap()).unwrap()));
    if *CHOSEN == usize::MAX && !REACHED[number].swap(true, Relaxed) {
        writeln!(FILE.lock().unwrap(), "{number}").unwrap();
    }
    *CHOSEN == number
}
"""
ALLOWED = "#![allow(warnings, unconditional_panic, arithmetic_overflow, unconditional_recursion, overflowing_literals)]\n"


def arguments():
    parser = argparse.ArgumentParser(prog="scripts/mutants.py", description="Which small faults in the given files no test notices. Each mutant meets "
                                     "the tests of its own module, then the others of its top folder. A Markdown table per folder and the list of the "
                                     "missed go to stdout, each mutant to target/mutants/results.tsv, progress to stderr. The checkout is not touched.",
                                     epilog="Exit status 0 when the tables were printed, whatever was missed.")
    parser.add_argument("paths", metavar="PATH", nargs="+", help="a folder or file below src or crates/NAME/src, or crates/NAME")
    parser.add_argument("--step", metavar="N", type=int, default=1, help="only every N-th mutant of a file [default: %(default)s]")
    parser.add_argument("--jobs", metavar="N", type=int, default=2, help="mutants at a time [default: %(default)s]")
    parser.add_argument("--list", action="store_true", help="build, and print how many there are; run none")
    given = parser.parse_args()
    if given.step < 1 or given.jobs < 1:
        parser.error("--step and --jobs are at least 1")
    return given


def is_test(path):
    return path.name == "tests.rs" or path.name.endswith("_tests.rs") or path.name.startswith("test_") or "tests" in path.parts


def sources(paths):
    """Files below the crates' src, as named from the root, in the order of the paths."""
    found = []
    for name in paths:
        path = (ROOT / name).resolve()
        path = path / "src" if path in [ROOT / place for place in CRATES.values()] else path
        files = sorted(path.rglob("*.rs")) if path.is_dir() else [path]
        if not files or not all(f.is_file() and any(f.is_relative_to(ROOT / place / "src") for place in CRATES.values()) for f in files):
            sys.exit(f"error: {name}: not below the src of a crate, or no such file")
        found += [str(f.relative_to(ROOT)) for f in files if not is_test(f.relative_to(ROOT)) and f.name != "main.rs"]
    return list(dict.fromkeys(found))


def crate_of(file):
    return "acquire" if Path(file).parts[0] == "src" else Path(file).parts[1]


def library_of(crate):
    return str(CRATES[crate] / "src/lib.rs")


def program_of(crate):
    return WORK / f"tests-{crate}"


def crates_of(files):
    return list(dict.fromkeys(map(crate_of, files)))


def folder_of(file):
    """A top folder of the root crate, or another crate as a whole: it is small."""
    crate = crate_of(file)
    return Path(file).parts[1].removesuffix(".rs") if crate == "acquire" else crate


def copy_tree():
    """The checkout as it lies there, new files too, ignored ones not."""
    shutil.rmtree(TREE, ignore_errors=True)
    for name in git(ROOT, "ls-files", "-co", "--exclude-standard", "-z").split("\0"):
        if name and (ROOT / name).is_file():
            (TREE / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, TREE / name)


def state_of_sources():
    """Equal when the tests' program would be."""
    digest = hashlib.sha256()
    for path in sorted([*(p for place in CRATES.values() for p in (ROOT / place / "src").rglob("*")), *(ROOT / "scripts/mutants/src").rglob("*.rs"), ROOT / "Cargo.lock", Path(__file__)]):
        if path.is_file():
            digest.update(str(path).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def plant(files):
    """Mutants (number, file, line, column, what, function) and places (file, start, end, numbers), planted into the copy."""
    libraries = [library_of(crate) for crate in CRATES]
    for file in [*files, *libraries]:
        shutil.copyfile(ROOT / file, TREE / file)
    done = subprocess.run([TOOL / "debug/mutants", TREE, DROPPED, *files], capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr.strip())
    lines = [line.split("\t") for line in done.stdout.splitlines()]
    mutants = [line[1:] for line in lines if line[0] == "mutant"]
    places = [(l[1], int(l[2]), int(l[3]), l[4].split(",")) for l in lines if l[0] == "place"]
    # Every crate has the runtime, and numbers of its own out of all.
    for library in libraries:
        path = TREE / library
        path.write_text(ALLOWED + path.read_text() + RUNTIME.replace("COUNT", str(len(mutants))))
    shifted = {library: len(ALLOWED.encode()) for library in libraries}
    return mutants, [(file, start + shifted.get(file, 0), end + shifted.get(file, 0), numbers) for file, start, end, numbers in places]


def compile_tests(crates):
    """The built programs by crate (None when one does not compile) and the compiler's errors, as lists of (file, start, end)."""
    packages = [f"--package={crate}" for crate in crates]
    command = ["cargo", "test", "--release", "--locked", "--lib", "--no-run", "--message-format=json", *packages, *PROFILE]
    env = {**os.environ, "CARGO_TARGET_DIR": str(CARGO), "CARGO_INCREMENTAL": "0"}
    done = subprocess.run(command, cwd=TREE, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    programs, errors, texts = {}, [], []
    for line in done.stdout.splitlines():
        said = json.loads(line) if line.startswith("{") else {}
        if said.get("executable") and said["profile"]["test"]:
            programs[said["target"]["name"].replace("_", "-")] = said["executable"]
        message = said.get("message")
        if said.get("reason") == "compiler-message" and message["level"] == "error" and message["spans"]:
            chosen = [s for s in message["spans"] if s["is_primary"]] or message["spans"]
            errors.append([(s["file_name"], s["byte_start"], s["byte_end"]) for s in chosen])
            texts.append(message["rendered"])
    (WORK / "errors.txt").write_text("\n".join(texts) + done.stderr)
    if done.returncode and not errors:
        sys.exit(f"error: the mutated tree does not build: see {WORK / 'errors.txt'}\n{done.stderr[-2000:]}")
    return (programs if done.returncode == 0 else None), errors


def culprits(errors, places):
    """Numbers of the mutants that errors belong to: of the smallest place around an error, else of those within it."""
    found = set()
    for error in errors:
        for file, start, end in error:
            around = [p for p in places if p[0] == file and p[1] <= start and end <= p[2]]
            within = [p for p in places if p[0] == file and start <= p[1] and p[2] <= end]
            for place in [min(around, key=lambda p: p[2] - p[1])] if around else within:
                found.update(place[3])
    return found


def build(files):
    """Plants and builds until all that is planted compiles. What does not compile is left out, round by round."""
    state = state_of_sources()
    crates = crates_of(files)
    if BUILT.is_file() and all(program_of(crate).is_file() for crate in crates):
        built = json.loads(BUILT.read_text())
        if built["state"] == state and set(files) <= set(built["files"]):
            return built
    for path in [*map(program_of, CRATES), BUILT, DROPPED]:
        path.unlink(missing_ok=True)
    seed(ROOT, CARGO)
    copy_tree()
    subprocess.run(["cargo", "build", "--quiet", "--locked", "--manifest-path", TREE / "scripts/mutants/Cargo.toml"],
                   env={**os.environ, "CARGO_TARGET_DIR": str(TOOL)}, check=True)
    generated = None
    for round in range(ROUNDS):
        mutants, places = plant(files)
        generated = generated or Counter(m[1] for m in mutants)
        say(f"mutants: round {round + 1}: building {len(mutants)}")
        programs, errors = compile_tests(crates)
        if programs:
            for crate, program in programs.items():
                shutil.copy2(program, program_of(crate))
            built = {"state": state, "files": files, "generated": generated, "mutants": mutants}
            BUILT.write_text(json.dumps(built))
            return built
        numbers = culprits(errors, places)
        say(f"mutants: {len(errors)} errors, {len(numbers)} do not compile")
        if not numbers:
            sys.exit(f"error: the mutated tree does not build, and no mutant is to blame: see {WORK / 'errors.txt'}")
        with DROPPED.open("a") as out:
            out.writelines("\t".join(m[1:5]) + "\n" for m in mutants if m[0] in numbers)
    sys.exit(f"error: still mutants that do not compile after {ROUNDS} rounds: see {WORK / 'errors.txt'}")


def run(crate, tests, number, limit, reached=os.devnull):
    """`passed`, `failed` or `timeout` of tests of a crate, one after the other on one thread, and the seconds it took."""
    env = {**os.environ, "MUTANT": number, "MUTANT_REACHED": str(reached), "RAYON_NUM_THREADS": "1", "RUST_BACKTRACE": "0"}
    start = time.monotonic()
    command = [program_of(crate), "--exact", *tests, "--test-threads", "1", "-q"]
    try:
        code = subprocess.run(command, cwd=TREE / CRATES[crate], env=env, timeout=limit, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode
        result = "failed" if code else "passed"
    except subprocess.TimeoutExpired:
        result = "timeout"
    return result, time.monotonic() - start


class Tests:
    """The tests of a top folder or a crate: how long each takes, and which mutants it reaches."""

    def __init__(self, folder, pool):
        self.crate, prefix = (folder, "") if folder in CRATES else ("acquire", f"{folder}::")

        def listed(*more):
            command = [program_of(self.crate), *([prefix] if prefix else []), "--list", *more]
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            return {line.removesuffix(": test") for line in text.splitlines() if line.startswith(prefix) and line.endswith(": test")}

        self.seconds, self.reached = {}, {}
        (WORK / "reached").mkdir(exist_ok=True)

        def measure(name):
            file = WORK / "reached" / hashlib.sha256(name.encode()).hexdigest()[:16]
            file.unlink(missing_ok=True)
            result, seconds = run(self.crate, [name], "reached", 600, file)
            if result != "passed":
                say(f"mutants: {name} fails without a mutant: left out")
                return
            self.seconds[name] = seconds
            self.reached[name] = set(file.read_text().split()) if file.is_file() else set()

        list(pool.map(measure, sorted(listed() - listed("--ignored"))))
        self.by_mutant = {}
        for name, numbers in self.reached.items():
            for number in numbers:
                self.by_mutant.setdefault(number, []).append(name)

    def meeting(self, mutant):
        """The tests that reach a mutant, in parts that run one after the other: its own module's, then the rest, quick ones first."""
        number, file = mutant[:2]
        parts = Path(file).relative_to(CRATES[self.crate]).with_suffix("").parts[1:]
        # The tests of mod.rs and lib.rs are in the module `tests` beside them.
        module = "::".join([*parts[:-1], "tests" if parts[-1] in ("mod", "lib") else parts[-1]]) + "::"
        names = sorted(self.by_mutant.get(number, []), key=lambda n: self.seconds[n])
        for part in [[n for n in names if n.startswith(module)], [n for n in names if not n.startswith(module)]]:
            quick = [n for n in part if self.seconds[n] < 0.3]
            slow = [n for n in part if self.seconds[n] >= 0.3]
            yield from [p for p in [quick, *([n] for n in slow)] if p]


def meet(mutant, tests):
    """`caught`, `missed`, `timed out` or `not reached`; the seconds; the tests of the part that told."""
    seconds, result = 0.0, "not reached"
    for names in tests.meeting(mutant):
        # Several times what they take without a mutant; the rest is for a machine with other work.
        said, took = run(tests.crate, names, mutant[0], 3 + 5 * sum(tests.seconds[n] for n in names))
        seconds += took
        if said != "passed":
            return ("caught" if said == "failed" else "timed out"), seconds, names[0] if len(names) == 1 else ""
        result = "missed"
    return result, seconds, ""


def table(built, files, results, step):
    """Rows of a Markdown table: a file each, and their sum."""
    rows, total = [], Counter()
    kept = Counter(m[1] for m in built["mutants"])
    for file in files:
        counts = Counter(r[6] for r in results if r[1] == file)
        counts["generated"] = built["generated"].get(file, 0)
        counts["uncompiled"] = counts["generated"] - kept[file]
        counts["run"] = sum(1 for r in results if r[1] == file)
        total += counts
        rows.append((file.removeprefix("src/"), counts))
    rows.append(("**all**", total))
    columns = [("generated", "generated"), ("uncompiled", "did not compile"), ("run", "run"), ("caught", "caught"),
               ("timed out", "timed out"), ("missed", "missed"), ("not reached", "not reached")]
    lines = [f"| file{f' (every {step}.)' if step > 1 else ''} | " + " | ".join(c[1] for c in columns) + " |", "|---" + "|---:" * len(columns) + "|"]
    lines += [f"| {name} | " + " | ".join(str(counts[c[0]]) for c in columns) + " |" for name, counts in rows if counts["generated"]]
    return "\n".join(lines)


def main():
    given = arguments()
    WORK.mkdir(parents=True, exist_ok=True)
    files = sources(given.paths)
    built = build(files)
    if given.list:
        for folder in dict.fromkeys(map(folder_of, files)):
            print(f"\n## {folder}\n\n{table(built, [f for f in files if folder_of(f) == folder], [], 1)}", flush=True)
        return
    lock = threading.Lock()
    with concurrent.futures.ThreadPoolExecutor(given.jobs) as pool, RESULTS.open("w") as out:
        print(*COLUMNS, sep="\t", file=out)
        for folder in dict.fromkeys(map(folder_of, files)):
            of_folder = [f for f in files if folder_of(f) == folder]
            tests = Tests(folder, pool)
            chosen = [m for file in of_folder for m in [m for m in built["mutants"] if m[1] == file][:: given.step]]
            say(f"mutants: {folder}: {len(tests.seconds)} tests, {len(chosen)} mutants")
            results = []

            def one(mutant):
                result, seconds, test = meet(mutant, tests)
                with lock:
                    results.append([*mutant, result])
                    print(*mutant, result, f"{seconds:.2f}", test, sep="\t", file=out, flush=True)

            list(pool.map(one, chosen))
            results.sort(key=lambda r: int(r[0]))
            print(f"\n## {folder}\n\n{table(built, of_folder, results, given.step)}\n")
            for _, file, line, column, what, function, result in results:
                if result in ("missed", "not reached"):
                    print(f"- {result}: {file}:{line}:{column}: {what} in `{function}`")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
