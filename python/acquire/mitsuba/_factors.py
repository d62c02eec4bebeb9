"""A material's factors, or a matrix, as arrays of the current Mitsuba variant: rows, offsets to draw, lit points in tiles."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import Material, Matrix

#: Share of the offsets that are drawn evenly from the window: a row may leave light where the mean of the rows has none.
EVEN_SHARE = 0.02
#: Rows whose mean is what offsets are drawn for.
MOST_ROWS = 4096
#: What lies beyond the lit area: tiles side by side, tiles mirrored at their sides, the outermost rows on and on, nothing.
WRAPS = ("repeat", "mirror", "clamp", "none")
_LANES = 4


def lattice(source: Material | Matrix) -> tuple[np.ndarray, np.ndarray]:
    """Origin (2,) and steps (2, 2) with place_mm = origin + steps @ (column, line) of the lit points, by least squares.

    The lattice that ``Material.response`` interpolates in; an axis of one point takes the lit pitch.
    """
    lines, columns, _ = source.lit_mm.shape
    place = source.lit_mm.reshape(-1, 2)
    middle = np.array([columns - 1, lines - 1]) / 2
    at = np.stack(np.meshgrid(np.arange(columns), np.arange(lines)), -1).reshape(-1, 2) - middle
    pitch = np.diag(source.info["lit_pitch_mm"])
    square = (at**2).sum(0)
    steps = np.where(square > 0, (place - place.mean(0)).T @ at / np.maximum(square, 1e-9), pitch)
    if abs(np.linalg.det(steps)) < 1e-6 * np.linalg.det(pitch):
        steps = pitch
    return place.mean(0) - steps @ middle, steps


def tile(origin: np.ndarray, steps: np.ndarray, points: list[int]) -> np.ndarray:
    """The largest part of the lit area that lies along the slab's axes and has the sides of its bounds: [[x from, x to], [y from, y to]], mm.

    The lit area itself, half a step around the lattice, where the lattice is not turned.
    """
    middle, half = origin + steps @ (np.array(points) - 1) / 2, np.abs(steps) @ np.array(points) / 2
    share = (np.array(points) / 2 / (np.abs(np.linalg.inv(steps)) @ half)).min()
    return np.stack([middle - share * half, middle + share * half], axis=1)


def offset_weights(source: Material | Matrix) -> np.ndarray:
    """With which probability each sample of the window is drawn, (dy, dx): the mean row, and a share that is even."""
    count = int(np.prod(source.info["points"]))
    chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_ROWS)).astype(int))
    rows = source.rows if isinstance(source, Material) else lambda block: _filled(source.read(block[0], block[-1] + 1))
    blocks = np.array_split(chosen, -(-len(chosen) // 256))
    mean = sum(np.maximum(rows(block).mean(-1, dtype=float), 0).mean(0) for block in blocks)
    if not mean.sum() > 0:
        return np.full_like(mean, 1 / mean.size)
    return (1 - EVEN_SHARE) * mean / mean.sum() + EVEN_SHARE / mean.size


def _filled(rows: Any) -> np.ndarray:
    """Responses of a matrix, 0 where not measured."""
    return np.where(rows.valid, rows.response, 0)


class Draws:
    """What is drawn for a hit: samples of the window, and lit points.

    A picture needs no interpolation: lit points and samples are drawn with the weights that a bilinear mean gives them, so that the mean over draws is the
    integral of ``Material.relight``.
    """

    def __init__(self, source: Material | Matrix, wrap: str) -> None:
        info = source.info
        self.jit, self.wrap = dr.is_jit_v(mi.Float), wrap
        self.points, self.window = info["points"], info["window"]
        self.pitch_mm: float = info["pitch_mm"]
        origin, steps = lattice(source)
        self.origin_mm, self.steps_mm, self.from_mm = origin.tolist(), steps.tolist(), np.linalg.inv(steps).tolist()
        #: From and to along x and y; uv = (0, 0) is its first corner.
        self.tile_mm = tile(origin, steps, self.points).tolist()
        weights = offset_weights(source).ravel()
        self.probability = self._upload(weights)
        self.draws = mi.DiscreteDistribution([float(p) for p in weights])

    def _upload(self, values: np.ndarray) -> Any:
        flat = np.ascontiguousarray(values).ravel()
        if not self.jit:
            return flat
        return mi.Int32(flat) if flat.dtype.kind == "i" else mi.Float(flat.astype(np.float32))

    def _at(self, array: Any, index: Any, active: Any) -> Any:
        if self.jit:
            kind = mi.Int32 if dr.is_integral_v(array) else mi.Float
            return dr.gather(kind, array, mi.UInt32(index), active)
        return array[index].item() if active else array.dtype.type(0).item()

    def draw_offset(self, choice: Any, jitter: Any) -> tuple[Any, Any, Any, Any]:
        """A sample of the window and a point that stands for it: (x, y, d in mm, area / probability in mm²).

        The point is distributed as the tent that a bilinear mean gives the sample; the half of a rim's sample that has no neighbour is even over half a pitch.
        """
        cell = self.draws.sample(choice)
        probability = self._at(self.probability, cell, True)
        width, height = self.window
        x, y = mi.Int32(cell % width), mi.Int32(cell // width)
        offset = []
        for k, n, u in ((x, width, jitter.x), (y, height, jitter.y)):
            tent = dr.select(u < 0.5, dr.sqrt(2 * u) - 1, 1 - dr.sqrt(2 * dr.maximum(1 - u, 0)))
            rim = ((k == 0) & (u < 0.5)) | ((k == n - 1) & (u >= 0.5))
            offset.append((k - n // 2 + dr.select(rim, u - 0.5, tent)) * self.pitch_mm)
        return x, y, mi.Point2f(*offset), self.pitch_mm**2 / probability

    def draw_lit_point(self, place_mm: Any, choice: Any) -> tuple[Any, Any, list[Any], Any]:
        """One of the four lit points around a place, drawn by its weight.

        :returns: its index, the place in the tile (mm), for each axis whether that is mirrored, and whether there is any.
        """
        place, mirrored, inside = [], [], True
        for v, (low, high) in zip(place_mm, self.tile_mm):
            v, flip, within = self._wrapped(v, low, high)
            place.append(v)
            mirrored.append(flip)
            inside = inside & within
        index = []
        for axis, (n, random) in enumerate(zip(self.points, choice)):
            along = self.from_mm[axis]
            u = dr.clip(along[0] * (place[0] - self.origin_mm[0]) + along[1] * (place[1] - self.origin_mm[1]), 0, n - 1)
            first = mi.Int32(dr.floor(u))
            index.append(dr.minimum(first + dr.select(random < u - first, 1, 0), n - 1))
        index = index[0] + index[1] * self.points[0]
        return (mi.UInt32(index) if self.jit else int(index)), mi.Point2f(*place), mirrored, inside

    def _wrapped(self, v: Any, low: float, high: float) -> tuple[Any, Any, Any]:
        """A coordinate in the tile, whether it is mirrored, and whether anything is there."""
        side, t = high - low, v - low
        if self.wrap == "repeat":
            return v - side * dr.floor(t / side), False, True
        if self.wrap == "mirror":
            t = t - 2 * side * dr.floor(t / (2 * side))
            return low + dr.select(t > side, 2 * side - t, t), t > side, True
        return dr.clip(v, low, high), False, (True if self.wrap == "clamp" else (t >= 0) & (t <= side))

class Factors(Draws):
    """R̂_d of a material, one lit point and one sample of its window at a time."""

    def __init__(self, material: Material, wrap: str) -> None:
        super().__init__(material, wrap)
        header, tensors = material.info, material.factors
        self.extended = header["extended"]
        self.planes = [header["incident_planes"], header["offset_planes"]]
        self.terms = -(-header["terms"] // _LANES) * _LANES
        profile = tensors["profile"][:, None] if "profile" in tensors else 1.0
        samples = np.moveaxis(tensors["offset_factors"] * profile, 1, -1)  # (B, y, x, T)
        self.incident = self._upload(self._padded(tensors["incident_factors"] * tensors["weights"]))
        self.offset = self._upload(self._padded(samples))
        self.shift = self._upload(tensors["shift"].astype(np.int32))
        self.degree, self.intensity_range = header["degree"], header["intensity_range"]
        if self.degree is not None:
            self.color = self._upload(tensors["color_coefficients"])
        self.exit_grid = header.get("exit_grid")
        if self.exit_grid:
            self.entry_map, self.exit_map = (self._upload(tensors[name]) for name in ("entry_map", "exit_map"))

    def _padded(self, values: np.ndarray) -> np.ndarray:
        return np.pad(values, [(0, 0)] * (values.ndim - 1) + [(0, self.terms - values.shape[-1])])

    def _product(self, row: Any, sample: Any, active: Any) -> Any:
        """Σ_j of a line of the incident factors times one of the offset factors."""
        if not self.jit:
            if not active:
                return 0.0
            return float(self.incident[row * self.terms :][: self.terms] @ self.offset[sample * self.terms :][: self.terms])
        packets = self.terms // _LANES
        packet = lambda array, line, k: dr.gather(mi.Vector4f, array, line * packets + k, active)  # noqa: E731
        body = lambda k, total: (k + 1, dr.fma(packet(self.incident, row, k), packet(self.offset, sample, k), total))  # noqa: E731
        return dr.sum(dr.while_loop((mi.UInt32(0), mi.Vector4f(0)), lambda k, total: k < packets, body)[1])

    def response(self, index: Any, x: Any, y: Any, exit_mm: Any, active: Any = True) -> Any:
        """R̂_d of lit point ``index`` at samples (x, y) of its window, mm⁻², with the exit map of ``exit_mm``."""
        e = []
        for axis, sample in enumerate((x, y)):
            shift = self._at(self.shift, 2 * index + axis, active)
            e.append(sample + (self.extended[axis] // 2 - self.window[axis] // 2) - shift)
            active = active & (e[axis] >= 0) & (e[axis] < self.extended[axis])
        place = e[0] + e[1] * self.extended[0]
        place, index = (dr.select(active, v, 0) for v in (place, index))
        if self.jit:
            place, index = mi.UInt32(place), mi.UInt32(index)
        samples, lit = self.extended[0] * self.extended[1], self.points[0] * self.points[1]
        of_plane = lambda k: self._product(  # noqa: E731
            index + min(k, self.planes[0] - 1) * lit, place + min(k, self.planes[1] - 1) * samples, active
        )
        planes = [of_plane(k) for k in range(max(self.planes))]
        value = self._colored(index, planes[0], active) if self.degree is not None else planes * (3 // len(planes))
        if self.exit_grid:
            value = [v * self._maps(c, index, exit_mm, active) for c, v in enumerate(value)]
        return dr.select(active, mi.Color3f(*value), 0)

    def _colored(self, index: Any, intensity: Any, active: Any) -> list[Any]:
        low, high = self.intensity_range
        u = dr.clip((2 * intensity - low - high) / (high - low), -1, 1)
        legendre = [mi.Float(1), u]
        for p in range(2, self.degree + 1):
            legendre.append(((2 * p - 1) * u * legendre[-1] - (p - 1) * legendre[-2]) / p)
        of_channel = lambda c: sum(  # noqa: E731
            self._at(self.color, (index * 3 + c) * (self.degree + 1) + p, active) * legendre[p] for p in range(self.degree + 1)
        )
        return [of_channel(c) for c in range(3)]

    def _maps(self, channel: int, index: Any, exit_mm: Any, active: Any) -> Any:
        """a_c of a lit point times e_c of a place, bilinear, the rim's beyond the map."""
        (columns, lines), planes = self.exit_grid["size"], self.exit_grid["planes"]
        plane = min(channel, planes - 1)
        at = [
            dr.clip((exit_mm[a] - self.exit_grid["origin_mm"][a]) / self.pitch_mm, 0, n - 1) for a, n in enumerate((columns, lines))
        ]
        first = [mi.Int32(dr.clip(dr.floor(v), 0, n - 1)) for v, n in zip(at, (columns, lines))]
        beyond = [v - f for v, f in zip(at, first)]
        cell = lambda dx, dy: self._at(  # noqa: E731
            self.exit_map,
            (plane * lines + dr.minimum(first[1] + dy, lines - 1)) * columns + dr.minimum(first[0] + dx, columns - 1),
            active,
        )
        above, below = (dr.lerp(cell(0, dy), cell(1, dy), beyond[0]) for dy in (0, 1))
        return self._at(self.entry_map, plane * self.points[0] * self.points[1] + index, active) * dr.lerp(above, below, beyond[1])


class Table(Draws):
    """R_d of a matrix, all of it: what a material is compared with."""

    def __init__(self, matrix: Matrix, wrap: str) -> None:
        super().__init__(matrix, wrap)
        self.values = self._upload(_filled(matrix.read()))

    def response(self, index: Any, x: Any, y: Any, exit_mm: Any, active: Any = True) -> Any:
        """R_d of lit point ``index`` at samples (x, y) of its window, mm⁻²; 0 where not measured."""
        first = 3 * ((index * self.window[1] + y) * self.window[0] + x)
        return mi.Color3f(*(self._at(self.values, first + c, active) for c in range(3)))
