"""Figure 1 and 2 after Kurt, Öztürk and Peers 2013, with a statue and materials made by code."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

import acquire
import acquire.mitsuba

from ._panels import column, error_times_five, flip, labelled, psnr_db, row, srgb, zoom

#: The paper's material: its bytes are what all models of Figure 2 get.
PAPER = dict(model="tucker", terms=15, degree=7)


def main() -> None:
    given = _arguments()
    given.out.mkdir(parents=True, exist_ok=True)
    acquire.mitsuba.use(given.variant)
    from ._scene import Stage

    matrices = {
        "chessboard": given.chessboard or _simulated(given.out / "chessboard", "chessboard-8x8", 64),
        "marble": given.marble or _simulated(given.out / "marble", "marble", 32),
    }
    stage = Stage(given.out / "statue.ply", given.width, given.spp)
    measured = {"spp": given.spp, "width": given.width}
    if given.figure in (None, 1):
        figure_1(given.out, stage, matrices)
    if given.figure in (None, 2):
        measured["figure_2"] = figure_2(given.out, stage, matrices["chessboard"])
        (given.out / "figure-2.json").write_text(json.dumps(measured, indent=1) + "\n")


def figure_1(out: Path, stage, matrices: dict[str, Path]) -> None:
    """Marble from near (T = 15, P = 4), a chessboard (T = 15, P = 7) under three lights."""
    marble = _factored(matrices["marble"], out / "marble-t15-p4.safetensors", model="tucker", terms=15, degree=4)
    paper = _factored(matrices["chessboard"], out / "chessboard-t15-p7.safetensors", **PAPER)
    pictures = [labelled(srgb(stage.render(marble, "window", near=True)), "marble, T = 15, P = 4")]
    pictures += [labelled(srgb(stage.render(paper, light)), f"chessboard, T = 15, P = 7, {light}") for light in ("spot", "window", "behind")]
    row(pictures).save(out / "figure-1.png")


def figure_2(out: Path, stage, matrix: Path) -> list[dict]:
    """The chessboard in a spot: the matrix, and models of as many bytes as the paper's, each with its difference × 5."""
    paper = _factored(matrix, out / "chessboard-t15-p7.safetensors", **PAPER)
    most = acquire.Material.load(paper).bytes_f32
    models = {
        "Peers et al. 2006": _factored(matrix, out / f"chessboard-peers-{most}.safetensors", model="peers2006", max_bytes=most),
        "Kurt et al. 2013": paper,
        "joint, with maps": _factored(matrix, out / f"chessboard-joint-{most}.safetensors", model="joint", max_bytes=most, maps=True),
    }
    reference, again = (stage.render(matrix, "spot", seed=k) for k in (0, 1))
    columns, measured = [column([labelled(srgb(reference), "matrix"), srgb(zoom(reference))])], []
    for name, file in {"matrix, other seed": None, **models}.items():
        before = time.process_time()
        picture = again if file is None else stage.render(file, "spot")
        figures = {"name": name, "psnr_db": psnr_db(picture, reference), "flip": flip(picture, reference)}
        if file is not None:
            figures |= {"bytes_f32": acquire.Material.load(file).bytes_f32, "processor_secs": round(time.process_time() - before, 2)}
            title = f"{name}: {figures['psnr_db']:.1f} dB"
            columns.append(column([labelled(srgb(picture), title), srgb(zoom(picture)), error_times_five(picture, reference)]))
        measured.append(figures)
        print(json.dumps(figures), flush=True)
    row(columns).save(out / "figure-2.png")
    return measured


def _factored(matrix: Path, path: Path, **how) -> Path:
    """A material, made once."""
    if not path.exists():
        print(f"factoring {path.name}", file=sys.stderr)
        acquire.factor(matrix, **how).save(path)
    return path


def _simulated(folder: Path, material: str, points: int) -> Path:
    """A noise-free matrix, made once; the chessboard takes about nine minutes of a processor."""
    if not (folder / "truth.rd.zarr").exists():
        pitches = dict(lit_pitch_mm=0.5, pitch_mm=0.5)
        acquire.simulate(folder, material=material, grid=(points, points), window=(31, 31), truth_only=True, seed=1, **pitches)
    return folder / "truth.rd.zarr"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m acquire.figures", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/figures"), help="folder of the pictures and what they are made of; what is there is used again")
    parser.add_argument("--figure", type=int, choices=(1, 2), help="only this one")
    parser.add_argument("--chessboard", type=Path, help="a matrix to take instead of the simulated chessboard")
    parser.add_argument("--marble", type=Path, help="a matrix to take instead of the simulated marble")
    parser.add_argument("--width", type=int, default=320, help="pixels of a picture, which is half as high again [320]")
    parser.add_argument("--spp", type=int, default=512, help="paths for a pixel [512]")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="Mitsuba's variant [llvm_ad_rgb]")
    return parser.parse_args()


if __name__ == "__main__":
    try:
        main()
    except acquire.InputError as error:
        sys.exit(f"error: {error}")
