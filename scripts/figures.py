#!/usr/bin/env python3
"""Reruns tables of the documentation and prints them as they are now. Python 3.11, standard library.

A table that can be rerun has a comment before it in docs/*.md, `<!-- figures: NAME`, then TOML, then `-->`. docs/testing.md
describes its fields ("Figures of the documentation").
"""

import argparse
import json
import math
import os
import re
import shlex
import struct
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from geometry_error import registration_rms

ROOT = Path(__file__).resolve().parent.parent
PAGES = [*sorted((ROOT / "docs").glob("*.md")), ROOT / "README.md"]
COMMENT = re.compile(r"<!-- figures: (\S+)\n((?:(?!-->)[^\n]*\n)*)-->\n((?:\|[^\n]*\n)+)")
FIELD = re.compile(r"\{([^{}:]+):([^{}]*)\}")
FAILED = "failed"


def say(text):
    print(text, file=sys.stderr, flush=True)


def arguments():
    parser = argparse.ArgumentParser(prog="scripts/figures.py", description="Reruns tables of the documentation. Tables go to stdout: a figure "
                                     "that changed as `old → new`. Progress goes to stderr.", epilog="Exit status 0 when all tables were printed, 1 when a name "
                                     "is unknown or a row could not be measured.")
    parser.add_argument("tables", metavar="TABLE", nargs="*", help="names of tables, as --list tells [default: none]")
    parser.add_argument("--list", action="store_true", help="list the tables, with page and line, and the commands of their rows")
    parser.add_argument("--rows", metavar="TEXT", help="only rows (of tables by column: columns) whose first cell contains TEXT")
    parser.add_argument("--write", action="store_true", help="write the new figures into the pages")
    parser.add_argument("--program", metavar="FILE", type=Path, help="the program [default: target/release/acquire]",
                        default=Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target")) / "release/acquire")
    given = parser.parse_args()
    if not given.tables and not given.list:
        parser.error("name a table, or --list")
    return given


class Table:
    """A table of a page with the description before it."""

    def __init__(self, page, found):
        self.page, self.name, self.text = page, found[1], found[3]
        self.line = page.read_text()[: found.start(3)].count("\n") + 1
        try:
            self.told = tomllib.loads(found[2])
        except tomllib.TOMLDecodeError as error:
            sys.exit(f"error: {page}: figures: {self.name}: {error}")
        lines = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]] for line in self.text.strip().split("\n")]
        self.head, self.rows = lines[0], lines[2:]

    def options(self, cell):
        """What a first cell stands for: `options` says it, or else the code in it."""
        named = self.told.get("options", {})
        return named[cell] if cell in named else " ".join(re.findall(r"`([^`]+)`", cell))

    def commands(self, cell):
        """Command lines of a row (a column), for people."""
        if "command" in self.told:
            yield self.told["command"].replace("{column}", cell)
        for name, run in self.told.get("run", {}).items():
            yield f"{name}: acquire simulate t {shlex.join(merged(run['simulate'], self.options(cell)))}; acquire build-matrix t{run.get('build', '')}"


def merged(base, row):
    """Options of `base`, with {row} replaced; of an option that is given twice the later one holds."""
    told, name = {}, ""
    for word in shlex.split(base.replace("{row}", row)):
        if word.startswith("--"):
            name = word
            told[name] = []
        else:
            told[name].append(word)
    return [word for name, values in told.items() for word in [name, *values]]


def program(given, *words, folder):
    done = subprocess.run([str(given.program.resolve()), *map(str, words)], cwd=folder, capture_output=True, text=True)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.startswith("error")] or [f"exit status {done.returncode}"]
        raise RuntimeError(f"acquire {words[0]}: {lines[0]}")
    return done.stdout


def without(capture, section):
    """Takes a section out of capture.toml."""
    path = capture / "capture.toml"
    path.write_text(re.sub(rf"^\[{section}\]\n(?:(?!\[).*\n)*", "", path.read_text(), flags=re.MULTILINE))


def measured(given, run, options):
    """One capture the whole way: all of `evaluate --json`, the matrix's attributes, and where camera and projector are off."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "t"
        program(given, "simulate", "t", "-q", *merged(run["simulate"], options), folder=folder)
        if "without" in run:
            without(capture, run["without"])
        program(given, "build-matrix", "t", "--out", "t.rd.zarr", "-q", *shlex.split(run.get("build", "")), folder=folder)
        told = json.loads(program(given, "evaluate", "t.rd.zarr", "t/truth.rd.zarr", "--json", "-q", folder=folder))
        told |= json.loads((Path(folder) / "t.rd.zarr/zarr.json").read_text())["attributes"]
        truth = tomllib.loads((capture / "truth.toml").read_text())
        told["camera_px"], told["projector_px"] = registration_rms(truth, told["provenance"]["registration"])
        matrix = Path(folder) / "t.rd.zarr"
        told["position_sd_mm"] = math.sqrt(2) * rms(matrix / "position_sd_mm/c/0/0")
        told["drift_sd_px"] = rms(matrix / "shot_drift_sd_px/c/0") if told["shots"] else None
        return told


def rms(chunk):
    """RMS of an array that is one chunk of f64 and a checksum."""
    data = chunk.read_bytes()[:-4]
    return math.sqrt(sum(v[0] ** 2 for v in struct.iter_unpack("<d", data)) / (len(data) // 8))


def shown(template, values, old):
    """The template with its fields filled; `…` at its end keeps what the old cell has from a bracket on."""
    def field(match):
        value = values
        for part in match[1].split("."):
            value = value[int(part) if isinstance(value, list) else part] if value is not None else None
        return "–" if value is None else (format(value, match[2]) if match[2] else str(value))

    text = FIELD.sub(field, template.removesuffix("…")).replace("%", " %").replace("  %", " %")
    if template.endswith("…"):
        text += old[old.index(" ("):] if " (" in old else ""
    return text


def numbers(text):
    return re.findall(r"\d*\.?\d+(?:e-?\d+)?", text)


def same(old, new):
    """Whether the new figures are the old ones, as exactly as the old ones are told."""
    a, b = numbers(old), numbers(new)
    decimals = [len(x.partition(".")[2]) for x in a]
    return old == new or (a and len(a) == len(b) and all(round(float(y), d) == float(x) for x, y, d in zip(a, b, decimals)))


def printed_rows(table, text):
    """Rows of a Markdown table that a command printed, by their first cells: {head: cell}."""
    lines = [[c.strip() for c in line.strip().strip("|").split("|")] for line in text.splitlines() if line.startswith("|")]
    head = [h.strip("`") for h in lines[0]]
    keys = table.told.get("keys", 1)
    return {tuple(row[:keys]): dict(zip(head, row)) for row in lines[2:]}


def block_rows(text):
    """Rows of the text that benches/equal_bytes.sh prints: a label, two spaces, numbers; the heads are the last words of the line that has no numbers."""
    rows, head = {}, []
    for line in text.splitlines():
        if share := re.match(r"\s+coded is 1/([\d.]+) of", line):
            rows["coded share"] = {"share": float(share[1])}
            continue
        found = re.match(r"\s+(\S.*?)\s{2,}((?:[-\d.e]+\s*)+)$", line)
        if found:
            values = [float(v) if v != "-" else None for v in found[2].split()]
            rows[found[1]] = dict(zip(head[-len(values):], values))
        elif line.startswith("  ") and len(line.split()) > 3:
            head = line.split()
    return rows


def shell(given, command):
    env = {**os.environ, "ACQUIRE": str(given.program.resolve())}
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", command], cwd=ROOT, env=env, capture_output=True, text=True)
    if done.returncode:
        lines = done.stderr.splitlines() or [f"exit status {done.returncode}"]
        raise RuntimeError(f"{command}: {next((line for line in lines if 'error' in line), lines[-1])}")
    return done.stdout


def chosen(given, cell):
    return not given.rows or given.rows in cell


def by_rows(given, table):
    """(row, column, new text) of each cell that is measured, a row's runs before the next row."""
    cells = table.told["cells"]
    for k, row in enumerate(table.rows):
        if not chosen(given, row[0]):
            continue
        say(f"figures: {table.name}: {row[0]}")
        try:
            values = {name: measured(given, run, table.options(row[0])) for name, run in table.told["run"].items()}
        except RuntimeError as error:
            yield k, 1, f"{FAILED}: {error}"
            continue
        for j, template in enumerate(cells, start=1):
            if template:
                yield k, j, shown(template, values, row[j])


def by_command(given, table):
    """The same where one command prints all rows as a Markdown table."""
    say(f"figures: {table.name}: {table.told['command']}")
    printed, keys = printed_rows(table, shell(given, table.told["command"])), table.told.get("keys", 1)
    for k, row in enumerate(table.rows):
        if not chosen(given, row[0]):
            continue
        values = printed.get(tuple(row[:keys]))
        if values is None:
            say(f"figures: {table.name}: the command prints no row {row[0]}")
            continue
        for j, template in enumerate(table.told["cells"], start=keys):
            if template:
                yield k, j, shown(template, values, row[j])


def by_columns(given, table):
    """The same where a command measures a column."""
    for j, column in enumerate(table.head[1:], start=1):
        if not chosen(given, column):
            continue
        say(f"figures: {table.name}: {column}")
        try:
            rows = block_rows(shell(given, table.told["command"].replace("{column}", column)))
        except RuntimeError as error:
            yield 0, j, f"{FAILED}: {error}"
            continue
        for k, row in enumerate(table.rows):
            told = table.told["rows"].get(row[0])
            if told:
                yield k, j, shown(told[1], rows[told[0]], row[j])


def rerun(given, table):
    """Prints the table; (whether all could be measured, its rows as they are now)."""
    way = by_columns if "rows" in table.told else by_command if "command" in table.told else by_rows
    new, told, good = [list(row) for row in table.rows], [list(row) for row in table.rows], True
    touched, changed, count = set(), 0, 0
    for k, j, text in way(given, table):
        good &= not text.startswith(FAILED)
        touched.add(k)
        count += 1
        old = table.rows[k][j]
        if not same(old, text):
            changed += 1
            new[k][j] = old if text.startswith(FAILED) else text
            told[k][j] = f"{old or '(empty)'} → **{text}**"
    print(f"\n{table.page.relative_to(ROOT)}:{table.line} `{table.name}`: {changed} of {count} cells changed\n")
    print(page_lines(table.head, [row for k, row in enumerate(told) if k in touched]), flush=True)
    return good, new


def page_lines(head, rows):
    return "\n".join("| " + " | ".join(row) + " |" if i != 1 else "|" + "---|" * len(head) for i, row in enumerate([head, [], *rows]))


def main():
    given = arguments()
    tables = [Table(page, found) for page in PAGES for found in COMMENT.finditer(page.read_text())]
    named = sum(len(re.findall("<!-- figures: (?!NAME)", page.read_text())) for page in PAGES)
    if named != len(tables):
        sys.exit(f"error: {named} comments <!-- figures: …, of which {len(tables)} are followed by TOML, --> and a table")
    if given.list:
        for table in tables:
            print(f"{table.name}  ({table.page.relative_to(ROOT)}:{table.line}, {len(table.rows)} rows)")
            cell = table.head[1] if "rows" in table.told else table.rows[0][0]
            for command in table.commands(cell):
                print(f"    {command}")
    names = {table.name: table for table in tables}
    unknown = [name for name in given.tables if name not in names]
    if unknown:
        sys.exit(f"error: no table named {', '.join(unknown)}\nhint: scripts/figures.py --list")
    if given.tables and not given.program.is_file():
        sys.exit(f"error: {given.program}: not there\nhint: cargo build --release")
    all_good = True
    for name in given.tables:
        table = names[name]
        try:
            good, rows = rerun(given, table)
        except RuntimeError as error:
            say(f"error: {name}: {error}")
            all_good = False
            continue
        all_good &= good
        if given.write:
            page = table.page.read_text()
            table.page.write_text(page.replace(table.text, page_lines(table.head, rows) + "\n"))
    sys.exit(0 if all_good else 1)


if __name__ == "__main__":
    main()
