"""What all tests use: the command-line program when it is there, a small simulated matrix, and its material."""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import acquire

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(os.environ.get("ACQUIRE", ROOT / "target/release/acquire"))


@pytest.fixture(scope="session")
def program():
    """Runs the command line."""
    if not PROGRAM.exists():
        pytest.skip(f"no program at {PROGRAM}")

    def run(*words):
        done = subprocess.run([PROGRAM, *map(str, words)], capture_output=True, text=True)
        return done.returncode, done.stdout, done.stderr

    return run


@pytest.fixture(scope="session")
def truth(tmp_path_factory):
    """The true matrix of a chessboard: 10 × 8 points, windows of 11 × 9 samples."""
    folder = tmp_path_factory.mktemp("simulated") / "c"
    acquire.simulate(folder, material="chessboard-2x2", grid=(10, 8), window=(11, 9), seed=3, truth_only=True, voxels_per_sample=1)
    return folder / "truth.rd.zarr"


@pytest.fixture(scope="session")
def material(truth):
    return acquire.factor(truth, terms=6)


def windows(points=(4, 3), window=(7, 5), channels=3):
    """Responses that fall with the distance; no two are alike."""
    nx, ny = points
    w, h = window
    dy, dx = np.mgrid[0:h, 0:w] - np.array([h // 2, w // 2])[:, None, None]
    fall = np.exp(-np.hypot(dx, dy))[None, None, :, :, None] * (1 + 0.1 * np.arange(channels))
    gain = (1 + 0.01 * np.arange(nx * ny)).reshape(ny, nx, 1, 1, 1)
    return (0.1 * fall * gain).astype(np.float32)
