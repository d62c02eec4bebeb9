"""Figures 1 to 3 after Kurt, Öztürk and Peers 2013, with a statue and materials made by code."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path

import numpy as np

import acquire
import acquire.mitsuba

from ._panels import column, error_times_five, flip_if_there, labelled, psnr_db, row, srgb, zoom
from ._trade import figure_3

#: The paper's material: its bytes are what all models of Figure 2 get.
PAPER = dict(model="tucker", terms=15, degree=7)
#: Lit points along a side of marble at most: 16 mm, as it is seen from near.
MARBLE_POINTS = 32


def main() -> None:
    given = _arguments()
    given.out.mkdir(parents=True, exist_ok=True)
    acquire.mitsuba.use(given.variant)
    from ._scene import Stage

    stage = Stage(given.out / "statue.ply", given.width, given.spp)
    wanted = (1, 2, 3) if given.figure is None else (given.figure,)
    if 1 in wanted:
        marble = given.marble or _simulated(given.out, "marble", min(given.points, MARBLE_POINTS))
        figure_1(given.out, stage, marble, given.chessboard4 or _simulated(given.out, "chessboard-4x4", given.points))
    if wanted == (1,):
        return
    matrix = given.chessboard or _simulated(given.out, "chessboard-8x8", given.points)
    for number, make in ((2, figure_2), (3, figure_3)):
        if number in wanted:
            figures = make(given.out, stage, matrix, lambda **how: _factored(given.out, matrix, **how))
            measured = {"spp": given.spp, "width": given.width, f"figure_{number}": figures}
            (given.out / f"figure-{number}.json").write_text(json.dumps(measured, indent=1) + "\n")


def figure_1(out: Path, stage, marble: Path, chessboard: Path) -> None:
    """Marble from near (T = 15, P = 4), a chessboard of 4 × 4 squares (T = 15, P = 7) under three lights."""
    material = _factored(out, marble, model="tucker", terms=15, degree=4)
    pictures = [labelled(srgb(stage.render(material, "window", near=True)), "marble, T = 15, P = 4")]
    paper = _factored(out, chessboard, **PAPER)
    pictures += [labelled(srgb(stage.render(paper, light)), f"chessboard 4x4, T = 15, P = 7, {light}") for light in ("spot", "window", "behind")]
    row(pictures).save(out / "figure-1.png")


def figure_2(out: Path, stage, matrix: Path, factored) -> list[dict]:
    """The chessboard in a spot: the matrix, and models of as many bytes as the paper's, each with its difference × 5."""
    paper = factored(**PAPER)
    most = acquire.Material.load(paper).bytes_f32
    models = {
        "Peers et al. 2006": factored(model="peers2006", max_bytes=most),
        "Kurt et al. 2013": paper,
        "joint, with maps": factored(model="joint", max_bytes=most, maps=True),
    }
    reference, again = (stage.render(matrix, "spot", seed=k) for k in (0, 1))
    columns, measured = [column([labelled(srgb(reference), "matrix"), srgb(zoom(reference))])], []
    for name, file in {"matrix, other seed": None, **models}.items():
        before = time.process_time()
        picture = again if file is None else stage.render(file, "spot")
        figures = {"name": name, "psnr_db": psnr_db(picture, reference), "flip": flip_if_there(picture, reference)}
        if file is not None:
            figures |= {"bytes_f32": acquire.Material.load(file).bytes_f32, "processor_secs": round(time.process_time() - before, 2)}
            title = f"{name}: {figures['psnr_db']:.1f} dB"
            columns.append(column([labelled(srgb(picture), title), srgb(zoom(picture)), error_times_five(picture, reference)]))
        measured.append(figures)
        print(json.dumps(figures), flush=True)
    row(columns).save(out / "figure-2.png")
    return measured


def _factored(out: Path, matrix: Path, **how) -> Path:
    """A material, made once for its matrix and options."""
    words = [str(value) if name == "model" else f"{name}-{value}" for name, value in how.items() if name != "precision"]
    path = out / f"{'-'.join([matrix.parent.name, _digest(matrix), *words])}.{'acq' if how.get('precision') == 'coded' else 'safetensors'}"
    if not path.exists():
        print(f"factoring {path.name}", file=sys.stderr)
        acquire.factor(matrix, **how).save(path)
    return path


def _digest(matrix: Path) -> str:
    """What tells a matrix from others: its metadata with their checksums, and those of its arrays."""
    found = hashlib.sha256()
    for path in sorted(matrix.rglob("zarr.json")):
        found.update(path.read_bytes())
    return found.hexdigest()[:8]


def _simulated(out: Path, material: str, points: int) -> Path:
    """A noise-free matrix, made once; a chessboard of 64 × 64 points takes about nine minutes of a processor."""
    folder = out / f"{material}-{points}"
    if not (folder / "truth.rd.zarr").exists():
        pitches = dict(lit_pitch_mm=0.5, pitch_mm=0.5)
        acquire.simulate(folder, material=material, grid=(points, points), window=(31, 31), truth_only=True, seed=1, **pitches)
    return folder / "truth.rd.zarr"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m acquire.figures", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/figures"), help="folder of the pictures and what they are made of; what is there is used again")
    parser.add_argument("--figure", type=int, choices=(1, 2, 3), help="only this one")
    parser.add_argument("--chessboard", type=Path, help="a matrix for Figures 2 and 3 instead of the simulated chessboard of 8 x 8 squares")
    parser.add_argument("--chessboard4", type=Path, help="a matrix for Figure 1 instead of the simulated chessboard of 4 x 4 squares")
    parser.add_argument("--marble", type=Path, help="a matrix to take instead of the simulated marble")
    parser.add_argument("--points", type=int, default=64, help=f"lit points along each side of what is simulated; of marble at most {MARBLE_POINTS} [64]")
    parser.add_argument("--width", type=int, default=320, help="pixels of a picture, which is half as high again [320]")
    parser.add_argument("--spp", type=int, default=512, help="paths for a pixel [512]")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba's variant [llvm_ad_rgb]")
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except acquire.InputError as error:
        sys.exit(f"error: {error}")
