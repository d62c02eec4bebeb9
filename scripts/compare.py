"""Two revisions beside each other: time, memory, sizes and errors, as a Markdown table. Python 3.11, standard library.

Called by scripts/compare.sh. docs/testing.md says how to read the table.
"""

import argparse
import hashlib
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import compare_build as build
from compare_build import say

ROOT = Path(__file__).resolve().parent.parent
# Options that every revision knows: --grid and --window with one number.
BENCH = ["--material", "chessboard-4x4", "--seed", "3"]
# name: options of its capture. A capture whose name begins with `matrix` gives a matrix and a truth to factor.
NORMAL = {
    "small": ["--grid", "10", "--window", "15"],
    "large": ["--grid", "2", "--window", "31", "--camera-px-per-sample", "20", "--exposures", "3"],
    "matrix": ["--grid", "20", "--window", "31", "--spacing", "10", "--exposures", "3", "--stops", "4"],
}
QUICK = {
    "small": ["--grid", "6", "--window", "15"],
    "large": ["--grid", "2", "--window", "31", "--camera-px-per-sample", "13", "--exposures", "3"],
    "matrix": ["--grid", "10", "--window", "21", "--spacing", "10", "--exposures", "3", "--stops", "4"],
}
SIMULATE = [*BENCH, "--grid", "4", "--window", "15"]
# Of `evaluate --json`; how a difference is told: as a ratio, in points of a per cent, in decibels.
ERRORS = {"rel_rmse": "ratio", "log_rmse": "ratio", "coverage_2sigma": "points", "relit_psnr_db": "dB"}


def arguments():
    parser = argparse.ArgumentParser(
        prog="scripts/compare.sh",
        description="Builds two revisions and runs both programs in turn on the same inputs. The table goes to stdout, progress to stderr.",
        epilog="Exit status 0 when the table was printed, whatever it says; 1 when a revision does not build or no input could be made.",
    )
    parser.add_argument("a", metavar="REVISION", help="A: a commit, a tag, a branch")
    parser.add_argument("b", metavar="REVISION2", nargs="?", help="B [default: the working tree as it is]")
    parser.add_argument("--rounds", type=int, metavar="N", help="how often each command runs in each program [default: 5, 3 with --quick]")
    parser.add_argument("--quick", action="store_true", help="smaller inputs and 3 rounds: under 3 minutes beside building")
    parser.add_argument("--inputs", metavar="DIR", type=Path, help="your own inputs: folders with a capture.toml, matrices *.rd.zarr")
    parser.add_argument("--inputs-by", choices=["a", "b"], default="a", help="which program makes the inputs [default: a]")
    parser.add_argument("--cache", metavar="DIR", type=Path, default=ROOT / "target/compare", help="programs and inputs [default: target/compare]")
    parser.add_argument("--json", metavar="FILE", type=Path, help="write every run and every row there too")
    given = parser.parse_args()
    given.rounds = given.rounds or (3 if given.quick else 5)
    return given


def run(command):
    """Runs a command; {wall_s, processor_s, peak_bytes} of it, or {failed: its message}, and its stdout."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        start = time.perf_counter()
        child = subprocess.Popen([str(part) for part in command], stdout=out, stderr=err, stdin=subprocess.DEVNULL)
        _, status, used = os.wait4(child.pid, 0)
        wall = time.perf_counter() - start
        child.returncode = os.waitstatus_to_exitcode(status)
        out.seek(0), err.seek(0)
        if child.returncode:
            lines = err.read().decode(errors="replace").splitlines() or [f"exit status {child.returncode}"]
            return {"failed": next((line for line in lines if "error" in line or "panicked" in line), lines[0])}, ""
        # Linux counts ru_maxrss in KiB, macOS in bytes.
        unit = 1 if sys.platform == "darwin" else 1024
        told = {"wall_s": wall, "processor_s": used.ru_utime + used.ru_stime, "peak_bytes": used.ru_maxrss * unit}
        return told, out.read().decode(errors="replace")


def without_output(command):
    """The command; what an earlier round wrote to its --out is removed: programs replace nothing unasked."""
    out = Path(command[command.index("--out") + 1]) if "--out" in command else None
    if out and out.is_dir():
        shutil.rmtree(out)
    elif out:
        out.unlink(missing_ok=True)
        out.with_suffix(".png").unlink(missing_ok=True)  # what relight writes beside it
    return command


def size(path):
    """Bytes of a file, or of all files in a folder."""
    return sum(p.stat().st_size for p in ([path] if path.is_file() else path.rglob("*")) if p.is_file())


def made_inputs(recipes, maker, cache):
    """The folder of the inputs that `maker` makes from `recipes`, made when it is not there."""
    key = hashlib.sha256(json.dumps([recipes, BENCH, maker.parent.name]).encode()).hexdigest()[:12]
    kept = cache / "inputs" / key
    if kept.is_dir():
        return kept
    kept.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=kept.parent) as folder:
        made = Path(folder) / "made"
        made.mkdir()
        for name, options in recipes.items():
            say(f"compare: making the input `{name}`")
            capture = made / name
            must(run([maker, "simulate", capture, "-q", *BENCH, *options]), f"simulate {name}")
            if name.startswith("matrix"):
                must(run([maker, "build-matrix", capture, "--out", made / f"{name}.rd.zarr", "-q"]), f"build-matrix {name}")
                (capture / "truth.rd.zarr").rename(made / f"{name}.truth.rd.zarr")
                shutil.rmtree(capture)
        made.rename(kept)
    return kept


def must(result, what):
    if "failed" in result[0]:
        sys.exit(f"error: {what}: {result[0]['failed']}\nhint: --inputs-by b, or --inputs DIR with your own")


class Inputs:
    """Captures and one matrix of a folder, with their truths where they are; a material of the matrix."""

    def __init__(self, folder, maker, scratch):
        self.captures = sorted(p.parent for p in [*folder.glob("capture.toml"), *folder.glob("*/capture.toml")])
        matrices = sorted(p for p in folder.glob("*.rd.zarr") if not p.name.endswith("truth.rd.zarr"))
        self.matrix, self.truth = (matrices or [None])[0], None
        if self.matrix is None and self.captures:
            self.matrix = scratch / "matrix.rd.zarr"
            must(run([maker, "build-matrix", self.captures[0], "--out", self.matrix, "-q"]), "build-matrix")
            self.truth = self.captures[0] / "truth.rd.zarr"
        elif self.matrix is not None:
            self.truth = self.matrix.with_name(self.matrix.name.replace(".rd.zarr", ".truth.rd.zarr"))
        if self.matrix is None:
            sys.exit(f"error: {folder}: no capture and no matrix\nhint: folders with a capture.toml, matrices *.rd.zarr")
        self.material = scratch / "material.safetensors"
        must(run([maker, "factor", self.matrix, "--out", self.material, "-q"]), "factor")


def photographs(capture):
    return sum(p.suffix.lower() in (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr") for p in capture.rglob("*"))


def commands(inputs, out):
    """(label, arguments) of all that is timed; results go to the folder `out`."""
    listed = [(f"build-matrix, `{c.name}` ({photographs(c)} photographs)", ["build-matrix", c, "--out", out / f"{c.name}.rd.zarr", "-q"])
              for c in inputs.captures]
    factor = ["factor", inputs.matrix, "-q", "--out"]
    return [
        *listed,
        ("factor", [*factor, out / "default.safetensors"]),
        ("factor, tucker T=15 P=7", [*factor, out / "tucker.safetensors", "--model", "tucker", "--terms", "15", "--degree", "7"]),
        ("factor, coded", [*factor, out / "default.acq"]),
        ("evaluate", ["evaluate", inputs.material, inputs.matrix, "--json", "-q"]),
        ("relight", ["relight", inputs.material, "--light", "spot", "--out", out / "spot.exr", "-q"]),
        ("export", ["export", inputs.material, "--to", "exr", "--out", out / "layers.exr", "-q"]),
        ("simulate", ["simulate", out / "simulated", "--force", "-q", *SIMULATE]),
    ]


def measure(programs, inputs, scratch, rounds):
    """All runs: {label: {"a": [run, …], "b": […]}}, each command in both programs before the next one."""
    outs = {side: scratch / side for side in programs}
    for out in outs.values():
        out.mkdir()
    lists = {side: commands(inputs, outs[side]) for side in programs}
    runs = {label: {"a": [], "b": []} for label, _ in lists["a"]}
    for number in range(rounds):
        say(f"compare: round {number + 1} of {rounds}")
        for index, (label, _) in enumerate(lists["a"]):
            for side in "ab" if number % 2 == 0 else "ba":
                runs[label][side].append(run([programs[side], *without_output(lists[side][index][1])])[0])
    return runs, outs


def median_interval(values):
    """Between which two of the sorted values the median of their law lies, with 95 % where there are enough of them
    (6 or more); the smallest and the largest otherwise. By the binomial law, without an assumption about errors."""
    ordered, n = sorted(values), len(values)
    left_out = 0
    while 2 * sum(math.comb(n, i) for i in range(left_out + 2)) / 2**n <= 0.05:
        left_out += 1
    return ordered[left_out], ordered[n - 1 - left_out]


def compared(what, measure_name, a, b):
    """A row of paired runs."""
    ratios = [y / x for x, y in zip(a, b) if x > 0]
    row = {"what": what, "measure": measure_name, "a": statistics.median(a), "b": statistics.median(b)}
    if ratios:
        ratio, (low, high) = statistics.median(ratios), median_interval(ratios)
        # One is outside of what the pairs say, and by more than half of their width. Few pairs fall on one side by chance
        # (three of them every fourth time), and peak memory varies by 2 %: below six, small differences say nothing.
        least = 0.0 if len(ratios) >= 6 else 0.03
        odd = not low <= 1 <= high and abs(ratio - 1) > max((high - low) / 2, least)
        row |= {"ratio": ratio, "low": low, "high": high, "marked": odd, "shown": f"{ratio:.3f}"}
    return row


def single(what, measure_name, a, b, told="ratio"):
    """A row of one figure for each: a size or an error, which repeats exactly."""
    row = {"what": what, "measure": measure_name, "a": a, "b": b}
    if a is None or b is None:
        return row
    if told == "ratio":
        ratio = b / a if a else (1.0 if b == a else math.inf)
        return row | {"ratio": ratio, "marked": abs(ratio - 1) > 1e-3, "shown": f"{ratio:.4f}"}
    difference = b - a
    if told == "points":
        return row | {"difference": difference, "marked": abs(difference) > 1e-3, "shown": f"{100 * difference:+.2f} points"}
    return row | {"difference": difference, "marked": abs(difference) > 0.01, "shown": f"{difference:+.3f} dB"}


def failure(what, sides):
    """A row that says in which program a command failed."""
    message = {side: next((r["failed"] for r in runs if "failed" in r), None) for side, runs in sides.items()}
    text = "; ".join(f"{side.upper()} failed: {m}" for side, m in message.items() if m)
    return {"what": what, "measure": "", "a": None, "b": None, "shown": text.replace("|", "\\|"), "marked": True}


def time_rows(runs):
    rows = []
    for label, sides in runs.items():
        if any("failed" in r for side in sides.values() for r in side):
            rows.append(failure(label, sides))
            continue
        rows += [compared(label, m, [r[m] for r in sides["a"]], [r[m] for r in sides["b"]]) for m in ["wall_s", "processor_s", "peak_bytes"]]
    return rows


def size_rows(programs, outs, inputs):
    def pair(what, name):
        paths = [outs[side] / name for side in "ab"]
        return [single(what, "bytes", *(size(p) if p.exists() else None for p in paths))] if any(p.exists() for p in paths) else []

    rows = [row for c in inputs.captures for row in pair(f"matrix of `{c.name}`", f"{c.name}.rd.zarr")]
    rows += pair("material.safetensors", "default.safetensors") + pair("material.safetensors, tucker", "tucker.safetensors")
    rows += pair("material.acq", "default.acq")
    rows.append(single("program", "bytes", *(size(programs[side]) for side in "ab")))
    if shutil.which("strip"):
        stripped = []
        for side in "ab":
            path = outs[side] / "stripped"
            subprocess.run(["strip", "-o", path, programs[side]], check=True)
            stripped.append(size(path))
        rows.append(single("program, stripped", "bytes", *stripped))
    return rows


def error_rows(programs, outs, inputs):
    """Matrices and materials against the truth. One program measures both sides, so that only what it measures differs."""
    listed = [(f"matrix of `{c.name}` against truth", f"{c.name}.rd.zarr", c / "truth.rd.zarr") for c in inputs.captures]
    for name in ["default.safetensors", "tucker.safetensors", "default.acq"]:
        listed.append((f"{name} against truth", name, inputs.truth))
    rows = []
    for what, name, truth in listed:
        if truth is None or not truth.is_dir():
            continue
        measures = {side: measured(programs, outs[side] / name, truth) for side in "ab"}
        if not measures["a"] and not measures["b"]:
            continue
        for key, told in ERRORS.items():
            a, b = (measures[side].get(key) for side in "ab")
            if a is not None or b is not None:
                rows.append(single(what, key, a, b, told))
    return rows


def measured(programs, candidate, truth):
    for program in [programs["b"], programs["a"]]:
        told, out = run([program, "evaluate", candidate, truth, "--json", "-q"])
        if "failed" not in told:
            return json.loads(out)
    return {}


def shown(measure_name, value):
    if value is None:
        return ""
    if measure_name in ("wall_s", "processor_s"):
        return f"{value:.3f}"
    if measure_name == "peak_bytes":
        return f"{value / 2**20:.1f}"
    if measure_name == "bytes":
        return f"{value:,}"
    if measure_name in ("rel_rmse", "coverage_2sigma"):
        return f"{100 * value:.3f} %"
    return f"{value:.4f}"


HEADS = {"wall_s": "wall, s", "processor_s": "processor, s", "peak_bytes": "peak memory, MiB"}


def table(rows):
    lines = ["| what | measure | A | B | B/A or B − A | pairs | |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        m = row["measure"]
        pairs = f"{row['low']:.3f} to {row['high']:.3f}" if "low" in row else ""
        name = HEADS.get(m, f"`{m}`" if m in ERRORS else m)
        lines.append(f"| {row['what']} | {name} | {shown(m, row['a'])} | {shown(m, row['b'])} | {row.get('shown', '')} | {pairs} "
                     f"| {'**differs**' if row.get('marked') else ''} |")
    return "\n".join(lines)


def main():
    given = arguments()
    cache = given.cache.resolve()
    revisions = {"a": given.a, "b": given.b}
    names = {side: build.name_of(ROOT, r) for side, r in revisions.items()}
    built = {side: build.program(ROOT, cache, r) for side, r in revisions.items()}
    maker = built[given.inputs_by]
    folder = given.inputs.resolve() if given.inputs else made_inputs(QUICK if given.quick else NORMAL, maker, cache)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=cache) as scratch:
        inputs = Inputs(folder, maker, Path(scratch))
        # Copies of now: how much of a program the system has in memory counts in its peak memory.
        programs = {side: Path(shutil.copy2(program, f"{scratch}/acquire-{side}")) for side, program in built.items()}
        runs, outs = measure(programs, inputs, Path(scratch), given.rounds)
        rows = time_rows(runs) + size_rows(programs, outs, inputs) + error_rows(programs, outs, inputs)
    same = built["a"] == built["b"]
    print(f"A: {names['a']}  \nB: {names['b']}{', the same program' if same else ''}  ")
    print(f"{given.rounds} rounds, {os.cpu_count()} processors, load {os.getloadavg()[0]:.1f} at the end, inputs by {given.inputs_by.upper()}\n")
    print(table(rows), flush=True)
    if given.json:
        told = {"a": names["a"], "b": names["b"], "rounds": given.rounds, "rows": rows, "runs": runs}
        given.json.write_text(json.dumps(told, indent=1) + "\n")
    say(f"compare: {time.perf_counter() - start:.0f} s beside building and making inputs; inputs in {folder}")


if __name__ == "__main__":
    main()
