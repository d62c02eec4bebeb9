"""Factored materials."""

from __future__ import annotations

import json
import os
from typing import Any, NamedTuple, Union

import numpy as np
import numpy.typing as npt

from ._errors import InputError, tell
from ._native import native

Path = Union[str, "os.PathLike[str]"]
Floats = npt.NDArray[np.float64]


class Exitance(NamedTuple):
    """What leaves a slab: a regular grid that covers all windows.

    :param values: radiant exitance, shape (y, x, 3), in the unit of the irradiance.
    :param x_mm: middles of the columns, mm, shape (x,).
    :param y_mm: middles of the lines, mm, shape (y,).
    """

    values: Floats
    x_mm: Floats
    y_mm: Floats


class Material:
    """A factored material: R̂_d(x_i, x_o) from a few kilobytes or megabytes.

    Made by :meth:`load` or :func:`acquire.factor`. Immutable; its methods may be called from any thread and run without Python's lock.
    """

    def __init__(self, native_material: Any, report: dict[str, Any] | None = None) -> None:
        self._native = native_material
        self._header: dict[str, Any] = json.loads(native_material.header())
        #: What :func:`acquire.factor` says about it: ``choice``, ``rel_rmse``, ``psnr_db``, ``bytes``, ``agreement``, ``findings``; ``None`` for one that was loaded.
        self.report = report

    @classmethod
    def load(cls, source: Path | bytes) -> Material:
        """Reads a material, plain (``.safetensors``) or coded (``.acq``), from a file or from the bytes of one.

        :raises InputError: when it cannot be read, or is damaged.
        """
        if isinstance(source, (bytes, bytearray, memoryview)):
            return cls(native.NativeMaterial.from_bytes(bytes(source)))
        return cls(native.NativeMaterial.load(os.fspath(source)))

    def __reduce__(self) -> tuple[Any, ...]:
        # Workers of dask and multiprocessing get the file's bytes.
        return (Material.load, (self.to_bytes("f32"),))

    def __repr__(self) -> str:
        x, y = self._header["points"]
        return f"<acquire.Material: {self._native.describe()}; {x} × {y} points, {self.bytes_f32} bytes of f32>"

    @property
    def info(self) -> dict[str, Any]:
        """The header: ``model``, ``points`` and ``window`` (along x and y), ``pitch_mm``, ``lit_pitch_mm``, ``terms``, ``degree``, ``singular_values``, ``provenance``, …

        ``docs/materials.md`` describes the fields.
        """
        return dict(self._header)

    @property
    def bytes_f32(self) -> int:
        """Every stored number as 4 bytes, the papers' count."""
        return self._native.bytes_f32()

    @property
    def lit_mm(self) -> Floats:
        """Where lit points are, mm, shape (points along y, points along x, 2), x first."""
        x, y = self._header["points"]
        return self._native.factors()["lit_mm"].reshape(y, x, 2)

    @property
    def lit_extent_mm(self) -> tuple[float, float, float, float]:
        """The lit area: x from, x to, y from, y to, mm; half a lit pitch around the lattice of lit points."""
        return tuple(self._native.lit_extent_mm())

    def response(self, x_i: npt.ArrayLike, x_o: npt.ArrayLike, *, interpolate: bool = True) -> npt.NDArray[np.float32]:
        """R̂_d(x_i, x_o) of n pairs of points.

        :param x_i: where light enters, mm, shape (n, 2) or (2,), x first.
        :param x_o: where it leaves; broadcast against ``x_i``.
        :param interpolate: bilinear between the four lit points around x_i, each at the offset x_o − x_i, and between the four samples around the offset;
            otherwise the nearest lit point and sample.
        :returns: mm⁻², shape (n, 3): R, G, B. 0 outside the window and beyond half a step from the lit points.
        """
        a, b = (np.asarray(p, dtype=np.float64) for p in (x_i, x_o))
        for name, points in (("x_i", a), ("x_o", b)):
            if points.ndim not in (1, 2) or points.shape[-1] != 2:
                raise InputError(f"{name}: expected shape (n, 2) or (2,), found {points.shape}", "Setting")
        try:
            a, b = np.broadcast_arrays(np.atleast_2d(a), np.atleast_2d(b))
        except ValueError:
            raise InputError(f"x_i, x_o: expected as many points, found {len(a)} and {len(b)}", "Setting") from None
        return self._native.response(np.ascontiguousarray(a), np.ascontiguousarray(b), interpolate)

    def row(self, i: int) -> npt.NDArray[np.float32]:
        """R̂_d of lit point ``i`` (row-major over (y, x); negative ones count from the end) on its window, mm⁻², shape (dy, dx, 3)."""
        return self.rows([i])[0]

    def rows(self, indices: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Rows of many lit points at once, which is far quicker than one by one: mm⁻², shape (n, dy, dx, 3)."""
        return self._native.rows(np.ascontiguousarray(indices, dtype=np.int64))

    def _index(self, x_i: int | npt.ArrayLike) -> int:
        if isinstance(x_i, (int, np.integer)):
            return int(x_i)
        at = np.asarray(x_i, dtype=np.float64)
        if at.shape != (2,):
            raise InputError(f"x_i: expected the number of a lit point, or a point (2,) in mm, found shape {at.shape}", "Setting")
        return self._native.nearest_point(*at)

    def sample(self, x_i: int | npt.ArrayLike, n: int, seed: int = 0) -> tuple[Floats, Floats]:
        """Draws offsets d = x_o − x_i for importance sampling.

        :param x_i: the number of a lit point, or a place in mm, of which the nearest lit point is taken.
        :returns: offsets, mm, shape (n, 2), and their probability densities, mm⁻², shape (n,). ∫ R̂_d dA is the mean of response / density.
            The density is nearly proportional to the response, exact, and positive wherever the response may be.
        """
        return self._native.sample(self._index(x_i), n, seed)

    def density(self, x_i: int | npt.ArrayLike, offsets: npt.ArrayLike) -> Floats:
        """The density with which :meth:`sample` draws offsets (n, 2), mm: mm⁻², shape (n,)."""
        return self._native.density(self._index(x_i), np.ascontiguousarray(offsets, dtype=np.float64).reshape(-1, 2))

    def relight(self, irradiance: npt.ArrayLike, extent_mm: tuple[float, float, float, float] | None = None, tile: tuple[int, int] = (1, 1)) -> Exitance:
        """The slab under a light.

        :param irradiance: shape (y, x) or (y, x, 3), linear; line 0 is at the smallest y. Each cell of the lit area receives the flux Φ = irradiance (its mean over
            the cell) × the cell's area, mm²; exitance has the unit of the irradiance, so that a slab of albedo A under an irradiance of 1 gives A.
        :param extent_mm: x from, x to, y from, y to of the image on the slab, mm; dark beyond it. Default: over the lit area, along the sides of its lattice.
        :param tile: copies of the image along x and y that fill this extent side by side; where copies meet, samples are means over parts of both, as within the image.
        :warns FindingWarning: without ``extent_mm``, for an image of another aspect ratio than the lit area's (``light-stretched``).
        """
        image = np.asarray(irradiance, dtype=np.float32)
        if image.ndim == 2:
            image = image[..., None]
        if image.ndim != 3 or image.shape[2] not in (1, 3):
            raise InputError(f"irradiance: expected shape (y, x) or (y, x, 3), found {np.shape(irradiance)}", "Setting")
        image = np.ascontiguousarray(np.broadcast_to(image, (*image.shape[:2], 3)))
        if extent_mm is not None:
            extent_mm = tuple(float(v) for v in extent_mm)
        tile = tuple(int(n) for n in tile)
        if len(tile) != 2 or min(tile) < 1:
            raise InputError(f"tile: expected two numbers of copies, 1 or more, found {tile}", "Setting")
        values, origin, findings = self._native.relight(image, extent_mm, tile)
        tell(json.loads(findings))
        lines, columns, _ = values.shape
        pitch = self._header["pitch_mm"]
        return Exitance(values, origin[0] + pitch * np.arange(columns), origin[1] + pitch * np.arange(lines))

    @property
    def factors(self) -> dict[str, np.ndarray]:
        """The tensors by name, copies: ``weights``, ``incident_factors``, ``offset_factors``, ``shift``, ``lit_mm``, …; shapes are in ``docs/materials.md``."""
        return self._native.factors()

    def save(self, path: Path, precision: str | None = None, *, force: bool = False) -> None:
        """Writes a material; the file is renamed into place when it is complete.

        :param precision: ``f32``, ``f16`` or ``coded``; default: as it was made or loaded. A name that ends in ``.acq`` is coded, one in ``.safetensors`` is not.
        :param force: replace an earlier material of this program.
        """
        name = os.fspath(path)
        if precision is None and name.endswith(".acq"):
            precision = "coded"
        self._native.save(name, precision, force)

    def to_bytes(self, precision: str | None = None) -> bytes:
        """What :meth:`save` would write."""
        return self._native.to_bytes(precision)

    def export(self, path: Path, *, force: bool = False) -> None:
        """Writes the factors as NumPy's ``.npz`` or as layers of an OpenEXR ``.exr`` (``docs/materials.md``).

        :param force: replace an earlier export of this program.
        """
        self._native.export(os.fspath(path), force)
