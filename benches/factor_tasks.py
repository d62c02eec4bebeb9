"""What a factorization by tasks costs beside one process, and beside Dask's own truncated SVD on the same store.

    target/python/new/bin/python benches/factor_tasks.py [FOLDER]

Needs the Python module, NumPy, zarr and dask (scripts/test_python.sh has made that environment), and target/release/acquire. Prints the tables of docs/scale.md.
"""

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy: one process is one thread
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
import numpy as np

import acquire

PROGRAM = Path(os.environ.get("ACQUIRE", Path(__file__).resolve().parents[1] / "target/release/acquire"))
POINTS, WINDOW, TERMS = (96, 84), (41, 31), 15
#: Of the matrix whose singular values are compared: all of them are computed.
FEW_POINTS, SMALL_WINDOW = (40, 32), (21, 17)


def matrix(path, points=POINTS, window=WINDOW):
    """A profile times one and smooth maps whose weights fall slowly, with noise of 1e-4 of the peak."""
    (x, y), (w, h) = points, window
    rng = np.random.default_rng(1)
    dy, dx = np.mgrid[0:h, 0:w] - np.array([h // 2, w // 2])[:, None, None]
    fall = np.exp(-np.hypot(dx, dy) / 5)
    rows = np.ones((x * y, h * w * 3), np.float32)
    iy, ix = np.mgrid[0:y, 0:x]
    for j in range(60):
        a, b, c, d = rng.uniform(-1, 1, 4)
        left = np.cos(0.3 * (a * ix + b * iy) + j).reshape(-1)
        right = np.stack([np.cos(0.5 * (c * dx + d * dy) + j + 0.2 * k) for k in range(3)], -1).reshape(-1)
        rows += (0.3 * (j + 1.0) ** -1.5 * np.outer(left, right)).astype(np.float32)
    rows *= np.repeat(fall.reshape(-1), 3).astype(np.float32)
    sd = 1e-4 * float(rows.max())
    rows += sd * rng.standard_normal(rows.shape, np.float32)
    response = rows.reshape(y, x, h, w, 3)
    acquire.write_matrix(path, response, pitch_mm=0.1, variance=np.full_like(response, sd * sd), progress=False)


def processor():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run(*words):
    """(stdout, processor seconds)"""
    before = processor()
    done = subprocess.run([PROGRAM, "--quiet", "--threads", "1", *map(str, words)], check=True, capture_output=True, text=True)
    return done.stdout, processor() - before


def by_tasks(folder, parts, options):
    """Processor seconds of the tasks and of what joins them, passes, and bytes of the largest pass and part."""
    out, passes = folder / "tasks.safetensors", folder / "passes"
    shutil.rmtree(passes, ignore_errors=True)
    out.unlink(missing_ok=True)
    passes.mkdir()
    tasks = joined = 0.0
    told = []
    while True:
        due, secs = run("factor", folder / "m.rd.zarr", *options, "--tasks", passes, "--parts", parts, "--out", out)
        joined += secs
        if not due.strip():
            break
        for part in due.split():
            said, secs = run("factor-part", passes, "--part", part, "--json")
            tasks += secs
            told.append(json.loads(said))
    kinds = {}
    for one in told:
        kind = kinds.setdefault(one["stage"], [0, 0])
        kind[0], kind[1] = max(kind[0], one["bytes_pass"]), max(kind[1], one["bytes_part"])
    return tasks, joined, max(one["pass"] for one in told), kinds


def settings(folder):
    for options in (["--terms", TERMS, "--degree", 7], ["--terms", TERMS, "--maps", "no"], ["--terms", TERMS, "--maps", "yes"]):
        print(" ".join(map(str, options)))
        for memory in ([], ["--memory", "1MiB"]):
            out = folder / "one.safetensors"
            out.unlink(missing_ok=True)
            _, secs = run("factor", folder / "m.rd.zarr", "--backend", "randomized", *options, *memory, "--out", out)
            print(f"  one process{' that streams' if memory else ''}: {secs:.2f} s")
        for parts in (1, 2, 4, 8, 32):
            tasks, joined, passes, kinds = by_tasks(folder, parts, options)
            one, many = (acquire.Material.load(folder / name).rows(range(POINTS[0] * POINTS[1])) for name in ("one.safetensors", "tasks.safetensors"))
            off = np.abs(one - many).max() / np.abs(one).max()
            sizes = ", ".join(f"{stage} {a / 1e6:.2f} → {b / 1e6:.2f} MB" for stage, (a, b) in kinds.items())
            print(f"  {parts} parts: tasks {tasks:.2f} s, joining {joined:.2f} s, {passes} passes; material off by {off:.1e} of the peak; pass → part: {sizes}")


def svd(folder):
    import dask
    import dask.array as da

    shutil.rmtree(folder / "m.rd.zarr", ignore_errors=True)
    matrix(folder / "m.rd.zarr", FEW_POINTS, SMALL_WINDOW)
    stored = da.from_zarr(str(folder / "m.rd.zarr"), component="response")
    rows = stored.reshape(-1, int(np.prod(stored.shape[2:])))
    # Of the Gram matrix in f64: 1e-8 of the largest.
    all_rows = rows.compute().astype(np.float64)
    exact = np.sqrt(np.linalg.eigvalsh(all_rows.T @ all_rows)[::-1][:TERMS])
    del all_rows
    off = lambda s: np.abs(np.asarray(s)[:TERMS] - exact).max() / exact[0]
    tall = rows.rechunk({1: -1})
    for power in (0, 2, 4):
        before, start = time.process_time(), time.perf_counter()
        with dask.config.set(scheduler="synchronous"):
            s = da.linalg.svd_compressed(tall, TERMS, n_power_iter=power, seed=1)[1].compute()
        print(f"dask.array.linalg.svd_compressed, n_power_iter={power}: {time.process_time() - before:.2f} s of processor, off by {off(s):.1e} of the largest")
    plain = ["--model", "joint", "--terms", TERMS, "--maps", "no", "--profile-power", 0, "--no-peak-shift"]
    for accuracy in (1e-3, 1e-5, 1e-6):
        tasks, joined, passes, _ = by_tasks(folder, 8, [*plain, "--accuracy", accuracy])
        s = acquire.Material.load(folder / "tasks.safetensors").info["singular_values"]
        print(f"8 tasks a pass, --accuracy {accuracy}: {tasks + joined:.2f} s of processor, {passes} passes, off by {off(s):.1e} of the largest")


def main():
    with tempfile.TemporaryDirectory(dir=sys.argv[1] if len(sys.argv) > 1 else None) as folder:
        folder = Path(folder)
        matrix(folder / "m.rd.zarr")
        settings(folder)
        svd(folder)


if __name__ == "__main__":
    main()
