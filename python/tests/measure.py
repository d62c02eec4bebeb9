"""The figures of docs/python.md, "Measured": run by hand, with the module installed and the program built.

    python measure.py target/release/acquire
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import acquire

program = sys.argv[1]


def best(work, times=5):
    """Seconds of the quickest of some runs."""
    found = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return min(found)


with tempfile.TemporaryDirectory() as name:
    folder = Path(name)
    acquire.simulate(folder / "c", material="chessboard-4x4", grid=(64, 64), window=(31, 31), truth_only=True, progress=False)
    truth = folder / "c/truth.rd.zarr"
    material = acquire.factor(truth, terms=15, progress=False)
    material.save(folder / "m.safetensors")
    rng = np.random.default_rng(0)
    x0, x1, y0, y1 = material.lit_extent_mm
    x_i = rng.uniform([x0, y0], [x1, y1], (1_000_000, 2))
    x_o = x_i + rng.normal(0, 2, x_i.shape)
    for interpolate in (True, False):
        secs = best(lambda: material.response(x_i, x_o, interpolate=interpolate))
        print(f"response, 10^6 pairs, interpolate={interpolate}: {secs:.3f} s, {1e3 * secs:.0f} ns a pair")
    print(f"rows, all 4096: {best(lambda: material.rows(np.arange(4096))):.3f} s")
    print(f"relight: {best(lambda: material.relight(np.ones((256, 256)))):.3f} s")
    ours = best(lambda: acquire.factor(truth, terms=15, progress=False), 3)
    theirs = best(lambda: subprocess.run([program, "factor", truth, "--terms", "15", "-q", "--out", folder / "m.safetensors"], check=True), 3)
    print(f"factor, 64 x 64 points, 31 x 31 window, T = 15: {ours:.2f} s from Python, {theirs:.2f} s by the program (and its file)")
