"""Figure 3: how far a picture is from the matrix's own, against the bytes of the material and the time of the picture."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

import acquire

from ._panels import flip_if_there, psnr_db
from ._plot import Axes, Drawing

#: Colour and mark of each model.
LOOKS = {
    "tucker": ("square", "#c0562f"),
    "peers2006": ("triangle", "#7a7a7a"),
    "joint": ("circle", "#1f6fb4"),
    "joint, coded": ("diamond", "#2c8a4b"),
}
TUCKER_TERMS, JOINT_TERMS, DEGREE = (5, 10, 15, 20), (8, 15, 30), 7
#: The material whose pictures are timed, and by what their paths are fewer than those of the other pictures.
TIMED, FEWER = 15, (16, 4, 1)
#: Times as many paths has the picture that the timed ones are compared with; its noise is half of the best one's.
LESS_NOISE = 4


def settings(factored: Callable[..., Path]) -> Iterator[tuple[str, str, Path]]:
    """Series, name and file of every material; ``factored(**how)`` makes a file.

    ``tucker`` (P = 7), ``peers2006`` in as many bytes, ``joint`` with maps, plain and coded.
    """
    for terms in TUCKER_TERMS:
        paper = factored(model="tucker", terms=terms, degree=DEGREE)
        yield "tucker", f"tucker, T = {terms}, P = {DEGREE}", paper
        peers = factored(model="peers2006", max_bytes=acquire.Material.load(paper).bytes_f32)
        yield "peers2006", f"peers2006, T = {_terms(peers)}", peers
    for terms in JOINT_TERMS:
        yield "joint", f"joint, T = {terms}", factored(model="joint", terms=terms, maps=True)
    for terms in (JOINT_TERMS[0], JOINT_TERMS[-1]):
        yield "joint, coded", f"joint, T = {terms}, coded", factored(model="joint", terms=terms, maps=True, precision="coded")


def figure_3(out: Path, stage, matrix: Path, factored: Callable[..., Path]) -> dict:
    """The chessboard in a spot, with the random numbers of the matrix's own picture; then one material with fewer paths."""
    reference = stage.render(matrix, "spot")
    models = []
    for series, name, file in settings(factored):
        picture = stage.render(file, "spot")
        size = file.stat().st_size if file.suffix == ".acq" else acquire.Material.load(file).bytes_f32
        models.append({"series": series, "name": name, "terms": _terms(file), "bytes": size, "psnr_db": psnr_db(picture, reference), "flip": flip_if_there(picture, reference)})
        print(json.dumps(models[-1]), flush=True)
    quiet = stage.render(matrix, "spot", seed=1, spp=LESS_NOISE * stage.spp)
    file = factored(model="joint", terms=TIMED, maps=True)
    times = [_timed(stage, file, max(1, stage.spp // fewer), quiet) for fewer in FEWER]
    measured = {"models": models, "timed": f"joint, T = {TIMED}", "reference_spp": LESS_NOISE * stage.spp, "times": times}
    drawing = draw(measured)
    drawing.save_svg(out / "figure-3.svg")
    drawing.save_png(out / "figure-3.png")
    return measured


def _terms(file: Path) -> int:
    return acquire.Material.load(file).info["terms"]


def _timed(stage, file: Path, spp: int, reference: np.ndarray) -> dict:
    """A picture's processor time without that of compiling, and its error."""
    scene = stage.scene(file, "spot")
    stage.picture(scene, spp=spp)
    before = time.process_time()
    picture = stage.picture(scene, spp=spp)
    figures = {"spp": spp, "processor_secs": round(time.process_time() - before, 3), "psnr_db": psnr_db(picture, reference)}
    print(json.dumps(figures), flush=True)
    return figures


def draw(measured: dict) -> Drawing:
    """PSNR over bytes, a colour and mark for each model; beside it, PSNR over processor time."""
    drawing = Drawing(760, 350)
    models, times = measured["models"], measured["times"]
    sizes, seconds = [m["bytes"] for m in models], [t["processor_secs"] for t in times]
    bytes_words = lambda v: f"{v / 1e6:g} MB" if v >= 1e6 else f"{v / 1e3:g} kB"  # noqa: E731
    left = Axes(drawing, (44, 40, 450, 280), _around(sizes), _span([m["psnr_db"] for m in models]), "bytes of the material; numbers: T", "PSNR to the matrix's picture, dB", bytes_words)
    for number, (series, (shape, colour)) in enumerate(LOOKS.items()):
        points = sorted((m["bytes"], m["psnr_db"]) for m in models if m["series"] == series)
        left.curve(points, shape, colour)
        for m in models:
            if m["series"] == series:
                x, y = left.at(m["bytes"], m["psnr_db"])
                drawing.words((x, y - 12), str(m["terms"]), "middle")
        drawing.mark((60 + 98 * number, 340), shape, colour)
        drawing.words((68 + 98 * number, 340), series)
    noise = [t["psnr_db"] for t in times]
    same = next(m["psnr_db"] for m in models if m["name"] == measured["timed"])
    right = Axes(drawing, (520, 40, 745, 280), _around(seconds), _span([*noise, same]), "processor time of a picture, s", f"PSNR of {measured['timed']}, dB", lambda v: f"{v:g}")
    right.level(same, "same random numbers")
    right.curve(list(zip(seconds, noise)), *LOOKS["joint"])
    for t in times:
        x, y = right.at(t["processor_secs"], t["psnr_db"])
        drawing.words((x, y - 12), f"{t['spp']}", "middle")
    drawing.words((632, 328), "numbers: paths a pixel", "middle")
    return drawing


def _around(values: list[float]) -> tuple[float, float]:
    """A range of a logarithmic axis with a fifth of its width, and at least a tenth of a decade, around the values."""
    beyond = max((max(values) / min(values)) ** 0.1, 10**0.1)
    return min(values) / beyond, max(values) * beyond


def _span(values: list[float]) -> tuple[float, float]:
    """A range of decibels with room for marks and words."""
    return min(values) - 3, max(values) + 4
