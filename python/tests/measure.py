"""The figures of docs/python.md, "Measured": run by hand, with the module installed and the program built.

    cargo build --release -p acquire-material --example time_pairs
    python measure.py target/release

RAYON_NUM_THREADS=1 for one thread.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import acquire

built = Path(sys.argv[1])
program = built / "acquire"


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
    # The same pairs as of examples/time_pairs.rs, but for the generator.
    rng = np.random.default_rng(0)
    places = material.lit_mm.reshape(-1, 2)
    x_i = rng.uniform(places.min(0), places.max(0), (1_000_000, 2))
    x_o = x_i + rng.uniform(-4, 4, x_i.shape)
    print(subprocess.run([built / "examples/time_pairs", folder / "m.safetensors"], capture_output=True, text=True, check=True).stdout, end="")
    for interpolate in (True, False):
        secs = best(lambda: material.response(x_i, x_o, interpolate=interpolate))
        print(f"response, 10^6 pairs, interpolate={interpolate}: {secs:.3f} s, {1e3 * secs:.0f} ns a pair")
    print(f"rows, all 4096: {best(lambda: material.rows(np.arange(4096))):.3f} s")
    print(f"relight: {best(lambda: material.relight(np.ones((256, 256)))):.3f} s")
    ours = best(lambda: acquire.factor(truth, terms=15, progress=False), 3)
    theirs = best(lambda: subprocess.run([program, "factor", truth, "--terms", "15", "-q", "--force", "--out", folder / "m.safetensors"], check=True), 3)
    print(f"factor, 64 x 64 points, 31 x 31 window, T = 15: {ours:.2f} s from Python, {theirs:.2f} s by the program (and its file)")
