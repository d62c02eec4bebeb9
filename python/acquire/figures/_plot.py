"""Diagrams as SVG and PNG from one list of lines, marks and words."""

from __future__ import annotations

import math
from collections.abc import Callable
from html import escape
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

#: Drawn larger by this and made smaller again, so that PNG has smooth lines.
_OVERSAMPLING = 4
_FONT = 11
#: Of the edge of a mark, px: its half width.
_MARK = 4.5
_INK, _FAINT = "#333333", "#dddddd"
_SHAPES = {
    "circle": [(math.cos(k * math.pi / 12), math.sin(k * math.pi / 12)) for k in range(24)],
    "square": [(-0.9, -0.9), (0.9, -0.9), (0.9, 0.9), (-0.9, 0.9)],
    "triangle": [(0, -1.2), (1.1, 0.8), (-1.1, 0.8)],
    "diamond": [(0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0)],
}
Point = tuple[float, float]


class Drawing:
    """Lines, filled marks and words in px from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self._parts: list[tuple] = []

    def line(self, points: list[Point], colour: str = _INK, dashed: bool = False) -> None:
        self._parts.append(("line", points, colour, dashed))

    def mark(self, at: Point, shape: str, colour: str, hollow: bool = False) -> None:
        """``shape``: circle, square, triangle or diamond."""
        self._parts.append(("mark", [(at[0] + _MARK * x, at[1] + _MARK * y) for x, y in _SHAPES[shape]], colour, hollow))

    def words(self, at: Point, text: str, anchor: str = "start") -> None:
        """Words whose middle line is at a point; ``anchor``: what of them, ``start``, ``middle`` or ``end``."""
        self._parts.append(("words", [at], text, anchor))

    def save_svg(self, path: Path) -> None:
        width, height = self.size
        lines = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="{_FONT}">']
        lines.append('<rect width="100%" height="100%" fill="white"/>')
        for kind, points, what, how in self._parts:
            places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
            if kind == "line":
                dashes = ' stroke-dasharray="4 3"' if how else ""
                lines.append(f'<polyline points="{places}" fill="none" stroke="{what}"{dashes}/>')
            elif kind == "mark":
                lines.append(f'<polygon points="{places}" fill="{"white" if how else what}" stroke="{what}"/>')
            else:
                (x, y), lower = points[0], _FONT * 0.35
                lines.append(f'<text x="{x:.1f}" y="{y + lower:.1f}" text-anchor="{how}" fill="{_INK}">{escape(what)}</text>')
        path.write_text("\n".join([*lines, "</svg>"]) + "\n")

    def save_png(self, path: Path) -> None:
        k = _OVERSAMPLING
        image = Image.new("RGB", (k * self.size[0], k * self.size[1]), "white")
        draw, font = ImageDraw.Draw(image), ImageFont.load_default(_FONT * k)
        for kind, points, what, how in self._parts:
            scaled = [(k * x, k * y) for x, y in points]
            if kind == "line":
                for a, b in zip(scaled, scaled[1:]):
                    for part in _dashes(a, b, k) if how else [(a, b)]:
                        draw.line(part, what, k)
            elif kind == "mark":
                draw.polygon(scaled, "white" if how else what, what, k)
            else:
                draw.text(scaled[0], what, _INK, font, anchor={"start": "lm", "middle": "mm", "end": "rm"}[how])
        image.resize(self.size, Image.Resampling.LANCZOS).save(path, optimize=True)


def _dashes(a: Point, b: Point, scale: int) -> list[tuple[Point, Point]]:
    """Dashes of 4 px, 3 px apart."""
    length = math.dist(a, b)
    at = lambda s: tuple(p + (q - p) * min(s / max(length, 1e-9), 1) for p, q in zip(a, b))  # noqa: E731
    return [(at(s), at(s + 4 * scale)) for s in range(0, int(length) + 1, 7 * scale)]


class Axes:
    """A panel of a drawing: x logarithmic, y linear.

    :param box: left, top, right and bottom, px.
    :param x: from and to; :param y: from and to.
    """

    def __init__(self, drawing: Drawing, box: tuple[int, int, int, int], x: Point, y: Point, x_words: str, y_words: str, tick: Callable[[float], str]) -> None:
        self.drawing, self.box, self.x, self.y = drawing, box, x, y
        left, top, right, bottom = box
        for value in _decades(*x):
            drawing.line([self.at(value, y[0]), self.at(value, y[1])], _FAINT)
            drawing.words((self.at(value, 0)[0], bottom + 12), tick(value), "middle")
        step = 5 if y[1] - y[0] <= 40 else 10
        for value in range(math.ceil(y[0] / step) * step, math.floor(y[1]) + 1, step):
            drawing.line([self.at(x[0], value), self.at(x[1], value)], _FAINT)
            drawing.words((left - 6, self.at(1, value)[1]), str(value), "end")
        drawing.line([(left, top), (left, bottom), (right, bottom)])
        drawing.words(((left + right) / 2, bottom + 30), x_words, "middle")
        drawing.words((left - 30, top - 14), y_words)

    def at(self, x: float, y: float) -> Point:
        left, top, right, bottom = self.box
        along = math.log(x / self.x[0]) / math.log(self.x[1] / self.x[0])
        return left + along * (right - left), bottom - (y - self.y[0]) / (self.y[1] - self.y[0]) * (bottom - top)

    def curve(self, points: list[Point], shape: str, colour: str, hollow: bool = False) -> None:
        """Marks, joined in their order."""
        places = [self.at(*p) for p in points]
        self.drawing.line(places, colour)
        for place in places:
            self.drawing.mark(place, shape, colour, hollow)

    def level(self, y: float, words: str) -> None:
        """A dashed line with words over its end."""
        self.drawing.line([self.at(self.x[0], y), self.at(self.x[1], y)], dashed=True)
        x, height = self.at(self.x[1], y)
        self.drawing.words((x, height - 8), words, "end")


def _decades(low: float, high: float) -> list[float]:
    """1, 2 and 5 times powers of ten in a range."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [d * 10.0**p for p in powers for d in (1, 2, 5) if low <= d * 10.0**p <= high]
